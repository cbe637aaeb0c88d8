//! Tests that compare choices with all others that could have been made.
#![allow(clippy::unwrap_used, clippy::panic)]

use super::*;
use crate::scene::PAPER;
use crate::scheme::CANDIDATES;

fn scene(sets: &[&str]) -> Scene {
    let sets: Vec<String> = ["sheet.points=[5, 4]"].iter().chain(sets).map(|set| (*set).to_owned()).collect();
    Scene::parse("paper", PAPER, &sets, &Limits::default()).unwrap()
}

/// Returns the chooser's entry of an allowed integrator.
fn open(chooser: &Chooser<'_>, integrator: Integrator) -> OpenChoice {
    *chooser.open.iter().find(|open| open.integrator == integrator).unwrap()
}

/// Returns what a search in a format finds with at most 1000 substeps.
fn found(chooser: &Chooser<'_>, integrator: Integrator, precision: Precision) -> Choice {
    match chooser.fewest(&open(chooser, integrator), precision, 1000, Effort::Quick) {
        Search::Keeps(choice) => choice,
        other => panic!("{integrator:?} {precision:?}: {other:?}"),
    }
}

/// Returns the cost of a choice, in substeps of `central` in f32.
fn cost(choice: &Choice) -> f64 {
    let format = FORMATS.iter().find(|format| format.0 == choice.precision).map(|found| found.1);
    entry(choice.integrator).cost * format.unwrap() * f64::from(choice.substeps)
}

#[test]
fn rounding_in_f32_grows_with_damping_and_with_shorter_substeps_and_is_less_in_better_formats() {
    let sheet = |damping_n_s_per_m| Oscillator {
        mass_kg: 0.01,
        damping_n_s_per_m,
        anchor_stiffness_n_per_m: 5.0,
        spring_stiffness_n_per_m: 120.0,
        viscous_time_s: 0.0,
        branches: Default::default(),
    };
    let of = |precision, damping, substep_s| rounding(precision, &sheet(damping), substep_s);
    let compensated = of(Precision::Compensated, 0.5, 1e-3);
    let creep = |damping, substep_s| of(Precision::F32, damping, substep_s) - compensated;
    // A displacement stands still when it creeps by less than its last digit: that is short by C/(K·dt) digits.
    assert!(creep(0.0, 1e-3).abs() < 1e-12 * compensated);
    assert!((creep(1.0, 1e-3) / creep(0.5, 1e-3) - 2.0).abs() < 1e-9);
    assert!((creep(0.5, 2.5e-4) / creep(0.5, 1e-3) - 4.0).abs() < 1e-9);
    assert!((of(Precision::Compensated, 9.0, 1e-5) - compensated).abs() < 1e-12 * compensated);
    assert!(of(Precision::F64, 9.0, 1e-5) < 1e-4 * compensated);
}

#[test]
fn the_choice_keeps_its_tolerance_and_nothing_that_keeps_it_is_much_cheaper() {
    for tolerance in ["1e-2", "1e-4", "1e-6"] {
        let scene = scene(&[&format!("stepping.tolerance={tolerance}")]);
        let (choice, _) = choose(&scene, &Limits::default(), &NEVER).unwrap();
        let chooser = Chooser::new(&scene, &Limits::default(), &NEVER);
        assert!(chooser.keeps(&choice), "{choice:?}");
        assert!(CANDIDATES.contains(&choice.integrator), "{choice:?}");
        for integrator in CANDIDATES {
            let least = stability::stable_substeps(integrator, 1e-3, &chooser.sheet);
            for (precision, _) in chooser.formats(integrator) {
                for substeps in least.. {
                    let other = Choice { integrator, substeps, precision, expected_error: 0.0 };
                    if cost(&other) >= 0.8 * cost(&choice) {
                        break;
                    }
                    assert!(
                        !chooser.keeps(&chooser.tried(integrator, substeps, precision)),
                        "{choice:?}, not {other:?}"
                    );
                }
            }
        }
    }
}

#[test]
fn an_integrator_takes_hardly_more_substeps_than_it_needs() {
    // Of those that `auto` may choose.
    for (integrator, tolerance) in [
        (Integrator::Central, "3e-3"),
        (Integrator::Exponential2, "1e-4"),
        (Integrator::Exponential3, "1e-6"),
        (Integrator::Exponential4, "1e-7"),
    ] {
        let scene = scene(&[&format!("stepping.tolerance={tolerance}"), "springs.stiffness_n_per_m=1000"]);
        let chooser = Chooser::new(&scene, &Limits::default(), &NEVER);
        let found = found(&chooser, integrator, Precision::F64);
        assert!(chooser.keeps(&found) && found.substeps > 2, "{found:?}");
        let fewer = chooser.tried(integrator, found.substeps * 2 / 3, Precision::F64);
        assert!(!chooser.keeps(&fewer), "{found:?}, but {fewer:?} would do");
        // With one less at most, there is none that keeps the tolerance, or one with fewer.
        let open = open(&chooser, integrator);
        let bounded = chooser.fewest(&open, Precision::F64, found.substeps - 1, Effort::Quick);
        let has_fewer = |bounded| matches!(bounded, Search::Keeps(fewer) if fewer.substeps < found.substeps);
        assert!(bounded == Search::Beyond || has_fewer(bounded), "{bounded:?}");
    }
}

#[test]
fn where_nothing_keeps_the_tolerance_the_least_error_is_chosen() {
    let limits = Limits { substeps: 2, ..Limits::default() };
    let scene = scene(&["stepping.tolerance=1e-9"]);
    let (choice, _) = choose(&scene, &limits, &NEVER).unwrap();
    let others = candidates(&scene, &limits);
    assert!(others.len() > 1 && choice.expected_error > 1e-9);
    let least = others.iter().map(|other| other.expected_error).fold(f64::INFINITY, f64::min);
    let most = others.iter().map(|other| other.expected_error).fold(0.0, f64::max);
    assert!(choice.expected_error == least && least < most, "{choice:?}, not {others:?}");
}

#[test]
fn a_choice_that_nobody_waits_for_is_given_up_before_anything_is_rehearsed() {
    let (limits, set) = (Limits::default(), AtomicBool::new(true));
    let scene = Scene::parse("paper", crate::scene::PAPER, &[], &limits).unwrap();
    assert_eq!(choose(&scene, &limits, &set).unwrap_err(), given_up());
    assert_eq!(Chooser::new(&scene, &limits, &set).rehearsal.left(), limits.rehearsal_work);
    // Also where substeps are given, and only the error is unknown.
    let given = Scene::parse("paper", crate::scene::PAPER, &["stepping.substeps=3".into()], &limits).unwrap();
    assert_eq!(choose(&given, &limits, &set).unwrap_err(), given_up());
    let (choice, work) = choose(&scene, &limits, &NEVER).unwrap();
    assert!(choice.expected_error <= scene.stepping.tolerance && work > 0);
}

#[test]
fn a_step_takes_a_time_of_its_own_and_more_for_each_point_in_each_substep() {
    let of = |points: &str, substeps: u32| {
        let scene = scene(&[points, &format!("stepping.substeps={substeps}"), "stepping.integrator=central"]);
        let (found, step_s) = least_step(&scene);
        assert_eq!(found, substeps);
        step_s - 1e-9 * STEP_NS
    };
    let one_s = of("sheet.points=[5, 4]", 2);
    assert!(one_s > 0.0);
    for (points, substeps, times) in [("[5, 4]", 6, 3.0), ("[10, 4]", 2, 2.0), ("[10, 8]", 1, 2.0)] {
        let step_s = of(&format!("sheet.points={points}"), substeps);
        assert!((step_s / one_s - times).abs() < 1e-9, "{points} {substeps}: {step_s} {one_s}");
    }
    // Without a number of substeps, as few as any integrator can do with.
    let scene = scene(&["springs.stiffness_n_per_m=2000"]);
    let each = CANDIDATES.map(|integrator| stability::stable_substeps(integrator, 1e-3, &Oscillator::of(&scene)));
    assert_eq!(Some(least_step(&scene).0), each.into_iter().min());
}

#[test]
fn the_time_of_a_point_is_its_schemes_and_its_formats_and_its_lanes_times_each_other() {
    let scene = scene(&[]);
    let of = |integrator, precision, lanes| point_substep_ns(&scene, integrator, precision, lanes);
    let least = of(Integrator::Central, Precision::F32, Lanes::Avx512);
    assert!((0.1..100.0).contains(&least), "{least} ns");
    for (precision, format_cost) in FORMATS {
        for integrator in CANDIDATES {
            for (lanes, times) in [(Lanes::Avx512, 1.0), (Lanes::Avx2, 1.6)] {
                let expected = least * entry(integrator).cost * format_cost * times;
                let found = of(integrator, precision, lanes);
                assert!((found / expected - 1.0).abs() < 1e-9, "{integrator:?} {precision:?} {lanes:?}: {found}");
            }
        }
    }
}

#[test]
fn where_rounding_errs_the_best_is_chosen_of_what_was_tried() {
    let sets = ["stepping.tolerance=1e-4", "springs.stiffness_n_per_m=1000", "stepping.precision=f32"];
    let scene = scene(&sets);
    let chooser = Chooser::new(&scene, &Limits::default(), &NEVER);
    for integrator in [Integrator::Exponential4, Integrator::Exponential3, Integrator::Central] {
        let open = open(&chooser, integrator);
        assert_eq!(chooser.fewest(&open, Precision::F32, 1000, Effort::Quick), Search::Stalls);
        let choice = chooser.nearest(&[open]).unwrap();
        assert!(!chooser.keeps(&choice), "{choice:?}");
        let substeps = choice.substeps;
        for other in [substeps / 3, substeps / 2, 2 * substeps, 3 * substeps].into_iter().filter(|other| *other > 0) {
            let other = chooser.tried(integrator, other, Precision::F32);
            assert!(choice.expected_error <= other.expected_error, "{choice:?}, not {other:?}");
        }
    }
}

#[test]
fn a_leap_that_went_too_far_is_taken_back() {
    let scene = scene(&["stepping.tolerance=1e-5", "springs.stiffness_n_per_m=1000"]);
    let chooser = Chooser::new(&scene, &Limits::default(), &NEVER);
    let found = found(&chooser, Integrator::Central, Precision::F64);
    let fewer = chooser.tried(Integrator::Central, found.substeps - 1, Precision::F64);
    assert!(chooser.keeps(&found) && !chooser.keeps(&fewer), "{found:?}, {fewer:?}");
}

/// Scenes whose motion is hard to predict: no damping, no anchor springs, or neither; a tolerance that f64 can't keep.
const HARD: [&[&str]; 8] = [
    &["damping.coefficient_n_s_per_m=0.0"],
    &["anchor_springs.stiffness_n_per_m=0.0"],
    &["anchor_springs.stiffness_n_per_m=0.0", "damping.coefficient_n_s_per_m=0.0"],
    &["anchor_springs.stiffness_n_per_m=0.0", "damping.coefficient_n_s_per_m=0.0", "springs.stiffness_n_per_m=20000"],
    &["anchor_springs.stiffness_n_per_m=0.0", "springs.stiffness_n_per_m=2e6", "springs.bending=true"],
    &["springs.stiffness_n_per_m=0.0", "anchor_springs.stiffness_n_per_m=0.0", "damping.coefficient_n_s_per_m=0.0"],
    &["damping.coefficient_n_s_per_m=0.0", "springs.stiffness_n_per_m=5000", "stepping.integrator=exponential2"],
    &["stepping.precision=compensated", "damping.coefficient_n_s_per_m=0.001"],
];

#[test]
fn the_choice_is_above_the_tolerance_only_if_every_integrator_alone_is() {
    let (limits, mut made) = (Limits::default(), 0);
    for (sets, tolerance) in HARD.iter().flat_map(|sets| [1e-3, 1e-14].map(|tolerance| (sets, tolerance))) {
        let scene = scene(&[sets, &[format!("stepping.tolerance={tolerance:e}").as_str()][..]].concat());
        let chosen = choose(&scene, &limits, &NEVER);
        let Ok((choice, work)) = chosen else {
            // Within the allowed work, so that others can repeat it.
            let refusal = chosen.unwrap_err();
            assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::TooLarge, "stepping.tolerance"));
            continue;
        };
        made += 1;
        let alone = candidates(&scene, &limits);
        let least = alone.iter().map(|other| other.expected_error).fold(f64::INFINITY, f64::min);
        let case = format!("{sets:?} {tolerance:e}: {choice:?} of {alone:?}");
        assert!(
            choice.expected_error <= tolerance || choice.expected_error <= 2.0 * least && least > tolerance,
            "{case}"
        );
        if tolerance == 1e-3 {
            assert_eq!(choose(&scene, &limits, &NEVER).unwrap(), (choice, work), "{case}");
        }
        for Choice { integrator, substeps, expected_error, .. } in alone.into_iter().chain([choice]) {
            assert_ne!(integrator, Integrator::Auto, "{case}");
            let stable = stability::stable_substeps(integrator, 1e-3, &Oscillator::of(&scene));
            let may_go_beyond = scene.stepping.integrator != Integrator::Auto && expected_error <= tolerance;
            assert!(may_go_beyond || substeps <= stable * MAX_TIMES_STABLE, "{case}");
        }
    }
    assert!(made > HARD.len(), "{made}");
}

#[test]
fn an_integrator_that_stalls_hides_no_other_that_keeps_the_tolerance() {
    // Nothing damps it: exponential4 errs by a hair too much however short its substep, exponential3 does not.
    let stiff = ["sheet.points=[5, 5]", "sheet.spacing_m=0.01", "springs.stiffness_n_per_m=4565.1"];
    let tied = ["anchor_springs.stiffness_n_per_m=261.92", "damping.coefficient_n_s_per_m=0.0"];
    let scene =
        scene(&[&stiff[..], &tied, &["springs.shear_stiffness_n_per_m=4565.1", "stepping.tolerance=4.08e-6"]].concat());
    let limits = Limits::default().offline();
    let chooser = Chooser::new(&scene, &limits, &NEVER);
    assert_eq!(chooser.cheapest(&chooser.open, Effort::Quick), None);
    let choice = chooser.best(&chooser.open);
    assert!(choice.expected_error <= 4.08e-6, "{choice:?}");
}

#[test]
fn where_nothing_can_be_predicted_the_fastest_vibration_turns_by_little_in_each_substep() {
    // No work is left for a rehearsal.
    let limits = Limits { rehearsal_work: 0, ..Limits::default() };
    for k in ["10", "5000", "2e6"] {
        let scene = scene(&[&format!("springs.stiffness_n_per_m={k}"), "damping.coefficient_n_s_per_m=0.0"]);
        let chooser = Chooser::new(&scene, &limits, &NEVER);
        let choice = chooser.best(&chooser.open);
        assert!(choice.expected_error.is_infinite() && choice.integrator == Integrator::Central, "{choice:?}");
        let turn = |substeps: u32| 1e-3 / f64::from(substeps) * chooser.sheet.omega_bound_per_s();
        assert!(turn(choice.substeps) <= stability::THETA, "{choice:?}");
        assert!(choice.substeps == 1 || turn(choice.substeps - 1) > stability::THETA, "{choice:?}");
    }
    assert_eq!(f64::from(MAX_TIMES_STABLE), 2.0 / (stability::THETA / stability::endurance(1.0, f64::INFINITY)));
}

#[test]
fn what_does_not_rest_within_the_tolerance_is_expected_to_err_by_more() {
    // Points that creep: f32 stands still before they are there.
    let scene = scene(&["damping.coefficient_n_s_per_m=50", "stepping.tolerance=1e-5"]);
    let chooser = Chooser::new(&scene, &Limits::default(), &NEVER);
    for format in [Precision::F32, Precision::F64] {
        let tried = chooser.tried(Integrator::Central, 8, format);
        let rests = chooser.resting_error(format, 8) <= 1e-5;
        assert_eq!(rests, format == Precision::F64);
        assert!(
            rests || !chooser.keeps(&tried) && tried.expected_error >= chooser.resting_error(format, 8),
            "{tried:?}"
        );
    }
}

#[test]
fn what_auto_would_take_is_told_only_where_the_scene_gives_something_itself() {
    let limits = Limits::default();
    assert_eq!(by_auto(&scene(&[]), &limits), None);
    let open = choose(&scene(&[]), &limits, &NEVER).unwrap().0;
    for given in ["stepping.integrator=lagged", "stepping.substeps=7", "stepping.precision=f64"] {
        assert_eq!(by_auto(&scene(&[given]), &limits), Some(open), "{given}");
    }
    // A choice that no integrator can keep, or that takes too much work, is not advised.
    let light = scene(&["sheet.point_mass_kg=1e-12", "springs.stiffness_n_per_m=1e12", "stepping.substeps=1"]);
    assert_eq!(by_auto(&light, &limits), None);
    assert_eq!(by_auto(&scene(&["stepping.substeps=7"]), &Limits { rehearsal_work: 0, ..limits }), None);
}
