//! A mesh that is being read: vertices, faces and volume elements in the file's unit, within the limits.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec3;

use super::allowance::MemoryAllowance;
use super::polygon::{Split, triangles};
use super::volume::{Cell, Volume};
use super::{ReadLimits, ReadMesh};
use crate::topology::Topology;
use crate::{Element, Group, MeshError, Problem, TriangleMesh, Unit, VolumeRegion};

/// Maximum number of groups in a file.
const GROUPS: usize = 4096;

/// Maximum number of regions of a file that are kept.
pub(super) const MAX_REGIONS: usize = 256;

/// Memory for making a region's surface, bytes for each corner of its faces: its vertex, the number of that, and its triangle.
const REGION_CORNER: usize = 160;

/// Marks a vertex that is dropped.
const NONE: u32 = u32::MAX;

/// Maximum number of comparisons for splitting the concave polygons of a file.
const COMPARISONS: u64 = 1 << 26;

/// Memory for splitting a polygon, bytes per corner.
const SPLITTING: usize = 320;

/// Memory for finding out whether a surface is closed, bytes per triangle.
const CLOSED: usize = 160;

/// A mesh while it is read.
pub(super) struct Draft<'l> {
    pub(super) limits: &'l ReadLimits,
    pub(super) allowance: MemoryAllowance<'l>,
    pub(super) notes: Vec<String>,
    /// Number of points and lines in the file, which are not part of a surface.
    pub(super) lines: usize,
    /// Whether to drop vertices without triangles: the inner ones of volumes and of curved elements.
    pub(super) drops_unused: bool,
    /// Whether to drop triangles that repeat an earlier one.
    pub(super) drops_repeated: bool,
    vertices: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
    uv: Vec<[[f32; 2]; 3]>,
    has_uv: bool,
    groups: Vec<Group>,
    groups_by_name: BTreeMap<String, usize>,
    /// Number of polygons that were split, by the method.
    split: usize,
    concave: usize,
    folded: usize,
    /// Number of comparisons left.
    comparisons: u64,
    volume: Volume,
    /// Volume elements and their groups.
    cell_groups: Vec<(u32, u32)>,
    regions: Vec<VolumeRegion>,
}

impl<'l> Draft<'l> {
    pub(super) fn new(limits: &'l ReadLimits, allowance: MemoryAllowance<'l>) -> Self {
        Self {
            limits,
            allowance,
            notes: Vec::new(),
            lines: 0,
            drops_unused: false,
            drops_repeated: false,
            vertices: Vec::new(),
            triangles: Vec::new(),
            uv: Vec::new(),
            has_uv: false,
            groups: Vec::new(),
            groups_by_name: BTreeMap::new(),
            split: 0,
            concave: 0,
            folded: 0,
            comparisons: COMPARISONS,
            volume: Volume::default(),
            cell_groups: Vec::new(),
            regions: Vec::new(),
        }
    }

    /// Returns the number of vertices so far.
    pub(super) fn vertices(&self) -> usize {
        self.vertices.len()
    }

    /// Adds a vertex.
    pub(super) fn vertex(&mut self, at: [f64; 3]) -> Result<(), Problem> {
        if self.vertices.len() >= self.limits.vertices {
            return Err(Problem::TooLarge { what: "vertices", limit: self.limits.vertices });
        }
        self.allowance.push(&mut self.vertices, DVec3::from_array(at))
    }

    /// Returns the group with a name, and adds it if it is new.
    pub(super) fn group(&mut self, name: &str) -> Result<usize, Problem> {
        if let Some(group) = self.groups_by_name.get(name) {
            return Ok(*group);
        }
        if self.groups.len() >= GROUPS {
            return Err(Problem::TooLarge { what: "groups", limit: GROUPS });
        }
        self.allowance.take(4 * (name.len() + size_of::<Group>()))?;
        let group = self.groups.len();
        self.groups.push(Group { name: name.to_owned(), vertices: Vec::new() });
        self.groups_by_name.insert(name.to_owned(), group);
        Ok(group)
    }

    /// Returns the vertex with an index, if it exists.
    fn index(&self, index: i64) -> Result<u32, Problem> {
        let vertices = self.vertices.len();
        u32::try_from(index)
            .ok()
            .filter(|found| (*found as usize) < vertices)
            .ok_or(Problem::IndexOutOfRange { index, vertices })
    }

    /// Checks vertices and adds them to groups.
    pub(super) fn assign(&mut self, corners: &[i64], groups: &[usize]) -> Result<(), Problem> {
        for corner in corners {
            let vertex = self.index(*corner)?;
            for group in groups {
                if let Some(group) = self.groups.get_mut(*group) {
                    self.allowance.push(&mut group.vertices, vertex)?;
                    // Many faces share a vertex; duplicates are removed so that no list takes more than twice what it
                    // needs.
                    if group.vertices.len() > 2 * self.vertices.len() + 1024 {
                        group.vertices.sort_unstable();
                        group.vertices.dedup();
                    }
                }
            }
        }
        Ok(())
    }

    /// Adds a polygon, split into triangles. `uv` has one entry per corner, or none.
    pub(super) fn polygon(&mut self, corners: &[i64], uv: &[[f32; 2]], groups: &[usize]) -> Result<(), Problem> {
        self.assign(corners, groups)?;
        let uv = if uv.len() == corners.len() { uv } else { &[] };
        if corners.len() == 3 {
            return self.triangle(corners, uv, [0, 1, 2]);
        }
        if corners.len() > self.limits.triangles.saturating_add(2) {
            return Err(Problem::TooLarge { what: "triangles", limit: self.limits.triangles });
        }
        self.allowance.take(SPLITTING * corners.len())?;
        self.split(corners, uv)?;
        self.allowance.give_back(SPLITTING * corners.len());
        Ok(())
    }

    fn split(&mut self, corners: &[i64], uv: &[[f32; 2]]) -> Result<(), Problem> {
        // A corner that is repeated in succession counts once.
        let is_last = |place: &usize| corners[*place] != corners[(*place + 1) % corners.len()];
        let places: Vec<usize> = (0..corners.len()).filter(is_last).collect();
        if places.len() < 3 {
            self.lines += 1;
            return Ok(());
        }
        let at = places.iter().map(|place| Ok(self.vertices[self.index(corners[*place])? as usize]));
        let (split, how) = triangles(&at.collect::<Result<Vec<_>, Problem>>()?, &mut self.comparisons);
        match how {
            Split::Fan => self.split += usize::from(split.len() > 1),
            Split::Ears => self.concave += 1,
            Split::Folded => self.folded += 1,
        }
        split.into_iter().try_for_each(|triangle| self.triangle(corners, uv, triangle.map(|place| places[place])))
    }

    /// Adds a triangle of three corners of a polygon.
    fn triangle(&mut self, corners: &[i64], uv: &[[f32; 2]], places: [usize; 3]) -> Result<(), Problem> {
        if self.triangles.len() >= self.limits.triangles {
            return Err(Problem::TooLarge { what: "triangles", limit: self.limits.triangles });
        }
        if !uv.is_empty() && !self.has_uv {
            self.has_uv = true;
            self.allowance.take(size_of::<[[f32; 2]; 3]>() * self.triangles.len())?;
            self.uv = vec![[[0.0; 2]; 3]; self.triangles.len()];
        }
        let [a, b, c] = places.map(|place| self.index(corners[place]));
        self.allowance.push(&mut self.triangles, [a?, b?, c?])?;
        if self.has_uv {
            let own = if uv.is_empty() { [[0.0; 2]; 3] } else { places.map(|place| uv[place]) };
            self.allowance.push(&mut self.uv, own)?;
        }
        Ok(())
    }

    /// Adds a strip of triangles: each vertex forms one with the two before it, and every other triangle is reversed.
    /// A repeated vertex, which starts the strip elsewhere, forms none.
    pub(super) fn strip(&mut self, corners: &[i64], uv: &[[f32; 2]]) -> Result<(), Problem> {
        // Checks the corners of skipped triangles too.
        self.assign(corners, &[])?;
        for first in 0..corners.len().saturating_sub(2) {
            let places = if first % 2 == 0 { [first, first + 1, first + 2] } else { [first + 1, first, first + 2] };
            let [a, b, c] = places.map(|place| corners[place]);
            if a != b && b != c && c != a {
                self.triangle(corners, if uv.len() == corners.len() { uv } else { &[] }, places)?;
            }
        }
        Ok(())
    }

    /// Adds a volume element by its corners, to groups of vertices and to the regions with the same names. The edges of a tetrahedron
    /// with ten nodes bend at their middles; further nodes of other curved ones are ignored.
    pub(super) fn cell(&mut self, cell: Cell, nodes: &[i64], groups: &[usize]) -> Result<(), Problem> {
        if self.volume.len() >= self.limits.triangles {
            return Err(Problem::TooLarge { what: "volume elements", limit: self.limits.triangles });
        }
        let all = nodes;
        let Some(nodes) = nodes.get(..cell.corners()) else {
            return Err(Problem::Syntax { message: format!("a volume element of {} vertices", nodes.len()) });
        };
        self.assign(nodes, groups)?;
        self.drops_unused = true;
        let corners = nodes.iter().map(|node| self.index(*node)).collect::<Result<Vec<u32>, _>>()?;
        for group in groups {
            self.allowance.push(&mut self.cell_groups, (self.volume.len() as u32, *group as u32))?;
        }
        self.volume.add(cell, &corners, &mut self.allowance)?;
        if let (Cell::Tetrahedron, [_, _, _, _, middles @ ..]) = (cell, all)
            && middles.len() == 6
        {
            let mut own = [0; 6];
            for (own, middle) in own.iter_mut().zip(middles) {
                *own = self.index(*middle)?;
            }
            self.volume.add_middles(own, &self.vertices, &mut self.allowance)?;
        }
        Ok(())
    }

    /// Returns whether the triangles so far form a closed surface.
    pub(super) fn is_closed(&mut self) -> bool {
        // Counts as not closed if there is no memory for finding out.
        let paid = self.allowance.take(CLOSED * self.triangles.len());
        paid.is_ok() && Topology::new(self.vertices.len(), &self.triangles).is_closed()
    }

    /// Replaces the triangles by the outer surface of the volume elements.
    fn take_outer_surface(&mut self) -> Result<(), Problem> {
        let volume = std::mem::take(&mut self.volume);
        self.regions = self.regions_of(&volume)?;
        if !self.triangles.is_empty() {
            let number = self.triangles.len();
            self.notes
                .push(format!("Surface triangles left out, since the outer surface of the volume is used: {number}."));
        }
        (self.split, self.concave, self.folded, self.has_uv) = (0, 0, 0, false);
        self.triangles.clear();
        self.uv.clear();
        let surface = volume.outer_surface(&self.vertices, &mut self.allowance)?;
        for face in surface.faces {
            let corners: Vec<i64> = face.into_iter().map(i64::from).collect();
            self.polygon(&corners, &[], &[])?;
        }
        if surface.repeated > 0 {
            let number = surface.repeated;
            self.notes.push(format!("Volume elements left out that have the corners of an earlier one: {number}."));
        }
        if surface.turned > 0 {
            let number = surface.turned;
            self.notes
                .push(format!("Volume elements turned, whose corners are in the order of a mirror image: {number}."));
        }
        let (cells, triangles) = (volume.len(), self.triangles.len());
        self.notes.push(format!(
            "The mesh is the outer surface of a volume. Volume elements: {cells}; triangles: {triangles}."
        ));
        Ok(())
    }

    /// Returns the regions of a volume: the surface around the elements of each group.
    fn regions_of(&mut self, volume: &Volume) -> Result<Vec<VolumeRegion>, Problem> {
        let mut of_cells = std::mem::take(&mut self.cell_groups);
        of_cells.sort_unstable_by_key(|(cell, group)| (*group, *cell));
        let mut regions = Vec::new();
        for cells in of_cells.chunk_by(|a, b| a.1 == b.1) {
            if regions.len() == MAX_REGIONS {
                self.notes.push(format!("Regions beyond the first {MAX_REGIONS} are left out."));
                break;
            }
            let before = self.allowance.taken();
            let part = volume.part(cells.iter().map(|(cell, _)| *cell), &mut self.allowance)?;
            let faces = part.outer_surface(&self.vertices, &mut self.allowance)?.faces;
            let mut region = VolumeRegion { name: self.groups[cells[0].1 as usize].name.clone(), ..Default::default() };
            self.allowance.take(REGION_CORNER * faces.iter().map(Vec::len).sum::<usize>())?;
            let mut numbers: BTreeMap<u32, u32> = BTreeMap::new();
            let mut number = |vertex: &u32| {
                *numbers.entry(*vertex).or_insert_with(|| {
                    region.vertices_m.push(self.vertices[*vertex as usize]);
                    region.vertices_m.len() as u32 - 1
                })
            };
            for face in faces {
                let corners: Vec<u32> = face.iter().map(&mut number).collect();
                region.triangles.extend((2..corners.len()).map(|at| [corners[0], corners[at - 1], corners[at]]));
            }
            region.vertices_m.shrink_to_fit();
            region.triangles.shrink_to_fit();
            // Only the surface is kept.
            self.allowance.give_back(self.allowance.taken().saturating_sub(before));
            self.allowance.take(size_of_val(&*region.vertices_m) + size_of_val(&*region.triangles))?;
            regions.push(region);
        }
        Ok(regions)
    }

    /// Drops triangles that repeat an earlier one with its orientation.
    fn drop_repeated(&mut self) -> Result<(), Problem> {
        // Twice a triangle, in a tree.
        const REPEATED: usize = 32;
        self.allowance.take(REPEATED * self.triangles.len())?;
        let mut seen = BTreeSet::new();
        let is_first = |triangle: &[u32; 3]| {
            let least = (0..3).min_by_key(|corner| triangle[*corner]).unwrap_or(0);
            let mut rotated = *triangle;
            rotated.rotate_left(least);
            seen.insert(rotated)
        };
        let is_kept: Vec<bool> = self.triangles.iter().map(is_first).collect();
        let dropped = is_kept.iter().filter(|is| !**is).count();
        if dropped == 0 {
            return Ok(());
        }
        let mut kept = is_kept.iter();
        self.triangles.retain(|_| *kept.next().unwrap_or(&true));
        let mut kept = is_kept.iter();
        self.uv.retain(|_| *kept.next().unwrap_or(&true));
        self.notes.push(format!("Triangles left out that an earlier one repeats, as in several groups: {dropped}."));
        Ok(())
    }

    /// Drops vertices without triangles.
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

    /// Returns the mesh in metres, with notes.
    pub(super) fn finish(mut self, file: &str, unit: Unit) -> Result<ReadMesh, MeshError> {
        let fail = |element, problem| MeshError { file: file.to_owned(), element, place_m: None, problem };
        if self.volume.len() > 0 {
            self.take_outer_surface().map_err(|problem| fail(Element::Whole, problem))?;
        }
        if self.drops_repeated {
            self.drop_repeated().map_err(|problem| fail(Element::Whole, problem))?;
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
        for vertex_m in self.regions.iter_mut().flat_map(|region| &mut region.vertices_m) {
            *vertex_m *= unit.metres();
            if !vertex_m.is_finite() {
                return Err(fail(Element::Whole, Problem::NotFinite));
            }
        }
        for group in &mut self.groups {
            group.vertices.sort_unstable();
            group.vertices.dedup();
        }
        self.groups.retain(|group| !group.vertices.is_empty());
        for (count, what) in [
            (self.split, "Polygons split into triangles, from their first vertex"),
            (self.concave, "Concave polygons split into triangles, by cutting off their ears"),
            (self.folded, "Polygons that cross themselves or have no plane, split from their first vertex"),
            (self.lines, "Points and lines left out"),
        ] {
            if count > 0 {
                self.notes.push(format!("{what}: {count}."));
            }
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
            regions: self.regions,
        };
        Ok(ReadMesh { mesh, unit, notes: self.notes })
    }
}
