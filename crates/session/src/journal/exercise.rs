//! The exercise of a session in its journal: its text and seed in the header, ends of phases and its result among the inputs.

use palpate_exercise::{Figure, register};
use palpate_proto::geometry::{from_vector, vector};
use palpate_proto::journal as pb;

use super::lumps::{from_lumps, lumps};
use crate::RecordedMark;
use crate::chosen_exercise::ChosenExercise;
use crate::exercise_judge::{EarnedCriterion, ExerciseScore, PhaseFigures};
use crate::measured_run::{EndedExercise, MomentFigures};
use crate::phase_run::PhaseEnd;
use palpate_refusal::{Refusal, Result, positive};
use palpate_tissue::scene::action::PlaceMark;

/// Returns an exercise as the header of a journal has it; `trainee_id` is the ID that opens the session for a trainee.
pub fn recorded(chosen: &ChosenExercise, trainee_id: &str) -> pb::RecordedExercise {
    pb::RecordedExercise {
        text: chosen.text.to_string(),
        seed: chosen.seed,
        trainee_id: trainee_id.to_owned(),
        noticed_pressure_pa: chosen.noticed_pressure_pa,
    }
}

/// Returns the exercise in the header of a journal; `None` if the session was not made for one. `place` names the journal.
///
/// # Errors
/// Refuses a text or a seed that [`ChosenExercise::new`] refuses, and a pressure that is not above 0.
pub fn from_header(place: &str, header: &pb::Header) -> Result<Option<ChosenExercise>> {
    let read = |recorded: &pb::RecordedExercise| {
        let pressure = |pressure_pa| positive("noticed_pressure_pa", pressure_pa);
        let read = ChosenExercise::new("exercise", &recorded.text, Some(recorded.seed)).and_then(|chosen| {
            let noticed_pressure_pa = recorded.noticed_pressure_pa.map(pressure).transpose()?;
            Ok(ChosenExercise { noticed_pressure_pa, ..chosen })
        });
        read.map_err(|refusal| Refusal { place: Some(place.to_owned()), ..refusal.within("exercise") })
    };
    header.exercise.as_ref().map(read).transpose()
}

/// What a journal has of its session's exercise, beside the header.
#[derive(Debug, Default)]
pub struct ExerciseEvents {
    /// The phases that the trainee has ended before their time, in their order.
    pub phase_ends: Vec<PhaseEnd>,
    /// The result; `None` if the exercise has not ended in this journal.
    pub result: Option<pb::ExerciseResult>,
}

fn recorded_figures(figures: &[Figure]) -> Vec<pb::Figure> {
    let figure = |figure: &Figure| pb::Figure {
        measure: figure.definition.name.to_owned(),
        value: figure.value,
        tool: figure.tool,
    };
    figures.iter().map(figure).collect()
}

/// Returns figures without those of measures that this program does not have.
fn known_figures(figures: &[pb::Figure]) -> Vec<Figure> {
    let figure = |figure: &pb::Figure| {
        let definition = register::find(&figure.measure)?;
        Some(Figure { definition, value: figure.value, tool: figure.tool })
    };
    figures.iter().filter_map(figure).collect()
}

/// Returns the result of an exercise as a message.
pub(super) fn result(end: &EndedExercise) -> pb::ExerciseResult {
    let MomentFigures { step, figures, phases, score } = &end.figures;
    let criterion = |earned: &EarnedCriterion| pb::EarnedCriterion { value: earned.value, earned: earned.part };
    let answer = |answer: &RecordedMark| pb::GivenAnswer {
        step: answer.step,
        tool: answer.tool,
        mark: Some(pb::Mark { place_m: vector(answer.mark.place_m), diameter_m: answer.mark.diameter_m }),
    };
    let phase = |phase: &PhaseFigures| pb::PhaseResult {
        begin_step: phase.begin_step,
        step: phase.end_step,
        figures: recorded_figures(&phase.figures),
    };
    pb::ExerciseResult {
        step: *step,
        figures: recorded_figures(figures),
        score_percent: score.as_ref().map(|score| score.percent),
        begin_step: end.begin_step,
        criteria: score.iter().flat_map(|score| score.criteria.iter().map(criterion)).collect(),
        answers: end.answers.iter().map(answer).collect(),
        phases: phases.iter().map(phase).collect(),
        added_lumps: lumps(&end.added_lumps),
    }
}

/// Returns the result in a message, of this exercise.
pub fn from_result(result: &pb::ExerciseResult, chosen: &ChosenExercise) -> EndedExercise {
    let criteria = chosen.exercise.criteria.iter().zip(&result.criteria).map(|(criterion, earned)| EarnedCriterion {
        criterion: criterion.clone(),
        value: earned.value,
        part: earned.earned,
    });
    let phase = |phase: &pb::PhaseResult| PhaseFigures {
        begin_step: phase.begin_step,
        end_step: phase.step,
        figures: known_figures(&phase.figures),
    };
    let answer = |answer: &pb::GivenAnswer| {
        let mark = answer.mark.as_ref()?;
        let place_m = from_vector(mark.place_m.as_ref());
        Some(RecordedMark {
            step: answer.step,
            tool: answer.tool,
            mark: PlaceMark { place_m, diameter_m: mark.diameter_m },
        })
    };
    let score = result.score_percent.map(|percent| ExerciseScore { percent, criteria: criteria.collect() });
    let figures = MomentFigures {
        step: result.step,
        figures: known_figures(&result.figures),
        phases: result.phases.iter().map(phase).collect(),
        score,
    };
    EndedExercise {
        begin_step: result.begin_step,
        figures,
        answers: result.answers.iter().filter_map(answer).collect(),
        added_lumps: from_lumps(&result.added_lumps),
    }
}
