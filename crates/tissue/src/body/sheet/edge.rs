//! The left edge of a strip: springs that begin in the column to its left and pull at its first column.
//!
//! They are evaluated along the column, as many rows at a time as a vector has lanes: a block of columns for each row
//! would cost as much as an awake block. Each lane does the same operations as the sweep would for its row, in the same
//! order: the bits are the same.
#![allow(unsafe_code)]
// The compiler does not always inline iterators over vectors. They then run without the caller's instructions, ten
// times slower.
#![allow(clippy::needless_range_loop)]

use crate::body::sheet::cuts::{COUNTER_DIAGONAL, DIAGONAL, RIGHT};
use crate::body::sheet::grid::{Grid, difference, excess, load};
use crate::kernel::field::{BLOCK, Layout};
use crate::kernel::lanes::Vector;
use crate::kernel::real::Real;
use crate::kernel::springs::Springs;

/// The forces of the column to the left of a strip on its first column, for as many rows at a time as a vector has
/// lanes.
pub(crate) struct Edge<V: Vector> {
    /// The strip's first column.
    column: usize,
    /// The range of rows that are evaluated.
    from: usize,
    to: usize,
    /// The force that each row passes to the right, in the sweep's order.
    across: [[V::Real; BLOCK]; 3],
    /// The forces of the diagonals on the row below.
    leaves: [V; 3],
}

impl<V: Vector> Edge<V> {
    /// Begins a strip whose first row is `row`. The force from the strip above is in the carry, if there is
    /// one.
    ///
    /// # Safety
    /// As for `Sweep::rows`; `column` is not 0.
    #[inline(always)]
    pub(crate) unsafe fn new(grid: &Grid<'_, V::Real>, column: usize, row: usize) -> Self {
        let Layout { stride, plane, .. } = grid.layout;
        debug_assert!((1..=stride).contains(&column) && grid.layout.holds(stride + column - 1, 1));
        // SAFETY: the caller's promise: the processor has the instructions, and the carry has a second row.
        let leaves = unsafe {
            let left = grid.carry.add(stride + column - 1);
            [V::of(*left), V::of(*left.add(plane)), V::of(*left.add(2 * plane))]
        };
        Edge { column, from: row, to: row, across: [[V::Real::default(); BLOCK]; 3], leaves }
    }

    /// Returns the force that the column passes to the right in row `i`, in the last lane. Call it for
    /// consecutive rows.
    ///
    /// # Safety
    /// As for `Sweep::rows`; the strip's rows from `i` on have not been advanced.
    #[inline(always)]
    pub(crate) unsafe fn left_of(&mut self, grid: &Grid<'_, V::Real>, i: usize) -> [V; 3] {
        if i == self.to {
            // SAFETY: the caller's promise.
            unsafe { self.evaluate(grid, i) };
        }
        let (k, proof) = (i - self.from, self.leaves[0]);
        [proof.splat(self.across[0][k]), proof.splat(self.across[1][k]), proof.splat(self.across[2][k])]
    }

    #[inline(always)]
    unsafe fn evaluate(&mut self, grid: &Grid<'_, V::Real>, row: usize) {
        let Layout { rows, stride, plane, .. } = grid.layout;
        let Springs { structural, shear, .. } = grid.springs;
        // Three components of both columns, and one extra row. Values below the sheet are not used.
        const LONG: usize = BLOCK + 1;
        let mut columns = [[V::Real::default(); 3 * LONG]; 2];
        for k in 0..=V::LANES {
            // SAFETY: the caller's promise: a row beyond the last can be read.
            let offset = (row + k).min(rows) * stride + self.column - 1;
            debug_assert!(grid.layout.holds(offset, 2));
            let at = unsafe { grid.x.add(offset) };
            for c in 0..3 {
                // SAFETY: as above.
                unsafe {
                    columns[0][c * LONG + k] = *at.add(c * plane);
                    columns[1][c * LONG + k] = *at.add(c * plane + 1);
                }
            }
        }
        let (first, second) = (columns[0].as_ptr(), columns[1].as_ptr());
        // SAFETY: each component has room for a vector that begins at 1.
        let (here, right) = unsafe { (load::<V>(first, LONG), load::<V>(second, LONG)) };
        // SAFETY: as above.
        let (below, beside) = unsafe { (load::<V>(first.add(1), LONG), load::<V>(second.add(1), LONG)) };
        let (r, a, b) = (difference(&right, &here), difference(&beside, &here), difference(&below, &right));
        let qr = excess(r[1], &r, [1, 0, 2]);
        let (qa, qb) = (excess(a[0].add(a[1]), &a, [0, 1, 2]), excess(b[0].sub(b[1]), &b, [0, 1, 2]));
        let (mut wr, mut wa, mut wb) = (structural.near(qr), shear.near(qa), shear.near(qb));
        if V::any(V::either(structural.is_far(qr.farther(qr)), shear.is_far(qa.farther(qb)))) {
            (wr, wa, wb) = (structural.weight(qr), shear.weight(qa), shear.weight(qb));
        }
        // As in the sweep: the factors of the differences, and the load that is left of a severed spring.
        let (mut gr, mut ga, mut gb) = (wr, wa, wb);
        let mut ties = [r[0].splat(V::Real::default()); 2];
        if grid.springs.is_tense() {
            ties = [r[0].splat(structural.tension), r[0].splat(shear.tension)];
            (gr, ga, gb) = (wr.add(ties[0]), wa.add(ties[1]), wb.add(ties[1]));
        }
        if !grid.cuts.is_empty() {
            // The factors of this column, row by row.
            let mut factors = [[V::Real::of(1.0); BLOCK]; 3];
            for k in 0..V::LANES {
                let cuts = grid.cuts.row(row + k);
                if !cuts.is_null() {
                    for (factors, spring) in factors.iter_mut().zip([RIGHT, DIAGONAL, COUNTER_DIAGONAL]) {
                        // SAFETY: a row of factors has the columns of the sheet.
                        factors[k] = unsafe { *cuts.add(spring * stride + self.column - 1) };
                    }
                }
            }
            // SAFETY: a block is as long as the widest vector.
            let [fr, fa, fb] =
                unsafe { [V::load(factors[0].as_ptr()), V::load(factors[1].as_ptr()), V::load(factors[2].as_ptr())] };
            (gr, ga, gb) = (gr.mul(fr), ga.mul(fa), gb.mul(fb));
            (wr, wa) = (wr.mul(fr).sub(ties[0].minus(ties[0], fr)), wa.mul(fa).sub(ties[1].minus(ties[1], fa)));
            wb = wb.mul(fb).sub(ties[1].minus(ties[1], fb));
        }
        let last = r[0].first((rows - 1).saturating_sub(row).min(V::LANES));
        for c in 0..3 {
            let fr = if c == 1 { gr.mul_add(r[c], wr) } else { gr.mul(r[c]) };
            let fa = if c < 2 { ga.mul_add(a[c], wa) } else { ga.mul(a[c]) };
            let fb = [gb.mul_add(b[c], wb), gb.mul_sub(b[c], wb), gb.mul(b[c])][c];
            let above = fa.shift(self.leaves[c]);
            // The last row of the sheet has only the spring to the right.
            let across = V::select(last, fb.sub(fr).sub(above), fr.add(above));
            // SAFETY: a block is as long as the widest vector.
            unsafe { across.store(self.across[c].as_mut_ptr()) };
            self.leaves[c] = fa;
        }
        (self.from, self.to) = (row, row + V::LANES);
    }

    /// Stores the forces for the strip below, which begins at row `end`, as a block of this column would have
    /// left them.
    ///
    /// # Safety
    /// As for `Sweep::rows`.
    #[inline(always)]
    pub(crate) unsafe fn leave(&self, grid: &Grid<'_, V::Real>, end: usize) {
        let Layout { stride, plane, .. } = grid.layout;
        for c in 0..3 {
            let mut leaves = [V::Real::default(); BLOCK];
            // SAFETY: a block is as long as the widest vector; the carry has a second row.
            unsafe {
                self.leaves[c].store(leaves.as_mut_ptr());
                *grid.carry.add(stride + c * plane + self.column - 1) = leaves[end - 1 - self.from];
            }
        }
    }
}
