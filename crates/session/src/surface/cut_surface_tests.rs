//! Tests of the surface within the cuts of a solid, as frames show it.
#![allow(clippy::unwrap_used)]

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use glam::DVec3;

use super::encode::tests::decoded;
use super::wound::tests::{block, cut};
use super::{Encoding, Refinement, Skin, Snapshot, encode};
use palpate_haptics::{Tip, TipShape};
use palpate_tissue::limits::Limits;
use palpate_tissue::{CutFace, CutSurface, CutVertex, Cuts, Model, Tissue, at_rest};

/// Cuts the block, 100 × 100 × 40 mm, wholly through along a straight line, obliquely to the lattice.
fn cut_through(tissue: &mut dyn Tissue) -> Vec<Cuts> {
    let at = |y: f64| DVec3::new(0.003 + 0.2 * y, y, -0.002);
    let mut cuts = cut(tissue, at(-0.056), at(0.056), 150);
    // The edge is 20 mm long.
    cuts.extend(cut(tissue, at(0.056) + 0.018 * DVec3::Z, at(-0.056) + 0.018 * DVec3::Z, 150));
    cuts.extend(cut(tissue, at(-0.056) + 0.03 * DVec3::Z, at(0.056) + 0.03 * DVec3::Z, 150));
    cuts
}

/// Returns the area of a face, as a vector out of its side, m².
fn area_m2(surface: &CutSurface, face: &CutFace) -> DVec3 {
    let [a, b, c, d] = face.corners.map(|corner| surface.vertices[corner as usize].rest_m);
    0.5 * (c - a).cross(d - b)
}

#[test]
fn both_sides_of_a_straight_cut_are_plane_and_have_the_area_of_the_section() {
    let model = block();
    let mut tissue = at_rest(&model);
    cut_through(&mut *tissue);
    let cuts = tissue.cuts();
    assert_eq!(cuts.pieces(&model), 2);
    let surface = CutSurface::of(&model, &cuts);
    let normal = DVec3::new(1.0, -0.2, 0.0).normalize();
    for vertex in &surface.vertices {
        let off_m = (vertex.rest_m - DVec3::new(0.003, 0.0, 0.0)).dot(normal);
        assert!(off_m.abs() < 1e-5, "{vertex:?} is {off_m} m off the plane");
        // Back on the plane, it may be a little outside.
        assert!(vertex.rest_m.abs().cmple(DVec3::splat(0.051)).all() && vertex.rest_m.z > -0.001, "{vertex:?}");
    }
    // 40 mm high, and 100 mm along y; the sides are rounded.
    let section_m2 = 0.04 * 0.1 / normal.x;
    let sides = [normal, -normal].map(|outward| {
        // Steps of the lattice along the cut have no area.
        let areas = surface.faces.iter().map(|face| (face, area_m2(&surface, face).dot(outward)));
        let areas: Vec<_> = areas.filter(|(_, area_m2)| *area_m2 > 1e-6 * section_m2).collect();
        let found_m2: f64 = areas.iter().map(|(_, area_m2)| area_m2).sum();
        assert!((found_m2 - section_m2).abs() < 0.06 * section_m2, "{found_m2} m², not {section_m2}");
        areas.into_iter().flat_map(|(face, _)| face.corners).collect::<BTreeSet<u32>>()
    });
    let sum_m2: f64 = surface.faces.iter().map(|face| area_m2(&surface, face).length()).sum();
    assert!(sum_m2 < 2.12 * section_m2, "folded: {sum_m2} m² for two sides of {section_m2}");
    // Both sides are apart everywhere.
    assert!(sides[0].is_disjoint(&sides[1]));
    assert!(surface.vertices.len() <= model.max_cut_vertices());
}

#[test]
fn where_a_cut_ends_both_sides_have_the_same_vertices() {
    let model = block();
    let mut tissue = at_rest(&model);
    // From one side to the middle, 15 mm deep.
    cut(&mut *tissue, DVec3::new(0.002, -0.056, 0.025), DVec3::new(0.002, 0.0, 0.025), 100);
    let surface = CutSurface::of(&model, &tissue.cuts());
    let pair = |face: &CutFace| (face.number / 2, face.corners);
    let mut faces: BTreeMap<u32, Vec<[u32; 4]>> = BTreeMap::new();
    surface.faces.iter().map(pair).for_each(|(face, corners)| faces.entry(face).or_default().push(corners));
    let mut shared = Vec::new();
    for sides in faces.values() {
        let [lower, higher] = sides[..] else { panic!("one side alone") };
        for (own, other) in lower.into_iter().zip(higher.into_iter().rev()) {
            let [a, b] = [own, other].map(|vertex| &surface.vertices[vertex as usize]);
            assert_eq!(a.rest_m, b.rest_m);
            if own == other {
                shared.push(a.rest_m);
            }
        }
    }
    // At the end along y, or at the bottom.
    assert!(!shared.is_empty());
    assert!(shared.iter().all(|at_m| at_m.y > -0.012 || at_m.z < 0.031), "{shared:?}");
    assert!(shared.iter().any(|at_m| at_m.y < -0.03), "the bottom is closed");
}

#[test]
fn a_client_that_follows_any_version_has_the_whole_surface() {
    let model = block();
    let mut tissue = at_rest(&model);
    let at = |x: f64, y: f64| DVec3::new(x, y, 0.022);
    let mut cuts = cut(&mut *tissue, at(-0.006, -0.055), at(0.011, 0.02), 100);
    // Across the first.
    cuts.extend(cut(&mut *tissue, at(-0.03, -0.013), at(0.03, -0.02), 60));
    let whole = CutSurface::of(&model, &tissue.cuts());
    assert!(cuts.len() > 10 && whole.faces.len() > 40);
    for known in &cuts {
        let surface = CutSurface::of(&model, known);
        let mut vertices: BTreeMap<u32, CutVertex> = (0..).zip(surface.vertices).collect();
        let mut faces: BTreeMap<u32, CutFace> = surface.faces.into_iter().map(|face| (face.number, face)).collect();
        for (number, vertex) in whole.vertices_since(known.version()) {
            assert!(number as usize <= vertices.len(), "a gap before vertex {number}");
            vertices.insert(number, *vertex);
        }
        faces.extend(whole.faces_since(known.version()).map(|face| (face.number, *face)));
        // With which cube a vertex moves is the server's business.
        let places = |vertices: &mut dyn Iterator<Item = &CutVertex>| vertices.map(|v| v.rest_m).collect::<Vec<_>>();
        assert_eq!(places(&mut vertices.values()), places(&mut whole.vertices.iter()), "{}", known.version());
        assert!(faces.values().eq(&whole.faces), "{}", known.version());
    }
}

/// Returns the displacements of the surface within the cuts of a tissue, m, as a frame has them.
fn framed_m(model: &Arc<Model>, skin: &Arc<Skin>, tissue: &dyn Tissue) -> Vec<DVec3> {
    let mut moved_m = std::array::from_fn(|_| Vec::new());
    tissue.shown_displacements_m(&mut moved_m);
    let snapshot = Snapshot::new(&model.scene, 1, 0.001, moved_m).with_skin(Some(skin)).with_cuts(tissue.cuts());
    let plain = Refinement::new(&model.scene, 0, &Limits::default()).unwrap();
    let grid = skin.with_cut_surface(plain);
    let all = |grid: Refinement| {
        let frame = encode(&snapshot, grid, Encoding::F32);
        frame.patches.iter().flat_map(|patch| decoded(&frame, patch)).map(DVec3::from).collect::<Vec<_>>()
    };
    let (with, without) = (all(grid), all(plain));
    assert_eq!(with[..without.len()], without[..]);
    assert_eq!(with.len(), without.len() + 16 * skin.cut_rows());
    with[skin.first_cut_place()..].to_vec()
}

#[test]
fn a_frame_has_each_side_of_a_cut_where_its_own_cells_are() {
    let model = block();
    let mut tissue = at_rest(&model);
    let skin = Skin::of(&model).unwrap();
    assert!(framed_m(&model, &skin, &*tissue).iter().all(|by_m| *by_m == DVec3::ZERO));
    // Through the block but for the lowest cells.
    let at = |y: f64| DVec3::new(0.003, y, 0.02);
    cut(&mut *tissue, at(-0.056), at(0.056), 150);
    let tip = Tip { radius_m: 0.012, shape: TipShape::Sphere, ..Tip::default() };
    for step in 0..400 {
        tissue.pose(1, DVec3::new(0.025, 0.0, 0.052 - 4e-5 * f64::from(step).min(200.0)), tip);
        tissue.step().unwrap();
    }
    let surface = skin.cut_surface(&tissue.cuts());
    let moved_m = framed_m(&model, &skin, &*tissue);
    let mut apart_m = 0.0_f64;
    for pair in surface.faces.chunks(2) {
        let [lower, higher] = pair else { panic!("one side alone") };
        for (own, other) in lower.corners.into_iter().zip(higher.corners.into_iter().rev()) {
            let gap_m = moved_m[other as usize] - moved_m[own as usize];
            apart_m = apart_m.max(gap_m.length());
        }
    }
    assert!(apart_m > 2e-4, "{apart_m} m");
    assert!(moved_m.iter().all(|by_m| by_m.length() < 0.02));
}
