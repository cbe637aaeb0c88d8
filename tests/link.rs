//! `palpate-client link` and `bridge`: what a simulated hand must feel through any network.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

#[path = "common/course.rs"]
mod course;
#[path = "common/proxy.rs"]
mod proxy;
#[path = "common/server.rs"]
mod server;

use std::process::{Command, Output};
use std::time::Duration;

use course::Course;
use proxy::Proxy;
use serde_json::Value;
use server::{Server, client_program};

fn client(arguments: &str) -> Output {
    Command::new(client_program()).args(arguments.split_whitespace()).output().unwrap()
}

fn link(arguments: &str) -> Value {
    let output = client(&format!("link --json {arguments}"));
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "link {arguments}: {told}");
    serde_json::from_slice(&output.stdout).unwrap()
}

fn number(value: &Value, name: &str) -> f64 {
    value[name].as_f64().unwrap_or_else(|| panic!("{name} is {} in {value}", value[name]))
}

#[test]
fn the_same_seed_is_the_same_run() {
    let run = "--scene liver --profile wan --seconds 3 --seed 5";
    let (first, second) = (link(run), link(run));
    assert_eq!(first, second);
    assert_ne!(
        first["force_error_rms_percent"],
        link("--scene liver --profile wan --seconds 3 --seed 6")["force_error_rms_percent"]
    );
}

#[test]
fn touch_is_true_passive_and_smooth_up_to_100_ms() {
    for scene in ["liver", "fibrotic"] {
        for (rtt_ms, most_percent) in [(0.0, 2.0), (10.0, 2.0), (50.0, 3.6), (100.0, 7.3)] {
            for hand in ["light", "medium", "firm"] {
                let found = link(&format!("--scene {scene} --hand {hand} --rtt-ms {rtt_ms} --seconds 6 --seed 3"));
                let error = number(&found, "force_error_rms_percent");
                assert!(error < most_percent, "{scene}, {hand}, {rtt_ms} ms: {error} %");
                assert!(number(&found, "energy_min_j") >= -1e-3, "{found}");
                assert!(number(&found, "jump_max_n") <= 0.1 + 1e-9, "{found}");
                assert!(number(&found, "rendered_share") >= 0.7, "{found}");
                assert_eq!((&found["unstable"], &found["faults"]), (&Value::Bool(false), &Value::from(0)), "{found}");
            }
        }
    }
}

#[test]
fn what_others_do_shakes_or_lies_where_the_model_does_not() {
    let run = |scheme: &str| link(&format!("--scene fibrotic --rtt-ms 50 --seconds 6 --scheme {scheme}"));
    assert_eq!(run("raw")["unstable"], true);
    let hold = run("hold");
    assert_eq!(hold["unstable"], false, "the envelope holds whatever is in it");
    assert!(number(&hold, "energy_min_j") >= -1e-3, "{hold}");
    assert!(number(&hold, "force_error_rms_percent") > 20.0, "{hold}");
    assert_eq!(run("model")["unstable"], false);
}

#[test]
fn a_deadband_sends_a_twentieth_and_is_not_felt() {
    for scene in ["liver", "fibrotic", "stomach"] {
        let found = link(&format!("--scene {scene} --rtt-ms 2 --deadband 0.1 --seconds 8"));
        assert!(number(&found, "packets_per_s") <= 50.0, "{found}");
        assert!(number(&found, "force_error_rms_percent") <= 2.0, "{found}");
    }
}

/// `palpate-client link --random 1000` is the long form.
#[test]
fn random_combinations_are_passive() {
    let found = link("--random 24 --seconds 5 --seed 100");
    assert_eq!((&found["runs"], &found["unstable"]), (&Value::from(24), &Value::from(0)));
    let worst = |name: &str| found[name]["worst"].as_f64().unwrap();
    assert!(worst("energy_min_j") >= -1e-3, "{found}");
    assert!(worst("jump_max_n") <= 0.1 + 1e-9, "{found}");
    assert!(worst("force_max_n") <= 3.3, "{found}");
}

#[test]
fn a_wrong_argument_is_refused_and_named() {
    for (arguments, named) in [
        ("--scene nowhere", "--scene"),
        ("--hand iron", "--hand"),
        ("--device hammer", "--device"),
        ("--rtt-ms=-1", "--rtt-ms"),
        ("--loss 2", "--loss"),
        ("--seconds nan", "--seconds"),
        ("--radius-m 0", "radius_m"),
        ("--profile wan --rtt-ms 5", "--rtt-ms"),
    ] {
        let output = client(&format!("link {arguments}"));
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "link {arguments}: {told}");
        assert!(told.contains(named), "link {arguments}: {told}");
    }
}

/// Over real gRPC, a wire that delays, and a cut: the bridge comes back by itself, its forces when they are asked for.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bridge_outlives_a_cut() {
    let server = Server::start(&[]);
    let proxy = Proxy::start(server.url.trim_start_matches("http://").to_owned(), Duration::from_millis(5)).await;
    let bridge = Command::new(client_program())
        .args(["bridge", "--scene", "liver", "--seconds", "12", "--server", &proxy.url()])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let waited = tokio::time::timeout(Duration::from_secs(30), async {
        while proxy.connections() == 0 {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    });
    waited.await.expect("the bridge connects");
    tokio::time::sleep(Duration::from_secs(4)).await;
    proxy.cut();
    tokio::time::sleep(Duration::from_millis(500)).await;
    proxy.mend();
    let output = tokio::task::spawn_blocking(move || bridge.wait_with_output().unwrap()).await.unwrap();
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{told}");
    let found: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(proxy.connections() >= 2, "{found}");
    assert!(number(&found, "connections") >= 2.0 && number(&found, "samples") > 100.0, "{found} {told}");
    assert!(number(&found, "energy_j") >= -1e-3, "{found}");
    assert_eq!(found["interventions_ticks"]["not_finite"], 0, "{found}");
    assert!(found["interventions_ticks"]["stale"].as_u64().unwrap() > 0, "the cut was not noticed: {found}");
}

/// The server is killed, the client is frozen: what leaves the client stays within the envelope, and comes back when the
/// device's owner asks for it.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn forces_stay_within_the_envelope_whatever_breaks() {
    let address = |server: &Server| server.url.trim_start_matches("http://").to_owned();
    let first = Server::start(&[]);
    let proxy = Proxy::start(address(&first), Duration::from_millis(5)).await;
    let file = std::env::temp_dir().join(format!("palpate-course-{}.csv", std::process::id()));
    let bridge = Command::new(client_program())
        .args(["bridge", "--scene", "liver", "--seconds", "14", "--server", &proxy.url(), "--course"])
        .arg(&file)
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    let signal = |name: &str| {
        let told = Command::new("kill").args([name, &bridge.id().to_string()]).status().unwrap();
        assert!(told.success());
    };
    tokio::time::sleep(Duration::from_secs(5)).await;
    drop(first);
    tokio::time::sleep(Duration::from_secs(1)).await;
    let second = Server::start(&[]);
    proxy.aim(address(&second));
    tokio::time::sleep(Duration::from_secs(4)).await;
    signal("-STOP");
    tokio::time::sleep(Duration::from_secs(1)).await;
    signal("-CONT");
    let output = tokio::task::spawn_blocking(move || bridge.wait_with_output().unwrap()).await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let course = Course::take(&file);
    let pauses = course.keeps_to_the_envelope();
    // One for the server, one for the freeze.
    assert!(pauses.len() >= 2, "{pauses:?}");
    assert!(course.comes_back_after(pauses[pauses.len() - 1]), "it never came back");
}
