//! Tests of the guard: what it checks, and what follows when a check fails.
#![allow(clippy::unwrap_used)]
use crate::shape::PointName;
use glam::DVec3;

use super::*;
use crate::scene::profile::Poke;
use crate::scene::{Integrator, Named};
use crate::scheme::Scheme;
use crate::shape::PointId;
use crate::{Push, Tissue};
use palpate_haptics::Tip;

/// The names of all schemes.
fn schemes() -> impl Iterator<Item = &'static str> {
    Integrator::of_anchored().map(Named::name)
}

fn sheet(integrator: &str) -> TissueState<f64> {
    sheet_with(integrator, &[])
}

fn sheet_with(integrator: &str, more: &[&str]) -> TissueState<f64> {
    let integrator = format!("stepping.integrator={integrator}");
    let format = ["stepping.substeps=4", "stepping.precision=f64", "sheet.points=[7, 9]", "sleep.tolerance=0.0"];
    let model = Model::paper(&[&[integrator.as_str()], &format[..], more].concat());
    let (scene, mut sheet) = (&model.scene, TissueState::new(&model));
    sheet.push(
        0,
        Some(Push::Constant(Poke {
            point: None,
            centre_m: scene.sheet().unwrap().spacing_m * DVec3::new(3.0, 4.0, 0.0),
            force_n: DVec3::new(0.1, -0.2, -1.0),
            falloff_per_m: 0.7 / scene.sheet().unwrap().spacing_m,
            falloff_offset: 0.0,
        })),
    );
    (0..40).for_each(|_| sheet.step().unwrap());
    sheet
}

/// Largest difference of displacements and of velocities, each as a fraction of the largest.
fn apart(a: &TissueState<f64>, b: &TissueState<f64>) -> [f64; 2] {
    let (mut most, mut largest) = ([0.0_f64; 2], [0.0_f64; 2]);
    for index in 0..a.model.len() {
        let [p, q] = [a, b].map(|sheet| sheet.point(PointId::new(index)));
        let pairs = [(p.displacement_m, q.displacement_m), (p.velocity_m_per_s, q.velocity_m_per_s)];
        for (which, (p, q)) in pairs.into_iter().enumerate() {
            most[which] = most[which].max(p.distance(q));
            largest[which] = largest[which].max(p.length());
        }
    }
    [most[0] / largest[0], most[1] / largest[1]]
}

#[test]
fn half_the_substep_shows_the_same_state_and_goes_on_the_same_way() {
    for integrator in schemes() {
        // A history is interpolated; what has none continues as it is, but for the scheme's own error.
        let within = match integrator {
            "rk4" => 1e-7,
            "exponential3" => 1e-4,
            "exponential4" => 1e-5,
            _ => 1e-3,
        };
        let (mut as_it_was, mut halved) = (sheet(integrator), sheet(integrator));
        halved.halve(0, 1);
        let now = apart(&as_it_was, &halved);
        assert!(now[0] < 1e-9 && now[1] < within, "{integrator}: {now:?}");
        (0..40).for_each(|_| [&mut as_it_was, &mut halved].into_iter().for_each(|sheet| sheet.step().unwrap()));
        let later = apart(&as_it_was, &halved);
        assert!(later.iter().all(|part| *part < within), "{integrator}, later: {later:?}");
        assert!(halved.guard_events() == 0 && as_it_was.guard_events() == 0);
    }
}

#[test]
fn central_differences_show_the_same_velocity_with_half_the_substep_to_the_last_digits() {
    let (as_it_was, mut halved) = (sheet("central"), sheet("central"));
    halved.halve(0, 1);
    let now = apart(&as_it_was, &halved);
    assert!(now.iter().all(|part| *part < 1e-9), "{now:?}");
}

#[test]
fn grasps_that_hold_still_beside_each_other_do_nothing() {
    for integrator in schemes() {
        let model = Model::paper(&[&format!("stepping.integrator={integrator}"), "stepping.substeps=7"]);
        let mut sheet = crate::at_rest(&model);
        let tip = Tip { grasps: true, ..Tip::default() };
        for tool in 0..16 {
            let (y_m, x_m) = (0.1 * f64::from(tool)).sin_cos();
            sheet.pose(tool as usize, DVec3::new(0.07 + 0.01 * x_m, 0.07 + 0.01 * y_m, -0.004), tip);
        }
        (0..400).for_each(|step| assert!(sheet.step().is_ok(), "{integrator}, {step}"));
        assert_eq!(sheet.guard_events(), 0, "{integrator}");
        let energy = sheet.energy();
        let energy_j = energy.kinetic_j + energy.spring_j + energy.anchor_j;
        assert!(energy_j < 1e-27, "{integrator}: {energy_j} J");
    }
}

#[test]
fn what_the_tools_do_is_what_the_sheet_has() {
    // Without damping `lagged` is `central`.
    for integrator in schemes() {
        let undamped = ["damping.coefficient_n_s_per_m=0.0"];
        let mut sheet = sheet_with(integrator, &undamped);
        let (survey, energy, energy_j) = sheet.survey(&sheet.tiles.region);
        let work_j = sheet.work.done_j - sheet.present_work_j(&survey);
        assert!((work_j - energy_j).abs() < 0.02 * energy_j, "{integrator}: {work_j} J, {energy_j} J");
        let mass_kg = sheet.model.scene.sheet().unwrap().point_mass_kg;
        let points = (0..sheet.model.len()).map(|index| sheet.point(PointId::new(index)));
        let kinetic_j: f64 = points.map(|point| 0.5 * mass_kg * point.velocity_m_per_s.length_squared()).sum();
        assert!((energy.kinetic_j - kinetic_j).abs() < 1e-9 * kinetic_j, "{integrator}: {energy:?} {kinetic_j}");
        // And continues like this.
        (0..20).for_each(|_| sheet.step().unwrap());
        assert_eq!(sheet.guard_events(), 0);
    }
}

#[test]
fn a_repetition_that_stops_at_each_step_fails_and_mends_as_one_that_does_not() {
    let sets = ["stepping.substeps=1", "springs.stiffness_n_per_m=100000"];
    let model = Model::paper(&[&["sheet.points=[9, 9]", "stepping.integrator=central"][..], &sets].concat());
    let (mut whole, mut parts) = (TissueState::<f32>::new(&model), TissueState::<f32>::new(&model));
    let mut stops = 0;
    for step in 0..300 {
        let place_m = DVec3::new(0.13, 0.13, 0.01 - 1e-3 * f64::from(step));
        for sheet in [&mut whole, &mut parts] {
            sheet.pose(0, place_m, Tip { radius_m: 0.03, ..Default::default() });
        }
        let done = whole.step();
        let done_in_parts = loop {
            match parts.step_while(&mut || false) {
                Ok(false) => stops += 1,
                done => break done.map(drop),
            }
        };
        assert_eq!(done, done_in_parts, "{step}");
        assert_eq!((whole.steps, whole.guard_events), (parts.steps, parts.guard_events), "{step}");
        assert_eq!(whole.state_hash(), parts.state_hash(), "{step}");
        if let Err(blow_up) = done {
            [&mut whole, &mut parts].into_iter().for_each(|sheet| drop(sheet.recover(blow_up.step, false)));
        }
    }
    assert!(stops > 20 && whole.guard_events > 0, "{stops} stops, {} events", whole.guard_events);
}

#[test]
fn a_repetition_that_fails_leaves_no_inputs_behind() {
    // Three halvings are needed: the first repetitions fail as well.
    let sets = ["stepping.substeps=1", "springs.stiffness_n_per_m=100000"];
    let model = Model::paper(&[&["sheet.points=[9, 9]", "stepping.integrator=central"][..], &sets].concat());
    let mut sheet = TissueState::<f32>::new(&model);
    let place_m = |step: u32| DVec3::new(0.13, 0.13, 0.01 - 1e-3 * f64::from(step));
    let mut mended = 0;
    for step in 0..120 {
        sheet.pose(0, place_m(step), palpate_haptics::Tip { radius_m: 0.03, ..Default::default() });
        sheet.step().unwrap();
        let from = sheet.checkpoint.as_ref().unwrap().steps;
        let inputs: Vec<u64> = sheet.inputs.iter().map(|input| input.0).collect();
        assert_eq!(inputs, (from..sheet.steps).collect::<Vec<_>>(), "step {step}");
        mended = mended.max(sheet.halvings);
    }
    assert!(mended >= 3, "{mended} halvings");
}

#[test]
fn a_checkpoint_is_taken_every_256_substeps() {
    let mut sheet = sheet("exponential2");
    (40..130).for_each(|_| sheet.step().unwrap());
    assert_eq!(sheet.checkpoint.as_ref().unwrap().steps, 128);
}

#[test]
fn a_point_that_is_not_finite_or_beyond_the_bound_is_named() {
    for broken in [f64::NAN, f64::INFINITY, 2.0 * farthest_in_spacings(&sheet("central").model)] {
        let mut sheet = sheet("central");
        let layout = sheet.tables.layout;
        assert_eq!(broken_point(&sheet.model, &layout, &sheet.state), None);
        let index = sheet.model.index_of([2, 5]);
        sheet.state.u[layout.plane + layout.offset(index)] = broken;
        assert_eq!(broken_point(&sheet.model, &layout, &sheet.state), Some(index));
        // A survey is due at step 64.
        sheet.steps = 64;
        assert_eq!(sheet.check(), Err(CheckFailure::NotFinite { point: PointName::Point([2, 5]) }), "{broken}");
    }
}

#[test]
fn increments_that_are_finite_and_below_the_bound_are_calm() {
    let farthest = farthest_in_spacings(&sheet("central").model);
    for (increment, settled) in [(1e-3, true), (0.1 * farthest, true), (10.0 * farthest, false), (f64::NAN, false)] {
        let mut sheet = sheet_with("central", &["springs.stiffness_n_per_m=0.0"]);
        let offset = sheet.tables.layout.offset(11);
        sheet.tables.is_settled(0.0);
        sheet.state.d[offset] = increment;
        sheet.do_step();
        assert_eq!(sheet.tables.is_settled(farthest), settled, "{increment}");
    }
}

#[test]
fn a_force_far_from_what_its_history_foretold_is_found() {
    for integrator in schemes().filter(|name| name.starts_with("exponential")) {
        let mut sheet = sheet(integrator);
        sheet.steps = 64;
        let weight = match &sheet.plan.scheme {
            Scheme::Exponential2(multistep) => multistep.correction[0] * multistep.extrapolation[0],
            Scheme::Exponential3(multistep) => multistep.correction[0] * multistep.extrapolation[0],
            Scheme::Exponential4(multistep) => multistep.correction[0] * multistep.extrapolation[0],
            _ => panic!("{integrator} is a multistep scheme"),
        };
        // A force of the past that moves the point by 5 spacings.
        let past = 5.0 / weight;
        let offset = sheet.tables.layout.offset(31);
        Arc::make_mut(&mut sheet.state.kept[0])[offset] += past;
        assert!(matches!(sheet.check(), Err(CheckFailure::Prediction { .. })), "{integrator}");
    }
}
