//! Tests of presses beside and over cuts: a law is that of the tissue as it is cut.
#![allow(clippy::unwrap_used)]

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use glam::DVec3;

use crate::compile::square_of_triangles;
use crate::interface::Tissue;
use crate::limits::Limits;
use crate::response::force_law::{self, Disc};
use crate::scene::Scene;
use crate::{Cuts, Model, at_rest};
use palpate_haptics::{Tip, TipShape};

fn sheet(pretension_n_per_m: f64, anchor_n_per_m: f64) -> Arc<Model> {
    let text = format!(
        "[sheet]\npoints = [32, 31]\nspacing_m = 0.004\npoint_mass_kg = 1e-3\nfixed = \"edges\"\n[springs]\n\
         stiffness_n_per_m = 60\nshear_stiffness_n_per_m = 30\npretension_n_per_m = {pretension_n_per_m:?}\n[anchor_springs]\n\
         stiffness_n_per_m = {anchor_n_per_m:?}\n[damping]\ncoefficient_n_s_per_m = 0.05\n[stepping]\nprecision = \"f64\"\n[sleep]\ntolerance = 0\n"
    );
    Model::parse("sheet", &text, &[]).unwrap()
}

/// Returns a flat surface of triangles, of 24 × 24 cells of 5 mm.
fn surface() -> Arc<Model> {
    let text = "[mesh]\nfile = \"flat.obj\"\nunit = \"m\"\npoint_mass_kg = 1e-3\n[springs]\nstiffness_n_per_m = 40\nbending = 0\n\
                [anchor_springs]\nstiffness_n_per_m = 4\n[damping]\ncoefficient_n_s_per_m = 0.1\n\
                [stepping]\nprecision = \"f64\"\n[sleep]\ntolerance = 0\n";
    let mesh = square_of_triangles([24, 24], 0.005);
    let scene = Scene::parse_given("flat", text, ("flat.obj", mesh.as_bytes()), &Limits::default()).unwrap();
    Model::compile(&scene, &Limits::default()).unwrap()
}

fn solid() -> Arc<Model> {
    let text = "[solid]\norgan = { name = \"phantom\", edge_m = 0.008, seed = 1 }\ncell_m = 0.01\n\
                fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1], within_m = 0.001 }]\n\
                [material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.45\ndensity_kg_per_m3 = 980\n\
                damping_per_s = 60\n[stepping]\nprecision = \"f64\"\nsubsteps = 4\n[sleep]\ntolerance = 0\n";
    Model::parse("solid", text, &[]).unwrap()
}

/// A tissue, the place on its top over whose middle a slit along y leads, and its half length, m; radius of a disc, and depth, m.
struct SlitPress {
    kind: &'static str,
    model: Arc<Model>,
    top_m: DVec3,
    half_m: f64,
    radius_m: f64,
    depth_m: f64,
}

/// Slits over which a disc presses: each is between two rows of points or cells, so that both sides move alike.
fn presses() -> Vec<SlitPress> {
    let solid = solid();
    let of_sheet = |kind, tension| SlitPress {
        kind,
        model: sheet(tension, 4.0),
        top_m: DVec3::new(0.062, 0.06, 0.0),
        half_m: 0.0301,
        radius_m: 0.006,
        depth_m: 0.005,
    };
    let top_m = |model: &Model| {
        let extent = model.shape().extent();
        extent.middle_m().with_z(extent.most_m.z)
    };
    vec![
        of_sheet("sheet", 0.0),
        of_sheet("tense sheet", 1.0),
        SlitPress {
            kind: "surface",
            model: surface(),
            top_m: DVec3::new(0.0625, 0.06, 0.0),
            half_m: 0.031,
            radius_m: 0.007,
            depth_m: 0.005,
        },
        SlitPress { kind: "solid", top_m: top_m(&solid), half_m: 0.035, radius_m: 0.01, depth_m: 3e-4, model: solid },
    ]
}

/// Severs the slit, with a blade that stands upright.
fn cut(tissue: &mut dyn Tissue, press: &SlitPress) {
    let tip = Tip { shape: TipShape::Blade, radius_m: 0.001, edge_m: 0.05 * DVec3::Z, ..Tip::default() };
    for step in 0..=100 {
        let along_m = press.half_m * (f64::from(step) / 50.0 - 1.0);
        tissue.pose(0, press.top_m + DVec3::new(2e-4, along_m, -0.023), tip);
        tissue.step().unwrap();
    }
    tissue.release(0);
}

/// Presses and waits until the tissue rests. Returns the force on the tool, outward, N.
fn pressed_n(tissue: &mut dyn Tissue, press: &SlitPress) -> f64 {
    let tip = Tip { radius_m: press.radius_m, friction: 1.0, ..Tip::default() };
    for step in 0..4000 {
        let down_m = press.depth_m * (f64::from(step) / 500.0).min(1.0);
        tissue.pose(1, press.top_m - down_m * DVec3::Z, tip);
        tissue.step().unwrap();
    }
    tissue.tool_contact(1).unwrap().force_on_tool_n.z
}

#[test]
fn a_law_over_a_slit_is_the_force_of_a_press_at_rest_in_the_cut_tissue() {
    for press in presses() {
        let mut tissue = at_rest(&press.model);
        cut(&mut *tissue, &press);
        let (cuts, never) = (tissue.cuts(), AtomicBool::new(false));
        let disc = Disc { radius_m: press.radius_m, at_m: press.top_m };
        assert!(disc.notices(&press.model, &cuts), "{}", press.kind);
        let law_n = |cuts: &Cuts| {
            let law = force_law::exact_within(&press.model, cuts, disc, u64::MAX, &never).unwrap();
            assert!(law.is_sound());
            law.at_depth(press.depth_m).force_n
        };
        // Without a coarse one, callers wait for the exact one.
        let coarse = force_law::first(&press.model, &cuts, disc, &never);
        let [of_cut_n, of_whole_n] = [&cuts, &Cuts::default()].map(law_n);
        let coarse_n = coarse.map_or(of_cut_n, |coarse| coarse.at_depth(press.depth_m).force_n);
        let truth_n = pressed_n(&mut *tissue, &press);
        let [error, coarse_error, change] =
            [of_cut_n, coarse_n, of_whole_n].map(|force_n| (force_n / truth_n - 1.0).abs());
        println!(
            "{}: {} springs severed, {truth_n:.4} N; the law is off by {error:.1e}, a first one by {coarse_error:.1e}, that of the \
             whole tissue by {change:.2}",
            press.kind,
            cuts.len()
        );
        assert!(error < 0.02 && coarse_error < 0.06 && change > 0.08, "{}", press.kind);
        // At the present state the tangent is that of the cut tissue too.
        let tangent = tissue.tangent_input(1).unwrap().tangent();
        let slope_n_per_m = {
            let law = force_law::exact_within(&press.model, &cuts, disc, u64::MAX, &never).unwrap();
            law.at_depth(press.depth_m).stiffness_n_per_m
        };
        let off = (tangent.stiffness_n_per_m.z_axis.z / slope_n_per_m - 1.0).abs();
        assert!(off < 0.05, "{}: {} and {slope_n_per_m} N/m", press.kind, tangent.stiffness_n_per_m.z_axis.z);
    }
}

#[test]
fn a_disc_far_from_all_cuts_keeps_the_law_of_the_whole_tissue() {
    // A press is felt 8 mm away.
    let press = &SlitPress { model: sheet(0.0, 15.0), ..presses().remove(0) };
    let mut tissue = at_rest(&press.model);
    cut(&mut *tissue, press);
    let (model, cuts) = (&press.model, tissue.cuts());
    let beside_m = |x_m: f64| press.top_m + x_m * DVec3::X;
    let disc = Disc { radius_m: press.radius_m, at_m: press.top_m };
    // It stays at its place while the tool moves a little, and goes with it near the cut.
    let (there, notices) = disc.follow_cut(model, &cuts, beside_m(0.001));
    assert_eq!((there, notices), (disc, true));
    let (there, notices) = disc.follow_cut(model, &cuts, beside_m(0.005));
    assert_eq!((there.at_m, notices), (beside_m(0.005), true));
    let far = disc.follow(model, beside_m(0.055));
    let (there, notices) = disc.follow_cut(model, &cuts, beside_m(0.055));
    assert_eq!((there, notices), (far, false));
    // A whole tissue has no cuts to notice.
    assert_eq!(disc.follow_cut(model, &Cuts::default(), press.top_m), (disc.follow(model, press.top_m), false));
    let never = AtomicBool::new(false);
    let law = |cuts: &Cuts, at_m: DVec3| {
        force_law::exact_within(model, cuts, Disc { at_m, ..disc }, u64::MAX, &never).unwrap()
    };
    let [cut_n, whole_n] = [&cuts, &Cuts::default()].map(|cuts| law(cuts, beside_m(0.055)).at_depth(0.004).force_n);
    assert!((cut_n / whole_n - 1.0).abs() < 0.01, "{cut_n} {whole_n} N");
}
