//! The winding number of triangles around a place: how often they enclose it, also if some are turned, doubled or missing.
//!
//! A triangle adds the solid angle that it covers as seen from the place, divided by 4π (Jacobson, Kavan and
//! Sorkine-Hornung, ACM Transactions on Graphics 32(4), 2013). Far away a group of triangles acts like a single area in its
//! middle (Barill et al., ACM Transactions on Graphics 37(4), 2018).

use std::f64::consts::PI;

use glam::DVec3;

use crate::tree::corners;
use crate::work::spend;

/// Maximum number of triangles in a leaf.
const LEAF: usize = 8;

/// A group is far away beyond this many of its radii: its error is then a few percent of its part.
const FAR: f64 = 2.0;

/// A group of triangles.
#[derive(Debug, Clone, Copy)]
struct Group {
    /// Its triangles, as a range.
    start: usize,
    end: usize,
    /// Index of the second half; the first half comes directly after its parent. `None` in a leaf.
    second: Option<usize>,
    /// Middle of its area, m, and the distance of its farthest corner from there, m.
    middle_m: DVec3,
    radius_m: f64,
    /// Sum of areas times normals, m².
    area_m2: DVec3,
}

/// Triangles, ordered for the sum.
#[derive(Debug)]
pub(crate) struct Winding {
    groups: Vec<Group>,
    /// The corners of the triangles, m.
    triangles_m: Vec<[DVec3; 3]>,
}

/// Returns three times the middle of a triangle.
fn middle(corners: &[DVec3; 3]) -> DVec3 {
    corners[0] + corners[1] + corners[2]
}

impl Winding {
    /// Orders triangles. All coordinates must be finite, and all indices in range.
    pub(crate) fn new(vertices_m: &[DVec3], triangles: &[[u32; 3]]) -> Self {
        let triangles_m = triangles.iter().map(|triangle| corners(vertices_m, *triangle)).collect();
        let mut winding = Winding { groups: Vec::new(), triangles_m };
        if !triangles.is_empty() {
            winding.divide();
        }
        winding
    }

    fn divide(&mut self) {
        // Ranges that have no group yet, with the parent if the group will be its second half.
        let mut waiting = vec![(0, self.triangles_m.len(), None)];
        while let Some((start, end, parent)) = waiting.pop() {
            let number = self.groups.len();
            if let Some(parent) = parent {
                let parent: &mut Group = &mut self.groups[parent];
                parent.second = Some(number);
            }
            spend(end - start);
            let group = self.group(start, end);
            self.groups.push(group);
            if end - start <= LEAF {
                continue;
            }
            let range = &mut self.triangles_m[start..end];
            let least = range.iter().map(middle).fold(DVec3::INFINITY, DVec3::min);
            let size = range.iter().map(middle).fold(DVec3::NEG_INFINITY, DVec3::max) - least;
            let axis = (0..3).max_by(|a, b| size[*a].total_cmp(&size[*b])).unwrap_or(0);
            let half = (end - start) / 2;
            range.select_nth_unstable_by(half, |a, b| middle(a)[axis].total_cmp(&middle(b)[axis]));
            waiting.push((start + half, end, Some(number)));
            waiting.push((start, start + half, None));
        }
    }

    fn group(&self, start: usize, end: usize) -> Group {
        let range = &self.triangles_m[start..end];
        let (mut area_m2, mut weighted, mut weight) = (DVec3::ZERO, DVec3::ZERO, 0.0);
        for corners in range {
            let area = 0.5 * (corners[1] - corners[0]).cross(corners[2] - corners[0]);
            area_m2 += area;
            weighted += area.length() * middle(corners) / 3.0;
            weight += area.length();
        }
        let middle_m = if weight > 0.0 { weighted / weight } else { range[0][0] };
        let away = range.iter().flatten().map(|corner| corner.distance_squared(middle_m));
        Group { start, end, second: None, middle_m, radius_m: away.fold(0.0, f64::max).sqrt(), area_m2 }
    }

    /// Returns the winding number around a place that is on no triangle: 1 inside of a closed surface that faces outward, 0
    /// outside, and between them near holes.
    pub(crate) fn around(&self, place_m: DVec3) -> f64 {
        let mut angle = 0.0;
        let mut waiting = if self.groups.is_empty() { Vec::new() } else { vec![0] };
        while let Some(number) = waiting.pop() {
            let group = &self.groups[number];
            let away = group.middle_m - place_m;
            let distance = away.length();
            spend(1);
            if distance > FAR * group.radius_m {
                angle += away.dot(group.area_m2) / (distance * distance * distance);
            } else if let Some(second) = group.second {
                waiting.extend([second, number + 1]);
            } else {
                angle +=
                    self.triangles_m[group.start..group.end].iter().map(|of| solid_angle(of, place_m)).sum::<f64>();
            }
        }
        angle / (4.0 * PI)
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
}
