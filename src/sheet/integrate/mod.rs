//! The schemes that advance the sheet: one file each, and one line each in [`Scheme::fit`].
//!
//! Units in this module: lengths are in spacings h, time in substeps dt. u is a displacement over h, d is (nearly) the
//! amount a scheme adds to it in a substep, forces are times dt²/(m·h). The coefficients of the equation of motion are
//! then a = K″·dt²/m and g = C·dt/m: u̇̇ = N − a·u − g·u̇ + F, with N from the springs and F from the tools. Small
//! numbers stay small and keep their digits in f32.

pub(super) mod central;
pub(super) mod exponential;
pub(super) mod lagged;
mod matrix;
pub(super) mod rk4;

use crate::scene::Integrator;
use central::TwoStep;
use exponential::Multistep;
use matrix::Matrix;

/// The properties of a sheet that a scheme depends on.
#[derive(Debug, Clone, Copy)]
pub struct Oscillator {
    /// Mass of a point, kg.
    pub mass_kg: f64,
    /// C, N·s/m.
    pub damping_n_s_per_m: f64,
    /// K″, N/m.
    pub virtual_stiffness_n_per_m: f64,
    /// The largest eigenvalue of the springs' stiffness under any deformation, N/m.
    pub spring_stiffness_n_per_m: f64,
}

impl Oscillator {
    /// a and g for a substep.
    pub fn scaled(&self, substep_s: f64) -> (f64, f64) {
        let a = self.virtual_stiffness_n_per_m * substep_s * substep_s / self.mass_kg;
        (a, self.damping_n_s_per_m * substep_s / self.mass_kg)
    }

    /// The springs' largest stiffness in a substep's terms, (ω·dt)².
    pub fn scaled_spring_stiffness(&self, substep_s: f64) -> f64 {
        self.spring_stiffness_n_per_m * substep_s * substep_s / self.mass_kg
    }

    /// ω_b, rad/s: an upper bound of every vibration's frequency, under any deformation.
    pub fn omega_bound_per_s(&self) -> f64 {
        ((self.spring_stiffness_n_per_m + self.virtual_stiffness_n_per_m) / self.mass_kg).sqrt()
    }
}

/// A scheme, fitted to a sheet and a substep.
#[derive(Debug, Clone, PartialEq)]
pub enum Scheme {
    /// `central` and `lagged`.
    TwoStep(TwoStep),
    /// The exponential multistep schemes.
    Multistep(Multistep),
    /// The classical fourth-order Runge–Kutta scheme.
    Rk4 {
        /// K″·dt²/m.
        a: f64,
        /// C·dt/m.
        g: f64,
    },
}

impl Scheme {
    /// Fits a scheme to a = K″·dt²/m and g = C·dt/m.
    pub fn fit(integrator: Integrator, a: f64, g: f64) -> Self {
        match integrator {
            Integrator::Auto | Integrator::Central => Scheme::TwoStep(central::fit(a, g)),
            Integrator::Lagged => Scheme::TwoStep(lagged::fit(a, g)),
            Integrator::Rk4 => Scheme::Rk4 { a, g },
            Integrator::Exponential2 => Scheme::Multistep(exponential::fit(2, a, g)),
            Integrator::Exponential3 => Scheme::Multistep(exponential::fit(3, a, g)),
            Integrator::Exponential4 => Scheme::Multistep(exponential::fit(4, a, g)),
        }
    }

    /// How the tools' force enters a substep: the moments (0 to 1) at which a law is evaluated, and the weights with
    /// which each value adds to the scheme's force fields.
    pub fn nodes(&self) -> Vec<Node> {
        match self {
            // The scheme sees the beginning only, and takes the mean of both sides where the force jumps.
            Scheme::TwoStep(two) => vec![Node { fraction: 0.0, weights: [two.q, 0.0, 0.0] }],
            Scheme::Multistep(multistep) => multistep.nodes(),
            Scheme::Rk4 { .. } => {
                let node = |k: usize| {
                    #[allow(clippy::cast_precision_loss)]
                    let fraction = k as f64 / 2.0;
                    Node { fraction, weights: std::array::from_fn(|field| f64::from(u8::from(field == k))) }
                };
                (0..3).map(node).collect()
            }
        }
    }

    /// Whether a force that jumps must be given as the mean of both sides.
    pub fn takes_means(&self) -> bool {
        matches!(self, Scheme::TwoStep(_))
    }

    /// The factor that scales the springs' forces beyond dt²/(m·h).
    pub fn spring_scale(&self) -> f64 {
        match self {
            Scheme::TwoStep(two) => two.q,
            _ => 1.0,
        }
    }

    /// The velocity that a constant force of 1 adds in a substep (nearly), through the last of its fields.
    pub fn impulse(&self) -> f64 {
        self.constant()[1]
    }

    /// The field of the tools' force that adds to the velocity.
    pub fn last_field(&self) -> usize {
        match self {
            Scheme::TwoStep(_) => 0,
            Scheme::Multistep(_) | Scheme::Rk4 { .. } => 1,
        }
    }

    /// The u and d that a constant force of 1 adds in a substep.
    pub fn constant(&self) -> [f64; 2] {
        match self {
            Scheme::TwoStep(two) => [two.q; 2],
            Scheme::Multistep(multistep) => multistep.constant(),
            Scheme::Rk4 { .. } => [0.5, 1.0],
        }
    }

    /// The u and d that an impulse of 1 at a substep's beginning has added by its end.
    pub fn kick(&self) -> [f64; 2] {
        match self {
            Scheme::TwoStep(two) => [two.q; 2],
            Scheme::Multistep(multistep) => multistep.kick(),
            Scheme::Rk4 { .. } => [1.0; 2],
        }
    }

    /// Fields that the scheme keeps beside u and d.
    pub fn kept(&self, compensated: bool) -> usize {
        match self {
            Scheme::TwoStep(_) => 0,
            Scheme::Multistep(multistep) => multistep.order + usize::from(compensated),
            Scheme::Rk4 { .. } => rk4::KEPT,
        }
    }

    /// Evaluations of the springs' force in a substep.
    pub fn evaluations(&self) -> u32 {
        if matches!(self, Scheme::Rk4 { .. }) { 4 } else { 1 }
    }

    /// The matrix that advances u, d and the kept values of a single vibration whose springs pull with −z·u. Its
    /// eigenvalues determine stability and accuracy.
    pub fn propagator(&self, z: f64) -> Matrix {
        match self {
            Scheme::TwoStep(two) => two.propagator(z),
            Scheme::Multistep(multistep) => multistep.propagator(z),
            Scheme::Rk4 { a, g } => rk4::propagator(*a + z, *g),
        }
    }

    /// The largest growth factor of a vibration z in a substep.
    pub fn growth(&self, z: f64) -> f64 {
        self.propagator(z).spectral_radius()
    }
}

/// A moment of a substep at which a tool's law is evaluated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Node {
    /// From 0, its beginning, to 1, its end.
    pub fraction: f64,
    /// Weights with which the force (times dt²/(m·h)) adds to each field of the scheme.
    pub weights: [f64; 3],
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_and_the_springs_stiffness_make_the_square_of_the_fastest_turn() {
        let sheet = Oscillator {
            mass_kg: 0.02,
            damping_n_s_per_m: 0.3,
            virtual_stiffness_n_per_m: 7.0,
            spring_stiffness_n_per_m: 130.0,
        };
        for substep_s in [1e-4, 1e-3, 0.02] {
            let ((a, g), z) = (sheet.scaled(substep_s), sheet.scaled_spring_stiffness(substep_s));
            let turn = sheet.omega_bound_per_s() * substep_s;
            assert!((a + z - turn * turn).abs() < 1e-12 * turn * turn);
            assert!((z / a - 130.0 / 7.0).abs() < 1e-12 && (g - 15.0 * substep_s).abs() < 1e-15);
        }
    }

    /// u and u̇ after a substep of u̇̇ = force − a·u − g·u̇, in steps too short to matter.
    fn moved(a: f64, g: f64, force: f64, velocity: f64) -> [f64; 2] {
        const STEPS: u32 = 2000;
        let dt = f64::from(STEPS).recip();
        let slope = |[u, w]: [f64; 2]| [w, force - a * u - g * w];
        (0..STEPS).fold([0.0, velocity], |y, _| {
            let along = |k: [f64; 2], t: f64| [y[0] + t * k[0], y[1] + t * k[1]];
            let middle = slope(along(slope(y), 0.5 * dt));
            along(middle, dt)
        })
    }

    #[test]
    fn impulses_and_constant_forces_act_as_on_the_oscillator() {
        for (a, g) in [(0.04, 0.3), (0.5, 0.0), (0.01, 2.0)] {
            for integrator in [Integrator::Exponential2, Integrator::Exponential3, Integrator::Exponential4] {
                let scheme = Scheme::fit(integrator, a, g);
                for (found, truth) in
                    [(scheme.kick(), moved(a, g, 0.0, 1.0)), (scheme.constant(), moved(a, g, 1.0, 0.0))]
                {
                    let near = (0..2).all(|row| (found[row] - truth[row]).abs() < 1e-6);
                    assert!(near, "{integrator:?} {a} {g}: {found:?} {truth:?}");
                }
                assert_eq!(scheme.impulse(), scheme.constant()[1]);
            }
            // Two-step schemes move a point by what they change its increment by.
            let central = Scheme::fit(Integrator::Central, a, g);
            assert_eq!((central.kick(), central.constant()), ([1.0 / (1.0 + g / 2.0); 2], central.kick()));
        }
    }
}
