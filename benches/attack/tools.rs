//! Attacks by tools that make a step long.

use std::f64::consts::TAU;
use std::time::Duration;

use futures_util::future::try_join_all;
use palpate_proto::pb;
use pb::command::Action;
use pb::create_session_request::Source;
use tonic::Status;

use super::Ground;
use super::memory::{lease, send};
use crate::caller::{Door, SIDE, create, push_all, sessions, sheet};

const TOOLS: u32 = 64;

fn pose(tool: u32, sequence: u64, [x, y, z]: [f64; 3], tip: pb::Tip) -> pb::Command {
    let position_m = Some(pb::Vector3 { x, y, z });
    let pose = pb::Pose { position_m, tip: Some(tip), ..Default::default() };
    pb::Command { tool, sequence: Some(sequence), action: Some(Action::Pose(pose)), ..Default::default() }
}

fn release(tool: u32, sequence: u64) -> pb::Command {
    pb::Command { tool, sequence: Some(sequence), action: Some(Action::Release(pb::Release {})), ..Default::default() }
}

/// Leases of all tools of a session.
async fn leases(door: &Door, session_id: &str, tools: u32) -> Result<Vec<String>, Status> {
    try_join_all((0..tools).map(|tool| lease(door, session_id, tool))).await
}

/// All tools do something again and again, each by `commands` of its number and of the sequence with which it begins.
async fn again(
    ground: &Ground,
    door: &Door,
    session_id: &str,
    commands: impl Fn(u32, u64) -> Vec<pb::Command>,
) -> Result<(), Status> {
    let leases = leases(door, session_id, ground.count(TOOLS)).await?;
    let mut sequence = 1;
    loop {
        let mut most = 0;
        for (lease_id, tool) in leases.iter().zip(0..) {
            let commands = commands(tool, sequence);
            most = most.max(commands.len() as u64);
            ground.heard(send(door, session_id, lease_id, commands).await).inspect(|()| ground.strike());
        }
        sequence += most;
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

async fn named(door: &Door, scene: &str) -> Result<String, Status> {
    let request = pb::CreateSessionRequest { source: Some(Source::SceneName(scene.into())), ..Default::default() };
    Ok(sessions(door).create_session(request).await?.into_inner().session.unwrap_or_default().session_id)
}

/// A tip as wide as half of a strip of so many points.
pub async fn strip(ground: &Ground, points: u32) -> Result<(), Status> {
    let (door, points) = (ground.caller.door().await?, ground.count(points));
    let scene = sheet(points, 1);
    let half_m = 0.25 * f64::from(points) * scene.sheet.unwrap_or_default().spacing_m.unwrap_or_default();
    let session_id = create(&door, sheet(points, 1), false).await?;
    let tip = pb::Tip { radius_m: half_m, ..Default::default() };
    again(ground, &door, &session_id, |tool, sequence| {
        vec![release(tool, sequence), pose(tool, sequence + 1, [0.0, 0.0, -0.001], tip)]
    })
    .await
}

/// Returns the place of a tool on an organ some centimetres wide.
fn around(tool: u32, height_m: f64) -> [f64; 3] {
    let angle = TAU * f64::from(tool) / f64::from(TOOLS);
    [0.01 * angle.cos(), 0.01 * angle.sin(), height_m]
}

/// Tips of so many metres all over an organ, which come and go.
pub async fn organ(ground: &Ground, scene: &str, radius_m: f64, grasps: bool) -> Result<(), Status> {
    let door = ground.caller.door().await?;
    let session_id = named(&door, scene).await?;
    come_and_go(ground, &door, &session_id, radius_m, grasps).await
}

/// Grasps that pull at the same points of a sheet, until the guard repeats steps.
pub async fn grasps(ground: &Ground, side: u32) -> Result<(), Status> {
    let (door, side) = (ground.caller.door().await?, ground.side(side));
    let session_id = create(&door, sheet(side, side), false).await?;
    come_and_go(ground, &door, &session_id, 0.01, true).await
}

async fn come_and_go(
    ground: &Ground,
    door: &Door,
    session_id: &str,
    radius_m: f64,
    grasps: bool,
) -> Result<(), Status> {
    let tip = pb::Tip { radius_m, grasps, ..Default::default() };
    again(ground, door, session_id, |tool, sequence| {
        vec![pose(tool, sequence, around(tool, if sequence % 2 == 0 { 0.002 } else { -0.004 }), tip)]
    })
    .await
}

/// Tips on an ordinary sheet that let go and touch again, each time with another radius.
pub async fn touch_again(ground: &Ground) -> Result<(), Status> {
    let door = ground.caller.door().await?;
    let session_id = create(&door, sheet(SIDE, SIDE), false).await?;
    #[allow(clippy::cast_precision_loss)]
    let radius_m = |sequence: u64| 0.004 + 1e-5 * (sequence % 100) as f64;
    again(ground, &door, &session_id, |tool, sequence| {
        let tip = pb::Tip { radius_m: radius_m(sequence), ..Default::default() };
        vec![release(tool, sequence), pose(tool, sequence + 1, around(tool, -0.002), tip)]
    })
    .await
}

/// Forces on all points of a sheet at once.
pub async fn wide_pushes(ground: &Ground) -> Result<(), Status> {
    let (door, side) = (ground.caller.door().await?, ground.side(100));
    let session_id = create(&door, sheet(side, side), false).await?;
    again(ground, &door, &session_id, |tool, sequence| vec![push_all(tool, sequence, -1e-4)]).await
}
