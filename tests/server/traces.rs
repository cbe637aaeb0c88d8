//! Traces of calls, received by a collector of OpenTelemetry in the test.

use std::collections::BTreeMap;
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::Instant;

use opentelemetry_proto::tonic::collector::trace::v1::trace_service_server::{TraceService, TraceServiceServer};
use opentelemetry_proto::tonic::collector::trace::v1::{ExportTraceServiceRequest, ExportTraceServiceResponse};
use opentelemetry_proto::tonic::common::v1::KeyValue;
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::trace::v1::Span;
use opentelemetry_proto::tonic::trace::v1::span::SpanKind;
use opentelemetry_proto::tonic::trace::v1::status::StatusCode;
use palpate::server::identity::{self, Role};
use palpate_proto::pb;
use tokio::net::TcpListener;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::{Code, Request, Response, Status};

use crate::common::server::{TEST_TIMEOUT, TestServer, palpate, server_program};

/// A collector, which keeps what it gets.
#[derive(Clone, Default)]
struct Collector(Arc<Mutex<Vec<ExportTraceServiceRequest>>>);

#[tonic::async_trait]
impl TraceService for Collector {
    async fn export(
        &self,
        request: Request<ExportTraceServiceRequest>,
    ) -> Result<Response<ExportTraceServiceResponse>, Status> {
        self.0.lock().unwrap().push(request.into_inner());
        Ok(Response::new(ExportTraceServiceResponse::default()))
    }
}

/// Attributes as text.
fn texts(attributes: &[KeyValue]) -> BTreeMap<String, String> {
    let text = |attribute: &KeyValue| match attribute.value.as_ref().and_then(|value| value.value.as_ref()) {
        Some(Value::StringValue(text)) => text.clone(),
        Some(Value::IntValue(number)) => number.to_string(),
        other => format!("{other:?}"),
    };
    attributes.iter().map(|attribute| (attribute.key.clone(), text(attribute))).collect()
}

impl Collector {
    async fn start() -> (Self, String) {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let collector = Collector::default();
        let router = tonic::transport::Server::builder().add_service(TraceServiceServer::new(collector.clone()));
        tokio::spawn(async move { router.serve_with_incoming(TcpListenerStream::new(listener)).await.unwrap() });
        (collector, url)
    }

    fn spans(&self) -> Vec<Span> {
        let received = self.0.lock().unwrap();
        let scopes = received.iter().flat_map(|one| &one.resource_spans).flat_map(|one| &one.scope_spans);
        scopes.flat_map(|scope| scope.spans.clone()).collect()
    }

    /// Waits until there are `count` spans, and returns them with the shortest name first.
    async fn until(&self, count: usize) -> Vec<Span> {
        let begun = Instant::now();
        while self.spans().len() < count {
            assert!(begun.elapsed() < TEST_TIMEOUT, "{:?} instead of {count} spans", self.spans());
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        }
        self.spans()
    }
}

/// A server that sends its traces to a collector, at most every 50 ms.
fn traced(url: &str, arguments: &[&str]) -> TestServer {
    let mut command = Command::new(server_program());
    command
        .args(["serve", "--listen", "127.0.0.1:0", "--log", "warn", "--otlp", url])
        .args(arguments)
        .env("OTEL_BSP_SCHEDULE_DELAY", "50")
        .env("OTEL_BSP_MAX_QUEUE_SIZE", "16")
        .env("OTEL_RESOURCE_ATTRIBUTES", "deployment.environment.name=test")
        .stderr(Stdio::piped());
    TestServer::spawn(&mut command)
}

/// Ends a server as the system does, and asserts that it ends by itself, and well.
async fn assert_ends(mut server: TestServer) {
    assert!(Command::new("kill").arg(server.child.id().to_string()).status().unwrap().success());
    let ended = tokio::task::spawn_blocking(move || server.child.wait().unwrap());
    assert!(tokio::time::timeout(TEST_TIMEOUT, ended).await.unwrap().unwrap().success());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_collector_gets_a_span_of_each_call_with_its_name_and_status() {
    let (collector, url) = Collector::start().await;
    let server = traced(&url, &[]);
    let session_id = server.paper(true).await;
    let mut sessions = server.sessions().await;
    let unknown = pb::GetSessionRequest { session_id: "0".repeat(32) };
    let mut unknown = Request::new(unknown);
    let (trace, parent) = ("4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7");
    unknown.metadata_mut().insert("traceparent", format!("00-{trace}-{parent}-01").parse().unwrap());
    assert_eq!(sessions.get_session(unknown).await.unwrap_err().code(), Code::NotFound);
    let request = pb::WatchSamplesRequest { session_id: session_id.clone(), ..Default::default() };
    let stream = server.haptics().await.watch_samples(request).await.unwrap();
    drop(stream);
    let spans = collector.until(3).await;
    let hex = |bytes: &[u8]| bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
    for (name, code) in [
        ("palpate.v1.SessionService/CreateSession", Code::Ok),
        ("palpate.v1.SessionService/GetSession", Code::NotFound),
        ("palpate.v1.HapticService/WatchSamples", Code::Cancelled),
    ] {
        let named: Vec<&Span> = spans.iter().filter(|span| span.name == name).collect();
        let [span] = named[..] else { panic!("{name}: {spans:?}") };
        assert_eq!(span.kind(), SpanKind::Server);
        let has = texts(&span.attributes);
        let (service, method) = name.split_once('/').unwrap();
        assert_eq!((has["rpc.system"].as_str(), has["rpc.service"].as_str()), ("grpc", service));
        assert_eq!((has["rpc.method"].as_str(), &has["rpc.grpc.status_code"]), (method, &i32::from(code).to_string()));
        assert!(span.end_time_unix_nano > span.start_time_unix_nano);
        // A refusal is no fault of the server.
        assert!(span.status.as_ref().is_none_or(|status| status.code() == StatusCode::Unset), "{span:?}");
        assert_eq!(hex(&span.trace_id) == trace, code == Code::NotFound);
        assert_eq!(hex(&span.parent_span_id), if code == Code::NotFound { parent } else { "" });
        assert!(span.events.is_empty() && !format!("{span:?}").contains(&session_id), "{span:?}");
    }
    let received = collector.0.lock().unwrap()[0].clone();
    let has = texts(&received.resource_spans[0].resource.as_ref().unwrap().attributes);
    assert_eq!((has["service.name"].as_str(), has["service.version"].as_str()), ("palpate", env!("CARGO_PKG_VERSION")));
    assert_eq!((has["service.instance.id"].len(), has["deployment.environment.name"].as_str()), (32, "test"));
    assert_ends(server).await;
    assert_eq!(collector.spans().len(), 3, "{:?}", collector.spans());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_span_names_the_caller_and_the_last_spans_are_sent_at_the_end() {
    let folder = tempfile::tempdir().unwrap();
    let (tokens, token) = (folder.path().join("tokens.toml"), identity::new_token().unwrap());
    std::fs::write(&tokens, identity::entry("ann", &[Role::Watch], &token).unwrap()).unwrap();
    let (collector, url) = Collector::start().await;
    let mut command = Command::new(server_program());
    command
        .args(["serve", "--listen", "127.0.0.1:0", "--otlp", &url, "--tokens", tokens.to_str().unwrap()])
        // Nothing is sent before the end.
        .env("OTEL_BSP_SCHEDULE_DELAY", "3600000")
        .env("OTEL_SERVICE_NAME", "theatre-3")
        .stderr(Stdio::piped());
    let server = TestServer::spawn(&mut command);
    let mut sessions = server.sessions().await;
    let mut request = Request::new(pb::ListScenesRequest {});
    assert_eq!(sessions.list_scenes(pb::ListScenesRequest {}).await.unwrap_err().code(), Code::Unauthenticated);
    request.metadata_mut().insert("authorization", format!("Bearer {token}").parse().unwrap());
    sessions.list_scenes(request).await.unwrap();
    assert!(collector.spans().is_empty());
    assert_ends(server).await;
    let callers = collector.spans().iter().map(|span| texts(&span.attributes)).collect::<Vec<_>>();
    let of = |code: &str| callers.iter().find(|has| has["rpc.grpc.status_code"] == code).unwrap();
    assert_eq!(of("0").get("enduser.id").map(String::as_str), Some("ann"));
    assert_eq!(of("16").get("enduser.id"), None);
    let received = collector.0.lock().unwrap()[0].clone();
    let has = texts(&received.resource_spans[0].resource.as_ref().unwrap().attributes);
    assert_eq!(has["service.name"], "theatre-3");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_serves_and_ends_though_its_collector_is_silent_or_absent() {
    // Connections to it are made by the system, and nobody answers.
    let silent = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let absent = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let urls = [&silent, &absent].map(|listener| format!("http://{}", listener.local_addr().unwrap()));
    drop(absent);
    for url in urls {
        let server = traced(&url, &[]);
        let mut sessions = server.sessions().await;
        // More spans than the queue has places.
        for _ in 0..100 {
            sessions.list_scenes(pb::ListScenesRequest {}).await.unwrap();
        }
        let session = server.paper(true).await;
        server.start_until(&session, 50).await;
        server.hash_at(&session, 50).await;
        assert_ends(server).await;
    }
    drop(silent);
}

#[test]
fn a_collector_that_is_not_a_url_is_refused() {
    for url in ["localhost:4317", "ftp://localhost:4317", "nowhere", ""] {
        let output = palpate(&["serve", "--listen", "127.0.0.1:0", "--otlp", url]);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{message}");
        assert!(message.contains("otlp") && message.contains("must be http://host:port"), "{message}");
    }
}
