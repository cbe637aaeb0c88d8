//! Random tips on random meshes with thin parts: everything stays finite, and no energy comes from nowhere.
//!
//! 20 in every test run; `PALPATE_STRESS_THIN=10000` takes as many as that, from the seed `PALPATE_STRESS_THIN_FROM` on, and
//! `PALPATE_STRESS_THIN_STEPS=400` runs each for longer.
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_precision_loss,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::disallowed_methods
)]

use std::sync::Arc;

use crate::common::thin_mesh::{ThinMesh, thin_mesh, thread};
use glam::DVec3;
use palpate_haptics::{Coupling, Tip};
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Scene;
use palpate_tissue::{self as tissue, Model, Tissue};

/// A scene on a mesh, of a random material. One in fifty chooses its own scheme, which takes longer than the steps of a test.
fn model(folder: &std::path::Path, mesh: &ThinMesh, dice: &mut fastrand::Rng) -> Option<Arc<Model>> {
    let limits = Limits { substeps: 20, ..Limits::default() };
    std::fs::write(folder.join("mesh.obj"), mesh.obj()).unwrap();
    let fixed = ["\"none\"", "\"rim\"", "[{ centre_m = [0, 0, 0], radius_m = 0.001 }]"][dice.usize(0..3)];
    let mut decades = |from: f64, to: f64| 10_f64.powf(from + (to - from) * dice.f64());
    let text = format!(
        "[mesh]\nfile = \"mesh.obj\"\nunit = \"m\"\nfixed = {fixed}\n[material]\nyoungs_modulus_pa = {:e}\nthickness_m = {:e}\n\
         depth_m = {:e}\nfoundation_n_per_m3 = {:e}\ndamping_ratio = {:e}\n",
        decades(3.0, 4.7),
        decades(-3.5, -2.5),
        decades(-2.0, -1.3),
        decades(5.0, 6.5),
        decades(-1.5, 0.3),
    );
    let compiled = |set: &[String], limits: &Limits| {
        let scene = Scene::parse_in(folder, "random", &text, set, limits).ok()?;
        Model::compile(&scene, limits).ok().filter(|model| model.plan.stable)
    };
    let integrator = ["central", "exponential2", "exponential3", "rk4"][dice.usize(0..4)];
    let stable = |substeps: u32| {
        let set = [format!("stepping.integrator={integrator}"), format!("stepping.substeps={substeps}")];
        compiled(&set, &Limits { rehearsal_work: 1, ..limits.clone() })
    };
    if dice.u8(0..50) == 0 {
        compiled(&["stepping.tolerance=1e-2".into()], &limits)
    } else {
        [1, 2, 3, 5, 8, 13, 20].into_iter().find_map(stable)
    }
}

/// A tip that comes, presses, goes along, jumps, and leaves.
fn tip(dice: &mut fastrand::Rng) -> Tip {
    let coupling = match dice.u8(0..5) {
        0 => Coupling::Spring { stiffness_n_per_m: 200.0, damping_n_s_per_m: 0.5 },
        _ => Coupling::Constraint,
    };
    let radius_m = 10_f64.powf(-3.3 + 1.3 * dice.f64());
    let friction = [0.0, 0.2, 0.8][dice.usize(0..3)];
    Tip { radius_m, friction, grasps: dice.u8(0..6) == 0, coupling, ..Tip::default() }
}

fn energy_j(tissue: &dyn Tissue) -> f64 {
    let energy = tissue.energy();
    energy.kinetic_j + energy.spring_j + energy.anchor_j
}

/// Energies below this are not compared, J.
const MIN_J: f64 = 1e-6;

/// An energy may be so many times the work, because between the ends of a step a force may have been larger than there.
const MAX_PART: f64 = 1.25;

/// The most that a tool can have done, from outside: by what is felt, and not by what the tissue counts itself.
#[derive(Debug, Clone, Copy)]
struct WorkBound {
    mass_kg: f64,
    step_s: f64,
    place_m: DVec3,
    way_m: DVec3,
    felt_n: f64,
    /// The most that the tool can have done.
    work_j: f64,
}

impl WorkBound {
    fn begin(model: &Model, place_m: DVec3) -> WorkBound {
        let (mass_kg, step_s) = (model.scene.mass_kg(), 1.0 / model.scene.stepping.rate_hz);
        WorkBound { mass_kg, step_s, place_m, way_m: DVec3::ZERO, felt_n: 0.0, work_j: 0.0 }
    }

    /// Adds a step's work: the larger of the forces at its ends along its whole way. What a tool sets in motion at once is not felt,
    /// but goes at most twice as fast as the tool.
    fn step(&mut self, place_m: DVec3, felt_n: f64, is_put: bool, displacement_m: f64) {
        let way_m = place_m - self.place_m;
        let meets = self.felt_n == 0.0 && (is_put || felt_n > 0.0);
        let (way, sudden) = if meets {
            let way = way_m.length().max(displacement_m);
            (way, way)
        } else {
            (way_m.length(), (way_m - self.way_m).length())
        };
        let speed_m_per_s = 2.0 * sudden / self.step_s;
        self.work_j += way * felt_n.max(self.felt_n) + 0.5 * self.mass_kg * speed_m_per_s * speed_m_per_s;
        (self.place_m, self.way_m, self.felt_n) = (place_m, way_m, felt_n);
    }
}

/// The most of a run.
#[derive(Debug, Default, Clone, Copy)]
struct Extremes {
    blow_ups: u64,
    guard_events: u64,
    force_n: f64,
    energy_j: f64,
    displacement_m: f64,
    /// The largest part that an energy was of the work until then.
    part: f64,
}

fn play(seed: u64, steps: u64) -> Option<(Extremes, &'static str)> {
    let dice = &mut fastrand::Rng::with_seed(seed);
    let folder = tempfile::tempdir().unwrap();
    let mesh = thin_mesh(dice, seed as usize);
    let model = model(folder.path(), &mesh, dice)?;
    let mut tissue = tissue::at_rest(&model);
    let shape = model.scene.shape();
    let mut course = Extremes::default();
    let (mut place_m, mut way_m, mut now) = (DVec3::ZERO, DVec3::ZERO, tip(dice));
    let (mut bound, mut has_recovered) = (None, false);
    for step in 0..steps {
        let is_put = step % 40 == 0 || std::mem::take(&mut has_recovered);
        if step % 40 == 0 {
            let point = palpate_tissue::shape::PointId::new(dice.usize(0..shape.point_count()));
            let mut random = || DVec3::from_array([(); 3].map(|()| 2.0 * dice.f64() - 1.0));
            let target_m = shape.rest_m(point) + 0.5 * now.radius_m * random();
            let from_m = target_m + 2.0 * now.radius_m * random();
            match if step == 0 { 0 } else { dice.u8(0..8) } {
                0 => {
                    tissue.release(0);
                    (place_m, now) = (from_m, tip(dice));
                    way_m = (target_m - place_m) / 40.0;
                }
                // A jump.
                1 => (place_m, way_m) = (target_m, DVec3::ZERO),
                2 | 3 => way_m = DVec3::ZERO,
                _ => way_m = (target_m - place_m) / 40.0,
            }
        }
        place_m += way_m;
        tissue.pose(0, place_m, now);
        let bound = bound.get_or_insert_with(|| WorkBound::begin(&model, place_m));
        if let Err(blow_up) = tissue.step() {
            course.blow_ups += 1;
            tissue.recover(blow_up.step, false);
            // All tools were released: what comes next is put.
            (bound.place_m, bound.felt_n, has_recovered) = (place_m, 0.0, true);
            continue;
        }
        let felt_n = tissue.tool_contact(0).unwrap().force_on_tool_n.length();
        course.force_n = course.force_n.max(felt_n);
        bound.step(place_m, felt_n, is_put, tissue.largest_displacement_m());
        let energy_j = energy_j(&*tissue);
        course.energy_j = course.energy_j.max(energy_j);
        course.part = course.part.max((energy_j - MIN_J) / (bound.work_j + MIN_J));
        course.displacement_m = course.displacement_m.max(tissue.largest_displacement_m());
        assert!(course.energy_j.is_finite() && felt_n.is_finite(), "{seed} {}, step {step}: {course:?}", mesh.kind);
    }
    course.guard_events = tissue.guard_events();
    Some((course, mesh.kind))
}

/// Runs in which a disc that stopped sliding was drawn to its tool at once or kept the normal of a place that it had left, or a tip that
/// came from beside the tissue was put into it.
const FOUND: [u64; 8] = [34, 435, 470, 481, 482, 511, 925, 1405];

/// Before contact was balanced, one in ten of these reached joules to megajoules, and up to kilometres.
#[test]
fn tips_on_thin_meshes_get_no_energy_from_nowhere() {
    let number = |name: &str| std::env::var(name).ok().map(|text| text.parse::<u64>().unwrap());
    let all = number("PALPATE_STRESS_THIN");
    let (from, count) = (number("PALPATE_STRESS_THIN_FROM").unwrap_or(0), all.unwrap_or(12));
    let steps = number("PALPATE_STRESS_THIN_STEPS").unwrap_or(80);
    let (mut played, mut blew_up, mut guarded) = (0, 0, 0);
    let mut beyond = Vec::new();
    let found = if all.is_some() { &[][..] } else { &FOUND };
    for seed in (from..from + count).chain(found.iter().copied()) {
        let Some((course, kind)) = play(seed, steps) else { continue };
        played += 1;
        blew_up += u64::from(course.blow_ups > 0);
        guarded += u64::from(course.guard_events > 0);
        if course.part > MAX_PART {
            let found = format!("{seed} {kind}: {course:?}");
            eprintln!("{found}");
            beyond.push(found);
        }
        if all.is_some() && (seed - from + 1).is_multiple_of(500) {
            eprintln!("{} of {count}: {} beyond", seed - from + 1, beyond.len());
        }
    }
    eprintln!("of {played} meshes the guard acted on {guarded}, and {blew_up} had to recover");
    assert!(beyond.is_empty(), "{}", beyond.join("\n"));
    assert!(2 * played > count, "{played} of {count} were played");
}

/// A fingertip, wider than the thread, comes down on its end, along its side and across it, and goes again. It reached 385 m and
/// 4.7 MJ.
#[test]
fn a_fingertip_on_a_thread_does_what_its_work_allows() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("mesh.obj"), thread(0.001, 0.03, 12, 30).obj()).unwrap();
    let text = "[mesh]\nfile = \"mesh.obj\"\nunit = \"m\"\n[material]\nyoungs_modulus_pa = 8000\nthickness_m = 0.0005\n\
                depth_m = 0.04\nfoundation_n_per_m3 = 1.34e6\ndamping_ratio = 0.5\n[stepping]\ntolerance = 1e-3\n";
    let limits = Limits::default();
    let scene = Scene::parse_in(folder.path(), "thread", text, &[], &limits).unwrap();
    let model = Model::compile(&scene, &limits).unwrap();
    let [end, side, off] = [DVec3::new(0.0, 0.0, 0.034), DVec3::new(0.004, 0.0, 0.015), DVec3::new(0.0003, 0.0, 0.034)];
    for (from_m, to_m) in
        [(end, DVec3::new(0.0, 0.0, 0.027)), (side, DVec3::new(-0.003, 0.0, 0.015)), (off, DVec3::ZERO)]
    {
        let mut tissue = tissue::at_rest(&model);
        let tip = Tip { radius_m: 0.005, friction: 0.2, ..Tip::default() };
        let (mut force_n, mut energy) = (0.0_f64, 0.0_f64);
        for step in 0..1500_u32 {
            let t = f64::from(step) / 1000.0;
            let part = (t / 0.5).min(1.0) - ((t - 0.9) / 0.5).clamp(0.0, 1.0);
            tissue.pose(0, from_m.lerp(to_m, part), tip);
            tissue.step().unwrap();
            force_n = force_n.max(tissue.tool_contact(0).unwrap().force_on_tool_n.length());
            energy = energy.max(energy_j(&*tissue));
        }
        assert_eq!(tissue.guard_events(), 0, "{from_m}");
        assert!(energy < 1e-3 && force_n < 0.5, "{from_m}: {energy} J, {force_n} N");
        assert!(energy > 1e-9 && energy_j(&*tissue) < 1e-6, "{from_m}: {energy} J");
    }
}
