//! Sessions in real time: the only room with a clock. Stepping threads own the sessions; what servers call here
//! posts a request to one, or goes through the session's intake, and never waits for a step.
//!
//! **Stepping threads wait for nobody.** Commands wait in the intake, whose lock is held for a queue operation and never for a
//! step. Samples and records wait in queues with bounds in items and bytes that drop the oldest and count it, snapshots for
//! frames in a slot that keeps the newest, the log in a buffer that drops. Requests to a session are messages to its thread,
//! which serves one of them before each step that is due.
//!
//! **Overruns.** Time steps are fixed. A session catches up two steps and what the longest step of its thread has made it late.
//! What it is behind beyond that is dropped from its schedule, counted (`overrun_count`), and shows as `time_dilation`.

mod admission;
pub mod auditor;
pub mod clock;
mod cost;
pub mod frames;
mod inbox;
pub(crate) mod laws;
pub(crate) mod priority;
pub mod queue;
mod reading;
pub mod streams;
pub mod tally;
mod taps;
mod thread;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use tokio::sync::{oneshot, watch};

use crate::budget::{Account, Budget, Taken};
use crate::limits::Limits;
use crate::lock::lock;
use crate::memory;
use crate::refusal::{Reason, Refusal, Result};
use crate::scene::Change;
use crate::scene::record::{Point, Record, Recovery};
use crate::session::Sample;
use crate::session::command::{Batch, Command, Intake, LeaseId};
use crate::session::local::Refinement;
use crate::session::sampling::{HEARTBEAT_S, Sampler, Sampling};
use crate::session::schedule::Schedule;
use crate::sheet::Model;
use auditor::{AuditTally, Audited, Auditor, Sessions};
use clock::{Dilation, now_ns};
use cost::{Cost, check_work};
use frames::{Delivery, Encoder, Viewer};
use inbox::{Inbox, Request};
use laws::{KeptLaws, SoughtLaw};
use priority::give_way;
use queue::{Reader, queue};
use reading::{Reading, Recipient};
use streams::Streams;
pub use streams::{Held, StreamGuard};
use tally::Tally;
use taps::{ProbeTap, SampleTap};

/// A sample, and how the session keeps time.
#[derive(Debug, Clone, PartialEq)]
pub struct PacedSample {
    /// What the tools felt.
    pub sample: Sample,
    /// When its step was due, by the server's clock.
    pub due_ns: u64,
    /// Steps dropped so far.
    pub overrun_count: u64,
    /// Of the last second or so.
    pub time_dilation: f64,
    /// Steps were dropped since the stream's last sample.
    pub overrun: bool,
}

/// A record, and its step. All who asked for the same share one.
pub type PacedRecord = Arc<Recorded>;

/// What was measured once, for whoever asked for it.
#[derive(Debug)]
pub struct Recorded {
    /// Steps done.
    pub step: u64,
    /// What was measured.
    pub record: Record,
    /// Its memory.
    _taken: Taken,
}

/// Whether a session's time goes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// In real time.
    Running,
    /// Waits to be started.
    Paused,
    /// Ended by the guard.
    Held,
}

/// How a session stands.
#[derive(Debug, Clone)]
pub struct Status {
    /// Whether time goes on.
    pub state: State,
    /// Steps done.
    pub step: u64,
    /// Nothing moves and no command waits: the session is not stepped.
    pub resting: bool,
    /// Steps skipped at rest.
    pub rested_steps: u64,
    /// Steps dropped.
    pub overrun_count: u64,
    /// Simulated over real time.
    pub dilation: Dilation,
    /// When steps are due while time goes on.
    pub schedule: Schedule,
    /// Commands that came too late for their step.
    pub late_commands: u64,
    /// Commands that had no effect because their tool was paused ([`crate::session::recovery`]).
    pub paused_commands: u64,
    /// Why it is held.
    pub hold_reason: Option<String>,
    /// How often the guard went back to a checkpoint.
    pub guard_events: u64,
    /// How often the tissue was taken back to an earlier state.
    pub recovery_count: u64,
    /// The newest of these, by ascending step.
    pub recoveries: Vec<Recovery>,
    /// Points that the last step computed.
    pub awake_points: usize,
    /// As [`crate::session::Session::path_counts`].
    pub path_counts: [u64; 3],
    /// Leases that ran out.
    pub lapsed_leases: u64,
    /// The tissue as it is: [`Live::change`] may have made another of it.
    pub model: Arc<Model>,
}

impl Status {
    /// The session goes on, and what it counts of itself begins anew.
    fn forget_hold(&mut self) {
        (self.hold_reason, self.state) = (None, State::Paused);
        (self.late_commands, self.guard_events, self.path_counts) = (0, 0, [0; 3]);
        self.paused_commands = 0;
        (self.recovery_count, self.recoveries) = (0, Vec::new());
    }
}

/// A session as the server sees it.
pub struct Live {
    /// Random, not to be guessed.
    pub id: String,
    /// The tissue as the session began with it. Points and rate stay; coefficients, scheme and substeps may be others by
    /// now ([`Status::model`]).
    pub model: Arc<Model>,
    /// Who made it, and pays for it.
    pub owner: Account,
    intake: Mutex<Intake>,
    /// Deleted when so long nobody asked for it, held a tool or had a stream, s.
    pub idle_timeout_s: f64,
    asked_ns: AtomicU64,
    number: u64,
    limits: Limits,
    status: Mutex<Status>,
    streams: Mutex<Streams>,
    refused: AtomicU64,
    laws: KeptLaws,
    tissue: watch::Sender<(u64, Arc<Model>)>,
    cost: Cost,
    audited: Mutex<Audited>,
    /// Of the stepping threads, its own, and where that is asked.
    thread: usize,
    inbox: Arc<Inbox>,
    /// The session, and its memory.
    _taken: [Taken; 2],
}

impl Live {
    /// How the session stands now: at rest its steps are done in thought.
    pub fn status(&self) -> Status {
        let now = now_ns();
        let resting = self.at_intake(|intake, _| intake.is_resting().then(|| intake.next_step()));
        let mut status = lock(&self.status).clone();
        if let Some(step) = resting.filter(|step| *step >= status.step) {
            status.rested_steps += step - status.step;
            status.dilation.observe(now, step, status.schedule.period_ns());
            (status.resting, status.step, status.awake_points) = (true, step, 0);
        }
        status
    }

    #[allow(clippy::cast_precision_loss)]
    fn is_idle(&self, now_ns: u64) -> bool {
        let unused_s = now_ns.saturating_sub(self.asked_ns.load(Ordering::Relaxed)) as f64 * 1e-9;
        unused_s > self.idle_timeout_s
            && self.streams() == 0
            && self.at_intake(|intake, _| intake.holders().next().is_none())
    }

    /// Where commands come in, as it stands now, and the time: also while no step is done that would end the leases that
    /// have run out. A session at rest wakes if need be.
    pub fn at_intake<T>(&self, act: impl FnOnce(&mut Intake, u64) -> T) -> T {
        let mut intake = lock(&self.intake);
        let now = now_ns();
        intake.lapse(now);
        let answer = act(&mut intake, now);
        let wake = intake.take_wake();
        drop(intake);
        if wake {
            self.inbox.send(self.number, Request::Wake);
        }
        answer
    }

    /// Accepts all of `commands` from the holder of `lease`, or none. The first slice of them is put in the queue.
    pub fn submit(&self, lease: LeaseId, commands: Vec<Command>) -> Result<Accepted<'_>> {
        let rules = lock(&self.intake).rules();
        let checked = rules.check(commands)?;
        self.at_intake(|intake, now| {
            let mut batch = intake.accept(lease, checked, now)?;
            let goes_on = intake.go_on(&mut batch);
            Ok(Accepted { live: self, batch, goes_on })
        })
    }

    /// So many commands were refused.
    pub fn count_refused(&self, commands: usize) {
        self.refused.fetch_add(commands as u64, Ordering::Relaxed);
    }

    /// What audits have found so far.
    pub fn audited(&self) -> Audited {
        lock(&self.audited).clone()
    }

    /// Commands that were refused, in all.
    pub fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }

    async fn ask<T>(&self, request: impl FnOnce(oneshot::Sender<Result<T>>) -> Request) -> Result<T> {
        let (reply, answer) = oneshot::channel();
        self.inbox.send(self.number, request(reply));
        answer.await.unwrap_or_else(|_| Err(deleted()))
    }

    /// Lets time go on, for ever or until so many steps are done; tells the step that comes next.
    pub async fn start(&self, until: Option<u64>) -> Result<u64> {
        self.ask(|reply| Request::Start { until, reply }).await
    }

    /// Changes the tissue from the beginning of step `at_step` on, or of the next. Tells the step, and the tissue from then
    /// on. It is compiled here, by who asks, some milliseconds: no step waits for that.
    ///
    /// `admit` is asked whether the thread has the time that the tissue will take of it, as a part of all. It is given up
    /// when `stop` is set.
    pub fn change(
        &self,
        change: &Change,
        at_step: Option<u64>,
        admit: impl Fn(f64) -> Result<()>,
        stop: &AtomicBool,
    ) -> Result<(u64, Arc<Model>)> {
        loop {
            let base = self.at_intake(|intake, _| intake.changed_to());
            let now = base.as_ref().unwrap_or(&self.model);
            let model = memory::attempt("", || now.changed_until(change, &self.model.scene, &self.limits, stop))?;
            check_work(&model, &self.limits)?;
            // The stepping thread lays out what the new scheme keeps, and a checkpoint.
            memory::check(2 * model.state_bytes(), "another tissue")?;
            let (before, after) = (lock(&self.status).model.plan.substeps, model.plan.substeps);
            if after > before {
                admit(self.cost.awake_share() * f64::from(after) / f64::from(before))?;
            }
            // Somebody may have been quicker; then it is made out of theirs.
            if let Some(step) = self.at_intake(|intake, now| intake.change(base.as_ref(), &model, at_step, now))? {
                return Ok((step, model));
            }
        }
    }

    /// Has a session that is held go on: from the step that it was held at, paused, with its tissue at rest, and no tool
    /// held. What made the tissue fail may make it fail again.
    pub async fn revive(&self) -> Result<u64> {
        self.ask(|reply| Request::Revive { reply }).await
    }

    /// Stops time.
    pub async fn pause(&self) -> Result<()> {
        self.ask(|reply| Request::Pause { reply }).await
    }

    /// Waits until `at` steps are done (now, if `None`), and tells the step and the state's hash there.
    /// `account` is charged for it.
    pub async fn hash_at(&self, at: Option<u64>, account: &Account) -> Result<(u64, u128)> {
        let account = account.clone();
        self.ask(|reply| Request::Hash { at, account, reply }).await
    }

    /// The samples that are asked for.
    ///
    /// What it takes on the stepping thread is charged to `watcher`, who gets no sample while its share of that time is used
    /// up; `None` for the stream of who holds a tool.
    pub fn samples(&self, sampling: Sampling, watcher: Option<&Account>) -> Reader<PacedSample> {
        self.tap(sampling, watcher, false)
    }

    /// The next sample; the present one if time stands.
    pub async fn next_sample(&self, only: Vec<u32>) -> Result<PacedSample> {
        let (laws, touch_stiffness) = (None, false);
        let sampling =
            Sampling { every: 1, only: Some(only), deadband: None, heartbeat_s: HEARTBEAT_S, laws, touch_stiffness };
        Ok(self.tap(sampling, None, true).pop().await?.0)
    }

    fn tap(&self, sampling: Sampling, watcher: Option<&Account>, once: bool) -> Reader<PacedSample> {
        let (writer, reader) = queue(if once { 1 } else { self.limits.queued_samples });
        let sampler = Sampler::new(sampling, self.model.scene.stepping.rate_hz);
        let tap = SampleTap { sampler, once, writer, watcher: watcher.cloned(), overrun_count: 0 };
        self.inbox.send(self.number, Request::Samples(tap));
        reader
    }

    /// Records of some points, or of all, every so many steps; refused if there is no memory for one.
    pub fn probe(
        &self,
        every: u64,
        points: Option<Vec<[usize; 2]>>,
        energy: bool,
        account: &Account,
    ) -> Result<Reader<PacedRecord>> {
        let count = points.as_ref().map_or(self.model.len(), Vec::len).max(1);
        let bytes = count * size_of::<Point>();
        memory::check(bytes as u64, "a record")?;
        let room = (self.limits.queued_bytes / bytes).clamp(1, self.limits.queued_records);
        let (writer, reader) = queue(room);
        let (recipient, points) = (Recipient::new(writer, room), points.map(Arc::from));
        let account = account.clone();
        self.inbox.send(self.number, Request::Probe(ProbeTap { every, points, energy, recipient, account }));
        Ok(reader)
    }

    /// The tissue, and the step from whose beginning on it acts. A change of it is noticed when it acts.
    pub(crate) fn tissue(&self) -> watch::Receiver<(u64, Arc<Model>)> {
        self.tissue.subscribe()
    }

    /// The force law of `model`, a tissue of this session, under a tip of `radius_m`. Nothing is computed here.
    ///
    /// # Errors
    /// Refuses if the session's owner can't have the memory of a further law.
    pub(crate) fn law(&self, model: &Arc<Model>, radius_m: f64) -> Result<Arc<SoughtLaw>> {
        self.laws.of(radius_m, model, self.limits.law_work, &self.owner)
    }

    /// Frames for a viewer.
    pub fn view(&self, viewer: Arc<Viewer>) {
        self.inbox.send(self.number, Request::View(viewer));
    }
}

/// Commands that were accepted. Those that are not in the queue yet are put there when this is dropped.
pub struct Accepted<'l> {
    live: &'l Live,
    batch: Batch,
    goes_on: bool,
}

impl Accepted<'_> {
    fn go_on(&mut self) {
        let batch = &mut self.batch;
        self.goes_on = self.live.at_intake(|intake, _| intake.go_on(batch));
    }

    /// Puts them in the queue slice by slice. Between slices other tasks and the stepping thread have their turns.
    pub async fn taken_in(mut self) {
        while self.goes_on {
            tokio::task::yield_now().await;
            self.go_on();
        }
    }
}

impl Drop for Accepted<'_> {
    fn drop(&mut self) {
        while self.goes_on {
            self.go_on();
        }
    }
}

/// Stiffnesses that wait to be computed, of all tools of a server.
const WAITING_REFINEMENTS: usize = 8;

fn deleted() -> Refusal {
    Refusal::new(Reason::SessionDeleted, "session_id", "the session has been deleted")
}

/// All sessions of a server, and the threads that step them.
pub struct Pacer {
    limits: Limits,
    /// What callers share.
    pub budget: Arc<Budget>,
    inboxes: Vec<Arc<Inbox>>,
    encoder: Arc<Encoder>,
    reading: Arc<Reading>,
    threads: Mutex<Vec<JoinHandle<()>>>,
    sessions: Sessions,
    auditor: Arc<Auditor>,
    viewers: Mutex<BTreeMap<String, std::sync::Weak<Viewer>>>,
    numbers: Mutex<u64>,
}

/// 128 random bits, in hexadecimal.
pub fn random_id() -> Result<String> {
    Ok(format!("{:032x}", random_bits()?))
}

/// 128 random bits.
pub fn random_bits() -> Result<u128> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes)
        .map_err(|e| Refusal::new(Reason::TooMany, "", format!("the system has no random numbers: {e}")))?;
    Ok(u128::from_le_bytes(bytes))
}

impl Pacer {
    /// Starts `threads` stepping threads, one that encodes frames, one that reads large sheets, and one that measures
    /// errors with `audit_share` of a core; none if that is 0.
    pub fn start(threads: usize, audit_share: f64, limits: &Limits, budget: Arc<Budget>) -> std::io::Result<Arc<Self>> {
        let (encoder, reading) = (Arc::new(Encoder::default()), Arc::new(Reading::default()));
        let mut handles = Vec::new();
        let mut inboxes = Vec::new();
        // It ends when the stepping threads have ended, and nobody sends any more.
        let (refiner, refinements) = std::sync::mpsc::sync_channel::<Refinement>(WAITING_REFINEMENTS);
        let worker = move || {
            give_way();
            refinements.into_iter().for_each(Refinement::work);
        };
        handles.push(std::thread::Builder::new().name("stiffness".into()).spawn(worker)?);
        for index in 0..threads.max(1) {
            let inbox = Arc::new(Inbox::default());
            inboxes.push(inbox.clone());
            let (encoder, refiner, reading) = (encoder.clone(), refiner.clone(), reading.clone());
            let builder = std::thread::Builder::new().name(format!("step-{index}"));
            handles.push(builder.spawn(move || thread::work(&inbox, &encoder, &refiner, &reading))?);
        }
        let (worker, shared) = (encoder.clone(), budget.clone());
        handles.push(std::thread::Builder::new().name("frames".into()).spawn(move || worker.work(&shared))?);
        let reader = reading.clone();
        let worker = move || {
            give_way();
            reader.work();
        };
        handles.push(std::thread::Builder::new().name("records".into()).spawn(worker)?);
        let (auditor, sessions) = (Arc::new(Auditor::default()), Sessions::default());
        if audit_share > 0.0 {
            let (auditor, sessions) = (auditor.clone(), sessions.clone());
            let worker = move || {
                give_way();
                auditor.work(&sessions, audit_share);
            };
            handles.push(std::thread::Builder::new().name("audit".into()).spawn(worker)?);
        }
        Ok(Arc::new(Pacer {
            limits: limits.clone(),
            budget,
            inboxes,
            encoder,
            reading,
            threads: Mutex::new(handles),
            sessions,
            auditor,
            viewers: Mutex::new(BTreeMap::new()),
            numbers: Mutex::new(0),
        }))
    }

    /// The session of that id.
    pub fn get(&self, id: &str) -> Result<Arc<Live>> {
        let live = lock(&self.sessions).get(id).cloned().ok_or_else(|| unknown_session(id))?;
        live.asked_ns.store(now_ns(), Ordering::Relaxed);
        Ok(live)
    }

    /// All sessions, oldest first.
    pub fn list(&self) -> Vec<Arc<Live>> {
        let mut all: Vec<_> = lock(&self.sessions).values().cloned().collect();
        all.sort_by_key(|live| live.number);
        all
    }

    /// What each stepping thread counts of itself.
    pub fn tallies(&self) -> impl Iterator<Item = &Tally> {
        self.inboxes.iter().map(|inbox| &inbox.tally)
    }

    /// What the auditor counts.
    pub fn audit_tally(&self) -> &AuditTally {
        &self.auditor.tally
    }

    /// Those who look at some session.
    pub fn viewers(&self) -> usize {
        lock(&self.viewers).values().filter(|viewer| viewer.strong_count() > 0).count()
    }

    /// Ends a session and all its streams.
    pub fn delete(&self, id: &str) -> Result<()> {
        let live = lock(&self.sessions).remove(id).ok_or_else(|| unknown_session(id))?;
        let waited = lock(&live.intake).close(deleted());
        if !waited.is_empty() {
            // To free many takes longer than other calls may wait.
            self.reading.post(&live.owner, reading::Piece::Remains(Box::new(waited)));
        }
        live.inbox.send(live.number, Request::Delete(deleted()));
        Ok(())
    }

    /// Deletes the sessions that nobody uses any more; tells which.
    pub fn delete_idle(&self) -> Vec<String> {
        let now = now_ns();
        let all: Vec<_> = lock(&self.sessions).values().cloned().collect();
        let ids: Vec<String> = all.iter().filter(|live| live.is_idle(now)).map(|live| live.id.clone()).collect();
        ids.into_iter().filter(|id| self.delete(id).is_ok()).collect()
    }

    /// Adds a viewer to a session.
    pub fn add_viewer(&self, live: &Live, viewer: &Arc<Viewer>) {
        let mut viewers = lock(&self.viewers);
        viewers.retain(|_, viewer| viewer.strong_count() > 0);
        viewers.insert(viewer.id.clone(), Arc::downgrade(viewer));
        drop(viewers);
        live.view(viewer.clone());
    }

    /// The viewer of that id.
    pub fn viewer(&self, id: &str) -> Result<Arc<Viewer>> {
        lock(&self.viewers).get(id).and_then(std::sync::Weak::upgrade).ok_or_else(|| {
            Refusal::new(Reason::UnknownViewer, "viewer_id", format!("there is no viewer `{}`", excerpt(id)))
        })
    }

    /// Ends all sessions and threads.
    pub fn stop(&self) {
        let why = Refusal::new(Reason::ShuttingDown, "", "the server is going down");
        for live in lock(&self.sessions).values() {
            drop(lock(&live.intake).close(why.clone()));
        }
        self.inboxes.iter().for_each(|inbox| inbox.stop(why.clone()));
        self.encoder.stop();
        self.reading.stop();
        self.auditor.stop();
        for thread in lock(&self.threads).drain(..) {
            let _ = thread.join();
        }
    }
}

fn unknown_session(id: &str) -> Refusal {
    let message = format!("there is no session `{}`", excerpt(id));
    Refusal::new(Reason::UnknownSession, "session_id", message)
}

/// The beginning of what a client sent: a message is no place for megabytes.
pub fn excerpt(text: &str) -> String {
    text.chars().take(64).collect()
}

/// Frames as a stream reads them.
pub type FrameReader = Reader<Delivery>;

#[cfg(test)]
mod tests;
