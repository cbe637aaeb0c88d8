//! Geometry on the surface of a mesh: points, straight paths (geodesics) across edges, and discs.
//!
//! A path is straight if it is a straight line once the triangles that it crosses are unfolded into one plane. A disc
//! contains all points that straight paths of at most its radius reach. Where the surface is curved, paths that pass
//! a vertex on different sides diverge slightly: by the angle defect of the vertex, which is smaller the finer the
//! mesh is.
//!
//! A hat is the piecewise linear function that is 1 at one vertex and 0 at all others.

use std::collections::BTreeSet;

use glam::{DMat3, DVec2, DVec3};

use crate::curvature::curvatures;
pub use crate::tree::nearest_place;
use crate::tree::{Nearest, Tree, corners};

/// What is on the other side of a side of a triangle.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Beyond {
    /// The neighbouring triangle; [`NONE`] at a boundary.
    triangle: u32,
    /// Which corner of the neighbour is opposite the side.
    apex: u8,
    /// Position of this corner, unfolded into the plane of this triangle: along the side from its first corner, and
    /// away from this triangle, both in units of the side's length.
    at: DVec2,
}

const NONE: u32 = u32::MAX;

/// Minimum barycentric coordinate of a point in its triangle. A path that begins exactly at a corner might not find a
/// side through which to leave.
const INSIDE: f64 = 1e-7;

/// Maximum number of triangles that a path crosses. Paths in practice are shorter on a mesh of any size.
const LONGEST_WAY: usize = 1 << 14;

/// A point on a [`Surface`], with two directions. It belongs to the surface that returned it; with another one,
/// functions give wrong results or panic.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Place {
    /// Index of the triangle among those of the surface, which leave out triangles without area.
    pub triangle: u32,
    /// Barycentric coordinates in the triangle, in the order of its corners: above 0, with the sum 1.
    pub barycentric: [f64; 3],
    /// Two perpendicular unit vectors in the plane of the triangle. Their cross product is the outward normal if the
    /// triangles are oriented consistently.
    pub frame: [DVec3; 2],
}

/// A mesh that is prepared for paths and discs on its surface. It does not change.
#[derive(Debug, Clone, PartialEq)]
pub struct Surface {
    vertices_m: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
    /// Side k of a triangle leads from its corner k to the next corner.
    beyond: Vec<[Beyond; 3]>,
    areas_m2: Vec<f64>,
    curvatures_per_m: Vec<[f32; 6]>,
    is_closed: bool,
    edge_m: f64,
    tree: Tree,
}

/// Returns the corners at the two ends of side k, in order, and the opposite corner.
fn side(k: usize) -> [usize; 3] {
    [k, (k + 1) % 3, (k + 2) % 3]
}

/// Rotates a vector counterclockwise by a right angle.
fn turned(way: DVec2) -> DVec2 {
    DVec2::new(-way.y, way.x)
}

impl Surface {
    /// Creates the surface of a mesh whose vertices (m) are finite and whose edges have at most two triangles, which
    /// is not checked: an edge of more counts as a boundary. Panics if an index is out of range. Triangles without
    /// area are omitted, since no path crosses them.
    #[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
    pub fn new(vertices_m: &[DVec3], triangles: &[[u32; 3]]) -> Self {
        let has_area = |triangle: &[u32; 3]| {
            let [a, b, c] = corners(vertices_m, *triangle);
            (b - a).cross(c - a).length() > 1e-12 * (b - a).length().max((c - a).length()).powi(2)
        };
        let kept: Vec<[u32; 3]> = triangles.iter().copied().filter(has_area).collect();
        let mut sides: Vec<([u32; 2], u32, u8)> = Vec::with_capacity(3 * kept.len());
        for (triangle, number) in kept.iter().zip(0..) {
            for k in 0..3_u8 {
                let [a, b, _] = side(usize::from(k)).map(|corner| triangle[corner]);
                sides.push(([a.min(b), a.max(b)], number, k));
            }
        }
        sides.sort_unstable();
        let rim = Beyond { triangle: NONE, apex: 0, at: DVec2::ZERO };
        let mut beyond = vec![[rim; 3]; kept.len()];
        let mut is_closed = true;
        for of_edge in sides.chunk_by(|a, b| a.0 == b.0) {
            let [(_, one, of_one), (_, other, of_other)] = of_edge else {
                is_closed = false;
                continue;
            };
            for (from, at_from, to, at_to) in [(one, of_one, other, of_other), (other, of_other, one, of_one)] {
                let [a, b, _] = side(usize::from(*at_from)).map(|corner| kept[*from as usize][corner]);
                let apex = side(usize::from(*at_to))[2];
                let [a, b, c] = [a, b, kept[*to as usize][apex]].map(|vertex| vertices_m[vertex as usize]);
                let length2 = (b - a).length_squared();
                let at = DVec2::new((c - a).dot(b - a), (b - a).cross(c - a).length()) / length2;
                beyond[*from as usize][usize::from(*at_from)] = Beyond { triangle: *to, apex: apex as u8, at };
            }
        }
        let mut areas_m2 = vec![0.0; vertices_m.len()];
        for triangle in &kept {
            let [a, b, c] = corners(vertices_m, *triangle);
            let third_m2 = (b - a).cross(c - a).length() / 6.0;
            triangle.iter().for_each(|vertex| areas_m2[*vertex as usize] += third_m2);
        }
        let tree = Tree::new(vertices_m, &kept, 0..kept.len() as u32);
        // The edge length of equilateral triangles of this area.
        let mean_m2 = areas_m2.iter().sum::<f64>() / kept.len().max(1) as f64;
        let edge_m = (mean_m2 * 4.0 / 3.0_f64.sqrt()).sqrt();
        let curvatures_per_m = curvatures(vertices_m, &kept);
        let vertices_m = vertices_m.to_vec();
        Surface { vertices_m, triangles: kept, beyond, areas_m2, curvatures_per_m, is_closed, edge_m, tree }
    }

    /// Returns the positions of the vertices as given to [`Surface::new`], m.
    pub fn vertices_m(&self) -> &[DVec3] {
        &self.vertices_m
    }

    /// Returns the vertices of the triangle of `place`, in the order of its barycentric coordinates.
    pub fn triangle(&self, place: &Place) -> [u32; 3] {
        self.triangles[place.triangle as usize]
    }

    /// Returns the area of each vertex, by vertex: a third of that of the triangles around it, m²; 0 without
    /// triangles. That is the integral of its hat over the surface, so a mass lumped by it is the sum of its row of
    /// the consistent mass matrix.
    pub fn areas_m2(&self) -> &[f64] {
        &self.areas_m2
    }

    /// Returns the curvature tensor at a vertex: how the outward normal changes per metre along the surface, 1/m. It
    /// is symmetric, in the frame of the vertices, and 1/R along a sphere of radius R. Its mean over a disc is the
    /// curvature of the surface there. It is 0 for a vertex without triangles; panics if `vertex` is out of range.
    ///
    /// In a triangle of area A and normal N, whose corners have the normals n_k, the change of the interpolated normal
    /// is Σ n_k ⊗ ∇h_k, with ∇h_k = N × e_k/2A the gradient of the hat of corner k and e_k the side opposite to it.
    /// n_k is the mean of the normals of the triangles around, by area. A vertex has the symmetric part of Σ A·(Σ n_k
    /// ⊗ ∇h_k)/Σ A over its triangles.
    pub fn curvature_per_m(&self, vertex: usize) -> DMat3 {
        let [xx, yy, zz, xy, xz, yz] = self.curvatures_per_m[vertex].map(f64::from);
        DMat3::from_cols(DVec3::new(xx, xy, xz), DVec3::new(xy, yy, yz), DVec3::new(xz, yz, zz))
    }

    /// Returns the usual length of an edge, m: √(4A/√3), that of triangles with equal sides whose area A is the mean
    /// of all. 0 without triangles.
    pub fn edge_m(&self) -> f64 {
        self.edge_m
    }

    /// Returns on which side of the surface a tool of radius `radius_m` (m) is when it first appears at the height
    /// `height_m` (m) above its nearest point, negative below: 1 for outside, -1 for inside. A tool below a closed
    /// surface by at most its radius counts as outside; below an open one, as inside.
    pub fn side(&self, height_m: f64, radius_m: f64) -> f64 {
        let below_m = if self.is_closed { radius_m } else { 0.0 };
        if height_m >= -below_m { 1.0 } else { -1.0 }
    }

    /// Returns where a place is in space, m: Σ b_k·x_k over the corners of its triangle, with b_k the barycentric
    /// coordinates and x_k the positions.
    pub fn at_m(&self, place: &Place) -> DVec3 {
        let at_m = corners(&self.vertices_m, self.triangle(place));
        (0..3).map(|corner| at_m[corner] * place.barycentric[corner]).sum()
    }

    /// Returns the point of the surface that is nearest to `point_m`, m; of equally near ones, that of the first
    /// triangle. Its frame begins with the triangle's first side. `None` if the surface has no area.
    pub fn nearest(&self, point_m: DVec3) -> Option<Place> {
        let found = self.tree.nearest((&self.vertices_m, &self.triangles), point_m)?;
        Some(self.place_at(&found))
    }

    /// Works as [`Surface::nearest`], and finds the same: with less work, the nearer `near` is.
    pub fn nearest_from(&self, point_m: DVec3, near: &Place) -> Option<Place> {
        let found = self.tree.nearest_from((&self.vertices_m, &self.triangles), point_m, near.triangle)?;
        Some(self.place_at(&found))
    }

    fn place_at(&self, found: &Nearest) -> Place {
        let [a, b, c] = corners(&self.vertices_m, self.triangles[found.triangle as usize]);
        let along = (b - a).normalize();
        let across = (b - a).cross(c - a).normalize().cross(along);
        let barycentric = inside(found.barycentric);
        Place { triangle: found.triangle, barycentric, frame: [along, across] }
    }

    /// Returns the corners of the triangles around a place, m: of those that are joined to its triangle by others with a
    /// corner within `reach_m` (m) of the place. They come in the order in which they are found, from the place outward.
    pub fn triangles_around(&self, place: &Place, reach_m: f64) -> Vec<[DVec3; 3]> {
        let middle_m = self.at_m(place);
        let mut found = vec![place.triangle];
        let mut known: BTreeSet<u32> = BTreeSet::from([place.triangle]);
        let mut next = 0;
        while let Some(triangle) = found.get(next).copied() {
            next += 1;
            for Beyond { triangle, .. } in self.beyond[triangle as usize] {
                if triangle != NONE && known.insert(triangle) {
                    let corners_m = corners(&self.vertices_m, self.triangles[triangle as usize]);
                    if corners_m.iter().any(|corner_m| corner_m.distance(middle_m) < reach_m) {
                        found.push(triangle);
                    }
                }
            }
        }
        found.iter().map(|triangle| corners(&self.vertices_m, self.triangles[*triangle as usize])).collect()
    }

    /// Returns the end of the straight path of length and direction `by_m` from the place `from`, in metres along the
    /// directions of its frame. The frame of the end is that of `from`, carried along the path. A path that meets a
    /// boundary continues along it; one that crosses more than 16 384 triangles ends there.
    pub fn walk(&self, from: &Place, by_m: DVec2) -> Place {
        let mut place = *from;
        let mut left_m = by_m.x * place.frame[0] + by_m.y * place.frame[1];
        for _ in 0..LONGEST_WAY {
            let corners_m = corners(&self.vertices_m, self.triangle(&place));
            let area = (corners_m[1] - corners_m[0]).cross(corners_m[2] - corners_m[0]);
            // How fast the coordinate of the corner opposite side k changes.
            let opposite = |k: usize| side(k)[2];
            let rate = |k: usize| {
                let [a, b, _] = side(k).map(|corner| corners_m[corner]);
                area.cross(b - a).dot(left_m) / area.length_squared()
            };
            let reached = |k: usize| {
                let rate = rate(k);
                if rate < 0.0 { (place.barycentric[opposite(k)] / -rate).max(0.0) } else { f64::INFINITY }
            };
            let k = (0..3).fold(0, |best, k| if reached(k) < reached(best) { k } else { best });
            let part = reached(k).min(1.0);
            for side in 0..3 {
                place.barycentric[opposite(side)] += part * rate(side);
            }
            if part >= 1.0 {
                break;
            }
            left_m *= 1.0 - part;
            place.barycentric[opposite(k)] = 0.0;
            let [a, b, c] = side(k).map(|corner| corners_m[corner]);
            let along = (b - a).normalize();
            let Beyond { triangle, apex, .. } = self.beyond[place.triangle as usize][k];
            if triangle == NONE {
                left_m = left_m.dot(along) * along;
                // Stays off the boundary by a negligible distance, so that the path does not meet it again at once.
                place.barycentric = inside(place.barycentric);
                if left_m.length() <= 1e-15 * (b - a).length() {
                    break;
                }
                continue;
            }
            // Unfolds: what pointed away from this triangle points into the next.
            let next = self.triangles[triangle as usize];
            let far_m = self.vertices_m[next[usize::from(apex)] as usize];
            let out = -((c - a) - (c - a).dot(along) * along).normalize();
            let into = ((far_m - a) - (far_m - a).dot(along) * along).normalize();
            let unfold = |way: DVec3| way.dot(along) * along + way.dot(out) * into;
            let [ahead, one_way, other_way] = [left_m, place.frame[0], place.frame[1]].map(unfold);
            left_m = ahead;
            let [one, other, _] = side(k).map(|corner| (self.triangle(&place)[corner], place.barycentric[corner]));
            place.frame = [one_way, other_way];
            place.barycentric = next.map(|vertex| match vertex {
                _ if vertex == one.0 => one.1,
                _ if vertex == other.0 => other.1,
                _ => 0.0,
            });
            place.triangle = triangle;
        }
        place.barycentric = inside(place.barycentric);
        place.frame = square(&place.frame);
        place
    }

    /// Calls `crossed` for each triangle on the straight path from a point along a direction (of length 1) in its
    /// frame, until the path is `radius_m` long or meets a boundary.
    fn trace(&self, from: &Place, direction: DVec2, radius_m: f64, mut crossed: impl FnMut(Crossing)) {
        let triangle_m = corners(&self.vertices_m, self.triangle(from));
        let at_m = self.at_m(from);
        // Positions of the corners in the frame, relative to the point.
        let mut plane = triangle_m
            .map(|corner_m| DVec2::new((corner_m - at_m).dot(from.frame[0]), (corner_m - at_m).dot(from.frame[1])));
        let mut triangle = from.triangle;
        let is_left = |at: DVec2| direction.perp_dot(at) > 0.0;
        // The path leaves through a side with one end on the left and one on the right, and of the two such sides,
        // the one that is farther along.
        let meets = |a: DVec2, b: DVec2| {
            let [left, right] = [direction.perp_dot(a), direction.perp_dot(b)];
            let part = left / (left - right);
            (part, direction.dot(a + part * (b - a)))
        };
        let mut entered: Option<usize> = None;
        let (mut hats, mut distance_m) = (from.barycentric, 0.0);
        for _ in 0..LONGEST_WAY {
            let mut leaves: Option<(usize, f64, f64)> = None;
            for k in (0..3).filter(|k| entered != Some(*k)) {
                let [a, b, _] = side(k);
                let (a, b) = (plane[a], plane[b]);
                if is_left(a) != is_left(b) {
                    let (part, at_m) = meets(a, b);
                    if leaves.is_none_or(|best| at_m > best.2) {
                        leaves = Some((k, part, at_m));
                    }
                }
            }
            let Some((k, part, leaves_m)) = leaves else { return };
            let leaves_m = leaves_m.max(distance_m);
            let mut out = [0.0; 3];
            let [a, b, _] = side(k);
            (out[a], out[b]) = (1.0 - part, part);
            if leaves_m >= radius_m {
                let part = if leaves_m > distance_m { (radius_m - distance_m) / (leaves_m - distance_m) } else { 0.0 };
                let mut end = hats;
                for corner in 0..3 {
                    end[corner] += part * (out[corner] - hats[corner]);
                }
                crossed(Crossing {
                    vertices: self.triangles[triangle as usize],
                    from_m: distance_m,
                    to_m: radius_m,
                    hats: [hats, end],
                });
                return;
            }
            crossed(Crossing {
                vertices: self.triangles[triangle as usize],
                from_m: distance_m,
                to_m: leaves_m,
                hats: [hats, out],
            });
            let Beyond { triangle: next, apex, at } = self.beyond[triangle as usize][k];
            if next == NONE {
                return;
            }
            let (a_at, b_at, c_at) = (plane[a], plane[b], plane[side(k)[2]]);
            let along = b_at - a_at;
            // Points away from this triangle.
            let away = if along.perp_dot(c_at - a_at) > 0.0 { -turned(along) } else { turned(along) };
            let apex_at = a_at + at.x * along + at.y * away;
            let vertices = self.triangles[triangle as usize];
            let of = |vertex: u32| match vertex {
                _ if vertex == vertices[a] => (a_at, 1.0 - part),
                _ if vertex == vertices[b] => (b_at, part),
                _ => (apex_at, 0.0),
            };
            for (corner, vertex) in self.triangles[next as usize].into_iter().enumerate() {
                (plane[corner], hats[corner]) = of(vertex);
            }
            // The side opposite the apex begins at the corner after it.
            entered = Some((usize::from(apex) + 1) % 3);
            (triangle, distance_m) = (next, leaves_m);
        }
    }
}

/// Returns barycentric coordinates that are kept off the sides of the triangle.
fn inside(barycentric: [f64; 3]) -> [f64; 3] {
    let kept = barycentric.map(|hat| hat.max(INSIDE));
    let sum: f64 = kept.iter().sum();
    kept.map(|hat| hat / sum)
}

/// Makes two directions perpendicular and of length 1 again, after rounding.
fn square([along, across]: &[DVec3; 2]) -> [DVec3; 2] {
    let along = along.normalize();
    [along, (*across - across.dot(along) * along).normalize()]
}

/// The part of a straight path in one triangle.
#[derive(Debug, Clone, Copy)]
struct Crossing {
    vertices: [u32; 3],
    /// Distances from the beginning of the path at which this part begins and ends, m.
    from_m: f64,
    to_m: f64,
    /// The hats of the vertices at both ends.
    hats: [[f64; 3]; 2],
}

/// A vertex near a disc, whose hat may overlap it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Covered {
    /// Index of the vertex in [`Surface::vertices_m`].
    pub vertex: u32,
    /// Mean of its hat over the disc, from 0 to 1. The weights of all vertices add up to 1.
    pub weight: f64,
    /// Derivative of the weight with respect to the position of the disc, in the directions of the frame of its
    /// centre, 1/m.
    pub gradient: DVec2,
}

/// Minimum and maximum number of paths in a disc, and their number per edge length in its radius.
const WAYS: [usize; 2] = [48, 192];
const WAYS_PER_EDGE: f64 = 32.0;

/// Minimum radius of the disc over which hats are averaged, as a fraction of the disc's own radius, when its area is
/// matched.
const MIN_PART: f64 = 0.05;

/// If a disc folds so much that its middle moves over less than this fraction of the area that its centre moves over,
/// it has no reliable normal. The fraction is 0.72 on a cylinder if the disc reaches half around it, 0.18 where it
/// meets itself, and becomes negative beyond that; on a sphere it is 0.41 if the disc reaches the equator.
const MIN_SPAN: f64 = 0.25;

/// Fraction of its area that a disc may cover a second time. If it covers more, it meets itself, or wraps around an
/// end. (On a sphere, straight paths converge: 8 % at an angle of 1, 17 % at 1.5.)
const MAX_OVERLAP: f64 = 0.2;

/// If paths are farther apart at the edge of the disc than this fraction of an edge length, it can't be determined
/// how often they cover a vertex.
const DENSE: f64 = 0.4;

/// A disc with a radius of more edge lengths than this is first tried with half of its radius, recursively.
const STAGE_EDGES: f64 = 4.0;
const MAX_STAGES: u32 = 20;

/// Number of bisections in the search for the largest simple disc.
const HALVINGS: u32 = 16;

/// A disc of given radius that can be placed anywhere on a surface.
///
/// The hats of a mesh blur a disc: under uniform pressure it acts as if it were larger, considerably so on a coarse
/// mesh. Its effective area is 1/Σ(w²/A): an elastic foundation of k N/m³ resists with k times this area. So the hats
/// are averaged over a smaller disc whose effective area is πa², determined anew at each position. Along a path, hats
/// are linear in each triangle and are integrated exactly; over the directions of the paths, the integral is a sum of
/// equal parts.
///
/// On a part that is thinner than the disc, straight paths lead around it: they meet on its far side, or wrap around
/// its end. Such a disc has no well-defined position or normal. It is made smaller until it is simple: it covers
/// hardly anything twice, and its middle moves with its centre ([`MIN_SPAN`]). At the end of a thread it is almost a
/// point.
#[derive(Debug, Clone)]
pub struct SurfaceDisc {
    radius_m: f64,
    edge_m: f64,
    /// Whether hats are averaged over the whole disc.
    is_whole: bool,
    /// ρ: radius of the disc over which hats are averaged at the present position.
    drawn_m: f64,
    directions: Vec<DVec2>,
    /// The parts of all paths, with indices into `covered` for vertices, and the end of each path in this list.
    crossings: Vec<SurfacePart>,
    ends: Vec<usize>,
    covered: Vec<Covered>,
    areas_m2: Vec<f64>,
    /// Hash table: index into `covered` by vertex; [`NONE`] marks a free slot. Its length is a power of two.
    found: Vec<(u32, u32)>,
    /// Scratch memory: ∂w/∂ρ of each covered vertex.
    widening: Vec<f64>,
}

#[derive(Debug, Clone, Copy)]
struct SurfacePart {
    covered: [u32; 3],
    from_m: f64,
    to_m: f64,
    hats: [[f64; 3]; 2],
}

impl SurfacePart {
    /// Returns the part within a radius, as a fraction of this whole part. It must begin within the radius.
    fn share_within(&self, rho_m: f64) -> f64 {
        let whole_m = self.to_m - self.from_m;
        if whole_m > 0.0 { (self.to_m.min(rho_m) - self.from_m) / whole_m } else { 0.0 }
    }

    /// Returns the hats at a fraction of this part, with the indices of their vertices in `covered`.
    fn hats_at(&self, share: f64) -> impl Iterator<Item = (usize, f64)> {
        let [first, last] = self.hats;
        let hat = move |corner: usize| first[corner] + share * (last[corner] - first[corner]);
        let covered = self.covered;
        (0..3).map(move |corner| (covered[corner] as usize, hat(corner)))
    }
}

/// Returns the number of paths of a disc.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn ways_of(radius_m: f64, edge_m: f64) -> usize {
    let wanted = (WAYS_PER_EDGE * radius_m / edge_m) as usize;
    wanted.next_multiple_of(8).clamp(WAYS[0], WAYS[1])
}

/// Returns for each path its parts that begin within a radius.
fn ways<'c>(
    crossings: &'c [SurfacePart],
    ends: &'c [usize],
    rho_m: f64,
) -> impl Iterator<Item = impl Iterator<Item = &'c SurfacePart>> {
    let begins = std::iter::once(0).chain(ends.iter().copied());
    begins.zip(ends).map(move |(begin, end)| crossings[begin..*end].iter().take_while(move |part| part.from_m < rho_m))
}

impl SurfaceDisc {
    /// Creates a disc of `radius_m` (m, above 0) for a surface with edges of about `edge_m` (m, [`Surface::edge_m`]).
    /// It covers nothing before the first [`SurfaceDisc::lay`].
    #[allow(clippy::cast_precision_loss)]
    pub fn new(radius_m: f64, edge_m: f64) -> Self {
        let count = ways_of(radius_m, edge_m);
        let direction = |way: usize| {
            let angle = std::f64::consts::TAU * (way as f64 + 0.5) / count as f64;
            DVec2::new(libm::cos(angle), libm::sin(angle))
        };
        SurfaceDisc {
            radius_m,
            edge_m,
            is_whole: false,
            drawn_m: radius_m,
            directions: (0..count).map(direction).collect(),
            crossings: Vec::new(),
            ends: Vec::new(),
            covered: Vec::new(),
            areas_m2: Vec::new(),
            found: vec![(NONE, 0); 64],
            widening: Vec::new(),
        }
    }

    /// Creates a disc as [`SurfaceDisc::new`] does, whose hats are averaged over the whole disc: its area is not matched. So
    /// its weights are those of an even pressure.
    pub fn whole(radius_m: f64, edge_m: f64) -> Self {
        SurfaceDisc { is_whole: true, ..Self::new(radius_m, edge_m) }
    }

    /// Estimates how many triangles the paths of a disc of `radius_m` (m) cross, on a surface whose edges are about
    /// `edge_m` (m) long: the work of laying it. There are 48 to 192 paths, by the radius, and a path crosses about 1
    /// + 2·`radius_m`/`edge_m`, two for each length of an edge.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn crossings(radius_m: f64, edge_m: f64) -> u64 {
        ways_of(radius_m, edge_m) as u64 * (1.0 + 2.0 * radius_m / edge_m) as u64
    }

    /// Returns the radius that the disc was created with, m.
    pub fn radius_m(&self) -> f64 {
        self.radius_m
    }

    /// Returns the vertices that the paths of the disc reach at its present position, each once, in the order in which
    /// the paths meet them. Those beyond the part of the disc over which hats are averaged have the weight 0. Empty
    /// before the first [`SurfaceDisc::lay`].
    pub fn covered(&self) -> &[Covered] {
        &self.covered
    }

    /// Returns the weight of a vertex at the present position of the disc ([`Covered::weight`]); 0 if the disc does
    /// not cover it, and before the first [`SurfaceDisc::lay`]. The time does not depend on the number of covered
    /// vertices.
    pub fn weight_of(&self, vertex: u32) -> f64 {
        match self.found[slot_of(vertex, &self.found)] {
            (NONE, _) => 0.0,
            (_, number) => self.covered[number as usize].weight,
        }
    }

    /// Returns how far the disc may move at once from its present position, so that its normal turns little on the
    /// way, m: half the radius of the disc that hats are averaged over (before the first [`SurfaceDisc::lay`], its own
    /// radius), or a quarter of an edge if that is more.
    pub fn stride_m(&self) -> f64 {
        0.5 * self.drawn_m.max(0.5 * self.edge_m)
    }

    /// Lays the disc on `place` of `surface`, which replaces its position and [`SurfaceDisc::covered`]. Finds the
    /// radius ρ over which hats are averaged with Σ(w²/A)·πa² = 1, with w the weights, a the disc's radius and A the
    /// areas of the vertices, by Newton's method between a/20 and a; ρ = a or a/20 if there is no such radius between.
    /// ρ = a for a disc made by [`SurfaceDisc::whole`]. Where the tissue is thinner than the disc, ρ shrinks until the disc
    /// is simple. Gradients are in the frame of `place`.
    pub fn lay(&mut self, surface: &Surface, place: &Place) {
        // Around a thin part, paths have no end: a large disc is tried in stages, from a small one upwards.
        let mut stages = 0;
        while self.radius_m / f64::from(1 << stages) > STAGE_EDGES * self.edge_m && stages < MAX_STAGES {
            stages += 1;
        }
        for stage in (1..=stages).rev() {
            let reach_m = self.radius_m / f64::from(1 << stage);
            self.trace(surface, place, reach_m);
            if !self.draw(surface, reach_m) {
                return self.shrink(surface, reach_m);
            }
        }
        self.trace(surface, place, self.radius_m);
        let target_m2 = std::f64::consts::PI * self.radius_m * self.radius_m;
        // Finds the radius ρ at which Σ(w²/A)·πa² is 1. The sum decreases with ρ; Newton's method, kept between two
        // bounds.
        let (mut low, mut high) = (MIN_PART * self.radius_m, self.radius_m);
        let mut rho_m = high;
        let (mut excess, mut slope) = self.weigh(rho_m, target_m2);
        let mut is_matched = false;
        if excess < 0.0 && !self.is_whole {
            rho_m = low;
            (excess, slope) = self.weigh(rho_m, target_m2);
            is_matched = excess > 0.0;
            if is_matched {
                rho_m = 0.8 * high;
                (excess, slope) = self.weigh(rho_m, target_m2);
                for _ in 0..40 {
                    if excess > 0.0 {
                        low = rho_m;
                    } else {
                        high = rho_m;
                    }
                    let next_m = rho_m - excess / slope;
                    let next_m = if next_m > low && next_m < high { next_m } else { 0.5 * (low + high) };
                    let is_found = (next_m - rho_m).abs() <= 1e-12 * self.radius_m;
                    rho_m = next_m;
                    (excess, slope) = self.weigh(rho_m, target_m2);
                    if is_found {
                        break;
                    }
                }
            }
        }
        self.incline(rho_m);
        self.drawn_m = rho_m;
        if !self.is_plain(surface, rho_m) {
            return self.shrink(surface, rho_m);
        }
        if is_matched && slope < 0.0 {
            // ρ also changes with the position.
            let mut change = DVec2::ZERO;
            for (covered, area_m2) in self.covered.iter().zip(&self.areas_m2) {
                change += 2.0 * covered.weight / area_m2 * target_m2 * covered.gradient;
            }
            let widens = change / -slope;
            for (covered, widening) in self.covered.iter_mut().zip(&self.widening) {
                covered.gradient += *widening * widens;
            }
        }
    }

    /// Returns whether the disc of radius ρ, with its present weights and gradients, covers hardly anything twice and
    /// moves with its centre.
    fn is_plain(&self, surface: &Surface, rho_m: f64) -> bool {
        let (mut along, mut twice_m2) = ([DVec3::ZERO; 2], 0.0);
        let area_m2 = std::f64::consts::PI * rho_m * rho_m;
        for (covered, of_vertex_m2) in self.covered.iter().zip(&self.areas_m2) {
            let at_m = surface.vertices_m[covered.vertex as usize];
            along[0] += covered.gradient.x * at_m;
            along[1] += covered.gradient.y * at_m;
            twice_m2 += (covered.weight * area_m2 - of_vertex_m2).max(0.0);
        }
        #[allow(clippy::cast_precision_loss)]
        let apart_m = std::f64::consts::TAU * rho_m / self.directions.len() as f64;
        let is_told = apart_m < DENSE * self.edge_m;
        along[0].cross(along[1]).length() >= MIN_SPAN && !(is_told && twice_m2 > MAX_OVERLAP * area_m2)
    }

    /// Averages the hats over a disc of radius ρ, without matching its area. Returns whether it is simple.
    fn draw(&mut self, surface: &Surface, rho_m: f64) -> bool {
        self.drawn_m = rho_m;
        self.weigh(rho_m, 1.0);
        self.incline(rho_m);
        self.is_plain(surface, rho_m)
    }

    /// Makes the disc the largest simple one with a radius below ρ. If there is none, it is almost a point.
    fn shrink(&mut self, surface: &Surface, rho_m: f64) {
        let (mut low, mut high) = (0.0, rho_m);
        for _ in 0..HALVINGS {
            let middle = 0.5 * (low + high);
            if self.draw(surface, middle) { low = middle } else { high = middle }
        }
        // Half of the shortest interval is a simple disc within its triangle, as good as a point.
        self.draw(surface, if low > 0.0 { low } else { high });
    }

    /// Follows all paths up to a radius.
    fn trace(&mut self, surface: &Surface, place: &Place, reach_m: f64) {
        self.crossings.clear();
        self.ends.clear();
        self.covered.clear();
        self.areas_m2.clear();
        self.found.fill((NONE, 0));
        let SurfaceDisc { directions, crossings, ends, covered, areas_m2, found, .. } = self;
        for direction in directions.iter() {
            surface.trace(place, *direction, reach_m, |Crossing { vertices, from_m, to_m, hats }| {
                let mut number = |corner: usize| number(vertices[corner], surface, covered, areas_m2, found);
                let covered = [number(0), number(1), number(2)];
                crossings.push(SurfacePart { covered, from_m, to_m, hats });
            });
            ends.push(crossings.len());
        }
        self.widening.clear();
        self.widening.resize(self.covered.len(), 0.0);
    }

    /// Averages the hats over a disc of radius ρ. Returns Σ(w²/A)·πa² − 1, and its derivative with respect to ρ, 1/m.
    fn weigh(&mut self, rho_m: f64, target_m2: f64) -> (f64, f64) {
        let SurfaceDisc { crossings, ends, covered, areas_m2, widening, .. } = self;
        covered.iter_mut().for_each(|covered| covered.weight = 0.0);
        widening.fill(0.0);
        let (mut area, mut rim) = (0.0, 0.0);
        for part in ways(crossings, ends, rho_m).flatten() {
            let SurfacePart { from_m, to_m, hats: [first, last], .. } = part;
            let (length_m, share) = (to_m.min(rho_m) - from_m, part.share_within(rho_m));
            // ∫ r dr, and the integral of the fraction of this part that is passed, times r.
            let (even, rising) =
                (length_m * (from_m + 0.5 * length_m), share * length_m * (0.5 * from_m + length_m / 3.0));
            area += even;
            for corner in 0..3 {
                let slope = last[corner] - first[corner];
                covered[part.covered[corner] as usize].weight += first[corner] * even + slope * rising;
            }
            if *to_m >= rho_m {
                rim += rho_m;
                for (vertex, hat) in part.hats_at(share) {
                    widening[vertex] += hat * rho_m;
                }
            }
        }
        let (mut sum, mut slope) = (0.0, 0.0);
        for ((covered, widening), area_m2) in covered.iter_mut().zip(widening).zip(areas_m2) {
            covered.weight /= area;
            *widening = (*widening - covered.weight * rim) / area;
            sum += covered.weight * covered.weight / *area_m2;
            slope += 2.0 * covered.weight * *widening / *area_m2;
        }
        (sum * target_m2 - 1.0, slope * target_m2)
    }

    /// Computes the derivatives of the weights of a disc of radius ρ with respect to its position: what enters at its
    /// edge.
    fn incline(&mut self, rho_m: f64) {
        let SurfaceDisc { directions, crossings, ends, covered, .. } = self;
        covered.iter_mut().for_each(|covered| covered.gradient = DVec2::ZERO);
        let (mut area, mut whole) = (0.0, DVec2::ZERO);
        for (way, direction) in ways(crossings, ends, rho_m).zip(directions) {
            let mut reached_m = 0.0;
            for part in way {
                reached_m = part.to_m.min(rho_m);
                if part.to_m >= rho_m {
                    whole += rho_m * *direction;
                    for (vertex, hat) in part.hats_at(part.share_within(rho_m)) {
                        covered[vertex].gradient += hat * rho_m * *direction;
                    }
                }
            }
            area += 0.5 * reached_m * reached_m;
        }
        for covered in covered {
            covered.gradient = (covered.gradient - covered.weight * whole) / area;
        }
    }
}

/// Returns the slot of a vertex in `found`, or the free slot for it.
fn slot_of(vertex: u32, found: &[(u32, u32)]) -> usize {
    let mut slot = (vertex.wrapping_mul(0x9E37_79B1) >> 7) as usize & (found.len() - 1);
    while found[slot].0 != NONE && found[slot].0 != vertex {
        slot = (slot + 1) & (found.len() - 1);
    }
    slot
}

/// Returns the index of a vertex in `covered`, and adds it if it is not there yet.
#[allow(clippy::cast_possible_truncation)]
fn number(
    vertex: u32,
    surface: &Surface,
    covered: &mut Vec<Covered>,
    areas_m2: &mut Vec<f64>,
    found: &mut Vec<(u32, u32)>,
) -> u32 {
    let slot = slot_of(vertex, found);
    if found[slot].0 == vertex {
        return found[slot].1;
    }
    let number = covered.len() as u32;
    found[slot] = (vertex, number);
    covered.push(Covered { vertex, weight: 0.0, gradient: DVec2::ZERO });
    areas_m2.push(surface.areas_m2[vertex as usize]);
    if 2 * covered.len() > found.len() {
        let before = std::mem::take(found);
        *found = vec![(NONE, 0); 2 * before.len()];
        for entry in before.into_iter().filter(|entry| entry.0 != NONE) {
            let slot = slot_of(entry.0, found);
            found[slot] = entry;
        }
    }
    number
}
