//! Random cuts, burns and tears in sheets, surfaces and solids, with tools that press and pull beside the blades, threads and clips that are
//! laid and taken out, saved and restored in the middle of it: numbers stay finite, the pieces are those that a search finds, and a restored
//! tissue has the bits of the one that was saved.
//!
//! Some thousand severed springs in every test run; `make stress-cuts` severs a million (`PALPATE_STRESS_CUTS`), from the seed
//! `PALPATE_STRESS_CUTS_FROM` on, and tells how far it is.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use crate::common::cases;
use crate::common::{model, scene_with};
use glam::{DQuat, DVec3};
use palpate_haptics::{Tip, TipShape};
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::action_check::check_tie;
use palpate_tissue::scene::tie::{Bite, Tie, TieKind};
use palpate_tissue::scene::{Body, SolidShape};
use palpate_tissue::{Model, Tissue, at_rest, restored};

/// A small organ under a pretension.
const ORGAN: &str = r#"
[mesh]
organ = { name = "gallbladder", edge_m = 0.0035 }
[material]
youngs_modulus_pa = 2e4
thickness_m = 0.003
foundation_n_per_m3 = 5e6
[springs]
pretension_n_per_m = 4.0
[cutting]
toughness_j_per_m2 = 20.0
[stepping]
substeps = 8
"#;

/// A block on a table.
const BLOCK: &str = r#"
[solid]
organ = { name = "phantom", edge_m = 0.008, seed = 1 }
cell_m = 0.009
fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1], within_m = 0.001 }]
[material]
youngs_modulus_pa = 15e3
poissons_ratio = 0.45
density_kg_per_m3 = 980
damping_per_s = 60
[cutting]
toughness_j_per_m2 = 20.0
[stepping]
substeps = 4
"#;

/// Returns a blade at an angle about the vertical, which leans by up to a radian.
fn blade(random: &mut fastrand::Rng, length_m: f64) -> Tip {
    let turn = DQuat::from_rotation_z(6.3 * random.f64()) * DQuat::from_rotation_y(random.f64());
    Tip { shape: TipShape::Blade, radius_m: 0.1 * length_m, edge_m: turn * (length_m * DVec3::Z), ..Tip::default() }
}

/// Returns the number of pieces by a search over all springs that are whole, from point to point.
fn pieces(model: &Model, tissue: &dyn Tissue) -> usize {
    let severed: BTreeSet<[usize; 2]> = tissue
        .cuts()
        .joints(model)
        .iter()
        .map(|joint| {
            let [a, b] = joint.points.map(palpate_tissue::shape::PointId::index);
            [a.min(b), a.max(b)]
        })
        .collect();
    let mut beside: Vec<Vec<usize>> = vec![Vec::new(); model.len()];
    let mut is_joined = vec![false; model.len()];
    for [a, b] in springs(model) {
        (is_joined[a], is_joined[b]) = (true, true);
        if !severed.contains(&[a.min(b), a.max(b)]) {
            beside[a].push(b);
            beside[b].push(a);
        }
    }
    let mut found = vec![false; model.len()];
    let mut count = 0;
    for point in 0..model.len() {
        if found[point] || !is_joined[point] {
            continue;
        }
        count += 1;
        let mut waiting = vec![point];
        found[point] = true;
        while let Some(point) = waiting.pop() {
            for other in &beside[point] {
                if !std::mem::replace(&mut found[*other], true) {
                    waiting.push(*other);
                }
            }
        }
    }
    count
}

/// Returns the springs of a scene by the indices of their ends, in any order; of a solid the faces between its cubes, by the least corners
/// of both.
fn springs(model: &Model) -> Vec<[usize; 2]> {
    if let Some(mesh) = model.scene.mesh() {
        return mesh.springs().map(|(ends, _)| ends.map(|end| end as usize)).collect();
    }
    if let Body::Solid(solid) = &model.scene.body {
        return faces(model, &solid.shape);
    }
    let [nx, ny] = model.scene.sheet().unwrap().points;
    let mut reach = vec![[0, 1], [1, 0], [1, 1], [1, -1_isize]];
    if model.scene.springs.bending {
        reach.extend([[0, 2], [2, 0]]);
    }
    let mut found = Vec::new();
    for (i, j) in (0..nx).flat_map(|i| (0..ny).map(move |j| (i, j))) {
        for [di, dj] in &reach {
            let Some(j1) = j.checked_add_signed(*dj).filter(|j1| *j1 < ny) else { continue };
            let i1 = i.checked_add_signed(*di).unwrap();
            if i1 < nx {
                found.push([i * ny + j, i1 * ny + j1]);
            }
        }
    }
    found
}

/// Returns the faces between the cubes of a solid, by the points at the least corners of both.
fn faces(model: &Model, shape: &SolidShape) -> Vec<[usize; 2]> {
    let lattice = shape.lattice();
    let corner = |at_m: DVec3| lattice.from_m(at_m).round().to_array().map(|at| at as usize);
    let points: BTreeMap<[usize; 3], usize> = palpate_tissue::shape::points(model.shape())
        .map(|point| (corner(model.shape().rest_m(point)), point.index()))
        .collect();
    let is_cube = |at: [usize; 3]| {
        let is_within = at.iter().zip(lattice.cells).all(|(at, cells)| *at < cells);
        is_within && shape.parts()[lattice.index(at)] > 0.0
    };
    let mut found = Vec::new();
    for at in points.keys().filter(|at| is_cube(**at)) {
        for axis in 0..3 {
            let mut beyond = *at;
            beyond[axis] += 1;
            if is_cube(beyond) {
                found.push([points[at], points[&beyond]]);
            }
        }
    }
    found
}

/// Returns a thread or clip between some places of the surface.
fn tie(model: &Model, random: &mut fastrand::Rng, place_m: impl Fn(&mut fastrand::Rng) -> DVec3) -> Option<Tie> {
    let is_clip = random.bool();
    let count = if is_clip { 2 } else { random.usize(2..5) };
    let radius_m = 0.6 * model.shape().edge_m();
    let bites: Vec<Bite> = (0..count).map(|_| Bite { place_m: place_m(random), radius_m }).collect();
    let path_m: f64 = bites.windows(2).map(|ends| ends[0].place_m.distance(ends[1].place_m)).sum();
    let thread = TieKind::Thread { length_m: (0.5 + random.f64()) * path_m, friction: random.f64() };
    let kind = if is_clip { TieKind::Clip } else { thread };
    let tie = Tie { bites, kind, strength_n: random.bool().then(|| 2.0 * random.f64() + 0.01) };
    check_tie("tie", model.shape(), &tie, &Limits::default()).is_ok().then_some(tie)
}

/// Steps a tissue, and lets it recover from a blow-up. Returns whether there was none.
fn step(tissue: &mut dyn Tissue) -> bool {
    match tissue.step() {
        Ok(()) => true,
        Err(blow_up) => {
            tissue.recover(blow_up.step, false);
            false
        }
    }
}

/// Cuts a tissue at random for twelve rounds. Returns how many springs are severed.
fn cut_at_random(model: &Arc<Model>, seed: u64) -> usize {
    // That of burns is of its own: without them seeds cut as they do.
    let (mut random, mut heat) = (fastrand::Rng::with_seed(seed), fastrand::Rng::with_seed(!seed));
    let mut tissue = at_rest(model);
    let extent = model.shape().extent();
    let (size_m, length_m) = (extent.size_m(), 0.4 * model.shape().longest_side_m());
    let place_m = |random: &mut fastrand::Rng| {
        let part = DVec3::new(random.f64(), random.f64(), random.f64());
        extent.least_m + part * size_m - 0.2 * length_m * DVec3::Z
    };
    for round in 0..12 {
        let (from_m, to_m, tip) = (place_m(&mut random), place_m(&mut random), blade(&mut random, length_m));
        let presser = Tip { radius_m: model.shape().edge_m(), grasps: random.bool(), ..Tip::default() };
        let presser = Tip { burn_s: if heat.u8(0..3) == 0 { 0.005 + 0.02 * heat.f64() } else { 0.0 }, ..presser };
        let on_surface = |random: &mut fastrand::Rng| model.shape().rest_m(model.shape().nearest(place_m(random)));
        let pressed_m = on_surface(&mut random);
        // A tip that holds also pulls, so that the tissue tears.
        let by_m = length_m * if presser.grasps { 0.5 * (random.f64() - 0.2) } else { -0.02 } * DVec3::Z;
        if random.bool() {
            let number = random.usize(0..3);
            tissue.tie(number, tie(model, &mut random, on_surface));
        }
        let steps = random.u32(20..120);
        let saved_at = random.u32(0..steps);
        let lead = |tissue: &mut dyn Tissue, step: u32| {
            let part = f64::from(step) / f64::from(steps);
            tissue.pose(0, from_m.lerp(to_m, part), tip);
            tissue.pose(1, pressed_m + part * by_m, presser);
        };
        let mut other: Option<Box<dyn Tissue>> = None;
        for number in 0..steps {
            if number == saved_at {
                let saved = tissue.save().plain();
                other = Some(restored(model, &saved.parts, &saved.values, &Limits::default()).unwrap());
            }
            lead(&mut *tissue, number);
            let is_done = step(&mut *tissue);
            let Some(again) = other.as_deref_mut() else { continue };
            lead(again, number);
            assert_eq!(step(again), is_done, "seed {seed}");
            if number >= saved_at + 5 || number + 1 == steps {
                assert_eq!(tissue.state_hash(), again.state_hash(), "seed {seed}, round {round}");
                assert_eq!(tissue.cuts().joints(model), again.cuts().joints(model), "seed {seed}");
                assert_eq!(tissue.cuts().fracture_j(), again.cuts().fracture_j(), "seed {seed}");
                tissue = other.take().unwrap();
            }
        }
        (0..2).for_each(|tool| tissue.release(tool));
        assert!(tissue.largest_displacement_m().is_finite() && tissue.cuts().fracture_j().is_finite(), "seed {seed}");
        assert!(
            tissue.ties().iter().all(|tie| tie.tensions_n.iter().all(|tension_n| tension_n.is_finite())),
            "seed {seed}"
        );
    }
    assert_eq!(tissue.cuts().pieces(model), pieces(model, &*tissue), "seed {seed}");
    tissue.cuts().len()
}

/// Returns the tissues that are cut: sheets, a surface and solids, in both formats, and of each kind one that tears.
fn models() -> Vec<Arc<Model>> {
    let sheet = |more: &[&str]| {
        let sets = [
            "sheet.points=[23, 37]",
            "sheet.spacing_m=0.004",
            "springs.bending=true",
            "springs.pretension_n_per_m=0.5",
        ];
        scene_with(palpate_tissue::scene::PAPER, &[&sets[..], more].concat())
    };
    let tears = "cutting.tear_strain=0.3";
    let scenes = [
        sheet(&["stepping.precision=f32"]),
        scene_with(ORGAN, &[]),
        scene_with(BLOCK, &["stepping.precision=f32"]),
        sheet(&["stepping.precision=f64", tears]),
        scene_with(ORGAN, &[tears, "cutting.anchor_depth_m=0.004"]),
        scene_with(BLOCK, &["stepping.precision=f64", tears]),
    ];
    scenes.iter().map(model).collect()
}

#[test]
fn tissues_that_are_cut_at_random_stay_finite_and_fall_into_the_pieces_that_a_search_finds() {
    let models = models();
    let wanted: usize = cases::count("PALPATE_STRESS_CUTS", 1500, 1_000_000);
    // The first ones of the short form cut a spring of which only the second end is near the blade.
    let (mut severed, mut seed) = (0, cases::count("PALPATE_STRESS_CUTS_FROM", 216, 0));
    let mut told = 0;
    while severed < wanted {
        let seeds: Vec<u64> = (seed..seed + models.len() as u64).collect();
        let found = cases::on_every_core(&seeds, |seed| cut_at_random(&models[*seed as usize % models.len()], *seed));
        assert!(found.iter().any(|of_tissue| *of_tissue > 0), "from seed {seed} on: nothing was cut");
        severed += found.iter().sum::<usize>();
        seed += models.len() as u64;
        if severed / 10_000 > told {
            told = severed / 10_000;
            println!("{severed} severed, up to seed {seed}");
        }
    }
}
