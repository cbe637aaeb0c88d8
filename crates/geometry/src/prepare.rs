//! From the mesh of a file to a surface of tissue: what has the same position is joined, closed parts face outward, what is there
//! twice is there once. Nothing is moved, and no hole is filled: that is `repair`.

use glam::DVec3;

use crate::join::{Joined, Odd, join, places};
use crate::orient::orient;
use crate::report::{MeshReport, report_within};
use crate::topology::is_proper;
use crate::tree::Tree;
use crate::walls::{doubled, match_diagonals};
use crate::{Group, ReadLimits, TriangleMesh};

/// A mesh to simulate, and that of the file.
#[derive(Debug, Clone, PartialEq)]
pub struct Prepared {
    /// The mesh to simulate. A vertex is in a group if one of those that it stands for is.
    pub mesh: TriangleMesh,
    /// The mesh of the file, if it has other vertices.
    pub file: Option<FileMesh>,
    /// What was done, with counts; empty if nothing was.
    pub notes: Vec<String>,
    /// For each vertex of `mesh`, the least of those of the file that it stands for.
    vertex_names: Vec<u32>,
    /// For each triangle of `mesh`, its number in the file.
    triangle_names: Vec<u32>,
}

/// The triangles that are simulated, between the vertices of the file: at a seam of its texture it has several at one position.
#[derive(Debug, Clone, PartialEq)]
pub struct FileMesh {
    /// The mesh. A vertex of the file that several simulated ones stand for has copies behind the last.
    pub mesh: TriangleMesh,
    /// For each of its vertices, the simulated one that stands for it; for one in no triangle, the nearest.
    pub vertex_of: Vec<u32>,
}

impl Prepared {
    /// Reports the mesh to simulate, with the numbers that vertices and triangles have in the file.
    #[must_use]
    pub fn report(&self) -> MeshReport {
        self.report_within(&ReadLimits::default())
    }

    /// Returns the same within other limits.
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

/// Notes what was done so many times, if it was.
pub(crate) fn note(notes: &mut Vec<String>, count: usize, what: &str) {
    if count > 0 {
        notes.push(format!("{what}: {count}."));
    }
}

/// What is not settled after so many passes stays so. One is enough for what only has to be joined; of the others each has
/// something to turn, to drop or to split, and what that changes may lead to more.
const PASSES: usize = 8;

/// Prepares a mesh. One with indices out of range or positions that are not finite stays as it is: the report refuses it. What
/// has been prepared does not change when it is prepared again.
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
    /// Drops, splits and turns what must be; returns how the triangles are joined, if nothing had to be.
    fn pass(&mut self, mesh: &mut TriangleMesh) -> Option<Joined> {
        let places = places(&mesh.vertices_m);
        let changes = match_diagonals(mesh) + self.drop_doubled(mesh, &places);
        let joined = join(&mesh.vertices_m, &mesh.triangles, &places, Odd::Stay);
        let mut oriented = orient(&mesh.vertices_m, &mesh.triangles, &joined);
        // What could not be found is told once.
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
        // A vertex in the middle of an edge has no name of the file but its own.
        self.vertex_names.extend((0..).take(mesh.vertices_m.len()).skip(self.vertex_names.len()));
        mesh.turn_triangles(&oriented.is_turned);
        let is_same = changes == 0 && mesh.vertices_m.len() == places.len() && !oriented.is_turned.contains(&true);
        is_same.then_some(joined)
    }

    /// Drops the triangles that are there more than once, and those that are lines; returns how many.
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

/// The mesh of joined vertices.
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
    }
}

/// Boxes that are looked at to find what is nearest to the vertices that no triangle has: so many, and so many for each triangle and
/// vertex. Usually one takes some tens.
const LOOKS: [u64; 2] = [1_000_000, 60];

/// The simulated vertex of each; for one that no triangle has, the nearest, or one that is near ([`LOOKS`]).
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
