//! Tests every reader with inputs that are almost valid: valid files that are corrupted, cut, spliced, and filled
//! with critical numbers. Each accepted file is reported, repaired, decimated and written.
//!
//! Each test run uses four thousand inputs for each reader, or `PALPATE_FUZZ_INPUTS`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod common;

use std::panic::{AssertUnwindSafe, catch_unwind};

use fastrand::Rng;
use palpate_geometry::decimate::decimate;
use palpate_geometry::delaunay::flip_to_delaunay;
use palpate_geometry::repair::{Repair, repair};
use palpate_geometry::report::report;
use palpate_geometry::write::{Format, write};
use palpate_geometry::{ReadLimits, Unit, prepare, read, read_label};

/// Number of accepted inputs that are mutated further.
const CORPUS: usize = 256;

/// Longest input, bytes.
const LONGEST: usize = 1 << 14;

/// Parts the two files of TetGen in an input.
const FORM_FEED: u8 = 0x0c;

/// Maximum memory for a run of all readers, bytes. A single unchecked count would need more.
const MEMORY: u64 = 512 << 20;

/// Byte sequences that are critical for readers.
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
        "4294967295",
        "2147483648",
        "-1",
        "0",
        "1",
        "[",
        "]",
        "{",
        "}",
        "\n",
        "\"",
        "\\\n",
        "/",
        "//",
        "<",
        ">",
        "</",
        "<a>",
        "&amp;",
        "<![CDATA[",
        "<!--",
        "\u{0}",
        "\u{feff}",
        "\u{10ffff}",
        "%2e",
        "f ",
        "v ",
        "$End",
        "\n$Nodes\n",
        "\n$Elements\n",
        "CELLS 1 1\n",
        "\n*NODE\n",
        "\n*ELEMENT, TYPE=C3D4\n",
        "\n*Part\n",
        ",",
        " Tetrahedra 1 ",
        "\x0c",
        "sizes: 1 70000 3",
        "(1e-300,0,nan)",
        " none ",
        " 65536",
    ];
    let mut pieces: Vec<Vec<u8>> = texts.iter().map(|text| text.as_bytes().to_vec()).collect();
    for number in [0_u64, 1, 0x7fff_ffff, 0x8000_0000, 0xffff_ffff, 1 << 40, i64::MAX as u64, 1 << 63, u64::MAX] {
        pieces.push(number.to_le_bytes().to_vec());
        pieces.push(number.to_be_bytes().to_vec());
        pieces.push(number.to_le_bytes()[..4].to_vec());
        pieces.push(number.to_be_bytes()[4..].to_vec());
    }
    for number in [f64::NAN, f64::INFINITY, f64::MAX, f64::MIN_POSITIVE, 5e-324] {
        pieces.push(number.to_le_bytes().to_vec());
        pieces.push((number as f32).to_le_bytes().to_vec());
    }
    pieces
}

/// Returns `bytes` with one change.
fn bend(random: &mut Rng, mut bytes: Vec<u8>, other: &[u8], pieces: &[Vec<u8>]) -> Vec<u8> {
    let from = random.usize(0..=bytes.len());
    let to = (from + random.usize(0..=16)).min(bytes.len());
    match random.u8(0..9) {
        0 if from < bytes.len() => bytes[from] ^= 1 << random.u8(0..8),
        1 if from < bytes.len() => bytes[from] = random.u8(..),
        2 => drop(bytes.drain(from..to)),
        3 => {
            let again = bytes[from..to].to_vec();
            let at = random.usize(0..=bytes.len());
            bytes.splice(at..at, again);
        }
        4 | 5 => {
            let piece = pieces[random.usize(0..pieces.len())].clone();
            // Replaces as many bytes, or is inserted.
            let to = if random.bool() { (from + piece.len()).min(bytes.len()) } else { from };
            bytes.splice(from..to, piece);
        }
        6 => {
            let (first, last) = (random.usize(0..=other.len()), random.usize(0..=other.len()));
            bytes.splice(from..to, other[first.min(last)..first.max(last)].to_vec());
        }
        7 => bytes.truncate(from),
        _ => bytes.insert(from, random.u8(..)),
    }
    bytes.truncate(LONGEST);
    bytes
}

/// Reads a file, and applies all operations to the mesh. Returns the number of triangles if the file was accepted.
fn try_all(name: &str, bytes: &[u8]) -> Option<usize> {
    // The other file of TetGen comes after a form feed.
    let ends = name.ends_with(".ele").then(|| bytes.iter().position(|byte| *byte == FORM_FEED)).flatten();
    let (bytes, beside) = ends.map_or((bytes, &[1; 128][..]), |end| (&bytes[..end], &bytes[end + 1..]));
    let neighbour = |_: &str| Some(beside.to_vec());
    let is_label_map = [".nrrd", ".nii", ".gz", ".dcm"].iter().any(|end| name.ends_with(end));
    let limits = ReadLimits::default();
    let read = if is_label_map {
        read_label(name, bytes, if name.ends_with("dcm") { 1 } else { 3 }, Some(Unit::METRE), &limits)
    } else {
        read(name, bytes, Unit::METRE, &neighbour, &limits)
    };
    let found = match read {
        Ok(found) => found,
        Err(error) => {
            assert!(error.to_string().starts_with(name.trim_end_matches("ele")));
            return None;
        }
    };
    let mesh = found.mesh;
    assert!(mesh.vertices_m.iter().all(|at| at.is_finite()));
    let count = mesh.vertices_m.len();
    assert!(mesh.triangles.iter().flatten().all(|vertex| (*vertex as usize) < count));
    assert!(mesh.uv.as_ref().is_none_or(|uv| uv.len() == mesh.triangles.len()));
    for group in &mesh.groups {
        assert!(
            group.vertices.is_sorted_by(|a, b| a < b) && group.vertices.iter().all(|vertex| (*vertex as usize) < count)
        );
    }
    if is_label_map {
        // It is closed whatever the labels; other formats try what follows on meshes of every kind.
        assert_eq!(report(&mesh).holes, 0);
        return Some(count);
    }
    assert!(serde_json::to_string(&report(&mesh)).is_ok());
    let prepared = prepare(mesh.clone());
    let joined = prepared.mesh.vertices_m.len();
    assert!(prepared.mesh.triangles.iter().flatten().all(|vertex| (*vertex as usize) < joined));
    if let Some(file) = &prepared.file {
        assert!(
            file.mesh.vertices_m.starts_with(&mesh.vertices_m) && file.mesh.vertices_m.len() == file.vertex_of.len()
        );
        assert!(file.vertex_of.iter().all(|vertex| (*vertex as usize) < joined));
        assert!(prepare(file.mesh.clone()).mesh == prepared.mesh, "prepared twice");
    }
    let _ = prepared.report();
    let repaired = repair(&mesh, &Repair::default());
    assert_eq!(repaired.vertex_of.len(), count);
    let after = report(&repaired.mesh);
    for name in ["degenerate", "duplicate_triangle", "unused_vertex", "not_finite", "index_out_of_range"] {
        // Filled holes may contain almost flat triangles.
        assert!(name == "degenerate" || !after.counts.contains_key(name), "{name}: {:?}", repaired.told);
    }
    let mut flipped = mesh.clone();
    flip_to_delaunay(&mut flipped);
    assert_eq!(flipped.triangles.len(), mesh.triangles.len());
    let coarse = decimate(&mesh, count / 2);
    assert!(coarse.places.len() == count || coarse.mesh.triangles.is_empty());
    for format in [Format::Obj, Format::Stl, Format::Ply] {
        assert!(!write(&repaired.mesh, format).is_empty());
    }
    Some(mesh.triangles.len())
}

/// The peak memory of this process, bytes; 0 if the system does not provide it.
fn most_memory() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    let kilobytes = line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok());
    kilobytes.unwrap_or(0) << 10
}

fn fuzz(extensions: &[&str]) {
    let inputs: u64 = std::env::var("PALPATE_FUZZ_INPUTS").map_or(4_000, |text| text.parse().unwrap());
    let mut random = Rng::with_seed(0x07_6a25);
    let is_own = |name: &str| extensions.iter().any(|extension| name.ends_with(extension));
    let mut corpus: Vec<(&str, Vec<u8>)> = common::samples()
        .into_iter()
        .map(|sample| (sample.name, sample.bytes))
        .chain(common::solids().into_iter().map(|solid| (solid.name, solid.text.into_bytes())))
        .chain([0, 1].map(|first| ("both.ele", common::tetgen(first).join("\x0c").into_bytes())))
        .chain(common::tiny_files())
        .filter(|(name, _)| is_own(name))
        .collect();
    for (name, bytes) in &corpus {
        assert!(try_all(name, bytes).is_some(), "{name}");
    }
    let (seeds, pieces, mut taken) = (corpus.len(), pieces(), 0);
    for _ in 0..inputs {
        let (name, mut bytes) = corpus[random.usize(0..corpus.len())].clone();
        for _ in 0..=random.u8(0..6) {
            let other = random.usize(0..corpus.len());
            bytes = bend(&mut random, bytes, &corpus[other].1, &pieces);
        }
        let ran = catch_unwind(AssertUnwindSafe(|| try_all(name, &bytes)));
        let Ok(triangles) = ran else {
            panic!("{name} panics at {bytes:?}\nas text: {}", String::from_utf8_lossy(&bytes));
        };
        taken += u64::from(triangles.is_some());
        // A file without triangles is not worth mutating. The seeds stay.
        if triangles.is_some_and(|triangles| triangles > 0) {
            if corpus.len() < CORPUS {
                corpus.push((name, bytes));
            } else {
                corpus[random.usize(seeds..CORPUS)] = (name, bytes);
            }
        }
    }
    println!("{extensions:?}: {inputs} inputs, {taken} of them taken, {} MiB", most_memory() >> 20);
    assert!(most_memory() < MEMORY, "{} MiB", most_memory() >> 20);
    // Otherwise the reader was hardly tested.
    assert!(taken > inputs / 1000 && taken < inputs, "{taken} of {inputs} taken");
}

#[test]
fn obj() {
    fuzz(&["obj"]);
}

#[test]
fn stl() {
    fuzz(&["stl"]);
}

#[test]
fn ply() {
    fuzz(&["ply"]);
}

#[test]
fn gltf() {
    fuzz(&["gltf", "glb"]);
}

#[test]
fn gmsh() {
    fuzz(&["msh"]);
}

#[test]
fn vtk() {
    fuzz(&["vtk"]);
}

#[test]
fn vtk_xml() {
    fuzz(&["vtp", "vtu"]);
}

#[test]
fn medit() {
    fuzz(&["mesh", "meshb"]);
}

#[test]
fn tetgen() {
    fuzz(&["ele"]);
}

#[test]
fn abaqus() {
    fuzz(&["inp"]);
}

#[test]
fn nrrd() {
    fuzz(&["nrrd"]);
}

#[test]
fn nifti() {
    fuzz(&["nii", "gz"]);
}

#[test]
fn dicom() {
    fuzz(&["dcm"]);
}
