//! Every call has a price: the processor time of the network's threads that it takes, charged to its caller. Who has used up
//! their part waits, and is refused if that takes too long. Commands and haptic streams do not wait: they have bounds of
//! their own, and are what the server is for.

use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use bytes::Bytes;
use http_body::Frame;
use tokio::time::Sleep;
use tonic::Status;
use tonic::body::Body;

use crate::budget::{Account, Work};
use crate::pace::clock::{now_ns, thread_time_ns};
use crate::refusal::{Reason, Refusal, Result};

/// Calls of these beginnings are not made to wait.
const AT_ONCE: [&str; 5] = [
    "/palpate.v1.HapticService/Touch",
    "/palpate.v1.HapticService/SendCommands",
    "/palpate.v1.HapticService/ReleaseTool",
    "/palpate.v1.AdminService/",
    "/grpc.health.",
];

/// A call waits no longer than this for its caller's part.
const PATIENCE: Duration = Duration::from_secs(1);

/// What a call takes is charged to this.
#[derive(Debug, Clone)]
pub(super) struct Price(Account);

impl Price {
    /// Of a call of `account`; none if it does not wait.
    pub(super) fn of(path: &str, account: &Account) -> Option<Self> {
        let at_once = AT_ONCE.iter().any(|beginning| path.starts_with(beginning));
        (!at_once).then(|| Price(account.clone()))
    }

    fn must_wait(&self) -> Option<Duration> {
        let ns = self.0.must_wait_ns(Work::Network, now_ns());
        (ns > 0).then(|| Duration::from_nanos(ns))
    }

    /// Waits until there is time for a call.
    async fn wait(&self) {
        while let Some(wait) = self.must_wait() {
            tokio::time::sleep(wait).await;
        }
    }

    /// Does something, and charges what it took.
    fn measure<T>(&self, act: impl FnOnce() -> T) -> T {
        let begun_ns = thread_time_ns();
        let done = act();
        self.0.spend(Work::Network, now_ns(), thread_time_ns().saturating_sub(begun_ns));
        done
    }

    /// The answer to a call, at that price: begun when its caller's part allows, one call of a caller after another.
    pub(super) async fn answer<F: Future>(&self, call: F) -> Result<F::Output> {
        let mut call = std::pin::pin!(call);
        let begun = {
            let turn = async {
                let turn = self.0.turn().await;
                self.wait().await;
                turn
            };
            let Ok(_turn) = tokio::time::timeout(PATIENCE, turn).await else {
                let message = "the calls of this caller take more than its part of the server's time";
                return Err(Refusal::new(Reason::Overloaded, "", message));
            };
            // Not more than a look: what the call waits for, others do not wait for.
            std::future::poll_fn(|context| Poll::Ready(self.measure(|| call.as_mut().poll(context)))).await
        };
        match begun {
            Poll::Ready(answer) => Ok(answer),
            Poll::Pending => Ok(std::future::poll_fn(|context| self.measure(|| call.as_mut().poll(context))).await),
        }
    }

    /// The answer, at that price: it comes as fast as its caller's part allows.
    pub(super) fn body(self, answer: Body) -> Body {
        Body::new(Charged { answer, price: self, wait: None })
    }
}

struct Charged {
    answer: Body,
    price: Price,
    wait: Option<Pin<Box<Sleep>>>,
}

impl http_body::Body for Charged {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<std::result::Result<Frame<Bytes>, Status>>> {
        let this = self.get_mut();
        if let Some(wait) = &mut this.wait {
            ready!(wait.as_mut().poll(context));
            this.wait = None;
        }
        let answer = &mut this.answer;
        let frame = ready!(this.price.measure(|| Pin::new(answer).poll_frame(context)));
        // The end is told at once.
        if frame.as_ref().is_some_and(|frame| frame.as_ref().is_ok_and(Frame::is_data)) {
            this.wait = this.price.must_wait().map(|wait| Box::pin(tokio::time::sleep(wait)));
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.answer.is_end_stream()
    }

    fn size_hint(&self) -> http_body::SizeHint {
        self.answer.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::budget::Budget;
    use crate::limits::Limits;

    #[test]
    fn who_has_used_up_their_part_waits_and_others_do_not() {
        let budget = Budget::new(&Limits::default(), 1, 1);
        let [greedy, other] = ["greedy", "other"].map(|name| budget.account(name));
        let price = |account| Price::of("/palpate.v1.SessionService/GetSession", account).unwrap();
        greedy.spend(Work::Network, now_ns(), 1_000_000_000);
        assert!(price(&greedy).must_wait().is_some());
        assert!(price(&other).must_wait().is_none());
        assert!(Price::of("/palpate.v1.HapticService/Touch", &greedy).is_none());
    }

    #[tokio::test]
    async fn a_call_that_waits_too_long_for_its_turn_is_refused() {
        let account = Budget::new(&Limits::default(), 1, 1).account("a");
        let _turn = account.turn().await;
        let refused = Price::of("/", &account).unwrap().answer(async {}).await.unwrap_err();
        assert_eq!(refused.reason, Reason::Overloaded);
    }

    #[tokio::test]
    async fn what_a_call_takes_is_charged_before_the_next_begins() {
        let account = Budget::new(&Limits::default(), 1, 1).account("a");
        let price = Price::of("/", &account).unwrap();
        let busy = || async {
            let begun_ns = thread_time_ns();
            while thread_time_ns() < begun_ns + 20_000_000 {}
        };
        price.answer(busy()).await.unwrap();
        assert!(price.must_wait().is_some());
        // It waits until it may, and goes on.
        price.answer(busy()).await.unwrap();
    }
}
