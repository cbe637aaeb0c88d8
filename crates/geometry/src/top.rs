//! The top of a surface, where a device has its origin.

use glam::DVec3;

/// Returns the z of a triangle at the x and y of `place_m`, m. `None` if this point is outside the triangle.
fn height_m(place_m: DVec3, [a, b, c]: [DVec3; 3]) -> Option<f64> {
    let across = |a: DVec3, b: DVec3| (a - place_m).truncate().perp_dot((b - place_m).truncate());
    let parts = [across(b, c), across(c, a), across(a, b)];
    let whole: f64 = parts.iter().sum();
    let is_inside = parts.iter().all(|part| part * whole >= 0.0) && whole != 0.0;
    is_inside.then(|| (parts[0] * a.z + parts[1] * b.z + parts[2] * c.z) / whole)
}

/// Returns the highest place of a surface at the x and y of `middle_m`, m, with z up. Where the surface is nowhere in
/// line with that, returns the highest place at the x and y of the nearest vertex (by x and y) whose normal has a z of
/// at least 0.5, or of the nearest vertex if there is none; `middle_m` itself if there is no triangle.
///
/// `normals` has the outward unit normal of each vertex. Indices must be in range, or it panics. Within a triangle z
/// is linear in x and y.
pub fn top_m(vertices_m: &[DVec3], triangles: &[[u32; 3]], normals: &[DVec3], middle_m: DVec3) -> DVec3 {
    let above = |place_m: DVec3| {
        let corners = triangles.iter().map(|triangle| triangle.map(|vertex| vertices_m[vertex as usize]));
        let highest_m = corners.filter_map(|corners_m| height_m(place_m, corners_m)).reduce(f64::max);
        highest_m.map(|z| place_m.with_z(z))
    };
    let beside = || {
        let used = triangles.iter().flatten().map(|vertex| *vertex as usize);
        let off_m = |vertex: usize| (vertices_m[vertex] - middle_m).truncate().length();
        // Steeper vertices are used only if there is no other: a tip would slip off them.
        let nearer = |a: &usize, b: &usize| {
            let is_steep = |vertex: usize| normals[vertex].z < 0.5;
            is_steep(*a).cmp(&is_steep(*b)).then(off_m(*a).total_cmp(&off_m(*b)))
        };
        used.min_by(nearer).map(|vertex| above(vertices_m[vertex]).unwrap_or(vertices_m[vertex]))
    };
    above(middle_m).or_else(beside).unwrap_or(middle_m)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn top_of(vertices_m: &[[f64; 3]], triangles: &[[u32; 3]], middle_m: [f64; 3]) -> DVec3 {
        let vertices_m: Vec<DVec3> = vertices_m.iter().map(|place_m| DVec3::from_array(*place_m)).collect();
        let mut normals = vec![DVec3::ZERO; vertices_m.len()];
        for triangle in triangles {
            let [a, b, c] = triangle.map(|vertex| vertices_m[vertex as usize]);
            triangle.iter().for_each(|vertex| normals[*vertex as usize] += (b - a).cross(c - a));
        }
        let normals: Vec<DVec3> = normals.into_iter().map(DVec3::normalize_or_zero).collect();
        top_m(&vertices_m, triangles, &normals, DVec3::from_array(middle_m))
    }

    #[test]
    fn the_top_is_the_highest_place_in_line_with_the_middle() {
        // A leaning pyramid: its tip is not above its middle, where the slope is half as high.
        let pyramid = [[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [4.0, 4.0, 0.0], [0.0, 4.0, 0.0], [1.0, 2.0, 3.0]];
        let sides = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [0, 2, 1], [0, 3, 2]];
        assert_eq!(top_of(&pyramid, &sides, [2.0, 2.0, 1.5]), DVec3::new(2.0, 2.0, 2.0));
        // Also at a vertex and at an edge.
        assert_eq!(top_of(&pyramid, &sides, [1.0, 2.0, 0.0]), DVec3::new(1.0, 2.0, 3.0));
        assert_eq!(top_of(&pyramid, &sides, [4.0, 2.0, 9.0]), DVec3::new(4.0, 2.0, 0.0));
    }

    #[test]
    fn where_nothing_is_in_line_with_the_middle_it_is_beside_that() {
        // Two squares with a gap between them. A wall in the gap is nearer to the middle, but too steep.
        let square = |x: f64, z: f64| [[x, 0.0, z], [x + 1.0, 0.0, z], [x + 1.0, 1.0, z], [x, 1.0, z]];
        let wall = [[1.6, 0.4, 0.0], [1.6, 0.6, 0.0], [1.6, 0.5, 5.0]];
        let vertices_m = [square(0.0, 0.5).as_slice(), &square(2.1, 0.25), &wall].concat();
        let triangles = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7], [8, 9, 10]];
        let top_m = top_of(&vertices_m, &triangles, [1.55, 0.4, 0.3]);
        assert!(top_m == DVec3::new(1.0, 0.0, 0.5) || top_m == DVec3::new(2.1, 0.0, 0.25), "{top_m}");
        assert_eq!(top_of(&[], &[], [1.0, 2.0, 3.0]), DVec3::new(1.0, 2.0, 3.0));
    }
}
