//! A correction: after an audit found an error above the tolerance, the same tissue is stepped more accurately.
//!
//! It is an input like a change of tissue: a recorded correction, applied at the same step, gives the same
//! bits.

use std::sync::Arc;

use crate::body::model::Model;
use crate::limits::Limits;
use crate::scene::record::Correction;
use crate::scene::{Integrator, Precision, Stepping};
use crate::scheme::entry;
use crate::select::audit::{AuditFinding, Origin};
use crate::select::scheme_selection::{self, Choice};
use palpate_refusal::Result;

/// The fraction of the tolerance at which a correction aims, so that the next window is not just above it
/// again.
const AIM: f64 = 0.5;

impl Model {
    /// Returns the correction that should bring the error of `finding`, of this model, to half of the
    /// tolerance, from step `step` on: another scheme or more substeps (at most `limits.substeps`), a better
    /// number format, or less sleep. `None` if the finding has no origin (the error is within the tolerance),
    /// or if nothing better exists. It may run rehearsals, which block for some tenths of a second. Nothing is
    /// changed: pass it to [`Model::corrected()`].
    pub fn correction(&self, finding: &AuditFinding, step: u64, limits: &Limits) -> Option<Correction> {
        let origin = finding.origin?;
        let excess = finding.error.largest() / (AIM * self.scene.stepping.tolerance);
        let mut correction = Correction {
            step,
            audited_error: finding.error,
            reason: origin.describe().to_owned(),
            integrator: self.plan.integrator,
            substeps: finding.substeps.max(self.plan.substeps),
            precision: self.precision,
            sleep_tolerance: self.sleep_tolerance,
        };
        match origin {
            Origin::Substep => {
                let factor = libm::pow(excess, entry(self.plan.integrator).order.recip());
                let needed = (f64::from(correction.substeps) * factor).ceil();
                #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
                let needed = needed.max(f64::from(correction.substeps + 1)) as u32;
                let possible = needed.min(limits.substeps);
                if let Some(better) = self.better_scheme(needed, limits) {
                    (correction.integrator, correction.substeps) = (better.integrator, better.substeps);
                } else if possible > correction.substeps {
                    correction.substeps = possible;
                } else {
                    return None;
                }
            }
            Origin::Rounding => {
                correction.precision = match self.precision {
                    Precision::F64 => return None,
                    Precision::F32 | Precision::Auto if entry(self.plan.integrator).compensates => {
                        Precision::Compensated
                    }
                    Precision::F32 | Precision::Auto | Precision::Compensated => Precision::F64,
                };
            }
            Origin::Sleep => {
                let tolerance = self.sleep_tolerance;
                correction.sleep_tolerance = if tolerance > f64::EPSILON { tolerance / excess.max(2.0) } else { 0.0 };
            }
        }
        Some(correction)
    }

    /// Returns the scheme that the tolerance would choose, if it differs from the present one and needs fewer
    /// substeps than `needed`.
    fn better_scheme(&self, needed: u32, limits: &Limits) -> Option<Choice> {
        let stepping = &self.scene.stepping;
        let mut open = self.scene.clone();
        open.stepping =
            Stepping { integrator: Integrator::Auto, substeps: None, precision: self.precision, ..stepping.clone() };
        let choice = scheme_selection::choose(&open, limits, &scheme_selection::NEVER).ok()?.0;
        let keeps = choice.expected_error <= stepping.tolerance && choice.substeps < needed;
        let fits = self.precision != Precision::Compensated || entry(choice.integrator).compensates;
        (keeps && fits && choice.integrator != self.plan.integrator).then_some(choice)
    }

    /// Compiles the same tissue, stepped as `correction` says, for [`Tissue::changed`](crate::Tissue::changed)
    /// or [`Tissue::change`](crate::Tissue::change). Later changes keep to the correction. Blocks as
    /// [`Model::compile`] does.
    ///
    /// # Errors
    /// Refuses a correction with which [`Model::compile`] refuses the scene, as with more substeps than
    /// `limits.substeps`.
    pub fn corrected(&self, correction: &Correction, limits: &Limits) -> Result<Arc<Self>> {
        let mut scene = self.scene.clone();
        scene.sleep_tolerance = Some(correction.sleep_tolerance);
        scene.stepping.precision = correction.precision;
        (scene.stepping.integrator, scene.stepping.substeps) = (correction.integrator, Some(correction.substeps));
        let mut model = Arc::unwrap_or_clone(Model::compile(&scene, limits)?);
        model.corrected = Some((correction.integrator, correction.substeps));
        // Keep the request; the plan and the format in force change.
        model.scene.stepping = self.scene.stepping.clone();
        model.warn_of_error(limits);
        Ok(Arc::new(model))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::scene::Named;
    use crate::scheme::order;
    use crate::select::audit::{AuditedError, ErrorExtent};

    fn finding(error: f64, origin: Origin) -> AuditFinding {
        let error = AuditedError { displacement: error, force: 0.5 * error };
        AuditFinding { step: 64, error, origin: Some(origin), substeps: 4, largest: ErrorExtent::default() }
    }

    #[test]
    fn more_substeps_are_as_many_as_the_order_of_the_scheme_asks_for() {
        // Without work for rehearsals no other scheme is looked for.
        let limits = Limits { rehearsal_work: 0, ..Limits::default() };
        // tests/reference.rs measures the orders.
        for integrator in Integrator::of_anchored() {
            let (order, integrator) = (order(integrator), format!("stepping.integrator={}", integrator.name()));
            let sets = [&integrator, "sheet.points=[3, 3]", "stepping.substeps=4", "stepping.tolerance=1e-4"];
            let correction = Model::paper(&sets).correction(&finding(2e-3, Origin::Substep), 70, &limits).unwrap();
            // An error of order p falls with the p-th power of the substep: from 2e-3 to half of the tolerance.
            let left = |substeps: u32| 2e-3 * (4.0 / f64::from(substeps)).powf(order);
            let substeps = correction.substeps;
            assert!(left(substeps) <= 5.01e-5 && left(substeps - 1) > 4.99e-5, "{integrator}: {substeps}");
            assert_eq!((correction.step, correction.audited_error.displacement), (70, 2e-3));
        }
    }

    #[test]
    fn another_scheme_is_taken_if_it_needs_fewer_substeps() {
        let limits = Limits::default();
        for (integrator, precision) in [("exponential2", "compensated"), ("exponential2", "f64"), ("lagged", "f32")] {
            let [integrator, precision] =
                [format!("stepping.integrator={integrator}"), format!("stepping.precision={precision}")];
            let sets =
                [&integrator, &precision, "sheet.points=[7, 7]", "stepping.substeps=1", "stepping.tolerance=1e-5"];
            let model = Model::paper(&sets);
            let correction = model.correction(&finding(0.1, Origin::Substep), 70, &limits).unwrap();
            assert_ne!(correction.integrator, model.plan.integrator, "{sets:?}");
            let corrected = model.corrected(&correction, &limits).unwrap();
            assert!(corrected.expected_error <= 1e-5, "{sets:?}: {correction:?}");
            assert_eq!(corrected.precision, model.precision);
        }
    }

    #[test]
    fn rounding_asks_for_a_better_format_and_sleep_for_less_of_it() {
        let limits = Limits::default();
        for (integrator, precision, better) in [
            ("central", "f32", Some(Precision::F64)),
            ("exponential3", "f32", Some(Precision::Compensated)),
            ("exponential3", "compensated", Some(Precision::F64)),
            ("exponential3", "f64", None),
        ] {
            let [integrator, precision] =
                [format!("stepping.integrator={integrator}"), format!("stepping.precision={precision}")];
            let sets = [&integrator, &precision, "sheet.points=[3, 3]", "stepping.substeps=1", "sleep.tolerance=1e-4"];
            let model = Model::paper(&sets);
            let correct = |origin| model.correction(&finding(1e-3, origin), 70, &limits);
            assert_eq!(correct(Origin::Rounding).map(|correction| correction.precision), better, "{sets:?}");
            let asleep = correct(Origin::Sleep).unwrap();
            assert!(asleep.sleep_tolerance <= 0.5e-4 && asleep.substeps == 4, "{asleep:?}");
        }
    }
}
