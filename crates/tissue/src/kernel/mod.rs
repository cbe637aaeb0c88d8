//! The kernel: vectors, number formats, fields, springs, and the stage that a sweep runs for each block of
//! points.

pub(crate) mod field;
pub(crate) mod lanes;
pub(crate) mod real;
pub(crate) mod region;
pub(crate) mod springs;
pub(crate) mod stage;
