//! `palpate mesh`: its report on a mesh file, its repairs, its output, and its exit status.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods, missing_docs)]

use std::path::Path;
use std::process::Command;

use serde_json::Value;

/// An octahedron, mm.
const OCTAHEDRON: &str = "v 50 0 0\nv -50 0 0\nv 0 50 0\nv 0 -50 0\nv 0 0 50\nv 0 0 -50\n\
    f 1 3 5\nf 3 2 5\nf 2 4 5\nf 4 1 5\nf 3 1 6\nf 2 3 6\nf 4 2 6\nf 1 4 6\n";

/// Exit status, standard output and standard error.
fn palpate(folder: &Path, arguments: &[&str]) -> (i32, String, String) {
    let program = env!("CARGO_BIN_EXE_palpate");
    let output = Command::new(program).arg("mesh").args(arguments).current_dir(folder).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
}

#[test]
fn a_sound_mesh_is_reported() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("organ.obj"), OCTAHEDRON).unwrap();
    let (status, table, told) = palpate(folder.path(), &["organ.obj", "--unit", "mm"]);
    assert_eq!((status, told.as_str()), (0, ""));
    for row in ["vertices        6", "holes           0", "100.00 × 100.00 × 100.00 mm", "166.667 ml"] {
        assert!(table.contains(row), "{row} is not in\n{table}");
    }
    let (status, json, _) = palpate(folder.path(), &["organ.obj", "--unit", "mm", "--json"]);
    let json: Value = serde_json::from_str(&json).unwrap();
    assert_eq!((status, json["vertices"].as_u64(), json["triangles"].as_u64()), (0, Some(6), Some(8)));
    assert_eq!((json["components"].as_u64(), json["holes"].as_u64()), (Some(1), Some(0)));
    assert!((json["volume_m3"].as_f64().unwrap() - 0.05_f64.powi(3) * 4.0 / 3.0).abs() < 1e-12);
    assert_eq!((json["extent_m"][0].as_f64(), json["problems"].as_array().map(Vec::len)), (Some(0.1), Some(0)));
}

#[test]
fn groups_are_listed_with_their_vertices() {
    let folder = tempfile::tempdir().unwrap();
    let text = OCTAHEDRON.replace("f 1 3 5", "g top\nf 1 3 5").replace("f 3 1 6", "g bottom\nf 3 1 6");
    std::fs::write(folder.path().join("organ.obj"), text).unwrap();
    let (status, table, told) = palpate(folder.path(), &["organ.obj", "--unit", "mm"]);
    assert_eq!((status, told.as_str()), (0, ""));
    for row in ["groups          ", "top: 5 vertices\n", "bottom: 5 vertices\n"] {
        assert!(table.contains(row), "{row} is not in\n{table}");
    }
    let (_, json, _) = palpate(folder.path(), &["organ.obj", "--unit", "mm", "--json"]);
    let groups = &serde_json::from_str::<Value>(&json).unwrap()["groups"];
    assert!(groups.as_array().unwrap().contains(&serde_json::json!({ "name": "top", "vertices": 5 })), "{groups}");
    let many: String = (0..30).map(|group| format!("g part{group}\nf 1 3 5\n")).collect();
    std::fs::write(folder.path().join("many.obj"), OCTAHEDRON.replace("f 1 3 5\n", &many)).unwrap();
    let (_, table, told) = palpate(folder.path(), &["many.obj", "--unit", "mm", "--repair"]);
    assert!(table.contains("and 10 more; --json lists all"), "{table}{told}");
}

#[test]
fn what_is_refused_says_element_place_and_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |text: &str, arguments: &[&str], says: &[&str]| {
        std::fs::write(folder.path().join("organ.obj"), text).unwrap();
        let (status, output, told) = palpate(folder.path(), arguments);
        assert_eq!(status, 2, "{told}");
        says.iter().for_each(|says| assert!(told.contains(says), "`{says}` is not in {told}"));
        output
    };
    refused(OCTAHEDRON, &["organ.obj"], &["no unit", "--unit mm"]);
    refused(OCTAHEDRON, &["organ.obj", "--unit", "inch"], &["`inch` is not a unit", "0.0254"]);
    refused(OCTAHEDRON, &["other.obj", "--unit", "mm"], &["other.obj: can't be opened"]);
    refused(OCTAHEDRON, &["organ.obj", "--unit", "mm", "--output", "a.vtk"], &["--output", ".ply"]);
    refused("v 1 2\n", &["organ.obj", "--unit", "mm"], &["organ.obj: line 1:", "v x y z"]);
    let fin = format!("{OCTAHEDRON}v 70 70 0\nf 1 3 7\n");
    let fin = refused(&fin, &["organ.obj", "--unit", "mm", "--json"], &["edge ", "--repair"]);
    let problems: Value = serde_json::from_str::<Value>(&fin).unwrap()["problems"].take();
    assert_eq!(problems[0]["what"], "non_manifold_edge");
    assert_eq!((problems[0]["element"].as_str(), problems[0]["place_m"][2].as_f64()), (Some("edge 0-2"), Some(0.0)));
    let broken = refused("v nan 0 0\n", &["organ.obj", "--unit", "mm", "--json"], &["vertex 0"]);
    let problems: Value = serde_json::from_str::<Value>(&broken).unwrap()["problems"].take();
    assert_eq!((&problems[0]["what"], &problems[0]["element"]), (&"not_finite".into(), &"vertex 0".into()));
}

#[test]
fn what_every_scene_does_with_a_mesh_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let told = |text: &str| {
        std::fs::write(folder.path().join("organ.obj"), text).unwrap();
        let (status, table, told) = palpate(folder.path(), &["organ.obj", "--unit", "mm"]);
        assert_eq!((status, told.as_str()), (0, ""), "{table}");
        assert!(table.contains("166.667 ml") && table.contains("vertices        6"), "{table}");
        table
    };
    // One triangle turned, all of them, and each with corners of its own.
    assert!(told(&OCTAHEDRON.replace("f 3 1 6", "f 1 3 6")).contains("that the others face: 1."));
    let faces = || OCTAHEDRON.lines().filter(|line| line.starts_with('f'));
    let corners: Vec<Vec<usize>> =
        faces().map(|line| line.split(' ').skip(1).map(|corner| corner.parse().unwrap()).collect()).collect();
    let vertices: String =
        OCTAHEDRON.lines().filter(|line| line.starts_with('v')).map(|line| format!("{line}\n")).collect();
    let inward: String = corners.iter().map(|of| format!("f {} {} {}\n", of[1], of[0], of[2])).collect();
    assert!(told(&format!("{vertices}{inward}")).contains("Closed surfaces turned outward: 1"));
    let lines: Vec<&str> = vertices.lines().collect();
    let mut soup: String = corners.iter().flatten().map(|corner| format!("{}\n", lines[corner - 1])).collect();
    soup.extend((0..8).map(|n| format!("f {} {} {}\n", 3 * n + 1, 3 * n + 2, 3 * n + 3)));
    assert!(told(&soup).contains("24 became 6."));
}

#[test]
fn repair_that_is_not_what_was_asked_for_ends_with_1() {
    let folder = tempfile::tempdir().unwrap();
    let ends = |text: &str, arguments: &[&str]| {
        std::fs::write(folder.path().join("organ.obj"), text).unwrap();
        let arguments = [&["organ.obj", "--unit", "mm", "--json"], arguments].concat();
        let (status, json, told) = palpate(folder.path(), &arguments);
        (status, serde_json::from_str::<Value>(&json).unwrap(), told)
    };
    // Another octahedron behind it, of other radius and place, mm.
    let other = |radius: i32, x: i32| {
        let vertices = OCTAHEDRON.lines().filter_map(|line| line.strip_prefix("v ")).map(|line| {
            let at: Vec<i32> = line.split(' ').map(|part| part.parse::<i32>().unwrap() * radius / 50).collect();
            format!("v {} {} {}\n", at[0] + x, at[1], at[2])
        });
        let faces = OCTAHEDRON.lines().filter_map(|line| line.strip_prefix("f ")).map(|line| {
            let of: Vec<i32> = line.split(' ').map(|part| part.parse::<i32>().unwrap() + 6).collect();
            format!("f {} {} {}\n", of[0], of[1], of[2])
        });
        format!("{OCTAHEDRON}{}{}", vertices.collect::<String>(), faces.collect::<String>())
    };
    // A hollow organ keeps its inner wall.
    let (status, json, told) = ends(&other(20, 0), &["--repair"]);
    assert_eq!(status, 0, "{told}");
    let hollow = 4.0 / 3.0 * (0.05_f64.powi(3) - 0.02_f64.powi(3));
    for volume in [&json["volume_m3"], &json["before"]["volume_m3"]] {
        assert!((volume.as_f64().unwrap() / hollow - 1.0).abs() < 1e-9, "{json}");
    }
    // Another organ beside it is dropped, and the report says so.
    let (status, json, told) = ends(&other(20, 100), &["--repair"]);
    assert_eq!((status, json["components"].as_u64()), (1, Some(1)), "{told}");
    assert!(
        told.contains("not as asked for") && json["faults"][0].as_str().unwrap().contains("% of the area"),
        "{told}"
    );
    // Each of two surfaces has 4 vertices at least.
    let (status, json, told) = ends(&other(20, 100), &["--vertices", "5"]);
    assert_eq!(status, 1, "{told}");
    assert!(json["before"]["area_m2"].as_f64().unwrap() > 0.0 && told.contains("more than 5"), "{told}");
}

#[test]
fn a_mesh_is_mended_made_coarser_and_written() {
    let folder = tempfile::tempdir().unwrap();
    // One triangle turned, another one twice, and a vertex that none has.
    let text = OCTAHEDRON.replace("f 3 1 6", "f 1 3 6") + "f 1 4 6\nv 1 1 1\n";
    std::fs::write(folder.path().join("organ.obj"), text).unwrap();
    let (status, table, _) = palpate(folder.path(), &["organ.obj", "--unit", "mm", "--repair", "-o", "organ.stl"]);
    assert_eq!(status, 0, "{table}");
    for line in ["Triangles turned to the side that the others face: 1.", "an earlier one: 1.", "no triangle has: 1."] {
        assert!(table.contains(line), "{line} is not in\n{table}");
    }
    let (status, json, _) = palpate(folder.path(), &["organ.stl", "--unit", "m", "--vertices", "5", "--json"]);
    let json: Value = serde_json::from_str(&json).unwrap();
    assert_eq!((status, json["holes"].as_u64()), (0, Some(0)), "{json}");
    assert!(json["notes"][0].as_str().unwrap().contains("welded"));
    assert!(json["done"][0].as_str().unwrap().starts_with("Vertices decimated: 6 to"));
}

#[test]
fn holes_and_what_is_wrong_are_told_with_their_place_in_the_unit_of_the_file() {
    let folder = tempfile::tempdir().unwrap();
    let open = OCTAHEDRON.replace("f 1 3 5\n", "");
    std::fs::write(folder.path().join("organ.obj"), &open).unwrap();
    let (status, table, _) = palpate(folder.path(), &["organ.obj", "--unit", "mm"]);
    assert_eq!(status, 0, "{table}");
    for row in ["holes           1", "                rim of 3 edges, 212 mm around, at (16.7, 16.7, 16.7) mm"] {
        assert!(table.contains(row), "{row} is not in\n{table}");
    }
    let (_, json, _) = palpate(folder.path(), &["organ.obj", "--unit", "mm", "--json"]);
    let border = serde_json::from_str::<Value>(&json).unwrap()["borders"][0].take();
    assert_eq!((border["edges"].as_u64(), border["is_rim"].as_bool()), (Some(3), Some(true)), "{border}");
    // A place that is 0 but for rounding, and a stray vertex that does not count. An edge of three triangles is
    // refused.
    let fin = OCTAHEDRON.replace("v 0 50 0", "v 0 50 1e-14") + "v 0 0 1e5\nv 10 10 0\nf 1 3 8\n";
    std::fs::write(folder.path().join("organ.obj"), fin).unwrap();
    let (status, table, told) = palpate(folder.path(), &["organ.obj", "--unit", "mm"]);
    assert_eq!(status, 2, "{told}");
    assert!(told.contains("edge 0-2 at (25, 25, 0) mm: "), "{told}");
    assert!(
        table.contains("100.00 × 100.00 × 100.00 mm") && table.contains("because no triangle has them: 1."),
        "{table}"
    );
}
