//! The falloff of a force over a sheet, as a table: e^(−c·r) at each point.
#![allow(unsafe_code)]

use std::ops::Range;

use glam::DVec3;

use crate::kernel::field::{BLOCK, Field, Layout};
use crate::kernel::lanes::{self, Run, Vector, Width};
use crate::kernel::real::Real;
use crate::scene::profile::Poke;

/// The steepest falloff of a table, per spacing: a steeper one does not reach a second point either. It is
/// finite in any format, so that its product with the distance 0 is 0.
const STEEPEST: f64 = 1e30;

/// The points of a sheet: how many along x and along y, and the distance between them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SheetPoints {
    pub(crate) points: [usize; 2],
    pub(crate) spacing_m: f64,
}

impl SheetPoints {
    /// Returns the first and the end of the rows and of the columns within `reach_m` of a control point.
    pub(crate) fn reached(&self, centre_m: DVec3, reach_m: f64) -> [[usize; 2]; 2] {
        std::array::from_fn(|axis| {
            let (centre_m, points) = (centre_m[axis], self.points[axis]);
            // Saturating casts: an infinite reach covers the whole sheet.
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
            let [from, to] =
                [((centre_m - reach_m) / self.spacing_m).ceil(), ((centre_m + reach_m) / self.spacing_m).floor() + 1.0]
                    .map(|edge| (edge.max(0.0) as usize).min(points));
            [from, to.max(from)]
        })
    }

    /// Returns the distance at rest of the point at a place in memory from a control point, m.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn away_m(&self, place: usize, centre_m: DVec3) -> f64 {
        let [i, j] = [place / self.points[1], place % self.points[1]];
        let (x, y) = (i as f64 * self.spacing_m - centre_m.x, j as f64 * self.spacing_m - centre_m.y);
        (x * x + y * y).sqrt()
    }

    /// Writes the falloff of `poke` over some rows and columns, with whole rows in `factors`, and which part of each row
    /// is not 0.
    pub(crate) fn fall_off<T: Real>(
        &self,
        width: Width,
        poke: &Poke,
        layout: &Layout,
        [rows, columns]: [Range<usize>; 2],
        factors: &mut Field<T>,
        spans: &mut Vec<Range<usize>>,
    ) {
        let falloff = Falloff {
            centre: (poke.centre_m.truncate() / self.spacing_m).to_array(),
            per_spacing: (poke.falloff_per_m * self.spacing_m).min(STEEPEST),
            rows,
            columns,
            stride: layout.stride,
            factors: factors.as_mut_ptr(),
        };
        // SAFETY: `factors` has as many rows, each of whole blocks.
        unsafe { lanes::run(width, &falloff) };
        let written = falloff.written(BLOCK);
        spans.clear();
        spans.extend(factors.chunks_exact(layout.stride).map(|row| {
            let counts = |block: &[T]| block.iter().any(|factor| *factor != T::default());
            let mut blocks = row[written.clone()].chunks(BLOCK);
            let place = |block: usize| written.start + block * BLOCK;
            match (blocks.clone().position(counts), blocks.rposition(counts)) {
                (Some(first), Some(last)) => place(first)..place(last + 1),
                _ => 0..0,
            }
        }));
    }
}

/// Fills a table with a falloff.
struct Falloff<T> {
    /// In spacings, from the first point.
    centre: [f64; 2],
    per_spacing: f64,
    rows: Range<usize>,
    columns: Range<usize>,
    stride: usize,
    factors: *mut T,
}

impl<T> Falloff<T> {
    /// Returns the places of a row that are written, in blocks of `length`.
    #[inline(always)]
    fn written(&self, length: usize) -> Range<usize> {
        self.columns.start / length * length..self.columns.end.next_multiple_of(length)
    }
}

impl<T: Real> Run<T> for Falloff<T> {
    #[inline(always)]
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    unsafe fn run<V: Vector<Real = T>>(&self) {
        // SAFETY: the caller's promise.
        unsafe {
            let zero = V::of(T::default());
            let slope = V::of(T::of(-self.per_spacing));
            let farthest = V::of(T::of(-T::NEGLIGIBLE_EXPONENT));
            let [_, centre] = self.centre;
            // Column numbers and the integer part of the centre are exact in any format; only the fraction is rounded.
            let (whole, rest) = (V::of(T::of(centre.floor())), V::of(T::of(centre - centre.floor())));
            for i in self.rows.clone() {
                let x = T::of(i as f64 - self.centre[0]);
                let x = V::of(x * x);
                for at in self.written(V::LANES).step_by(V::LANES) {
                    let y = zero.count(at).sub(whole).sub(rest);
                    let exponent = slope.mul(y.mul_add(y, x).root());
                    let far = exponent.beyond(farthest);
                    let factor = V::select(far, zero, exponential(exponent)).keep(zero.first(self.columns.end - at));
                    // The columns bound the reach more exactly than this format.
                    let factor = V::select(zero.first(self.columns.start.saturating_sub(at)), zero, factor);
                    debug_assert!(at + V::LANES <= self.stride);
                    factor.store(self.factors.add((i - self.rows.start) * self.stride + at));
                }
            }
        }
    }
}

/// Returns e^x for x from [`Real::NEGLIGIBLE_EXPONENT`] to 0, within two units of the last place: 2^k·e^r, |r|
/// ≤ ½ln 2. Unlike the platform's function, it has the same bits on every machine.
#[inline(always)]
fn exponential<V: Vector>(x: V) -> V {
    let of = |value: f64| x.splat(V::Real::of(value));
    // Adding and subtracting a number whose last digit is 1 rounds to an integer.
    let unit = of(V::Real::UNIT);
    let k = x.mul_add(of(std::f64::consts::LOG2_E), unit).sub(unit);
    let [high, low] = V::Real::LN_2;
    let r = x.minus(k, of(high)).minus(k, of(low));
    let mut sum = of(INVERSE_FACTORIALS[V::Real::EXPONENTIAL_DEGREE]);
    for n in (0..V::Real::EXPONENTIAL_DEGREE).rev() {
        sum = sum.mul_add(r, of(INVERSE_FACTORIALS[n]));
    }
    sum.mul(k.power_of_two())
}

/// 1/n!.
const INVERSE_FACTORIALS: [f64; 14] = {
    let mut series = [1.0; 14];
    let mut n = 1;
    while n < series.len() {
        #[allow(clippy::cast_precision_loss)]
        let next = series[n - 1] / n as f64;
        series[n] = next;
        n += 1;
    }
    series
};

#[cfg(test)]
mod tests;
