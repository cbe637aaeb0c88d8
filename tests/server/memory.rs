//! A server to which the system gives no more memory: what needs much is refused with a reason, or ends the session
//! that needs it; the process lives and serves others. Linux only: elsewhere the limit of a process can't be set by
//! another.

use std::time::Duration;

use crate::common::cores;
use crate::common::server::{TEST_TIMEOUT, TestServer, TestTouch, force, sheet, told};
use palpate_proto::pb;
use pb::session_service_client::SessionServiceClient;
use rustix::process::{Pid, Resource, Rlimit, prlimit};
use tonic::transport::Channel;
use tonic::{Code, Status};

/// From now on the server may have so many bytes of address space more than it has.
fn leave(server: &TestServer, bytes: u64) {
    let limit = Some(cores::address_space(server.child.id()) + bytes);
    prlimit(Some(Pid::from_child(&server.child)), Resource::As, Rlimit { current: limit, maximum: None }).unwrap();
}

async fn create(sessions: &mut SessionServiceClient<Channel>, side: u32, paused: bool) -> Result<String, Status> {
    let request = pb::CreateSessionRequest { source: Some(sheet(side, side)), paused, idle_timeout_s: None };
    Ok(sessions.create_session(request).await?.into_inner().session.unwrap().session_id)
}

/// Refused for want of memory, in the name of `field`.
#[track_caller]
fn assert_no_memory(refused: &Status, field: &str) {
    assert_eq!(told(refused), (Code::ResourceExhausted, "OVERLOADED".into(), field.into()), "{refused:?}");
    assert!(refused.message().contains("the system has no memory for"), "{refused:?}");
}

/// Checks that readers and commands of a session that is held get that state.
async fn assert_is_held(server: &TestServer, session: &str, mut touch: TestTouch) {
    let ended = loop {
        match tokio::time::timeout(TEST_TIMEOUT, touch.hear()).await.expect("the stream did not end") {
            Ok(Some(_)) => {}
            Ok(None) => panic!("it ends without a reason"),
            Err(status) => break status,
        }
    };
    assert_eq!(told(&ended).1, "SESSION_HELD");
    let mut haptics = server.haptics().await;
    let acquire = pb::AcquireToolRequest { session_id: session.into(), tool: 1, ..Default::default() };
    assert_eq!(told(&haptics.acquire_tool(acquire).await.unwrap_err()).1, "SESSION_HELD");
    // A new reader gets the last good state at once, and the information that no more follows.
    let request = pb::WatchSamplesRequest { session_id: session.into(), ..Default::default() };
    let mut watched = haptics.watch_samples(request).await.unwrap().into_inner();
    assert!(watched.message().await.unwrap().unwrap().sample.unwrap().held);
    assert_eq!(told(&watched.message().await.unwrap_err()).1, "SESSION_HELD");
    let points = pb::GridPoints { points: vec![pb::GridPoint { x: 0, y: 0 }] };
    let named = Some(pb::probe_request::Where::Points(points));
    let request = pb::ProbeRequest { session_id: session.into(), r#where: named, ..Default::default() };
    let mut records = haptics.probe(request).await.unwrap().into_inner();
    assert_eq!(told(&records.message().await.unwrap_err()).1, "SESSION_HELD");
}

#[tokio::test(flavor = "multi_thread")]
async fn without_address_space_requests_are_refused_sessions_end_and_others_are_served() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(
        &config,
        "[limits]\npoints_in_all = 1000000000\nperiods_per_step = 1000.0\nwork_s = 600\nsessions_per_minute = 100000\n",
    )
    .unwrap();
    // The budget is no bound here.
    let server = TestServer::start(&["--config", config.to_str().unwrap(), "--memory", "1024GiB", "--log", "error"]);
    let mut sessions = server.sessions().await;
    let small = server.paper(false).await;
    let mut touch = TestTouch::hold(&server, &small).await;
    let doomed = create(&mut sessions, 512, false).await.unwrap();
    let doomed_touch = TestTouch::hold(&server, &doomed).await;
    leave(&server, 512 << 20);

    // Large sessions until one is refused, then smaller ones: after that there is room for small things alone.
    let mut kept = Vec::new();
    for side in [512, 256, 128, 64] {
        let refused = loop {
            match create(&mut sessions, side, true).await {
                Ok(session) => kept.push(session),
                Err(refused) => break refused,
            }
            assert!(kept.len() < 1000, "nothing is refused");
        };
        assert_no_memory(&refused, "sheet.points");
    }
    let large = kept[0].clone();

    // Whatever needs much is refused.
    let view = pb::WatchFramesRequest { session_id: large.clone(), ..Default::default() };
    assert_no_memory(&server.views().await.watch_frames(view).await.unwrap_err(), "refinement");
    let all = Some(pb::probe_request::Where::AllPoints(true));
    let probe = pb::ProbeRequest { session_id: large.clone(), r#where: all, ..Default::default() };
    assert_no_memory(&server.haptics().await.probe(probe).await.unwrap_err(), "");
    let hash = pb::GetStateHashRequest { session_id: large.clone(), at_step: None };
    assert_no_memory(&sessions.get_state_hash(hash).await.unwrap_err(), "");
    let change = pb::UpdateTissueRequest { session_id: large, stiffness_n_per_m: Some(11.0), ..Default::default() };
    assert_no_memory(&sessions.update_tissue(change).await.unwrap_err(), "");

    // A session that needs more memory to continue is held with the reason.
    doomed_touch.command(force(0, 1, -1.0)).await;
    let waited = tokio::time::timeout(TEST_TIMEOUT, async {
        loop {
            let status = server.status(&doomed).await;
            if status.state() == pb::SessionState::Held {
                return status.hold_reason;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    });
    let reason = waited.await.expect("it was not held without memory");
    assert!(reason.contains("the system has no memory for"), "{reason}");
    assert_is_held(&server, &doomed, doomed_touch).await;

    // Others notice nothing.
    for sequence in 1..50 {
        touch.command(force(0, sequence, -1.0)).await;
        touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == sequence).await;
    }
    assert_eq!(server.status(&small).await.state(), pb::SessionState::Running);

    // A deleted session frees its memory.
    for session_id in kept {
        sessions.delete_session(pb::DeleteSessionRequest { session_id }).await.unwrap();
    }
    let again = tokio::time::timeout(TEST_TIMEOUT, async {
        while let Err(refused) = create(&mut sessions, 512, true).await {
            assert_no_memory(&refused, "sheet.points");
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    });
    again.await.expect("memory does not come back");
}

/// Each thread that had a heap of its own would reserve 64 MiB of addresses for it.
#[tokio::test]
async fn a_server_with_few_addresses_serves_its_first_requests() {
    let script = "ulimit -v 300000 && exec \"$0\" serve --listen 127.0.0.1:0 --memory 64MiB";
    let server = TestServer::by_script(script, &[]);
    let mut sessions = server.sessions().await;
    let first = create(&mut sessions, 31, false).await.unwrap();
    for _ in 0..3 {
        create(&mut sessions, 101, false).await.unwrap();
    }
    // A request without room is refused, and the server continues.
    let refused = create(&mut sessions, 2000, true).await.unwrap_err();
    assert_eq!(refused.code(), Code::ResourceExhausted, "{refused:?}");
    assert_eq!(server.status(&first).await.state(), pb::SessionState::Running);
}
