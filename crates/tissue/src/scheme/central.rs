//! Central differences with implicit damping: second order, and stable for dt·ω < 2 whatever the damping.
//!
//! m(u₊ − 2u + u₋)/dt² = F(u) − C(u₊ − u₋)/2dt, with d₊ = u₊ − u, d = u − u₋ and g = C·dt/m:
//! (1 + g/2)·d₊ = (1 − g/2)·d + (dt²/m)·F(u).
//!
//! A viscous tissue pulls with N + β·Ṅ, where Ṅ is that of the parabola through N and its last two values: second order, and stable
//! for (dt·ω)²·(1 + 4β) < 4.

use super::arithmetic::{Arithmetic, MAX_KEPT};
use super::exponential::{rate_weights, resample_history};
use super::family::{Family, QuadratureNode, Release};
use super::matrix::Matrix;
use super::oscillator::Coefficients;
use crate::kernel::lanes::Vector;
use crate::kernel::real::Real;

/// The two-step form d ← p·d + q·(N − a·u + F), u ← u + d of `central` and `lagged`, where d is the increment
/// of the last substep, N the springs' force and F the tools' ([units](super)). a = K″·dt²/m and g = C·dt/m
/// below. With `KEEPS` N is a sum over the springs' force now and a substep and two ago.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TwoStep<const KEEPS: bool> {
    /// p: the part of the last increment that damping leaves: (1 − g/2)/(1 + g/2) for `central`, 1 − g for
    /// `lagged`.
    pub p: f64,
    /// q: the increment per unit of force: 1/(1 + g/2) for `central`, 1 for `lagged`.
    pub q: f64,
    /// a = K″·dt²/m, the pull of the anchor spring.
    pub a: f64,
    /// Weights of N₀, N₋₁ and N₋₂; without `KEEPS` 1, 0 and 0.
    pub springs: [f64; 3],
}

impl TwoStep<true> {
    /// Returns the form without viscosity.
    pub(super) fn elastic(self) -> TwoStep<false> {
        TwoStep { p: self.p, q: self.q, a: self.a, springs: ELASTIC }
    }
}

/// Weights of N₀, N₋₁ and N₋₂ in an elastic tissue.
const ELASTIC: [f64; 3] = [1.0, 0.0, 0.0];

/// Returns the weights of N₀, N₋₁ and N₋₂ in N + β·Ṅ.
pub(super) fn viscous(viscosity: f64) -> [f64; 3] {
    let rate = rate_weights(ELASTIC.len());
    [0, 1, 2].map(|i| ELASTIC[i] + viscosity * rate[i])
}

/// Fits central differences.
pub(super) fn fit(of: Coefficients) -> TwoStep<true> {
    let Coefficients { anchor, damping: g, viscosity } = of;
    TwoStep { p: (1.0 - g / 2.0) / (1.0 + g / 2.0), q: 1.0 / (1.0 + g / 2.0), a: anchor, springs: viscous(viscosity) }
}

impl<const KEEPS: bool> Family for TwoStep<KEEPS> {
    type Plain<T: Real> = CentralAdvance<T, KEEPS>;
    type Compensated<T: Real> = CentralAdvance<T, KEEPS>;

    fn plain<T: Real>(&self, _: usize) -> CentralAdvance<T, KEEPS> {
        CentralAdvance {
            p: T::of(self.p),
            pull: T::of(-self.q * self.a),
            springs: self.springs.map(T::of),
            keeps: self.p > 0.98 && !KEEPS,
        }
    }

    fn compensated<T: Real>(&self, sweep: usize) -> CentralAdvance<T, KEEPS> {
        self.plain(sweep)
    }

    fn history(&self) -> usize {
        if KEEPS { 2 } else { 0 }
    }

    fn takes_means(&self) -> bool {
        true
    }

    fn last_field(&self) -> usize {
        0
    }

    /// The scheme evaluates only the beginning, and takes the mean of both sides where the force jumps.
    fn nodes(&self) -> Vec<QuadratureNode> {
        vec![QuadratureNode { fraction: 0.0, weights: [self.q, 0.0, 0.0] }]
    }

    fn spring_scale(&self) -> f64 {
        self.q
    }

    fn constant(&self) -> [f64; 2] {
        [self.q; 2]
    }

    fn kick(&self) -> [f64; 2] {
        [self.q; 2]
    }

    fn propagator(&self, z: f64) -> Matrix {
        let [now, past, before] = self.springs;
        let pull = -self.q * (z * now + self.a);
        // Kept values are q times the springs' force.
        let rows = [
            [1.0 + pull, self.p, past, before],
            [pull, self.p, past, before],
            [-self.q * z, 0.0, 0.0, 0.0],
            [0.0, 0.0, 1.0, 0.0],
        ];
        Matrix::of(2 + self.history(), |i, j| rows[i][j])
    }

    /// A release is a jump. Before it, the whole force on the point without damping was m·a + C·v with the
    /// tool's a and v; after it, the force is F = spring + applied − K″·u. At a jump the scheme needs the mean
    /// of both (see `applied_force`), and it uses F with the mean of the applied force. The tool moved at
    /// constant velocity, so a = 0: the point gets ½(C·v + F) minus that. In terms of the increment, this is q
    /// times the difference.
    fn release(&self, at: Release<'_>) -> Option<[f64; 2]> {
        let pulls = self.pull_of(at.springs) - self.q * self.a * at.u;
        let used = pulls + at.used;
        let kick = 0.5 * (self.q * at.scale * at.lost_n + pulls) - used;
        Some([kick, kick])
    }

    /// d = v·dt − ½·acceleration·dt², at the time of u.
    fn resample(&self, to: &Self, ratio: f64, [u, d]: [f64; 2], pushed: f64, springs: &mut [f64]) -> [f64; 2] {
        let acceleration = (self.p - 1.0) * d - self.q * self.a * u + self.pull_of(springs) + pushed;
        if KEEPS {
            // In proportion to q.
            resample_history(springs, ratio);
            springs.iter_mut().for_each(|force| *force *= to.q / self.q);
        }
        let velocity = d + 0.5 * acceleration;
        [u, velocity * ratio - 0.5 * acceleration * ratio * ratio]
    }
}

impl<const KEEPS: bool> TwoStep<KEEPS> {
    /// Returns the sum of the springs' force now and the kept ones.
    fn pull_of(&self, springs: &[f64]) -> f64 {
        self.springs.iter().zip(springs).map(|(weight, force)| weight * force).sum()
    }
}

/// The scheme in the number format of the state; q is in the scale of the springs and the tools.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CentralAdvance<T, const KEEPS: bool> {
    p: T,
    pull: T,
    springs: [T; 3],
    /// Whether damping is almost zero, and no earlier force counts, so that d·d₊ is twice the kinetic energy that the scheme conserves.
    keeps: bool,
}

impl<T: Real, const KEEPS: bool> Arithmetic<T> for CentralAdvance<T, KEEPS> {
    const KEPT: usize = if KEEPS { 2 } else { 0 };
    const WRITTEN: usize = KEEPS as usize;
    const FORCES: usize = 1;
    /// Cuts only d: u is a sum of values that were not cut, and gets smaller only where two of them cancel.
    const CUTS: bool = true;

    #[inline(always)]
    fn advance<V: Vector<Real = T>>(
        &self,
        x: V,
        d: V,
        mut n: V,
        kept: &mut [V; MAX_KEPT],
        force: Option<[V; 2]>,
    ) -> (V, V) {
        if KEEPS {
            let sum = d.splat(self.springs[1]).mul_add(kept[0], d.splat(self.springs[2]).mul(kept[1]));
            // The newest value takes the place of the oldest.
            kept[1] = n;
            n = d.splat(self.springs[0]).mul_add(n, sum);
        }
        let n = if let Some(force) = force { n.add(force[0]) } else { n };
        let d = d.splat(self.p).mul_add(d, d.splat(self.pull).mul_add(x, n));
        let d = d.keep(d.counts());
        (x.add(d), d)
    }

    #[inline(always)]
    fn travel<V: Vector<Real = T>>(&self, _: [V; 2], [_, next]: [V; 2]) -> V {
        // The force acts from half a substep before the substep's beginning to half a substep after it: the
        // mean of d and this. The guard subtracts half of the last at each survey.
        next
    }

    #[inline(always)]
    fn observe<V: Vector<Real = T>>(&self, x: V, d: V, n: V, kept: &[V; MAX_KEPT], force: Option<V>) -> (V, V) {
        // The mean of the increments of the substep just done and of the one that would follow: second order, and at
        // the time of the displacement.
        let (_, next) = self.advance(x, d, n, &mut kept.clone(), force.map(|force| [force; 2]));
        (x, d.splat(T::of(0.5)).mul(d.add(next)))
    }

    #[inline(always)]
    fn conserved_speed_squared<V: Vector<Real = T>>(
        &self,
        x: V,
        d: V,
        n: V,
        kept: &[V; MAX_KEPT],
        force: Option<V>,
    ) -> V {
        // Without damping and tools, the scheme conserves ½·d·d₊ + the elastic energy to the last bit, however large
        // the substep; with the square of the velocity instead, the sum oscillates by (dt·ω)²/8. Strong damping hides
        // that oscillation, and may let d·d₊ rise.
        let (_, next) = self.advance(x, d, n, &mut kept.clone(), force.map(|force| [force; 2]));
        let mean = d.splat(T::of(0.5)).mul(d.add(next));
        if self.keeps { d.mul(next) } else { mean.mul(mean) }
    }
}
