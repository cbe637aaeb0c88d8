//! A session as the server's calls use it: requests to its stepping thread, and its intake.

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use tokio::sync::{oneshot, watch};

use super::audited::Audited;
use super::clock::now_ns;
use super::cost::{Cost, check_work};
use super::event_log::{Event, EventLog};
use super::frames::Viewer;
use super::inbox::{Inbox, Present, Request};
use super::law_cache::{LawCache, SoughtLaw};
use super::live_exercise::{ExerciseNews, LiveExercise};
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
use palpate_session::input::Input;
use palpate_session::intake::Intake;
use palpate_session::intake_transfer::Handed;
use palpate_session::lease::LeaseId;
use palpate_session::measured_run::EndedExercise;
use palpate_session::rules::{Commands, Rules};
use palpate_session::sample_selection::PacedSample;
use palpate_session::sample_selection::{HEARTBEAT_S, Sampler, Sampling};
use palpate_session::surface::Skin;
use palpate_tissue::limits::Limits;
use palpate_tissue::lock::lock;
use palpate_tissue::memory;
use palpate_tissue::response::force_law::Disc;
use palpate_tissue::scene::Change;
use palpate_tissue::scene::exercise::Lump;
use palpate_tissue::scene::record::{Point, ToolRecord};
use palpate_tissue::shape::PointId;
use palpate_tissue::{Cuts, Model};

/// Handle of a session for the server's calls, which any thread may use. Its stepping thread owns the session
/// itself.
pub struct SessionHandle {
    /// ID of the session; random, so that it can't be guessed.
    pub id: String,
    /// The first tissue of the session. Its points and its rate stay; coefficients, scheme and substeps may have
    /// changed since ([`Status::model`]).
    pub model: Arc<Model>,
    /// Surface by which frames show the tissue, if it is a mesh; `None` for a sheet.
    pub skin: Option<Arc<Skin>>,
    /// Account of the caller that created the session, which is charged for it and its commands.
    pub owner: Account,
    /// Rules of its intake, which checks commands without a lock.
    pub(super) rules: Arc<Rules>,
    pub(super) intake: Mutex<Intake>,
    /// Time without calls, held tools or streams after which [`Pacer::delete_idle`](super::Pacer::delete_idle)
    /// deletes the session, s.
    pub idle_timeout_s: f64,
    /// Revision of the session's key in etcd at which this server became its owner; 0 without a fleet.
    pub(super) revision: AtomicU64,
    /// Whether it is being handed over to this server, which is not its owner yet.
    pub(super) is_coming: AtomicBool,
    pub(super) asked_ns: AtomicU64,
    pub(super) number: u64,
    pub(super) limits: Limits,
    pub(super) status: Mutex<Status>,
    pub(super) streams: Mutex<StreamSlots>,
    pub(super) refused: AtomicU64,
    pub(super) laws: LawCache,
    pub(super) tissue: watch::Sender<(u64, Arc<Model>)>,
    pub(super) cost: Cost,
    pub(super) audited: Mutex<Audited>,
    /// Index of its stepping thread; `step-apart` comes after the last.
    pub(super) thread: AtomicUsize,
    /// Inbox of the thread that it began on, which passes requests on if the session has moved.
    pub(super) inbox: Arc<Inbox>,
    /// The exercise that the session is made for; `None` for any other session.
    pub exercise: Option<Arc<LiveExercise>>,
    /// The recording that the session plays; `None` for a live session.
    pub playback: Option<Playback>,
    /// Event log for the session's journal; `None` if the server keeps no journals or does not record this session.
    pub event_log: Option<Arc<EventLog>>,
    /// Its place in the limit on sessions, freed when it is deleted, even if readers remain.
    pub(super) slot: Mutex<Taken>,
    /// Its memory, charged until the last reader is gone.
    pub(super) _memory: Taken,
}

impl SessionHandle {
    /// Returns the present status, as of the last step or request. For a session at rest it counts the steps that are
    /// due by now, without computing them. It does not wait for the stepping thread.
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

    /// Returns the index of its stepping thread.
    pub(super) fn thread(&self) -> usize {
        self.thread.load(Ordering::Relaxed)
    }

    /// Returns the speed of its time: other than 1 only for a playback.
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

    /// Runs `act` on the session's intake, with the time in ns of the clock of stepping, and returns its result.
    /// First it ends the leases that have expired, and afterwards it wakes a session at rest if `act` requires
    /// that. `act` runs under the intake's lock and must be short.
    pub fn at_intake<T>(&self, act: impl FnOnce(&mut Intake, u64) -> T) -> T {
        let mut intake = lock(&self.intake);
        let now = now_ns();
        intake.release_expired(now);
        let answer = act(&mut intake, now);
        let wake = intake.take_wake();
        drop(intake);
        if wake {
            self.inbox.send(self.number, Request::Wake);
        }
        answer
    }

    /// Accepts all of `commands` from the holder of `lease`, or none, renews the lease, and puts the first slice of
    /// them in the queue. [`Accepted::taken_in`] puts in the rest.
    ///
    /// # Errors
    /// Returns the refusals of [`Rules::check`](palpate_session::rules::Rules::check) (too many commands, an action
    /// that breaks a rule) and of [`Intake::accept`] (a session that is held, deleted or a playback; tools of other
    /// leases; an unfinished batch; sequence numbers that do not rise; tips; a full queue; missing memory).
    pub fn submit(&self, lease: LeaseId, commands: impl Into<Commands>) -> Result<Accepted<'_>> {
        let checked = self.rules.check(commands)?;
        self.at_intake(|intake, now| {
            let mut batch = intake.accept(lease, checked, now)?;
            let goes_on = intake.go_on(&mut batch);
            Ok(Accepted { handle: self, batch, goes_on })
        })
    }

    /// Returns the revision in etcd at which this server became the session's owner, or last confirmed that it is; 0
    /// without a fleet.
    pub fn revision(&self) -> u64 {
        self.revision.load(Ordering::Acquire)
    }

    /// Sets the revision at which this server became the session's owner or confirmed that it is. A lower revision
    /// is ignored.
    pub fn set_owned_since(&self, revision: u64) {
        self.revision.fetch_max(revision, Ordering::AcqRel);
    }

    /// Adds `commands` to the number of refused commands, which [`SessionHandle::refused`] returns.
    pub fn count_refused(&self, commands: usize) {
        self.refused.fetch_add(commands as u64, Ordering::Relaxed);
    }

    /// Returns a copy of the results of audits so far on this server.
    pub fn audited(&self) -> Audited {
        lock(&self.audited).clone()
    }

    /// Returns the number of refused commands so far, as [`SessionHandle::count_refused`] counted them.
    pub fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }

    async fn ask<T>(&self, request: impl FnOnce(oneshot::Sender<Result<T>>) -> Request) -> Result<T> {
        let (reply, answer) = oneshot::channel();
        self.inbox.send(self.number, request(reply));
        answer.await.unwrap_or_else(|_| Err(deleted()))
    }

    /// Starts time, without end or until `until` steps are done, when the thread serves the request. If time advances
    /// already, only its end changes. Returns the number of the next step, which is that of steps done.
    ///
    /// # Errors
    /// Refuses a session that is held ([`Reason::SessionHeld`]) or deleted ([`Reason::SessionDeleted`]), and an
    /// `until` that is not above the steps done ([`Reason::StepPassed`]).
    pub async fn start(&self, until: Option<u64>) -> Result<u64> {
        self.ask(|reply| Request::Start { until, reply }).await
    }

    /// Changes the tissue from the beginning of step `at_step` on, or of the next step if that is later or `at_step`
    /// is `None`. Returns that step and the new tissue. The tissue is compiled in the calling thread, which takes
    /// some milliseconds; no step waits for that. If another change comes first, this one is applied to its result.
    /// Setting `stop` cancels the call.
    ///
    /// `admit` gets the fraction of its thread that the session would take, if the change needs more substeps, and
    /// decides whether the thread has that left.
    ///
    /// # Errors
    /// - The change is invalid, or beyond the limits.
    /// - [`Reason::TooLarge`]: its steps are too heavy.
    /// - The refusals of `admit` and of [`Intake::change`] (closed intake, a waiting change with a later step, too
    ///   many waiting changes, missing memory).
    /// - `stop` is set.
    pub fn change(
        &self,
        change: &Change,
        at_step: Option<u64>,
        admit: impl Fn(f64) -> Result<()>,
        stop: &AtomicBool,
    ) -> Result<(u64, Arc<Model>)> {
        let changed = |now: &Model| now.changed_until(change, &self.model.scene, &self.limits, stop);
        self.exchange_tissue(changed, at_step, admit)
    }

    /// Adds a lump to the tissue from the beginning of the next step on, as [`SessionHandle::change`] changes it. `lump` chooses it,
    /// from those that were added before. Returns that step and the new tissue, whose last added lump it is.
    ///
    /// # Errors
    /// Returns the refusals of `lump`, of [`Model::with_lump_until`] and of [`SessionHandle::change`].
    pub fn add_lump(
        &self,
        lump: impl Fn(&[Lump]) -> Result<Lump>,
        admit: impl Fn(f64) -> Result<()>,
        stop: &AtomicBool,
    ) -> Result<(u64, Arc<Model>)> {
        let with_lump = |now: &Model| now.with_lump_until(&lump(&now.scene.added_lumps)?, &self.limits, stop);
        self.exchange_tissue(with_lump, None, admit)
    }

    /// Exchanges the tissue for the one that `make` makes of it, from the beginning of step `at_step` on.
    fn exchange_tissue(
        &self,
        make: impl Fn(&Model) -> Result<Arc<Model>>,
        at_step: Option<u64>,
        admit: impl Fn(f64) -> Result<()>,
    ) -> Result<(u64, Arc<Model>)> {
        loop {
            let base = self.at_intake(|intake, _| intake.changed_to());
            let now = base.as_ref().unwrap_or(&self.model);
            let model = memory::attempt("", || make(now))?;
            check_work(&model, &self.limits)?;
            // The stepping thread allocates the fields of the new scheme, and a checkpoint.
            memory::check(2 * model.state_bytes(), "another tissue")?;
            let (before, after) = (lock(&self.status).model.plan.substeps, model.plan.substeps);
            if after > before {
                admit(self.cost.awake_share() * f64::from(after) / f64::from(before))?;
            }
            // If another change came first, this one is applied to its result.
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

    /// Adopts the changes of the tissue that waited for their step on the server that had the session before, each
    /// with that step, by ascending step. Changes for which there is no memory are dropped, with a warning in the
    /// log.
    pub fn adopt_waiting(&self, waiting: Vec<(u64, Input)>) {
        let handed = Handed { leases: Vec::new(), waiting };
        let dropped = self.at_intake(|intake, now| {
            let dropped = intake.adopt(handed, now);
            self.note_waiting(intake);
            dropped
        });
        if dropped > 0 {
            tracing::warn!(session = %self.id, dropped, "no memory for some waiting changes of the tissue");
        }
    }

    /// Writes the waiting changes of the tissue to the event log, so that a session keeps them after a crash.
    pub(super) fn note_waiting(&self, intake: &Intake) {
        if let Some(event_log) = &self.event_log {
            event_log.note(intake.next_step(), Event::Waiting(intake.waiting_changes()));
        }
    }

    /// Revives a held session: it continues at the step at which it was held, paused, with its tissue at rest and all
    /// leases ended. Its counts begin again. Returns that step. The cause of the failure may occur again.
    ///
    /// # Errors
    /// Refuses a session that is not held ([`Reason::OutOfTurn`]) or that is deleted ([`Reason::SessionDeleted`]),
    /// and if there is no memory.
    pub async fn revive(&self) -> Result<u64> {
        self.ask(|reply| Request::Revive { reply }).await
    }

    /// Waits for the stepping thread and returns a copy of the present state, from which a session can continue.
    ///
    /// # Errors
    /// Refuses a session that is deleted ([`Reason::SessionDeleted`]), and if the system has no memory for the copy.
    pub async fn save(&self) -> Result<Present> {
        self.ask(Request::Save).await
    }

    /// Stops stepping until [`SessionHandle::thaw`], and returns a copy of the present state. Requests are still
    /// served. Freezing changes no bits of the session.
    ///
    /// # Errors
    /// Refuses a session that is deleted ([`Reason::SessionDeleted`]), and if the system has no memory for the copy;
    /// then the session is not frozen.
    pub async fn freeze(&self) -> Result<Present> {
        self.ask(Request::Freeze).await
    }

    /// Makes this server the owner of a session that was handed over frozen
    /// ([`Begin::frozen`](super::Begin::frozen)): `revision` is that of its key in etcd. The session is stepped and
    /// served from now on.
    pub fn arrive(&self, revision: u64) {
        self.set_owned_since(revision);
        self.is_coming.store(false, Ordering::Release);
        self.thaw();
    }

    /// Returns whether the session is being handed over to this server, which is not its owner yet.
    pub fn is_coming(&self) -> bool {
        self.is_coming.load(Ordering::Acquire)
    }

    /// Returns the measured fraction of a core that the session's steps take while they are computed; 0 at rest or
    /// paused. Before the first steps it is an estimate.
    pub fn share(&self) -> f64 {
        self.cost.share()
    }

    /// Resumes stepping after [`SessionHandle::freeze`], when the thread serves the request; otherwise it has no
    /// effect.
    pub fn thaw(&self) {
        self.inbox.send(self.number, Request::Thaw);
    }

    /// Pauses the session's time, when the thread serves the request. Streams of samples get the present one. A
    /// session that is paused or held stays so.
    ///
    /// # Errors
    /// Refuses a session that is deleted ([`Reason::SessionDeleted`]).
    pub async fn pause(&self) -> Result<()> {
        self.ask(|reply| Request::Pause { reply }).await
    }

    /// Waits until `at` steps are done; `None` stands for now. Returns the step count and the hash of the state
    /// there. `account` is charged for the time of reading and, for a large tissue, for the memory of a copy. It
    /// waits for as long as time is paused before that step.
    ///
    /// # Errors
    /// - [`Reason::StepPassed`]: more than `at` steps are done.
    /// - [`Reason::SessionHeld`] or [`Reason::SessionDeleted`], also while it waits. A hash of the step at which a
    ///   session is held is returned.
    /// - [`Reason::Overloaded`]: the caller has used up its part of the reading time, or there is no memory.
    pub async fn hash_at(&self, at: Option<u64>, account: &Account) -> Result<(u64, u128)> {
        let account = account.clone();
        self.ask(|reply| Request::Hash { at, account, reply }).await
    }

    /// Opens a stream of samples and returns its reader. A full queue (`limits.queued_samples`) drops its oldest
    /// sample. `sampling` must have been checked. If time is paused, the present sample comes at once. For a held
    /// session the stream ends with [`Reason::SessionHeld`] after the present sample.
    ///
    /// The stepping thread's time is charged to `watcher`, which gets no sample while its part of that time is used
    /// up, except the last before a pause; `None` stands for the stream of a client that holds a tool.
    pub fn samples(&self, sampling: Sampling, watcher: Option<&Account>) -> Reader<PacedSample> {
        self.tap(sampling, watcher, false)
    }

    /// Waits for the next sample of the tools `only`, in their order, without local models; returns the present
    /// sample if time is paused.
    ///
    /// # Errors
    /// Refuses a session that is deleted, or that is held while it waits.
    pub async fn next_sample(&self, only: Vec<u32>) -> Result<PacedSample> {
        let (laws, touch_stiffness) = (None, false);
        let sampling = Sampling {
            every: 1,
            only: Some(only),
            deadband: None,
            heartbeat_s: HEARTBEAT_S,
            laws,
            touch_stiffness,
            other_tools: false,
            wanted: None,
        };
        Ok(self.tap(sampling, None, true).pop().await?.0)
    }

    fn tap(&self, sampling: Sampling, watcher: Option<&Account>, once: bool) -> Reader<PacedSample> {
        let (writer, reader) = queue(if once { 1 } else { self.limits.queued_samples });
        let sampler = Sampler::new(sampling, self.model.scene.stepping.rate_hz);
        let tap = SampleTap { sampler, once, writer, watcher: watcher.cloned(), overrun_count: 0 };
        self.inbox.send(self.number, Request::Samples(Box::new(tap)));
        reader
    }

    /// Opens a stream of records and returns its reader: of `points` in their order, or of all for `None`, whenever
    /// the step count is a multiple of `every` (at least 1), with the tissue's energies if `energy` and with the
    /// states of tools led by poses if `tools`. The points must be those of the tissue. Time and memory are charged
    /// to `account`. A record for which it has neither, or for which the reader is too late (`limits.queued_bytes`,
    /// `limits.queued_records`), is left out and counted as dropped.
    ///
    /// # Errors
    /// Refuses if the system has no memory for a record. A held session ends the stream with [`Reason::SessionHeld`].
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

    /// Ends the exercise that the session is made for, unless it has ended, and returns its result.
    ///
    /// # Errors
    /// Refuses a session without an exercise ([`Reason::UnknownExercise`]), and one that is deleted or held for good meanwhile.
    pub async fn finish_exercise(&self) -> Result<Arc<EndedExercise>> {
        let news = self.live_exercise()?.news();
        self.end(Request::FinishExercise, news, |_| false).await?.ok_or_else(deleted)
    }

    /// Asks for an end of the exercise or of a phase, and waits until the exercise has ended or `is_done`. Returns the result of an exercise
    /// that has ended.
    async fn end(
        &self,
        request: Request,
        mut news: watch::Receiver<ExerciseNews>,
        is_done: impl Fn(&ExerciseNews) -> bool,
    ) -> Result<Option<Arc<EndedExercise>>> {
        self.inbox.send(self.number, request);
        let told = news.wait_for(|news| news.ended.is_some() || news.closed.is_some() || is_done(news)).await;
        let told = told.map_err(|_| deleted())?;
        match (&told.ended, &told.closed) {
            (None, Some(why)) => Err(why.clone()),
            (ended, _) => Ok(ended.clone()),
        }
    }

    /// Ends a phase of the exercise that the session is made for (from 1), unless it has ended. Returns the exercise's result if that has
    /// ended, as it does with the last phase.
    ///
    /// # Errors
    /// Refuses what [`SessionHandle::finish_exercise`] refuses, a phase that the exercise does not have ([`Reason::OutOfRange`]), and one
    /// that has not begun ([`Reason::OutOfTurn`]).
    pub async fn finish_phase(&self, phase: u32) -> Result<Option<Arc<EndedExercise>>> {
        let live = self.live_exercise()?;
        let news = live.news();
        let count = live.chosen.exercise.phases.len();
        if phase == 0 || phase as usize > count {
            let message = format!("{phase} is no phase of the exercise, which has {count}");
            return Err(Refusal::new(Reason::OutOfRange, "phase", message));
        }
        let (begun, has_ended) = (news.borrow().phase, live.has_ended());
        if !has_ended && phase > begun {
            let message = format!("{phase} has not begun: phase {begun} goes on");
            return Err(Refusal::new(Reason::OutOfTurn, "phase", message));
        }
        self.end(Request::FinishPhase(phase), news, |news| news.phase > phase).await
    }

    /// Returns the exercise that the session is made for.
    ///
    /// # Errors
    /// Refuses a session without one ([`Reason::UnknownExercise`]).
    pub fn live_exercise(&self) -> Result<&Arc<LiveExercise>> {
        self.exercise.as_ref().ok_or_else(|| {
            Refusal::new(Reason::UnknownExercise, "session_id", "is a session that is not made for an exercise")
        })
    }

    /// Returns a receiver of the step from whose beginning the present tissue acts and of that tissue. It has the
    /// present value, and is updated when a change takes effect.
    pub fn tissue(&self) -> watch::Receiver<(u64, Arc<Model>)> {
        self.tissue.subscribe()
    }

    /// Returns the force law of `model`, a tissue of this session, with these cuts under a disc, with up to `limits.law_work` for the
    /// exact one. It computes nothing; see [`SoughtLaw`].
    ///
    /// # Errors
    /// Refuses if the memory of a further law exceeds the part of the session's owner or of the system.
    pub fn law(&self, model: &Arc<Model>, cuts: &Cuts, disc: Disc) -> Result<Arc<SoughtLaw>> {
        self.laws.of(disc, model, cuts, self.limits.law_work, &self.owner)
    }

    /// Returns the force law of the tissue without what the session's exercise hides, as [`SessionHandle::law`] does.
    ///
    /// # Errors
    /// Refuses a session without an exercise, and if the memory of a further law exceeds the part of the session's owner or of the
    /// system.
    pub fn plain_law(&self, cuts: &Cuts, disc: Disc) -> Result<Arc<SoughtLaw>> {
        self.live_exercise()?.plain_law(cuts, disc, &self.limits, &self.owner)
    }

    /// Returns the force laws of the present tissue that have been computed so far, each with its disc; the most
    /// recently requested is the last.
    pub fn known_laws(&self) -> Vec<(Disc, Arc<Law>)> {
        let model = self.tissue.borrow().1.clone();
        self.laws.known(&model)
    }

    /// Adds force laws of the present tissue that another server has computed. A law for which there is no memory
    /// is left out; it is computed when it is needed.
    pub fn adopt_laws(&self, known: Vec<(Disc, Law)>) {
        let model = self.tissue.borrow().1.clone();
        for (disc, law) in known {
            if let Ok(sought) = self.law(&model, &Cuts::default(), disc) {
                sought.add_known(law);
            }
        }
    }

    /// Adds a viewer: it is sent a full frame of the present state and then further frames.
    /// [`Pacer::add_viewer`](super::Pacer::add_viewer) also makes it known by its ID.
    pub fn view(&self, viewer: Arc<Viewer>) {
        self.inbox.send(self.number, Request::View(viewer));
    }
}

/// Commands that [`SessionHandle::submit`] accepted, of which the first slice is in the queue. Dropping this puts
/// those that remain in the queue, in the calling thread.
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

    /// Puts the remaining commands in the queue, slice by slice. It yields between slices to other tasks and the
    /// stepping thread. If it is cancelled, the rest is put in at once.
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

/// Returns the refusal of a request to a deleted session.
pub(super) fn deleted() -> Refusal {
    Refusal::new(Reason::SessionDeleted, "session_id", "the session has been deleted")
}
