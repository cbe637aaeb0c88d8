//! A triangle mesh: vertices in space, triangles between them, and what the file said besides.

use glam::DVec3;

/// A mesh of triangles. Nothing about it is promised but that indices are in range: `report` tells what is wrong with it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TriangleMesh {
    /// Where the vertices are, m, in the order of the file.
    pub vertices_m: Vec<DVec3>,
    /// Three vertices each, counterclockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Texture coordinates of each corner of each triangle, if the file has them; as long as `triangles`.
    pub uv: Option<Vec<[[f32; 2]; 3]>>,
    /// Named sets of vertices: groups, objects, materials, physical names.
    pub groups: Vec<Group>,
}

/// A named set of vertices of a mesh.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Group {
    /// As the file names it.
    pub name: String,
    /// Ascending, each once.
    pub vertices: Vec<u32>,
}
