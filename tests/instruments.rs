//! Instruments: what their tips do is what tools with these tips do, and what is felt is the sum.
#![allow(clippy::unwrap_used, clippy::panic, missing_docs)]

use std::path::Path;
use std::sync::Arc;

use crate::common;
use glam::{DQuat, DVec3};
use palpate_session::run::{self, RunEvent, RunOptions};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Scene;
use palpate_tissue::scene::record::{InstrumentRecord, Record, Summary};
use palpate_tissue::scene::script::Script;

/// A tissue of 8 kPa that fills a box and is held below; its cells follow.
const BOX: &str = "[solid]\nfile = \"box.obj\"\nunit = \"m\"\nfixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1] }]\n\
    [material]\nyoungs_modulus_pa = 8e3\npoissons_ratio = 0.45\ndamping_per_s = 100\n\
    [stepping]\nintegrator = \"central\"\nsubsteps = 4\n";

fn model(size_m: DVec3, cell_m: f64) -> Arc<Model> {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("box.obj"), common::box_obj(size_m, DQuat::IDENTITY)).unwrap();
    let sets = [format!("solid.cell_m={cell_m:?}")];
    let scene = Scene::parse_in(folder.path(), "box", BOX, &sets, &Limits::default()).unwrap();
    Model::compile(&scene, &Limits::default()).unwrap()
}

fn block() -> Arc<Model> {
    model(DVec3::new(0.06, 0.06, 0.03), 0.005)
}

fn script(model: &Model, text: &str) -> palpate_refusal::Result<Script> {
    Script::parse("test", text, Path::new(""), &model.scene, &Limits::default())
}

/// Plays a script. Returns its records and its summary.
fn played(model: &Arc<Model>, text: &str) -> (Vec<Record>, Summary) {
    let mut records = Vec::new();
    let told = &mut |event: RunEvent<'_>| {
        if let RunEvent::Record(record) = event {
            records.push(record);
        }
        Ok(())
    };
    let script = script(model, text).unwrap();
    let summary = run::run_with(model, &script, RunOptions::default(), &Limits::default(), &|| 0.0, told).unwrap();
    (records, summary)
}

fn last(records: &[Record]) -> &InstrumentRecord {
    &records.last().unwrap().instruments[0]
}

/// A quaternion as scripts write it.
fn text_of(turn: DQuat) -> String {
    format!("[{:?}, {:?}, {:?}, {:?}]", turn.w, turn.x, turn.y, turn.z)
}

#[test]
fn an_instrument_does_what_tools_with_its_tips_do_and_feels_their_sum() {
    let model = block();
    let begin = "duration_s = 0.3\nsample_every_s = 0.1\n";
    let (radius_m, offsets_m) = (0.004, [DVec3::new(-0.008, 0.002, 0.0), DVec3::ZERO, DVec3::new(0.006, 0.0, 0.001)]);
    let turn = DQuat::from_rotation_z(0.7) * DQuat::from_rotation_y(0.1);
    let [from_m, to_m] = [DVec3::new(0.03, 0.03, 0.036), DVec3::new(0.031, 0.03, 0.031)];
    let tips =
        offsets_m.map(|at_m| format!("{{ offset_m = {:?}, radius_m = {radius_m}, friction = 0.3 }}", at_m.to_array()));
    let instrument = format!(
        "{begin}[[instrument]]\ntips = [{}]\nposes = [{{ at_s = 0.01, place_m = {:?}, orientation = {turn} }}, \
         {{ at_s = 0.2, place_m = {:?}, orientation = {turn} }}]\n",
        tips.join(", "),
        from_m.to_array(),
        to_m.to_array(),
        turn = text_of(turn),
    );
    let tools = offsets_m.map(|at_m| {
        let place_m = |place_m: DVec3| (place_m + turn * at_m).to_array();
        format!(
            "[[tool]]\ntip = {{ shape = \"sphere\", radius_m = {radius_m}, friction = 0.3 }}\n\
             poses = [{{ at_s = 0.01, place_m = {:?} }}, {{ at_s = 0.2, place_m = {:?} }}]\n",
            place_m(from_m),
            place_m(to_m)
        )
    });
    let (records, one) = played(&model, &instrument);
    let (of_tools, three) = played(&model, &format!("{begin}{}", tools.concat()));
    assert!(one.largest_displacement_m > 1e-3, "{one:?}");
    assert!((one.largest_displacement_m / three.largest_displacement_m - 1.0).abs() < 1e-9);
    let felt = last(&records);
    let tools = &of_tools.last().unwrap().tools;
    let forces = || tools.iter().map(|tool| (DVec3::from(tool.place_m) - to_m, DVec3::from(tool.force_on_tool_n)));
    let force_n: DVec3 = forces().map(|(_, force_n)| force_n).sum();
    let torque_n_m: DVec3 = forces().map(|(from_m, force_n)| from_m.cross(force_n)).sum();
    assert!(force_n.z > 0.1 && torque_n_m.length() > 1e-4, "{force_n} {torque_n_m}");
    assert!(force_n.distance(felt.force_on_tool_n.into()) < 1e-6 * force_n.length(), "{force_n} {felt:?}");
    assert!(torque_n_m.distance(felt.torque_on_tool_n_m.into()) < 1e-6 * torque_n_m.length(), "{torque_n_m} {felt:?}");
    assert_eq!((felt.jaw_rad, felt.opening_n_m), (None, None));
}

/// Tips a radius apart press nearly like tips a third of that apart. (Each tip that a place touches adds its contact stiffness, so
/// that more of them are stiffer.)
#[test]
fn the_force_on_a_shaft_hardly_depends_on_how_many_tips_it_has() {
    let model = block();
    let wrench = |gaps: u32| {
        let (length_m, radius_m) = (0.024, 0.004);
        let tips = (0..=gaps).map(|at| {
            let offset_m = -length_m * f64::from(at) / f64::from(gaps);
            format!("{{ offset_m = [{offset_m:?}, 0, 0], radius_m = {radius_m}, friction = 0 }}")
        });
        let text = format!(
            "duration_s = 0.4\nsample_every_s = 0.4\n[[instrument]]\ntips = [{}]\n\
             poses = [{{ at_s = 0.01, place_m = [0.042, 0.03, 0.036] }}, {{ at_s = 0.2, place_m = [0.042, 0.03, 0.032] }}]\n",
            tips.collect::<Vec<_>>().join(", ")
        );
        let (records, _) = played(&model, &text);
        let InstrumentRecord { force_on_tool_n, torque_on_tool_n_m, .. } = *last(&records);
        (DVec3::from(force_on_tool_n).z, DVec3::from(torque_on_tool_n_m).y)
    };
    let shaft = "duration_s = 0.4\nsample_every_s = 0.4\n[[instrument]]\n\
                 shaft = { length_m = 0.024, radius_m = 0.004, friction = 0 }\n\
                 poses = [{ at_s = 0.01, place_m = [0.042, 0.03, 0.036] }, { at_s = 0.2, place_m = [0.042, 0.03, 0.032] }]\n";
    let (records, _) = played(&model, shaft);
    let felt = last(&records);
    let (force_n, torque_n_m) = (felt.force_on_tool_n[2], felt.torque_on_tool_n_m[1]);
    let (fine_n, fine_n_m) = wrench(24);
    println!("{force_n} N, {torque_n_m} N·m; {fine_n} N, {fine_n_m} N·m");
    assert_eq!(records.last().unwrap().tools.len(), 7);
    assert!(force_n > 0.1 && (force_n / fine_n - 1.0).abs() < 0.03, "{force_n} {fine_n} N");
    assert!((torque_n_m / fine_n_m - 1.0).abs() < 0.03, "{torque_n_m} {fine_n_m} N·m");
}

/// A plate that stands on its edge, between jaws from above.
#[test]
fn jaws_lift_what_is_between_them_by_friction_and_slip_without_it() {
    let plate = model(DVec3::new(0.04, 0.008, 0.024), 0.004);
    let down = text_of(DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2));
    let lifted = |friction: f64| {
        let pose = |at_s: f64, z_m: f64, jaw_rad: f64| {
            format!("{{ at_s = {at_s}, place_m = [0.02, 0.004, {z_m}], orientation = {down}, jaw_rad = {jaw_rad} }}")
        };
        let poses = [pose(0.01, 0.03, 0.7), pose(0.2, 0.016, 0.7), pose(0.4, 0.016, 0.1), pose(0.6, 0.02, 0.1)];
        let text = format!(
            "duration_s = 1.0\nsample_every_s = 0.1\n[[instrument]]\n\
             jaws = {{ length_m = 0.03, radius_m = 0.003, friction = {friction} }}\nposes = [{}]\n",
            poses.join(", ")
        );
        let (records, summary) = played(&plate, &text);
        assert_eq!(summary.guard_events, 0);
        records
    };
    let [holds, slips] = [0.8, 0.05].map(lifted);
    let [open, closed, held] = [2, 9, 10].map(|at: usize| &holds[at].instruments[0]);
    assert_eq!(open.force_on_tool_n, [0.0; 3]);
    println!("{held:?}\n{:?}", last(&slips));
    // The tissue pulls the instrument down, opens its jaws, and turns it by nothing.
    assert!(held.force_on_tool_n[2] < -0.02, "{held:?}");
    assert!(held.opening_n_m.unwrap() > 2e-4 && held.jaw_rad == Some(0.1), "{held:?}");
    assert!(held.torque_on_tool_n_m.iter().all(|part| part.abs() < 0.05 * held.opening_n_m.unwrap()), "{held:?}");
    // Nothing creeps.
    assert!((held.force_on_tool_n[2] / closed.force_on_tool_n[2] - 1.0).abs() < 1e-3, "{closed:?} {held:?}");
    // What is pressed between smooth jaws is driven out of them.
    assert!(last(&slips).force_on_tool_n[2] > held.force_on_tool_n[2] / 3.0, "{:?}", last(&slips));
}

/// Jaws close on the plate twice, further than their limit allows, and open in between.
#[test]
fn a_summary_tells_each_time_that_jaws_crush_what_they_hold() {
    let plate = model(DVec3::new(0.04, 0.008, 0.024), 0.004);
    let down = text_of(DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2));
    let pose = |at_s: f64, jaw_rad: f64| {
        format!("{{ at_s = {at_s}, place_m = [0.02, 0.004, 0.016], orientation = {down}, jaw_rad = {jaw_rad} }}")
    };
    let poses =
        [pose(0.01, 0.7), pose(0.2, 0.1), pose(0.3, 0.1), pose(0.4, 0.7), pose(0.5, 0.7), pose(0.7, 0.1)].join(", ");
    let text = |limit: &str| {
        format!(
            "duration_s = 0.8\nsample_every_s = 0.001\n[[instrument]]\n{limit}\n\
             jaws = {{ length_m = 0.03, radius_m = 0.003, friction = 0.8 }}\nposes = [{poses}]\n"
        )
    };
    let (records, free) = played(&plate, &text(""));
    let opening_n_m = |record: &Record| record.instruments.first().map_or(0.0, |felt| felt.opening_n_m.unwrap());
    let most_n_m = records.iter().map(opening_n_m).fold(0.0, f64::max);
    let limit_n_m = 0.5 * most_n_m;
    assert!(free.jaw_overloads.is_empty() && free.warnings.is_empty(), "{:?}", free.warnings);
    let (_, limited) = played(&plate, &text(&format!("jaw_torque_limit_n_m = {limit_n_m:?}")));
    println!("{:?} {:?}", limited.jaw_overloads, limited.warnings);
    assert_eq!(limited.final_hash, free.final_hash);
    // Once for each time that they close: at the first step whose torque is above the limit.
    let is_above = |from_step: usize| (from_step..).find(|step| opening_n_m(&records[*step]) > limit_n_m);
    let steps: Vec<_> = limited.jaw_overloads.iter().map(|overload| Some(overload.step as usize)).collect();
    assert_eq!(steps, [is_above(0), is_above(450)]);
    for overload in &limited.jaw_overloads {
        assert_eq!((overload.instrument, overload.first_tool, overload.limit_n_m), (0, 0, limit_n_m));
        assert_eq!(overload.torque_n_m, opening_n_m(&records[overload.step as usize]));
    }
    let [warning] = &limited.warnings[..] else { panic!("{:?}", limited.warnings) };
    assert!(warning.contains("instrument 0") && warning.contains("2 times"), "{warning}");
    for (limit, says) in
        [("0", "above 0"), ("-1", "above 0"), ("101", "at most 100"), ("nan", "finite"), ("\"a\"", "number")]
    {
        let refusal = script(&plate, &text(&format!("jaw_torque_limit_n_m = {limit}"))).unwrap_err().to_string();
        assert!(refusal.contains("jaw_torque_limit_n_m") && refusal.contains(says), "{refusal}");
    }
    let shaft = text("jaw_torque_limit_n_m = 0.1").replace("jaws =", "shaft =").replace("jaw_rad = 0.7", "jaw_rad = 0");
    let refusal = script(&plate, &shaft.replace("jaw_rad = 0.1", "jaw_rad = 0")).unwrap_err().to_string();
    assert!(refusal.contains("jaw_torque_limit_n_m") && refusal.contains("with jaws"), "{refusal}");
}

/// A shaft through a port presses and sweeps. Between its poses the script would lead it past the port.
#[test]
fn a_shaft_stays_in_its_port_whose_reaction_balances_the_wrench() {
    let model = block();
    let port_m = DVec3::new(0.02, 0.03, 0.12);
    let text = "duration_s = 0.6\nsample_every_s = 0.01\n[[instrument]]\n\
        shaft = { length_m = 0.02, radius_m = 0.004, friction = 0.4 }\n\
        port = { place_m = [0.02, 0.03, 0.12], handle_m = 0.3 }\n\
        poses = [{ at_s = 0, place_m = [0.03, 0.03, 0.036] }, { at_s = 0.2, place_m = [0.03, 0.03, 0.031] },\n\
        { at_s = 0.5, place_m = [0.04, 0.036, 0.031], orientation = [0, 0, 1, 0] }]\n";
    let (records, _) = played(&model, text);
    let mut pressed_n = 0.0_f64;
    for record in &records {
        let [felt] = &record.instruments[..] else { panic!("{record:?}") };
        let place_m = DVec3::from(felt.place_m);
        let [w, x, y, z] = felt.orientation;
        let axis = DQuat::from_xyzw(x, y, z, w) * DVec3::X;
        assert!((port_m - place_m).cross(axis).length() < 1e-12, "{felt:?}");
        for tool in &record.tools {
            let apart_m = (DVec3::from(tool.place_m) - port_m).cross(axis).length();
            assert!(apart_m < 1e-9, "{apart_m} m");
        }
        let load = felt.in_port.unwrap();
        let [port_n, hand_n, hand_n_m] =
            [load.force_of_port_n, load.force_on_hand_n, load.torque_on_hand_n_m].map(DVec3::from);
        let (force_n, torque_n_m) = (DVec3::from(felt.force_on_tool_n), DVec3::from(felt.torque_on_tool_n_m));
        assert!((force_n + port_n).distance(hand_n) < 1e-12, "{felt:?}");
        let about_m = torque_n_m + (port_m - place_m).cross(port_n) - (-0.3 * axis).cross(hand_n) - hand_n_m;
        assert!(about_m.length() < 1e-12 && port_n.dot(axis).abs() < 1e-12, "{about_m} {felt:?}");
        pressed_n = pressed_n.max(port_n.length());
    }
    assert!(pressed_n > 0.05, "{pressed_n} N");
}

#[test]
fn instruments_that_nothing_can_be_are_refused_with_their_place() {
    let model = block();
    let pose = "poses = [{ at_s = 0, place_m = [0.03, 0.03, 0.05] }]";
    let of = |instrument: &str| format!("duration_s = 1\nsample_every_s = 1\n[[instrument]]\n{instrument}\n");
    let tip = "tips = [{ radius_m = 0.004 }]";
    for (text, expected) in [
        (of(pose), "instrument[0]: must have `tips`, a `shaft`, `jaws`, `scissors` or a `blade`"),
        (of(&format!("{tip}\nposes = []")), "instrument[0].poses: must have at least one pose"),
        (
            of(&format!("blade = {{ length_m = 0.5 }}\n{pose}")),
            "instrument[0].blade.length_m: must be above 0 and at most",
        ),
        (of(&format!("{tip}\n{pose}\nuntil_s = 0")), "instrument[0].until_s: must be later than the first pose"),
        (
            of(&format!("{tip}\nposes = [{{ at_s = 0, place_m = [0.03, 0.03, 0.05], jaw_rad = 0.1 }}]")),
            "instrument[0].poses[0].jaw_rad: is for an instrument with jaws",
        ),
        (
            of(&format!("{tip}\nposes = [{{ at_s = 0, place_m = [0.03, 0.03, 0.05], orientation = [1, 1, 0, 0] }}]")),
            "instrument[0].poses[0].orientation: must have the length 1",
        ),
        (
            of("jaws = { length_m = 0.01, radius_m = 0.002 }\n\
                poses = [{ at_s = 0, place_m = [0.03, 0.03, 0.05], jaw_rad = -0.1 }]"),
            "instrument[0].poses[0].jaw_rad: must be from 0 to 3.1416",
        ),
        (
            of(&format!("shaft = {{ length_m = 0.5, radius_m = 0.002 }}\n{pose}")),
            "instrument[0]: has 65 tips, above the limit of 64",
        ),
        (
            of(&format!("shaft = {{ length_m = 0.5, radius_m = 0.05 }}\n{pose}")),
            "instrument[0].shaft.radius_m: must be above 0 and at most",
        ),
        (
            of(&format!("tips = [{{ radius_m = 0.004, grasps = true }}]\n{pose}")),
            "instrument[0].tips[0].grasps: is for a [[tool]]",
        ),
        (of(&format!("tips = [{{ radius_m = 0.0001 }}]\n{pose}")), "instrument[0].tips[0].radius_m: must be at least"),
        (
            of(&format!("{tip}\nport = {{ place_m = [0.03, 0.03, 0.05] }}\n{pose}")),
            "instrument[0].poses[0].place_m: must be from 0.001 to 0.329 m from the port",
        ),
        (
            of(&format!(
                "{tip}\nport = {{ place_m = [0.03, 0.03, 0.04] }}\nposes = [{{ at_s = 0, place_m = [0.02, 0.03, 0.04] }}, \
                 {{ at_s = 1, place_m = [0.04, 0.03, 0.04] }}]"
            )),
            "instrument[0].poses[1].place_m: must be at least 0.001 m from the port on the way from the pose before",
        ),
        (
            of(&format!("{tip}\nport = {{ place_m = [0.03, 0.03, 0.1], handle_m = 3 }}\n{pose}")),
            "instrument[0].port.handle_m: must be from 0.01 to 2",
        ),
        (
            of(&format!("{tip}\nposes = [{{ at_s = 0, place_m = [0, 0, 9] }}]")),
            "instrument[0].poses[0].place_m: must be at most",
        ),
    ] {
        let refusal = script(&model, &text).unwrap_err().to_string();
        assert!(refusal.contains(expected), "{expected}: {refusal}");
    }
}

/// Two shafts meet above the tissue, crossed, at 0.1 m/s.
#[test]
fn records_tell_the_overlap_of_two_instruments_and_equal_forces_on_both() {
    let across = text_of(DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2));
    let text = format!(
        "duration_s = 0.3\nsample_every_s = 0.01\n[[instrument]]\n\
         shaft = {{ length_m = 0.03, radius_m = 0.003 }}\n\
         poses = [{{ at_s = 0, place_m = [0.045, 0.03, 0.05] }}, {{ at_s = 0.2, place_m = [0.045, 0.03, 0.05] }}]\n\
         [[instrument]]\nshaft = {{ length_m = 0.03, radius_m = 0.003 }}\n\
         poses = [{{ at_s = 0, place_m = [0.03, 0.045, 0.066], orientation = {across} }}, \
         {{ at_s = 0.12, place_m = [0.03, 0.045, 0.054], orientation = {across} }}]\n"
    );
    let (records, summary) = played(&block(), &text);
    assert_eq!(summary.guard_events, 0);
    let mut deepest_m = 0.0_f64;
    for record in &records {
        let [lower, upper] = &record.instruments[..] else { continue };
        let apart_m = upper.place_m[2] - lower.place_m[2];
        let ([of_lower], [of_upper]) = (&lower.contacts[..], &upper.contacts[..]) else {
            assert!(lower.contacts.is_empty() && upper.contacts.is_empty() && apart_m >= 0.006 - 1e-12, "{record:?}");
            continue;
        };
        assert_eq!((of_lower.with_instrument, of_upper.with_instrument), (1, 0));
        assert!((of_lower.depth_m - (0.006 - apart_m)).abs() < 1e-12, "{record:?}");
        assert!(of_upper.force_n[2] > 0.0 && (of_upper.force_n[2] + of_lower.force_n[2]).abs() < 1e-12, "{record:?}");
        deepest_m = deepest_m.max(of_lower.depth_m);
    }
    assert!((deepest_m - 0.002).abs() < 1e-9, "{deepest_m} m");
}
