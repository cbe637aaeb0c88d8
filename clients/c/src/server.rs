//! Servers and sessions: connect, list scenes, create, join, change, delete.

use std::ffi::c_char;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use ::palpate_session::wire::scene::{MeshToSend, SceneToSend};
use palpate_client::bridge::{SessionChoice, Target};
use palpate_client::upload::upload_mesh;
use palpate_client::{Channel, Credentials, Followed, HeldTools, Server, Token, fleet};
use palpate_proto::geometry::from_vector;
use palpate_proto::pb;
use palpate_refusal::Refusal;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Scene;
use palpate_tissue::scene::sent::{self, MeshFile, mesh_file};
use pb::create_session_request::Source;
use pb::session_service_client::SessionServiceClient;

use crate::axes::palpate_vector;
use crate::error::{
    CodedError, PALPATE_CONNECTION, at, at_mut, guard, optional_text, palpate_result, text, write_text,
};
use crate::options::{TouchOptions, options_at, palpate_connect_options};
use crate::os::Threads;

/// A connection to a server, with the caller's credentials, from `palpate_connect` to `palpate_server_free`. Any
/// thread, also several at once.
pub struct palpate_server {
    pub(crate) shared: Arc<Connected>,
}

/// The state shared by a server's handle and everything created from it.
pub(crate) struct Connected {
    pub(crate) threads: Threads,
    pub(crate) server: Server,
    pub(crate) channel: Channel,
    pub(crate) timeout: Duration,
}

/// A handle of a session on a server: of one simulated tissue, which exists on the server independently of its
/// handles. Any thread, also several at once.
pub struct palpate_session {
    pub(crate) shared: Arc<Connected>,
    pub(crate) session_id: String,
    /// The tools by which it lays threads and clips.
    pub(crate) tools: Arc<HeldTools>,
    extent: palpate_extent,
}

/// The bounding box of a tissue at rest, in Palpate's own axes, m.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct palpate_extent {
    /// The corner with the smallest coordinates.
    pub least_m: palpate_vector,
    /// The corner with the largest coordinates.
    pub most_m: palpate_vector,
    /// The middle of the box.
    pub middle_m: palpate_vector,
    /// The highest place of the surface above or below its middle: the origin of devices is placed there.
    pub top_m: palpate_vector,
}

/// The state of a session, from `palpate_session_status_of`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct palpate_session_status {
    /// Number of steps done.
    pub step: u64,
    /// Simulated time, s.
    pub time_s: f64,
    /// The version of what joins the points of the tissue; 0 if nothing was severed.
    pub topology_version: u32,
    /// Number of severed springs, or of severed faces between the cells of a solid.
    pub severed: u32,
    /// Number of parts of the tissue; 1 if it is whole.
    pub pieces: u32,
    /// 1 if a solid has no room for further cuts, so that blades only push; else 0.
    pub cuts_exhausted: u32,
}

/// A change of the tissue's coefficients. A value that is NaN leaves the coefficient as it is.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct palpate_change {
    /// Stiffness of the structural springs, N/m.
    pub stiffness_n_per_m: f64,
    /// Damping, N·s/m.
    pub damping_n_s_per_m: f64,
    /// Stiffness of the anchor springs, which pull points to their places at rest, N/m.
    pub anchor_stiffness_n_per_m: f64,
    /// Stiffness of the volume of a closed mesh, Pa.
    pub volume_stiffness_pa: f64,
}

impl Connected {
    /// Waits for a call, at most for the time limit of calls.
    pub(crate) fn wait<T, E: Into<CodedError>>(
        &self,
        call: impl Future<Output = Result<T, E>>,
    ) -> Result<T, CodedError> {
        self.wait_for(1, call)
    }

    /// Waits for `calls` calls in succession, at most for `calls` times the time limit of a call.
    fn wait_for<T, E: Into<CodedError>>(
        &self,
        calls: u32,
        call: impl Future<Output = Result<T, E>>,
    ) -> Result<T, CodedError> {
        let timeout = self.timeout.saturating_mul(calls);
        let limited = async { tokio::time::timeout(timeout, call).await };
        match self.threads.block_on(limited)? {
            Ok(answer) => answer.map_err(Into::into),
            Err(_) => {
                let why = format!("the server has not answered within {} s", timeout.as_secs_f64());
                Err(CodedError::new(PALPATE_CONNECTION, why))
            }
        }
    }

    /// Makes a call for a session, which another server of a fleet may have.
    pub(crate) fn follow<T, F>(&self, call: impl Fn(SessionServiceClient<Channel>) -> F) -> Result<T, CodedError>
    where
        F: Future<Output = Result<T, tonic::Status>>,
    {
        let call = |channel| call(SessionServiceClient::new(channel));
        let at = self.wait(fleet::follow_from(&self.server, self.channel.clone(), call))?;
        Ok(at.answer)
    }

    pub(crate) fn sessions(&self) -> SessionServiceClient<Channel> {
        SessionServiceClient::new(self.channel.clone())
    }
}

impl palpate_session {
    /// Returns the session's state on the server.
    pub(crate) fn get(&self) -> Result<pb::Session, CodedError> {
        let request = pb::GetSessionRequest { session_id: self.session_id.clone() };
        let answer = self.shared.follow(|mut sessions| {
            let request = request.clone();
            async move { sessions.get_session(request).await }
        })?;
        Ok(answer.into_inner().session.unwrap_or_default())
    }

    /// Returns the target of a tool with these options.
    pub(crate) fn target(&self, options: &TouchOptions) -> Target {
        Target {
            server: self.shared.server.clone(),
            session: SessionChoice::Existing(self.session_id.clone()),
            tool: options.tool,
            tip: options.tip,
            deadband: options.deadband,
            up_deadband: options.up_deadband,
            datagrams: options.datagrams,
            holder: options.holder.clone(),
        }
    }
}

/// Longest time for connecting.
pub(crate) const CONNECTING: Duration = Duration::from_secs(10);

/// Connects to the server at `url`, such as "http://127.0.0.1:7117". `options` may be null. Waits for the first
/// answer, at most 10 s; any answer counts, so an invalid token is refused only by later calls. Writes a handle
/// for `palpate_server_free`, or null after an error. Returns `PALPATE_ARGUMENT` also for a token that would be
/// sent without TLS to another machine, and for certificates without TLS. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_connect(
    url: *const c_char,
    options: *const palpate_connect_options,
    server: *mut *mut palpate_server,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (url, options, out) =
            unsafe { (text(url, "url")?, options_at(options)?, at_mut(server, "server is null")?) };
        *out = std::ptr::null_mut();
        // SAFETY: the caller's promises.
        let [token, ca, tls_name, certificate, key] = unsafe {
            [
                optional_text(options.token, "token")?,
                optional_text(options.ca_pem, "ca_pem")?,
                optional_text(options.tls_name, "tls_name")?,
                optional_text(options.certificate_pem, "certificate_pem")?,
                optional_text(options.key_pem, "key_pem")?,
            ]
        };
        let cert_and_key = match (certificate, key) {
            (Some(certificate), Some(key)) => Some((certificate.to_owned(), key.to_owned())),
            (None, None) => None,
            _ => return Err(CodedError::argument("certificate_pem and key_pem go together")),
        };
        let credentials = Credentials {
            token: token.map(Token::new).transpose()?,
            ca: ca.map(str::to_owned),
            tls_name: tls_name.map(str::to_owned),
            cert_and_key,
        };
        let timeout = Duration::try_from_secs_f64(options.timeout_s).ok().filter(|time| !time.is_zero());
        let timeout = timeout.ok_or_else(|| CodedError::argument("timeout_s must be above 0"))?;
        let server = Server::new(url, &credentials)?.within(timeout.min(CONNECTING));
        let threads = Threads::start()?;
        let channel = threads.block_on(server.connect())??;
        let shared = Arc::new(Connected { threads, server, channel, timeout });
        *out = Box::into_raw(Box::new(palpate_server { shared }));
        Ok(())
    })
}

/// Frees the handle of a connection, which closes when nothing created from it is left. Null is allowed. Any thread,
/// once.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_server_free(server: *mut palpate_server) {
    // SAFETY: the caller's promise.
    guard(|| unsafe { free(server) });
}

/// # Safety
/// The pointer must be null or from `Box::into_raw`.
pub(crate) unsafe fn free<T>(handle: *mut T) -> Result<(), CodedError> {
    if !handle.is_null() {
        // SAFETY: the caller's promise.
        drop(unsafe { Box::from_raw(handle) });
    }
    Ok(())
}

/// Writes the names of the server's scenes, sorted, into `names`, one per line, and into `needed` the number of
/// bytes that they take with the zero at the end; one of both may be null. Returns `PALPATE_BUFFER` if `capacity`
/// bytes are too few. Any thread; waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_scenes(
    server: *const palpate_server,
    names: *mut c_char,
    capacity: usize,
    needed: *mut usize,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promise.
        let shared = &unsafe { at(server, "server is null") }?.shared;
        let answer = shared.wait(shared.sessions().list_scenes(pb::ListScenesRequest {}))?;
        let lines = answer.into_inner().scene_names.join("\n");
        // SAFETY: the caller's promise.
        unsafe { write_text(&lines, names, capacity, needed) }
    })
}

fn handle(shared: &Arc<Connected>, session: Option<pb::Session>) -> Result<*mut palpate_session, CodedError> {
    let session = session.ok_or_else(|| CodedError::new(PALPATE_CONNECTION, "the server sent no session"))?;
    let extent = session.extent.unwrap_or_default();
    let place = |place: Option<pb::Vector3>| palpate_vector::own(from_vector(place.as_ref()));
    let top_m = extent.top_m.or(extent.middle_m);
    let [least_m, most_m, middle_m, top_m] = [extent.least_m, extent.most_m, extent.middle_m, top_m].map(place);
    let extent = palpate_extent { least_m, most_m, middle_m, top_m };
    let session_id = session.session_id;
    let followed = Followed::new(shared.server.clone(), shared.channel.clone(), session_id.clone());
    let tools = Arc::new(HeldTools::new(Arc::new(followed), "libpalpate"));
    let handle = palpate_session { shared: shared.clone(), session_id, tools, extent };
    Ok(Box::into_raw(Box::new(handle)))
}

fn create(shared: &Arc<Connected>, source: Source) -> Result<*mut palpate_session, CodedError> {
    let request = pb::CreateSessionRequest { source: Some(source), ..Default::default() };
    let answer = shared.wait(shared.sessions().create_session(request))?;
    handle(shared, answer.into_inner().session)
}

/// Creates a session of one of the server's scenes. It runs at once. It exists until `palpate_session_delete`, or
/// until the server deletes it because it is idle. Writes a handle for `palpate_session_free`. Any thread; waits for
/// the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_create(
    server: *const palpate_server,
    scene_name: *const c_char,
    session: *mut *mut palpate_session,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (shared, name, out) = unsafe {
            (
                &at(server, "server is null")?.shared,
                text(scene_name, "scene_name")?,
                at_mut(session, "session is null")?,
            )
        };
        *out = std::ptr::null_mut();
        *out = create(shared, Source::SceneName(name.to_owned()))?;
        Ok(())
    })
}

/// Smallest size of the parts of an uploaded file, bytes.
const PART_BYTES: usize = 256 << 10;

/// Creates a session of a scene that was read here, after uploading its mesh. `said` is what the scene file says
/// about the mesh.
fn create_own(
    shared: &Arc<Connected>,
    scene: &Scene,
    said: Option<MeshFile>,
) -> Result<*mut palpate_session, CodedError> {
    let to_send = SceneToSend::of(scene, said.as_ref(), None);
    let mut mesh_id = String::new();
    if let Some(MeshToSend { name, bytes, unit }) = &to_send.upload {
        let calls = u32::try_from(bytes.len() / PART_BYTES).unwrap_or(u32::MAX).saturating_add(1);
        let answer = shared.wait_for(calls, upload_mesh(shared.channel.clone(), name, bytes, unit, None, false))?;
        if let Some(report) = answer.report.filter(|report| report.refused) {
            let what = report.problems.first().map(|problem| format!("{}: {}", problem.element, problem.what));
            return Err(CodedError::argument(format!("the mesh can't be used: {}", what.unwrap_or_default())));
        }
        mesh_id = answer.mesh_id;
    }
    create(shared, Source::Scene(to_send.with_mesh_id(mesh_id)))
}

fn refused(refusal: Refusal) -> CodedError {
    CodedError::argument(refusal.to_string())
}

/// Creates a session of a scene file of your own (TOML), by its path. If the file names a mesh, that is read from the
/// given path and sent to the server. The session runs at once, and exists until `palpate_session_delete`, or until
/// it is idle for long. Writes a handle for `palpate_session_free`. Any thread; waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_create_from_file(
    server: *const palpate_server,
    scene_file: *const c_char,
    session: *mut *mut palpate_session,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (shared, path, out) = unsafe {
            (
                &at(server, "server is null")?.shared,
                Path::new(text(scene_file, "scene_file")?),
                at_mut(session, "session is null")?,
            )
        };
        *out = std::ptr::null_mut();
        let limits = Limits::default();
        let scene = Scene::load(path, &[], &limits).map_err(refused)?;
        *out = create_own(shared, &scene, mesh_file(path, &limits).map_err(refused)?)?;
        Ok(())
    })
}

/// Creates a session of the text of a scene file, with a mesh in memory: the `byte_count` bytes of a file (OBJ, STL,
/// PLY, glTF, Gmsh or VTK) that `[mesh]` of the text calls `mesh_name`. Sends the mesh to the server. The session
/// runs at once, and exists until `palpate_session_delete`, or until it is idle for long. Writes a handle for
/// `palpate_session_free`. Any thread; waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_create_from_mesh(
    server: *const palpate_server,
    scene_text: *const c_char,
    mesh_name: *const c_char,
    mesh_bytes: *const u8,
    byte_count: usize,
    session: *mut *mut palpate_session,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (shared, scene, mesh_name, out) = unsafe {
            (
                &at(server, "server is null")?.shared,
                text(scene_text, "scene_text")?,
                text(mesh_name, "mesh_name")?,
                at_mut(session, "session is null")?,
            )
        };
        *out = std::ptr::null_mut();
        if mesh_bytes.is_null() {
            return Err(CodedError::argument("mesh_bytes is null"));
        }
        // SAFETY: the caller guarantees this number of bytes.
        let bytes = unsafe { std::slice::from_raw_parts(mesh_bytes, byte_count) };
        let made = Scene::parse_given("scene_text", scene, (mesh_name, bytes), &Limits::default()).map_err(refused)?;
        *out = create_own(shared, &made, sent::said("scene_text", scene).map_err(refused)?)?;
        Ok(())
    })
}

/// Creates a session of the text of a scene file that names no other file: a sheet, or a generated organ. The session
/// runs at once, and exists until `palpate_session_delete`, or until it is idle for long. Writes a handle for
/// `palpate_session_free`. Any thread; waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_create_from_text(
    server: *const palpate_server,
    scene_text: *const c_char,
    session: *mut *mut palpate_session,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (shared, scene, out) = unsafe {
            (
                &at(server, "server is null")?.shared,
                text(scene_text, "scene_text")?,
                at_mut(session, "session is null")?,
            )
        };
        *out = std::ptr::null_mut();
        let made = Scene::parse("scene_text", scene, &[], &Limits::default()).map_err(refused)?;
        *out = create_own(shared, &made, sent::said("scene_text", scene).map_err(refused)?)?;
        Ok(())
    })
}

/// Joins an existing session by its ID, also one on another server of the fleet. Writes a handle for
/// `palpate_session_free`, or null after an error. Returns `PALPATE_REFUSED` if there is no such session. Any thread;
/// waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_join(
    server: *const palpate_server,
    session_id: *const c_char,
    session: *mut *mut palpate_session,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (shared, id, out) = unsafe {
            (
                &at(server, "server is null")?.shared,
                text(session_id, "session_id")?,
                at_mut(session, "session is null")?,
            )
        };
        *out = std::ptr::null_mut();
        let request = pb::GetSessionRequest { session_id: id.to_owned() };
        let answer = shared.follow(|mut sessions| {
            let request = request.clone();
            async move { sessions.get_session(request).await }
        })?;
        *out = handle(shared, answer.into_inner().session)?;
        Ok(())
    })
}

/// Writes the session's ID, by which others join it, and the number of bytes it takes, as `palpate_scenes` does. Any
/// thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_id(
    session: *const palpate_session,
    id: *mut c_char,
    capacity: usize,
    needed: *mut usize,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        unsafe { write_text(&at(session, "session is null")?.session_id, id, capacity, needed) }
    })
}

/// Writes the bounding box of the tissue at rest. It never changes. Never waits. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_extent(
    session: *const palpate_session,
    extent: *mut palpate_extent,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (session, out) = unsafe { (at(session, "session is null")?, at_mut(extent, "extent is null")?) };
        *out = session.extent;
        Ok(())
    })
}

/// Writes the present state of the session. Any thread; waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_status_of(
    session: *const palpate_session,
    status: *mut palpate_session_status,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (session, out) = unsafe { (at(session, "session is null")?, at_mut(status, "status is null")?) };
        let session = session.get()?;
        *out = palpate_session_status {
            step: session.step,
            time_s: session.simulation_time_s,
            topology_version: session.topology_version,
            severed: session.severed,
            pieces: session.pieces,
            cuts_exhausted: u32::from(session.cuts_exhausted),
        };
        Ok(())
    })
}

/// Writes how many of the severed springs (`palpate_session_status.severed`) are anchor springs: blades and heat sever those of a scene with
/// `anchor_depth_m`. Any thread; waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_severed_anchors(
    session: *const palpate_session,
    count: *mut u32,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (session, count) = unsafe { (at(session, "session is null")?, at_mut(count, "count is null")?) };
        *count = session.get()?.severed_anchors;
        Ok(())
    })
}

/// Initializes a change so that it changes nothing. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_change_init(change: *mut palpate_change) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promise.
        let change = unsafe { at_mut(change, "change is null") }?;
        let stays = f64::NAN;
        *change = palpate_change {
            stiffness_n_per_m: stays,
            damping_n_s_per_m: stays,
            anchor_stiffness_n_per_m: stays,
            volume_stiffness_pa: stays,
        };
        Ok(())
    })
}

/// Changes the tissue from the next step on; all users who touch it feel the change. Returns `PALPATE_REFUSED` for
/// a value out of its range: then nothing changes. Any thread; waits for the server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_change(
    session: *const palpate_session,
    change: *const palpate_change,
) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promises.
        let (session, change) = unsafe { (at(session, "session is null")?, at(change, "change is null")?) };
        let given = |value: f64| Some(value).filter(|value| !value.is_nan());
        let request = pb::UpdateTissueRequest {
            session_id: session.session_id.clone(),
            stiffness_n_per_m: given(change.stiffness_n_per_m),
            damping_n_s_per_m: given(change.damping_n_s_per_m),
            anchor_stiffness_n_per_m: given(change.anchor_stiffness_n_per_m),
            volume_stiffness_pa: given(change.volume_stiffness_pa),
            at_step: None,
        };
        session.shared.follow(|mut sessions| {
            let request = request.clone();
            async move { sessions.update_tissue(request).await }
        })?;
        Ok(())
    })
}

/// Deletes the session on the server, for all users. The handle must still be freed. Any thread; waits for the
/// server.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_delete(session: *const palpate_session) -> palpate_result {
    guard(|| {
        // SAFETY: the caller's promise.
        let session = unsafe { at(session, "session is null") }?;
        let request = pb::DeleteSessionRequest { session_id: session.session_id.clone() };
        session.shared.follow(|mut sessions| {
            let request = request.clone();
            async move { sessions.delete_session(request).await }
        })?;
        Ok(())
    })
}

/// Frees a handle. The session continues on the server. Null is allowed. Any thread, once.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_session_free(session: *mut palpate_session) {
    // SAFETY: the caller's promise.
    guard(|| unsafe { free(session) });
}
