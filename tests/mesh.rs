//! Tissue on meshes: the same laws as on the sheet, and the sheet itself where a mesh has its points and springs.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use std::path::Path;
use std::sync::Arc;

use glam::DVec3;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::collection::find_scene;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::{Body, BodyKind, Inclusion, Material, Mesh, MeshShape, PerNodeFactors, Region, Scene};
use palpate_tissue::shape::{PointId, PointName, RestShape};
use palpate_tissue::{Grasp, Model, Push, Tissue, at_rest};

/// The paper's scene with another body, and with some values set.
fn scene(body: Option<Body>, sets: &[&str]) -> Scene {
    let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
    let mut scene = Scene::parse("paper", palpate_tissue::scene::PAPER, &sets, &Limits::default()).unwrap();
    if let Some(body) = body {
        scene.body = body;
    }
    scene
}

fn tissue(scene: &Scene) -> Box<dyn Tissue> {
    at_rest(&Model::compile(scene, &Limits::default()).unwrap())
}

/// A sphere of `rings` × 2·`rings` vertices and two poles, dented a little here and there so that no two edges are
/// alike.
fn sphere(rings: u32, radius_m: f64) -> MeshShape {
    let mut dice = fastrand::Rng::with_seed(5);
    let around = 2 * rings;
    let mut vertices_m = vec![];
    for ring in 0..rings {
        for k in 0..around {
            let (down, turn) = (
                std::f64::consts::PI * f64::from(ring + 1) / f64::from(rings + 1),
                std::f64::consts::TAU * (f64::from(k) + 0.5 * f64::from(ring % 2)) / f64::from(around),
            );
            let place =
                DVec3::new(libm::sin(down) * libm::cos(turn), libm::sin(down) * libm::sin(turn), libm::cos(down));
            vertices_m.push(radius_m * (0.97 + 0.06 * dice.f64()) * place);
        }
    }
    let [top, bottom] = [rings * around, rings * around + 1];
    vertices_m.extend([DVec3::Z * radius_m, -DVec3::Z * radius_m]);
    let mut triangles = vec![];
    for k in 0..around {
        let next = (k + 1) % around;
        triangles.push([top, k, next]);
        triangles.push([bottom, (rings - 1) * around + next, (rings - 1) * around + k]);
        for ring in 1..rings {
            let [a, b, c, d] =
                [(ring - 1, k), (ring - 1, next), (ring, k), (ring, next)].map(|(ring, k)| ring * around + k);
            if ring % 2 == 1 {
                triangles.extend([[a, c, b], [b, c, d]]);
            } else {
                triangles.extend([[a, c, d], [a, d, b]]);
            }
        }
    }
    MeshShape::new(vertices_m, triangles, |_, _, _| false).unwrap()
}

fn body(shape: MeshShape, point_mass_kg: f64, bending: f64) -> Option<Body> {
    Some(Body::Mesh(Mesh::new(point_mass_kg, bending, Arc::new(shape))))
}

/// The same where masses, springs and anchor springs differ from vertex to vertex.
fn uneven_body(shape: MeshShape, point_mass_kg: f64, bending: f64) -> Option<Body> {
    let mut dice = fastrand::Rng::with_seed(8);
    let mut list = |count: usize, least: f64| (0..count).map(|_| least + dice.f64()).collect::<Vec<f64>>();
    let count = shape.vertices_m().len();
    let differences = PerNodeFactors {
        relative_mass: list(count, 0.4),
        extra_anchor: list(count, -0.3),
        edges: list(shape.edges().len(), 0.5),
        bending: list(shape.opposite().len(), 0.5),
    };
    Some(Body::Mesh(Mesh::uneven(point_mass_kg, bending, Arc::new(shape), differences)))
}

fn poke(centre_m: DVec3, force_n: DVec3, falloff_per_m: f64) -> Option<Push> {
    Some(Push::Constant(Poke { point: None, centre_m, force_n, falloff_per_m, falloff_offset: 0.0 }))
}

#[test]
fn a_flat_mesh_with_the_springs_of_a_sheet_is_that_sheet() {
    const NX: u32 = 19;
    const NY: u32 = 33;
    let of_sheet = scene(None, &[&format!("sheet.points=[{NX}, {NY}]"), "sheet.fixed=corners"]);
    let sheet = of_sheet.sheet().unwrap();
    let at = |i: u32, j: u32| i * NY + j;
    let vertices_m = (0..NX * NY).map(|k| sheet.rest_m(PointId::new(k as usize))).collect();
    let (mut triangles, mut braces) = (vec![], vec![]);
    for (i, j) in (0..NX - 1).flat_map(|i| (0..NY - 1).map(move |j| (i, j))) {
        triangles.extend([[at(i, j), at(i + 1, j), at(i + 1, j + 1)], [at(i, j), at(i + 1, j + 1), at(i, j + 1)]]);
        braces.push([at(i + 1, j), at(i, j + 1)]);
    }
    let is_fixed = |_: bool, _: DVec3, vertex: u32| sheet.is_fixed(PointId::new(vertex as usize));
    let shape = MeshShape::braced(vertices_m, triangles, &braces, is_fixed).unwrap();
    let like = |scene: &Scene| {
        let mut scene = scene.clone();
        scene.body = body(shape_of(&shape), sheet.point_mass_kg, 0.0).unwrap();
        scene
    };
    for sets in [
        &["stepping.integrator=central", "stepping.precision=f64", "stepping.substeps=2"][..],
        &["stepping.integrator=exponential4", "stepping.precision=f32", "stepping.substeps=1"],
        &["stepping.integrator=rk4", "stepping.precision=f64", "stepping.substeps=1"],
    ] {
        let points = format!("sheet.points=[{NX}, {NY}]");
        let sets = [&[points.as_str(), "sheet.fixed=corners", "springs.shear_stiffness_n_per_m=10"], sets].concat();
        let of_sheet = scene(None, &sets);
        let (mut flat, mut mesh) = (tissue(&of_sheet), tissue(&like(&of_sheet)));
        let centre_m = sheet.rest_m(sheet.point([7, 12])) + DVec3::new(0.004, 0.007, 0.0);
        let (mut largest, mut apart) = ([0.0_f64; 2], [0.0_f64; 2]);
        for step in 0..400 {
            for tissue in [&mut flat, &mut mesh] {
                if step == 10 {
                    tissue.push(0, poke(centre_m, DVec3::new(0.2, -0.1, -0.9), 20.0));
                    tissue.grasp(1, sheet.point([12, 25]), Grasp::Target(DVec3::new(0.0, 0.005, 0.01)));
                }
                if step == 250 {
                    tissue.push(0, None);
                    tissue.release(1);
                }
                tissue.step().unwrap();
            }
            for point in palpate_tissue::shape::points(sheet).step_by(7) {
                let [a, b] = [flat.point(point), mesh.point(point)];
                for (which, [a, b]) in
                    [[a.displacement_m, b.displacement_m], [a.reaction_n(), b.reaction_n()]].into_iter().enumerate()
                {
                    largest[which] = largest[which].max(a.length());
                    apart[which] = apart[which].max(a.distance(b));
                }
            }
        }
        println!("{sets:?}: {:e} of displacement, {:e} of force", apart[0] / largest[0], apart[1] / largest[1]);
        assert!(largest[0] > 1e-3 && apart[0] < 1e-6 * largest[0], "{sets:?}: {apart:?} of {largest:?}");
        // The sum of springs in f32 rounds in another order.
        assert!(apart[1] < 1e-5 * largest[1], "{sets:?}: {apart:?} of {largest:?}");
    }
}

/// Returns a copy of the shape.
fn shape_of(shape: &MeshShape) -> MeshShape {
    let known: std::collections::BTreeSet<[u32; 2]> = shape
        .triangles()
        .iter()
        .flat_map(|[a, b, c]| [[*a, *b], [*b, *c], [*c, *a]])
        .map(|[a, b]| [a.min(b), a.max(b)])
        .collect();
    let braces: Vec<[u32; 2]> = shape.edges().iter().filter(|edge| !known.contains(*edge)).copied().collect();
    let fixed = |_: bool, _: DVec3, vertex: u32| shape.is_fixed(PointId::new(vertex as usize));
    MeshShape::braced(shape.vertices_m().to_vec(), shape.triangles().to_vec(), &braces, fixed).unwrap()
}

#[test]
fn without_damping_energy_is_kept_and_springs_change_no_momentum() {
    for (bending, is_uneven) in [(0.0, false), (0.4, false), (0.4, true)] {
        let sets = ["damping.coefficient_n_s_per_m=0", "anchor_springs.stiffness_n_per_m=0", "stepping.precision=f64"];
        let sets =
            [&sets[..], &["sleep.tolerance=0", "stepping.integrator=exponential4", "stepping.substeps=4"]].concat();
        let of = if is_uneven { uneven_body } else { body };
        let scene = scene(of(sphere(9, 0.1), 0.01, bending), &sets);
        let mut tissue = tissue(&scene);
        let points: Vec<PointId> = tissue.model().points().collect();
        tissue.push(0, poke(DVec3::new(0.0, 0.1, 0.0), DVec3::new(0.1, -0.6, 0.2), 15.0));
        (0..30).for_each(|_| tissue.step().unwrap());
        tissue.push(0, None);
        (0..3).for_each(|_| tissue.step().unwrap());
        let mass = |point: &PointId| scene.relative_mass(*point);
        let momentum = |tissue: &dyn Tissue| -> DVec3 {
            points.iter().map(|point| mass(point) * tissue.point(*point).velocity_m_per_s).sum()
        };
        let turn = |tissue: &dyn Tissue| -> DVec3 {
            let of = |point: &PointId| {
                let state = tissue.point(*point);
                mass(point) * (scene.shape().rest_m(*point) + state.displacement_m).cross(state.velocity_m_per_s)
            };
            points.iter().map(of).sum()
        };
        let total = |tissue: &dyn Tissue| {
            let energy = tissue.energy();
            energy.kinetic_j + energy.spring_j + energy.anchor_j
        };
        let (begun_j, begun, begun_turn) = (total(&*tissue), momentum(&*tissue), turn(&*tissue));
        for _ in 0..500 {
            tissue.step().unwrap();
            let largest: f64 = points.iter().map(|point| tissue.point(*point).velocity_m_per_s.length()).sum();
            assert!((total(&*tissue) - begun_j).abs() < 1e-5 * begun_j, "{} {begun_j}", total(&*tissue));
            assert!(momentum(&*tissue).distance(begun) < 1e-9 * largest, "{} {begun}", momentum(&*tissue));
            assert!(turn(&*tissue).distance(begun_turn) < 1e-5 * 0.1 * largest, "{} {begun_turn}", turn(&*tissue));
        }
        assert!(tissue.energy().spring_j > 1e-3 * begun_j && begun.length() > 0.0);
    }
}

#[test]
fn the_bits_of_a_mesh_are_those_of_any_width() {
    for (index, (integrator, precision)) in
        [("central", "f32"), ("exponential3", "compensated"), ("exponential4", "f64"), ("rk4", "f32")]
            .into_iter()
            .cycle()
            .take(6)
            .enumerate()
    {
        let of = if index < 4 { body } else { uneven_body };
        let hash = |lanes: &str| {
            let [integrator, precision, lanes] =
                [("integrator", integrator), ("precision", precision), ("lanes", lanes)]
                    .map(|(key, value)| format!("stepping.{key}={value}"));
            let scene =
                scene(of(sphere(13, 0.1), 0.01, 0.3), &[&integrator, &precision, &lanes, "stepping.substeps=2"]);
            let model = Model::compile(&scene, &Limits::default()).ok()?;
            let mut tissue = at_rest(&model);
            tissue.push(0, poke(DVec3::new(0.07, 0.07, 0.02), DVec3::new(0.4, -0.6, 0.2), 25.0));
            tissue.grasp(1, PointId::new(40), Grasp::Target(DVec3::new(0.0, 0.01, -0.02)));
            (0..60).for_each(|_| tissue.step().unwrap());
            Some((tissue.state_hash(), tissue.awake_points()))
        };
        let hashes: Vec<_> = ["plain", "avx2", "avx512", "neon"].into_iter().filter_map(hash).collect();
        assert!(
            hashes.len() > 1 && hashes.iter().all(|hash| *hash == hashes[0]),
            "{integrator} {precision}: {hashes:?}"
        );
    }
}

#[test]
fn a_mesh_sleeps_where_nothing_moves_and_wakes_where_something_does() {
    sleeps_and_wakes(body);
    sleeps_and_wakes(uneven_body);
}

fn sleeps_and_wakes(of: fn(MeshShape, f64, f64) -> Option<Body>) {
    let sets = ["damping.coefficient_n_s_per_m=0.3", "anchor_springs.stiffness_n_per_m=20"];
    let with_sleep = |sleep: &str| scene(of(sphere(45, 0.1), 0.01, 0.0), &[&sets[..], &[sleep]].concat());
    let (mut sleeper, mut awake) =
        (tissue(&with_sleep("sleep.tolerance=1e-4")), tissue(&with_sleep("sleep.tolerance=0")));
    assert!(sleeper.is_still() && sleeper.awake_points() == 0);
    let (mut largest, mut apart, mut fewest) = (0.0_f64, 0.0_f64, usize::MAX);
    for step in 0..1500 {
        for tissue in [&mut sleeper, &mut awake] {
            match step {
                0 => tissue.push(0, poke(DVec3::new(0.0, 0.0, 0.1), DVec3::new(0.0, 0.0, -0.6), 600.0)),
                700 => tissue.push(0, poke(DVec3::new(0.0, 0.0, -0.1), DVec3::new(0.2, 0.0, 0.4), 600.0)),
                _ => {}
            }
            tissue.step().unwrap();
        }
        if step == 2 {
            fewest = sleeper.awake_points();
        }
        for point in awake.model().points().step_by(17) {
            let [a, b] = [&sleeper, &awake].map(|tissue| tissue.point(point).displacement_m);
            largest = largest.max(b.length());
            apart = apart.max(a.distance(b));
        }
    }
    println!("{fewest} of {} points awake; {:e} apart", awake.model().len(), apart / largest);
    assert!(fewest > 0 && 2 * fewest < awake.model().len(), "{fewest}");
    assert!(largest > 1e-4 && apart < 1e-4 * largest, "{apart} of {largest}");
    for _ in 0..6000 {
        sleeper.step().unwrap();
        if sleeper.is_still() {
            return;
        }
    }
    panic!("{} awake", sleeper.awake_points());
}

#[test]
fn a_scene_on_a_mesh_is_found_by_its_name_with_the_file_beside_it() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("organ.obj"), "v 0 0 0\nv 50 0 0\nv 0 50 0\nv 50 50 0\nf 1 2 3\nf 2 4 3\n")
        .unwrap();
    let text = "[mesh]\nfile = \"organ.obj\"\nunit = \"mm\"\npoint_mass_kg = 0.01\n\
                [springs]\nstiffness_n_per_m = 10.0\n[anchor_springs]\nstiffness_n_per_m = 5.0\n\
                [damping]\ncoefficient_n_s_per_m = 0.05\n";
    std::fs::write(folder.path().join("organ.toml"), text).unwrap();
    let limits = Limits::default();
    let by_name = find_scene(Path::new("organ"), folder.path(), &[], &limits).unwrap();
    let by_path = find_scene(&folder.path().join("organ.toml"), Path::new("elsewhere"), &[], &limits).unwrap();
    assert_eq!(by_name.shape().point_count(), 4);
    assert_eq!(by_name, by_path);
    let refused = Scene::parse("organ", text, &[], &limits).unwrap_err();
    assert!(refused.to_string().contains("a scene that a client sends can't"), "{refused}");
}

#[test]
fn forces_move_each_vertex_by_its_own_mass() {
    for integrator in ["central", "exponential4", "rk4"] {
        let sets =
            ["damping.coefficient_n_s_per_m=0.03", "anchor_springs.stiffness_n_per_m=9", "stepping.precision=f64"];
        let [integrator, rate] = [format!("stepping.integrator={integrator}"), "stepping.rate_hz=20000".to_owned()];
        let sets = [&sets[..], &["sleep.tolerance=0", &integrator, &rate, "stepping.substeps=1"]].concat();
        let scene = scene(uneven_body(sphere(7, 0.1), 0.01, 0.4), &sets);
        let model = Model::compile(&scene, &Limits::default()).unwrap();
        let mut tissue = at_rest(&model);
        tissue.push(0, poke(DVec3::new(0.0, 0.1, 0.0), DVec3::new(0.1, -0.6, 0.2), 15.0));
        let held = PointId::new(30);
        tissue.grasp(1, held, Grasp::Target(DVec3::new(0.002, 0.0, 0.0)));
        let velocities = |tissue: &dyn Tissue| -> Vec<DVec3> {
            model.points().map(|point| tissue.point(point).velocity_m_per_s).collect()
        };
        for round in 0..4 {
            (0..30).for_each(|_| tissue.step().unwrap());
            let before = velocities(&*tissue);
            tissue.step().unwrap();
            let now: Vec<_> = model.points().map(|point| tissue.point(point)).collect();
            tissue.step().unwrap();
            let after = velocities(&*tissue);
            let (mut largest, mut apart) = (0.0_f64, 0.0_f64);
            for (point, state) in model.points().zip(&now) {
                let anchor_n = -model.anchor_stiffness_n_per_m(point) * state.displacement_m;
                let damping_n = -model.damping_n_s_per_m(point) * state.velocity_m_per_s;
                assert!(state.anchor_n.distance(anchor_n) < 1e-12 && state.damping_n.distance(damping_n) < 1e-12);
                if point == held {
                    continue;
                }
                let acceleration = (after[point.index()] - before[point.index()]) / 2.0 * 20_000.0;
                let force_n = state.reaction_n() + state.applied_n;
                largest = largest.max(force_n.length());
                apart = apart.max((model.mass_kg(point) * acceleration - force_n).length());
            }
            assert!(apart <= 2e-3 * largest, "{integrator} {round}: {apart} of {largest}");
        }
        let (energy, mass_kg) = (tissue.energy(), |point| model.mass_kg(point));
        let kinetic_j: f64 = model
            .points()
            .map(|point| 0.5 * mass_kg(point) * tissue.point(point).velocity_m_per_s.length_squared())
            .sum();
        let anchor_j: f64 = model
            .points()
            .map(|point| {
                0.5 * model.anchor_stiffness_n_per_m(point) * tissue.point(point).displacement_m.length_squared()
            })
            .sum();
        assert!((energy.kinetic_j - kinetic_j).abs() < 1e-9 * kinetic_j, "{integrator}: {energy:?} {kinetic_j}");
        assert!((energy.anchor_j - anchor_j).abs() < 1e-9 * anchor_j, "{integrator}: {energy:?} {anchor_j}");
        assert_eq!(tissue.guard_events(), 0);
    }
}

/// An icosahedron, all of whose vertices are alike.
fn icosahedron(radius_m: f64) -> MeshShape {
    let long = 0.5 * (1.0 + 5.0_f64.sqrt());
    let of =
        |a: f64, b: f64| [DVec3::new(0.0, a, b * long), DVec3::new(a, b * long, 0.0), DVec3::new(b * long, 0.0, a)];
    let signs = [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)];
    let vertices: Vec<DVec3> =
        signs.into_iter().flat_map(|(a, b)| of(a, b)).map(|place| radius_m * place.normalize()).collect();
    let mut triangles = vec![];
    let is_edge = |a: usize, b: usize| vertices[a].distance(vertices[b]) < 1.1 * radius_m;
    for (a, b) in (0..12).flat_map(|a| (a + 1..12).map(move |b| (a, b))).filter(|(a, b)| is_edge(*a, *b)) {
        for c in (b + 1..12).filter(|c| is_edge(a, *c) && is_edge(b, *c)) {
            let outward = (vertices[b] - vertices[a]).cross(vertices[c] - vertices[a]).dot(vertices[a]) > 0.0;
            triangles.push(if outward { [a, b, c] } else { [a, c, b] }.map(|vertex| vertex as u32));
        }
    }
    assert_eq!(triangles.len(), 20);
    MeshShape::new(vertices, triangles, |_, _, _| false).unwrap()
}

const MATERIAL: Material = Material {
    youngs_modulus_pa: 8000.0,
    thickness_m: 0.004,
    density_kg_per_m3: 1060.0,
    depth_m: 0.03,
    foundation_n_per_m3: 4e5,
    damping_ratio: 0.5,
    foundation_group: None,
};

#[test]
fn where_all_vertices_are_alike_a_material_is_the_coefficients_of_the_paper() {
    let made = MATERIAL.applied(0.0, Arc::new(icosahedron(0.02))).unwrap();
    let sets = ["stepping.integrator=exponential4", "stepping.precision=f64", "stepping.substeps=2"];
    let with = |mesh: Mesh| {
        let mut scene = scene(Some(Body::Mesh(mesh)), &sets);
        scene.springs.stiffness_n_per_m = made.stiffness_n_per_m;
        scene.anchor_stiffness_n_per_m = made.anchor_stiffness_n_per_m;
        scene.damping_n_s_per_m = made.damping_n_s_per_m;
        scene
    };
    let even = Mesh::new(made.mesh.point_mass_kg, 0.0, made.mesh.shape.clone());
    assert!((made.mesh.stiffest.bound / even.stiffest.bound - 1.0).abs() < 1e-9);
    let area_m2 = 20.0 * 3.0_f64.sqrt() / 4.0 * made.mesh.shape.edge_m().powi(2);
    assert!((made.anchor_stiffness_n_per_m / (4e5 * area_m2 / 12.0) - 1.0).abs() < 1e-12);
    assert!((made.mesh.mass_kg() / (1060.0 * 0.03 / 3.0 * area_m2) - 1.0).abs() < 1e-12);
    // Nothing gives way where all is alike.
    assert!((made.stiffness_n_per_m / (3.0_f64.sqrt() / 2.0 * 32.0) - 1.0).abs() < 1e-9, "{}", made.stiffness_n_per_m);
    let [mut a, mut b] = [with(made.mesh.clone()), with(even)].map(|scene| tissue(&scene));
    let (mut largest, mut apart) = (0.0_f64, 0.0_f64);
    for _ in 0..100 {
        for tissue in [&mut a, &mut b] {
            tissue.push(0, poke(DVec3::new(0.02, 0.0, 0.0), DVec3::new(-0.2, 0.05, 0.0), 60.0));
            tissue.step().unwrap();
        }
        for point in a.model().points() {
            let [p, q] = [&a, &b].map(|tissue| tissue.point(point).displacement_m);
            largest = largest.max(p.length());
            apart = apart.max(p.distance(q));
        }
    }
    assert!(largest > 1e-4 && apart < 1e-11 * largest, "{apart} of {largest}");
}

#[test]
fn an_inclusion_makes_a_mesh_stiffer_where_it_is_and_nowhere_else() {
    let sets =
        ["damping.coefficient_n_s_per_m=0.4", "anchor_springs.stiffness_n_per_m=20", "springs.stiffness_n_per_m=10"];
    let shape = Arc::new(sphere(13, 0.1));
    let plain = Mesh::new(0.01, 0.2, shape.clone());
    let lump = Inclusion {
        region: Region::Ball { centre_m: DVec3::new(0.09, 0.0, 0.0), radius_m: 0.03 },
        stiffness_factor: 4.0,
        anchor_stiffness_factor: 3.0,
        edge_m: 0.01,
    };
    let with = Inclusion::put_into(&[lump], "inclusion", &plain).unwrap();
    let depth_m = |mesh: &Mesh, place_m: DVec3| {
        let mut tissue =
            tissue(&scene(Some(Body::Mesh(mesh.clone())), &[&sets[..], &["stepping.tolerance=1e-3"]].concat()));
        let point = shape.nearest(place_m);
        tissue.push(0, poke(shape.rest_m(point), -0.05 * shape.normal(point), 100.0));
        (0..400).for_each(|_| tissue.step().unwrap());
        tissue.point(point).displacement_m.length()
    };
    let ratio = |place_m: DVec3| depth_m(&with, place_m) / depth_m(&plain, place_m);
    let within = ratio(DVec3::new(0.1, 0.0, 0.0));
    assert!((0.2..0.5).contains(&within), "{within}");
    for place_m in [DVec3::new(-0.1, 0.0, 0.0), DVec3::new(0.0, 0.1, 0.0), DVec3::new(0.0, 0.0, -0.1)] {
        let beyond = ratio(place_m);
        assert!((beyond - 1.0).abs() < 0.01, "{place_m}: {beyond}");
    }
}

/// The text of a mesh in the form of an OBJ file.
fn obj(shape: &MeshShape) -> String {
    let vertices = shape.vertices_m().iter().map(|place| format!("v {} {} {}\n", place.x, place.y, place.z));
    let triangles = shape.triangles().iter().map(|[a, b, c]| format!("f {} {} {}\n", a + 1, b + 1, c + 1));
    vertices.chain(triangles).collect()
}

#[test]
fn what_a_scene_says_of_a_mesh_and_its_material_is_refused_by_key() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("ball.obj"), obj(&icosahedron(0.02))).unwrap();
    let limits = Limits { points: 20_000, ..Limits::default() };
    let parsed = |text: &str| Scene::parse_in(folder.path(), "test", text, &[], &limits);
    let (file, organ) = ("file = \"ball.obj\"\nunit = \"m\"\n", "organ = { name = \"liver\", edge_m = 0.0001 }\n");
    let material = "[material]\nyoungs_modulus_pa = 1e4\nthickness_m = 0.01\nfoundation_n_per_m3 = 1e6\n";
    let good = parsed(&format!("[mesh]\n{file}{material}")).unwrap();
    assert!(good.springs.stiffness_n_per_m > 50.0 && good.damping_n_s_per_m > 0.0 && good.point_mass_kg() > 0.0);
    let inclusion = |keys: &str| format!("[mesh]\n{file}{material}[[inclusion]]\n{keys}\n");
    for (text, field, message) in [
        (format!("[mesh]\n{file}point_mass_kg = 1.0\n{material}"), "mesh.point_mass_kg", "does not go with [material]"),
        (
            format!("[mesh]\n{file}{material}[damping]\ncoefficient_n_s_per_m = 1.0\n"),
            "damping",
            "from which it follows",
        ),
        (
            format!("[mesh]\n{file}{material}[springs]\nstiffness_n_per_m = 1.0\n"),
            "springs.stiffness_n_per_m",
            "follows",
        ),
        (format!("[mesh]\n{file}[material]\nyoungs_modulus_pa = 1.0\n"), "material.thickness_m", "is missing"),
        (format!("[mesh]\n{file}{material}depth_m = 0.0\n"), "material.depth_m", ""),
        (format!("[mesh]\n{file}vertices = 3\n{material}"), "mesh.vertices", "at least 4"),
        (format!("[mesh]\n{file}{organ}{material}"), "mesh.file", "does not go with organ"),
        (format!("[mesh]\n{organ}{material}"), "mesh.organ.edge_m", "more than 20000"),
        (format!("[mesh]\norgan = {{ name = \"liver\", edge_m = 0.1 }}\n{material}"), "mesh.organ.edge_m", "too long"),
        (
            format!("[mesh]\norgan = {{ name = \"lever\", edge_m = 0.1 }}\n{material}"),
            "mesh.organ.name",
            "no organ `lever`",
        ),
        (format!("[sheet]\npoints = [3, 3]\n{material}"), "material", "is for a mesh"),
        (inclusion("stiffness_factor = 2.0"), "inclusion[0].centre_m", "or else `group`"),
        (inclusion("group = \"lump\""), "inclusion[0].group", "the mesh has no group"),
        (inclusion("group = \"lump\"\ncentre_m = [0, 0, 0]"), "inclusion[0].group", "a ball or a group"),
        (inclusion("group = \"lump\"\nradius_m = 0.01"), "inclusion[0].radius_m", "a ball or a group"),
        (inclusion("centre_m = [0, 0, 0]\nradius = 0.01"), "inclusion[0].radius", "the unit belongs to the name"),
        (inclusion("centre_m = [0, 0, 0]\nradius_m = 0.001"), "inclusion[0].radius_m", "no vertex is within"),
        (
            inclusion("centre_m = [0, 0, 0]\nradius_m = 0.1\nstiffness_factor = 0"),
            "inclusion[0].stiffness_factor",
            "0.01",
        ),
    ] {
        let refused = parsed(&text).unwrap_err();
        assert_eq!(refused.field, field, "{refused}");
        assert!(refused.to_string().contains(message) && refused.place.is_some(), "{refused}");
    }
}

#[test]
fn a_rim_of_a_closed_mesh_is_warned_of_and_so_is_a_vertex_that_is_much_too_fast() {
    let folder = tempfile::tempdir().unwrap();
    let mut text = obj(&icosahedron(0.02));
    std::fs::write(folder.path().join("ball.obj"), &text).unwrap();
    // Three more triangles in place of the last one, around a vertex beside its first corner.
    let last = text.lines().last().unwrap().to_owned();
    let corners: Vec<usize> = last.split(' ').skip(1).map(|number| number.parse().unwrap()).collect();
    let shape = icosahedron(0.02);
    let at = |corner: usize| shape.vertices_m()[corners[corner] - 1];
    let near = 0.96 * at(0) + 0.02 * at(1) + 0.02 * at(2);
    let [a, b, c] = [corners[0], corners[1], corners[2]];
    text =
        text.replace(&last, &format!("v {} {} {}\nf {a} {b} 13\nf {b} {c} 13\nf {c} {a} 13", near.x, near.y, near.z));
    std::fs::write(folder.path().join("sliver.obj"), &text).unwrap();
    let warnings = |file: &str| {
        let text = format!(
            "[mesh]\nfile = \"{file}\"\nunit = \"m\"\nfixed = \"rim\"\n[material]\nyoungs_modulus_pa = 1e3\n\
             thickness_m = 0.01\nfoundation_n_per_m3 = 1e5\n[stepping]\ntolerance = 1e-2\n"
        );
        let scene = Scene::parse_in(folder.path(), "test", &text, &[], &Limits::default()).unwrap();
        let Body::Mesh(mesh) = scene.body else { panic!("of another kind") };
        mesh.warnings()
    };
    let even = warnings("ball.obj");
    assert!(even.len() == 1 && even[0].contains("\"rim\" fixes nothing"), "{even:?}");
    let uneven = warnings("sliver.obj");
    assert!(uneven.len() == 2 && uneven[1].contains("times as fast as half of the mesh"), "{uneven:?}");
}

#[test]
fn a_shape_is_the_same_tissue_however_its_file_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let ball = sphere(9, 0.03);
    let write = |vertices_m: &[DVec3], triangles: &[[u32; 3]], head: &str| {
        let vertices = vertices_m.iter().map(|place| format!("v {} {} {}\n", place.x, place.y, place.z));
        let triangles = triangles.iter().map(|[a, b, c]| format!("f {} {} {}\n", a + 1, b + 1, c + 1));
        std::fs::write(folder.path().join("ball.obj"), vertices.chain(triangles).collect::<String>()).unwrap();
        let text = format!(
            "[mesh]\nfile = \"ball.obj\"\nunit = \"m\"\n{head}[material]\nyoungs_modulus_pa = 8e3\nthickness_m = 5e-4\n\
             foundation_n_per_m3 = 1.34e6\n[stepping]\nintegrator = \"exponential4\"\nsubsteps = 4\n"
        );
        Scene::parse_in(folder.path(), "test", &text, &[], &Limits::default()).unwrap()
    };
    let top = ball.vertices_m().iter().position(|place| place.z > 0.0299).unwrap();
    // The displacement of the vertex on top under a push there, and the warnings.
    let pressed = |scene: &Scene, vertex: u32| {
        let model = Model::compile(scene, &Limits::default()).unwrap();
        let point = model.shape().find("test", PointName::Vertex(vertex)).unwrap();
        let mut tissue = at_rest(&model);
        tissue.push(0, poke(model.shape().rest_m(point), DVec3::new(0.0, 0.0, -0.02), 200.0));
        (0..200).for_each(|_| tissue.step().unwrap());
        (tissue.point(point).displacement_m, model.shape().normal(point).z, model.warnings.clone())
    };
    let (expected_m, up, warnings) = pressed(&write(ball.vertices_m(), ball.triangles(), ""), top as u32);
    assert!(expected_m.z < -1e-5 && up > 0.99 && warnings.is_empty(), "{expected_m} {warnings:?}");

    let inward: Vec<[u32; 3]> = ball.triangles().iter().map(|[a, b, c]| [*b, *a, *c]).collect();
    let some: Vec<[u32; 3]> = ball
        .triangles()
        .iter()
        .enumerate()
        .map(|(n, [a, b, c])| if n % 3 == 0 { [*b, *a, *c] } else { [*a, *b, *c] })
        .collect();
    for (triangles, word) in [(&inward, "turned outward"), (&some, "that the others face")] {
        let (found_m, up, warnings) = pressed(&write(ball.vertices_m(), triangles, ""), top as u32);
        assert!(found_m.distance(expected_m) < 1e-4 * expected_m.length(), "{found_m} {expected_m}");
        assert!(up > 0.99 && warnings.iter().any(|warning| warning.contains(word)), "{warnings:?}");
    }
    for triangles in [ball.triangles(), &inward, &some] {
        let soup: Vec<DVec3> = triangles.iter().flatten().map(|vertex| ball.vertices_m()[*vertex as usize]).collect();
        let own: Vec<[u32; 3]> = (0..triangles.len() as u32).map(|n| [3 * n, 3 * n + 1, 3 * n + 2]).collect();
        for head in ["", "vertices = 60\n"] {
            let scene = write(&soup, &own, head);
            let Body::Mesh(mesh) = &scene.body else { panic!("of another kind") };
            let shown = mesh.shape.shown().unwrap();
            assert_eq!((&shown.mesh.vertices_m, shown.places.len()), (&soup, soup.len()), "those of the file");
            // Each corner of the file at the top is the same point, which the first of them names.
            let of_top: Vec<u32> = (0..).zip(&soup).filter(|(_, place)| place.z > 0.0299).map(|(n, _)| n).collect();
            let points: Vec<PointId> =
                of_top.iter().map(|n| mesh.shape.find("test", PointName::Vertex(*n)).unwrap()).collect();
            assert!(of_top.len() > 4 && points.iter().all(|point| *point == points[0]));
            if head.is_empty() {
                assert_eq!(mesh.shape.point_count(), ball.point_count());
                assert_eq!(mesh.shape.name(points[0]), PointName::Vertex(of_top[0]));
                let (found_m, up, warnings) = pressed(&scene, of_top[2]);
                assert!(
                    found_m.distance(expected_m) < 1e-4 * expected_m.length() && up > 0.99,
                    "{found_m} {expected_m}"
                );
                assert!(warnings.iter().any(|warning| warning.contains("joined along the edges")), "{warnings:?}");
            } else {
                assert!(mesh.shape.point_count() <= 60);
            }
            // A client that sends it, and a journal that keeps it, make the same tissue.
            let sent = palpate_session::wire::scene::sent(&scene);
            let again = palpate_session::wire::scene::from_scene(&sent, Some(&shown.mesh)).unwrap();
            let Body::Mesh(other) = &again.body else { panic!("of another kind") };
            assert_eq!(other.shape.vertices_m(), mesh.shape.vertices_m());
            assert_eq!(other.shape.triangles(), mesh.shape.triangles());
            assert_eq!(other.shape.shown(), mesh.shape.shown());
        }
    }
}

#[test]
fn what_remains_doubtful_about_a_mesh_is_warned_of() {
    let folder = tempfile::tempdir().unwrap();
    let warnings = |text: &str| {
        std::fs::write(folder.path().join("organ.obj"), text).unwrap();
        let scene = "[mesh]\nfile = \"organ.obj\"\nunit = \"m\"\n[material]\nyoungs_modulus_pa = 1e3\n\
             thickness_m = 0.01\nfoundation_n_per_m3 = 1e5\n[stepping]\ntolerance = 1e-2\n";
        let scene = Scene::parse_in(folder.path(), "test", scene, &[], &Limits::default());
        Model::compile(&scene.unwrap(), &Limits::default()).unwrap().warnings.join("; ")
    };
    let ball = obj(&icosahedron(0.02));
    assert_eq!(warnings(&ball), "");
    // A stray vertex, far away: it is no tissue, and does not make it larger.
    assert!(warnings(&format!("{ball}v 90 0 0\n")).contains("no triangle has them: 1."));
    let (vertices, faces): (Vec<&str>, Vec<&str>) = ball.lines().partition(|line| line.starts_with('v'));
    let other = |by: f64| {
        let moved = vertices.iter().map(|line| {
            let at: Vec<f64> = line.split(' ').skip(1).map(|part| part.parse().unwrap()).collect();
            format!("v {} {} {}\n", at[0] + by, at[1] + 0.001, at[2])
        });
        let next = faces.iter().map(|line| {
            let of: Vec<usize> = line.split(' ').skip(1).map(|part| part.parse().unwrap()).collect();
            format!("f {} {} {}\n", of[0] + vertices.len(), of[1] + vertices.len(), of[2] + vertices.len())
        });
        format!("{ball}{}{}", moved.collect::<String>(), next.collect::<String>())
    };
    assert!(warnings(&other(0.1)).contains("2 separate surfaces"));
    let cut = warnings(&other(0.015));
    assert!(cut.contains("cuts through") && cut.contains("of this kind"), "{cut}");
    // Open, and facing inwards.
    let open: String = vertices
        .iter()
        .map(|line| format!("{line}\n"))
        .chain(faces[3..].iter().map(|line| {
            let of: Vec<&str> = line.split(' ').collect();
            format!("f {} {} {}\n", of[2], of[1], of[3])
        }))
        .collect();
    assert!(warnings(&open).contains("the open surface faces inwards"));
}

#[test]
fn of_a_decimated_mesh_the_vertices_of_the_file_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let fine = sphere(13, 0.1);
    std::fs::write(folder.path().join("ball.obj"), obj(&fine)).unwrap();
    let text = "[mesh]\nfile = \"ball.obj\"\nunit = \"m\"\nvertices = 100\n[material]\nyoungs_modulus_pa = 1e4\n\
                thickness_m = 0.01\nfoundation_n_per_m3 = 1e6\n";
    let scene = Scene::parse_in(folder.path(), "test", text, &[], &Limits::default()).unwrap();
    let Body::Mesh(mesh) = &scene.body else { panic!("of another kind") };
    let (shape, count) = (&mesh.shape, fine.vertices_m().len());
    let shown = shape.shown().unwrap();
    assert!(shape.point_count() <= 100 && shown.places.len() == count && shown.mesh.triangles == fine.triangles());
    for (vertex, place_m) in (0..).zip(fine.vertices_m()) {
        let point = shape.find("test", PointName::Vertex(vertex)).unwrap();
        assert!(shape.rest_m(point).distance(*place_m) < 0.04, "{vertex}");
    }
    assert!(shape.find("test", PointName::Vertex(count as u32)).is_err());
    for point in palpate_tissue::shape::points(&**shape) {
        let PointName::Vertex(vertex) = shape.name(point) else { panic!("of another kind") };
        assert!(shape.rest_m(point).distance(fine.vertices_m()[vertex as usize]) < 0.03, "{vertex}");
    }
}

#[test]
fn the_organs_that_are_built_in_give_way_under_a_fingertip_and_less_so_at_a_lump() {
    let limits = Limits::default();
    for (name, total_n, at_m, lumps_m) in [
        ("gallbladder", 0.2, [0.02, 0.0, -0.02], &[][..]),
        ("colon", 0.2, [0.1, 0.0, -0.02], &[]),
        ("liver-organ", 1.0, [-0.034, 0.004, 0.05], &[[-0.040, -0.026, 0.037], [0.030, -0.013, 0.028]]),
    ] {
        let scene = find_scene(Path::new(name), Path::new("no-such-folder"), &[], &limits).unwrap();
        let model = Model::compile(&scene, &limits).unwrap();
        println!("{name}: {} points, {:?}, {} substeps", model.len(), model.plan.integrator, model.plan.substeps);
        assert!(model.plan.stable && model.expected_error <= scene.stepping.tolerance, "{name}");
        assert_eq!(model.warnings, [""; 0], "{name}");
        let depth_mm = |place_m: [f64; 3]| {
            let (mut tissue, shape) = (at_rest(&model), model.shape());
            let point = shape.nearest(DVec3::from_array(place_m));
            // In all as much as a disc of 5 mm.
            let falloff_per_m = 2.0_f64.sqrt() / 0.005;
            let force_n = total_n / palpate_tissue::scene::profile::weights(shape, shape.rest_m(point), falloff_per_m);
            tissue.push(0, poke(shape.rest_m(point), -force_n * shape.normal(point), falloff_per_m));
            (0..60).for_each(|_| tissue.step().unwrap());
            assert_eq!(tissue.guard_events(), 0);
            1e3 * tissue.point(point).displacement_m.length()
        };
        let depth = depth_mm(at_m);
        println!("{name}: {depth} mm");
        assert!((1.0..15.0).contains(&depth), "{name}: {depth} mm");
        for lump_m in lumps_m {
            let found = depth_mm(*lump_m);
            println!("{name}: {found} mm at a lump");
            assert!(found < 0.8 * depth, "{name}: {found} of {depth} mm");
        }
    }
}
