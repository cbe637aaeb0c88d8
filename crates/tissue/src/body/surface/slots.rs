//! The slots of a mesh: a slot is a place of a vertex in the blocks that vectors sweep. Also the springs of
//! each slot, in the order in which forces are summed.

use glam::DVec3;

use super::order::{Adjacency, TABLES, TILE_SLOTS, order};
use crate::kernel::field::{BLOCK, Layout};
use crate::kernel::real::Real;
use crate::memory;
use crate::scene::graph::{GraphFault, MeshGraph};

/// The vertex number of an empty slot in [`MeshSlots::vertex_of`]; no vertex has it.
pub const NO_VERTEX: u32 = u32::MAX;

/// Largest number of outside neighbours that a block handles at once. If it has more, its springs are in
/// several parts.
pub(super) const HALO: usize = 3 * BLOCK;

/// A spring, seen from one of its ends.
#[derive(Debug, Clone, Copy)]
pub(super) struct HalfSpring {
    /// The slot of the other end.
    pub(super) to: u32,
    /// The vector to the other end at rest, spacings.
    pub(super) rest: DVec3,
    /// k divided by the relative mass of this end, N/m.
    pub(super) stiffness: f64,
}

/// The vertices of a mesh in slots, and their springs. A slot is a place of a vertex in the blocks that vectors
/// sweep. Independent of substep, scheme, number format and vector width.
#[derive(Debug)]
pub struct MeshSlots {
    slot_of: Vec<u32>,
    vertex_of: Vec<u32>,
    /// The number of each slot's first spring; then the number of all.
    firsts: Vec<u32>,
    halves: Vec<HalfSpring>,
    /// The relative mass of each slot; 0 if it is empty. The list is empty if all are 1.
    masses: Vec<f64>,
    /// The extra K″/m of each slot divided by the reference value. Empty if all are 0.
    extra: Vec<f64>,
    /// The number of each tile's first neighbour; then the number of all.
    first_neighbours: Vec<u32>,
    neighbours: Vec<u32>,
}

impl MeshSlots {
    /// Assigns the vertices of a graph to slots: vertices that are near along the mesh come near to each other.
    /// Unwinds with a refusal if there is no memory ([`attempt`](crate::memory::attempt)).
    ///
    /// # Errors
    /// Returns the first fault of the graph, in the order of [`GraphFault`] (spring by spring for the last three).
    #[allow(clippy::cast_possible_truncation)]
    pub fn new(graph: &MeshGraph) -> Result<Self, GraphFault> {
        graph.check()?;
        let count = graph.rest_m.len();
        let adjacency = Adjacency::of(graph);
        let mut vertex_of = order(count, &adjacency);
        let mut slot_of = memory::zeroed(count, TABLES);
        for (slot, vertex) in vertex_of.iter().enumerate() {
            slot_of[*vertex as usize] = slot as u32;
        }
        vertex_of.resize(count.next_multiple_of(BLOCK), NO_VERTEX);
        let of_slots = |list: &[f64], value: &dyn Fn(u32) -> f64| {
            let values = vertex_of.iter().map(|vertex| if *vertex == NO_VERTEX { 0.0 } else { value(*vertex) });
            if list.is_empty() { Vec::new() } else { memory::collected(values, TABLES) }
        };
        let masses = of_slots(&graph.relative_mass, &|vertex| graph.mass(vertex));
        let extra = of_slots(&graph.extra_anchor, &|vertex| graph.extra(vertex));
        let mut firsts = memory::with_room(vertex_of.len() + 1, TABLES);
        let mut halves = memory::with_room(2 * graph.springs.len(), TABLES);
        for (block, vertices) in vertex_of.chunks(BLOCK).enumerate() {
            let places = || vertices.iter().filter(|vertex| **vertex != NO_VERTEX);
            let ends = places().flat_map(|vertex| adjacency.of_point(*vertex));
            let outside = outside(ends.map(|(other, _)| slot_of[*other as usize]), block);
            for vertex in vertices {
                firsts.push(halves.len() as u32);
                let springs = if *vertex == NO_VERTEX { &[] } else { adjacency.of_point(*vertex) };
                let from = halves.len();
                halves.extend(springs.iter().map(|&(other, spring)| HalfSpring {
                    to: slot_of[other as usize],
                    rest: graph.rest(*vertex, other),
                    stiffness: graph.springs[spring as usize].stiffness_n_per_m / graph.mass(*vertex),
                }));
                // The sort keeps the order of springs between the same points.
                halves[from..].sort_by_key(|half: &HalfSpring| (part(&outside, block, half.to), half.to));
            }
        }
        firsts.push(halves.len() as u32);
        let mut slots = MeshSlots {
            slot_of,
            vertex_of,
            firsts,
            halves,
            masses,
            extra,
            first_neighbours: vec![0],
            neighbours: Vec::new(),
        };
        slots.find_neighbours();
        Ok(slots)
    }

    /// Fills in the neighbours of the tiles.
    #[allow(clippy::cast_possible_truncation)]
    fn find_neighbours(&mut self) {
        for tile in 0..self.tiles() {
            let slots = tile * TILE_SLOTS..((tile + 1) * TILE_SLOTS).min(self.vertex_of.len());
            let others = self.halves[self.firsts[slots.start] as usize..self.firsts[slots.end] as usize].iter();
            let mut others: Vec<u32> = others.map(|half| half.to / TILE_SLOTS as u32).collect();
            others.sort_unstable();
            others.dedup();
            self.neighbours.extend(others.into_iter().filter(|other| *other as usize != tile));
            self.first_neighbours.push(self.neighbours.len() as u32);
        }
    }

    /// Returns the slot of each vertex, by vertex: a different number for each, below the number of vertices.
    pub fn slot_of(&self) -> &[u32] {
        &self.slot_of
    }

    /// Returns the vertex of each slot, by slot; [`NO_VERTEX`] for an empty one, which are the last. Their number is
    /// the next multiple of 16.
    pub fn vertex_of(&self) -> &[u32] {
        &self.vertex_of
    }

    /// Returns the number of blocks of 16 slots, the rows of the layout.
    pub fn blocks(&self) -> usize {
        self.vertex_of.len() / BLOCK
    }

    /// Returns the number of tiles of 256 successive slots, which sleep as one; the last tile may have fewer.
    pub fn tiles(&self) -> usize {
        self.vertex_of.len().div_ceil(TILE_SLOTS)
    }

    /// Returns the other tiles that springs of tile number `tile` (from 0) reach, ascending, each once. Panics if
    /// there is no such tile.
    pub fn neighbours(&self, tile: usize) -> &[u32] {
        let [from, to] = [0, 1].map(|next| self.first_neighbours[tile + next] as usize);
        &self.neighbours[from..to]
    }

    /// Returns the layout of a state: 16 columns, and the offset of a slot is its number.
    pub(crate) fn layout<T: Real>(&self) -> Layout {
        let layout = Layout::new::<T>([self.blocks(), BLOCK]);
        debug_assert_eq!(layout.stride, BLOCK);
        layout
    }

    /// Returns the springs of a slot, in the order in which their forces are summed.
    pub(super) fn springs(&self, slot: usize) -> &[HalfSpring] {
        &self.halves[self.firsts[slot] as usize..self.firsts[slot + 1] as usize]
    }

    /// Returns the number of the first half of a slot's springs among the halves of all slots.
    pub(crate) fn first_half(&self, slot: usize) -> usize {
        self.firsts[slot] as usize
    }

    /// Returns the number of all halves of springs.
    pub(crate) fn count(&self) -> usize {
        self.halves.len()
    }

    /// Returns the slots outside a block that its springs reach, ascending.
    pub(super) fn outside(&self, block: usize) -> Vec<u32> {
        let slots = block * BLOCK..(block + 1) * BLOCK;
        let halves = &self.halves[self.firsts[slots.start] as usize..self.firsts[slots.end] as usize];
        outside(halves.iter().map(|half| half.to), block)
    }

    /// Returns the relative masses of the slots. Empty if all are 1.
    pub(super) fn masses(&self) -> &[f64] {
        &self.masses
    }

    /// Returns whether masses differ.
    pub(crate) fn has_masses(&self) -> bool {
        !self.masses.is_empty()
    }

    /// Returns the mass of a slot divided by the reference mass; 0 for an empty slot, if masses differ.
    pub(crate) fn mass(&self, slot: usize) -> f64 {
        self.masses.get(slot).copied().unwrap_or(1.0)
    }

    /// Returns K″/m of a slot divided by the reference value, minus 1.
    pub(crate) fn extra_at(&self, slot: usize) -> f64 {
        self.extra.get(slot).copied().unwrap_or(0.0)
    }

    /// Returns K″/m of a slot divided by the reference value, minus 1; `None` if it is 0 everywhere.
    pub(crate) fn extra_of(&self, slot: usize) -> Option<f64> {
        self.extra.get(slot).copied()
    }

    /// Returns the extra K″/m of the slots divided by the reference value. Empty if all are 0.
    pub(super) fn extra(&self) -> &[f64] {
        &self.extra
    }
}

/// Returns those of some slots that are outside a block, ascending, each once.
fn outside(slots: impl Iterator<Item = u32>, block: usize) -> Vec<u32> {
    let mut outside: Vec<u32> = slots.filter(|slot| *slot as usize / BLOCK != block).collect();
    outside.sort_unstable();
    outside.dedup();
    outside
}

/// Returns the part of a block's springs to which a spring to slot `to` belongs. Part 0 has those within the
/// block, and those to the first [`HALO`] slots `outside`.
pub(super) fn part(outside: &[u32], block: usize, to: u32) -> usize {
    if to as usize / BLOCK == block { 0 } else { outside.partition_point(|slot| *slot < to) / HALO }
}
