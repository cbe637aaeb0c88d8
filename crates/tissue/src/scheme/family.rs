//! The interface between a family of schemes and the tissue.

use super::arithmetic::Arithmetic;
use super::matrix::Matrix;
use crate::kernel::real::Real;

/// A moment of a substep at which a tool's force is evaluated, and what its value adds to the scheme.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct QuadratureNode {
    /// Fraction of the substep: 0 is its beginning, 1 its end.
    pub fraction: f64,
    /// Weights with which the force (times dt²/(m·h)) adds to each of the scheme's force fields; those beyond
    /// its last field are 0.
    pub weights: [f64; 3],
}

/// One component of a point that a tool releases at the beginning of a substep.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Release<'a> {
    /// The displacement.
    pub(crate) u: f64,
    /// The springs' force now, then the forces that the scheme keeps, newest first, then the filters of branches.
    pub(crate) springs: &'a [f64],
    /// The tools' force that the substep uses.
    pub(crate) used: f64,
    /// The factor from newtons to the scheme's unit of force.
    pub(crate) scale: f64,
    /// The damping force and the tools' force from now on, N.
    pub(crate) lost_n: f64,
}

/// A scheme with coefficients for a tissue and a substep. Units as in [`super`].
pub(crate) trait Family {
    /// The arithmetic in a number format.
    type Plain<T: Real>: Arithmetic<T>;
    /// The arithmetic with compensation of rounding errors, if the family has that.
    type Compensated<T: Real>: Arithmetic<T>;

    /// Returns the arithmetic of sweep number `sweep`.
    fn plain<T: Real>(&self, sweep: usize) -> Self::Plain<T>;

    /// Returns the arithmetic of sweep number `sweep` with compensation.
    fn compensated<T: Real>(&self, sweep: usize) -> Self::Compensated<T>;

    /// Returns the number of sweeps over the springs in a substep.
    fn sweeps(&self) -> usize {
        1
    }

    /// Returns the number of fields that the scheme keeps besides u and d.
    fn kept(&self, compensated: bool) -> usize {
        if compensated { Self::Compensated::<f64>::KEPT } else { Self::Plain::<f64>::KEPT }
    }

    /// Returns how many of the kept fields, from the first, are the springs' forces of earlier substeps, newest
    /// first.
    fn history(&self) -> usize {
        0
    }

    /// Returns how many of the kept fields, after those of the history, are filters of branches.
    fn filters(&self) -> usize {
        0
    }

    /// Returns whether a force that jumps must be given as the mean of both sides.
    fn takes_means(&self) -> bool {
        false
    }

    /// Returns the field of the tools' force that adds to the velocity.
    fn last_field(&self) -> usize;

    /// Returns the first field of the tools' force that sweep number `sweep` reads.
    fn field(&self, _sweep: usize) -> usize {
        0
    }

    /// Returns the fraction of the substep to which the state after sweep number `sweep` belongs; `None` after
    /// the last.
    fn fraction_after(&self, _sweep: usize) -> Option<f64> {
        None
    }

    /// Returns the moments (0 to 1) at which a tool's force is evaluated, and the weights with which each value
    /// adds to the scheme's force fields.
    fn nodes(&self) -> Vec<QuadratureNode>;

    /// Returns the factor that scales the springs' forces in addition to dt²/(m·h).
    fn spring_scale(&self) -> f64 {
        1.0
    }

    /// Returns the u and d that a constant force of 1 adds in a substep.
    fn constant(&self) -> [f64; 2];

    /// Returns the u and d that an impulse of 1 at a substep's beginning has added by its end.
    fn kick(&self) -> [f64; 2];

    /// Returns the matrix that advances u, d and the kept values of a single vibration whose springs pull with
    /// −z·u.
    fn propagator(&self, z: f64) -> Matrix;

    /// Returns the changes of a point's u and d when a tool releases it, so that it continues smoothly; `None`
    /// if nothing must change.
    fn release(&self, at: Release<'_>) -> Option<[f64; 2]>;

    /// Converts u and d of one component of a point to the same scheme with another substep, `ratio` times as
    /// long. Also converts `springs`: the springs' force now, then the kept forces, newest first, then the filters of branches. `pushed`
    /// is the tools' force.
    fn resample(&self, to: &Self, ratio: f64, state: [f64; 2], pushed: f64, springs: &mut [f64]) -> [f64; 2];
}
