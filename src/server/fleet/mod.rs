//! This server as a member of a fleet. `member` keeps its lease in etcd, and with it the *fence*: the time until
//! which it may act for its sessions. `owned` keeps the etcd keys of this server's sessions, `follow` ends sessions
//! whose key names another owner, and `reconcile` repairs keys that wrongly name this server. `replication` sends
//! journals to the standby servers; `replica_receiver` receives the journals of others, which `replica` keeps.
//! `failover` claims sessions whose owner is gone, `migrate` moves sessions of this server to others, and `receive`
//! takes sessions that others hand over. `peers` holds the connections to other servers, `fenced` ends responses at
//! the fence, and `counters` and `agones` report the state.
//!
//! Clients connect to the owner of a session. No call is forwarded except the creation of a session.

#[cfg(feature = "agones")]
mod agones;
mod counters;
mod failover;
mod fenced;
mod follow;
mod member;
mod migrate;
mod owned;
mod peers;
mod positional_io;
mod receive;
mod reconcile;
mod replica;
mod replica_receiver;
mod replication;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

use palpate_proto::pb;
use tokio::sync::{Notify, watch};
use tokio_util::sync::CancellationToken;

pub(super) use counters::Standing;
pub(super) use fenced::FencedBody;
pub(super) use peers::MAX_MESSAGE_BYTES;

use super::config::Config;
use super::journals::Journals;
use super::journals::progress::Growth;
use palpate_cluster::etcd::{Etcd, EtcdError, EtcdOptions, KeyValue};
use palpate_cluster::key::{Keys, NodeValue, SessionValue, decode};
use palpate_cluster::placement;
use palpate_realtime::clock::now_ns;
use palpate_realtime::{Pacer, SessionHandle};
use palpate_refusal::{Reason, Refusal, Result, excerpt};
use palpate_session::budget::Account;
use palpate_tissue::lock::lock;
use peers::Peers;
use replica::StandBy;

/// Maximum number of URLs of other servers that a client is sent.
const MAX_OTHERS: usize = 8;

/// The servers of a fleet, by name.
type Nodes = BTreeMap<String, NodeValue>;

/// This server as a member of a fleet.
pub(super) struct Fleet {
    /// This server's name.
    node: String,
    keys: Keys,
    etcd: Etcd,
    ttl_s: u64,
    pacer: Arc<Pacer>,
    config: Arc<Config>,
    nodes: watch::Sender<Arc<Nodes>>,
    /// The state that this server publishes of itself.
    own: Mutex<NodeValue>,
    /// Sessions that were sent to each server since it last published how many it has.
    sent: Mutex<BTreeMap<String, u32>>,
    peers: Peers,
    /// The sessions of which this server is the owner in etcd.
    owned: Mutex<BTreeMap<String, Owned>>,
    /// Sessions that are arriving at this server: handed over, claimed, or found again. It does not own them yet.
    coming: Mutex<BTreeSet<String>>,
    /// Sessions that this server is handing over: meanwhile it names no standby for them.
    moving: Mutex<BTreeSet<String>>,
    /// Sessions that can't continue here: their journals and keys stay as they are.
    left_alone: Mutex<BTreeSet<String>>,
    /// Notified when the result of a transaction is unknown: etcd may name this server wrongly as an owner.
    unsettled: Notify,
    growth: Arc<Growth>,
    tally: counters::FleetTally,
    stand_by: StandBy,
    /// The standby of each session.
    standbys: Mutex<BTreeMap<String, Standby>>,
    /// Deleted or moved sessions whose journals the named server need not keep any longer, by server.
    past: Mutex<BTreeMap<String, Vec<String>>>,
    journals: OnceLock<Arc<Journals>>,
    held: Mutex<HeldLease>,
    /// The fence that etcd has confirmed, ns, also before this server acts for sessions.
    confirmed_ns: AtomicU64,
    is_draining: AtomicBool,
    /// Cancelled when the server leaves the fleet.
    ended: CancellationToken,
}

/// This server's lease and key in etcd.
#[derive(Debug, Clone, Copy, Default)]
struct HeldLease {
    /// The lease; 0 before it has one.
    lease: i64,
    /// The revision at which this process last wrote the server's key.
    key_revision: u64,
}

/// The standby of a session: the server that keeps a copy of its journal and may take it over.
#[derive(Debug, Clone, Default)]
struct Standby {
    /// The standby in etcd; empty if there is none.
    named: String,
    /// A server that has the whole journal and is about to be named. Until etcd has confirmed it, nothing further
    /// counts as replicated: either may be the one that claims the session.
    naming: Option<String>,
}

impl Standby {
    /// Returns whether `name` is the confirmed standby, so that its copy counts as replicated.
    fn is(&self, name: &str) -> bool {
        self.naming.is_none() && self.named == name
    }

    /// Returns whether etcd may name `name` as the standby: the copy there is kept.
    fn may_be(&self, name: &str) -> bool {
        self.named == name || self.naming.as_deref() == Some(name)
    }
}

/// A session of which this server is the owner in etcd.
struct Owned {
    revision: u64,
    /// Whether it has been here: if so and it is gone, it was deleted.
    was_here: bool,
    since_ns: u64,
}

impl Owned {
    /// Creates the entry of a session owned since that revision; the session is about to arrive.
    fn since(revision: u64) -> Self {
        Owned { revision, was_here: false, since_ns: now_ns() }
    }
}

/// Returns the refusal of a call that etcd did not answer, or not as expected.
fn of_etcd(error: EtcdError) -> Refusal {
    Refusal::new(Reason::Fenced, "", error.to_string())
}

impl Fleet {
    /// Joins the fleet: writes the server's name to etcd, under a lease that it renews from then on. The server does
    /// not act for sessions yet.
    ///
    /// # Errors
    /// Refuses if etcd can't be reached, or another server has this name.
    pub(super) async fn join(config: &Arc<Config>, pacer: &Arc<Pacer>) -> Result<Arc<Self>> {
        let cluster = &config.cluster;
        let options = EtcdOptions {
            endpoints: cluster.etcd.clone(),
            ca: cluster.etcd_ca.clone(),
            certificate: cluster.etcd_cert.clone(),
            key: cluster.etcd_key.clone(),
            user: cluster.etcd_user.clone(),
            password_file: cluster.etcd_password_file.clone(),
        };
        let within = |error: EtcdError| Refusal::new(Reason::NotAvailable, "cluster.etcd", error.to_string());
        let etcd = Etcd::open(&options).map_err(within)?;
        let folder = config.journal.clone().unwrap_or_default();
        let stand_by = StandBy::open(&folder)?;
        let own = NodeValue {
            endpoint: cluster.endpoint().to_owned(),
            instance: replica::instance(&folder)?,
            version: env!("CARGO_PKG_VERSION").to_owned(),
            replays: palpate_session::journal::format::REPLAYS,
            threads: u32::try_from(config.stepping_threads()).unwrap_or(u32::MAX),
            load: 0.0,
            sessions: 0,
            // Until its own sessions continue, others must not send it new ones.
            draining: true,
        };
        let fleet = Arc::new(Fleet {
            node: cluster.node(),
            keys: Keys::of(&cluster.name)?,
            etcd,
            ttl_s: cluster.ttl_s,
            pacer: pacer.clone(),
            config: config.clone(),
            nodes: watch::Sender::default(),
            own: Mutex::new(own),
            sent: Mutex::default(),
            peers: Peers::new(config)?,
            owned: Mutex::default(),
            coming: Mutex::default(),
            moving: Mutex::default(),
            left_alone: Mutex::default(),
            unsettled: Notify::new(),
            growth: Arc::default(),
            tally: counters::FleetTally::default(),
            stand_by,
            standbys: Mutex::default(),
            past: Mutex::default(),
            journals: OnceLock::new(),
            held: Mutex::default(),
            confirmed_ns: 0.into(),
            is_draining: false.into(),
            ended: CancellationToken::new(),
        });
        // The fence stays closed until the server has a lease.
        pacer.fence.set(0);
        fleet.register_first().await?;
        // Runs also while the server looks for its own sessions, which may take longer than the lease.
        fleet.spawn(fleet.clone().keep_alive());
        // The watch starts later: a list read after it could hide its newer events.
        fleet.list_nodes().await?;
        Ok(fleet)
    }

    /// Returns the account with that name.
    pub(super) fn account(&self, name: &str) -> Account {
        self.pacer.budget.account(name)
    }

    /// Returns the progress of the journals, which their keeper updates.
    pub(super) fn growth(&self) -> Arc<Growth> {
        self.growth.clone()
    }

    fn is_there(&self, node: &str) -> bool {
        self.nodes.borrow().contains_key(node)
    }

    fn ownership(&self, value: &SessionValue, revision: u64) -> pb::Ownership {
        let nodes = self.nodes.borrow();
        let owner = nodes.get(&value.node);
        let others = nodes.iter().filter(|(name, _)| **name != value.node).take(MAX_OTHERS);
        pb::Ownership {
            endpoint: owner.map(|node| node.endpoint.clone()).unwrap_or_default(),
            node: value.node.clone(),
            revision,
            standby: value.standby.clone(),
            others: others.map(|(_, node)| node.endpoint.clone()).collect(),
        }
    }

    /// Returns the ownership of a session of this server, as clients receive it.
    pub(super) fn own(&self, handle: &SessionHandle) -> pb::Ownership {
        let standby = lock(&self.standbys).get(&handle.id).map(|standby| standby.named.clone()).unwrap_or_default();
        self.ownership(&SessionValue { node: self.node.clone(), standby }, handle.revision())
    }

    /// Returns the server that owns a session.
    ///
    /// # Errors
    /// Refuses an unknown ID, and if etcd can't be reached or no server has the session now.
    pub(super) async fn locate(&self, id: &str) -> Result<pb::Ownership> {
        let unknown =
            || Refusal::new(Reason::UnknownSession, "session_id", format!("there is no session `{}`", excerpt(id)));
        let (value, revision) = self.session_value(id).await?.ok_or_else(unknown)?;
        if !self.is_there(&value.node) {
            let standby = Some(value.standby.as_str()).filter(|node| self.is_there(node));
            return Err(between_owners(standby));
        }
        Ok(self.ownership(&value, revision))
    }

    /// Returns why this server does not serve a session that is `unknown` here.
    pub(super) async fn refuse(&self, id: &str, unknown: Refusal) -> Refusal {
        match self.locate(id).await {
            Ok(ownership) if ownership.node == self.node => between_owners(Some(&self.node)),
            Ok(ownership) => elsewhere(&ownership.node, ownership.endpoint),
            Err(refusal) if refusal.reason == Reason::UnknownSession => unknown,
            Err(refusal) => refusal,
        }
    }

    /// Returns the name and endpoint of the server that is to create a new session, if it is another one. Counts the
    /// session as sent to it.
    fn place(&self) -> Option<(String, String)> {
        let mut nodes = (**self.nodes.borrow()).clone();
        let mut sent = lock(&self.sent);
        for (name, node) in &mut nodes {
            node.sessions += sent.get(name).copied().unwrap_or_default();
        }
        let name = placement::roomiest(&nodes)?.to_owned();
        *sent.entry(name.clone()).or_default() += 1;
        let endpoint = nodes.get(&name)?.endpoint.clone();
        (name != self.node).then_some((name, endpoint))
    }

    /// Lets another server create a session, if one has more room. `None`: this server is to create it.
    pub(super) async fn create_elsewhere(
        &self,
        request: &pb::CreateSessionRequest,
        owner: &Account,
    ) -> Option<std::result::Result<pb::Session, tonic::Status>> {
        use pb::create_session_request::Source;
        // An uploaded mesh or journal is on this server.
        let is_anywhere = match &request.source {
            Some(Source::SceneName(_)) => true,
            Some(Source::Scene(scene)) => palpate_proto::scene::mesh_id(scene).is_none(),
            _ => false,
        };
        if !is_anywhere {
            return None;
        }
        let (_, endpoint) = self.place()?;
        let here = pb::CreateHereRequest { request: Some(request.clone()), owner: owner.name().to_owned() };
        let created = self.peers.at(&endpoint).ok()?.create_here(here).await;
        match created {
            Ok(answer) => answer.into_inner().session.map(Ok),
            // That server is gone, or has just lost its lease: this server creates the session.
            Err(status) if status.code() == tonic::Code::Unavailable => None,
            Err(status) => Some(Err(status)),
        }
    }

    /// Returns the servers of the fleet.
    pub(super) fn nodes(&self) -> Vec<pb::Node> {
        let nodes = self.nodes.borrow();
        let of = |(name, node): (&String, &NodeValue)| pb::Node {
            node: name.clone(),
            endpoint: node.endpoint.clone(),
            version: node.version.clone(),
            replays: node.replays,
            threads: node.threads,
            load: node.load,
            sessions: node.sessions,
            draining: node.draining,
        };
        nodes.iter().map(of).collect()
    }

    /// Returns the sessions of the fleet, by ID.
    ///
    /// # Errors
    /// Refuses if etcd can't be reached.
    pub(super) async fn sessions(&self) -> Result<Vec<pb::FleetSession>> {
        let prefix = self.keys.sessions();
        let (found, _) = self.etcd.list(&prefix).await.map_err(of_etcd)?;
        let of = |found: KeyValue| {
            let value: SessionValue = decode(&found.value)?;
            let ownership = pb::Ownership { others: Vec::new(), ..self.ownership(&value, found.mod_revision) };
            let session_id = found.key.strip_prefix(&prefix)?.to_owned();
            Some(pb::FleetSession { session_id, served: self.is_there(&value.node), ownership: Some(ownership) })
        };
        Ok(found.into_iter().filter_map(of).collect())
    }

    /// Sets whether this server refuses new sessions.
    fn set_draining(&self, is_draining: bool) {
        self.is_draining.store(is_draining, Ordering::Relaxed);
    }
}

/// Returns the refusal of a session that no server has now; `standby` is the server that may claim it, if it runs.
fn between_owners(standby: Option<&str>) -> Refusal {
    let message = match standby {
        Some(node) => {
            format!("the server of this session is gone, and `{node}` is about to take over; try again in a second")
        }
        None => {
            "the server of this session is gone, and it had no standby: the session continues when that server is back"
                .to_owned()
        }
    };
    Refusal::new(Reason::Fenced, "session_id", message)
}

/// Returns the refusal of a session that another server has.
fn elsewhere(node: &str, endpoint: String) -> Refusal {
    let message = format!("the server `{node}` of the fleet has this session; connect there");
    Refusal { place: Some(endpoint), ..Refusal::new(Reason::Elsewhere, "session_id", message) }
}
