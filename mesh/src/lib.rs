//! Triangle meshes of organs: read from files, checked, mended, written, generated. No tissue, no network, no clock.

mod curvature;
pub mod decimate;
pub mod delaunay;
pub mod format;
pub mod mesh;
pub mod organ;
pub mod problem;
pub mod read;
pub mod repair;
pub mod report;
pub mod surface;
pub mod topology;
mod tree;
pub mod unit;
pub mod write;

pub use mesh::{Group, TriangleMesh};
pub use problem::{Element, MeshError, Problem};
pub use read::{ReadLimits, ReadMesh, read};
pub use report::{Report, report};
pub use unit::Unit;
