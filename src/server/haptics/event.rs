//! Events that a haptic stream sends besides samples.

use palpate_proto::pb;
use tonic::Status;

/// An event that a haptic stream sends besides samples.
pub(super) enum StreamEvent {
    Rejected(pb::Rejection),
    /// The answer to `renew`: the client's time, when it arrived, and another datagram session if the client
    /// requested one.
    Renewed {
        client_time_ns: u64,
        arrival_ns: u64,
        datagrams: Option<pb::DatagramOffer>,
    },
    /// The tissue has changed from this step on; for a stream whose client has a copy of it and no force law.
    TissueChanged(u64),
    /// A message of the client could not be read.
    Failed(Status),
    /// The client has closed its side of the stream.
    Finished,
}
