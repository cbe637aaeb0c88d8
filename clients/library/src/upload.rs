//! Sends a mesh of your own to the server, in parts, for sessions on it.

use palpate_proto::pb;
use pb::session_service_client::SessionServiceClient;
use tonic::Status;

use crate::connect::Channel;

/// Bytes of a part: other calls of the connection wait for one part at most.
const PART_BYTES: usize = 256 << 10;

/// Sends the file of a mesh; `unit` is what a length of 1 in it is: "m", "cm", "mm" or so many metres. The answer has the
/// `mesh_id` for `Scene.mesh`, and a report that tells whether the mesh can be used.
///
/// # Errors
/// Returns the server's refusal, or how the connection broke.
pub async fn upload_mesh(
    channel: Channel,
    file_name: &str,
    file: &[u8],
    unit: &str,
    repair: bool,
) -> Result<pb::UploadMeshResponse, Status> {
    let mut sessions = SessionServiceClient::new(channel);
    let mut answer = pb::UploadMeshResponse::default();
    let mut rest = file;
    loop {
        let offset = (file.len() - rest.len()) as u64;
        let (part, after) = rest.split_at(rest.len().min(PART_BYTES));
        rest = after;
        let request = pb::UploadMeshRequest {
            mesh_id: answer.mesh_id,
            file_name: file_name.to_owned(),
            offset,
            part: part.to_vec(),
            last: rest.is_empty(),
            unit: unit.to_owned(),
            repair,
        };
        answer = sessions.upload_mesh(request).await?.into_inner();
        if rest.is_empty() {
            return Ok(answer);
        }
    }
}
