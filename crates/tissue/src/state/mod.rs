//! The state of a tissue: its step, its readings, what changes it otherwise, its copies, and how it is saved and restored.

pub(crate) mod context;
mod copy;
mod guarded;
mod reading;
pub(crate) mod restore;
pub mod saved;
pub(crate) mod stage_times;
mod step;
#[cfg(test)]
mod subnormal;
pub(crate) mod tissue_state;
