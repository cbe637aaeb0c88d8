//! A stepping thread: it owns its sessions, and steps each when its time has come.
//!
//! Overruns: time steps are fixed. A session that is behind catches up at most [`CATCH_UP_STEPS`] steps; what it is
//! behind beyond that is dropped from its schedule, and counted. Simulated time then runs slower than real time.
//!
//! Rest: while all of a tissue is asleep and no command waits, its steps change nothing but their number. Then only the
//! steps are done that somebody is to be told of (a heartbeat, a record, a hash); those between are skipped, all at once,
//! when the next is due. A session of which nobody waits for a step is not in the thread's rota at all, and a thread
//! whose rota is empty sleeps until it is asked something. What comes in meanwhile is placed where it would be had the
//! session been stepped ([`Intake::rest`](crate::session::command::Intake::rest)), and wakes the thread.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use tokio::sync::oneshot;

use super::clock::now_ns;
use super::frames::{Encoder, Job, Viewer};
use super::queue::lock;
use super::tally::Tally;
use super::taps::{HashReply, ProbeTap, SampleTap, Taps, ViewTap};
use super::{Dilation, Live, PacedRecord, PacedSample, State};
use crate::refusal::{Reason, Refusal, Result};
use crate::session::Session;
use crate::session::command::Due;
use crate::session::local::Refinement;
use crate::session::schedule::Schedule;
use crate::surface::Snapshot;

/// Steps that a session may be behind before the rest is dropped.
const CATCH_UP_STEPS: f64 = 2.0;

/// Every so many steps of a session one is a span of the log, at level debug.
const STEPS_PER_SPAN: u64 = 1024;

/// How often the stiffness under tools is computed anew, Hz.
const REFINED_HZ: f64 = 50.0;

/// What a stepping thread is asked for.
pub(super) enum Request {
    Adopt(Box<Running>),
    Start {
        until: Option<u64>,
        reply: oneshot::Sender<Result<u64>>,
    },
    Pause {
        reply: oneshot::Sender<Result<()>>,
    },
    /// Something came to a session at rest.
    Wake,
    Samples(SampleTap),
    Probe(ProbeTap),
    View(Arc<Viewer>),
    Hash {
        at: Option<u64>,
        reply: HashReply,
    },
    Delete(Refusal),
}

/// Where a stepping thread is asked.
#[derive(Default)]
pub(super) struct Inbox {
    state: Mutex<InboxState>,
    wake: Condvar,
    /// Written by the thread that reads here.
    pub(super) tally: Tally,
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
}

/// A session and its schedule.
pub(super) struct Running {
    live: Arc<Live>,
    session: Session,
    running: bool,
    until: Option<u64>,
    schedule: Schedule,
    /// The step to do next. At rest, those before it are skipped; `u64::MAX` if there is none.
    next_step: u64,
    /// Steps done when all was asleep first, if it still is.
    still_since: Option<u64>,
    rested_steps: u64,
    overrun_count: u64,
    lapsed_leases: u64,
    dilation: Dilation,
    due: Vec<Due>,
    hashed: Option<(u64, u128)>,
    taps: Taps,
    deleted: bool,
}

/// The sessions of a thread, by number, and when each needs it next. One at rest may need it never.
#[derive(Default)]
struct Rota {
    sessions: BTreeMap<u64, Box<Running>>,
    due: BTreeSet<(u64, u64)>,
}

impl Rota {
    /// Does something with session `number`, if it is there still, which may change when it is due.
    fn with(&mut self, number: u64, act: impl FnOnce(&mut Running)) {
        let Entry::Occupied(mut session) = self.sessions.entry(number) else { return };
        let running = session.get_mut();
        if let Some(due_ns) = running.due_ns() {
            self.due.remove(&(due_ns, number));
        }
        act(running);
        if let Some(due_ns) = running.due_ns() {
            self.due.insert((due_ns, number));
        }
        if running.deleted {
            session.remove();
        }
    }

    /// The session that is due first, and when.
    fn first(&self) -> Option<(u64, u64)> {
        self.due.first().copied()
    }
}

/// The thread's work.
pub(super) fn work(inbox: &Inbox, encoder: &Encoder, refiner: &SyncSender<Refinement>) {
    // The default slack of 50 µs would be the larger part of each step's lateness. Where it can't be set, so be it.
    #[cfg(target_os = "linux")]
    let _ = rustix::thread::set_current_timer_slack(std::num::NonZeroU64::new(1));
    let mut rota = Rota::default();
    let mut requests = VecDeque::new();
    loop {
        let next_ns = rota.first().map(|first| first.0);
        if let Some(why) = wait(inbox, next_ns, &mut requests) {
            rota.sessions.values_mut().for_each(|running| running.end(&why));
            return;
        }
        // One at a time where a step is due: to answer many must not make a step wait.
        while let Some((number, request)) = requests.pop_front() {
            if let Request::Adopt(running) = request {
                rota.sessions.insert(number, running);
                rota.with(number, Running::plan);
            } else {
                rota.with(number, |running| running.serve(request, encoder));
            }
            if next_ns.is_some_and(|next_ns| next_ns <= now_ns()) {
                break;
            }
        }
        // The one that is due first: a heavy session is late itself before it makes others late.
        let begun_ns = now_ns();
        if let Some((due_ns, number)) = rota.first()
            && due_ns <= begun_ns
        {
            rota.with(number, |running| running.step(encoder, refiner));
            inbox.tally.lateness.add(begun_ns - due_ns);
            inbox.tally.step_time.add(now_ns().saturating_sub(begun_ns));
        }
    }
}

/// Waits until `deadline_ns` or until something is asked, which is added to `requests`. Tells why to stop, if so.
fn wait(inbox: &Inbox, deadline_ns: Option<u64>, requests: &mut VecDeque<(u64, Request)>) -> Option<Refusal> {
    let mut state = lock(&inbox.state);
    loop {
        requests.extend(state.requests.drain(..));
        if !requests.is_empty() || state.stop.is_some() {
            return state.stop.clone();
        }
        state = match deadline_ns {
            None => inbox.wake.wait(state).unwrap_or_else(PoisonError::into_inner),
            Some(deadline_ns) => {
                let rest_ns = deadline_ns.saturating_sub(now_ns());
                if rest_ns == 0 {
                    return None;
                }
                let waited = inbox.wake.wait_timeout(state, Duration::from_nanos(rest_ns));
                waited.unwrap_or_else(PoisonError::into_inner).0
            }
        };
    }
}

impl Running {
    pub(super) fn new(live: Arc<Live>, running: bool) -> Self {
        let now = now_ns();
        let schedule = Schedule::new(0, now, live.model.scene.stepping.rate_hz);
        Running {
            session: Session::new(&live.model),
            running,
            until: None,
            schedule,
            next_step: 0,
            still_since: Some(0),
            rested_steps: 0,
            overrun_count: 0,
            lapsed_leases: 0,
            dilation: Dilation::new(now, 0),
            due: Vec::new(),
            hashed: None,
            taps: Taps::default(),
            deleted: false,
            live,
        }
    }

    /// When its next step is due, if time goes on and one is wanted.
    fn due_ns(&self) -> Option<u64> {
        (self.running && self.next_step < u64::MAX).then(|| self.schedule.due_ns(self.next_step))
    }

    /// Decides which step comes next: the very next one, or at rest the next one that somebody waits for.
    fn plan(&mut self) {
        let step = self.session.step_count();
        let wanted = || {
            let wanted = self.taps.next_wanted(step, self.still_since, self.live.model.scene.stepping.rate_hz);
            self.until.map_or(wanted, |until| wanted.min(until - 1))
        };
        let rests_until = self.session.rests_until().filter(|_| self.running);
        let until = rests_until.map_or(step, |until| until.min(wanted()));
        let mut intake = lock(&self.live.intake);
        self.next_step = intake.rest(step, until, &self.schedule);
        self.lapsed_leases = intake.lapsed();
    }

    /// At rest, time has gone on without a step: brings the session to where it stands now.
    fn catch_up(&mut self) {
        // Something may have come since that must not be skipped.
        self.plan();
        if self.running {
            self.skip_to(self.schedule.next_step(now_ns()).min(self.next_step));
        }
    }

    fn skip_to(&mut self, step: u64) {
        self.rested_steps += step.saturating_sub(self.session.step_count());
        self.session.skip_to(step);
    }

    fn serve(&mut self, request: Request, encoder: &Encoder) {
        self.catch_up();
        let step = self.session.step_count();
        // Also while time stands, when no step does it.
        self.taps.forget_the_gone();
        match request {
            Request::Adopt(_) | Request::Wake => {}
            Request::Start { until, reply } => {
                let started = self.start(until);
                self.plan();
                self.publish_status();
                let _ = reply.send(started);
            }
            Request::Pause { reply } => {
                self.stand();
                let _ = reply.send(Ok(()));
            }
            Request::Samples(mut tap) => {
                tap.overrun_count = self.overrun_count;
                if !self.running {
                    self.tell(&mut tap, true);
                }
                if self.session.hold_reason().is_some() {
                    tap.writer.close(self.passed(0));
                } else if self.running || !tap.once {
                    self.taps.samples.push(tap);
                }
            }
            Request::Probe(tap) if self.session.hold_reason().is_some() => tap.writer.close(self.passed(0)),
            Request::Probe(tap) => self.taps.probes.push(tap),
            Request::View(viewer) => {
                // Who joins late gets a full frame first.
                let frame_id = viewer.frame_id(step, self.live.model.scene.stepping.rate_hz);
                self.post(encoder, vec![(viewer.clone(), frame_id)]);
                self.taps.viewers.push(ViewTap { viewer, shown: step, passed: frame_id });
            }
            Request::Hash { at, reply } => {
                let at = at.unwrap_or(step);
                if at > step && self.session.hold_reason().is_none() {
                    self.taps.hashes.push((at, reply));
                } else {
                    let _ = reply.send(if at == step { Ok((step, self.hash())) } else { Err(self.passed(at)) });
                }
            }
            Request::Delete(why) => {
                self.end(&why);
                self.deleted = true;
            }
        }
        self.plan();
        self.publish_status();
    }

    /// The state's hash, computed once a step.
    fn hash(&mut self) -> u128 {
        let step = self.session.step_count();
        let hash = self.hashed.filter(|hashed| hashed.0 == step).map(|hashed| hashed.1);
        let hash = hash.unwrap_or_else(|| self.session.tissue().state_hash());
        self.hashed = Some((step, hash));
        hash
    }

    /// Time stands from now on. Who reads samples gets the present one.
    fn stand(&mut self) {
        self.running = false;
        self.plan();
        self.publish_status();
        self.tell_all(true);
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
            let now = now_ns();
            self.running = true;
            self.schedule = Schedule::new(step, now, self.live.model.scene.stepping.rate_hz);
            self.schedule.delay(1.0);
            self.dilation = Dilation::new(now, step);
        }
        Ok(step)
    }

    /// What it is behind beyond what it may catch up is dropped.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn drop_backlog(&mut self) {
        let late_ns = now_ns().saturating_sub(self.schedule.due_ns(self.next_step));
        let behind = (late_ns as f64 / self.schedule.period_ns()).floor() - CATCH_UP_STEPS;
        if behind > 0.0 {
            self.schedule.delay(behind);
            self.overrun_count += behind as u64;
            tracing::debug!(session = %self.live.id, dropped = behind, "steps dropped");
        }
    }

    /// The next step, at its time or after it.
    fn step(&mut self, encoder: &Encoder, refiner: &SyncSender<Refinement>) {
        let sampled = self.next_step.is_multiple_of(STEPS_PER_SPAN);
        let span = sampled.then(|| tracing::debug_span!("step", session = %self.live.id, step = self.next_step));
        let _span = span.map(tracing::Span::entered);
        if self.next_step > self.session.step_count() {
            self.plan();
            self.skip_to(self.next_step);
        } else {
            // Only of steps that cost something can a session be behind.
            self.drop_backlog();
        }
        lock(&self.live.intake).take_due(self.session.step_count(), now_ns(), &mut self.due);

        let Running { session, taps, due, .. } = self;
        session.advance(due, |session| {
            let step = session.step_count();
            // A pass over the sheet, once for all who want it.
            let mut energy = None;
            for tap in taps.probes.iter().filter(|tap| step.is_multiple_of(tap.every)) {
                let mut record = session.record(tap.points.as_deref());
                if tap.energy {
                    record.energy_j = Some(*energy.get_or_insert_with(|| session.energy()));
                }
                tap.writer.push(PacedRecord { step, record });
            }
        });
        if let Some(reason) = self.session.hold_reason() {
            tracing::warn!(session = %self.live.id, reason, "session held");
            self.running = false;
            lock(&self.live.intake).close(Refusal::new(Reason::SessionHeld, "", reason));
            self.publish_status();
            for (at, reply) in std::mem::take(&mut self.taps.hashes) {
                let _ = reply.send(Err(self.passed(at)));
            }
            // No further record will come.
            let held = self.passed(0);
            self.taps.probes.drain(..).for_each(|tap| tap.writer.close(held.clone()));
        }
        if self.until.is_some_and(|until| self.session.step_count() >= until) {
            self.running = false;
        }
        let step = self.session.step_count();
        self.still_since = self.session.rests_until().map(|_| self.still_since.unwrap_or(step));
        self.dilation.observe(now_ns(), step, self.schedule.period_ns());
        // The status first: who is told of this step may ask for it at once.
        self.publish_status();
        self.publish(encoder);
        let every = (self.live.model.scene.stepping.rate_hz / REFINED_HZ).max(1.0) as u64;
        if self.session.step_count().is_multiple_of(every) {
            self.refine(refiner);
        }
        self.plan();
    }

    /// Has the stiffness computed anew under the tools of which it is told.
    fn refine(&self, refiner: &SyncSender<Refinement>) {
        for refinement in self.taps.samples.iter().flat_map(|tap| tap.sampler.refinements(&self.session)) {
            // What finds the refiner busy is left: the next is newer.
            let _ = refiner.try_send(refinement);
        }
    }

    /// Gives a stream the present sample, if it is to get it, or if no other follows for now.
    fn tell(&self, tap: &mut SampleTap, last: bool) {
        let Some(sample) = tap.sampler.pick(&self.session, last || tap.once) else { return };
        let overrun = self.overrun_count > tap.overrun_count;
        tap.overrun_count = self.overrun_count;
        let Running { overrun_count, .. } = *self;
        tap.writer.push(PacedSample { sample, overrun_count, time_dilation: self.dilation.value, overrun });
    }

    fn tell_all(&mut self, last: bool) {
        let mut taps = std::mem::take(&mut self.taps.samples);
        taps.iter_mut().for_each(|tap| self.tell(tap, last));
        taps.retain(|tap| !tap.once);
        self.taps.samples = taps;
    }

    /// Tells everybody who wants to know of this step.
    fn publish(&mut self, encoder: &Encoder) {
        let step = self.session.step_count();
        self.tell_all(!self.running);
        self.taps.forget_the_gone();
        let (still_since, rate_hz) = (self.still_since, self.live.model.scene.stepping.rate_hz);
        let held = self.session.hold_reason().is_some();
        let due_frame = |tap: &mut ViewTap| {
            let last = held.then(|| tap.viewer.frame_id(step, rate_hz));
            let due = last.or_else(|| tap.due(step, still_since, rate_hz));
            tap.pass(step, due.is_some(), rate_hz);
            let frame_id = due?;
            tap.shown = step;
            tap.viewer.has_credit().then(|| (tap.viewer.clone(), frame_id))
        };
        let viewers: Vec<_> = self.taps.viewers.iter_mut().filter_map(due_frame).collect();
        if !viewers.is_empty() {
            self.post(encoder, viewers);
        }
        for (at, reply) in self.taps.hashes.extract_if(.., |waiting| waiting.0 == step).collect::<Vec<_>>() {
            let _ = reply.send(Ok((at, self.hash())));
        }
    }

    fn post(&self, encoder: &Encoder, viewers: Vec<(Arc<Viewer>, u64)>) {
        let mut displacement_m = std::array::from_fn(|_| Vec::new());
        self.session.tissue().displacements_m(&mut displacement_m);
        let points = self.live.model.points;
        let snapshot = Snapshot::new(self.session.step_count(), self.session.time_s(), points, displacement_m);
        let (snapshot, spacing_m) = (Arc::new(snapshot), self.live.model.scene.sheet.spacing_m);
        let (overrun_count, time_dilation) = (self.overrun_count, self.dilation.value);
        encoder.post(self.live.number, Job { snapshot, spacing_m, viewers, overrun_count, time_dilation });
    }

    fn publish_status(&self) {
        let mut status = lock(&self.live.status);
        let (before, tally) = (&*status, &self.live.inbox.tally);
        let path_counts = self.session.path_counts();
        let guard_events = self.session.tissue().guard_events();
        let is_held = self.session.hold_reason().is_some();
        tally.rested_steps.add(self.rested_steps - before.rested_steps);
        tally.overruns.add(self.overrun_count - before.overrun_count);
        tally.late_commands.add(self.session.late_commands() - before.late_commands);
        tally.lapsed_leases.add(self.lapsed_leases - before.lapsed_leases);
        tally.guard_events.add(guard_events - before.guard_events);
        tally.held_sessions.add(u64::from(is_held && before.state != State::Held));
        let path_tallies = [&tally.limited_steps, &tally.dropped_poses, &tally.stale_releases];
        for (index, count) in path_tallies.into_iter().enumerate() {
            count.add(path_counts[index] - before.path_counts[index]);
        }
        status.state = match (self.session.hold_reason(), self.running) {
            (Some(_), _) => State::Held,
            (None, true) => State::Running,
            (None, false) => State::Paused,
        };
        status.step = self.session.step_count();
        status.rested_steps = self.rested_steps;
        status.overrun_count = self.overrun_count;
        status.guard_events = guard_events;
        status.awake_points = self.session.tissue().awake_points();
        status.path_counts = path_counts;
        status.lapsed_leases = self.lapsed_leases;
        status.dilation = self.dilation;
        status.schedule = self.schedule;
        status.late_commands = self.session.late_commands();
        if status.hold_reason.is_none() {
            status.hold_reason = self.session.hold_reason().map(str::to_owned);
        }
    }

    /// Ends every stream, and what waits.
    fn end(&mut self, why: &Refusal) {
        self.running = false;
        lock(&self.live.intake).close(why.clone());
        let taps = std::mem::take(&mut self.taps);
        taps.samples.iter().for_each(|tap| tap.writer.close(why.clone()));
        taps.probes.iter().for_each(|tap| tap.writer.close(why.clone()));
        taps.viewers.iter().for_each(|tap| tap.viewer.close(why.clone()));
        for (_, reply) in taps.hashes {
            let _ = reply.send(Err(why.clone()));
        }
    }
}
