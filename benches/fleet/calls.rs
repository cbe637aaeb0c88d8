//! Calls to a fleet beside the same calls to one server.

use std::time::Instant;

use palpate_proto::pb;
use pb::create_session_request::Source;
use pb::session_service_client::SessionServiceClient;
use serde_json::json;
use tonic::transport::Channel;

use crate::etcd::EtcdMembers;
use crate::fleet::Node;
use crate::report::chart::Panel;
use crate::report::{BenchReport, cells, digits, quick};
use crate::server::TestServer;
use crate::{FleetTimes, generous};

type SessionClients = SessionServiceClient<Channel>;

async fn create(sessions: &mut SessionClients) -> pb::Session {
    let request = pb::CreateSessionRequest { source: Some(Source::SceneName("paper".into())), ..Default::default() };
    sessions.create_session(request).await.unwrap().into_inner().session.unwrap()
}

async fn get(sessions: &mut SessionClients, session_id: &str) {
    let request = pb::GetSessionRequest { session_id: session_id.to_owned() };
    sessions.get_session(request).await.unwrap();
}

async fn delete(sessions: &mut SessionClients, session_id: String) {
    sessions.delete_session(pb::DeleteSessionRequest { session_id }).await.unwrap();
}

/// The time of a call, ms.
async fn timed<T>(times: &mut FleetTimes, call: impl Future<Output = T>) -> T {
    let begun = Instant::now();
    let answer = call.await;
    times.0.push(1e3 * begun.elapsed().as_secs_f64());
    answer
}

/// Each call through three servers in turn, and in between to one without a fleet.
pub fn measure(report: &mut BenchReport) -> Option<Panel> {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    runtime.block_on(measured(report));
    None
}

async fn measured(report: &mut BenchReport) {
    let rounds = if quick() { 30 } else { 2000 };
    let folder = tempfile::tempdir().unwrap();
    let config = generous(folder.path());
    let more = ["--log", "error", "--config", config.to_str().unwrap()];
    let etcd = EtcdMembers::start(1);
    let alone = folder.path().join("alone");
    let alone = TestServer::start(&[&["--threads", "1", "--journal", alone.to_str().unwrap()], &more[..]].concat());
    let nodes: Vec<Node> =
        (0..3).map(|at| Node::start(folder.path(), &format!("n{at}"), &etcd.endpoints(), &more)).collect();
    nodes[0].until_nodes(3).await;
    let mut plain = alone.sessions().await;
    let mut doors = Vec::new();
    for node in &nodes {
        doors.push(node.there().sessions().await);
    }
    let owner = |session: &pb::Session| {
        let endpoint = &session.ownership.as_ref().unwrap().endpoint;
        nodes.iter().position(|node| node.url == *endpoint).unwrap()
    };
    let mut times: [FleetTimes; 5] = Default::default();
    let [create_alone, create_here, get_alone, get_here, locate] = &mut times;
    for round in 0..rounds {
        if round % 500 == 0 {
            eprintln!("call {round} of {rounds}");
        }
        let session = timed(create_alone, create(&mut plain)).await;
        timed(get_alone, get(&mut plain, &session.session_id)).await;
        delete(&mut plain, session.session_id).await;
        let session = timed(create_here, create(&mut doors[round % 3])).await;
        let at = owner(&session);
        timed(get_here, get(&mut doors[at], &session.session_id)).await;
        let request = pb::LocateSessionRequest { session_id: session.session_id.clone() };
        timed(locate, doors[(round + 1) % 3].locate_session(request)).await.unwrap();
        delete(&mut doors[at], session.session_id).await;
    }
    report.heading("Calls");
    report.say(&format!(
        "{rounds} calls of each kind, to three servers in turn, and in between to one server without a fleet that also keeps \
         journals. A server with less room forwards a creation to one with more. `LocateSession` asks etcd; the table \
         compares it with `GetSession` of the server without a fleet."
    ));
    let header = cells([
        "call",
        "one server: p50, ms",
        "p99, ms",
        "fleet: p50, ms",
        "p99, ms",
        "p50 × one server",
        "p99 × one server",
    ]);
    let mut rows = Vec::new();
    for (name, [alone, here]) in [
        ("CreateSession", [&times[0], &times[1]]),
        ("GetSession", [&times[2], &times[3]]),
        ("LocateSession", [&times[2], &times[4]]),
    ] {
        let of = |times: &FleetTimes| [0.5, 0.99].map(|quantile| times.quantile(quantile));
        let (alone, here) = (of(alone), of(here));
        let row = [alone[0], alone[1], here[0], here[1], here[0] / alone[0], here[1] / alone[1]];
        rows.push([vec![name.to_owned()], row.map(digits).to_vec()].concat());
        report.figure(&format!("{name}_ms"), json!({ "one_server": alone, "fleet": here }));
    }
    report.table(&header, &rows);
}
