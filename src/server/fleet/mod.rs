//! This server as one of a fleet. `member` keeps its lease, and with it the fence; `mirror` sends journals to the servers that
//! stand by, `receive` takes in those of others, which `stand_by` keeps; `take_over` claims sessions whose owner is gone,
//! `hand_over` moves those of this server, and `take_in` takes those of others.
//!
//! Clients connect to the owner of a session. No call is passed on but the creation of a session.

mod agones;
mod fenced;
mod hand_over;
mod member;
mod mirror;
mod peers;
mod receive;
mod stand_by;
mod take_in;
mod take_over;
mod tally;

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock};

use palpate_proto::pb;
use tokio::sync::watch;
use tokio_util::sync::CancellationToken;

pub(super) use fenced::FencedBody;
pub(super) use peers::MOST_MESSAGE_BYTES;
pub(super) use tally::Standing;

use super::config::Config;
use super::journals::Journals;
use super::journals::growth::Growth;
use crate::budget::Account;
use crate::cluster::etcd::{Etcd, EtcdError, EtcdOptions, KeyValue, Outcome, Txn};
use crate::cluster::key::{Keys, NodeValue, SessionValue, decode};
use crate::cluster::{placement, rules};
use crate::ids::random_id;
use crate::lock::lock;
use crate::pace::clock::now_ns;
use crate::pace::{Birth, Live, Pacer};
use crate::refusal::{Reason, Refusal, Result, excerpt};
use peers::Peers;
use stand_by::StandBy;

/// URLs of other servers that a client is told.
const MOST_OTHERS: usize = 8;

/// The nodes of a fleet, by name.
type Nodes = BTreeMap<String, NodeValue>;

/// This server as one of a fleet.
pub(super) struct Fleet {
    /// This server's name.
    node: String,
    keys: Keys,
    etcd: Etcd,
    ttl_s: u64,
    pacer: Arc<Pacer>,
    config: Arc<Config>,
    nodes: watch::Sender<Arc<Nodes>>,
    /// What this server tells of itself.
    own: Mutex<NodeValue>,
    /// Sessions that were sent to a node since it told how many it has.
    sent: Mutex<BTreeMap<String, u32>>,
    peers: Peers,
    /// The sessions of which this server is the owner in etcd.
    owned: Mutex<BTreeMap<String, Owned>>,
    growth: Arc<Growth>,
    tally: tally::FleetTally,
    stand_by: StandBy,
    /// Who stands by for each session.
    standbys: Mutex<BTreeMap<String, Standby>>,
    journals: OnceLock<Arc<Journals>>,
    /// The lease of this server; 0 before it has one.
    lease: std::sync::atomic::AtomicI64,
    is_draining: AtomicBool,
    /// It is no more of the fleet.
    ended: CancellationToken,
}

/// Who stands by for a session.
#[derive(Debug, Clone, Default)]
struct Standby {
    /// As etcd says; empty if it says of none.
    named: String,
    /// A server that has all, and is about to be named. Till etcd has said so, nothing further counts as mirrored: either may be the
    /// one that claims the session.
    naming: Option<String>,
}

impl Standby {
    /// Whether what that server has counts.
    fn is(&self, name: &str) -> bool {
        self.naming.is_none() && self.named == name
    }

    /// Whether etcd may say that it is that server: what it has is kept there.
    fn may_be(&self, name: &str) -> bool {
        self.named == name || self.naming.as_deref() == Some(name)
    }
}

/// A session of which this server is the owner in etcd.
struct Owned {
    revision: u64,
    /// It has been here: if it is not any more, it is deleted.
    was_here: bool,
    since_ns: u64,
}

impl Owned {
    /// Since that revision; the session is about to come.
    fn since(revision: u64) -> Self {
        Owned { revision, was_here: false, since_ns: now_ns() }
    }
}

/// A session that does not come within this time, ns, was given up by who wanted it.
const COMES_NS: u64 = 300_000_000_000;

/// A refusal because etcd does not answer, or not as asked.
fn of_etcd(error: EtcdError) -> Refusal {
    Refusal::new(Reason::Fenced, "", error.to_string())
}

impl Fleet {
    /// Joins the fleet: the server's name is in etcd, under a lease that is kept from then on. It does not act for sessions yet.
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
            instance: stand_by::instance(&folder)?,
            version: env!("CARGO_PKG_VERSION").to_owned(),
            replays: crate::journal::format::REPLAYS,
            threads: u32::try_from(config.stepping_threads()).unwrap_or(u32::MAX),
            load: 0.0,
            sessions: 0,
            // Until its own sessions go on, others must not send it new ones.
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
            growth: Arc::default(),
            tally: tally::FleetTally::default(),
            stand_by,
            standbys: Mutex::default(),
            journals: OnceLock::new(),
            lease: 0.into(),
            is_draining: false.into(),
            ended: CancellationToken::new(),
        });
        // Nothing is stepped or said before the lease is there.
        pacer.fence.set(0);
        fleet.register_first().await?;
        // From then on they are watched: a list that came late would hide what that has told.
        fleet.list_nodes().await?;
        Ok(fleet)
    }

    /// The account of that name.
    pub(super) fn account(&self, name: &str) -> Account {
        self.pacer.budget.account(name)
    }

    /// What the keeper of journals tells.
    pub(super) fn growth(&self) -> Arc<Growth> {
        self.growth.clone()
    }

    fn is_there(&self, node: &str) -> bool {
        self.nodes.borrow().contains_key(node)
    }

    /// A transaction whose end may be unknown: if so, what etcd has is read. `is_done` tells by that whether it took place. Tells the
    /// revision that it made, or what is there instead.
    async fn transact(
        &self,
        txn: Txn,
        id: &str,
        is_done: impl Fn(Option<&SessionValue>) -> bool,
    ) -> Result<std::result::Result<u64, Option<(SessionValue, u64)>>> {
        let key = self.keys.session(id);
        let outcome = self.etcd.transact(txn).await;
        match outcome {
            Ok(Outcome { succeeded: true, revision, .. }) => return Ok(Ok(revision)),
            Ok(_) | Err(EtcdError::Unknown(_)) => {}
            Err(error) => return Err(of_etcd(error)),
        }
        let was_unknown = outcome.is_err();
        let (found, _) = self.etcd.get(&key).await.map_err(of_etcd)?;
        let found = found.and_then(|found| Some((decode::<SessionValue>(&found.value)?, found.mod_revision)));
        if was_unknown && is_done(found.as_ref().map(|found| &found.0)) {
            return Ok(Ok(found.map_or(0, |found| found.1)));
        }
        Ok(Err(found))
    }

    /// Changes the key of a session of this server: `make` gives the transaction for the revision that the key has. This server may
    /// have changed the key itself since it looked: then it is made anew. Tells the revision, or what is there if that is another's.
    async fn change(
        &self,
        id: &str,
        mut revision: u64,
        make: impl Fn(u64) -> Txn,
        is_done: impl Fn(Option<&SessionValue>) -> bool,
    ) -> Result<std::result::Result<u64, Option<(SessionValue, u64)>>> {
        loop {
            match self.transact(make(revision), id, &is_done).await? {
                Err(Some((value, now))) if value.node == self.node && now > revision => revision = now,
                ended => return Ok(ended),
            }
        }
    }

    /// Makes this server the owner of a new session.
    ///
    /// # Errors
    /// Refuses while etcd can't be reached, and if this server has lost its lease.
    pub(super) async fn birth(&self) -> Result<Birth> {
        let id = random_id()?;
        let made = self.transact(rules::create(&self.keys, &id, &self.node), &id, |found| found.is_some()).await?;
        let revision = made.map_err(|_| crate::pace::fenced())?;
        lock(&self.owned).insert(id.clone(), Owned::since(revision));
        Ok(Birth { id, revision })
    }

    /// The session of a birth is there; or, if `is_there` is false, will not come.
    pub(super) async fn born(&self, birth: &Birth, is_there: bool) {
        if let Some(owned) = lock(&self.owned).get_mut(&birth.id) {
            owned.was_here = true;
        }
        if !is_there {
            self.forget_the_deleted().await;
        }
    }

    /// Sessions that this server has no more, because they are deleted, are no more in etcd either.
    pub(super) async fn forget_the_deleted(&self) {
        let mut gone = Vec::new();
        for (id, owned) in lock(&self.owned).iter_mut() {
            let is_here = self.pacer.has(id);
            if !is_here && (owned.was_here || now_ns().saturating_sub(owned.since_ns) > COMES_NS) {
                gone.push((id.clone(), owned.revision));
            }
            owned.was_here |= is_here;
        }
        for (id, revision) in gone {
            let delete = |revision| rules::delete(&self.keys, &id, revision);
            if self.change(&id, revision, delete, |found| found.is_none()).await.is_ok() {
                lock(&self.owned).remove(&id);
                lock(&self.standbys).remove(&id);
                self.growth.ended(&id);
            }
        }
    }

    /// The revision at which this server owns a session.
    fn revision(&self, id: &str) -> Option<u64> {
        lock(&self.owned).get(id).map(|owned| owned.revision)
    }

    /// The session's key in etcd.
    async fn session_value(&self, id: &str) -> Result<Option<(SessionValue, u64)>> {
        // What is no ID would be another key.
        if id.len() != 32 || !id.bytes().all(|byte| byte.is_ascii_hexdigit()) {
            return Ok(None);
        }
        let (found, _) = self.etcd.get(&self.keys.session(id)).await.map_err(of_etcd)?;
        Ok(found.and_then(|found| Some((decode(&found.value)?, found.mod_revision))))
    }

    fn ownership(&self, value: &SessionValue, revision: u64) -> pb::Ownership {
        let nodes = self.nodes.borrow();
        let owner = nodes.get(&value.node);
        let others = nodes.iter().filter(|(name, _)| **name != value.node).take(MOST_OTHERS);
        pb::Ownership {
            endpoint: owner.map(|node| node.endpoint.clone()).unwrap_or_default(),
            node: value.node.clone(),
            revision,
            standby: value.standby.clone(),
            others: others.map(|(_, node)| node.endpoint.clone()).collect(),
        }
    }

    /// Who serves a session of this server, as clients are told.
    pub(super) fn own(&self, live: &Live) -> pb::Ownership {
        let standby = lock(&self.standbys).get(&live.id).map(|standby| standby.named.clone()).unwrap_or_default();
        self.ownership(&SessionValue { node: self.node.clone(), standby }, live.revision())
    }

    /// Who serves a session.
    ///
    /// # Errors
    /// Refuses an unknown ID, while etcd can't be reached, and while nobody serves it.
    pub(super) async fn locate(&self, id: &str) -> Result<pb::Ownership> {
        let unknown =
            || Refusal::new(Reason::UnknownSession, "session_id", format!("there is no session `{}`", excerpt(id)));
        let (value, revision) = self.session_value(id).await?.ok_or_else(unknown)?;
        if !self.is_there(&value.node) {
            return Err(between_owners());
        }
        Ok(self.ownership(&value, revision))
    }

    /// Why this server does not serve a session that is `unknown` here.
    pub(super) async fn refuse(&self, id: &str, unknown: Refusal) -> Refusal {
        match self.locate(id).await {
            Ok(ownership) if ownership.node == self.node => between_owners(),
            Ok(ownership) => elsewhere(&ownership.node, ownership.endpoint),
            Err(refusal) if refusal.reason == Reason::UnknownSession => unknown,
            Err(refusal) => refusal,
        }
    }

    /// The node that is to take a new session, if that is another.
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

    /// Has another node create a session, if one has more room. `None`: this server is to do it.
    pub(super) async fn create_elsewhere(
        &self,
        request: &pb::CreateSessionRequest,
        owner: &Account,
    ) -> Option<std::result::Result<pb::Session, tonic::Status>> {
        use pb::create_session_request::Source;
        // A mesh or a journal that a client has sent is here.
        let is_anywhere = match &request.source {
            Some(Source::SceneName(_)) => true,
            Some(Source::Scene(scene)) => scene.mesh.is_none(),
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
            // It is not there, or has just lost its lease: then this server does it.
            Err(status) if status.code() == tonic::Code::Unavailable => None,
            Err(status) => Some(Err(status)),
        }
    }

    /// The servers of the fleet.
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

    /// The sessions of the fleet, by ID.
    ///
    /// # Errors
    /// Refuses while etcd can't be reached.
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

    /// Whether this server takes no new sessions.
    fn set_draining(&self, is_draining: bool) {
        self.is_draining.store(is_draining, Ordering::Relaxed);
    }
}

/// The refusal of a session whose owner is gone, and that nobody has taken over yet.
fn between_owners() -> Refusal {
    let message = "the server of this session is gone, and another is about to take over; try again in a second";
    Refusal::new(Reason::Fenced, "session_id", message)
}

/// The refusal of a session that another server has.
fn elsewhere(node: &str, endpoint: String) -> Refusal {
    let message = format!("the server `{node}` of the fleet has this session; connect there");
    Refusal { place: Some(endpoint), ..Refusal::new(Reason::Elsewhere, "session_id", message) }
}
