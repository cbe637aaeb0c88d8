//! Central differences with implicit damping: second order, and stable for dt·ω < 2 whatever the damping.
//!
//! m(u₊ − 2u + u₋)/dt² = F(u) − C(u₊ − u₋)/2dt, with d₊ = u₊ − u, d = u − u₋ and g = C·dt/m:
//! (1 + g/2)·d₊ = (1 − g/2)·d + (dt²/m)·F(u).
//!
//! A viscous tissue pulls with N + β·Ṅ, where Ṅ is that of the parabola through N and its last two values: second order, and stable
//! for (dt·ω)²·(1 + 4β) < 4. What branches add (`filter`) is a part of N: viscosity acts on it too.
// The compiler does not always inline iterators over vectors. They then run without the caller's instructions, ten times slower.
#![allow(clippy::needless_range_loop)]

use super::arithmetic::{Arithmetic, MAX_KEPT};
use super::exponential::{rate_weights, resample_history};
use super::family::{Family, QuadratureNode, Release};
use super::filter::BranchFilter;
use super::matrix::Matrix;
use super::oscillator::Coefficients;
use crate::kernel::lanes::Vector;
use crate::kernel::real::Real;
use crate::scene::MAX_BRANCHES;

/// The two-step form d ← p·d + q·(N − a·u + F), u ← u + d of `central` and `lagged`, where d is the increment
/// of the last substep, N the springs' force and F the tools' ([units](super)). a = K″·dt²/m and g = C·dt/m
/// below. `KEPT` is the number of kept fields: with 2, N is a sum over the springs' force now and a substep and two ago, and with 5 also over
/// the filters of branches.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TwoStep<const KEPT: usize> {
    /// p: the part of the last increment that damping leaves: (1 − g/2)/(1 + g/2) for `central`, 1 − g for
    /// `lagged`.
    pub p: f64,
    /// q: the increment per unit of force: 1/(1 + g/2) for `central`, 1 for `lagged`.
    pub q: f64,
    /// a = K″·dt²/m, the pull of the anchor spring.
    pub a: f64,
    /// Weights of N₀, N₋₁ and N₋₂; with none of them kept 1 and zeros.
    pub springs: [f64; 1 + HISTORY],
    /// The filters of branches, whose force is a part of N.
    pub filters: [BranchFilter; MAX_BRANCHES],
}

/// How many forces of the past a two-step scheme keeps, and how many fields with the filters of branches.
const HISTORY: usize = 2;
const LONGEST: usize = HISTORY + MAX_BRANCHES;

/// Fits central differences.
pub(super) fn fit(of: Coefficients) -> TwoStep<LONGEST> {
    let Coefficients { anchor, damping: g, viscosity, branches } = of;
    let filters = branches.map(BranchFilter::of);
    let mut springs = [1.0, 0.0, 0.0];
    for (weight, rate) in springs.iter_mut().zip(rate_weights(1 + HISTORY)) {
        *weight += viscosity * rate;
    }
    TwoStep { p: (1.0 - g / 2.0) / (1.0 + g / 2.0), q: 1.0 / (1.0 + g / 2.0), a: anchor, springs, filters }
}

impl TwoStep<LONGEST> {
    /// Returns the same form for a tissue without what the fields beyond `KEPT` are for.
    pub(super) fn keeping<const KEPT: usize>(self) -> TwoStep<KEPT> {
        let TwoStep { p, q, a, springs, filters } = self;
        TwoStep { p, q, a, springs, filters }
    }
}

impl<const KEPT: usize> Family for TwoStep<KEPT> {
    type Plain<T: Real> = CentralAdvance<T, KEPT>;
    type Compensated<T: Real> = CentralAdvance<T, KEPT>;

    fn plain<T: Real>(&self, _: usize) -> CentralAdvance<T, KEPT> {
        let (mean_pulls, mean_filtered) = BranchFilter::means(&self.filters);
        CentralAdvance {
            p: T::of(self.p),
            pull: T::of(-self.q * self.a),
            springs: self.springs.map(T::of),
            filters: self.filters.map(|filter| [filter.keeps, 1.0 - filter.keeps].map(T::of)),
            whole: T::of(BranchFilter::whole(&self.filters)),
            pulls: self.filters.map(|filter| T::of(-filter.pull)),
            mean_pulls: mean_pulls.map(T::of),
            mean_filtered: mean_filtered.map(T::of),
            keeps: self.p > 0.98 && KEPT == 0,
        }
    }

    fn compensated<T: Real>(&self, sweep: usize) -> CentralAdvance<T, KEPT> {
        self.plain(sweep)
    }

    fn history(&self) -> usize {
        KEPT.min(HISTORY)
    }

    fn filters(&self) -> usize {
        KEPT - self.history()
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
        let weights = self.weights();
        let pull = -self.q * (z * weights[0] + self.a);
        // Kept values are q times the springs' force.
        let springs = -self.q * z;
        let kept = |row: usize, column: usize| match (row, column) {
            (0, 0) => BranchFilter::whole(&self.filters) * springs,
            (0, column) if column >= 2 + HISTORY => -self.filters[column - 2 - HISTORY].pull,
            (1, 2) => 1.0,
            (HISTORY.., 0) => (1.0 - self.filters[row - HISTORY].keeps) * springs,
            (HISTORY.., _) if column == 2 + row => self.filters[row - HISTORY].keeps,
            _ => 0.0,
        };
        let first = |column: usize| match column {
            0 => pull,
            1 => self.p,
            _ => weights[column - 1],
        };
        Matrix::of(2 + KEPT, |row, column| match row {
            0 => f64::from(u8::from(column == 0)) + first(column),
            1 => first(column),
            _ => kept(row - 2, column),
        })
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
        if let Some((history, filtered)) = springs.split_at_mut_checked(1 + HISTORY) {
            let now = history[0];
            history[0] *= BranchFilter::whole(&self.filters);
            for ((s, from), to) in filtered.iter_mut().zip(&self.filters).zip(&to.filters) {
                history[0] -= from.pull * *s;
                *s = ratio * ratio * from.resampled(to, now, *s);
            }
            resample_history(history, ratio);
            // In proportion to q.
            springs.iter_mut().for_each(|force| *force *= to.q / self.q);
        }
        let velocity = d + 0.5 * acceleration;
        [u, velocity * ratio - 0.5 * acceleration * ratio * ratio]
    }
}

impl<const KEPT: usize> TwoStep<KEPT> {
    /// Returns the sum of the springs' force now and the kept values.
    fn pull_of(&self, springs: &[f64]) -> f64 {
        self.weights().iter().zip(springs).map(|(weight, force)| weight * force).sum()
    }

    /// Returns the weights of the springs' force now, without branches, and of the kept values.
    fn weights(&self) -> [f64; 1 + LONGEST] {
        let mut weights = [0.0; 1 + LONGEST];
        weights[..=HISTORY].copy_from_slice(&self.springs);
        let (now, filtered) = BranchFilter::weights(self.springs[0], &self.filters);
        weights[0] = now;
        weights[1 + HISTORY..].copy_from_slice(&filtered);
        weights
    }
}

/// The scheme in the number format of the state; q is in the scale of the springs and the tools.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CentralAdvance<T, const KEPT: usize> {
    p: T,
    pull: T,
    springs: [T; 1 + HISTORY],
    /// The weights of N without branches and of the filters in N.
    whole: T,
    pulls: [T; MAX_BRANCHES],
    /// What each filter keeps of itself, and what it takes from N.
    filters: [[T; 2]; MAX_BRANCHES],
    /// The weights of N₀ without branches, N₋₁ and the filters in the force of the branches during the last increment.
    mean_pulls: [T; 2],
    mean_filtered: [T; MAX_BRANCHES],
    /// Whether damping is almost zero, and no earlier force counts, so that d·d₊ is twice the kinetic energy that the scheme conserves.
    keeps: bool,
}

impl<T: Real, const KEPT: usize> Arithmetic<T> for CentralAdvance<T, KEPT> {
    const KEPT: usize = KEPT;
    const WRITTEN: usize = if KEPT > 0 { KEPT - 1 } else { 0 };
    const FORCES: usize = 1;
    /// Cuts only d: u is a sum of values that were not cut, and gets smaller only where two of them cancel.
    const CUTS: bool = true;
    const RELAXES: bool = KEPT > HISTORY;

    #[inline(always)]
    fn relaxing<V: Vector<Real = T>>(&self, n: V, kept: &[V; MAX_KEPT]) -> V {
        let mut force = n.splat(self.mean_pulls[1]).mul_add(kept[0], n.splat(self.mean_pulls[0]).mul(n));
        for field in HISTORY..KEPT {
            force = n.splat(self.mean_filtered[field - HISTORY]).mul_add(kept[field], force);
        }
        force
    }

    #[inline(always)]
    fn advance<V: Vector<Real = T>>(
        &self,
        x: V,
        d: V,
        mut n: V,
        kept: &mut [V; MAX_KEPT],
        force: Option<[V; 2]>,
    ) -> (V, V) {
        if KEPT > 0 {
            let sum = d.splat(self.springs[1]).mul_add(kept[0], d.splat(self.springs[2]).mul(kept[1]));
            if Self::RELAXES {
                let mut whole = d.splat(self.whole).mul(n);
                for field in HISTORY..KEPT {
                    whole = d.splat(self.pulls[field - HISTORY]).mul_add(kept[field], whole);
                    let [keeps, takes] = self.filters[field - HISTORY];
                    kept[field] = d.splat(keeps).mul_add(kept[field], d.splat(takes).mul(n));
                }
                n = whole;
            }
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
