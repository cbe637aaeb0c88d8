//! Tissue that encloses a volume: the laws of its pressure, what it does to a touch, sleep, bits, and changes under
//! way.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use std::path::Path;
use std::sync::Arc;

use crate::common;
use crate::common::{model, scene_with, schemes};
use glam::DVec3;
use palpate_haptics::{Coupling, Tip, TipShape};
use palpate_refusal::Reason;
use palpate_session::run::{RunOptions, run};
use palpate_tissue::limits::Limits;
use palpate_tissue::response::tangent;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::{Body, Change, Scene};
use palpate_tissue::shape::{PointId, RestShape};
use palpate_tissue::{Model, Push, Tissue, at_rest};

/// A ball of 162 vertices and 0.1 m.
fn ball(sets: &[&str]) -> Scene {
    let text = "[mesh]\nfile = \"icosphere.obj\"\nunit = \"m\"\npoint_mass_kg = 0.01\n[springs]\nstiffness_n_per_m = 10.0\n\
                [anchor_springs]\nstiffness_n_per_m = 5.0\n[damping]\ncoefficient_n_s_per_m = 0.1\n\
                [volume]\nstiffness_pa = 2e4\n";
    let folder = format!("{}/tests/reference", env!("CARGO_MANIFEST_DIR"));
    let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
    Scene::parse_in(Path::new(&folder), "ball", text, &sets, &Limits::default()).unwrap()
}

/// A gallbladder of several tiles, its points heavy and light, part of it fixed.
fn gallbladder(sets: &[&str]) -> Scene {
    let text = "[mesh]\norgan = { name = \"gallbladder\", edge_m = 0.0025 }\nfixed = { group = \"bed\" }\n[material]\n\
                youngs_modulus_pa = 15e3\nthickness_m = 0.001\nfoundation_n_per_m3 = 2e6\n[volume]\nstiffness_pa = 2e4\n\
                [stepping]\ntolerance = 1e-4\n";
    scene_with(text, sets)
}

fn poke(centre_m: DVec3, force_n: DVec3, falloff_per_m: f64) -> Option<Push> {
    Some(Push::Constant(Poke { point: None, centre_m, force_n, falloff_per_m, falloff_offset: 0.0 }))
}

fn points(tissue: &dyn Tissue) -> Vec<PointId> {
    tissue.model().points().collect()
}

/// Σ a·u, m³.
fn growth_m3(tissue: &dyn Tissue) -> f64 {
    let areas_m2 = &tissue.model().scene.volume().unwrap().areas_m2;
    points(tissue).iter().zip(areas_m2).map(|(point, area)| area.dot(tissue.point(*point).displacement_m)).sum()
}

/// Returns the volume of the moved triangles over that at rest, minus 1.
fn true_growth(tissue: &dyn Tissue) -> f64 {
    let Body::Mesh(mesh) = &tissue.model().scene.body else { panic!("no mesh") };
    let enclosed = |places_m: &[DVec3]| -> f64 {
        let of = |triangle: &[u32; 3]| {
            let [a, b, c] = triangle.map(|vertex| places_m[vertex as usize]);
            a.dot(b.cross(c)) / 6.0
        };
        mesh.shape.triangles().iter().map(of).sum()
    };
    let moved = |point: &PointId| mesh.shape.rest_m(*point) + tissue.point(*point).displacement_m;
    let now_m: Vec<DVec3> = points(tissue).iter().map(moved).collect();
    enclosed(&now_m) / enclosed(mesh.shape.vertices_m()) - 1.0
}

#[test]
fn the_pressure_pushes_each_vertex_by_its_area_and_stores_what_it_says() {
    for integrator in schemes() {
        let integrator = format!("stepping.integrator={integrator}");
        // The pressure alone is elastic, on points of all masses.
        let scene = gallbladder(&[&integrator, "stepping.precision=f64", "sleep.tolerance=0"]);
        let mut scene = Scene { volume_stiffness_pa: 3e3, ..scene };
        (scene.springs.stiffness_n_per_m, scene.stepping.substeps) = (0.0, Some(16));
        let mut tissue = at_rest(&model(&scene));
        let volume = tissue.model().scene.volume().unwrap().clone();
        tissue.push(0, poke(DVec3::new(0.02, 0.0, -0.05), DVec3::new(0.02, 0.01, 0.05), 50.0));
        for _ in 0..25 {
            tissue.step().unwrap();
        }
        let pressure_pa = -3e3 * growth_m3(&*tissue) / volume.volume_m3;
        let (mut largest_n, mut apart_n, mut sum_n) = (0.0_f64, 0.0_f64, DVec3::ZERO);
        for (point, area) in points(&*tissue).into_iter().zip(&volume.areas_m2) {
            let found_n = tissue.point(point).spring_n;
            (largest_n, sum_n) = (largest_n.max(found_n.length()), sum_n + found_n);
            apart_n = apart_n.max(found_n.distance(pressure_pa * *area));
        }
        // A multistep scheme sees a displacement that is corrected by what the forces were foretold to be.
        assert!(largest_n > 1e-6 && apart_n < 1e-3 * largest_n, "{integrator}: {apart_n} of {largest_n} N");
        assert!(sum_n.length() < 1e-9 * largest_n, "{integrator}: {sum_n}");
        let stored_j = 0.5 * growth_m3(&*tissue).powi(2) * 3e3 / volume.volume_m3;
        let found_j = tissue.energy().spring_j;
        assert!((found_j / stored_j - 1.0).abs() < 2e-3, "{integrator}: {found_j} {stored_j} J");
        assert_eq!(tissue.guard_events(), 0);
    }
}

#[test]
fn what_nothing_damps_keeps_its_energy_and_what_nothing_holds_its_momentum() {
    for (integrator, within) in
        [("central", 3e-3), ("rk4", 1e-5), ("exponential2", 3e-3), ("exponential3", 1e-4), ("exponential4", 1e-5)]
    {
        let integrator = format!("stepping.integrator={integrator}");
        let free = ["damping.coefficient_n_s_per_m=0", "anchor_springs.stiffness_n_per_m=0", "sleep.tolerance=0"];
        let finely = ["stepping.precision=f64", "stepping.substeps=4", &integrator];
        let mut tissue = at_rest(&model(&ball(&[&free[..], &finely].concat())));
        tissue.push(0, poke(DVec3::new(0.05, 0.0, 0.0), DVec3::new(-0.3, 0.0, 0.1), 40.0));
        (0..50).for_each(|_| tissue.step().unwrap());
        tissue.push(0, None);
        (0..4).for_each(|_| tissue.step().unwrap());
        let state = |tissue: &dyn Tissue| {
            let energy = tissue.energy();
            let momentum: DVec3 = points(tissue).iter().map(|point| tissue.point(*point).velocity_m_per_s).sum();
            (energy.kinetic_j + energy.spring_j + energy.anchor_j, momentum)
        };
        let (before_j, momentum) = state(&*tissue);
        for _ in 0..4 {
            (0..100).for_each(|_| tissue.step().unwrap());
            let (now_j, now) = state(&*tissue);
            assert!((now_j / before_j - 1.0).abs() < within, "{integrator}: {before_j} {now_j} J");
            assert!(now.distance(momentum) < 1e-9 * momentum.length(), "{integrator}: {momentum} {now}");
        }
        assert_eq!(tissue.guard_events(), 0);
    }
}

const TIP: Tip = Tip {
    shape: TipShape::Disc,
    radius_m: 0.02,
    friction: 0.2,
    grasps: false,
    coupling: Coupling::Constraint,
    edge_m: DVec3::ZERO,
    burn_s: 0.0,
};

/// The same pressed in from above, by 10 % of its size, until all is steady.
fn pressed(stiffness_pa: &str) -> Box<dyn Tissue> {
    let stiffness = format!("volume.stiffness_pa={stiffness_pa}");
    let mut tissue =
        at_rest(&model(&ball(&[&stiffness, "damping.coefficient_n_s_per_m=0.4", "stepping.tolerance=1e-3"])));
    for step in 0..1500 {
        tissue.pose(0, DVec3::new(0.0, 0.0, 0.052 - 0.012 * (f64::from(step) / 500.0).min(1.0)), TIP);
        tissue.step().unwrap();
    }
    assert_eq!(tissue.guard_events(), 0);
    tissue
}

#[test]
fn the_stiffer_its_volume_the_better_a_pressed_ball_keeps_it_and_the_more_its_other_side_bulges() {
    let mut before: Option<(f64, f64, f64)> = None;
    for stiffness_pa in ["1", "300", "3e3", "3e4", "3e5"] {
        let tissue = pressed(stiffness_pa);
        let far = tissue.model().shape().nearest(DVec3::new(0.0, 0.0, -0.05));
        let lost = -growth_m3(&*tissue) / tissue.model().scene.volume().unwrap().volume_m3;
        let bulges_m = -tissue.point(far).displacement_m.z;
        let force_n = tissue.tool_contact(0).unwrap().force_on_tool_n.z;
        println!(
            "{stiffness_pa} Pa: {lost:.2e} lost, {:.2e} truly; {bulges_m:.2e} m, {force_n:.3} N",
            -true_growth(&*tissue)
        );
        if let Some((lost_before, bulges_before_m, force_before_n)) = before {
            assert!(lost > 0.0 && lost < lost_before, "{stiffness_pa}: {lost} {lost_before}");
            assert!(bulges_m > bulges_before_m && force_n > force_before_n, "{stiffness_pa}: {bulges_m} {force_n}");
        }
        before = Some((lost, bulges_m, force_n));
        // Terms beyond first order.
        assert!((-true_growth(&*tissue) - lost).abs() < 3e-4, "{stiffness_pa}");
    }
    assert!(before.unwrap().0 < 1e-3);
}

#[test]
fn a_force_is_felt_as_the_tangent_and_the_force_law_say_also_where_only_a_part_is_looked_at() {
    // All points notice the disc, or a part of them.
    for foundation in ["material.foundation_n_per_m3=5e5", "material.foundation_n_per_m3=8e6"] {
        let [with, without] = ["volume.stiffness_pa=1e5", "volume.stiffness_pa=1e-6"]
            .map(|stiffness| model(&gallbladder(&["stepping.tolerance=1e-3", foundation, stiffness])));
        let shape = with.shape();
        let top = shape.nearest(DVec3::new(0.02, 0.0, -0.05));
        let (at_m, outward) = (shape.rest_m(top), shape.normal(top));
        let tip = Tip { radius_m: 0.006, friction: 10.0, ..TIP };
        let felt_and_told_n = |model: &Arc<Model>| {
            let law = tangent::press(model, tip.radius_m, at_m, 0.0005, 7);
            for three in law.windows(3) {
                let slope = (three[2].force_n - three[0].force_n) / 0.001;
                let found = three[1].tangent.stiffness_n_per_m.z_axis.z;
                // The tangent lets the disc go aside.
                assert!((found / slope - 1.0).abs() < 0.03, "{found} {slope}");
            }
            let mut tissue = at_rest(model);
            for step in 0..1500 {
                let part = (f64::from(step) / 400.0).min(1.0);
                tissue.pose(0, at_m + (0.001 - part * 0.004) * outward, tip);
                tissue.step().unwrap();
            }
            let feel = tissue.tool_contact(0).unwrap();
            assert!((feel.surface_m.distance(at_m) - 0.003).abs() < 1e-6);
            [feel.force_on_tool_n.dot(outward), law[6].force_n]
        };
        let [with, without] = [felt_and_told_n(&with), felt_and_told_n(&without)];
        println!("{foundation}: felt and by the law {with:?} N, without a volume {without:?} N");
        // A law presses straight along the mean normal of the disc: what a volume adds is what is compared.
        let [felt, told] = [0, 1].map(|which| with[which] / without[which] - 1.0);
        assert!(felt > 0.005 && (told / felt - 1.0).abs() < 0.1, "{felt} {told}");
    }
}

#[test]
fn at_rest_it_sleeps_under_a_force_and_without_as_near_to_the_truth_as_it_should() {
    let press = |tissue: &mut dyn Tissue| {
        tissue.push(0, poke(DVec3::new(0.02, 0.0, -0.05), DVec3::new(-0.002, 0.001, 0.01), 80.0));
    };
    let (mut slept, mut awake) = (0, 0);
    let scene = gallbladder(&[]);
    let mut tissue = at_rest(&model(&scene));
    let mut truth = at_rest(&model(&gallbladder(&["sleep.tolerance=0", "stepping.precision=f64"])));
    let count = tissue.model().len();
    assert!(tissue.is_still() && count > 4 * 256, "{count}");
    [&mut tissue, &mut truth].into_iter().for_each(|tissue| press(&mut **tissue));
    let apart = |tissue: &dyn Tissue, truth: &dyn Tissue| {
        let apart = |point: &PointId| tissue.point(*point).displacement_m.distance(truth.point(*point).displacement_m);
        points(tissue).iter().map(apart).fold(0.0, f64::max)
    };
    let (mut largest_m, mut most_m) = (0.0_f64, 0.0_f64);
    for step in 0..3000 {
        if step == 1500 {
            [&mut tissue, &mut truth].into_iter().for_each(|tissue| tissue.push(0, None));
        }
        [&mut tissue, &mut truth].into_iter().for_each(|tissue| tissue.step().unwrap());
        (slept, awake) = (slept + usize::from(tissue.is_still()), awake + usize::from(tissue.awake_points() == count));
        if step % 100 == 99 {
            largest_m = largest_m.max(truth.largest_displacement_m());
            most_m = most_m.max(apart(&*tissue, &*truth));
        }
        if step == 1499 {
            assert!(tissue.is_still() && tissue.largest_displacement_m() > 1e-5, "{slept}");
            // Also the energy of what sleeps, at any number of looks.
            let (found, again, expected) = (tissue.energy(), tissue.energy(), truth.energy());
            assert_eq!(found, again);
            assert!((found.spring_j / expected.spring_j - 1.0).abs() < 1e-3, "{found:?} {expected:?}");
        }
    }
    println!("{slept} steps asleep, {awake} all awake; {:.1e} apart", most_m / largest_m);
    assert!(tissue.is_still() && slept > 1000, "{slept}");
    assert!(most_m < 1e-4 * largest_m, "{most_m} of {largest_m}");
    let (hash, steps) = (tissue.state_hash(), tissue.substeps_done());
    tissue.step().unwrap();
    assert_eq!((tissue.state_hash(), tissue.awake_points()), (hash, 0));
    assert!(tissue.substeps_done() > steps && tissue.guard_events() == 0);
}

#[test]
fn the_bits_are_the_same_at_every_width_and_a_copy_has_them() {
    for format in [
        ["stepping.precision=f32", "stepping.integrator=central"],
        ["stepping.precision=f64", "stepping.integrator=rk4"],
        ["stepping.precision=compensated", "stepping.integrator=exponential3"],
    ] {
        let mut hashes = Vec::new();
        for lanes in ["plain", "neon", "avx2", "avx512"] {
            let lanes = format!("stepping.lanes={lanes}");
            let sets = [&format[..], &[&lanes, "stepping.substeps=8", "sleep.tolerance=1e-4"]].concat();
            let Ok(model) = Model::compile(&gallbladder(&sets), &Limits::default()) else { continue };
            let mut tissue = at_rest(&model);
            tissue.push(0, poke(DVec3::new(0.02, 0.0, -0.05), DVec3::new(-0.002, 0.001, 0.01), 80.0));
            for step in 0..30 {
                let away_m = 0.003 * f64::from(step) / 30.0;
                tissue.pose(1, DVec3::new(0.0, 0.03 - away_m, -0.05), Tip { radius_m: 0.004, ..TIP });
                tissue.step().unwrap();
            }
            let copy = tissue.copy();
            assert!(model.points().all(|point| copy.point(point) == tissue.point(point)));
            hashes.push((tissue.state_hash(), format!("{:?}", tissue.energy())));
        }
        hashes.dedup();
        assert_eq!(hashes.len(), 1, "{format:?}: {hashes:?}");
    }
}

#[test]
fn an_audit_in_f64_finds_the_error_within_the_tolerance_also_of_what_sleeps() {
    for scene in [ball(&[]), gallbladder(&[])] {
        let text = "duration_s = 0.6\nsample_every_s = 0.1\n[[force]]\nvertex = 40\nforce_n = [-0.004, 0.002, 0.01]\n\
                    falloff_per_m = 60.0\nfalloff_offset = 0.0\nprofile = { type = \"pulse\", on_s = 0.05, off_s = 0.3 }\n";
        let (script, limits) = (common::script(text, &scene), Limits::default());
        let mut output = Vec::new();
        let summary = run(
            &model(&scene),
            &script,
            RunOptions { audit: true, ..Default::default() },
            &limits,
            &mut output,
            &|| 0.0,
            &mut |_| {},
        )
        .unwrap();
        let found = summary.audited_error.unwrap();
        println!("{found:?}, {:e} asked for", scene.stepping.tolerance);
        assert!(found.largest() <= scene.stepping.tolerance, "{}: {found:?}", scene.name);
    }
}

#[test]
fn its_stiffness_changes_under_way_and_other_tissue_gets_none() {
    let (limits, softer) = (Limits::default(), |stiffness_pa: f64| Change {
        volume_stiffness_pa: Some(stiffness_pa),
        ..Change::default()
    });
    let damped = "damping.coefficient_n_s_per_m=0.4";
    let first = model(&ball(&["stepping.integrator=exponential3", damped]));
    let mut tissue = at_rest(&first);
    tissue.push(0, poke(DVec3::new(0.05, 0.0, 0.0), DVec3::new(-0.2, 0.0, 0.1), 40.0));
    (0..600).for_each(|_| tissue.step().unwrap());
    let mut grown = vec![growth_m3(&*tissue)];
    for stiffness_pa in [1e3, 0.0, 2e4] {
        let next = tissue.model().changed(&softer(stiffness_pa), &first.scene, &limits).unwrap();
        let before = points(&*tissue).iter().map(|point| tissue.point(*point)).collect::<Vec<_>>();
        tissue.change(&next);
        for (point, before) in points(&*tissue).into_iter().zip(before) {
            let now = tissue.point(point);
            assert!(now.displacement_m.distance(before.displacement_m) < 1e-6);
            assert!(now.velocity_m_per_s.distance(before.velocity_m_per_s) < 1e-4);
        }
        (0..600).for_each(|_| tissue.step().unwrap());
        grown.push(growth_m3(&*tissue));
    }
    // At last as before the changes.
    assert!(grown[0] < 0.0 && grown[1] < 2.0 * grown[0] && grown[2] < 1.05 * grown[1], "{grown:?}");
    assert!((grown[3] / grown[0] - 1.0).abs() < 0.05, "{grown:?}");
    assert_eq!(tissue.guard_events(), 0);
    // The guard's last resort.
    tissue.recover(tissue.step_count(), false);
    tissue.step().unwrap();
    let refused = model(&common::scene(palpate_tissue::scene::PAPER)).changed(&softer(5.0), &first.scene, &limits);
    let refused = refused.unwrap_err();
    assert_eq!((refused.reason, refused.field.as_str()), (Reason::WrongKind, "volume.stiffness_pa"));
    for bad in [-1.0, f64::NAN, 1e13] {
        assert_eq!(first.changed(&softer(bad), &first.scene, &limits).unwrap_err().field, "volume.stiffness_pa");
    }
}

#[test]
fn a_scene_that_encloses_nothing_or_says_it_wrongly_is_refused_with_its_line() {
    let parse = |text: String| {
        let folder = format!("{}/tests/reference", env!("CARGO_MANIFEST_DIR"));
        Scene::parse_in(Path::new(&folder), "ball", &text, &[], &Limits::default()).unwrap_err().to_string()
    };
    let coefficients = "[springs]\nstiffness_n_per_m = 10.0\n[anchor_springs]\nstiffness_n_per_m = 5.0\n[damping]\n\
                        coefficient_n_s_per_m = 0.1\n";
    let mesh = "[mesh]\nfile = \"icosphere.obj\"\nunit = \"m\"\npoint_mass_kg = 0.01\n";
    let colon = "[mesh]\norgan = { name = \"colon\", edge_m = 0.005 }\npoint_mass_kg = 0.01\n";
    let sheet = "[sheet]\npoints = [3, 3]\nspacing_m = 0.1\npoint_mass_kg = 0.01\n";
    for (body, volume, words) in [
        (mesh, "stiffness_pa = 0.0", "above 0"),
        (mesh, "stiffness_pa = inf", "volume.stiffness_pa"),
        (mesh, "stiffness_pa = 1e13", "1e12"),
        (mesh, "", "stiffness_pa"),
        (mesh, "stiffness_pa = 1.0\nmodulus = 2.0", "modulus"),
        (colon, "stiffness_pa = 1e3", "needs a closed mesh"),
        (sheet, "stiffness_pa = 1e3", "is for a closed mesh"),
    ] {
        let refused = parse(format!("{body}{coefficients}[volume]\n{volume}\n"));
        assert!(refused.contains(words) && refused.contains("volume"), "{refused}");
    }
    // So stiff that no limit of substeps suffices: what decides is named.
    let limits = Limits { substeps: 100, ..Limits::default() };
    let refused = Model::compile(&ball(&["volume.stiffness_pa=1e12"]), &limits).unwrap_err();
    assert!(refused.message.contains("volume.stiffness_pa most of all"), "{refused}");
}
