//! Ends the calls of callers whose credentials are revoked. When a message of a call is received or sent, the call is
//! checked if the token file has changed. When the file changes, all calls are checked, since a client that does not
//! read would never be.

use std::collections::HashMap;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::Bytes;
use futures_util::task::AtomicWaker;
use http::HeaderMap;
use http_body::Frame;
use tonic::Status;
use tonic::body::Body;
use tracing::{info, warn};

use super::connection_leases::LastingLeases;
use super::connections::Peer;
use super::identity::{KnownCallers, PresentedCredentials};
use super::reload::Reloaded;
use palpate_realtime::SessionHandle;
use palpate_refusal::{Refusal, Result};
use palpate_session::lease::LeaseId;
use palpate_tissue::lock::lock;

/// Time that a client has to read that its call has ended; then its connection is closed.
const GRACE: Duration = Duration::from_secs(1);

/// The running calls of authenticated callers.
pub(super) struct Calls {
    credentials: Arc<Reloaded<KnownCallers>>,
    under_way: Mutex<HashMap<u64, Weak<Call>>>,
    begun: AtomicU64,
    /// Leases of tools that outlast the call that acquired them.
    leases: LastingLeases,
}

impl Calls {
    pub(super) fn new(credentials: Arc<Reloaded<KnownCallers>>) -> Arc<Self> {
        Arc::new(Calls {
            credentials,
            under_way: Mutex::default(),
            begun: AtomicU64::new(0),
            leases: LastingLeases::default(),
        })
    }

    /// Registers a call from `peer` with credentials that were valid in `version` of the token file. Dropping the
    /// result removes it.
    pub(super) fn begin(
        self: &Arc<Self>,
        presented: PresentedCredentials,
        peer: Option<Peer>,
        version: u64,
    ) -> Arc<Call> {
        let number = self.begun.fetch_add(1, Ordering::Relaxed);
        let call = Arc::new(Call {
            calls: self.clone(),
            number,
            presented,
            peer,
            version: AtomicU64::new(version),
            state: Mutex::default(),
            inward: AtomicWaker::new(),
            outward: AtomicWaker::new(),
        });
        lock(&self.under_way).insert(number, Arc::downgrade(&call));
        call
    }

    /// Ends the calls and leases of callers whose credentials are removed from the file. Runs until the server ends.
    pub(super) async fn watch(self: Arc<Self>) {
        let mut changes = self.credentials.changes();
        while changes.changed().await.is_ok() {
            let credentials = self.credentials.get();
            let released =
                self.leases.end(|presented| presented.is_some_and(|presented| presented.check(&credentials).is_err()));
            if released > 0 {
                info!(released, "tools released: their holders' credentials were revoked");
            }
            let calls: Vec<_> = lock(&self.under_way).values().filter_map(Weak::upgrade).collect();
            let ended: Vec<_> = calls.iter().filter(|call| call.refused().is_some()).map(Arc::downgrade).collect();
            drop(calls);
            if ended.is_empty() {
                continue;
            }
            tokio::spawn(async move {
                tokio::time::sleep(GRACE).await;
                for call in ended.iter().filter_map(Weak::upgrade) {
                    if let Some(peer) = &call.peer {
                        warn!(client = %peer.address, "connection closed: it does not read that its call is over");
                        peer.gate.close();
                    }
                }
            });
        }
    }
}

/// The credentials of a call's caller, for leases that outlast the call.
#[derive(Clone)]
pub(super) struct Tenure {
    calls: Arc<Calls>,
    presented: PresentedCredentials,
}

impl Tenure {
    /// Makes a lease end when the caller's credentials are revoked.
    ///
    /// # Errors
    /// Refuses, and ends the lease, if they are revoked already.
    pub(super) fn bind(&self, handle: &Arc<SessionHandle>, lease: LeaseId) -> Result<()> {
        self.calls.leases.add(handle, lease, Some(self.presented.clone()));
        // The file may have changed since the call was admitted. A later change finds the lease.
        self.presented.check(&self.calls.credentials.get()).map(|_| ()).inspect_err(|_| {
            let _ = handle.at_intake(|intake, _| intake.release(lease));
        })
    }
}

/// A call, until both its directions have ended.
pub(super) struct Call {
    calls: Arc<Calls>,
    number: u64,
    presented: PresentedCredentials,
    peer: Option<Peer>,
    /// Version of the token file by which the call was last checked.
    version: AtomicU64,
    state: Mutex<RevocationState>,
    inward: AtomicWaker,
    outward: AtomicWaker,
}

#[derive(Default)]
struct RevocationState {
    answer: Option<Body>,
    refusal: Option<Refusal>,
}

impl Call {
    /// Returns the caller's credentials, for leases that outlast the call.
    pub(super) fn tenure(&self) -> Tenure {
        Tenure { calls: self.calls.clone(), presented: self.presented.clone() }
    }

    /// Returns the refusal if the caller's credentials are revoked. Then also drops the response, and with it what
    /// the call holds, such as a tool, and wakes both directions.
    fn refused(&self) -> Option<Refusal> {
        let credentials = &self.calls.credentials;
        let version = credentials.version();
        if self.version.swap(version, Ordering::AcqRel) != version
            && let Err(refusal) = self.presented.check(&credentials.get())
        {
            let mut state = lock(&self.state);
            if state.refusal.is_none() {
                info!(client = ?self.peer.as_ref().map(|peer| peer.address), "call ended: {refusal}");
            }
            state.refusal.get_or_insert(refusal);
            let answer = state.answer.take();
            // Dropping the response may wake a task that calls this method.
            drop(state);
            drop(answer);
            self.inward.wake();
            self.outward.wake();
        }
        lock(&self.state).refusal.clone()
    }

    /// Returns an error if no further message may be received; registers the current task to be woken when that
    /// happens.
    pub(super) fn may_say(&self, context: &Context<'_>) -> Result<()> {
        self.inward.register(context.waker());
        self.refused().map_or(Ok(()), Err)
    }

    /// Wraps the body of the response, which ends with the refusal when the credentials are revoked.
    pub(super) fn answer(self: Arc<Self>, answer: Body) -> Body {
        let mut state = lock(&self.state);
        // A call that has ended already is answered only by its refusal.
        if state.refusal.is_none() {
            state.answer = Some(answer);
        }
        drop(state);
        Body::new(Answer { call: self, over: false })
    }
}

impl Drop for Call {
    fn drop(&mut self) {
        lock(&self.calls.under_way).remove(&self.number);
    }
}

/// The body of the response to a call.
struct Answer {
    call: Arc<Call>,
    over: bool,
}

impl http_body::Body for Answer {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<std::result::Result<Frame<Bytes>, Status>>> {
        if self.over {
            return Poll::Ready(None);
        }
        self.call.outward.register(context.waker());
        if let Some(refusal) = self.call.refused() {
            self.over = true;
            let mut trailers = HeaderMap::new();
            return Poll::Ready(
                Status::from(refusal).add_header(&mut trailers).ok().map(|()| Ok(Frame::trailers(trailers))),
            );
        }
        let mut state = lock(&self.call.state);
        match &mut state.answer {
            Some(answer) => Pin::new(answer).poll_frame(context),
            // It was dropped in the meantime: the next poll returns the reason.
            None => {
                context.waker().wake_by_ref();
                Poll::Pending
            }
        }
    }

    fn is_end_stream(&self) -> bool {
        self.over || lock(&self.call.state).answer.as_ref().is_some_and(Body::is_end_stream)
    }
}
