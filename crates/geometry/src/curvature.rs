//! The curvature of a triangulated surface.

use glam::{DMat3, DVec3};

use crate::tree::corners;

/// Returns the curvature at each vertex: how the outward normal changes per metre along the surface, 1/m, as xx, yy,
/// zz, xy, xz and yz of a symmetric matrix that is 1/R along a sphere. Within a triangle the change is that of the
/// normals of its corners, interpolated linearly; a vertex has the mean of its triangles, weighted by area. So the
/// mean over a part of the surface is, except at its edge, the change of normal across that part, for any
/// triangulation.
#[allow(clippy::cast_possible_truncation)]
pub(crate) fn curvatures(vertices_m: &[DVec3], triangles: &[[u32; 3]]) -> Vec<[f32; 6]> {
    let mut normals = vec![DVec3::ZERO; vertices_m.len()];
    let doubled = |triangle: &[u32; 3]| {
        let [a, b, c] = corners(vertices_m, *triangle);
        (b - a).cross(c - a)
    };
    for triangle in triangles {
        let normal_m2 = doubled(triangle);
        triangle.iter().for_each(|vertex| normals[*vertex as usize] += normal_m2);
    }
    normals.iter_mut().for_each(|normal| *normal = normal.normalize_or_zero());
    let mut sums = vec![(DMat3::ZERO, 0.0); vertices_m.len()];
    for triangle in triangles {
        let normal_m2 = doubled(triangle);
        let [a, b, c] = corners(vertices_m, *triangle);
        let of_corners = triangle.map(|vertex| normals[vertex as usize]);
        // The gradient of a corner's hat function is n × (opposite side)/(2·area), so this is area times gradient of
        // the normal.
        let across = normal_m2.normalize_or_zero();
        let mut change = DMat3::ZERO;
        for (normal, opposite_m) in of_corners.iter().zip([c - b, a - c, b - a]) {
            let gradient_m = 0.5 * across.cross(opposite_m);
            change += DMat3::from_cols(*normal * gradient_m.x, *normal * gradient_m.y, *normal * gradient_m.z);
        }
        let area_m2 = 0.5 * normal_m2.length();
        for vertex in triangle {
            let (sum, over_m2) = &mut sums[*vertex as usize];
            *sum += change;
            *over_m2 += area_m2;
        }
    }
    let of = |(sum, over_m2): (DMat3, f64)| {
        let mean = 0.5 * (sum + sum.transpose()) * (1.0 / over_m2.max(f64::MIN_POSITIVE));
        let [x, y, z] = [mean.x_axis, mean.y_axis, mean.z_axis];
        [x.x, y.y, z.z, x.y, x.z, y.z].map(|entry| entry as f32)
    };
    sums.into_iter().map(of).collect()
}
