//! A session in this process: a tissue and its tools, stepped as fast as the machine can.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use glam::DVec3;
use palpate_refusal::Refusal;
use palpate_session as session;
use palpate_session::simulation::Simulation;
use palpate_session::snapshot::Saved;
use palpate_tissue::Model;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::{Action, PlaceMark};
use palpate_tissue::scene::tie::{Bite, Tie, TieKind};
use palpate_tissue::scene::{self, Change};
use palpate_tissue::shape::PointId;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

use crate::arrays::{OF_POINT, add_point, column, records, rows, vector, write_into};
use crate::error::{failed, refused, wrong};
use crate::scene::{Scene, Tissue, limits, point};
use crate::tip::Tip;
use crate::waiting::LOOK;

/// The target of a posed tool, until it is released or gets another kind of command.
#[derive(Debug, Clone, Copy)]
struct PoseTarget {
    place_m: DVec3,
    tip: palpate_haptics::Tip,
}

/// A simulation with the state that a client would keep.
pub(crate) struct SessionState {
    simulation: Simulation,
    /// The scene with which the session started: changes are based on it.
    first: scene::Scene,
    /// Tips of the tools that were in the tissue when the session was restored, until their next command.
    tips: BTreeMap<u32, palpate_haptics::Tip>,
    led: BTreeMap<u32, PoseTarget>,
}

impl SessionState {
    pub(crate) fn of(session: session::Session, first: scene::Scene) -> Self {
        let tips = session.tips().collect();
        let simulation = Simulation::of(session, &first, &limits());
        SessionState { simulation, first, tips, led: BTreeMap::new() }
    }

    /// Gives a tool a command, which acts from the next step on.
    fn submit(&mut self, tool: u32, action: Action) -> Result<(), Refusal> {
        self.simulation.command(tool, action.clone())?;
        // A thread, clip or mark leaves the tool as it is.
        if matches!(action, Action::Tie { .. } | Action::Mark(_)) {
            return Ok(());
        }
        self.tips.remove(&tool);
        match action {
            Action::Pose { place_m, tip, .. } => self.led.insert(tool, PoseTarget { place_m, tip }),
            _ => self.led.remove(&tool),
        };
        Ok(())
    }

    fn step(&mut self) -> Result<(), Refusal> {
        // A tool without new poses would let go; these tools are to stay.
        let led: Vec<(u32, PoseTarget)> = self.led.iter().map(|(tool, led)| (*tool, *led)).collect();
        for (tool, PoseTarget { place_m, tip }) in led {
            self.submit(tool, Action::Pose { place_m, velocity_m_per_s: None, tip })?;
        }
        let recoveries = self.simulation.session.recoveries().count();
        self.simulation.step(0)?;
        if self.simulation.session.recoveries().count() > recoveries {
            self.led.clear();
        }
        Ok(())
    }
}

/// A simulated tissue. A tool's command acts from the next step on, until its next command. Several threads may use
/// one session; the interpreter's lock is released while it steps.
#[pyclass(frozen, module = "palpate")]
pub(crate) struct Session {
    inner: Mutex<SessionState>,
}

impl Session {
    pub(crate) fn of(inner: SessionState) -> Self {
        Session { inner: Mutex::new(inner) }
    }

    /// Runs `work` on the session without the interpreter's lock: another thread may use the session for long.
    fn with<T: Send>(&self, py: Python<'_>, work: impl FnOnce(&mut SessionState) -> T + Send) -> T {
        py.detach(|| work(&mut self.inner.lock().unwrap_or_else(PoisonError::into_inner)))
    }

    fn submit(&self, py: Python<'_>, tool: u32, action: Action) -> PyResult<()> {
        self.with(py, |inner| inner.submit(tool, action)).map_err(refused)
    }
}

#[pymethods]
impl Session {
    #[new]
    fn new(py: Python<'_>, tissue: &Bound<'_, PyAny>) -> PyResult<Self> {
        let model = Tissue::given(py, tissue)?;
        Ok(Session::of(py.detach(|| SessionState::of(session::Session::new(&model), model.scene.clone()))))
    }

    /// Restores a session from `save()` that started with `scene`: tools stay where they are, with their tips.
    #[staticmethod]
    fn restore(py: Python<'_>, scene: &Bound<'_, PyAny>, snapshot: &[u8]) -> PyResult<Self> {
        let scene = match scene.cast::<Tissue>() {
            Ok(tissue) => tissue.get().model.scene.clone(),
            Err(_) => Scene::given(scene)?.get().scene.clone(),
        };
        let restored = py.detach(|| {
            let saved = Saved::from_bytes(snapshot, &limits())?;
            let model = Model::resumed(&scene, saved.tissue(), &limits())?;
            Ok(SessionState::of(session::Session::restore(&model, &saved)?, scene))
        });
        restored.map(Session::of).map_err(refused)
    }

    /// Does `steps` steps. Raises Failed if the tissue can't continue. Ctrl-C ends it between two steps.
    #[pyo3(signature = (steps=1))]
    fn step(&self, py: Python<'_>, steps: u64) -> PyResult<()> {
        let mut left = steps;
        loop {
            let reason = self.with(py, |inner| {
                let begun = Instant::now();
                while left > 0 && inner.simulation.session.hold_reason().is_none() && begun.elapsed() < LOOK {
                    inner.step()?;
                    left -= 1;
                }
                Ok(inner.simulation.session.hold_reason().map(str::to_owned))
            });
            if let Some(reason) = reason.map_err(refused)? {
                return Err(failed(&reason));
            }
            if left == 0 {
                return Ok(());
            }
            py.check_signals()?;
        }
    }

    /// Number of steps done.
    #[getter]
    fn steps(&self, py: Python<'_>) -> u64 {
        self.with(py, |inner| inner.simulation.session.step_count())
    }

    /// Simulated time, s.
    #[getter]
    fn time_s(&self, py: Python<'_>) -> f64 {
        self.with(py, |inner| inner.simulation.session.time_s())
    }

    /// The tissue, with its current coefficients.
    #[getter]
    fn tissue(&self, py: Python<'_>) -> Tissue {
        self.with(py, |inner| Tissue { model: inner.simulation.session.model().clone() })
    }

    /// Number of points that the last step computed; the others are at rest.
    #[getter]
    fn awake_points(&self, py: Python<'_>) -> usize {
        self.with(py, |inner| inner.simulation.session.tissue().awake_points())
    }

    /// How often the guard went back to a checkpoint and halved the substep, or brought a solid that rested
    /// inside out to its shape.
    #[getter]
    fn guard_events(&self, py: Python<'_>) -> u64 {
        self.with(py, |inner| inner.simulation.session.tissue().guard_events())
    }

    /// The number of springs that blades have severed.
    #[getter]
    fn severed(&self, py: Python<'_>) -> usize {
        self.with(py, |inner| inner.simulation.session.tissue().cuts().len())
    }

    /// The number of parts of the tissue: 1 if it is whole.
    #[getter]
    fn pieces(&self, py: Python<'_>) -> usize {
        self.with(py, |inner| {
            let tissue = inner.simulation.session.tissue();
            tissue.cuts().pieces(tissue.model())
        })
    }

    /// The energy that has gone into separation, J: the work of blades at their edges, and what severed springs had stored.
    #[getter]
    fn fracture_j(&self, py: Python<'_>) -> f64 {
        self.with(py, |inner| inner.simulation.session.tissue().cuts().fracture_j())
    }

    /// Why the tissue is not in the state that its tools caused, as a sentence: it is stopped, or has recovered. None
    /// if it is.
    #[getter]
    fn fault(&self, py: Python<'_>) -> Option<String> {
        self.with(py, |inner| inner.simulation.session.fault())
    }

    /// The hash of the state: equal for equal bits.
    #[getter]
    fn hash(&self, py: Python<'_>) -> String {
        self.with(py, |inner| format!("{:032x}", inner.simulation.session.tissue().state_hash()))
    }

    /// Pushes at a point or a place; at a distance r from there with force_n * exp(-falloff_per_m * r +
    /// falloff_offset).
    #[pyo3(signature = (tool, force_n, *, point=None, at_m=None, falloff_per_m=200.0, falloff_offset=0.0))]
    #[allow(clippy::too_many_arguments)]
    fn push(
        &self,
        py: Python<'_>,
        tool: u32,
        force_n: &Bound<'_, PyAny>,
        point: Option<&Bound<'_, PyAny>>,
        at_m: Option<&Bound<'_, PyAny>>,
        falloff_per_m: f64,
        falloff_offset: f64,
    ) -> PyResult<()> {
        let model = self.with(py, |inner| inner.simulation.session.model().clone());
        let force_n = vector("force_n", force_n)?;
        let (point, centre_m) = match (point, at_m) {
            (Some(point), None) => {
                let point = self::point(&model, point)?;
                (Some(point), model.shape().rest_m(point))
            }
            (None, Some(at_m)) => (None, vector("at_m", at_m)?),
            _ => return Err(wrong("point", "give either a point or a place, at_m")),
        };
        self.submit(py, tool, Action::Push(Poke { point, centre_m, force_n, falloff_per_m, falloff_offset }))
    }

    /// Holds a point, and moves it to this displacement from its place at rest by the end of the step.
    fn grasp(
        &self,
        py: Python<'_>,
        tool: u32,
        point: &Bound<'_, PyAny>,
        displacement_m: &Bound<'_, PyAny>,
    ) -> PyResult<()> {
        let model = self.with(py, |inner| inner.simulation.session.model().clone());
        let point = self::point(&model, point)?;
        let displacement_m = vector("displacement_m", displacement_m)?;
        self.submit(py, tool, Action::Grasp { point, displacement_m })
    }

    /// Moves a tool with a tip to `place_m` by the end of the step. It stays there until its next command.
    #[pyo3(signature = (tool, place_m, tip=None))]
    fn pose(&self, py: Python<'_>, tool: u32, place_m: &Bound<'_, PyAny>, tip: Option<Tip>) -> PyResult<()> {
        let place_m = vector("place_m", place_m)?;
        let known = self.with(py, |inner| inner.led.get(&tool).map(|led| led.tip).or(inner.tips.get(&tool).copied()));
        let tip = tip.map(|tip| tip.0).or(known).unwrap_or_default();
        self.submit(py, tool, Action::Pose { place_m, velocity_m_per_s: None, tip })
    }

    /// Lays thread `number` through bites at these places of the tissue at rest, in their order, or changes its length, friction or
    /// strength if it has these bites already. It has `length_m` from the first bite to the last, is drawn in at the last by at most
    /// 0.1 m/s, and breaks beyond a tension of `strength_n`. It stays when the tool, which does what it did, is released.
    #[pyo3(signature = (tool, number, bites_m, length_m, *, radius_m=0.001, friction=0.0, strength_n=None))]
    #[allow(clippy::too_many_arguments)]
    fn thread(
        &self,
        py: Python<'_>,
        tool: u32,
        number: u32,
        bites_m: Vec<Bound<'_, PyAny>>,
        length_m: f64,
        radius_m: f64,
        friction: f64,
        strength_n: Option<f64>,
    ) -> PyResult<()> {
        let tie = Tie { bites: bites(&bites_m, radius_m)?, kind: TieKind::Thread { length_m, friction }, strength_n };
        self.submit(py, tool, Action::Tie { number, tie: Some(tie) })
    }

    /// Closes clip `number` on two places of the tissue at rest, and holds them together; it opens beyond a force of `strength_n`.
    /// Threads and clips share their numbers. It stays when the tool, which does what it did, is released.
    #[pyo3(signature = (tool, number, bites_m, *, radius_m=0.001, strength_n=None))]
    fn clip(
        &self,
        py: Python<'_>,
        tool: u32,
        number: u32,
        bites_m: Vec<Bound<'_, PyAny>>,
        radius_m: f64,
        strength_n: Option<f64>,
    ) -> PyResult<()> {
        let tie = Tie { bites: bites(&bites_m, radius_m)?, kind: TieKind::Clip, strength_n };
        self.submit(py, tool, Action::Tie { number, tie: Some(tie) })
    }

    /// Marks a place of the surface, m, as an answer in an exercise: what you look for is there, or below it, and has about this
    /// diameter, m. It changes nothing, and the tool does what it did.
    #[pyo3(signature = (tool, place_m, *, diameter_m=None))]
    fn mark(&self, py: Python<'_>, tool: u32, place_m: &Bound<'_, PyAny>, diameter_m: Option<f64>) -> PyResult<()> {
        let place_m = vector("place_m", place_m)?;
        self.submit(py, tool, Action::Mark(PlaceMark { place_m, diameter_m }))
    }

    /// Cuts a thread or clip, and takes it out.
    fn untie(&self, py: Python<'_>, tool: u32, number: u32) -> PyResult<()> {
        self.submit(py, tool, Action::Tie { number, tie: None })
    }

    /// The threads and clips by their number, those that broke included: a dictionary for each, with `tensions_n` between successive bites
    /// in the last step, the largest so far, `peak_n`, the thread's `length_m`, `path_m`, the distances between its bites in all, and
    /// `is_broken`.
    #[getter]
    fn ties<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let all = PyDict::new(py);
        for state in self.with(py, |inner| inner.simulation.session.tissue().ties()) {
            let of = PyDict::new(py);
            of.set_item("tensions_n", state.tensions_n)?;
            of.set_item("peak_n", state.peak_n)?;
            of.set_item("length_m", state.length_m)?;
            of.set_item("path_m", state.path_m)?;
            of.set_item("is_broken", state.is_broken)?;
            all.set_item(state.number, of)?;
        }
        Ok(all)
    }

    /// Ends what a tool does.
    fn release(&self, py: Python<'_>, tool: u32) -> PyResult<()> {
        self.submit(py, tool, Action::Release)
    }

    /// Returns what a tool does and feels; None if it does nothing.
    fn tool<'py>(&self, py: Python<'py>, tool: u32) -> PyResult<Option<Bound<'py, PyAny>>> {
        let sample = self.with(py, |inner| inner.simulation.session.sample(Some(&[tool])));
        let Some(contact) = sample.tools.first().and_then(|tool| tool.contact) else { return Ok(None) };
        let numbers = [
            contact.displacement_m,
            contact.surface_displacement_m,
            contact.velocity_m_per_s,
            contact.force_on_tool_n,
            contact.applied_force_n,
        ];
        let made = py.import("palpate._arrays")?.getattr("tool_state")?;
        // −0 becomes 0, as in records.
        let numbers: Vec<f64> = numbers.iter().flat_map(|v| (*v + DVec3::ZERO).to_array()).collect();
        made.call1((rows(py, numbers)?,)).map(Some)
    }

    /// Makes the tissue softer or stiffer from the next step on. Coefficients that are not given stay as they are.
    #[pyo3(signature = (*, stiffness_n_per_m=None, damping_n_s_per_m=None, anchor_stiffness_n_per_m=None, volume_stiffness_pa=None))]
    fn change(
        &self,
        py: Python<'_>,
        stiffness_n_per_m: Option<f64>,
        damping_n_s_per_m: Option<f64>,
        anchor_stiffness_n_per_m: Option<f64>,
        volume_stiffness_pa: Option<f64>,
    ) -> PyResult<()> {
        let change = Change { stiffness_n_per_m, damping_n_s_per_m, anchor_stiffness_n_per_m, volume_stiffness_pa };
        let changed = self.with(py, |inner| {
            let model = inner.simulation.session.model().changed(&change, &inner.first, &limits())?;
            inner.simulation.session.change(&model);
            Ok(())
        });
        changed.map_err(refused)
    }

    /// Returns the displacement of each point from its place at rest, m, with at least the digits of f32; `records`
    /// has all digits. `out` is an array to write into.
    #[pyo3(signature = (out=None))]
    fn displacements<'py>(&self, py: Python<'py>, out: Option<Bound<'py, PyAny>>) -> PyResult<Bound<'py, PyAny>> {
        let read = |inner: &mut SessionState, into: &mut Vec<f64>| {
            inner.simulation.session.tissue().whole_displacements_m(into);
        };
        self.read(py, out, &read)
    }

    /// Returns the position of each point, m. `out` is an array to write into.
    #[pyo3(signature = (out=None))]
    fn positions<'py>(&self, py: Python<'py>, out: Option<Bound<'py, PyAny>>) -> PyResult<Bound<'py, PyAny>> {
        let read = |inner: &mut SessionState, into: &mut Vec<f64>| {
            inner.simulation.session.tissue().whole_displacements_m(into);
            let model = inner.simulation.session.model();
            let shape = model.shape();
            let rest_m = model.points().flat_map(|point| shape.rest_m(point).to_array());
            into.iter_mut().zip(rest_m).for_each(|(to, rest_m)| *to += rest_m);
        };
        self.read(py, out, &read)
    }

    /// Returns the velocity of each point, m/s. `out` is an array to write into.
    #[pyo3(signature = (out=None))]
    fn velocities<'py>(&self, py: Python<'py>, out: Option<Bound<'py, PyAny>>) -> PyResult<Bound<'py, PyAny>> {
        let read = |inner: &mut SessionState, into: &mut Vec<f64>| {
            let (tissue, points) = (inner.simulation.session.tissue(), inner.simulation.session.model().points());
            into.clear();
            into.extend(points.flat_map(|point| (tissue.point(point).velocity_m_per_s + DVec3::ZERO).to_array()));
        };
        self.read(py, out, &read)
    }

    /// Returns how burnt each point is by cautery: the time of contact divided by that in which it burns through, 0 to 1.
    /// In a solid that of the most burnt cell around the point.
    fn burns<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let burns = self.with(py, |inner| {
            let tissue = inner.simulation.session.tissue();
            let mut burns = vec![0.0_f64; tissue.model().len()];
            tissue.burns().points(tissue.model()).for_each(|burnt| burns[burnt.point.index()] = burnt.burn);
            burns
        });
        column(py, burns)
    }

    /// Returns records of all quantities of the given points, as in `Run.points`; of all points if None.
    #[pyo3(signature = (points=None))]
    fn records<'py>(&self, py: Python<'py>, points: Option<Vec<Bound<'py, PyAny>>>) -> PyResult<Bound<'py, PyAny>> {
        let model = self.with(py, |inner| inner.simulation.session.model().clone());
        let points =
            points.map(|points| points.iter().map(|name| point(&model, name)).collect::<PyResult<Vec<PointId>>>());
        let points = points.transpose()?;
        let numbers = self.with(py, |inner| {
            let record = inner.simulation.session.record(points.as_deref());
            let mut numbers = Vec::with_capacity(record.points.len() * OF_POINT);
            record.points.iter().for_each(|point| add_point(&mut numbers, point));
            numbers
        });
        let count = numbers.len() / OF_POINT;
        records(py, numbers, "POINT", &[count])
    }

    /// The energy of the tissue, J: kinetic, spring and virtual.
    #[getter]
    fn energy_j<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let energy = self.with(py, |inner| inner.simulation.session.energy());
        let found = PyDict::new(py);
        found.set_item("kinetic", energy.kinetic)?;
        found.set_item("spring", energy.spring)?;
        found.set_item("virtual", energy.anchor_springs)?;
        Ok(found)
    }

    /// Returns a snapshot, for `restore`.
    fn save<'py>(&self, py: Python<'py>) -> Bound<'py, PyBytes> {
        let bytes = self.with(py, |inner| inner.simulation.session.save().to_bytes());
        PyBytes::new(py, &bytes)
    }

    fn __repr__(&self, py: Python<'_>) -> String {
        let (name, steps) = self.with(py, |inner| (inner.first.name.clone(), inner.simulation.session.step_count()));
        format!("<palpate.Session of {name:?}: {steps} steps>")
    }
}

impl Session {
    /// Writes vectors of all points to the caller's array or a new one.
    fn read<'py>(
        &self,
        py: Python<'py>,
        out: Option<Bound<'py, PyAny>>,
        read: &(dyn Fn(&mut SessionState, &mut Vec<f64>) + Sync),
    ) -> PyResult<Bound<'py, PyAny>> {
        let mut numbers = Vec::new();
        self.with(py, |inner| read(inner, &mut numbers));
        let Some(out) = out else { return rows(py, numbers) };
        write_into(py, &out, numbers)?;
        Ok(out)
    }
}

/// Returns the bites at some places, all with the same radius.
fn bites(places_m: &[Bound<'_, PyAny>], radius_m: f64) -> PyResult<Vec<Bite>> {
    places_m.iter().map(|place_m| Ok(Bite { place_m: vector("bites_m", place_m)?, radius_m })).collect()
}
