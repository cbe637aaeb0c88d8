//! Scripts in people's terms: tools with a tip, forces in newtons in all, scripts made for a scene, and what a moving
//! force feels.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use std::path::Path;
use std::sync::Arc;

use crate::common;
use crate::common::{model, scene_with, script};
use glam::DVec3;
use palpate_session::Session;
use palpate_session::command::{Command, Due};
use palpate_session::run::{RunOptions, run};
use palpate_session::simulation::Simulation;
use palpate_session::snapshot::Saved;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::record::Summary;
use palpate_tissue::scene::script::{Action, BUILT_IN, Script};
use palpate_tissue::scene::{self, Scene, script_reader};

fn built_in(scene: &str, sets: &[&str]) -> Scene {
    let (_, text) = scene::BUILT_IN.iter().find(|(name, _)| *name == scene).unwrap();
    scene_with(text, sets)
}

fn shipped(name: &str, scene: &Scene) -> Script {
    let (_, text) = BUILT_IN.iter().find(|(other, _)| *other == name).unwrap();
    Script::parse(name, text, Path::new("scripts"), scene, &Limits::default()).unwrap()
}

fn run_whole(model: &Arc<Model>, script: &Script, held: bool) -> (Vec<serde_json::Value>, Summary) {
    let (mut out, limits) = (Vec::new(), Limits::default());
    let summary =
        run(model, script, RunOptions { held, ..Default::default() }, &limits, &mut out, &|| 0.0, &mut |_| {}).unwrap();
    let lines = String::from_utf8(out).unwrap();
    (lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect(), summary)
}

/// The largest and the least z of the first point of all records, mm.
fn range_mm(records: &[serde_json::Value]) -> [f64; 2] {
    let depths = records.iter().filter_map(|record| record["points"][0]["displacement_m"][2].as_f64());
    depths.fold([0.0, 0.0], |[most, least], z_m| [f64::max(most, 1e3 * z_m), f64::min(least, 1e3 * z_m)])
}

#[test]
fn every_shipped_script_fits_the_scenes_that_it_is_made_for_and_says_so_elsewhere() {
    for (name, text) in BUILT_IN {
        let made_for: Vec<&str> =
            scene::BUILT_IN.iter().map(|scene| scene.0).filter(|scene| script_reader::fits(text, scene)).collect();
        assert!(!made_for.is_empty() && made_for.len() < scene::BUILT_IN.len(), "{name}: {made_for:?}");
        // Those of sheets name points by row and column.
        for (scene, _) in scene::BUILT_IN.into_iter().filter(|scene| scene.1.contains("[sheet]")) {
            let warnings = shipped(name, &built_in(scene, &[])).warnings;
            let warned = warnings.iter().any(|warning| warning.starts_with("scenes: made for"));
            assert_eq!(warned, !made_for.contains(&scene), "{name} on {scene}: {warnings:?}");
        }
    }
    assert!(script_reader::fits("no TOML [", "liver") && script_reader::fits("duration_s = 1.0", "liver"));
}

#[test]
fn shipped_scripts_move_each_tissue_by_some_millimetres() {
    for scene in ["liver", "fibrotic", "stomach"] {
        let scene = built_in(scene, &[]);
        let model = model(&scene);
        // A tip moves the tissue by its mean: the point in the middle goes farther. What a grasp lets go may swing.
        for (name, at_least_mm, at_most_mm) in [
            ("press", [0.0, -5.6], [0.5, -4.5]),
            ("grasp", [3.9, -4.0], [5.6, 0.1]),
            ("push", [0.0, -4.0], [0.5, -0.2]),
        ] {
            let [most, least] = range_mm(&run_whole(&model, &shipped(name, &scene), false).0);
            assert!((at_least_mm[0]..=at_most_mm[0]).contains(&most), "{}, {name}: {most} mm", scene.name);
            assert!((at_least_mm[1]..=at_most_mm[1]).contains(&least), "{}, {name}: {least} mm", scene.name);
        }
    }
}

/// A lobe of the solid liver between the jaws of a grasper, which only touch.
#[test]
fn lift_lifts_a_lobe_and_lets_it_go() {
    let scene = built_in("liver-solid", &[]);
    let (records, summary) = run_whole(&model(&scene), &shipped("lift", &scene), false);
    let at = |time_s: f64| records.iter().find(|record| record["time_s"].as_f64() >= Some(time_s)).unwrap();
    let force_n = |time_s: f64| {
        let parts = &at(time_s)["instruments"][0]["force_on_tool_n"];
        DVec3::from_array([0, 1, 2].map(|axis| parts[axis].as_f64().unwrap()))
    };
    // What is lifted pulls down, and does not creep.
    assert!(force_n(2.8).z < -0.05, "{}", force_n(2.8));
    assert!(force_n(2.0).distance(force_n(2.8)) < 0.01 * force_n(2.8).length(), "{} {}", force_n(2.0), force_n(2.8));
    // The rim of the lobe, beyond the jaws, goes farther than they do.
    let moved_m = summary.largest_displacement_m;
    assert!((0.01..0.04).contains(&moved_m) && summary.guard_events == 0, "{moved_m} m");
    assert_eq!(records.last().unwrap()["instruments"], serde_json::Value::Null);
}

/// A gallbladder that its bed and its neck hold.
#[test]
fn dissect_frees_a_gallbladder_from_its_bed_and_takes_it_away() {
    let scene = built_in("gallbladder-bed", &[]);
    let model = model(&scene);
    let anchored = model.points().filter(|point| model.anchor_stiffness_n_per_m(*point) > 0.0).count();
    let (records, summary) = run_whole(&model, &shipped("dissect", &scene), false);
    let topology = summary.topology.unwrap();
    assert_eq!((topology.severed_anchors, topology.pieces), (anchored, 2));
    assert!(anchored > 200 && topology.severed > anchored, "{topology:?}");
    assert_eq!(summary.guard_events, 0);
    let pulled_n = |time_s: f64| {
        let record = records.iter().find(|record| record["time_s"].as_f64() >= Some(time_s)).unwrap();
        let parts = &record["tools"][0]["force_on_tool_n"];
        DVec3::from_array([0, 1, 2].map(|axis| parts[axis].as_f64().unwrap())).length()
    };
    // Free of its bed, it is held by its neck; then nothing pulls at the grasper any more.
    assert!(pulled_n(7.4) > 0.05 && pulled_n(10.5) < 0.1 * pulled_n(7.4), "{} N, {} N", pulled_n(7.4), pulled_n(10.5));
}

#[test]
fn records_tell_what_a_tip_feels_and_where_it_is() {
    let scene = built_in("liver", &[]);
    let model = model(&scene);
    // A grasped point comes before the tip, whatever their order in the script.
    let text = "duration_s = 0.5\nsample_every_s = 0.05\n[[tool]]\nposes = [{ at_s = 0.05, place_m = [0.03, 0.04, 0.001] }, \
                { at_s = 0.25, place_m = [0.03, 0.04, -0.003] }]\nuntil_s = 0.42\n\
                [[tool]]\npoint = [2, 2]\nmoves = [{ from_s = 0.0, to_s = 0.2, by_m = [0.0, 0.0, -0.001] }]\n";
    let script = script(text, &scene);
    let (records, _) = run_whole(&model, &script, true);
    // The same steps, and the content of a stream at the same times.
    let mut session = Session::new(&model);
    let mut told = Vec::new();
    for step in 0..script.steps {
        let due = script
            .actions_at(step)
            .map(|(tool, action)| Due::in_time(Command::new(tool as u32, Some(step + 1), action)));
        session.advance(&mut due.collect::<Vec<_>>(), |session| {
            if session.step_count().is_multiple_of(script.sample_every) {
                let felt = session.sample(None).tools.into_iter().find(|tool| tool.tool == 1 && tool.feel.is_some());
                told.push(felt.map(|tool| (tool.feel.unwrap().place_m, tool.contact.unwrap())));
            }
        });
    }
    let records = &records[1..records.len() - 1];
    assert_eq!((records.len(), told.len()), (11, 11));
    let vector = |value: &serde_json::Value| DVec3::from_array(serde_json::from_value(value.clone()).unwrap());
    for (record, told) in records.iter().zip(told) {
        let time_s = record["time_s"].as_f64().unwrap();
        assert_eq!(told.is_some(), (0.05..0.42).contains(&time_s), "{time_s} s");
        let Some((place_m, contact)) = told else {
            assert!(record.get("tools").is_none(), "{record}");
            continue;
        };
        let [tool] = record["tools"].as_array().unwrap().as_slice() else { panic!("{record}") };
        assert_eq!(tool["tool"], 1);
        // The text of a number may be read with another last digit.
        for (key, expected) in [
            ("place_m", place_m),
            ("displacement_m", contact.displacement_m),
            ("force_on_tool_n", contact.force_on_tool_n),
        ] {
            assert!((vector(&tool[key]) - expected).length() < 1e-12, "{key} at {time_s} s: {record}");
        }
        let force_n = contact.force_on_tool_n;
        assert!(place_m.z < 0.0005 || force_n == DVec3::ZERO, "{time_s} s: {force_n}");
        assert!(place_m.z > -0.002 || force_n.z > 0.1, "{time_s} s: {force_n}");
    }
    // While the tip is away, what a point feels is not plotted as the tip's, and is no peak of it.
    let away = text.replace("duration_s = 0.5\nsample_every_s = 0.05", "duration_s = 0.5\nsample_every_s = 0.5");
    let (_, summary) = run_whole(&model, &common::script(&away, &scene), true);
    assert!(summary.curves.to_string().contains("Force of the tissue on the tool along z, N: nothing"));
    assert_eq!(summary.peak_reaction_n, 0.0);
    // A script without tips has the records that it had.
    let (records, _) = run_whole(&model, &shipped("push", &scene), false);
    assert!(records.iter().all(|record| record.get("tools").is_none()));
}

#[test]
fn poses_are_commands_so_that_a_run_is_the_same_bits_held_or_not() {
    let scene = built_in("liver", &[]);
    let model = model(&scene);
    for name in ["press", "stroke", "grasp"] {
        let script = shipped(name, &scene);
        let [free, held] = [false, true].map(|held| run_whole(&model, &script, held).1);
        assert_eq!(free.final_hash, held.final_hash, "{name}");
        assert_ne!(free.substeps, 0);
    }
}

#[test]
fn a_pose_is_reached_at_the_end_of_its_step_and_the_tool_leaves_at_the_end() {
    let scene = built_in("liver", &[]);
    let text = "duration_s = 0.2\nsample_every_s = 0.1\n[[tool]]\ntip = { radius_m = 0.004, friction = 0.0 }\nposes = [\
                { at_s = 0.05, place_m = [0.03, 0.04, 0.002] }, { at_s = 0.15, place_m = [0.03, 0.05, -0.002] }]\n\
                until_s = 0.18\n";
    let script = script(text, &scene);
    let place = |step: u64| match script.actions_at(step).collect::<Vec<_>>().as_slice() {
        [] => None,
        [(0, Action::Pose { place_m, tip, .. })] if tip.radius_m == 0.004 => Some(Some(*place_m)),
        [(0, Action::Release)] => Some(None),
        other => panic!("{step}: {other:?}"),
    };
    assert_eq!(place(48), None);
    assert_eq!(place(49), Some(Some(DVec3::new(0.03, 0.04, 0.002))));
    let half = place(99).unwrap().unwrap();
    assert!(half.distance(DVec3::new(0.03, 0.045, 0.0)) < 1e-15, "{half}");
    assert_eq!(place(149), Some(Some(DVec3::new(0.03, 0.05, -0.002))));
    assert_eq!(place(170), place(149));
    assert_eq!((place(179), place(180)), (Some(None), None));
    // The control points are those under the poses.
    assert_eq!(script.sample_points, [[12, 16], [12, 20]].map(|point| scene.sheet().unwrap().point(point)));
}

#[test]
fn a_force_in_all_is_that_force_wherever_the_points_are() {
    for (spacing_m, points, at_m) in [(0.0025, 31, [0.0375, 0.0375]), (0.00125, 61, [0.0312, 0.0403])] {
        let sets = [format!("sheet.spacing_m={spacing_m}"), format!("sheet.points=[{points}, {points}]")];
        let scene = built_in("liver", &sets.each_ref().map(String::as_str));
        let text = format!(
            "duration_s = 0.01\nsample_every_s = 0.01\nsample_points = \"all\"\n[[force]]\nat_m = {at_m:?}\n\
             total_n = [0.1, 0.0, -0.5]\nradius_m = 0.004\nprofile = {{ type = \"constant\" }}\n"
        );
        let script = script(&text, &scene);
        let (records, _) = run_whole(&model(&scene), &script, false);
        let applied = |c: usize| -> f64 {
            let points = records[1]["points"].as_array().unwrap();
            points.iter().map(|point| point["applied_n"][c].as_f64().unwrap()).sum()
        };
        // The remaining precision of f32.
        assert!((applied(2) + 0.5).abs() < 1e-6 && (applied(0) - 0.1).abs() < 1e-6, "{} {}", applied(0), applied(2));
    }
}

/// Liver with points twice as close: mass, anchor springs and damping are those of an area.
fn finer(scene: &Scene) -> Scene {
    let mut finer = scene.clone();
    finer.sheet_mut().unwrap().points = scene.sheet().unwrap().points.map(|points| 2 * points - 1);
    finer.sheet_mut().unwrap().spacing_m /= 2.0;
    finer.sheet_mut().unwrap().point_mass_kg /= 4.0;
    finer.anchor_stiffness_n_per_m /= 4.0;
    finer.damping_n_s_per_m /= 4.0;
    finer
}

#[test]
fn a_force_in_all_means_the_same_at_half_the_spacing() {
    // A deep and steep dent is another matter: there the points of the tissue themselves are too few (5 % at 0.3 N
    // and 5 mm).
    let liver = built_in("liver", &[]);
    for (total_n, radius_m) in [(0.03, 0.005), (0.3, 0.01), (0.3, 0.015)] {
        let text = format!(
            "duration_s = 0.5\nsample_every_s = 0.5\n[[force]]\nat_m = [0.0375, 0.0375]\ntotal_n = [0.0, 0.0, -{total_n}]\n\
             radius_m = {radius_m}\nprofile = {{ type = \"ramp\", from_s = 0.0, to_s = 0.2 }}\n"
        );
        let depth_m = |scene: &Scene| {
            let (records, _) = run_whole(&model(scene), &script(&text, scene), false);
            records[2]["points"][0]["displacement_m"][2].as_f64().unwrap()
        };
        let [coarse, fine] = [depth_m(&liver), depth_m(&finer(&liver))];
        assert!(coarse < -1e-5 && (coarse / fine - 1.0).abs() < 0.02, "{total_n} N: {coarse} m and {fine} m");
    }
}

#[test]
fn what_is_wrong_with_a_force_or_a_pose_is_named() {
    let scene = built_in("liver", &[]);
    let force = |lines: &str| format!("[[force]]\n{lines}\nprofile = {{ type = \"constant\" }}\n");
    let tool = |lines: &str| format!("[[tool]]\n{lines}\n");
    let poses = "poses = [{ at_s = 0.0, place_m = [0.03, 0.03, 0.0] }]";
    for (text, expected) in [
        (force("at_m = [0.03, 0.03]\ntotal_n = [0.0, 0.0, -1.0]"), "force[0].falloff_per_m: is missing"),
        (
            force("at_m = [0.03, 0.03]\ntotal_n = [0.0, 0.0, -1.0]\nradius_m = 0.004\nfalloff_per_m = 3.0"),
            "force[0].falloff_per_m: does not go with radius_m",
        ),
        (force("at_m = [0.03, 0.03]\nforce_n = [0.0, 0.0, -1.0]\nradius_m = 0.004"), "force[0].force_n: does not go"),
        (force("at_m = [0.03, 0.03]\nradius_m = 0.004"), "force[0].total_n: is missing"),
        (force("at_m = [0.031, 0.031]\ntotal_n = [0.0, 0.0, -1.0]\nradius_m = 1e-5"), "force[0].radius_m: is so small"),
        (
            force("at_m = [0.3, 0.03]\ntotal_n = [0.0, 0.0, -1.0]\nradius_m = 0.004"),
            "force[0].at_m: (0.3, 0.03, 0) m is off",
        ),
        (
            force("at_m = [0.03, 0.03]\npoint = [3, 3]\ntotal_n = [0.0, 0.0, -1.0]\nradius_m = 0.004"),
            "just one of `point` (`vertex` on a mesh), `at_m`, `hops` and `path`",
        ),
        (tool("poses = []"), "tool[0].poses: must have at least one pose"),
        (
            tool("poses = [{ at_s = 0.1, place_m = [0.0, 0.0, 0.0] }, { at_s = 0.1, place_m = [0.0, 0.0, 0.0] }]"),
            "tool[0].poses[1].at_s: must be later",
        ),
        (tool("poses = [{ at_s = 0.1, place_m = [0.0, 0.0, 99.0] }]"), "tool[0].poses[0].place_m"),
        (tool(&format!("{poses}\nuntil_s = 0.0")), "tool[0].until_s: must be later than the first pose"),
        (tool(&format!("{poses}\ntip = {{ radius_m = -1.0 }}")), "tool[0].tip.radius_m"),
        (tool(&format!("{poses}\ntip = {{ sharp = true }}")), "tool[0].tip.sharp"),
        (tool(&format!("{poses}\npoint = [3, 3]")), "tool[0].point"),
    ] {
        let text = format!("duration_s = 0.1\nsample_every_s = 0.1\n{text}");
        let refusal = Script::parse("s", &text, Path::new(""), &scene, &Limits::default()).unwrap_err().to_string();
        assert!(refusal.contains(expected), "{refusal}\nexpected: {expected}");
    }
}

#[test]
fn a_pose_beside_the_tissue_is_warned_of() {
    let scene = built_in("liver", &[]);
    let warnings = |x_m: f64, z_m: f64| {
        let text = format!(
            "duration_s = 0.1\nsample_every_s = 0.1\n[[tool]]\nposes = [{{ at_s = 0.0, place_m = [{x_m}, 0.03, {z_m}] }}]\n"
        );
        script(&text, &scene).warnings
    };
    assert_eq!(warnings(0.075, 0.02), [""; 0]);
    let [warning] = warnings(0.085, -0.002).try_into().unwrap();
    // On the rim, which is fixed.
    let [rim] = warnings(0.075, -0.002).try_into().unwrap();
    assert!(rim.starts_with("tool[0].poses[0].place_m: is at a fixed point"), "{rim}");
    assert!(
        warning.starts_with("tool[0].poses[0].place_m: is 0.01") && warning.contains("beside the tissue"),
        "{warning}"
    );
}

/// Does a step of a session with an action of tool 0. Returns the contact in the sample after it.
fn told(session: &mut Session, sequence: u64, action: Action) -> palpate_session::Contact {
    let (sequence, at_step) = (Some(sequence), Some(session.step_count()));
    let command = Command {
        tool: 0,
        sequence,
        client_time_ns: 0,
        by_datagram: false,
        at_step,
        time_to_live_s: None,
        action,
        arrival_ns: 0,
    };
    session.advance(&mut vec![Due::in_time(command)], |_| {});
    session.sample(None).tools[0].contact.unwrap()
}

#[test]
fn a_force_that_moves_between_points_feels_smooth_and_one_on_a_point_feels_that_point() {
    use palpate_tissue::scene::profile::Poke;
    let scene = built_in("liver", &[]);
    let model = model(&scene);
    let spacing_m = scene.sheet().unwrap().spacing_m;
    // Slowly over three points, after it has settled; the ripple relative to the mean force.
    let ripple = |by_point: bool| {
        let mut session = Session::new(&model);
        let (mut least, mut most) = (f64::INFINITY, 0.0_f64);
        for step in 0..2000_u64 {
            let along_m = 0.03 + 3.0 * spacing_m * (step.max(500) - 500) as f64 / 1500.0;
            let centre_m = DVec3::new(along_m, 0.0375, 0.0);
            let nearest = model.shape().nearest(centre_m);
            let point = by_point.then_some(nearest);
            let poke = Poke {
                point,
                centre_m,
                force_n: DVec3::new(0.0, 0.0, -0.02),
                falloff_per_m: 250.0,
                falloff_offset: 0.0,
            };
            let contact = told(&mut session, step + 1, Action::Push(poke));
            assert_eq!(contact.point, nearest);
            if by_point {
                let state = session.tissue().point(nearest);
                assert_eq!(
                    (contact.force_on_tool_n, contact.surface_displacement_m),
                    (state.reaction_n(), state.displacement_m)
                );
            }
            if step >= 500 {
                least = least.min(contact.force_on_tool_n.z);
                most = most.max(contact.force_on_tool_n.z);
            }
        }
        (most - least) / (0.5 * (most + least))
    };
    let [smooth, saw] = [ripple(false), ripple(true)];
    assert!(smooth < 0.3 * saw && smooth < 0.15, "{smooth} and {saw}");
}

#[test]
fn the_surface_under_a_tip_is_deeper_than_the_mean_over_it() {
    let scene = built_in("liver", &[]);
    let model = model(&scene);
    let mut session = Session::new(&model);
    let mut contact = None;
    for step in 0..400_u64 {
        let z_m = -0.004 * (step as f64 / 300.0).min(1.0);
        let action = Action::Pose {
            place_m: DVec3::new(0.0375, 0.0375, z_m),
            velocity_m_per_s: None,
            tip: palpate_haptics::Tip::default(),
        };
        contact = Some(told(&mut session, step + 1, action));
    }
    let contact = contact.unwrap();
    let middle = session.tissue().point(scene.sheet().unwrap().point([15, 15])).displacement_m;
    assert!((contact.surface_displacement_m - middle).length() < 1e-4, "{contact:?}, {middle}");
    assert!(contact.surface_displacement_m.z < 1.03 * contact.displacement_m.z, "{contact:?}");
    // Between points it is bilinear, and beyond the rim that of the rim.
    let at = |i: f64, j: f64| {
        session.tissue().surface_displacement_m(scene.sheet().unwrap().spacing_m * DVec3::new(i, j, 0.0))
    };
    assert!((at(14.5, 15.0) - 0.5 * (at(14.0, 15.0) + at(15.0, 15.0))).length() < 1e-12);
    assert_eq!(at(-3.0, 15.0), at(0.0, 15.0));
}

#[test]
fn three_stitches_close_a_wound_while_its_lips_are_drawn_apart() {
    let scene = built_in("liver", &[]);
    let (model, sutured) = (model(&scene), shipped("suture", &scene));
    let mut open = sutured.clone();
    open.ties.clear();
    let opening_m = |script: &Script| {
        let limits = Limits::default();
        let mut simulation = Simulation::playing(&model, script, false, &limits).unwrap();
        simulation.run_to(script.steps).unwrap();
        let at = |x: f64| simulation.session.tissue().surface_displacement_m(DVec3::new(x, 0.0375, 0.0)).x;
        at(0.0375) - at(0.035)
    };
    let (with_m, without_m) = (opening_m(&sutured), opening_m(&open));
    assert!(without_m > 5e-4 && with_m < 0.3 * without_m, "{with_m} {without_m} m");
    let (records, summary) = run_whole(&model, &sutured, false);
    assert!(summary.ties.len() == 3 && summary.guard_events == 0, "{summary:?}");
    for (tie, name) in summary.ties.iter().zip(["lower", "middle", "upper"]) {
        assert!(tie.name == name && !tie.is_broken && tie.peak_tension_n > 0.02, "{tie:?}");
        assert!((tie.path_m / 0.008 - 1.0).abs() < 0.01 && (tie.length_m - 0.008).abs() < 1e-9, "{tie:?}");
    }
    let opened_m = summary.ties[1].path_when_laid_m - 0.008;
    assert!(opened_m > 5e-4, "{opened_m}");
    let told = &records.last().unwrap()["summary"]["ties"];
    assert_eq!(told.as_array().unwrap().len(), 3, "{told}");
}

/// A blade that stands upright in a block goes from one side of it to the other, in each of some planes.
#[test]
fn a_run_warns_if_its_blade_leaves_a_solid_no_room_for_further_cuts() {
    let text = "[solid]\norgan = { name = \"phantom\", edge_m = 0.006, seed = 1 }\ncell_m = 0.01\n\
                fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1], within_m = 0.001 }]\n\
                [material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.45\n[stepping]\nsubsteps = 4\n";
    let scene = Scene::parse("block", text, &[], &Limits::default()).unwrap();
    let model = model(&scene);
    let is_warned = |planes_x_m: &[f64]| {
        let mut poses = String::new();
        for (plane, x_m) in planes_x_m.iter().enumerate() {
            for end in 0..2 {
                let at_s = 0.3 * plane as f64 + 0.26 * f64::from(end);
                let y_m = if end == plane as u32 % 2 { -0.06 } else { 0.06 };
                let upright = "orientation = [0.70710678, 0, 0.70710678, 0]";
                poses += &format!("{{ at_s = {at_s:?}, place_m = [{x_m:?}, {y_m:?}, 0.005], {upright} }},\n");
            }
        }
        let duration_s = 0.3 * planes_x_m.len() as f64;
        let text = format!(
            "duration_s = {duration_s:?}\nsample_every_s = 0.1\n[[tool]]\nblade = {{ length_m = 0.06 }}\nposes = [\n{poses}]\n"
        );
        let (_, summary) = run_whole(&model, &script(&text, &scene), false);
        assert!(summary.topology.is_some_and(|topology| topology.severed > 20), "{summary:?}");
        summary.warnings.iter().any(|warning| warning.contains("no spare places"))
    };
    assert!(!is_warned(&[0.004]));
    assert!(is_warned(&[-0.026, -0.006, 0.014, 0.034]));
}

/// A tip that rests on the liver from its first pose on, and is taken away at `until_s`.
fn cautery(burn_s: f64, until_s: f64) -> String {
    format!(
        "duration_s = 0.4\nsample_every_s = 0.1\n[[tool]]\ntip = {{ radius_m = 0.004, grasps = true, burn_s = {burn_s:?} }}\n\
         poses = [{{ at_s = 0.05, place_m = [0.0375, 0.0375, 0.0] }}]\nuntil_s = {until_s:?}\n"
    )
}

#[test]
fn a_tip_of_a_script_burns_through_what_it_touches_for_long_enough() {
    let scene = built_in("liver", &[]);
    let model = model(&scene);
    let severed = |burn_s: f64, until_s: f64| {
        let (records, summary) = run_whole(&model, &script(&cautery(burn_s, until_s), &scene), false);
        let severed = summary.topology.map_or(0, |topology| topology.severed);
        assert_eq!(records.last().unwrap()["summary"]["severed"].as_u64().unwrap_or(0), severed as u64);
        assert_eq!(summary.guard_events, 0);
        severed
    };
    // It touches for 0.2 s.
    assert!(severed(0.2, 0.25) > 20);
    assert_eq!([severed(0.201, 0.25), severed(0.2, 0.249), severed(0.0, 0.4)], [0, 0, 0]);
    for (tip, expected) in [
        ("burn_s = -1.0", "tool[0].tip.burn_s: must be from 0 to 3600, but is -1"),
        ("burn_s = 3601.0", "tool[0].tip.burn_s"),
        ("burn_s = \"1 s\"", "tool[0].tip.burn_s"),
    ] {
        let text = format!(
            "duration_s = 0.1\nsample_every_s = 0.1\n[[tool]]\ntip = {{ {tip} }}\n\
             poses = [{{ at_s = 0.0, place_m = [0.03, 0.03, 0.0] }}]\n"
        );
        let refusal = Script::parse("s", &text, Path::new(""), &scene, &Limits::default()).unwrap_err().to_string();
        assert!(refusal.contains(expected), "{refusal}\nexpected: {expected}");
    }
}

/// A tip of 10 mm that is at a height over the phantom from its first pose on, and is taken away at `until_s`.
fn cautery_of_phantom(tip: &str, height_m: f64, burn_s: f64, until_s: f64) -> String {
    format!(
        "duration_s = 0.4\nsample_every_s = 0.1\n[[tool]]\ntip = {{ {tip}, radius_m = 0.01, burn_s = {burn_s:?} }}\n\
         poses = [{{ at_s = 0.05, place_m = [0.0, 0.0, {height_m:?}] }}]\nuntil_s = {until_s:?}\n"
    )
}

#[test]
fn a_tip_of_a_script_burns_through_a_solid_at_the_stated_time() {
    let scene = built_in("phantom", &[]);
    let model = model(&scene);
    let severed = |tip: &str, height_m: f64, burn_s: f64, until_s: f64| {
        let text = cautery_of_phantom(tip, height_m, burn_s, until_s);
        let (_, summary) = run_whole(&model, &script(&text, &scene), false);
        let topology = summary.topology;
        assert!(topology.as_ref().is_none_or(|topology| topology.pieces == 1), "{tip}: {topology:?}");
        topology.map_or(0, |topology| topology.severed)
    };
    // It holds for 0.2 s.
    let holding = |burn_s, until_s| severed("grasps = true", 0.04, burn_s, until_s);
    assert!(holding(0.2, 0.25) > 10);
    assert_eq!([holding(0.201, 0.25), holding(0.2, 0.249), holding(0.0, 0.4)], [0, 0, 0]);
    // A tip that touches comes from above, and meets the tissue some steps later.
    let touching = |burn_s| severed("shape = \"rigid\"", 0.038, burn_s, 0.25);
    assert!(touching(0.19) > 10);
    assert_eq!(touching(0.2), 0);
    let blade = "duration_s = 0.1\nsample_every_s = 0.1\n[[tool]]\nblade = { length_m = 0.06 }\ntip = { burn_s = 0.1 }\n\
                 poses = [{ at_s = 0.0, place_m = [0.0, 0.0, 0.03] }]\n";
    assert!(Script::parse("s", blade, Path::new(""), &scene, &Limits::default()).is_err());
}

#[test]
fn a_burn_is_part_of_a_snapshot_and_of_a_continued_session() {
    for (name, text) in [("liver", cautery(0.2, 0.4)), ("phantom", cautery_of_phantom("grasps = true", 0.04, 0.2, 0.4))]
    {
        continues_in_mid_burn(name, &text);
    }
}

fn continues_in_mid_burn(name: &str, text: &str) {
    let scene = built_in(name, &[]);
    let (model, burns, limits) = (model(&scene), script(text, &scene), Limits::default());
    let mut simulation = Simulation::playing(&model, &burns, true, &limits).unwrap();
    simulation.run_to(150).unwrap();
    let bytes = simulation.session.save().to_bytes();
    let saved = Saved::from_bytes(&bytes, &limits).unwrap();
    let mut again = Session::restore(&model, &saved).unwrap();
    assert_eq!(again.save().to_bytes(), bytes);
    for step in 150..400 {
        let due = burns
            .actions_at(step)
            .map(|(tool, action)| Due::in_time(Command::new(tool as u32, Some(step + 1), action)));
        again.advance(&mut due.collect::<Vec<_>>(), |_| {});
        simulation.step(0).unwrap();
        // It touches at the end of the fiftieth step for the first time, and burns through in the 200th from there on.
        assert_eq!(again.tissue().cuts().is_empty(), step < 248, "{name}, after step {step}");
    }
    assert_eq!(again.tissue().state_hash(), simulation.session.tissue().state_hash());
    let burnt = [&again, &simulation.session].map(|session| {
        session.tissue().burns().points(&model).map(|burnt| (burnt.point, burnt.burn)).collect::<Vec<_>>()
    });
    assert!(burnt[0] == burnt[1] && burnt[0].iter().any(|(_, burn)| *burn == 1.0), "{name}: {burnt:?}");
    // The sequence numbers of the tool differ, so the bytes of both do.
    let versions = [&again, &simulation.session].map(|session| session.tissue().burns().version());
    assert!(versions[0] == versions[1] && versions[0] > 0, "{versions:?}");
}

#[test]
fn what_is_wrong_with_a_thread_or_a_clip_is_named() {
    let scene = built_in("liver", &[]);
    let bites = "bites = [{ place_m = [0.03, 0.03, 0] }, { place_m = [0.04, 0.03, 0] }]";
    let thread = |lines: &str| format!("[[thread]]\n{lines}\n");
    let clip = |lines: &str| format!("[[clip]]\n{lines}\n");
    for (text, expected) in [
        (thread(bites), "thread[0].length_m: is missing"),
        (thread("length_m = 0.01"), "thread[0].bites: is missing"),
        (thread("length_m = 0.01\nbites = [{ place_m = [0.03, 0.03, 0] }]"), "thread[0].bites: has 1 bites"),
        (thread(&format!("{bites}\nlength_m = -0.01")), "thread[0].length_m"),
        (thread(&format!("{bites}\nlength_m = []")), "thread[0].length_m: must have at least one"),
        (
            thread(&format!(
                "{bites}\nlength_m = [{{ at_s = 0.1, length_m = 0.01 }}, {{ at_s = 0.1, length_m = 0.02 }}]"
            )),
            "thread[0].length_m[1].at_s: must be later",
        ),
        (
            thread(&format!("{bites}\nlength_m = [{{ at_s = 0.1, length_m = 0.01 }}]\nfrom_s = 0.1")),
            "thread[0].from_s: is for a thread of one length",
        ),
        (thread(&format!("{bites}\nlength_m = 0.01\nfriction = 11.0")), "thread[0].friction"),
        (thread(&format!("{bites}\nlength_m = 0.01\nstrength_n = 0.0")), "thread[0].strength_n"),
        (thread(&format!("{bites}\nlength_m = 0.01\nuntil_s = 0.0")), "thread[0].until_s: must be later"),
        (
            clip("bites = [{ place_m = [0.3, 0.03, 0] }, { place_m = [0.04, 0.03, 0] }]"),
            "clip[0].bites[0].place_m: (0.3",
        ),
        (clip(&format!("{bites}\nlength_m = 0.01")), "clip[0].length_m"),
        (
            clip("bites = [{ place_m = [0.03, 0.03, 0], radius_m = -1.0 }, { place_m = [0.04, 0.03, 0] }]"),
            "clip[0].bites[0].radius_m",
        ),
    ] {
        let text = format!("duration_s = 0.1\nsample_every_s = 0.1\n{text}");
        let refusal = Script::parse("s", &text, Path::new(""), &scene, &Limits::default()).unwrap_err().to_string();
        assert!(refusal.contains(expected), "{refusal}\nexpected: {expected}");
    }
    let text = "duration_s = 0.1\nsample_every_s = 0.1\n[[clip]]\nbites = [{ place_m = [0, 0.03, 0] }, { place_m = [0.01, 0.03, 0] }]\n";
    let warnings = script(text, &scene).warnings;
    assert!(warnings.len() == 1 && warnings[0].contains("place_m: is at a fixed point"), "{warnings:?}");
}

#[test]
fn a_thread_is_part_of_a_snapshot_and_of_a_continued_session() {
    let scene = built_in("liver", &[]);
    let (model, sutured, limits) = (model(&scene), shipped("suture", &scene), Limits::default());
    let mut simulation = Simulation::playing(&model, &sutured, true, &limits).unwrap();
    simulation.run_to(2700).unwrap();
    let bytes = simulation.session.save().to_bytes();
    let saved = Saved::from_bytes(&bytes, &limits).unwrap();
    let mut again = Session::restore(&model, &saved).unwrap();
    assert_eq!(again.save().to_bytes(), bytes);
    assert_eq!((again.tissue().ties().len(), again.tissue().ties()), (2, simulation.session.tissue().ties()));
    for step in 2700..3200 {
        let due = sutured
            .actions_at(step)
            .map(|(tool, action)| Due::in_time(Command::new(tool as u32, Some(step + 1), action)));
        again.advance(&mut due.collect::<Vec<_>>(), |_| {});
        simulation.step(0).unwrap();
    }
    assert_eq!(again.tissue().state_hash(), simulation.session.tissue().state_hash());
}
