//! Converts the mesh of a file to a surface of tissue: joins vertices at one position, turns closed parts outward,
//! and removes duplicates. Moves nothing and fills no hole: that is `repair`.

use glam::DVec3;

use crate::join::{Joined, Odd, join, places};
use crate::orient::orient;
use crate::report::{MeshReport, report_within};
use crate::topology::is_proper;
use crate::tree::Tree;
use crate::walls::{doubled, match_diagonals};
use crate::{Group, ReadLimits, TriangleMesh};

/// The result of [`prepare`]: a mesh to simulate, and that of the file.
#[derive(Debug, Clone, PartialEq)]
pub struct Prepared {
    /// The mesh to simulate. A vertex is in a group if one of the file's vertices that it represents is.
    pub mesh: TriangleMesh,
    /// The mesh of the file, if its vertices differ from those of `mesh`; otherwise `None`.
    pub file: Option<FileMesh>,
    /// Sentences on what was done, with counts, in the order of the work; empty if nothing was.
    pub notes: Vec<String>,
    /// For each vertex of `mesh`, the smallest vertex of the file that it represents.
    vertex_names: Vec<u32>,
    /// For each triangle of `mesh`, its number in the file.
    triangle_names: Vec<u32>,
}

/// The simulated triangles with the vertices of the file, which has several at one position along a seam of its
/// texture.
#[derive(Debug, Clone, PartialEq)]
pub struct FileMesh {
    /// The mesh, with the triangles of [`Prepared::mesh`] in the same order. A vertex of the file that several
    /// simulated ones represent has copies appended at the end.
    pub mesh: TriangleMesh,
    /// For each of its vertices, the simulated vertex that represents it; for one without a triangle, the nearest (or
    /// a near one, if the search takes too long).
    pub vertex_of: Vec<u32>,
}

impl Prepared {
    /// Reports on the mesh to simulate within the default limits ([`ReadLimits`]). Problems name vertices and
    /// triangles by their numbers in the file, from 0.
    #[must_use]
    pub fn report(&self) -> MeshReport {
        self.report_within(&ReadLimits::default())
    }

    /// Reports on the mesh to simulate. Problems name vertices and triangles by their numbers in the file, from 0; a
    /// vertex that preparing added has a number beyond. A mesh beyond `limits` is only counted.
    #[must_use]
    pub fn report_within(&self, limits: &ReadLimits) -> MeshReport {
        let mut report = report_within(&self.mesh, limits);
        let name = |names: &[u32], number: u32| names.get(number as usize).copied().unwrap_or(number);
        for finding in &mut report.problems {
            finding.rename(|vertex| name(&self.vertex_names, vertex), |triangle| name(&self.triangle_names, triangle));
        }
        report
    }
}

/// Adds a note on what was done `count` times, if that is not 0.
pub(crate) fn note(notes: &mut Vec<String>, count: usize, what: &str) {
    if count > 0 {
        notes.push(format!("{what}: {count}."));
    }
}

/// Maximum number of passes; faults left after that stay. Joining alone takes one pass; other passes have something
/// to turn, drop or split, which may lead to more.
const PASSES: usize = 8;

/// Prepares a mesh: joins vertices at one position along the edges of their triangles, leaves out doubled triangles,
/// walls inside of the tissue and unused vertices, splits vertices and halves triangles where surfaces touch, and
/// turns closed parts outward. Returns a mesh with indices out of range or positions that are not finite unchanged,
/// without notes: the report refuses it. Preparing a prepared mesh again does not change it.
#[must_use]
pub fn prepare(mut mesh: TriangleMesh) -> Prepared {
    let count = mesh.vertices_m.len();
    let is_valid = mesh.triangles.iter().flatten().all(|vertex| (*vertex as usize) < count)
        && mesh.vertices_m.iter().all(|at| at.is_finite());
    let mut prepared = Prepared {
        mesh: TriangleMesh::default(),
        file: None,
        notes: Vec::new(),
        vertex_names: (0..).take(count).collect(),
        triangle_names: (0..).take(mesh.triangles.len()).collect(),
    };
    if !is_valid {
        return Prepared { mesh, ..prepared };
    }
    let (mut joined, mut passes) = (prepared.pass(&mut mesh), 1);
    while joined.is_none() && passes < PASSES {
        (joined, passes) = (prepared.pass(&mut mesh), passes + 1);
    }
    let joined =
        joined.unwrap_or_else(|| join(&mesh.vertices_m, &mesh.triangles, &places(&mesh.vertices_m), Odd::Stay));
    let (vertex_of, least) = joined.numbered(&mesh);
    let (unused, now) = (vertex_of.iter().filter(|joined| joined.is_none()).count(), least.len());
    let before = mesh.vertices_m.len() - unused;
    let notes = &mut prepared.notes;
    if before > now {
        notes.push(format!(
            "Vertices at one position joined along the edges of their triangles: {before} became {now}."
        ));
    }
    note(notes, joined.left_over, "Edges that an odd number of triangles have, one of which is not joined there");
    note(notes, unused, "Vertices left out because no triangle has them");
    prepared.vertex_names = least.iter().map(|vertex| prepared.vertex_names[*vertex as usize]).collect();
    if mesh.triangles.is_empty() || (unused == 0 && before == now) {
        return Prepared { mesh, ..prepared };
    }
    prepared.mesh = simulated(&mesh, &vertex_of, &least);
    let vertex_of = stand_ins(&vertex_of, &mesh, &prepared.mesh);
    prepared.file = Some(FileMesh { mesh, vertex_of });
    prepared
}

impl Prepared {
    /// Drops, splits and turns what is necessary. Returns how the triangles are joined, if nothing had to change.
    fn pass(&mut self, mesh: &mut TriangleMesh) -> Option<Joined> {
        let places = places(&mesh.vertices_m);
        let changes = match_diagonals(mesh) + self.drop_doubled(mesh, &places);
        let joined = join(&mesh.vertices_m, &mesh.triangles, &places, Odd::Stay);
        let mut oriented = orient(&mesh.vertices_m, &mesh.triangles, &joined);
        // Notes on what could not be found out appear once.
        let notes: Vec<String> = oriented.notes().into_iter().filter(|note| !self.notes.contains(note)).collect();
        self.notes.extend(notes);
        let copies = joined.split_vertices(mesh);
        note(&mut self.notes, copies.len(), "Vertices split where surfaces touch");
        self.vertex_names.extend(copies);
        let halved = joined.halve(mesh);
        note(
            &mut self.notes,
            halved.len(),
            "Triangles halved where surfaces touch at an edge, both ends of which they share",
        );
        for triangle in halved.iter().map(|triangle| *triangle as usize) {
            self.triangle_names.push(self.triangle_names[triangle]);
            oriented.is_turned.push(oriented.is_turned[triangle]);
        }
        // A vertex in the middle of an edge has no name in the file; it gets a new number.
        self.vertex_names.extend((0..).take(mesh.vertices_m.len()).skip(self.vertex_names.len()));
        mesh.turn_triangles(&oriented.is_turned);
        let is_same = changes == 0 && mesh.vertices_m.len() == places.len() && !oriented.is_turned.contains(&true);
        is_same.then_some(joined)
    }

    /// Drops duplicate triangles and those that are lines; returns their number.
    fn drop_doubled(&mut self, mesh: &mut TriangleMesh, places: &[u32]) -> usize {
        let mut found = doubled(mesh, places);
        let mut lines = 0;
        for (triangle, keep) in mesh.triangles.iter().zip(&mut found.keep) {
            if !is_proper(&triangle.map(|vertex| places[vertex as usize])) {
                *keep = false;
                lines += 1;
            }
        }
        let notes = &mut self.notes;
        note(notes, lines, "Triangles left out because two of their corners are at one position");
        note(notes, found.copies, "Triangles left out because an earlier one has the same corners");
        note(notes, found.walls, "Triangles left out because they are walls inside of the tissue");
        mesh.keep_triangles(&found.keep);
        let mut keep = found.keep.iter();
        self.triangle_names.retain(|_| *keep.next().unwrap_or(&true));
        lines + found.copies + found.walls
    }
}

/// Builds the mesh of joined vertices.
fn simulated(file: &TriangleMesh, vertex_of: &[Option<u32>], least: &[u32]) -> TriangleMesh {
    let new = |vertex: u32| vertex_of[vertex as usize];
    let group = |group: &Group| {
        let mut vertices: Vec<u32> = group.vertices.iter().filter_map(|vertex| new(*vertex)).collect();
        vertices.sort_unstable();
        vertices.dedup();
        Group { name: group.name.clone(), vertices }
    };
    TriangleMesh {
        vertices_m: least.iter().map(|vertex| file.vertices_m[*vertex as usize]).collect(),
        triangles: file.triangles.iter().map(|triangle| triangle.map(|vertex| new(vertex).unwrap_or(0))).collect(),
        uv: file.uv.clone(),
        groups: file.groups.iter().map(group).collect(),
        regions: file.regions.clone(),
    }
}

/// Maximum number of boxes that are visited to find the nearest points for the vertices that no triangle uses: a
/// fixed number, and a number for each triangle and vertex. A search typically takes some tens.
const LOOKS: [u64; 2] = [1_000_000, 60];

/// Returns the simulated vertex of each; for one without a triangle, the nearest, or a near one ([`LOOKS`]).
fn stand_ins(vertex_of: &[Option<u32>], file: &TriangleMesh, simulated: &TriangleMesh) -> Vec<u32> {
    let of = (&simulated.vertices_m[..], &simulated.triangles[..]);
    let mut tree = None;
    let mut looks = LOOKS[0] + LOOKS[1] * (of.1.len() + vertex_of.len()) as u64;
    let mut nearest = |at: DVec3| {
        let tree = tree.get_or_insert_with(|| Tree::new(of.0, of.1, (0..).take(of.1.len())));
        let triangle =
            tree.nearest_within(of, at, &mut looks).map(|found| of.1[found.triangle as usize]).unwrap_or_default();
        let away = |vertex: &u32| of.0[*vertex as usize].distance_squared(at);
        triangle.into_iter().min_by(|a, b| away(a).total_cmp(&away(b))).unwrap_or(0)
    };
    vertex_of.iter().zip(&file.vertices_m).map(|(joined, at)| joined.unwrap_or_else(|| nearest(*at))).collect()
}
