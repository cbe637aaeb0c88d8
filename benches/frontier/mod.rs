//! Trials of schemes at several steps, and their Pareto frontier of time and error.
#![allow(unreachable_pub, missing_docs)]

use serde_json::{Value, json};

use crate::scenes::Case;

/// One scheme at one step on one scene.
#[derive(Clone)]
pub struct SchemeTrial {
    pub integrator: &'static str,
    pub precision: &'static str,
    /// Length of a substep, s.
    pub step_s: f64,
    /// Largest error, relative to the largest displacement.
    pub displacement: f64,
    /// Largest error, relative to the largest force.
    pub force: f64,
    /// Run time per simulated second, s.
    pub cost: f64,
}

/// The trials of one scheme and number format, largest step first.
pub type Curve = Vec<SchemeTrial>;

impl SchemeTrial {
    /// The larger error.
    pub fn error(&self) -> f64 {
        self.displacement.max(self.force)
    }

    pub fn figures(&self, is_best: bool) -> Value {
        json!({
            "integrator": self.integrator, "precision": self.precision, "step_s": self.step_s,
            "displacement_error": self.displacement, "force_error": self.force,
            "run_s_per_simulated_s": self.cost, "is_best": is_best,
        })
    }
}

/// Whether no other trial takes less time for an error that is smaller, or larger by at most a 50th: f32 and f64 at
/// one step differ by less, which is not worth a cost.
pub fn is_best(trial: &SchemeTrial, curves: &[Curve]) -> bool {
    !curves.iter().flatten().any(|other| other.error() < 1.02 * trial.error() && other.cost < trial.cost)
}

/// Returns whether a scheme has a trial on the frontier of any scene.
pub fn on_any_frontier(integrator: &str, precision: &str, results: &[(&Case, Vec<Curve>)]) -> bool {
    results.iter().any(|(_, curves)| {
        let mut own = curves.iter().flatten().filter(|t| t.integrator == integrator && t.precision == precision);
        own.any(|trial| is_best(trial, curves))
    })
}

/// The cost of an error.
pub struct Offer {
    /// Run time per simulated second, s.
    pub cost: f64,
    /// The scheme and number format.
    pub by: String,
    /// Whether it lies beyond the smallest step tried.
    pub extrapolated: bool,
}

/// The least cost at which the trials accepted by `of` reach `error`. If none does and `extrapolate` is true, the f64
/// curves are extrapolated at first order; rounding would stop those in f32.
pub fn cheapest(curves: &[Curve], error: f64, of: impl Fn(&SchemeTrial) -> bool, extrapolate: bool) -> Option<Offer> {
    let offers = |extrapolated: bool| {
        let curves = curves.iter().filter(|curve| of(&curve[0]) && (!extrapolated || curve[0].precision == "f64"));
        let offer = move |curve: &Curve| {
            let cost = if extrapolated { carried_on(curve, error) } else { between(curve, error)? };
            Some(Offer { cost, by: format!("{} {}", curve[0].integrator, curve[0].precision), extrapolated })
        };
        curves.filter_map(offer).min_by(|a, b| a.cost.total_cmp(&b.cost))
    };
    offers(false).or_else(|| extrapolate.then(|| offers(true)).flatten())
}

/// The cost of `error` on a curve, interpolated between its trials in logarithms. An error larger than that of the
/// largest step costs as much as that step, because a larger step is not stable.
fn between(curve: &Curve, error: f64) -> Option<f64> {
    let place = curve.iter().position(|trial| trial.error() <= error)?;
    let fine = &curve[place];
    let Some(coarse) = place.checked_sub(1).map(|place| &curve[place]) else { return Some(fine.cost) };
    let share = (coarse.error() / error).ln() / (coarse.error() / fine.error()).ln();
    Some(coarse.cost * (fine.cost / coarse.cost).powf(share))
}

/// The cost of `error` if halving the error doubles the cost.
fn carried_on(curve: &Curve, error: f64) -> f64 {
    curve.iter().map(|trial| trial.cost * trial.error() / error).fold(f64::INFINITY, f64::min)
}
