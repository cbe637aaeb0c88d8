//! The elastic force of a spring, without cancellation and nearly without square roots.
//!
//! Lengths are counted in spacings. With D0 the rest vector of a spring a–b, Δ = u_b − u_a and
//! Q = 2·D0·Δ + Δ·Δ = L² − L0², q = Q/L0², its length is L = s·L0, s = √(1 + q), and 1 − L0/L = q/(s(1 + s)):
//! the extension without the cancellation that L − L0 has. So
//!
//! force on a = k(1 − L0/L)(x_b − x_a) = k·q/(s(1 + s))·(D0 + Δ),  energy = ½k(L − L0)² = ½k·L0²·(q/(1 + s))².
//!
//! **Pretension.** With the strain ε at rest, the force is k·ε·L0 there, along D0, and something holds the rest shape against it: a
//! constant load on each end. The length at which such a spring is slack is L0·(1 − ε), so that spring and load give
//!
//! force on a = k(1 − ε)(1 − L0/L)(D0 + Δ) + k·ε·Δ,
//! energy = ½k(1 − ε)(L − L0)² + ½k·ε·Δ·Δ, if it is counted from rest.
//!
//! Both are 0 at rest, again without cancellation. Of a severed spring the load alone is left, −k·ε·D0 on a: it opens the cut. Its energy is
//! −k·ε·D0·Δ. The stiffness along the spring is k, and across it at most that, as without pretension.
//!
//! For |q| ≤ 1/8 (strains up to 6 %), q/(s(1 + s)) is q times a polynomial that is exact to the last bits; beyond, it
//! comes from 1/s ([`SpringCoefficients::far`]). The choice depends on that spring alone, so every vector width agrees.

use crate::kernel::field::Layout;
use crate::kernel::lanes::{Scalar, Vector};
use crate::kernel::real::Real;
use crate::scene;

/// The smallest 1 + q = (L/L0)². A spring pressed to zero length has no direction. Below a millionth of its
/// rest length its force fades to 0 in proportion to its length, so nothing divides by 0.
const MIN_LENGTH_SQUARED: f64 = 1e-12;

/// The largest |q| for which the polynomial is valid.
const NEAR: f64 = 0.125;

/// Springs of the same rest length and stiffness.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SpringCoefficients<T> {
    /// k times the factor to the scheme's units of force.
    stiffness: T,
    /// Polynomial in Q of the stiffness times (1 − L0/L)/Q.
    series: [T; 14],
    /// The largest |Q| for which the polynomial is valid.
    near: T,
    /// 1/L0².
    per_length_squared: T,
    /// k·ε, with the strain ε of the pretension; 0 without.
    pub(crate) tension: T,
}

impl<T: Real> SpringCoefficients<T> {
    /// Computes the coefficients. `stiffness` is k times any factor; `length_squared` is L0², in spacings
    /// squared.
    pub(crate) fn new(stiffness: f64, length_squared: f64) -> Self {
        Self::tense(stiffness, length_squared, 0.0)
    }

    /// Computes the coefficients of springs with a pretension: `prestrain` is their strain at rest.
    pub(crate) fn tense(stiffness: f64, length_squared: f64, prestrain: f64) -> Self {
        let tension = T::of(prestrain * stiffness);
        let stiffness = (1.0 - prestrain) * stiffness;
        let mut power = stiffness;
        let series = T::SERIES.map(|coefficient| {
            power /= length_squared;
            T::of(coefficient * power)
        });
        SpringCoefficients {
            stiffness: T::of(stiffness),
            series,
            near: T::of(NEAR * length_squared),
            per_length_squared: T::of(length_squared.recip()),
            tension,
        }
    }

    /// Returns the lanes in which [`SpringCoefficients::near`] is not valid, given the magnitude of Q.
    #[inline(always)]
    pub(crate) fn is_far<V: Vector<Real = T>>(&self, magnitude: V) -> V::Mask {
        magnitude.above(magnitude.splat(self.near))
    }

    /// Returns stiffness × (1 − L0/L) for small Q. Even and odd powers are summed separately, which halves the
    /// dependency chain. A spring whose strain is too small to count does not pull: at rest, the force is
    /// exactly 0.
    #[inline(always)]
    pub(crate) fn near<V: Vector<Real = T>>(&self, excess: V) -> V {
        self.series(excess, Self::square(excess)).keep(Self::counts(excess))
    }

    /// Returns stiffness × (1 − L0/L) for small Q, and a square that shows where it is not valid
    /// ([`SpringCoefficients::is_square_far`]). The square also decides which springs have too little strain to count,
    /// so their bound is rounded differently from [`SpringCoefficients::near`].
    #[inline(always)]
    pub(crate) fn near_and_square<V: Vector<Real = T>>(&self, excess: V) -> (V, V) {
        let square = Self::square(excess);
        let least = T::of(T::MIN_EXCESS * T::MIN_EXCESS + T::FAINT);
        (self.series(excess, square).keep(square.above(excess.splat(least))), square)
    }

    /// Returns the lanes in which [`SpringCoefficients::near_and_square`] is not valid, given its square or the
    /// largest of several.
    #[inline(always)]
    pub(crate) fn is_square_far<V: Vector<Real = T>>(&self, square: V) -> V::Mask {
        square.above(square.splat(self.near * self.near))
    }

    /// Returns stiffness × (1 − L0/L) for small Q for the springs of `mask`; the others do not pull.
    #[inline(always)]
    pub(crate) fn near_of<V: Vector<Real = T>>(&self, mask: V::Mask, excess: V) -> V {
        self.series(excess, Self::square(excess)).keep(V::both(Self::counts(excess), mask))
    }

    #[inline(always)]
    fn counts<V: Vector<Real = T>>(excess: V) -> V::Mask {
        excess.beyond(excess.splat(T::of(T::MIN_EXCESS)))
    }

    /// Returns Q², but never below the normal range.
    #[inline(always)]
    fn square<V: Vector<Real = T>>(excess: V) -> V {
        excess.mul_add(excess, excess.splat(T::of(T::FAINT)))
    }

    #[inline(always)]
    fn series<V: Vector<Real = T>>(&self, excess: V, square: V) -> V {
        let (mut even, mut odd) = (excess.splat(self.series[T::TERMS - 2]), excess.splat(self.series[T::TERMS - 1]));
        for term in (0..T::TERMS / 2 - 1).rev() {
            even = even.mul_add(square, excess.splat(self.series[2 * term]));
            odd = odd.mul_add(square, excess.splat(self.series[2 * term + 1]));
        }
        odd.mul_add(excess, even).mul(excess)
    }

    /// Returns stiffness × (1 − L0/L) for any Q, most accurate away from 0. With r near 1/s, e = 1 − r²(1 + q)
    /// is small, and 1 − 1/s = (1 − r) − r·e/2 up to e², where 1 − r is exact for r from ½ to 2. A rough r from
    /// the bits of the number and a few Newton steps cost a quarter of a root and a division, whose throughput
    /// does not grow with the vector width.
    #[inline(always)]
    pub(crate) fn far<V: Vector<Real = T>>(&self, excess: V) -> V {
        let (one, half) = (excess.splat(T::of(1.0)), excess.splat(T::of(0.5)));
        let q = excess.mul(excess.splat(self.per_length_squared));
        let sum = one.add(q);
        // The rounding error of the sum.
        let rest = q.sub(sum.sub(one));
        let square = sum.larger(excess.splat(T::of(MIN_LENGTH_SQUARED)));
        let mut r = square.approximate_inverse_root();
        let halved = half.mul(square);
        for _ in 0..T::NEWTON {
            r = r.mul(excess.splat(T::of(1.5)).minus(halved.mul(r), r));
        }
        let e = one.minus(square.mul(r), r).minus(r.mul(r), rest);
        excess.splat(self.stiffness).mul(one.sub(r).minus(half.mul(r), e))
    }

    /// Returns stiffness × (1 − L0/L), in each lane by the form that is valid there.
    #[inline(always)]
    pub(crate) fn weight<V: Vector<Real = T>>(&self, excess: V) -> V {
        let far = excess.beyond(excess.splat(self.near));
        let near = self.near(excess);
        if V::any(far) { V::select(far, self.far(excess), near) } else { near }
    }

    /// Returns the energy, stiffness × ½(L − L0)².
    #[inline(always)]
    pub(crate) fn energy<V: Vector<Real = T>>(&self, excess: V) -> V {
        let (q, s) = self.stretch(excess);
        let extension = q.div(excess.splat(T::of(1.0)).add(s));
        let extension = extension.keep(Self::counts(excess));
        excess.splat(T::of(0.5 * self.stiffness.wide() / self.per_length_squared.wide())).mul(extension.mul(extension))
    }

    /// Returns q and s.
    #[inline(always)]
    fn stretch<V: Vector<Real = T>>(&self, excess: V) -> (V, V) {
        let q = excess.mul(excess.splat(self.per_length_squared));
        let square = excess.splat(T::of(1.0)).add(q);
        (q, square.larger(excess.splat(T::of(MIN_LENGTH_SQUARED))).root())
    }
}

/// The springs of a sheet, with forces scaled for a scheme.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Springs<T> {
    pub(crate) structural: SpringCoefficients<T>,
    pub(crate) shear: SpringCoefficients<T>,
    pub(crate) bending: Option<SpringCoefficients<T>>,
}

impl<T: Real> Springs<T> {
    /// Computes the coefficients; forces are in newtons × `scale` / spacing. `prestrain` is the strain of the pretension.
    pub(crate) fn new(springs: &scene::Springs, prestrain: f64, scale: f64) -> Self {
        let (structural, shear) = (springs.stiffness_n_per_m * scale, springs.shear_stiffness_n_per_m * scale);
        Springs {
            structural: SpringCoefficients::tense(structural, 1.0, prestrain),
            shear: SpringCoefficients::tense(shear, 2.0, prestrain),
            bending: springs.bending.then(|| SpringCoefficients::new(structural, 4.0)),
        }
    }

    /// Returns whether the sheet has a pretension.
    #[inline(always)]
    pub(crate) fn is_tense(&self) -> bool {
        self.structural.tension != T::default() || self.shear.tension != T::default()
    }

    /// Returns the force of all springs on the point [i, j]. `factor` gives the factor of the stiffness of each from its number and the row and
    /// column of its other end; 0: it is severed. For a few single points.
    // Loops over indices: iterators are not always inlined, and then run without the caller's instructions.
    #[allow(clippy::needless_range_loop)]
    #[inline(always)]
    pub(crate) fn gather(
        &self,
        layout: &Layout,
        u: &[T],
        [i, j]: [usize; 2],
        factor: impl Fn(usize, [usize; 2]) -> f64,
    ) -> [T; 3] {
        let mut sum = [T::default(); 3];
        let own = i * layout.stride + j;
        let kinds = [Some(&self.structural), Some(&self.shear), self.bending.as_ref()];
        for kind in 0..3 {
            let Some(spring) = kinds[kind] else { continue };
            for end in 0..4 {
                let [di, dj] = ENDS[kind][end];
                // Below 0 it wraps, to beyond the last.
                let (i1, j1) = (i.wrapping_add_signed(di), j.wrapping_add_signed(dj));
                if i1 >= layout.rows || j1 >= layout.columns {
                    continue;
                }
                #[allow(clippy::cast_precision_loss)]
                let rest = [T::of(di as f64), T::of(dj as f64), T::default()];
                let tension = spring.tension;
                let factor = factor(4 * kind + end, [i1, j1]);
                if factor == 0.0 {
                    // What held the rest shape against the spring stays.
                    for c in 0..3 {
                        sum[c] += T::default() - tension * rest[c];
                    }
                    continue;
                }
                let (other, mut delta) = (i1 * layout.stride + j1, [T::default(); 3]);
                for c in 0..3 {
                    delta[c] = u[c * layout.plane + other] - u[c * layout.plane + own];
                }
                let along = rest[0] * delta[0] + rest[1] * delta[1];
                let mut squares = along + along;
                for c in 0..3 {
                    squares = delta[c].fused(delta[c], squares);
                }
                let weight = spring.weight(Scalar(squares)).0 * T::of(factor);
                for c in 0..3 {
                    sum[c] += (weight + tension).fused(delta[c], weight * rest[c]);
                }
            }
        }
        sum
    }
}

/// Rows and columns to the other ends of structural, shear and bending springs. Seen from the other end, entry n of a kind is
/// entry 3 − n.
pub(crate) const ENDS: [[[isize; 2]; 4]; 3] =
    [[[-1, 0], [0, -1], [0, 1], [1, 0]], [[-1, -1], [-1, 1], [1, -1], [1, 1]], [[-2, 0], [0, -2], [0, 2], [2, 0]]];

#[cfg(test)]
mod tests {
    use super::*;

    fn pulls_by_its_extension<T: Real>(within: f64) {
        for length_squared in [1.0, 2.0, 4.0] {
            let kind = SpringCoefficients::<T>::new(3.0, length_squared);
            for thousandth in -600..=900 {
                let length = 1.0 + f64::from(thousandth) / 1000.0;
                let excess = T::of((length * length - 1.0) * length_squared);
                // As the format has it.
                let q = excess.wide() / length_squared;
                let s = (1.0 + q).sqrt();
                let truth = 3.0 * q / (s * (1.0 + s));
                let found = kind.weight(Scalar(excess)).0.wide();
                assert!(
                    (found - truth).abs() <= within * truth.abs(),
                    "{length_squared} {thousandth}: {found} {truth}"
                );
                let energy = kind.energy(Scalar(excess)).0.wide();
                let truth = 1.5 * length_squared * (s - 1.0).powi(2);
                assert!(
                    (energy - truth).abs() <= 1e2 * within * truth,
                    "{length_squared} {thousandth}: {energy} {truth}"
                );
            }
        }
    }

    #[test]
    fn a_spring_pulls_by_its_extension_over_its_length() {
        pulls_by_its_extension::<f32>(1e-6);
        pulls_by_its_extension::<f64>(1e-14);
    }
}
