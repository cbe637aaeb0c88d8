//! Triangle meshes of organs: read from files, checked, mended, written, generated. No tissue, no network, no clock.

pub mod mesh;
pub mod organ;

pub use mesh::{Group, TriangleMesh};
