//! Attacks on the UDP port: packets that mean nothing, handshakes without end, tickets that are none, and a session that says too
//! much.

use std::net::SocketAddr;
use std::time::Duration;

use palpate_proto::pb;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use prost::Message;
use tokio::net::UdpSocket;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;
use wtransport::tls::Sha256Digest;
use wtransport::{ClientConfig, Connection, Endpoint};

use super::Ground;
use crate::caller::{SIDE, create, haptics, sheet};

fn broken(error: &impl std::error::Error) -> Status {
    Status::unavailable(error.to_string())
}

async fn socket(ground: &Ground) -> Result<UdpSocket, Status> {
    let socket = UdpSocket::bind("127.0.0.1:0").await.map_err(|error| broken(&error))?;
    socket.connect(ground.caller.address()).await.map_err(|error| broken(&error))?;
    Ok(socket)
}

/// Packets as fast as they go. `looks_right`: each begins like the first of a handshake, and is as long.
pub async fn packets(ground: &Ground, looks_right: bool) -> Result<(), Status> {
    let socket = socket(ground).await?;
    let mut random = fastrand::Rng::with_seed(ground.seed);
    let mut packet = vec![0; 1200];
    loop {
        random.fill(&mut packet);
        let length = if looks_right { 1200 } else { random.usize(1..1200) };
        if looks_right {
            // A long header, version 1, and connection ids of 8 bytes.
            packet[..6].copy_from_slice(&[0xc3, 0, 0, 0, 1, 8]);
            packet[14] = 8;
        }
        // A full buffer is no reason to stop.
        let _ = socket.send(&packet[..length]).await;
        ground.strike();
        if ground.strikes.load(std::sync::atomic::Ordering::Relaxed).is_multiple_of(64) {
            tokio::task::yield_now().await;
        }
    }
}

async fn dial(ground: &Ground, hash: &[u8], ticket: &[u8]) -> Result<Connection, Status> {
    let to: SocketAddr = ground.caller.address().parse().map_err(|error| broken(&error))?;
    let hash = Sha256Digest::new(hash.try_into().unwrap_or([0; 32]));
    let config = ClientConfig::builder().with_bind_address(([127, 0, 0, 1], 0).into());
    let config = config.with_server_certificate_hashes([hash]).build();
    let ticket: String = ticket.iter().map(|byte| format!("{byte:02x}")).collect();
    let endpoint = Endpoint::client(config).map_err(|error| broken(&error))?;
    endpoint.connect(format!("https://{to}/touch/{ticket}")).await.map_err(|error| broken(&error))
}

/// A stream that was offered datagrams, as long as what is returned is kept.
async fn offered(ground: &Ground) -> Result<(pb::DatagramOffer, impl Send + Sync + use<>), Status> {
    let door = ground.caller.door().await?;
    let session_id = create(&door, sheet(SIDE, SIDE), false).await?;
    let (say, messages) = tokio::sync::mpsc::channel(64);
    let open = pb::TouchOpen { session_id, tools: vec![0], lease_s: Some(60.0), datagrams: true, ..Default::default() };
    let _ = say.send(pb::TouchRequest { message: Some(Say::Open(open)) }).await;
    let mut heard = haptics(&door).touch(ReceiverStream::new(messages)).await?.into_inner();
    let offer = match heard.message().await?.and_then(|heard| heard.message) {
        Some(Heard::Opened(opened)) => opened.datagrams,
        _ => None,
    };
    let reading = tokio::spawn(async move { while let Ok(Some(_)) = heard.message().await {} });
    let reading = tokio_util::task::AbortOnDropHandle::new(reading);
    Ok((offer.ok_or_else(|| Status::unavailable("no datagrams are offered"))?, (say, reading)))
}

/// Handshakes with tickets that are none, 32 at a time.
pub async fn forged_tickets(ground: &Ground) -> Result<(), Status> {
    let (offer, _kept) = offered(ground).await?;
    let mut random = fastrand::Rng::with_seed(ground.seed);
    loop {
        let tickets: Vec<[u8; 16]> = (0..32).map(|_| std::array::from_fn(|_| random.u8(..))).collect();
        let dialled = tickets.iter().map(|ticket| async {
            let tried = tokio::time::timeout(Duration::from_secs(2), dial(ground, &offer.certificate_sha256, ticket));
            assert!(!matches!(tried.await, Ok(Ok(_))), "a forged ticket was taken");
            ground.strike();
        });
        futures_util::future::join_all(dialled).await;
    }
}

/// A session that says a hundred times what it may.
pub async fn chatter(ground: &Ground) -> Result<(), Status> {
    let (offer, _kept) = offered(ground).await?;
    let connection = dial(ground, &offer.certificate_sha256, &offer.ticket).await?;
    let pose = palpate_proto::touch::pose(glam::DVec3::ZERO, &palpate_haptics::Tip::default());
    for number in 1.. {
        let poses = |tool| pb::ToolPoses {
            tool,
            sequence: number,
            client_time_ns: 1_000_000 * number,
            pose: Some(pose),
            earlier: vec![pb::EarlierPose { sequences: 1, client_time_ns: 1, ..Default::default() }; 8],
        };
        let message = pb::PosesDatagram { number, tools: (0..5).map(poses).collect(), ..Default::default() };
        connection.send_datagram(message.encode_to_vec()).map_err(|error| broken(&error))?;
        ground.strike();
        if number.is_multiple_of(8) {
            tokio::task::yield_now().await;
        }
    }
    Ok(())
}
