//! The sweep over a lattice: evaluates every cube once, row by row, and advances the corners behind it, in place.
//!
//! Row (j, k) of cubes acts on the rows (j, k), (j + 1, k), (j, k + 1) and (j + 1, k + 1) of corners. Forces are kept by
//! sides ([`neo_hookean::CubeSide`](super::neo_hookean::CubeSide)), the corners with one y: with the signs of a lower z they act on row
//! (j, k), with those of a higher one on (j, k + 1). What the sweep still needs waits: the far side of a row of cubes for the next
//! row, and for each row of a plane, even and odd along x, what comes from the plane before. When cube row (j, k) is done, all forces
//! on corner row (j, k) are known, and nothing reads its displacements again. The force on corner i is
//!
//! (odd − even) of cube i − (even + odd) of cube i − 1,  each the part of the plane before + (side, all ∓ with σ_z).
//!
//! A row is three loops: over what each cube pulls with, over the sums of forces, and over the corners that advance. Each is short
//! enough for a processor to work on several blocks at once; one loop was not, and took half as long again.
//!
//! Cubes beside cuts have the weight 0 in their rows. What they pull with is known before the first row ([`CutCubes`]), because the sweep
//! overwrites the displacements of corners that it has done. Copies of corners are in rows of their own, after those of the lattice.
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

use super::corner_copies::{CornerCopies, DoubledCorner};
use super::cut_cubes::{CutCubes, gather_cut};
use super::neo_hookean::{NeoHookean, Patterns, Stress, side};
use super::places::SolidPlaces;
use crate::kernel::field::{BLOCK, Field, Layout};
use crate::kernel::lanes::{Run, Scalar, Vector};
use crate::kernel::real::Real;
use crate::kernel::region::{Region, tile_of};
use crate::kernel::stage::{ANY, Stage};

/// Columns of which the sweep knows together whether there is a cube.
const GROUP: usize = 8;

/// A group has cubes; or corners alone; or neither.
const CUBES: u8 = 2;
const CORNERS_ALONE: u8 = 1;

/// Values of a cube's stress, of a side, and of what waits for a corner of a plane.
const STRESS_VALUES: usize = Stress::<Scalar<f64>>::VECTORS;
const SIDE_VALUES: usize = 12;
const PLANE_VALUES: usize = 6;

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
    /// The tiles that have corners.
    tiles: Vec<usize>,
    /// The cubes beside cuts, once there is one or may be one soon.
    cut: Option<Box<CutCubes<T>>>,
    buffers: RefCell<Buffers<T>>,
}

/// What a sweep keeps for a while, block by block, so that the values of a block lie together and few addresses are computed.
#[derive(Debug)]
struct Buffers<T> {
    /// For each row of a plane, even and odd parts along x of the forces by the plane before; by component.
    planes: Field<T>,
    /// The forces on the far side of the row of cubes before.
    far_side: Field<T>,
    /// The displacements of the far side of the row of cubes before, and the row of corners they are those of.
    shared: Field<T>,
    shared_rows: Vec<usize>,
    /// What the cubes of a row pull with ([`Stress`]); then, in its place, the forces on the corners.
    stresses: Field<T>,
}

impl<T: Real> Buffers<T> {
    fn new(places: &SolidPlaces, layout: &Layout) -> Self {
        let of = |values: usize| Field::of_length(values * layout.stride + BLOCK);
        Buffers {
            planes: of(PLANE_VALUES * places.rows_per_plane()),
            far_side: of(SIDE_VALUES),
            shared: of(SIDE_VALUES),
            shared_rows: vec![usize::MAX; layout.stride],
            stresses: of(STRESS_VALUES),
        }
    }

    /// Makes them ready for a sweep: nothing acts yet, and nothing is known.
    fn clear(&mut self) {
        self.planes.fill(T::default());
        self.far_side.fill(T::default());
        self.shared_rows.fill(usize::MAX);
    }
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
            tiles: Vec::new(),
            cut: None,
            buffers: RefCell::new(Buffers::new(places, layout)),
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
        let with_mass = (0..places.count()).filter(|place| places.mass(*place) > 0.0);
        tables.tiles =
            with_mass.map(|place| tile_of(layout, [place / layout.columns, place % layout.columns])).collect();
        tables.tiles.sort_unstable();
        tables.tiles.dedup();
        tables
    }

    /// Makes the tables those of a solid with these copies of corners.
    pub(crate) fn follow(&mut self, places: &SolidPlaces, layout: &Layout, copies: Option<&CornerCopies>) {
        if self.cut.as_ref().is_some_and(|cut| !cut.is_empty()) {
            *self = SolidTables::new(places, layout);
        }
        let Some(copies) = copies else { return };
        for number in 0..copies.cubes().len() {
            self.take_out(places, layout, copies, number);
        }
        let corners: Vec<usize> = copies.places().map(|place| copies.corner_of(place)).collect();
        for place in corners.into_iter().chain(copies.places()) {
            self.weigh(places, layout, copies, place);
        }
    }

    /// Takes the copy of a corner into the tables.
    pub(crate) fn double(
        &mut self,
        places: &SolidPlaces,
        layout: &Layout,
        copies: &CornerCopies,
        doubled: &DoubledCorner,
    ) {
        for cube in doubled.cubes(places) {
            if let Some(number) = copies.number_of(cube) {
                self.take_out(places, layout, copies, number);
            }
        }
        for place in [doubled.from, doubled.to] {
            self.weigh(places, layout, copies, place);
        }
    }

    /// Makes room for cubes beside cuts, which the first cut then need not do.
    pub(crate) fn prepare_to_cut(&mut self, layout: &Layout) -> &mut CutCubes<T> {
        self.cut.get_or_insert_with(|| Box::new(CutCubes::none(layout)))
    }

    /// Takes a cube out of its row.
    fn take_out(&mut self, places: &SolidPlaces, layout: &Layout, copies: &CornerCopies, number: usize) {
        self.prepare_to_cut(layout).set(places, layout, copies, number);
        self.weights[layout.offset(copies.cubes()[number].cube as usize)] = T::default();
    }

    /// Returns where the corners of the cube beside cuts of a number are in a plane of a field.
    #[inline]
    pub(crate) fn cut_offsets(&self, number: usize) -> Option<[usize; 8]> {
        self.cut.as_ref().map(|cut| cut.offsets_of(number))
    }

    /// Sets the mass of a corner or a copy.
    fn weigh(&mut self, places: &SolidPlaces, layout: &Layout, copies: &CornerCopies, place: usize) {
        let (at, mass) = (layout.offset(place), copies.mass(places, place));
        self.masses[at] = T::of(mass);
        self.mobility[at] = T::of(mass.recip());
        self.beds[at] = T::of(places.bed(copies.corner_of(place)));
        self.groups[at / GROUP] = self.groups[at / GROUP].max(CORNERS_ALONE);
        let (span, column) = (&mut self.spans[place / layout.columns], place % layout.columns);
        let block = column / BLOCK * BLOCK;
        *span = if span.start == span.end {
            block..block + BLOCK
        } else {
            span.start.min(block)..span.end.max(block + BLOCK)
        };
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
        let mut buffers = tables.buffers.borrow_mut();
        assert!(buffers.planes.len() == PLANE_VALUES * rows * layout.stride + BLOCK);
        assert!(
            buffers.stresses.len() == STRESS_VALUES * layout.stride + BLOCK && tables.weights.len() == layout.plane
        );
        buffers.clear();
        // Tiles without corners never wake by themselves.
        let all_awake = tables.tiles.iter().all(|tile| self.over.awake.has[*tile]);
        // SAFETY: the caller's promise, and the tables are those of the layout.
        unsafe {
            let mut sums = self.stage.begin::<V>();
            if let Some(cut) = tables.cut.as_ref().filter(|cut| !cut.is_empty()) {
                cut.pull::<V, S>(layout, self.grid.law, self.grid.x, self.over, &self.stage);
            }
            for row in self.over.rows(rows + 1, layout.rows) {
                // `black_box` hides the row from the compiler, which would otherwise keep an address for each array.
                let place = [std::hint::black_box(row % rows), row / rows];
                if row < places.corner_rows() {
                    self.compute_stresses::<V>(place, &mut buffers, all_awake);
                    self.add_up::<V>(place, &mut buffers, all_awake);
                }
                self.hand_over::<V>(place, &buffers, all_awake, &mut sums);
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

    /// Returns what the block of a row at a column has; `None` if it is not needed. A force that waits for a sleeping corner is
    /// never used, so it need not be right.
    #[inline(always)]
    fn needed<V: Vector<Real = T>>(&self, row: usize, column: usize, all_awake: bool) -> Option<u8> {
        let is_needed = all_awake || self.is_needed(row, [column, column + V::LANES]);
        is_needed.then(|| self.content::<V>(row, column))
    }

    /// Returns what the block of a row at a column has.
    #[inline(always)]
    fn content<V: Vector<Real = T>>(&self, row: usize, column: usize) -> u8 {
        let (groups, at) = (&self.grid.tables.groups, (row * self.grid.layout.stride + column) / GROUP);
        // SAFETY: a column of a row is in the plane, in whole blocks.
        let group = |at: usize| unsafe { *groups.get_unchecked(at) };
        if V::LANES > GROUP { group(at).max(group(at + 1)) } else { group(at) }
    }

    /// Computes the stresses of row (j, k) of cubes.
    ///
    /// # Safety
    /// `x` has the layout's planes, and the buffers are those of the layout.
    #[inline(always)]
    unsafe fn compute_stresses<V: Vector<Real = T>>(
        &self,
        [j, k]: [usize; 2],
        buffers: &mut Buffers<T>,
        all_awake: bool,
    ) {
        let SolidGrid { layout: Layout { stride, plane, .. }, places, tables, law, x, .. } = self.grid;
        let rows = places.rows_per_plane();
        let (row, layer) = (k * rows + j, stride * rows);
        let (stresses, shared) = (buffers.stresses.as_mut_ptr(), buffers.shared.as_mut_ptr());
        // SAFETY: the caller's promise.
        unsafe {
            let zero = V::of(T::default());
            let span = tables.spans[row].clone();
            let mut column = span.start;
            while column < span.end {
                if self.needed::<V>(row, column, all_awake) == Some(CUBES) {
                    let at = row * stride + column;
                    let (mut near, mut far) = ([[zero; 4]; 3], [[zero; 4]; 3]);
                    let of_block = shared.add(SIDE_VALUES * column);
                    let is_known = *buffers.shared_rows.get_unchecked(column) == row;
                    let side_at = |from: *const T| {
                        let corners = |from: *const T| [V::load(from), V::load(from.add(1))];
                        side(corners(from), corners(from.add(layer)))
                    };
                    for c in 0..3 {
                        let of_component = of_block.add(4 * c * V::LANES);
                        let from = x.add(c * plane + at);
                        if is_known {
                            for part in 0..4 {
                                near[c][part] = V::load(of_component.add(part * V::LANES));
                            }
                        } else {
                            near[c] = side_at(from);
                        }
                        far[c] = side_at(from.add(stride));
                        for part in 0..4 {
                            far[c][part].store(of_component.add(part * V::LANES));
                        }
                    }
                    *buffers.shared_rows.get_unchecked_mut(column) = row + 1;
                    let (w, patterns) = (V::load(tables.weights.as_ptr().add(at)), Patterns::between(&near, &far));
                    let stresses = stresses.add(STRESS_VALUES * column);
                    patterns.store_hourglasses(stresses);
                    // The energy of a cube belongs to its least corner.
                    if S::ENERGY && (all_awake || self.over.is_awake(row, column)) {
                        self.stage.energy(column, law.energy(w, &patterns));
                    }
                    law.stress(w, &patterns).store(stresses);
                }
                column += V::LANES;
            }
        }
    }

    /// Adds up the forces on row (j, k) of corners, and writes them in place of the stresses.
    ///
    /// # Safety
    /// The buffers are those of the layout, with the stresses of the row.
    #[inline(always)]
    unsafe fn add_up<V: Vector<Real = T>>(&self, [j, k]: [usize; 2], buffers: &mut Buffers<T>, all_awake: bool) {
        let SolidGrid { layout: Layout { stride, .. }, places, tables, .. } = self.grid;
        let row = k * places.rows_per_plane() + j;
        let (planes, far_side) = (buffers.planes.as_mut_ptr(), buffers.far_side.as_mut_ptr());
        let stresses = buffers.stresses.as_mut_ptr();
        // SAFETY: the caller's promise.
        unsafe {
            let zero = V::of(T::default());
            let mut before = [zero; 3];
            let span = tables.spans[row].clone();
            let mut column = span.start;
            while column < span.end {
                let Some(group) = self.needed::<V>(row, column, all_awake) else {
                    before = [zero; 3];
                    column += V::LANES;
                    continue;
                };
                let of_plane = planes.add(PLANE_VALUES * (j * stride + column));
                let (of_side, of_block) = (far_side.add(SIDE_VALUES * column), stresses.add(STRESS_VALUES * column));
                let mut on_side = [[zero; 4]; 3];
                for c in 0..3 {
                    for part in 0..4 {
                        on_side[c][part] = V::load(of_side.add((4 * c + part) * V::LANES));
                    }
                }
                if group == CUBES {
                    let stress = Stress::<V>::load(of_block);
                    for c in 0..3 {
                        on_side[c] = stress.on_near_side(c, on_side[c]);
                        let on_far_side = stress.on_far_side(c);
                        for part in 0..4 {
                            on_far_side[part].store(of_side.add((4 * c + part) * V::LANES));
                        }
                    }
                } else {
                    for part in 0..SIDE_VALUES {
                        zero.store(of_side.add(part * V::LANES));
                    }
                }
                for c in 0..3 {
                    let [all, z, x, xz] = on_side[c];
                    let (of_even, of_odd) = (of_plane.add(2 * c * V::LANES), of_plane.add((2 * c + 1) * V::LANES));
                    let (even, odd) = (V::load(of_even).add(all.sub(z)), V::load(of_odd).add(x.sub(xz)));
                    all.add(z).store(of_even);
                    x.add(xz).store(of_odd);
                    let passed = even.add(odd);
                    odd.sub(even).sub(passed.shift(before[c])).store(of_block.add(c * V::LANES));
                    before[c] = passed;
                }
                if group == 0 {
                    before = [zero; 3];
                }
                column += V::LANES;
            }
        }
    }

    /// Hands row (j, k) of corners to the stage, with the forces that [`SolidSweep::add_up`] wrote.
    ///
    /// # Safety
    /// `x` has the layout's planes, and the buffers have the forces of the row.
    #[inline(always)]
    unsafe fn hand_over<V: Vector<Real = T>>(
        &self,
        [j, k]: [usize; 2],
        buffers: &Buffers<T>,
        all_awake: bool,
        sums: &mut [V; 2],
    ) {
        let SolidGrid { layout: ref layout @ Layout { stride, plane, .. }, places, tables, load, x, .. } = self.grid;
        let (row, forces) = (k * places.rows_per_plane() + j, buffers.stresses.as_ptr());
        let is_of_lattice = row < places.corner_rows();
        // SAFETY: the caller's promise.
        unsafe {
            let zero = V::of(T::default());
            let span = tables.spans[row].clone();
            let mut column = span.start;
            while column < span.end {
                let is_awake = all_awake || self.over.is_awake(row, column);
                if is_awake && self.content::<V>(row, column) != 0 {
                    let at = row * stride + column;
                    let mobility = V::load(tables.mobility.as_ptr().add(at));
                    let (mut here, mut n) = ([zero; 3], [zero; 3]);
                    let of_cut = if let Some(cut) = &tables.cut { cut.forces_at::<V>(layout, row, at) } else { None };
                    for c in 0..3 {
                        if is_of_lattice {
                            n[c] = V::load(forces.add(STRESS_VALUES * column + c * V::LANES));
                        }
                        if let Some(of_cut) = of_cut {
                            n[c] = n[c].add(of_cut[c]);
                        }
                        n[c] = n[c].mul(mobility);
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
                        if S::ENERGY {
                            self.stage.energy(column, energy.mul(V::load(tables.masses.as_ptr().add(at))));
                        }
                    }
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
    copies: Option<&CornerCopies>,
    law: &NeoHookean<T>,
    load: &PointLoad<T>,
    layout: &Layout,
    u: &[T],
    place: usize,
) -> [T; 3] {
    let zero = Scalar(T::default());
    // The forces on the side of the place: by the cubes at it and by those before along x; with the same z, and before along z.
    let mut sides = [[[[zero; 4]; 3]; 2]; 2];
    for beside in 0..2 {
        let stress = places.cubes_around(place, beside).map(|cube| {
            cube.map(|cube| {
                let corners = places.offsets_of(layout, cube);
                let patterns =
                    Patterns::of_corners(&corners.map(|at| [0, 1, 2].map(|c| Scalar(u[c * layout.plane + at]))));
                let is_cut = copies.is_some_and(|copies| copies.number_of(cube).is_some());
                law.stress(if is_cut { zero } else { Scalar(T::of(places.weight(cube))) }, &patterns)
            })
        });
        for below in 0..2 {
            for c in 0..3 {
                // In the order of the sweep: the far side of the row before, then the near side.
                let far = stress[2 * below + 1].as_ref().map_or([zero; 4], |stress| stress.on_far_side(c));
                let near = stress[2 * below].as_ref();
                sides[beside][below][c] = near.map_or(far, |stress| stress.on_near_side(c, far));
            }
        }
    }
    let mass = copies.map_or(places.mass(place), |copies| copies.mass(places, place));
    let mobility = if mass > 0.0 { Scalar(T::of(mass.recip())) } else { zero };
    let of_cut = copies.map(|copies| gather_cut(places, copies, law, layout, u, place));
    let bed = places.bed(copies.map_or(place, |copies| copies.corner_of(place)));
    let mut found = [T::default(); 3];
    for c in 0..3 {
        let [[even, odd], [even_before, odd_before]] = [0, 1].map(|beside| {
            let [[all, z, x, xz], [all_below, z_below, x_below, xz_below]] =
                [0, 1].map(|below| sides[beside][below][c]);
            [all_below.add(z_below).add(all.sub(z)), x_below.add(xz_below).add(x.sub(xz))]
        });
        let mut force = odd.sub(even).sub(even_before.add(odd_before));
        if let Some(of_cut) = of_cut {
            force = force.add(Scalar(of_cut[c]));
        }
        force = force.mul(mobility);
        if load.acts && mass > 0.0 {
            let x = Scalar(u[c * layout.plane + layout.offset(place)]);
            force = force.add(load.force(c, Scalar(T::of(bed)), x));
        }
        found[c] = force.0;
    }
    found
}
