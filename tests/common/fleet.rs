//! Servers of a fleet, each a process of its own, and what must hold for the journals of their sessions.
#![allow(
    dead_code,
    unreachable_pub,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::disallowed_methods
)]

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::time::Duration;

use palpate_proto::pb;
use palpate_session::journal::{JournalReader, file, replay};
use palpate_tissue::limits::Limits;
use pb::admin_service_client::AdminServiceClient;
use rustix::process::{Pid, Signal, kill_process};
use tonic::Status;

use super::server::{TestServer, until};

/// Fleets at a time: each has several processes, and some have clients at 1 kHz. Most of them wait for most of their time.
pub static FLEETS: tokio::sync::Semaphore = tokio::sync::Semaphore::const_new(3);

/// A port that is free now.
pub fn port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// A server of a fleet, which may be gone.
pub struct Node {
    pub name: String,
    pub url: String,
    pub journals: PathBuf,
    arguments: Vec<String>,
    pub server: Option<TestServer>,
}

impl Node {
    /// Starts it at `etcd`, with further arguments.
    pub fn start(folder: &Path, name: &str, etcd: &[String], more: &[&str]) -> Self {
        let url = format!("http://127.0.0.1:{}", port());
        let journals = folder.join(name);
        let journal = journals.display().to_string();
        let own = [
            "--cluster",
            &etcd.join(","),
            "--advertise",
            &url,
            "--node",
            name,
            "--journal",
            &journal,
            "--threads",
            "1",
        ];
        let arguments = own.iter().chain(more).map(|&word| word.to_owned()).collect();
        let mut node = Node { name: name.to_owned(), url, journals, arguments, server: None };
        node.begin();
        node
    }

    /// Starts it, or starts it again.
    pub fn begin(&mut self) {
        let listen = self.url.trim_start_matches("http://").to_owned();
        let arguments: Vec<&str> = self.arguments.iter().map(String::as_str).collect();
        self.server = Some(TestServer::start_at(&listen, &arguments));
    }

    pub fn there(&self) -> &TestServer {
        self.server.as_ref().unwrap()
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.there().child), signal).unwrap();
    }

    /// `kill -9`.
    pub fn kill(&mut self) {
        self.signal(Signal::KILL);
        self.server = None;
    }

    /// Ends it as a user does, and waits until it has.
    pub fn end(&mut self) {
        self.signal(Signal::TERM);
        if let Some(server) = &mut self.server {
            server.child.wait().unwrap();
        }
        self.server = None;
    }

    pub fn freeze(&self) {
        self.signal(Signal::STOP);
    }

    pub fn thaw(&self) {
        self.signal(Signal::CONT);
    }

    pub async fn admin(&self) -> AdminServiceClient<tonic::transport::Channel> {
        AdminServiceClient::new(self.there().channel().await)
    }

    /// The session, if this server serves it.
    pub async fn session(&self, id: &str) -> Result<pb::Session, Status> {
        let request = pb::GetSessionRequest { session_id: id.to_owned() };
        let asked = async { self.there().sessions().await.get_session(request).await };
        let answer = tokio::time::timeout(Duration::from_secs(2), asked).await;
        let answer = answer.map_err(|_| Status::deadline_exceeded("no answer"))??;
        Ok(answer.into_inner().session.unwrap())
    }

    /// Returns the sessions of the fleet from etcd, by ID; none if this server does not answer.
    pub async fn fleet_sessions(&self) -> BTreeMap<String, pb::FleetSession> {
        let mut found = BTreeMap::new();
        let mut admin = self.admin().await;
        let Ok(listed) = admin.list_fleet_sessions(pb::ListFleetSessionsRequest {}).await else { return found };
        let mut listed = listed.into_inner();
        while let Ok(Some(part)) = listed.message().await {
            found.extend(part.sessions.into_iter().map(|session| (session.session_id.clone(), session)));
        }
        found
    }

    /// The IDs of the sessions that this server serves; nothing if it does not answer.
    pub async fn served(&self) -> Option<Vec<String>> {
        let asked = async { self.there().sessions().await.list_sessions(pb::ListSessionsRequest {}).await };
        let answer = tokio::time::timeout(Duration::from_secs(2), asked).await.ok()?.ok()?.into_inner();
        Some(answer.sessions.into_iter().map(|session| session.session_id).collect())
    }

    /// The journals of a session that are here, by ascending run.
    pub fn runs(&self, id: &str) -> Vec<file::JournalFile> {
        file::list(&self.journals).unwrap().into_iter().filter(|file| file.session_id == id).collect()
    }

    /// Waits until the fleet has so many servers.
    pub async fn until_nodes(&self, count: usize) {
        until("the fleet is whole", async || {
            let listed = self.admin().await.list_nodes(pb::ListNodesRequest {}).await;
            let nodes = listed.map(|listed| listed.into_inner().nodes).unwrap_or_default();
            nodes.len() == count && nodes.iter().all(|node| !node.draining)
        })
        .await;
    }
}

/// Three servers, each of which says of a step that it is durable when it is on two disks.
pub async fn three(folder: &Path, etcd: &[String]) -> Vec<Node> {
    let nodes: Vec<Node> =
        (0..3).map(|at| Node::start(folder, &format!("n{at}"), etcd, &["--durable", "two", "--log", "warn"])).collect();
    nodes[0].until_nodes(3).await;
    nodes
}

/// A session of the paper's scene, wherever the fleet makes it.
pub async fn create(node: &Node) -> pb::Session {
    let source = pb::create_session_request::Source::SceneName("paper".into());
    node.there().create(source, false).await.unwrap()
}

/// Which of the servers serves a session.
pub async fn owner(nodes: &[Node], id: &str) -> Option<usize> {
    for (at, node) in nodes.iter().enumerate() {
        if node.server.is_some() && node.session(id).await.is_ok() {
            return Some(at);
        }
    }
    None
}

/// Waits until a server serves a session, whose standby has all of it. Tells which, and the session.
pub async fn until_stood_by(nodes: &[Node], id: &str) -> (usize, pb::Session) {
    let mut found = None;
    until("a session has a standby", async || {
        let Some(at) = owner(nodes, id).await else { return false };
        let Ok(session) = nodes[at].session(id).await else { return false };
        let is_stood_by = !session.ownership.as_ref().unwrap().standby.is_empty();
        found = Some((at, session));
        is_stood_by
    })
    .await;
    found.unwrap()
}

/// The bits with which the run of a session at `after` begins are those of an offline run of the journal before it,
/// wherever that is.
pub async fn goes_on(nodes: &[Node], id: &str, after: &Node, lets_go: bool) {
    // It is written a little after the session continues.
    let mut begun = None;
    until("the journal has begun", async || {
        let session = after.session(id).await.ok();
        let run = session.and_then(|session| session.journal).map_or(0, |journal| u64::from(journal.run));
        let path = after.journals.join(file::name(id, run));
        let batch = JournalReader::open(&path).ok().and_then(|mut reader| reader.next_batch().ok().flatten());
        let first = batch.and_then(|batch| batch.snapshots().ok()?.into_iter().next());
        begun = first.map(|first| (run, first));
        begun.is_some()
    })
    .await;
    let (run, first) = begun.unwrap();
    let before = || nodes.iter().flat_map(|node| node.runs(id)).filter(|file| file.run == run - 1);
    // A server that died may have more on its own disk than the one that has taken over got.
    let fits = |path: &std::path::Path| {
        let mut survey = JournalReader::open(path).unwrap();
        let end = survey.survey(&mut |_| {}).unwrap().until_step;
        if end < first.step {
            return false;
        }
        let (mut session, _) =
            replay::session_at(JournalReader::open(path).unwrap(), &Limits::default(), first.step, &false.into())
                .unwrap();
        if lets_go {
            session.let_go();
        }
        first.hash == format!("{:032x}", session.tissue().state_hash())
    };
    // The last of it is written a little later, too.
    until(&format!("{id} goes on from its run {} at step {}", run - 1, first.step), async || {
        before().any(|file| fits(&file.path))
    })
    .await;
}

/// All hashes and snapshots of a journal are those of an offline run of its inputs. Tells how many were compared.
pub fn verify(path: &Path) -> u64 {
    let verdict = replay::verify(JournalReader::open(path).unwrap(), &Limits::default(), &mut |_, _| {}).unwrap();
    assert_eq!(verdict.difference, None, "{}", path.display());
    verdict.compared.iter().sum()
}
