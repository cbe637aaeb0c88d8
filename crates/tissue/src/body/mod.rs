//! The kinds of tissue, with one folder each: `sheet` and `surface` (meshes). Each has its layout, its sweep
//! over the springs, and the contact of a disc with it.

pub(crate) mod footprint;
pub(crate) mod sheet;
pub mod surface;
pub(crate) mod tables;

use std::sync::Arc;

use crate::kernel::field::BLOCK;
use crate::scene::{Body, Scene};
use crate::shape::{self, RestShape};
use surface::{GraphFault, MeshPlaces};

/// The points of a scene in memory.
pub(crate) struct MemoryLayout {
    /// Rows and columns: those of a sheet, or the slots of a mesh in rows of [`BLOCK`].
    pub(crate) points: [usize; 2],
    /// Row-major places of the fixed points, ascending.
    pub(crate) fixed: Vec<usize>,
    /// The places of a mesh's points, and its springs; `None` for a sheet.
    pub(crate) graph: Option<Arc<MeshPlaces>>,
}

impl MemoryLayout {
    /// Lays out the points of a scene.
    ///
    /// # Errors
    /// Returns the fault of a mesh whose springs can't be laid out.
    pub(crate) fn of(scene: &Scene) -> Result<Self, GraphFault> {
        Ok(match &scene.body {
            Body::Sheet(sheet) => MemoryLayout { points: sheet.points, fixed: sheet.fixed_indices(), graph: None },
            Body::Mesh(mesh) => {
                let graph = MeshPlaces::of(mesh)?;
                let points = shape::points(&*mesh.shape).filter(|point| mesh.shape.is_fixed(*point));
                let mut fixed: Vec<usize> = points.map(|point| graph.slot_of(point)).collect();
                fixed.sort_unstable();
                MemoryLayout { points: [graph.rows(), BLOCK], fixed, graph: Some(Arc::new(graph)) }
            }
        })
    }
}

/// Adds what tells the tissue of `scene` from another with the same coefficients to the bytes of its identity: its
/// kind, and on a mesh also points, order in memory and springs.
pub(crate) fn identify(scene: &Scene, graph: Option<&MeshPlaces>, add: &mut impl FnMut(&[u8])) {
    match (&scene.body, graph) {
        (Body::Mesh(mesh), Some(graph)) => surface::identify(mesh, graph, add),
        _ => add(b"sheet"),
    }
}
