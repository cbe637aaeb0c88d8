//! The sweep over a mesh: evaluates every spring from both ends and advances the points, block by block.
//!
//! With D0 the rest vector of a spring, Δ = u_other − u_own and e = D0 + Δ: Q = Δ·(D0 + e), q = Q/L0², and the force on
//! this end is stiffness·weight(q)·e, with the weight of `springs` for a rest length of 1. Small numbers are treated as
//! there.
//!
//! **Large strains.** The polynomial is valid up to |q| = 1/8. A block is first computed as if it were valid
//! everywhere, while the largest q² is kept, which costs one operation per spring and no branch. If a spring is
//! beyond, the block is computed again with the form that is valid for each lane.
#![allow(unsafe_code)]
// The compiler does not always inline iterators over vectors. They then run without the caller's instructions, ten
// times slower.
#![allow(clippy::needless_range_loop)]

use std::cell::RefCell;

use super::order::{TABLES, TILE_SLOTS};
use super::pack::{Arrangement, COEFFICIENTS, Halo, MeshSprings, ONE_AND_A_HALF, Part, Rows, coefficients};
use super::slots::MeshSlots;
use crate::body::sheet::grid::load;
use crate::kernel::field::{BLOCK, Field, Layout};
use crate::kernel::lanes::{LaneShape, Names, Run, Scalar, Vector, record_place};
use crate::kernel::real::Real;
use crate::kernel::region::Region;
use crate::kernel::springs::SpringCoefficients;
use crate::kernel::stage::{ANY, ROW_LOADED, ROW_UNLOADED, Stage};
use crate::memory;

/// Bytes of a cache line.
const LINE: usize = 64;

/// How far ahead coefficients are prefetched, bytes: about two blocks. (Measured: saves a tenth at 10,000
/// points.)
const AHEAD: usize = 4096;

/// What a sweep reads, and where it keeps its snapshot of the displacements.
pub(crate) struct MeshGrid<'a, T> {
    pub(crate) layout: Layout,
    pub(crate) slots: &'a MeshSlots,
    pub(crate) springs: &'a MeshSprings<T>,
    /// A spring of length 1, whose stiffness is the factor from N/m, divided by the reference mass, to the
    /// scheme's units.
    pub(crate) unit: &'a SpringCoefficients<T>,
    /// a = K″·dt²/m in the scheme's units of force: the factor of the extra anchor stiffness.
    pub(crate) pull: T,
    /// The pressure: a factor and three planes, whose product is subtracted from the force divided by the
    /// relative mass. The planes are null without a volume.
    pub(crate) push: (T, *const T),
    /// Displacements: three planes, spacings.
    pub(crate) x: *const T,
    /// Memory of this mesh's size.
    pub(crate) snapshot: &'a RefCell<Snapshot<T>>,
}

/// Memory for the displacements before a sweep. Nothing in it is kept from one sweep to the next.
#[derive(Debug)]
pub(crate) struct Snapshot<T> {
    /// A record for each slot.
    records: Field<T>,
    /// For each tile, whether this sweep has copied it.
    copied: Vec<bool>,
}

impl<T: Real> Snapshot<T> {
    /// Allocates a snapshot for a mesh.
    pub(crate) fn of(slots: &MeshSlots) -> Self {
        let records = Field::of_length(record_place(slots.vertex_of().len()));
        Snapshot { records, copied: memory::filled(slots.tiles(), false, TABLES) }
    }

    /// Overwrites the values, which no sweep may need.
    #[cfg(test)]
    pub(super) fn fill(&mut self, value: T) {
        self.records.fill(value);
    }
}

/// A sweep over a mesh, ready to run at the width that its springs are arranged for.
pub(crate) struct MeshSweep<'a, T, S> {
    pub(crate) grid: MeshGrid<'a, T>,
    pub(crate) over: &'a Region,
    pub(crate) stage: S,
}

/// What a sweep uses in its inner loop. The compiler keeps values in registers if it knows that no store
/// changes them: so the numbers are copies.
struct AtHand<T> {
    unit: SpringCoefficients<T>,
    pull: T,
    /// The pressure, as in [`MeshGrid`].
    push: T,
    areas: *const T,
    plane: usize,
    /// What is left of severed springs ([`MeshSprings::loads`]); null if nothing is.
    loads: *const T,
    /// Values of the slots, null if all are the same ([`MeshSprings`]).
    extra: *const T,
    masses: *const T,
}

/// The sums over the springs of a vector of slots.
struct Sum<V> {
    force: [V; 3],
    /// The largest q².
    farthest: V,
    /// The energies of the springs divided by the relative mass of this end, each spring whole.
    energy: V,
}

impl<T: Real, S: Stage<T>> Run<T> for MeshSweep<'_, T, S> {
    #[inline(always)]
    unsafe fn run<V: Vector<Real = T>>(&self) {
        let MeshGrid { layout, slots, springs, unit, pull, push, snapshot, .. } = &self.grid;
        let mut snapshot = snapshot.borrow_mut();
        let Snapshot { records, copied } = &mut *snapshot;
        copied.fill(false);
        let slot_count = layout.rows * BLOCK;
        assert!(springs.shape == LaneShape::of::<V>() && springs.slots == slot_count && slots.blocks() == layout.rows);
        assert!(records.len() == record_place(slot_count) && copied.len() == slots.tiles());
        let of = |field: &Option<Field<T>>| field.as_ref().map_or(std::ptr::null(), |field| field.as_ptr());
        let ((push, areas), plane) = (*push, layout.plane);
        let (extra, masses, loads) = (of(&springs.extra), of(&springs.masses), of(&springs.loads));
        let at_hand = AtHand { unit: **unit, pull: *pull, push, areas, plane, loads, extra, masses };
        let records = records.as_mut_ptr();
        // SAFETY: the caller's promise, and the springs and records are those of the slots.
        unsafe {
            let mut sums = self.stage.begin::<V>();
            // Each width uses one arrangement, and needs no code for the other.
            match &springs.arrangement {
                Arrangement::Rows(rows) if !V::PICKS => {
                    self.tiles::<V>(&ByRows::of(rows, records), &at_hand, (records, copied), &mut sums);
                }
                Arrangement::Halo(halo) if V::PICKS => {
                    self.tiles::<V>(&ByHalo::of(halo, records), &at_hand, (records, copied), &mut sums);
                }
                _ => debug_assert!(false, "springs arranged for another width"),
            }
            self.stage.end(sums);
        }
    }
}

impl<T: Real, S: Stage<T>> MeshSweep<'_, T, S> {
    /// Copies the displacements of a tile to the records, if this sweep has not yet done so.
    #[inline(always)]
    unsafe fn copy_tile<V: Vector<Real = T>>(&self, tile: usize, (records, copied): (*mut T, &mut [bool])) {
        if std::mem::replace(&mut copied[tile], true) {
            return;
        }
        let MeshGrid { layout, x, .. } = self.grid;
        let end = ((tile + 1) * TILE_SLOTS).min(layout.rows * BLOCK);
        for slot in (tile * TILE_SLOTS..end).step_by(V::LANES) {
            // SAFETY: the caller's promise.
            unsafe { V::store_records(load::<V>(x.add(slot), layout.plane), records, slot) };
        }
    }

    /// Sweeps over the awake tiles.
    #[inline(always)]
    unsafe fn tiles<V: Vector<Real = T>>(
        &self,
        gather: &impl Gather<V>,
        at_hand: &AtHand<T>,
        (records, copied): (*mut T, &mut [bool]),
        sums: &mut [V; 2],
    ) {
        let MeshGrid { layout: Layout { rows, plane, .. }, slots, x, .. } = self.grid;
        for &tile in self.over.tiles() {
            // Copies as late as possible, while the values are still in the cache.
            // SAFETY: the caller's promise.
            unsafe {
                self.copy_tile::<V>(tile, (records, &mut *copied));
                for beside in slots.neighbours(tile) {
                    self.copy_tile::<V>(*beside as usize, (records, &mut *copied));
                }
            }
            for row in tile * TILE_SLOTS / BLOCK..((tile + 1) * TILE_SLOTS / BLOCK).min(rows) {
                let duty = self.stage.duty(row);
                for column in (0..BLOCK).step_by(V::LANES) {
                    let at = row * BLOCK + column;
                    // SAFETY: the caller's promise; all slots of a row are in the layout.
                    unsafe {
                        let x = load::<V>(x.add(at), plane);
                        let n = self.force(gather, at_hand, at, &x);
                        if const { S::ENERGY || !V::IS_REGISTER || size_of::<T>() > size_of::<f32>() } {
                            self.stage.finish::<V, ANY>(row, at, x, n, sums);
                            continue;
                        }
                        match duty {
                            ROW_UNLOADED => self.stage.finish::<V, ROW_UNLOADED>(row, at, x, n, sums),
                            ROW_LOADED => self.stage.finish::<V, ROW_LOADED>(row, at, x, n, sums),
                            _ => self.stage.finish::<V, ANY>(row, at, x, n, sums),
                        }
                    }
                }
                // SAFETY: the caller's promise.
                unsafe { self.stage.end_row() };
            }
        }
    }

    /// Returns the force of the springs, of the extra anchor stiffness and of the pressure on the slots from
    /// `at` on.
    #[inline(always)]
    unsafe fn force<V: Vector<Real = T>>(
        &self,
        gather: &impl Gather<V>,
        at_hand: &AtHand<T>,
        at: usize,
        x: &[V; 3],
    ) -> [V; 3] {
        let unit = &at_hand.unit;
        // SAFETY: the caller's promise.
        unsafe {
            let mut sum = if S::ENERGY {
                gather.sum::<false, true>(&at_hand.unit, at, x)
            } else {
                gather.sum::<true, false>(&at_hand.unit, at, x)
            };
            if !S::ENERGY && V::any(unit.is_square_far(sum.farthest)) {
                sum = gather.sum::<false, false>(&at_hand.unit, at, x);
            }
            if !at_hand.extra.is_null() {
                let pull = x[0].splat(at_hand.pull).mul(V::load(at_hand.extra.add(at)));
                for c in 0..3 {
                    sum.force[c] = sum.force[c].minus(pull, x[c]);
                }
            }
            if !at_hand.areas.is_null() {
                let push = x[0].splat(at_hand.push);
                for c in 0..3 {
                    sum.force[c] = sum.force[c].minus(push, V::load(at_hand.areas.add(c * at_hand.plane + at)));
                }
            }
            if !at_hand.loads.is_null() {
                let tension = x[0].splat(unit.tension);
                for c in 0..3 {
                    let load = V::load(at_hand.loads.add(c * at_hand.plane + at));
                    sum.force[c] = sum.force[c].minus(tension, load);
                    if S::ENERGY {
                        // All of it belongs to this end.
                        let stored = tension.mul(load).mul(x[c]);
                        sum.energy = sum.energy.add(stored.add(stored));
                    }
                }
            }
            if S::ENERGY {
                // Half of each spring belongs to each end.
                let mut part = x[0].splat(T::of(0.5));
                if !at_hand.masses.is_null() {
                    part = part.mul(V::load(at_hand.masses.add(at)));
                }
                self.stage.energy(at % BLOCK, sum.energy.mul(part));
            }
            sum.force
        }
    }
}

/// An arrangement of springs that can be summed for a vector of slots.
trait Gather<V: Vector> {
    /// Sums the springs of the slots from `at` on. With `NEAR` the result is valid if no |q| is too large.
    ///
    /// # Safety
    /// The records have been written, and belong to the same mesh.
    unsafe fn sum<const NEAR: bool, const ENERGY: bool>(
        &self,
        unit: &SpringCoefficients<V::Real>,
        at: usize,
        own: &[V; 3],
    ) -> Sum<V>;
}

/// Pointers to the tables of [`Rows`].
struct ByRows<T> {
    records: *const T,
    firsts: *const u32,
    places: *const u32,
    coefficients: *const T,
}

impl<T: Real> ByRows<T> {
    fn of(rows: &Rows<T>, records: *const T) -> Self {
        let Rows { firsts, places, coefficients } = rows;
        ByRows { records, firsts: firsts.as_ptr(), places: places.as_ptr(), coefficients: coefficients.as_ptr() }
    }
}

impl<V: Vector> Gather<V> for ByRows<V::Real> {
    #[inline(always)]
    unsafe fn sum<const NEAR: bool, const ENERGY: bool>(
        &self,
        unit: &SpringCoefficients<V::Real>,
        at: usize,
        own: &[V; 3],
    ) -> Sum<V> {
        let mut sum = Sum::zero(own);
        // SAFETY: each vector of slots has rows, and each row places and coefficients.
        unsafe {
            let first = self.firsts.add(at / V::LANES);
            let rows = [*first as usize, *first.add(1) as usize];
            let ends = Anywhere { records: self.records, places: self.places };
            sum_rows::<V, NEAR, ENERGY>(unit, rows, &ends, self.coefficients, own, &mut sum);
        }
        sum
    }
}

/// Pointers to the tables of [`Halo`].
struct ByHalo<T> {
    records: *const T,
    firsts: *const u32,
    parts: *const Part,
    places: *const u32,
    others: *const Names,
    coefficients: *const T,
    owners: *const Names,
    passes: *const u8,
    returns: *const Names,
}

impl<T: Real> ByHalo<T> {
    fn of(halo: &Halo<T>, records: *const T) -> Self {
        ByHalo {
            records,
            firsts: halo.firsts.as_ptr(),
            parts: halo.parts.as_ptr(),
            places: halo.places.as_ptr(),
            others: halo.others.as_ptr(),
            coefficients: halo.coefficients.as_ptr(),
            owners: halo.owners.as_ptr(),
            passes: halo.passes.as_ptr(),
            returns: halo.returns.as_ptr(),
        }
    }
}

impl<V: Vector> Gather<V> for ByHalo<V::Real> {
    #[inline(always)]
    unsafe fn sum<const NEAR: bool, const ENERGY: bool>(
        &self,
        unit: &SpringCoefficients<V::Real>,
        at: usize,
        own: &[V; 3],
    ) -> Sum<V> {
        let mut sum = Sum::zero(own);
        // SAFETY: each block has parts, and each part places for its vectors.
        unsafe {
            let first = self.firsts.add(at / BLOCK);
            let (mut number, end) = (*first as usize, *first.add(1) as usize);
            while number < end {
                let part = &*self.parts.add(number);
                let places = self.places.add(part.place as usize);
                let first = V::records(self.records, places);
                if part.halves < ONE_AND_A_HALF {
                    self.part::<V, 1, NEAR, ENERGY>(unit, part, own, &[first], &mut sum);
                } else if part.halves == ONE_AND_A_HALF {
                    let second = V::half_of_records(self.records, places.add(BLOCK));
                    self.part::<V, 2, NEAR, ENERGY>(unit, part, own, &[first, second], &mut sum);
                } else {
                    let second = V::records(self.records, places.add(BLOCK));
                    if part.halves == 4 {
                        self.part::<V, 2, NEAR, ENERGY>(unit, part, own, &[first, second], &mut sum);
                    } else {
                        let third = V::records(self.records, places.add(2 * BLOCK));
                        self.part::<V, 3, NEAR, ENERGY>(unit, part, own, &[first, second, third], &mut sum);
                    }
                }
                number += 1;
            }
        }
        sum
    }
}

impl<T: Real> ByHalo<T> {
    /// Adds the springs of a part, given its halo.
    #[inline(always)]
    unsafe fn part<V: Vector<Real = T>, const G: usize, const NEAR: bool, const ENERGY: bool>(
        &self,
        unit: &SpringCoefficients<T>,
        part: &Part,
        own: &[V; 3],
        around: &[[V; 3]; G],
        sum: &mut Sum<V>,
    ) {
        let first = part.row as usize;
        let (middle, end) = (first + part.plain as usize, first + (part.plain + part.packed) as usize);
        let (mut packed, mut pass) = (part.first_packed as usize, part.first_pass as usize);
        // SAFETY: each row has the lanes of its other ends, and coefficients; each packed row also those of its own
        // ends, and passes.
        unsafe {
            let ends = Around { names: self.others, own, around };
            sum_rows::<V, NEAR, ENERGY>(unit, [first, middle], &ends, self.coefficients, own, sum);
            let mut row = middle;
            while row < end {
                let owner = V::pick(self.owners.add(packed), own, &[]);
                let coefficients = self.coefficients.add(row * BLOCK * COEFFICIENTS);
                let strain = Strain::of(&ends.others(row), &owner, coefficients);
                let weight = strain.weight::<NEAR>(unit, coefficients, &mut sum.farthest);
                let energy = if ENERGY { strain.energy(unit, coefficients) } else { weight };
                let is_tense = unit.tension != T::default();
                // With a pretension the factors are those of the force itself.
                let (weight, [x, y, z]) = if is_tense {
                    let (mut force, tie) = (strain.span, strain.tie(unit, coefficients));
                    for c in 0..3 {
                        force[c] = tie.mul_add(strain.delta[c], weight.mul(strain.span[c]));
                    }
                    (weight.splat(T::of(1.0)), force)
                } else {
                    (weight, strain.span)
                };
                let end_of_passes = pass + usize::from(*self.passes.add(packed));
                while pass < end_of_passes {
                    let names = self.returns.add(pass);
                    let comes = V::named(names);
                    let [weight, x, y, z] = V::pick(names, &[weight, x, y, z], &[]);
                    for (c, span) in [x, y, z].into_iter().enumerate() {
                        let force = sum.force[c];
                        sum.force[c] = V::select(comes, weight.mul_add(span, force), force);
                    }
                    if ENERGY {
                        let [energy] = V::pick(names, &[energy], &[]);
                        sum.energy = V::select(comes, sum.energy.add(energy), sum.energy);
                    }
                    pass += 1;
                }
                packed += 1;
                row += 1;
            }
        }
    }
}

impl<V: Vector> Sum<V> {
    /// Returns the sum of no springs; `proof` proves that the processor has the instructions.
    #[inline(always)]
    fn zero(proof: &[V; 3]) -> Self {
        let zero = proof[0].splat(V::Real::default());
        Sum { force: [zero; 3], farthest: zero, energy: zero }
    }

    /// Adds a row of springs.
    ///
    /// # Safety
    /// As for [`Strain::of`].
    #[inline(always)]
    unsafe fn add<const NEAR: bool, const ENERGY: bool>(
        &mut self,
        unit: &SpringCoefficients<V::Real>,
        strain: &Strain<V>,
        coefficients: *const V::Real,
    ) {
        // SAFETY: the caller's promise.
        unsafe {
            let weight = strain.weight::<NEAR>(unit, coefficients, &mut self.farthest);
            for c in 0..3 {
                self.force[c] = weight.mul_add(strain.span[c], self.force[c]);
            }
            if unit.tension != V::Real::default() {
                let tie = strain.tie(unit, coefficients);
                for c in 0..3 {
                    self.force[c] = tie.mul_add(strain.delta[c], self.force[c]);
                }
            }
            if ENERGY {
                self.energy = self.energy.add(strain.energy(unit, coefficients));
            }
        }
    }
}

/// The other ends of the springs of a row.
trait Ends<V: Vector> {
    /// Returns the displacements of the other ends.
    ///
    /// # Safety
    /// There is such a row.
    unsafe fn others(&self, row: usize) -> [V; 3];
}

/// Ends anywhere in the mesh.
struct Anywhere<T> {
    records: *const T,
    places: *const u32,
}

impl<V: Vector> Ends<V> for Anywhere<V::Real> {
    #[inline(always)]
    unsafe fn others(&self, row: usize) -> [V; 3] {
        // SAFETY: the caller's promise.
        unsafe { V::records(self.records, self.places.add(row * V::LANES)) }
    }
}

/// Ends in a block and around it.
struct Around<'a, V, const G: usize> {
    names: *const Names,
    own: &'a [V; 3],
    around: &'a [[V; 3]; G],
}

impl<V: Vector, const G: usize> Ends<V> for Around<'_, V, G> {
    #[inline(always)]
    unsafe fn others(&self, row: usize) -> [V; 3] {
        // SAFETY: the caller's promise.
        unsafe { V::pick(self.names.add(row), self.own, self.around) }
    }
}

/// Adds the springs of the rows from `row` to `end`, each of which belongs to its own lane.
///
/// # Safety
/// There are such rows.
#[inline(always)]
unsafe fn sum_rows<V: Vector, const NEAR: bool, const ENERGY: bool>(
    unit: &SpringCoefficients<V::Real>,
    [mut row, end]: [usize; 2],
    ends: &impl Ends<V>,
    coefficients: *const V::Real,
    own: &[V; 3],
    sum: &mut Sum<V>,
) {
    let length = V::LANES * COEFFICIENTS;
    while row < end {
        // SAFETY: the caller's promise.
        unsafe {
            let coefficients = coefficients.add(row * length);
            for value in (0..length).step_by(LINE / size_of::<V::Real>()) {
                V::prefetch(coefficients.wrapping_add(value).wrapping_byte_add(AHEAD));
            }
            let strain = Strain::of(&ends.others(row), own, coefficients);
            sum.add::<NEAR, ENERGY>(unit, &strain, coefficients);
        }
        row += 1;
    }
}

/// A row of springs under strain.
struct Strain<V> {
    q: V,
    /// The vectors e from end to end, and what they are more than at rest.
    span: [V; 3],
    delta: [V; 3],
}

impl<V: Vector> Strain<V> {
    /// # Safety
    /// The coefficients of a row can be read.
    #[inline(always)]
    unsafe fn of(other: &[V; 3], own: &[V; 3], coefficients: *const V::Real) -> Self {
        // Keeps the squares of small differences above the subnormal range, as `grid::excess` does.
        let mut excess = own[0].splat(V::Real::of(V::Real::FAINT));
        let (mut span, mut delta) = (*own, *own);
        // SAFETY: the caller's promise.
        unsafe {
            for c in 0..3 {
                let rest = V::load(coefficients.add(c * V::LANES));
                delta[c] = other[c].sub(own[c]);
                span[c] = rest.add(delta[c]);
                excess = delta[c].mul_add(rest.add(span[c]), excess);
            }
            Strain { q: excess.mul(V::load(coefficients.add(3 * V::LANES))), span, delta }
        }
    }

    /// Returns the factor of e that gives the force. With `NEAR` it is valid for small |q|, and `farthest`
    /// keeps the largest q².
    ///
    /// # Safety
    /// As for [`Strain::of`].
    #[inline(always)]
    unsafe fn weight<const NEAR: bool>(
        &self,
        unit: &SpringCoefficients<V::Real>,
        coefficients: *const V::Real,
        farthest: &mut V,
    ) -> V {
        let (mut weight, square) = unit.near_and_square(self.q);
        if NEAR {
            *farthest = farthest.larger(square);
        } else {
            let far = unit.is_square_far(square);
            if V::any(far) {
                weight = V::select(far, unit.far(self.q), weight);
            }
        }
        // SAFETY: the caller's promise.
        unsafe { weight.mul(V::load(coefficients.add(4 * V::LANES))) }
    }

    /// Returns the factor of the difference from rest that gives the force of the pretension.
    ///
    /// # Safety
    /// As for [`Strain::of`].
    #[inline(always)]
    unsafe fn tie(&self, unit: &SpringCoefficients<V::Real>, coefficients: *const V::Real) -> V {
        // SAFETY: the caller's promise.
        unsafe { self.q.splat(unit.tension).mul(V::load(coefficients.add(4 * V::LANES))) }
    }

    /// # Safety
    /// As for [`Strain::of`].
    #[inline(always)]
    unsafe fn energy(&self, unit: &SpringCoefficients<V::Real>, coefficients: *const V::Real) -> V {
        let mut squared = self.q.splat(V::Real::default());
        // SAFETY: the caller's promise.
        unsafe {
            for c in 0..3 {
                let rest = V::load(coefficients.add(c * V::LANES));
                squared = rest.mul_add(rest, squared);
            }
            let mut energy = unit.energy(self.q).mul(squared).mul(V::load(coefficients.add(4 * V::LANES)));
            if unit.tension != V::Real::default() {
                let [x, y, z] = self.delta;
                let squares = z.mul_add(z, y.mul_add(y, x.mul(x)));
                energy = self.tie(unit, coefficients).mul(squares).mul_add(energy.splat(V::Real::of(0.5)), energy);
            }
            energy
        }
    }
}

/// Returns the force of the springs and of the extra anchor stiffness on one slot, minus the pressure
/// `pressed`. `extra` is the extra K″/m divided by the reference value, if the slots differ in it. `factor` gives the factor of the stiffness of each spring from its
/// number and the slot of its other end; 0: it is severed, and only the load that held the rest shape against its pretension is left. For a few single points. `unit` and `pull` as in [`MeshGrid`].
#[inline(always)]
pub(crate) fn gather<T: Real>(
    slots: &MeshSlots,
    unit: &SpringCoefficients<T>,
    (pull, extra): (T, Option<f64>),
    pressed: Option<(T, [T; 3])>,
    u: &[T],
    slot: usize,
    factor: impl Fn(usize, usize) -> f64,
) -> [T; 3] {
    let plane = slots.layout::<T>().plane;
    let at = |slot: usize| std::array::from_fn(|c| Scalar(u[c * plane + slot]));
    let own: [Scalar<T>; 3] = at(slot);
    let mut sum = Sum::zero(&own);
    for (number, half) in slots.springs(slot).iter().enumerate() {
        let mut coefficients = coefficients::<T>(half);
        let factor = factor(number, half.to as usize);
        if factor == 0.0 {
            for c in 0..3 {
                sum.force[c] = sum.force[c].minus(Scalar(unit.tension * coefficients[4]), Scalar(coefficients[c]));
            }
            continue;
        }
        coefficients[4] = T::of(factor * half.stiffness);
        // SAFETY: the coefficients are those of a row of one spring.
        unsafe {
            let strain = Strain::of(&at(half.to as usize), &own, coefficients.as_ptr());
            sum.add::<false, false>(unit, &strain, coefficients.as_ptr());
        }
    }
    if let Some(extra) = extra {
        let pull = Scalar(pull * T::of(extra));
        for c in 0..3 {
            sum.force[c] = sum.force[c].minus(pull, own[c]);
        }
    }
    if let Some((push, areas)) = pressed {
        for c in 0..3 {
            sum.force[c] = sum.force[c].minus(Scalar(push), Scalar(areas[c]));
        }
    }
    sum.force.map(|force| force.0)
}
