//! Admission: a session is created, started or changed only if its thread has time for its steps.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use tokio::sync::watch;

use super::audited::Audited;
use super::clock::{Dilation, now_ns};
use super::cost::{Cost, check_asked, check_work};
use super::event_log::{About, EventLog};
use super::exercise_task::{ExerciseTask, measures_bytes};
use super::law_cache::LawCache;
use super::live_exercise::{LiveExercise, SessionExercise};
use super::pacer::Pacer;
use super::playback::Playback;
use super::session_handle::SessionHandle;
use super::session_task::{SessionTask, beat_ns};
use super::slots::StreamSlots;
use super::status::{RunState, Status};
use crate::ids::random_id;
use palpate_refusal::{Reason, Refusal, Result, number};
use palpate_session::Session;
use palpate_session::budget::{Account, Purpose, Resource, Taken};
use palpate_session::chosen_exercise::ChosenExercise;
use palpate_session::felt_lump::with_noticed_pressure;
use palpate_session::input::Input;
use palpate_session::intake::Intake;
use palpate_session::schedule::Schedule;
use palpate_session::surface::Skin;
use palpate_tissue::lock::lock;
use palpate_tissue::memory;
use palpate_tissue::scene::exercise::Lump;
use palpate_tissue::scene::{Change, Scene};
use palpate_tissue::select::scheme_selection;
use palpate_tissue::{Burns, Model};

/// The state with which a saved or recorded session begins on this server ([`Pacer::resume`]).
pub struct Begin {
    /// ID of the session, which no session of this server may have.
    pub id: String,
    /// The first tissue of the session, in its first run; later changes are made from its scene.
    pub first: Arc<Model>,
    /// Whether the session's time advances. A session that has stopped for good begins held whatever this says.
    pub running: bool,
    /// The step count at which the session pauses; `None` if it has no such end.
    pub until: Option<u64>,
    /// Time without calls, held tools or streams after which the session is deleted, s.
    pub idle_timeout_s: f64,
    /// The recording that the session plays instead of commands of clients; its intake is then closed. `None` for a
    /// live session.
    pub playback: Option<Playback>,
    /// Number of the journal's run that the session continues; 0 if there is none.
    pub after_run: u64,
    /// Revision of the session's key in etcd at which this server became its owner; 0 without a fleet.
    pub revision: u64,
    /// Changes of the tissue that wait for a later step, each with that step, by ascending step.
    pub waiting: Vec<(u64, Input)>,
    /// Whether the session begins frozen, and is neither stepped nor found by [`Pacer::get`] until
    /// [`SessionHandle::arrive`].
    pub frozen: bool,
    /// Whether the session's events are written to an event log, if the server keeps journals. A playback is never
    /// recorded.
    pub recorded: bool,
    /// The exercise that the session is made for, if any; it begins with the session.
    pub exercise: Option<SessionExercise>,
}

/// A reserved ID for a new session, for [`Pacer::create_as`]. In a fleet, the ID is already this server's key in
/// etcd.
#[derive(Debug, Clone)]
pub struct SessionReservation {
    /// ID of the session, which no session of this server may have.
    pub id: String,
    /// Revision of the session's key in etcd at which this server became its owner; 0 without a fleet.
    pub revision: u64,
    /// Whether the session's events are written to an event log, if the server keeps journals.
    pub recorded: bool,
}

impl SessionReservation {
    /// Chooses a new random ID without a fleet, for a session that is recorded. Nothing is kept for it.
    ///
    /// # Errors
    /// Refuses if the system has no random numbers ([`Reason::TooMany`]).
    pub fn new() -> Result<Self> {
        Ok(SessionReservation { id: random_id()?, revision: 0, recorded: true })
    }
}

impl Pacer {
    /// Creates a session for `owner` with a new random ID, at rest at step 0. `paused`: its time does not advance
    /// before [`Pacer::start_session`]. `idle_timeout_s` is the time without use after which it is deleted, s. Blocks
    /// while the scene is compiled, unless a session has an equal one; setting `stop` cancels the call.
    ///
    /// # Errors
    /// - [`Reason::TooMany`]: `owner` has its part of the sessions, or all sessions together would have more points
    ///   than `limits.points_in_all`.
    /// - The scene is invalid or beyond the limits, or its rate is above `limits.session_rate_hz`.
    /// - [`Reason::TooLarge`]: a step would be too heavy (`limits.point_substeps_per_step`,
    ///   `limits.periods_per_step`).
    /// - [`Reason::Overloaded`]: the memory exceeds the part of `owner` or of the system; or, if time is to advance,
    ///   no stepping thread has the time left for the steps (`limits.thread_share`).
    /// - `stop` is set.
    /// - The system has no random numbers.
    pub fn create(
        &self,
        scene: &Scene,
        paused: bool,
        idle_timeout_s: f64,
        owner: &Account,
        stop: &AtomicBool,
    ) -> Result<Arc<SessionHandle>> {
        self.create_as(SessionReservation::new()?, scene, (paused, idle_timeout_s), owner, stop)
    }

    /// Creates a session for `owner` with a reserved ID, at rest at step 0. The ID must be unused: this is not
    /// checked. The pair is whether time is paused, and the time without use after which the session is deleted, s.
    /// Blocks while the scene is compiled, unless a session has an equal one; setting `stop` cancels the call.
    ///
    /// # Errors
    /// - [`Reason::TooMany`]: `owner` has its part of the sessions, or all sessions together would have more points
    ///   than `limits.points_in_all`.
    /// - The scene is invalid or beyond the limits, or its rate is above `limits.session_rate_hz`.
    /// - [`Reason::TooLarge`]: a step would be too heavy (`limits.point_substeps_per_step`,
    ///   `limits.periods_per_step`).
    /// - [`Reason::Overloaded`]: the memory exceeds the part of `owner` or of the system; or, if time is to advance,
    ///   no stepping thread has the time left for the steps (`limits.thread_share`).
    /// - `stop` is set.
    pub fn create_as(
        &self,
        reservation: SessionReservation,
        scene: &Scene,
        how: (bool, f64),
        owner: &Account,
        stop: &AtomicBool,
    ) -> Result<Arc<SessionHandle>> {
        self.create_for(None, reservation, scene, how, owner, stop)
    }

    /// Creates a session for an exercise, as [`Pacer::create_as`] does. `scene` has the exercise's truth in it.
    ///
    /// # Errors
    /// Returns the refusals of [`Pacer::create_as`], and refuses an exercise that does not fit the tissue.
    pub fn create_exercise(
        &self,
        reservation: SessionReservation,
        scene: &Scene,
        chosen: ChosenExercise,
        how: (bool, f64),
        owner: &Account,
        stop: &AtomicBool,
    ) -> Result<Arc<SessionHandle>> {
        self.create_for(Some(chosen), reservation, scene, how, owner, stop)
    }

    fn create_for(
        &self,
        chosen: Option<ChosenExercise>,
        SessionReservation { id, revision, recorded }: SessionReservation,
        scene: &Scene,
        (paused, idle_timeout_s): (bool, f64),
        owner: &Account,
        stop: &AtomicBool,
    ) -> Result<Arc<SessionHandle>> {
        // Taken before any work is done for it.
        let slot = owner.take(Resource::Sessions, 1, "")?;
        let model = self.model_of(scene, stop)?;
        let of_exercise = |chosen: ChosenExercise| {
            let plain = self.plain_of(&chosen, &model, stop)?;
            // The presses step two tissues, which are gone when the session begins.
            let pressed_bytes = if chosen.lump_to_press().is_some() { 2 * model.session_bytes() } else { 0 };
            let points_key = model.scene.body.kind().points_key();
            let _pressed = owner.take(Resource::Memory(Purpose::Session), pressed_bytes, points_key)?;
            let chosen = with_noticed_pressure(chosen, &model, &self.limits, stop);
            let chosen = chosen.map_err(|refusal| refusal.within("exercise"))?;
            Ok(SessionExercise { chosen, trainee_id: random_id()?, plain, ended: None })
        };
        let exercise = chosen.map(of_exercise).transpose()?;
        let begin = Begin {
            id,
            first: model.clone(),
            running: !paused,
            until: None,
            idle_timeout_s,
            playback: None,
            after_run: 0,
            revision,
            waiting: Vec::new(),
            frozen: false,
            recorded,
            exercise,
        };
        self.admit(begin, owner, slot, || Ok(Session::new(&model)), stop)
    }

    /// Compiles the tissue of an exercise without what it hides; `model` has it in it.
    ///
    /// # Errors
    /// Refuses a tissue that can't be compiled, missing memory, and a set `stop`.
    pub fn plain_of(&self, chosen: &ChosenExercise, model: &Arc<Model>, stop: &AtomicBool) -> Result<Arc<Model>> {
        if !chosen.exercise.hides_truth() {
            return Ok(model.clone());
        }
        self.model_of(&model.scene.without_inclusions()?, stop)
    }

    /// Compiles a scene, after checking that a server steps such scenes.
    fn model_of(&self, scene: &Scene, stop: &AtomicBool) -> Result<Arc<Model>> {
        let most_hz = self.limits.session_rate_hz;
        number("stepping.rate_hz", scene.stepping.rate_hz, &format!("at most {most_hz}"), |v| v <= most_hz)?;
        check_asked(scene, &self.limits)?;
        memory::attempt(scene.body.kind().points_key(), || self.compile(scene, stop))
    }

    /// Creates a session that continues a saved one, or plays a recording. `session` returns the saved session, and
    /// is called once the memory is taken; `begin.first` is the tissue with which the session first began. Setting
    /// `stop` cancels the call.
    ///
    /// # Errors
    /// - [`Reason::OutOfTurn`]: a session of this server has the ID.
    /// - [`Reason::TooMany`]: `owner` has its part of the sessions, or all sessions together would have more points
    ///   than `limits.points_in_all`.
    /// - [`Reason::TooLarge`]: a step would be too heavy.
    /// - [`Reason::Overloaded`]: the memory exceeds the part of `owner` or of the system; or, if time is to advance,
    ///   no stepping thread has the time left.
    /// - The refusal of `session`, and a set `stop`.
    pub fn resume(
        &self,
        begin: Begin,
        owner: &Account,
        session: impl FnOnce() -> Result<Session>,
        stop: &AtomicBool,
    ) -> Result<Arc<SessionHandle>> {
        let slot = owner.take(Resource::Sessions, 1, "")?;
        if lock(&self.sessions).contains_key(&begin.id) {
            return Err(Refusal::new(Reason::OutOfTurn, "session_id", "already belongs to a session"));
        }
        self.admit(begin, owner, slot, session, stop)
    }

    fn admit(
        &self,
        begin: Begin,
        owner: &Account,
        slot: Taken,
        session: impl FnOnce() -> Result<Session>,
        stop: &AtomicBool,
    ) -> Result<Arc<SessionHandle>> {
        let Begin {
            id,
            first,
            running,
            until,
            idle_timeout_s,
            playback,
            after_run,
            revision,
            waiting,
            frozen,
            recorded,
            exercise,
        } = begin;
        let speed = playback.as_ref().map_or(1.0, |playback| playback.speed);
        check_work(&first, &self.limits)?;
        // What refusals of memory and of so many points name.
        let points_key = first.scene.body.kind().points_key();
        let skin = memory::attempt(points_key, || Ok(Skin::of(&first)))?;
        first.shape().prepare_contact();
        let of_exercise = exercise
            .as_ref()
            .map_or(0, |exercise| exercise.plain.session_bytes() + measures_bytes(&exercise.chosen.exercise));
        let bytes = first.session_bytes() + skin.as_ref().map_or(0, |skin| skin.bytes()) + of_exercise;
        let memory = owner.take(Resource::Memory(Purpose::Session), bytes, points_key)?;
        // Allocated before the lock is taken, which every call needs.
        let mut session = memory::attempt(points_key, session)?;
        session.time_stages(self.measures_stages.load(Ordering::Relaxed).then_some(now_ns));
        let (model, step) = (session.model().clone(), session.step_count());
        let running = running && session.hold_reason().is_none();
        let number = {
            let mut numbers = lock(&self.numbers);
            *numbers += 1;
            *numbers
        };
        let begin_ns = beat_ns(now_ns());
        let status = Status {
            state: if running { RunState::Running } else { RunState::Paused },
            step,
            resting: false,
            rested_steps: 0,
            overrun_count: 0,
            dilation: Dilation::new(begin_ns, step),
            schedule: Schedule::new(step, begin_ns, speed * first.scene.stepping.rate_hz),
            late_commands: 0,
            paused_commands: 0,
            hold_reason: None,
            guard_events: 0,
            recovery_count: 0,
            recoveries: Vec::new(),
            cuts: session.tissue().cuts(),
            burns: session.tissue().burns(),
            ties: session.tissue().ties(),
            awake_points: 0,
            path_counts: [0; 3],
            stages: Vec::new(),
            lapsed_leases: 0,
            model: model.clone(),
        };
        let (cost, thread) = self.place(&model, !running, owner)?;
        let stepper = &self.steppers[thread];
        let changed_to = (!Arc::ptr_eq(&model, &first)).then(|| model.clone());
        let mut intake = Intake::new(&first.scene, &self.limits)
            .of_substeps(first.plan.substeps)
            .charged_to(owner)
            .of_cut_bytes(first.cut_bytes() + Burns::most_bytes(&first))
            .continued(&session, changed_to);
        if first.scene.cutting.tear_strain.is_some() || !session.tissue().cuts().is_empty() {
            intake.charge_cuts(points_key)?;
        }
        if let Some(reason) = session.hold_reason() {
            drop(intake.close(Refusal::new(Reason::SessionHeld, "", reason)));
        }
        if playback.is_some() {
            let message = "this session plays a recording; to touch the tissue, begin a session at one of its moments (CreateSession)";
            drop(intake.close(Refusal::new(Reason::NotAvailable, "session_id", message)));
        }
        let ended = exercise.as_ref().and_then(|exercise| exercise.ended.clone()).map(Arc::new);
        let exercise = exercise.map(|exercise| Arc::new(LiveExercise::new(exercise, step)));
        let measured = exercise.as_ref().filter(|_| ended.is_none());
        let measuring = measured.map(|live| ExerciseTask::new(live, &session).map(Box::new)).transpose()?;
        let about = || About {
            id: id.clone(),
            owner: owner.name().to_owned(),
            idle_timeout_s,
            first: first.clone(),
            begin_step: step,
            running,
            until_step: until,
            after_run,
            revision,
            exercise: exercise.as_ref().map(|live| (live.chosen.clone(), live.trainee_id.clone())),
        };
        // A playback is already recorded.
        let event_log =
            self.event_logs.get().filter(|_| recorded && playback.is_none()).map(|queue| EventLog::new(queue, about()));
        let handle = Arc::new(SessionHandle {
            id: id.clone(),
            rules: intake.rules(),
            intake: Mutex::new(intake),
            owner: owner.clone(),
            idle_timeout_s,
            revision: AtomicU64::new(revision),
            is_coming: AtomicBool::new(frozen),
            asked_ns: AtomicU64::new(now_ns()),
            number,
            limits: self.limits.clone(),
            status: Mutex::new(status),
            streams: Mutex::new(StreamSlots::new(&self.limits)),
            refused: AtomicU64::new(0),
            laws: LawCache::default(),
            tissue: watch::Sender::new((step, model)),
            audited: Mutex::new(Audited::default()),
            model: first,
            skin,
            cost,
            thread: AtomicUsize::new(thread),
            inbox: stepper.inbox.clone(),
            event_log,
            exercise,
            playback,
            slot: Mutex::new(slot),
            _memory: memory,
        });
        // This is the first event of its journal.
        if !waiting.is_empty() {
            handle.adopt_waiting(waiting);
        }
        let mut running =
            memory::attempt(points_key, || Ok(Box::new(SessionTask::new(handle.clone(), session, running))))?;
        running.until = until;
        running.frozen = frozen;
        running.exercise = measuring;
        // The next run of the journal needs it as well.
        ended.into_iter().for_each(|ended| running.note_input(Input::ExerciseEnded(ended)));
        running.publish_status();
        if stop.load(Ordering::Relaxed) {
            return Err(scheme_selection::given_up());
        }
        let mut sessions = lock(&self.sessions);
        let points: usize = sessions.values().map(|handle| handle.model.len()).sum();
        if points + handle.model.len() > self.limits.points_in_all {
            let message = format!("the sessions of the server already have {points} points");
            return Err(Refusal::new(Reason::TooMany, points_key, message));
        }
        if let Some(exercise) = &handle.exercise {
            lock(&self.trainees).insert(exercise.trainee_id.clone(), id.clone());
        }
        sessions.insert(id, handle.clone());
        // No caller can name the session before this, so every request to it comes after this.
        stepper.adopt(number, running);
        Ok(handle)
    }

    /// Returns the compiled model of a scene. Sessions of equal scenes share one in memory, which is compiled once.
    fn compile(&self, scene: &Scene, stop: &AtomicBool) -> Result<Arc<Model>> {
        let known = lock(&self.sessions)
            .values()
            .flat_map(|handle| [Some(&handle.model), handle.exercise.as_ref().map(|exercise| &exercise.plain)])
            .flatten()
            .find(|model| model.scene == *scene)
            .cloned();
        known.map_or_else(|| Model::compile_until(scene, &self.limits, stop), Ok)
    }

    /// Returns the estimated cost of a further session of `owner`, and the index of the thread with the most time
    /// left.
    fn place(&self, model: &Model, paused: bool, owner: &Account) -> Result<(Cost, usize)> {
        let sessions = lock(&self.sessions);
        // Sessions on `step-apart` are not typical for a new one.
        let known = sessions.values().filter(|handle| handle.thread() < self.steppers.len());
        let cost = Cost::guess(model, known.map(|handle| &handle.cost));
        let mut taken = vec![(0.0, 0_usize); self.steppers.len()];
        for handle in sessions.values() {
            // Sessions on `step-apart` take no time of these threads.
            if let Some(taken) = taken.get_mut(handle.thread()) {
                taken.0 += handle.cost.share();
                taken.1 += 1;
            }
        }
        let spare =
            |a: &(usize, &(f64, usize)), b: &(usize, &(f64, usize))| a.1.0.total_cmp(&b.1.0).then(a.1.1.cmp(&b.1.1));
        let thread = taken.iter().enumerate().min_by(spare).map_or(0, |(thread, _)| thread);
        if !paused {
            let beside = self.taken_beside(sessions.values().filter(|handle| handle.thread() == thread), owner);
            self.check_share(beside, cost.awake_share())?;
        }
        Ok((cost, thread))
    }

    /// Changes the tissue of a session as [`SessionHandle::change`] does, if its thread has the time for the new
    /// steps. Returns the step from which it acts, and the new tissue. Blocks while the tissue is compiled.
    ///
    /// # Errors
    /// Returns the refusals of [`SessionHandle::change`], and refuses a change with more substeps that would make
    /// other sessions of the thread late ([`Reason::Overloaded`]).
    pub fn change_tissue(
        &self,
        handle: &SessionHandle,
        change: &Change,
        at_step: Option<u64>,
        stop: &AtomicBool,
    ) -> Result<(u64, Arc<Model>)> {
        handle.change(change, at_step, |needed| self.check_share(self.taken_by_others(handle), needed), stop)
    }

    /// Adds a lump to the tissue of a session as [`SessionHandle::add_lump`] does, if its thread has the time for the new steps. Blocks
    /// while the tissue is compiled.
    ///
    /// # Errors
    /// Returns the refusals of [`SessionHandle::add_lump`], and refuses as [`Pacer::change_tissue`] does.
    pub fn add_lump(
        &self,
        handle: &SessionHandle,
        lump: impl Fn(&[Lump]) -> Result<Lump>,
        stop: &AtomicBool,
    ) -> Result<(u64, Arc<Model>)> {
        handle.add_lump(lump, |needed| self.check_share(self.taken_by_others(handle), needed), stop)
    }

    /// Returns the fraction of a session's thread that other awake sessions take.
    fn taken_by_others(&self, handle: &SessionHandle) -> f64 {
        let thread = handle.thread();
        // Sessions on `step-apart` may be late.
        if thread == self.steppers.len() {
            return 0.0;
        }
        let others = |other: &&Arc<SessionHandle>| other.thread() == thread && other.number != handle.number;
        self.taken_beside(lock(&self.sessions).values().filter(others), &handle.owner)
    }

    /// Returns the fraction of a thread that these sessions take from a further one of `owner`. Another caller
    /// counts with at most its equal part, because the thread gives it no more if `owner` needs its own; what it
    /// takes beyond that delays only that caller's sessions.
    fn taken_beside<'a>(&self, sessions: impl Iterator<Item = &'a Arc<SessionHandle>>, owner: &Account) -> f64 {
        let mut by_owner = BTreeMap::from([(owner.number(), 0.0)]);
        for handle in sessions {
            *by_owner.entry(handle.owner.number()).or_default() += handle.cost.share();
        }
        fairly_taken(&by_owner, owner.number(), self.limits.thread_share)
    }

    /// Refuses a session that would make others late. A session alone on its thread delays no other, however heavy;
    /// and a session at rest takes nothing.
    fn check_share(&self, taken: f64, needed: f64) -> Result<()> {
        let most = self.limits.thread_share;
        if taken == 0.0 || taken + needed <= most {
            return Ok(());
        }
        let message = format!(
            "the other sessions of the stepping thread take {taken:.3} of it, and this one would take \
             {needed:.3}: above the {most} that sessions may take (limits.thread_share)"
        );
        Err(Refusal::new(Reason::Overloaded, "", message))
    }

    /// Starts a session's time as [`SessionHandle::start`] does, unless it is paused and its steps would make other
    /// sessions of its thread late. Returns the number of the next step.
    ///
    /// # Errors
    /// Returns the refusals of [`SessionHandle::start`], and refuses steps for which the thread has no time left
    /// ([`Reason::Overloaded`], `limits.thread_share`).
    pub async fn start_session(&self, handle: &SessionHandle, until: Option<u64>) -> Result<u64> {
        if lock(&handle.status).state == RunState::Paused {
            self.check_share(self.taken_by_others(handle), handle.cost.awake_share())?;
        }
        handle.start(until).await
    }
}

/// Returns the sum of the fractions that callers, by their numbers, take of a thread. Each caller but `owner`
/// counts with at most an equal part of `most`.
#[allow(clippy::cast_precision_loss)]
fn fairly_taken(by_owner: &BTreeMap<u64, f64>, owner: u64, most: f64) -> f64 {
    let callers = by_owner.iter().filter(|(number, taken)| **number == owner || **taken > 0.0).count();
    let part = most / callers.max(1) as f64;
    by_owner.iter().map(|(number, taken)| if *number == owner { *taken } else { taken.min(part) }).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn another_caller_counts_with_its_part_at_most() {
        let taken = |others: &[f64]| {
            let mut by_owner = BTreeMap::from([(0, 0.1)]);
            by_owner.extend((1..).zip(others.iter().copied()));
            fairly_taken(&by_owner, 0, 0.8)
        };
        assert!((taken(&[]) - 0.1).abs() < 1e-12);
        // A caller that takes less than its part counts in full, and one at rest does not divide the thread.
        assert!((taken(&[0.3, 0.0]) - 0.4).abs() < 1e-12);
        assert!((taken(&[0.75, 0.0]) - 0.5).abs() < 1e-12);
        assert!((taken(&[0.75, 0.1]) - (0.1 + 0.8 / 3.0 + 0.1)).abs() < 1e-12);
    }
}
