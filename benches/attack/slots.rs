//! Attacks that occupy the room that others need, or continue where they may not.

use std::time::Duration;

use futures_util::future::join_all;
use palpate::server::identity::Role;
use palpate_proto::pb;
use pb::touch_request::Message as Say;
use tokio::io::AsyncWriteExt;
use tokio::net::TcpStream;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;

use super::Ground;
use crate::caller::{MIDDLE, SIDE, TestCaller, create, haptics, push, sessions, sheet};

/// A stream whose client never reads, and whose token is struck out after a second of commands. Strikes are commands
/// that were taken more than 2 s later.
pub async fn revoked_unread(ground: &Ground) -> Result<(), Status> {
    let name = format!("prey-{:x}", ground.seed);
    let token = ground.keys.admit(&name, &[Role::Touch, Role::Create]);
    let prey = TestCaller::new(&ground.caller.url, &token);
    let made = async {
        loop {
            // The server looks at the file once a second.
            let door = prey.door().await?;
            match create(&door, sheet(SIDE, SIDE), false).await {
                Err(status) if status.code() == tonic::Code::Unauthenticated => {
                    tokio::time::sleep(Duration::from_millis(50)).await;
                }
                made => return made,
            }
        }
    };
    let session_id = made.await?;
    // Nothing of the answer but its headers leaves the server.
    let door = prey.dial(|endpoint| endpoint.initial_stream_window_size(0)).await?;
    let (say, messages) = tokio::sync::mpsc::channel(64);
    let open =
        pb::TouchOpen { session_id: session_id.clone(), tools: vec![0], lease_s: Some(60.0), ..Default::default() };
    let _ = say.send(pb::TouchRequest { message: Some(Say::Open(open)) }).await;
    let _unread = haptics(&door).touch(ReceiverStream::new(messages)).await?;
    let mut tick = tokio::time::interval(Duration::from_millis(20));
    let mut command = async |sequence| {
        tick.tick().await;
        let command = push(0, sequence, MIDDLE, -0.1);
        say.send(pb::TouchRequest { message: Some(Say::Command(command)) }).await.is_ok()
    };
    for sequence in 1..=50 {
        command(sequence).await;
    }
    ground.keys.strike(&name);
    for sequence in 51..=150 {
        command(sequence).await;
    }
    let door = ground.caller.door().await?;
    let taken = async || {
        let request = pb::GetSessionRequest { session_id: session_id.clone() };
        let session = sessions(&door).get_session(request).await?.into_inner().session.unwrap_or_default();
        Ok::<_, Status>(session.commands.unwrap_or_default().accepted)
    };
    let mut before = taken().await?;
    let mut sequence = 151;
    while command(sequence).await {
        sequence += 1;
        let now = taken().await?;
        (before..now).for_each(|_| ground.strike());
        before = now;
    }
    Ok(())
}

/// Streams that read the honest client's session, over connections of 64 each.
pub async fn watchers(ground: &Ground) -> Result<(), Status> {
    let mut streams = Vec::new();
    for _ in 0..ground.count(4) {
        let door = ground.caller.door().await?;
        for _ in 0..64 {
            let request = pb::WatchSamplesRequest { session_id: ground.shared.clone(), ..Default::default() };
            let stream = haptics(&door).watch_samples(request).await;
            streams.extend(ground.heard(stream).inspect(|_| ground.strike()).map(tonic::Response::into_inner));
        }
    }
    // They are read: who does not read is another attack.
    join_all(streams.iter_mut().map(async |stream| while let Ok(Some(_)) = stream.message().await {})).await;
    Ok(())
}

/// Leases without a connection.
pub async fn kept_leases(ground: &Ground) -> Result<(), Status> {
    let door = ground.caller.door().await?;
    for tool in 1..64 {
        let request = pb::AcquireToolRequest {
            session_id: ground.shared.clone(),
            tool,
            lease_s: Some(600.0),
            holder: "kept".into(),
            outlives_connection: true,
            more_tools: Vec::new(),
        };
        ground.heard(haptics(&door).acquire_tool(request).await).inspect(|_| ground.strike());
    }
    drop(door);
    std::future::pending().await
}

/// Sessions that stand still, over connections enough to be as fast as may be.
pub async fn all_slots(ground: &Ground) -> Result<(), Status> {
    let each = async || {
        let door = ground.caller.door().await?;
        loop {
            let made = create(&door, sheet(4, 4), true).await;
            if ground.heard(made).inspect(|_| ground.strike()).is_none() {
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
    };
    let ended: Vec<Result<(), Status>> = join_all((0..4).map(|_| each())).await;
    ended.into_iter().collect()
}

/// Opens connections that send only `greeting`, and opens closed ones again.
pub async fn connections(ground: &Ground, greeting: &[u8]) -> Result<(), Status> {
    let most = ground.count(if greeting.is_empty() { 1000 } else { 1500 }) as usize;
    let mut open: Vec<TcpStream> = Vec::new();
    loop {
        let still_open = |socket: &TcpStream| match socket.try_read(&mut [0; 256]) {
            Ok(count) => count > 0,
            Err(error) => error.kind() == std::io::ErrorKind::WouldBlock,
        };
        open.retain(still_open);
        while open.len() < most {
            let dialed =
                tokio::time::timeout(Duration::from_secs(1), TcpStream::connect(ground.caller.address())).await;
            let Ok(Ok(mut socket)) = dialed else { break };
            if socket.write_all(greeting).await.is_ok() {
                open.push(socket);
                ground.strike();
            }
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}
