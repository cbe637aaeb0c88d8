//! Tests of tears: at which strain they begin, and which springs go.
#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use glam::DVec3;

use crate::compile::square_of_triangles;
use crate::interface::Tissue;
use crate::limits::Limits;
use crate::scene::Scene;
use crate::scene::profile::{MotionProfile, Move};
use crate::shape::PointId;
use crate::state::cutting::faces::tests::cube_of;
use crate::{Grasp, Model, at_rest, restored};

/// The side of a square, m, and the strain to which it is led.
const SIDE_M: f64 = 0.08;
const LED: f64 = 0.15;

/// How long the square is led, s.
const LED_S: f64 = 2.0;

/// Returns a square of `cells` cells a side: a sheet, or a surface of triangles; `bends`: with springs that resist bending.
fn square(kind: &str, cells: u32, bends: bool, more: &str) -> Arc<Model> {
    let spacing_m = SIDE_M / f64::from(cells);
    let mass_kg = 1e-4 * (8.0 / f64::from(cells)).powi(2);
    let both = format!(
        "[damping]\ncoefficient_n_s_per_m = {:?}\n[anchor_springs]\nstiffness_n_per_m = 0\n\
         [stepping]\nintegrator = \"exponential2\"\nprecision = \"f64\"\ntolerance = 1e-3\n{more}",
        200.0 * mass_kg
    );
    if kind == "sheet" {
        let text = format!(
            "[sheet]\npoints = [{0}, {0}]\nspacing_m = {spacing_m:?}\npoint_mass_kg = {mass_kg:?}\nfixed = []\n\
             [springs]\nstiffness_n_per_m = 100\nshear_stiffness_n_per_m = 50\nbending = {bends}\n{both}",
            cells + 1
        );
        return Model::parse("square", &text, &[]).unwrap();
    }
    let mesh = square_of_triangles([cells; 2], spacing_m);
    let text = format!(
        "[mesh]\nfile = \"square.obj\"\nunit = \"m\"\npoint_mass_kg = {mass_kg:?}\n\
         [springs]\nstiffness_n_per_m = 100\nbending = {}\n{both}",
        if bends { 0.1 } else { 0.0 }
    );
    let scene = Scene::parse_given("square", &text, ("square.obj", mesh.as_bytes()), &Limits::default()).unwrap();
    Model::compile(&scene, &Limits::default()).unwrap()
}

/// Leads the rim of a square as an even stretch along x leads it, so that all of it is stretched evenly.
fn stretch(model: &Model, tissue: &mut dyn Tissue) {
    let size_m = model.shape().extent().most_m;
    let is_rim = |point: PointId| {
        let at_m = model.shape().rest_m(point);
        [at_m.x, at_m.y].iter().any(|at_m| *at_m < 1e-9) || (at_m - size_m).truncate().abs().min_element() < 1e-9
    };
    for (tool, point) in model.points().filter(|point| is_rim(*point)).enumerate() {
        let by_m = LED * model.shape().rest_m(point).x * DVec3::X;
        let moves = vec![Move { from_s: 0.0, to_s: LED_S, by_m }];
        tissue.grasp(tool, point, Grasp::Profile(MotionProfile { point, moves }));
    }
}

/// Returns the strain at a time, s.
fn strain(time_s: f64) -> f64 {
    let x = time_s / LED_S;
    LED * x * x * x * (10.0 + x * (6.0 * x - 15.0))
}

#[test]
fn a_tear_starts_at_the_stated_strain_whatever_the_mesh() {
    for kind in ["sheet", "surface"] {
        for (cells, more, expected) in [
            (8, "[cutting]\ntear_strain = 0.1\n", 0.1),
            (12, "[cutting]\ntear_strain = 0.1\n", 0.1),
            (18, "[cutting]\ntear_strain = 0.1\n", 0.1),
            (12, "[cutting]\ntear_strain = 0.07\ntear_reference_m = 0.01\n", 0.07 * 1.5_f64.sqrt()),
            (18, "[cutting]\ntear_strain = 0.07\ntear_reference_m = 0.01\n", 0.07 * 1.5),
        ] {
            // At a rim, springs that resist bending would pull unevenly.
            let model = square(kind, cells, false, more);
            let mut tissue = at_rest(&model);
            stretch(&model, &mut *tissue);
            while tissue.cuts().is_empty() && tissue.step_count() < 2000 {
                tissue.step().unwrap();
            }
            let began = strain(tissue.step_count() as f64 * 1e-3);
            assert!((began / expected - 1.0).abs() < 0.02, "{kind} {cells}: {began}, not {expected}");
            let joints = tissue.cuts().joints(&model);
            for joint in &joints {
                let [a_m, b_m] = joint.points.map(|point| model.shape().rest_m(point));
                assert!((b_m - a_m).x.abs() > 1e-9 && joint.part == 0.5, "{kind}: {a_m} {b_m}");
            }
            assert_eq!(tissue.cuts().version(), 1);
        }
    }
}

/// Stretches a cube of cells by the part `LED` along z until `LED_S`, by the points of its rim.
fn stretch_cube(model: &Model, side_m: f64, tissue: &mut dyn Tissue) {
    let is_rim = |at_m: DVec3| at_m.min_element() < 1e-9 || at_m.max_element() > side_m - 1e-9;
    let rim = model.points().filter(|point| is_rim(model.shape().rest_m(*point)) && !model.shape().is_fixed(*point));
    for (tool, point) in rim.enumerate() {
        let by_m = LED * model.shape().rest_m(point).z * DVec3::Z;
        let moves = vec![Move { from_s: 0.0, to_s: LED_S, by_m }];
        tissue.grasp(tool, point, Grasp::Profile(MotionProfile { point, moves }));
    }
}

#[test]
fn the_strain_around_a_place_is_that_of_an_even_stretch_in_each_kind_of_tissue() {
    let side_m = 0.016;
    for (kind, model) in [
        ("sheet", square("sheet", 8, false, "")),
        ("surface", square("surface", 8, false, "")),
        ("solid", cube_of(4, side_m / 4.0, &[])),
    ] {
        let mut tissue = at_rest(&model);
        match kind {
            "solid" => stretch_cube(&model, side_m, &mut *tissue),
            _ => stretch(&model, &mut *tissue),
        }
        let middle_m = model.shape().extent().middle_m();
        let reach_m = 2.0 * model.shape().edge_m();
        assert_eq!(tissue.strain_around(middle_m, reach_m), 0.0, "{kind}");
        let steps = (0.5 * LED_S * model.scene.stepping.rate_hz) as u64;
        (0..steps).for_each(|_| tissue.step().unwrap());
        let (found, expected) = (tissue.strain_around(middle_m, reach_m), strain(0.5 * LED_S));
        // Near the led rim: the middle follows a little later.
        let at_rim = tissue.strain_around(DVec3::ZERO, reach_m);
        println!("{kind}: {found:.6} in the middle, {at_rim:.6} at the rim, {expected:.6} expected");
        assert!((found / expected - 1.0).abs() < 0.01, "{kind}: {found} instead of {expected}");
        while tissue.step_count() < (1.25 * LED_S * model.scene.stepping.rate_hz) as u64 {
            tissue.step().unwrap();
        }
        let rested = tissue.strain_around(middle_m, reach_m);
        assert!((rested - LED).abs() < 1e-3 * LED, "{kind}: {rested} instead of {LED}");
    }
}

#[test]
fn a_tear_in_a_solid_starts_at_the_stated_strain_whatever_the_size_of_its_cells() {
    let side_m = 0.016;
    for (cells, limit, reference) in [(4_u32, 0.1, None), (6, 0.1, None), (8, 0.1, None), (8, 0.05, Some(0.008))] {
        let edge_m = side_m / f64::from(cells);
        let mut sets = vec![format!("cutting.tear_strain={limit}")];
        sets.extend(reference.map(|edge_m: f64| format!("cutting.tear_reference_m={edge_m}")));
        let model = cube_of(cells as usize, edge_m, &sets.iter().map(String::as_str).collect::<Vec<_>>());
        let mut tissue = at_rest(&model);
        stretch_cube(&model, side_m, &mut *tissue);
        let rate_hz = model.scene.stepping.rate_hz;
        while tissue.cuts().is_empty() && tissue.step_count() < (LED_S * rate_hz) as u64 {
            tissue.step().unwrap();
        }
        let began = strain(tissue.step_count() as f64 / rate_hz);
        println!("{cells}³ cells, {limit}: {began:.4}");
        assert!((began / 0.1 - 1.0).abs() < 0.02, "{cells} {limit}: {began}");
        let along_z = |joint: &crate::SeveredJoint| {
            let [a_m, b_m] = joint.points.map(|point| model.shape().rest_m(point));
            (b_m - a_m).distance(edge_m * DVec3::Z) < 1e-9
        };
        assert!(tissue.cuts().joints(&model).iter().all(along_z), "{cells}");
    }
}

#[test]
fn a_tissue_without_a_limit_does_not_tear_and_one_under_pretension_counts_from_its_shape_at_rest() {
    let model = square("sheet", 8, true, "");
    let mut tissue = at_rest(&model);
    stretch(&model, &mut *tissue);
    (0..2000).for_each(|_| tissue.step().unwrap());
    assert!(tissue.cuts().is_empty());
    let text = "[sheet]\npoints = [9, 9]\nspacing_m = 0.01\npoint_mass_kg = 1e-4\nfixed = []\n\
                [springs]\nstiffness_n_per_m = 100\npretension_n_per_m = 4\n[damping]\ncoefficient_n_s_per_m = 0.04\n\
                [anchor_springs]\nstiffness_n_per_m = 0\n[stepping]\nintegrator = \"exponential2\"\nprecision = \"f64\"\n\
                tolerance = 1e-3\n[cutting]\ntear_strain = 0.1\n";
    let model = Model::parse("tense", text, &[]).unwrap();
    assert!(model.prestrain > 0.01);
    let mut tissue = at_rest(&model);
    stretch(&model, &mut *tissue);
    while tissue.cuts().is_empty() && tissue.step_count() < 2000 {
        tissue.step().unwrap();
    }
    let began = strain(tissue.step_count() as f64 * 1e-3);
    assert!((began / 0.1 - 1.0).abs() < 0.02, "{began}");
}

#[test]
fn a_tear_runs_through_and_has_the_same_bits_at_every_width_and_after_a_snapshot() {
    for kind in ["sheet", "surface"] {
        let mut hashes = Vec::new();
        for lanes in ["plain", "auto"] {
            let more = format!("lanes = \"{lanes}\"\n[cutting]\ntear_strain = 0.08\n");
            let model = square(kind, 8, true, &more);
            let mut tissue = at_rest(&model);
            stretch(&model, &mut *tissue);
            while tissue.cuts().is_empty() {
                tissue.step().unwrap();
            }
            (0..3).for_each(|_| tissue.step().unwrap());
            let saved = tissue.save().plain();
            let mut again = restored(&model, &saved.parts, &saved.values, &Limits::default()).unwrap();
            for _ in 0..600 {
                tissue.step().unwrap();
                again.step().unwrap();
            }
            assert_eq!(again.state_hash(), tissue.state_hash(), "{kind} {lanes}");
            assert_eq!(again.cuts().joints(&model), tissue.cuts().joints(&model), "{kind} {lanes}");
            assert!(tissue.cuts().len() > 20 && tissue.guard_events() == 0, "{kind}: {}", tissue.guard_events());
            hashes.push(tissue.state_hash());
        }
        assert_eq!(hashes[0], hashes[1], "{kind}");
    }
}

#[test]
fn in_a_step_only_the_most_strained_spring_of_each_point_tears() {
    let model = square("sheet", 8, true, "[cutting]\ntear_strain = 0.05\n");
    let mut tissue = at_rest(&model);
    stretch(&model, &mut *tissue);
    let mut before = 0;
    for _ in 0..1500 {
        tissue.step().unwrap();
        let joints = tissue.cuts().joints(&model);
        let mut ends: Vec<PointId> = Vec::new();
        for joint in &joints[before..] {
            let [a_m, b_m] = joint.points.map(|point| model.shape().rest_m(point));
            // Springs that resist bending go with what they span.
            if a_m.distance(b_m) < 0.015 {
                ends.extend(joint.points);
            }
        }
        let count = ends.len();
        ends.sort_unstable();
        ends.dedup();
        assert_eq!(ends.len(), count);
        before = joints.len();
    }
    assert!(before > 8, "{before}");
}
