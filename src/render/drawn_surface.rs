//! What is drawn of a tissue: vertices, triangles and lines in space.

use glam::{DVec2, DVec3};

#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Vertex {
    /// Position, m.
    pub(super) at_m: DVec3,
    /// Unit normal out of the tissue.
    pub(super) normal: DVec3,
    /// Texture coordinates, 0 to 1 along x and along y.
    pub(super) share: DVec2,
    /// For a mesh without texture coordinates: position at rest, 0 to 1 over the longest side, and how far the
    /// surface faces each axis.
    pub(super) rest: DVec3,
    pub(super) facing: DVec3,
    /// Fraction of ambient light that reaches the vertex: less in a dent.
    pub(super) open: f64,
    /// How burnt it is, 0 to 1.
    pub(super) burn: f64,
}

/// The vertices, triangles and lines that are drawn.
#[derive(Debug)]
pub(super) struct DrawnSurface {
    pub(super) vertices: Vec<Vertex>,
    pub(super) triangles: Vec<[usize; 3]>,
    /// The ends of the lines that show the mesh.
    pub(super) lines: Vec<[usize; 2]>,
    /// Approximate number of vertices along a side.
    pub(super) along: usize,
    pub(super) wound: DrawnWound,
}

/// What is drawn of a wound besides the surface.
#[derive(Debug, Default)]
pub(super) struct DrawnWound {
    /// Corners of the triangles of tissue beneath the lips, m.
    pub(super) bed_m: Vec<[DVec3; 3]>,
    /// The ends of the lines along both lips, by the vertices of the surface.
    pub(super) lips: Vec<[usize; 2]>,
    /// The triangles of the surface within the cuts of a solid, which has no bed.
    pub(super) cut_surface: Vec<[Vertex; 3]>,
}
