//! What a haptic stream is told besides samples.

use palpate_proto::pb;
use tonic::Status;

/// What a haptic stream is told besides samples.
pub(super) enum StreamEvent {
    Rejected(pb::Rejection),
    /// The client's time, and when it came; another session for datagrams, if it asked for one.
    Renewed {
        client_time_ns: u64,
        arrival_ns: u64,
        datagrams: Option<pb::DatagramOffer>,
    },
    /// What the client sent can't be read.
    Failed(Status),
    /// The client has said all it wanted to say.
    Finished,
}
