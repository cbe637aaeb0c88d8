//! A triangle mesh: vertices, triangles, texture coordinates and groups.

use glam::DVec3;

/// A triangle mesh. One that [`crate::read()`] returns has finite coordinates, indices in range and lists of matching
/// lengths; nothing else is guaranteed, and of a mesh composed otherwise not even that. [`crate::report()`] lists its
/// faults.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TriangleMesh {
    /// Positions of the vertices, m, in the order of the file.
    pub vertices_m: Vec<DVec3>,
    /// Three vertex indices per triangle, from 0, counterclockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Texture coordinates (u, v) of each corner of each triangle, in the order of `triangles` and as many; `None` if
    /// the file has none.
    pub uv: Option<Vec<[[f32; 2]; 3]>>,
    /// Named sets of vertices: groups, objects, materials or physical names of the file. A vertex may be in several.
    pub groups: Vec<Group>,
    /// Named parts of the inside, of a file with volume elements. They may overlap.
    pub regions: Vec<VolumeRegion>,
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

    /// Writes the texture coordinates of each vertex to `into`, by vertex; at a seam, those of its first corner.
    /// Vertices without a triangle, and all if the mesh has no texture coordinates, keep what is there. Panics if
    /// `into` is shorter than the vertices.
    pub fn write_vertex_uv(&self, into: &mut [[f32; 2]]) {
        // Backwards, so that the first corner is written last.
        for (triangle, corners) in self.triangles.iter().zip(self.uv.as_deref().unwrap_or_default()).rev() {
            triangle.iter().zip(corners).for_each(|(vertex, uv)| into[*vertex as usize] = *uv);
        }
    }
}

/// A named part of the inside of a mesh: the surface around its volume elements.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct VolumeRegion {
    /// Name of the part in the file.
    pub name: String,
    /// Positions of the vertices, m.
    pub vertices_m: Vec<DVec3>,
    /// Three vertex indices per triangle, from 0, counterclockwise seen from outside the region.
    pub triangles: Vec<[u32; 3]>,
}

/// A named set of vertices of a mesh, which may overlap other sets.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Group {
    /// Name of the set in the file.
    pub name: String,
    /// Vertex indices, ascending and unique.
    pub vertices: Vec<u32>,
}
