//! What was done in a session, measured step by step and judged by an exercise if there is one, up to the end of the exercise.

use crate::chosen_exercise::ChosenExercise;
use crate::exercise_judge::{ExerciseJudge, ExerciseScore};
use crate::measure_recorder::MeasureRecorder;
use crate::{RecordedMark, Session};
use palpate_exercise::{ExerciseTruth, Figure, MeasureOptions, Measures};
use palpate_refusal::Result;
use palpate_tissue::Model;
use palpate_tissue::scene::script::Script;

/// Measures a session, and judges it by an exercise. Show it the session after each step; what comes after the end of the exercise does not
/// count. A server that runs a session and a program that replays its journal get the same bits.
pub struct MeasuredRun {
    recorder: MeasureRecorder,
    judge: Option<ExerciseJudge>,
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
    rate_hz: f64,
}

/// The figures of a moment.
#[derive(Debug, Clone, PartialEq)]
pub struct MomentFigures {
    /// Number of steps done.
    pub step: u64,
    /// The figures that need no truth, then those of the exercise.
    pub figures: Vec<Figure>,
    /// The score; `None` for an exercise without criteria, and without an exercise.
    pub score: Option<ExerciseScore>,
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
        Ok(MeasuredRun {
            recorder: MeasureRecorder::new(model, begin_step, options, continuous)?,
            judge: chosen.map(judge).transpose()?,
            ends_at: None,
            ended: None,
        })
    }

    /// Returns this run with an end of the exercise at step `step`, if that is before its time is up.
    #[must_use]
    pub fn ending_at(self, step: Option<u64>) -> Self {
        MeasuredRun { ends_at: step, ..self }
    }

    /// Takes the session at its present step. Returns whether the exercise has ended.
    pub fn see(&mut self, session: &Session) -> bool {
        if self.ended.is_some() {
            return true;
        }
        self.recorder.see(session);
        if let Some(judge) = &mut self.judge {
            judge.see(session, self.recorder.rows());
            if judge.is_time_up(session) || self.ends_at.is_some_and(|step| session.step_count() >= step) {
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

    /// Returns the end of the exercise; `None` before.
    pub fn ended(&self) -> Option<&MeasuredMoment> {
        self.ended.as_ref()
    }

    /// Returns the measures that need no truth: those at the end of the exercise, or so far.
    pub fn measures(&self) -> &Measures {
        self.ended.as_ref().map_or_else(|| self.recorder.measures(), |ended| &ended.measures)
    }

    /// Returns the step at which the time of the exercise is up; `None` without a limit.
    pub fn limit_step(&self) -> Option<u64> {
        self.judge.as_ref().and_then(ExerciseJudge::limit_step)
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
            rate_hz: session.model().scene.stepping.rate_hz,
        }
    }
}

impl MeasuredMoment {
    /// Computes the figures and the score, which takes some milliseconds.
    pub fn figures(&self) -> MomentFigures {
        let mut figures = self.measures.figures();
        let mut score = None;
        if let Some((judge, truth)) = &self.judged {
            figures.extend(truth.figures(self.rate_hz, judge.tasks()));
            score = judge.score(&figures);
        }
        MomentFigures { step: self.step, figures, score }
    }

    /// Returns the judge at that moment; `None` without an exercise.
    pub fn judge(&self) -> Option<&ExerciseJudge> {
        self.judged.as_ref().map(|(judge, _)| judge)
    }
}
