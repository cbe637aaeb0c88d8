//! The first mesh of a shape: surface nets of a grid whose cells resolve its thinnest part. It determines the
//! surface's topology, independent of the edge length.

use fast_surface_nets::ndshape::{RuntimeShape, Shape as _};
use fast_surface_nets::{SurfaceNetsBuffer, surface_nets};
use glam::{BVec3, DVec3};

use super::shape::Shape;

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

/// Distance set at a grid point that is filled, mm.
const FILLED: f32 = -1e-3;

/// Corners 0 to 7 of a cell have x, y and z in bits 0 to 2. The two diagonals of each of its six faces, as sets of
/// corners.
const FACES: [[u8; 2]; 6] = [
    [0b0000_1001, 0b0000_0110],
    [0b1001_0000, 0b0110_0000],
    [0b0010_0001, 0b0001_0010],
    [0b1000_0100, 0b0100_1000],
    [0b0100_0001, 0b0001_0100],
    [0b1000_0010, 0b0010_1000],
];

/// The four diagonals through a cell, as sets of corners.
const THROUGH: [u8; 4] = [0b1000_0001, 0b0100_0010, 0b0010_0100, 0b0001_1000];

/// Makes grid points negative until the surface between negative and positive ones is a manifold: it is not if the
/// signs at a face alternate, or two opposite corners of a cell differ from all others (Latecki, Eckhardt and
/// Rosenfeld, "Well-composed sets", 1995). That happens where a surface grazes the grid. Points are only ever filled,
/// so this ends.
fn fill_ambiguous(distances: &mut [f32], points: [usize; 3]) {
    let strides = [1, points[0], points[0] * points[1]];
    let corner = |origin: usize, corner: usize| {
        origin + (0..3).filter(|axis| corner >> axis & 1 == 1).map(|axis| strides[axis]).sum::<usize>()
    };
    loop {
        let mut is_manifold = true;
        for cell in 0..(points[0] - 1) * (points[1] - 1) * (points[2] - 1) {
            let (row, x) = (cell / (points[0] - 1), cell % (points[0] - 1));
            let origin = x + row % (points[1] - 1) * strides[1] + row / (points[1] - 1) * strides[2];
            let inside = (0..8).fold(0, |set, i| set | u8::from(distances[corner(origin, i)] < 0.0) << i);
            if inside == 0 || inside == u8::MAX {
                continue;
            }
            let face = FACES.iter().find_map(|&[one, other]| match (inside & one, inside & other) {
                (0, within) if within == other => Some(one),
                (within, 0) if within == one => Some(other),
                _ => None,
            });
            let is_through = THROUGH.contains(&inside) || THROUGH.contains(&!inside);
            let Some(outside) = face.or(is_through.then_some(!inside)) else { continue };
            let candidates = (0..8).filter(|i| outside >> i & 1 == 1).map(|i| corner(origin, i));
            // The candidate nearest to the surface.
            if let Some(nearest) = candidates.min_by(|&one, &other| distances[one].total_cmp(&distances[other])) {
                distances[nearest] = FILLED;
                is_manifold = false;
            }
        }
        if is_manifold {
            return;
        }
    }
}
