//! A stepping thread's queue of requests. The thread sleeps here until a request arrives or a step is due.

use std::collections::VecDeque;
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use tokio::sync::oneshot;

use super::clock::now_ns;
use super::frames::Viewer;
use super::reading::HashReply;
use super::subscribers::{ProbeTap, SampleTap};
use super::thread_counters::ThreadCounters;
use palpate_refusal::{Refusal, Result};
use palpate_session::budget::Account;
use palpate_session::measured_run::EndedExercise;
use palpate_session::snapshot::Saved;
use palpate_tissue::ReadCopy;
use palpate_tissue::lock::lock;
use palpate_tissue::select::audit::{Mark, WindowInputs};

/// The present state of a session, from which another can continue
/// ([`SessionHandle::save`](super::SessionHandle::save)). It has no leases and no waiting commands.
pub struct Present {
    /// Everything that the next step depends on, without a running audit.
    pub saved: Box<Saved>,
    /// A copy of the state, to be hashed.
    pub copy: ReadCopy,
    /// Whether the session's time advances.
    pub running: bool,
    /// The step count at which the session pauses; `None` if it has no such end.
    pub until_step: Option<u64>,
}

/// Why a session leaves its server; its journal records it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Leaving {
    /// The session is deleted.
    Deleted,
    /// Another server has become its owner. A last snapshot is recorded.
    Moved,
    /// The session was being handed to this server, and the handover was cancelled.
    Withdrawn,
}

/// A request to a session or its stepping thread.
pub(super) enum Request {
    /// New sessions wait for the thread.
    Adopt,
    Start {
        until: Option<u64>,
        reply: oneshot::Sender<Result<u64>>,
    },
    Revive {
        reply: oneshot::Sender<Result<u64>>,
    },
    Pause {
        reply: oneshot::Sender<Result<()>>,
    },
    /// A command or a change has arrived for a session at rest.
    Wake,
    Samples(Box<SampleTap>),
    Probe(ProbeTap),
    View(Arc<Viewer>),
    /// A copy of the session as it is.
    Save(oneshot::Sender<Result<Present>>),
    /// A copy of the session as it is; then no step until [`Request::Thaw`].
    Freeze(oneshot::Sender<Result<Present>>),
    Thaw,
    /// Ends every stream; the session stays.
    Silence(Refusal),
    /// Asks for the audit of a window of steps.
    Audit(WindowInputs, SyncSender<Mark>),
    Hash {
        at: Option<u64>,
        /// The caller that is charged for it.
        account: Account,
        reply: HashReply,
    },
    /// Ends the session's exercise now.
    FinishExercise,
    /// Ends this phase of the session's exercise now, from 1, unless it has ended or has not begun.
    FinishPhase(u32),
    /// The result of the session's exercise is known.
    ExerciseEnded(Arc<EndedExercise>),
    /// Removes the session from this server: it is deleted, or has another owner.
    Leave(Refusal, Leaving),
    /// Moves the session to the thread of lower priority.
    #[cfg(test)]
    GoApart,
    /// Causes a fault of the program.
    #[cfg(test)]
    Panic,
}

/// The system's tick on Windows, ns.
#[cfg(windows)]
const TICK_NS: u64 = 15_625_000;

/// Inbox of a stepping thread.
#[derive(Default)]
pub(super) struct Inbox {
    state: Mutex<InboxState>,
    wake: Condvar,
    /// Written only by the thread that reads this inbox.
    pub(super) tally: ThreadCounters,
}

#[derive(Default)]
struct InboxState {
    requests: Vec<(u64, Request)>,
    stop: Option<Refusal>,
}

impl Inbox {
    pub(super) fn send(&self, session: u64, request: Request) {
        let mut state = lock(&self.state);
        if state.stop.is_none() {
            state.requests.push((session, request));
        }
        drop(state);
        self.wake.notify_one();
    }

    pub(super) fn stop(&self, why: Refusal) {
        let mut state = lock(&self.state);
        state.stop = Some(why);
        state.requests.clear();
        drop(state);
        self.wake.notify_one();
    }

    /// Waits until `deadline_ns` or until a request arrives, and appends all requests to `requests`. Returns the
    /// reason to stop, if the thread is to stop.
    pub(super) fn wait(
        &self,
        deadline_ns: Option<u64>,
        mut now: u64,
        requests: &mut VecDeque<(u64, Request)>,
    ) -> Option<Refusal> {
        let mut state = lock(&self.state);
        loop {
            requests.extend(state.requests.drain(..));
            if !requests.is_empty() || state.stop.is_some() {
                return state.stop.clone();
            }
            state = match deadline_ns {
                None => self.wake.wait(state).unwrap_or_else(PoisonError::into_inner),
                Some(deadline_ns) => {
                    let rest_ns = deadline_ns.saturating_sub(now);
                    if rest_ns == 0 {
                        return None;
                    }
                    // On Windows a condition variable wakes with the system's tick, every 15.6 ms. The sleep of a
                    // thread is exact; a request then waits for the end of the sleep, when its step is due anyway.
                    #[cfg(windows)]
                    if rest_ns < 2 * TICK_NS {
                        drop(state);
                        std::thread::sleep(Duration::from_nanos(rest_ns.min(TICK_NS / 16)));
                        now = now_ns();
                        state = lock(&self.state);
                        continue;
                    }
                    #[cfg(windows)]
                    let rest_ns = rest_ns - 2 * TICK_NS;
                    let waited = self.wake.wait_timeout(state, Duration::from_nanos(rest_ns));
                    now = now_ns();
                    waited.unwrap_or_else(PoisonError::into_inner).0
                }
            };
        }
    }
}
