//! Measures the duration of a tick while the network side and other threads are busy: `make bench-tick`.
#![allow(clippy::unwrap_used, clippy::disallowed_methods)]

use std::f64::consts::TAU;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Instant;

use glam::{DMat3, DVec3};
use palpate_client::Reading;
use palpate_client::bridge::{Offline, PositionOrigin, Ticker};
use palpate_haptics::force_law::Row;
use palpate_haptics::{ContactState, Device, Law, LocalModel};
use palpate_proto::{pb, touch};
use pb::touch_response::Message as Heard;
use prost::Message;

/// Ticks measured per round trip; a tenth of them with a sample before each.
const TICKS: u32 = 10_000_000;
/// Longest duration that is counted separately, in steps of 10 ns.
const MAX_TICKS: usize = 100_000;

fn bytes(message: Heard) -> Vec<u8> {
    pb::TouchResponse { message: Some(message) }.encode_to_vec()
}

/// A force law that hardens, as long as those of servers.
fn law() -> Law {
    let row = |k: u32| Row {
        force_n: 0.02 * f64::from(k) + 1e-4 * f64::from(k * k),
        stiffness_n_per_m: 200.0 + 2.0 * f64::from(k),
        across_n_per_m: 100.0,
        damping_n_s_per_m: 0.5,
        across_n_s_per_m: 0.3,
        drag_n_s_per_m: 0.2,
    };
    Law { step_m: 1e-4, rows: (0..200).map(row).collect(), is_coarse: false }
}

/// The place at a tick: on a circle through the tissue, at most 3 mm deep.
fn place_m(tick: u32) -> DVec3 {
    let (sin, cos) = (TAU * f64::from(tick % 2000) / 2000.0).sin_cos();
    DVec3::new(0.004 * cos, 0.0, -0.001 + 0.002 * sin)
}

fn sample(tick: u32, curvature_per_m: f64) -> Vec<u8> {
    let place_m = place_m(tick);
    let model = LocalModel {
        sequence: u64::from(tick) + 1,
        client_time_s: 1.0 + 1e-3 * f64::from(tick),
        step: u64::from(tick),
        place_m,
        velocity_m_per_s: DVec3::ZERO,
        force_n: law().at_depth(-place_m.z).force_n * DVec3::Z,
        stiffness_n_per_m: 400.0 * DMat3::IDENTITY,
        damping_n_s_per_m: 0.5 * DMat3::IDENTITY,
        surface_m: DVec3::new(place_m.x, 0.0, 0.0),
        normal: DVec3::Z,
        curvature_per_m: curvature_per_m * DMat3::from_diagonal(DVec3::new(1.0, 1.0, 0.0)),
        valid_m: 0.01,
        friction: 0.2,
        contact_state: if place_m.z < 0.0 { ContactState::Sticking } else { ContactState::Free },
        law: 0,
    };
    let tool = pb::ToolSample { local_model: Some(touch::local_model(&model)), ..Default::default() };
    bytes(Heard::Sample(pb::Sample { step: u64::from(tick), tools: vec![tool], ..Default::default() }))
}

/// The sample of a tick, from a course that repeats; only time and number advance.
fn sample_of(models: &[Vec<u8>], tick: u32) -> Vec<u8> {
    let mut message = pb::TouchResponse::decode(models[tick as usize % models.len()].as_slice()).unwrap();
    if let Some(Heard::Sample(sample)) = &mut message.message {
        let model = sample.tools[0].local_model.as_mut().unwrap();
        model.sequence = u64::from(tick) + 1;
        model.client_time_ns = 1_000_000_000 + 1_000_000 * u64::from(tick);
    }
    message.encode_to_vec()
}

fn offline() -> Offline {
    let mut offline = Offline::new(Device::named("omega3").unwrap(), PositionOrigin::Tissue, DVec3::ZERO, 0.05);
    let opened = pb::TouchOpened { law: Some(touch::law(&law(), 0)), ..Default::default() };
    offline.record.arrive(&bytes(Heard::Opened(opened))).unwrap();
    offline
}

/// Durations, counted in steps of 10 ns.
struct TickTimes {
    counts: Vec<u64>,
    most_ns: u128,
}

impl TickTimes {
    fn new() -> Self {
        TickTimes { counts: vec![0; MAX_TICKS], most_ns: 0 }
    }

    fn tick(&mut self, ticker: &mut Ticker, tick: u32) {
        let reading = Reading { place_m: place_m(tick), enable: tick > 10 };
        let began = Instant::now();
        std::hint::black_box(ticker.tick(reading, 1e-3 * f64::from(tick)));
        let ns = began.elapsed().as_nanos();
        self.most_ns = self.most_ns.max(ns);
        self.counts[usize::try_from(ns / 10).unwrap().min(MAX_TICKS - 1)] += 1;
    }

    fn row(&self, round_trip_ms: u32) {
        let all: u64 = self.counts.iter().sum();
        let share = |share: f64| {
            let (wanted, mut seen) = ((share * all as f64) as u64, 0);
            let place = self.counts.iter().position(|count| {
                seen += count;
                seen >= wanted
            });
            0.01 * (place.unwrap_or(MAX_TICKS) as f64 + 1.0)
        };
        let [p50, p99, p999] = [0.5, 0.99, 0.999].map(share);
        println!("| {round_trip_ms} | {p50:.2} | {p99:.2} | {p999:.2} | {:.0} |", self.most_ns as f64 * 1e-3);
    }
}

const HEAD: &str = "| round trip, ms | p50, µs | p99, µs | p99.9, µs | most, µs |\n|---|---|---|---|---|";

/// Starts threads that allocate and free memory: a tick must not meet the allocator's lock.
fn busy<'s>(scope: &'s std::thread::Scope<'s, '_>, others: usize, is_over: &'s AtomicBool) {
    for _ in 0..others {
        scope.spawn(move || {
            while !is_over.load(Ordering::Relaxed) {
                std::hint::black_box(vec![1_u8; 4096]);
            }
        });
    }
}

fn main() {
    let others = std::thread::available_parallelism().map_or(1, usize::from);
    // The law of a sheet is flat, that of an organ is curved.
    let [flat, round] = [0.0, 20.0].map(|curvature| (0..2000).map(|tick| sample(tick, curvature)).collect::<Vec<_>>());
    println!("A sample before each tick; {} ticks, {others} other threads busy:", TICKS / 10);
    for (what, models, round_trip) in [("a sheet", &flat), ("an organ", &round)]
        .into_iter()
        .flat_map(|(what, models)| [1, 5, 20, 50, 200].map(|round_trip| (what, models, round_trip)))
    {
        if round_trip == 1 {
            println!("\n{what}:\n\n{HEAD}");
        }
        let Offline { mut ticker, mut record } = offline();
        let (mut times, is_over) = (TickTimes::new(), AtomicBool::new(false));
        std::thread::scope(|scope| {
            busy(scope, others, &is_over);
            for tick in 0..TICKS / 10 {
                if tick >= round_trip {
                    record.arrive(&sample_of(models, tick - round_trip)).unwrap();
                }
                times.tick(&mut ticker, tick);
            }
            is_over.store(true, Ordering::Relaxed);
        });
        times.row(round_trip);
    }
    println!(
        "\nSamples by another thread, as fast as it can; {TICKS} ticks without a pause, {others} more threads busy:\n\n{HEAD}"
    );
    for round_trip in [1, 5, 50] {
        let Offline { mut ticker, mut record } = offline();
        let (now, is_over) = (AtomicU32::new(0), AtomicBool::new(false));
        let mut times = TickTimes::new();
        std::thread::scope(|scope| {
            let (now, is_over, models) = (&now, &is_over, &round);
            scope.spawn(move || {
                let mut last = u32::MAX;
                while !is_over.load(Ordering::Relaxed) {
                    let tick = now.load(Ordering::Relaxed);
                    if tick < round_trip || tick == last {
                        std::hint::spin_loop();
                        continue;
                    }
                    last = tick;
                    record.arrive(&sample_of(models, tick - round_trip)).unwrap();
                }
            });
            busy(scope, others, is_over);
            for tick in 0..TICKS {
                now.store(tick, Ordering::Relaxed);
                times.tick(&mut ticker, tick);
            }
            is_over.store(true, Ordering::Relaxed);
        });
        times.row(round_trip);
    }
}
