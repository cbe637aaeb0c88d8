//! The state of a tissue: advanced, copied, saved, restored, and changed to another model.

pub(crate) mod change;
pub(crate) mod copy;
pub(crate) mod restore;
pub mod saved;
#[cfg(test)]
mod subnormal;
pub(crate) mod tissue_state;
