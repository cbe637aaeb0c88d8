//! Whatever a legal scene says, to look at it, to make a session of it and to step that is bounded work, or it is
//! refused with a reason.
//!
//! Fifty scenes in every run of the tests; `make stress` draws ten thousand (`PALPATE_STRESS_SCENES`). What decides is
//! the work, counted in points × substeps; the processor time is shown.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]
#![allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::common::cases;
use palpate_realtime::Pacer;
use palpate_refusal::Reason;
use palpate_session::budget::Budget;
use palpate_tissue as tissue;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::{
    Body, FixedPoints, Integrator, Lanes, Named, PointSet, Precision, Scene, Sheet, Springs, Stepping,
};
use palpate_tissue::select::scheme_selection::NEVER;

fn name<T: Named>(random: &mut fastrand::Rng) -> T {
    T::NAMES[random.usize(..T::NAMES.len())].1
}

/// A scene with every field drawn over all of its legal range, by orders of magnitude.
fn legal(seed: u64, limits: &Limits) -> Scene {
    let mut random = fastrand::Rng::with_seed(seed);
    let decades = |random: &mut fastrand::Rng, from: f64, to: f64| 10_f64.powf(from + (to - from) * random.f64());
    let any = |random: &mut fastrand::Rng| decades(random, -12.0, 12.0);
    let or_zero = |random: &mut fastrand::Rng| if random.u8(..8) == 0 { 0.0 } else { any(random) };
    let most = (limits.points as f64).log10();
    let nx = decades(&mut random, 0.0, most) as usize;
    let ny = decades(&mut random, 0.0, (limits.points as f64 / nx as f64).log10()) as usize;
    let points = [[nx, ny], [ny, nx]][random.usize(..2)];
    let place = |random: &mut fastrand::Rng| points.map(|side| random.usize(..side));
    let fixed = match random.u8(..4) {
        0 => FixedPoints::Edges,
        1 => FixedPoints::Corners,
        2 => FixedPoints::Points((0..random.usize(..100)).map(|_| place(&mut random)).collect()),
        _ => FixedPoints::Points(PointSet::default()),
    };
    let stiffness_n_per_m = or_zero(&mut random);
    let shear_stiffness_n_per_m = if random.bool() { stiffness_n_per_m } else { or_zero(&mut random) };
    Scene {
        name: format!("legal {seed}"),
        body: Body::Sheet(Sheet { points, spacing_m: any(&mut random), point_mass_kg: any(&mut random), fixed }),
        material: None,
        inclusions: Arc::default(),
        added_lumps: Arc::default(),
        springs: Springs {
            stiffness_n_per_m,
            shear_stiffness_n_per_m,
            bending: random.bool(),
            pretension_n_per_m: 0.0,
        },
        anchor_stiffness_n_per_m: or_zero(&mut random),
        damping_n_s_per_m: or_zero(&mut random),
        volume_stiffness_pa: 0.0,
        stepping: Stepping {
            rate_hz: decades(&mut random, -3.0, limits.session_rate_hz.log10()),
            tolerance: decades(&mut random, -16.0, 0.0),
            integrator: Some(name(&mut random))
                .filter(|named: &Integrator| named.takes_anchor_springs() && random.bool())
                .unwrap_or(Integrator::Auto),
            substeps: random.bool().then(|| decades(&mut random, 0.0, f64::from(limits.substeps).log10()) as u32),
            precision: if random.bool() { Precision::Auto } else { name(&mut random) },
            lanes: Lanes::Auto,
            correct: random.bool(),
        },
        sleep_tolerance: random.bool().then(|| decades(&mut random, -16.0, 0.0)),
        appearance: palpate_tissue::scene::Appearance::default(),
        cutting: palpate_tissue::scene::Cutting::default(),
    }
}

/// Of this thread, s.
fn processor_s() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

/// One stepping thread.
fn one_thread(limits: &Limits) -> Arc<Pacer> {
    Pacer::start(1, 0.0, limits, Budget::new(limits, 1, 1)).unwrap()
}

/// Steps that each is stepped.
const STEPS: u64 = 10;

#[test]
fn every_legal_scene_is_bounded_work_or_refused() {
    let scenes = cases::count("PALPATE_STRESS_SCENES", 50, 1000);
    // An unoptimized build takes a hundred times as long for each.
    let rehearsal_work = if cfg!(debug_assertions) { 1 << 18 } else { Limits::default().rehearsal_work };
    let limits = Limits { rehearsal_work, ..Limits::default() };
    let pacer = one_thread(&limits);
    let (mut taken, mut refused) = (Vec::new(), BTreeMap::<String, u32>::new());
    for seed in 0..scenes {
        let scene = legal(seed, &limits);
        // A sheet of short rows counts as what it costs, and may then have too many points.
        scene.check(&limits).unwrap_or_else(|refusal| assert_eq!(refusal.field, "sheet.points", "{seed}: {refusal}"));
        let begun_s = processor_s();
        match pacer.create(&scene, true, 60.0, &pacer.budget.account("test"), &NEVER) {
            Err(refusal) => {
                assert!([Reason::TooLarge, Reason::WrongKind].contains(&refusal.reason), "{seed}: {refusal}");
                *refused.entry(refusal.field).or_default() += 1;
            }
            Ok(live) => {
                let model = &live.model;
                // Repetitions after the guard has stopped a run are bounded by the length of the run.
                assert!(model.rehearsed <= limits.rehearsal_work, "{seed}: {}", model.rehearsed);
                assert!(model.predicted_step_s() * scene.stepping.rate_hz <= limits.periods_per_step, "{seed}");
                let mut tissue = tissue::at_rest(model);
                (0..STEPS).for_each(|_| tissue.step().unwrap());
                assert_eq!(tissue.substeps_done(), STEPS * u64::from(model.plan.substeps), "{seed}");
                pacer.delete(&live.id).unwrap();
            }
        }
        taken.push((processor_s() - begun_s, seed));
        if seed > 0 && seed.is_multiple_of(1000) {
            eprintln!("{seed} scenes");
        }
    }
    pacer.stop();
    taken.sort_by(|a, b| b.0.total_cmp(&a.0));
    println!("{} made, refused by field: {refused:?}", scenes - u64::from(refused.values().sum::<u32>()));
    println!("slowest, processor s and seed: {:?}", &taken[..taken.len().min(10)]);
    assert!(scenes < 50 || refused.values().map(|count| u64::from(*count)).sum::<u64>() < scenes, "all were refused");
}

fn scene(text: &str, sets: &[&str]) -> Scene {
    let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
    Scene::parse("scene", text, &sets, &Limits::default()).unwrap()
}

/// Four points that vibrate 10¹² times a second, stepped once a second.
const STIFF: &str = "[sheet]\npoints = [2, 2]\nspacing_m = 0.01\npoint_mass_kg = 1e-12\n\
                     [springs]\nstiffness_n_per_m = 1e12\n[anchor_springs]\nstiffness_n_per_m = 1.0\n\
                     [damping]\ncoefficient_n_s_per_m = 0.0\n[stepping]\nrate_hz = 1.0\n";

#[test]
fn what_no_number_of_substeps_can_do_is_refused_at_once_with_the_figure() {
    let limits = Limits::default();
    let compile = |sets: &[&str]| tissue::Model::compile(&scene(STIFF, sets), &limits);
    let refusal = compile(&[]).unwrap_err();
    assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::TooLarge, "stepping.substeps"));
    assert!(refusal.message.contains("above the limit of 100000"), "{refusal}");
    // A scene that gives a number gets it without a rehearsal, with a warning that it is unstable or that its error
    // is unknown.
    let model = compile(&["stepping.substeps=1"]).unwrap();
    assert!(!model.plan.stable && model.rehearsed == 0 && model.warnings.len() == 2, "{:?}", model.warnings);
    // Damping that only `lagged` can't bear.
    let lagged = ["springs.stiffness_n_per_m=0.0", "damping.coefficient_n_s_per_m=1e12", "stepping.integrator=lagged"];
    let refusal = compile(&lagged).unwrap_err();
    assert_eq!(refusal.reason, Reason::TooLarge, "{refusal}");
}

#[test]
fn a_step_longer_than_its_period_is_refused_with_the_figure() {
    let large = scene(palpate_tissue::scene::PAPER, &["sheet.points=[1001, 1001]"]);
    let limits = Limits::default();
    let pacer = one_thread(&limits);
    let Err(refusal) = pacer.create(&large, true, 60.0, &pacer.budget.account("test"), &NEVER) else {
        panic!("admitted")
    };
    assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::TooLarge, "stepping.rate_hz"));
    assert!(refusal.message.contains("limits.periods_per_step"), "{refusal}");
    pacer.stop();
    let pacer = one_thread(&Limits { periods_per_step: 20.0, ..limits });
    assert!(pacer.create(&large, true, 60.0, &pacer.budget.account("test"), &NEVER).is_ok());
    pacer.stop();
}

#[test]
fn the_scenes_that_are_built_in_are_never_refused() {
    let pacer = one_thread(&Limits::default());
    for (name, text) in palpate_tissue::scene::BUILT_IN {
        let account = pacer.budget.account("test");
        pacer
            .create(&scene(text, &[]), true, 60.0, &account, &NEVER)
            .unwrap_or_else(|refusal| panic!("{name}: {refusal}"));
    }
    pacer.stop();
}
