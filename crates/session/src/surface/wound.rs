//! The wound of a shown surface: triangles that severed springs cross are split along the line of the cut.
//!
//! A severed spring that is an edge of shown triangles gets two new vertices at the place where it was severed, one for each lip of the
//! wound. Each rides on its own end of the spring: it has the displacement of that end. So the lips lie on each other at rest, and gape
//! as far as the ends do. No mass point is added.
//!
//! A triangle is divided by its severed edges. With one, the cut ends in the triangle: both parts meet at the opposite corner.
//! With two, the corner between them is cut off. With three, all corners are apart, and meet at three vertices in the middle, each
//! of which rides on a corner. The parts have the area of the whole, and no part reaches across a severed edge.
//!
//! ```text
//!        r                  r                  r
//!       /|\                / \                / \
//!      / | \              x   \              x   x
//!     /  |  \            /     \            /  o  \
//!    p---xx--q          p---xx--q          p---xx--q
//! ```
//!
//! Vertices are numbered in the order in which springs were severed, so that a wound that grows keeps its vertices.
//!
//! Between the points of a refined sheet frames interpolate, also across a wound. So a cell of points with a split triangle is drawn
//! without refinement, but for the vertices on its sides, so that no gap opens to its refined neighbours.

use std::collections::BTreeMap;

use glam::DVec3;
use palpate_tissue::shape::PointId;
use palpate_tissue::{Cuts, Model, SeveredJoint};

use super::refine::Refinement;
use super::skin::Skin;

/// How near to an end an edge of a solid's surface is severed at least, as a part of its length.
const NEAREST: f64 = 0.05;

/// A place of a triangle at rest that rides on one of its corners: a vertex of a lip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LipVertex {
    /// The vertex whose displacement it has.
    pub host: u32,
    /// The other vertices that give its place: a second one on an edge, twice, or both others of a triangle.
    pub others: [u32; 2],
    /// How far it is on the way to each of these, from the host on: at rest it is at h + w₀·(o₀ − h) + w₁·(o₁ − h), and so are its texture
    /// coordinates.
    pub weights: [f32; 2],
    /// The version of the topology since which it is shown.
    pub version: u32,
}

impl LipVertex {
    /// Returns the weights of its host and of the others; their sum is 1.
    pub fn shares(&self) -> [f64; 3] {
        let [second, third] = self.weights.map(f64::from);
        [1.0 - second - third, second, third]
    }
}

/// Triangles of a surface that are no longer shown, and what is shown in their place.
#[derive(Debug, Clone, PartialEq)]
pub struct CutTriangles {
    /// The first triangle.
    pub first: u32,
    /// Number of triangles.
    pub count: u32,
    /// The corners of the triangles in their place, counter-clockwise from outside. If the second or the third one is new, the side between
    /// these two is a lip of the wound.
    pub corners: Vec<[u32; 3]>,
    /// The version of the topology since which they are shown.
    pub version: u32,
}

/// The wound of a surface, as changes of its vertices and triangles.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Wound {
    /// The number of the first new vertex: that of the vertices of the whole surface.
    pub first_vertex: u32,
    /// The new vertices, in the order in which they appeared.
    pub vertices: Vec<LipVertex>,
    /// The changed triangles, ascending.
    pub triangles: Vec<CutTriangles>,
}

impl Wound {
    /// Splits the surface that frames of `refinement` show along the severed springs of a tissue. `skin` is that of its model. `None` if
    /// a coarser mesh is simulated than is shown: such a surface is shown whole.
    #[allow(clippy::cast_possible_truncation)]
    pub fn of(model: &Model, cuts: &Cuts, skin: Option<&Skin>, refinement: Refinement) -> Option<Self> {
        let Some(skin) = skin else {
            let points = refinement.coarsest();
            let triangle = |number: usize| {
                let [a, b, c, d, e, f] = points.triangles(number / 2);
                if number.is_multiple_of(2) { [a, b, c] } else { [d, e, f] }.map(|vertex| vertex as u32)
            };
            let edges = edges_of(model, cuts, |point| point.index() as u32);
            let triangles = (0..2 * points.cell_count()).map(triangle);
            return Some(split(triangles, &edges, points.vertex_count() as u32).refined(refinement));
        };
        let triangles = skin.triangles().iter().map(|triangle| triangle.map(|vertex| skin.places()[vertex as usize]));
        if skin.cells().len() > 0 {
            let edges = parted_edges(model, cuts, skin, triangles.clone());
            return Some(split(triangles, &edges, skin.vertices().len() as u32));
        }
        if skin.is_bound() {
            return None;
        }
        let edges = edges_of(model, cuts, |point| skin.places()[point.index()]);
        Some(split(triangles, &edges, skin.vertices().len() as u32))
    }

    /// Returns what is new since a version of the topology. If the wound only grew since then, a viewer that has the wound of that version
    /// has all of it with this.
    #[must_use]
    pub fn since(mut self, version: u32) -> Self {
        let known = self.vertices.partition_point(|vertex| vertex.version <= version);
        self.vertices.drain(..known);
        self.triangles.retain(|triangles| triangles.version > version);
        Wound { first_vertex: self.first_vertex + u32::try_from(known).unwrap_or(u32::MAX), ..self }
    }

    /// Returns the sides of shown triangles that are lips of the wound.
    pub fn lips(&self) -> impl Iterator<Item = [u32; 2]> + '_ {
        let sides = self.triangles.iter().flat_map(|triangles| &triangles.corners).map(|[_, from, to]| [*from, *to]);
        sides.filter(|side| side.iter().any(|vertex| *vertex >= self.first_vertex))
    }

    /// Returns the triangles that are shown in place of `whole`, those of the whole surface in their order.
    pub fn shown_triangles(&self, whole: impl IntoIterator<Item = [u32; 3]>) -> Vec<[u32; 3]> {
        let mut changes = self.triangles.iter().peekable();
        let mut removed = 0..0;
        let mut shown = Vec::new();
        for (number, corners) in (0..).zip(whole) {
            if let Some(change) = changes.next_if(|change| change.first == number) {
                removed = number..number + change.count;
                shown.extend(&change.corners);
            }
            if !removed.contains(&number) {
                shown.push(corners);
            }
        }
        shown
    }

    /// Converts the wound of the points of a sheet, which are its vertices without refinement, to one of a refined surface: cells with a
    /// split triangle are shown without refinement.
    #[allow(clippy::cast_possible_truncation)]
    fn refined(self, refinement: Refinement) -> Self {
        if refinement.between() == 0 {
            return self;
        }
        let [_, across] = refinement.coarsest().vertices();
        let (sides, [_, fine_across]) = (refinement.between() + 1, refinement.vertices());
        let first_vertex = refinement.vertex_count() as u32;
        let vertex = |number: u32| match number.checked_sub(self.first_vertex) {
            None => refinement.vertex_at(PointId::new(number as usize)) as u32,
            Some(added) => first_vertex + added,
        };
        let mut cells: Vec<CutTriangles> = Vec::new();
        for half in self.triangles.chunk_by(|one, other| one.first / 2 == other.first / 2) {
            let cell = half[0].first / 2;
            let [a, b, c, d, e, f] = refinement.coarsest().triangles(cell as usize).map(|corner| corner as u32);
            let of = |number: u32, whole: [u32; 3]| match half.iter().find(|triangles| triangles.first == number) {
                Some(triangles) => triangles.corners.clone(),
                None => vec![whole],
            };
            let corners = [of(2 * cell, [a, b, c]), of(2 * cell + 1, [d, e, f])].concat();
            let corners = corners.into_iter().flat_map(|corners| {
                let mut parts = Vec::new();
                subdivide(corners.map(vertex), refinement, &mut parts);
                parts
            });
            let version = half.iter().map(|triangles| triangles.version).max().unwrap_or_default();
            let [i, j] = [cell as usize / (across - 1), cell as usize % (across - 1)];
            let rows = (0..sides).map(|row| (i * sides + row) * (fine_across - 1) + j * sides);
            let removed = rows.map(|first| CutTriangles {
                first: 2 * first as u32,
                count: 2 * sides as u32,
                corners: Vec::new(),
                version,
            });
            let begin = cells.len();
            cells.extend(removed);
            cells[begin].corners = corners.collect();
        }
        cells.sort_by_key(|triangles| triangles.first);
        let on_surface = |lip: LipVertex| LipVertex { host: vertex(lip.host), others: lip.others.map(vertex), ..lip };
        Wound { first_vertex, vertices: self.vertices.into_iter().map(on_surface).collect(), triangles: cells }
    }
}

/// Appends the parts of a triangle of a cell of points whose sides on the cell's have the vertices of the refined surface, so that no gap
/// opens to the neighbouring cell. A lip stays between the second and the third corner.
#[allow(clippy::cast_possible_truncation)]
fn subdivide(corners: [u32; 3], refinement: Refinement, parts: &mut Vec<[u32; 3]>) {
    let ([_, across], count) = (refinement.vertices(), refinement.vertex_count());
    let sides = refinement.between() + 1;
    for from in 0..3 {
        let [p, q, apex] = [0, 1, 2].map(|at| corners[(from + at) % 3]);
        let [p_at, q_at] = [p, q].map(|vertex| [vertex as usize / across, vertex as usize % across]);
        let apart = [0, 1].map(|axis| p_at[axis].abs_diff(q_at[axis]));
        if p.max(q) as usize >= count || (apart != [sides, 0] && apart != [0, sides]) {
            continue;
        }
        let between = |part: usize| {
            let at = [0, 1].map(|axis| (p_at[axis] * (sides - part) + q_at[axis] * part) / sides);
            (at[0] * across + at[1]) as u32
        };
        for part in 0..sides {
            let [x, y] = [between(part), between(part + 1)];
            let fan = match from {
                0 if part + 1 == sides => [x, y, apex],
                2 if part == 0 => [y, apex, x],
                _ => [apex, x, y],
            };
            subdivide(fan, refinement, parts);
        }
        return;
    }
    parts.push(corners);
}

/// A severed spring between two vertices of a surface.
#[derive(Debug, Clone, Copy)]
struct SeveredEdge {
    /// The vertices, ascending.
    ends: [u32; 2],
    /// The part of the way from the first to the second.
    part: f64,
    version: u32,
}

/// Returns the severed springs by their vertices, in the order in which they were severed, each pair of vertices once.
fn edges_of(model: &Model, cuts: &Cuts, vertex: impl Fn(PointId) -> u32) -> Vec<SeveredEdge> {
    let edge = |joint: SeveredJoint| {
        let ([first, second], SeveredJoint { part, version, .. }) = (joint.points.map(&vertex), joint);
        if first <= second {
            SeveredEdge { ends: [first, second], part, version }
        } else {
            SeveredEdge { ends: [second, first], part: 1.0 - part, version }
        }
    };
    cuts.joints(model).into_iter().map(edge).collect()
}

/// Returns the edges of the surface of a solid whose vertices move with cells that a cut has parted, in the order in which it did. Where the
/// blade crossed the line between the middles of both cells, the edge is severed in the same plane.
fn parted_edges(
    model: &Model,
    cuts: &Cuts,
    skin: &Skin,
    triangles: impl Iterator<Item = [u32; 3]>,
) -> Vec<SeveredEdge> {
    let (cells, shape) = (skin.cells().collect::<Vec<_>>(), model.shape());
    let Some([points, places]) = model.shown_order().filter(|_| !cuts.is_empty()) else { return Vec::new() };
    let joint = |joint: SeveredJoint| (joint.points.map(|point| places[point.index()]), joint.part);
    let parts: BTreeMap<[u32; 2], f64> = cuts.joints(model).into_iter().map(joint).collect();
    let least_m = |cell: u32| shape.rest_m(PointId::new(points[cell as usize] as usize));
    let mut apart: BTreeMap<[u32; 2], Option<u32>> = BTreeMap::new();
    let mut edges = BTreeMap::new();
    for [a, b, c] in triangles {
        for [from, to] in [[a, b], [b, c], [c, a]] {
            let ends = [from.min(to), from.max(to)];
            let of_ends = ends.map(|end| cells[end as usize]);
            // Most cells are beside no cut.
            let is_whole = of_ends.iter().all(|cell| cuts.doubled_corners(*cell).is_none());
            if is_whole || of_ends[0] == of_ends[1] || edges.contains_key(&ends) {
                continue;
            }
            let pair = [of_ends[0].min(of_ends[1]), of_ends[0].max(of_ends[1])];
            let since = *apart.entry(pair).or_insert_with(|| cuts.cells_apart_since(model, pair));
            let Some(version) = since else { continue };
            // Along the way from the middle of the lower cell to that of the other: only differences count.
            let [low_m, high_m] = pair.map(least_m);
            let way_m = high_m - low_m;
            let half_m = DVec3::splat(0.5 * shape.edge_m());
            let along = |vertex: u32| {
                let at_m = skin.rest_m(skin.vertices()[vertex as usize]) - low_m - half_m;
                at_m.dot(way_m) / way_m.length_squared()
            };
            let [begin, end] = ends.map(along);
            let plane = parts.get(&pair).copied().unwrap_or(0.5);
            let part = if begin == end { 0.5 } else { ((plane - begin) / (end - begin)).clamp(NEAREST, 1.0 - NEAREST) };
            edges.insert(ends, SeveredEdge { ends, part, version });
        }
    }
    let mut edges: Vec<SeveredEdge> = edges.into_values().collect();
    edges.sort_by_key(|edge| edge.version);
    edges
}

/// A triangle with severed edges.
struct Crossed {
    triangle: u32,
    corners: [u32; 3],
    /// The severed edge from each corner to the next.
    edges: [Option<usize>; 3],
}

/// Splits the triangles of a surface with `first_vertex` vertices along severed edges.
#[allow(clippy::cast_possible_truncation)]
fn split(triangles: impl Iterator<Item = [u32; 3]>, edges: &[SeveredEdge], first_vertex: u32) -> Wound {
    let crossed = crossed(triangles, edges);
    // The number of the first of both vertices of each edge that a triangle has, then of the three in the middle of a triangle.
    let mut uses = vec![false; edges.len()];
    crossed.iter().flat_map(|crossed| crossed.edges).flatten().for_each(|edge| uses[edge] = true);
    let mut whole_until: Vec<(usize, usize)> = Vec::new();
    for (index, Crossed { edges, .. }) in crossed.iter().enumerate() {
        if let [Some(a), Some(b), Some(c)] = *edges {
            whole_until.push((a.max(b).max(c), index));
        }
    }
    whole_until.sort_unstable();
    let mut middles = whole_until.into_iter().peekable();
    let (mut lips, mut middle) = (vec![0; edges.len()], vec![0; crossed.len()]);
    let mut vertices: Vec<LipVertex> = Vec::new();
    for (index, edge) in edges.iter().enumerate().filter(|(index, _)| uses[*index]) {
        let SeveredEdge { ends: [a, b], part, version } = *edge;
        lips[index] = first_vertex + vertices.len() as u32;
        let lip = |host, other, part: f64| {
            let weights = [part as f32, 0.0];
            LipVertex { host, others: [other, other], weights, version }
        };
        vertices.extend([lip(a, b, part), lip(b, a, 1.0 - part)]);
        while let Some((_, of)) = middles.next_if(|(last, _)| *last == index) {
            middle[of] = first_vertex + vertices.len() as u32;
            vertices.extend(middle_of(&crossed[of], edges, version));
        }
    }
    let lip = |edge: usize, host: u32| lips[edge] + u32::from(edges[edge].ends[0] != host);
    let parts = crossed.iter().zip(middle).map(|(crossed, middle)| {
        let versions = crossed.edges.iter().flatten().map(|edge| edges[*edge].version);
        let corners = parts_of(crossed, lip, middle);
        CutTriangles { first: crossed.triangle, count: 1, corners, version: versions.max().unwrap_or_default() }
    });
    let triangles = parts.collect();
    Wound { first_vertex, vertices, triangles }
}

/// Returns the triangles that have a severed edge, ascending.
fn crossed(triangles: impl Iterator<Item = [u32; 3]>, edges: &[SeveredEdge]) -> Vec<Crossed> {
    let mut by_ends: Vec<([u32; 2], usize)> = edges.iter().map(|edge| edge.ends).zip(0..).collect();
    by_ends.sort_unstable();
    // Several springs may join the same vertices: the first counts.
    by_ends.dedup_by_key(|(ends, _)| *ends);
    // Most triangles have no severed edge: few of their vertices are ends of any.
    let most = by_ends.iter().map(|([_, second], _)| *second).max().map_or(0, |most| most as usize + 1);
    let mut is_end = vec![false; most];
    by_ends.iter().flat_map(|(ends, _)| ends).for_each(|end| is_end[*end as usize] = true);
    let found = |a: u32, b: u32| {
        let ends = [a.min(b), a.max(b)];
        by_ends.binary_search_by_key(&ends, |(ends, _)| *ends).ok().map(|at| by_ends[at].1)
    };
    let crossed = triangles.zip(0..).filter_map(|(corners, triangle)| {
        let [a, b, c] = corners;
        let ends = corners.iter().filter(|corner| is_end.get(**corner as usize).is_some_and(|is_end| *is_end));
        if ends.count() < 2 {
            return None;
        }
        let edges = [found(a, b), found(b, c), found(c, a)];
        edges.iter().any(Option::is_some).then_some(Crossed { triangle, corners, edges })
    });
    crossed.collect()
}

/// Returns the three vertices in the middle of a triangle that has three severed edges, which ride on its corners in turn.
#[allow(clippy::cast_possible_truncation)]
fn middle_of(crossed: &Crossed, edges: &[SeveredEdge], version: u32) -> [LipVertex; 3] {
    let Crossed { corners, edges: severed, .. } = crossed;
    // The mean of the three places on the edges.
    let mut shares = [0.0; 3];
    for (from, edge) in severed.iter().enumerate() {
        let to = (from + 1) % 3;
        let part = edge.map_or(0.5, |edge| match edges[edge] {
            SeveredEdge { ends: [first, _], part, .. } if first == corners[from] => part,
            SeveredEdge { part, .. } => 1.0 - part,
        });
        shares[from] += (1.0 - part) / 3.0;
        shares[to] += part / 3.0;
    }
    [0, 1, 2].map(|corner| {
        let [second, third] = [(corner + 1) % 3, (corner + 2) % 3];
        LipVertex {
            host: corners[corner],
            others: [corners[second], corners[third]],
            weights: [shares[second] as f32, shares[third] as f32],
            version,
        }
    })
}

/// Returns the parts of a triangle; a side on a lip is between the second and the third corner. `lip` is the vertex of a severed edge that rides on one of its ends, and `middle` the first of those in the
/// triangle's middle.
fn parts_of(crossed: &Crossed, lip: impl Fn(usize, u32) -> u32, middle: u32) -> Vec<[u32; 3]> {
    let Crossed { corners, edges, .. } = crossed;
    // The triangle from each corner on: its edges are from p to q, from q to r, and from r to p.
    let turned = |from: usize| {
        let at = [from, (from + 1) % 3, (from + 2) % 3];
        (at.map(|corner| corners[corner]), at.map(|corner| edges[corner]))
    };
    let mut parts = Vec::with_capacity(6);
    for from in 0..3 {
        let ([p, q, r], severed) = turned(from);
        match severed {
            [Some(pq), None, None] => parts.extend([[p, lip(pq, p), r], [q, r, lip(pq, q)]]),
            [Some(pq), None, Some(rp)] => {
                parts.extend([[p, lip(pq, p), lip(rp, p)], [lip(pq, q), q, r], [r, lip(rp, r), lip(pq, q)]]);
            }
            [Some(pq), Some(_), Some(rp)] => {
                let own = middle + from as u32;
                parts.extend([[p, lip(pq, p), own], [p, own, lip(rp, p)]]);
            }
            _ => {}
        }
    }
    parts
}

#[cfg(test)]
pub(super) mod tests;
