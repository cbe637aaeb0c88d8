//! Tests of what may sleep.
#![allow(clippy::unwrap_used)]
use crate::shape::PointId;
use glam::DVec3;

use std::sync::Arc;

use super::*;
use crate::body::severed::Cuts;
use crate::body::window::{Window, half_window_m};
use crate::limits::Limits;
use crate::response::tangent::LinearPatch;
use crate::scene::profile::Poke;
use crate::scene::{Body, Mesh, PerNodeFactors};
use crate::scheme::Relaxation;
use crate::shape;
use crate::state::sleep::tiles::CHECK_STEPS;
use crate::{Footprint, Grasp, Model, Push, Tissue};

fn pushed<T: Real>(sets: &[&str], falloff_per_m: f64) -> TissueState<T> {
    let always = ["stepping.integrator=central", "stepping.substeps=1"];
    let model = Model::paper(&[&always[..], sets].concat());
    let mut sheet = TissueState::new(&model);
    let centre_m = model.scene.sheet().unwrap().spacing_m * DVec3::new(1.0, 1.0, 0.0);
    let force_n = DVec3::new(0.0, 0.0, -1.0);
    sheet.push(0, Some(Push::Constant(Poke { point: None, centre_m, force_n, falloff_per_m, falloff_offset: 0.0 })));
    sheet
}

#[test]
fn a_force_moves_its_centre_no_less_than_if_all_springs_held_it() {
    let mut sheet = pushed::<f64>(&["sheet.points=[20, 20]", "stepping.precision=f64"], 1000.0);
    sheet.step().unwrap();
    // The fastest vibration of a sheet without bending springs is as stiff as 12 k + K″ (`stability`).
    let expected_m = 1.0 / (12.0 * 10.0 + 5.0);
    let found_m = sheet.tiles.largest * sheet.model.scene.sheet().unwrap().spacing_m;
    assert!((found_m - expected_m).abs() < 1e-9, "{found_m} {expected_m}");
}

#[test]
fn a_sheet_falls_asleep_under_a_force_as_soon_as_its_format_can_tell_no_difference() {
    // Overdamped: it creeps until the increment is less than half the last digit.
    let overdamped = ["damping.coefficient_n_s_per_m=50.0", "anchor_springs.stiffness_n_per_m=500.0"];
    let small = ["springs.stiffness_n_per_m=0.0", "sheet.points=[3, 3]", "stepping.precision=f32"];
    let mut sheet = pushed::<f32>(&[&overdamped[..], &small, &["sleep.tolerance=1e-9"]].concat(), 0.0);
    for _ in 0..1000 {
        sheet.step().unwrap();
    }
    assert!(!sheet.is_still());
    for _ in 0..2000 {
        sheet.step().unwrap();
    }
    assert!(sheet.is_still());
    let z_m = sheet.point(PointId::new(4)).displacement_m.z;
    assert!((z_m + 1.0 / 500.0).abs() < 1e-5 / 500.0, "{z_m}");
}

#[test]
fn a_grasped_point_counts_among_the_displacements_that_a_sleeping_tile_is_measured_by() {
    // Nothing else moves: the tools' points are seen wherever they are.
    let sets = ["sheet.points=[20, 20]", "stepping.precision=f64", "springs.stiffness_n_per_m=0.0"];
    let sets = [&sets[..], &["stepping.integrator=central", "stepping.substeps=1"]].concat();
    let model = Model::paper(&sets);
    for [i, j] in [[3, 5], [7, 11], [12, 14], [18, 9]] {
        let mut sheet = TissueState::<f64>::new(&model);
        let point = model.scene.sheet().unwrap().point([i, j]);
        sheet.grasp(0, point, Grasp::Target(DVec3::new(0.0, 0.03, -0.04)));
        while sheet.steps == 0 || !sheet.steps.is_multiple_of(CHECK_STEPS) {
            sheet.step().unwrap();
        }
        let found_m = sheet.tiles.largest * model.unit_m;
        assert!((0.045..0.055).contains(&found_m), "{i} {j}: {found_m} m");
    }
}

/// The half of a gallbladder with x above `free_above_m` (m) has no anchors.
fn half_anchored(sets: &[&str], free_above_m: f64) -> Arc<Model> {
    let mut scene = Model::gallbladder(sets).scene.clone();
    let Body::Mesh(mesh) = &scene.body else { panic!("of another kind") };
    let is_free = |point: PointId| mesh.shape.vertices_m()[point.index()].x > free_above_m;
    let extra = |point: PointId| if is_free(point) { -1.0 } else { 0.0 };
    let extra_anchor: Vec<f64> = shape::points(&*mesh.shape).map(extra).collect();
    let differences = PerNodeFactors { extra_anchor, ..(*mesh.differences).clone() };
    scene.body = Body::Mesh(Mesh::uneven(mesh.point_mass_kg, mesh.bending, mesh.shape.clone(), differences));
    Model::compile(&scene, &Limits::default()).unwrap()
}

/// A force on the point nearest to a place, which is 0 beyond some millimetres.
fn narrow(model: &Model, place_m: DVec3) -> (PointId, Push) {
    let point = model.shape().nearest(place_m);
    let (centre_m, force_n) = (model.shape().rest_m(point), -0.02 * model.shape().normal(point));
    let poke = Poke { point: None, centre_m, force_n, falloff_per_m: 1e5, falloff_offset: 0.0 };
    (point, Push::Constant(poke))
}

#[test]
fn a_tissue_some_of_whose_points_have_no_anchor_sleeps_wakes_and_tells_its_reach() {
    let sets = ["stepping.integrator=exponential3", "stepping.precision=f64", "sleep.tolerance=1e-3"];
    let model = half_anchored(&sets, 0.0);
    let (free, anchored): (Vec<PointId>, Vec<PointId>) =
        model.points().partition(|point| model.anchor_stiffness_n_per_m(*point) == 0.0);
    assert!(free.len() > 50 && anchored.len() > 50, "{} {}", free.len(), anchored.len());
    assert!(anchored.iter().all(|point| model.anchor_stiffness_n_per_m(*point) > 0.0));
    // Nothing bounds how long and how far a small force is noticed.
    let relaxation = Relaxation::of(&model.scene);
    assert!(!relaxation.is_bounded() && relaxation.rest_s(0.01).is_err());
    assert_eq!((half_window_m(&model, 0.005), relaxation.slowest_per_s()), (f64::INFINITY, 0.0));
    assert!((1..=10_000).contains(&model.window_steps()), "{}", model.window_steps());
    let top_m = model.shape().top_m();
    let footprint = Footprint::new(&model, 0.005, top_m);
    let window = Window::around(&model, &footprint);
    assert_eq!(window.len(), model.len());
    let tangent =
        LinearPatch::new(&model, &Cuts::default(), &footprint, window, vec![DVec3::ZERO; model.len()]).tangent();
    assert!(tangent.stiffness_n_per_m.is_finite() && tangent.stiffness_n_per_m.determinant() > 0.0, "{tangent:?}");
    // It sleeps until something acts on it.
    let extent = model.shape().extent();
    let mut tissue = TissueState::<f64>::new(&model);
    let mut awake = Model::clone(&model);
    awake.sleep_tolerance = 0.0;
    let mut reference = TissueState::<f64>::new(&Arc::new(awake));
    assert_eq!(tissue.awake_points(), 0);
    // First far from the free half, whose tiles it does not reach, then in its middle.
    let places_m = [extent.least_m, extent.most_m];
    for (round, place_m) in (1..).zip(places_m) {
        let (point, push) = narrow(&model, place_m);
        for tissue in [&mut tissue, &mut reference] {
            tissue.push(0, Some(push.clone()));
            (0..150).for_each(|_| tissue.step().unwrap());
        }
        assert!(tissue.awake_points() > 0, "{round}");
        let (moved, exact) = (tissue.point(point), reference.point(point));
        let error_m = moved.displacement_m.distance(exact.displacement_m);
        let largest_m = reference.largest_displacement_m();
        assert!(exact.displacement_m.length() > 0.01 * largest_m && largest_m > 0.0, "{round}: {exact:?}");
        assert!(error_m <= 1e-3 * largest_m, "{round}: {error_m} of {largest_m}");
    }
    let energy = tissue.energy();
    assert!(energy.spring_j.is_finite() && energy.anchor_j.is_finite() && energy.spring_j > 0.0, "{energy:?}");
}
