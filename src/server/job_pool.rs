//! Threads of low priority for heavy work that a call waits for: scenes, force laws, textures. Callers take turns,
//! and each has at most one job running. A caller with many jobs therefore delays only itself, as long as there are
//! fewer such callers than threads; beyond that, others wait for at most one job. A job that no call waits for any
//! longer is not started, or is cancelled if it runs.
//!
//! Jobs are limited by counted work, not by time, so that one request has one result on every machine:
//! `limits.rehearsal_work` (points × substeps of the rehearsals that choose a scene's stepping), `limits.law_work`
//! (springs × iterations of a force law), `limits.press_work` (points × substeps of presses), `limits.mesh_work` (operations on a
//! mesh, whose triangles may come from a stranger). A scene that needs more is refused, never stepped less accurately; offline programs allow 32 times as
//! much.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use palpate_geometry::work::{self, GivenUp};
use tokio::sync::oneshot;
use tonic::Status;

use palpate_realtime::clock::now_ns;
use palpate_realtime::priority::{give_way, thread};
use palpate_refusal::{Reason, Refusal};
use palpate_session::budget::{Account, Turns};
use palpate_tissue::limits::Limits;
use palpate_tissue::lock::lock;
use palpate_tissue::select::scheme_selection::given_up;

/// Number of threads of a job pool.
const THREADS: usize = 2;

/// The order of one caller's jobs; jobs of one kind run in the order of their requests. Many laws thus delay no call
/// that somebody waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Urgency {
    /// Work that a call needs.
    Call,
    /// A force law that a haptic stream starts with, or that its tool needs.
    Law,
    /// A more accurate law than the one in use.
    BetterLaw,
}

/// A flag that tells a job to stop, because its call does not wait for it any longer.
#[derive(Debug, Clone, Default)]
pub(crate) struct CancelFlag(Arc<AtomicBool>);

impl CancelFlag {
    /// Returns the flag, which is set when the call does not wait any longer.
    pub(crate) fn flag(&self) -> &AtomicBool {
        &self.0
    }
}

struct Job {
    number: u64,
    requested_ns: u64,
    urgency: Urgency,
    run: Box<dyn FnOnce() + Send>,
}

#[derive(Default)]
struct PoolState {
    waiting: Turns<Job>,
    /// The running jobs: the account's number, and the time at which the job was requested, ns.
    running: Vec<(u64, u64)>,
    next_number: u64,
    is_closed: bool,
}

/// Returns whether one of the `running` jobs belongs to `account`.
fn is_running(running: &[(u64, u64)], account: u64) -> bool {
    running.iter().any(|job| job.0 == account)
}

impl PoolState {
    /// Takes the first job of the next account without a running job and counts it as running. Returns the account's
    /// number and the job.
    fn start_next(&mut self) -> Option<(u64, Job)> {
        let (account, job) = self.waiting.next(|account| !is_running(&self.running, account))?;
        self.running.push((account, job.requested_ns));
        Some((account, job))
    }

    /// Returns whether another job may start.
    fn may_start(&self) -> bool {
        self.waiting.accounts().any(|account| !is_running(&self.running, account))
    }

    /// Removes the running job of `account` from the list.
    fn end(&mut self, account: u64) {
        if let Some(done) = self.running.iter().position(|running| running.0 == account) {
            self.running.swap_remove(done);
        }
    }
}

struct PoolShared {
    queue: Mutex<PoolState>,
    changed: Condvar,
    deadline: Duration,
    most_waiting: usize,
    most_operations: u64,
}

impl PoolShared {
    /// Runs jobs until the job pool is closed and no job is left to start.
    fn work(&self) {
        let mut done = None;
        while let Some((account, job)) = self.next(done) {
            (job.run)();
            done = Some(account);
        }
    }

    /// Marks the job of the account `done` as ended, waits for the next job that may start, and takes it. A thread of
    /// low priority may be stopped for tens of milliseconds anywhere, also while it holds the lock that calls wait
    /// for. So it holds the lock once per job, as briefly as possible, and wakes others without it.
    fn next(&self, done: Option<u64>) -> Option<(u64, Job)> {
        let mut queue = lock(&self.queue);
        if let Some(account) = done {
            queue.end(account);
        }
        let next = loop {
            if let Some(next) = queue.start_next() {
                break next;
            }
            if queue.is_closed {
                return None;
            }
            queue = self.changed.wait(queue).unwrap_or_else(PoisonError::into_inner);
        };
        let is_more = queue.may_start();
        drop(queue);
        if is_more {
            self.changed.notify_one();
        }
        Some(next)
    }
}

/// Closes the job pool when it is dropped, with the last clone; its threads then end.
struct CloseOnDrop(Arc<PoolShared>);

impl Drop for CloseOnDrop {
    fn drop(&mut self) {
        lock(&self.0.queue).is_closed = true;
        self.0.changed.notify_all();
    }
}

/// A call's wait for its job. Dropping it cancels the job: removes it from the queue, or sets its flag.
struct CancelOnDrop {
    shared: Arc<PoolShared>,
    account: u64,
    number: u64,
    cancelled: CancelFlag,
    /// Whether the job has left the queue.
    is_started: Arc<AtomicBool>,
}

impl Drop for CancelOnDrop {
    fn drop(&mut self) {
        self.cancelled.0.store(true, Ordering::Relaxed);
        if !self.is_started.load(Ordering::Relaxed) {
            lock(&self.shared.queue).waiting.retain(self.account, |job| job.number != self.number);
        }
    }
}

/// The load of a job pool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Load {
    /// Number of jobs that wait for their turn.
    pub(crate) waiting: usize,
    /// Age of the oldest waiting or running job since its request; 0 if there is none, s.
    pub(crate) oldest_s: f64,
    /// Whether the oldest job is past its deadline.
    pub(crate) is_late: bool,
}

/// A pool of threads for heavy work. They end with the last clone.
#[derive(Clone)]
pub(crate) struct JobPool(Arc<CloseOnDrop>);

impl JobPool {
    /// Starts the threads, named `name` and a number.
    ///
    /// # Errors
    /// Returns the system's error if a thread can't be started.
    pub(crate) fn open(name: &str, limits: &Limits) -> std::io::Result<Self> {
        let deadline = Duration::from_secs_f64(limits.work_s);
        let (queue, changed) = (Mutex::default(), Condvar::new());
        let (most_waiting, most_operations) = (limits.queued_work, limits.mesh_work);
        let shared = Arc::new(PoolShared { queue, changed, deadline, most_waiting, most_operations });
        let close = Arc::new(CloseOnDrop(shared.clone()));
        for index in 0..THREADS {
            let shared = shared.clone();
            thread(format!("{name}-{index}")).spawn(move || {
                give_way();
                shared.work();
            })?;
        }
        Ok(JobPool(close))
    }

    /// Runs `work` when it is the turn of `account`, and returns its result. If the call ends or the deadline passes
    /// before that, `work` never runs; if that happens while `work` runs, its flag is set.
    ///
    /// # Errors
    /// Returns an error if too many jobs of this account wait, if the deadline passes, if `work` takes too many
    /// operations, or if it panics.
    pub(crate) async fn work<T: Send + 'static>(
        &self,
        account: &Account,
        work: impl FnOnce(&CancelFlag) -> T + Send + 'static,
    ) -> Result<T, Status> {
        self.work_as(Urgency::Call, account, work).await
    }

    /// Runs `work` in the pool like [`JobPool::work`], but after the more urgent jobs of this account.
    ///
    /// # Errors
    /// Returns the errors of [`JobPool::work`].
    pub(crate) async fn work_as<T: Send + 'static>(
        &self,
        urgency: Urgency,
        account: &Account,
        work: impl FnOnce(&CancelFlag) -> T + Send + 'static,
    ) -> Result<T, Status> {
        let (done, result) = oneshot::channel();
        let cancelled = CancelFlag::default();
        let (flag, most) = (cancelled.clone(), self.0.0.most_operations);
        let is_started = Arc::new(AtomicBool::new(false));
        let starts = is_started.clone();
        let run = move || {
            starts.store(true, Ordering::Relaxed);
            if let Ok(answer) = catch_unwind(AssertUnwindSafe(|| work::within(&flag.0, most, || work(&flag)))) {
                let _ = done.send(answer);
            }
        };
        let _waiting = self.enqueue(account.number(), urgency, cancelled, is_started, Box::new(run))?;
        match tokio::time::timeout(self.0.0.deadline, result).await {
            Ok(Ok(Ok(answer))) => Ok(answer),
            Ok(Ok(Err(GivenUp::TooMuch(most)))) => {
                let message = format!("would take more than {most} operations on its mesh (limits.mesh_work)");
                Err(Refusal::new(Reason::TooLarge, "", message).into())
            }
            // Nobody waits for the result any longer.
            Ok(Ok(Err(GivenUp::Stopped))) => Err(given_up().into()),
            Ok(Err(_)) => Err(Status::internal("internal error (worker panicked)")),
            Err(_) => {
                let message =
                    format!("the work took longer than {} s (limits.work_s)", self.0.0.deadline.as_secs_f64());
                Err(Refusal::new(Reason::TimedOut, "", message).into())
            }
        }
    }

    fn enqueue(
        &self,
        account: u64,
        urgency: Urgency,
        cancelled: CancelFlag,
        is_started: Arc<AtomicBool>,
        run: Box<dyn FnOnce() + Send>,
    ) -> Result<CancelOnDrop, Refusal> {
        let shared = &self.0.0;
        let mut queue = lock(&shared.queue);
        let number = queue.next_number;
        queue.next_number += 1;
        let job = Job { number, requested_ns: now_ns(), urgency, run };
        let waiting = queue.waiting.count(account);
        if waiting >= shared.most_waiting {
            let message = format!("this caller has {waiting} jobs waiting already (limits.queued_work)");
            return Err(Refusal::new(Reason::Overloaded, "", message));
        }
        queue.waiting.push_before(account, job, |other| other.urgency > urgency);
        drop(queue);
        shared.changed.notify_one();
        Ok(CancelOnDrop { shared: shared.clone(), account, number, cancelled, is_started })
    }

    /// Returns the load of the job pool.
    pub(crate) fn load(&self) -> Load {
        let queue = lock(&self.0.0.queue);
        let running = queue.running.iter().map(|running| running.1);
        let requested_ns = queue.waiting.iter().map(|job| job.requested_ns).chain(running).min();
        let age = |requested_ns| Duration::from_nanos(now_ns().saturating_sub(requested_ns));
        let oldest = requested_ns.map_or(Duration::ZERO, age);
        let waiting = queue.waiting.iter().count();
        Load { waiting, oldest_s: oldest.as_secs_f64(), is_late: oldest > self.0.0.deadline }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_session::budget::Budget;
    use std::sync::mpsc;

    fn job_pool(limits: Limits) -> JobPool {
        JobPool::open("test", &limits).unwrap()
    }

    fn accounts<const N: usize>(names: [&str; N]) -> [Account; N] {
        let budget = Budget::new(&Limits::default(), 1, 1);
        names.map(|name| budget.account(name))
    }

    #[tokio::test]
    async fn jobs_of_one_caller_run_in_order_even_after_a_panic() {
        let (job_pool, [one]) = (job_pool(Limits::default()), accounts(["one"]));
        let faulty = job_pool.work(&one, |_| -> u32 { panic!("a test") }).await;
        assert_eq!(faulty.unwrap_err().code(), tonic::Code::Internal);
        let order = Arc::new(Mutex::new(Vec::new()));
        let all = (0..20).map(|number| {
            let order = order.clone();
            job_pool.work(&one, move |_| lock(&order).push(number))
        });
        futures_util::future::join_all(all).await;
        assert_eq!(*lock(&order), (0..20).collect::<Vec<_>>());
        let load = job_pool.load();
        assert!(load.waiting == 0 && !load.is_late, "{load:?}");
    }

    #[tokio::test]
    async fn two_hundred_laws_of_a_caller_delay_its_own_call_by_the_one_that_runs() {
        let (job_pool, [one]) = (job_pool(Limits::default()), accounts(["one"]));
        let (release, gate) = mpsc::channel::<()>();
        let order = Arc::new(Mutex::new(Vec::new()));
        let work = |urgency: Urgency| {
            let (job_pool, one, order) = (job_pool.clone(), one.clone(), order.clone());
            async move { job_pool.work_as(urgency, &one, move |_| lock(&order).push(urgency)).await }
        };
        let running = tokio::spawn({
            let (job_pool, one) = (job_pool.clone(), one.clone());
            async move { job_pool.work_as(Urgency::Law, &one, move |_| gate.recv().is_err()).await }
        });
        while lock(&job_pool.0.0.queue).running.is_empty() {
            tokio::task::yield_now().await;
        }
        let laws: Vec<_> = (0..200)
            .map(|law| tokio::spawn(work(if law % 2 == 0 { Urgency::BetterLaw } else { Urgency::Law })))
            .collect();
        while job_pool.load().waiting < 200 {
            tokio::task::yield_now().await;
        }
        let call = tokio::spawn(work(Urgency::Call));
        while job_pool.load().waiting < 201 {
            tokio::task::yield_now().await;
        }
        drop(release);
        call.await.unwrap().unwrap();
        assert!(running.await.unwrap().unwrap());
        for law in laws {
            law.await.unwrap().unwrap();
        }
        let order = lock(&order);
        assert!(order[0] == Urgency::Call && order.is_sorted(), "{order:?}");
    }

    #[tokio::test]
    async fn one_callers_endless_jobs_do_not_stop_anothers_and_end_when_they_are_cancelled() {
        let (job_pool, [greedy, other]) = (job_pool(Limits::default()), accounts(["greedy", "other"]));
        let (ended, end) = mpsc::channel();
        let endless = |ended: mpsc::Sender<()>| {
            move |stop: &CancelFlag| {
                while !stop.flag().load(Ordering::Relaxed) {
                    std::thread::yield_now();
                }
                let _ = ended.send(());
            }
        };
        let asked: Vec<_> = (0..5)
            .map(|_| {
                let (job_pool, greedy, work) = (job_pool.clone(), greedy.clone(), endless(ended.clone()));
                tokio::spawn(async move { job_pool.work(&greedy, work).await })
            })
            .collect();
        while job_pool.load().waiting < 4 {
            tokio::task::yield_now().await;
        }
        // One job runs, four wait, and the other thread is free.
        for number in 0..10 {
            assert_eq!(job_pool.work(&other, move |_| number).await.unwrap(), number);
        }
        assert_eq!(job_pool.load().waiting, 4);
        // The waiting jobs are cancelled first: the end of the running job would start the next.
        for asked in asked.into_iter().rev() {
            asked.abort();
            assert!(asked.await.unwrap_err().is_cancelled());
        }
        // The running job was cancelled; the others never started.
        end.recv().unwrap();
        assert_eq!(job_pool.load().waiting, 0);
        assert_eq!(job_pool.work(&greedy, |_| 7).await.unwrap(), 7);
        assert!(end.try_recv().is_err());
    }

    #[tokio::test]
    async fn a_job_of_many_operations_ends_when_its_call_does_and_when_it_takes_too_many() {
        let [one, other] = accounts(["one", "other"]);
        let strict = job_pool(Limits { mesh_work: 1000, ..Limits::default() });
        let refused = strict.work(&one, |_| (0..2000).for_each(|_| work::spend(1))).await.unwrap_err();
        assert_eq!(refused.code(), tonic::Code::ResourceExhausted);
        assert!(refused.message().contains("more than 1000 operations"), "{refused}");
        let job_pool = job_pool(Limits { mesh_work: u64::MAX, ..Limits::default() });
        let (begun, begin) = mpsc::channel();
        let endless = move |_: &CancelFlag| {
            let _ = begun.send(());
            // It looks at no flag of its own.
            loop {
                work::spend(1);
            }
        };
        let asked = tokio::spawn({
            let (job_pool, one) = (job_pool.clone(), one.clone());
            async move { job_pool.work::<()>(&one, endless).await }
        });
        while begin.try_recv().is_err() {
            tokio::task::yield_now().await;
        }
        assert_eq!(job_pool.work(&other, |_| 7).await.unwrap(), 7);
        asked.abort();
        assert!(asked.await.unwrap_err().is_cancelled());
        assert_eq!(job_pool.work(&one, |_| 7).await.unwrap(), 7);
    }

    #[tokio::test]
    async fn what_waits_is_bounded_and_has_a_deadline() {
        let limits = Limits { queued_work: 2, work_s: 0.2, ..Limits::default() };
        let (job_pool, [one]) = (job_pool(limits), accounts(["one"]));
        let (release, gate) = mpsc::channel::<()>();
        // A job that ignores the flag.
        let stuck = job_pool.work(&one, move |_| gate.recv().is_err());
        let mut waiting = Box::pin(futures_util::future::join(stuck, job_pool.work(&one, |_| ())));
        let is_stuck = || job_pool.load().waiting == 1 && !lock(&job_pool.0.0.queue).running.is_empty();
        while !is_stuck() {
            let now = std::future::poll_fn(|cx| std::task::Poll::Ready(waiting.as_mut().poll(cx).is_pending()));
            assert!(now.await);
        }
        let mut third = Box::pin(job_pool.work(&one, |_| ()));
        let now = std::future::poll_fn(|cx| std::task::Poll::Ready(third.as_mut().poll(cx).is_pending()));
        assert!(now.await);
        let refused = job_pool.work(&one, |_| ()).await.unwrap_err();
        assert_eq!(refused.code(), tonic::Code::ResourceExhausted);
        let (stuck, second) = waiting.await;
        assert_eq!(stuck.unwrap_err().code(), tonic::Code::DeadlineExceeded);
        assert_eq!(second.unwrap_err().code(), tonic::Code::DeadlineExceeded);
        drop(third);
        // The stuck job counts until it ends.
        assert!(job_pool.load().is_late && job_pool.load().waiting == 0);
        drop(release);
        assert_eq!(job_pool.work(&one, |_| 7).await.unwrap(), 7);
    }
}
