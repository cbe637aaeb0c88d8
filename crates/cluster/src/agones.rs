//! Tells Agones how a server stands, by the SDK beside it in the pod. Agones may be slow, hang or not be there: then it is told later,
//! and the server notices nothing.
//!
//! Where sessions go, the servers decide. Agones decides how many servers there are: it ends only those that are `Ready`, so a server
//! with sessions says `Allocate`, and `Ready` again when the last has gone.

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

/// Agones hears so often that the server is well.
const HEALTH: Duration = Duration::from_secs(2);

/// How the server stands is told so often at most.
const LOOK: Duration = Duration::from_secs(1);

/// An SDK that takes longer for one call counts as away.
const SDK_TIMEOUT: Duration = Duration::from_secs(5);

/// The counter of the game server that has the sessions.
const COUNTER: &str = "sessions";

/// The SDK's port unless Agones says another.
const PORT: u16 = 9357;

/// How a server stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ServerStatus {
    /// It may step and speak for sessions.
    pub acts: bool,
    /// Its sessions.
    pub sessions: usize,
    /// It takes no new ones.
    pub draining: bool,
}

/// What Agones knows of the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum AgonesState {
    Starting,
    Ready,
    Allocated,
    Shutdown,
}

impl AgonesState {
    /// The next that is to be told, if any. Agones hears `Ready` before anything else.
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

/// The SDK in this pod.
struct Sdk {
    sdk: SdkClient<Channel>,
    counters: Counters<Channel>,
    state: AgonesState,
    /// What the counter was told, and how far it goes.
    counted: Option<i64>,
    capacity: Option<i64>,
    /// Whether the log has it that Agones does not answer.
    is_away: bool,
}

/// One call, with patience.
async fn within<T>(call: impl Future<Output = Result<T, Status>>) -> Result<T, Status> {
    timeout(SDK_TIMEOUT, call).await.unwrap_or_else(|_| Err(Status::deadline_exceeded("no answer")))
}

impl Sdk {
    /// Tells what has changed.
    async fn tell(&mut self, seen: ServerStatus) -> Result<(), Status> {
        if let Some(next) = self.state.next(seen) {
            match next {
                AgonesState::Allocated => within(self.sdk.allocate(Empty {})).await?,
                AgonesState::Shutdown => within(self.sdk.shutdown(Empty {})).await?,
                AgonesState::Starting | AgonesState::Ready => within(self.sdk.ready(Empty {})).await?,
            };
            info!(state = ?next, "Agones is told");
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
        // If it was refused, somebody may have changed the capacity.
        match told {
            Ok(()) => self.counted = Some(sessions),
            Err(_) => self.capacity = None,
        }
        told
    }

    /// Sets the counter, no higher than it goes: a server may take more sessions than Agones reckons with.
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

/// Tells for ever how the server stands, which `seen` tells: whether it is ready, has sessions, how many, and at last that it was
/// drained.
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

/// Says for ever that the server is well.
async fn tell_health(channel: Channel) {
    let mut sdk = SdkClient::new(channel);
    loop {
        let mut ticks = interval(HEALTH);
        // A server that was frozen says once that it is well.
        ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
        // Ends when the SDK does.
        let _ = sdk.health(IntervalStream::new(ticks).map(|_| Empty {})).await;
        sleep(HEALTH).await;
    }
}

/// Returns the port at which Agones has put the SDK of this pod.
pub fn port() -> u16 {
    const NAME: &str = "AGONES_SDK_GRPC_PORT";
    let Ok(text) = std::env::var(NAME) else { return PORT };
    text.parse().unwrap_or_else(|_| {
        warn!("{NAME} must be a port, but is `{text}`: {PORT} is tried");
        PORT
    })
}

/// Tells the SDK at `port` of this machine how a server stands, for ever. `seen` is called once a second and must not wait.
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
            // It is still there.
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
