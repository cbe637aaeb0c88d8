//! An octahedron in every format that can be read, for the tests of the readers and as a seed for fuzzing.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used)]

mod label_maps;
mod others;

use std::fmt::Write;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use glam::DVec3;
use palpate_geometry::TriangleMesh;

#[allow(unused_imports)]
pub use label_maps::*;
pub use others::*;

/// Corners of an octahedron, mm.
pub const VERTICES: [[f64; 3]; 6] = [
    [100.0, 0.0, 0.0],
    [-100.0, 0.0, 0.0],
    [0.0, 100.0, 0.0],
    [0.0, -100.0, 0.0],
    [0.0, 0.0, 100.0],
    [0.0, 0.0, -100.0],
];

/// Its faces, counterclockwise seen from outside.
pub const TRIANGLES: [[u32; 3]; 8] =
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]];

/// The middle of the octahedron. Together with it, the faces form eight tetrahedra.
const MIDDLE: [f64; 3] = [0.0; 3];

/// Its volume, m³.
pub const VOLUME_M3: f64 = 4.0 / 3.0 * 1e-3;

/// A file: name and content.
pub struct SampleFile {
    pub name: &'static str,
    pub bytes: Vec<u8>,
    /// Whether a truncated file can be distinguished from a complete one.
    pub knows_its_end: bool,
}

fn sample(name: &'static str, bytes: impl Into<Vec<u8>>) -> SampleFile {
    SampleFile { name, bytes: bytes.into(), knows_its_end: true }
}

/// The octahedron as a mesh in metres.
pub fn octahedron() -> TriangleMesh {
    TriangleMesh {
        vertices_m: VERTICES.iter().map(|at| DVec3::from_array(*at) * 1e-3).collect(),
        triangles: TRIANGLES.to_vec(),
        ..TriangleMesh::default()
    }
}

/// A sphere with a radius of 0.1 m: the octahedron, subdivided `halvings` times.
pub fn sphere(halvings: usize) -> TriangleMesh {
    let mut mesh = octahedron();
    for _ in 0..halvings {
        let mut middles = std::collections::BTreeMap::new();
        let mut triangles = Vec::new();
        for [a, b, c] in mesh.triangles {
            let [ab, bc, ca] = [[a, b], [b, c], [c, a]].map(|[from, to]| {
                *middles.entry([from.min(to), from.max(to)]).or_insert_with(|| {
                    let sum = mesh.vertices_m[from as usize] + mesh.vertices_m[to as usize];
                    mesh.vertices_m.push(sum.normalize() * 0.1);
                    u32::try_from(mesh.vertices_m.len() - 1).unwrap()
                })
            });
            triangles.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
        }
        mesh.triangles = triangles;
    }
    mesh
}

/// A flat sheet of `n` × `n` squares, 0.1 m wide. Each vertex is displaced by the result of `jitter`, in units of a
/// square's side.
pub fn sheet(n: u32, mut jitter: impl FnMut() -> f64) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for y in 0..=n {
        for x in 0..=n {
            let is_inner = x > 0 && y > 0 && x < n && y < n;
            let [dx, dy] = if is_inner { [jitter(), jitter()] } else { [0.0; 2] };
            let at = DVec3::new(f64::from(x) + dx, f64::from(y) + dy, 0.0);
            mesh.vertices_m.push(at * (0.1 / f64::from(n)));
            if x < n && y < n {
                let a = y * (n + 1) + x;
                mesh.triangles.extend([[a, a + 1, a + n + 2], [a, a + n + 2, a + n + 1]]);
            }
        }
    }
    mesh
}

fn bytes<const N: usize>(numbers: impl IntoIterator<Item = [u8; N]>) -> Vec<u8> {
    numbers.into_iter().flatten().collect()
}

fn coordinates() -> impl Iterator<Item = f64> {
    VERTICES.into_iter().flatten()
}

fn lines(numbers: &[[f64; 3]]) -> String {
    numbers.iter().map(|[x, y, z]| format!("{x} {y} {z}\n")).collect()
}

pub fn obj() -> String {
    let mut text = String::from("# an octahedron\nmtllib skin.mtl\no organ\n");
    for [x, y, z] in VERTICES {
        writeln!(text, "v {x} {y} {z}").unwrap();
    }
    text += "vt 0 0\nvt 1 0\nvt 0 1\nvn 0 0 1\n";
    for (number, [a, b, c]) in TRIANGLES.iter().enumerate() {
        match number {
            0 => text += "g top\nusemtl red skin\n",
            4 => text += "g bottom\n",
            _ => {}
        }
        writeln!(text, "f {}/1/1 {}/2/1 {}/3/1", a + 1, b + 1, c + 1).unwrap();
    }
    text
}

pub fn stl_text() -> String {
    let mut text = String::from("solid an organ\n");
    for triangle in TRIANGLES {
        text += " facet normal 0 0 0\n  outer loop\n";
        for vertex in triangle {
            let [x, y, z] = VERTICES[vertex as usize];
            writeln!(text, "   vertex {x:e} {y:e} {z:e}").unwrap();
        }
        text += "  endloop\n endfacet\n";
    }
    text + "endsolid an organ\n"
}

pub fn stl_binary() -> Vec<u8> {
    // Many programs begin binary files like this.
    let mut file = b"solid binary".to_vec();
    file.resize(80, 0);
    file.extend(8_u32.to_le_bytes());
    for triangle in TRIANGLES {
        file.extend([0; 12]);
        let at = triangle.map(|vertex| VERTICES[vertex as usize]);
        file.extend(bytes(at.into_iter().flatten().map(|part| (part as f32).to_le_bytes())));
        file.extend([0; 2]);
    }
    file
}

fn ply_header(format: &str) -> String {
    format!(
        "ply\nformat {format} 1.0\ncomment made by a test\nelement vertex 6\nproperty float x\nproperty float y\n\
         property float z\nproperty uchar red\nelement face 8\nproperty list uchar int vertex_indices\nend_header\n"
    )
}

pub fn ply_text() -> String {
    let mut text = ply_header("ascii");
    for [x, y, z] in VERTICES {
        writeln!(text, "{x} {y} {z} 255").unwrap();
    }
    for [a, b, c] in TRIANGLES {
        writeln!(text, "3 {a} {b} {c}").unwrap();
    }
    text
}

pub fn ply_binary(is_big: bool) -> Vec<u8> {
    let mut file = ply_header(if is_big { "binary_big_endian" } else { "binary_little_endian" }).into_bytes();
    let word = |bytes: [u8; 4]| if is_big { bytes.into_iter().rev().collect::<Vec<_>>() } else { bytes.to_vec() };
    for at in VERTICES {
        at.iter().for_each(|part| file.extend(word((*part as f32).to_le_bytes())));
        file.push(255);
    }
    for triangle in TRIANGLES {
        file.push(3);
        triangle.iter().for_each(|vertex| file.extend(word(vertex.to_le_bytes())));
    }
    file
}

/// Positions as f32, then indices as u16.
fn gltf_buffer() -> Vec<u8> {
    let mut buffer = bytes(coordinates().map(|part| (part as f32).to_le_bytes()));
    buffer.extend(bytes(TRIANGLES.into_iter().flatten().map(|vertex| (vertex as u16).to_le_bytes())));
    buffer
}

fn gltf_json(uri: &str) -> String {
    // A node moves the octahedron, and its child moves it back.
    format!(
        r#"{{"asset":{{"version":"2.0"}},"scene":0,"scenes":[{{"nodes":[1]}}],
"nodes":[{{"mesh":0,"name":"organ","translation":[-1,0,0]}},{{"children":[0],"matrix":[1,0,0,0,0,1,0,0,0,0,1,0,1,0,0,1]}}],
"meshes":[{{"primitives":[{{"attributes":{{"POSITION":0}},"indices":1,"material":0}},{{"attributes":{{"POSITION":0}},"mode":0}}]}}],
"materials":[{{"name":"skin"}}],
"accessors":[{{"bufferView":0,"componentType":5126,"count":6,"type":"VEC3"}},
{{"bufferView":1,"componentType":5123,"count":24,"type":"SCALAR"}}],
"bufferViews":[{{"buffer":0,"byteLength":72}},{{"buffer":0,"byteOffset":72,"byteLength":48}}],
"buffers":[{{"byteLength":120{uri}}}]}}"#
    )
}

pub fn gltf_embedded() -> String {
    gltf_json(&format!(r#","uri":"data:application/octet-stream;base64,{}""#, STANDARD.encode(gltf_buffer())))
}

/// With a buffer in a separate file `organ data.bin`.
pub fn gltf_apart() -> (String, Vec<u8>) {
    (gltf_json(r#","uri":"organ%20data.bin""#), gltf_buffer())
}

pub fn glb() -> Vec<u8> {
    let mut json = gltf_json("").into_bytes();
    while !json.len().is_multiple_of(4) {
        json.push(b' ');
    }
    glb_of(&json)
}

fn glb_of(json: &[u8]) -> Vec<u8> {
    let buffer = gltf_buffer();
    let length = 12 + 8 + json.len() + 8 + buffer.len();
    let word = |number: usize| u32::try_from(number).unwrap().to_le_bytes();
    let parts: [&[u8]; 9] =
        [b"glTF", &word(2), &word(length), &word(json.len()), b"JSON", json, &word(buffer.len()), b"BIN\0", &buffer];
    parts.concat()
}

pub fn gmsh_1() -> String {
    let mut text = String::from("$NOD\n6\n");
    for (number, [x, y, z]) in VERTICES.iter().enumerate() {
        writeln!(text, "{} {x} {y} {z}", 10 * number + 7).unwrap();
    }
    text += "$ENDNOD\n$ELM\n8\n";
    for (number, triangle) in TRIANGLES.iter().enumerate() {
        let [a, b, c] = triangle.map(|vertex| 10 * vertex + 7);
        writeln!(text, "{} 2 {} 1 3 {a} {b} {c}", number + 1, if number < 4 { 3 } else { 0 }).unwrap();
    }
    text + "$ENDELM\n"
}

pub fn gmsh_2(is_binary: bool) -> Vec<u8> {
    let int = |number: u32| number.to_le_bytes();
    let mut file = format!("$MeshFormat\n2.2 {} 8\n", u8::from(is_binary)).into_bytes();
    if is_binary {
        file.extend(int(1));
        file.push(b'\n');
    }
    file.extend(b"$EndMeshFormat\n$PhysicalNames\n1\n2 3 \"top\"\n$EndPhysicalNames\n$Nodes\n6\n");
    for (number, at) in (1..).zip(VERTICES) {
        if is_binary {
            file.extend(int(number));
            file.extend(bytes(at.map(f64::to_le_bytes)));
        } else {
            file.extend(format!("{number} {} {} {}\n", at[0], at[1], at[2]).bytes());
        }
    }
    file.extend(b"$EndNodes\n$Elements\n8\n");
    for (number, triangle) in (1..).zip(TRIANGLES) {
        let physical = if number <= 4 { 3 } else { 0 };
        let [a, b, c] = triangle.map(|vertex| vertex + 1);
        if is_binary {
            file.extend(bytes([2, 1, 2, number, physical, 1, a, b, c].map(int)));
        } else {
            file.extend(format!("{number} 2 2 {physical} 1 {a} {b} {c}\n").bytes());
        }
    }
    file.extend(b"$EndElements\n");
    file
}

/// Tetrahedra in format 2.2, some with reversed orientation.
pub fn gmsh_volume() -> String {
    let mut text = String::from("$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n7\n1 0 0 0\n");
    for (number, [x, y, z]) in VERTICES.iter().enumerate() {
        writeln!(text, "{} {x} {y} {z}", number + 2).unwrap();
    }
    text += "$EndNodes\n$Elements\n8\n";
    for (number, triangle) in TRIANGLES.iter().enumerate() {
        let [a, b, c] = triangle.map(|vertex| vertex + 2);
        let [b, c] = if number % 2 == 0 { [b, c] } else { [c, b] };
        writeln!(text, "{} 4 2 5 1 1 {a} {b} {c}", number + 1).unwrap();
    }
    text + "$EndElements\n"
}

pub fn gmsh_4(is_binary: bool) -> Vec<u8> {
    let mut file = format!("$MeshFormat\n4.1 {} 8\n", u8::from(is_binary)).into_bytes();
    let put = |file: &mut Vec<u8>, ints: &[u32], sizes: &[u64], reals: &[f64]| {
        if is_binary {
            file.extend(bytes(ints.iter().map(|number| number.to_le_bytes())));
            file.extend(bytes(sizes.iter().map(|number| number.to_le_bytes())));
            file.extend(bytes(reals.iter().map(|number| number.to_le_bytes())));
        } else {
            ints.iter().for_each(|number| file.extend(format!("{number} ").bytes()));
            sizes.iter().for_each(|number| file.extend(format!("{number} ").bytes()));
            reals.iter().for_each(|number| file.extend(format!("{number} ").bytes()));
            file.push(b'\n');
        }
    };
    if is_binary {
        file.extend(1_u32.to_le_bytes());
        file.push(b'\n');
    }
    file.extend(b"$EndMeshFormat\n$PhysicalNames\n1\n2 3 \"top\"\n$EndPhysicalNames\n$Entities\n");
    // Two surfaces; the first one has the physical tag 3.
    put(&mut file, &[], &[0, 0, 2, 0], &[]);
    put(&mut file, &[1], &[], &[0.0; 6]);
    put(&mut file, &[], &[1], &[]);
    put(&mut file, &[3], &[0], &[]);
    put(&mut file, &[2], &[], &[0.0; 6]);
    put(&mut file, &[], &[0, 0], &[]);
    file.extend(b"\n$EndEntities\n$Nodes\n");
    put(&mut file, &[], &[1, 6, 1, 6], &[]);
    put(&mut file, &[2, 1, 0], &[6], &[]);
    put(&mut file, &[], &[1, 2, 3, 4, 5, 6], &[]);
    put(&mut file, &[], &[], &coordinates().collect::<Vec<_>>());
    file.extend(b"\n$EndNodes\n$Elements\n");
    put(&mut file, &[], &[2, 8, 1, 8], &[]);
    for (entity, start) in [(1, 0), (2, 4)] {
        put(&mut file, &[2, entity, 2], &[4], &[]);
        for (number, triangle) in TRIANGLES.iter().enumerate().skip(start).take(4) {
            let [a, b, c] = triangle.map(|vertex| u64::from(vertex) + 1);
            put(&mut file, &[], &[number as u64 + 1, a, b, c], &[]);
        }
    }
    file.extend(b"\n$EndElements\n");
    file
}

pub fn vtk(is_binary: bool) -> Vec<u8> {
    let kind = if is_binary { "BINARY" } else { "ASCII" };
    let mut file =
        format!("# vtk DataFile Version 3.0\nan organ\n{kind}\nDATASET POLYDATA\nPOINTS 6 float\n").into_bytes();
    if is_binary {
        file.extend(bytes(coordinates().map(|part| (part as f32).to_be_bytes())));
        file.extend(b"\nPOLYGONS 8 32\n");
        file.extend(bytes(TRIANGLES.iter().flat_map(|[a, b, c]| [3, *a, *b, *c]).map(u32::to_be_bytes)));
    } else {
        file.extend(lines(&VERTICES).bytes());
        file.extend(b"POLYGONS 8 32\n");
        TRIANGLES.iter().for_each(|[a, b, c]| file.extend(format!("3 {a} {b} {c}\n").bytes()));
    }
    file.extend(b"\nPOINT_DATA 6\nSCALARS s float 1\nLOOKUP_TABLE default\n");
    file
}

/// Tetrahedra in VTK's version 5.1, with separate offsets and connectivity.
pub fn vtk_volume(is_binary: bool) -> Vec<u8> {
    let kind = if is_binary { "BINARY" } else { "ASCII" };
    let mut file =
        format!("# vtk DataFile Version 5.1\nan organ\n{kind}\nDATASET UNSTRUCTURED_GRID\nPOINTS 7 double\n")
            .into_bytes();
    let points: Vec<f64> = coordinates().chain(MIDDLE).collect();
    let offsets: Vec<i64> = (0..=8).map(|cell| 4 * cell).collect();
    let connectivity: Vec<i64> = TRIANGLES.iter().flat_map(|[a, b, c]| [*a, *b, *c, 6]).map(i64::from).collect();
    let integers = |file: &mut Vec<u8>, numbers: &[i64]| {
        if is_binary {
            file.extend(bytes(numbers.iter().map(|number| number.to_be_bytes())));
        } else {
            numbers.iter().for_each(|number| file.extend(format!("{number} ").bytes()));
        }
    };
    if is_binary {
        file.extend(bytes(points.iter().map(|number| number.to_be_bytes())));
    } else {
        points.iter().for_each(|number| file.extend(format!("{number} ").bytes()));
    }
    file.extend(b"\nCELLS 9 32\nOFFSETS vtktypeint64\n");
    integers(&mut file, &offsets);
    file.extend(b"\nCONNECTIVITY vtktypeint64\n");
    integers(&mut file, &connectivity);
    file.extend(b"\nCELL_TYPES 8\n");
    if is_binary {
        file.extend(bytes([10_u32.to_be_bytes(); 8]));
    } else {
        file.extend(b"10\n10\n10\n10\n10\n10\n10\n10\n");
    }
    file
}

/// Encoding of the arrays in a VTK XML file.
#[derive(Clone, Copy, PartialEq, Eq)]
pub enum Xml {
    Text,
    Base64,
    Zlib,
    AppendedRaw,
    AppendedZlib,
}

pub fn vtp(xml: Xml) -> Vec<u8> {
    let is_zlib = matches!(xml, Xml::Zlib | Xml::AppendedZlib);
    let points = bytes(coordinates().map(|part| (part as f32).to_le_bytes()));
    let connectivity = bytes(TRIANGLES.into_iter().flatten().map(|vertex| i64::from(vertex).to_le_bytes()));
    let offsets = bytes((1..=8_i64).map(|face| (3 * face).to_le_bytes()));
    let texts = [
        lines(&VERTICES),
        TRIANGLES.iter().flatten().map(|vertex| format!("{vertex} ")).collect(),
        (1..=8).map(|face| format!("{} ", 3 * face)).collect(),
    ];
    let word = |number: usize| u32::try_from(number).unwrap().to_le_bytes();
    // Header and data, encoded separately.
    let stored = |data: &[u8]| -> [Vec<u8>; 2] {
        if is_zlib {
            // In two blocks.
            let size = data.len() / 2;
            let blocks =
                [&data[..size], &data[size..]].map(|block| miniz_oxide::deflate::compress_to_vec_zlib(block, 6));
            let last = if data.len().is_multiple_of(2) { 0 } else { size + 1 };
            let header = [2, size, last, blocks[0].len(), blocks[1].len()].map(word).concat();
            [header, blocks.concat()]
        } else {
            [word(data.len()).to_vec(), data.to_vec()]
        }
    };
    let mut appended = Vec::new();
    let mut array = |name: &str, kind: &str, text: &str, data: &[u8]| {
        let [header, data] = stored(data);
        let head = format!(r#"<DataArray type="{kind}" Name="{name}" NumberOfComponents="3""#);
        match xml {
            Xml::Text => format!("{head} format=\"ascii\">\n{text}</DataArray>\n"),
            Xml::Base64 => {
                format!("{head} format=\"binary\">\n {}\n</DataArray>\n", STANDARD.encode([header, data].concat()))
            }
            Xml::Zlib => {
                format!("{head} format=\"binary\">{}{}</DataArray>", STANDARD.encode(header), STANDARD.encode(data))
            }
            Xml::AppendedRaw | Xml::AppendedZlib => {
                let text = format!("{head} format=\"appended\" offset=\"{}\"/>\n", appended.len());
                if xml == Xml::AppendedRaw {
                    appended.extend([header, data].concat());
                } else {
                    appended.extend((STANDARD.encode(header) + &STANDARD.encode(data)).bytes());
                }
                text
            }
        }
    };
    let points = array("Points", "Float32", &texts[0], &points);
    let connectivity = array("connectivity", "Int64", &texts[1], &connectivity);
    let offsets = array("offsets", "Int64", &texts[2], &offsets);
    let compressor = if is_zlib { r#" compressor="vtkZLibDataCompressor""# } else { "" };
    let mut file = format!(
        "<?xml version=\"1.0\"?>\n<VTKFile type=\"PolyData\" version=\"0.1\" byte_order=\"LittleEndian\"{compressor}>\n\
         <PolyData><Piece NumberOfPoints=\"6\" NumberOfPolys=\"8\">\n<PointData></PointData>\n\
         <Points>\n{points}</Points>\n<Polys>\n{connectivity}{offsets}</Polys>\n</Piece></PolyData>\n"
    )
    .into_bytes();
    if !appended.is_empty() {
        let encoding = if xml == Xml::AppendedRaw { "raw" } else { "base64" };
        file.extend(format!("<AppendedData encoding=\"{encoding}\">\n_").bytes());
        file.extend(appended);
        file.extend(b"\n</AppendedData>\n");
    }
    file.extend(b"</VTKFile>\n");
    file
}

/// Tetrahedra as an XML unstructured grid.
pub fn vtu() -> String {
    let connectivity: String = TRIANGLES.iter().map(|[a, b, c]| format!("{a} {b} {c} 6\n")).collect();
    format!(
        "<VTKFile type=\"UnstructuredGrid\"><UnstructuredGrid><Piece>\n<Points><DataArray type=\"Float64\">{}0 0 0\n\
         </DataArray></Points>\n<Cells><DataArray type=\"Int32\" Name=\"connectivity\">{connectivity}</DataArray>\n\
         <DataArray type=\"Int32\" Name=\"offsets\">4 8 12 16 20 24 28 32</DataArray>\n\
         <DataArray type=\"UInt8\" Name=\"types\">10 10 10 10 10 10 10 10</DataArray></Cells>\n\
         </Piece></UnstructuredGrid></VTKFile>\n",
        lines(&VERTICES)
    )
}

/// The octahedron in every format.
pub fn samples() -> Vec<SampleFile> {
    let mut obj = sample("octahedron.obj", obj());
    obj.knows_its_end = false;
    let mut old = sample("old.obj", obj_of_old());
    old.knows_its_end = false;
    // The first solid alone is a complete file.
    let mut two = sample("two.stl", stl_of_two());
    two.knows_its_end = false;
    // Elements follow elements.
    let mut abaqus = sample("volume.inp", abaqus());
    abaqus.knows_its_end = false;
    vec![
        obj,
        old,
        two,
        abaqus,
        sample("volume.mesh", medit_text()),
        sample("volume-two.meshb", medit_binary(2)),
        sample("volume-four.meshb", medit_binary(4)),
        sample("more.stl", stl_with_more()),
        sample("wide.ply", ply_wide()),
        sample("strips.ply", ply_strips(false)),
        sample("strips-binary.ply", ply_strips(true)),
        sample("textures.glb", glb_with_textures()),
        sample("fields.vtk", vtk_fields(false)),
        sample("fields-binary.vtk", vtk_fields(true)),
        sample("volume-pyramids.vtk", vtk_pyramids()),
        sample("text.stl", stl_text()),
        sample("binary.stl", stl_binary()),
        sample("text.ply", ply_text()),
        sample("little.ply", ply_binary(false)),
        sample("big.ply", ply_binary(true)),
        sample("embedded.gltf", gltf_embedded()),
        sample("organ.glb", glb()),
        sample("one.msh", gmsh_1()),
        sample("two.msh", gmsh_2(false)),
        sample("two-binary.msh", gmsh_2(true)),
        sample("two-volume.msh", gmsh_volume()),
        sample("four.msh", gmsh_4(false)),
        sample("four-binary.msh", gmsh_4(true)),
        sample("text.vtk", vtk(false)),
        sample("binary.vtk", vtk(true)),
        sample("volume.vtk", vtk_volume(false)),
        sample("volume-binary.vtk", vtk_volume(true)),
        sample("text.vtp", vtp(Xml::Text)),
        sample("base64.vtp", vtp(Xml::Base64)),
        sample("zlib.vtp", vtp(Xml::Zlib)),
        sample("raw.vtp", vtp(Xml::AppendedRaw)),
        sample("appended.vtp", vtp(Xml::AppendedZlib)),
        sample("volume.vtu", vtu()),
    ]
}
