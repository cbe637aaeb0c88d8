//! Capacity of one etcd for a fleet: transactions on sessions, keys, leases, and nodes that follow each other.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use palpate_cluster::etcd::{Etcd as Client, EtcdOptions, Op, Txn};
use palpate_cluster::key::{Keys, NodeValue, encode};
use palpate_cluster::rules;
use serde_json::json;

use crate::FleetTimes;
use crate::cores::{processor_s, resident};
use crate::etcd::EtcdMembers;
use crate::report::chart::{Look, Panel, Series};
use crate::report::{BenchReport, cells, digits, quick};

/// Transactions at once, as of some nodes that all take over.
const AT_ONCE: usize = 64;

/// The nodes that these are of.
const CLIENTS: usize = 8;

/// The bytes of the database that are in use.
const IN_USE: &str = "etcd_mvcc_db_total_size_in_use_in_bytes";

/// Longer than a server's: none may end while others are made.
const TTL_S: u64 = 600;

/// Time limit of an attempt: a list of all sessions takes its time.
const LIMIT: Duration = Duration::from_secs(30);

fn client(etcd: &EtcdMembers) -> Client {
    let options = EtcdOptions { endpoints: etcd.endpoints(), ..Default::default() };
    Client::open_within(&options, LIMIT).unwrap()
}

fn node(index: usize, load: f64) -> Vec<u8> {
    encode(&NodeValue {
        endpoint: format!("https://tissue-{index:04}.example:7117"),
        instance: format!("{index:032x}"),
        version: "0.1.0".to_owned(),
        replays: 1,
        threads: 8,
        load,
        sessions: 100,
        draining: false,
    })
}

/// Processor time of etcd, s.
fn etcd_s(etcd: &EtcdMembers) -> f64 {
    etcd.process(0).map_or(0.0, processor_s)
}

/// Transactions for each of `count` sessions, [`AT_ONCE`] at a time: the rate, their times in ms, and etcd's cores.
async fn transact(
    etcd: &EtcdMembers,
    count: usize,
    make: impl Fn(usize) -> Txn + Send + Sync + 'static,
) -> (Vec<u64>, Rate) {
    let (make, next) = (Arc::new(make), Arc::new(AtomicUsize::new(0)));
    let clients: Vec<Client> = (0..CLIENTS).map(|_| client(etcd)).collect();
    let (begun, before_s) = (Instant::now(), etcd_s(etcd));
    let mut at_work = tokio::task::JoinSet::new();
    for index in 0..AT_ONCE {
        let (client, make, next) = (clients[index % CLIENTS].clone(), make.clone(), next.clone());
        at_work.spawn(async move {
            let mut done = Vec::new();
            loop {
                let session = next.fetch_add(1, Ordering::Relaxed);
                if session >= count {
                    return done;
                }
                let asked = Instant::now();
                let outcome = client.transact(make(session)).await.unwrap();
                assert!(outcome.succeeded, "{session}");
                done.push((session, outcome.revision, 1e3 * asked.elapsed().as_secs_f64()));
            }
        });
    }
    let (mut revisions, mut times) = (vec![0; count], FleetTimes::default());
    for done in at_work.join_all().await {
        for (session, revision, ms) in done {
            revisions[session] = revision;
            times.0.push(ms);
        }
    }
    let elapsed_s = begun.elapsed().as_secs_f64();
    let rate = Rate { per_s: count as f64 / elapsed_s, times, cores: (etcd_s(etcd) - before_s) / elapsed_s };
    (revisions, rate)
}

/// Rate of an operation.
struct Rate {
    per_s: f64,
    /// ms
    times: FleetTimes,
    /// Of etcd.
    cores: f64,
}

impl Rate {
    fn row(&self, what: &str) -> Vec<String> {
        let figures = [
            self.per_s,
            self.times.quantile(0.5),
            self.times.quantile(0.99),
            self.cores,
            1e6 * self.cores / self.per_s,
        ];
        [vec![what.to_owned()], figures.map(digits).to_vec()].concat()
    }
}

/// One etcd, alone.
pub fn measure(report: &mut BenchReport) -> Option<Panel> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    Some(runtime.block_on(measured(report)))
}

async fn measured(report: &mut BenchReport) -> Panel {
    let (sessions, nodes) = if quick() { (500, 20) } else { (100_000, 1000) };
    // Room for all revisions: nothing is compacted here.
    let etcd = EtcdMembers::start_with(1, crate::etcd::DEFAULT_TIMES, &["--quota-backend-bytes=8589934592"], |_| None);
    let keys = Keys::of("default").unwrap();
    let own = client(&etcd);
    report.heading("The capacity of etcd");
    report.say(&format!(
        "One etcd member with default settings, syncing each write to this machine's disk: {AT_ONCE} calls at once by \
         {CLIENTS} clients."
    ));
    // The nodes that the transactions ask for.
    let lease = own.grant(TTL_S).await.unwrap();
    for index in 0..2 {
        let put = Op::Put { key: keys.node(&format!("n{index}")), value: node(index, 0.5), lease: Some(lease.id) };
        own.transact(Txn { then: vec![put], ..Txn::default() }).await.unwrap();
    }
    let size = |name: &str| etcd.metric(0, name).unwrap_or(f64::NAN);
    let before_bytes = size(IN_USE);
    let id =
        |session: usize| format!("{:032x}", (session as u128).wrapping_mul(0x9e37_79b9_7f4a_7c15_f39c_c060_5ced_c835));
    eprintln!("etcd: {sessions} sessions");
    let of = keys.clone();
    let (revisions, created) = transact(&etcd, sessions, move |at| rules::create(&of, &id(at), "n0")).await;
    let bytes_each = (size(IN_USE) - before_bytes) / sessions as f64;
    let (of, known) = (keys.clone(), revisions);
    let (revisions, kept) = transact(&etcd, sessions, move |at| rules::keep(&of, &id(at), known[at], "n0", "n1")).await;
    let (of, known) = (keys.clone(), revisions);
    let (_, handed) =
        transact(&etcd, sessions, move |at| rules::hand_over(&of, &id(at), known[at], ["n0", "n1"])).await;
    let resident_mib = etcd.process(0).map_or(f64::NAN, |process| resident(process) as f64 / 1_048_576.0);
    eprintln!("etcd: {nodes} leases");
    let kept_alive = keep_alive(&etcd, &keys, nodes).await;
    let header = cells(["", "a second", "p50, ms", "p99, ms", "etcd, cores", "etcd, µs each"]);
    let rows = [
        created.row("a session is created"),
        kept.row("its standby is named"),
        handed.row("it is handed over"),
        kept_alive.row("a lease is kept alive"),
    ];
    report.table(&header, &rows);
    let mut listing = [FleetTimes::default(), FleetTimes::default()];
    for _ in 0..5 {
        for (prefix, times) in [keys.nodes(), keys.sessions()].iter().zip(&mut listing) {
            let begun = Instant::now();
            let listed = own.list(prefix).await.unwrap().0.len();
            times.0.push(1e3 * begun.elapsed().as_secs_f64());
            assert!(listed >= nodes.min(sessions), "{prefix}: {listed}");
        }
    }
    report.say(&format!(
        "A session is one key: {} bytes of the database, so {} MB for 10⁵ sessions, and as much again for each change until \
         etcd compacts. After three changes of {sessions} sessions etcd uses {} MiB of memory. Listing all {nodes} nodes \
         takes {} ms, listing all {sessions} sessions {} ms.",
        digits(bytes_each),
        digits(bytes_each * 0.1),
        digits(resident_mib),
        digits(listing[0].median()),
        digits(listing[1].median()),
    ));
    let followed = follow(&etcd, &keys, if quick() { &[1, 5, 20] } else { &[1, 10, 100, 300, 1000] }).await;
    report.say("A node publishes its load; the table has the time until every watching node has received it:");
    let header =
        cells(["nodes that watch", "time until the last has it: p50, ms", "p99, ms", "etcd, µs for each receiver"]);
    let rows: Vec<_> = followed
        .iter()
        .map(|(count, times, each_us)| {
            [vec![count.to_string()], [times.quantile(0.5), times.quantile(0.99), *each_us].map(digits).to_vec()]
                .concat()
        })
        .collect();
    report.table(&header, &rows);
    report.figure(
        "etcd",
        json!({
            "created_per_s": created.per_s, "kept_per_s": kept.per_s, "handed_over_per_s": handed.per_s,
            "kept_alive_per_s": kept_alive.per_s, "bytes_per_session": bytes_each, "resident_mib": resident_mib,
            "list_nodes_ms": listing[0].median(), "list_sessions_ms": listing[1].median(), "nodes": nodes, "sessions": sessions,
        }),
    );
    let line = |name: &str, hue, quantile: f64| Series {
        name: name.to_owned(),
        hue,
        look: Look::Full,
        points: followed.iter().map(|(count, times, _)| (*count as f64, times.quantile(quantile))).collect(),
    };
    Panel::Lines {
        title: "Time until all nodes know".to_owned(),
        x: "nodes that watch",
        y: "ms after a node has published",
        series: vec![line("p50", 3, 0.5), line("p99", 4, 0.99)],
    }
}

/// Keeps the leases of so many nodes alive for a while, as fast as it goes.
async fn keep_alive(etcd: &EtcdMembers, keys: &Keys, nodes: usize) -> Rate {
    let clients: Vec<Client> = (0..CLIENTS).map(|_| client(etcd)).collect();
    let mut leases = vec![Vec::new(); CLIENTS];
    for index in 0..nodes {
        let client = &clients[index % CLIENTS];
        let lease = client.grant(TTL_S).await.unwrap().id;
        let put = Op::Put { key: keys.node(&format!("node-{index:04}")), value: node(index, 0.5), lease: Some(lease) };
        client.transact(Txn { then: vec![put], ..Txn::default() }).await.unwrap();
        leases[index % CLIENTS].push(lease);
    }
    let over = Instant::now() + Duration::from_secs(if quick() { 1 } else { 10 });
    let (begun, before_s) = (Instant::now(), etcd_s(etcd));
    let mut at_work = tokio::task::JoinSet::new();
    for (client, leases) in clients.into_iter().zip(leases) {
        at_work.spawn(async move {
            let mut times = Vec::new();
            for lease in leases.iter().cycle() {
                let asked = Instant::now();
                if asked > over {
                    break;
                }
                assert!(client.keep_alive(*lease).await.unwrap().is_some());
                times.push(1e3 * asked.elapsed().as_secs_f64());
            }
            times
        });
    }
    let times = FleetTimes(at_work.join_all().await.concat());
    let elapsed_s = begun.elapsed().as_secs_f64();
    Rate { per_s: times.0.len() as f64 / elapsed_s, cores: (etcd_s(etcd) - before_s) / elapsed_s, times }
}

/// Returns the times until the last of this many watches has a node's report, ms, and etcd's time for each watch, µs.
async fn follow(etcd: &EtcdMembers, keys: &Keys, counts: &[usize]) -> Vec<(usize, FleetTimes, f64)> {
    let puts = if quick() { 10 } else { 200 };
    let own = client(etcd);
    let mut followed = Vec::new();
    for count in counts {
        eprintln!("etcd: {count} watches");
        let (_, revision) = own.get(&keys.node("n0")).await.unwrap();
        let (tell, mut told) = tokio::sync::mpsc::unbounded_channel();
        let mut watching = tokio::task::JoinSet::new();
        for _ in 0..*count {
            let (client, prefix, tell) = (client(etcd), keys.nodes(), tell.clone());
            watching.spawn(async move {
                let mut watch = client.watch(&prefix, revision + 1);
                while let Ok(events) = watch.next().await {
                    if events.iter().any(|_| tell.send(()).is_err()) {
                        return;
                    }
                }
            });
        }
        let (mut times, mut before_s) = (FleetTimes::default(), 0.0);
        for index in 0..=puts {
            let asked = Instant::now();
            let put = Op::Put { key: keys.node("n0"), value: node(0, 0.01 * f64::from(index)), lease: None };
            own.transact(Txn { then: vec![put], ..Txn::default() }).await.unwrap();
            for _ in 0..*count {
                told.recv().await.unwrap();
            }
            // The first waits until all watches are open.
            if index == 0 {
                before_s = etcd_s(etcd);
            } else {
                times.0.push(1e3 * asked.elapsed().as_secs_f64());
            }
        }
        let each_us = 1e6 * (etcd_s(etcd) - before_s) / (f64::from(puts) * *count as f64);
        followed.push((*count, times, each_us));
        watching.shutdown().await;
    }
    followed
}
