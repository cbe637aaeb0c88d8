//! A real server, in a process of its own, and short ways to talk to it.
#![allow(
    dead_code,
    unreachable_pub,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::disallowed_methods
)]

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Output, Stdio};
use std::sync::OnceLock;
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::{Duration, Instant};

use palpate_haptics::Law;
use palpate_proto::{pb, touch};
use pb::haptic_service_client::HapticServiceClient;
use pb::session_service_client::SessionServiceClient;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use pb::view_service_client::ViewServiceClient;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tonic::transport::Channel;
use tonic::{Code, Status, Streaming};
use tonic_types::StatusExt;

/// Timeout of a test: long enough for any machine.
pub const TEST_TIMEOUT: Duration = Duration::from_secs(60);

/// Time between two looks at what is waited for.
const LOOK_INTERVAL: Duration = Duration::from_millis(5);

/// Waits until `holds`, and returns how long that took. Panics with `what` after [`TEST_TIMEOUT`].
pub async fn until(what: &str, mut holds: impl AsyncFnMut() -> bool) -> Duration {
    let begun = Instant::now();
    while !holds().await {
        assert!(begun.elapsed() < TEST_TIMEOUT, "never: {what}");
        tokio::time::sleep(LOOK_INTERVAL).await;
    }
    begun.elapsed()
}

/// Waits as [`until`] does, on a thread that runs no futures.
pub fn until_blocking(what: &str, mut holds: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !holds() {
        assert!(begun.elapsed() < TEST_TIMEOUT, "never: {what}");
        std::thread::sleep(LOOK_INTERVAL);
    }
}

/// A configuration, from the folder of the repository, without the limit on a stepping thread's time.
const BUSY_MACHINE: &str = "tests/common/busy_machine.toml";

/// The folder of the repository, with the scenes and scripts.
pub fn repository() -> &'static Path {
    let package = Path::new(env!("CARGO_MANIFEST_DIR"));
    package.ancestors().find(|folder| folder.join("scenes").is_dir()).unwrap()
}

/// The folder of the programs, which are built if they are not there or not new.
fn programs() -> &'static Path {
    static BUILT: OnceLock<PathBuf> = OnceLock::new();
    BUILT.get_or_init(|| {
        let mut build = Command::new(env!("CARGO"));
        // All programs, as `make build` does: a part of them might want other features of what both use, and so all of
        // that once more.
        build.args(["build", "--quiet", "--workspace", "--bins"]).current_dir(repository());
        // Benches have no `foxglove`.
        #[allow(unexpected_cfgs)]
        let optional =
            [("palpate/otlp", cfg!(feature = "otlp")), ("palpate-programs/foxglove", cfg!(feature = "foxglove"))];
        for (feature, _) in optional.iter().filter(|feature| feature.1) {
            build.args(["--features", feature]);
        }
        // Cargo's variables for a test would change the input of build scripts, and libraries would be built once
        // more.
        let of_package = |key: &str| {
            let starts = ["CARGO_MANIFEST_", "CARGO_PKG_", "CARGO_BIN_"].iter().any(|start| key.starts_with(start));
            starts || key == "CARGO_CRATE_NAME" || key == "CARGO_PRIMARY_PACKAGE"
        };
        for (key, _) in std::env::vars().filter(|(key, _)| of_package(key)) {
            build.env_remove(key);
        }
        if !cfg!(debug_assertions) {
            build.arg("--release");
        }
        assert!(build.status().unwrap().success());
        // Beside the folder `deps` of this test.
        std::env::current_exe().unwrap().ancestors().nth(2).unwrap().to_owned()
    })
}

/// The client program, built if it is not there or not new.
pub fn client_program() -> PathBuf {
    programs().join("palpate-client")
}

/// The server program. Cargo builds it for tests and benches of its own package.
pub fn server_program() -> PathBuf {
    option_env!("CARGO_BIN_EXE_palpate").map_or_else(|| programs().join("palpate"), PathBuf::from)
}

/// The server's program, to its end. One that goes on, as a server would that should have been refused, is ended after
/// [`TEST_TIMEOUT`] and has no exit code.
pub fn palpate(arguments: &[&str]) -> Output {
    let child = Command::new(server_program())
        .args(arguments)
        .current_dir(repository())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let (id, ended) = (child.id(), channel::<()>());
    let guard = std::thread::spawn(move || {
        if ended.1.recv_timeout(TEST_TIMEOUT) == Err(RecvTimeoutError::Timeout) {
            drop(Command::new("kill").args(["-KILL", &id.to_string()]).status());
        }
    });
    let output = child.wait_with_output().unwrap();
    drop(ended.0);
    guard.join().unwrap();
    output
}

pub struct TestServer {
    pub child: Child,
    pub url: String,
    /// Its output after the line with its address.
    pub out: BufReader<ChildStdout>,
}

impl TestServer {
    /// Starts a server that refuses no session for want of processor time, which a busy machine would decide.
    /// A configuration among the arguments replaces this one.
    pub fn start(arguments: &[&str]) -> Self {
        let own: &[&str] = if arguments.contains(&"--config") { &[] } else { &["--config", BUSY_MACHINE] };
        TestServer::start_at("127.0.0.1:0", &[own, arguments].concat())
    }

    /// Starts a server that gives heavy work, such as the tissue of an exercise, all the time that it takes on a busy machine. `config` is
    /// added to its configuration, before the limits; `folder` takes the file.
    pub fn start_patiently(folder: &Path, config: &str, limits: &str) -> Self {
        let file = folder.join("server.toml");
        let text = format!("datagrams = false\n{config}\n[limits]\nwork_s = 300.0\n{limits}\n");
        std::fs::write(&file, text).unwrap();
        TestServer::start(&["--config", file.to_str().unwrap()])
    }

    /// Starts a server at that address.
    pub fn start_at(listen: &str, arguments: &[&str]) -> Self {
        let mut command = Command::new(server_program());
        command.args(["serve", "--listen", listen]).args(arguments);
        if std::env::var_os("PALPATE_SHOW_LOGS").is_some() {
            return TestServer::spawn(command.stderr(Stdio::inherit()));
        }
        TestServer::spawn(command.stderr(Stdio::piped()))
    }

    /// A server that a script of the shell starts, such as one that sets limits: `$0` is the program, `$1` and so on
    /// `arguments`.
    pub fn by_script(script: &str, arguments: &[&std::ffi::OsStr]) -> Self {
        let mut command = Command::new("sh");
        command.args(["-c", script]).arg(server_program()).args(arguments);
        TestServer::spawn(command.stderr(Stdio::piped()))
    }

    /// A server that a command starts, which prints its address first.
    pub fn spawn(command: &mut Command) -> Self {
        let mut child = command.current_dir(repository()).stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        let mut out = BufReader::new(child.stdout.take().unwrap());
        out.read_line(&mut line).unwrap();
        let url = line.split_whitespace().last().unwrap_or_default().to_owned();
        assert!(url.contains("://127.0.0.1:"), "{line:?}");
        TestServer { child, url, out }
    }

    pub async fn channel(&self) -> Channel {
        Channel::from_shared(self.url.clone()).unwrap().connect().await.unwrap()
    }

    pub async fn sessions(&self) -> SessionServiceClient<Channel> {
        SessionServiceClient::new(self.channel().await)
    }

    pub async fn haptics(&self) -> HapticServiceClient<Channel> {
        HapticServiceClient::new(self.channel().await)
    }

    pub async fn views(&self) -> ViewServiceClient<Channel> {
        ViewServiceClient::new(self.channel().await)
    }

    /// A session of the paper's scene.
    pub async fn paper(&self, paused: bool) -> String {
        let source = pb::create_session_request::Source::SceneName("paper".into());
        self.create(source, paused).await.unwrap().session_id
    }

    pub async fn create(
        &self,
        source: pb::create_session_request::Source,
        paused: bool,
    ) -> Result<pb::Session, Status> {
        let request = pb::CreateSessionRequest { source: Some(source), paused, idle_timeout_s: None };
        Ok(self.sessions().await.create_session(request).await?.into_inner().session.unwrap())
    }

    pub async fn start_until(&self, session_id: &str, step: u64) {
        let request = pb::StartSessionRequest { session_id: session_id.into(), until_step: Some(step) };
        self.sessions().await.start_session(request).await.unwrap();
    }

    pub async fn hash_at(&self, session_id: &str, step: u64) -> String {
        let request = pb::GetStateHashRequest { session_id: session_id.into(), at_step: Some(step) };
        let mut sessions = self.sessions().await;
        let answer = tokio::time::timeout(TEST_TIMEOUT, sessions.get_state_hash(request));
        answer.await.unwrap().unwrap().into_inner().state_hash
    }

    pub async fn status(&self, session_id: &str) -> pb::Session {
        let request = pb::GetSessionRequest { session_id: session_id.into() };
        self.sessions().await.get_session(request).await.unwrap().into_inner().session.unwrap()
    }

    /// Waits until `more` commands have acted in the sessions of a scene, all together, since it was asked; tells
    /// whose sessions they are.
    pub async fn until_applied(&self, scene_name: &str, more: u64) -> Vec<pb::Session> {
        let mut sessions = self.sessions().await;
        let waited = tokio::time::timeout(TEST_TIMEOUT, async {
            let mut before = None;
            loop {
                let listed = sessions.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner().sessions;
                let ours: Vec<_> = listed.into_iter().filter(|session| session.scene_name == scene_name).collect();
                let applied: u64 = ours.iter().map(|session| session.commands.unwrap().applied).sum();
                if applied >= *before.get_or_insert(applied) + more {
                    return ours;
                }
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        });
        waited.await.unwrap_or_else(|_| panic!("{more} commands to {scene_name} do not come"))
    }

    /// Waits until no tool of any session is held.
    pub async fn until_let_go(&self) {
        let mut sessions = self.sessions().await;
        let waited = tokio::time::timeout(TEST_TIMEOUT, async {
            loop {
                let listed = sessions.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner().sessions;
                if listed.iter().all(|session| session.held_tools.is_empty()) {
                    return;
                }
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        });
        waited.await.expect("a tool was never released");
    }

    /// Ends the server. Returns its log.
    pub fn log(mut self) -> String {
        let _ = self.child.kill();
        let _ = self.child.wait();
        let mut text = String::new();
        self.child.stderr.take().unwrap().read_to_string(&mut text).unwrap();
        text
    }
}

impl Drop for TestServer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A haptic stream.
pub struct TestTouch {
    outbound: Option<mpsc::Sender<pb::TouchRequest>>,
    inbound: Streaming<pb::TouchResponse>,
    pub opened: Option<pb::TouchOpened>,
}

impl TestTouch {
    pub async fn open(server: &TestServer, open: pb::TouchOpen) -> Result<Self, Status> {
        let (outbound, messages) = mpsc::channel(4096);
        outbound.send(pb::TouchRequest { message: Some(Say::Open(open)) }).await.unwrap();
        let inbound = server.haptics().await.touch(ReceiverStream::new(messages)).await?.into_inner();
        let mut touch = TestTouch { outbound: Some(outbound), inbound, opened: None };
        match touch.hear().await? {
            Some(Heard::Opened(opened)) => touch.opened = Some(opened),
            other => panic!("{other:?}"),
        }
        Ok(touch)
    }

    /// Holds tool 0 for a minute.
    pub async fn hold(server: &TestServer, session_id: &str) -> Self {
        TestTouch::open(server, open(session_id, &[0])).await.unwrap()
    }

    pub async fn say(&self, message: Say) {
        self.outbound.as_ref().unwrap().send(pb::TouchRequest { message: Some(message) }).await.unwrap();
    }

    pub async fn command(&self, command: pb::Command) {
        self.say(Say::Command(command)).await;
    }

    /// The same, of a stream that may have ended: whether it went out.
    pub async fn try_command(&self, command: pb::Command) -> bool {
        let message = pb::TouchRequest { message: Some(Say::Command(command)) };
        self.outbound.as_ref().unwrap().send(message).await.is_ok()
    }

    /// No more from this side.
    pub fn finish(&mut self) {
        self.outbound = None;
    }

    pub async fn hear(&mut self) -> Result<Option<Heard>, Status> {
        let message =
            tokio::time::timeout(TEST_TIMEOUT, self.inbound.message()).await.expect("the server is silent")?;
        Ok(message.map(|message| message.message.unwrap()))
    }

    pub async fn sample(&mut self) -> pb::Sample {
        loop {
            match self.hear().await.unwrap().unwrap() {
                Heard::Sample(sample) => return sample,
                Heard::Rejection(rejection) => panic!("{rejection:?}"),
                _ => {}
            }
        }
    }

    /// The first sample that satisfies `wanted`.
    pub async fn sample_with(&mut self, wanted: impl Fn(&pb::Sample) -> bool) -> pb::Sample {
        loop {
            let sample = self.sample().await;
            if wanted(&sample) {
                return sample;
            }
        }
    }

    /// The law that takes the place of the coarse one of `opened`.
    pub async fn exact_law(&mut self) -> Law {
        loop {
            if let Heard::ForceLaw(update) = self.hear().await.unwrap().unwrap() {
                return touch::from_law(&update.law.expect("the coarse law stays")).unwrap();
            }
        }
    }

    pub async fn rejection(&mut self) -> pb::Rejection {
        loop {
            if let Heard::Rejection(rejection) = self.hear().await.unwrap().unwrap() {
                return rejection;
            }
        }
    }

    /// All that was said before has been taken in.
    pub async fn settle(&mut self) {
        self.say(Say::Renew(pb::Renew { client_time_ns: 77, datagrams: false })).await;
        loop {
            match self.hear().await.unwrap().unwrap() {
                Heard::Renewed(renewed) => return assert_eq!(renewed.client_time_ns, 77),
                Heard::Rejection(rejection) => panic!("{rejection:?}"),
                _ => {}
            }
        }
    }
}

pub fn open(session_id: &str, tools: &[u32]) -> pb::TouchOpen {
    pb::TouchOpen {
        session_id: session_id.into(),
        tools: tools.to_vec(),
        lease_s: Some(60.0),
        holder: "test".into(),
        ..Default::default()
    }
}

pub fn force(tool: u32, sequence: u64, z_n: f64) -> pb::Command {
    let force = pb::Force {
        centre: Some(pb::force::Centre::Point(pb::GridPoint { x: 15, y: 15 })),
        force_n: Some(pb::Vector3 { x: 0.0, y: 0.0, z: z_n }),
        falloff_per_m: Some(150.0),
        falloff_offset: None,
    };
    let sequence = Some(sequence);
    pb::Command { tool, sequence, action: Some(pb::command::Action::Force(force)), ..Default::default() }
}

pub fn position(tool: u32, sequence: u64, z_m: f64) -> pb::Command {
    let position = pb::Position {
        point: Some(pb::GridPoint { x: 15, y: 15 }),
        vertex: None,
        target: Some(pb::position::Target::DisplacementM(pb::Vector3 { x: 0.0, y: 0.0, z: z_m })),
    };
    let sequence = Some(sequence);
    pb::Command { tool, sequence, action: Some(pb::command::Action::Position(position)), ..Default::default() }
}

/// The paper's scene with so many points.
pub fn sheet(nx: u32, ny: u32) -> pb::create_session_request::Source {
    let limits = palpate_tissue::limits::Limits { points: 1 << 40, ..Default::default() };
    let points = format!("sheet.points=[{nx}, {ny}]");
    let scene = palpate_tissue::scene::Scene::parse("paper", palpate_tissue::scene::PAPER, &[points], &limits).unwrap();
    pb::create_session_request::Source::Scene(palpate_session::wire::scene::scene(&scene))
}

/// The steps of the changes of the tissue that wait, as a journal has them. `None`: it can't be read yet.
pub fn waiting(journal: &Path) -> Option<Vec<u64>> {
    let survey =
        palpate_session::journal::JournalReader::open(journal).and_then(|mut reader| reader.survey(&mut |_| {}));
    Some(survey.ok()?.waiting.iter().map(|input| input.step).collect())
}

/// Code, reason and field of an error.
pub fn told(status: &Status) -> (Code, String, String) {
    let info = status.get_details_error_info().unwrap_or_else(|| panic!("{status:?}"));
    assert_eq!(info.domain, "palpate");
    (status.code(), info.reason, info.metadata.get("field").cloned().unwrap_or_default())
}
