//! What a tissue is pressed with, and where.

use glam::DVec3;

use crate::sheet::Model;

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
}
