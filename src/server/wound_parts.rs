//! Splits the wound of a session's surface into messages.

use palpate_proto::pb;
use palpate_realtime::SessionHandle;
use palpate_session::surface::wound::{CutTriangles, LipVertex, Wound};
use palpate_session::surface::{Refinement, Skin};

/// Number of new vertices and of changed runs of triangles in a message: about 100 KiB.
const ENTRIES_PER_MESSAGE: usize = 2048;

/// The wound of a session's surface, as far as a client does not know it.
pub(super) struct WoundParts {
    /// What each part says.
    common: pb::GetWoundResponse,
    vertices: std::vec::IntoIter<LipVertex>,
    triangles: std::vec::IntoIter<CutTriangles>,
}

impl WoundParts {
    /// Splits the surface as frames of `refinement` show it now, less what a client knows that has the wound of version `since_version`.
    pub(super) fn new(handle: &SessionHandle, refinement: Refinement, since_version: u32) -> Self {
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
        WoundParts { common, vertices: wound.vertices.into_iter(), triangles: wound.triangles.into_iter() }
    }

    /// Returns the next message, and whether it is the last, which has `last` set.
    pub(super) fn next(&mut self) -> (pb::GetWoundResponse, bool) {
        let vertices: Vec<_> = self.vertices.by_ref().take(ENTRIES_PER_MESSAGE).map(lip_vertex).collect();
        let room = ENTRIES_PER_MESSAGE - vertices.len();
        let triangles: Vec<_> = self.triangles.by_ref().take(room).map(cut_triangles).collect();
        let last = self.vertices.len() == 0 && self.triangles.len() == 0;
        (pb::GetWoundResponse { vertices, triangles, last, ..self.common.clone() }, last)
    }
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
