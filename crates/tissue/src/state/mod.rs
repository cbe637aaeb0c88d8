//! The state of a tissue: stepping, copying, saving, restoring, and changing to another model.

pub(crate) mod change;
pub(crate) mod copy;
pub(crate) mod restore;
pub mod saved;
#[cfg(test)]
mod subnormal;
pub(crate) mod tissue_state;
