//! Joins triangles along edges: where an edge of one coincides with an edge of another, for any numbers of its
//! vertices. If more than two meet at an edge, they are paired so that each solid is closed.
//!
//! A *place* is the common position of vertices. Vertices are joined through the triangles at them, and not by their
//! places alone: two closed parts that touch at a vertex stay separate.
//!
//! Two triangles that name an edge by equal vertices stay joined. All other triangles at an edge are free. Two free
//! triangles are joined. If there are more, they are sorted by their angles around the edge, seen from its first
//! place p to its second q. The normal of a triangle that runs from p to q is (q − p) × (o − p), with o its third
//! vertex: it points to larger angles, so the solid behind such a triangle ends there, and behind one that runs from
//! q to p it begins. Beginnings and ends are paired like parentheses around the edge. The remaining ones face one
//! way, since some triangles of the file are turned: neighbours are joined. At most one triangle is left over; it has
//! a border there.

use std::collections::{BTreeSet, HashMap};

use glam::DVec3;

use crate::TriangleMesh;
use crate::topology::{Sets, Side, is_proper};
use crate::work::spend;

/// Difference below which angles count as equal, in quarters of a turn.
const SAME_ANGLE: f64 = 1e-9;

/// How the triangles of a mesh are joined.
pub(crate) struct Joined {
    /// The joined vertex of each corner of each triangle. Only equality of these numbers has a meaning.
    corners: Vec<[u32; 3]>,
    /// Pairs of triangles at an edge. A side is forward if it runs from the smaller place to the larger one.
    pub(crate) pairs: Vec<[Side; 2]>,
    /// Triangles at an edge without a partner, with the places of the edge.
    pub(crate) borders: Vec<(u32, [u32; 2])>,
    /// Triangles at edges that an odd number above one names: all stay joined there ([`Odd::Stay`]).
    pub(crate) crowded: Vec<u32>,
    /// For each edge with several pairs, these pairs: the corners of both triangles at its smaller and at its larger
    /// place. A corner is three times its triangle plus its index there.
    pub(crate) touching: Vec<Vec<[[u32; 2]; 2]>>,
    /// Number of edges at which more than two free triangles were paired.
    pub(crate) paired_edges: usize,
    /// Number of borders at such edges.
    pub(crate) left_over: usize,
}

/// What to do with an odd number of triangles, above one, that name one edge by equal vertices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Odd {
    /// They stay joined: no surface has such an edge, and the report names it.
    Stay,
    /// They are paired, and one has a border.
    Pair,
}

/// Returns the place of each vertex: the smallest vertex at its position. Positions must be finite.
pub(crate) fn places(vertices: &[DVec3]) -> Vec<u32> {
    spend(4 * vertices.len());
    let mut order: Vec<u32> = (0..).take(vertices.len()).collect();
    // −0 counts as 0.
    let key = |vertex: &u32| (vertices[*vertex as usize] + DVec3::ZERO).to_array().map(f64::to_bits);
    order.sort_by_cached_key(key);
    let mut places = vec![0; vertices.len()];
    for same in order.chunk_by(|a, b| key(a) == key(b)) {
        same.iter().for_each(|vertex| places[*vertex as usize] = same[0]);
    }
    places
}

/// Joins triangles, given the place of each vertex. Ignores triangles with two corners at one place; indices must be
/// in range.
pub(crate) fn join(vertices: &[DVec3], triangles: &[[u32; 3]], places: &[u32], odd: Odd) -> Joined {
    spend(16 * triangles.len());
    let place = |vertex: u32| places[vertex as usize];
    // For each side of each triangle: the places of its edge, then the vertices of its edge.
    let mut halves: Vec<([u32; 2], [u32; 2], Side)> = Vec::with_capacity(3 * triangles.len());
    for (number, triangle) in (0..).zip(triangles).filter(|(_, triangle)| is_proper(&triangle.map(place))) {
        for corner in 0..3 {
            let (from, to) = (triangle[corner], triangle[(corner + 1) % 3]);
            let is_forward = place(from) < place(to);
            let [low, high] = if is_forward { [from, to] } else { [to, from] };
            halves.push(([place(low), place(high)], [low, high], Side { triangle: number, is_forward }));
        }
    }
    halves.sort_unstable();
    let mut joined = Joined {
        corners: Vec::new(),
        pairs: Vec::with_capacity(halves.len() / 2),
        borders: Vec::new(),
        crowded: Vec::new(),
        touching: Vec::new(),
        paired_edges: 0,
        left_over: 0,
    };
    let mut corners = Sets::new(3 * triangles.len());
    let corner_at = |triangle: u32, at: u32| {
        let corner = triangles[triangle as usize].iter().position(|vertex| place(*vertex) == at).unwrap_or(0);
        3 * triangle + u32::try_from(corner).unwrap_or(0)
    };
    let mut free: Vec<Side> = Vec::new();
    for at_edge in halves.chunk_by(|a, b| a.0 == b.0) {
        let edge = at_edge[0].0;
        let (first_pair, first_crowded) = (joined.pairs.len(), joined.crowded.len());
        free.clear();
        for named in at_edge.chunk_by(|a, b| a.1 == b.1) {
            match named {
                [a, b] => joined.pairs.push([a.2, b.2]),
                [_, _, _, ..] if odd == Odd::Stay && named.len() % 2 == 1 => {
                    joined.crowded.extend(named.iter().map(|half| half.2.triangle));
                }
                _ => free.extend(named.iter().map(|half| half.2)),
            }
        }
        match free[..] {
            [] => {}
            [one] => joined.borders.push((one.triangle, edge)),
            [a, b] => joined.pairs.push([a, b]),
            _ => {
                spend(16 * free.len());
                let around = around(vertices, triangles, edge, &free, &place);
                joined.paired_edges += 1;
                let alone = pair(&around, &mut joined.pairs);
                joined.left_over += usize::from(alone.is_some());
                joined.borders.extend(alone.map(|side| (side.triangle, edge)));
            }
        }
        let pairs = &joined.pairs[first_pair..];
        if pairs.len() > 1 {
            let of = |pair: &[Side; 2]| pair.map(|side| edge.map(|at| corner_at(side.triangle, at)));
            joined.touching.push(pairs.iter().map(of).collect());
        }
        let crowded = joined.crowded[first_crowded..].windows(2).map(|pair| [pair[0], pair[1]]);
        for [a, b] in pairs.iter().map(|pair| pair.map(|side| side.triangle)).chain(crowded) {
            for at in edge {
                corners.join(corner_at(a, at), corner_at(b, at));
            }
        }
    }
    let all = (0_u32..).take(triangles.len());
    joined.corners = all.map(|triangle| [0, 1, 2].map(|corner| corners.find(3 * triangle + corner))).collect();
    joined
}

impl Joined {
    /// Gives each joined vertex vertices of its own: of several that share one, the first in the order of triangles
    /// keeps it, the others get copies appended at the end. Returns the original vertex of each copy.
    pub(crate) fn split_vertices(&self, mesh: &mut TriangleMesh) -> Vec<u32> {
        let mut keeps = vec![u32::MAX; mesh.vertices_m.len()];
        // Only looked up.
        let mut copy_of: HashMap<(u32, u32), u32> = HashMap::new();
        let mut copies = Vec::new();
        for (vertex, joined) in mesh.triangles.iter_mut().flatten().zip(self.corners.iter().flatten()) {
            let old = *vertex as usize;
            if keeps[old] == u32::MAX {
                keeps[old] = *joined;
            }
            if keeps[old] != *joined {
                *vertex = *copy_of.entry((*vertex, *joined)).or_insert_with(|| {
                    mesh.vertices_m.push(mesh.vertices_m[old]);
                    copies.push(*vertex);
                    u32::try_from(mesh.vertices_m.len() - 1).unwrap_or(*vertex)
                });
            }
        }
        for group in &mut mesh.groups {
            spend(1 + 4 * copies.len());
            // Copies have larger numbers, in ascending order.
            let new = (keeps.len() as u32..).zip(&copies).filter(|(_, old)| group.vertices.binary_search(old).is_ok());
            let new: Vec<u32> = new.map(|(new, _)| new).collect();
            group.vertices.extend(new);
        }
        copies
    }

    /// Where several pairs have both ends of their edge in common, halves the triangles of all but the first by a
    /// vertex in the middle of the edge: a surface has only one edge between two vertices. Halves at most one edge of
    /// each triangle. Returns the halved triangles; their other halves are appended in this order.
    ///
    /// Apply it to the mesh after [`Joined::split_vertices`].
    pub(crate) fn halve(&self, mesh: &mut TriangleMesh) -> Vec<u32> {
        let mut halved: BTreeSet<u32> = BTreeSet::new();
        let mut order = Vec::new();
        for at_edge in &self.touching {
            let mut known = BTreeSet::new();
            for pair in at_edge {
                let ends = pair[0].map(|corner| self.corners[corner as usize / 3][corner as usize % 3]);
                let triangles = pair.map(|corners| corners[0] / 3);
                if known.insert(ends) || triangles.iter().any(|triangle| halved.contains(triangle)) {
                    continue;
                }
                let mut middle_of = None;
                for corners in pair {
                    let triangle = corners[0] as usize / 3;
                    let at = corners.map(|corner| corner as usize % 3);
                    let edge = at.map(|corner| mesh.triangles[triangle][corner]);
                    let middle = match middle_of {
                        Some((known, middle)) if known == edge => Some(middle),
                        _ => middle_vertex(mesh, edge),
                    };
                    let Some(middle) = middle else { continue };
                    middle_of = Some((edge, middle));
                    let mut other = mesh.triangles[triangle];
                    (mesh.triangles[triangle][at[1]], other[at[0]]) = (middle, middle);
                    mesh.triangles.push(other);
                    if let Some(uv) = &mut mesh.uv {
                        let mut other = uv[triangle];
                        let middle = [0, 1].map(|part| 0.5 * (other[at[0]][part] + other[at[1]][part]));
                        (uv[triangle][at[1]], other[at[0]]) = (middle, middle);
                        uv.push(other);
                    }
                    halved.insert(triangle as u32);
                    order.push(triangle as u32);
                }
            }
        }
        order
    }

    /// Returns for each vertex the number of the joined one that it belongs to, if it is in a triangle; and for each
    /// joined one its smallest vertex, ascending. Joined vertices must share none: apply it after
    /// [`Joined::split_vertices`].
    pub(crate) fn numbered(&self, mesh: &TriangleMesh) -> (Vec<Option<u32>>, Vec<u32>) {
        const NONE: u32 = u32::MAX;
        let mut set_of = vec![NONE; mesh.vertices_m.len()];
        for (vertex, joined) in mesh.triangles.iter().flatten().zip(self.corners.iter().flatten()) {
            set_of[*vertex as usize] = *joined;
        }
        let (mut number_of, mut least) = (vec![NONE; 3 * mesh.triangles.len()], Vec::new());
        let mut vertex_of = Vec::with_capacity(set_of.len());
        for (vertex, set) in (0..).zip(set_of) {
            vertex_of.push((set != NONE).then(|| {
                let number = &mut number_of[set as usize];
                if *number == NONE {
                    *number = least.len() as u32;
                    least.push(vertex);
                }
                *number
            }));
        }
        (vertex_of, least)
    }
}

/// Adds a vertex in the middle of an edge; `None` if no number lies between its ends.
fn middle_vertex(mesh: &mut TriangleMesh, edge: [u32; 2]) -> Option<u32> {
    let [from, to] = edge.map(|vertex| mesh.vertices_m[vertex as usize]);
    let (place, middle) = (from.midpoint(to), u32::try_from(mesh.vertices_m.len()).ok()?);
    if place == from || place == to || !place.is_finite() {
        return None;
    }
    mesh.vertices_m.push(place);
    spend(4 * mesh.groups.len());
    for group in &mut mesh.groups {
        if edge.iter().all(|vertex| group.vertices.binary_search(vertex).is_ok()) {
            group.vertices.push(middle);
        }
    }
    Some(middle)
}

/// Sorts the sides at an edge by their angles around it; of two with equal angles, the end of a solid comes before a
/// beginning.
fn around(
    vertices: &[DVec3],
    triangles: &[[u32; 3]],
    edge: [u32; 2],
    sides: &[Side],
    place: &impl Fn(u32) -> u32,
) -> Vec<Side> {
    let [from, to] = edge.map(|at| vertices[at as usize]);
    let along = (to - from).normalize_or_zero();
    let across = |side: &Side| {
        let other = triangles[side.triangle as usize].into_iter().find(|vertex| !edge.contains(&place(*vertex)));
        let off = vertices[other.unwrap_or(edge[0]) as usize] - from;
        (off - off.dot(along) * along).normalize_or_zero()
    };
    let first = across(&sides[0]);
    let second = along.cross(first);
    // A number from 0 to 4 that grows with the angle, by arithmetic with equal results on every machine.
    let angle = |side: &Side| {
        let off = across(side);
        let (x, y) = (off.dot(first), off.dot(second));
        let part = y / (x.abs() + y.abs());
        let angle = if x < 0.0 { 2.0 - part } else { part };
        let angle = if angle.is_nan() { 0.0 } else { angle };
        // An angle just below a whole turn counts as the beginning.
        if angle < -SAME_ANGLE { angle + 4.0 } else { angle }
    };
    let mut ordered: Vec<(f64, Side)> = sides.iter().map(|side| (angle(side), *side)).collect();
    ordered.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    for same in ordered.chunk_by_mut(|a, b| b.0 - a.0 <= SAME_ANGLE) {
        same.sort_by_key(|(_, side)| !side.is_forward);
    }
    ordered.into_iter().map(|(_, side)| side).collect()
}

/// Pairs sides in their order around the edge; returns the one that is left over, if any.
fn pair(around: &[Side], pairs: &mut Vec<[Side; 2]>) -> Option<Side> {
    let mut is_paired = vec![false; around.len()];
    let mut begun = Vec::new();
    // Two turns: what begins before the first angle ends after it.
    for (turn, which) in (0..2).flat_map(|turn| (0..around.len()).map(move |which| (turn, which))) {
        if is_paired[which] {
            continue;
        }
        if !around[which].is_forward {
            if turn == 0 {
                begun.push(which);
            }
        } else if let Some(other) = begun.pop() {
            (is_paired[which], is_paired[other]) = (true, true);
            pairs.push([around[other], around[which]]);
        }
    }
    let left: Vec<Side> = around.iter().zip(is_paired).filter(|(_, is_paired)| !is_paired).map(|(s, _)| *s).collect();
    let (both, alone) = left.as_chunks::<2>();
    pairs.extend(both);
    alone.first().copied()
}
