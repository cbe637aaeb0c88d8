//! How a tissue responds at a place: tangent, force law, and what lies around a point.

pub(crate) mod around_place;
pub mod force_law;
pub mod representative_place;
pub mod tangent;
