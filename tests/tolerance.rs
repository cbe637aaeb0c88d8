//! Schemes chosen for a scene's tolerance keep it, also on random scenes. `make bench-tolerance` tries a thousand; of
//! random meshes there are 4 here, and more by `PALPATE_TOLERANCE_MESHES`; of solids 3, `PALPATE_TOLERANCE_SOLIDS`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use crate::common::cases;
use crate::common::random_scenes;
use crate::common::random_scenes::{
    PointHistory, RandomScene, case, errors, mesh_case, play, solid_case, truth, truth_within,
};
use palpate_refusal::Reason;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::{Named, PAPER, Precision, Scene};
use palpate_tissue::scheme::Oscillator;
use palpate_tissue::scheme::stability;
use palpate_tissue::select::scheme_selection;

/// With the scheme that is chosen for each.
fn keeps_every_tolerance(case: &RandomScene) {
    let broken = broken(case, &truth(case).unwrap().course, &[1e-2, 1e-3, 1e-4, 1e-5, 1e-6]);
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

/// Returns which of these tolerances a case does not keep with the scheme that is chosen for each.
fn broken(case: &RandomScene, truth: &PointHistory, tolerances: &[f64]) -> Vec<String> {
    let mut broken = Vec::new();
    for tolerance in tolerances.iter().copied() {
        let played = match play(case, &[format!("stepping.tolerance={tolerance:e}")], &|| 0.0) {
            Ok(played) => played,
            Err(reason) => {
                broken.push(format!("{}, asked for {tolerance:.0e}: {reason}", case.about));
                continue;
            }
        };
        let [displacement, force] = errors(truth, &played.course);
        let model = &played.model;
        let told = format!(
            "{}: displacement {displacement:.1e}, force {force:.1e}, expected {:.1e}, with {} × {} {}, asked for {tolerance:.0e}",
            case.about,
            model.expected_error,
            model.plan.integrator.name(),
            model.plan.substeps,
            model.precision.name()
        );
        println!("{:.2} {told}", displacement.max(force) / tolerance);
        if displacement.max(force) > tolerance {
            broken.push(told);
        }
    }
    broken
}

#[test]
fn every_tolerance_is_kept_on_random_scenes() {
    (0..16).for_each(|seed| keeps_every_tolerance(&case(seed)));
}

#[test]
fn every_tolerance_is_kept_on_random_meshes() {
    let meshes = cases::count("PALPATE_TOLERANCE_MESHES", 4, 40);
    (0..meshes).for_each(|seed| keeps_every_tolerance(&mesh_case(seed)));
}

/// The truth is that of a tolerance of 1e-6. For 300 solids: `PALPATE_TOLERANCE_SOLIDS=300`, from `PALPATE_TOLERANCE_SOLIDS_FROM` on.
#[test]
fn the_usual_tolerances_are_kept_on_random_solids() {
    let from = cases::count("PALPATE_TOLERANCE_SOLIDS_FROM", 0, 0);
    let solids = cases::count("PALPATE_TOLERANCE_SOLIDS", 3, 40);
    let broken: Vec<String> = (from..from + solids)
        .map(solid_case)
        .flat_map(|case| match truth_within(&case, 1e-6) {
            Ok(truth) => broken(&case, &truth.course, &[1e-2, 1e-3]),
            Err(reason) => vec![format!("{}: {reason}", case.about)],
        })
        .collect();
    assert!(broken.is_empty(), "{} of {solids}:\n{}", broken.len(), broken.join("\n"));
}

fn paper_with(assignments: &[&str]) -> palpate_refusal::Result<std::sync::Arc<Model>> {
    let (assignments, limits) =
        (assignments.iter().map(|text| (*text).to_owned()).collect::<Vec<_>>(), Limits::default());
    Model::compile(&Scene::parse("paper", PAPER, &assignments, &limits)?, &limits)
}

/// The force of a stiff, lightly tied sheet is a small difference of large displacements: f32 rounds it away.
#[test]
fn a_stiff_sheet_on_soft_anchor_springs_gets_f64() {
    let stiff = ["springs.stiffness_n_per_m=1000", "damping.coefficient_n_s_per_m=0.05"];
    assert_eq!(paper_with(&stiff).unwrap().precision, Precision::F64);
    assert_eq!(paper_with(&[]).unwrap().precision, Precision::F32);
}

/// The check of a scene takes bounded time too.
#[test]
fn a_scene_that_needs_endless_substeps_is_refused() {
    let refusal = paper_with(&[
        "sheet.points=[2, 2]",
        "sheet.point_mass_kg=1e-12",
        "springs.stiffness_n_per_m=1e12",
        "anchor_springs.stiffness_n_per_m=1",
        "damping.coefficient_n_s_per_m=0",
        "stepping.rate_hz=1",
    ])
    .unwrap_err();
    assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::TooLarge, "stepping.substeps"));
}

/// Returns the largest number of substeps where nothing keeps the tolerance, as docs/accuracy.md states it.
fn most_substeps(model: &Model) -> u32 {
    let (scene, plan) = (&model.scene, &model.plan);
    scheme_selection::MAX_TIMES_STABLE
        * stability::stable_substeps(plan.integrator, scene.stepping.rate_hz.recip(), &Oscillator::of(scene))
}

/// Bodies that float freely, are undamped, or both: a movement never ends.
#[test]
fn a_body_whose_error_nothing_bounds_takes_few_substeps_or_is_refused_at_once() {
    let limits = Limits::default();
    let [free, undamped] = ["material.foundation_n_per_m3=0.0", "material.damping_ratio=0.0"];
    for (seed, sets) in [
        (0, vec![free, undamped]),
        (1, vec![undamped]),
        (2, vec![free]),
        (3, vec![free, undamped, "volume.stiffness_pa=3000.0"]),
    ] {
        let sets: Vec<String> = sets.iter().chain(&["stepping.tolerance=1e-3"]).map(|set| (*set).to_owned()).collect();
        let scene = random_scenes::scene(&mesh_case(seed), &sets, &limits).unwrap();
        match Model::compile(&scene, &limits) {
            Ok(model) => {
                let (keeps, substeps) = (model.expected_error <= 1e-3, model.plan.substeps);
                assert!(keeps || substeps <= most_substeps(&model), "{seed} {sets:?}: {substeps}");
                let warning = model.warnings.iter().find(|warning| warning.starts_with("stepping.tolerance: "));
                assert_eq!(warning.is_none(), keeps, "{seed} {sets:?}");
                assert!(warning.is_none_or(|warning| !warning.contains("auto")), "{warning:?}");
            }
            Err(refusal) => {
                assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::TooLarge, "stepping.tolerance"));
            }
        }
    }
}
