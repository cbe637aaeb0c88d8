//! What is measured: scenes by their text, settings by the names that `--set` takes. So a scheme that this build does
//! not know yet is left out, and one that it comes to know is measured, without a change here.
// Each benchmark uses a part of this.
#![allow(dead_code, unreachable_pub)]

use std::sync::Arc;

use palpate::limits::Limits;
use palpate::refusal::Result;
use palpate::scene::{PAPER, Scene};
use palpate::sheet::Model;

/// The key of each name below.
pub const INTEGRATOR: &str = "stepping.integrator";
/// Every scheme there is or may come to be, the paper's first.
pub const INTEGRATORS: [&str; 6] = ["lagged", "central", "rk4", "exponential2", "exponential3", "exponential4"];

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

/// The paper's scene with everything awake, and assignments over it.
pub fn scene(assignments: &[String]) -> Result<Scene> {
    let all: Vec<String> = std::iter::once(set("sleep.tolerance", 0)).chain(assignments.iter().cloned()).collect();
    Scene::parse("paper", PAPER, &all, &Limits { points: 10_000_000, ..Limits::default() })
}

/// The same, compiled.
pub fn model(assignments: &[String]) -> Result<Arc<Model>> {
    Model::compile(&scene(assignments)?, &Limits::default())
}

/// Those names that this build, on this machine, takes for a key. What it refuses is told.
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
