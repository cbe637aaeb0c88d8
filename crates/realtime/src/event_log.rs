//! The event log of a session: what its journal records. The stepping thread adds events and never waits for the
//! reader; the thread that writes journals takes all events at once.
//!
//! An event log is bounded. If the writer of journals does not keep up or can't write, the log breaks: it discards
//! its events, keeps the reason, and the session continues without a journal. If the disk was full or too slow and
//! the writer reports that there is room again, the stepping thread restarts the log with a snapshot; that begins
//! another run of the journal.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::watch;

use super::clock::now_ns;
use super::inbox::Leaving;
use palpate_session::chosen_exercise::ChosenExercise;
use palpate_session::input::{Felt, Input};
use palpate_session::snapshot::Saved;
use palpate_tissue::lock::lock;
use palpate_tissue::{Model, ReadCopy};

/// Limit of events that an event log holds: half a minute of a tool at 1 kHz.
const MAX_EVENTS: usize = 1 << 15;

/// The reason of a break because events arrive faster than the disk takes them.
const OVERFLOW: &str = "the disk is too slow: the number of events that wait for it reached the limit";

/// Limit of bytes of tissue copies that an event log holds, beside the first copy. Further copies are left out
/// while the disk is slow.
const MAX_COPIED_BYTES: u64 = 64 << 20;

/// Intervals between copies of the tissue for a journal, s: snapshots, from which a session can continue, and
/// hashes.
const SNAPSHOT_S: f64 = 10.0;
const HASH_S: f64 = 1.0;

/// Limit of the bytes copied per second. A large tissue is copied less often than the intervals above say.
const COPIED_BYTES_PER_S: f64 = 16e6;

/// Rate at which the poses and forces of tools are recorded, Hz.
const FELT_HZ: f64 = 100.0;

/// An event of a session that its journal records. Copies of the state are made on the stepping thread; hashes are
/// computed by the writer of journals.
pub enum Event {
    /// An input acted on the session, before the next step.
    Input(Input),
    /// A copy of the state, to be hashed; about once a second of simulated time.
    Hash(ReadCopy),
    /// Everything that the next step depends on, and a copy of the state, to be hashed; about every 10 s, and at the
    /// beginning.
    Snapshot(Box<Saved>, ReadCopy),
    /// Poses of the tools, and the forces on them; at most 100 times a second.
    Felt(Vec<Felt>),
    /// All changes of the tissue that wait for their step, each with that step. The list replaces the previous one.
    Waiting(Vec<(u64, Arc<Model>)>),
    /// The session has left this server: no event follows.
    Left(Leaving),
}

/// An event with its step and time, as an event log holds it.
pub struct Noted {
    /// Number of steps done before the event.
    pub step: u64,
    /// Time at which the event was added, ns of the clock of stepping ([`now_ns`](super::clock::now_ns)).
    pub at_ns: u64,
    /// The event.
    pub event: Event,
}

/// The content of an event log, as [`EventLog::take`] returns it to the writer of journals.
pub struct TakenEvents {
    /// Events in the order in which they happened; empty if only steps were done.
    pub events: Vec<Noted>,
    /// All events before this step are in `events`, or were taken earlier: the journal may be complete up to it.
    pub until_step: u64,
    /// Whether the session is at rest or paused, so that no event follows for now.
    pub is_still: bool,
    /// Where the events begin, if the log was restarted since the last call, so that they do not follow on what was
    /// taken earlier; otherwise `None`.
    pub anew: Option<Beginning>,
    /// Whether the log is broken: it keeps no events until it is restarted.
    pub is_broken: bool,
    /// Whether the log broke since it was last taken because it held 32,768 events.
    pub has_overflowed: bool,
}

/// State of a session at the beginning of its journal or of a further run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Beginning {
    /// Number of steps done when it begins.
    pub step: u64,
    /// Whether the session's time advances.
    pub running: bool,
    /// The step count at which the session pauses, if any.
    pub until_step: Option<u64>,
}

#[derive(Default)]
struct HeldEvents {
    anew: Option<Beginning>,
    events: Vec<Noted>,
    copied_bytes: u64,
    until_step: u64,
    is_still: bool,
    /// Whether the log waits in the queue to be taken.
    is_queued: bool,
    broken: Option<Arc<str>>,
    has_overflowed: bool,
}

/// Progress of a journal: which steps are on disk. Steps are numbers of steps done.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct JournalProgress {
    /// Everything before this step is durable: on disk, or on the disks of two servers if that is required. `None`
    /// before anything is.
    pub durable_step: Option<u64>,
    /// Everything before this step is on the disk of this server; `None` before anything is.
    pub local_step: Option<u64>,
    /// Age of the newest written event when it reached the disk of this server, s; 0 before any.
    pub lag_s: f64,
    /// Number of the run that is being written; 0 before it has begun.
    pub run: u32,
    /// Why no more events are written; `None` while the journal works. It stays after a restart until something is on
    /// disk again.
    pub broken: Option<Arc<str>>,
    /// Everything before this step is on the disk of the standby server; `None` before anything is.
    pub mirrored_step: Option<u64>,
    /// Whether everything is on disk and no event follows, because the session has left.
    pub is_complete: bool,
}

/// Description of the session that an event log belongs to, at the beginning of the log: the journal's header is made
/// from it.
#[derive(Debug, Clone)]
pub struct About {
    /// The session's ID.
    pub id: String,
    /// Name of the account that created the session.
    pub owner: String,
    /// Time without use after which the session is deleted, s.
    pub idle_timeout_s: f64,
    /// The first tissue of the session, in its first run.
    pub first: Arc<Model>,
    /// Number of steps done when the log began.
    pub begin_step: u64,
    /// Whether the session's time advances.
    pub running: bool,
    /// The step count at which the session pauses, if any.
    pub until_step: Option<u64>,
    /// Number of the run that this one continues; 0 if there is none.
    pub after_run: u64,
    /// Revision of the session's key in etcd at which this server became its owner; 0 without a fleet.
    pub revision: u64,
    /// The exercise that the session is made for, with the ID that opens the session for a trainee; `None` for any other session.
    pub exercise: Option<(ChosenExercise, String)>,
}

/// Event log of one session: the events that its journal does not have yet, and which steps are on disk. The stepping
/// thread adds events; the writer of journals takes them and reports progress.
pub struct EventLog {
    /// The session that the log belongs to, as it was when the log began.
    pub about: About,
    held: Mutex<HeldEvents>,
    queue: Arc<EventLogQueue>,
    /// Whether only mirrored events are durable.
    needs_mirror: bool,
    /// Whether a broken log may restart because there is room again.
    may_begin_anew: AtomicBool,
    /// The durable step plus one, so that 0 stands for none.
    durable: AtomicU64,
    progress: watch::Sender<JournalProgress>,
}

impl EventLog {
    pub(super) fn new(queue: &Arc<EventLogQueue>, about: About) -> Arc<Self> {
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

    /// Returns the step before which everything is durable: on the disk of this server and, if that is required, of
    /// the standby; `None` before anything is.
    pub fn durable_step(&self) -> Option<u64> {
        self.durable.load(Ordering::Acquire).checked_sub(1)
    }

    /// Returns a receiver of the journal's progress, which has the present value.
    pub fn progress(&self) -> watch::Receiver<JournalProgress> {
        self.progress.subscribe()
    }

    /// Sets that everything before `step` is on the disk of this server, and clears the reason of an earlier break
    /// unless the log is broken now. `lag_s` is the age of the newest of it, s. A lower `step` than before counts
    /// too.
    pub fn set_durable(&self, step: u64, lag_s: f64) {
        self.progress.send_modify(|progress| {
            (progress.local_step, progress.lag_s) = (Some(step), lag_s);
            // The log may have overflowed while the disk was busy.
            if lock(&self.held).broken.is_none() {
                progress.broken = None;
            }
            self.tell_durable(progress);
        });
    }

    /// Sets that everything before `step` is on the disk of the standby server. A lower step than before is
    /// ignored.
    pub fn set_mirrored(&self, step: u64) {
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

    /// Returns the step before which everything is on the disk of the standby server; `None` before anything is.
    pub fn mirrored_step(&self) -> Option<u64> {
        self.progress.borrow().mirrored_step
    }

    /// Returns the step before which everything is on the disk of this server; `None` before anything is.
    pub fn local_step(&self) -> Option<u64> {
        self.progress.borrow().local_step
    }

    /// Sets the number of the run in which the log is written from now on.
    pub fn begins(&self, run: u32) {
        self.progress.send_modify(|progress| progress.run = run);
    }

    /// Marks the journal as complete: everything is on disk, and no event follows.
    pub fn set_complete(&self) {
        self.progress.send_modify(|progress| progress.is_complete = true);
    }

    /// Breaks the log: discards its events, ignores further ones, and logs `reason` unless an earlier break is still
    /// reported. A log that is broken already keeps its reason. The session continues.
    pub fn break_off(&self, reason: &str) {
        self.break_held(lock(&self.held), reason, false);
    }

    fn break_held(&self, mut held: MutexGuard<'_, HeldEvents>, reason: &str, has_overflowed: bool) {
        if held.broken.is_some() {
            return;
        }
        let reason: Arc<str> = reason.into();
        *held = HeldEvents { broken: Some(reason.clone()), has_overflowed, ..HeldEvents::default() };
        drop(held);
        self.progress.send_modify(|progress| {
            // Logged once, and not at every attempt to restart.
            if progress.broken.replace(reason.clone()).is_none() {
                tracing::error!(session = %self.about.id, %reason, "the journal of a session is broken");
            }
        });
    }

    /// Lets a broken log restart, because there may be room again. The stepping thread restarts it after the next
    /// step, with a snapshot. For a log that works it has no effect.
    pub fn may_begin_anew(&self) {
        self.may_begin_anew.store(true, Ordering::Release);
    }

    /// Restarts the log if it is broken and may restart. Returns whether it did: then the caller must add a
    /// snapshot.
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

    /// Adds an event of the moment at which `step` steps are done. A broken log ignores it; a log that already
    /// holds 32,768 events breaks.
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
        // The journal is complete without a copy; it only records the state less often. It needs the first copy to
        // begin with.
        if bytes > 0 && held.copied_bytes > 0 && held.copied_bytes + bytes > MAX_COPIED_BYTES {
            return;
        }
        if held.events.len() >= MAX_EVENTS {
            self.break_held(held, OVERFLOW, true);
            // The writer of journals must learn of it, to restart the log.
            return self.queue.push(self.clone());
        }
        held.copied_bytes += bytes;
        held.events.push(noted);
        self.queue_up(held);
    }

    /// Sets that all events before `step` have been added. `is_still`: no event follows for now.
    pub(super) fn set_until(self: &Arc<Self>, step: u64, is_still: bool) {
        let mut held = lock(&self.held);
        let was_still = std::mem::replace(&mut held.is_still, is_still);
        held.until_step = step;
        // The next event may be far away: the events until now must not wait for it.
        if is_still && !was_still {
            self.queue_up(held);
        }
    }

    /// Queues the log to be written now, even if it holds no event but only steps.
    pub(super) fn hurry(self: &Arc<Self>) {
        self.queue_up(lock(&self.held));
    }

    fn queue_up(self: &Arc<Self>, mut held: MutexGuard<'_, HeldEvents>) {
        if held.broken.is_none() && !std::mem::replace(&mut held.is_queued, true) {
            drop(held);
            self.queue.push(self.clone());
        }
    }

    /// Takes all events, and where they begin. The log is empty afterwards, and is queued again with its next event.
    pub fn take(&self) -> TakenEvents {
        // The new buffer has room for as many events, so that the stepping thread does not allocate.
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
            has_overflowed: std::mem::take(&mut held.has_overflowed),
        }
    }
}

/// Queue of the event logs that hold events, each at most once, from stepping threads to the writer of journals.
#[derive(Default)]
pub struct EventLogQueue {
    state: Mutex<Queued>,
    wake: Condvar,
    needs_mirror: AtomicBool,
}

#[derive(Default)]
struct Queued {
    event_logs: Vec<Arc<EventLog>>,
    stop: bool,
}

impl EventLogQueue {
    /// Makes only events that are on two disks durable, in event logs that are created from now on.
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

    /// Blocks until an event log holds events, at most for `longest` (`None`: without limit), and takes all that do,
    /// in the order in which they were queued. The list is empty after a timeout. `None` if the queue is stopped and
    /// empty.
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

    /// Takes the event logs that hold events now, in the order in which they were queued, without waiting; empty if
    /// there are none.
    pub fn take(&self) -> Vec<Arc<EventLog>> {
        std::mem::take(&mut lock(&self.state).event_logs)
    }

    /// Returns whether the queue has been stopped.
    pub fn is_stopped(&self) -> bool {
        lock(&self.state).stop
    }

    /// Stops the queue and wakes its reader: [`EventLogQueue::wait`] returns `None` once it is empty.
    pub fn stop(&self) {
        lock(&self.state).stop = true;
        self.wake.notify_all();
    }
}

/// Schedule by which a stepping thread writes the state to an event log.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cadence {
    snapshot_steps: u64,
    hash_steps: u64,
    felt_steps: u64,
    next_snapshot: u64,
}

impl Cadence {
    /// Creates the schedule of a session of `model` that has done `step` steps.
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

    /// Returns whether a snapshot is due at `step`, and then plans the next. `is_new_rest`: the tissue has come to
    /// rest there.
    pub(super) fn wants_snapshot(&mut self, step: u64, is_new_rest: bool) -> bool {
        let least = self.next_snapshot.saturating_sub(self.snapshot_steps) + self.hash_steps;
        let is_due = step >= self.next_snapshot || (is_new_rest && step >= least);
        if is_due {
            self.next_snapshot = step + self.snapshot_steps;
        }
        is_due
    }

    /// Returns whether a hash is due at `step`.
    pub(super) fn wants_hash(&self, step: u64) -> bool {
        step.is_multiple_of(self.hash_steps)
    }

    /// Returns whether poses and forces are recorded at `step`.
    pub(super) fn wants_felt(&self, step: u64) -> bool {
        step.is_multiple_of(self.felt_steps)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use palpate_tissue::scene::PAPER;

    use super::*;

    #[test]
    fn a_log_that_overflows_during_a_sync_stays_broken_and_is_reported_once() {
        let first = Model::parse("paper", PAPER, &["sheet.points=[5, 5]"]).unwrap();
        let (id, owner) = ("a".to_owned(), "b".to_owned());
        let about = About {
            id,
            owner,
            idle_timeout_s: 1.0,
            first,
            begin_step: 0,
            running: true,
            until_step: None,
            after_run: 0,
            revision: 0,
            exercise: None,
        };
        let log = EventLog::new(&Arc::default(), about);
        let fill = |count: usize| (0..count).for_each(|_| log.note(1, Event::Left(Leaving::Deleted)));
        fill(MAX_EVENTS);
        assert!(!log.take().is_broken, "as many as it holds");
        fill(MAX_EVENTS + 1);
        log.set_durable(1, 0.0);
        let reason = log.progress().borrow().broken.clone();
        assert_eq!(reason.as_deref(), Some(OVERFLOW), "the events after that are lost");
        let taken = log.take();
        assert!(taken.is_broken && taken.has_overflowed && taken.events.is_empty());
        assert!(!log.take().has_overflowed);
        // The writer allows it to restart.
        log.may_begin_anew();
        assert!(log.begins_anew(|| Beginning { step: 2, running: true, until_step: None }));
        fill(1);
        let taken = log.take();
        assert!(!taken.is_broken && taken.anew.is_some() && taken.events.len() == 1);
        log.set_durable(2, 0.0);
        assert_eq!(log.progress().borrow().broken, None);
    }
}
