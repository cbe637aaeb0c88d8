//! Callers with tokens of their own, at one server that asks for them.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used, clippy::disallowed_methods)]

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Mutex;

use palpate::server::identity::{self, Role};
use palpate_proto::pb;
use pb::haptic_service_client::HapticServiceClient;
use pb::session_service_client::SessionServiceClient;
use pb::view_service_client::ViewServiceClient;
use tempfile::TempDir;
use tonic::metadata::{Ascii, MetadataValue};
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Request, Status};
use tonic_types::StatusExt;

/// A file of tokens that changes while a server reads it.
pub struct TokenFile {
    _folder: TempDir,
    file: PathBuf,
    /// Entries of the file, by name.
    entries: Mutex<BTreeMap<String, String>>,
}

impl TokenFile {
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("tokens.toml");
        let keys = TokenFile { _folder: folder, file, entries: Mutex::default() };
        keys.change(|_| {});
        keys
    }

    /// Returns the file for `palpate serve --tokens`.
    pub fn file(&self) -> &str {
        self.file.to_str().unwrap()
    }

    /// Another file in the same folder, such as a configuration; where it is.
    pub fn beside(&self, name: &str, text: &str) -> String {
        let file = self.file.with_file_name(name);
        std::fs::write(&file, text).unwrap();
        file.to_str().unwrap().to_owned()
    }

    /// Replaces the whole file at once, so that no reader sees half of it.
    fn change(&self, change: impl FnOnce(&mut BTreeMap<String, String>)) {
        let mut entries = self.entries.lock().unwrap();
        change(&mut entries);
        let beside = self.file.with_extension("new");
        std::fs::write(&beside, entries.values().map(String::as_str).collect::<String>()).unwrap();
        std::fs::rename(beside, &self.file).unwrap();
    }

    /// A new token with these roles. A server that runs already takes a second to know it.
    pub fn admit(&self, name: &str, roles: &[Role]) -> String {
        let token = identity::new_token().unwrap();
        let entry = identity::entry(name, roles, &token).unwrap();
        self.change(|entries| drop(entries.insert(name.to_owned(), entry)));
        token
    }

    /// From now on the file does not have it.
    pub fn strike(&self, name: &str) {
        self.change(|entries| drop(entries.remove(name)));
    }
}

/// Shows a token with each call.
#[derive(Clone)]
pub struct TestBearer(MetadataValue<Ascii>);

impl Interceptor for TestBearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        request.metadata_mut().insert("authorization", self.0.clone());
        Ok(request)
    }
}

/// A connection over which a token is shown.
pub type Door = InterceptedService<Channel, TestBearer>;

/// A caller of a server, with its token.
#[derive(Clone)]
pub struct TestCaller {
    pub url: String,
    bearer: TestBearer,
}

impl TestCaller {
    pub fn new(url: &str, token: &str) -> Self {
        TestCaller { url: url.to_owned(), bearer: TestBearer(format!("Bearer {token}").parse().unwrap()) }
    }

    /// Returns this caller with another route, such as a proxy.
    pub fn by(&self, url: &str) -> Self {
        TestCaller { url: url.to_owned(), ..self.clone() }
    }

    /// "127.0.0.1:7117".
    pub fn address(&self) -> &str {
        self.url.trim_start_matches("http://")
    }

    /// A connection of its own, of that shape.
    pub async fn dial(&self, shape: impl FnOnce(Endpoint) -> Endpoint) -> Result<Door, Status> {
        let endpoint = shape(Channel::from_shared(self.url.clone()).unwrap());
        let channel = endpoint.connect().await.map_err(|error| Status::unavailable(error.to_string()))?;
        Ok(InterceptedService::new(channel, self.bearer.clone()))
    }

    /// A connection of its own, as any client would make it.
    pub async fn door(&self) -> Result<Door, Status> {
        self.dial(|endpoint| endpoint).await
    }
}

pub fn sessions(door: &Door) -> SessionServiceClient<Door> {
    SessionServiceClient::new(door.clone())
}

pub fn haptics(door: &Door) -> HapticServiceClient<Door> {
    HapticServiceClient::new(door.clone())
}

pub fn views(door: &Door) -> ViewServiceClient<Door> {
    ViewServiceClient::new(door.clone())
}

/// A session of this scene; its id.
pub async fn create(door: &Door, scene: pb::Scene, paused: bool) -> Result<String, Status> {
    let source = Some(pb::create_session_request::Source::Scene(scene));
    let request = pb::CreateSessionRequest { source, paused, idle_timeout_s: None };
    Ok(sessions(door).create_session(request).await?.into_inner().session.unwrap_or_default().session_id)
}

/// Points along a side of an ordinary sheet: the paper's, or what a server that was not optimized steps as fast.
pub const SIDE: u32 = if cfg!(debug_assertions) { 9 } else { 31 };

/// Its middle.
pub const MIDDLE: [u32; 2] = [SIDE / 2; 2];

/// A sheet of the paper's tissue with so many points.
pub fn sheet(points_x: u32, points_y: u32) -> pb::Scene {
    let limits = palpate_tissue::limits::Limits::default();
    let paper = palpate_tissue::scene::Scene::parse("paper", palpate_tissue::scene::PAPER, &[], &limits).unwrap();
    let mut scene = palpate_session::wire::scene::scene(&paper);
    let sheet = scene.sheet.as_mut().unwrap();
    (sheet.points_x, sheet.points_y) = (Some(points_x), Some(points_y));
    scene
}

/// A force on the point at (x, y), and on what is around it within a few spacings of the paper's.
pub fn push(tool: u32, sequence: u64, [x, y]: [u32; 2], z_n: f64) -> pb::Command {
    let force = pb::Force {
        centre: Some(pb::force::Centre::Point(pb::GridPoint { x, y })),
        force_n: Some(pb::Vector3 { x: 0.0, y: 0.0, z: z_n }),
        falloff_per_m: Some(150.0),
        falloff_offset: None,
    };
    let sequence = Some(sequence);
    pb::Command { tool, sequence, action: Some(pb::command::Action::Force(force)), ..Default::default() }
}

/// Returns one force on every point, so that all of a tissue moves.
pub fn push_all(tool: u32, sequence: u64, z_n: f64) -> pb::Command {
    let mut command = push(tool, sequence, [0, 0], z_n);
    if let Some(pb::command::Action::Force(force)) = &mut command.action {
        force.falloff_per_m = Some(0.0);
    }
    command
}

/// Why a call failed: our reason if there is one, else what the transport says.
pub fn why(status: &Status) -> String {
    status.get_details_error_info().map_or_else(|| format!("{:?}: {}", status.code(), status.message()), |e| e.reason)
}
