//! The rest shape of a solid: the lattice, its points, and the surface within it.

use std::sync::Arc;

use glam::DVec3;
use palpate_geometry::cell_surface::surface_of;
use palpate_geometry::fill::{Lattice, filled};
use palpate_geometry::subdivide::subdivide;
use palpate_geometry::{Group, TriangleMesh, prepare, report};

use super::fixed::{FixedPart, along_axis};
use crate::limits::Limits;
use crate::scene::mesh::{MeshShape, group_named, unknown_name};
use crate::scene::shown::{findings_of, to_repair};
use crate::shape::{CellPlace, Deepest, Extent, PointId, PointName, RestShape, ShownShape};
use palpate_refusal::{Reason, Refusal, Result, legible};

/// The number of a corner of the lattice that is no point.
const NO_POINT: u32 = u32::MAX;

/// Largest part of the rays that may run through holes of the surface. The winding number closes smaller ones, and many triangles
/// that are turned or doubled look like some.
const MAX_OPEN: f64 = 0.02;

/// From this part on they are told. (Parts of a surface that touch in an edge make some.)
const TOLD_OPEN: f64 = 0.002;

/// Vertices of the surface that tools touch: its edges are split until they are as long as those of a cube, or until there
/// are as many.
const MAX_VERTICES: usize = 400_000;

/// Smallest part of a cube that counts, if any of it is inside: a corner whose cubes were all slivers would have no mass, and
/// slivers that are turned inside out would hardly come back.
const MIN_PART: f64 = 0.1;

/// A cube is evaluated at its middle. One that is filled in part is farther out there than what fills it, so it is strained
/// more and counts too much. A part p counts for stiffness as p·(1 − 0.4·(1 − p)): by beams turned in the lattice, which were
/// 10 to 14 % too stiff with p itself (`make bench-solid`).
const TOO_STIFF: f64 = 0.4;

/// How deep beneath a fixed part of the surface points are fixed, in edges. The points nearest to its vertices are up to half an
/// edge inside or outside; those inside would hold more of the solid than is fixed.
const FIXED_DEPTH: f64 = 0.25;

/// How large the cubes of a solid are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CellSize {
    /// Edges of this length, m.
    Edge(f64),
    /// About this many cubes.
    Count(f64),
}

impl CellSize {
    /// That of a scene that gives neither the size of cubes nor their number.
    pub const USUAL: Self = CellSize::Count(20_000.0);
}

/// The rest shape of a solid. Its points are the corners of the cubes that are inside the surface or meet it, numbered in
/// the order of the lattice: x runs fastest, then y. Frames show the surface.
#[derive(Debug, PartialEq)]
pub struct SolidShape {
    lattice: Lattice,
    /// The part of each cube that is inside.
    parts: Vec<f32>,
    /// The point at each corner of the lattice, and the corner of each point.
    point_of: Vec<u32>,
    corner_of: Vec<u32>,
    is_fixed: Vec<bool>,
    /// What the scene fixes.
    fixed: Vec<FixedPart>,
    /// The surface, whose edges are about as short as those of a cube.
    surface: Arc<MeshShape>,
    /// Its named groups of vertices.
    groups: Vec<Group>,
    /// The mesh that the scene names.
    source: TriangleMesh,
    /// The cube that each vertex of the surface moves with.
    bound: Vec<CellPlace>,
    /// The vertex of the surface nearest to each point.
    vertex_of: Vec<u32>,
    findings: Vec<String>,
}

/// Corner n of a cube is at its least corner plus these.
pub(crate) const CORNERS: [[usize; 3]; 8] =
    [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1], [1, 1, 1]];

/// Returns the trilinear weights of the corners of a cube for a place whose coordinates are 0 to 1 within it.
pub(crate) fn trilinear(part: DVec3) -> [f64; 8] {
    CORNERS.map(|by| (0..3).map(|axis| if by[axis] == 1 { part[axis] } else { 1.0 - part[axis] }).product())
}

impl SolidShape {
    /// Fills a closed surface with cubes, and finds the fixed points.
    ///
    /// # Errors
    /// Refuses a mesh that does not enclose a space, with a place of a hole (empty field); cubes that are larger than the
    /// surface, or more than the limits allow (field `cell_m`); and a fixed part without a point (field `solid.fixed`).
    pub fn of(source: TriangleMesh, size: CellSize, fixed: &[FixedPart], limits: &Limits) -> Result<Self> {
        let refuse = |message: String| Refusal::new(Reason::Unreadable, "", message);
        let Enclosing { mut mesh, is_surface, mut findings } = Enclosing::of(source.clone())?;
        let extent = Extent::around(mesh.vertices_m.iter().copied());
        let edge_m = match size {
            CellSize::Edge(edge_m) => edge_m,
            CellSize::Count(count) => edge_for(&mesh, count)?,
        };
        let most = limits.points as f64;
        if (extent.size_m() / edge_m + 3.0).element_product() > most {
            let message = format!("gives more corners of cubes than the limit of {} points", limits.points);
            return Err(Refusal::new(Reason::TooLarge, "cell_m", message));
        }
        let lattice = lattice_around(extent, edge_m, fixed);
        let found = filled(&mesh.vertices_m, &mesh.triangles, &lattice);
        if found.open_part > TOLD_OPEN {
            let [x, y, z] = found.open_at_m.unwrap_or_default().to_array().map(legible);
            let message = format!(
                "is not closed: {:.1} % of the lines across it pass through a hole, one at ({x}, {y}, {z}) m",
                100.0 * found.open_part
            );
            if found.open_part > MAX_OPEN {
                return Err(refuse(message + "; `palpate mesh FILE --repair` may close it"));
            }
            findings.push(format!("mesh: {message}; cells fill it as if the hole were closed"));
        }
        if found.parts.iter().all(|part| *part == 0.0) {
            return Err(refuse("encloses nothing".to_owned()));
        }
        if !is_surface {
            findings.push(format!(
                "mesh: its triangles form no surface, so one is made around what they enclose, to {} m",
                legible(0.5 * edge_m)
            ));
            mesh = rebuilt(&mesh, &lattice);
        }
        let most = MAX_VERTICES.max(mesh.vertices_m.len());
        subdivide(&mut mesh, 0.5 * edge_m, most);
        let groups = mesh.groups;
        let surface = MeshShape::new(mesh.vertices_m, mesh.triangles, |_, _, _| false);
        let surface = surface.map_err(|refusal| refuse(refusal.message))?;
        let mut shape = Self::filled(lattice, found.parts, surface, source, findings);
        shape.groups = groups;
        shape.fix(fixed)?;
        Ok(shape)
    }

    /// Returns a block of `cells`³ full cubes whose lowest points are fixed.
    pub(crate) fn block(cells: usize, edge_m: f64) -> Self {
        let lattice = Lattice { origin_m: DVec3::ZERO, edge_m, cells: [cells; 3] };
        let side_m = cells as f64 * edge_m;
        let corner_m = |[x, y, z]: [usize; 3]| side_m * DVec3::new(x as f64, y as f64, z as f64);
        let vertices_m = CORNERS.map(corner_m).to_vec();
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles: Vec<[u32; 3]> = quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
        let source =
            TriangleMesh { vertices_m: vertices_m.clone(), triangles: triangles.clone(), ..Default::default() };
        let surface = MeshShape::new(vertices_m, triangles, |_, _, _| false);
        let surface = surface.unwrap_or_else(|_| unreachable!("a cube is a surface"));
        let mut shape = Self::filled(lattice, vec![1.0; cells.pow(3)], surface, source, Vec::new());
        for (fixed, corner) in shape.is_fixed.iter_mut().zip(&shape.corner_of) {
            *fixed = (*corner as usize) < (cells + 1) * (cells + 1);
        }
        shape
    }

    #[allow(clippy::cast_possible_truncation)]
    fn filled(
        lattice: Lattice,
        parts: Vec<f32>,
        surface: MeshShape,
        source: TriangleMesh,
        findings: Vec<String>,
    ) -> Self {
        let corners: usize = lattice.cells.iter().map(|cells| cells + 1).product();
        let mut shape = SolidShape {
            lattice,
            parts,
            point_of: vec![NO_POINT; corners],
            corner_of: Vec::new(),
            is_fixed: Vec::new(),
            fixed: Vec::new(),
            surface: Arc::new(surface),
            groups: Vec::new(),
            source,
            bound: Vec::new(),
            vertex_of: Vec::new(),
            findings,
        };
        for cell in shape.cells() {
            if shape.is_in(cell) {
                CORNERS.iter().for_each(|by| {
                    let corner = shape.corner(added(cell, *by));
                    shape.point_of[corner] = 0;
                });
            }
        }
        for corner in 0..corners {
            if shape.point_of[corner] != NO_POINT {
                shape.point_of[corner] = shape.corner_of.len() as u32;
                shape.corner_of.push(corner as u32);
            }
        }
        shape.is_fixed = vec![false; shape.corner_of.len()];
        shape.bound = shape.surface.vertices_m().iter().map(|place_m| shape.bind(*place_m)).collect();
        let places = || crate::shape::points(&shape).map(|point| shape.rest_m(point));
        shape.surface.prepare_contact();
        shape.vertex_of = places().map(|place_m| nearest_vertex(&shape.surface, place_m)).collect();
        shape
    }

    /// Returns how much of each cube that a region of the file reaches is the region's, 0 to 1, of what is inside; by
    /// [`Lattice::index`].
    ///
    /// # Errors
    /// Refuses a name that no region has, with the field `field`.
    pub(super) fn region_parts(&self, name: &str, field: &str) -> Result<Vec<(usize, f64)>> {
        let regions = &self.source.regions;
        let Some(region) = regions.iter().find(|region| region.name == name) else {
            if regions.is_empty() {
                let message = "is for a file with volume elements in named groups; in others an inclusion of a solid is a ball, \
                               with centre_m and radius_m";
                return Err(Refusal::new(Reason::WrongKind, field, message));
            }
            let names = || regions.iter().map(|region| region.name.as_str());
            return Err(unknown_name(field, "the file has no region", name, names));
        };
        let of_region = filled(&region.vertices_m, &region.triangles, &self.lattice).parts;
        let share = |(region, whole): (&f32, &f32)| f64::from(*region / whole.max(*region).max(f32::MIN_POSITIVE));
        let shares = of_region.iter().zip(&self.parts).map(share).enumerate();
        Ok(shares.filter(|(_, share)| *share > 0.0).collect())
    }

    /// Fixes the points of some parts.
    fn fix(&mut self, parts: &[FixedPart]) -> Result<()> {
        for (number, part) in parts.iter().enumerate() {
            let mut holds_any = false;
            if let FixedPart::Group(name) = part {
                let group = group_named("solid.fixed", name, &self.groups)?;
                for vertex in &group.vertices {
                    let point = self.point_to_fix(*vertex as usize);
                    holds_any = true;
                    self.is_fixed[point.index()] = true;
                }
            }
            for point in crate::shape::points(self) {
                if part.holds(&self.lattice, self.rest_m(point)) {
                    holds_any = true;
                    self.is_fixed[point.index()] = true;
                }
            }
            if !holds_any {
                let message = format!("part {number} holds no point of the solid, which is {}", self.extent());
                return Err(Refusal::new(Reason::OutOfRange, "solid.fixed", message));
            }
        }
        self.fixed = parts.to_vec();
        Ok(())
    }

    /// Returns the point that a vertex of a fixed group moves with most, of those that are no deeper than [`FIXED_DEPTH`].
    fn point_to_fix(&self, vertex: usize) -> PointId {
        let (bound, normal) = (&self.bound[vertex], self.surface.normals()[vertex]);
        let point = |corner: usize| PointId::new(bound.points[corner] as usize);
        let from_m = |corner: usize| self.rest_m(point(corner)) - self.surface.vertices_m()[vertex];
        let is_shallow = |corner: &usize| from_m(*corner).dot(normal) >= -FIXED_DEPTH * self.lattice.edge_m;
        let most = (0..8).filter(is_shallow).max_by(|a, b| bound.weights[*a].total_cmp(&bound.weights[*b]));
        most.map_or_else(|| bound.most_moving(), point)
    }

    /// Returns the lattice of cubes.
    pub fn lattice(&self) -> &Lattice {
        &self.lattice
    }

    /// Returns the parts of space whose points never move.
    pub fn fixed(&self) -> &[FixedPart] {
        &self.fixed
    }

    /// Returns the part of each cube that is inside the surface, 0 to 1, by [`Lattice::index`].
    pub fn parts(&self) -> &[f32] {
        &self.parts
    }

    /// Returns the part of each cube that counts for mass; 0 for a cube outside.
    pub(super) fn mass_parts(&self) -> Vec<f64> {
        (0..self.parts.len()).map(|cell| self.mass_part(cell)).collect()
    }

    /// Returns the part that counts for mass of the cube of which a corner is the least one.
    pub(crate) fn mass_part_at(&self, corner: usize) -> f64 {
        self.mass_part(self.lattice.index(self.corner_at(corner)))
    }

    fn mass_part(&self, cell: usize) -> f64 {
        let part = self.parts[cell];
        if part > 0.0 { f64::from(part).max(MIN_PART) } else { 0.0 }
    }

    /// Returns the part of each cube that counts for stiffness, at most that for mass; 0 for a cube outside.
    pub(super) fn stiffness_parts(&self) -> Vec<f64> {
        (0..self.parts.len()).map(|cell| self.stiffness_part(cell)).collect()
    }

    /// Returns the part of a cube that counts for stiffness.
    pub(super) fn stiffness_part(&self, cell: usize) -> f64 {
        let part = self.mass_part(cell);
        part * (1.0 - TOO_STIFF * (1.0 - part))
    }

    /// Returns the surface, with edges about as short as those of a cube: frames show it, and tools touch it.
    pub fn surface(&self) -> &Arc<MeshShape> {
        &self.surface
    }

    /// Returns the cube that a vertex of the surface moves with.
    pub(crate) fn cell_of(&self, vertex: usize) -> &CellPlace {
        &self.bound[vertex]
    }

    /// Returns the mesh that the scene names.
    pub fn source(&self) -> &TriangleMesh {
        &self.source
    }

    pub(super) fn findings(&self) -> &[String] {
        &self.findings
    }

    /// Returns the number of corners of the lattice.
    pub(crate) fn place_count(&self) -> usize {
        self.point_of.len()
    }

    /// Returns the number of the corner of a point: x runs fastest, then y.
    pub(crate) fn corner_of(&self, point: PointId) -> usize {
        self.corner_of[point.index()] as usize
    }

    /// Returns the point at a corner of this number; `None` if none is there.
    pub(crate) fn point_at_corner(&self, corner: usize) -> Option<PointId> {
        let point = self.point_of[corner];
        (point != NO_POINT).then_some(PointId::new(point as usize))
    }

    /// Returns the point at a corner of the lattice; `None` if none is there.
    pub(super) fn point_at(&self, corner: [usize; 3]) -> Option<PointId> {
        self.point_at_corner(self.corner(corner))
    }

    /// Returns the rest position of the corner of a number, m.
    pub(crate) fn corner_m(&self, number: usize) -> DVec3 {
        // Not mapped: the compiler does not always inline that.
        let [i, j, k] = self.corner_at(number);
        self.lattice.origin_m + self.lattice.edge_m * DVec3::new(i as f64, j as f64, k as f64)
    }

    /// Returns the point at each corner (the number of none where there is none), and the corner of each point.
    pub(crate) fn order(&self) -> [&[u32]; 2] {
        [&self.point_of, &self.corner_of]
    }

    /// Returns the number of a corner.
    pub(crate) fn corner(&self, [i, j, k]: [usize; 3]) -> usize {
        let [x, y, _] = self.lattice.cells.map(|cells| cells + 1);
        (k * y + j) * x + i
    }

    /// Returns the corner of a number.
    #[inline(always)]
    pub(crate) fn corner_at(&self, number: usize) -> [usize; 3] {
        let [x, y, _] = self.lattice.cells;
        let (x, y) = (x + 1, y + 1);
        [number % x, number / x % y, number / x / y]
    }

    /// Returns the cubes, in the order of [`Lattice::index`].
    pub(crate) fn cells(&self) -> impl Iterator<Item = [usize; 3]> + use<> {
        let [x, y, z] = self.lattice.cells;
        (0..x * y * z).map(move |cell| [cell % x, cell / x % y, cell / x / y])
    }

    /// Returns whether a part of a cube is inside.
    fn is_in(&self, cell: [usize; 3]) -> bool {
        self.parts[self.lattice.index(cell)] > 0.0
    }

    /// Returns the cubes that a ball may reach.
    pub(super) fn cells_within(&self, centre_m: DVec3, radius_m: f64) -> impl Iterator<Item = [usize; 3]> + use<> {
        let [least, most] = [-radius_m, radius_m].map(|by_m| self.lattice.from_m(centre_m + by_m));
        let [x, y, z] = [0, 1, 2].map(|axis| {
            let cells = self.lattice.cells[axis];
            whole(least[axis]).min(cells)..whole(most[axis] + 1.0).min(cells)
        });
        let lines = z.flat_map(move |k| y.clone().map(move |j| (j, k)));
        lines.flat_map(move |(j, k)| x.clone().map(move |i| [i, j, k]))
    }

    /// Returns, for each point, an eighth of the sum of a value of its cubes.
    pub(super) fn at_points(&self, of_cells: &[f64]) -> Vec<f64> {
        let mut at_points = vec![0.0; self.corner_of.len()];
        for cell in self.cells().filter(|cell| self.is_in(*cell)) {
            for by in CORNERS {
                let point = self.point_of[self.corner(added(cell, by))];
                at_points[point as usize] += 0.125 * of_cells[self.lattice.index(cell)];
            }
        }
        at_points
    }

    /// Returns the points at the corners of the cube around a place and their trilinear weights. For a place in no cube
    /// of the solid, it is the nearest cube of the solid, and the place is moved to it.
    pub(crate) fn bind(&self, place_m: DVec3) -> CellPlace {
        let at = self.lattice.from_m(place_m);
        let mut cell = [0, 1, 2].map(|axis| whole(at[axis]).min(self.lattice.cells[axis] - 1));
        if !self.is_in(cell) {
            cell = self.nearest_cell(cell, at);
        }
        let part = [0, 1, 2].map(|axis| (at[axis] - cell[axis] as f64).clamp(0.0, 1.0));
        CellPlace {
            points: CORNERS.map(|by| self.point_of[self.corner(added(cell, by))]),
            weights: trilinear(part.into()),
        }
    }

    /// Returns the cube of the solid whose middle is nearest to a place in edges, from the cube that it is in.
    fn nearest_cell(&self, from: [usize; 3], at: DVec3) -> [usize; 3] {
        let away = |cell: &[usize; 3]| (DVec3::from_array(cell.map(|at| at as f64)) + 0.5).distance_squared(at);
        let most = self.lattice.cells.iter().copied().max().unwrap_or(1);
        for reach in 1..=most {
            let [x, y, z] = [0, 1, 2]
                .map(|axis| from[axis].saturating_sub(reach)..(from[axis] + reach + 1).min(self.lattice.cells[axis]));
            let cells = z.flat_map(|k| y.clone().map(move |j| [j, k]));
            let cells = cells.flat_map(|[j, k]| x.clone().map(move |i| [i, j, k]));
            let found = cells.filter(|cell| self.is_in(*cell)).min_by(|a, b| away(a).total_cmp(&away(b)));
            if let Some(found) = found {
                return found;
            }
        }
        from
    }
}

/// Triangles that enclose a space.
struct Enclosing {
    mesh: TriangleMesh,
    /// Whether they form a surface, each edge of which has two of them.
    is_surface: bool,
    /// What was done with the mesh of the scene, and doubts about it.
    findings: Vec<String>,
}

impl Enclosing {
    /// Joins the triangles of a mesh, and turns them outward as far as they form surfaces.
    ///
    /// # Errors
    /// Refuses a mesh without a triangle that has an area, and one with a wrong number (empty field).
    fn of(mesh: TriangleMesh) -> Result<Self> {
        let prepared = prepare(mesh);
        let report = prepared.report();
        if let Some(finding) = report.refusal_of_solid() {
            return Err(Refusal::new(Reason::Unreadable, "", to_repair(finding)));
        }
        let is_surface = report.refusal().is_none();
        Ok(Enclosing { findings: findings_of(&prepared.notes, &report), mesh: prepared.mesh, is_surface })
    }
}

/// Returns the surface around what triangles enclose, to half a cube of a lattice, with the groups of the triangles: the
/// vertex nearest to each of theirs.
#[allow(clippy::cast_possible_truncation)]
fn rebuilt(mesh: &TriangleMesh, lattice: &Lattice) -> TriangleMesh {
    let finer = Lattice { edge_m: 0.5 * lattice.edge_m, cells: lattice.cells.map(|cells| 2 * cells), ..*lattice };
    let mut surface = surface_of(&filled(&mesh.vertices_m, &mesh.triangles, &finer).parts, &finer);
    let Ok(places) = MeshShape::new(surface.vertices_m.clone(), surface.triangles.clone(), |_, _, _| false) else {
        return surface;
    };
    for group in &mesh.groups {
        let nearest = |vertex: &u32| nearest_vertex(&places, mesh.vertices_m[*vertex as usize]);
        let mut vertices: Vec<u32> = group.vertices.iter().map(nearest).collect();
        vertices.sort_unstable();
        vertices.dedup();
        surface.groups.push(Group { name: group.name.clone(), vertices });
    }
    surface
}

/// Returns the vertex of a surface nearest to a place, m: a corner of the nearest triangle.
fn nearest_vertex(surface: &MeshShape, place_m: DVec3) -> u32 {
    let Some(place) = surface.surface().nearest(place_m) else { return 0 };
    let corners = surface.surface().triangle(&place);
    let most = (0..3).max_by(|a, b| place.barycentric[*a].total_cmp(&place.barycentric[*b])).unwrap_or(0);
    corners[most]
}

/// Returns a number without its fraction; 0 if it is negative.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn whole(number: f64) -> usize {
    number.max(0.0) as usize
}

/// Returns `looks`³ places in a cube, evenly apart, m.
#[allow(clippy::cast_precision_loss)]
pub(super) fn places_in_cube(middle_m: DVec3, edge_m: f64, looks: usize) -> impl Iterator<Item = DVec3> {
    let step_m = edge_m / looks as f64;
    let first_m = middle_m - 0.5 * (edge_m - step_m);
    (0..looks.pow(3)).map(move |look| {
        let at = [look % looks, look / looks % looks, look / looks / looks].map(|at| at as f64);
        first_m + step_m * DVec3::from_array(at)
    })
}

fn added(cell: [usize; 3], by: [usize; 3]) -> [usize; 3] {
    std::array::from_fn(|axis| cell[axis] + by[axis])
}

/// Returns the edge of cubes of which about `count` fill a surface, m.
fn edge_for(mesh: &TriangleMesh, count: f64) -> Result<f64> {
    if count < 1.0 {
        return Err(Refusal::new(Reason::OutOfRange, "cell_m", "must be at least 1"));
    }
    let volume_m3 = report::volume(&mesh.vertices_m, &mesh.triangles).abs();
    let edge_m = (volume_m3 / count).cbrt();
    if edge_m > 0.0 { Ok(edge_m) } else { Err(Refusal::new(Reason::Unreadable, "", "encloses no volume")) }
}

/// Returns a lattice around a box, so that fixed planes across an axis meet corners, and otherwise the box is in its
/// middle.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn lattice_around(extent: Extent, edge_m: f64, fixed: &[FixedPart]) -> Lattice {
    let mut origin_m = DVec3::ZERO;
    let mut cells = [1; 3];
    for axis in 0..3 {
        let size = extent.size_m()[axis] / edge_m;
        let fitting = (size - 1e-6).ceil().max(1.0);
        let plane_m = fixed.iter().find_map(|part| match part {
            FixedPart::Plane { plane_m, normal, .. } if along_axis(*normal) == Some(axis) => Some(plane_m[axis]),
            _ => None,
        });
        let least_m = extent.least_m[axis];
        let (first_m, count) = match plane_m {
            Some(plane_m) => {
                let below = ((plane_m - least_m) / edge_m - 1e-6).ceil();
                let first_m = plane_m - below * edge_m;
                (first_m, ((extent.most_m[axis] - first_m) / edge_m - 1e-6).ceil().max(1.0))
            }
            None => (least_m - 0.5 * (fitting - size) * edge_m, fitting),
        };
        origin_m[axis] = first_m;
        cells[axis] = count as usize;
    }
    Lattice { origin_m, edge_m, cells }
}

impl RestShape for SolidShape {
    fn describe(&self) -> String {
        let cells = self.parts.iter().filter(|part| **part > 0.0).count();
        format!("{cells} cubes of {} m, {} points", legible(self.lattice.edge_m), self.corner_of.len())
    }

    fn point_count(&self) -> usize {
        self.corner_of.len()
    }

    fn name(&self, point: PointId) -> PointName {
        PointName::Vertex(self.vertex_of[point.index()])
    }

    /// A vertex of the surface stands for the corner of its cube that moves most with it.
    fn find(&self, field: &str, name: PointName) -> Result<PointId> {
        let PointName::Vertex(vertex) = name else { return self.surface.find(field, name) };
        match self.bound.get(vertex as usize) {
            Some(cell) => Ok(cell.most_moving()),
            None => self.surface.find(field, name),
        }
    }

    fn rest_m(&self, point: PointId) -> DVec3 {
        self.corner_m(self.corner_of(point))
    }

    /// Returns the normal of the nearest vertex of the surface.
    fn normal(&self, point: PointId) -> DVec3 {
        self.surface.normals()[self.vertex_of[point.index()] as usize]
    }

    fn is_fixed(&self, point: PointId) -> bool {
        self.is_fixed[point.index()]
    }

    /// Returns the corners of the cubes around a point.
    fn neighbours(&self, point: PointId) -> Vec<PointId> {
        let at = self.corner_at(self.corner_of(point));
        let mut found: Vec<PointId> = Vec::new();
        let cells = CORNERS.iter().filter_map(|by| {
            let cell: [usize; 3] = std::array::from_fn(|axis| at[axis].wrapping_sub(by[axis]));
            (0..3).all(|axis| cell[axis] < self.lattice.cells[axis]).then_some(cell)
        });
        for cell in cells.filter(|cell| self.is_in(*cell)) {
            found.extend(CORNERS.iter().filter_map(|by| self.point_at(added(cell, *by))));
        }
        found.sort_unstable();
        found.dedup();
        found.retain(|other| *other != point);
        found
    }

    /// Of a place that is near no point, it is the point that moves most with the nearest vertex of the surface.
    fn nearest(&self, place_m: DVec3) -> PointId {
        let at = self.lattice.from_m(place_m);
        let corner = [0, 1, 2].map(|axis| whole((at[axis] + 0.5).floor()).min(self.lattice.cells[axis]));
        self.point_at(corner)
            .unwrap_or_else(|| self.bound[nearest_vertex(&self.surface, place_m) as usize].most_moving())
    }

    fn around(&self, place_m: DVec3, radius_m: f64) -> Vec<PointId> {
        let [least, most] = [-radius_m, radius_m].map(|by_m| self.lattice.from_m(place_m + by_m));
        let range =
            |axis: usize| whole(least[axis].ceil())..whole(most[axis].floor() + 1.0).min(self.lattice.cells[axis] + 1);
        let mut found = Vec::new();
        for k in range(2) {
            for j in range(1) {
                let points = range(0).filter_map(|i| self.point_at([i, j, k]));
                found.extend(points.filter(|point| self.rest_m(*point).distance(place_m) <= radius_m));
            }
        }
        found
    }

    fn extent(&self) -> Extent {
        self.surface.extent()
    }

    fn edge_m(&self) -> f64 {
        self.lattice.edge_m
    }

    fn top_m(&self) -> DVec3 {
        self.surface.top_m()
    }

    /// Returns the top: in the middle of the box there may be nothing to touch.
    fn pressed_m(&self) -> DVec3 {
        self.surface.top_m()
    }

    fn approach_m(&self, place_m: DVec3, radius_m: f64, height_m: f64) -> Option<DVec3> {
        self.surface.approach_m(place_m, radius_m, height_m)
    }

    fn prepare_contact(&self) {
        self.surface.prepare_contact();
    }

    fn shown_surface(&self) -> Option<ShownShape<'_>> {
        let shown = self.surface.shown_surface()?;
        Some(ShownShape { groups: &self.groups, in_cells: &self.bound, ..shown })
    }

    fn deepest(&self, way_m: &[DVec3], radius_m: f64) -> Option<Deepest> {
        self.surface.deepest(way_m, radius_m)
    }

    fn most_tip_radius_m(&self) -> (f64, &'static str) {
        self.surface.most_tip_radius_m()
    }

    fn disc_work(&self, radius_m: f64) -> u64 {
        self.surface.disc_work(radius_m)
    }

    fn takes_rigid_tips(&self) -> bool {
        true
    }
}
