//! Nothing that the protocol forbids: random calls with random arguments, by seed.

use std::time::Duration;

use fastrand::Rng;
use palpate_proto::pb;
use pb::touch_request::Message as Say;
use tonic::{Status, Streaming};

use super::Ground;
use super::memory::{lease, send};
use crate::caller::{Door, create, haptics, push, push_all, sessions, sheet, views};

/// Sessions and streams of one attacker at a time.
const SESSIONS: usize = 6;
const STREAMS: usize = 24;

/// No call is waited for any longer.
const CALL_TIMEOUT: Duration = Duration::from_secs(3);

/// Open streams, which may be read.
enum OpenStream {
    Samples(Streaming<pb::WatchSamplesResponse>),
    Records(Streaming<pb::ProbeResponse>),
    Frames(Streaming<pb::WatchFramesResponse>),
    Mesh(Streaming<pb::GetMeshResponse>),
    Texture(Streaming<pb::GetTextureResponse>),
    Script(Streaming<pb::GetScriptResponse>),
    Touch(Streaming<pb::TouchResponse>, tokio::sync::mpsc::Sender<pb::TouchRequest>),
}

impl OpenStream {
    /// Reads one message. Returns the acknowledgement to send, if it is a frame.
    async fn read(&mut self) -> Result<Option<pb::AcknowledgeFramesRequest>, Status> {
        match self {
            OpenStream::Samples(stream) => stream.message().await.map(|_| None),
            OpenStream::Records(stream) => stream.message().await.map(|_| None),
            OpenStream::Frames(stream) => {
                let frame = stream.message().await?;
                Ok(frame.map(|f| pb::AcknowledgeFramesRequest { viewer_id: f.viewer_id, frame_id: f.frame_id }))
            }
            OpenStream::Mesh(stream) => stream.message().await.map(|_| None),
            OpenStream::Texture(stream) => stream.message().await.map(|_| None),
            OpenStream::Script(stream) => stream.message().await.map(|_| None),
            OpenStream::Touch(stream, _) => stream.message().await.map(|_| None),
        }
    }
}

/// A number between the two, each power of ten as likely as any other.
fn decades(random: &mut Rng, from: f64, to: f64) -> f64 {
    (from.ln() + (to.ln() - from.ln()) * random.f64()).exp()
}

fn scene(ground: &Ground, random: &mut Rng) -> pb::Scene {
    let most = f64::from(ground.side(400));
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let mut side = || decades(random, 2.0, most.max(4.0)) as u32;
    let mut scene = sheet(side(), side());
    scene.springs.get_or_insert_default().stiffness_n_per_m = Some(decades(random, 0.1, 1000.0));
    scene.anchor_springs.get_or_insert_default().stiffness_n_per_m = Some(decades(random, 0.01, 100.0));
    scene.damping.get_or_insert_default().coefficient_n_s_per_m = Some(decades(random, 0.01, 10.0));
    scene.stepping.get_or_insert_default().rate_hz = Some([50.0, 250.0, 1000.0, 2000.0][random.usize(..4)]);
    scene
}

fn command(random: &mut Rng, tool: u32, sequence: u64) -> pb::Command {
    let z = -random.f64();
    let mut command = match random.u8(..4) {
        0 => push_all(tool, sequence, 0.01 * z),
        1 => pb::Command {
            action: Some(pb::command::Action::Release(pb::Release {})),
            ..push(tool, sequence, [0, 0], z)
        },
        2 => {
            let position_m = Some(pb::Vector3 { x: 0.05 * random.f64(), y: 0.05 * random.f64(), z: 0.01 * z });
            let pose = pb::Pose { position_m, ..Default::default() };
            pb::Command { action: Some(pb::command::Action::Pose(pose)), ..push(tool, sequence, [0, 0], z) }
        }
        _ => push(tool, sequence, [0, 1], 0.1 * z),
    };
    command.time_to_live_s = random.bool().then_some(0.05);
    command.at_step = (random.u8(..8) == 0).then(|| random.u64(..10_000));
    command
}

pub async fn calls(ground: &Ground) -> Result<(), Status> {
    let mut random = Rng::with_seed(ground.seed);
    let door = ground.caller.door().await?;
    let (mut mine, mut streams, mut sequence) = (Vec::new(), Vec::new(), 0);
    loop {
        sequence += 1;
        let called = call(ground, &door, &mut random, &mut mine, &mut streams, sequence);
        let called = tokio::time::timeout(CALL_TIMEOUT, called).await;
        let called = called.unwrap_or_else(|_| Err(Status::deadline_exceeded("no answer")));
        // A caller that has lost its connection opens another.
        if called.as_ref().is_err_and(|status| status.code() == tonic::Code::Unavailable) {
            return called;
        }
        ground.heard(called).inspect(|()| ground.strike());
        while streams.len() > STREAMS {
            streams.swap_remove(random.usize(..streams.len()));
        }
    }
}

async fn call(
    ground: &Ground,
    door: &Door,
    random: &mut Rng,
    mine: &mut Vec<String>,
    streams: &mut Vec<OpenStream>,
    sequence: u64,
) -> Result<(), Status> {
    if mine.is_empty() || mine.len() < SESSIONS && random.u8(..8) == 0 {
        let paused = random.u8(..4) == 0;
        mine.push(create(door, scene(ground, random), paused).await?);
        return Ok(());
    }
    let session_id = mine[random.usize(..mine.len())].clone();
    let (refinement, tool) = (random.u32(..4), random.u32(..8));
    match random.u8(..18) {
        0 if random.u8(..4) == 0 => {
            mine.retain(|id| *id != session_id);
            sessions(door).delete_session(pb::DeleteSessionRequest { session_id }).await.map(drop)
        }
        0 | 1 => {
            let until_step = random.bool().then(|| random.u64(..10_000));
            sessions(door).start_session(pb::StartSessionRequest { session_id, until_step }).await.map(drop)
        }
        2 => sessions(door).pause_session(pb::PauseSessionRequest { session_id }).await.map(drop),
        3 => sessions(door).get_session(pb::GetSessionRequest { session_id }).await.map(drop),
        4 => sessions(door).get_state_hash(pb::GetStateHashRequest { session_id, at_step: None }).await.map(drop),
        5 => {
            let request = pb::UpdateTissueRequest {
                session_id,
                stiffness_n_per_m: random.bool().then(|| decades(random, 0.1, 1000.0)),
                damping_n_s_per_m: Some(decades(random, 0.01, 10.0)),
                ..Default::default()
            };
            sessions(door).update_tissue(request).await.map(drop)
        }
        6 => sessions(door).list_scripts(pb::ListScriptsRequest::default()).await.map(drop),
        7 => sessions(door).list_scenes(pb::ListScenesRequest {}).await.map(drop),
        8 => {
            let script_name = "vertical-60".to_owned();
            let script = sessions(door).get_script(pb::GetScriptRequest { session_id, script_name }).await?;
            streams.push(OpenStream::Script(script.into_inner()));
            Ok(())
        }
        9 => {
            let request = pb::WatchSamplesRequest { session_id, ..Default::default() };
            streams.push(OpenStream::Samples(haptics(door).watch_samples(request).await?.into_inner()));
            Ok(())
        }
        10 => {
            let r#where = Some(pb::probe_request::Where::AllPoints(true));
            let every_steps = Some(random.u32(1..20));
            let request =
                pb::ProbeRequest { session_id, r#where, every_steps, energy: random.bool(), tools: random.bool() };
            streams.push(OpenStream::Records(haptics(door).probe(request).await?.into_inner()));
            Ok(())
        }
        11 => {
            let request =
                pb::WatchFramesRequest { session_id, refinement, always_full: random.bool(), ..Default::default() };
            streams.push(OpenStream::Frames(views(door).watch_frames(request).await?.into_inner()));
            Ok(())
        }
        12 => {
            let mesh = views(door).get_mesh(pb::GetMeshRequest { session_id, refinement }).await?;
            streams.push(OpenStream::Mesh(mesh.into_inner()));
            Ok(())
        }
        13 => {
            let texture = views(door).get_texture(pb::GetTextureRequest { session_id, ..Default::default() }).await?;
            streams.push(OpenStream::Texture(texture.into_inner()));
            Ok(())
        }
        14 => {
            let lease_id = lease(door, &session_id, tool).await?;
            let commands = (1..random.u64(2..64)).map(|sequence| command(random, tool, sequence)).collect();
            let sent = send(door, &session_id, &lease_id, commands).await;
            let released = haptics(door).release_tool(pb::ReleaseToolRequest { session_id, lease_id }).await;
            sent.and(released.map(drop))
        }
        15 => {
            let (say, messages) = tokio::sync::mpsc::channel(256);
            let open = pb::TouchOpen { session_id, tools: vec![tool], lease_s: Some(5.0), ..Default::default() };
            let _ = say.send(pb::TouchRequest { message: Some(Say::Open(open)) }).await;
            for number in 1..random.u64(2..200) {
                let message = Some(Say::Command(command(random, tool, sequence * 1000 + number)));
                let _ = say.try_send(pb::TouchRequest { message });
            }
            let messages = tokio_stream::wrappers::ReceiverStream::new(messages);
            streams.push(OpenStream::Touch(haptics(door).touch(messages).await?.into_inner(), say));
            Ok(())
        }
        _ if streams.is_empty() => Ok(()),
        _ => {
            // Some of what came; the rest stays unread.
            let at = random.usize(..streams.len());
            for _ in 0..random.u8(..20) {
                let patience = Duration::from_millis(20);
                match tokio::time::timeout(patience, streams[at].read()).await {
                    Ok(Ok(Some(frame))) => drop(views(door).acknowledge_frames(frame).await?),
                    Ok(Ok(None)) => {}
                    Ok(Err(status)) => {
                        streams.swap_remove(at);
                        return Err(status);
                    }
                    Err(_) => break,
                }
            }
            Ok(())
        }
    }
}
