//! The network side of a bridge: connects, opens a haptic stream, passes commands and models on, and when something
//! breaks begins anew, for ever. What was not sent by then is dropped: nothing old is ever replayed.

use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use glam::DVec3;
use palpate::haptics::deadband::HEARTBEAT_S;
use palpate::haptics::renderer::MOST_LAWS;
use palpate::haptics::{Device, Law, LocalModel};
use palpate::scene::script::Action;
use palpate::scene::tip::Tip;
use palpate::wire::pb::haptic_service_client::HapticServiceClient;
use palpate::wire::pb::session_service_client::SessionServiceClient;
use palpate::wire::{self, pb};
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

use crate::connect::{Server, describe};

/// What the device's loop and the network pass to each other. The newest counts: neither waits.
#[derive(Default)]
pub(crate) struct Shared {
    inbound: Mutex<Inbound>,
}

/// What has arrived since it was last asked for.
#[derive(Default)]
pub(crate) struct Inbound {
    /// The law of a new connection.
    pub(crate) law: Option<Law>,
    /// Further laws of the newest connection, and their numbers, at most [`MOST_LAWS`].
    pub(crate) further: Vec<(u32, Law)>,
    /// The middle of the sheet, m.
    pub(crate) middle_m: DVec3,
    /// Of the newest connection.
    pub(crate) newest: Option<LocalModel>,
    /// Samples, bytes of them, and connections in all.
    pub(crate) samples: u64,
    pub(crate) bytes: u64,
    pub(crate) connections: u64,
    /// Commands that the server refused.
    pub(crate) refused: u64,
    /// The scene of the session, as the server has it.
    pub(crate) failure: Option<String>,
}

impl Shared {
    pub(crate) fn inbound(&self) -> std::sync::MutexGuard<'_, Inbound> {
        self.inbound.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Where a tool was, and when by the client's clock, ns.
pub(crate) type Command = (u64, DVec3);

/// What a bridge connects to.
#[derive(Debug, Clone)]
pub(crate) struct Target {
    pub(crate) server: Server,
    /// A session that is there, or a scene to make one of.
    pub(crate) session: Option<String>,
    /// The session that it has made.
    pub(crate) made: Option<String>,
    pub(crate) scene: String,
    pub(crate) tool: u32,
    pub(crate) tip: Tip,
    pub(crate) deadband: f64,
}

/// First and longest pause before it connects again.
const PAUSES: [Duration; 2] = [Duration::from_millis(100), Duration::from_secs(2)];

/// Without a word from the server for so long the connection is given up.
const SILENCE: Duration = Duration::from_secs(2);

/// Commands under way to the network at most: more would be a backlog.
pub(crate) const COMMANDS: usize = 64;

/// Keeps a connection until `commands` ends.
pub(crate) async fn keep(mut target: Target, device: Device, shared: &Shared, mut commands: mpsc::Receiver<Command>) {
    let mut pause = PAUSES[0];
    loop {
        let before = shared.inbound().samples;
        match connect(&mut target, &device, shared, &mut commands).await {
            Ok(()) => return,
            Err(message) => {
                crate::say!("palpate-client: warning: {message}; connecting again");
                shared.inbound().failure = Some(message);
            }
        }
        if shared.inbound().samples > before {
            pause = PAUSES[0];
        }
        // What the device says meanwhile is of no use to anybody later.
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

/// One connection, until it breaks or `commands` ends.
async fn connect(
    target: &mut Target,
    device: &Device,
    shared: &Shared,
    commands: &mut mpsc::Receiver<Command>,
) -> Result<(), String> {
    let channel = target.server.clone().within(SILENCE).connect().await?;
    let mut sessions = SessionServiceClient::new(channel.clone());
    let told = |status: tonic::Status| describe(&status);
    let mut known = None;
    if let Some(id) = target.session.as_ref().or(target.made.as_ref()) {
        let request = pb::GetSessionRequest { session_id: id.clone() };
        known = match sessions.get_session(request).await {
            Ok(answer) => answer.into_inner().session,
            // A server that was started anew has forgotten what we made.
            Err(status) if status.code() == tonic::Code::NotFound && target.session.is_none() => None,
            Err(status) => return Err(told(status)),
        };
    }
    if known.is_none() {
        let source = pb::create_session_request::Source::SceneName(target.scene.clone());
        let request = pb::CreateSessionRequest { source: Some(source), ..Default::default() };
        known = sessions.create_session(request).await.map_err(told)?.into_inner().session;
    }
    let session = known.ok_or("the server tells nothing of the session")?;
    target.made = Some(session.session_id.clone());
    let scene = session.scene.as_ref().ok_or("the server does not tell the session's scene")?;
    let sheet = scene.sheet.as_ref().ok_or("the server does not tell the scene's sheet")?;
    let spacing_m = sheet.spacing_m.unwrap_or(0.0);
    let middle = |points: Option<u32>| 0.5 * spacing_m * f64::from(points.unwrap_or(1).saturating_sub(1));
    let middle_m = DVec3::new(middle(sheet.points_x), middle(sheet.points_y), 0.0);

    let (outbound, messages) = mpsc::channel(COMMANDS);
    let say = |message: Say| pb::TouchRequest { message: Some(message) };
    let open = pb::TouchOpen {
        session_id: session.session_id.clone(),
        tools: vec![target.tool],
        holder: "palpate-client bridge".to_owned(),
        device: Some(wire::local::device(device)),
        deadband: (target.deadband > 0.0)
            .then(|| pb::Deadband { rendered_fraction: Some(target.deadband), ..Default::default() }),
        heartbeat_s: Some(HEARTBEAT_S),
        tip: Some(wire::command::tip(&target.tip)),
        // A bridge that hangs must not hold a tool for long.
        lease_s: Some(SILENCE.as_secs_f64()),
        ..Default::default()
    };
    outbound.send(say(Say::Open(open))).await.map_err(|e| e.to_string())?;
    let mut haptics = HapticServiceClient::new(channel);
    let mut touch = haptics.touch(ReceiverStream::new(messages)).await.map_err(told)?.into_inner();
    let mut sequence = 0;
    loop {
        tokio::select! {
            heard = tokio::time::timeout(SILENCE, touch.message()) => {
                let heard = heard.map_err(|_| "the server says nothing".to_owned())?.map_err(told)?;
                match heard.ok_or("the server has ended the stream")?.message {
                    Some(Heard::Opened(opened)) => {
                        opened.warnings.iter().for_each(|warning| crate::say!("palpate-client: warning: {warning}"));
                        let law = opened.law.as_ref().ok_or("the server sent no force law")?;
                        let law = wire::local::from_law(law).map_err(|refusal| refusal.to_string())?;
                        let mut inbound = shared.inbound();
                        inbound.connections += 1;
                        (inbound.law, inbound.further) = (Some(law), Vec::new());
                        (inbound.newest, inbound.middle_m) = (None, middle_m);
                    }
                    Some(Heard::ForceLaw(update)) => match update.law {
                        Some(message) => {
                            let law = wire::local::from_law(&message).map_err(|refusal| refusal.to_string())?;
                            let further = &mut shared.inbound().further;
                            if further.len() == MOST_LAWS {
                                further.remove(0);
                            }
                            further.push((message.number, law));
                        }
                        None => {
                            let (message, reason) = (update.message, update.reason);
                            let stays = if update.tissue_step.is_some() { "that of the old tissue" } else { "a coarse one" };
                            crate::say!("palpate-client: the force law stays {stays}: {message} ({reason})");
                        }
                    },
                    Some(Heard::Sample(sample)) => {
                        if sample.held {
                            return Err("the session was stopped by its guard".to_owned());
                        }
                        let mut inbound = shared.inbound();
                        inbound.samples += 1;
                        inbound.bytes += wire::local::wire_bytes(&sample);
                        if let Some(model) = sample.tools.first().and_then(|tool| tool.local_model.as_ref()) {
                            inbound.newest = Some(wire::local::from_local_model(model, sample.step));
                        }
                    }
                    Some(Heard::Rejection(rejection)) => {
                        shared.inbound().refused += 1;
                        // We were silent for so long that the tool was let go.
                        if rejection.reason == "NOT_HOLDER" {
                            return Err("the lease of the tool has lapsed".to_owned());
                        }
                    }
                    Some(Heard::Renewed(_)) | None => {}
                }
            }
            command = commands.recv() => {
                let Some((client_time_ns, place_m)) = command else { return Ok(()) };
                sequence += 1;
                let action = Action::Lead { place_m, tip: target.tip };
                let command = wire::command::now(target.tool, sequence, &action, client_time_ns);
                // A network that does not keep up: this one is dropped, the next is newer.
                if let Err(mpsc::error::TrySendError::Closed(_)) = outbound.try_send(say(Say::Command(command))) {
                    return Err("the stream is closed".to_owned());
                }
            }
        }
    }
}
