//! The measuring of a session's exercise, on its stepping thread.
//!
//! It looks at the session after each step. Ten times per second of simulated time it copies the measures; the thread `records` computes
//! the figures, which may take longer than a step. A copy that is due while another one is computed is left out, except the last. The
//! result is told once it is in the event log of the session.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::inbox::{Inbox, Request};
use super::live_exercise::LiveExercise;
use super::reading::{Piece, Reading};
use palpate_refusal::Result;
use palpate_session::Session;
use palpate_session::budget::Account;
use palpate_session::measured_run::{EndedExercise, MeasuredMoment, MeasuredRun};
use palpate_tissue::scene::exercise::Exercise;

/// How often figures are told, per second of simulated time.
const TOLD_HZ: f64 = 10.0;

/// Memory of the measures of a whole exercise, or of a phase, and of a copy of them, bytes.
const MEASURES_BYTES: u64 = 8 << 20;

/// Returns the memory of the measures of an exercise, bytes.
pub(super) fn measures_bytes(exercise: &Exercise) -> u64 {
    MEASURES_BYTES * (1 + exercise.phases.len() as u64)
}

/// The measuring of a session's exercise, on its stepping thread.
pub(super) struct ExerciseTask {
    live: Arc<LiveExercise>,
    /// Whether figures are being computed.
    is_computing: Arc<AtomicBool>,
    run: MeasuredRun,
    /// Number of steps between figures.
    every: u64,
    /// The step of the newest figures that were asked for.
    asked_step: u64,
    /// Whether figures are due though no time has passed: a phase has ended.
    is_overdue: bool,
    /// Whether the result is computed or known.
    is_over: Arc<AtomicBool>,
}

/// Clears a flag when it is dropped: also when a computation is refused memory, which unwinds. Then it can be asked for again.
struct ClearsFlag(Option<Arc<AtomicBool>>);

impl ClearsFlag {
    fn keep(mut self) {
        self.0 = None;
    }
}

impl Drop for ClearsFlag {
    fn drop(&mut self) {
        self.0.iter().for_each(|flag| flag.store(false, Ordering::Release));
    }
}

impl ExerciseTask {
    /// Begins at the session's present step.
    ///
    /// # Errors
    /// Refuses an exercise that does not fit the tissue.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(super) fn new(live: &Arc<LiveExercise>, session: &Session) -> Result<Self> {
        let (model, begin_step, chosen) = (session.model(), session.step_count(), &live.chosen);
        let mut run = MeasuredRun::new(model, begin_step, chosen.thresholds(), None, Some(chosen))?;
        run.see(session);
        let every = (model.scene.stepping.rate_hz / TOLD_HZ).round().max(1.0) as u64;
        let [is_computing, is_over] = [Arc::default(), Arc::default()];
        Ok(ExerciseTask {
            live: live.clone(),
            is_computing,
            run,
            every,
            asked_step: begin_step,
            is_overdue: false,
            is_over,
        })
    }

    /// Takes the session after a step.
    pub(super) fn see(&mut self, session: &Session) {
        let before = self.run.phase();
        self.run.see(session);
        self.tell_phase(before);
    }

    /// Tells the phase that goes on, if it is another than before.
    fn tell_phase(&self, before: Option<u32>) {
        if let Some(phase) = self.run.phase().filter(|phase| before != Some(*phase)) {
            self.live.tell_phase(phase);
        }
    }

    /// Returns the step that a session at rest must do next, because figures are due after it; `u64::MAX` if there is none.
    pub(super) fn next_wanted(&self, step: u64) -> u64 {
        if self.is_over.load(Ordering::Acquire) {
            return u64::MAX;
        }
        let due = (step + 1).next_multiple_of(self.every);
        self.run.limit_step().map_or(due, |limit| due.min(limit)).saturating_sub(1).max(step)
    }

    /// Has the figures computed that are due after a step.
    pub(super) fn tell(&mut self, session: &Session, to: (u64, &Arc<Inbox>), account: &Account, reading: &Reading) {
        if self.is_over.load(Ordering::Acquire) {
            return;
        }
        if self.run.ended().is_some() {
            return self.end(session, to, account, reading);
        }
        let step = session.step_count();
        let is_due = self.is_overdue || (step.is_multiple_of(self.every) && step > self.asked_step);
        if !is_due || self.is_computing.swap(true, Ordering::AcqRel) {
            return;
        }
        (self.asked_step, self.is_overdue) = (step, false);
        let computed = ClearsFlag(Some(self.is_computing.clone()));
        let (live, moment) = (self.live.clone(), self.run.moment(session));
        let work = move || {
            let figures = moment.figures();
            drop(computed);
            live.tell_figures(figures);
        };
        reading.post(account, Piece::Work(Box::new(work)));
    }

    /// Ends a phase of the exercise at the session's present step, if it is `phase`, from 1: with the last one the exercise ends. `note` writes
    /// to the event log that the next one begins, before anybody is told.
    pub(super) fn end_phase(
        &mut self,
        session: &Session,
        phase: u32,
        note: impl FnOnce(),
        to: (u64, &Arc<Inbox>),
        account: &Account,
        reading: &Reading,
    ) {
        if self.is_over.load(Ordering::Acquire) || self.run.ended().is_some() {
            return;
        }
        if self.run.end_phase(session, phase) {
            note();
            self.live.tell_phase(phase + 1);
            self.is_overdue = true;
            self.tell(session, to, account, reading);
        } else if self.run.phase() == Some(phase) {
            self.end(session, to, account, reading);
        }
    }

    /// Ends the exercise at the session's present step, unless it has ended, and has its result computed.
    pub(super) fn end(
        &mut self,
        session: &Session,
        (number, inbox): (u64, &Arc<Inbox>),
        account: &Account,
        reading: &Reading,
    ) {
        if self.is_over.swap(true, Ordering::AcqRel) {
            return;
        }
        let computing = ClearsFlag(Some(self.is_over.clone()));
        let (moment, answers): (MeasuredMoment, _) =
            (self.run.end(session).clone(), self.run.answers(session).to_vec());
        let (inbox, begin_step) = (inbox.clone(), self.live.begin_step);
        let work = move || {
            let added_lumps = moment.judge().map_or(Vec::new(), |judge| judge.added_lumps().to_vec());
            let ended = EndedExercise { begin_step, figures: moment.figures(), answers, added_lumps };
            inbox.send(number, Request::ExerciseEnded(Arc::new(ended)));
            computing.keep();
        };
        reading.post(account, Piece::Work(Box::new(work)));
    }
}

#[cfg(test)]
mod tests {
    use std::panic::{AssertUnwindSafe, catch_unwind};

    use super::*;

    #[test]
    fn a_computation_that_is_refused_memory_can_be_asked_for_again() {
        let flag = Arc::new(AtomicBool::new(true));
        let computing = ClearsFlag(Some(flag.clone()));
        let refused = catch_unwind(AssertUnwindSafe(move || {
            let _computing = computing;
            std::panic::resume_unwind(Box::new("refused"));
        }));
        assert!(refused.is_err() && !flag.load(Ordering::Acquire));
        flag.store(true, Ordering::Release);
        ClearsFlag(Some(flag.clone())).keep();
        assert!(flag.load(Ordering::Acquire));
    }
}
