//! `make figures`: generates the figures and experiments of docs/paper.md in docs/figures. Every run gives the same
//! bytes.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]
#![allow(dead_code, unreachable_pub)] // The chart module is shared.

#[path = "../benches/report/chart.rs"]
mod chart;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use chart::{Look, Panel, Series, svg};
use palpate::limits::Limits;
use palpate::render::{Camera, Film, View};
use palpate::scene::script::Script;
use palpate::scene::{PAPER, Scene};
use palpate::session::{Session, run};
use palpate::sheet::Model;
use palpate::surface::Refinement;
use palpate::texture;

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
    run::play(&mut session, &script);
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

/// Keys of a scene and their labels in a picture.
const K: (&str, &str) = ("springs.stiffness_n_per_m", "k");
const C: (&str, &str) = ("damping.coefficient_n_s_per_m", "C");
const VIRTUAL: (&str, &str) = ("virtual_springs.stiffness_n_per_m", "K″");

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

    let sweep = |file: &str, panels: &[Panel]| write(file, svg(panels.len(), panels).as_bytes());
    let one = |title, what, values: &[f64], up| [curves(title, what, values, up, &[])];
    sweep("sweep-k.svg", &one("springs k, N/m", K, &[1.0, 10.0, 30.0, 100.0], -20.0..200.0));
    sweep("sweep-c.svg", &one("damping C, N·s/m", C, &[0.1, 0.25, 0.5, 1.0], -40.0..120.0));
    sweep("sweep-virtual.svg", &one("virtual springs K″, N/m", VIRTUAL, &[2.0, 5.0, 10.0, 20.0], -20.0..120.0));

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
