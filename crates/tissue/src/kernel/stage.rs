//! The stage of a sweep: what happens at each block of points once the springs' force on it is known.
#![allow(unsafe_code)]

use crate::kernel::lanes::Vector;
use crate::kernel::real::Real;

/// What a sweep does with the springs' force on a block of points.
pub(crate) trait Stage<T: Real> {
    /// Whether the sweep also reports the energies of the springs.
    const ENERGY: bool = false;

    /// Returns the duty of a row (see [`ROW_UNLOADED`]). `finish` gets it at compile time.
    fn duty(&self, _row: usize) -> u8 {
        ROW_UNLOADED
    }

    /// Returns the initial values of the sums.
    ///
    /// # Safety
    /// The pointers of the stage are valid, and the processor has the instructions.
    #[inline(always)]
    unsafe fn begin<V: Vector<Real = T>>(&self) -> [V; 2] {
        [unsafe { V::of(T::default()) }; 2]
    }

    /// Handles a block of row `row` that begins at place `at`. `x` are its displacements, `n` the springs'
    /// forces on it. Adds to `sums`; the stage gets the totals at the end.
    ///
    /// # Safety
    /// The pointers of the stage are valid.
    unsafe fn finish<V: Vector<Real = T>, const DUTY: u8>(
        &self,
        row: usize,
        at: usize,
        x: [V; 3],
        n: [V; 3],
        sums: &mut [V; 2],
    );

    /// Receives the energies of the springs that begin in the block at `column`.
    ///
    /// # Safety
    /// The pointers of the stage are valid.
    unsafe fn energy<V: Vector<Real = T>>(&self, _column: usize, _energy: V) {}

    /// Ends a row.
    ///
    /// # Safety
    /// The pointers of the stage are valid.
    unsafe fn end_row(&self) {}

    /// Ends the sweep; `_sums` are the totals.
    ///
    /// # Safety
    /// The pointers of the stage are valid.
    unsafe fn end<V: Vector<Real = T>>(&self, _sums: [V; 2]) {}
}

/// Duties of a row ([`Stage::duty`]): springs only, springs and one tool's force, or anything.
pub(crate) const ROW_UNLOADED: u8 = 0;
pub(crate) const ROW_LOADED: u8 = 1;
pub(crate) const ANY: u8 = 2;
