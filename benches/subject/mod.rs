//! The program under test: scenes by their text, settings by the names that `--set` takes. A new scheme is measured
//! without a change here.
// Each benchmark uses only a part of this module.
#![allow(dead_code, unreachable_pub)]

use std::sync::Arc;

use palpate_refusal::Result;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::{BUILT_IN, Integrator, Named, Scene};

/// The key of each name below.
pub const INTEGRATOR: &str = "stepping.integrator";
/// Every scheme of a sheet, the paper's first.
pub fn integrators() -> Vec<&'static str> {
    let mut names: Vec<_> = Integrator::of_anchored().map(Named::name).collect();
    names.sort_by_key(|name| *name != "lagged");
    names
}

/// The key of each name below.
pub const LANES: &str = "stepping.lanes";
/// Every width of the kernel.
pub const LANE_NAMES: [&str; 4] = ["avx512", "avx2", "neon", "plain"];

/// The key of the number format.
pub const PRECISION: &str = "stepping.precision";
/// Both number formats.
pub const PRECISIONS: [&str; 2] = ["f32", "f64"];

/// `key=value`, as `--set` takes it.
pub fn set(key: &str, value: impl std::fmt::Display) -> String {
    format!("{key}={value}")
}

/// The paper's scene with everything awake, and the assignments.
pub fn scene(assignments: &[String]) -> Result<Scene> {
    scene_of("paper", assignments)
}

/// Returns the subject of a built-in scene.
pub fn scene_of(name: &str, assignments: &[String]) -> Result<Scene> {
    let (_, text) = BUILT_IN.iter().find(|scene| scene.0 == name).unwrap();
    let all: Vec<String> = std::iter::once(set("sleep.tolerance", 0)).chain(assignments.iter().cloned()).collect();
    Scene::parse(name, text, &all, &Limits { points: 10_000_000, ..Limits::default() })
}

/// The paper's scene, compiled.
pub fn model(assignments: &[String]) -> Result<Arc<Model>> {
    model_of("paper", assignments)
}

/// Any scene that is built in, compiled.
pub fn model_of(name: &str, assignments: &[String]) -> Result<Arc<Model>> {
    Model::compile(&scene_of(name, assignments)?, &Limits::default())
}

/// The names that this build, on this machine, accepts for a key. Reports the ones it refuses.
pub fn known(key: &str, names: &[&'static str]) -> Vec<&'static str> {
    let takes = |name: &&'static str| match model(&[set(key, name)]) {
        Ok(_) => true,
        Err(refusal) => {
            eprintln!("left out: {refusal}");
            false
        }
    };
    names.iter().copied().filter(takes).collect()
}
