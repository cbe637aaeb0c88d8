//! Where the points of a mesh are in memory, and what its tiles border on.
//!
//! The points are placed in *slots*, in an order in which neighbours are close together: the graph of the springs is split
//! in halves, and these again (by distance along the graph, not in space: two surfaces that nearly touch stay apart). A row
//! of memory is a block of [`BLOCK`] slots, so a sheet's fields, stages, tables of forces and sums serve a mesh as they are,
//! and a tile of `tiles` is [`TILE`] such rows: 256 points.

use std::ops::Range;

use glam::DVec3;

use super::field::BLOCK;
use super::region::TILE;
use crate::scene::Mesh;
use crate::shape::{PointId, RestShape};

/// Slots of a tile.
const TILE_SLOTS: usize = TILE * BLOCK;

/// A spring between two slots.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spring {
    pub(super) ends: [usize; 2],
    /// Its k over that of an edge.
    pub(super) part: f64,
}

/// The order of a mesh's points in memory, and its springs.
#[derive(Debug)]
pub(super) struct Graph {
    /// The slot of each vertex.
    slots: Vec<u32>,
    /// The vertex in each slot; those that are empty have none.
    vertices: Vec<Option<u32>>,
    /// Where the point of each slot rests, m; not a number where there is none.
    rest_m: Vec<DVec3>,
    /// The mean length of an edge, m.
    unit_m: f64,
    /// Ends are slots.
    springs: Vec<Spring>,
    /// The middle of each row's points, m, and the radius of the ball around them.
    balls: Vec<(DVec3, f64)>,
    /// The ends of the box around each tile's points, m.
    boxes: Vec<[[f64; 2]; 3]>,
    /// The slots beyond each tile that its springs lead to, ascending; and the tiles that those are of.
    around: Lists,
    beside: Lists,
}

/// Lists of numbers, one after another.
#[derive(Debug)]
struct Lists {
    from: Vec<usize>,
    members: Vec<usize>,
}

impl Lists {
    fn new(lists: &[Vec<usize>]) -> Self {
        let mut from = vec![0];
        let mut members = Vec::new();
        for list in lists {
            members.extend_from_slice(list);
            from.push(members.len());
        }
        Lists { from, members }
    }

    fn range(&self, of: usize) -> Range<usize> {
        self.from[of]..self.from[of + 1]
    }

    fn of(&self, which: usize) -> &[usize] {
        &self.members[self.range(which)]
    }
}

impl Graph {
    #[allow(clippy::cast_possible_truncation)]
    pub(super) fn of(mesh: &Mesh) -> Self {
        let (shape, count) = (&mesh.shape, mesh.shape.vertices_m().len());
        let order = order(count, shape.edges());
        let rows = count.div_ceil(BLOCK);
        let mut slots = vec![0; count];
        let (mut vertices, mut rest_m) = (vec![None; rows * BLOCK], vec![DVec3::NAN; rows * BLOCK]);
        for (slot, vertex) in order.into_iter().enumerate() {
            slots[vertex as usize] = slot as u32;
            vertices[slot] = Some(vertex);
            rest_m[slot] = shape.vertices_m()[vertex as usize];
        }
        let unit_m = mesh.shape.edge_m();
        let springs: Vec<Spring> = shape
            .springs(mesh.flexion)
            .map(|(ends, part)| Spring { ends: ends.map(|vertex| slots[vertex as usize] as usize), part })
            .collect();
        let of_row = |row: usize| rest_m[row * BLOCK..(row + 1) * BLOCK].iter().filter(|place_m| place_m.is_finite());
        #[allow(clippy::cast_precision_loss)]
        let ball = |row: usize| {
            let centre_m = of_row(row).sum::<DVec3>() / of_row(row).count() as f64;
            (centre_m, of_row(row).map(|place_m| place_m.distance(centre_m)).fold(0.0, f64::max))
        };
        let tiles = rows.div_ceil(TILE);
        let box_of = |tile: usize| {
            let places = (tile * TILE..((tile + 1) * TILE).min(rows)).flat_map(of_row);
            let (mut least_m, mut most_m) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
            places.for_each(|place_m| (least_m, most_m) = (least_m.min(*place_m), most_m.max(*place_m)));
            std::array::from_fn(|axis| [least_m[axis], most_m[axis]])
        };
        let mut around = vec![Vec::new(); tiles];
        for Spring { ends: [a, b], .. } in &springs {
            let of = [a / TILE_SLOTS, b / TILE_SLOTS];
            if of[0] != of[1] {
                around[of[0]].push(*b);
                around[of[1]].push(*a);
            }
        }
        let sorted = |list: &mut Vec<usize>| {
            list.sort_unstable();
            list.dedup();
        };
        around.iter_mut().for_each(sorted);
        let mut beside: Vec<Vec<usize>> =
            around.iter().map(|slots| slots.iter().map(|slot| slot / TILE_SLOTS).collect()).collect();
        beside.iter_mut().for_each(sorted);
        Graph {
            balls: (0..rows).map(ball).collect(),
            boxes: (0..tiles).map(box_of).collect(),
            around: Lists::new(&around),
            beside: Lists::new(&beside),
            slots,
            vertices,
            rest_m,
            unit_m,
            springs,
        }
    }

    /// All springs.
    pub(super) fn springs(&self) -> &[Spring] {
        &self.springs
    }

    /// Where the point of a slot rests, in mean lengths of an edge.
    pub(super) fn rest(&self, slot: usize) -> DVec3 {
        self.rest_m[slot] / self.unit_m
    }

    /// Rows of memory.
    pub(super) fn rows(&self) -> usize {
        self.vertices.len() / BLOCK
    }

    /// The slot of a point.
    pub(super) fn slot_of(&self, point: PointId) -> usize {
        self.slots[point.index()] as usize
    }

    /// The point in a slot; in an empty one, the first.
    pub(super) fn point_in(&self, slot: usize) -> PointId {
        PointId::new(self.vertices[slot].unwrap_or_default() as usize)
    }

    /// Where the point of a slot rests, m.
    pub(super) fn rest_m(&self, slot: usize) -> DVec3 {
        self.rest_m[slot]
    }

    /// Where the points of a row rest, m.
    pub(super) fn rest_in_row(&self, row: usize) -> &[DVec3] {
        &self.rest_m[row * BLOCK..(row + 1) * BLOCK]
    }

    /// The rows from the first to the last that has a place within a ball.
    pub(super) fn rows_within(&self, centre_m: DVec3, radius_m: f64) -> Range<usize> {
        let is_near = |(middle_m, ball_m): &(DVec3, f64)| middle_m.distance(centre_m) - ball_m <= radius_m;
        match (self.balls.iter().position(is_near), self.balls.iter().rposition(is_near)) {
            (Some(first), Some(last)) => first..last + 1,
            _ => 0..0,
        }
    }

    /// The ends of the box around the points of a tile along each axis, m.
    pub(super) fn box_of(&self, tile: usize) -> &[[f64; 2]; 3] {
        &self.boxes[tile]
    }

    /// The tiles that springs join to a tile, ascending.
    pub(super) fn beside(&self, tile: usize) -> &[usize] {
        self.beside.of(tile)
    }

    /// The slots beyond a tile that its springs lead to, ascending.
    pub(super) fn slots_around(&self, tile: usize) -> &[usize] {
        self.around.of(tile)
    }

    /// Where those are in the list of such slots of all tiles.
    pub(super) fn around(&self, tile: usize) -> Range<usize> {
        self.around.range(tile)
    }

    /// The length of that list.
    pub(super) fn watched_slots(&self) -> usize {
        self.around.members.len()
    }
}

/// The vertices by slots: recursive halves along the graph.
#[allow(clippy::cast_possible_truncation)]
fn order(count: usize, edges: &[[u32; 2]]) -> Vec<u32> {
    let mut around = vec![Vec::new(); count];
    for [a, b] in edges {
        around[*a as usize].push(*b);
        around[*b as usize].push(*a);
    }
    let mut order: Vec<u32> = (0..count as u32).collect();
    // The part that each vertex belongs to, and the search that reached it last.
    let (mut part_of, mut reached) = (vec![0_u32; count], vec![0_u32; count]);
    let (mut parts, mut searches) = (1, 0);
    let mut waiting = vec![0..count];
    let mut found: Vec<u32> = Vec::new();
    while let Some(range) = waiting.pop() {
        if range.len() <= BLOCK {
            continue;
        }
        let part = part_of[order[range.start] as usize];
        // From one end to the other: the vertex that a first search finds last begins the second.
        let mut first = order[range.start];
        for _ in 0..2 {
            searches += 1;
            found.clear();
            let mut next = 0;
            for start in std::iter::once(first).chain(order[range.clone()].iter().copied()) {
                if reached[start as usize] == searches {
                    continue;
                }
                reached[start as usize] = searches;
                found.push(start);
                while next < found.len() {
                    for other in &around[found[next] as usize] {
                        if part_of[*other as usize] == part && reached[*other as usize] != searches {
                            reached[*other as usize] = searches;
                            found.push(*other);
                        }
                    }
                    next += 1;
                }
            }
            first = *found.last().unwrap_or(&first);
        }
        order[range.clone()].copy_from_slice(&found);
        // Halves of whole tiles, or else of whole rows.
        let unit = if range.len() > TILE_SLOTS { TILE_SLOTS } else { BLOCK };
        let half = (range.len() / 2).next_multiple_of(unit).min(range.len());
        if half == range.len() {
            continue;
        }
        let middle = range.start + half;
        order[middle..range.end].iter().for_each(|vertex| part_of[*vertex as usize] = parts);
        parts += 1;
        waiting.push(middle..range.end);
        waiting.push(range.start..middle);
    }
    order
}
