//! Exercises of a server: the exercise of a session, its live measures, and its result, converted for Python.

use std::collections::BTreeMap;
use std::sync::Arc;

use palpate_proto::geometry::from_vector;
use palpate_proto::pb;
use pb::create_session_request::Source;
use pyo3::exceptions::{PyStopAsyncIteration, PyStopIteration};
use pyo3::prelude::*;
use tokio::sync::Mutex;
use tonic::Streaming;

use crate::error::of_status;
use crate::waiting::answer;

/// The exercise that a session is to be made for: `exercise` is the name of one of the server, or the text of one.
pub(crate) fn source(exercise: String, seed: Option<u64>, scene: Option<String>) -> Source {
    use pb::chosen_exercise::Source as Of;
    // A text has more than a line.
    let source = if exercise.contains('\n') { Of::Text(exercise) } else { Of::Name(exercise) };
    Source::Exercise(pb::ChosenExercise { source: Some(source), seed, scene_name: scene.unwrap_or_default() })
}

/// What everybody may know of an exercise.
#[derive(IntoPyObject)]
pub(crate) struct KnownExercise {
    name: String,
    title: String,
    instructions: String,
    scenes: Vec<String>,
    time_limit_s: Option<f64>,
    force_limit_n: Option<f64>,
    pressure_limit_pa: Option<f64>,
    strain_limit: Option<f64>,
    coverage_pa: Option<f64>,
    hides_truth: bool,
    live_measures: Vec<String>,
    tells_result: bool,
    phases: Vec<KnownPhase>,
}

/// A phase of an exercise.
#[derive(IntoPyObject)]
struct KnownPhase {
    title: String,
    instructions: String,
    time_limit_s: Option<f64>,
}

impl KnownExercise {
    pub(crate) fn of(exercise: pb::Exercise) -> Self {
        let phase = |phase: pb::ExercisePhase| {
            let pb::ExercisePhase { title, instructions, time_limit_s } = phase;
            KnownPhase { title, instructions, time_limit_s }
        };
        KnownExercise {
            name: exercise.name,
            title: exercise.title,
            instructions: exercise.instructions,
            scenes: exercise.scene_names,
            time_limit_s: exercise.time_limit_s,
            force_limit_n: exercise.force_limit_n,
            pressure_limit_pa: exercise.pressure_limit_pa,
            strain_limit: exercise.strain_limit,
            coverage_pa: exercise.coverage_pa,
            hides_truth: exercise.hides_truth,
            live_measures: exercise.live_measures,
            tells_result: exercise.tells_result,
            phases: exercise.phases.into_iter().map(phase).collect(),
        }
    }
}

/// The exercise of a session.
#[derive(IntoPyObject)]
pub(crate) struct SessionTask {
    exercise: KnownExercise,
    role: &'static str,
    trainee_id: Option<String>,
    seed: Option<u64>,
    begin_step: u64,
    finished: bool,
}

impl SessionTask {
    pub(crate) fn of(task: pb::SessionExercise) -> Self {
        let is_trainee = task.role() == pb::ExerciseRole::Trainee;
        SessionTask {
            role: if is_trainee { "trainee" } else { "trainer" },
            trainee_id: Some(task.trainee_id).filter(|id| !id.is_empty()),
            seed: task.seed,
            begin_step: task.begin_step,
            finished: task.finished,
            exercise: KnownExercise::of(task.exercise.unwrap_or_default()),
        }
    }
}

type Values = BTreeMap<String, f64>;

/// Returns the figures of all tools together, and those of each tool.
fn values(figures: Vec<pb::Figure>) -> (Values, BTreeMap<u32, Values>) {
    let (mut all, mut of_tools) = (Values::new(), BTreeMap::<u32, Values>::new());
    for figure in figures {
        match figure.tool {
            Some(tool) => of_tools.entry(tool).or_default().insert(figure.measure, figure.value),
            None => all.insert(figure.measure, figure.value),
        };
    }
    (all, of_tools)
}

fn place(place_m: Option<pb::Vector3>) -> Option<(f64, f64, f64)> {
    place_m.map(|place_m| from_vector(Some(&place_m)).into())
}

#[derive(IntoPyObject)]
struct ToldAdvice {
    number: u32,
    text: String,
    place_m: Option<(f64, f64, f64)>,
}

#[derive(IntoPyObject)]
struct ToldCriterion {
    measure: String,
    phase: Option<u32>,
    weight: f64,
    poor: f64,
    good: f64,
    value: Option<f64>,
    earned: f64,
}

#[derive(IntoPyObject)]
struct ToldLump {
    centre_m: Option<(f64, f64, f64)>,
    radius_m: f64,
    stiffness_factor: f64,
}

#[derive(IntoPyObject)]
struct ToldAnswer {
    step: u64,
    tool: u32,
    place_m: Option<(f64, f64, f64)>,
    diameter_m: Option<f64>,
}

/// What was measured in a phase.
#[derive(IntoPyObject)]
struct ToldPhase {
    begin_step: u64,
    step: u64,
    time_s: f64,
    figures: Values,
    tools: BTreeMap<u32, Values>,
}

/// The result of an exercise.
#[derive(IntoPyObject)]
pub(crate) struct ToldResult {
    step: u64,
    time_s: f64,
    is_told: bool,
    figures: Values,
    tools: BTreeMap<u32, Values>,
    score_percent: Option<f64>,
    criteria: Vec<ToldCriterion>,
    lumps: Vec<ToldLump>,
    answers: Vec<ToldAnswer>,
    phases: Vec<ToldPhase>,
}

impl ToldResult {
    pub(crate) fn of(result: pb::ExerciseResult) -> Self {
        let (figures, tools) = values(result.figures);
        let criterion = |earned: pb::EarnedCriterion| {
            let pb::EarnedCriterion { measure, weight, poor, good, value, earned, phase } = earned;
            ToldCriterion { measure, phase: Some(phase).filter(|phase| *phase > 0), weight, poor, good, value, earned }
        };
        let lump = |lump: pb::HiddenLump| ToldLump {
            centre_m: place(lump.centre_m),
            radius_m: lump.radius_m,
            stiffness_factor: lump.stiffness_factor,
        };
        let answer = |answer: pb::GivenAnswer| ToldAnswer {
            step: answer.step,
            tool: answer.tool,
            place_m: place(answer.place_m),
            diameter_m: answer.diameter_m,
        };
        let phase = |phase: pb::PhaseResult| {
            let (figures, tools) = values(phase.figures);
            ToldPhase { begin_step: phase.begin_step, step: phase.step, time_s: phase.time_s, figures, tools }
        };
        ToldResult {
            step: result.step,
            time_s: result.time_s,
            is_told: result.is_told,
            figures,
            tools,
            score_percent: result.score_percent,
            criteria: result.criteria.into_iter().map(criterion).collect(),
            lumps: result.lumps.into_iter().map(lump).collect(),
            answers: result.answers.into_iter().map(answer).collect(),
            phases: result.phases.into_iter().map(phase).collect(),
        }
    }
}

/// A lump that the trainer has hidden.
#[derive(IntoPyObject)]
pub(crate) struct ToldHiddenLump {
    centre_m: Option<(f64, f64, f64)>,
    radius_m: f64,
    stiffness_factor: f64,
    step: u64,
}

impl ToldHiddenLump {
    pub(crate) fn of(hidden: pb::HideLumpResponse) -> Self {
        let lump = hidden.lump.unwrap_or_default();
        ToldHiddenLump {
            centre_m: place(lump.centre_m),
            radius_m: lump.radius_m,
            stiffness_factor: lump.stiffness_factor,
            step: hidden.step,
        }
    }
}

/// The figures of a moment.
#[derive(IntoPyObject)]
struct ToldMoment {
    step: u64,
    time_s: f64,
    figures: Values,
    tools: BTreeMap<u32, Values>,
    score_percent: Option<f64>,
    advice: Vec<ToldAdvice>,
    phase: Option<u32>,
    phase_time_s: f64,
    result: Option<ToldResult>,
}

impl ToldMoment {
    fn of(message: pb::WatchExerciseResponse) -> Self {
        let (figures, tools) = values(message.figures);
        let advice = |advice: pb::Advice| ToldAdvice {
            number: advice.number,
            text: advice.text,
            place_m: place(advice.place_m),
        };
        ToldMoment {
            step: message.step,
            time_s: message.time_s,
            figures,
            tools,
            score_percent: message.score_percent,
            advice: message.advice.into_iter().map(advice).collect(),
            phase: Some(message.phase).filter(|phase| *phase > 0),
            phase_time_s: message.phase_time_s,
            result: message.result.map(ToldResult::of),
        }
    }
}

/// The measures of a session's exercise, one moment after another, ten per second of simulated time. Each is a dictionary:
///
/// - `step`: steps done; `time_s`: simulated time since the exercise began.
/// - `figures`: the figures of all tools together, by the name of the measure; `tools`: those of each tool, by its number.
/// - `score_percent`: the score if it ended now; None for a trainee.
/// - `advice`: what the trainer has told since the moment before: `number`, `text`, `place_m` of a marker.
/// - `phase`: the phase that goes on, from 1, None for an exercise of one piece; `phase_time_s`: simulated time since it began.
/// - `result`: what `RemoteSession.finish_exercise` returns, once the exercise has ended; the iteration ends then.
#[pyclass(frozen, name = "Measures", module = "palpate")]
pub(crate) struct LiveMeasures {
    pub(crate) stream: Arc<Mutex<Streaming<pb::WatchExerciseResponse>>>,
    pub(crate) awaited: bool,
}

#[pymethods]
impl LiveMeasures {
    fn __iter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    fn __next__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (stream, awaited) = (self.stream.clone(), self.awaited);
        answer(py, awaited, async move {
            let message = stream.lock().await.message().await.map_err(of_status)?;
            let end = || if awaited { PyStopAsyncIteration::new_err(()) } else { PyStopIteration::new_err(()) };
            message.map(ToldMoment::of).ok_or_else(end)
        })
    }

    fn __aiter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    fn __anext__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.__next__(py)
    }
}
