//! Mending: weld, drop, split, orient, fill. Each step tells what it did, and where vertices went.

use std::cmp::Reverse;
use std::collections::HashMap;

use glam::DVec3;

use crate::delaunay::flip_degenerate;
use crate::report::{extent, has_area, volume};
use crate::topology::Topology;
use crate::{Group, TriangleMesh};

/// The tolerance of welding, as a part of the diagonal of the bounding box, unless it is given.
const WELD: f64 = 1e-6;

/// Vertices of one cell that others are compared with.
const COMPARED: usize = 8;

/// What is mended. The default is everything.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Repair {
    /// Weld vertices that are this near, m; `None`: a millionth of the diagonal; 0: the same position only.
    pub weld_m: Option<f64>,
    /// Drop triangles without area, and those that have the vertices of an earlier one.
    pub degenerate: bool,
    /// Drop the triangles that an edge has beyond two; give each surface at a shared vertex its own one.
    pub manifold: bool,
    /// Turn triangles to one side; outwards if the surface is closed.
    pub orient: bool,
    /// Keep the connected surface with the most triangles.
    pub largest: bool,
    /// Fill holes with at most so many edges: those with three, and those with a border shorter than the diagonal of the
    /// bounding box.
    pub hole_edges: usize,
    /// Drop vertices that no triangle has.
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

/// A mended mesh.
#[derive(Debug, Clone, PartialEq)]
pub struct Repaired {
    /// The mesh.
    pub mesh: TriangleMesh,
    /// What was done, with counts; empty if nothing was.
    pub told: Vec<String>,
    /// For each vertex of the mesh before, the vertex that it is now; `None` if it was dropped.
    pub vertex_of: Vec<Option<u32>>,
}

/// Mends a mesh. Triangles whose vertices don't exist or are not finite are dropped.
#[must_use]
pub fn repair(mesh: &TriangleMesh, how: &Repair) -> Repaired {
    let mut work =
        Work { mesh: mesh.clone(), told: Vec::new(), vertex_of: (0..).take(mesh.vertices_m.len()).map(Some).collect() };
    work.drop_invalid();
    work.weld(how.weld_m);
    if how.degenerate {
        work.drop_degenerate();
    }
    if how.manifold {
        work.split_edges();
        work.split_vertices();
    }
    if how.orient {
        work.orient();
    }
    if how.largest {
        work.keep_largest();
    }
    if how.hole_edges > 0 {
        work.fill_holes(how.hole_edges);
    }
    if how.orient {
        work.face_outward();
    }
    if how.unused {
        work.drop_unused();
    }
    Repaired { mesh: work.mesh, told: work.told, vertex_of: work.vertex_of }
}

/// A mesh while it is mended.
struct Work {
    mesh: TriangleMesh,
    told: Vec<String>,
    vertex_of: Vec<Option<u32>>,
}

impl Work {
    fn tell(&mut self, count: usize, what: &str) {
        if count > 0 {
            self.told.push(format!("{what}: {count}."));
        }
    }

    fn topology(&self) -> Topology {
        Topology::new(self.mesh.vertices_m.len(), &self.mesh.triangles)
    }

    /// Keeps some triangles; returns how many it drops.
    fn keep(&mut self, keep: &[bool]) -> usize {
        let before = self.mesh.triangles.len();
        let mut kept = keep.iter();
        self.mesh.triangles.retain(|_| *kept.next().unwrap_or(&true));
        if let Some(uv) = &mut self.mesh.uv {
            let mut kept = keep.iter();
            uv.retain(|_| *kept.next().unwrap_or(&true));
        }
        before - self.mesh.triangles.len()
    }

    /// Gives vertices other numbers, in triangles, groups and the map.
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
        // The cell of a position; without a tolerance the position itself. Only looked up.
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

    fn drop_degenerate(&mut self) {
        let flipped = flip_degenerate(&mut self.mesh);
        self.tell(flipped, "Edges flipped beside triangles without area");
        let vertices = &self.mesh.vertices_m;
        let keep: Vec<bool> = self.mesh.triangles.iter().map(|triangle| has_area(vertices, *triangle)).collect();
        let dropped = self.keep(&keep);
        self.tell(dropped, "Triangles without area dropped");
        let mut keep = vec![true; self.mesh.triangles.len()];
        for triangle in self.topology().duplicates {
            keep[triangle as usize] = false;
        }
        let dropped = self.keep(&keep);
        self.tell(dropped, "Triangles dropped that have the vertices of an earlier one");
    }

    /// Drops the triangles that an edge has beyond two: the first one stays, and the next one that faces the same side.
    fn split_edges(&mut self) {
        let topology = self.topology();
        let mut keep = vec![true; self.mesh.triangles.len()];
        for edge in topology.non_manifold_edges() {
            let open: Vec<_> =
                topology.sides(edge).iter().filter(|side| keep[side.triangle as usize]).copied().collect();
            if open.len() <= 2 {
                continue;
            }
            let first = open[0];
            let second = open.iter().find(|side| side.is_forward != first.is_forward).unwrap_or(&open[1]);
            for side in &open {
                keep[side.triangle as usize] = side.triangle == first.triangle || side.triangle == second.triangle;
            }
        }
        let dropped = self.keep(&keep);
        self.tell(dropped, "Triangles dropped at edges that more than two had");
    }

    /// Gives each fan of triangles at a vertex its own vertex; the first one keeps the old one.
    fn split_vertices(&mut self) {
        let topology = self.topology();
        let mut added: HashMap<(u32, u32), u32> = HashMap::new();
        for (triangle, fans) in self.mesh.triangles.iter_mut().zip(&topology.fan_of_corner) {
            for (vertex, fan) in triangle.iter_mut().zip(fans).filter(|(_, fan)| **fan > 0) {
                let old = *vertex;
                let vertices = &mut self.mesh.vertices_m;
                *vertex = *added.entry((old, *fan)).or_insert_with(|| {
                    vertices.push(vertices[old as usize]);
                    u32::try_from(vertices.len() - 1).unwrap_or(old)
                });
            }
        }
        let count = added.len();
        if count > 0 {
            let mut copies: Vec<(u32, u32)> = added.into_iter().map(|((old, _), new)| (old, new)).collect();
            copies.sort_unstable();
            for group in &mut self.mesh.groups {
                let is_in = |copy: &&(u32, u32)| group.vertices.binary_search(&copy.0).is_ok();
                let new: Vec<u32> = copies.iter().filter(is_in).map(|copy| copy.1).collect();
                group.vertices.extend(new);
                group.vertices.sort_unstable();
            }
        }
        self.tell(count, "Vertices added where surfaces touched at a vertex alone");
    }

    /// Turns triangles so that neighbours face the same side as the first one of their surface.
    fn orient(&mut self) {
        let topology = self.topology();
        let count = self.mesh.triangles.len();
        // The neighbours of each triangle, and whether they face the other side.
        let mut neighbours: Vec<Vec<(u32, bool)>> = vec![Vec::new(); count];
        for edge in &topology.edges {
            if let [a, b] = topology.sides(edge) {
                let is_other = a.is_forward == b.is_forward;
                neighbours[a.triangle as usize].push((b.triangle, is_other));
                neighbours[b.triangle as usize].push((a.triangle, is_other));
            }
        }
        let mut is_turned: Vec<Option<bool>> = vec![None; count];
        let (mut turned, mut is_orientable) = (Vec::new(), true);
        for start in 0..count {
            if is_turned[start].is_some() {
                continue;
            }
            is_turned[start] = Some(false);
            let mut surface = vec![start];
            let mut next = 0;
            while let Some(triangle) = surface.get(next).copied() {
                next += 1;
                let own = is_turned[triangle].unwrap_or(false);
                for (neighbour, is_other) in &neighbours[triangle] {
                    let wanted = own != *is_other;
                    match is_turned[*neighbour as usize] {
                        None => {
                            is_turned[*neighbour as usize] = Some(wanted);
                            surface.push(*neighbour as usize);
                        }
                        Some(is) => is_orientable &= is == wanted,
                    }
                }
            }
            // The side that most triangles face.
            let is_most =
                2 * surface.iter().filter(|triangle| is_turned[**triangle] == Some(true)).count() > surface.len();
            turned.extend(surface.into_iter().filter(|triangle| (is_turned[*triangle] == Some(true)) != is_most));
        }
        for triangle in &turned {
            self.turn(*triangle);
        }
        self.tell(turned.len(), "Triangles turned to the side that the others face");
        if !is_orientable {
            self.told.push(
                "The surface has one side only, like a Möbius strip: no way of turning triangles fits.".to_owned(),
            );
        }
    }

    fn turn(&mut self, triangle: usize) {
        self.mesh.triangles[triangle].swap(1, 2);
        if let Some(uv) = &mut self.mesh.uv {
            uv[triangle].swap(1, 2);
        }
    }

    fn keep_largest(&mut self) {
        let topology = self.topology();
        let mut sizes = vec![0_usize; topology.components];
        topology.component.iter().flatten().for_each(|component| sizes[*component as usize] += 1);
        // Of several as large, the first.
        let largest = (0_u32..).zip(&sizes).min_by_key(|(_, size)| Reverse(**size)).map(|(component, _)| component);
        if sizes.len() > 1 {
            let keep: Vec<bool> = topology.component.iter().map(|component| *component == largest).collect();
            let dropped = self.keep(&keep);
            self.told.push(format!("Smaller surfaces dropped: {}, with their triangles: {dropped}.", sizes.len() - 1));
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
        let (mut filled, mut added) = (0, 0);
        for hole in topology.holes() {
            let at: Vec<DVec3> = hole.iter().map(|vertex| self.mesh.vertices_m[*vertex as usize]).collect();
            let border: f64 = (0..at.len()).map(|n| at[n].distance(at[(n + 1) % at.len()])).sum();
            let mut sorted = hole.clone();
            sorted.sort_unstable();
            sorted.dedup();
            let is_loop = hole.len() >= 3 && sorted.len() == hole.len() && is_border(&topology, &hole);
            // The rim of an open sheet is longer than the sheet. A missing triangle of a coarse mesh may be, too.
            let is_small = hole.len() <= most_edges && (hole.len() == 3 || border < longest);
            if !is_loop || !is_small {
                continue;
            }
            let uv = |vertex: u32| uv_of.get(&vertex).copied().unwrap_or_default();
            if let [a, b, c] = hole[..] {
                // A triangle by itself has such a border, too.
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
    }

    fn face_outward(&mut self) {
        let topology = self.topology();
        let is_consistent = topology.inconsistent_edges().next().is_none();
        if topology.is_closed() && is_consistent && volume(&self.mesh.vertices_m, &self.mesh.triangles) < 0.0 {
            (0..self.mesh.triangles.len()).for_each(|triangle| self.turn(triangle));
            self.told.push("All triangles were turned outwards.".to_owned());
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

/// Whether the last edge of a loop is a border too: a line of border edges that is no loop has none there.
fn is_border(topology: &Topology, hole: &[u32]) -> bool {
    border_triangle(topology, hole[0], hole[hole.len() - 1]).is_some()
}

/// The triangle at an edge that has only one.
fn border_triangle(topology: &Topology, a: u32, b: u32) -> Option<usize> {
    let found = topology.edges.binary_search_by(|other| other.vertices.cmp(&[a.min(b), a.max(b)])).ok()?;
    match topology.sides(&topology.edges[found]) {
        [side] => Some(side.triangle as usize),
        _ => None,
    }
}
