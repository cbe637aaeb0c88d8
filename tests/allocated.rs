//! What decoders take in memory is measured before, and paid for: every message of the protocol, of journals and of
//! etcd, with entries that say nothing, many of them; journals and snapshots that say much in few bytes. And every
//! session that may be goes to another server.
//!
//! Ten thousand messages in every run of the tests; `PALPATE_FUZZ_INPUTS` says how many instead.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]
#![allow(
    clippy::cast_possible_truncation,
    clippy::cast_possible_wrap,
    clippy::cast_precision_loss,
    clippy::cast_sign_loss
)]

#[path = "common/cases.rs"]
mod cases;
#[path = "common/counting.rs"]
mod counting;
#[path = "common/journal_opening.rs"]
mod journal_opening;
#[path = "common/moved.rs"]
mod moved;

use std::io::Cursor;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use counting::counted;
use fastrand::Rng;
use palpate_geometry::TriangleMesh;
use palpate_proto::measure::{MULTIPLE, ROOM, Shape};
use palpate_proto::pb;
use palpate_refusal::{Reason, Result};
use palpate_session::Session;
use palpate_session::budget::{Account, Budget, Purpose, Resource};
use palpate_session::journal::records::{self, Chunk};
use palpate_session::journal::{JournalReader, REPLAYS, Topic, message, pb as kept};
use palpate_session::snapshot::{self, Saved};
use palpate_session::wire;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::{BUILT_IN, PAPER, Scene};
use prost::Message;

/// Bytes that are not counted: short texts of refusals, and the smallest allocation.
const SLACK: usize = 64 << 10;

fn account(memory_bytes: u64) -> Account {
    Budget::new(&Limits { memory_bytes, ..Limits::default() }, 1, 1).account("test")
}

fn varint(mut value: u64, out: &mut Vec<u8>) {
    while value >= 0x80 {
        out.push(value as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

/// Fields of any numbers and types, within each other, and some of them many times.
fn random_message(random: &mut Rng, levels: u32) -> Vec<u8> {
    let mut bytes = Vec::new();
    for _ in 0..random.u8(0..6) {
        let mut field = Vec::new();
        // Those of nearly all messages are below 16.
        let number = if random.u8(0..8) == 0 { random.u64(1..40) } else { random.u64(1..9) };
        match random.u8(0..8) {
            0 => {
                varint(number << 3, &mut field);
                varint(random.u64(..) >> random.u8(0..64), &mut field);
            }
            1 => {
                varint(number << 3 | 1, &mut field);
                field.extend([0; 8]);
            }
            2 => {
                varint(number << 3 | 5, &mut field);
                field.extend([0; 4]);
            }
            3 => {
                // Packed numbers, or a text.
                let length = random.usize(0..2000);
                varint(number << 3 | 2, &mut field);
                varint(length as u64, &mut field);
                field.extend(vec![random.u8(0..128); length]);
            }
            _ => {
                let own = if levels > 0 { random_message(random, levels - 1) } else { Vec::new() };
                varint(number << 3 | 2, &mut field);
                varint(own.len() as u64, &mut field);
                field.extend(own);
            }
        }
        let times = if random.u8(0..4) == 0 { random.usize(1..300) } else { 1 };
        bytes.extend(field.repeat(times.min(1 + (1 << 16) / field.len())));
        bytes.truncate(1 << 17);
    }
    bytes
}

#[test]
fn a_message_takes_no_more_than_was_measured() {
    let inputs: u64 = cases::count("PALPATE_FUZZ_INPUTS", 3000, 100_000);
    let mut random = Rng::with_seed(0x3e_a5);
    let (decoded, refused) = (AtomicU64::new(0), AtomicU64::new(0));
    // Returns how many times its bytes a message took.
    let try_one = |shape: &'static Shape, bytes: &[u8]| {
        let most_memory = MULTIPLE * bytes.len() + ROOM;
        let memory = shape.measure(bytes, usize::MAX, most_memory).memory;
        if memory > most_memory {
            refused.fetch_add(1, Ordering::Relaxed);
            return 0.0;
        }
        let (was_decoded, took) = counted(|| shape.decodes(bytes));
        decoded.fetch_add(u64::from(was_decoded), Ordering::Relaxed);
        // A field of bytes is copied twice where it is decoded from a slice.
        assert!(
            took <= memory + bytes.len() + 1024,
            "{}: {} bytes took {took}, but were measured as {memory}: {:?}",
            shape.name(),
            bytes.len(),
            &bytes[..bytes.len().min(200)]
        );
        took.saturating_sub(ROOM) as f64 / bytes.len().max(1) as f64
    };
    let shapes: Vec<&'static Shape> = Shape::all().iter().collect();
    let mut most: Vec<(f64, &str)> = cases::on_every_core(&shapes, |shape| {
        let mut most = 0.0_f64;
        // Each field, empty, a hundred thousand times: alone, and within each other.
        for number in 1..16_u8 {
            most = most.max(try_one(shape, &[number << 3 | 2, 0].repeat(100_000)));
            for inner in 1..8_u8 {
                most = most.max(try_one(shape, &[number << 3 | 2, 2, inner << 3 | 2, 0].repeat(50_000)));
                let many = [inner << 3 | 2, 0].repeat(60);
                most = most.max(try_one(shape, &[&[number << 3 | 2, 120][..], &many].concat().repeat(500)));
            }
        }
        (most, shape.name())
    });
    for _ in 0..inputs {
        let shape = shapes[random.usize(0..shapes.len())];
        let bytes = random_message(&mut random, 4);
        most.push((try_one(shape, &bytes), shape.name()));
    }
    let (decoded, refused) = (decoded.into_inner(), refused.into_inner());
    let (multiple, name) = most.iter().max_by(|a, b| a.0.total_cmp(&b.0)).unwrap();
    println!("{decoded} messages decoded, {refused} refused; {name} takes {multiple:.1} times its bytes");
    assert!(decoded > inputs / 10 && refused > 100);
}

/// A small tissue.
fn model() -> Arc<Model> {
    let scene = Scene::parse("test", &PAPER.replace("[31, 31]", "[5, 5]"), &[], &Limits::default()).unwrap();
    Model::compile(&scene, &Limits::default()).unwrap()
}

/// A journal with one batch, which has these messages beside its header.
fn journal(header: &kept::Header, messages: &[(Topic, Vec<u8>)]) -> Vec<u8> {
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
    let mut chunk = Chunk::new(7, 0, &channels);
    chunk.add(Topic::Header.channel(), &header.encode_to_vec());
    for (topic, bytes) in messages {
        chunk.add(topic.channel(), bytes);
    }
    [records::beginning("test"), chunk.finish()].concat()
}

fn header() -> kept::Header {
    let model = model();
    kept::Header {
        session_id: "a".to_owned(),
        replays: REPLAYS,
        rate_hz: 1000.0,
        scene: Some(wire::scene::scene(&model.scene)),
        tissue: Some(message::tissue(&model)),
        ..Default::default()
    }
}

/// Reads all of a journal.
fn read_all(file: &[u8], account: &Account) -> Result<()> {
    let paid = account.take(Resource::Memory(Purpose::Journals), 0, "")?;
    let mut reader = JournalReader::paid("test", Cursor::new(file), Some(paid))?;
    let _survey = reader.survey(&mut |_| {})?;
    while let Some(batch) = reader.next_batch()? {
        let _items = palpate_session::journal::replay::items(&batch)?;
        let (_felt, _waiting, _end) = (batch.felt()?, batch.waiting()?, batch.end()?);
    }
    Ok(())
}

#[test]
fn a_journal_of_empty_entries_takes_no_more_than_its_reader_pays_for() {
    let empty = |number: u8, count: usize| [number << 3 | 2, 0].repeat(count);
    let inputs = || (Topic::Inputs, empty(5, 0));
    let groups = vec![kept::Group::default(); 300_000];
    let mesh = kept::Header { mesh: Some(kept::TriangleMesh { groups, ..Default::default() }), ..header() };
    let files = [
        ("inputs", journal(&header(), &[(Topic::Inputs, empty(5, 1 << 16))])),
        ("too many inputs", journal(&header(), &[(Topic::Inputs, empty(5, 1_000_000))])),
        ("waiting", journal(&header(), &[inputs(), (Topic::Waiting, empty(1, 1_000_000))])),
        ("moments", journal(&header(), &[inputs(), (Topic::Felt, empty(1, 1_000_000))])),
        ("tools", journal(&header(), &[inputs(), (Topic::Felt, [0x0a, 2, 0x12, 0].repeat(500_000))])),
        ("hashes", journal(&header(), &[vec![inputs()], vec![(Topic::Hashes, Vec::new()); 60_000]].concat())),
        ("groups", journal(&mesh, &[inputs()])),
    ];
    for (what, file) in &files {
        let rich = account(4 << 30);
        let mut paid = 0;
        let (read, took) = counted(|| read_all(file, &rich));
        assert_eq!(rich.has(Resource::Memory(Purpose::Journals)), 0, "{what}: what was paid is given back");
        // The smallest account that suffices has to have as much as was taken.
        if read.is_ok() {
            let suffices = |bytes: u64| read_all(file, &account(bytes * 4 / 3 + 4)).is_ok();
            paid = (0..34).map(|bit| 1_u64 << bit).find(|bytes| suffices(*bytes)).unwrap();
            assert!(took as u64 <= paid + SLACK as u64, "{what}: {} bytes took {took}, paid {paid}", file.len());
        }
        println!("{what}: {} bytes took {took}, paid at most {paid}: {:?}", file.len(), read.err().map(|r| r.message));
        // A batch has room for 65,536 inputs, however short they are.
        assert!(took <= 2 * (MULTIPLE * file.len() + ROOM) + (32 << 20), "{what}: {} bytes took {took}", file.len());
    }
    // With little memory the request ends, before anything is decoded.
    let (read, took) = counted(|| read_all(&files[0].1, &account(4 << 20)));
    assert_eq!(read.unwrap_err().reason, Reason::TooLarge);
    assert!(took < 4 << 20, "{took}");
}

/// A snapshot with other parts.
fn snapshot(parts: &[u8]) -> Vec<u8> {
    let mut bytes = snapshot::MAGIC.to_vec();
    bytes.extend(snapshot::VERSION.to_le_bytes());
    bytes.extend((parts.len() as u64).to_le_bytes());
    bytes.extend([0; 16]);
    bytes.extend(parts);
    snapshot::seal(&mut bytes);
    bytes
}

#[test]
fn a_snapshot_takes_no_more_than_its_header_says() {
    let whole = Session::new(&model()).save().to_bytes();
    let length = u64::from_le_bytes(whole[12..20].try_into().unwrap()) as usize;
    let parts = &whole[36..36 + length];
    let mut random = Rng::with_seed(0x5a_7e);
    let mut most: f64 = 0.0;
    let inputs: u64 = cases::count("PALPATE_FUZZ_INPUTS", 1000, 20_000);
    let mut try_one = |parts: &[u8]| {
        let bytes = snapshot(parts);
        let (_, took) = counted(|| Saved::from_bytes(&bytes, &Limits::default()).map(drop));
        assert!(took as u64 <= snapshot::memory_of(&bytes) + SLACK as u64, "{} bytes took {took}", bytes.len());
        most = most.max(took.saturating_sub(4 << 20) as f64 / bytes.len() as f64);
    };
    // A list in the place of each byte, as long as there are bytes; a million tools are the first.
    for at in 0..parts.len() {
        let count = if at == 0 { 1_000_000 } else { 20_000 };
        let mut bent = parts[..at].to_vec();
        varint(count, &mut bent);
        bent.extend(vec![0; 10 * count as usize]);
        bent.extend(&parts[at..]);
        try_one(&bent);
        if at == 0 {
            let refusal = Saved::from_bytes(&snapshot(&bent), &Limits::default()).unwrap_err();
            assert_eq!(refusal.reason, Reason::OutOfRange, "{refusal}");
        }
    }
    for _ in 0..inputs {
        let mut bent = parts.to_vec();
        let at = random.usize(0..bent.len());
        let piece = vec![random.u8(0..3); random.usize(0..5000)];
        bent.splice(at..at, piece);
        let at = random.usize(0..bent.len());
        bent[at] = random.u8(..);
        try_one(&bent);
    }
    println!("a snapshot takes {most:.1} times its bytes");
}

/// A mesh of a sheet's shape whose texture coordinates are all 0: each of its corners is bytes that look like
/// messages.
fn flat(side: u32) -> TriangleMesh {
    let at = |x: u32, y: u32| glam::DVec3::new(f64::from(x), f64::from(y), 0.0) * 1e-3;
    let number = |x: u32, y: u32| y * side + x;
    let cells = (0..side - 1).flat_map(|y| (0..side - 1).map(move |x| (x, y)));
    let triangles: Vec<[u32; 3]> = cells
        .flat_map(|(x, y)| {
            let [a, b, c, d] = [number(x, y), number(x + 1, y), number(x + 1, y + 1), number(x, y + 1)];
            [[a, b, c], [a, c, d]]
        })
        .collect();
    TriangleMesh {
        vertices_m: (0..side).flat_map(|y| (0..side).map(move |x| at(x, y))).collect(),
        uv: Some(vec![[[0.0; 2]; 3]; triangles.len()]),
        triangles,
        groups: Vec::new(),
        regions: Vec::new(),
    }
}

#[test]
fn every_shipped_scene_and_a_mesh_of_zeros_can_be_moved() {
    let limits = Limits::default();
    let shipped = BUILT_IN.iter().map(|(name, text)| Scene::parse(name, text, &[], &limits).unwrap());
    let message = pb::Scene {
        mesh: Some(pb::Mesh { mesh_id: "a".into(), point_mass_kg: Some(1e-4), ..Default::default() }),
        springs: Some(pb::Springs { stiffness_n_per_m: Some(10.0), ..Default::default() }),
        anchor_springs: Some(pb::AnchorSprings { stiffness_n_per_m: Some(1.0) }),
        damping: Some(pb::Damping { coefficient_n_s_per_m: Some(0.01) }),
        ..Default::default()
    };
    let mesh = flat(100);
    assert_eq!(mesh.triangles.len(), 19_602);
    let zeros = wire::scene::from_scene(&message, Some(&mesh)).unwrap();
    for scene in shipped.chain([zeros]) {
        let model = Model::compile(&scene, &limits).unwrap();
        let mut session = Session::new(&model);
        session.advance(&mut Vec::new(), |_| {});
        let there =
            moved::moved(&model, &session, &limits).unwrap_or_else(|refusal| panic!("{}: {refusal}", scene.name));
        assert!(there.save().to_bytes() == session.save().to_bytes(), "{}", scene.name);
    }
}
