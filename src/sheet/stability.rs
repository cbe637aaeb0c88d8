//! How fast the sheet can vibrate, and how many substeps that asks for.

use crate::scene::Springs;

/// What a substep of central differences may turn the fastest vibration by, rad: dt·ω_b ≤ θ. The scheme is
/// stable below 2; its error falls with θ². At 0.25 the force of the stiffest scenes is within 5e-3 (ARCHITECTURE.md,
/// "Figures").
pub const THETA: f64 = 0.25;

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

/// Fewest substeps with dt·`omega_per_s` ≤ `theta`, dt = `step_s` / substeps. Saturates for absurd scenes.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub fn substeps(step_s: f64, omega_per_s: f64, theta: f64) -> u32 {
    (step_s * omega_per_s / theta).ceil().clamp(1.0, f64::from(u32::MAX)) as u32
}
