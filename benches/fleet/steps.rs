//! Cost of the steps of a server in a fleet, which sends its journals to another server, compared with a single
//! server.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use palpate_proto::pb;
use pb::touch_response::Message as Heard;
use serde_json::json;

use crate::cores::{kept_to, processor_s, thread_times};
use crate::etcd::EtcdMembers;
use crate::fleet::Node;
use crate::report::chart::{Look, Panel, Series};
use crate::report::{BenchReport, cells, digits, quick};
use crate::server::{TestServer, TestTouch, force, open, until};
use crate::{FleetTimes, generous};

/// What is compared: a name, and whether it is of a fleet, and with what else.
const WAYS: [(&str, Option<&[&str]>); 3] = [
    ("one server, with journals", None),
    ("fleet, one stands by", Some(&[])),
    ("fleet, durable on two", Some(&["--durable", "two"])),
];

/// One run of one way.
struct WayRun {
    /// Time of stepping threads for a step, and of all threads, µs.
    step_us: f64,
    all_us: f64,
    /// Of round trips, ms.
    p50_ms: f64,
    p99_ms: f64,
    /// Cores that the standby and etcd use.
    standby_cores: f64,
    etcd_cores: f64,
}

/// The steps under touch: each way several times, in turn.
pub fn measure(report: &mut BenchReport) -> Option<Panel> {
    let (clients, seconds, rounds) = if quick() { (2, 2.0, 1) } else { (20, 10.0, 7) };
    let mut runs: [Vec<WayRun>; 3] = Default::default();
    for round in 1..=rounds {
        for (way, runs) in WAYS.iter().zip(&mut runs) {
            eprintln!("steps, {}: {round} of {rounds}", way.0);
            runs.push(run(way.1, clients, seconds));
        }
    }
    report.heading("Steps");
    report.say(&format!(
        "{clients} haptic clients, each at 1 kHz in its own session, at one server (one stepping thread) that is limited to \
         one core; the clients, etcd and the stand-by server use the other cores. Medians of {rounds} runs of {seconds} s, \
         with the three setups in turn."
    ));
    let median = |runs: &[WayRun], of: fn(&WayRun) -> f64| FleetTimes(runs.iter().map(of).collect()).median();
    let header = cells([
        "",
        "stepping, µs a step",
        "× one server",
        "all threads, µs a step",
        "round trip p50, ms",
        "p99, ms",
        "p99 × one server",
        "stand-by server, cores",
        "etcd, cores",
    ]);
    let (mut rows, mut series) = (Vec::new(), Vec::new());
    let alone = [median(&runs[0], |run| run.step_us), median(&runs[0], |run| run.p99_ms)];
    for (hue, ((name, _), runs)) in WAYS.iter().zip(&runs).enumerate() {
        let (step_us, p99_ms) = (median(runs, |run| run.step_us), median(runs, |run| run.p99_ms));
        let figures = [
            step_us,
            step_us / alone[0],
            median(runs, |run| run.all_us),
            median(runs, |run| run.p50_ms),
            p99_ms,
            p99_ms / alone[1],
            median(runs, |run| run.standby_cores),
            median(runs, |run| run.etcd_cores),
        ];
        rows.push([vec![(*name).to_owned()], figures.map(digits).to_vec()].concat());
        report.figure(&format!("steps_{hue}"), json!({ "way": name, "step_us": step_us, "p99_ms": p99_ms }));
        let points = runs.iter().enumerate().map(|(at, run)| (at as f64 + 1.0, run.step_us)).collect();
        series.push(Series { name: (*name).to_owned(), hue, look: Look::Full, points });
    }
    report.table(&header, &rows);
    let most = series.iter().flat_map(|line| line.points.iter().map(|at| at.1)).fold(0.0, f64::max);
    let (title, x, y) = ("Cost of a step".to_owned(), "run", "µs of a stepping thread");
    Some(Panel::Curves { title, x, y, up: 0.0..1.2 * most, series })
}

fn run(fleet: Option<&[&str]>, clients: usize, seconds: f64) -> WayRun {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    // The threads of the runtime have been started outside the server's core.
    kept_to(false, || runtime.block_on(ran(fleet, clients, seconds)))
}

async fn ran(fleet: Option<&[&str]>, clients: usize, seconds: f64) -> WayRun {
    let folder = tempfile::tempdir().unwrap();
    let config = generous(folder.path());
    let common = ["--log", "error", "--config", config.to_str().unwrap()];
    let Some(more) = fleet else {
        let journals = folder.path().join("alone");
        let own = ["--threads", "1", "--journal", journals.to_str().unwrap()];
        let server = kept_to(true, || TestServer::start(&[&own[..], &common].concat()));
        let mut ids = Vec::new();
        for _ in 0..clients {
            ids.push(server.paper(false).await);
        }
        return measured(&server, &ids, seconds, [None, None]).await;
    };
    let etcd = EtcdMembers::start(1);
    let more = [&common[..], more].concat();
    let there = kept_to(true, || Node::start(folder.path(), "n0", &etcd.endpoints(), &more));
    let standby = Node::start(folder.path(), "n1", &etcd.endpoints(), &more);
    there.until_nodes(2).await;
    let mut ids = Vec::new();
    for _ in 0..clients {
        let session = crate::fleet::create(&there).await;
        if session.ownership.unwrap().node == "n1" {
            let request = pb::MoveSessionRequest { session_id: session.session_id.clone(), node: "n0".into() };
            standby.admin().await.move_session(request).await.unwrap();
        }
        ids.push(session.session_id);
    }
    until("all are stood by", async || {
        let told = there.fleet_sessions().await;
        told.values()
            .all(|session| session.ownership.as_ref().is_some_and(|own| own.node == "n0" && own.standby == "n1"))
    })
    .await;
    measured(there.there(), &ids, seconds, [Some(standby.there().child.id()), etcd.process(0)]).await
}

/// Measures a server with a client in each of its sessions, and what two other processes take.
async fn measured(server: &TestServer, ids: &[String], seconds: f64, others: [Option<u32>; 2]) -> WayRun {
    let over = Arc::new(AtomicBool::new(false));
    let begins = Arc::new(AtomicBool::new(false));
    let mut presses = Vec::new();
    for id in ids {
        let touch =
            TestTouch::open(server, pb::TouchOpen { sample_every_steps: Some(1), ..open(id, &[0]) }).await.unwrap();
        presses.push(tokio::spawn(press(touch, begins.clone(), over.clone())));
    }
    // All are under way.
    tokio::time::sleep(Duration::from_secs(1)).await;
    begins.store(true, Ordering::Relaxed);
    let process = server.child.id();
    let cores = || others.map(|other| other.map_or(0.0, processor_s));
    let (begun, times, others_s, steps) = (Instant::now(), thread_times(process), cores(), steps(server, ids).await);
    tokio::time::sleep(Duration::from_secs_f64(seconds)).await;
    let (elapsed_s, after, others_after_s) = (begun.elapsed().as_secs_f64(), thread_times(process), cores());
    let done = (self::steps(server, ids).await - steps) as f64;
    over.store(true, Ordering::Relaxed);
    let mut round_trips = FleetTimes::default();
    for press in presses {
        round_trips.0.extend(press.await.unwrap().0);
    }
    let of = |times: &[(String, [f64; 2])], name: &str| {
        let threads = times.iter().filter(|thread| name.is_empty() || thread.0 == name);
        threads.map(|thread| thread.1[0] + thread.1[1]).sum::<f64>()
    };
    let each_us = |name: &str| 1e6 * (of(&after, name) - of(&times, name)) / done;
    let [standby_cores, etcd_cores] = [0, 1].map(|at| (others_after_s[at] - others_s[at]) / elapsed_s);
    WayRun {
        step_us: each_us("step"),
        all_us: each_us(""),
        p50_ms: round_trips.quantile(0.5),
        p99_ms: round_trips.quantile(0.99),
        standby_cores,
        etcd_cores,
    }
}

/// Steps that were done, of all sessions.
async fn steps(server: &TestServer, ids: &[String]) -> u64 {
    let mut sum = 0;
    for id in ids {
        let session = server.status(id).await;
        sum += session.step - session.rested_steps;
    }
    sum
}

/// A command each millisecond, until it is over. The times until they were acknowledged, ms.
async fn press(mut touch: TestTouch, begins: Arc<AtomicBool>, over: Arc<AtomicBool>) -> FleetTimes {
    let mut ticks = tokio::time::interval(Duration::from_millis(1));
    ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    let (mut sequence, mut waiting, mut times) = (0, VecDeque::new(), FleetTimes::default());
    while !over.load(Ordering::Relaxed) {
        tokio::select! {
            biased;
            heard = touch.hear() => {
                let Some(Heard::Sample(sample)) = heard.unwrap() else { continue };
                let newest = sample.tools.first().map_or(0, |tool| tool.acknowledged_sequence);
                while let Some((number, sent)) = waiting.front().copied().filter(|(number, _): &(u64, Instant)| *number <= newest) {
                    waiting.pop_front();
                    if begins.load(Ordering::Relaxed) && number > 0 {
                        times.0.push(1e3 * sent.elapsed().as_secs_f64());
                    }
                }
            }
            _ = ticks.tick() => {
                sequence += 1;
                waiting.push_back((sequence, Instant::now()));
                // Never the same force twice: the tissue does not fall asleep.
                let z_n = -0.1 - 0.02 * (0.003 * sequence as f64).sin();
                touch.command(force(0, sequence, z_n)).await;
            }
        }
    }
    times
}
