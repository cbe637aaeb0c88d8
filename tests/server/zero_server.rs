//! −0 from a client of another language: their protobuf sends it, as ours does not. The session is verified and outlives a kill.
#![cfg(unix)]

use std::path::Path;

use crate::common::raw_codec::RawBytes;
use crate::common::server::{self, TestServer};
use palpate_proto::pb;
use palpate_tissue::limits::Limits;
use prost::Message;

/// Calls a method of a service with bytes.
async fn call(server: &TestServer, method: &'static str, request: Vec<u8>) -> Vec<u8> {
    let mut client = tonic::client::Grpc::new(server.channel().await);
    client.ready().await.unwrap();
    let path = http::uri::PathAndQuery::from_static(method);
    client.unary(tonic::Request::new(request), path, RawBytes).await.unwrap().into_inner()
}

/// A field that holds a message, or bytes.
fn within(tag: u8, inner: &[u8]) -> Vec<u8> {
    [&[tag << 3 | 2, u8::try_from(inner.len()).unwrap()][..], inner].concat()
}

/// A vector all of whose components are sent.
fn vector(v: [f64; 3]) -> Vec<u8> {
    let component = |(tag, value): (u8, f64)| [&[tag << 3 | 1][..], &value.to_le_bytes()].concat();
    (1..).zip(v).flat_map(component).collect()
}

fn start(folder: &Path) -> TestServer {
    TestServer::start(&["--log", "info", "--journal", folder.to_str().unwrap()])
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_session_that_was_told_negative_zeros_is_verified_and_outlives_a_kill() {
    let folder = tempfile::tempdir().unwrap();
    let mut before = start(folder.path());
    // A scene with zeros of that kind: no damping, and κ of nothing.
    let paper = before.paper(true).await;
    let mut scene = before.status(&paper).await.scene.unwrap();
    scene.damping = Some(pb::Damping { coefficient_n_s_per_m: Some(-0.0) });
    scene.sleep = Some(pb::Sleep { tolerance: Some(-0.0) });
    scene.stepping.as_mut().unwrap().integrator = "exponential2".to_owned();
    scene.stepping.as_mut().unwrap().substeps = Some(2);
    let source = pb::create_session_request::Source::Scene(scene);
    let id = before.create(source, true).await.unwrap().session_id;
    let grid = pb::GridPoint { x: 7, y: 6 }.encode_to_vec();
    // Position: depth 0, as z = −depth. Force: z alone. Pose: above the middle.
    let position = [within(1, &grid), within(3, &vector([-0.0, 1e-3, -0.0]))].concat();
    let force = [within(1, &grid), within(3, &vector([-0.0, -0.0, -0.3]))].concat();
    let pose = within(1, &vector([-0.0, 0.1, -0.0]));
    for (tool, (action, message)) in (0_u8..).zip([(7, position), (6, force), (9, pose)]) {
        let acquire = pb::AcquireToolRequest {
            session_id: id.clone(),
            tool: tool.into(),
            holder: "zero".to_owned(),
            lease_s: Some(10.0),
            outlives_connection: true,
            more_tools: Vec::new(),
        };
        let lease_id = before.haptics().await.acquire_tool(acquire).await.unwrap().into_inner().lease_id;
        let request = pb::SendCommandsRequest { session_id: id.clone(), lease_id, commands: Vec::new() };
        let command = [&[1 << 3, tool][..], &within(action, &message)].concat();
        let request = [request.encode_to_vec(), within(3, &command)].concat();
        call(&before, "/palpate.v1.HapticService/SendCommands", request).await;
    }
    before.start_until(&id, 1010).await;
    let hash = before.hash_at(&id, 1010).await;
    let waited = tokio::time::timeout(server::TEST_TIMEOUT, async {
        while before.status(&id).await.journal.unwrap().durable_step != Some(1010) {
            tokio::time::sleep(std::time::Duration::from_millis(10)).await;
        }
    });
    waited.await.unwrap();
    before.child.kill().unwrap();
    before.child.wait().unwrap();

    let after = start(folder.path());
    let session = after.status(&id).await;
    assert_eq!(session.step, 1010);
    assert_eq!(after.hash_at(&id, 1010).await, hash);
    let file = palpate_session::journal::file::list(folder.path())
        .unwrap()
        .into_iter()
        .find(|file| file.session_id == id)
        .unwrap();
    let reader = palpate_session::journal::JournalReader::open(&file.path).unwrap();
    let verdict = palpate_session::journal::verify(reader, &Limits::default(), &mut |_, _| {}).unwrap();
    assert!(verdict.difference.is_none() && verdict.compared[0] > 0, "{verdict:?}");
}
