//! The closed surface around the filled cubes of a lattice, for meshes that have an inside and are no surface.

use fast_surface_nets::ndshape::RuntimeShape;
use fast_surface_nets::{SurfaceNetsBuffer, surface_nets};
use glam::DVec3;

use crate::TriangleMesh;
use crate::fill::Lattice;
use crate::manifold_grid::fill_ambiguous;
use crate::work::spend;

/// A cube whose part is nearer to one half than this counts as filled by so much more than one half: vertices around the middle of
/// one that is filled by exactly one half would be at the same place.
const NEAREST: f32 = 0.01;

/// Returns the surface at which `parts`, the filled part of each cube ([`Lattice::index`]), is one half between the middles
/// of neighbouring cubes (surface nets). Cubes beyond the lattice are empty. The surface is closed and faces outward; it is
/// empty if no cube is filled by more than half. What is thinner than a cube may be missing.
///
/// Panics if `parts` has fewer entries than the lattice has cubes.
pub fn surface_of(parts: &[f32], lattice: &Lattice) -> TriangleMesh {
    // A layer of empty cubes all around.
    let points = lattice.cells.map(|cells| cells + 2);
    #[allow(clippy::cast_possible_truncation)]
    let sides = points.map(|count| count as u32);
    let grid = RuntimeShape::<u32, 3>::new(sides);
    let mut distances = vec![0.5_f32; points.iter().product()];
    spend(distances.len());
    for k in 0..lattice.cells[2] {
        for j in 0..lattice.cells[1] {
            for i in 0..lattice.cells[0] {
                let at = ((k + 1) * points[1] + j + 1) * points[0] + i + 1;
                let distance = 0.5 - parts[lattice.index([i, j, k])];
                distances[at] = if distance.abs() < NEAREST { -NEAREST } else { distance };
            }
        }
    }
    fill_ambiguous(&mut distances, points);
    let mut net = SurfaceNetsBuffer::default();
    surface_nets(&distances, &grid, [0; 3], sides.map(|count| count - 1), &mut net);
    let place_m =
        |position: &[f32; 3]| lattice.origin_m + lattice.edge_m * (DVec3::from_array(position.map(f64::from)) - 0.5);
    TriangleMesh {
        vertices_m: net.positions.iter().map(place_m).collect(),
        triangles: net.indices.chunks_exact(3).map(|corners| [corners[0], corners[1], corners[2]]).collect(),
        ..TriangleMesh::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fill::filled;
    use crate::organ::{Organ, generate};
    use crate::report;

    #[test]
    fn the_surface_of_filled_cubes_is_closed_and_encloses_what_they_fill() {
        let mesh = generate(Organ::Kidney, 4e-3, 1).unwrap();
        let least = mesh.vertices_m.iter().copied().fold(DVec3::INFINITY, DVec3::min);
        let lattice = Lattice { origin_m: least, edge_m: 2e-3, cells: [70, 60, 40] };
        let parts = filled(&mesh.vertices_m, &mesh.triangles, &lattice).parts;
        let surface = surface_of(&parts, &lattice);
        let (found, truth) = (report(&surface), report(&mesh));
        assert!(found.refusal().is_none() && found.holes == 0, "{found:?}");
        let ratio = found.volume_m3.unwrap() / truth.volume_m3.unwrap();
        assert!((ratio - 1.0).abs() < 0.02, "{ratio}");
    }

    #[test]
    fn a_cube_that_is_filled_by_one_half_makes_no_edge_without_length() {
        let lattice = Lattice { origin_m: DVec3::ZERO, edge_m: 1.0, cells: [3, 3, 3] };
        for others in [0.0, 1.0] {
            let mut parts = [others; 27];
            parts[13] = 0.5;
            let surface = surface_of(&parts, &lattice);
            let edges = surface.triangles.iter().flat_map(|[a, b, c]| [[*a, *b], [*b, *c], [*c, *a]]);
            let shortest = edges
                .map(|ends| ends.map(|end| surface.vertices_m[end as usize]))
                .map(|[a, b]| a.distance(b))
                .min_by(f64::total_cmp);
            assert!(shortest.is_some_and(|length| length > 1e-3), "{others}: {shortest:?}");
        }
    }

    #[test]
    fn nothing_filled_has_no_surface() {
        let lattice = Lattice { origin_m: DVec3::ZERO, edge_m: 1.0, cells: [2, 3, 4] };
        assert_eq!(surface_of(&[0.0; 24], &lattice).triangles.len(), 0);
    }
}
