//! Choices beside all others that could have been made.
#![allow(clippy::unwrap_used)]

use super::*;
use crate::scene::PAPER;

fn scene(sets: &[&str]) -> Scene {
    let sets: Vec<String> = ["sheet.points=[5, 4]"].iter().chain(sets).map(|set| (*set).to_owned()).collect();
    Scene::parse("paper", PAPER, &sets, &Limits::default()).unwrap()
}

/// The cost of a choice, in substeps of `central` in f32.
fn cost(choice: &Choice) -> f64 {
    let format = FORMATS.iter().find(|format| format.0 == choice.precision).map(|found| found.1);
    entry(choice.integrator).cost * format.unwrap() * f64::from(choice.substeps)
}

#[test]
fn rounding_in_f32_grows_with_damping_and_with_shorter_substeps_and_is_less_in_better_formats() {
    let sheet = |damping_n_s_per_m| Oscillator {
        mass_kg: 0.01,
        damping_n_s_per_m,
        virtual_stiffness_n_per_m: 5.0,
        spring_stiffness_n_per_m: 120.0,
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
    // Of those that `auto` may become.
    for (integrator, tolerance) in [
        (Integrator::Central, "3e-3"),
        (Integrator::Exponential2, "1e-4"),
        (Integrator::Exponential3, "1e-6"),
        (Integrator::Exponential4, "1e-7"),
    ] {
        let scene = scene(&[&format!("stepping.tolerance={tolerance}"), "springs.stiffness_n_per_m=1000"]);
        let chooser = Chooser::new(&scene, &Limits::default(), &NEVER);
        let found = chooser.fewest(integrator, Precision::F64, 1000).unwrap().choice;
        assert!(chooser.keeps(&found) && found.substeps > 2, "{found:?}");
        let fewer = chooser.tried(integrator, found.substeps * 2 / 3, Precision::F64);
        assert!(!chooser.keeps(&fewer), "{found:?}, but {fewer:?} would do");
        // With one less at most, there is none that keeps the tolerance, or one with fewer.
        let bounded = chooser.fewest(integrator, Precision::F64, found.substeps - 1);
        assert!(bounded.is_none_or(|bounded| bounded.choice.substeps < found.substeps));
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
    let scene = scene(&["stepping.tolerance=1e-4", "springs.stiffness_n_per_m=1000"]);
    let chooser = Chooser::new(&scene, &Limits::default(), &NEVER);
    for integrator in [Integrator::Exponential4, Integrator::Exponential3, Integrator::Central] {
        let Fewest { choice, rounding } = chooser.fewest(integrator, Precision::F32, 1000).unwrap();
        assert!(rounding && !chooser.keeps(&choice), "{choice:?}");
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
    let found = chooser.fewest(Integrator::Central, Precision::F64, 1000).unwrap().choice;
    let fewer = chooser.tried(Integrator::Central, found.substeps - 1, Precision::F64);
    assert!(chooser.keeps(&found) && !chooser.keeps(&fewer), "{found:?}, {fewer:?}");
}
