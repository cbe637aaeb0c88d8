//! Tests of wounds: nothing reaches across a cut, and nothing else changes.
#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::{DVec2, DVec3};

use super::super::encode::tests::decoded;
use super::super::{Encoding, FrameTiles, Snapshot, encode};
use super::*;
use palpate_haptics::{Tip, TipShape};
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::{PAPER, Scene};
use palpate_tissue::{Tissue, at_rest};

/// A surface as a client has it: rest positions, m, and triangles.
#[derive(Debug, Clone, PartialEq)]
struct Mesh {
    rest_m: Vec<DVec3>,
    triangles: Vec<[u32; 3]>,
}

impl Mesh {
    fn of_sheet(refinement: Refinement) -> Self {
        let halves = |[a, b, c, d, e, f]: [usize; 6]| [[a, b, c], [d, e, f]];
        let triangles = (0..refinement.cell_count()).flat_map(|cell| halves(refinement.triangles(cell)));
        Mesh {
            rest_m: (0..refinement.vertex_count()).map(|vertex| refinement.rest_m(vertex)).collect(),
            triangles: triangles.map(|corners| corners.map(|corner| u32::try_from(corner).unwrap())).collect(),
        }
    }

    fn of_skin(skin: &Skin) -> Self {
        Mesh {
            rest_m: skin.vertices().iter().map(|vertex| skin.rest_m(*vertex)).collect(),
            triangles: skin.triangles().iter().map(|corners| corners.map(|at| skin.places()[at as usize])).collect(),
        }
    }

    /// Returns the places of all vertices and the triangles with a wound, from displacements of the vertices, m.
    fn cut(&self, wound: &Wound, moved_m: &[DVec3]) -> Mesh {
        let mut places_m: Vec<DVec3> = self.rest_m.iter().zip(moved_m).map(|(rest_m, by_m)| *rest_m + *by_m).collect();
        for lip in &wound.vertices {
            let at = [lip.host, lip.others[0], lip.others[1]].map(|vertex| self.rest_m[vertex as usize]);
            let rest_m: DVec3 = at.iter().zip(lip.shares()).map(|(at_m, share)| share * *at_m).sum();
            places_m.push(rest_m + moved_m[lip.host as usize]);
        }
        Mesh { rest_m: places_m, triangles: wound.shown_triangles(self.triangles.iter().copied()) }
    }

    fn at_rest(&self, wound: &Wound) -> Mesh {
        self.cut(wound, &vec![DVec3::ZERO; self.rest_m.len()])
    }

    /// Returns twice the area of each triangle, as vectors.
    fn normals(&self) -> impl Iterator<Item = DVec3> + '_ {
        self.triangles.iter().map(|corners| {
            let [a, b, c] = corners.map(|corner| self.rest_m[corner as usize]);
            (b - a).cross(c - a)
        })
    }

    fn area_m2(&self) -> f64 {
        self.normals().map(|normal| 0.5 * normal.length()).sum()
    }
}

fn host(wound: &Wound, vertex: u32) -> u32 {
    vertex.checked_sub(wound.first_vertex).map_or(vertex, |lip| wound.vertices[lip as usize].host)
}

/// Returns the sides of triangles, ascending, that belong to one of them alone.
fn of_one(triangles: &[[u32; 3]]) -> Vec<[u32; 2]> {
    let mut sides: Vec<[u32; 2]> = triangles
        .iter()
        .flat_map(|[a, b, c]| [[*a, *b], [*b, *c], [*c, *a]])
        .map(|[p, q]| [p.min(q), p.max(q)])
        .collect();
    sides.sort_unstable();
    sides.chunk_by(|one, other| one == other).filter(|same| same.len() == 1).map(|same| same[0]).collect()
}

/// Asserts that no shown triangle reaches across a severed edge, and that each edge that was shown has two vertices where it was severed.
fn assert_parted(mesh: &Mesh, wound: &Wound, edges: &[SeveredEdge]) {
    let mut severed: Vec<[u32; 2]> = edges.iter().map(|edge| edge.ends).collect();
    severed.sort_unstable();
    let shown = mesh.at_rest(wound);
    for corners in &shown.triangles {
        let [a, b, c] = corners.map(|corner| host(wound, corner));
        for [p, q] in [[a, b], [b, c], [c, a]] {
            assert!(severed.binary_search(&[p.min(q), p.max(q)]).is_err(), "{corners:?} joins {p} and {q}");
        }
    }
    // Both lips of the wound are the sides that only one triangle has, less those that the whole surface has.
    let is_along = |[p, q]: [u32; 2]| {
        let of_spring = |lip: u32, end: u32| {
            let lip = lip.checked_sub(wound.first_vertex).map(|lip| wound.vertices[lip as usize]);
            lip.is_some_and(|lip| lip.host == end || lip.others == [end, end])
        };
        of_spring(p, q) || of_spring(q, p)
    };
    let is_new = |side: &[u32; 2]| side[1] >= wound.first_vertex && !is_along(*side);
    let mut lips: Vec<[u32; 2]> = wound.lips().map(|[p, q]| [p.min(q), p.max(q)]).collect();
    lips.sort_unstable();
    assert_eq!(lips, of_one(&shown.triangles).into_iter().filter(is_new).collect::<Vec<_>>());
    let joins = |[a, b]: [u32; 2]| mesh.triangles.iter().any(|corners| corners.contains(&a) && corners.contains(&b));
    let mut count = 0;
    for edge in edges.iter().filter(|edge| joins(edge.ends)) {
        let [a_m, b_m] = edge.ends.map(|end| mesh.rest_m[end as usize]);
        let place_m = a_m.lerp(b_m, edge.part);
        // Weights have the precision of a float.
        let within_m = 1e-6 * a_m.distance(b_m);
        for end in edge.ends {
            let is_own = |(lip, at_m): (&LipVertex, &DVec3)| lip.host == end && at_m.distance(place_m) < within_m;
            let lips = wound.vertices.iter().zip(&shown.rest_m[mesh.rest_m.len()..]);
            assert_eq!(lips.filter(|lip| is_own(*lip)).count(), 1, "{edge:?}");
        }
        count += 2;
    }
    let middles = wound.vertices.iter().filter(|lip| lip.others[0] != lip.others[1]).count();
    assert!(count > 0 && wound.vertices.len() == count + middles);
    let [before, after] = [mesh.area_m2(), shown.area_m2()];
    assert!((after - before).abs() < 1e-6 * before, "{before} m², with a wound {after} m²");
}

/// Leads an upright blade through a tissue. Returns its cuts at each version of the topology.
pub(in super::super) fn cut(tissue: &mut dyn Tissue, from_m: DVec3, to_m: DVec3, steps: u32) -> Vec<Cuts> {
    let tip = Tip { shape: TipShape::Blade, radius_m: 0.001, edge_m: 0.02 * DVec3::Z, ..Tip::default() };
    let mut cuts = vec![tissue.cuts()];
    for step in 0..=steps {
        tissue.pose(0, from_m.lerp(to_m, f64::from(step) / f64::from(steps)), tip);
        tissue.step().unwrap();
        if tissue.cuts().version() > cuts[cuts.len() - 1].version() {
            cuts.push(tissue.cuts());
        }
    }
    tissue.release(0);
    cuts
}

fn model(text: &str, sets: &[&str]) -> Arc<Model> {
    let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
    Model::compile(&Scene::parse("test", text, &sets, &Limits::default()).unwrap(), &Limits::default()).unwrap()
}

/// A sheet of 12 × 11 points that are 5 mm apart.
fn sheet() -> Arc<Model> {
    model(PAPER, &["sheet.points=[12, 11]", "sheet.spacing_m=0.005", "springs.bending=true", "stepping.precision=f64"])
}

fn refinement(model: &Model, n: u32) -> Refinement {
    Refinement::new(&model.scene, n, &Limits::default()).unwrap()
}

/// Adds what is new to the wound that a client has.
fn follow(known: &mut Wound, new: Wound) {
    let kept = new.first_vertex as usize - known.first_vertex as usize;
    assert_eq!(known.vertices.len(), kept);
    known.vertices.extend(new.vertices);
    let mut triangles: BTreeMap<u32, CutTriangles> = known.triangles.drain(..).map(|cut| (cut.first, cut)).collect();
    triangles.extend(new.triangles.into_iter().map(|cut| (cut.first, cut)));
    known.triangles = triangles.into_values().collect();
}

#[test]
fn a_slit_in_a_sheet_has_two_lips_and_nothing_reaches_across_it() {
    let model = sheet();
    let mut tissue = at_rest(&model);
    // Oblique, from the middle to beyond the middle.
    cut(&mut *tissue, DVec3::new(0.013, 0.011, -0.01), DVec3::new(0.041, 0.037, -0.01), 60);
    let (cuts, points) = (tissue.cuts(), refinement(&model, 0));
    let edges = edges_of(&model, &cuts, |point| u32::try_from(point.index()).unwrap());
    let wound = Wound::of(&model, &cuts, None, points).unwrap();
    assert!(wound.vertices.len() > 20, "{}", wound.vertices.len());
    assert_parted(&Mesh::of_sheet(points), &wound, &edges);
}

#[test]
fn both_sides_of_a_cut_through_a_sheet_move_apart_without_a_stretched_triangle() {
    let model = sheet();
    let mut tissue = at_rest(&model);
    cut(&mut *tissue, DVec3::new(0.0271, -0.005, -0.01), DVec3::new(0.0283, 0.06, -0.01), 80);
    let cuts = tissue.cuts();
    assert_eq!(cuts.pieces(&model), 2);
    let grid = refinement(&model, 0);
    let by_m = DVec3::new(0.01, 0.002, 0.003);
    // Beyond the cut everything moves alike.
    let moved: [Vec<f32>; 3] = std::array::from_fn(|c| {
        let is_beyond = |point: usize| grid.rest_m(point).x > 0.0277;
        (0..grid.point_count()).map(|point| if is_beyond(point) { by_m[c] as f32 } else { 0.0 }).collect()
    });
    let snapshot = Snapshot::new(&model.scene, 1, 0.001, moved);
    for n in [0, 1, 3] {
        let grid = refinement(&model, n);
        let mesh = Mesh::of_sheet(grid);
        let mut moved_m = vec![DVec3::ZERO; grid.vertex_count()];
        let frame = encode(&snapshot, grid, Encoding::F32);
        for patch in &frame.patches {
            for (index, by_m) in decoded(&frame, patch).into_iter().enumerate() {
                let at = [patch.first[0] + index / patch.count[1], patch.first[1] + index % patch.count[1]];
                moved_m[at[0] * grid.vertices()[1] + at[1]] = by_m.into();
            }
        }
        let wound = Wound::of(&model, &cuts, None, grid).unwrap();
        let (rest, now) = (mesh.at_rest(&wound), mesh.cut(&wound, &moved_m));
        assert!((rest.area_m2() - mesh.area_m2()).abs() < 1e-8, "n = {n}");
        for (corners, (before, after)) in rest.triangles.iter().zip(rest.normals().zip(now.normals())) {
            assert!((before - after).length() < 1e-9, "n = {n}: {corners:?}");
            assert!(before.z > 0.0 || before.length() < 1e-12, "n = {n}: {corners:?}");
        }
        // Only at the sides of the sheet and on the lips has a side of a triangle no other beside it.
        let mut lips: Vec<[u32; 2]> = wound.lips().map(|[p, q]| [p.min(q), p.max(q)]).collect();
        lips.sort_unstable();
        assert!(!lips.is_empty());
        let on_side = |at_m: DVec3| {
            at_m.x.min(at_m.y).abs() < 1e-9 || (at_m.x - 0.055).abs() < 1e-9 || (at_m.y - 0.05).abs() < 1e-9
        };
        let single = of_one(&rest.triangles)
            .into_iter()
            .filter(|side| !side.iter().all(|vertex| on_side(rest.rest_m[*vertex as usize])));
        assert_eq!(single.collect::<Vec<_>>(), lips, "n = {n}");
        // Without the wound, what lies between is stretched.
        let whole = mesh.cut(&Wound::default(), &moved_m);
        assert!(whole.area_m2() > 1.1 * mesh.area_m2(), "n = {n}");
    }
}

#[test]
fn a_slit_in_a_mesh_has_two_lips_and_nothing_reaches_across_it() {
    let model = model(crate::GALLBLADDER, &[]);
    let mut tissue = at_rest(&model);
    let extent = model.shape().extent();
    let (middle_m, most_m) = (extent.middle_m(), extent.least_m.z + 2.0 * (extent.middle_m().z - extent.least_m.z));
    let at = |x: f64| DVec3::new(middle_m.x + x, middle_m.y + 0.3 * x, most_m - 0.012);
    cut(&mut *tissue, at(-0.012), at(0.012), 60);
    let (cuts, skin) = (tissue.cuts(), Skin::of(&model).unwrap());
    let edges = edges_of(&model, &cuts, |point| skin.places()[point.index()]);
    let wound = Wound::of(&model, &cuts, Some(&skin), refinement(&model, 0)).unwrap();
    assert!(wound.vertices.len() > 8, "{}", wound.vertices.len());
    assert_parted(&Mesh::of_skin(&skin), &wound, &edges);
}

/// A block of 100 × 100 × 40 mm on a table.
pub(in super::super) fn block() -> Arc<Model> {
    let text = "[solid]\norgan = { name = \"phantom\", edge_m = 0.006, seed = 1 }\ncell_m = 0.008\n\
                fixed = [{ plane_m = [0, 0, 0], normal = [0, 0, 1], within_m = 0.001 }]\n\
                [material]\nyoungs_modulus_pa = 15e3\npoissons_ratio = 0.45\n[stepping]\nsubsteps = 4\n";
    model(text, &[])
}

#[test]
fn a_slit_in_a_solid_has_two_lips_each_of_which_moves_with_its_own_cells() {
    let model = block();
    let mut tissue = at_rest(&model);
    // Oblique, from one side to beyond the middle, 15 mm deep; then across it.
    let low = |x: f64, y: f64| DVec3::new(x, y, 0.025);
    let mut cuts = cut(&mut *tissue, low(-0.006, -0.055), low(0.011, 0.02), 100);
    cuts.extend(cut(&mut *tissue, low(-0.02, -0.013), low(0.03, -0.02), 60));
    let skin = Skin::of(&model).unwrap();
    let (mesh, whole) = (Mesh::of_skin(&skin), tissue.cuts());
    let triangles = || mesh.triangles.iter().copied();
    let edges = parted_edges(&model, &whole, &skin, triangles());
    let wounds: Vec<Wound> =
        cuts.iter().map(|cuts| Wound::of(&model, cuts, Some(&skin), refinement(&model, 0)).unwrap()).collect();
    let wound = &wounds[wounds.len() - 1];
    assert!(edges.len() > 20 && wounds.len() > 10, "{} {}", edges.len(), wounds.len());
    assert_parted(&mesh, wound, &edges);
    for (known, cuts) in wounds.iter().zip(&cuts) {
        let mut known = known.clone();
        follow(&mut known, wound.clone().since(cuts.version()));
        assert_eq!(&known, wound, "from version {} on", cuts.version());
    }
    // Pressed beside the slit, one lip goes down and the other does not follow.
    let tip = Tip { radius_m: 0.008, shape: TipShape::Sphere, ..Tip::default() };
    for step in 0..400 {
        tissue.pose(1, DVec3::new(0.02, 0.0, 0.048 - 4e-5 * f64::from(step).min(200.0)), tip);
        tissue.step().unwrap();
    }
    let mut simulated_m = std::array::from_fn(|_| Vec::new());
    tissue.shown_displacements_m(&mut simulated_m);
    let shown_m = skin.displacement_m(&simulated_m, &tissue.cuts(), skin.vertices().len());
    let z_m = |vertex: u32| f64::from(shown_m[2][vertex as usize]);
    let gaps_m = wound.vertices.chunks(2).filter(|lips| lips.len() == 2 && lips[0].others == [lips[1].host; 2]);
    let most_m = gaps_m.map(|lips| (z_m(lips[0].host) - z_m(lips[1].host)).abs()).fold(0.0, f64::max);
    assert!(most_m > 5e-4, "{most_m} m");
}

#[test]
fn a_wound_that_is_followed_from_any_version_is_the_whole_wound() {
    let model = sheet();
    let mut tissue = at_rest(&model);
    let mut cuts = cut(&mut *tissue, DVec3::new(0.013, 0.011, -0.01), DVec3::new(0.041, 0.037, -0.01), 60);
    // A second cut crosses the first, so that some triangles are in three parts.
    cuts.extend(cut(&mut *tissue, DVec3::new(0.043, 0.012, -0.01), DVec3::new(0.008, 0.0372, -0.01), 60));
    for n in [0, 2] {
        let grid = refinement(&model, n);
        let wounds: Vec<Wound> = cuts.iter().map(|cuts| Wound::of(&model, cuts, None, grid).unwrap()).collect();
        let whole = &wounds[wounds.len() - 1];
        assert!(wounds.len() > 20 && wounds[0].vertices.is_empty() && wounds[0].triangles.is_empty());
        for (known, cuts) in wounds.iter().zip(&cuts) {
            let mut known = known.clone();
            follow(&mut known, whole.clone().since(cuts.version()));
            assert_eq!(&known, whole, "from version {} on", cuts.version());
        }
        assert_eq!(whole.clone().since(0), *whole);
    }
}

#[test]
fn a_new_topology_makes_a_frame_although_nothing_moves() {
    let scene = sheet().scene.clone();
    let at = |step: u64, version: u32| {
        let still = std::array::from_fn(|_| vec![0.0; 12 * 11]);
        let mut snapshot = Snapshot::new(&scene, step, step as f64 * 0.001, still);
        snapshot.topology_version = version;
        Arc::new(snapshot)
    };
    let grid = Refinement::new(&scene, 0, &Limits::default()).unwrap();
    for encoding in Encoding::ALL {
        let mut tiles = FrameTiles::new(&at(0, 0), grid, encoding);
        tiles.update(&at(1, 0));
        let known = Some(tiles.version());
        assert!(!tiles.is_newer_than(known));
        tiles.update(&at(2, 1));
        tiles.update(&at(3, 1));
        assert!(tiles.is_newer_than(known) && !tiles.is_newer_than(Some(tiles.version())));
        let frame = tiles.newer_than(known);
        assert_eq!((frame.topology_version, frame.patches.len(), frame.full), (1, 0, false));
    }
}

/// A triangle with severed edges.
fn triangle(edges: &[([u32; 2], f64)]) -> (Mesh, Wound, Vec<SeveredEdge>) {
    let mesh = Mesh {
        rest_m: [DVec2::ZERO, DVec2::new(1.0, 0.0), DVec2::new(0.2, 0.9)].map(|place| place.extend(0.0)).to_vec(),
        triangles: vec![[0, 1, 2]],
    };
    let edges: Vec<_> = edges
        .iter()
        .zip(1..)
        .map(|((ends, part), version)| SeveredEdge { ends: *ends, part: *part, version })
        .collect();
    let wound = split(mesh.triangles.iter().copied(), &edges, 3);
    (mesh, wound, edges)
}

#[test]
fn a_triangle_is_divided_by_any_of_its_edges() {
    let all = [([0, 1], 0.3), ([1, 2], 0.7), ([0, 2], 0.45)];
    for mask in 1..8_usize {
        let severed: Vec<_> =
            all.iter().enumerate().filter(|(edge, _)| mask >> edge & 1 != 0).map(|(_, e)| *e).collect();
        let (mesh, wound, edges) = triangle(&severed);
        assert_parted(&mesh, &wound, &edges);
        let expected = [0, 2, 3, 6][severed.len()];
        assert_eq!(wound.triangles[0].corners.len(), expected);
        assert!(mesh.at_rest(&wound).normals().all(|normal| normal.z > 0.0), "{mask}");
    }
    // What is not an edge of a triangle changes nothing.
    assert_eq!(triangle(&[([1, 7], 0.5)]).1, Wound { first_vertex: 3, ..Wound::default() });
}

/// The file that the tests of the package for TypeScript read: a small mesh, its wound in two parts, and what is shown then.
#[test]
fn the_wound_that_clients_are_tested_with_is_this_one() {
    let grid = [4_u32, 4];
    let rest_m: Vec<DVec3> = (0..16).map(|at| DVec3::new(f64::from(at / 4), f64::from(at % 4), 0.0)).collect();
    let corner = |i: u32, j: u32| grid[1] * i + j;
    let cells = (0..9).map(|cell| (cell / 3, cell % 3));
    let halves = cells.flat_map(|(i, j)| {
        let [a, b, c, d] = [corner(i, j), corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)];
        [[a, b, c], [a, c, d]]
    });
    let mesh = Mesh { rest_m, triangles: halves.collect() };
    // Between the rows 1 and 2, then around vertex 5, so that triangles are in two, three and six parts.
    let ends = [[5, 9], [5, 10], [6, 10], [6, 11], [4, 9], [4, 8], [4, 5], [0, 5], [5, 6], [1, 5], [9, 10]];
    let edge = |(at, ends): (usize, &[u32; 2])| {
        let part = 0.25 + 0.125 * (at % 4) as f64;
        SeveredEdge { ends: *ends, part, version: if at < 6 { 3 } else { 5 } }
    };
    let edges: Vec<SeveredEdge> = ends.iter().enumerate().map(edge).collect();
    let [first, whole] = [&edges[..6], &edges].map(|edges| split(mesh.triangles.iter().copied(), edges, 16));
    assert_parted(&mesh, &whole, &edges);
    assert!(whole.triangles.iter().any(|cut| cut.corners.len() == 6));
    let moved_m: Vec<DVec3> = (0..16).map(|at| 0.125 * DVec3::new(f64::from(at % 3), f64::from(at % 5), 1.0)).collect();
    let now = mesh.cut(&whole, &moved_m);
    let numbers = |places: &[DVec3]| places.iter().flat_map(DVec3::to_array).collect::<Vec<f64>>();
    let message = |wound: &Wound| {
        let vertex = |lip: &LipVertex| {
            let third = if lip.others[0] == lip.others[1] { 0 } else { lip.others[1] };
            serde_json::json!({ "host": lip.host, "second": lip.others[0], "third": third,
                "secondPart": lip.weights[0], "thirdPart": lip.weights[1] })
        };
        let cut = |cut: &CutTriangles| serde_json::json!({ "first": cut.first, "count": cut.count, "corners": cut.corners.concat() });
        serde_json::json!({ "firstVertex": wound.first_vertex,
            "vertices": wound.vertices.iter().map(vertex).collect::<Vec<_>>(),
            "triangles": wound.triangles.iter().map(cut).collect::<Vec<_>>() })
    };
    let mut shown: Vec<[u32; 3]> = now.triangles.clone();
    shown.sort_unstable();
    let file = serde_json::json!({
        "restM": numbers(&mesh.rest_m), "triangles": mesh.triangles.concat(), "displacementM": numbers(&moved_m),
        "first": message(&first), "second": message(&whole.clone().since(3)),
        "shownM": numbers(&now.rest_m), "shownTriangles": shown,
    });
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../clients/typescript/test/wound.json");
    let text = format!("{file}\n");
    let known = std::fs::read_to_string(path).unwrap_or_default();
    if known != text {
        let beside = std::env::temp_dir().join("wound.json");
        std::fs::write(&beside, text).unwrap();
        panic!("clients/typescript/test/wound.json is not of this rule; {} is", beside.display());
    }
}
