//! Memory has a budget: what would be above it is refused with a reason before it is taken, and all is given back.

use std::time::Duration;

use crate::common::server::{self, TEST_TIMEOUT, TestServer, sheet, told, until};
use crate::common::{cores, metrics};
use palpate_proto::pb;
use tonic::Code;

/// A server with so much memory, and where its metrics are. It refuses nothing because its machine is slow.
fn small(memory: &str) -> (TestServer, String) {
    let config = tempfile::NamedTempFile::new().unwrap();
    std::fs::write(&config, "[limits]\nperiods_per_step = 1000.0\n").unwrap();
    let path = config.path().to_str().unwrap();
    let mut server =
        TestServer::start(&["--config", path, "--memory", memory, "--metrics", "127.0.0.1:0", "--log", "error"]);
    let metrics = metrics::url(&mut server.out);
    (server, metrics)
}

/// A metric, of all labels together.
fn metric(url: &str, name: &str) -> f64 {
    metrics::sum(&metrics::scrape(url), name)
}

/// Bytes that the process has in memory.
fn resident(server: &TestServer) -> u64 {
    cores::resident(server.child.id())
}

const TAKEN: &str = "palpate_memory_taken_bytes";

#[tokio::test]
async fn sessions_above_the_budget_are_refused_and_what_went_makes_room() {
    let (server, metrics) = small("64MiB");
    let other = server.paper(false).await;
    let mut touch = server::TestTouch::hold(&server, &other).await;
    let mut kept = Vec::new();
    let refused = loop {
        match server.create(sheet(128, 128), true).await {
            Ok(session) => kept.push(session.session_id),
            Err(refused) => break refused,
        }
        assert!(kept.len() < 100, "nothing is refused");
    };
    assert_eq!(told(&refused), (Code::ResourceExhausted, "OVERLOADED".into(), "sheet.points".into()));
    assert!(kept.len() > 2 && metric(&metrics, TAKEN) <= f64::from(48 << 20));
    // Clients that have their memory are served.
    touch.command(server::force(0, 1, -1.0)).await;
    touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == 1).await;
    drop(touch);
    kept.push(other);
    // A request that could never fit is refused as such.
    let refused = server.create(sheet(1024, 1024), true).await.unwrap_err();
    assert_eq!(told(&refused).1, "TOO_LARGE");
    let mut sessions = server.sessions().await;
    for session_id in kept {
        sessions.delete_session(pb::DeleteSessionRequest { session_id }).await.unwrap();
    }
    drop(sessions);
    until("memory is given back", async || metric(&metrics, TAKEN) == 0.0).await;
    server.create(sheet(128, 128), true).await.unwrap();
}

#[tokio::test]
async fn viewers_above_the_budget_are_refused_and_what_they_were_shown_is_forgotten() {
    let (server, metrics) = small("64MiB");
    let session = server.create(sheet(65, 65), false).await.unwrap().session_id;
    let request = || pb::WatchFramesRequest { session_id: session.clone(), refinement: 5, ..Default::default() };
    let mut unread = Vec::new();
    // One connection, which is counted as well.
    let mut views = server.views().await;
    let refused = loop {
        match views.watch_frames(request()).await {
            Ok(stream) => unread.push(stream),
            Err(refused) => break refused,
        }
        assert!(unread.len() < 100, "no stream was refused");
    };
    // The viewer does not fit, or already the buffer of its stream.
    let (code, reason, field) = told(&refused);
    assert_eq!((code, reason.as_str()), (Code::ResourceExhausted, "OVERLOADED"));
    assert!(["refinement", ""].contains(&field.as_str()), "{field}");
    assert!(unread.len() > 2);
    drop(unread);
    until("what viewers saw is forgotten", async || {
        metric(&metrics, "palpate_memory_taken_bytes{for=\"frames\"}") == 0.0
    })
    .await;
    views.watch_frames(request()).await.unwrap();
}

#[tokio::test]
async fn force_laws_are_charged_and_go_with_their_session() {
    let (server, metrics) = small("96MiB");
    let session_id = server.paper(true).await;
    let laws = || metric(&metrics, "palpate_memory_taken_bytes{for=\"laws\"}");
    assert_eq!(laws(), 0.0);
    let device = palpate_haptics::Device::named("omega3").unwrap();
    let device = Some(palpate_proto::touch::device(&device));
    let touch =
        server::TestTouch::open(&server, pb::TouchOpen { device, ..server::open(&session_id, &[0]) }).await.unwrap();
    assert!(laws() > 0.0);
    drop(touch);
    let request = pb::DeleteSessionRequest { session_id };
    server.sessions().await.delete_session(request).await.unwrap();
    until("laws of a session that is gone are forgotten", async || laws() == 0.0).await;
}

#[tokio::test]
async fn few_changes_of_the_tissue_wait() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, "[limits]\nqueued_changes = 3\n").unwrap();
    let server = TestServer::start(&["--config", config.to_str().unwrap()]);
    let session = server.paper(true).await;
    let mut sessions = server.sessions().await;
    let mut taken = 0;
    let refused = loop {
        let request = pb::UpdateTissueRequest {
            session_id: session.clone(),
            at_step: Some(1000 + taken),
            damping_n_s_per_m: Some(1.0 + taken as f64),
            ..Default::default()
        };
        match sessions.update_tissue(request).await {
            Ok(_) => taken += 1,
            Err(refused) => break refused,
        }
    };
    assert_eq!((taken, told(&refused).1.as_str()), (3, "QUEUE_FULL"));
}

#[tokio::test]
async fn a_sheet_of_short_rows_counts_as_what_it_costs() {
    let (server, _) = small("1GiB");
    let refused = server.create(sheet(1 << 22, 1), true).await.unwrap_err();
    assert_eq!(told(&refused), (Code::ResourceExhausted, "TOO_LARGE".into(), "sheet.points".into()));
    assert!(refused.message().contains("longer side last"), "{refused:?}");
}

#[cfg(all(target_os = "linux", target_env = "gnu"))]
#[tokio::test]
async fn memory_goes_back_to_the_system_with_the_sessions() {
    let (server, metrics) = small("2GiB");
    server.paper(true).await;
    let before = resident(&server);
    let mut sessions = server.sessions().await;
    for _ in 0..3 {
        let session_id = server.create(sheet(512, 512), false).await.unwrap().session_id;
        // Something moves, so that its memory is there.
        let mut touch = server::TestTouch::hold(&server, &session_id).await;
        touch.command(server::force(0, 1, -1.0)).await;
        touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == 1).await;
        let request = pb::GetStateHashRequest { session_id: session_id.clone(), at_step: None };
        sessions.get_state_hash(request).await.unwrap();
        // Another tissue wakes all of it.
        let harder = pb::UpdateTissueRequest {
            session_id: session_id.clone(),
            stiffness_n_per_m: Some(11.0),
            ..Default::default()
        };
        sessions.update_tissue(harder).await.unwrap();
        until("some of it is in memory", async || resident(&server) > before + (4 << 20)).await;
        drop(touch);
        sessions.delete_session(pb::DeleteSessionRequest { session_id }).await.unwrap();
    }
    let name = "palpate_memory_taken_bytes{for=\"sessions\"}";
    until("sessions give their memory back", async || metric(&metrics, name) < f64::from(4 << 20)).await;
    until("memory goes back to the system", async || resident(&server) < before + (64 << 20)).await;
}

/// The tool of a session that is held.
async fn held(server: &TestServer, session: &str) -> usize {
    server.status(session).await.held_tools.len()
}

#[tokio::test]
async fn a_lease_ends_with_its_connection_unless_asked_otherwise() {
    let server = TestServer::start(&[]);
    let session = server.paper(false).await;
    let request = |tool, outlives_connection| pb::AcquireToolRequest {
        session_id: session.clone(),
        tool,
        lease_s: Some(600.0),
        outlives_connection,
        ..Default::default()
    };
    let mut haptics = server.haptics().await;
    haptics.acquire_tool(request(0, false)).await.unwrap();
    haptics.acquire_tool(request(1, true)).await.unwrap();
    assert_eq!(held(&server, &session).await, 2);
    drop(haptics);
    let waited = tokio::time::timeout(TEST_TIMEOUT, async {
        while held(&server, &session).await > 1 {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    });
    waited.await.expect("a tool was never released");
    assert_eq!(server.status(&session).await.held_tools[0].tool, 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn who_administers_frees_tools_and_cuts_streams_and_callers() {
    // Built before anything is held: a connection that does not answer meanwhile is closed.
    tokio::task::spawn_blocking(server::client_program).await.unwrap();
    let server = TestServer::start(&["--log", "error"]);
    let session = server.paper(false).await;
    let admin = |arguments: &[&str]| {
        let mut command = std::process::Command::new(server::client_program());
        command.arg("admin").args(arguments).args(["--server", &server.url]);
        command.output().unwrap()
    };
    let text = |output: &std::process::Output| String::from_utf8(output.stdout.clone()).unwrap();
    let mut touch = server::TestTouch::hold(&server, &session).await;
    let shown = text(&admin(&["streams", &session]));
    assert!(shown.contains("Touch") && shown.contains("holds") && shown.contains("address:127.0.0.1"), "{shown}");
    assert!(text(&admin(&["callers"])).contains("address:127.0.0.1"));
    let number = shown.lines().nth(1).unwrap().split_whitespace().next().unwrap();
    assert!(admin(&["cut-stream", &session, number]).status.success());
    let ended = loop {
        match tokio::time::timeout(TEST_TIMEOUT, touch.hear()).await.expect("a stream that was cut did not end") {
            Ok(Some(_)) => {}
            Ok(None) => panic!("it ends without a reason"),
            Err(status) => break status,
        }
    };
    assert_eq!(told(&ended), (Code::Aborted, "CUT".into(), String::new()));
    server.until_let_go().await;
    assert!(!admin(&["cut-stream", &session, number]).status.success());

    let request = pb::AcquireToolRequest { session_id: session.clone(), lease_s: Some(600.0), ..Default::default() };
    let mut haptics = server.haptics().await;
    haptics.acquire_tool(request.clone()).await.unwrap();
    assert!(admin(&["free-tool", &session, "0"]).status.success());
    assert_eq!(held(&server, &session).await, 0);
    haptics.acquire_tool(request).await.unwrap();
    assert!(!admin(&["revive", &session]).status.success());
    // Its own connection goes, too.
    admin(&["cut-caller", "address:127.0.0.1", "--delete-sessions"]);
    let listed = server.sessions().await.list_sessions(pb::ListSessionsRequest {}).await.unwrap();
    assert!(listed.into_inner().sessions.is_empty());
}

#[tokio::test]
async fn watchers_leave_room_for_who_holds_a_tool() {
    let server = TestServer::start(&["--log", "error"]);
    let session = server.paper(true).await;
    let mut haptics = server.haptics().await;
    let mut watchers = Vec::new();
    let refused = loop {
        let request = pb::WatchSamplesRequest { session_id: session.clone(), ..Default::default() };
        match haptics.watch_samples(request).await {
            Ok(stream) => watchers.push(stream),
            Err(refused) => break refused,
        }
    };
    assert_eq!(told(&refused), (Code::ResourceExhausted, "TOO_MANY".into(), String::new()));
    server::TestTouch::hold(&server, &session).await;
}
