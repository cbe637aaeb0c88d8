//! `make figures`: generates the figures and experiments of docs/paper.md and docs/organs.md in docs/figures. Every run gives
//! the same bytes.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]
#![allow(dead_code, unreachable_pub)] // The chart module is shared.

#[path = "../benches/report/chart.rs"]
mod chart;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use chart::{Look, Panel, Series, svg};
use glam::DVec3;
use palpate::render::{Camera, Film, View};
use palpate_session::Session;
use palpate_session::surface::Refinement;
use palpate_texture as texture;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::response::tangent;
use palpate_tissue::scene::script::Script;
use palpate_tissue::scene::{BUILT_IN, PAPER, Scene};

const SIZE: [usize; 2] = [560, 420];

/// The texture has as many pixels per side as the tenfold refined sheet has vertices.
const TEXTURE: &str = "appearance.texture_size=331";

fn model(sets: &[String]) -> Arc<Model> {
    let limits = Limits::default();
    Model::compile(&Scene::parse("paper", PAPER, sets, &limits).unwrap(), &limits).unwrap()
}

fn script(name: &str, model: &Model) -> Script {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("scripts").join(name).with_extension("toml");
    Script::load(&path, &model.scene, &Limits::default()).unwrap()
}

fn write(name: &str, bytes: &[u8]) {
    let folder: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/figures");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join(name), bytes).unwrap();
    println!("docs/figures/{name}: {} KiB", bytes.len().div_ceil(1024));
}

/// One of the paper's figures: refinement, whether to show its mesh, script and moment.
fn figure(number: u32, n: u32, mesh: bool, script_name: &str, at_step: u64) {
    let (model, limits) = (model(&[TEXTURE.to_owned()]), Limits::default());
    let script = script(script_name, &model);
    let refinement = Refinement::new(&model.scene, n, &limits).unwrap();
    let skin = (!mesh).then(|| texture::image(&model.scene.appearance, &limits).unwrap());
    let view = View { camera: Camera::default(), size: SIZE, refinement, texture: skin };
    let still = Film::new(&model, &script, &limits).unwrap().at(at_step).unwrap();
    write(&format!("figure-{number}.png"), &still.picture(&model, &view).png().unwrap());
}

/// Depth of the control point, mm, over time, s, while `vertical-60` is played with the settings `sets`.
fn depth(sets: &[String]) -> Vec<(f64, f64)> {
    let model = model(sets);
    let script = script("vertical-60", &model);
    let mut session = Session::new(&model);
    session.play_script(&script);
    let centre = model.scene.sheet().unwrap().point([15, 15]);
    let mut course = Vec::new();
    for _ in 0..script.steps {
        session.advance(&mut Vec::new(), |session| {
            course.push((session.time_s(), -1e3 * session.tissue().point(centre).displacement_m.z));
        });
        if let Some(reason) = session.fault() {
            // The last point is of the state that the tissue went back to.
            course.pop();
            println!("{sets:?}: {reason}");
            break;
        }
    }
    course
}

fn curves(title: &str, (key, name): (&str, &str), values: &[f64], up: std::ops::Range<f64>, others: &[&str]) -> Panel {
    let line = |(hue, value): (usize, &f64)| {
        let mut sets: Vec<String> = others.iter().map(|set| (*set).to_owned()).collect();
        sets.push(format!("{key}={value:?}"));
        Series { name: format!("{name} = {value}"), hue, look: Look::Full, points: depth(&sets) }
    };
    let series = values.iter().enumerate().map(line).collect();
    Panel::Curves { title: title.to_owned(), x: "time, s", y: "depth, mm", up, series }
}

/// An organ, and where a fingertip presses it.
struct Pressed {
    name: &'static str,
    /// Near the place; the surface is pressed where it is nearest.
    at_m: [f64; 3],
    deep_m: f64,
    camera: Camera,
}

/// A camera at an azimuth and an elevation, degrees, and a distance in longest sides.
const fn from(azimuth_deg: f64, elevation_deg: f64, distance: f64) -> Camera {
    Camera { azimuth_deg, elevation_deg, distance }
}

const ORGANS: [Pressed; 3] = [
    Pressed { name: "liver-organ", at_m: [-0.040, -0.060, 0.050], deep_m: 0.006, camera: from(0.0, 30.0, 1.6) },
    Pressed { name: "gallbladder", at_m: [0.0, -0.05, 0.02], deep_m: 0.008, camera: from(20.0, 35.0, 1.6) },
    Pressed { name: "colon", at_m: [0.10, 0.012, 0.022], deep_m: 0.009, camera: from(190.0, 15.0, 1.5) },
];

/// A scene of an organ, compiled.
fn organ(name: &str) -> Arc<Model> {
    let (_, text) = BUILT_IN.iter().find(|scene| scene.0 == name).unwrap();
    let limits = Limits::default();
    Model::compile(&Scene::parse(name, text, &[], &limits).unwrap(), &limits).unwrap()
}

/// An organ at rest, and under a fingertip that comes from outside (of the colon, whose wall faces inward, from inside).
fn pressed(organ_pressed: &Pressed) {
    let Pressed { name, at_m, deep_m, camera } = organ_pressed;
    let (model, limits) = (organ(name), Limits::default());
    let point = model.shape().nearest(DVec3::from_array(*at_m));
    let (place_m, outward) = (model.shape().rest_m(point), model.shape().normal(point));
    let pose = |at_s: f64, out_m: f64| {
        let [x, y, z] = (place_m + outward * out_m).to_array();
        format!("{{ at_s = {at_s:?}, place_m = [{x:?}, {y:?}, {z:?}] }}")
    };
    let poses = [pose(0.0, 0.004), pose(0.4, -deep_m), pose(0.6, -deep_m)].join(", ");
    let text = format!(
        "name = \"press\"\nduration_s = 0.6\nsample_every_s = 0.1\n[[tool]]\ntip = {{ radius_m = 0.005, friction = 0.2 }}\nposes = [{poses}]\nuntil_s = 0.6\n"
    );
    let script = Script::parse("press", &text, Path::new("."), &model.scene, &limits).unwrap();
    let refinement = Refinement::new(&model.scene, 0, &limits).unwrap();
    let skin = texture::image(&model.scene.appearance, &limits).unwrap();
    let view = View { camera: *camera, size: SIZE, refinement, texture: Some(skin) };
    let mut film = Film::new(&model, &script, &limits).unwrap();
    for (what, step) in [("rest", 0), ("pressed", 590)] {
        let still = film.at(step).unwrap();
        write(&format!("organ-{name}-{what}.png"), &still.picture(&model, &view).png().unwrap());
    }
}

/// The slab `liver`, cut by the script `cut`, without and with a pretension that opens the wound.
fn wounds() {
    let (_, text) = BUILT_IN.iter().find(|scene| scene.0 == "liver").unwrap();
    for (name, pretension_n_per_m) in [("closed", 0.0), ("open", 2.0)] {
        let sets = [format!("springs.pretension_n_per_m={pretension_n_per_m:?}")];
        let limits = Limits::default();
        let model = Model::compile(&Scene::parse("liver", text, &sets, &limits).unwrap(), &limits).unwrap();
        let refinement = Refinement::new(&model.scene, Refinement::for_picture(&model.scene), &limits).unwrap();
        let skin = texture::image(&model.scene.appearance, &limits).unwrap();
        let view = View { camera: from(25.0, 55.0, 1.0), size: SIZE, refinement, texture: Some(skin) };
        let script = script("cut", &model);
        let still = Film::new(&model, &script, &limits).unwrap().at(1850).unwrap();
        write(&format!("wound-{name}.png"), &still.picture(&model, &view).png().unwrap());
    }
}

/// Force over depth of a slow press of `liver-organ`, over its lumps and away from them.
fn lumps() {
    let model = organ("liver-organ");
    let line = |(hue, (name, place_m)): (usize, (&str, DVec3))| {
        let pressed = tangent::press(&model, 0.005, place_m, 0.0005, 11);
        let points = pressed.iter().map(|at| (1e3 * at.depth_m, at.force_n)).collect();
        Series { name: name.to_owned(), hue, look: Look::Full, points }
    };
    let places = [
        ("over the larger lump", DVec3::new(-0.040, -0.026, 0.037)),
        ("over the smaller lump", DVec3::new(0.030, -0.013, 0.028)),
        ("away from them", DVec3::new(-0.034, 0.004, 0.05)),
    ];
    let series = places.into_iter().enumerate().map(line).collect();
    let title = "Force of a slow press by a disc of 5 mm radius".to_owned();
    let panel = Panel::Curves { title, x: "depth, mm", y: "force, N", up: 0.0..3.0, series };
    write("organ-lumps.svg", svg(1, &[panel]).as_bytes());
}

/// Keys of a scene and their labels in a picture.
const K: (&str, &str) = ("springs.stiffness_n_per_m", "k");
const C: (&str, &str) = ("damping.coefficient_n_s_per_m", "C");
const VIRTUAL: (&str, &str) = ("anchor_springs.stiffness_n_per_m", "K″");

fn main() {
    // The last step before the force is released.
    let poked = 500;
    figure(2, 0, true, "vertical-60", poked);
    figure(3, 1, true, "vertical-60", poked);
    figure(4, 3, true, "vertical-60", poked);
    figure(5, 10, false, "vertical-60", 0);
    figure(6, 10, false, "vertical-60", poked);
    figure(7, 10, false, "oblique-60", poked);
    figure(8, 10, false, "oblique-100", poked);

    ORGANS.iter().for_each(pressed);
    lumps();
    wounds();

    let sweep = |file: &str, panels: &[Panel]| write(file, svg(panels.len(), panels).as_bytes());
    let one = |title, what, values: &[f64], up| [curves(title, what, values, up, &[])];
    sweep("sweep-k.svg", &one("springs k, N/m", K, &[1.0, 10.0, 30.0, 100.0], -20.0..200.0));
    sweep("sweep-c.svg", &one("damping C, N·s/m", C, &[0.1, 0.25, 0.5, 1.0], -40.0..120.0));
    sweep("sweep-virtual.svg", &one("anchor springs K″, N/m", VIRTUAL, &[2.0, 5.0, 10.0, 20.0], -20.0..120.0));

    let (values, up) = ([10.0, 36.0, 38.0, 40.0], || -20.0..100.0);
    let paper = ["stepping.integrator=lagged", "stepping.substeps=1", "stepping.rate_hz=100"];
    sweep(
        "oscillation.svg",
        &[
            curves("the paper's scheme, steps of 10 ms", K, &values, up(), &paper),
            curves("the paper's scheme, steps of 1 ms", K, &values, up(), &paper[..2]),
            curves("right within 1e-5", K, &values, up(), &[]),
        ],
    );
}
