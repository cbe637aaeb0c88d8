//! Triangle meshes of organs: reading, checking, repairing, writing and generating them. Independent of tissue,
//! network and clock.

pub mod cell_surface;
mod curvature;
pub mod decimate;
pub mod delaunay;
pub mod dice;
pub mod fill;
pub mod format;
mod join;
mod manifold_grid;
pub mod mesh;
pub mod organ;
mod orient;
pub mod prepare;
pub mod problem;
mod ray;
pub mod read;
pub mod repair;
pub mod report;
pub mod subdivide;
pub mod surface;
pub mod top;
pub mod topology;
mod tree;
pub mod unit;
mod walls;
mod winding;
pub mod work;
pub mod write;

pub use mesh::{Group, TriangleMesh, VolumeRegion};
pub use prepare::{FileMesh, Prepared, prepare};
pub use problem::{Element, MeshError, Problem};
pub use read::{ReadLimits, ReadMesh, read, read_label, read_paid};
pub use report::{MeshReport, report};
pub use unit::Unit;
