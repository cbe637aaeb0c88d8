//! What a journal is told of a session. The stepping thread adds events, and never waits for whoever takes them off; a thread
//! that writes journals takes all that there are at once.
//!
//! A tape that nobody empties is full one day. Then it breaks: what it holds is forgotten, the reason stays, and the session
//! goes on without a journal. When who writes journals says that there is room again, the stepping thread begins anew, with a
//! snapshot: that is another run of the journal.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use tokio::sync::watch;

use super::clock::now_ns;
use super::inbox::Leaving;
use palpate_session::input::{Felt, Input};
use palpate_session::snapshot::Saved;
use palpate_tissue::lock::lock;
use palpate_tissue::{Model, ReadCopy};

/// Events that a tape holds at most: half a minute of a tool at 1 kHz.
const MAX_EVENTS: usize = 1 << 15;

/// Bytes of copies of the tissue that a tape holds at most, beside the first: further ones are left out while the disk is slow.
const MAX_COPIED_BYTES: u64 = 64 << 20;

/// A copy of the tissue is made for a journal so often, s: of its state, to continue from, and to be hashed.
const SNAPSHOT_S: f64 = 10.0;
const HASH_S: f64 = 1.0;

/// Bytes that are copied a second, at most. Of a large tissue copies are made less often than told above.
const COPIED_BYTES_PER_S: f64 = 16e6;

/// Poses and forces of tools are kept so often, Hz.
const FELT_HZ: f64 = 100.0;

/// What is told of a session.
pub enum Event {
    /// Something acts on it.
    Input(Input),
    /// The state, to be hashed.
    Hash(ReadCopy),
    /// Everything that the next step depends on, and the state, to be hashed.
    Snapshot(Box<Saved>, ReadCopy),
    /// What tools feel.
    Felt(Vec<Felt>),
    /// All changes of the tissue that wait for their step, each with that step.
    Waiting(Vec<(u64, Arc<Model>)>),
    /// The session leaves this server: nothing follows.
    Left(Leaving),
}

/// An event, the steps that were done before it, and when it was noted by the clock of stepping.
pub struct Noted {
    /// Steps done.
    pub step: u64,
    /// ns.
    pub at_ns: u64,
    /// The event.
    pub event: Event,
}

/// What is taken off a tape.
pub struct TakenEvents {
    /// In the order in which they happened.
    pub events: Vec<Noted>,
    /// All that happened before this step is in `events`, or was taken before.
    pub until_step: u64,
    /// The session is at rest, or stands: nothing more comes for now.
    pub is_still: bool,
    /// Where the events begin, if they do not go on from what was taken before.
    pub anew: Option<Beginning>,
    /// Nothing is kept any more.
    pub is_broken: bool,
}

/// How a session stands where a journal of it begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Beginning {
    /// Steps done.
    pub step: u64,
    /// Whether time goes on.
    pub running: bool,
    /// The step at which it pauses.
    pub until_step: Option<u64>,
}

#[derive(Default)]
struct HeldEvents {
    anew: Option<Beginning>,
    events: Vec<Noted>,
    copied_bytes: u64,
    until_step: u64,
    is_still: bool,
    /// Whether it waits to be taken.
    is_queued: bool,
    broken: Option<Arc<str>>,
}

/// How far a journal has come.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct JournalProgress {
    /// What happened before this step is durable: on disk, or on two if that is asked for; `None` if nothing is yet.
    pub durable_step: Option<u64>,
    /// What happened before this step is on the disk of this server.
    pub local_step: Option<u64>,
    /// How long ago the newest of that happened when it was on disk, s.
    pub lag_s: f64,
    /// The run of the server that writes; 0 before it has begun.
    pub run: u32,
    /// Why nothing more is written.
    pub broken: Option<Arc<str>>,
    /// What happened before this step is on the disk of the server that stands by too.
    pub mirrored_step: Option<u64>,
    /// Notes that all is on disk, and nothing follows: the session has left.
    pub is_complete: bool,
}

/// The session of a tape, at the tape's beginning.
#[derive(Debug, Clone)]
pub struct About {
    /// The session's ID.
    pub id: String,
    /// Who made it.
    pub owner: String,
    /// Time without use after which it is deleted, s.
    pub idle_timeout_s: f64,
    /// The tissue that it began with, in its first run.
    pub first: Arc<Model>,
    /// Steps done.
    pub begin_step: u64,
    /// Whether time goes on.
    pub running: bool,
    /// The step at which it pauses.
    pub until_step: Option<u64>,
    /// The run of the journal that this one continues; 0 if there is none.
    pub after_run: u64,
    /// [`Begin::revision`](super::Begin).
    pub revision: u64,
}

/// The events of one session, and how far they are on disk.
pub struct EventLog {
    /// Of what it tells.
    pub about: About,
    held: Mutex<HeldEvents>,
    queue: Arc<TapeQueue>,
    /// Only what is mirrored is durable.
    needs_mirror: bool,
    /// It is broken, and there is room again.
    may_begin_anew: AtomicBool,
    /// One more than the durable step, so that 0 is none.
    durable: AtomicU64,
    progress: watch::Sender<JournalProgress>,
}

impl EventLog {
    pub(super) fn new(queue: &Arc<TapeQueue>, about: About) -> Arc<Self> {
        Arc::new(EventLog {
            about,
            held: Mutex::new(HeldEvents::default()),
            queue: queue.clone(),
            needs_mirror: queue.needs_mirror.load(Ordering::Relaxed),
            may_begin_anew: AtomicBool::new(false),
            durable: AtomicU64::new(0),
            progress: watch::Sender::new(JournalProgress::default()),
        })
    }

    /// Returns what happened before this step is on disk.
    pub fn durable_step(&self) -> Option<u64> {
        self.durable.load(Ordering::Acquire).checked_sub(1)
    }

    /// Returns how far it is on disk.
    pub fn progress(&self) -> watch::Receiver<JournalProgress> {
        self.progress.subscribe()
    }

    /// Tells that everything before `step` is on disk since now; the newest of it is `lag_s` old.
    pub fn is_durable(&self, step: u64, lag_s: f64) {
        self.progress.send_modify(|progress| {
            (progress.local_step, progress.lag_s) = (Some(step), lag_s);
            progress.broken = None;
            self.tell_durable(progress);
        });
    }

    /// Tells that everything before `step` is on the disk of the server that stands by.
    pub fn is_mirrored(&self, step: u64) {
        self.progress.send_modify(|progress| {
            progress.mirrored_step = progress.mirrored_step.max(Some(step));
            self.tell_durable(progress);
        });
    }

    fn tell_durable(&self, progress: &mut JournalProgress) {
        let on_two = progress.local_step.min(progress.mirrored_step);
        progress.durable_step = if self.needs_mirror { on_two } else { progress.local_step };
        self.durable.store(progress.durable_step.map_or(0, |step| step + 1), Ordering::Release);
    }

    /// Returns what happened before this step is on the disk of the server that stands by too.
    pub fn mirrored_step(&self) -> Option<u64> {
        self.progress.borrow().mirrored_step
    }

    /// Notes that the step is written here: what happened before this step is on the disk of this server.
    pub fn local_step(&self) -> Option<u64> {
        self.progress.borrow().local_step
    }

    /// Notes that the tape is written in this run of the server.
    pub fn begins(&self, run: u32) {
        self.progress.send_modify(|progress| progress.run = run);
    }

    /// Notes that all is on disk, and nothing follows.
    pub fn is_complete(&self) {
        self.progress.send_modify(|progress| progress.is_complete = true);
    }

    /// Breaks the tape off: nothing more is kept, and nothing more is taken.
    pub fn break_off(&self, reason: &str) {
        let reason: Arc<str> = reason.into();
        {
            let mut held = lock(&self.held);
            if held.broken.is_some() {
                return;
            }
            *held = HeldEvents { broken: Some(reason.clone()), ..HeldEvents::default() };
        }
        self.progress.send_modify(|progress| {
            // Not at every attempt to begin anew.
            if progress.broken.replace(reason.clone()).is_none() {
                tracing::error!(session = %self.about.id, %reason, "the journal of a session is broken");
            }
        });
    }

    /// Notes that there may be room again: the stepping thread begins anew, if it is broken.
    pub fn may_begin_anew(&self) {
        self.may_begin_anew.store(true, Ordering::Release);
    }

    /// Begins anew, if it is broken and may. A snapshot has to follow.
    pub(super) fn begins_anew(&self, beginning: impl FnOnce() -> Beginning) -> bool {
        if !self.may_begin_anew.load(Ordering::Relaxed) || !self.may_begin_anew.swap(false, Ordering::AcqRel) {
            return false;
        }
        let mut held = lock(&self.held);
        let is_broken = held.broken.is_some();
        if is_broken {
            let beginning = beginning();
            *held = HeldEvents { until_step: beginning.step, anew: Some(beginning), ..HeldEvents::default() };
        }
        is_broken
    }

    /// Adds what happened when `step` steps were done.
    pub(super) fn note(self: &Arc<Self>, step: u64, event: Event) {
        let bytes = match &event {
            Event::Hash(copy) => copy.model().state_bytes(),
            Event::Snapshot(_, copy) => 2 * copy.model().state_bytes(),
            _ => 0,
        };
        let noted = Noted { step, at_ns: now_ns(), event };
        let mut held = lock(&self.held);
        if held.broken.is_some() {
            return;
        }
        // A journal is whole without a copy, and tells less often how the tissue was. The first it needs to begin with.
        if bytes > 0 && held.copied_bytes > 0 && held.copied_bytes + bytes > MAX_COPIED_BYTES {
            return;
        }
        if held.events.len() >= MAX_EVENTS {
            drop(held);
            return self.break_off("the disk did not keep up: what waited to be written reached its bound");
        }
        held.copied_bytes += bytes;
        held.events.push(noted);
        self.queue_up(held);
    }

    /// All that happened before `step` has been told. `is_still`: nothing more comes for now.
    pub(super) fn is_told_until(self: &Arc<Self>, step: u64, is_still: bool) {
        let mut held = lock(&self.held);
        let was_still = std::mem::replace(&mut held.is_still, is_still);
        held.until_step = step;
        // What happens next may be far away: what has happened till then must not wait for it.
        if is_still && !was_still {
            self.queue_up(held);
        }
    }

    /// What is told so far is written now, also if nothing has happened but steps.
    pub(super) fn hurry(self: &Arc<Self>) {
        self.queue_up(lock(&self.held));
    }

    fn queue_up(self: &Arc<Self>, mut held: std::sync::MutexGuard<'_, HeldEvents>) {
        if held.broken.is_none() && !std::mem::replace(&mut held.is_queued, true) {
            drop(held);
            self.queue.push(self.clone());
        }
    }

    /// Takes everything off it.
    pub fn take(&self) -> TakenEvents {
        // Room for as many again, made here: the stepping thread only writes into it.
        let room = lock(&self.held).events.len();
        let mut events = Vec::with_capacity(room);
        let mut held = lock(&self.held);
        held.is_queued = false;
        held.copied_bytes = 0;
        std::mem::swap(&mut events, &mut held.events);
        TakenEvents {
            events,
            until_step: held.until_step,
            is_still: held.is_still,
            anew: held.anew.take(),
            is_broken: held.broken.is_some(),
        }
    }
}

/// The tapes that hold something.
#[derive(Default)]
pub struct TapeQueue {
    state: Mutex<Queued>,
    wake: Condvar,
    needs_mirror: AtomicBool,
}

#[derive(Default)]
struct Queued {
    event_logs: Vec<Arc<EventLog>>,
    stop: bool,
}

impl TapeQueue {
    /// Sets that from now on only what is mirrored counts as durable, of new tapes.
    pub fn needs_mirror(&self) {
        self.needs_mirror.store(true, Ordering::Relaxed);
    }

    fn push(&self, event_log: Arc<EventLog>) {
        let mut state = lock(&self.state);
        state.event_logs.push(event_log);
        let is_first = state.event_logs.len() == 1;
        drop(state);
        if is_first {
            self.wake.notify_one();
        }
    }

    /// Waits until a tape holds something, at most for `longest`, and takes all that do. `None` when it is time to stop, and
    /// nothing is left.
    pub fn wait(&self, longest: Option<Duration>) -> Option<Vec<Arc<EventLog>>> {
        let mut state = lock(&self.state);
        let mut waited = false;
        loop {
            if !state.event_logs.is_empty() || (waited && !state.stop) {
                return Some(std::mem::take(&mut state.event_logs));
            }
            if state.stop {
                return None;
            }
            state = match longest {
                None => self.wake.wait(state).unwrap_or_else(PoisonError::into_inner),
                Some(longest) => {
                    let (state, result) =
                        self.wake.wait_timeout(state, longest).unwrap_or_else(PoisonError::into_inner);
                    waited = result.timed_out();
                    state
                }
            };
        }
    }

    /// Takes the tapes that hold something now.
    pub fn take(&self) -> Vec<Arc<EventLog>> {
        std::mem::take(&mut lock(&self.state).event_logs)
    }

    /// Returns whether nothing more comes.
    pub fn is_stopped(&self) -> bool {
        lock(&self.state).stop
    }

    /// Ends the tape: nothing more comes.
    pub fn stop(&self) {
        lock(&self.state).stop = true;
        self.wake.notify_all();
    }
}

/// When a stepping thread tells a tape of the state.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cadence {
    snapshot_steps: u64,
    hash_steps: u64,
    felt_steps: u64,
    next_snapshot: u64,
}

impl Cadence {
    /// Of a session of `model` that has done `step` steps.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(super) fn new(model: &Model, step: u64) -> Self {
        let rate_hz = model.scene.stepping.rate_hz;
        let copy_s = model.state_bytes() as f64 / COPIED_BYTES_PER_S;
        let steps = |least_s: f64| (rate_hz * least_s).ceil().max(1.0) as u64;
        let snapshot_steps = steps(SNAPSHOT_S.max(2.0 * copy_s));
        Cadence {
            snapshot_steps,
            hash_steps: steps(HASH_S.max(2.0 * copy_s)),
            felt_steps: (rate_hz / FELT_HZ).max(1.0) as u64,
            next_snapshot: step,
        }
    }

    /// Whether a snapshot is due at `step`; `is_new_rest`: the tissue has come to rest there.
    pub(super) fn wants_snapshot(&mut self, step: u64, is_new_rest: bool) -> bool {
        let least = self.next_snapshot.saturating_sub(self.snapshot_steps) + self.hash_steps;
        let is_due = step >= self.next_snapshot || (is_new_rest && step >= least);
        if is_due {
            self.next_snapshot = step + self.snapshot_steps;
        }
        is_due
    }

    /// Whether a hash is due at `step`.
    pub(super) fn wants_hash(&self, step: u64) -> bool {
        step.is_multiple_of(self.hash_steps)
    }

    /// Whether poses and forces are kept at `step`.
    pub(super) fn wants_felt(&self, step: u64) -> bool {
        step.is_multiple_of(self.felt_steps)
    }
}
