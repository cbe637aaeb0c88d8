//! What a tolerance asks for: integrator, substeps and precision, and the error that they are expected to have.
//!
//! **The model of the error.** A force that is switched on at a point excites every vibration of the sheet. Of a
//! vibration whose springs pull with −z·u (times in substeps, see `integrate`) both the exact course and the scheme's
//! are known. The largest difference of the two over time, for vibrations spread evenly over z up to the bound under
//! any deformation, gives what to expect: of displacements, in which a vibration has weight 1/(z + a), and of forces, in
//! which all weigh the same. The sheet is not linear, and tools do other things than to switch on: so a part
//! [`SAFETY`] of the tolerance is aimed at. (Measured against expected, on all scenes of `make bench-error`:
//! docs/benchmarks/error.md.)
//!
//! **Rounding.** f32 errs by what [`rounding`] says, from measurements; a tenth of the tolerance may be that.

use super::integrate::{Oscillator, Scheme};
use super::stability;
use crate::scene::{Integrator, Precision, Stepping};

/// Part of the tolerance that is aimed at.
const SAFETY: f64 = 0.4;

/// Vibrations that are looked at.
const VIBRATIONS: u32 = 12;

/// Longest course that is looked at, s. Where vibrations last longer, their error grows in proportion, up to
/// [`LASTING_S`].
const COURSE_S: f64 = 0.25;

/// Errors that grow with time, where nothing damps them, are expected for so long, s.
pub const LASTING_S: f64 = 2.0;

/// What a substep costs, in those of `central` in f32: integrator, order of the error, cost. Measured (`make bench-kernel`).
const CANDIDATES: [(Integrator, f64, f64); 4] = [
    (Integrator::Central, 2.0, 1.0),
    (Integrator::Exponential2, 3.0, 1.3),
    (Integrator::Exponential3, 4.0, 1.4),
    (Integrator::Exponential4, 5.0, 1.6),
];

/// Numbers of substeps that are tried before they are doubled.
const MOST_ROUNDS: u32 = 32;

/// What f64 and compensated f32 cost, in f32.
const COST_F64: f64 = 2.6;
const COST_COMPENSATED: f64 = 1.1;

/// An integrator, how often it is used in a step, in which format, and what to expect of that.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Choice {
    /// The integrator.
    pub integrator: Integrator,
    /// Substeps a step.
    pub substeps: u32,
    /// The format.
    pub precision: Precision,
    /// Expected error of displacement and force, the larger, relative to the largest of each.
    pub expected_error: f64,
}

/// The expected error of a scheme with so many substeps in a step of `step_s`, but for rounding: of displacement and of
/// force, at the ends of steps, which is all that anybody sees.
pub fn expected_error(integrator: Integrator, sheet: &Oscillator, step_s: f64, seen: u32) -> [f64; 2] {
    let substep_s = step_s / f64::from(seen);
    let (a, g) = sheet.scaled(substep_s);
    let scheme = Scheme::fit(integrator, a, g);
    let stiffest = sheet.scaled_spring_stiffness(substep_s);
    let decay_s = 2.0 * sheet.mass_kg / sheet.damping_n_s_per_m;
    let course_s = COURSE_S.min(4.0 * decay_s);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let substeps = ((course_s / substep_s).ceil().min(1e5) as u32).max(seen.saturating_mul(16).min(100_000)).max(seen);
    // Damping ends the growth of an error; until then it is in proportion to time.
    let growth = (decay_s.min(LASTING_S) / course_s).max(1.0);
    let (mut errors, mut largest) = ([0.0; 2], [0.0; 2]);
    for k in 0..VIBRATIONS {
        let z = stiffest * (f64::from(k) + 0.5) / f64::from(VIBRATIONS);
        let [u, force] = scheme.error_of_a_switched_force(z, a, g, substeps, seen);
        errors[0] += u;
        errors[1] += force;
        largest[0] += 1.0 / (z + a).max(f64::MIN_POSITIVE);
        largest[1] += 1.0;
    }
    // Without springs nothing but the linear part moves, and all schemes but the two-step ones are exact.
    let part = |which: usize| if stiffest + a > 0.0 { growth * errors[which] / largest[which] } else { 0.0 };
    [part(0), part(1)]
}

/// What rounding is expected to add: measured, see docs/benchmarks/error.md.
pub fn rounding(precision: Precision, sheet: &Oscillator, substep_s: f64) -> f64 {
    let unit = f64::from(f32::EPSILON) / 2.0;
    // A displacement that creeps by less than half its last digit in a substep stands still: short by so many digits as
    // the damping takes substeps to let go of one.
    let stiffness = sheet.virtual_stiffness_n_per_m + 0.05 * sheet.spring_stiffness_n_per_m;
    if stiffness == 0.0 {
        return if precision == Precision::F64 { 1e-12 } else { 4.0 * unit };
    }
    let creep = 0.5 * sheet.damping_n_s_per_m / (stiffness * substep_s);
    // The stiffest vibrations' forces are differences of nearly equal displacements.
    let stiff = (sheet.spring_stiffness_n_per_m / stiffness).sqrt();
    match precision {
        Precision::F64 => 1e-12,
        Precision::Compensated => unit * (4.0 + stiff),
        Precision::Auto | Precision::F32 => unit * (4.0 + stiff + creep),
    }
}

/// Every integrator, each with the fewest substeps that keep to the tolerance, of what `stepping` leaves open.
pub fn candidates(stepping: &Stepping, sheet: &Oscillator, most_substeps: u32) -> Vec<Choice> {
    let step_s = stepping.rate_hz.recip();
    let open = CANDIDATES
        .iter()
        .filter(|(integrator, ..)| stepping.integrator == Integrator::Auto || stepping.integrator == *integrator);
    let fitted = open.map(|&(integrator, order, _)| {
        let tolerance = SAFETY * stepping.tolerance;
        let needed = || fewest(integrator, order, sheet, step_s, tolerance, most_substeps);
        with_precision(integrator, stepping.substeps.unwrap_or_else(needed), stepping, sheet)
    });
    fitted.collect()
}

/// The cheapest that keeps to the tolerance, of what `stepping` leaves open.
pub fn choose(stepping: &Stepping, sheet: &Oscillator, most_substeps: u32) -> Choice {
    let cost = |choice: &Choice| {
        let scheme = CANDIDATES.iter().find(|candidate| candidate.0 == choice.integrator).map_or(1.0, |found| found.2);
        let format = match choice.precision {
            Precision::F64 => COST_F64,
            Precision::Compensated => COST_COMPENSATED,
            Precision::Auto | Precision::F32 => 1.0,
        };
        // What misses the tolerance is taken only if nothing keeps to it, and then the one that misses it least.
        let miss = if choice.expected_error <= stepping.tolerance { 1.0 } else { 1e9 * choice.expected_error.min(1e9) };
        scheme * format * f64::from(choice.substeps) * miss
    };
    let candidates = candidates(stepping, sheet, most_substeps);
    candidates.into_iter().min_by(|a, b| cost(a).total_cmp(&cost(b))).unwrap_or_else(|| {
        // A yardstick, asked for by name: as stable as it has to be.
        let needed = || stability::substeps(stepping.integrator, stepping.rate_hz.recip(), sheet);
        with_precision(stepping.integrator, stepping.substeps.unwrap_or_else(needed), stepping, sheet)
    })
}

fn with_precision(integrator: Integrator, substeps: u32, stepping: &Stepping, sheet: &Oscillator) -> Choice {
    let step_s = stepping.rate_hz.recip();
    let substep_s = step_s / f64::from(substeps);
    let may_compensate = integrator.is_exponential();
    let precision = match stepping.precision {
        Precision::Auto => [Precision::F32, Precision::Compensated]
            .into_iter()
            .filter(|format| may_compensate || *format == Precision::F32)
            .find(|format| rounding(*format, sheet, substep_s) <= stepping.tolerance / 10.0)
            .unwrap_or(Precision::F64),
        given => given,
    };
    let [displacement, force] = expected_error(integrator, sheet, step_s, substeps);
    let expected_error = displacement.max(force) + rounding(precision, sheet, substep_s);
    Choice { integrator, substeps, precision, expected_error }
}

/// Fewest substeps with which a scheme is stable and errs by at most `tolerance`.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn fewest(integrator: Integrator, order: f64, sheet: &Oscillator, step_s: f64, tolerance: f64, most: u32) -> u32 {
    let mut substeps = stability::substeps(integrator, step_s, sheet);
    let mut rounds = 0;
    loop {
        // More than are allowed for accuracy's sake, no; for stability's, that is for others to refuse.
        if substeps >= most {
            return substeps;
        }
        let [displacement, force] = expected_error(integrator, sheet, step_s, substeps);
        let excess = displacement.max(force) / tolerance;
        if excess <= 1.0 {
            return substeps;
        }
        // As many more as the order says; one at least, and not more than the double at a time. An error that does not get
        // less as it should is not followed one by one for ever.
        rounds += 1;
        let least = if rounds < MOST_ROUNDS { 1.0 } else { 2.0 };
        let ratio = excess.powf(order.recip()).clamp(least, 2.0);
        substeps = (f64::from(substeps) * ratio).ceil().max(f64::from(substeps + 1)).min(f64::from(most)) as u32;
    }
}
