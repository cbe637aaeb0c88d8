//! The auditor: one thread, named `audit`, that measures errors of live sessions, with little time and a lower priority than
//! stepping.
//!
//! It asks the awake sessions in turns for a window of steps (`sheet::audit`), and repeats that at a quarter of the substep
//! in f64. The stepping thread shares two checkpoints and writes down what the tools are told; it waits for nothing and
//! copies nothing, unless the auditor has not taken its copy of a checkpoint before the next one is made. After each slice
//! of work the auditor rests until its processor time is within its share of a core.
//!
//! What it finds is told in the session's status, in the metrics, and in the log if it is above the tolerance. Where the
//! scene says `correct`, a more accurate model enters as another tissue does: through the intake, at a step that is told.

use std::collections::BTreeMap;
use std::ops::Bound;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::mpsc::{Receiver, sync_channel};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

use super::audited::AuditTally;
use super::clock::{now_ns, thread_time_ns};
use super::cost::check_work;
use super::inbox::Request;
use super::live::Live;
use crate::budget::{Purpose, Resource};
use crate::lock::lock;
use crate::memory;
use crate::refusal::Result;
use crate::scene::Named;
use crate::scene::record::Correction;
use crate::sheet::Model;
use crate::sheet::audit::{Audit, FINER, Finding, Inputs, Mark, Origin};
use crate::sheet::guard::INTERVAL_SUBSTEPS;

/// How long to wait where no session is awake.
const IDLE: Duration = Duration::from_millis(250);

/// A session whose window takes more than so many times what it should is passed over: it was paused, say.
const PATIENCE: f64 = 2.0;

/// Between two warnings about one session, ns.
const WARN_EVERY_NS: u64 = 10_000_000_000;

/// All sessions of a server.
pub(super) type Sessions = Arc<Mutex<BTreeMap<String, Arc<Live>>>>;

/// The thread, as others see it.
#[derive(Debug, Default)]
pub(super) struct Auditor {
    stopped: Mutex<bool>,
    wake: Condvar,
    pub(super) tally: AuditTally,
}

impl Auditor {
    pub(super) fn stop(&self) {
        *lock(&self.stopped) = true;
        self.wake.notify_all();
    }

    /// Waits so long, or until it is to stop. False if it is.
    fn wait(&self, time: Duration) -> bool {
        let stopped = lock(&self.stopped);
        let waited = self.wake.wait_timeout_while(stopped, time, |stopped| !*stopped);
        !*waited.unwrap_or_else(PoisonError::into_inner).0
    }

    /// The thread's work, with `share` of a core.
    pub(super) fn work(&self, sessions: &Sessions, share: f64) {
        let mut duty = Duty { auditor: self, share, since_ns: thread_time_ns() };
        let mut last = String::new();
        loop {
            let goes_on = match next_awake(sessions, &last) {
                Some(live) => {
                    last.clone_from(&live.id);
                    // A fault in one audit must not end the others.
                    let audited = catch_unwind(AssertUnwindSafe(|| audit(&live, sessions, &mut duty, &self.tally)));
                    if let Err(panic) = audited {
                        match memory::refusal_of(&*panic) {
                            Some(refusal) => tracing::debug!(session = %live.id, %refusal, "no audit"),
                            None => tracing::error!(session = %live.id, "a fault of the program ended an audit"),
                        }
                    }
                    // Also where nothing came of it: to ask is work too.
                    duty.rest() && self.wait(Duration::from_millis(1))
                }
                None => self.wait(IDLE),
            };
            if !goes_on {
                return;
            }
        }
    }
}

/// The next session after the one with the id `last` that is awake, in the order of ids, the first after the last. This thread
/// gives way, and may be stopped for long while it holds the lock that every call needs: so it holds it for one session at a time.
fn next_awake(sessions: &Sessions, last: &str) -> Option<Arc<Live>> {
    let after = |id: &str| {
        let sessions = lock(sessions);
        sessions.range::<str, _>((Bound::Excluded(id), Bound::Unbounded)).next().map(|(_, live)| live.clone())
    };
    let is_awake = |live: &Arc<Live>| live.cost.share() > 0.0;
    let rest = std::iter::successors(after(last), |live| after(&live.id));
    let beginning = std::iter::successors(after(""), |live| after(&live.id)).take_while(|live| *live.id <= *last);
    rest.chain(beginning).find(is_awake)
}

/// Keeps the thread to its share of a core.
struct Duty<'a> {
    auditor: &'a Auditor,
    share: f64,
    since_ns: u64,
}

impl Duty<'_> {
    /// Rests for what was done since the last rest. False if it is time to stop.
    #[allow(clippy::cast_precision_loss)]
    fn rest(&mut self) -> bool {
        let now_ns = thread_time_ns();
        let busy_ns = now_ns.saturating_sub(self.since_ns);
        self.since_ns = now_ns;
        self.auditor.tally.busy_ns.add(busy_ns);
        let rest_s = busy_ns as f64 * 1e-9 * (self.share.recip() - 1.0).max(0.0);
        self.auditor.wait(Duration::from_secs_f64(rest_s))
    }
}

/// Audits one window of a session, if one comes, and if there is memory for it.
fn audit(live: &Live, sessions: &Sessions, duty: &mut Duty<'_>, tally: &AuditTally) {
    let bytes = Audit::bytes(&live.model);
    let _taken = match live.owner.take(Resource::Memory(Purpose::Session), bytes, "") {
        Ok(taken) => taken,
        Err(refusal) => return tracing::debug!(session = %live.id, %refusal, "no audit"),
    };
    let (marks, told) = sync_channel(2);
    live.inbox.send(live.number, Request::Audit(Inputs::default(), marks));
    let Some((model, opening)) = next(&told, longest(&live.model)).and_then(|mark| match mark {
        Mark::Begin(begin) => Some((begin.model().clone(), begin.open())),
        Mark::End(..) | Mark::Dropped => None,
    }) else {
        return;
    };
    let Some(Mark::End(end, inputs)) = next(&told, longest(&model)) else { return };
    let audit = opening.close(end, inputs);
    let extent = lock(&live.audited).extent;
    // Nobody wants to know of a session that is deleted, and its memory is to be freed.
    let mut goes_on = || duty.rest() && lock(sessions).contains_key(&live.id);
    let Some(finding) = audit.work(FINER, extent, &mut goes_on) else { return };
    note(live, &finding, tally);
    let Some(origin) = finding.origin else { return };
    if model.scene.stepping.correct {
        let corrected = correct(live, &model, &finding);
        note_correction(live, corrected, tally);
    }
    warn(live, &finding, origin);
}

fn next(told: &Receiver<Mark>, within: Duration) -> Option<Mark> {
    told.recv_timeout(within).ok()
}

/// How long to wait for the beginning or the end of a window: with one interval of checkpoints before each.
#[allow(clippy::cast_precision_loss)]
fn longest(model: &Model) -> Duration {
    let interval = (INTERVAL_SUBSTEPS / u64::from(model.plan.substeps)).max(1);
    let steps = (model.window_steps() + interval) as f64;
    Duration::from_secs_f64((PATIENCE * steps / model.scene.stepping.rate_hz + 1.0).min(600.0))
}

fn note(live: &Live, finding: &Finding, tally: &AuditTally) {
    let Finding { step, error, origin, largest, .. } = *finding;
    let is_above = origin.is_some();
    tally.windows.add(1);
    tally.above.add(u64::from(is_above));
    let mut audited = lock(&live.audited);
    audited.windows += 1;
    audited.above += u64::from(is_above);
    audited.newest = Some((step, error));
    audited.largest = audited.largest.max(error);
    audited.extent = largest;
    audited.origin = origin.or(audited.origin);
}

/// Logs an error above the tolerance, and why no correction was made of it if that was asked for. Not too often.
fn warn(live: &Live, finding: &Finding, origin: Origin) {
    let Finding { step, error, .. } = *finding;
    let now = now_ns();
    let mut audited = lock(&live.audited);
    if audited.warned_ns.is_some_and(|warned| now < warned + WARN_EVERY_NS) {
        return;
    }
    audited.warned_ns = Some(now);
    let (above, refused) = (audited.above, audited.refused_correction.clone());
    drop(audited);
    let (asked, from) = (live.model.scene.stepping.tolerance, origin.describe());
    let refused = refused.map(|refusal| format!("; a correction was refused: {refusal}")).unwrap_or_default();
    tracing::warn!(
        session = %live.id, step, displacement = error.displacement, force = error.force, asked, windows = above,
        "audited error above the tolerance: most of it comes from {from}{refused}"
    );
}

/// Steps the tissue more accurately from the next step on. Nothing happens if meanwhile it is another.
///
/// # Errors
/// Refuses a correction whose steps would take longer than a scene's may.
fn correct(live: &Live, audited: &Arc<Model>, finding: &Finding) -> Result<Option<Correction>> {
    let base = live.at_intake(|intake, _| intake.changed_to());
    if !Arc::ptr_eq(base.as_ref().unwrap_or(&live.model), audited) {
        return Ok(None);
    }
    let Some(correction) = audited.correction(finding, finding.step, &live.limits) else { return Ok(None) };
    let model = audited.corrected(&correction, &live.limits)?;
    check_work(&model, &live.limits)?;
    let step = live.at_intake(|intake, now| intake.change(base.as_ref(), &model, None, now))?;
    Ok(step.map(|step| Correction { step, ..correction }))
}

fn note_correction(live: &Live, corrected: Result<Option<Correction>>, tally: &AuditTally) {
    match corrected {
        Ok(Some(told)) => {
            tally.corrections.add(1);
            tracing::info!(
                session = %live.id, step = told.step, integrator = told.integrator.name(), substeps = told.substeps, precision = told.precision.name(),
                sleep_tolerance = told.sleep_tolerance, "tissue corrected: {} had too large an error", told.reason
            );
            let mut audited = lock(&live.audited);
            audited.corrections += 1;
            (audited.correction, audited.refused_correction) = (Some(told), None);
        }
        Ok(None) => {}
        Err(refusal) => lock(&live.audited).refused_correction = Some(refusal),
    }
}
