//! The schemes that advance a tissue in time. Each has a file and a line in the register.
//!
//! Units in this module: lengths are in spacings h, time in substeps dt. u is a displacement divided by h, d is
//! (nearly) what a scheme adds to it in a substep, and forces are multiplied by dt²/(m·h). The coefficients of
//! the equation of motion are then a = K″·dt²/m, g = C·dt/m and β = τ/dt: u̇̇ = N + β·Ṅ − a·u − g·u̇ + F, with N from
//! the springs and F from the tools. Small numbers stay small and keep their digits in f32.

pub(crate) mod arithmetic;
mod central;
mod exponential;
pub(crate) mod family;
mod filter;
mod lagged_damping;
mod matrix;
pub(crate) mod observer;
mod oscillator;
mod relaxation;
mod rk4;
pub mod stability;
mod stormer;

pub use central::TwoStep;
pub use exponential::Multistep;
pub use family::QuadratureNode;
use filter::BranchFilter;
pub use oscillator::{Coefficients, Oscillator, ScaledBranch};
pub use relaxation::Relaxation;
pub use rk4::Rk4;

use std::any::Any;

use crate::scene::Integrator;
use family::{Family, Release};
use matrix::Matrix;

/// A scheme with its coefficients for a tissue and a substep: one variant for each arithmetic. [`Scheme::fit`]
/// creates it. Values of its methods are in the module's [units](self).
#[derive(Debug, Clone, PartialEq)]
pub enum Scheme {
    /// `central` and `lagged`, which differ in their coefficients alone.
    TwoStep(TwoStep<0>),
    /// `stormer`, and `central` and `lagged` of a viscous tissue: they keep 2 earlier forces of the springs.
    LongTwoStep(TwoStep<2>),
    /// The two-step schemes of a tissue with branches: they also keep a filter of each.
    RelaxingTwoStep(TwoStep<5>),
    /// The exponential multistep scheme that keeps 2 earlier forces of the springs.
    Exponential2(Multistep<2>),
    /// The exponential multistep scheme that keeps 3 earlier forces of the springs.
    Exponential3(Multistep<3>),
    /// The exponential multistep scheme that keeps 4 earlier forces of the springs.
    Exponential4(Multistep<4>),
    /// The classical fourth-order Runge–Kutta scheme, `rk4`.
    Rk4(Rk4),
}

/// Compiles an expression once for each variant of [`Scheme`], with `$family` as the fitted scheme, and runs the one of
/// `$scheme`.
macro_rules! each {
    ($scheme:expr, |$family:ident| $body:expr) => {
        match $scheme {
            $crate::scheme::Scheme::TwoStep($family) => $body,
            $crate::scheme::Scheme::LongTwoStep($family) => $body,
            $crate::scheme::Scheme::RelaxingTwoStep($family) => $body,
            $crate::scheme::Scheme::Exponential2($family) => $body,
            $crate::scheme::Scheme::Exponential3($family) => $body,
            $crate::scheme::Scheme::Exponential4($family) => $body,
            $crate::scheme::Scheme::Rk4($family) => $body,
        }
    };
}
pub(crate) use each;

/// The condition for a substep of an integrator when rehearsals do not choose the number of substeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Bound {
    /// Stability.
    Stable,
    /// A small turn of the fastest vibration ([`THETA`](crate::scheme::stability::THETA)).
    Turn,
    /// A small turn of the fastest vibration, and at most half of the damping at which the scheme is stable.
    TurnAndLag,
}

/// An integrator's entry in the register.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Entry {
    /// The power of the substep with which the error falls.
    pub(crate) order: f64,
    /// The cost of a substep relative to `central`. Measured (`make tables-kernel`).
    pub(crate) cost: f64,
    /// The condition for its substep.
    pub(crate) bound: Bound,
    /// Whether it can compensate the rounding of f32.
    pub(crate) compensates: bool,
    fit: fn(Coefficients) -> Scheme,
}

/// The integrators that `auto` may become, by falling order.
pub(crate) const CANDIDATES: [Integrator; 4] =
    [Integrator::Exponential4, Integrator::Exponential3, Integrator::Exponential2, Integrator::Central];

/// The same for a viscous tissue: viscosity damps the fast vibrations of which `stormer` has a large error.
const CANDIDATES_OF_VISCOUS: [Integrator; 4] =
    [Integrator::Exponential4, Integrator::Exponential3, Integrator::Exponential2, Integrator::Stormer];

/// Returns the integrators that `auto` may become for a tissue, by falling order.
pub(crate) fn candidates(of: &Oscillator) -> &'static [Integrator] {
    match of {
        _ if of.relaxes() => &[Integrator::Stormer],
        _ if of.viscous_time_s > 0.0 => &CANDIDATES_OF_VISCOUS,
        _ => &CANDIDATES,
    }
}

/// Returns the entry of an integrator in the register.
pub(crate) fn entry(integrator: Integrator) -> Entry {
    type Fit = fn(Coefficients) -> Scheme;
    let exponential =
        |order: f64, cost: f64, fit: Fit| Entry { order, cost, bound: Bound::Stable, compensates: true, fit };
    let other = |order: f64, cost: f64, bound: Bound, fit: Fit| Entry { order, cost, bound, compensates: false, fit };
    let by_central = |bound: Bound| other(2.0, 1.0, bound, |of| two_step(of, central::fit(of)));
    match integrator {
        Integrator::Auto => by_central(Bound::Stable),
        Integrator::Central => by_central(Bound::Turn),
        Integrator::Lagged => other(1.0, 1.0, Bound::TurnAndLag, |of| two_step(of, lagged_damping::fit(of))),
        // It evaluates the springs four times.
        Integrator::Rk4 => other(4.0, 4.0, Bound::Stable, |of| Scheme::Rk4(Rk4 { a: of.anchor, g: of.damping })),
        Integrator::Stormer => other(2.0, 1.1, Bound::Stable, |of| long_two_step(of, stormer::fit(of))),
        Integrator::Exponential2 => exponential(3.0, 1.3, |of| Scheme::Exponential2(exponential::fit(of))),
        Integrator::Exponential3 => exponential(4.0, 1.4, |of| Scheme::Exponential3(exponential::fit(of))),
        Integrator::Exponential4 => exponential(5.0, 1.6, |of| Scheme::Exponential4(exponential::fit(of))),
    }
}

/// Returns the scheme of a fitted two-step form: that of an elastic tissue keeps no force.
fn two_step(of: Coefficients, fitted: TwoStep<5>) -> Scheme {
    if of.viscosity > 0.0 || of.relaxes() { long_two_step(of, fitted) } else { Scheme::TwoStep(fitted.keeping()) }
}

/// Returns the scheme of a fitted two-step form that keeps forces.
fn long_two_step(of: Coefficients, fitted: TwoStep<5>) -> Scheme {
    if of.relaxes() { Scheme::RelaxingTwoStep(fitted) } else { Scheme::LongTwoStep(fitted.keeping()) }
}

/// Returns `to` if it has the same type as `_from`.
fn like<'t, F: 'static>(_from: &F, to: &'t dyn Any) -> Option<&'t F> {
    to.downcast_ref()
}

/// Returns the power p of the substep with which the error of an integrator falls, as dtᵖ: 1 for `lagged`, 2
/// for `central` (and for `auto`) and `stormer`, 4 for `rk4`, 3 to 5 for `exponential2` to `exponential4`.
pub fn order(integrator: Integrator) -> f64 {
    entry(integrator).order
}

impl Scheme {
    /// Creates an integrator's scheme with coefficients for a tissue and a substep ([`Oscillator::scaled`]). `auto` gives
    /// `central`; `rk4` leaves viscosity out. Whether it is stable is not checked: see [`stability::is_stable`].
    pub fn fit(integrator: Integrator, of: Coefficients) -> Self {
        (entry(integrator).fit)(of)
    }

    /// Returns the number of sweeps over the springs in a substep.
    pub(crate) fn sweeps(&self) -> usize {
        each!(self, |family| family.sweeps())
    }

    /// Returns the first field of the tools' force that sweep number `sweep` reads.
    pub(crate) fn field(&self, sweep: usize) -> usize {
        each!(self, |family| family.field(sweep))
    }

    /// Returns the fraction of the substep to which the state after sweep number `sweep` belongs; `None` after
    /// the last.
    pub(crate) fn fraction_after(&self, sweep: usize) -> Option<f64> {
        each!(self, |family| family.fraction_after(sweep))
    }

    /// Returns how the tools' force enters a substep: the moments, by ascending fraction, at which it is
    /// evaluated, and the weights with which each value adds to the scheme's force fields.
    pub fn nodes(&self) -> Vec<QuadratureNode> {
        each!(self, |family| family.nodes())
    }

    /// Returns whether a force that jumps must be given as the mean of both sides: true for `central` and
    /// `lagged`.
    pub fn takes_means(&self) -> bool {
        each!(self, |family| family.takes_means())
    }

    /// Returns the factor that scales the springs' forces in addition to dt²/(m·h): [`TwoStep::q`] for two-step
    /// schemes, otherwise 1.
    pub fn spring_scale(&self) -> f64 {
        each!(self, |family| family.spring_scale())
    }

    /// Returns the velocity, as d per substep, that a constant force of 1 adds in a substep (nearly): the
    /// second value of [`Scheme::constant`].
    pub fn impulse(&self) -> f64 {
        self.constant()[1]
    }

    /// Returns the index, from 0, of the field of the tools' force that adds to the velocity.
    pub fn last_field(&self) -> usize {
        each!(self, |family| family.last_field())
    }

    /// Returns the u and d that a constant force of 1 adds in a substep to a point at rest. Exact for
    /// exponential schemes: ∫₀¹ e^{A(1−s)}·b ds (see `exponential.rs`).
    pub fn constant(&self) -> [f64; 2] {
        each!(self, |family| family.constant())
    }

    /// Returns the u and d that an impulse of 1 (a sudden velocity of one spacing per substep) at a substep's
    /// beginning has added by its end, to a point at rest.
    pub fn kick(&self) -> [f64; 2] {
        each!(self, |family| family.kick())
    }

    /// Returns the number of fields that the scheme keeps besides u and d. `compensated` adds one, for the
    /// rounding errors of u in f32, to the exponential schemes; others can't compensate.
    pub fn kept(&self, compensated: bool) -> usize {
        each!(self, |family| family.kept(compensated))
    }

    /// Returns how many of the kept fields, from the first, are the springs' forces of earlier substeps, newest
    /// first, with what branches added: p for the exponential schemes, 2 for a two-step scheme that keeps them, otherwise 0.
    pub fn history(&self) -> usize {
        each!(self, |family| family.history())
    }

    /// Returns how many of the kept fields, from the first, follow from the springs' forces: those of [`Scheme::history`], then the
    /// filters of branches.
    pub(crate) fn kept_of_springs(&self) -> usize {
        self.history() + each!(self, |family| family.filters())
    }

    /// Returns the weights of the springs' force now and of the kept values that follow from it in β·Ṅ and the branches; empty without
    /// viscosity and branches.
    pub(crate) fn added_weights(&self, of: &Coefficients) -> Vec<f64> {
        let count = if self.history() > 0 && (of.viscosity > 0.0 || of.relaxes()) { 1 + self.history() } else { 0 };
        let viscous = exponential::rate_weights(count).into_iter().map(|weight| of.viscosity * weight);
        let mut weights: Vec<f64> = viscous.collect();
        if self.kept_of_springs() > self.history() {
            // Viscosity acts on the branches as well.
            let (now, filtered) = BranchFilter::weights(1.0 + weights[0], &of.branches.map(BranchFilter::of));
            weights[0] = now - 1.0;
            weights.extend(filtered);
        }
        weights
    }

    /// Returns the matrix that advances (u, d, kept values) by one substep, for a single vibration without
    /// tools whose springs pull with −z·u. z = (ω·dt)² is at least 0. Its eigenvalues determine stability and
    /// accuracy.
    pub fn propagator(&self, z: f64) -> Matrix {
        each!(self, |family| family.propagator(z))
    }

    /// Returns the largest growth factor of a vibration z = (ω·dt)² in a substep: the spectral radius of its
    /// propagator. Above 1 the vibration grows.
    pub fn growth(&self, z: f64) -> f64 {
        self.propagator(z).spectral_radius()
    }

    /// Returns the changes of a point's u and d when a tool releases it ([`Family::release`]); `None` if
    /// nothing changes.
    pub(crate) fn release(&self, at: Release<'_>) -> Option<[f64; 2]> {
        each!(self, |family| family.release(at))
    }

    /// Converts u and d of one component of a point to the same scheme with another substep
    /// ([`Family::resample`]), or to another scheme. Also converts `springs`, the springs' forces.
    pub(crate) fn resample(
        &self,
        to: &Self,
        ratio: f64,
        state: [f64; 2],
        pushed: f64,
        springs: &mut [f64],
    ) -> [f64; 2] {
        each!(self, |from| each!(to, |to| match like(from, to) {
            Some(to) => from.resample(to, ratio, state, pushed, springs),
            // Schemes of two families have only the velocity in common.
            None => [state[0], state[1] * ratio],
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn elastic(anchor: f64, damping: f64) -> Coefficients {
        Coefficients { anchor, damping, ..Coefficients::default() }
    }

    #[test]
    fn a_and_the_springs_stiffness_make_the_square_of_the_fastest_turn() {
        let oscillator = Oscillator {
            mass_kg: 0.02,
            damping_n_s_per_m: 0.3,
            anchor_stiffness_n_per_m: 7.0,
            spring_stiffness_n_per_m: 130.0,
            viscous_time_s: 0.0,
            branches: Default::default(),
        };
        for substep_s in [1e-4, 1e-3, 0.02] {
            let (of, z) = (oscillator.scaled(substep_s), oscillator.scaled_spring_stiffness(substep_s));
            let (a, g) = (of.anchor, of.damping);
            let turn = oscillator.omega_bound_per_s() * substep_s;
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
                let scheme = Scheme::fit(integrator, elastic(a, g));
                for (found, truth) in
                    [(scheme.kick(), moved(a, g, 0.0, 1.0)), (scheme.constant(), moved(a, g, 1.0, 0.0))]
                {
                    let near = (0..2).all(|row| (found[row] - truth[row]).abs() < 1e-6);
                    assert!(near, "{integrator:?} {a} {g}: {found:?} {truth:?}");
                }
                assert_eq!(scheme.impulse(), scheme.constant()[1]);
            }
            // Two-step schemes move a point by what they change its increment by.
            let central = Scheme::fit(Integrator::Central, elastic(a, g));
            assert_eq!((central.kick(), central.constant()), ([1.0 / (1.0 + g / 2.0); 2], central.kick()));
        }
    }
}
