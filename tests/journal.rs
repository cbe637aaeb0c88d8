//! Journals: what is written is read again, whatever happens to the file, and gives the same bits.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::cast_possible_truncation)]

use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::common::cases;
use crate::common::journal_opening::opening;
use glam::DVec3;
use palpate_haptics::{Instrument, Tip};
use palpate_refusal::Reason;
use palpate_session::Session;
use palpate_session::command::{Command, Due};
use palpate_session::input::Input;
use palpate_session::journal::replay::{JournalItem, items};
use palpate_session::journal::{self, JournalReader, JournalWriter, Opening, ReplayEvent, pb, recover};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::script::Action;
use palpate_tissue::scene::{Change, PAPER, Scene};
use palpate_tissue::select::scheme_selection::NEVER;

/// 2026-01-01.
const BEGUN_NS: u64 = 1_767_225_600_000_000_000;

fn model(sets: &[&str]) -> Arc<Model> {
    let (limits, sets) = (Limits::default(), sets.iter().map(|text| (*text).to_owned()).collect::<Vec<_>>());
    Model::compile(&Scene::parse("paper", PAPER, &sets, &limits).unwrap(), &limits).unwrap()
}

fn due(tool: u32, sequence: u64, action: Action) -> Due {
    let client_time_ns = sequence * 1_000_000;
    Due::in_time(Command { client_time_ns, ..Command::new(tool, Some(sequence), action) })
}

/// A pose of a tip that strokes over the middle.
fn pose(model: &Model, sequence: u64) -> Action {
    let middle_m = model.shape().extent().middle_m();
    let deep_m = 0.2 * model.shape().edge_m() * (1.0 - libm::cos(sequence as f64 * 0.01));
    let place_m = middle_m + DVec3::new(1e-5 * sequence as f64, 0.0, -deep_m);
    Action::Pose { place_m, velocity_m_per_s: None, tip: Tip { radius_m: model.shape().edge_m(), ..Tip::default() } }
}

/// Steps of a session in each batch, and in all.
const BATCH_STEPS: u64 = 20;

/// A session that is written as it goes: a tool that strokes, another tissue, a release. Each batch is durable when
/// the next one is written. Tells the file, and where each batch ends.
fn written(first: &Arc<Model>, steps: u64, ends: bool) -> (Vec<u8>, Vec<(u64, u64)>) {
    let mut writer = JournalWriter::new(&opening(first), BEGUN_NS);
    let mut session = Session::new(first);
    let (mut file, mut ends_at) = (Vec::new(), Vec::new());
    let snapshot = |writer: &mut JournalWriter, session: &Session| {
        let (hash, saved) = (session.tissue().state_hash(), session.save().to_bytes());
        writer.snapshot(session.step_count(), hash, session.model(), saved);
    };
    snapshot(&mut writer, &session);
    writer.hash(0, session.tissue().state_hash());
    for step in 0..steps {
        let mut acting = Vec::new();
        if step % 97 == 50 && step < 1000 {
            let change = Change { stiffness_n_per_m: Some(100.0 + step as f64), ..Change::default() };
            let changed = session.model().changed(&change, &first.scene, &Limits::default()).unwrap();
            writer.waiting(&[(step, changed.clone())]);
            writer.input(step, &Input::Tissue(changed.clone()));
            session.change(&changed);
        }
        match step % 200 {
            150 => acting.push(due(0, step + 1, Action::Release)),
            151..200 => {}
            _ => acting.push(due(0, step + 1, pose(first, step + 1))),
        }
        acting.iter().for_each(|due| writer.input(step, &Input::Command(due.clone())));
        session.advance(&mut acting, |_| {});
        let done = session.step_count();
        if done.is_multiple_of(10) {
            writer.felt(done, &session.felt());
        }
        if done.is_multiple_of(50) {
            writer.hash(done, session.tissue().state_hash());
        }
        if done % 500 == 90 {
            snapshot(&mut writer, &session);
        }
        if done.is_multiple_of(BATCH_STEPS) {
            writer.durable(writer.batches());
            file.extend(writer.flush(done, BEGUN_NS + done * 1_000_000));
            ends_at.push((file.len() as u64, done));
        }
    }
    if ends {
        writer.durable(writer.batches());
        file.extend(writer.finish(pb::Why::Drained, "the server ended", steps, BEGUN_NS + steps * 1_000_000));
        ends_at.push((file.len() as u64, steps));
    }
    (file, ends_at)
}

fn small() -> Arc<Model> {
    model(&["sheet.points=[7, 7]"])
}

fn survey(bytes: &[u8]) -> palpate_refusal::Result<palpate_session::journal::Survey> {
    JournalReader::new("test", Cursor::new(bytes))?.survey(&mut |_| {})
}

#[test]
fn a_journal_of_a_stranger_names_no_file_of_this_machine() {
    let mut scene = Scene::parse("paper", PAPER, &["sheet.points=[7, 7]".to_owned()], &Limits::default()).unwrap();
    scene.appearance.texture = Some("/etc/passwd".into());
    let (file, _) = written(&Model::compile(&scene, &Limits::default()).unwrap(), 40, true);
    let texture = |reader: JournalReader<'_>| reader.header().appearance.clone().unwrap().texture;
    let open = || JournalReader::new("a journal", Cursor::new(&file[..])).unwrap();
    assert_eq!(texture(open()), "/etc/passwd");
    assert_eq!(texture(open().without_files()), "");
}

#[test]
fn what_is_written_is_read_again() {
    let first = small();
    let (file, ends) = written(&first, 400, true);
    let found = survey(&file).unwrap();
    assert_eq!((found.until_step, found.batches, found.torn_bytes, found.sealed), (400, ends.len() as u64, 0, false));
    assert_eq!((found.hashes, found.whole_bytes), (9, file.len() as u64));
    assert_eq!(found.end.unwrap().why(), pb::Why::Drained);
    let mut reader = JournalReader::new("test", Cursor::new(&file)).unwrap();
    assert_eq!((reader.header().session_id.as_str(), reader.header().run), ("0123456789abcdef", 1));
    let (mut inputs, mut moments) = (Vec::new(), 0);
    while let Some(batch) = reader.next_batch().unwrap() {
        assert_eq!(batch.first_input, inputs.len() as u64);
        inputs.extend(batch.inputs().unwrap());
        moments += batch.felt().unwrap().len();
    }
    assert_eq!((inputs.len() as u64, moments), (found.inputs, 40));
    assert!(inputs.is_sorted_by_key(|input| input.step));
    // Every pose has its tip, though most are written without one.
    let tips = inputs.iter().filter(|input| {
        let Some(pb::input::What::Command(command)) = &input.what else { return false };
        matches!(&command.action, Some(pb::command::Action::Pose(pose)) if pose.tip.is_some())
    });
    assert_eq!(tips.count(), 300);
}

#[test]
fn a_file_that_is_cut_anywhere_is_read_up_to_its_last_whole_batch() {
    let first = small();
    let (file, ends) = written(&first, 200, true);
    // Up to the end of the chunk itself: its index may be cut.
    for length in 0..file.len() {
        let found = match survey(&file[..length]) {
            Ok(found) => found,
            Err(refusal) => {
                assert!((length as u64) < ends[0].0, "{length}");
                assert!(length < 100 || refusal.reason == Reason::Missing, "{length}: {refusal}");
                continue;
            }
        };
        let before = ends.iter().rev().find(|end| end.0 <= length as u64);
        let after = ends.iter().find(|end| end.0 > length as u64).unwrap();
        assert!(
            found.until_step == before.map_or(0, |end| end.1) || found.until_step == after.1,
            "{length}: {found:?}"
        );
        assert!(found.whole_bytes <= length as u64 && found.end.is_none() || length as u64 > ends[ends.len() - 2].0);
        assert_eq!(found.whole_bytes + found.torn_bytes, length as u64, "{length}: {found:?}");
    }
}

#[test]
fn a_bit_that_is_other_is_found_or_harmless() {
    let first = small();
    let (file, _) = written(&first, 200, true);
    let whole = survey(&file).unwrap();
    let inputs = |bytes: &[u8]| {
        let mut reader = JournalReader::new("test", Cursor::new(bytes)).unwrap();
        let mut all = Vec::new();
        while let Some(batch) = reader.next_batch().unwrap() {
            all.extend(batch.inputs().unwrap());
        }
        all
    };
    let all = inputs(&file);
    let (mut refused, mut torn, mut harmless) = (0, 0, 0);
    let mut rng = fastrand::Rng::with_seed(1);
    let count = cases::short_or_long(3000, 100_000);
    for _ in 0..count {
        let mut bent = file.clone();
        let (at, bit) = (rng.usize(..bent.len()), rng.u8(..8));
        bent[at] ^= 1 << bit;
        match survey(&bent) {
            Err(refusal) => {
                refused += 1;
                assert!(!refusal.message.is_empty() && refusal.place.is_some());
            }
            Ok(found) => {
                let read = inputs(&bent);
                assert_eq!(read, all[..read.len()], "byte {at}, bit {bit}");
                if found.until_step == whole.until_step && found.inputs == whole.inputs {
                    harmless += 1;
                } else {
                    torn += 1;
                    // Only what was not known to be on the disk is taken for torn.
                    assert!(found.batches + 2 >= whole.batches, "byte {at}, bit {bit}: {found:?}");
                }
            }
        }
    }
    assert!(refused > 20 * torn && harmless > 0, "{refused} refused, {torn} torn, {harmless} harmless");
}

#[test]
fn a_sealed_file_opens_with_the_reader_of_mcap() {
    let first = small();
    let (mut file, ends) = written(&first, 200, true);
    let mut sealed = Cursor::new(std::mem::take(&mut file));
    palpate_session::journal::seal::seal(&mut sealed).unwrap();
    let file = sealed.into_inner();
    let found = survey(&file).unwrap();
    assert!(found.sealed && found.torn_bytes == 0 && found.batches == ends.len() as u64, "{found:?}");
    let summary = mcap::Summary::read(&file).unwrap().unwrap();
    let statistics = summary.stats.as_ref().unwrap();
    assert_eq!((statistics.chunk_count, statistics.channel_count), (ends.len() as u32, 7));
    assert_eq!(found.waiting.iter().map(|input| input.step).collect::<Vec<_>>(), [147]);
    assert_eq!(statistics.message_count, mcap::MessageStream::new(&file).unwrap().map(Result::unwrap).count() as u64);
    assert_eq!(summary.chunk_indexes.len(), ends.len());
    for index in &summary.chunk_indexes {
        let indexes = summary.read_message_indexes(&file, index).unwrap();
        assert_eq!(indexes.len(), index.message_index_offsets.len());
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(palpate_session::journal::file::name("abc", 3));
    std::fs::write(&path, &file).unwrap();
    assert_eq!(palpate_session::journal::file::list(folder.path()).unwrap()[0].run, 3);
    assert!(JournalReader::open(&path).is_ok());
    assert!(JournalReader::open(Path::new("nowhere.1.mcap")).is_err());
}

/// Ten minutes with PALPATE_LONG, and then it prints how long that took: for a journal with more hashes and snapshots
/// than a server writes.
#[test]
#[allow(clippy::disallowed_methods)] // The time is only printed.
fn a_long_touch_verifies() {
    let steps = cases::short_or_long(3000, 600_000);
    let (file, _) = written(&model(&["sheet.points=[31, 31]"]), steps, true);
    let begun = std::time::Instant::now();
    let verdict = journal::verify(reader(&file), &Limits::default(), &mut |_, _| {}).unwrap();
    assert_eq!((verdict.steps, verdict.difference), ([0, steps], None));
    let seconds = begun.elapsed().as_secs_f64();
    println!("{steps} steps, {} bytes: verified in {seconds:.2} s", file.len());
}

fn reader(bytes: &[u8]) -> JournalReader<'_> {
    JournalReader::new("test", Cursor::new(bytes)).unwrap()
}

#[test]
fn a_journal_gives_the_same_bits_again_and_a_difference_is_named() {
    for sets in [&["sheet.points=[7, 7]"][..], &["sheet.points=[9, 5]", "stepping.precision=f64"]] {
        let first = model(sets);
        let (file, _) = written(&first, 700, true);
        let verdict = journal::verify(reader(&file), &Limits::default(), &mut |_, _| {}).unwrap();
        assert_eq!((verdict.steps, verdict.difference), ([0, 700], None));
        // Hashes at 50, 100 and so on; snapshots at 0, 90 and 590.
        assert_eq!(verdict.compared, [14, 3]);
    }
    // The tissue of another session: as if one bit of the arithmetic were other.
    let sets = ["sheet.points=[7, 7]", "stepping.integrator=central", "stepping.substeps=2", "stepping.precision=f32"];
    let first = model(&sets);
    let other = model(&[&sets[..], &["damping.coefficient_n_s_per_m=0.06"]].concat());
    let mut writer = JournalWriter::new(&opening(&other), BEGUN_NS);
    let mut inputs = Vec::new();
    let (file, _) = written(&first, 200, true);
    let mut read = reader(&file);
    while let Some(batch) = read.next_batch().unwrap() {
        inputs.extend(items(&batch).unwrap());
    }
    for item in inputs {
        match item {
            JournalItem::Hash(hash) => writer.hash(hash.step, u128::from_str_radix(&hash.hash, 16).unwrap()),
            JournalItem::Input(pb::Input { step, what: Some(pb::input::What::Command(command)) }) => {
                let Some(pb::command::Action::Pose(_)) = command.action else { continue };
                writer.input(step, &Input::Command(due(0, step + 1, pose(&first, step + 1))));
            }
            _ => {}
        }
    }
    let bent = writer.finish(pb::Why::Drained, "", 200, BEGUN_NS);
    let difference = journal::verify(reader(&bent), &Limits::default(), &mut |_, _| {}).unwrap().difference.unwrap();
    assert_eq!((difference.step, difference.equal_until), (50, Some(0)), "{difference}");
    assert!(difference.to_string().contains("at step 0 they were equal"), "{difference}");
}

#[test]
fn a_session_goes_on_from_a_torn_journal_at_its_last_whole_batch() {
    let first = small();
    let (file, ends) = written(&first, 700, false);
    let hash_at = |step: u64| {
        let (session, _) = journal::session_at(reader(&file), &Limits::default(), step, &NEVER).unwrap();
        assert_eq!(session.step_count(), step);
        session.tissue().state_hash()
    };
    for (end, step) in [ends[1], ends[4], ends[29], ends[34]] {
        let resumed = journal::resume(reader(&file[..file.len().min(end as usize + 3)]), &Limits::default());
        let resumed = resumed.unwrap_or_else(|refusal| panic!("{refusal}"));
        assert_eq!((resumed.session.step_count(), resumed.running), (step, true));
        assert_eq!(resumed.session.tissue().state_hash(), hash_at(step), "{step}");
        assert_eq!(resumed.first.scene, first.scene);
    }
    assert!(journal::session_at(reader(&file), &Limits::default(), 701, &NEVER).is_err());
}

#[test]
fn a_part_of_a_journal_and_a_recovered_one_verify_alone() {
    let first = small();
    let (file, ends) = written(&first, 700, false);
    let limits = Limits::default();
    for [from, to] in [[0, 700], [90, 91], [333, 512], [699, 700]] {
        let mut part = Cursor::new(Vec::new());
        recover::cut(reader(&file), [from, to], &limits, &mut part).unwrap();
        let part = part.into_inner();
        let verdict = journal::verify(reader(&part), &limits, &mut |_, _| {}).unwrap();
        assert_eq!((verdict.steps, verdict.difference), ([from, to], None));
        let found = survey(&part).unwrap();
        assert!(found.sealed && found.end.unwrap().why() == pb::Why::Cut);
        let at =
            |bytes: &[u8]| journal::session_at(reader(bytes), &limits, to, &NEVER).unwrap().0.tissue().state_hash();
        assert_eq!(at(&part), at(&file));
    }
    assert!(recover::cut(reader(&file), [5, 5], &limits, &mut Cursor::new(Vec::new())).is_err());
    let torn = &file[..ends[20].0 as usize - 1];
    let mut whole = Cursor::new(Vec::new());
    // The last index is cut off, and no message with it.
    let lost = recover::recover(reader(torn), &mut whole, &mut |_| {}).unwrap();
    let whole = whole.into_inner();
    let found = survey(&whole).unwrap();
    assert_eq!((found.until_step, found.torn_bytes, lost.until_step), (ends[20].1, 0, ends[20].1));
    assert!(found.sealed && found.end.unwrap().why() == pb::Why::Recovered);
    assert_eq!(journal::verify(reader(&whole), &limits, &mut |_, _| {}).unwrap().difference, None);
    let count = mcap::MessageStream::new(&whole).unwrap().map(Result::unwrap).count() as u64;
    assert_eq!(mcap::Summary::read(&whole).unwrap().unwrap().stats.unwrap().message_count, count);
}

#[test]
fn steps_at_rest_are_skipped_and_seen_where_somebody_wants_to() {
    let first = small();
    let mut writer = JournalWriter::new(&opening(&first), BEGUN_NS);
    writer.input(1000, &Input::Pause);
    writer.input(1000, &Input::Start { until: Some(100_000) });
    let file = writer.finish(pb::Why::Drained, "", 5000, BEGUN_NS);
    let mut read = reader(&file);
    let survey = read.survey(&mut |_| {}).unwrap();
    let mut seen = Vec::new();
    let mut replay = journal::Replay::new(read, survey, &Limits::default()).unwrap().stopping_every(1500);
    let see: &mut dyn FnMut(ReplayEvent<'_>) -> palpate_refusal::Result<()> = &mut |what| {
        if let ReplayEvent::Step(session) = what {
            seen.push(session.step_count());
        }
        Ok(())
    };
    replay.advance(u64::MAX, see).unwrap();
    assert_eq!(seen, [1000, 1500, 3000, 4500, 5000]);
    assert_eq!(replay.running(), (true, Some(100_000)));
}

/// The golden file of the versions with that number of [`journal::REPLAYS`].
fn golden(replays: u32) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/journal/golden.{replays}.mcap"))
}

/// Each golden file is of the first version with its number, and stays as it is: until bits change, every later
/// version gives its bits, and then it is refused.
#[test]
fn the_journal_of_an_older_version_gives_the_same_bits_or_is_refused_with_both_versions() {
    for replays in 1..=journal::REPLAYS {
        let mut read = JournalReader::open(&golden(replays)).unwrap();
        let survey = read.survey(&mut |_| {}).unwrap();
        assert_eq!((survey.until_step, survey.snapshots.len(), survey.sealed), (1000, 3, true), "{replays}");
        let verified = journal::verify(read, &Limits::default(), &mut |_, _| {});
        if replays == journal::REPLAYS {
            assert_eq!(verified.unwrap().difference, None);
        } else {
            let message = verified.unwrap_err().to_string();
            assert!(message.contains(&format!("written by Palpate 0.1.0 (replays {replays})")), "{message}");
        }
    }
}

/// Once after each change of `REPLAYS`.
#[test]
#[ignore = "writes the golden file"]
fn write_the_golden_file() {
    let mut file = Cursor::new(written(&small(), 1000, true).0);
    journal::seal::seal(&mut file).unwrap();
    std::fs::write(golden(journal::REPLAYS), file.into_inner()).unwrap();
}

/// The bytes of a snapshot, as a server sends them, with a tool of that radius in the tissue.
fn snapshot_bytes(model: &Arc<Model>, radius_m: f64) -> Vec<u8> {
    let mut session = Session::new(model);
    let middle_m = model.shape().extent().middle_m();
    let action = Action::Pose { place_m: middle_m, velocity_m_per_s: None, tip: Tip { radius_m, ..Tip::default() } };
    session.advance(&mut vec![due(0, 1, action)], |_| {});
    let mut writer = JournalWriter::new(&Opening { begin_step: 1, ..opening(model) }, BEGUN_NS);
    writer.snapshot(1, session.tissue().state_hash(), model, session.save().to_bytes());
    writer.finish(pb::Why::Cut, "a snapshot", 1, BEGUN_NS)
}

#[test]
fn a_copy_for_a_client_is_bounded_whatever_a_server_sends() {
    let tip = Tip { radius_m: 0.005, ..Tip::default() };
    let copy = |sets: &[&str]| {
        let model = model(sets);
        let radius_m = 2.0 * model.shape().edge_m();
        palpate_session::journal::prediction(&snapshot_bytes(&model, radius_m), &Instrument::of_tip(tip))
    };
    let refused = |sets: &[&str], why: &str| {
        let said = copy(sets).err().unwrap();
        assert!(said.contains(why), "{sets:?}: {said}");
    };
    assert!(copy(&["sheet.points=[7, 7]", "sheet.spacing_m=0.01"]).is_ok());
    let given =
        ["stepping.integrator=central", "stepping.substeps=1", "stepping.precision=f64", "sheet.fixed=\"corners\""];
    // Smaller than the tip; and a strip of which it covers ten thousand points.
    refused(&[&given[..], &["sheet.points=[7, 7]", "sheet.spacing_m=1e-7"]].concat(), "tip.radius_m");
    refused(&[&given[..], &["sheet.points=[2, 20000]", "sheet.spacing_m=1e-6"]].concat(), "lengths of an edge");
    refused(&[&given[..], &["sheet.points=[400, 400]", "sheet.spacing_m=0.01"]].concat(), "points");
}
