//! The foundation under the surface of a solid: each part of it is pulled back to where it rests, by a stiffness for each area and
//! displacement (Winkler).

use std::sync::Arc;

use super::shape::SolidShape;
use crate::shape::{PointId, RestShape};

/// A foundation under all of a solid's surface.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Foundation {
    /// Stiffness, N/m³; 0 without a foundation.
    pub(super) n_per_m3: f64,
    /// Area of the surface that each point carries, in faces of a cube; empty without a foundation.
    areas: Arc<[f64]>,
    /// Area of a face of a cube, m².
    face_m2: f64,
    /// The largest stiffness at a point that moves, divided by its relative mass, N/m.
    pub(super) bound_n_per_m: f64,
}

impl Foundation {
    /// Creates a foundation of a stiffness above 0, N/m³. `masses` is the relative mass of each point.
    pub(super) fn new(n_per_m3: f64, shape: &SolidShape, masses: &[f64]) -> Self {
        let areas = areas(shape).into();
        let mut foundation =
            Foundation { n_per_m3, areas, face_m2: shape.lattice().edge_m.powi(2), bound_n_per_m: 0.0 };
        let moving = crate::shape::points(shape).filter(|point| !shape.is_fixed(*point));
        let of_mass = |point: PointId| foundation.n_per_m(point) / masses[point.index()];
        foundation.bound_n_per_m = moving.map(of_mass).fold(0.0, f64::max);
        foundation
    }

    /// Returns the stiffness with which a point is pulled back, N/m.
    pub(super) fn n_per_m(&self, point: PointId) -> f64 {
        let area_m2 = self.areas.get(point.index()).copied().unwrap_or(0.0) * self.face_m2;
        self.n_per_m3 * area_m2
    }
}

/// Returns the area of the surface that each point carries, in faces of a cube: a third of each triangle's for each of its vertices, and of
/// that to each corner of the cube of a vertex the part with which it moves it.
fn areas(shape: &SolidShape) -> Vec<f64> {
    let mut areas = vec![0.0; shape.point_count()];
    let (surface, face_m2) = (shape.surface(), shape.lattice().edge_m.powi(2));
    let vertices_m = surface.vertices_m();
    for triangle in surface.triangles() {
        let [a, b, c] = triangle.map(|vertex| vertices_m[vertex as usize]);
        let third = (b - a).cross(c - a).length() / 6.0 / face_m2;
        for vertex in triangle {
            let place = shape.cell_of(*vertex as usize);
            for (point, weight) in place.points.iter().zip(place.weights) {
                areas[*point as usize] += third * weight;
            }
        }
    }
    areas
}
