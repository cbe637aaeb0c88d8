//! The measuring of a session's exercise, on its stepping thread.
//!
//! It looks at the session after each step. Ten times per second of simulated time it copies the measures; the thread `records` computes
//! the figures, which may take longer than a step. A copy that is due while another one is computed is left out, except the last. The
//! result is told once it is in the event log of the session.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::inbox::{Inbox, Request};
use super::live_exercise::{EndedExercise, LiveExercise};
use super::reading::{Piece, Reading};
use palpate_refusal::Result;
use palpate_session::Session;
use palpate_session::budget::Account;
use palpate_session::exercise_judge::thresholds;
use palpate_session::measured_run::{MeasuredMoment, MeasuredRun};

/// How often figures are told, per second of simulated time.
const TOLD_HZ: f64 = 10.0;

/// Memory of the measures of a session and of a copy of them, bytes.
pub(super) const MEASURES_BYTES: u64 = 8 << 20;

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
    /// Whether the result was asked for.
    is_over: bool,
}

impl ExerciseTask {
    /// Begins at the session's present step.
    ///
    /// # Errors
    /// Refuses an exercise that does not fit the tissue.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(super) fn new(live: &Arc<LiveExercise>, session: &Session) -> Result<Self> {
        let (model, begin_step, chosen) = (session.model(), session.step_count(), &live.chosen);
        let mut run = MeasuredRun::new(model, begin_step, thresholds(&chosen.exercise), None, Some(chosen))?;
        run.see(session);
        let every = (model.scene.stepping.rate_hz / TOLD_HZ).round().max(1.0) as u64;
        let is_computing = Arc::default();
        Ok(ExerciseTask { live: live.clone(), is_computing, run, every, asked_step: begin_step, is_over: false })
    }

    /// Takes the session after a step.
    pub(super) fn see(&mut self, session: &Session) {
        self.run.see(session);
    }

    /// Returns the step that a session at rest must do next, because figures are due after it; `u64::MAX` if there is none.
    pub(super) fn next_wanted(&self, step: u64) -> u64 {
        if self.is_over {
            return u64::MAX;
        }
        let due = (step + 1).next_multiple_of(self.every);
        self.run.limit_step().map_or(due, |limit| due.min(limit)).saturating_sub(1).max(step)
    }

    /// Has the figures computed that are due after a step.
    pub(super) fn tell(&mut self, session: &Session, to: (u64, &Arc<Inbox>), account: &Account, reading: &Reading) {
        if self.is_over {
            return;
        }
        if self.run.ended().is_some() {
            return self.end(session, to, account, reading);
        }
        let step = session.step_count();
        let is_due = step.is_multiple_of(self.every) && step > self.asked_step;
        if !is_due || self.is_computing.swap(true, Ordering::AcqRel) {
            return;
        }
        self.asked_step = step;
        let (live, is_computing, moment) = (self.live.clone(), self.is_computing.clone(), self.run.moment(session));
        let work = move || {
            let figures = moment.figures();
            is_computing.store(false, Ordering::Release);
            live.tell_figures(figures);
        };
        reading.post(account, Piece::Work(Box::new(work)));
    }

    /// Ends the exercise at the session's present step, unless it has ended, and has its result computed.
    pub(super) fn end(
        &mut self,
        session: &Session,
        (number, inbox): (u64, &Arc<Inbox>),
        account: &Account,
        reading: &Reading,
    ) {
        if std::mem::replace(&mut self.is_over, true) {
            return;
        }
        let (moment, answers): (MeasuredMoment, _) =
            (self.run.end(session).clone(), self.run.answers(session).to_vec());
        let inbox = inbox.clone();
        let work = move || {
            let ended = EndedExercise { figures: Arc::new(moment.figures()), answers };
            inbox.send(number, Request::ExerciseEnded(Arc::new(ended)));
        };
        reading.post(account, Piece::Work(Box::new(work)));
    }
}
