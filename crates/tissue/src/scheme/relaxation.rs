//! How a displaced tissue comes back to rest: how fast, and how far a disturbance is noticed. All code that needs the
//! stiffness of the foundation for this takes it from here.

use crate::scene::{MaxwellBranch, Scene};

/// How a displaced tissue comes back to rest, for a point of the reference mass. The slowest vibration decides. In tissue
/// on anchor springs it hardly bends the tissue, so only each point's own anchor pulls it back; a solid has one of its own
/// ([`BodyKind::restoring_n_per_m`](crate::scene::BodyKind::restoring_n_per_m)).
#[derive(Debug, Clone, Copy)]
pub struct Relaxation {
    mass_kg: f64,
    damping_n_s_per_m: f64,
    restoring_n_per_m: f64,
    /// The longest time in which what a branch holds falls by a factor of e, s; 0 without branches.
    creep_s: f64,
}

impl Relaxation {
    /// Returns how a tissue of a scene comes back to rest.
    pub fn of(scene: &Scene) -> Self {
        let kind = scene.body.kind();
        Relaxation {
            mass_kg: kind.point_mass_kg(),
            // Adding 0.0 turns −0.0 into +0.0, so that dividing by it gives +∞.
            damping_n_s_per_m: scene.damping_n_s_per_m + 0.0,
            restoring_n_per_m: kind.restoring_n_per_m(&scene.springs, scene.anchor_stiffness_n_per_m) + 0.0,
            creep_s: creep_s(&kind.branches()),
        }
    }

    /// Returns how the same tissue comes back to rest if some of its points have lost their anchors.
    #[must_use]
    pub(crate) fn without_anchors(self) -> Self {
        Relaxation { restoring_n_per_m: 0.0, ..self }
    }

    /// Returns the stiffness that pulls a displaced point back wherever the others are, N/m; 0 if nothing does.
    pub fn restoring_n_per_m(&self) -> f64 {
        self.restoring_n_per_m
    }

    /// Returns the longest time in which what a branch holds falls by a factor of e, s; 0 without branches.
    pub fn creep_s(&self) -> f64 {
        self.creep_s
    }

    /// Returns whether every point is pulled back, so that a small force moves the tissue by a bounded distance.
    pub fn is_bounded(&self) -> bool {
        self.restoring_n_per_m > 0.0
    }

    /// Returns the restoring stiffness K in the units of a scheme, K·dt²/m, for a substep of `substep_s`, s.
    pub(crate) fn scaled(&self, substep_s: f64) -> f64 {
        self.restoring_n_per_m * substep_s * substep_s / self.mass_kg
    }

    /// Returns √(K/m), rad/s: the slowest vibration without damping. 0 if nothing pulls the tissue back.
    pub fn slowest_per_s(&self) -> f64 {
        (self.restoring_n_per_m / self.mass_kg).sqrt()
    }

    /// Returns γ, 1/s: the amplitude of the slowest vibration falls as e^(−γt). 0 if it does not fall.
    ///
    /// For m·ü + C·u̇ + K·u = 0, γ = C/2m, or in the overdamped case γ = (C − √(C² − 4mK))/2m for the slower part.
    pub fn decay_per_s(&self) -> f64 {
        let Relaxation { mass_kg, damping_n_s_per_m: c, restoring_n_per_m: k, .. } = *self;
        // The difference without cancellation.
        let root = (c * c - 4.0 * mass_kg * k).max(0.0).sqrt();
        if root > 0.0 { 2.0 * k / (c + root) } else { c / (2.0 * mass_kg) }
    }

    /// Returns the time at which the slowest vibration, and what branches hold, has decayed to a `part` (below 1) of its amplitude, s.
    ///
    /// # Errors
    /// Returns why there is none, for people: nothing damps the tissue, or its points have no anchors.
    pub fn rest_s(&self, part: f64) -> Result<f64, &'static str> {
        if self.damping_n_s_per_m <= 0.0 {
            return Err("never: there is no damping");
        }
        if !self.is_bounded() {
            return Err("unknown: without anchor springs nothing but fixed points pulls the tissue back");
        }
        Ok(-part.ln() * self.decay_per_s().recip().max(self.creep_s))
    }

    /// Returns l/h = √(k/K), at least 1: the length, in distances between neighbours h, over which a displacement falls
    /// by a factor of e beside a disc, for springs of stiffness k = `spring_n_per_m`, N/m. There a membrane of springs and its
    /// foundation are in balance, k·h²·u″ = K·u. Infinite if nothing pulls the tissue back;
    /// 1 if there are no springs either.
    pub fn reach(&self, spring_n_per_m: f64) -> f64 {
        (spring_n_per_m / self.restoring_n_per_m).sqrt().max(1.0)
    }
}

/// Returns the time in which a free tissue with branches creeps back by a factor of e, s: it is at most τ·(1 + Σγ).
fn creep_s(branches: &[MaxwellBranch]) -> f64 {
    let whole = MaxwellBranch::whole(branches);
    let creeping = branches.iter().filter(|branch| branch.stiffness > 0.0);
    creeping.map(|branch| branch.time_s * whole).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn what_creeps_back_takes_longer_and_what_nothing_damps_never_rests() {
        let rest_s = |damping_n_s_per_m: f64, restoring_n_per_m: f64| {
            Relaxation { mass_kg: 1.0, damping_n_s_per_m, restoring_n_per_m, creep_s: 0.0 }.rest_s(0.01)
        };
        // The slower of the roots of s² + 10 s + 9 is −1.
        assert!((rest_s(10.0, 9.0).unwrap() - 100.0_f64.ln()).abs() < 1e-9);
        assert!((rest_s(2.0, 9.0).unwrap() - 100.0_f64.ln()).abs() < 1e-9);
        assert!(rest_s(0.0, 9.0).unwrap_err().starts_with("never"));
        assert!(rest_s(1.0, 0.0).unwrap_err().starts_with("unknown"));
    }
}
