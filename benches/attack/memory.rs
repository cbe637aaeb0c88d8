//! Attacks that have the server keep things for them.

use std::time::Duration;

use futures_util::future::join_all;
use palpate_proto::pb;
use tonic::{Status, Streaming};

use super::Ground;
use crate::caller::{Door, MIDDLE, SIDE, create, haptics, push, push_all, sessions, sheet, views};

/// A step that is never done.
const NEVER: u64 = 1 << 40;

/// Returns a scene with this many fixed points, all of them the same one.
pub fn fixed(points: u32) -> pb::Scene {
    let mut scene = sheet(SIDE, SIDE);
    let points = vec![pb::GridPoint { x: 0, y: 0 }; points as usize];
    let fixed = pb::sheet::Fixed::FixedPoints(pb::GridPoints { points });
    scene.sheet.get_or_insert_default().fixed = Some(fixed);
    scene
}

/// A lease of one tool.
pub async fn lease(door: &Door, session_id: &str, tool: u32) -> Result<String, Status> {
    let request = pb::AcquireToolRequest {
        session_id: session_id.to_owned(),
        tool,
        lease_s: Some(60.0),
        holder: "siege".into(),
        outlives_connection: false,
        more_tools: Vec::new(),
    };
    Ok(haptics(door).acquire_tool(request).await?.into_inner().lease_id)
}

/// Commands by a lease.
pub async fn send(door: &Door, session_id: &str, lease_id: &str, commands: Vec<pb::Command>) -> Result<(), Status> {
    let request =
        pb::SendCommandsRequest { session_id: session_id.to_owned(), lease_id: lease_id.to_owned(), commands };
    haptics(door).send_commands(request).await.map(drop)
}

/// Pushes all of a tissue until the connection ends.
pub async fn push_everywhere(door: &Door, session_id: &str, force_n: f64) -> Result<(), Status> {
    let lease_id = lease(door, session_id, 0).await?;
    send(door, session_id, &lease_id, vec![push_all(0, 1, force_n)]).await
}

/// A connection that takes in little unread.
pub async fn narrow(ground: &Ground) -> Result<Door, Status> {
    let narrow = |endpoint: tonic::transport::Endpoint| {
        endpoint.initial_stream_window_size(16_384).initial_connection_window_size(65_535)
    };
    ground.caller.dial(narrow).await
}

pub async fn tissue_changes(ground: &Ground) -> Result<(), Status> {
    let door = ground.caller.door().await?;
    let session_id = create(&door, fixed(ground.count(500_000)), true).await?;
    let each = async |number: u32| {
        let mut stiffness = 10.0 + f64::from(number);
        loop {
            stiffness += 0.001;
            let request = pb::UpdateTissueRequest {
                session_id: session_id.clone(),
                stiffness_n_per_m: Some(stiffness),
                at_step: Some(NEVER),
                ..Default::default()
            };
            let changed = sessions(&door).update_tissue(request).await;
            if ground.heard(changed).inspect(|_| ground.strike()).is_none() {
                tokio::time::sleep(Duration::from_millis(10)).await;
            }
        }
    };
    join_all((0..8).map(each)).await;
    Ok(())
}

pub async fn fixed_sessions(ground: &Ground) -> Result<(), Status> {
    let door = ground.caller.door().await?;
    let scene = fixed(ground.count(500_000));
    loop {
        let made = create(&door, scene.clone(), true).await;
        if ground.heard(made).inspect(|_| ground.strike()).is_none() {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    }
}

/// A stream of full frames.
async fn viewer(door: &Door, session_id: &str, rate_hz: f64) -> Result<Streaming<pb::WatchFramesResponse>, Status> {
    let request = pb::WatchFramesRequest {
        session_id: session_id.to_owned(),
        refinement: 10,
        rate_hz: Some(rate_hz),
        always_full: true,
        ..Default::default()
    };
    Ok(views(door).watch_frames(request).await?.into_inner())
}

pub async fn unread_viewers(ground: &Ground) -> Result<(), Status> {
    let (wide, side) = (ground.caller.door().await?, ground.side(186));
    let session_id = create(&wide, sheet(side, side), false).await?;
    let door = narrow(ground).await?;
    let mut unread = Vec::new();
    for _ in 0..ground.count(139) {
        unread.extend(ground.heard(viewer(&door, &session_id, 60.0).await).inspect(|_| ground.strike()));
    }
    push_everywhere(&wide, &session_id, -0.01).await?;
    std::future::pending().await
}

pub async fn stalled_viewer(ground: &Ground) -> Result<(), Status> {
    let door = ground.caller.door().await?;
    let session_id = create(&door, sheet(SIDE, SIDE), false).await?;
    let _unread = viewer(&door, &session_id, 1000.0).await?;
    ground.strike();
    std::future::pending().await
}

/// Sends as many commands as may wait in a session, with all of its tools.
pub async fn fill(ground: &Ground, door: &Door, session_id: &str) -> Result<(), Status> {
    for tool in 0..ground.count(64) {
        let lease_id = lease(door, session_id, tool).await?;
        for batch in 0..4 {
            let command = |at| pb::Command { at_step: Some(NEVER + at), ..push(tool, at, MIDDLE, -0.1) };
            let commands = (1024 * batch + 1..=1024 * (batch + 1)).map(command).collect();
            send(door, session_id, &lease_id, commands).await?;
            ground.strike();
        }
    }
    Ok(())
}

pub async fn waiting_commands(ground: &Ground) -> Result<(), Status> {
    loop {
        let door = ground.caller.door().await?;
        let session_id = create(&door, sheet(SIDE, SIDE), true).await?;
        if ground.heard(fill(ground, &door, &session_id).await).is_none() {
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    }
}

pub async fn thin_sheet(ground: &Ground) -> Result<(), Status> {
    let door = ground.caller.door().await?;
    let session_id = create(&door, sheet(ground.count(1 << 22), 1), false).await?;
    ground.strike();
    push_everywhere(&door, &session_id, -0.01).await?;
    std::future::pending().await
}
