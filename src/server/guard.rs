//! The one layer that every call goes through: who calls, and whether they may.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use http::{HeaderValue, Method, Request, Response, StatusCode, header};
use tonic::Status;
use tonic::body::Body;
use tower::{Layer, Service};
use tracing::{Instrument, info, info_span};

use super::connections::Peer;
use super::identity::{Access, Caller, Credentials, access};
use super::metrics::Traffic;
use super::price::Price;
use super::reload::Reloaded;
use super::request::{Inward, Pace};
use super::revocation::{Calls, Shown};
use super::visitor::Visitor;
use crate::budget::Budget;
use crate::refusal::{Reason, Refusal, Result};

/// Puts a [`Guard`] before a service.
#[derive(Clone)]
pub(super) struct GuardLayer {
    pub(super) credentials: Arc<Reloaded<Credentials>>,
    /// Those under way whose callers were asked.
    pub(super) calls: Arc<Calls>,
    /// For the messages of a call.
    pub(super) patience: Duration,
    pub(super) traffic: Arc<Traffic>,
    pub(super) budget: Arc<Budget>,
    /// Nobody is asked who they are because nobody else can get here: then no page of another site may, either.
    pub(super) local_only: bool,
    /// Pages that may.
    pub(super) origins: Arc<[HeaderValue]>,
}

impl<S> Layer<S> for GuardLayer {
    type Service = Guard<S>;

    fn layer(&self, inner: S) -> Guard<S> {
        Guard { layer: self.clone(), inner }
    }
}

/// Lets a call through whose caller has the role that it asks for.
#[derive(Clone)]
pub(super) struct Guard<S> {
    layer: GuardLayer,
    inner: S,
}

/// The answer to a call.
type Answer<E> = Pin<Box<dyn Future<Output = std::result::Result<Response<Body>, E>> + Send>>;

/// Who calls, and what they showed for it, with the version of the file by which that was enough.
type Known = (Caller, Option<(Shown, u64)>);

/// Calls of this server's own protocol.
const OWN: &str = "/palpate.";

/// Its messages come for as long as somebody holds a tool; for the first there is a deadline of its own.
const TOUCH: &str = "/palpate.v1.HapticService/Touch";

/// Anybody may ask, as often as they like.
const REFLECTION: &str = "/grpc.reflection.";

impl GuardLayer {
    /// Who calls, if they may, and what they showed for it; else why not, and how long that is to be kept back.
    fn admit<B>(&self, request: &Request<B>) -> std::result::Result<Known, (Refusal, Duration)> {
        let peer = request.extensions().get::<Peer>();
        peer.map_or(Ok(()), |peer| peer.calls.pass())?;
        self.identify(request, peer).map_err(|refusal| (refusal, Duration::ZERO))
    }

    fn identify<B>(&self, request: &Request<B>, peer: Option<&Peer>) -> Result<Known> {
        let path = request.uri().path();
        let nobody = || Ok((Caller::nobody(), None));
        match access(path) {
            Some(Access::Open) => nobody(),
            Some(Access::Role(role)) => {
                self.check_origin(request)?;
                let authorization = request.headers().get(header::AUTHORIZATION).cloned();
                let version = self.credentials.version();
                let certificate = peer.and_then(|peer| peer.certificate.clone());
                let shown = Shown { authorization, certificate, role };
                let credentials = self.credentials.get();
                let caller = shown.check(&credentials)?;
                self.traffic.called(path);
                if let Some(peer) = peer {
                    peer.seat.is_known();
                }
                // Who need not show anything is not asked again.
                Ok((caller, (!credentials.is_open()).then_some((shown, version))))
            }
            // Nobody is asked anything: then it is not known, rather than not allowed.
            None if path.starts_with(OWN) && self.credentials.get().is_open() => nobody(),
            None if path.starts_with(OWN) => {
                let message = "is a call that nobody has been given a role for";
                Err(Refusal::new(Reason::RoleMissing, "", format!("{} {message}", crate::pace::excerpt(path))))
            }
            // What is not a call to a session: a page, or nothing.
            None => nobody(),
        }
    }

    /// A site can give its own name the address of this machine; its pages then pass for pages of this server. They
    /// can't pass for an address, or for `localhost`.
    fn check_origin<B>(&self, request: &Request<B>) -> Result<()> {
        let Some(origin) = request.headers().get(header::ORIGIN).filter(|_| self.local_only) else { return Ok(()) };
        let uri = origin.to_str().ok().and_then(|origin| origin.parse::<http::Uri>().ok());
        let host = uri.as_ref().and_then(http::Uri::host).unwrap_or_default();
        let is_address = host.trim_matches(['[', ']']).parse::<std::net::IpAddr>().is_ok();
        if is_address || host == "localhost" || self.origins.contains(origin) {
            return Ok(());
        }
        let message = "is not this machine, nor one of `origins` in the configuration";
        Err(Refusal::new(Reason::OriginNotAllowed, "origin", message))
    }
}

/// What is told to who asks for a call in another way than gRPC: gRPC itself could not say it so that they read it.
fn misdirected<B>(request: &Request<B>) -> Option<Response<Body>> {
    let path = request.uri().path();
    access(path)?;
    let kind = request.headers().get(header::CONTENT_TYPE).map(HeaderValue::as_bytes).unwrap_or_default();
    let (status, message) = if request.method() != Method::POST {
        (StatusCode::METHOD_NOT_ALLOWED, "is a gRPC call: it is made by POST")
    } else if !kind.starts_with(b"application/grpc") {
        (
            StatusCode::UNSUPPORTED_MEDIA_TYPE,
            "is a gRPC call: its content-type is application/grpc or application/grpc-web",
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

impl<S> Service<Request<Body>> for Guard<S>
where
    S: Service<Request<Body>, Response = Response<Body>>,
    S::Future: Send + 'static,
    S::Error: Send + 'static,
{
    type Response = Response<Body>;
    type Error = S::Error;
    type Future = Answer<S::Error>;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<std::result::Result<(), S::Error>> {
        self.inner.poll_ready(cx)
    }

    fn call(&mut self, mut request: Request<Body>) -> Self::Future {
        match self.layer.admit(&request) {
            Ok((caller, shown)) => {
                // Who may not call is told that first.
                if let Some(answer) = misdirected(&request) {
                    return Box::pin(async move { Ok(answer) });
                }
                let peer = request.extensions().get::<Peer>();
                let name = Visitor::account_name(shown.is_some().then_some(&*caller.name), peer);
                let account = self.layer.budget.account(&name);
                if let Some(peer) = peer {
                    peer.used_by(account.number());
                }
                let (gate, from) = (peer.map(|peer| peer.gate.clone()), peer.cloned());
                let pace = match request.uri().path() {
                    TOUCH => Pace::Own,
                    path if path.starts_with(REFLECTION) => Pace::Each(self.layer.patience),
                    _ => Pace::Whole(self.layer.patience),
                };
                let price = Price::of(request.uri().path(), &account);
                let visitor = Visitor::new(account, &request);
                request.extensions_mut().insert(visitor);
                let call = shown.map(|(shown, version)| self.layer.calls.begin(shown, from, version));
                if let Some(call) = &call {
                    request.extensions_mut().insert(call.tenure());
                }
                let request = request.map(|body| Inward::body(body, call.clone(), gate, pace));
                // In every line of the log that the call writes.
                let span = info_span!("call", path = request.uri().path(), client = &*caller.name);
                let answer = self.inner.call(request).instrument(span);
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
