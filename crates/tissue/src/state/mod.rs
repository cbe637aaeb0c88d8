//! The state of a tissue: its step, its readings, what changes it otherwise, its copies, and how it is saved and restored.

mod copy;
mod guarded;
mod point_reader;
pub(crate) mod restore;
pub mod saved;
pub(crate) mod stage_times;
mod step;
pub(crate) mod step_context;
#[cfg(test)]
mod subnormal;
pub(crate) mod tissue_state;
