//! Random scenes under random tools, with sleep and without: the difference is within the tolerance of sleep.
//!
//! 24 in every test run; `PALPATE_SLEEP=5000` takes as many as that, from the seed `PALPATE_SLEEP_FROM` on.
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_precision_loss,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::disallowed_methods
)]

use std::sync::Arc;

use crate::common::thin_mesh::thread;
use glam::DVec3;
use palpate_haptics::Tip;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Scene;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::shape::PointId;
use palpate_tissue::{self as tissue, Grasp, Model, Push, Tissue};

const STEPS: u64 = 400;

/// A disturbance of the tolerance has to change a course by this part of what sleep does, where that is beyond the
/// tolerance.
const AS_SENSITIVE: f64 = 0.3;

/// The most disturbances tried: whether a tip touches, slides or lets go may hang on one of them.
const DISTURBANCES: usize = 24;

/// The number of the first disturbing tool. Those of the acts have lower ones.
const FIRST_DISTURBING: usize = 8;

/// A sheet of several tiles, or a closed tube, of a random material.
fn scene(folder: &std::path::Path, dice: &mut fastrand::Rng, sleep_tolerance: f64) -> [Result<Arc<Model>, String>; 2] {
    let mut decades = |from: f64, to: f64| 10_f64.powf(from + (to - from) * dice.f64());
    let (turn, ratio, zeta) = (decades(-1.7, 0.0), decades(-0.5, 2.0), decades(-1.3, 0.5));
    let integrator = ["auto", "auto", "central", "exponential3", "rk4"][dice.usize(0..5)];
    let rest = format!("[stepping]\nintegrator = \"{integrator}\"\ntolerance = 1e-2\nprecision = \"f64\"\n");
    let text = if dice.u8(0..3) > 0 {
        let [nx, ny] = [(); 2].map(|()| dice.u32(17..50));
        let (mass, spacing_m) = (1e-3, 0.01);
        let stiffness = mass * (turn / 1e-3).powi(2) / 12.0;
        let of_place = stiffness / ratio;
        format!(
            "[sheet]\npoints = [{nx}, {ny}]\nspacing_m = {spacing_m}\npoint_mass_kg = {mass}\nfixed = {}\n[springs]\n\
             stiffness_n_per_m = {stiffness:e}\nbending = {}\n[anchor_springs]\nstiffness_n_per_m = {of_place:e}\n[damping]\n\
             coefficient_n_s_per_m = {:e}\n{rest}",
            ["[]", "\"edges\"", "\"corners\""][dice.usize(0..3)],
            dice.bool(),
            2.0 * zeta * (of_place * mass).sqrt(),
        )
    } else {
        let mesh = thread(0.02, 0.08, dice.u32(16..33), dice.u32(16..41));
        std::fs::write(folder.join("mesh.obj"), mesh.obj()).unwrap();
        let foundation = 10.0 * (turn / 1e-3).powi(2) / (10.0 * ratio + 1.0);
        let youngs_modulus_pa = ratio * foundation * 0.004 * 0.004 / 1e-3;
        format!(
            "[mesh]\nfile = \"mesh.obj\"\nunit = \"m\"\n[material]\nyoungs_modulus_pa = {youngs_modulus_pa:e}\nthickness_m = 1e-3\n\
             depth_m = 0.03\nfoundation_n_per_m3 = {foundation:e}\ndamping_ratio = {zeta:e}\n{rest}"
        )
    };
    let limits = Limits { substeps: 40, ..Limits::default() };
    [sleep_tolerance, 0.0].map(|tolerance| {
        let set = [format!("sleep.tolerance={tolerance:e}")];
        let scene = Scene::parse_in(folder, "random", &text, &set, &limits);
        scene.and_then(|scene| Model::compile(&scene, &limits)).map_err(|refusal| refusal.to_string())
    })
}

/// Action of a tool from a step on.
enum ToolChange {
    /// Holds a point and takes it along at a speed, m/s, after a jump, m.
    Grasp(PointId, DVec3, DVec3),
    /// Leads a tip from a place at a speed.
    Pose(DVec3, DVec3, Tip),
    Push(Poke),
    Release,
}

impl ToolChange {
    /// Returns the place of the action, m.
    fn place_m(&self, model: &Model) -> Option<DVec3> {
        match self {
            ToolChange::Grasp(point, ..) => Some(model.scene.shape().rest_m(*point)),
            ToolChange::Pose(place_m, ..) => Some(*place_m),
            ToolChange::Push(push) => Some(push.centre_m),
            ToolChange::Release => None,
        }
    }
}

fn random_act(model: &Model, dice: &mut fastrand::Rng) -> ToolChange {
    let shape = model.scene.shape();
    let point = loop {
        let point = PointId::new(dice.usize(0..shape.point_count()));
        if !shape.is_fixed(point) {
            break point;
        }
    };
    let edge_m = shape.edge_m();
    let mut random = || DVec3::from_array([(); 3].map(|()| 2.0 * dice.f64() - 1.0));
    let (jump_m, way) = (edge_m * random(), random());
    let speed = [0.0, 0.05, 0.5][dice.usize(0..3)];
    match dice.u8(0..6) {
        0 | 1 => ToolChange::Grasp(point, [0.0, 1.0][dice.usize(0..2)] * jump_m, speed * way),
        2 | 3 => {
            let tip = Tip {
                radius_m: edge_m * (0.5 + 3.0 * dice.f64()),
                friction: [0.0, 0.4][dice.usize(0..2)],
                grasps: dice.bool(),
                ..Tip::default()
            };
            let place_m = shape.rest_m(point) - 0.5 * edge_m * dice.f64() * shape.normal(point);
            ToolChange::Pose(place_m, 0.1 * speed * way, tip)
        }
        4 => {
            let stiffness = model.scene.anchor_stiffness_n_per_m + 0.3 * model.scene.springs.stiffness_n_per_m;
            ToolChange::Push(Poke {
                point: Some(point),
                centre_m: shape.rest_m(point),
                force_n: 0.5 * edge_m * stiffness * way,
                falloff_per_m: 10_f64.powf(dice.f64() - 0.5) / edge_m,
                falloff_offset: 0.0,
            })
        }
        _ => ToolChange::Release,
    }
}

/// Actions on both of a pair of tissues.
struct Hands {
    acts: Vec<(u64, usize, ToolChange)>,
}

impl Hands {
    fn act(&self, tissue: &mut dyn Tissue, step: u64) {
        for (from, tool, act) in &self.acts {
            // The newest act of each tool counts.
            if *from > step || self.acts.iter().any(|(other, of, _)| of == tool && other > from && *other <= step) {
                continue;
            }
            let since_s = (step - from) as f64 * 1e-3;
            match act {
                ToolChange::Grasp(point, jump_m, way) => {
                    tissue.grasp(*tool, *point, Grasp::Target(*jump_m + (since_s.min(0.05)) * *way));
                }
                ToolChange::Pose(place_m, way, tip) => tissue.pose(*tool, *place_m + since_s.min(0.2) * *way, *tip),
                ToolChange::Push(poke) if *from == step => tissue.push(*tool, Some(Push::Constant(*poke))),
                ToolChange::Release if *from == step => tissue.release(*tool),
                _ => {}
            }
        }
    }
}

/// The largest displacement of a course without sleep, and the largest difference of another to it at the end of any
/// step, m. Stops at a blow-up.
fn compared(
    hands: &Hands,
    model: &Arc<Model>,
    other: &Arc<Model>,
    disturb: impl Fn(&mut dyn Tissue, u64),
) -> Option<(f64, f64)> {
    let [mut awake, mut tissue] = [model, other].map(tissue::at_rest);
    let (mut largest_m, mut difference_m) = (0.0_f64, 0.0_f64);
    let (mut of_awake, mut of_other) = (Vec::new(), Vec::new());
    for step in 0..STEPS {
        for tissue in [&mut awake, &mut tissue] {
            hands.act(&mut **tissue, step);
        }
        disturb(&mut *tissue, step);
        awake.step().ok()?;
        tissue.step().ok()?;
        if awake.guard_events() + tissue.guard_events() > 0 {
            return None;
        }
        if step % 5 == 4 {
            awake.whole_displacements_m(&mut of_awake);
            tissue.whole_displacements_m(&mut of_other);
            for (a, b) in of_awake.iter().zip(&of_other) {
                (largest_m, difference_m) = (largest_m.max(a.abs()), difference_m.max((a - b).abs()));
            }
        }
    }
    Some((largest_m, difference_m))
}

/// Result of a seed.
enum SeedOutcome {
    /// The scene needs too many substeps, or the guard acted.
    Left,
    Within,
    /// Beyond the tolerance, and so is what a disturbance of that size does.
    Sensitive,
    Beyond(String),
}

fn play(seed: u64) -> SeedOutcome {
    let dice = &mut fastrand::Rng::with_seed(seed);
    let folder = tempfile::tempdir().unwrap();
    let tolerance = 10_f64.powf(-6.0 + 3.0 * dice.f64());
    let [Ok(sleeping), Ok(awake)] = scene(folder.path(), dice, tolerance) else { return SeedOutcome::Left };
    let mut acts = Vec::new();
    for _ in 0..dice.usize(2..9) {
        acts.push((dice.u64(0..STEPS * 3 / 4), dice.usize(0..3), random_act(&awake, dice)));
    }
    acts.sort_by_key(|(step, tool, _)| (*step, *tool));
    acts.dedup_by_key(|(step, tool, _)| (*step, *tool));
    let hands = Hands { acts };
    let Some((largest_m, difference_m)) = compared(&hands, &awake, &sleeping, |_, _| {}) else {
        return SeedOutcome::Left;
    };
    if difference_m <= tolerance * largest_m {
        return SeedOutcome::Within;
    }
    // Permanent forces that move the points where tools act, and one more, by no more than the tolerance. A tip that
    // is put just between two places of its disc may take either, so the forces go three ways.
    let shape = awake.scene.shape();
    let mut places_m = vec![shape.rest_m(PointId::new(dice.usize(0..shape.point_count())))];
    places_m.extend(hands.acts.iter().filter_map(|(_, _, act)| act.place_m(&awake)));
    let mut disturbed_m = 0.0_f64;
    for _ in 0..DISTURBANCES {
        let pushes: Vec<Poke> = places_m
            .iter()
            .map(|place_m| Poke {
                point: None,
                centre_m: *place_m,
                force_n: tolerance * largest_m * awake.scene.anchor_stiffness_n_per_m / places_m.len() as f64
                    * DVec3::from_array([(); 3].map(|()| 2.0 * dice.f64() - 1.0)).normalize_or(DVec3::Z),
                falloff_per_m: 0.1 / shape.edge_m(),
                falloff_offset: 0.0,
            })
            .collect();
        let disturb = |tissue: &mut dyn Tissue, step: u64| {
            for (tool, push) in pushes.iter().enumerate().filter(|_| step == 0) {
                tissue.push(FIRST_DISTURBING + tool, Some(Push::Constant(*push)));
            }
        };
        let Some((_, other_m)) = compared(&hands, &awake, &awake, disturb) else { return SeedOutcome::Sensitive };
        disturbed_m = disturbed_m.max(other_m);
        if disturbed_m >= AS_SENSITIVE * difference_m {
            return SeedOutcome::Sensitive;
        }
    }
    SeedOutcome::Beyond(format!(
        "seed {seed}: {:.3e} of the largest displacement, {tolerance:.3e} asked for; disturbances of that: {:.3e}; {} points, {:?}",
        difference_m / largest_m,
        disturbed_m / largest_m,
        shape.point_count(),
        awake.plan.scheme,
    ))
}

#[test]
fn sleep_under_tools_errs_by_no_more_than_its_tolerance() {
    let number = |name: &str| std::env::var(name).ok().map(|text| text.parse::<u64>().unwrap());
    let (from, count) = (number("PALPATE_SLEEP_FROM").unwrap_or(0), number("PALPATE_SLEEP").unwrap_or(24));
    let [mut left, mut within, mut sensitive] = [0; 3];
    let mut beyond = Vec::new();
    for seed in from..from + count {
        match play(seed) {
            SeedOutcome::Left => left += 1,
            SeedOutcome::Within => within += 1,
            SeedOutcome::Sensitive => sensitive += 1,
            SeedOutcome::Beyond(text) => beyond.push(text),
        }
        if (seed - from + 1).is_multiple_of(500) {
            eprintln!("{} of {count}: {} beyond", seed - from + 1, beyond.len());
        }
    }
    eprintln!("{count} scenes: {within} within, {sensitive} as sensitive, {} beyond, {left} left out", beyond.len());
    assert!(beyond.is_empty(), "{}", beyond.join("\n"));
    assert!(2 * within > count, "{within} of {count} were within");
}
