//! A client of a server. Each call gives its result at once, or something to await: `awaited` says which, and is handed on from
//! the connection to what it makes.

use std::sync::Arc;
use std::time::Duration;

use palpate::wire;
use palpate_client::bridge::{self, Options, Report, Target};
use palpate_client::{Channel, Credentials, Token, view, watch};
use palpate_proto::geometry::from_vector;
use palpate_proto::pb;
use palpate_touch::{LimitCause, RenderingState};
use pb::session_service_client::SessionServiceClient;
use pb::view_service_client::ViewServiceClient;
use pyo3::exceptions::{PyStopAsyncIteration, PyStopIteration};
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use tokio::sync::{Mutex, oneshot};

use crate::arrays::{column, records, rows, shaped};
use crate::device::Given;
use crate::error::{of_client, of_status, wrong};
use crate::scene::Scene;
use crate::tip::Tip;
use crate::waiting::{answer, answer_in_order};

/// What a call gives that gives nothing: `None`.
const NOTHING: Option<bool> = None;

/// A number of seconds that may pass.
fn duration(field: &str, seconds: f64) -> PyResult<Duration> {
    Duration::try_from_secs_f64(seconds)
        .map_err(|_| wrong(field, format!("must be a number of seconds, but is {seconds}")))
}

/// A connection to a server.
#[pyclass(frozen, module = "palpate")]
pub(crate) struct Server {
    server: palpate_client::Server,
    channel: Channel,
    awaited: bool,
}

impl Server {
    fn sessions(&self) -> SessionServiceClient<Channel> {
        SessionServiceClient::new(self.channel.clone())
    }

    fn session_of(&self, id: String) -> RemoteSession {
        RemoteSession { id, server: self.server.clone(), channel: self.channel.clone(), awaited: self.awaited }
    }
}

#[pymethods]
impl Server {
    #[staticmethod]
    #[pyo3(signature = (url, *, token=None, ca=None, tls_name=None, cert=None, key=None, within_s=10.0, awaited=false))]
    #[allow(clippy::too_many_arguments)]
    fn connect<'py>(
        py: Python<'py>,
        url: &str,
        token: Option<&str>,
        ca: Option<String>,
        tls_name: Option<String>,
        cert: Option<String>,
        key: Option<String>,
        within_s: f64,
        awaited: bool,
    ) -> PyResult<Bound<'py, PyAny>> {
        let cert_and_key = match (cert, key) {
            (None, None) => None,
            (Some(cert), Some(key)) => Some((cert, key)),
            _ => return Err(wrong("cert", "goes with a key, and a key with it")),
        };
        let token = token.map(Token::new).transpose().map_err(of_client)?;
        let credentials = Credentials { token, ca, tls_name, cert_and_key };
        let server = palpate_client::Server::new(url, &credentials).map_err(of_client)?;
        let server = server.within(duration("within_s", within_s)?);
        answer(py, awaited, async move {
            let channel = server.connect().await.map_err(of_client)?;
            Ok(Server { server, channel, awaited })
        })
    }

    fn scenes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let mut sessions = self.sessions();
        answer(py, self.awaited, async move {
            let found = sessions.list_scenes(pb::ListScenesRequest {}).await.map_err(of_status)?;
            Ok(found.into_inner().scene_names)
        })
    }

    #[pyo3(name = "sessions")]
    fn sessions_there<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let mut sessions = self.sessions();
        answer(py, self.awaited, async move {
            let found = sessions.list_sessions(pb::ListSessionsRequest {}).await.map_err(of_status)?;
            Ok(found.into_inner().sessions.into_iter().map(Status::of).collect::<Vec<_>>())
        })
    }

    #[pyo3(signature = (scene, *, paused=false, idle_timeout_s=None))]
    fn create_session<'py>(
        &self,
        py: Python<'py>,
        scene: &Bound<'py, PyAny>,
        paused: bool,
        idle_timeout_s: Option<f64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        use pb::create_session_request::Source;
        let source = match scene.cast::<Scene>() {
            Ok(scene) => {
                let scene = &scene.get().scene;
                if scene.sheet().is_none() {
                    return Err(wrong("scene", "is of a mesh: give the name of a scene that the server has"));
                }
                Source::Scene(wire::scene::sent(scene))
            }
            Err(_) => Source::SceneName(scene.extract().map_err(|_| {
                wrong("scene", "must be the name of a scene that the server has, or a palpate.Scene of a sheet")
            })?),
        };
        let request = pb::CreateSessionRequest { source: Some(source), paused, idle_timeout_s };
        let mut sessions = self.sessions();
        let made = self.session_of(String::new());
        answer(py, self.awaited, async move {
            let found = sessions.create_session(request).await.map_err(of_status)?;
            let id = found.into_inner().session.map(|session| session.session_id).unwrap_or_default();
            Ok(RemoteSession { id, ..made })
        })
    }

    fn session<'py>(&self, py: Python<'py>, session_id: String) -> PyResult<Bound<'py, PyAny>> {
        let (mut sessions, made) = (self.sessions(), self.session_of(session_id.clone()));
        answer(py, self.awaited, async move {
            // Refused if there is none.
            sessions.get_session(pb::GetSessionRequest { session_id }).await.map_err(of_status)?;
            Ok(made)
        })
    }

    fn __repr__(&self) -> String {
        format!("<palpate.Client of {:?}>", self.server)
    }
}

/// How a session stands.
#[derive(IntoPyObject)]
struct Status {
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
    resting: bool,
    hold_reason: String,
    held_tools: Vec<(u32, String)>,
    middle_m: (f64, f64, f64),
    warnings: Vec<String>,
}

impl Status {
    fn of(session: pb::Session) -> Self {
        let state = match session.state() {
            pb::SessionState::Running => "running",
            pb::SessionState::Paused => "paused",
            pb::SessionState::Held => "held",
            pb::SessionState::Unspecified => "unknown",
        };
        let middle_m = from_vector(session.extent.as_ref().and_then(|extent| extent.middle_m.as_ref()));
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
            resting: session.resting,
            hold_reason: session.hold_reason,
            held_tools: session.held_tools.into_iter().map(|held| (held.tool, held.holder)).collect(),
            middle_m: (middle_m.x, middle_m.y, middle_m.z),
            warnings: session.warnings,
        }
    }
}

/// A session of a server.
#[pyclass(frozen, module = "palpate")]
pub(crate) struct RemoteSession {
    id: String,
    server: palpate_client::Server,
    channel: Channel,
    awaited: bool,
}

impl RemoteSession {
    fn sessions(&self) -> SessionServiceClient<Channel> {
        SessionServiceClient::new(self.channel.clone())
    }
}

#[pymethods]
impl RemoteSession {
    #[getter]
    fn id(&self) -> &str {
        &self.id
    }

    fn status<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (mut sessions, session_id) = (self.sessions(), self.id.clone());
        answer(py, self.awaited, async move {
            let found = sessions.get_session(pb::GetSessionRequest { session_id }).await;
            let found = found.map_err(of_status)?.into_inner();
            Ok(Status::of(found.session.unwrap_or_default()))
        })
    }

    #[pyo3(signature = (*, until_step=None))]
    fn start<'py>(&self, py: Python<'py>, until_step: Option<u64>) -> PyResult<Bound<'py, PyAny>> {
        let (mut sessions, session_id) = (self.sessions(), self.id.clone());
        answer(py, self.awaited, async move {
            let found = sessions.start_session(pb::StartSessionRequest { session_id, until_step }).await;
            Ok(found.map_err(of_status)?.into_inner().step)
        })
    }

    fn pause<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (mut sessions, session_id) = (self.sessions(), self.id.clone());
        answer(py, self.awaited, async move {
            let found = sessions.pause_session(pb::PauseSessionRequest { session_id }).await;
            found.map(|_| NOTHING).map_err(of_status)
        })
    }

    #[pyo3(signature = (*, stiffness_n_per_m=None, damping_n_s_per_m=None, virtual_stiffness_n_per_m=None,
        volume_stiffness_pa=None, at_step=None))]
    fn change<'py>(
        &self,
        py: Python<'py>,
        stiffness_n_per_m: Option<f64>,
        damping_n_s_per_m: Option<f64>,
        virtual_stiffness_n_per_m: Option<f64>,
        volume_stiffness_pa: Option<f64>,
        at_step: Option<u64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let (mut sessions, session_id) = (self.sessions(), self.id.clone());
        let request = pb::UpdateTissueRequest {
            session_id,
            stiffness_n_per_m,
            damping_n_s_per_m,
            virtual_stiffness_n_per_m,
            volume_stiffness_pa,
            at_step,
        };
        answer(py, self.awaited, async move {
            let found = sessions.update_tissue(request).await;
            Ok(found.map_err(of_status)?.into_inner().step)
        })
    }

    #[pyo3(signature = (*, at_step=None))]
    fn hash<'py>(&self, py: Python<'py>, at_step: Option<u64>) -> PyResult<Bound<'py, PyAny>> {
        let (mut sessions, session_id) = (self.sessions(), self.id.clone());
        answer(py, self.awaited, async move {
            let found = sessions.get_state_hash(pb::GetStateHashRequest { session_id, at_step }).await;
            let found = found.map_err(of_status)?.into_inner();
            Ok((found.step, found.state_hash))
        })
    }

    fn save<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (mut sessions, session_id) = (self.sessions(), self.id.clone());
        answer(py, self.awaited, async move {
            let parts = sessions.save_snapshot(pb::SaveSnapshotRequest { session_id }).await;
            let mut parts = parts.map_err(of_status)?.into_inner();
            let mut bytes = Vec::new();
            while let Some(part) = parts.message().await.map_err(of_status)? {
                bytes.extend_from_slice(&part.part);
            }
            Ok(Bytes(bytes))
        })
    }

    fn delete<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (mut sessions, session_id) = (self.sessions(), self.id.clone());
        answer(py, self.awaited, async move {
            let found = sessions.delete_session(pb::DeleteSessionRequest { session_id }).await;
            found.map(|_| NOTHING).map_err(of_status)
        })
    }

    #[pyo3(signature = (*, every_steps=1, heartbeat_s=None))]
    fn samples<'py>(&self, py: Python<'py>, every_steps: u32, heartbeat_s: Option<f64>) -> PyResult<Bound<'py, PyAny>> {
        let request = pb::WatchSamplesRequest {
            session_id: self.id.clone(),
            sample_every_steps: Some(every_steps),
            heartbeat_s,
            ..Default::default()
        };
        let (channel, awaited) = (self.channel.clone(), self.awaited);
        answer(py, awaited, async move {
            let samples = watch::Samples::open(channel, request).await.map_err(of_status)?;
            Ok(Samples { stream: Arc::new(Mutex::new(samples)), awaited })
        })
    }

    #[pyo3(signature = (*, rate_hz=60.0, refinement=0, precise=true))]
    fn frames<'py>(
        &self,
        py: Python<'py>,
        rate_hz: f64,
        refinement: u32,
        precise: bool,
    ) -> PyResult<Bound<'py, PyAny>> {
        let request = pb::WatchFramesRequest {
            session_id: self.id.clone(),
            refinement,
            encoding: if precise { pb::Encoding::F32 } else { pb::Encoding::I16 }.into(),
            rate_hz: Some(rate_hz),
            ..Default::default()
        };
        let (channel, awaited) = (self.channel.clone(), self.awaited);
        answer(py, awaited, async move {
            let frames = view::Frames::open(channel, request).await.map_err(of_status)?;
            Ok(Frames { stream: Arc::new(Mutex::new(frames)), awaited })
        })
    }

    #[pyo3(signature = (*, refinement=0))]
    fn mesh<'py>(&self, py: Python<'py>, refinement: u32) -> PyResult<Bound<'py, PyAny>> {
        let (mut views, session_id) = (ViewServiceClient::new(self.channel.clone()), self.id.clone());
        answer(py, self.awaited, async move {
            let parts = views.get_mesh(pb::GetMeshRequest { session_id, refinement }).await;
            let mut parts = parts.map_err(of_status)?.into_inner();
            let mut mesh = Mesh::default();
            while let Some(part) = parts.message().await.map_err(of_status)? {
                mesh.grid = (part.vertices_x, part.vertices_y);
                mesh.rest_m.extend(part.rest_position_m);
                mesh.uv.extend(part.texture_coordinates);
                mesh.triangles.extend(part.triangles);
                mesh.file_vertex.extend(part.file_vertex);
            }
            Ok(mesh)
        })
    }

    #[pyo3(signature = (device, *, seconds=None, tool=0, tip=None, deadband=0.0, up_deadband=0.0, datagrams=true,
        holder="python", remember=true))]
    #[allow(clippy::too_many_arguments)]
    fn touch<'py>(
        &self,
        py: Python<'py>,
        device: &Bound<'py, PyAny>,
        seconds: Option<f64>,
        tool: u32,
        tip: Option<Tip>,
        deadband: f64,
        up_deadband: f64,
        datagrams: bool,
        holder: &str,
        remember: bool,
    ) -> PyResult<Bound<'py, PyAny>> {
        let device = Given::of(device)?;
        let lasts = seconds.or(device.lasts_s()).map(|seconds| duration("seconds", seconds)).transpose()?;
        let target = Target {
            server: self.server.clone(),
            session: bridge::Session::Existing(self.id.clone()),
            tool,
            tip: tip.map(|tip| tip.0).unwrap_or_default(),
            deadband,
            up_deadband,
            datagrams,
            holder: holder.to_owned(),
        };
        let options = Options { lasts, remembers: remember, keeps_session: true, ..Options::default() };
        let (end, ended) = oneshot::channel();
        answer_in_order(py, self.awaited, Some(end), async move {
            let stop = async {
                // Dropped when nobody waits any more.
                let _ = ended.await;
            };
            let (_, report) = bridge::run(device, target, options, stop).await.map_err(of_client)?;
            Ok(Touched(report))
        })
    }

    fn __enter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    #[pyo3(signature = (*_raised))]
    fn __exit__<'py>(&self, py: Python<'py>, _raised: &Bound<'py, PyAny>) -> PyResult<()> {
        self.delete(py).map(drop)
    }

    fn __aenter__<'py>(slf: Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        let (py, session) = (slf.py(), slf.unbind());
        answer(py, true, async move { Ok(session) })
    }

    #[pyo3(signature = (*_raised))]
    fn __aexit__<'py>(&self, py: Python<'py>, _raised: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        self.delete(py)
    }

    fn __repr__(&self) -> String {
        format!("<palpate.RemoteSession {} of {:?}>", self.id, self.server)
    }
}

/// Bytes for Python.
struct Bytes(Vec<u8>);

impl<'py> IntoPyObject<'py> for Bytes {
    type Target = PyBytes;
    type Output = Bound<'py, PyBytes>;
    type Error = PyErr;

    fn into_pyobject(self, py: Python<'py>) -> PyResult<Self::Output> {
        Ok(PyBytes::new(py, &self.0))
    }
}

/// What of a surface stays.
#[derive(Default)]
struct Mesh {
    grid: (u32, u32),
    rest_m: Vec<f32>,
    uv: Vec<f32>,
    triangles: Vec<u32>,
    file_vertex: Vec<u32>,
}

impl<'py> IntoPyObject<'py> for Mesh {
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

/// What came of a touch.
struct Touched(Report);

impl<'py> IntoPyObject<'py> for Touched {
    type Target = PyAny;
    type Output = Bound<'py, PyAny>;
    type Error = PyErr;

    fn into_pyobject(self, py: Python<'py>) -> PyResult<Self::Output> {
        let Report { course, ages_s, envelope, late_ticks, missed_ticks, traffic, lost, .. } = self.0;
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
        found.set_item("connections", traffic.connections)?;
        found.set_item("failed_attempts", traffic.failed)?;
        found.set_item("samples", traffic.samples)?;
        found.set_item("poses", traffic.poses)?;
        found.set_item("refused", traffic.refused)?;
        found.set_item("datagrams_up", traffic.carried.sent)?;
        found.set_item("datagrams_down", traffic.carried.came)?;
        let limits = PyDict::new(py);
        for (cause, name) in LimitCause::ALL.iter().filter(|_| envelope.is_some()) {
            limits.set_item(*name, envelope.as_ref().map_or(0, |envelope| envelope.count(*cause).0))?;
        }
        found.set_item("limits", limits)?;
        found.set_item("energy_j", envelope.as_ref().map_or(0.0, palpate_touch::Envelope::energy_j))?;
        found.set_item("lost", lost.map(|error| error.to_string()))?;
        py.import("palpate._touch")?.getattr("Touched")?.call((), Some(&found))
    }
}

/// The end of a stream.
fn at_end(awaited: bool) -> PyErr {
    if awaited { PyStopAsyncIteration::new_err(()) } else { PyStopIteration::new_err(()) }
}

/// The samples of a session.
#[pyclass(frozen, module = "palpate")]
pub(crate) struct Samples {
    stream: Arc<Mutex<watch::Samples>>,
    awaited: bool,
}

/// Samples, one row for each tool of each.
#[derive(Default)]
struct Sampled {
    step: Vec<u64>,
    time_s: Vec<f64>,
    tool: Vec<u32>,
    numbers: Vec<f64>,
    awake_points: Vec<u32>,
    asleep: Vec<bool>,
}

impl Sampled {
    fn add(&mut self, sample: &pb::Sample) {
        for tool in &sample.tools {
            self.step.push(sample.step);
            self.time_s.push(sample.simulation_time_s);
            self.tool.push(tool.tool);
            self.awake_points.push(sample.awake_points);
            self.asleep.push(sample.asleep);
            for vector in [
                &tool.displacement_m,
                &tool.surface_displacement_m,
                &tool.velocity_m_per_s,
                &tool.force_on_tool_n,
                &tool.applied_force_n,
            ] {
                self.numbers.extend(from_vector(vector.as_ref()).to_array());
            }
        }
    }
}

impl<'py> IntoPyObject<'py> for Sampled {
    type Target = PyAny;
    type Output = Bound<'py, PyAny>;
    type Error = PyErr;

    fn into_pyobject(self, py: Python<'py>) -> PyResult<Self::Output> {
        let (given, rows) = (PyDict::new(py), self.step.len());
        given.set_item("step", column(py, self.step)?)?;
        given.set_item("time_s", column(py, self.time_s)?)?;
        given.set_item("tool", column(py, self.tool)?)?;
        given.set_item("awake_points", column(py, self.awake_points)?)?;
        given.set_item("asleep", column(py, self.asleep)?)?;
        given.set_item("felt", records(py, self.numbers, "FELT", &[rows])?)?;
        py.import("palpate._touch")?.getattr("Sampled")?.call((), Some(&given))
    }
}

/// A sample, whether it has tools or not.
#[derive(IntoPyObject)]
struct Sample {
    step: u64,
    time_s: f64,
    awake_points: u32,
    asleep: bool,
    held: bool,
    overruns: u64,
    time_dilation: f64,
    late_commands: u64,
    dropped_samples: u64,
    tools: std::collections::BTreeMap<u32, ToolSample>,
}

/// A tool in a sample.
#[derive(IntoPyObject)]
struct ToolSample {
    displacement_m: (f64, f64, f64),
    surface_displacement_m: (f64, f64, f64),
    velocity_m_per_s: (f64, f64, f64),
    force_on_tool_n: (f64, f64, f64),
    applied_force_n: (f64, f64, f64),
    late: bool,
    expired: bool,
    stale: bool,
}

impl Sample {
    fn of(sample: &pb::Sample) -> Self {
        let numbers = |v: Option<&pb::Vector3>| from_vector(v).into();
        let tools = sample.tools.iter().map(|tool| {
            let sampled = ToolSample {
                displacement_m: numbers(tool.displacement_m.as_ref()),
                surface_displacement_m: numbers(tool.surface_displacement_m.as_ref()),
                velocity_m_per_s: numbers(tool.velocity_m_per_s.as_ref()),
                force_on_tool_n: numbers(tool.force_on_tool_n.as_ref()),
                applied_force_n: numbers(tool.applied_force_n.as_ref()),
                late: tool.late,
                expired: tool.expired,
                stale: tool.stale,
            };
            (tool.tool, sampled)
        });
        Sample {
            step: sample.step,
            time_s: sample.simulation_time_s,
            awake_points: sample.awake_points,
            asleep: sample.asleep,
            held: sample.held,
            overruns: sample.overrun_count,
            time_dilation: sample.time_dilation,
            late_commands: sample.late_commands,
            dropped_samples: sample.dropped_samples,
            tools: tools.collect(),
        }
    }
}

#[pymethods]
impl Samples {
    fn take<'py>(&self, py: Python<'py>, count: usize) -> PyResult<Bound<'py, PyAny>> {
        let stream = self.stream.clone();
        answer(py, self.awaited, async move {
            let (mut stream, mut sampled) = (stream.lock().await, Sampled::default());
            for _ in 0..count {
                match stream.next().await.map_err(of_status)? {
                    Some(sample) => sampled.add(&sample),
                    None => break,
                }
            }
            Ok(sampled)
        })
    }

    fn __iter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    fn __next__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (stream, awaited) = (self.stream.clone(), self.awaited);
        answer(py, awaited, async move {
            let sample = stream.lock().await.next().await.map_err(of_status)?;
            sample.map(|sample| Sample::of(&sample)).ok_or_else(|| at_end(awaited))
        })
    }

    fn __aiter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    fn __anext__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.__next__(py)
    }
}

/// The frames of a session.
#[pyclass(frozen, module = "palpate")]
pub(crate) struct Frames {
    stream: Arc<Mutex<view::Frames>>,
    awaited: bool,
}

/// A frame: the whole surface.
struct Frame {
    step: u64,
    time_s: f64,
    frame_id: u64,
    skipped: u64,
    vertices: [usize; 2],
    displacement_m: Vec<[f32; 3]>,
}

impl<'py> IntoPyObject<'py> for Frame {
    type Target = PyAny;
    type Output = Bound<'py, PyAny>;
    type Error = PyErr;

    fn into_pyobject(self, py: Python<'py>) -> PyResult<Self::Output> {
        let given = PyDict::new(py);
        given.set_item("step", self.step)?;
        given.set_item("time_s", self.time_s)?;
        given.set_item("frame_id", self.frame_id)?;
        given.set_item("skipped", self.skipped)?;
        let numbers = self.displacement_m.into_flattened();
        given.set_item("displacement_m", shaped(py, numbers, &[self.vertices[1].max(1), 3])?)?;
        py.import("palpate._touch")?.getattr("Frame")?.call((), Some(&given))
    }
}

#[pymethods]
impl Frames {
    fn __iter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    fn __next__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (stream, awaited) = (self.stream.clone(), self.awaited);
        answer(py, awaited, async move {
            let mut stream = stream.lock().await;
            let Some((part, surface)) = stream.next().await.map_err(of_status)? else {
                return Err(at_end(awaited));
            };
            Ok(Frame {
                step: part.step,
                time_s: part.simulation_time_s,
                frame_id: part.frame_id,
                skipped: part.skipped_frames,
                vertices: surface.vertices,
                displacement_m: surface.displacement_m.clone(),
            })
        })
    }

    fn __aiter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    fn __anext__<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        self.__next__(py)
    }
}
