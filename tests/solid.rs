//! Solids: the stiffness under a disc against a reference, energy, bits, snapshots, and refused scenes.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use crate::common;
use crate::common::journal_opening;
use glam::{DQuat, DVec3};
use palpate_geometry::ReadLimits;
use palpate_haptics::{ContactState, Tip, TipShape};
use palpate_refusal::Reason;
use palpate_session::command::Command;
use palpate_session::indentation::Indentation;
use palpate_session::intake::Intake;
use palpate_session::journal::{JournalReader, JournalWriter, pb};
use palpate_tissue::limits::Limits;
use palpate_tissue::response::force_law::{self, Disc};
use palpate_tissue::response::mesh_error::MeshErrorEstimate;
use palpate_tissue::response::tangent;
use palpate_tissue::saved::PlainTissue;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::Action;
use palpate_tissue::scene::{self, Body, CellSize, Change, FixedPart, Named, Scene, Solid, SolidMaterial};
use palpate_tissue::{Model, Push, Tissue, at_rest};

/// A block of 60 × 60 × 30 mm that is held below, of a tissue of 8 kPa.
fn block_text(more: &str) -> String {
    format!(
        "[solid]\nfile = \"block.obj\"\nunit = \"mm\"\nfixed = [{{ plane_m = [0, 0, 0], normal = [0, 0, 1] }}]\n{more}\n\
         [material]\nyoungs_modulus_pa = 8e3\npoissons_ratio = 0.45\ndamping_per_s = 100\n\
         [stepping]\nintegrator = \"central\"\nsubsteps = 4\n"
    )
}

fn read(text: &str, sets: &[&str]) -> palpate_refusal::Result<Scene> {
    let folder = format!("{}/tests/reference", env!("CARGO_MANIFEST_DIR"));
    let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
    Scene::parse_in(Path::new(&folder), "block", text, &sets, &Limits::default())
}

fn block(more: &str, sets: &[&str]) -> Arc<Model> {
    Model::compile(&read(&block_text(more), sets).unwrap(), &Limits::default()).unwrap()
}

/// Presses the middle of the block with a finger of 5 mm, 0.2 mm deep. Returns the stiffness under it, N/m.
fn pressed_n_per_m(tissue: &mut dyn Tissue) -> f64 {
    const DEPTH_M: f64 = 2e-4;
    for step in 0..900 {
        let part = (f64::from(step) / 300.0).min(1.0);
        let height_m = 0.03 - DEPTH_M * part + 1e-4 * (1.0 - part);
        tissue.pose(0, DVec3::new(0.03, 0.03, height_m), Tip::default());
        tissue.step().unwrap();
    }
    assert_eq!(tissue.guard_events(), 0);
    tissue.tool_contact(0).unwrap().force_on_tool_n.z / DEPTH_M
}

/// The reference is a solution with quadratic elements and linear pressure, within 0.1 % under refinement: 107.37 N/m for
/// an even pressure on a disc of 5 mm over its mean depth.
#[test]
fn a_disc_meets_the_stiffness_of_the_block_the_nearer_the_smaller_the_cubes() {
    let error = |cell_m: &str| {
        let mut tissue = at_rest(&block(&format!("cell_m = {cell_m}"), &[]));
        pressed_n_per_m(&mut *tissue) / 107.37 - 1.0
    };
    let [large, middle, small] = ["0.005", "0.00375", "0.003"].map(error);
    println!("{large} {middle} {small}");
    assert!(small > 0.0 && small < 0.05 && middle < 0.07 && large < 0.12, "{large} {middle} {small}");
    assert!(small < middle && middle < large, "{large} {middle} {small}");
}

/// A fifth of the points along each axis is enough for these.
fn small(more: &str, sets: &[&str]) -> Arc<Model> {
    block(&format!("cell_m = 0.01\n{more}"), sets)
}

fn push(tissue: &mut dyn Tissue, force_n: DVec3) {
    let centre_m = DVec3::new(0.03, 0.03, 0.03);
    let poke = Poke { point: None, centre_m, force_n, falloff_per_m: 100.0, falloff_offset: 0.0 };
    tissue.push(0, Some(Push::Constant(poke)));
}

#[test]
fn a_solid_that_nothing_damps_keeps_its_energy() {
    let undamped = ["material.damping_per_s=0", "material.viscosity_pa_s=0"];
    let sets = [&undamped[..], &["stepping.substeps=16", "stepping.precision=\"f64\""]].concat();
    let mut tissue = at_rest(&small("", &sets));
    push(&mut *tissue, DVec3::new(0.1, 0.05, -0.2));
    (0..200).for_each(|_| tissue.step().unwrap());
    tissue.release(0);
    tissue.step().unwrap();
    let whole_j = |tissue: &dyn Tissue| {
        let energy = tissue.energy();
        energy.kinetic_j + energy.spring_j + energy.anchor_j
    };
    let before_j = whole_j(&*tissue);
    assert!(before_j > 1e-6, "{before_j} J");
    for _ in 0..20 {
        (0..100).for_each(|_| tissue.step().unwrap());
        let now_j = whole_j(&*tissue);
        assert!((now_j / before_j - 1.0).abs() < 0.02, "{before_j} {now_j}");
    }
    assert_eq!(tissue.guard_events(), 0);
}

#[test]
fn every_scheme_steps_a_solid_and_its_bits_are_those_of_every_width() {
    let schemes = common::schemes().chain(["stormer"]).flat_map(|scheme| [(scheme, 0.0), (scheme, 0.1)]);
    for (scheme, viscosity_pa_s) in schemes.filter(|of| *of != ("rk4", 0.1)) {
        let hash = |lanes: &str| {
            let set = [
                format!("stepping.integrator=\"{scheme}\""),
                format!("stepping.lanes=\"{lanes}\""),
                format!("material.viscosity_pa_s={viscosity_pa_s}"),
            ];
            let mut tissue = at_rest(&small("", &set.each_ref().map(String::as_str)));
            push(&mut *tissue, DVec3::new(0.1, 0.05, -0.2));
            (0..100).for_each(|_| tissue.step().unwrap());
            assert_eq!(tissue.guard_events(), 0, "{scheme}");
            assert!(tissue.largest_displacement_m() > 1e-4, "{scheme}");
            tissue.state_hash()
        };
        assert_eq!(hash("plain"), hash("auto"), "{scheme}");
    }
}

/// Under its weight a column that is held below sinks by ρ·g·H²/2M, with M = λ + 2μ if its sides do not move. This block is wide, and in its
/// middle nearly so.
#[test]
fn a_block_sags_under_its_weight_and_not_if_its_file_has_the_shape_under_gravity() {
    let sag_m = |gravity: &str, more: &[&str]| {
        let text = block_text("cell_m = 0.005").replace("[stepping]", &format!("{gravity}\n[stepping]"));
        let mut tissue = at_rest(&Model::compile(&read(&text, more).unwrap(), &Limits::default()).unwrap());
        (0..1000).for_each(|_| tissue.step().unwrap());
        assert_eq!(tissue.guard_events(), 0);
        (tissue.surface_displacement_m(DVec3::new(0.03, 0.03, 0.03)).z, tissue.awake_points())
    };
    let acceleration = "acceleration_m_per_s2 = [0, 0, -9.81]";
    // In compliant air, ν = 0: M = E, without any effect of the sides.
    let (free_m, awake) = sag_m(&format!("[gravity]\n{acceleration}"), &["material.poissons_ratio=0"]);
    let theory_m = -1060.0 * 9.81 * 0.03 * 0.03 / (2.0 * 8e3);
    println!("{free_m} {theory_m} {awake}");
    assert!((free_m / theory_m - 1.0).abs() < 0.04, "{free_m} {theory_m}");
    // It sleeps when it has sunk.
    assert_eq!(awake, 0);
    assert_eq!(sag_m(&format!("[gravity]\n{acceleration}\nloaded = true"), &[]).0, 0.0);
    assert_eq!(sag_m("", &[]).0, 0.0);
}

/// A block that lies on a foundation on all sides moves as a whole: by F/(k·A) under a force F that is spread over it, here its weight.
#[test]
fn a_solid_that_only_its_foundation_holds_gives_way_as_a_whole() {
    const FOUNDATION_N_PER_M3: f64 = 2e4;
    let text = block_text("cell_m = 0.005\nfoundation_n_per_m3 = 2e4");
    let held = "fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1] }]";
    let gravity = "[gravity]\nacceleration_m_per_s2 = [0, 0, -9.81]\n[stepping]";
    let text = text.replace(held, "fixed = \"none\"").replace("[stepping]", gravity);
    let scene = read(&text, &["material.youngs_modulus_pa=8e4", "stepping.substeps=16"]).unwrap();
    let mut tissue = at_rest(&Model::compile(&scene, &Limits::default()).unwrap());
    (0..3000).for_each(|_| tissue.step().unwrap());
    assert_eq!(tissue.guard_events(), 0);
    let area_m2 = 2.0 * (0.06 * 0.06 + 0.06 * 0.03 + 0.06 * 0.03);
    let theory_m = -1060.0 * 9.81 * 0.06 * 0.06 * 0.03 / (FOUNDATION_N_PER_M3 * area_m2);
    let moved_m = [[0.03, 0.03, 0.03], [0.03, 0.03, 0.0], [0.0, 0.03, 0.015]]
        .map(|place| tissue.surface_displacement_m(DVec3::from_array(place)).z);
    println!("{moved_m:?} {theory_m}");
    assert!((moved_m.iter().sum::<f64>() / 3.0 / theory_m - 1.0).abs() < 0.05, "{moved_m:?} {theory_m}");
    // A snapshot of any moment of the fall goes on with the same bits, also one of the first.
    for at in [0, 1, 300] {
        let model = Model::compile(&scene, &Limits::default()).unwrap();
        let mut tissue = at_rest(&model);
        (0..at).for_each(|_| tissue.step().unwrap());
        let PlainTissue { parts, values } = tissue.save().plain();
        let mut other = palpate_tissue::restored(&model, &parts, &values, &Limits::default()).unwrap();
        (0..50).for_each(|_| tissue.step().unwrap());
        (0..50).for_each(|_| other.step().unwrap());
        assert_eq!(other.state_hash(), tissue.state_hash(), "{at}");
    }
    // The same bits at every width, in the midst of the fall.
    let hash = |lanes: &str| {
        let scene = read(&text, &[&format!("stepping.lanes={lanes}"), "stepping.substeps=4"]).unwrap();
        let mut tissue = at_rest(&Model::compile(&scene, &Limits::default()).unwrap());
        (0..40).for_each(|_| tissue.step().unwrap());
        assert!(tissue.largest_displacement_m() > 1e-4);
        tissue.state_hash()
    };
    assert_eq!(hash("plain"), hash("auto"));
    // Without a foundation nothing would hold the block.
    let refusal = read(&text.replace("foundation_n_per_m3 = 2e4", ""), &[]).unwrap_err();
    assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::Missing, "solid.fixed"));
    // Gravity is of a solid.
    let sheet = format!("{}\n[gravity]\nacceleration_m_per_s2 = [0, 0, 1]\n", scene::PAPER);
    let refusal = Scene::parse("paper", &sheet, &[], &Limits::default()).unwrap_err();
    assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::WrongKind, "gravity"));
}

/// All schemes step the same viscous solid: the finer, the nearer they are to each other.
#[test]
fn a_viscous_solid_moves_the_same_with_every_scheme() {
    let course = |scheme: &str, substeps: u32| {
        let sets = [
            format!("stepping.integrator=\"{scheme}\""),
            format!("stepping.substeps={substeps}"),
            "stepping.precision=\"f64\"".to_owned(),
            "material.viscosity_pa_s=3".to_owned(),
        ];
        let mut tissue = at_rest(&small("", &sets.each_ref().map(String::as_str)));
        push(&mut *tissue, DVec3::new(0.1, 0.05, -0.2));
        let place_m = DVec3::new(0.03, 0.03, 0.03);
        let moved_m = |_| {
            tissue.step().unwrap();
            tissue.surface_displacement_m(place_m)
        };
        (0..60).map(moved_m).collect::<Vec<DVec3>>()
    };
    let truth = course("exponential4", 64);
    let largest_m = truth.iter().map(|u| u.length()).fold(0.0, f64::max);
    let error = |scheme: &str, substeps: u32| {
        let course = course(scheme, substeps);
        let off_m = course.iter().zip(&truth).map(|(found, truth)| found.distance(*truth)).fold(0.0, f64::max);
        off_m / largest_m
    };
    for (scheme, order, within) in
        [("central", 2, 2e-3), ("stormer", 2, 2e-3), ("exponential2", 3, 2e-4), ("exponential3", 4, 2e-5)]
    {
        let [coarse, fine] = [16, 32].map(|substeps| error(scheme, substeps));
        println!("{scheme}: {coarse:.1e} {fine:.1e}");
        assert!(coarse < within && fine < 1.25 * coarse / 2_f64.powi(order), "{scheme}: {coarse:e} {fine:e}");
    }
}

/// The force of a viscous tissue that moves includes that of the rate: τ times the rate at which the force of rest changes.
#[test]
fn a_finger_that_moves_feels_the_viscosity() {
    const SPEED_M_PER_S: f64 = 0.002;
    let felt_n = |viscosity_pa_s: f64, scheme: &str| {
        let sets = [
            format!("material.viscosity_pa_s={viscosity_pa_s}"),
            format!("stepping.integrator=\"{scheme}\""),
            "stepping.substeps=24".to_owned(),
        ];
        let mut tissue = at_rest(&small("", &sets.each_ref().map(String::as_str)));
        let press = |tissue: &mut dyn Tissue, steps: std::ops::Range<i32>, moves: bool| {
            for step in steps {
                let depth_m = 1e-3 * SPEED_M_PER_S * f64::from(if moves { step } else { 500 });
                tissue.pose(0, DVec3::new(0.03, 0.03, 0.0301 - depth_m), Tip::default());
                tissue.step().unwrap();
            }
            tissue.tool_contact(0).unwrap().force_on_tool_n.z
        };
        let moving_n = press(&mut *tissue, 0..501, true);
        [moving_n, press(&mut *tissue, 500..1500, false)]
    };
    for scheme in ["central", "stormer", "exponential2", "exponential4"] {
        let ([elastic_n, rest_n], [viscous_n, other_rest_n]) = (felt_n(0.0, scheme), felt_n(3.0, scheme));
        assert!((other_rest_n / rest_n - 1.0).abs() < 1e-3, "{scheme}: {rest_n} {other_rest_n}");
        let stiffness_n_per_m = rest_n / (SPEED_M_PER_S * 0.5 - 1e-4);
        let viscous_time_s = 3.0 / (8e3 / 2.9);
        let ratio = (viscous_n - elastic_n) / (viscous_time_s * stiffness_n_per_m * SPEED_M_PER_S);
        println!("{scheme}: {elastic_n} {viscous_n} {rest_n}, {ratio} of what the rate says");
        assert!((0.9..1.1).contains(&ratio), "{scheme}: {ratio}");
    }
}

/// A tenth of the block's cells along each axis, of a tissue with branches.
fn relaxing(branches: &[(f64, f64)], sets: &[&str]) -> Arc<Model> {
    let branch = |(of_shear, time_s): &(f64, f64)| {
        format!("[[branch]]\nshear_modulus_pa = {:?}\ntime_s = {time_s:?}\n", of_shear * 8e3 / 2.9)
    };
    let text = block_text("cell_m = 0.01") + &branches.iter().map(branch).collect::<String>();
    let scene = read(&text, sets).unwrap();
    Model::compile(&scene, &Limits::default()).unwrap()
}

/// Returns Σ γ·τ/T·(e^{T/τ} − 1)·e^{−t/τ}: what is left at `after_s` of branches that a strain filled evenly in the first `rise_s`.
fn left(branches: &[(f64, f64)], rise_s: f64, after_s: f64) -> f64 {
    let of = |(stiffness, time_s): &(f64, f64)| {
        stiffness * time_s / rise_s * (rise_s / time_s).exp_m1() * (-after_s / time_s).exp()
    };
    branches.iter().map(of).sum()
}

#[test]
fn a_held_press_relaxes_as_its_branches_say() {
    let branches = [(0.8, 0.02), (0.5, 0.3), (0.3, 5.0)];
    let felt_n = |branches: &[(f64, f64)], scheme: &str| -> Vec<f64> {
        let sets = [format!("stepping.integrator=\"{scheme}\""), "stepping.substeps=16".to_owned()];
        let mut tissue = at_rest(&relaxing(branches, &sets.each_ref().map(String::as_str)));
        let felt_n = (1..=1000).map(|step| {
            let depth_m = 5e-4 * (f64::from(step) / 50.0).min(1.0);
            tissue.pose(0, DVec3::new(0.03, 0.03, 0.03 - depth_m), Tip::default());
            tissue.step().unwrap();
            tissue.tool_contact(0).unwrap().force_on_tool_n.z
        });
        let felt_n = felt_n.collect();
        assert_eq!(tissue.guard_events(), 0);
        felt_n
    };
    for scheme in ["stormer", "central", "lagged"] {
        let (elastic_n, relaxing_n) = (felt_n(&[], scheme), felt_n(&branches, scheme));
        // After the waves of the press.
        for step in [150, 200, 300, 500, 999] {
            let truth = 1.0 + left(&branches, 0.05, 1e-3 * (step + 1) as f64);
            let ratio = relaxing_n[step] / elastic_n[999] / truth;
            println!(
                "{scheme}, {step} ms: {:.4} N, {ratio:.4} of theory, {truth:.3} of the elastic one",
                relaxing_n[step]
            );
            assert!((ratio - 1.0).abs() < 0.02, "{scheme} {step}: {ratio}");
        }
    }
}

#[test]
fn a_held_force_creeps_to_the_place_that_it_has_without_branches() {
    let (stiffness, time_s) = (1.0, 0.1);
    let moved_m = |branches: &[(f64, f64)]| -> Vec<f64> {
        let mut tissue = at_rest(&relaxing(branches, &[]));
        push(&mut *tissue, DVec3::new(0.0, 0.0, -0.02));
        let moved_m = |_| {
            tissue.step().unwrap();
            tissue.surface_displacement_m(DVec3::new(0.03, 0.03, 0.03)).z
        };
        (0..1000).map(moved_m).collect()
    };
    let (elastic_m, creeping_m) = (moved_m(&[]), moved_m(&[(stiffness, time_s)]));
    for step in [150, 300, 600, 999] {
        // The strain of J(t) = 1 − γ/(1 + γ)·e^(−t/((1 + γ)τ)).
        let truth =
            1.0 - stiffness / (1.0 + stiffness) * (-1e-3 * (step + 1) as f64 / ((1.0 + stiffness) * time_s)).exp();
        let ratio = creeping_m[step] / elastic_m[999] / truth;
        println!("{step} ms: {ratio:.4} of theory");
        assert!((ratio - 1.0).abs() < 0.02, "{step}: {ratio}");
    }
}

/// Fast presses and jumps: what branches give back is no energy from nowhere to the guard, and a released solid comes to rest.
#[test]
fn branches_give_back_what_they_stored_and_no_more() {
    for branches in [vec![(2.0, 0.003)], vec![(0.5, 0.05), (3.0, 0.1)], vec![(1.0, 0.3)]] {
        let hash = |lanes: &str| {
            let sets = [
                format!("stepping.lanes=\"{lanes}\""),
                "stepping.integrator=\"auto\"".to_owned(),
                "stepping.substeps=\"auto\"".to_owned(),
            ];
            let model = relaxing(&branches, &sets.each_ref().map(String::as_str));
            assert_eq!(model.plan.integrator.name(), "stormer");
            let mut tissue = at_rest(&model);
            let mut hash = None;
            for step in 0..10_000 {
                match step {
                    0..600 => {
                        // In and out within 40 ms, 5 mm deep, then a jump, then a grasp that moves.
                        let depth_m = 0.0025 * (1.0 - (f64::from(step) * std::f64::consts::TAU / 40.0).cos());
                        tissue.pose(0, DVec3::new(0.03, 0.03, 0.03 - depth_m), Tip::default());
                    }
                    600 => {
                        tissue.release(0);
                        push(&mut *tissue, DVec3::new(0.05, 0.0, -0.1));
                    }
                    800 => {
                        tissue.release(0);
                        let point = model.shape().nearest(DVec3::new(0.03, 0.02, 0.03));
                        tissue.grasp(1, point, palpate_tissue::Grasp::Target(DVec3::new(0.002, 0.0, 0.003)));
                    }
                    900 => tissue.release(1),
                    1000 => hash = Some(tissue.state_hash()),
                    _ => {}
                }
                tissue.step().unwrap();
            }
            assert_eq!(tissue.guard_events(), 0, "{branches:?}");
            assert_eq!(tissue.awake_points(), 0, "{branches:?}: {} m", tissue.largest_displacement_m());
            hash.unwrap()
        };
        assert_eq!(hash("plain"), hash("auto"), "{branches:?}");
    }
}

#[test]
fn a_relaxing_solid_continues_from_a_snapshot_with_the_same_bits_and_is_told_whole() {
    let model = relaxing(
        &[(1.0, 0.1), (0.5, 1.0)],
        &["stepping.integrator=\"stormer\"", "gravity.acceleration_m_per_s2=[0, 0, -9.81]"],
    );
    let mut tissue = at_rest(&model);
    let press = |tissue: &mut dyn Tissue, steps: u32| {
        for _ in 0..steps {
            tissue.pose(0, DVec3::new(0.03, 0.03, 0.029), Tip::default());
            tissue.step().unwrap();
        }
    };
    press(&mut *tissue, 300);
    let PlainTissue { parts, values } = tissue.save().plain();
    let mut continued = palpate_tissue::restored(&model, &parts, &values, &Limits::default()).unwrap();
    [&mut tissue, &mut continued].into_iter().for_each(|tissue| press(&mut **tissue, 100));
    assert_eq!(tissue.state_hash(), continued.state_hash());
    // A scene that is sent has the same branches.
    let Body::Solid(solid) = &model.scene.body else { panic!() };
    let message = palpate_session::wire::scene::scene(&model.scene);
    let told = palpate_session::wire::scene::from_told(&message, solid.shape.source()).unwrap();
    let Body::Solid(told) = &told.body else { panic!() };
    assert_eq!((told.material.branches, told.material.branches.iter().count()), (solid.material.branches, 2));
}

#[test]
fn branches_that_no_solid_can_have_are_refused_with_their_place() {
    let refused = |branches: &str, sets: &[&str]| {
        let refusal = read(&(block_text("cell_m = 0.01") + branches), sets).unwrap_err();
        (refusal.reason, refusal.field)
    };
    let of = |reason, field: &str| (reason, field.to_owned());
    let one = "[[branch]]\nshear_modulus_pa = 1000\ntime_s = 0.1\n";
    assert_eq!(refused(&one.repeat(4), &[]), of(Reason::TooLarge, "branch"));
    let bad = |from: &str, to: &str| refused(&(one.to_owned() + &one.replace(from, to)), &[]);
    assert_eq!(bad("1000", "-1"), of(Reason::OutOfRange, "branch[1].shear_modulus_pa"));
    assert_eq!(bad("0.1", "1e-5"), of(Reason::OutOfRange, "branch[1].time_s"));
    assert_eq!(bad("time_s = 0.1", ""), of(Reason::Missing, "branch[1].time_s"));
    for scheme in ["rk4", "exponential2", "exponential4"] {
        let set = format!("stepping.integrator=\"{scheme}\"");
        assert_eq!(refused(one, &[&set]), of(Reason::WrongKind, "stepping.integrator"));
    }
    let sheet = format!("{}{one}", palpate_tissue::scene::PAPER);
    assert_eq!(read(&sheet, &[]).map_err(|refusal| refusal.field).unwrap_err(), "branch");
}

type StillPress = fn(&mut dyn Tissue);

/// A press that stays still: by a force, and by a finger that stays where it is.
fn presses() -> [(&'static str, StillPress); 2] {
    let by_force = |tissue: &mut dyn Tissue| push(tissue, DVec3::new(1e-4, 5e-5, -5e-4));
    let by_finger = |tissue: &mut dyn Tissue| tissue.pose(0, DVec3::new(0.03, 0.03, 0.029), Tip::default());
    [("force", by_force), ("finger", by_finger)]
}

#[test]
fn a_still_press_sleeps_within_the_tolerance_and_so_does_the_solid_when_it_is_released() {
    for (name, press) in presses() {
        for tolerance in [1e-2, 1e-3] {
            let with = |tolerance: f64| {
                let set = format!("sleep.tolerance={tolerance}");
                at_rest(&block("cell_m = 0.003", &[&set, "stepping.precision=\"f64\""]))
            };
            let (mut truth, mut sleeping) = (with(0.0), with(tolerance));
            assert_eq!(sleeping.awake_points(), 0);
            let (mut error_m, mut largest_m) = (0.0_f64, 0.0_f64);
            for step in 0..1200 {
                for tissue in [&mut truth, &mut sleeping] {
                    if step == 0 {
                        press(&mut **tissue);
                    }
                    if step == 600 {
                        tissue.release(0);
                    }
                    tissue.step().unwrap();
                }
                if step % 50 == 49 {
                    for point in truth.model().points() {
                        let [exact_m, found_m] = [&truth, &sleeping].map(|tissue| tissue.point(point).displacement_m);
                        error_m = error_m.max(exact_m.distance(found_m));
                        largest_m = largest_m.max(exact_m.length());
                    }
                }
                if step == 599 {
                    let part = sleeping.awake_points() as f64 / truth.awake_points() as f64;
                    println!("{name}, {tolerance:e}: {part} awake under it, error {:e}", error_m / largest_m);
                    assert!(part < if name == "force" { 1e-9 } else { 0.5 }, "{name} {tolerance:e}: {part}");
                }
            }
            assert!(
                error_m <= tolerance * largest_m && largest_m > 1e-4,
                "{name} {tolerance:e}: {error_m} {largest_m}"
            );
            assert_eq!(sleeping.awake_points(), 0, "{name} {tolerance:e}");
        }
    }
}

#[test]
fn what_sleeps_and_wakes_has_the_same_bits_at_every_width() {
    for (name, press) in presses() {
        let hashes = |lanes: &str| {
            let set = format!("stepping.lanes=\"{lanes}\"");
            let mut tissue = at_rest(&block("cell_m = 0.003", &[&set, "sleep.tolerance=1e-2"]));
            press(&mut *tissue);
            (0..400).for_each(|_| tissue.step().unwrap());
            assert!(tissue.computed_fraction() < 1.0, "{name}");
            let pressed = tissue.state_hash();
            tissue.pose(1, DVec3::new(0.015, 0.02, 0.0295), Tip::default());
            (0..50).for_each(|_| tissue.step().unwrap());
            [pressed, tissue.state_hash()]
        };
        assert_eq!(hashes("plain"), hashes("auto"), "{name}");
    }
}

fn first_n_per_m(model: &Model) -> f64 {
    let disc = Disc::in_middle(model, Tip::default().radius_m);
    force_law::first(model, &palpate_tissue::Cuts::default(), disc, &AtomicBool::new(false)).unwrap().rows[0]
        .stiffness_n_per_m
}

#[test]
fn a_layer_is_felt_in_cells_that_are_thicker_than_it() {
    let stiffness = |cell_m: f64, more: &str| first_n_per_m(&block(&format!("cell_m = {cell_m}\n{more}"), &[]));
    let bare = stiffness(0.003, "");
    for (factor, least, most) in [(0.2, 0.4, 0.9), (10.0, 1.2, 3.0)] {
        let layer = format!("[[layer]]\nthickness_m = 0.002\nstiffness_factor = {factor}");
        let [fine, coarse] = [0.002, 0.004].map(|cell_m| stiffness(cell_m, &layer));
        println!("{factor}: {bare} without, {fine}, {coarse}");
        assert!((least..most).contains(&(fine / bare)), "{factor}: {fine} {bare}");
        // The cells at the surface are half filled, which alone makes them stiffer.
        assert!((0.9..1.25).contains(&(coarse / fine)), "{factor}: {coarse} {fine}");
    }
}

/// Cubes that the surface passes through must count for what fills them: with their part of the stiffness alone a beam that lies
/// askew in the lattice sinks by 14 % less.
#[test]
fn a_beam_bends_under_its_weight_however_it_lies_in_the_lattice() {
    let (size_m, gravity_m_per_s2, damping_per_s) = (DVec3::new(0.06, 0.012, 0.012), 0.01, 18.0);
    let ends_m = |turn: DQuat| {
        let (axis, up) = (turn * DVec3::X, turn * DVec3::Z);
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("beam.obj"), common::box_obj(size_m, turn)).unwrap();
        let text = format!(
            "[solid]\nfile = \"beam.obj\"\nunit = \"m\"\ncell_m = 0.003\n\
             fixed = [{{ plane_m = [0, 0, 0], normal = {:?}, within_m = 0.0 }}]\n\
             [material]\nyoungs_modulus_pa = 8e3\npoissons_ratio = 0.0\ndamping_per_s = {damping_per_s:?}\n\
             [gravity]\nacceleration_m_per_s2 = {:?}\n\
             [stepping]\nintegrator = \"central\"\nsubsteps = 2\nprecision = \"f64\"\n[sleep]\ntolerance = 0\n",
            axis.to_array(),
            (-gravity_m_per_s2 * up).to_array(),
        );
        let scene = Scene::parse_in(folder.path(), "beam", &text, &[], &Limits::default()).unwrap();
        let mut tissue = at_rest(&Model::compile(&scene, &Limits::default()).unwrap());
        (0..2000).for_each(|_| tissue.step().unwrap());
        let end_m = turn * DVec3::new(size_m.x, 0.5 * size_m.y, size_m.z);
        -tissue.surface_displacement_m(end_m).dot(up)
    };
    // Timoshenko: bending and shear.
    let load_n_per_m4 = 1060.0 * gravity_m_per_s2;
    let bends_m = load_n_per_m4 * size_m.x.powi(4) * 12.0 / (8.0 * 8e3 * size_m.z.powi(2));
    let theory_m = bends_m + load_n_per_m4 * size_m.x.powi(2) / (2.0 * 4e3 * 5.0 / 6.0);
    for turn in
        [DQuat::IDENTITY, DQuat::from_rotation_x(0.35), DQuat::from_rotation_z(0.5) * DQuat::from_rotation_y(0.4)]
    {
        let error = ends_m(turn) / theory_m - 1.0;
        println!("{turn}: {error:+.3}");
        assert!(error.abs() < 0.07, "{turn}: {error}");
    }
}

fn prostate(sets: &[&str]) -> Arc<Model> {
    let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
    let text = scene::BUILT_IN.iter().find(|(name, _)| *name == "prostate").unwrap().1;
    let scene = Scene::parse("prostate", text, &sets, &Limits::default()).unwrap();
    Model::compile(&scene, &Limits::default()).unwrap()
}

/// References of another code, whose triangles of the group `front` are fixed (docs/solids.md, N/m at 17 kPa).
#[test]
fn a_prostate_that_a_group_holds_is_as_stiff_as_its_reference() {
    let model = prostate(&["solid.cell_m=0.003", "stepping.integrator=central", "stepping.substeps=20"]);
    for (at_m, truth_n_per_m) in [(DVec3::new(0.012, 0.004, 0.01585), 217.3), (DVec3::new(0.0, 0.0, 0.01289), 203.8)] {
        let press = &tangent::press(&model, 0.005, at_m, 0.0, 1)[0];
        let error = press.tangent.stiffness_n_per_m.z_axis.z / truth_n_per_m - 1.0;
        println!("{at_m}: {error:+.3}");
        assert!(error.abs() < 0.08, "{at_m}: {error}");
    }
}

#[test]
fn layers_follow_one_another_inward_and_are_refused_with_their_field() {
    let layer = |thickness_m: f64, factor: f64| {
        format!("[[layer]]\nthickness_m = {thickness_m:?}\nstiffness_factor = {factor:?}\n")
    };
    let solid = |layers: &str| match &small(layers, &[]).scene.body {
        Body::Solid(solid) => solid.clone(),
        other => panic!("{other:?}"),
    };
    // The upper third, the middle one, and the rest of a lattice of 6 × 6 × 3 cubes; the sides have the first layer.
    let both = solid(&(layer(0.01, 4.0) + &layer(0.01, 2.0)));
    assert_eq!(both.layers().len(), 2);
    let of = |i: usize, j: usize, k: usize| both.weights()[(k * 6 + j) * 6 + i];
    for (at, expected) in [([2, 2, 2], 4.0), ([2, 2, 1], 2.0), ([0, 2, 1], 4.0), ([1, 2, 1], 2.0), ([2, 2, 0], 4.0)] {
        assert!((of(at[0], at[1], at[2]) - expected).abs() < 1e-6, "{at:?}: {}", of(at[0], at[1], at[2]));
    }
    for (layers, field) in [
        (layer(0.0, 1.0), "layer[0].thickness_m"),
        (layer(0.001, 1.0) + &layer(0.001, 200.0), "layer[1].stiffness_factor"),
        (layer(0.001, 1.0).repeat(9), "layer"),
    ] {
        let refusal = read(&block_text(&format!("cell_m = 0.01\n{layers}")), &[]).unwrap_err();
        assert_eq!(refusal.field, field, "{refusal}");
    }
    let sheet = palpate_tissue::scene::PAPER.to_owned() + &layer(0.001, 1.0);
    let refusal = read(&sheet, &[]).unwrap_err();
    assert_eq!((refusal.field.as_str(), refusal.reason), ("layer", Reason::WrongKind), "{refusal}");
}

/// All of it would take longer than a first law may: larger cells stand for what is far from the disc.
#[test]
fn the_first_law_of_a_solid_of_many_cells_is_near_that_of_all_of_them() {
    let model = block("cell_m = 0.0015", &[]);
    let all = MeshErrorEstimate::of(&model, Disc::in_middle(&model, Tip::default().radius_m)).unwrap();
    let first = first_n_per_m(&model);
    println!("{first} {}", all.stiffness_n_per_m);
    assert!((first / all.stiffness_n_per_m - 1.0).abs() < 0.03, "{first} {all:?}");
}

#[test]
fn a_lump_is_felt_through_the_tissue_above_it() {
    let stiffness = |more: &str| pressed_n_per_m(&mut *at_rest(&block(&format!("cell_m = 0.005\n{more}"), &[])));
    let lump = "[[inclusion]]\ncentre_m = [0.03, 0.03, 0.02]\nradius_m = 0.005\nstiffness_factor = 5";
    let ratio = stiffness(lump) / stiffness("");
    // The reference of contrib/reference/solids.py for ν = 0.49 is 1.158.
    assert!((1.12..1.22).contains(&ratio), "{ratio}");
}

#[test]
fn what_is_fixed_stays_and_the_mass_is_that_of_the_volume() {
    let model = small("", &[]);
    assert!((model.scene.mass_kg() / (0.06 * 0.06 * 0.03 * 1060.0) - 1.0).abs() < 1e-6, "{}", model.scene.mass_kg());
    let mut tissue = at_rest(&model);
    push(&mut *tissue, DVec3::new(0.0, 0.0, -0.5));
    (0..300).for_each(|_| tissue.step().unwrap());
    let shape = model.shape();
    let (fixed, free): (Vec<_>, Vec<_>) = model.points().partition(|point| shape.is_fixed(*point));
    assert!(fixed.len() == 49 && fixed.iter().all(|point| shape.rest_m(*point).z == 0.0));
    assert!(fixed.iter().all(|point| tissue.point(*point).displacement_m == DVec3::ZERO));
    assert!(free.iter().any(|point| tissue.point(*point).displacement_m.z < -1e-3));
}

#[test]
fn a_stiffer_tissue_gives_way_less() {
    let (soft, first) = (small("", &[]), small("", &[]).scene.clone());
    let twice = Change { stiffness_n_per_m: Some(2.0 * first.springs.stiffness_n_per_m), ..Change::default() };
    let stiff = soft.changed(&twice, &first, &Limits::default()).unwrap();
    let models = [soft, stiff];
    let [soft, stiff] = models.each_ref().map(|model| pressed_n_per_m(&mut *at_rest(model)));
    assert!((stiff / soft - 2.0).abs() < 0.01, "{soft} {stiff}");
    let [soft, stiff] = models.map(|model| {
        let (mut tissue, tip) = (at_rest(&model), Tip { shape: TipShape::RigidDisc, ..Tip::default() });
        stroked(&mut *tissue, tip, 0..290, &mut |_| {});
        tissue.tool_contact(0).unwrap().force_on_tool_n.z
    });
    assert!((stiff / soft - 2.0).abs() < 0.05, "rigid: {soft} {stiff}");
}

#[test]
fn a_solid_that_is_pressed_far_too_deep_comes_back() {
    let model = small("", &["material.damping_per_s=400"]);
    let mut tissue = at_rest(&model);
    for step in 0..400 {
        let depth_m = 0.024 * (f64::from(step) / 100.0).min(1.0);
        tissue.pose(0, DVec3::new(0.03, 0.03, 0.03 - depth_m), Tip { radius_m: 0.01, ..Tip::default() });
        tissue.step().unwrap();
        assert!(tissue.largest_displacement_m().is_finite());
    }
    tissue.release(0);
    (0..3000).for_each(|_| tissue.step().unwrap());
    assert!(tissue.largest_displacement_m() < 1e-5, "{}", tissue.largest_displacement_m());
}

/// 107.37 N/m is the truth ([`a_disc_meets_the_stiffness_of_the_block_the_nearer_the_smaller_the_cubes`]).
#[test]
fn the_error_of_the_cubes_is_estimated_within_a_factor_of_two() {
    for cell_m in ["0.006", "0.005", "0.00375"] {
        let model = block(&format!("cell_m = {cell_m}"), &[]);
        let disc = Disc { radius_m: 0.005, at_m: DVec3::new(0.03, 0.03, 0.03) };
        let estimate = MeshErrorEstimate::of(&model, disc).unwrap();
        let truth = estimate.stiffness_n_per_m / 107.37 - 1.0;
        println!("{cell_m}: {estimate:?}, {truth}");
        assert!((0.5..2.0).contains(&(estimate.relative / truth)), "{cell_m}: {estimate:?}, {truth}");
    }
    assert_eq!(
        MeshErrorEstimate::of(
            &common::model(&common::scene_with(common::SMALL, &[])),
            Disc { radius_m: 0.1, at_m: DVec3::ZERO }
        ),
        None
    );
}

const INDENTATION: Indentation =
    Indentation { place_m: None, shape: TipShape::Disc, radius_m: 0.005, depth_m: 1e-3, speed_m_per_s: 0.002 };

#[test]
fn an_indentation_goes_in_and_comes_back_on_one_curve() {
    let model = block("cell_m = 0.006", &["material.damping_per_s=20"]);
    let indentation = INDENTATION;
    let indented = indentation.run(&model, &Limits::default(), &|| 0.0, &mut |_| {}).unwrap();
    let [first, .., last] = &indented.curve[..] else { panic!() };
    assert!(indented.curve.len() == 21 && first.depth_m == 0.0 && (last.depth_m - 1e-3).abs() < 1e-6, "{last:?}");
    assert!((indented.place_m - DVec3::new(0.03, 0.03, 0.03)).length() < 1e-3, "{}", indented.place_m);
    for row in &indented.curve {
        assert!((row.loading_n - row.unloading_n).abs() < 0.01 * last.loading_n, "{row:?}");
    }
    assert!(indented.curve.is_sorted_by(|a, b| a.loading_n < b.loading_n), "{:?}", indented.curve);
    // The truth is 107.37 N/m, and cubes of 6 mm are a tenth too stiff.
    assert!((105.0..130.0).contains(&indented.stiffness_n_per_m), "{}", indented.stiffness_n_per_m);
    assert!(indented.summary.mesh_error_estimate.is_some_and(|error| error > 0.05 && error < 0.3));
    assert_eq!(indented.gives_way_at_m(), None);
}

/// Under an even pressure of more than E, nothing is in equilibrium near the shape at rest.
#[test]
fn a_deep_indentation_tells_where_the_tissue_gives_way() {
    let text = scene::BUILT_IN.iter().find(|(name, _)| *name == "phantom").unwrap().1;
    let scene = Scene::parse("phantom", text, &[], &Limits::default()).unwrap();
    let model = Model::compile(&scene, &Limits::default()).unwrap();
    let deep = Indentation { depth_m: 6e-3, speed_m_per_s: 0.02, ..INDENTATION };
    let deep = deep.run(&model, &Limits::default(), &|| 0.0, &mut |_| {}).unwrap();
    let gives_way_at_m = deep.gives_way_at_m().unwrap();
    assert!((4e-3..6.1e-3).contains(&gives_way_at_m), "{:?}", deep.curve);
}

/// Deeper than the tissue bears an even pressure, it slips from the disc, which then comes out from beneath the surface.
#[test]
fn a_disc_that_the_tissue_slipped_from_comes_out_without_giving_energy() {
    let text = scene::BUILT_IN.iter().find(|(name, _)| *name == "prostate").unwrap().1;
    let scene = Scene::parse("prostate", text, &[], &Limits::default()).unwrap();
    let mut tissue = at_rest(&Model::compile(&scene, &Limits::default()).unwrap());
    let top_m = tissue.model().shape().pressed_m();
    let mut has_slipped = false;
    for step in 0..1400 {
        let part = |from: u32, over: f64| (f64::from(step.max(from) - from) / over).min(1.0);
        let depth_m = -3e-3 + 13e-3 * (part(0, 300.0) - part(800, 400.0));
        let aside_m = 4e-3 * part(100, 200.0);
        tissue.pose(0, top_m + DVec3::new(aside_m, -aside_m, -depth_m), Tip::default());
        tissue.step().unwrap();
        has_slipped |=
            step > 800 && depth_m > 1e-3 && tissue.tool_contact(0).unwrap().contact_state == ContactState::Free;
    }
    assert_eq!((has_slipped, tissue.guard_events()), (true, 0));
}

/// Returns the mean of the forces on the way in and back at the last depth but `rows` of an indentation, N, and that depth, m.
fn indented_n(model: &Arc<Model>, indentation: Indentation) -> (f64, f64) {
    let indented = indentation.run(model, &Limits::default(), &|| 0.0, &mut |_| {}).unwrap();
    assert!(indented.summary.fault().is_none(), "{indentation:?}: {:?}", indented.summary);
    let row = indented.curve[10];
    (0.5 * (row.loading_n + row.unloading_n), row.depth_m)
}

/// On a half space a rigid disc is 32/(3π²) = 1.081 times as stiff as an even pressure (Boussinesq), of which the block has
/// 107.37 N/m. For a sphere: Hertz, whose force at a depth is that of the block for the depth less what an even pressure of the
/// same force spares by the block's finite size.
#[test]
fn rigid_tips_meet_the_stiffness_that_theory_gives_wherever_the_cells_are() {
    let even_n_per_m: f64 = 107.37;
    let modulus_pa = 8e3 / (1.0 - 0.45_f64.powi(2));
    let half_space_n_per_m = 3.0 * std::f64::consts::PI.powi(2) / 16.0 * 0.005 * modulus_pa;
    let spared_m_per_n = half_space_n_per_m.recip() - even_n_per_m.recip();
    let hertz_n = |radius_m: f64, depth_m: f64| {
        let of_depth = |depth_m: f64| 4.0 / 3.0 * modulus_pa * radius_m.sqrt() * depth_m.powf(1.5);
        (0..50).fold(of_depth(depth_m), |force_n, _| of_depth(depth_m + spared_m_per_n * force_n))
    };
    let places = [DVec3::ZERO, 0.5 * DVec3::X, DVec3::new(0.5, 0.5, 0.0)];
    for (cell_m, places) in [(0.005, &places[..]), (0.003, &places[..1])] {
        let model = block(&format!("cell_m = {cell_m}"), &["material.damping_per_s=60"]);
        for along in places.iter().copied() {
            let place_m = Some(DVec3::new(0.03, 0.03, 0.03) + cell_m * along);
            let base = Indentation { place_m, speed_m_per_s: 0.01, ..INDENTATION };
            let (disc_n, disc_m) =
                indented_n(&model, Indentation { shape: TipShape::RigidDisc, depth_m: 4e-4, ..base });
            let disc = disc_n / disc_m / (32.0 / (3.0 * std::f64::consts::PI.powi(2)) * even_n_per_m);
            let sphere = Indentation { shape: TipShape::Sphere, radius_m: 0.01, depth_m: 4e-3, ..base };
            let (sphere_n, depth_m) = indented_n(&model, sphere);
            let sphere = sphere_n / hertz_n(0.01, depth_m);
            // What a device is told of the next depths.
            let law = |shape: TipShape, radius_m: f64| {
                force_law::of_tip(&model, force_law::exact(&model, radius_m), shape, radius_m)
            };
            let disc_law = law(TipShape::RigidDisc, 0.005).at_depth(disc_m).force_n / disc_n;
            let sphere_law = law(TipShape::Sphere, 0.01).at_depth(depth_m).force_n / sphere_n;
            println!("{cell_m} {along}: {disc:.3} {sphere:.3}, laws {disc_law:.3} {sphere_law:.3}");
            assert!(
                (0.93..1.07).contains(&disc) && (0.85..1.15).contains(&sphere),
                "{cell_m} {along}: {disc} {sphere}"
            );
            assert!([disc_law, sphere_law].iter().all(|law| (0.9..1.1).contains(law)), "{disc_law} {sphere_law}");
        }
    }
}

/// To two fifths of the thickness. An even pressure gives way before one radius
/// ([`a_deep_indentation_tells_where_the_tissue_gives_way`]).
#[test]
fn rigid_tips_press_deep_with_a_force_that_rises_and_give_no_more_back_than_they_take() {
    let model = block("cell_m = 0.005", &["material.damping_per_s=60"]);
    for shape in [TipShape::RigidDisc, TipShape::Sphere] {
        let deep = Indentation { shape, radius_m: 0.01, depth_m: 0.012, speed_m_per_s: 0.03, ..INDENTATION };
        let indented = deep.run(&model, &Limits::default(), &|| 0.0, &mut |_| {}).unwrap();
        let most_n = indented.curve.last().unwrap().loading_n;
        println!("{shape:?}: {:.3?}", indented.curve.iter().map(|row| row.loading_n).collect::<Vec<_>>());
        println!("{shape:?}: {:.3?}", indented.curve.iter().map(|row| row.unloading_n).collect::<Vec<_>>());
        assert!(indented.summary.fault().is_none(), "{shape:?}: {:?}", indented.summary);
        assert!(indented.curve.is_sorted_by(|a, b| a.loading_n < b.loading_n), "{shape:?}: {:?}", indented.curve);
        assert!(
            indented.curve.iter().all(|row| row.unloading_n < row.loading_n + 0.01 * most_n),
            "{:?}",
            indented.curve
        );
    }
}

/// Presses a rigid tip 2 mm deep and moves it over the block. `at` gets the tissue after each step.
fn stroked(tissue: &mut dyn Tissue, tip: Tip, steps: std::ops::Range<u32>, at: &mut dyn FnMut(&dyn Tissue)) {
    for step in steps {
        let part = |from: u32, over: f64| (f64::from(step.saturating_sub(from)) / over).min(1.0);
        let down_m = 2e-3 * part(0, 200.0);
        let place_m =
            DVec3::new(0.025 + 0.01 * part(300, 300.0), 0.031, 0.03 - down_m + tip.shape.height_m(tip.radius_m));
        tissue.pose(0, place_m, tip);
        tissue.step().unwrap();
        at(tissue);
    }
}

#[test]
fn friction_holds_a_rigid_tip_up_to_its_part_of_the_pressure() {
    for shape in [TipShape::RigidDisc, TipShape::Sphere] {
        for friction in [0.0, 0.3] {
            let tip = Tip { shape, friction, ..Tip::default() };
            let mut tissue = at_rest(&block("cell_m = 0.005", &[]));
            let mut contact = None;
            stroked(&mut *tissue, tip, 0..600, &mut |tissue| contact = tissue.tool_contact(0));
            let contact = contact.unwrap();
            let force_n = contact.force_on_tool_n;
            assert_eq!((contact.contact_state, tissue.guard_events()), (ContactState::Sliding, 0), "{tip:?}");
            let ratio = -force_n.x / force_n.z;
            println!("{shape:?} {friction}: {force_n}");
            // The tissue in front of a tip rises, which holds it too.
            let least = if friction == 0.0 { -0.02 } else { 0.8 * friction };
            assert!((least..friction + 0.2).contains(&ratio), "{tip:?}: {force_n}");
        }
    }
}

/// Over a prostate whose surface turns by up to 40 degrees on the way. A tip drew back as a whole from a part of the surface that
/// came to count at some depth at once, under the rim of a disc or on the flank of a sphere: its force fell to 0 and rose by up to
/// 2 N in a step.
#[test]
fn rigid_tips_slide_over_a_curved_solid_with_a_force_that_does_not_jump() {
    let (model, disc, sphere) = (prostate(&[]), TipShape::RigidDisc, TipShape::Sphere);
    for (shape, x_m, speed_m_per_s, depth_m, down_s) in [
        (disc, -0.003, 0.05, 0.0025, 0.05),
        (disc, 0.004, 0.05, 0.003, 0.05),
        (disc, -0.01, 0.03, 0.002, 0.05),
        (sphere, -0.003, 0.03, 0.01, 0.2),
        (sphere, 0.004, -0.03, 0.009, 0.2),
    ] {
        let tip = Tip { shape, ..Tip::default() };
        let (mut tissue, mut before_n, mut largest_n) = (at_rest(&model), 0.0, 0.0_f64);
        let middle_m = DVec3::new(x_m, -0.001, 0.013 + shape.height_m(tip.radius_m));
        for step in 0..450 {
            let time_s = 1e-3 * f64::from(step);
            let (along_m, down_m) = (speed_m_per_s * (time_s - down_s).max(0.0), depth_m * (time_s / down_s).min(1.0));
            tissue.pose(0, middle_m + along_m * DVec3::X - down_m * DVec3::Z, tip);
            tissue.step().unwrap();
            let force_n = tissue.tool_contact(0).unwrap().force_on_tool_n.length();
            // Until then the tool gets to its depth.
            let jump_n = if time_s > down_s + 0.03 { (force_n - before_n).abs() } else { 0.0 };
            (before_n, largest_n) = (force_n, largest_n.max(force_n));
            assert!(jump_n < 0.1, "{shape:?} from {x_m}, step {step}: {jump_n} N");
        }
        println!("{shape:?} from {x_m}: up to {largest_n:.2} N");
        assert!(largest_n > 0.5 && tissue.guard_events() == 0, "{shape:?} from {x_m}: {largest_n} N");
    }
}

#[test]
fn a_rigid_tip_continues_from_a_snapshot_with_the_same_bits() {
    for shape in [TipShape::RigidDisc, TipShape::Sphere] {
        let tip = Tip { shape, ..Tip::default() };
        let model = block("cell_m = 0.005", &["stepping.integrator=\"exponential4\""]);
        let mut tissue = at_rest(&model);
        stroked(&mut *tissue, tip, 0..400, &mut |_| {});
        let PlainTissue { parts, values } = tissue.save().plain();
        let mut continued = palpate_tissue::restored(&model, &parts, &values, &Limits::default()).unwrap();
        for tissue in [&mut tissue, &mut continued] {
            stroked(&mut **tissue, tip, 400..500, &mut |_| {});
        }
        assert!(tissue.tool_contact(0).unwrap().force_on_tool_n.z > 0.01);
        assert_eq!(tissue.state_hash(), continued.state_hash(), "{shape:?}");
        assert_eq!(tissue.tool_contact(0), continued.tool_contact(0), "{shape:?}");
    }
}

#[test]
fn rigid_tips_that_nothing_can_be_are_refused() {
    let refused = |scene: &Scene, tip: &str| {
        let text = format!(
            "name = \"a\"\nduration_s = 1\nsample_every_s = 0.1\n[[tool]]\ntip = {{ {tip} }}\nposes = [{{ at_s = 0, place_m = [0.03, 0.03, 0.03] }}]"
        );
        let read = palpate_tissue::scene::script::Script::parse("a", &text, Path::new(""), scene, &Limits::default());
        read.err().map(|refusal| refusal.field)
    };
    let solid = small("", &[]);
    assert_eq!(refused(&solid.scene, "shape = \"sphere\""), None);
    let of = |name: &str| Some(format!("tool[0].tip.{name}"));
    assert_eq!(refused(&solid.scene, "shape = \"cube\""), of("shape"));
    assert_eq!(refused(&solid.scene, "shape = \"sphere\", grasps = true"), of("shape"));
    let spring = "shape = \"rigid\", spring = { stiffness_n_per_m = 1, damping_n_s_per_m = 0 }";
    assert_eq!(refused(&solid.scene, spring), of("shape"));
    assert_eq!(refused(&solid.scene, "shape = \"rigid\", radius_m = 0.001"), of("radius_m"));
    let sheet = read(palpate_tissue::scene::PAPER, &[]).unwrap();
    assert_eq!(refused(&sheet, "shape = \"sphere\""), of("shape"));
    let unknown = palpate_proto::pb::Tip { radius_m: 0.005, shape: 9, ..Default::default() };
    assert_eq!(palpate_proto::touch::from_tip("pose.tip", Some(&unknown)).unwrap_err().field, "pose.tip.shape");
}

#[test]
fn a_tool_keeps_the_shape_of_its_tip_until_it_is_released() {
    let model = small("", &[]);
    let mut intake = Intake::new(&model.scene, &Limits::default());
    intake.acquire(&[0], "test", 1.0, 1, 0).unwrap();
    let mut pose = |shape| {
        let tip = Tip { shape, ..Tip::default() };
        let action = Action::Pose { place_m: DVec3::new(0.03, 0.03, 0.04), velocity_m_per_s: None, tip };
        intake.submit(1, vec![Command::new(0, None, action)], 0)
    };
    pose(TipShape::Disc).unwrap();
    let refusal = pose(TipShape::Sphere).unwrap_err();
    assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::OutOfTurn, "pose.tip.shape"), "{refusal}");
}

/// Doubled and turned triangles, triangles on an edge of two others, and a second block that crosses the first.
/// The block and half of it, which cross, with triangles that are doubled, turned and in the way.
fn crossing_blocks() -> palpate_geometry::TriangleMesh {
    let name = "block.obj";
    let limits = ReadLimits::default();
    let whole = palpate_geometry::read(name, &bytes(name), "mm".parse().unwrap(), &|_| None, &limits).unwrap().mesh;
    let mut bad = whole.clone();
    let first = bad.triangles[0];
    bad.triangles.push(first);
    bad.triangles.push([first[0], first[1], bad.triangles[5][2]]);
    bad.triangles[3].swap(0, 1);
    let corners = bad.vertices_m.len() as u32;
    bad.vertices_m.extend(whole.vertices_m.iter().map(|at| *at * 0.5 + DVec3::new(0.041, 0.013, 0.007)));
    bad.triangles.extend(whole.triangles.iter().map(|triangle| triangle.map(|corner| corner + corners)));
    bad
}

#[test]
fn triangles_that_form_no_surface_are_filled_as_if_they_did() {
    let fixed = FixedPart::Plane { plane_m: DVec3::ZERO, normal: DVec3::Z, within_m: 0.0 };
    let of =
        |mesh| Solid::of(mesh, CellSize::Edge(0.004), std::slice::from_ref(&fixed), SolidMaterial::usual()).unwrap();
    let solid = of(crossing_blocks());
    let volume_m3 =
        |solid: &Solid| solid.shape.parts().iter().map(|part| f64::from(*part)).sum::<f64>() * 0.004_f64.powi(3);
    // Of the second block, x from 60 to 71 mm is outside of the first.
    let expected = 0.06 * 0.06 * 0.03 + 0.011 * 0.03 * 0.015;
    assert!((volume_m3(&solid) / expected - 1.0).abs() < 0.02, "{} {expected}", volume_m3(&solid));
    assert!(solid.shape.surface().vertices_m().len() > 100);
}

/// A block of 4 × 4 × 4 hexahedra of 10 mm, the eight in the middle of region 7, in three formats; a third of the elements are
/// mirror images.
fn with_a_region() -> [(&'static str, String); 3] {
    let node = |[x, y, z]: [usize; 3]| x + 5 * (y + 5 * z);
    let points: Vec<[usize; 3]> = (0..125).map(|n| [n % 5, n / 5 % 5, n / 25]).collect();
    let cells: Vec<[usize; 3]> = (0..64).map(|n| [n % 4, n / 4 % 4, n / 16]).collect();
    let corners = |(number, [x, y, z]): (usize, [usize; 3])| {
        let below = |z: usize| [[x, y, z], [x + 1, y, z], [x + 1, y + 1, z], [x, y + 1, z]].map(node);
        let [low, high] = if number % 3 == 0 { [z + 1, z] } else { [z, z + 1] };
        [below(low), below(high)].concat()
    };
    let hexes: Vec<Vec<usize>> = cells.iter().copied().enumerate().map(corners).collect();
    let tags: Vec<usize> =
        cells.iter().map(|cell| if cell.iter().all(|c| (1..3).contains(c)) { 7 } else { 1 }).collect();
    let words = |numbers: &[usize]| numbers.iter().map(ToString::to_string).collect::<Vec<_>>().join(" ");
    let places: Vec<String> = points.iter().map(|of| words(&of.map(|c| 10 * c))).collect();
    let nodes: Vec<String> = (1..).zip(&places).map(|(n, place)| format!("{n} {place}")).collect();
    let of_hex = |(n, (hex, tag)): (usize, (&Vec<usize>, &usize))| {
        format!("{n} 5 2 {tag} {tag} {}", words(&hex.iter().map(|node| node + 1).collect::<Vec<_>>()))
    };
    let elements: Vec<String> = (1..).zip(hexes.iter().zip(&tags)).map(of_hex).collect();
    let msh = format!(
        "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$PhysicalNames\n2\n3 1 \"tissue\"\n3 7 \"lump\"\n$EndPhysicalNames\n\
         $Nodes\n125\n{}\n$EndNodes\n$Elements\n64\n{}\n$EndElements\n",
        nodes.join("\n"),
        elements.join("\n")
    );
    let lists: Vec<String> = hexes.iter().map(|hex| format!("8 {}", words(hex))).collect();
    let vtk = format!(
        "# vtk DataFile Version 3.0\nblock\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 125 float\n{}\nCELLS 64 576\n{}\n\
         CELL_TYPES 64\n{}\nPOINT_DATA 125\nSCALARS height float 1\nLOOKUP_TABLE default\n{}\nCELL_DATA 64\n\
         SCALARS material int\nLOOKUP_TABLE default\n{}\n",
        places.join("\n"),
        lists.join("\n"),
        words(&[12; 64]),
        words(&[3; 125]),
        words(&tags)
    );
    let array = |name: &str, kind: &str, values: String| {
        format!("<DataArray type=\"{kind}\" Name=\"{name}\" format=\"ascii\">{values}</DataArray>")
    };
    let vtu = format!(
        "<VTKFile type=\"UnstructuredGrid\"><UnstructuredGrid><Piece NumberOfPoints=\"125\" NumberOfCells=\"64\"><CellData>{}{}\
         </CellData><Points><DataArray type=\"Float32\" NumberOfComponents=\"3\" format=\"ascii\">{}</DataArray></Points>\
         <Cells>{}{}{}</Cells></Piece></UnstructuredGrid></VTKFile>",
        array("quality", "Float64", words(&[1; 64])),
        array("region", "Int32", words(&tags)),
        places.join(" "),
        array("connectivity", "Int32", words(&hexes.concat())),
        array("offsets", "Int32", words(&(1..=64).map(|n| 8 * n).collect::<Vec<_>>())),
        array("types", "UInt8", words(&[12; 64])),
    );
    [("lump", msh), ("material 7", vtk), ("region 7", vtu)]
}

#[test]
fn regions_of_volume_elements_tell_the_material() {
    for ((name, text), ending) in with_a_region().into_iter().zip(["msh", "vtk", "vtu"]) {
        let file = format!("block.{ending}");
        let scene = |inclusion: &str, cell_m: &str| {
            let of_block = format!(
                "[solid]\nfile = \"{file}\"\nunit = \"mm\"\ncell_m = {cell_m}\nfixed = [{{ plane_m = [0, 0, 0], normal = [0, 0, 1] }}]\n\
                 [material]\nyoungs_modulus_pa = 8e3\npoissons_ratio = 0.45\n[[inclusion]]\nstiffness_factor = 5\n{inclusion}\n"
            );
            Scene::parse_given("block", &of_block, (&file, text.as_bytes()), &Limits::default())
        };
        let region = |cell_m: &str| scene(&format!("group = \"{name}\""), cell_m).unwrap();
        let Body::Solid(aligned) = region("0.005").body else { panic!() };
        let count = |factor: f64| aligned.weights().iter().filter(|weight| (*weight - factor).abs() < 1e-6).count();
        assert_eq!((count(5.0), count(1.0)), (64, 448), "{ending}");
        // Cells across its faces have a mean of the factors.
        let Body::Solid(coarse) = region("0.008").body else { panic!() };
        let part = |weight: &f64| (weight.powf(-0.3) - 1.0) / (5_f64.powf(-0.3) - 1.0);
        let parts: Vec<f64> = coarse.weights().iter().filter(|weight| **weight > 1.0).map(part).collect();
        let volume = parts.iter().sum::<f64>() * 0.512;
        assert!(parts.len() > 8 && (volume / 8.0 - 1.0).abs() < 0.02, "{ending}: {volume} of {}", parts.len());
        let refused = |inclusion: &str| scene(inclusion, "0.005").unwrap_err();
        let unknown = refused("group = \"lumps\"");
        assert_eq!(unknown.field, "inclusion[0].group", "{unknown}");
        assert!(unknown.message.contains(name), "{unknown}");
        assert_eq!(refused(&format!("group = \"{name}\"\nedge_m = 0.001")).field, "inclusion[0].edge_m");
    }
    let block =
        read(&block_text("cell_m = 0.01\n[[inclusion]]\ngroup = \"lump\"\nstiffness_factor = 5"), &[]).unwrap_err();
    assert_eq!(block.field, "inclusion[0].group");
}

/// A solid that a journal kept is the same again, also one whose triangles form no surface.
#[test]
fn a_journal_keeps_regions_and_triangles_that_form_no_surface() {
    let limits = Limits::default();
    let (name, text) = &with_a_region()[0];
    let of_region = format!(
        "[solid]\nfile = \"block.msh\"\nunit = \"mm\"\ncell_m = 0.01\nfixed = [{{ plane_m = [0, 0, 0], normal = [0, 0, 1] }}]\n\
         [material]\nyoungs_modulus_pa = 8e3\npoissons_ratio = 0.45\n[[inclusion]]\nstiffness_factor = 5\ngroup = \"{name}\"\n"
    );
    let of_region = Scene::parse_given("block", &of_region, ("block.msh", text.as_bytes()), &limits).unwrap();
    let crossing = crossing_blocks();
    let vertices: String =
        crossing.vertices_m.iter().map(|at| format!("v {} {} {}\n", 1e3 * at.x, 1e3 * at.y, 1e3 * at.z)).collect();
    let faces: String =
        crossing.triangles.iter().map(|[a, b, c]| format!("f {} {} {}\n", a + 1, b + 1, c + 1)).collect();
    let (text, obj) = (block_text("cell_m = 0.01"), vertices + &faces);
    let of_triangles = Scene::parse_given("block", &text, ("block.obj", obj.as_bytes()), &limits).unwrap();
    for scene in [of_region, of_triangles] {
        let model = Model::compile(&scene, &limits).unwrap();
        let writer = JournalWriter::new(&journal_opening::opening(&model), 0);
        let file = writer.finish(pb::Why::Cut, "", 0, 0);
        let reader = JournalReader::new("journal", std::io::Cursor::new(file)).unwrap();
        let again = palpate_session::journal::message::model(reader.header(), &limits).unwrap();
        assert_eq!(again.fingerprint(), model.fingerprint());
    }
}

fn bytes(name: &str) -> Vec<u8> {
    std::fs::read(format!("{}/tests/reference/{name}", env!("CARGO_MANIFEST_DIR"))).unwrap()
}

#[test]
fn scenes_that_no_solid_can_have_are_refused_with_their_place() {
    let refused = |more: &str, sets: &[&str]| {
        let refusal = read(&block_text(more), sets).unwrap_err();
        (refusal.reason, refusal.field)
    };
    let of = |reason, field: &str| (reason, field.to_owned());
    assert_eq!(refused("", &["material.poissons_ratio=0.4999"]), of(Reason::OutOfRange, "material.poissons_ratio"));
    assert_eq!(refused("", &["material.youngs_modulus_pa=-1"]), of(Reason::OutOfRange, "material.youngs_modulus_pa"));
    assert_eq!(refused("cell_m = 1e-5", &[]), of(Reason::TooLarge, "solid.cell_m"));
    assert_eq!(refused("cell_m = 0.01\ncells = 100", &[]), of(Reason::WrongKind, "solid.cells"));
    assert_eq!(refused("cell_m = 0.01\n[springs]\nstiffness_n_per_m = 1", &[]), of(Reason::WrongKind, "springs"));
    assert_eq!(refused("cell_m = 0.01\n[volume]\nstiffness_pa = 1", &[]), of(Reason::WrongKind, "volume"));
    assert_eq!(refused("cell_m = 0.01", &["solid.fixed=[]"]), of(Reason::Missing, "solid.fixed"));
    let nowhere = "solid.fixed=[{ centre_m = [1, 1, 1], radius_m = 0.1 }]";
    assert_eq!(refused("cell_m = 0.01", &[nowhere]), of(Reason::OutOfRange, "solid.fixed"));
    let open = refused("cell_m = 0.01", &["solid.file=\"open.obj\""]);
    assert_eq!(open, of(Reason::Unreadable, "solid.file"));
    let lump = "cell_m = 0.01\n[[inclusion]]\ncentre_m = [1, 1, 1]\nradius_m = 0.005\nstiffness_factor = 5";
    assert_eq!(refused(lump, &[]), of(Reason::OutOfRange, "inclusion[0].radius_m"));
}
