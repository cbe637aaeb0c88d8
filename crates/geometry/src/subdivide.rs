//! Splits the edges of a mesh until all are short.

use std::collections::BTreeMap;

use crate::TriangleMesh;
use crate::work::spend;

/// Splits each edge that is longer than `most_m` (m) in its middle, and again, until all edges are at most that long or
/// the mesh has more than `vertices`. The surface stays where it is. New vertices follow the others; one is in a group if
/// both ends of its edge are. Returns whether all edges are short enough.
#[allow(clippy::cast_possible_truncation)]
pub fn subdivide(mesh: &mut TriangleMesh, most_m: f64, vertices: usize) -> bool {
    loop {
        let mut middles = BTreeMap::new();
        for triangle in &mesh.triangles {
            for [a, b] in sides(*triangle) {
                let length_m = mesh.vertices_m[a as usize].distance(mesh.vertices_m[b as usize]);
                if length_m > most_m {
                    middles.insert([a.min(b), a.max(b)], 0_u32);
                }
            }
        }
        if middles.is_empty() {
            return true;
        }
        if mesh.vertices_m.len() + middles.len() > vertices {
            return false;
        }
        spend(4 * mesh.triangles.len());
        for ([a, b], middle) in &mut middles {
            *middle = mesh.vertices_m.len() as u32;
            mesh.vertices_m.push(mesh.vertices_m[*a as usize].midpoint(mesh.vertices_m[*b as usize]));
            for group in &mut mesh.groups {
                if [a, b].iter().all(|end| group.vertices.binary_search(end).is_ok()) {
                    group.vertices.push(*middle);
                }
            }
        }
        split(mesh, &middles);
    }
}

/// Returns the sides of a triangle, side k from corner k on.
fn sides([a, b, c]: [u32; 3]) -> [[u32; 2]; 3] {
    [[a, b], [b, c], [c, a]]
}

/// Splits the triangles along the edges that have a middle.
fn split(mesh: &mut TriangleMesh, middles: &BTreeMap<[u32; 2], u32>) {
    let (old, uv) = (std::mem::take(&mut mesh.triangles), mesh.uv.take());
    let mut of_new = uv.as_ref().map(|_| Vec::new());
    for (number, triangle) in old.iter().enumerate() {
        let middle = sides(*triangle).map(|[a, b]| middles.get(&[a.min(b), a.max(b)]).copied());
        // Corners 0 to 2, and the middle of side k as 3 + k.
        for part in parts(middle.map(|middle| middle.is_some())) {
            let corner = |at: usize| if at < 3 { triangle[at] } else { middle[at - 3].unwrap_or(triangle[at - 3]) };
            mesh.triangles.push(part.map(corner));
            if let (Some(of_new), Some(uv)) = (&mut of_new, &uv) {
                let between = |a: [f32; 2], b: [f32; 2]| [0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1])];
                let of = &uv[number];
                of_new.push(part.map(|at| if at < 3 { of[at] } else { between(of[at - 3], of[(at - 2) % 3]) }));
            }
        }
    }
    mesh.uv = of_new;
}

/// Returns the triangles into which a triangle falls whose sides have a middle or not: corners 0 to 2, and the middle of
/// side k as 3 + k.
fn parts(is_split: [bool; 3]) -> Vec<[usize; 3]> {
    // Turned so that the first side is split, and of two the other follows it.
    let turned = |by: usize, list: &[[usize; 3]]| -> Vec<[usize; 3]> {
        let turn = |at: usize| at / 3 * 3 + (at % 3 + by) % 3;
        list.iter().map(|part| part.map(turn)).collect()
    };
    const ONE: [[usize; 3]; 2] = [[0, 3, 2], [3, 1, 2]];
    const TWO: [[usize; 3]; 3] = [[3, 1, 4], [0, 3, 4], [0, 4, 2]];
    const ALL: [[usize; 3]; 4] = [[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]];
    match is_split {
        [false, false, false] => vec![[0, 1, 2]],
        [true, true, true] => ALL.to_vec(),
        [true, false, false] => turned(0, &ONE),
        [false, true, false] => turned(1, &ONE),
        [false, false, true] => turned(2, &ONE),
        [true, true, false] => turned(0, &TWO),
        [false, true, true] => turned(1, &TWO),
        [true, false, true] => turned(2, &TWO),
    }
}

#[cfg(test)]
mod tests {
    use glam::{DVec2, DVec3, Vec3Swizzles as _};

    use super::*;
    use crate::Group;

    #[test]
    fn edges_become_short_and_the_surface_stays_closed_and_as_large() {
        let vertices_m = vec![DVec3::ZERO, DVec3::X, 0.7 * DVec3::Y, 0.4 * DVec3::Z];
        let triangles = vec![[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]];
        let uv =
            Some(triangles.iter().map(|triangle: &[u32; 3]| triangle.map(|vertex| [vertex as f32, 1.0])).collect());
        let groups = vec![Group { name: "side".to_owned(), vertices: vec![0, 1] }];
        let mut mesh = TriangleMesh { vertices_m, triangles, uv, groups, regions: Vec::new() };
        let area = |mesh: &TriangleMesh| -> f64 {
            let of = |triangle: &[u32; 3]| {
                let [a, b, c] = triangle.map(|vertex| mesh.vertices_m[vertex as usize]);
                (b - a).cross(c - a).length()
            };
            mesh.triangles.iter().map(of).sum()
        };
        let before = area(&mesh);
        assert!(subdivide(&mut mesh, 0.15, 10_000));
        assert!(
            (area(&mesh) - before).abs() < 1e-12 && mesh.uv.as_ref().is_some_and(|uv| uv.len() == mesh.triangles.len())
        );
        let mut edges = BTreeMap::new();
        for [a, b] in mesh.triangles.iter().flat_map(|triangle| sides(*triangle)) {
            assert!(mesh.vertices_m[a as usize].distance(mesh.vertices_m[b as usize]) <= 0.15);
            *edges.entry([a.min(b), a.max(b)]).or_insert(0) += if a < b { 1 } else { -1 };
        }
        assert!(edges.values().all(|turns| *turns == 0), "each edge has a triangle at either side");
        assert!(mesh.groups[0].vertices.iter().all(|vertex| mesh.vertices_m[*vertex as usize].yz() == DVec2::ZERO));
        assert_eq!(mesh.groups[0].vertices.len(), 9);
        assert!(!subdivide(&mut mesh, 1e-3, 10_000));
    }
}
