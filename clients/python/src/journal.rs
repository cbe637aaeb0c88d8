//! Journals as NumPy arrays.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::atomic::Ordering;

use palpate_proto::geometry::from_vector;
use palpate_refusal::Refusal;
use palpate_session::journal::{self, JournalReader, Survey, pb, replay};
use palpate_tissue::select::scheme_selection::given_up;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyList};

use crate::arrays::{column, rows};
use crate::error::refused;
use crate::scene::limits;
use crate::session::{Session, SessionState};
use crate::waiting::work;

/// A recorded session: a journal file of `palpate serve --journal`.
#[pyclass(frozen, module = "palpate")]
pub(crate) struct Journal {
    path: PathBuf,
    header: pb::Header,
    survey: Survey,
}

/// What one tool did and felt.
#[derive(Default)]
struct ToolHistory {
    step: Vec<u64>,
    place_m: Vec<f64>,
    displacement_m: Vec<f64>,
    force_n: Vec<f64>,
}

/// Commands, as columns with one row per command.
#[derive(Default)]
struct CommandColumns {
    step: Vec<u64>,
    tool: Vec<u32>,
    kind: Vec<&'static str>,
    place_m: Vec<f64>,
    force_n: Vec<f64>,
    point: Vec<i64>,
    client_time_ns: Vec<u64>,
    late: Vec<bool>,
}

const NONE: [f64; 3] = [f64::NAN; 3];

impl CommandColumns {
    fn add(&mut self, step: u64, command: &pb::Command) {
        use pb::command::Action;
        let (kind, place_m, force_n, point) = match &command.action {
            _ if command.ends_lease => ("end_of_lease", NONE, NONE, -1),
            Some(Action::Push(push)) => {
                let [place, force] = [&push.centre_m, &push.force_n].map(|v| from_vector(v.as_ref()).to_array());
                ("push", place, force, push.point.map_or(-1, i64::from))
            }
            Some(Action::Grasp(grasp)) => {
                ("grasp", from_vector(grasp.displacement_m.as_ref()).to_array(), NONE, i64::from(grasp.point))
            }
            Some(Action::Pose(pose)) => ("pose", from_vector(pose.place_m.as_ref()).to_array(), NONE, -1),
            Some(Action::Tie(tie)) => {
                let first = tie.bites.first().map_or(NONE, |bite| from_vector(bite.place_m.as_ref()).to_array());
                ("tie", first, NONE, -1)
            }
            Some(Action::Mark(mark)) => ("mark", from_vector(mark.place_m.as_ref()).to_array(), NONE, -1),
            Some(Action::Release(_)) | None => ("release", NONE, NONE, -1),
        };
        self.step.push(step);
        self.tool.push(command.tool);
        self.kind.push(kind);
        self.place_m.extend(place_m);
        self.force_n.extend(force_n);
        self.point.push(point);
        self.client_time_ns.push(command.client_time_ns);
        self.late.push(command.late);
    }
}

impl Journal {
    fn open(&self) -> Result<JournalReader<'static>, Refusal> {
        JournalReader::open(&self.path)
    }

    #[allow(clippy::cast_precision_loss)]
    fn times<'py>(&self, py: Python<'py>, steps: &[u64]) -> PyResult<Bound<'py, PyAny>> {
        let rate_hz = self.header.rate_hz;
        let times: Vec<f64> =
            steps.iter().map(|step| if rate_hz > 0.0 { *step as f64 / rate_hz } else { 0.0 }).collect();
        column(py, times)
    }
}

#[pymethods]
impl Journal {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let opened = py.detach(|| {
            let mut reader = JournalReader::open(&path)?;
            let survey = reader.survey(&mut |_| {})?;
            Ok((reader.header().clone(), survey))
        });
        let (header, survey) = opened.map_err(refused)?;
        Ok(Journal { path, header, survey })
    }

    /// Information on the recording, by name: scene, first and last step, and more.
    #[getter]
    fn info<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let Journal { header, survey, .. } = self;
        let found = PyDict::new(py);
        found.set_item("session_id", &header.session_id)?;
        found.set_item("run", header.run)?;
        found.set_item("scene", header.scene.as_ref().map(|scene| scene.name.clone()).unwrap_or_default())?;
        found.set_item("owner", &header.owner)?;
        found.set_item("version", &header.version)?;
        found.set_item("rate_hz", header.rate_hz)?;
        found.set_item("begin_step", header.begin_step)?;
        found.set_item("end_step", survey.until_step)?;
        found.set_item("inputs", survey.inputs)?;
        found.set_item("hashes", survey.hashes)?;
        found.set_item("snapshot_steps", survey.snapshots.iter().map(|at| at.step).collect::<Vec<u64>>())?;
        found.set_item("begin_unix_ns", survey.unix_ns[0])?;
        found.set_item("end_unix_ns", survey.unix_ns[1])?;
        found.set_item("torn_bytes", survey.torn_bytes)?;
        found.set_item("end", survey.end.as_ref().map(|end| end.message.clone()))?;
        Ok(found)
    }

    /// Returns what each tool did and felt, by its number.
    fn tools<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let read = py.detach(|| {
            let mut courses: BTreeMap<u32, ToolHistory> = BTreeMap::new();
            let mut reader = self.open()?;
            let numbers = |v: Option<pb::Vector>| v.map_or([0.0; 3], |v| [v.x, v.y, v.z].map(f64::from));
            while let Some(batch) = reader.next_batch()? {
                for moment in batch.felt()? {
                    for felt in moment.tools {
                        let course = courses.entry(felt.tool).or_default();
                        course.step.push(moment.step);
                        course.place_m.extend(numbers(felt.place_m));
                        course.displacement_m.extend(numbers(felt.displacement_m));
                        course.force_n.extend(numbers(felt.force_n));
                    }
                }
            }
            Ok(courses)
        });
        let (found, made) = (PyDict::new(py), py.import("palpate._journal")?.getattr("Course")?);
        for (tool, course) in read.map_err(refused)? {
            let given = PyDict::new(py);
            given.set_item("time_s", self.times(py, &course.step)?)?;
            given.set_item("step", column(py, course.step)?)?;
            given.set_item("place_m", rows(py, course.place_m)?)?;
            given.set_item("displacement_m", rows(py, course.displacement_m)?)?;
            given.set_item("force_n", rows(py, course.force_n)?)?;
            found.set_item(tool, made.call((), Some(&given))?)?;
        }
        Ok(found)
    }

    /// Returns all commands, by the step at which they acted.
    fn commands<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let read = py.detach(|| {
            let (mut commands, mut reader) = (CommandColumns::default(), self.open()?);
            while let Some(batch) = reader.next_batch()? {
                for input in batch.inputs()? {
                    if let Some(pb::input::What::Command(command)) = &input.what {
                        commands.add(input.step, command);
                    }
                }
            }
            Ok(commands)
        });
        let commands = read.map_err(refused)?;
        let given = PyDict::new(py);
        given.set_item("time_s", self.times(py, &commands.step)?)?;
        given.set_item("step", column(py, commands.step)?)?;
        given.set_item("tool", column(py, commands.tool)?)?;
        given.set_item("kind", PyList::new(py, commands.kind)?)?;
        given.set_item("place_m", rows(py, commands.place_m)?)?;
        given.set_item("force_n", rows(py, commands.force_n)?)?;
        given.set_item("point", column(py, commands.point)?)?;
        given.set_item("client_time_ns", column(py, commands.client_time_ns)?)?;
        given.set_item("late", column(py, commands.late)?)?;
        py.import("palpate._journal")?.getattr("Commands")?.call((), Some(&given))
    }

    /// Simulates the recording again, and compares every hash and snapshot. Returns the verdict.
    fn verify<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let verified = work(py, |stop| {
            let mut reader = self.open()?;
            let survey = reader.survey(&mut |_| {})?;
            let steps = [reader.header().begin_step, survey.until_step];
            let mut replay = journal::Replay::new(reader, survey, &limits())?;
            replay.advance(u64::MAX, &mut |_| if stop.load(Ordering::Relaxed) { Err(given_up()) } else { Ok(()) })?;
            Ok((steps, replay.compared(), replay.difference().cloned()))
        })?;
        let ([begin, end], [hashes, snapshots], difference) = verified.map_err(refused)?;
        let text = difference.as_ref().map(ToString::to_string);
        let step = difference.map(|difference| difference.step);
        let made = py.import("palpate._journal")?.getattr("Verdict")?;
        made.call1((begin, end, hashes, snapshots, step, text))
    }

    /// Returns the session after `step` steps; at the end of the recording if None.
    #[pyo3(signature = (step=None))]
    fn session(&self, py: Python<'_>, step: Option<u64>) -> PyResult<Session> {
        let step = step.unwrap_or(self.survey.until_step);
        let found = work(py, |stop| replay::session_at(self.open()?, &limits(), step, stop))?;
        let (session, first) = found.map_err(refused)?;
        Ok(Session::of(SessionState::of(session, first.scene.clone())))
    }

    fn __repr__(&self) -> String {
        let Journal { path, header, survey } = self;
        format!(
            "<palpate.Journal {:?}: steps {} to {}>",
            path.display().to_string(),
            header.begin_step,
            survey.until_step
        )
    }
}
