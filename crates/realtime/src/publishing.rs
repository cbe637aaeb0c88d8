//! What a session publishes after a step: samples, frames, hashes, its status, and marks for the auditor.

use std::sync::Arc;
use std::sync::mpsc::SyncSender;

use super::clock::now_ns;
use super::frames::{Encoder, Job, Viewer};
use super::queue::Wakes;
use super::reading::{Copied, HashReply, Piece, Reading, is_much};
use super::session_task::{SessionTask, ThreadContext};
use super::status::RunState;
use super::subscribers::{SampleTap, ViewTap};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::Sample;
use palpate_session::budget::{Account, Work};
use palpate_session::local_model::StiffnessJob;
use palpate_session::recovery::describe;
use palpate_session::sample_selection::PacedSample;
use palpate_session::surface::{MESH_ROW, Snapshot};
use palpate_tissue::Hashing;
use palpate_tissue::lock::lock;
use palpate_tissue::memory;
use palpate_tissue::select::audit::Mark;

/// The hash of a state, or the copy to compute it from.
enum HashSource {
    Hash(u64, u128),
    Copy(Arc<Copied>),
}

/// Number of steps between two lists of threads and clips in the status: where they are is a sum over the points of each bite.
pub(super) const TIES_EVERY: u64 = 32;

impl SessionTask {
    /// Sends the auditor the mark of a window's beginning or end, without waiting: the channel has room for both.
    pub(super) fn tell_auditor(&mut self) {
        let Some(auditor) = &self.audit else { return };
        let ended = self.session.hold_reason().is_some();
        let Some(mark) = self.session.take_mark().or(ended.then_some(Mark::Dropped)) else { return };
        let is_last = !matches!(mark, Mark::Begin(_));
        if auditor.try_send(mark).is_err() || is_last {
            self.audit = None;
        }
    }

    /// Requests new stiffnesses under the tools that streams are sent.
    pub(super) fn refine(&self, refiner: &SyncSender<StiffnessJob>) {
        for refinement in self.subscribers.samples.iter().flat_map(|tap| tap.sampler.refinements(&self.session)) {
            // A request that finds the worker busy is dropped: the next one is newer.
            let _ = refiner.try_send(refinement);
        }
    }

    /// Sends a stream the present sample, if the stream is due one or if `last` says that no other follows for now.
    /// `all` keeps the sample of all tools for other streams, once one has needed it.
    pub(super) fn tell(&self, tap: &mut SampleTap, all: &mut Option<Sample>, last: bool, wakes: &mut Wakes) {
        let Some(sample) = tap.sampler.pick_from(&self.session, all, last || tap.once) else { return };
        let overrun = self.overrun_count > tap.overrun_count;
        tap.overrun_count = self.overrun_count;
        let SessionTask { overrun_count, due_ns, .. } = *self;
        let durable_step = self.handle.event_log.as_ref().and_then(|event_log| event_log.durable_step());
        let (time_dilation, ownership_revision) = (self.dilation.value, self.handle.revision());
        let paced =
            PacedSample { sample, due_ns, overrun_count, time_dilation, durable_step, ownership_revision, overrun };
        tap.writer.push_quietly(paced, wakes);
    }

    pub(super) fn tell_all(&mut self, last: bool, wakes: &mut Wakes) {
        let (mut subscribers, mut all) = (std::mem::take(&mut self.subscribers.samples), None);
        for tap in &mut subscribers {
            let Some(watcher) = tap.watcher.clone() else {
                self.tell(tap, &mut all, last, wakes);
                continue;
            };
            let now = now_ns();
            // The last sample for now is never left out: otherwise the stream would miss the state in which the
            // session pauses.
            if last || watcher.must_wait_ns(Work::Reading, now) == 0 {
                self.tell(tap, &mut all, last, wakes);
                let ended = now_ns();
                watcher.spend(Work::Reading, ended, ended.saturating_sub(now));
            }
        }
        subscribers.retain(|tap| !tap.once);
        self.subscribers.samples = subscribers;
    }

    /// Sends the results of this step to all subscribers that are due.
    pub(super) fn publish(&mut self, context: &mut ThreadContext<'_>) {
        let step = self.session.step_count();
        self.tell_all(!self.running, &mut context.wakes);
        self.subscribers.forget_the_gone();
        let (still_since, rate_hz) = (self.still_since, self.handle.model.scene.stepping.rate_hz);
        let held = self.session.hold_reason().is_some();
        let due_frame = |tap: &mut ViewTap| {
            let last = held.then(|| tap.viewer.frame_id(step, rate_hz));
            let due = last.or_else(|| tap.due(step, still_since, rate_hz));
            tap.pass(step, due.is_some(), rate_hz);
            let frame_id = due?;
            tap.shown = step;
            tap.viewer.has_credit().then(|| (tap.viewer.clone(), frame_id))
        };
        let viewers: Vec<_> = self.subscribers.viewers.iter_mut().filter_map(due_frame).collect();
        if !viewers.is_empty() {
            self.post(context.encoder, viewers);
        }
        for (_, account, reply) in
            self.subscribers.hashes.extract_if(.., |waiting| waiting.0 == step).collect::<Vec<_>>()
        {
            self.hash_for(&account, reply, context.reading);
        }
    }

    pub(super) fn publish_status(&self) {
        let mut status = lock(&self.handle.status);
        let (before, tally) = (&*status, &self.inbox.tally);
        let path_counts = self.session.path_counts();
        let guard_events = self.session.tissue().guard_events();
        let is_held = self.session.hold_reason().is_some();
        tally.rested_steps.add(self.rested_steps - before.rested_steps);
        tally.overruns.add(self.overrun_count - before.overrun_count);
        tally.late_commands.add(self.session.late_commands() - before.late_commands);
        tally.paused_commands.add(self.session.paused_commands() - before.paused_commands);
        tally.lapsed_leases.add(self.lapsed_leases - before.lapsed_leases);
        tally.guard_events.add(guard_events - before.guard_events);
        let recovery_count = self.session.recoveries().count();
        tally.recoveries.add(recovery_count - before.recovery_count);
        tally.held_sessions.add(u64::from(is_held && before.state != RunState::Held));
        let path_tallies = [&tally.limited_steps, &tally.dropped_poses, &tally.stale_releases];
        for (index, count) in path_tallies.into_iter().enumerate() {
            count.add(path_counts[index] - before.path_counts[index]);
        }
        status.state = match (self.session.hold_reason(), self.running) {
            (Some(_), _) => RunState::Held,
            (None, true) => RunState::Running,
            (None, false) => RunState::Paused,
        };
        let step = self.session.step_count();
        if !self.running || step / TIES_EVERY != status.step / TIES_EVERY {
            status.ties = self.session.tissue().ties();
        }
        status.step = step;
        status.model.clone_from(self.session.model());
        status.rested_steps = self.rested_steps;
        status.overrun_count = self.overrun_count;
        status.guard_events = guard_events;
        if status.recovery_count != recovery_count {
            (status.recovery_count, status.recoveries) = (recovery_count, self.session.recoveries().list());
        }
        status.cuts = self.session.tissue().cuts();
        status.burns = self.session.tissue().burns();
        status.awake_points = self.session.tissue().awake_points();
        if let Some(times) = self.session.tissue().stage_times() {
            status.stages = times.list();
        }
        status.path_counts = path_counts;
        status.lapsed_leases = self.lapsed_leases;
        status.dilation = self.dilation;
        status.schedule = self.schedule;
        status.late_commands = self.session.late_commands();
        status.paused_commands = self.session.paused_commands();
        if status.hold_reason.is_none() {
            status.hold_reason = self.session.hold_reason().map(str::to_owned);
        }
    }

    /// Posts the present state to be encoded as frames for `viewers`. If there is no memory for it, their streams
    /// end.
    ///
    /// The displacements are copied in one go: that is half of what a substep reads and half of what it writes. The
    /// encoder does everything else.
    pub(super) fn post(&self, encoder: &Encoder, viewers: Vec<(Arc<Viewer>, u64)>) {
        let model = &self.handle.model;
        // A frame of a mesh has whole rows.
        let room = model.len().next_multiple_of(MESH_ROW);
        let copied = memory::attempt("", || {
            let mut displacement_m = std::array::from_fn(|_| memory::with_room(room, "a picture of the tissue"));
            self.session.tissue().shown_displacements_m(&mut displacement_m);
            Ok(displacement_m)
        });
        let displacement_m = match copied {
            Ok(displacement_m) => displacement_m,
            Err(refusal) => return viewers.iter().for_each(|(viewer, _)| viewer.close(refusal.clone())),
        };
        let snapshot = Snapshot::new(&model.scene, self.session.step_count(), self.session.time_s(), displacement_m);
        let tissue = self.session.tissue();
        let snapshot = snapshot.with_skin(self.handle.skin.as_ref()).with_cuts(tissue.cuts());
        let snapshot = Arc::new(snapshot.with_burn_version(tissue.burns().version()));
        let (overrun_count, time_dilation) = (self.overrun_count, self.dilation.value);
        encoder.post(self.handle.number, Job { snapshot, viewers, overrun_count, time_dilation });
    }

    /// Sends the step and the hash of the state to `reply`, or a refusal if the caller has used up its part of the
    /// reading time. For a large sheet the thread of `reading` computes the hash from a copy.
    pub(super) fn hash_for(&mut self, account: &Account, reply: HashReply, reading: &Reading) {
        let begun_ns = now_ns();
        match self.hash_now(account, begun_ns) {
            Ok(HashSource::Hash(step, hash)) => _ = reply.send(Ok((step, hash))),
            Ok(HashSource::Copy(copied)) => {
                let (step, hashed) = (self.session.step_count(), self.hashed.clone());
                reading.post(account, Piece::Hash { copied, hashing: Hashing::default(), step, hashed, reply });
            }
            Err(refusal) => _ = reply.send(Err(refusal)),
        }
        let ended_ns = now_ns();
        account.spend(Work::Reading, ended_ns, ended_ns.saturating_sub(begun_ns));
    }

    /// Returns the hash, which is computed once per step, or the copy to compute it from.
    fn hash_now(&mut self, account: &Account, now_ns: u64) -> Result<HashSource> {
        let step = self.session.step_count();
        if let Some((_, hash)) = lock(&self.hashed).filter(|hashed| hashed.0 == step) {
            return Ok(HashSource::Hash(step, hash));
        }
        if account.must_wait_ns(Work::Reading, now_ns) > 0 {
            let message =
                "what this caller has read recently took more than its part of the time of the stepping threads";
            return Err(Refusal::new(Reason::Overloaded, "", message));
        }
        let points = self.session.model().len();
        if is_much(points, points) {
            return self.copies.of(&self.session, account).map(HashSource::Copy);
        }
        let hash = self.session.tissue().state_hash();
        *lock(&self.hashed) = Some((step, hash));
        Ok(HashSource::Hash(step, hash))
    }

    /// Logs the recovery of the last step, if there was one.
    pub(super) fn log_recovery(&self) {
        let step = self.session.step_count();
        if let Some(newest) = self.session.recoveries().newest().filter(|newest| newest.recovery.step == step) {
            tracing::warn!(session = %self.handle.id, "tissue recovered: {}", describe(&newest.recovery));
        }
    }
}
