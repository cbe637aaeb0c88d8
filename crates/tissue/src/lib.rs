//! Simulates the tissue: an immutable model, a state, and the step that advances the state. It uses no clock
//! and no socket.
//!
//! The state is u, the displacement from rest, and d, what a substep adds to it, both in units of the spacing.
//! Positions are not stored, so that small movements keep their digits in f32. Each substep is one sweep over
//! the springs (`body`), in which a scheme (`scheme`) advances each point. A tissue at rest costs almost
//! nothing: its tiles sleep (`sleep`).

pub mod body;
mod compile;
pub mod files;
pub mod guard;
mod interface;
mod kernel;
pub mod limits;
pub mod lock;
pub mod memory;
pub mod model;
pub mod response;
pub mod scene;
pub mod scheme;
pub mod select;
pub mod shape;
mod sleep;
pub mod state;
pub mod texture;
mod tools;

pub use body::footprint::{Footprint, RestSurface, WeightedNode};
pub use compile::check_processor;
pub use guard::work_account::CheckFailure;
pub use interface::{BlowUp, Energy, Hashing, PointState, ReadCopy, Released, Tissue};
pub use model::{Model, Plan};
pub use scheme::order;
pub use state::restore::restored;
pub use state::stage_times::StageTimes;
pub use state::tissue_state::at_rest;
pub use tools::applied_force::Push;
pub use tools::contact::{TangentInput, ToolContact};
pub use tools::prescribed::Grasp;
