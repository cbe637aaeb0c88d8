//! Attacks that have the server work for them.

use std::time::Duration;

use bytes::{BufMut, Bytes};
use futures_util::future::join_all;
use palpate_proto::pb;
use pb::touch_request::Message as Say;
use prost::Message;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::codec::{Codec, DecodeBuf, Decoder, EncodeBuf, Encoder};
use tonic::{Request, Status};

use super::Ground;
use super::memory::{fill, fixed, lease, narrow, push_everywhere, send};
use crate::caller::{MIDDLE, SIDE, create, haptics, push, push_all, sessions, sheet};

/// An attacker waits so long for what may never come.
const CALL_TIMEOUT: Duration = Duration::from_secs(3);

/// `work`, unless it takes too long.
async fn within<T>(work: impl Future<Output = Result<T, Status>>) -> Result<T, Status> {
    let given_up = |_| Err(Status::deadline_exceeded("nothing came"));
    tokio::time::timeout(CALL_TIMEOUT, work).await.unwrap_or_else(given_up)
}

pub async fn endless_scene(ground: &Ground) -> Result<(), Status> {
    let mut scene = sheet(2, 2);
    scene.sheet.get_or_insert_default().point_mass_kg = Some(1e-12);
    scene.springs = Some(pb::Springs { stiffness_n_per_m: Some(1e12), ..Default::default() });
    scene.anchor_springs.get_or_insert_default().stiffness_n_per_m = Some(1.0);
    scene.damping.get_or_insert_default().coefficient_n_s_per_m = Some(0.0);
    scene.stepping = Some(pb::Stepping { rate_hz: Some(1.0), substeps: Some(1), ..Default::default() });
    loop {
        ground.strike();
        let door = ground.caller.door().await?;
        ground.heard(within(create(&door, scene.clone(), true)).await);
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

pub async fn big_law(ground: &Ground) -> Result<(), Status> {
    let (door, side) = (ground.caller.door().await?, ground.side(331));
    let mut scene = sheet(side, side);
    scene.anchor_springs.get_or_insert_default().stiffness_n_per_m = Some(1e-6);
    let session_id = within(create(&door, scene, true)).await?;
    loop {
        ground.strike();
        let device = pb::Device {
            name: "siege".into(),
            max_force_n: 3.3,
            continuous_force_n: 1.0,
            max_stiffness_n_per_m: 2000.0,
            max_damping_n_s_per_m: 10.0,
            workspace_radius_m: 1.0,
            max_torque_n_m: 0.0,
        };
        let open = pb::TouchOpen { session_id: session_id.clone(), device: Some(device), ..Default::default() };
        let say = tokio_stream::once(pb::TouchRequest { message: Some(Say::Open(open)) });
        let opened = async {
            // Kept open until the answer.
            let mut inbound = haptics(&door).touch(say.chain(tokio_stream::pending())).await?.into_inner();
            inbound.message().await
        };
        ground.heard(within(opened).await);
    }
}

pub async fn fixed_positions(ground: &Ground) -> Result<(), Status> {
    let door = ground.caller.door().await?;
    let session_id = create(&door, fixed(ground.count(500_000)), false).await?;
    let lease_id = lease(&door, &session_id, 0).await?;
    let target = Some(pb::position::Target::DisplacementM(pb::Vector3::default()));
    let position = pb::Position { point: Some(pb::GridPoint { x: SIDE / 2, y: SIDE / 2 }), vertex: None, target };
    let mut first = 1;
    loop {
        let command = |sequence| pb::Command {
            sequence: Some(sequence),
            action: Some(pb::command::Action::Position(position)),
            ..Default::default()
        };
        let commands = (first..first + 4096).map(command).collect();
        first += 4096;
        ground.strike();
        ground.heard(send(&door, &session_id, &lease_id, commands).await);
    }
}

/// Messages as they are.
#[derive(Clone, Copy)]
struct Raw;

impl Codec for Raw {
    type Encode = Bytes;
    type Decode = ();
    type Encoder = Raw;
    type Decoder = Raw;

    fn encoder(&mut self) -> Raw {
        Raw
    }

    fn decoder(&mut self) -> Raw {
        Raw
    }
}

impl Encoder for Raw {
    type Item = Bytes;
    type Error = Status;

    fn encode(&mut self, message: Bytes, buffer: &mut EncodeBuf<'_>) -> Result<(), Status> {
        buffer.put(message);
        Ok(())
    }
}

impl Decoder for Raw {
    type Item = ();
    type Error = Status;

    fn decode(&mut self, buffer: &mut DecodeBuf<'_>) -> Result<Option<()>, Status> {
        bytes::Buf::advance(buffer, bytes::Buf::remaining(buffer));
        Ok(Some(()))
    }
}

pub async fn empty_commands(ground: &Ground) -> Result<(), Status> {
    let door = ground.caller.door().await?;
    let session_id = create(&door, sheet(SIDE, SIDE), true).await?;
    let lease_id = lease(&door, &session_id, 0).await?;
    let mut message = pb::SendCommandsRequest { session_id, lease_id, commands: Vec::new() }.encode_to_vec();
    // Field 3, no bytes.
    for _ in 0..ground.count(500_000) {
        message.extend_from_slice(&[0x1a, 0]);
    }
    let message = Bytes::from(message);
    let mut grpc = tonic::client::Grpc::new(door);
    loop {
        let ready = grpc.ready().await;
        ready.map_err(|error| Status::unavailable(error.to_string()))?;
        let path = http::uri::PathAndQuery::from_static("/palpate.v1.HapticService/SendCommands");
        ground.strike();
        ground.heard(grpc.unary(Request::new(message.clone()), path, Raw).await);
    }
}

/// Opens probes of all points of a sheet at each step, and reads none of them.
pub async fn unread_probes(ground: &Ground, probes: u32, side: u32) -> Result<(), Status> {
    let session_id = create(&ground.caller.door().await?, sheet(side, side), false).await?;
    let mut unread = Vec::new();
    for _ in 0..ground.count(probes).div_ceil(100) {
        let door = narrow(ground).await?;
        for _ in 0..ground.count(probes).min(100) {
            let r#where = Some(pb::probe_request::Where::AllPoints(true));
            let request = pb::ProbeRequest { session_id: session_id.clone(), r#where, ..Default::default() };
            unread.extend(ground.heard(haptics(&door).probe(request).await).inspect(|_| ground.strike()));
        }
    }
    std::future::pending().await
}

pub async fn heavy_poked(ground: &Ground) -> Result<(), Status> {
    let (door, side) = (ground.caller.door().await?, ground.side(2000));
    let session_id = create(&door, sheet(side, side), false).await?;
    let lease_id = lease(&door, &session_id, 0).await?;
    for sequence in 1.. {
        ground.strike();
        ground.heard(send(&door, &session_id, &lease_id, vec![push_all(0, sequence, -0.01)]).await);
        tokio::time::sleep(Duration::from_millis(500)).await;
    }
    Ok(())
}

pub async fn stiff_change(ground: &Ground) -> Result<(), Status> {
    let door = ground.caller.door().await?;
    let session_id = create(&door, sheet(SIDE, SIDE), false).await?;
    let request =
        pb::UpdateTissueRequest { session_id: session_id.clone(), stiffness_n_per_m: Some(1e9), ..Default::default() };
    ground.heard(within(sessions(&door).update_tissue(request)).await).inspect(|_| ground.strike());
    push_everywhere(&door, &session_id, -0.1).await?;
    std::future::pending().await
}

pub async fn woken_together(ground: &Ground) -> Result<(), Status> {
    let mut resting = Vec::new();
    // No connection makes more in one go.
    for _ in 0..4 {
        let door = ground.caller.door().await?;
        for _ in 0..ground.count(100) {
            let Some(session_id) = ground.heard(create(&door, sheet(SIDE, SIDE), false).await) else { break };
            let Some(lease_id) = ground.heard(lease(&door, &session_id, 0).await) else { break };
            resting.push((door.clone(), session_id, lease_id));
        }
    }
    for sequence in 1.. {
        let wake = async |(door, session_id, lease_id): &(_, String, String)| {
            let command = pb::Command { time_to_live_s: Some(0.2), ..push_all(0, sequence, -0.1) };
            ground.heard(send(door, session_id, lease_id, vec![command]).await).inspect(|()| ground.strike());
        };
        join_all(resting.iter().map(wake)).await;
        tokio::time::sleep(Duration::from_millis(500)).await;
    }
    Ok(())
}

pub async fn polling(ground: &Ground) -> Result<(), Status> {
    let door = ground.caller.door().await?;
    let session_id = create(&door, sheet(SIDE, SIDE), true).await?;
    ground.heard(fill(ground, &door, &session_id).await);
    let each = async || {
        loop {
            let request = pb::GetSessionRequest { session_id: session_id.clone() };
            ground.heard(sessions(&door).get_session(request).await).inspect(|_| ground.strike());
        }
    };
    join_all((0..16).map(|_| each())).await;
    Ok(())
}

pub async fn hashes(ground: &Ground) -> Result<(), Status> {
    let (door, side) = (ground.caller.door().await?, ground.side(1024));
    let session_id = create(&door, sheet(side, side), true).await?;
    push_everywhere(&door, &session_id, -0.01).await?;
    // A few steps in which every point moves; then time stands still.
    let request = pb::StartSessionRequest { session_id: session_id.clone(), until_step: Some(3) };
    sessions(&door).start_session(request).await?;
    let mut tick = tokio::time::interval(Duration::from_millis(125));
    loop {
        tick.tick().await;
        let request = pb::GetStateHashRequest { session_id: session_id.clone(), at_step: None };
        ground.heard(sessions(&door).get_state_hash(request).await).inspect(|_| ground.strike());
    }
}

pub async fn command_flood(ground: &Ground) -> Result<(), Status> {
    let door = ground.caller.door().await?;
    let session_id = create(&door, sheet(SIDE, SIDE), false).await?;
    let say = |message| pb::TouchRequest { message: Some(message) };
    let (sender, receiver) = tokio::sync::mpsc::channel(64);
    let open = pb::TouchOpen { session_id, tools: vec![0], ..Default::default() };
    let _ = sender.send(say(Say::Open(open))).await;
    let mut inbound = haptics(&door).touch(ReceiverStream::new(receiver)).await?.into_inner();
    let writing = async {
        // A hundred a millisecond, or what the transport lets through, until the stream is ended.
        let mut tick = tokio::time::interval(Duration::from_millis(1));
        for sequence in 1_u64.. {
            if sequence % 100 == 0 {
                tick.tick().await;
            }
            if sender.send(say(Say::Command(push(0, sequence, MIDDLE, -1.0)))).await.is_err() {
                break;
            }
            ground.strike();
        }
        // The reason is yet to be read.
        std::future::pending::<()>().await;
    };
    let reading = async {
        while inbound.message().await?.is_some() {}
        Ok(())
    };
    tokio::select! {
        () = writing => Ok(()),
        ended = reading => ended,
    }
}

pub async fn create_and_drop(ground: &Ground) -> Result<(), Status> {
    let door = ground.caller.door().await?;
    loop {
        ground.strike();
        let Some(session_id) = ground.heard(create(&door, sheet(SIDE, SIDE), false).await) else { continue };
        ground.heard(sessions(&door).delete_session(pb::DeleteSessionRequest { session_id }).await);
    }
}
