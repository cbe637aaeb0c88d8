//! The force of a tool over the points: a vector times a falloff. The falloff is a table, computed when the force is
//! placed, and only where it counts; the sweep multiplies. So a changing force costs as little as a constant one, and
//! only a moving force needs new tables.
#![allow(unsafe_code)]
// The compiler does not always inline iterators over vectors. They then run without the caller's instructions, ten
// times slower.
#![allow(clippy::needless_range_loop)]

use std::ops::Range;

use glam::DVec3;

use crate::body::model::Model;
use crate::body::solid::corner_copies::CornerCopies;
use crate::kernel::field::{BLOCK, Field, Layout};
use crate::kernel::lanes::{Vector, Width};
use crate::kernel::real::Real;
use crate::scene::profile::Poke;

/// A change of a tool's force.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ForceChange {
    pub(crate) old: Option<Poke>,
    pub(crate) new: Option<Poke>,
    pub(crate) reached: [[[usize; 2]; 2]; 2],
}

impl ForceChange {
    /// Returns an upper bound of the change of force on any point of a rectangle or box, N. `sides` has its
    /// ends along each axis, m.
    pub(crate) fn most_n(&self, sides: &[[f64; 2]]) -> f64 {
        let nearest = |poke: &Poke| {
            let away = sides.iter().enumerate().map(|(axis, [from, to])| {
                let centre = poke.centre_m[axis];
                (from - centre).max(centre - to).max(0.0)
            });
            let away_m = away.map(|away| away * away).sum::<f64>().sqrt();
            factor_of(poke.falloff_offset - poke.falloff_per_m * away_m)
        };
        let [p, q] = [&self.old, &self.new].map(|poke| poke.as_ref().map_or(0.0, nearest));
        let each = |poke: &Option<Poke>, factor: f64| poke.map_or(0.0, |poke| poke.force_n.length() * factor);
        let both = each(&self.old, p) + each(&self.new, q);
        let Some((old, new)) = self.old.as_ref().zip(self.new.as_ref()) else { return both };
        if !same_falloff(&Poke { centre_m: new.centre_m, ..*old }, new) {
            return both;
        }
        // A moving centre changes the exponent by at most the falloff times the distance.
        let moved = new.falloff_per_m * old.centre_m.distance(new.centre_m);
        both.min((new.force_n - old.force_n).length() * q + old.force_n.length() * moved * p.max(q))
    }

    /// Returns the points that the old force reaches, and those that the new one reaches, along x and along y.
    pub(crate) fn reached(&self) -> [[Range<usize>; 2]; 2] {
        self.reached.map(|sides| sides.map(|[from, to]| from..to))
    }

    /// Returns the new force at its centre, N.
    pub(crate) fn peak_n(&self) -> f64 {
        self.new.map_or(0.0, |poke| poke.force_n.length() * factor_of(poke.falloff_offset))
    }
}

/// Forces with the same falloff: a weighted sum for each of the scheme's fields, N.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct FalloffForces {
    /// Defines the falloff; its force vector is not used.
    pub(crate) poke: Poke,
    pub(crate) forces_n: [DVec3; 3],
}

/// A force over the points: a vector times e^{−c·r}.
#[derive(Debug, Clone)]
pub(crate) struct Term<T: Real> {
    pub(crate) wanted: FalloffForces,
    /// e^{c′}.
    gain: f64,
    /// The force in each of the scheme's fields, in the scheme's units.
    pub(crate) forces: [[T; 3]; 3],
    /// The rows where the force counts.
    pub(crate) rows: Range<usize>,
    columns: Range<usize>,
    /// The columns in each of those rows, in whole blocks.
    pub(crate) spans: Vec<Range<usize>>,
    /// e^{−c·r} divided by the relative mass for those rows, each as long as a row of the layout; 0 elsewhere.
    pub(crate) factors: Field<T>,
}

/// Returns e^x, at most the largest number: a force of 0 may have any factor, and 0 times infinity is NaN.
pub(crate) fn factor_of(exponent: f64) -> f64 {
    libm::exp(exponent).min(f64::MAX)
}

/// Returns whether two forces differ only in the vector.
pub(crate) fn same_falloff(a: &Poke, b: &Poke) -> bool {
    Poke { force_n: b.force_n, point: b.point, ..*a } == *b
}

impl<T: Real> Term<T> {
    pub(crate) fn new() -> Self {
        let poke =
            Poke { point: None, centre_m: DVec3::ZERO, force_n: DVec3::ZERO, falloff_per_m: 0.0, falloff_offset: 0.0 };
        Term {
            wanted: FalloffForces { poke, forces_n: [DVec3::ZERO; 3] },
            gain: 1.0,
            forces: [[T::default(); 3]; 3],
            rows: 0..0,
            columns: 0..0,
            spans: Vec::new(),
            factors: Field::of_length(0),
        }
    }

    /// Writes the falloff of `poke` to the table. Costs as much as the points that the old and the new falloff
    /// reach.
    pub(crate) fn place(&mut self, poke: &Poke, model: &Model, layout: &Layout, copies: Option<&CornerCopies>) {
        // Beyond its spans the table is 0, also where it was longer before.
        for (row, span) in self.factors.chunks_exact_mut(layout.stride).zip(&self.spans) {
            row[span.clone()].fill(T::default());
        }
        [self.rows, self.columns] = model.places.reached::<T>(poke).map(|[from, to]| from..to);
        if let Some(copies) = copies.filter(|_| !self.rows.is_empty()) {
            // Copies are in the last rows.
            self.rows.end = self.rows.end.max(copies.end().div_ceil(layout.columns));
            self.columns = 0..layout.columns.next_multiple_of(BLOCK);
        }
        // `libm` gives the same bits on every machine; the platform's exponential does not.
        self.gain = libm::exp(poke.falloff_offset);
        self.factors.resize(self.rows.len() * layout.stride);
        let points = [self.rows.clone(), self.columns.clone()];
        let (width, spans) = (Width::of(model.lanes), &mut self.spans);
        model.places.fall_off(width, (poke, copies), layout, points, &mut self.factors, spans);
    }

    pub(crate) fn set(&mut self, wanted: FalloffForces, scale: f64) {
        self.forces = wanted.forces_n.map(|force_n| (self.gain * scale * force_n).to_array().map(T::of));
        self.wanted = wanted;
    }

    /// Returns e^{−c·r} divided by the relative mass at a point.
    pub(crate) fn factor(&self, layout: &Layout, [i, j]: [usize; 2]) -> T {
        if self.rows.contains(&i) { self.factors[(i - self.rows.start) * layout.stride + j] } else { T::default() }
    }
}

/// A term in the form that a sweep uses: pointers and numbers that need no checks.
#[derive(Clone, Copy)]
pub(crate) struct Pull<'a, T> {
    /// Where the factors of row 0 would be.
    factors: *const T,
    from: usize,
    to: usize,
    /// First and last place of the table, for debug checks.
    places: [usize; 2],
    spans: &'a [Range<usize>],
    /// Forces of one field and, if there is another, the next.
    forces: [[T; 3]; 2],
}

impl<T: Real> Pull<'_, T> {
    pub(crate) fn none() -> Self {
        Pull { factors: std::ptr::null(), from: 0, to: 0, places: [0; 2], spans: &[], forces: [[T::default(); 3]; 2] }
    }

    /// Returns the factors of a block of one of its rows.
    ///
    /// # Safety
    /// The table belongs to the same tissue as the block and is still alive.
    #[inline(always)]
    unsafe fn factor<V: Vector<Real = T>>(&self, at: usize) -> V {
        debug_assert!(self.places[0] <= at && at + V::LANES <= self.places[1]);
        // SAFETY: the caller's promise.
        unsafe { V::load(self.factors.wrapping_add(at)) }
    }
}

impl<T: Real> Term<T> {
    /// Returns the term for the fields from `field` on.
    pub(crate) fn pull(&self, field: usize, stride: usize) -> Pull<'_, T> {
        let factors = self.factors.as_ptr().wrapping_sub(self.rows.start * stride);
        let forces = [self.forces[field], self.forces[(field + 1).min(2)]];
        Pull {
            factors,
            from: self.rows.start,
            to: self.rows.end,
            places: [self.rows.start, self.rows.end].map(|row| row * stride),
            spans: &self.spans,
            forces,
        }
    }
}

/// Returns whether any force acts on a block of a row that has a force.
#[inline(always)]
pub(crate) fn reaches<T>(pulls: &[Pull<'_, T>], row: usize, column: usize) -> bool {
    match pulls {
        [pull] => pull.spans.get(row.wrapping_sub(pull.from)).is_some_and(|span| span.contains(&column)),
        _ => true,
    }
}

/// Returns the force of one term on a block that it reaches, by component, for `FIELDS` fields; a single field
/// is given twice.
///
/// # Safety
/// The table belongs to the same tissue as the block and is still alive.
#[inline(always)]
pub(crate) unsafe fn force_of<V: Vector, const FIELDS: usize>(pull: &Pull<'_, V::Real>, at: usize) -> [[V; 2]; 3] {
    // SAFETY: the caller's promise.
    let factor = unsafe { pull.factor::<V>(at) };
    let mut forces = [[factor; 2]; 3];
    for c in 0..3 {
        for f in 0..FIELDS {
            forces[c][f] = factor.splat(pull.forces[f][c]).mul(factor);
        }
        if FIELDS == 1 {
            forces[c][1] = forces[c][0];
        }
    }
    forces
}

/// Returns the forces of all terms on a block, by component, for `FIELDS` fields; a single field is given
/// twice.
///
/// # Safety
/// The tables belong to the same tissue as the block and are still alive.
#[inline(always)]
pub(crate) unsafe fn force_on<V: Vector, const FIELDS: usize>(
    pulls: &[Pull<'_, V::Real>],
    row: usize,
    at: usize,
) -> [[V; 2]; 3] {
    // SAFETY: the caller's promise.
    let mut sum = [[unsafe { V::of(V::Real::default()) }; 2]; 3];
    if let [pull] = pulls
        && row >= pull.from
        && row < pull.to
    {
        // SAFETY: the caller's promise.
        return unsafe { force_of::<V, FIELDS>(pull, at) };
    }
    for pull in pulls {
        if row >= pull.from && row < pull.to {
            // SAFETY: the caller's promise.
            let factor = unsafe { pull.factor::<V>(at) };
            for c in 0..3 {
                for f in 0..FIELDS {
                    sum[c][f] = factor.splat(pull.forces[f][c]).mul_add(factor, sum[c][f]);
                }
            }
        }
    }
    if FIELDS == 1 {
        for c in 0..3 {
            sum[c][1] = sum[c][0];
        }
    }
    sum
}

/// Returns the rows on which any force acts.
pub(crate) fn rows<T: Real>(terms: &[Term<T>]) -> Range<usize> {
    let rows = terms.iter().map(|term| term.rows.clone());
    rows.reduce(|a, b| a.start.min(b.start)..a.end.max(b.end)).unwrap_or(0..0)
}

/// Returns e^{−c·r + c′} at a distance, m; 0 where it is negligible.
pub(crate) fn factor(poke: &Poke, away_m: f64, negligible: f64) -> f64 {
    let exponent = -poke.falloff_per_m * away_m;
    if exponent < negligible { 0.0 } else { libm::exp(exponent + poke.falloff_offset) }
}
