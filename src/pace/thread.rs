//! A stepping thread: it owns its sessions, and steps each when its time has come.
//!
//! Overruns: time steps are fixed. A session that is behind catches up at most [`CATCH_UP_STEPS`] steps; what it is
//! behind beyond that is dropped from its schedule, and counted. Simulated time then runs slower than real time.

use std::collections::VecDeque;
use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use tokio::sync::oneshot;

use super::clock::now_ns;
use super::frames::{Encoder, Job, Viewer};
use super::queue::{Writer, lock};
use super::{Live, PacedRecord, PacedSample, State};
use crate::haptics::Law;
use crate::refusal::{Reason, Refusal, Result};
use crate::session::Session;
use crate::session::command::Due;
use crate::session::local::{Modeller, Refinement};
use crate::surface::Snapshot;

/// Steps that a session may be behind before the rest is dropped.
const CATCH_UP_STEPS: f64 = 2.0;

/// How often the stiffness under tools is computed anew, Hz.
const REFINED_HZ: f64 = 50.0;

/// Over which time dilation is measured.
const DILATION_WINDOW_NS: u64 = 1_000_000_000;

/// Who waits for the step and the hash of a state.
type HashReply = oneshot::Sender<Result<(u64, u128)>>;

/// What a stepping thread is asked for.
pub(super) enum Request {
    Adopt(Box<Running>),
    Start { until: Option<u64>, reply: oneshot::Sender<Result<u64>> },
    Pause { reply: oneshot::Sender<Result<()>> },
    Samples(SampleTap),
    Probe(ProbeTap),
    View(Arc<Viewer>),
    LookAhead { tool: u32, law: Arc<Law> },
    Hash { at: Option<u64>, reply: HashReply },
    Delete(Refusal),
}

/// Where a stepping thread is asked.
#[derive(Default)]
pub(super) struct Inbox {
    state: Mutex<InboxState>,
    wake: Condvar,
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

/// A stream of samples.
pub(super) struct SampleTap {
    pub(super) every: u64,
    pub(super) only: Option<Vec<u32>>,
    pub(super) once: bool,
    pub(super) writer: Writer<PacedSample>,
}

/// A stream of records.
pub(super) struct ProbeTap {
    pub(super) every: u64,
    /// All, if none are named.
    pub(super) points: Option<Vec<[usize; 2]>>,
    pub(super) energy: bool,
    pub(super) writer: Writer<PacedRecord>,
}

/// A session and its schedule.
pub(super) struct Running {
    live: Arc<Live>,
    session: Session,
    running: bool,
    until: Option<u64>,
    /// Step `anchor_step` is due at `anchor_ns`, and each further one a period later.
    anchor_ns: f64,
    anchor_step: u64,
    period_ns: f64,
    overrun_count: u64,
    window: (u64, u64),
    time_dilation: f64,
    due: Vec<Due>,
    hashed: Option<(u64, u128)>,
    taps: Taps,
    deleted: bool,
}

/// Who wants to know.
#[derive(Default)]
struct Taps {
    samples: Vec<SampleTap>,
    probes: Vec<ProbeTap>,
    viewers: Vec<Arc<Viewer>>,
    hashes: Vec<(u64, HashReply)>,
}

impl Taps {
    fn forget_the_gone(&mut self) {
        self.samples.retain(|tap| !tap.writer.is_abandoned());
        self.probes.retain(|tap| !tap.writer.is_abandoned());
        self.viewers.retain(|viewer| !viewer.is_gone());
        self.hashes.retain(|waiting| !waiting.1.is_closed());
    }
}

/// The thread's work.
pub(super) fn work(inbox: &Inbox, encoder: &Encoder, refiner: &SyncSender<Refinement>) {
    // The default slack of 50 µs would be the larger part of each step's lateness. Where it can't be set, so be it.
    #[cfg(target_os = "linux")]
    let _ = rustix::thread::set_current_timer_slack(std::num::NonZeroU64::new(1));
    let mut sessions: Vec<Running> = Vec::new();
    let mut requests = VecDeque::new();
    loop {
        let next = sessions.iter().filter(|r| r.running).map(Running::deadline_ns).min();
        let stop = wait(inbox, next, &mut requests);
        if let Some(why) = stop {
            for running in &mut sessions {
                running.end(&why);
            }
            return;
        }
        // One at a time where a step is due: to answer many must not make a step wait.
        while let Some((number, request)) = requests.pop_front() {
            match request {
                Request::Adopt(running) => sessions.push(*running),
                request => {
                    if let Some(running) = sessions.iter_mut().find(|r| r.live.number == number) {
                        running.serve(request, encoder);
                    }
                }
            }
            if next.is_some_and(|next| next <= now_ns()) {
                break;
            }
        }
        sessions.retain(|running| !running.deleted);
        // The one that is due first: a heavy session is late itself before it makes others late.
        let earliest = sessions.iter_mut().filter(|r| r.running).min_by_key(|r| r.deadline_ns());
        if let Some(running) = earliest
            && running.deadline_ns() <= now_ns()
        {
            running.step(encoder, refiner);
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
        #[allow(clippy::cast_precision_loss)]
        Running {
            session: Session::new(&live.model),
            running,
            until: None,
            anchor_ns: now as f64,
            anchor_step: 0,
            period_ns: 1e9 / live.model.scene.stepping.rate_hz,
            overrun_count: 0,
            window: (now, 0),
            time_dilation: 1.0,
            due: Vec::new(),
            hashed: None,
            taps: Taps::default(),
            deleted: false,
            live,
        }
    }

    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    fn deadline_ns(&self) -> u64 {
        (self.anchor_ns + self.session.step_count().saturating_sub(self.anchor_step) as f64 * self.period_ns) as u64
    }

    fn serve(&mut self, request: Request, encoder: &Encoder) {
        let step = self.session.step_count();
        // Also while time stands, when no step does it.
        self.taps.forget_the_gone();
        match request {
            Request::Adopt(_) => {}
            Request::Start { until, reply } => {
                let started = self.start(until);
                self.publish_status();
                let _ = reply.send(started);
            }
            Request::Pause { reply } => {
                self.stand();
                let _ = reply.send(Ok(()));
            }
            Request::Samples(tap) => {
                let at_once = !self.running;
                if at_once {
                    tap.writer.push(self.paced_sample(&tap, false));
                }
                if self.session.hold_reason().is_some() {
                    tap.writer.close(self.passed(0));
                } else if !(at_once && tap.once) {
                    self.taps.samples.push(tap);
                }
            }
            Request::LookAhead { tool, law } => self.session.look_ahead_for(tool, Some(Modeller::new(law))),
            Request::Probe(tap) if self.session.hold_reason().is_some() => tap.writer.close(self.passed(0)),
            Request::Probe(tap) => self.taps.probes.push(tap),
            Request::View(viewer) => {
                // Who joins late gets a full frame first.
                let frame_id = viewer.frame_id(step, self.live.model.scene.stepping.rate_hz);
                self.post(encoder, vec![(viewer.clone(), frame_id)]);
                self.taps.viewers.push(viewer);
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

    /// Time stands from now on. Who waits for the next sample gets the present one.
    fn stand(&mut self) {
        self.running = false;
        self.publish_status();
        for tap in self.taps.samples.extract_if(.., |tap| tap.once).collect::<Vec<_>>() {
            tap.writer.push(self.paced_sample(&tap, false));
        }
    }

    fn passed(&self, at: u64) -> Refusal {
        let step = self.session.step_count();
        match self.session.hold_reason() {
            Some(reason) => Refusal::new(Reason::SessionHeld, "", reason),
            None => Refusal::new(Reason::StepPassed, "at_step", format!("is {at}, but {step} steps are done")),
        }
    }

    #[allow(clippy::cast_precision_loss)]
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
            self.anchor_ns = now as f64 + self.period_ns;
            self.anchor_step = step;
            self.window = (now, step);
        }
        Ok(step)
    }

    /// One step, at its time or after it.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn step(&mut self, encoder: &Encoder, refiner: &SyncSender<Refinement>) {
        let now = now_ns();
        let behind = ((now - self.deadline_ns()) as f64 / self.period_ns).floor() - CATCH_UP_STEPS;
        let overrun = behind > 0.0;
        if overrun {
            self.anchor_ns += behind * self.period_ns;
            self.overrun_count += behind as u64;
            tracing::debug!(session = %self.live.id, dropped = behind, "steps dropped");
        }
        lock(&self.live.intake).take_due(self.session.step_count(), now, &mut self.due);

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
            self.stand();
        }
        let elapsed_ns = now - self.window.0.min(now);
        if elapsed_ns >= DILATION_WINDOW_NS {
            let steps = (self.session.step_count() - self.window.1.min(self.session.step_count())) as f64;
            self.time_dilation = steps * self.period_ns / elapsed_ns as f64;
            self.window = (now, self.session.step_count());
        }
        // The status first: who is told of this step may ask for it at once.
        self.publish_status();
        self.publish(encoder, overrun);
        let every = (self.live.model.scene.stepping.rate_hz / REFINED_HZ).max(1.0) as u64;
        if self.session.step_count().is_multiple_of(every) {
            // What finds the refiner busy is left: the next is newer.
            self.session.refinements().for_each(|refinement| drop(refiner.try_send(refinement)));
        }
    }

    fn paced_sample(&self, tap: &SampleTap, overrun: bool) -> PacedSample {
        PacedSample {
            sample: self.session.sample(tap.only.as_deref()),
            overrun_count: self.overrun_count,
            time_dilation: self.time_dilation,
            overrun,
        }
    }

    /// Tells everybody who wants to know of this step.
    fn publish(&mut self, encoder: &Encoder, overrun: bool) {
        let step = self.session.step_count();
        let held = self.session.hold_reason().is_some();
        for tap in &self.taps.samples {
            if step.is_multiple_of(tap.every) || held || tap.once {
                tap.writer.push(self.paced_sample(tap, overrun));
            }
        }
        self.taps.samples.retain(|tap| !tap.once);
        self.taps.forget_the_gone();
        let rate_hz = self.live.model.scene.stepping.rate_hz;
        let due_frame = |viewer: &Arc<Viewer>| {
            let frame_id = viewer.frame_id(step, rate_hz);
            let is_due = held || frame_id != viewer.frame_id(step.saturating_sub(1), rate_hz);
            is_due.then(|| (viewer.clone(), frame_id))
        };
        let viewers: Vec<_> = self.taps.viewers.iter().filter_map(due_frame).collect();
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
        let snapshot =
            Snapshot { step: self.session.step_count(), simulation_time_s: self.session.time_s(), displacement_m };
        let Running { overrun_count, time_dilation, .. } = *self;
        encoder.post(self.live.number, Job { snapshot, viewers, overrun_count, time_dilation });
    }

    fn publish_status(&self) {
        let mut status = lock(&self.live.status);
        status.state = match (self.session.hold_reason(), self.running) {
            (Some(_), _) => State::Held,
            (None, true) => State::Running,
            (None, false) => State::Paused,
        };
        status.step = self.session.step_count();
        status.overrun_count = self.overrun_count;
        status.guard_events = self.session.tissue().guard_events();
        status.time_dilation = self.time_dilation;
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
        taps.viewers.iter().for_each(|viewer| viewer.close(why.clone()));
        for (_, reply) in taps.hashes {
            let _ = reply.send(Err(why.clone()));
        }
    }
}
