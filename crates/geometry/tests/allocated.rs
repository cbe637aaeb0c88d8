//! The memory for reading a file is at most a multiple of its size, and is accounted for before it is allocated.
//! Tested with valid files, with corrupted ones, and with small files that demand much memory.
//!
//! Each test run reads a thousand corrupted files for each reader, or `PALPATE_FUZZ_INPUTS`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_precision_loss,
    clippy::cast_sign_loss
)]

mod common;
#[path = "../../../tests/common/counting.rs"]
mod counting;

use std::collections::BTreeMap;

use counting::counted;
use fastrand::Rng;
use palpate_geometry::read::{MULTIPLE, ROOM};
use palpate_geometry::{ReadLimits, Unit, prepare, read_paid};

/// Memory that is not accounted for: messages, and a vector that grows slightly before it is.
const SLACK: usize = 256 << 10;

/// Memory for the cells around a label, and for the surface between them, bytes.
const CELLS: usize = 160 << 20;

/// Maxima of a reader: memory as a multiple of the size of a file and its allowance, and bytes per element of a mesh
/// for preparing it.
#[derive(Default)]
struct Most {
    multiple: f64,
    element: f64,
}

fn try_one(name: &str, bytes: &[u8], most: &mut BTreeMap<String, Most>) -> bool {
    let mut paid = 0;
    let mut pay = |bytes: u64| {
        paid = bytes as usize;
        true
    };
    let limits = ReadLimits::default();
    let (read, took) =
        counted(|| read_paid(name, bytes, None, Some(Unit::METRE), &|_| None, &limits, &mut pay).map(|read| read.mesh));
    // A label map may unpack to far more than its bytes: its cells have a limit of their own.
    let is_label_map = [".nrrd", ".nii", ".gz", ".dcm"].iter().any(|end| name.ends_with(end));
    let room = if is_label_map { ROOM + CELLS } else { ROOM };
    let extension = name.rsplit('.').next().unwrap().to_owned();
    let own = most.entry(extension).or_default();
    own.multiple = own.multiple.max(took.saturating_sub(room) as f64 / bytes.len().max(1) as f64);
    let shown = String::from_utf8_lossy(&bytes[..bytes.len().min(300)]);
    assert!(took <= paid + SLACK, "{name}: {} bytes took {took}, but {paid} were paid for: {shown}", bytes.len());
    // For compressed arrays, four bytes for each compressed byte count towards the file size.
    let multiple = if name.ends_with(".vtp") || name.ends_with(".vtu") { 5 * MULTIPLE } else { MULTIPLE };
    assert!(took <= multiple * bytes.len() + room + SLACK, "{name}: {} bytes took {took}: {shown}", bytes.len());
    let Ok(mesh) = read else { return false };
    let elements = mesh.vertices_m.len() + mesh.triangles.len();
    if elements > 1000 {
        let (_, took) = counted(|| prepare(mesh.clone()).report_within(&limits));
        own.element = own.element.max(took as f64 / elements as f64);
    }
    true
}

fn tell(most: &BTreeMap<String, Most>) {
    for (name, Most { multiple, element }) in most {
        println!("{name}: {multiple:.1} times its bytes, {element:.0} bytes an element to prepare it");
    }
}

#[test]
fn bent_files_take_no_more_than_a_multiple_of_their_bytes() {
    let inputs: u64 = std::env::var("PALPATE_FUZZ_INPUTS").map_or(1_000, |text| text.parse().unwrap());
    let (mut random, mut most) = (Rng::with_seed(0x0a_110c), BTreeMap::new());
    let seeds: Vec<(&str, Vec<u8>)> = common::samples()
        .into_iter()
        .map(|sample| (sample.name, sample.bytes))
        .chain(common::solids().into_iter().map(|solid| (solid.name, solid.text.into_bytes())))
        .chain(common::tiny_files())
        .collect();
    let mut taken = 0;
    for _ in 0..inputs * 7 {
        let (name, mut bytes) = seeds[random.usize(0..seeds.len())].clone();
        for _ in 0..random.u8(1..4) {
            let from = random.usize(0..bytes.len());
            let to = (from + random.usize(1..64)).min(bytes.len());
            match random.u8(0..4) {
                0 => bytes[from] = random.u8(..),
                // Larger digits.
                1 => bytes[from..to].iter_mut().filter(|byte| byte.is_ascii_digit()).for_each(|byte| *byte = b'9'),
                2 => {
                    let piece = bytes[from..to].repeat(random.usize(1..200));
                    bytes.splice(from..from, piece);
                }
                _ => drop(bytes.drain(from..to)),
            }
            if bytes.is_empty() {
                bytes.push(b'v');
            }
        }
        taken += u64::from(try_one(name, &bytes, &mut most));
    }
    tell(&most);
    assert!(taken > inputs / 100, "{taken} taken");
}

/// VTK XML with the given arrays: name, type, and contents.
fn vtp(points: &str, more: &str) -> Vec<u8> {
    format!(
        "<VTKFile type=\"PolyData\" byte_order=\"LittleEndian\" header_type=\"UInt32\" compressor=\"vtkZLibDataCompressor\">\
         <PolyData><Piece NumberOfPoints=\"0\"><Points><DataArray type=\"Float64\" format=\"binary\">{points}</DataArray>\
         </Points>{more}</Piece></PolyData></VTKFile>"
    )
    .into_bytes()
}

/// Zeros compressed with zlib in blocks, in base64. The header states `said` as the size of a block.
fn packed(blocks: usize, bytes: usize, said: usize) -> String {
    use base64::Engine;
    use base64::engine::general_purpose::STANDARD;
    let block = miniz_oxide::deflate::compress_to_vec_zlib(&vec![0; bytes], 9);
    let mut header: Vec<u32> = vec![blocks as u32, said as u32, 0];
    header.extend(vec![block.len() as u32; blocks]);
    let header: Vec<u8> = header.iter().flat_map(|word| word.to_le_bytes()).collect();
    STANDARD.encode(header) + &STANDARD.encode(block.repeat(blocks))
}

#[test]
fn files_that_say_much_in_few_bytes_take_no_more_than_a_multiple_of_them() {
    let mut most = BTreeMap::new();
    let lines = |head: &str, line: &str, count: usize| (head.to_owned() + &line.repeat(count)).into_bytes();
    let triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";
    let gltf = |rest: &str| format!("{{\"asset\":{{\"version\":\"2.0\"}},{rest}}}").into_bytes();
    let list = |entry: &str, count: usize| vec![entry; count].join(",");
    let accessor = "{\"componentType\":5126,\"type\":\"VEC3\",\"count\":500000}";
    let primitive = "{\"attributes\":{\"POSITION\":0}}";
    let overlapping = "\"buffers\":[{\"byteLength\":8000,\"uri\":\"data:;base64,".to_owned()
        + &"AAAA".repeat(2667)
        + "\"}],\"bufferViews\":[{\"buffer\":0,\"byteLength\":8000,\"byteStride\":1}],\"accessors\":[{\"bufferView\":0,\
           \"componentType\":5126,\"type\":\"VEC3\",\"count\":7900}]";
    let ply = |vertices: usize, corners: usize| {
        let mut bytes = format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\nproperty char x\nproperty char y\n\
             property char z\nelement face 1\nproperty list int uchar vertex_indices\nend_header\n"
        )
        .into_bytes();
        bytes.extend((0..3 * vertices).map(|at| (at * 7919 % 251) as u8));
        bytes.extend((corners as u32).to_le_bytes());
        bytes.extend((0..corners).map(|at| (at * 31 % 200) as u8));
        bytes
    };
    let cells = |cell: &str, kind: &str, count: usize, width: usize| {
        format!(
            "# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 8 float\n0 0 0 1 0 0 1 1 0 0 1 0 0 0 1 \
             1 0 1 1 1 1 0 1 1\nCELLS {count} {}\n{}CELL_TYPES {count}\n{}",
            count * width,
            cell.repeat(count),
            kind.repeat(count)
        )
        .into_bytes()
    };
    let nodes = |count: usize| {
        let nodes: String = (0..count).map(|node| format!("{node} 0 0 0\n")).collect();
        let elements = format!("$Elements\n{count}\n{}$EndElements\n", "1 4 0 0 1 2 3\n".repeat(count));
        format!("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n{count}\n{nodes}$EndNodes\n{elements}").into_bytes()
    };
    let zeros = packed(40, 1 << 20, 1 << 20);
    let files: Vec<(&str, Vec<u8>)> = vec![
        ("groups.obj", lines(&format!("{triangle}o a\nusemtl b\ng a b c d e f g h\n"), "f 1 2 3\n", 100_000)),
        ("names.obj", (0..4096).map(|name| format!("g {name}\n")).collect::<String>().into_bytes()),
        ("corners.obj", lines(&format!("{triangle}f"), " 1 2", 200_000)),
        ("faces.obj", lines(triangle, "f 1 2 3\n", 200_000)),
        ("vertices.obj", lines("", "v 0 0 0\n", 200_000)),
        ("places.obj", lines(triangle, "vt 0\n", 200_000)),
        ("textured.obj", lines(&format!("{triangle}vt 0 0\n"), "f 1/1 2/1 3/1\n", 200_000)),
        ("accessor.gltf", gltf(&format!("\"meshes\":[{{\"primitives\":[{primitive}]}}],\"accessors\":[{accessor}]"))),
        (
            "primitives.gltf",
            gltf(&format!("\"meshes\":[{{\"primitives\":[{}]}}],{overlapping}", list(primitive, 3000))),
        ),
        (
            "nodes.gltf",
            gltf(&format!(
                "\"nodes\":[{}],\"meshes\":[{{\"primitives\":[{primitive}]}}],{overlapping}",
                list("{\"mesh\":0}", 3000)
            )),
        ),
        ("empty.gltf", gltf(&format!("\"nodes\":[{}]", list("{}", 16_000)))),
        (
            "lists.gltf",
            gltf(&format!("\"nodes\":[{0}],\"meshes\":[{0}],\"materials\":[{0}],\"scenes\":[{0}]", list("{}", 16_000))),
        ),
        ("children.gltf", gltf(&format!("\"nodes\":[{{\"children\":[{}]}},{{}}]", list("1", 16_000)))),
        ("corners.ply", ply(200, 150_000)),
        ("vertices.ply", ply(400_000, 3)),
        ("tetrahedra.vtk", cells("4 0 1 2 4\n", "10\n", 50_000, 5)),
        ("hexahedra.vtk", cells("8 0 1 2 3 4 5 6 7\n", "12\n", 30_000, 9)),
        ("strips.vtk", cells("9 0 1 2 3 4 5 6 7 0\n", "6\n", 30_000, 10)),
        ("polygon.vtk", cells(&format!("40000{}\n", " 1 2".repeat(20_000)), "7\n", 4, 40_001)),
        ("nodes.msh", nodes(40_000)),
        ("nodes.inp", {
            let nodes: String = (0..40_000).map(|node| format!("{node}\n")).collect();
            lines(&format!("*NODE\n{nodes}*ELEMENT,TYPE=C3D4,ELSET=a\n"), "1,0,1,2,3\n", 40_000)
        }),
        ("curved.inp", {
            let nodes = "1\n2,1,0,0\n3,0,1,0\n4,0,0,1\n5,.5,0,0\n6,.5,.5\n7,0,.5\n8,0,0,.5\n9,.5,0,.5\n10,0,.5,.5\n";
            lines(&format!("*NODE\n{nodes}*ELEMENT,TYPE=C3D10\n"), "1,1,2,3,4,5,6,7,8,9,10\n", 30_000)
        }),
        ("curved-apart.inp", {
            let element = |n: usize| (0..=10).map(|k| format!("{},", 10 * n + k)).collect::<String>() + "\n";
            let node = |n: usize| format!("{n},{},{},{}\n", n % 7, n * 31 % 11, n * 17 % 13);
            let nodes: String = (0..40_000).map(node).collect();
            (format!("*NODE\n{nodes}*ELEMENT,TYPE=C3D10,ELSET=a\n") + &(0..3_990).map(element).collect::<String>())
                .into_bytes()
        }),
        ("tetrahedra.mesh", {
            let vertices = "0 0 0 0\n1 0 0 0\n0 1 0 0\n0 0 1 0\n";
            let head = format!("MeshVersionFormatted 1\nDimension 3\nVertices 4\n{vertices}Tetrahedra 60000\n");
            [lines(&head, "1 2 3 4 1\n", 60_000), b"End".to_vec()].concat()
        }),
        ("zeros.vtp", vtp(&zeros, "")),
        ("more.vtp", vtp(&packed(4, 1 << 20, 1 << 10), "")),
        ("promised.vtp", vtp(&packed(1, 1 << 10, u32::MAX as usize), "")),
        (
            "cells.vtp",
            vtp(
                &packed(1, 1 << 10, 1 << 10),
                &format!(
                    "<Polys><DataArray type=\"Int8\" Name=\"connectivity\" format=\"binary\">{zeros}</DataArray>\
                     <DataArray type=\"Int8\" Name=\"offsets\" format=\"binary\">{zeros}</DataArray></Polys>"
                ),
            ),
        ),
        ("zeros.nii.gz", common::scan_of_zeros(200)),
        ("ones.nrrd", common::scan(60, |_| 1).nrrd(false, true)),
        ("noise.nrrd", {
            let mut random = Rng::with_seed(1);
            let noise: Vec<u8> = (0..27_000).map(|_| random.u8(0..2)).collect();
            common::scan(30, |at| noise[at]).nrrd(false, true)
        }),
        ("triangles.stl", lines("solid\n", "facet\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendfacet\n", 20_000)),
    ];
    for (name, bytes) in &files {
        let taken = try_one(name, bytes, &mut most);
        println!("{name}: {} bytes, {}", bytes.len(), if taken { "taken" } else { "refused" });
    }
    tell(&most);
}
