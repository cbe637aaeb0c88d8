//! The paper's scheme: central differences with the damping force of the last substep's velocity. First order.
//!
//! m(u₊ − 2u + u₋)/dt² = F(u) − C(u − u₋)/dt: d₊ = (1 − g)·d + (dt²/m)·F(u), g = C·dt/m. Its characteristic
//! polynomial z² − (2 − g − W)z + 1 − g, W = (dt·ω)², has its roots within the unit circle iff W + 2g < 4.

use super::super::stability::{self, THETA};
use super::{Oscillator, Scheme};

pub(super) const SCHEME: Scheme = Scheme {
    coefficients: |g, dt2_per_m| (1.0 - g, dt2_per_m),
    // Half the stable damping, so that light points do not ring with the substep.
    substeps: |sheet: &Oscillator| {
        let damping_rate_per_s = sheet.damping_n_s_per_m / sheet.mass_kg;
        stability::substeps(sheet.step_s, sheet.omega_per_s, THETA).max(stability::substeps(
            sheet.step_s,
            damping_rate_per_s,
            1.0,
        ))
    },
    is_stable: |w, g| w + 2.0 * g < 4.0,
};
