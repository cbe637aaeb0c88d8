//! Simulates the tissue: an immutable model, a state, and the step that advances the state. It uses no clock
//! and no socket.
//!
//! The state is u, the displacement from rest, and d, what a substep adds to it, both in units of the spacing.
//! Positions are not stored, so that small movements keep their digits in f32. Each substep is one sweep over
//! the springs (`body`), in which a scheme (`scheme`) advances each point. A tissue at rest costs almost
//! nothing: its tiles sleep (`state::sleep`).

mod audit_window;
pub mod body;
mod compile;
pub mod files;
mod interface;
mod kernel;
pub mod limits;
pub mod lock;
pub mod memory;
pub mod response;
pub mod saved;
pub mod scene;
pub mod scheme;
pub mod select;
pub mod shape;
mod stage_times;
pub mod state;
mod tools;

pub use body::footprint::{Footprint, RestSurface, WeightedNode};
pub use body::model::{self, Model, Plan};
pub use body::severed::{Cuts, SeveredJoint};
pub use body::solid::cut_surface::{CutFace, CutSurface, CutVertex};
pub use compile::check_processor;
pub use interface::{BlowUp, CheckFailure, Energy, Hashing, PointState, ReadCopy, Released, Tissue};
pub use scheme::order;
pub use stage_times::StageTimes;
pub use state::guard;
pub use state::restore::restored;
pub use state::tissue_state::at_rest;
pub use tools::applied_force::Push;
pub use tools::burns::{Burns, BurntPoint};
pub use tools::contact::{TangentInput, ToolContact};
pub use tools::prescribed::Grasp;
pub use tools::rigid_tip::rigid_tip_work;
pub use tools::tie::TieState;
