//! The auditor: one thread, named `audit`, that measures errors of live sessions. It uses a small fraction of a
//! core, at a lower priority than stepping.
//!
//! It asks the awake sessions in turn for a window of steps (`palpate_tissue::select::audit`), and repeats that
//! window in f64 with a quarter of the substep. The stepping thread shares two checkpoints and records the tools'
//! inputs. It waits for nothing and copies nothing, unless the auditor has not taken its copy of a checkpoint before
//! the next one is made. After each slice of work the auditor rests until its processor time is within its share of
//! a core.
//!
//! The results appear in the session's status, in the metrics and, if an error is above the tolerance, in the log.
//! If the scene sets `correct`, a more accurate model replaces the tissue as any change does: through the intake,
//! at a step that the log and the status name.

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
use super::session_handle::SessionHandle;
use palpate_haptics::Tip;
use palpate_refusal::Result;
use palpate_session::budget::{Purpose, Resource};
use palpate_tissue::Model;
use palpate_tissue::guard::INTERVAL_SUBSTEPS;
use palpate_tissue::lock::lock;
use palpate_tissue::memory;
use palpate_tissue::response::force_law::Disc;
use palpate_tissue::response::mesh_error::MeshErrorEstimate;
use palpate_tissue::scene::Named;
use palpate_tissue::scene::record::Correction;
use palpate_tissue::select::audit::{Audit, AuditFinding, FINER, Mark, Origin, WindowInputs};

/// Wait between looks for an awake session.
const IDLE: Duration = Duration::from_millis(250);

/// A session whose window takes more than this multiple of its nominal time is skipped: for example, it was paused.
const MAX_WINDOW_FACTOR: f64 = 2.0;

/// Least time between two warnings about one session, ns.
const WARN_EVERY_NS: u64 = 10_000_000_000;

/// All sessions of a server, by their ID.
pub(super) type Sessions = Arc<Mutex<BTreeMap<String, Arc<SessionHandle>>>>;

/// The auditor, as other threads see it.
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

    /// Waits for `time`, or until the auditor is stopped. Returns false if it is stopped.
    fn wait(&self, time: Duration) -> bool {
        let stopped = lock(&self.stopped);
        let waited = self.wake.wait_timeout_while(stopped, time, |stopped| !*stopped);
        !*waited.unwrap_or_else(PoisonError::into_inner).0
    }

    /// Runs the thread, with `share` of a core, until it is stopped.
    pub(super) fn work(&self, sessions: &Sessions, share: f64) {
        let mut duty = Duty { auditor: self, share, since_ns: thread_time_ns() };
        let mut last = String::new();
        loop {
            let goes_on = match next_awake(sessions, &last) {
                Some(handle) => {
                    last.clone_from(&handle.id);
                    // A fault in one audit must not end the others.
                    let audited = catch_unwind(AssertUnwindSafe(|| {
                        estimate_mesh_error(&handle);
                        audit(&handle, sessions, &mut duty, &self.tally);
                    }));
                    if let Err(panic) = audited {
                        match memory::refusal_of(&*panic) {
                            Some(refusal) => tracing::debug!(session = %handle.id, %refusal, "no audit"),
                            None => tracing::error!(session = %handle.id, "a fault of the program ended an audit"),
                        }
                    }
                    // Also after an audit without result, because asking takes time too.
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

/// Returns the next awake session after the one with the ID `last`, in the order of IDs; the first follows the
/// last. This thread has a low priority, and may be preempted for long while it holds the lock that every call
/// needs: so it takes the lock for one session at a time.
fn next_awake(sessions: &Sessions, last: &str) -> Option<Arc<SessionHandle>> {
    let after = |id: &str| {
        let sessions = lock(sessions);
        sessions.range::<str, _>((Bound::Excluded(id), Bound::Unbounded)).next().map(|(_, handle)| handle.clone())
    };
    let is_awake = |handle: &Arc<SessionHandle>| handle.cost.share() > 0.0;
    let rest = std::iter::successors(after(last), |handle| after(&handle.id));
    let beginning =
        std::iter::successors(after(""), |handle| after(&handle.id)).take_while(|handle| *handle.id <= *last);
    rest.chain(beginning).find(is_awake)
}

/// Limits the thread to its share of a core.
struct Duty<'a> {
    auditor: &'a Auditor,
    share: f64,
    since_ns: u64,
}

impl Duty<'_> {
    /// Rests for the work since the last rest. Returns false if the auditor is stopped.
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

/// Estimates the error of the cells of a session's tissue, once. It takes up to some seconds.
fn estimate_mesh_error(handle: &SessionHandle) {
    if std::mem::replace(&mut lock(&handle.audited).knows_mesh, true) {
        return;
    }
    // Eight times as many cells, if they are few.
    let bytes = 9 * handle.model.bytes();
    let _taken = match handle.owner.take(Resource::Memory(Purpose::Laws), bytes, "") {
        Ok(taken) => taken,
        Err(refusal) => return tracing::debug!(session = %handle.id, %refusal, "no estimate of the cells' error"),
    };
    let disc = Disc::in_middle(&handle.model, Tip::default().radius_m);
    lock(&handle.audited).mesh_error = MeshErrorEstimate::of(&handle.model, disc);
}

/// Audits one window of a session, if the window arrives in time and there is memory for it.
fn audit(handle: &SessionHandle, sessions: &Sessions, duty: &mut Duty<'_>, tally: &AuditTally) {
    let bytes = Audit::bytes(&handle.model);
    let _taken = match handle.owner.take(Resource::Memory(Purpose::Session), bytes, "") {
        Ok(taken) => taken,
        Err(refusal) => return tracing::debug!(session = %handle.id, %refusal, "no audit"),
    };
    let (marks, told) = sync_channel(2);
    handle.inbox.send(handle.number, Request::Audit(WindowInputs::default(), marks));
    let Some((model, opening)) = next(&told, longest(&handle.model)).and_then(|mark| match mark {
        Mark::Begin(begin) => Some((begin.model().clone(), begin.open())),
        Mark::End(..) | Mark::Dropped => None,
    }) else {
        return;
    };
    let Some(Mark::End(end, inputs)) = next(&told, longest(&model)) else { return };
    let audit = opening.close(end, inputs);
    let extent = lock(&handle.audited).extent;
    // A deleted session needs no audit, and its memory must be freed.
    let mut goes_on = || duty.rest() && lock(sessions).contains_key(&handle.id);
    let Some(finding) = audit.work(FINER, extent, &mut goes_on) else { return };
    note(handle, &finding, tally);
    let Some(origin) = finding.origin else { return };
    if model.scene.stepping.correct {
        let corrected = correct(handle, &model, &finding);
        note_correction(handle, corrected, tally);
    }
    warn(handle, &finding, origin);
}

fn next(told: &Receiver<Mark>, within: Duration) -> Option<Mark> {
    told.recv_timeout(within).ok()
}

/// Returns the time to wait for the beginning or the end of a window, each with one interval of checkpoints before
/// it.
#[allow(clippy::cast_precision_loss)]
fn longest(model: &Model) -> Duration {
    let interval = (INTERVAL_SUBSTEPS / u64::from(model.plan.substeps)).max(1);
    let steps = (model.window_steps() + interval) as f64;
    Duration::from_secs_f64((MAX_WINDOW_FACTOR * steps / model.scene.stepping.rate_hz + 1.0).min(600.0))
}

fn note(handle: &SessionHandle, finding: &AuditFinding, tally: &AuditTally) {
    let AuditFinding { step, error, origin, largest, .. } = *finding;
    let is_above = origin.is_some();
    tally.windows.add(1);
    tally.above.add(u64::from(is_above));
    let mut audited = lock(&handle.audited);
    audited.windows += 1;
    audited.above += u64::from(is_above);
    audited.newest = Some((step, error));
    audited.largest = audited.largest.max(error);
    audited.extent = largest;
    audited.origin = origin.or(audited.origin);
}

/// Logs an error above the tolerance, and why a requested correction was refused; at most every 10 s for one
/// session.
fn warn(handle: &SessionHandle, finding: &AuditFinding, origin: Origin) {
    let AuditFinding { step, error, .. } = *finding;
    let now = now_ns();
    let mut audited = lock(&handle.audited);
    if audited.warned_ns.is_some_and(|warned| now < warned + WARN_EVERY_NS) {
        return;
    }
    audited.warned_ns = Some(now);
    let (above, refused) = (audited.above, audited.refused_correction.clone());
    drop(audited);
    let (asked, from) = (handle.model.scene.stepping.tolerance, origin.describe());
    let refused = refused.map(|refusal| format!("; a correction was refused: {refusal}")).unwrap_or_default();
    tracing::warn!(
        session = %handle.id, step, displacement = error.displacement, force = error.force, asked, windows = above,
        "audited error above the tolerance: most of it comes from {from}{refused}"
    );
}

/// Makes the steps of the tissue more accurate from the next step on. `None` if the tissue has changed meanwhile,
/// or if there is no suitable correction.
///
/// # Errors
/// Refuses a correction whose steps would take longer than a scene's may.
fn correct(handle: &SessionHandle, audited: &Arc<Model>, finding: &AuditFinding) -> Result<Option<Correction>> {
    let base = handle.at_intake(|intake, _| intake.changed_to());
    if !Arc::ptr_eq(base.as_ref().unwrap_or(&handle.model), audited) {
        return Ok(None);
    }
    let Some(correction) = audited.correction(finding, finding.step, &handle.limits) else { return Ok(None) };
    let model = audited.corrected(&correction, &handle.limits)?;
    check_work(&model, &handle.limits)?;
    let step = handle.at_intake(|intake, now| intake.change(base.as_ref(), &model, None, now))?;
    Ok(step.map(|step| Correction { step, ..correction }))
}

fn note_correction(handle: &SessionHandle, corrected: Result<Option<Correction>>, tally: &AuditTally) {
    match corrected {
        Ok(Some(told)) => {
            tally.corrections.add(1);
            tracing::info!(
                session = %handle.id, step = told.step, integrator = told.integrator.name(), substeps = told.substeps, precision = told.precision.name(),
                sleep_tolerance = told.sleep_tolerance, "tissue corrected: {} had too large an error", told.reason
            );
            let mut audited = lock(&handle.audited);
            audited.corrections += 1;
            (audited.correction, audited.refused_correction) = (Some(told), None);
        }
        Ok(None) => {}
        Err(refusal) => lock(&handle.audited).refused_correction = Some(refusal),
    }
}
