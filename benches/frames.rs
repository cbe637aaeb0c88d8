//! Refining and encoding a frame beside a plain copy of its bytes: both on one core, in turn, the least time of many
//! turns. The frame is written into the buffers of the one before, as the server does; the copy goes into a buffer
//! that has been written before.

#![allow(clippy::unwrap_used, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]

use std::fmt::Write;
use std::hint::black_box;
use std::time::{Duration, Instant};

use palpate::limits::Limits;
use palpate::surface::{Encoding, Frame, Refinement, Snapshot, encode, encode_over};
use plotters::prelude::*;
use serde_json::json;

const SIDES: [usize; 2] = [31, 331];
const REFINEMENTS: [u32; 4] = [0, 1, 3, 10];
const ENCODINGS: [Encoding; 2] = [Encoding::F32, Encoding::I16];

/// How long each case is measured, and at least how often.
const DURATION: Duration = Duration::from_millis(1000);
const LEAST_TURNS: u32 = 25;

/// What is asked for: a frame takes at most as long as so many copies.
const GOAL: f64 = 3.0;

/// One line of the table.
struct Case {
    side: usize,
    refinement: u32,
    encoding: Encoding,
    vertices: usize,
    bytes: usize,
    frame_s: f64,
    copy_s: f64,
}

impl Case {
    fn ratio(&self) -> f64 {
        self.frame_s / self.copy_s
    }
}

/// A sheet that waves, each component on its own scale.
fn snapshot(side: usize) -> Snapshot {
    let wave = |k: usize, c: usize| {
        let (x, y) = ((k / side) as f32, (k % side) as f32);
        0.01 * ((c + 1) as f32 * 0.13 * x).sin() * (0.17 * y + c as f32).cos()
    };
    let displacement_m = std::array::from_fn(|c| (0..side * side).map(|k| wave(k, c)).collect());
    Snapshot { step: 1, simulation_time_s: 0.001, displacement_m }
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
    let snapshot = snapshot(side);
    let mut frame = encode(&snapshot, grid, encoding);
    let mut copied = vec![1_u8; bytes];
    let (mut frame_s, mut copy_s) = (f64::INFINITY, f64::INFINITY);
    let (begin, mut turns) = (Instant::now(), 0);
    while turns < LEAST_TURNS || begin.elapsed() < DURATION {
        let start = Instant::now();
        frame = black_box(encode_over(black_box(&snapshot), frame));
        frame_s = frame_s.min(start.elapsed().as_secs_f64());
        let start = Instant::now();
        copy(black_box(&frame), &mut copied);
        black_box(&mut copied);
        copy_s = copy_s.min(start.elapsed().as_secs_f64());
        turns += 1;
    }
    Case { side, refinement, encoding, vertices, bytes, frame_s, copy_s }
}

fn table(cases: &[Case]) -> String {
    let mut text = String::from(
        "| sheet | n | encoding | ms a frame | ns a vertex | GB/s | copy, ms | frame / copy |\n\
         |---|---:|---|---:|---:|---:|---:|---:|\n",
    );
    for case in cases {
        let Case { side, refinement, encoding, vertices, bytes, frame_s, copy_s } = case;
        writeln!(
            text,
            "| {side} × {side} | {refinement} | {encoding:?} | {:.5} | {:.2} | {:.1} | {:.5} | {:.2} |",
            frame_s * 1e3,
            frame_s * 1e9 / *vertices as f64,
            *bytes as f64 / frame_s * 1e-9,
            copy_s * 1e3,
            case.ratio(),
        )
        .unwrap();
    }
    text
}

fn machine() -> String {
    let information = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = information.lines().find_map(|line| line.strip_prefix("model name")?.split(": ").nth(1));
    name.unwrap_or("unknown").to_owned()
}

/// The ratio of each case as a bar, and the goal as a line.
fn draw(cases: &[Case], path: &std::path::Path) {
    let area = SVGBackend::new(path, (900, 420)).into_drawing_area();
    area.fill(&WHITE).unwrap();
    let top = cases.iter().map(Case::ratio).fold(GOAL, f64::max) * 1.1;
    let count = cases.len() as f64;
    let mut chart = ChartBuilder::on(&area)
        .caption("Time of a frame / time of a copy of its bytes", ("sans-serif", 18))
        .margin(12)
        .x_label_area_size(60)
        .y_label_area_size(50)
        .build_cartesian_2d(0.0..count, 0.0..top)
        .unwrap();
    chart.configure_mesh().disable_x_mesh().disable_x_axis().y_desc("ratio").draw().unwrap();
    let bars = cases.iter().enumerate().map(|(index, case)| {
        let color =
            if case.encoding == Encoding::F32 { RGBColor(0x1f, 0x77, 0xb4) } else { RGBColor(0xff, 0x7f, 0x0e) };
        let left = index as f64;
        Rectangle::new([(left + 0.15, 0.0), (left + 0.85, case.ratio())], color.filled())
    });
    chart.draw_series(bars).unwrap();
    chart.draw_series([PathElement::new(vec![(0.0, GOAL), (count, GOAL)], RED)]).unwrap();
    for (index, case) in cases.iter().enumerate() {
        let (x, y) = chart.backend_coord(&(index as f64 + 0.2, 0.0));
        let style = ("sans-serif", 12).into_font();
        area.draw(&Text::new(format!("{:?}", case.encoding), (x, y + 6), style.clone())).unwrap();
        area.draw(&Text::new(format!("n = {}", case.refinement), (x, y + 22), style.clone())).unwrap();
        area.draw(&Text::new(format!("{}²", case.side), (x, y + 38), style)).unwrap();
    }
    area.present().unwrap();
}

fn main() {
    let mut cases = Vec::new();
    for side in SIDES {
        for refinement in REFINEMENTS {
            cases.extend(ENCODINGS.map(|encoding| measure(side, refinement, encoding)));
        }
    }
    let (table, machine) = (table(&cases), machine());
    print!("{table}");
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/benchmarks");
    std::fs::create_dir_all(&folder).unwrap();
    let text = format!(
        "# Frames\n\n\
         A frame refined and encoded into the buffers of the one before, beside a plain copy of its bytes (memcpy into\n\
         a buffer written before), in turn on one core; the least time of many turns. The goal for 331 × 331 points is at most {GOAL}.\n\n\
         {table}\n![The ratios](frames.svg)\n\n\
         Machine: {machine}, one core. Command: `make bench-frames`. Numbers: [frames.json](frames.json).\n",
    );
    std::fs::write(folder.join("frames.md"), text).unwrap();
    let rows = cases.iter().map(|case| {
        json!({
            "side_points": case.side,
            "refinement": case.refinement,
            "encoding": format!("{:?}", case.encoding),
            "vertices": case.vertices,
            "bytes": case.bytes,
            "frame_s": case.frame_s,
            "copy_s": case.copy_s,
            "ratio": case.ratio(),
        })
    });
    let numbers = json!({
        "machine": machine,
        "command": "make bench-frames",
        "goal_ratio": GOAL,
        "cases": rows.collect::<Vec<_>>(),
    });
    let numbers = serde_json::to_string_pretty(&numbers).unwrap();
    std::fs::write(folder.join("frames.json"), numbers + "\n").unwrap();
    draw(&cases, &folder.join("frames.svg"));
}
