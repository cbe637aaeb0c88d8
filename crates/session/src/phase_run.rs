//! The phases of an exercise: which one goes on, when it ends, and what was measured in each.

use std::sync::{Arc, OnceLock};

use crate::Session;
use crate::exercise_judge::{ExerciseJudge, PhaseFigures, limit_step};
use crate::measure_recorder::MeasureRecorder;
use palpate_exercise::{ExerciseTruth, Measures, ToolRow};

/// The end of a phase before its time, because the trainee went on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PhaseEnd {
    /// The phase, from 1.
    pub phase: u32,
    /// Number of steps done when it ended.
    pub step: u64,
}

/// The phase of an exercise that goes on, and those that have ended.
pub(crate) struct PhaseRun {
    /// A recorder that has seen nothing: each phase begins with a copy.
    blank: MeasureRecorder,
    recorder: MeasureRecorder,
    judge: ExerciseJudge,
    ended: Vec<Arc<PhaseMoment>>,
    /// In a replay: where the trainee went on.
    ends: Vec<PhaseEnd>,
}

/// What was measured in a phase. Its figures are computed once, at the first use.
#[derive(Debug)]
pub(crate) struct PhaseMoment {
    begin_step: u64,
    end_step: u64,
    measures: Measures,
    judge: ExerciseJudge,
    truth: ExerciseTruth,
    figures: OnceLock<PhaseFigures>,
}

impl PhaseRun {
    /// Begins the first phase of an exercise that has some. `recorder` and `judge` are those of the whole exercise, which have seen nothing.
    pub(crate) fn new(recorder: &MeasureRecorder, judge: &ExerciseJudge) -> Self {
        let [blank, recorder] = [recorder.clone(), recorder.clone()];
        PhaseRun { blank, recorder, judge: judge.clone(), ended: Vec::new(), ends: Vec::new() }
    }

    /// Ends phases where a recorded trainee has gone on.
    pub(crate) fn end_at(&mut self, ends: Vec<PhaseEnd>) {
        self.ends = ends;
    }

    /// Returns the number of the phase that goes on, from 1.
    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn number(&self) -> u32 {
        self.ended.len() as u32 + 1
    }

    fn is_last(&self) -> bool {
        self.ended.len() + 1 >= self.judge.exercise().phases.len()
    }

    /// Returns the number of steps done when the time of the present phase is up; `None` without a limit.
    pub(crate) fn limit_step(&self) -> Option<u64> {
        let limit_s = self.judge.exercise().phases[self.ended.len()].time_limit_s;
        limit_s.map(|limit_s| limit_step(self.judge.begin_step(), limit_s, self.judge.rate_hz()))
    }

    /// Takes the session at its present step, with the rows of its tools. Returns whether the last phase has ended.
    pub(crate) fn see(&mut self, session: &Session, rows: &[ToolRow]) -> bool {
        let step = session.step_count();
        self.recorder.see_rows(step, rows);
        self.judge.see(session, self.recorder.rows());
        loop {
            let is_up = self.limit_step().is_some_and(|limit| step >= limit);
            let goes_on = self.ends.iter().any(|end| end.phase == self.number() && step >= end.step);
            match is_up || goes_on {
                false => return false,
                true if self.is_last() => return true,
                true => self.go_on(session),
            }
        }
    }

    /// Ends the present phase, unless it is another than `phase` or the last one. Returns whether it did.
    pub(crate) fn end(&mut self, session: &Session, phase: u32) -> bool {
        let ends = phase == self.number() && !self.is_last();
        if ends {
            self.go_on(session);
        }
        ends
    }

    fn go_on(&mut self, session: &Session) {
        self.ended.push(Arc::new(self.present(session)));
        self.judge = self.judge.of_phase(session);
        let next = self.blank.beginning_at(session.step_count());
        let ended = std::mem::replace(&mut self.recorder, next);
        self.recorder.see_rows(session.step_count(), ended.rows());
    }

    fn present(&self, session: &Session) -> PhaseMoment {
        PhaseMoment {
            begin_step: self.judge.begin_step(),
            end_step: session.step_count(),
            measures: self.recorder.measures().clone(),
            judge: self.judge.clone(),
            truth: self.judge.truth(session),
            figures: OnceLock::new(),
        }
    }

    /// Returns the phases that have ended, and the present one so far.
    pub(crate) fn moments(&self, session: &Session) -> Vec<Arc<PhaseMoment>> {
        self.ended.iter().cloned().chain([Arc::new(self.present(session))]).collect()
    }
}

impl PhaseMoment {
    /// Returns the figures of the phase.
    pub(crate) fn figures(&self) -> &PhaseFigures {
        self.figures.get_or_init(|| {
            let mut figures = self.measures.figures();
            figures.extend(self.truth.figures(self.judge.rate_hz(), self.judge.tasks()));
            PhaseFigures { begin_step: self.begin_step, end_step: self.end_step, figures }
        })
    }

    /// Returns whether the trainee has done anything in the phase.
    pub(crate) fn has_acted(&self) -> bool {
        self.judge.has_acted()
    }
}
