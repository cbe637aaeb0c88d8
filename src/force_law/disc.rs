//! What a tissue is pressed with, and where.

use glam::DVec3;

use super::place;
use crate::sheet::Model;

/// A tool so many radii away from the surface wants no law of the place.
const NEAR_IN_RADII: f64 = 4.0;

/// The law of a place serves a tool as far as this from it: on a sheet, and on a mesh, whose vertices lie wider.
const SERVES_IN_RADII: [f64; 2] = [0.5, 1.0];

/// What a tissue is pressed with, and where.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Disc {
    /// Its radius, m.
    pub radius_m: f64,
    /// Its middle at rest: the place of the surface that is nearest to this, m.
    pub at_m: DVec3,
}

impl Disc {
    /// In the middle of a sheet; on a mesh at the place of the surface that is nearest to the middle of the box around it.
    pub fn in_middle(model: &Model, radius_m: f64) -> Self {
        Disc { radius_m, at_m: model.shape().extent().middle_m() }
    }

    /// The disc whose law serves a tool at `place_m`: this one still, unless the tool is near the surface, at a place with
    /// another law. What moves to and fro between two places has the law of the first.
    #[must_use]
    pub fn follow(self, model: &Model, place_m: DVec3) -> Self {
        let shape = model.shape();
        let nearest_m = shape.rest_m(shape.nearest(place_m));
        if nearest_m.distance(place_m) > NEAR_IN_RADII * self.radius_m {
            return self;
        }
        let at_m = place::serving(model, self.radius_m, place_m);
        let serves_m = self.radius_m * SERVES_IN_RADII[usize::from(shape.dimensions() > 2)];
        if at_m.distance(self.at_m) <= serves_m { self } else { Disc { at_m, ..self } }
    }
}
