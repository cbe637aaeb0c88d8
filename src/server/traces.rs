//! Traces of calls for OpenTelemetry: a span for each call of a service, sent to a collector by OTLP over gRPC.
//!
//! The server never waits for the collector. A queue of 2048 spans (`OTEL_BSP_MAX_QUEUE_SIZE`) lies between the two:
//! while it is full, the server drops new spans, and counts them in the log. A thread and a runtime of their own, of
//! lower priority than stepping and network, send the spans.
//!
//! A span has no session ID, because anybody who knows an ID can open the session.

use std::pin::Pin;
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::Bytes;
use http::{HeaderMap, HeaderName, HeaderValue, Request, Response, header};
use http_body::{Frame, SizeHint};
use opentelemetry::KeyValue;
use opentelemetry::propagation::{Extractor, TextMapPropagator};
use opentelemetry::trace::TracerProvider;
use opentelemetry_otlp::{SpanExporter, WithExportConfig, WithTonicConfig};
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::propagation::TraceContextPropagator;
use opentelemetry_sdk::resource::{EnvResourceDetector, ResourceDetector, TelemetryResourceDetector};
use opentelemetry_sdk::trace::SdkTracerProvider;
use tonic::body::Body;
use tonic::transport::ClientTlsConfig;
use tonic::{Code, Status};
use tower::{Layer, Service};
use tracing::field::Empty;
use tracing::level_filters::LevelFilter;
use tracing::{Span, Subscriber, info_span};
use tracing_opentelemetry::OpenTelemetrySpanExt;
use tracing_subscriber::filter::Targets;
use tracing_subscriber::registry::LookupSpan;

use super::config::Config;
use super::identity::access;
use palpate_realtime::ids::random_id;
use palpate_realtime::priority::give_way_a_little;
use palpate_refusal::printable::printable;
use palpate_refusal::{Reason, Refusal, Result};

/// Target of the spans that are sent, which no log should contain.
pub const TARGET: &str = "palpate::traces";

/// Path prefix of the calls that have a span: not those of health and reflection.
const SERVICES: &str = "/palpate.";

/// Time for the last spans to be sent when the server ends.
const FLUSH_TIMEOUT: Duration = Duration::from_secs(2);

/// The connection to a collector, which sends spans until [`Traces::finish`].
pub struct Traces {
    provider: SdkTracerProvider,
    runtime: tokio::runtime::Runtime,
}

/// Returns the attributes of the server: by `OTEL_SERVICE_NAME` and `OTEL_RESOURCE_ATTRIBUTES`, and where these say
/// nothing, the service `palpate`, its version, and the server's name in its fleet or a random ID.
fn resource(config: &Config) -> Result<Resource> {
    let instance = if config.cluster.is_on() { config.cluster.node() } else { random_id()? };
    let own = [
        KeyValue::new("service.name", "palpate"),
        KeyValue::new("service.version", env!("CARGO_PKG_VERSION")),
        KeyValue::new("service.instance.id", instance),
    ];
    let detectors: [Box<dyn ResourceDetector>; 2] =
        [Box::new(TelemetryResourceDetector), Box::new(EnvResourceDetector::new())];
    let resource = Resource::builder_empty().with_attributes(own).with_detectors(&detectors);
    Ok(match std::env::var("OTEL_SERVICE_NAME") {
        Ok(name) if !name.is_empty() => resource.with_service_name(name),
        _ => resource,
    }
    .build())
}

impl Traces {
    /// Starts the threads that send spans to the collector `config.otlp`; `None` if there is none. Does not wait for
    /// a connection. The other variables `OTEL_…` of the environment apply as in the SDK of OpenTelemetry.
    ///
    /// # Errors
    /// Refuses a URL that is not of the form `http://host:port` or `https://host:port`, a variable of the environment
    /// that the exporter can't use, and a system that starts no threads.
    pub fn start(config: &Config) -> Result<Option<Self>> {
        let Some(url) = config.otlp.clone() else { return Ok(None) };
        let resource = resource(config)?;
        let refused = |reason, message: String| Refusal::new(reason, "otlp", message);
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(1)
            .thread_name("traces")
            .on_thread_start(give_way_a_little)
            .enable_all()
            .build()
            .map_err(|e| refused(Reason::TooMany, format!("can't start the threads of traces: {e}")))?;
        // On the thread of that runtime, so that the thread of the processor inherits its priority.
        let built = runtime.spawn(async move {
            let (secure, exporter) =
                (url.starts_with("https:"), SpanExporter::builder().with_tonic().with_endpoint(url));
            let exporter = match secure {
                true => exporter.with_tls_config(ClientTlsConfig::new().with_enabled_roots()),
                false => exporter,
            };
            let exporter = exporter.build()?;
            Ok(SdkTracerProvider::builder().with_batch_exporter(exporter).with_resource(resource).build())
        });
        let built: std::result::Result<_, opentelemetry_otlp::ExporterBuildError> =
            runtime.block_on(built).map_err(|e| refused(Reason::TooMany, format!("can't send traces: {e}")))?;
        let provider = built.map_err(|e| refused(Reason::WrongKind, e.to_string()))?;
        Ok(Some(Traces { provider, runtime }))
    }

    /// Returns the layer of a log's registry that sends the spans of calls, and nothing else.
    pub fn layer<S>(&self) -> impl tracing_subscriber::Layer<S> + Send + Sync + use<S>
    where
        S: Subscriber + for<'s> LookupSpan<'s> + Send + Sync,
    {
        let layer = tracing_opentelemetry::layer()
            .with_tracer(self.provider.tracer("palpate"))
            .with_location(false)
            .with_threads(false)
            .with_target(false)
            .with_tracked_inactivity(false);
        tracing_subscriber::Layer::with_filter(layer, Targets::new().with_target(TARGET, LevelFilter::INFO))
    }

    /// Sends the spans that wait, for at most 2 s, and ends the threads. Must not be called on a thread of a runtime.
    pub fn finish(self) {
        if let Err(error) = self.provider.shutdown_with_timeout(FLUSH_TIMEOUT) {
            tracing::warn!(%error, "the last traces were not sent");
        }
        self.runtime.shutdown_background();
    }
}

/// Puts a [`TracedCalls`] in front of a service.
#[derive(Clone)]
pub(super) struct TraceLayer;

impl<S> Layer<S> for TraceLayer {
    type Service = TracedCalls<S>;

    fn layer(&self, inner: S) -> TracedCalls<S> {
        TracedCalls(inner)
    }
}

/// A service that opens a span for each call. The span ends with the response, for a stream at its end, and is a child
/// of the caller's span in the header `traceparent`.
#[derive(Clone)]
pub(super) struct TracedCalls<S>(S);

/// The future response to a traced call.
type TracedResponse<E> = Pin<Box<dyn Future<Output = std::result::Result<Response<Body>, E>> + Send>>;

impl<S> Service<Request<Body>> for TracedCalls<S>
where
    S: Service<Request<Body>, Response = Response<Body>>,
    S::Future: Send + 'static,
    S::Error: Send + 'static,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = TracedResponse<S::Error>;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<std::result::Result<(), S::Error>> {
        self.0.poll_ready(cx)
    }

    fn call(&mut self, request: Request<Body>) -> Self::Future {
        let Some(call) = OpenCall::begin(&request) else { return Box::pin(self.0.call(request)) };
        let answer = call.span.in_scope(|| self.0.call(request));
        Box::pin(async move { answer.await.map(|answer| call.answer(answer)) })
    }
}

/// The headers of a request, from which the span of the caller is read.
struct RequestHeaders<'h>(&'h HeaderMap);

impl Extractor for RequestHeaders<'_> {
    fn get(&self, key: &str) -> Option<&str> {
        self.0.get(key)?.to_str().ok()
    }

    fn keys(&self) -> Vec<&str> {
        self.0.keys().map(HeaderName::as_str).collect()
    }
}

/// The span of a call that has not ended. If it is dropped before the call has a status, the call was cancelled.
struct OpenCall {
    span: Span,
    has_status: bool,
}

impl OpenCall {
    /// Opens the span of a call; `None` if the request is not a call of this server's protocol, or nobody wants spans.
    fn begin<B>(request: &Request<B>) -> Option<Self> {
        let path = request.uri().path();
        // Only paths from the table of calls become names.
        access(path).filter(|_| path.starts_with(SERVICES))?;
        let name = path.trim_start_matches('/');
        let (service, method) = name.split_once('/')?;
        let span = info_span!(
            target: TARGET,
            parent: None,
            "call",
            otel.name = name,
            otel.kind = "server",
            rpc.system = "grpc",
            rpc.service = service,
            rpc.method = method,
            rpc.grpc.status_code = Empty,
            otel.status_code = Empty,
            otel.status_description = Empty,
            enduser.id = Empty,
        );
        if span.is_disabled() {
            return None;
        }
        let caller = TraceContextPropagator::new().extract(&RequestHeaders(request.headers()));
        // Fails only for a span that has begun.
        let _ = span.set_parent(caller);
        Some(OpenCall { span, has_status: false })
    }

    /// Notes the status in headers or trailers, if they have one.
    fn note(&mut self, headers: &HeaderMap) {
        let Some(status) = Status::from_header_map(headers) else { return };
        self.note_code(status.code());
        // By the conventions of OpenTelemetry the other codes are no errors of a server: a refusal is a good answer.
        let is_fault = [
            Code::Unknown,
            Code::DeadlineExceeded,
            Code::Unimplemented,
            Code::Internal,
            Code::Unavailable,
            Code::DataLoss,
        ];
        if is_fault.contains(&status.code()) {
            self.span.record("otel.status_code", "error");
            self.span.record("otel.status_description", printable(status.message()));
        }
    }

    fn note_code(&mut self, code: Code) {
        self.has_status = true;
        self.span.record("rpc.grpc.status_code", i32::from(code));
    }

    /// Notes the status of a response, now or when its body ends.
    fn answer(mut self, answer: Response<Body>) -> Response<Body> {
        self.note(answer.headers());
        if !answer.status().is_success() {
            // Not an answer of gRPC: it has no status.
            self.has_status = true;
        }
        if self.has_status {
            return answer;
        }
        let kind = answer.headers().get(header::CONTENT_TYPE).map(HeaderValue::as_bytes).unwrap_or_default();
        let is_web = kind.starts_with(b"application/grpc-web");
        answer.map(|body| Body::new(TracedBody { body, call: self, is_web }))
    }
}

impl Drop for OpenCall {
    fn drop(&mut self) {
        if !self.has_status {
            self.note_code(Code::Cancelled);
        }
    }
}

/// The body of a response, which notes the status at its end.
struct TracedBody {
    body: Body,
    call: OpenCall,
    /// For gRPC-web the trailers are data.
    is_web: bool,
}

/// Returns the trailers in the last part of a body of gRPC-web, which is: a byte with the highest bit set, the length
/// in four bytes, and lines `name:value`. `None` if it is another part.
fn web_trailers(part: &[u8]) -> Option<HeaderMap> {
    if part.first()? & 0x80 == 0 {
        return None;
    }
    let lines = part.get(5..)?.split(|byte| *byte == b'\n');
    let pair = |line: &[u8]| {
        let line = line.trim_ascii();
        let colon = line.iter().position(|byte| *byte == b':')?;
        let name = HeaderName::from_bytes(&line[..colon]).ok()?;
        Some((name, HeaderValue::from_bytes(line[colon + 1..].trim_ascii()).ok()?))
    };
    Some(lines.filter_map(pair).collect())
}

impl http_body::Body for TracedBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<std::result::Result<Frame<Bytes>, Status>>> {
        let polled = Pin::new(&mut self.body).poll_frame(context);
        if let Poll::Ready(Some(Ok(frame))) = &polled {
            if let Some(trailers) = frame.trailers_ref() {
                self.call.note(trailers);
            } else if let Some(trailers) = frame.data_ref().filter(|_| self.is_web).and_then(|part| web_trailers(part))
            {
                self.call.note(&trailers);
            }
        }
        polled
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn the_trailers_of_grpc_web_are_the_part_with_the_highest_bit() {
        let part = |lines: &str| [&[0x80, 0, 0, 0, u8::try_from(lines.len()).unwrap()], lines.as_bytes()].concat();
        let trailers = web_trailers(&part("grpc-status:5\r\ngrpc-message:no%20such\r\n")).unwrap();
        let status = Status::from_header_map(&trailers).unwrap();
        assert_eq!((status.code(), status.message()), (Code::NotFound, "no such"));
        assert!(web_trailers(&[0, 0, 0, 0, 2, 8, 1]).is_none() && web_trailers(&[]).is_none());
        // A part that ends early has no status, and one without a colon no trailer.
        assert!(web_trailers(&[0x80, 0, 0]).is_none());
        assert!(web_trailers(&part("grpc-status\r\n")).unwrap().is_empty());
    }
}
