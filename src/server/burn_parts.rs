//! Splits what tips have burnt of a session's surface into messages.

use palpate_proto::pb;
use palpate_realtime::SessionHandle;
use palpate_session::surface::Refinement;
use palpate_session::surface::burns::{VertexBurn, vertex_burns};

/// Number of vertices in a message: some 30 KiB.
const VERTICES_PER_MESSAGE: usize = 2048;

/// What is burnt of a session's surface, as far as a client does not know it.
pub(super) struct BurnParts {
    version: u32,
    continues: bool,
    burns: std::vec::IntoIter<VertexBurn>,
}

impl BurnParts {
    /// Reads what is burnt now of the surface that frames of `refinement` show, less what a client knows that has version `since_version`.
    pub(super) fn new(handle: &SessionHandle, refinement: Refinement, since_version: u32) -> Self {
        let status = handle.status();
        let continues = status.burns.continues(since_version);
        let since = if continues { since_version } else { 0 };
        let burns = vertex_burns(&status.model, &status.burns, handle.skin.as_deref(), refinement, since);
        BurnParts { version: status.burns.version(), continues, burns: burns.into_iter() }
    }

    /// Returns the next message, and whether it is the last, which has `last` set.
    pub(super) fn next(&mut self) -> (pb::GetBurnsResponse, bool) {
        let burn = |VertexBurn { vertex, burn }| pb::VertexBurn { vertex, burn };
        let burns = self.burns.by_ref().take(VERTICES_PER_MESSAGE).map(burn).collect();
        let last = self.burns.len() == 0;
        let BurnParts { version, continues, .. } = *self;
        (pb::GetBurnsResponse { version, continues, burns, last }, last)
    }
}
