//! The response of a tissue at a place: tangent stiffness, force law, and the surroundings of a place.

pub(crate) mod around_place;
pub mod force_law;
pub mod mesh_error;
pub mod tangent;
