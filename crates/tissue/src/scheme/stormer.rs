//! Störmer's scheme: central differences whose springs' force includes its second difference. Third order but for damping,
//! viscosity and tools, which enter as in `central`: second order, with a small error where the springs count most. For tissue without anchor springs.
//!
//! u₊ − 2u + u₋ = ∫₋₁¹ (1 − |s|)·N(s) ds = N + (N − 2N₋₁ + N₋₂)/12 with the parabola through the last three forces (Hairer,
//! Nørsett, Wanner I, III.10). A viscous tissue pulls with N + β·Ṅ (`central`). Stable for (dt·ω)²·(4/3 + 4β) < 4: of all
//! schemes whose error is as small it takes the longest substep.

use super::central::{self, TwoStep};
use super::oscillator::Coefficients;

/// Weights of N₀, N₋₁ and N₋₂ in the second difference.
const SECOND: [f64; 3] = [1.0 / 12.0, -2.0 / 12.0, 1.0 / 12.0];

/// Fits the scheme to a tissue and a substep.
pub(super) fn fit(of: Coefficients) -> TwoStep<5> {
    let fitted = central::fit(of);
    TwoStep { springs: [0, 1, 2].map(|i: usize| fitted.springs[i] + SECOND[i]), ..fitted }
}
