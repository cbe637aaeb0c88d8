//! The body of a request. It must arrive in time, and its caller's credentials must still be valid; each part that is
//! read allows the connection to receive more. The memory of a large message is charged to its caller from before it
//! is decoded until the call is answered.

use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::Bytes;
use http_body::Frame;
use palpate_proto::codec::{Payer, paid_by};
use tokio::time::{Instant, Sleep};
use tonic::Status;
use tonic::body::Body;

use super::revocation::Call;
use super::transport::Gate;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::budget::{Account, Purpose, Resource, Taken};
use palpate_tissue::lock::lock;

/// Time limit for the messages of a call.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum TimeLimit {
    /// The whole body must arrive within this time: for a call with one message.
    WholeBody(Duration),
    /// Each message must arrive within this time after the one before: for a call with many messages.
    EachMessage(Duration),
    /// The call itself sets its deadlines.
    None,
}

/// A request's body with its time limit, credentials and flow control.
pub(super) struct RequestBody {
    body: Body,
    /// The call, if its caller was authenticated.
    call: Option<Arc<Call>>,
    gate: Option<Arc<Gate>>,
    limit: TimeLimit,
    /// Created when the body is first polled.
    deadline: Option<Pin<Box<Sleep>>>,
    begun: Instant,
}

impl RequestBody {
    pub(super) fn wrap(body: Body, call: Option<Arc<Call>>, gate: Option<Arc<Gate>>, limit: TimeLimit) -> Body {
        // An empty body needs neither a time limit nor a check.
        if http_body::Body::is_end_stream(&body) {
            return body;
        }
        Body::new(RequestBody { body, call, gate, limit, deadline: None, begun: Instant::now() })
    }

    /// Returns the refusal once the time limit has passed.
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

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<std::result::Result<Frame<Bytes>, Status>>> {
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

/// The memory charged for a call's message. In a call with many messages it is that of the last one: the reader pays
/// for what it keeps.
struct MessageMemory {
    account: Account,
    taken: Mutex<Option<Taken>>,
}

impl Payer for MessageMemory {
    fn pay(&self, bytes: u64) -> Result<()> {
        let mut taken = lock(&self.taken);
        *taken = None;
        *taken = Some(self.account.take(Resource::Memory(Purpose::Requests), bytes, "")?);
        Ok(())
    }
}

/// Runs a call and charges the memory of its messages to `account`.
pub(super) async fn paid_for<F: Future>(account: Account, call: F) -> F::Output {
    let payer: Arc<dyn Payer> = Arc::new(MessageMemory { account, taken: Mutex::default() });
    let mut call = std::pin::pin!(call);
    std::future::poll_fn(|context| paid_by(&payer, || call.as_mut().poll(context))).await
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use palpate_proto::codec::accepts;
    use palpate_proto::pb;
    use prost::Message;

    use super::*;
    use palpate_session::budget::Budget;
    use palpate_tissue::limits::Limits;

    #[tokio::test]
    async fn a_large_message_is_its_callers_until_the_call_is_answered() {
        let account = |memory_bytes| Budget::new(&Limits { memory_bytes, ..Limits::default() }, 1, 1).account("test");
        let has = |account: &Account| account.has(Resource::Memory(Purpose::Requests));
        let request = |commands| pb::SendCommandsRequest {
            commands: vec![pb::Command::default(); commands],
            ..Default::default()
        };
        let (small, large) = (request(2).encode_to_vec(), request(4096).encode_to_vec());
        let rich = account(1 << 30);
        paid_for(rich.clone(), async {
            accepts::<pb::SendCommandsRequest>(&small).unwrap();
            assert_eq!(has(&rich), 0, "a command is not worth the bookkeeping");
            accepts::<pb::SendCommandsRequest>(&large).unwrap();
            let one = has(&rich);
            assert!(one as usize >= 4096 * size_of::<pb::Command>(), "{one}");
            tokio::task::yield_now().await;
            accepts::<pb::SendCommandsRequest>(&large).unwrap();
            assert_eq!(has(&rich), one, "the message before has been read");
        })
        .await;
        assert_eq!(has(&rich), 0);
        let poor = account(100_000);
        let refused = paid_for(poor, async { accepts::<pb::SendCommandsRequest>(&large) }).await.unwrap_err();
        assert_eq!(refused.reason, Reason::TooLarge, "{refused}");
        // A message decoded outside a call is charged to nobody.
        accepts::<pb::SendCommandsRequest>(&large).unwrap();
    }
}
