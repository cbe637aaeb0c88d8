//! Real members of etcd, in processes of their own: killed, frozen and started again on the same data and ports.
#![allow(
    dead_code,
    unreachable_pub,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::disallowed_methods
)]

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};

/// Timeout of a test: long enough for any machine.
const ETCD_TIMEOUT: Duration = Duration::from_secs(60);

/// Time after which members notice that their leader is gone.
#[derive(Debug, Clone, Copy)]
pub struct FailoverTimes {
    pub heartbeat_ms: u32,
    pub election_ms: u32,
}

/// The default times of etcd.
pub const DEFAULT_TIMES: FailoverTimes = FailoverTimes { heartbeat_ms: 100, election_ms: 1000 };

/// For tests of what happens without a leader.
pub const SHORT_TIMES: FailoverTimes = FailoverTimes { heartbeat_ms: 50, election_ms: 500 };

/// The certificates of members and their clients (PEM files).
#[derive(Debug, Clone)]
pub struct Certificates {
    pub ca: PathBuf,
    pub cert: PathBuf,
    pub key: PathBuf,
}

/// Members that found each other. They end with this.
pub struct EtcdMembers {
    members: Vec<Member>,
    arguments: Vec<String>,
    certificates: Option<Certificates>,
    folder: tempfile::TempDir,
}

struct Member {
    client: SocketAddr,
    peer: SocketAddr,
    metrics: SocketAddr,
    child: Option<Child>,
}

impl EtcdMembers {
    /// Returns whether etcd is on this machine. Prints a message if not, and fails where CI is set.
    pub fn is_there() -> bool {
        // Without arguments, etcd would serve.
        let programs = [("etcd", "--version"), ("etcdctl", "version")];
        let is_there = programs.iter().all(|(program, version)| Command::new(program).arg(version).output().is_ok());
        if !is_there {
            eprintln!("SKIPPED: there is no etcd (Debian: apt-get install etcd-server etcd-client)");
            assert!(std::env::var_os("CI").is_none(), "CI is set, and there is no etcd");
        }
        is_there
    }

    /// Starts this many members, with etcd's default times.
    pub fn start(members: usize) -> Self {
        EtcdMembers::start_with(members, DEFAULT_TIMES, &[], |_| None)
    }

    /// Starts this many members, with these times, more arguments, and certificates if `certify` makes some for their
    /// addresses.
    pub fn start_with(
        members: usize,
        times: FailoverTimes,
        arguments: &[&str],
        certify: impl FnOnce(&[SocketAddr]) -> Option<Certificates>,
    ) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let host = host();
        // All ports are held until all are chosen.
        let listeners: Vec<TcpListener> =
            (0..3 * members).map(|_| TcpListener::bind((host.as_str(), 0)).unwrap()).collect();
        let addresses: Vec<SocketAddr> = listeners.iter().map(|one| one.local_addr().unwrap()).collect();
        drop(listeners);
        let member = |ports: &[SocketAddr]| Member { client: ports[0], peer: ports[1], metrics: ports[2], child: None };
        let members: Vec<Member> = addresses.chunks(3).map(member).collect();
        let certificates = certify(&members.iter().map(|member| member.client).collect::<Vec<_>>());
        let mut all = vec![
            format!("--heartbeat-interval={}", times.heartbeat_ms),
            format!("--election-timeout={}", times.election_ms),
            "--logger=zap".to_owned(),
            "--log-outputs=stderr".to_owned(),
        ];
        all.extend(arguments.iter().map(|&argument| argument.to_owned()));
        let mut etcd = EtcdMembers { members, arguments: all, certificates, folder };
        etcd.restart_all();
        etcd
    }

    /// Addresses for clients.
    pub fn endpoints(&self) -> Vec<String> {
        let scheme = if self.certificates.is_some() { "https" } else { "http" };
        self.members.iter().map(|member| format!("{scheme}://{}", member.client)).collect()
    }

    /// A member's process, if it runs.
    pub fn process(&self, index: usize) -> Option<u32> {
        self.members[index].child.as_ref().map(Child::id)
    }

    /// A metric without labels of a member that runs.
    pub fn metric(&self, index: usize, name: &str) -> Option<f64> {
        let told = get(self.members[index].metrics, "/metrics");
        told.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ')?.parse().ok())
    }

    /// Which member has this address.
    pub fn index(&self, endpoint: &str) -> usize {
        self.endpoints().iter().position(|own| own == endpoint).unwrap()
    }

    /// The certificates that it was started with.
    pub fn certificates(&self) -> Option<&Certificates> {
        self.certificates.as_ref()
    }

    /// Kills a member, if it runs.
    pub fn kill(&mut self, index: usize) {
        if let Some(mut child) = self.members[index].child.take() {
            child.kill().unwrap();
            child.wait().unwrap();
        }
    }

    /// Starts a member that was killed, on its data and ports; does not wait until it serves (`wait`).
    pub fn restart(&mut self, index: usize) {
        self.kill(index);
        let member = &self.members[index];
        let scheme = if self.certificates.is_some() { "https" } else { "http" };
        let (client, peer, metrics) = (member.client, member.peer, member.metrics);
        let name = |index: usize| format!("member-{index}");
        let peers = self.members.iter().enumerate().map(|(at, one)| format!("{}=http://{}", name(at), one.peer));
        let mut command = Command::new("etcd");
        command
            .arg(format!("--name={}", name(index)))
            .arg(format!("--data-dir={}", self.folder.path().join(name(index)).display()))
            .arg(format!("--listen-client-urls={scheme}://{client}"))
            .arg(format!("--advertise-client-urls={scheme}://{client}"))
            .arg(format!("--listen-peer-urls=http://{peer}"))
            .arg(format!("--initial-advertise-peer-urls=http://{peer}"))
            .arg(format!("--listen-metrics-urls=http://{metrics}"))
            .arg(format!("--initial-cluster={}", peers.collect::<Vec<_>>().join(",")))
            .arg("--initial-cluster-state=new")
            .args(&self.arguments);
        if let Some(files) = &self.certificates {
            let of = |option: &str, path: &Path| format!("--{option}={}", path.display());
            command.arg("--client-cert-auth").arg(of("trusted-ca-file", &files.ca));
            command.args([of("cert-file", &files.cert), of("key-file", &files.key)]);
        }
        let log = std::fs::OpenOptions::new().create(true).append(true).open(self.log(index)).unwrap();
        let child = command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(log).spawn().unwrap();
        self.members[index].child = Some(child);
    }

    /// Kills all members.
    pub fn stop_all(&mut self) {
        (0..self.members.len()).for_each(|index| self.kill(index));
    }

    /// Starts all members again, and waits until they serve.
    pub fn restart_all(&mut self) {
        (0..self.members.len()).for_each(|index| self.restart(index));
        self.wait();
    }

    /// Freezes a member (SIGSTOP).
    pub fn pause(&self, index: usize) {
        self.signal(index, Signal::STOP);
        // The kernel stops it when it next runs, until which it may answer.
        let id = self.members[index].child.as_ref().unwrap().id();
        let begun = std::time::Instant::now();
        while !std::fs::read_to_string(format!("/proc/{id}/stat")).unwrap().contains(") T ") {
            assert!(begun.elapsed() < ETCD_TIMEOUT, "member {index} does not stop");
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
    }

    /// Lets a frozen member continue.
    pub fn resume(&self, index: usize) {
        self.signal(index, Signal::CONT);
    }

    fn signal(&self, index: usize, signal: Signal) {
        let child = self.members[index].child.as_ref().unwrap();
        kill_process(Pid::from_child(child), signal).unwrap();
    }

    /// Waits until every member that runs serves, with a leader.
    pub fn wait(&mut self) {
        let begun = Instant::now();
        for index in 0..self.members.len() {
            let metrics = self.members[index].metrics;
            while self.members[index].child.is_some() && !get(metrics, "/health").contains("\"true\"") {
                let ended = self.members[index].child.as_mut().and_then(|child| child.try_wait().unwrap());
                let late = begun.elapsed() > ETCD_TIMEOUT;
                assert!(ended.is_none() && !late, "member {index} does not serve: {ended:?}\n{}", self.said(index));
                std::thread::sleep(Duration::from_millis(20));
            }
        }
    }

    /// The member that leads, if one says so.
    pub fn leader(&self) -> Option<usize> {
        let leads = |member: &Member| get(member.metrics, "/metrics").contains("\netcd_server_is_leader 1\n");
        self.members.iter().position(|member| member.child.is_some() && leads(member))
    }

    /// The program `etcdctl` at the first member, which has to succeed; what it says.
    pub fn control(&self, arguments: &[&str]) -> String {
        let mut command = Command::new("etcdctl");
        command.env("ETCDCTL_API", "3").arg("--endpoints").arg(&self.endpoints()[0]);
        if let Some(files) = &self.certificates {
            command.arg("--cacert").arg(&files.ca).arg("--cert").arg(&files.cert).arg("--key").arg(&files.key);
        }
        let output = command.args(arguments).output().unwrap();
        let said = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
        assert!(output.status.success(), "etcdctl {arguments:?}: {}", said(&output.stderr));
        said(&output.stdout)
    }

    fn log(&self, index: usize) -> PathBuf {
        self.folder.path().join(format!("member-{index}.log"))
    }

    /// The end of what a member has logged.
    fn said(&self, index: usize) -> String {
        let log = std::fs::read_to_string(self.log(index)).unwrap_or_default();
        let lines: Vec<&str> = log.lines().collect();
        lines[lines.len().saturating_sub(20)..].join("\n")
    }
}

impl Drop for EtcdMembers {
    fn drop(&mut self) {
        for child in self.members.iter_mut().filter_map(|member| member.child.as_mut()) {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

/// An address of this machine. Where every address of 127.0.0.0/8 is, that is one of our own: nobody else's port, nor
/// the near end of anybody's connection, can be one of a member that is to start again.
fn host() -> String {
    static COUNT: AtomicU8 = AtomicU8::new(0);
    if !cfg!(target_os = "linux") {
        return "127.0.0.1".to_owned();
    }
    let [.., high, low] = std::process::id().to_be_bytes();
    format!("127.{}.{low}.{}", 1 + high % 254, 1 + COUNT.fetch_add(1, Ordering::Relaxed) % 254)
}

/// Returns the answer at a path of a member's port for metrics; nothing if it does not answer.
fn get(address: SocketAddr, path: &str) -> String {
    let asked = || -> std::io::Result<String> {
        let patience = Duration::from_secs(1);
        let mut stream = TcpStream::connect_timeout(&address, patience)?;
        stream.set_read_timeout(Some(patience))?;
        write!(stream, "GET {path} HTTP/1.0\r\nHost: etcd\r\n\r\n")?;
        let mut text = String::new();
        stream.read_to_string(&mut text)?;
        Ok(text)
    };
    asked().unwrap_or_default()
}
