//! How the triangles of a mesh are connected: edges, surfaces, holes, and non-manifold elements.

use crate::work::spend;

/// Maximum number of continuations that are compared where more than two borders meet.
const CHOICES: usize = 8;

/// A triangle at an edge, and its direction along the edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Side {
    /// Index of the triangle.
    pub triangle: u32,
    /// Whether the triangle runs along the edge from the vertex with the smaller index to the other one.
    pub is_forward: bool,
}

/// An edge of a mesh, of at least one triangle; it belongs to the [`Topology`] that lists it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Edge {
    /// Its vertices, the smaller index first.
    pub vertices: [u32; 2],
    first: usize,
    count: usize,
}

/// The connectivity of a mesh. Triangles that use a vertex twice, or whose indices are out of range, are ignored: they
/// keep their index, but have no edges.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Topology {
    /// The edges, each once, in ascending order of their vertices.
    pub edges: Vec<Edge>,
    /// Number of edges at each vertex; 0 without triangles.
    pub valence: Vec<u32>,
    /// Index of the connected surface of each triangle, in the order of the first triangles of the surfaces; `None`
    /// if the triangle is ignored.
    pub component: Vec<Option<u32>>,
    /// Number of connected surfaces; surfaces are connected where they share a vertex.
    pub components: usize,
    /// For each vertex, the number of fans of triangles that share no edge: 1 on a manifold, 0 without triangles.
    pub fans: Vec<u32>,
    /// Index of the fan of each corner of each triangle; each vertex numbers its fans from 0. 0 for ignored triangles.
    pub fan_of_corner: Vec<[u32; 3]>,
    /// Triangles with the vertices of an earlier triangle in any order, ascending.
    pub duplicates: Vec<u32>,
    sides: Vec<Side>,
}

/// Returns whether a triangle has three different vertices.
pub(crate) fn is_proper(triangle: &[u32; 3]) -> bool {
    let [a, b, c] = *triangle;
    a != b && b != c && c != a
}

/// Disjoint sets (union-find); the smallest member represents its set.
pub(crate) struct Sets(Vec<u32>);

impl Sets {
    pub(crate) fn new(count: usize) -> Self {
        Self((0..).take(count).collect())
    }

    pub(crate) fn find(&mut self, member: u32) -> u32 {
        let mut at = member;
        while self.0[at as usize] != at {
            let next = self.0[self.0[at as usize] as usize];
            self.0[at as usize] = next;
            at = next;
        }
        at
    }

    pub(crate) fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.find(a), self.find(b));
        self.0[a.max(b) as usize] = a.min(b);
    }
}

impl Topology {
    /// Determines the connectivity of `triangles` between `vertices` vertices, numbered from 0. Triangles whose
    /// indices are out of range are ignored.
    #[must_use]
    pub fn new(vertices: usize, triangles: &[[u32; 3]]) -> Self {
        let is_in = |triangle: &[u32; 3]| is_proper(triangle) && triangle.iter().all(|v| (*v as usize) < vertices);
        spend(16 * triangles.len());
        let mut halves: Vec<([u32; 2], Side)> = Vec::with_capacity(3 * triangles.len());
        for (number, triangle) in (0..).zip(triangles).filter(|(_, triangle)| is_in(triangle)) {
            for corner in 0..3 {
                let (from, to) = (triangle[corner], triangle[(corner + 1) % 3]);
                let side = Side { triangle: number, is_forward: from < to };
                halves.push(([from.min(to), from.max(to)], side));
            }
        }
        halves.sort_unstable();
        let mut edges = Vec::new();
        let (mut valence, mut first) = (vec![0; vertices], 0);
        for same in halves.chunk_by(|a, b| a.0 == b.0) {
            edges.push(Edge { vertices: same[0].0, first, count: same.len() });
            same[0].0.iter().for_each(|vertex| valence[*vertex as usize] += 1);
            first += same.len();
        }
        let sides: Vec<Side> = halves.into_iter().map(|(_, side)| side).collect();

        // Surfaces are connected through vertices, fans through edges: for fans, corners are joined instead of
        // vertices.
        let mut surfaces = Sets::new(vertices);
        let mut corners = Sets::new(3 * triangles.len());
        let corner_of = |triangle: u32, vertex: u32| {
            let place = triangles[triangle as usize].iter().position(|other| *other == vertex);
            3 * triangle + u32::try_from(place.unwrap_or(0)).unwrap_or(0)
        };
        for edge in &edges {
            surfaces.join(edge.vertices[0], edge.vertices[1]);
            let at = &sides[edge.first..edge.first + edge.count];
            for vertex in edge.vertices {
                for pair in at.windows(2) {
                    corners.join(corner_of(pair[0].triangle, vertex), corner_of(pair[1].triangle, vertex));
                }
            }
        }
        let mut number_of = vec![None; vertices];
        let mut components = 0;
        let mut component = Vec::with_capacity(triangles.len());
        for triangle in triangles {
            component.push(is_in(triangle).then(|| {
                let set = surfaces.find(triangle[0]) as usize;
                *number_of[set].get_or_insert_with(|| {
                    components += 1;
                    components - 1
                })
            }));
        }
        let mut fans = vec![0_u32; vertices];
        let mut fan_of_corner: Vec<[u32; 3]> = vec![[0; 3]; triangles.len()];
        for (number, triangle) in (0_u32..).zip(triangles).filter(|(_, triangle)| is_in(triangle)) {
            for (corner, vertex) in (0_u32..).zip(triangle) {
                // The smallest corner of a fan comes first and assigns its index.
                let root = corners.find(3 * number + corner);
                let fan = if root == 3 * number + corner {
                    fans[*vertex as usize] += 1;
                    fans[*vertex as usize] - 1
                } else {
                    fan_of_corner[root as usize / 3][root as usize % 3]
                };
                fan_of_corner[number as usize][corner as usize] = fan;
            }
        }

        let mut same: Vec<([u32; 3], u32)> = Vec::with_capacity(triangles.len());
        for (number, triangle) in (0..).zip(triangles).filter(|(_, triangle)| is_in(triangle)) {
            let mut sorted = *triangle;
            sorted.sort_unstable();
            same.push((sorted, number));
        }
        same.sort_unstable();
        let mut duplicates: Vec<u32> =
            same.windows(2).filter(|pair| pair[0].0 == pair[1].0).map(|pair| pair[1].1).collect();
        duplicates.sort_unstable();
        Self { edges, valence, component, components: components as usize, fans, fan_of_corner, duplicates, sides }
    }

    /// Returns the triangles at an edge of this topology, ascending; at least one. May panic for an edge of another.
    #[must_use]
    pub fn sides(&self, edge: &Edge) -> &[Side] {
        &self.sides[edge.first..edge.first + edge.count]
    }

    /// Returns the edges that more than two triangles share, in the order of [`Topology::edges`].
    pub fn non_manifold_edges(&self) -> impl Iterator<Item = &Edge> {
        self.edges.iter().filter(|edge| edge.count > 2)
    }

    /// Returns the edges of exactly two triangles that face opposite sides there (both run along the edge the same
    /// way), in the order of [`Topology::edges`].
    pub fn inconsistent_edges(&self) -> impl Iterator<Item = &Edge> {
        self.edges.iter().filter(|edge| match self.sides(edge) {
            [a, b] => a.is_forward == b.is_forward,
            _ => false,
        })
    }

    /// Returns whether there are triangles and each edge has exactly two. Their orientation does not count.
    #[must_use]
    pub fn is_closed(&self) -> bool {
        !self.edges.is_empty() && self.edges.iter().all(|edge| edge.count == 2)
    }

    /// Returns the borders of the surface: loops of vertices along edges that belong to only one triangle. If the
    /// mesh is oriented, the vertices are in the order of a triangle that would fill the loop. Open lines of edges,
    /// which occur at non-manifold vertices, are also returned as loops.
    #[must_use]
    pub fn holes(&self) -> Vec<Vec<u32>> {
        // Start and end of each border edge, in the direction of a filling triangle.
        let mut borders: Vec<[u32; 2]> = Vec::new();
        for edge in self.edges.iter().filter(|edge| edge.count == 1) {
            let [a, b] = edge.vertices;
            borders.push(if self.sides(edge)[0].is_forward { [b, a] } else { [a, b] });
        }
        // The border edges that begin or end at each vertex. Both are needed: in a mesh that is not oriented,
        // directions mean nothing.
        let mut begin = vec![0_usize; self.valence.len() + 1];
        for vertex in borders.iter().flatten() {
            begin[*vertex as usize + 1] += 1;
        }
        for vertex in 1..begin.len() {
            begin[vertex] += begin[vertex - 1];
        }
        let mut left = vec![0_usize; self.valence.len()];
        let mut at_vertex = vec![0_usize; 2 * borders.len()];
        for (number, border) in borders.iter().enumerate() {
            for vertex in border.map(|vertex| vertex as usize) {
                at_vertex[begin[vertex] + left[vertex]] = number;
                left[vertex] += 1;
            }
        }
        let mut is_done = vec![false; borders.len()];
        let mut loops = Vec::new();
        for start in 0..borders.len() {
            if is_done[start] {
                continue;
            }
            is_done[start] = true;
            let [first, mut at] = borders[start];
            let mut hole = vec![first];
            while at != first {
                hole.push(at);
                let vertex = at as usize;
                let (mut next, mut looked) = (None, 0);
                // Two border edges meet at a vertex of a manifold. Elsewhere there may be many, but a few are enough
                // to choose from.
                while looked < left[vertex].min(CHOICES) {
                    let number = at_vertex[begin[vertex] + looked];
                    if is_done[number] {
                        left[vertex] -= 1;
                        at_vertex.swap(begin[vertex] + looked, begin[vertex] + left[vertex]);
                        continue;
                    }
                    // Prefers to continue in the direction of the border.
                    let key = (borders[number][0] != at, number);
                    next = Some(next.map_or(key, |best: (bool, usize)| best.min(key)));
                    looked += 1;
                }
                let Some((_, next)) = next else { break };
                is_done[next] = true;
                at = if borders[next][0] == at { borders[next][1] } else { borders[next][0] };
            }
            loops.push(hole);
        }
        loops
    }
}
