//! Touch on organs over a network, from local models and from a copy of the tissue that the client simulates: in
//! virtual time and through a real server; and what a copy costs. Writes docs/benchmarks/prediction.{md,json}.
//! `-- --quick` measures less.

#![allow(clippy::unwrap_used, clippy::panic, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]

mod links;
#[path = "../tests/common/proxy.rs"]
mod proxy;
mod report;
#[path = "../tests/common/server.rs"]
mod server;

use std::sync::Arc;
use std::time::{Duration, Instant};

use glam::DVec3;
use links::{by_seed, link, links, number};
use palpate_haptics::{Instrument, InstrumentPose, Predictor, Tip};
use palpate_proto::pb;
use palpate_session::tissue_copy::TissueCopy;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::{BUILT_IN, Scene};
use palpate_tissue::{Footprint, Model};
use report::chart::{Look, Panel, Series};
use report::{BenchReport, cells, digits, quick};
use serde_json::{Value, json};

/// Round trip, ms.
const ROUND_TRIP_MS: u32 = 50;

const SCHEMES: [&str; 2] = ["prediction", "model"];

/// The cases: a title, a scene, and the place of touch.
const PLACES: [(&str, &str, &str); 5] = [
    ("liver-organ, away from lumps", "liver-organ", ""),
    ("liver-organ, over the larger lump", "liver-organ", "--place -0.040,-0.026,0.037"),
    ("liver-organ, over the smaller lump", "liver-organ", "--place 0.030,-0.013,0.028"),
    ("gallbladder", "gallbladder", ""),
    ("colon", "colon", ""),
];

/// Figures of a run that the tables show.
const COLUMNS: [(&str, &str); 6] = [
    ("force error, % RMS", "force_error_rms_percent"),
    ("p99, N", "force_error_p99_n"),
    ("largest true force, N", "true_force_max_n"),
    ("of the depth, %", "depth_error_percent"),
    ("least energy, J", "energy_min_j"),
    ("largest jump, N", "jump_max_n"),
];

fn header(label: &[&str]) -> Vec<String> {
    let mut header = cells(label);
    header.extend(COLUMNS.iter().map(|(title, _)| (*title).to_owned()));
    header.push("ticks from the copy".to_owned());
    header
}

/// Means over seeds, of energy and jump the worst.
fn row(label: &[&str], runs: &[Value]) -> Vec<String> {
    let mut row = cells(label);
    for (_, name) in COLUMNS {
        let values = runs.iter().map(|run| number(&run[name]));
        row.push(digits(match name {
            "energy_min_j" => values.fold(f64::INFINITY, f64::min),
            "jump_max_n" => values.fold(0.0, f64::max),
            _ => values.sum::<f64>() / runs.len() as f64,
        }));
    }
    let [predicted, all] = [
        runs.iter().map(|run| number(&run["predicted_ticks"])).sum::<f64>(),
        runs.iter().map(|run| 1e3 * number(&run["seconds"])).sum::<f64>(),
    ];
    row.push(format!("{:.0} %", 100.0 * predicted / all));
    row
}

fn main() {
    let mut report =
        BenchReport::new("prediction", "Touch on organs from a copy of the tissue", "make bench-prediction");
    report.say(
        "`model` renders the local model along the tool's own path. `prediction` renders from a copy of the tissue that the \
         client simulates and corrects by samples, or from the local model while it recently matched the samples better. \
         Medium hand, omega3, runs of 20 s in virtual time; means over the seeds 1 to 3, but the worst for energies and jumps \
         (`palpate-client link --help`).",
    );
    report.say(
        "**Virtual time.** The true force comes from a second tissue without a delay, at the tool's own place. The client's \
         copy has the same tissue and the same places, so without other users it equals that tissue bit by bit: the remaining \
         error comes from the corrections, not from the network. The tables show the error when the copy differs: if the \
         server gets places late or not at all, with a second tool, with a tissue that changes, and in real time.",
    );
    // Before anything else is busy.
    cost(&mut report);
    live(&mut report);
    let seeds = if quick() { 1 } else { 3 };
    places(&mut report, seeds);
    disturbed(&mut report, seeds);
    let panels = [panel("colon", "colon", ""), panel("over the smaller lump", "liver-organ", PLACES[2].2)];
    report.write(2, &panels);
}

/// A table of what was run by each scheme.
fn table(report: &mut BenchReport, label: &str, name: &'static str, runs: &[(&str, String)], seeds: u64) {
    let each = || runs.iter().flat_map(|(title, run)| SCHEMES.map(|scheme| (*title, run, scheme)));
    let all: Vec<_> = each().flat_map(|(_, run, scheme)| by_seed(&format!("{run} --scheme {scheme}"), seeds)).collect();
    let found = links(&all);
    let rows = each().zip(found.chunks(seeds as usize)).map(|((title, _, scheme), runs)| row(&[title, scheme], runs));
    report.table(&header(&[label, "scheme"]), &rows.collect::<Vec<_>>());
    report.figure(name, Value::Array(found));
}

fn places(report: &mut BenchReport, seeds: u64) {
    report.heading("A constant delay of 50 ms, datagrams");
    let run = |(title, scene, place): &(&'static str, &str, &str)| {
        (*title, format!("--scene {scene} {place} --transport datagram --rtt-ms {ROUND_TRIP_MS}"))
    };
    table(report, "where", "places", &PLACES.iter().map(run).collect::<Vec<_>>(), seeds);
}

/// Measures runs in which the copy differs from the server's tissue.
fn disturbed(report: &mut BenchReport, seeds: u64) {
    report.heading("When the copy is incomplete: liver-organ");
    report.say(
        "A second tool presses with its own task. After 10 s the springs of the tissue become 1.5 times as stiff; the new \
         law and a new copy reach the client after 100 ms plus the one-way delay.",
    );
    let conditions = [
        ("± 40 ms, datagrams", "--rtt-ms 50 --jitter-ms 40 --transport datagram"),
        ("120 ± 40 ms, 1 % lost, datagrams", "--profile bad-wan --transport datagram"),
        ("50 ± 10 ms, 0.1 % lost, stream", "--profile wan"),
        ("200 ms, datagrams", "--rtt-ms 200 --transport datagram"),
        ("both deadbands (0.1, 0.05), datagrams", "--rtt-ms 50 --transport datagram --deadband 0.1 --up-deadband 0.05"),
        ("another client's tool 15 mm away", "--rtt-ms 50 --second-tool-mm 15"),
        ("another client's tool 5 mm away", "--rtt-ms 50 --second-tool-mm 5"),
        ("a tool of the own second hand 15 mm away", "--rtt-ms 50 --second-tool-mm 15 --second-hand own"),
        ("a tool of the own second hand 5 mm away", "--rtt-ms 50 --second-tool-mm 5 --second-hand own"),
        ("changing tissue", "--rtt-ms 50 --tissue-change-s 10 --tissue-change-factor 1.5"),
    ];
    let runs = conditions.map(|(title, condition)| (title, format!("--scene liver-organ {condition}")));
    table(report, "network or condition", "disturbed", &runs, seeds);
}

/// True and rendered force around the moment at which local models are farthest off.
fn panel(title: &str, scene: &str, place: &str) -> Panel {
    let courses = SCHEMES.map(|scheme| {
        let file = std::env::temp_dir().join(format!("palpate-prediction-{}.csv", std::process::id()));
        let path = file.display();
        link(&format!(
            "--scene {scene} {place} --transport datagram --rtt-ms {ROUND_TRIP_MS} --scheme {scheme} --course {path}"
        ));
        let text = std::fs::read_to_string(&file).unwrap();
        std::fs::remove_file(&file).unwrap();
        text.lines().skip(1).map(|line| line.split(',').map(|value| value.parse().unwrap()).collect()).collect()
    });
    let [predicted, modelled]: [Vec<Vec<f64>>; 2] = courses;
    let off_n = |row: &Vec<f64>| (row[2] - row[3]).abs();
    let worst = modelled.iter().max_by(|a, b| off_n(a).total_cmp(&off_n(b))).unwrap()[0];
    let of = |rows: &[Vec<f64>], column: usize| -> Vec<(f64, f64)> {
        let near = rows.iter().filter(|row| (row[0] - worst).abs() < 0.4);
        near.map(|row| (1e3 * (row[0] - worst), 1e3 * row[column])).collect()
    };
    let series = |name: &str, hue, look, points| Series { name: name.to_owned(), hue, look, points };
    let all = [
        series("true", 2, Look::Broad, of(&modelled, 3)),
        series("local models", 0, Look::Plain, of(&modelled, 2)),
        series("copy, its own course", 1, Look::Plain, of(&predicted, 2)),
    ];
    let most = all.iter().flat_map(|series| series.points.iter().map(|point| point.1)).fold(0.0, f64::max);
    Panel::Curves {
        title: format!("Force at {ROUND_TRIP_MS} ms: {title}"),
        x: "ms",
        y: "mN",
        up: 0.0..1.1 * most,
        series: all.into(),
    }
}

fn live(report: &mut BenchReport) {
    report.heading("In real time, 50 ms");
    report.say(
        "The same hand and task over gRPC to a real server through a proxy that delays by 25 ms each way. The client makes \
         the copy from a snapshot that the server sends. Ticks and steps are sometimes late; client and server use their own \
         clocks.",
    );
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let server = server::TestServer::start(&["--log", "warn"]);
    let seconds = if quick() { 8 } else { 20 };
    let (mut rows, mut figures) = (Vec::new(), Vec::new());
    for (title, scene, place) in PLACES.iter().filter(|place| place.1 != "gallbladder") {
        for scheme in SCHEMES {
            let delay = Duration::from_millis(u64::from(ROUND_TRIP_MS) / 2);
            let target = server.url.trim_start_matches("http://").to_owned();
            let proxy = runtime.block_on(proxy::Proxy::start(target, delay));
            let url = proxy.url();
            let found = link(&format!("--scene {scene} {place} --seconds {seconds} --server {url} --scheme {scheme}"));
            let mut row = row(&[title, scheme], std::slice::from_ref(&found));
            row.push(found["late_ticks"].to_string());
            rows.push(row);
            figures.push(found);
        }
    }
    let mut header = header(&["where", "scheme"]);
    header.push("late ticks".to_owned());
    report.table(&header, &rows);
    report.figure("real time", Value::Array(figures));
}

/// Measures the cost of a copy: time of a tick, memory, and time to create it.
fn cost(report: &mut BenchReport) {
    report.heading("The cost of a copy");
    report.say(
        "A tip of 5 mm strokes over the tissue, 3 mm deep, at 1 kHz: the time of one step of the copy, on one thread. The \
         server sends the snapshot; the last column is the time to make a copy from it, on another thread than the loop.",
    );
    let runtime = tokio::runtime::Runtime::new().unwrap();
    let server = server::TestServer::start(&["--log", "warn"]);
    let (mut rows, mut figures) = (Vec::new(), Vec::new());
    for name in ["liver-organ", "gallbladder", "colon", "liver"] {
        let text = BUILT_IN.iter().find(|scene| scene.0 == name).unwrap().1;
        let limits = Limits::default();
        let model = Model::compile(&Scene::parse(name, text, &[], &limits).unwrap(), &limits).unwrap();
        let mut times_us = times_us(&model);
        times_us.sort_by(f64::total_cmp);
        let at = |part: f64| times_us[((times_us.len() - 1) as f64 * part) as usize];
        let snapshot = runtime.block_on(snapshot(&server, name));
        let began = Instant::now();
        drop(palpate_session::journal::prediction(&snapshot, &Instrument::of_tip(Tip::default())).unwrap());
        let made_ms = 1e3 * began.elapsed().as_secs_f64();
        let (points, megabytes) = (model.shape().point_count(), 1e-6 * snapshot.len() as f64);
        let values = [at(0.5), at(0.99), at(1.0), megabytes, made_ms];
        let mut row = cells([name.to_owned(), points.to_string()]);
        row.extend(values.map(digits));
        rows.push(row);
        figures.push(json!({
            "scene": name, "points": points, "p50_us": values[0], "p99_us": values[1], "most_us": values[2],
            "snapshot_megabytes": megabytes, "made_ms": made_ms,
        }));
    }
    let titles = ["tissue", "points", "p50, µs", "p99, µs", "most, µs", "snapshot, MB", "made in, ms"];
    report.table(&cells(titles), &rows);
    report.figure("cost", Value::Array(figures));
}

/// The time of each tick while the tip strokes to and fro, µs.
fn times_us(model: &Arc<Model>) -> Vec<f64> {
    let tip = Tip::default();
    let near_m = model.shape().extent().middle_m();
    let (at_m, outward) = Footprint::new(model, tip.radius_m, near_m).at_rest();
    let along = outward.any_orthonormal_vector();
    let mut copy = TissueCopy::new(model, tip);
    let times = (0..4000_u32).map(|tick| {
        let time_s = 1e-3 * f64::from(tick);
        let depth_m = 0.003 * (time_s / 0.2).min(1.0) - 0.002 * (1.0 - (time_s / 0.2).min(1.0));
        let stroke_m = 0.008 * (3.0 * (time_s - 0.2).max(0.0)).sin();
        let place_m: DVec3 = at_m - depth_m * outward + stroke_m * along;
        let began = Instant::now();
        std::hint::black_box(copy.feel(time_s, &InstrumentPose::at(place_m), &[]));
        1e6 * began.elapsed().as_secs_f64()
    });
    // From when it touches on.
    times.skip(200).collect()
}

async fn snapshot(server: &server::TestServer, scene: &str) -> Vec<u8> {
    let source = pb::create_session_request::Source::SceneName(scene.to_owned());
    let request = pb::CreateSessionRequest { source: Some(source), ..Default::default() };
    let session = server.sessions().await.create_session(request).await.unwrap().into_inner().session.unwrap();
    let session_id = session.session_id;
    let request = pb::SaveSnapshotRequest { session_id: session_id.clone() };
    let parts = server.sessions().await.save_snapshot(request).await.unwrap().into_inner();
    let bytes = palpate_client::snapshot::collect(parts).await.unwrap();
    server.sessions().await.delete_session(pb::DeleteSessionRequest { session_id }).await.unwrap();
    bytes
}
