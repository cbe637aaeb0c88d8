//! The exercise of a session in its journal: its text and seed in the header, its result among the inputs.

use palpate_exercise::{Figure, register};
use palpate_proto::journal as pb;

use crate::chosen_exercise::ChosenExercise;
use crate::exercise_judge::ExerciseScore;
use crate::measured_run::MomentFigures;
use palpate_refusal::{Refusal, Result};

/// Returns an exercise as the header of a journal has it; `trainee_id` is the ID that opens the session for a trainee.
pub fn recorded(chosen: &ChosenExercise, trainee_id: &str) -> pb::RecordedExercise {
    pb::RecordedExercise { text: chosen.text.to_string(), seed: chosen.seed, trainee_id: trainee_id.to_owned() }
}

/// Returns the exercise in the header of a journal; `None` if the session was not made for one. `place` names the journal.
///
/// # Errors
/// Refuses a text or a seed that [`ChosenExercise::new`] refuses.
pub fn from_header(place: &str, header: &pb::Header) -> Result<Option<ChosenExercise>> {
    let read = |recorded: &pb::RecordedExercise| {
        let read = ChosenExercise::new("exercise", &recorded.text, Some(recorded.seed));
        read.map_err(|refusal| Refusal { place: Some(place.to_owned()), ..refusal.within("exercise") })
    };
    header.exercise.as_ref().map(read).transpose()
}

/// Returns the result of an exercise as a message.
pub(super) fn result(MomentFigures { step, figures, score }: &MomentFigures) -> pb::ExerciseResult {
    let figure = |figure: &Figure| pb::Figure {
        measure: figure.definition.name.to_owned(),
        value: figure.value,
        tool: figure.tool,
    };
    let score_percent = score.as_ref().map(|score| score.percent);
    pb::ExerciseResult { step: *step, figures: figures.iter().map(figure).collect(), score_percent }
}

/// Returns the result in a message, with the score in percent and without its criteria. Figures of measures that this program does not
/// have are left out.
pub fn from_result(result: &pb::ExerciseResult) -> MomentFigures {
    let figure = |figure: &pb::Figure| {
        let definition = register::find(&figure.measure)?;
        Some(Figure { definition, value: figure.value, tool: figure.tool })
    };
    let score = result.score_percent.map(|percent| ExerciseScore { percent, criteria: Vec::new() });
    MomentFigures { step: result.step, figures: result.figures.iter().filter_map(figure).collect(), score }
}
