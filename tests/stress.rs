//! Random scenes under random tools, and adversarial ones: everything stays finite, no energy appears from nowhere, no
//! panic.
//!
//! Fifty in every test run; `make stress` does ten thousand (`PALPATE_STRESS_SCENES`) and a soak of 10⁷ steps. Of closed
//! meshes of a random material there are 4 for 250 steps each, and 200 for 5,000 (`PALPATE_STRESS_MESHES`); of solids 4, and
//! 1,000 (`PALPATE_STRESS_SOLIDS`).
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use crate::common;
use crate::common::cases;
use crate::common::closed_mesh::closed_mesh;
use crate::common::random_scenes;
use crate::common::random_scenes::solid_case;
use crate::common::{SMALL, model, scene_with};
use glam::DVec3;
use palpate_haptics::{Tip, TipShape};
use palpate_tissue::guard::INTERVAL_SUBSTEPS;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Scene;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::{self as tissue, Grasp, Model, Push, Tissue};
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};

/// Bound on the excess of the energy over the work of all tools, as a fraction of the largest energy so far and of all
/// work: the margin of the guard, which checks every 256 substeps, and the error of estimating the work of held
/// positions.
const MARGIN: f64 = 0.1;

/// Ten to the power of something in a range.
fn decades(from: f64, to: f64) -> impl Strategy<Value = f64> {
    (from..to).prop_map(|exponent| 10_f64.powf(exponent))
}

/// A scene as a file: k over twelve decades, all coefficients also 0.
fn any_scene() -> impl Strategy<Value = String> {
    let coefficient = |from, to| prop_oneof![6 => decades(from, to), 1 => Just(0.0)];
    // One of each family, and mostly what scenes have.
    let integrator = prop_oneof![6 => Just("auto"), 1 => Just("central"), 1 => Just("exponential2"), 1 => Just("rk4")];
    let shape = (1..14_usize, 1..20_usize, decades(-3.0, 0.0), decades(-4.0, 0.0));
    let elastic = (coefficient(-6.0, 6.0), coefficient(-3.0, 3.0), coefficient(-3.0, 1.0), any::<bool>());
    let fixed = prop_oneof![3 => Just("[]"), 1 => Just("\"edges\""), 1 => Just("\"corners\"")];
    let tolerance = decades(-7.0, -2.0);
    (shape, elastic, fixed, integrator, tolerance).prop_map(
        |((nx, ny, h, m), (k, anchor_k, c, bending), fixed, integrator, tolerance)| {
            format!(
                "[sheet]\npoints = [{nx}, {ny}]\nspacing_m = {h:e}\npoint_mass_kg = {m:e}\nfixed = {fixed}\n\
                 [springs]\nstiffness_n_per_m = {k:e}\nbending = {bending}\n\
                 [anchor_springs]\nstiffness_n_per_m = {anchor_k:e}\n[damping]\ncoefficient_n_s_per_m = {c:e}\n\
                 [stepping]\nintegrator = \"{integrator}\"\ntolerance = {tolerance:e}\n"
            )
        },
    )
}

/// The action of a tool before a step: its strength (relative to the scene), place and kind.
#[derive(Debug, Clone, Copy)]
struct RandomAction {
    step: u64,
    tool: usize,
    place: [f64; 2],
    towards: [f64; 3],
    manner: u8,
}

fn any_act() -> impl Strategy<Value = RandomAction> {
    (0..200_u64, 0..3_usize, [0.0..1.0_f64, 0.0..1.0_f64], [-1.0..1.0_f64, -1.0..1.0, -1.0..1.0], 0..8_u8)
        .prop_map(|(step, tool, place, towards, manner)| RandomAction { step, tool, place, towards, manner })
}

fn act(tissue: &mut dyn Tissue, RandomAction { tool, place, towards, manner, .. }: RandomAction) {
    let scene = tissue.model().scene.clone();
    let [nx, ny] = scene.sheet().unwrap().points;
    let point = [(place[0] * nx as f64) as usize, (place[1] * ny as f64) as usize];
    let (spacing_m, towards) = (scene.sheet().unwrap().spacing_m, DVec3::from_array(towards));
    if scene.shape().is_fixed(scene.sheet().unwrap().point(point)) || manner == 0 {
        return tissue.release(tool);
    }
    if manner < 3 {
        // As far as through its neighbours and out: springs pressed to zero length and inverted.
        let index = tissue.model().scene.sheet().unwrap().point(point);
        return tissue.grasp(tool, index, Grasp::Target(2.5 * spacing_m * towards));
    }
    // A force that moves a point by up to some spacings.
    let stiffness = scene.anchor_stiffness_n_per_m + scene.springs.stiffness_n_per_m.min(1e3);
    tissue.push(
        tool,
        Some(Push::Constant(Poke {
            point: None,
            centre_m: scene.shape().rest_m(scene.sheet().unwrap().point(point)),
            force_n: 3.0 * stiffness * spacing_m * towards,
            falloff_per_m: 10_f64.powf(2.0 * place[0] - 1.0) / spacing_m,
            falloff_offset: 0.0,
        })),
    );
}

fn all_finite(tissue: &dyn Tissue) -> bool {
    tissue.model().points().all(|index| {
        let point = tissue.point(index);
        let whole = point.displacement_m.is_finite() && point.velocity_m_per_s.is_finite();
        whole && point.reaction_n().is_finite() && point.constraint_n.is_none_or(DVec3::is_finite)
    })
}

fn energy_j(tissue: &dyn Tissue) -> f64 {
    let energy = tissue.energy();
    energy.kinetic_j + energy.spring_j + energy.anchor_j
}

/// Plays the acts for 256 steps, then releases and waits. Everything must be finite, and without tools no energy may
/// appear.
fn play(text: &str, acts: &[RandomAction]) -> Result<(), TestCaseError> {
    let limits = Limits { substeps: 400, ..Limits::default() };
    let scene = Scene::parse("random", text, &[], &limits).unwrap();
    // A scene that needs more substeps is refused, which is a valid result.
    let Ok(model) = Model::compile(&scene, &limits) else { return Ok(()) };
    let mut tissue = tissue::at_rest(&model);
    let mut acts = acts.to_vec();
    acts.sort_by_key(|act| act.step);
    let mut waiting = acts.into_iter().peekable();
    for step in 0..256 {
        while let Some(next) = waiting.next_if(|act| act.step == step) {
            act(&mut *tissue, next);
        }
        if tissue.step().is_err() {
            // Held: the state is finite and stays the same.
            prop_assert!(all_finite(&*tissue));
            return Ok(());
        }
        if step % 32 == 0 {
            prop_assert!(all_finite(&*tissue), "step {step}");
        }
    }
    (0..3).for_each(|tool| tissue.release(tool));
    tissue.step().ok();
    let mut before_j = energy_j(&*tissue);
    for window in 0..4 {
        for _ in 0..64 {
            if tissue.step().is_err() {
                prop_assert!(all_finite(&*tissue));
                return Ok(());
            }
        }
        prop_assert!(all_finite(&*tissue), "after, window {window}");
        let most_j = before_j * (1.0 + MARGIN) + 1e-18;
        let mut now_j = energy_j(&*tissue);
        // Since the guard has looked last, energy may have appeared. It does not outlast the next look, which comes within as many
        // steps: the guard goes back.
        if now_j > most_j {
            for _ in 0..INTERVAL_SUBSTEPS {
                if tissue.step().is_err() {
                    prop_assert!(all_finite(&*tissue));
                    return Ok(());
                }
            }
            now_j = energy_j(&*tissue);
        }
        prop_assert!(now_j <= most_j, "energy {before_j:e} to {now_j:e}, without a tool");
        before_j = before_j.max(now_j);
    }
    Ok(())
}

#[test]
fn random_scenes_stay_finite_and_take_no_energy_from_nowhere() {
    let cases = cases::count("PALPATE_STRESS_SCENES", 50, 1000);
    let mut runner =
        TestRunner::new(Config { cases, failure_persistence: None, max_shrink_iters: 200, ..Config::default() });
    let done = std::cell::Cell::new(0_u32);
    let input = (any_scene(), prop::collection::vec(any_act(), 0..12));
    let ended = runner.run(&input, |(text, acts)| {
        done.set(done.get() + 1);
        if done.get().is_multiple_of(1000) {
            eprintln!("{} scenes", done.get());
        }
        play(&text, &acts)
    });
    if let Err(failure) = ended {
        panic!("after {} scenes: {failure}", done.get());
    }
}

/// A free sheet that is pushed hundreds of spacings away, grasped at once where it was, and let go: two substeps are far too few for
/// that, and its energy grows by a third in 64 steps.
#[test]
fn energy_that_appears_between_two_looks_of_the_guard_does_not_outlast_the_second() {
    let scene = "[sheet]\npoints = [7, 3]\nspacing_m = 1.0\npoint_mass_kg = 3.2794546670559865e-2\nfixed = []\n\
                 [springs]\nstiffness_n_per_m = 1.559932287026399e4\nbending = true\n\
                 [anchor_springs]\nstiffness_n_per_m = 1.317469143691047e2\n\
                 [damping]\ncoefficient_n_s_per_m = 1.648929095254097e-3\n\
                 [stepping]\nintegrator = \"central\"\ntolerance = 1e-2\n";
    let towards = [0.5477845957859616, 0.7475874882048965, 0.16899049618750936];
    let push = RandomAction { step: 19, tool: 0, place: [0.39974532906274307, 0.0], towards, manner: 3 };
    let grasp =
        RandomAction { step: 139, tool: 0, place: [0.0; 2], towards: [0.0, 0.0, -0.5568062780921599], manner: 1 };
    play(scene, &[push, grasp]).unwrap();
}

#[test]
fn closed_meshes_of_any_material_stay_finite() {
    let meshes = cases::count("PALPATE_STRESS_MESHES", 4, 20);
    let steps: u64 = if meshes > 4 { 5000 } else { 250 };
    let (folder, limits) = (tempfile::tempdir().unwrap(), Limits { substeps: 400, ..Limits::default() });
    let mut played = 0;
    for seed in 0..meshes {
        let dice = &mut fastrand::Rng::with_seed(seed);
        std::fs::write(folder.path().join("mesh.obj"), closed_mesh(dice).obj()).unwrap();
        let mut decades = |from: f64, to: f64| 10_f64.powf(from + (to - from) * dice.f64());
        let text = format!(
            "[mesh]\nfile = \"mesh.obj\"\nunit = \"m\"\n[material]\nyoungs_modulus_pa = {:e}\nthickness_m = {:e}\n\
             foundation_n_per_m3 = {:e}\ndamping_ratio = {:e}\n[springs]\nbending = {}\n[[inclusion]]\ncentre_m = [0, 0, 0]\n\
             radius_m = 1.0\nstiffness_factor = {:e}\nanchor_stiffness_factor = {:e}\n[stepping]\ntolerance = 1e-2\n",
            decades(2.0, 5.0),
            decades(-3.0, -2.0),
            decades(3.0, 6.5),
            decades(-2.0, 1.0),
            [0.0, 0.1, 1.0][seed as usize % 3],
            decades(-1.5, 1.5),
            decades(-1.5, 1.5),
        );
        let scene = Scene::parse_in(folder.path(), "random", &text, &[], &limits).unwrap();
        let Ok(model) = Model::compile(&scene, &limits) else { continue };
        let mut tissue = tissue::at_rest(&model);
        let (shape, edge_m) = (scene.shape(), scene.shape().edge_m());
        let stiffness = scene.anchor_stiffness_n_per_m + 0.3 * scene.springs.stiffness_n_per_m;
        played += 1;
        for step in 0..steps {
            if step % 25 == 0 {
                let point = palpate_tissue::shape::PointId::new(dice.usize(0..shape.point_count()));
                let towards = DVec3::from_array([(); 3].map(|()| 2.0 * dice.f64() - 1.0));
                let tool = dice.usize(0..3);
                match dice.u8(0..4) {
                    0 => tissue.release(tool),
                    1 => tissue.grasp(tool, point, Grasp::Target(2.5 * edge_m * towards)),
                    _ => tissue.push(
                        tool,
                        Some(Push::Constant(Poke {
                            point: None,
                            centre_m: shape.rest_m(point),
                            force_n: 3.0 * stiffness * edge_m * towards,
                            falloff_per_m: 10_f64.powf(2.0 * dice.f64() - 1.0) / edge_m,
                            falloff_offset: 0.0,
                        })),
                    ),
                }
            }
            let is_held = tissue.step().is_err();
            if is_held || step % 50 == 0 {
                assert!(all_finite(&*tissue), "mesh {seed}, step {step}");
            }
            if is_held {
                break;
            }
        }
    }
    assert!(2 * played >= meshes, "{played} of {meshes} were played");
}

/// Steps a tissue; after a blow-up it goes on from its last sound state, as in a session. Returns whether that was so.
fn recovers(tissue: &mut dyn Tissue) -> bool {
    let Err(blow_up) = tissue.step() else { return false };
    tissue.recover(blow_up.step, false);
    true
}

/// Tips that jump through random solids, up to 80 % deep, at any place and speed; forces a hundred times those of a hand;
/// lumps up to 100 times as stiff. Everything stays finite, and afterwards the solid comes back to rest.
#[test]
fn abused_solids_stay_finite_and_come_back_to_rest() {
    let from = cases::count("PALPATE_STRESS_SOLIDS_FROM", 0_u64, 0);
    let solids = cases::count("PALPATE_STRESS_SOLIDS", 4, 100);
    let seeds: Vec<u64> = (from..from + solids).collect();
    let played: Vec<_> = cases::on_every_core(&seeds, |seed| abused(*seed)).into_iter().flatten().collect();
    let sum = |of: fn(&[u64; 2]) -> u64| played.iter().map(of).sum::<u64>();
    let (guarded, recovered) = (sum(|of| of[0]), sum(|of| of[1]));
    println!("{} of {solids} solids, {guarded} events of the guard, {recovered} recoveries", played.len());
    assert!(2 * played.len() as u64 >= solids, "{} of {solids} were played", played.len());
}

/// A solid of which a part is torn around so far that it comes to rest inside out: the guard brings it to its shape.
#[test]
fn a_solid_that_comes_to_rest_inside_out_returns_to_its_shape() {
    let [guarded, recovered] = abused(286).unwrap();
    assert_eq!((guarded, recovered), (1, 0));
}

/// Abuses a random solid. Returns the events of its guard and its recoveries; `None` if no solid comes of the seed.
fn abused(seed: u64) -> Option<[u64; 2]> {
    let mut recovered = 0;
    let mut case = solid_case(seed);
    let dice = &mut fastrand::Rng::with_seed(seed);
    case.scene += &format!(
        "[[inclusion]]\ncentre_m = [0, 0, 0]\nradius_m = 0.01\nstiffness_factor = {:e}\n",
        10_f64.powf(2.0 * dice.f64())
    );
    let limits = Limits { substeps: 400, ..Limits::default() };
    let sets = ["stepping.tolerance=1e-2".to_owned(), "material.damping_per_s=30".to_owned()];
    let scene = random_scenes::scene(&case, &sets, &limits).ok()?;
    let model = Model::compile(&scene, &limits).ok()?;
    let mut tissue = tissue::at_rest(&model);
    let (shape, cell_m) = (scene.shape(), scene.shape().edge_m());
    let (size_m, middle_m) = (shape.extent().size_m(), shape.extent().middle_m());
    let hand_n = 0.2 * scene.springs.stiffness_n_per_m * cell_m;
    let mut largest_m = 0.0_f64;
    for step in 0..300 {
        if step % 15 == 0 {
            let tool = dice.usize(0..3);
            let mut within = || 2.0 * dice.f64() - 1.0;
            let (side, towards) = (DVec3::new(within(), within(), 1.0), DVec3::new(within(), within(), within()));
            match dice.u8(0..5) {
                0 => tissue.release(tool),
                1 | 2 => {
                    // From the surface to a fifth of the height.
                    let at = DVec3::new(0.4, 0.4, 0.5 - 0.8 * dice.f64()) * side * size_m;
                    let shape = TipShape::ALL[dice.usize(0..3)];
                    let radius_m = cell_m * (0.5 + 2.0 * dice.f64());
                    tissue.pose(tool, middle_m + at, Tip { shape, radius_m, ..Tip::default() });
                }
                3 => {
                    let point = palpate_tissue::shape::PointId::new(dice.usize(0..shape.point_count()));
                    if !shape.is_fixed(point) {
                        tissue.grasp(tool, point, Grasp::Target(3.0 * cell_m * towards));
                    }
                }
                _ => tissue.push(
                    tool,
                    Some(Push::Constant(Poke {
                        point: None,
                        centre_m: middle_m + 0.4 * side * size_m,
                        force_n: 100.0 * hand_n * towards,
                        falloff_per_m: 10_f64.powf(dice.f64()) / cell_m,
                        falloff_offset: 0.0,
                    })),
                ),
            }
        }
        recovered += u64::from(recovers(&mut *tissue));
        if step % 10 == 0 {
            assert!(all_finite(&*tissue), "{}, step {step}", case.about);
            largest_m = largest_m.max(tissue.largest_displacement_m());
        }
    }
    (0..3).for_each(|tool| tissue.release(tool));
    // What sleeps may be from rest by the tolerance of what it did.
    let (near_m, asleep_m) = (0.05 * cell_m, 1e-2 * largest_m);
    // A heavy part on a soft neck creeps back for tens of seconds under this damping.
    let mut waited = 0;
    while waited < 100_000 && !tissue.is_still() && tissue.largest_displacement_m() >= near_m {
        recovered += u64::from(recovers(&mut *tissue));
        waited += 1;
    }
    let left_m = tissue.largest_displacement_m();
    assert!(
        left_m < near_m.max(asleep_m),
        "{}: {:.3} cells from rest, {waited} steps after",
        case.about,
        left_m / cell_m
    );
    Some([tissue.guard_events(), recovered])
}

/// Scenes where only the damping is fast, dt·C/m from 0.7 to 90: `rk4` was stable by its vibrations alone, and grew.
#[test]
fn strong_damping_alone_lets_no_scheme_grow() {
    let held = RandomAction { step: 0, tool: 0, place: [0.0; 2], towards: [0.0, 0.0, 0.77], manner: 1 };
    for integrator in ["auto"].into_iter().chain(common::schemes()) {
        for damping in [0.2, 0.7, 0.75, 1.4, 6.0, 25.0] {
            let text = format!(
                "[sheet]\npoints = [3, 7]\nspacing_m = 1.0\npoint_mass_kg = 2.5e-4\nfixed = []\n\
                 [springs]\nstiffness_n_per_m = 0.015\nbending = false\n\
                 [anchor_springs]\nstiffness_n_per_m = 1.0\n[damping]\ncoefficient_n_s_per_m = {damping}\n\
                 [stepping]\nintegrator = \"{integrator}\"\ntolerance = 1e-2\n"
            );
            play(&text, &[held]).unwrap_or_else(|failure| panic!("{integrator}, C = {damping}: {failure}"));
        }
    }
}

/// Adversarial tools, at 1 kHz.
#[test]
fn adversarial_commands_leave_the_tissue_finite() {
    for worst in 0..4 {
        let scene = scene_with(SMALL, &["stepping.precision=f32"]);
        let model = model(&scene);
        let mut tissue = tissue::at_rest(&model);
        // The sign changes at the frequency of the fastest vibration at rest.
        let half_period = (std::f64::consts::PI / model.omega_bound_per_s * scene.stepping.rate_hz).max(1.0) as u64;
        for step in 0..2000_u64 {
            let sign = if (step / half_period).is_multiple_of(2) { 1.0 } else { -1.0 };
            let corner = [[0, 0], [6, 4], [0, 4], [6, 0]][(step % 4) as usize];
            let place = DVec3::new(sign, -sign, sign) * 0.3;
            match worst {
                0 => tissue.grasp(0, model.scene.sheet().unwrap().point(corner), Grasp::Target(place)),
                1 => tissue.push(0, Some(common::push_on(&scene, corner, [1e4, 1e4 * sign, -1e4]))),
                2 => tissue.push(0, Some(common::push_on(&scene, [3, 2], [50.0 * sign, 20.0, 100.0 * sign]))),
                _ => {
                    tissue.grasp((step % 3) as usize, model.scene.sheet().unwrap().point([3, 2]), Grasp::Target(place));
                }
            }
            if tissue.step().is_err() {
                break;
            }
            assert!(all_finite(&*tissue), "{worst}, step {step}");
        }
        assert!(all_finite(&*tissue));
    }
}

#[test]
fn a_sheet_that_wrinkles_stays_bounded() {
    let sets = ["springs.stiffness_n_per_m=1e4", "sheet.points=[15, 15]", "sheet.point_mass_kg=0.01"];
    let scene = scene_with(SMALL, &sets);
    let mut tissue = tissue::at_rest(&model(&scene));
    // Both sides pressed towards the middle, and a little out of the plane.
    tissue.push(0, Some(common::push_on(&scene, [0, 7], [400.0, 0.0, 0.5])));
    tissue.push(1, Some(common::push_on(&scene, [14, 7], [-400.0, 0.0, -0.3])));
    for _ in 0..500 {
        tissue.step().unwrap();
    }
    assert!(all_finite(&*tissue) && tissue.largest_displacement_m() < 10.0 * scene.shape().longest_side_m());
}

#[test]
#[ignore = "ten million steps: make stress"]
fn ten_million_steps_end_where_they_should() {
    // Every step must be computed: nothing may sleep.
    let scene = scene_with(SMALL, &["stepping.precision=auto", "sleep.tolerance=0"]);
    let mut tissue = tissue::at_rest(&model(&scene));
    tissue.push(0, Some(common::push_on(&scene, [3, 2], [0.1, 0.0, -0.3])));
    let mut settled = None;
    for million in 0..10 {
        for _ in 0..1_000_000 {
            tissue.step().unwrap();
        }
        let now = tissue.point(tissue.model().scene.sheet().unwrap().point([3, 2])).displacement_m;
        eprintln!("{} million steps: {now}", million + 1);
        assert!(all_finite(&*tissue));
        let settled = *settled.get_or_insert(now);
        assert!((now - settled).length() < 1e-6 * settled.length(), "{settled} crept to {now}");
    }
    tissue.release(0);
    for _ in 0..1_000_000 {
        tissue.step().unwrap();
    }
    assert!(tissue.largest_displacement_m() < 1e-9 * scene.sheet().unwrap().spacing_m);
}
