//! Computes the force law of a tissue under a disc from the tissue's model. The crate `palpate-haptics` evaluates it.
//!
//! An exact law takes seconds for a large sheet, so [`first`] gives a coarse law if the exact one takes too
//! much work.

mod coarse;
mod disc;
mod exact;

pub use coarse::first;
pub use disc::Disc;
pub use exact::{Computation, LawProgress, exact, exact_within};
