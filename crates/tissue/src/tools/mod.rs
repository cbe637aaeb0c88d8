//! What tools do to a tissue: forces, prescribed displacements, and contact of a tip's disc (`contact`) or of a rigid tip.

pub(crate) mod applied_force;
pub(crate) mod blade;
pub(crate) mod contact;
pub(crate) mod input;
pub(crate) mod prescribed;
pub(crate) mod rigid_tip;
