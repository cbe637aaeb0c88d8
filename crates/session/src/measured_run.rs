//! What was done in a session, measured step by step and judged by an exercise if there is one, up to the end of the exercise; the same of
//! each of its phases.

use std::sync::Arc;

use crate::chosen_exercise::ChosenExercise;
use crate::exercise_judge::{ExerciseJudge, ExerciseScore, PhaseFigures};
use crate::measure_recorder::MeasureRecorder;
use crate::phase_run::{PhaseEnd, PhaseMoment, PhaseRun};
use crate::{RecordedMark, Session};
use palpate_exercise::{ExerciseTruth, Figure, MeasureOptions, Measures};
use palpate_refusal::Result;
use palpate_tissue::Model;
use palpate_tissue::scene::exercise::Lump;
use palpate_tissue::scene::script::Script;

/// Measures a session, and judges it by an exercise. Show it the session after each step; what comes after the end of the exercise does not
/// count. A server that runs a session and a program that replays its journal get the same bits.
pub struct MeasuredRun {
    recorder: MeasureRecorder,
    judge: Option<ExerciseJudge>,
    /// `None` for an exercise of one piece, and without an exercise.
    phases: Option<PhaseRun>,
    /// The step at which the exercise was ended before its time.
    ends_at: Option<u64>,
    ended: Option<MeasuredMoment>,
}

/// What was measured up to a moment. Its figures take longer than a step may, so that they are computed elsewhere.
#[derive(Clone)]
pub struct MeasuredMoment {
    /// Number of steps done.
    pub step: u64,
    /// The measures that need no truth.
    pub measures: Measures,
    judged: Option<(ExerciseJudge, ExerciseTruth)>,
    phases: Vec<Arc<PhaseMoment>>,
    rate_hz: f64,
}

/// The figures of a moment.
#[derive(Debug, Clone, PartialEq)]
pub struct MomentFigures {
    /// Number of steps done.
    pub step: u64,
    /// The figures that need no truth, then those of the exercise.
    pub figures: Vec<Figure>,
    /// The figures of the phases that have ended, and of the one that goes on; empty for an exercise of one piece.
    pub phases: Vec<PhaseFigures>,
    /// The score; `None` for an exercise without criteria, and without an exercise.
    pub score: Option<ExerciseScore>,
}

/// The end of an exercise.
#[derive(Debug, Clone, PartialEq)]
pub struct EndedExercise {
    /// Number of steps done when it began.
    pub begin_step: u64,
    /// All figures, and the score.
    pub figures: MomentFigures,
    /// What was marked.
    pub answers: Vec<RecordedMark>,
    /// The lumps that the trainer hid while it went on, beside those with which it began.
    pub added_lumps: Vec<Lump>,
}

impl MeasuredRun {
    /// Begins at step `begin_step`, with an exercise if there is one; `continuous` is as for [`MeasureRecorder::new`].
    ///
    /// # Errors
    /// Refuses what [`MeasureRecorder::new`] and [`ExerciseJudge::new`] refuse.
    pub fn new(
        model: &Model,
        begin_step: u64,
        options: MeasureOptions,
        continuous: Option<&Script>,
        chosen: Option<&ChosenExercise>,
    ) -> Result<Self> {
        let judge =
            |chosen: &ChosenExercise| ExerciseJudge::new(&chosen.exercise, chosen.lumps.clone(), model, begin_step);
        let recorder = MeasureRecorder::new(model, begin_step, options, continuous)?;
        let judge = chosen.map(judge).transpose()?;
        let phased = judge.as_ref().filter(|judge| !judge.exercise().phases.is_empty());
        Ok(MeasuredRun {
            phases: phased.map(|judge| PhaseRun::new(&recorder, judge)),
            recorder,
            judge,
            ends_at: None,
            ended: None,
        })
    }

    /// Returns this run with an end of the exercise at step `step`, if that is before its time is up.
    #[must_use]
    pub fn ending_at(self, step: Option<u64>) -> Self {
        MeasuredRun { ends_at: step, ..self }
    }

    /// Returns this run with phases that end where a recorded trainee went on.
    #[must_use]
    pub fn ending_phases_at(mut self, ends: Vec<PhaseEnd>) -> Self {
        self.phases.iter_mut().for_each(|phases| phases.end_at(ends.clone()));
        self
    }

    /// Takes the session at its present step. Returns whether the exercise has ended.
    pub fn see(&mut self, session: &Session) -> bool {
        if self.ended.is_some() {
            return true;
        }
        self.recorder.see(session);
        if let Some(judge) = &mut self.judge {
            judge.see(session, self.recorder.rows());
            let is_done = self.phases.as_mut().is_some_and(|phases| phases.see(session, self.recorder.rows()));
            if is_done || judge.is_time_up(session) || self.ends_at.is_some_and(|step| session.step_count() >= step) {
                self.ended = Some(self.moment(session));
            }
        }
        self.ended.is_some()
    }

    /// Ends the exercise at the session's present step, unless it has ended. Returns its end.
    pub fn end(&mut self, session: &Session) -> &MeasuredMoment {
        self.see(session);
        let ended = self.ended.take().unwrap_or_else(|| self.moment(session));
        self.ended.insert(ended)
    }

    /// Ends the present phase at the session's present step, if it is `phase` (from 1) and another one follows. Returns whether it did.
    pub fn end_phase(&mut self, session: &Session, phase: u32) -> bool {
        let has_ended = self.see(session);
        !has_ended && self.phases.as_mut().is_some_and(|phases| phases.end(session, phase))
    }

    /// Returns the number of the phase that goes on, from 1; `None` for an exercise of one piece, and without an exercise.
    pub fn phase(&self) -> Option<u32> {
        self.phases.as_ref().map(PhaseRun::number)
    }

    /// Returns the end of the exercise; `None` before.
    pub fn ended(&self) -> Option<&MeasuredMoment> {
        self.ended.as_ref()
    }

    /// Returns the measures that need no truth: those at the end of the exercise, or so far.
    pub fn measures(&self) -> &Measures {
        self.ended.as_ref().map_or_else(|| self.recorder.measures(), |ended| &ended.measures)
    }

    /// Returns the step at which the time of the exercise, or of its present phase, is up; `None` without a limit.
    pub fn limit_step(&self) -> Option<u64> {
        let whole = self.judge.as_ref().and_then(ExerciseJudge::limit_step);
        let of_phase = self.phases.as_ref().and_then(PhaseRun::limit_step);
        whole.into_iter().chain(of_phase).min()
    }

    /// Returns the places that were marked since the exercise began; all marks without an exercise.
    pub fn answers<'s>(&self, session: &'s Session) -> &'s [RecordedMark] {
        self.judge.as_ref().map_or(session.marks(), |judge| judge.answers(session))
    }

    /// Returns what was measured so far.
    pub fn moment(&self, session: &Session) -> MeasuredMoment {
        MeasuredMoment {
            step: session.step_count(),
            measures: self.recorder.measures().clone(),
            judged: self.judge.as_ref().map(|judge| (judge.clone(), judge.truth(session))),
            phases: self.phases.as_ref().map_or(Vec::new(), |phases| phases.moments(session)),
            rate_hz: session.model().scene.stepping.rate_hz,
        }
    }
}

impl MeasuredMoment {
    /// Computes the figures and the score, which takes some milliseconds.
    pub fn figures(&self) -> MomentFigures {
        let mut figures = self.measures.figures();
        let phases: Vec<PhaseFigures> = self.phases.iter().map(|phase| phase.figures().clone()).collect();
        let mut score = None;
        if let Some((judge, truth)) = &self.judged {
            figures.extend(truth.figures(self.rate_hz, judge.tasks()));
            let of_phases: Vec<_> =
                self.phases.iter().map(|phase| (&phase.figures().figures[..], phase.has_acted())).collect();
            score = judge.score(&figures, &of_phases);
        }
        MomentFigures { step: self.step, figures, phases, score }
    }

    /// Returns the judge at that moment; `None` without an exercise.
    pub fn judge(&self) -> Option<&ExerciseJudge> {
        self.judged.as_ref().map(|(judge, _)| judge)
    }
}
