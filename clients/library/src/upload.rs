//! Uploads meshes and journals to the server, in parts, for sessions that it creates from them.

use palpate_proto::pb;
use pb::session_service_client::SessionServiceClient;
use tonic::Status;

use crate::connect::Channel;

/// Bytes per part: other calls of the connection wait for at most one part.
const PART_BYTES: usize = 256 << 10;

/// Splits a file into parts: the offset of each, its bytes, and whether it is the last. An empty file has one.
fn parts(file: &[u8]) -> impl Iterator<Item = (u64, Vec<u8>, bool)> {
    let count = file.len().div_ceil(PART_BYTES).max(1);
    (0..count).map(move |number| {
        let rest = &file[number * PART_BYTES..];
        ((number * PART_BYTES) as u64, rest[..rest.len().min(PART_BYTES)].to_vec(), number + 1 == count)
    })
}

/// Uploads `file`, the bytes of a mesh's file called `file_name`, in parts one after another. `unit` is the length of
/// 1 in it: "m", "cm", "mm" or a number of metres. Of a label map with several labels (NRRD, NIfTI, DICOM), `label` is the one
/// whose voxels are inside; then `unit` may be empty, for that of the file. If `repair` is true, the server repairs faults. The
/// answer contains the `mesh_id` for `Scene.mesh`, and a report of whether the mesh can be used: faults of the mesh are no error here
/// (`report.refused`).
///
/// ```no_run
/// # async fn example(channel: palpate_client::Channel) -> Result<(), Box<dyn std::error::Error>> {
/// let file = std::fs::read("kidney.stl")?;
/// let sent = palpate_client::upload::upload_mesh(channel, "kidney.stl", &file, "mm", None, true).await?;
/// println!("mesh {}: {:?}", sent.mesh_id, sent.report);
/// # Ok(())
/// # }
/// ```
///
/// # Errors
/// Returns the server's refusal of a part, or how the connection broke. Nothing resumes the upload.
pub async fn upload_mesh(
    channel: Channel,
    file_name: &str,
    file: &[u8],
    unit: &str,
    label: Option<u32>,
    repair: bool,
) -> Result<pb::UploadMeshResponse, Status> {
    let mut sessions = SessionServiceClient::new(channel);
    let mut answer = pb::UploadMeshResponse::default();
    for (offset, part, last) in parts(file) {
        let (mesh_id, file_name, unit) = (answer.mesh_id, file_name.to_owned(), unit.to_owned());
        let request = pb::UploadMeshRequest { mesh_id, file_name, offset, part, last, unit, repair, label };
        answer = sessions.upload_mesh(request).await?.into_inner();
    }
    Ok(answer)
}

/// Uploads `file`, the bytes of a journal or a snapshot (MCAP), in parts one after another. The answer contains the
/// `upload_id` for `JournalMoment`, and a description of the journal. Calls `sent` after each part with the number of
/// bytes that have arrived in all.
///
/// # Errors
/// Returns the server's refusal of a part, or how the connection broke. Nothing resumes the upload.
pub async fn upload_journal(
    channel: Channel,
    file: &[u8],
    mut sent: impl FnMut(u64),
) -> Result<pb::UploadJournalResponse, Status> {
    let mut sessions = SessionServiceClient::new(channel);
    let mut answer = pb::UploadJournalResponse::default();
    for (offset, part, last) in parts(file) {
        let request = pb::UploadJournalRequest { upload_id: answer.upload_id, offset, part, last };
        answer = sessions.upload_journal(request).await?.into_inner();
        sent(answer.received_bytes);
    }
    Ok(answer)
}
