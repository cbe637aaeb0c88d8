//! The properties of a tissue that a scheme is fitted to.

use crate::scene::{MAX_BRANCHES, MaxwellBranch};

/// The properties of a tissue that a scheme depends on, for a point of the reference mass. [`Oscillator::of`]
/// takes them from a scene.
#[derive(Debug, Clone, Copy)]
pub struct Oscillator {
    /// Mass of the point, kg.
    pub mass_kg: f64,
    /// C of its damping force, N·s/m.
    pub damping_n_s_per_m: f64,
    /// K″ of its anchor spring, N/m.
    pub anchor_stiffness_n_per_m: f64,
    /// λ: an upper bound of the largest eigenvalue of the springs' stiffness under any deformation, N/m
    /// ([`largest_stiffness_n_per_m`](super::stability::largest_stiffness_n_per_m)).
    pub spring_stiffness_n_per_m: f64,
    /// τ of the springs, s: their force is N + τ·Ṅ with N the elastic force (Kelvin–Voigt); 0 if they are elastic.
    pub viscous_time_s: f64,
    /// Parts of the springs' force that relax.
    pub branches: [MaxwellBranch; MAX_BRANCHES],
}

/// The coefficients of the equation of motion, without unit, for a substep of length dt.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Coefficients {
    /// a = K″·dt²/m.
    pub anchor: f64,
    /// g = C·dt/m.
    pub damping: f64,
    /// β = τ/dt.
    pub viscosity: f64,
    /// Parts of the springs' force that relax.
    pub branches: [ScaledBranch; MAX_BRANCHES],
}

/// A branch ([`MaxwellBranch`]) for a substep of length dt: γ·(N − z) with ż = (N − z)/θ.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScaledBranch {
    /// γ; 0 for no branch.
    pub stiffness: f64,
    /// θ = τ/dt.
    pub substeps: f64,
}

impl Default for ScaledBranch {
    /// No branch.
    fn default() -> Self {
        ScaledBranch { stiffness: 0.0, substeps: 1.0 }
    }
}

impl Coefficients {
    /// Returns whether a part of the springs' force relaxes.
    pub fn relaxes(&self) -> bool {
        self.branches.iter().any(|branch| branch.stiffness > 0.0)
    }
}

impl Oscillator {
    /// Returns whether a part of the springs' force relaxes.
    pub fn relaxes(&self) -> bool {
        MaxwellBranch::any(&self.branches)
    }

    /// Returns the coefficients for a substep of length dt = `substep_s`, s.
    pub fn scaled(&self, substep_s: f64) -> Coefficients {
        Coefficients {
            anchor: self.anchor_stiffness_n_per_m * substep_s * substep_s / self.mass_kg,
            damping: self.damping_n_s_per_m * substep_s / self.mass_kg,
            viscosity: self.viscous_time_s / substep_s,
            branches: self
                .branches
                .map(|MaxwellBranch { stiffness, time_s }| ScaledBranch { stiffness, substeps: time_s / substep_s }),
        }
    }

    /// Returns the springs' largest stiffness in units of a substep of length dt = `substep_s`, s: (ω·dt)² =
    /// λ·dt²/m, without unit, with λ their largest eigenvalue.
    pub fn scaled_spring_stiffness(&self, substep_s: f64) -> f64 {
        self.spring_stiffness_n_per_m * substep_s * substep_s / self.mass_kg
    }

    /// Returns ω_b = √((λ·(1 + Σγ) + K″)/m), rad/s, with γ of the branches: an upper bound of the frequency of every
    /// vibration, under any deformation. (ω² is an eigenvalue of stiffness divided by mass, and that of a sum is at most the sum
    /// of the largest ones.)
    pub fn omega_bound_per_s(&self) -> f64 {
        let whole = MaxwellBranch::whole(&self.branches);
        ((self.spring_stiffness_n_per_m * whole + self.anchor_stiffness_n_per_m) / self.mass_kg).sqrt()
    }
}
