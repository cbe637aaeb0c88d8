//! The sweep: one pass over the rows that evaluates every spring once and advances the points behind it, in place.
//!
//! Row i has four springs per point: to the right, and from the pair of points j, j + 1 to the pair below, down and
//! along both diagonals. A spring's force on the row below waits in `carry` until the sweep reaches that row; its force
//! on the next column moves there by a shift of the vector by one lane. When the sweep leaves a block of row i, all
//! forces on it are known and nothing reads its displacement again, so the stage may overwrite it.
//!
//! At column j, with R to the right, D down, A the diagonal from j to j + 1 below, B that from j + 1 to j below:
//!
//! force on j = R + D + A − (what the row above left) + (B − R − A of the row above) of column j − 1;
//! the row leaves D + B, and A.
//!
//! A lane's result depends on the same operations in the same order at every width: the bits are the same.
//!
//! If only part of the sheet is awake (`sleep::tiles`), the sweep covers strips: rectangles of rows and columns
//! that cover the awake part, plus the springs above that its forces need. The stage gets awake blocks only.
//! The springs of the column to the left of a strip are evaluated along the column, a vector of rows at a time
//! ([`Edge`]): a block of columns for each row would cost as much as an awake block. (Bending springs begin two
//! columns to the left and do use that block.)
//!
//! **Small numbers.** Arithmetic below the normal range is tens of times slower, and fields decay in time and
//! space without end. So the sweep stores 0 for a value whose square is below that range; springs with too
//! little strain do not pull (`Real::MIN_EXCESS`); squares are added to a negligible number. Two-step schemes
//! cut only increments: a displacement is their sum, and cutting it as well would take 5 % of a step.
//!
//! **Speed.** Calls that the compiler does not inline lose their caller's vector instructions. Hot code
//! therefore uses no iterators and closures over vectors, which are ten times slower.
#![allow(unsafe_code)]
// The compiler does not always inline iterators over vectors. They then run without the caller's instructions, ten
// times slower.
#![allow(clippy::needless_range_loop)]

use std::ops::Range;

use crate::body::sheet::cuts::{COUNTER_DIAGONAL, DIAGONAL, DOWN, RIGHT, TWO_DOWN, TWO_RIGHT};
use crate::body::sheet::edge::Edge;
use crate::body::sheet::grid::{CARRY_ROWS, Grid, difference, excess, load};
use crate::kernel::field::Layout;
use crate::kernel::lanes::{Run, Vector};
use crate::kernel::real::Real;
use crate::kernel::region::Region;
use crate::kernel::springs::{SpringCoefficients, Springs};
use crate::kernel::stage::{ANY, ROW_LOADED, ROW_UNLOADED, Stage};

/// A sweep, ready to run at any width.
pub(crate) struct Sweep<'a, T, S> {
    pub(crate) grid: Grid<'a, T>,
    pub(crate) over: &'a Region,
    pub(crate) stage: S,
}

impl<T: Real, S: Stage<T>> Run<T> for Sweep<'_, T, S> {
    #[inline(always)]
    unsafe fn run<V: Vector<Real = T>>(&self) {
        // SAFETY: the caller's promise.
        unsafe {
            match &self.grid.springs.bending {
                None => self.rows::<V, false>(&self.grid.springs.structural),
                Some(bending) => self.rows::<V, true>(bending),
            }
        }
    }
}

impl<T: Real, S: Stage<T>> Sweep<'_, T, S> {
    /// # Safety
    /// `x` has 3 planes that can be read a row and a block beyond the last point; `carry` has the layout's size.
    #[inline(always)]
    unsafe fn rows<V: Vector<Real = T>, const BENDING: bool>(&self, bending: &SpringCoefficients<T>) {
        // SAFETY: the caller's promise; offsets stay within rows + 1 rows and a block.
        unsafe {
            let Layout { rows, columns, stride, plane } = self.grid.layout;
            let zero = V::of(T::default());
            let mut sums = self.stage.begin::<V>();
            for strip in &self.over.strips {
                // Include the block to the left, or its last column: its springs pull at the first column.
                let beside = strip.columns.start.saturating_sub(V::LANES);
                let from = if BENDING { beside } else { strip.columns.start };
                let to = strip.columns.end.min(columns.next_multiple_of(V::LANES));
                if strip.rows.start == 0 {
                    for row in 0..if BENDING { CARRY_ROWS } else { 2 } {
                        for c in 0..3 {
                            for column in (beside..to).step_by(V::LANES) {
                                debug_assert!(self.grid.layout.holds(row * stride + column, V::LANES));
                                zero.store(self.grid.carry.add(c * plane + row * stride + column));
                            }
                        }
                    }
                }
                let all = strip.awake && beside == strip.columns.start && to == columns.next_multiple_of(V::LANES);
                let whole = V::IS_REGISTER && all;
                let mut edge =
                    if BENDING || from == 0 { None } else { Some(Edge::new(&self.grid, from, strip.rows.start)) };
                for i in strip.rows.clone() {
                    // `black_box` hides `i` from the compiler, which would otherwise keep an address for each array and
                    // kind of row and increment all of them for each row.
                    let i = std::hint::black_box(i);
                    let left = match &mut edge {
                        Some(edge) => edge.left_of(&self.grid, i),
                        None => [zero; 3],
                    };
                    let span = (from..to, strip.awake && from == strip.columns.start, left);
                    // The two most frequent kinds of rows have loops of their own, without the code that only other rows
                    // need. Each loop is compiled for every scheme, width and number format, which is most of the build's
                    // time. Others gave no time that could be measured: rows with fixed points, rows that are partly
                    // asleep, and springs that bend.
                    let (has_below, duty) = (i + 1 < rows, self.stage.duty(i));
                    let is_cut = !self.grid.cuts.row(i).is_null() || !self.grid.cuts.anchors().is_null();
                    let is_plain = !self.grid.springs.is_tense() && !is_cut;
                    if const { V::IS_REGISTER && !BENDING && !S::ENERGY } && has_below && whole && is_plain {
                        if duty == ROW_UNLOADED {
                            self.row::<V, BENDING, true, true, ROW_UNLOADED>(bending, i, span, &mut sums);
                            continue;
                        }
                        if duty == ROW_LOADED {
                            self.row::<V, BENDING, true, true, ROW_LOADED>(bending, i, span, &mut sums);
                            continue;
                        }
                    }
                    if has_below {
                        self.row::<V, BENDING, true, false, ANY>(bending, i, span, &mut sums);
                    } else {
                        self.row::<V, BENDING, false, false, ANY>(bending, i, span, &mut sums);
                    }
                }
                if let Some(edge) = edge {
                    edge.leave(&self.grid, strip.rows.end);
                }
            }
            self.stage.end(sums);
        }
    }

    /// Sweeps row `i`, which may be the last.
    #[inline(always)]
    unsafe fn row<V: Vector<Real = T>, const BENDING: bool, const BELOW: bool, const WHOLE: bool, const DUTY: u8>(
        &self,
        bending: &SpringCoefficients<T>,
        i: usize,
        (span, all_awake, left): (Range<usize>, bool, [V; 3]),
        sums: &mut [V; 2],
    ) {
        // SAFETY: as for `rows`.
        unsafe {
            let Layout { rows, columns, stride, plane } = self.grid.layout;
            let Springs { structural, shear, .. } = self.grid.springs;
            let is_tense = !WHOLE && self.grid.springs.is_tense();
            let x = self.grid.x.add(i * stride);
            let zero = V::of(T::default());
            let (down, diagonal) = (self.grid.carry, self.grid.carry.add(stride));
            let two_down = self.grid.carry.add((2 + i % 2) * stride);
            // The last point has no spring to the next column.
            let full = zero.first(V::LANES);
            let tail = zero.first((columns - 1) % V::LANES);
            let (mut passed, mut passed_two) = (if WHOLE { [zero; 3] } else { left }, [zero; 3]);
            let span = if WHOLE { 0..columns.next_multiple_of(V::LANES) } else { span };
            // A row with cuts or a pretension is never swept as a whole one.
            let cuts = if WHOLE { std::ptr::null() } else { self.grid.cuts.row(i) };
            let anchors = if WHOLE { std::ptr::null() } else { self.grid.cuts.anchors() };
            let mut column = span.start;
            while column < span.end {
                let mask = if column + V::LANES < columns { full } else { tail };
                let awake = WHOLE || all_awake || self.over.is_awake(i, column);
                // The farthest place read: a row and a point on, or two of each, and the carry's last row.
                debug_assert!(
                    self.grid.layout.holds((i + usize::from(BELOW)) * stride + column + 1, V::LANES)
                        && (!BENDING || self.grid.layout.holds(i * stride + column + 2, V::LANES))
                        && (!BENDING || i + 2 >= rows || self.grid.layout.holds((i + 2) * stride + column, V::LANES))
                        && self.grid.layout.holds((CARRY_ROWS - 1) * stride + column, V::LANES)
                );
                let at = x.add(column);
                let (here, right) = (load::<V>(at, plane), load::<V>(at.add(1), plane));
                let r = difference(&right, &here);
                let qr = excess(r[1], &r, [1, 0, 2]);
                let (mut d, mut a, mut b) = ([zero; 3], [zero; 3], [zero; 3]);
                let (mut qd, mut qa, mut qb) = (zero, zero, zero);
                let (mut wr, mut wd, mut wa, mut wb);
                if BELOW {
                    let (below, beside) = (load(at.add(stride), plane), load(at.add(stride + 1), plane));
                    (d, a, b) = (difference(&below, &here), difference(&beside, &here), difference(&below, &right));
                    qd = excess(d[0], &d, [0, 1, 2]);
                    (qa, qb) = (excess(a[0].add(a[1]), &a, [0, 1, 2]), excess(b[0].sub(b[1]), &b, [0, 1, 2]));
                    let far = structural.is_far(qr.farther(qd));
                    if V::any(V::either(far, shear.is_far(qa.farther(qb)))) {
                        (wr, wd) = (structural.weight(qr).keep(mask), structural.weight(qd));
                        (wa, wb) = (shear.weight(qa).keep(mask), shear.weight(qb).keep(mask));
                    } else {
                        (wr, wd) = (structural.near_of(mask, qr), structural.near(qd));
                        (wa, wb) = (shear.near_of(mask, qa), shear.near_of(mask, qb));
                    }
                } else {
                    (wr, wd, wa, wb) = (structural.weight(qr).keep(mask), zero, zero, zero);
                }
                // The factors of the differences: with a pretension others than those of the rest vectors.
                let (mut gr, mut gd, mut ga, mut gb) = (wr, wd, wa, wb);
                let mut ties = [zero; 4];
                if is_tense {
                    let (along, across) = (zero.splat(structural.tension), zero.splat(shear.tension));
                    ties[RIGHT] = along.keep(mask);
                    if BELOW {
                        (ties[DOWN], ties[DIAGONAL], ties[COUNTER_DIAGONAL]) =
                            (along, across.keep(mask), across.keep(mask));
                    }
                    (gr, gd) = (wr.add(ties[RIGHT]), wd.add(ties[DOWN]));
                    (ga, gb) = (wa.add(ties[DIAGONAL]), wb.add(ties[COUNTER_DIAGONAL]));
                }
                let mut whole = [zero; 4];
                if !WHOLE && !cuts.is_null() {
                    for spring in [RIGHT, DOWN, DIAGONAL, COUNTER_DIAGONAL] {
                        whole[spring] = V::load(cuts.add(spring * stride + column));
                    }
                    (gr, gd) = (gr.mul(whole[RIGHT]), gd.mul(whole[DOWN]));
                    (ga, gb) = (ga.mul(whole[DIAGONAL]), gb.mul(whole[COUNTER_DIAGONAL]));
                    // Of a severed spring the load that held the rest shape is left.
                    let mut weights = [wr, wd, wa, wb];
                    for spring in [RIGHT, DOWN, DIAGONAL, COUNTER_DIAGONAL] {
                        let left = ties[spring].minus(ties[spring], whole[spring]);
                        weights[spring] = weights[spring].mul(whole[spring]).sub(left);
                    }
                    [wr, wd, wa, wb] = weights;
                }
                if S::ENERGY && awake {
                    let mut energies = [structural.energy(qr).keep(mask), zero, zero, zero];
                    if BELOW {
                        let (ea, eb) = (shear.energy(qa).keep(mask), shear.energy(qb).keep(mask));
                        energies = [energies[0], structural.energy(qd), ea, eb];
                    }
                    if is_tense {
                        let half = zero.splat(T::of(0.5));
                        for (spring, delta) in [(RIGHT, &r), (DOWN, &d), (DIAGONAL, &a), (COUNTER_DIAGONAL, &b)] {
                            let squares =
                                delta[2].mul_add(delta[2], delta[1].mul_add(delta[1], delta[0].mul(delta[0])));
                            energies[spring] = half.mul(ties[spring]).mul_add(squares, energies[spring]);
                        }
                    }
                    if !cuts.is_null() {
                        let along = [r[1], d[0], a[0].add(a[1]), b[0].sub(b[1])];
                        for spring in [RIGHT, DOWN, DIAGONAL, COUNTER_DIAGONAL] {
                            let lost = ties[spring].minus(ties[spring], whole[spring]).mul(along[spring]);
                            energies[spring] = energies[spring].mul(whole[spring]).sub(lost);
                        }
                    }
                    let [er, ed, ea, eb] = energies;
                    self.stage.energy(column, er.add(ed).add(ea.add(eb)));
                }
                let mut n = [zero; 3];
                for c in 0..3 {
                    let (down, diagonal) = (down.add(c * plane + column), diagonal.add(c * plane + column));
                    let fr = if c == 1 { gr.mul_add(r[c], wr) } else { gr.mul(r[c]) };
                    if BELOW {
                        let fd = if c == 0 { gd.mul_add(d[c], wd) } else { gd.mul(d[c]) };
                        let fa = if c < 2 { ga.mul_add(a[c], wa) } else { ga.mul(a[c]) };
                        let fb = [gb.mul_add(b[c], wb), gb.mul_sub(b[c], wb), gb.mul(b[c])][c];
                        let across = fb.sub(fr).sub(V::load(diagonal));
                        n[c] = fr.add(fd).add(fa.sub(V::load(down))).add(across.shift(passed[c]));
                        fd.add(fb).store(down);
                        fa.store(diagonal);
                        passed[c] = across;
                    } else {
                        let across = fr.add(V::load(diagonal));
                        n[c] = fr.sub(V::load(down)).sub(across.shift(passed[c]));
                        passed[c] = across;
                    }
                }
                if BENDING {
                    // If the last block has a single column, the block before is not full either.
                    let mask = zero.first(columns.saturating_sub(2 + column));
                    let r = difference(&load(at.add(2), plane), &here);
                    let q = excess(r[1].add(r[1]), &r, [1, 0, 2]);
                    let mut w = bending.weight(q).keep(mask);
                    if !cuts.is_null() {
                        w = w.mul(V::load(cuts.add(TWO_RIGHT * stride + column)));
                    }
                    let two = w.add(w);
                    let fr = [w.mul(r[0]), w.mul_add(r[1], two), w.mul(r[2])];
                    let mut energy = if S::ENERGY { bending.energy(q).keep(mask) } else { zero };
                    if S::ENERGY && !cuts.is_null() {
                        energy = energy.mul(V::load(cuts.add(TWO_RIGHT * stride + column)));
                    }
                    for c in 0..3 {
                        let carried = two_down.add(c * plane + column);
                        n[c] = n[c].add(fr[c].sub(fr[c].shift_two(passed_two[c]))).sub(V::load(carried));
                        passed_two[c] = fr[c];
                    }
                    if i + 2 < rows {
                        let d = difference(&load(at.add(2 * stride), plane), &here);
                        let q = excess(d[0].add(d[0]), &d, [0, 1, 2]);
                        let mut w = bending.weight(q);
                        if !cuts.is_null() {
                            w = w.mul(V::load(cuts.add(TWO_DOWN * stride + column)));
                        }
                        let two = w.add(w);
                        let fd = [w.mul_add(d[0], two), w.mul(d[1]), w.mul(d[2])];
                        for c in 0..3 {
                            n[c] = n[c].add(fd[c]);
                            fd[c].store(two_down.add(c * plane + column));
                        }
                        if S::ENERGY {
                            let mut stored = bending.energy(q);
                            if !cuts.is_null() {
                                stored = stored.mul(V::load(cuts.add(TWO_DOWN * stride + column)));
                            }
                            energy = energy.add(stored);
                        }
                    }
                    if S::ENERGY && awake {
                        self.stage.energy(column, energy);
                    }
                }
                if !WHOLE && !anchors.is_null() {
                    let pull = zero.splat(self.grid.pull).mul(V::load(anchors.add(i * stride + column)));
                    for c in 0..3 {
                        n[c] = n[c].minus(pull, here[c]);
                    }
                }
                if awake {
                    self.stage.finish::<V, DUTY>(i, i * stride + column, here, n, sums);
                }
                column += V::LANES;
            }
            self.stage.end_row();
        }
    }
}
