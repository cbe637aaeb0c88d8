//! Random scenes whose fields are at their bounds: each is refused by the name of a field, or it is checked, touched
//! and stepped, with finite numbers.
//!
//! 200 in every test run; `PALPATE_STRESS_BOUNDS=10000` takes as many as that, from the seed
//! `PALPATE_STRESS_BOUNDS_FROM` on, and prints which took longer than a second.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use std::fmt::Write;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use crate::common::closed_mesh;
use crate::common::closed_mesh::closed_mesh;
use fastrand::Rng;
use glam::DVec3;
use palpate_haptics::{Coupling, Tip};
use palpate_refusal::Refusal;
use palpate_session::command::Command;
use palpate_session::intake::Intake;
use palpate_session::{Session, check};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Scene;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::{Action, Script};

const LEASE: u128 = 1;

/// Zeros, the smallest numbers of both formats and the largest, those whose squares are none, and numbers beside 1.
const EXTREMES: [f64; 22] = [
    0.0,
    5e-324,
    2.3e-308,
    1e-160,
    1.4e-45,
    1.2e-38,
    1e-20,
    1e-12,
    1e-9,
    1e-6,
    0.01,
    1.0,
    10.0,
    100.0,
    1e6,
    1e9,
    1e12,
    3.4e38,
    3.5e38,
    1e155,
    1.5e308,
    f64::MAX,
];

/// A number as usual, or an extreme one.
fn number(dice: &mut Rng, usual: f64, odds: f64) -> f64 {
    match dice.f64() {
        odd if odd >= odds => usual,
        odd if odd < 0.7 * odds => EXTREMES[dice.usize(0..EXTREMES.len())],
        // Something between, which the rest may allow.
        _ => usual * 10_f64.powf(12.0 * dice.f64() - 6.0),
    }
}

/// Writes `key = number`, or leaves it out.
fn maybe(text: &mut String, dice: &mut Rng, key: &str, usual: f64, odds: f64) {
    if dice.f64() < 0.6 {
        let _ = writeln!(text, "{key} = {:e}", number(dice, usual, odds));
    }
}

fn pick<'t>(dice: &mut Rng, all: &[&'t str]) -> &'t str {
    all[dice.usize(0..all.len())]
}

/// A scene as a file says it, and its mesh.
fn scene(seed: u64) -> (String, Option<String>) {
    let mut dice = Rng::with_seed(seed);
    let dice = &mut dice;
    let odds = [0.03, 0.1, 0.3][dice.usize(0..3)];
    let mut text = String::new();
    let mesh = dice.bool().then(|| closed_mesh(dice));
    let edge_m = mesh.as_ref().map_or(0.01, closed_mesh::ClosedMesh::edge_m);
    let mut with_material = false;
    if mesh.is_some() {
        text += "[mesh]\nfile = \"mesh.obj\"\n";
        let unit = number(dice, 1.0, 0.5 * odds);
        let _ = writeln!(text, "unit = \"{unit:e}\"");
        with_material = dice.bool();
        if !with_material {
            let _ = writeln!(text, "point_mass_kg = {:e}", number(dice, 1e-3, odds));
        }
        if dice.f64() < 0.2 {
            let _ = writeln!(text, "vertices = {}", [4, 5, 12, 1_000_000][dice.usize(0..4)]);
        }
        let (z, r) = (number(dice, -edge_m, odds), number(dice, edge_m, odds));
        let ball = format!("[{{ centre_m = [0.0, 0.0, {z:e}], radius_m = {r:e} }}]");
        let _ = writeln!(text, "fixed = {}", [ball.as_str(), "\"none\"", "\"rim\""][dice.usize(0..3)]);
    } else {
        let points = ["[1, 1]", "[1, 2]", "[2, 2]", "[7, 5]", "[1, 60]", "[33, 2]", "[64, 64]"];
        let fixed = ["", "fixed = \"edges\"\n", "fixed = \"corners\"\n", "fixed = [[0, 0]]\n"];
        let (points, fixed) = (pick(dice, &points), pick(dice, &fixed));
        let (spacing, mass) = (number(dice, 0.01, odds), number(dice, 1e-3, odds));
        let _ =
            writeln!(text, "[sheet]\npoints = {points}\nspacing_m = {spacing:e}\npoint_mass_kg = {mass:e}\n{fixed}");
    }
    if with_material {
        text += "[material]\n";
        for (key, usual) in [("youngs_modulus_pa", 8000.0), ("thickness_m", 1e-3), ("foundation_n_per_m3", 1e6)] {
            let _ = writeln!(text, "{key} = {:e}", number(dice, usual, odds));
        }
        for (key, usual) in [("density_kg_per_m3", 1060.0), ("depth_m", 0.03), ("damping_ratio", 0.5)] {
            maybe(&mut text, dice, key, usual, odds);
        }
        text += "[springs]\n";
    } else {
        let _ = writeln!(text, "[anchor_springs]\nstiffness_n_per_m = {:e}", number(dice, 5.0, odds));
        let _ = writeln!(text, "[damping]\ncoefficient_n_s_per_m = {:e}", number(dice, 0.1, odds));
        let _ = writeln!(text, "[springs]\nstiffness_n_per_m = {:e}", number(dice, 10.0, odds));
    }
    if mesh.is_some() {
        maybe(&mut text, dice, "bending", 0.2, odds);
        if dice.f64() < 0.3 {
            let _ = writeln!(text, "[volume]\nstiffness_pa = {:e}", number(dice, 3000.0, odds));
        }
        for _ in 0..dice.usize(0..3) {
            let radius_m = number(dice, 3.0 * edge_m, odds);
            let _ = writeln!(
                text,
                "[[inclusion]]\ncentre_m = [{:e}, 0.0, 0.0]\nradius_m = {radius_m:e}",
                number(dice, edge_m, odds)
            );
            for (key, usual) in [("stiffness_factor", 3.0), ("anchor_stiffness_factor", 4.0), ("edge_m", edge_m)] {
                maybe(&mut text, dice, key, usual, odds);
            }
        }
    } else {
        maybe(&mut text, dice, "shear_stiffness_n_per_m", 5.0, odds);
        let _ = writeln!(text, "bending = {}", dice.bool());
    }
    text += "[stepping]\n";
    maybe(&mut text, dice, "rate_hz", 1000.0, odds);
    maybe(&mut text, dice, "tolerance", 1e-3, odds);
    if dice.f64() < 0.7 {
        let integrators = ["central", "exponential2", "exponential3", "exponential4", "rk4", "lagged"];
        let substeps = ["1", "2", "5", "20", "100000"];
        let (integrator, substeps) = (pick(dice, &integrators), pick(dice, &substeps));
        let _ = writeln!(text, "integrator = \"{integrator}\"\nsubsteps = {substeps}");
    }
    let _ = writeln!(text, "precision = \"{}\"", pick(dice, &["auto", "f32", "compensated", "f64"]));
    if dice.bool() {
        let _ = writeln!(text, "[sleep]\ntolerance = {:e}", number(dice, 1e-4, odds));
    }
    (text, mesh.map(|mesh| mesh.obj()))
}

/// A script that presses and holds, with extreme numbers too.
fn script(seed: u64, scene: &Scene) -> String {
    let mut dice = Rng::with_seed(!seed);
    let dice = &mut dice;
    let (odds, edge_m) = (0.1, scene.shape().edge_m());
    let at = if scene.sheet().is_some() { "point = [0, 0]" } else { "vertex = 1" };
    let force = [(); 3].map(|()| number(dice, 0.01, odds));
    format!(
        "duration_s = {:e}\nsample_every_s = {:e}\n[[force]]\n{at}\nforce_n = {force:?}\nfalloff_per_m = {:e}\nfalloff_offset = {:e}\n\
         profile = {{ type = \"sine\", frequency_hz = {:e} }}\n",
        number(dice, 0.05, odds),
        number(dice, 0.01, odds),
        number(dice, 1.0 / edge_m, odds),
        number(dice, 0.0, odds),
        number(dice, 3.0, odds),
    )
}

/// Says which field is wrong, or which place of the file.
fn assert_told(refusal: &Refusal, about: &str) {
    let names_it = !refusal.field.is_empty() || refusal.place.is_some();
    assert!(names_it && !refusal.message.is_empty(), "{about}: {refusal:?}");
    assert!(!refusal.message.contains("NaN"), "{about}: {refusal}");
}

fn is_finite(session: &Session) -> bool {
    session.model().points().all(|point| {
        let point = session.tissue().point(point);
        point.displacement_m.is_finite() && point.velocity_m_per_s.is_finite()
    })
}

/// Three tools press, hold and touch, if the rules for commands let them. Returns how many do.
fn touch(session: &mut Session, model: &Arc<Model>, dice: &mut Rng, limits: &Limits, about: &str) -> usize {
    let (shape, edge_m) = (model.shape(), model.shape().edge_m());
    let rest_m = shape.rest_m(shape.nearest(shape.extent().middle_m()));
    let normal = shape.normal(shape.nearest(rest_m));
    let poke = Poke {
        point: None,
        centre_m: rest_m,
        force_n: -number(dice, 0.01, 0.1) * normal,
        falloff_per_m: number(dice, 0.5 / edge_m, 0.1),
        falloff_offset: 0.0,
    };
    let free = model.points().find(|point| !shape.is_fixed(*point));
    let displacement_m = DVec3::new(0.0, 0.0, number(dice, 0.01 * edge_m, 0.1));
    let grasp = free.map_or(Action::Release, |point| Action::Grasp { point, displacement_m });
    let coupling = match dice.u8(0..2) {
        0 => {
            Coupling::Spring { stiffness_n_per_m: number(dice, 200.0, 0.1), damping_n_s_per_m: number(dice, 0.5, 0.1) }
        }
        _ => Coupling::Constraint,
    };
    let radius_m = number(dice, edge_m, 0.1);
    let (friction, grasps) = (number(dice, 0.3, 0.1), dice.u8(0..6) == 0);
    let tip = Tip { radius_m, friction, grasps, coupling, ..Tip::default() };
    let place_m = rest_m - number(dice, 0.1 * edge_m, 0.1) * normal;
    let pose = Action::Pose { place_m, velocity_m_per_s: None, tip };
    let mut intake = Intake::new(&model.scene, limits).continued(session, None);
    intake.acquire(&[0, 1, 2], "test", 1.0, LEASE, 0).unwrap();
    for (action, tool) in [Action::Push(poke), grasp, pose].into_iter().zip(0..) {
        if let Err(refusal) = intake.submit(LEASE, vec![Command::new(tool, None, action)], 0) {
            assert_told(&refusal, about);
        }
    }
    let mut due = Vec::new();
    intake.take_due(session.step_count(), 0, &mut due);
    let count = due.len();
    for _ in 0..30 {
        session.advance(&mut due, |_| {});
        assert!(is_finite(session), "{about}");
        for tool in session.sample(None).tools {
            assert!(!format!("{tool:?}").contains("NaN"), "{about}: {tool:?}");
        }
        assert!(!format!("{:?}", session.energy()).contains("NaN"), "{about}: {:?}", session.energy());
    }
    count
}

#[test]
fn scenes_at_the_bounds_of_their_fields_are_refused_by_name_or_stay_finite() {
    let told = |name: &str| std::env::var(name).ok().map(|text| text.parse::<u64>().unwrap());
    let all = told("PALPATE_STRESS_BOUNDS");
    let (from, count) = (told("PALPATE_STRESS_BOUNDS_FROM").unwrap_or(0), all.unwrap_or(200));
    let limits = Limits { substeps: 64, rehearsal_work: 1 << 20, ..Limits::default() };
    let folder = tempfile::tempdir().unwrap();
    let (mut refused, mut touched, mut scripted) = (0, 0, 0);
    for seed in from..from + count {
        let begun = Instant::now();
        let (text, mesh) = scene(seed);
        let about = format!("seed {seed}\n{text}");
        if let Some(mesh) = mesh {
            std::fs::write(folder.path().join("mesh.obj"), mesh).unwrap();
        }
        let compiled = Scene::parse_in(folder.path(), "scene", &text, &[], &limits)
            .and_then(|scene| Model::compile(&scene, &limits));
        let model = match compiled {
            Ok(model) => model,
            Err(refusal) => {
                assert_told(&refusal, &about);
                refused += 1;
                continue;
            }
        };
        let mut session = Session::new(&model);
        touched += touch(&mut session, &model, &mut Rng::with_seed(seed ^ 1), &limits, &about);
        let script_text = script(seed, &model.scene);
        let script = match Script::parse("script", &script_text, Path::new("."), &model.scene, &limits) {
            Ok(script) => Some(script),
            Err(refusal) => {
                assert_told(&refusal, &format!("{about}\n{script_text}"));
                None
            }
        };
        scripted += usize::from(script.is_some());
        if all.is_some() || seed % 8 == 0 {
            let clock_s = || begun.elapsed().as_secs_f64();
            let report = check::check(&model, script.as_ref(), &limits, &clock_s).to_string();
            assert!(!report.contains("NaN"), "{about}\n{script_text}\n{report}");
        }
        if all.is_some() && begun.elapsed().as_secs_f64() > 1.0 {
            eprintln!("{:.1} s: {about}", begun.elapsed().as_secs_f64());
        }
    }
    eprintln!("of {count} scenes {refused} were refused; {touched} tools, {scripted} scripts");
    let played = count - refused;
    assert!(
        10 * played > count && touched as u64 > played,
        "{refused} of {count} were refused, {touched} tools touched"
    );
}
