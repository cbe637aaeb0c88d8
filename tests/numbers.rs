//! Every number that comes in, by the protocol, a journal or TOML: −0, subnormal numbers and extremes are refused
//! with a reason, or they give the same bits whichever way the session then takes: on from where it is, again from
//! its journal, or from its snapshot.
//!
//! The descriptors of the protocol list the numbers, so a new field is tried as soon as it exists.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::collections::BTreeMap;
use std::io::Cursor;
use std::sync::Arc;

use crate::common::journal_opening;
use crate::common::scene_with;
use glam::DVec3;
use palpate_geometry::{Group, TriangleMesh};
use palpate_haptics::Tip;
use palpate_proto::pb;
use palpate_refusal::Refusal;
use palpate_session::Session;
use palpate_session::command::{Command, Due};
use palpate_session::input::Input;
use palpate_session::intake::Intake;
use palpate_session::journal::{self, JournalReader, JournalWriter, Opening};
use palpate_session::snapshot::Saved;
use palpate_session::wire;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::{Action, Script};
use palpate_tissue::scene::{PAPER, Scene};
use prost::Message;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FileDescriptorSet};

/// Difficult values: zeros, subnormal numbers of both formats, numbers beyond f32, and those whose squares overflow
/// or vanish.
const NUMBERS: [f64; 14] = [
    -0.0,
    0.0,
    5e-324,
    -1e-310,
    f64::MIN_POSITIVE,
    -1e-45,
    1e-12,
    1e12,
    3.5e38,
    -1e160,
    f64::MAX,
    f64::MIN,
    f64::INFINITY,
    f64::NAN,
];

const LEASE: u128 = 1;

/// Nothing is rehearsed.
fn limits() -> Limits {
    Limits { rehearsal_work: 1 << 20, ..Limits::default() }
}

/// The messages of some descriptors, by their full names.
fn messages(descriptors: &[u8]) -> BTreeMap<String, DescriptorProto> {
    let mut found = BTreeMap::new();
    for file in FileDescriptorSet::decode(descriptors).unwrap().file {
        for message in file.message_type {
            found.insert(format!(".{}.{}", file.package.clone().unwrap_or_default(), message.name()), message);
        }
    }
    found
}

/// A number in a message: the fields that lead to it, for people and by their tags.
#[derive(Debug, Clone)]
struct Number {
    name: String,
    tags: Vec<u32>,
    is_double: bool,
}

/// All numbers in a message, at any depth.
fn numbers(all: &BTreeMap<String, DescriptorProto>, message: &str) -> Vec<Number> {
    let mut found = Vec::new();
    for field in &all[message].field {
        let (name, tag) = (field.name().to_owned(), field.number() as u32);
        match field.r#type() {
            // A packed list is another matter: all of it is sent, whatever its bits.
            kind @ (Type::Double | Type::Float) if field.label() != Label::Repeated => {
                found.push(Number { name, tags: vec![tag], is_double: kind == Type::Double });
            }
            Type::Message => {
                for Number { name: inner, tags, is_double } in numbers(all, field.type_name()) {
                    let tags = [&[tag][..], &tags].concat();
                    found.push(Number { name: format!("{name}.{inner}"), tags, is_double });
                }
            }
            _ => {}
        }
    }
    found
}

fn varint(mut value: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    while value >= 0x80 {
        bytes.push(value as u8 | 0x80);
        value >>= 7;
    }
    bytes.push(value as u8);
    bytes
}

impl Number {
    /// A message with this number alone. Behind the bytes of another message it takes the place of what that has
    /// there.
    fn set_to(&self, value: f64) -> Vec<u8> {
        let (last, outer) = self.tags.split_last().unwrap();
        let (wire, bytes) =
            if self.is_double { (1, value.to_le_bytes().to_vec()) } else { (5, (value as f32).to_le_bytes().to_vec()) };
        let inner = [varint(u64::from(*last) << 3 | wire), bytes].concat();
        outer
            .iter()
            .rev()
            .fold(inner, |inner, tag| [varint(u64::from(*tag) << 3 | 2), varint(inner.len() as u64), inner].concat())
    }
}

/// Refuses without a word to say nothing.
fn assert_told(refusal: &Refusal, about: &str) {
    assert!(!refusal.message.is_empty(), "{about}: {refusal}");
}

fn is_finite(session: &Session) -> bool {
    session.model().points().all(|point| {
        let point = session.tissue().point(point);
        point.displacement_m.is_finite() && point.velocity_m_per_s.is_finite()
    })
}

/// Returns the state hash and the description of a session, without the server's times of commands.
fn told(session: &Session) -> (u128, String) {
    let tools = session.sample(None).tools;
    let tools: Vec<_> =
        tools.iter().map(|tool| (tool.tool, tool.contact, tool.feel, tool.late, tool.expired)).collect();
    (session.tissue().state_hash(), format!("{tools:?} {:?} {:?}", session.energy(), session.recoveries().list()))
}

fn snapshot(writer: &mut JournalWriter, session: &Session) {
    let (hash, saved) = (session.tissue().state_hash(), session.save().to_bytes());
    writer.snapshot(session.step_count(), hash, session.model(), saved);
}

fn opening(first: &Arc<Model>, begin_step: u64) -> Opening<'_> {
    Opening { owner: "", begin_step, ..journal_opening::opening(first) }
}

/// Steps with what a test has them do.
const STEPS: u64 = 24;

/// Lets a session of a scene go every way, if it is not held at once. Returns whether there is one: else it was
/// refused, with a reason.
fn is_taken_on_every_way(scene: palpate_refusal::Result<Scene>, about: &str) -> bool {
    match scene.and_then(|scene| Model::compile(&scene, &limits())) {
        Err(refusal) => {
            assert_told(&refusal, about);
            false
        }
        Ok(model) => {
            let session = begun(&model);
            if session.hold_reason().is_none() {
                goes_every_way(session, &model, BTreeMap::new(), about);
            }
            true
        }
    }
}

/// Goes on with a session under commands, and compares the ways: it is verified from its journal, resumed from that
/// as after a kill, and restored from its own snapshot in the middle.
fn goes_every_way(mut session: Session, first: &Arc<Model>, mut acting: BTreeMap<u64, Vec<Due>>, about: &str) {
    let begin = session.step_count();
    let mut writer = JournalWriter::new(&opening(first, begin), 1);
    snapshot(&mut writer, &session);
    let (middle, mut restored) = (begin + STEPS / 2, None);
    for step in begin..begin + STEPS {
        if step == middle {
            let bytes = session.save().to_bytes();
            let saved = Saved::from_bytes(&bytes, &limits()).unwrap_or_else(|refusal| panic!("{about}: {refusal}"));
            let again = Session::restore(session.model(), &saved);
            let again = again.unwrap_or_else(|refusal| panic!("{about}: {refusal}"));
            assert!(again.save().to_bytes() == bytes, "{about}: other bytes");
            restored = Some(again);
            // A journal's snapshot is restored as well, when it is verified.
            snapshot(&mut writer, &session);
        }
        let mut due = acting.remove(&step).unwrap_or_default();
        due.iter().for_each(|due| writer.input(step, &Input::Command(due.clone())));
        if let Some(again) = &mut restored {
            again.advance(&mut due.clone(), |_| {});
        }
        session.advance(&mut due, |_| {});
        assert!(is_finite(&session), "{about}");
        writer.hash(session.step_count(), session.tissue().state_hash());
    }
    assert_eq!(told(&restored.unwrap()), told(&session), "{about}: from its snapshot");
    let until = session.step_count();
    let file = writer.finish(journal::pb::Why::Drained, "", until, 2);
    let reader = || JournalReader::new("journal", Cursor::new(file.clone())).unwrap();
    let verdict = journal::verify(reader(), &Limits::default(), &mut |_, _| {});
    let verdict = verdict.unwrap_or_else(|refusal| panic!("{about}: {refusal}"));
    assert_eq!(verdict.difference, None, "{about}");
    let resumed = journal::resume(reader(), &Limits::default()).unwrap_or_else(|refusal| panic!("{about}: {refusal}"));
    assert_eq!(told(&resumed.session), told(&session), "{about}: after a kill");
}

/// A session of which the tools 0, 1 and 2 press, hold and touch.
fn begun(model: &Arc<Model>) -> Session {
    let mut session = Session::new(model);
    let (shape, edge_m) = (model.shape(), model.shape().edge_m());
    let rest_m = shape.rest_m(shape.nearest(shape.extent().middle_m()));
    let poke = Poke {
        point: None,
        centre_m: rest_m,
        force_n: DVec3::new(0.02, 0.0, -0.1),
        falloff_per_m: 0.5 / edge_m,
        falloff_offset: 0.0,
    };
    let free = model.points().find(|point| !shape.is_fixed(*point));
    let displacement_m = DVec3::new(-0.0, 0.01 * edge_m, -0.0);
    let grasp = free.map_or(Action::Release, |point| Action::Grasp { point, displacement_m });
    let tip = Tip { radius_m: edge_m, ..Tip::default() };
    let place_m = rest_m - 0.1 * edge_m * shape.normal(shape.nearest(rest_m));
    let pose = Action::Pose { place_m, velocity_m_per_s: None, tip };
    let commands = [Action::Push(poke), grasp, pose].into_iter().zip(0..);
    let mut due = commands.map(|(action, tool)| Due::in_time(Command::new(tool, Some(1), action))).collect();
    (0..20).for_each(|_| session.advance(&mut due, |_| {}));
    session
}

fn sheet(precision: &str, more: &[&str]) -> Scene {
    let precision = format!("stepping.precision={precision}");
    let sets = ["sheet.points=[9, 7]", "stepping.integrator=exponential3", "stepping.substeps=2", &precision];
    scene_with(PAPER, &[&sets[..], more].concat())
}

/// Messages of every kind of command, with all numbers that they may have.
fn commands() -> Vec<pb::Command> {
    use pb::command::Action as Message;
    let vector = |x, y, z| Some(pb::Vector3 { x, y, z });
    let grid = || Some(pb::GridPoint { x: 4, y: 3 });
    let bite = |x| pb::Bite { place_m: vector(x, 0.15, 0.0), radius_m: 0.05 };
    let force = |centre| {
        let (falloff_per_m, falloff_offset) = (Some(20.0), Some(0.1));
        Message::Force(pb::Force {
            centre: Some(centre),
            force_n: vector(0.0, 0.1, -0.3),
            falloff_per_m,
            falloff_offset,
        })
    };
    let position = |target| Message::Position(pb::Position { point: grid(), vertex: None, target: Some(target) });
    let pose = pb::Pose {
        position_m: vector(0.2, 0.15, -0.002),
        orientation: Some(pb::Quaternion { w: 1.0, x: 0.0, y: 0.0, z: 0.0 }),
        tip_offset_m: vector(0.0, 0.0, 0.001),
        tip: Some(pb::Tip {
            radius_m: 0.05,
            friction: Some(0.3),
            grasps: false,
            spring: Some(pb::Spring { stiffness_n_per_m: 200.0, damping_n_s_per_m: 0.5 }),
            ..Default::default()
        }),
        velocity_m_per_s: vector(0.01, 0.0, -0.1),
    };
    let grasping = pb::Pose {
        tip: Some(pb::Tip { grasps: true, spring: None, ..pose.tip.unwrap() }),
        velocity_m_per_s: None,
        ..pose
    };
    let actions = [
        force(pb::force::Centre::Point(grid().unwrap())),
        force(pb::force::Centre::CentreM(pb::Vector2 { x: 0.2, y: 0.1 })),
        force(pb::force::Centre::AtM(pb::Vector3 { x: 0.2, y: 0.1, z: 0.0 })),
        position(pb::position::Target::DisplacementM(pb::Vector3 { x: 1e-3, y: 0.0, z: 2e-3 })),
        position(pb::position::Target::PositionM(pb::Vector3 { x: 0.2, y: 0.15, z: 1e-3 })),
        Message::Pose(pose),
        Message::Pose(grasping),
        Message::Tie(pb::Tie {
            number: 1,
            kind: Some(pb::tie::Kind::Thread(pb::Thread {
                bites: vec![bite(0.15), bite(0.25)],
                length_m: 0.09,
                friction: 0.1,
                strength_n: Some(50.0),
            })),
        }),
        Message::Tie(pb::Tie {
            number: 0,
            kind: Some(pb::tie::Kind::Clip(pb::Clip { bites: vec![bite(0.2), bite(0.22)], strength_n: None })),
        }),
    ];
    actions
        .into_iter()
        .map(|action| pb::Command { tool: 3, time_to_live_s: Some(0.5), action: Some(action), ..Default::default() })
        .collect()
}

#[test]
fn every_number_of_a_command_gives_the_same_bits_on_every_way_or_is_refused() {
    let descriptors = messages(pb::DESCRIPTORS);
    let numbers = numbers(&descriptors, ".palpate.v1.Command");
    assert!(numbers.len() > 25, "{numbers:?}");
    let models = ["f32", "f64"].map(|precision| Model::compile(&sheet(precision, &[]), &limits()).unwrap());
    let saved = models.each_ref().map(|model| Saved::from_bytes(&begun(model).save().to_bytes(), &limits()).unwrap());
    let (mut taken, mut refused) = (0, 0);
    for (message, number) in
        commands().into_iter().flat_map(|message| numbers.iter().map(move |n| (message.clone(), n)))
    {
        for (value, which) in NUMBERS.into_iter().zip([0, 1].into_iter().cycle()) {
            let about = format!("{} = {value:e} in {message:?}", number.name);
            let bytes = [message.encode_to_vec(), number.set_to(value)].concat();
            let mut sent = pb::Command::decode(&bytes[..]).unwrap();
            let by_time =
                matches!(&sent.action, Some(pb::command::Action::Pose(pose)) if pose.velocity_m_per_s.is_some());
            sent.client_time_ns = if by_time { 5_000_000 } else { 0 };
            let model = &models[which];
            let session = Session::restore(model, &saved[which]).unwrap();
            let mut intake = Intake::new(&model.scene, &limits()).continued(&session, None);
            intake.acquire(&[3], "test", 1.0, LEASE, 0).unwrap();
            let command = wire::command::from_command(&sent, model.shape(), 7);
            match command.and_then(|command| intake.submit(LEASE, vec![command], 0)) {
                Err(refusal) => {
                    assert_told(&refusal, &about);
                    refused += 1;
                }
                Ok(()) => {
                    let mut due = Vec::new();
                    let step = session.step_count();
                    intake.take_due(step, 0, &mut due);
                    goes_every_way(session, model, [(step, due)].into(), &about);
                    taken += 1;
                }
            }
        }
    }
    println!("{taken} commands taken, {refused} refused");
    assert!(taken > 500 && refused > 500, "{taken} {refused}");
}

/// A closed mesh, one of whose corners is at −0.
fn octahedron() -> TriangleMesh {
    let at = |x, y, z| DVec3::new(x, y, z) * 0.03;
    TriangleMesh {
        vertices_m: vec![
            at(1.0, -0.0, 0.0),
            at(-1.0, 0.0, -0.0),
            at(-0.0, 1.0, -0.0),
            at(0.0, -1.0, 0.0),
            at(-0.0, -0.0, 1.0),
            at(0.0, 0.0, -1.0),
        ],
        triangles: vec![[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]],
        uv: None,
        groups: vec![Group { name: "held".to_owned(), vertices: vec![5] }],
        regions: Vec::new(),
    }
}

/// Scenes as messages, with all numbers that they may have.
fn scenes() -> Vec<pb::Scene> {
    let stepping = Some(pb::Stepping {
        rate_hz: Some(1000.0),
        tolerance: Some(1e-3),
        integrator: "exponential3".to_owned(),
        substeps: Some(4),
        ..Default::default()
    });
    let sleep = Some(pb::Sleep { tolerance: Some(1e-3) });
    let plain = wire::scene::scene(&sheet("f32", &["stepping.substeps=4"]));
    let of_sheet = pb::Scene { stepping: stepping.clone(), sleep, ..plain };
    let ball = |z| pb::Ball { centre_m: Some(pb::Vector3 { x: 0.0, y: 0.0, z }), radius_m: 0.005 };
    let of_mesh = pb::Scene {
        name: "mesh".to_owned(),
        mesh: Some(pb::Mesh {
            mesh_id: "any".to_owned(),
            fixed: Some(pb::mesh::Fixed::FixedBalls(pb::Balls { balls: vec![ball(-0.03)] })),
            ..Default::default()
        }),
        material: Some(pb::Material {
            youngs_modulus_pa: Some(5000.0),
            thickness_m: Some(0.002),
            density_kg_per_m3: Some(1000.0),
            depth_m: Some(0.02),
            foundation_n_per_m3: Some(4e5),
            damping_ratio: Some(0.5),
            foundation_group: None,
        }),
        inclusions: vec![pb::Inclusion {
            centre_m: Some(pb::Vector3 { x: 0.0, y: 0.0, z: 0.03 }),
            radius_m: Some(0.01),
            stiffness_factor: Some(2.0),
            anchor_stiffness_factor: Some(2.0),
            edge_m: Some(0.002),
            ..Default::default()
        }],
        springs: Some(pb::Springs { bending_factor: Some(0.2), ..Default::default() }),
        volume: Some(pb::Volume { stiffness_pa: Some(300.0) }),
        stepping,
        sleep,
        ..Default::default()
    };
    let of_coefficients = pb::Scene {
        mesh: Some(pb::Mesh { point_mass_kg: Some(1e-3), ..of_mesh.mesh.clone().unwrap() }),
        material: None,
        springs: Some(pb::Springs { stiffness_n_per_m: Some(20.0), bending_factor: Some(0.2), ..Default::default() }),
        anchor_springs: Some(pb::AnchorSprings { stiffness_n_per_m: Some(5.0) }),
        damping: Some(pb::Damping { coefficient_n_s_per_m: Some(0.1) }),
        ..of_mesh.clone()
    };
    vec![of_sheet, of_mesh, of_coefficients]
}

#[test]
fn every_number_of_a_scene_gives_the_same_bits_on_every_way_or_is_refused() {
    let descriptors = messages(pb::DESCRIPTORS);
    let numbers = numbers(&descriptors, ".palpate.v1.Scene");
    assert!(numbers.len() > 25, "{numbers:?}");
    let mesh = octahedron();
    let (mut taken, mut refused) = (0, 0);
    for (message, number) in scenes().into_iter().flat_map(|message| numbers.iter().map(move |n| (message.clone(), n)))
    {
        for value in NUMBERS {
            let about = format!("{} = {value:e} in {}", number.name, message.name);
            let mut sent = pb::Scene::decode(&[message.encode_to_vec(), number.set_to(value)].concat()[..]).unwrap();
            // A list has become longer by a message: that takes the place of what was there.
            if let [first, second] = &mut sent.inclusions[..] {
                let merged = [first.encode_to_vec(), second.encode_to_vec()].concat();
                sent.inclusions = vec![pb::Inclusion::decode(&merged[..]).unwrap()];
            }
            if let Some(pb::mesh::Fixed::FixedBalls(balls)) = sent.mesh.as_mut().and_then(|mesh| mesh.fixed.as_mut())
                && let [first, second] = &mut balls.balls[..]
            {
                let merged = [first.encode_to_vec(), second.encode_to_vec()].concat();
                balls.balls = vec![pb::Ball::decode(&merged[..]).unwrap()];
            }
            let is_taken = is_taken_on_every_way(wire::scene::from_scene(&sent, Some(&mesh)), &about);
            *(if is_taken { &mut taken } else { &mut refused }) += 1;
        }
    }
    println!("{taken} scenes taken, {refused} refused");
    assert!(taken > 200 && refused > 200, "{taken} {refused}");
}

/// An input as a journal gives it back, with more bytes behind those of its command or tissue.
fn with_more(
    descriptors: &BTreeMap<String, DescriptorProto>,
    input: &Input,
    more: &[u8],
    first: &Arc<Model>,
) -> Result<Input, Refusal> {
    use journal::pb::input::What;
    let within = |message: &str, field: &str, inner: &[u8]| {
        let fields = &descriptors[&format!(".palpate.journal.v1.{message}")].field;
        let tag = fields.iter().find(|other| other.name() == field).unwrap().number() as u64;
        [varint(tag << 3 | 2), varint(inner.len() as u64), inner.to_vec()].concat()
    };
    let bytes = journal::inputs::encoded(&[(0, input.clone())]).remove(0);
    let inputs = journal::pb::Inputs::decode(&bytes[..]).unwrap();
    let (field, own) = match inputs.inputs[0].what.as_ref().unwrap() {
        What::Command(command) => ("command", command.encode_to_vec()),
        What::Tissue(tissue) => ("tissue", tissue.encode_to_vec()),
        other => panic!("{other:?}"),
    };
    // Not by way of the types: to encode a zero leaves it out.
    let bytes = within("Inputs", "inputs", &within("Input", field, &[&own[..], more].concat()));
    Ok(journal::inputs::decoded(&bytes, first, &limits())?.remove(0).1)
}

#[test]
fn a_zero_has_no_sign_in_any_number_of_a_journal() {
    let descriptors = messages(journal::pb::DESCRIPTORS);
    let first = Model::compile(&sheet("f64", &["damping.coefficient_n_s_per_m=0.0"]), &limits()).unwrap();
    // Of the tissue: the same model, or none.
    let change = palpate_tissue::scene::Change { anchor_stiffness_n_per_m: Some(0.0), ..Default::default() };
    let changed = first.changed(&change, &first.scene, &limits()).unwrap();
    let tissue = |more: &[u8]| -> Result<Arc<Model>, Refusal> {
        match with_more(&descriptors, &Input::Tissue(changed.clone()), more, &first)? {
            Input::Tissue(model) => Ok(model),
            _ => panic!("no tissue"),
        }
    };
    let mut tried = 0;
    for number in numbers(&descriptors, ".palpate.journal.v1.Tissue") {
        let [negative, positive] = [-0.0, 0.0].map(|zero| tissue(&number.set_to(zero)));
        match (negative, positive) {
            (Ok(negative), Ok(positive)) => {
                assert_eq!(negative.fingerprint(), positive.fingerprint(), "{}", number.name);
                let state = |model: &Model| format!("{:?}", model.saved_plan());
                assert_eq!(state(&negative), state(&positive), "{}", number.name);
                tried += 1;
            }
            (negative, positive) => assert!(negative.is_err() && positive.is_err(), "{}", number.name),
        }
    }
    assert!(tried > 4, "{tried}");
    // Of a command: the same bits.
    let rest_m = first.shape().rest_m(first.scene.sheet().unwrap().point([4, 3]));
    let tip = Tip {
        radius_m: 0.05,
        coupling: palpate_haptics::Coupling::Spring { stiffness_n_per_m: 50.0, damping_n_s_per_m: 0.1 },
        ..Tip::default()
    };
    let point = first.scene.sheet().unwrap().point([4, 3]);
    let actions = [
        Action::Push(Poke {
            point: None,
            centre_m: rest_m,
            force_n: -DVec3::Z,
            falloff_per_m: 9.0,
            falloff_offset: 0.1,
        }),
        Action::Grasp { point, displacement_m: 1e-3 * DVec3::ONE },
        Action::Pose { place_m: rest_m - 1e-3 * DVec3::Z, velocity_m_per_s: Some(DVec3::X), tip },
    ];
    for action in actions {
        for number in numbers(&descriptors, ".palpate.journal.v1.Command") {
            let course = |zero: f64| -> Result<(u128, String), String> {
                let command = Command { client_time_ns: 1, ..Command::new(0, Some(1), action.clone()) };
                let input = Input::Command(Due::in_time(command));
                let input = with_more(&descriptors, &input, &number.set_to(zero), &first);
                let Input::Command(due) = input.map_err(|refusal| refusal.to_string())? else { panic!("no command") };
                let mut session = Session::new(&first);
                let mut due = vec![due];
                (0..30).for_each(|_| session.advance(&mut due, |_| {}));
                let bytes = session.save().to_bytes();
                Ok((xxhash_rust::xxh3::xxh3_128(&bytes), told(&session).1))
            };
            let [negative, positive] = [course(-0.0), course(0.0)];
            let same = match (&negative, &positive) {
                (Err(_), Err(_)) => true,
                (negative, positive) => negative == positive,
            };
            assert!(same, "{} of {action:?}: {negative:?} {positive:?}", number.name);
        }
    }
}

/// All numbers of a text, each in turn in place of what stands there.
fn with_each_number(text: &str, value: &str) -> Vec<(String, String)> {
    let mut found = Vec::new();
    let marks: Vec<usize> = text.match_indices('@').map(|mark| mark.0).collect();
    for pair in marks.chunks_exact(2) {
        let [at, end] = [pair[0], pair[1]];
        let replaced = format!("{}{value}{}", &text[..at], &text[end + 1..]);
        let line = text[..at].rsplit('\n').next().unwrap_or_default().to_owned();
        found.push((line, replaced.replace('@', "")));
    }
    found
}

const SHEET: &str = "name = \"zeros\"\n[sheet]\npoints = [9, 7]\nspacing_m = @0.05@\npoint_mass_kg = @0.02@\n[springs]\n\
    stiffness_n_per_m = @30.0@\nshear_stiffness_n_per_m = @15.0@\n[anchor_springs]\nstiffness_n_per_m = @5.0@\n[damping]\n\
    coefficient_n_s_per_m = @0.2@\n[stepping]\nrate_hz = @1000.0@\ntolerance = @1e-3@\nintegrator = \"exponential3\"\n\
    substeps = 4\n[sleep]\ntolerance = @1e-3@\n";

const MESH: &str = "name = \"zeros\"\n[mesh]\norgan = { name = \"gallbladder\", edge_m = 0.007 }\n[material]\n\
    youngs_modulus_pa = @2e4@\nthickness_m = @0.003@\ndensity_kg_per_m3 = @1000.0@\ndepth_m = @0.02@\nfoundation_n_per_m3 = @5e6@\n\
    damping_ratio = @0.5@\n[springs]\nbending = @0.1@\n[[inclusion]]\ncentre_m = [@0.0@, @0.0@, @-0.05@]\nradius_m = @0.03@\n\
    stiffness_factor = @2.0@\nanchor_stiffness_factor = @2.0@\nedge_m = @0.004@\n[stepping]\nintegrator = \"exponential3\"\n\
    substeps = 12\n[sleep]\ntolerance = @1e-3@\n";

#[test]
fn every_number_of_a_scene_file_gives_the_same_bits_on_every_way_or_is_refused() {
    let (mut taken, mut refused) = (0, 0);
    for text in [SHEET, MESH] {
        for value in NUMBERS {
            for (line, text) in with_each_number(text, &format!("{value:?}").replace("NaN", "nan")) {
                let about = format!("{value:e} in {line}");
                let is_taken = is_taken_on_every_way(Scene::parse("text", &text, &[], &limits()), &about);
                *(if is_taken { &mut taken } else { &mut refused }) += 1;
            }
        }
    }
    println!("{taken} scenes taken, {refused} refused");
    assert!(taken > 20 && refused > 50, "{taken} {refused}");
}

const SCRIPT: &str = "name = \"zeros\"\nduration_s = 0.03\nsample_every_s = 0.01\n[[force]]\nat_m = [@0.2@, @0.1@]\n\
    force_n = [@0.1@, @0.0@, @-0.3@]\nfalloff_per_m = @20.0@\nfalloff_offset = @0.1@\n\
    profile = { type = \"ramp\", from_s = @0.0@, to_s = @0.02@ }\n[[tool]]\npoint = [4, 3]\n\
    moves = [{ from_s = @0.0@, to_s = @0.01@, by_m = [@0.0@, @1e-3@, @2e-3@] }]\n[[tool]]\n\
    tip = { radius_m = @0.05@, friction = @0.2@, spring = { stiffness_n_per_m = @100.0@, damping_n_s_per_m = @0.1@ } }\n\
    poses = [{ at_s = @0.0@, place_m = [@0.15@, @0.15@, @0.001@] }, { at_s = 0.01, place_m = [0.15, 0.15, -0.002] }]\n";

#[test]
fn every_number_of_a_script_gives_the_same_bits_on_every_way_or_is_refused() {
    let scene = sheet("f64", &[]);
    let model = Model::compile(&scene, &limits()).unwrap();
    let bits = |text: &str| -> Result<BTreeMap<u64, Vec<Due>>, Refusal> {
        let script = Script::parse("text", text, std::path::Path::new("."), &scene, &limits())?;
        let mut acting = BTreeMap::new();
        for step in 0..STEPS {
            let commands = script
                .actions_at(step)
                .map(|(tool, action)| Due::in_time(Command::new(tool as u32, Some(step + 1), action)));
            acting.insert(step, commands.collect());
        }
        // And as functions of time.
        let mut session = Session::new(&model);
        session.play_script(&script);
        for _ in 0..STEPS {
            session.advance(&mut Vec::new(), |_| {});
            assert!(is_finite(&session), "{text}");
        }
        let saved = Saved::from_bytes(&session.save().to_bytes(), &limits()).unwrap();
        let mut again = Session::restore(&model, &saved).unwrap_or_else(|refusal| panic!("{text}: {refusal}"));
        for _ in 0..5 {
            [&mut session, &mut again].into_iter().for_each(|session| session.advance(&mut Vec::new(), |_| {}));
        }
        assert_eq!(told(&session), told(&again), "{text}");
        Ok(acting)
    };
    let mut taken = 0;
    for value in NUMBERS {
        for (line, text) in with_each_number(SCRIPT, &format!("{value:?}").replace("NaN", "nan")) {
            match bits(&text) {
                Err(refusal) => assert_told(&refusal, &line),
                Ok(acting) => {
                    goes_every_way(Session::new(&model), &model, acting, &format!("{value:e} in {line}"));
                    taken += 1;
                }
            }
        }
    }
    assert!(taken > 100, "{taken}");
}
