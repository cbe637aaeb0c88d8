//! How fast the sheet can vibrate, and how many substeps that asks for.

use super::integrate::{Oscillator, Scheme};
use crate::scene::{Integrator, Springs};

/// What a substep of central differences may turn the fastest vibration by, rad: dt·ω_b ≤ θ. The scheme is
/// stable below 2; its error falls with θ². At 0.25 the force of the stiffest scenes is within 5e-3 (ARCHITECTURE.md,
/// "Figures").
pub const THETA: f64 = 0.25;

/// By how much smaller than [`THETA`] a turn has to be where vibrations last, from 1 to 8.
///
/// A vibration ω of central differences is fast by ω(dt·ω)²/24, and the phase that it loses so adds up for as long as
/// the vibration lasts, τ = 2m/C: to (ω·τ)(dt·ω)²/24. The same error then asks for a turn smaller by √(ω·τ). Up to
/// ω_b·τ = 27 the turn of `THETA` itself does; beyond 27·8² one runs for a given time, not until all is still, and no
/// scheme of second order is the right one. (Measured on scenes with C = 0 and k/K″ from 4 to 100 for 1 to 2 s: errors of
/// 2e-2 of the largest displacement without this, 3e-4 with it.)
pub fn endurance(omega_per_s: f64, decay_s: f64) -> f64 {
    let turns = omega_per_s * decay_s;
    // Nothing vibrates, and nothing damps it.
    if turns.is_nan() { 1.0 } else { (turns / 27.0).sqrt().clamp(1.0, 8.0) }
}

/// Largest eigenvalue of the springs' stiffness matrix under any deformation, N/m.
///
/// A spring with unit direction n contributes k(nnᵀ + (1 − L0/L)(I − nnᵀ)) to the tangent stiffness, which is at
/// most k·I: so no deformation makes the matrix larger than the graph Laplacian with weights k. On the unbounded
/// grid the wave (a, b) has the eigenvalue
///
/// λ = k₁(4 − 2x − 2y) + k₂(4 − 4xy) + k₃(8 − 4x² − 4y²),  x = cos a, y = cos b in [−1, 1],
///
/// k₁ structural, k₂ shear, k₃ flexion; a finite sheet has fewer springs, and smaller eigenvalues. With all k equal
/// the largest is 12k without and 16⅓·k with flexion.
pub fn largest_stiffness_n_per_m(springs: &Springs) -> f64 {
    let (k1, k2) = (springs.stiffness_n_per_m, springs.shear_stiffness_n_per_m);
    let k3 = if springs.flexion { k1 } else { 0.0 };
    let eigenvalue =
        |x: f64, y: f64| k1 * (4.0 - 2.0 * x - 2.0 * y) + k2 * (4.0 - 4.0 * x * y) + k3 * (8.0 - 4.0 * (x * x + y * y));
    // λ is a quadratic form: its maximum is at a corner, where its slope along an edge is 0, or where both slopes are.
    let mut candidates = vec![(-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)];
    if k3 > 0.0 {
        for edge in [-1.0, 1.0] {
            candidates.push((edge, -(2.0 * k1 + 4.0 * k2 * edge) / (8.0 * k3)));
        }
    }
    if k2 + k3 > 0.0 {
        let inner = -2.0 * k1 / (4.0 * k2 + 8.0 * k3);
        candidates.push((inner, inner));
    }
    let inside = |&(x, y): &(f64, f64)| x.abs() <= 1.0 && y.abs() <= 1.0;
    candidates.into_iter().filter(inside).map(|(x, y)| eigenvalue(x, y)).fold(0.0, f64::max)
}

/// Vibrations between the slowest and the fastest at which stability is looked at: it may fail in between.
const VIBRATIONS: u32 = 48;

/// By which a vibration may grow in a substep and still count as stable: what rounding leaves of 1.
const NO_GROWTH: f64 = 1.0 + 1e-7;

/// Whether no vibration grows, of springs up to `stiffness` = (ω·dt)².
pub fn is_stable(scheme: &Scheme, stiffness: f64) -> bool {
    (0..=VIBRATIONS).all(|k| {
        // Dense towards the stiff end, where schemes fail first.
        let part = f64::from(k) / f64::from(VIBRATIONS);
        scheme.growth(stiffness * part * part) <= NO_GROWTH
    })
}

/// Fewest substeps of `step_s` with which any scheme is stable. Saturates for absurd scenes.
pub fn least_substeps(step_s: f64, sheet: &Oscillator) -> u32 {
    fewest(step_s, sheet.omega_bound_per_s(), 2.0)
}

/// Fewest substeps of `step_s` with which a scheme is stable. Saturates for absurd scenes.
pub fn stable_substeps(integrator: Integrator, step_s: f64, sheet: &Oscillator) -> u32 {
    let mut substeps = least_substeps(step_s, sheet);
    let stable = |substeps: u32| {
        let substep_s = step_s / f64::from(substeps);
        let (a, g) = sheet.scaled(substep_s);
        is_stable(&Scheme::fit(integrator, a, g), sheet.scaled_spring_stiffness(substep_s))
    };
    // The limit of all is above dt·ω = 0.3 even without damping, and above dt·C/m = 2 (that of `rk4` is 2.785); rounding
    // may tell otherwise for ever.
    let fastest_per_s = (sheet.omega_bound_per_s() / 0.1).max(sheet.damping_n_s_per_m / sheet.mass_kg);
    let most = (step_s * fastest_per_s).min(f64::from(u32::MAX));
    while !stable(substeps) && f64::from(substeps) < most {
        substeps = substeps.saturating_add(substeps / 8 + 1);
    }
    substeps
}

/// Fewest substeps of `step_s` with which a yardstick is stable, and as accurate as it promises. Saturates for absurd
/// scenes.
pub fn substeps(integrator: Integrator, step_s: f64, sheet: &Oscillator) -> u32 {
    match integrator {
        Integrator::Central | Integrator::Lagged => {
            let decay_s = 2.0 * sheet.mass_kg / sheet.damping_n_s_per_m;
            let omega = sheet.omega_bound_per_s();
            let turn = fewest(step_s, omega, THETA / endurance(omega, decay_s));
            // `lagged`: half the stable damping, so that light points do not ring with the substep.
            let lag = fewest(step_s, sheet.damping_n_s_per_m / sheet.mass_kg, 1.0);
            if integrator == Integrator::Lagged { turn.max(lag) } else { turn }
        }
        _ => stable_substeps(integrator, step_s, sheet),
    }
}

/// Fewest substeps with dt·`omega_per_s` ≤ `theta`, dt = `step_s` / substeps. Saturates for absurd scenes.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn fewest(step_s: f64, omega_per_s: f64, theta: f64) -> u32 {
    (step_s * omega_per_s / theta).ceil().clamp(1.0, f64::from(u32::MAX)) as u32
}
