//! `palpate-client load`: what it tells is true, and it leaves nothing behind.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

#[path = "common/server.rs"]
mod server;

use std::process::{Command, Output, Stdio};
use std::time::Duration;

use palpate_proto::pb;
use serde_json::Value;
use server::{PATIENCE, Server, client_program};

fn load(server: &Server, arguments: &str) -> Output {
    let server = if arguments.contains("--server") { String::new() } else { format!("--server {}", server.url) };
    let all = format!("load {server} --quiet {arguments}");
    Command::new(client_program()).args(all.split_whitespace()).output().unwrap()
}

fn told(server: &Server, arguments: &str) -> Value {
    let output = load(server, &format!("--json {arguments}"));
    assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn number(told: &Value, path: &str) -> f64 {
    told.pointer(path).and_then(Value::as_f64).unwrap_or_else(|| panic!("{path} is missing in {told}"))
}

async fn sessions(server: &Server) -> Vec<pb::Session> {
    server.sessions().await.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner().sessions
}

#[tokio::test(flavor = "multi_thread")]
async fn every_command_of_a_load_is_accounted_for_and_no_session_stays() {
    let server = Server::start(&[]);
    let told = told(&server, "--sessions 3 --clients-per-session 2 --viewers 1 --seconds 2 --rate-hz 500");
    assert_eq!((number(&told, "/sessions"), number(&told, "/lost"), number(&told, "/rejected")), (3.0, 0.0, 0.0));
    assert!(number(&told, "/commands") > 0.0, "{told}");
    assert!(number(&told, "/samples") > 0.0 && number(&told, "/frames") > 0.0, "{told}");
    assert!(number(&told, "/awake_points_mean") > 100.0, "{told}");
    assert!(number(&told, "/dilation_min") > 0.0, "{told}");
    for name in ["round_trip_us", "sample_gap_us", "frame_age_us"] {
        let quantiles = ["p50", "p99", "p999", "max"].map(|quantile| number(&told, &format!("/{name}/{quantile}")));
        assert!(quantiles.is_sorted() && quantiles[3] > 0.0, "{name} of {told}");
    }
    assert!(sessions(&server).await.is_empty());
}

/// 400,000 points 10,000 times a second, which no core does: its time goes on slower than ours, and that is told.
#[tokio::test(flavor = "multi_thread")]
async fn the_dilation_of_sessions_that_are_too_heavy_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, config) = (folder.path().join("heavy.toml"), folder.path().join("palpate.toml"));
    let paper = palpate::scene::PAPER.replace("points = [31, 31]", "points = [800, 500]");
    std::fs::write(&scene, paper + "[stepping]\nrate_hz = 10000.0\n[sleep]\ntolerance = 0.0\n").unwrap();
    std::fs::write(&config, "[limits]\nthread_share = 1000.0\nperiods_per_step = 20.0\n").unwrap();
    let server = Server::start(&["--config", config.to_str().unwrap()]);
    for clients in [0, 1] {
        let scene = scene.to_str().unwrap();
        let told = told(&server, &format!("--scene {scene} --sessions 1 --clients-per-session {clients} --seconds 2"));
        let dilation = number(&told, "/dilation_min");
        assert!(dilation > 0.0 && dilation < 0.9, "{clients} clients: {told}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn sessions_without_clients_are_kept_awake() {
    let server = Server::start(&[]);
    let told = told(&server, "--sessions 2 --clients-per-session 0 --seconds 3");
    assert_eq!((number(&told, "/samples"), number(&told, "/broken_streams")), (0.0, 0.0));
    assert!(number(&told, "/dilation_min") > 0.0 && told["round_trip_us"]["p50"].is_null(), "{told}");
    assert!(sessions(&server).await.is_empty());
}

#[test]
fn the_limit_is_the_largest_number_that_meets_the_objective() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, "[limits]\nsessions = 6\n").unwrap();
    let server = Server::start(&["--config", config.to_str().unwrap()]);
    let told = told(&server, "--sessions 2 --seconds 0.2 --rate-hz 100 --find-limit lost<1");
    assert_eq!((number(&told, "/limit_sessions"), number(&told, "/sessions")), (6.0, 6.0));
    // What nothing meets.
    let told = self::told(&server, "--sessions 2 --seconds 0.2 --rate-hz 100 --find-limit dilation>2");
    assert_eq!(number(&told, "/limit_sessions"), 0.0);
}

#[test]
fn what_makes_no_sense_is_refused() {
    let server = Server::start(&[]);
    for (arguments, expected) in [
        ("--find-limit p99<2", "not a valid bound of p99"),
        ("--find-limit p98<2ms", "unknown quantity `p98`"),
        ("--sessions 0", "--sessions"),
        ("--rate-hz 0", "--rate-hz"),
        ("--scene nothing", "there is no scene `nothing`"),
        ("--server ftp://x", "--server"),
    ] {
        let output = load(&server, arguments);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{arguments}: {message}");
        assert!(message.contains(expected), "{arguments}: {message}");
    }
    let output = load(&server, "--server http://127.0.0.1:1");
    assert_eq!(output.status.code(), Some(1), "{}", String::from_utf8_lossy(&output.stderr));
}

#[tokio::test(flavor = "multi_thread")]
async fn clients_that_are_killed_leave_no_tool_held_and_no_session() {
    let server = Server::start(&[]);
    let mut child = Command::new(client_program())
        .args(["load", "--server", &server.url, "--sessions", "3", "--seconds", "1000", "--quiet"])
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    let waited = tokio::time::timeout(PATIENCE, async {
        loop {
            let sessions = sessions(&server).await;
            if sessions.len() == 3 && sessions.iter().all(|session| session.commands.unwrap().applied > 10) {
                break;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    });
    waited.await.expect("the load does not begin");
    child.kill().unwrap();
    child.wait().unwrap();
    let waited = tokio::time::timeout(PATIENCE, async {
        loop {
            let sessions = sessions(&server).await;
            for commands in sessions.iter().map(|session| session.commands.unwrap()) {
                let all = commands.applied + commands.superseded + commands.dropped + commands.waiting;
                assert_eq!(commands.accepted, all, "{commands:?}");
            }
            // The tools at once, the sessions when they were idle for 10 s.
            if sessions.is_empty() {
                break;
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    });
    waited.await.expect("the sessions of a load that was killed stay");
}
