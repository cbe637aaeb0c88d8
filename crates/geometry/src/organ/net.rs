//! The first mesh of a shape: surface nets of a grid whose cells resolve its thinnest part. It determines the
//! surface's topology, independent of the edge length.

use fast_surface_nets::ndshape::{RuntimeShape, Shape as _};
use fast_surface_nets::{SurfaceNetsBuffer, surface_nets};
use glam::{BVec3, DVec3};

use super::shape::Shape;
use crate::manifold_grid::fill_ambiguous;

/// A mesh near the surface of a shape.
pub(super) struct Net {
    /// Positions of the vertices, mm.
    pub(super) places: Vec<DVec3>,
    /// The axes along which each vertex must not move, because the shape is cut there.
    pub(super) held: Vec<BVec3>,
    /// Vertices of each triangle, counterclockwise seen from the positive side.
    pub(super) triangles: Vec<[u32; 3]>,
}

impl Net {
    /// Creates the net of a shape.
    pub(super) fn new(shape: &Shape) -> Net {
        // The centres of the first and last layer of cells lie at the ends of the box: vertices at a cut lie in them.
        let [least, most] = shape.extent;
        let steps = ((most - least) / shape.cell).ceil().max(DVec3::ONE);
        let cell = (most - least) / steps;
        let place = |grid_place: DVec3| least + (grid_place - 0.5) * cell;
        let exact = |point: [u32; 3]| DVec3::from_array(point.map(f64::from));
        let grid = RuntimeShape::<u32, 3>::new(steps.to_array().map(|cells| cells as u32 + 2));
        let distance = |i| (shape.distance)(place(exact(grid.delinearize(i)))) as f32;
        let mut distances: Vec<f32> = (0..grid.size()).map(distance).collect();
        fill_ambiguous(&mut distances, steps.to_array().map(|cells| cells as usize + 2));
        let mut net = SurfaceNetsBuffer::default();
        surface_nets(&distances, &grid, [0; 3], steps.to_array().map(|cells| cells as u32 + 1), &mut net);

        let cells: Vec<DVec3> = net.surface_points.iter().map(|&cell| exact(cell)).collect();
        let first_layer = |cell: DVec3| cell.cmpeq(DVec3::ZERO) & shape.cut;
        let last_layer = |cell: DVec3| cell.cmpeq(steps) & shape.cut;
        let settled = |(position, &cell): (&[f32; 3], &DVec3)| {
            let near = place(DVec3::from_array(position.map(f64::from)));
            DVec3::select(first_layer(cell), least, DVec3::select(last_layer(cell), most, near))
        };
        let places = net.positions.iter().zip(&cells).map(settled).collect();
        let held: Vec<BVec3> = cells.iter().map(|&cell| first_layer(cell) | last_layer(cell)).collect();
        // A triangle within a cut has no area.
        let triangles = net.indices.chunks_exact(3).map(|corners| [corners[0], corners[1], corners[2]]);
        let is_cut = |corners: &[u32; 3]| corners.iter().fold(BVec3::TRUE, |all, &v| all & held[v as usize]).any();
        let triangles = triangles.filter(|corners| !is_cut(corners)).collect();
        Net { places, held, triangles }.without_unused()
    }

    /// Removes vertices without triangles.
    fn without_unused(self) -> Net {
        let mut number = vec![u32::MAX; self.places.len()];
        let mut net = Net { places: Vec::new(), held: Vec::new(), triangles: self.triangles };
        for corner in net.triangles.iter_mut().flatten() {
            let old = *corner as usize;
            if number[old] == u32::MAX {
                number[old] = net.places.len() as u32;
                net.places.push(self.places[old]);
                net.held.push(self.held[old]);
            }
            *corner = number[old];
        }
        net
    }

    /// Returns the total area of the triangles, mm².
    pub(super) fn area(&self) -> f64 {
        let area = |corners: &[u32; 3]| {
            let [a, b, c] = corners.map(|v| self.places[v as usize]);
            (b - a).cross(c - a).length() / 2.0
        };
        self.triangles.iter().map(area).sum()
    }
}
