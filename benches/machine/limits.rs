//! The limits of this processor, as JSON: the kernel benchmark compiles this file for it and runs it.
//! Arguments: sides of the sheets whose memory traffic it measures.

use std::hint::black_box;
use std::time::Instant;

/// The least time of `runs` runs of `work`, s.
fn least_s(runs: usize, mut work: impl FnMut()) -> f64 {
    let once = |()| {
        let start = Instant::now();
        work();
        start.elapsed().as_secs_f64()
    };
    std::iter::repeat_n((), runs).map(once).fold(f64::INFINITY, f64::min)
}

/// Dependent multiplications and exclusive ors: 3 + 1 cycles on every recent x86.
fn clock_ghz() -> f64 {
    const LINKS: u32 = 1_000_000;
    let (factor, mask) = (black_box(0x9e37_79b9_7f4a_7c15_u64), black_box(0x5555_u64));
    let mut x = black_box(1_u64);
    let chain_s = least_s(20, || {
        for _ in 0..LINKS {
            x = x.wrapping_mul(factor) ^ mask;
        }
        x = black_box(x);
    });
    4.0 * f64::from(LINKS) / chain_s * 1e-9
}

/// A fused multiply-add of 16 lanes, ns: chains on many values in the nearest cache.
fn fma_of_16_lanes_ns() -> f64 {
    const VALUES: usize = 4096;
    const CHAIN: usize = 8;
    const PASSES: usize = 500;
    let (factor, term) = (black_box(0.999_f32), black_box(1e-3_f32));
    let mut values = vec![1.0_f32; VALUES];
    let run_s = least_s(50, || {
        for _ in 0..PASSES {
            for value in &mut values {
                for _ in 0..CHAIN {
                    *value = value.mul_add(factor, term);
                }
            }
            black_box(&mut values);
        }
    });
    run_s * 1e9 / (VALUES / 16 * CHAIN * PASSES) as f64
}

/// Reading and writing back 6 arrays of f32 (displacement and increment of each point), ns per point.
fn traffic_ns(side: usize) -> f64 {
    let points = side * side;
    let mut arrays: [Vec<f32>; 6] = std::array::from_fn(|_| vec![0.5; points]);
    let passes = (4_000_000 / points).max(1);
    let run_s = least_s(20, || {
        for _ in 0..passes {
            for array in &mut arrays {
                for value in array.iter_mut() {
                    *value = 1.0 - 0.5 * *value;
                }
            }
            black_box(&mut arrays);
        }
    });
    run_s * 1e9 / (points * passes) as f64
}

fn main() {
    let sides = std::env::args().skip(1).filter_map(|side| side.parse::<usize>().ok());
    let traffic: Vec<String> = sides.map(|side| format!("\"{side}\": {}", traffic_ns(side))).collect();
    let (clock_ghz, fma_ns) = (clock_ghz(), fma_of_16_lanes_ns());
    println!(
        "{{\"clock_ghz\": {clock_ghz}, \"fma_of_16_lanes_ns\": {fma_ns}, \"traffic_ns_per_point\": {{{}}}}}",
        traffic.join(", ")
    );
}
