//! Reports the state of a server to Agones, through the SDK beside it in the pod. Agones may be slow, hang or be
//! absent: then the report comes later, and the server is not affected.
//!
//! The servers decide where sessions go; Agones decides how many servers there are. Agones ends only servers that
//! are `Ready`, so a server with sessions reports `Allocate`, and `Ready` again when the last session has gone.

use std::time::Duration;

use palpate_proto::agones::Empty;
use palpate_proto::agones::beta::sdk_client::SdkClient as Counters;
use palpate_proto::agones::beta::{CounterUpdateRequest, GetCounterRequest, UpdateCounterRequest};
use palpate_proto::agones::sdk_client::SdkClient;
use tokio::time::{MissedTickBehavior, interval, sleep, timeout};
use tokio_stream::StreamExt;
use tokio_stream::wrappers::IntervalStream;
use tonic::Status;
use tonic::transport::{Channel, Endpoint};
use tracing::{info, warn};

/// Interval between health reports to Agones.
const HEALTH: Duration = Duration::from_secs(2);

/// Interval between reports of the server's state.
const LOOK: Duration = Duration::from_secs(1);

/// Time limit of one call to the SDK.
const SDK_TIMEOUT: Duration = Duration::from_secs(5);

/// Name of the game server's counter that holds the number of sessions.
const COUNTER: &str = "sessions";

/// Port of the SDK if the environment names no other.
const PORT: u16 = 9357;

/// State of a server that is reported to Agones: `Ready` without sessions, `Allocated` with some, and shut down once
/// it is draining and has none.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ServerStatus {
    /// Whether the server may step its sessions and answer for them. Nothing is reported before it first does.
    pub acts: bool,
    /// Number of sessions.
    pub sessions: usize,
    /// Whether the server takes no new sessions.
    pub draining: bool,
}

/// State of the server that Agones has been sent last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum AgonesState {
    Starting,
    Ready,
    Allocated,
    Shutdown,
}

impl AgonesState {
    /// Returns the next state to report, if any. The first report is always `Ready`.
    fn next(self, seen: ServerStatus) -> Option<AgonesState> {
        let wanted = match (self, seen) {
            (AgonesState::Shutdown, _) | (AgonesState::Starting, ServerStatus { acts: false, .. }) => return None,
            (AgonesState::Starting, _) => AgonesState::Ready,
            (_, ServerStatus { sessions: 0, draining: true, .. }) => AgonesState::Shutdown,
            (_, ServerStatus { sessions: 0, .. }) => AgonesState::Ready,
            _ => AgonesState::Allocated,
        };
        (wanted != self).then_some(wanted)
    }
}

/// Client of the SDK in this pod, and what it has reported.
struct Sdk {
    sdk: SdkClient<Channel>,
    counters: Counters<Channel>,
    state: AgonesState,
    /// Value that the counter was last set to.
    counted: Option<i64>,
    /// Capacity of the counter, as read from Agones.
    capacity: Option<i64>,
    /// Whether the log already says that Agones does not answer.
    is_away: bool,
}

/// Runs one call with the time limit [`SDK_TIMEOUT`].
async fn within<T>(call: impl Future<Output = Result<T, Status>>) -> Result<T, Status> {
    timeout(SDK_TIMEOUT, call).await.unwrap_or_else(|_| Err(Status::deadline_exceeded("no answer")))
}

impl Sdk {
    /// Reports what has changed since the last report, and keeps it in `self` if the call succeeded.
    async fn tell(&mut self, seen: ServerStatus) -> Result<(), Status> {
        if let Some(next) = self.state.next(seen) {
            match next {
                AgonesState::Allocated => within(self.sdk.allocate(Empty {})).await?,
                AgonesState::Shutdown => within(self.sdk.shutdown(Empty {})).await?,
                AgonesState::Starting | AgonesState::Ready => within(self.sdk.ready(Empty {})).await?,
            };
            info!(state = ?next, "reported the server's state to Agones");
            self.state = next;
        }
        if self.state == AgonesState::Starting || self.state == AgonesState::Shutdown {
            return Ok(());
        }
        let sessions = i64::try_from(seen.sessions).unwrap_or(i64::MAX);
        if self.counted == Some(sessions) {
            return Ok(());
        }
        let told = self.count(sessions).await;
        // A refusal may mean that the capacity has been changed.
        match told {
            Ok(()) => self.counted = Some(sessions),
            Err(_) => self.capacity = None,
        }
        told
    }

    /// Sets the counter, limited to its capacity: a server may have more sessions than Agones allows for.
    async fn count(&mut self, sessions: i64) -> Result<(), Status> {
        let capacity = match self.capacity {
            Some(capacity) => capacity,
            None => {
                let there = within(self.counters.get_counter(GetCounterRequest { name: COUNTER.to_owned() })).await?;
                *self.capacity.insert(there.into_inner().capacity)
            }
        };
        let count = Some(sessions.min(capacity));
        let update = CounterUpdateRequest { name: COUNTER.to_owned(), count };
        within(self.counters.update_counter(UpdateCounterRequest { counter_update_request: Some(update) })).await?;
        Ok(())
    }
}

/// Reports the server's state, as `seen` returns it, once a second until the task is dropped: whether it is ready,
/// the number of its sessions, and at the end that it was drained.
async fn tell_standing(channel: Channel, seen: impl Fn() -> ServerStatus) {
    let mut sdk = Sdk {
        sdk: SdkClient::new(channel.clone()),
        counters: Counters::new(channel),
        state: AgonesState::Starting,
        counted: None,
        capacity: None,
        is_away: false,
    };
    loop {
        match sdk.tell(seen()).await {
            Ok(()) if sdk.is_away => {
                info!("Agones answers");
                sdk.is_away = false;
            }
            Err(status) if !sdk.is_away => {
                warn!("Agones can't be reached to report this server's state; trying again: {}", status.message());
                sdk.is_away = true;
            }
            Ok(()) | Err(_) => {}
        }
        sleep(LOOK).await;
    }
}

/// Reports every 2 s that the server is healthy, until the task is dropped.
async fn tell_health(channel: Channel) {
    let mut sdk = SdkClient::new(channel);
    loop {
        let mut ticks = interval(HEALTH);
        // A server that was frozen sends one report, not one for each missed tick.
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        // Returns when the SDK ends the stream.
        let _ = sdk.health(IntervalStream::new(ticks).map(|_| Empty {})).await;
        sleep(HEALTH).await;
    }
}

/// Returns the port of this pod's Agones SDK: the environment variable `AGONES_SDK_GRPC_PORT`, or 9357 if that is
/// absent or not a port.
pub fn port() -> u16 {
    const NAME: &str = "AGONES_SDK_GRPC_PORT";
    let Ok(text) = std::env::var(NAME) else { return PORT };
    text.parse().unwrap_or_else(|_| {
        warn!("{NAME} must be a port, but is `{text}`: {PORT} is tried");
        PORT
    })
}

/// Reports the state of a server to the SDK at `port` of this machine, until the future is dropped: its health every
/// 2 s, and what has changed in its state and number of sessions once a second. Calls `seen` once a second; it must
/// not block. If the SDK does not answer, it logs that and tries again; it returns only if `port` gives no valid
/// address.
pub async fn tell(port: u16, seen: impl Fn() -> ServerStatus) {
    let Ok(endpoint) = Endpoint::from_shared(format!("http://localhost:{port}")) else { return };
    let channel = endpoint.connect_timeout(SDK_TIMEOUT).connect_lazy();
    tokio::join!(tell_health(channel.clone()), tell_standing(channel, seen));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agones_hears_of_each_change_in_its_order() {
        let seen = |sessions, draining| ServerStatus { acts: true, sessions, draining };
        let fenced = ServerStatus { acts: false, ..seen(0, false) };
        for (state, seen, next) in [
            (AgonesState::Starting, fenced, None),
            (AgonesState::Starting, seen(3, false), Some(AgonesState::Ready)),
            (AgonesState::Ready, seen(0, false), None),
            (AgonesState::Ready, seen(3, false), Some(AgonesState::Allocated)),
            // The server still exists.
            (AgonesState::Allocated, ServerStatus { acts: false, ..seen(3, false) }, None),
            (AgonesState::Allocated, seen(0, false), Some(AgonesState::Ready)),
            (AgonesState::Allocated, seen(1, true), None),
            (AgonesState::Allocated, seen(0, true), Some(AgonesState::Shutdown)),
            (AgonesState::Ready, seen(0, true), Some(AgonesState::Shutdown)),
            (AgonesState::Shutdown, seen(1, false), None),
        ] {
            assert_eq!(state.next(seen), next, "{state:?} {seen:?}");
        }
    }
}
