//! Shared parts of the tests.
#![allow(
    dead_code,
    unreachable_pub,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::disallowed_methods
)]

use std::path::Path;
use std::sync::Arc;

use glam::{DQuat, DVec3};
use palpate_session::Session;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::Script;
use palpate_tissue::scene::{Integrator, Named, Scene};
use palpate_tissue::{Model, Push};

pub fn scene(text: &str) -> Scene {
    Scene::parse("test scene", text, &[], &Limits::default()).unwrap()
}

pub fn scene_with(text: &str, assignments: &[&str]) -> Scene {
    let assignments: Vec<String> = assignments.iter().map(|assignment| (*assignment).to_owned()).collect();
    Scene::parse("test scene", text, &assignments, &Limits::default()).unwrap()
}

pub fn model(scene: &Scene) -> Arc<Model> {
    Model::compile(scene, &Limits::default()).unwrap()
}

pub fn script(text: &str, scene: &Scene) -> Script {
    Script::parse("test script", text, Path::new("scripts"), scene, &Limits::default()).unwrap()
}

/// The names of all schemes.
pub fn schemes() -> impl Iterator<Item = &'static str> {
    Integrator::of_anchored().map(Named::name)
}

/// A session with a script's profiles acting.
pub fn playing(scene: &Scene, script: &Script) -> Session {
    let mut session = Session::new(&model(scene));
    session.play_script(script);
    session
}

/// Steps a session without commands.
pub fn advance(session: &mut Session, steps: u64) {
    for _ in 0..steps {
        session.advance(&mut Vec::new(), |_| {});
        assert_eq!(session.fault(), None);
    }
}

/// A force on one point alone.
pub fn push_on(scene: &Scene, [i, j]: [usize; 2], force_n: [f64; 3]) -> Push {
    Push::Constant(Poke {
        point: None,
        centre_m: scene.shape().rest_m(scene.sheet().unwrap().point([i, j])),
        force_n: force_n.into(),
        falloff_per_m: 100.0 / scene.sheet().unwrap().spacing_m,
        falloff_offset: 0.0,
    })
}

/// A small sheet; `--set` what differs.
pub const SMALL: &str = r#"
name = "small"
[sheet]
points = [7, 5]
spacing_m = 0.05
point_mass_kg = 0.02
[springs]
stiffness_n_per_m = 30.0
[anchor_springs]
stiffness_n_per_m = 5.0
[damping]
coefficient_n_s_per_m = 0.2
[stepping]
precision = "f64"
"#;

/// The corners of a box and its triangles as an OBJ file, m, each place turned by `turn`.
pub fn box_obj(size_m: DVec3, turn: DQuat) -> String {
    let corner = |n: u8| turn * (DVec3::from_array([0, 1, 2].map(|axis| f64::from(n >> axis & 1))) * size_m);
    let vertices = (0..8).map(corner).map(|at| format!("v {:?} {:?} {:?}\n", at.x, at.y, at.z));
    let quads = ["1 3 4 2", "5 6 8 7", "1 2 6 5", "3 7 8 4", "1 5 7 3", "2 4 8 6"].map(|quad| format!("f {quad}\n"));
    vertices.chain(quads).collect()
}
