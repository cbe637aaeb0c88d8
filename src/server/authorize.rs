//! The layer that every call passes through: it authenticates the caller and checks the caller's role.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::task::{Context, Poll};
use std::time::Duration;

use http::{HeaderValue, Method, Request, Response, StatusCode, header};
use tonic::Status;
use tonic::body::Body;
use tower::{Layer, Service};
use tracing::{Instrument, info, info_span};

use super::charged_caller::ChargedCaller;
use super::connections::Peer;
use super::cpu_account::CpuAccount;
use super::fleet::FencedBody;
use super::identity::{Access, Caller, KnownCallers, PresentedCredentials, access};
use super::reload::Reloaded;
use super::request::{RequestBody, TimeLimit, paid_for};
use super::revocation::Calls;
use super::traffic::Traffic;
use palpate_realtime::fence::Fence;
use palpate_refusal::{Reason, Refusal, Result, excerpt};
use palpate_session::budget::Budget;

/// Puts a [`CallAuthorizer`] in front of a service.
#[derive(Clone)]
pub(super) struct AuthorizeLayer {
    pub(super) credentials: Arc<Reloaded<KnownCallers>>,
    /// The running calls of authenticated callers.
    pub(super) calls: Arc<Calls>,
    /// Time limit for the messages of a call.
    pub(super) message_timeout: Duration,
    pub(super) traffic: Arc<Traffic>,
    pub(super) budget: Arc<Budget>,
    /// Authentication is disabled because only this machine can reach the server. Pages of other sites are then refused.
    pub(super) local_only: bool,
    /// Origins whose pages may call.
    pub(super) origins: Arc<[HeaderValue]>,
    /// In a fleet: the time until which this server may act for its sessions.
    pub(super) fence: Option<Arc<Fence>>,
}

impl<S> Layer<S> for AuthorizeLayer {
    type Service = CallAuthorizer<S>;

    fn layer(&self, inner: S) -> CallAuthorizer<S> {
        CallAuthorizer { layer: self.clone(), inner }
    }
}

/// A service that passes on a call only if its caller has the required role.
#[derive(Clone)]
pub(super) struct CallAuthorizer<S> {
    layer: AuthorizeLayer,
    inner: S,
}

/// The future response to a call.
type CallResponse<E> = Pin<Box<dyn Future<Output = std::result::Result<Response<Body>, E>> + Send>>;

/// A caller. If it was authenticated: its credentials and the version of the token file that accepted them.
type Identified = (Caller, Option<(PresentedCredentials, u64)>);

/// Path prefix of this server's own protocol.
const OWN: &str = "/palpate.";

/// Path prefixes of the server's own protocol that do not act for sessions.
const OF_THE_FLEET: [&str; 3] = [NODES, "/palpate.v1.AdminService/List", "/palpate.v1.SessionService/LocateSession"];

/// Path of `Touch`. Its messages arrive for as long as the client holds a tool; the call sets the deadline for the
/// first.
const TOUCH: &str = "/palpate.v1.HapticService/Touch";

/// Path prefix of the streams of other servers of the fleet. They stay open for as long as those servers run.
const NODES: &str = "/palpate.v1.NodeService/";

/// Path prefix of reflection: calls without authentication and with many messages.
const REFLECTION: &str = "/grpc.reflection.";

impl AuthorizeLayer {
    /// Returns the caller if the call is allowed; otherwise the refusal and the time by which to delay it.
    fn admit<B>(&self, request: &Request<B>) -> std::result::Result<Identified, (Refusal, Duration)> {
        let peer = request.extensions().get::<Peer>();
        peer.map_or(Ok(()), |peer| peer.calls.pass())?;
        self.identify(request, peer).map_err(|refusal| (refusal, Duration::ZERO))
    }

    fn identify<B>(&self, request: &Request<B>, peer: Option<&Peer>) -> Result<Identified> {
        let path = request.uri().path();
        let anonymous = || Ok((Caller::anonymous(), None));
        match access(path) {
            Some(Access::Open) => anonymous(),
            Some(Access::Role(role)) => {
                self.check_origin(request)?;
                let authorization = request.headers().get(header::AUTHORIZATION).cloned();
                let version = self.credentials.version();
                let certificate = peer.and_then(|peer| peer.certificate.clone());
                let presented = PresentedCredentials { authorization, certificate, role };
                let credentials = self.credentials.get();
                let caller = presented.check(&credentials)?;
                self.traffic.called(path);
                if let Some(peer) = peer {
                    peer.slot.mark_authenticated();
                    peer.is_served.store(true, Ordering::Relaxed);
                }
                // With authentication disabled there is nothing to check again later.
                Ok((caller, (!credentials.is_open()).then_some((presented, version))))
            }
            // With authentication disabled, gRPC answers that the call is unknown.
            None if path.starts_with(OWN) && self.credentials.get().is_open() => anonymous(),
            None if path.starts_with(OWN) => {
                let message = format!("no role allows the call {}", excerpt(path));
                Err(Refusal::new(Reason::RoleMissing, "", message))
            }
            // Not a gRPC call of this server: a file of the page, or an unknown path.
            None => anonymous(),
        }
    }

    /// Refuses pages of other sites (DNS rebinding): a site can point its own name at the address of this machine, so
    /// that its pages seem to come from this server. Such an origin is a name, never an address or `localhost`.
    fn check_origin<B>(&self, request: &Request<B>) -> Result<()> {
        let Some(origin) = request.headers().get(header::ORIGIN).filter(|_| self.local_only) else { return Ok(()) };
        if is_here(origin.to_str().unwrap_or_default()) || self.origins.contains(origin) {
            return Ok(());
        }
        let message = "must be this machine, or one of `origins` in the configuration";
        Err(Refusal::new(Reason::OriginNotAllowed, "origin", message))
    }
}

/// Returns the host of an origin.
fn host(origin: &str) -> Option<String> {
    Some(origin.parse::<http::Uri>().ok()?.host()?.to_owned())
}

/// Returns whether the host of an origin is an address or `localhost`, which no site can give to its own name.
fn is_here(origin: &str) -> bool {
    host(origin)
        .is_some_and(|host| host == "localhost" || host.trim_matches(['[', ']']).parse::<std::net::IpAddr>().is_ok())
}

/// Returns whether a page of `origin` may open datagrams at `authority`: its host is that of `authority`, an address
/// or `localhost`, or it is one of the allowed `origins`.
pub(super) fn is_own_or_among(origin: &str, authority: &str, origins: &[HeaderValue]) -> bool {
    let own = format!("https://{authority}");
    is_here(origin) || host(origin).is_some_and(|of| host(&own) == Some(of)) || origins.iter().any(|of| of == origin)
}

/// Returns the response to a request for a gRPC call that is not gRPC itself (405 or 415 as plain text); `None` if it
/// is gRPC. Such a client would not see a gRPC status.
fn answer_if_not_grpc<B>(request: &Request<B>) -> Option<Response<Body>> {
    let path = request.uri().path();
    access(path)?;
    let kind = request.headers().get(header::CONTENT_TYPE).map(HeaderValue::as_bytes).unwrap_or_default();
    let (status, message) = if request.method() != Method::POST {
        (StatusCode::METHOD_NOT_ALLOWED, "is a gRPC call: use POST")
    } else if !kind.starts_with(b"application/grpc") {
        (
            StatusCode::UNSUPPORTED_MEDIA_TYPE,
            "is a gRPC call: the content-type must be application/grpc or application/grpc-web",
        )
    } else {
        return None;
    };
    let mut answer = Response::new(Body::new(axum::body::Body::from(format!("{path} {message}\n"))));
    *answer.status_mut() = status;
    answer.headers_mut().insert(header::CONTENT_TYPE, HeaderValue::from_static("text/plain; charset=utf-8"));
    if status == StatusCode::METHOD_NOT_ALLOWED {
        answer.headers_mut().insert(header::ALLOW, HeaderValue::from_static("POST"));
    }
    Some(answer)
}

impl<S> Service<Request<Body>> for CallAuthorizer<S>
where
    S: Service<Request<Body>, Response = Response<Body>>,
    S::Future: Send + 'static,
    S::Error: Send + 'static,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = CallResponse<S::Error>;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<std::result::Result<(), S::Error>> {
        self.inner.poll_ready(cx)
    }

    fn call(&mut self, mut request: Request<Body>) -> Self::Future {
        match self.layer.admit(&request) {
            Ok((caller, presented)) => {
                // After the check of the role: an unauthorized caller gets that refusal instead.
                if let Some(answer) = answer_if_not_grpc(&request) {
                    return Box::pin(async move { Ok(answer) });
                }
                // Of the span of traces, if there is one: no other has this field.
                tracing::Span::current().record("enduser.id", &*caller.name);
                let peer = request.extensions().get::<Peer>();
                let name = ChargedCaller::account_name(presented.is_some().then_some(&*caller.name), peer);
                let account = self.layer.budget.account(&name);
                if let Some(peer) = peer {
                    peer.used_by(account.number());
                }
                let (gate, from) = (peer.map(|peer| peer.gate.clone()), peer.cloned());
                let limit = match request.uri().path() {
                    TOUCH => TimeLimit::None,
                    path if path.starts_with(NODES) => TimeLimit::None,
                    path if path.starts_with(REFLECTION) => TimeLimit::EachMessage(self.layer.message_timeout),
                    _ => TimeLimit::WholeBody(self.layer.message_timeout),
                };
                let price = CpuAccount::of(request.uri().path(), &account);
                let charged_caller = ChargedCaller::new(account.clone(), &request);
                request.extensions_mut().insert(charged_caller);
                let call = presented.map(|(presented, version)| self.layer.calls.begin(presented, from, version));
                if let Some(call) = &call {
                    request.extensions_mut().insert(call.tenure());
                }
                let request = request.map(|body| RequestBody::wrap(body, call.clone(), gate, limit));
                // The span adds path and client to every line that the call logs.
                let span = info_span!("call", path = request.uri().path(), client = &*caller.name);
                // Once the fence has passed, calls that act for sessions get no answer; calls about the fleet itself
                // still do.
                let path = request.uri().path();
                let is_of_sessions = path.starts_with(OWN) && !OF_THE_FLEET.iter().any(|of| path.starts_with(of));
                let fence = self.layer.fence.clone().filter(|_| is_of_sessions);
                let answer = paid_for(account, self.inner.call(request).instrument(span));
                let traffic = self.layer.traffic.clone();
                Box::pin(async move {
                    let answer = match price {
                        None => answer.await?,
                        Some(price) => match price.answer(answer).await {
                            Ok(answer) => answer?.map(|body| price.body(body)),
                            Err(refusal) => {
                                traffic.refused(refusal.reason);
                                return Ok(Status::from(refusal).into_http());
                            }
                        },
                    };
                    let answer = match fence {
                        Some(fence) => answer.map(|body| FencedBody::wrap(body, fence)),
                        None => answer,
                    };
                    Ok(match call {
                        Some(call) => answer.map(|body| call.answer(body)),
                        None => answer,
                    })
                })
            }
            Err((refusal, wait)) => {
                let address = request.extensions().get::<Peer>().map(|peer| peer.address);
                let reason = refusal.reason.as_str();
                info!(path = request.uri().path(), client = ?address, reason, "call refused: {refusal}");
                self.layer.traffic.refused(refusal.reason);
                Box::pin(async move {
                    tokio::time::sleep(wait).await;
                    Ok(Status::from(refusal).into_http())
                })
            }
        }
    }
}
