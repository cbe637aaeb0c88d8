//! A mesh while it is read: vertices, faces and volume elements in the file's unit, within the limits.

use std::collections::BTreeMap;

use glam::DVec3;

use super::{ReadLimits, ReadMesh};
use crate::{Element, Group, MeshError, Problem, TriangleMesh, Unit};

/// Groups of a file; what has more of them is no organ.
const GROUPS: usize = 4096;

/// In the place of the fourth corner of a triangle.
const NONE: u32 = u32::MAX;

/// A volume element by the faces of its corners. Corners are numbered as in Gmsh and VTK, which agree here.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cell {
    Tetrahedron,
    Hexahedron,
    Prism,
    Pyramid,
}

impl Cell {
    /// How many corners it has.
    pub(super) fn corners(self) -> usize {
        match self {
            Cell::Tetrahedron => 4,
            Cell::Hexahedron => 8,
            Cell::Prism => 6,
            Cell::Pyramid => 5,
        }
    }

    fn faces(self) -> &'static [&'static [usize]] {
        match self {
            Cell::Tetrahedron => &[&[0, 2, 1], &[0, 1, 3], &[1, 2, 3], &[0, 3, 2]],
            Cell::Hexahedron => {
                &[&[0, 3, 2, 1], &[4, 5, 6, 7], &[0, 1, 5, 4], &[1, 2, 6, 5], &[2, 3, 7, 6], &[3, 0, 4, 7]]
            }
            Cell::Prism => &[&[0, 2, 1], &[3, 4, 5], &[0, 1, 4, 3], &[1, 2, 5, 4], &[2, 0, 3, 5]],
            Cell::Pyramid => &[&[0, 3, 2, 1], &[0, 1, 4], &[1, 2, 4], &[2, 3, 4], &[3, 0, 4]],
        }
    }
}

/// A mesh while it is read.
pub(super) struct Draft<'l> {
    pub(super) limits: &'l ReadLimits,
    pub(super) notes: Vec<String>,
    /// Points and lines of the file, which are no surface.
    pub(super) lines: usize,
    /// Whether vertices that no triangle has are dropped: the inner ones of volumes and of curved elements.
    pub(super) drops_unused: bool,
    vertices: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
    uv: Vec<[[f32; 2]; 3]>,
    has_uv: bool,
    groups: Vec<Group>,
    groups_by_name: BTreeMap<String, usize>,
    split: usize,
    cells: usize,
    /// The faces of volume elements, seen from outside.
    faces: Vec<[u32; 4]>,
}

impl<'l> Draft<'l> {
    pub(super) fn new(limits: &'l ReadLimits) -> Self {
        Self {
            limits,
            notes: Vec::new(),
            lines: 0,
            drops_unused: false,
            vertices: Vec::new(),
            triangles: Vec::new(),
            uv: Vec::new(),
            has_uv: false,
            groups: Vec::new(),
            groups_by_name: BTreeMap::new(),
            split: 0,
            cells: 0,
            faces: Vec::new(),
        }
    }

    /// How many vertices there are so far.
    pub(super) fn vertices(&self) -> usize {
        self.vertices.len()
    }

    /// Adds a vertex.
    pub(super) fn vertex(&mut self, at: [f64; 3]) -> Result<(), Problem> {
        if self.vertices.len() >= self.limits.vertices {
            return Err(Problem::TooLarge { what: "vertices", limit: self.limits.vertices });
        }
        self.vertices.push(DVec3::from_array(at));
        Ok(())
    }

    /// The group of a name.
    pub(super) fn group(&mut self, name: &str) -> Result<usize, Problem> {
        if let Some(group) = self.groups_by_name.get(name) {
            return Ok(*group);
        }
        if self.groups.len() >= GROUPS {
            return Err(Problem::TooLarge { what: "groups", limit: GROUPS });
        }
        let group = self.groups.len();
        self.groups.push(Group { name: name.to_owned(), vertices: Vec::new() });
        self.groups_by_name.insert(name.to_owned(), group);
        Ok(group)
    }

    /// The vertex of an index, if it exists.
    fn index(&self, index: i64) -> Result<u32, Problem> {
        let vertices = self.vertices.len();
        u32::try_from(index)
            .ok()
            .filter(|found| (*found as usize) < vertices)
            .ok_or(Problem::IndexOutOfRange { index, vertices })
    }

    /// Puts vertices into groups, and checks them.
    pub(super) fn assign(&mut self, corners: &[i64], groups: &[usize]) -> Result<(), Problem> {
        for corner in corners {
            let vertex = self.index(*corner)?;
            for group in groups {
                if let Some(group) = self.groups.get_mut(*group) {
                    group.vertices.push(vertex);
                    // Many faces share a vertex. So that none takes more than twice what it needs:
                    if group.vertices.len() > 2 * self.vertices.len() + 1024 {
                        group.vertices.sort_unstable();
                        group.vertices.dedup();
                    }
                }
            }
        }
        Ok(())
    }

    /// Adds a polygon, split as a fan from its first vertex. `uv` has one place for each corner, or none.
    pub(super) fn polygon(&mut self, corners: &[i64], uv: &[[f32; 2]], groups: &[usize]) -> Result<(), Problem> {
        self.assign(corners, groups)?;
        if corners.len() < 3 {
            self.lines += 1;
            return Ok(());
        }
        self.split += usize::from(corners.len() > 3);
        let has_uv = uv.len() == corners.len();
        if has_uv && !self.has_uv {
            self.has_uv = true;
            self.uv = vec![[[0.0; 2]; 3]; self.triangles.len()];
        }
        for second in 1..corners.len() - 1 {
            if self.triangles.len() >= self.limits.triangles {
                return Err(Problem::TooLarge { what: "triangles", limit: self.limits.triangles });
            }
            let at = [0, second, second + 1];
            let mut triangle = [0; 3];
            for (vertex, place) in triangle.iter_mut().zip(at) {
                *vertex = self.index(corners[place])?;
            }
            self.triangles.push(triangle);
            if self.has_uv {
                self.uv.push(if has_uv { at.map(|place| uv[place]) } else { [[0.0; 2]; 3] });
            }
        }
        Ok(())
    }

    /// Adds a volume element by its corners; further nodes of curved ones are left out.
    pub(super) fn cell(&mut self, cell: Cell, nodes: &[i64], groups: &[usize]) -> Result<(), Problem> {
        if self.cells >= self.limits.triangles {
            return Err(Problem::TooLarge { what: "volume elements", limit: self.limits.triangles });
        }
        let Some(nodes) = nodes.get(..cell.corners()) else {
            return Err(Problem::Syntax { message: format!("a volume element of {} vertices", nodes.len()) });
        };
        self.assign(nodes, groups)?;
        self.cells += 1;
        self.drops_unused = true;
        let mut corners = [0; 8];
        for (corner, node) in corners.iter_mut().zip(nodes) {
            *corner = self.index(*node)?;
        }
        let at = |corner: usize| self.vertices[corners[corner] as usize];
        let middle = (0..nodes.len()).map(at).sum::<DVec3>() / nodes.len() as f64;
        for face in cell.faces() {
            let normal = (at(face[1]) - at(face[0])).cross(at(face[2]) - at(face[0]));
            let mut outer = [NONE; 4];
            for (corner, place) in outer.iter_mut().zip(*face) {
                *corner = corners[*place];
            }
            // Files number elements in both senses.
            if normal.dot(at(face[0]) - middle) < 0.0 {
                outer[..face.len()].reverse();
            }
            self.faces.push(outer);
        }
        Ok(())
    }

    /// Replaces faces by the outer surface of the volume elements: the faces that one element alone has.
    fn take_outer_surface(&mut self) -> Result<(), Problem> {
        let key = |face: &[u32; 4]| {
            let mut sorted = *face;
            sorted.sort_unstable();
            sorted
        };
        let mut sorted: Vec<([u32; 4], usize)> = self.faces.iter().map(key).zip(0..).collect();
        sorted.sort_unstable();
        let mut is_outer = vec![false; self.faces.len()];
        for same in sorted.chunk_by(|a, b| a.0 == b.0) {
            is_outer[same[0].1] = same.len() == 1;
        }
        drop(sorted);
        if !self.triangles.is_empty() {
            let number = self.triangles.len();
            self.notes
                .push(format!("Surface triangles left out, since the outer surface of the volume is used: {number}."));
        }
        (self.split, self.has_uv) = (0, false);
        self.triangles.clear();
        self.uv.clear();
        for (face, is_outer) in std::mem::take(&mut self.faces).into_iter().zip(is_outer) {
            if is_outer {
                let corners: Vec<i64> = face.into_iter().filter(|corner| *corner != NONE).map(i64::from).collect();
                self.polygon(&corners, &[], &[])?;
            }
        }
        let (cells, triangles) = (self.cells, self.triangles.len());
        self.notes.push(format!(
            "The mesh is the outer surface of a volume. Volume elements: {cells}; triangles: {triangles}."
        ));
        Ok(())
    }

    /// Drops the vertices that no triangle has.
    fn drop_unused(&mut self) {
        let mut number = vec![NONE; self.vertices.len()];
        for vertex in self.triangles.iter().flatten() {
            number[*vertex as usize] = 0;
        }
        let mut kept = 0;
        for number in number.iter_mut().filter(|number| **number == 0) {
            *number = kept;
            kept += 1;
        }
        let all = self.vertices.len();
        if kept as usize == all {
            return;
        }
        let mut old = 0;
        self.vertices.retain(|_| {
            old += 1;
            number[old - 1] != NONE
        });
        self.triangles.iter_mut().flatten().for_each(|vertex| *vertex = number[*vertex as usize]);
        for group in &mut self.groups {
            group.vertices.retain(|vertex| number[*vertex as usize] != NONE);
            group.vertices.iter_mut().for_each(|vertex| *vertex = number[*vertex as usize]);
        }
        self.notes.push(format!(
            "Vertices kept, since they are corners of the surface: {kept} of {all}; numbered from 0 in the order of the file."
        ));
    }

    /// The mesh in metres.
    pub(super) fn finish(mut self, file: &str, unit: Unit) -> Result<ReadMesh, MeshError> {
        let fail = |element, problem| MeshError { file: file.to_owned(), element, place_m: None, problem };
        if self.cells > 0 {
            self.take_outer_surface().map_err(|problem| fail(Element::Whole, problem))?;
        }
        if self.drops_unused {
            self.drop_unused();
        }
        for (number, vertex) in (0..).zip(&mut self.vertices) {
            *vertex *= unit.metres();
            if !vertex.is_finite() {
                return Err(fail(Element::Vertex(number), Problem::NotFinite));
            }
        }
        for group in &mut self.groups {
            group.vertices.sort_unstable();
            group.vertices.dedup();
        }
        self.groups.retain(|group| !group.vertices.is_empty());
        if self.split > 0 {
            self.notes.push(format!("Polygons split into triangles, from their first vertex: {}.", self.split));
        }
        if self.lines > 0 {
            self.notes.push(format!("Points and lines left out: {}.", self.lines));
        }
        let has_finite_uv = self.uv.iter().flatten().flatten().all(|part| part.is_finite());
        if self.has_uv && !has_finite_uv {
            self.notes.push("The texture coordinates are left out: some are not finite numbers.".to_owned());
        }
        let mesh = TriangleMesh {
            vertices_m: self.vertices,
            triangles: self.triangles,
            uv: (self.has_uv && has_finite_uv).then_some(self.uv),
            groups: self.groups,
        };
        Ok(ReadMesh { mesh, notes: self.notes })
    }
}
