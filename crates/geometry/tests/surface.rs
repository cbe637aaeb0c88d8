//! Paths and discs on a surface.
#![allow(
    clippy::unwrap_used,
    clippy::cast_possible_truncation,
    clippy::disallowed_methods,
    clippy::cast_precision_loss
)]

mod common;

use glam::{DVec2, DVec3};
use palpate_geometry::surface::{Place, Surface, SurfaceDisc};

/// A flat mesh of nearly equilateral triangles with edges of about 1, its vertices moved by up to `jitter`.
fn flat(side: u32, jitter: f64, seed: u64) -> Surface {
    let mut dice = fastrand::Rng::with_seed(seed);
    let mut vertices = Vec::new();
    for i in 0..=side {
        for j in 0..=side {
            let on_rim = i == 0 || j == 0 || i == side || j == side;
            let mut moved = || if on_rim { 0.0 } else { jitter * (2.0 * dice.f64() - 1.0) };
            let (x, y) = (f64::from(i) * 0.75_f64.sqrt() + moved(), f64::from(j) + 0.5 * f64::from(i % 2) + moved());
            vertices.push(DVec3::new(x, y, 0.0));
        }
    }
    let mut triangles = Vec::new();
    for i in 0..side {
        for j in 0..side {
            let [a, b, c, d] =
                [i * (side + 1) + j, (i + 1) * (side + 1) + j, i * (side + 1) + j + 1, (i + 1) * (side + 1) + j + 1];
            triangles.extend(if i % 2 == 0 { [[a, b, c], [b, d, c]] } else { [[a, b, d], [a, d, c]] });
        }
    }
    Surface::new(&vertices, &triangles)
}

/// A sphere of radius 1: an octahedron, subdivided `times` times.
fn sphere(times: usize) -> Surface {
    let mesh = common::sphere(times);
    let vertices: Vec<DVec3> = mesh.vertices_m.iter().map(|place| place.normalize()).collect();
    Surface::new(&vertices, &mesh.triangles)
}

fn place(surface: &Surface, x: f64, y: f64) -> Place {
    surface.nearest(DVec3::new(x, y, 0.0)).unwrap()
}

fn rest(surface: &Surface, vertex: u32) -> DVec3 {
    // The vertex is the point at which its hat is 1.
    surface.vertices_m()[vertex as usize]
}

#[test]
fn a_way_on_a_plane_is_straight_and_keeps_its_frame() {
    let surface = flat(20, 0.25, 1);
    let mut dice = fastrand::Rng::with_seed(2);
    for _ in 0..200 {
        let from = place(&surface, 8.0 + dice.f64(), 9.0 + dice.f64());
        let by = 6.0 * DVec2::new(dice.f64() - 0.5, dice.f64() - 0.5);
        let to = surface.walk(&from, by);
        let expected = surface.at_m(&from) + by.x * from.frame[0] + by.y * from.frame[1];
        assert!(surface.at_m(&to).distance(expected) < 1e-5, "{} {expected}", surface.at_m(&to));
        assert!(to.frame[0].distance(from.frame[0]) < 1e-9 && to.frame[1].distance(from.frame[1]) < 1e-9);
        // And back.
        assert!(surface.at_m(&surface.walk(&to, -by)).distance(surface.at_m(&from)) < 1e-5);
    }
}

#[test]
fn a_way_over_a_sphere_is_a_great_circle_and_ends_where_it_began() {
    let surface = sphere(5);
    let from = surface.nearest(DVec3::new(0.3, 0.4, 0.7)).unwrap();
    let mut at = from;
    let steps = 1000;
    let [along, normal] = [from.frame[0], from.frame[0].cross(from.frame[1])];
    for step in 1..=steps {
        at = surface.walk(&at, DVec2::X * (std::f64::consts::TAU / f64::from(steps)));
        let angle = std::f64::consts::TAU * f64::from(step) / f64::from(steps);
        let expected = normal * angle.cos() + along * angle.sin();
        assert!(surface.at_m(&at).normalize().distance(expected.normalize()) < 0.06, "{step}");
        assert!(at.frame[0].dot(at.frame[1]).abs() < 1e-12);
        let outward = at.frame[0].cross(at.frame[1]);
        assert!(outward.dot(surface.at_m(&at).normalize()) > 0.99);
    }
}

#[test]
fn a_way_over_the_rim_goes_on_along_it() {
    let surface = flat(10, 0.0, 1);
    let from = place(&surface, 3.0, 5.2);
    let by = DVec3::new(-5.0, 1.0, 0.0);
    let to = surface.walk(&from, DVec2::new(by.dot(from.frame[0]), by.dot(from.frame[1])));
    let at = surface.at_m(&to);
    assert!(at.x.abs() < 1e-5, "{at}");
    assert!((at.y - 6.2).abs() < 1e-4, "{at}");
}

#[test]
fn weights_add_up_to_1_about_the_place_with_the_area_of_the_disc() {
    let mut dice = fastrand::Rng::with_seed(3);
    for jitter in [0.0, 0.3] {
        let surface = flat(24, jitter, 4);
        for radius in [1.0, 1.5, 2.0, 4.0] {
            let mut disc = SurfaceDisc::new(radius, 1.0);
            for _ in 0..20 {
                let at = place(&surface, 9.0 + 3.0 * dice.f64(), 11.0 + 3.0 * dice.f64());
                disc.lay(&surface, &at);
                let whole: f64 = disc.covered().iter().map(|covered| covered.weight).sum();
                let middle: DVec3 = disc.covered().iter().map(|c| c.weight * rest(&surface, c.vertex)).sum();
                assert!((whole - 1.0).abs() < 1e-12, "{whole}");
                assert!(middle.distance(surface.at_m(&at)) < 2e-3 * radius, "{middle} {}", surface.at_m(&at));
                let shared: f64 =
                    disc.covered().iter().map(|c| c.weight.powi(2) / surface.areas_m2()[c.vertex as usize]).sum();
                let area = std::f64::consts::PI * radius * radius;
                assert!((shared * area - 1.0).abs() < 1e-9, "{radius}: {}", shared * area);
            }
        }
    }
}

#[test]
fn the_gradient_is_the_change_of_the_weights() {
    let mut dice = fastrand::Rng::with_seed(5);
    let surface = flat(24, 0.3, 6);
    for radius in [1.2, 2.0, 4.0] {
        let mut disc = SurfaceDisc::new(radius, 1.0);
        let mut largest: f64 = 0.0;
        for _ in 0..50 {
            let at = place(&surface, 9.0 + 3.0 * dice.f64(), 11.0 + 3.0 * dice.f64());
            let heights: Vec<f64> = (0..surface.vertices_m().len()).map(|_| dice.f64()).collect();
            let mut height = |place: &Place| {
                disc.lay(&surface, place);
                let sum = |of: &dyn Fn(&palpate_geometry::surface::Covered) -> f64| -> f64 {
                    disc.covered().iter().map(|c| of(c) * heights[c.vertex as usize]).sum()
                };
                (sum(&|c| c.weight), DVec2::new(sum(&|c| c.gradient.x), sum(&|c| c.gradient.y)))
            };
            let (_, gradient) = height(&at);
            let step = 1e-4;
            for axis in [DVec2::X, DVec2::Y] {
                let [ahead, behind] = [step, -step].map(|by| height(&surface.walk(&at, by * axis)).0);
                let slope = (ahead - behind) / (2.0 * step);
                largest = largest.max((slope - gradient.dot(axis)).abs());
            }
        }
        println!("{radius}: {largest}");
        assert!(largest < 0.03 / radius, "{radius}: {largest}");
    }
}

#[test]
fn weights_change_without_jumps_along_a_way() {
    // Relative to the disc's radius: on a curved surface, a path may change the side on which it passes a vertex.
    for (surface, most) in [(flat(40, 0.3, 7), 1e-4), (sphere(4), 2e-3)] {
        let edge = (surface.areas_m2().iter().sum::<f64>() / surface.areas_m2().len() as f64).sqrt();
        let mut disc = SurfaceDisc::new(2.0 * edge, edge);
        let mut at = surface.nearest(DVec3::new(10.0, 12.0, 0.0)).unwrap();
        let mut before: Option<DVec3> = None;
        let step = 0.005 * edge;
        for _ in 0..1000 {
            disc.lay(&surface, &at);
            let middle: DVec3 = disc.covered().iter().map(|c| c.weight * rest(&surface, c.vertex)).sum();
            if let Some(before) = before {
                let jump = (middle.distance(before) - step).abs() / disc.radius_m();
                assert!(jump < most, "{jump}");
            }
            before = Some(middle);
            at = surface.walk(&at, step * DVec2::new(0.8, 0.6));
        }
    }
}

#[test]
fn half_a_disc_over_the_rim_has_the_weights_of_what_is_on_the_surface() {
    let surface = flat(16, 0.2, 9);
    let mut disc = SurfaceDisc::new(2.0, 1.0);
    for x in [0.0, 0.4, 1.1] {
        disc.lay(&surface, &place(&surface, x, 8.0));
        let whole: f64 = disc.covered().iter().map(|covered| covered.weight).sum();
        assert!((whole - 1.0).abs() < 1e-12);
        assert!(disc.covered().iter().all(|covered| covered.weight >= 0.0 && covered.gradient.is_finite()));
    }
}

#[test]
fn the_mean_curvature_under_a_disc_on_a_sphere_is_that_of_its_radius() {
    let surface = sphere(5);
    let mut dice = fastrand::Rng::with_seed(3);
    let mut disc = SurfaceDisc::new(0.25, surface.edge_m());
    for _ in 0..50 {
        let [x, y, z] = [(); 3].map(|()| dice.f64() - 0.5);
        let place = surface.nearest(DVec3::new(x, y, z).normalize()).unwrap();
        disc.lay(&surface, &place);
        let normal = surface.at_m(&place).normalize();
        let along = normal.any_orthonormal_vector();
        for way in [along, normal.cross(along)] {
            let turns = disc.covered().iter().map(|on| on.weight * (surface.curvature_per_m(on.vertex as usize) * way));
            let turn: DVec3 = turns.sum();
            assert!((turn - turn.dot(normal) * normal - way).length() < 0.05, "{normal}: {turn} for {way}");
        }
    }
}
