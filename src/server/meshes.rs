//! Meshes that clients upload: receiving, checking, repairing and keeping them.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use palpate_geometry::prepare::prepare;
use palpate_geometry::repair::{Repair, repair};
use palpate_geometry::report::{Border, Finding};
use palpate_geometry::{Element, MeshError, Problem, ReadLimits, TriangleMesh, Unit, VolumeRegion};
use palpate_proto::geometry::vector;
use palpate_proto::{pb, scene};

use super::uploads::{FilePart, Received, UploadKind, Uploads};
use palpate_refusal::{Reason, Refusal, Result, excerpt};
use palpate_session::budget::{Account, Purpose};
use palpate_session::wire;
use palpate_tissue::limits::Limits;
use palpate_tissue::memory;
use palpate_tissue::select::scheme_selection::given_up;
use palpate_tissue::shape::Extent;

/// Triangles per vertex that a mesh may have: a closed surface has two.
const TRIANGLES_PER_VERTEX: usize = 4;

/// Memory for repairing, preparing and reporting a mesh, bytes per vertex and triangle.
const PREPARING: u64 = 500;

/// Most group names that a report contains.
const GROUPS_TOLD: usize = 1000;

/// The uploaded meshes of all clients.
#[derive(Clone)]
pub(crate) struct Meshes {
    uploads: Uploads<TriangleMesh>,
    vertices: usize,
}

/// How a file is read: the unit of its lengths, unless that of a label map counts, and the label.
#[derive(Debug, Clone, Copy)]
pub(super) struct ReadAs {
    unit: Option<Unit>,
    label: Option<i64>,
}

/// Parses how the file of a request is read.
///
/// # Errors
/// Refuses a unit that is none, and its absence without a label.
pub(super) fn read_as(request: &pb::UploadMeshRequest) -> Result<ReadAs> {
    let label = request.label.map(i64::from);
    let is_own = label.is_some() && request.unit.is_empty();
    Ok(ReadAs { unit: if is_own { None } else { Some(unit(&request.unit)?) }, label })
}

/// Parses the unit of length in a request.
///
/// # Errors
/// Refuses an empty text and one that is not a unit.
fn unit(text: &str) -> Result<Unit> {
    if text.is_empty() {
        let message = "is missing: mesh files do not state theirs; \"m\", \"cm\", \"mm\" or so many metres";
        return Err(Refusal::new(Reason::Missing, "unit", message));
    }
    text.parse().map_err(|_| {
        let message = format!("must be \"m\", \"cm\", \"mm\" or so many metres, but is `{}`", excerpt(text));
        Refusal::new(Reason::WrongKind, "unit", message)
    })
}

impl Meshes {
    /// Creates the store, without meshes.
    pub(super) fn new(limits: &Limits) -> Self {
        let uploads = Uploads::new(UploadKind {
            names: ["mesh", "meshes"],
            id: "mesh_id",
            unknown: Reason::UnknownMesh,
            purpose: Purpose::Meshes,
            most_bytes: (limits.mesh_bytes, "limits.mesh_bytes"),
            most_each: (limits.meshes_per_caller, "limits.meshes_per_caller"),
            kept_s: limits.mesh_s,
        });
        Meshes { uploads, vertices: limits.mesh_vertices.min(limits.points) }
    }

    /// Adds a part of a file, as [`Uploads::add`] does.
    ///
    /// # Errors
    /// Returns the errors of [`Uploads::add`].
    pub(super) fn add(&self, request: &pb::UploadMeshRequest, account: &Account) -> Result<pb::UploadMeshResponse> {
        let pb::UploadMeshRequest { mesh_id, offset, part, last, .. } = request;
        let part = FilePart { id: mesh_id, offset: *offset, bytes: part, last: *last };
        let (mesh_id, received_bytes) = self.uploads.add(&part, account)?;
        Ok(pb::UploadMeshResponse { mesh_id, received_bytes, ..Default::default() })
    }

    /// Takes a completely received file out of the uploads, to read it. Dropping the result deletes the file.
    /// Refusals refer to it as `file_name`.
    ///
    /// # Errors
    /// Refuses a mesh that this caller is not uploading.
    pub(super) fn read(&self, id: &str, file_name: &str, account: &Account) -> Result<UploadReading> {
        Ok(UploadReading {
            received: self.uploads.take(id, account)?,
            name: name_of(file_name, "the mesh"),
            limits: self.limits(),
        })
    }

    /// Returns a mesh that this caller has uploaded.
    ///
    /// # Errors
    /// Refuses a mesh that this caller has not uploaded, not uploaded in full, or that has expired.
    pub(super) fn get(&self, id: &str, account: &Account) -> Result<Arc<TriangleMesh>> {
        if id.is_empty() {
            let message = "is missing: a client sends its mesh with UploadMesh, which tells its mesh_id";
            return Err(Refusal::new(Reason::Missing, scene::MESH_ID, message));
        }
        self.uploads.get(id, account).map_err(|refusal| refusal.within(scene::MESH))
    }

    /// Removes the meshes whose last part arrived too long ago.
    pub(super) fn forget_expired(&self, now_ns: u64) {
        self.uploads.forget_expired(now_ns);
    }

    fn limits(&self) -> ReadLimits {
        ReadLimits {
            bytes: usize::try_from(self.uploads.kind().most_bytes.0).unwrap_or(usize::MAX),
            vertices: self.vertices,
            triangles: self.vertices.saturating_mul(TRIANGLES_PER_VERTEX),
        }
    }
}

/// Returns the name of a file in refusals: without folders, and of a long name the last 64 characters, which contain
/// the format. `nameless` is that of a file without one.
pub(super) fn name_of(file_name: &str, nameless: &str) -> String {
    let name = file_name.rsplit(['/', '\\']).next().unwrap_or_default();
    let skipped = name.chars().count().saturating_sub(64);
    let end: String = name.chars().skip(skipped).collect();
    if end.is_empty() { nameless.to_owned() } else { end }
}

/// A received mesh file that is being read.
pub(super) struct UploadReading {
    received: Received<TriangleMesh>,
    name: String,
    limits: ReadLimits,
}

impl UploadReading {
    /// Reads the file, repairs the mesh if `mends`, and returns a report. Keeps the mesh for use by sessions unless
    /// the report refuses it for solids too.
    ///
    /// # Errors
    /// Refuses a file that can't be read (with element and place), too little memory, and when `stop` is set.
    pub(super) fn finish(mut self, how: ReadAs, mends: bool, stop: &AtomicBool) -> Result<pb::MeshReport> {
        memory::attempt("part", || self.finished(how, mends, stop))
    }

    fn finished(&mut self, ReadAs { unit, label }: ReadAs, mends: bool, stop: &AtomicBool) -> Result<pb::MeshReport> {
        let go_on = || if stop.load(Ordering::Relaxed) { Err(given_up()) } else { Ok(()) };
        let limits = &self.limits;
        let bytes = std::mem::take(&mut self.received.bytes);
        // The file stays in memory while it is read, in a vector whose capacity may be twice its length.
        let kept = 2 * bytes.len() as u64;
        let mut paid = Ok(());
        let mut pay = |reading: u64| {
            paid = self.received.charge(kept.saturating_add(reading));
            paid.is_ok()
        };
        let read = palpate_geometry::read_paid(&self.name, &bytes, label, unit, &|_| None, limits, &mut pay);
        paid?;
        let read = read.map_err(refuse)?;
        drop(bytes);
        let elements = (read.mesh.vertices_m.len() + read.mesh.triangles.len()) as u64;
        self.received.charge(bytes_of(&read.mesh) * 2 + PREPARING * elements)?;
        go_on()?;
        let (mut mesh, mut problems) = (read.mesh, read.notes.into_iter().map(note).collect::<Vec<_>>());
        if mends {
            let repaired = repair(&mesh, &Repair::default());
            mesh = repaired.mesh;
            problems.extend(repaired.told.into_iter().map(note));
            problems.extend(repaired.faults.into_iter().map(|fault| note(format!("Not as asked for: {fault}."))));
            go_on()?;
        }
        // Prepares the mesh as a session does, for the notes of that.
        let prepared = prepare(mesh.clone());
        let found = prepared.report_within(limits);
        problems.extend(prepared.notes.into_iter().map(note));
        go_on()?;
        let refused = found.refusal().is_some();
        // Refusals come first. The rim of an open surface is not a hole.
        let holes = found.borders.iter().filter(|border| !border.is_rim).map(hole);
        let problems = found.problems.iter().map(problem).chain(holes).chain(problems).collect();
        let count = |count: usize| u32::try_from(count).unwrap_or(u32::MAX);
        let places_m = &mesh.vertices_m;
        let used = mesh.triangles.iter().flatten().filter_map(|vertex| places_m.get(*vertex as usize));
        let extent = Extent::around(used.copied());
        let report = pb::MeshReport {
            vertices: count(found.vertices),
            triangles: count(found.triangles),
            components: count(found.components),
            holes: count(found.holes),
            volume_m3: found.volume_m3,
            extent: extent.least_m.is_finite().then(|| wire::extent(&extent)),
            edge_m: found.edge_m.median,
            problems,
            groups: mesh.groups.iter().map(|group| group.name.clone()).take(GROUPS_TOLD).collect(),
            refused,
            solid_only: refused && found.refusal_of_solid().is_none(),
        };
        if !refused || report.solid_only {
            let bytes = bytes_of(&mesh);
            self.received.finish(mesh, bytes)?;
        }
        Ok(report)
    }
}

/// Returns the memory that a mesh takes, bytes.
fn bytes_of(mesh: &TriangleMesh) -> u64 {
    let groups: usize = mesh.groups.iter().map(|group| group.name.len() + size_of_val(group.vertices.as_slice())).sum();
    let uv = mesh.uv.as_deref().map_or(0, size_of_val);
    let of_region = |region: &VolumeRegion| {
        region.name.len() + size_of_val(region.vertices_m.as_slice()) + size_of_val(region.triangles.as_slice())
    };
    let regions: usize = mesh.regions.iter().map(of_region).sum();
    (size_of_val(mesh.vertices_m.as_slice()) + size_of_val(mesh.triangles.as_slice()) + uv + groups + regions) as u64
}

/// Returns an entry of the report that says what was done with a mesh.
fn note(what: String) -> pb::MeshProblem {
    pb::MeshProblem { what, ..Default::default() }
}

fn problem(finding: &Finding) -> pb::MeshProblem {
    pb::MeshProblem {
        what: finding.problem.to_string(),
        element: if finding.element == Element::Whole { String::new() } else { finding.element.to_string() },
        place_m: finding.place_m.and_then(|place_m| vector(place_m.into())),
    }
}

fn hole(border: &Border) -> pb::MeshProblem {
    let what = format!("hole of {} edges", border.edges);
    pb::MeshProblem { what, element: String::new(), place_m: vector(border.place_m.into()) }
}

/// Returns the refusal of a file that can't be read. The message contains element and place.
fn refuse(error: MeshError) -> Refusal {
    let (reason, field) = match error.problem {
        Problem::LabelMissing { .. } => (Reason::Missing, "label"),
        Problem::LabelUnknown { .. } => (Reason::OutOfRange, "label"),
        _ => (Reason::Unreadable, "part"),
    };
    Refusal::new(reason, field, error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use palpate_realtime::clock::now_ns;
    use palpate_session::budget::{Budget, Resource};

    const TETRAHEDRON: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n";

    fn part(mesh_id: &str, offset: usize, part: &[u8]) -> pb::UploadMeshRequest {
        let (mesh_id, part, file_name) = (mesh_id.to_owned(), part.to_vec(), "organ.obj".to_owned());
        pb::UploadMeshRequest { mesh_id, offset: offset as u64, part, file_name, ..Default::default() }
    }

    fn meshes(limits: &Limits) -> (Meshes, [Account; 2]) {
        let budget = Budget::new(limits, 1, 1);
        (Meshes::new(limits), ["one", "other"].map(|name| budget.account(name)))
    }

    fn sent(meshes: &Meshes, account: &Account) -> String {
        let id = meshes.add(&part("", 0, TETRAHEDRON.as_bytes()), account).unwrap().mesh_id;
        let reading = meshes.read(&id, "organ.obj", account).unwrap();
        let report =
            reading.finish(ReadAs { unit: unit("mm").ok(), label: None }, false, &AtomicBool::new(false)).unwrap();
        assert!(!report.refused && report.vertices == 4 && report.volume_m3.is_some(), "{report:?}");
        id
    }

    #[test]
    fn a_mesh_is_its_callers_alone_and_its_memory_is_counted() {
        let (meshes, [one, other]) = meshes(&Limits::default());
        let taken = || one.has(Resource::Memory(Purpose::Meshes));
        let id = sent(&meshes, &one);
        assert_eq!(meshes.get(&id, &one).unwrap().vertices_m.len(), 4);
        assert_eq!(taken(), 4 * 24 + 4 * 12);
        let refused = meshes.get(&id, &other).unwrap_err();
        assert_eq!((refused.reason, refused.field.as_str()), (Reason::UnknownMesh, "scene.mesh.mesh_id"));
        assert_eq!(meshes.add(&part(&id, 0, b"v"), &other).unwrap_err().reason, Reason::UnknownMesh);
        assert_eq!(meshes.add(&part(&id, TETRAHEDRON.len(), b"v"), &one).unwrap_err().reason, Reason::OutOfTurn);
        meshes.forget_expired(now_ns() + 599_000_000_000);
        assert!(meshes.get(&id, &one).is_ok());
        meshes.forget_expired(now_ns() + 600_000_000_000);
        assert_eq!(meshes.get(&id, &one).unwrap_err().reason, Reason::UnknownMesh);
        assert_eq!(taken(), 0);
    }

    #[test]
    fn parts_follow_each_other_and_are_bounded() {
        let limits = Limits { mesh_bytes: 100, meshes_per_caller: 2, ..Limits::default() };
        let (meshes, [one, _]) = meshes(&limits);
        let id = meshes.add(&part("", 0, b"v 0 0 0\n"), &one).unwrap().mesh_id;
        for (offset, bytes, reason, field) in [
            (7, &b"v"[..], Reason::OutOfTurn, "offset"),
            (9, b"v", Reason::OutOfTurn, "offset"),
            (8, b"", Reason::Missing, "part"),
        ] {
            let refused = meshes.add(&part(&id, offset, bytes), &one).unwrap_err();
            assert_eq!((refused.reason, refused.field.as_str()), (reason, field));
        }
        assert_eq!(meshes.get(&id, &one).unwrap_err().reason, Reason::OutOfTurn);
        assert_eq!(meshes.add(&part(&id, 8, b"v 1 0 0\n"), &one).unwrap().received_bytes, 16);
        // One more upload fits, not two: unfinished ones are not given up.
        let second = meshes.add(&part("", 0, b"v"), &one).unwrap().mesh_id;
        assert_eq!(meshes.add(&part("", 0, b"v"), &one).unwrap_err().reason, Reason::TooMany);
        let refused = meshes.add(&part(&second, 1, &[b' '; 100]), &one).unwrap_err();
        assert_eq!(refused.reason, Reason::TooLarge);
        // The refused one is gone, and a completed one is replaced.
        let third = sent(&meshes, &one);
        sent(&meshes, &one);
        assert_eq!(meshes.get(&third, &one).unwrap_err().reason, Reason::UnknownMesh);
        assert_eq!(meshes.add(&part("", 1, b"v"), &one).unwrap_err().reason, Reason::OutOfTurn);
    }

    #[test]
    fn what_is_no_mesh_is_refused_and_forgotten() {
        let (meshes, [one, _]) = meshes(&Limits { mesh_vertices: 5, ..Limits::default() });
        let finish = |text: &str, mends: bool, stop: bool| {
            let id = meshes.add(&part("", 0, text.as_bytes()), &one).unwrap().mesh_id;
            let reading = meshes.read(&id, "organ.obj", &one).unwrap();
            let report = reading.finish(ReadAs { unit: unit("m").ok(), label: None }, mends, &AtomicBool::new(stop));
            (meshes.get(&id, &one).is_ok(), report)
        };
        let (is_kept, refused) = finish("v 0 0\nf 1 2 3\n", false, false);
        let refused = refused.unwrap_err();
        assert!(!is_kept && refused.message.contains("organ.obj: line 1"), "{refused}");
        let (is_kept, refused) = finish(&format!("{TETRAHEDRON}v 5 5 5\nv 6 6 6\n"), false, false);
        assert!(!is_kept && refused.unwrap_err().message.contains("vertices"));
        assert_eq!(finish(TETRAHEDRON, false, true).1.unwrap_err().reason, given_up().reason);
        // An edge with three triangles: no surface, but kept for a solid.
        let leaf = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nv 0 -1 -1\nf 1 2 3\nf 2 1 4\nf 1 2 5\n";
        let (is_kept, report) = finish(leaf, false, false);
        let report = report.unwrap();
        assert!(is_kept && report.refused && report.solid_only && report.problems[0].place_m.is_some(), "{report:?}");
        let (is_kept, report) = finish(leaf, true, false);
        assert!(is_kept && !report.unwrap().refused);
        assert!(unit("ell").is_err() && unit("").is_err());
    }
}
