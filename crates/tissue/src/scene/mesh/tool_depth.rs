//! How deep a tool's path goes into a mesh at rest.

use glam::DVec3;
use palpate_geometry::surface::Surface;

use crate::shape::Deepest;

/// Limit of the samples of a straight part of a path: each searches for the nearest place of the surface.
const MAX_SAMPLES: u32 = 256;

/// Returns the deepest place of a path along these points by a tip of `radius_m`, m, as a tool meets a mesh
/// (`tools/contact.rs`): relative to the side on which it begins, and only while the nearest place of the
/// surface is within its radius across the normal. `None` if it is beside the mesh all the time.
pub(super) fn deepest(surface: &Surface, way_m: &[DVec3], radius_m: f64) -> Option<Deepest> {
    let last = way_m.last().map(|end_m| [*end_m; 2]);
    let parts = way_m.windows(2).map(|pair| [pair[0], pair[1]]).chain(last);
    let (mut side, mut found) = (None, None::<Deepest>);
    for place_m in parts.flat_map(|part| samples(part, 0.25 * surface.edge_m().max(radius_m))) {
        let place = surface.nearest(place_m)?;
        let (rest_m, normal) = (surface.at_m(&place), place.frame[0].cross(place.frame[1]));
        let gap_m = place_m - rest_m;
        let height_m = gap_m.dot(normal);
        if (gap_m - height_m * normal).length() > radius_m {
            continue;
        }
        let side = *side.get_or_insert_with(|| surface.side(height_m, radius_m));
        let depth_m = -side * height_m;
        if found.is_none_or(|found| depth_m > found.depth_m) {
            found = Some(Deepest { depth_m, rest_m });
        }
    }
    found
}

/// Returns the beginning of a straight path, and places on it that are at most `apart_m` apart; at most 256 in all.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn samples([from_m, to_m]: [DVec3; 2], apart_m: f64) -> impl Iterator<Item = DVec3> {
    let count = ((from_m.distance(to_m) / apart_m).ceil() as u32).clamp(1, MAX_SAMPLES);
    (0..count).map(move |k| from_m.lerp(to_m, f64::from(k) / f64::from(count)))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::cast_possible_truncation)]
    use super::*;

    /// A ball about the origin: the faces of an octahedron, in `parts`² triangles each.
    fn ball(radius_m: f64, parts: u32) -> Surface {
        let (mut vertices_m, mut triangles) = (Vec::new(), Vec::new());
        for octant in 0..8_u32 {
            let sign = |axis: u32| if octant >> axis & 1 == 0 { 1.0 } else { -1.0 };
            let signs = DVec3::new(sign(0), sign(1), sign(2));
            let mut at = |i: u32, j: u32| {
                let corner = DVec3::new(f64::from(i), f64::from(j), f64::from(parts - i - j));
                vertices_m.push(radius_m * signs * corner.normalize());
                vertices_m.len() as u32 - 1
            };
            for (i, j) in (0..parts).flat_map(|i| (0..parts - i).map(move |j| (i, j))) {
                let [a, b, c] = [at(i, j), at(i + 1, j), at(i, j + 1)];
                triangles.push([a, b, c]);
                if i + j + 1 < parts {
                    let d = at(i + 1, j + 1);
                    triangles.push([b, d, c]);
                }
            }
        }
        for triangle in &mut triangles {
            let [a, b, c] = triangle.map(|vertex| vertices_m[vertex as usize]);
            if (b - a).cross(c - a).dot(a) < 0.0 {
                triangle.swap(1, 2);
            }
        }
        Surface::new(&vertices_m, &triangles)
    }

    /// A ball of 40 mm, on all sides and from within.
    #[test]
    fn a_way_goes_as_deep_as_it_is_beyond_the_nearest_place_of_the_surface() {
        let surface = ball(0.04, 16);
        for direction in [DVec3::Z, DVec3::X, DVec3::NEG_Y, DVec3::new(1.0, -1.0, 1.0).normalize()] {
            let way_m = |from_m: f64, to_m: f64| [from_m * direction, to_m * direction, from_m * direction];
            for (from_m, to_m, depth_m) in [(0.045, 0.037, 0.003), (0.05, 0.0425, -0.0025), (0.03, 0.042, 0.002)] {
                let found = deepest(&surface, &way_m(from_m, to_m), 0.005).unwrap();
                // The facets are within 0.1 mm of the ball.
                assert!((found.depth_m - depth_m).abs() < 2e-4, "{direction} {to_m}: {found:?}");
                assert!(found.rest_m.distance(0.04 * direction) < 1e-3, "{direction}: {found:?}");
            }
        }
        assert!(deepest(&surface, &[], 0.005).is_none());
    }
}
