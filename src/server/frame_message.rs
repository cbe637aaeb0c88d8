//! Splits a frame of the displaced surface into messages for one viewer.

use palpate_proto::geometry::vector;
use palpate_proto::pb;
use palpate_session::surface::encode::Patch;
use palpate_session::wire::sample::encoding;

use palpate_realtime::frames::Delivery;

/// Bytes of displacements per message: messages of other streams wait for at most one of these.
const FRAME_BYTES_PER_MESSAGE: usize = 64 << 10;

/// Returns the messages of a frame for the viewer `viewer_id`, in the order of the frame's patches; only the last one
/// has `last` set. Each has patches of at most 64 KiB together, or a single larger one. `skipped` is the number of
/// frames before this one that the viewer did not get. A frame without patches tells of a new topology, or of burns, alone.
pub fn frame_messages(viewer_id: &str, delivery: &Delivery, skipped: u64) -> Vec<pb::WatchFramesResponse> {
    let frame = &delivery.frame;
    let [vertices_x, vertices_y] = frame.refinement.vertices();
    #[allow(clippy::cast_possible_truncation)]
    let message = || pb::WatchFramesResponse {
        viewer_id: viewer_id.to_owned(),
        frame_id: delivery.frame_id,
        step: frame.step,
        simulation_time_s: frame.simulation_time_s,
        refinement: frame.refinement.between() as u32,
        vertices_x: vertices_x as u32,
        vertices_y: vertices_y as u32,
        encoding: encoding(frame.encoding).into(),
        origin_m: vector(frame.quanta.origin_m),
        scale_m: vector(frame.quanta.scale_m),
        full: frame.full,
        skipped_frames: skipped,
        overrun_count: delivery.overrun_count,
        time_dilation: delivery.time_dilation,
        patches: Vec::new(),
        last: false,
        topology_version: frame.topology_version,
        burn_version: frame.burn_version,
    };
    let mut messages: Vec<pb::WatchFramesResponse> = Vec::new();
    let mut room = 0;
    for patch in &frame.patches {
        if messages.is_empty() || patch.bytes.len() > room {
            messages.push(message());
            room = FRAME_BYTES_PER_MESSAGE;
        }
        room -= patch.bytes.len().min(room);
        if let Some(message) = messages.last_mut() {
            message.patches.push(self::patch(patch));
        }
    }
    if messages.is_empty() {
        messages.push(message());
    }
    if let Some(last) = messages.last_mut() {
        last.last = true;
    }
    messages
}

#[allow(clippy::cast_possible_truncation)]
fn patch(patch: &Patch) -> pb::Patch {
    pb::Patch {
        first_x: patch.first[0] as u32,
        first_y: patch.first[1] as u32,
        count_x: patch.count[0] as u32,
        count_y: patch.count[1] as u32,
        displacement: patch.bytes.clone(),
    }
}
