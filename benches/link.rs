//! Touch over a network, in virtual time: the accuracy, stability and passivity of the force on a simulated hand, by
//! delay, tissue, hand, network and scheme. It first compares two results with theory: the delay at which hand and
//! spring become unstable, and the stiffness of the tissues under a disc (a flat punch). Runs `palpate-client link`,
//! as a user can.

#![allow(clippy::unwrap_used, clippy::panic, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]

mod links;
#[path = "../tests/common/proxy.rs"]
mod proxy;
mod report;
#[path = "../tests/common/server.rs"]
mod server;

use links::{by_seed, link, links, number};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::response::tangent;
use palpate_tissue::scene::{BUILT_IN, Scene};
use report::chart::{Look, Panel, Series};
use report::{BenchReport, cells, digits, quick, rough};
use serde_json::{Value, json};

const SCHEMES: [&str; 3] = ["model", "hold", "raw"];
const ROUND_TRIPS_MS: [f64; 7] = [0.5, 2.0, 10.0, 20.0, 50.0, 100.0, 200.0];

/// Merges several seeds: means, and the worst case where a mean says little.
fn merged(runs: &[Value], name: &str) -> f64 {
    let values = runs.iter().map(|run| number(&run[name]));
    match name {
        "energy_min_j" => values.fold(f64::INFINITY, f64::min),
        "jump_max_n" | "peak_ratio" | "model_age_ms_p99" => values.fold(0.0, f64::max),
        _ => values.sum::<f64>() / runs.len() as f64,
    }
}

const COLUMNS: [(&str, &str); 11] = [
    ("scale", "scale"),
    ("force error, % RMS", "force_error_rms_percent"),
    ("p99, N", "force_error_p99_n"),
    ("least energy, J", "energy_min_j"),
    ("largest jump, N", "jump_max_n"),
    ("guard acts, share of ticks in contact", "guard_share"),
    ("rendered / true", "rendered_share"),
    ("peak / true peak", "peak_ratio"),
    ("model age p99, ms", "model_age_ms_p99"),
    ("packets a second", "packets_per_s"),
    ("kbit/s", "kbit_per_s"),
];

fn row(label: &[String], runs: &[Value]) -> Vec<String> {
    let unstable = runs.iter().filter(|run| run["unstable"] == true).count();
    let mut row = label.to_vec();
    row.push(if unstable > 0 { format!("in {unstable} of {}", runs.len()) } else { "–".to_owned() });
    row.extend(COLUMNS.iter().map(|(_, name)| match *name {
        "energy_min_j" => rough(merged(runs, name)),
        _ => digits(merged(runs, name)),
    }));
    row
}

fn header(label: &[&str]) -> Vec<String> {
    let mut header = cells(label);
    header.push("unstable".to_owned());
    header.extend(COLUMNS.iter().map(|(title, _)| (*title).to_owned()));
    header
}

fn main() {
    let seeds: u64 = if quick() { 1 } else { 3 };
    let mut report = BenchReport::new("link", "Touch over a network", "make bench-link");
    report.say(
        "Simulated hands, devices and networks, in virtual time (`palpate-client link --help`). Runs last 20 s; the figures \
         are means over the seeds 1 to 3, but the worst of the three for energies, jumps, peaks and ages. `raw` renders the \
         newest force unchanged, `hold` renders it within the safety envelope, and `model` renders the local model along the \
         tool's own path within the envelope. Negative energy was given off by the device's port. The depths of a task are \
         scaled, with the same factor for all schemes, so that a hand that touches the tissue directly (no network, no \
         client) meets at most 0.8 of the device's force: the column `scale`. The figures of a run that became unstable cover \
         the time until then.",
    );
    report.say(
        "**The place.** Tasks stay within 1 cm of the middle of the sheet, unless a table says otherwise. The force law \
         follows the tool, but near a fixed rim the force also changes along the tool's path, and the rim pulls a pressed tip \
         aside. Models do not include this, so errors are larger there ([at a rim](rim.md)).",
    );
    boundary(&mut report);
    stiffness(&mut report);
    // The only runs that the machine's load disturbs come early: the rest is virtual time, and may share the machine.
    live(&mut report);
    let panels = delays(&mut report, seeds);
    others(&mut report, seeds);
    lossy(&mut report, seeds);
    places(&mut report, seeds);
    organs(&mut report, seeds);
    random(&mut report);
    report.write(3, &panels);
}

fn boundary(report: &mut BenchReport) {
    let found = link("--boundary");
    let rows = found.as_array().unwrap();
    let apart = |row: &Value| (number(&row["predicted_ms"]) - number(&row["observed_ms"])).abs();
    let most = rows.iter().map(apart).fold(0.0, f64::max);
    report.heading("The delay at which hand and spring become unstable");
    report.say(&format!(
        "The prediction is the solution of m·s² + b·s + k + K·e^(−s·t) = 0. The observation is from the loop of `link` with \
         a spring in place of the tissue: {} combinations, which differ by at most {} ms.",
        rows.len(),
        digits(most)
    ));
    let table: Vec<_> = rows
        .iter()
        .map(|row| {
            let hand = row["hand"].as_str().unwrap().to_owned();
            let numbers = ["stiffness_n_per_m", "predicted_ms", "observed_ms"];
            let numbers = numbers.map(|name| digits(number(&row[name])));
            std::iter::once(hand).chain(numbers).collect()
        })
        .collect();
    report.table(&cells(["hand", "K, N/m", "predicted, ms", "observed, ms"]), &table);
    report.figure("boundary", found);
}

fn stiffness(report: &mut BenchReport) {
    report.heading("Stiffness under a disc, by spacing");
    report.say(
        "Force divided by depth, N/m, in a slow press by a disc of 5 mm radius. The same tissue on finer grids, with the \
         disc at three places of a cell (on a point, at a quarter, in the middle). The last column is a flat punch on a \
         half-space of the same material without hardening, 2aE/(1 − ν²).",
    );
    let punches = [("liver", 5400.0), ("stomach", 1920.0), ("fibrotic", 26_900.0)];
    let (mut rows, mut figures) = (Vec::new(), Vec::new());
    for (name, young_pa) in punches {
        let text = BUILT_IN.iter().find(|scene| scene.0 == name).unwrap().1;
        let base = Scene::parse(name, text, &[], &Limits::default()).unwrap();
        let spacings = if quick() { &[0.01, 0.005, 0.0025][..] } else { &[0.01, 0.005, 0.0025, 0.00125] };
        for &spacing_m in spacings {
            let share = (spacing_m / base.sheet().unwrap().spacing_m).powi(2);
            let points = (0.08 / spacing_m).round() as usize + 1;
            let mut scene = base.clone();
            scene.sheet_mut().unwrap().points = [points; 2];
            scene.sheet_mut().unwrap().spacing_m = spacing_m;
            scene.sheet_mut().unwrap().point_mass_kg *= share;
            scene.anchor_stiffness_n_per_m *= share;
            scene.damping_n_s_per_m *= share;
            let model = Model::compile(&scene, &Limits::default()).unwrap();
            let places = [0.0, 0.25, 0.5].map(|part| {
                let centre_m =
                    scene.shape().extent().middle_m() + glam::DVec3::new(part * spacing_m, part * spacing_m, 0.0);
                let pressed = tangent::press(&model, 0.005, centre_m, 0.0005, 3);
                [1, 2].map(|row: usize| pressed[row].force_n / pressed[row].depth_m)
            });
            let cell = |depth: usize| places.map(|place| digits(place[depth])).join(" / ");
            let punch = 2.0 * 0.005 * young_pa / (1.0 - 0.49 * 0.49);
            rows.push(cells([name.to_owned(), digits(1e3 * spacing_m), cell(0), cell(1), digits(punch)]));
            figures
                .push(json!({"scene": name, "spacing_m": spacing_m, "n_per_m": places, "flat_punch_n_per_m": punch}));
        }
    }
    report.table(&cells(["tissue", "spacing, mm", "at 0.5 mm", "at 1 mm", "flat punch"]), &rows);
    report.figure("stiffness", Value::Array(figures));
}

/// The main table: error by delay.
fn delays(report: &mut BenchReport, seeds: u64) -> Vec<Panel> {
    report.heading("By delay: medium hand, omega3");
    let scenes = ["liver", "fibrotic", "stomach"];
    let mut runs = Vec::new();
    for scene in scenes {
        for rtt in ROUND_TRIPS_MS {
            for scheme in SCHEMES {
                for seed in 1..=seeds {
                    runs.push(format!("--scene {scene} --rtt-ms {rtt} --scheme {scheme} --seed {seed}"));
                }
            }
        }
    }
    let found = links(&runs);
    let mut groups = found.chunks(seeds as usize);
    let (mut rows, mut panels) = (Vec::new(), Vec::new());
    for scene in scenes {
        let mut series = SCHEMES.map(|scheme| Series {
            name: scheme.to_owned(),
            hue: SCHEMES.iter().position(|other| *other == scheme).unwrap(),
            look: if scheme == "model" { Look::Full } else { Look::Hollow },
            points: Vec::new(),
        });
        for rtt in ROUND_TRIPS_MS {
            for (series, scheme) in series.iter_mut().zip(SCHEMES) {
                let runs = groups.next().unwrap();
                rows.push(row(&cells([scene.to_owned(), digits(rtt), scheme.to_owned()]), runs));
                series.points.push((rtt, merged(runs, "force_error_rms_percent")));
            }
        }
        let title = format!("{scene}, medium hand");
        panels.push(Panel::Lines { title, x: "round trip, ms", y: "force error, % RMS", series: series.to_vec() });
    }
    report.table(&header(&["tissue", "round trip, ms", "scheme"]), &rows);
    report.figure("delays", Value::Array(found));
    panels
}

fn others(report: &mut BenchReport, seeds: u64) {
    let table = |report: &mut BenchReport, name: &str, labels: &[&str], runs: Vec<(Vec<String>, String)>| {
        let all: Vec<_> = runs.iter().flat_map(|(_, run)| by_seed(run, seeds)).collect();
        let found = links(&all);
        let rows: Vec<_> =
            runs.iter().zip(found.chunks(seeds as usize)).map(|((label, _), runs)| row(label, runs)).collect();
        report.table(&header(labels), &rows);
        report.figure(name, Value::Array(found));
    };
    report.heading("By network and hand: fibrotic, omega3");
    let mut runs = Vec::new();
    for profile in ["lan", "metro", "wan", "bad-wan"] {
        for hand in ["light", "medium", "firm", "none"] {
            for scheme in SCHEMES {
                let run = format!("--scene fibrotic --profile {profile} --hand {hand} --scheme {scheme}");
                runs.push((cells([profile, hand, scheme]), run));
            }
        }
    }
    table(report, "networks", &["network", "hand", "scheme"], runs);

    report.heading("By device: fibrotic, medium hand, 50 ms");
    let devices = ["touch", "omni", "desktop", "falcon", "omega3", "delta3", "sigma7", "lambda7", "inverse3"];
    let run = |device: &&str| (cells([*device]), format!("--scene fibrotic --rtt-ms 50 --device {device}"));
    table(report, "devices", &["device"], devices.iter().map(run).collect());

    report.heading("Deadband: 2 ms, medium hand, omega3");
    report
        .say("The server sends a sample if the error of the force that the client renders exceeds δ, or after 40 ms.");
    let mut runs = Vec::new();
    for scene in ["liver", "fibrotic", "stomach"] {
        for (scheme, delta) in [("model", 0.0), ("model", 0.1), ("model", 0.2)] {
            let run = format!("--scene {scene} --rtt-ms 2 --scheme {scheme} --deadband {delta}");
            runs.push((cells([scene.to_owned(), scheme.to_owned(), delta.to_string()]), run));
        }
    }
    table(report, "deadband", &["tissue", "scheme", "δ"], runs);

    report.heading("A client that stops: 10 ms, medium hand, omega3");
    report.say(
        "Once a second, at a random moment, the client stops (a busy machine, a pause of the program), and samples and the \
         device's places wait. The device holds its last force, as real devices do, and the hand continues to move under it: \
         the energy is computed with the force that the device really held. No envelope can act meanwhile; the energy that \
         the port gives off is bounded by the held force times the movement of the hand.",
    );
    let mut runs = Vec::new();
    for scene in ["liver", "fibrotic"] {
        for stall_ms in [0, 5, 20, 50, 100, 300] {
            let run = format!("--scene {scene} --rtt-ms 10 --stall-ms {stall_ms}");
            runs.push((cells([scene.to_owned(), stall_ms.to_string()]), run));
        }
    }
    table(report, "stalls", &["tissue", "stops for, ms"], runs);
}

/// Runs a hand and task of virtual time in real time, over gRPC with a delay, for validation.
fn live(report: &mut BenchReport) {
    report.heading("In real time: medium hand, omega3");
    report.say(
        "`palpate-client link --server URL` through a proxy that delays by half the round trip each way, compared with the \
         same seed in virtual time. In real time, ticks of the simulated device and steps of the server are sometimes late. \
         The hand follows the clock even if device or server is late, and the device then holds its last force.",
    );
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let server = server::TestServer::start(&["--log", "warn"]);
    let seconds = if quick() { 8 } else { 20 };
    let (mut rows, mut figures) = (Vec::new(), Vec::new());
    for scene in ["liver", "fibrotic"] {
        for rtt_ms in [10_u32, 50, 100] {
            let delay = std::time::Duration::from_micros(u64::from(rtt_ms) * 500);
            let target = server.url.trim_start_matches("http://").to_owned();
            let proxy = runtime.block_on(proxy::Proxy::start(target, delay));
            let ways = [("real", format!("--server {}", proxy.url())), ("virtual", format!("--rtt-ms {rtt_ms}"))];
            for (time, way) in ways {
                let found = link(&format!("--scene {scene} --seconds {seconds} --seed 1 {way}"));
                let mut row =
                    row(&cells([scene.to_owned(), rtt_ms.to_string(), time.to_owned()]), std::slice::from_ref(&found));
                row.push(found["late_ticks"].as_u64().map_or("–".to_owned(), |ticks| ticks.to_string()));
                rows.push(row);
                figures.push(json!({"scene": scene, "rtt_ms": rtt_ms, "time": time, "found": found}));
            }
        }
    }
    let mut header = header(&["tissue", "round trip, ms", "time"]);
    header.push("late ticks".to_owned());
    report.table(&header, &rows);
    report.figure("real time", Value::Array(figures));
}

/// Columns of the tables of both transports, by title.
const BOTH: [(&str, &str); 11] = [
    ("force error, % RMS", "force_error_rms_percent"),
    ("after outages, % RMS", "force_error_after_outages_percent"),
    ("share of the contact", "after_outages_share"),
    ("p99, N", "force_error_p99_n"),
    ("bias, N", "force_bias_n"),
    ("gain", "force_gain"),
    ("depth error, m RMS", "depth_error_rms_m"),
    ("p99, m", "depth_error_p99_m"),
    ("of the depth, %", "depth_error_percent"),
    ("guard acts, share of ticks in contact", "guard_share"),
    ("least energy, J", "energy_min_j"),
];

/// A table of runs over a stream beside the same over datagrams, of liver and fibrotic tissue: by label and arguments.
fn beside(report: &mut BenchReport, name: &str, label: &str, runs: &[(String, String)], seeds: u64) {
    let transports = ["stream", "datagram"];
    let tissues = ["liver", "fibrotic"];
    let mut all = Vec::new();
    for tissue in tissues {
        for (_, run) in runs {
            for transport in transports {
                all.extend(by_seed(&format!("--scene {tissue} --transport {transport} {run}"), seeds));
            }
        }
    }
    let found = links(&all);
    let mut groups = found.chunks(seeds as usize);
    let mut rows = Vec::new();
    for tissue in tissues {
        for (label, _) in runs {
            for transport in transports {
                let Some(runs) = groups.next() else { return };
                let mut row = cells([tissue, label, transport]);
                row.extend(BOTH.iter().map(|(_, name)| match *name {
                    "energy_min_j" => rough(merged(runs, name)),
                    _ => digits(merged(runs, name)),
                }));
                let sum = |name: &str| runs.iter().map(|run| number(&run[name])).sum::<f64>();
                row.push(format!("{} / {}", sum("pauses"), sum("faults")));
                rows.push(row);
            }
        }
    }
    let mut header = cells(["tissue", label, "transport"]);
    header.extend(BOTH.iter().map(|(title, _)| (*title).to_owned()));
    header.push("pauses / faults, all seeds".to_owned());
    report.table(&header, &rows);
    report.figure(name, Value::Array(found));
}

/// Loss, jitter and outages.
fn lossy(report: &mut BenchReport, seeds: u64) {
    report.heading("Stream and datagrams: 50 ms, medium hand, omega3");
    report.say(
        "In a stream a lost packet delays all that follow it. A lost datagram delays no other; each repeats up to eight \
         places that the server may not have yet. Outages occur once a second, at a random moment. *After outages* excludes \
         each outage and the 50 ms after its end, and pauses until rendering has engaged again; *share of the contact* is the \
         part of the contact that this figure covers. The *depth error* is the distance between the tool and the place where \
         the hand's tool would be without a network. It depends on all earlier forces, so it is not the error of a force at \
         one moment.",
    );
    let named = |(label, run): (&str, &str)| (label.to_owned(), format!("--rtt-ms 50 {run}"));
    let mut runs: Vec<_> = [
        ("nothing lost", ""),
        ("0.1 % lost", "--loss 0.001"),
        ("1 % lost", "--loss 0.01"),
        ("5 % lost", "--loss 0.05"),
        ("10 % lost", "--loss 0.1"),
        ("1 % lost, 5 in a row", "--loss 0.01 --loss-burst 5"),
        ("± 10 ms", "--jitter-ms 10"),
        ("± 40 ms", "--jitter-ms 40"),
    ]
    .map(named)
    .into();
    runs.extend(["wan", "bad-wan"].map(|profile| (profile.to_owned(), format!("--profile {profile}"))));
    runs.extend(
        [
            ("outages of 100 ms", "--outage-ms 100"),
            ("outages of 200 ms", "--outage-ms 200"),
            ("outages of 400 ms", "--outage-ms 400"),
            ("3 Mbit/s each way, queue of 100 ms", "--bandwidth-kbit 3000"),
            ("1 Mbit/s, both deadbands", "--bandwidth-kbit 1000 --deadband 0.1 --up-deadband 0.05"),
        ]
        .map(named),
    );
    beside(report, "lossy", "network", &runs, seeds);
}

/// Places of a sheet of 75 mm, a second tool, and a tissue that changes.
fn places(report: &mut BenchReport, seeds: u64) {
    report.heading("Other places, a second tool, a changing tissue: 50 ms, medium hand, omega3");
    report.say(
        "*Half-way* is between the middle and the rim, *at the rim* one radius of the tip (5 mm) from it; the rim is fixed. \
         The second tool presses with its own task, 15 mm from the middle of the first tool's, to half the depths. After 10 s \
         the springs of the tissue become 1.5 times as stiff; the new law reaches the client after 100 ms plus the one-way \
         delay.",
    );
    let runs = [
        ("half-way", "--place 0.01875,0.0375"),
        ("at the rim", "--place 0.005,0.0375"),
        ("second tool", "--second-tool-mm 15"),
        ("changing tissue", "--tissue-change-s 10 --tissue-change-factor 1.5"),
    ]
    .map(|(label, run)| (label.to_owned(), format!("--rtt-ms 50 {run}")));
    beside(report, "places", "place or condition", &runs, seeds);
}

/// Organs, whose surfaces are curved.
fn organs(report: &mut BenchReport, seeds: u64) {
    report.heading("Organs: 50 ms, medium hand, omega3, datagrams");
    report.say(
        "A model describes the surface under the tip with its curvature; a tip that strokes over a rim, a fold or a lump \
         meets another surface within the round trip. A wall that is touched from inside (`colon`) has folds on all sides. \
         These figures are for local models alone: prediction.md compares them with a copy of the tissue.",
    );
    let runs = [
        ("liver-organ, away from lumps", "liver-organ", ""),
        ("liver-organ, over the larger lump", "liver-organ", "--place -0.040,-0.026,0.037"),
        ("liver-organ, over the smaller lump", "liver-organ", "--place 0.030,-0.013,0.028"),
        ("gallbladder", "gallbladder", ""),
        ("colon", "colon", ""),
    ];
    let all: Vec<_> = runs
        .iter()
        .flat_map(|(_, scene, place)| {
            by_seed(&format!("--scene {scene} --scheme model --transport datagram --rtt-ms 50 {place}"), seeds)
        })
        .collect();
    let found = links(&all);
    let mut rows = Vec::new();
    for ((label, ..), runs) in runs.iter().zip(found.chunks(seeds as usize)) {
        let mut row = cells([label]);
        row.extend(ORGANS.iter().map(|(_, name)| digits(merged(runs, name))));
        row.push(runs.iter().map(|run| digits(number(&run["force_error_rms_percent"]))).collect::<Vec<_>>().join(", "));
        rows.push(row);
    }
    let mut header = cells(["where"]);
    header.extend(ORGANS.iter().map(|(title, _)| (*title).to_owned()));
    header.push("% RMS, each seed".to_owned());
    report.table(&header, &rows);
    report.figure("organs", Value::Array(found));
}

/// Columns of the table of organs, by title.
const ORGANS: [(&str, &str); 5] = [
    ("force error, % RMS", "force_error_rms_percent"),
    ("p99, N", "force_error_p99_n"),
    ("largest true force, N", "true_force_max_n"),
    ("of the depth, %", "depth_error_percent"),
    ("least energy, J", "energy_min_j"),
];

fn random(report: &mut BenchReport) {
    let runs = if quick() { 20 } else { 1000 };
    report.heading("Random combinations");
    let found = link(&format!("--random {runs} --seconds 5"));
    report.say(&format!(
        "`palpate-client link --random {runs} --seconds 5`: scene, hand, device, task and place, network and transport, \
         deadbands, a second tool and a change of the tissue, drawn by seed; {} runs were unstable. The worst value of each \
         figure, and its run:",
        found["unstable"]
    ));
    let mut rows = Vec::new();
    for (name, entry) in found.as_object().unwrap() {
        let Some(run) = entry.get("run") else { continue };
        let text = |key: &str| run[key].as_str().unwrap_or("").to_owned();
        let worst = number(&entry["worst"]);
        let worst = if name == "energy_min_j" { rough(worst) } else { digits(worst) };
        let (rtt, jitter, loss) = (&run["rtt_ms"], &run["jitter_ms"], &run["loss"]);
        let network = format!("{rtt} ± {jitter} ms, loss {loss}");
        rows.push(cells([
            name.clone(),
            worst,
            text("scene"),
            text("hand"),
            text("device"),
            network,
            run["seed"].to_string(),
        ]));
    }
    report.table(&cells(["figure", "worst", "tissue", "hand", "device", "network", "seed"]), &rows);
    report.figure("random", found);
}
