//! A triangulation with neighbours, and the three operations that change it: split, collapse and flip. It has no
//! positions.

use std::iter::once;

/// Marks a missing half-edge or vertex.
pub(super) const NONE: u32 = u32::MAX;

/// A manifold of triangles, closed or with boundaries. Half-edges 3t, 3t + 1 and 3t + 2 go around triangle t.
/// Vertices and triangles keep their numbers when others are removed.
pub(super) struct HalfEdges {
    /// The vertex where each half-edge starts; `NONE` in a removed triangle.
    start: Vec<u32>,
    /// The half-edge along the same edge in the neighbouring triangle; `NONE` at a boundary.
    twin: Vec<u32>,
    /// A half-edge that starts at each vertex; `NONE` for a removed vertex.
    leaving: Vec<u32>,
}

/// Returns the half-edge after `h` around its triangle.
pub(super) fn next(h: u32) -> u32 {
    if h % 3 == 2 { h - 2 } else { h + 1 }
}

/// Returns the half-edge before `h` around its triangle.
pub(super) fn previous(h: u32) -> u32 {
    if h.is_multiple_of(3) { h + 2 } else { h - 1 }
}

impl HalfEdges {
    /// Creates the triangulation of `triangles`. `None` unless it is a manifold in which neighbours have consistent
    /// orientations and each of the `vertices` vertices is used.
    pub(super) fn new(vertices: usize, triangles: &[[u32; 3]]) -> Option<HalfEdges> {
        let start = triangles.concat();
        let edge = |h: u32| {
            let (from, to) = (start[h as usize], start[next(h) as usize]);
            (from.min(to), from.max(to), h)
        };
        let mut edges: Vec<(u32, u32, u32)> = (0..start.len() as u32).map(edge).collect();
        edges.sort_unstable();
        let mut twin = vec![NONE; start.len()];
        for same in edges.chunk_by(|one, other| (one.0, one.1) == (other.0, other.1)) {
            match *same {
                [_] => {}
                [(.., one), (.., other)] if start[one as usize] != start[other as usize] => {
                    twin[one as usize] = other;
                    twin[other as usize] = one;
                }
                _ => return None,
            }
        }
        let mut leaving = vec![NONE; vertices];
        let mut count = vec![0; vertices];
        for (h, &vertex) in start.iter().enumerate() {
            leaving[vertex as usize] = h as u32;
            count[vertex as usize] += 1;
        }
        let mesh = HalfEdges { start, twin, leaving };
        // At a vertex where two fans of triangles touch, one ring does not contain all its half-edges.
        let is_manifold = |v: u32| count[v as usize] > 0 && mesh.ring(v).count() == count[v as usize];
        (0..vertices as u32).all(is_manifold).then_some(mesh)
    }

    /// Returns the number of half-edges, including those of removed triangles.
    pub(super) fn half_edges(&self) -> u32 {
        self.start.len() as u32
    }

    /// Returns the number of vertices, including removed ones.
    pub(super) fn vertices(&self) -> u32 {
        self.leaving.len() as u32
    }

    /// Returns whether the triangle of a half-edge still exists.
    pub(super) fn lives(&self, h: u32) -> bool {
        self.start(h) != NONE
    }

    /// Returns the vertex where a half-edge starts.
    pub(super) fn start(&self, h: u32) -> u32 {
        self.start[h as usize]
    }

    /// Returns the vertex where a half-edge ends.
    pub(super) fn end(&self, h: u32) -> u32 {
        self.start(next(h))
    }

    /// Returns the vertex opposite a half-edge in its triangle.
    pub(super) fn apex(&self, h: u32) -> u32 {
        self.start(previous(h))
    }

    /// Returns the half-edge along the same edge in the neighbouring triangle, or `NONE`.
    pub(super) fn twin(&self, h: u32) -> u32 {
        self.twin[h as usize]
    }

    /// Returns the half-edges that start at a vertex, counterclockwise; none for a removed vertex.
    pub(super) fn ring(&self, vertex: u32) -> impl Iterator<Item = u32> + '_ {
        let first = self.first(vertex);
        let mut following = first;
        std::iter::from_fn(move || {
            let h = following;
            if h == NONE {
                return None;
            }
            let around = self.twin(previous(h));
            following = if around == first { NONE } else { around };
            Some(h)
        })
    }

    /// Returns the half-edge with which a vertex's ring starts: at a boundary, the one without a twin.
    fn first(&self, vertex: u32) -> u32 {
        let begin = self.leaving[vertex as usize];
        let mut h = begin;
        while h != NONE && self.twin(h) != NONE {
            h = next(self.twin(h));
            if h == begin {
                break;
            }
        }
        h
    }

    /// Returns the vertices that an edge connects with a vertex, counterclockwise.
    pub(super) fn neighbours(&self, vertex: u32) -> impl Iterator<Item = u32> + '_ {
        // At a boundary, no half-edge runs from the vertex to its last neighbour.
        let last = |h: u32| (self.twin(previous(h)) == NONE).then(|| self.apex(h));
        self.ring(vertex).flat_map(move |h| once(self.end(h)).chain(last(h)))
    }

    /// Returns the number of edges at a vertex.
    pub(super) fn valence(&self, vertex: u32) -> usize {
        self.neighbours(vertex).count()
    }

    /// Returns whether an existing vertex is at a boundary.
    pub(super) fn at_boundary(&self, vertex: u32) -> bool {
        self.twin(self.first(vertex)) == NONE
    }

    /// Returns whether an edge connects two vertices.
    pub(super) fn are_connected(&self, one: u32, other: u32) -> bool {
        self.neighbours(one).any(|neighbour| neighbour == other)
    }

    /// Makes two half-edges twins; either may be `NONE`.
    fn join(&mut self, one: u32, other: u32) {
        if one != NONE {
            self.twin[one as usize] = other;
        }
        if other != NONE {
            self.twin[other as usize] = one;
        }
    }

    /// Splits an edge by a new vertex, and the triangles at it. The new vertex has the highest number.
    pub(super) fn split(&mut self, h: u32) {
        let (twin, middle) = (self.twin(h), self.vertices());
        self.leaving.push(NONE);
        let second = self.bisect(h, middle);
        if twin != NONE {
            let other = self.bisect(twin, middle);
            self.join(h, other);
            self.join(twin, second);
        }
    }

    /// Splits the triangle (a, b, c) of h = a → b into (a, m, c) and (m, b, c). Returns the half-edge m → b, without
    /// its twin yet.
    fn bisect(&mut self, h: u32, middle: u32) -> u32 {
        let (forth, back) = (next(h), previous(h));
        let (second, b) = (self.half_edges(), self.start(forth));
        self.start.extend([middle, b, self.start(back)]);
        self.twin.extend([NONE; 3]);
        self.join(second + 1, self.twin(forth));
        self.join(second + 2, forth);
        self.leaving[b as usize] = second + 1;
        self.leaving[middle as usize] = second;
        self.start[forth as usize] = middle;
        second
    }

    /// Flips an edge that has two triangles, (a, b, c) and (b, a, d), to c – d.
    pub(super) fn flip(&mut self, h: u32) {
        let twin = self.twin(h);
        let (forth, back) = (next(h), previous(h));
        let (twin_forth, twin_back) = (next(twin), previous(twin));
        let [a, b, c, d] = [self.start(h), self.end(h), self.apex(h), self.apex(twin)];
        let [b_c, c_a] = [self.twin(forth), self.twin(back)];
        let [a_d, d_b] = [self.twin(twin_forth), self.twin(twin_back)];
        // The triangles become (d, c, a) and (c, d, b).
        for (half, vertex, neighbour) in
            [(h, d, twin), (forth, c, c_a), (back, a, a_d), (twin, c, h), (twin_forth, d, d_b), (twin_back, b, b_c)]
        {
            self.start[half as usize] = vertex;
            self.leaving[vertex as usize] = half;
            self.join(half, neighbour);
        }
    }

    /// Returns whether the surface stays a manifold when the edge of `h` collapses.
    pub(super) fn may_collapse(&self, h: u32) -> bool {
        let (a, b, twin) = (self.start(h), self.end(h), self.twin(h));
        // An inner edge between two boundary vertices: the surface would be pinched there.
        if twin != NONE && self.at_boundary(a) && self.at_boundary(b) {
            return false;
        }
        // Any other common neighbour would become the end of two coinciding edges.
        let apexes = if twin == NONE { 1 } else { 2 };
        if self.neighbours(a).filter(|&neighbour| self.are_connected(b, neighbour)).count() != apexes {
            return false;
        }
        [h, twin].into_iter().filter(|&h| h != NONE).all(|h| {
            let is_ear = self.twin(next(h)) == NONE && self.twin(previous(h)) == NONE;
            !is_ear && (self.at_boundary(self.apex(h)) || self.valence(self.apex(h)) > 3)
        })
    }

    /// Collapses the edge of h = a → b: removes vertex a and the triangles at the edge, and connects what was around
    /// a with b.
    pub(super) fn collapse(&mut self, h: u32) {
        let (a, b, twin) = (self.start(h), self.end(h), self.twin(h));
        let around: Vec<u32> = self.ring(a).collect();
        for half in around {
            self.start[half as usize] = b;
        }
        self.leaving[a as usize] = NONE;
        for half in [h, twin].into_iter().filter(|&half| half != NONE) {
            self.remove(half, b);
        }
    }

    /// Removes the triangle of `h`, both of whose ends are vertex `b` now, and joins its neighbours.
    fn remove(&mut self, h: u32, b: u32) {
        let apex = self.apex(h);
        let (from_apex, to_apex) = (self.twin(next(h)), self.twin(previous(h)));
        self.join(from_apex, to_apex);
        self.leaving[apex as usize] = if from_apex == NONE { next(to_apex) } else { from_apex };
        self.leaving[b as usize] = if to_apex == NONE { next(from_apex) } else { to_apex };
        for half in [h, next(h), previous(h)] {
            self.start[half as usize] = NONE;
        }
    }

    /// Returns the triangles with vertices renumbered without gaps, and the old number of each vertex.
    pub(super) fn compact(&self) -> (Vec<[u32; 3]>, Vec<u32>) {
        let mut number = vec![NONE; self.leaving.len()];
        let mut kept = Vec::new();
        for vertex in (0..self.vertices()).filter(|&vertex| self.leaving[vertex as usize] != NONE) {
            number[vertex as usize] = kept.len() as u32;
            kept.push(vertex);
        }
        let corners = |t: usize| [0, 1, 2].map(|corner| number[self.start[3 * t + corner] as usize]);
        let living = (0..self.start.len() / 3).filter(|&t| self.start[3 * t] != NONE);
        (living.map(corners).collect(), kept)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dice::Dice;

    /// A grid of squares, closed to a torus if `closed`.
    fn grid(side: u32, closed: bool) -> (usize, Vec<[u32; 3]>) {
        let (squares, points) = if closed { (side, side) } else { (side, side + 1) };
        let vertex = |x: u32, y: u32| x % points + y % points * points;
        let square = |i: u32| {
            let (x, y) = (i % squares, i / squares);
            let [a, b] = [vertex(x, y), vertex(x + 1, y)];
            let [c, d] = [vertex(x, y + 1), vertex(x + 1, y + 1)];
            [[a, b, d], [a, d, c]]
        };
        ((points * points) as usize, (0..squares * squares).flat_map(square).collect())
    }

    #[test]
    fn a_manifold_stays_one_whatever_is_done_to_it() {
        for closed in [true, false] {
            let (vertices, triangles) = grid(6, closed);
            let mut mesh = HalfEdges::new(vertices, &triangles).unwrap();
            let mut dice = Dice::new(1);
            for _ in 0..4000 {
                let h = (dice.within(0.0, 1.0) * f64::from(mesh.half_edges() - 1)) as u32;
                if !mesh.lives(h) {
                    continue;
                }
                let choice = dice.within(0.0, 1.0);
                if choice < 0.2 {
                    mesh.split(h);
                } else if choice < 0.7 {
                    // A boundary vertex stays on the boundary.
                    let leaves = mesh.at_boundary(mesh.start(h)) && !mesh.at_boundary(mesh.end(h));
                    if !leaves && mesh.may_collapse(h) {
                        mesh.collapse(h);
                    }
                } else if mesh.twin(h) != NONE {
                    let (apex, other) = (mesh.apex(h), mesh.apex(mesh.twin(h)));
                    if !mesh.are_connected(apex, other) {
                        mesh.flip(h);
                    }
                }
            }
            let (triangles, kept) = mesh.compact();
            assert!(HalfEdges::new(kept.len(), &triangles).is_some());
            // Vertices − edges + triangles, for a torus and a disc.
            let boundary = (0..mesh.half_edges()).filter(|&h| mesh.lives(h) && mesh.twin(h) == NONE).count();
            let edges = (3 * triangles.len() + boundary) / 2;
            assert_eq!(kept.len() + triangles.len() - edges, usize::from(!closed));
        }
    }

    #[test]
    fn what_is_no_manifold_is_told() {
        let (vertices, triangles) = grid(4, false);
        assert!(HalfEdges::new(vertices, &triangles).is_some());
        assert!(HalfEdges::new(vertices + 1, &triangles).is_none(), "a vertex without a triangle");
        let mut turned = triangles.clone();
        turned[5].swap(0, 1);
        assert!(HalfEdges::new(vertices, &turned).is_none(), "a triangle turned over");
        assert!(HalfEdges::new(5, &[[0, 1, 2], [0, 3, 4]]).is_none(), "two triangles that touch at a vertex");
    }
}
