//! The readers of bytes of others, one function each. libFuzzer calls them, and so does `tests/fuzz.rs` with inputs
//! of its own. None may panic on any input; the values of an accepted input must be finite and within bounds. Each
//! returns whether it accepted the input.
#![allow(
    missing_docs,
    unreachable_pub,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::missing_panics_doc
)]

use std::path::Path;
use std::sync::{Arc, OnceLock};

use glam::{DQuat, DVec3};
use palpate::server::config::Config;
use palpate::server::identity::{self, KnownCallers, Role};
use palpate_geometry::{Group, TriangleMesh};
use palpate_haptics::{
    Device, Envelope, Instrument, InstrumentPart, InstrumentPose, InstrumentTip, Law, Port, Renderer, Tip,
};
use palpate_proto::{datagram as of_touch, instrument, pb, touch};
use palpate_session::Session;
use palpate_session::command::{Command, Due};
use palpate_session::intake::Intake;
use palpate_session::journal::records::{self, Chunk};
use palpate_session::journal::{JournalReader, Replay, Topic, message as of_journal, pb as journal_pb};
use palpate_session::led_instrument::LedInstrument;
use palpate_session::sample_selection::Sampler;
use palpate_session::snapshot::{self, Saved};
use palpate_session::surface::Refinement;
use palpate_session::wire;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::action_check::check_tip;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::record::{Record, write_line};
use palpate_tissue::scene::script::{Action, Script};
use palpate_tissue::scene::{FixedVertices, Mesh, MeshShape, PAPER, Scene};
use palpate_tissue::shape::RestShape;
use prost::Message;

/// Whether an input was accepted.
pub type Taker = fn(&[u8]) -> bool;

/// A decoder.
pub struct FuzzTarget {
    pub name: &'static str,
    pub run: Taker,
    /// Valid inputs to begin with.
    pub seeds: fn() -> Vec<Vec<u8>>,
}

pub const TARGETS: [FuzzTarget; 10] = [
    FuzzTarget { name: "journal", run: journal, seeds: journal_seeds },
    FuzzTarget { name: "scene", run: scene, seeds: scene_seeds },
    FuzzTarget { name: "script", run: script, seeds: script_seeds },
    FuzzTarget { name: "request", run: request, seeds: request_seeds },
    FuzzTarget { name: "datagram", run: datagram, seeds: datagram_seeds },
    FuzzTarget { name: "sample", run: sample, seeds: sample_seeds },
    FuzzTarget { name: "record", run: record, seeds: record_seeds },
    FuzzTarget { name: "frame", run: frame, seeds: frame_seeds },
    FuzzTarget { name: "config", run: config, seeds: config_seeds },
    FuzzTarget { name: "snapshot", run: snapshot, seeds: snapshot_seeds },
];

/// Limits for reading an input; only smaller inputs are compiled.
fn limits() -> Limits {
    Limits { points: 1 << 12, substeps: 1000, ..Limits::default() }
}

const COMPILED_POINTS: usize = 64;

/// Compiles a small scene and steps it.
fn step(scene: &Scene) -> bool {
    if scene.shape().point_count() > COMPILED_POINTS {
        return true;
    }
    let small = Limits { substeps: 20, ..limits() };
    let Ok(model) = Model::compile(scene, &small) else { return false };
    let mut session = Session::new(&model);
    session.advance(&mut Vec::new(), |_| {});
    true
}

pub fn scene(bytes: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(bytes) else { return false };
    Scene::parse("fuzz", text, &[], &limits()).is_ok_and(|scene| step(&scene))
}

fn scene_seeds() -> Vec<Vec<u8>> {
    let small = PAPER.replace("[31, 31]", "[5, 4]");
    let more = "[sleep]\ntolerance = 1e-4\n[stepping]\nrate_hz = 500.0\nintegrator = \"rk4\"\nprecision = \"f64\"\n";
    vec![PAPER.into(), small.clone().into(), include_str!("../../scenes/liver.toml").into(), (small + more).into()]
}

/// A tissue of 5 × 5 points, and the parts of it that never change.
fn model() -> &'static Arc<Model> {
    static MODEL: OnceLock<Arc<Model>> = OnceLock::new();
    MODEL.get_or_init(|| {
        let text = PAPER.replace("[31, 31]", "[5, 5]");
        let scene = Scene::parse("fuzz", &text, &[], &limits()).expect("the scene is sound");
        assert_eq!(scene.sheet().unwrap().points, [5, 5], "the paper's scene has other points");
        Model::compile(&scene, &limits()).expect("the scene is sound")
    })
}

pub fn script(bytes: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(bytes) else { return false };
    static SCENE: OnceLock<Scene> = OnceLock::new();
    let scene = SCENE.get_or_init(|| Scene::parse("fuzz", PAPER, &[], &limits()).expect("the scene is sound"));
    let Ok(script) = Script::parse("fuzz", text, Path::new("nowhere"), scene, &limits()) else { return false };
    let _actions: usize = (0..3).map(|step| script.actions_at(step).count()).sum();
    true
}

fn script_seeds() -> Vec<Vec<u8>> {
    let scripts = [include_str!("../../scripts/vertical-60.toml"), include_str!("../../scripts/oblique-100.toml")];
    scripts.iter().map(|text| text.as_bytes().to_vec()).collect()
}

/// Requests of the protocol that can be processed further than decoding without a server.
pub const REQUESTS: &[(&str, Taker)] = &[
    ("CreateSessionRequest", |bytes| {
        use pb::create_session_request::Source;
        match pb::CreateSessionRequest::decode(bytes).map(|request| request.source) {
            Ok(Some(Source::Scene(scene))) => {
                wire::scene::from_scene(&scene, scene.mesh.as_ref().map(|_| tetrahedron()))
                    .is_ok_and(|scene| step(&scene))
            }
            other => other.is_ok(),
        }
    }),
    ("TouchRequest", |bytes| match pb::TouchRequest::decode(bytes).map(|request| request.message) {
        Ok(Some(pb::touch_request::Message::Open(message))) => open(&message),
        Ok(Some(pb::touch_request::Message::Command(command))) => command_all(&[command]),
        other => other.is_ok(),
    }),
    ("SendCommandsRequest", |bytes| {
        pb::SendCommandsRequest::decode(bytes).is_ok_and(|request| command_all(&request.commands))
    }),
    ("AcquireToolRequest", |bytes| {
        pb::AcquireToolRequest::decode(bytes).is_ok_and(|request| {
            let mut intake = Intake::new(&model().scene, &limits());
            let tools: Vec<u32> = std::iter::once(request.tool).chain(request.more_tools).collect();
            intake.acquire(&tools, &request.holder, request.lease_s.unwrap_or(2.0), 1, 0).is_ok()
        })
    }),
    ("WatchSamplesRequest", |bytes| {
        pb::WatchSamplesRequest::decode(bytes).is_ok_and(|request| {
            let (every, deadband) = (request.sample_every_steps, request.deadband.as_ref());
            let sampling = wire::sample::sampling(every, None, deadband, request.heartbeat_s, false);
            sampling.is_ok_and(|sampling| Sampler::new(sampling, 1000.0).next_due(7) > 7)
        })
    }),
    ("ProbeRequest", |bytes| {
        pb::ProbeRequest::decode(bytes).is_ok_and(|request| {
            let every = wire::every("every_steps", request.every_steps).is_ok();
            match &request.r#where {
                Some(pb::probe_request::Where::Points(points)) => points.points.iter().all(|point| {
                    let name = wire::from_point(Some(point), None).expect("a point has a name");
                    model().shape().find("points", name).is_ok_and(|point| point.index() < model().len())
                }),
                Some(pb::probe_request::Where::Vertices(vertices)) => vertices.vertices.iter().all(|vertex| {
                    let name = wire::from_point(None, Some(*vertex)).expect("a vertex has a name");
                    ball().find("vertices", name).is_ok_and(|point| point.index() < ball().point_count())
                }),
                _ => every,
            }
        })
    }),
    ("GetMeshRequest", |bytes| {
        pb::GetMeshRequest::decode(bytes)
            .is_ok_and(|request| Refinement::new(&model().scene, request.refinement, &limits()).is_ok())
    }),
    ("WatchFramesRequest", |bytes| {
        pb::WatchFramesRequest::decode(bytes)
            .is_ok_and(|request| Refinement::new(&model().scene, request.refinement, &limits()).is_ok())
    }),
    ("UploadMeshRequest", |bytes| {
        pb::UploadMeshRequest::decode(bytes).is_ok_and(|request| {
            let (unit, label) = (request.unit.parse().ok(), request.label.map(i64::from));
            if unit.is_none() && label.is_none() {
                return false;
            }
            let within = palpate_geometry::ReadLimits { bytes: 1 << 16, vertices: 1000, triangles: 4000 };
            let (name, part, mut pay) = (&request.file_name, &request.part, |_: u64| true);
            let read = palpate_geometry::read_paid(name, part, label, unit, &|_| None, &within, &mut pay);
            read.is_ok_and(|read| {
                let report = palpate_geometry::report(&read.mesh);
                report.refusal().is_some() || Mesh::of(read.mesh, 0.01, FixedVertices::Rim).is_ok()
            })
        })
    }),
    ("UpdateTissueRequest", |bytes| {
        pb::UpdateTissueRequest::decode(bytes).is_ok_and(|request| {
            let change = wire::scene::from_change(&request);
            model().changed(&change, &model().scene, &limits()).is_ok()
        })
    }),
    // From a client that sends bytes that are not a request.
    ("", |bytes| pb::Scene::decode(bytes).is_ok_and(|scene| wire::scene::from_scene(&scene, None).is_ok())),
];

/// Every request of the protocol.
pub fn requests() -> &'static [(&'static str, Taker)] {
    static ALL: OnceLock<Vec<(&str, Taker)>> = OnceLock::new();
    ALL.get_or_init(|| {
        let is_own = |name: &str| REQUESTS.iter().any(|request| request.0 == name);
        let others = pb::DECODERS.iter().filter(|decoder| !is_own(decoder.0));
        REQUESTS.iter().chain(others).copied().collect()
    })
}

/// The first byte selects the request that the others encode.
pub fn request(bytes: &[u8]) -> bool {
    let all = requests();
    bytes.split_first().is_some_and(|(which, bytes)| all[usize::from(*which) % all.len()].1(bytes))
}

fn open(open: &pb::TouchOpen) -> bool {
    let shape = model().shape();
    let device = open.device.as_ref().map(touch::from_device);
    let tip = touch::from_tip("tip", open.tip.as_ref()).unwrap_or_default();
    let only = (!open.tools.is_empty()).then(|| open.tools.clone());
    let (every, deadband) = (open.sample_every_steps, open.deadband.as_ref());
    let sampling = wire::sample::sampling(every, only, deadband, open.heartbeat_s, open.device.is_some());
    let mut intake = Intake::new(&model().scene, &limits());
    let held = intake.acquire(&open.tools, &open.holder, open.lease_s.unwrap_or(2.0), 1, 0).is_ok();
    if check_tip("tip", shape, &tip).is_ok() {
        assert!(tip.radius_m.is_finite() && tip.friction.is_finite());
    }
    let taken = sampling.map(|sampling| Sampler::new(sampling, 1000.0).next_due(7));
    let instruments = open.instruments.iter().map(|message| instrument::from_instrument("instruments[0]", message));
    held && taken.is_ok()
        && instruments.into_iter().all(|read| read.is_ok())
        && device.is_none_or(|device| device.is_ok())
}

/// The smallest closed mesh.
fn tetrahedron() -> &'static TriangleMesh {
    static MESH: OnceLock<TriangleMesh> = OnceLock::new();
    MESH.get_or_init(|| TriangleMesh {
        vertices_m: [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]].map(Into::into).to_vec(),
        triangles: vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]],
        uv: None,
        groups: vec![Group { name: "base".into(), vertices: vec![0, 1, 2] }],
        regions: Vec::new(),
    })
}

/// Its shape as a tissue.
fn ball() -> &'static MeshShape {
    static SHAPE: OnceLock<Mesh> = OnceLock::new();
    let made = || Mesh::of(tetrahedron().clone(), 0.01, FixedVertices::None).expect("the mesh is sound");
    &SHAPE.get_or_init(made).shape
}

/// Reads a command: to a tool, or to the grasper.
fn commands_of(message: &pb::Command, shape: &dyn RestShape) -> Result<Vec<Command>, String> {
    let Some(pb::command::Action::Instrument(pose)) = &message.action else {
        let read = wire::command::from_command(message, shape, 1).map(|command| vec![command]);
        return read.map_err(|refusal| refusal.to_string());
    };
    let instrument = instrument::from_instrument("instruments[0]", &grasper()).expect("it is sound");
    let (pose, velocity) = instrument::from_pose(pose, &instrument).map_err(|refusal| refusal.to_string())?;
    let grasper = LedInstrument::new(instrument, 0);
    let command = wire::command::with_action(message, Action::Release, 1);
    Ok(grasper.lead(&command, &pose, velocity.as_ref(), shape))
}

/// Submits all of them to one session, all or none, and does two steps after them.
fn command_all(messages: &[pb::Command]) -> bool {
    let scene = &model().scene;
    let on_mesh: Vec<_> = messages.iter().map(|message| commands_of(message, ball())).collect();
    let fit_mesh = on_mesh.iter().all(Result::is_ok);
    for command in on_mesh.into_iter().flatten().flatten() {
        if let Action::Push(poke) = command.action {
            assert!(poke.centre_m.is_finite(), "{poke:?}");
        }
    }
    let mut intake = Intake::new(scene, &limits());
    intake.acquire(&[0, 1, 2], "fuzz", 60.0, 1, 0).expect("tools are free");
    let commands: Result<Vec<_>, _> = messages.iter().map(|message| commands_of(message, scene.shape())).collect();
    let Ok(commands) = commands else { return fit_mesh };
    if intake.submit(1, commands.concat(), 1).is_err() {
        return false;
    }
    let mut session = Session::new(model());
    let mut due = Vec::new();
    for _ in 0..2 {
        intake.take_due(session.step_count(), 2, &mut due);
        session.advance(&mut due, |_| {});
        let sample = session.sample(None);
        for contact in sample.tools.iter().filter_map(|tool| tool.contact) {
            assert!(contact.displacement_m.is_finite() && contact.force_on_tool_n.is_finite(), "{contact:?}");
        }
    }
    true
}

/// A shaft in a port and two jaws, whose tips are tools 0 to 2.
fn grasper() -> pb::Instrument {
    let tip = |offset_m, part| InstrumentTip { offset_m, tip: Tip { radius_m: 0.02, ..Tip::default() }, part };
    let tips = vec![
        tip(-0.05 * DVec3::X, InstrumentPart::Body),
        tip(DVec3::ZERO, InstrumentPart::UpperJaw),
        tip(DVec3::ZERO, InstrumentPart::LowerJaw),
    ];
    let port = Some(Port { place_m: DVec3::new(0.1, 0.1, 1.0), handle_m: 2.0 });
    instrument::instrument(&Instrument { tips, hinge_m: -0.03 * DVec3::X, port, jaw_torque_limit_n_m: Some(0.01) }, 0)
}

fn request_seeds() -> Vec<Vec<u8>> {
    let vector = |x, y, z| Some(pb::Vector3 { x, y, z });
    let point = pb::GridPoint { x: 2, y: 1 };
    let force = pb::command::Action::Force(pb::Force {
        centre: Some(pb::force::Centre::Point(point)),
        force_n: vector(0.1, 0.0, -1.0),
        falloff_per_m: Some(150.0),
        falloff_offset: Some(0.0),
    });
    let position = pb::command::Action::Position(pb::Position {
        point: Some(point),
        vertex: None,
        target: Some(pb::position::Target::DisplacementM(pb::Vector3 { x: 0.0, y: 0.0, z: -0.01 })),
    });
    let pose = pb::command::Action::Pose(pb::Pose {
        position_m: vector(0.05, 0.05, -0.002),
        orientation: Some(pb::Quaternion { w: 1.0, ..Default::default() }),
        tip_offset_m: vector(0.0, 0.0, 0.01),
        velocity_m_per_s: vector(0.01, 0.0, -0.02),
        tip: Some(pb::Tip {
            radius_m: 0.02,
            friction: Some(0.3),
            grasps: true,
            spring: Some(pb::Spring { stiffness_n_per_m: 100.0, damping_n_s_per_m: 1.0 }),
            shape: pb::TipShape::Disc.into(),
            edge_m: None,
            burn_s: 0.5,
        }),
    });
    let grasper_pose = pb::command::Action::Instrument(instrument::pose(&InstrumentPose {
        place_m: DVec3::new(0.1, 0.1, 0.01),
        orientation: DQuat::IDENTITY,
        jaw_rad: 0.4,
    }));
    let bite = |x| pb::Bite { place_m: vector(x, 0.05, 0.0), radius_m: 0.02 };
    let thread =
        pb::Thread { bites: vec![bite(0.05), bite(0.1)], length_m: 0.04, friction: 0.1, strength_n: Some(5.0) };
    let tie = pb::command::Action::Tie(pb::Tie { number: 1, kind: Some(pb::tie::Kind::Thread(thread)) });
    let actions = [force, position, pose, grasper_pose, pb::command::Action::Release(pb::Release {}), tie];
    let command = |index: usize| pb::Command {
        tool: index as u32 % 3,
        sequence: Some(index as u64 + 1),
        client_time_ns: index as u64 * 1_000_000,
        at_step: (index == 1).then_some(1),
        time_to_live_s: (index == 2).then_some(0.001),
        action: Some(actions[index % actions.len()].clone()),
    };
    let commands: Vec<_> = (0..6).map(command).collect();
    let deadband = pb::Deadband { force_n: Some(0.01), force_fraction: Some(0.1), ..Default::default() };
    let open = pb::TouchOpen {
        session_id: "0123456789abcdef".into(),
        tools: vec![0, 1, 2],
        sample_every_steps: Some(2),
        lease_s: Some(1.0),
        holder: "somebody".into(),
        deadband: Some(deadband),
        heartbeat_s: Some(0.04),
        device: Some(touch::device(&Device::named("omega3").expect("there is one"))),
        tip: Some(pb::Tip { radius_m: 0.02, friction: Some(0.2), ..Default::default() }),
        touch_stiffness: true,
        datagrams: true,
        lease_id: "0123456789abcdef0123456789abcdef".into(),
        other_tools: true,
        instruments: vec![grasper()],
    };
    let touch = |message| pb::TouchRequest { message: Some(message) }.encode_to_vec();
    let scene = pb::create_session_request::Source::Scene(wire::scene::scene(&model().scene));
    let on_mesh = pb::create_session_request::Source::Scene(pb::Scene {
        sheet: None,
        mesh: Some(pb::Mesh {
            mesh_id: "0123456789abcdef".into(),
            point_mass_kg: Some(0.01),
            vertices: None,
            fixed: Some(pb::mesh::Fixed::FixedGroup("base".into())),
        }),
        springs: Some(pb::Springs { stiffness_n_per_m: Some(10.0), bending_factor: Some(0.2), ..Default::default() }),
        ..wire::scene::scene(&model().scene)
    });
    let of_material = pb::create_session_request::Source::Scene(pb::Scene {
        mesh: Some(pb::Mesh { mesh_id: "0123456789abcdef".into(), ..Default::default() }),
        material: Some(pb::Material {
            youngs_modulus_pa: Some(5000.0),
            thickness_m: Some(0.002),
            density_kg_per_m3: Some(1000.0),
            depth_m: Some(0.02),
            foundation_n_per_m3: Some(4e5),
            damping_ratio: Some(0.7),
            foundation_group: None,
        }),
        inclusions: vec![
            pb::Inclusion {
                centre_m: vector(0.1, 0.0, 0.0),
                radius_m: Some(0.02),
                stiffness_factor: Some(3.0),
                anchor_stiffness_factor: Some(2.0),
                edge_m: Some(0.1),
                ..Default::default()
            },
            pb::Inclusion { group: Some("base".into()), stiffness_factor: Some(0.5), ..Default::default() },
        ],
        springs: Some(pb::Springs { bending_factor: Some(0.2), ..Default::default() }),
        ..Default::default()
    });
    let places = [pb::force::Centre::Vertex(3), pb::force::Centre::AtM(pb::Vector3 { x: 0.01, y: 0.02, z: 0.0 })];
    let pushes = places.map(|centre| pb::Command {
        sequence: Some(1),
        action: Some(pb::command::Action::Force(pb::Force {
            centre: Some(centre),
            force_n: vector(0.0, 0.1, 0.0),
            ..Default::default()
        })),
        ..Default::default()
    });
    let upload = |(file_name, part): (&str, &[u8])| pb::UploadMeshRequest {
        file_name: file_name.into(),
        part: part.to_vec(),
        last: true,
        unit: "mm".into(),
        label: (file_name == "two.nrrd").then_some(2),
        ..Default::default()
    };
    let uploads: [(&str, &[u8]); 5] = [
        ("organ.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"),
        ("organ.inp", b"*NODE\n1\n2,1\n3,0,1\n4,0,0,1\n*ELEMENT,TYPE=C3D4,ELSET=a\n1,1,2,3,4\n"),
        (
            "organ.mesh",
            b"MeshVersionFormatted 2\nDimension 3\nVertices 4\n0 0 0 0\n1 0 0 0\n0 1 0 0\n0 0 1 0\nTetrahedra 1\n1 2 3 4 5\nEnd\n",
        ),
        ("organ.nrrd", b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n\n\x01\x01\x01\x01\0\0\0\0"),
        ("two.nrrd", b"NRRD0004\ntype: uchar\ndimension: 3\nsizes: 2 2 2\nencoding: raw\n\n\x01\x01\x02\x02\0\0\0\0"),
    ];
    let vertices = pb::probe_request::Where::Vertices(pb::Vertices { vertices: vec![2, 0] });
    let watch = pb::WatchSamplesRequest { deadband: Some(deadband), heartbeat_s: Some(1.0), ..Default::default() };
    let points = pb::probe_request::Where::Points(pb::GridPoints { points: vec![point] });
    let mut seeds = vec![
        (
            "CreateSessionRequest",
            pb::CreateSessionRequest { source: Some(scene), ..Default::default() }.encode_to_vec(),
        ),
        (
            "CreateSessionRequest",
            pb::CreateSessionRequest { source: Some(on_mesh), ..Default::default() }.encode_to_vec(),
        ),
        (
            "CreateSessionRequest",
            pb::CreateSessionRequest { source: Some(of_material), ..Default::default() }.encode_to_vec(),
        ),
        ("ProbeRequest", pb::ProbeRequest { r#where: Some(vertices), ..Default::default() }.encode_to_vec()),
        (
            "SendCommandsRequest",
            pb::SendCommandsRequest { commands: pushes.to_vec(), ..Default::default() }.encode_to_vec(),
        ),
        ("TouchRequest", touch(pb::touch_request::Message::Open(open))),
        ("TouchRequest", touch(pb::touch_request::Message::Renew(pb::Renew { client_time_ns: 7, datagrams: false }))),
        (
            "SendCommandsRequest",
            pb::SendCommandsRequest { commands: commands.clone(), ..Default::default() }.encode_to_vec(),
        ),
        (
            "AcquireToolRequest",
            pb::AcquireToolRequest { tool: 3, lease_s: Some(1.0), more_tools: vec![4, 0], ..Default::default() }
                .encode_to_vec(),
        ),
        ("WatchSamplesRequest", watch.encode_to_vec()),
        ("ProbeRequest", pb::ProbeRequest { r#where: Some(points), ..Default::default() }.encode_to_vec()),
        ("GetMeshRequest", pb::GetMeshRequest { refinement: 3, ..Default::default() }.encode_to_vec()),
        ("WatchFramesRequest", pb::WatchFramesRequest { refinement: 10, ..Default::default() }.encode_to_vec()),
        (
            "UpdateTissueRequest",
            pb::UpdateTissueRequest {
                stiffness_n_per_m: Some(4.0),
                damping_n_s_per_m: Some(1.0),
                ..Default::default()
            }
            .encode_to_vec(),
        ),
        ("GetStateHashRequest", pb::GetStateHashRequest { at_step: Some(9), ..Default::default() }.encode_to_vec()),
    ];
    seeds.extend(uploads.map(|file| ("UploadMeshRequest", upload(file).encode_to_vec())));
    for command in commands {
        seeds.push(("TouchRequest", touch(pb::touch_request::Message::Command(command))));
    }
    let which = |name: &str| requests().iter().position(|request| request.0 == name).expect("is in the table") as u8;
    seeds.into_iter().map(|(name, bytes)| [vec![which(name)], bytes].concat()).collect()
}

/// Largest force that a device renders from any bytes of a server, N.
const MAX_N: f64 = 3.3;

/// Reads messages to a client in a haptic stream, up to the force at the device.
/// A datagram of a client, and one of a server.
pub fn datagram(bytes: &[u8]) -> bool {
    use palpate_haptics::datagram_health::DatagramHealth;
    let mut carrier = DatagramHealth::default();
    let from_server = pb::SampleDatagram::decode(bytes).is_ok_and(|message| {
        carrier.arrive(message.number, message.acknowledges, 0.0);
        assert!(!carrier.update(0.0), "nothing was sent that could be confirmed");
        message.sample.is_some()
    });
    let Ok(message) = pb::PosesDatagram::decode(bytes) else { return from_server };
    let commands: Vec<pb::Command> = message.tools.iter().flat_map(of_touch::commands).collect();
    assert!(commands.len() <= message.tools.len() * (1 + of_touch::MAX_EARLIER));
    let to_instruments: Vec<pb::Command> = of_touch::instrument_commands(&message).collect();
    let mut intake = Intake::new(&model().scene, &limits());
    intake.acquire(&[0, 1, 2], "fuzz", 60.0, 1, 0).expect("tools are free");
    let mut session = Session::new(model());
    let mut taken = false;
    for command in &commands {
        // One by one, as the server does: a late one does not cause the others to be refused.
        let Ok(command) = wire::command::from_command(command, model().scene.shape(), 1) else { continue };
        taken |= intake.submit(1, vec![Command { by_datagram: true, ..command }], 1).is_ok();
    }
    for command in &to_instruments {
        let Ok(commands) = commands_of(command, model().scene.shape()) else { continue };
        taken |= intake.submit(1, commands, 1).is_ok();
    }
    let mut due = Vec::new();
    for _ in 0..3 {
        intake.take_due(session.step_count(), 2, &mut due);
        session.advance(&mut due, |_| {});
        for contact in session.sample(None).tools.iter().filter_map(|tool| tool.contact) {
            assert!(contact.displacement_m.is_finite() && contact.force_on_tool_n.is_finite(), "{contact:?}");
        }
    }
    taken || from_server
}

fn datagram_seeds() -> Vec<Vec<u8>> {
    let posed = |sequence: u64, moves: bool| {
        let place_m = DVec3::new(0.1, 0.1, 1e-4 * sequence as f64);
        let velocity_m_per_s = moves.then_some(pb::Vector3 { x: 0.01, y: 0.0, z: -0.1 });
        let pose = pb::Pose { velocity_m_per_s, ..touch::pose(place_m, &Tip::default()) };
        of_touch::Posed { sequence, client_time_ns: 1_000_000 * (1 + sequence), pose }
    };
    let poses = |tool: u32, moves: bool| {
        let all: Vec<_> = (0..9).rev().map(|sequence| posed(sequence, moves)).collect();
        of_touch::tool_poses(tool, &all[0], all[1..].iter())
    };
    let instruments = vec![pb::PosedInstrument {
        tool: 0,
        sequence: 20,
        client_time_ns: 30_000_000,
        pose: Some(instrument::pose(&InstrumentPose::at(DVec3::new(0.1, 0.1, 0.01)))),
    }];
    let with = |tools, instruments| pb::PosesDatagram {
        number: 9,
        acknowledges: 7,
        heartbeat_s: 0.04,
        tools,
        sent_ns: 1 << 40,
        instruments,
    };
    let datagram = |tools| with(tools, Vec::new());
    let sample = pb::Sample { step: 5, tools: vec![pb::ToolSample::default()], ..Default::default() };
    let answer =
        pb::SampleDatagram { number: 7, acknowledges: 9, heartbeat_s: 0.0125, sample: Some(sample), sent_ns: 1 << 41 };
    vec![
        datagram(vec![poses(0, false)]).encode_to_vec(),
        datagram(vec![poses(0, true), poses(2, false)]).encode_to_vec(),
        with(Vec::new(), instruments).encode_to_vec(),
        answer.encode_to_vec(),
    ]
}

pub fn sample(bytes: &[u8]) -> bool {
    let Ok(response) = pb::TouchResponse::decode(bytes) else { return false };
    let device = Device::named("omega3").expect("there is one");
    let render = |law: Law, models: &mut dyn Iterator<Item = (&pb::LocalModel, u64)>| {
        let mut renderer = Renderer::new(law, Envelope::new(device, DVec3::ZERO));
        renderer.envelope.enable();
        for tick in 0..4 {
            let now_s = 1e-3 * f64::from(tick);
            if let Some((model, step)) = models.next() {
                renderer.receive(touch::from_local_model(model, step), now_s);
            }
            let force_n = renderer.tick(now_s, DVec3::new(0.0, 0.0, -1e-3 * f64::from(tick)));
            assert!(force_n.is_finite() && force_n.length() <= MAX_N + 1e-9, "{force_n}");
        }
    };
    match response.message {
        Some(pb::touch_response::Message::Opened(pb::TouchOpened { law: Some(law), .. })) => {
            touch::from_law(&law).map(|law| render(law, &mut std::iter::empty())).is_ok()
        }
        Some(pb::touch_response::Message::ForceLaw(pb::ForceLawUpdate { law: Some(law), .. })) => {
            touch::from_law(&law).map(|law| render(law, &mut std::iter::empty())).is_ok()
        }
        Some(pb::touch_response::Message::Sample(sample)) => {
            let _ = touch::wire_bytes(&sample);
            let models = sample.tools.iter().filter_map(|tool| tool.local_model.as_ref());
            render(Law::linear(500.0, 1.0), &mut models.map(|model| (model, sample.step)));
            true
        }
        other => other.is_some(),
    }
}

fn sample_seeds() -> Vec<Vec<u8>> {
    use pb::touch_response::Message as Heard;
    let vector = |x, y, z| Some(pb::Vector3 { x, y, z });
    let matrix = |k| Some(pb::Symmetric3 { xx: k, yy: k, zz: 2.0 * k, ..Default::default() });
    let model = |contact: pb::Contact| pb::LocalModel {
        sequence: 1 + contact as u64,
        client_time_ns: 1_000_000,
        position_m: vector(0.0, 0.0, -0.001),
        velocity_m_per_s: vector(0.01, 0.0, -0.01),
        force_on_tool_n: vector(0.01, 0.0, 0.3),
        stiffness_n_per_m: matrix(100.0),
        damping_n_s_per_m: matrix(1.0),
        surface_m: vector(0.0, 0.0, 0.0),
        normal: vector(0.0, 0.0, 1.0),
        curvature_per_m: matrix(20.0),
        valid_m: 0.005,
        friction: 0.2,
        contact: contact.into(),
        law: contact as u32,
    };
    let contacts = [pb::Contact::Free, pb::Contact::Sticking, pb::Contact::Sliding, pb::Contact::Holding];
    let tools = contacts.map(|contact| pb::ToolSample { local_model: Some(model(contact)), ..Default::default() });
    let mut messages: Vec<Heard> = tools
        .iter()
        .map(|tool| Heard::Sample(pb::Sample { step: 5, tools: vec![*tool], ..Default::default() }))
        .collect();
    messages.push(Heard::Sample(pb::Sample { step: 7, tools: tools.to_vec(), ..Default::default() }));
    let law = touch::law(&Law::linear(300.0, 1.0), 1);
    let update = pb::ForceLawUpdate { coarse_number: 0, law: Some(law.clone()), ..Default::default() };
    messages.push(Heard::ForceLaw(update));
    messages.push(Heard::Opened(pb::TouchOpened { step: 3, law: Some(law), ..Default::default() }));
    messages.into_iter().map(|message| pb::TouchResponse { message: Some(message) }.encode_to_vec()).collect()
}

/// Reads a part of a record for the file of a replay.
pub fn record(bytes: &[u8]) -> bool {
    let Ok(message) = pb::ProbeResponse::decode(bytes) else { return false };
    let mut record = Record::default();
    let _ = wire::sample::add_to_record(&mut record, &message);
    let mut line = Vec::new();
    write_line(&mut line, &record).expect("memory takes all");
    assert_eq!(line.iter().filter(|byte| **byte == b'\n').count(), 1);
    true
}

fn record_seeds() -> Vec<Vec<u8>> {
    let vector = Some(pb::Vector3 { x: 0.1, y: -0.2, z: 3e-9 });
    let point = pb::PointRecord {
        point: Some(pb::GridPoint { x: 2, y: 3 }),
        displacement_m: vector,
        spring_n: vector,
        constraint_n: vector,
        ..Default::default()
    };
    let energy = Some(pb::Energy { kinetic_j: 1.0, spring_j: 2.0, anchor_j: 3.0 });
    let tool = pb::ToolRecord { tool: 1, place_m: vector, displacement_m: vector, force_on_tool_n: vector };
    let (points, tools) = (vec![point; 3], vec![tool]);
    let last = pb::ProbeResponse { step: 9, points, tools, energy, last: true, ..Default::default() };
    vec![last.encode_to_vec(), pb::ProbeResponse { last: false, ..last }.encode_to_vec()]
}

/// Reads a frame, a mesh or a session as a client does: the result is written and read again as the same.
pub fn frame(bytes: &[u8]) -> bool {
    fn again<M: Message + Default + PartialEq>(bytes: &[u8]) -> bool {
        let Ok(message) = M::decode(bytes) else { return false };
        let written = message.encode_to_vec();
        // NaN does not equal itself, but its bytes do.
        let read = M::decode(&*written).expect("what was written can be read");
        assert_eq!(read.encode_to_vec(), written);
        true
    }
    match bytes.split_first() {
        Some((which, bytes)) if which % 3 == 0 => again::<pb::WatchFramesResponse>(bytes),
        Some((which, bytes)) if which % 3 == 1 => again::<pb::GetMeshResponse>(bytes),
        Some((_, bytes)) => again::<pb::Session>(bytes),
        None => false,
    }
}

fn frame_seeds() -> Vec<Vec<u8>> {
    let patch =
        pb::Patch { first_x: 1, count_x: 2, count_y: 3, displacement: vec![7; 36].into(), ..Default::default() };
    let frame = pb::WatchFramesResponse {
        viewer_id: "viewer".into(),
        frame_id: 9,
        encoding: pb::Encoding::I16.into(),
        patches: vec![patch; 2],
        ..Default::default()
    };
    let mesh = pb::GetMeshResponse {
        vertices_x: 3,
        vertices_y: 2,
        rest_position_m: vec![0.5; 18],
        triangles: vec![0, 1, 2, 1, 3, 2],
        ..Default::default()
    };
    let held_tools = vec![pb::HeldTool { tool: 1, holder: "somebody".into() }];
    let session =
        pb::Session { scene: Some(wire::scene::scene(&model().scene)), step: 9, held_tools, ..Default::default() };
    let messages = [frame.encode_to_vec(), mesh.encode_to_vec(), session.encode_to_vec()];
    messages.into_iter().enumerate().map(|(which, bytes)| [vec![which as u8], bytes].concat()).collect()
}

/// Reads a configuration, or a file of tokens.
pub fn config(bytes: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(bytes) else { return false };
    let known = KnownCallers::parse(Path::new("fuzz"), text).is_ok();
    Config::parse("fuzz", text).is_ok() || known
}

fn config_seeds() -> Vec<Vec<u8>> {
    let config = "listen = \"127.0.0.1:0\"\nthreads = 2\nlease_s = 1.5\norigins = [\"https://example.org\"]\n\
                  [limits]\npoints = 1000\nlease_s = 60.0\nsession_rate_hz = 2e3\n";
    let token = identity::entry("somebody", &[Role::Touch, Role::Create], "palpate_00").expect("is an entry");
    let certificate = "[[certificate]]\nname = \"bench-3\"\nroles = [\"touch\"]\n";
    vec![config.into(), format!("{token}{certificate}").into()]
}

/// Messages of a journal, in a file with valid checksums, so that the code behind the checksums is tested.
#[derive(Clone, PartialEq, Message)]
struct JournalParts {
    #[prost(bytes = "vec", tag = "1")]
    header: Vec<u8>,
    #[prost(bytes = "vec", repeated, tag = "2")]
    inputs: Vec<Vec<u8>>,
    #[prost(bytes = "vec", tag = "3")]
    hash: Vec<u8>,
    #[prost(bytes = "vec", tag = "4")]
    snapshot: Vec<u8>,
    #[prost(bytes = "vec", tag = "5")]
    end: Vec<u8>,
    /// Bytes appended to the file unchanged.
    #[prost(bytes = "vec", tag = "6")]
    more: Vec<u8>,
    #[prost(bytes = "vec", tag = "7")]
    waiting: Vec<u8>,
}

impl JournalParts {
    fn file(&self) -> Vec<u8> {
        let mut file = records::beginning("fuzz");
        let mut channels = Vec::new();
        for topic in Topic::ALL {
            records::record(&mut channels, records::CHANNEL, |body| {
                body.extend(topic.channel().to_le_bytes());
                body.extend([0; 2]);
                records::string(body, topic.name());
                records::string(body, "protobuf");
                body.extend([0; 4]);
            });
        }
        for (number, inputs) in self.inputs.iter().enumerate() {
            let mut chunk = Chunk::new(7, number as u32, if number == 0 { &channels } else { &[] });
            if number == 0 {
                chunk.add(Topic::Header.channel(), &self.header);
            }
            chunk.add(Topic::Inputs.channel(), inputs);
            for (topic, bytes) in [
                (Topic::Hashes, &self.hash),
                (Topic::Snapshots, &self.snapshot),
                (Topic::Waiting, &self.waiting),
                (Topic::End, &self.end),
            ] {
                if number + 1 == self.inputs.len() && !bytes.is_empty() {
                    chunk.add(topic.channel(), bytes);
                }
            }
            file.extend(chunk.finish());
        }
        file.extend(&self.more);
        file
    }
}

/// Largest number of steps of a journal that is simulated.
const SIMULATED_STEPS: u64 = 50;

/// Reads a file unchanged, or, after a byte of 1, made from parts.
pub fn journal(bytes: &[u8]) -> bool {
    let made;
    let file = match bytes.split_first() {
        Some((1, parts)) => {
            let Ok(parts) = JournalParts::decode(parts) else { return false };
            made = parts.file();
            &made
        }
        _ => bytes,
    };
    let Ok(mut reader) = JournalReader::new("fuzz", std::io::Cursor::new(file)) else { return false };
    let Ok(survey) = reader.survey(&mut |_| {}) else { return false };
    assert!(survey.whole_bytes + survey.torn_bytes <= file.len() as u64);
    let header = reader.header();
    let steps = survey.until_step.saturating_sub(header.begin_step);
    let small = Limits { points: COMPILED_POINTS, substeps: 20, mesh_vertices: COMPILED_POINTS, ..limits() };
    let Ok(model) = of_journal::model(header, &small) else { return true };
    if steps <= SIMULATED_STEPS && model.len() <= COMPILED_POINTS {
        let _ = Replay::new(reader, survey, &small).and_then(|replay| replay.verify(&mut |_, _| {}));
    }
    true
}

fn journal_seeds() -> Vec<Vec<u8>> {
    use journal_pb::input::What;
    let header = |scene: Option<pb::Scene>| journal_pb::Header {
        session_id: "a".to_owned(),
        run: 1,
        replays: palpate_session::journal::REPLAYS,
        rate_hz: 1000.0,
        running: true,
        scene,
        appearance: Some(journal_pb::Appearance { surface: "mucosa".to_owned(), ..Default::default() }),
        tissue: Some(of_journal::tissue(model())),
        ..Default::default()
    };
    let vector = |z: f64| Some(pb::Vector3 { x: 0.02, y: 0.02, z });
    let command = |action: journal_pb::command::Action| {
        What::Command(journal_pb::Command { sequence: Some(3), action: Some(action), ..Default::default() })
    };
    let tip = Some(journal_pb::Tip { radius_m: 0.005, friction: 0.2, ..Default::default() });
    let pose = journal_pb::Pose { place_m: vector(-0.001), velocity_m_per_s: None, tip };
    let push =
        journal_pb::Push { centre_m: vector(0.0), force_n: vector(-0.1), falloff_per_m: 200.0, ..Default::default() };
    let all = [
        command(journal_pb::command::Action::Pose(pose)),
        command(journal_pb::command::Action::Push(push)),
        command(journal_pb::command::Action::Release(journal_pb::Release {})),
        What::Tissue(of_journal::tissue(model())),
        What::Start(journal_pb::Start { until_step: Some(40) }),
        What::Pause(journal_pb::Pause {}),
        What::DroppedSteps(journal_pb::DroppedSteps { steps: 3 }),
        What::Hold(journal_pb::Hold { reason: "a test".to_owned() }),
        What::Revive(journal_pb::Revive {}),
    ];
    let inputs =
        all.into_iter().enumerate().map(|(step, what)| journal_pb::Input { step: step as u64, what: Some(what) });
    let inputs: Vec<_> = inputs.collect();
    let batch = |batch: u64, until_step: u64, inputs: &[journal_pb::Input]| {
        let first_input = if batch == 0 { 0 } else { 5 };
        journal_pb::Inputs { batch, until_step, durable_batches: batch, first_input, inputs: inputs.to_vec() }
            .encode_to_vec()
    };
    let hash = journal_pb::Hash { step: 8, hash: "0".repeat(32), after_inputs: 9 };
    let parts = JournalParts {
        header: header(Some(wire::scene::scene(&model().scene))).encode_to_vec(),
        inputs: vec![batch(0, 5, &inputs[..5]), batch(1, 20, &inputs[5..])],
        hash: hash.encode_to_vec(),
        snapshot: Vec::new(),
        end: journal_pb::End { why: 1, message: "deleted".to_owned() }.encode_to_vec(),
        more: Vec::new(),
        waiting: journal_pb::Waiting { inputs: vec![inputs[3].clone()] }.encode_to_vec(),
    };
    let torn = JournalParts { inputs: vec![batch(0, 3, &inputs[..3])], more: vec![6; 30], ..parts.clone() };
    let bytes = |parts: &JournalParts| [vec![1], parts.encode_to_vec()].concat();
    vec![parts.file(), bytes(&parts), bytes(&torn)]
}

/// Restores a snapshot with a valid checksum, so that the code behind the checksum is tested. The restored session
/// continues, and all values stay finite.
pub fn snapshot(bytes: &[u8]) -> bool {
    let mut bytes = bytes.to_vec();
    snapshot::seal(&mut bytes);
    let Ok(saved) = Saved::from_bytes(&bytes, &limits()) else { return false };
    let _ = Model::resumed(&model().scene, saved.tissue(), &limits());
    let Ok(mut session) = Session::restore(model(), &saved) else { return false };
    let is_finite = |session: &Session| {
        model().points().all(|point| {
            let point = session.tissue().point(point);
            point.displacement_m.is_finite() && point.velocity_m_per_s.is_finite()
        })
    };
    assert!(is_finite(&session));
    // The result is written, and read again as the same.
    let again = session.save().to_bytes();
    let same = Saved::from_bytes(&again, &limits()).and_then(|saved| Session::restore(model(), &saved));
    assert_eq!(same.expect("what was restored can be saved").save().to_bytes(), again);
    for _ in 0..3 {
        session.advance(&mut Vec::new(), |_| {});
        assert!(is_finite(&session));
        let _ = session.sample(None);
    }
    session.let_go();
    session.advance(&mut Vec::new(), |_| {});
    assert!(is_finite(&session));
    true
}

fn snapshot_seeds() -> Vec<Vec<u8>> {
    let at_rest = Session::new(model()).save().to_bytes();
    let mut session = Session::new(model());
    let command = |tool: u32, sequence: u64, action: Action| Command {
        client_time_ns: if tool == 2 { sequence * 1_000_000 } else { 0 },
        time_to_live_s: (tool == 0).then_some(0.5),
        arrival_ns: 5,
        ..Command::new(tool, Some(sequence), action)
    };
    let (shape, tip) = (model().shape(), Tip { radius_m: 0.03, ..Default::default() });
    let middle_m = shape.rest_m(shape.nearest(shape.extent().middle_m()));
    let poke = Poke {
        point: None,
        centre_m: middle_m,
        force_n: DVec3::new(0.1, 0.0, -0.5),
        falloff_per_m: 20.0,
        falloff_offset: 0.1,
    };
    let mut seeds = vec![at_rest];
    for step in 1..80 {
        let place_m = middle_m - 1e-4 * f64::from(step as u32) * DVec3::Z;
        let pose = Action::Pose { place_m, velocity_m_per_s: None, tip };
        let grasp = Action::Grasp { point: shape.nearest(DVec3::ZERO), displacement_m: 1e-3 * DVec3::Z };
        let actions = [(0, Action::Push(poke)), (1, grasp), (2, pose)];
        let due = actions
            .into_iter()
            .filter(|(tool, _)| *tool == 2 || step % 20 == 1)
            .map(|(tool, action)| Due::in_time(command(tool, step, action)));
        session.advance(&mut due.collect(), |_| {});
        if [1, 30, 79].contains(&step) {
            seeds.push(session.save().to_bytes());
        }
    }
    seeds
}
