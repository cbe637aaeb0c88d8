//! The state of a tissue: the stages of its step, its readings, what changes it otherwise, its copies, and how it is
//! restored.

mod copy;
pub(crate) mod cutting;
mod grasping;
pub mod guard;
mod guarded;
mod point_reader;
mod position_control;
pub(crate) mod restore;
pub(crate) mod sleep;
mod step;
pub(crate) mod step_context;
#[cfg(test)]
mod subnormal;
pub(crate) mod tissue_state;
mod tying;
