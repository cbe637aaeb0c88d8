//! Refining and encoding a frame beside a plain copy of its bytes: both on one core, in turn, the least time of many
//! turns. The frame is written into the buffers of the one before, as the server does; the copy goes into a buffer
//! that has been written before. Writes docs/benchmarks/frames.{md,json,svg}.

#![allow(clippy::unwrap_used, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]

mod report;

use std::hint::black_box;
use std::time::{Duration, Instant};

use palpate::limits::Limits;
use palpate::surface::{Encoding, Frame, Refinement, Snapshot, encode, encode_over};
use report::chart::Panel;
use report::{Report, cells, digits, quick, seconds};
use serde_json::json;

const SIDES: [usize; 2] = [31, 331];
const REFINEMENTS: [u32; 4] = [0, 1, 3, 10];
const ENCODINGS: [Encoding; 2] = [Encoding::F32, Encoding::I16];

/// How long each case is measured, and at least how often.
const DURATION: Duration = Duration::from_millis(1000);
const LEAST_TURNS: u32 = 25;

/// What is asked for: a frame of 331 × 331 points takes at most as long as so many copies.
const GOAL: f64 = 3.0;

struct Case {
    side: usize,
    refinement: u32,
    encoding: Encoding,
    vertices: usize,
    bytes: usize,
    frame_s: f64,
    /// To find the box around the displacements, once for all frames of a snapshot.
    box_s: f64,
    copy_s: f64,
}

impl Case {
    fn ratio(&self) -> f64 {
        self.frame_s / self.copy_s
    }

    /// With the box, as if nobody else looked; only `I16` needs it.
    fn ratio_with_box(&self) -> f64 {
        let box_s = if self.encoding == Encoding::I16 { self.box_s } else { 0.0 };
        (self.frame_s + box_s) / self.copy_s
    }
}

/// A sheet that waves, each component on its own scale.
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

fn measure(side: usize, refinement: u32, encoding: Encoding) -> Case {
    let limits = Limits { frame_vertices: usize::MAX, ..Limits::default() };
    let grid = Refinement::new([side, side], refinement, &limits).unwrap();
    let vertices = grid.vertices().iter().product::<usize>();
    let bytes = vertices * encoding.bytes_per_vertex();
    let displacement_m = waving(side);
    let snapshot = Snapshot::new(1, 0.001, displacement_m.clone());
    let mut frame = encode(&snapshot, grid, encoding);
    let mut copied = vec![1_u8; bytes];
    let mut least_s = [f64::INFINITY; 3];
    let (begin, mut turns) = (Instant::now(), 0);
    let duration = if quick() { DURATION / 10 } else { DURATION };
    while turns < LEAST_TURNS || begin.elapsed() < duration {
        let (frame_s, next) = seconds(|| black_box(encode_over(black_box(&snapshot), frame)));
        frame = next;
        let (copy_s, ()) = seconds(|| copy(black_box(&frame), black_box(&mut copied)));
        let just_written = displacement_m.clone();
        let (box_s, _) = seconds(|| black_box(Snapshot::new(1, 0.001, black_box(just_written))));
        for (least, now_s) in least_s.iter_mut().zip([frame_s, copy_s, box_s]) {
            *least = least.min(now_s);
        }
        turns += 1;
    }
    let [frame_s, copy_s, box_s] = least_s;
    Case { side, refinement, encoding, vertices, bytes, frame_s, box_s, copy_s }
}

fn table(report: &mut Report, cases: &[Case]) {
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

/// The ratio of each case, by sheet, refinement and encoding; the goal is yellow.
fn map(cases: &[Case]) -> Panel {
    let shown = |case: &Case| (digits(case.ratio()), 0.5 * case.ratio() / GOAL);
    let column = |side: usize| cases.iter().filter(move |case| case.side == side);
    let name = |case: &Case| format!("n={} {:?}", case.refinement, case.encoding);
    Panel::Cells {
        title: "Time of a frame / time of a copy of its bytes".to_owned(),
        x: ("points", SIDES.map(|side| format!("{side}²")).into()),
        y: ("", column(SIDES[0]).map(name).collect()),
        rows: (0..column(SIDES[0]).count())
            .map(|row| SIDES.map(|side| column(side).nth(row).map(shown).unwrap()).into())
            .collect(),
    }
}

fn main() {
    let mut report = Report::new("frames", "Frames", "make bench-frames");
    let mut cases = Vec::new();
    for side in SIDES {
        for refinement in REFINEMENTS {
            cases.extend(ENCODINGS.map(|encoding| measure(side, refinement, encoding)));
        }
    }
    report.say(&format!(
        "A whole frame refined and encoded into the buffers of the one before, beside a plain copy of its bytes (memcpy \
         into a buffer written before), in turn on one core; the least time of many turns. The goal for 331 × 331 \
         points is at most {GOAL}. The box around the displacements, over which integers are spread, is found once a \
         snapshot, when it has just been taken; `with box` counts that as if one viewer alone looked."
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
    report.figure("goal_ratio", json!(GOAL));
    report.figure("cases", rows.collect());
    report.write(1, &[map(&cases)]);
}
