//! How deep a force dents a mesh, and how thick the tissue is beneath: both at rest, for `palpate check`.

use glam::DVec3;

use crate::scene::profile::Poke;
use crate::scene::{Body, Mesh, Scene};
use crate::shape::{self, PointId, RestShape};

/// Steps of the conjugate gradients at most, and the part of the first residual at which they end.
const MOST_STEPS: usize = 200;
const RESIDUAL: f64 = 1e-8;

/// How far a force moves any point of a mesh in the end, m, if springs went on as they begin: a lower bound of the stiffness,
/// because springs that a dent stretches resist it more and more. `None` for a sheet, and where nothing pulls back.
pub(super) fn depth_m(scene: &Scene, poke: &Poke) -> Option<f64> {
    let Body::Mesh(mesh) = &scene.body else { return None };
    if scene.virtual_stiffness_n_per_m <= 0.0 {
        return None;
    }
    let shape = &mesh.shape;
    let pulls: Vec<f64> = shape::points(&**shape)
        .map(|point| scene.virtual_stiffness_n_per_m * scene.relative_virtual_stiffness(point))
        .collect();
    let springs: Vec<([usize; 2], f64, DVec3)> = mesh
        .springs()
        .map(|(ends, k)| {
            let ends = ends.map(|end| end as usize);
            let along = (shape.vertices_m()[ends[1]] - shape.vertices_m()[ends[0]]).normalize_or_zero();
            (ends, k * scene.springs.stiffness_n_per_m, along)
        })
        .collect();
    let mut diagonal: Vec<DVec3> = pulls.iter().map(|pull| DVec3::splat(*pull)).collect();
    for ([a, b], k, along) in &springs {
        diagonal[*a] += *k * *along * *along;
        diagonal[*b] += *k * *along * *along;
    }
    let free = |vertex: usize| !shape.is_fixed(PointId::new(vertex));
    let force_n = |vertex: usize| {
        let away_m = shape.vertices_m()[vertex].distance(poke.centre_m);
        poke.force_n * libm::exp(poke.falloff_offset - poke.falloff_per_m * away_m)
    };
    let zero = DVec3::ZERO;
    let mut residual: Vec<DVec3> =
        (0..pulls.len()).map(|vertex| if free(vertex) { force_n(vertex) } else { zero }).collect();
    let scaled = |residual: &[DVec3]| residual.iter().zip(&diagonal).map(|(r, d)| *r / *d).collect::<Vec<_>>();
    let dot = |a: &[DVec3], b: &[DVec3]| a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum::<f64>();
    let (mut moved_m, mut direction) = (vec![zero; pulls.len()], scaled(&residual));
    let mut left = dot(&residual, &direction);
    let enough = RESIDUAL * left;
    for _ in 0..MOST_STEPS {
        if left <= enough {
            break;
        }
        let mut product: Vec<DVec3> = direction.iter().zip(&pulls).map(|(d, pull)| *pull * *d).collect();
        for ([a, b], k, along) in &springs {
            let force = *k * along.dot(direction[*b] - direction[*a]) * *along;
            product[*a] -= force;
            product[*b] += force;
        }
        product.iter_mut().enumerate().filter(|(vertex, _)| !free(*vertex)).for_each(|(_, value)| *value = zero);
        let far = left / dot(&direction, &product);
        moved_m.iter_mut().zip(&direction).for_each(|(moved, direction)| *moved += far * *direction);
        residual.iter_mut().zip(&product).for_each(|(residual, product)| *residual -= far * *product);
        let next = scaled(&residual);
        let before = std::mem::replace(&mut left, dot(&residual, &next));
        direction.iter_mut().zip(next).for_each(|(direction, next)| *direction = next + left / before * *direction);
    }
    let most_m = moved_m.iter().map(|moved| moved.length()).fold(0.0, f64::max);
    most_m.is_finite().then_some(most_m)
}

/// How thick a mesh is under a point: as far as straight in, against its normal, until another part of it; `None` if there is
/// none.
pub(super) fn thickness_m(mesh: &Mesh, point: PointId) -> Option<f64> {
    let shape = &mesh.shape;
    let (from_m, inward) = (shape.rest_m(point), -shape.normal(point));
    let meets = |triangle: &[u32; 3]| {
        if triangle.iter().any(|vertex| *vertex as usize == point.index()) {
            return None;
        }
        let [a, b, c] = triangle.map(|vertex| shape.vertices_m()[vertex as usize]);
        let (ab, ac) = (b - a, c - a);
        let across = inward.cross(ac);
        let volume = ab.dot(across);
        let to = from_m - a;
        let (u, turned) = (to.dot(across) / volume, to.cross(ab));
        let (v, away_m) = (inward.dot(turned) / volume, ac.dot(turned) / volume);
        (u >= 0.0 && v >= 0.0 && u + v <= 1.0 && away_m > 0.0).then_some(away_m)
    };
    shape.triangles().iter().filter_map(meets).min_by(f64::total_cmp)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::limits::Limits;

    #[test]
    fn a_dent_is_as_deep_as_the_bed_lets_it_and_a_ball_as_thick_as_it_is_wide() {
        let text = "[mesh]\norgan = { name = \"gallbladder\", edge_m = 0.0035 }\n[material]\nyoungs_modulus_pa = 2e4\n\
                    thickness_m = 0.003\nbed_n_per_m3 = 5e5\n";
        let scene = Scene::parse("test", text, &[], &Limits::default()).unwrap();
        let Body::Mesh(mesh) = &scene.body else { panic!("of another kind") };
        // The middle of the bottom.
        let point = mesh.shape.nearest(DVec3::new(0.02, 0.0, -0.05));
        let thick_m = thickness_m(mesh, point).unwrap();
        assert!((0.02..0.05).contains(&thick_m), "{thick_m}");
        // All of it pushed alike moves as its bed says.
        let poke = |force_n: DVec3, falloff_per_m: f64| Poke {
            point: None,
            centre_m: mesh.shape.rest_m(point),
            force_n,
            falloff_per_m,
            falloff_offset: 0.0,
        };
        let depth_m = |poke: &Poke| depth_m(&scene, poke).unwrap();
        let inward = -mesh.shape.normal(point);
        let (near_m, twice_m) = (depth_m(&poke(0.01 * inward, 200.0)), depth_m(&poke(0.02 * inward, 200.0)));
        assert!((twice_m / near_m - 2.0).abs() < 1e-6 && near_m > 1e-4, "{near_m} {twice_m}");
        // Less than the bed alone would let the point go, which shares the force with its neighbours.
        let alone_m = 0.01 / scene.virtual_stiffness_n_per_m / scene.relative_virtual_stiffness(point);
        assert!(near_m < 1.5 * alone_m, "{near_m} {alone_m}");
    }
}
