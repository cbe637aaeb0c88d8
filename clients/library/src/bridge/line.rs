//! The network side of a bridge: connects, opens a haptic stream, and transfers commands and models. When the
//! connection breaks, it connects again; in a fleet, to the server that has the session then.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use glam::DVec3;
use palpate_haptics::datagram_health::Carried;
use palpate_haptics::deadband::HEARTBEAT_S;
use palpate_haptics::{Device, Instrument};
use palpate_proto::geometry::{from_vector, vector};
use palpate_proto::{instrument as of_instrument, pb, touch};
use palpate_refusal::Reason;
use palpate_refusal::status::elsewhere;
use pb::command::Action;
use pb::session_service_client::SessionServiceClient;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use tokio::sync::{Notify, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tonic_types::StatusExt;

use super::copy_fetch::{Copier, Copying};
use super::cut_button::{CutButton, CuttingTip};
use super::ticker::{LoopFeed, ToolPose};
use super::{Copies, SessionChoice, Target};
use crate::Error;
use crate::connect::Server;
use crate::datagrams::Datagrams;
use crate::exchange::QueueReader;
use crate::fleet::{AGAIN, At, Trail, follow};
use crate::touch::Touch;

/// The state of the network side, for the program. The loop of a device does not access it.
#[derive(Default)]
pub(super) struct Shared {
    inbound: Mutex<Inbound>,
    /// Notified when a connection has been opened.
    pub(super) opened: Notify,
}

/// The state of the network side.
#[derive(Default)]
pub(super) struct Inbound {
    pub(super) traffic: Traffic,
    /// Why the newest connection broke or could not be opened; `None` while there is one.
    pub(super) failure: Option<Error>,
    /// The session that was created for the target.
    pub(super) made: Option<String>,
    /// The server that last had the session.
    at: Option<Server>,
}

/// Totals of what was sent and received over all connections of a bridge so far.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Traffic {
    /// Number of connections that were opened.
    pub connections: u64,
    /// Number of samples that were used, by datagram or stream. Overtaken ones, and those of a server that no longer
    /// has the session, do not count.
    pub samples: u64,
    /// Bytes of these samples, each with the headers that a message of a stream has: gRPC, HTTP/2, TCP and IP.
    pub bytes: u64,
    /// Number of commands that the server refused.
    pub refused: u64,
    /// How often the jaws of the instrument exceeded their limit ([`palpate_haptics::Instrument::jaw_torque_limit_n_m`]).
    pub jaw_overloads: u64,
    /// Number of failed attempts to connect, and of connections that broke. Moves to a server that a refusal named do
    /// not count.
    pub failed: u64,
    /// Number of poses that the ticks passed to a connection, including those dropped because its stream did not keep
    /// up.
    pub poses: u64,
    /// Numbers of messages sent and received by datagram, and how often the stream took over again.
    pub carried: Carried,
    /// Largest displacement of the tissue under the middle of the tip, as reported in samples, m.
    pub deepest_m: f64,
}

impl Shared {
    pub(super) fn inbound(&self) -> MutexGuard<'_, Inbound> {
        self.inbound.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The commands of a loop, for the network side.
pub(super) struct Commands {
    pub(super) queue: QueueReader<ToolPose>,
    /// Notified when the queue has a command, or the loop has ended or is to end.
    pub(super) news: Arc<Notify>,
    /// Whether the loop is to end: then no more commands are sent.
    pub(super) is_stopped: Arc<AtomicBool>,
}

impl Commands {
    /// Returns the next command; `None` after the last. Dropping the future loses none.
    async fn recv(&mut self) -> Option<ToolPose> {
        loop {
            if self.is_stopped.load(Ordering::Relaxed) {
                return None;
            }
            let is_over = self.queue.is_over();
            if let Some(command) = self.queue.pop() {
                return Some(command);
            }
            if is_over {
                return None;
            }
            self.news.notified().await;
        }
    }
}

/// First and longest pause before another connection, which doubles in between.
const PAUSES: [Duration; 2] = [Duration::from_millis(100), Duration::from_secs(2)];

/// Limit on redirections to other servers without a sample in between; beyond it, waits as after a break.
const MAX_MOVES: u32 = 8;

/// Time without a message from the server after which the connection is given up.
pub(super) const SILENCE: Duration = Duration::from_secs(2);

/// Time limit for opening a stream. The server computes the first force law in that time, which takes seconds on a
/// busy machine; a client that gives up earlier makes it start again each time.
const OPENING: Duration = Duration::from_secs(8);

/// Number of steps between two samples of an instrument.
const INSTRUMENT_EVERY: u32 = 5;

/// Largest number of commands that wait for the stream.
const COMMANDS: usize = 64;

/// Keeps a connection open until `commands` ends; connects again whenever it breaks. Ends early if the first attempt
/// is refused.
#[allow(clippy::too_many_arguments)] // One caller, which has them all.
pub(super) async fn keep(
    target: Target,
    instrument: Option<Instrument>,
    cut_button: Option<CutButton>,
    copies: Option<Copies>,
    device: Device,
    shared: &Shared,
    mut feed: LoopFeed,
    mut commands: Commands,
    warn: &(impl Fn(&str) + Sync),
) {
    let copier = copies.map(Copier::new);
    let mut pause = PAUSES[0];
    // Failed attempts in a row.
    let mut attempts = 0_u64;
    // Redirections to other servers in a row.
    let mut moves = 0;
    let mut trail = Trail::new(target.server.clone().within(SILENCE));
    loop {
        let before = shared.inbound().traffic;
        let ended = connect(
            &target,
            instrument.as_ref(),
            cut_button,
            copier.as_ref(),
            &mut trail,
            &device,
            shared,
            &mut feed,
            &mut commands,
            warn,
        )
        .await;
        let Err(error) = ended else { return };
        // After a move the tool is still in the tissue, and continues with its lease; not after any other break.
        let went_on = moved_to(&error).is_none() && !std::mem::take(&mut trail.lease_id).is_empty();
        if went_on && is_of(&error, Reason::NotHolder) {
            continue;
        }
        if shared.inbound().traffic.samples > before.samples {
            moves = 0;
        }
        if let Some(endpoint) = moved_to(&error).filter(|_| moves < MAX_MOVES)
            && trail.go(&endpoint).is_ok()
        {
            moves += 1;
            let moved = format!("the session is at {endpoint} now");
            warn(&moved);
            shared.inbound().failure = Some(Error::Connection(moved));
            continue;
        }
        let traffic = {
            let mut inbound = shared.inbound();
            inbound.traffic.failed += 1;
            inbound.traffic
        };
        // Another attempt would be refused too, or would wait for a user who may hold the tool for hours.
        let is_final = error.is_refusal() || error.is_denied() || is_of(&error, Reason::ToolHeld);
        if traffic.connections == 0 && is_final {
            shared.inbound().failure = Some(error);
            return;
        }
        attempts = if traffic.connections > before.connections { 0 } else { attempts + 1 };
        if traffic.samples > before.samples {
            pause = PAUSES[0];
        }
        let tried = if attempts == 1 { "1 attempt".to_owned() } else { format!("{attempts} attempts") };
        if trail.is_awaited() {
            pause = pause.min(AGAIN);
        }
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
        // Commands from this pause would be outdated later.
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

/// Returns the endpoint of the server that has the session, if the error names one.
fn moved_to(error: &Error) -> Option<String> {
    let Error::Call(status) = error else { return None };
    elsewhere(status)
}

fn is_of(error: &Error, reason: Reason) -> bool {
    let Error::Call(status) = error else { return false };
    status.get_details_error_info().is_some_and(|info| info.reason == reason.as_str())
}

/// Deletes the session that was created for the target, if there is one. A server that can't be reached deletes it
/// later when it is idle.
pub(super) async fn delete_made(server: &Server, shared: &Shared) {
    let (made, at) = {
        let mut inbound = shared.inbound();
        (inbound.made.take(), inbound.at.take())
    };
    let Some(session_id) = made else { return };
    let request = pb::DeleteSessionRequest { session_id };
    let server = at.unwrap_or_else(|| server.clone()).within(SILENCE);
    let deleting = follow(&server, |channel| {
        let request = request.clone();
        async move { SessionServiceClient::new(channel).delete_session(request).await }
    });
    let _ = tokio::time::timeout(SILENCE, deleting).await;
}

/// Finds or creates the session of a target. Returns it with the server that has it.
async fn session(target: &Target, trail: &mut Trail, shared: &Shared) -> Result<At<pb::Session>, Error> {
    let made = shared.inbound().made.clone();
    let (id, scene) = match &target.session {
        SessionChoice::Existing(id) => (Some(id), None),
        SessionChoice::New { scene } => (made.as_ref(), Some(scene)),
    };
    let is_unknown = |error: &Error| matches!(error, Error::Call(status) if status.code() == tonic::Code::NotFound);
    let mut known = None;
    if let Some(id) = id {
        known = match trail.seek(id).await {
            Ok(at) => Some(at),
            // The server was restarted and no longer has the session.
            Err(error) if is_unknown(&error) && scene.is_some() => None,
            Err(error) => return Err(error),
        };
    }
    if let (None, Some(scene)) = (&known, scene) {
        let server = trail.server().clone();
        let channel = server.connect().await?;
        let source = pb::create_session_request::Source::SceneName(scene.clone());
        let request = pb::CreateSessionRequest { source: Some(source), ..Default::default() };
        let created = SessionServiceClient::new(channel.clone()).create_session(request).await?.into_inner().session;
        let created = created.ok_or_else(|| broken("the server sent no session"))?;
        {
            let mut inbound = shared.inbound();
            inbound.made = Some(created.session_id.clone());
            inbound.at = Some(server.clone());
        }
        known = Some(match &created.ownership {
            // A fleet may have created it on another server.
            Some(_) => trail.seek(&created.session_id).await?,
            None => At { server, channel, answer: created },
        });
    }
    let known = known.ok_or_else(|| broken("the server sent no session"))?;
    shared.inbound().at = Some(known.server.clone());
    Ok(known)
}

/// Returns the place of a device's origin in a session's tissue, m: the top of its surface; its middle if the server
/// does not send the top.
fn origin_m(session: &pb::Session) -> Result<DVec3, Error> {
    let extent = session.extent.as_ref().ok_or_else(|| broken("the server does not report where the tissue is"))?;
    Ok(from_vector(extent.top_m.as_ref().or(extent.middle_m.as_ref())))
}

fn broken(why: &str) -> Error {
    Error::Connection(why.to_owned())
}

/// Runs one connection, until it breaks or `commands` ends.
#[allow(clippy::too_many_arguments)] // One caller, which has them all.
async fn connect(
    target: &Target,
    instrument: Option<&Instrument>,
    cut_button: Option<CutButton>,
    copier: Option<&Copier>,
    trail: &mut Trail,
    device: &Device,
    shared: &Shared,
    feed: &mut LoopFeed,
    commands: &mut Commands,
    warn: &(impl Fn(&str) + Sync),
) -> Result<(), Error> {
    let At { server, channel, answer: session } = session(target, trail, shared).await?;
    let origin_m = origin_m(&session)?;
    let mut copying = Copying::new(
        copier,
        &session,
        channel.clone(),
        instrument.cloned().unwrap_or_else(|| Instrument::of_tip(target.tip)),
    );
    let (outbound, messages) = mpsc::channel(COMMANDS);
    let open = pb::TouchOpen {
        session_id: session.session_id,
        tools: (target.tool..).take(instrument.map_or(1, |instrument| instrument.tips.len())).collect(),
        instruments: instrument
            .map(|instrument| of_instrument::instrument(instrument, target.tool))
            .into_iter()
            .collect(),
        // A copy is corrected by samples; each has all tips.
        sample_every_steps: instrument.map(|_| INSTRUMENT_EVERY),
        holder: target.holder.clone(),
        // A device gets local models of single tips.
        device: instrument.is_none().then(|| touch::device(device)),
        deadband: (target.deadband > 0.0)
            .then(|| pb::Deadband { rendered_fraction: Some(target.deadband), ..Default::default() }),
        heartbeat_s: Some(HEARTBEAT_S),
        tip: Some(touch::tip(&target.tip)),
        // A bridge that hangs must not hold a tool for long.
        lease_s: Some(SILENCE.as_secs_f64()),
        datagrams: target.datagrams,
        lease_id: trail.lease_id.clone(),
        other_tools: copying.is_wanted(),
        ..Default::default()
    };
    let silent = |_| broken("the server is silent");
    let opening = Touch::open(channel, open, ReceiverStream::new(messages));
    let mut stream = tokio::time::timeout(OPENING, opening).await.map_err(silent)??;
    trail.lease_id.clone_from(&stream.opened().lease_id);
    stream.opened().warnings.iter().for_each(|warning| warn(warning));
    let first = stream.opened().law.as_ref();
    if first.is_none() && instrument.is_none() {
        return Err(broken("the server sent no force law"));
    }
    feed.begin(first, origin_m)?;
    // From now on the stream reports every change of the tissue.
    copying.begin();
    {
        let mut inbound = shared.inbound();
        inbound.traffic.connections += 1;
        inbound.failure = None;
    }
    shared.opened.notify_one();
    // Commands that waited while the stream was opened are outdated.
    while commands.queue.pop().is_some() {}
    let mut cutting = cut_button.map(|button| CuttingTip::new(target.tip, button));
    // The sequence of the newest release. Until the server has it, poses follow it by the stream: a datagram would overtake it.
    let mut released = 0;
    let mut newest_release = 0;
    let mut datagrams = Datagrams::dial(stream.opened().datagrams.as_ref(), &server);
    // Counts of earlier connections.
    let before = shared.inbound().traffic.carried;
    let take = |sample: &pb::Sample, datagrams: &mut Datagrams, copying: &mut Copying, feed: &mut LoopFeed| {
        copying.look(sample.topology_version);
        let now = datagrams.carried();
        {
            let mut inbound = shared.inbound();
            inbound.traffic.samples += 1;
            inbound.traffic.bytes += touch::wire_bytes(sample);
            // The mean over a tip, `displacement_m`, lies off the surface where that is curved, even at rest.
            for moved_m in sample.tools.iter().filter_map(|tool| tool.surface_displacement_m) {
                let deep_m = DVec3::new(moved_m.x, moved_m.y, moved_m.z).length();
                inbound.traffic.deepest_m = inbound.traffic.deepest_m.max(deep_m);
            }
            inbound.traffic.carried = Carried {
                sent: before.sent + now.sent,
                came: before.came + now.came,
                fell_back: before.fell_back + now.fell_back,
            };
        }
        feed.receive(sample, datagrams.wanted_s());
    };
    let look = |sample: &pb::Sample, cutting: &mut Option<CuttingTip>, released: &mut u64| {
        let Some(tool) = sample.tools.iter().find(|tool| tool.tool == target.tool) else { return };
        cutting.iter_mut().for_each(|cutting| cutting.take(tool));
        if tool.acknowledged_sequence > *released {
            *released = 0;
        }
    };
    loop {
        tokio::select! {
            heard = tokio::time::timeout(SILENCE, stream.next()) => {
                match heard.map_err(silent)??.ok_or_else(|| broken("the server has ended the stream"))? {
                    Heard::ForceLaw(update) => {
                        let is_other_tissue = update.tissue_step.is_some();
                        if is_other_tissue {
                            feed.predict(None);
                            copying.begin();
                        }
                        match update.law {
                            Some(message) => feed.learn(&message)?,
                            None if instrument.is_some() => {}
                            None => {
                                let stays = if is_other_tissue { "that of the old tissue" } else { "a coarse one" };
                                warn(&format!("the force law stays {stays}: {} ({})", update.message, update.reason));
                            }
                        }
                    }
                    Heard::Sample(sample) => {
                        if sample.held {
                            return Err(broken("the session was stopped by its guard"));
                        }
                        if trail.is_current(sample.ownership_revision) && datagrams.is_newer(&sample) {
                            look(&sample, &mut cutting, &mut released);
                            take(&sample, &mut datagrams, &mut copying, feed);
                        }
                    }
                    // A datagram with the tip of before that the release has overtaken.
                    Heard::Rejection(rejection)
                        if rejection.sequence < newest_release && rejection.reason == Reason::OutOfTurn.as_str() => {}
                    Heard::Rejection(rejection) => {
                        shared.inbound().traffic.refused += 1;
                        if rejection.reason == Reason::OutOfTurn.as_str() {
                            // Such a datagram came between the release and the first pose with the other tip.
                            cutting.iter_mut().for_each(CuttingTip::release_again);
                        }
                        // This side was silent for so long that the server has released the tool.
                        if rejection.reason == Reason::NotHolder.as_str() {
                            return Err(broken("the lease of the tool has expired"));
                        }
                    }
                    Heard::Renewed(renewed) => renewed.datagrams.iter().for_each(|offer| datagrams.take_offer(offer)),
                    Heard::JawOverload(overload) => {
                        shared.inbound().traffic.jaw_overloads += 1;
                        let pb::JawOverload { first_tool, step, torque_n_m, limit_n_m } = overload;
                        warn(&format!(
                            "the jaws of the instrument with tool {first_tool} crush what they hold: at step {step} the torque \
                             between them was {torque_n_m:.3e} N·m, above its limit of {limit_n_m:.3e} N·m"
                        ));
                    }
                    Heard::Opened(_) => {}
                }
            }
            made = copying.next() => match made {
                Ok(copy) => feed.predict(Some(copy)),
                Err(error) if instrument.is_some() => warn(&format!("nothing is rendered: there is no copy of the tissue: {error}")),
                Err(error) => warn(&format!("forces come from local models alone, without a copy of the tissue: {error}")),
            },
            sample = datagrams.next() => {
                if trail.is_current(sample.ownership_revision) {
                    look(&sample, &mut cutting, &mut released);
                    take(&sample, &mut datagrams, &mut copying, feed);
                }
            }
            command = commands.recv() => {
                let Some(ToolPose { client_time_ns, pose, velocity_m_per_s, orientation, buttons }) = command else {
                    drop(outbound);
                    // The server ends its part once it has released the tool.
                    end_of(&mut stream).await;
                    return Ok(());
                };
                let led = cutting.as_mut().map(|cutting| cutting.next(pose.place_m, orientation, buttons));
                let (tip, is_released) = led.unwrap_or((target.tip, false));
                if is_released {
                    trail.sequence += 1;
                    (released, newest_release) = (trail.sequence, trail.sequence);
                    let (tool, sequence, action) = (target.tool, Some(released), Some(Action::Release(pb::Release {})));
                    let release = pb::Command { tool, sequence, client_time_ns, action, ..Default::default() };
                    // It must not be dropped, as the next pose has another tip. Samples wait meanwhile.
                    if outbound.send(Say::Command(release)).await.is_err() {
                        return Err(end_of(&mut stream).await);
                    }
                }
                trail.sequence += 1;
                let velocity_m_per_s = velocity_m_per_s.and_then(vector);
                let action = Some(match instrument {
                    Some(_) => Action::Instrument(of_instrument::pose(&pose)),
                    None => Action::Pose(pb::Pose { velocity_m_per_s, ..touch::pose(pose.place_m, &tip) }),
                });
                let (tool, sequence) = (target.tool, Some(trail.sequence));
                let command = pb::Command { tool, sequence, client_time_ns, action, ..Default::default() };
                shared.inbound().traffic.poses += 1;
                if datagrams.asks() {
                    // If it does not get through, a later tick requests it again.
                    let _ = outbound.try_send(Say::Renew(pb::Renew { client_time_ns, datagrams: true }));
                }
                if released == 0 && datagrams.send(&command) {
                    continue;
                }
                // If the network does not keep up, this command is dropped; the next one replaces it.
                if let Err(mpsc::error::TrySendError::Closed(_)) = outbound.try_send(Say::Command(command)) {
                    return Err(end_of(&mut stream).await);
                }
            }
        }
    }
}

/// Returns why the server has ended a stream: reads the messages that it sent before the reason.
async fn end_of(stream: &mut Touch) -> Error {
    let reason = async {
        loop {
            match stream.next().await {
                Ok(Some(_)) => {}
                Ok(None) => return broken("the server has ended the stream"),
                Err(status) => return status.into(),
            }
        }
    };
    tokio::time::timeout(SILENCE, reason).await.unwrap_or_else(|_| broken("the stream is closed"))
}
