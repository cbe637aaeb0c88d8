//! The tissue: an immutable model, a state, and the step that advances it. No clock, no socket.
//!
//! The state is u, the displacement from rest, and d, what a substep adds to it, both in spacings. Positions are not stored: so
//! small movements keep their digits in f32. Each substep is one sweep over the springs (`sweep`), in which a scheme
//! (`integrate`) advances each point. A sheet at rest costs almost nothing: tiles sleep (`tiles`, `rest`).

mod advance;
pub mod alike;
mod applied;
mod around;
pub mod audit;
mod audit_window;
mod bounds;
mod change;
mod checkpoint;
pub mod choice;
mod compile;
mod contact;
mod copy;
mod correction;
#[cfg(test)]
mod decay;
mod edge;
mod field;
mod footprint;
mod grid;
pub mod guard;
pub mod integrate;
mod lanes;
pub mod mesh;
pub mod model;
mod motion;
mod prescribed;
mod pressure;
mod real;
mod recovery;
mod region;
mod rehearsal;
mod rest;
mod restore;
pub mod saved;
mod springs;
pub mod stability;
mod stage;
mod survey;
mod sweep;
mod swelling;
mod tables;
pub mod tangent;
mod tiles;
mod tissue;
mod touch;

pub use applied::Push;
pub use checkpoint::CheckFailure;
pub use contact::{Feel, Surroundings};
pub use footprint::{Footprint, Reached, RestSurface};
pub use integrate::order;
pub use model::{Model, Plan};
pub use motion::at_rest;
pub use prescribed::Grasp;
pub use restore::restored;
pub use tissue::{BlowUp, Energy, Hashing, PointState, Released, SheetCopy, Tissue};
