//! Splits the wound of a session's surface into messages.

use palpate_proto::pb;
use palpate_realtime::SessionHandle;
use palpate_session::surface::wound::{CutTriangles, LipVertex, Wound};
use palpate_session::surface::{Refinement, Skin};
use palpate_tissue::{CutFace, CutVertex};

/// Number of entries of all lists in a message: about 100 KiB.
const ENTRIES_PER_MESSAGE: usize = 2048;

/// The wound of a session's surface, as far as a client does not know it.
pub(super) struct WoundParts {
    /// What each part says.
    common: pb::GetWoundResponse,
    vertices: std::vec::IntoIter<LipVertex>,
    triangles: std::vec::IntoIter<CutTriangles>,
    cut_vertices: std::vec::IntoIter<pb::CutVertex>,
    cut_faces: std::vec::IntoIter<pb::CutFace>,
}

impl WoundParts {
    /// Splits the surface as frames of `refinement` show it now, less what the client knows.
    pub(super) fn new(handle: &SessionHandle, refinement: Refinement, request: &pb::GetWoundRequest) -> Self {
        let pb::GetWoundRequest { since_version, cut_surface, .. } = *request;
        let status = handle.status();
        let (cuts, model) = (&status.cuts, &status.model);
        let skin: Option<&Skin> = handle.skin.as_deref();
        let continues = cuts.continues(since_version);
        let wound = Wound::of(model, cuts, skin, refinement);
        let stays_whole = wound.is_none() && !cuts.is_empty();
        let mut wound = wound.unwrap_or_default();
        if continues {
            wound = wound.since(since_version);
        }
        let count = |count: usize| u32::try_from(count).unwrap_or(u32::MAX);
        let common = pb::GetWoundResponse {
            version: cuts.version(),
            continues,
            first_vertex: wound.first_vertex,
            severed: count(cuts.len()),
            pieces: if cuts.is_empty() { 1 } else { count(cuts.pieces(model)) },
            stays_whole,
            ..Default::default()
        };
        let cut_surface = skin.filter(|_| cut_surface).map(|skin| skin.cut_surface(cuts)).unwrap_or_default();
        let known = if continues { since_version } else { 0 };
        let cut_vertices: Vec<_> = cut_surface.vertices_since(known).map(cut_vertex).collect();
        let cut_faces: Vec<_> = cut_surface.faces_since(known).map(cut_face).collect();
        WoundParts {
            common,
            vertices: wound.vertices.into_iter(),
            triangles: wound.triangles.into_iter(),
            cut_vertices: cut_vertices.into_iter(),
            cut_faces: cut_faces.into_iter(),
        }
    }

    /// Returns the next message, and whether it is the last, which has `last` set.
    pub(super) fn next(&mut self) -> (pb::GetWoundResponse, bool) {
        let mut room = ENTRIES_PER_MESSAGE;
        let vertices: Vec<_> = taken(&mut self.vertices, &mut room).map(lip_vertex).collect();
        let triangles: Vec<_> = taken(&mut self.triangles, &mut room).map(cut_triangles).collect();
        let cut_vertices: Vec<_> = taken(&mut self.cut_vertices, &mut room).collect();
        let cut_faces: Vec<_> = taken(&mut self.cut_faces, &mut room).collect();
        let last = [self.vertices.len(), self.triangles.len(), self.cut_vertices.len(), self.cut_faces.len()] == [0; 4];
        (pb::GetWoundResponse { vertices, triangles, cut_vertices, cut_faces, last, ..self.common.clone() }, last)
    }
}

/// Takes as many entries as there is room for, which it takes up.
fn taken<T>(entries: &mut std::vec::IntoIter<T>, room: &mut usize) -> impl Iterator<Item = T> {
    let count = entries.len().min(*room);
    *room -= count;
    entries.take(count)
}

fn cut_vertex((number, vertex): (u32, &CutVertex)) -> pb::CutVertex {
    let [rest_x_m, rest_y_m, rest_z_m] = vertex.rest_m.as_vec3().to_array();
    pb::CutVertex { number, rest_x_m, rest_y_m, rest_z_m }
}

fn cut_face(face: &CutFace) -> pb::CutFace {
    pb::CutFace { number: face.number, corners: face.corners.to_vec() }
}

fn lip_vertex(vertex: LipVertex) -> pb::LipVertex {
    let LipVertex { host, others: [second, third], weights: [second_part, third_part], .. } = vertex;
    let third = if third == second { 0 } else { third };
    pb::LipVertex { host, second, third, second_part, third_part }
}

fn cut_triangles(triangles: CutTriangles) -> pb::CutTriangles {
    let CutTriangles { first, count, corners, .. } = triangles;
    pb::CutTriangles { first, count, corners: corners.concat() }
}
