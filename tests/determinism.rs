//! Equal scenes, commands and steps give equal bits.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

mod common;

use std::sync::Arc;

use common::{playing, scene_with, script};
use palpate_session::run::{RunOptions, run};
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::{PAPER, Scene};
use palpate_tissue::{self as tissue, Grasp, Model};

const ALL_LAWS: &str = r#"
duration_s = 0.3
sample_every_s = 0.1
[[force]]
point = [15, 15]
force_n = [1.0, 0.0, -2.0]
falloff_per_m = 60.0
falloff_offset = 0.0
profile = { type = "pulse", on_s = 0.01, off_s = 0.2 }
[[force]]
hops = [{ at_s = 0.0, point = [3, 8] }, { at_s = 0.05, point = [4, 8] }, { at_s = 0.1, point = [5, 9] }]
force_n = [0.0, 0.0, -1.0]
falloff_per_m = 40.0
falloff_offset = 0.1
profile = { type = "ramp", from_s = 0.0, to_s = 0.15 }
[[force]]
path = { from_m = [0.13, 0.37], velocity_m_per_s = [0.9, 0.11] }
force_n = [0.0, 0.3, -0.4]
falloff_per_m = 30.0
falloff_offset = 0.0
profile = { type = "sine", frequency_hz = 5.0 }
[[tool]]
point = [7, 7]
moves = [{ from_s = 0.0, to_s = 0.2, by_m = [0.0, 0.0, -0.1] }]
"#;

fn hash(scene: &Scene, held: bool) -> String {
    let script = script(ALL_LAWS, scene);
    let model = common::model(scene);
    let mut output = Vec::new();
    run(
        &model,
        &script,
        RunOptions { held, ..Default::default() },
        &Limits::default(),
        &mut output,
        &|| 0.0,
        &mut |_| {},
    )
    .unwrap()
    .final_hash
}

#[test]
fn the_golden_hash_of_a_fixed_scene_stays() {
    // These change only when the arithmetic changes. If they do, say so in CHANGELOG.md.
    for (sets, golden) in [
        (vec!["stepping.precision=f32"], GOLDEN_F32),
        (vec!["stepping.precision=f64", "springs.bending=true", "stepping.substeps=3"], GOLDEN_F64),
    ] {
        let scene = scene_with(PAPER, &sets);
        assert_eq!(hash(&scene, false), golden, "{sets:?}");
        assert_eq!(hash(&scene, false), golden, "{sets:?}, again");
    }
}

const GOLDEN_F32: &str = "4ace3dced533a026a88fe966716071ba";
const GOLDEN_F64: &str = "c7e1935cc00396f140fae1feaac03c4d";

#[test]
fn every_width_of_vectors_gives_the_same_bits() {
    let widths: Vec<&str> = ["plain", "neon", "avx2", "avx512"]
        .into_iter()
        .filter(|lanes| {
            let set = [format!("stepping.lanes={lanes}")];
            let scene = Scene::parse("test", PAPER, &set, &Limits::default()).unwrap();
            Model::compile(&scene, &Limits::default()).is_ok()
        })
        .collect();
    println!("compared: {widths:?}");
    let hash = |points: [usize; 2], sets: &[&str], lanes: &str| {
        let (points, lanes) =
            (format!("sheet.points=[{}, {}]", points[0], points[1]), format!("stepping.lanes={lanes}"));
        let mut sets = sets.to_vec();
        sets.extend([points.as_str(), lanes.as_str()]);
        let scene = scene_with(PAPER, &sets);
        let mut tissue = tissue::at_rest(&common::model(&scene));
        // Strong enough to strain springs beyond the polynomial's range, and for rounding to matter.
        tissue.push(0, Some(common::push_on(&scene, [0, 0], [0.7, 0.2, -0.9])));
        let middle = [scene.sheet().unwrap().points[0] / 2, scene.sheet().unwrap().points[1] / 2];
        tissue.push(1, Some(common::push_on(&scene, middle, [-0.1, 0.5, 1.5])));
        for _ in 0..40 {
            tissue.step().unwrap();
        }
        tissue.grasp(
            1,
            tissue.model().scene.sheet().unwrap().point(middle),
            Grasp::Target(glam::DVec3::new(0.01, 0.0, 0.03)),
        );
        // Past the first survey of the guard.
        for _ in 0..260 {
            tissue.step().unwrap();
        }
        (tissue.state_hash(), format!("{:?}", tissue.energy()))
    };
    for points in [[1, 1], [1, 9], [9, 1], [2, 2], [3, 15], [5, 16], [6, 17], [4, 33], [19, 47]] {
        for (index, scheme) in common::schemes().enumerate() {
            let compensates = scheme.starts_with("exponential");
            let scheme = format!("stepping.integrator={scheme}");
            let format = ["f32", "f64", if compensates { "compensated" } else { "f32" }][(index + points[1]) % 3];
            let precision = format!("stepping.precision={format}");
            let others = [
                ["springs.bending=true", "sheet.fixed=edges"],
                ["springs.bending=false", "damping.coefficient_n_s_per_m=0.1"],
            ];
            let mut sets = vec![scheme.as_str(), precision.as_str(), "stepping.substeps=2"];
            sets.extend(others[(index + points[0]) % 2]);
            let expected = hash(points, &sets, widths[0]);
            for lanes in &widths[1..] {
                assert_eq!(hash(points, &sets, lanes), expected, "{lanes}, {points:?}, {sets:?}");
            }
        }
    }
}

#[test]
fn held_forces_differ_from_laws_but_not_by_much() {
    let scene = scene_with(PAPER, &["stepping.precision=f64"]);
    assert_ne!(hash(&scene, true), hash(&scene, false));
    assert_eq!(hash(&scene, true), hash(&scene, true));
}

#[test]
fn a_session_steps_the_same_on_any_thread() {
    let scene = scene_with(PAPER, &[]);
    let script = Arc::new(script(ALL_LAWS, &scene));
    let threads: Vec<_> = (0..4)
        .map(|_| {
            let (scene, script) = (scene.clone(), script.clone());
            std::thread::spawn(move || {
                let mut session = playing(&scene, &script);
                common::advance(&mut session, 300);
                session.tissue().state_hash()
            })
        })
        .collect();
    let hashes: Vec<u128> = threads.into_iter().map(|thread| thread.join().unwrap()).collect();
    assert!(hashes.windows(2).all(|pair| pair[0] == pair[1]), "{hashes:?}");
}
