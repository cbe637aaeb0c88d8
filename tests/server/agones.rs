//! Reports to Agones, received by a gRPC server that imitates its SDK.

use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use palpate_cluster::agones::{self, ServerStatus};
use palpate_proto::agones::Empty;
use palpate_proto::agones::beta::sdk_server::{Sdk as Counters, SdkServer as CountersServer};
use palpate_proto::agones::beta::{Counter, GetCounterRequest, UpdateCounterRequest};
use palpate_proto::agones::sdk_server::{Sdk, SdkServer};
use palpate_proto::pb;
use pb::admin_service_client::AdminServiceClient;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Request, Response, Status, Streaming};

use crate::common::etcd::EtcdMembers;
use crate::common::server::{TEST_TIMEOUT, TestServer, server_program};

/// The capacity of the counter.
const CAPACITY: i64 = 70;

/// The SDK of a pod, as far as servers call it.
#[derive(Clone, Default)]
struct Imitation {
    calls: Arc<Mutex<Vec<String>>>,
    beats: Arc<AtomicUsize>,
    /// Number of calls that are not answered.
    hangs: Arc<AtomicUsize>,
}

impl Imitation {
    /// A call is made. Does not end if it hangs.
    async fn called(&self, call: &str) {
        let hangs = self.hangs.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |left| left.checked_sub(1));
        if hangs.is_ok() {
            std::future::pending::<()>().await;
        }
        self.calls.lock().unwrap().push(call.to_owned());
    }

    async fn empty(&self, call: &str) -> Result<Response<Empty>, Status> {
        self.called(call).await;
        Ok(Response::new(Empty {}))
    }

    fn serve(&self, listener: TcpListener) {
        let router = tonic::transport::Server::builder()
            .add_service(SdkServer::new(self.clone()))
            .add_service(CountersServer::new(self.clone()));
        tokio::spawn(async move { router.serve_with_incoming(TcpListenerStream::new(listener)).await.unwrap() });
    }

    /// Waits until these are all calls so far.
    async fn until(&self, expected: &[&str]) {
        let begun = std::time::Instant::now();
        while *self.calls.lock().unwrap() != expected {
            assert!(begun.elapsed() < TEST_TIMEOUT, "{:?} instead of {expected:?}", self.calls.lock().unwrap());
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    async fn until_beats(&self, least: usize) {
        let begun = std::time::Instant::now();
        while self.beats.load(Ordering::SeqCst) < least {
            assert!(begun.elapsed() < TEST_TIMEOUT, "the server does not say that it is well");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
}

#[tonic::async_trait]
impl Sdk for Imitation {
    async fn ready(&self, _: Request<Empty>) -> Result<Response<Empty>, Status> {
        self.empty("ready").await
    }

    async fn allocate(&self, _: Request<Empty>) -> Result<Response<Empty>, Status> {
        self.empty("allocate").await
    }

    async fn shutdown(&self, _: Request<Empty>) -> Result<Response<Empty>, Status> {
        self.empty("shutdown").await
    }

    async fn health(&self, request: Request<Streaming<Empty>>) -> Result<Response<Empty>, Status> {
        let mut beats = request.into_inner();
        while beats.message().await?.is_some() {
            self.beats.fetch_add(1, Ordering::SeqCst);
        }
        Ok(Response::new(Empty {}))
    }
}

#[tonic::async_trait]
impl Counters for Imitation {
    async fn get_counter(&self, request: Request<GetCounterRequest>) -> Result<Response<Counter>, Status> {
        let name = request.into_inner().name;
        self.called(&format!("get {name}")).await;
        Ok(Response::new(Counter { name, count: 0, capacity: CAPACITY }))
    }

    async fn update_counter(&self, request: Request<UpdateCounterRequest>) -> Result<Response<Counter>, Status> {
        let update = request.into_inner().counter_update_request.unwrap();
        let count = update.count.unwrap();
        self.called(&format!("{} {count}", update.name)).await;
        match (0..=CAPACITY).contains(&count) {
            true => Ok(Response::new(Counter { name: update.name, count, capacity: CAPACITY })),
            false => Err(Status::unknown("out of range")),
        }
    }
}

async fn listen(port: u16) -> TcpListener {
    TcpListener::bind(("127.0.0.1", port)).await.unwrap()
}

/// Tells an SDK at `port` how a server stands, which may be changed.
fn tell(port: u16, seen: ServerStatus) -> (Arc<Mutex<ServerStatus>>, JoinHandle<()>) {
    let standing = Arc::new(Mutex::new(seen));
    let told = standing.clone();
    (standing, tokio::spawn(agones::tell(port, move || *told.lock().unwrap())))
}

const EMPTY: ServerStatus = ServerStatus { acts: true, sessions: 0, draining: false };

#[tokio::test]
async fn agones_hears_everything_in_its_order() {
    let (listener, sdk) = (listen(0).await, Imitation::default());
    let port = listener.local_addr().unwrap().port();
    sdk.serve(listener);
    let (standing, telling) = tell(port, ServerStatus { acts: false, ..EMPTY });
    // It is well before it takes sessions.
    sdk.until_beats(2).await;
    sdk.until(&[]).await;
    let mut calls = Vec::new();
    for (seen, more) in [
        (EMPTY, &["ready", "get sessions", "sessions 0"][..]),
        (ServerStatus { sessions: 1, ..EMPTY }, &["allocate", "sessions 1"]),
        (ServerStatus { sessions: 7, ..EMPTY }, &["sessions 7"]),
        // More than Agones reckons with.
        (ServerStatus { sessions: 100, ..EMPTY }, &["sessions 70"]),
        (EMPTY, &["ready", "sessions 0"]),
        (ServerStatus { sessions: 2, ..EMPTY }, &["allocate", "sessions 2"]),
        // While it is drained it is still in use.
        (ServerStatus { sessions: 1, draining: true, ..EMPTY }, &["sessions 1"]),
        (ServerStatus { draining: true, ..EMPTY }, &["shutdown"]),
    ] {
        *standing.lock().unwrap() = seen;
        calls.extend(more);
        sdk.until(&calls).await;
    }
    // Nothing after that, but that it is well.
    *standing.lock().unwrap() = ServerStatus { sessions: 3, ..EMPTY };
    let beats = sdk.beats.load(Ordering::SeqCst);
    sdk.until_beats(beats + 2).await;
    sdk.until(&calls).await;
    assert!(!telling.is_finished());
    telling.abort();
}

#[tokio::test]
async fn an_sdk_that_comes_late_is_told_all_the_same() {
    let listener = listen(0).await;
    let port = listener.local_addr().unwrap().port();
    drop(listener);
    let (standing, telling) = tell(port, EMPTY);
    tokio::time::sleep(Duration::from_millis(1500)).await;
    let sdk = Imitation::default();
    sdk.serve(listen(port).await);
    sdk.until(&["ready", "get sessions", "sessions 0"]).await;
    *standing.lock().unwrap() = ServerStatus { sessions: 1, ..EMPTY };
    sdk.until(&["ready", "get sessions", "sessions 0", "allocate", "sessions 1"]).await;
    sdk.until_beats(1).await;
    assert!(!telling.is_finished());
    telling.abort();
}

#[tokio::test]
async fn an_sdk_that_hangs_is_asked_again() {
    let (listener, sdk) = (listen(0).await, Imitation::default());
    let port = listener.local_addr().unwrap().port();
    sdk.hangs.store(1, Ordering::SeqCst);
    sdk.serve(listener);
    let (_, telling) = tell(port, EMPTY);
    sdk.until(&["ready", "get sessions", "sessions 0"]).await;
    assert!(!telling.is_finished());
    telling.abort();
}

/// A server of a fleet of one, under Agones.
fn under_agones(etcd: &EtcdMembers, port: u16, folder: &std::path::Path) -> TestServer {
    let mut command = Command::new(server_program());
    command
        .args(["serve", "--listen", "127.0.0.1:0", "--agones", "--node", "a", "--advertise", "http://localhost:7117"])
        .arg(format!("--cluster={}", etcd.endpoints().join(",")))
        .arg("--journal")
        .arg(folder)
        .env("AGONES_SDK_GRPC_PORT", port.to_string())
        .stderr(Stdio::piped());
    TestServer::spawn(&mut command)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_under_agones_tells_of_its_sessions_and_of_its_drain() {
    if !EtcdMembers::is_there() {
        return;
    }
    let (listener, sdk) = (listen(0).await, Imitation::default());
    let port = listener.local_addr().unwrap().port();
    sdk.serve(listener);
    let (etcd, folder) = (EtcdMembers::start(1), tempfile::tempdir().unwrap());
    let server = under_agones(&etcd, port, folder.path());
    let mut calls = vec!["ready", "get sessions", "sessions 0"];
    sdk.until(&calls).await;
    let session_id = server.paper(false).await;
    calls.extend(["allocate", "sessions 1"]);
    sdk.until(&calls).await;
    server.sessions().await.delete_session(pb::DeleteSessionRequest { session_id }).await.unwrap();
    calls.extend(["ready", "sessions 0"]);
    sdk.until(&calls).await;
    let mut admin = AdminServiceClient::new(server.channel().await);
    let mut drained = admin.drain_node(pb::DrainNodeRequest { stop: false }).await.unwrap().into_inner();
    assert!(drained.message().await.unwrap().is_none());
    calls.push("shutdown");
    sdk.until(&calls).await;
    sdk.until_beats(2).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_serves_while_agones_hangs_or_is_not_there() {
    if !EtcdMembers::is_there() {
        return;
    }
    // Connections are taken, and nothing is said.
    let listener = listen(0).await;
    let port = listener.local_addr().unwrap().port();
    let (etcd, folder) = (EtcdMembers::start(1), tempfile::tempdir().unwrap());
    let server = under_agones(&etcd, port, folder.path());
    let begun = std::time::Instant::now();
    loop {
        // Refused while the server waits for its lease.
        let source = pb::create_session_request::Source::SceneName("paper".into());
        match server.create(source, false).await {
            Ok(_) => break,
            Err(status) => assert!(begun.elapsed() < TEST_TIMEOUT, "{status}"),
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    drop(listener);
    server.paper(false).await;
}
