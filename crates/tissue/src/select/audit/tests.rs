//! Tests of windows, and of tissues that continue from a checkpoint.
#![allow(clippy::unwrap_used)]

use glam::DVec3;

use super::*;
use crate::scene::profile::Poke;
use crate::state::tissue_state::TissueState;
use crate::{Push, Tissue};

#[test]
fn a_window_lasts_until_the_slowest_vibration_has_lost_half() {
    // m = 0.01 kg; γ = C/2m, overdamped (C − √(C² − 4mK))/2m.
    for (damping, stiffness, window_s) in [
        (0.5, 50.0, 2.0_f64.ln() / 25.0),
        (0.2, 1.0, 2.0_f64.ln() / 10.0),
        (1.0, 5.0, 2.0_f64.ln() / (50.0 - 2000.0_f64.sqrt())),
        (1.0, 0.0, LONGEST_S),
        (0.0, 5.0, LONGEST_S),
        (1e-3, 5.0, LONGEST_S),
    ] {
        let damped = format!("damping.coefficient_n_s_per_m={damping}");
        let held = format!("anchor_springs.stiffness_n_per_m={stiffness}");
        let stepping = ["stepping.rate_hz=2000", "stepping.integrator=exponential3", "stepping.precision=f64"];
        let sets = [&damped, &held, "sheet.points=[3, 3]"];
        let steps = Model::paper(&[&sets[..], &stepping].concat()).window_steps();
        let expected = (2000.0 * window_s.min(LONGEST_S)).ceil();
        assert!((steps as f64 - expected).abs() <= 1.0, "{damping} {stiffness}: {steps}, not {expected}");
    }
}

/// Returns a tissue that a constant force has moved for some steps.
fn moving(sets: &[&str], steps: u64) -> TissueState<f64> {
    let always = ["stepping.integrator=exponential3", "stepping.precision=f64", "sleep.tolerance=0.0"];
    let model = Model::paper(&[&always[..], sets].concat());
    let (scene, mut sheet) = (&model.scene, TissueState::new(&model));
    sheet.push(
        0,
        Some(Push::Constant(Poke {
            point: None,
            centre_m: scene.sheet().unwrap().spacing_m * DVec3::new(2.0, 3.0, 0.0),
            force_n: DVec3::new(0.1, -0.2, -1.0),
            falloff_per_m: 0.7 / scene.sheet().unwrap().spacing_m,
            falloff_offset: 0.0,
        })),
    );
    (0..steps).for_each(|_| sheet.step().unwrap());
    sheet
}

/// Steps a tissue until it reports on the requested window.
fn next_mark(sheet: &mut TissueState<f64>) -> Mark {
    for _ in 0..1000 {
        sheet.step().unwrap();
        if let Some(mark) = sheet.take_mark() {
            return mark;
        }
    }
    panic!("no report in 1000 steps");
}

#[test]
fn a_window_begins_at_a_checkpoint_and_ends_at_the_first_one_after_its_length() {
    // Four substeps: a checkpoint every 64 steps. The window of this tissue is 51 steps long.
    let mut sheet = moving(&["sheet.points=[5, 5]", "stepping.substeps=4"], 130);
    assert_eq!(Tissue::model(&sheet).window_steps(), 51);
    sheet.request_audit(WindowInputs::default());
    assert!(matches!(next_mark(&mut sheet), Mark::Begin(_)));
    assert_eq!(sheet.step_count(), 192);
    assert!(matches!(next_mark(&mut sheet), Mark::End(..)));
    assert_eq!(sheet.step_count(), 256);
    assert!(sheet.take_mark().is_none());
}

#[test]
fn an_audit_asks_between_slices_whether_to_go_on_and_finds_nothing_if_not() {
    let work = |answer: bool| {
        let mut sheet = moving(&["stepping.substeps=24"], 1);
        sheet.request_audit(WindowInputs::default());
        let Mark::Begin(begin) = next_mark(&mut sheet) else { panic!("no window") };
        let opening = begin.open();
        let Mark::End(end, inputs) = next_mark(&mut sheet) else { panic!("no end") };
        let mut asked = 0;
        let finding = opening.close(end, inputs).work(FINER, ErrorExtent::default(), &mut || {
            asked += 1;
            answer
        });
        (finding, asked)
    };
    let (finding, asked) = work(true);
    // 31² points in 96 substeps: some 11 steps make a slice.
    assert!(asked > 1, "{asked}");
    let error = finding.unwrap().error;
    assert!(error.largest() > 0.0 && error.largest() < 1e-5, "{error:?}");
    assert_eq!(work(false), (None, 1));
}
