//! Cuts: the time of each step while a blade moves over a surface at 100 mm/s, beside the same steps without a blade. The steps of both
//! take turns. `-- --quick` measures less.

#![allow(clippy::unwrap_used, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]

use std::sync::Arc;
use std::time::Instant;

use glam::DVec3;
use palpate_haptics::{Tip, TipShape};
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::{BUILT_IN, Scene};
use palpate_tissue::{Model, Tissue, at_rest};

/// Steps of a second at 1 kHz: 100 mm of cutting.
const STEPS: usize = 1000;

fn model(name: &str, sets: &[&str]) -> Arc<Model> {
    let text = BUILT_IN.iter().find(|scene| scene.0 == name).unwrap().1;
    let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
    let scene = Scene::parse(name, text, &sets, &Limits::default()).unwrap();
    Model::compile(&scene, &Limits::default()).unwrap()
}

/// Where the blade's tip is at a step: to and fro over the top of the tissue, 5 mm deep.
fn tip_m(model: &Model, step: usize) -> DVec3 {
    let extent = model.shape().extent();
    let (middle_m, half_m) = (extent.middle_m(), 0.35 * extent.size_m().x);
    let way_m = 1e-4 * step as f64;
    let phase = (way_m / (2.0 * half_m)) % 2.0;
    let along = if phase < 1.0 { 2.0 * phase - 1.0 } else { 3.0 - 2.0 * phase };
    let aside = 0.05 * extent.size_m().y * (way_m / half_m).sin();
    let at = middle_m + DVec3::new(along * half_m, aside, 0.0);
    let top = model.shape().nearest(at + extent.size_m().z * DVec3::Z);
    DVec3::new(at.x, at.y, model.shape().rest_m(top).z - 0.005)
}

fn step_us(tissue: &mut dyn Tissue) -> f64 {
    let begun = Instant::now();
    tissue.step().unwrap();
    begun.elapsed().as_secs_f64() * 1e6
}

fn main() {
    let rounds = if std::env::args().any(|argument| argument == "--quick") { 2 } else { 7 };
    println!(
        "{:<12} {:>8}  {:>27}  {:>27}  severed",
        "tissue", "points", "without: median, p99, worst", "with a blade more: the same"
    );
    for (name, sets) in [
        ("liver", &[][..]),
        ("liver", &["sheet.points=[121, 121]", "sheet.spacing_m=0.000625"]),
        ("liver-organ", &["mesh.organ.edge_m=0.002"]),
        ("liver-solid", &["solid.cell_m=0.0035"]),
    ] {
        let model = model(name, &[&["sleep.tolerance=0"], sets].concat());
        let tip = Tip { shape: TipShape::Blade, radius_m: 0.001, edge_m: 0.03 * DVec3::Z, ..Tip::default() };
        // Of each step the least time of all rounds: what others do on the machine does not count.
        let (mut plain_us, mut cut_us) = (vec![f64::MAX; STEPS], vec![f64::MAX; STEPS]);
        let mut severed = 0;
        for _ in 0..rounds {
            let (mut plain, mut cut) = (at_rest(&model), at_rest(&model));
            for step in 0..STEPS {
                cut.pose(0, tip_m(&model, step), tip);
                plain_us[step] = plain_us[step].min(step_us(&mut *plain));
                cut_us[step] = cut_us[step].min(step_us(&mut *cut));
            }
            severed = cut.cuts().len();
        }
        let mut more_us: Vec<f64> = cut_us.iter().zip(&plain_us).skip(2).map(|(cut, plain)| cut - plain).collect();
        let quantiles = |times: &mut Vec<f64>| {
            times.sort_by(f64::total_cmp);
            [0.5, 0.99, 1.0].map(|part| times[((times.len() - 1) as f64 * part) as usize])
        };
        let ([a, b, c], [d, e, f]) = (quantiles(&mut plain_us), quantiles(&mut more_us));
        println!(
            "{name:<12} {:>8}  {a:>8.1} {b:>8.1} {c:>8.1} µs  {d:>8.1} {e:>8.1} {f:>8.1} µs  {severed}",
            model.len()
        );
    }
}
