//! Etcd and servers of a fleet, each a process of its own.
#![allow(
    dead_code,
    unreachable_pub,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::disallowed_methods
)]

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use palpate_proto::pb;
use pb::admin_service_client::AdminServiceClient;
use rustix::process::{Pid, Signal, kill_process};
use tonic::Status;

use crate::server::{PATIENCE, Server};

/// A port that is free now.
pub fn port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

/// Whether etcd is on this machine. Where CI says that it must be, its absence is an error.
pub fn is_there() -> bool {
    let found = Command::new("etcd").arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok();
    if !found {
        assert!(std::env::var_os("CI").is_none(), "etcd is missing (Debian: apt-get install etcd-server)");
        eprintln!("left out: etcd is missing (Debian: apt-get install etcd-server)");
    }
    found
}

/// Members of etcd.
pub struct Etcd {
    arguments: Vec<Vec<String>>,
    members: Vec<Option<Child>>,
    pub urls: Vec<String>,
    log: PathBuf,
}

impl Etcd {
    pub fn start(folder: &Path, count: usize) -> Self {
        let ports: Vec<(u16, u16)> = (0..count).map(|_| (port(), port())).collect();
        let peer = |at: usize| format!("http://127.0.0.1:{}", ports[at].1);
        let cluster: Vec<String> = (0..count).map(|at| format!("m{at}={}", peer(at))).collect();
        let of = |at: usize| {
            let client = format!("http://127.0.0.1:{}", ports[at].0);
            let data = folder.join(format!("etcd-{at}")).display().to_string();
            let options = [
                ("name", format!("m{at}")),
                ("data-dir", data),
                ("listen-client-urls", client.clone()),
                ("advertise-client-urls", client),
                ("listen-peer-urls", peer(at)),
                ("initial-advertise-peer-urls", peer(at)),
                ("initial-cluster", cluster.join(",")),
                ("log-level", "error".to_owned()),
            ];
            options.iter().flat_map(|(name, value)| [format!("--{name}"), value.clone()]).collect()
        };
        let urls = ports.iter().map(|(client, _)| format!("http://127.0.0.1:{client}")).collect();
        let mut etcd = Etcd {
            arguments: (0..count).map(of).collect(),
            members: (0..count).map(|_| None).collect(),
            urls,
            log: folder.join("etcd.log"),
        };
        etcd.start_all();
        etcd
    }

    pub fn start_all(&mut self) {
        for at in 0..self.members.len() {
            self.restart(at);
        }
    }

    pub fn restart(&mut self, at: usize) {
        let log = std::fs::File::options().create(true).append(true).open(&self.log).unwrap();
        let child = Command::new("etcd").args(&self.arguments[at]).stdout(Stdio::null()).stderr(log).spawn().unwrap();
        self.members[at] = Some(child);
    }

    pub fn kill(&mut self, at: usize) {
        if let Some(mut child) = self.members[at].take() {
            let _ = child.kill();
            let _ = child.wait();
        }
    }

    pub fn kill_all(&mut self) {
        (0..self.members.len()).for_each(|at| self.kill(at));
    }
}

impl Drop for Etcd {
    fn drop(&mut self) {
        self.kill_all();
    }
}

/// A server of a fleet, which may be gone.
pub struct Node {
    pub name: String,
    pub url: String,
    pub journals: PathBuf,
    arguments: Vec<String>,
    pub server: Option<Server>,
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
        self.server = Some(Server::start_at(&listen, &arguments));
    }

    pub fn there(&self) -> &Server {
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

/// Waits until `holds`. Tells how long that took.
pub async fn until(what: &str, mut holds: impl AsyncFnMut() -> bool) -> Duration {
    let begun = Instant::now();
    while !holds().await {
        assert!(begun.elapsed() < PATIENCE, "never: {what}");
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    begun.elapsed()
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
