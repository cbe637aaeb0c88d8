//! Frames for viewers: the points of a sheet, refined by bilinear interpolation, or the vertices of a mesh as they
//! are; encoded in patches.
//!
//! Frames carry no normals; viewers compute them: `clients/library/src/surface_view.rs` and `src/render/surface.rs`.

pub mod burns;
#[cfg(test)]
mod cut_surface_tests;
mod displacements;
pub mod encode;
pub mod refine;
pub mod skin;
pub mod tiles;
mod wide;
pub mod wound;

pub use displacements::Snapshot;
pub use encode::{Encoding, Frame, encode, encode_over};
pub use refine::{LARGEST_REFINEMENT, MESH_ROW, Refinement};
pub use skin::Skin;
pub use tiles::FrameTiles;
pub use wound::Wound;

/// Returns a scene with this many points along x and y, 1 cm apart.
#[cfg(test)]
fn scene([nx, ny]: [usize; 2]) -> palpate_tissue::scene::Scene {
    let sets = [format!("sheet.points=[{nx}, {ny}]"), "sheet.spacing_m=0.01".to_owned()];
    palpate_tissue::scene::Scene::parse(
        "test",
        palpate_tissue::scene::PAPER,
        &sets,
        &palpate_tissue::limits::Limits::default(),
    )
    .unwrap()
}
