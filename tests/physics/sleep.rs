//! Sleep: the cost in accuracy of not computing what rests, and that every force wakes the tiles it reaches.

use glam::DVec3;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::{CentreProfile, LoadProfile, Profile, StrengthProfile};
use palpate_tissue::scene::{PAPER, Scene};
use palpate_tissue::{Grasp, Model, Push, Tissue, at_rest};

fn sheet(settings: &[&str]) -> Box<dyn Tissue> {
    let settings: Vec<String> = settings.iter().map(|text| (*text).to_owned()).collect();
    let scene = Scene::parse("paper", PAPER, &settings, &Limits::default()).unwrap();
    at_rest(&Model::compile(&scene, &Limits::default()).unwrap())
}

fn field(tissue: &dyn Tissue) -> [Vec<f32>; 3] {
    let mut field = [Vec::new(), Vec::new(), Vec::new()];
    tissue.displacements_m(&mut field);
    field
}

/// The largest component of two fields' difference, and of the first.
fn difference(a: &[Vec<f32>; 3], b: &[Vec<f32>; 3]) -> [f64; 2] {
    let pairs = a.iter().flatten().zip(b.iter().flatten());
    pairs.fold([0.0, 0.0], |[most, largest], (a, b)| {
        [f64::max(most, f64::from((a - b).abs())), f64::max(largest, f64::from(a.abs()))]
    })
}

fn push(centre: CentreProfile, force_n: [f64; 3], falloff_per_m: f64, profile: Profile) -> Push {
    let strength = StrengthProfile::Scaled(DVec3::from_array(force_n), profile);
    Push::Profile(LoadProfile { centre, strength, falloff_per_m, falloff_offset: 0.0 })
}

fn at(x: f64, y: f64) -> CentreProfile {
    CentreProfile::Hops(vec![(0, DVec3::new(x, y, 0.0))])
}

/// The pushes on a sheet of 65 × 97 points, each with the settings that it needs.
fn cases() -> Vec<(&'static str, Vec<&'static str>, Vec<Push>)> {
    let pulse = Profile::Pulse { on: 0, off: 400 };
    let path = CentreProfile::Path { from_m: DVec3::new(1.0, 0.3, 0.0), velocity_m_per_s: DVec3::new(0.05, 1.2, 0.0) };
    vec![
        ("local", vec![], vec![push(at(1.0, 1.5), [0.0, 0.0, -3.0], 150.0, pulse)]),
        ("stiff", vec!["springs.stiffness_n_per_m=200"], vec![push(at(1.0, 1.5), [0.3, 0.0, -1.0], 60.0, pulse)]),
        ("bending", vec!["springs.bending=true"], vec![push(at(0.53, 0.53), [1.0, 0.5, -2.0], 100.0, pulse)]),
        ("stroke", vec![], vec![push(path, [0.2, 0.3, -1.0], 60.0, Profile::Constant)]),
        (
            "two tools",
            vec!["springs.stiffness_n_per_m=100"],
            vec![
                push(at(0.5, 0.6), [0.0, 0.0, -3.0], 150.0, pulse),
                push(at(1.6, 2.4), [1.0, 1.0, -2.6], 150.0, Profile::Pulse { on: 100, off: 600 }),
            ],
        ),
        (
            "slow creep",
            vec!["damping.coefficient_n_s_per_m=5"],
            vec![push(at(1.0, 1.5), [0.0, 0.2, -2.0], 80.0, Profile::Ramp { from_s: 0.0, to_s: 1.0 })],
        ),
        ("central", vec!["stepping.integrator=central"], vec![push(at(1.0, 1.5), [0.0, 0.0, -3.0], 150.0, pulse)]),
        ("f64", vec!["stepping.precision=f64"], vec![push(at(1.0, 1.5), [0.0, 0.0, -3.0], 150.0, pulse)]),
    ]
}

#[test]
fn the_error_of_what_is_left_out_stays_within_the_tolerance_over_the_whole_field() {
    for (name, settings, pushes) in cases() {
        for tolerance in [1e-3, 1e-4, 1e-5] {
            let sleep = format!("sleep.tolerance={tolerance}");
            let with = |sleep: &str| {
                let mut all = settings.clone();
                all.extend(["sheet.points=[65, 97]", sleep]);
                let mut tissue = sheet(&all);
                pushes.iter().enumerate().for_each(|(tool, push)| tissue.push(tool, Some(push.clone())));
                tissue
            };
            let (mut truth, mut skipping) = (with("sleep.tolerance=0"), with(&sleep));
            let (mut most, mut largest) = (0.0, 0.0);
            for _ in 0..40 {
                for _ in 0..25 {
                    truth.step().unwrap();
                    skipping.step().unwrap();
                }
                let [error, size] = difference(&field(&*truth), &field(&*skipping));
                (most, largest) = (f64::max(most, error), f64::max(largest, size));
            }
            assert!(largest > 0.0);
            assert!(most <= tolerance * largest, "{name} at {tolerance:e}: {:e}", most / largest);
            assert!(skipping.computed_fraction() < 1.0, "{name} at {tolerance:e}: nothing slept");
            assert_eq!(truth.computed_fraction(), 1.0);
            assert_eq!(skipping.guard_events(), 0, "{name}");
        }
    }
}

#[test]
fn a_sheet_at_rest_computes_nothing_and_wakes_within_the_step_that_touches_it() {
    let mut tissue = sheet(&[]);
    assert_eq!(tissue.awake_points(), 0);
    for _ in 0..1_000_000 {
        tissue.step().unwrap();
    }
    assert_eq!((tissue.step_count(), tissue.computed_fraction()), (1_000_000, 0.0));
    let push = push(at(0.5, 0.5), [0.0, 0.0, -3.0], 150.0, Profile::Constant);
    tissue.push(0, Some(push));
    tissue.step().unwrap();
    assert!(tissue.awake_points() > 0);
    assert!(tissue.point(tissue.model().scene.sheet().unwrap().point([15, 15])).displacement_m.z < 0.0);
    // A held poke comes to rest and stays there.
    for _ in 0..3000 {
        tissue.step().unwrap();
    }
    assert_eq!(tissue.awake_points(), 0);
    let held = tissue.point(tissue.model().scene.sheet().unwrap().point([15, 15]));
    tissue.step().unwrap();
    assert_eq!(tissue.point(tissue.model().scene.sheet().unwrap().point([15, 15])), held);
    assert_eq!(held.velocity_m_per_s, DVec3::ZERO);
    // All forces balance within the tolerance.
    let rest = held.spring_n + held.anchor_n + held.applied_n;
    assert!(rest.length() < 1e-5 * held.applied_n.length(), "{rest}");
    tissue.push(0, None);
    tissue.step().unwrap();
    assert!(tissue.point(tissue.model().scene.sheet().unwrap().point([15, 15])).velocity_m_per_s.z > 0.0);
}

#[test]
fn a_tile_wakes_with_the_history_that_it_would_have_had() {
    // Pressed, at rest, and released: with zeros as history the first steps would be wrong by the whole spring force.
    let with = |sleep: &str| sheet(&["stepping.integrator=exponential3", "stepping.substeps=1", sleep]);
    let (mut truth, mut skipping) = (with("sleep.tolerance=0"), with("sleep.tolerance=1e-6"));
    for tissue in [&mut truth, &mut skipping] {
        tissue.push(0, Some(push(at(0.5, 0.5), [0.0, 0.0, -3.0], 150.0, Profile::Constant)));
        (0..2000).for_each(|_| tissue.step().unwrap());
    }
    assert_eq!(skipping.awake_points(), 0);
    let mut most = 0.0;
    let largest = truth.largest_displacement_m();
    for tissue in [&mut truth, &mut skipping] {
        tissue.push(0, None);
    }
    for _ in 0..20 {
        truth.step().unwrap();
        skipping.step().unwrap();
        most = f64::max(most, difference(&field(&*truth), &field(&*skipping))[0]);
    }
    assert!(most < 2e-6 * largest, "{:e}", most / largest);
}

/// Pulls a point by `far_m` in `steps` steps; returns the largest error seen, relative to the largest displacement.
fn creep(steps: u32, far_m: f64) -> f64 {
    let with = |sleep: &str| sheet(&["sheet.points=[64, 64]", "springs.stiffness_n_per_m=50", sleep]);
    let (mut truth, mut skipping) = (with("sleep.tolerance=0"), with("sleep.tolerance=1e-4"));
    let index = truth.model().scene.sheet().unwrap().point([8, 8]);
    let mut most = 0.0;
    for step in 0..steps {
        for tissue in [&mut truth, &mut skipping] {
            let to_m = far_m * f64::from(step) / f64::from(steps);
            tissue.grasp(0, index, Grasp::Target(DVec3::new(to_m, to_m, -to_m)));
            tissue.step().unwrap();
        }
        // Compare once the error comes from the creep, not from its first steps.
        if step > steps / 10 && step.is_multiple_of(steps / 40) {
            let [error, largest] = difference(&field(&*truth), &field(&*skipping));
            most = f64::max(most, error / largest);
        }
    }
    assert!(skipping.awake_points() < 64 * 64);
    most
}

#[test]
fn a_creep_too_slow_for_any_one_step_wakes_what_it_reaches() {
    // A micrometre per step: a comparison with the step before would never wake anything beyond the point's tile.
    let error = creep(20_000, 0.02);
    assert!(error <= 1e-4, "{error:e}");
}

#[test]
#[ignore = "a minute: make stress"]
fn a_million_steps_of_creep_stay_within_the_tolerance() {
    let error = creep(1_000_000, 0.02);
    println!("error {error:.1e} of 1e-4");
    assert!(error <= 1e-4, "{error:e}");
}

#[test]
fn sleeping_is_the_same_at_every_width() {
    // One of each family.
    for integrator in ["central", "exponential3", "rk4"] {
        let hash = |lanes: &str| {
            let (integrator, lanes) = (format!("stepping.integrator={integrator}"), format!("stepping.lanes={lanes}"));
            let settings = [integrator.as_str(), lanes.as_str(), "sheet.points=[45, 61]", "sleep.tolerance=1e-4"];
            let settings: Vec<String> = settings.iter().map(|text| (*text).to_owned()).collect();
            let scene = Scene::parse("paper", PAPER, &settings, &Limits::default()).unwrap();
            // Skip lanes that this machine does not have.
            let model = Model::compile(&scene, &Limits::default()).ok()?;
            let mut tissue = at_rest(&model);
            let path =
                CentreProfile::Path { from_m: DVec3::new(0.4, 0.4, 0.0), velocity_m_per_s: DVec3::new(1.5, 2.0, 0.0) };
            tissue.push(0, Some(push(path, [0.2, 0.0, -1.0], 60.0, Profile::Pulse { on: 0, off: 300 })));
            (0..500).for_each(|_| tissue.step().unwrap());
            let part = tissue.computed_fraction();
            assert!(part > 0.0 && part < 1.0);
            Some(tissue.state_hash())
        };
        let plain = hash("plain");
        for lanes in ["neon", "avx2", "avx512"] {
            assert!(hash(lanes).is_none_or(|hash| Some(hash) == plain), "{integrator} {lanes}");
        }
    }
}

/// The energies from the points' displacements and velocities, J: each spring computed separately.
fn energies_by_points(tissue: &dyn Tissue) -> [f64; 3] {
    let scene = &tissue.model().scene;
    let [rows, columns] = scene.sheet().unwrap().points;
    let points: Vec<_> = tissue.model().points().map(|point| tissue.point(point)).collect();
    let mut spring_j = 0.0;
    for i in 0..rows {
        for j in 0..columns {
            for (di, dj, k) in [
                (0, 1, scene.springs.stiffness_n_per_m),
                (1, 0, scene.springs.stiffness_n_per_m),
                (1, 1, scene.springs.shear_stiffness_n_per_m),
                (1, -1, scene.springs.shear_stiffness_n_per_m),
            ] {
                let Some(to) = j.checked_add_signed(dj).filter(|to| *to < columns && i + di < rows) else { continue };
                let rest_m = DVec3::new(di as f64, dj as f64, 0.0) * scene.sheet().unwrap().spacing_m;
                let delta_m = points[(i + di) * columns + to].displacement_m - points[i * columns + j].displacement_m;
                // L − L0 = (L² − L0²)/(L + L0), without cancellation.
                let longer_m = (2.0 * rest_m + delta_m).dot(delta_m) / ((rest_m + delta_m).length() + rest_m.length());
                spring_j += 0.5 * k * longer_m * longer_m;
            }
        }
    }
    let kinetic_j =
        points.iter().map(|point| 0.5 * scene.sheet().unwrap().point_mass_kg * point.velocity_m_per_s.length_squared());
    let anchor_j =
        points.iter().map(|point| 0.5 * scene.anchor_stiffness_n_per_m * point.displacement_m.length_squared());
    [kinetic_j.sum(), spring_j, anchor_j.sum()]
}

#[test]
fn the_energy_of_tiles_that_sleep_is_counted_to_the_last_digits() {
    // A multistep scheme evaluates its springs at the predicted places, which differ by the later correction.
    for (integrator, part) in [("central", 1e-11), ("exponential3", 1e-7)] {
        let integrator = format!("stepping.integrator={integrator}");
        let settings = [integrator.as_str(), "stepping.precision=f64", "sheet.points=[65, 97]", "sleep.tolerance=1e-4"];
        let (mut asked, mut unasked) = (sheet(&settings), sheet(&settings));
        let path =
            CentreProfile::Path { from_m: DVec3::new(0.5, 0.5, 0.0), velocity_m_per_s: DVec3::new(0.5, 0.9, 0.0) };
        for tissue in [&mut asked, &mut unasked] {
            tissue.push(0, Some(push(path.clone(), [0.2, 0.3, -1.0], 60.0, Profile::Pulse { on: 0, off: 1500 })));
            tissue.push(1, Some(push(at(1.5, 0.5), [0.0, 0.0, -2.0], 150.0, Profile::Constant)));
        }
        let mut partly = 0;
        for step in 1..=2000 {
            asked.step().unwrap();
            unasked.step().unwrap();
            let energy = asked.energy();
            if step % 100 != 0 {
                continue;
            }
            partly += usize::from((1..65 * 97).contains(&asked.awake_points()));
            let truth = energies_by_points(&*asked);
            let total_j: f64 = truth.iter().sum();
            for (found_j, truth_j) in [energy.kinetic_j, energy.spring_j, energy.anchor_j].into_iter().zip(truth) {
                assert!((found_j - truth_j).abs() <= part * total_j, "{integrator}, {step}: {energy:?}, {truth:?}");
            }
            // Earlier calls make no difference.
            assert_eq!(unasked.energy(), energy);
        }
        assert!(partly > 10, "{integrator}: {partly}");
    }
}

#[test]
fn a_moving_tool_asks_only_tiles_within_its_reach() {
    // Springs too weak to pass anything on, and a trembling tool: its force ends 11 points away (e^−22), in the first
    // tile.
    let mut tissue = sheet(&["sheet.points=[16, 64]", "springs.stiffness_n_per_m=1e-6", "sleep.tolerance=1e-6"]);
    let hops = (0..20_000).map(|step| (step, DVec3::new(0.2, if step % 2 == 0 { 0.09 } else { 0.11 }, 0.0))).collect();
    tissue.push(0, Some(push(CentreProfile::Hops(hops), [0.0, 0.0, -3.0], 60.0, Profile::Constant)));
    for step in 0..20_000 {
        tissue.step().unwrap();
        // A bound on the force beyond its reach, summed over all steps, would finally wake the second tile.
        assert_eq!(tissue.awake_points(), 16 * 16, "step {step}");
    }
}

/// A scheme of several sweeps pulls at the tiles beside a grasped point within the substep in which its tool moves it.
#[test]
fn a_grasped_point_wakes_the_tiles_beside_it_before_it_moves() {
    for integrator in ["rk4", "central", "exponential3"] {
        for (point, by_m) in [([16, 16], 0.05), ([15, 16], 0.05), ([31, 5], 0.05), ([16, 15], 0.0005)] {
            let displaced = |tolerance: &str| {
                let settings = [
                    "sheet.points=[33, 33]",
                    "stepping.precision=f64",
                    &format!("stepping.integrator={integrator}"),
                    &format!("sleep.tolerance={tolerance}"),
                ];
                let mut tissue = sheet(&settings);
                let point = tissue.model().scene.sheet().unwrap().point(point);
                let (mut held_m, mut all) = (0.0_f64, Vec::new());
                for step in 0..600 {
                    // There and back: at once, or at 0.5 m/s.
                    let target_m = if step % 400 < 200 { 0.05 } else { 0.0 };
                    held_m += (target_m - held_m).clamp(-by_m, by_m);
                    tissue.grasp(0, point, Grasp::Target(held_m * DVec3::NEG_Z));
                    tissue.step().unwrap();
                    let mut displacement_m = Vec::new();
                    tissue.whole_displacements_m(&mut displacement_m);
                    all.push(displacement_m);
                }
                all
            };
            let (with, without) = (displaced("1e-6"), displaced("0"));
            let apart = with.iter().flatten().zip(without.iter().flatten()).map(|(a, b)| (a - b).abs());
            let error = apart.fold(0.0, f64::max) / 0.05;
            assert!(error < 1e-6, "{integrator}, {point:?}, {by_m} m a step: {error:e}");
        }
    }
}
