//! Computes the force law of a tissue under a disc from the tissue's model. The crate `palpate-touch` evaluates it.
//!
//! An exact law takes seconds for a large sheet, so [`first`] gives a coarse law where the exact one takes too much work.

mod coarse;
mod exact;

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

pub use coarse::first;
pub use exact::{Computation, Progress, exact, exact_within};
