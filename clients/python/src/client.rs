//! A client of a server. Each call returns its result, or an awaitable of it: the flag `awaited` of the connection
//! decides which, and everything created from the connection has it too.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use glam::DVec3;
use palpate_client::bridge::{self, Copies, Options, Target};
use palpate_client::{Channel, Credentials, Followed, HeldTools, Token, snapshot};
use palpate_proto::{pb, touch};
use palpate_refusal::{Reason, Refusal};
use palpate_session::journal;
use palpate_tissue::scene;
use palpate_tissue::shape::PointName;
use pb::command::Action;
use pb::exercise_service_client::ExerciseServiceClient;
use pb::session_service_client::SessionServiceClient;
use pb::view_service_client::ViewServiceClient;
use pyo3::prelude::*;
use tokio::sync::{Mutex, oneshot};

use crate::arrays::vector;
use crate::device::Given;
use crate::error::{has_reason, of_client, of_status, refused, wrong};
use crate::exercise::{self, KnownExercise, LiveMeasures, SessionTask, ToldHiddenLump, ToldResult};
use crate::hand::Hand;
use crate::instrument::Instrument;
use crate::load::load;
use crate::play::play;
use crate::scene::{Scene, Script, point_name};
use crate::sent::SessionSource;
use crate::streams::{self, Following, FrameStream, Samples};
use crate::tip::Tip;
use crate::told::{Bytes, Status, SurfaceMesh, Touched};
use crate::waiting::{answer, answer_in_order};

/// The name of a tool's holder that others see.
pub(crate) const HOLDER: &str = "python";

/// The result of a call without a result: `None`.
const NOTHING: Option<bool> = None;

/// Converts a number of seconds to a duration; refuses negative ones and those that are not finite.
fn duration(field: &str, seconds: f64) -> PyResult<Duration> {
    Duration::try_from_secs_f64(seconds)
        .map_err(|_| wrong(field, format!("must be a number of seconds, but is {seconds}")))
}

/// A connection to a server.
#[pyclass(frozen, module = "palpate")]
#[derive(Clone)]
pub(crate) struct Server {
    server: palpate_client::Server,
    channel: Channel,
    awaited: bool,
}

impl Server {
    fn sessions(&self) -> SessionServiceClient<Channel> {
        SessionServiceClient::new(self.channel.clone())
    }

    /// Finds the session with this ID, on any server of the fleet.
    async fn found(self, id: String, scene: Option<Arc<scene::Scene>>) -> PyResult<RemoteSession> {
        let found = Followed::find(self.server, self.channel, id).await.map_err(of_client)?;
        Ok(RemoteSession::of(found.0, scene, self.awaited))
    }
}

#[pymethods]
impl Server {
    /// Connects to a server, for `palpate.connect` and `palpate.aio.connect`.
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

    /// Returns the names of the server's scenes.
    fn scenes<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let mut sessions = self.sessions();
        answer(py, self.awaited, async move {
            let found = sessions.list_scenes(pb::ListScenesRequest {}).await.map_err(of_status)?;
            Ok(found.into_inner().scene_names)
        })
    }

    /// Returns the state of each session of the server, like `RemoteSession.status`.
    #[pyo3(name = "sessions")]
    fn sessions_there<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let mut sessions = self.sessions();
        answer(py, self.awaited, async move {
            let found = sessions.list_sessions(pb::ListSessionsRequest {}).await.map_err(of_status)?;
            Ok(found.into_inner().sessions.into_iter().map(Status::of).collect::<Vec<_>>())
        })
    }

    /// Creates a session of one of the server's scenes, by its name, or of a scene of yours. The server deletes it
    /// when nobody uses it for `idle_timeout_s`.
    #[pyo3(signature = (scene, *, paused=false, idle_timeout_s=None))]
    fn create_session<'py>(
        &self,
        py: Python<'py>,
        scene: &Bound<'py, PyAny>,
        paused: bool,
        idle_timeout_s: Option<f64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let (source, own) = match scene.cast::<Scene>() {
            Ok(scene) => (SessionSource::of(scene.get()).map_err(refused)?, Some(Arc::new(scene.get().scene.clone()))),
            Err(_) => {
                let name = scene.extract().map_err(|_| {
                    wrong("scene", "must be the name of a scene that the server has, or a palpate.Scene")
                })?;
                (SessionSource::Name(name), None)
            }
        };
        let (server, awaited) = (self.clone(), self.awaited);
        answer(py, awaited, async move {
            let source = Some(source.source(server.channel.clone()).await?);
            let request = pb::CreateSessionRequest { source, paused, idle_timeout_s };
            let made = server.sessions().create_session(request).await.map_err(of_status)?.into_inner().session;
            let made = made.unwrap_or_default();
            // Another server of the fleet may have created it.
            match &made.ownership {
                Some(_) => server.found(made.session_id, own).await,
                None => {
                    let session = Followed::new(server.server, server.channel, made.session_id);
                    Ok(RemoteSession::of(session, own, awaited))
                }
            }
        })
    }

    /// Returns the server's exercises: name, title, instructions, scenes, limits, and what a trainee is told.
    fn exercises<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let mut exercises = ExerciseServiceClient::new(self.channel.clone());
        answer(py, self.awaited, async move {
            let found = exercises.list_exercises(pb::ListExercisesRequest {}).await.map_err(of_status)?;
            Ok(found.into_inner().exercises.into_iter().map(KnownExercise::of).collect::<Vec<_>>())
        })
    }

    /// Creates a session for an exercise, by its name, or for one of yours, by its text (TOML). Without a seed, the server draws the
    /// hidden truth from one that it does not tell trainees. The session is the trainer's; `exercise()["trainee_id"]` is the id for
    /// `session` that opens it for a trainee.
    #[pyo3(signature = (exercise, *, seed=None, scene=None, paused=false, idle_timeout_s=None))]
    fn create_exercise<'py>(
        &self,
        py: Python<'py>,
        exercise: String,
        seed: Option<u64>,
        scene: Option<String>,
        paused: bool,
        idle_timeout_s: Option<f64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let (server, awaited) = (self.clone(), self.awaited);
        let source = Some(exercise::source(exercise, seed, scene));
        answer(py, awaited, async move {
            let request = pb::CreateSessionRequest { source, paused, idle_timeout_s };
            let made = server.sessions().create_session(request).await.map_err(of_status)?.into_inner().session;
            let session = Followed::new(server.server, server.channel, made.unwrap_or_default().session_id);
            Ok(RemoteSession::of(session, None, awaited))
        })
    }

    /// Loads the server with simulated users by a plan, like `palpate-client load --plan`, and returns the report.
    /// `plan` is a file (TOML), its text, or a dict with its keys. `report` is a file for a page with plots (HTML).
    /// "kept" of the report says whether all objectives were met and no stream broke, "why" lists what was not; see
    /// docs/operating.md. Ctrl-C ends it, and deletes its sessions.
    #[pyo3(signature = (plan, *, report=None))]
    fn load<'py>(
        &self,
        py: Python<'py>,
        plan: &Bound<'py, PyAny>,
        report: Option<PathBuf>,
    ) -> PyResult<Bound<'py, PyAny>> {
        load(py, self.server.clone(), plan, report, self.awaited)
    }

    /// Returns the session with this id. Raises Refused if there is none.
    fn session<'py>(&self, py: Python<'py>, session_id: String) -> PyResult<Bound<'py, PyAny>> {
        // Refused if there is none.
        answer(py, self.awaited, self.clone().found(session_id, None))
    }

    fn __repr__(&self) -> String {
        format!("<palpate.Client of {:?}>", self.server)
    }
}

fn grid_point(point: [usize; 2]) -> pb::GridPoint {
    let [x, y] = point.map(|number| number.try_into().unwrap_or(u32::MAX));
    pb::GridPoint { x, y }
}

/// Converts a vector unchecked: the server refuses one that is not finite, with its field.
fn numbers(DVec3 { x, y, z }: DVec3) -> pb::Vector3 {
    pb::Vector3 { x, y, z }
}

/// A session on a server. `with` deletes it at the end. In a fleet, calls and streams follow it to the server that
/// has it.
#[pyclass(frozen, module = "palpate")]
pub(crate) struct RemoteSession {
    pub(crate) session: Arc<Followed>,
    pub(crate) held: Arc<HeldTools>,
    /// The scene from which the caller created it.
    pub(crate) scene: Option<Arc<scene::Scene>>,
    pub(crate) awaited: bool,
}

/// Calls the server that has the session.
macro_rules! called {
    ($session:expr, $client:ident . $call:ident ( $request:expr )) => {{
        let request = $request;
        let called = $session.call(|channel| {
            let request = request.clone();
            async move { $client::new(channel).$call(request).await }
        });
        called.await.map_err(of_client).map(tonic::Response::into_inner)
    }};
}
pub(crate) use called;

/// Returns bites at some places, all with the same radius.
fn bites(places_m: &[Bound<'_, PyAny>], radius_m: f64) -> PyResult<Vec<pb::Bite>> {
    let bite = |place_m| Ok(pb::Bite { place_m: Some(numbers(vector("bites_m", place_m)?)), radius_m });
    places_m.iter().map(bite).collect()
}

impl RemoteSession {
    /// Deletes the session at the end of a `with` block. A trainee only leaves it: it is the trainer's.
    fn leave<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (session, session_id) = self.own();
        answer(py, self.awaited, async move {
            let request = pb::DeleteSessionRequest { session_id };
            match called!(session, SessionServiceClient.delete_session(request)) {
                Err(error) if has_reason(&error, Reason::NotForTrainee) => Ok(NOTHING),
                other => other.map(|_| NOTHING),
            }
        })
    }

    fn of(session: Followed, scene: Option<Arc<scene::Scene>>, awaited: bool) -> Self {
        let session = Arc::new(session);
        let held = Arc::new(HeldTools::new(session.clone(), HOLDER));
        RemoteSession { session, held, scene, awaited }
    }

    /// Returns the session, to be moved into a future, and its ID.
    fn own(&self) -> (Arc<Followed>, String) {
        (self.session.clone(), self.session.session_id().to_owned())
    }

    fn tell<'py>(&self, py: Python<'py>, tool: u32, action: Action) -> PyResult<Bound<'py, PyAny>> {
        let told = self.held.clone().command(tool, action);
        answer(py, self.awaited, async move { told.await.map(|()| NOTHING).map_err(of_client) })
    }
}

#[pymethods]
impl RemoteSession {
    /// The id of the session, for `Client.session`.
    #[getter]
    fn id(&self) -> &str {
        self.session.session_id()
    }

    /// URL of the server that last had the session.
    #[getter]
    fn server(&self) -> String {
        self.session.server().url().to_owned()
    }

    /// Returns the state of the session: state, step, points, held tools, what is cut, threads and clips, and more.
    fn status<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (session, session_id) = self.own();
        answer(py, self.awaited, async move {
            let found = called!(session, SessionServiceClient.get_session(pb::GetSessionRequest { session_id }))?;
            Ok(Status::of(found.session.unwrap_or_default()))
        })
    }

    /// Starts the session, to run until step `until_step` if given. Returns the next step.
    #[pyo3(signature = (*, until_step=None))]
    fn start<'py>(&self, py: Python<'py>, until_step: Option<u64>) -> PyResult<Bound<'py, PyAny>> {
        let (session, session_id) = self.own();
        answer(py, self.awaited, async move {
            let request = pb::StartSessionRequest { session_id, until_step };
            Ok(called!(session, SessionServiceClient.start_session(request))?.step)
        })
    }

    /// Pauses the session after its current step.
    fn pause<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (session, session_id) = self.own();
        answer(py, self.awaited, async move {
            let request = pb::PauseSessionRequest { session_id };
            called!(session, SessionServiceClient.pause_session(request)).map(|_| NOTHING)
        })
    }

    /// Makes the tissue softer or stiffer, from step `at_step` on if given, else from the next. Returns that step.
    /// Coefficients that are not given stay as they are.
    #[pyo3(signature = (*, stiffness_n_per_m=None, damping_n_s_per_m=None, anchor_stiffness_n_per_m=None,
        volume_stiffness_pa=None, at_step=None))]
    fn change<'py>(
        &self,
        py: Python<'py>,
        stiffness_n_per_m: Option<f64>,
        damping_n_s_per_m: Option<f64>,
        anchor_stiffness_n_per_m: Option<f64>,
        volume_stiffness_pa: Option<f64>,
        at_step: Option<u64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let (session, session_id) = self.own();
        let request = pb::UpdateTissueRequest {
            session_id,
            stiffness_n_per_m,
            damping_n_s_per_m,
            anchor_stiffness_n_per_m,
            volume_stiffness_pa,
            at_step,
        };
        answer(py, self.awaited, async move { Ok(called!(session, SessionServiceClient.update_tissue(request))?.step) })
    }

    /// Returns a number of steps done and the hash of the state after them: `at_step` if given, else the current one.
    #[pyo3(signature = (*, at_step=None))]
    fn hash<'py>(&self, py: Python<'py>, at_step: Option<u64>) -> PyResult<Bound<'py, PyAny>> {
        let (session, session_id) = self.own();
        answer(py, self.awaited, async move {
            let request = pb::GetStateHashRequest { session_id, at_step };
            let found = called!(session, SessionServiceClient.get_state_hash(request))?;
            Ok((found.step, found.state_hash))
        })
    }

    /// Returns a journal of the current moment (MCAP), for `Journal`.
    fn save<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (session, session_id) = self.own();
        answer(py, self.awaited, async move {
            let request = pb::SaveSnapshotRequest { session_id };
            let parts = called!(session, SessionServiceClient.save_snapshot(request))?;
            snapshot::collect(parts).await.map(Bytes).map_err(of_status)
        })
    }

    /// Deletes the session, for all its users.
    fn delete<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (session, session_id) = self.own();
        answer(py, self.awaited, async move {
            let request = pb::DeleteSessionRequest { session_id };
            called!(session, SessionServiceClient.delete_session(request)).map(|_| NOTHING)
        })
    }

    /// Watches the samples of all tools from now on, one per `every_steps` steps. `heartbeat_s` is the longest time
    /// between two samples of a tissue at rest, s.
    #[pyo3(signature = (*, every_steps=1, heartbeat_s=None))]
    fn samples<'py>(&self, py: Python<'py>, every_steps: u32, heartbeat_s: Option<f64>) -> PyResult<Bound<'py, PyAny>> {
        let request = pb::WatchSamplesRequest {
            session_id: self.session.session_id().to_owned(),
            sample_every_steps: Some(every_steps),
            heartbeat_s,
            ..Default::default()
        };
        let (session, awaited) = (self.session.clone(), self.awaited);
        answer(py, awaited, async move {
            let samples = streams::samples(&session, &request).await?;
            Ok(Samples { stream: Arc::new(Mutex::new(Following::new(session, request, samples))), awaited })
        })
    }

    /// Watches the surface from now on, at most `rate_hz` frames per second. `refinement` is the number of vertices
    /// between two points of the tissue, 0 to 10; `precise=False` halves the bytes.
    #[pyo3(signature = (*, rate_hz=60.0, refinement=0, precise=true))]
    fn frames<'py>(
        &self,
        py: Python<'py>,
        rate_hz: f64,
        refinement: u32,
        precise: bool,
    ) -> PyResult<Bound<'py, PyAny>> {
        let request = pb::WatchFramesRequest {
            session_id: self.session.session_id().to_owned(),
            refinement,
            encoding: if precise { pb::Encoding::F32 } else { pb::Encoding::I16 }.into(),
            rate_hz: Some(rate_hz),
            ..Default::default()
        };
        let (session, awaited) = (self.session.clone(), self.awaited);
        answer(py, awaited, async move {
            let frames = streams::frames(&session, &request).await?;
            Ok(FrameStream { stream: Arc::new(Mutex::new(Following::new(session, request, frames))), awaited })
        })
    }

    /// Returns the constant part of the surface: grid, rest_m, uv, triangles, file_vertex.
    #[pyo3(signature = (*, refinement=0))]
    fn mesh<'py>(&self, py: Python<'py>, refinement: u32) -> PyResult<Bound<'py, PyAny>> {
        let (session, session_id) = self.own();
        answer(py, self.awaited, async move {
            let request = pb::GetMeshRequest { session_id, refinement };
            let mut parts = called!(session, ViewServiceClient.get_mesh(request))?;
            let mut mesh = SurfaceMesh::default();
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

    /// Touches with a device at 1 kHz, on a thread of its own, with rendered forces within the safety envelope.
    ///
    /// `device` is a Course, or an object with `read()`, which returns ((x, y, z), enable), and `write(force_n)`, and
    /// optionally `limits`, as a Course has them. A change of enable from False to True enables forces. `prediction`
    /// says of which tissues the loop simulates a copy, so that forces come without the delay of the network: "auto",
    /// of meshes; "always"; "never". Warns (RuntimeWarning) if no force was felt at all. Raises Refused, reason
    /// TOOL_HELD, if somebody holds the tool, this session object included.
    ///
    /// With `instrument` the device leads it, and its tips are the tools from `tool` on: `read()` also returns the
    /// orientation (w, x, y, z) of the device and the angle between the jaws, rad, and `write(force_n, torque_n_m)` gets
    /// the torque about the device's place, within `torque_n_m` of `limits`. Force and torque come from a copy of the
    /// tissue.
    ///
    /// With `hand`, one of `two_hands`, another call touches the same session with the other hand, and each copy of the
    /// tissue has the tools of both at once. `prediction` must allow a copy: "always" for single tips on a sheet.
    #[pyo3(signature = (device, *, seconds=None, tool=0, tip=None, deadband=0.0, up_deadband=0.0, datagrams=true,
        prediction="auto", holder="python", remember=true, instrument=None, hand=None))]
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
        prediction: &str,
        holder: &str,
        remember: bool,
        instrument: Option<Instrument>,
        hand: Option<Hand>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let of_grids = match prediction {
            "always" => Some(true),
            // An instrument is rendered from a copy of any tissue.
            "auto" => Some(instrument.is_some()),
            "never" => None,
            _ => {
                let message = format!("must be \"auto\", \"always\" or \"never\", but is {prediction:?}");
                return Err(wrong("prediction", message));
            }
        };
        let copies = of_grids.map(|of_grids| Copies { make: Arc::new(journal::prediction), of_grids });
        let device = Given::of(device, instrument.is_some())?;
        let instrument = instrument.map(|instrument| instrument.0);
        let tools = tool..tool.saturating_add(instrument.as_ref().map_or(1, |instrument| instrument.tips.len() as u32));
        let lasts = seconds.or(device.lasts_s()).map(|seconds| duration("seconds", seconds)).transpose()?;
        let target = Target {
            server: self.session.server(),
            session: bridge::SessionChoice::Existing(self.session.session_id().to_owned()),
            tool,
            tip: tip.map(|tip| tip.0).unwrap_or_default(),
            deadband,
            up_deadband,
            datagrams,
            holder: holder.to_owned(),
        };
        let hand = hand.map(|hand| hand.0.take(self.session.session_id())).transpose().map_err(of_client)?;
        let options =
            Options { lasts, remembers: remember, keeps_session: true, copies, hand, instrument, ..Options::default() };
        let (end, ended) = oneshot::channel();
        let held = self.held.clone();
        answer_in_order(py, self.awaited, Some(end), async move {
            let stop = async {
                // Dropped when the caller no longer waits.
                let _ = ended.await;
            };
            for tool in tools {
                if !held.holds(tool).await {
                    continue;
                }
                let message = format!(
                    "tool {tool} is held by this session object, which took it for pose, push or grasp: call release({tool}) \
                     first, or touch with another tool"
                );
                return Err(refused(Refusal::new(Reason::ToolHeld, "tool", message)));
            }
            let (_, report) = bridge::run(device, target, options, stop).await.map_err(of_client)?;
            Ok(Touched(report))
        })
    }

    /// Moves a tool with a tip to `place_m` by the end of the next step; acquires the tool first if needed. It stays
    /// there until its next command, even if the session moves. Raises Refused, reason TOOL_HELD, if somebody else
    /// holds the tool.
    #[pyo3(signature = (tool, place_m, tip=None))]
    fn pose<'py>(
        &self,
        py: Python<'py>,
        tool: u32,
        place_m: &Bound<'py, PyAny>,
        tip: Option<Tip>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let tip = tip.map(|tip| tip.0).unwrap_or_default();
        self.tell(py, tool, Action::Pose(touch::pose(vector("place_m", place_m)?, &tip)))
    }

    /// Pushes at a point or a place; at a distance r from there with force_n * exp(-falloff_per_m * r +
    /// falloff_offset).
    #[pyo3(signature = (tool, force_n, *, point=None, at_m=None, falloff_per_m=200.0, falloff_offset=0.0))]
    #[allow(clippy::too_many_arguments)]
    fn push<'py>(
        &self,
        py: Python<'py>,
        tool: u32,
        force_n: &Bound<'py, PyAny>,
        point: Option<&Bound<'py, PyAny>>,
        at_m: Option<&Bound<'py, PyAny>>,
        falloff_per_m: f64,
        falloff_offset: f64,
    ) -> PyResult<Bound<'py, PyAny>> {
        let centre = match (point, at_m) {
            (Some(point), None) => match point_name(point)? {
                PointName::Point(at) => pb::force::Centre::Point(grid_point(at)),
                PointName::Vertex(vertex) => pb::force::Centre::Vertex(vertex),
            },
            (None, Some(at_m)) => pb::force::Centre::AtM(numbers(vector("at_m", at_m)?)),
            _ => return Err(wrong("point", "give either a point or a place, at_m")),
        };
        let force = pb::Force {
            centre: Some(centre),
            force_n: Some(numbers(vector("force_n", force_n)?)),
            falloff_per_m: Some(falloff_per_m),
            falloff_offset: Some(falloff_offset),
        };
        self.tell(py, tool, Action::Force(force))
    }

    /// Holds a point, and moves it to this displacement from its place at rest.
    fn grasp<'py>(
        &self,
        py: Python<'py>,
        tool: u32,
        point: &Bound<'py, PyAny>,
        displacement_m: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let (point, vertex) = match point_name(point)? {
            PointName::Point(at) => (Some(grid_point(at)), None),
            PointName::Vertex(vertex) => (None, Some(vertex)),
        };
        let displacement_m = numbers(vector("displacement_m", displacement_m)?);
        let target = Some(pb::position::Target::DisplacementM(displacement_m));
        self.tell(py, tool, Action::Position(pb::Position { point, vertex, target }))
    }

    /// Lays thread `number`, as `Session.thread` does; acquires the tool first if needed. `status()["ties"]` has the threads and clips.
    #[pyo3(signature = (tool, number, bites_m, length_m, *, radius_m=0.001, friction=0.0, strength_n=None))]
    #[allow(clippy::too_many_arguments)]
    fn thread<'py>(
        &self,
        py: Python<'py>,
        tool: u32,
        number: u32,
        bites_m: Vec<Bound<'py, PyAny>>,
        length_m: f64,
        radius_m: f64,
        friction: f64,
        strength_n: Option<f64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let thread = pb::Thread { bites: bites(&bites_m, radius_m)?, length_m, friction, strength_n };
        let laid = self.held.clone().thread(tool, number, thread);
        answer(py, self.awaited, async move { laid.await.map(|()| NOTHING).map_err(of_client) })
    }

    /// Closes clip `number` on two places, as `Session.clip` does; acquires the tool first if needed.
    #[pyo3(signature = (tool, number, bites_m, *, radius_m=0.001, strength_n=None))]
    #[allow(clippy::too_many_arguments)]
    fn clip<'py>(
        &self,
        py: Python<'py>,
        tool: u32,
        number: u32,
        bites_m: Vec<Bound<'py, PyAny>>,
        radius_m: f64,
        strength_n: Option<f64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let clip = pb::Clip { bites: bites(&bites_m, radius_m)?, strength_n };
        let laid = self.held.clone().clip(tool, number, clip);
        answer(py, self.awaited, async move { laid.await.map(|()| NOTHING).map_err(of_client) })
    }

    /// Marks a place of the surface, m, as `Session.mark` does; acquires the tool first if needed.
    #[pyo3(signature = (tool, place_m, *, diameter_m=None))]
    fn mark<'py>(
        &self,
        py: Python<'py>,
        tool: u32,
        place_m: &Bound<'py, PyAny>,
        diameter_m: Option<f64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let place_m = Some(numbers(vector("place_m", place_m)?));
        self.tell(py, tool, Action::Mark(pb::Mark { place_m, diameter_m }))
    }

    /// Returns the exercise that the session is made for: `exercise` (like `Client.exercises`), `role` ("trainer" or "trainee"),
    /// `begin_step`, `finished`, and for a trainer `trainee_id` and `seed`; None for any other session.
    fn exercise<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (session, session_id) = self.own();
        answer(py, self.awaited, async move {
            let found = called!(session, SessionServiceClient.get_session(pb::GetSessionRequest { session_id }))?;
            Ok(found.session.and_then(|session| session.exercise).map(SessionTask::of))
        })
    }

    /// Watches the measures of the session's exercise from now on, until it ends.
    fn measures<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let ((session, session_id), awaited) = (self.own(), self.awaited);
        answer(py, awaited, async move {
            let request = pb::WatchExerciseRequest { session_id };
            let stream = called!(session, ExerciseServiceClient.watch_exercise(request))?;
            Ok(LiveMeasures { stream: Arc::new(Mutex::new(stream)), awaited })
        })
    }

    /// Ends the session's exercise, unless it has ended, and returns its result: `figures`, `tools`, `score_percent`, `criteria`, the
    /// hidden `lumps`, the `answers`, the `phases` (each with `begin_step`, `step`, `time_s`, `figures` and `tools`), `step` and `time_s`. A
    /// trainee gets step and time alone if the exercise says so (`is_told`).
    fn finish_exercise<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let (session, session_id) = self.own();
        answer(py, self.awaited, async move {
            let request = pb::FinishExerciseRequest { session_id, phase: 0 };
            let finished = called!(session, ExerciseServiceClient.finish_exercise(request))?;
            Ok(ToldResult::of(finished.result.unwrap_or_default()))
        })
    }

    /// Ends a phase of the session's exercise, from 1, unless it has ended, so that the next one begins. Returns None, or with the last
    /// phase what `finish_exercise` returns.
    fn finish_phase<'py>(&self, py: Python<'py>, phase: u32) -> PyResult<Bound<'py, PyAny>> {
        let (session, session_id) = self.own();
        answer(py, self.awaited, async move {
            let request = pb::FinishExerciseRequest { session_id, phase };
            let finished = called!(session, ExerciseServiceClient.finish_exercise(request))?;
            Ok(finished.result.map(ToldResult::of))
        })
    }

    /// Sends the trainee a hint (a text), or a marker at a place of the surface at rest, m. For trainers.
    #[pyo3(signature = (text="", *, place_m=None))]
    fn advise<'py>(
        &self,
        py: Python<'py>,
        text: &str,
        place_m: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let (session, session_id) = self.own();
        let place_m = place_m.map(|place_m| vector("place_m", place_m)).transpose()?.map(numbers);
        let request = pb::AdviseTraineeRequest { session_id, text: text.to_owned(), place_m };
        answer(py, self.awaited, async move {
            called!(session, ExerciseServiceClient.advise_trainee(request)).map(|_| NOTHING)
        })
    }

    /// Hides another lump in the tissue while the exercise goes on: drawn as the exercise draws its lumps, or the given one
    /// (`centre_m` and `radius_m`, m, and `stiffness_factor`, all three). Returns these of the lump, and the `step` from which on it is
    /// there. For trainers.
    #[pyo3(signature = (*, centre_m=None, radius_m=None, stiffness_factor=None))]
    fn hide_lump<'py>(
        &self,
        py: Python<'py>,
        centre_m: Option<&Bound<'py, PyAny>>,
        radius_m: Option<f64>,
        stiffness_factor: Option<f64>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let (session, session_id) = self.own();
        let centre_m = centre_m.map(|centre_m| vector("centre_m", centre_m)).transpose()?.map(numbers);
        let lump = match (centre_m, radius_m, stiffness_factor) {
            (None, None, None) => None,
            (Some(centre_m), Some(radius_m), Some(stiffness_factor)) => {
                Some(pb::HiddenLump { centre_m: Some(centre_m), radius_m, stiffness_factor })
            }
            _ => {
                let message = "goes with radius_m and stiffness_factor: give all three, or none";
                return Err(wrong("centre_m", message));
            }
        };
        let request = pb::HideLumpRequest { session_id, lump };
        answer(py, self.awaited, async move {
            called!(session, ExerciseServiceClient.hide_lump(request)).map(ToldHiddenLump::of)
        })
    }

    /// Cuts a thread or clip, and takes it out; acquires the tool first if needed.
    fn untie<'py>(&self, py: Python<'py>, tool: u32, number: u32) -> PyResult<Bound<'py, PyAny>> {
        let cut = self.held.clone().untie(tool, number);
        answer(py, self.awaited, async move { cut.await.map(|()| NOTHING).map_err(of_client) })
    }

    /// Ends what a tool does, and releases it.
    fn release<'py>(&self, py: Python<'py>, tool: u32) -> PyResult<Bound<'py, PyAny>> {
        let released = self.held.clone().release(tool);
        answer(py, self.awaited, async move { released.await.map(|()| NOTHING).map_err(of_client) })
    }

    /// Plays a script in real time, each command at its exact step, starting at the session's current step. The
    /// session must be paused, and is paused at the end. If it starts at step 0, the records are those of `run(...,
    /// held=True)`. A session on a mesh needs its `scene`, unless you created it from one.
    #[pyo3(signature = (script, *, scene=None))]
    fn play<'py>(
        &self,
        py: Python<'py>,
        script: &Bound<'py, PyAny>,
        scene: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Bound<'py, PyAny>> {
        let given = scene.map(Scene::given).transpose()?.map(|scene| Arc::new(scene.get().scene.clone()));
        let played = play(self.session.clone(), given.or(self.scene.clone()), Script::given(script)?);
        answer(py, self.awaited, played)
    }

    fn __enter__(slf: Bound<'_, Self>) -> Bound<'_, Self> {
        slf
    }

    #[pyo3(signature = (*_raised))]
    fn __exit__<'py>(&self, py: Python<'py>, _raised: &Bound<'py, PyAny>) -> PyResult<()> {
        self.leave(py).map(drop)
    }

    fn __aenter__<'py>(slf: Bound<'py, Self>) -> PyResult<Bound<'py, PyAny>> {
        let (py, session) = (slf.py(), slf.unbind());
        answer(py, true, async move { Ok(session) })
    }

    #[pyo3(signature = (*_raised))]
    fn __aexit__<'py>(&self, py: Python<'py>, _raised: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        self.leave(py)
    }

    fn __repr__(&self) -> String {
        format!("<palpate.RemoteSession {} of {:?}>", self.session.session_id(), self.session.server())
    }
}
