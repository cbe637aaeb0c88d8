//! The kinds of tissue: one folder a kind. Each has its layout, its sweep over the springs, and the way a disc meets it.

pub(crate) mod sheet;
pub mod surface;
pub(crate) mod tables;
