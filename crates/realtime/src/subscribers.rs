//! Subscribers of a session: which streams get samples, records, frames and hashes, and at which steps.

use std::sync::Arc;

use super::clock::now_ns;
use super::frames::Viewer;
use super::queue::{Wakes, Writer};
use super::reading::{Copied, Copies, HashReply, Piece, Reading, Recipient, Recorded, SharedRecord, is_much};
use palpate_refusal::Result;
use palpate_session::Session;
use palpate_session::budget::{Account, Purpose, Resource, Taken, Work};
use palpate_session::sample_selection::PacedSample;
use palpate_session::sample_selection::Sampler;
use palpate_tissue::memory;
use palpate_tissue::scene::record::{Point, Record, ToolRecord};
use palpate_tissue::shape::PointId;

/// A stream of samples.
pub(super) struct SampleTap {
    pub(super) sampler: Sampler,
    pub(super) once: bool,
    pub(super) writer: Writer<PacedSample>,
    /// Account that is charged, unless the stream holds a tool.
    pub(super) watcher: Option<Account>,
    /// Number of dropped steps that the stream has been sent.
    pub(super) overrun_count: u64,
}

/// A stream of records.
pub(super) struct ProbeTap {
    pub(super) every: u64,
    /// All points, if `None`.
    pub(super) points: Option<Arc<[PointId]>>,
    pub(super) energy: bool,
    /// Whether to include the tools with a tip.
    pub(super) tools: bool,
    pub(super) recipient: Arc<Recipient>,
    /// Account that is charged.
    pub(super) account: Account,
}

/// A finished record of a moment, or the work of reading it.
enum ProbeAnswer {
    Record(SharedRecord),
    Piece(Piece),
}

impl ProbeTap {
    /// Returns a record without energies, and its memory. For many points the record is empty, and the copy is
    /// returned that they are to be read from.
    fn read(&self, session: &Session, copies: &mut Copies) -> Result<(Record, Taken, Option<Arc<Copied>>)> {
        let all = session.model().len();
        let points = self.points.as_ref().map_or(all, |points| points.len());
        let tools = if self.tools { session.tool_records() } else { Vec::new() };
        let bytes = (points * size_of::<Point>() + tools.len() * size_of::<ToolRecord>()) as u64;
        let taken = self.account.take(Resource::Memory(Purpose::Records), bytes, "")?;
        if is_much(points, all) {
            let copied = copies.of(session, &self.account)?;
            return Ok((Record { tools, ..session.record(Some(&[])) }, taken, Some(copied)));
        }
        let record = memory::attempt("", || Ok(session.record(self.points.as_deref())))?;
        Ok((Record { tools, ..record }, taken, None))
    }
}

/// A stream of frames.
pub(super) struct ViewTap {
    pub(super) viewer: Arc<Viewer>,
    /// Step count at the newest frame that was posted for it.
    pub(super) shown: u64,
    /// Number of the newest frame whose time has passed.
    pub(super) passed: u64,
}

impl ViewTap {
    /// Returns the number of the frame that belongs to step `step`, if one is due there. `still_since`: nothing has
    /// moved since that step.
    pub(super) fn due(&self, step: u64, still_since: Option<u64>, rate_hz: f64) -> Option<u64> {
        let number = |step| self.viewer.frame_id(step, rate_hz);
        let is_due = step >= self.earliest(still_since, rate_hz) && number(step) != number(step.saturating_sub(1));
        is_due.then(|| number(step))
    }

    /// Counts the frames up to step `step` that were due since the last call and were not sent, because nothing had
    /// changed. `is_due`: a frame of this step is sent, so it is not counted.
    pub(super) fn pass(&mut self, step: u64, is_due: bool, rate_hz: f64) {
        let newest = self.viewer.frame_id(step, rate_hz);
        self.viewer.count_unchanged(newest.saturating_sub(self.passed + u64::from(is_due)));
        self.passed = self.passed.max(newest);
    }

    /// A still tissue is shown once, at the next frame's time, and then every second in case a viewer missed it.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn earliest(&self, still_since: Option<u64>, rate_hz: f64) -> u64 {
        match still_since {
            Some(since) if self.shown >= since => self.shown + rate_hz.ceil() as u64,
            _ => self.shown + 1,
        }
    }

    /// Returns the next step after `step` at which a frame is due, if nothing moves from now on.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    fn next_due(&self, step: u64, still_since: Option<u64>, rate_hz: f64) -> u64 {
        let from = self.earliest(still_since, rate_hz).max(step + 1);
        let number = self.viewer.frame_id(from - 1, rate_hz) + 1;
        // Rounding may be off by a step; `frame_id` decides.
        let near = (number as f64 * rate_hz / self.viewer.rate_hz) as u64;
        let exact = (near.saturating_sub(2)..near + 2).find(|step| self.viewer.frame_id(*step, rate_hz) >= number);
        exact.unwrap_or(from).max(from)
    }
}

/// All subscribers of a session.
#[derive(Default)]
pub(super) struct Subscribers {
    pub(super) samples: Vec<SampleTap>,
    pub(super) probes: Vec<ProbeTap>,
    pub(super) viewers: Vec<ViewTap>,
    pub(super) hashes: Vec<(u64, Account, HashReply)>,
}

impl Subscribers {
    /// Sends each stream of records that is due the record of this moment; streams with equal settings share one.
    /// Records of many points are read from a copy, by the thread of `reading`.
    pub(super) fn record(&self, session: &Session, copies: &mut Copies, reading: &Reading, wakes: &mut Wakes) {
        let step = session.step_count();
        // A pass over the sheet, once for all streams that include the energies.
        let mut energy = None;
        let mut told: Vec<(&ProbeTap, ProbeAnswer)> = Vec::new();
        for tap in self.probes.iter().filter(|tap| step.is_multiple_of(tap.every)) {
            let writer = tap.recipient.writer();
            let same = |told: &&mut (&ProbeTap, _)| {
                (&told.0.points, told.0.energy, told.0.tools) == (&tap.points, tap.energy, tap.tools)
            };
            match told.iter_mut().find(same) {
                Some((_, ProbeAnswer::Record(record))) => {
                    writer.push_quietly(record.clone(), wakes);
                    continue;
                }
                Some((_, ProbeAnswer::Piece(Piece::Record { to, .. }))) if !tap.recipient.is_behind() => {
                    to.push(tap.recipient.clone());
                    continue;
                }
                _ => {}
            }
            let now = now_ns();
            let has_time = tap.account.must_wait_ns(Work::Reading, now) == 0 && !tap.recipient.is_behind();
            let read = has_time.then(|| tap.read(session, copies)).and_then(Result::ok);
            let Some((mut record, taken, copied)) = read else {
                writer.skip();
                continue;
            };
            if tap.energy {
                record.energy_j = Some(*energy.get_or_insert_with(|| session.energy()));
            }
            let ended = now_ns();
            tap.account.spend(Work::Reading, ended, ended.saturating_sub(now));
            told.push(match copied {
                Some(copied) => {
                    let (points, to) = (tap.points.clone(), vec![tap.recipient.clone()]);
                    (tap, ProbeAnswer::Piece(Piece::Record { copied, points, step, record, taken, to }))
                }
                None => {
                    let record = Arc::new(Recorded { step, record, _taken: taken });
                    writer.push_quietly(record.clone(), wakes);
                    (tap, ProbeAnswer::Record(record))
                }
            });
        }
        for (tap, told) in told {
            if let ProbeAnswer::Piece(piece) = told {
                reading.post(&tap.account, piece);
            }
        }
    }

    pub(super) fn forget_the_gone(&mut self) {
        self.samples.retain(|tap| !tap.writer.is_abandoned());
        self.probes.retain(|tap| !tap.recipient.writer().is_abandoned());
        self.viewers.retain(|tap| !tap.viewer.is_gone());
        self.hashes.retain(|waiting| !waiting.2.is_closed());
    }

    /// Returns the step that a session at rest must do next because a subscriber waits for its result; `u64::MAX`
    /// if there is none. The session has done `step` steps.
    pub(super) fn next_wanted(&self, step: u64, still_since: Option<u64>, rate_hz: f64) -> u64 {
        // The first record is of the beginning of step 0.
        let record = |tap: &ProbeTap| if step == 0 { 1 } else { (step + 1).next_multiple_of(tap.every) };
        let samples = self.samples.iter().map(|tap| tap.sampler.next_due(step));
        let probes = self.probes.iter().map(record);
        let views = self.viewers.iter().map(|tap| tap.next_due(step, still_since, rate_hz));
        let hashes = self.hashes.iter().map(|waiting| waiting.0);
        samples.chain(probes).chain(views).chain(hashes).min().map_or(u64::MAX, |end| end.saturating_sub(1))
    }
}
