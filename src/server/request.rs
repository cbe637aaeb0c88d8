//! The body of a request as it comes: it must come in time, its caller must still be allowed to, and what of it was taken
//! makes room for more of the connection.

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

/// How long the messages of a call may take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Pace {
    /// All of it must have come by then: a call with one message.
    Whole(Duration),
    /// The next must have come by then: a call with many, to nobody in particular.
    Each(Duration),
    /// The call itself says.
    Own,
}

/// A request's body.
pub(super) struct Inward {
    body: Body,
    /// Of a caller that showed who it is.
    call: Option<Arc<Call>>,
    gate: Option<Arc<Gate>>,
    pace: Pace,
    /// Only once it is waited for.
    deadline: Option<Pin<Box<Sleep>>>,
    begun: Instant,
}

impl Inward {
    pub(super) fn body(body: Body, call: Option<Arc<Call>>, gate: Option<Arc<Gate>>, pace: Pace) -> Body {
        // What has no body, or a page's whole one, is not waited for.
        if http_body::Body::is_end_stream(&body) {
            return body;
        }
        Body::new(Inward { body, call, gate, pace, deadline: None, begun: Instant::now() })
    }

    /// What has not come in time.
    fn poll_late(&mut self, context: &mut Context<'_>) -> Poll<Refusal> {
        let (Pace::Whole(within) | Pace::Each(within)) = self.pace else { return Poll::Pending };
        let until = self.begun + within;
        let deadline = self.deadline.get_or_insert_with(|| Box::pin(tokio::time::sleep_until(until)));
        deadline.as_mut().poll(context).map(|()| {
            let message = format!("did not come in full within {} s", within.as_secs_f64());
            Refusal::new(Reason::TimedOut, "request", message)
        })
    }
}

impl http_body::Body for Inward {
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
        if matches!(this.pace, Pace::Each(_)) {
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
