//! What tools do to a tissue: forces, prescribed displacements, and contact of a tip's disc.

pub(crate) mod applied_force;
pub(crate) mod contact;
pub(crate) mod input;
pub(crate) mod prescribed;
