//! Attacks by tools that cost, and by meshes that take long to read.

use std::f64::consts::TAU;
use std::fmt::Write;
use std::time::Duration;

use futures_util::future::{join_all, try_join_all};
use palpate_proto::pb;
use pb::command::Action;
use pb::create_session_request::Source;
use tonic::Status;

use super::Ground;
use super::hoard::{lease, send};
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

/// Where tools are on an organ some centimetres wide.
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

/// Sends a mesh, and makes a session of it.
async fn mesh(ground: &Ground, door: &Door, name: &str, file: &[u8], vertices: Option<u32>) -> Result<(), Status> {
    let (mut mesh_id, part) = (String::new(), 1 << 20);
    for offset in (0..file.len()).step_by(part) {
        let end = file.len().min(offset + part);
        let request = pb::UploadMeshRequest {
            mesh_id,
            file_name: name.to_owned(),
            offset: offset as u64,
            part: file[offset..end].to_vec(),
            last: end == file.len(),
            unit: "m".into(),
            repair: false,
        };
        mesh_id = sessions(door).upload_mesh(request).await?.into_inner().mesh_id;
    }
    ground.strike();
    let source = pb::Mesh { mesh_id, vertices, ..Default::default() };
    let material = pb::Material {
        youngs_modulus_pa: Some(8000.0),
        thickness_m: Some(0.001),
        bed_n_per_m3: Some(1e6),
        ..Default::default()
    };
    let scene = pb::Scene { mesh: Some(source), material: Some(material), ..Default::default() };
    create(door, scene, true).await.map(drop)
}

/// Two callers at once send a mesh again and again.
async fn meshes(ground: &Ground, name: &str, file: &[u8], vertices: Option<u32>) -> Result<(), Status> {
    let each = async |_| -> Result<(), Status> {
        let door = ground.caller.door().await?;
        loop {
            if ground.heard(mesh(ground, &door, name, file, vertices).await).is_none() {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        }
    };
    join_all((0..2).map(each)).await.into_iter().collect()
}

/// Two cones on one circle of so many vertices, as OBJ.
fn two_hubs(around: u32) -> String {
    let mut obj = "v 0 0 0.05\nv 0 0 -0.05\n".to_owned();
    for k in 0..around {
        let angle = TAU * f64::from(k) / f64::from(around);
        let _ = writeln!(obj, "v {:.7} {:.7} 0", 0.1 * angle.cos(), 0.1 * angle.sin());
    }
    for k in 0..around {
        let (a, b) = (3 + k, 3 + (k + 1) % around);
        let _ = writeln!(obj, "f 1 {a} {b}\nf 2 {b} {a}");
    }
    obj
}

pub async fn hub(ground: &Ground, vertices: Option<u32>) -> Result<(), Status> {
    meshes(ground, "hub.obj", two_hubs(ground.count(100_000)).as_bytes(), vertices).await
}

/// Tetrahedra around each other, or one and the same, as OBJ.
pub async fn nested(ground: &Ground, grows: bool) -> Result<(), Status> {
    let (count, mut obj) = (ground.count(4000), String::new());
    for k in 0..count {
        let size = 0.05 * (1.0 + if grows { f64::from(k) / f64::from(count) } else { 1e-9 * f64::from(k) });
        for [x, y, z] in [[1.0, 1.0, 1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, -1.0], [1.0, -1.0, -1.0]] {
            let _ = writeln!(obj, "v {:.12} {:.12} {:.12}", size * x, size * y, size * z);
        }
        for [a, b, c] in [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]] {
            let _ = writeln!(obj, "f {} {} {}", 4 * k + a + 1, 4 * k + b + 1, 4 * k + c + 1);
        }
    }
    meshes(ground, "nested.obj", obj.as_bytes(), None).await
}

/// Vertices that no triangle has, in the middle of a tetrahedron.
pub async fn unused_vertices(ground: &Ground) -> Result<(), Status> {
    let mut obj = two_hubs(2000);
    for k in 0..ground.count(20_000) {
        let _ = writeln!(obj, "v {:e} 0 0", 1e-9 * f64::from(k));
    }
    meshes(ground, "unused.obj", obj.as_bytes(), None).await
}

/// A glTF file of some hundred bytes that says that it has millions of vertices.
pub async fn empty_accessor(ground: &Ground) -> Result<(), Status> {
    let gltf = r#"{"asset":{"version":"2.0"},"scenes":[{"nodes":[0]}],"scene":0,"nodes":[{"mesh":0}],"meshes":[{"primitives":[{"attributes":{"POSITION":0}}]}],"accessors":[{"componentType":5126,"count":10000000,"type":"VEC3","min":[0,0,0],"max":[1,1,1]}]}"#;
    meshes(ground, "empty.gltf", gltf.as_bytes(), None).await
}
