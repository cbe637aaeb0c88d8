//! `palpate-client load`: its report is true, and it leaves nothing behind.

use std::process::{Command, Output, Stdio};

use crate::common::server::{TestServer, client_program, repository, until};
use palpate_proto::pb;
use serde_json::Value;

fn load(server: &TestServer, arguments: &str) -> Output {
    let server = if arguments.contains("--server") { String::new() } else { format!("--server {}", server.url) };
    let all = format!("load {server} --quiet {arguments}");
    Command::new(client_program()).args(all.split_whitespace()).output().unwrap()
}

fn told(server: &TestServer, arguments: &str) -> Value {
    let output = load(server, &format!("--json {arguments}"));
    assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn number(told: &Value, path: &str) -> f64 {
    told.pointer(path).and_then(Value::as_f64).unwrap_or_else(|| panic!("{path} is missing in {told}"))
}

async fn sessions(server: &TestServer) -> Vec<pb::Session> {
    server.sessions().await.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner().sessions
}

#[tokio::test(flavor = "multi_thread")]
async fn every_command_of_a_load_is_accounted_for_and_no_session_stays() {
    // However long a step takes beside other tests, no session is refused.
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, "[limits]\nthread_share = 1000.0\n").unwrap();
    let server = TestServer::start(&["--config", config.to_str().unwrap()]);
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

/// 400,000 points 10,000 times a second, which no core can do: its time runs slower than real time, and the report
/// says so.
#[tokio::test(flavor = "multi_thread")]
async fn the_dilation_of_sessions_that_are_too_heavy_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let (scene, config) = (folder.path().join("heavy.toml"), folder.path().join("palpate.toml"));
    let paper = palpate_tissue::scene::PAPER.replace("points = [31, 31]", "points = [800, 500]");
    std::fs::write(&scene, paper + "[stepping]\nrate_hz = 10000.0\n[sleep]\ntolerance = 0.0\n").unwrap();
    std::fs::write(&config, "[limits]\nthread_share = 1000.0\nperiods_per_step = 20.0\n").unwrap();
    let server = TestServer::start(&["--config", config.to_str().unwrap()]);
    for clients in [0, 1] {
        let scene = scene.to_str().unwrap();
        let told = told(&server, &format!("--scene {scene} --sessions 1 --clients-per-session {clients} --seconds 2"));
        let dilation = number(&told, "/dilation_min");
        assert!(dilation > 0.0 && dilation < 0.9, "{clients} clients: {told}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn sessions_without_clients_are_kept_awake() {
    let server = TestServer::start(&[]);
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
    let server = TestServer::start(&["--config", config.to_str().unwrap()]);
    let told = told(&server, "--sessions 2 --seconds 0.2 --rate-hz 100 --find-limit lost<1");
    assert_eq!((number(&told, "/limit_sessions"), number(&told, "/sessions")), (6.0, 6.0));
    // An objective that cannot be met.
    let told = self::told(&server, "--sessions 2 --seconds 0.2 --rate-hz 100 --find-limit dilation>2");
    assert_eq!(number(&told, "/limit_sessions"), 0.0);
}

#[test]
fn what_makes_no_sense_is_refused() {
    let server = TestServer::start(&[]);
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
    let server = TestServer::start(&[]);
    let mut child = Command::new(client_program())
        .args(["load", "--server", &server.url, "--sessions", "3", "--seconds", "1000", "--quiet"])
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    until("the load begins", async || {
        let sessions = sessions(&server).await;
        sessions.len() == 3 && sessions.iter().all(|session| session.commands.unwrap().applied > 10)
    })
    .await;
    child.kill().unwrap();
    child.wait().unwrap();
    until("the sessions of a load that was killed end", async || {
        let sessions = sessions(&server).await;
        for commands in sessions.iter().map(|session| session.commands.unwrap()) {
            let all = commands.applied + commands.superseded + commands.dropped + commands.waiting;
            assert_eq!(commands.accepted, all, "{commands:?}");
        }
        // The tools at once, the sessions when they were idle for 10 s.
        sessions.is_empty()
    })
    .await;
}

/// Hands lead instruments: each pose moves all of their tips. A busy machine has no room for all users.
#[tokio::test(flavor = "multi_thread")]
async fn users_of_a_plan_lead_instruments() {
    let (server, folder) = (TestServer::start(&[]), tempfile::tempdir().unwrap());
    let plan = "[[hand]]\nhand = \"medium\"\ninstrument = \"shaft\"\n[[hand]]\nhand = \"light\"\ninstrument = \"grasper\"\n\
                [[phase]]\nseconds = 3\narrivals = \"spike\"\nusers = 4\nobjective = \"rejected<1\"\n";
    let output = planned(&server, folder.path(), plan, &["--json"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let told: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(told["kept"], true, "{told}");
    let hands = told["mix"]["hands"].as_object().unwrap();
    assert!(hands.keys().all(|hand| ["medium shaft", "light grasper"].contains(&&**hand)), "{hands:?}");
    assert!(number(&told, "/all/commands") > 100.0 && number(&told, "/all/round_trip_us/p50") > 0.0, "{told}");
}

/// Every part that a plan may have. Users that are far away wait at least 20 ms.
const PLAN: &str = r#"
name = "<all> & more"
seed = 5
objective = "p50<60s,rejected<1000000"
[[scene]]
name = "liver"
[[scene]]
name = "fibrotic"
[[hand]]
hand = "medium"
device = "omega3"
deadband = 0.1
up_deadband = 0.05
[[hand]]
hand = "push"
[[network]]
name = "far"
delay_ms = 10
jitter_ms = 0.5
[[viewers]]
number = 0
[[viewers]]
number = 1
rate_hz = 30
[[phase]]
name = "steady"
seconds = 3
arrivals = "steady"
rate_per_s = 1
stays_s = 2.5
[[phase]]
name = "random"
seconds = 3
arrivals = "poisson"
rate_per_s = 1
stays_s = 1
[[phase]]
name = "spike"
seconds = 3
arrivals = "spike"
users = 3
stays_s = 60
[[phase]]
name = "after"
seconds = 1
"#;

fn planned(server: &TestServer, folder: &std::path::Path, plan: &str, more: &[&str]) -> Output {
    let path = folder.join("plan.toml");
    std::fs::write(&path, plan).unwrap();
    let mut program = Command::new(client_program());
    let server = if more.contains(&"--server") { vec![] } else { vec!["--server", &server.url] };
    program.args(["load", "--quiet", "--plan", path.to_str().unwrap()]).args(server);
    program.args(more).output().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_plan_is_played_by_its_users_and_told_by_second_phase_and_page() {
    let (server, folder) = (TestServer::start(&[]), tempfile::tempdir().unwrap());
    let page = folder.path().join("load.html");
    let output = planned(&server, folder.path(), PLAN, &["--json", "--report", page.to_str().unwrap()]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let told: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(told["kept"], true);
    let phases: Vec<&str> =
        told["phases"].as_array().unwrap().iter().map(|phase| phase["name"].as_str().unwrap()).collect();
    assert_eq!(phases, ["steady", "random", "spike", "after"]);
    let sum = |key: &str| told["phases"].as_array().unwrap().iter().map(|phase| number(phase, key)).sum::<f64>();
    let users = number(&told, "/all/users_arrived");
    // Everybody who came has gone, and their sessions with them.
    let away: f64 = told["all"]["turned_away"].as_object().unwrap().values().map(|count| count.as_f64().unwrap()).sum();
    let gone = number(&told, "/all/users_left") + away;
    assert!(users >= 6.0 && users == sum("/users_arrived") && users == gone, "{told}");
    assert_eq!((number(&told, "/phases/0/users_arrived"), number(&told, "/phases/2/users_arrived")), (3.0, 3.0));
    assert!(sessions(&server).await.is_empty());
    for kind in ["scenes", "hands", "networks", "scripts", "viewers"] {
        let drawn: f64 = told["mix"][kind].as_object().unwrap().values().map(|count| count.as_f64().unwrap()).sum();
        assert_eq!(drawn, users, "{kind}");
    }
    assert!(number(&told, "/all/commands") > 100.0 && number(&told, "/all/frames") > 0.0, "{told}");
    assert_eq!(sum("/samples"), number(&told, "/all/samples"));
    // At least the proxy's delay: 10 ms each way, give or take the jitter.
    assert!(number(&told, "/all/round_trip_us/p50") > 18_000.0, "{told}");
    assert!(number(&told, "/all/dilation_min") > 0.0 && number(&told, "/all/start_us/p50") > 0.0);
    assert_eq!(told["seconds"].as_array().unwrap().len(), 11);
    let page = std::fs::read_to_string(page).unwrap();
    assert!(page.matches("<svg").count() == 4 && page.matches("</svg>").count() == 4);
    assert!(page.contains("&lt;all&gt; &amp; more") && !page.contains("<all>"));
    assert!(page.contains("All objectives were kept."));
    // Plots have numbers only, and nothing comes from elsewhere.
    let paths: Vec<&str> = page.split("<path d=\"").skip(1).map(|rest| rest.split('"').next().unwrap()).collect();
    assert!(paths.len() > 5 && paths.iter().all(|path| !path.contains("NaN") && !path.contains("inf")), "{paths:?}");
    assert!(!page.contains("http:") && !page.contains("https:") && !page.contains("<script"));
}

/// A thread and a clip, which are cut again.
const TIES: &str = r#"
duration_s = 2.0
sample_every_s = 1.0
[[force]]
point = [10, 10]
force_n = [0.0, 0.0, -0.5]
falloff_per_m = 150.0
falloff_offset = 0.0
profile = { type = "constant" }
[[thread]]
bites = [{ place_m = [0.02, 0.03, 0.0] }, { place_m = [0.03, 0.03, 0.0] }, { place_m = [0.03, 0.04, 0.0] }]
length_m = [{ at_s = 0.2, length_m = 0.02 }, { at_s = 0.7, length_m = 0.015 }]
until_s = 1.2
[[clip]]
bites = [{ place_m = [0.05, 0.03, 0.0] }, { place_m = [0.053, 0.03, 0.0] }]
from_s = 0.2
until_s = 1.2
"#;

#[tokio::test(flavor = "multi_thread")]
async fn a_script_of_a_plan_lays_and_cuts_threads_and_clips_in_the_sessions_of_users_again_and_again() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("ties.toml"), TIES).unwrap();
    let server = TestServer::start(&["--scripts", folder.path().to_str().unwrap()]);
    // A user whose instrument has many tools, and one that pushes.
    let plan = "[[scene]]\nname = \"liver\"\n[[script]]\nname = \"ties\"\n[[hand]]\nhand = \"push\"\n[[hand]]\nhand = \"light\"\n\
                instrument = \"grasper\"\n[[phase]]\nseconds = 1000\narrivals = \"spike\"\nusers = 4\n";
    let path = folder.path().join("plan.toml");
    std::fs::write(&path, plan).unwrap();
    let mut command = Command::new(client_program());
    command.args(["load", "--quiet", "--json", "--server", &server.url, "--plan", path.to_str().unwrap()]);
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    for ties in [2, 0, 2, 0] {
        // Each of the sessions has come so far, not all of them at once.
        let mut done = std::collections::BTreeSet::new();
        until(&format!("{ties} threads and clips"), async || {
            for session in sessions(&server).await {
                if session.ties.len() == ties && session.step > 0 {
                    assert!(session.ties.iter().all(|laid| !laid.broken), "{session:?}");
                    done.insert(session.session_id);
                }
            }
            done.len() == 4
        })
        .await;
    }
    Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    let output = child.wait_with_output().unwrap();
    let told: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(told["why"], "the plan was interrupted");
    assert_eq!(told["mix"]["scripts"], serde_json::json!({ "ties": 4 }));
    assert_eq!((number(&told, "/all/broken_streams"), number(&told, "/all/rejected")), (0.0, 0.0), "{told}");
    assert!(told["mix"]["hands"].as_object().unwrap().len() == 2, "{told}");
    assert!(sessions(&server).await.is_empty());
    // A script that the server lacks, or that does not fit, turns its users away.
    let unknown = "[[script]]\nname = \"nothing\"\n[[phase]]\nseconds = 1.5\narrivals = \"spike\"\nusers = 1\n";
    let refused = planned(&server, folder.path(), unknown, &[]);
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(
        refused.status.code() == Some(1) && said.contains("no user could touch: ") && said.contains("nothing"),
        "{said}"
    );
    assert!(sessions(&server).await.is_empty());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_plan_that_misses_an_objective_or_is_wrong_says_so_by_its_status() {
    let (server, folder) = (TestServer::start(&[]), tempfile::tempdir().unwrap());
    let short = "[[phase]]\nname = \"brief\"\nseconds = 1.5\narrivals = \"spike\"\nusers = 1\n";
    let missed = planned(&server, folder.path(), &format!("{short}objective = \"p50<1us\"\n"), &[]);
    let said = String::from_utf8_lossy(&missed.stderr);
    assert_eq!(missed.status.code(), Some(1), "{said}");
    assert!(said.contains("`brief` misses p50<1us"), "{said}");
    assert!(String::from_utf8_lossy(&missed.stdout).contains("misses p50<1us"));
    // The server has no such scene: no user is admitted, and the report gives the reason.
    let nowhere = planned(&server, folder.path(), &format!("{short}[[scene]]\nname = \"nowhere\"\n"), &[]);
    let said = String::from_utf8_lossy(&nowhere.stderr);
    assert_eq!(nowhere.status.code(), Some(1), "{said}");
    assert!(said.contains("no user could touch") && said.contains("UNKNOWN_SCENE"), "{said}");
    let wrong = planned(&server, folder.path(), &format!("{short}stay_s = 3\n"), &[]);
    let said = String::from_utf8_lossy(&wrong.stderr);
    assert_eq!(wrong.status.code(), Some(2), "{said}");
    assert!(said.contains("plan.toml:6") && said.contains("phase[0].stay_s"), "{said}");
    assert!(sessions(&server).await.is_empty());
    // The plan that the guide begins with can be read: its server is nowhere.
    let root = repository();
    let plan = std::fs::read_to_string(root.join("contrib/plan.toml")).unwrap();
    let nobody = planned(&server, folder.path(), &plan, &["--server", "http://127.0.0.1:9"]);
    assert_ne!(nobody.status.code(), Some(2), "{}", String::from_utf8_lossy(&nobody.stderr));
}
