//! The order of a mesh's points in memory: points that are near along the mesh are near in the order, whatever
//! the shape in space.
//!
//! A set of points is split in two again and again, down to blocks. Each time, two of its points that are far
//! apart along the mesh are found, and the points nearer to the one are put before those nearer to the other.
//! (Orders in space, such as space-filling curves, fail where two parts of a surface are close.)

use std::cmp::Reverse;

use palpate_geometry::work::spend;

use crate::kernel::field::BLOCK;
use crate::kernel::region::TILE;
use crate::memory;
use crate::scene::graph::MeshGraph;

/// Slots (places of vertices in memory) of a tile.
pub(super) const TILE_SLOTS: usize = TILE * BLOCK;

/// The name of the tables in messages.
pub(super) const TABLES: &str = "the points of a mesh";

/// The springs of each point, and the points at their other ends.
pub(super) struct Adjacency {
    firsts: Vec<u32>,
    others: Vec<(u32, u32)>,
}

impl Adjacency {
    /// Collects the springs of a graph, which must join existing points.
    #[allow(clippy::cast_possible_truncation)]
    pub(super) fn of(graph: &MeshGraph) -> Self {
        let mut firsts: Vec<u32> = memory::zeroed(graph.rest_m.len() + 2, TABLES);
        // Counts the springs of each point two places on, so that the table is complete once they are filled in.
        for point in graph.springs.iter().flat_map(|spring| spring.ends) {
            firsts[point as usize + 2] += 1;
        }
        for point in 2..firsts.len() {
            firsts[point] += firsts[point - 1];
        }
        let mut others = memory::filled(2 * graph.springs.len(), (0, 0), TABLES);
        for (index, spring) in graph.springs.iter().enumerate() {
            let [a, b] = spring.ends;
            for (from, to) in [(a, b), (b, a)] {
                let next: &mut u32 = &mut firsts[from as usize + 1];
                others[*next as usize] = (to, index as u32);
                *next += 1;
            }
        }
        Adjacency { firsts, others }
    }

    /// Returns (other end, spring) for each spring of a point, ascending by springs.
    pub(super) fn of_point(&self, point: u32) -> &[(u32, u32)] {
        let [from, to] = [0, 1].map(|next| self.firsts[point as usize + next] as usize);
        &self.others[from..to]
    }
}

/// Returns the points in their new order.
#[allow(clippy::cast_possible_truncation)]
pub(super) fn order(count: usize, adjacency: &Adjacency) -> Vec<u32> {
    let mut order = memory::collected(0..count as u32, TABLES);
    let mut walks = Walks::new(count, adjacency);
    let mut sets = vec![[0, count]];
    while let Some([from, to]) = sets.pop() {
        let length = to - from;
        if length > BLOCK {
            walks.sort(&mut order[from..to]);
            // Whole tiles while there are several, then whole blocks.
            let unit = if length > TILE_SLOTS { TILE_SLOTS } else { BLOCK };
            let half = (length / 2 + unit / 2) / unit * unit;
            let middle = from + half.clamp(unit, (length - 1) / unit * unit);
            sets.extend([[from, middle], [middle, to]]);
        }
    }
    // The lanes of a narrow vector should have about as many springs each.
    for block in order.chunks_mut(BLOCK) {
        block.sort_by_key(|point| Reverse(adjacency.of_point(*point).len()));
    }
    order
}

/// Breadth-first walks over sets of points.
struct Walks<'a> {
    adjacency: &'a Adjacency,
    /// The last set that contained each point, and the last walk that reached it.
    set: Vec<u32>,
    walk: Vec<u32>,
    /// The distance of each point in the first of two walks.
    distance: Vec<u32>,
    /// The points of the last walk and their distances.
    came: Vec<(u32, u32)>,
    ranks: Vec<(i64, u32, u32)>,
    /// The number of sets and walks so far.
    count: u32,
}

impl<'a> Walks<'a> {
    fn new(count: usize, adjacency: &'a Adjacency) -> Self {
        Walks {
            adjacency,
            set: memory::zeroed(count, TABLES),
            walk: memory::zeroed(count, TABLES),
            distance: memory::zeroed(count, TABLES),
            came: memory::with_room(count, TABLES),
            ranks: memory::with_room(count, TABLES),
            count: 0,
        }
    }

    /// Sorts a set of points from one of its ends to the opposite one.
    fn sort(&mut self, points: &mut [u32]) {
        self.count += 1;
        let set = self.count;
        points.iter().for_each(|point| self.set[*point as usize] = set);
        let end = self.farthest_from(points[0], points, set);
        let opposite = self.farthest_from(end, points, set);
        for &(point, distance) in &self.came {
            self.distance[point as usize] = distance;
        }
        self.farthest_from(opposite, points, set);
        self.ranks.clear();
        for &(point, away) in &self.came {
            let distance = self.distance[point as usize];
            self.ranks.push((i64::from(distance) - i64::from(away), distance, point));
        }
        // All ranks differ.
        self.ranks.sort_unstable();
        points.iter_mut().zip(&self.ranks).for_each(|(point, rank)| *point = rank.2);
    }

    /// Walks from a point over all of a set. Returns the last point, which is one of the farthest.
    fn farthest_from(&mut self, start: u32, points: &[u32], set: u32) -> u32 {
        self.count += 1;
        let walk = self.count;
        self.came.clear();
        self.came.push((start, 0));
        self.walk[start as usize] = walk;
        let mut unseen = points.iter();
        let mut last = (start, 0);
        for next in 0..points.len() {
            if next == self.came.len() {
                // The set has another piece.
                let Some(point) = unseen.find(|point| self.walk[**point as usize] != walk) else { break };
                self.walk[*point as usize] = walk;
                self.came.push((*point, last.1 + 1));
            }
            last = self.came[next];
            let around = self.adjacency.of_point(last.0);
            spend(1 + around.len());
            for &(other, _) in around {
                if self.set[other as usize] == set && self.walk[other as usize] != walk {
                    self.walk[other as usize] = walk;
                    self.came.push((other, last.1 + 1));
                }
            }
        }
        last.0
    }
}
