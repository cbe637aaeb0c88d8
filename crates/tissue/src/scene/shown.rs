//! Prepares the mesh of a file for simulation, and binds the mesh that is shown to it.
//!
//! The shown mesh has the vertices of the file. The simulated mesh differs from it if it is coarser, or if
//! vertices of the file were joined: then each shown vertex moves with a place on the simulated mesh.

use glam::DVec3;
use palpate_geometry::decimate::{MeshPlace, decimate};
use palpate_geometry::delaunay::flip_to_delaunay;
use palpate_geometry::report::Finding;
use palpate_geometry::surface::nearest_place;
use palpate_geometry::work::spend;
use palpate_geometry::{FileMesh, MeshReport, TriangleMesh, prepare};

use crate::shape::BoundPlace;
use palpate_refusal::{Reason, Refusal, Result};

/// The mesh of the file, and how its vertices follow the simulated mesh. It exists if the simulated mesh has
/// other vertices.
#[derive(Debug, PartialEq)]
pub struct Shown {
    /// The mesh of the file, m, with its own vertex numbers. If one vertex stands for several simulated ones,
    /// copies of it are at the end.
    pub mesh: TriangleMesh,
    /// For each of its vertices, in their order, the place on the simulated mesh that it follows.
    pub places: Vec<BoundPlace>,
    /// For each of its vertices, the nearest simulated vertex.
    pub(super) nearest: Vec<u32>,
    /// For each simulated vertex, a vertex of the file: the closest of those whose nearest simulated vertex it
    /// is, and of several equally close ones the first. If there are none, the closest of all that are bound to
    /// one of its triangles.
    pub(super) names: Vec<u32>,
}

/// The mesh of a scene as it is simulated, and the mesh that is shown; for
/// [`Mesh::simulating`](super::Mesh::simulating).
#[derive(Debug, PartialEq)]
pub struct Simulated {
    /// The simulated mesh, m. Its edges are Delaunay if they were flipped.
    pub mesh: TriangleMesh,
    /// The mesh of the file, if it has other vertices than the simulated one; otherwise `None`.
    pub shown: Option<Shown>,
    /// What was done with the mesh of the file, and doubts about it, as sentences for the user; empty for a
    /// generated mesh.
    pub findings: Vec<String>,
}

impl Simulated {
    /// Prepares the mesh of a file, m: joins vertices with the same position and turns closed parts outward.
    /// Then it reduces the mesh to at most `vertices`, if possible (`None` or more than it has: not at all),
    /// and flips edges to Delaunay if `flips`. This may take seconds for a large mesh.
    ///
    /// # Errors
    /// Refuses a mesh that is not a surface ([`Reason::Unreadable`], field `mesh`); the message names the
    /// element and place.
    pub fn of(mesh: TriangleMesh, vertices: Option<usize>, flips: bool) -> Result<Self> {
        let prepared = prepare(mesh);
        let report = prepared.report();
        if let Some(finding) = report.refusal() {
            return Err(Refusal::new(Reason::Unreadable, "mesh", to_repair(finding)));
        }
        let findings = findings_of(&prepared.notes, &report);
        Ok(Self { findings, ..Self::bound(prepared.mesh, prepared.file, vertices, flips) })
    }

    /// Prepares a generated mesh, m, which needs no repair: reduces it to at most `vertices`, if possible
    /// (`None` or more than it has: not at all), and flips edges to Delaunay if `flips`. Then it has a shown
    /// mesh if it was reduced.
    pub fn made(mesh: TriangleMesh, vertices: Option<usize>, flips: bool) -> Self {
        Self::bound(mesh, None, vertices, flips)
    }

    fn bound(mut mesh: TriangleMesh, file: Option<FileMesh>, vertices: Option<usize>, flips: bool) -> Self {
        let shown = match vertices.filter(|vertices| *vertices < mesh.vertices_m.len()) {
            Some(vertices) => {
                let shown;
                (mesh, shown) = coarser(mesh, file, vertices, flips);
                Some(shown)
            }
            None => {
                if flips {
                    flip_to_delaunay(&mut mesh);
                }
                file.map(|file| Shown::joined(file, &mesh))
            }
        };
        Self { mesh, shown, findings: Vec::new() }
    }
}

/// Returns a mesh of at most `vertices`, if possible, with Delaunay edges if `flips`; and the mesh that is
/// shown in its place.
fn coarser(mesh: TriangleMesh, file: Option<FileMesh>, vertices: usize, flips: bool) -> (TriangleMesh, Shown) {
    let decimated = decimate(&mesh, vertices);
    let (mut coarse, before) = (decimated.mesh.clone(), decimated.mesh.triangles);
    if flips {
        flip_to_delaunay(&mut coarse);
    }
    let vertices_m = mesh.vertices_m.clone();
    let file = file.unwrap_or_else(|| FileMesh { vertex_of: (0..).take(vertices_m.len()).collect(), mesh });
    let shown = Shown::decimated(file, &vertices_m, &coarse, &before, &decimated.places);
    (coarse, shown)
}

/// Returns the message of a refusal of a mesh: what is wrong, and what may mend it.
pub(super) fn to_repair(finding: &Finding) -> String {
    format!("{finding}; `palpate mesh FILE --repair` may mend it")
}

/// Returns what was done with a mesh and the first problem of each kind, as sentences for the user.
pub(super) fn findings_of(notes: &[String], report: &MeshReport) -> Vec<String> {
    let mut findings: Vec<String> = notes.iter().map(|note| format!("mesh: {note}")).collect();
    for (kind, count) in &report.counts {
        let of_kind = report.problems.iter().find(|finding| finding.problem.name() == *kind);
        let more = if *count > 1 { format!(" ({count} of this kind: `palpate mesh FILE`)") } else { String::new() };
        findings.extend(of_kind.map(|first| format!("mesh: {first}{more}")));
    }
    findings
}

impl Shown {
    /// Binds a mesh to the simulated one, each of whose vertices stands for one or more of its own.
    #[allow(clippy::cast_possible_truncation)]
    fn joined(FileMesh { mesh, vertex_of }: FileMesh, simulated: &TriangleMesh) -> Self {
        let mut corners = vec![(0, 0); simulated.vertices_m.len()];
        for (triangle, number) in simulated.triangles.iter().zip(0_u32..) {
            triangle.iter().zip(0..).for_each(|(vertex, corner)| corners[*vertex as usize] = (number, corner));
        }
        let bind = |vertex: &u32| {
            let (triangle, corner) = corners[*vertex as usize];
            let mut barycentric = [0.0; 3];
            barycentric[corner] = 1.0;
            BoundPlace { triangle, barycentric, height_m: 0.0 }
        };
        let places = vertex_of.iter().map(bind).collect();
        let mut names = vec![0; simulated.vertices_m.len()];
        // In reverse, so that the lowest number is written last.
        for (number, (vertex, place_m)) in vertex_of.iter().zip(&mesh.vertices_m).enumerate().rev() {
            if simulated.vertices_m[*vertex as usize] == *place_m {
                names[*vertex as usize] = number as u32;
            }
        }
        Shown { mesh, places, nearest: vertex_of, names }
    }

    /// Binds a mesh to a coarser one. `places` are on the coarser mesh's triangles `before` edges were flipped;
    /// `vertices_m` are the vertices that were decimated.
    #[allow(clippy::cast_possible_truncation)]
    fn decimated(
        FileMesh { mesh, vertex_of }: FileMesh,
        vertices_m: &[DVec3],
        coarse: &TriangleMesh,
        before: &[[u32; 3]],
        places: &[MeshPlace],
    ) -> Self {
        let mut around: Vec<Vec<u32>> = vec![Vec::new(); coarse.vertices_m.len()];
        for (number, triangle) in (0..).zip(&coarse.triangles) {
            triangle.iter().for_each(|vertex| around[*vertex as usize].push(number));
        }
        let at = |vertex: u32| coarse.vertices_m[vertex as usize];
        let bind = |(place_m, place): (&DVec3, &MeshPlace)| {
            let old = before[place.triangle as usize];
            let own = [old, coarse.triangles[place.triangle as usize]];
            let mut candidates: Vec<u32> = vec![place.triangle];
            if own[0] != own[1] {
                candidates = old.iter().flat_map(|vertex| &around[*vertex as usize]).copied().collect();
                spend(16 * candidates.len());
                candidates.sort_unstable();
                candidates.dedup();
            }
            let on = |triangle: u32| {
                let [a, b, c] = coarse.triangles[triangle as usize].map(at);
                let barycentric = if own[0] == own[1] { place.barycentric } else { nearest_place(*place_m, [a, b, c]) };
                let [u, v, w] = barycentric;
                (place_m.distance_squared(u * a + v * b + w * c), triangle, barycentric)
            };
            let best = candidates.into_iter().map(on).min_by(|a, b| a.0.total_cmp(&b.0));
            let (_, triangle, barycentric) = best.unwrap_or((0.0, place.triangle, place.barycentric));
            let [a, b, c] = coarse.triangles[triangle as usize].map(at);
            let normal = (b - a).cross(c - a).normalize_or_zero();
            BoundPlace { triangle, barycentric, height_m: normal.dot(*place_m - a) }
        };
        let bound: Vec<BoundPlace> = vertices_m.iter().zip(places).map(bind).collect();
        let places: Vec<BoundPlace> =
            vertex_of.iter().filter_map(|vertex| bound.get(*vertex as usize).copied()).collect();
        let mut nearest = Vec::with_capacity(places.len());
        let mut closest = vec![[(f64::INFINITY, 0_u32); 2]; coarse.vertices_m.len()];
        for ((vertex, place), number) in vertex_of.iter().zip(&places).zip(0_u32..) {
            let place_m = vertices_m[*vertex as usize];
            let corners = coarse.triangles[place.triangle as usize];
            let away = |vertex: u32| at(vertex).distance_squared(place_m);
            let mut best = corners[0];
            for corner in corners {
                if away(corner) < away(best) {
                    best = corner;
                }
                let any = &mut closest[corner as usize][1];
                if away(corner) < any.0 {
                    *any = (away(corner), number);
                }
            }
            let own = &mut closest[best as usize][0];
            if away(best) < own.0 {
                *own = (away(best), number);
            }
            nearest.push(best);
        }
        let names = closest.iter().map(|[own, any]| if own.0.is_finite() { own.1 } else { any.1 }).collect();
        Shown { mesh, places, nearest, names }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use palpate_geometry::organ::{Organ, generate};

    use super::*;

    #[test]
    fn a_place_on_the_coarser_mesh_and_its_height_give_the_vertex_back() {
        let mesh = generate(Organ::Gallbladder, 0.0035, 2).unwrap();
        let count = mesh.vertices_m.len();
        for flips in [false, true] {
            let (coarse, shown) = coarser(mesh.clone(), None, count / 3, flips);
            assert!(coarse.vertices_m.len() <= count / 3 + 1 && shown.places.len() == count);
            let mut off_m: Vec<f64> = Vec::new();
            for (place_m, place) in shown.mesh.vertices_m.iter().zip(&shown.places) {
                let [a, b, c] = coarse.triangles[place.triangle as usize].map(|v| coarse.vertices_m[v as usize]);
                let [u, v, w] = place.barycentric;
                assert!(u + v + w > 1.0 - 1e-9 && u.min(v).min(w) >= -1e-9, "{place:?}");
                let normal = (b - a).cross(c - a).normalize();
                off_m.push(place_m.distance(u * a + v * b + w * c + place.height_m * normal));
            }
            off_m.sort_by(f64::total_cmp);
            // Beside an edge or a corner a place is not straight over its triangle.
            assert!(off_m[count / 2] < 1e-6 && off_m[count - 1] < 1e-3, "{} {}", off_m[count / 2], off_m[count - 1]);
            for (vertex, name) in shown.names.iter().enumerate() {
                assert!(coarse.vertices_m[vertex].distance(shown.mesh.vertices_m[*name as usize]) < 0.006, "{vertex}");
            }
        }
    }
}
