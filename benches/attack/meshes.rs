//! Attacks by meshes that take long to read.

use std::f64::consts::TAU;
use std::fmt::Write;
use std::time::Duration;

use futures_util::future::join_all;
use palpate_proto::pb;
use tonic::Status;

use super::Ground;
use crate::caller::{Door, create, sessions};

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
            ..Default::default()
        };
        mesh_id = sessions(door).upload_mesh(request).await?.into_inner().mesh_id;
    }
    ground.strike();
    let source = pb::Mesh { mesh_id, vertices, ..Default::default() };
    let material = pb::Material {
        youngs_modulus_pa: Some(8000.0),
        thickness_m: Some(0.001),
        foundation_n_per_m3: Some(1e6),
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
