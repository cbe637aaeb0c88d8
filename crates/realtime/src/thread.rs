//! A stepping thread (named `step-0` and so on): it owns its sessions, and steps each one when the step is due.
//!
//! Sessions begin at a whole millisecond, so those of one rate are due together. The thread wakes once for all of
//! them, and wakes their readers together: at the end of the round, after 32 readers, or after 0.2 ms
//! (`queue::Wakes`). So the samples of a round leave in few turns of the network threads.
//!
//! A session whose steps take too long for the others moves to a thread of lower priority (`step-apart`), by the
//! rule in `policy.rs`. Requests still go to the thread that the session began on, which passes them on; so
//! requests keep their order.

use std::collections::{BTreeSet, VecDeque};
use std::sync::atomic::Ordering;
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex};

use super::clock::{now_ns, thread_time_ns};
use super::fence::Fence;
use super::frames::Encoder;
use super::inbox::{Inbox, Request};
use super::policy::CallerTurn;
use super::policy::Longest;
use super::queue::Wakes;
use super::reading::{Piece, Reading};
use super::run_queue::RunQueue;
use super::session_task::{SessionTask, ThreadContext};
use palpate_session::local_model::StiffnessJob;
use palpate_tissue::lock::lock;

/// A stepping thread as other threads see it: its inbox, and the new sessions that it has not taken yet.
#[derive(Default)]
pub(super) struct Stepper {
    pub(super) inbox: Arc<Inbox>,
    newcomers: Mutex<Vec<(u64, Box<SessionTask>)>>,
}

impl Stepper {
    /// Hands a new session to the thread. Requests that are sent later are served later.
    pub(super) fn adopt(&self, number: u64, running: Box<SessionTask>) {
        lock(&self.newcomers).push((number, running));
        self.inbox.send(number, Request::Adopt);
    }
}

/// The thread of lower priority for sessions whose steps take too long (`step-apart`).
pub(super) struct Apart {
    pub(super) stepper: Arc<Stepper>,
    /// Index of this thread, as [`SessionHandle::thread`](super::session_handle::SessionHandle) has it.
    pub(super) index: usize,
}

impl Apart {
    /// Moves a session to this thread.
    fn adopt(&self, number: u64, mut running: Box<SessionTask>) {
        tracing::info!(session = %running.handle.id, "steps take too long for other sessions: moved to a thread of lower priority");
        (running.goes_apart, running.inbox) = (false, self.stepper.inbox.clone());
        running.handle.thread.store(self.index, Ordering::Relaxed);
        self.stepper.adopt(number, running);
    }
}

/// Limits of a round: the number of readers that wait to be woken, and its duration, ns.
const MAX_WAKES: usize = 32;
const MAX_ROUND_NS: u64 = 200_000;

/// Interval at which a fenced thread checks whether it may step again, ns.
const FENCED_NS: u64 = 5_000_000;

/// Runs the thread until its inbox is stopped.
pub(super) fn work(
    stepper: &Stepper,
    apart: Option<&Apart>,
    fence: &Fence,
    encoder: &Encoder,
    refiner: &SyncSender<StiffnessJob>,
    reading: &Reading,
) {
    // The default timer slack of 50 µs would be the larger part of each step's lateness. A failure is ignored.
    #[cfg(target_os = "linux")]
    let _ = rustix::thread::set_current_timer_slack(std::num::NonZeroU64::new(1));
    let inbox = &*stepper.inbox;
    let mut run_queue = RunQueue::default();
    let mut requests = VecDeque::new();
    let (wakes, longest) = (Wakes::default(), Longest::default());
    let mut context = ThreadContext { fence, encoder, refiner, reading, wakes, longest };
    let (mut begun_round_ns, mut gone, mut turn) = (0, BTreeSet::new(), CallerTurn::default());
    let part_with = |number, running: Box<SessionTask>, gone: &mut BTreeSet<u64>| match apart {
        Some(apart) if running.goes_apart => {
            gone.insert(number);
            apart.adopt(number, running);
        }
        _ => {
            // Freeing a session's memory takes longer than a step may wait.
            let owner = running.handle.owner.clone();
            reading.post(&owner, Piece::Remains(running));
        }
    };
    loop {
        let now = now_ns();
        // While the server is fenced no session is stepped, however late it is.
        let not_before_ns = if fence.may_act() { 0 } else { now + FENCED_NS };
        let next_ns = run_queue.first().map(|first| first.0.max(not_before_ns));
        let is_round_over = next_ns.is_none_or(|next_ns| next_ns > now) || now > begun_round_ns + MAX_ROUND_NS;
        if is_round_over || context.wakes.len() >= MAX_WAKES {
            context.wakes.wake();
        }
        if let Some(why) = inbox.wait(next_ns, now, &mut requests) {
            context.wakes.wake();
            run_queue.end(&why);
            return;
        }
        // One request at a time while a step is due: answering many must not delay a step.
        while let Some((number, request)) = requests.pop_front() {
            if matches!(request, Request::Adopt) {
                let newcomers = std::mem::take(&mut *lock(&stepper.newcomers));
                newcomers.into_iter().for_each(|(number, running)| run_queue.adopt(number, running));
            } else if let Some(apart) = apart.filter(|_| gone.contains(&number)) {
                if matches!(request, Request::Leave(..)) {
                    gone.remove(&number);
                }
                apart.stepper.inbox.send(number, request);
            } else {
                let left =
                    run_queue.with(number, |running| running.guarded(|running| running.serve(request, &mut context)));
                if let Some(running) = left {
                    part_with(number, running, &mut gone);
                }
            }
            if next_ns.is_some_and(|next_ns| next_ns <= now_ns()) {
                break;
            }
        }
        let begun_ns = now_ns();
        if let Some(number) = run_queue.next(begun_ns, turn.is_over_for(begun_ns))
            && fence.may_act()
        {
            turn.step(run_queue.owner(number).unwrap_or_default(), begun_ns);
            if context.wakes.is_empty() {
                begun_round_ns = begun_ns;
            }
            let (parts, is_alone) = (run_queue.parts(number), run_queue.is_alone());
            let left = run_queue.with(number, |running| {
                let late_ns = running.late_ns(begun_ns);
                let worked_ns = running.watch.measures().then(thread_time_ns);
                running.guarded(|running| running.step(begun_ns, &mut context));
                running.guarded(|running| running.serve_waiting(&mut context));
                let worked_ns = worked_ns.map(|before_ns| thread_time_ns().saturating_sub(before_ns));
                let ended_ns = now_ns();
                let taken_ns = ended_ns.saturating_sub(begun_ns);
                context.longest.observe(ended_ns, taken_ns);
                inbox.tally.lateness.add(late_ns);
                inbox.tally.step_time.add(taken_ns);
                running.queue_again(begun_ns, ended_ns, parts, is_alone);
                let is_too_long = running.watch.is_too_long(taken_ns, worked_ns, running.schedule.period_ns());
                running.goes_apart = is_too_long && !is_alone && apart.is_some();
            });
            if let Some(running) = left {
                part_with(number, running, &mut gone);
            }
        }
    }
}
