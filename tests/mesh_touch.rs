//! Tools with a tip on meshes: the same force wherever the disc lies between the vertices, on whichever side it is.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use std::sync::Arc;

use glam::DVec3;
use palpate_haptics::{ContactState, Tip};
use palpate_tissue::limits::Limits;
use palpate_tissue::response::tangent;
use palpate_tissue::scene::{Body, Mesh, MeshShape, Scene};
use palpate_tissue::{Model, Tissue, ToolContact, at_rest};

/// Membrane and foundation of a liver: N/m along an edge, N/m³ beneath, kg/m², and the damping ratio of a point on the foundation.
const EDGE_N_PER_M: f64 = 80.0;
const BED_N_PER_M3: f64 = 4e5;
const KG_PER_M2: f64 = 2.0;

/// A scene on a mesh whose vertices have `area_m2` each in the mean.
fn scene(shape: MeshShape, area_m2: f64, sets: &[&str]) -> Scene {
    let mass_kg = KG_PER_M2 * area_m2;
    let anchor_n_per_m = BED_N_PER_M3 * area_m2;
    let damping = 2.0 * 0.7 * (mass_kg * anchor_n_per_m).sqrt();
    let mut all = vec![
        format!("springs.stiffness_n_per_m={EDGE_N_PER_M}"),
        format!("anchor_springs.stiffness_n_per_m={anchor_n_per_m:.17}"),
        format!("damping.coefficient_n_s_per_m={damping:.17}"),
        "stepping.tolerance=1e-4".to_owned(),
    ];
    all.extend(sets.iter().map(|set| (*set).to_owned()));
    let mut scene = Scene::parse("paper", palpate_tissue::scene::PAPER, &all, &Limits::default()).unwrap();
    scene.body = Body::Mesh(Mesh::new(mass_kg, 0.0, Arc::new(shape)));
    scene
}

fn model(scene: &Scene) -> Arc<Model> {
    Model::compile(scene, &Limits::default()).unwrap()
}

/// A flat mesh of edges of about `edge_m`, `size_m` long and wide, whose vertices are moved by up to `jitter` edges. Its
/// triangles are those of Delaunay.
fn flat(edge_m: f64, size_m: f64, jitter: f64, seed: u64) -> (MeshShape, f64) {
    let mut dice = fastrand::Rng::with_seed(seed);
    let (rows, columns) = ((size_m / (0.75_f64.sqrt() * edge_m)) as u32, (size_m / edge_m) as u32);
    let mut vertices_m = Vec::new();
    for i in 0..=rows {
        for j in 0..=columns {
            let is_rim = i == 0 || j == 0 || i == rows || j == columns;
            let mut moved = || if is_rim { 0.0 } else { jitter * (2.0 * dice.f64() - 1.0) };
            let x = f64::from(i) * 0.75_f64.sqrt() + moved();
            let y = f64::from(j) + 0.5 * f64::from(i % 2) + moved();
            vertices_m.push(edge_m * DVec3::new(x, y, 0.0));
        }
    }
    let at = |i: u32, j: u32| i * (columns + 1) + j;
    let mut triangles = Vec::new();
    for i in 0..rows {
        for j in 0..columns {
            let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i, j + 1), at(i + 1, j + 1)];
            triangles.extend(if i % 2 == 0 { [[a, b, c], [b, d, c]] } else { [[a, b, d], [a, d, c]] });
        }
    }
    let mut mesh = palpate_geometry::TriangleMesh { vertices_m, triangles, ..Default::default() };
    palpate_geometry::delaunay::flip_to_delaunay(&mut mesh);
    let area_m2 = edge_m * edge_m * 0.75_f64.sqrt();
    (MeshShape::new(mesh.vertices_m, mesh.triangles, |rim, _, _| rim).unwrap(), area_m2)
}

/// A sphere of `times` halved edges of an icosahedron.
fn sphere(times: u32, radius_m: f64) -> (MeshShape, f64) {
    let golden = 0.5 + 1.25_f64.sqrt();
    let corners = [[-1.0, golden], [1.0, golden], [-1.0, -golden], [1.0, -golden]];
    let mut vertices_m: Vec<DVec3> = Vec::new();
    vertices_m.extend(corners.map(|[a, b]| DVec3::new(a, b, 0.0)));
    vertices_m.extend(corners.map(|[a, b]| DVec3::new(0.0, a, b)));
    vertices_m.extend(corners.map(|[a, b]| DVec3::new(b, 0.0, a)));
    // The faces: three corners next to each other, seen from outside.
    let mut triangles: Vec<[u32; 3]> = Vec::new();
    for a in 0..12_u32 {
        for b in a + 1..12 {
            for c in b + 1..12 {
                let [x, y, z] = [a, b, c].map(|corner| vertices_m[corner as usize]);
                if [(x, y), (y, z), (z, x)].iter().all(|(one, other)| (one.distance(*other) - 2.0).abs() < 1e-9) {
                    let is_outward = (y - x).cross(z - x).dot(x) > 0.0;
                    triangles.push(if is_outward { [a, b, c] } else { [a, c, b] });
                }
            }
        }
    }
    assert_eq!(triangles.len(), 20);
    for _ in 0..times {
        let mut middles = std::collections::BTreeMap::new();
        let mut middle = |a: u32, b: u32, vertices_m: &mut Vec<DVec3>| {
            *middles.entry([a.min(b), a.max(b)]).or_insert_with(|| {
                vertices_m.push(0.5 * (vertices_m[a as usize] + vertices_m[b as usize]));
                vertices_m.len() as u32 - 1
            })
        };
        let halved = |[a, b, c]: [u32; 3], vertices_m: &mut Vec<DVec3>| {
            let [ab, bc, ca] = [[a, b], [b, c], [c, a]].map(|[a, b]| middle(a, b, vertices_m));
            [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
        };
        let mut fine = Vec::new();
        let mut halve = halved;
        triangles.iter().for_each(|triangle| fine.extend(halve(*triangle, &mut vertices_m)));
        triangles = fine;
    }
    vertices_m.iter_mut().for_each(|place_m| *place_m = radius_m * place_m.normalize());
    let area_m2 = 4.0 * std::f64::consts::PI * radius_m * radius_m / vertices_m.len() as f64;
    (MeshShape::new(vertices_m, triangles, |_, _, _| false).unwrap(), area_m2)
}

const TIP: Tip = Tip {
    shape: palpate_haptics::TipShape::Disc,
    radius_m: 0.005,
    friction: 0.0,
    grasps: false,
    coupling: palpate_haptics::Coupling::Constraint,
    edge_m: DVec3::ZERO,
    burn_s: 0.0,
};

/// Moves a tool straight from one place to another in so many steps, and leaves it there for `rest` more.
fn lead(tissue: &mut dyn Tissue, from_m: DVec3, to_m: DVec3, steps: u32, rest: u32, tip: Tip) -> ToolContact {
    for step in 1..=steps + rest {
        tissue.pose(0, from_m.lerp(to_m, f64::from(step.min(steps)) / f64::from(steps)), tip);
        tissue.step().unwrap();
    }
    tissue.tool_contact(0).unwrap()
}

/// Mean, and standard deviation over the mean.
fn spread(values: &[f64]) -> (f64, f64) {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let squares = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / values.len() as f64;
    (mean, squares.sqrt() / mean)
}

#[test]
fn a_disc_feels_the_same_wherever_it_is_between_the_vertices_and_on_whichever_mesh() {
    let mut dice = fastrand::Rng::with_seed(1);
    let mut means = Vec::new();
    for edge_m in [0.0025, 0.00125] {
        let (shape, area_m2) = flat(edge_m, 0.06, 0.0, 3);
        let model = model(&scene(shape, area_m2, &[]));
        let places = 8;
        let forces: Vec<Vec<f64>> = (0..places)
            .map(|_| {
                let centre_m = DVec3::new(0.025 + 0.01 * dice.f64(), 0.025 + 0.01 * dice.f64(), 0.0);
                let pressed = tangent::press(&model, TIP.radius_m, centre_m, 0.0005, 5);
                vec![pressed[1].force_n, pressed[4].force_n]
            })
            .collect();
        for depth in 0..2 {
            let (mean_n, spread) = spread(&forces.iter().map(|of_place| of_place[depth]).collect::<Vec<_>>());
            println!("edges of {edge_m} m, depth {depth}: {mean_n:.5} N ± {:.3} %", 100.0 * spread);
            assert!(spread < 0.01, "{edge_m} {depth}: {spread}");
            means.push(mean_n);
        }
    }
    for depth in 0..2 {
        let [coarse, fine] = [means[depth], means[2 + depth]];
        assert!((coarse / fine - 1.0).abs() < 0.05, "{coarse} {fine}");
    }
}

#[test]
fn a_tool_feels_the_balance_of_the_tissue_under_it() {
    let (shape, area_m2) = sphere(3, 0.03);
    let model = model(&scene(shape, area_m2, &[]));
    let mut tissue = at_rest(&model);
    let outward = DVec3::new(0.3, -0.5, 0.8).normalize();
    let before = lead(&mut *tissue, 0.04 * outward, 0.031 * outward, 20, 5, TIP);
    assert_eq!((before.contact_state, before.force_on_tool_n), (ContactState::Free, DVec3::ZERO));
    assert!(before.normal.dot(outward) > 0.999, "{}", before.normal);
    // The disc's own place is the mean of its points: a little below the top of the curve.
    let height_m = before.surface_m.length();
    let depth_m = 0.002;
    let to_m = (height_m - depth_m) * outward;
    let felt = lead(&mut *tissue, 0.031 * outward, to_m, 50, 400, TIP);
    let expected = tangent::press(&model, TIP.radius_m, 0.03 * outward, depth_m, 2)[1].force_n;
    let felt_n = felt.force_on_tool_n;
    println!("{felt_n} N, by balance {expected} N");
    assert!((felt_n.length() / expected - 1.0).abs() < 0.01, "{} {expected}", felt_n.length());
    assert!(felt_n.normalize().dot(outward) > 2.0_f64.to_radians().cos(), "{}", felt_n.normalize().dot(outward));
    let after = lead(&mut *tissue, to_m, 0.04 * outward, 50, 400, TIP);
    assert_eq!((after.contact_state, after.force_on_tool_n), (ContactState::Free, DVec3::ZERO));
}

#[test]
fn a_tool_inside_a_closed_surface_presses_outward() {
    let (shape, area_m2) = sphere(3, 0.03);
    let model = model(&scene(shape, area_m2, &[]));
    let mut tissue = at_rest(&model);
    let way = DVec3::new(-0.6, 0.1, 0.4).normalize();
    let free = lead(&mut *tissue, DVec3::ZERO, 0.025 * way, 100, 10, TIP);
    assert_eq!(free.contact_state, ContactState::Free);
    assert!(free.normal.dot(way) < -0.99, "{}", free.normal);
    let felt = lead(&mut *tissue, 0.025 * way, 0.0315 * way, 50, 300, TIP);
    assert!(felt.force_on_tool_n.normalize().dot(way) < -2.0_f64.to_radians().cos(), "{}", felt.force_on_tool_n);
    assert!(felt.surface_m.distance(0.0315 * way) < 1e-3);
}

#[test]
fn a_tool_slides_over_edges_and_vertices_without_a_ripple() {
    let (shape, area_m2) = flat(0.0025, 0.06, 0.25, 8);
    let model = model(&scene(shape, area_m2, &[]));
    let mut tissue = at_rest(&model);
    let from_m = DVec3::new(0.02, 0.022, -0.001);
    lead(&mut *tissue, from_m + 0.003 * DVec3::Z, from_m, 50, 300, TIP);
    // Slowly: 20 mm in 2 s.
    let mut forces = Vec::new();
    let way_m = DVec3::new(0.016, 0.012, 0.0);
    let mut before_n = tissue.tool_contact(0).unwrap().force_on_tool_n.z;
    for step in 1..=2000 {
        tissue.pose(0, from_m + f64::from(step) / 2000.0 * way_m, TIP);
        tissue.step().unwrap();
        let feel = tissue.tool_contact(0).unwrap();
        assert_eq!(feel.contact_state, ContactState::Sliding);
        let force_n = feel.force_on_tool_n.z;
        assert!((force_n / before_n - 1.0).abs() < 0.02, "step {step}: {before_n} to {force_n}");
        before_n = force_n;
        forces.push(force_n);
    }
    let (mean_n, ripple) = spread(&forces[200..]);
    println!("{mean_n} N ± {:.3} %", 100.0 * ripple);
    assert!(ripple < 0.03, "{ripple}");
}

#[test]
fn a_grasp_holds_a_mesh_and_a_tool_round_the_rim_comes_to_the_other_side() {
    let (shape, area_m2) = flat(0.004, 0.06, 0.1, 8);
    let model = model(&scene(shape, area_m2, &[]));
    let mut tissue = at_rest(&model);
    let place_m = DVec3::new(0.03, 0.031, 0.0);
    let grasp = Tip { grasps: true, ..TIP };
    lead(&mut *tissue, place_m, place_m, 1, 2, grasp);
    let lifted = lead(&mut *tissue, place_m, place_m + 0.004 * DVec3::Z, 40, 300, grasp);
    assert_eq!(lifted.contact_state, ContactState::Holding);
    assert!(lifted.force_on_tool_n.z < -0.01 && (lifted.surface_m.z - 0.004).abs() < 1e-4, "{lifted:?}");
    tissue.release(0);
    (0..500).for_each(|_| tissue.step().unwrap());
    // Down beside the rim, under it, and up from below.
    let beside_m = DVec3::new(-0.03, 0.03, 0.0);
    lead(&mut *tissue, beside_m + 0.01 * DVec3::Z, beside_m - 0.01 * DVec3::Z, 40, 1, TIP);
    let below_m = DVec3::new(0.03, 0.03, -0.01);
    let under = lead(&mut *tissue, beside_m - 0.01 * DVec3::Z, below_m, 200, 1, TIP);
    assert_eq!(under.contact_state, ContactState::Free);
    assert!(under.normal.z < -0.9, "{}", under.normal);
    let pressed = lead(&mut *tissue, below_m, DVec3::new(0.03, 0.03, 0.001), 50, 200, TIP);
    assert!(pressed.force_on_tool_n.z < -0.01, "{pressed:?}");
}
