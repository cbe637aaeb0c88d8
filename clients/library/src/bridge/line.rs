//! The network side of a bridge: connects, opens a haptic stream, and passes commands and models on. When the connection
//! breaks, it connects again.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use glam::DVec3;
use palpate_proto::geometry::{from_vector, vector};
use palpate_proto::refusal::Reason;
use palpate_proto::{pb, touch};
use palpate_touch::carrier::Carried;
use palpate_touch::deadband::HEARTBEAT_S;
use palpate_touch::renderer::MOST_LAWS;
use palpate_touch::{Device, Law, LocalModel};
use pb::command::Action;
use pb::session_service_client::SessionServiceClient;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

use super::{Session, Target};
use crate::Error;
use crate::connect::{Channel, Server};
use crate::datagrams::Datagrams;
use crate::touch::Touch;

/// The data that the network passes to the device's loop. Only the newest counts; neither waits for the other.
#[derive(Default)]
pub(super) struct Shared {
    inbound: Mutex<Inbound>,
}

/// What has arrived since it was last asked for.
#[derive(Default)]
pub(super) struct Inbound {
    /// The law of a new connection.
    pub(super) law: Option<Law>,
    /// Further laws of the newest connection, and their numbers, at most [`MOST_LAWS`].
    pub(super) further: Vec<(u32, Law)>,
    /// The middle of the sheet, m.
    pub(super) middle_m: DVec3,
    /// Of the newest connection.
    pub(super) newest: Option<LocalModel>,
    pub(super) traffic: Traffic,
    /// The longest time between two poses that the server wants, s; 0 before it has said so.
    pub(super) wanted_s: f64,
    /// Why the newest connection broke, or never came to be; `None` while one stands.
    pub(super) failure: Option<Error>,
    /// The session that was made for the target.
    pub(super) made: Option<String>,
}

/// What went over the network, in all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Traffic {
    /// Connections that were opened.
    pub connections: u64,
    /// Samples that arrived.
    pub samples: u64,
    /// Their bytes, with the headers of the network.
    pub bytes: u64,
    /// Commands that the server refused.
    pub refused: u64,
    /// Attempts to connect that failed, and connections that broke.
    pub failed: u64,
    /// Poses that were sent, by whichever way.
    pub poses: u64,
    /// What went by datagram, and how often the stream took over again.
    pub carried: Carried,
}

impl Shared {
    pub(super) fn inbound(&self) -> MutexGuard<'_, Inbound> {
        self.inbound.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Where a tool was.
#[derive(Debug, Clone, Copy)]
pub(super) struct Command {
    /// By the client's clock.
    pub(super) client_time_ns: u64,
    /// m.
    pub(super) place_m: DVec3,
    /// How it moved, m/s, if the server is to go on like that.
    pub(super) velocity_m_per_s: Option<DVec3>,
}

/// First and longest pause before it connects again.
const PAUSES: [Duration; 2] = [Duration::from_millis(100), Duration::from_secs(2)];

/// A connection on which the server is silent for longer than this is given up.
const SILENCE: Duration = Duration::from_secs(2);

/// Largest number of commands on their way to the network: more would be a backlog.
pub(super) const COMMANDS: usize = 64;

/// Keeps a connection until `commands` ends.
pub(super) async fn keep(
    target: Target,
    device: Device,
    shared: &Shared,
    mut commands: mpsc::Receiver<Command>,
    warn: &(impl Fn(&str) + Sync),
) {
    let mut pause = PAUSES[0];
    // Attempts in a row.
    let mut attempts = 0_u64;
    loop {
        let before = shared.inbound().traffic;
        let ended = connect(&target, &device, shared, &mut commands, warn).await;
        let Err(error) = ended else { return };
        let traffic = {
            let mut inbound = shared.inbound();
            inbound.traffic.failed += 1;
            inbound.traffic
        };
        // Another attempt would be refused too.
        if traffic.connections == 0 && (error.is_refusal() || is_denied(&error)) {
            shared.inbound().failure = Some(error);
            return;
        }
        attempts = if traffic.connections > before.connections { 0 } else { attempts + 1 };
        if traffic.samples > before.samples {
            pause = PAUSES[0];
        }
        let tried = if attempts == 1 { "1 attempt".to_owned() } else { format!("{attempts} attempts") };
        let since = match (traffic.connections, attempts) {
            (0, _) => format!("never connected, in {tried}"),
            (_, 0) => "the connection was lost".to_owned(),
            _ => format!("the connection was lost, and {tried} to connect again failed"),
        };
        shared.inbound().failure = Some(Error::Connection(format!("{since}: {error}")));
        let pause_s = pause.as_secs_f64();
        warn(&match attempts {
            0 => format!("{error}; connecting again in {pause_s:.1} s"),
            _ => format!("{error}; attempt {attempts}, the next in {pause_s:.1} s"),
        });
        // Commands of the meantime would be old later.
        let over = tokio::time::sleep(pause);
        tokio::pin!(over);
        loop {
            tokio::select! {
                () = &mut over => break,
                command = commands.recv() => if command.is_none() { return },
            }
        }
        pause = (2 * pause).min(PAUSES[1]);
    }
}

/// Whether the server does not let the caller in.
fn is_denied(error: &Error) -> bool {
    use tonic::Code::{PermissionDenied, Unauthenticated};
    matches!(error, Error::Call(status) if [Unauthenticated, PermissionDenied].contains(&status.code()))
}

/// Deletes the session that was made for the target, if there is one. A server that can't be reached deletes it later by
/// itself.
pub(super) async fn delete_made(server: Server, shared: &Shared) {
    let made = shared.inbound().made.take();
    let Some(session_id) = made else { return };
    let deleting = async {
        let mut sessions = SessionServiceClient::new(server.within(SILENCE).connect().await?);
        sessions.delete_session(pb::DeleteSessionRequest { session_id }).await?;
        Ok::<(), Error>(())
    };
    let _ = tokio::time::timeout(SILENCE, deleting).await;
}

/// The session of a target.
async fn session(target: &Target, shared: &Shared, channel: Channel) -> Result<pb::Session, Error> {
    let mut sessions = SessionServiceClient::new(channel);
    let made = shared.inbound().made.clone();
    let (id, scene) = match &target.session {
        Session::Existing(id) => (Some(id), None),
        Session::New { scene } => (made.as_ref(), Some(scene)),
    };
    let mut known = None;
    if let Some(id) = id {
        let request = pb::GetSessionRequest { session_id: id.clone() };
        known = match sessions.get_session(request).await {
            Ok(answer) => answer.into_inner().session,
            // The server was restarted and no longer has the session.
            Err(status) if status.code() == tonic::Code::NotFound && scene.is_some() => None,
            Err(status) => return Err(status.into()),
        };
    }
    if let (None, Some(scene)) = (&known, scene) {
        let source = pb::create_session_request::Source::SceneName(scene.clone());
        let request = pb::CreateSessionRequest { source: Some(source), ..Default::default() };
        known = sessions.create_session(request).await?.into_inner().session;
        shared.inbound().made = known.as_ref().map(|session| session.session_id.clone());
    }
    known.ok_or_else(|| broken("the server sent no session"))
}

/// The middle of a session's tissue at rest, m.
fn middle_m(session: &pb::Session) -> Result<DVec3, Error> {
    let extent = session.extent.as_ref().ok_or_else(|| broken("the server does not tell where the tissue is"))?;
    Ok(from_vector(extent.middle_m.as_ref()))
}

fn broken(why: &str) -> Error {
    Error::Connection(why.to_owned())
}

/// The law in a message.
fn law(message: &pb::ForceLaw) -> Result<Law, Error> {
    touch::from_law(message).map_err(|refusal| Error::Connection(refusal.to_string()))
}

/// One connection, until it breaks or `commands` ends.
async fn connect(
    target: &Target,
    device: &Device,
    shared: &Shared,
    commands: &mut mpsc::Receiver<Command>,
    warn: &(impl Fn(&str) + Sync),
) -> Result<(), Error> {
    let channel = target.server.clone().within(SILENCE).connect().await?;
    let session = session(target, shared, channel.clone()).await?;
    let middle_m = middle_m(&session)?;
    let (outbound, messages) = mpsc::channel(COMMANDS);
    let open = pb::TouchOpen {
        session_id: session.session_id,
        tools: vec![target.tool],
        holder: target.holder.clone(),
        device: Some(touch::device(device)),
        deadband: (target.deadband > 0.0)
            .then(|| pb::Deadband { rendered_fraction: Some(target.deadband), ..Default::default() }),
        heartbeat_s: Some(HEARTBEAT_S),
        tip: Some(touch::tip(&target.tip)),
        // A bridge that hangs must not hold a tool for long.
        lease_s: Some(SILENCE.as_secs_f64()),
        datagrams: target.datagrams,
        ..Default::default()
    };
    let silent = |_| broken("the server is silent");
    let opening = Touch::open(channel, open, ReceiverStream::new(messages));
    let mut stream = tokio::time::timeout(SILENCE, opening).await.map_err(silent)??;
    stream.opened().warnings.iter().for_each(|warning| warn(warning));
    let first = stream.opened().law.as_ref().ok_or_else(|| broken("the server sent no force law"))?;
    let first = law(first)?;
    {
        let mut inbound = shared.inbound();
        inbound.traffic.connections += 1;
        inbound.failure = None;
        (inbound.law, inbound.further) = (Some(first), Vec::new());
        (inbound.newest, inbound.middle_m) = (None, middle_m);
    }
    // Commands that waited while the stream was opened are old.
    while commands.try_recv().is_ok() {}
    let mut sequence = 0;
    let mut datagrams = Datagrams::dial(stream.opened().datagrams.as_ref(), &target.server);
    // Those of earlier connections.
    let before = shared.inbound().traffic.carried;
    let take = |sample: &pb::Sample, datagrams: &mut Datagrams| {
        let now = datagrams.carried();
        let mut inbound = shared.inbound();
        inbound.traffic.samples += 1;
        inbound.traffic.bytes += touch::wire_bytes(sample);
        inbound.traffic.carried = Carried {
            sent: before.sent + now.sent,
            came: before.came + now.came,
            fell_back: before.fell_back + now.fell_back,
        };
        inbound.wanted_s = datagrams.wanted_s();
        if let Some(model) = sample.tools.first().and_then(|tool| tool.local_model.as_ref()) {
            let model = touch::from_local_model(model, sample.step);
            if inbound.newest.as_ref().is_none_or(|newest| newest.sequence < model.sequence) {
                inbound.newest = Some(model);
            }
        }
    };
    loop {
        tokio::select! {
            heard = tokio::time::timeout(SILENCE, stream.next()) => {
                match heard.map_err(silent)??.ok_or_else(|| broken("the server has ended the stream"))? {
                    Heard::ForceLaw(update) => match update.law {
                        Some(message) => {
                            let law = law(&message)?;
                            let further = &mut shared.inbound().further;
                            if further.len() == MOST_LAWS {
                                further.remove(0);
                            }
                            further.push((message.number, law));
                        }
                        None => {
                            let stays = if update.tissue_step.is_some() { "that of the old tissue" } else { "a coarse one" };
                            warn(&format!("the force law stays {stays}: {} ({})", update.message, update.reason));
                        }
                    },
                    Heard::Sample(sample) => {
                        if sample.held {
                            return Err(broken("the session was stopped by its guard"));
                        }
                        if datagrams.is_newer(&sample) {
                            take(&sample, &mut datagrams);
                        }
                    }
                    Heard::Rejection(rejection) => {
                        shared.inbound().traffic.refused += 1;
                        // This side was silent for so long that the server released the tool.
                        if rejection.reason == Reason::NotHolder.as_str() {
                            return Err(broken("the lease of the tool has lapsed"));
                        }
                    }
                    Heard::Renewed(renewed) => renewed.datagrams.iter().for_each(|offer| datagrams.take_offer(offer)),
                    Heard::Opened(_) => {}
                }
            }
            sample = datagrams.next() => take(&sample, &mut datagrams),
            command = commands.recv() => {
                let Some(Command { client_time_ns, place_m, velocity_m_per_s }) = command else { return Ok(()) };
                sequence += 1;
                let velocity_m_per_s = velocity_m_per_s.and_then(vector);
                let pose = pb::Pose { velocity_m_per_s, ..touch::pose(place_m, &target.tip) };
                let action = Some(Action::Pose(pose));
                let (tool, sequence) = (target.tool, Some(sequence));
                let command = pb::Command { tool, sequence, client_time_ns, action, ..Default::default() };
                shared.inbound().traffic.poses += 1;
                if datagrams.asks() {
                    // If it does not get through it is asked again.
                    let _ = outbound.try_send(Say::Renew(pb::Renew { client_time_ns, datagrams: true }));
                }
                if datagrams.send(&command) {
                    continue;
                }
                // If the network does not keep up, this command is dropped; the next is newer.
                if let Err(mpsc::error::TrySendError::Closed(_)) = outbound.try_send(Say::Command(command)) {
                    return Err(broken("the stream is closed"));
                }
            }
        }
    }
}
