//! Tests of cautery in solids: that it severs at the stated time of contact under tips of all shapes, to the depth of a cube, and that
//! nothing comes loose of a thick part.
#![allow(clippy::unwrap_used, clippy::cast_possible_truncation)]

use std::collections::BTreeSet;
use std::sync::Arc;

use glam::DVec3;

use super::{BURN_STEPS, burning, model, on_top};
use crate::body::footprint::Footprint;
use crate::body::severed::{Severed, SeveredSpring};
use crate::interface::Tissue;
use crate::limits::Limits;
use crate::scene::{BUILT_IN, Body, Scene};
use crate::state::tissue_state::TissueState;
use crate::{Burns, Model, at_rest};
use palpate_haptics::{ContactState, Tip, TipShape};

fn built_in(name: &str, sets: &[&str]) -> Arc<Model> {
    let (_, text) = BUILT_IN.iter().find(|(of, _)| *of == name).unwrap();
    Model::parse(name, text, sets).unwrap()
}

/// Returns the number of pieces once all faces between some cubes are severed, or all that heat severs.
fn pieces_without_faces_of(model: &Model, cubes: &BTreeSet<usize>, all: bool) -> usize {
    let mut severed = Severed::default();
    for cube in cubes {
        model.each_spring(*cube, |face| {
            if face.other > *cube && cubes.contains(&face.other) && (all || !model.leads_deeper(*cube, &face)) {
                let ends = [*cube, face.other].map(|cube| cube as u32);
                severed.add(model, SeveredSpring { ends, number: face.number as u32, part: 0.5, version: 1 });
            }
        });
    }
    assert!(severed.len() > cubes.len(), "{} faces of {} cubes", severed.len(), cubes.len());
    severed.cuts().pieces(model)
}

#[test]
fn tips_of_all_shapes_sever_a_solid_at_the_stated_time_to_the_depth_of_a_cube() {
    let model = model("solid", &["stepping.precision=f64"]);
    let (top_m, normal) = on_top(&model);
    for (shape, grasps) in
        [(TipShape::Disc, false), (TipShape::Disc, true), (TipShape::RigidDisc, false), (TipShape::Sphere, false)]
    {
        let mut tissue = at_rest(&model);
        let tip = Tip { shape, grasps, ..burning(0.009) };
        let place_m = top_m + (shape.height_m(tip.radius_m) - 0.002) * normal;
        let (mut touched, mut first) = (0, None);
        for _ in 0..20 * BURN_STEPS {
            tissue.pose(0, place_m, tip);
            tissue.step().unwrap();
            touched += u32::from(tissue.tool_contact(0).unwrap().contact_state != ContactState::Free);
            if !tissue.cuts().is_empty() && first.is_none() {
                first = Some(touched);
                let through = tissue.burns().points(&model).filter(|burnt| burnt.burn == 1.0).count();
                assert!(through >= 12, "{shape:?}: {through} corners of cubes that have burnt through");
            }
        }
        // The least corners of cubes beneath the top face, in pairs beside each other.
        let joints = tissue.cuts().joints(&model);
        let is_at_top = |place_m: DVec3| (place_m.z - (top_m.z - model.shape().edge_m())).abs() < 1e-9;
        for joint in &joints {
            let ends_m = joint.points.map(|point| model.shape().rest_m(point));
            assert!(ends_m.into_iter().all(is_at_top) && joint.part == 0.5, "{shape:?}: {ends_m:?} m");
            assert!(ends_m[0].distance(top_m) < 0.009 + 2.0 * model.shape().edge_m(), "{shape:?}: {ends_m:?} m");
        }
        println!("{shape:?}, grasps {grasps}: {} faces, the first after {first:?} steps", joints.len());
        assert_eq!(first, Some(BURN_STEPS), "{shape:?}");
        assert!(joints.len() >= 4, "{shape:?}: {}", joints.len());
        assert_eq!((tissue.cuts().pieces(&model), tissue.guard_events()), (1, 0), "{shape:?}");
    }
}

#[test]
fn a_solid_stays_in_one_piece_if_its_whole_surface_burns_through() {
    for name in ["liver-solid", "phantom", "prostate"] {
        let model = built_in(name, &["stepping.substeps=8"]);
        let Body::Solid(solid) = &model.scene.body else { panic!("of another kind") };
        let places = model.places.solid().unwrap();
        let vertices_m = solid.shape.surface().vertices_m();
        let cubes: BTreeSet<usize> = vertices_m.iter().map(|vertex_m| places.cube_at(*vertex_m)).collect();
        assert_eq!(pieces_without_faces_of(&model, &cubes, false), 1, "{name}");
        // Without the faces that lead inward, cubes above each other come loose.
        assert!(pieces_without_faces_of(&model, &cubes, true) > 50, "{name}");
    }
}

#[test]
fn a_ring_that_a_tip_burns_on_a_round_organ_frees_nothing() {
    let model = built_in("liver-solid", &["stepping.substeps=8"]);
    let mut tissue = TissueState::<f32>::new(&model);
    let (top_m, _) = on_top(&model);
    let tip = Tip { radius_m: 0.009, shape: TipShape::Sphere, friction: 0.0, burn_s: 0.02, ..Tip::default() };
    for step in 0..500 {
        let turn = 6.5 * f64::from(step) / 500.0;
        let beside_m = top_m + 0.02 * DVec3::new(turn.cos(), turn.sin(), 0.0);
        let disc = Footprint::new(&model, tip.radius_m, beside_m);
        tissue.pose(0, disc.anchor_m() + (tip.radius_m - 0.002) * disc.at_rest().1, tip);
        tissue.step().unwrap();
    }
    let cuts = tissue.cuts();
    let through = tissue.contacts.burns.saved().into_iter().filter(|(_, steps)| *steps >= 20);
    let through: BTreeSet<usize> = through.map(|(cube, _)| cube as usize).collect();
    println!("{} cubes through, {} faces", through.len(), cuts.len());
    assert!(through.len() > 30 && cuts.len() > through.len() / 2, "{} cubes, {} faces", through.len(), cuts.len());
    assert_eq!((cuts.pieces(&model), tissue.guard_events()), (1, 0));
    assert!(pieces_without_faces_of(&model, &through, true) > 1);
}

/// Returns a plate of 60 × 40 × 5 mm that is held at one end, of cubes of 5 mm.
fn plate() -> Arc<Model> {
    let corner = |number: u32| {
        let [x, y, z] = [number & 1, number >> 1 & 1, number >> 2].map(f64::from);
        format!("v {:?} {:?} {:?}\n", 0.06 * x, 0.04 * y, 0.005 * z)
    };
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let face = |[a, b, c, d]: [u32; 4]| format!("f {} {} {} {}\n", a + 1, b + 1, c + 1, d + 1);
    let mesh: String = (0..8).map(corner).chain(quads.map(face)).collect();
    let text = "[solid]\nfile = \"plate.obj\"\nunit = \"m\"\ncell_m = 0.005\n\
                fixed = [{ plane_m = [0, 0, 0], normal = [1, 0, 0], within_m = 0.001 }]\n\
                [material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.45\ndensity_kg_per_m3 = 980\n\
                damping_per_s = 60\n[stepping]\nsubsteps = 8\n";
    let limits = Limits::default();
    let scene = Scene::parse_given("plate", text, ("plate.obj", mesh.as_bytes()), &limits).unwrap();
    Model::compile(&scene, &limits).unwrap()
}

#[test]
fn a_plate_as_thin_as_a_cube_is_burnt_through() {
    let model = plate();
    let mut tissue = at_rest(&model);
    let tip = Tip { friction: 0.0, ..burning(0.006) };
    for step in 0..1200 {
        let y = 0.042 * f64::from(step) / 1199.0 - 0.001;
        tissue.pose(0, DVec3::new(0.02, y, 0.0045), tip);
        tissue.step().unwrap();
    }
    tissue.release(0);
    assert!(tissue.cuts().pieces(&model) >= 2 && tissue.guard_events() == 0, "{}", tissue.cuts().pieces(&model));
    // The free end is one of them, and lies beyond the burn.
    for joint in tissue.cuts().joints(&model) {
        let at_m = joint.points.map(|point| model.shape().rest_m(point).x);
        assert!(at_m.iter().all(|x| (0.005..0.031).contains(x)), "{at_m:?} m");
    }
}

#[test]
fn the_guard_undoes_a_burn_of_a_solid_and_what_it_severed() {
    let model = model("solid", &["stepping.precision=f64"]);
    let tip = Tip { grasps: true, burn_s: 0.03, ..burning(0.009) };
    let mut tissue = TissueState::<f64>::new(&model);
    super::touch(&mut tissue, tip, 25);
    let burnt = tissue.contacts.burns.saved();
    tissue.take_checkpoint();
    super::touch(&mut tissue, tip, 5);
    assert!(!tissue.cuts().is_empty() && tissue.contacts.burns.saved() != burnt);
    let severed = tissue.cuts().joints(&model);
    tissue.go_back(0);
    assert!(tissue.cuts().is_empty() && tissue.contacts.burns.saved() == burnt);
    super::touch(&mut tissue, tip, 4);
    assert!(tissue.cuts().is_empty());
    super::touch(&mut tissue, tip, 1);
    let ends = |joints: &[crate::SeveredJoint]| joints.iter().map(|joint| joint.points).collect::<Vec<_>>();
    assert_eq!(ends(&tissue.cuts().joints(&model)), ends(&severed));
}

/// As with blades, a solid has room for so many doubled corners.
#[test]
fn a_burn_that_finds_no_room_severs_no_more_and_takes_no_more_memory_than_is_charged() {
    let model = model("solid", &[]);
    let mut tissue = TissueState::<f32>::new(&model);
    let (top_m, _) = on_top(&model);
    let tip = Tip { burn_s: 0.02, ..burning(0.045) };
    for _ in 0..60 {
        tissue.pose(0, top_m - 0.001 * DVec3::Z, tip);
        tissue.step().unwrap();
    }
    let places = model.places.solid().unwrap();
    let through = tissue.contacts.burns.saved().len();
    assert!(!tissue.cuts().has_room(&model) && tissue.cuts().len() > 100, "{}", tissue.cuts().len());
    assert!(tissue.tables.severed.copies().unwrap().places().count() <= places.spare().len());
    assert!(tissue.largest_displacement_m().is_finite() && tissue.guard_events() == 0);
    // Each of four lists has 24 bytes for a cube.
    assert!(through > 200 && Burns::most_bytes(&model) >= 4 * 24 * through as u64, "{through}");
}
