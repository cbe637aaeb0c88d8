//! The body of a request. It must arrive in time, its caller's credentials must still be valid, and each part that is read
//! lets the connection receive more.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::Bytes;
use http_body::Frame;
use tokio::time::{Instant, Sleep};
use tonic::Status;
use tonic::body::Body;

use super::revocation::Call;
use super::transport::Gate;
use crate::refusal::{Reason, Refusal};

/// How long the messages of a call may take to arrive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TimeLimit {
    /// The whole body must arrive within this time: a call with one message.
    WholeBody(Duration),
    /// Each message must arrive within this time after the one before: a call with many messages.
    EachMessage(Duration),
    /// The call itself sets its deadlines.
    None,
}

/// A request's body.
pub(super) struct RequestBody {
    body: Body,
    /// Present if the caller was authenticated.
    call: Option<Arc<Call>>,
    gate: Option<Arc<Gate>>,
    limit: TimeLimit,
    /// Created when the body is first waited for.
    deadline: Option<Pin<Box<Sleep>>>,
    begun: Instant,
}

impl RequestBody {
    pub(super) fn wrap(body: Body, call: Option<Arc<Call>>, gate: Option<Arc<Gate>>, limit: TimeLimit) -> Body {
        // An empty body needs no wait and no check.
        if http_body::Body::is_end_stream(&body) {
            return body;
        }
        Body::new(RequestBody { body, call, gate, limit, deadline: None, begun: Instant::now() })
    }

    /// Ready with the refusal when the time limit has passed.
    fn poll_late(&mut self, context: &mut Context<'_>) -> Poll<Refusal> {
        let (TimeLimit::WholeBody(within) | TimeLimit::EachMessage(within)) = self.limit else { return Poll::Pending };
        let until = self.begun + within;
        let deadline = self.deadline.get_or_insert_with(|| Box::pin(tokio::time::sleep_until(until)));
        deadline.as_mut().poll(context).map(|()| {
            let message = format!("did not arrive in full within {} s", within.as_secs_f64());
            Refusal::new(Reason::TimedOut, "request", message)
        })
    }
}

impl http_body::Body for RequestBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        let this = &mut *self;
        if let Some(Err(refusal)) = this.call.as_ref().map(|call| call.may_say(context)) {
            return Poll::Ready(Some(Err(refusal.into())));
        }
        let Poll::Ready(frame) = Pin::new(&mut this.body).poll_frame(context) else {
            return this.poll_late(context).map(|refusal| Some(Err(refusal.into())));
        };
        if let (Some(gate), Some(Ok(frame))) = (&this.gate, &frame)
            && let Some(data) = frame.data_ref()
        {
            gate.taken(data.len());
        }
        if matches!(this.limit, TimeLimit::EachMessage(_)) {
            (this.deadline, this.begun) = (None, Instant::now());
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> http_body::SizeHint {
        self.body.size_hint()
    }
}
