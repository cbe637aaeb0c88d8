//! Compares refining and encoding a frame with a plain copy of its bytes: both on one core, in turn, the least time of
//! many turns. The frame is written into the buffers of the one before, as in the server; the copy goes into a buffer
//! that has been written before. Also measures the bytes of a poke sent as frames of changes. Writes
//! docs/benchmarks/frames.{md,svg}.

#![allow(clippy::unwrap_used, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]

mod report;
mod subject;

use std::hint::black_box;
use std::sync::Arc;
use std::time::{Duration, Instant};

use glam::DVec3;
use palpate_realtime::frames::Delivery;
use palpate_session::surface::{Encoding, Frame, FrameTiles, Refinement, Snapshot, encode, encode_over};
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::{PAPER, Scene};
use palpate_tissue::{Push, at_rest};
use report::chart::Panel;
use report::{BenchReport, cells, digits, quick, seconds};
use serde_json::json;

const SIDES: [usize; 2] = [31, 331];
const REFINEMENTS: [u32; 4] = [0, 1, 3, 10];

/// Duration of the measurement of each case, and the smallest number of repetitions.
const DURATION: Duration = Duration::from_millis(1000);
const MIN_TURNS: u32 = 25;

/// The goal: a frame of 331 × 331 points takes at most as long as this many copies.
const GOAL: f64 = 3.0;

struct FrameCase {
    side: usize,
    refinement: u32,
    encoding: Encoding,
    vertices: usize,
    bytes: usize,
    frame_s: f64,
    /// The time to find the bounding box of the displacements, once for all frames of a snapshot.
    box_s: f64,
    copy_s: f64,
}

impl FrameCase {
    fn ratio(&self) -> f64 {
        self.frame_s / self.copy_s
    }

    /// Including the box, as if there were one viewer; only `I16` needs it.
    fn ratio_with_box(&self) -> f64 {
        let box_s = if self.encoding.largest_integer().is_some() { self.box_s } else { 0.0 };
        (self.frame_s + box_s) / self.copy_s
    }
}

/// A sheet with waves, each component on its own scale.
fn waving(side: usize) -> [Vec<f32>; 3] {
    let wave = |k: usize, c: usize| {
        let (x, y) = ((k / side) as f32, (k % side) as f32);
        0.01 * ((c + 1) as f32 * 0.13 * x).sin() * (0.17 * y + c as f32).cos()
    };
    std::array::from_fn(|c| (0..side * side).map(|k| wave(k, c)).collect())
}

fn copy(frame: &Frame, mut to: &mut [u8]) {
    for patch in &frame.patches {
        let (here, rest) = to.split_at_mut(patch.bytes.len());
        here.copy_from_slice(&patch.bytes);
        to = rest;
    }
}

fn measure(side: usize, refinement: u32, encoding: Encoding) -> FrameCase {
    let limits = Limits { frame_vertices: usize::MAX, ..Limits::default() };
    let sets = [format!("sheet.points=[{side}, {side}]")];
    let scene = Scene::parse("frames", PAPER, &sets, &limits).unwrap();
    let grid = Refinement::new(&scene, refinement, &limits).unwrap();
    let vertices = grid.vertex_count();
    let bytes = vertices * encoding.bytes_per_vertex();
    let displacement_m = waving(side);
    let snapshot = Snapshot::new(&scene, 1, 0.001, displacement_m.clone());
    let mut frame = encode(&snapshot, grid, encoding);
    let mut copied = vec![1_u8; bytes];
    let mut least_s = [f64::INFINITY; 3];
    let (begin, mut turns) = (Instant::now(), 0);
    let duration = if quick() { DURATION / 10 } else { DURATION };
    while turns < MIN_TURNS || begin.elapsed() < duration {
        let (frame_s, next) = seconds(|| black_box(encode_over(black_box(&snapshot), frame)));
        frame = next;
        let (copy_s, ()) = seconds(|| copy(black_box(&frame), black_box(&mut copied)));
        let just_written = displacement_m.clone();
        let (box_s, _) = seconds(|| black_box(Snapshot::new(&scene, 1, 0.001, black_box(just_written))));
        for (least, now_s) in least_s.iter_mut().zip([frame_s, copy_s, box_s]) {
            *least = least.min(now_s);
        }
        turns += 1;
    }
    let [frame_s, copy_s, box_s] = least_s;
    FrameCase { side, refinement, encoding, vertices, bytes, frame_s, box_s, copy_s }
}

fn table(report: &mut BenchReport, cases: &[FrameCase]) {
    let header =
        ["sheet", "n", "encoding", "ms a frame", "ns a vertex", "GB/s", "copy, ms", "frame / copy", "with box"];
    let rows = cases.iter().map(|case| {
        cells([
            format!("{0} × {0}", case.side),
            case.refinement.to_string(),
            format!("{:?}", case.encoding),
            digits(case.frame_s * 1e3),
            digits(case.frame_s * 1e9 / case.vertices as f64),
            digits(case.bytes as f64 / case.frame_s * 1e-9),
            digits(case.copy_s * 1e3),
            digits(case.ratio()),
            digits(case.ratio_with_box()),
        ])
    });
    report.table(&cells(header), &rows.collect::<Vec<_>>());
}

/// The ratio of each case by sheet, refinement and encoding; yellow is the goal.
fn map(cases: &[FrameCase]) -> Panel {
    let shown = |case: &FrameCase| (digits(case.ratio()), 0.5 * case.ratio() / GOAL);
    let column = |side: usize| cases.iter().filter(move |case| case.side == side);
    let name = |case: &FrameCase| format!("n={} {:?}", case.refinement, case.encoding);
    Panel::Cells {
        title: "Time of a frame / time of a copy of its bytes".to_owned(),
        x: ("points", SIDES.map(|side| format!("{side}²")).into()),
        y: ("", column(SIDES[0]).map(name).collect()),
        rows: (0..column(SIDES[0]).count())
            .map(|row| SIDES.map(|side| column(side).nth(row).map(shown).unwrap()).into())
            .collect(),
    }
}

/// Frames per second.
const RATE_HZ: u64 = 60;

/// A poke of 331 × 331 points, in phases with their end times, ms; the force acts in the first.
const PHASES: [(&str, u64); 4] = [("poked", 1000), ("let go", 2000), ("coming to rest", 7000), ("still", 12_000)];

/// The frames of changes sent in one phase.
struct SentFrames {
    bytes: usize,
    frames: u64,
    /// Largest distance of a vertex from its true place, in quanta.
    error: f64,
}

/// The frames that a viewer gets of a poke: for each phase, and in total.
fn poke(force_n: DVec3, refinement: u32, report: &mut BenchReport, rows: &mut Vec<Vec<String>>) {
    let side = 331;
    let model = subject::model(&[subject::set("sheet.points", format!("[{side}, {side}]"))]).unwrap();
    let mut tissue = at_rest(&model);
    let centre_m = model.shape().extent().middle_m();
    let push = Poke { point: None, centre_m, force_n, falloff_per_m: 150.0, falloff_offset: 0.0 };
    tissue.push(0, Some(Push::Constant(push)));
    let limits = Limits { frame_vertices: usize::MAX, ..Limits::default() };
    let grid = Refinement::new(&model.scene, refinement, &limits).unwrap();
    let [_, columns] = grid.vertices();
    let full_bytes = grid.vertex_count() * Encoding::I16.bytes_per_vertex();
    let (mut tiles, mut seen, mut shown) = (None::<FrameTiles>, None, vec![[0.0; 3]; full_bytes / 6]);
    let mut sent: Vec<SentFrames> = Vec::new();
    let mut frames = 0;
    for (phase, (name, end)) in PHASES.into_iter().enumerate() {
        sent.push(SentFrames { bytes: 0, frames: 0, error: 0.0 });
        let sent = &mut sent[phase];
        let begin = tissue.step_count();
        while tissue.step_count() < end {
            tissue.step().unwrap();
            let step = tissue.step_count();
            if step * RATE_HZ / 1000 == (step - 1) * RATE_HZ / 1000 {
                continue;
            }
            frames += 1;
            let mut displacement_m = [(); 3].map(|()| Vec::new());
            tissue.displacements_m(&mut displacement_m);
            let snapshot = Arc::new(Snapshot::new(&model.scene, step, step as f64 * 1e-3, displacement_m));
            let tiles = tiles.get_or_insert_with(|| FrameTiles::new(&snapshot, grid, Encoding::I16));
            tiles.update(&snapshot);
            if tiles.is_newer_than(seen) {
                let frame = tiles.newer_than(seen);
                seen = Some(tiles.version());
                show(&frame, columns, &mut shown);
                let delivery = Delivery {
                    frame_id: frames,
                    frame: Arc::new(frame),
                    since: seen,
                    unchanged: 0,
                    overrun_count: 0,
                    time_dilation: 1.0,
                };
                // Including the protocol's overhead.
                let messages = palpate::server::frame_message::frame_messages(&"0".repeat(32), &delivery, 0);
                sent.bytes += messages.iter().map(prost::Message::encoded_len).sum::<usize>();
                sent.frames += 1;
                // Comparing every frame would take too long.
                if frames.is_multiple_of(8) {
                    let truth = encode(&snapshot, grid, Encoding::F32);
                    sent.error = sent.error.max(error(&truth, &delivery.frame, columns, &shown));
                }
            }
        }
        if phase == 0 {
            tissue.push(0, None);
        }
        let duration_s = (end - begin) as f64 * 1e-3;
        let share = sent.bytes as f64 / (full_bytes as f64 * RATE_HZ as f64 * duration_s);
        let force = force_n.to_array().map(|f| f.to_string()).join(", ");
        rows.push(cells([
            refinement.to_string(),
            force.clone(),
            name.to_owned(),
            digits(duration_s),
            sent.frames.to_string(),
            digits(sent.bytes as f64 / duration_s * 1e-3),
            format!("{} %", digits(100.0 * share)),
            digits(sent.error),
        ]));
        report.figure(
            &format!("n={refinement} force=[{force}] {name}"),
            json!({ "bytes": sent.bytes, "duration_s": duration_s, "share_of_full": share, "error_quanta": sent.error }),
        );
    }
}

/// The vertices of a frame and their bytes.
fn vertices(frame: &Frame, columns: usize) -> impl Iterator<Item = (usize, &[u8])> {
    let size = frame.encoding.bytes_per_vertex();
    frame.patches.iter().flat_map(move |patch| {
        let place =
            move |k: usize| (patch.first[0] + k / patch.count[1]) * columns + patch.first[1] + k % patch.count[1];
        patch.bytes.chunks(size).enumerate().map(move |(k, bytes)| (place(k), bytes))
    })
}

/// Writes a frame over the displacements shown before.
fn show(frame: &Frame, columns: usize, shown: &mut [[f64; 3]]) {
    for (vertex, bytes) in vertices(frame, columns) {
        shown[vertex] = std::array::from_fn(|c| {
            let q = f64::from(i16::from_le_bytes([bytes[2 * c], bytes[2 * c + 1]]));
            frame.quanta.origin_m[c] + frame.quanta.scale_m[c] * q
        });
    }
}

/// The largest difference between the displacements shown and the truth, in quanta.
fn error(truth: &Frame, frame: &Frame, columns: usize, shown: &[[f64; 3]]) -> f64 {
    let errors = vertices(truth, columns).flat_map(|(vertex, bytes)| {
        (0..3).map(move |c| {
            let exact = f64::from(f32::from_le_bytes(bytes[4 * c..4 * c + 4].try_into().unwrap()));
            (shown[vertex][c] - exact).abs() / frame.quanta.scale_m[c]
        })
    });
    errors.fold(0.0, f64::max)
}

fn main() {
    let mut report = BenchReport::new("frames", "Frames", "make bench-frames");
    let mut cases = Vec::new();
    for side in SIDES {
        for refinement in REFINEMENTS {
            cases.extend(Encoding::ALL.map(|encoding| measure(side, refinement, encoding)));
        }
    }
    report.say(&format!(
        "The time to refine a whole frame and encode it into the buffers of the previous one, compared with a plain copy of \
         its bytes (memcpy into a buffer written before), in turn on one core; the shortest of many turns. The goal for 331 × \
         331 points is a ratio of at most {GOAL}. The box around the displacements, which defines the range of the integers, \
         is computed once per snapshot; `with box` adds its time, as for a single viewer."
    ));
    table(&mut report, &cases);
    let rows = cases.iter().map(|case| {
        json!({
            "side_points": case.side,
            "refinement": case.refinement,
            "encoding": format!("{:?}", case.encoding),
            "vertices": case.vertices,
            "bytes": case.bytes,
            "frame_s": case.frame_s,
            "box_s": case.box_s,
            "copy_s": case.copy_s,
            "ratio": case.ratio(),
        })
    });
    report.heading("Frames of changes");
    report.say(&format!(
        "A sheet of 331 × 331 points, poked at its centre for a second (falloff 150/m), and one viewer that receives \
         {RATE_HZ} i16 frames a second of the changes: bytes with the overhead of the protocol, relative to whole frames at \
         that rate. The first phase has a full frame because the viewer joins, and the third because five seconds have \
         passed. The error is the largest difference between a vertex and its true position, in quanta, of every eighth \
         frame."
    ));
    let mut sent = Vec::new();
    for refinement in if quick() { &[0][..] } else { &[0, 10] } {
        for force_n in [DVec3::new(0.0, 0.0, -3.0), DVec3::new(2.0, 0.0, -2.0)] {
            poke(force_n, *refinement, &mut report, &mut sent);
        }
    }
    let header = ["n", "force, N", "phase", "s", "frames", "kB/s", "of whole frames", "error, quanta"];
    report.table(&cells(header), &sent);
    report.figure("goal_ratio", json!(GOAL));
    report.figure("cases", rows.collect());
    report.write(1, &[map(&cases)]);
}
