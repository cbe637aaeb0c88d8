//! A call that goes on for long ends when who made it may not any more: the answer of a stream asks again, whenever
//! something of it leaves, if the file of tokens has changed since.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use http::{HeaderMap, HeaderValue};
use http_body::Frame;
use tonic::Status;
use tonic::body::Body;
use tracing::info;

use super::connections::Peer;
use super::identity::{Caller, Credentials, Role};
use super::reload::Reloaded;
use crate::refusal::Result;

/// What a caller showed, and for what.
#[derive(Clone)]
pub(super) struct Shown {
    pub(super) authorization: Option<HeaderValue>,
    pub(super) peer: Option<Peer>,
    pub(super) role: Role,
    /// Of the file by which that was enough.
    pub(super) version: u64,
}

impl Shown {
    /// Whether that is enough.
    pub(super) fn check(&self, credentials: &Credentials) -> Result<Caller> {
        let caller = credentials.caller(self.authorization.as_ref(), self.peer.as_ref())?;
        caller.needs(self.role)?;
        Ok(caller)
    }
}

/// The answer to a call, until its caller is told to go.
pub(super) struct Revocable {
    answer: Option<Body>,
    shown: Shown,
    credentials: Arc<Reloaded<Credentials>>,
}

impl Revocable {
    /// `answer` to who has shown that.
    pub(super) fn body(answer: Body, shown: Shown, credentials: Arc<Reloaded<Credentials>>) -> Body {
        Body::new(Revocable { answer: Some(answer), shown, credentials })
    }

    /// Why the caller may not go on, if so.
    fn refused(&mut self) -> Option<HeaderMap> {
        let version = self.credentials.version();
        if version == self.shown.version {
            return None;
        }
        self.shown.version = version;
        let refusal = self.shown.check(&self.credentials.get()).err()?;
        info!(client = ?self.shown.peer.as_ref().map(|peer| peer.address), "stream ended: {refusal}");
        let mut trailers = HeaderMap::new();
        Status::from(refusal).add_header(&mut trailers).ok()?;
        Some(trailers)
    }
}

impl http_body::Body for Revocable {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<std::result::Result<Frame<Bytes>, Status>>> {
        let Some(answer) = &mut self.answer else { return Poll::Ready(None) };
        let frame = ready!(Pin::new(answer).poll_frame(context));
        if let Some(trailers) = self.refused() {
            // What the stream holds (a tool, perhaps) is given back.
            self.answer = None;
            return Poll::Ready(Some(Ok(Frame::trailers(trailers))));
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.answer.as_ref().is_none_or(Body::is_end_stream)
    }
}
