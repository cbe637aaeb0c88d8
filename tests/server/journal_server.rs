//! Journals of a real server: sessions on the disk continue after a kill, with the same bits; and what happens when
//! the disk fails.
#![cfg(unix)]

use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use crate::common::journal_opening::opening;
use crate::common::server::{self, TEST_TIMEOUT, TestServer, TestTouch, force, server_program, waiting};
use palpate_proto::pb;
use palpate_tissue::limits::Limits;
use palpate_tissue::select::scheme_selection::NEVER;

fn start(folder: &Path) -> TestServer {
    TestServer::start(&["--log", "info", "--journal", folder.to_str().unwrap()])
}

/// The journals of a session, by run.
fn files(folder: &Path, session_id: &str) -> Vec<PathBuf> {
    let listed = palpate_session::journal::file::list(folder).unwrap();
    listed.into_iter().filter(|file| file.session_id == session_id).map(|file| file.path).collect()
}

fn verifies(files: &[PathBuf]) {
    for path in files {
        let reader = palpate_session::journal::JournalReader::open(path).unwrap();
        let verdict = palpate_session::journal::replay::verify(reader, &Limits::default(), &mut |_, _| {}).unwrap();
        assert_eq!(verdict.difference, None, "{}", path.display());
    }
}

/// Returns the position of a byte in the last batch that a later one calls durable.
fn last_durable_byte(path: &Path) -> usize {
    let mut reader = palpate_session::journal::JournalReader::open(path).unwrap();
    let mut batches = Vec::new();
    while let Some(batch) = reader.next_batch().unwrap() {
        batches.push(batch);
    }
    let durable = batches.last().unwrap().durable_batches as usize;
    assert!(durable >= 2, "a batch with steps comes before the damaged one: {durable}");
    // Behind the heads of the record and of its chunk.
    batches[durable - 1].offset as usize + 64
}

async fn durable_at(server: &TestServer, session_id: &str, step: u64) -> u64 {
    let waited = tokio::time::timeout(TEST_TIMEOUT, async {
        loop {
            let journal = server.status(session_id).await.journal.unwrap();
            assert_eq!(journal.fault, "");
            if let Some(durable) = journal.durable_step.filter(|durable| *durable >= step) {
                return durable;
            }
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    });
    waited.await.unwrap()
}

async fn pause(server: &TestServer, session_id: &str) -> pb::Session {
    let request = pb::PauseSessionRequest { session_id: session_id.into() };
    server.sessions().await.pause_session(request).await.unwrap();
    server.status(session_id).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_killed_server_goes_on_with_its_sessions_from_their_durable_step() {
    let folder = tempfile::tempdir().unwrap();
    let mut before = start(folder.path());
    let (pressed, stopped) = (before.paper(false).await, before.paper(true).await);
    before.start_until(&stopped, 120).await;
    let hash_at_120 = before.hash_at(&stopped, 120).await;
    let mut touch = TestTouch::hold(&before, &pressed).await;
    let mut told = 0;
    for sequence in 1..=200_u16 {
        touch.command(force(0, u64::from(sequence), -1e-3 * f64::from(sequence))).await;
        told = touch.sample().await.durable_step.unwrap_or(told).max(told);
        if sequence == 100 {
            let mut change = pb::UpdateTissueRequest { session_id: pressed.clone(), ..Default::default() };
            change.damping_n_s_per_m = Some(0.35);
            before.sessions().await.update_tissue(change).await.unwrap();
        }
    }
    let acted = touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == 200).await.step;
    told = told.max(durable_at(&before, &pressed, acted).await);
    durable_at(&before, &stopped, 120).await;
    before.child.kill().unwrap();
    before.child.wait().unwrap();

    let after = start(folder.path());
    let listed = after.sessions().await.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner().sessions;
    let ids: Vec<_> = listed.iter().map(|session| session.session_id.as_str()).collect();
    assert_eq!(ids.len(), 2, "{ids:?}");
    durable_at(&after, &pressed, told).await;
    let session = after.status(&pressed).await;
    assert!(session.step >= told, "{} < {told}", session.step);
    assert!(session.held_tools.is_empty());
    assert_eq!((session.journal.as_ref().unwrap().run, session.state()), (2, pb::SessionState::Running));
    assert_eq!(session.scene.unwrap().damping.unwrap().coefficient_n_s_per_m, Some(0.35));
    let session = after.status(&stopped).await;
    assert_eq!((session.step, session.state()), (120, pb::SessionState::Paused));
    assert_eq!(after.hash_at(&stopped, 120).await, hash_at_120);
    // Leases are void, sequence numbers begin anew.
    let mut touch = TestTouch::hold(&after, &pressed).await;
    touch.command(force(0, 1, -0.1)).await;
    touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == 1).await;
    drop(touch);
    let session = pause(&after, &pressed).await;
    durable_at(&after, &pressed, session.step).await;
    verifies(&[files(folder.path(), &pressed), files(folder.path(), &stopped)].concat());
}

/// Waits until the journal of a run has changes of the tissue that wait for these steps.
async fn until_waits(folder: &Path, session_id: &str, run: usize, steps: &[u64]) {
    let waits = |path: &PathBuf| waiting(path).as_deref() == Some(steps);
    let waited = tokio::time::timeout(TEST_TIMEOUT, async {
        while !files(folder, session_id).get(run - 1).is_some_and(waits) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    });
    waited.await.unwrap_or_else(|_| panic!("run {run} never has what waits for {steps:?}"));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn changes_of_the_tissue_that_wait_for_their_step_outlive_a_kill() {
    let folder = tempfile::tempdir().unwrap();
    let mut server = start(folder.path());
    let id = server.paper(true).await;
    for (step, stiffness) in [(100, 40.0), (200, 50.0)] {
        let mut change = pb::UpdateTissueRequest { session_id: id.clone(), at_step: Some(step), ..Default::default() };
        change.stiffness_n_per_m = Some(stiffness);
        server.sessions().await.update_tissue(change).await.unwrap();
    }
    // Before the first step, after the first change, and when all have acted.
    let stiffness = [(0, [100, 200].as_slice(), None), (150, &[100, 200], Some(40.0)), (300, &[200], Some(50.0))];
    for (run, (until, waits, stiffness)) in (1..).zip(stiffness) {
        until_waits(folder.path(), &id, run, waits).await;
        if until > 0 {
            server.start_until(&id, until).await;
            server.hash_at(&id, until).await;
            durable_at(&server, &id, until).await;
            let springs = server.status(&id).await.scene.unwrap().springs.unwrap();
            assert_eq!(springs.stiffness_n_per_m, stiffness, "at step {until}");
        }
        server.child.kill().unwrap();
        server.child.wait().unwrap();
        server = start(folder.path());
    }
    assert_eq!(server.status(&id).await.step, 300);
    let kept = files(folder.path(), &id);
    let mut acted = Vec::new();
    for path in &kept {
        let mut reader = palpate_session::journal::JournalReader::open(path).unwrap();
        while let Some(batch) = reader.next_batch().unwrap() {
            let is_tissue =
                |what: &Option<_>| matches!(what, Some(palpate_session::journal::pb::input::What::Tissue(_)));
            acted.extend(batch.inputs().unwrap().iter().filter(|input| is_tissue(&input.what)).map(|input| input.step));
        }
    }
    assert_eq!(acted, [100, 200]);
    verifies(&kept);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_told_to_end_hands_its_sessions_over() {
    let folder = tempfile::tempdir().unwrap();
    let mut before = start(folder.path());
    let id = before.paper(false).await;
    let touch = TestTouch::hold(&before, &id).await;
    touch.command(force(0, 1, -0.2)).await;
    before.until_applied("paper", 0).await;
    let pid = rustix::process::Pid::from_child(&before.child);
    rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
    before.child.wait().unwrap();
    let first = files(folder.path(), &id);
    verifies(&first);
    let after = start(folder.path());
    durable_at(&after, &id, 0).await;
    let session = pause(&after, &id).await;
    assert_eq!(session.journal.unwrap().run, 2);
    assert!(session.step > 0);
    // Deleted, it is not continued, and what happened stays on the disk.
    let deleted = pb::DeleteSessionRequest { session_id: id.clone() };
    let answer = after.sessions().await.delete_session(deleted).await.unwrap().into_inner();
    assert_eq!(answer.journal_fault, "");
    drop(after);
    let last = start(folder.path());
    assert!(
        last.sessions().await.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner().sessions.is_empty()
    );
    let kept = files(folder.path(), &id);
    assert_eq!(kept.len(), 2);
    verifies(&kept);
    let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode() & 0o777;
    assert!(kept.iter().all(|path| mode(path) == 0o600));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nothing_is_kept_where_it_is_not_wanted() {
    let folder = tempfile::tempdir().unwrap();
    let server =
        TestServer::start(&["--log", "error", "--journal", folder.path().to_str().unwrap(), "--journal-keep", "0"]);
    let id = server.paper(false).await;
    assert_eq!(files(folder.path(), &id).len(), 1);
    server.sessions().await.delete_session(pb::DeleteSessionRequest { session_id: id.clone() }).await.unwrap();
    assert!(files(folder.path(), &id).is_empty());
    // Another server has its own folder.
    let mut second = Command::new(server_program())
        .args(["serve", "--listen", "127.0.0.1:0", "--journal", folder.path().to_str().unwrap()])
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut said = String::new();
    std::io::Read::read_to_string(&mut second.stderr.take().unwrap(), &mut said).unwrap();
    assert_eq!(second.wait().unwrap().code(), Some(2), "{said}");
    assert!(said.contains("another server keeps its journals here"), "{said}");
    // Without a journal nothing is reported about one.
    let without = TestServer::start(&["--log", "error"]);
    let id = without.paper(false).await;
    assert_eq!(without.status(&id).await.journal, None);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_full_disk_breaks_the_journal_and_not_the_session_and_the_journal_begins_anew_when_there_is_room() {
    let folder = tempfile::tempdir().unwrap();
    // No file may have more than 200 KiB.
    let script = "trap '' XFSZ; ulimit -f 400; exec \"$0\" serve --listen 127.0.0.1:0 --log error --journal \"$1\"";
    let server = TestServer::by_script(script, &[folder.path().as_os_str()]);
    let id = server.paper(false).await;
    let mut touch = TestTouch::hold(&server, &id).await;
    let mut sequence = 0;
    let fault = tokio::time::timeout(TEST_TIMEOUT, async {
        loop {
            for _ in 0..100 {
                sequence += 1;
                touch.command(force(0, sequence, -0.1)).await;
                touch.sample().await;
            }
            let fault = server.status(&id).await.journal.unwrap().fault;
            if !fault.is_empty() {
                return fault;
            }
        }
    });
    let fault = fault.await.unwrap();
    assert!(fault.contains("can't be written"), "{fault}");
    // The session continues, and the steps that were reported as durable are there.
    let durable = server.status(&id).await.journal.unwrap().durable_step.unwrap();
    sequence += 1;
    touch.command(force(0, sequence, -0.2)).await;
    touch.sample_with(|sample| sample.tools[0].acknowledged_sequence == sequence).await;
    // Another file has room: the journal continues there from a snapshot, and then the fault is over.
    let anew = async {
        loop {
            let journal = server.status(&id).await.journal.unwrap();
            if journal.fault.is_empty() {
                return journal.durable_step.unwrap();
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    let anew = tokio::time::timeout(TEST_TIMEOUT, anew).await.unwrap();
    assert!(anew > durable, "{durable} {anew}");
    drop(server);
    let files = files(folder.path(), &id);
    assert!(files.len() >= 2, "{files:?}");
    verifies(&files);
    let after = start(folder.path());
    assert!(after.status(&id).await.step >= anew);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_journal_that_is_damaged_in_its_middle_is_left_alone_and_told() {
    let folder = tempfile::tempdir().unwrap();
    let mut before = start(folder.path());
    let (broken, whole) = (before.paper(false).await, before.paper(false).await);
    for id in [&broken, &whole] {
        let mut touch = TestTouch::hold(&before, id).await;
        for sequence in 1..=300 {
            touch.command(force(0, sequence, -0.1)).await;
            let step = touch.sample().await.step;
            // A batch after each hundredth sample tells that what came before is durable, however slow the disk is.
            if sequence % 100 == 0 {
                durable_at(&before, id, step).await;
            }
        }
    }
    before.child.kill().unwrap();
    before.child.wait().unwrap();
    let path = files(folder.path(), &broken).remove(0);
    let mut bytes = std::fs::read(&path).unwrap();
    let place = last_durable_byte(&path);
    bytes[place] ^= 16;
    std::fs::write(&path, &bytes).unwrap();
    let after = start(folder.path());
    let listed = after.sessions().await.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner().sessions;
    assert_eq!(listed.len(), 1);
    assert_eq!(listed[0].session_id, whole);
    // It is played, and gone on from, up to there.
    let request = pb::GetJournalRequest { session_id: broken.clone(), run: 0 };
    let told = after.sessions().await.get_journal(request).await.unwrap().into_inner();
    let fault = told.info.unwrap().fault;
    assert!(fault.starts_with("damaged at byte") && told.end_step > told.begin_step, "{fault}, {}", told.end_step);
    let moment = |plays| {
        let step = Some(told.end_step);
        let moment = pb::JournalMoment { session_id: broken.clone(), step, plays, ..Default::default() };
        pb::create_session_request::Source::Journal(moment)
    };
    for plays in [true, false] {
        assert_eq!(after.create(moment(plays), true).await.unwrap().step, told.end_step);
    }
    assert_eq!(std::fs::read(&path).unwrap(), bytes);
    let log = after.log();
    assert!(log.contains(path.to_str().unwrap()) && log.contains("step"), "{log}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_was_recorded_is_played_with_the_same_bits_and_gone_on_from() {
    use pb::create_session_request::Source;
    let folder = tempfile::tempdir().unwrap();
    let server = start(folder.path());
    let id = server.paper(true).await;
    let mut touch = TestTouch::hold(&server, &id).await;
    let mut hashes = Vec::new();
    for (sequence, step) in (1..).zip([40, 80, 120, 160, 200]) {
        touch.command(force(0, sequence, -0.05 * step as f64)).await;
        touch.settle().await;
        server.start_until(&id, step).await;
        hashes.push((step, server.hash_at(&id, step).await));
    }
    durable_at(&server, &id, 200).await;
    let moment = |step, plays, speed| {
        Source::Journal(pb::JournalMoment { session_id: id.clone(), step, plays, speed, ..Default::default() })
    };
    // Played from its beginning and from its middle: the same hashes. At the end time stands.
    for (from, speed) in [(0, Some(8.0)), (100, Some(0.5)), (160, None)] {
        let played = server.create(moment(Some(from), true, speed), true).await.unwrap();
        let playback = played.playback.clone().unwrap();
        assert_eq!((played.step, playback.end_step, playback.speed), (from, 200, speed.unwrap_or(1.0)));
        let played = played.session_id;
        for (step, hash) in hashes.iter().filter(|(step, _)| *step > from) {
            server.start_until(&played, *step).await;
            assert_eq!(server.hash_at(&played, *step).await, *hash, "step {step} of what is played from {from}");
        }
        server.start_until(&played, 1000).await;
        let waited = tokio::time::timeout(TEST_TIMEOUT, async {
            while server.status(&played).await.state() != pb::SessionState::Paused {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        });
        waited.await.unwrap();
        assert_eq!(server.status(&played).await.step, 200);
        let held = TestTouch::open(&server, server::open(&played, &[0])).await;
        assert!(held.err().unwrap().message().contains("plays a recording"));
    }
    // Gone on from: a live session, at whose beginning the tissue is as it was, and nothing presses any more.
    let live = server.create(moment(Some(120), false, None), true).await.unwrap();
    assert!(live.playback.is_none() && live.journal.is_some() && live.step == 120);
    assert_eq!(server.hash_at(&live.session_id, 120).await, hashes[2].1);
    let mut other = TestTouch::hold(&server, &live.session_id).await;
    other.command(force(0, 1, -0.2)).await;
    other.settle().await;
    server.start_until(&live.session_id, 160).await;
    assert_ne!(server.hash_at(&live.session_id, 160).await, hashes[3].1);
    // The curve of the whole, and what can't be.
    let mut sessions = server.sessions().await;
    let listed = sessions.list_journals(pb::ListJournalsRequest {}).await.unwrap().into_inner().journals;
    assert_eq!(listed.len(), 2, "what is played is not recorded again: {listed:?}");
    assert!(listed.iter().all(|info| info.live && info.fault.is_empty() && info.scene_name == "paper"));
    let request = pb::GetJournalRequest { session_id: id.clone(), run: 0 };
    let told = sessions.get_journal(request).await.unwrap().into_inner();
    assert_eq!((told.begin_step, told.end_step, told.rate_hz), (0, 200, 1000.0));
    assert!(told.forces.iter().any(|moment| moment.force_n > 0.01), "{:?}", told.forces);
    for (step, speed, wrong) in [(Some(201), None, "step"), (None, Some(9.0), "speed")] {
        let refused = server.create(moment(step, true, speed), true).await.unwrap_err();
        assert!(refused.message().contains(wrong), "{refused}");
    }
    for unknown in ["../lock", "nothing"] {
        let request = pb::GetJournalRequest { session_id: unknown.into(), run: 0 };
        assert_eq!(sessions.get_journal(request).await.unwrap_err().code(), tonic::Code::NotFound);
    }
}

/// Sends a request in parts. Returns the answer to the last one.
async fn send(server: &TestServer, bytes: &[u8]) -> Result<pb::UploadJournalResponse, tonic::Status> {
    let at = palpate_client::Server::new(&server.url, &palpate_client::Credentials::default()).unwrap();
    let (channel, mut sent) = (at.connect().await.unwrap(), 0);
    let answer = palpate_client::upload::upload_journal(channel, bytes, |bytes| sent = bytes).await?;
    assert_eq!(sent, bytes.len() as u64);
    Ok(answer)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_snapshot_is_a_journal_of_one_moment_and_goes_on_at_another_server() {
    use pb::create_session_request::Source;
    let server = TestServer::start(&["--log", "error"]);
    let id = server.paper(true).await;
    let mut touch = TestTouch::hold(&server, &id).await;
    touch.command(force(0, 1, -0.3)).await;
    touch.settle().await;
    server.start_until(&id, 77).await;
    let hash = server.hash_at(&id, 77).await;
    let request = pb::SaveSnapshotRequest { session_id: id.clone() };
    let parts = server.sessions().await.save_snapshot(request).await.unwrap().into_inner();
    let bytes = palpate_client::snapshot::collect(parts).await.unwrap();
    let reader = palpate_session::journal::JournalReader::new("snapshot", std::io::Cursor::new(&bytes)).unwrap();
    let (session, _) = palpate_session::journal::session_at(reader, &Limits::default(), 77, &NEVER).unwrap();
    assert_eq!(format!("{:032x}", session.tissue().state_hash()), hash);

    let other = TestServer::start(&["--log", "error"]);
    let answer = send(&other, &bytes).await.unwrap();
    let told = answer.journal.unwrap();
    assert_eq!((told.begin_step, told.end_step, told.info.unwrap().session_id), (77, 77, id.clone()));
    let moment = |upload_id: &str, step| {
        Source::Journal(pb::JournalMoment { upload_id: upload_id.into(), step, ..Default::default() })
    };
    let live = other.create(moment(&answer.upload_id, None), true).await.unwrap();
    assert_ne!(live.session_id, id);
    assert_eq!((live.step, other.hash_at(&live.session_id, 77).await), (77, hash.clone()));
    other.start_until(&live.session_id, 100).await;
    // Twice, and not what it has not.
    assert_eq!(other.create(moment(&answer.upload_id, Some(77)), true).await.unwrap().step, 77);
    let refused = other.create(moment(&answer.upload_id, Some(78)), true).await.unwrap_err();
    assert!(refused.message().contains("step"), "{refused}");
    // Nobody else's, and nothing else.
    let refused = server.create(moment(&answer.upload_id, None), true).await.unwrap_err();
    assert_eq!(refused.code(), tonic::Code::NotFound, "{refused}");
    let both = pb::JournalMoment { upload_id: answer.upload_id.clone(), session_id: id, ..Default::default() };
    assert!(other.create(Source::Journal(both), true).await.is_err());
    let mut bent = bytes.clone();
    let middle = bent.len() / 2;
    bent[middle] ^= 1;
    for wrong in [&bytes[..20], b"solid", &bent] {
        let refused = send(&other, wrong).await.unwrap_err();
        assert_eq!(refused.code(), tonic::Code::InvalidArgument, "{refused}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_journal_is_replayed_through_a_server_that_keeps_none() {
    let folder = tempfile::tempdir().unwrap();
    let (id, hash, file) = {
        let server = start(folder.path());
        let id = server.paper(true).await;
        let mut touch = TestTouch::hold(&server, &id).await;
        touch.command(force(0, 1, -0.3)).await;
        touch.settle().await;
        server.start_until(&id, 150).await;
        let hash = server.hash_at(&id, 150).await;
        durable_at(&server, &id, 150).await;
        let file = files(folder.path(), &id).remove(0);
        (id, hash, file)
    };
    let server = TestServer::start(&["--log", "error"]);
    let run = |program: PathBuf, arguments: &[&str]| {
        let ran = Command::new(program).args(arguments).arg(&file).args(["--server", &server.url]).output().unwrap();
        (
            ran.status.code(),
            String::from_utf8_lossy(&ran.stdout).into_owned(),
            String::from_utf8_lossy(&ran.stderr).into_owned(),
        )
    };
    let (status, out, told) = run(server::client_program(), &["play", "--json", "--speed", "8"]);
    assert_eq!(status, Some(0), "{told}");
    let played: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!((played["begin_step"].as_u64(), played["end_step"].as_u64()), (Some(0), Some(150)));
    assert_eq!(played["state_hash"], hash.as_str());
    assert_ne!(played["session_id"], id.as_str());
    let (status, out, told) = run(server_program(), &["journal", "replay", "--from", "100", "--to", "120"]);
    assert!(status == Some(0) && out.contains("100 to 120"), "{out}{told}");
    let (status, _, told) = run(server_program(), &["journal", "replay", "--from", "151"]);
    assert!(status == Some(2) && told.contains("--from: must be from 0 to 150"), "{told}");
    // Nothing is left, except the session that continues live.
    let (status, out, told) = run(server::client_program(), &["play", "--live", "--json"]);
    assert_eq!(status, Some(0), "{told}");
    let live: serde_json::Value = serde_json::from_str(&out).unwrap();
    let listed = server.sessions().await.list_sessions(pb::ListSessionsRequest {}).await.unwrap().into_inner().sessions;
    assert_eq!(listed.len(), 1);
    assert_eq!(
        (listed[0].session_id.as_str(), listed[0].state()),
        (live["session_id"].as_str().unwrap(), pb::SessionState::Running)
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_a_server_plays_is_compared_with_the_journal_and_written() {
    let folder = tempfile::tempdir().unwrap();
    let (id, file) = {
        let server = start(folder.path());
        let id = server.paper(true).await;
        let mut touch = TestTouch::hold(&server, &id).await;
        // It does not come to rest before a second is over, when its hash is written.
        for (sequence, step) in (1..).zip([450, 900, 1200]) {
            touch.command(force(0, sequence, -3e-4 * step as f64)).await;
            touch.settle().await;
            server.start_until(&id, step).await;
            server.hash_at(&id, step).await;
        }
        durable_at(&server, &id, 1200).await;
        (id.clone(), files(folder.path(), &id).remove(0))
    };
    server::client_program();
    let server = TestServer::start(&["--log", "error"]);
    let replay = |file: &Path, arguments: &[&str]| {
        let ran = server::palpate(&[&["journal", "replay", file.to_str().unwrap()], arguments].concat());
        let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
        (ran.status.code(), text(ran.stdout), text(ran.stderr))
    };
    let on_server = ["--server", server.url.as_str(), "--speed", "4"];
    let [here, there] = ["here.jsonl", "there.jsonl"].map(|name| folder.path().join(name).display().to_string());
    let records = |output: &'_ str| {
        ["--every", "100", "--point", "15,15", "--point", "3,4", "--output"]
            .map(str::to_owned)
            .into_iter()
            .chain([output.to_owned()])
            .collect::<Vec<_>>()
    };
    let told = |output: &str, more: &[&str]| {
        let records = records(output);
        let arguments: Vec<&str> = records.iter().map(String::as_str).chain(more.iter().copied()).collect();
        replay(&file, &arguments)
    };
    assert_eq!(told(&here, &[]).0, Some(0));
    let (status, out, err) = told(&there, &on_server);
    assert!(status == Some(0) && out.contains("recorded hashes  1 equal"), "{out}{err}");
    // The same lines, but for the record of the beginning and the summary of what was computed here.
    let lines = |path: &str| std::fs::read_to_string(path).unwrap().lines().map(str::to_owned).collect::<Vec<_>>();
    let (mut here, there) = (lines(&here), lines(&there));
    assert!(here.pop().unwrap().contains("summary") && here.remove(1).contains("\"time_s\":0.0"));
    assert!(here.len() == 13 && here == there, "{there:?}");
    let (status, _, err) = replay(&file, &[&on_server[..], &["--point", "1,1"]].concat());
    assert!(status == Some(2) && err.contains("--output"), "{err}");
    // A journal that has another hash than its inputs give.
    let mut reader = palpate_session::journal::JournalReader::open(&file).unwrap();
    let survey = reader.survey(&mut |_| {}).unwrap();
    let first = palpate_session::journal::Replay::new(reader, survey, &Limits::default()).unwrap().first().clone();
    let opening = palpate_session::journal::Opening { session_id: &id, ..opening(&first) };
    let mut writer = palpate_session::journal::JournalWriter::new(&opening, 1);
    writer.hash(100, 7);
    let wrong = folder.path().join("wrong.mcap");
    std::fs::write(&wrong, writer.finish(palpate_session::journal::pb::Why::Deleted, "", 200, 2)).unwrap();
    let (status, out, err) = replay(&wrong, &on_server);
    assert!(
        status == Some(1) && err.contains("differs: the state at step 100 was 00000000000000000000000000000007"),
        "{out}{err}"
    );
}

/// A file system of its own, in a file of `folder`. It is gone with this.
#[cfg(target_os = "linux")]
struct Disk(PathBuf);

#[cfg(target_os = "linux")]
impl Disk {
    /// `None` if mounting is not allowed here.
    fn mount(folder: &Path) -> Option<Self> {
        let [image, at] = ["disk", "mounted"].map(|name| folder.join(name));
        std::fs::create_dir(&at).unwrap();
        std::fs::File::create(&image).unwrap().set_len(64 << 20).unwrap();
        let is_there = run("mkfs.ext4", &["-q".as_ref(), &image])
            && run("fsfreeze", &["--version".as_ref()])
            && run("mount", &["-o".as_ref(), "loop".as_ref(), &image, &at]);
        is_there.then_some(Disk(at))
    }

    /// Blocks writers until the returned guard is dropped.
    fn freeze(&self) -> Frozen<'_> {
        assert!(run("fsfreeze", &["-f".as_ref(), &self.0]));
        Frozen(&self.0)
    }
}

#[cfg(target_os = "linux")]
struct Frozen<'d>(&'d Path);

#[cfg(target_os = "linux")]
impl Drop for Frozen<'_> {
    fn drop(&mut self) {
        run("fsfreeze", &["-u".as_ref(), self.0]);
    }
}

#[cfg(target_os = "linux")]
impl Drop for Disk {
    fn drop(&mut self) {
        run("umount", &[&self.0]);
    }
}

#[cfg(target_os = "linux")]
fn run(program: &str, arguments: &[&Path]) -> bool {
    let ran = Command::new(program).args(arguments).stdout(Stdio::null()).stderr(Stdio::null()).status();
    ran.is_ok_and(|status| status.success())
}

/// Presses for so long, each command after the one before has acted. Tells the steps that were done and those that
/// were dropped.
#[cfg(target_os = "linux")]
async fn pressed(
    server: &TestServer,
    id: &str,
    touch: &mut TestTouch,
    sequence: &mut u64,
    longest: Duration,
) -> [u64; 2] {
    let (before, begun) = (server.status(id).await, std::time::Instant::now());
    while begun.elapsed() < longest {
        *sequence += 1;
        touch.command(force(0, *sequence, -0.1 - 1e-3 * (*sequence % 100) as f64)).await;
        let newest = *sequence;
        touch.sample_with(|sample| sample.tools.first().is_some_and(|tool| tool.acknowledged_sequence == newest)).await;
    }
    let after = server.status(id).await;
    [after.step - before.step, after.overrun_count - before.overrun_count]
}

#[cfg(target_os = "linux")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_step_waits_for_a_disk_that_stalls() {
    if std::env::var_os("PALPATE_LONG").is_none() {
        return eprintln!("SKIPPED: a disk that stalls for 5 s; PALPATE_LONG=1 does it");
    }
    let folder = tempfile::tempdir().unwrap();
    let Some(disk) = Disk::mount(folder.path()) else {
        return eprintln!("SKIPPED: a disk that stalls needs root, mkfs.ext4, mount with a loop device, and fsfreeze");
    };
    let journals = disk.0.join("journals");
    let server = start(&journals);
    let id = server.paper(false).await;
    let (mut touch, mut sequence, stall) = (TestTouch::hold(&server, &id).await, 0, Duration::from_secs(5));
    let usual = pressed(&server, &id, &mut touch, &mut sequence, stall).await;
    durable_at(&server, &id, usual[0]).await;
    let frozen = disk.freeze();
    let stalled = pressed(&server, &id, &mut touch, &mut sequence, stall).await;
    let told = server.status(&id).await;
    let journal = told.journal.unwrap();
    drop(frozen);
    eprintln!("5 s each: {usual:?} steps done and dropped with the disk, {stalled:?} while it stalled");
    // Steps done meanwhile reach the disk later: nothing is lost.
    assert!(journal.fault.is_empty() && journal.durable_step.unwrap() + stalled[0] / 2 < told.step, "{journal:?}");
    let after = pressed(&server, &id, &mut touch, &mut sequence, Duration::from_millis(500)).await;
    assert!(after[0] > 0);
    let session = pause(&server, &id).await;
    durable_at(&server, &id, session.step).await;
    drop((touch, server));
    verifies(&files(&journals, &id));
}
