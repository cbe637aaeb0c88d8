//! The winding number of triangles around a place: how often they enclose it, also if some are turned, doubled or missing.
//!
//! A triangle adds the solid angle that it covers as seen from the place, divided by 4π (Jacobson, Kavan and
//! Sorkine-Hornung, ACM Transactions on Graphics 32(4), 2013). Far away a group of triangles acts like a single area in its
//! middle (Barill et al., ACM Transactions on Graphics 37(4), 2018).

use std::f64::consts::PI;

use glam::DVec3;

use crate::tree::{Tree, corners};
use crate::work::spend;

/// The triangles of a node are far away beyond this many of their radii: the error is then a few percent of their part.
const FAR: f64 = 2.0;

/// The triangles of a node, as seen from far away.
#[derive(Debug, Clone, Copy)]
struct FarArea {
    /// Middle of the area, m, and the distance of the farthest corner from there, m.
    middle_m: DVec3,
    radius_m: f64,
    /// Sum of areas times normals, m².
    area_m2: DVec3,
}

/// Triangles, ordered for the sum. Those of different sizes are apart: a long triangle among short ones would make their node
/// large, and so near for places that are far from the short ones.
#[derive(Debug)]
pub(crate) struct Winding {
    sizes: Vec<SizeClass>,
}

/// Triangles of about the same size.
#[derive(Debug)]
struct SizeClass {
    tree: Tree,
    /// Of each node.
    areas: Vec<FarArea>,
    /// The corners of the triangles in the tree's order, m.
    triangles_m: Vec<[DVec3; 3]>,
}

impl FarArea {
    fn of(triangles_m: &[[DVec3; 3]]) -> Self {
        spend(triangles_m.len());
        let (mut area_m2, mut weighted, mut weight) = (DVec3::ZERO, DVec3::ZERO, 0.0);
        for [a, b, c] in triangles_m {
            let area = 0.5 * (b - a).cross(c - a);
            area_m2 += area;
            weighted += area.length() * (a + b + c) / 3.0;
            weight += area.length();
        }
        let middle_m = if weight > 0.0 { weighted / weight } else { triangles_m[0][0] };
        let away = triangles_m.iter().flatten().map(|corner| corner.distance_squared(middle_m));
        FarArea { middle_m, radius_m: away.fold(0.0, f64::max).sqrt(), area_m2 }
    }
}

impl SizeClass {
    fn new(vertices_m: &[DVec3], triangles: &[[u32; 3]], of: impl Iterator<Item = u32>) -> Self {
        let tree = Tree::new(vertices_m, triangles, of);
        let of = |triangle: &u32| corners(vertices_m, triangles[*triangle as usize]);
        let triangles_m: Vec<[DVec3; 3]> = tree.order().iter().map(of).collect();
        let areas = (0..tree.len()).map(|node| FarArea::of(&triangles_m[tree.range(node)])).collect();
        SizeClass { tree, areas, triangles_m }
    }

    /// Adds up the solid angles of the triangles, as seen from a place. `waiting` is empty before and after.
    fn angle(&self, place_m: DVec3, waiting: &mut Vec<usize>) -> f64 {
        let mut angle = 0.0;
        waiting.push(0);
        while let Some(node) = waiting.pop() {
            let area = &self.areas[node];
            let away = area.middle_m - place_m;
            let distance = away.length();
            spend(1);
            if distance > FAR * area.radius_m {
                angle += away.dot(area.area_m2) / (distance * distance * distance);
            } else if let Some(halves) = self.tree.halves(node) {
                waiting.extend(halves);
            } else {
                angle += self.triangles_m[self.tree.range(node)].iter().map(|of| solid_angle(of, place_m)).sum::<f64>();
            }
        }
        angle
    }
}

/// Returns the class of a triangle's size: the next begins at four times the length.
fn size_class([a, b, c]: [DVec3; 3]) -> i32 {
    let longest = a.distance_squared(b).max(b.distance_squared(c)).max(c.distance_squared(a));
    libm::ilogb(longest).div_euclid(4)
}

impl Winding {
    /// Orders triangles. All coordinates must be finite, and all indices in range.
    pub(crate) fn new(vertices_m: &[DVec3], triangles: &[[u32; 3]]) -> Self {
        let class = |triangle: u32| size_class(corners(vertices_m, triangles[triangle as usize]));
        let mut order: Vec<(i32, u32)> =
            (0..).take(triangles.len()).map(|triangle| (class(triangle), triangle)).collect();
        order.sort_unstable();
        let of_class =
            |all: &[(i32, u32)]| SizeClass::new(vertices_m, triangles, all.iter().map(|(_, triangle)| *triangle));
        Winding { sizes: order.chunk_by(|a, b| a.0 == b.0).map(of_class).collect() }
    }

    /// Returns the winding number around a place that is on no triangle: 1 inside of a closed surface that faces outward, 0
    /// outside, and between them near holes.
    pub(crate) fn around(&self, place_m: DVec3) -> f64 {
        let mut waiting = Vec::new();
        self.sizes.iter().map(|size| size.angle(place_m, &mut waiting)).sum::<f64>() / (4.0 * PI)
    }
}

/// Returns the solid angle that a triangle covers, positive if it is anticlockwise seen from the other side (van Oosterom
/// and Strackee, IEEE Transactions on Biomedical Engineering 30(2), 1983).
fn solid_angle(corners: &[DVec3; 3], place_m: DVec3) -> f64 {
    let (a, b, c) = (corners[0] - place_m, corners[1] - place_m, corners[2] - place_m);
    let (to_a, to_b, to_c) = (a.length(), b.length(), c.length());
    let spanned = a.dot(b.cross(c));
    let beside = to_a * to_b * to_c + a.dot(b) * to_c + b.dot(c) * to_a + c.dot(a) * to_b;
    2.0 * libm::atan2(spanned, beside)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::organ::{Organ, generate};
    use crate::work::within;
    use std::sync::Arc;

    /// Most nodes that a place may look at on the average.
    const MOST: u64 = 600;

    #[test]
    fn a_place_inside_has_1_and_one_outside_0() {
        let mesh = generate(Organ::Kidney, 4e-3, 1).unwrap();
        let winding = Winding::new(&mesh.vertices_m, &mesh.triangles);
        for (place_m, expected) in [(DVec3::ZERO, 1.0), (DVec3::new(0.02, 0.0, 0.01), 1.0), (DVec3::splat(0.06), 0.0)] {
            let found = winding.around(place_m);
            assert!((found - expected).abs() < 0.05, "{place_m}: {found}");
        }
    }

    #[test]
    fn turned_triangles_take_their_part_twice() {
        let mut mesh = generate(Organ::Kidney, 4e-3, 1).unwrap();
        mesh.triangles.iter_mut().step_by(20).for_each(|triangle| triangle.swap(0, 1));
        let found = Winding::new(&mesh.vertices_m, &mesh.triangles).around(DVec3::ZERO);
        assert!((found - 0.9).abs() < 0.05, "{found}");
    }

    #[test]
    fn a_few_long_triangles_make_no_place_look_at_all_short_ones() {
        let mut mesh = generate(Organ::Kidney, 2e-3, 1).unwrap();
        let count = u32::try_from(mesh.vertices_m.len()).unwrap();
        for first in (0..count / 3).step_by(40) {
            let corners = [first, first + count / 3, first + 2 * (count / 3)];
            mesh.triangles.extend([corners, [corners[1], corners[0], corners[2]]]);
        }
        let winding = Winding::new(&mesh.vertices_m, &mesh.triangles);
        let places = (0..100).map(|n| DVec3::new(0.02, 0.0, 2e-4 * f64::from(n)));
        let found = within(&Arc::default(), 100 * MOST, || places.map(|place_m| winding.around(place_m)).sum::<f64>());
        assert!(found.is_ok_and(f64::is_finite), "{found:?}");
    }
}
