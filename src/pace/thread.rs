//! A stepping thread: it owns its sessions, and steps each when its time has come.
//!
//! Overruns: time steps are fixed. A session that is behind catches up at most [`CATCH_UP_STEPS`] steps; what it is
//! behind beyond that is dropped from its schedule, and counted. Simulated time then runs slower than real time.
//!
//! Fair parts: the session that is due first goes first, so those of any rates are all on time while there is time for
//! all. If there is not, whoever takes no more than its part of the thread still goes by when it is due; whoever
//! takes more and is late goes after all that are due. The thread is divided among the callers whose sessions are awake,
//! and each one's part among its sessions: who wakes four hundred at once slows those. So between two steps of a session that is too heavy all others
//! get theirs, and it gets what they leave. A step can't be interrupted: by the longest one of late everybody may be
//! behind through no fault of its own, and catches that up however many steps it is.
//!
//! Rest: while all of a tissue is asleep and no command waits, its steps change nothing but their number. Then only the
//! steps are done that somebody is to be told of (a heartbeat, a record, a hash); those between are skipped, all at once,
//! when the next is due. A session of which nobody waits for a step is not in the thread's rota at all, and a thread
//! whose rota is empty sleeps until it is asked something. What comes in meanwhile is placed where it would be had the
//! session been stepped ([`Intake::rest`](crate::session::command::Intake::rest)), and wakes the thread.
//!
//! One beat: sessions begin at a whole millisecond, so those of one rate are due together. The thread wakes once for all of
//! them, and wakes their readers together at the end of the round, after 32 of them, or after 0.2 ms (`queue::Wakes`). So the
//! samples of a round leave in few turns of the network threads.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::SyncSender;

use super::clock::{Dilation, now_ns};
use super::cost::Longest;
use super::frames::{Encoder, Job, Viewer};
use super::inbox::{Inbox, Request};
use super::queue::Wakes;
use super::reading::{Copies, Hashed, Piece, Reading};
use super::taps::{SampleTap, Taps, ViewTap};
use super::{Live, PacedSample, State};
use crate::budget::Work;
use crate::lock::lock;
use crate::memory;
use crate::refusal::{Reason, Refusal, Result};
use crate::session::command::Due;
use crate::session::local::Refinement;
use crate::session::schedule::Schedule;
use crate::session::{Sample, Session};
use crate::sheet::audit::Mark;

/// Steps that a session may be behind before the rest is dropped.
const CATCH_UP_STEPS: f64 = 2.0;

/// Sessions begin on the same beat, whose length this is, ns: a thread wakes once for all of a rate, and so does who
/// carries what they tell.
const BEAT_NS: u64 = 1_000_000;

/// So many readers wait at most, and so long, ns, for the end of a round of steps before they are woken.
const MOST_WAKES: usize = 32;
const MOST_ROUND_NS: u64 = 200_000;

/// Every so many steps of a session one is a span of the log, at level debug.
const STEPS_PER_SPAN: u64 = 1024;

/// How often the stiffness under tools is computed anew, Hz.
const REFINED_HZ: f64 = 50.0;

/// A session and its schedule.
pub(super) struct Running {
    live: Arc<Live>,
    session: Session,
    running: bool,
    until: Option<u64>,
    schedule: Schedule,
    /// The step to do next. At rest, those before it are skipped; `u64::MAX` if there is none.
    next_step: u64,
    /// When the newest step was due, before what it was late by beyond measure was dropped.
    due_ns: u64,
    /// It was late, and takes more than its part: it goes after those that were due by then.
    not_before_ns: u64,
    /// Steps done when all was asleep first, if it still is.
    still_since: Option<u64>,
    rested_steps: u64,
    overrun_count: u64,
    lapsed_leases: u64,
    dilation: Dilation,
    due: Vec<Due>,
    hashed: Hashed,
    copies: Copies,
    taps: Taps,
    /// Who is to be told of the window that the session was asked for.
    audit: Option<SyncSender<Mark>>,
    deleted: bool,
}

/// The sessions of a thread, by number, and when each needs it next. One at rest may need it never.
#[derive(Default)]
struct Rota {
    sessions: BTreeMap<u64, Box<Running>>,
    due: BTreeSet<(u64, u64)>,
    /// Sessions that are due some time, by the account of who made them.
    awake: BTreeMap<u64, usize>,
}

impl Rota {
    /// Does something with session `number`, if it is there still, which may change when it is due. Returns the session if
    /// that has deleted it.
    fn with(&mut self, number: u64, act: impl FnOnce(&mut Running)) -> Option<Box<Running>> {
        let Entry::Occupied(mut session) = self.sessions.entry(number) else { return None };
        let running = session.get_mut();
        let owner = running.live.owner.number();
        if let Some(due_ns) = running.due_ns()
            && self.due.remove(&(due_ns, number))
            && let Entry::Occupied(mut awake) = self.awake.entry(owner)
        {
            *awake.get_mut() -= 1;
            if *awake.get() == 0 {
                awake.remove();
            }
        }
        act(running);
        if let Some(due_ns) = running.due_ns() {
            self.due.insert((due_ns, number));
            *self.awake.entry(owner).or_default() += 1;
        }
        running.deleted.then(|| session.remove())
    }

    /// Of how many the thread's time is an equal part for session `number`: each caller gets as much as another, and divides
    /// it among its sessions.
    fn parts(&self, number: u64) -> usize {
        let owner = self.sessions.get(&number).map(|running| running.live.owner.number());
        self.awake.len() * owner.and_then(|owner| self.awake.get(&owner)).copied().unwrap_or(1)
    }

    /// The session that is due first, and when.
    fn first(&self) -> Option<(u64, u64)> {
        self.due.first().copied()
    }
}

/// What all sessions of a thread use.
struct Desk<'t> {
    encoder: &'t Encoder,
    refiner: &'t SyncSender<Refinement>,
    reading: &'t Reading,
    wakes: Wakes,
    longest: Longest,
}

/// The beat at `now_ns`, or the next.
pub(super) fn beat_ns(now_ns: u64) -> u64 {
    now_ns.next_multiple_of(BEAT_NS)
}

/// The thread's work.
pub(super) fn work(inbox: &Inbox, encoder: &Encoder, refiner: &SyncSender<Refinement>, reading: &Reading) {
    // The default slack of 50 µs would be the larger part of each step's lateness. Where it can't be set, so be it.
    #[cfg(target_os = "linux")]
    let _ = rustix::thread::set_current_timer_slack(std::num::NonZeroU64::new(1));
    let mut rota = Rota::default();
    let mut requests = VecDeque::new();
    let mut desk = Desk { encoder, refiner, reading, wakes: Wakes::default(), longest: Longest::default() };
    let mut begun_round_ns = 0;
    loop {
        let next_ns = rota.first().map(|first| first.0);
        let now = now_ns();
        let is_round_over = next_ns.is_none_or(|next_ns| next_ns > now) || now > begun_round_ns + MOST_ROUND_NS;
        if is_round_over || desk.wakes.len() >= MOST_WAKES {
            desk.wakes.wake();
        }
        if let Some(why) = inbox.wait(next_ns, now, &mut requests) {
            desk.wakes.wake();
            rota.sessions.values_mut().for_each(|running| running.end(&why));
            return;
        }
        // One at a time where a step is due: to answer many must not make a step wait.
        while let Some((number, request)) = requests.pop_front() {
            if let Request::Adopt(running) = request {
                rota.sessions.insert(number, running);
                rota.with(number, Running::plan);
            } else {
                let deleted = rota.with(number, |running| running.guarded(|running| running.serve(request, &mut desk)));
                if let Some(running) = deleted {
                    // To free what a session has takes longer than a step may wait.
                    let owner = running.live.owner.clone();
                    reading.post(&owner, Piece::Remains(running));
                }
            }
            if next_ns.is_some_and(|next_ns| next_ns <= now_ns()) {
                break;
            }
        }
        let begun_ns = now_ns();
        if let Some((due_ns, number)) = rota.first()
            && due_ns <= begun_ns
        {
            if desk.wakes.is_empty() {
                begun_round_ns = begun_ns;
            }
            let (parts, alone) = (rota.parts(number), rota.due.len() == 1);
            rota.with(number, |running| {
                let late_ns = begun_ns.saturating_sub(running.schedule.due_ns(running.next_step));
                running.guarded(|running| running.step(begun_ns, &mut desk));
                let ended_ns = now_ns();
                let taken_ns = ended_ns.saturating_sub(begun_ns);
                desk.longest.observe(ended_ns, taken_ns);
                inbox.tally.lateness.add(late_ns);
                inbox.tally.step_time.add(taken_ns);
                running.queue_again(begun_ns, ended_ns, parts, alone);
            });
        }
    }
}

impl Running {
    pub(super) fn new(live: Arc<Live>, running: bool) -> Self {
        let (schedule, dilation) = {
            let status = lock(&live.status);
            (status.schedule, status.dilation)
        };
        Running {
            session: Session::new(&live.model),
            running,
            until: None,
            schedule,
            next_step: 0,
            due_ns: 0,
            not_before_ns: 0,
            still_since: Some(0),
            rested_steps: 0,
            overrun_count: 0,
            lapsed_leases: 0,
            dilation,
            due: Vec::new(),
            hashed: Hashed::default(),
            copies: Copies::default(),
            taps: Taps::default(),
            audit: None,
            deleted: false,
            live,
        }
    }

    /// When its next step is due, if time goes on and one is wanted.
    fn due_ns(&self) -> Option<u64> {
        let due_ns = (self.running && self.next_step < u64::MAX).then(|| self.schedule.due_ns(self.next_step))?;
        Some(due_ns.max(self.not_before_ns))
    }

    /// Finds its place among the sessions of the thread, after a step, if one of `parts` of its time is its own.
    #[allow(clippy::cast_precision_loss)]
    fn queue_again(&mut self, begun_ns: u64, now_ns: u64, parts: usize, alone: bool) {
        if self.still_since.is_none() {
            self.live.cost.observe(now_ns.saturating_sub(begun_ns));
        }
        let is_late = now_ns.saturating_sub(self.schedule.due_ns(self.next_step)) as f64 > self.schedule.period_ns();
        let takes_more = self.live.cost.awake_share() * parts as f64 > 1.0;
        self.not_before_ns = if !alone && is_late && takes_more { now_ns } else { 0 };
    }

    /// Does something with it. A panic ends this session, and no other; so does memory that can't be had.
    fn guarded(&mut self, act: impl FnOnce(&mut Self)) {
        let Err(panic) = catch_unwind(AssertUnwindSafe(|| act(self))) else { return };
        let step = self.session.step_count();
        let reason = if let Some(refusal) = memory::refusal_of(&*panic) {
            format!("after step {step} {}", refusal.message)
        } else {
            let text = panic.downcast_ref::<String>().map(String::as_str);
            let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("without a message");
            format!("a fault of the program ended it after step {step}: {text}")
        };
        tracing::error!(session = %self.live.id, reason, "session held");
        self.session.hold(reason.clone());
        self.end(&Refusal::new(Reason::SessionHeld, "", reason));
        self.live.cost.set_awake(false);
        self.publish_status();
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
        {
            let mut intake = lock(&self.live.intake);
            self.next_step = intake.rest(step, until, &self.schedule);
            self.lapsed_leases = intake.lapsed();
        }
        self.live.cost.set_awake(self.running && self.next_step == step);
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

    fn serve(&mut self, request: Request, desk: &mut Desk<'_>) {
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
            Request::Revive { reply } => {
                let _ = reply.send(self.revive());
            }
            Request::Pause { reply } => {
                self.stand(desk);
                let _ = reply.send(Ok(()));
            }
            Request::Samples(mut tap) => {
                tap.overrun_count = self.overrun_count;
                if !self.running {
                    self.tell(&mut tap, &mut None, true, &mut desk.wakes);
                }
                if self.session.hold_reason().is_some() {
                    tap.writer.close(self.passed(0));
                } else if self.running || !tap.once {
                    self.taps.samples.push(tap);
                }
            }
            Request::Audit(inputs, marks) => {
                self.session.watch(inputs);
                self.audit = Some(marks);
            }
            Request::Probe(tap) if self.session.hold_reason().is_some() => {
                tap.recipient.writer().close(self.passed(0));
            }
            Request::Probe(tap) => self.taps.probes.push(tap),
            Request::View(viewer) => {
                // Who joins late gets a full frame first.
                let frame_id = viewer.frame_id(step, self.live.model.scene.stepping.rate_hz);
                self.post(desk.encoder, vec![(viewer.clone(), frame_id)]);
                self.taps.viewers.push(ViewTap { viewer, shown: step, passed: frame_id });
            }
            Request::Hash { at, account, reply } => {
                let at = at.unwrap_or(step);
                if at > step && self.session.hold_reason().is_none() {
                    self.taps.hashes.push((at, account, reply));
                } else if at == step {
                    self.hash_for(&account, reply, desk.reading);
                } else {
                    let _ = reply.send(Err(self.passed(at)));
                }
            }
            Request::Delete(why) => {
                self.end(&why);
                self.deleted = true;
            }
            #[cfg(test)]
            #[allow(clippy::panic)]
            Request::Panic => panic!("a test"),
        }
        self.plan();
        self.publish_status();
    }

    /// Time stands from now on. Who reads samples gets the present one.
    fn stand(&mut self, desk: &mut Desk<'_>) {
        self.running = false;
        self.plan();
        self.publish_status();
        self.tell_all(true, &mut desk.wakes);
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
            self.schedule = Schedule::new(step, now, self.live.model.scene.stepping.rate_hz);
            self.schedule.delay(1.0);
            self.dilation = Dilation::new(now, step);
        }
        Ok(step)
    }

    /// What it is behind beyond what it may catch up is dropped.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn drop_backlog(&mut self, now_ns: u64, forgiven_ns: u64) {
        let late_ns = now_ns.saturating_sub(self.schedule.due_ns(self.next_step)).saturating_sub(forgiven_ns);
        let behind = (late_ns as f64 / self.schedule.period_ns()).floor() - CATCH_UP_STEPS;
        if behind > 0.0 {
            self.schedule.delay(behind);
            self.overrun_count += behind as u64;
            tracing::debug!(session = %self.live.id, dropped = behind, "steps dropped");
        }
    }

    /// The next step, at its time or after it.
    fn step(&mut self, begun_ns: u64, desk: &mut Desk<'_>) {
        let sampled = self.next_step.is_multiple_of(STEPS_PER_SPAN);
        let span = sampled.then(|| tracing::debug_span!("step", session = %self.live.id, step = self.next_step));
        let _span = span.map(tracing::Span::entered);
        self.due_ns = self.schedule.due_ns(self.next_step);
        if self.next_step == self.session.step_count() {
            // Only of steps that cost something can a session be behind.
            self.drop_backlog(begun_ns, desk.longest.ns());
        } else {
            self.plan();
            self.skip_to(self.next_step);
        }
        let step = self.session.step_count();
        let change = {
            let mut intake = lock(&self.live.intake);
            intake.take_due(step, begun_ns, &mut self.due);
            intake.take_change(step)
        };
        if let Some(model) = change {
            self.session.change(&model);
            self.live.tissue.send_replace((step, model));
        }

        let (Running { session, taps, due, copies, .. }, wakes, reading) = (&mut *self, &mut desk.wakes, desk.reading);
        copies.forget();
        session.advance(due, |session| taps.record(session, copies, reading, wakes));
        self.tell_auditor();
        self.log_recovery();
        if let Some(reason) = self.session.hold_reason() {
            tracing::warn!(session = %self.live.id, reason, "session held");
            self.running = false;
            drop(lock(&self.live.intake).close(Refusal::new(Reason::SessionHeld, "", reason)));
            self.publish_status();
            for (at, _, reply) in std::mem::take(&mut self.taps.hashes) {
                let _ = reply.send(Err(self.passed(at)));
            }
            // No further record will come.
            let held = self.passed(0);
            let probes = self.taps.probes.drain(..);
            probes.for_each(|tap| desk.reading.close(&tap.account, &tap.recipient, held.clone()));
        }
        if self.until.is_some_and(|until| self.session.step_count() >= until) {
            self.running = false;
        }
        let step = self.session.step_count();
        self.still_since = self.session.rests_until().map(|_| self.still_since.unwrap_or(step));
        self.dilation.observe(begun_ns, step, self.schedule.period_ns());
        // The status first: who is told of this step may ask for it at once.
        self.publish_status();
        self.publish(desk);
        let every = (self.live.model.scene.stepping.rate_hz / REFINED_HZ).max(1.0) as u64;
        if self.session.step_count().is_multiple_of(every) {
            self.refine(desk.refiner);
        }
        self.plan();
    }

    /// Tells the auditor where the window begins or ends, without waiting: there is room for both.
    fn tell_auditor(&mut self) {
        let Some(auditor) = &self.audit else { return };
        let ended = self.session.hold_reason().is_some();
        let Some(mark) = self.session.take_mark().or(ended.then_some(Mark::Dropped)) else { return };
        let is_last = !matches!(mark, Mark::Begin(_));
        if auditor.try_send(mark).is_err() || is_last {
            self.audit = None;
        }
    }

    /// Has the stiffness computed anew under the tools of which it is told.
    fn refine(&self, refiner: &SyncSender<Refinement>) {
        for refinement in self.taps.samples.iter().flat_map(|tap| tap.sampler.refinements(&self.session)) {
            // What finds the refiner busy is left: the next is newer.
            let _ = refiner.try_send(refinement);
        }
    }

    /// Gives a stream the present sample, if it is to get it, or if no other follows for now. `all` is the sample of all
    /// tools, once a stream has asked for it.
    fn tell(&self, tap: &mut SampleTap, all: &mut Option<Sample>, last: bool, wakes: &mut Wakes) {
        let Some(sample) = tap.sampler.pick_from(&self.session, all, last || tap.once) else { return };
        let overrun = self.overrun_count > tap.overrun_count;
        tap.overrun_count = self.overrun_count;
        let Running { overrun_count, due_ns, .. } = *self;
        let paced = PacedSample { sample, due_ns, overrun_count, time_dilation: self.dilation.value, overrun };
        tap.writer.push_quietly(paced, wakes);
    }

    fn tell_all(&mut self, last: bool, wakes: &mut Wakes) {
        let (mut taps, mut all) = (std::mem::take(&mut self.taps.samples), None);
        for tap in &mut taps {
            let Some(watcher) = tap.watcher.clone() else {
                self.tell(tap, &mut all, last, wakes);
                continue;
            };
            let now = now_ns();
            // The last sample for now is not left out: the stream would miss the state in which the session stands.
            if last || watcher.must_wait_ns(Work::Reading, now) == 0 {
                self.tell(tap, &mut all, last, wakes);
                let ended = now_ns();
                watcher.spend(Work::Reading, ended, ended.saturating_sub(now));
            }
        }
        taps.retain(|tap| !tap.once);
        self.taps.samples = taps;
    }

    /// Tells everybody who wants to know of this step.
    fn publish(&mut self, desk: &mut Desk<'_>) {
        let step = self.session.step_count();
        self.tell_all(!self.running, &mut desk.wakes);
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
            self.post(desk.encoder, viewers);
        }
        for (_, account, reply) in self.taps.hashes.extract_if(.., |waiting| waiting.0 == step).collect::<Vec<_>>() {
            self.hash_for(&account, reply, desk.reading);
        }
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
        tally.paused_commands.add(self.session.paused_commands() - before.paused_commands);
        tally.lapsed_leases.add(self.lapsed_leases - before.lapsed_leases);
        tally.guard_events.add(guard_events - before.guard_events);
        let recovery_count = self.session.recoveries().count();
        tally.recoveries.add(recovery_count - before.recovery_count);
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
        status.model.clone_from(self.session.model());
        status.rested_steps = self.rested_steps;
        status.overrun_count = self.overrun_count;
        status.guard_events = guard_events;
        if status.recovery_count != recovery_count {
            (status.recovery_count, status.recoveries) = (recovery_count, self.session.recoveries().list());
        }
        status.awake_points = self.session.tissue().awake_points();
        status.path_counts = path_counts;
        status.lapsed_leases = self.lapsed_leases;
        status.dilation = self.dilation;
        status.schedule = self.schedule;
        status.late_commands = self.session.late_commands();
        status.paused_commands = self.session.paused_commands();
        if status.hold_reason.is_none() {
            status.hold_reason = self.session.hold_reason().map(str::to_owned);
        }
    }

    /// Ends every stream, and what waits.
    fn end(&mut self, why: &Refusal) {
        self.running = false;
        drop(lock(&self.live.intake).close(why.clone()));
        let taps = std::mem::take(&mut self.taps);
        taps.samples.iter().for_each(|tap| tap.writer.close(why.clone()));
        taps.probes.iter().for_each(|tap| tap.recipient.writer().close(why.clone()));
        taps.viewers.iter().for_each(|tap| tap.viewer.close(why.clone()));
        for (_, _, reply) in taps.hashes {
            let _ = reply.send(Err(why.clone()));
        }
    }
}

mod care;
#[cfg(test)]
mod tests;
