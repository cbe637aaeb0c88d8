//! Tests of cuts in solids: pieces, bits, energy, and the opening of a crack against its closed form.
#![allow(clippy::unwrap_used, clippy::cast_precision_loss, clippy::cast_possible_truncation)]

use std::sync::Arc;

use glam::DVec3;

use crate::body::model::Plan;
use crate::body::severed::SeveredSpring;
use crate::interface::Tissue;
use crate::kernel::lanes;
use crate::limits::Limits;
use crate::scene::profile::Poke;
use crate::scene::{Body, Integrator, Lanes, Precision, Scene, Solid, SolidMaterial, SolidShape};
use crate::scheme::Oscillator;
use crate::state::tissue_state::TissueState;
use crate::{Grasp, Model, Push, at_rest, restored};
use palpate_haptics::{Tip, TipShape};

/// A block of 100 × 100 × 40 mm on a table, of cubes of 10 mm.
fn block(sets: &[&str]) -> Arc<Model> {
    Model::parse("block", BLOCK, sets).unwrap()
}

const BLOCK: &str = "[solid]\norgan = { name = \"phantom\", edge_m = 0.008, seed = 1 }\ncell_m = 0.01\n\
                     fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1], within_m = 0.001 }]\n\
                     [material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.45\ndensity_kg_per_m3 = 980\n\
                     damping_per_s = 60\n[stepping]\nsubsteps = 4\n";

fn blade(length_m: f64) -> Tip {
    Tip { shape: TipShape::Blade, radius_m: 0.001, edge_m: length_m * DVec3::Z, ..Tip::default() }
}

/// Leads a blade with an upright edge of 60 mm from one place to another.
fn cut(tissue: &mut dyn Tissue, from_m: DVec3, to_m: DVec3, steps: u32) {
    for step in 0..=steps {
        tissue.pose(0, from_m.lerp(to_m, f64::from(step) / f64::from(steps)), blade(0.06));
        tissue.step().unwrap();
    }
    tissue.release(0);
}

#[test]
fn a_cut_through_a_block_leaves_two_pieces_that_share_no_corner() {
    let model = block(&["stepping.precision=f64"]);
    let mut tissue = TissueState::<f64>::new(&model);
    cut(&mut tissue, DVec3::new(0.001, -0.06, -0.01), DVec3::new(0.001, 0.06, -0.01), 150);
    // 10 × 4 faces between the cubes, with 11 × 5 corners.
    let cuts = tissue.cuts();
    assert_eq!((cuts.len(), cuts.pieces(&model)), (40, 2));
    let copies = tissue.tables.severed.copies().unwrap().clone();
    assert_eq!(copies.places().count(), 55);
    for joint in cuts.joints(&model) {
        let [a_m, b_m] = joint.points.map(|point| model.shape().rest_m(point));
        assert!((b_m - a_m).distance(0.01 * DVec3::X) < 1e-9 && (joint.part - 0.6).abs() < 0.02, "{joint:?}");
    }
    // What presses on one piece moves it alone.
    let tip = Tip { radius_m: 0.01, shape: TipShape::Sphere, ..Tip::default() };
    for step in 0..400 {
        tissue.pose(1, DVec3::new(-0.02, 0.0, 0.05 - 4e-5 * f64::from(step).min(250.0)), tip);
        tissue.step().unwrap();
    }
    let places = model.places.solid().unwrap();
    let moved_m = |x: f64| {
        let corner = |place: &usize| places.rest_m(copies.corner_of(*place)).distance(DVec3::new(x, 0.0, 0.04)) < 1e-6;
        let all = (0..model.place_count()).filter(|place| places.mass(copies.corner_of(*place)) > 0.0);
        let of = |place: usize| model.unit_m * tissue.vector(&tissue.state.u, place).length();
        all.filter(corner).map(of).collect::<Vec<_>>()
    };
    let [own, far] = [moved_m(-0.01), moved_m(0.01)];
    assert!(own[0] > 1e-4 && far[0] < 0.05 * own[0], "{own:?} {far:?} m");
    let lips = moved_m(0.0);
    assert!(lips.len() == 2 && lips[0].max(lips[1]) > 5.0 * lips[0].min(lips[1]), "{lips:?} m");
}

#[test]
fn a_cut_solid_has_the_same_bits_at_every_width_and_continues_from_a_snapshot() {
    for precision in ["f32", "f64"] {
        for integrator in ["auto", "exponential2"] {
            let mut hashes = Vec::new();
            for lanes in ["plain", "avx2", "auto"] {
                let sets = ["precision", "integrator", "lanes"].into_iter().zip([precision, integrator, lanes]);
                let sets: Vec<String> = sets.map(|(key, value)| format!("stepping.{key}={value}")).collect();
                let model = block(&sets.iter().map(String::as_str).collect::<Vec<_>>());
                let mut tissue = at_rest(&model);
                let sphere = Tip { radius_m: 0.008, shape: TipShape::Sphere, ..Tip::default() };
                let disc = Tip { radius_m: 0.008, friction: 0.3, ..Tip::default() };
                let lead = |tissue: &mut dyn Tissue, steps: std::ops::Range<u32>| {
                    for step in steps {
                        let part = f64::from(step) / 120.0;
                        // Through one side, between two presses that it separates.
                        tissue.pose(0, DVec3::new(0.002 + 0.01 * part, -0.06 + 0.1 * part, 0.012), blade(0.06));
                        tissue.pose(1, DVec3::new(-0.012, -0.01, 0.05 - 0.016 * part), sphere);
                        tissue.pose(2, DVec3::new(0.014, -0.02, 0.042 - 0.01 * part), disc);
                        tissue.step().unwrap();
                    }
                };
                lead(&mut *tissue, 0..70);
                let saved = tissue.save().plain();
                let mut again = restored(&model, &saved.parts, &saved.values, &Limits::default()).unwrap();
                lead(&mut *tissue, 70..120);
                lead(&mut *again, 70..120);
                assert!(tissue.cuts().len() > 15, "{:?}", tissue.cuts().len());
                assert_eq!(again.state_hash(), tissue.state_hash(), "{precision} {integrator} {lanes}");
                hashes.push(tissue.state_hash());
            }
            assert!(hashes.windows(2).all(|pair| pair[0] == pair[1]), "{precision} {integrator}: {hashes:x?}");
        }
    }
}

/// A block that swings without damping is cut: its energy stays as near as that of a whole one, and the guard finds nothing.
#[test]
fn severing_faces_gives_and_takes_no_energy() {
    for integrator in ["central", "exponential2"] {
        let integrator = format!("stepping.integrator={integrator}");
        let undamped =
            ["material.damping_per_s=0", "material.viscosity_pa_s=0", "stepping.precision=f64", "stepping.substeps=16"];
        let model = block(&[&undamped[..], &[&integrator]].concat());
        // Returns by which part the energy changes in the steps of the cut, and after them.
        let changes = |cuts: bool| {
            let mut tissue = TissueState::<f64>::new(&model);
            let corner = model.shape().nearest(DVec3::new(0.05, 0.05, 0.04));
            tissue.grasp(0, corner, Grasp::Target(DVec3::new(0.004, 0.006, 0.002)));
            (0..200).for_each(|_| tissue.step().unwrap());
            tissue.release(0);
            (0..20).for_each(|_| tissue.step().unwrap());
            let whole_j = |tissue: &TissueState<f64>| tissue.energy().kinetic_j + tissue.energy().spring_j;
            let before_j = whole_j(&tissue);
            let mut jump = 0.0_f64;
            for step in 0..60 {
                if cuts {
                    tissue.pose(1, DVec3::new(0.021, -0.06 + 0.002 * f64::from(step), 0.005), blade(0.06));
                }
                tissue.step().unwrap();
                jump = jump.max((whole_j(&tissue) / before_j - 1.0).abs());
            }
            tissue.release(1);
            (0..300).for_each(|_| tissue.step().unwrap());
            assert!(cuts == (tissue.cuts().len() > 20) && tissue.guard_events() == 0, "{}", tissue.guard_events());
            [jump, (whole_j(&tissue) / before_j - 1.0).abs()]
        };
        let ([jump, after], [whole_jump, whole_after]) = (changes(true), changes(false));
        println!("{integrator}: {jump:e} {after:e}, without a cut {whole_jump:e} {whole_after:e}");
        assert!(jump < 2.0 * whole_jump + 1e-5 && after < 2.0 * whole_after + 1e-5);
    }
}

/// Returns a cube of `side`³ cells of 2 mm, held below, E = 10 kPa, ν = 0.3.
pub(in crate::state::cutting) fn cube(side: usize) -> Arc<Model> {
    cube_of(side, 0.002, &[])
}

/// Returns such a cube of cells of any size.
pub(in crate::state::cutting) fn cube_of(side: usize, edge_m: f64, more: &[&str]) -> Arc<Model> {
    let sets = [
        "material.poissons_ratio=0.3",
        "stepping.precision=f64",
        "stepping.integrator=central",
        "stepping.rate_hz=2000",
        "sleep.tolerance=0",
    ];
    let sets: Vec<String> = sets.iter().chain(more).map(|set| (*set).to_owned()).collect();
    let mut scene = Scene::parse("block", BLOCK, &sets, &Limits::default()).unwrap();
    let Body::Solid(solid) = &scene.body else { panic!("of another kind") };
    let material = SolidMaterial { youngs_modulus_pa: 1e4, damping_per_s: 150.0, ..solid.material };
    let solid = Solid::new(Arc::new(SolidShape::block(side, edge_m)), material);
    scene.body = Body::Solid(solid);
    scene.springs.stiffness_n_per_m = 1e4 * edge_m;
    scene.damping_n_s_per_m = 150.0 * scene.point_mass_kg();
    let plan = Plan::new(Integrator::Central, 3, 5e-4, &Oscillator::of(&scene));
    assert!(plan.stable);
    Arc::new(
        Model::planned(scene, plan, Precision::F64, lanes::available(Lanes::Auto).unwrap_or(Lanes::Plain)).unwrap(),
    )
}

/// A round crack across a pulled block opens by 8(1 − ν²)σc/(πE) in its middle (Sneddon 1946), with c from the area of its faces.
#[test]
fn a_round_crack_opens_as_sneddon_says() {
    // `PALPATE_CRACK_CELLS`: the radius in cells. The block is ten times as wide.
    let radius: usize = std::env::var("PALPATE_CRACK_CELLS").map_or(3, |cells| cells.parse().unwrap());
    let side = 10 * radius;
    let model = cube(side);
    let edge_m = model.unit_m;
    let mut tissue = TissueState::<f64>::new(&model);
    let places = model.places.solid().unwrap().clone();
    let (middle, side_m) = (side / 2, edge_m * side as f64);
    let mut faces = 0_u32;
    for cube in (0..places.count()).filter(|cube| places.weight(*cube) > 0.0) {
        let at = (places.rest_m(cube) / edge_m).round();
        let from = DVec3::new(at.x + 0.5 - middle as f64, at.y + 0.5 - middle as f64, 0.0);
        if at.z as usize + 1 == middle && from.length() < radius as f64 {
            faces += 1;
            let ends = [cube, places.cube_across(cube, 2, true).unwrap()].map(|end| end as u32);
            assert!(tissue.sever_face(SeveredSpring { ends, number: 4, part: 0.5, version: 1 }));
        }
    }
    let stretched_m = 0.002 * side_m;
    let top: Vec<_> = model.points().filter(|point| model.shape().rest_m(*point).z > side_m - 1e-6).collect();
    for (tool, point) in top.iter().enumerate() {
        tissue.grasp(tool, *point, Grasp::Target(stretched_m * DVec3::Z));
    }
    (0..200 * radius).for_each(|_| tissue.step().unwrap());
    let pulled_n: f64 = top.iter().map(|point| tissue.point(*point).reaction_n().z).sum();
    let stress_pa = pulled_n.abs() / (side_m * side_m);
    let centre_m = DVec3::new(0.5 * side_m, 0.5 * side_m, edge_m * middle as f64);
    let copies = tissue.tables.severed.copies().unwrap();
    let is_centre = |place: &usize| places.rest_m(copies.corner_of(*place)).distance(centre_m) < 1e-9;
    let all = (0..places.count()).chain(copies.places()).filter(is_centre);
    let lips: Vec<f64> = all.map(|place| edge_m * tissue.vector(&tissue.state.u, place).z).collect();
    let opening_m = (lips[1] - lips[0]).abs();
    let radius_m = edge_m * (f64::from(faces) / std::f64::consts::PI).sqrt();
    let expected_m = 8.0 * (1.0 - 0.09) * stress_pa * radius_m / (std::f64::consts::PI * 1e4);
    let ratio = opening_m / expected_m;
    println!("c = {:.2} cells: {ratio:.4} of the closed form", radius_m / edge_m);
    assert!(lips.len() == 2 && (0.85..1.15).contains(&ratio), "{lips:?} m, {expected_m} m: {ratio}");
}

/// A force on points beside a cut is divided among both sides as their mass is: together they weigh as much on the table as before.
#[test]
fn a_force_beside_a_cut_acts_on_both_sides() {
    let model = block(&["stepping.precision=f64", "material.damping_per_s=200"]);
    let weighed_n = |cuts: bool| {
        let mut tissue = TissueState::<f64>::new(&model);
        let poke = Poke {
            point: None,
            centre_m: DVec3::new(0.0, 0.0, 0.04),
            force_n: -0.05 * DVec3::Z,
            falloff_per_m: 80.0,
            falloff_offset: 0.0,
        };
        tissue.push(1, Some(Push::Constant(poke)));
        if cuts {
            cut(&mut tissue, DVec3::new(0.001, -0.06, -0.01), DVec3::new(0.001, 0.06, -0.01), 150);
            let copies = tissue.tables.severed.copies().unwrap();
            for place in copies.places() {
                let corner = copies.corner_of(place);
                let [own, copy] = [corner, place].map(|place| tissue.applied.until(&model, place));
                let whole = tissue.model.places.solid().unwrap().mass(corner);
                let part = tissue.tables.relative_mass_at(&model, place) / whole;
                assert!((copy - part * (own + copy)).length() < 1e-15 && copy.length() > 0.0, "{own} {copy} {part}");
            }
        }
        (0..600).for_each(|_| tissue.step().unwrap());
        model
            .points()
            .filter(|point| model.shape().is_fixed(*point))
            .map(|point| {
                let place = model.place_of(point);
                let of = |place: usize| tissue.reader().point(place).spring_n.z + tissue.applied.until(&model, place).z;
                let copies = tissue.tables.severed.copies();
                let of_copies =
                    copies.iter().flat_map(|copies| copies.places().filter(|copy| copies.corner_of(*copy) == place));
                of(place) + of_copies.map(of).sum::<f64>()
            })
            .sum::<f64>()
    };
    let [whole_n, cut_n] = [weighed_n(false), weighed_n(true)];
    assert!(whole_n < -0.5 && (cut_n / whole_n - 1.0).abs() < 1e-3, "{whole_n} {cut_n}");
}

/// A solid that was cut and has come to rest sleeps as a whole, wakes as a whole, and continues from a snapshot of its rest.
#[test]
fn a_cut_solid_sleeps_and_continues_from_a_snapshot_of_its_rest() {
    let model = block(&["material.damping_per_s=200", "stepping.precision=f64"]);
    let mut tissue = at_rest(&model);
    cut(&mut *tissue, DVec3::new(0.001, -0.06, 0.012), DVec3::new(0.001, 0.06, 0.012), 150);
    let press = |tissue: &mut dyn Tissue, depth_m: f64| {
        let tip = Tip { radius_m: 0.008, friction: 0.3, ..Tip::default() };
        tissue.pose(1, DVec3::new(0.012, 0.0, 0.04 - depth_m), tip);
        tissue.step().unwrap();
    };
    (0..100).for_each(|step| press(&mut *tissue, 2e-5 * f64::from(step)));
    tissue.release(1);
    let steps = (0..20_000).take_while(|_| !tissue.is_still() && tissue.step().is_ok()).count();
    assert!(tissue.is_still() && tissue.awake_points() == 0 && steps > 100, "{steps}");
    let saved = tissue.save().plain();
    let mut again = restored(&model, &saved.parts, &saved.values, &Limits::default()).unwrap();
    for step in 0..50 {
        press(&mut *tissue, 2e-5 * f64::from(step));
        press(&mut *again, 2e-5 * f64::from(step));
    }
    assert_eq!(again.state_hash(), tissue.state_hash());
    assert!(tissue.largest_displacement_m() > 1e-4 && tissue.guard_events() == 0);
    // After a recovery to rest, tips still move with their own side.
    let step = tissue.step_count();
    tissue.recover(step, true);
    let saved = tissue.save().plain();
    let mut again = restored(&model, &saved.parts, &saved.values, &Limits::default()).unwrap();
    for step in 0..50 {
        press(&mut *tissue, 2e-5 * f64::from(step));
        press(&mut *again, 2e-5 * f64::from(step));
    }
    assert_eq!(again.state_hash(), tissue.state_hash());
}

/// A solid has room for so many doubled corners. Beyond them a blade severs nothing more, and only pushes.
#[test]
fn a_blade_that_finds_no_room_cuts_no_more() {
    let model = block(&[]);
    let mut tissue = at_rest(&model);
    let mut severed = Vec::new();
    for x in [-0.029, -0.009, 0.011, 0.031] {
        cut(&mut *tissue, DVec3::new(x, -0.06, -0.01), DVec3::new(x, 0.06, -0.01), 150);
        severed.push(tissue.cuts().len());
    }
    assert!(severed[0] == 40 && severed[1] > 40 && severed[3] == severed[2] && severed[3] < 160, "{severed:?}");
    assert!(!tissue.cuts().has_room(&model) && tissue.largest_displacement_m().is_finite());
}

/// A block that is pulled apart tears at the stated strain of the way between the middles of its cells.
#[test]
fn a_solid_tears_at_the_stated_strain() {
    let model = block(&["cutting.tear_strain=0.2", "stepping.precision=f64", "material.damping_per_s=300"]);
    let mut tissue = TissueState::<f64>::new(&model);
    let top: Vec<_> = model.points().filter(|point| model.shape().rest_m(*point).z > 0.0399).collect();
    let mut at = 0.0;
    for step in 0..2000 {
        at = 0.004 + 2e-6 * f64::from(step) * 2.0;
        for (tool, point) in top.iter().enumerate() {
            tissue.grasp(tool, *point, Grasp::Target(at * DVec3::Z));
        }
        tissue.step().unwrap();
        if !tissue.cuts().is_empty() {
            break;
        }
    }
    // The block is 4 cells high; held above and below it is strained unevenly, most at its rim.
    let mean = at / 0.04;
    assert!(!tissue.cuts().is_empty() && (0.1..0.2).contains(&mean), "{mean}");
}
