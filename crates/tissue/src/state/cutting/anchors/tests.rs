//! Tests of severed anchor springs: that a freed tissue feels its bed no more, and what a blade must cross for that.
#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use glam::DVec3;

use crate::compile::square_of_triangles;
use crate::interface::Tissue;
use crate::limits::Limits;
use crate::scene::Scene;
use crate::scene::profile::{MotionProfile, Move, Poke};
use crate::state::tissue_state::TissueState;
use crate::{Grasp, Model, at_rest, restored};
use palpate_haptics::{Tip, TipShape};
use palpate_refusal::Reason;

/// The longer side of the surface, m, and how far beneath it its anchors are attached.
const SIDE_M: f64 = 0.08;
const DEPTH_M: f64 = 0.004;

/// Number of points of the surface.
const POINTS: usize = 17 * 15;

/// Returns the text of a flat surface of triangles on anchor springs, which a blade severs; a sheet of the same size has as many points.
fn text(more: &str) -> String {
    format!(
        "[mesh]\nfile = \"square.obj\"\nunit = \"m\"\npoint_mass_kg = 1e-4\n[springs]\nstiffness_n_per_m = 100\nbending = 0.1\n\
         [anchor_springs]\nstiffness_n_per_m = 5\n[cutting]\nanchor_depth_m = {DEPTH_M:?}\n{more}"
    )
}

fn model(kind: &str, damping: f64, sets: &str) -> Arc<Model> {
    let more = format!("[damping]\ncoefficient_n_s_per_m = {damping:?}\n[stepping]\n{sets}");
    if kind == "sheet" {
        let text = text(&more).replace("bending = 0.1", "bending = false");
        let body = "[sheet]\npoints = [17, 15]\nspacing_m = 0.005\n";
        let text = text.replace("[mesh]\nfile = \"square.obj\"\nunit = \"m\"\n", body);
        return Model::parse("sheet", &text, &[]).unwrap();
    }
    let mesh = square_of_triangles([16, 14], SIDE_M / 16.0);
    let scene =
        Scene::parse_given("square", &text(&more), ("square.obj", mesh.as_bytes()), &Limits::default()).unwrap();
    Model::compile(&scene, &Limits::default()).unwrap()
}

/// The tip of a lying blade, y in m: its edge reaches over the whole width.
const BEGIN_M: f64 = -0.005;

/// A blade whose edge lies along y, longer than the surface is wide.
fn lying() -> Tip {
    Tip { shape: TipShape::Blade, radius_m: 0.001, edge_m: SIDE_M * DVec3::Y, ..Tip::default() }
}

/// Leads a blade along x from before the surface to a place, m, at a height, m.
fn sweep(tissue: &mut dyn Tissue, [to_m, height_m]: [f64; 2], steps: u32, tip: Tip) {
    let from_m = DVec3::new(-0.01, BEGIN_M, height_m);
    for step in 0..=steps {
        let way_m = (to_m + 0.01) * f64::from(step) / f64::from(steps);
        tissue.pose(0, from_m + way_m * DVec3::X, tip);
        tissue.step().unwrap();
    }
    tissue.release(0);
}

/// Pulls up in the middle from now on, for some steps.
fn pull(tissue: &mut dyn Tissue, steps: u32) {
    let centre_m = DVec3::new(0.5 * SIDE_M, 0.4 * SIDE_M, 0.0);
    let force_n = DVec3::new(0.02, 0.0, 0.1);
    let poke = Poke { point: None, centre_m, force_n, falloff_per_m: 50.0, falloff_offset: 0.0 };
    tissue.push(1, Some(crate::Push::Constant(poke)));
    (0..steps).for_each(|_| tissue.step().unwrap());
}

/// Returns Σ m·v, kg·m/s.
fn momentum(tissue: &dyn Tissue) -> DVec3 {
    let model = tissue.model().clone();
    model.points().map(|point| model.mass_kg(point) * tissue.point(point).velocity_m_per_s).sum()
}

#[test]
fn a_flap_cut_free_of_its_bed_lifts_without_a_force_of_the_foundation() {
    for kind in ["sheet", "surface"] {
        let model = model(kind, 0.01, "precision = \"f64\"\n");
        let held = model.shape().nearest(DVec3::new(0.5 * SIDE_M, 0.5 * SIDE_M, 0.0));
        let lift = |tissue: &mut dyn Tissue| {
            let moves = vec![Move { from_s: 0.0, to_s: 1.0, by_m: 0.005 * DVec3::Z }];
            tissue.grasp(2, held, Grasp::Profile(MotionProfile { point: held, moves }));
            (0..3000).for_each(|_| tissue.step().unwrap());
            let force_n = tissue.point(held).constraint_n.unwrap();
            force_n.length()
        };
        let bound_n = lift(&mut *at_rest(&model));
        assert!(bound_n > 0.02, "{bound_n} N");
        let mut tissue = at_rest(&model);
        sweep(&mut *tissue, [0.09, -0.002], 100, lying());
        let cuts = tissue.cuts();
        assert_eq!((cuts.anchor_count(), cuts.len(), cuts.pieces(&model)), (POINTS, POINTS, 1));
        assert!(cuts.joints(&model).is_empty());
        // The rest is damping: it creeps into its flat shape, because springs hardly resist small bends.
        let freed_n = lift(&mut *tissue);
        assert!(freed_n < 0.01 * bound_n, "{freed_n} N of {bound_n} N");
        assert!(model.points().all(|point| tissue.point(point).anchor_n == DVec3::ZERO));
        assert_eq!((tissue.energy().anchor_j, tissue.guard_events()), (0.0, 0));
    }
}

#[test]
fn anchors_stay_whole_above_below_and_along_a_blade() {
    for kind in ["sheet", "surface"] {
        let model = model(kind, 0.05, "");
        let upright = Tip { edge_m: SIDE_M * DVec3::Z, ..lying() };
        // The last one crosses the surface itself, farther than the anchors are long.
        for (what, height_m, tip) in
            [("above", 0.001, lying()), ("below", -0.006, lying()), ("upright", -0.05, upright)]
        {
            let mut tissue = at_rest(&model);
            let mut tip_m = DVec3::new(-0.01, if what == "upright" { 0.0374 } else { BEGIN_M }, height_m);
            for _ in 0..100 {
                tip_m.x += 4e-4;
                tissue.pose(0, tip_m, tip);
                tissue.step().unwrap();
            }
            let cuts = tissue.cuts();
            assert_eq!((cuts.anchor_count(), cuts.joint_count() > 0), (0, what == "upright"), "{what}");
        }
        // As far as the blade came: points at 0 to 30 mm.
        let mut tissue = at_rest(&model);
        sweep(&mut *tissue, [0.032, -0.002], 100, lying());
        assert_eq!(tissue.cuts().anchor_count(), 7 * 15);
        // Lifted tissue offers longer lines: the blade passes above where the surface rests.
        let mut lifted = at_rest(&model);
        pull(&mut *lifted, 300);
        let risen_m = lifted.largest_displacement_m();
        sweep(&mut *lifted, [0.09, 0.5 * risen_m], 30, lying());
        let count = lifted.cuts().anchor_count();
        assert!(count > 0 && count < POINTS, "{count} at half of {risen_m} m");
    }
}

#[test]
fn a_severed_anchor_takes_its_energy_along_and_leaves_the_momentum() {
    for kind in ["sheet", "surface"] {
        for (integrator, part) in [("exponential2", 1e-3), ("exponential4", 1e-3), ("central", 1e-2), ("rk4", 1e-3)] {
            let model =
                model(kind, 0.0, &format!("precision = \"f64\"\nsubsteps = 8\nintegrator = \"{integrator}\"\n"));
            let mut tissue = at_rest(&model);
            pull(&mut *tissue, 60);
            tissue.push(1, None);
            let stored = |tissue: &dyn Tissue| {
                let energy = tissue.energy();
                energy.kinetic_j + energy.spring_j + energy.anchor_j
            };
            tissue.pose(0, DVec3::new(-0.01, BEGIN_M, -0.0035), lying());
            tissue.step().unwrap();
            let before_j = stored(&*tissue);
            tissue.pose(0, DVec3::new(0.09, BEGIN_M, -0.0035), lying());
            tissue.step().unwrap();
            tissue.release(0);
            let (after_j, fracture_j) = (stored(&*tissue), tissue.cuts().fracture_j());
            assert_eq!(tissue.cuts().anchor_count(), POINTS);
            assert!(fracture_j > 0.05 * before_j, "{integrator}: {fracture_j} J of {before_j} J");
            let lost_j = before_j - after_j - fracture_j;
            assert!(lost_j.abs() < part * before_j, "{integrator}: {lost_j} J of {before_j} J");
            // Nothing else acts on it: it drifts evenly, from the first step on.
            let begun = momentum(&*tissue);
            for step in 0..150 {
                tissue.step().unwrap();
                if step > 10 && step % 20 != 0 {
                    continue;
                }
                let now = momentum(&*tissue);
                assert!(
                    (now - begun).length() < 1e-3 * begun.length(),
                    "{integrator}, step {step}: {begun} then {now}"
                );
            }
            assert_eq!(tissue.guard_events(), 0, "{integrator}");
        }
    }
}

#[test]
fn severed_anchors_have_the_same_bits_at_every_width_and_continue_from_a_snapshot() {
    for (kind, precision) in
        [("sheet", "f32"), ("sheet", "f64"), ("organ", "f32"), ("organ", "compensated"), ("organ", "f64")]
    {
        let mut hashes = Vec::new();
        for lanes in ["plain", "avx2", "auto"] {
            let model = if kind == "sheet" {
                model(kind, 0.02, &format!("precision = \"{precision}\"\nlanes = \"{lanes}\"\n"))
            } else {
                let sets = [&format!("stepping.precision={precision}"), &format!("stepping.lanes={lanes}")];
                let [precision, lanes] = sets.map(String::as_str);
                Model::gallbladder(&[precision, lanes, "cutting.anchor_depth_m=0.006"])
            };
            let extent = model.shape().extent();
            let (middle_m, size_m) = (extent.middle_m(), extent.size_m());
            // Beneath the wall on top of the organ, which it leaves and enters where that is curved; beneath the sheet.
            let height_m = if kind == "sheet" { -0.001 } else { extent.most_m.z - 0.004 };
            let tip = Tip { edge_m: size_m.x.min(size_m.y + 0.01) * DVec3::Y, ..lying() };
            let begin_m = extent.least_m.y - 0.001;
            let lead = |tissue: &mut dyn Tissue, steps: std::ops::Range<u32>| {
                for step in steps {
                    let x = middle_m.x + size_m.x * (f64::from(step) / 120.0 - 0.5);
                    tissue.pose(0, DVec3::new(x, begin_m, height_m), tip);
                    tissue.step().unwrap();
                }
            };
            let mut tissue = at_rest(&model);
            pull(&mut *tissue, 40);
            lead(&mut *tissue, 0..60);
            let half = tissue.cuts().anchor_count();
            let saved = tissue.save().plain();
            let mut again = restored(&model, &saved.parts, &saved.values, &Limits::default()).unwrap();
            assert_eq!(again.cuts().anchor_count(), half);
            lead(&mut *tissue, 60..120);
            lead(&mut *again, 60..120);
            let cuts = tissue.cuts();
            assert!(half > 20 && cuts.anchor_count() > half, "{kind}: {half}, {cuts:?}");
            assert_eq!(cuts.joint_count() > 0, kind == "organ", "{cuts:?}");
            assert_eq!((again.state_hash(), again.cuts().anchor_count()), (tissue.state_hash(), cuts.anchor_count()));
            hashes.push(tissue.state_hash());
        }
        assert!(hashes.windows(2).all(|pair| pair[0] == pair[1]), "{kind} {precision}: {hashes:x?}");
    }
}

#[test]
fn a_snapshot_with_an_anchor_that_its_tissue_lacks_is_refused() {
    for kind in ["sheet", "surface"] {
        let model = model(kind, 0.05, "");
        let mut tissue = at_rest(&model);
        sweep(&mut *tissue, [0.032, -0.002], 40, lying());
        let saved = tissue.save().plain();
        let refused = |change: &dyn Fn(&mut crate::saved::TissueParts)| {
            let mut parts = saved.parts.clone();
            change(&mut parts);
            restored(&model, &parts, &saved.values, &Limits::default()).is_err()
        };
        assert!(!refused(&|_| ()));
        assert!(refused(&|parts| parts.severed[0].place = u32::MAX - 1));
        assert!(refused(&|parts| parts.severed[1] = parts.severed[0]));
    }
}

#[test]
fn a_tissue_that_goes_back_to_before_a_cut_is_anchored_again() {
    for kind in ["sheet", "surface"] {
        let model = model(kind, 0.05, "precision = \"f64\"\n");
        let mut tissue = TissueState::<f64>::new(&model);
        // No check, which would take a later checkpoint, is due in the next steps.
        pull(&mut tissue, 49);
        tissue.take_checkpoint();
        let forces = |tissue: &TissueState<f64>| -> Vec<DVec3> {
            model.points().map(|point| tissue.point(point).reaction_n()).collect()
        };
        let (before, hash) = (forces(&tissue), tissue.state_hash());
        sweep(&mut tissue, [0.09, -0.002], 1, lying());
        assert_eq!(tissue.cuts().anchor_count(), POINTS);
        let version = tissue.cuts().version();
        tissue.go_back(0);
        assert_eq!((tissue.cuts().anchor_count(), tissue.cuts().len()), (0, 0));
        assert!(tissue.cuts().version() > version);
        assert_eq!((forces(&tissue), tissue.state_hash()), (before, hash));
    }
}

#[test]
fn an_anchor_burns_through_with_its_point() {
    for kind in ["sheet", "surface"] {
        let model = model(kind, 0.05, "");
        let tip = Tip { radius_m: 0.008, burn_s: 0.05, ..Tip::default() };
        let counts = |steps: u32| {
            let mut tissue = at_rest(&model);
            for _ in 0..steps {
                tissue.pose(0, DVec3::new(0.5 * SIDE_M, 0.5 * SIDE_M, -0.002), Tip { grasps: true, ..tip });
                tissue.step().unwrap();
            }
            tissue.cuts().anchor_count()
        };
        let burnt = counts(60);
        assert!(counts(49) == 0 && burnt > 4 && burnt < POINTS / 4, "{burnt}");
    }
}

#[test]
fn a_scene_names_what_is_wrong_with_its_anchors() {
    let refused = |text: &str| {
        let mesh = square_of_triangles([4, 4], 0.02);
        let refusal =
            Scene::parse_given("square", text, ("square.obj", mesh.as_bytes()), &Limits::default()).unwrap_err();
        (refusal.reason, refusal.field)
    };
    let depth = format!("anchor_depth_m = {DEPTH_M:?}");
    let damped = text("[damping]\ncoefficient_n_s_per_m = 0.05\n");
    for (found, put, reason, field) in [
        (depth.as_str(), "anchor_depth_m = 0.0", Reason::OutOfRange, "cutting.anchor_depth_m"),
        (depth.as_str(), "anchor_direction = [0, 0, 1]", Reason::Missing, "cutting.anchor_direction"),
        (
            "anchor_depth_m",
            "anchor_direction = [0, 0, 0]\nanchor_depth_m",
            Reason::OutOfRange,
            "cutting.anchor_direction",
        ),
    ] {
        assert_eq!(refused(&damped.replace(found, put)), (reason, field.to_owned()), "{put}");
    }
    let solid = crate::scene::BUILT_IN.iter().find(|(name, _)| *name == "liver-solid").unwrap().1;
    let solid = Scene::parse("solid", solid, &["cutting.anchor_depth_m=0.004".to_owned()], &Limits::default());
    assert_eq!(solid.unwrap_err().reason, Reason::WrongKind);
}
