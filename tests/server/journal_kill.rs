//! A server with journals is killed at random moments under load (`kill -9`), and started again: every session is
//! there, not before the last step that was reported to a client as durable, with the bits of an offline run of the
//! same inputs; of the commands that were reported as durable none is lost, and none acts twice.
//!
//! Twice in every run of the tests; `make soak` does it JOURNAL_KILLS=200 times with 20 sessions
//! (PALPATE_JOURNAL_KILLS, PALPATE_JOURNAL_SESSIONS, PALPATE_SEED), and prints how soon clients touch again.
#![cfg(unix)]

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::common::random::TestRandom;
use crate::common::server::{self, TestServer, TestTouch, force, until};
use palpate_proto::pb;
use palpate_session::journal::file::JournalFile;
use palpate_session::journal::{JournalReader, file, pb as kept, replay};
use palpate_tissue::limits::Limits;
use pb::touch_response::Message as Heard;

/// Reports to a client about a session.
#[derive(Debug, Clone, Copy, Default)]
struct ClientHistoryBeforeKill {
    durable_step: u64,
    /// The newest command that acted before that step.
    durable_sequence: u64,
}

/// Presses a session at 1 kHz until its server is gone. Tells when its first command had acted.
async fn press(
    server: Arc<TestServer>,
    id: String,
    told: Arc<Mutex<BTreeMap<String, ClientHistoryBeforeKill>>>,
) -> Option<Instant> {
    let mut open = server::open(&id, &[0]);
    open.sample_every_steps = Some(1);
    let mut touch = TestTouch::open(&server, open).await.ok()?;
    let mut ticks = tokio::time::interval(Duration::from_millis(1));
    let (mut sequence, mut first) = (0_u16, None);
    // Steps and the newest commands that had acted at them, until they are durable.
    let mut acted: Vec<(u64, u64)> = Vec::new();
    loop {
        tokio::select! {
            _ = ticks.tick() => {
                sequence += 1;
                let z_n = -0.2 * (f64::from(sequence) * 0.01).sin().abs();
                if !touch.try_command(force(0, u64::from(sequence), z_n)).await {
                    return first;
                }
            }
            heard = touch.hear() => match heard {
                Ok(Some(Heard::Sample(sample))) => {
                    let sequence = sample.tools.first().map_or(0, |tool| tool.acknowledged_sequence);
                    if sequence > 0 {
                        first.get_or_insert_with(Instant::now);
                        acted.push((sample.step, sequence));
                    }
                    let Some(durable_step) = sample.durable_step else { continue };
                    let durable = acted.partition_point(|acted| acted.0 <= durable_step);
                    let newest = acted.drain(..durable).next_back();
                    let mut told = told.lock().unwrap();
                    let told = told.entry(id.clone()).or_default();
                    told.durable_step = told.durable_step.max(durable_step);
                    told.durable_sequence = newest.map_or(told.durable_sequence, |acted| acted.1);
                }
                Ok(Some(_)) => {}
                Ok(None) | Err(_) => return first,
            }
        }
    }
}

fn sequences(path: &Path) -> Vec<u64> {
    let mut reader = JournalReader::open(path).unwrap();
    let mut sequences = Vec::new();
    while let Some(batch) = reader.next_batch().unwrap() {
        for input in batch.inputs().unwrap() {
            if let Some(kept::input::What::Command(command)) = input.what {
                sequences.extend(command.sequence);
            }
        }
    }
    sequences
}

/// Checks that the run continues the one before with the bits of an offline run of its inputs.
fn goes_on(before: &JournalFile, after: &JournalFile) {
    let resumed = replay::resume(JournalReader::open(&before.path).unwrap(), &Limits::default()).unwrap();
    let mut session = resumed.session;
    if let Some(model) = &resumed.pending {
        session.change(model);
    }
    session.let_go();
    let mut reader = JournalReader::open(&after.path).unwrap();
    assert_eq!(reader.header().begin_step, resumed.survey.until_step);
    let first = reader.next_batch().unwrap().unwrap().snapshots().unwrap().remove(0);
    assert_eq!(first.hash, format!("{:032x}", session.tissue().state_hash()), "{}", after.path.display());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whatever_was_told_to_be_durable_survives_a_kill_at_any_moment() {
    let of = |name: &str, otherwise: u64| std::env::var(name).map_or(otherwise, |text| text.parse().unwrap());
    let (kills, count) = (of("PALPATE_JOURNAL_KILLS", 2), of("PALPATE_JOURNAL_SESSIONS", 3));
    let mut random = TestRandom(of("PALPATE_SEED", 1));
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("palpate.toml");
    std::fs::write(&config, "[limits]\nthread_share = 1000.0\n").unwrap();
    let journals = folder.path().join("journals");
    let start = || {
        let arguments =
            ["--log", "error", "--config", config.to_str().unwrap(), "--journal", journals.to_str().unwrap()];
        Arc::new(TestServer::start(&arguments))
    };
    let mut server = start();
    let mut ids = Vec::new();
    for _ in 0..count {
        ids.push(server.paper(false).await);
    }
    let mut again_s = Vec::new();
    for kill in 1..=kills {
        let told = Arc::new(Mutex::new(BTreeMap::new()));
        let begun = Instant::now();
        let clients: Vec<_> =
            ids.iter().map(|id| tokio::spawn(press(server.clone(), id.clone(), told.clone()))).collect();
        // A client has received a report before a kill, whatever the load of the machine.
        let all = format!("kill {kill}: all sessions have a report");
        until(&all, async || told.lock().unwrap().len() == ids.len()).await;
        let mut sessions = server.sessions().await;
        for _ in 0..2 {
            tokio::time::sleep(Duration::from_millis(random.below(400))).await;
            let which = usize::try_from(random.below(count)).unwrap();
            let damping_n_s_per_m = Some(0.3 + 0.01 * f64::from(u32::try_from(random.below(20)).unwrap()));
            let change =
                pb::UpdateTissueRequest { session_id: ids[which].clone(), damping_n_s_per_m, ..Default::default() };
            sessions.update_tissue(change).await.unwrap();
        }
        tokio::time::sleep(Duration::from_millis(random.below(400))).await;
        let pid = rustix::process::Pid::from_child(&server.child);
        rustix::process::kill_process(pid, rustix::process::Signal::KILL).unwrap();
        for client in clients {
            again_s.push(client.await.unwrap().map_or(f64::INFINITY, |first| (first - begun).as_secs_f64()));
        }
        let told = told.lock().unwrap().clone();
        server = start();
        let runs = |id: &str| {
            let listed = file::list(&journals).unwrap();
            listed.into_iter().filter(|file| file.session_id == id).collect::<Vec<_>>()
        };
        for id in &ids {
            let mut session = server.status(id).await;
            // The journal of this run begins a little after the session continues.
            until(&format!("kill {kill}: {id} has a journal again"), async || {
                session = server.status(id).await;
                session.journal.as_ref().unwrap().durable_step.is_some()
            })
            .await;
            assert!(session.step >= told[id].durable_step, "kill {kill}: {} < {:?}", session.step, told[id]);
            let files = runs(id);
            let [before, after] = &files[files.len() - 2..] else { panic!("{files:?}") };
            // Commands of one lease, from the first on: each once, and none left out.
            let sequences = sequences(&before.path);
            assert!(sequences.iter().zip(1..).all(|(one, wanted)| *one == wanted), "kill {kill}: {sequences:?}");
            assert!(
                sequences.len() as u64 >= told[id].durable_sequence,
                "kill {kill}: {} {:?}",
                sequences.len(),
                told[id]
            );
            goes_on(before, after);
        }
        // No more than the newest two are compared: room for many kills.
        for id in &ids {
            let files = runs(id);
            files[..files.len() - 1].iter().for_each(|file| std::fs::remove_file(&file.path).unwrap());
        }
    }
    again_s.sort_by(f64::total_cmp);
    println!(
        "{kills} kills, {count} sessions: clients touch again after {:.3} s (median), {:.3} s (worst)",
        again_s[again_s.len() / 2],
        again_s[again_s.len() - 1]
    );
}
