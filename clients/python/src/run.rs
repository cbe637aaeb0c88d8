//! Runs scripts, one or many over several threads.

use std::io::ErrorKind;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::channel;
use std::time::Instant;

use palpate_refusal::{Reason, Refusal};
use palpate_session::run::{RunEvent, RunOptions, run_with};
use palpate_session::simulation::SimulationFailure;
use palpate_tissue::Model;
use palpate_tissue::scene;
use palpate_tissue::scene::record::{Record, Run, Summary};
use palpate_tissue::select::scheme_selection::given_up;
use palpate_tissue::shape::PointName;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::arrays::{OF_POINT, OF_TOOL, add_point, column, records};
use crate::error::{of_run, refused, wrong};
use crate::scene::{Scene, Script, Tissue, limits, named};
use crate::waiting::{LOOK, STACK_BYTES, work};

/// The results of a run, as numbers.
#[derive(Default)]
pub(crate) struct RunRecord {
    header: Option<Run>,
    summary: Option<Summary>,
    point_names: Vec<PointName>,
    tools: Vec<u32>,
    time_s: Vec<f64>,
    points: Vec<f64>,
    felt: Vec<f64>,
    energy_j: Vec<f64>,
    awake_points: Vec<u64>,
    warnings: Vec<String>,
}

impl RunRecord {
    /// Creates the empty record of a run of this script.
    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn of(script: &scene::script::Script) -> Self {
        let point_names = script.sample_points.iter().map(|point| script.shape.name(*point)).collect();
        // Tools with a tip follow the others.
        let tools = script.first_tip().map_or_else(Vec::new, |first| (first as u32..script.tools() as u32).collect());
        RunRecord { point_names, tools, ..RunRecord::default() }
    }

    /// Adds the description of the run and its summary.
    pub(crate) fn finish(&mut self, run: Run, summary: Summary) {
        self.warnings = summary.warnings.iter().cloned().chain(summary.fault()).collect();
        (self.header, self.summary) = (Some(run), Some(summary));
    }

    pub(crate) fn add(&mut self, record: &Record) {
        self.time_s.push(record.time_s);
        record.points.iter().for_each(|point| add_point(&mut self.points, point));
        for number in &self.tools {
            match record.tools.iter().find(|tool| tool.tool == *number) {
                Some(tool) => {
                    let vectors = [tool.place_m, tool.displacement_m, tool.force_on_tool_n];
                    self.felt.extend(vectors.iter().flatten());
                }
                // The tool is away.
                None => self.felt.extend([f64::NAN; OF_TOOL]),
            }
        }
        let energy =
            record.energy_j.map_or([f64::NAN; 3], |energy| [energy.kinetic, energy.spring, energy.anchor_springs]);
        self.energy_j.extend(energy);
        self.awake_points.push(record.awake_points as u64);
    }

    /// Returns the results as a `palpate._run.Run` with arrays.
    fn given<'py>(self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let found = PyDict::new(py);
        let (times, points, tools) = (self.time_s.len(), self.point_names.len(), self.tools.len());
        let json = |value: serde_json::Result<String>| value.unwrap_or_default();
        found.set_item("header", json(serde_json::to_string(&self.header)))?;
        found.set_item("summary", json(serde_json::to_string(&self.summary)))?;
        found.set_item("time_s", column(py, self.time_s)?)?;
        let names: PyResult<Vec<_>> = self.point_names.into_iter().map(|name| named(py, name)).collect();
        found.set_item("point_names", PyList::new(py, names?)?)?;
        found.set_item("points", records(py, self.points, "POINT", &[times, points])?)?;
        found.set_item("tool_numbers", self.tools)?;
        found.set_item("tools", records(py, self.felt, "TOOL", &[times, tools])?)?;
        found.set_item("energy_j", records(py, self.energy_j, "ENERGY", &[times])?)?;
        found.set_item("awake_points", column(py, self.awake_points)?)?;
        found.set_item("warnings", self.warnings)?;
        py.import("palpate._run")?.getattr("Run")?.call((), Some(&found))
    }
}

/// Plays a script until it ends or `stop` is set.
fn play(
    model: &Arc<Model>,
    script: &Script,
    options: RunOptions,
    stop: &AtomicBool,
) -> Result<RunRecord, SimulationFailure> {
    let script = script.bound(&model.scene)?;
    let mut recorded = RunRecord::of(&script);
    let records = usize::try_from(script.steps / script.sample_every).unwrap_or(0).saturating_add(1).min(1 << 16);
    recorded.points.reserve(records.saturating_mul(script.sample_points.len() * OF_POINT).min(1 << 24));
    let begun = Instant::now();
    let clock_s = || begun.elapsed().as_secs_f64();
    let summary = run_with(model, &script, options, &limits(), &clock_s, &mut |news| {
        match news {
            RunEvent::Run(run) => recorded.header = Some(run.clone()),
            RunEvent::Record(record) => recorded.add(&record),
            RunEvent::Steps(_) if stop.load(Ordering::Relaxed) => return Err(ErrorKind::Interrupted.into()),
            RunEvent::Steps(_) | RunEvent::Summary(_) => {}
        }
        Ok(())
    })?;
    let warnings = model.warnings.iter().chain(&script.warnings).chain(&summary.warnings);
    recorded.warnings = warnings.cloned().chain(summary.fault()).collect();
    recorded.summary = Some(summary);
    Ok(recorded)
}

impl<'py> IntoPyObject<'py> for RunRecord {
    type Target = PyAny;
    type Output = Bound<'py, PyAny>;
    type Error = PyErr;

    fn into_pyobject(self, py: Python<'py>) -> PyResult<Self::Output> {
        self.given(py)
    }
}

/// A compiled tissue, or a scene to compile.
enum Given {
    Model(Arc<Model>),
    Scene(Py<Scene>),
}

impl Given {
    fn of(value: &Bound<'_, PyAny>) -> PyResult<Self> {
        match value.cast::<Tissue>() {
            Ok(tissue) => Ok(Given::Model(tissue.get().model.clone())),
            Err(_) => Ok(Given::Scene(Scene::given(value)?.unbind())),
        }
    }

    fn model(&self, stop: &AtomicBool) -> Result<Arc<Model>, Refusal> {
        match self {
            Given::Model(model) => Ok(model.clone()),
            Given::Scene(scene) => scene.get().compiled(stop),
        }
    }
}

/// Plays a script, with the numbers and the hash of `palpate run`. `held=True` holds forces constant within each
/// step, as a client does; `audit=True` plays it a second time in f64 with a quarter of the substep, and reports the
/// difference (summary["audited_error"]).
#[pyfunction]
#[pyo3(signature = (scene, script, *, held=false, audit=false))]
pub(crate) fn run<'py>(
    py: Python<'py>,
    scene: &Bound<'py, PyAny>,
    script: &Bound<'py, PyAny>,
    held: bool,
    audit: bool,
) -> PyResult<Bound<'py, PyAny>> {
    let (given, script) = (Given::of(scene)?, Script::given(script)?);
    let played = work(py, |stop| play(&given.model(stop)?, &script, RunOptions { held, audit, profile: None }, stop))?;
    played.map_err(of_run)?.given(py)
}

/// Runs many cases (scene, script) on several threads, and returns the results in their order; by default on as many
/// threads as there are processors. `progress` is called with the number of cases done and of all cases.
#[pyfunction]
#[pyo3(signature = (cases, *, held=false, threads=None, errors="raise", progress=None))]
pub(crate) fn study<'py>(
    py: Python<'py>,
    cases: &Bound<'py, PyAny>,
    held: bool,
    threads: Option<usize>,
    errors: &str,
    progress: Option<Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyList>> {
    let returns = match errors {
        "raise" => false,
        "return" => true,
        _ => return Err(wrong("errors", format!("must be \"raise\" or \"return\", but is `{errors}`"))),
    };
    let cases: PyResult<Vec<(Given, Script)>> = cases
        .try_iter()?
        .map(|case| {
            let (scene, script): (Bound<'_, PyAny>, Bound<'_, PyAny>) = case?.extract()?;
            Ok((Given::of(&scene)?, Script::given(&script)?))
        })
        .collect();
    let cases = cases?;
    let threads = thread_count(threads)?;
    let mut found: Vec<Option<Result<RunRecord, SimulationFailure>>> = Vec::new();
    found.resize_with(cases.len(), || None);
    let progress = progress.map(Bound::unbind);
    let (stop, next) = (AtomicBool::new(false), AtomicUsize::new(0));
    let raised = py.detach(|| {
        std::thread::scope(|scope| {
            let (tell, told) = channel();
            for number in 0..threads.min(cases.len()) {
                let (tell, cases, stop, next) = (tell.clone(), &cases, &stop, &next);
                let thread = std::thread::Builder::new().name(format!("study-{number}")).stack_size(STACK_BYTES);
                thread.spawn_scoped(scope, move || {
                    loop {
                        let case = next.fetch_add(1, Ordering::Relaxed);
                        let Some((given, script)) = cases.get(case).filter(|_| !stop.load(Ordering::Relaxed)) else {
                            break;
                        };
                        let played = given.model(stop).map_err(SimulationFailure::from);
                        let played = played
                            .and_then(|model| play(&model, script, RunOptions { held, ..Default::default() }, stop));
                        if tell.send((case, played)).is_err() {
                            break;
                        }
                    }
                })?;
            }
            drop(tell);
            let (mut done, mut looked, mut raised) = (0_usize, Instant::now(), Ok(()));
            loop {
                match told.recv_timeout(LOOK) {
                    Ok((case, played)) => {
                        done += 1;
                        stop.fetch_or(played.is_err() && !returns, Ordering::Relaxed);
                        found[case] = Some(played);
                    }
                    Err(std::sync::mpsc::RecvTimeoutError::Timeout) => {}
                    Err(std::sync::mpsc::RecvTimeoutError::Disconnected) => break,
                }
                if raised.is_ok() && (looked.elapsed() >= LOOK || done == cases.len()) {
                    raised = Python::attach(|py| {
                        py.check_signals()?;
                        progress.as_ref().map_or(Ok(()), |call| call.call1(py, (done, cases.len())).map(drop))
                    });
                    stop.fetch_or(raised.is_err(), Ordering::Relaxed);
                    looked = Instant::now();
                }
            }
            raised
        })
    });
    raised?;
    if !returns {
        // Of several failures, the first by number that was not merely stopped because of another.
        for (case, played) in found.iter_mut().enumerate() {
            if let Some(Err(failure)) = played.take_if(|played| is_cause(played)) {
                let error = of_run(failure);
                let _ = error.value(py).call_method1("add_note", (format!("in case {case} of the study"),));
                return Err(error);
            }
        }
    }
    let given = found.into_iter().flatten().map(|played| match played {
        Ok(recorded) => recorded.given(py),
        Err(failure) => Ok(of_run(failure).into_value(py).into_bound(py).into_any()),
    });
    PyList::new(py, given.collect::<PyResult<Vec<_>>>()?)
}

/// Returns the number of threads for work that is spread over them: that of cores if none is given.
pub(crate) fn thread_count(threads: Option<usize>) -> PyResult<usize> {
    match threads {
        Some(0) => Err(refused(Refusal::new(Reason::OutOfRange, "threads", "must be 1 or more"))),
        Some(threads) => Ok(threads),
        None => Ok(std::thread::available_parallelism().map_or(1, Into::into)),
    }
}

/// Returns whether a run failed by itself.
fn is_cause(played: &Result<RunRecord, SimulationFailure>) -> bool {
    match played {
        Err(SimulationFailure::Output(error)) => error.kind() != ErrorKind::Interrupted,
        Err(SimulationFailure::Refused(refusal)) => refusal.message != given_up().message,
        Err(SimulationFailure::Held(_)) => true,
        Ok(_) => false,
    }
}
