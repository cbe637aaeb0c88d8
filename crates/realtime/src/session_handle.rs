//! A session as the server sees it: requests to its stepping thread, and its intake.

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use tokio::sync::{oneshot, watch};

use super::audited::Audited;
use super::clock::now_ns;
use super::cost::{Cost, check_work};
use super::event_log::{Event, EventLog};
use super::frames::Viewer;
use super::inbox::{Inbox, Present, Request};
use super::law_cache::{KeptLaws, SoughtLaw};
use super::playback::Playback;
use super::queue::{Reader, queue};
use super::reading::{Recipient, SharedRecord};
use super::slots::StreamSlots;
use super::status::Status;
use super::subscribers::{ProbeTap, SampleTap};
use palpate_haptics::Law;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::batch::AcceptedBatch;
use palpate_session::budget::{Account, Taken};
use palpate_session::command::Command;
use palpate_session::input::Input;
use palpate_session::intake::Intake;
use palpate_session::intake_transfer::Handed;
use palpate_session::lease::LeaseId;
use palpate_session::sample_selection::PacedSample;
use palpate_session::sample_selection::{HEARTBEAT_S, Sampler, Sampling};
use palpate_session::surface::Skin;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::lock::lock;
use palpate_tissue::memory;
use palpate_tissue::response::force_law::Disc;
use palpate_tissue::scene::Change;
use palpate_tissue::scene::record::{Point, ToolRecord};
use palpate_tissue::shape::PointId;

/// A session as the server sees it.
pub struct SessionHandle {
    /// Random, not to be guessed.
    pub id: String,
    /// The tissue as the session began with it. Points and rate stay; coefficients, scheme and substeps may be others by
    /// now ([`Status::model`]).
    pub model: Arc<Model>,
    /// How frames show the tissue, if it is a mesh.
    pub skin: Option<Arc<Skin>>,
    /// Who made it, and pays for it.
    pub owner: Account,
    pub(super) intake: Mutex<Intake>,
    /// Time without calls, held tools or streams after which the session is deleted, s.
    pub idle_timeout_s: f64,
    /// The revision at which this server became its owner; 0 without a fleet.
    pub(super) revision: AtomicU64,
    /// It is handed over to this server, which is not its owner yet.
    pub(super) is_coming: AtomicBool,
    pub(super) asked_ns: AtomicU64,
    pub(super) number: u64,
    pub(super) limits: Limits,
    pub(super) status: Mutex<Status>,
    pub(super) streams: Mutex<StreamSlots>,
    pub(super) refused: AtomicU64,
    pub(super) laws: KeptLaws,
    pub(super) tissue: watch::Sender<(u64, Arc<Model>)>,
    pub(super) cost: Cost,
    pub(super) audited: Mutex<Audited>,
    /// Index of its stepping thread; that of the one that gives way comes after the last.
    pub(super) thread: AtomicUsize,
    /// The inbox of the thread that it began on, which passes on what it is asked.
    pub(super) inbox: Arc<Inbox>,
    /// What it plays, if it plays what was recorded.
    pub playback: Option<Playback>,
    /// What a journal is told of it, if the server keeps journals.
    pub event_log: Option<Arc<EventLog>>,
    /// Its place among the sessions: given back when it is deleted, while others may still read it.
    pub(super) slot: Mutex<Taken>,
    /// Its memory, until nobody reads it any more.
    pub(super) _memory: Taken,
}

impl SessionHandle {
    /// Returns how the session stands now: at rest, the steps that would have been done by now are counted without
    /// computing them.
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

    /// Index of its stepping thread.
    pub(super) fn thread(&self) -> usize {
        self.thread.load(Ordering::Relaxed)
    }

    /// How fast time goes on: other than 1 only of what is played.
    pub(super) fn speed(&self) -> f64 {
        self.playback.as_ref().map_or(1.0, |playback| playback.speed)
    }

    #[allow(clippy::cast_precision_loss)]
    pub(super) fn is_idle(&self, now_ns: u64) -> bool {
        let unused_s = now_ns.saturating_sub(self.asked_ns.load(Ordering::Relaxed)) as f64 * 1e-9;
        unused_s > self.idle_timeout_s
            && self.streams() == 0
            && self.at_intake(|intake, _| intake.holders().next().is_none())
    }

    /// Returns where commands come in, as it stands now, and the time: also while no step is done that would end the
    /// leases that have run out. A session at rest wakes if need be.
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
    ///
    /// # Errors
    /// Refuses commands that do not keep to the rules, and as [`Intake::accept`] does.
    pub fn submit(&self, lease: LeaseId, commands: Vec<Command>) -> Result<Accepted<'_>> {
        let rules = lock(&self.intake).rules();
        let checked = rules.check(commands)?;
        self.at_intake(|intake, now| {
            let mut batch = intake.accept(lease, checked, now)?;
            let goes_on = intake.go_on(&mut batch);
            Ok(Accepted { handle: self, batch, goes_on })
        })
    }

    /// Returns the revision at which this server became the session's owner, or last said so; 0 without a fleet.
    pub fn revision(&self) -> u64 {
        self.revision.load(Ordering::Acquire)
    }

    /// Notes that this server has become the session's owner, or has said so, at that revision.
    pub fn is_owned_since(&self, revision: u64) {
        self.revision.fetch_max(revision, Ordering::AcqRel);
    }

    /// Counts commands that were refused.
    pub fn count_refused(&self, commands: usize) {
        self.refused.fetch_add(commands as u64, Ordering::Relaxed);
    }

    /// Returns what audits have found so far.
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
    ///
    /// # Errors
    /// Refuses a session that is held or deleted, and a step that is done already.
    pub async fn start(&self, until: Option<u64>) -> Result<u64> {
        self.ask(|reply| Request::Start { until, reply }).await
    }

    /// Changes the tissue from the beginning of step `at_step` on, or of the next. Tells the step, and the tissue from then
    /// on. It is compiled here, by who asks, some milliseconds: no step waits for that.
    ///
    /// `admit` is asked whether the thread has the time that the tissue will take of it, as a part of all. It is given up
    /// when `stop` is set.
    ///
    /// # Errors
    /// Refuses a change that is not valid or whose steps are too heavy, what `admit` refuses, and when `stop` is set.
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
            let accepted = self.at_intake(|intake, now| {
                let accepted = intake.change(base.as_ref(), &model, at_step, now)?;
                if accepted.is_some() {
                    self.note_waiting(intake);
                }
                Ok(accepted)
            })?;
            if let Some(step) = accepted {
                return Ok((step, model));
            }
        }
    }

    /// Adopts what waited for its step where the session was before waits here.
    pub fn adopt_waiting(&self, waiting: Vec<(u64, Input)>) {
        let handed = Handed { leases: Vec::new(), waiting };
        let dropped = self.at_intake(|intake, now| {
            let dropped = intake.adopt(handed, now);
            self.note_waiting(intake);
            dropped
        });
        if dropped > 0 {
            tracing::warn!(session = %self.id, dropped, "no memory for all that waited");
        }
    }

    /// Tells the journal which changes of the tissue wait: a session that goes on after a crash still has them.
    pub(super) fn note_waiting(&self, intake: &Intake) {
        if let Some(event_log) = &self.event_log {
            event_log.note(intake.next_step(), Event::Waiting(intake.waiting_changes()));
        }
    }

    /// Has a session that is held go on: from the step that it was held at, paused, with its tissue at rest, and no tool
    /// held. What made the tissue fail may make it fail again.
    ///
    /// # Errors
    /// Refuses a session that is not held, or that is deleted.
    pub async fn revive(&self) -> Result<u64> {
        self.ask(|reply| Request::Revive { reply }).await
    }

    /// Returns the session as it is, to continue from.
    ///
    /// # Errors
    /// Refuses a session that is deleted, and if the system has no memory for it.
    pub async fn save(&self) -> Result<Present> {
        self.ask(Request::Save).await
    }

    /// Returns the session as it is, after which no step is done until [`SessionHandle::thaw`]. It changes no bits.
    ///
    /// # Errors
    /// As for [`SessionHandle::save`].
    pub async fn freeze(&self) -> Result<Present> {
        self.ask(Request::Freeze).await
    }

    /// Makes this server its owner since that revision: a session that began frozen goes on, and is served.
    pub fn arrive(&self, revision: u64) {
        self.is_owned_since(revision);
        self.is_coming.store(false, Ordering::Release);
        self.thaw();
    }

    /// Returns whether it is being handed over to this server, which is not its owner yet.
    pub fn is_coming(&self) -> bool {
        self.is_coming.load(Ordering::Acquire)
    }

    /// Returns its share of its stepping thread, measured.
    pub fn share(&self) -> f64 {
        self.cost.share()
    }

    /// Steps are done again.
    pub fn thaw(&self) {
        self.inbox.send(self.number, Request::Thaw);
    }

    /// Stops time.
    ///
    /// # Errors
    /// Refuses a session that is deleted.
    pub async fn pause(&self) -> Result<()> {
        self.ask(|reply| Request::Pause { reply }).await
    }

    /// Waits until `at` steps are done (now, if `None`), and tells the step and the state's hash there.
    /// `account` is charged for it.
    ///
    /// # Errors
    /// Refuses a step that has passed, a session that is held or deleted, and a caller who has used up their part of the
    /// reading time.
    pub async fn hash_at(&self, at: Option<u64>, account: &Account) -> Result<(u64, u128)> {
        let account = account.clone();
        self.ask(|reply| Request::Hash { at, account, reply }).await
    }

    /// Returns the samples that are asked for.
    ///
    /// What it takes on the stepping thread is charged to `watcher`, who gets no sample while its share of that time is used
    /// up; `None` for the stream of who holds a tool.
    pub fn samples(&self, sampling: Sampling, watcher: Option<&Account>) -> Reader<PacedSample> {
        self.tap(sampling, watcher, false)
    }

    /// Returns the next sample; the present one if time stands.
    ///
    /// # Errors
    /// Refuses a session that is held or deleted.
    pub async fn next_sample(&self, only: Vec<u32>) -> Result<PacedSample> {
        let (laws, touch_stiffness) = (None, false);
        let sampling = Sampling {
            every: 1,
            only: Some(only),
            deadband: None,
            heartbeat_s: HEARTBEAT_S,
            laws,
            touch_stiffness,
            wanted: None,
        };
        Ok(self.tap(sampling, None, true).pop().await?.0)
    }

    fn tap(&self, sampling: Sampling, watcher: Option<&Account>, once: bool) -> Reader<PacedSample> {
        let (writer, reader) = queue(if once { 1 } else { self.limits.queued_samples });
        let sampler = Sampler::new(sampling, self.model.scene.stepping.rate_hz);
        let tap = SampleTap { sampler, once, writer, watcher: watcher.cloned(), overrun_count: 0 };
        self.inbox.send(self.number, Request::Samples(tap));
        reader
    }

    /// Records of some points, or of all, every so many steps, with energies and with tools if asked for; refused if there
    /// is no memory for one.
    ///
    /// # Errors
    /// Refuses if the system has no memory for a record.
    pub fn probe(
        &self,
        every: u64,
        points: Option<Vec<PointId>>,
        energy: bool,
        tools: bool,
        account: &Account,
    ) -> Result<Reader<SharedRecord>> {
        let count = points.as_ref().map_or(self.model.len(), Vec::len).max(1);
        let most_tools = if tools { self.limits.tools as usize } else { 0 };
        let bytes = count * size_of::<Point>() + most_tools * size_of::<ToolRecord>();
        memory::check(bytes as u64, "a record")?;
        let room = (self.limits.queued_bytes / bytes).clamp(1, self.limits.queued_records);
        let (writer, reader) = queue(room);
        let (recipient, points) = (Recipient::new(writer, room), points.map(Arc::from));
        let account = account.clone();
        self.inbox.send(self.number, Request::Probe(ProbeTap { every, points, energy, tools, recipient, account }));
        Ok(reader)
    }

    /// Returns the tissue, and the step from whose beginning on it acts. A change of it is noticed when it acts.
    pub fn tissue(&self) -> watch::Receiver<(u64, Arc<Model>)> {
        self.tissue.subscribe()
    }

    /// Returns the force law of `model`, a tissue of this session, under a disc. Nothing is computed here.
    ///
    /// # Errors
    /// Refuses if the session's owner can't have the memory of a further law.
    pub fn law(&self, model: &Arc<Model>, disc: Disc) -> Result<Arc<SoughtLaw>> {
        self.laws.of(disc, model, self.limits.law_work, &self.owner)
    }

    /// Returns the force laws of the session's tissue that are known.
    pub fn known_laws(&self) -> Vec<(Disc, Arc<Law>)> {
        let model = self.tissue.borrow().1.clone();
        self.laws.known(&model)
    }

    /// Adopts laws of the session's tissue that another server has computed. Those for which there is no memory are computed anew when they
    /// are wanted.
    pub fn adopt_laws(&self, known: Vec<(Disc, Law)>) {
        let model = self.tissue.borrow().1.clone();
        for (disc, law) in known {
            if let Ok(sought) = self.law(&model, disc) {
                sought.is_known(law);
            }
        }
    }

    /// Begins frames for a viewer.
    pub fn view(&self, viewer: Arc<Viewer>) {
        self.inbox.send(self.number, Request::View(viewer));
    }
}

/// Commands that were accepted. Those that are not in the queue yet are put there when this is dropped.
pub struct Accepted<'l> {
    handle: &'l SessionHandle,
    batch: AcceptedBatch,
    goes_on: bool,
}

impl Accepted<'_> {
    fn go_on(&mut self) {
        let batch = &mut self.batch;
        self.goes_on = self.handle.at_intake(|intake, _| intake.go_on(batch));
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

/// The refusal of what a deleted session is asked.
pub(super) fn deleted() -> Refusal {
    Refusal::new(Reason::SessionDeleted, "session_id", "the session has been deleted")
}
