//! What a haptic stream is told besides samples.

use palpate_proto::pb;
use tonic::Status;

/// What a haptic stream is told besides samples.
pub(super) enum Event {
    Rejected(pb::Rejection),
    /// The client's time, and when it came.
    Renewed(u64, u64),
    /// What the client sent can't be read.
    Failed(Status),
    /// The client has said all it wanted to say.
    Finished,
}
