//! The sessions of a server, and the threads that step them.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock, Weak};
use std::thread::JoinHandle;

use super::audited::AuditTally;
use super::auditor::{Auditor, Sessions};
use super::clock::now_ns;
use super::event_log::EventLogQueue;
use super::fence::Fence;
use super::frames::{Encoder, Viewer};
use super::inbox::{Leaving, Request};
use super::reading::{Piece, Reading};
use super::session_handle::{SessionHandle, deleted};
use super::thread::{self, Apart, Stepper};
use super::thread_counters::ThreadCounters;
use crate::priority::{self, STEPPING_TURN, give_way, give_way_a_little, take_short_turns};
use palpate_refusal::{Reason, Refusal, Result, excerpt};
use palpate_session::budget::Budget;
use palpate_session::local_model::StiffnessJob;
use palpate_tissue::limits::Limits;
use palpate_tissue::lock::lock;

/// Limit of waiting computations of stiffness, over all tools of a server.
const WAITING_REFINEMENTS: usize = 8;

/// All sessions of a server, with the threads that step, show, read and audit them. [`Pacer::stop`] ends them;
/// dropping it does not.
pub struct Pacer {
    pub(super) limits: Limits,
    /// Memory, processor time and other resources, divided among the callers.
    pub budget: Arc<Budget>,
    /// One for each stepping thread: its inbox and its new sessions.
    pub(super) steppers: Vec<Arc<Stepper>>,
    /// The thread of lower priority, for sessions whose steps take too long.
    apart: Arc<Stepper>,
    encoder: Arc<Encoder>,
    reading: Arc<Reading>,
    threads: Mutex<Vec<JoinHandle<()>>>,
    pub(super) sessions: Sessions,
    /// The IDs of sessions by those that open them for a trainee.
    pub(super) trainees: Mutex<BTreeMap<String, String>>,
    auditor: Arc<Auditor>,
    viewers: Mutex<BTreeMap<String, Weak<Viewer>>>,
    pub(super) numbers: Mutex<u64>,
    pub(super) event_logs: OnceLock<Arc<EventLogQueue>>,
    pub(super) measures_stages: AtomicBool,
    /// The moment until which the server may step its sessions and answer for them; none at first.
    pub fence: Arc<Fence>,
}

impl Pacer {
    /// Starts `threads` stepping threads (0 counts as 1; named `step-0` and so on) and one thread each for: sessions
    /// whose steps take too long for others (`step-apart`), the stiffness under tools (`stiffness`), frames
    /// (`frames`), reading large sheets (`records`), and audits with `audit_share` of a core, 0 to 1 (`audit`; none
    /// if that is 0). There are no sessions at first.
    ///
    /// # Errors
    /// Returns the error of the system if a thread can't be started; those that were started keep waiting.
    pub fn start(threads: usize, audit_share: f64, limits: &Limits, budget: Arc<Budget>) -> std::io::Result<Arc<Self>> {
        let (encoder, reading) = (Arc::new(Encoder::default()), Arc::new(Reading::default()));
        let (mut handles, fence) = (Vec::new(), Arc::new(Fence::default()));
        let (mut steppers, apart) = (Vec::new(), Arc::new(Stepper::default()));
        // It ends when the stepping threads have ended and the channel has no senders.
        let (refiner, refinements) = std::sync::mpsc::sync_channel::<StiffnessJob>(WAITING_REFINEMENTS);
        let worker = move || {
            give_way();
            refinements.into_iter().for_each(StiffnessJob::work);
        };
        handles.push(priority::thread("stiffness").spawn(worker)?);
        let threads = threads.max(1);
        // The thread without `apart`, to which other threads' sessions move, has a lower priority.
        let spawn = |name: String, stepper: Arc<Stepper>, apart: Option<Apart>| {
            let (encoder, refiner, reading, fence) = (encoder.clone(), refiner.clone(), reading.clone(), fence.clone());
            priority::thread(name).spawn(move || {
                if apart.is_some() {
                    take_short_turns(STEPPING_TURN);
                } else {
                    give_way();
                }
                thread::work(&stepper, apart.as_ref(), &fence, &encoder, &refiner, &reading);
            })
        };
        for index in 0..threads {
            let stepper = Arc::new(Stepper::default());
            steppers.push(stepper.clone());
            let apart = Apart { stepper: apart.clone(), index: threads };
            handles.push(spawn(format!("step-{index}"), stepper, Some(apart))?);
        }
        handles.push(spawn("step-apart".to_owned(), apart.clone(), None)?);
        let (frames, shared) = (encoder.clone(), budget.clone());
        // A late frame is visible, a late step is felt: so frames yield to steps.
        let worker = move || {
            give_way_a_little();
            frames.work(&shared);
        };
        handles.push(priority::thread("frames").spawn(worker)?);
        let reader = reading.clone();
        let worker = move || {
            give_way();
            reader.work();
        };
        handles.push(priority::thread("records").spawn(worker)?);
        let (auditor, sessions) = (Arc::new(Auditor::default()), Sessions::default());
        if audit_share > 0.0 {
            let (auditor, sessions) = (auditor.clone(), sessions.clone());
            let worker = move || {
                give_way();
                auditor.work(&sessions, audit_share);
            };
            handles.push(priority::thread("audit").spawn(worker)?);
        }
        Ok(Arc::new(Pacer {
            limits: limits.clone(),
            budget,
            steppers,
            apart,
            encoder,
            reading,
            threads: Mutex::new(handles),
            sessions,
            trainees: Mutex::new(BTreeMap::new()),
            auditor,
            viewers: Mutex::new(BTreeMap::new()),
            numbers: Mutex::new(0),
            event_logs: OnceLock::new(),
            measures_stages: AtomicBool::new(false),
            fence,
        }))
    }

    /// Makes each session that is created from now on write an event log, unless it is not to be recorded. Returns
    /// the queue of the logs, which the caller must empty; a further call returns the same queue.
    pub fn record_events(&self) -> Arc<EventLogQueue> {
        self.event_logs.get_or_init(Arc::default).clone()
    }

    /// Makes each session that is created from now on measure how long the stages of its steps take
    /// ([`Status::stages`](super::status::Status::stages)).
    pub fn measure_stages(&self) {
        self.measures_stages.store(true, Ordering::Relaxed);
    }

    /// Returns whether a session has this ID, including one that is still being handed to this server.
    pub fn has(&self, id: &str) -> bool {
        lock(&self.sessions).contains_key(id)
    }

    /// Returns the session of that ID, and counts the call as a use of it.
    ///
    /// # Errors
    /// Refuses an ID that no session has or whose session is still being handed to this server
    /// ([`Reason::UnknownSession`]), and every other ID while the server may not answer for its sessions
    /// ([`Reason::Fenced`]).
    pub fn get(&self, id: &str) -> Result<Arc<SessionHandle>> {
        let handle = lock(&self.sessions).get(id).cloned();
        let handle = handle.filter(|handle| !handle.is_coming()).ok_or_else(|| unknown_session(id))?;
        if !self.fence.may_act() {
            return Err(fenced());
        }
        handle.asked_ns.store(now_ns(), Ordering::Relaxed);
        Ok(handle)
    }

    /// Returns the session that an ID opens for a trainee, and counts the call as a use of it; `None` if it opens none.
    ///
    /// # Errors
    /// Returns the refusals of [`Pacer::get`] for that session.
    pub fn get_for_trainee(&self, trainee_id: &str) -> Option<Result<Arc<SessionHandle>>> {
        let id = lock(&self.trainees).get(trainee_id).cloned()?;
        // A refusal names the ID that was sent.
        let of_trainee = |refusal: Refusal| match refusal.reason {
            Reason::UnknownSession => unknown_session(trainee_id),
            _ => refusal,
        };
        Some(self.get(&id).map_err(of_trainee))
    }

    /// Returns whether the session exists, has an event log, and its journal is being written as run `run`.
    pub fn is_recording(&self, id: &str, run: u32) -> bool {
        let sessions = lock(&self.sessions);
        let event_log = sessions.get(id).and_then(|handle| handle.event_log.as_ref());
        event_log.is_some_and(|event_log| event_log.progress().borrow().run == run)
    }

    /// Returns all sessions, oldest on this server first, including those that are still being handed to it.
    pub fn list(&self) -> Vec<Arc<SessionHandle>> {
        let mut all: Vec<_> = lock(&self.sessions).values().cloned().collect();
        all.sort_by_key(|handle| handle.number);
        all
    }

    /// Returns the counters of each stepping thread, in the order of their numbers; the last are those of
    /// `step-apart`.
    pub fn tallies(&self) -> impl Iterator<Item = &ThreadCounters> {
        self.steppers.iter().chain([&self.apart]).map(|stepper| &stepper.inbox.tally)
    }

    /// Returns the counters of the auditor; all 0 if there is none.
    pub fn audit_tally(&self) -> &AuditTally {
        &self.auditor.tally
    }

    /// Returns the number of viewers that exist, over all sessions.
    pub fn viewers(&self) -> usize {
        lock(&self.viewers).values().filter(|viewer| viewer.strong_count() > 0).count()
    }

    /// Deletes a session: ends all its streams, and discards its waiting commands. Its ID is unknown from now on; its
    /// thread drops it later.
    ///
    /// # Errors
    /// Refuses an unknown ID ([`Reason::UnknownSession`]).
    pub fn delete(&self, id: &str) -> Result<()> {
        self.part_with(id, deleted(), Leaving::Deleted)
    }

    /// Removes a session that has another owner: ends all its streams on this server with `why`, and records a last
    /// snapshot and that it left in its journal.
    ///
    /// # Errors
    /// Refuses an unknown ID ([`Reason::UnknownSession`]).
    pub fn leave(&self, id: &str, why: Refusal) -> Result<()> {
        self.part_with(id, why, Leaving::Moved)
    }

    /// Cancels a session that was being handed to this server: discards what has arrived, and ends its streams with
    /// `why`. It does not check that the session is still arriving.
    ///
    /// # Errors
    /// Refuses an unknown ID ([`Reason::UnknownSession`]).
    pub fn withdraw(&self, id: &str, why: Refusal) -> Result<()> {
        self.part_with(id, why, Leaving::Withdrawn)
    }

    fn part_with(&self, id: &str, why: Refusal, leaving: Leaving) -> Result<()> {
        let handle = lock(&self.sessions).remove(id).ok_or_else(|| unknown_session(id))?;
        if let Some(exercise) = &handle.exercise {
            lock(&self.trainees).remove(&exercise.trainee_id);
        }
        lock(&handle.slot).shrink_to(0);
        let waited = lock(&handle.intake).close(why.clone());
        if !waited.is_empty() {
            // Freeing many commands takes longer than other calls may wait.
            self.reading.post(&handle.owner, Piece::Remains(Box::new(waited)));
        }
        handle.inbox.send(handle.number, Request::Leave(why, leaving));
        Ok(())
    }

    /// Ends all streams of all sessions and releases all their tools at the next step, because the server may no
    /// longer answer for its sessions. The sessions stay.
    pub fn fall_silent(&self) {
        for handle in self.list() {
            handle.at_intake(|intake, _| intake.free(|_, _| true));
            handle.inbox.send(handle.number, Request::Silence(fenced()));
        }
    }

    /// Deletes the sessions that had no call, stream or held tool for longer than their idle timeout. Returns their
    /// IDs, in ascending order.
    pub fn delete_idle(&self) -> Vec<String> {
        let now = now_ns();
        let all: Vec<_> = lock(&self.sessions).values().cloned().collect();
        let ids: Vec<String> =
            all.iter().filter(|handle| handle.is_idle(now)).map(|handle| handle.id.clone()).collect();
        ids.into_iter().filter(|id| self.delete(id).is_ok()).collect()
    }

    /// Adds a viewer to a session: it is sent a full frame and then further ones. [`Pacer::viewer`] finds it while it
    /// exists.
    pub fn add_viewer(&self, handle: &SessionHandle, viewer: &Arc<Viewer>) {
        let mut viewers = lock(&self.viewers);
        viewers.retain(|_, viewer| viewer.strong_count() > 0);
        viewers.insert(viewer.id.clone(), Arc::downgrade(viewer));
        drop(viewers);
        handle.view(viewer.clone());
    }

    /// Returns the viewer of that ID, of any session.
    ///
    /// # Errors
    /// Refuses an ID that no viewer has or whose viewer has ended ([`Reason::UnknownViewer`]).
    pub fn viewer(&self, id: &str) -> Result<Arc<Viewer>> {
        lock(&self.viewers).get(id).and_then(Weak::upgrade).ok_or_else(|| {
            Refusal::new(Reason::UnknownViewer, "viewer_id", format!("there is no viewer `{}`", excerpt(id)))
        })
    }

    /// Ends all sessions with [`Reason::ShuttingDown`] and all threads, and blocks until the threads have ended. Each
    /// event log gets a last snapshot. [`Pacer::list`] still returns the sessions. Do not call it on one of these
    /// threads.
    pub fn stop(&self) {
        let why = Refusal::new(Reason::ShuttingDown, "", "the server is shutting down");
        for handle in lock(&self.sessions).values() {
            drop(lock(&handle.intake).close(why.clone()));
        }
        self.steppers.iter().chain([&self.apart]).for_each(|stepper| stepper.inbox.stop(why.clone()));
        self.encoder.stop();
        self.reading.stop();
        self.auditor.stop();
        for thread in lock(&self.threads).drain(..) {
            let _ = thread.join();
        }
    }
}

/// Returns the refusal of a call while the server may not answer for its sessions ([`Reason::Fenced`]).
pub fn fenced() -> Refusal {
    let message = "the server has not heard from etcd for so long that another server may have this session; it continues here, or \
                   there, when they have";
    Refusal::new(Reason::Fenced, "", message)
}

fn unknown_session(id: &str) -> Refusal {
    let message = format!("there is no session `{}`", excerpt(id));
    Refusal::new(Reason::UnknownSession, "session_id", message)
}
