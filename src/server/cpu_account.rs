//! Charges callers for calls: each call pays for the processor time that it takes on the network threads. The calls
//! of a caller that has used up its share wait, and are refused if they wait too long. Haptic streams, `ReleaseTool`,
//! `AdminService` and health are not charged and never wait. (Haptic streams have limits of their own, and are the
//! server's main task.)

use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use bytes::Bytes;
use http_body::Frame;
use tokio::time::Sleep;
use tonic::Status;
use tonic::body::Body;

use palpate_realtime::clock::{now_ns, thread_time_ns};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::budget::{Account, Work};

/// Calls whose paths begin with these are not charged and never wait.
const NEVER_WAIT: [&str; 4] = [
    "/palpate.v1.HapticService/Touch",
    "/palpate.v1.HapticService/ReleaseTool",
    "/palpate.v1.AdminService/",
    "/grpc.health.",
];

/// Longest time that a call waits for its caller's share before it is refused.
const SHARE_TIMEOUT: Duration = Duration::from_secs(1);

/// The account that the processor time of a call is charged to.
#[derive(Debug, Clone)]
pub(super) struct CpuAccount(Account);

impl CpuAccount {
    /// Returns the account for a call to `path` by `account`; `None` if such calls are not charged.
    pub(super) fn of(path: &str, account: &Account) -> Option<Self> {
        let never_waits = NEVER_WAIT.iter().any(|beginning| path.starts_with(beginning));
        (!never_waits).then(|| CpuAccount(account.clone()))
    }

    fn must_wait(&self) -> Option<Duration> {
        let ns = self.0.must_wait_ns(Work::Network, now_ns());
        (ns > 0).then(|| Duration::from_nanos(ns))
    }

    /// Returns a timer until the caller's share may allow more; `None` if it allows more now.
    fn sleep(&self) -> Option<Pin<Box<Sleep>>> {
        self.must_wait().map(|wait| Box::pin(tokio::time::sleep(wait)))
    }

    /// Waits until the caller's share allows a call.
    async fn wait(&self) {
        while let Some(wait) = self.must_wait() {
            tokio::time::sleep(wait).await;
        }
    }

    /// Runs `act` and charges the processor time that it took.
    fn measure<T>(&self, act: impl FnOnce() -> T) -> T {
        let begun_ns = thread_time_ns();
        let done = act();
        self.0.spend(Work::Network, now_ns(), thread_time_ns().saturating_sub(begun_ns));
        done
    }

    /// Runs a call and charges it. The call starts when its caller's share allows; a caller's calls start one after
    /// another.
    ///
    /// # Errors
    /// Returns an error if the call would wait longer than [`SHARE_TIMEOUT`].
    pub(super) async fn answer<F: Future>(&self, call: F) -> Result<F::Output> {
        let mut call = std::pin::pin!(call);
        let begun = {
            let turn = async {
                let turn = self.0.turn().await;
                self.wait().await;
                turn
            };
            let Ok(_turn) = tokio::time::timeout(SHARE_TIMEOUT, turn).await else {
                let message = "the calls of this caller take more than its share of the server's time";
                return Err(Refusal::new(Reason::Overloaded, "", message));
            };
            // Polls only once: while the call waits for something, the caller's next call may start.
            std::future::poll_fn(|context| Poll::Ready(self.measure(|| call.as_mut().poll(context)))).await
        };
        match begun {
            Poll::Ready(answer) => Ok(answer),
            Poll::Pending => Ok(std::future::poll_fn(|context| self.measure(|| call.as_mut().poll(context))).await),
        }
    }

    /// Wraps the body of the response so that it is charged and sent as fast as its caller's share allows.
    pub(super) fn body(self, answer: Body) -> Body {
        Body::new(Charged { answer, price: self, wait: None })
    }
}

struct Charged {
    answer: Body,
    price: CpuAccount,
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
        // Other calls of the caller may have used up its share in the meantime.
        while let Some(wait) = &mut this.wait {
            ready!(wait.as_mut().poll(context));
            this.wait = this.price.sleep();
        }
        let answer = &mut this.answer;
        let frame = ready!(this.price.measure(|| Pin::new(answer).poll_frame(context)));
        // Trailers are sent immediately.
        if frame.as_ref().is_some_and(|frame| frame.as_ref().is_ok_and(Frame::is_data)) {
            this.wait = this.price.sleep();
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
    use palpate_session::budget::Budget;
    use palpate_tissue::limits::Limits;

    #[test]
    fn a_caller_that_has_used_up_its_share_waits_and_others_do_not() {
        let budget = Budget::new(&Limits::default(), 1, 1);
        let [greedy, other] = ["greedy", "other"].map(|name| budget.account(name));
        let price = |account| CpuAccount::of("/palpate.v1.SessionService/GetSession", account).unwrap();
        greedy.spend(Work::Network, now_ns(), 1_000_000_000);
        assert!(price(&greedy).must_wait().is_some());
        assert!(price(&other).must_wait().is_none());
        assert!(CpuAccount::of("/palpate.v1.HapticService/Touch", &greedy).is_none());
        assert!(CpuAccount::of("/palpate.v1.HapticService/SendCommands", &greedy).is_some());
    }

    #[tokio::test]
    async fn a_call_that_waits_too_long_for_its_turn_is_refused() {
        let account = Budget::new(&Limits::default(), 1, 1).account("a");
        let _turn = account.turn().await;
        let refused = CpuAccount::of("/", &account).unwrap().answer(async {}).await.unwrap_err();
        assert_eq!(refused.reason, Reason::Overloaded);
    }

    #[tokio::test]
    async fn what_a_call_takes_is_charged_before_the_next_begins() {
        let account = Budget::new(&Limits::default(), 1, 1).account("a");
        let price = CpuAccount::of("/", &account).unwrap();
        let busy = || async {
            let begun_ns = thread_time_ns();
            while thread_time_ns() < begun_ns + 20_000_000 {}
        };
        price.answer(busy()).await.unwrap();
        assert!(price.must_wait().is_some());
        // It waits until its share allows it, then runs.
        price.answer(busy()).await.unwrap();
    }
}
