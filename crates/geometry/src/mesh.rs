//! A triangle mesh: vertices, triangles, texture coordinates and groups.

use glam::DVec3;

/// A triangle mesh. Only indices are guaranteed to be in range; `report` lists its faults.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TriangleMesh {
    /// Positions of the vertices, m, in the order of the file.
    pub vertices_m: Vec<DVec3>,
    /// Three vertex indices per triangle, counterclockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Texture coordinates (u, v) of each corner of each triangle, if the file has them; as many as `triangles`.
    pub uv: Option<Vec<[[f32; 2]; 3]>>,
    /// Named sets of vertices: groups, objects, materials or physical names of the file.
    pub groups: Vec<Group>,
}

impl TriangleMesh {
    /// Removes the triangles for which `keep` is false, with their texture coordinates.
    pub(crate) fn keep_triangles(&mut self, keep: &[bool]) {
        let mut kept = keep.iter();
        self.triangles.retain(|_| *kept.next().unwrap_or(&true));
        if let Some(uv) = &mut self.uv {
            let mut kept = keep.iter();
            uv.retain(|_| *kept.next().unwrap_or(&true));
        }
    }

    /// Reverses the triangles for which `is_turned` is true.
    pub(crate) fn turn_triangles(&mut self, is_turned: &[bool]) {
        for (triangle, _) in self.triangles.iter_mut().zip(is_turned).filter(|(_, is_turned)| **is_turned) {
            triangle.swap(1, 2);
        }
        for (uv, _) in self.uv.iter_mut().flatten().zip(is_turned).filter(|(_, is_turned)| **is_turned) {
            uv.swap(1, 2);
        }
    }

    /// Writes the texture coordinates of each vertex to `into`, if there are any; at a seam, those of its first
    /// corner.
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
    /// Name of the set in the file.
    pub name: String,
    /// Vertex indices, ascending and unique.
    pub vertices: Vec<u32>,
}
