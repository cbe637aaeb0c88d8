//! Remeshes the surface of a shape evenly. Long edges are split, short ones collapse, edges flip to Delaunay, vertices
//! move along the surface to the middle of their neighbours (Botsch and Kobbelt, "A remeshing approach to
//! multiresolution modeling", 2004).

use glam::{BVec3, DVec3};

use super::halfedges::{HalfEdges, NONE};
use super::net::Net;
use super::shape::Shape;

/// Ratio to the edge length above which edges are split; no collapse creates such an edge. With 4/3 and 4/5 a split
/// creates no short edge, and a collapse no long one.
const LONG: f64 = 4.0 / 3.0;

/// Ratio to the edge length below which edges collapse.
const SHORT: f64 = 4.0 / 5.0;

/// Maximum number of rounds, more than the finest mesh needs: each halves edges that are too long.
const MAX_ROUNDS: usize = 24;

/// Number of rounds in succession with hardly any change after which the mesh counts as even.
const CALM_ROUNDS: usize = 3;

/// Largest number of edges of a vertex that a collapse may create.
const LARGEST_VALENCE: usize = 8;

/// Smallest number of edges of a vertex that a collapse or flip may leave, except at a boundary.
const SMALLEST_VALENCE: usize = 4;

/// The state of a remeshing.
pub(super) struct Remesh<'s> {
    shape: &'s Shape,
    /// The target edge length, mm.
    edge: f64,
    mesh: HalfEdges,
    places: Vec<DVec3>,
    /// The normals of the surface at the vertices.
    normals: Vec<DVec3>,
    /// The axes along which each vertex must not move: it is on the boundary if there is any.
    held: Vec<BVec3>,
}

/// An evenly remeshed surface.
pub(super) struct Even {
    /// Positions of the vertices, mm.
    pub(super) places: Vec<DVec3>,
    /// Vertices of each triangle, counterclockwise seen from the positive side.
    pub(super) triangles: Vec<[u32; 3]>,
    /// Whether each vertex is on the boundary.
    pub(super) at_boundary: Vec<bool>,
}

impl<'s> Remesh<'s> {
    /// Starts from the first mesh of a shape; `None` unless it is a manifold.
    pub(super) fn new(shape: &'s Shape, net: &Net, edge: f64) -> Option<Remesh<'s>> {
        let mesh = HalfEdges::new(net.places.len(), &net.triangles)?;
        let settled = net.places.iter().zip(&net.held).map(|(&place, &held)| shape.settle(place, held, 3));
        let (places, normals) = settled.unzip();
        Some(Remesh { shape, edge, mesh, places, normals, held: net.held.clone() })
    }

    /// Remeshes until the mesh is even.
    pub(super) fn even(mut self) -> Even {
        let mut calm = 0;
        for _ in 0..MAX_ROUNDS {
            let changed = self.split_long() + self.collapse_short();
            self.flip_to_delaunay();
            self.relax(1);
            calm = if changed > self.places.len() / 100 { 0 } else { calm + 1 };
            if calm == CALM_ROUNDS {
                break;
            }
        }
        self.flip_to_delaunay();
        self.relax(3);
        self.flip_to_delaunay();
        let (triangles, kept) = self.mesh.compact();
        let places = kept.iter().map(|&vertex| self.places[vertex as usize]).collect();
        let at_boundary = kept.iter().map(|&vertex| self.mesh.at_boundary(vertex)).collect();
        Even { places, triangles, at_boundary }
    }

    /// Returns the position of a vertex, mm.
    fn place(&self, vertex: u32) -> DVec3 {
        self.places[vertex as usize]
    }

    /// Returns the length of the edge of a half-edge, mm.
    fn length(&self, h: u32) -> f64 {
        (self.place(self.mesh.end(h)) - self.place(self.mesh.start(h))).length()
    }

    /// Returns whether `h` is the representative half-edge of an existing edge.
    fn is_edge(&self, h: u32) -> bool {
        // Without a twin, the other number is the largest one.
        self.mesh.lives(h) && h < self.mesh.twin(h)
    }

    /// Splits the long edges, the longest first. Returns their number. A split changes the edges of its triangles,
    /// which may then have to wait for the next round; the longest edge of a triangle does not wait.
    fn split_long(&mut self) -> usize {
        let lengths = (0..self.mesh.half_edges()).filter(|&h| self.is_edge(h)).map(|h| (self.length(h), h));
        let mut long: Vec<(f64, u32)> = lengths.filter(|&(length, _)| length > LONG * self.edge).collect();
        long.sort_by(|one, other| other.0.total_cmp(&one.0));
        let mut count = 0;
        for (_, h) in long {
            if self.length(h) <= LONG * self.edge {
                continue;
            }
            let (a, b) = (self.mesh.start(h) as usize, self.mesh.end(h) as usize);
            let at_boundary = self.mesh.twin(h) == NONE;
            let held = if at_boundary { self.held[a] & self.held[b] } else { BVec3::FALSE };
            let (place, normal) = self.shape.settle((self.places[a] + self.places[b]) / 2.0, held, 2);
            self.mesh.split(h);
            self.places.push(place);
            self.normals.push(normal);
            self.held.push(held);
            count += 1;
        }
        count
    }

    /// Collapses each edge that is short or at a vertex with only three edges, if the surface keeps its shape.
    /// Returns their number.
    fn collapse_short(&mut self) -> usize {
        let mut count = 0;
        for h in 0..self.mesh.half_edges() {
            let is_short = |h| {
                let has_spare_end = self.is_spare(self.mesh.start(h)) || self.is_spare(self.mesh.end(h));
                has_spare_end || self.length(h) < SHORT * self.edge
            };
            if self.is_edge(h) && is_short(h) {
                let twin = self.mesh.twin(h);
                count += usize::from(self.collapse(h) || (twin != NONE && self.collapse(twin)));
            }
        }
        count
    }

    /// Returns whether a vertex has too few edges: removing it creates no new ones.
    fn is_spare(&self, vertex: u32) -> bool {
        !self.mesh.at_boundary(vertex) && self.mesh.valence(vertex) < SMALLEST_VALENCE
    }

    /// Collapses the edge of h = a → b, if the surface keeps its shape, no edge becomes long, and no valence large.
    /// Returns whether.
    fn collapse(&mut self, h: u32) -> bool {
        let (a, b) = (self.mesh.start(h), self.mesh.end(h));
        let [held_a, held_b] = [a, b].map(|vertex| self.held[vertex as usize]);
        // Vertex a must not leave the boundary.
        let may_move = (held_a & held_b) == held_a;
        let valence = self.mesh.valence(a) + self.mesh.valence(b);
        let keeps_edges = [h, self.mesh.twin(h)].into_iter().filter(|&h| h != NONE).all(|h| {
            let apex = self.mesh.apex(h);
            self.mesh.at_boundary(apex) || self.mesh.valence(apex) > SMALLEST_VALENCE
        });
        if !may_move || valence > LARGEST_VALENCE + 4 || !keeps_edges || !self.mesh.may_collapse(h) {
            return false;
        }
        let is_spare = self.is_spare(a);
        let (place, normal) = if held_a == held_b && !is_spare {
            self.shape.settle((self.place(a) + self.place(b)) / 2.0, held_a, 2)
        } else {
            (self.place(b), self.normals[b as usize])
        };
        let fits = |vertex: u32, other: u32| {
            self.mesh.ring(vertex).all(|around| {
                let (from, to) = (self.mesh.end(around), self.mesh.apex(around));
                let is_short = |end: u32| is_spare || (self.place(end) - place).length() <= LONG * self.edge;
                let corners = [(place, normal), self.corner(from), self.corner(to)];
                from == other || to == other || (is_short(from) && is_short(to) && faces_outward(corners))
            })
        };
        if !fits(a, b) || !fits(b, a) {
            return false;
        }
        self.mesh.collapse(h);
        self.places[b as usize] = place;
        self.normals[b as usize] = normal;
        true
    }

    /// Returns the position of a vertex and the normal there.
    fn corner(&self, vertex: u32) -> (DVec3, DVec3) {
        (self.place(vertex), self.normals[vertex as usize])
    }

    /// Flips edges until the angles opposite each have a sum of at most 180°, if the surface keeps its shape.
    fn flip_to_delaunay(&mut self) {
        // Nearly all flips are done in the first two passes.
        for _ in 0..8 {
            let mut is_delaunay = true;
            for h in 0..self.mesh.half_edges() {
                if self.is_edge(h) && self.mesh.twin(h) != NONE && self.is_to_flip(h) {
                    self.mesh.flip(h);
                    is_delaunay = false;
                }
            }
            if is_delaunay {
                break;
            }
        }
    }

    /// Returns whether an edge is not Delaunay and can be flipped.
    fn is_to_flip(&self, h: u32) -> bool {
        let (a, b) = (self.mesh.start(h), self.mesh.end(h));
        let (c, d) = (self.mesh.apex(h), self.mesh.apex(self.mesh.twin(h)));
        let cotangent = |apex: u32| {
            let (to_a, to_b) = (self.place(a) - self.place(apex), self.place(b) - self.place(apex));
            to_a.dot(to_b) / to_a.cross(to_b).length()
        };
        // A margin, so that rounding does not flip the diagonal of a square without end.
        cotangent(c) + cotangent(d) < -1e-6
            && faces_outward([a, d, c].map(|vertex| self.corner(vertex)))
            && faces_outward([d, b, c].map(|vertex| self.corner(vertex)))
            && [a, b]
                .into_iter()
                .all(|vertex| self.mesh.at_boundary(vertex) || self.mesh.valence(vertex) > SMALLEST_VALENCE)
            && !self.mesh.are_connected(c, d)
    }

    /// Moves each vertex along the surface to the middle of its neighbours (of those along its boundary, if it is on
    /// one), then onto the surface in `steps` steps.
    fn relax(&mut self, steps: usize) {
        let relaxed = |vertex: u32| {
            let (place, normal) = self.corner(vertex);
            let held = self.held[vertex as usize];
            let along = |&other: &u32| (self.held[other as usize] & held) == held;
            let neighbours = self.mesh.neighbours(vertex).filter(along);
            let (sum, count) = neighbours.fold((DVec3::ZERO, 0), |(sum, n), other| (sum + self.place(other), n + 1));
            if count == 0 {
                return (place, normal);
            }
            let way = sum / f64::from(count) - place;
            let way = DVec3::select(held, DVec3::ZERO, way - normal * way.dot(normal));
            self.shape.settle(place + way * 0.7, held, steps)
        };
        let relaxed = (0..self.mesh.vertices()).map(relaxed);
        (self.places, self.normals) = relaxed.unzip();
    }
}

/// Returns whether a triangle faces the side of the normals at its corners, rather than along the surface or into it.
fn faces_outward(corners: [(DVec3, DVec3); 3]) -> bool {
    let [(a, at_a), (b, at_b), (c, at_c)] = corners;
    let normal = (b - a).cross(c - a);
    let outward = at_a + at_b + at_c;
    normal.dot(outward) > 0.3 * normal.length() * outward.length()
}
