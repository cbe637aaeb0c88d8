//! `palpate journal` of damaged, cut and signed journals: whole parts are used, proofs are reported, and who
//! changed a file is found.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods, missing_docs)]

use std::path::Path;
use std::process::Command;

use crate::common::journal_opening::opening;
use palpate::server::journal_key;
use palpate_session::Session;
use palpate_session::journal::signature::{Key, Signatures};
use palpate_session::journal::{JournalReader, JournalWriter, Opening, pb};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::{PAPER, Scene};

/// 2026-01-01.
const BEGUN_NS: u64 = 1_767_225_600_000_000_000;

/// Exit status, and both outputs.
fn palpate(folder: &Path, arguments: &[&str]) -> (i32, String) {
    let program = env!("CARGO_BIN_EXE_palpate");
    let output = Command::new(program).arg("journal").args(arguments).current_dir(folder).output().unwrap();
    let text = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
    (output.status.code().unwrap(), text)
}

/// A session of 400 steps at rest: a hash every 100 steps, a batch every 40, each durable when the next one is
/// written.
fn journal(key: Option<&Key>, ends: bool) -> Vec<u8> {
    let limits = Limits::default();
    let scene = Scene::parse("paper", PAPER, &["sheet.points=[7, 7]".to_owned()], &limits).unwrap();
    let first = Model::compile(&scene, &limits).unwrap();
    let opening = Opening { owner: "ann of the test", ..opening(&first) };
    let (mut session, mut file) = (Session::new(&first), Vec::new());
    let mut writer = JournalWriter::new(&opening, BEGUN_NS).signed(key);
    writer.snapshot(0, session.tissue().state_hash(), session.model(), session.save().to_bytes());
    for step in (40..=400).step_by(40) {
        session.skip_to(step);
        if step % 80 == 0 {
            writer.hash(step, session.tissue().state_hash());
        }
        writer.durable(writer.batches());
        file.extend(writer.flush(step, BEGUN_NS + step * 10_000_000));
    }
    if ends {
        writer.durable(writer.batches());
        file.extend(writer.finish(pb::Why::Drained, "the server ended", 400, BEGUN_NS + 4_000_000_000));
    }
    file
}

/// Returns the beginning of each batch.
fn batches(file: &[u8]) -> Vec<usize> {
    let mut reader = JournalReader::new("test", std::io::Cursor::new(file)).unwrap();
    std::iter::from_fn(|| reader.next_batch().unwrap()).map(|batch| usize::try_from(batch.offset).unwrap()).collect()
}

#[test]
fn what_is_whole_of_a_damaged_journal_can_be_used() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let run = |arguments: &[&str]| palpate(folder.path(), arguments);
    let mut file = journal(None, true);
    // In the batch of steps 240 to 280.
    let place = batches(&file)[6] + 60;
    file[place] ^= 1;
    std::fs::write(at("s.1.mcap"), &file).unwrap();
    let says = |(status, text): (i32, String), expected: i32, parts: &[&str]| {
        assert_eq!(status, expected, "{text}");
        parts.iter().for_each(|part| assert!(text.contains(part), "`{part}` is not in {text}"));
    };
    let damage = "damaged at byte";
    says(run(&["verify", "s.1.mcap"]), 2, &["240 of 240 steps proved, 0 to 240: 3 hashes", damage]);
    says(run(&["list", "."]), 0, &["damaged", " 240 "]);
    let cut = ["cut", "s.1.mcap", "--from", "80", "--to", "240", "--output", "cut.1.mcap"];
    says(run(&cut), 0, &["warning", damage, "whole up to step 240"]);
    says(run(&["verify", "cut.1.mcap"]), 0, &["160 of 160 steps proved"]);
    says(run(&["cut", "s.1.mcap", "--from", "80", "--to", "300", "--output", "x.1.mcap"]), 2, &["at most 240", damage]);
    assert!(!at("x.1.mcap").exists());
    let replayed = run(&["replay", "s.1.mcap", "--to", "200", "--every", "40", "--point", "3,3"]);
    says(replayed, 0, &["\"time_s\":0.2,", "warning", damage]);
    says(run(&["replay", "s.1.mcap", "--every", "40", "--point", "3,3"]), 2, &["\"time_s\":0.24,", damage]);
    says(run(&["export", "s.1.mcap", "--format", "csv"]), 2, &["step,time_s", damage]);
    says(run(&["export", "s.1.mcap", "--format", "mcap", "--output", "fox.mcap"]), 2, &[damage]);
    assert!(at("fox.mcap").metadata().unwrap().len() > 1000);
    says(run(&["render", "s.1.mcap", "--at", "120", "--size", "64x64", "--output", "a.png"]), 0, &["warning", damage]);
    says(run(&["recover", "s.1.mcap"]), 0, &["s.1.mcap.damaged", "complete up to step 240", "are lost"]);
    assert_eq!(std::fs::read(at("s.1.mcap.damaged")).unwrap(), file);
    says(run(&["verify", "s.1.mcap"]), 0, &["240 of 240 steps proved"]);
}

#[test]
fn verify_tells_how_much_was_proved() {
    let folder = tempfile::tempdir().unwrap();
    let run = |arguments: &[&str]| palpate(folder.path(), arguments);
    std::fs::write(folder.path().join("s.1.mcap"), journal(None, true)).unwrap();
    assert_eq!(run(&["cut", "s.1.mcap", "--from", "90", "--to", "150", "--output", "none.1.mcap"]).0, 0);
    assert_eq!(run(&["cut", "s.1.mcap", "--from", "90", "--to", "190", "--output", "some.1.mcap"]).0, 0);
    let (status, text) = run(&["verify", "none.1.mcap"]);
    assert!(
        status == 0 && text.contains("0 of 60 steps proved: it has no hash after its beginning at step 90"),
        "{text}"
    );
    let (status, text) = run(&["verify", "some.1.mcap"]);
    assert!(status == 0 && text.contains("70 of 100 steps proved, 90 to 160: 1 hash, 1 snapshot"), "{text}");
    assert!(text.contains("the 30 steps after the last hash can be anything"), "{text}");
}

#[test]
fn a_signature_finds_who_changed_a_journal() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let run = |arguments: &[&str]| palpate(folder.path(), arguments);
    for name in ["a.key", "b.key"] {
        assert_eq!(run(&["key", name]).0, 0);
    }
    let (status, text) = run(&["key", "a.key"]);
    assert!(status == 2 && text.contains("exists already"), "{text}");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        assert_eq!(at("a.key").metadata().unwrap().permissions().mode() & 0o777, 0o600);
    }
    let key = journal_key::private(&std::fs::read_to_string(at("a.key")).unwrap()).unwrap();
    let verify = |file: &[u8], key: &str| {
        std::fs::write(at("s.1.mcap"), file).unwrap();
        run(&["verify", "s.1.mcap", "--signed-by", key])
    };
    let whole = journal(Some(&key), true);
    let (status, text) = verify(&whole, "a.key.pub");
    assert!(status == 0 && text.contains("400 of 400 steps proved") && text.contains("signed whole"), "{text}");
    let (status, text) = verify(&whole, "b.key.pub");
    assert!(status == 1 && text.contains("is signed by another key"), "{text}");
    let (status, text) = verify(&journal(None, true), "a.key.pub");
    assert!(status == 1 && text.contains("has no signature"), "{text}");
    let (status, text) = verify(&whole, "a.key");
    assert!(status == 2 && text.contains("has no public key in PEM"), "{text}");
    // A file that ends behind a signature: nobody has changed it, but its end is not there. A second passes in 100
    // steps.
    let at_batch = batches(&whole);
    let (status, text) = verify(&whole[..at_batch[4]], "a.key.pub");
    assert!(status == 0 && text.contains("signed up to step 160") && text.contains("it has no end"), "{text}");
    let (status, text) = verify(&whole[..at_batch[3]], "a.key.pub");
    assert!(status == 1 && text.contains("signed up to step 40 only") && text.contains("anybody"), "{text}");
    // An attacker who changes an input also renews the checksum of its chunk; hashes at rest would not show it.
    let mut changed = whole.clone();
    let owner = changed.windows(15).position(|bytes| bytes == b"ann of the test").unwrap();
    changed[owner..owner + 3].copy_from_slice(b"bob");
    let length = u64::from_le_bytes(changed[at_batch[0] + 1..at_batch[0] + 9].try_into().unwrap());
    let chunk = at_batch[0] + 9..at_batch[0] + 9 + usize::try_from(length).unwrap();
    let crc = crc32fast::hash(&changed[chunk.start + 40..chunk.end]);
    changed[chunk.start + 24..chunk.start + 28].copy_from_slice(&crc.to_le_bytes());
    let (status, text) = verify(&changed, "a.key.pub");
    assert!(status == 1 && text.contains("its signature is of something else"), "{text}");
    assert!(text.contains("400 of 400 steps proved"), "{text}");
}

#[test]
fn every_bit_that_decides_something_is_signed() {
    let key = "-----BEGIN PRIVATE KEY-----\nMC4CAQAwBQYDK2VwBCIEIAABAgMEBQYHCAkKCwwNDg8QERITFBUWFxgZGhscHR4f\n\
        -----END PRIVATE KEY-----\n";
    // A key as openssl writes it, without the public part.
    let key = journal_key::private(key).unwrap();
    let whole = journal(Some(&key), true);
    let signed = |bytes: &[u8]| {
        let (mut reader, mut signatures) =
            (JournalReader::new("test", std::io::Cursor::new(bytes))?, Signatures::of(key.public()));
        while let Some(batch) = reader.next_batch()? {
            signatures.check(&batch)?;
        }
        Ok::<_, palpate_refusal::Refusal>(signatures.signed())
    };
    let all = signed(&whole).unwrap().unwrap();
    assert!(all.ended && all.unsigned == 0 && all.until_step == 400, "{all:?}");
    let mut rng = fastrand::Rng::with_seed(1);
    let at = batches(&whole);
    for _ in 0..300 {
        // Behind the checksum, which is made anew, in any chunk.
        let mut bent = whole.clone();
        let begin = at[rng.usize(..at.len())];
        let length = usize::try_from(u64::from_le_bytes(bent[begin + 1..begin + 9].try_into().unwrap())).unwrap();
        let place = begin + 9 + 40 + rng.usize(..length - 40);
        bent[place] ^= 1 << rng.u8(..8);
        let crc = crc32fast::hash(&bent[begin + 49..begin + 9 + length]);
        bent[begin + 33..begin + 37].copy_from_slice(&crc.to_le_bytes());
        if let Ok(Some(found)) = signed(&bent)
            && found == all
        {
            // Schemas, names of unknown channels, numbers and times of publication: they have no effect.
            let read = |bytes: &[u8]| {
                let mut reader = JournalReader::new("test", std::io::Cursor::new(bytes)).unwrap();
                let header = reader.header().clone();
                let batches: Vec<_> = std::iter::from_fn(|| reader.next_batch().unwrap())
                    .map(|batch| (batch.inputs().unwrap(), batch.hashes().unwrap(), batch.until_step, batch.unix_ns))
                    .collect();
                (header, batches)
            };
            assert_eq!(read(&bent), read(&whole), "byte {place}");
        }
    }
}
