//! The grid that a sweep reads: displacements, springs, carried forces, and the differences between neighbours.
#![allow(unsafe_code)]

use super::cuts::SheetCuts;
use crate::kernel::field::Layout;
use crate::kernel::lanes::Vector;
use crate::kernel::real::Real;
use crate::kernel::springs::Springs;

/// What a sweep reads, and where it keeps forces on later rows.
pub(crate) struct Grid<'a, T> {
    pub(crate) layout: Layout,
    pub(crate) springs: &'a Springs<T>,
    pub(crate) cuts: &'a SheetCuts<T>,
    /// a = K″·dt²/m in the scheme's units of force: the factor of the extra anchor stiffness.
    pub(crate) pull: T,
    /// Displacements: three planes, spacings.
    pub(crate) x: *const T,
    /// Forces that rows leave to those below: three planes of [`CARRY_ROWS`] rows.
    pub(crate) carry: *mut T,
}

/// Rows of the carry: two for the row before, and two for bending springs, which reach two rows on.
pub(crate) const CARRY_ROWS: usize = 4;

/// Returns Q of a spring whose rest vector is `rest` times the unit vector along it: 2·along + Δ·Δ, where
/// `along` is D0·Δ. The added [`Real::FAINT`] keeps the squares of small Δ across the spring above the
/// subnormal range.
#[inline(always)]
pub(crate) fn excess<V: Vector>(along: V, delta: &[V; 3], [first, second, third]: [usize; 3]) -> V {
    let faint = along.mul_add(along.splat(V::Real::of(2.0)), along.splat(V::Real::of(V::Real::FAINT)));
    let sum = delta[first].mul_add(delta[first], faint);
    delta[third].mul_add(delta[third], delta[second].mul_add(delta[second], sum))
}

#[inline(always)]
pub(crate) fn difference<V: Vector>(to: &[V; 3], from: &[V; 3]) -> [V; 3] {
    [to[0].sub(from[0]), to[1].sub(from[1]), to[2].sub(from[2])]
}

/// Loads the three components of a block.
///
/// # Safety
/// All three can be read.
#[inline(always)]
pub(crate) unsafe fn load<V: Vector>(at: *const V::Real, plane: usize) -> [V; 3] {
    // SAFETY: the caller's promise.
    unsafe { [V::load(at), V::load(at.add(plane)), V::load(at.add(2 * plane))] }
}
