//! The schemes that advance the sheet: one file each, and one line each in [`plan`].
//!
//! Both are of the two-step form d ← p·d + q·F(u), u ← u + d, where d is the increment of the last substep and F
//! the force without damping. With the increment as the state, small movements keep their digits.

mod central;
mod lagged;

use crate::scene::Integrator;

/// What a scheme needs to know of a sheet.
#[derive(Debug, Clone, Copy)]
pub struct Oscillator {
    /// Mass of a point, kg.
    pub mass_kg: f64,
    /// C, N·s/m.
    pub damping_n_s_per_m: f64,
    /// ω_b: the fastest vibration under any deformation, rad/s.
    pub omega_per_s: f64,
    /// Length of a step, s.
    pub step_s: f64,
}

/// A scheme, fitted to a sheet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plan {
    /// What `auto` became.
    pub integrator: Integrator,
    /// Substeps a step.
    pub substeps: u32,
    /// Length of a substep, s.
    pub substep_s: f64,
    /// p of the two-step form.
    pub p: f64,
    /// q of the two-step form, s²/kg.
    pub q: f64,
    /// Whether the substep is within the stability bound. It always is if the number was not given.
    pub stable: bool,
}

/// A scheme as this module sees it.
struct Scheme {
    /// p and q for g = C·dt/m and dt²/m.
    coefficients: fn(f64, f64) -> (f64, f64),
    /// Fewest substeps that are stable and as accurate as the scheme promises.
    substeps: fn(&Oscillator) -> u32,
    /// Whether (dt·ω)² = W and g are stable.
    is_stable: fn(f64, f64) -> bool,
}

/// Fits `integrator` to a sheet; chooses the substeps if they are not given.
pub fn plan(integrator: Integrator, substeps: Option<u32>, sheet: &Oscillator) -> Plan {
    let (integrator, scheme) = match integrator {
        Integrator::Auto | Integrator::Central => (Integrator::Central, central::SCHEME),
        Integrator::Lagged => (Integrator::Lagged, lagged::SCHEME),
    };
    let substeps = substeps.unwrap_or_else(|| (scheme.substeps)(sheet));
    let substep_s = sheet.step_s / f64::from(substeps);
    let g = sheet.damping_n_s_per_m * substep_s / sheet.mass_kg;
    let (p, q) = (scheme.coefficients)(g, substep_s * substep_s / sheet.mass_kg);
    let stable = (scheme.is_stable)((substep_s * sheet.omega_per_s).powi(2), g);
    Plan { integrator, substeps, substep_s, p, q, stable }
}
