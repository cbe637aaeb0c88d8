//! Clients and servers are killed at random moments under load (`kill -9`): the remaining ones continue, tools are
//! released, clients come back by themselves, and what a device renders stays within its envelope throughout.
//!
//! Twice in every run of the tests; `make soak` does it KILLS=50 times (PALPATE_KILLS, and PALPATE_SEED for other
//! moments).
#![cfg(unix)]

use std::io::Read;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use crate::common::course::DeviceTrace;
use crate::common::proxy::Proxy;
use crate::common::random::TestRandom;
use crate::common::server::{TEST_TIMEOUT, TestServer, client_program};
use palpate_proto::pb;

/// Sessions of a load, each with a client that holds its tool 0.
const SESSIONS: usize = 4;

/// So many commands, one a tick, a device is left alone for after its server was killed: it touches, and is enabled
/// again.
const TOUCHES: u64 = 1000;

/// A server that lets everybody in: on a busy machine steps take long, and a session more would make others late.
fn start(config: &Path) -> TestServer {
    std::fs::write(config, "[limits]\nthread_share = 1000.0\n").unwrap();
    TestServer::start(&["--log", "error", "--config", config.to_str().unwrap()])
}

/// A program that is killed together with the process that started it.
struct Program(Child);

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn load(server: &TestServer) -> Program {
    let sessions = SESSIONS.to_string();
    let arguments = ["load", "--server", &server.url, "--sessions", &sessions, "--seconds", "600", "--ramp-s", "0.1"];
    let child = Command::new(client_program()).args(arguments).stdout(Stdio::null()).stderr(Stdio::piped()).spawn();
    Program(child.unwrap())
}

/// Sessions of the paper's scene (the device's has another) of which a tool is held.
async fn held(server: &TestServer) -> Vec<String> {
    let listed = server.sessions().await.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner();
    let held = listed.sessions.into_iter().filter(|one| one.scene_name == "paper" && !one.held_tools.is_empty());
    held.map(|session| session.session_id).collect()
}

async fn held_at_last(server: &TestServer, clients: &mut Program, wanted: usize) -> Vec<String> {
    let begun = Instant::now();
    loop {
        let held = held(server).await;
        if held.len() == wanted {
            return held;
        }
        if begun.elapsed() > TEST_TIMEOUT {
            let _ = clients.0.kill();
            let mut said = String::new();
            clients.0.stderr.take().unwrap().read_to_string(&mut said).unwrap();
            panic!("{} sessions are held, not {wanted}; the load says: {said}", held.len());
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn who_is_killed_holds_nothing_and_who_is_left_comes_back() {
    let of = |name: &str, otherwise: u64| std::env::var(name).map_or(otherwise, |text| text.parse().unwrap());
    let (kills, seed) = (of("PALPATE_KILLS", 2), of("PALPATE_SEED", 1));
    let mut random = TestRandom(seed);
    // Commands of a load before a kill, and ms without a server.
    let mut moment = move || random.below(1500);
    let address = |server: &TestServer| server.url.trim_start_matches("http://").to_owned();
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    let mut server = start(&config);
    let proxy = Proxy::start(address(&server), Duration::from_millis(2)).await;
    let file = folder.path().join("course.csv");
    let begun = Instant::now();
    // It ends after enough kills, whose duration is not known before.
    let mut bridge = Program(
        Command::new(client_program())
            .args(["bridge", "--scene", "liver", "--server", &proxy.url(), "--course"])
            .arg(&file)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap(),
    );
    server.until_applied("liver", TOUCHES).await;
    for kill in 1..=kills {
        let mut clients = load(&server);
        let before = held_at_last(&server, &mut clients, SESSIONS).await;
        server.until_applied("paper", moment()).await;
        clients.0.kill().unwrap();
        held_at_last(&server, &mut clients, 0).await;
        // Anybody may take them now.
        for session_id in before {
            let mut haptics = server.haptics().await;
            let request = pb::AcquireToolRequest { session_id: session_id.clone(), tool: 0, ..Default::default() };
            let lease_id = haptics.acquire_tool(request).await.unwrap().into_inner().lease_id;
            haptics.release_tool(pb::ReleaseToolRequest { session_id, lease_id }).await.unwrap();
        }
        let mut clients = load(&server);
        held_at_last(&server, &mut clients, SESSIONS).await;
        server.until_applied("paper", moment()).await;
        server.child.kill().unwrap();
        // A load without a server has nothing to measure, and says so.
        let ended = tokio::task::spawn_blocking(move || clients.0.wait().unwrap()).await.unwrap();
        assert!(!ended.success());
        tokio::time::sleep(Duration::from_millis(moment())).await;
        server = start(&config);
        proxy.aim(address(&server));
        server.until_applied("liver", TOUCHES).await;
        println!("{kill} of {kills} after {:.0} s", begun.elapsed().as_secs_f64());
    }
    let told = Command::new("kill").args(["-INT", &bridge.0.id().to_string()]).status().unwrap();
    assert!(told.success() && bridge.0.wait().unwrap().success());
    let course = DeviceTrace::take(&file);
    let pauses = course.keeps_to_the_envelope();
    assert!(pauses.len() >= kills as usize, "killed {kills} times, paused at {pauses:?} s");
    assert!(course.comes_back_after(pauses[pauses.len() - 1]), "it never came back");
}
