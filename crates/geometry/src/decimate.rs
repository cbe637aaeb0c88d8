//! Decimates a mesh: edges collapse, starting with those that change the surface least.
//!
//! The error of a vertex is the sum of squared distances to the planes of the triangles that it stands for (Garland
//! and Heckbert, Surface simplification using quadric error metrics, SIGGRAPH 1997, doi:10.1145/258734.258849). A
//! small part of the edge's length is added, so that flat regions get even edges.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use glam::{DMat3, DVec3};

use crate::topology::Topology;
use crate::tree::{Tree, corners};
use crate::work::spend;
use crate::{Group, TriangleMesh};

/// Weight of the edge length relative to the error of the surface.
const EVEN: f64 = 1e-2;

/// Weight of the border relative to the surface.
const BORDER: f64 = 10.0;

/// Smallest cosine of the angle between a triangle's normals before and after a collapse.
const TURN: f64 = 0.3;

/// Smallest quality of a new triangle (1 for equal sides), unless the old one was worse.
const QUALITY: f64 = 0.2;

/// Number of triangles around a vertex above which it stays as it is: the work for a collapse grows with them.
const MAX_AROUND: usize = 256;

/// Smallest number of vertices of a closed surface; [`decimate`] does not go below it.
pub const MIN_VERTICES: usize = 4;

/// A point on the surface of a mesh, within one of its triangles.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeshPlace {
    /// Index of the triangle in [`TriangleMesh::triangles`].
    pub triangle: u32,
    /// Weights of its three vertices, in the order of the triangle, from 0 to 1; their sum is 1.
    pub barycentric: [f64; 3],
}

/// The result of [`decimate`]: the mesh with fewer vertices, and where the original vertices are on it.
#[derive(Debug, Clone, PartialEq)]
pub struct Decimated {
    /// The decimated mesh, without texture coordinates. A vertex is in a group if one that it replaces was; groups
    /// without a vertex are dropped.
    pub mesh: TriangleMesh,
    /// For each vertex of the original mesh, in its order, the nearest point on this one; empty if this one has no
    /// triangle.
    pub places: Vec<MeshPlace>,
}

/// A weighted sum of squared distances to planes: xᵀ·a·x + 2·b·x + c.
#[derive(Clone, Copy, Default)]
struct Quadric {
    /// xx, xy, xz, yy, yz, zz.
    a: [f64; 6],
    b: DVec3,
    c: f64,
}

impl Quadric {
    /// Creates the squared distance to the plane through a point, times a weight. The normal has unit length.
    fn plane(normal: DVec3, through: DVec3, weight: f64) -> Self {
        let DVec3 { x, y, z } = normal;
        let distance = -normal.dot(through);
        Self {
            a: [x * x, x * y, x * z, y * y, y * z, z * z].map(|part| part * weight),
            b: normal * (distance * weight),
            c: distance * distance * weight,
        }
    }

    fn plus(self, other: Self) -> Self {
        let mut a = self.a;
        a.iter_mut().zip(other.a).for_each(|(own, other)| *own += other);
        Self { a, b: self.b + other.b, c: self.c + other.c }
    }

    fn matrix(&self) -> DMat3 {
        let [xx, xy, xz, yy, yz, zz] = self.a;
        DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz))
    }

    fn at(&self, point: DVec3) -> f64 {
        (point.dot(self.matrix() * point) + 2.0 * self.b.dot(point) + self.c).max(0.0)
    }
}

/// An edge that may collapse. The smallest cost comes first, then the smallest vertices.
struct Candidate {
    cost: f64,
    vertices: [u32; 2],
    place: DVec3,
    /// Number of changes of the vertices when the cost was computed.
    versions: [u32; 2],
}

impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> Ordering {
        // The heap returns the largest first.
        other.cost.total_cmp(&self.cost).then_with(|| other.vertices.cmp(&self.vertices))
    }
}

impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Candidate {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Candidate {}

/// Collapses edges until at most `vertices` are left (at least [`MIN_VERTICES`]), or no edge can collapse without
/// folding the surface: then more are left. Border vertices stay on the border; vertices on an edge of more than two
/// triangles, or where surfaces touch, stay in place. All coordinates must be finite and all indices in range;
/// vertices without triangles are dropped.
///
/// The cost of an edge of length l is Q(x) + 0.01·l⁴. Q(x) = xᵀAx + 2b·x + c is the sum of the squared distances of x
/// from the planes of the triangles at both ends, weighted by their areas. The edge collapses to x = −A⁻¹b, where Q is
/// least, or to the best of both ends and the middle.
#[must_use]
pub fn decimate(mesh: &TriangleMesh, vertices: usize) -> Decimated {
    let mut work = Decimation::new(mesh);
    work.collapse_down_to(vertices.max(4));
    work.finish(mesh)
}

/// The state of a decimation.
struct Decimation {
    at: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
    /// The triangles of each vertex.
    around: Vec<Vec<u32>>,
    quadrics: Vec<Quadric>,
    is_border: Vec<bool>,
    /// Whether a vertex is not manifold: its edges do not collapse.
    is_fixed: Vec<bool>,
    versions: Vec<u32>,
    /// The vertex that replaces each one; itself if it still exists.
    stands_in: Vec<u32>,
    left: usize,
    heap: BinaryHeap<Candidate>,
}

fn normal([a, b, c]: [DVec3; 3]) -> DVec3 {
    (b - a).cross(c - a)
}

/// 1 for a triangle with equal sides, 0 for one without area: 4√3·A/Σ l², with A the area and l the sides.
fn quality(triangle: [DVec3; 3]) -> f64 {
    let [a, b, c] = triangle;
    let squares = (b - a).length_squared() + (c - b).length_squared() + (a - c).length_squared();
    2.0 * 3.0_f64.sqrt() * normal(triangle).length() / squares
}

impl Decimation {
    fn new(mesh: &TriangleMesh) -> Self {
        let count = mesh.vertices_m.len();
        let topology = Topology::new(count, &mesh.triangles);
        let mut work = Self {
            at: mesh.vertices_m.clone(),
            triangles: mesh.triangles.clone(),
            around: vec![Vec::new(); count],
            quadrics: vec![Quadric::default(); count],
            is_border: vec![false; count],
            is_fixed: topology.fans.iter().map(|fans| *fans > 1).collect(),
            versions: vec![0; count],
            stands_in: (0..).take(count).collect(),
            left: topology.fans.iter().filter(|fans| **fans > 0).count(),
            heap: BinaryHeap::new(),
        };
        for (number, triangle) in (0..).zip(&mesh.triangles) {
            if topology.component[number as usize].is_none() {
                continue;
            }
            let at = corners(&work.at, *triangle);
            let across = normal(at);
            let plane = Quadric::plane(across.normalize_or_zero(), at[0], across.length() / 2.0);
            for vertex in triangle.map(|vertex| vertex as usize) {
                work.around[vertex].push(number);
                work.quadrics[vertex] = work.quadrics[vertex].plus(plane);
            }
        }
        for edge in &topology.edges {
            let [a, b] = edge.vertices.map(|vertex| vertex as usize);
            match topology.sides(edge) {
                [side] => {
                    // A plane through the border, perpendicular to the surface.
                    let along = work.at[b] - work.at[a];
                    let surface = normal(corners(&work.at, mesh.triangles[side.triangle as usize]));
                    let across = along.cross(surface).normalize_or_zero();
                    let plane = Quadric::plane(across, work.at[a], BORDER * along.length_squared());
                    for vertex in [a, b] {
                        work.is_border[vertex] = true;
                        work.quadrics[vertex] = work.quadrics[vertex].plus(plane);
                    }
                }
                [_, _] => {}
                _ => [a, b].into_iter().for_each(|vertex| work.is_fixed[vertex] = true),
            }
        }
        for edge in &topology.edges {
            work.consider(edge.vertices);
        }
        work
    }

    /// Returns the number of triangles that contain both vertices.
    fn shared(&self, [a, b]: [u32; 2]) -> usize {
        self.around[a as usize].iter().filter(|triangle| self.triangles[**triangle as usize].contains(&b)).count()
    }

    /// Pushes an edge to the heap, if it may collapse at all.
    fn consider(&mut self, vertices: [u32; 2]) {
        let [a, b] = vertices.map(|vertex| vertex as usize);
        if self.around[a].len() + self.around[b].len() > MAX_AROUND {
            return;
        }
        let both_border = self.is_border[a] && self.is_border[b];
        // An edge across the surface from border to border: its collapse would pinch the surface.
        let pinches = both_border && self.shared(vertices) != 1;
        if self.is_fixed[a] || self.is_fixed[b] || pinches {
            return;
        }
        let quadric = self.quadrics[a].plus(self.quadrics[b]);
        let (from, to) = (self.at[a], self.at[b]);
        let middle = (from + to) / 2.0;
        let mut places = vec![middle, from, to];
        let matrix = quadric.matrix();
        let trace = matrix.x_axis.x + matrix.y_axis.y + matrix.z_axis.z;
        if matrix.determinant().abs() > 1e-6 * trace * trace * trace {
            let best = matrix.inverse() * -quadric.b;
            // Not far away, where nearly parallel planes meet.
            if best.is_finite() && best.distance(middle) <= from.distance(to) {
                places.insert(0, best);
            }
        }
        if self.is_border[a] != self.is_border[b] {
            places = vec![if self.is_border[a] { from } else { to }];
        }
        let length = from.distance_squared(to);
        let mut best: Option<(f64, DVec3)> = None;
        for place in places {
            let error = quadric.at(place);
            if best.is_none_or(|(least, _)| error < least) {
                best = Some((error, place));
            }
        }
        if let Some((error, place)) = best {
            // Both are fourth powers of a length.
            let cost = error + EVEN * length * length;
            let versions = [self.versions[a], self.versions[b]];
            self.heap.push(Candidate { cost, vertices, place, versions });
        }
    }

    fn collapse_down_to(&mut self, vertices: usize) {
        while self.left > vertices {
            let Some(candidate) = self.heap.pop() else { break };
            spend(1);
            let [a, b] = candidate.vertices;
            let is_current = candidate.versions == [self.versions[a as usize], self.versions[b as usize]]
                && self.stands_in[a as usize] == a
                && self.stands_in[b as usize] == b;
            if is_current && self.may_collapse(&candidate) {
                self.collapse(&candidate);
            }
        }
    }

    /// Returns the neighbours of a vertex, ascending.
    fn neighbours(&self, vertex: u32) -> Vec<u32> {
        let own = self.around[vertex as usize].iter().flat_map(|triangle| self.triangles[*triangle as usize]);
        let mut neighbours: Vec<u32> = own.filter(|other| *other != vertex).collect();
        neighbours.sort_unstable();
        neighbours.dedup();
        neighbours
    }

    /// Returns whether the surface stays a manifold, without folds and new slivers.
    fn may_collapse(&self, candidate: &Candidate) -> bool {
        let [a, b] = candidate.vertices;
        spend(8 * (self.around[a as usize].len() + self.around[b as usize].len()));
        let shared = self.shared(candidate.vertices);
        let (of_a, of_b) = (self.neighbours(a), self.neighbours(b));
        let mut common = of_a.iter().filter(|vertex| of_b.binary_search(vertex).is_ok());
        if common.clone().any(|vertex| self.around[*vertex as usize].len() > MAX_AROUND) {
            return false;
        }
        let common = common.by_ref().count();
        // The common neighbours must be only those opposite the edge; otherwise a ring of three would close up.
        if common != shared || shared == 0 || (of_a.len() <= 3 && of_b.len() <= 3) {
            return false;
        }
        let stays = |vertex: u32, other: u32| {
            let kept = self.around[vertex as usize].iter().map(|triangle| self.triangles[*triangle as usize]);
            kept.filter(|triangle| !triangle.contains(&other)).all(|triangle| {
                let old = corners(&self.at, triangle);
                let mut new = old;
                new.iter_mut().zip(triangle).filter(|(_, of)| *of == vertex).for_each(|(at, _)| *at = candidate.place);
                let (before, after) = (normal(old), normal(new));
                let is_even = quality(new) >= QUALITY.min(quality(old));
                is_even && before.dot(after) >= TURN * before.length() * after.length()
            })
        };
        stays(a, b) && stays(b, a)
    }

    /// Collapses an edge into its first vertex.
    fn collapse(&mut self, candidate: &Candidate) {
        let [a, b] = candidate.vertices;
        let gone: Vec<u32> = std::mem::take(&mut self.around[b as usize]);
        for number in gone {
            let triangle = self.triangles[number as usize];
            if triangle.contains(&a) {
                for vertex in triangle {
                    self.around[vertex as usize].retain(|other| *other != number);
                }
            } else {
                self.triangles[number as usize] = triangle.map(|vertex| if vertex == b { a } else { vertex });
                self.around[a as usize].push(number);
            }
        }
        self.quadrics[a as usize] = self.quadrics[a as usize].plus(self.quadrics[b as usize]);
        self.is_border[a as usize] |= self.is_border[b as usize];
        self.at[a as usize] = candidate.place;
        self.stands_in[b as usize] = a;
        self.left -= 1;
        self.versions[a as usize] += 1;
        for neighbour in self.neighbours(a) {
            self.consider([a.min(neighbour), a.max(neighbour)]);
        }
    }

    fn finish(mut self, before: &TriangleMesh) -> Decimated {
        let mut is_there = vec![false; self.triangles.len()];
        self.around.iter().flatten().for_each(|triangle| is_there[*triangle as usize] = true);
        let mut there = is_there.iter();
        self.triangles.retain(|_| *there.next().unwrap_or(&false));
        let mut number_of = vec![None; self.at.len()];
        self.triangles.iter().flatten().for_each(|vertex| number_of[*vertex as usize] = Some(0));
        let mut mesh = TriangleMesh::default();
        for (number, at) in number_of.iter_mut().zip(&self.at).filter(|(number, _)| number.is_some()) {
            *number = u32::try_from(mesh.vertices_m.len()).ok();
            mesh.vertices_m.push(*at);
        }
        let new = |vertex: u32| number_of.get(vertex as usize).copied().flatten();
        let last = last_of(&self.stands_in);
        mesh.triangles =
            self.triangles.iter().map(|triangle| triangle.map(|vertex| new(vertex).unwrap_or(0))).collect();
        for group in &before.groups {
            spend(group.vertices.len());
            let of = |vertex: &u32| last.get(*vertex as usize).and_then(|last| new(*last));
            let mut vertices: Vec<u32> = group.vertices.iter().filter_map(of).collect();
            vertices.sort_unstable();
            vertices.dedup();
            mesh.groups.push(Group { name: group.name.clone(), vertices });
        }
        mesh.groups.retain(|group| !group.vertices.is_empty());
        let all = (0..).take(mesh.triangles.len());
        let tree = Tree::new(&mesh.vertices_m, &mesh.triangles, all);
        let nearest = before.vertices_m.iter().filter_map(|at| tree.nearest((&mesh.vertices_m, &mesh.triangles), *at));
        let places =
            nearest.map(|found| MeshPlace { triangle: found.triangle, barycentric: found.barycentric }).collect();
        drop(tree);
        Decimated { mesh, places }
    }
}

/// Returns for each vertex the last of its chain of replacements, which replaces itself.
fn last_of(stands_in: &[u32]) -> Vec<u32> {
    let mut last = stands_in.to_vec();
    for vertex in 0..last.len() {
        let mut end = last[vertex];
        while last[end as usize] != end {
            end = last[end as usize];
        }
        // Shortens the chain for later searches.
        let mut at = vertex;
        while last[at] != end {
            at = std::mem::replace(&mut last[at], end) as usize;
        }
    }
    last
}
