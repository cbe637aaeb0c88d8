//! Accuracy against scenes solved to 1e-10 by other means. Each file in tests/reference has the scene, the times, and
//! for each time displacements, velocities, forces and energies.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use crate::common::{playing, script};
use glam::DVec3;
use palpate_session::Session;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::{Integrator, Named, Scene};
use palpate_tissue::shape::PointName;
use serde_json::Value;

const SCENES: [&str; 6] = ["poke31", "ringdown9x14", "overdamped19", "tool15", "icosphere", "filled"];

fn load(name: &str) -> Value {
    let path = format!("{}/tests/reference/{name}.json", env!("CARGO_MANIFEST_DIR"));
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap()
}

fn vector(value: &Value) -> DVec3 {
    DVec3::new(number(&value[0]), number(&value[1]), number(&value[2]))
}

/// [i, j] on a sheet, the number of a vertex on a mesh.
fn point(value: &Value) -> PointName {
    let whole = |value: &Value| value.as_u64().unwrap() as usize;
    if value.is_array() {
        PointName::Point([whole(&value[0]), whole(&value[1])])
    } else {
        PointName::Vertex(u32::try_from(whole(value)).unwrap())
    }
}

/// The scene of a reference as a scene file.
fn scene_text(scene: &Value) -> String {
    let mass = &scene["mass"];
    let body = if scene.get("mesh").is_some() {
        format!("[mesh]\nfile = {}\nunit = \"m\"\npoint_mass_kg = {mass}\n", scene["mesh"])
    } else {
        let [nx, ny, spacing] = ["nx", "ny", "spacing"].map(|key| &scene[key]);
        format!("[sheet]\npoints = [{nx}, {ny}]\nspacing_m = {spacing}\npoint_mass_kg = {mass}\n")
    };
    let bending = scene.get("bending").and_then(Value::as_bool).unwrap_or(false);
    let volume = scene.get("kappa").map_or(String::new(), |kappa| format!("[volume]\nstiffness_pa = {kappa}\n"));
    format!(
        "{body}{volume}[springs]\nstiffness_n_per_m = {}\nbending = {bending}\n[anchor_springs]\nstiffness_n_per_m = {}\n\
         [damping]\ncoefficient_n_s_per_m = {}\n",
        scene["k"], scene["K"], scene["C"]
    )
}

/// The scene of a reference.
fn scene_of(scene: &Value, assignments: &[&str]) -> Scene {
    let assignments: Vec<String> = assignments.iter().map(|text| (*text).to_owned()).collect();
    let folder = format!("{}/tests/reference", env!("CARGO_MANIFEST_DIR"));
    let folder = std::path::Path::new(&folder);
    Scene::parse_in(folder, "reference", &scene_text(scene), &assignments, &Limits::default()).unwrap()
}

/// Its forces and tool as a script.
fn script_text(scene: &Value) -> String {
    let times = scene["times"].as_array().unwrap();
    let key = if scene.get("mesh").is_some() { "vertex" } else { "point" };
    let mut text = format!("duration_s = {}\nsample_every_s = {}\n", scene["t_end"], times[1]);
    for force in scene["forces"].as_array().unwrap() {
        let profile = match force["profile"]["type"].as_str().unwrap() {
            "constant" => "{ type = \"constant\" }".to_owned(),
            "pulse" => {
                let (on, off) = (&force["profile"]["t_on"], &force["profile"]["t_off"]);
                format!("{{ type = \"pulse\", on_s = {on}, off_s = {off} }}")
            }
            other => panic!("{other}"),
        };
        text += &format!(
            "[[force]]\n{key} = {}\nforce_n = {}\nfalloff_per_m = {}\nfalloff_offset = {}\nprofile = {profile}\n",
            force["point"], force["vector"], force["c"], force["c_prime"]
        );
    }
    if let Some(tool) = scene.get("tool") {
        let moves: Vec<String> = tool["moves"]
            .as_array()
            .unwrap()
            .iter()
            .map(|m| format!("{{ from_s = {}, to_s = {}, by_m = {} }}", m["t0"], m["t1"], m["by"]))
            .collect();
        text += &format!("[[tool]]\n{key} = {}\nmoves = [{}]\n", tool["point"], moves.join(", "));
    }
    text
}

/// Largest errors of a run, relative to the largest value of each kind.
#[derive(Debug, Default)]
struct Errors {
    displacement: f64,
    velocity: f64,
    force: f64,
    energy: f64,
}

/// Runs a reference scene with `assignments` and compares every value in the reference.
fn errors(name: &str, assignments: &[&str]) -> Errors {
    let reference = load(name);
    let scene = scene_of(&reference["scene"], assignments);
    let script = script(&script_text(&reference["scene"]), &scene);
    let mut session = playing(&scene, &script);
    let mut frames = reference["frames"].as_array().unwrap().iter();
    let (mut error, mut largest) = (Errors::default(), Errors::default());
    let samples: Vec<_> = reference["scene"]["samples"].as_array().unwrap().iter().map(point).collect();
    let watch: Vec<_> = reference["scene"]["watch"].as_array().unwrap().iter().map(point).collect();
    let mut compare = |session: &Session| {
        if !session.step_count().is_multiple_of(script.sample_every) {
            return;
        }
        let frame = frames.next().unwrap();
        assert!((session.time_s() - number(&frame["t"])).abs() < 1e-9);
        let at = |name| session.tissue().point(session.model().shape().find("", name).unwrap());
        for (index, place) in samples.iter().enumerate() {
            let (u, v) = (vector(&frame["u"][index]), vector(&frame["v"][index]));
            error.displacement = error.displacement.max((at(*place).displacement_m - u).length());
            error.velocity = error.velocity.max((at(*place).velocity_m_per_s - v).length());
            largest.displacement = largest.displacement.max(u.length());
            largest.velocity = largest.velocity.max(v.length());
        }
        for (index, place) in watch.iter().enumerate() {
            let expected = &frame["watch"][index];
            let part = |name: &str| vector(&expected[name]);
            let state = at(*place);
            let reaction = part("reaction") + part("damping");
            let mut pairs = vec![
                (state.spring_n, part("spring")),
                (state.anchor_n, part("virtual")),
                (state.damping_n, part("damping")),
                (state.applied_n, part("surgical")),
                (state.reaction_n(), reaction),
            ];
            if expected.get("constraint").is_some() {
                pairs.push((state.constraint_n.unwrap(), part("constraint")));
            }
            for (force, expected) in pairs {
                error.force = error.force.max((force - expected).length());
            }
            largest.force = largest.force.max(reaction.length());
        }
        let (energy, expected) = (session.tissue().energy(), &frame["energy"]);
        for (value, name) in [(energy.kinetic_j, "kinetic"), (energy.spring_j, "spring"), (energy.anchor_j, "virtual")]
        {
            error.energy = error.energy.max((value - number(&expected[name])).abs());
            largest.energy = largest.energy.max(number(&expected[name]));
        }
    };
    for _ in 0..script.steps {
        session.advance(&mut Vec::new(), &mut compare);
        assert_eq!(session.fault(), None);
    }
    assert!(frames.next().is_none(), "the run is shorter than the reference");
    Errors {
        displacement: error.displacement / largest.displacement,
        velocity: error.velocity / largest.velocity,
        force: error.force / largest.force,
        energy: error.energy / largest.energy,
    }
}

/// The factor by which each error falls when the step falls by 4.
fn gains(name: &str, integrator: &str, rate_hz: f64) -> [f64; 4] {
    let at = |rate_hz: f64| {
        let integrator = format!("stepping.integrator={integrator}");
        let rate = format!("stepping.rate_hz={rate_hz}");
        errors(name, &[&integrator, &rate, "stepping.precision=f64", "stepping.substeps=1"])
    };
    let (coarse, fine) = (at(rate_hz), at(4.0 * rate_hz));
    [
        coarse.displacement / fine.displacement,
        coarse.velocity / fine.velocity,
        coarse.force / fine.force,
        coarse.energy / fine.energy,
    ]
}

#[test]
fn each_scheme_has_its_order() {
    // At these rates the coarse step is already accurate, and the fine one does not reach the digits of the references
    // yet.
    for (integrator, scheme) in Integrator::NAMES {
        let rate_hz = match scheme {
            // `lagged` is stable only at finer steps: see below.
            Integrator::Auto | Integrator::Lagged | Integrator::Stormer => continue,
            Integrator::Rk4 => 2000.0,
            _ => 1000.0,
        };
        let order = palpate_tissue::order(*scheme);
        for name in SCENES {
            for gain in gains(name, integrator, rate_hz) {
                println!("{integrator} {name}: {:.2}", gain.log2() / 2.0);
                // Damping that takes five times a point's momentum in a step reaches the fifth order only at finer
                // steps.
                // The third derivative of a tool's move jumps where it begins and ends, which a fifth order notices.
                let order =
                    if ["overdamped19", "icosphere", "filled"].contains(&name) { f64::min(order, 4.0) } else { order };
                assert!(gain.log2() / 2.0 > order - 0.75, "{integrator}, {name}: {gain}");
            }
        }
    }
}

#[test]
fn lagged_is_first_order_within_its_stable_range() {
    for name in SCENES {
        for gain in gains(name, "lagged", 4000.0) {
            assert!((3.5..5.0).contains(&gain), "{name}: {gain}");
        }
    }
}

#[test]
fn lagged_explodes_where_its_damping_is_too_strong_and_the_guard_mends_it() {
    let sets = ["stepping.integrator=lagged", "stepping.substeps=1"];
    let reference = load("overdamped19");
    let scene = scene_of(&reference["scene"], &sets);
    let script = script(&script_text(&reference["scene"]), &scene);
    let mut session = playing(&scene, &script);
    for _ in 0..script.steps {
        session.advance(&mut Vec::new(), |session| {
            for index in session.model().points() {
                let point = session.tissue().point(index);
                assert!(point.displacement_m.is_finite() && point.reaction_n().is_finite());
            }
        });
        assert_eq!(session.fault(), None);
    }
    assert!(session.tissue().guard_events() > 0 && session.tissue().plan().substeps > 1);
    // Auto substeps are within the bound from the beginning.
    assert!(errors("overdamped19", &["stepping.integrator=lagged"]).displacement < 1e-2);
}

#[test]
fn a_tolerance_is_kept() {
    for name in SCENES {
        for tolerance in [1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8] {
            let errors = errors(name, &[&format!("stepping.tolerance={tolerance:e}")]);
            println!("{name} {tolerance:e}: {errors:?}");
            assert!(errors.displacement < tolerance && errors.force < tolerance, "{name}, {tolerance:e}: {errors:?}");
        }
    }
}
