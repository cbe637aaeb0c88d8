//! Repairs meshes: weld vertices, drop triangles, resolve non-manifold edges, orient, fill holes. Each step reports
//! what it did and where the vertices went; the result is compared with the original surface.

use std::cmp::Reverse;
use std::collections::HashMap;

use glam::DVec3;
use serde::Serialize;

use crate::delaunay::flip_degenerate;
use crate::join::{Odd, join, places};
use crate::orient::{Oriented, orient};
use crate::prepare::note;
use crate::report::{area, extent, has_area, volume};
use crate::topology::{Sets, Topology};
use crate::tree::corners;
use crate::walls::{doubled, match_diagonals};
use crate::{Group, TriangleMesh};

/// Default welding tolerance, as a fraction of the diagonal of the bounding box.
const WELD: f64 = 1e-6;

/// Maximum number of vertices of a cell that others are compared with.
const COMPARED: usize = 8;

/// Maximum number of rounds in which triangles are halved at an edge that surfaces share: a triangle has three edges.
const HALVINGS: usize = 8;

/// A change of the area or of the volume by more than this fraction is reported as a loss.
const LOST: f64 = 0.01;

/// Steps of a repair, in the order in which [`repair`] takes them. The default is all of them, with holes of up to 64
/// edges.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Repair {
    /// Weld vertices that are at most this far apart, m. `None`: a millionth of the diagonal of the bounding box; 0,
    /// or a value that is negative or not finite: only vertices at exactly the same position.
    pub weld_m: Option<f64>,
    /// Drop triangles without area, triangles with the vertices of an earlier one, and internal walls that are
    /// present from both sides.
    pub degenerate: bool,
    /// Pair the triangles of edges that more than two triangles share, so that each solid is closed; give each
    /// surface its own copy of a vertex that several surfaces share.
    pub manifold: bool,
    /// Orient triangles consistently: closed surfaces outwards from the tissue, so walls of cavities into the
    /// cavities.
    pub orient: bool,
    /// Keep the connected surface with the most triangles, along with surfaces that touch it at edges and surfaces
    /// inside it.
    pub largest: bool,
    /// Fill holes with at most this many edges (0: none): holes with three edges, and holes with a border shorter than
    /// the diagonal of the bounding box. A hole with more than three edges gets a vertex in its middle.
    pub hole_edges: usize,
    /// Drop vertices that no triangle uses, and groups without a vertex.
    pub unused: bool,
}

impl Default for Repair {
    fn default() -> Self {
        Self {
            weld_m: None,
            degenerate: true,
            manifold: true,
            orient: true,
            largest: true,
            hole_edges: 64,
            unused: true,
        }
    }
}

/// The result of [`repair`]: the mesh, what was done, and how it compares with the original.
#[derive(Debug, Clone, PartialEq)]
pub struct Repaired {
    /// The repaired mesh; it may still have faults.
    pub mesh: TriangleMesh,
    /// What was done, with counts, one sentence each in the order of the work; empty if the mesh was not changed.
    pub told: Vec<String>,
    /// For each vertex of the original mesh, its index in the new mesh; `None` if it was dropped. Welded vertices have
    /// the same index; added ones have no entry.
    pub vertex_of: Vec<Option<u32>>,
    /// Size of the surface before the repair, triangles with invalid vertices left out.
    pub before: SurfaceMeasure,
    /// Size of the surface after the repair.
    pub after: SurfaceMeasure,
    /// Ways in which the result falls short of the request, one clause each: more than 1 % of the area dropped or of
    /// the volume changed, a surface no longer closed, small holes left open. Empty if it does not.
    pub faults: Vec<String>,
}

/// Area and enclosed volume of a surface.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct SurfaceMeasure {
    /// The area of all triangles, m²: Σ |(b − a) × (c − a)|/2.
    pub area_m2: f64,
    /// The volume inside, m³: |Σ a·(b × c)|/6 over the triangles (a, b, c). `None` unless as many triangles run one
    /// way along each edge as the other: the surface is then closed and oriented. Vertices at one position count as
    /// one. In [`Repaired::before`] it is measured without copies of triangles, and with those turned that must be.
    pub volume_m3: Option<f64>,
}

impl SurfaceMeasure {
    /// Measures a surface. Its coordinates must be finite and its indices in range, or it panics or is NaN.
    #[must_use]
    pub fn of(mesh: &TriangleMesh) -> Self {
        let (vertices, triangles) = (&mesh.vertices_m, &mesh.triangles);
        let area_m2 = triangles.iter().map(|triangle| area(corners(vertices, *triangle)).0).sum();
        let places = places(vertices);
        let mut ways: Vec<([u32; 2], bool)> = Vec::with_capacity(3 * triangles.len());
        for triangle in triangles {
            let [a, b, c] = triangle.map(|vertex| places[vertex as usize]);
            let sides = [[a, b], [b, c], [c, a]].into_iter().filter(|[from, to]| from != to);
            ways.extend(sides.map(|[from, to]| ([from.min(to), from.max(to)], from < to)));
        }
        ways.sort_unstable();
        let mut edges = ways.chunk_by(|a, b| a.0 == b.0);
        let is_closed = edges.all(|edge| 2 * edge.iter().filter(|way| way.1).count() == edge.len());
        let volume_m3 = (is_closed && !ways.is_empty()).then(|| volume(vertices, triangles).abs());
        Self { area_m2, volume_m3 }
    }
}

/// Repairs a copy of `mesh` by the steps of `how`. Before all others, triangles whose vertices don't exist or are not
/// finite are dropped. It never fails: [`Repaired::faults`] lists what it could not do.
#[must_use]
pub fn repair(mesh: &TriangleMesh, how: &Repair) -> Repaired {
    let mut work = RepairedMesh {
        mesh: mesh.clone(),
        told: Vec::new(),
        vertex_of: (0..).take(mesh.vertices_m.len()).map(Some).collect(),
        faults: Vec::new(),
    };
    work.drop_invalid();
    let mut before = SurfaceMeasure::of(&work.mesh);
    work.weld(how.weld_m);
    let copies = if how.degenerate { work.drop_degenerate() } else { 0 };
    let parts = work.join(how);
    if before.volume_m3.is_none() || copies > 0 || parts.oriented.is_turned.contains(&true) {
        before.volume_m3 = SurfaceMeasure::of(&work.mesh).volume_m3;
    }
    if how.largest {
        work.keep_largest(&parts);
    }
    if how.hole_edges > 0 {
        work.fill_holes(how.hole_edges);
        // A surface that is closed now has an inside.
        work.join(how);
    }
    if how.unused {
        work.drop_unused();
    }
    let after = SurfaceMeasure::of(&work.mesh);
    work.compare(&before, &after);
    Repaired { mesh: work.mesh, told: work.told, vertex_of: work.vertex_of, before, after, faults: work.faults }
}

/// A mesh that is being repaired.
struct RepairedMesh {
    mesh: TriangleMesh,
    told: Vec<String>,
    vertex_of: Vec<Option<u32>>,
    faults: Vec<String>,
}

/// The triangles, connected at edges to parts.
struct Parts {
    oriented: Oriented,
    /// Pairs of triangles of parts that touch at an edge.
    touching: Vec<[u32; 2]>,
}

impl RepairedMesh {
    fn tell(&mut self, count: usize, what: &str) {
        note(&mut self.told, count, what);
    }

    fn topology(&self) -> Topology {
        Topology::new(self.mesh.vertices_m.len(), &self.mesh.triangles)
    }

    /// Keeps the marked triangles. Returns the number of dropped triangles.
    fn keep(&mut self, keep: &[bool]) -> usize {
        let before = self.mesh.triangles.len();
        self.mesh.keep_triangles(keep);
        before - self.mesh.triangles.len()
    }

    /// Renumbers vertices, in triangles, groups and the map.
    fn renumber(&mut self, new_of: &[Option<u32>]) {
        let new = |vertex: u32| new_of.get(vertex as usize).copied().flatten();
        for vertex in self.mesh.triangles.iter_mut().flatten() {
            *vertex = new(*vertex).unwrap_or(*vertex);
        }
        for group in &mut self.mesh.groups {
            group.vertices = group.vertices.iter().filter_map(|vertex| new(*vertex)).collect();
            group.vertices.sort_unstable();
            group.vertices.dedup();
        }
        for vertex in &mut self.vertex_of {
            *vertex = vertex.and_then(new);
        }
    }

    fn drop_invalid(&mut self) {
        let vertices = &self.mesh.vertices_m;
        let is_valid = |vertex: &u32| vertices.get(*vertex as usize).is_some_and(|at| at.is_finite());
        let keep: Vec<bool> = self.mesh.triangles.iter().map(|triangle| triangle.iter().all(is_valid)).collect();
        let dropped = self.keep(&keep);
        self.tell(dropped, "Triangles dropped because their vertices do not exist or are not finite");
    }

    fn weld(&mut self, weld_m: Option<f64>) {
        let vertices = &self.mesh.vertices_m;
        let tolerance = weld_m.unwrap_or_else(|| WELD * extent(vertices, &self.mesh.triangles).length());
        let tolerance = if tolerance.is_finite() { tolerance.max(0.0) } else { 0.0 };
        // The grid cell of a position; without a tolerance, the position itself. Used for lookups only.
        let mut cells: HashMap<[i64; 3], Vec<u32>> = HashMap::new();
        #[allow(clippy::cast_possible_truncation)]
        let cell = |at: DVec3| -> [i64; 3] {
            if tolerance > 0.0 {
                (at / tolerance).floor().to_array().map(|part| part as i64)
            } else {
                (at + DVec3::ZERO).to_array().map(|part| part.to_bits().cast_signed())
            }
        };
        let reach = if tolerance > 0.0 { 1 } else { 0 };
        let mut new_of: Vec<Option<u32>> = Vec::with_capacity(vertices.len());
        let mut welded = 0;
        for (number, at) in (0_u32..).zip(vertices) {
            let mut found = None;
            if at.is_finite() {
                let own = cell(*at);
                for offset in 0..27 {
                    let offset = [offset % 3 - 1, offset / 3 % 3 - 1, offset / 9 - 1];
                    if offset.iter().any(|part: &i64| part.abs() > reach) {
                        continue;
                    }
                    let place = [0, 1, 2].map(|axis| own[axis].saturating_add(offset[axis]));
                    let others = cells.get(&place).map_or(&[][..], Vec::as_slice);
                    let near = others.iter().filter(|other| at.distance(vertices[**other as usize]) <= tolerance);
                    found = found.into_iter().chain(near.copied()).min();
                }
                if found.is_none() {
                    let here = cells.entry(own).or_default();
                    if here.len() < COMPARED {
                        here.push(number);
                    }
                }
            }
            welded += usize::from(found.is_some());
            new_of.push(found.or(Some(number)));
        }
        if welded > 0 {
            self.renumber(&new_of);
            self.tell(welded, "Vertices welded with an earlier one");
        }
    }

    /// Returns the number of dropped duplicate triangles.
    fn drop_degenerate(&mut self) -> usize {
        let flipped = flip_degenerate(&mut self.mesh);
        self.tell(flipped, "Edges flipped beside triangles without area");
        let vertices = &self.mesh.vertices_m;
        let keep: Vec<bool> = self.mesh.triangles.iter().map(|triangle| has_area(vertices, *triangle)).collect();
        let dropped = self.keep(&keep);
        self.tell(dropped, "Triangles without area dropped");
        match_diagonals(&mut self.mesh);
        let found = doubled(&self.mesh, &places(&self.mesh.vertices_m));
        self.keep(&found.keep);
        self.tell(found.copies, "Triangles dropped that have the vertices of an earlier one");
        self.tell(found.walls, "Triangles dropped that are walls inside, there from both sides");
        found.copies
    }

    /// Connects each triangle to at most one other triangle per edge. If requested, gives touching surfaces separate
    /// vertices, and reorients triangles.
    fn join(&mut self, how: &Repair) -> Parts {
        let odd = if how.manifold { Odd::Pair } else { Odd::Stay };
        let joined = |mesh: &TriangleMesh| join(&mesh.vertices_m, &mesh.triangles, &places(&mesh.vertices_m), odd);
        let mut joint = joined(&self.mesh);
        if how.manifold {
            self.tell(joint.paired_edges, "Edges that more than two triangles had, whose triangles were paired");
            self.tell(joint.left_over, "Triangles that got a border of their own at such an edge");
            let (mut added, mut halved, mut again) = (joint.split_vertices(&mut self.mesh).len(), 0, HALVINGS);
            loop {
                let halves = joint.halve(&mut self.mesh).len();
                if halves == 0 || again == 0 {
                    break;
                }
                (halved, again) = (halved + halves, again - 1);
                joint = joined(&self.mesh);
                added += joint.split_vertices(&mut self.mesh).len();
            }
            self.tell(added, "Vertices added where surfaces touched at a vertex or an edge");
            self.tell(halved, "Triangles halved where surfaces touched at an edge, both ends of which they shared");
        }
        let oriented = orient(&self.mesh.vertices_m, &self.mesh.triangles, &joint);
        if how.orient {
            self.mesh.turn_triangles(&oriented.is_turned);
            let notes: Vec<String> = oriented.notes().into_iter().filter(|note| !self.told.contains(note)).collect();
            self.told.extend(notes);
        }
        let first = |pair: &[[u32; 2]; 2]| pair[0][0] / 3;
        let touching = joint.touching.iter().flat_map(|of| of.windows(2).map(|two| [first(&two[0]), first(&two[1])]));
        Parts { oriented, touching: touching.collect() }
    }

    fn keep_largest(&mut self, Parts { oriented, touching }: &Parts) {
        let parts = &oriented.parts;
        let mut sets = Sets::new(parts.len());
        for [a, b] in touching {
            sets.join(oriented.part_of[*a as usize], oriented.part_of[*b as usize]);
        }
        let mut sizes = vec![0_usize; parts.len()];
        for (number, part) in (0..).zip(parts) {
            sizes[sets.find(number) as usize] += part.triangles.len();
        }
        // If several are equally large, the first one.
        let largest = (0_u32..).zip(&sizes).min_by_key(|(_, size)| Reverse(**size)).map(|(number, _)| number);
        let Some(largest) = largest else { return };
        let is_kept: Vec<bool> = (0..)
            .zip(parts)
            .map(|(number, part)| {
                let around = part.around.iter().any(|other| sets.find(*other) == largest);
                sets.find(number) == largest || around
            })
            .collect();
        let smaller = is_kept.iter().filter(|is_kept| !**is_kept).count();
        if smaller == 0 {
            return;
        }
        let keeps = |part: &u32| is_kept.get(*part as usize).copied().unwrap_or(false);
        let keep: Vec<bool> = oriented.part_of.iter().map(keeps).collect();
        let before = SurfaceMeasure::of(&self.mesh).area_m2;
        let dropped = self.keep(&keep);
        let lost = 1.0 - SurfaceMeasure::of(&self.mesh).area_m2 / before;
        self.told.push(format!(
            "Smaller surfaces dropped: {smaller}, with their triangles: {dropped}, and {:.2} % of the area.",
            100.0 * lost
        ));
        if lost > LOST {
            self.faults.push(format!(
                "{:.1} % of the area was in surfaces that are separate from the largest one, and is dropped: if they \
                 belong to it, join them in the program that made the mesh",
                100.0 * lost
            ));
        }
    }

    fn fill_holes(&mut self, most_edges: usize) {
        let topology = self.topology();
        let longest = extent(&self.mesh.vertices_m, &self.mesh.triangles).length();
        let mut uv_of: HashMap<u32, [f32; 2]> = HashMap::new();
        if let Some(uv) = &self.mesh.uv {
            for (triangle, uv) in self.mesh.triangles.iter().zip(uv) {
                uv_of.extend(triangle.iter().copied().zip(uv.iter().copied()));
            }
        }
        let (mut filled, mut added, mut tangled) = (0, 0, 0);
        for hole in topology.holes() {
            let at: Vec<DVec3> = hole.iter().map(|vertex| self.mesh.vertices_m[*vertex as usize]).collect();
            let border: f64 = (0..at.len()).map(|n| at[n].distance(at[(n + 1) % at.len()])).sum();
            let mut sorted = hole.clone();
            sorted.sort_unstable();
            sorted.dedup();
            let is_loop = hole.len() >= 3 && sorted.len() == hole.len() && is_border(&topology, &hole);
            // The boundary of an open sheet is longer than the sheet. That of a missing triangle in a coarse mesh may
            // be, too.
            let is_small = hole.len() <= most_edges && (hole.len() == 3 || border < longest);
            if !is_loop || !is_small {
                tangled += usize::from(is_small);
                continue;
            }
            let uv = |vertex: u32| uv_of.get(&vertex).copied().unwrap_or_default();
            if let [a, b, c] = hole[..] {
                // A separate triangle also has such a border.
                if border_triangle(&topology, a, b).is_some_and(|own| self.mesh.triangles[own].contains(&c)) {
                    continue;
                }
                if !has_area(&self.mesh.vertices_m, [a, b, c]) {
                    continue;
                }
                self.mesh.triangles.push([a, b, c]);
                if let Some(list) = &mut self.mesh.uv {
                    list.push([uv(a), uv(b), uv(c)]);
                }
            } else {
                let mean = at.iter().sum::<DVec3>() / at.len() as f64;
                if !mean.is_finite() {
                    continue;
                }
                let middle = u32::try_from(self.mesh.vertices_m.len()).unwrap_or(u32::MAX);
                self.mesh.vertices_m.push(mean);
                added += 1;
                let sum =
                    hole.iter().map(|vertex| uv(*vertex)).fold([0.0; 2], |sum, uv| [sum[0] + uv[0], sum[1] + uv[1]]);
                let middle_uv = sum.map(|part| part / hole.len() as f32);
                for (n, a) in hole.iter().enumerate() {
                    let b = hole[(n + 1) % hole.len()];
                    self.mesh.triangles.push([*a, b, middle]);
                    if let Some(list) = &mut self.mesh.uv {
                        list.push([uv(*a), uv(b), middle_uv]);
                    }
                }
            }
            filled += 1;
        }
        self.tell(filled, "Holes filled");
        self.tell(added, "Vertices added in the middle of holes");
        if tangled > 0 {
            self.faults.push(format!("small holes whose borders are not loops are left open: {tangled}"));
        }
    }

    /// Reports losses in comparison with the original surface.
    fn compare(&mut self, before: &SurfaceMeasure, after: &SurfaceMeasure) {
        match (before.volume_m3, after.volume_m3) {
            (Some(was), Some(is)) if (is - was).abs() > LOST * was => self.faults.push(format!(
                "the surface enclosed {:.3} ml, and encloses {:.3} ml now",
                was * 1e6,
                is * 1e6
            )),
            (Some(was), None) => {
                self.faults.push(format!("the surface enclosed {:.3} ml, and is not closed now", was * 1e6));
            }
            _ => {}
        }
    }

    fn drop_unused(&mut self) {
        let mut new_of = vec![None; self.mesh.vertices_m.len()];
        for vertex in self.mesh.triangles.iter().flatten() {
            new_of[*vertex as usize] = Some(0);
        }
        let mut kept = 0;
        for new in new_of.iter_mut().filter(|new| new.is_some()) {
            *new = Some(kept);
            kept += 1;
        }
        let dropped = new_of.len() - kept as usize;
        if dropped == 0 {
            return;
        }
        let mut is_kept = new_of.iter().map(Option::is_some);
        self.mesh.vertices_m.retain(|_| is_kept.next().unwrap_or(true));
        self.renumber(&new_of);
        self.mesh.groups.retain(|group: &Group| !group.vertices.is_empty());
        self.tell(dropped, "Vertices dropped that no triangle has");
    }
}

/// Returns whether the last edge of a loop is also a border. If the border edges are an open line, there is no such
/// edge.
fn is_border(topology: &Topology, hole: &[u32]) -> bool {
    border_triangle(topology, hole[0], hole[hole.len() - 1]).is_some()
}

/// Returns the triangle at an edge that belongs to only one triangle.
fn border_triangle(topology: &Topology, a: u32, b: u32) -> Option<usize> {
    let found = topology.edges.binary_search_by(|other| other.vertices.cmp(&[a.min(b), a.max(b)])).ok()?;
    match topology.sides(&topology.edges[found]) {
        [side] => Some(side.triangle as usize),
        _ => None,
    }
}
