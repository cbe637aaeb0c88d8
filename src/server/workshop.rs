//! Work of milliseconds or more that a call waits for (a session laid out, a force law, a texture), on threads that give
//! way to those that step. Callers have their turns one after another, and each has one piece under way at a time: so to ask
//! for much delays nobody but who asks, as long as fewer ask for much than there are threads, and others by no more than a
//! piece. What nobody waits for any more is not begun, and is told to end.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use tokio::sync::oneshot;
use tonic::Status;

use crate::budget::Account;
use crate::limits::Limits;
use crate::lock::lock;
use crate::pace::clock::now_ns;
use crate::pace::priority::give_way;
use crate::refusal::{Reason, Refusal};

/// Threads of a workshop.
const THREADS: usize = 2;

/// Tells work whether anybody still waits for it.
#[derive(Debug, Clone, Default)]
pub(crate) struct Stop(Arc<AtomicBool>);

impl Stop {
    /// Set when nobody waits any more.
    pub(crate) fn flag(&self) -> &AtomicBool {
        &self.0
    }
}

struct Piece {
    number: u64,
    asked_ns: u64,
    work: Box<dyn FnOnce() + Send>,
}

#[derive(Default)]
struct Shop {
    /// By the number of the account, in the order of their turns; nobody without work.
    waiting: VecDeque<(u64, VecDeque<Piece>)>,
    /// For whom something is done, and since when it was asked for.
    working: Vec<(u64, u64)>,
    pieces: u64,
    is_closed: bool,
}

impl Shop {
    /// The first of the next caller for whom nothing is being done.
    fn next(&mut self) -> Option<(u64, Piece)> {
        let is_free = |account: u64| !self.working.iter().any(|busy| busy.0 == account);
        let turn = self.waiting.iter().position(|(account, _)| is_free(*account))?;
        let (account, mut pieces) = self.waiting.remove(turn)?;
        let piece = pieces.pop_front()?;
        if !pieces.is_empty() {
            self.waiting.push_back((account, pieces));
        }
        self.working.push((account, piece.asked_ns));
        Some((account, piece))
    }

    fn remove(&mut self, account: u64, number: u64) {
        if let Some((_, pieces)) = self.waiting.iter_mut().find(|waiting| waiting.0 == account) {
            pieces.retain(|piece| piece.number != number);
        }
        self.waiting.retain(|waiting| !waiting.1.is_empty());
    }
}

struct Bench {
    shop: Mutex<Shop>,
    more: Condvar,
    deadline: Duration,
    most_waiting: usize,
}

impl Bench {
    fn work(&self) {
        let mut shop = lock(&self.shop);
        loop {
            if let Some((account, piece)) = shop.next() {
                drop(shop);
                (piece.work)();
                shop = lock(&self.shop);
                if let Some(done) = shop.working.iter().position(|busy| busy.0 == account) {
                    shop.working.swap_remove(done);
                }
                // Its next piece may be begun by any thread.
                self.more.notify_all();
            } else if shop.is_closed {
                return;
            } else {
                shop = self.more.wait(shop).unwrap_or_else(PoisonError::into_inner);
            }
        }
    }
}

/// Ends the threads with the last clone of a workshop.
struct Door(Arc<Bench>);

impl Drop for Door {
    fn drop(&mut self) {
        lock(&self.0.shop).is_closed = true;
        self.0.more.notify_all();
    }
}

/// Whoever waits for a piece. When they are gone it is not begun, and ends soon if it was.
struct Waiting {
    bench: Arc<Bench>,
    account: u64,
    number: u64,
    stop: Stop,
}

impl Drop for Waiting {
    fn drop(&mut self) {
        self.stop.0.store(true, Ordering::Relaxed);
        lock(&self.bench.shop).remove(self.account, self.number);
    }
}

/// How much there is to do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Load {
    /// Pieces that wait for their turn.
    pub(crate) waiting: usize,
    /// How long ago the oldest was asked for, of those that wait and those under way; 0 if there is none, s.
    pub(crate) oldest_s: f64,
    /// The oldest should be over.
    pub(crate) is_late: bool,
}

/// Threads for heavy work. They end with the last clone.
#[derive(Clone)]
pub(crate) struct Workshop(Arc<Door>);

impl Workshop {
    /// Starts the threads.
    pub(crate) fn open(name: &str, limits: &Limits) -> std::io::Result<Self> {
        let deadline = Duration::from_secs_f64(limits.work_s);
        let (shop, more) = (Mutex::default(), Condvar::new());
        let bench = Arc::new(Bench { shop, more, deadline, most_waiting: limits.queued_work });
        let door = Arc::new(Door(bench.clone()));
        for index in 0..THREADS {
            let bench = bench.clone();
            std::thread::Builder::new().name(format!("{name}-{index}")).spawn(move || {
                give_way();
                bench.work();
            })?;
        }
        Ok(Workshop(door))
    }

    /// Does `work` when it is the turn of `account`. Who hangs up before that is passed over; who hangs up later sets the
    /// flag that `work` is given, and so does the deadline.
    pub(crate) async fn work<T: Send + 'static>(
        &self,
        account: &Account,
        work: impl FnOnce(&Stop) -> T + Send + 'static,
    ) -> Result<T, Status> {
        let (done, result) = oneshot::channel();
        let stop = Stop::default();
        let told = stop.clone();
        let work = move || {
            if let Ok(answer) = catch_unwind(AssertUnwindSafe(|| work(&told))) {
                let _ = done.send(answer);
            }
        };
        let _waiting = self.put(account.number(), stop, Box::new(work))?;
        match tokio::time::timeout(self.0.0.deadline, result).await {
            Ok(Ok(answer)) => Ok(answer),
            Ok(Err(_)) => Err(Status::internal("a fault of the program ended what was asked for")),
            Err(_) => {
                let message = format!("was not done within {} s (limits.work_s)", self.0.0.deadline.as_secs_f64());
                Err(Refusal::new(Reason::TimedOut, "", message).into())
            }
        }
    }

    fn put(&self, account: u64, stop: Stop, work: Box<dyn FnOnce() + Send>) -> Result<Waiting, Refusal> {
        let bench = &self.0.0;
        let mut shop = lock(&bench.shop);
        let number = shop.pieces;
        shop.pieces += 1;
        let piece = Piece { number, asked_ns: now_ns(), work };
        match shop.waiting.iter_mut().find(|waiting| waiting.0 == account) {
            Some((_, pieces)) if pieces.len() >= bench.most_waiting => {
                let message =
                    format!("{} pieces of work of this caller wait already (limits.queued_work)", pieces.len());
                return Err(Refusal::new(Reason::Overloaded, "", message));
            }
            Some((_, pieces)) => pieces.push_back(piece),
            None => shop.waiting.push_back((account, VecDeque::from([piece]))),
        }
        bench.more.notify_one();
        Ok(Waiting { bench: bench.clone(), account, number, stop })
    }

    /// How much there is to do.
    pub(crate) fn load(&self) -> Load {
        let shop = lock(&self.0.0.shop);
        let pieces = shop.waiting.iter().flat_map(|waiting| &waiting.1);
        let begun = shop.working.iter().map(|busy| busy.1);
        let asked_ns = pieces.map(|piece| piece.asked_ns).chain(begun).min();
        let oldest = asked_ns.map_or(Duration::ZERO, |asked| Duration::from_nanos(now_ns().saturating_sub(asked)));
        let waiting = shop.waiting.iter().map(|waiting| waiting.1.len()).sum();
        Load { waiting, oldest_s: oldest.as_secs_f64(), is_late: oldest > self.0.0.deadline }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::budget::Budget;
    use std::sync::mpsc;

    fn workshop(limits: Limits) -> Workshop {
        Workshop::open("test", &limits).unwrap()
    }

    fn accounts<const N: usize>(names: [&str; N]) -> [Account; N] {
        let budget = Budget::new(&Limits::default(), 1, 1);
        names.map(|name| budget.account(name))
    }

    #[tokio::test]
    async fn work_of_one_caller_is_done_in_order_whatever_becomes_of_a_piece() {
        let (workshop, [one]) = (workshop(Limits::default()), accounts(["one"]));
        let faulty = workshop.work(&one, |_| -> u32 { panic!("a test") }).await;
        assert_eq!(faulty.unwrap_err().code(), tonic::Code::Internal);
        let order = Arc::new(Mutex::new(Vec::new()));
        let all = (0..20).map(|number| {
            let order = order.clone();
            workshop.work(&one, move |_| lock(&order).push(number))
        });
        futures_util::future::join_all(all).await;
        assert_eq!(*lock(&order), (0..20).collect::<Vec<_>>());
        assert_eq!(workshop.load(), Load { waiting: 0, oldest_s: workshop.load().oldest_s, is_late: false });
    }

    #[tokio::test]
    async fn one_callers_endless_work_does_not_stop_anothers_and_ends_when_it_is_given_up() {
        let (workshop, [greedy, other]) = (workshop(Limits::default()), accounts(["greedy", "other"]));
        let (ended, end) = mpsc::channel();
        let endless = |ended: mpsc::Sender<()>| {
            move |stop: &Stop| {
                while !stop.flag().load(Ordering::Relaxed) {
                    std::thread::yield_now();
                }
                let _ = ended.send(());
            }
        };
        let asked: Vec<_> = (0..5)
            .map(|_| {
                let (workshop, greedy, work) = (workshop.clone(), greedy.clone(), endless(ended.clone()));
                tokio::spawn(async move { workshop.work(&greedy, work).await })
            })
            .collect();
        while workshop.load().waiting < 4 {
            tokio::task::yield_now().await;
        }
        // One piece is under way, four wait, and the other thread is free.
        for number in 0..10 {
            assert_eq!(workshop.work(&other, move |_| number).await.unwrap(), number);
        }
        assert_eq!(workshop.load().waiting, 4);
        asked.iter().for_each(tokio::task::JoinHandle::abort);
        for asked in asked {
            assert!(asked.await.unwrap_err().is_cancelled());
        }
        // The one that was begun was told to end; the others never began.
        end.recv().unwrap();
        assert_eq!(workshop.load().waiting, 0);
        assert_eq!(workshop.work(&greedy, |_| 7).await.unwrap(), 7);
        assert!(end.try_recv().is_err());
    }

    #[tokio::test]
    async fn what_waits_is_bounded_and_has_a_deadline() {
        let limits = Limits { queued_work: 2, work_s: 0.2, ..Limits::default() };
        let (workshop, [one]) = (workshop(limits), accounts(["one"]));
        let (release, gate) = mpsc::channel::<()>();
        // Deaf to the flag.
        let stuck = workshop.work(&one, move |_| gate.recv().is_err());
        let mut waiting = Box::pin(futures_util::future::join(stuck, workshop.work(&one, |_| ())));
        let is_stuck = || workshop.load().waiting == 1 && !lock(&workshop.0.0.shop).working.is_empty();
        while !is_stuck() {
            let now = std::future::poll_fn(|cx| std::task::Poll::Ready(waiting.as_mut().poll(cx).is_pending()));
            assert!(now.await);
        }
        let mut third = Box::pin(workshop.work(&one, |_| ()));
        let now = std::future::poll_fn(|cx| std::task::Poll::Ready(third.as_mut().poll(cx).is_pending()));
        assert!(now.await);
        let refused = workshop.work(&one, |_| ()).await.unwrap_err();
        assert_eq!(refused.code(), tonic::Code::ResourceExhausted);
        let (stuck, second) = waiting.await;
        assert_eq!(stuck.unwrap_err().code(), tonic::Code::DeadlineExceeded);
        assert_eq!(second.unwrap_err().code(), tonic::Code::DeadlineExceeded);
        drop(third);
        // What is stuck is told of until it ends.
        assert!(workshop.load().is_late && workshop.load().waiting == 0);
        drop(release);
        assert_eq!(workshop.work(&one, |_| 7).await.unwrap(), 7);
    }
}
