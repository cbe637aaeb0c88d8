//! Every decoder under inputs that are nearly right: valid ones, bent, cut, spliced, with the numbers that hurt. The
//! same functions as under libFuzzer (`fuzz/`); here without instrumentation, and the same inputs in every run.
//!
//! Twenty thousand for each decoder in every run of the tests; `make fuzz` tries a million (`PALPATE_FUZZ_INPUTS`).
#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::cast_precision_loss,
    clippy::disallowed_methods
)]

#[path = "common/cases.rs"]
mod cases;
#[path = "common/counting.rs"]
mod counting;
#[path = "../fuzz/src/lib.rs"]
#[allow(dead_code, clippy::cast_possible_truncation)]
mod targets;

use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};

use counting::counted;
use fastrand::Rng;
use palpate_proto::measure::{MULTIPLE, ROOM};
use palpate_proto::pb;
use prost::Message;
use targets::{FuzzTarget, REQUESTS, TARGETS, Taker, requests};

/// Inputs that were taken and are bent further.
const CORPUS: usize = 512;

/// Inputs between two messages of progress.
const PROGRESS: u64 = 50_000;

/// Longest input, bytes.
const LONGEST: usize = 1 << 14;

/// Additional memory that an input may take, bytes: for a message, and for a small tissue that is compiled and
/// rehearsed.
const MAX_ROOM: usize = 3 * ROOM;

/// Pieces of text and of protobuf at which readers stumble.
fn pieces() -> Vec<Vec<u8>> {
    let texts = [
        "nan",
        "inf",
        "-inf",
        "-1e400",
        "1e308",
        "-0.0",
        "5e-324",
        "99999999999999999999",
        "-1",
        "0",
        "[",
        "]",
        "{",
        "}",
        "[[force]]",
        "[sheet]",
        "=",
        "\n",
        "\"",
        "\"\"\"",
        "#",
        "\u{0}",
        "\u{feff}",
        "\u{10ffff}",
        "points",
        ".",
        "e",
        "true",
    ];
    let numbers = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX, f64::MIN_POSITIVE, 5e-324, -0.0, 1e18, -1.0];
    let mut pieces: Vec<Vec<u8>> = texts.iter().map(|text| text.as_bytes().to_vec()).collect();
    pieces.extend(numbers.iter().map(|number| number.to_le_bytes().to_vec()));
    // Varints: the largest, one too long, 2³² and 2³¹.
    pieces.push([&[0xff; 9][..], &[1]].concat());
    pieces.push(vec![0xff; 11]);
    pieces.push(vec![0x80, 0x80, 0x80, 0x80, 0x10]);
    pieces.push(vec![0x80, 0x80, 0x80, 0x80, 0x08]);
    pieces
}

/// A place in `bytes`, also the one behind the last.
fn place(random: &mut Rng, bytes: &[u8]) -> usize {
    random.usize(0..=bytes.len())
}

/// `bytes` with one thing changed.
fn bend(random: &mut Rng, mut bytes: Vec<u8>, other: &[u8], pieces: &[Vec<u8>]) -> Vec<u8> {
    let from = place(random, &bytes);
    let to = (from + random.usize(0..=16)).min(bytes.len());
    match random.u8(0..9) {
        0 if from < bytes.len() => bytes[from] ^= 1 << random.u8(0..8),
        1 if from < bytes.len() => bytes[from] = random.u8(..),
        2 => drop(bytes.drain(from..to)),
        3 => {
            let again = bytes[from..to].to_vec();
            let at = place(random, &bytes);
            bytes.splice(at..at, again);
        }
        4 | 5 => {
            let piece = pieces[random.usize(0..pieces.len())].clone();
            // In the place of something as long, or between.
            let to = if random.bool() { (from + piece.len()).min(bytes.len()) } else { from };
            bytes.splice(from..to, piece);
        }
        6 => {
            let (first, last) = (place(random, other), place(random, other));
            bytes.splice(from..to, other[first.min(last)..first.max(last)].to_vec());
        }
        7 => bytes.truncate(from),
        _ => bytes.insert(from, random.u8(..)),
    }
    bytes.truncate(LONGEST);
    bytes
}

fn fuzz(target: &FuzzTarget, inputs: u64) {
    let pieces = pieces();
    let mut random = Rng::with_seed(0x7011_ca7e);
    let mut corpus = (target.seeds)();
    for seed in &corpus {
        assert!((target.run)(seed), "{} does not take its own seed {:?}", target.name, String::from_utf8_lossy(seed));
    }
    let seeds = corpus.len();
    let (mut taken, mut most_bytes, mut most_multiple, mut slowest) = (0, 0, 0.0_f64, Duration::ZERO);
    let started = Instant::now();
    for tried in 0..inputs {
        // Runs of minutes show how far they are.
        if tried > 0 && tried % PROGRESS == 0 {
            eprintln!("{}: {tried} of {inputs} inputs after {:.0} s", target.name, started.elapsed().as_secs_f64());
        }
        let mut bytes = corpus[random.usize(0..corpus.len())].clone();
        for _ in 0..=random.u8(0..6) {
            let other = random.usize(0..corpus.len());
            bytes = bend(&mut random, bytes, &corpus[other], &pieces);
        }
        let begun = Instant::now();
        let (ran, took) = counted(|| catch_unwind(AssertUnwindSafe(|| (target.run)(&bytes))));
        let Ok(was_taken) = ran else {
            panic!("{} panics at {:?}\nas text: {}", target.name, bytes, String::from_utf8_lossy(&bytes));
        };
        slowest = slowest.max(begun.elapsed());
        assert!(
            took <= MULTIPLE * bytes.len() + MAX_ROOM,
            "{}: {} bytes take {took} of memory: {:?}\nas text: {}",
            target.name,
            bytes.len(),
            bytes,
            String::from_utf8_lossy(&bytes)
        );
        most_bytes = most_bytes.max(took);
        most_multiple = most_multiple.max(took as f64 / bytes.len().max(64) as f64);
        if was_taken {
            taken += 1;
            // The seeds stay.
            if corpus.len() < CORPUS {
                corpus.push(bytes);
            } else {
                corpus[random.usize(seeds..CORPUS)] = bytes;
            }
        }
    }
    println!(
        "{}: {inputs} inputs, {taken} of them taken; memory at most {:.0} KiB, {most_multiple:.0} times the bytes of an input (of 64 at least); the slowest took {:.1} ms",
        target.name,
        most_bytes as f64 / 1024.0,
        slowest.as_secs_f64() * 1e3
    );
    // Else the readers were hardly tried.
    assert!(taken > inputs / 1000 && taken < inputs, "{}: {taken} of {inputs} taken", target.name);
}

fn fuzz_named(name: &str) {
    let inputs = cases::count("PALPATE_FUZZ_INPUTS", 6000, 200_000);
    fuzz(TARGETS.iter().find(|target| target.name == name).unwrap(), inputs);
}

macro_rules! decoders {
    ($($name:ident)*) => {
        $(#[test] fn $name() { fuzz_named(stringify!($name)); })*

        #[test]
        fn every_target_is_a_test_and_a_program_for_libfuzzer() {
            let programs = include_str!("../fuzz/Cargo.toml");
            let names: BTreeSet<_> = TARGETS.iter().map(|target| target.name).collect();
            assert_eq!(names, BTreeSet::from([$(stringify!($name)),*]));
            names.iter().for_each(|name| assert!(programs.contains(&format!("name = \"{name}\""))));
        }
    };
}

decoders! { journal scene script request datagram sample record frame config snapshot }

#[test]
fn every_request_of_the_protocol_is_tried() {
    let mut asked = BTreeSet::new();
    for file in prost_types::FileDescriptorSet::decode(pb::DESCRIPTORS).unwrap().file {
        for method in file.service.iter().flat_map(|service| &service.method) {
            asked.insert(method.input_type().rsplit('.').next().unwrap().to_owned());
        }
    }
    let names = |requests: &[(&str, Taker)]| {
        requests.iter().map(|request| request.0.to_owned()).filter(|name| !name.is_empty()).collect::<BTreeSet<_>>()
    };
    assert_eq!(names(requests()), asked);
    assert!(names(REQUESTS).is_subset(&asked) && requests().len() == asked.len() + 1);
    // The first byte of an input chooses one.
    assert!(requests().len() < 256);
}
