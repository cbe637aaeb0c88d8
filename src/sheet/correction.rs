//! A correction: the same tissue, stepped more accurately, because an audit found an error above the tolerance.
//!
//! It is an input like a change of tissue: a recorded correction, applied at the same step, gives the same bits.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use super::audit::{Finding, Origin};
use super::choice::{self, Choice};
use super::model::Model;
use crate::limits::Limits;
use crate::refusal::Result;
use crate::scene::record::Correction;
use crate::scene::{Integrator, Precision, Scene, Stepping};

/// A correction aims at this part of the tolerance, so that the next window is not just above it again.
const AIM: f64 = 0.5;

impl Model {
    /// The correction that keeps the error of `finding` below the tolerance from step `step` on: another scheme or more
    /// substeps, a better number format, or less sleep. `None` if the error is within the tolerance, or if nothing
    /// better exists.
    pub fn correction(&self, finding: &Finding, step: u64, limits: &Limits) -> Option<Correction> {
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
                let factor = libm::pow(excess, choice::order(self.plan.integrator).recip());
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
                    Precision::F32 | Precision::Auto if self.plan.integrator.is_exponential() => Precision::Compensated,
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

    /// The scheme that the tolerance would choose, if it differs and takes fewer substeps than `needed` of the present
    /// one.
    fn better_scheme(&self, needed: u32, limits: &Limits) -> Option<Choice> {
        let stepping = &self.scene.stepping;
        let mut open = self.scene.clone();
        open.stepping =
            Stepping { integrator: Integrator::Auto, substeps: None, precision: self.precision, ..stepping.clone() };
        let choice = choice::choose(&open, limits, &choice::NEVER).ok()?.0;
        let keeps = choice.expected_error <= stepping.tolerance && choice.substeps < needed;
        let fits = self.precision != Precision::Compensated || choice.integrator.is_exponential();
        (keeps && fits && choice.integrator != self.plan.integrator).then_some(choice)
    }

    /// The same tissue, stepped as `correction` says.
    ///
    /// # Errors
    /// Refuses a correction that this model can't be compiled with.
    pub fn corrected(&self, correction: &Correction, limits: &Limits) -> Result<Arc<Self>> {
        let mut scene = self.scene.clone();
        scene.sleep_tolerance = Some(correction.sleep_tolerance);
        scene.stepping.precision = correction.precision;
        (scene.stepping.integrator, scene.stepping.substeps) = (correction.integrator, Some(correction.substeps));
        let mut model = Arc::unwrap_or_clone(Model::compile(&scene, limits)?);
        model.corrected = Some((correction.integrator, correction.substeps));
        // Keep the request; the plan and the format in force change.
        model.scene.stepping = self.scene.stepping.clone();
        Ok(Arc::new(model))
    }

    /// Compiles another tissue from this one's scene, with the scheme and at least the substeps of the correction in
    /// force.
    pub(super) fn compile_corrected(&self, scene: &Scene, limits: &Limits, stop: &AtomicBool) -> Result<Self> {
        let Some((integrator, least)) = self.corrected else {
            return Ok(Arc::unwrap_or_clone(Model::compile_until(scene, limits, stop)?));
        };
        let mut scene = scene.clone();
        (scene.stepping.integrator, scene.stepping.substeps) = (integrator, None);
        let mut model = Model::compile_until(&scene, limits, stop)?;
        if model.plan.substeps < least {
            scene.stepping.substeps = Some(least);
            model = Model::compile_until(&scene, limits, stop)?;
        }
        Ok(Model { corrected: self.corrected, ..Arc::unwrap_or_clone(model) })
    }
}
