//! The classical fourth-order Runge–Kutta scheme: four evaluations of the forces per substep. A reference for
//! comparison.
//!
//! y′ = f(y), y = (u, w): k₁ = f(y), k₂ = f(y + k₁/2), k₃ = f(y + k₂/2), k₄ = f(y + k₃),
//! y₊ = y + (k₁ + 2k₂ + 2k₃ + k₄)/6. Each stage is a sweep that evaluates the springs at the u of the stage before,
//! adds to the sum, and writes the u and w that the next stage needs.

use super::arithmetic::{Arithmetic, MAX_KEPT};
use super::family::{Family, QuadratureNode, Release};
use super::matrix::Matrix;
use crate::kernel::lanes::Vector;
use crate::kernel::real::Real;

/// Kept fields: u and w at the beginning, and the sums of the slopes so far.
const KEPT: usize = 4;

/// The four stages: how far the next stage follows this slope, and the weight of the slope in the sum.
const STAGES: [(f64, f64); 4] = [(0.5, 1.0 / 6.0), (0.5, 1.0 / 3.0), (1.0, 1.0 / 3.0), (0.0, 1.0 / 6.0)];

/// Advances a single vibration by one substep.
fn step(pull: f64, g: f64, force: f64, y: [f64; 2]) -> [f64; 2] {
    let slope = |y: [f64; 2]| [y[1], force - pull * y[0] - g * y[1]];
    let along = |k: [f64; 2], far: f64| [y[0] + far * k[0], y[1] + far * k[1]];
    let k1 = slope(y);
    let k2 = slope(along(k1, 0.5));
    let k3 = slope(along(k2, 0.5));
    let k4 = slope(along(k3, 1.0));
    [0, 1].map(|c: usize| y[c] + (k1[c] + 2.0 * k2[c] + 2.0 * k3[c] + k4[c]) / 6.0)
}

/// The classical scheme of Runge and Kutta for y′ = (w, N − a·u − g·w + F), y = (u, w), with N the springs'
/// force and F the tools' ([units](super)).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rk4 {
    /// a = K″·dt²/m, the pull of the anchor spring.
    pub a: f64,
    /// g = C·dt/m, the damping.
    pub g: f64,
}

impl Family for Rk4 {
    type Plain<T: Real> = Rk4Advance<T>;
    type Compensated<T: Real> = Rk4Advance<T>;

    fn plain<T: Real>(&self, sweep: usize) -> Rk4Advance<T> {
        let (far, share) = STAGES[sweep];
        Rk4Advance { a: T::of(-self.a), g: T::of(-self.g), far: T::of(far), share: T::of(share), stage: sweep }
    }

    fn compensated<T: Real>(&self, sweep: usize) -> Rk4Advance<T> {
        self.plain(sweep)
    }

    fn sweeps(&self) -> usize {
        STAGES.len()
    }

    fn last_field(&self) -> usize {
        1
    }

    fn field(&self, sweep: usize) -> usize {
        sweep.div_ceil(2)
    }

    fn fraction_after(&self, sweep: usize) -> Option<f64> {
        (sweep + 1 < STAGES.len()).then(|| STAGES[sweep].0)
    }

    fn nodes(&self) -> Vec<QuadratureNode> {
        let node = |k: usize| {
            #[allow(clippy::cast_precision_loss)]
            let fraction = k as f64 / 2.0;
            QuadratureNode { fraction, weights: std::array::from_fn(|field| f64::from(u8::from(field == k))) }
        };
        (0..3).map(node).collect()
    }

    fn constant(&self) -> [f64; 2] {
        [0.5, 1.0]
    }

    fn kick(&self) -> [f64; 2] {
        [1.0; 2]
    }

    fn propagator(&self, z: f64) -> Matrix {
        let pull = self.a + z;
        let columns = [step(pull, self.g, 0.0, [1.0, 0.0]), step(pull, self.g, 0.0, [0.0, 1.0])];
        Matrix::of(2, |i, j| columns[j][i])
    }

    /// u and w are the point's own values: it continues with the tool's velocity.
    fn release(&self, _: Release<'_>) -> Option<[f64; 2]> {
        None
    }

    fn resample(&self, _: &Self, ratio: f64, [u, w]: [f64; 2], _: f64, _: &mut [f64]) -> [f64; 2] {
        [u, w * ratio]
    }
}

/// One stage, in the number format of the state.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Rk4Advance<T> {
    a: T,
    g: T,
    far: T,
    share: T,
    stage: usize,
}

impl<T: Real> Arithmetic<T> for Rk4Advance<T> {
    const KEPT: usize = KEPT;
    const WRITTEN: usize = KEPT;
    const FORCES: usize = 1;

    #[inline(always)]
    fn advance<V: Vector<Real = T>>(
        &self,
        x: V,
        d: V,
        n: V,
        kept: &mut [V; MAX_KEPT],
        force: Option<[V; 2]>,
    ) -> (V, V) {
        let n = if let Some(force) = force { n.add(force[0]) } else { n };
        let slope = [d, d.splat(self.g).mul_add(d, d.splat(self.a).mul_add(x, n))];
        let share = d.splat(self.share);
        if self.stage == 0 {
            [kept[0], kept[1], kept[2], kept[3]] = [x, d, share.mul(slope[0]), share.mul(slope[1])];
        } else {
            kept[2] = share.mul_add(slope[0], kept[2]);
            kept[3] = share.mul_add(slope[1], kept[3]);
        }
        if self.stage + 1 == STAGES.len() {
            return (kept[0].add(kept[2]), kept[1].add(kept[3]));
        }
        let far = d.splat(self.far);
        (far.mul_add(slope[0], kept[0]), far.mul_add(slope[1], kept[1]))
    }

    #[inline(always)]
    fn travel<V: Vector<Real = T>>(&self, [_, d]: [V; 2], _: [V; 2]) -> V {
        d.splat(self.share).mul(d)
    }

    #[inline(always)]
    fn observe<V: Vector<Real = T>>(&self, x: V, d: V, _: V, _: &[V; MAX_KEPT], _: Option<V>) -> (V, V) {
        (x, d)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_stage_has_the_force_of_the_moment_at_which_it_is() {
        let scheme = Rk4 { a: 0.01, g: 0.1 };
        let nodes = scheme.nodes();
        let mut fraction = 0.0;
        for (sweep, moment) in [0.0, 0.5, 0.5, 1.0].into_iter().enumerate() {
            assert_eq!(fraction, moment, "stage {sweep}");
            // The only node whose force is in the stage's field.
            let field = scheme.field(sweep);
            let forces: Vec<f64> =
                nodes.iter().filter(|node| node.weights[field] != 0.0).map(|node| node.fraction).collect();
            assert_eq!(forces, [moment], "stage {sweep}");
            fraction = scheme.fraction_after(sweep).unwrap_or(1.0);
        }
    }
}
