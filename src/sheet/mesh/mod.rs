//! The springs of a mesh, and the sweep that evaluates them.
//!
//! A mesh has no rows: a spring may lead anywhere. So each point gathers the forces of its own springs, in a fixed order: a
//! spring is evaluated from both ends, nothing is scattered, and the bits are the same at every width. The springs of a
//! block of 16 slots are stored side by side, as many for each point as the one of them has that has most (the format is
//! known as SELL-C). A sweep first copies the displacements of the awake tiles, and of those beside them, to records of
//! (x, y, z, 0), which a point reads whole; so the stage may overwrite the state at once.
#![allow(unsafe_code)]
// The compiler does not always inline iterators and closures over vectors.
#![allow(clippy::needless_range_loop)]

use std::cell::RefCell;

use super::field::{BLOCK, Layout};
use super::graph::{Graph, Spring};
use super::lanes::{Plain, Run, Vector};
use super::real::Real;
use super::region::{Region, TILE};
use super::springs::Kind;
use super::stage::{ANY, Stage};
use crate::memory;

/// The springs of a mesh, gathered from both ends.
#[derive(Debug, Clone)]
pub(super) struct MeshSprings<T> {
    /// Where the springs of each row of slots begin, in blocks; one more for the end.
    from: Vec<u32>,
    /// The slots at their other ends; its own for a point that has no more springs.
    other: Vec<[u32; BLOCK]>,
    /// Rest vector (three components), 1/L0² and stiffness of each.
    rest: Vec<[[T; BLOCK]; 5]>,
    /// A spring of unit length and stiffness.
    unit: Kind<T>,
}

/// Components of `rest`.
const LENGTH: usize = 3;
const STIFFNESS: usize = 4;

impl<T: Real> MeshSprings<T> {
    /// Of a mesh; `stiffness` is that of an edge, in the scheme's terms.
    #[allow(clippy::cast_possible_truncation)]
    pub(super) fn new(graph: &Graph, stiffness: f64) -> Self {
        let rows = graph.rows();
        let mut of_slot: Vec<Vec<(usize, f64)>> = vec![Vec::new(); rows * BLOCK];
        for Spring { ends: [a, b], part } in graph.springs() {
            of_slot[*a].push((*b, *part));
            of_slot[*b].push((*a, *part));
        }
        let mut found = MeshSprings { from: vec![0], other: Vec::new(), rest: Vec::new(), unit: Kind::unit() };
        for row in 0..rows {
            let own = &of_slot[row * BLOCK..(row + 1) * BLOCK];
            for k in 0..own.iter().map(Vec::len).max().unwrap_or(0) {
                let mut other: [u32; BLOCK] = std::array::from_fn(|lane| (row * BLOCK + lane) as u32);
                let mut values = [[T::default(); BLOCK]; 5];
                for lane in 0..BLOCK {
                    let Some((to, part)) = own[lane].get(k).copied() else { continue };
                    other[lane] = to as u32;
                    let along = graph.rest(to) - graph.rest(row * BLOCK + lane);
                    (0..3).for_each(|c| values[c][lane] = T::of(along[c]));
                    values[LENGTH][lane] = T::of(along.length_squared().recip());
                    values[STIFFNESS][lane] = T::of(stiffness * part);
                }
                found.other.push(other);
                found.rest.push(values);
            }
            found.from.push(found.other.len() as u32);
        }
        found
    }

    /// The springs' force on a slot.
    pub(super) fn gather(&self, layout: &Layout, u: &[T], slot: usize) -> [T; 3] {
        let (row, lane) = (slot / BLOCK, slot % BLOCK);
        let one = Plain::<T, 1>::one;
        let place = |slot: usize| [0, 1, 2].map(|c| one(u[c * layout.plane + layout.offset(slot)]));
        let here = place(slot);
        let mut sum = [one(T::default()); 3];
        for k in self.from[row] as usize..self.from[row + 1] as usize {
            let of = self.rest[k].map(|values| one(values[lane]));
            let (force, _) = self.force(&here, &place(self.other[k][lane] as usize), &of);
            sum = [0, 1, 2].map(|c| sum[c].add(force[c]));
        }
        sum.map(Plain::value)
    }

    /// The force of a spring on its end `here`, and its q = (L/L0)² − 1.
    #[inline(always)]
    fn force<V: Vector<Real = T>>(&self, here: &[V; 3], there: &[V; 3], of: &[V; 5]) -> ([V; 3], V) {
        let delta = [there[0].sub(here[0]), there[1].sub(here[1]), there[2].sub(here[2])];
        let along = delta[2].mul_add(of[2], delta[1].mul_add(of[1], delta[0].mul(of[0])));
        let excess = super::grid::excess(along, &delta, [0, 1, 2]).mul(of[LENGTH]);
        let weight = self.unit.weight(excess).mul(of[STIFFNESS]);
        let mut force = delta;
        for c in 0..3 {
            force[c] = weight.mul(of[c].add(delta[c]));
        }
        (force, excess)
    }
}

/// A sweep over a mesh, ready to run at any width.
pub(super) struct MeshSweep<'a, T, S> {
    pub(super) layout: Layout,
    pub(super) springs: &'a MeshSprings<T>,
    pub(super) graph: &'a Graph,
    /// Displacements: three planes.
    pub(super) x: *const T,
    pub(super) records: &'a RefCell<Records<T>>,
    pub(super) over: &'a Region,
    pub(super) stage: S,
}

/// Displacements as records of (x, y, z, 0), one for each slot. Kept, so that a step allocates nothing.
#[derive(Debug)]
pub(super) struct Records<T> {
    values: Vec<T>,
    /// The sweep that copied each tile last.
    copied: Vec<u64>,
    sweeps: u64,
}

impl<T: Real> Records<T> {
    pub(super) fn new(rows: usize) -> Self {
        Records {
            values: memory::zeroed(4 * rows * BLOCK, "the state of a mesh"),
            copied: memory::zeroed(rows.div_ceil(TILE), "the tiles of a mesh"),
            sweeps: 0,
        }
    }

    /// Copies a tile, unless this sweep has.
    ///
    /// # Safety
    /// `x` has three planes of the layout.
    #[inline(always)]
    unsafe fn copy(&mut self, layout: &Layout, x: *const T, tile: usize) {
        if std::mem::replace(&mut self.copied[tile], self.sweeps) == self.sweeps {
            return;
        }
        for row in tile * TILE..((tile + 1) * TILE).min(layout.rows) {
            let records = self.values[4 * row * BLOCK..4 * (row + 1) * BLOCK].chunks_exact_mut(4);
            for (lane, record) in records.enumerate() {
                for c in 0..3 {
                    // SAFETY: a row of the layout has a block.
                    record[c] = unsafe { *x.add(c * layout.plane + row * layout.stride + lane) };
                }
            }
        }
    }
}

impl<T: Real, S: Stage<T>> Run<T> for MeshSweep<'_, T, S> {
    #[inline(always)]
    unsafe fn run<V: Vector<Real = T>>(&self) {
        // SAFETY: the caller's promise: `x` has three planes of the layout; there are records for all slots, and the springs
        // lead from slots to slots.
        unsafe {
            let Layout { rows, stride, plane, .. } = self.layout;
            let zero = V::of(T::default());
            let mut sums = self.stage.begin::<V>();
            let tiles = self.over.tiles();
            let mut records = self.records.borrow_mut();
            records.sweeps += 1;
            for tile in tiles {
                for tile in self.graph.beside(*tile).iter().chain([tile]) {
                    records.copy(&self.layout, self.x, *tile);
                }
            }
            let records = records.values.as_ptr();
            for tile in tiles {
                for row in tile * TILE..((tile + 1) * TILE).min(rows) {
                    let of_row = self.springs.from[row] as usize..self.springs.from[row + 1] as usize;
                    let mut column = 0;
                    while column < BLOCK {
                        let at = row * stride + column;
                        let here = super::grid::load::<V>(self.x.add(at), plane);
                        let (mut n, mut energy) = ([zero; 3], zero);
                        for k in of_row.clone() {
                            let (mut there, other) = ([[T::default(); BLOCK]; 3], &self.springs.other[k]);
                            for lane in 0..V::LANES {
                                let record = records.add(4 * other[column + lane] as usize);
                                for c in 0..3 {
                                    there[c][lane] = *record.add(c);
                                }
                            }
                            let there =
                                [V::load(there[0].as_ptr()), V::load(there[1].as_ptr()), V::load(there[2].as_ptr())];
                            let rest = self.springs.rest[k].as_ptr().cast::<T>().add(column);
                            let mut of = [zero; 5];
                            for c in 0..5 {
                                of[c] = V::load(rest.add(c * BLOCK));
                            }
                            let (force, excess) = self.springs.force(&here, &there, &of);
                            for c in 0..3 {
                                n[c] = n[c].add(force[c]);
                            }
                            if S::ENERGY {
                                // Each end counts half of it.
                                let of_unit = self.springs.unit.energy(excess).mul(of[STIFFNESS]);
                                let length_squared = V::of(T::of(0.5)).div(of[LENGTH].larger(V::of(T::of(1e-30))));
                                energy = of_unit.mul_add(length_squared, energy);
                            }
                        }
                        if S::ENERGY {
                            self.stage.energy(column, energy);
                        }
                        self.stage.finish::<V, ANY>(row, at, here, n, &mut sums);
                        column += V::LANES;
                    }
                    self.stage.end_row();
                }
            }
            self.stage.end(sums);
        }
    }
}
