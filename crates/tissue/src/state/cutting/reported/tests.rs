//! Tests of reported cuts: a tissue that severs what another reports feels like that one.
#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use glam::DVec3;

use crate::compile::square_of_triangles;
use crate::interface::Tissue;
use crate::limits::Limits;
use crate::scene::Scene;
use crate::{Model, at_rest};
use palpate_haptics::{ReportedSpring, Tip, TipShape};
use palpate_refusal::Reason;

/// Returns a flat surface of triangles, of 24 × 24 cells of 5 mm.
fn surface() -> Arc<Model> {
    let text = "[mesh]\nfile = \"flat.obj\"\nunit = \"m\"\npoint_mass_kg = 1e-3\n[springs]\nstiffness_n_per_m = 40\nbending = 0\n\
                [anchor_springs]\nstiffness_n_per_m = 4\n[damping]\ncoefficient_n_s_per_m = 0.1\n\
                [stepping]\nprecision = \"f64\"\n[sleep]\ntolerance = 0\n";
    let mesh = square_of_triangles([24, 24], 0.005);
    let scene = Scene::parse_given("flat", text, ("flat.obj", mesh.as_bytes()), &Limits::default()).unwrap();
    Model::compile(&scene, &Limits::default()).unwrap()
}

/// A sheet under a pretension whose anchor springs a blade severs, a surface, and a solid.
fn models() -> [(&'static str, Arc<Model>); 3] {
    let sheet = "[sheet]\npoints = [31, 31]\nspacing_m = 0.004\npoint_mass_kg = 1e-3\n[springs]\nstiffness_n_per_m = 60\npretension_n_per_m = 2\n\
                 [anchor_springs]\nstiffness_n_per_m = 1\n[cutting]\nanchor_depth_m = 0.01\n[damping]\n\
                 coefficient_n_s_per_m = 0.02\n[stepping]\nprecision = \"f64\"\n[sleep]\ntolerance = 0\n";
    let solid = "[solid]\norgan = { name = \"phantom\", edge_m = 0.008, seed = 1 }\ncell_m = 0.01\n\
                 fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1], within_m = 0.001 }]\n\
                 [material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.45\ndensity_kg_per_m3 = 980\n\
                 damping_per_s = 60\n[stepping]\nprecision = \"f64\"\nsubsteps = 4\n[sleep]\ntolerance = 0\n";
    [
        ("sheet", Model::parse("sheet", sheet, &[]).unwrap()),
        ("surface", surface()),
        ("solid", Model::parse("solid", solid, &[]).unwrap()),
    ]
}

/// Leads a leaning blade through the middle of the top, along y.
fn cut(tissue: &mut dyn Tissue, steps: u32) {
    let extent = tissue.model().shape().extent();
    let (middle_m, size_m, top_m) = (extent.middle_m(), extent.size_m(), extent.most_m.z);
    let edge_m = DVec3::new(0.02, 0.0, 0.04);
    let tip = Tip { shape: TipShape::Blade, radius_m: 0.001, edge_m, ..Tip::default() };
    for step in 0..=steps {
        let y = middle_m.y + size_m.y * (-0.3 + 0.6 * f64::from(step) / f64::from(steps));
        tissue.pose(0, DVec3::new(middle_m.x + 0.0013, y, top_m - 0.012), tip);
        tissue.step().unwrap();
    }
    tissue.release(0);
}

/// Returns the force on a tip after a press beside the wound, N.
fn pressed_n(tissue: &mut dyn Tissue, steps: u32) -> DVec3 {
    let extent = tissue.model().shape().extent();
    let place_m = extent.middle_m().with_z(extent.most_m.z) + DVec3::new(0.004, 0.001, 0.001);
    let tip = Tip { radius_m: 0.005, friction: 0.3, ..Tip::default() };
    for step in 0..steps {
        let depth_m = 0.004 * (f64::from(step) / 200.0).min(1.0);
        tissue.pose(1, place_m - depth_m * DVec3::Z, tip);
        tissue.step().unwrap();
    }
    tissue.tool_contact(1).unwrap().force_on_tool_n
}

fn names(tissue: &dyn Tissue) -> Vec<(u32, u32)> {
    let mut names: Vec<_> = tissue.cuts().reported(0).map(|(spring, _)| spring.name()).collect();
    names.sort_unstable();
    names
}

fn reported(tissue: &dyn Tissue) -> Vec<ReportedSpring> {
    tissue.cuts().reported(0).map(|(spring, _)| spring).collect()
}

#[test]
fn a_tissue_that_severs_what_another_reports_feels_like_it() {
    for (kind, model) in models() {
        let mut tissue = at_rest(&model);
        cut(&mut *tissue, 150);
        let (all, pieces) = (reported(&*tissue), tissue.cuts().pieces(&model));
        // In two reports, in either order, and each part more than once.
        let mut copies = [at_rest(&model), at_rest(&model)];
        let (first, later) = all.split_at(all.len() / 3);
        copies[0].sever(first).unwrap();
        copies[0].step().unwrap();
        copies[0].sever(&all).unwrap();
        copies[1].sever(later).unwrap();
        copies[1].sever(first).unwrap();
        let version = copies[1].cuts().version();
        copies[1].sever(&all).unwrap();
        assert_eq!((copies[1].cuts().version(), version), (2, 2), "{kind}");
        for copy in &copies {
            assert_eq!(names(&**copy), names(&*tissue), "{kind}");
            assert_eq!(copy.cuts().pieces(&model), pieces);
        }
        let steps = 3000;
        let truth_n = pressed_n(&mut *tissue, steps);
        let whole_n = pressed_n(&mut *at_rest(&model), steps);
        let [first_n, second_n] = copies.each_mut().map(|copy| pressed_n(&mut **copy, steps));
        let far = |force_n: DVec3| force_n.distance(truth_n) / truth_n.length();
        println!(
            "{kind}: {} springs, {} anchors; {truth_n} N, copies off by {:.1e} and {:.1e}, a whole one by {:.2}",
            all.len(),
            tissue.cuts().anchor_count(),
            far(first_n),
            far(second_n),
            far(whole_n)
        );
        assert!(far(first_n) < 2e-3 && far(second_n) < 2e-3 && far(whole_n) > 0.05, "{kind}");
        assert_eq!(copies.map(|copy| copy.guard_events()), [0, 0], "{kind}");
    }
}

#[test]
fn springs_that_the_tissue_lacks_are_refused_with_all_others() {
    for (kind, model) in models() {
        let mut tissue = at_rest(&model);
        cut(&mut *tissue, 30);
        let sound = reported(&*tissue)[0];
        let mut copy = at_rest(&model);
        for bad in [
            ReportedSpring { place: u32::MAX, ..sound },
            ReportedSpring { number: 1000, ..sound },
            ReportedSpring { part: f64::NAN, ..sound },
            ReportedSpring { part: 1.5, ..sound },
            // Seen from its other end, or an anchor spring of a tissue whose anchors can't be severed.
            ReportedSpring { number: if kind == "sheet" { 1 } else { u32::MAX }, place: 0, ..sound },
        ] {
            let refused = copy.sever(&[sound, bad]).unwrap_err();
            assert_eq!(refused.reason, Reason::OutOfRange, "{kind}: {bad:?}");
            assert!(copy.cuts().is_empty() && copy.cuts().version() == 0, "{kind}: {bad:?}");
        }
        copy.sever(&[sound]).unwrap();
        assert_eq!(copy.cuts().len(), 1);
    }
}

/// No input of a tool repeats a reported cut, so going back, or a recovery, must not undo it.
#[test]
fn the_guard_keeps_a_reported_cut() {
    for (kind, model) in models() {
        let mut other = at_rest(&model);
        cut(&mut *other, 60);
        let all = reported(&*other);
        let mut tissue = crate::state::tissue_state::TissueState::<f64>::new(&model);
        pressed_n(&mut tissue, 100);
        tissue.take_checkpoint();
        tissue.sever_reported(&all).unwrap();
        let severed = names(&tissue);
        pressed_n(&mut tissue, 20);
        tissue.go_back(0);
        assert!(names(&tissue) == severed && !severed.is_empty(), "{kind}");
        let displaced_m = tissue.largest_displacement_m();
        assert!(displaced_m > 1e-5, "{kind}: the press of before is kept: {displaced_m} m");
        tissue.recover(120, false);
        assert_eq!(names(&tissue), severed, "{kind}");
    }
}
