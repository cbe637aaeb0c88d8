//! An exercise in a score: what was chosen, and what was earned by its criteria.

use std::path::PathBuf;
use std::sync::Arc;

use palpate_exercise::MeasureOptions;
use palpate_proto::journal as pb;
use palpate_refusal::Refusal;
use palpate_session::chosen_exercise::ChosenExercise;
use palpate_session::exercise_judge::{EarnedCriterion, ExerciseJudge, ExerciseScore, PhaseFigures};
use palpate_session::felt_lump;
use palpate_session::journal::exercise::from_header;
use palpate_session::measured_run::MomentFigures;
use palpate_session::phase_run::PhaseEnd;
use palpate_session::{RecordedMark, Session};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::exercise::{ExercisePhase, Lump};
use palpate_tissue::scene::exercise_reader::find_exercise;
use palpate_tissue::scene::script::Script;
use palpate_tissue::select::scheme_selection::NEVER;
use serde::{Deserialize, Serialize};

use super::super::scene::{SceneArguments, compile_with};
use super::super::{Failure, say};
use super::ScoredMeasure;

/// Which exercise, with which hidden truth.
#[derive(clap::Args, Default)]
pub(crate) struct ExerciseOptions {
    /// An exercise file, or the name of one that is in ./exercises or built in: `lumps-1`, `lumps-2`, `lumps-3`, `palpate-all`,
    /// `search-mark`, `cut-line`, `lift-hold`, `close-wound`. Its hidden lumps take the place of the scene's own
    #[arg(long, value_name = "EXERCISE")]
    exercise: Option<PathBuf>,
    /// The seed of the exercise's hidden truth [default: that of the exercise]
    #[arg(long, value_name = "NUMBER", requires = "exercise")]
    seed: Option<u64>,
}

impl ExerciseOptions {
    /// Reads the exercise; `None` if none was given.
    ///
    /// # Errors
    /// Refuses what [`find_exercise`] and [`ChosenExercise::new`] refuse.
    pub(crate) fn chosen(&self) -> Result<Option<ChosenExercise>, Refusal> {
        let Some(path) = &self.exercise else { return Ok(None) };
        let (name, text) = find_exercise(path, &Limits::default())?;
        ChosenExercise::new(&name, &text, self.seed).map(Some).map_err(of_option)
    }

    /// Warns if the file of the exercise is not named as the exercise is.
    pub(crate) fn warn_of_name(&self, chosen: Option<&ChosenExercise>) {
        let (Some(path), Some(ChosenExercise { exercise, .. })) = (&self.exercise, chosen) else { return };
        if path.file_stem().unwrap_or_default() != exercise.name.as_str() {
            say!(
                "palpate: warning: exercise {}: its file is {}: a server leaves out an exercise whose file is named otherwise",
                exercise.name,
                path.display()
            );
        }
    }

    /// Returns the exercise of a recorded session: that of its journal, if the session was made for one, or else the one that was given.
    /// `place` names the journal.
    ///
    /// # Errors
    /// Refuses what [`ExerciseOptions::chosen`] refuses, an exercise in the journal that can't be read, and one that was given and is not
    /// that of the journal.
    pub(crate) fn recorded(&self, place: &str, header: &pb::Header) -> Result<Option<ChosenExercise>, Refusal> {
        let given = self.chosen()?;
        let Some(recorded) = from_header(place, header)? else { return Ok(given) };
        if let Some(given) = given {
            // Without --seed, the seed is not given.
            let seed = self.seed.unwrap_or(recorded.seed);
            ChosenExercise { seed, ..given }.check_same(&recorded, place).map_err(of_option)?;
        }
        Ok(Some(recorded))
    }
}

/// Names the option in place of the field.
fn of_option(refusal: Refusal) -> Refusal {
    match refusal.field.as_str() {
        "seed" | "exercise" => Refusal { field: format!("--{}", refusal.field), ..refusal },
        _ => refusal,
    }
}

/// Returns the thresholds of an exercise; the usual ones without an exercise.
pub(crate) fn usual_thresholds(chosen: Option<&ChosenExercise>) -> MeasureOptions {
    chosen.map_or_else(MeasureOptions::default, ChosenExercise::thresholds)
}

/// Returns the exercise with the pressure from which on the lump of its `[coverage]` is felt in this tissue, if it has one.
///
/// # Errors
/// Refuses what [`felt_lump::with_noticed_pressure`] refuses.
pub(crate) fn with_noticed_pressure(
    chosen: Option<ChosenExercise>,
    model: &Model,
    limits: &Limits,
) -> Result<Option<ChosenExercise>, Refusal> {
    chosen.map(|chosen| felt_lump::with_noticed_pressure(chosen, model, limits, &NEVER)).transpose()
}

/// Compiles the scene that the arguments name, with the exercise's changes if there is one. Returns it with the limits in force.
///
/// # Errors
/// Refuses what [`compile_with`] refuses; a refusal of the exercise's changes names the exercise.
pub(crate) fn compile(
    chosen: Option<&ChosenExercise>,
    scene: &SceneArguments,
) -> Result<(Arc<Model>, Limits), Failure> {
    let Some(chosen) = chosen else { return compile_with(scene, &[]) };
    let of_exercise = |failure: Failure| match failure {
        // The lumps that were drawn are in the scene's text: they are not the user's `--set`.
        Failure::Refused(message) if message.contains("inclusion") => {
            Failure::Refused(misfit(chosen, &message.replace("--set: ", "")))
        }
        other => other,
    };
    let compiled = compile_with(scene, &chosen.assignments()).map_err(of_exercise)?;
    warn(chosen, &compiled.0);
    Ok(compiled)
}

/// Returns the refusal of a scene in which the exercise's lumps are the inclusions, for those who wrote the exercise.
fn misfit(chosen: &ChosenExercise, message: &str) -> String {
    let (name, seed) = (&chosen.exercise.name, chosen.seed);
    let number = message.split_once("inclusion[").and_then(|(_, rest)| rest.split_once(']'));
    let number = number.and_then(|(number, _)| number.parse::<usize>().ok());
    match number.and_then(|number| Some((number + 1, chosen.lumps.get(number)?.centre_m))) {
        Some((number, at_m)) => format!(
            "exercise {name}: lump {number} of seed {seed}, at [{:.4}, {:.4}, {:.4}] m, does not fit this scene: {message}; from_m and \
             to_m of [lumps] are the box of the places",
            at_m[0], at_m[1], at_m[2]
        ),
        None => format!("exercise {name}: a lump of seed {seed} does not fit this scene: {message}"),
    }
}

/// Returns where the trainee of a script ends phases of an exercise.
///
/// # Errors
/// Refuses a phase that the exercise does not have.
pub(crate) fn phase_ends(script: &Script, chosen: Option<&ChosenExercise>) -> Result<Vec<PhaseEnd>, Failure> {
    let Some(chosen) = chosen else { return Ok(Vec::new()) };
    let phases = chosen.exercise.phases.len();
    if let Some((index, (_, phase))) = script.phase_ends.iter().enumerate().find(|(_, end)| end.1 as usize > phases) {
        let message =
            format!("phase_end[{index}].phase: {phase}: the exercise `{}` has {phases} phases", chosen.exercise.name);
        return Err(Failure::Refused(message));
    }
    Ok(script.phase_ends.iter().map(|(step, phase)| PhaseEnd { phase: *phase, step: *step }).collect())
}

/// Warns if the exercise is made for other scenes than that of the tissue, and if this can hardly show the hidden lumps.
pub(crate) fn warn(chosen: &ChosenExercise, model: &Model) {
    for warning in chosen.warnings(model) {
        say!("palpate: warning: {warning}");
    }
    let scene = &model.scene.name;
    if !chosen.exercise.scenes.iter().any(|name| name == scene) {
        let (name, made_for) = (&chosen.exercise.name, chosen.exercise.scenes.join(", "));
        say!("palpate: warning: exercise {name}: made for {made_for}; on `{scene}` its places may be wrong");
    }
}

/// A place that the trainee marked.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ScoredAnswer {
    pub(crate) step: u64,
    pub(crate) tool: u32,
    pub(crate) place_m: [f64; 3],
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) diameter_m: Option<f64>,
}

/// A hidden lump.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ScoredLump {
    pub(crate) centre_m: [f64; 3],
    pub(crate) radius_m: f64,
    pub(crate) stiffness_factor: f64,
}

/// What a criterion earned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ScoredCriterion {
    pub(crate) measure: String,
    /// The phase whose figure counts, from 1; absent: that of the whole exercise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) phase: Option<u32>,
    pub(crate) weight: f64,
    pub(crate) poor: f64,
    pub(crate) good: f64,
    /// Absent: the measure has no value, which earns nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) value: Option<f64>,
    /// The earned part of the weight, 0 to 1.
    pub(crate) earned: f64,
}

impl ScoredCriterion {
    /// Returns the measure, with its phase if it is of one.
    pub(crate) fn title(&self) -> String {
        self.phase.map_or_else(|| self.measure.clone(), |phase| format!("{} ({phase})", self.measure))
    }
}

/// What was measured in a phase of an exercise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ScoredPhase {
    pub(crate) title: String,
    /// Steps done at its beginning, and in it.
    pub(crate) begin_step: u64,
    pub(crate) steps: u64,
    /// All tools together, then each tool.
    pub(crate) measures: Vec<ScoredMeasure>,
}

impl ScoredPhase {
    /// Returns how long it took, s.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn time_s(&self, rate_hz: f64) -> f64 {
        self.steps as f64 / rate_hz
    }

    /// Returns the figures of all tools together.
    pub(crate) fn of_all_tools(&self) -> impl Iterator<Item = &ScoredMeasure> {
        self.measures.iter().filter(|measure| measure.tool.is_none())
    }
}

/// The exercise of a score: its truth, the answers, and what was earned.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ScoredExercise {
    pub(crate) name: String,
    pub(crate) seed: u64,
    /// The thresholds that options have changed: the score is not comparable with others of the exercise.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) changed_thresholds: Vec<String>,
    /// The earned part of all weights, in percent; absent without a criterion.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) score_percent: Option<f64>,
    pub(crate) criteria: Vec<ScoredCriterion>,
    /// The phases that had begun; not written for an exercise of one piece.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(crate) phases: Vec<ScoredPhase>,
    pub(crate) lumps: Vec<ScoredLump>,
    pub(crate) answers: Vec<ScoredAnswer>,
}

impl ScoredExercise {
    /// Returns the exercise of a session at its end, with its figures and its score.
    pub(crate) fn of(judge: &ExerciseJudge, seed: u64, session: &Session, ended: &MomentFigures) -> Self {
        let score = ended.score.as_ref();
        let phase =
            |(phase, PhaseFigures { begin_step, end_step, figures }): (&ExercisePhase, &PhaseFigures)| ScoredPhase {
                title: phase.title.clone(),
                begin_step: *begin_step,
                steps: end_step - begin_step,
                measures: figures.iter().map(ScoredMeasure::of).collect(),
            };
        let criterion = |EarnedCriterion { criterion, value, part }: &EarnedCriterion| ScoredCriterion {
            measure: criterion.measure.clone(),
            phase: criterion.phase,
            weight: criterion.weight,
            poor: criterion.poor,
            good: criterion.good,
            value: *value,
            earned: *part,
        };
        let lump = |lump: &Lump| ScoredLump {
            centre_m: lump.centre_m.to_array(),
            radius_m: lump.radius_m,
            stiffness_factor: lump.stiffness_factor,
        };
        let answer = |placed: &RecordedMark| ScoredAnswer {
            step: placed.step,
            tool: placed.tool,
            place_m: placed.mark.place_m.to_array(),
            diameter_m: placed.mark.diameter_m,
        };
        ScoredExercise {
            name: judge.exercise().name.clone(),
            seed,
            changed_thresholds: Vec::new(),
            score_percent: score.map(|score| score.percent),
            criteria: score
                .into_iter()
                .flat_map(|ExerciseScore { criteria, .. }| criteria.iter().map(criterion))
                .collect(),
            phases: judge.exercise().phases.iter().zip(&ended.phases).map(phase).collect(),
            lumps: judge.lumps().map(lump).collect(),
            answers: judge.answers(session).iter().map(answer).collect(),
        }
    }
}
