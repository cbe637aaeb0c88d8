//! Scripts through a server: the same bits as offline, whatever else happens, and clear ends when it can't be.

use std::io::{BufReader, Read as _};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use crate::common::server::{
    self, TestServer, TestTouch, client_program, force, open, repository, server_program, until, until_blocking,
};
use palpate_proto::pb;
use serde_json::Value;

fn replay(server: &TestServer, script: &Path, more: &[&str]) -> Output {
    Command::new(client_program())
        .args(["replay", script.to_str().unwrap(), "--server", &server.url])
        .args(more)
        .current_dir(repository())
        .output()
        .unwrap()
}

fn run_held(scene: &str, script: &Path) -> Vec<Value> {
    let output = Command::new(server_program())
        .args(["run", scene, script.to_str().unwrap(), "--held"])
        .current_dir(repository())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    lines(&output.stdout)
}

fn lines(bytes: &[u8]) -> Vec<Value> {
    String::from_utf8_lossy(bytes).lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

/// Each with the first scene that it is made for.
fn shipped_scripts() -> Vec<(String, PathBuf)> {
    let mut scripts: Vec<_> = std::fs::read_dir(repository().join("scripts"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "toml"))
        .collect();
    scripts.sort();
    assert!(scripts.len() >= 7);
    let scene = |script: &Path| {
        let text: toml::Table = std::fs::read_to_string(script).unwrap().parse().unwrap();
        text["scenes"][0].as_str().unwrap().to_owned()
    };
    scripts.into_iter().map(|script| (scene(&script), script)).collect()
}

/// Replays and compares every record, and the hash, with the run offline.
fn assert_same(server: &TestServer, scene: &str, script: &Path) {
    let output = replay(server, script, &["--scene", scene]);
    let errors = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{errors}");
    let (through, offline) = (lines(&output.stdout), run_held(scene, script));
    assert_eq!(through.len(), offline.len());
    assert_eq!(through[0], offline[0]);
    let last = through.len() - 1;
    let (summary, expected) = (&through[last]["summary"], &offline[last]["summary"]);
    assert_eq!((&summary["rejected_commands"], &summary["late_commands"]), (&Value::from(0), &Value::from(0)));
    assert_eq!(through[1..last], offline[1..last], "{}", script.display());
    assert_eq!(summary["final_hash"], expected["final_hash"], "{}", script.display());
    for key in ["steps", "substeps", "points"] {
        assert_eq!(summary[key], expected[key]);
    }
    for row in ["steps", "overruns", "largest displacement", "peak reaction", "round trip", "final hash"] {
        assert!(errors.contains(row), "no row `{row}` in:\n{errors}");
    }
}

#[test]
fn every_shipped_script_gives_the_hash_of_the_run_offline() {
    let server = TestServer::start(&[]);
    for (scene, script) in shipped_scripts() {
        assert_same(&server, &scene, &script);
    }
}

/// A force, and beside it a tip that never touches.
const HOVERING: &str = r#"
name = "hovering"
duration_s = 0.1
sample_every_s = 0.01
[[force]]
point = [5, 4]
force_n = [0.0, 0.0, -1.0]
falloff_per_m = 150.0
falloff_offset = 0.0
profile = { type = "constant" }
[[tool]]
poses = [{ at_s = 0.02, place_m = [0.1, 0.1, 0.5] }]
until_s = 0.08
"#;

#[test]
fn a_replay_plots_the_first_tool_with_a_tip_as_a_run_does() {
    let server = TestServer::start(&[]);
    let folder = tempfile::tempdir().unwrap();
    let (scene, script) = (folder.path().join("stiff.toml"), folder.path().join("hovering.toml"));
    std::fs::write(&scene, STIFF).unwrap();
    std::fs::write(&script, HOVERING).unwrap();
    let scene = scene.to_str().unwrap();
    assert_same(&server, scene, &script);
    let through = replay(&server, &script, &["--scene", scene, "--plot"]);
    let offline = Command::new(server_program())
        .args(["run", scene, script.to_str().unwrap(), "--held", "--plot"])
        .output()
        .unwrap();
    for ended in [through, offline] {
        let said = String::from_utf8_lossy(&ended.stderr);
        assert!(said.contains("Force of the tissue on the tool along z, N: 0 throughout"), "{said}");
        // Records still go to a pipe.
        assert_eq!(lines(&ended.stdout).len(), 1 + 11 + 1);
    }
}

/// Commands and sessions without rest, beside what is tested.
struct Hammer {
    stop: Arc<AtomicBool>,
    sent: Arc<AtomicU64>,
    thread: std::thread::JoinHandle<()>,
}

fn hammer(url: String) -> Hammer {
    let (stop, sent) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let (stopped, counter) = (stop.clone(), sent.clone());
    let thread = std::thread::spawn(move || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        // Borrows the real server's address; it is not this one's to end.
        let mut child = Command::new("true").stdout(Stdio::piped()).spawn().unwrap();
        let out = BufReader::new(child.stdout.take().unwrap());
        let server = std::mem::ManuallyDrop::new(TestServer { child, url, out });
        runtime.block_on(async {
            while !stopped.load(Ordering::Relaxed) {
                let session = server.paper(false).await;
                let mut touch = TestTouch::open(&server, open(&session, &[0])).await.unwrap();
                for sequence in 1..400 {
                    let strength_n = if sequence % 2 == 0 { -3.0 } else { f64::NAN };
                    touch.command(force(0, sequence, strength_n)).await;
                    touch.hear().await.unwrap();
                    counter.fetch_add(1, Ordering::Relaxed);
                }
                // Or they would be ever more.
                let request = pb::DeleteSessionRequest { session_id: session };
                server.sessions().await.delete_session(request).await.unwrap();
            }
        });
    });
    Hammer { stop, sent, thread }
}

#[test]
fn a_replay_is_exact_while_another_client_hammers_another_session() {
    // Built before the load begins.
    server::client_program();
    let server = TestServer::start(&["--log", "error"]);
    let hammer = hammer(server.url.clone());
    // The solid's scripts take most of the time, and the test above plays them.
    for (scene, script) in shipped_scripts().into_iter().filter(|(scene, _)| scene != "liver-solid") {
        assert_same(&server, &scene, &script);
    }
    hammer.stop.store(true, Ordering::Relaxed);
    hammer.thread.join().unwrap();
    assert!(hammer.sent.load(Ordering::Relaxed) > 1000);
}

const EVERYTHING: &str = r#"
name = "everything"
duration_s = 0.6
sample_every_s = 0.02
sample_points = "all"
[[force]]
point = [3, 4]
force_n = [0.0, 0.2, -0.5]
falloff_per_m = 40.0
falloff_offset = 0.0
profile = { type = "sine", frequency_hz = 5.0 }
[[force]]
path = { from_m = [0.02, 0.05], velocity_m_per_s = [0.8, 0.1] }
force_n = [0.0, 0.0, -0.4]
falloff_per_m = 60.0
falloff_offset = 0.2
profile = { type = "ramp", from_s = 0.0, to_s = 0.15 }
[[force]]
hops = [{ at_s = 0.1, point = [1, 2] }, { at_s = 0.2, point = [2, 2] }, { at_s = 0.25, point = [3, 3] }]
force_n = [0.0, 0.0, -0.3]
falloff_per_m = 60.0
falloff_offset = 0.0
profile = { type = "pulse", on_s = 0.05, off_s = 0.5 }
[[force]]
point = [5, 1]
falloff_per_m = 50.0
falloff_offset = 0.0
profile = { type = "trace", file = "trace.csv" }
[[tool]]
point = [7, 7]
moves = [{ from_s = 0.0, to_s = 0.2, by_m = [0.0, 0.0, -0.02] }, { from_s = 0.3, to_s = 0.5, by_m = [0.01, 0.0, 0.02] }]
[[tissue]]
at_s = 0.123
stiffness_n_per_m = 55.0
[[tissue]]
at_s = 0.2
damping_n_s_per_m = 0.6
anchor_stiffness_n_per_m = 11.0
"#;

const STIFF: &str = r#"
name = "stiff"
[sheet]
points = [11, 9]
spacing_m = 0.04
point_mass_kg = 0.01
fixed = "corners"
[springs]
stiffness_n_per_m = 400.0
shear_stiffness_n_per_m = 200.0
bending = true
[anchor_springs]
stiffness_n_per_m = 5.0
[damping]
coefficient_n_s_per_m = 0.3
[stepping]
precision = "f64"
"#;

#[test]
fn every_kind_of_force_and_tool_comes_through_exactly() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, script) = (folder.path().join("stiff.toml"), folder.path().join("everything.toml"));
    std::fs::write(&scene, STIFF).unwrap();
    std::fs::write(&script, EVERYTHING).unwrap();
    let rows: Vec<String> =
        (0..60).map(|k| format!("{},0.0,{},-0.2", 0.01 * f64::from(k), 0.01 * f64::from(k % 9))).collect();
    std::fs::write(folder.path().join("trace.csv"), format!("time_s,fx_n,fy_n,fz_n\n{}\n", rows.join("\n"))).unwrap();
    let server = TestServer::start(&["--scenes", folder.path().to_str().unwrap()]);
    assert_same(&server, scene.to_str().unwrap(), &script);
    // By the name under which the server has it, too.
    let output = replay(&server, &script, &["--scene", "stiff"]);
    assert!(output.status.success());
    let (through, offline) = (lines(&output.stdout), run_held(scene.to_str().unwrap(), &script));
    assert_eq!(through.last().unwrap()["summary"]["final_hash"], offline.last().unwrap()["summary"]["final_hash"]);
}

/// Half a second of nothing but another tissue, a short push, in which it changes again, and another push later.
const PAUSES: &str = r#"
name = "pauses"
duration_s = 1.2
sample_every_s = 0.4
sample_points = [[15, 15]]
[[force]]
point = [15, 15]
force_n = [0.0, 0.0, -1.0]
falloff_per_m = 150.0
falloff_offset = 0.0
profile = { type = "pulse", on_s = 0.5, off_s = 0.6 }
[[force]]
point = [4, 20]
force_n = [0.1, 0.0, -0.5]
falloff_per_m = 150.0
falloff_offset = 0.0
profile = { type = "pulse", on_s = 1.1, off_s = 1.15 }
[[tissue]]
at_s = 0.3
anchor_stiffness_n_per_m = 7.0
[[tissue]]
at_s = 0.55
stiffness_n_per_m = 30.0
damping_n_s_per_m = 0.4
"#;

#[test]
fn a_session_that_rests_gives_the_hash_of_the_run_offline_on_any_number_of_threads_and_samples() {
    let folder = tempfile::tempdir().unwrap();
    let script = folder.path().join("pauses.toml");
    std::fs::write(&script, PAUSES).unwrap();
    let offline = run_held("paper", &script);
    for threads in ["1", "3"] {
        let server = TestServer::start(&["--threads", threads]);
        assert_same(&server, "paper", &script);
        for sampling in [
            &["--every", "20"][..],
            &["--deadband-force-n", "0.05", "--deadband-force-fraction", "0.1", "--heartbeat-s", "0.3"],
            &["--deadband-displacement-m", "1e-3"],
        ] {
            let output = replay(&server, &script, sampling);
            let errors = String::from_utf8_lossy(&output.stderr).into_owned();
            assert!(output.status.success(), "{errors}");
            let summary = &lines(&output.stdout).pop().unwrap()["summary"];
            assert_eq!(summary["final_hash"], offline.last().unwrap()["summary"]["final_hash"], "{errors}");
            // Fewer than steps: that is what was asked for.
            let row = errors.lines().find(|line| line.starts_with("samples")).unwrap();
            let samples: u64 = row.split_whitespace().nth(1).unwrap().parse().unwrap();
            assert!(samples < 400, "{row}");
        }
    }
}

/// A new force at every step, for longer than a client sends commands ahead.
#[cfg(unix)]
const RESTLESS: &str = r#"
name = "restless"
duration_s = 4.0
sample_every_s = 0.1
sample_points = [[15, 15]]
[[force]]
point = [15, 15]
force_n = [0.0, 0.2, -0.5]
falloff_per_m = 150.0
falloff_offset = 0.0
profile = { type = "sine", frequency_hz = 5.0 }
"#;

/// Asks for the only session until it satisfies `wanted`.
#[cfg(unix)]
async fn session_that(server: &TestServer, wanted: impl Fn(&pb::Session) -> bool) -> pb::Session {
    let (mut sessions, mut found) = (server.sessions().await, None);
    until("a session is as it should be", async || {
        let listed = sessions.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner().sessions;
        found = listed.into_iter().find(&wanted);
        found.is_some()
    })
    .await;
    found.unwrap()
}

#[cfg(unix)]
#[tokio::test]
async fn time_waits_for_a_replay_that_stands_still() {
    let server = TestServer::start(&[]);
    let folder = tempfile::tempdir().unwrap();
    let script = folder.path().join("restless.toml");
    std::fs::write(&script, RESTLESS).unwrap();
    let client = Command::new(client_program())
        .args(["replay", script.to_str().unwrap(), "--server", &server.url])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let signal = |name: &str| {
        assert!(Command::new("kill").args([name, &client.id().to_string()]).status().unwrap().success());
    };
    session_that(&server, |session| session.step > 0).await;
    signal("-STOP");
    let stands = session_that(&server, |session| session.state() == pb::SessionState::Paused).await;
    assert!((1..4000).contains(&stands.step), "time went on to step {}", stands.step);
    signal("-CONT");
    let output = tokio::task::spawn_blocking(move || client.wait_with_output().unwrap()).await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let (through, offline) = (lines(&output.stdout), run_held("paper", &script));
    let (summary, expected) = (&through.last().unwrap()["summary"], &offline.last().unwrap()["summary"]);
    assert_eq!(summary["late_commands"], 0);
    assert_eq!(summary["final_hash"], expected["final_hash"]);
}

/// Waits until a client is in the middle of a replay: records have come.
fn until_records(records: &Path, client: &mut Child) {
    until_blocking("records come", || {
        if let Some(status) = client.try_wait().unwrap() {
            let mut message = String::new();
            client.stderr.take().unwrap().read_to_string(&mut message).unwrap();
            panic!("the client has ended ({status}): {message}");
        }
        std::fs::metadata(records).is_ok_and(|meta| meta.len() >= 20_000)
    });
}

#[test]
fn a_server_that_stops_in_mid_replay_is_told() {
    let mut server = TestServer::start(&[]);
    let folder = tempfile::tempdir().unwrap();
    let script = folder.path().join("long.toml");
    let text = std::fs::read_to_string(repository().join("scripts/vertical-60.toml")).unwrap();
    std::fs::write(&script, text.replace("duration_s = 1.0", "duration_s = 600.0")).unwrap();
    let records = folder.path().join("records.jsonl");
    let mut client = Command::new(client_program())
        .args(["replay", script.to_str().unwrap(), "--server", &server.url, "--output", records.to_str().unwrap()])
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    until_records(&records, &mut client);
    server.child.kill().unwrap();
    let output = client.wait_with_output().unwrap();
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{message}");
    assert!(message.contains("the server"), "{message}");
}

#[cfg(unix)]
#[test]
fn a_server_that_falls_silent_in_mid_replay_is_told() {
    let server = TestServer::start(&[]);
    let folder = tempfile::tempdir().unwrap();
    let script = folder.path().join("long.toml");
    std::fs::write(&script, "duration_s = 600.0\nsample_every_s = 0.001\nsample_points = [[0, 0]]\n").unwrap();
    let records = folder.path().join("records.jsonl");
    let mut client = Command::new(client_program())
        .args(["replay", script.to_str().unwrap(), "--server", &server.url, "--output", records.to_str().unwrap()])
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    until_records(&records, &mut client);
    let frozen = Command::new("kill").args(["-STOP", &server.child.id().to_string()]).status().unwrap();
    assert!(frozen.success());
    let output = client.wait_with_output().unwrap();
    let message = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{message}");
    assert!(message.contains("the server was silent for 10 s"), "{message}");
}

#[test]
fn what_a_replay_can_not_play_is_refused() {
    let server = TestServer::start(&[]);
    let script = repository().join("scripts/vertical-60.toml");
    let refused = |output: Output, status: i32, expected: &str| {
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(status), "{message}");
        assert!(message.contains(expected), "{message}");
    };
    refused(replay(&server, &script, &["--scene", "nothing"]), 2, "UNKNOWN_SCENE");
    let own = "; give your own scene by its path, --scene FILE.toml";
    refused(replay(&server, &script, &["--scene", "nothing"]), 2, own);
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("stiff.toml"), STIFF).unwrap();
    let name = folder.path().join("stiff");
    let meant = format!("; did you mean the file `{}.toml`?", name.display());
    refused(replay(&server, &script, &["--scene", name.to_str().unwrap()]), 2, &meant);
    refused(replay(&server, Path::new("no-such-script.toml"), &[]), 2, "no-such-script.toml");
    refused(replay(&server, &script, &["--output", "/no/such/folder/file"]), 2, "/no/such/folder/file");
    refused(replay(&server, &script, &["--deadband-force-n=-1"]), 2, "deadband.force_n");
    refused(replay(&server, &script, &["--every", "0"]), 2, "--every");
    refused(replay(&server, &script, &["--every", "5000"]), 2, "samples pace the commands");
    refused(replay(&server, &script, &["--heartbeat-s", "9"]), 2, "--heartbeat-s");
    for server in ["ftp://nowhere", "http://"] {
        let wrong = Command::new(client_program())
            .args(["replay", script.to_str().unwrap(), "--server", server])
            .output()
            .unwrap();
        refused(wrong, 2, server);
    }
    for server in ["http://127.0.0.1:1", "https://127.0.0.1:1"] {
        let nobody = Command::new(client_program())
            .args(["replay", script.to_str().unwrap(), "--server", server])
            .output()
            .unwrap();
        refused(nobody, 1, &format!("can't reach {server}"));
    }
}

#[tokio::test]
async fn a_replay_leaves_no_session_behind() {
    let server = TestServer::start(&[]);
    let folder = tempfile::tempdir().unwrap();
    let script = folder.path().join("short.toml");
    std::fs::write(&script, "duration_s = 0.05\nsample_every_s = 0.05\n").unwrap();
    let output = replay(&server, &script, &[]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let request = pb::ListSessionsRequest {};
    let listed = server.sessions().await.list_sessions(request).await.unwrap().into_inner().sessions;
    assert!(listed.is_empty());
}

/// Springs far too stiff for the substeps that the scene gives: each force makes the tissue blow up.
#[test]
fn a_recovery_is_the_same_in_a_replay_and_offline_and_neither_calls_that_the_script() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: String| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    };
    let stiff = palpate_tissue::scene::PAPER.replace("stiffness_n_per_m = 10.0", "stiffness_n_per_m = 1e9");
    let scene = write("stiff.toml", format!("{stiff}\n[stepping]\nsubsteps = 1\n"));
    let force = |on_s: f64| {
        let profile = format!("{{ type = \"pulse\", on_s = {on_s}, off_s = {} }}", on_s + 0.1);
        format!(
            "[[force]]\npoint = [15, 15]\nforce_n = [0.1, 0.0, -1.0]\nfalloff_per_m = 20.0\nfalloff_offset = 0.0\n\
             profile = {profile}\n"
        )
    };
    let head = "duration_s = 0.6\nsample_every_s = 0.01\nsample_points = [[15, 15], [3, 4]]\n";
    let script = write("twice.toml", format!("{head}{}{}", force(0.1), force(0.4)));
    // The scene's error is not known, and looking for it would take long.
    let config = write("palpate.toml", "[limits]\nrehearsal_work = 1\n".to_owned());
    let config = ["--config", config.to_str().unwrap()];
    let server = TestServer::start(&config);
    let through = replay(&server, &script, &["--scene", scene.to_str().unwrap()]);
    let offline = Command::new(server_program())
        .args(["run", scene.to_str().unwrap(), script.to_str().unwrap(), "--held"])
        .args(config)
        .output()
        .unwrap();
    for ended in [&through, &offline] {
        let said = String::from_utf8_lossy(&ended.stderr);
        assert!(
            ended.status.code() == Some(1) && said.contains("from there on the run differs from the script"),
            "{said}"
        );
    }
    let (through, offline) = (lines(&through.stdout), lines(&offline.stdout));
    let last = offline.len() - 1;
    assert_eq!(through[..last], offline[..last]);
    let (summary, expected) = (&through[last]["summary"], &offline[last]["summary"]);
    assert_eq!(summary["final_hash"], expected["final_hash"]);
    assert_eq!((&summary["recoveries"], &summary["rejected_commands"]), (&expected["recoveries"], &Value::from(0)));
    let recoveries = expected["recoveries"].as_array().unwrap();
    assert_eq!(recoveries.len(), 2, "{recoveries:?}");
    for (recovery, state_of_step) in recoveries.iter().zip([100, 400]) {
        assert_eq!((&recovery["state_of_step"], &recovery["undone_commands"]), (&state_of_step.into(), &1.into()));
        assert!(recovery["step"].as_u64().unwrap() > state_of_step && recovery["reason"].is_string(), "{recovery:?}");
    }
}
