//! Sheets: mass points in rows and columns.

pub(crate) mod cuts;
pub(crate) mod edge;
pub(crate) mod falloff;
pub(crate) mod footprint;
pub(crate) mod grid;
pub(crate) mod sweep;
pub(crate) mod tiles;
