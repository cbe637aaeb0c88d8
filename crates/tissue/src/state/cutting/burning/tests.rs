//! Tests of cautery: that it severs at the stated time of contact, no earlier, and what lies under the tip alone.
#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use glam::DVec3;

use crate::interface::Tissue;
use crate::limits::Limits;
use crate::scene::action_check::check_tip;
use crate::shape::PointId;
use crate::{Burns, Model, at_rest, restored};
use palpate_haptics::{ContactState, Tip, TipShape};
use palpate_refusal::Reason;

/// Steps of a millisecond after which the tips of these tests sever.
const BURN_STEPS: u32 = 50;

fn burning(radius_m: f64) -> Tip {
    Tip { radius_m, burn_s: 1e-3 * f64::from(BURN_STEPS), ..Tip::default() }
}

/// A gallbladder, a block of 100 × 100 × 40 mm on a table, of cubes of 5 mm, or a sheet of 150 × 130 mm on a soft ground, which settles within
/// some steps.
fn model(kind: &str, sets: &[&str]) -> Arc<Model> {
    match kind {
        "surface" => Model::gallbladder(sets),
        "solid" => Model::parse("block", BLOCK, sets).unwrap(),
        _ => Model::parse("sheet", SHEET, sets).unwrap(),
    }
}

/// The kinds of tissue.
const KINDS: [&str; 3] = ["sheet", "surface", "solid"];

const BLOCK: &str = "[solid]\norgan = { name = \"phantom\", edge_m = 0.008, seed = 1 }\ncell_m = 0.005\n\
                     fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1], within_m = 0.001 }]\n\
                     [material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.45\ndensity_kg_per_m3 = 980\n\
                     damping_per_s = 60\n[stepping]\nsubsteps = 8\n";

const SHEET: &str = "[sheet]\npoints = [31, 27]\nspacing_m = 0.005\npoint_mass_kg = 1e-4\n\
                     [springs]\nstiffness_n_per_m = 100\nbending = true\n[anchor_springs]\nstiffness_n_per_m = 5\n\
                     [damping]\ncoefficient_n_s_per_m = 0.05\n";

/// A place on the surface at rest and the direction out of it.
fn on_top(model: &Model) -> (DVec3, DVec3) {
    let (shape, extent) = (model.shape(), model.shape().extent());
    let point = shape.nearest(DVec3::new(extent.middle_m().x, extent.middle_m().y, extent.most_m.z));
    (shape.rest_m(point), shape.normal(point))
}

/// Does steps with a tip by `depth_m` within the surface at rest. Returns for how many of them it touched.
fn press(tissue: &mut dyn Tissue, depth_m: f64, tip: Tip, steps: u32) -> u32 {
    let (place_m, normal) = on_top(&tissue.model().clone());
    let mut touched = 0;
    for _ in 0..steps {
        tissue.pose(0, place_m - depth_m * normal, tip);
        tissue.step().unwrap();
        touched += u32::from(tissue.tool_contact(0).unwrap().contact_state != ContactState::Free);
    }
    touched
}

/// Presses until a tip has touched in this many steps more, which need not follow each other: one that comes at once may bounce.
fn touch(tissue: &mut dyn Tissue, tip: Tip, steps: u32) {
    let mut touched = 0;
    for _ in 0..10 * steps {
        if touched < steps {
            touched += press(tissue, 0.002, tip, 1);
        }
    }
    assert_eq!(touched, steps);
}

#[test]
fn a_tip_severs_what_lies_under_it_at_the_stated_time_of_contact_to_a_step() {
    for kind in KINDS {
        for grasps in [false, true] {
            let model = model(kind, &["stepping.precision=f64"]);
            let mut tissue = at_rest(&model);
            let tip = Tip { grasps, ..burning(0.006) };
            touch(&mut *tissue, tip, BURN_STEPS - 1);
            assert!(tissue.cuts().is_empty(), "{kind}: too early");
            let before_n = tissue.tool_contact(0).unwrap().force_on_tool_n.length();
            touch(&mut *tissue, tip, 1);
            let severed = tissue.cuts().len();
            assert!(severed > 5 && tissue.cuts().version() == 1, "{kind}: {severed}");
            let (place_m, _) = on_top(&model);
            // As far as its disc reaches, which covers all corners of what it lies on; springs against bending join points over two edges.
            let most_m = 0.006 + 4.0 * model.shape().edge_m();
            for spring in tissue.cuts().joints(&model) {
                for point in spring.points {
                    let far_m = model.shape().rest_m(point).distance(place_m);
                    assert!(far_m < most_m, "{kind}: a spring {far_m} m beside the tip");
                }
            }
            // The tip stays: it severs nothing else, and feels less. One that holds the tissue where it found it feels nothing.
            press(&mut *tissue, 0.002, tip, 300);
            assert_eq!((tissue.cuts().len(), tissue.guard_events()), (severed, 0), "{kind}");
            let after_n = tissue.tool_contact(0).unwrap().force_on_tool_n.length();
            // The gallbladder's anchors bear most of it.
            let most_n = if kind == "sheet" { 0.7 * before_n } else { 0.99 * before_n };
            assert!(grasps || after_n < most_n, "{kind}: {before_n} N, then {after_n} N");
        }
    }
}

#[test]
fn a_tip_that_leaves_in_time_severs_nothing_and_times_of_contact_add_up() {
    for kind in KINDS {
        let model = model(kind, &["stepping.precision=f64"]);
        let mut tissue = at_rest(&model);
        let tip = burning(0.006);
        touch(&mut *tissue, tip, BURN_STEPS - 1);
        tissue.release(0);
        (0..200).for_each(|_| tissue.step().unwrap());
        assert_eq!(press(&mut *tissue, -0.02, tip, 100), 0, "{kind}");
        // One that does not burn adds nothing.
        press(&mut *tissue, 0.002, Tip { burn_s: 0.0, ..tip }, 100);
        assert!(tissue.cuts().is_empty(), "{kind}");
        touch(&mut *tissue, tip, 1);
        assert!(!tissue.cuts().is_empty(), "{kind}");
    }
}

#[test]
fn a_point_under_two_tips_burns_once_and_the_quicker_one_severs() {
    let model = model("sheet", &["stepping.precision=f64"]);
    let mut tissue = at_rest(&model);
    let (place_m, _) = on_top(&model);
    let slow = Tip { grasps: true, ..burning(0.006) };
    let quick = Tip { burn_s: 0.5 * slow.burn_s, ..slow };
    for step in 1..=BURN_STEPS / 2 {
        assert!(tissue.cuts().is_empty(), "at step {step}");
        for (tool, tip) in [slow, quick].into_iter().enumerate() {
            tissue.pose(tool, place_m - 0.002 * DVec3::Z, tip);
        }
        tissue.step().unwrap();
    }
    assert!(!tissue.cuts().is_empty());
}

#[test]
fn a_tip_that_is_drawn_across_a_sheet_leaves_two_pieces() {
    let model = Model::paper(&["sheet.points=[21, 9]", "sheet.spacing_m=0.005", "stepping.precision=f64"]);
    let mut tissue = at_rest(&model);
    let tip = Tip { friction: 0.0, ..burning(0.006) };
    for step in 0..1000 {
        let y = 0.04 * f64::from(step) / 999.0;
        tissue.pose(0, DVec3::new(0.05, y, -0.001), tip);
        tissue.step().unwrap();
    }
    tissue.release(0);
    (0..100).for_each(|_| tissue.step().unwrap());
    // Each side is a piece, and what burnt between them is loose points.
    let severed = tissue.cuts().joints(&model);
    let is_across = |x: f64| severed.iter().any(|spring| spring.points.iter().all(|of| near(&model, *of, x)));
    assert!(tissue.cuts().pieces(&model) >= 2 && tissue.guard_events() == 0, "{:?}", tissue.guard_events());
    assert!(!is_across(0.02) && !is_across(0.08), "burnt beside the tip");
}

fn near(model: &Model, point: PointId, x: f64) -> bool {
    (model.shape().rest_m(point).x - x).abs() < 0.01
}

#[test]
fn a_burn_has_the_same_bits_at_every_width_and_continues_from_a_snapshot() {
    for kind in KINDS {
        for precision in ["f32", "f64"] {
            let mut hashes = Vec::new();
            for lanes in ["plain", "auto"] {
                let sets = [format!("stepping.precision={precision}"), format!("stepping.lanes={lanes}")];
                let model = model(kind, &sets.each_ref().map(String::as_str));
                let mut tissue = at_rest(&model);
                let tip = burning(0.006);
                press(&mut *tissue, 0.002, tip, BURN_STEPS / 2);
                let saved = tissue.save().plain();
                let mut again = restored(&model, &saved.parts, &saved.values, &Limits::default()).unwrap();
                assert_eq!(again.save().plain(), saved, "{kind}");
                for tissue in [&mut tissue, &mut again] {
                    press(&mut **tissue, 0.002, tip, BURN_STEPS / 2 - 1);
                    assert!(tissue.cuts().is_empty(), "{kind}");
                    press(&mut **tissue, 0.002, tip, 30);
                    assert!(!tissue.cuts().is_empty(), "{kind}");
                }
                assert_eq!(again.state_hash(), tissue.state_hash(), "{kind} {precision} {lanes}");
                assert_eq!(tissue.copy().point(model.point_at(0)), tissue.point(model.point_at(0)));
                hashes.push(tissue.state_hash());
            }
            assert_eq!(hashes[0], hashes[1], "{kind} {precision}");
        }
    }
}

#[test]
fn what_is_burnt_is_kept_by_the_state_that_the_guard_goes_back_to_and_by_a_recovery() {
    let model = model("sheet", &["stepping.precision=f64"]);
    let tip = Tip { grasps: true, ..burning(0.006) };
    let mut tissue = crate::state::tissue_state::TissueState::<f64>::new(&model);
    press(&mut tissue, 0.002, tip, 30);
    let burnt = tissue.contacts.burns.saved();
    tissue.take_checkpoint();
    press(&mut tissue, 0.002, tip, 10);
    assert_ne!(tissue.contacts.burns.saved(), burnt);
    tissue.go_back(0);
    assert_eq!(tissue.contacts.burns.saved(), burnt);
    for at_rest in [false, true] {
        let step = tissue.steps;
        tissue.recover(step, at_rest);
        assert_eq!(tissue.contacts.burns.saved(), burnt, "{at_rest}");
    }
    assert!(tissue.contacts.tools.is_empty());
    press(&mut tissue, 0.002, tip, BURN_STEPS - 31);
    assert!(tissue.cuts().is_empty());
    press(&mut tissue, 0.002, tip, 1);
    assert!(!tissue.cuts().is_empty());
}

#[test]
fn the_burn_of_a_point_is_its_time_of_contact_as_a_part_of_that_of_the_quickest_tip() {
    for kind in KINDS {
        let model = model(kind, &["stepping.precision=f64"]);
        let mut tissue = at_rest(&model);
        let most = |tissue: &dyn Tissue| tissue.burns().points(&model).map(|burnt| burnt.burn).fold(0.0, f64::max);
        assert!(tissue.burns().is_empty() && tissue.burns().version() == 0 && tissue.burns().continues(0));
        let tip = burning(0.006);
        for steps in 1..=BURN_STEPS {
            touch(&mut *tissue, tip, 1);
            let burn = f64::from(steps) / f64::from(BURN_STEPS);
            assert!((most(&*tissue) - burn).abs() < 1e-12 && (steps < BURN_STEPS || most(&*tissue) == 1.0), "{kind}");
            // Each step is more than 1/255, so that a viewer is told.
            assert_eq!(tissue.burns().version(), steps, "{kind}");
        }
        // It has burnt through: nothing more is seen.
        touch(&mut *tissue, tip, 5);
        assert_eq!((most(&*tissue), tissue.burns().version()), (1.0, BURN_STEPS), "{kind}");
        // Two thirds of a slower tip's time are all of a quicker one's.
        let mut tissue = at_rest(&model);
        touch(&mut *tissue, Tip { burn_s: 1.5 * tip.burn_s, ..tip }, BURN_STEPS - 1);
        assert!((most(&*tissue) - 2.0 / 3.0 * (1.0 - 1.0 / f64::from(BURN_STEPS))).abs() < 1e-12, "{kind}");
        touch(&mut *tissue, tip, 1);
        assert_eq!(most(&*tissue), 1.0, "{kind}");
    }
}

#[test]
fn a_slow_burn_has_no_more_versions_than_a_viewer_has_levels() {
    let model = model("sheet", &["stepping.precision=f64"]);
    let mut tissue = at_rest(&model);
    let slow = Tip { grasps: true, burn_s: 1.0, ..burning(0.006) };
    press(&mut *tissue, 0.002, slow, 1000);
    let burns = tissue.burns();
    assert!(burns.points(&model).all(|burnt| burnt.burn == 1.0 && burnt.version == burns.version()));
    assert_eq!(burns.version(), 255);
}

#[test]
fn the_guard_undoes_a_burn_in_a_new_version_that_does_not_continue() {
    let model = model("sheet", &["stepping.precision=f64"]);
    let tip = Tip { grasps: true, ..burning(0.006) };
    let mut tissue = crate::state::tissue_state::TissueState::<f64>::new(&model);
    press(&mut tissue, 0.002, tip, 10);
    tissue.take_checkpoint();
    let at_checkpoint = tissue.burns();
    press(&mut tissue, 0.002, tip, 10);
    let later = tissue.burns();
    assert!(later.continues(at_checkpoint.version()));
    tissue.go_back(0);
    let back = tissue.burns();
    assert!(back.version() > later.version());
    assert!(!back.continues(later.version()) && !back.continues(at_checkpoint.version()));
    let burn = |burns: &Burns| burns.points(&model).map(|burnt| (burnt.point, burnt.burn)).collect::<Vec<_>>();
    assert_eq!(burn(&back), burn(&at_checkpoint));
    // Where nothing was burnt since, nothing is undone.
    tissue.go_back(0);
    assert_eq!(tissue.burns(), back);
}

#[test]
fn a_restored_tissue_has_the_burns_in_their_version_and_those_of_an_earlier_format_are_unknown() {
    let model = model("surface", &["stepping.precision=f64"]);
    let mut tissue = at_rest(&model);
    let tip = burning(0.006);
    press(&mut *tissue, 0.002, tip, 20);
    let (saved, burns) = (tissue.save().plain(), tissue.burns());
    let again = restored(&model, &saved.parts, &saved.values, &Limits::default()).unwrap();
    let burn = |burns: &Burns| burns.points(&model).map(|burnt| (burnt.point, burnt.burn)).collect::<Vec<_>>();
    assert_eq!((burn(&again.burns()), again.burns().version()), (burn(&burns), burns.version()));
    // A viewer that knows an earlier version gets all: which points are new is not saved.
    assert!(again.burns().continues(burns.version()) && !again.burns().continues(burns.version() - 1));
    let mut parts = saved.parts.clone();
    parts.burn_times = Default::default();
    let mut old = restored(&model, &parts, &saved.values, &Limits::default()).unwrap();
    assert!(old.burns().points(&model).all(|burnt| burnt.burn == 0.0) && !old.burns().is_empty());
    // It goes on with the same times of contact.
    press(&mut *old, 0.002, tip, 1);
    press(&mut *tissue, 0.002, tip, 1);
    assert_eq!(burn(&old.burns()), burn(&tissue.burns()));
    for broken in [vec![0.5], vec![-1.0; burns.points(&model).count()], vec![f64::NAN; burns.points(&model).count()]] {
        parts.burn_times.now_s = broken;
        assert!(restored(&model, &parts, &saved.values, &Limits::default()).is_err());
    }
}

#[test]
fn a_tissue_moves_alike_under_a_tip_that_burns_until_that_severs_and_only_a_burn_is_state() {
    for kind in KINDS {
        let model = model(kind, &["stepping.precision=f32"]);
        let done = |depth_m: f64, burn_s: f64| {
            let mut tissue = at_rest(&model);
            press(&mut *tissue, depth_m, Tip { burn_s, ..burning(0.006) }, 80);
            let moved: Vec<_> = model.points().map(|point| tissue.point(point).displacement_m).collect();
            (moved, tissue.state_hash())
        };
        let [cold, hot] = [0.0, 0.5].map(|burn_s| done(0.002, burn_s));
        assert!(cold.0 == hot.0 && cold.1 != hot.1, "{kind}");
        assert_eq!(done(-0.02, 0.0), done(-0.02, 0.5), "{kind}: it touches nothing");
    }
}

#[test]
fn tips_that_cannot_burn_are_refused() {
    let sheet = model("sheet", &[]);
    let refused = |tip: Tip| check_tip("tip", sheet.shape(), &tip).unwrap_err();
    for burn_s in [-1e-9, f64::NAN, f64::INFINITY, 3601.0] {
        let refusal = refused(Tip { burn_s, ..Tip::default() });
        let reason = if burn_s.is_finite() { Reason::OutOfRange } else { Reason::NotFinite };
        assert_eq!((&*refusal.field, refusal.reason), ("tip.burn_s", reason), "{burn_s}");
    }
    let blade = Tip { shape: TipShape::Blade, edge_m: 0.02 * DVec3::Z, burn_s: 0.5, ..Tip::default() };
    assert_eq!((&*refused(blade).field, refused(blade).reason), ("tip.burn_s", Reason::WrongKind));
    let sphere = Tip { shape: TipShape::Sphere, ..burning(0.005) };
    assert_eq!(&*refused(sphere).field, "tip.shape");
    // On a solid other tips touch, and burn.
    let (solid, edge_m) = (model("solid", &[]), 0.02 * DVec3::Z);
    for shape in [TipShape::Disc, TipShape::RigidDisc, TipShape::Sphere, TipShape::Blade] {
        let tip = Tip { shape, ..burning(0.005) };
        let tip = if shape == TipShape::Blade { Tip { edge_m, ..tip } } else { tip };
        let refusal = check_tip("tip", solid.shape(), &tip).err().map(|refusal| (refusal.field, refusal.reason));
        let expected = (shape == TipShape::Blade).then(|| ("tip.burn_s".into(), Reason::WrongKind));
        assert_eq!(refusal, expected, "{shape:?}");
    }
}

mod solid;
mod stiffness;
