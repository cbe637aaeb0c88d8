//! Tests of blades: what they sever, and that a cut tissue has the same bits everywhere.
#![allow(clippy::unwrap_used)]

mod energy;
mod press;
mod slit;

use std::sync::Arc;

use glam::DVec3;

use super::EdgeSweep;
use crate::interface::Tissue;
use crate::limits::Limits;
use crate::{Model, at_rest, restored};
use palpate_haptics::{Tip, TipShape};

/// A blade whose edge stands upright, 20 mm long.
fn blade() -> Tip {
    Tip { shape: TipShape::Blade, radius_m: 0.001, edge_m: 0.02 * DVec3::Z, ..Tip::default() }
}

/// Leads a blade through the surface from one place to another.
fn cut(tissue: &mut dyn Tissue, from_m: DVec3, to_m: DVec3, steps: u32) {
    for step in 0..=steps {
        tissue.pose(0, from_m.lerp(to_m, f64::from(step) / f64::from(steps)), blade());
        tissue.step().unwrap();
    }
    tissue.release(0);
}

/// Returns a sheet of 40 × 37 points that are 5 mm apart.
fn sheet(more: &[&str]) -> Arc<Model> {
    let mut sets = vec!["sheet.points=[40, 37]", "sheet.spacing_m=0.005", "springs.bending=true"];
    sets.extend(more);
    Model::paper(&sets)
}

#[test]
fn an_edge_crosses_what_lies_between_its_lines_once() {
    let sweep = EdgeSweep { from_m: [-DVec3::Z, DVec3::Z], to_m: [DVec3::X - DVec3::Z, DVec3::X + DVec3::Z] };
    let crosses = |x: f64, y: f64| sweep.crosses(DVec3::new(x, y, 0.1), -2.0 * y * DVec3::Y, DVec3::ZERO);
    assert_eq!(crosses(0.5, 0.5), Some(0.5));
    assert_eq!(crosses(0.9, -0.25), Some(0.5));
    assert_eq!((crosses(-0.1, 0.5), crosses(1.1, 0.5)), (None, None));
    // On the diagonal of both triangles, and on the line at which one sweep ends and the next begins.
    let next = EdgeSweep { from_m: sweep.to_m, to_m: sweep.to_m.map(|place_m| place_m + DVec3::X) };
    for (x, y, z) in [(0.55, 0.5, 0.1), (1.0, 0.5, 0.1), (1.0, -0.5, -0.3)] {
        let by = |sweep: &EdgeSweep| sweep.crosses(DVec3::new(x, y, z), -2.0 * y * DVec3::Y, DVec3::ZERO).is_some();
        assert_eq!([&sweep, &next].map(by).into_iter().filter(|crosses| *crosses).count(), 1, "{x} {y} {z}");
    }
    // A line that moves across an edge that stays.
    let stays = EdgeSweep { from_m: sweep.from_m, to_m: sweep.from_m };
    let moved = |by: f64| stays.crosses(DVec3::new(0.1, 0.5, 0.0), -DVec3::Y, by * DVec3::X);
    assert_eq!((moved(0.2), moved(0.05)), (Some(0.5), None));
}

#[test]
fn a_cut_across_a_sheet_leaves_two_pieces_and_no_spring_between_them() {
    let model = sheet(&["stepping.precision=f64"]);
    let mut tissue = at_rest(&model);
    assert_eq!((tissue.cuts().pieces(&model), tissue.cuts()), (1, crate::Cuts::default()));
    // Between rows 9 and 10.
    let [from_m, to_m] = [-0.01, 0.19].map(|y| DVec3::new(0.0475, y, -0.01));
    cut(&mut *tissue, from_m, to_m, 150);
    assert_eq!(tissue.cuts().pieces(&model), 2);
    // Each row of points has one spring across, two shear springs to each side, and two bending springs.
    let columns = 37;
    assert_eq!(tissue.cuts().len(), columns + 2 * (columns - 1) + 2 * columns);
    let sides = tissue.cuts().joints(&model).iter().all(|spring| {
        let [a, b] = spring.points.map(|point| model.shape().rest_m(point).x);
        (a - 0.0475) * (b - 0.0475) < 0.0 && (a + spring.part * (b - a) - 0.0475).abs() < 1e-4
    });
    assert!(sides, "a spring beside the cut");
    // What pushes on one piece moves it alone.
    let middle = DVec3::new(0.02, 0.09, 0.0);
    let poke = crate::scene::profile::Poke {
        point: None,
        centre_m: middle,
        force_n: -0.2 * DVec3::Z,
        falloff_per_m: 100.0,
        falloff_offset: 0.0,
    };
    tissue.push(1, Some(crate::Push::Constant(poke)));
    (0..200).for_each(|_| tissue.step().unwrap());
    let moved_m = |x: f64| tissue.surface_displacement_m(DVec3::new(x, 0.09, 0.0)).length();
    assert!(moved_m(0.04) > 1e-4 && moved_m(0.06) < 0.2 * moved_m(0.04), "{} {}", moved_m(0.04), moved_m(0.06));
}

#[test]
fn a_cut_has_the_same_bits_at_every_width_and_continues_from_a_snapshot() {
    for scene in ["sheet", "gallbladder"] {
        for precision in ["f32", "f64"] {
            let mut hashes = Vec::new();
            for lanes in ["plain", "avx2", "auto"] {
                let sets = [&format!("stepping.precision={precision}"), &format!("stepping.lanes={lanes}")];
                let sets = sets.map(String::as_str);
                let model = if scene == "sheet" { sheet(&sets) } else { Model::gallbladder(&sets) };
                let extent = model.shape().extent();
                let (middle_m, size_m) = (extent.middle_m(), extent.size_m());
                let top_m = if scene == "sheet" { 0.0 } else { extent.most_m.z };
                let along = DVec3::new(0.3 * size_m.x, 0.1 * size_m.y, 0.0);
                let low_m = DVec3::new(middle_m.x, middle_m.y, top_m - 0.008);
                let mut tissue = at_rest(&model);
                let tip = |at: f64| (low_m + at * along, blade());
                let lead = |tissue: &mut dyn Tissue, steps: std::ops::Range<u32>| {
                    for step in steps {
                        let (place_m, tip) = tip(-1.0 + f64::from(step) / 60.0);
                        tissue.pose(0, place_m, tip);
                        tissue.step().unwrap();
                    }
                };
                lead(&mut *tissue, 0..70);
                let saved = tissue.save().plain();
                let mut again = restored(&model, &saved.parts, &saved.values, &Limits::default()).unwrap();
                assert_eq!(again.cuts().version(), tissue.cuts().version());
                lead(&mut *tissue, 70..120);
                lead(&mut *again, 70..120);
                assert!(tissue.cuts().len() > 20, "{scene}: {:?}", tissue.cuts());
                assert_eq!(again.state_hash(), tissue.state_hash(), "{scene} {precision} {lanes}");
                assert_eq!(again.cuts().joints(&model), tissue.cuts().joints(&model));
                hashes.push(tissue.state_hash());
            }
            assert!(hashes.windows(2).all(|pair| pair[0] == pair[1]), "{scene} {precision}: {hashes:x?}");
        }
    }
}

#[test]
fn the_sweep_and_a_single_point_agree_about_severed_springs() {
    for scene in ["sheet", "gallbladder"] {
        let sets = ["stepping.precision=f64", "stepping.integrator=central"];
        let model = if scene == "sheet" { sheet(&sets) } else { Model::gallbladder(&sets) };
        let mut tissue = crate::state::tissue_state::TissueState::<f64>::new(&model);
        let extent = model.shape().extent();
        let (middle_m, size_m) = (extent.middle_m(), extent.size_m());
        let low_m = DVec3::new(middle_m.x, middle_m.y, extent.most_m.z - 0.008);
        let poke = crate::scene::profile::Poke {
            point: None,
            centre_m: DVec3::new(middle_m.x, middle_m.y, extent.most_m.z),
            force_n: DVec3::new(0.05, 0.02, -0.1),
            falloff_per_m: 50.0,
            falloff_offset: 0.0,
        };
        tissue.push(1, Some(crate::Push::Constant(poke)));
        cut(&mut tissue, low_m - 0.3 * size_m.x * DVec3::X, low_m + 0.3 * size_m.x * DVec3::X, 100);
        assert!(tissue.cuts().len() > 20);
        // Newton: all forces on a point give its change of velocity.
        let energy_j = tissue.energy();
        let by_points: f64 = model
            .points()
            .map(|point| {
                let state = tissue.point(point);
                0.5 * model.mass_kg(point) * state.velocity_m_per_s.length_squared()
            })
            .sum();
        assert!((energy_j.kinetic_j / by_points - 1.0).abs() < 1e-6, "{} {by_points}", energy_j.kinetic_j);
        let momentum: DVec3 = model.points().map(|point| tissue.point(point).spring_n).sum();
        let most = model.points().map(|point| tissue.point(point).spring_n.length()).fold(0.0, f64::max);
        assert!(momentum.length() < 1e-9 * most.max(1e-9) * model.len() as f64, "{momentum} of {most} N");
    }
}

/// Returns the sheet under a pretension, without anchor springs, held at its rim.
fn tense(points: usize, more: &[&str]) -> Arc<Model> {
    let points = format!("sheet.points=[{points}, {points}]");
    let mut sets = vec![
        points.as_str(),
        "sheet.spacing_m=0.001",
        "sheet.point_mass_kg=1e-6",
        "sheet.fixed=\"edges\"",
        "springs.stiffness_n_per_m=100",
        "springs.shear_stiffness_n_per_m=50",
        "springs.pretension_n_per_m=0.5",
        "anchor_springs.stiffness_n_per_m=0",
        "damping.coefficient_n_s_per_m=0.002",
        "stepping.precision=f64",
        "stepping.integrator=exponential2",
        "stepping.substeps=1",
        "stepping.rate_hz=20000",
        "sleep.tolerance=0",
    ];
    sets.extend(more);
    Model::paper(&sets)
}

#[test]
fn a_tense_sheet_rests_exactly_and_a_slit_in_it_opens_as_inglis_says() {
    let (points, half) = (201, 10);
    let model = tense(points, &[]);
    let mut tissue = at_rest(&model);
    (0..50).for_each(|_| tissue.step().unwrap());
    assert_eq!(tissue.largest_displacement_m(), 0.0);
    // Between two rows of points in the middle, across 2c = 21 springs.
    let middle_m = 0.001 * (points - 1) as f64 / 2.0;
    let x = middle_m + 0.0005;
    let y = [-1.0, 1.0].map(|side| middle_m + side * (0.001 * half as f64 + 0.0003));
    let low = |y: f64| DVec3::new(x, y, -0.01);
    for step in 0..=40 {
        tissue.pose(0, low(y[0] + (y[1] - y[0]) * f64::from(step) / 40.0), blade());
        tissue.step().unwrap();
    }
    tissue.release(0);
    let structural = tissue.cuts().joints(&model).into_iter().filter(|spring| {
        let [a, b] = spring.points.map(|point| model.shape().rest_m(point));
        a.y == b.y
    });
    assert_eq!(structural.count(), 2 * half + 1);
    (0..6000).for_each(|_| tissue.step().unwrap());
    let at = |x: f64| tissue.surface_displacement_m(DVec3::new(x, middle_m, 0.0)).x;
    let opening_m = at(middle_m + 0.001) - at(middle_m);
    // E·t = 8k/3·… of the lattice: k = 100, k_s = 50 N/m: isotropic with ν = 1/3, E·t = 4k/3.
    let expected_m = 4.0 * 0.5 * (0.001 * (half as f64 + 0.5)) / (4.0 / 3.0 * 100.0);
    assert!((opening_m / expected_m - 1.0).abs() < 0.1, "{opening_m} m, {expected_m} m");
}

/// Returns a sheet of 75 mm like the scene `liver`, with keys that differ.
pub(super) fn liver(more: &[&str]) -> Arc<Model> {
    let sets = [
        "sheet.points=[31, 31]",
        "sheet.spacing_m=0.0025",
        "sheet.point_mass_kg=6.625e-5",
        "springs.stiffness_n_per_m=40.5",
        "springs.shear_stiffness_n_per_m=20.25",
        "anchor_springs.stiffness_n_per_m=5.655",
        "damping.coefficient_n_s_per_m=0.01936",
    ];
    Model::paper(&[&sets[..], more].concat())
}

#[test]
fn a_blade_pushes_first_and_then_cuts_with_the_work_of_separation() {
    let toughness = 20.0;
    let model = liver(&["stepping.precision=f64", "cutting.toughness_j_per_m2=20"]);
    let mut tissue = at_rest(&model);
    let (mut pushed_n, mut cutting_n, mut largest_jump_n) = (0.0_f64, Vec::new(), 0.0_f64);
    let mut before_n = 0.0;
    // In at rest, 5 mm deep; then 30 mm along at 20 mm/s.
    for step in 0..1500 {
        let y = 0.021 + 2e-5 * f64::from(step);
        tissue.pose(0, DVec3::new(0.03625, y, -0.005), blade());
        tissue.step().unwrap();
        let contact = tissue.tool_contact(0).unwrap();
        let along_n = -contact.force_on_tool_n.y;
        if tissue.cuts().is_empty() {
            pushed_n = pushed_n.max(along_n);
        } else {
            largest_jump_n = largest_jump_n.max((along_n - before_n).abs());
        }
        before_n = along_n;
        if step > 600 {
            cutting_n.push(along_n);
        }
    }
    let mean_n = cutting_n.iter().sum::<f64>() / cutting_n.len() as f64;
    let most_n = cutting_n.iter().copied().fold(0.0, f64::max);
    let resistance_n = toughness * 0.005;
    assert!(pushed_n > 0.2 * resistance_n, "{pushed_n} N before anything was severed");
    assert!((mean_n / resistance_n - 1.0).abs() < 0.02, "{mean_n} N of {resistance_n} N");
    assert!(most_n <= 1.001 * resistance_n && largest_jump_n < 0.2 * resistance_n, "{most_n} {largest_jump_n}");
    // Out of the tissue it feels nothing.
    tissue.pose(0, DVec3::new(0.03625, 0.05, 0.01), blade());
    tissue.step().unwrap();
    tissue.step().unwrap();
    assert_eq!(tissue.tool_contact(0).unwrap().force_on_tool_n, DVec3::ZERO);
}

#[test]
fn a_blade_that_turns_as_it_cuts_does_not_look_like_energy_from_nowhere() {
    // Of a soft tissue, and of a liver, which a blade pushes far before it cuts.
    let models = ["20", "187"].map(|toughness| liver(&[&format!("cutting.toughness_j_per_m2={toughness}")]));
    for (seed, model) in (0..8).zip(models.iter().cycle()) {
        let mut tissue = at_rest(model);
        let phase = f64::from(seed);
        // As a hand leads it: in and out and along, while the edge turns about two axes.
        for step in 0..2500 {
            let time_s = 1e-3 * f64::from(step);
            let swing = |hz: f64, phase: f64| (std::f64::consts::TAU * hz * time_s + phase).sin();
            let place_m = DVec3::new(
                0.0375 + 0.008 * swing(0.4, 2.0 * phase),
                0.0375 + 0.01 * swing(0.5, phase),
                -0.001 - 0.004 * swing(0.7, 3.0 * phase),
            );
            let edge_m = 0.012 * DVec3::new(0.4 * swing(1.0, phase), 0.4 * swing(0.7, 1.0 + phase), 1.0).normalize();
            tissue.pose(0, place_m, Tip { edge_m, ..blade() });
            tissue.step().unwrap();
        }
        assert_eq!(tissue.guard_events(), 0, "seed {seed}");
        assert!(tissue.cuts().len() > 10, "seed {seed}: {} severed", tissue.cuts().len());
    }
}

#[test]
fn scissors_cut_what_lies_between_their_edges_when_they_close() {
    let model = sheet(&["stepping.precision=f64"]);
    let text = "duration_s = 0.3\nsample_every_s = 0.1\n[[instrument]]\nscissors = { length_m = 0.03 }\n\
                poses = [{ at_s = 0.0, place_m = [0.0976, 0.1, 0.0], orientation = [0.5, 0.5, 0.5, 0.5], jaw_rad = 0.6 },\n\
                { at_s = 0.2, place_m = [0.0976, 0.1, 0.0], orientation = [0.5, 0.5, 0.5, 0.5] }]\n";
    let folder = std::path::Path::new("scripts");
    let script = crate::scene::script::Script::parse("test", text, folder, &model.scene, &Limits::default()).unwrap();
    let mut tissue = at_rest(&model);
    let mut severed_at = [0; 2];
    for step in 0..300 {
        for (tool, action) in script.poses_at(step) {
            let crate::scene::script::Action::Pose { place_m, tip, .. } = action else { panic!("{action:?}") };
            tissue.pose(tool, place_m, tip);
        }
        tissue.step().unwrap();
        severed_at[usize::from(step > 150)] = tissue.cuts().len();
    }
    // It points along y: from its hinge, 30 mm behind the ends of the jaws.
    let joints = tissue.cuts().joints(&model);
    assert!(joints.len() > 8 && severed_at[0] < joints.len(), "{severed_at:?}");
    for joint in joints {
        let [a_m, b_m] = joint.points.map(|point| model.shape().rest_m(point));
        let place_m = a_m.lerp(b_m, joint.part);
        assert!((place_m.x - 0.0976).abs() < 1e-3 && (0.065..0.105).contains(&place_m.y), "{place_m}");
    }
}

#[test]
fn a_wound_that_gapes_without_any_damping_does_not_look_like_energy_from_nowhere() {
    for integrator in ["exponential2", "central"] {
        let integrator = format!("stepping.integrator={integrator}");
        let model = tense(61, &["damping.coefficient_n_s_per_m=0", &integrator]);
        let mut tissue = at_rest(&model);
        let low = |y: f64| DVec3::new(0.0305, y, -0.01);
        cut(&mut *tissue, low(0.0245), low(0.0355), 400);
        (0..4000).for_each(|_| tissue.step().unwrap());
        assert_eq!(tissue.guard_events(), 0);
        assert!(tissue.largest_displacement_m() > 1e-5, "{} m", tissue.largest_displacement_m());
    }
}
