//! Replay of a journal: simulates its session again, from the beginning or a snapshot up to a step, and compares
//! every recorded hash on the way.

use std::collections::VecDeque;
use std::io::Cursor;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use palpate_haptics::{Instrument, Predictor};
use palpate_proto::journal as pb;

use super::inputs;
use super::message::{self, check_replays, from_hash, from_tissue};
use super::reader::{JournalBatch, JournalReader, SnapshotAt, Survey};
use crate::Session;
use crate::input::Input;
use crate::simulation::Simulation;
use crate::snapshot::{self, Saved};
use crate::tissue_copy::{TICK_POINT_SUBSTEPS, TissueCopy};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::memory;
use palpate_tissue::select::scheme_selection::given_up;

/// An entry of a journal that a replay uses, in encoded form.
#[derive(Debug, Clone)]
pub enum JournalItem {
    /// An input to the session.
    Input(pb::Input),
    /// A hash of the state to compare with.
    Hash(pb::Hash),
    /// A snapshot to compare with or to begin from.
    Snapshot(pb::Snapshot),
}

impl JournalItem {
    /// Returns the number of steps done before the entry acts or was recorded.
    pub fn step(&self) -> u64 {
        match self {
            JournalItem::Input(input) => input.step,
            JournalItem::Hash(hash) => hash.step,
            JournalItem::Snapshot(snapshot) => snapshot.step,
        }
    }
}

/// Returns the inputs, hashes and snapshots of a batch, in the order in which they were recorded: a hash or snapshot
/// after the inputs that acted before it.
///
/// # Errors
/// Refuses messages that can't be decoded, a pose without a tip, and hashes or snapshots that do not lie among the
/// inputs of the batch.
pub fn items(batch: &JournalBatch) -> Result<VecDeque<JournalItem>> {
    let hashes = batch.hashes()?.into_iter().map(|hash| (hash.after_inputs, JournalItem::Hash(hash)));
    let snapshots =
        batch.snapshots()?.into_iter().map(|snapshot| (snapshot.after_inputs, JournalItem::Snapshot(snapshot)));
    let mut compared: Vec<(u64, JournalItem)> = hashes.chain(snapshots).collect();
    compared.sort_by_key(|(after, item)| (*after, item.step()));
    let range = batch.first_input..=batch.first_input + batch.input_count;
    if compared.iter().any(|(after, _)| !range.contains(after)) {
        return Err(batch.refuse("a hash or a snapshot is not among the inputs of its batch".to_owned()));
    }
    let (mut items, mut compared) = (VecDeque::new(), compared.into_iter().peekable());
    for (number, input) in (batch.first_input..).zip(batch.inputs()?) {
        while let Some((_, item)) = compared.next_if(|(after, _)| *after <= number) {
            items.push_back(item);
        }
        items.push_back(JournalItem::Input(input));
    }
    items.extend(compared.map(|(_, item)| item));
    Ok(items)
}

/// First difference between the recorded session and the replay. Its `Display` is a sentence with the steps.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    /// The step at which the recording and the replay are first known to differ; they may differ since any step after
    /// `equal_until`.
    pub step: u64,
    /// The last step at which the two are known to be equal, by a hash or by the snapshot from which the replay
    /// began; `None` if there was neither.
    pub equal_until: Option<u64>,
    /// Description of the difference, for people.
    pub what: String,
}

/// Event of a replay, as [`Replay::advance`] gives it.
pub enum ReplayEvent<'s> {
    /// A step was done, or steps were skipped at rest: the session at the present step. Before step 1 of a session it
    /// also comes at t = 0⁺.
    Step(&'s Session),
    /// An input acts now, before the next step.
    Input(&'s pb::Input),
}

/// A journal that is being replayed, with the session at the present step. It compares each recorded hash and
/// snapshot on the way, and stops at the first difference.
pub struct Replay<'s> {
    reader: JournalReader<'s>,
    survey: Survey,
    limits: Limits,
    first: Arc<Model>,
    simulation: Simulation,
    items: VecDeque<JournalItem>,
    running: bool,
    until: Option<u64>,
    hashes: u64,
    snapshots: u64,
    equal_until: Option<u64>,
    difference: Option<Difference>,
    /// The step counts that are multiples of this are not skipped at rest.
    stops_every: u64,
}

impl<'s> Replay<'s> {
    /// Begins a replay at the beginning of a journal: at rest, or from the snapshot in its first batch. `survey` must
    /// be that of this journal; forces, reach and tool numbers are not limited by `limits` ([`message::limits`]).
    ///
    /// # Errors
    /// Refuses a journal of another generation ([`REPLAYS`](super::REPLAYS)), one whose tissue or first snapshot is
    /// invalid, one that can't be read there, and missing memory. A snapshot whose state has another hash than
    /// recorded is no error but a [`Difference`].
    pub fn new(reader: JournalReader<'s>, survey: Survey, limits: &Limits) -> Result<Self> {
        let header = reader.header();
        let begins = |at: &&SnapshotAt| at.step == header.begin_step && at.batch == 0;
        let at = survey.snapshots.iter().find(begins).copied();
        Replay::from_snapshot(reader, survey, limits, at.as_ref(), None)
    }

    /// Begins a replay at the newest snapshot that is not after `step`, or at the beginning if there is none. It does
    /// not simulate to `step`.
    ///
    /// # Errors
    /// Returns the refusals of [`Replay::new`], and refuses a step before the journal's first or after its last
    /// ([`Reason::OutOfRange`]).
    pub fn near(reader: JournalReader<'s>, survey: Survey, limits: &Limits, step: u64) -> Result<Self> {
        Replay::near_with(reader, survey, limits, step, None)
    }

    /// Begins a replay at the newest snapshot that is not after `step`. Reuses the tissue of `known` if it belongs to
    /// a journal of the same session.
    fn near_with(
        reader: JournalReader<'s>,
        survey: Survey,
        limits: &Limits,
        step: u64,
        known: Option<Known>,
    ) -> Result<Self> {
        let begin = reader.header().begin_step;
        if !(begin..=survey.until_step).contains(&step) {
            let damage = survey.and_damage();
            let message =
                format!("must be from {begin} to {}, which the journal has, but is {step}{damage}", survey.until_step);
            let refusal = Refusal::new(Reason::OutOfRange, "step", message);
            return Err(Refusal { place: Some(reader.place().to_owned()), ..refusal });
        }
        let before = survey.snapshots.partition_point(|at| at.step <= step);
        let at = before.checked_sub(1).map(|index| survey.snapshots[index]);
        Replay::from_snapshot(reader, survey, limits, at.as_ref(), known)
    }

    fn from_snapshot(
        mut reader: JournalReader<'s>,
        survey: Survey,
        given: &Limits,
        at: Option<&SnapshotAt>,
        known: Option<Known>,
    ) -> Result<Self> {
        let limits = message::limits(given);
        let place = reader.place().to_owned();
        let placed = |refusal: Refusal| Refusal { place: Some(place.clone()), ..refusal };
        check_replays(reader.header()).map_err(placed)?;
        let known = known.filter(|(header, _)| is_same_tissue(header, reader.header()));
        let first =
            known.map_or_else(|| message::model(reader.header(), &limits).map_err(placed), |known| Ok(known.1))?;
        reader.keep(2 * first.session_bytes()).map_err(placed)?;
        let mut items = VecDeque::new();
        let begin_step = reader.header().begin_step;
        let (mut running, mut until) = (reader.header().running, reader.header().until_step);
        let mut begins_with = None;
        let session = match at {
            None => {
                let mut session = Session::new(&first);
                session.skip_to(begin_step);
                reader.rewind();
                session
            }
            Some(at) => {
                let (batch, snapshot, after) = snapshot(&mut reader, at)?;
                items = after;
                (running, until) = (snapshot.running, snapshot.until_step);
                reader.pay_beside(snapshot::memory_of(&snapshot.saved)).map_err(|refusal| batch.placed(refusal))?;
                let session = restored(&snapshot, &first, &limits).map_err(|refusal| batch.placed(refusal))?;
                begins_with = Some(snapshot.hash);
                session
            }
        };
        let equal_until = Some(session.step_count()).filter(|_| at.is_some());
        let simulation = Simulation::of(session, &first.scene, &limits);
        let mut replay = Replay {
            reader,
            survey,
            limits,
            first,
            simulation,
            items,
            running,
            until,
            hashes: 0,
            snapshots: u64::from(at.is_some()),
            equal_until,
            difference: None,
            stops_every: u64::MAX,
        };
        if let Some(hash) = begins_with {
            replay.compare(&hash, "snapshot")?;
        }
        Ok(replay)
    }

    /// Returns this replay with events at all steps that are multiples of `every`, even where the tissue rests and
    /// steps are skipped. 0 counts as 1.
    #[must_use]
    pub fn stopping_every(self, every: u64) -> Self {
        Replay { stops_every: every.max(1), ..self }
    }

    /// Returns the session at the present step.
    pub fn session(&self) -> &Session {
        &self.simulation.session
    }

    /// Returns the tissue with which the session began, in its first run.
    pub fn first(&self) -> &Arc<Model> {
        &self.first
    }

    /// Returns the header of the journal.
    pub fn header(&self) -> &pb::Header {
        self.reader.header()
    }

    /// Returns the survey of the journal that the replay was given.
    pub fn survey(&self) -> &Survey {
        &self.survey
    }

    /// Returns whether time advances in the recorded session at the present step, and the step count at which it
    /// pauses, if any. A stopped session does not advance.
    pub fn running(&self) -> (bool, Option<u64>) {
        let reached = self.until.is_some_and(|until| self.session().step_count() >= until);
        (self.running && !reached && self.session().hold_reason().is_none(), self.until)
    }

    /// Returns the number of hashes and the number of snapshots that were compared so far; the snapshot from which
    /// the replay began counts.
    pub fn compared(&self) -> [u64; 2] {
        [self.hashes, self.snapshots]
    }

    /// Returns the first difference between recording and replay, at which the replay has stopped; `None` if there is
    /// none so far.
    pub fn difference(&self) -> Option<&Difference> {
        self.difference.as_ref()
    }

    /// Simulates until `until` steps are done, or to the end of the journal if that is earlier. The inputs that act
    /// at the last step have not acted then. It ends early, without an error, at a difference
    /// ([`Replay::difference`]). Calls `see` with each event; an error of `see` ends the call.
    ///
    /// # Errors
    /// - The refusals of [`JournalReader::next_batch`] and [`items`]: the journal can't be read or decoded, or is
    ///   damaged.
    /// - An input acts before the present step, or a session would not accept it.
    /// - [`Reason::TooLarge`]: a step would compute more than `limits.point_substeps_per_step`.
    /// - The errors of `see`.
    pub fn advance(&mut self, until: u64, see: &mut dyn FnMut(ReplayEvent<'_>) -> Result<()>) -> Result<()> {
        let until = until.min(self.survey.until_step);
        while self.difference.is_none() {
            self.fill()?;
            let next = self.items.front().map(|item| (item.step(), matches!(item, JournalItem::Input(_))));
            let Some((step, is_input)) = next else { break };
            if step > until || (step == until && is_input) {
                break;
            }
            if step < self.session().step_count() {
                let text = format!("an input acts at step {step}, but {} steps are done", self.session().step_count());
                return Err(self.reader.refuse(&text));
            }
            self.run_to(step, see)?;
            if self.difference.is_none()
                && let Some(item) = self.items.pop_front()
            {
                self.take(&item, see)?;
            }
        }
        self.run_to(until, see)
    }

    /// Reads the next batch with any items, if all earlier ones are used.
    fn fill(&mut self) -> Result<()> {
        while self.items.is_empty() {
            let Some(batch) = self.reader.next_batch()? else { break };
            self.items = items(&batch)?;
        }
        Ok(())
    }

    fn run_to(&mut self, target: u64, see: &mut dyn FnMut(ReplayEvent<'_>) -> Result<()>) -> Result<()> {
        while self.difference.is_none() && self.session().step_count() < target {
            let step = self.session().step_count();
            self.simulation.take_inputs(0)?;
            if let Some(reason) = self.session().hold_reason() {
                let what = format!("the session is held here, but continued when it was recorded: {reason}");
                self.differ(step, what);
                break;
            }
            self.check_work()?;
            let Simulation { session, due, .. } = &mut self.simulation;
            let rests = session.rests_until().filter(|until| due.is_empty() && *until > step);
            if let Some(rests) = rests {
                let stop = (step + 1).checked_next_multiple_of(self.stops_every).unwrap_or(u64::MAX);
                session.skip_to(target.min(rests).min(stop));
                see(ReplayEvent::Step(session))?;
                continue;
            }
            let mut seen = Ok(());
            session.advance(due, |session| {
                if seen.is_ok() {
                    seen = see(ReplayEvent::Step(session));
                }
            });
            seen?;
        }
        Ok(())
    }

    /// Refuses steps with more work than a server would do, because the journal may come from an untrusted party.
    fn check_work(&self) -> Result<()> {
        let (model, most) = (self.session().model(), self.limits.point_substeps_per_step);
        let (points, substeps) = (model.swept_points(), model.plan.substeps);
        if (points as u64).saturating_mul(u64::from(substeps)) <= most {
            return Ok(());
        }
        let message = format!(
            "a step would compute {points} points {substeps} times, above the limit of {most} in all \
             (limits.point_substeps_per_step)"
        );
        Err(Refusal { reason: Reason::TooLarge, ..self.reader.refuse(&message) })
    }

    fn differ(&mut self, step: u64, what: String) {
        self.difference.get_or_insert(Difference { step, equal_until: self.equal_until, what });
    }

    fn take(&mut self, item: &JournalItem, see: &mut dyn FnMut(ReplayEvent<'_>) -> Result<()>) -> Result<()> {
        match item {
            JournalItem::Input(input) => {
                see(ReplayEvent::Input(input))?;
                let acted = self.act(input);
                return acted.map_err(|refusal| {
                    let field = if refusal.field.is_empty() { String::new() } else { format!("{}: ", refusal.field) };
                    self.reader.refuse(&format!("the input at step {}: {field}{}", input.step, refusal.message))
                });
            }
            JournalItem::Hash(hash) => {
                self.hashes += 1;
                self.compare(&hash.hash, "state")?;
            }
            JournalItem::Snapshot(snapshot) => {
                self.snapshots += 1;
                self.compare(&snapshot.hash, "state")?;
                if self.difference.is_none() {
                    self.reader.pay_beside(snapshot::memory_of(&snapshot.saved))?;
                    let restored = restored(snapshot, &self.first, &self.limits);
                    let restored = restored.map_err(|refusal| self.reader.refuse(&refusal.to_string()))?;
                    self.compare(&message::hash(restored.tissue().state_hash()), "snapshot")?;
                }
            }
        }
        if self.difference.is_none() {
            self.equal_until = Some(item.step());
        }
        Ok(())
    }

    fn compare(&mut self, recorded: &str, what: &str) -> Result<()> {
        let computed = self.session().tissue().state_hash();
        if from_hash(recorded)? != computed {
            let step = self.session().step_count();
            self.differ(step, format!("the recorded hash of the {what} is {recorded}, but here it is {computed:032x}"));
        }
        Ok(())
    }

    fn act(&mut self, input: &pb::Input) -> Result<()> {
        use pb::input::What;
        match input.what.as_ref() {
            Some(What::Start(start)) => (self.running, self.until) = (true, start.until_step),
            Some(What::Pause(_)) => self.running = false,
            Some(What::Revive(_)) if self.session().hold_reason().is_none() => {
                let what = "the session was held when it was recorded, but is not held here";
                self.differ(self.session().step_count(), what.to_owned());
                return Ok(());
            }
            Some(What::Revive(_)) => (self.running, self.until) = (false, None),
            _ => {}
        }
        let rules = self.simulation.intake.rules();
        if let Some(input) = inputs::input(input, &rules, &self.first, &self.limits)? {
            self.simulation.apply(input);
        }
        Ok(())
    }

    /// Continues to `step`, before the inputs that act there. Returns the session there, the tissue with which it
    /// began, and the reader, which is after the batches that were needed. At the end of the journal it stops at that
    /// step. Setting `stop` ends the call before the next event.
    ///
    /// # Errors
    /// Returns the errors of [`Replay::advance`], and refuses if a hash differs or `stop` is set.
    pub fn reach(mut self, step: u64, stop: &AtomicBool) -> Result<(Session, Arc<Model>, JournalReader<'s>)> {
        self.advance(step, &mut |_| if stop.load(Ordering::Relaxed) { Err(given_up()) } else { Ok(()) })?;
        match self.difference {
            Some(difference) => Err(self.reader.refuse(&difference.to_string())),
            None => {
                self.reader.let_go(2 * self.first.session_bytes());
                Ok((self.simulation.session, self.first, self.reader))
            }
        }
    }

    /// Continues to the end of the journal, or to the first difference. Returns the result of the comparison. Calls
    /// `progress` with the number of steps done and the last step, at steps that are multiples of 1024 and not
    /// skipped.
    ///
    /// # Errors
    /// Returns the errors of [`Replay::advance`]. A difference is not an error but part of the verdict.
    pub fn verify(mut self, progress: &mut dyn FnMut(u64, u64)) -> Result<Verdict> {
        let (begin, end) = (self.reader.header().begin_step, self.survey.until_step);
        self.advance(u64::MAX, &mut |seen| {
            if let ReplayEvent::Step(session) = seen
                && session.step_count().is_multiple_of(1024)
            {
                progress(session.step_count(), end);
            }
            Ok(())
        })?;
        let proved_until = self.equal_until.unwrap_or(begin).max(begin);
        Ok(Verdict { steps: [begin, end], proved_until, compared: self.compared(), difference: self.difference })
    }

    /// Continues to the end of the journal, for a server that continues the session. Commands for the step after the
    /// end have no effect, because their leases have ended; other inputs for that step act.
    ///
    /// # Errors
    /// Returns the errors of [`Replay::advance`], and refuses if a hash differs or a waiting change is invalid.
    pub fn resume(mut self) -> Result<Resumed> {
        let see: &mut dyn FnMut(ReplayEvent<'_>) -> Result<()> = &mut |_| Ok(());
        self.advance(u64::MAX, see)?;
        loop {
            self.fill()?;
            let Some(item) = self.items.pop_front() else { break };
            let is_command =
                matches!(&item, JournalItem::Input(pb::Input { what: Some(pb::input::What::Command(_)), .. }));
            if !is_command && item.step() == self.session().step_count() && self.difference.is_none() {
                self.take(&item, see)?;
            }
        }
        if let Some(difference) = self.difference {
            return Err(self.reader.refuse(&difference.to_string()));
        }
        let (running, until_step) = self.running();
        let waiting = self.waiting()?;
        Ok(Resumed {
            header: self.reader.header().clone(),
            first: self.first,
            session: self.simulation.session,
            pending: self.simulation.changes.pop_back().map(|change| change.1),
            waiting,
            running,
            until_step,
            survey: self.survey,
        })
    }

    /// Returns the changes of the tissue that wait for a step after this one; none if the session is held.
    fn waiting(&self) -> Result<Vec<(u64, Input)>> {
        let next = self.session().step_count() + u64::from(!self.simulation.changes.is_empty());
        let is_held = self.session().hold_reason().is_some();
        let left = self.survey.waiting.iter().filter(|input| !is_held && input.step >= next);
        let mut waiting = Vec::new();
        for input in left.take(self.limits.queued_changes) {
            let Some(pb::input::What::Tissue(tissue)) = &input.what else { continue };
            let model = from_tissue(tissue, &self.first, &self.limits)
                .map_err(|refusal| self.reader.refuse(&format!("what waits for step {}: {refusal}", input.step)))?;
            waiting.push((input.step, Input::Tissue(model)));
        }
        waiting.sort_by_key(|(step, _)| *step);
        Ok(waiting)
    }
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Difference { step, equal_until, what } = self;
        write!(f, "differs at step {step}: {what}")?;
        match equal_until {
            Some(equal) => write!(f, "; at step {equal} they were equal"),
            None => Ok(()),
        }
    }
}

/// Reads a snapshot. Returns its batch, the snapshot, and the items that follow it in the batch.
fn snapshot(
    reader: &mut JournalReader<'_>,
    at: &SnapshotAt,
) -> Result<(JournalBatch, pb::Snapshot, VecDeque<JournalItem>)> {
    reader.go_to(at);
    let Some(batch) = reader.next_batch()? else {
        return Err(reader.refuse("the batch of a snapshot is missing"));
    };
    let mut items = items(&batch)?;
    loop {
        match items.pop_front() {
            Some(JournalItem::Snapshot(snapshot)) if snapshot.step == at.step => return Ok((batch, snapshot, items)),
            Some(_) => {}
            None => return Err(batch.refuse("a snapshot is missing".to_owned())),
        }
    }
}

/// Returns the saved session in a snapshot, and its tissue.
fn saved(snapshot: &pb::Snapshot, first: &Arc<Model>, limits: &Limits) -> Result<(Saved, Arc<Model>)> {
    let saved = Saved::from_bytes(&snapshot.saved, limits)?;
    if saved.step() != snapshot.step {
        let message = format!("is of step {}, but should be of step {}", saved.step(), snapshot.step);
        return Err(Refusal::new(Reason::Unreadable, "snapshot", message));
    }
    // Most sessions have the tissue with which they began.
    let scene = message::scene_of(&first.scene, &snapshot.tissue.clone().unwrap_or_default())?;
    let is_first = *saved.tissue() == first.saved_plan() && scene.added_lumps == first.scene.added_lumps;
    let model = if is_first { first.clone() } else { Model::resumed(&scene, saved.tissue(), limits)? };
    Ok((saved, model))
}

/// Returns the session in a snapshot.
fn restored(snapshot: &pb::Snapshot, first: &Arc<Model>, limits: &Limits) -> Result<Session> {
    let (saved, model) = saved(snapshot, first, limits)?;
    Session::restore(&model, &saved)
}

/// A session at the end of its journal, ready to be continued, as [`resume`] returns it.
pub struct Resumed {
    /// The journal's header.
    pub header: pb::Header,
    /// The tissue with which the session began; later changes are made from its scene.
    pub first: Arc<Model>,
    /// The session at the last durable step. Its tools still act: the caller releases them ([`Session::let_go`]).
    pub session: Session,
    /// The tissue from this step on, if it changes here, to be passed to [`Session::change`]; otherwise `None`.
    pub pending: Option<Arc<Model>>,
    /// Changes of the tissue that wait for a later step, each with that step, by ascending step; at most
    /// `limits.queued_changes`. Empty if the session has stopped.
    pub waiting: Vec<(u64, Input)>,
    /// Whether the session's time advances at the end.
    pub running: bool,
    /// The step count at which the session pauses; `None` if it has no such end.
    pub until_step: Option<u64>,
    /// Survey of the journal.
    pub survey: Survey,
}

/// Returns the session at the end of a journal. It is simulated from the newest snapshot on, and the hashes from
/// there on are compared.
///
/// # Errors
/// Refuses a journal that can't be read or decoded, is damaged in the middle, is of another generation
/// ([`REPLAYS`](super::REPLAYS)), has inputs or a tissue beyond the limits, or gives other hashes; and missing
/// memory.
pub fn resume(reader: JournalReader<'_>, limits: &Limits) -> Result<Resumed> {
    resume_as(reader, limits, None)
}

/// Returns a copy of the tissue in an encoded journal with at least one snapshot (the last counts), at rest and cut as in the snapshot, for
/// a client's `instrument`, which may be a single tip. It can be stepped at 1 kHz. The session's steps and tools are not restored.
///
/// # Errors
/// Returns a message if the bytes are no such journal or of another generation, if the tissue has more than 100,000
/// points or is invalid, if a tip does not fit the tissue or is too large ([`TissueCopy::for_client`]), or if
/// memory is missing.
pub fn tissue_copy(bytes: &[u8], instrument: &Instrument) -> std::result::Result<TissueCopy, String> {
    #[allow(clippy::cast_possible_truncation)]
    let limits = message::limits(&Limits { points: TICK_POINT_SUBSTEPS as usize, ..Limits::default() });
    let copy = || {
        // The bytes come from a server: file names in them do not apply to this machine.
        let mut reader = JournalReader::new("the snapshot", Cursor::new(bytes))?.without_files();
        check_replays(reader.header())?;
        let survey = reader.survey(&mut |_| {})?;
        let Some(at) = survey.snapshots.last() else { return Err(reader.refuse("has no snapshot")) };
        let first = message::model(reader.header(), &limits)?;
        let (_, snapshot, _) = snapshot(&mut reader, at)?;
        let (saved, model) = saved(&snapshot, &first, &limits)?;
        let mut copy = TissueCopy::for_client(&model, instrument)?;
        copy.follow(&saved.cuts())?;
        Ok(copy)
    };
    memory::attempt("snapshot", copy).map_err(|refusal| refusal.to_string())
}

/// Returns the [`tissue_copy`] as the predictor that a bridge makes of a server's snapshot.
///
/// # Errors
/// Returns the messages of [`tissue_copy`].
pub fn prediction(bytes: &[u8], instrument: &Instrument) -> std::result::Result<Box<dyn Predictor>, String> {
    Ok(Box::new(tissue_copy(bytes, instrument)?))
}

/// A journal's header and the compiled tissue with which its session began, for reuse by [`resume_as`].
pub type Known = (pb::Header, Arc<Model>);

/// Returns the session at the end of a journal, as [`resume`] does. Reuses the tissue of `known` if it belongs to the
/// same session, scene and tissue, so that it need not be compiled again; otherwise `known` is ignored.
///
/// # Errors
/// Returns the refusals of [`resume`].
pub fn resume_as(mut reader: JournalReader<'_>, limits: &Limits, known: Option<Known>) -> Result<Resumed> {
    let survey = reader.survey(&mut |_| {})?;
    let until = survey.until_step;
    Replay::near_with(reader, survey, limits, until, known)?.resume()
}

fn is_same_tissue(a: &pb::Header, b: &pb::Header) -> bool {
    a.session_id == b.session_id && a.scene == b.scene && a.mesh == b.mesh && a.tissue == b.tissue
}

/// Returns the session after `step` steps, before the inputs that act there, and the tissue with which it began. It
/// is simulated from the newest snapshot before, and hashes are compared. Setting `stop` ends the call.
///
/// # Errors
/// Refuses a step that the journal does not contain ([`Reason::OutOfRange`]), a set `stop`, and what [`resume`]
/// refuses.
pub fn session_at(
    mut reader: JournalReader<'_>,
    limits: &Limits,
    step: u64,
    stop: &AtomicBool,
) -> Result<(Session, Arc<Model>)> {
    let survey = reader.survey(&mut |_| {})?;
    let (session, first, _) = Replay::near(reader, survey, limits, step)?.reach(step, stop)?;
    Ok((session, first))
}

/// Result of a verification ([`verify`], [`Replay::verify`]).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Verdict {
    /// Step counts at the beginning and at the end of the journal.
    pub steps: [u64; 2],
    /// The last step whose recorded hash was equal; nothing is known of the steps after it. The beginning if no hash
    /// was compared.
    pub proved_until: u64,
    /// Number of hashes and number of snapshots that were compared, in this order.
    pub compared: [u64; 2],
    /// The first difference; `None` if there is none.
    pub difference: Option<Difference>,
}

/// Simulates a whole journal, and compares every hash and every snapshot. Returns the result. Calls `progress` with
/// the number of steps done and the last step, every 1024 steps.
///
/// A journal is recorded while a session runs. Then it is simulated again, and both hashes are the same:
///
/// ```
/// use std::io::Cursor;
///
/// use palpate_session::Session;
/// use palpate_session::command::{Command, Due};
/// use palpate_session::input::Input;
/// use palpate_session::journal::{JournalReader, JournalWriter, Opening, pb, verify};
/// use palpate_tissue::Model;
/// use palpate_tissue::limits::Limits;
/// use palpate_tissue::scene::PAPER;
/// use palpate_tissue::scene::profile::Poke;
/// use palpate_tissue::scene::script::Action;
///
/// let model = Model::parse("paper", PAPER, &["sheet.points=[5, 5]"])?;
/// let opening = Opening {
///     session_id: "example",
///     run: 1,
///     owner: "",
///     idle_timeout_s: 900.0,
///     first: &model,
///     begin_step: 0,
///     running: true,
///     until_step: None,
///     ownership_revision: 0,
///     exercise: None,
/// };
/// // Times are in nanoseconds since 1970; a step is a millisecond.
/// let mut writer = JournalWriter::new(&opening, 0);
/// let mut session = Session::new(&model);
/// writer.snapshot(0, session.tissue().state_hash(), &model, session.save().to_bytes());
/// // 0.1 N down on the middle, from the first step on.
/// let centre_m = model.shape().extent().middle_m();
/// let force_n = glam::DVec3::new(0.0, 0.0, -0.1);
/// let poke = Poke { point: None, centre_m, force_n, falloff_per_m: 100.0, falloff_offset: 0.0 };
/// let mut due = vec![Due::in_time(Command::new(0, Some(1), Action::Push(poke)))];
/// writer.input(0, &Input::Command(due[0].clone()));
/// for _ in 0..100 {
///     session.advance(&mut due, |_| {});
/// }
/// writer.hash(100, session.tissue().state_hash());
/// let journal = writer.finish(pb::Why::Drained, "the example ended", 100, 100_000_000);
///
/// let reader = JournalReader::new("example.mcap", Cursor::new(journal))?;
/// let verdict = verify(reader, &Limits::default(), &mut |_, _| {})?;
/// assert_eq!((verdict.steps, verdict.proved_until), ([0, 100], 100));
/// assert_eq!(verdict.difference, None);
/// # Ok::<(), palpate_refusal::Refusal>(())
/// ```
///
/// # Errors
/// Refuses a journal that can't be read or decoded, is damaged in the middle, is of another generation, or has a
/// tissue, snapshot or input beyond the limits; and missing memory. A difference is not an error.
pub fn verify(mut reader: JournalReader<'_>, limits: &Limits, progress: &mut dyn FnMut(u64, u64)) -> Result<Verdict> {
    let survey = reader.survey(&mut |_| {})?;
    Replay::new(reader, survey, limits)?.verify(progress)
}
