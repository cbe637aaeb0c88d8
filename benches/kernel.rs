//! The time of a step for every width of the kernel, number format and size, compared with the limits of the machine
//! and with implementations in NumPy, numba or Taichi. Writes docs/benchmarks/kernel.{md,svg}. The peers run if
//! PEERS names a Python that has them, as `make bench-kernel` ensures. `-- --quick` measures two sizes once.

#![allow(
    clippy::unwrap_used,
    clippy::disallowed_methods,
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    missing_docs
)]

mod peers;
mod report;
mod subject;

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

use glam::DVec3;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::{Push, Tissue, at_rest};
use report::chart::{Look, Panel, Series};
use report::{BenchReport, digits, quick, seconds};
use serde_json::{Value, json};
use subject::{INTEGRATOR, LANE_NAMES, LANES, PRECISION, PRECISIONS, known, set};

/// Additions, multiplications and fused multiply-adds of 16 lanes per point, the operations of the measured chain.
/// Comparisons, masks and shifts of lanes are not counted: some processors have other units for them. For each of its 4
/// springs: 3 for the difference, ½ along the spring, 4 for the square, 7 for a polynomial of degree 5, 3 for the
/// force, 5¼ to add it to both ends. For each of its 3 components: 4 for anchor spring, damping, the sum, and the
/// check of all.
const OPERATIONS_PER_POINT: f64 = (4.0 * 22.75 + 3.0 * 4.0) / 16.0;

/// Long enough for the clock, and short enough to fall between the machine's other activities.
const WINDOW_S: f64 = 3e-3;
/// Total length of the windows of one kernel in a round, if they are at least 5.
const WINDOWS_S: f64 = 0.15;

/// The windows of each round, by subject and side of the sheet.
type Rounds = BTreeMap<(String, usize), Vec<Windows>>;

/// Statistics of many windows, ns per point and step.
#[derive(Clone, Copy)]
struct Windows {
    least_ns: f64,
    median_ns: f64,
}

/// A sheet in motion everywhere: pushed like the paper's within a few points, and also pushed too weakly to matter as
/// far as the edge, so that all numbers are in the normal range.
fn tissue(settings: &[String], side: usize) -> Box<dyn Tissue> {
    let size = set("sheet.points", format!("[{side}, {side}]"));
    let settings: Vec<String> = settings.iter().cloned().chain([size, set("stepping.substeps", 1)]).collect();
    let model = subject::model(&settings).unwrap();
    let spacing_m = model.scene.sheet().unwrap().spacing_m;
    let mut tissue = at_rest(&model);
    let pushes = [(1.0, 0.5 / spacing_m), (0.01, 4.0 / (spacing_m * side as f64))];
    for (tool, (strength, falloff_per_m)) in pushes.into_iter().enumerate() {
        let push = Poke {
            point: None,
            centre_m: model.shape().rest_m(model.scene.sheet().unwrap().point([side / 2; 2])),
            force_n: strength * DVec3::new(0.03, 0.0, -0.1),
            falloff_per_m,
            falloff_offset: 0.0,
        };
        tissue.push(tool, Some(Push::Constant(push)));
    }
    tissue
}

fn measure(settings: &[String], side: usize) -> Windows {
    let mut tissue = tissue(settings, side);
    let mut run = |steps: usize| seconds(|| (0..steps).for_each(|_| tissue.step().unwrap())).0;
    // Sets it in motion. Few steps, because the slowest kernels on the largest sheets take long.
    let step_s = run(4) / 4.0;
    run((WINDOWS_S / step_s).min(50.0) as usize);
    let steps = ((WINDOW_S / step_s) as usize).max(1);
    let count = (WINDOWS_S / (steps as f64 * step_s)).clamp(5.0, 100.0) as usize;
    let windows = (0..count).map(|_| run(steps) * 1e9 / (steps * side * side) as f64);
    let mut windows: Vec<f64> = windows.collect();
    windows.sort_by(f64::total_cmp);
    Windows { least_ns: windows[0], median_ns: windows[count / 2] }
}

/// Settings of every kernel, by name.
fn kernels() -> Vec<(String, Vec<String>)> {
    let lanes: Vec<Option<&str>> = match known(LANES, &LANE_NAMES).as_slice() {
        [] => vec![None],
        names => names.iter().copied().map(Some).collect(),
    };
    let mut kernels = Vec::new();
    for integrator in known(INTEGRATOR, &["central", "exponential3"]) {
        for precision in PRECISIONS {
            for lane in &lanes {
                let mut settings = vec![set(INTEGRATOR, integrator), set(PRECISION, precision)];
                settings.extend(lane.map(|lane| set(LANES, lane)));
                let name = [integrator, precision, lane.unwrap_or("")].join(" ");
                kernels.push((name.trim_end().to_owned(), settings));
            }
        }
    }
    kernels
}

/// Compiles the limits for this processor, and measures them.
fn machine_limits(sides: &[usize]) -> Option<Value> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let program = root.join("target/machine-limits");
    let compiler = std::env::var("RUSTC").unwrap_or_else(|_| "rustc".to_owned());
    let mut compile = Command::new(compiler);
    compile.args(["-O", "--edition", "2024", "-C", "target-cpu=native", "-o"]).arg(&program);
    compile.arg(root.join("benches/machine/limits.rs"));
    if !compile.status().is_ok_and(|status| status.success()) {
        eprintln!("left out: the machine's limits, which rustc has to compile");
        return None;
    }
    let output = Command::new(&program).args(sides.iter().map(ToString::to_string)).output().unwrap();
    serde_json::from_slice(&output.stdout).ok()
}

/// Runs `rounds` rounds in which the kernels, the peers and the limits take turns.
fn measure_all(rounds: usize, sides: &[usize], kernels: &[(String, Vec<String>)]) -> (Rounds, Vec<Value>) {
    let python = peers::python();
    let mut measured = Rounds::new();
    let mut limits = Vec::new();
    for round in 1..=rounds {
        for &side in sides {
            eprintln!("round {round} of {rounds}: {side} × {side} points");
            for (name, settings) in kernels {
                measured.entry((name.clone(), side)).or_default().push(measure(settings, side));
            }
        }
        for script in ["numba_sheet.py", "taichi_sheet.py", "numpy_sheet.py"] {
            let Some(python) = &python else { continue };
            eprintln!("round {round} of {rounds}: {script}");
            let sides: Vec<String> = sides.iter().map(ToString::to_string).collect();
            for line in peers::lines(python, script, &sides) {
                let key = (line["peer"].as_str().unwrap().to_owned(), line["side"].as_u64().unwrap() as usize);
                let [least_ns, median_ns] = ["least_ns", "median_ns"].map(|name| line[name].as_f64().unwrap());
                measured.entry(key).or_default().push(Windows { least_ns, median_ns });
            }
        }
        limits.extend(machine_limits(sides));
    }
    (measured, limits)
}

/// The least of all rounds.
fn least(rounds: &[Windows]) -> f64 {
    rounds.iter().map(|windows| windows.least_ns).fold(f64::INFINITY, f64::min)
}

/// The median of the rounds' medians.
fn median(rounds: &[Windows]) -> f64 {
    let mut sorted: Vec<f64> = rounds.iter().map(|windows| windows.median_ns).collect();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() / 2]
}

fn main() {
    let (rounds, sides): (_, &[usize]) = if quick() { (1, &[31, 121]) } else { (3, &[15, 31, 61, 121, 331, 1001]) };
    let kernels = kernels();
    let (measured, limits) = measure_all(rounds, sides, &kernels);
    let of = |name: &str, side: usize| measured.get(&(name.to_owned(), side)).map(Vec::as_slice);
    let mut names: Vec<String> = kernels.into_iter().map(|(name, _)| name).collect();
    let peers = ["numba", "Taichi", "NumPy"].map(str::to_owned);
    let peers: Vec<String> = peers.into_iter().filter(|peer| of(peer, sides[0]).is_some()).collect();
    let product: Vec<String> = names.iter().filter(|name| name.starts_with("central f32")).cloned().collect();
    names.extend(peers.iter().cloned());
    let product_ns =
        |side: usize| product.iter().map(|name| least(of(name, side).unwrap())).fold(f64::INFINITY, f64::min);

    // The best result of the machine in any round.
    let best = |read: &dyn Fn(&Value) -> Option<f64>| limits.iter().filter_map(read).reduce(f64::min);
    let arithmetic_ns = best(&|limit| limit["fma_of_16_lanes_ns"].as_f64()).map(|ns| ns * OPERATIONS_PER_POINT);
    let memory_ns = |side: usize| best(&|limit| limit["traffic_ns_per_point"][side.to_string()].as_f64());
    let clock_ghz = limits.iter().filter_map(|limit| limit["clock_ghz"].as_f64()).reduce(f64::max);

    let mut report = BenchReport::new("kernel", "The time of a step", "make bench-kernel");
    report.say(
        "Time per point and substep, ns, with one substep per step, on one thread, for whole steps (applied force, checks, \
         checkpoints): the shortest of many windows of about 3 ms in several rounds, and in brackets the median of the \
         rounds. The sheet is the paper's tissue, pushed at its centre so that all of it moves. The peers do the same \
         arithmetic on the same tissue (benches/peers), without checks.",
    );
    let mut header = vec!["points".to_owned()];
    header.extend(sides.iter().map(|side| format!("{side}²")));
    let row = |name: &str, cell: &dyn Fn(usize) -> Option<String>| {
        let cells = sides.iter().map(|side| cell(*side).unwrap_or_else(|| "–".to_owned()));
        std::iter::once(name.to_owned()).chain(cells).collect::<Vec<_>>()
    };
    let time = |name: &str, side: usize| {
        of(name, side).map(|rounds| format!("{} ({})", digits(least(rounds)), digits(median(rounds))))
    };
    let mut rows: Vec<_> = names.iter().map(|name| row(name, &|side| time(name, side))).collect();
    rows.push(row("arithmetic limit, 16 lanes", &|_| arithmetic_ns.map(digits)));
    rows.push(row("memory limit, f32", &|side| memory_ns(side).map(digits)));
    report.table(&header, &rows);
    report.say(&format!(
        "The limits, from the same run: the arithmetic limit is {OPERATIONS_PER_POINT:.1} sums and products of 16 lanes per \
         point (counted in benches/kernel.rs, without comparisons and masks, for which some processors have other units) at \
         the machine's rate of multiplications and additions; the memory limit is the time to read and write back 6 arrays of \
         f32. Clock, from a chain of multiplications: {} GHz.",
        clock_ghz.map_or("?".to_owned(), digits)
    ));
    if !peers.is_empty() {
        report.heading("How many times faster");
        report.say("The peer's shortest time divided by that of the fastest `central f32`.");
        let ratio = |peer: &str, side: usize| of(peer, side).map(|rounds| digits(least(rounds) / product_ns(side)));
        let rows: Vec<_> = peers.iter().map(|peer| row(peer, &|side| ratio(peer, side))).collect();
        report.table(&header, &rows);
    }

    let figures = measured.iter().map(|((name, side), rounds)| {
        json!({"name": name, "side": side, "least_ns": least(rounds), "median_ns": median(rounds)})
    });
    report.figure("ns_per_point_substep", figures.collect());
    report.figure("limits", json!({"operations_of_16_lanes_per_point": OPERATIONS_PER_POINT, "rounds": limits}));

    let line = |name: &str, hue: usize, look: Look, ns: &dyn Fn(usize) -> Option<f64>| Series {
        name: name.to_owned(),
        hue,
        look,
        points: sides.iter().filter_map(|side| Some(((side * side) as f64, ns(*side)?))).collect(),
    };
    let mut series = vec![
        line("arithmetic limit", 2, Look::Broad, &|_| arithmetic_ns),
        line("memory limit", 6, Look::Broad, &memory_ns),
    ];
    // One colour for both number formats.
    let mut families: Vec<String> = Vec::new();
    for name in &names {
        let family = PRECISIONS.iter().fold(name.clone(), |name, precision| name.replace(precision, ""));
        let hue = families.iter().position(|other| *other == family).unwrap_or_else(|| {
            families.push(family);
            families.len() - 1
        });
        let look = if name.contains("f64") { Look::Hollow } else { Look::Full };
        series.push(line(name, hue, look, &|side| of(name, side).map(least)));
    }
    let panel = Panel::Lines {
        title: "The time of a step".to_owned(),
        x: "points of the sheet",
        y: "ns a point and substep",
        series,
    };
    report.say(&format!("Rounds: {rounds}. Python: the versions of benches/peers/requirements.txt."));
    report.write(1, &[panel]);
}
