//! Random cuts on sheets and surfaces, with tools that press beside the blades, saved and restored between: numbers stay finite, the
//! pieces are those that a search finds, and a restored tissue has the bits of the one that was saved.
//!
//! A few hundred severed springs in every test run; `make stress` severs a million (`PALPATE_STRESS_CUTS`).
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

#[path = "common/cases.rs"]
mod cases;
mod common;

use std::collections::BTreeSet;
use std::sync::Arc;

use common::{model, scene_with};
use glam::{DQuat, DVec3};
use palpate_haptics::{Tip, TipShape};
use palpate_tissue::limits::Limits;
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

/// Returns the springs of a scene by the indices of their ends, in any order.
fn springs(model: &Model) -> Vec<[usize; 2]> {
    if let Some(mesh) = model.scene.mesh() {
        return mesh.springs().map(|(ends, _)| ends.map(|end| end as usize)).collect();
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

/// Cuts a tissue at random until so many springs are severed, or for 4000 steps. Returns how many are.
fn cut_at_random(model: &Arc<Model>, seed: u64) -> usize {
    let mut random = fastrand::Rng::with_seed(seed);
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
        let pressed_m = place_m(&mut random);
        let steps = random.u32(20..120);
        for step in 0..steps {
            let part = f64::from(step) / f64::from(steps);
            tissue.pose(0, from_m.lerp(to_m, part), tip);
            tissue.pose(1, pressed_m - 0.02 * part * length_m * DVec3::Z, presser);
            if let Err(blow_up) = tissue.step() {
                tissue.recover(blow_up.step, false);
            }
        }
        tissue.release(0);
        tissue.release(1);
        assert!(tissue.largest_displacement_m().is_finite(), "seed {seed}");
        let saved = tissue.save().plain();
        let mut again = restored(model, &saved.parts, &saved.values, &Limits::default()).unwrap();
        for _ in 0..5 {
            let (one, other) = (tissue.step().is_ok(), again.step().is_ok());
            assert_eq!(one, other, "seed {seed}");
            if !one {
                break;
            }
        }
        assert_eq!(tissue.state_hash(), again.state_hash(), "seed {seed}, round {round}");
        assert_eq!(tissue.cuts().joints(model), again.cuts().joints(model), "seed {seed}");
        tissue = again;
    }
    assert_eq!(tissue.cuts().pieces(model), pieces(model, &*tissue), "seed {seed}");
    tissue.cuts().len()
}

#[test]
fn tissues_that_are_cut_at_random_stay_finite_and_fall_into_the_pieces_that_a_search_finds() {
    let sheets = ["f32", "f64"].map(|precision| {
        let sets = [
            "sheet.points=[23, 37]",
            "sheet.spacing_m=0.004",
            "springs.bending=true",
            "springs.pretension_n_per_m=0.5",
        ];
        let precision = format!("stepping.precision={precision}");
        model(&scene_with(palpate_tissue::scene::PAPER, &[&sets[..], &[precision.as_str()]].concat()))
    });
    let models = [sheets.to_vec(), vec![model(&scene_with(ORGAN, &[]))]].concat();
    let wanted: usize = cases::count("PALPATE_STRESS_CUTS", 1500, 1_000_000);
    let (mut severed, mut seed) = (0, 0);
    while severed < wanted {
        let seeds: Vec<u64> = (seed..seed + 6).collect();
        let found = cases::on_every_core(&seeds, |seed| cut_at_random(&models[*seed as usize % models.len()], *seed));
        severed += found.iter().sum::<usize>();
        seed += 6;
        assert!(seed < 60 || severed > 0, "nothing was cut");
    }
}
