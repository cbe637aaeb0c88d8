//! The sessions, clients and viewers of one thread of a load.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use glam::DVec3;
use palpate_client::view::Frames;
use palpate_client::{Channel, Error, Server, describe, fleet};
use palpate_proto::geometry::from_vector;
use palpate_proto::pb;
use pb::create_session_request::Source;
use pb::haptic_service_client::HapticServiceClient;
use pb::session_service_client::SessionServiceClient;
use tokio::sync::watch;
use tokio::task::JoinSet;
use tonic::Status;

use super::client::{Arrivals, Client, Common, Stage, lock};
use super::stroke::Stroke;

/// The task of one thread.
pub(crate) struct Orders {
    pub(crate) server: Server,
    pub(crate) source: Source,
    /// Indices of its sessions among all.
    pub(crate) sessions: Vec<usize>,
    pub(crate) clients_per_session: u32,
    pub(crate) viewers_per_session: u32,
    pub(crate) clients_per_connection: usize,
    pub(crate) frame_rate_hz: f64,
    /// Time between the starts of two sessions.
    pub(crate) pause: Duration,
    /// Upper bound of the whole duration, s; leases last as long.
    pub(crate) lasts_s: f64,
}

/// A session that this thread created.
struct Made {
    id: String,
    /// The server that has made it: of a fleet, any.
    server: Server,
    rate_hz: f64,
    /// Step and our time, ns, at which the measurement began.
    begin: Option<(u64, u64)>,
}

/// Connections that several clients share.
struct Connections<'o> {
    orders: &'o Orders,
    /// By the server.
    newest: BTreeMap<String, (Channel, usize)>,
}

impl Connections<'_> {
    async fn next(&mut self, server: &Server) -> Result<Channel, Error> {
        if let Some((channel, users)) = self.newest.get_mut(server.url())
            && *users < self.orders.clients_per_connection
        {
            *users += 1;
            return Ok(channel.clone());
        }
        let channel = server.connect().await?;
        self.newest.insert(server.url().to_owned(), (channel.clone(), 1));
        Ok(channel)
    }
}

/// The sessions and clients of a thread.
pub(crate) struct Swarm {
    client: SessionServiceClient<Channel>,
    /// Connections to the servers that have made sessions.
    hosts: BTreeMap<String, Channel>,
    made: Vec<Made>,
    tasks: JoinSet<()>,
    common: Common,
}

impl Swarm {
    pub(crate) async fn new(server: &Server, common: &Common) -> Result<Self, Error> {
        let channel = server.connect().await?;
        let hosts = BTreeMap::from([(server.url().to_owned(), channel.clone())]);
        let client = SessionServiceClient::new(channel);
        Ok(Swarm { client, hosts, made: Vec::new(), tasks: JoinSet::new(), common: common.clone() })
    }

    /// Creates the sessions and opens the streams of their clients and viewers.
    pub(crate) async fn gather(&mut self, orders: &Orders, phases: &[watch::Receiver<u64>]) -> Result<(), Error> {
        let mut connections = Connections { orders, newest: BTreeMap::new() };
        // Separate connections: on a shared one, frames would delay samples.
        let mut viewing = Connections { orders, newest: BTreeMap::new() };
        let begun = tokio::time::Instant::now();
        for (place, number) in orders.sessions.iter().enumerate() {
            #[allow(clippy::cast_possible_truncation)]
            tokio::time::sleep_until(begun + orders.pause * place as u32).await;
            let request = pb::CreateSessionRequest {
                source: Some(orders.source.clone()),
                paused: false,
                // If this program dies, the server deletes its sessions.
                idle_timeout_s: Some(10.0),
            };
            let created = self.client.create_session(request).await?.into_inner().session.unwrap_or_default();
            let server = fleet::home(&orders.server, &created)?;
            let whole = Stroke::new(&created, 0.0);
            let (middle_m, rate_hz) = (middle_m(&created), rate_hz(&created));
            let (id, step) = (created.session_id, created.step);
            self.made.push(Made { id: id.clone(), server: server.clone(), rate_hz, begin: None });
            if !self.hosts.contains_key(server.url()) {
                self.hosts.insert(server.url().to_owned(), server.connect().await?);
            }
            let arrivals = (orders.viewers_per_session > 0).then(|| Arc::new(Mutex::new(Arrivals::new())));
            for tool in 0..orders.clients_per_session {
                let client = Client {
                    common: self.common.clone(),
                    session_id: id.clone(),
                    tool,
                    rate_hz,
                    #[allow(clippy::cast_precision_loss)]
                    stroke: whole.beginning(0.618 * (number + tool as usize) as f64),
                    middle_m,
                    arrivals: arrivals.clone(),
                };
                let ticks = phases[(number + tool as usize) % phases.len()].clone();
                self.tasks.spawn(client.open(connections.next(&server).await?, ticks).await?);
            }
            if orders.clients_per_session == 0 {
                let channel = connections.next(&server).await?;
                keep_awake(channel, &id, whole, rate_hz, step, orders.lasts_s).await?;
            }
            for _ in 0..orders.viewers_per_session {
                let (channel, frames_hz) = (viewing.next(&server).await?, orders.frame_rate_hz.min(rate_hz));
                let viewer = view(self.common.clone(), channel, id.clone(), frames_hz, arrivals.clone());
                self.tasks.spawn(viewer.await?);
            }
        }
        Ok(())
    }

    /// Asks for the steps of sessions without clients, at the beginning and at the end of the measurement.
    pub(crate) async fn look(&mut self, orders: &Orders) {
        if orders.clients_per_session > 0 {
            return;
        }
        for made in &mut self.made {
            let request = pb::GetSessionRequest { session_id: made.id.clone() };
            let Some(channel) = self.hosts.get(made.server.url()) else { continue };
            let answer = fleet::follow_from(&made.server, channel.clone(), |channel| {
                let request = request.clone();
                async move { SessionServiceClient::new(channel).get_session(request).await }
            });
            let answer = answer.await.map(|at| at.answer);
            let now_ns = self.common.now_ns();
            let mut tally = lock(&self.common.tally);
            match answer.map(|answer| answer.into_inner().session.unwrap_or_default()) {
                Ok(session) => match made.begin {
                    None => made.begin = Some((session.step, now_ns)),
                    Some((step, at_ns)) => {
                        #[allow(clippy::cast_precision_loss)]
                        let (simulated_s, real_s) =
                            ((session.step - step) as f64 / made.rate_hz, (now_ns - at_ns) as f64 * 1e-9);
                        tally.dilation_min = tally.dilation_min.min(simulated_s / real_s);
                        if session.resting {
                            tally.broke("a session came to rest although it was to be kept awake".to_owned());
                        }
                    }
                },
                Err(error) => tally.broke(error.to_string()),
            }
        }
    }

    /// Waits for all clients and viewers to end.
    pub(crate) async fn drain(&mut self) {
        while self.tasks.join_next().await.is_some() {}
    }

    /// Deletes the sessions, also after a failure.
    pub(crate) async fn disperse(&mut self) {
        self.tasks.abort_all();
        for made in self.made.drain(..) {
            let Some(channel) = self.hosts.get(made.server.url()) else { continue };
            let request = pb::DeleteSessionRequest { session_id: made.id };
            let deleted = fleet::follow_from(&made.server, channel.clone(), |channel| {
                let request = request.clone();
                async move { SessionServiceClient::new(channel).delete_session(request).await }
            });
            let is_deleted = matches!(tokio::time::timeout(Duration::from_secs(2), deleted).await, Ok(Ok(_)));
            if !is_deleted && self.hosts.len() == 1 {
                // The server is gone, and its sessions with it.
                return;
            }
        }
    }
}

/// Sends a session without clients all its commands in advance, in one call: a new force every [`APART_S`], so that the
/// tissue never comes to rest.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
async fn keep_awake(
    channel: Channel,
    id: &str,
    stroke: Stroke,
    rate_hz: f64,
    step: u64,
    lasts_s: f64,
) -> Result<(), Error> {
    /// Fewer than a session queues.
    const MAX_COMMANDS: u64 = 4000;
    const APART_S: f64 = 0.05;
    let steps = (lasts_s * rate_hz) as u64;
    let apart = ((APART_S * rate_hz) as u64).max(steps / MAX_COMMANDS).max(1);
    let mut haptics = HapticServiceClient::new(channel);
    let acquire = pb::AcquireToolRequest {
        session_id: id.to_owned(),
        tool: 0,
        lease_s: Some(lasts_s),
        holder: "palpate-client load".to_owned(),
        // The connection closes before the commands act.
        outlives_connection: true,
    };
    let lease_id = haptics.acquire_tool(acquire).await?.into_inner().lease_id;
    let command = |index: u64| {
        let at_step = step + index * apart;
        let action = Some(stroke.at(at_step as f64 / rate_hz));
        pb::Command { at_step: Some(at_step), sequence: Some(index + 1), action, ..Default::default() }
    };
    let commands = (0..steps.div_ceil(apart)).map(command).collect();
    haptics.send_commands(pb::SendCommandsRequest { session_id: id.to_owned(), lease_id, commands }).await?;
    Ok(())
}

/// The middle of a session's tissue, m.
pub(crate) fn middle_m(session: &pb::Session) -> DVec3 {
    from_vector(session.extent.as_ref().and_then(|extent| extent.middle_m.as_ref()))
}

/// Steps a second of a session.
pub(crate) fn rate_hz(session: &pb::Session) -> f64 {
    let stepping = session.scene.as_ref().and_then(|scene| scene.stepping.as_ref());
    stepping.and_then(|stepping| stepping.rate_hz).unwrap_or(1000.0)
}

/// Begins to watch a session. The returned future is the viewer's life.
pub(crate) async fn view(
    common: Common,
    channel: Channel,
    session_id: String,
    rate_hz: f64,
    arrivals: Option<Arc<Mutex<Arrivals>>>,
) -> Result<impl Future<Output = ()>, Status> {
    let (encoding, rate_hz) = (pb::Encoding::I16.into(), Some(rate_hz));
    let request = pb::WatchFramesRequest { session_id, encoding, rate_hz, ..Default::default() };
    Ok(watch(common, Frames::open(channel, request).await?, arrivals))
}

/// Counts a viewer's frames until the measurement is over.
async fn watch(common: Common, mut frames: Frames, arrivals: Option<Arc<Mutex<Arrivals>>>) {
    // Used when there are no samples: arrival time minus simulated time of the least delayed frame, s.
    let mut least_s = f64::INFINITY;
    while !common.stage.is(Stage::DRAIN) {
        let part = match tokio::time::timeout(Duration::from_millis(200), frames.next_part()).await {
            Err(_) => continue,
            Ok(Ok(Some(part))) => part,
            Ok(Ok(None)) => return lock(&common.tally).broke("the server ended a viewer's stream".to_owned()),
            Ok(Err(status)) => return lock(&common.tally).broke(describe(&status)),
        };
        if !part.last {
            continue;
        }
        let now_ns = common.now_ns();
        #[allow(clippy::cast_precision_loss)]
        let ahead_s = now_ns as f64 * 1e-9 - part.simulation_time_s;
        least_s = least_s.min(ahead_s);
        if common.stage.is(Stage::MEASURE) {
            let sampled_ns = arrivals.as_ref().and_then(|arrivals| lock(arrivals).of(part.step));
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
            let age_ns = sampled_ns.map_or(((ahead_s - least_s) * 1e9) as u64, |at_ns| now_ns.saturating_sub(at_ns));
            let mut tally = lock(&common.tally);
            tally.frames += 1;
            tally.frame_age_ns.saturating_record(age_ns);
        }
    }
}
