//! Central differences with implicit damping: second order, and stable for dt·ω < 2 whatever the damping.
//!
//! m(u₊ − 2u + u₋)/dt² = F(u) − C(u₊ − u₋)/2dt, with d₊ = u₊ − u, d = u − u₋ and g = C·dt/m:
//! (1 + g/2)·d₊ = (1 − g/2)·d + (dt²/m)·F(u).

use super::super::stability::{self, THETA};
use super::{Oscillator, Scheme};

pub(super) const SCHEME: Scheme = Scheme {
    coefficients: |g, dt2_per_m| ((1.0 - g / 2.0) / (1.0 + g / 2.0), dt2_per_m / (1.0 + g / 2.0)),
    substeps: |sheet: &Oscillator| {
        // Without damping the decay never ends, and the factor is at its largest.
        let decay_s = 2.0 * sheet.mass_kg / sheet.damping_n_s_per_m;
        stability::substeps(sheet.step_s, sheet.omega_per_s, THETA / stability::endurance(sheet.omega_per_s, decay_s))
    },
    is_stable: |w, _| w < 4.0,
};
