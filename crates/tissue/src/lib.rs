//! The tissue: an immutable model, a state, and the step that advances it. No clock, no socket.
//!
//! The state is u, the displacement from rest, and d, what a substep adds to it, both in spacings. Positions are not stored: so
//! small movements keep their digits in f32. Each substep is one sweep over the springs (`sweep`), in which a scheme
//! (`integrate`) advances each point. A sheet at rest costs almost nothing: tiles sleep (`tiles`, `rest`).

mod advance;
mod applied;
pub mod audit;
mod audit_window;
mod bounds;
mod calibration;
mod change;
mod checkpoint;
mod compile;
mod contact;
mod copy;
mod correction;
mod edge;
mod field;
pub mod files;
mod footprint;
pub mod force_law;
mod grid;
pub mod guard;
pub mod integrate;
mod interface;
mod interpolate;
mod lanes;
pub mod limits;
pub mod lock;
pub mod memory;
pub mod mesh;
pub mod model;
mod motion;
mod prescribed;
mod pressure;
mod real;
mod recovery;
mod region;
pub mod representative_place;
mod rest;
mod restore;
pub mod saved;
pub mod scene;
pub mod scheme_selection;
pub mod shape;
mod springs;
pub mod stability;
mod stage;
#[cfg(test)]
mod subnormal;
mod survey;
mod sweep;
mod tables;
pub mod tangent;
pub mod texture;
mod tiles;
mod touch;
mod volume_change;

pub use applied::Push;
pub use checkpoint::CheckFailure;
pub use compile::check_processor;
pub use contact::{TangentInput, ToolContact};
pub use footprint::{Footprint, RestSurface, WeightedNode};
pub use integrate::order;
pub use interface::{BlowUp, Energy, Hashing, PointState, ReadCopy, Released, Tissue};
pub use model::{Model, Plan};
pub use motion::at_rest;
pub use prescribed::Grasp;
pub use restore::restored;
