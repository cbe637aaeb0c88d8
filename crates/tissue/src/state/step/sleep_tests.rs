//! Tests of what may sleep.
#![allow(clippy::unwrap_used)]
use crate::shape::PointId;
use glam::DVec3;

use super::*;
use crate::scene::profile::Poke;
use crate::state::sleep::tiles::CHECK_STEPS;
use crate::{Grasp, Model, Push, Tissue};

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
