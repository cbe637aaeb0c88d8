//! Evenness of the distribution of sessions over a fleet.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use palpate_proto::pb;
use pb::create_session_request::Source;
use serde_json::json;

use crate::cores::resident;
use crate::etcd::EtcdMembers;
use crate::fleet::Node;
use crate::generous;
use crate::report::chart::Panel;
use crate::report::{BenchReport, cells, digits, quick};

/// Clients that create sessions at once, as many at each server.
const AT_ONCE: usize = 6;

/// Sessions at rest, created through three servers.
pub fn measure(report: &mut BenchReport) -> Option<Panel> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    runtime.block_on(measured(report));
    None
}

async fn measured(report: &mut BenchReport) {
    let count: usize = if quick() { 60 } else { 10_000 };
    let folder = tempfile::tempdir().unwrap();
    let config = generous(folder.path());
    let etcd = EtcdMembers::start(1);
    let more = ["--log", "error", "--config", config.to_str().unwrap()];
    let nodes: Vec<Node> =
        (0..3).map(|at| Node::start(folder.path(), &format!("n{at}"), &etcd.endpoints(), &more)).collect();
    nodes[0].until_nodes(3).await;
    let process = |node: &Node| node.there().child.id();
    let before: Vec<u64> = nodes.iter().map(|node| resident(process(node))).collect();
    let made = Arc::new(AtomicUsize::new(0));
    let begun = Instant::now();
    let mut creating = tokio::task::JoinSet::new();
    for index in 0..AT_ONCE {
        let (mut sessions, made) = (nodes[index % 3].there().sessions().await, made.clone());
        creating.spawn(async move {
            while made.fetch_add(1, Ordering::Relaxed) < count {
                let source = Some(Source::SceneName("paper".into()));
                let request = pb::CreateSessionRequest { source, ..Default::default() };
                sessions.create_session(request).await.unwrap();
            }
        });
    }
    while let Some(ended) = creating.join_next().await {
        ended.unwrap();
        eprintln!("{} of {count} sessions", made.load(Ordering::Relaxed).min(count));
    }
    let took_s = begun.elapsed().as_secs_f64();
    report.heading("Placement of sessions");
    report.say(&format!(
        "{AT_ONCE} clients, two at each of three servers, create {count} sessions that nobody touches: {} a second.",
        digits(count as f64 / took_s)
    ));
    let (mut rows, mut most) = (Vec::new(), 0.0_f64);
    let even = count as f64 / nodes.len() as f64;
    let mut has = Vec::new();
    for (node, before) in nodes.iter().zip(before) {
        let sessions = node.served().await.unwrap().len();
        let off_percent = 100.0 * (sessions as f64 / even - 1.0);
        most = most.max(off_percent.abs());
        has.push(sessions);
        let kib = resident(process(node)).saturating_sub(before) as f64 / 1024.0 / sessions.max(1) as f64;
        rows.push(cells([node.name.clone(), sessions.to_string(), format!("{off_percent:+.1} %"), digits(kib)]));
    }
    assert_eq!(has.iter().sum::<usize>(), count, "none is lost");
    report.table(&cells(["server", "sessions", "deviation from equal", "memory for each, KiB"]), &rows);
    report.say(&format!("The largest deviation from equal shares is {most:.1} %."));
    report
        .figure("spread", json!({ "sessions": has, "off_even_percent": most, "created_per_s": count as f64 / took_s }));
}
