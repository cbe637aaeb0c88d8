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
    /// Keeps the triangles for which `keep` is true, with their texture coordinates.
    pub(crate) fn keep_triangles(&mut self, keep: &[bool]) {
        let mut kept = keep.iter();
        self.triangles.retain(|_| *kept.next().unwrap_or(&true));
        if let Some(uv) = &mut self.uv {
            let mut kept = keep.iter();
            uv.retain(|_| *kept.next().unwrap_or(&true));
        }
    }

    /// Turns the triangles for which `is_turned` is true to their other side.
    pub(crate) fn turn_triangles(&mut self, is_turned: &[bool]) {
        for (triangle, _) in self.triangles.iter_mut().zip(is_turned).filter(|(_, is_turned)| **is_turned) {
            triangle.swap(1, 2);
        }
        for (uv, _) in self.uv.iter_mut().flatten().zip(is_turned).filter(|(_, is_turned)| **is_turned) {
            uv.swap(1, 2);
        }
    }

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
