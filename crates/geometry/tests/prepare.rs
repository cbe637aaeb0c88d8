//! Whatever the vertex indices and orientations in a file are, the same shape results in the same tissue, and repair
//! does not remove parts of it.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::cast_possible_truncation)]

mod common;

use std::collections::BTreeMap;

use common::{octahedron, sheet, sphere};
use fastrand::Rng;
use glam::DVec3;
use palpate_geometry::organ::{Organ, generate};
use palpate_geometry::repair::{Repair, Repaired, SurfaceMeasure, repair};
use palpate_geometry::{Group, MeshReport, Prepared, ReadLimits, TriangleMesh, Unit, prepare, read, report};

/// Gives each corner of each triangle a separate vertex.
fn soup(mesh: &TriangleMesh) -> TriangleMesh {
    TriangleMesh {
        vertices_m: mesh.triangles.iter().flatten().map(|vertex| mesh.vertices_m[*vertex as usize]).collect(),
        triangles: (0..mesh.triangles.len() as u32).map(|n| [3 * n, 3 * n + 1, 3 * n + 2]).collect(),
        ..TriangleMesh::default()
    }
}

/// Reverses the triangles for which `is_turned` is true.
fn turned(mesh: &TriangleMesh, mut is_turned: impl FnMut(usize) -> bool) -> TriangleMesh {
    let mut mesh = mesh.clone();
    mesh.triangles.iter_mut().enumerate().filter(|(n, _)| is_turned(*n)).for_each(|(_, of)| of.swap(0, 1));
    mesh
}

fn moved(mesh: &TriangleMesh, scale: f64, by: DVec3) -> TriangleMesh {
    let mut mesh = mesh.clone();
    mesh.vertices_m.iter_mut().for_each(|at| *at = *at * scale + by);
    mesh
}

fn both(one: &TriangleMesh, other: &TriangleMesh) -> TriangleMesh {
    let mut mesh = one.clone();
    let first = mesh.vertices_m.len() as u32;
    mesh.vertices_m.extend(&other.vertices_m);
    mesh.triangles.extend(other.triangles.iter().map(|triangle| triangle.map(|vertex| vertex + first)));
    mesh
}

/// Boxes with sides of 1 cm, each with separate triangles but shared vertices.
fn boxes(cells: &[[i32; 3]]) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    let mut known = BTreeMap::new();
    for cell in cells {
        for (axis, side) in (0..3).flat_map(|axis| [(axis, 0), (axis, 1)]) {
            let mut corner = |u: i32, v: i32| {
                let mut at = *cell;
                at[axis] += side;
                at[(axis + 1) % 3] += u;
                at[(axis + 2) % 3] += v;
                *known.entry(at).or_insert_with(|| {
                    mesh.vertices_m.push(DVec3::from_array(at.map(f64::from)) * 0.01);
                    mesh.vertices_m.len() as u32 - 1
                })
            };
            let [a, b, c, d] = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
            let both = [[a, b, c], [a, c, d]];
            mesh.triangles.extend(both.map(|[a, b, c]| if side == 1 { [a, b, c] } else { [b, a, c] }));
        }
    }
    mesh
}

const BOX_M3: f64 = 1e-6;

fn same(one: f64, other: f64) {
    assert!((one / other - 1.0).abs() < 1e-9, "{one} {other}");
}

/// Checks that the mesh can be used. Returns its report.
fn usable(prepared: &Prepared) -> MeshReport {
    let report = prepared.report();
    assert!(report.refusal().is_none(), "{:?} {:?}", report.problems, prepared.notes);
    // Preparing it again changes nothing.
    let file = prepared.file.as_ref().map_or(&prepared.mesh, |file| &file.mesh);
    let again = prepare(file.clone());
    assert!((&again.mesh, &again.file) == (&prepared.mesh, &prepared.file), "{:?} {:?}", prepared.notes, again.notes);
    if let Some(file) = &prepared.file {
        assert_eq!(file.vertex_of.len(), file.mesh.vertices_m.len());
        for (of_file, simulated) in file.mesh.triangles.iter().zip(&prepared.mesh.triangles) {
            assert_eq!(of_file.map(|vertex| file.vertex_of[vertex as usize]), *simulated);
        }
        for vertex in file.mesh.triangles.iter().flatten().map(|vertex| *vertex as usize) {
            assert_eq!(file.mesh.vertices_m[vertex], prepared.mesh.vertices_m[file.vertex_of[vertex] as usize]);
        }
    }
    report
}

fn mended(mesh: &TriangleMesh) -> (Repaired, MeshReport) {
    let repaired = repair(mesh, &Repair::default());
    let report = report(&repaired.mesh);
    assert!(report.refusal().is_none(), "{:?} {:?}", report.problems, repaired.told);
    (repaired, report)
}

#[test]
fn a_mesh_without_a_flaw_is_not_changed() {
    for organ in [Organ::Gallbladder, Organ::Colon, Organ::Patch] {
        let mesh = generate(organ, 0.0035, 3).unwrap();
        let prepared = prepare(mesh.clone());
        assert_eq!((prepared.mesh, prepared.file, prepared.notes), (mesh, None, Vec::new()), "{organ:?}");
    }
}

#[test]
fn a_shape_is_the_same_however_its_triangles_are_numbered_and_turned() {
    let mut dice = Rng::with_seed(5);
    for mesh in [octahedron(), sphere(2), sphere(3), boxes(&[[0, 0, 0]])] {
        let measure = SurfaceMeasure::of(&mesh);
        for round in 0..24 {
            let mut other = match round % 4 {
                0 => turned(&mesh, |_| true),
                1 => turned(&mesh, |n| n % 2 == 0),
                2 => turned(&mesh, |_| dice.bool()),
                _ => mesh.clone(),
            };
            if round % 3 > 0 {
                other = soup(&other);
            }
            if round > 12 {
                dice.shuffle(&mut other.triangles);
            }
            let prepared = prepare(other.clone());
            let report = usable(&prepared);
            assert_eq!((report.vertices, report.components, report.holes), (mesh.vertices_m.len(), 1, 0));
            same(report.volume_m3.unwrap(), measure.volume_m3.unwrap());
            // The vertices of the file keep their indices.
            if let Some(file) = prepared.file {
                assert_eq!(file.mesh.vertices_m, other.vertices_m);
            }
            let (repaired, report) = mended(&other);
            same(report.volume_m3.unwrap(), measure.volume_m3.unwrap());
            assert_eq!(repaired.faults, [""; 0]);
        }
    }
}

#[test]
fn closed_parts_face_outward_from_the_tissue_around_their_cavities() {
    let mut dice = Rng::with_seed(8);
    let (outer, inner, island) =
        (sphere(2), moved(&sphere(2), 0.6, DVec3::new(0.01, 0.0, 0.005)), moved(&sphere(1), 0.3, DVec3::ZERO));
    let beside = moved(&sphere(2), 0.7, DVec3::new(0.3, 0.0, 0.0));
    let volume = |mesh: &TriangleMesh| SurfaceMeasure::of(mesh).volume_m3.unwrap();
    for round in 0..32 {
        let either = |mesh: &TriangleMesh, bit: usize| turned(mesh, |_| round >> bit & 1 == 1);
        let mut mesh = both(&either(&outer, 0), &either(&inner, 1));
        let mut expected = volume(&outer) - volume(&inner);
        if round >= 8 {
            mesh = both(&either(&beside, 2), &mesh);
            expected += volume(&beside);
        }
        if round >= 16 {
            mesh = both(&mesh, &either(&island, 3));
            expected += volume(&island);
        }
        if round % 5 == 0 {
            mesh = soup(&mesh);
            dice.shuffle(&mut mesh.triangles);
        }
        let report = usable(&prepare(mesh.clone()));
        same(report.volume_m3.unwrap(), expected);
        assert!(!report.counts.contains_key("faces_inward") && !report.counts.contains_key("cavity_faces_tissue"));
    }
    // Surfaces that intersect each other are not inside each other.
    let cutting = both(&outer, &moved(&outer, 0.9, DVec3::new(0.03, 0.01, 0.02)));
    same(usable(&prepare(cutting.clone())).volume_m3.unwrap(), volume(&outer) * (1.0 + 0.9_f64.powi(3)));
    // The report on an unchanged file.
    let hollow = both(&outer, &inner);
    assert_eq!(report(&hollow).counts["cavity_faces_tissue"], 1);
    assert_eq!(report(&turned(&both(&outer, &beside), |n| n < 128)).counts["faces_inward"], 1);
}

#[test]
fn repair_keeps_the_walls_of_cavities_and_tells_what_it_drops() {
    let (outer, inner) = (sphere(3), moved(&sphere(3), 0.8, DVec3::ZERO));
    let hollow = SurfaceMeasure::of(&outer).volume_m3.unwrap() * (1.0 - 0.8_f64.powi(3));
    for is_inward in [false, true] {
        let (repaired, report) = mended(&both(&outer, &turned(&inner, |_| is_inward)));
        same(report.volume_m3.unwrap(), hollow);
        same(repaired.after.volume_m3.unwrap(), hollow);
        assert_eq!(report.components, 2);
        same(repaired.before.volume_m3.unwrap(), hollow);
        assert_eq!(repaired.faults, [""; 0]);
    }
    // Debris is dropped. A second organ is dropped too, but this is reported as a fault.
    let debris = both(&outer, &moved(&octahedron(), 0.02, DVec3::new(0.2, 0.0, 0.0)));
    let (repaired, report) = mended(&debris);
    assert_eq!((report.components, repaired.faults.len()), (1, 0), "{:?}", repaired.faults);
    let (repaired, report) = mended(&both(&outer, &moved(&inner, 1.0, DVec3::new(0.3, 0.0, 0.0))));
    assert_eq!(report.components, 1);
    assert!(repaired.faults.iter().any(|fault| fault.contains("% of the area")), "{:?}", repaired.faults);
    assert!(repaired.before.volume_m3.unwrap() > 1.5 * repaired.after.volume_m3.unwrap());
}

#[test]
fn solids_that_touch_at_an_edge_or_a_vertex_are_closed_each() {
    let mut dice = Rng::with_seed(3);
    for other in [[1, 1, 0], [0, 1, 1], [1, 0, -1], [1, 1, 1], [-1, 1, -1]] {
        let mesh = boxes(&[[0, 0, 0], other]);
        assert!(report(&mesh).refusal().is_some());
        for round in 0..12 {
            let mesh = if round % 2 == 0 { mesh.clone() } else { soup(&mesh) };
            let mesh = match round / 2 % 3 {
                0 => mesh,
                1 => turned(&mesh, |n| n >= 12),
                _ => turned(&mesh, |_| dice.usize(..6) == 0),
            };
            let report = usable(&prepare(mesh.clone()));
            assert_eq!(report.holes, 0);
            same(report.volume_m3.unwrap(), 2.0 * BOX_M3);
        }
        // Parts that share an edge stay together; parts that share only a vertex do not.
        let (repaired, report) = mended(&mesh);
        let is_edge = other.contains(&0);
        same(report.volume_m3.unwrap(), BOX_M3 * if is_edge { 2.0 } else { 1.0 });
        assert_eq!(repaired.faults.is_empty(), is_edge, "{:?}", repaired.faults);
    }
}

#[test]
fn an_edge_of_three_triangles_is_refused_if_the_file_says_so_and_repair_leaves_one_apart() {
    let mut fin = octahedron();
    fin.vertices_m.push(DVec3::new(0.2, 0.2, 0.0));
    fin.triangles.push([0, 2, 6]);
    assert!(prepare(fin.clone()).report().counts.contains_key("non_manifold_edge"));
    let prepared = prepare(soup(&fin));
    let report = usable(&prepared);
    assert_eq!((report.components, report.holes), (2, 1));
    assert!(prepared.notes.iter().any(|note| note.contains("odd number of triangles")), "{:?}", prepared.notes);
    for mesh in [fin.clone(), soup(&fin)] {
        let (repaired, report) = mended(&mesh);
        assert_eq!((report.triangles, report.holes), (8, 0), "{:?}", repaired.told);
    }
}

#[test]
fn a_surface_of_two_sides_is_one_layer() {
    let flat = sheet(3, || 0.0);
    for mesh in [flat.clone(), sphere(2), both(&sphere(2), &moved(&flat, 1.0, DVec3::new(0.3, 0.0, 0.0)))] {
        let back = turned(&mesh, |_| true);
        let mut shared = mesh.clone();
        shared.triangles.extend(&back.triangles);
        for two_sided in [shared.clone(), both(&mesh, &back), soup(&shared)] {
            let report = usable(&prepare(two_sided));
            assert_eq!((report.vertices, report.triangles), (mesh.vertices_m.len(), mesh.triangles.len()));
        }
        let repaired = repair(&shared, &Repair { largest: false, hole_edges: 0, ..Repair::default() });
        assert_eq!(repaired.mesh.triangles.len(), mesh.triangles.len());
    }
}

#[test]
fn open_surfaces_face_one_side_and_are_told_if_that_is_inward() {
    let mut dice = Rng::with_seed(1);
    let flat = sheet(4, || 0.0);
    for _ in 0..10 {
        let prepared = prepare(soup(&turned(&flat, |_| dice.usize(..4) == 0)));
        let report = usable(&prepared);
        assert_eq!((report.vertices, report.holes), (25, 1));
        assert!(!report.counts.contains_key("orientation") && !report.counts.contains_key("open_faces_inward"));
        // The orientation of the majority is kept.
        let mesh = &prepared.mesh;
        let up = mesh.triangles.iter().filter(|of| {
            let [a, b, c] = of.map(|vertex| mesh.vertices_m[vertex as usize]);
            (b - a).cross(c - a).z > 0.0
        });
        assert_eq!(up.count(), flat.triangles.len());
    }
    let mut half = sphere(3);
    half.triangles.retain(|of| of.iter().map(|v| half.vertices_m[*v as usize].z).sum::<f64>() > 0.0);
    assert!(!usable(&prepare(half.clone())).counts.contains_key("open_faces_inward"));
    let inward = prepare(turned(&half, |_| true));
    assert_eq!(usable(&inward).counts["open_faces_inward"], 1);
    // A small unintended hole: the inside is still known.
    let mut nearly = turned(&sphere(4), |_| true);
    nearly.triangles.truncate(nearly.triangles.len() - 3);
    let prepared = prepare(nearly);
    assert!(!usable(&prepared).counts.contains_key("faces_inward"));
    assert!(prepared.notes.iter().any(|note| note.starts_with("Closed surfaces turned outward: 1")));
}

#[test]
fn seams_of_texture_and_groups_are_kept() {
    // Split where the texture has a seam: z = 0.
    let mut mesh = sphere(2);
    let count = mesh.vertices_m.len() as u32;
    let mut copies = Vec::new();
    let (mut uv, mut lower) = (Vec::new(), Vec::new());
    for triangle in &mut mesh.triangles {
        let is_lower = triangle.iter().map(|vertex| mesh.vertices_m[*vertex as usize].z).sum::<f64>() < 0.0;
        if is_lower {
            for vertex in triangle.iter_mut().filter(|vertex| mesh.vertices_m[**vertex as usize].z == 0.0) {
                let known = copies.iter().position(|other| other == vertex);
                *vertex = count
                    + known.unwrap_or_else(|| {
                        copies.push(*vertex);
                        copies.len() - 1
                    }) as u32;
            }
            lower.extend(*triangle);
        }
        uv.push([[if is_lower { 1.0 } else { 0.0 }, 0.5]; 3]);
    }
    let seam: Vec<DVec3> = copies.iter().map(|vertex| mesh.vertices_m[*vertex as usize]).collect();
    mesh.vertices_m.extend(seam);
    lower.sort_unstable();
    lower.dedup();
    mesh.groups = vec![Group { name: "lower".into(), vertices: lower.clone() }];
    mesh.uv = Some(uv.clone());
    let prepared = prepare(mesh.clone());
    let report = usable(&prepared);
    assert_eq!((report.vertices, report.holes), (count as usize, 0));
    let file = prepared.file.unwrap();
    assert_eq!((&file.mesh.uv, &file.mesh.groups), (&mesh.uv, &mesh.groups));
    let group = &prepared.mesh.groups[0].vertices;
    assert!(group.is_sorted_by(|a, b| a < b) && group.len() == lower.len());
    assert!(copies.iter().all(|vertex| group.contains(vertex)), "the seam belongs to both sides");
    // If a vertex is split, all its copies are in its groups.
    let mut touching = boxes(&[[0, 0, 0], [1, 1, 1]]);
    let shared = touching.vertices_m.iter().position(|at| *at == DVec3::splat(0.01)).unwrap() as u32;
    touching.groups = vec![Group { name: "shared".into(), vertices: vec![shared] }];
    let prepared = prepare(touching);
    usable(&prepared);
    assert_eq!((&prepared.mesh.groups[0].vertices[..], prepared.file), (&[shared, 15][..], None));
}

#[test]
fn a_vertex_that_no_triangle_has_is_no_tissue() {
    for far in [0.0, 5.0, 1e6] {
        let mut mesh = boxes(&[[0, 0, 0]]);
        mesh.vertices_m.insert(3, DVec3::new(far, 0.02, 0.0));
        mesh.triangles.iter_mut().flatten().filter(|vertex| **vertex >= 3).for_each(|vertex| *vertex += 1);
        assert!(report(&mesh).extent_m.iter().all(|side| (side - 0.01).abs() < 1e-12), "of what is used");
        let prepared = prepare(mesh);
        assert_eq!(usable(&prepared).vertices, 8);
        let file = prepared.file.unwrap();
        let nearest = prepared.mesh.vertices_m[file.vertex_of[3] as usize];
        assert_eq!(nearest.y, 0.01);
        // Messages use the vertex indices of the file.
        let mut torn = boxes(&[[0, 0, 0]]);
        torn.vertices_m.insert(0, DVec3::splat(far + 0.03));
        torn.triangles.iter_mut().flatten().for_each(|vertex| *vertex += 1);
        torn.triangles.push([1, 2, 0]);
        let told = prepare(torn).report().refusal().unwrap().element.to_string();
        assert_eq!(told, "edge 1-2");
    }
}

/// The cells of a grid as in VTK, each as five tetrahedra whose diagonals depend on `kind`, or as a hexahedron.
fn grid(size: [i32; 3], mut kind: impl FnMut([i32; 3]) -> Option<bool>) -> TriangleMesh {
    let [nx, ny, nz] = size;
    let number = |[x, y, z]: [i32; 3]| x + (nx + 1) * (y + (ny + 1) * z);
    let (mut cells, mut types, mut length) = (String::new(), String::new(), 0);
    for [x, y, z] in (0..nx * ny * nz).map(|n| [n % nx, n / nx % ny, n / nx / ny]) {
        let corner = |n: i32| number([x + (n & 1), y + (n >> 1 & 1), z + (n >> 2)]);
        let mut add = |corners: &[i32], of: i32| {
            let text: Vec<String> = corners.iter().map(|n| corner(*n).to_string()).collect();
            cells += &format!("{} {}\n", corners.len(), text.join(" "));
            types += &format!("{of}\n");
            length += corners.len() + 1;
        };
        match kind([x, y, z]) {
            None => add(&[0, 1, 3, 2, 4, 5, 7, 6], 12),
            Some(false) => {
                [[0, 1, 2, 4], [3, 1, 2, 7], [5, 1, 4, 7], [6, 2, 4, 7], [1, 2, 4, 7]]
                    .iter()
                    .for_each(|of| add(of, 10));
            }
            Some(true) => {
                [[1, 0, 3, 5], [2, 0, 3, 6], [4, 0, 5, 6], [7, 3, 5, 6], [0, 3, 5, 6]]
                    .iter()
                    .for_each(|of| add(of, 10));
            }
        }
    }
    let mut points = String::new();
    let count = (nx + 1) * (ny + 1) * (nz + 1);
    for n in 0..count {
        points +=
            &format!("{} {} {}\n", 7 * (n % (nx + 1)), 5 * (n / (nx + 1) % (ny + 1)), 11 * (n / (nx + 1) / (ny + 1)));
    }
    let number = types.lines().count();
    let text = format!(
        "# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS {count} double\n{points}CELLS {number} \
         {length}\n{cells}CELL_TYPES {number}\n{types}"
    );
    read("grid.vtk", text.as_bytes(), "mm".parse::<Unit>().unwrap(), &|_| None, &ReadLimits::default()).unwrap().mesh
}

#[test]
fn cells_whose_diagonals_do_not_match_are_one_solid() {
    let mut dice = Rng::with_seed(6);
    for (size, rounds) in [([2, 1, 1], 2), ([2, 2, 1], 4), ([3, 1, 1], 4), ([2, 2, 2], 8), ([3, 3, 3], 12)] {
        for round in 0..rounds {
            let mesh = grid(size, |[x, y, z]| match round {
                // All cells are equal, except the one in the middle.
                0 => Some(false),
                1 => Some((x + y + z) % 2 == usize::from([x, y, z] == [1, 1, 1]) as i32),
                2 => [None, Some(false), Some(true)][dice.usize(..3)],
                _ => Some(dice.bool()),
            });
            let volume = f64::from(size[0] * size[1] * size[2]) * 385e-9;
            same(SurfaceMeasure::of(&mesh).volume_m3.unwrap(), volume);
            let prepared = prepare(mesh.clone());
            let found = usable(&prepared);
            assert_eq!((found.components, found.holes), (1, 0), "{size:?} {round} {:?}", prepared.notes);
            same(found.volume_m3.unwrap(), volume);
            let (repaired, found) = mended(&mesh);
            assert_eq!((found.components, repaired.faults.len()), (1, 0), "{:?} {:?}", repaired.told, repaired.faults);
            same(found.volume_m3.unwrap(), volume);
            let [x, y, z] = size.map(f64::from);
            let area = 2e-6 * (35.0 * x * y + 55.0 * y * z + 77.0 * z * x);
            same(repaired.after.area_m2, area);
        }
    }
}

#[test]
fn voxels_that_hang_together_are_closed_and_whole() {
    let mut dice = Rng::with_seed(4);
    // Around an edge between the middle voxels, which share both its ends; and random sets like this.
    let ring = [[0, 0, 0], [1, 1, 0], [0, 0, 1], [1, 1, 1], [0, 0, 2], [1, 1, 2]];
    let bridges = [[1, 0, 0], [1, 0, 2]];
    let mut sets = vec![ring.iter().chain(&bridges).copied().collect::<Vec<_>>()];
    for _ in 0..40 {
        sets.push((0..27).filter(|_| dice.usize(..3) > 0).map(|n| [n % 3, n / 3 % 3, n / 9]).collect());
    }
    for cells in sets {
        let prepared = prepare(boxes(&cells));
        let report = usable(&prepared);
        assert_eq!(report.holes, 0);
        same(report.volume_m3.unwrap(), BOX_M3 * cells.len() as f64);
        let (repaired, report) = mended(&boxes(&cells));
        assert_eq!(report.holes, 0, "{:?}", repaired.told);
        same(repaired.after.volume_m3.unwrap(), report.volume_m3.unwrap());
    }
    for _ in 0..60 {
        // A random walk from voxel to voxel through faces and edges.
        let (mut at, mut cells) = ([0_i32; 3], vec![[0; 3]]);
        for _ in 0..dice.usize(1..14) {
            let from = at;
            for axis in (0..3).filter(|_| dice.bool()).take(2).collect::<Vec<_>>() {
                at[axis] = (at[axis] + if dice.bool() { 1 } else { -1 }).clamp(0, 2);
            }
            if from.iter().zip(&at).filter(|(a, b)| a != b).count() == 3 {
                at = from;
            }
            cells.push(at);
        }
        cells.sort_unstable();
        cells.dedup();
        let volume = BOX_M3 * cells.len() as f64;
        for mesh in [boxes(&cells), soup(&boxes(&cells))] {
            let (repaired, report) = mended(&mesh);
            assert_eq!((report.holes, repaired.faults.len()), (0, 0), "{cells:?} {:?}", repaired.faults);
            same(report.volume_m3.unwrap(), volume);
        }
        let report = usable(&prepare(boxes(&cells)));
        assert_eq!(report.holes, 0);
        same(report.volume_m3.unwrap(), volume);
    }
}
