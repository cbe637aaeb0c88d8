//! What acts on a solid besides its cubes and its fixed points: a foundation under all of its surface, and gravity.

use glam::DVec3;

use super::shape::SolidShape;
use crate::scene::toml_document::Item;
use crate::shape::RestShape;
use palpate_refusal::{Reason, Refusal, Result};

/// Largest acceleration, m/s²: a hundred times that of the Earth.
const MAX_ACCELERATION_M_PER_S2: f64 = 1000.0;

/// The section `[gravity]` of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Gravity {
    /// The acceleration, m/s²; 0 without gravity.
    pub acceleration_m_per_s2: DVec3,
    /// Whether the shape of the file is that under gravity: stresses that are not modelled balance the weight. Otherwise it is the
    /// shape without weight, and the tissue sags from its first step on.
    pub is_loaded: bool,
}

impl Gravity {
    /// Message of the refusal of gravity on another tissue ([`Reason::WrongKind`]).
    pub const OF_A_SOLID: &str = "is for a solid: the rest shape of other tissues is that under gravity";

    pub(in crate::scene) fn read(item: &Item<'_>) -> Result<Self> {
        item.table(|fields| {
            Ok(Gravity {
                acceleration_m_per_s2: fields.required("acceleration_m_per_s2")?.vector()?,
                is_loaded: fields.item("loaded").map_or(Ok(false), |item| item.flag())?,
            })
        })
    }

    /// Refuses an acceleration that is not finite or above 1000 m/s².
    pub(super) fn check(&self) -> Result<()> {
        if self.acceleration_m_per_s2.length() <= MAX_ACCELERATION_M_PER_S2 {
            return Ok(());
        }
        let message = format!("must be at most {MAX_ACCELERATION_M_PER_S2} m/s² long");
        Err(Refusal::new(Reason::OutOfRange, "gravity.acceleration_m_per_s2", message))
    }

    /// Returns the acceleration that stress must balance, m/s².
    pub(crate) fn pull_m_per_s2(&self) -> DVec3 {
        if self.is_loaded { DVec3::ZERO } else { self.acceleration_m_per_s2 }
    }
}

/// Returns the area of the surface that each point carries, in faces of a cube: a third of each triangle's for each of its vertices, and of
/// that to each corner of the cube of a vertex the part with which it moves it.
pub(super) fn areas(shape: &SolidShape) -> Vec<f64> {
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
