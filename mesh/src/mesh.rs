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

impl TriangleMesh {
    /// Writes the texture coordinates of each vertex, if the file has them; at a seam those of the first corner there.
    pub fn write_vertex_uv(&self, into: &mut [[f32; 2]]) {
        // Backwards, so that the first corner is written last.
        for (triangle, corners) in self.triangles.iter().zip(self.uv.as_deref().unwrap_or_default()).rev() {
            triangle.iter().zip(corners).for_each(|(vertex, uv)| into[*vertex as usize] = *uv);
        }
    }
}

/// A named set of vertices of a mesh.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Group {
    /// As the file names it.
    pub name: String,
    /// Ascending, each once.
    pub vertices: Vec<u32>,
}
