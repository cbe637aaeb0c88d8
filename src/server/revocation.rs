//! Ends the calls of callers whose credentials are revoked. A call is checked when a message of it comes or goes, if the
//! file of tokens has changed. When the file changes, all calls are checked: a client that does not read would never be.

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

/// So long a client may take to read that its call is over; then its connection is closed.
const GRACE: Duration = Duration::from_secs(1);

/// The calls under way of authenticated callers.
pub(super) struct Calls {
    credentials: Arc<Reloaded<KnownCallers>>,
    under_way: Mutex<HashMap<u64, Weak<Call>>>,
    begun: AtomicU64,
    /// What calls that are over have left.
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

    /// A call from `peer` with these credentials, which were enough by the file of `version`.
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

    /// Ends the calls of those who are struck from the file, for ever.
    pub(super) async fn watch(self: Arc<Self>) {
        let mut changes = self.credentials.changes();
        while changes.changed().await.is_ok() {
            let credentials = self.credentials.get();
            let released =
                self.leases.end(|presented| presented.is_some_and(|presented| presented.check(&credentials).is_err()));
            if released > 0 {
                info!(released, "tools released: who held them may not any more");
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

/// Who made a call, for what outlasts it.
#[derive(Clone)]
pub(super) struct Tenure {
    calls: Arc<Calls>,
    presented: PresentedCredentials,
}

impl Tenure {
    /// Has a lease end when who made the call may not make it any more.
    ///
    /// # Errors
    /// Refuses, and ends the lease, if that is so already.
    pub(super) fn bind(&self, handle: &Arc<SessionHandle>, lease: LeaseId) -> Result<()> {
        self.calls.leases.add(handle, lease, Some(self.presented.clone()));
        // The file may have changed since the call was let in. A change from now on finds the lease.
        self.presented.check(&self.calls.credentials.get()).map(|_| ()).inspect_err(|_| {
            let _ = handle.at_intake(|intake, _| intake.release(lease));
        })
    }
}

/// A call, until both its directions are over.
pub(super) struct Call {
    calls: Arc<Calls>,
    number: u64,
    presented: PresentedCredentials,
    peer: Option<Peer>,
    /// Of the file by which it was looked at last.
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
    /// Who made it.
    pub(super) fn tenure(&self) -> Tenure {
        Tenure { calls: self.calls.clone(), presented: self.presented.clone() }
    }

    /// Why the caller may not go on, if so. Then what the call holds (a tool, perhaps) is given back, and both directions
    /// are told.
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
            // What is dropped here may wake, and ask.
            drop(state);
            drop(answer);
            self.inward.wake();
            self.outward.wake();
        }
        lock(&self.state).refusal.clone()
    }

    /// Whether a further message may come in; who asks is woken when none may.
    pub(super) fn may_say(&self, context: &Context<'_>) -> Result<()> {
        self.inward.register(context.waker());
        self.refused().map_or(Ok(()), Err)
    }

    /// The answer, until the caller is told to go.
    pub(super) fn answer(self: Arc<Self>, answer: Body) -> Body {
        let mut state = lock(&self.state);
        // A call that is over already has nothing to answer but that.
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

/// The answer to a call.
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
            // It was taken away since: the next turn tells why.
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
