//! How deep a force dents a mesh, and how thick the tissue is beneath: both at rest.

use glam::DVec3;

use super::Mesh;
use crate::scene::body::BodyKind;
use crate::scene::profile::Poke;
use crate::scene::springs::Springs;
use crate::shape::{self, PointId, RestShape};

/// Limit of the steps of the conjugate gradients, and the part of the first residual at which they end.
const MAX_STEPS: usize = 200;
const RESIDUAL: f64 = 1e-8;

/// Returns the largest displacement under a constant force, m, if springs kept their initial stiffness
/// ([`BodyKind::indentation_m`](crate::scene::BodyKind::indentation_m)). That is an upper bound, because a dent
/// stretches springs, which then resist more.
pub(super) fn depth_m(
    mesh: &Mesh,
    springs: &Springs,
    anchor_n_per_m: f64,
    volume_stiffness_pa: f64,
    poke: &Poke,
) -> Option<f64> {
    if mesh.restoring_n_per_m(springs, anchor_n_per_m) <= 0.0 {
        return None;
    }
    let shape = &mesh.shape;
    let pulls: Vec<f64> =
        shape::points(&**shape).map(|point| anchor_n_per_m * mesh.relative_anchor_stiffness(point)).collect();
    let joined: Vec<([usize; 2], f64, DVec3)> = mesh
        .springs()
        .map(|(ends, k)| {
            let ends = ends.map(|end| end as usize);
            let along = (shape.vertices_m()[ends[1]] - shape.vertices_m()[ends[0]]).normalize_or_zero();
            (ends, k * springs.stiffness_n_per_m, along)
        })
        .collect();
    let mut diagonal: Vec<DVec3> = pulls.iter().map(|pull| DVec3::splat(*pull)).collect();
    for ([a, b], k, along) in &joined {
        diagonal[*a] += *k * *along * *along;
        diagonal[*b] += *k * *along * *along;
    }
    // The pressure of a volume.
    let (areas_m2, pa_per_m3) = mesh
        .volume
        .as_ref()
        .map_or((&[][..], 0.0), |volume| (&volume.areas_m2[..], volume_stiffness_pa / volume.volume_m3));
    diagonal.iter_mut().zip(areas_m2).for_each(|(diagonal, area)| *diagonal += pa_per_m3 * *area * *area);
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
    for _ in 0..MAX_STEPS {
        if left <= enough {
            break;
        }
        let mut product: Vec<DVec3> = direction.iter().zip(&pulls).map(|(d, pull)| *pull * *d).collect();
        for ([a, b], k, along) in &joined {
            let force = *k * along.dot(direction[*b] - direction[*a]) * *along;
            product[*a] -= force;
            product[*b] += force;
        }
        let pushed_pa = pa_per_m3 * areas_m2.iter().zip(&direction).map(|(area, d)| area.dot(*d)).sum::<f64>();
        product.iter_mut().zip(areas_m2).for_each(|(product, area)| *product += pushed_pa * *area);
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

/// Returns the thickness of a mesh under a point, m: the distance straight inward, against its normal, to another
/// part of the mesh. `None` if there is none.
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
    use glam::DMat3;

    use super::*;
    use crate::limits::Limits;
    use crate::scene::Scene;

    fn gallbladder(foundation_n_per_m3: &str) -> Scene {
        let text = format!(
            "[mesh]\norgan = {{ name = \"gallbladder\", edge_m = 0.0035 }}\n[material]\nyoungs_modulus_pa = 2e4\n\
             thickness_m = 0.003\nfoundation_n_per_m3 = {foundation_n_per_m3}\n"
        );
        Scene::parse("test", &text, &[], &Limits::default()).unwrap()
    }

    fn indentation_m(scene: &Scene, poke: &Poke) -> f64 {
        let (anchor_n_per_m, volume_pa) = (scene.anchor_stiffness_n_per_m, scene.volume_stiffness_pa);
        scene.body.kind().indentation_m(&scene.springs, anchor_n_per_m, volume_pa, poke).unwrap()
    }

    #[test]
    fn a_dent_is_as_deep_as_the_bed_lets_it_and_a_ball_as_thick_as_it_is_wide() {
        let scene = gallbladder("5e5");
        let mesh = scene.mesh().unwrap();
        // The middle of the bottom.
        let point = mesh.shape.nearest(DVec3::new(0.02, 0.0, -0.05));
        let thick_m = thickness_m(mesh, point).unwrap();
        assert!((0.02..0.05).contains(&thick_m), "{thick_m}");
        // The depth is proportional to the force.
        let poke = |force_n: DVec3, falloff_per_m: f64| Poke {
            point: None,
            centre_m: mesh.shape.rest_m(point),
            force_n,
            falloff_per_m,
            falloff_offset: 0.0,
        };
        let depth_m = |poke: &Poke| indentation_m(&scene, poke);
        let inward = -mesh.shape.normal(point);
        let (near_m, twice_m) = (depth_m(&poke(0.01 * inward, 200.0)), depth_m(&poke(0.02 * inward, 200.0)));
        assert!((twice_m / near_m - 2.0).abs() < 1e-6 && near_m > 1e-4, "{near_m} {twice_m}");
        // Less than the foundation alone would give, because neighbours share the force.
        let alone_m = 0.01 / scene.anchor_stiffness_n_per_m / scene.relative_anchor_stiffness(point);
        assert!(near_m < 1.5 * alone_m, "{near_m} {alone_m}");
    }

    #[test]
    fn a_tissue_is_as_thick_as_it_is_far_to_where_straight_in_meets_its_other_side() {
        let scene = gallbladder("5e6");
        let mesh = scene.mesh().unwrap();
        let surface = mesh.shape.surface();
        let points: Vec<PointId> = shape::points(&*mesh.shape).step_by(7).collect();
        let mut found = 0;
        for point in &points {
            let Some(thick_m) = thickness_m(mesh, *point) else { continue };
            let at_m = mesh.shape.rest_m(*point) - thick_m * mesh.shape.normal(*point);
            let nearest_m = surface.at_m(&surface.nearest(at_m).unwrap());
            assert!(nearest_m.distance(at_m) < 1e-9, "{point:?}: {thick_m} m, {} m off", nearest_m.distance(at_m));
            found += 1;
        }
        // A ray may pass between two triangles that meet in an edge, by rounding.
        assert!(found * 10 >= points.len() * 9, "{found} of {}", points.len());
    }

    #[test]
    fn a_dent_is_that_in_which_springs_and_bed_balance_the_force_at_every_point() {
        let scene = gallbladder("5e6");
        let mesh = scene.mesh().unwrap();
        let shape = &mesh.shape;
        let point = shape.nearest(DVec3::new(0.02, 0.0, -0.05));
        let (centre_m, force_n) = (shape.rest_m(point), DVec3::new(0.02, 0.01, 0.03));
        let poke = Poke { point: None, centre_m, force_n, falloff_per_m: 100.0, falloff_offset: 0.2 };
        // Point by point: each is moved to where the forces on it balance, until none moves any more.
        let mut joined: Vec<Vec<(usize, DMat3)>> = vec![Vec::new(); shape.vertices_m().len()];
        for ([a, b], k) in mesh.springs() {
            let [a, b] = [a, b].map(|end| end as usize);
            let along = (shape.vertices_m()[b] - shape.vertices_m()[a]).normalize();
            let stiffness = k
                * scene.springs.stiffness_n_per_m
                * DMat3::from_cols_array_2d(&along.to_array().map(|part| (part * along).to_array()));
            joined[a].push((b, stiffness));
            joined[b].push((a, stiffness));
        }
        let mut moved_m = vec![DVec3::ZERO; joined.len()];
        for _ in 0..2000 {
            let mut change_m = 0.0_f64;
            for (vertex, joined) in joined.iter().enumerate() {
                if shape.is_fixed(PointId::new(vertex)) {
                    continue;
                }
                let pull = scene.anchor_stiffness_n_per_m * scene.relative_anchor_stiffness(PointId::new(vertex));
                let away_m = shape.vertices_m()[vertex].distance(centre_m);
                let (mut stiffness, mut sum_n) = (DMat3::IDENTITY * pull, force_n * (0.2 - 100.0 * away_m).exp());
                for (other, of_spring) in joined {
                    stiffness += *of_spring;
                    sum_n += *of_spring * moved_m[*other];
                }
                let to_m = stiffness.inverse() * sum_n;
                change_m = change_m.max(to_m.distance(moved_m[vertex]));
                moved_m[vertex] = to_m;
            }
            if change_m < 1e-12 {
                break;
            }
        }
        let deepest_m = moved_m.iter().map(|moved_m| moved_m.length()).fold(0.0, f64::max);
        let found_m = indentation_m(&scene, &poke);
        assert!((found_m / deepest_m - 1.0).abs() < 1e-4, "{found_m} m, not {deepest_m}");
    }
}
