//! Tissue on meshes over the network: sessions, commands by vertex, samples, records, frames, meshes that clients
//! send.

use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use crate::common::server::{TestServer, TestTouch, client_program, open, palpate, repository, told};
use glam::DVec3;
use palpate_client::view::SurfaceState;
use palpate_haptics::Tip;
use palpate_haptics::device::Device;
use palpate_proto::geometry::{from_vector, vector};
use palpate_proto::{pb, touch};
use palpate_tissue::limits::Limits;
use palpate_tissue::response::force_law::{self, Disc};
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::{Body, Scene};
use palpate_tissue::shape::{PointId, PointName, RestShape};
use palpate_tissue::{Grasp, Model, Push, Tissue, at_rest};
use pb::create_session_request::Source;
use pb::force::Centre;
use pb::touch_response::Message as Heard;
use tempfile::TempDir;
use tonic::{Code, Status};

const ICOSPHERE: &str = include_str!("../reference/icosphere.obj");

/// A ball of a material, with two lumps.
const LUMPS: &str = r#"
name = "lumps"
[mesh]
file = "lumps.obj"
unit = "m"
fixed = [{ centre_m = [0.0, 0.0, 0.05], radius_m = 0.02 }]
[material]
youngs_modulus_pa = 2000.0
thickness_m = 0.005
depth_m = 0.02
foundation_n_per_m3 = 5e4
[springs]
bending = 0.1
[[inclusion]]
centre_m = [0.0, -0.05, 0.0]
radius_m = 0.02
stiffness_factor = 3.0
anchor_stiffness_factor = 2.0
[[inclusion]]
group = "lump"
anchor_stiffness_factor = 4.0
edge_m = 0.01
[stepping]
integrator = "central"
substeps = 4
precision = "f32"
"#;

/// A ball of 5 cm radius; its top never moves.
const SCENE: &str = r#"
name = "ball"
[mesh]
file = "ball.obj"
unit = "m"
point_mass_kg = 0.01
fixed = [{ centre_m = [0.0, 0.0, 0.05], radius_m = 0.02 }]
[springs]
stiffness_n_per_m = 10.0
bending = 0.3
[anchor_springs]
stiffness_n_per_m = 5.0
[damping]
coefficient_n_s_per_m = 0.1
[stepping]
integrator = "central"
substeps = 2
precision = "f32"
"#;

/// A folder with the ball and its scene, and a server that has it.
fn ball() -> (TempDir, TestServer) {
    let folder = folder();
    // A server that was not optimized takes long to lay out a session.
    let config = folder.path().join("patient.conf");
    std::fs::write(&config, "[limits]\nwork_s = 600.0\n").unwrap();
    let [scenes, config] = [folder.path(), &config].map(|path| path.to_str().unwrap());
    let server = TestServer::start(&["--scenes", scenes, "--config", config]);
    (folder, server)
}

fn folder() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    // Two groups, for the sake of their names.
    let grouped = ICOSPHERE.replacen("f ", "g cap\nf ", 1);
    std::fs::write(folder.path().join("ball.obj"), grouped).unwrap();
    std::fs::write(folder.path().join("ball.toml"), SCENE).unwrap();
    let (vertices, triangles) = ICOSPHERE.split_at(ICOSPHERE.find("f ").unwrap());
    let (lump, rest) = triangles.split_at(triangles.match_indices('\n').nth(20).unwrap().0);
    std::fs::write(folder.path().join("lumps.obj"), format!("{vertices}g lump\n{lump}\ng rest{rest}")).unwrap();
    std::fs::write(folder.path().join("lumps.toml"), LUMPS).unwrap();
    folder
}

fn scene(folder: &TempDir) -> Scene {
    scene_of(folder, "ball")
}

fn scene_of(folder: &TempDir, name: &str) -> Scene {
    Scene::load(&folder.path().join(format!("{name}.toml")), &[], &Limits::default()).unwrap()
}

fn by_name() -> Source {
    Source::SceneName("ball".into())
}

/// The paper's tissue, 40 cm wide.
fn small_sheet() -> Source {
    let sets = ["sheet.points=[5, 5]", "sheet.spacing_m=0.1", "stepping.integrator=central", "stepping.substeps=2"];
    let sets = sets.map(str::to_owned);
    let scene = Scene::parse("small", palpate_tissue::scene::PAPER, &sets, &Limits::default()).unwrap();
    Source::Scene(palpate_session::wire::scene::scene(&scene))
}

fn push(tool: u32, sequence: u64, centre: Centre, force_n: DVec3) -> pb::Command {
    let force =
        pb::Force { centre: Some(centre), force_n: vector(force_n), falloff_per_m: Some(80.0), falloff_offset: None };
    command(tool, sequence, pb::command::Action::Force(force))
}

fn grasp(tool: u32, sequence: u64, vertex: u32, displacement_m: DVec3) -> pb::Command {
    let DVec3 { x, y, z } = displacement_m;
    let target = Some(pb::position::Target::DisplacementM(pb::Vector3 { x, y, z }));
    command(tool, sequence, pb::command::Action::Position(pb::Position { point: None, vertex: Some(vertex), target }))
}

fn command(tool: u32, sequence: u64, action: pb::command::Action) -> pb::Command {
    pb::Command { tool, sequence: Some(sequence), at_step: Some(0), action: Some(action), ..Default::default() }
}

/// The tissue offline, after the same commands.
fn offline(scene: &Scene, steps: usize) -> Box<dyn Tissue> {
    let mut tissue = at_rest(&Model::compile(scene, &Limits::default()).unwrap());
    let centre_m = scene.shape().rest_m(PointId::new(7));
    let poke = Poke { point: None, centre_m, force_n: FORCE_N, falloff_per_m: 80.0, falloff_offset: 0.0 };
    tissue.push(0, Some(Push::Constant(poke)));
    tissue.grasp(1, PointId::new(40), Grasp::Target(MOVE_M));
    (0..steps).for_each(|_| tissue.step().unwrap());
    tissue
}

const FORCE_N: DVec3 = DVec3::new(0.1, -0.2, -0.3);
const MOVE_M: DVec3 = DVec3::new(0.0, 0.002, 0.001);

/// All of what a session shows at rest.
#[derive(Default)]
struct RestingMesh {
    rest_m: Vec<DVec3>,
    file_vertex: Vec<u32>,
    triangles: Vec<u32>,
    groups: BTreeMap<String, Vec<u32>>,
    size: [u32; 2],
    edge_m: f64,
}

async fn shown(server: &TestServer, session_id: &str) -> RestingMesh {
    let request = pb::GetMeshRequest { session_id: session_id.into(), refinement: 0 };
    let mut parts = server.views().await.get_mesh(request).await.unwrap().into_inner();
    let mut all = RestingMesh::default();
    while let Some(part) = parts.message().await.unwrap() {
        let place = |place: &[f32]| DVec3::from_array([0, 1, 2].map(|c| f64::from(place[c])));
        all.rest_m.extend(part.rest_position_m.chunks(3).map(place));
        all.file_vertex.extend(part.file_vertex);
        all.triangles.extend(part.triangles);
        part.groups.into_iter().for_each(|group| all.groups.entry(group.name).or_default().extend(group.vertices));
        all.size = [part.vertices_x, part.vertices_y];
        all.edge_m = part.vertex_spacing_m;
    }
    all
}

/// The first frame, which is full.
async fn surface(server: &TestServer, session_id: &str, encoding: pb::Encoding) -> SurfaceState {
    let request =
        pb::WatchFramesRequest { session_id: session_id.to_owned(), encoding: encoding.into(), ..Default::default() };
    let mut frames = server.views().await.watch_frames(request).await.unwrap().into_inner();
    let mut surface = SurfaceState::default();
    loop {
        let part = frames.message().await.unwrap().unwrap();
        surface.write(&part).unwrap();
        if part.last {
            assert!(part.full);
            return surface;
        }
    }
}

#[tokio::test]
async fn a_session_on_a_mesh_is_told_pushed_grasped_sampled_probed_and_shown() {
    let (folder, server) = ball();
    let scene = scene(&folder);
    let session = server.create(by_name(), true).await.unwrap();
    let told_scene = session.scene.clone().unwrap();
    let mesh = told_scene.mesh.unwrap();
    assert!(told_scene.sheet.is_none() && mesh.mesh_id.is_empty() && mesh.point_mass_kg == Some(0.01));
    assert!(matches!(mesh.fixed, Some(pb::mesh::Fixed::FixedBalls(balls)) if balls.balls[0].radius_m == 0.02));
    let springs = told_scene.springs.unwrap();
    assert_eq!((springs.shear_stiffness_n_per_m, springs.bending_factor), (None, Some(0.3)));
    assert_eq!(session.points, 162);
    let extent = session.extent.unwrap();
    assert!(from_vector(extent.most_m.as_ref()).distance(scene.shape().extent().most_m) < 1e-12);

    let id = &session.session_id;
    let mut touch = TestTouch::open(&server, open(id, &[0, 1])).await.unwrap();
    touch.command(push(0, 1, Centre::Vertex(7), FORCE_N)).await;
    touch.command(grasp(1, 1, 40, MOVE_M)).await;
    touch.settle().await;
    let mut haptics = server.haptics().await;
    let request = pb::ProbeRequest {
        session_id: id.clone(),
        r#where: Some(pb::probe_request::Where::Vertices(pb::Vertices { vertices: vec![7, 40, 100] })),
        every_steps: Some(60),
        energy: true,
        ..Default::default()
    };
    let mut records = haptics.probe(request).await.unwrap().into_inner();
    server.start_until(id, 60).await;
    let sample = touch.sample_with(|sample| sample.step == 60).await;
    let truth = offline(&scene, 60);
    assert_eq!(server.hash_at(id, 60).await, format!("{:032x}", truth.state_hash()));
    for (tool, vertex) in sample.tools.iter().zip([7, 40]) {
        assert_eq!((tool.point, tool.vertex), (None, Some(vertex)));
        let state = truth.point(PointId::new(vertex as usize));
        assert!(from_vector(tool.displacement_m.as_ref()).distance(state.displacement_m) < 1e-12);
        assert!(from_vector(tool.force_on_tool_n.as_ref()).distance(state.reaction_n()) < 1e-9);
    }
    let record = loop {
        let record = records.message().await.unwrap().unwrap();
        if record.step == 60 {
            break record;
        }
    };
    let vertices: Vec<_> = record.points.iter().map(|point| (point.point, point.vertex.unwrap())).collect();
    assert_eq!(vertices, [(None, 7), (None, 40), (None, 100)]);
    for point in &record.points {
        let state = truth.point(PointId::new(point.vertex.unwrap() as usize));
        assert!(from_vector(point.displacement_m.as_ref()).distance(state.displacement_m) < 1e-12);
        assert!(state.displacement_m.length() > 1e-6);
    }

    // The file's mesh is shown, in another order.
    let all = shown(&server, id).await;
    assert_eq!((all.rest_m.len(), all.size, all.triangles.len()), (162, [11, 16], 960));
    assert!((all.edge_m - scene.shape().edge_m()).abs() < 1e-12);
    let mut sorted = all.file_vertex.clone();
    sorted.sort_unstable();
    assert_eq!(sorted, (0..162).collect::<Vec<_>>());
    for (rest_m, vertex) in all.rest_m.iter().zip(&all.file_vertex) {
        assert!(rest_m.distance(scene.shape().rest_m(PointId::new(*vertex as usize))) < 1e-8);
    }
    for triangle in all.triangles.chunks(3) {
        let [a, b, c] = [0, 1, 2].map(|corner| all.rest_m[triangle[corner] as usize]);
        assert!((b - a).cross(c - a).dot(a + b + c) > 0.0, "outward");
    }
    assert_eq!(all.groups["cap"].len(), 162);
    for (encoding, within_m) in [(pb::Encoding::F32, 1e-9), (pb::Encoding::I16, 1e-6)] {
        let surface = surface(&server, id, encoding).await;
        assert_eq!(surface.vertices, [11, 16]);
        for (moved_m, vertex) in surface.displacement_m.iter().zip(&all.file_vertex) {
            let expected = truth.point(PointId::new(*vertex as usize)).displacement_m;
            assert!(DVec3::from_array(moved_m.map(f64::from)).distance(expected) < within_m, "{vertex}");
        }
    }
}

#[tokio::test]
async fn frames_of_a_coarser_tissue_show_the_mesh_of_its_file() {
    let (folder, server) = ball();
    let coarse = SCENE.replacen("fixed =", "vertices = 80\nfixed =", 1).replace("\"ball\"", "\"coarse\"");
    let file = folder.path().join("coarse.toml");
    std::fs::write(&file, coarse).unwrap();
    let scene = Scene::load(&file, &[], &Limits::default()).unwrap();
    let Body::Mesh(mesh) = &scene.body else { panic!("no mesh") };
    let (shape, bound) = (&mesh.shape, mesh.shape.shown().unwrap());
    let session = server.create(Source::SceneName("coarse".into()), true).await.unwrap();
    let id = &session.session_id;
    assert_eq!(session.points as usize, shape.point_count());
    assert_eq!(session.scene.unwrap().mesh.unwrap().vertices, Some(session.points));
    let mut touch = TestTouch::hold(&server, id).await;
    // Any vertex of the file has a name.
    touch.command(push(0, 1, Centre::Vertex(161), FORCE_N)).await;
    touch.settle().await;
    server.start_until(id, 40).await;
    let sample = touch.sample_with(|sample| sample.step == 40).await;
    let point = shape.find("", PointName::Vertex(161)).unwrap();
    assert_eq!(PointName::Vertex(sample.tools[0].vertex.unwrap()), shape.name(point));

    let mut truth = at_rest(&Model::compile(&scene, &Limits::default()).unwrap());
    let (centre_m, falloff_per_m) = (shape.rest_m(point), 80.0);
    let poke = Poke { point: None, centre_m, force_n: FORCE_N, falloff_per_m, falloff_offset: 0.0 };
    truth.push(0, Some(Push::Constant(poke)));
    (0..40).for_each(|_| truth.step().unwrap());
    assert_eq!(server.hash_at(id, 40).await, format!("{:032x}", truth.state_hash()));
    let all = shown(&server, id).await;
    assert_eq!((all.rest_m.len(), all.size, all.triangles.len()), (162, [11, 16], 960));
    let surface = surface(&server, id, pb::Encoding::F32).await;
    let mut farthest_m = 0.0_f64;
    for ((rest_m, vertex), moved_m) in all.rest_m.iter().zip(&all.file_vertex).zip(&surface.displacement_m) {
        assert!(rest_m.distance(bound.mesh.vertices_m[*vertex as usize]) < 1e-8);
        let place = bound.places[*vertex as usize];
        let corners = shape.triangles()[place.triangle as usize].map(|corner| PointId::new(corner as usize));
        let over = |at: &dyn Fn(PointId) -> DVec3| {
            let [a, b, c] = corners.map(at);
            let [u, v, w] = place.barycentric;
            u * a + v * b + w * c + place.height_m * (b - a).cross(c - a).normalize()
        };
        let now = |corner: PointId| shape.rest_m(corner) + truth.point(corner).displacement_m;
        let expected_m = over(&now) - over(&|corner| shape.rest_m(corner));
        assert!(DVec3::from_array(moved_m.map(f64::from)).distance(expected_m) < 1e-7, "{vertex}");
        farthest_m = farthest_m.max(expected_m.length());
    }
    assert!(farthest_m > 1e-4);
}

#[tokio::test]
async fn what_does_not_fit_the_tissue_is_refused_with_what_does() {
    let (_folder, server) = ball();
    let mesh = server.create(by_name(), true).await.unwrap().session_id;
    let sheet = server.create(small_sheet(), true).await.unwrap().session_id;
    let mut on_mesh = TestTouch::hold(&server, &mesh).await;
    let mut on_sheet = TestTouch::hold(&server, &sheet).await;
    let place = |x, y, z| Centre::AtM(pb::Vector3 { x, y, z });
    let point = Centre::Point(pb::GridPoint { x: 1, y: 1 });
    let plane = Centre::CentreM(pb::Vector2 { x: 0.0, y: 0.0 });
    for (is_mesh, centre, field, reason, words) in [
        (true, point, "force.point", "WRONG_KIND", "the number of a vertex"),
        (true, plane, "force.centre_m", "WRONG_KIND", "`at_m`"),
        (true, Centre::Vertex(162), "force.vertex", "OFF_TISSUE", "from 0 to 161"),
        (true, place(0.0, 0.0, 0.07), "force.at_m", "OFF_TISSUE", "a tenth"),
        (true, place(0.0, f64::NAN, 0.0), "force.at_m", "NOT_FINITE", ""),
        (false, Centre::Vertex(3), "force.vertex", "WRONG_KIND", "5 × 5"),
        (false, place(0.2, 0.2, 0.2), "force.at_m", "OFF_TISSUE", ""),
    ] {
        let touch = if is_mesh { &mut on_mesh } else { &mut on_sheet };
        touch.command(push(0, 1, centre, FORCE_N)).await;
        let rejection = touch.rejection().await;
        assert_eq!((rejection.field.as_str(), rejection.reason.as_str()), (field, reason), "{rejection:?}");
        assert!(rejection.message.contains(words), "{rejection:?}");
    }
    let target = Some(pb::position::Target::DisplacementM(pb::Vector3::default()));
    let at = Some(pb::GridPoint { x: 1, y: 1 });
    for (is_mesh, position, field, reason) in [
        (true, pb::Position { point: at, vertex: None, target }, "position.point", "WRONG_KIND"),
        (true, pb::Position { point: None, vertex: None, target }, "position.vertex", "MISSING"),
        (true, pb::Position { point: at, vertex: Some(1), target }, "position.vertex", "WRONG_KIND"),
        (false, pb::Position { point: None, vertex: Some(1), target }, "position.vertex", "WRONG_KIND"),
        (false, pb::Position { point: None, vertex: None, target }, "position.point", "MISSING"),
    ] {
        let touch = if is_mesh { &mut on_mesh } else { &mut on_sheet };
        touch.command(command(0, 1, pb::command::Action::Position(position))).await;
        let rejection = touch.rejection().await;
        assert_eq!((rejection.field.as_str(), rejection.reason.as_str()), (field, reason), "{rejection:?}");
    }
    // A place in space is one on the sheet, too: the nearest one.
    on_sheet.command(push(0, 2, place(0.2, 0.2, 0.03), FORCE_N)).await;
    on_sheet.settle().await;
    server.start_until(&sheet, 1).await;
    let sample = on_sheet.sample_with(|sample| sample.step == 1).await;
    assert_eq!(sample.tools[0].point, Some(pb::GridPoint { x: 2, y: 2 }));

    let mut views = server.views().await;
    let request = pb::GetMeshRequest { session_id: mesh.clone(), refinement: 1 };
    let refused = views.get_mesh(request).await.unwrap_err();
    assert_eq!(told(&refused), (Code::InvalidArgument, "OUT_OF_RANGE".into(), "refinement".into()));
    let r#where = Some(pb::probe_request::Where::Vertices(pb::Vertices { vertices: vec![3, 162] }));
    let probe = pb::ProbeRequest { session_id: mesh, r#where: r#where.clone(), ..Default::default() };
    let mut haptics = server.haptics().await;
    assert_eq!(told(&haptics.probe(probe).await.unwrap_err()).2, "vertices[1]");
    let probe = pb::ProbeRequest { session_id: sheet, r#where, ..Default::default() };
    assert_eq!(told(&haptics.probe(probe).await.unwrap_err()).2, "vertices[0]");
}

/// Sends a file in parts of that size.
async fn upload(
    server: &TestServer,
    file: &[u8],
    part: usize,
    unit: &str,
    repair: bool,
) -> Result<pb::UploadMeshResponse, Status> {
    let mut sessions = server.sessions().await;
    let mut answer = pb::UploadMeshResponse::default();
    let count = file.len().div_ceil(part).max(1);
    for index in 0..count {
        let request = pb::UploadMeshRequest {
            mesh_id: answer.mesh_id,
            file_name: "ball.obj".into(),
            offset: (index * part) as u64,
            part: file[index * part..file.len().min((index + 1) * part)].to_vec(),
            last: index + 1 == count,
            unit: unit.into(),
            repair,
            label: None,
        };
        answer = sessions.upload_mesh(request).await?.into_inner();
    }
    assert_eq!(answer.received_bytes, file.len() as u64);
    Ok(answer)
}

/// The ball's scene on a mesh that was sent.
fn on(mesh_id: &str, scene: &Scene) -> pb::Scene {
    let mut message = palpate_session::wire::scene::sent(scene);
    message.mesh.as_mut().unwrap().mesh_id = mesh_id.to_owned();
    message
}

#[tokio::test]
async fn a_mesh_that_a_client_sends_makes_the_session_that_its_file_does() {
    let (folder, server) = ball();
    let scene = scene(&folder);
    let file = std::fs::read(folder.path().join("ball.obj")).unwrap();
    let sent = upload(&server, &file, 1000, "m", false).await.unwrap();
    let report = sent.report.unwrap();
    assert!(!report.refused && report.problems.is_empty(), "{report:?}");
    assert_eq!((report.vertices, report.triangles, report.components, report.holes), (162, 320, 1, 0));
    assert!(report.volume_m3.unwrap() > 4e-4 && report.groups == ["cap"]);
    let session = server.create(Source::Scene(on(&sent.mesh_id, &scene)), true).await.unwrap();
    assert_eq!(session.scene.unwrap().mesh.unwrap().mesh_id, "");
    let id = session.session_id;
    let touch = TestTouch::open(&server, open(&id, &[0, 1])).await;
    let mut touch = touch.unwrap();
    touch.command(push(0, 1, Centre::Vertex(7), FORCE_N)).await;
    touch.command(grasp(1, 1, 40, MOVE_M)).await;
    touch.settle().await;
    server.start_until(&id, 30).await;
    assert_eq!(server.hash_at(&id, 30).await, format!("{:032x}", offline(&scene, 30).state_hash()));

    let fixed = |fixed| {
        let mut scene = on(&sent.mesh_id, &scene);
        scene.mesh.as_mut().unwrap().fixed = Some(fixed);
        scene
    };
    let ball = pb::Ball { centre_m: None, radius_m: 1.0 };
    let without_mass = {
        let mut scene = on(&sent.mesh_id, &scene);
        scene.mesh.as_mut().unwrap().point_mass_kg = None;
        scene
    };
    let with_shear = {
        let mut scene = on(&sent.mesh_id, &scene);
        scene.springs.as_mut().unwrap().shear_stiffness_n_per_m = Some(1.0);
        scene
    };
    for (scene, field, words) in [
        (on("", &scene), "scene.mesh.mesh_id", "UploadMesh"),
        (on("0123", &scene), "scene.mesh.mesh_id", "send the mesh again"),
        (fixed(pb::mesh::Fixed::FixedGroup("cup".into())), "scene.mesh.fixed_group", "did you mean `cap`"),
        (fixed(pb::mesh::Fixed::FixedBalls(pb::Balls { balls: vec![ball] })), "scene.mesh.fixed_balls.centre_m", ""),
        (without_mass, "scene.mesh.point_mass_kg", ""),
        (with_shear, "scene.springs.shear_stiffness_n_per_m", "edges of a mesh"),
    ] {
        let refused = server.create(Source::Scene(scene), true).await.unwrap_err();
        assert_eq!(told(&refused).2, field, "{refused:?}");
        assert!(refused.message().contains(words), "{refused:?}");
    }
    let all = fixed(pb::mesh::Fixed::FixedGroup("cap".into()));
    server.create(Source::Scene(all), true).await.unwrap();
}

/// A label map of 12 × 10 × 10 voxels of 5 mm: 4 × 6 × 6 of the label 3, and as many of 7 beside them.
fn scan() -> Vec<u8> {
    let mut file = b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 12 10 10\nencoding: raw\n\
        space: left-posterior-superior\nspace directions: (5,0,0) (0,5,0) (0,0,5)\nspace units: \"mm\" \"mm\" \"mm\"\n\n"
        .to_vec();
    let label = |n: usize| {
        let is_inner = [(n / 12 % 10, 10), (n / 120, 10)].iter().all(|(at, side)| (2..side - 2).contains(at));
        match n % 12 {
            2..6 if is_inner => 3,
            6..10 if is_inner => 7,
            _ => 0,
        }
    };
    file.extend((0..1200).map(label));
    file
}

#[tokio::test]
async fn a_label_of_an_uploaded_scan_becomes_a_solid_and_another_one_is_refused_with_those_of_the_file() {
    let server = TestServer::start(&[]);
    let upload = async |unit: &str, label| {
        let mut sessions = server.sessions().await;
        let request = pb::UploadMeshRequest {
            file_name: "scan.nrrd".into(),
            part: scan(),
            last: true,
            unit: unit.into(),
            label,
            ..Default::default()
        };
        sessions.upload_mesh(request).await.map(tonic::Response::into_inner)
    };
    // 144 voxels of 125 mm³, in the unit that the file states, or in another one.
    for (unit, volume_m3) in [("", 18e-6), ("mm", 18e-6), ("cm", 18e-3)] {
        let sent = upload(unit, Some(7)).await.unwrap();
        let report = sent.report.unwrap();
        assert!((report.volume_m3.unwrap() / volume_m3 - 1.0).abs() < 1e-3, "{unit}: {report:?}");
        assert!(!report.refused && report.holes == 0, "{report:?}");
        let least = report.extent.unwrap().least_m.unwrap();
        // Corners are rounded, and the volume is that of the voxels: the sides are half a voxel farther out.
        let voxel_m = if unit == "cm" { 0.05 } else { 0.005 };
        assert!((least.x / voxel_m - 5.0).abs() < 0.5 && (least.y / voxel_m - 1.0).abs() < 0.5, "{least:?}");
    }
    let sent = upload("", Some(3)).await.unwrap();
    let solid = pb::Solid {
        mesh_id: sent.mesh_id,
        cells: Some(500),
        youngs_modulus_pa: Some(8e3),
        poissons_ratio: Some(0.45),
        foundation_n_per_m3: Some(2e4),
        ..Default::default()
    };
    let scene = pb::Scene { name: "scan".into(), solid: Some(solid), ..Default::default() };
    let session = server.create(Source::Scene(scene), true).await.unwrap();
    assert!(session.points > 100, "{session:?}");
    for (unit, label, reason, field, says) in [
        ("mm", None, "MISSING", "label", "choose one of its labels 3, 7"),
        ("mm", Some(4), "OUT_OF_RANGE", "label", "no voxel has the label 4: there are 3, 7"),
        ("mm", Some(0), "OUT_OF_RANGE", "label", "no voxel has the label 0: there are 3, 7"),
        ("ell", Some(3), "WRONG_KIND", "unit", "must be"),
        ("", None, "MISSING", "unit", "is missing"),
    ] {
        let refused = upload(unit, label).await.unwrap_err();
        assert_eq!(told(&refused), (Code::InvalidArgument, reason.into(), field.into()), "{refused:?}");
        assert!(refused.message().contains(says), "{}", refused.message());
    }
}

async fn delete_journal(server: &TestServer, id: &str) -> Result<u32, Status> {
    let request = pb::DeleteJournalRequest { session_id: id.to_owned() };
    Ok(server.sessions().await.delete_journal(request).await?.into_inner().files)
}

#[tokio::test]
async fn a_mesh_that_was_sent_stays_in_journals_only_as_long_as_its_owner_is_told() {
    let folder = folder();
    let scene = scene(&folder);
    let file = std::fs::read(folder.path().join("ball.obj")).unwrap();
    let (journals, config) = (folder.path().join("journals"), folder.path().join("patient.conf"));
    std::fs::write(&config, "[limits]\nwork_s = 600.0\n").unwrap();
    let start = |more: &[&str]| {
        let usual = ["--journal", journals.to_str().unwrap(), "--config", config.to_str().unwrap()];
        TestServer::start(&[&usual[..], more].concat())
    };
    let kept = || palpate_session::journal::file::list(&journals).unwrap().len();
    let server = start(&[]);
    let sent = upload(&server, &file, 100_000, "m", false).await.unwrap();
    assert!(sent.kept.contains("30 days") && sent.kept.contains("DeleteJournal"), "{}", sent.kept);
    let id = server.create(Source::Scene(on(&sent.mesh_id, &scene)), true).await.unwrap().session_id;
    assert_eq!(kept(), 1);
    let refused = delete_journal(&server, &id).await.unwrap_err();
    assert!(refused.message().contains("still runs: delete that first"), "{refused:?}");
    server.sessions().await.delete_session(pb::DeleteSessionRequest { session_id: id.clone() }).await.unwrap();
    assert_eq!((kept(), delete_journal(&server, &id).await.unwrap(), kept()), (1, 1, 0));
    for unknown in [id.as_str(), "../patient", ""] {
        assert_eq!(delete_journal(&server, unknown).await.unwrap_err().code(), Code::NotFound, "{unknown}");
    }
    drop(server);

    // Kept out of journals: a session on it has none, and the others have theirs.
    let server = start(&["--journal-meshes", "false"]);
    let sent = upload(&server, &file, 100_000, "m", false).await.unwrap();
    assert_eq!(sent.kept, "");
    let session = server.create(Source::Scene(on(&sent.mesh_id, &scene)), true).await.unwrap();
    assert_eq!((session.journal, kept()), (None, 0));
    server.paper(true).await;
    assert_eq!(kept(), 1);
}

#[tokio::test]
async fn a_material_and_inclusions_are_told_and_what_is_wrong_with_them_is_named() {
    let (folder, server) = ball();
    let scene = scene_of(&folder, "lumps");
    let file = std::fs::read(folder.path().join("lumps.obj")).unwrap();
    let mesh_id = upload(&server, &file, 1 << 19, "m", false).await.unwrap().mesh_id;
    let own = server.create(Source::Scene(on(&mesh_id, &scene)), true).await.unwrap();
    let by_name = server.create(Source::SceneName("lumps".into()), true).await.unwrap();
    let told_scene = own.scene.unwrap();
    assert_eq!(told_scene, by_name.scene.unwrap());
    assert_eq!(told_scene, palpate_session::wire::scene::scene(&scene));
    let material = told_scene.material.unwrap();
    assert_eq!((material.youngs_modulus_pa, material.density_kg_per_m3), (Some(2000.0), Some(1060.0)));
    assert_eq!(told_scene.inclusions[1].group.as_deref(), Some("lump"));
    // The reference stiffness k is changed.
    let request =
        pb::UpdateTissueRequest { session_id: own.session_id, stiffness_n_per_m: Some(11.0), ..Default::default() };
    let changed = server.sessions().await.update_tissue(request).await.unwrap().into_inner().session.unwrap();
    let changed = changed.scene.unwrap();
    assert_eq!(changed.springs.unwrap().stiffness_n_per_m, Some(11.0));
    assert_eq!((changed.material, changed.inclusions), (Some(material), told_scene.inclusions));

    let mut soft = on(&mesh_id, &scene);
    soft.material.as_mut().unwrap().youngs_modulus_pa = Some(-1.0);
    let mut lamp = on(&mesh_id, &scene);
    lamp.inclusions[1].group = Some("lamp".into());
    let mut both = on(&mesh_id, &scene);
    both.damping = Some(pb::Damping { coefficient_n_s_per_m: Some(0.1) });
    for (scene, field, words) in [
        (soft, "scene.material.youngs_modulus_pa", "above 0"),
        (lamp, "scene.inclusions[1].group", "did you mean `lump`"),
        (both, "scene.damping", "does not go with [material]"),
    ] {
        let refused = server.create(Source::Scene(scene), true).await.unwrap_err();
        assert_eq!((told(&refused).0, told(&refused).2.as_str()), (Code::InvalidArgument, field), "{refused:?}");
        assert!(refused.message().contains(words), "{refused:?}");
    }
}

#[tokio::test]
async fn a_session_tells_what_was_done_with_its_mesh() {
    let (folder, server) = ball();
    let scene = scene(&folder);
    let file = std::fs::read_to_string(folder.path().join("ball.obj")).unwrap();
    // Each triangle turned over, and a vertex that none has, far away.
    let turned = file.lines().map(|line| match line.split_whitespace().collect::<Vec<_>>()[..] {
        ["f", a, b, c] => format!("f {b} {a} {c}\n"),
        _ => format!("{line}\n"),
    });
    let turned = turned.collect::<String>() + "v 90 0 0\n";
    let sent = upload(&server, turned.as_bytes(), 1 << 19, "m", false).await.unwrap();
    let report = sent.report.unwrap();
    assert!(!report.refused && report.vertices == 162 && report.volume_m3.unwrap() > 4e-4, "{report:?}");
    assert!(report.extent.unwrap().most_m.unwrap().x < 1.0);
    let session = server.create(Source::Scene(on(&sent.mesh_id, &scene)), true).await.unwrap();
    for word in ["turned outward", "no triangle has them: 1."] {
        assert!(report.problems.iter().any(|problem| problem.what.contains(word)), "{word}: {:?}", report.problems);
        assert!(session.warnings.iter().any(|warning| warning.contains(word)), "{word}: {:?}", session.warnings);
    }
}

#[tokio::test]
async fn a_mesh_that_is_none_is_refused_by_element_and_place() {
    let server = TestServer::start(&[]);
    let whole = ICOSPHERE.as_bytes();
    // Cut in the middle of a vertex: one of its coordinates is missing.
    let cut = ICOSPHERE.find("\nf ").unwrap() - 20;
    let refused = upload(&server, &whole[..cut], 4096, "m", false).await.unwrap_err();
    assert_eq!(told(&refused), (Code::InvalidArgument, "UNREADABLE".into(), "part".into()));
    assert!(refused.message().contains("ball.obj: line"), "{refused:?}");
    for (unit, reason) in [("", "MISSING"), ("furlong", "WRONG_KIND")] {
        let refused = upload(&server, whole, 1 << 19, unit, false).await.unwrap_err();
        assert_eq!(told(&refused), (Code::InvalidArgument, reason.into(), "unit".into()));
    }
    // A hole is reported but not refused; repair fills it.
    let with_hole = ICOSPHERE.trim_end().rsplit_once('\n').unwrap().0;
    let report = upload(&server, with_hole.as_bytes(), 1 << 19, "m", false).await.unwrap().report.unwrap();
    assert_eq!((report.holes, report.volume_m3, report.refused), (1, None, false), "{report:?}");
    let report = upload(&server, with_hole.as_bytes(), 1 << 19, "m", true).await.unwrap().report.unwrap();
    assert_eq!((report.holes, report.refused), (0, false), "{report:?}");
    assert!(!report.problems.is_empty());
    // An edge with three triangles can't be used, and is reported with its place.
    let bad = format!("{ICOSPHERE}v 0 0 0\nf 1 43 163\n");
    let sent = upload(&server, bad.as_bytes(), 1 << 19, "m", false).await.unwrap();
    let report = sent.report.unwrap();
    assert!(report.refused && report.problems[0].place_m.is_some(), "{report:?}");
    assert_eq!(report.problems[0].element, "edge 0-42");
}

#[tokio::test]
async fn a_mesh_above_the_limits_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, "[limits]\nmesh_bytes = 14000\nmesh_vertices = 161\n").unwrap();
    let server = TestServer::start(&["--config", config.to_str().unwrap()]);
    let long = [ICOSPHERE.as_bytes(), &[b'\n'; 1000]].concat();
    let refused = upload(&server, &long, 1000, "m", false).await.unwrap_err();
    assert_eq!(told(&refused), (Code::ResourceExhausted, "TOO_LARGE".into(), "part".into()));
    let refused = upload(&server, ICOSPHERE.as_bytes(), 1000, "m", false).await.unwrap_err();
    assert!(refused.message().contains("161"), "{refused:?}");
}

/// A force, a moving force and a grasp.
const SCRIPT: &str = r#"
name = "poking"
scenes = ["ball", "lumps", "coarse", "organ"]
duration_s = 0.1
sample_every_s = 0.02
[[force]]
vertex = 7
force_n = [0.1, -0.2, -0.3]
falloff_per_m = 80.0
falloff_offset = 0.0
profile = { type = "constant" }
[[force]]
at_m = [0.0, -0.05, 0.0]
force_n = [0.0, 0.3, 0.0]
falloff_per_m = 80.0
falloff_offset = 0.0
profile = { type = "sine", frequency_hz = 20.0 }
[[tool]]
vertex = 40
moves = [{ from_s = 0.01, to_s = 0.06, by_m = [0.0, 0.002, 0.001] }]
[[tissue]]
at_s = 0.04
stiffness_n_per_m = 11.0
"#;

/// An organ that is made, and so has no file.
const ORGAN: &str = r#"
name = "organ"
[mesh]
organ = { name = "gallbladder", edge_m = 0.0035 }
fixed = { group = "bed" }
"#;

#[test]
fn a_replay_on_a_mesh_has_the_hash_of_the_run_offline() {
    let (folder, server) = ball();
    let script = folder.path().join("poking-script.toml");
    // Forces and tools are everywhere on the ball; the organ is elsewhere.
    let on_organ = SCRIPT.replace("[0.0, -0.05, 0.0]", "[0.02, 0.0, -0.02]");
    let organ_script = folder.path().join("organ-script.toml");
    std::fs::write(&script, SCRIPT).unwrap();
    std::fs::write(&organ_script, on_organ).unwrap();
    let file = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let coarse = LUMPS.replace("fixed =", "vertices = 80\nfixed =").replace("\"lumps\"", "\"coarse\"");
    std::fs::write(file("coarse.toml"), coarse).unwrap();
    let material = &LUMPS[LUMPS.find("[material]").unwrap()..LUMPS.find("[[inclusion]]").unwrap()];
    let stepping = &LUMPS[LUMPS.find("[stepping]").unwrap()..];
    std::fs::write(file("organ.toml"), format!("{ORGAN}{material}{stepping}")).unwrap();
    let summary = |output: std::process::Output| {
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        let lines: Vec<serde_json::Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        let last = lines.len() - 1;
        (lines[1..last].to_vec(), lines[last]["summary"]["final_hash"].clone())
    };
    for (name, script) in [("ball", &script), ("lumps", &script), ("coarse", &script), ("organ", &organ_script)] {
        let (file, script) = (file(&format!("{name}.toml")), script.to_str().unwrap());
        let expected = summary(palpate(&["run", &file, script, "--held"]));
        for scene in [name, &file] {
            let output = std::process::Command::new(client_program())
                .args(["replay", script, "--server", &server.url, "--scene", scene])
                .current_dir(repository())
                .output()
                .unwrap();
            assert_eq!(summary(output), expected, "{scene}");
        }
    }
}

#[tokio::test]
async fn a_tip_touches_a_mesh_by_the_law_of_the_place_where_it_is() {
    let (folder, server) = ball();
    let scene = scene(&folder);
    let model = Model::compile(&scene, &Limits::default()).unwrap();
    let session = server.create(by_name(), false).await.unwrap().session_id;
    let tip = Tip { radius_m: 0.02, friction: 0.0, ..Tip::default() };
    let device = touch::device(&Device::named("omega3").unwrap());
    let tip_message = pb::Tip { radius_m: tip.radius_m, friction: Some(0.0), ..Default::default() };
    let wanted = pb::TouchOpen { device: Some(device), tip: Some(tip_message), ..open(&session, &[0]) };
    let mut stream = TestTouch::open(&server, wanted).await.unwrap();
    let first = touch::from_law(&stream.opened.take().unwrap().law.unwrap()).unwrap();
    let mut laws = vec![first];
    // Below, and then from the side.
    for (begin, outward) in [(1, -DVec3::Z), (1_000_001, DVec3::new(0.6, -0.8, 0.0))] {
        let nearest = scene.shape().nearest(0.05 * outward);
        let disc = Disc { radius_m: tip.radius_m, at_m: scene.shape().rest_m(nearest) };
        let expected =
            force_law::exact_within(&model, &palpate_tissue::Cuts::default(), disc, u64::MAX, &AtomicBool::new(false))
                .unwrap();
        let (mut is_told, mut felt_n, mut step) = (false, DVec3::ZERO, 0_u32);
        tokio::time::timeout(Duration::from_secs(60), async {
            while !(is_told && felt_n.length() > 0.01) {
                step += 1;
                // Inward by 4 mm, after it has come near from outside; then it stays.
                let away_m = 0.055 - 1e-5 * f64::from(step.min(900));
                let position_m = vector(away_m * outward);
                let tip = Some(tip_message);
                let pose = pb::Pose { position_m, tip, ..Default::default() };
                let action = Some(pb::command::Action::Pose(pose));
                let sequence = Some(begin + u64::from(step));
                stream.command(pb::Command { tool: 0, sequence, action, ..Default::default() }).await;
                match stream.hear().await.unwrap().unwrap() {
                    Heard::ForceLaw(update) => {
                        assert_eq!((update.reason.as_str(), update.tissue_step), ("", None));
                        let law = update.law.unwrap();
                        assert_eq!(law.number as usize, laws.len());
                        laws.push(touch::from_law(&law).unwrap());
                    }
                    Heard::Sample(sample) => {
                        let Some(tool) = sample.tools.first() else { continue };
                        let Some(model) = &tool.local_model else { continue };
                        // Of the place before.
                        if tool.acknowledged_sequence < begin {
                            continue;
                        }
                        is_told = laws[model.law as usize] == expected;
                        felt_n = from_vector(tool.force_on_tool_n.as_ref());
                        if felt_n.length() > 0.01 {
                            let radial = felt_n.normalize().dot(outward);
                            assert!(radial > 0.9, "{felt_n} of {outward}");
                        }
                    }
                    _ => {}
                }
            }
        })
        .await
        .unwrap_or_else(|_| panic!("{outward}: {felt_n} N, {} laws", laws.len()));
        // Away from the surface, so that the way to the next place is free.
        stream.command(command_now(pb::command::Action::Release(pb::Release {}), begin + 999_999)).await;
    }
    assert!(laws.len() >= 3, "one for each place");
}

fn command_now(action: pb::command::Action, sequence: u64) -> pb::Command {
    pb::Command { tool: 0, sequence: Some(sequence), action: Some(action), ..Default::default() }
}
