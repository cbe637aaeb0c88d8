//! Membership: the server's lease and its fence, and who else is there.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use futures_util::stream::{self, StreamExt};
use tokio::task::AbortHandle;
use tokio::time::{Instant, sleep, sleep_until};
use tracing::{error, info, warn};

use super::counters::Standing;
use super::owned::Found;
use super::{Fleet, HeldLease, Nodes, elsewhere};
use crate::server::journals::Journals;
use palpate_cluster::etcd::{Compare, EtcdError, Op, Txn, WatchError, WatchEvent};
use palpate_cluster::key::{NodeValue, decode, encode};
use palpate_cluster::rules;
use palpate_realtime::fence::boot_ns;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::lock::lock;

/// After a failure it is tried again so soon.
const PAUSE: Duration = Duration::from_millis(100);

/// A server that starts waits so long for etcd.
const START: Duration = Duration::from_secs(10);

/// The fence is looked at so often, to end streams when it is passed.
const LOOK: Duration = Duration::from_millis(20);

/// What the server tells of itself is told so often, if it has changed.
const TELL: Duration = Duration::from_millis(500);

/// No more often than this times the number of servers: etcd then gets at most a hundred such writes a second, however many there are.
const TELL_EACH: Duration = Duration::from_millis(10);

/// Transactions at once.
const AT_ONCE: usize = 16;

impl Fleet {
    /// The same, waiting a while for an etcd that is about to start too.
    ///
    /// # Errors
    /// As for [`Fleet::register`].
    pub(super) async fn register_first(self: &Arc<Self>) -> Result<()> {
        let until = Instant::now() + START;
        loop {
            match self.register().await {
                Err(refusal) if refusal.reason == Reason::NotAvailable && Instant::now() < until => {
                    warn!("{refusal}; trying again");
                    sleep(5 * PAUSE).await;
                }
                ended => return ended,
            }
        }
    }

    /// Puts this server's name in etcd, under a new lease.
    ///
    /// # Errors
    /// Refuses if etcd can't be reached, or another server has this name.
    pub(super) async fn register(self: &Arc<Self>) -> Result<()> {
        let within = |error: EtcdError| Refusal::new(Reason::NotAvailable, "cluster.etcd", error.to_string());
        let lease = self.etcd.grant(self.ttl_s).await.map_err(within)?;
        let key = self.keys.node(&self.node);
        let own = lock(&self.own).clone();
        let (found, _) = self.etcd.get(&key).await.map_err(within)?;
        if let Some(found) = &found
            && decode::<NodeValue>(&found.value).is_some_and(|there| there.instance != own.instance)
        {
            let message = format!("another server of the fleet has the name `{}`: give each its own", self.node);
            return Err(Refusal::new(Reason::OutOfTurn, "cluster.node", message));
        }
        // The one before this process, of the same folder, has ended.
        let as_seen =
            found.map_or(Compare::Absent(key.clone()), |found| Compare::ModRevision(key.clone(), found.mod_revision));
        let put = Op::Put { key: key.clone(), value: encode(&own), lease: Some(lease.id) };
        let txn = Txn { if_all: vec![as_seen], then: vec![put], otherwise: vec![] };
        let written = match self.etcd.transact(txn).await {
            Ok(outcome) => outcome.succeeded.then_some(outcome.revision),
            Err(EtcdError::Unknown(_)) => {
                let (found, _) = self.etcd.get(&key).await.map_err(within)?;
                found.filter(|found| found.lease == lease.id).map(|found| found.mod_revision)
            }
            Err(error) => return Err(within(error)),
        };
        let Some(key_revision) = written else {
            return Err(Refusal::new(
                Reason::OutOfTurn,
                "cluster.node",
                "is being taken by another server at this moment",
            ));
        };
        *lock(&self.held) = HeldLease { lease: lease.id, key_revision };
        info!(node = self.node, lease = lease.id, ttl_s = lease.ttl_s, "this server is of the fleet");
        Ok(())
    }

    /// The sessions of this server go on: it takes new ones, and steps and speaks for its own while it has its lease.
    pub(in crate::server) fn begin(self: &Arc<Self>, journals: &Arc<Journals>) {
        let _ = self.journals.set(journals.clone());
        // Those that can't be continued stay as they are, in etcd too. Others that are not here are deleted.
        lock(&self.owned).retain(|id, owned| {
            owned.was_here = true;
            let stays = self.pacer.has(id) || !journals.has_left_alone(id);
            if !stays {
                lock(&self.left_alone).insert(id.clone());
            }
            stays
        });
        self.pacer.fence.set(self.confirmed_ns.load(Ordering::Acquire));
        self.spawn(self.clone().watch_fence());
        self.spawn(self.peers.watch());
        self.spawn(self.clone().watch_nodes());
        self.spawn(self.clone().tell());
        self.spawn(self.clone().mirror());
        self.spawn(self.clone().take_over());
        self.spawn(self.clone().settle());
        self.spawn(self.clone().follow_owned());
        #[cfg(feature = "agones")]
        self.spawn(self.clone().tell_agones());
    }

    /// Does `work` until the server is no more of the fleet.
    pub(super) fn spawn(&self, work: impl Future<Output = ()> + Send + 'static) -> AbortHandle {
        tokio::spawn(self.ended.clone().run_until_cancelled_owned(work)).abort_handle()
    }

    /// Keeps the lease, for ever; moves the fence on. When the lease has ended, gets another, and takes back the sessions that nobody
    /// has claimed.
    pub(super) async fn keep_alive(self: Arc<Self>) {
        let every = self.between_keepalives();
        let mut is_well = true;
        loop {
            let begun = Instant::now();
            let sent_ns = boot_ns();
            let lease = lock(&self.held).lease;
            match self.etcd.keep_alive(lease).await {
                Ok(Some(ttl_s)) => {
                    is_well = true;
                    let was_fenced = !self.pacer.fence.may_act();
                    self.confirmed_ns.store(rules::fence_ns(sent_ns, ttl_s), Ordering::Release);
                    // Nothing is stepped or said before this server's own sessions are here.
                    if self.journals.get().is_some() {
                        self.pacer.fence.set(self.confirmed_ns.load(Ordering::Acquire));
                    }
                    if was_fenced && self.pacer.fence.may_act() {
                        info!("etcd has confirmed the lease: sessions go on here");
                    }
                    sleep_until(begun + every).await;
                }
                Ok(None) => {
                    warn!("the lease has ended: another server may have taken over sessions of this one");
                    self.rejoin().await;
                }
                Err(error) => {
                    // Once for each time that it goes away.
                    if std::mem::take(&mut is_well) {
                        warn!("{error}");
                    }
                    sleep(PAUSE).await;
                }
            }
        }
    }

    fn between_keepalives(&self) -> Duration {
        Duration::from_millis(self.ttl_s * 1000 / 6)
    }

    /// Gets another lease, and takes back what nobody has claimed. Nothing is stepped or said till the next keepalive. If the new lease
    /// ends before all is taken back, it begins anew.
    async fn rejoin(self: &Arc<Self>) {
        self.confirmed_ns.store(0, Ordering::Release);
        self.pacer.fence.set(0);
        loop {
            while let Err(refusal) = self.register().await {
                warn!("{refusal}");
                sleep(PAUSE).await;
            }
            tokio::select! {
                is_done = self.take_all_back() => if is_done {
                    return;
                },
                () = self.until_lease_ends() => {}
            }
            warn!("the lease has ended again before all sessions were taken back");
            sleep(PAUSE).await;
        }
    }

    /// Keeps the lease, and leaves the fence where it is, till it has ended.
    async fn until_lease_ends(&self) {
        let lease = lock(&self.held).lease;
        while !matches!(self.etcd.keep_alive(lease).await, Ok(None)) {
            sleep(self.between_keepalives()).await;
        }
    }

    /// Whether it is known of all sessions whether they still are this server's. If not, its lease has ended.
    async fn take_all_back(&self) -> bool {
        let owned: Vec<(String, u64)> =
            lock(&self.owned).iter().map(|(id, owned)| (id.clone(), owned.revision)).collect();
        let mut taken = stream::iter(owned)
            .map(|(id, revision)| async move { self.take_back(&id, revision).await })
            .buffer_unordered(AT_ONCE);
        while let Some(is_known) = taken.next().await {
            if !is_known {
                return false;
            }
        }
        true
    }

    /// Says that this server still owns a session, or lets it go if another does. Tells whether it could find out: it can't if its
    /// lease has ended.
    async fn take_back(&self, id: &str, revision: u64) -> bool {
        loop {
            let keep = |revision| rules::keep(&self.keys, id, revision, &self.node, "");
            match self.change(id, revision, keep, |found| self.is_own(found, "")).await {
                Ok(Ok(now)) => {
                    if self.owns_since(id, now) {
                        self.names_nobody(id);
                    }
                    self.pacer
                        .list()
                        .iter()
                        .filter(|handle| handle.id == id)
                        .for_each(|handle| handle.is_owned_since(now));
                    return true;
                }
                Ok(Err(Some((value, _)))) if value.node == self.node => return false,
                Ok(Err(found)) => {
                    // Unless the watch of its key has told that before.
                    if self.revision(id).is_some() {
                        let node = found.as_ref().map_or("", |(value, _)| &value.node);
                        info!(session = %id, node, "another server has taken over");
                        self.tally.lost.one_more();
                        self.lose(id, self.is_lost(found));
                    }
                    return true;
                }
                Err(refusal) => {
                    warn!(session = %id, "{refusal}");
                    sleep(PAUSE).await;
                }
            }
        }
    }

    /// The refusal of a session that is found to be another server's.
    pub(super) fn is_lost(&self, found: Found) -> Refusal {
        let node = found.map_or_else(String::new, |(value, _)| value.node);
        let endpoint = self.nodes.borrow().get(&node).map(|there| there.endpoint.clone());
        elsewhere(&node, endpoint.unwrap_or_default())
    }

    /// A session of this server has another owner.
    pub(super) fn lose(&self, id: &str, why: Refusal) {
        lock(&self.owned).remove(id);
        lock(&self.standbys).remove(id);
        self.growth.ended(id);
        let _ = self.pacer.leave(id, why);
    }

    /// Ends streams and lets tools go when the fence is passed.
    async fn watch_fence(self: Arc<Self>) {
        let mut might_act = false;
        loop {
            let may_act = self.pacer.fence.may_act();
            if might_act && !may_act {
                error!("etcd has not confirmed the lease in time: no step is done and nothing is said until it does");
                self.pacer.fall_silent();
            }
            might_act = may_act;
            sleep(LOOK).await;
        }
    }

    /// Reads who is there. Tells the revision.
    pub(super) async fn list_nodes(&self) -> Result<u64> {
        let prefix = self.keys.nodes();
        let (found, revision) = self.etcd.list(&prefix).await.map_err(super::of_etcd)?;
        let name = |key: &str| key.strip_prefix(&prefix).map(str::to_owned);
        let nodes: Nodes = found.iter().filter_map(|found| Some((name(&found.key)?, decode(&found.value)?))).collect();
        self.nodes.send_replace(Arc::new(nodes));
        Ok(revision)
    }

    /// Follows who is there, for ever.
    async fn watch_nodes(self: Arc<Self>) {
        let prefix = self.keys.nodes();
        loop {
            let Ok(revision) = self.list_nodes().await else {
                sleep(PAUSE).await;
                continue;
            };
            let mut watch = self.etcd.watch(&prefix, revision + 1);
            loop {
                let events = match watch.next().await {
                    Ok(events) => events,
                    Err(WatchError::Compacted { .. }) => break,
                    Err(error) => {
                        warn!("{error}");
                        sleep(PAUSE).await;
                        break;
                    }
                };
                let mut nodes = (**self.nodes.borrow()).clone();
                for event in events {
                    match event {
                        WatchEvent::Put(found) => {
                            if let (Some(name), Some(value)) = (found.key.strip_prefix(&prefix), decode(&found.value)) {
                                lock(&self.sent).remove(name);
                                nodes.insert(name.to_owned(), value);
                            }
                        }
                        WatchEvent::Delete { key, .. } => {
                            if let Some(name) = key.strip_prefix(&prefix)
                                && nodes.remove(name).is_some()
                            {
                                warn!(node = name, "a server of the fleet is gone");
                            }
                        }
                    }
                }
                self.peers.keep(|endpoint| nodes.values().any(|node| node.endpoint == endpoint));
                self.nodes.send_replace(Arc::new(nodes));
            }
        }
    }

    /// Tells what this server has to do, when that has changed; forgets deleted sessions. In a large fleet it tells that less often.
    async fn tell(self: Arc<Self>) {
        let mut told = None;
        loop {
            let count = u32::try_from(self.nodes.borrow().len()).unwrap_or(u32::MAX);
            sleep(TELL.max(TELL_EACH * count)).await;
            self.forget_the_deleted().await;
            let own = self.measure();
            if told.as_ref() == Some(&own) && self.nodes.borrow().get(&self.node) == Some(&own) {
                continue;
            }
            told = self.tell_once(&own).await.then_some(own);
        }
    }

    /// Writes the server's key, as this process has left it: so an older process, or one that waited, can't bring it under an older
    /// lease.
    async fn tell_once(&self, own: &NodeValue) -> bool {
        let HeldLease { lease, key_revision } = *lock(&self.held);
        let key = self.keys.node(&self.node);
        let put = Op::Put { key: key.clone(), value: encode(own), lease: Some(lease) };
        let as_left = Compare::ModRevision(key.clone(), key_revision);
        let written = match self.etcd.transact(Txn { if_all: vec![as_left], then: vec![put], otherwise: vec![] }).await
        {
            Ok(outcome) if outcome.succeeded => Some(outcome.revision),
            _ => None,
        };
        let now = match written {
            Some(revision) => Some(revision),
            // It may have been written all the same.
            None => match self.etcd.get(&key).await {
                Ok((found, _)) => found.filter(|found| found.lease == lease).map(|found| found.mod_revision),
                Err(_) => None,
            },
        };
        let mut held = lock(&self.held);
        // Not if it has a new lease by now.
        if let Some(now) = now.filter(|_| held.lease == lease) {
            held.key_revision = held.key_revision.max(now);
        }
        written.is_some()
    }

    /// What this server has to do.
    #[allow(clippy::cast_precision_loss)]
    fn measure(&self) -> NodeValue {
        let sessions = self.pacer.list();
        let share: f64 = sessions.iter().map(|handle| handle.share()).sum();
        let mut own = lock(&self.own);
        own.load = (share / f64::from(own.threads.max(1)) * 100.0).round().abs() / 100.0;
        own.sessions = u32::try_from(sessions.len()).unwrap_or(u32::MAX);
        own.draining = self.is_draining.load(Ordering::Relaxed);
        own.clone()
    }

    /// How this server stands, for Prometheus.
    pub(in crate::server) fn standing(&self) -> Standing {
        let (mirrored_bytes, unmirrored_bytes) = self.growth.mirrored_bytes();
        let owned: Vec<String> = lock(&self.owned).keys().cloned().collect();
        let without_standby = {
            let standbys = lock(&self.standbys);
            let has_one = |id: &&String| standbys.get(*id).is_some_and(|standby| self.is_there(&standby.named));
            owned.iter().filter(|id| !has_one(id)).count()
        };
        Standing {
            acts: self.pacer.fence.may_act(),
            to_fence_s: self.pacer.fence.left_s(),
            nodes: self.nodes.borrow().len(),
            load: lock(&self.own).load,
            sessions: owned.len(),
            without_standby,
            mirrored_bytes,
            unmirrored_bytes,
            taken_over: self.tally.taken_over.get(),
            moved: self.tally.moved.get(),
            lost: self.tally.lost.get(),
        }
    }

    /// The server ends: others may take over at once.
    pub(in crate::server) async fn leave(&self) {
        let until = Instant::now() + Duration::from_secs(2);
        while !self.growth.is_mirrored() && self.nodes.borrow().len() > 1 && Instant::now() < until {
            sleep(LOOK).await;
        }
        self.pacer.fence.set(0);
        self.ended.cancel();
        let lease = lock(&self.held).lease;
        let _ = tokio::time::timeout(Duration::from_secs(1), self.etcd.revoke(lease)).await;
    }
}
