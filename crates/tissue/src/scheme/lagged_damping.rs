//! The paper's scheme: central differences with the damping force from the last substep's velocity. First
//! order.
//!
//! m(u₊ − 2u + u₋)/dt² = F(u) − C(u − u₋)/dt: d₊ = (1 − g)·d + (dt²/m)·F(u), g = C·dt/m. Its characteristic
//! polynomial z² − (2 − g − W)z + 1 − g, W = (dt·ω)², has its roots within the unit circle iff W + 2g < 4.

use super::central::{self, TwoStep};
use super::oscillator::Coefficients;

pub(super) fn fit(of: Coefficients) -> TwoStep<5> {
    TwoStep { p: 1.0 - of.damping, q: 1.0, ..central::fit(of) }
}
