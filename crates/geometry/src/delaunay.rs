//! Flips edges until the triangles are Delaunay: springs along such edges resist stretch most evenly.

use std::collections::{HashMap, VecDeque};

use glam::DVec3;

use crate::TriangleMesh;
use crate::report::has_area;
use crate::topology::{Topology, is_proper};
use crate::work::spend;

/// Number of edge checks per edge of the mesh; on curved surfaces, flips need not end by themselves.
const LOOKS: usize = 20;

/// Cosine of the angle between two triangles below which their common edge is a fold of the surface and is not
/// flipped.
const FOLD: f64 = 0.5;

/// An edge with the vertices opposite it: its triangles are (a, b, c) and (b, a, d).
struct Diamond {
    a: u32,
    b: u32,
    c: u32,
    d: u32,
}

/// Flips edges between two triangles until the sum of the angles opposite each edge is at most π, or until it has
/// looked at 20 edges per edge of the mesh. Does not flip border edges, folds of more than 60°, seams of the texture,
/// and edges at a vertex with three edges. Vertices and groups do not change; a flip changes two triangles in place,
/// with their texture coordinates. Returns the number of flips. Coordinates must be finite and indices in range.
///
/// With α and β these angles, α + β ≤ π is cot α + cot β = sin(α + β)/(sin α·sin β) ≥ 0, and cot α = u·v/|u × v| for
/// the sides u and v from the corner to the ends of the edge.
pub fn flip_to_delaunay(mesh: &mut TriangleMesh) -> usize {
    flip(mesh, |vertices, edge| {
        let at = |vertex: u32| vertices[vertex as usize];
        // Negative if the sum of the angles opposite the edge is more than π.
        let cotangent = |apex: u32| {
            let (u, v) = (at(edge.a) - at(apex), at(edge.b) - at(apex));
            u.dot(v) / u.cross(v).length()
        };
        cotangent(edge.c) + cotangent(edge.d) < -1e-9
    })
}

/// Flips the longest edge of each triangle that has three different vertices but no area, so that both triangles get
/// one. Returns the number of flips.
pub(crate) fn flip_degenerate(mesh: &mut TriangleMesh) -> usize {
    flip(mesh, |vertices, edge| {
        let length = |a: u32, b: u32| vertices[a as usize].distance_squared(vertices[b as usize]);
        let is_flat = |apex: u32| {
            let longest = length(edge.a, edge.b);
            !has_area(vertices, [edge.a, edge.b, apex])
                && longest > length(edge.b, apex)
                && longest > length(apex, edge.a)
        };
        is_flat(edge.c) != is_flat(edge.d)
    })
}

fn flip(mesh: &mut TriangleMesh, wants: impl Fn(&[DVec3], &Diamond) -> bool) -> usize {
    let topology = Topology::new(mesh.vertices_m.len(), &mesh.triangles);
    let vertices = &mesh.vertices_m;
    let mut valence = topology.valence.clone();
    // The triangle on the left of each directed edge; only looked up. `None` if there are several.
    let mut left: HashMap<[u32; 2], Option<u32>> = HashMap::new();
    for (number, triangle) in (0..).zip(&mesh.triangles).filter(|(_, triangle)| is_proper(triangle)) {
        for corner in 0..3 {
            let edge = [triangle[corner], triangle[(corner + 1) % 3]];
            left.entry(edge).and_modify(|other| *other = None).or_insert(Some(number));
        }
    }
    let mut waiting: VecDeque<[u32; 2]> = topology.edges.iter().map(|edge| edge.vertices).collect();
    let (mut flips, mut looks) = (0, LOOKS * waiting.len());
    while let Some([a, b]) = waiting.pop_front() {
        if looks == 0 {
            break;
        }
        looks -= 1;
        spend(4);
        let of = |edge: [u32; 2]| left.get(&edge).copied().flatten();
        let (Some(first), Some(second)) = (of([a, b]), of([b, a])) else { continue };
        let opposite = |triangle: u32| {
            mesh.triangles[triangle as usize].into_iter().find(|vertex| *vertex != a && *vertex != b).unwrap_or(a)
        };
        let diamond = Diamond { a, b, c: opposite(first), d: opposite(second) };
        let (c, d) = (diamond.c, diamond.d);
        let is_free = c != d && !left.contains_key(&[c, d]) && !left.contains_key(&[d, c]);
        // Each end must have more than three edges, or the surface would fold onto itself.
        let is_rich = valence[a as usize] > 3 && valence[b as usize] > 3;
        if !is_free || !is_rich || !wants(vertices, &diamond) || !stays_smooth(vertices, &diamond) {
            continue;
        }
        if let Some(uv) = &mut mesh.uv {
            let corner = |triangle: u32, vertex: u32| {
                let place = mesh.triangles[triangle as usize].iter().position(|other| *other == vertex);
                uv[triangle as usize][place.unwrap_or(0)]
            };
            if corner(first, a) != corner(second, a) || corner(first, b) != corner(second, b) {
                continue;
            }
            let [ua, ub, uc, ud] = [corner(first, a), corner(first, b), corner(first, c), corner(second, d)];
            uv[first as usize] = [ua, ud, uc];
            uv[second as usize] = [ud, ub, uc];
        }
        mesh.triangles[first as usize] = [a, d, c];
        mesh.triangles[second as usize] = [d, b, c];
        left.remove(&[a, b]);
        left.remove(&[b, a]);
        for (triangle, edges) in [(first, [[a, d], [d, c], [c, a]]), (second, [[d, b], [b, c], [c, d]])] {
            for edge in edges {
                // If several triangles are on the left of an edge, it stays unknown.
                left.entry(edge).and_modify(|other| *other = other.map(|_| triangle)).or_insert(Some(triangle));
            }
        }
        for vertex in [a, b] {
            valence[vertex as usize] -= 1;
        }
        for vertex in [c, d] {
            valence[vertex as usize] += 1;
        }
        waiting.extend([[a, d], [d, b], [b, c], [c, a]]);
        flips += 1;
    }
    flips
}

/// Returns whether the surface has no fold at an edge, and faces the same side after its flip.
fn stays_smooth(vertices: &[DVec3], edge: &Diamond) -> bool {
    let normal = |triangle: [u32; 3]| {
        let [a, b, c] = triangle.map(|vertex| vertices[vertex as usize]);
        (b - a).cross(c - a)
    };
    let Diamond { a, b, c, d } = *edge;
    let (first, second) = (normal([a, b, c]), normal([b, a, d]));
    let sum = first + second;
    let new = [[a, d, c], [d, b, c]];
    // The normal of a triangle without area is only rounding error.
    let is_flat = !has_area(vertices, [a, b, c]) || !has_area(vertices, [b, a, d]);
    (is_flat || first.dot(second) >= FOLD * first.length() * second.length())
        && new.iter().all(|triangle| normal(*triangle).dot(sum) > 0.0 && has_area(vertices, *triangle))
}
