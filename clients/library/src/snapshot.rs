//! Receives snapshots of sessions.

use palpate_proto::pb;
use tonic::{Status, Streaming};

/// Limit on the bytes of a snapshot.
const MAX_BYTES: usize = 1 << 31;

/// Receives all parts of a snapshot, the answer to `SaveSnapshot`, and returns its bytes: a journal (MCAP) of a single
/// moment.
///
/// # Errors
/// Returns the server's refusal, or how the connection broke; `RESOURCE_EXHAUSTED` if the snapshot has more than 2
/// GiB.
pub async fn collect(parts: Streaming<pb::SaveSnapshotResponse>) -> Result<Vec<u8>, Status> {
    collect_within(parts, MAX_BYTES).await
}

/// Receives a snapshot of at most `most_bytes`.
pub(crate) async fn collect_within(
    mut parts: Streaming<pb::SaveSnapshotResponse>,
    most_bytes: usize,
) -> Result<Vec<u8>, Status> {
    let mut bytes = Vec::new();
    while let Some(message) = parts.message().await? {
        if bytes.len() + message.part.len() > most_bytes {
            return Err(Status::resource_exhausted(format!("the snapshot has more than {most_bytes} bytes")));
        }
        bytes.extend_from_slice(&message.part);
    }
    Ok(bytes)
}
