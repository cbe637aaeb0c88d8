//! Computes the force law of a tissue under a disc from the tissue's model. The crate `palpate-haptics` evaluates it.
//!
//! An exact law takes seconds for a large sheet, so [`first`] gives a coarse law if the exact one takes too
//! much work.

mod coarse;
mod disc;
mod exact;

use palpate_haptics::{Law, TipShape};

use crate::body::model::Model;
use crate::scene::Body;

pub use coarse::first;
pub use disc::Disc;
pub use exact::{Computation, LawProgress, exact, exact_within};

/// Returns the law of a tip of `shape`, from that of a disc of `radius_m` (m) with an even pressure: the same law, if no rigid tip
/// touches the tissue ([`Law::of_tip`]).
pub fn of_tip(model: &Model, law: Law, shape: TipShape, radius_m: f64) -> Law {
    let Body::Solid(solid) = &model.scene.body else { return law };
    let nu = solid.material.poissons_ratio;
    law.of_tip(shape, radius_m, model.youngs_modulus_pa() / (1.0 - nu * nu))
}
