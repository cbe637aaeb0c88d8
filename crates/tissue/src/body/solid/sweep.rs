//! The sweep over a lattice: evaluates every cube once, row by row, and advances the corners behind it, in place.
//!
//! Row (j, k) of cubes acts on the rows (j, k), (j + 1, k), (j, k + 1) and (j + 1, k + 1) of corners. What the sweep still
//! needs of it waits: for (j + 1, k) in a row, for (j, k + 1) in a plane, for (j + 1, k + 1) in a row that the next row of
//! cubes adds to the plane. When cube row (j, k) is done, all forces on corner row (j, k) are known and nothing reads its
//! displacements again. All of it is kept as even and odd parts along x ([`neo_hookean`](super::neo_hookean)): the force on corner i is
//!
//! (odd − even) of cube i − (even + odd) of cube i − 1,  each the sum (plane + row) + own.
//!
//! A lane's result depends on the same operations in the same order at every width. Blocks of eight columns without a
//! cube are skipped; a cube of weight 0 has a force of 0, so this changes no bit either.
#![allow(unsafe_code)]
// The compiler does not always inline iterators over vectors. They then run without the caller's instructions, ten
// times slower.
#![allow(clippy::needless_range_loop)]

use std::cell::RefCell;
use std::ops::Range;

use glam::DVec3;

use super::neo_hookean::{NeoHookean, Patterns};
use super::places::SolidPlaces;
use crate::kernel::field::{BLOCK, Field, Layout};
use crate::kernel::lanes::{Run, Scalar, Vector};
use crate::kernel::real::Real;
use crate::kernel::region::Region;
use crate::kernel::stage::{ANY, Stage};

/// Columns of which the sweep knows together whether there is a cube.
const GROUP: usize = 8;

/// A group has cubes; or corners alone; or neither.
const CUBES: u8 = 2;
const CORNERS_ALONE: u8 = 1;

/// What acts on the points of a solid besides its cubes: its weight, and a foundation.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PointLoad<T> {
    /// The acceleration by gravity, in the scheme's unit of force divided by mass.
    weight: [T; 3],
    /// The factor of [`SolidPlaces::bed`] to the scheme's stiffness divided by mass.
    foundation: T,
    /// Whether any of them is not 0.
    acts: bool,
}

impl<T: Real> PointLoad<T> {
    /// Creates it with the factors from a stiffness, N/m, and from an acceleration, m/s², to the scheme's units.
    pub(crate) fn new(places: &SolidPlaces, of_stiffness: f64, of_acceleration: f64) -> Self {
        let (weight, foundation) = (of_acceleration * places.pull_m_per_s2, of_stiffness * places.foundation_n_per_m);
        let acts = weight != DVec3::ZERO || foundation != 0.0;
        PointLoad { weight: weight.to_array().map(T::of), foundation: T::of(foundation), acts }
    }

    /// Returns the force along an axis at `x`, for a place with this bed.
    #[inline(always)]
    fn force<V: Vector<Real = T>>(&self, c: usize, bed: V, x: V) -> V {
        x.splat(self.weight[c]).minus(x.splat(self.foundation).mul(bed), x)
    }

    /// Returns the energy of that force, which is 0 at rest.
    #[inline(always)]
    fn energy<V: Vector<Real = T>>(&self, c: usize, bed: V, x: V) -> V {
        let half = x.splat(T::of(0.5)).mul(x.splat(self.foundation).mul(bed));
        x.mul(half.mul(x).sub(x.splat(self.weight[c])))
    }
}

/// The tables of a sweep over a lattice.
#[derive(Debug)]
pub(crate) struct SolidTables<T> {
    /// For each place, the weight of the cube of which it is the least corner: one plane.
    weights: Field<T>,
    /// For each place, 1 divided by its relative mass; 0 where there is no point.
    mobility: Field<T>,
    /// For each place, its relative mass; 0 where there is no point.
    pub(crate) masses: Field<T>,
    /// For each place, [`SolidPlaces::bed`].
    beds: Field<T>,
    /// For each group of columns of each row, what is there.
    groups: Vec<u8>,
    /// The columns of each row that have corners or act on some, in whole blocks.
    spans: Vec<Range<usize>>,
    waiting: RefCell<Field<T>>,
}

impl<T: Real> SolidTables<T> {
    /// Creates the tables of a lattice.
    pub(crate) fn new(places: &SolidPlaces, layout: &Layout) -> Self {
        let mut tables = SolidTables {
            weights: Field::of_length(layout.plane),
            mobility: Field::of_length(layout.plane),
            masses: Field::of_length(layout.plane),
            beds: Field::of_length(layout.plane),
            groups: vec![0; layout.plane.div_ceil(GROUP)],
            spans: vec![0..0; layout.rows],
            waiting: RefCell::new(Field::of_length(6 * (places.rows_per_plane() + 2) * layout.stride + BLOCK)),
        };
        let mut reached = vec![[usize::MAX, 0]; layout.rows];
        for place in 0..places.count() {
            let at = layout.offset(place);
            let (mass, weight) = (places.mass(place), places.weight(place));
            if mass > 0.0 {
                tables.masses[at] = T::of(mass);
                tables.beds[at] = T::of(places.bed(place));
                tables.mobility[at] = T::of(mass.recip());
                tables.groups[at / GROUP] = tables.groups[at / GROUP].max(CORNERS_ALONE);
                let (row, column) = (place / layout.columns, place % layout.columns);
                let [first, end] = &mut reached[row];
                (*first, *end) = ((*first).min(column), (*end).max(column + 1));
            }
            if weight > 0.0 {
                tables.weights[at] = T::of(weight);
                tables.groups[at / GROUP] = CUBES;
            }
        }
        for (span, [first, end]) in tables.spans.iter_mut().zip(reached) {
            if first < end {
                *span = first / BLOCK * BLOCK..end.next_multiple_of(BLOCK);
            }
        }
        tables
    }
}

/// What a sweep reads.
pub(crate) struct SolidGrid<'a, T> {
    pub(crate) layout: Layout,
    pub(crate) places: &'a SolidPlaces,
    pub(crate) tables: &'a SolidTables<T>,
    pub(crate) law: &'a NeoHookean<T>,
    pub(crate) load: &'a PointLoad<T>,
    /// Displacements: three planes, edges of cubes.
    pub(crate) x: *const T,
}

/// A sweep over a lattice, ready to run at any width.
pub(crate) struct SolidSweep<'a, T, S> {
    pub(crate) grid: SolidGrid<'a, T>,
    pub(crate) over: &'a Region,
    pub(crate) stage: S,
}

impl<T: Real, S: Stage<T>> Run<T> for SolidSweep<'_, T, S> {
    #[inline(always)]
    unsafe fn run<V: Vector<Real = T>>(&self) {
        let SolidGrid { layout, places, tables, .. } = &self.grid;
        let rows = places.rows_per_plane();
        let mut waiting = tables.waiting.borrow_mut();
        assert!(waiting.len() == 6 * (rows + 2) * layout.stride + BLOCK && tables.weights.len() == layout.plane);
        waiting.fill(T::default());
        let waiting = waiting.as_mut_ptr();
        let all_awake = self.over.awake.is_full();
        // SAFETY: the caller's promise, and the tables are those of the layout.
        unsafe {
            let mut sums = self.stage.begin::<V>();
            for row in self.over.rows(rows + 1, layout.rows) {
                // `black_box` hides the row from the compiler, which would otherwise keep an address for each array.
                let (j, k) = (std::hint::black_box(row % rows), row / rows);
                self.row::<V>(j, k, waiting, all_awake, &mut sums);
                self.stage.end_row();
            }
            self.stage.end(sums);
        }
    }
}

impl<T: Real, S: Stage<T>> SolidSweep<'_, T, S> {
    /// Returns whether a corner that is awake belongs to one of the cubes of a row between two columns.
    #[inline(always)]
    fn is_needed(&self, row: usize, columns: [usize; 2]) -> bool {
        let Layout { rows, columns: most, .. } = self.grid.layout;
        let per_plane = self.grid.places.rows_per_plane();
        let of_cubes = [row, row + 1, row + per_plane, row + per_plane + 1];
        let is_awake = |row: usize, column: usize| row < rows && column < most && self.over.is_awake(row, column);
        of_cubes.iter().any(|row| columns.iter().any(|column| is_awake(*row, *column)))
    }

    /// Sweeps over row (j, k).
    ///
    /// # Safety
    /// `x` has the layout's planes; `waiting` has 6 rows for each row of a plane and two more.
    #[inline(always)]
    unsafe fn row<V: Vector<Real = T>>(&self, j: usize, k: usize, waiting: *mut T, all_awake: bool, sums: &mut [V; 2]) {
        let SolidGrid { layout: Layout { stride, plane, .. }, places, tables, law, load, x } = self.grid;
        let rows = places.rows_per_plane();
        let (row, layer) = (k * rows + j, stride * rows);
        let at_row = row * stride;
        // SAFETY: the caller's promise.
        unsafe {
            let zero = V::of(T::default());
            let of_plane = waiting.add(6 * j * stride);
            let (of_row, of_corner) = (waiting.add(6 * rows * stride), waiting.add(6 * (rows + 1) * stride));
            let mut before = [zero; 3];
            let span = tables.spans[row].clone();
            let mut column = span.start;
            while column < span.end {
                let is_awake = all_awake || self.over.is_awake(row, column);
                // A force that waits for a sleeping corner is never used, so it need not be right.
                if !all_awake && !self.is_needed(row, [column, column + V::LANES]) {
                    before = [zero; 3];
                    column += V::LANES;
                    continue;
                }
                let at = at_row + column;
                let group = *tables.groups.get_unchecked(at / GROUP);
                let group =
                    if V::LANES > GROUP { group.max(*tables.groups.get_unchecked(at / GROUP + 1)) } else { group };
                let (mut even, mut odd) = ([zero; 3], [zero; 3]);
                for c in 0..3 {
                    let place = 2 * c * stride + column;
                    even[c] = V::load(of_plane.add(place)).add(V::load(of_row.add(place)));
                    odd[c] = V::load(of_plane.add(place + stride)).add(V::load(of_row.add(place + stride)));
                }
                if group == CUBES {
                    let w = V::load(tables.weights.as_ptr().add(at));
                    let mut patterns = Patterns::at_rest(zero);
                    for c in 0..3 {
                        let from = x.add(c * plane + at);
                        let (up, beyond) = (from.add(layer), from.add(1));
                        let far_up = up.add(1);
                        patterns.set(
                            c,
                            [V::load(from), V::load(from.add(stride)), V::load(up), V::load(up.add(stride))],
                            [
                                V::load(beyond),
                                V::load(beyond.add(stride)),
                                V::load(far_up),
                                V::load(far_up.add(stride)),
                            ],
                        );
                    }
                    // The energy of a cube belongs to its least corner.
                    if S::ENERGY && is_awake {
                        self.stage.energy(column, law.energy(w, &patterns));
                    }
                    let stress = law.stress(w, &patterns);
                    for c in 0..3 {
                        let forces = stress.on_rows(&patterns, c);
                        even[c] = even[c].add(forces.even[0]);
                        odd[c] = odd[c].add(forces.odd[0]);
                        let place = 2 * c * stride + column;
                        let corner = of_corner.add(place);
                        forces.even[2].add(V::load(corner)).store(of_plane.add(place));
                        forces.even[3].store(corner);
                        forces.even[1].store(of_row.add(place));
                        let (place, corner) = (place + stride, corner.add(stride));
                        forces.odd[2].add(V::load(corner)).store(of_plane.add(place));
                        forces.odd[3].store(corner);
                        forces.odd[1].store(of_row.add(place));
                    }
                } else {
                    for part in 0..6 {
                        let place = part * stride + column;
                        V::load(of_corner.add(place)).store(of_plane.add(place));
                        zero.store(of_row.add(place));
                        zero.store(of_corner.add(place));
                    }
                }
                if group == 0 {
                    before = [zero; 3];
                    column += V::LANES;
                    continue;
                }
                let mobility = V::load(tables.mobility.as_ptr().add(at));
                let (mut here, mut n) = ([zero; 3], [zero; 3]);
                for c in 0..3 {
                    let passed = even[c].add(odd[c]);
                    n[c] = odd[c].sub(even[c]).sub(passed.shift(before[c])).mul(mobility);
                    before[c] = passed;
                    here[c] = V::load(x.add(c * plane + at));
                }
                if load.acts {
                    let bed = V::load(tables.beds.as_ptr().add(at));
                    // Where there is no point, nothing has a weight.
                    let is_point = mobility.above(zero);
                    let mut energy = zero;
                    for c in 0..3 {
                        n[c] = n[c].add(V::select(is_point, load.force(c, bed, here[c]), zero));
                        if S::ENERGY {
                            energy = energy.add(load.energy(c, bed, here[c]));
                        }
                    }
                    if S::ENERGY && is_awake {
                        self.stage.energy(column, energy.mul(V::load(tables.masses.as_ptr().add(at))));
                    }
                }
                if is_awake {
                    self.stage.finish::<V, ANY>(row, at, here, n, sums);
                }
                column += V::LANES;
            }
        }
    }
}

/// Returns the force on a place divided by its relative mass, with the bits of a sweep.
#[inline(always)]
pub(crate) fn gather<T: Real>(
    places: &SolidPlaces,
    law: &NeoHookean<T>,
    load: &PointLoad<T>,
    layout: &Layout,
    u: &[T],
    place: usize,
) -> [T; 3] {
    let zero = Scalar(T::default());
    // Even and odd parts of the rows (j, k), (j − 1, k), (j, k − 1) and (j − 1, k − 1) of cubes, on the row of the place;
    // first those of the cubes at the place, then those of the cubes before them along x.
    let mut parts = [[[[zero; 4]; 3]; 2]; 2];
    for beside in 0..2 {
        let cubes = places.cubes_around(place, beside);
        for row in 0..4 {
            let Some(cube) = cubes[row] else { continue };
            let corners = places.corners_of(cube);
            let mut offsets = [0; 8];
            for corner in 0..8 {
                offsets[corner] = layout.offset(corners[corner]);
            }
            let mut patterns = Patterns::at_rest(zero);
            for c in 0..3 {
                let (mut near, mut far) = ([zero; 4], [zero; 4]);
                for of_cube in 0..4 {
                    near[of_cube] = Scalar(u[c * layout.plane + offsets[2 * of_cube]]);
                    far[of_cube] = Scalar(u[c * layout.plane + offsets[2 * of_cube + 1]]);
                }
                patterns.set(c, near, far);
            }
            let stress = law.stress(Scalar(T::of(places.weight(cube))), &patterns);
            for c in 0..3 {
                let forces = stress.on_rows(&patterns, c);
                parts[beside][0][c][row] = forces.even[row];
                parts[beside][1][c][row] = forces.odd[row];
            }
        }
    }
    let mobility = if places.mass(place) > 0.0 { Scalar(T::of(places.mass(place).recip())) } else { zero };
    let mut found = [T::default(); 3];
    for c in 0..3 {
        // In the order of the sweep: of the plane before, of the row before, own.
        let mut sums = [[zero; 2]; 2];
        for beside in 0..2 {
            for part in 0..2 {
                let rows = parts[beside][part][c];
                sums[beside][part] = rows[2].add(rows[3]).add(rows[1]).add(rows[0]);
            }
        }
        let [[even, odd], [even_before, odd_before]] = sums;
        let mut force = odd.sub(even).sub(even_before.add(odd_before)).mul(mobility);
        if load.acts && places.mass(place) > 0.0 {
            let x = Scalar(u[c * layout.plane + layout.offset(place)]);
            force = force.add(load.force(c, Scalar(T::of(places.bed(place))), x));
        }
        found[c] = force.0;
    }
    found
}
