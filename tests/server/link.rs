//! `palpate-client link` and `bridge`: what a simulated hand must feel through any network.

use crate::common::cases;
use std::process::{Child, Command, Output, Stdio};
use std::time::Duration;

use crate::common::course::DeviceTrace;
use crate::common::proxy::Proxy;
use crate::common::server::{TestServer, client_program};
use palpate_haptics::envelope::PAUSE_S;
use serde_json::Value;

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

/// Virtual time is the same on every machine: bounds are a quarter above what is measured.
#[test]
fn touch_is_true_passive_and_smooth_up_to_100_ms() {
    for (scene, at_once_percent, delayed_percent) in [("liver", 0.95, 0.68), ("fibrotic", 2.3, 0.44)] {
        for rtt_ms in [0.0, 10.0, 50.0, 100.0] {
            let most_percent = if rtt_ms > 0.0 { delayed_percent } else { at_once_percent };
            for hand in cases::short_or_long(&["firm"][..], &["light", "medium", "firm"]) {
                let found = link(&format!("--scene {scene} --hand {hand} --rtt-ms {rtt_ms} --seconds 6 --seed 3"));
                let error = number(&found, "force_error_rms_percent");
                assert!(error < most_percent, "{scene}, {hand}, {rtt_ms} ms: {error} %");
                assert!(number(&found, "energy_min_j") >= -1e-6, "{found}");
                assert!(number(&found, "jump_max_n") <= 0.062, "{found}");
                assert!((number(&found, "rendered_share") - 1.0).abs() < 0.01, "{found}");
                assert_eq!((&found["unstable"], &found["faults"]), (&Value::Bool(false), &Value::from(0)), "{found}");
            }
        }
    }
}

/// What the missing copy costs a trainee: docs/exercises.md has these figures. Bounds are a quarter above what is measured.
#[test]
fn where_lumps_are_hidden_the_force_is_less_true_than_with_a_copy_and_stays_stable() {
    let run = "--scene phantom --radius-m 0.008 --place 0,0,0.04 --rtt-ms 50 --seconds 6";
    let [copied, hidden] = [link(run), link(&format!("{run} --hides-lumps"))];
    let [with_copy, without] = [&copied, &hidden].map(|found| number(found, "force_error_rms_percent"));
    assert!(with_copy < 0.08 && without < 5.6, "{with_copy} % {without} %");
    // Whoever gets no copy must not be told that it costs nothing.
    assert!(without > 20.0 * with_copy, "{with_copy} % {without} %");
    assert!(number(&hidden, "energy_min_j") >= -8e-5 && hidden["unstable"] == false, "{hidden}");
}

#[test]
fn what_others_do_shakes_or_lies_where_the_model_does_not() {
    let run = |scheme: &str| link(&format!("--scene fibrotic --rtt-ms 50 --seconds 6 --scheme {scheme}"));
    let (raw, hold, model) = (run("raw"), run("hold"), run("model"));
    // Of the same task.
    assert!(number(&raw, "scale") < 1.0 && raw["scale"] == hold["scale"] && raw["scale"] == model["scale"], "{raw}");
    assert_eq!(raw["unstable"], true);
    assert_eq!(hold["unstable"], false, "the envelope holds whatever is in it");
    assert!(number(&hold, "energy_min_j") >= -3e-4, "{hold}");
    assert!((38.0..58.0).contains(&number(&hold, "force_error_rms_percent")), "{hold}");
    assert_eq!(model["unstable"], false);
}

/// The most that a hand gets from the force that is held for 100 ms, once a second, J.
const LONG_STALL_J: f64 = 2.5e-3;

/// The device holds its last force meanwhile, and the hand moves on: no envelope can help that, and it is not hidden.
#[test]
fn what_a_client_gives_that_stands_still_is_counted() {
    for scene in ["liver", "fibrotic"] {
        let found = |stall_ms| link(&format!("--scene {scene} --rtt-ms 10 --stall-ms {stall_ms} --seconds 6"));
        let [short, long] = [found(20), found(100)];
        assert!(number(&short, "energy_min_j") >= -1e-6, "{short}");
        assert!((-LONG_STALL_J..-1e-5).contains(&number(&long, "energy_min_j")), "{long}");
        for found in [short, long] {
            assert_eq!((&found["unstable"], &found["faults"]), (&Value::Bool(false), &Value::from(0)), "{found}");
        }
    }
}

/// A plane in place of the curved surface would be off by four times the bound.
#[test]
fn over_a_curved_organ_the_force_turns_with_the_surface() {
    let found = link("--scene liver-organ --scheme model --rtt-ms 50 --seconds 8");
    assert!(number(&found, "force_error_rms_percent") <= 1.0, "{found}");
    assert_eq!(found["unstable"], false);
}

#[test]
fn a_deep_press_goes_by_the_law_of_what_it_presses_not_of_what_is_nearest() {
    // From inside, 11 mm deep in the wall: the flank of a fold is nearer, and half as stiff again.
    let found = link("--scene colon --scheme model --rtt-ms 50 --seconds 7");
    let error_percent = number(&found, "force_error_rms_percent");
    assert!(error_percent < 2.0, "{error_percent} %");
}

/// Local models are off by 6 % here: over the edge of a lump the force changes faster than a round trip.
#[test]
fn a_copy_of_the_tissue_knows_the_lump_that_comes_next() {
    let over_a_lump = "--scene liver-organ --place 0.030,-0.013,0.028 --seconds 5 --seed 2";
    // Places that come late or not at all make the server's tool go another way than the copy's.
    for network in ["--rtt-ms 50", "--profile bad-wan --transport datagram"] {
        let found = link(&format!("{over_a_lump} {network}"));
        let error_percent = number(&found, "force_error_rms_percent");
        assert!(error_percent < 0.3, "{network}: {error_percent} %");
        assert_eq!(found["scheme"], "prediction", "the usual one on a mesh");
        // From when the first sample has met it.
        assert!(number(&found, "predicted_ticks") > 4800.0, "{found}");
        assert!(number(&found, "energy_min_j") >= -1e-6, "{found}");
    }
    let found = link(&format!("{over_a_lump} --rtt-ms 50 --scheme model"));
    assert_eq!(number(&found, "predicted_ticks"), 0.0);
    assert!(number(&found, "force_error_rms_percent") > 3.0, "{found}");
}

/// What only the server knows comes by samples, and where that makes the copy worse than the local model, that is
/// rendered.
#[test]
fn a_copy_that_is_not_the_whole_truth_does_no_harm() {
    for (what, most_percent) in [
        ("--second-tool-mm 10", 5.0),
        // For 100 ms the client does not know of it.
        ("--tissue-change-s 3 --tissue-change-factor 1.5", 10.0),
        ("--deadband 0.1 --up-deadband 0.05", 2.0),
    ] {
        let run = |scheme| link(&format!("--scene fibrotic --rtt-ms 50 {what} --seconds 6 --scheme {scheme}"));
        let (copy, models) = (run("prediction"), run("model"));
        let [copy_percent, models_percent] = [&copy, &models].map(|found| number(found, "force_error_rms_percent"));
        assert!(
            copy_percent < most_percent && copy_percent < 1.5 * models_percent + 0.5,
            "{what}: {copy_percent} {models_percent}"
        );
        assert!(number(&copy, "predicted_ticks") > 1000.0 && copy["unstable"] == false, "{copy}");
    }
}

/// With a real server's snapshot.
#[test]
fn a_bridge_renders_from_a_copy_of_a_mesh_and_of_a_sheet_only_when_asked_to() {
    let server = TestServer::start(&[]);
    let run = |scene: &str, more: &str, seconds: u32| {
        let url = &server.url;
        client(&format!("bridge --json --server {url} --scene {scene} --seconds {seconds} {more}"))
    };
    let predicted = |output: &std::process::Output| {
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let report: Value = serde_json::from_slice(&output.stdout).unwrap();
        let late_us = ["p50", "p99", "max"].map(|part| number(&report["tick_lateness_us"], part));
        assert!(late_us[0] <= late_us[1] && late_us[1] <= late_us[2] && late_us[2] > 0.0, "{report}");
        report["predicted_ticks"].as_u64().unwrap()
    };
    // On a busy machine, a connection or a copy may take more than a few seconds.
    for (scene, more) in [("paper", ""), ("gallbladder", "--prediction never")] {
        let output = [3, 30].iter().map(|seconds| run(scene, more, *seconds)).find(|output| output.status.success());
        let output = output.unwrap_or_else(|| panic!("the bridge of {scene} does not connect"));
        assert_eq!(predicted(&output), 0);
    }
    for (scene, more) in [("paper", "--prediction always"), ("gallbladder", "")] {
        assert!([3, 30, 60].iter().any(|seconds| {
            let output = run(scene, more, *seconds);
            output.status.success() && predicted(&output) > 0
        }));
    }
}

/// Over a stream the same losses cost a third of the force.
#[test]
fn over_datagrams_a_lost_packet_costs_nothing() {
    for (scene, network) in [
        ("liver", "--rtt-ms 50 --loss 0.1"),
        ("fibrotic", "--rtt-ms 50 --loss 0.01 --loss-burst 5"),
        ("liver", "--rtt-ms 50 --jitter-ms 40"),
        ("fibrotic", "--profile bad-wan"),
    ] {
        let found = link(&format!("--scene {scene} --transport datagram {network} --seconds 8"));
        assert!(number(&found, "force_error_rms_percent") <= 0.7, "{found}");
        assert_eq!((number(&found, "energy_min_j"), number(&found, "pauses")), (0.0, 0.0), "{found}");
    }
}

/// The gain is that of a tissue as stiff as it is, and the hand is where it would be without a network.
#[test]
fn a_hand_is_as_deep_as_one_that_feels_the_tissue_itself() {
    for scene in ["liver", "fibrotic"] {
        let found = link(&format!("--scene {scene} --rtt-ms 50 --seconds 8"));
        assert!((number(&found, "force_gain") - 1.0).abs() < 0.01, "{found}");
        assert!(number(&found, "force_bias_n").abs() < 0.01, "{found}");
        assert!(number(&found, "depth_error_percent") < 1.0, "{found}");
        let [rms_m, p99_m] = ["depth_error_rms_m", "depth_error_p99_m"].map(|name| number(&found, name));
        assert!(rms_m > 0.0 && rms_m < p99_m && p99_m < 2e-4, "{found}");
    }
}

/// Samples of each step are 4 Mbit/s: a queue that is always full costs its length. What is news fits.
#[test]
fn a_link_that_is_too_slow_for_all_is_fast_enough_for_news() {
    let run = |more: &str| {
        link(&format!("--scene liver --transport datagram --rtt-ms 50 --bandwidth-kbit 1000 {more} --seconds 8"))
    };
    let (all, news) = (run(""), run("--deadband 0.1 --up-deadband 0.05"));
    assert!(number(&all, "overflowed") > 1000.0 && number(&all, "model_age_ms_p99") > 140.0, "{all}");
    assert_eq!(number(&news, "overflowed"), 0.0, "{news}");
    assert!(number(&news, "force_error_rms_percent") < 1.5, "{news}");
}

/// The copy has the second tool: a hand of this client's at once, another client's by samples.
#[test]
fn a_copy_feels_what_a_second_tool_does_to_the_tissue() {
    let scenes = [("liver", 15), ("gallbladder", 5)];
    for (scene, gap_mm) in scenes {
        let run = |hand: &str| {
            let second = format!("--second-tool-mm {gap_mm} --second-hand {hand}");
            link(&format!(
                "--scene {scene} --scheme prediction --transport datagram --rtt-ms 50 --loss 0.01 {second} --seconds 5"
            ))
        };
        let [own, another, unknown] = ["own", "another", "unknown"].map(run);
        let [own_percent, another_percent, unknown_percent] =
            [&own, &another, &unknown].map(|found| number(found, "force_error_rms_percent"));
        assert!(own_percent < 0.5, "{own}");
        assert!(another_percent < 2.0 && another_percent < 0.7 * unknown_percent, "{another} {unknown}");
        assert!(number(&own, "energy_min_j") >= -1e-6 && number(&another, "energy_min_j") >= -1e-4, "{own} {another}");
    }
}

/// The truth has the second tool and the change of the tissue at the same moments as the server.
#[test]
fn what_else_happens_to_a_tissue_is_felt_by_the_truth_too() {
    for (what, most_percent) in [("--second-tool-mm 15", 5.0), ("--tissue-change-s 4 --tissue-change-factor 1.5", 5.0)]
    {
        let found = link(&format!("--scene liver --transport datagram --rtt-ms 50 {what} --seconds 8"));
        assert!(number(&found, "force_error_rms_percent") < most_percent, "{found}");
        assert!(number(&found, "energy_min_j") >= -1e-3, "{found}");
        assert_eq!(found["unstable"], false);
    }
}

#[test]
fn an_outage_lets_go_of_the_force_and_gives_no_energy() {
    for outage_ms in [100, 200] {
        let found =
            link(&format!("--scene fibrotic --transport datagram --rtt-ms 50 --outage-ms {outage_ms} --seconds 8"));
        assert!(number(&found, "energy_min_j") >= -1e-3, "{found}");
        assert_eq!((&found["unstable"], number(&found, "faults")), (&Value::Bool(false), 0.0), "{found}");
    }
}

/// The tool lets go on the server meanwhile, and rendering pauses. A new touch after it is
/// felt.
#[test]
fn after_a_long_outage_touch_is_enabled_again_without_a_jump() {
    let found = link("--scene liver --transport datagram --rtt-ms 50 --outage-ms 400 --seconds 8");
    assert!(number(&found, "pauses") >= 5.0 && number(&found, "releases") >= 5.0, "{found}");
    assert!(number(&found, "model_age_ms_p99") < 500.0, "{found}");
    assert!(number(&found, "jump_max_n") <= 0.1 && number(&found, "energy_min_j") >= -3e-4, "{found}");
}

/// Of a thousand each way a second, and with no more than half a per cent of error beside what 1000 have.
#[test]
fn news_alone_are_a_tenth_of_the_packets_each_way() {
    for (transport, network) in [("stream", ""), ("datagram", "--loss 0.01"), ("datagram", "--jitter-ms 10")] {
        let run = |news: &str| {
            link(&format!("--scene liver --transport {transport} --rtt-ms 50 {network} {news} --seconds 8"))
        };
        let (all, news) = (run(""), run("--up-deadband 0.05 --deadband 0.1"));
        let error = |found: &Value| number(found, "force_error_rms_percent");
        assert!(error(&news) <= error(&all) + 0.5, "{news}");
        assert!(number(&news, "packets_per_s") <= 100.0 && number(&news, "commands_per_s") <= 100.0, "{news}");
    }
}

#[test]
fn a_deadband_sends_a_twentieth_and_is_not_felt() {
    for scene in ["liver", "fibrotic", "stomach"] {
        let found = link(&format!("--scene {scene} --rtt-ms 2 --deadband 0.1 --seconds 8"));
        assert!((25.0..=32.0).contains(&number(&found, "packets_per_s")), "{found}");
        assert!(number(&found, "force_error_rms_percent") <= 0.4, "{found}");
    }
}

/// `palpate-client link --random 1000` is the long form.
#[test]
fn random_combinations_are_passive() {
    let runs = cases::short_or_long(8, 100);
    let found = link(&format!("--random {runs} --seconds 5 --seed 100"));
    assert_eq!((&found["runs"], &found["unstable"]), (&Value::from(runs), &Value::from(0)));
    let worst = |name: &str| found[name]["worst"].as_f64().unwrap();
    assert!(worst("energy_min_j") >= -1e-3, "{found}");
    assert!(worst("jump_max_n") <= 0.1 + 1e-9, "{found}");
    // The envelope's largest force: a second tool and a stiffer tissue push a hand that is not prepared for it.
    assert!(worst("force_max_n") <= 3.3, "{found}");
}

/// Tips that overlap, stick and turn get more from a copy of the tissue than they gave. No other tool gave that: before it was bounded
/// by what others give, the port gave 0.34 mJ beyond the credit of the envelope, 0.25 mJ.
#[test]
fn a_copy_without_other_tools_is_no_credit_of_a_shaft() {
    let found = link("--instrument shaft --random 1 --seed 2079 --seconds 3");
    let energy_min_j = number(&found["energy_min_j"], "worst");
    assert!((-2.6e-4..0.0).contains(&energy_min_j), "{found}");
}

#[cfg(target_os = "linux")]
#[test]
fn a_sheet_for_which_there_is_no_memory_is_refused_with_a_reason() {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("large.toml");
    std::fs::write(&scene, palpate_tissue::scene::PAPER.replace("points = [31, 31]", "points = [2048, 2048]")).unwrap();
    let mut limited = Command::new("sh");
    limited.args(["-c", "ulimit -v 524288; exec \"$@\"", "sh"]).arg(client_program());
    let ended = limited.args(["link", "--seconds", "1", "--scene"]).arg(&scene).output().unwrap();
    let said = String::from_utf8_lossy(&ended.stderr);
    assert_eq!(ended.status.code(), Some(2), "{said}");
    assert!(said.contains("--scene") && said.contains("the system has no memory for"), "{said}");
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
        ("--bandwidth-kbit 0", "--bandwidth-kbit"),
        ("--second-tool-mm 60", "--second-tool-mm"),
        ("--tissue-change-s 1 --tissue-change-factor 0", "--tissue-change-factor"),
    ] {
        let output = client(&format!("link {arguments}"));
        let told = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "link {arguments}: {told}");
        assert!(told.contains(named), "link {arguments}: {told}");
    }
}

#[tokio::test]
async fn a_bridge_to_what_the_server_does_not_have_ends() {
    let server = TestServer::start(&[]);
    let output = client(&format!("bridge --server {} --scene nowhere", server.url));
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{told}");
    assert!(told.contains("UNKNOWN_SCENE"), "{told}");
}

#[test]
fn a_bridge_to_nobody_fails_and_says_how_often_it_tried() {
    // A port without a listener.
    let address = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let output = client(&format!("bridge --server http://{address} --seconds 0.5"));
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{told}");
    assert!(output.stdout.is_empty());
    assert!(told.contains("attempt 2, the next in 0.2 s"), "{told}");
    let last = told.lines().last().unwrap();
    assert!(
        last.starts_with("palpate-client: never connected, in ") && last.contains("attempts: can't reach"),
        "{told}"
    );
}

#[cfg(unix)]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bridge_deletes_the_session_that_it_made_and_no_other() {
    let scene = || palpate_proto::pb::create_session_request::Source::SceneName("liver".to_owned());
    for (keeps, given, left) in [(false, false, 0), (true, false, 1), (false, true, 1)] {
        let server = TestServer::start(&[]);
        let mut more = if keeps { vec!["--keep-session"] } else { Vec::new() };
        let session = if given { server.create(scene(), false).await.unwrap().session_id } else { String::new() };
        if given {
            more.extend(["--session", &session]);
        }
        let bridge = bridge(&server.url, &more);
        server.until_applied("liver", 10).await;
        let table = String::from_utf8(interrupted(bridge).await.stdout).unwrap();
        assert!(table.contains("connections") && table.contains("late ticks") && !table.contains('{'), "{table}");
        let listed = server.sessions().await.list_sessions(palpate_proto::pb::ListSessionsRequest {}).await.unwrap();
        assert_eq!(listed.into_inner().sessions.len(), left, "keeps {keeps}, given {given}");
    }
}

#[test]
fn a_run_of_link_is_a_table_with_units_for_people() {
    let output = client("link --scene liver --rtt-ms 50 --seconds 1");
    let table = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(table.contains("50 ms round trip, ± 0 ms each way, 0 % lost"), "{table}");
    for (name, unit) in [("largest force", "N rendered"), ("force error", "% rms"), ("least energy", "J (below 0")] {
        let line = table.lines().find(|line| line.starts_with(name)).unwrap_or_else(|| panic!("no {name}: {table}"));
        assert!(line.contains(unit), "{line}");
    }
    // Rounded: no number has more than four digits behind its point.
    let digits =
        |word: &str| word.split_once('.').map_or(0, |(_, part)| part.chars().filter(char::is_ascii_digit).count());
    assert!(table.split_whitespace().all(|word| digits(word) <= 5), "{table}");
}

/// Commands of a bridge, one a tick: within so many its owner has asked for forces three times, and pressed.
const TOUCHES: u64 = 1000;

fn bridge(url: &str, more: &[&str]) -> Child {
    Command::new(client_program())
        .args(["bridge", "--scene", "liver", "--server", url])
        .args(more)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap()
}

fn signal(child: &Child, name: &str) {
    assert!(Command::new("kill").args([name, &child.id().to_string()]).status().unwrap().success());
}

/// Ends a bridge as its user does.
async fn interrupted(bridge: Child) -> Output {
    signal(&bridge, "-INT");
    let output = tokio::task::spawn_blocking(move || bridge.wait_with_output().unwrap()).await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    output
}

fn address(server: &TestServer) -> String {
    server.url.trim_start_matches("http://").to_owned()
}

/// Over real gRPC, a wire that delays, and a cut: the bridge comes back by itself, its forces when they are asked for.
#[cfg(unix)]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_bridge_outlives_a_cut() {
    let server = TestServer::start(&[]);
    let proxy = Proxy::start(address(&server), Duration::from_millis(5)).await;
    let bridge = bridge(&proxy.url(), &["--json"]);
    server.until_applied("liver", TOUCHES).await;
    proxy.cut();
    server.until_let_go().await;
    proxy.mend();
    server.until_applied("liver", TOUCHES).await;
    let output = interrupted(bridge).await;
    let found: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert!(proxy.connections() >= 2, "{found}");
    assert!(number(&found, "connections") >= 2.0 && number(&found, "samples") > 100.0, "{found}");
    assert!(number(&found, "energy_j") >= -1e-3, "{found}");
    assert_eq!(found["interventions_ticks"]["not_finite"], 0, "{found}");
    assert!(found["interventions_ticks"]["stale"].as_u64().unwrap() > 0, "the cut was not noticed: {found}");
}

/// The server is killed, the client is frozen: what leaves the client stays within the envelope, and comes back when
/// the device's owner asks for it.
#[cfg(unix)]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn forces_stay_within_the_envelope_whatever_breaks() {
    let first = TestServer::start(&[]);
    let proxy = Proxy::start(address(&first), Duration::from_millis(5)).await;
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("course.csv");
    let bridge = bridge(&proxy.url(), &["--course", file.to_str().unwrap()]);
    first.until_applied("liver", TOUCHES).await;
    drop(first);
    // Long enough without a server that forces pause, however soon the next one is there.
    tokio::time::sleep(Duration::from_secs_f64(2.0 * PAUSE_S)).await;
    let second = TestServer::start(&[]);
    proxy.aim(address(&second));
    second.until_applied("liver", TOUCHES).await;
    signal(&bridge, "-STOP");
    second.until_let_go().await;
    signal(&bridge, "-CONT");
    second.until_applied("liver", TOUCHES).await;
    interrupted(bridge).await;
    let course = DeviceTrace::take(&file);
    let pauses = course.keeps_to_the_envelope();
    // One for the server, one for the freeze.
    assert!(pauses.len() >= 2, "{pauses:?}");
    assert!(course.comes_back_after(pauses[pauses.len() - 1]), "it never came back");
}
