//! The sheet as vertices in space, refined as for viewers, with normals and texture coordinates.

use glam::{DVec2, DVec3};

use crate::surface::{Encoding, Refinement, Snapshot, encode};

#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Vertex {
    /// Position, m.
    pub(super) at_m: DVec3,
    /// Unit normal out of the tissue.
    pub(super) normal: DVec3,
    /// Texture coordinates, 0 to 1 along x and along y.
    pub(super) share: DVec2,
    /// The fraction of ambient light that reaches the vertex: less in a dent.
    pub(super) open: f64,
}

/// Vertex (a, b) at a·count[1] + b.
#[derive(Debug)]
pub(super) struct Surface {
    pub(super) count: [usize; 2],
    pub(super) vertices: Vec<Vertex>,
}

impl Surface {
    pub(super) fn new(snapshot: &Snapshot, refinement: Refinement) -> Self {
        let points = refinement.coarsest();
        // Interpolate the points' normals, so that shading is smooth: a bilinear patch has creases of its own.
        let places_m = places(snapshot, points);
        let grid = points.vertices();
        let (normals, open) = (normals(grid, &places_m), openness(points, &places_m));
        let count = refinement.vertices();
        let part = refinement.between() + 1;
        let vertices = places(snapshot, refinement)
            .into_iter()
            .enumerate()
            .map(|(index, at_m)| {
                let [a, b] = [index / count[1], index % count[1]];
                let normal = bilinear(grid, &normals, [a, b], part).try_normalize().unwrap_or(DVec3::Z);
                let share = refinement.texture_at(index);
                Vertex { at_m, normal, share, open: bilinear(grid, &open, [a, b], part).x }
            })
            .collect();
        Surface { count, vertices }
    }
}

/// The positions of the vertices, m, from the data that a viewer gets.
fn places(snapshot: &Snapshot, refinement: Refinement) -> Vec<DVec3> {
    let [_, ny] = refinement.vertices();
    let mut places: Vec<DVec3> = (0..refinement.vertex_count()).map(|vertex| refinement.rest_m(vertex)).collect();
    for patch in encode(snapshot, refinement, Encoding::F32).patches {
        for (k, bytes) in patch.bytes.chunks_exact(12).enumerate() {
            let (a, b) = (patch.first[0] + k / patch.count[1], patch.first[1] + k % patch.count[1]);
            let component = |c: usize| {
                let four = [bytes[4 * c], bytes[4 * c + 1], bytes[4 * c + 2], bytes[4 * c + 3]];
                f64::from(f32::from_le_bytes(four))
            };
            places[a * ny + b] += DVec3::new(component(0), component(1), component(2));
        }
    }
    places
}

fn normals([nx, ny]: [usize; 2], places: &[DVec3]) -> Vec<DVec3> {
    let at = |i: usize, j: usize| places[i * ny + j];
    (0..nx * ny)
        .map(|index| {
            let (i, j) = (index / ny, index % ny);
            let along_x = at((i + 1).min(nx - 1), j) - at(i.saturating_sub(1), j);
            let along_y = at(i, (j + 1).min(ny - 1)) - at(i, j.saturating_sub(1));
            along_x.cross(along_y).try_normalize().unwrap_or(DVec3::Z)
        })
        .collect()
}

/// The ambient openness of each point, from the height of its surroundings at some distances. Stored in x.
fn openness(points: Refinement, places_m: &[DVec3]) -> Vec<DVec3> {
    let [nx, ny] = points.vertices();
    let of = |index: usize| {
        let (i, j) = (index / ny, index % ny);
        let mut slopes = 0.0;
        for reach in [1, 2, 4] {
            let (mut rise_m, mut count) = (0.0, 0.0);
            for [di, dj] in [[-1, -1], [-1, 0], [-1, 1], [0, -1], [0, 1], [1, -1], [1, 0], [1, 1_isize]] {
                let (Some(i), Some(j)) = (i.checked_add_signed(reach * di), j.checked_add_signed(reach * dj)) else {
                    continue;
                };
                if i < nx && j < ny {
                    rise_m += places_m[i * ny + j].z - places_m[index].z;
                    count += 1.0;
                }
            }
            slopes += (rise_m / f64::max(count, 1.0)).max(0.0) / (reach as f64 * points.spacing_m());
        }
        DVec3::splat(1.0 / (1.0 + 0.5 * slopes))
    };
    (0..nx * ny).map(of).collect()
}

/// Interpolates `values`, one for each point, at vertex `[a, b]`; there are `part` vertices per spacing.
fn bilinear([nx, ny]: [usize; 2], values: &[DVec3], [a, b]: [usize; 2], part: usize) -> DVec3 {
    let (i, j) = (a / part, b / part);
    let (s, t) = ((a % part) as f64 / part as f64, (b % part) as f64 / part as f64);
    let at = |i: usize, j: usize| values[i.min(nx - 1) * ny + j.min(ny - 1)];
    at(i, j).lerp(at(i + 1, j), s).lerp(at(i, j + 1).lerp(at(i + 1, j + 1), s), t)
}
