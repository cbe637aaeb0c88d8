//! What a session needs now and then: a picture, its hash, a log of a recovery, and to go on after it was held.

use std::sync::Arc;

use super::super::reading::{Copied, Piece, is_much};
use super::super::taps::HashReply;
use super::{Encoder, Hashed, Job, Reading, Running, Viewer, lock, now_ns};
use crate::budget::{Account, Work};
use crate::memory;
use crate::refusal::{Reason, Refusal, Result};
use crate::session::Session;
use crate::session::recovery::describe;
use crate::sheet::Hashing;
use crate::surface::Snapshot;

/// What a hash is told from.
enum Found {
    Hash(u64, u128),
    Copy(Arc<Copied>),
}

impl Running {
    /// Has the present state shown to `viewers`. Without memory for it their streams end.
    ///
    /// The displacements are copied in one go: they are half of what a substep reads and half of what it writes. All
    /// else is done by the encoder.
    pub(super) fn post(&self, encoder: &Encoder, viewers: Vec<(Arc<Viewer>, u64)>) {
        let model = &self.live.model;
        let copied = memory::attempt("", || {
            let mut displacement_m = std::array::from_fn(|_| memory::with_room(model.len(), "a picture of the sheet"));
            self.session.tissue().displacements_m(&mut displacement_m);
            Ok(displacement_m)
        });
        let displacement_m = match copied {
            Ok(displacement_m) => displacement_m,
            Err(refusal) => return viewers.iter().for_each(|(viewer, _)| viewer.close(refusal.clone())),
        };
        let snapshot = Snapshot::new(self.session.step_count(), self.session.time_s(), model.points, displacement_m);
        let (snapshot, spacing_m) = (Arc::new(snapshot), model.scene.sheet.spacing_m);
        let (overrun_count, time_dilation) = (self.overrun_count, self.dilation.value);
        encoder.post(self.live.number, Job { snapshot, spacing_m, viewers, overrun_count, time_dilation });
    }

    /// Answers with the step and the state's hash; whoever has used up their part of the time is refused. Of a large
    /// sheet the hash is computed by the thread of `reading`, from a copy.
    pub(super) fn hash_for(&mut self, account: &Account, reply: HashReply, reading: &Reading) {
        let begun_ns = now_ns();
        match self.hash_now(account, begun_ns) {
            Ok(Found::Hash(step, hash)) => _ = reply.send(Ok((step, hash))),
            Ok(Found::Copy(copied)) => {
                let (step, hashed) = (self.session.step_count(), self.hashed.clone());
                reading.post(account, Piece::Hash { copied, hashing: Hashing::default(), step, hashed, reply });
            }
            Err(refusal) => _ = reply.send(Err(refusal)),
        }
        let ended_ns = now_ns();
        account.spend(Work::Reading, ended_ns, ended_ns.saturating_sub(begun_ns));
    }

    /// The hash, which is computed once a step, or the copy to compute it from.
    fn hash_now(&mut self, account: &Account, now_ns: u64) -> Result<Found> {
        let step = self.session.step_count();
        if let Some((_, hash)) = lock(&self.hashed).filter(|hashed| hashed.0 == step) {
            return Ok(Found::Hash(step, hash));
        }
        if account.must_wait_ns(Work::Reading, now_ns) > 0 {
            let message =
                "what this caller has read of late took more than its part of the time of the stepping threads";
            return Err(Refusal::new(Reason::Overloaded, "", message));
        }
        let points = self.session.model().len();
        if is_much(points, points) {
            return self.copies.of(&self.session, account).map(Found::Copy);
        }
        let hash = self.session.tissue().state_hash();
        *lock(&self.hashed) = Some((step, hash));
        Ok(Found::Hash(step, hash))
    }

    /// Logs the recovery in the step that was just done, if there was one.
    pub(super) fn log_recovery(&self) {
        let step = self.session.step_count();
        if let Some(newest) = self.session.recoveries().newest().filter(|newest| newest.recovery.step == step) {
            tracing::warn!(session = %self.live.id, "tissue recovered: {}", describe(&newest.recovery));
        }
    }

    /// The same tissue at rest, at the same step; time stands.
    pub(super) fn revive(&mut self) -> Result<u64> {
        if self.session.hold_reason().is_none() {
            return Err(Refusal::new(Reason::OutOfTurn, "session_id", "is a session that is not held"));
        }
        let step = self.session.step_count();
        let mut session = memory::attempt("session_id", || Ok(Session::new(self.session.model())))?;
        session.skip_to(step);
        (self.session, self.hashed, self.audit) = (session, Hashed::default(), None);
        self.copies.forget();
        (self.running, self.until, self.still_since) = (false, None, Some(step));
        lock(&self.live.intake).reopen();
        lock(&self.live.status).forget_hold();
        tracing::info!(session = %self.live.id, step, "session revived");
        Ok(step)
    }
}
