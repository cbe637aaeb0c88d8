//! The kinds of tissue, with one folder each: `sheet` and `surface` (meshes). Each has its layout, its sweep
//! over the springs, and the contact of a disc with it.

pub(crate) mod sheet;
pub mod surface;
pub(crate) mod tables;
