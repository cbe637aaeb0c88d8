//! Sessions at rest: the total cost to a server of a thousand sessions (REST_SESSIONS) that are untouched, and of
//! sessions at rest again after a poke. Memory is the resident memory of the process beyond its initial size; time is
//! that of all its threads, over 10 s (REST_S). Linux only: both are read from /proc.

#![allow(clippy::unwrap_used, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]

#[path = "../tests/common/server.rs"]
mod server;

use std::time::{Duration, Instant};

use palpate_proto::pb;
use pb::create_session_request::Source;
use pb::haptic_service_client::HapticServiceClient;
use pb::session_service_client::SessionServiceClient;
use server::{TestServer, force};
use tonic::transport::Channel;

/// Limit for all sessions together, per cent of one core.
const MAX_PERCENT: f64 = 1.0;

/// Limit for one session of 31 × 31 points.
const MAX_KIB: f64 = 128.0;

/// Sessions poked at a time: fewer than a core can step.
const BATCH: usize = 50;

fn environment(name: &str, otherwise: f64) -> f64 {
    std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(otherwise)
}

/// Resident memory, KiB.
fn memory_kib(server: &TestServer) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{}/status", server.child.id())).unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

/// Processor time of all threads so far, s. Linux counts it in ticks of 10 ms.
fn cpu_s(server: &TestServer) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{}/stat", server.child.id())).unwrap();
    let after_name = &stat[stat.rfind(')').unwrap() + 2..];
    let ticks = after_name.split_whitespace().skip(11).take(2).map(|field| field.parse::<f64>().unwrap());
    ticks.sum::<f64>() / 100.0
}

/// Per cent of a core, over some seconds without requests.
fn share_percent(server: &TestServer) -> f64 {
    let (begun, before_s) = (Instant::now(), cpu_s(server));
    std::thread::sleep(Duration::from_secs_f64(environment("REST_S", 10.0)));
    100.0 * (cpu_s(server) - before_s) / begun.elapsed().as_secs_f64()
}

async fn create(sessions: &mut SessionServiceClient<Channel>) -> String {
    let source = Some(Source::SceneName("paper".into()));
    let request = pb::CreateSessionRequest { source, ..Default::default() };
    sessions.create_session(request).await.unwrap().into_inner().session.unwrap().session_id
}

async fn is_resting(sessions: &mut SessionServiceClient<Channel>, session_id: &str) -> bool {
    let request = pb::GetSessionRequest { session_id: session_id.to_owned() };
    sessions.get_session(request).await.unwrap().into_inner().session.unwrap().resting
}

/// Pushes with 1 N for a tenth of a second, then releases the tool.
async fn poke(haptics: &mut HapticServiceClient<Channel>, session_id: &str) {
    let acquire = pb::AcquireToolRequest { session_id: session_id.to_owned(), ..Default::default() };
    let lease_id = haptics.acquire_tool(acquire).await.unwrap().into_inner().lease_id;
    let command = pb::Command { time_to_live_s: Some(0.1), ..force(0, 1, -1.0) };
    let request = pb::SendCommandsRequest { session_id: session_id.to_owned(), lease_id, commands: vec![command] };
    haptics.send_commands(request).await.unwrap();
}

/// Returns whether all sessions come to rest within a minute.
async fn settle(sessions: &mut SessionServiceClient<Channel>, ids: &[String]) -> bool {
    let begun = Instant::now();
    for id in ids {
        while !is_resting(sessions, id).await {
            if begun.elapsed() > Duration::from_secs(60) {
                return false;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }
    true
}

fn main() {
    if !std::path::Path::new("/proc/self/stat").exists() {
        return println!("left out: there is no /proc on this system");
    }
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let count = environment("REST_SESSIONS", 1000.0) as usize;
    let server = TestServer::start(&["--log", "warn"]);
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
    let channel = runtime.block_on(server.channel());
    let (mut sessions, mut haptics) = (SessionServiceClient::new(channel.clone()), HapticServiceClient::new(channel));
    // The cost that the first session adds once belongs to the server.
    runtime.block_on(create(&mut sessions));
    let before_kib = memory_kib(&server);
    let mut missed = false;
    let mut report = |what: &str| {
        let (each_kib, percent) = ((memory_kib(&server) - before_kib) / count as f64, share_percent(&server));
        println!("| {what} | {percent:.2} % | {each_kib:.1} KiB |");
        missed |= percent >= MAX_PERCENT || each_kib > MAX_KIB;
    };
    println!("| {count} sessions of 31 × 31 points | of a core, all together | memory of each |\n|---|---|---|");
    let ids: Vec<String> = runtime.block_on(async {
        let mut ids = Vec::new();
        for _ in 0..count {
            ids.push(create(&mut sessions).await);
        }
        assert!(settle(&mut sessions, &ids).await, "untouched sessions do not rest");
        ids
    });
    report("never touched");
    let settled = runtime.block_on(async {
        for batch in ids.chunks(BATCH) {
            for id in batch {
                poke(&mut haptics, id).await;
            }
            // The tools are released when their leases expire, if not before.
            if !settle(&mut sessions, batch).await {
                return false;
            }
        }
        true
    });
    if settled {
        report("at rest after a poke");
    } else {
        println!("\npoked sessions do not come to rest");
        missed = true;
    }
    if missed {
        println!("\nabove the bounds of {MAX_PERCENT} % and {MAX_KIB} KiB");
        // Stops the server; an exit would not run the destructor.
        drop(server);
        std::process::exit(1);
    }
}
