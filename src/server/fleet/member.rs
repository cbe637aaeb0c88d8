//! Membership in the fleet: this server's lease in etcd and its fence (the time until which it may act), and the
//! other servers.

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

/// Pause before another try after a failure.
const PAUSE: Duration = Duration::from_millis(100);

/// Time for which a starting server waits for etcd.
const START: Duration = Duration::from_secs(10);

/// Interval between checks of the fence; streams end when it has passed.
const LOOK: Duration = Duration::from_millis(20);

/// Interval at which the server publishes its own state, if it has changed.
const TELL: Duration = Duration::from_millis(500);

/// That interval is at least this times the number of servers, so that etcd gets at most a hundred such writes a
/// second.
const TELL_EACH: Duration = Duration::from_millis(10);

/// Concurrent transactions.
const AT_ONCE: usize = 16;

impl Fleet {
    /// Registers this server's name in etcd. Retries for up to [`START`] if etcd can't be reached, since it may be
    /// starting too.
    ///
    /// # Errors
    /// Returns the errors of [`Fleet::register`].
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

    /// Writes this server's name to etcd, under a new lease.
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
        // The previous process with this folder has ended.
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

    /// Starts the server's work in the fleet: it accepts new sessions, and acts for its own while it has its lease.
    pub(in crate::server) fn begin(self: &Arc<Self>, journals: &Arc<Journals>) {
        let _ = self.journals.set(journals.clone());
        // Sessions that can't be continued keep their journals and their keys. Others that are not here are deleted.
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

    /// Runs `work` until the server leaves the fleet.
    pub(super) fn spawn(&self, work: impl Future<Output = ()> + Send + 'static) -> AbortHandle {
        tokio::spawn(self.ended.clone().run_until_cancelled_owned(work)).abort_handle()
    }

    /// Renews the lease and advances the fence, until the server ends. If the lease has ended, gets a new one and
    /// takes back the sessions that no other server has claimed.
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
                    // The fence stays closed until this server's own sessions are here.
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
                    // Logs it once per outage.
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

    /// Gets a new lease, and takes back the sessions that no other server has claimed. The fence stays closed until
    /// the next renewal. If the new lease ends before all are taken back, starts again.
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

    /// Renews the lease, without advancing the fence, until it has ended.
    async fn until_lease_ends(&self) {
        let lease = lock(&self.held).lease;
        while !matches!(self.etcd.keep_alive(lease).await, Ok(None)) {
            sleep(self.between_keepalives()).await;
        }
    }

    /// Takes back all sessions. Returns whether it is known for each of them who owns it; if not, the lease has
    /// ended.
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

    /// Confirms in etcd that this server owns a session, or gives it up if another does. Returns whether that could
    /// be found out: it can't if the lease has ended.
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
                        .for_each(|handle| handle.set_owned_since(now));
                    return true;
                }
                Ok(Err(Some((value, _)))) if value.node == self.node => return false,
                Ok(Err(found)) => {
                    // Unless the watch of its key has found that before.
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

    /// Returns the refusal of a session that turned out to belong to another server.
    pub(super) fn is_lost(&self, found: Found) -> Refusal {
        let node = found.map_or_else(String::new, |(value, _)| value.node);
        let endpoint = self.nodes.borrow().get(&node).map(|there| there.endpoint.clone());
        elsewhere(&node, endpoint.unwrap_or_default())
    }

    /// Ends a session here that has another owner now.
    pub(super) fn lose(&self, id: &str, why: Refusal) {
        lock(&self.owned).remove(id);
        lock(&self.standbys).remove(id);
        self.growth.ended(id);
        let _ = self.pacer.leave(id, why);
    }

    /// Ends streams and releases tools when the fence has passed.
    async fn watch_fence(self: Arc<Self>) {
        let mut might_act = false;
        loop {
            let may_act = self.pacer.fence.may_act();
            if might_act && !may_act {
                error!("etcd has not confirmed the lease in time: sessions stand still and silent until it does");
                self.pacer.fall_silent();
            }
            might_act = may_act;
            sleep(LOOK).await;
        }
    }

    /// Reads the list of servers from etcd. Returns its revision.
    pub(super) async fn list_nodes(&self) -> Result<u64> {
        let prefix = self.keys.nodes();
        let (found, revision) = self.etcd.list(&prefix).await.map_err(super::of_etcd)?;
        let name = |key: &str| key.strip_prefix(&prefix).map(str::to_owned);
        let nodes: Nodes = found.iter().filter_map(|found| Some((name(&found.key)?, decode(&found.value)?))).collect();
        self.nodes.send_replace(Arc::new(nodes));
        Ok(revision)
    }

    /// Watches which servers are in the fleet, until this server ends.
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

    /// Publishes this server's load when it has changed, and removes deleted sessions from etcd. Larger fleets do so
    /// less often.
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

    /// Writes the server's key if it is unchanged since this process last wrote it, so that neither an older process
    /// nor a delayed request can restore it under an old lease. Returns whether it was written.
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
            // The write may have succeeded all the same.
            None => match self.etcd.get(&key).await {
                Ok((found, _)) => found.filter(|found| found.lease == lease).map(|found| found.mod_revision),
                Err(_) => None,
            },
        };
        let mut held = lock(&self.held);
        // Not if it has a new lease in the meantime.
        if let Some(now) = now.filter(|_| held.lease == lease) {
            held.key_revision = held.key_revision.max(now);
        }
        written.is_some()
    }

    /// Measures this server's load and number of sessions.
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

    /// Returns the state of this server in the fleet, for Prometheus.
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

    /// Leaves the fleet, so that others can take over at once. Waits up to 2 s until the journals are replicated.
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
