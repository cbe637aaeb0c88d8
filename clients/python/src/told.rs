//! Messages of a server about a session, converted for Python.

use std::collections::BTreeMap;

use palpate_client::bridge::BridgeReport;
use palpate_haptics::{LimitCause, RenderingState};
use palpate_proto::geometry::from_vector;
use palpate_proto::pb;
use pyo3::exceptions::PyRuntimeWarning;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};

use crate::arrays::{column, rows, shaped};

/// The state of a session.
#[derive(IntoPyObject)]
pub(crate) struct Status {
    session_id: String,
    scene: String,
    state: &'static str,
    step: u64,
    time_s: f64,
    points: u32,
    integrator: String,
    substeps: u32,
    precision: String,
    time_dilation: f64,
    overrun_steps: u64,
    late_commands: u64,
    recoveries: u64,
    awake_points: u32,
    topology_version: u32,
    severed: u32,
    severed_anchors: u32,
    pieces: u32,
    cuts_exhausted: bool,
    ties: BTreeMap<u32, TieStatus>,
    resting: bool,
    hold_reason: String,
    held_tools: Vec<(u32, String)>,
    middle_m: (f64, f64, f64),
    top_m: (f64, f64, f64),
    warnings: Vec<String>,
}

/// A thread or clip of a session.
#[derive(IntoPyObject)]
struct TieStatus {
    tension_n: f64,
    length_m: f64,
    path_m: f64,
    is_broken: bool,
}

impl TieStatus {
    /// Returns it with its number.
    fn of(laid: pb::LaidTie) -> (u32, Self) {
        let pb::LaidTie { tie, length_m, path_m, tension_n, broken } = laid;
        (tie.map_or(0, |tie| tie.number), TieStatus { tension_n, length_m, path_m, is_broken: broken })
    }
}

impl Status {
    pub(crate) fn of(session: pb::Session) -> Self {
        let state = match session.state() {
            pb::SessionState::Running => "running",
            pb::SessionState::Paused => "paused",
            pb::SessionState::Held => "held",
            pb::SessionState::Unspecified => "unknown",
        };
        let extent = session.extent.unwrap_or_default();
        let [middle_m, top_m] =
            [extent.middle_m.as_ref(), extent.top_m.as_ref().or(extent.middle_m.as_ref())].map(from_vector);
        Status {
            session_id: session.session_id,
            scene: session.scene_name,
            state,
            step: session.step,
            time_s: session.simulation_time_s,
            points: session.points,
            integrator: session.integrator,
            substeps: session.substeps,
            precision: session.precision,
            time_dilation: session.time_dilation,
            overrun_steps: session.overrun_count,
            late_commands: session.late_commands,
            recoveries: session.recovery_count,
            awake_points: session.awake_points,
            topology_version: session.topology_version,
            severed: session.severed,
            severed_anchors: session.severed_anchors,
            pieces: session.pieces,
            cuts_exhausted: session.cuts_exhausted,
            ties: session.ties.into_iter().map(TieStatus::of).collect(),
            resting: session.resting,
            hold_reason: session.hold_reason,
            held_tools: session.held_tools.into_iter().map(|held| (held.tool, held.holder)).collect(),
            middle_m: middle_m.into(),
            top_m: top_m.into(),
            warnings: session.warnings,
        }
    }
}

/// Bytes for Python.
pub(crate) struct Bytes(pub(crate) Vec<u8>);

impl<'py> IntoPyObject<'py> for Bytes {
    type Target = PyBytes;
    type Output = Bound<'py, PyBytes>;
    type Error = PyErr;

    fn into_pyobject(self, py: Python<'py>) -> PyResult<Self::Output> {
        Ok(PyBytes::new(py, &self.0))
    }
}

/// The constant part of a surface.
#[derive(Default)]
pub(crate) struct SurfaceMesh {
    pub(crate) grid: (u32, u32),
    pub(crate) rest_m: Vec<f32>,
    pub(crate) uv: Vec<f32>,
    pub(crate) triangles: Vec<u32>,
    pub(crate) file_vertex: Vec<u32>,
}

impl<'py> IntoPyObject<'py> for SurfaceMesh {
    type Target = PyDict;
    type Output = Bound<'py, PyDict>;
    type Error = PyErr;

    fn into_pyobject(self, py: Python<'py>) -> PyResult<Self::Output> {
        let found = PyDict::new(py);
        found.set_item("grid", self.grid)?;
        found.set_item("rest_m", shaped(py, self.rest_m, &[3])?)?;
        found.set_item("uv", shaped(py, self.uv, &[2])?)?;
        found.set_item("triangles", shaped(py, self.triangles, &[3])?)?;
        found.set_item("file_vertex", column(py, self.file_vertex)?)?;
        Ok(found)
    }
}

/// The results of touching with a device.
pub(crate) struct Touched(pub(crate) BridgeReport);

impl<'py> IntoPyObject<'py> for Touched {
    type Target = PyAny;
    type Output = Bound<'py, PyAny>;
    type Error = PyErr;

    fn into_pyobject(self, py: Python<'py>) -> PyResult<Self::Output> {
        if let Some(why) = self.0.unfelt() {
            let text = std::ffi::CString::new(why)?;
            PyErr::warn(py, &py.get_type::<PyRuntimeWarning>(), &text, 1)?;
        }
        let BridgeReport {
            course,
            ages_s,
            envelope,
            late_ticks,
            missed_ticks,
            predicted_ticks,
            most_torque_n_m,
            traffic,
            lost,
            ..
        } = self.0;
        let found = PyDict::new(py);
        let place_m = course.iter().flat_map(|tick| tick.place_m.to_array()).collect();
        let force_n = course.iter().flat_map(|tick| tick.force_n.to_array()).collect();
        let enabled: Vec<bool> = course.iter().map(|tick| tick.state == Some(RenderingState::Enabled)).collect();
        let time_s: Vec<f64> = course.iter().map(|tick| tick.time_s).collect();
        found.set_item("time_s", column(py, time_s)?)?;
        found.set_item("place_m", rows(py, place_m)?)?;
        found.set_item("force_n", rows(py, force_n)?)?;
        found.set_item("enabled", column(py, enabled)?)?;
        found.set_item("ages_s", column(py, ages_s)?)?;
        found.set_item("late_ticks", late_ticks)?;
        found.set_item("missed_ticks", missed_ticks)?;
        found.set_item("predicted_ticks", predicted_ticks)?;
        found.set_item("connections", traffic.connections)?;
        found.set_item("failed_attempts", traffic.failed)?;
        found.set_item("samples", traffic.samples)?;
        found.set_item("poses", traffic.poses)?;
        found.set_item("refused", traffic.refused)?;
        found.set_item("jaw_overloads", traffic.jaw_overloads)?;
        found.set_item("datagrams_up", traffic.carried.sent)?;
        found.set_item("datagrams_down", traffic.carried.came)?;
        let limits = PyDict::new(py);
        for (cause, name) in LimitCause::ALL.iter().filter(|_| envelope.is_some()) {
            limits.set_item(*name, envelope.as_ref().map_or(0, |envelope| envelope.count(*cause).0))?;
        }
        found.set_item("limits", limits)?;
        found.set_item("energy_j", envelope.as_ref().map_or(0.0, palpate_haptics::Envelope::energy_j))?;
        found.set_item("lost", lost.map(|error| error.to_string()))?;
        found.set_item("largest_torque_n_m", most_torque_n_m)?;
        py.import("palpate._touch")?.getattr("Touched")?.call((), Some(&found))
    }
}
