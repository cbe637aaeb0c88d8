//! Organs: the time of a step, what a poke on a resting organ costs beside it all awake, what
//! a tip costs, and how even touch is over a mesh. Writes docs/benchmarks/organ.{md,svg}. `-- --quick` measures less.

#![allow(clippy::unwrap_used, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]

mod report;

use std::sync::Arc;

use glam::DVec3;
use palpate_haptics::{Coupling, Tip, TipShape};
use palpate_tissue::limits::Limits;
use palpate_tissue::response::tangent;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::{BUILT_IN, Named, Scene};
use palpate_tissue::shape::points;
use palpate_tissue::{Model, Push, Tissue, at_rest};
use report::chart::{Look, Panel, Series};
use report::{BenchReport, cells, digits, least, quick, seconds};
use serde_json::json;

/// Steps of one timing.
const STEPS: usize = 20;

const TIP: Tip = Tip {
    shape: TipShape::Disc,
    radius_m: 0.005,
    friction: 0.0,
    grasps: false,
    coupling: Coupling::Constraint,
    edge_m: DVec3::ZERO,
    burn_s: 0.0,
};

fn model(name: &str, sets: &[String]) -> Arc<Model> {
    let text = BUILT_IN.iter().find(|scene| scene.0 == name).unwrap().1;
    let scene = Scene::parse(name, text, sets, &Limits::default()).unwrap();
    Model::compile(&scene, &Limits::default()).unwrap()
}

/// With edges of so many metres.
fn organ(name: &str, edge_m: f64, sets: &[&str]) -> Arc<Model> {
    let mut all = vec![format!("mesh.organ.edge_m={edge_m}")];
    all.extend(sets.iter().map(|set| (*set).to_owned()));
    model(name, &all)
}

fn poke(model: &Model, falloff_per_m: f64) -> Push {
    let centre_m = model.shape().extent().middle_m();
    let point = model.shape().nearest(centre_m + 0.5 * model.shape().extent().size_m().z * DVec3::Z);
    let force_n = -0.3 * model.shape().normal(point);
    let centre_m = model.shape().rest_m(point);
    Push::Constant(Poke { point: None, centre_m, force_n, falloff_per_m, falloff_offset: 0.0 })
}

/// The least time of a step of each tissue, s; they take turns.
fn step_s(rounds: usize, tissues: &[std::cell::RefCell<Box<dyn Tissue>>]) -> Vec<f64> {
    let times = least(rounds, tissues, |tissue| {
        let mut tissue = tissue.borrow_mut();
        seconds(|| (0..STEPS).for_each(|_| tissue.step().unwrap())).0
    });
    times.into_iter().map(|time_s| time_s / STEPS as f64).collect()
}

fn main() {
    let rounds = if quick() { 10 } else { 100 };
    let mut report = BenchReport::new("organ", "Organs", "make bench-organ");
    report.say(
        "Release build, one thread. Times are the shortest of many runs, in which the rows of a table take turns.",
    );
    speed(&mut report, rounds);
    let model = organ("liver-organ", 0.002, &[]);
    let across = across_a_lump(&mut report, &model);
    let map = map(&mut report, &model);
    evenness(&mut report);
    report.write(2, &[across, map]);
}

fn speed(report: &mut BenchReport, rounds: usize) {
    report.heading("Time of a step");
    report.say(
        "`liver-organ` at its default tolerance and 1 kHz. All awake: a force reaches every vertex. A poke: a force of 0.3 N \
         that decreases by a factor of e in 5 mm, on the organ at rest. A tip: 5 mm radius, pressed 2 mm deep. Both are timed \
         0.4 s later: under a constant force the whole organ is asleep at that time, while a tip keeps the tissue around it \
         awake. Asleep: nothing touches the organ.",
    );
    let sizes: &[f64] = if quick() { &[0.002] } else { &[0.002, 0.00167, 0.00124] };
    let mut rows = Vec::new();
    for edge_m in sizes {
        let model = organ("liver-organ", *edge_m, &[]);
        let awake = organ("liver-organ", *edge_m, &["sleep.tolerance=0"]);
        let tissues: Vec<_> =
            [&awake, &model, &model, &model].map(|model| std::cell::RefCell::new(at_rest(model))).into();
        tissues[0].borrow_mut().push(0, Some(poke(&awake, 0.0)));
        tissues[1].borrow_mut().push(0, Some(poke(&model, 200.0)));
        let (top, outward) = top(&model);
        {
            let mut tissue = tissues[2].borrow_mut();
            for step in 0..200 {
                tissue.pose(0, top + (0.003 - 0.005 * f64::from(step) / 199.0) * outward, TIP);
                tissue.step().unwrap();
            }
        }
        // Until what moves has come to rest as far as it does.
        tissues.iter().for_each(|tissue| (0..400).for_each(|_| tissue.borrow_mut().step().unwrap()));
        let awake_points: Vec<usize> = tissues.iter().map(|tissue| tissue.borrow().awake_points()).collect();
        let times_s = step_s(rounds, &tissues);
        let vertices = model.len();
        let rate_hz = model.scene.stepping.rate_hz;
        for (which, what) in ["all awake", "a poke", "a tip", "asleep"].into_iter().enumerate() {
            let time_s = times_s[which];
            rows.push(cells([
                vertices.to_string(),
                what.to_owned(),
                format!("{} × {}, {}", model.plan.substeps, model.plan.integrator.name(), model.precision.name()),
                awake_points[which].to_string(),
                digits(time_s * 1e6),
                digits(100.0 * time_s * rate_hz),
                digits(times_s[0] / time_s),
            ]));
            report.figure(
                &format!("{vertices} {what}"),
                json!({ "step_us": time_s * 1e6, "awake": awake_points[which] }),
            );
        }
    }
    let header = ["vertices", "what", "a step", "awake", "µs a step", "% of a core at 1 kHz", "all awake ÷ this"];
    report.table(&header.map(str::to_owned), &rows);
}

/// A place on top, and its normal.
fn top(model: &Model) -> (DVec3, DVec3) {
    let extent = model.shape().extent();
    let point = model.shape().nearest(extent.middle_m().with_z(extent.most_m.z));
    (model.shape().rest_m(point), model.shape().normal(point))
}

/// The middles of the two lumps of `liver-organ`, and how far each reaches, m.
const LUMPS_M: [(DVec3, f64); 2] =
    [(DVec3::new(-0.040, -0.026, 0.037), 0.014), (DVec3::new(0.030, -0.013, 0.028), 0.010)];

/// Held vertices so far from a disc stiffen what it feels, m.
const NEAR_M: f64 = 0.005;

/// Stiffness of a slow press of 2 mm along a line over the larger lump.
fn across_a_lump(report: &mut BenchReport, model: &Arc<Model>) -> Panel {
    report.heading("Only the lumps are stiffer: a press across a lump");
    report.say("Force of a slow press of `liver-organ`, 1 and 2 mm deep, along a line across its larger lump.");
    let lump_m = LUMPS_M[0].0;
    let places: Vec<f64> = (-12..=12).map(|k| 2.5e-3 * f64::from(k)).collect();
    let forces: Vec<[f64; 2]> = places
        .iter()
        .map(|along_m| {
            let pressed = tangent::press(model, TIP.radius_m, lump_m + DVec3::X * *along_m, 0.001, 3);
            [pressed[1].force_n, pressed[2].force_n]
        })
        .collect();
    let rows: Vec<_> = places
        .iter()
        .zip(&forces)
        .map(|(along_m, [one, two])| cells([digits(along_m * 1e3), digits(1e3 * one), digits(1e3 * two)]))
        .collect();
    report.table(&["mm from the lump's middle", "mN at 1 mm", "mN at 2 mm"].map(str::to_owned), &rows);
    let series = [0, 1].map(|depth| Series {
        name: format!("{} mm deep", depth + 1),
        hue: depth,
        look: Look::Full,
        points: places.iter().zip(&forces).map(|(along_m, forces)| (along_m * 1e3, forces[depth] * 1e3)).collect(),
    });
    let most = forces.iter().map(|forces| 1e3 * forces[1]).fold(0.0, f64::max);
    Panel::Curves {
        title: "Force of a press across a lump".to_owned(),
        x: "mm from the lump's middle",
        y: "mN",
        up: 0.0..1.1 * most,
        series: series.into(),
    }
}

/// Stiffness of a slow press of 1 mm all over the organ, seen from above. Places are `apart_m` or more from each
/// other.
fn map(report: &mut BenchReport, model: &Arc<Model>) -> Panel {
    report.heading("Only the lumps are stiffer: the whole organ");
    let apart_m: f64 = if quick() { 0.012 } else { 0.004 };
    let shape = model.shape();
    let mut chosen: Vec<DVec3> = Vec::new();
    for point in points(shape).filter(|point| shape.normal(*point).z > 0.3 && !shape.is_fixed(*point)) {
        let place_m = shape.rest_m(point);
        if chosen.iter().all(|other_m| other_m.distance(place_m) >= apart_m) {
            chosen.push(place_m);
        }
    }
    let stiffness = |place_m: &DVec3| tangent::press(model, TIP.radius_m, *place_m, 0.001, 2)[1].force_n / 0.001;
    let felt: Vec<(DVec3, f64)> = chosen.iter().map(|place_m| (*place_m, stiffness(place_m))).collect();
    let held_m: Vec<DVec3> = points(shape).filter(|at| shape.is_fixed(*at)).map(|at| shape.rest_m(at)).collect();
    let kind = |place_m: DVec3| {
        let reaches = |other_m: DVec3, reach_m: f64| place_m.distance(other_m) < reach_m + TIP.radius_m;
        let lump = LUMPS_M.iter().position(|(lump_m, reach_m)| reaches(*lump_m, *reach_m));
        let is_held = || held_m.iter().any(|held_m| reaches(*held_m, NEAR_M));
        lump.map_or_else(|| if is_held() { 3 } else { 0 }, |lump| lump + 1)
    };
    let kinds: Vec<usize> = chosen.iter().map(|place_m| kind(*place_m)).collect();
    let rows: Vec<_> = ["elsewhere", "over the larger lump", "over the smaller lump", "near where it is held"]
        .into_iter()
        .enumerate()
        .map(|(which, name)| {
            let of_kind = felt.iter().zip(&kinds).filter(|(_, kind)| **kind == which);
            let mut values: Vec<f64> = of_kind.map(|(place, _)| place.1).collect();
            values.sort_by(f64::total_cmp);
            let at = |part: f64| values[((values.len() - 1) as f64 * part).round() as usize];
            let numbers = [0.0, 0.05, 0.5, 0.95, 1.0].map(at);
            report.figure(name, json!({ "places": values.len(), "stiffness_n_per_m": numbers }));
            [name.to_owned(), values.len().to_string()].into_iter().chain(numbers.map(digits)).collect()
        })
        .collect();
    report.say(
        "Stiffness of a slow press of 1 mm (force divided by depth), N/m, at all places where the organ faces up and is not \
         fixed: minimum, 5 %, median, 95 %, maximum. A place is over a lump if the disc reaches the lump or its soft edge. It \
         is near the fixed part if vertices that never move are within 5 mm of the disc.",
    );
    let header = ["where", "places", "least", "5 %", "median", "95 %", "most"];
    report.table(&header.map(str::to_owned), &rows);
    Panel::Places {
        title: "Stiffness all over the organ, from above".to_owned(),
        unit: "mm",
        value: "N/m",
        size: 1.3e3 * apart_m,
        places: felt.iter().map(|(place_m, stiffness)| [1e3 * place_m.x, 1e3 * place_m.y, *stiffness]).collect(),
    }
}

/// A square of `size_m` with edges of about `edge_m`, its vertices moved by up to `jitter` edges, as an OBJ file in
/// metres.
fn jittered(edge_m: f64, size_m: f64, jitter: f64) -> String {
    let mut dice = fastrand::Rng::with_seed(8);
    let count = |of_edge: f64| (size_m / of_edge).round() as u32;
    let (rows, columns) = (count(0.75_f64.sqrt() * edge_m), count(edge_m));
    let mut text = String::new();
    for i in 0..=rows {
        for j in 0..=columns {
            let on_rim = i == 0 || j == 0 || i == rows || j == columns;
            let mut moved = || if on_rim { 0.0 } else { jitter * (2.0 * dice.f64() - 1.0) };
            let x = edge_m * (f64::from(i) * 0.75_f64.sqrt() + moved());
            let y = edge_m * (f64::from(j) + 0.5 * f64::from(i % 2) + moved());
            text += &format!("v {x} {y} 0\n");
        }
    }
    for i in 0..rows {
        for j in 0..columns {
            let at = |i: u32, j: u32| i * (columns + 1) + j + 1;
            let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i, j + 1), at(i + 1, j + 1)];
            let of_cell = if i % 2 == 0 { [[a, b, c], [b, d, c]] } else { [[a, b, d], [a, d, c]] };
            of_cell.iter().for_each(|[a, b, c]| text += &format!("f {a} {b} {c}\n"));
        }
    }
    text
}

/// Flat tissue of the liver's material on such a square.
fn flat(edge_m: f64) -> Arc<Model> {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("flat.obj"), jittered(edge_m, 0.14, 0.25)).unwrap();
    let scene = r#"
        name = "flat"
        mesh = { file = "flat.obj", unit = "m", fixed = "rim" }
        stepping = { tolerance = 1e-4 }
        [material]
        youngs_modulus_pa = 8000.0
        thickness_m = 0.01
        depth_m = 0.03
        foundation_n_per_m3 = 1.34e6
        damping_ratio = 0.5
        [springs]
        bending = 0.1
    "#;
    let path = folder.path().join("flat.toml");
    std::fs::write(&path, scene).unwrap();
    Model::compile(&Scene::load(&path, &[], &Limits::default()).unwrap(), &Limits::default()).unwrap()
}

/// The mean, and the standard deviation over the mean in per cent.
fn spread(values: &[f64]) -> (f64, f64) {
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let squares = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / values.len() as f64;
    (mean, 100.0 * squares.sqrt() / mean)
}

/// Measures one press at many places between the vertices, and a tip that slides.
fn evenness(report: &mut BenchReport) {
    report.heading("The force does not depend on the place between vertices");
    report.say(
        "Flat tissue of the liver's material on a mesh whose vertices are moved by up to a quarter of an edge. A disc of 5 \
         mm radius is pressed slowly at 20 places: the mean force, and its standard deviation relative to the mean. The same \
         disc slides over 100 mm at a constant depth of 1 mm and 50 mm/s: the standard deviation relative to the mean \
         (ripple), and the largest change from one step to the next.",
    );
    let mut rows = Vec::new();
    let edges: &[f64] = if quick() { &[0.0025] } else { &[0.005, 0.0025, 0.00125] };
    for edge_m in edges {
        let model = flat(*edge_m);
        let mut dice = fastrand::Rng::with_seed(3);
        let mut forces = [Vec::new(), Vec::new()];
        for _ in 0..20 {
            let at_m = DVec3::new(0.06 + 0.02 * dice.f64(), 0.06 + 0.02 * dice.f64(), 0.0);
            let pressed = tangent::press(&model, TIP.radius_m, at_m, 0.0005, 5);
            forces[0].push(pressed[1].force_n);
            forces[1].push(pressed[4].force_n);
        }
        let [(shallow_n, of_shallow), (deep_n, of_deep)] = forces.each_ref().map(|forces| spread(forces));
        let mut tissue = at_rest(&model);
        let (from_m, way_m) = (DVec3::new(0.03, 0.025, -0.001), DVec3::new(0.08, 0.06, 0.0));
        for step in 0..500 {
            tissue.pose(0, from_m + (0.003 - 0.003 * f64::from(step.min(100)) / 100.0) * DVec3::Z, TIP);
            tissue.step().unwrap();
        }
        let (mut slid, mut jump, steps) = (Vec::new(), 0.0_f64, 2000);
        for step in 1..=steps {
            tissue.pose(0, from_m + f64::from(step) / f64::from(steps) * way_m, TIP);
            tissue.step().unwrap();
            let force_n = tissue.tool_contact(0).unwrap().force_on_tool_n.z;
            if step > 200 {
                jump = slid.last().map_or(0.0, |last: &f64| (force_n / last - 1.0).abs()).max(jump);
                slid.push(force_n);
            }
        }
        let (_, ripple) = spread(&slid);
        report.figure(
            &format!("{edge_m}"),
            json!({ "spread_percent": [of_shallow, of_deep], "force_n": [shallow_n, deep_n], "ripple_percent": ripple, "jump": jump }),
        );
        let numbers = [1e3 * edge_m, 1e3 * shallow_n, of_shallow, 1e3 * deep_n, of_deep, ripple, 100.0 * jump];
        rows.push(numbers.map(digits).to_vec());
    }
    let header = ["edge, mm", "mN at 0.5 mm", "± %", "mN at 2 mm", "± %", "ripple, %", "largest jump, %"];
    report.table(&header.map(str::to_owned), &rows);
}
