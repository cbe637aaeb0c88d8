//! The cost of a session's steps: estimated before it begins, then measured; and the largest step that is allowed.
//!
//! The step of a new session is estimated from its points and substeps, and from the times of awake sessions.
//! Sessions at rest do not count: a thousand of them are a valid use, and `limits.sessions` bounds them.

use std::sync::atomic::{AtomicU64, Ordering};

use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Scene;
use palpate_tissue::select::scheme_selection;

/// Estimates before anything was measured: time of one point and substep, and of a step beside its points, ns.
const GUESS_NS: f64 = 2.0;
const GUESS_STEP_NS: f64 = 2000.0;

/// Number of steps over which the running mean is taken.
const MEMORY: f64 = 64.0;

/// Limit of one step's time as a multiple of the mean; a longer step counts as this. A step in which the thread was
/// preempted does not characterize the session.
const OUTLIER: f64 = 8.0;

/// Time that a session takes of its thread.
#[derive(Debug)]
pub(super) struct Cost {
    /// Mean time of a step, ns, as bits of an f64.
    step_ns: AtomicU64,
    /// Fraction of a core, as bits of an f64, while steps are computed; 0 at rest.
    share: AtomicU64,
    rate_hz: f64,
    point_substeps: f64,
}

fn get(bits: &AtomicU64) -> f64 {
    f64::from_bits(bits.load(Ordering::Relaxed))
}

fn set(bits: &AtomicU64, value: f64) {
    bits.store(value.to_bits(), Ordering::Relaxed);
}

#[allow(clippy::cast_precision_loss)]
impl Cost {
    /// Estimates the cost of a session that has not begun, from the times per point of the sessions `known`.
    pub(super) fn guess<'c>(model: &Model, known: impl Iterator<Item = &'c Cost>) -> Self {
        let point_substeps = model.swept_points() as f64 * f64::from(model.plan.substeps);
        let (taken_ns, worked) = known.filter(|cost| cost.share() > 0.0).fold((0.0, 0.0), |(ns, work), cost| {
            (ns + get(&cost.step_ns), work + cost.point_substeps + GUESS_STEP_NS / GUESS_NS)
        });
        let each_ns = if worked > 0.0 { taken_ns / worked } else { GUESS_NS };
        let step_ns = each_ns * (point_substeps + GUESS_STEP_NS / GUESS_NS);
        let rate_hz = model.scene.stepping.rate_hz;
        Cost { step_ns: AtomicU64::new(step_ns.to_bits()), share: AtomicU64::new(0), rate_hz, point_substeps }
    }

    /// Returns the fraction of a core that the session takes when it is awake.
    pub(super) fn awake_share(&self) -> f64 {
        get(&self.step_ns) * 1e-9 * self.rate_hz
    }

    /// Returns the fraction of a core that it takes now; 0 at rest.
    pub(super) fn share(&self) -> f64 {
        get(&self.share)
    }

    /// Adds the time of a step to the running mean. Only the thread that steps the session may call this.
    pub(super) fn observe(&self, took_ns: u64) {
        let mean_ns = get(&self.step_ns);
        let took_ns = (took_ns as f64).min(OUTLIER * mean_ns.max(1.0));
        set(&self.step_ns, mean_ns + (took_ns - mean_ns) / MEMORY);
    }

    /// Sets whether steps are computed now.
    pub(super) fn set_awake(&self, is_awake: bool) {
        set(&self.share, if is_awake { self.awake_share() } else { 0.0 });
    }
}

/// Refuses a scene whose step would be too heavy with any scheme, before any work is done for it.
pub(super) fn check_asked(scene: &Scene, limits: &Limits) -> Result<()> {
    scene.check(limits)?;
    let (substeps, step_s) = scheme_selection::least_step(scene);
    check_step(scene.shape().point_count(), substeps, step_s, scene.stepping.rate_hz, limits)
}

/// Refuses a model whose steps would leave no time for other sessions.
pub(super) fn check_work(model: &Model, limits: &Limits) -> Result<()> {
    let (step_s, rate_hz) = (model.predicted_step_s(), model.scene.stepping.rate_hz);
    check_step(model.swept_points(), model.plan.substeps, step_s, rate_hz, limits)
}

fn check_step(points: usize, substeps: u32, step_s: f64, rate_hz: f64, limits: &Limits) -> Result<()> {
    let most = limits.point_substeps_per_step;
    if (points as u64).saturating_mul(u64::from(substeps)) > most {
        let message =
            format!("a step would compute {points} points {substeps} times, above the limit of {most} in all");
        return Err(Refusal::new(Reason::TooLarge, "stepping.substeps", message));
    }
    let (periods, most) = (step_s * rate_hz, limits.periods_per_step);
    if periods > most {
        let message = format!(
            "a step of {points} points, computed {substeps} times each, would take {:.3} ms, which is {periods:.2} of its \
             periods: above the limit of {most} (limits.periods_per_step). Fewer points, softer springs or a lower rate take less",
            step_s * 1e3
        );
        return Err(Refusal::new(Reason::TooLarge, "stepping.rate_hz", message));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model(points: &str) -> std::sync::Arc<Model> {
        Model::parse("paper", palpate_tissue::scene::PAPER, &[&format!("sheet.points={points}")]).unwrap()
    }

    #[test]
    fn a_session_is_guessed_by_what_others_take_and_only_the_awake_count() {
        let small = Cost::guess(&model("[31, 31]"), std::iter::empty());
        (0..1000).for_each(|_| small.observe(10_000));
        assert_eq!(small.share(), 0.0);
        small.set_awake(true);
        assert!((small.share() - 0.01).abs() < 1e-4);
        let large = Cost::guess(&model("[310, 310]"), std::iter::once(&small));
        assert!((0.1..1.0).contains(&large.awake_share()), "{large:?}");
        // One step in which the thread was preempted changes little.
        small.observe(1_000_000_000);
        assert!(small.awake_share() < 0.012);
        small.set_awake(false);
        assert_eq!(small.share(), 0.0);
    }
}
