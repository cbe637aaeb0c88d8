//! Tools of an operator: metrics, `palpate top`, and the files that come with the server.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader};
use std::process::{Command, Output, Stdio};

use crate::common::metrics::{self, scrape};
use crate::common::server::{TestServer, TestTouch, client_program, force, server_program};
use palpate_proto::pb;
use serde_json::Value;

#[tokio::test]
async fn metrics_tell_what_was_done_and_name_no_session() {
    let mut server = TestServer::start(&["--metrics", "127.0.0.1:0"]);
    let url = metrics::url(&mut server.out);
    let (running, paused) = (server.paper(false).await, server.paper(true).await);
    let mut touch = TestTouch::hold(&server, &running).await;
    for sequence in 1..=3 {
        touch.command(force(0, sequence, -1.0)).await;
    }
    touch.command(force(0, 3, -1.0)).await;
    assert_eq!(touch.rejection().await.reason, "STALE_SEQUENCE");
    touch.sample_with(|sample| sample.awake_points > 0 && sample.step > 10).await;
    let told = scrape(&url);
    let value = |name: &str| *told.get(name).unwrap_or_else(|| panic!("{name} is not in {told:?}"));
    assert_eq!(value("palpate_commands_total"), 3.0);
    assert_eq!(value("palpate_refusals_total{reason=\"STALE_SEQUENCE\"}"), 1.0);
    assert_eq!(value("palpate_calls_total{call=\"/palpate.v1.HapticService/Touch\"}"), 1.0);
    assert_eq!(value("palpate_calls_total{call=\"/palpate.v1.SessionService/CreateSession\"}"), 2.0);
    assert_eq!((value("palpate_sessions{state=\"running\"}"), value("palpate_sessions{state=\"paused\"}")), (1.0, 1.0));
    assert_eq!((value("palpate_points"), value("palpate_streams"), value("palpate_viewers")), (1922.0, 1.0, 0.0));
    assert!(value("palpate_awake_points") > 0.0 && value("palpate_connections") >= 1.0);
    assert!(value("palpate_sent_bytes_total") > 100.0 && value("palpate_received_bytes_total") > 100.0);
    for histogram in ["step_time", "step_lateness"] {
        let name = format!("palpate_{histogram}_seconds");
        let (count, all) = (value(&format!("{name}_count")), value(&format!("{name}_bucket{{le=\"+Inf\"}}")));
        assert!(count > 0.0 && count == all && value(&format!("{name}_sum")) > 0.0, "{told:?}");
    }
    assert!(!told.keys().any(|name| name.contains(&running) || name.contains(&paused)));
    // A count does not fall when what it counted is gone.
    touch.finish();
    for session_id in [running, paused] {
        server.sessions().await.delete_session(pb::DeleteSessionRequest { session_id }).await.unwrap();
    }
    let later = scrape(&url);
    for (name, value) in told.iter().filter(|told| told.0.contains("_total") || told.0.contains("_count")) {
        assert!(later[name] >= *value, "{name} fell from {value} to {}", later[name]);
    }
    assert_eq!((later["palpate_sessions{state=\"running\"}"], later["palpate_points"]), (0.0, 0.0));
}

/// Programs with these features have tests of their own, `observe`.
#[cfg(not(any(feature = "otlp", feature = "foxglove")))]
#[test]
fn a_program_without_an_optional_feature_names_it() {
    let refused = |program, arguments: &[&str], feature: &str| {
        let output = Command::new(program).args(arguments).output().unwrap();
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains(&format!("without the feature `{feature}`")), "{message}");
    };
    refused(server_program(), &["serve", "--listen", "127.0.0.1:0", "--otlp", "http://127.0.0.1:4317"], "otlp");
    refused(client_program(), &["foxglove", &"0".repeat(32)], "foxglove");
}

#[test]
fn the_dashboard_shows_what_is_there_and_asks_for_nothing_else() {
    let folder = tempfile::tempdir().unwrap();
    let journals = folder.path().to_str().unwrap();
    let mut server = TestServer::start(&["--metrics", "127.0.0.1:0", "--journal", journals]);
    let url = metrics::url(&mut server.out);
    let told = scrape(&url);
    let names: BTreeSet<&str> = told.keys().map(|name| name.split('{').next().unwrap()).collect();
    let dashboard: Value = serde_json::from_str(include_str!("../../contrib/grafana.json")).unwrap();
    let mut asked = BTreeSet::new();
    for target in dashboard["panels"].as_array().unwrap().iter().flat_map(|panel| panel["targets"].as_array().unwrap())
    {
        let query = target["expr"].as_str().unwrap();
        for (at, _) in query.match_indices("palpate_") {
            let name: String = query[at..].chars().take_while(|c| c.is_ascii_alphanumeric() || *c == '_').collect();
            // Those of a fleet are compared in src/server/metrics.rs, where they are defined.
            if name.starts_with("palpate_fleet_") {
                continue;
            }
            // These are there when the first call, refusal, cut or look at a file is.
            let later = [
                "palpate_calls_total",
                "palpate_refusals_total",
                "palpate_transport_cuts_total",
                "palpate_useless_files",
            ];
            assert!(names.contains(&*name) || later.contains(&&*name), "{name} is not in {names:?}");
            asked.insert(name);
        }
    }
    // And it shows everything: of a histogram its buckets will do.
    let shown = |name: &str| {
        let histogram = ["_bucket", "_count", "_sum"].iter().find_map(|end| name.strip_suffix(end));
        histogram.map_or_else(|| asked.contains(name), |histogram| asked.contains(&format!("{histogram}_bucket")))
    };
    let left_out: Vec<_> = names.iter().filter(|name| name.starts_with("palpate_") && !shown(name)).collect();
    assert!(asked.len() > 20 && left_out.is_empty(), "{left_out:?}");
}

fn top(arguments: &[&str]) -> Output {
    // The server's program hands over to the client's, which lies beside it.
    client_program();
    Command::new(server_program()).arg("top").args(arguments).output().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn top_shows_sessions_as_a_table_and_as_json() {
    // While it is built a tissue would come to rest.
    client_program();
    let server = TestServer::start(&["--profile"]);
    let (running, paused) = (server.paper(false).await, server.paper(true).await);
    let mut touch = TestTouch::hold(&server, &running).await;
    // Now more and now less, all the while: it would come to rest.
    tokio::spawn(async move {
        for sequence in 1.. {
            touch.command(force(0, sequence, -1.0 / f64::from(1 + u32::from(sequence % 2 == 0)))).await;
            touch.sample_with(|_| true).await;
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        }
    });
    let told = top(&[&server.url, "--once", "--json"]);
    assert!(told.status.success(), "{told:?}");
    let told: Value = serde_json::from_slice(&told.stdout).unwrap();
    let [first, second] = &told["sessions"].as_array().unwrap()[..] else { panic!("{told}") };
    assert_eq!(
        (&first["session_id"], &first["state"], &first["scene"]),
        (&running.into(), &"running".into(), &"paper".into())
    );
    assert_eq!((&first["streams"], &first["points"]), (&1.into(), &961.into()));
    assert_eq!(first["held_tools"][0]["holder"], "test");
    assert!(first["steps_per_s"].as_f64().unwrap() > 0.0 && first["awake_points"].as_f64().unwrap() > 0.0);
    assert!(first["stages_us_per_step"]["sweep"].as_f64().unwrap() > 0.0, "{first}");
    assert_eq!(
        (&second["session_id"], &second["state"], &second["step"]),
        (&paused.into(), &"paused".into(), &0.into())
    );
    let table = top(&[&server.url, "--once"]);
    let table = String::from_utf8(table.stdout).unwrap();
    assert!(table.contains("2 sessions (1 running") && table.contains("0: test"), "{table}");
    assert!(table.contains(" µs a step: "), "{table}");
    assert!(!table.contains('\u{1b}'), "no terminal, no colours");
    // In a pipe whose reader has seen enough.
    let mut child = Command::new(client_program())
        .args(["top", &server.url, "--json"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let lines = BufReader::new(child.stdout.take().unwrap()).lines().take(2);
    assert!(lines.map(Result::unwrap).all(|line| line.starts_with("{\"sessions\":")));
    let ended = child.wait_with_output().unwrap();
    assert!(ended.status.success() && ended.stderr.is_empty(), "{ended:?}");
    let nobody = top(&["http://127.0.0.1:1", "--once"]);
    assert_eq!(nobody.status.code(), Some(1));
    assert!(String::from_utf8(nobody.stderr).unwrap().contains("palpate serve"));
}

#[test]
fn a_server_says_that_it_is_well_and_one_that_is_gone_does_not() {
    let server = TestServer::start(&[]);
    let health = |url: &str| Command::new(client_program()).args(["health", url]).output().unwrap().status.code();
    assert_eq!(health(&server.url), Some(0));
    let url = server.url.clone();
    drop(server);
    assert_eq!(health(&url), Some(1));
}

/// Returns options in a text that `palpate serve` does not have.
fn unknown_options(text: &str) -> Vec<String> {
    let help = Command::new(server_program()).args(["serve", "--help"]).output().unwrap();
    let client = Command::new(client_program()).args(["health", "--help"]).output().unwrap();
    let help = String::from_utf8([help.stdout, client.stdout].concat()).unwrap();
    let words = text.split(|c: char| c.is_whitespace() || "\",[]`".contains(c));
    words.filter(|word| word.starts_with("--") && !help.contains(word)).map(str::to_owned).collect()
}

#[test]
fn the_packaged_files_start_servers_as_they_are() {
    let unit = include_str!("../../contrib/palpate.service");
    let start = unit.split("ExecStart=").nth(1).unwrap().split("LoadCredential").next().unwrap();
    assert_eq!(unknown_options(start), [] as [&str; 0]);
    let dockerfile = include_str!("../../contrib/Dockerfile");
    let commands = dockerfile.split("HEALTHCHECK").nth(1).unwrap();
    let commands = commands.split_once("CMD").unwrap().1;
    assert_eq!(unknown_options(commands), [] as [&str; 0]);
    for line in [
        "DynamicUser=yes",
        "StateDirectory=",
        "NoNewPrivileges=yes",
        "ProtectSystem=strict",
        "MemoryMax=",
        "LimitNOFILE=",
    ] {
        assert!(unit.contains(line), "the unit lacks {line}");
    }
    // Where systemd is, it says whether it understands the unit, with this build's program in the place of the
    // installed.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("palpate.service");
    std::fs::write(&path, unit.replace("/usr/local/bin/palpate", server_program().to_str().unwrap())).unwrap();
    if let Ok(verified) = Command::new("systemd-analyze").arg("verify").arg(&path).output() {
        assert!(verified.status.success() && verified.stderr.is_empty(), "{verified:?}");
    }
}
