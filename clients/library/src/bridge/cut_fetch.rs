//! Fetches what is severed in a session's tissue, for the copy of it that a loop renders from.
//!
//! Each sample has the version of the topology. If the copy lacks it, one call fetches what was severed since, while the
//! stream goes on; at most [`RATE_HZ`] of them in a second, as a blade makes a version in each step. A server that does not name the springs is
//! asked once: the copy then keeps the cuts with which it began.

use std::time::Duration;

use palpate_haptics::{ReportedCuts, ReportedSpring};
use palpate_proto::pb;
use pb::view_service_client::ViewServiceClient;
use tokio::time::{Instant, sleep_until, timeout};

use super::background_call::BackgroundCall;
use super::copy_thread::CutsWriter;
use crate::Error;
use crate::connect::Channel;

/// Largest number of calls in a second.
const RATE_HZ: f64 = 25.0;

/// Pause after a call that failed, and the time limit of a call.
const PAUSE: Duration = Duration::from_secs(1);
const CALL_TIMEOUT: Duration = Duration::from_secs(5);

/// Limit on the springs of a report: no client could step a tissue with so many.
const MAX_SPRINGS: usize = 1 << 20;

/// Follows the cuts of a session for one copy at a time.
pub(super) struct CutsFollower {
    channel: Channel,
    session_id: String,
    /// `None`: there is no copy, or it follows no cuts.
    copy: Option<CutsWriter>,
    call: BackgroundCall<ReportedCuts>,
    /// The earliest time of the next call.
    next: Instant,
}

impl CutsFollower {
    /// Creates a follower without a copy.
    pub(super) fn new(channel: Channel, session_id: String) -> Self {
        CutsFollower { channel, session_id, copy: None, call: BackgroundCall::none(), next: Instant::now() }
    }

    /// Follows for another copy from now on; `None`: for none.
    pub(super) fn follow(&mut self, copy: Option<CutsWriter>) {
        self.call.abort();
        self.copy = copy;
    }

    /// Begins a call if the copy lacks a version of the topology and none is under way.
    pub(super) fn look(&mut self, topology_version: u32) {
        let Some(copy) = self.copy.as_ref().filter(|copy| copy.version() < topology_version) else { return };
        if self.call.is_under_way() {
            return;
        }
        let (channel, session_id, since_version) = (self.channel.clone(), self.session_id.clone(), copy.version());
        let next = self.next;
        self.call.begin(async move {
            sleep_until(next).await;
            let late = |_| Error::Connection("the server does not tell in time what is severed".to_owned());
            timeout(CALL_TIMEOUT, fetch(channel, session_id, since_version)).await.map_err(late)?
        });
    }

    /// Waits for the call under way, if any, and passes its report to the copy. Never returns without a call. Dropping the future loses
    /// nothing.
    pub(super) async fn passed_on(&mut self) {
        let pause = match self.call.result().await {
            Ok(cuts) => {
                // The server tells its state of some steps ago, which may be before a snapshot.
                if let Some(copy) = self.copy.as_mut().filter(|copy| copy.version() <= cuts.version) {
                    copy.report(cuts);
                }
                Duration::from_secs_f64(RATE_HZ.recip())
            }
            Err(Error::Call(status)) if is_final(&status) => {
                self.copy = None;
                PAUSE
            }
            Err(_) => PAUSE,
        };
        self.next = Instant::now() + pause;
    }
}

/// Returns whether a later call would have the same answer.
fn is_final(status: &tonic::Status) -> bool {
    use tonic::Code::{FailedPrecondition, InvalidArgument, PermissionDenied, Unimplemented};
    matches!(status.code(), Unimplemented | PermissionDenied | FailedPrecondition | InvalidArgument)
}

/// Fetches what was severed since a version.
async fn fetch(channel: Channel, session_id: String, since_version: u32) -> Result<ReportedCuts, Error> {
    let request = pb::GetTopologyRequest { session_id, since_version, by_name: true };
    let mut parts = ViewServiceClient::new(channel).get_topology(request).await?.into_inner();
    let mut cuts = ReportedCuts::default();
    while let Some(pb::GetTopologyResponse { version, continues, severed, last, .. }) = parts.message().await? {
        (cuts.version, cuts.continues) = (version, continues);
        if cuts.springs.len() + severed.len() > MAX_SPRINGS {
            return Err(tonic::Status::unimplemented("the server reports too many severed springs for a copy").into());
        }
        for spring in severed {
            // A server of before ignores `by_name`.
            let Some(pb::SpringName { place, number }) = spring.name else {
                return Err(tonic::Status::unimplemented("the server does not name springs").into());
            };
            cuts.springs.push(ReportedSpring { place, number, part: f64::from(spring.part) });
        }
        if last {
            return Ok(cuts);
        }
    }
    Err(Error::Connection("the server's list of severed springs has no end".to_owned()))
}
