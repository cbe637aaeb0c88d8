//! Which part of each cube of a lattice is inside a closed surface.
//!
//! Rays along z cross the surface. Each triangle that a ray crosses upwards out of the inside counts −1, into it +1; a
//! place is inside where the count is not 0. So parts that overlap count once, and a surface that crosses itself has no
//! hole there. If the counts of a ray do not end at 0, it crosses triangles that are turned, doubled or missing. Then the
//! winding number between two crossings tells whether that part of the ray is inside: more than one half. Where it is near one
//! half, every crossing changes sides, if their number is even; if it is odd, the ray passes near a hole.
//!
//! Along a ray the part is exact; across, a cell is the mean of [`RAYS`]² rays.

use glam::{DVec2, DVec3};

use crate::winding::Winding;
use crate::work::spend;

/// Rays along each side of a cell.
pub const RAYS: usize = 4;

/// Shortest part of a ray on which a hole is seen, in edges.
const SEEN: f64 = 0.5;

/// A lattice of cubes, parallel to the axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lattice {
    /// The corner of least coordinates, m.
    pub origin_m: DVec3,
    /// Length of an edge of a cube, m.
    pub edge_m: f64,
    /// Number of cubes along each axis, at least 1.
    pub cells: [usize; 3],
}

impl Lattice {
    /// Returns the number of cubes.
    pub fn count(&self) -> usize {
        self.cells.iter().product()
    }

    /// Returns the number of a cube in lists over all of them: x runs fastest, then y.
    pub fn index(&self, [i, j, k]: [usize; 3]) -> usize {
        (k * self.cells[1] + j) * self.cells[0] + i
    }

    /// Returns a place in edges from the origin: cube [i, j, k] reaches from (i, j, k) to (i + 1, j + 1, k + 1).
    pub fn from_m(&self, place_m: DVec3) -> DVec3 {
        (place_m - self.origin_m) / self.edge_m
    }

    /// Returns the middle of a cube, m.
    #[allow(clippy::cast_precision_loss)]
    pub fn middle_m(&self, cell: [usize; 3]) -> DVec3 {
        self.origin_m + self.edge_m * (DVec3::from_array(cell.map(|at| at as f64)) + 0.5)
    }
}

/// The parts of cubes inside a surface ([`filled`]).
#[derive(Debug, Clone, PartialEq)]
pub struct Filled {
    /// For each cube of the lattice ([`Lattice::index`]) the part of it that is inside, 0 to 1.
    pub parts: Vec<f32>,
    /// Rays that pass near a hole, divided by the rays that cross the surface: 0 for a closed surface.
    pub open_part: f64,
    /// A place near a hole, m; `None` for a closed surface.
    pub open_at_m: Option<DVec3>,
}

/// A ray crosses the surface.
#[derive(Debug, Clone, Copy)]
struct RayCrossing {
    ray: u32,
    /// Height in edges.
    height: f64,
    /// 1 where the ray enters, −1 where it leaves.
    into: i8,
}

/// Returns twice the signed area of a triangle of two vertices, given by number and place, and a third place. The
/// triangles at both sides of an edge get opposite numbers to the last bit, so that a ray through the edge is in one of
/// them.
fn side(a: (u32, DVec2), b: (u32, DVec2), place: DVec2) -> f64 {
    let of = |a: DVec2, b: DVec2| (b - a).perp_dot(place - a);
    if a.0 < b.0 { of(a.1, b.1) } else { -of(b.1, a.1) }
}

/// Returns which part of each cube is inside the surface of `vertices_m` (m) and `triangles` (vertices, anticlockwise
/// seen from outside). Panics if a triangle names a vertex that is not there. Parts of the surface beyond the lattice do
/// not count.
pub fn filled(vertices_m: &[DVec3], triangles: &[[u32; 3]], lattice: &Lattice) -> Filled {
    let crossings = crossings(vertices_m, triangles, lattice);
    let mut parts = vec![0.0_f32; lattice.count()];
    let (mut crossed, mut open, mut open_at_m, mut winding) = (0_usize, 0_usize, None, None);
    let rays = lattice.cells[0] * RAYS;
    for of_ray in crossings.chunk_by(|a, b| a.ray == b.ray) {
        crossed += 1;
        let ray = of_ray[0].ray as usize;
        let [x, y] = [ray % rays, ray / rays];
        let mut fill = |pair: &[RayCrossing]| {
            let column = |k: usize| lattice.index([x / RAYS, y / RAYS, k]);
            add(pair[0].height, pair[1].height, lattice.cells[2], |k, length| parts[column(k)] += length);
        };
        if of_ray.iter().map(|crossing| i32::from(crossing.into)).sum::<i32>() == 0 {
            let mut count = 0;
            for pair in of_ray.windows(2) {
                count += i32::from(pair[0].into);
                if count != 0 {
                    fill(pair);
                }
            }
            continue;
        }
        let winding = winding.get_or_insert_with(|| Winding::new(vertices_m, triangles));
        let place_m = |height: f64| lattice.origin_m + lattice.edge_m * place_of([x, y]).extend(height);
        let is_even = of_ray.len().is_multiple_of(2);
        let mut told = |is_open: bool, middle_m: DVec3| {
            if is_open {
                open += 1;
                open_at_m = open_at_m.or(Some(middle_m));
            }
        };
        for (number, pair) in of_ray.windows(2).enumerate() {
            let middle_m = place_m(0.5 * (pair[0].height + pair[1].height));
            let around = winding.around(middle_m).abs();
            let is_clear = (around - 0.5).abs() > 0.25;
            // Next to one triangle that is turned or doubled, the part of the ray is short.
            told(!is_clear && !is_even && pair[1].height - pair[0].height >= SEEN, middle_m);
            let is_inside = if is_clear || !is_even { around > 0.5 } else { number % 2 == 0 };
            if is_inside {
                fill(pair);
            }
        }
        // Beyond its ends the ray is outside, if there is no hole.
        for beyond in [of_ray[0].height - SEEN, of_ray[of_ray.len() - 1].height + SEEN] {
            told(!is_even && winding.around(place_m(beyond)).abs() > 0.25, place_m(beyond));
        }
    }
    #[allow(clippy::cast_precision_loss)]
    let per_ray = 1.0 / (RAYS * RAYS) as f32;
    parts.iter_mut().for_each(|part| *part = (*part * per_ray).min(1.0));
    #[allow(clippy::cast_precision_loss)]
    Filled { parts, open_part: open as f64 / crossed.max(1) as f64, open_at_m }
}

/// Returns the place of a ray across z, in edges.
#[allow(clippy::cast_precision_loss)]
fn place_of([x, y]: [usize; 2]) -> DVec2 {
    (DVec2::new(x as f64, y as f64) + 0.5) / RAYS as f64
}

/// Returns the crossings of all rays, by ray and height.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
fn crossings(vertices_m: &[DVec3], triangles: &[[u32; 3]], lattice: &Lattice) -> Vec<RayCrossing> {
    let [columns, lines] = [lattice.cells[0] * RAYS, lattice.cells[1] * RAYS];
    let mut crossings = Vec::new();
    for triangle in triangles {
        let corners = triangle.map(|vertex| lattice.from_m(vertices_m[vertex as usize]));
        let flat = [0, 1, 2].map(|corner| (triangle[corner], corners[corner].truncate()));
        let least = flat.iter().fold(DVec2::INFINITY, |least, corner| least.min(corner.1));
        let most = flat.iter().fold(DVec2::NEG_INFINITY, |most, corner| most.max(corner.1));
        // Saturating casts. A ray's place is (number + ½)/RAYS.
        let first = |least: f64| (least * RAYS as f64 - 0.5).ceil().max(0.0) as usize;
        let end =
            |most: f64, count: usize| ((most * RAYS as f64 - 0.5).floor() + 1.0).max(0.0).min(count as f64) as usize;
        let (from, to) = ([first(least.x), first(least.y)], [end(most.x, columns), end(most.y, lines)]);
        spend(1 + to[0].saturating_sub(from[0]) * to[1].saturating_sub(from[1]));
        for y in from[1]..to[1] {
            for x in from[0]..to[0] {
                let place = place_of([x, y]);
                let sides = [0, 1, 2].map(|corner| side(flat[(corner + 1) % 3], flat[(corner + 2) % 3], place));
                // A zero counts as positive from the vertex of the lower number to the other.
                let positive = [0, 1, 2].map(|corner| {
                    let (a, b) = (flat[(corner + 1) % 3].0, flat[(corner + 2) % 3].0);
                    if sides[corner] == 0.0 { a < b } else { sides[corner] > 0.0 }
                });
                let is_up = match positive {
                    [true, true, true] => true,
                    [false, false, false] => false,
                    _ => continue,
                };
                let whole: f64 = sides.iter().sum();
                let height = (0..3).map(|corner| sides[corner] * corners[corner].z).sum::<f64>() / whole;
                if height.is_finite() {
                    let ray = (y * columns + x) as u32;
                    // A triangle that is anticlockwise seen from above has the inside below it.
                    crossings.push(RayCrossing { ray, height, into: if is_up { -1 } else { 1 } });
                }
            }
        }
    }
    spend(crossings.len());
    // At the same height a ray enters before it leaves.
    crossings.sort_by(|a, b| a.ray.cmp(&b.ray).then(a.height.total_cmp(&b.height)).then(b.into.cmp(&a.into)));
    crossings
}

/// Calls `add` with each cell of a column that an interval of heights reaches, and the length within it, in edges.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
fn add(from: f64, to: f64, cells: usize, mut add: impl FnMut(usize, f32)) {
    let (from, to) = (from.max(0.0), to.min(cells as f64));
    let mut at = from;
    while at < to {
        let cell = (at.floor() as usize).min(cells - 1);
        let end = to.min((cell + 1) as f64);
        add(cell, (end - at) as f32);
        if end <= at {
            break;
        }
        at = end;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The corners of a box, and its triangles seen from outside.
    fn block(least_m: DVec3, most_m: DVec3) -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let corner = |n: usize| DVec3::from_array(std::array::from_fn(|axis| [least_m, most_m][n >> axis & 1][axis]));
        let vertices = (0..8).map(corner).collect();
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        (vertices, quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect())
    }

    fn lattice(edge_m: f64, cells: [usize; 3]) -> Lattice {
        Lattice { origin_m: DVec3::ZERO, edge_m, cells }
    }

    #[test]
    fn a_block_fills_each_cell_by_the_part_that_it_covers() {
        let (vertices, triangles) = block(DVec3::new(0.5, 1.0, 0.25), DVec3::new(2.0, 3.0, 1.75));
        let lattice = lattice(1.0, [3, 4, 2]);
        let found = filled(&vertices, &triangles, &lattice);
        assert_eq!((found.open_part, found.open_at_m), (0.0, None));
        for k in 0..2 {
            for j in 0..4 {
                for i in 0..3 {
                    let along_x = [0.5, 1.0, 0.0][i];
                    let along_y = [0.0, 1.0, 1.0, 0.0][j];
                    let expected = along_x * along_y * 0.75;
                    assert!((found.parts[lattice.index([i, j, k])] - expected).abs() < 1e-6, "{i} {j} {k}");
                }
            }
        }
    }

    #[test]
    fn rays_through_edges_and_corners_cross_a_closed_surface_an_even_number_of_times() {
        // The planes and the diagonals of the faces pass through the rays.
        let (vertices, triangles) = block(DVec3::splat(0.125), DVec3::splat(2.125));
        let found = filled(&vertices, &triangles, &lattice(1.0, [3, 3, 3]));
        assert_eq!(found.open_part, 0.0);
        assert!((f64::from(found.parts.iter().sum::<f32>()) - 8.0).abs() < 0.8);
    }

    fn volume((vertices, triangles): &(Vec<DVec3>, Vec<[u32; 3]>)) -> f64 {
        let found = filled(vertices, triangles, &lattice(0.5, [7, 7, 7]));
        assert_eq!(found.open_part, 0.0);
        f64::from(found.parts.iter().sum::<f32>()) * 0.125
    }

    #[test]
    fn what_overlaps_counts_once() {
        let (mut vertices, mut triangles) = block(DVec3::splat(0.05), DVec3::splat(2.05));
        let (others, of_others) = block(DVec3::splat(1.05), DVec3::splat(3.05));
        vertices.extend(others);
        triangles.extend(of_others.iter().map(|triangle| triangle.map(|vertex| vertex + 8)));
        assert!((volume(&(vertices, triangles)) - 15.0).abs() < 0.01);
    }

    #[test]
    fn a_triangle_that_is_turned_round_makes_no_hole() {
        let mut surface = block(DVec3::splat(0.05), DVec3::splat(2.05));
        surface.1[0].swap(1, 2);
        assert!((volume(&surface) - 8.0).abs() < 0.01);
    }

    #[test]
    fn a_hole_is_told_with_a_place() {
        let (vertices, triangles) = block(DVec3::splat(0.05), DVec3::splat(2.05));
        // Half of the upper face is missing.
        let found = filled(&vertices, &triangles[..3], &lattice(0.5, [5, 5, 5]));
        assert!(found.open_part > 0.3 && found.open_at_m.is_some(), "{found:?}");
        assert!(found.parts.iter().all(|part| (0.0..=1.0).contains(part)));
    }
}
