//! Files as other programs write them and as people edit them: each is either read correctly, or refused with the
//! cause.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod common;

use common::solids;
use palpate_geometry::{MeshError, MeshReport, ReadLimits, ReadMesh, Unit, read, report};

fn mm() -> Unit {
    "mm".parse().unwrap()
}

fn read_mm(name: &str, bytes: impl AsRef<[u8]>) -> Result<ReadMesh, MeshError> {
    read(name, bytes.as_ref(), mm(), &|_| None, &ReadLimits::default())
}

fn report_of(name: &str, bytes: impl AsRef<[u8]>) -> MeshReport {
    report(&read_mm(name, bytes).unwrap_or_else(|e| panic!("{e}")).mesh)
}

fn refusal(name: &str, bytes: impl AsRef<[u8]>) -> String {
    read_mm(name, bytes).map_or_else(|e| e.to_string(), |found| panic!("{name} is read: {:?}", found.mesh))
}

/// The corners of a box of 40 × 30 × 20 mm, and its triangles.
const CORNERS: &str = "0 0 0\n40 0 0\n40 30 0\n0 30 0\n0 0 20\n40 0 20\n40 30 20\n0 30 20\n";
const TRIANGLES: [[usize; 3]; 12] = [
    [0, 3, 2],
    [0, 2, 1],
    [4, 5, 6],
    [4, 6, 7],
    [0, 1, 5],
    [0, 5, 4],
    [1, 2, 6],
    [1, 6, 5],
    [2, 3, 7],
    [2, 7, 6],
    [3, 0, 4],
    [3, 4, 7],
];

fn triangles(line: impl Fn([usize; 3]) -> String) -> String {
    TRIANGLES.into_iter().map(line).collect()
}

fn obj() -> String {
    box_obj(1)
}

/// The box as OBJ. `first` is the index of its first vertex.
fn box_obj(first: usize) -> String {
    let vertices: String = CORNERS.lines().map(|line| format!("v {line}\n")).collect();
    vertices + &triangles(|[a, b, c]| format!("f {} {} {}\n", a + first, b + first, c + first))
}

fn stl() -> String {
    let corners: Vec<&str> = CORNERS.lines().collect();
    let facet = |triangle: [usize; 3]| {
        let vertices: String = triangle.iter().map(|corner| format!("vertex {}\n", corners[*corner])).collect();
        format!("facet normal 0 0 0\nouter loop\n{vertices}endloop\nendfacet\n")
    };
    format!("solid box\n{}endsolid box\n", triangles(facet))
}

fn ply_of(vertices: &str, faces: &str, properties: &str) -> String {
    format!(
        "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\nelement face 12\n\
         {properties}end_header\n{vertices}{faces}"
    )
}

fn ply() -> String {
    ply_of(CORNERS, &triangles(|[a, b, c]| format!("3 {a} {b} {c}\n")), "property list uchar int vertex_indices\n")
}

fn vtk() -> String {
    let faces = triangles(|[a, b, c]| format!("3 {a} {b} {c}\n"));
    format!(
        "# vtk DataFile Version 3.0\nbox\nASCII\nDATASET POLYDATA\nPOINTS 8 float\n{CORNERS}POLYGONS 12 48\n{faces}"
    )
}

fn gmsh() -> String {
    let nodes: String = CORNERS.lines().zip(1..).map(|(line, number)| format!("{number} {line}\n")).collect();
    let elements = triangles(|[a, b, c]| format!("1 2 2 1 1 {} {} {}\n", a + 1, b + 1, c + 1));
    format!(
        "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n8\n{nodes}$EndNodes\n$Elements\n12\n{elements}$EndElements\n"
    )
}

fn gltf() -> String {
    let json = common::gltf_embedded();
    json.replacen("\"nodes\":[1]", "\"nodes\":[0]", 1).replacen(",\"translation\":[-1,0,0]", "", 1)
}

/// Asserts that a file is the box.
#[track_caller]
fn is_box(what: &str, name: &str, bytes: impl AsRef<[u8]>) {
    let found = read_mm(name, bytes).unwrap_or_else(|e| panic!("{what}: {e}"));
    let report = report(&found.mesh);
    assert_eq!((report.triangles, report.holes, report.refusal()), (12, 0, None), "{what}: {found:?}");
    assert!((report.volume_m3.unwrap() - 24e-6).abs() < 1e-12, "{what}: {report:?}");
    assert!((report.area_m2 - 52e-4).abs() < 1e-9, "{what}: {report:?}");
}

#[test]
fn solids_close_and_have_their_volume_whatever_their_faces_and_the_sense_of_their_elements() {
    for solid in solids() {
        let report = report_of(solid.name, &solid.text);
        assert_eq!([report.vertices, report.triangles], solid.counts, "{}: {report:?}", solid.name);
        assert_eq!((report.holes, report.refusal(), report.counts.len()), (0, None, 0), "{}: {report:?}", solid.name);
        let (area, volume) = (report.area_m2 * 1e4, report.volume_m3.unwrap() * 1e6);
        assert!((area - solid.area_cm2).abs() < 1e-3, "{}: {area} cm²", solid.name);
        assert!((volume - solid.volume_ml).abs() < 1e-3, "{}: {volume} ml", solid.name);
    }
}

#[test]
fn every_text_may_end_lines_and_itself_as_any_system_does_and_begin_with_a_mark() {
    let files = [("a.obj", obj()), ("a.stl", stl()), ("a.ply", ply()), ("a.vtk", vtk()), ("a.msh", gmsh())];
    for (name, text) in &files {
        for end in ["\n", "\r\n", "\r", "\r\r\n", "\n\n", " \n"] {
            // Two empty lines would be the title of a VTK file.
            if !(name.ends_with("vtk") && ["\n\n", "\r\r\n"].contains(&end)) {
                is_box(&format!("{name} {end:?}"), name, text.replace('\n', end));
            }
        }
        for (start, end) in [("\u{feff}", ""), ("", "\0"), ("", "\0\0\0"), ("", "\u{1a}"), ("\u{feff}", "\n \n \0\n")] {
            is_box(&format!("{name} {start:?} {end:?}"), name, format!("{start}{text}{end}"));
        }
        for wide in [
            [b"\xff\xfe".to_vec(), text.encode_utf16().flat_map(u16::to_le_bytes).collect()].concat(),
            [b"\xfe\xff".to_vec(), text.encode_utf16().flat_map(u16::to_be_bytes).collect()].concat(),
            text.encode_utf16().flat_map(u16::to_le_bytes).collect(),
        ] {
            let refusal = refusal(name, wide);
            assert!(refusal.contains("UTF-16"), "{refusal}");
        }
        let commas = text.replace("40 30", "40,0 30,5");
        let refusal = refusal(name, commas);
        assert!(refusal.contains("`40,0` has a decimal comma") && refusal.contains("40.0"), "{refusal}");
        assert!(refusal.contains(": line "), "{refusal}");
    }
    for (start, end) in [("\u{feff}", ""), ("", "\0\0"), ("\u{feff}\r", "\r\0")] {
        assert_eq!(report_of("a.gltf", format!("{start}{}{end}", gltf())).triangles, 8);
        assert_eq!(report_of("a.vtu", format!("{start}{}", common::vtu())).triangles, 8);
    }
    let comma = refusal("a.vtu", common::vtu().replace("100 0 0", "100,0 0,5 1.000,25"));
    assert!(comma.contains("`100,0` has a decimal comma"), "{comma}");
    // In JSON a comma ends a number.
    let comma = refusal("a.gltf", common::gltf_embedded().replace("[-1,0,0]", "[-1,5,0,0,0,0]"));
    assert!(comma.contains("decimal comma"), "{comma}");
    // In lists of numbers with commas between them, these are not decimal commas.
    let list = refusal("a.obj", obj().replace("v 40 30 0", "v 40, 30, 0"));
    assert!(list.contains("`40,` is not a number"), "{list}");
    // Lines are counted as in editors.
    for end in ["\n", "\r\n", "\r"] {
        let refusal = refusal("a.obj", obj().replace("f 1 6 5", "f 1 6 x").replace('\n', end));
        assert!(refusal.starts_with("a.obj: line 14: `x`"), "{refusal}");
    }
}

#[test]
fn a_row_of_ply_is_a_line() {
    let list = "property list uchar int vertex_indices\n";
    let face = |[a, b, c]: [usize; 3]| format!("3 {a} {b} {c}");
    let faces = triangles(|own| face(own) + "\n");
    for (what, text) in [
        ("columns after lists", ply_of(CORNERS, &triangles(|own| face(own) + " 6 0.1 0.2 0.3 0.4 0.5 0.6\n"), list)),
        ("a column after lists", ply_of(CORNERS, &triangles(|own| face(own) + " 3\n"), list)),
        ("columns after vertices", ply_of(&CORNERS.replace('\n', " 0.5 255 255\n"), &faces, list)),
        ("words after lists", ply_of(CORNERS, &triangles(|own| face(own) + " # red\n"), list)),
        ("empty lines", ply_of(&CORNERS.replace('\n', "\n\n \t\n"), &faces, list)),
        ("comments", ply_of(CORNERS, &format!("comment faces\n{faces}comment end\n\n"), list)),
        (
            "lists of two kinds",
            ply_of(
                CORNERS,
                &triangles(|own| format!("6 0 0 1 0 1 1 {} 7\n", face(own))),
                &format!("property list uchar float texcoord\n{list}property int texnumber\n"),
            ),
        ),
        (
            "another list after that of vertices",
            ply_of(
                CORNERS,
                &triangles(|own| format!("{} 2 0.5 1e3 255\n", face(own))),
                &format!("{list}property list uchar float quality\nproperty uchar red\n"),
            ),
        ),
        ("another name of the list", ply_of(CORNERS, &faces, "property list uchar uint vertices\n")),
        ("indices with points", ply_of(CORNERS, &triangles(|[a, b, c]| format!("3.0 {a}.0 {b}.0 {c}.0\n")), list)),
    ] {
        is_box(what, "a.ply", text);
    }
    let notes = read_mm("a.ply", ply_of(CORNERS, &faces.replacen('\n', " 1\n", 3), list)).unwrap().notes;
    assert_eq!(notes, ["Rows with columns that the header does not name, which are left out: 3."]);
    for (what, text, says) in [
        (
            "a vertex of two numbers",
            ply_of(&CORNERS.replace("40 30 20", "40 30"), &faces, list),
            "line 16: the row ends",
        ),
        ("a face of two vertices", ply_of(CORNERS, &faces.replace("3 0 1 5", "3 0 1"), list), "line 22: the row ends"),
        ("a longer list", ply_of(CORNERS, &faces.replace("3 0 1 5", "9 0 1 5"), list), "line 22: the row ends early"),
        (
            "faces without their length",
            ply_of(CORNERS, &triangles(|[a, b, c]| format!("{a} {b} {c}\n")), list),
            "line 18: a face of 0 vertices in a longer row",
        ),
        (
            "half a vertex",
            ply_of(CORNERS, &faces.replace("3 0 1 5", "3 0 1.5 5"), list),
            "line 22: `1.5` is not a whole",
        ),
        ("a word", ply_of(CORNERS, &faces.replace("3 0 1 5", "3 0 one 5"), list), "line 22: `one` is not a number"),
        (
            "a vertex too many",
            ply_of(&format!("{CORNERS}1 1 1\n"), &faces, list),
            "line 18: a face of 1 vertices in a longer row",
        ),
        ("a face too many", ply_of(CORNERS, &format!("{faces}3 0 1 2\n"), list), "line 30: a row more"),
        (
            "a face too few",
            ply_of(CORNERS, faces.trim_end().rsplit_once('\n').unwrap().0, list),
            "row 11 of 12 of `face`",
        ),
        ("no z", ply_of(CORNERS, &faces, list).replace("property float z\n", ""), "no property `z`"),
        ("no list", ply_of(CORNERS, &faces, "property int red\n"), "no property `vertex_indices`"),
        ("a vertex that is not there", ply_of(CORNERS, &faces.replace("3 0 1 5", "3 0 1 8"), list), "face 4: vertex 8"),
    ] {
        let refusal = refusal("a.ply", text);
        assert!(refusal.contains(says), "{what}: {refusal}");
    }
}

#[test]
fn strips_of_triangles_are_read() {
    let strips = |list: &str, kind: &str| {
        format!(
            "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n\
             element tristrips {}\nproperty list int {kind} vertex_indices\nend_header\n{CORNERS}{list}\n",
            list.lines().count()
        )
    };
    // Around the box, its lid and its bottom.
    let parts = ["4 0 5 1 6 2 7 3 4 0", "7 4 6 5", "1 0 2 3"];
    is_box("parted by −1", "a.ply", strips(&format!("20 {} -1 {} -1 {}", parts[0], parts[1], parts[2]), "int"));
    is_box("ended by −1", "a.ply", strips(&format!("21 {} -1 {} -1 {} -1", parts[0], parts[1], parts[2]), "int"));
    is_box("in rows", "a.ply", strips(&format!("10 {}\n4 {}\n4 {}", parts[0], parts[1], parts[2]), "uint"));
    let end = u32::MAX;
    is_box("unsigned", "a.ply", strips(&format!("20 {} {end} {} {end} {}", parts[0], parts[1], parts[2]), "uint"));
    // A repeated vertex connects strips; the orientation alternates there as well.
    is_box("joined", "a.ply", strips("22 4 0 5 1 6 2 7 3 4 0 0 7 7 4 6 5 5 1 1 0 2 3", "int"));
    let refusal = refusal("a.ply", strips("4 0 4 1 8", "int"));
    assert!(refusal.contains("face 0: vertex 8 does not exist"), "{refusal}");
    let vtk = vtk();
    let head = vtk.split("POLYGONS").next().unwrap();
    is_box("VTK", "a.vtk", format!("{head}TRIANGLE_STRIPS 3 21\n10 {}\n4 {}\n4 {}\n", parts[0], parts[1], parts[2]));
}

#[test]
fn what_vtk_keeps_beside_a_surface_is_skipped() {
    let information = "METADATA\nINFORMATION 1\nNAME RANGE LOCATION vtkDataArray\nDATA 2 0 7\n\n";
    for field in [
        "FIELD FieldData 1\nSPACE 1 1 string\nLPS\n",
        "FIELD FieldData 2\nSPACE 1 2 string\nPOINTS\n\nmore 1 1 utf8_string\nx%20y\n",
        "field FieldData 1\nbits 3 3 bit\n1 0 1 0 1 1 0 0 1\n",
        "FIELD FieldData 3\nNULL_ARRAY\nids 1 2 vtkIdType\n1 2\nu 1 1 unsigned_long\n18446744073709551615\n",
        "FIELD FieldData 1\nany 1 2 variant\n6 3\n13 a%20text\n",
        "FIELD FieldData 0\n",
        "FIELD FieldData 1\nnone 1 0 string\n",
        &format!("FIELD FieldData 2\na 1 1 Float\n1\n{information}b 1 1 char\n7\n{information}{information}"),
    ] {
        is_box(field, "a.vtk", vtk().replace("DATASET", &format!("{field}DATASET")));
        is_box(field, "a.vtk", vtk().replace("POINTS", &format!("{field}POINTS")));
        is_box(field, "a.vtk", vtk().replace("POLYGONS", &format!("{field}POLYGONS")));
    }
    let values = "CELL_DATA 12\nSCALARS s float 1\nLOOKUP_TABLE t\n1 2 3\nLOOKUP_TABLE t 2\n0 0 0 1 1 1 1 1\n";
    is_box("values", "a.vtk", vtk() + values);
    is_box("small letters", "a.vtk", vtk().to_lowercase());
    is_box("capitals", "a.vtk", vtk().to_uppercase());
    let offsets: String = (0..=12).map(|n| format!("{} ", 3 * n)).collect();
    let corners: String = TRIANGLES.iter().flatten().map(|corner| format!("{corner} ")).collect();
    let head = vtk();
    let head = head.split("POLYGONS").next().unwrap();
    for kind in ["vtktypeint64", "vtkIdType", "int", "unsigned_char"] {
        // Lists show their version themselves, whatever the first line says.
        let lists = format!("POLYGONS 13 36\nOFFSETS {kind}\n{offsets}\nCONNECTIVITY {kind}\n{corners}\n");
        is_box(kind, "a.vtk", format!("{head}{lists}"));
        is_box(kind, "a.vtk", format!("{head}{information}{}", lists.to_lowercase()));
    }
    let shifted =
        format!("{head}POLYGONS 13 36\nOFFSETS int\n{}CONNECTIVITY int\n{corners}\n", offsets.replacen('0', "1", 1));
    assert!(refusal("a.vtk", shifted).contains("the first offset is 1"));
    let unknown = refusal("a.vtk", vtk().replace("DATASET", "FIELD FieldData 1\na 1 1 colour\n1\nDATASET"));
    assert!(unknown.contains("arrays of `colour` are not read"), "{unknown}");
}

#[test]
fn obj_is_read_with_what_hands_and_old_programs_put_into_it() {
    for (what, text) in [
        ("dollar comments", format!("$ made by hand\n{}$\n", obj())),
        ("dollar comments after faces", obj().replace("f 1 6 5", "f 1 6 5 $ the front")),
        ("comments", obj().replace('\n', " # what\n")),
        ("a comment that ends in a backslash", format!("# from C:\\meshes\\\n{}", obj())),
        ("a path that ends in a backslash", format!("mtllib C:\\meshes\\\n{}", obj())),
        ("continued lines", obj().replace("f 1 6 5", "f 1 \\\n6 \\  \n5")),
        ("continued lines of Windows", obj().replace("v 40 30 20", "v 40\\\n30 20").replace('\n', "\r\n")),
        ("capitals", obj().to_uppercase()),
        ("old faces", obj().replace("f ", "fo ")),
        ("colours", obj().replace(" 20\n", " 20 0.5 0.5 0.5\n")),
        ("references", obj().replace("f 1 6 5", "f 1/1/1 6//2 5/7")),
        ("from the last backwards", obj().replace("f 1 6 5", "f -8 -3 -4")),
        ("a tab and spaces", obj().replace("f 1 6 5", "\t f\t1  6\t5 ")),
        ("texture coordinates that are no numbers", format!("vt 0 -nan(ind)\n{}", obj())),
    ] {
        is_box(what, "a.obj", text);
    }
    // A polygon may end with its first vertex.
    let closed = "v 0 0 0\nv 10 0 0\nv 10 10 0\nv 0 10 0\nf 1 2 3 4 1\nf 1 1 2 2 3 3\nf 1 1 2 2\n";
    let found = read_mm("a.obj", closed).unwrap();
    assert_eq!(found.mesh.triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 2]]);
}

#[test]
fn polygons_are_split_in_their_plane() {
    let area = |text: &str| {
        let found = read_mm("a.obj", text).unwrap();
        let report = report(&found.mesh);
        (report.triangles, (report.area_m2 * 1e8).round() / 1e2, report.counts.contains_key("degenerate"), found.notes)
    };
    let dart = "v 0 0 0\nv 10 4 0\nv 0 8 0\nv 4 4 0\n";
    for (start, is_fan) in
        [("f 1 2 3 4\n", false), ("f 2 3 4 1\n", true), ("f 3 4 1 2\n", false), ("f 4 1 2 3\n", true)]
    {
        let (triangles, mm2, is_degenerate, notes) = area(&format!("{dart}{start}"));
        assert_eq!((triangles, mm2, is_degenerate), (2, 24.0, false), "{start}");
        assert_eq!(notes[0].contains("first vertex"), is_fan, "{start} {notes:?}");
    }
    // Seen from the other side, in another plane, and not quite flat.
    assert_eq!(area(&format!("{dart}f 4 3 2 1\nf 3 2 1 4\n")).1, 48.0);
    assert_eq!(area("v 0 0 0\nv 0 10 4\nv 0 0 8\nv 0 4 4\nf 1 2 3 4\n").1, 24.0);
    assert!((area("v 0 0 0.01\nv 10 4 0\nv 0 8 0.01\nv 4 4 0\nf 1 2 3 4\n").1 - 24.0).abs() < 0.1);
    // Convex polygons are still split into a fan.
    let hexagon: String =
        (0..6).map(|k| f64::from(k).to_radians() * 60.0).map(|a| format!("v {} {} 0\n", a.cos(), a.sin())).collect();
    let found = read_mm("a.obj", format!("{hexagon}f 1 2 3 4 5 6\n")).unwrap();
    assert_eq!(found.mesh.triangles, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]);
    // A vertex in the middle of a side does not result in a triangle without area, whichever corner is first.
    let side = "v 0 0 0\nv 5 0 0\nv 10 0 0\nv 10 10 0\nv 0 10 0\n";
    for start in 0..5 {
        let face: String = (0..5).map(|k| format!(" {}", (start + k) % 5 + 1)).collect();
        let (triangles, mm2, is_degenerate, _) = area(&format!("{side}f{face}\n"));
        assert_eq!((triangles, mm2, is_degenerate), (3, 100.0, false), "{face}");
    }
    // A comb with many teeth.
    let teeth: Vec<[i32; 2]> =
        (0..50).flat_map(|k| [[2 * k, 10], [2 * k + 1, 1]]).chain([[99, 0], [0, 0]]).rev().collect();
    let vertices: String = teeth.iter().map(|[x, y]| format!("v {x} {y} 0\n")).collect();
    let exact: i32 =
        (0..teeth.len()).map(|k| (teeth[k], teeth[(k + 1) % teeth.len()])).map(|([a, b], [c, d])| a * d - b * c).sum();
    let face: String = (1..=teeth.len()).map(|k| format!(" {k}")).collect();
    let (triangles, mm2, _, _) = area(&format!("{vertices}f{face}\n"));
    assert_eq!((triangles, mm2), (teeth.len() - 2, f64::from(exact) / 2.0));
    // A polygon that crosses itself, has no plane or contains NaN is always split in the same way.
    for text in [
        "v 0 0 0\nv 10 10 0\nv 10 0 0\nv 0 10 0\nf 1 2 3 4\n",
        "v 0 0 0\nv 1 0 0\nv 2 0 0\nv 3 0 0\nf 1 2 3 4\n",
        "v 0 0 0\nv 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3 4\n",
        "v 1e300 0 0\nv 0 1e300 0\nv -1e300 0 0\nv 0 -1e300 1e-300\nf 1 2 3 4\n",
    ] {
        let found = read_mm("a.obj", text).unwrap();
        assert_eq!(found.mesh.triangles, [[0, 1, 2], [0, 2, 3]], "{text}");
        assert_eq!(read_mm("a.obj", text).unwrap(), found);
    }
    // Corners keep their texture coordinates.
    let found = read_mm("a.obj", format!("{dart}vt 0 0\nvt 1 0\nvt 2 0\nvt 3 0\nf 1/1 2/2 3/3 4/4\n")).unwrap();
    for (triangle, uv) in found.mesh.triangles.iter().zip(found.mesh.uv.unwrap()) {
        assert_eq!(triangle.map(|vertex| vertex as f32), uv.map(|[u, _]| u));
    }
}

#[test]
fn stl_ends_and_begins_in_more_than_one_way() {
    let text = stl();
    let half = text.match_indices("facet normal").nth(5).unwrap().0;
    for (what, text) in [
        ("end solid", text.replace("endsolid", "end solid")),
        ("all keywords apart", text.replace("end", "end ").replace("END", "End ")),
        ("capitals", text.to_uppercase()),
        ("no name", text.replace(" box", "")),
        ("a long name", text.replace(" box", " a box of 40,5 mm, end solid")),
        ("two solids", format!("{}endsolid box\nsolid vertex\n{}", &text[..half], &text[half..])),
        // The surface is closed, so nothing can be missing.
        ("no end", text.replace("endsolid box\n", "")),
    ] {
        is_box(what, "a.stl", text);
    }
    for (what, text) in [("open", text[..half].to_owned()), ("cut", text[..text.len() - 22].to_owned())] {
        assert!(refusal("a.stl", text).contains("the file ends early: `endsolid` is missing"), "{what}");
    }
    let mut binary = b"solid box".to_vec();
    binary.resize(80, 0);
    binary.extend(12_u32.to_le_bytes());
    let corners: Vec<Vec<f32>> =
        CORNERS.lines().map(|line| line.split(' ').map(|number| number.parse().unwrap()).collect()).collect();
    for triangle in TRIANGLES {
        binary.extend([0; 12]);
        triangle.iter().flat_map(|corner| &corners[*corner]).for_each(|number| binary.extend(number.to_le_bytes()));
        binary.extend([0; 2]);
    }
    is_box("binary", "a.stl", &binary);
    for more in [&b"\0"[..], b"\n", b"facet", &[0; 50], &[b'x'; 200]] {
        is_box("more bytes", "a.stl", [&binary, more].concat());
        let spaces: Vec<u8> =
            binary.iter().enumerate().map(|(n, byte)| if (9..80).contains(&n) { b' ' } else { *byte }).collect();
        is_box("more bytes after a header of spaces", "a.stl", [&spaces, more].concat());
        let lines: Vec<u8> = spaces.iter().enumerate().map(|(n, byte)| if n == 20 { b'\n' } else { *byte }).collect();
        is_box("more bytes after a header of two lines", "a.stl", [&lines, more].concat());
    }
    let cut = refusal("a.stl", &binary[..binary.len() - 10]);
    assert!(cut.contains("the file ends early: a part of 12 triangles is missing"), "{cut}");
}

#[test]
fn gltf_names_what_it_needs() {
    let with = |start: &str| gltf().replacen('{', &format!("{{{start},"), 1);
    for harmless in [
        "KHR_texture_basisu",
        "EXT_texture_webp",
        "EXT_texture_avif",
        "MSFT_texture_dds",
        "KHR_texture_transform",
        "KHR_materials_unlit",
        "KHR_materials_variants",
        "KHR_lights_punctual",
        "KHR_mesh_quantization",
    ] {
        assert_eq!(report_of("a.gltf", with(&format!(r#""extensionsRequired":["{harmless}"]"#))).triangles, 8);
        for needed in ["EXT_meshopt_compression", "KHR_draco_mesh_compression", "EXT_mesh_gpu_instancing", "ACME_mesh"]
        {
            let text = with(&format!(r#""extensionsRequired":["{harmless}","{needed}"]"#));
            let refusal = refusal("a.gltf", text);
            assert!(refusal.contains(&format!("needs {needed}, which is not read")), "{refusal}");
        }
    }
    let both = refusal("a.gltf", with(r#""extensionsRequired":["ACME_a","KHR_texture_basisu","ACME_b"]"#));
    assert!(both.contains("needs ACME_a, ACME_b,"), "{both}");
    // Reported before the missing buffer, which only the extension fills.
    let empty = r#"{"extensionsRequired":["EXT_meshopt_compression"],"buffers":[{"byteLength":100}]}"#;
    assert!(refusal("a.gltf", empty).contains("needs EXT_meshopt_compression"));
    let unsaid = r#"{"buffers":[{"byteLength":9,"extensions":{"EXT_meshopt_compression":{"fallback":true}}}]}"#;
    assert!(refusal("a.gltf", unsaid).contains("buffer 0: needs EXT_meshopt_compression"));
    assert!(refusal("a.gltf", r#"{"buffers":[{"byteLength":9}]}"#).contains("its content is missing"));
    // Compressed, although it does not declare the extension as required.
    let draco = gltf().replacen("\"indices\":1", r#""indices":1,"extensions":{"KHR_draco_mesh_compression":{}}"#, 1);
    assert_eq!(report_of("a.gltf", &draco).triangles, 8);
    let draco = refusal("a.gltf", draco.replacen("{\"bufferView\":0,", "{", 1));
    assert!(draco.contains("needs KHR_draco_mesh_compression"), "{draco}");
    for (version, text) in [
        ("1.0", r#"{"asset":{"version":"1.0"},"accessors":{"a":{}},"scenes":{}}"#),
        ("1.1", r#"{"scenes":{},"meshes":{"a":{"primitives":[]}},"asset":{"version":"1.1"}}"#),
        ("1.0", r#"{"accessors":{},"meshes":{"a":{}}}"#),
        ("1.0", r#"{"asset":{"version":1.0}}"#),
        ("3.0", r#"{"asset":{"version":"3.0"},"meshes":[]}"#),
    ] {
        let refusal = refusal("a.gltf", text);
        assert!(refusal.contains(&format!("glTF {version} is not read: export the file as glTF 2.0")), "{refusal}");
    }
    let mut old = common::glb();
    old[4] = 1;
    assert!(refusal("a.glb", old).contains("glTF 1.0 is not read"));
    assert_eq!(report_of("a.gltf", gltf().replace("\"2.0\"", "\"2.1\"")).triangles, 8);
    assert_eq!(report_of("a.gltf", gltf().replace(r#""asset":{"version":"2.0"},"#, "")).triangles, 8);
}

#[test]
fn elements_given_twice_count_once() {
    let mixed = include_str!("common/mixed.vtk");
    let found = read_mm("a.vtk", mixed).unwrap();
    let note = "Volume elements left out that have the corners of an earlier one: 1.";
    assert!(found.notes.iter().any(|own| own == note), "{:?}", found.notes);
    // Tetrahedra with other vertex indices for the same corners.
    let tetrahedra = "# vtk DataFile Version 3.0\n\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 5 float\n0 0 0 10 0 0 0 10 0 0 0 10 \
                      10 10 10\nCELLS 5 25\n4 0 1 2 3\n4 1 2 3 4\n4 2 1 0 3\n4 4 3 2 1\n4 0 1 2 3\nCELL_TYPES 5\n10 10 10 10 10\n";
    let report = report_of("a.vtk", tetrahedra);
    assert_eq!((report.triangles, report.holes, report.refusal()), (6, 0, None));
    assert!((report.volume_m3.unwrap() - 0.5e-6).abs() < 1e-15, "{report:?}");
    // A hexahedron that is collapsed to a wedge.
    let wedge =
        tetrahedra.split("CELLS").next().unwrap().to_owned() + "CELLS 1 9\n8 0 1 2 2 3 4 4 4\nCELL_TYPES 1\n12\n";
    let report = report_of("a.vtk", wedge);
    assert_eq!((report.holes, report.refusal(), report.counts.get("degenerate")), (0, None, None), "{report:?}");
    // Gmsh writes an element once for each group that contains it.
    let elements: Vec<String> = triangles(|[a, b, c]| format!("1 2 2 2 1 {} {} {}\n", b + 1, c + 1, a + 1))
        .lines()
        .take(4)
        .map(|line| format!("{line}\n"))
        .collect();
    let twice =
        gmsh().replace("$Elements\n12", "$Elements\n16").replace("$EndElements", &(elements.concat() + "$EndElements"));
    let found = read_mm("a.msh", &twice).unwrap();
    assert_eq!(found.mesh.groups.iter().map(|group| group.vertices.len()).collect::<Vec<_>>(), [8, 8]);
    is_box("in two groups", "a.msh", twice);
}

#[test]
fn a_vertex_without_a_triangle_does_not_change_the_size() {
    for stray in ["v 0 0 100000\n", "v -5e7 3 3\n", "v 1e300 0 0\n"] {
        for text in [obj() + stray, stray.to_owned() + &box_obj(2)] {
            let Ok(found) = read_mm("a.obj", &text) else { panic!("{text}") };
            let report = report(&found.mesh);
            assert!(report.extent_m[2] < 0.021 && report.extent_m[0] < 0.041, "{stray}: {:?}", report.extent_m);
            assert!(!report.counts.contains_key("size"), "{stray}: {:?}", report.counts);
            assert_eq!(report.counts.get("unused_vertex"), Some(&1));
        }
    }
    // It does not change the welding tolerance either: nothing is welded here.
    let near = obj() + "v 0 0 20.0005\nv 1e9 0 0\nf 9 5 6\n";
    let found = read_mm("a.obj", near).unwrap().mesh;
    let repaired = palpate_geometry::repair::repair(
        &found,
        &palpate_geometry::repair::Repair { largest: false, manifold: false, ..Default::default() },
    );
    assert!(repaired.told.iter().all(|line| !line.contains("welded")), "{:?}", repaired.told);
}

#[test]
fn holes_are_told_with_their_place_in_the_unit_of_the_file() {
    // Without one triangle of the lid.
    let text = obj().replace("f 5 6 7\n", "");
    let report = report_of("a.obj", &text);
    let [hole] = report.borders[..] else { panic!("{report:?}") };
    assert_eq!((report.holes, hole.edges, hole.name()), (1, 3, "rim"), "{hole:?}");
    assert_eq!(hole.text(mm()), "rim of 3 edges, 120 mm around, at (26.7, 10, 20) mm");
    assert_eq!(
        hole.text("0.0254".parse().unwrap()),
        "rim of 3 edges, 4.72 × 0.0254 m around, at (1.05, 0.394, 0.787) × 0.0254 m"
    );
    // A small hole in the middle of a disc, at the origin except for rounding.
    let ring: String = (0..40)
        .map(|k| (if k % 2 == 0 { 1.0 } else { 30.0 }, f64::from(k / 2) * 18_f64.to_radians()))
        .map(|(radius, angle)| format!("v {} {} 1e-14\n", radius * angle.cos(), radius * angle.sin()))
        .collect();
    let faces: String = (0..20)
        .map(|k| (2 * k + 1, (2 * k + 2) % 40 + 1))
        .map(|(a, b)| format!("f {a} {} {} {b}\n", a + 1, b + 1))
        .collect();
    let report = report_of("a.obj", ring + &faces);
    let texts: Vec<String> = report.borders.iter().map(|border| border.text(mm())).collect();
    assert_eq!(
        texts,
        ["rim of 20 edges, 188 mm around, at (0, 0, 0) mm", "hole of 20 edges, 6.26 mm around, at (0, 0, 0) mm"]
    );
    // Also in findings.
    let turned = report_of("a.obj", obj().replace("f 1 6 5", "f 1 5 6"));
    let texts: Vec<String> = turned.problems.iter().map(|finding| finding.text(mm())).collect();
    assert!(texts[0].starts_with("edge 0-4 at (0, 0, 10) mm: "), "{texts:?}");
    assert!(turned.problems[0].to_string().contains(" at (0, 0, 0.01) m: "));
}
