//! Time saved by sleep, and its cost in accuracy. Sizes, springs and kinds of poke against the tolerance of
//! `[sleep]`; the truth is the same run with everything awake. Writes docs/benchmarks/skip.{md,svg}. `-- --quick`
//! measures the small sheets.

#![allow(clippy::unwrap_used, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]

mod report;
mod subject;

use glam::DVec3;
use palpate_tissue::scene::profile::{CentreProfile, LoadProfile, Profile, StrengthProfile};
use palpate_tissue::{Push, at_rest};
use report::chart::{Look, Panel, Series};
use report::{BenchReport, cells, digits, quick, rough, seconds};
use serde_json::json;
use subject::set;

const TOLERANCES: [f64; 4] = [1e-3, 1e-4, 1e-5, 1e-6];
const STEPS: u64 = 2000;
/// Steps between two records of the whole field.
const LOOK_STEPS: u64 = 50;

/// The forces on a sheet of side `length_m`, at 1 kHz.
struct LoadCase {
    name: &'static str,
    about: &'static str,
    pushes: fn(length_m: f64) -> Vec<LoadProfile>,
}

/// The place at a part of the diagonal.
fn at(length_m: f64, part: f64) -> DVec3 {
    DVec3::new(length_m * part, length_m * part, 0.0)
}

/// The paper's poke: 3 N, 150 /m, released after a second.
fn poke(centre_m: DVec3, force_n: DVec3) -> LoadProfile {
    LoadProfile {
        centre: CentreProfile::Hops(vec![(0, centre_m)]),
        strength: StrengthProfile::Scaled(force_n, Profile::Pulse { on: 0, off: 1000 }),
        falloff_per_m: 150.0,
        falloff_offset: 0.0,
    }
}

const KINDS: [LoadCase; 4] = [
    LoadCase {
        name: "local",
        about: "3 N straight down at the centre for 1 s, then released",
        pushes: |length_m| vec![poke(at(length_m, 0.5), DVec3::new(0.0, 0.0, -3.0))],
    },
    LoadCase {
        name: "stroke",
        about: "1 N at a slant that moves along y at 0.2 m/s, all the time",
        pushes: |length_m| {
            vec![LoadProfile {
                centre: CentreProfile::Path {
                    from_m: DVec3::new(length_m / 2.0, length_m / 2.0 - 0.2, 0.0),
                    velocity_m_per_s: DVec3::new(0.0, 0.2, 0.0),
                },
                strength: StrengthProfile::Scaled(DVec3::new(0.2, 0.3, -1.0), Profile::Constant),
                falloff_per_m: 60.0,
                falloff_offset: 0.0,
            }]
        },
    },
    LoadCase {
        name: "two tools",
        about: "3 N at a third and at two thirds of the diagonal for 1 s, at a slant and straight down",
        pushes: |length_m| {
            vec![
                poke(at(length_m, 1.0 / 3.0), DVec3::new(0.0, 0.0, -3.0)),
                poke(at(length_m, 2.0 / 3.0), DVec3::new(1.0, 1.0, -2.6)),
            ]
        },
    },
    LoadCase {
        name: "everything",
        about: "a force on all points that swings at 3 Hz, all the time",
        pushes: |length_m| {
            vec![LoadProfile {
                centre: CentreProfile::Hops(vec![(0, at(length_m, 0.5))]),
                strength: StrengthProfile::Scaled(DVec3::new(0.01, 0.0, -0.05), Profile::Sine { frequency_hz: 3.0 }),
                falloff_per_m: 1.0 / length_m,
                falloff_offset: 0.0,
            }]
        },
    },
];

/// A run: the mean time of a step, the computed fraction, and the recorded fields.
struct SkipRun {
    step_s: f64,
    computed: f64,
    fields: Vec<[Vec<f32>; 3]>,
}

fn run(settings: &[String], kind: &LoadCase, rounds: usize) -> SkipRun {
    let model = subject::model(settings).unwrap();
    let length_m = model.shape().longest_side_m();
    let (mut least_s, mut fields, mut computed) = (f64::INFINITY, Vec::new(), 0.0);
    for _ in 0..rounds {
        let mut tissue = at_rest(&model);
        for (tool, profile) in (kind.pushes)(length_m).into_iter().enumerate() {
            tissue.push(tool, Some(Push::Profile(profile)));
        }
        fields.clear();
        let mut stepping_s = 0.0;
        for _ in 0..STEPS / LOOK_STEPS {
            stepping_s += seconds(|| (0..LOOK_STEPS).for_each(|_| tissue.step().unwrap())).0;
            let mut field = [Vec::new(), Vec::new(), Vec::new()];
            tissue.displacements_m(&mut field);
            fields.push(field);
        }
        least_s = least_s.min(stepping_s);
        computed = tissue.computed_fraction();
    }
    SkipRun { step_s: least_s / STEPS as f64, computed, fields }
}

/// Bound for the time of a step with a part of the points awake: 1.1 times the cost of those points in a step with all
/// awake, plus 1 µs.
fn bound_s(all_awake_s: f64, computed: f64) -> f64 {
    1.1 * computed * all_awake_s + 1e-6
}

/// The largest component anywhere at any time, and the largest difference.
fn compare(truth: &SkipRun, other: &SkipRun) -> [f64; 2] {
    let mut most = [0.0_f64; 2];
    for (truth, other) in truth.fields.iter().flatten().zip(other.fields.iter().flatten()) {
        for (a, b) in truth.iter().zip(other) {
            most = [most[0].max(f64::from(a.abs())), most[1].max(f64::from((a - b).abs()))];
        }
    }
    most
}

fn main() {
    let sides: &[usize] = if quick() { &[31, 121] } else { &[31, 121, 331, 1001] };
    let mut report = BenchReport::new("skip", "Time saved by skipping tissue at rest", "make bench-skip");
    report.say(
        "Two seconds at 1 kHz of the paper's tissue (K″ = 5 N/m) with more points and stiffer springs. Each cell contains \
         the speed-up of the steps over a run with everything awake, and the error: the largest difference from that run of \
         any point at any of 40 moments, relative to the largest displacement.",
    );
    report.say(
        "The last figure of each cell is cost ÷ bound, where the bound is 1.1 × the number of computed points × the cost of \
         a point with everything awake, plus 1 µs. Above 1, part of the time is not spent on moving points.",
    );
    for kind in &KINDS {
        report.say(&format!("*{}*: {}.", kind.name, kind.about));
    }
    let header: Vec<String> = ["poke", "k/K″", "points", "all awake, µs a step"]
        .into_iter()
        .map(str::to_owned)
        .chain(
            TOLERANCES
                .iter()
                .map(|tolerance| format!("{tolerance:.0e}: times faster, error, part computed, cost over bound")),
        )
        .collect();
    let (mut rows, mut figures) = (Vec::new(), Vec::new());
    let mut series: Vec<Series> = Vec::new();
    for (hue, kind) in KINDS.iter().enumerate() {
        for ratio in [2.0, 20.0, 200.0] {
            let mut line = Vec::new();
            for side in sides {
                // The largest sheets of stiff springs show nothing that smaller ones don't.
                if *side > 500 && ratio > 20.0 {
                    continue;
                }
                eprintln!("{}, k/K″ = {ratio}, {side} × {side} points", kind.name);
                let rounds = if *side > 200 { 1 } else { 5 };
                let with = |tolerance: f64| {
                    let settings = [
                        set("sheet.points", format!("[{side}, {side}]")),
                        set("springs.stiffness_n_per_m", 5.0 * ratio),
                        set("sleep.tolerance", tolerance),
                    ];
                    run(&settings, kind, rounds)
                };
                let truth = with(0.0);
                let mut row = cells([kind.name.to_owned(), ratio.to_string(), format!("{side}²")]);
                row.push(digits(truth.step_s * 1e6));
                for tolerance in TOLERANCES {
                    let skipping = with(tolerance);
                    let [largest, difference] = compare(&truth, &skipping);
                    let (faster, error) = (truth.step_s / skipping.step_s, difference / largest);
                    let over_bound = skipping.step_s / bound_s(truth.step_s, skipping.computed);
                    row.push(format!(
                        "{}, {}, {}, {over_bound:.2}",
                        digits(faster),
                        rough(error),
                        digits(skipping.computed)
                    ));
                    if tolerance == 1e-6 {
                        line.push(((side * side) as f64, faster));
                    }
                    figures.push(json!({
                        "poke": kind.name, "ratio": ratio, "side": side, "tolerance": tolerance, "times_faster": faster,
                        "error": error, "computed_fraction": skipping.computed, "all_awake_s": truth.step_s,
                        "cost_over_bound": over_bound,
                    }));
                }
                rows.push(row);
            }
            let look = if ratio > 100.0 { Look::Hollow } else { Look::Full };
            if ratio != 20.0 {
                series.push(Series { name: format!("{}, k/K″ = {ratio}", kind.name), hue, look, points: line });
            }
        }
    }
    report.table(&header, &rows);
    report.figure("runs", figures.into());
    let panel = Panel::Lines {
        title: "With a tolerance of 1e-6".to_owned(),
        x: "points of the sheet",
        y: "times faster than all awake",
        series,
    };
    report.write(1, &[panel]);
}
