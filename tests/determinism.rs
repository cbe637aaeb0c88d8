//! The same scene, commands and steps give the same bits.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

mod common;

use std::sync::Arc;

use common::{playing, scene_with, script};
use palpate::limits::Limits;
use palpate::scene::{PAPER, Scene};
use palpate::session::run::run;

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
    run(&model, &script, held, &Limits::default(), &mut output, &|| 0.0, &mut |_| {}).unwrap().final_hash
}

#[test]
fn the_golden_hash_of_a_fixed_scene_stays() {
    // These change only when the arithmetic does: then say so in CHANGELOG.md.
    for (sets, golden) in [
        (vec!["stepping.precision=f32"], GOLDEN_F32),
        (vec!["stepping.precision=f64", "springs.flexion=true", "stepping.substeps=3"], GOLDEN_F64),
    ] {
        let scene = scene_with(PAPER, &sets);
        assert_eq!(hash(&scene, false), golden, "{sets:?}");
        assert_eq!(hash(&scene, false), golden, "{sets:?}, again");
    }
}

const GOLDEN_F32: &str = "4c7e3cc1db49379ffac86ddc98b6fd17";
const GOLDEN_F64: &str = "706aa1c81a99a128dfe5813825267052";

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
