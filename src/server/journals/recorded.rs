//! What the journals of a server hold, for calls: which there are, what is in one, and sessions that begin at a moment of one.

use std::io::Cursor;
use std::path::Path;
use std::sync::Arc;
use std::time::UNIX_EPOCH;

use palpate_proto::pb;

use super::Journals;
use super::keeper::unix_ns;
use super::player::read_ahead;
use crate::budget::Account;
use crate::ids::random_id;
use crate::journal::file::{self, JournalFile};
use crate::journal::inputs::Inputs;
use crate::journal::{Opening, Reader, Writer, pb as kept, replay, seal};
use crate::limits::Limits;
use crate::pace::feed::{Feed, Playback};
use crate::pace::{Begin, Live, Pacer, Present};
use crate::refusal::{Reason, Refusal, Result, number};
use crate::sheet::choice::NEVER;

/// Moments of a curve of forces.
const MOST_MOMENTS: usize = 2000;

/// The journal of a run of a session; of its newest if `run` is 0.
fn find(folder: &Path, session_id: &str, run: u32) -> Result<JournalFile> {
    let unknown = |message: &str| Refusal::new(Reason::UnknownSession, "session_id", message.to_owned());
    // A name that is none would be a path.
    if file::parse(&file::name(session_id, 1)).is_none() {
        return Err(unknown("is no ID of a session"));
    }
    let listed = file::list(folder).map_err(|error| {
        Refusal::new(Reason::Unreadable, "journal", format!("the folder of the journals can't be read: {error}"))
    })?;
    let is_it = |file: &JournalFile| file.session_id == session_id && (run == 0 || file.run == u64::from(run));
    // The newest run may have been cut off before anything of it was on the disk.
    let is_begun = |file: &JournalFile| {
        run != 0 || !Reader::open(&file.path).is_err_and(|refusal| refusal.reason == Reason::Missing)
    };
    listed
        .into_iter()
        .rev()
        .filter(is_it)
        .find(is_begun)
        .ok_or_else(|| unknown("there is no journal of this session and run; ListJournals tells which there are"))
}

fn info(file: &JournalFile, pacer: &Pacer) -> pb::JournalInfo {
    let metadata = std::fs::metadata(&file.path).ok();
    let written = metadata.as_ref().and_then(|metadata| metadata.modified().ok()?.duration_since(UNIX_EPOCH).ok());
    let run = u32::try_from(file.run).unwrap_or(u32::MAX);
    let known = pb::JournalInfo {
        session_id: file.session_id.clone(),
        run,
        end_unix_ns: written.map_or(0, |since| u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)),
        bytes: metadata.map_or(0, |metadata| metadata.len()),
        live: pacer.is_recording(&file.session_id, run),
        ..Default::default()
    };
    let begun = Reader::open(&file.path).and_then(|mut reader| {
        let begin_unix_ns = reader.next_batch()?.map_or(0, |batch| batch.unix_ns);
        let header = reader.header();
        let scene_name = header.scene.as_ref().map(|scene| scene.name.clone()).unwrap_or_default();
        Ok(pb::JournalInfo { scene_name, owner: header.owner.clone(), begin_unix_ns, ..known.clone() })
    });
    begun.unwrap_or_else(|refusal| pb::JournalInfo { fault: refusal.to_string(), ..known })
}

impl Journals {
    /// All journals, by session and run.
    ///
    /// # Errors
    /// Refuses if the folder can't be read.
    pub(in crate::server) fn list(&self, pacer: &Pacer) -> Result<pb::ListJournalsResponse> {
        let listed = file::list(self.folder.path()).map_err(|error| {
            Refusal::new(Reason::Unreadable, "journal", format!("the folder of the journals can't be read: {error}"))
        })?;
        Ok(pb::ListJournalsResponse { journals: listed.iter().map(|file| info(file, pacer)).collect() })
    }

    /// What is in a journal: a pass over it.
    ///
    /// # Errors
    /// Refuses a journal that is not there, or can't be read.
    pub(in crate::server) fn told(
        &self,
        request: &pb::GetJournalRequest,
        pacer: &Pacer,
    ) -> Result<pb::GetJournalResponse> {
        let file = find(self.folder.path(), &request.session_id, request.run)?;
        let mut reader = Reader::open(&file.path)?;
        let survey = reader.survey(&mut |_| {})?;
        let mut forces = Forces::default();
        while let Some(batch) = reader.next_batch()? {
            for moment in batch.felt()? {
                let of = |tool: &kept::FeltTool| {
                    let kept::Vector { x, y, z } = tool.force_n.unwrap_or_default();
                    glam::Vec3::new(x, y, z).length()
                };
                forces.add(moment.step, f64::from(moment.tools.iter().map(of).fold(0.0, f32::max)));
            }
        }
        Ok(pb::GetJournalResponse {
            info: Some(info(&file, pacer)),
            rate_hz: reader.header().rate_hz,
            begin_step: reader.header().begin_step,
            end_step: survey.until_step,
            forces: forces.moments,
            snapshot_steps: survey.snapshots.iter().map(|at| at.step).collect(),
        })
    }

    /// A session that begins at a moment of a journal, and goes on live or plays what was recorded.
    ///
    /// # Errors
    /// Refuses a journal that is not there, can't be read or simulated again here, a step that it does not have, a speed out of
    /// range, and as [`Pacer::create`] does.
    pub(in crate::server) fn begin(
        &self,
        moment: &pb::JournalMoment,
        (paused, idle_timeout_s): (bool, f64),
        payer: &Account,
        pacer: &Pacer,
        limits: &Limits,
    ) -> Result<Arc<Live>> {
        let speed = moment.speed.unwrap_or(1.0);
        number("journal.speed", speed, "from 0.1 to 8", |speed| (0.1..=8.0).contains(&speed))?;
        let file = find(self.folder.path(), &moment.session_id, moment.run)?;
        let mut reader = Reader::open(&file.path)?;
        let survey = reader.survey(&mut |_| {})?;
        let step = moment.step.unwrap_or(survey.until_step);
        let steps = [reader.header().begin_step, survey.until_step];
        let (mut session, first) =
            replay::session_at(Reader::open(&file.path)?, limits, step).map_err(|refusal| refusal.within("journal"))?;
        let mut begin = Begin {
            id: random_id()?,
            first: first.clone(),
            running: !paused,
            until: None,
            idle_timeout_s,
            overrun_count: 0,
            playback: None,
        };
        if !moment.plays {
            return pacer.resume(
                begin,
                payer,
                || {
                    session.let_go();
                    Ok(session)
                },
                &NEVER,
            );
        }
        let feed = Arc::new(Feed::default());
        let mut inputs = Inputs::new(reader, &survey, &first, limits, step);
        read_ahead(&feed, &mut inputs, step)?;
        let (session_id, run) = (file.session_id, file.run);
        begin.playback = Some(Playback { session_id, run, steps, speed, feed: feed.clone() });
        let live = pacer.resume(begin, payer, || Ok(session), &NEVER)?;
        self.player.play(&live, &feed, inputs);
        Ok(live)
    }
}

/// A curve of forces with at most [`MOST_MOMENTS`] moments, the largest of each while.
#[derive(Default)]
struct Forces {
    moments: Vec<pb::ForceMoment>,
    /// Moments that are one in the curve, as a power of 2; and how many of the newest are in already.
    halvings: u32,
    in_newest: u32,
}

impl Forces {
    fn add(&mut self, step: u64, force_n: f64) {
        if self.in_newest == 0 {
            self.moments.push(pb::ForceMoment { step, force_n });
        } else if let Some(newest) = self.moments.last_mut() {
            *newest = pb::ForceMoment { step, force_n: newest.force_n.max(force_n) };
        }
        self.in_newest = (self.in_newest + 1) % (1 << self.halvings);
        if self.moments.len() == MOST_MOMENTS && self.in_newest == 0 {
            let pair = |pair: &[pb::ForceMoment]| {
                let force_n = pair.iter().map(|moment| moment.force_n).fold(0.0, f64::max);
                pb::ForceMoment { step: pair[pair.len() - 1].step, force_n }
            };
            self.moments = self.moments.chunks(2).map(pair).collect();
            self.halvings += 1;
        }
    }
}

/// A journal of one moment: of a session of `live` as it stood.
pub(in crate::server) fn snapshot(live: &Live, present: &Present) -> Result<Vec<u8>> {
    let Present { saved, copy, running, until_step } = present;
    let step = saved.step();
    let opening = Opening {
        session_id: &live.id,
        run: 1,
        owner: live.owner.name(),
        idle_timeout_s: live.idle_timeout_s,
        first: &live.model,
        begin_step: step,
        running: *running,
        until_step: *until_step,
    };
    let now = unix_ns();
    let mut writer = Writer::new(&opening, now);
    writer.snapshot(step, copy.state_hash(), copy.model(), saved.to_bytes());
    let mut file = Cursor::new(writer.finish(kept::Why::Cut, "a snapshot", step, now));
    seal::seal(&mut file).map_err(|error| Refusal::new(Reason::Overloaded, "", error.to_string()))?;
    Ok(file.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_curve_keeps_its_peaks_and_its_end_however_long_it_is() {
        for count in [0, 1, 1999, 2000, 2001, 5000, 100_003_u64] {
            let mut forces = Forces::default();
            for step in 0..count {
                forces.add(step, if step == count / 3 { 7.0 } else { 1.0 });
            }
            assert!(forces.moments.len() <= MOST_MOMENTS);
            assert!(forces.moments.is_sorted_by_key(|moment| moment.step));
            if count > 0 {
                assert_eq!(forces.moments.last().unwrap().step, count - 1);
                assert_eq!(forces.moments.iter().filter(|moment| moment.force_n == 7.0).count(), 1, "{count}");
            }
        }
    }
}
