//! Meshes as users have them: in every format, complete and cut off, valid and invalid. Each is read, repaired as
//! requested, or refused with the element and its position.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod common;

use common::{SampleFile, TRIANGLES, VERTICES, VOLUME_M3, octahedron, samples, sheet, sphere};
use fastrand::Rng;
use glam::DVec3;
use palpate_geometry::decimate::decimate;
use palpate_geometry::delaunay::flip_to_delaunay;
use palpate_geometry::repair::{Repair, Repaired, repair};
use palpate_geometry::write::{Format, write};
use palpate_geometry::{
    Element, MeshError, MeshReport, Problem, ReadLimits, ReadMesh, TriangleMesh, Unit, read, report,
};

fn unit(text: &str) -> Unit {
    text.parse().unwrap()
}

fn read_mm(name: &str, bytes: impl AsRef<[u8]>) -> Result<ReadMesh, MeshError> {
    read(name, bytes.as_ref(), unit("mm"), &|_| None, &ReadLimits::default())
}

/// The names of the problems for which the mesh is refused.
fn refused(report: &MeshReport) -> Vec<&'static str> {
    report.problems.iter().filter(|found| found.problem.is_refused()).map(|found| found.problem.name()).collect()
}

fn mended(mesh: &TriangleMesh) -> Repaired {
    let repaired = repair(mesh, &Repair::default());
    assert_eq!(repaired.vertex_of.len(), mesh.vertices_m.len());
    // A vertex that was not dropped did not move, except within the welding tolerance.
    for (at, new) in mesh.vertices_m.iter().zip(&repaired.vertex_of) {
        let moved = new.map(|new| at.distance(repaired.mesh.vertices_m[new as usize]));
        assert!(moved.is_none_or(|moved| moved <= 1e-5 * at.length()), "{moved:?}");
    }
    repaired
}

/// Positions of the triangles' corners, each triangle beginning at its smallest corner, sorted.
fn shape(mesh: &TriangleMesh) -> Vec<[[i64; 3]; 3]> {
    #[allow(clippy::cast_possible_truncation)]
    let at = |vertex: u32| mesh.vertices_m[vertex as usize].to_array().map(|part| (part * 1e6).round() as i64);
    let mut shape: Vec<_> = mesh.triangles.iter().map(|triangle| triangle.map(at)).collect();
    for triangle in &mut shape {
        let least = (0..3).min_by_key(|corner| triangle[*corner]).unwrap();
        triangle.rotate_left(least);
    }
    shape.sort_unstable();
    shape
}

#[test]
fn every_format_gives_the_same_mesh() {
    for SampleFile { name, bytes, .. } in samples() {
        let found = read_mm(name, &bytes).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(shape(&found.mesh), shape(&octahedron()), "{name}");
        assert_eq!(found.mesh.vertices_m.len(), 6, "{name}");
        let report = report(&found.mesh);
        assert_eq!(refused(&report), [""; 0], "{name}");
        assert_eq!((report.components, report.holes), (1, 0), "{name}");
        assert!((report.volume_m3.unwrap() - VOLUME_M3).abs() < 1e-9, "{name}: {report:?}");
        assert!(report.extent_m.iter().all(|side| (side - 0.2).abs() < 1e-7), "{name}");
        // Except for STL, vertices have the same indices as in the file.
        if !name.ends_with("stl") {
            assert!(
                found
                    .mesh
                    .vertices_m
                    .iter()
                    .zip(VERTICES)
                    .all(|(at, mm)| at.distance(DVec3::from_array(mm) * 1e-3) < 1e-7)
            );
            if !name.contains("volume") {
                assert_eq!(found.mesh.triangles, TRIANGLES, "{name}");
            }
        }
    }
}

#[test]
fn what_was_done_to_a_file_is_told() {
    let notes = |name: &str| {
        let sample = samples().into_iter().find(|sample| sample.name == name).unwrap();
        read_mm(name, sample.bytes).unwrap().notes.join(" ")
    };
    assert!(notes("binary.stl").contains("24 became 6 vertices"), "{}", notes("binary.stl"));
    let volume = notes("two-volume.msh");
    assert!(volume.contains("Volume elements: 8; triangles: 8."), "{volume}");
    assert!(volume.contains("corners of the surface: 6 of 7;"), "{volume}");
    assert!(notes("embedded.gltf").contains("Points and lines left out: 1."));
    let squares = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nf 1 2 3 4\nl 1 2\nf -5 -4 -1\n";
    let found = read_mm("squares.obj", squares).unwrap();
    assert_eq!(found.mesh.triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 4]]);
    assert_eq!(found.notes.len(), 2, "{:?}", found.notes);
    assert!(found.notes[0].contains("from their first vertex: 1."));
    // The content decides, not the extension.
    let other = read_mm("wrong.obj", common::stl_binary()).unwrap();
    assert!(other.notes[0].contains("Stl"), "{:?}", other.notes);
}

#[test]
fn groups_and_texture_coordinates_are_kept() {
    let mesh = read_mm("organ.obj", common::obj()).unwrap().mesh;
    let names: Vec<&str> = mesh.groups.iter().map(|group| group.name.as_str()).collect();
    assert_eq!(names, ["organ", "top", "red skin", "bottom"]);
    assert_eq!(mesh.groups[0].vertices, [0, 1, 2, 3, 4, 5]);
    assert_eq!(mesh.groups[1].vertices, [0, 1, 2, 3, 4]);
    assert_eq!(mesh.uv.unwrap(), [[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]; 8]);
    for name in ["two.msh", "two-binary.msh", "four.msh", "four-binary.msh"] {
        let sample = samples().into_iter().find(|sample| sample.name == name).unwrap();
        let groups = read_mm(name, sample.bytes).unwrap().mesh.groups;
        assert_eq!(groups.len(), 1, "{name}");
        assert_eq!((groups[0].name.as_str(), groups[0].vertices.as_slice()), ("top", &[0, 1, 2, 3, 4][..]), "{name}");
    }
    assert_eq!(read_mm("one.msh", common::gmsh_1()).unwrap().mesh.groups[0].name, "physical 3");
    let groups = read_mm("organ.glb", common::glb()).unwrap().mesh.groups;
    assert_eq!(groups.iter().map(|group| group.name.as_str()).collect::<Vec<_>>(), ["organ", "skin"]);
}

#[test]
fn lengths_are_in_the_unit_that_is_given() {
    for (text, factor) in [("m", 1.0), ("cm", 1e-2), ("mm", 1e-3), ("0.0254", 0.0254)] {
        let found = read("a.obj", common::obj().as_bytes(), unit(text), &|_| None, &ReadLimits::default()).unwrap();
        assert!((found.mesh.vertices_m[0].x - 100.0 * factor).abs() < 1e-12);
    }
    for text in ["", "inch", "0", "-1", "nan", "inf", "1e-400"] {
        let problem = text.parse::<Unit>().unwrap_err();
        assert!(problem.to_string().contains("give m, cm, mm"), "{problem}");
    }
    // A liver of 200 m.
    let large = read("a.obj", common::obj().as_bytes(), Unit::METRE, &|_| None, &ReadLimits::default()).unwrap();
    let report = report(&large.mesh);
    let size = report.problems.iter().find(|found| found.problem.name() == "size").unwrap();
    let says =
        "the longest side is 200 m, organs are 0.005 to 5 m long: check the unit (1000 times smaller: mm instead of m)";
    assert_eq!(size.problem.to_string(), says);
    assert_eq!(refused(&report), [""; 0]);
}

#[test]
fn a_file_that_ends_early_is_refused_with_a_place_or_read_as_far_as_it_goes() {
    for SampleFile { name, bytes, knows_its_end } in samples() {
        for part in 0..100 {
            let end = bytes.len() * part / 100;
            match read_mm(name, &bytes[..end]) {
                Ok(found) => {
                    // Either the cut removed only data that is ignored, or there are no faces yet.
                    let is_whole = shape(&found.mesh) == shape(&octahedron());
                    let may = !knows_its_end || is_whole || found.mesh.triangles.is_empty();
                    assert!(may, "{name} cut at {end}");
                    let _ = report(&found.mesh);
                }
                Err(error) => {
                    assert!(error.to_string().starts_with(name), "{error}");
                    assert!(!error.problem.to_string().is_empty());
                }
            }
        }
    }
}

#[test]
fn what_is_not_finite_or_out_of_range_is_refused_with_its_element() {
    let elements = |name: &str, text: &str| {
        let error = read_mm(name, text).unwrap_err();
        (error.element.clone(), error.problem.name())
    };
    let vertices = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";
    assert_eq!(elements("a.obj", &format!("{vertices}v nan 0 0\nf 1 2 3\n")), (Element::Vertex(3), "not_finite"));
    assert_eq!(elements("a.obj", &format!("{vertices}v 0 1e999 0\nf 1 2 3\n")), (Element::Vertex(3), "not_finite"));
    assert_eq!(elements("a.obj", &format!("{vertices}f 1 2 3\nf 1 2 4\n")), (Element::Line(5), "index_out_of_range"));
    assert_eq!(elements("a.obj", &format!("{vertices}f 1 2 -4\n")), (Element::Line(4), "index_out_of_range"));
    assert_eq!(elements("a.obj", &format!("{vertices}f 0 1 2\n")), (Element::Line(4), "syntax"));
    assert_eq!(elements("a.obj", "v 1 2\n"), (Element::Line(1), "syntax"));
    let ply = common::ply_text().replace("3 0 3 5", "3 0 3 6");
    assert_eq!(elements("a.ply", &ply), (Element::Face(7), "index_out_of_range"));
    let gltf = common::gltf_embedded().replace("\"count\":6", "\"count\":5");
    assert_eq!(elements("a.gltf", &gltf), (Element::Part("mesh", 0), "index_out_of_range"));
    let msh = common::gmsh_1().replace(" 37 ", " 38 ");
    assert_eq!(elements("a.msh", &msh).1, "index_out_of_range");
    let vtk = String::from_utf8(common::vtk(false)).unwrap().replace("3 0 3 5", "3 0 -1 5");
    assert_eq!(elements("a.vtk", &vtk), (Element::Face(7), "index_out_of_range"));
    assert_eq!(elements("a.txt", "hello"), (Element::Whole, "unknown_format"));
    assert_eq!(elements("a.msh", "$MeshFormat\n4.0 0 8\n$EndMeshFormat\n").1, "unsupported");
    let error = read_mm("liver.obj", "v nan 0 0\n").unwrap_err();
    assert_eq!(error.to_string(), "liver.obj: vertex 0: a coordinate is not a finite number");
}

#[test]
fn files_within_a_file_come_from_the_same_folder_only() {
    let (json, buffer) = common::gltf_apart();
    let give = |name: &str| (name == "organ data.bin").then(|| buffer.clone());
    let found = read("a.gltf", json.as_bytes(), unit("mm"), &give, &ReadLimits::default()).unwrap();
    assert_eq!(shape(&found.mesh), shape(&octahedron()));
    assert_eq!(read_mm("a.gltf", &json).unwrap_err().problem.name(), "neighbour_missing");
    for uri in ["../organ.bin", "/etc/passwd", "a\\\\b", "http://a", "..", "%2e%2e%2fa"] {
        let json = json.replace("organ%20data.bin", uri);
        let give = |_: &str| -> Option<Vec<u8>> { panic!("asked for {uri}") };
        let error = read("a.gltf", json.as_bytes(), unit("mm"), &give, &ReadLimits::default()).unwrap_err();
        assert_eq!(error.problem.name(), "neighbour_missing", "{uri}");
    }
}

#[test]
fn limits_hold_however_much_a_file_claims() {
    let small = ReadLimits { bytes: 1 << 16, vertices: 5, triangles: 7 };
    for SampleFile { name, bytes, .. } in samples() {
        let error = read(name, &bytes, unit("mm"), &|_| None, &small).unwrap_err();
        assert_eq!(error.problem.name(), "too_large", "{error}");
        let few = ReadLimits { vertices: 7, ..small };
        let error = read(name, &bytes, unit("mm"), &|_| None, &few).unwrap_err();
        assert_eq!(error.problem.name(), "too_large", "{error}");
        let short = ReadLimits { bytes: bytes.len() - 1, ..ReadLimits::default() };
        assert_eq!(read(name, &bytes, unit("mm"), &|_| None, &short).unwrap_err().problem.name(), "too_large");
    }
    // Counts without the data.
    let mut stl = vec![0; 80];
    stl.extend(u32::MAX.to_le_bytes());
    stl.extend([0; 60]);
    assert_eq!(read_mm("a.stl", &stl).unwrap_err().problem.name(), "truncated");
    let many = "99999999999999999";
    for (name, text) in [
        ("a.ply", common::ply_text().replace("vertex 6", &format!("vertex {many}"))),
        ("a.ply", "ply\nformat ascii 1.0\nelement nothing 99999999999\nelement vertex 1\nend_header\n".to_owned()),
        ("a.msh", common::gmsh_1().replacen("6\n", &format!("{many}\n"), 1)),
        ("a.vtk", String::from_utf8(common::vtk(false)).unwrap().replace("POINTS 6", &format!("POINTS {many}"))),
        ("a.gltf", common::gltf_embedded().replace("\"count\":24", &format!("\"count\":{many}"))),
    ] {
        match read_mm(name, &text) {
            Ok(found) => assert!(found.mesh.vertices_m.is_empty(), "{name}"),
            Err(error) => assert!(["truncated", "too_large"].contains(&error.problem.name()), "{error}"),
        }
    }
    // Nested more deeply than any stack allows.
    let deep = "[".repeat(1 << 20);
    assert!(read_mm("a.gltf", format!("{{\"nodes\":{deep}")).is_err());
    let deep = "<a>".repeat(1 << 20);
    assert!(read_mm("a.vtp", format!("<VTKFile type=\"PolyData\">{deep}")).is_err());
    // A small text that needs much work: many nodes that share many primitives.
    let primitives = [r#"{"attributes":{"POSITION":0}}"#; 2000].join(",");
    let nodes = [r#"{"mesh":0}"#; 2000].join(",");
    let many = format!(
        r#"{{"nodes":[{nodes}],"meshes":[{{"primitives":[{primitives}]}}],
        "accessors":[{{"componentType":5126,"count":0,"type":"VEC3"}}]}}"#
    );
    assert_eq!(read_mm("a.gltf", many).unwrap_err().problem.name(), "too_large");
    // An entity with many physical tags and many elements.
    let tags = "3 ".repeat(100_000);
    let elements = "2 1 15 1 1 1\n".repeat(20_000);
    let many = format!(
        "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Entities\n1 0 0 0\n1 0 0 0 100000 {tags}\n$EndEntities\n\
         $Nodes\n1 1 1 1\n0 1 0 1\n1\n0 0 0\n$EndNodes\n$Elements\n20000 20000 1 1\n{}$EndElements\n",
        elements.replace("2 1 15", "0 1 15")
    );
    let found = read_mm("a.msh", many).unwrap();
    assert_eq!((found.mesh.groups.len(), found.mesh.groups[0].vertices.len()), (1, 1));
    // A node that contains itself.
    let circle = r#"{"scenes":[{"nodes":[0]}],"nodes":[{"children":[0]}]}"#;
    assert_eq!(read_mm("a.gltf", circle).unwrap_err().element, Element::Part("node", 0));
}

#[test]
fn what_unpacks_to_more_than_the_limit_is_refused() {
    let block = miniz_oxide::deflate::compress_to_vec_zlib(&vec![0; 8 << 20], 9);
    let word = |number: usize| u32::try_from(number).unwrap().to_le_bytes();
    let mut data = [1, 8 << 20, 0, block.len()].map(word).concat();
    data.extend(&block);
    let mut file = b"<VTKFile type=\"PolyData\" compressor=\"vtkZLibDataCompressor\"><Piece><Points>\
        <DataArray type=\"Float64\" format=\"appended\" offset=\"0\"/></Points></Piece>\
        <AppendedData encoding=\"raw\">_"
        .to_vec();
    file.extend(data);
    let limits = ReadLimits { bytes: 1 << 20, ..ReadLimits::default() };
    let error = read("bomb.vtp", &file, unit("mm"), &|_| None, &limits).unwrap_err();
    assert_eq!(error.problem.name(), "too_large", "{error}");
}

#[test]
fn without_triangles_or_area_there_is_nothing_to_touch() {
    let points = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n";
    let none = report(&read_mm("a.obj", points).unwrap().mesh);
    assert_eq!(refused(&none), ["only_degenerate"]);
    let lines = report(&read_mm("a.obj", format!("{points}v 2 0 0\nf 1 2 5\nf 1 1 2\n")).unwrap().mesh);
    assert_eq!(refused(&lines), ["only_degenerate"]);
    assert_eq!(lines.counts["degenerate"], 2);
    let few = report(&read_mm("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap().mesh);
    assert_eq!(refused(&few), ["too_few_vertices"]);
    assert_eq!(refused(&report(&TriangleMesh::default())), ["too_few_vertices", "only_degenerate"]);
}

#[test]
fn meshes_made_elsewhere_are_checked_as_well() {
    let mut mesh = octahedron();
    mesh.triangles.push([0, 1, 6]);
    mesh.vertices_m[2].y = f64::NAN;
    let found = report(&mesh);
    assert_eq!(refused(&found), ["not_finite", "index_out_of_range"]);
    assert_eq!(found.problems[1].element, Element::Triangle(8));
    let repaired = repair(&mesh, &Repair::default());
    assert_eq!(repaired.mesh.vertices_m.len(), 5);
    assert!(repaired.told[0].ends_with("not finite: 5."), "{:?}", repaired.told);
    assert_eq!(repaired.vertex_of[2], None);
}

#[test]
fn holes_are_counted_and_small_ones_filled() {
    let mut mesh = sphere(3);
    // A missing triangle, and a missing fan around another vertex.
    mesh.triangles.remove(100);
    mesh.triangles.retain(|triangle| !triangle.contains(&40));
    let found = report(&mesh);
    assert_eq!((found.holes, found.volume_m3, found.counts["unused_vertex"]), (2, None, 1));
    assert_eq!(refused(&found), [""; 0]);
    let repaired = mended(&mesh);
    let after = report(&repaired.mesh);
    assert_eq!((after.holes, after.problems.len()), (0, 0), "{after:?}");
    assert!((after.volume_m3.unwrap() / report(&sphere(3)).volume_m3.unwrap() - 1.0).abs() < 0.01);
    assert!(repaired.told.iter().any(|line| line == "Holes filled: 2."), "{:?}", repaired.told);
    // Also in a coarse mesh.
    let mut coarse = octahedron();
    coarse.triangles.remove(3);
    assert_eq!(shape(&mended(&coarse).mesh), shape(&octahedron()));
    // The boundary of a sheet is not a hole to fill.
    let flat = sheet(4, || 0.0);
    let repaired = mended(&flat);
    assert_eq!((repaired.mesh, report(&flat).holes), (flat, 1));
}

#[test]
fn flipped_triangles_are_turned() {
    let mut mesh = sphere(2);
    for triangle in [3, 17, 40] {
        mesh.triangles[triangle].swap(0, 1);
    }
    let found = report(&mesh);
    assert_eq!((refused(&found).len(), found.counts["orientation"]), (9, 9));
    assert!(matches!(found.problems[0].element, Element::Edge(_)) && found.problems[0].place_m.is_some());
    assert_eq!(shape(&mended(&mesh).mesh), shape(&sphere(2)));
    // All triangles.
    mesh = sphere(2);
    mesh.triangles.iter_mut().for_each(|triangle| triangle.swap(1, 2));
    let found = report(&mesh);
    assert_eq!((found.problems[0].problem.name(), refused(&found).len()), ("faces_inward", 0));
    assert_eq!(shape(&mended(&mesh).mesh), shape(&sphere(2)));
}

#[test]
fn a_surface_with_one_side_stays_refused() {
    let mut mesh = TriangleMesh::default();
    for step in 0..20_u32 {
        let (turn, twist) = (f64::from(step) * 0.314_159_265_358_979_3, f64::from(step) * 0.157_079_632_679_489_65);
        let (across, up) = (0.02 * libm::cos(twist), 0.02 * libm::sin(twist));
        for side in [-1.0, 1.0] {
            let radius = 0.1 + side * across;
            mesh.vertices_m.push(DVec3::new(radius * libm::cos(turn), radius * libm::sin(turn), side * up));
        }
        let (a, b) = (2 * step, 2 * step + 1);
        let (c, d) = if step < 19 { (a + 2, b + 2) } else { (1, 0) };
        mesh.triangles.extend([[a, c, b], [b, c, d]]);
    }
    let repaired = repair(&mesh, &Repair { hole_edges: 0, ..Repair::default() });
    assert!(repaired.told.iter().any(|line| line.contains("Möbius")), "{:?}", repaired.told);
    assert!(refused(&report(&repaired.mesh)).contains(&"orientation"));
}

#[test]
fn duplicates_are_found_and_dropped() {
    let mut mesh = sphere(2);
    mesh.triangles.push(mesh.triangles[5]);
    let [a, b, c] = mesh.triangles[9];
    mesh.triangles.push([b, a, c]);
    let found = report(&mesh);
    assert_eq!(found.counts["duplicate_triangle"], 2);
    assert!(refused(&found).contains(&"non_manifold_edge"));
    let repaired = mended(&mesh);
    assert_eq!(shape(&repaired.mesh), shape(&sphere(2)));
    assert_eq!(repaired.told, ["Triangles dropped that have the vertices of an earlier one: 2."]);
    // Each triangle with separate vertices, one of them slightly displaced.
    let whole = sphere(2);
    let mut soup = TriangleMesh::default();
    for triangle in &whole.triangles {
        let first = u32::try_from(soup.vertices_m.len()).unwrap();
        soup.vertices_m.extend(triangle.map(|vertex| whole.vertices_m[vertex as usize]));
        soup.triangles.push([first, first + 1, first + 2]);
    }
    soup.vertices_m[7].x += 1e-8;
    let found = report(&soup);
    assert_eq!(found.components, 128);
    assert_eq!(found.counts["duplicate_vertex"], 3 * 128 - 66 - 1);
    let repaired = mended(&soup);
    assert_eq!((repaired.mesh.vertices_m.len(), report(&repaired.mesh).problems.len()), (66, 0));
}

#[test]
fn surfaces_that_share_an_edge_or_a_vertex_are_refused_with_the_place() {
    // A fin on an edge of the octahedron, and a pyramid that touches its top.
    let mut mesh = octahedron();
    mesh.vertices_m
        .extend([[0.2, 0.2, 0.0], [0.05, 0.0, 0.2], [-0.05, 0.05, 0.2], [-0.05, -0.05, 0.2]].map(DVec3::from_array));
    mesh.triangles.push([0, 2, 6]);
    mesh.triangles.extend([[4, 8, 7], [4, 9, 8], [4, 7, 9], [7, 8, 9]]);
    let found = report(&mesh);
    assert_eq!(refused(&found), ["non_manifold_edge", "non_manifold_vertex"]);
    assert_eq!(found.problems[0].element, Element::Edge([0, 2]));
    assert_eq!(found.problems[0].place_m, Some([0.05, 0.05, 0.0]));
    assert_eq!((&found.problems[1].element, found.problems[1].place_m), (&Element::Vertex(4), Some([0.0, 0.0, 0.1])));
    let repaired = mended(&mesh);
    assert_eq!(shape(&repaired.mesh), shape(&octahedron()), "{:?}", repaired.told);
}

#[test]
fn slivers_and_sizes_are_warned_of() {
    let mut mesh = sphere(1);
    mesh.vertices_m[6] = mesh.vertices_m[0] + (mesh.vertices_m[6] - mesh.vertices_m[0]) * 1e-4;
    let found = report(&mesh);
    assert_eq!(refused(&found), [""; 0]);
    assert!(found.counts.contains_key("edge_spread") && found.counts.contains_key("area_spread"), "{:?}", found.counts);
    for (factor, is_doubted) in [(1e-9, true), (1e-2, true), (0.1, false), (1.0, false), (20.0, false), (1e6, true)] {
        let mut mesh = sphere(2);
        mesh.vertices_m.iter_mut().for_each(|at| *at *= factor);
        let found = report(&mesh);
        assert_eq!(found.counts.contains_key("size"), is_doubted, "{factor}");
        assert_eq!(refused(&found), [""; 0], "{factor}");
        let volume = report(&sphere(2)).volume_m3.unwrap() * factor * factor * factor;
        assert!((found.volume_m3.unwrap() / volume - 1.0).abs() < 1e-9, "{factor}");
        assert_eq!(mended(&mesh).mesh, mesh, "{factor}");
    }
}

#[test]
fn triangles_in_a_line_are_flipped_away() {
    // The middle of an edge of the octahedron is a vertex, but only of a triangle without area beside the edge.
    let mut mesh = octahedron();
    mesh.vertices_m.push((mesh.vertices_m[0] + mesh.vertices_m[2]) / 2.0);
    mesh.triangles.retain(|triangle| *triangle != [0, 2, 4]);
    mesh.triangles.extend([[0, 6, 4], [6, 2, 4], [0, 2, 6]]);
    assert_eq!(report(&mesh).counts["degenerate"], 1);
    let after = report(&mended(&mesh).mesh);
    assert_eq!((after.problems.len(), after.triangles, after.holes), (0, 10, 0), "{after:?}");
}

#[test]
fn surfaces_that_cut_each_other_are_warned_of() {
    let mut mesh = sphere(2);
    let other = sphere(2);
    let first = u32::try_from(mesh.vertices_m.len()).unwrap();
    mesh.vertices_m.extend(other.vertices_m.iter().map(|at| *at * 0.9 + DVec3::new(0.1, 0.01, 0.02)));
    mesh.triangles.extend(other.triangles.iter().map(|triangle| triangle.map(|vertex| vertex + first)));
    let found = report(&mesh);
    assert_eq!((found.components, found.counts["components"]), (2, 1));
    assert!(found.counts["self_intersection"] > 5, "{:?}", found.counts);
    let cut = found.problems.iter().find(|found| found.problem.name() == "self_intersection").unwrap();
    let Problem::SelfIntersection { by } = cut.problem else { panic!() };
    assert!(by >= 128 && cut.place_m.is_some());
    assert_eq!(shape(&mended(&mesh).mesh), shape(&sphere(2)));
    assert!(!report(&sphere(3)).counts.contains_key("self_intersection"));
}

#[test]
fn what_is_written_reads_the_same() {
    let mut mesh = read_mm("organ.obj", common::obj()).unwrap().mesh;
    mesh.vertices_m.iter_mut().for_each(|at| *at *= 1.0 / 3.0);
    for (name, format) in [("a.obj", Format::Obj), ("a.stl", Format::Stl), ("a.ply", Format::Ply)] {
        assert_eq!(Format::of(name), Ok(format));
        let again = read(name, &write(&mesh, format), Unit::METRE, &|_| None, &ReadLimits::default()).unwrap().mesh;
        assert_eq!(shape(&again), shape(&mesh), "{name}");
        if format != Format::Stl {
            assert_eq!((&again.vertices_m, &again.uv), (&mesh.vertices_m, &mesh.uv), "{name}");
        }
        if format == Format::Obj {
            let names = |mesh: &TriangleMesh| {
                let of = |group: &palpate_geometry::Group| (group.name.replace(' ', "_"), group.vertices.clone());
                let mut groups: Vec<_> = mesh.groups.iter().map(of).collect();
                groups.sort();
                groups
            };
            assert_eq!(names(&again), names(&mesh));
        }
    }
    assert!(Format::of("a.vtk").is_err());
}

#[test]
fn decimation_keeps_the_surface() {
    let mesh = sphere(5);
    let before = report(&mesh);
    for vertices in [2000, 500, 100] {
        let coarse = decimate(&mesh, vertices);
        assert_eq!(coarse, decimate(&mesh, vertices));
        let after = report(&coarse.mesh);
        assert_eq!((after.vertices, after.holes, refused(&after).len()), (vertices, 0, 0));
        let volume = after.volume_m3.unwrap() / before.volume_m3.unwrap();
        assert!((volume - 1.0).abs() < 8.0 / vertices as f64, "{vertices}: {volume}");
        assert!(after.edge_m.ratio().unwrap() < 5.0, "{:?}", after.edge_m);
        assert!(after.valence.largest <= 12.0, "{:?}", after.valence);
        for (at, place) in mesh.vertices_m.iter().zip(&coarse.places) {
            let corners =
                coarse.mesh.triangles[place.triangle as usize].map(|vertex| coarse.mesh.vertices_m[vertex as usize]);
            let found: DVec3 = corners.iter().zip(place.barycentric).map(|(corner, weight)| *corner * weight).sum();
            assert!(found.distance(*at) < 0.6 / vertices as f64, "{vertices}: {}", found.distance(*at));
        }
    }
}

#[test]
fn decimation_keeps_borders_and_groups() {
    let mut mesh = sheet(40, || 0.0);
    let left = (0..41).map(|row| 41 * row).collect();
    mesh.groups.push(palpate_geometry::Group { name: "left".into(), vertices: left });
    let coarse = decimate(&mesh, 200).mesh;
    let after = report(&coarse);
    assert_eq!((after.vertices, after.holes, refused(&after).len()), (200, 1, 0));
    assert!((after.area_m2 - 0.01).abs() < 1e-9, "{}", after.area_m2);
    assert!(coarse.groups[0].vertices.iter().any(|vertex| coarse.vertices_m[*vertex as usize].x.abs() < 1e-12));
    // Removes only as many triangles as possible without folding.
    assert!(report(&decimate(&octahedron(), 1).mesh).volume_m3.unwrap() > 0.0);
}

#[test]
fn flips_end_where_all_edges_are_delaunay() {
    let mut random = Rng::with_seed(3);
    let mut mesh = sheet(20, || 0.6 * random.f64() - 0.3);
    let before = report(&mesh);
    let flips = flip_to_delaunay(&mut mesh);
    let after = report(&mesh);
    assert!(flips > 50, "{flips}");
    assert_eq!((after.vertices, after.triangles, refused(&after).len()), (before.vertices, before.triangles, 0));
    assert!((after.area_m2 - before.area_m2).abs() < 1e-12);
    assert_eq!(flip_to_delaunay(&mut mesh), 0);
    // Closed meshes stay closed.
    let mut round = sphere(3);
    let volume = report(&round).volume_m3.unwrap();
    flip_to_delaunay(&mut round);
    assert!((report(&round).volume_m3.unwrap() / volume - 1.0).abs() < 0.02);
}

#[test]
fn a_report_as_json_has_what_programs_look_for() {
    let mut mesh = octahedron();
    mesh.triangles[3].swap(0, 1);
    let json = serde_json::to_value(report(&mesh)).unwrap();
    for key in ["vertices", "triangles", "components", "holes", "volume_m3", "area_m2", "extent_m", "problems"] {
        assert!(json.get(key).is_some(), "{key}");
    }
    assert!(json["volume_m3"].is_null());
    let problem = &json["problems"][0];
    assert_eq!((problem["what"].as_str(), problem["refused"].as_bool()), (Some("orientation"), Some(true)));
    assert_eq!(problem["element"], "edge 0-3");
    assert_eq!(problem["place_m"].as_array().unwrap().len(), 3);
}
