//! A session on its stepping thread: its schedule, the requests to it, and its steps.
//!
//! Rest: while a whole tissue is asleep and no command waits, its steps change nothing but their number. Then only
//! the steps are done that a reader waits for (a heartbeat, a record, a hash). The steps between are skipped, all
//! at once, when the next is due. A session without such a step has no due time in the run queue, and a thread
//! whose sessions are all so sleeps until a request arrives. Commands that arrive meanwhile get the step that they
//! would have had without the rest ([`Intake::rest`](palpate_session::intake::Intake::rest)), and wake the thread.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::SyncSender;

use super::clock::{Dilation, now_ns};
use super::event_log::Event;
use super::exercise_task::ExerciseTask;
use super::fence::Fence;
use super::frames::Encoder;
use super::inbox::{Inbox, Leaving, Present, Request};
use super::playback::Next;
use super::policy::{Longest, StepWatch, Turn, dropped_steps};
use super::queue::Wakes;
use super::reading::{Copies, Hashed, Reading};
use super::recorder::Recorder;
use super::session_handle::SessionHandle;
use super::subscribers::{Subscribers, ViewTap};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::Session;
use palpate_session::command::Due;
use palpate_session::input::Input;
use palpate_session::local_model::StiffnessJob;
use palpate_session::schedule::Schedule;
use palpate_tissue::Model;
use palpate_tissue::lock::lock;
use palpate_tissue::memory;
use palpate_tissue::select::audit::Mark;

/// Sessions begin at a multiple of this time, ns: so a thread wakes once for all sessions of one rate, and so do
/// the network threads for their samples.
const BEAT_NS: u64 = 1_000_000;

/// One step in this number is a span in the log, at level debug.
const STEPS_PER_SPAN: u64 = 1024;

/// Time limit of a repetition by the guard, ns, after which other sessions of the thread have their turn. A
/// repetition may take many times as long as a step.
const MAX_REPETITION_NS: u64 = if cfg!(test) { 0 } else { 500_000 };

/// Rate at which the stiffness under tools is recomputed, Hz.
const REFINED_HZ: f64 = 50.0;

/// Time that a playback waits for inputs that have not been read yet, s.
const RECORD_WAIT_S: f64 = 0.01;

/// A session with its schedule and its readers, as its stepping thread owns it.
pub(super) struct SessionTask {
    pub(super) handle: Arc<SessionHandle>,
    pub(super) session: Session,
    pub(super) running: bool,
    pub(super) until: Option<u64>,
    pub(super) schedule: Schedule,
    /// The next step to do. At rest, the steps before it are skipped; `u64::MAX` if there is none.
    pub(super) next_step: u64,
    /// Time at which the newest step was due, before a backlog was dropped, ns.
    pub(super) due_ns: u64,
    /// Time before which it is not stepped, ns, because it was late and takes more than its part.
    not_before_ns: u64,
    /// Step count at which all points fell asleep, if they still are.
    pub(super) still_since: Option<u64>,
    pub(super) rested_steps: u64,
    pub(super) overrun_count: u64,
    pub(super) lapsed_leases: u64,
    pub(super) dilation: Dilation,
    pub(super) due: Vec<Due>,
    pub(super) hashed: Hashed,
    pub(super) copies: Copies,
    pub(super) subscribers: Subscribers,
    /// Receiver of the marks of the audit that was requested.
    pub(super) audit: Option<SyncSender<Mark>>,
    /// Writer of the event log, if there is one.
    pub(super) recorder: Option<Recorder>,
    /// The measuring of the session's exercise, if it is made for one.
    pub(super) exercise: Option<Box<ExerciseTask>>,
    /// Whether it is being handed over: then no step is done unless the handover fails.
    pub(super) frozen: bool,
    pub(super) watch: StepWatch,
    /// Inbox of the thread that has the session; it holds the thread's counters.
    pub(super) inbox: Arc<Inbox>,
    /// Whether the session is to move to the thread of lower priority.
    pub(super) goes_apart: bool,
    left: bool,
    /// Requests that arrived within an unfinished step, oldest first.
    waiting: VecDeque<Request>,
}

/// Resources that all sessions of a thread use.
pub(super) struct ThreadContext<'t> {
    pub(super) fence: &'t Fence,
    pub(super) encoder: &'t Encoder,
    pub(super) refiner: &'t SyncSender<StiffnessJob>,
    pub(super) reading: &'t Reading,
    pub(super) wakes: Wakes,
    pub(super) longest: Longest,
}

/// Returns the next multiple of the beat, at or after `now_ns`.
pub(super) fn beat_ns(now_ns: u64) -> u64 {
    now_ns.next_multiple_of(BEAT_NS)
}

impl SessionTask {
    pub(super) fn new(handle: Arc<SessionHandle>, session: Session, running: bool) -> Self {
        let (schedule, dilation) = {
            let status = lock(&handle.status);
            (status.schedule, status.dilation)
        };
        SessionTask {
            exercise: None,
            recorder: handle.event_log.as_ref().map(|event_log| Recorder::new(event_log, &session)),
            running,
            until: None,
            schedule,
            next_step: session.step_count(),
            due_ns: 0,
            not_before_ns: 0,
            still_since: session.rests_until().map(|_| session.step_count()),
            session,
            rested_steps: 0,
            overrun_count: 0,
            lapsed_leases: 0,
            dilation,
            due: Vec::new(),
            hashed: Hashed::default(),
            copies: Copies::default(),
            subscribers: Subscribers::default(),
            audit: None,
            frozen: false,
            watch: StepWatch::default(),
            inbox: handle.inbox.clone(),
            goes_apart: false,
            left: false,
            waiting: VecDeque::new(),
            handle,
        }
    }

    /// Returns the time at which its next step is due, ns; `None` if time is paused or no step is wanted.
    pub(super) fn due_ns(&self) -> Option<u64> {
        let due_ns = (self.running && !self.frozen && !self.goes_apart && self.next_step < u64::MAX)
            .then(|| self.schedule.due_ns(self.next_step))?;
        Some(due_ns.max(self.not_before_ns))
    }

    /// Updates when it is stepped next, after a step, so that it keeps its place among the thread's sessions. One
    /// of `parts` equal parts of the thread's time is its own.
    pub(super) fn queue_again(&mut self, begun_ns: u64, now_ns: u64, parts: usize, is_alone: bool) {
        if self.still_since.is_none() {
            self.handle.cost.observe(now_ns.saturating_sub(begun_ns));
        }
        let (due_ns, period_ns) = (self.schedule.due_ns(self.next_step), self.schedule.period_ns());
        let turn = Turn { due_ns, period_ns, share: self.handle.cost.awake_share(), parts, is_alone };
        self.not_before_ns = turn.not_before_ns(now_ns);
    }

    /// Returns how late its next step is at `now_ns`, ns.
    pub(super) fn late_ns(&self, now_ns: u64) -> u64 {
        now_ns.saturating_sub(self.schedule.due_ns(self.next_step))
    }

    /// Returns the number of its owner's account.
    pub(super) fn owner(&self) -> u64 {
        self.handle.owner.number()
    }

    /// Returns whether it must leave the thread: it has left the server, or moves to another thread.
    pub(super) fn has_left(&self) -> bool {
        self.left || self.goes_apart
    }

    /// Runs `act`. A panic, or memory that can't be allocated, holds this session and no other.
    pub(super) fn guarded(&mut self, act: impl FnOnce(&mut Self)) {
        let Err(panic) = catch_unwind(AssertUnwindSafe(|| act(self))) else { return };
        let step = self.session.step_count();
        let reason = if let Some(refusal) = memory::refusal_of(&*panic) {
            format!("after step {step} {}", refusal.message)
        } else {
            let text = panic.downcast_ref::<String>().map(String::as_str);
            let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("without a message");
            format!("a fault of the program ended it after step {step}: {text}")
        };
        tracing::error!(session = %self.handle.id, reason, "session held");
        self.session.hold(reason.clone());
        self.note_input(Input::Hold(reason.clone()));
        self.end(&Refusal::new(Reason::SessionHeld, "", reason));
        self.handle.cost.set_awake(false);
        self.publish_status();
    }

    /// Decides which step comes next: the very next one or, at rest, the next one that a reader waits for.
    pub(super) fn plan(&mut self) {
        if self.session.is_within_step() {
            return;
        }
        let step = self.session.step_count();
        let wanted = || {
            let wanted = self.subscribers.next_wanted(step, self.still_since, self.handle.model.scene.stepping.rate_hz);
            let wanted = self.exercise.as_ref().map_or(wanted, |exercise| wanted.min(exercise.next_wanted(step)));
            self.until.map_or(wanted, |until| wanted.min(until - 1))
        };
        let rests_until = self.session.rests_until().filter(|_| self.running);
        let played = || self.handle.playback.as_ref().map_or(u64::MAX, |playback| playback.feed.next_step().max(step));
        let until = rests_until.map_or(step, |until| until.min(wanted()).min(played()));
        {
            let mut intake = lock(&self.handle.intake);
            self.next_step = intake.rest(step, until, &self.schedule);
            self.lapsed_leases = intake.expired();
        }
        self.handle.cost.set_awake(self.running && self.next_step == step);
    }

    /// Advances a session at rest to the step that it has reached by now.
    fn catch_up(&mut self, fence: &Fence) {
        // A command may have arrived that must not be skipped.
        self.plan();
        if self.running && !self.frozen && fence.may_act() {
            self.skip_to(self.schedule.next_step(now_ns()).min(self.next_step));
        }
    }

    fn skip_to(&mut self, step: u64) {
        self.rested_steps += step.saturating_sub(self.session.step_count());
        self.session.skip_to(step);
        self.note_rest();
    }

    pub(super) fn serve(&mut self, request: Request, context: &mut ThreadContext<'_>) {
        if self.session.is_within_step() {
            self.waiting.push_back(request);
            return;
        }
        self.catch_up(context.fence);
        let step = self.session.step_count();
        // Here too, because no step does it while time is paused.
        self.subscribers.forget_the_gone();
        match request {
            Request::Adopt | Request::Wake => {}
            Request::Start { until, reply } => {
                let started = self.start(until);
                if started.is_ok() {
                    self.note_input(Input::Start { until });
                }
                self.plan();
                self.publish_status();
                let _ = reply.send(started);
            }
            Request::Revive { reply } => {
                let _ = reply.send(self.revive());
            }
            Request::Pause { reply } => {
                self.note_input(Input::Pause);
                self.stand(context);
                let _ = reply.send(Ok(()));
            }
            Request::Samples(mut tap) => {
                tap.overrun_count = self.overrun_count;
                if !self.running {
                    self.tell(&mut tap, &mut None, true, &mut context.wakes);
                }
                if self.session.hold_reason().is_some() {
                    tap.writer.close(self.passed(0));
                } else if self.running || !tap.once {
                    self.subscribers.samples.push(*tap);
                }
            }
            Request::Save(reply) => _ = reply.send(self.present()),
            Request::Freeze(reply) => {
                let present = self.present();
                self.frozen = present.is_ok();
                let _ = reply.send(present);
            }
            Request::Thaw => self.frozen = false,
            Request::Silence(why) => self.silence(&why),
            Request::Audit(inputs, marks) => {
                self.session.request_audit(inputs);
                self.audit = Some(marks);
            }
            Request::Probe(tap) if self.session.hold_reason().is_some() => {
                tap.recipient.writer().close(self.passed(0));
            }
            Request::Probe(tap) => self.subscribers.probes.push(tap),
            Request::View(viewer) => {
                // A new viewer gets a full frame first.
                let frame_id = viewer.frame_id(step, self.handle.model.scene.stepping.rate_hz);
                self.post(context.encoder, vec![(viewer.clone(), frame_id)]);
                self.subscribers.viewers.push(ViewTap { viewer, shown: step, passed: frame_id });
            }
            Request::Hash { at, account, reply } => {
                let at = at.unwrap_or(step);
                if at > step && self.session.hold_reason().is_none() {
                    self.subscribers.hashes.push((at, account, reply));
                } else if at == step {
                    self.hash_for(&account, reply, context.reading);
                } else {
                    let _ = reply.send(Err(self.passed(at)));
                }
            }
            Request::FinishExercise => {
                if let Some(exercise) = &mut self.exercise {
                    let inbox = (self.handle.number, &self.handle.inbox);
                    exercise.end(&self.session, inbox, &self.handle.owner, context.reading);
                }
            }
            Request::FinishPhase(phase) => {
                // Taken out: the task writes to the event log.
                if let Some(mut exercise) = self.exercise.take() {
                    let (inbox, note) =
                        ((self.handle.number, &self.handle.inbox), || self.note_input(Input::PhaseEnded(phase)));
                    exercise.end_phase(&self.session, phase, note, inbox, &self.handle.owner, context.reading);
                    self.exercise = Some(exercise);
                }
            }
            Request::ExerciseEnded(ended) => {
                self.note_input(Input::ExerciseEnded(ended.clone()));
                tracing::info!(session = %self.handle.id, step = ended.figures.step, "exercise ended");
                self.handle.exercise.iter().for_each(|exercise| exercise.tell_end(ended.clone()));
            }
            Request::Leave(why, leaving) => {
                if leaving == Leaving::Moved {
                    self.note_the_end();
                }
                self.note(Event::Left(leaving));
                self.end(&why);
                self.left = true;
            }
            #[cfg(test)]
            Request::GoApart => self.goes_apart = true,
            #[cfg(test)]
            #[allow(clippy::panic)]
            Request::Panic => panic!("a test"),
        }
        self.plan();
        self.publish_status();
    }

    fn present(&self) -> Result<Present> {
        let (running, until_step) = (self.running, self.until);
        memory::attempt("", || {
            let (saved, copy) = (Box::new(self.session.save()), self.session.copy());
            Ok(Present { saved, copy, running, until_step })
        })
    }

    /// Pauses time. Readers of samples get the present one.
    fn stand(&mut self, context: &mut ThreadContext<'_>) {
        self.running = false;
        self.note_standstill();
        self.plan();
        self.publish_status();
        self.tell_all(true, &mut context.wakes);
    }

    fn passed(&self, at: u64) -> Refusal {
        let step = self.session.step_count();
        match self.session.hold_reason() {
            Some(reason) => Refusal::new(Reason::SessionHeld, "", reason),
            None => Refusal::new(Reason::StepPassed, "at_step", format!("is {at}, but {step} steps are done")),
        }
    }

    fn start(&mut self, until: Option<u64>) -> Result<u64> {
        let step = self.session.step_count();
        if let Some(until) = until.filter(|until| *until <= step) {
            return Err(Refusal { field: "until_step".into(), ..self.passed(until) });
        }
        if let Some(reason) = self.session.hold_reason() {
            return Err(Refusal::new(Reason::SessionHeld, "", reason));
        }
        self.until = until;
        if !self.running {
            let now = beat_ns(now_ns());
            self.running = true;
            self.schedule = Schedule::new(step, now, self.handle.speed() * self.handle.model.scene.stepping.rate_hz);
            self.schedule.delay(1.0);
            self.dilation = Dilation::new(now, step);
        }
        Ok(step)
    }

    /// Replaces the session by its tissue at rest, at the same step, paused. Returns the step.
    fn revive(&mut self) -> Result<u64> {
        if self.session.hold_reason().is_none() {
            return Err(Refusal::new(Reason::OutOfTurn, "session_id", "is a session that is not held"));
        }
        let step = self.session.step_count();
        let mut session = memory::attempt("session_id", || Ok(Session::new(self.session.model())))?;
        session.skip_to(step);
        self.restart_with(session);
        (self.running, self.until, self.still_since) = (false, None, Some(step));
        {
            let mut intake = lock(&self.handle.intake);
            intake.reopen();
            self.handle.note_waiting(&intake);
        }
        self.note_input(Input::Revive);
        tracing::info!(session = %self.handle.id, step, "session revived");
        Ok(step)
    }

    /// Replaces the session, whose counts begin at 0 again, and forgets everything that was derived from the old one.
    fn restart_with(&mut self, session: Session) {
        (self.session, self.hashed, self.audit) = (session, Hashed::default(), None);
        self.copies.forget();
        lock(&self.handle.status).forget_hold();
    }

    /// Drops the steps from the schedule that the policy does not let the session catch up.
    #[allow(clippy::cast_precision_loss)]
    fn drop_backlog(&mut self, now_ns: u64, forgiven_ns: u64) {
        let (late_ns, period_ns) = (self.late_ns(now_ns), self.schedule.period_ns());
        let dropped = dropped_steps(late_ns, forgiven_ns, period_ns);
        if dropped > 0 {
            self.schedule.delay(dropped as f64);
            self.overrun_count += dropped;
            self.note_input(Input::DroppedSteps(dropped));
            tracing::debug!(session = %self.handle.id, dropped, "steps dropped");
        }
    }

    /// Serves the requests that arrived within the step that has ended.
    pub(super) fn serve_waiting(&mut self, context: &mut ThreadContext<'_>) {
        while !self.session.is_within_step()
            && let Some(request) = self.waiting.pop_front()
        {
            self.serve(request, context);
        }
    }

    /// Completes an unfinished step, before the session ends.
    pub(super) fn finish_step(&mut self) {
        if self.session.is_within_step() {
            self.session.advance(&mut self.due, |_| {});
            self.note_state();
        }
    }

    /// Does the next step: all of it, or a part of what the guard repeats for it.
    pub(super) fn step(&mut self, begun_ns: u64, context: &mut ThreadContext<'_>) {
        if !self.session.is_within_step() && !self.begin_step(begun_ns, context) {
            return;
        }
        let (SessionTask { session, subscribers, due, copies, exercise, .. }, wakes, reading) =
            (&mut *self, &mut context.wakes, context.reading);
        copies.forget();
        let mut may_go_on = || now_ns() < begun_ns + MAX_REPETITION_NS;
        let see = |session: &Session| {
            subscribers.record(session, copies, reading, wakes);
            exercise.iter_mut().for_each(|exercise| exercise.see(session));
        };
        if session.advance_while(due, &mut may_go_on, see) {
            self.end_step(begun_ns, context);
        }
    }

    /// Returns whether the next step can be done, because its inputs are known. It takes them.
    fn begin_step(&mut self, begun_ns: u64, context: &mut ThreadContext<'_>) -> bool {
        let sampled = self.next_step.is_multiple_of(STEPS_PER_SPAN);
        let span = sampled.then(|| tracing::debug_span!("step", session = %self.handle.id, step = self.next_step));
        let _span = span.map(tracing::Span::entered);
        self.due_ns = self.schedule.due_ns(self.next_step);
        if self.next_step == self.session.step_count() {
            // Only steps that are computed can be late.
            self.drop_backlog(begun_ns, context.longest.ns());
        } else {
            self.plan();
            self.skip_to(self.next_step);
        }
        let step = self.session.step_count();
        let Some(change) = self.take_inputs(step, begun_ns) else {
            self.wait_for_record(context);
            return false;
        };
        self.note_inputs(change.as_ref());
        if let Some(model) = change {
            self.session.change(&model);
            self.handle.tissue.send_replace((step, model));
        }
        true
    }

    /// Publishes the results of a step.
    fn end_step(&mut self, begun_ns: u64, context: &mut ThreadContext<'_>) {
        self.tell_auditor();
        self.log_recovery();
        self.note_state();
        if let Some(exercise) = &mut self.exercise {
            exercise.tell(&self.session, (self.handle.number, &self.handle.inbox), &self.handle.owner, context.reading);
        }
        if let Some(reason) = self.session.hold_reason() {
            tracing::warn!(session = %self.handle.id, reason, "session held");
            self.running = false;
            drop(lock(&self.handle.intake).close(Refusal::new(Reason::SessionHeld, "", reason)));
            self.publish_status();
            for (at, _, reply) in std::mem::take(&mut self.subscribers.hashes) {
                let _ = reply.send(Err(self.passed(at)));
            }
            // No further record will be made.
            let held = self.passed(0);
            let probes = self.subscribers.probes.drain(..);
            probes.for_each(|tap| context.reading.close(&tap.account, &tap.recipient, held.clone()));
        }
        if self.until.is_some_and(|until| self.session.step_count() >= until) {
            self.running = false;
            self.note_standstill();
        }
        let step = self.session.step_count();
        self.still_since = self.session.rests_until().map(|_| self.still_since.unwrap_or(step));
        self.dilation.observe(begun_ns, step, self.schedule.period_ns());
        // The status first: a reader of this step may ask for it at once.
        self.publish_status();
        self.publish(context);
        let every = (self.handle.model.scene.stepping.rate_hz / REFINED_HZ).max(1.0) as u64;
        if self.session.step_count().is_multiple_of(every) {
            self.refine(context.refiner);
        }
        self.plan();
    }

    /// Takes the inputs of the coming step: commands are appended to `due`, and a change of the tissue is returned.
    /// `None` if a playback can't continue, because the inputs have not been read or were not recorded.
    fn take_inputs(&mut self, step: u64, now_ns: u64) -> Option<Option<Arc<Model>>> {
        let mut intake = lock(&self.handle.intake);
        intake.take_due(step, now_ns, &mut self.due);
        let change = intake.take_change(step);
        drop(intake);
        let Some(playback) = &self.handle.playback else { return Some(change) };
        let fetched = match playback.feed.take(step, &mut self.due) {
            Next::Step(fetched) => fetched,
            Next::Late => return None,
            Next::Over => {
                self.running = false;
                return None;
            }
        };
        if fetched.is_revived
            && let Ok(mut session) = memory::attempt("", || Ok(Session::new(self.session.model())))
        {
            session.skip_to(step);
            self.restart_with(session);
        }
        if let Some(reason) = fetched.hold {
            self.session.hold(reason);
        }
        Some(fetched.change)
    }

    /// Delays a playback whose inputs are not available, or publishes its last state if it is over.
    fn wait_for_record(&mut self, context: &mut ThreadContext<'_>) {
        self.schedule.delay(RECORD_WAIT_S * self.handle.speed() * self.handle.model.scene.stepping.rate_hz);
        self.publish_status();
        if !self.running {
            self.tell_all(true, &mut context.wakes);
        }
        self.plan();
    }

    /// Ends every stream, and refuses waiting commands.
    pub(super) fn end(&mut self, why: &Refusal) {
        self.running = false;
        drop(lock(&self.handle.intake).close(why.clone()));
        self.silence(why);
    }

    /// Ends every stream, and refuses the requests that wait for a step.
    fn silence(&mut self, why: &Refusal) {
        self.handle.exercise.iter().for_each(|exercise| exercise.close(why));
        let subscribers = std::mem::take(&mut self.subscribers);
        subscribers.samples.iter().for_each(|tap| tap.writer.close(why.clone()));
        subscribers.probes.iter().for_each(|tap| tap.recipient.writer().close(why.clone()));
        subscribers.viewers.iter().for_each(|tap| tap.viewer.close(why.clone()));
        for (_, _, reply) in subscribers.hashes {
            let _ = reply.send(Err(why.clone()));
        }
    }
}
