//! The scale on which a parameter is searched for: without bounds, and the same for large and small values.

use palpate_tissue::scene::tissue_parameter::TissueParameter;

/// Poisson's ratio stays below this, the largest of a scene.
const MAX_POISSON: f64 = 0.495;

/// How far the search goes from its start: a factor of e^9, 8000, up or down.
const FARTHEST: f64 = 9.0;

/// Maps a number x, 0 at the start, to a value: start·eˣ of what is positive, and 0.495/(1 + e^−(x₀ + x)) of Poisson's ratio.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Scale {
    /// Of a value above 0, which begins here.
    Logarithm(f64),
    /// Of Poisson's ratio, with x₀ of the value where it begins.
    Poisson(f64),
}

impl Scale {
    /// Returns the scale of a parameter that begins at a value; a Poisson's ratio below 0.01 or above 0.49 begins there.
    pub fn of(parameter: TissueParameter, start: f64) -> Self {
        if parameter != TissueParameter::PoissonsRatio {
            return Scale::Logarithm(start);
        }
        let part = start.clamp(0.01, 0.49) / MAX_POISSON;
        Scale::Poisson((part / (1.0 - part)).ln())
    }

    /// Returns the value at a number.
    pub fn value(&self, x: f64) -> f64 {
        let x = x.clamp(-FARTHEST, FARTHEST);
        match self {
            Scale::Logarithm(start) => start * x.exp(),
            // From 0.0015 to 0.4935: towards ½ runs take ever longer.
            Scale::Poisson(start) => MAX_POISSON / (1.0 + (-(start + x).clamp(-5.8, 5.8)).exp()),
        }
    }

    /// Returns the differences of x by which a search differentiates a parameter, each with what the difference of the forces is divided
    /// by: first toward the softer tissue, which takes no more substeps, then the other way, for where that tissue has no forces. Forces
    /// are nearly proportional to a value that is above 0, or linear in it: then d/dx is the difference divided by eʰ − 1, however large
    /// the step h is. It is large enough that the difference does not drown in the errors of runs.
    pub fn steps(&self, parameter: TissueParameter) -> [[f64; 2]; 2] {
        let step: f64 = match parameter {
            _ if parameter.adds_by_motion() => 0.2,
            TissueParameter::BranchTime(_) => 0.2,
            _ => 0.1,
        };
        let divisor = |step: f64| if matches!(self, Scale::Poisson(_)) { step } else { step.exp_m1() };
        [-step, step].map(|step| [step, divisor(step)])
    }

    /// Returns whether an interval of the values is too wide to say anything: more than a factor of two up and down, and of
    /// Poisson's ratio more than 0.1.
    pub fn is_too_wide(&self, x: f64, half_width: f64) -> bool {
        if half_width.is_nan() {
            return true;
        }
        match self {
            Scale::Logarithm(_) => half_width > std::f64::consts::LN_2,
            Scale::Poisson(_) => self.value(x + half_width) - self.value(x - half_width) > 0.2,
        }
    }
}
