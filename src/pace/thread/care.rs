//! What a session needs now and then: its hash, a word on a recovery, and to go on after it was held.

use super::{Running, lock, now_ns};
use crate::budget::{Account, Work};
use crate::refusal::{Reason, Refusal, Result};
use crate::session::Session;
use crate::session::recovery::describe;

impl Running {
    /// The step and the state's hash, computed once a step; whoever has used up their part of the time is refused.
    pub(super) fn hash_for(&mut self, account: &Account) -> Result<(u64, u128)> {
        let step = self.session.step_count();
        if let Some(hashed) = self.hashed.filter(|hashed| hashed.0 == step) {
            return Ok(hashed);
        }
        let begun_ns = now_ns();
        if account.must_wait_ns(Work::Reading, begun_ns) > 0 {
            let message =
                "what this caller has read of late took more than its part of the time of the stepping threads";
            return Err(Refusal::new(Reason::Overloaded, "", message));
        }
        let hash = self.session.tissue().state_hash();
        let ended_ns = now_ns();
        account.spend(Work::Reading, ended_ns, ended_ns.saturating_sub(begun_ns));
        self.hashed = Some((step, hash));
        Ok((step, hash))
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
        let mut session = Session::new(self.session.model());
        session.skip_to(step);
        (self.session, self.hashed, self.audit) = (session, None, None);
        (self.running, self.until, self.still_since) = (false, None, Some(step));
        lock(&self.live.intake).reopen();
        lock(&self.live.status).forget_hold();
        tracing::info!(session = %self.live.id, step, "session revived");
        Ok(step)
    }
}
