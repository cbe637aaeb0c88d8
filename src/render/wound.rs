//! The wound of a drawn surface: its split triangles, both lips as dark lines, and dark tissue beneath them.

use glam::{DVec2, DVec3};

use super::drawn_surface::{DrawnSurface, DrawnWound, Vertex};
use palpate_session::surface::Wound;
use palpate_session::surface::wound::LipVertex;
use palpate_tissue::CutSurface;

/// How far beneath the surface the dark tissue is drawn, as a fraction of the distance of neighbouring points.
const DEPTH: f64 = 0.5;

/// The dark tissue is not drawn where it would be stretched to this many distances of points: there the pieces are apart.
const MAX_STRETCH: f64 = 4.0;

/// Opens a wound in a whole surface. `rest_m` returns the rest position of a vertex, m, and neighbouring points are `edge_m` apart.
pub(super) fn open_wound(surface: &mut DrawnSurface, wound: &Wound, rest_m: impl Fn(usize) -> DVec3, edge_m: f64) {
    let sunk_m = |corner: usize| surface.vertices[corner].at_m - DEPTH * edge_m * surface.vertices[corner].normal;
    let hidden = |cut: &palpate_session::surface::wound::CutTriangles| {
        cut.first as usize..cut.first as usize + cut.count as usize
    };
    let covered = wound.triangles.iter().flat_map(hidden).filter_map(|number| surface.triangles.get(number));
    let is_whole = |[a, b, c]: &[DVec3; 3]| {
        [a.distance(*b), b.distance(*c), c.distance(*a)].into_iter().all(|side_m| side_m < MAX_STRETCH * edge_m)
    };
    let bed_m = covered.map(|corners| corners.map(sunk_m)).filter(is_whole).collect();
    for lip in &wound.vertices {
        let vertex = lip_vertex(lip, &surface.vertices, &rest_m);
        surface.vertices.push(vertex);
    }
    #[allow(clippy::cast_possible_truncation)]
    let whole = surface.triangles.iter().map(|corners| corners.map(|corner| corner as u32));
    surface.triangles = wound.shown_triangles(whole).iter().map(|corners| corners.map(|at| at as usize)).collect();
    let lips = wound.lips().map(|side| side.map(|vertex| vertex as usize)).collect();
    if !wound.triangles.is_empty() {
        draw_lines(surface, wound);
    }
    surface.wound = DrawnWound { bed_m, lips, cut_surface: Vec::new() };
}

/// Shows the surface within the cuts of a solid in place of the tissue beneath the lips. `moved_m` has the displacements of its vertices, m;
/// `share` returns a rest position as a part of the longest side.
pub(super) fn show_cut_surface(
    surface: &mut DrawnSurface,
    cut_surface: &CutSurface,
    moved_m: &[DVec3],
    share: impl Fn(DVec3) -> DVec3,
) {
    let at = |corner: u32| {
        let rest_m = cut_surface.vertices[corner as usize].rest_m;
        (rest_m, rest_m + moved_m.get(corner as usize).copied().unwrap_or_default())
    };
    let triangles = cut_surface.faces.iter().flat_map(|face| {
        let [a, b, c, d] = face.corners.map(at);
        [[a, b, c], [a, c, d]]
    });
    let normal = |[a, b, c]: [DVec3; 3]| (b - a).cross(c - a).normalize_or(DVec3::Z);
    let drawn = triangles.map(|corners| {
        let (facing, now) = (normal(corners.map(|(rest_m, _)| rest_m)), normal(corners.map(|(_, at_m)| at_m)));
        corners.map(|(rest_m, at_m)| Vertex {
            at_m,
            normal: now,
            share: DVec2::ZERO,
            rest: share(rest_m),
            facing: facing.abs(),
            open: 1.0,
            burn: 0.0,
        })
    });
    surface.wound.cut_surface = drawn.collect();
    surface.wound.bed_m.clear();
}

/// Returns a vertex of a lip. It is as far from its host as at rest, and looks like that place of the surface.
fn lip_vertex(lip: &LipVertex, vertices: &[Vertex], rest_m: impl Fn(usize) -> DVec3) -> Vertex {
    let corners = [lip.host, lip.others[0], lip.others[1]].map(|vertex| vertex as usize);
    let host = vertices[corners[0]];
    let mut vertex = Vertex { share: Default::default(), rest: DVec3::ZERO, facing: DVec3::ZERO, burn: 0.0, ..host };
    vertex.at_m -= rest_m(corners[0]);
    for (corner, share) in corners.into_iter().zip(lip.shares()) {
        let Vertex { share: texture, rest, facing, burn, .. } = vertices[corner];
        vertex.at_m += share * rest_m(corner);
        vertex.share += share * texture;
        vertex.rest += share * rest;
        vertex.facing += share * facing;
        vertex.burn += share * burn;
    }
    vertex
}

/// Takes away the lines of the mesh that the wound severs, and draws them up to its lips.
fn draw_lines(surface: &mut DrawnSurface, wound: &Wound) {
    let sides = surface.triangles.iter().flat_map(|[a, b, c]| [[*a, *b], [*b, *c], [*c, *a]]);
    let mut shown: Vec<[usize; 2]> = sides.map(|[a, b]| [a.min(b), a.max(b)]).collect();
    shown.sort_unstable();
    surface.lines.retain(|[a, b]| shown.binary_search(&[*a.min(b), *a.max(b)]).is_ok());
    let first = wound.first_vertex as usize;
    let along_springs = wound.vertices.iter().enumerate().filter(|(_, lip)| lip.others[0] == lip.others[1]);
    surface.lines.extend(along_springs.map(|(index, lip)| [lip.host as usize, first + index]));
}
