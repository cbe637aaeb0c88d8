//! Repairs entries in etcd that name this server as owner of sessions it does not have: the result of transactions
//! whose outcome nobody learned, and of lost folders.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::{Instant, sleep, timeout};
use tracing::warn;

use super::Fleet;
use palpate_cluster::key::{SessionValue, decode};
use palpate_cluster::rules;
use palpate_refusal::Result;
use palpate_tissue::lock::lock;

/// Time for which a wrong entry must persist before it is repaired: a session may just be created or received.
const AGAIN: Duration = Duration::from_secs(3);

/// Time within which a transaction with an unknown result shows its effect, if it has any.
const SHOWS: Duration = Duration::from_secs(30);

/// Interval between checks without such a transaction.
const RARELY: Duration = Duration::from_secs(600);

/// Sessions that were not found here, and the revisions of their keys.
type Missing = BTreeMap<String, u64>;

impl Fleet {
    /// Checks and repairs entries until the server ends.
    pub(super) async fn settle(self: Arc<Self>) {
        let mut missing = Missing::new();
        let mut until = Instant::now() + SHOWS;
        loop {
            match self.look_for_missing(&missing).await {
                Ok(found) => missing = found,
                Err(refusal) => warn!("{refusal}"),
            }
            let is_quiet = missing.is_empty() && Instant::now() > until;
            let waited = timeout(if is_quiet { RARELY } else { AGAIN }, self.unsettled.notified()).await;
            if waited.is_ok() {
                until = Instant::now() + SHOWS;
                sleep(AGAIN).await;
            }
        }
    }

    /// Repairs the entries that were `missing` before and still are. Returns those that are missing for the first
    /// time.
    async fn look_for_missing(self: &Arc<Self>, missing: &Missing) -> Result<Missing> {
        let prefix = self.keys.sessions();
        let (found, _) = self.etcd.list(&prefix).await.map_err(super::of_etcd)?;
        let mut new = Missing::new();
        for found in found {
            let (Some(id), Some(value)) = (found.key.strip_prefix(&prefix), decode::<SessionValue>(&found.value))
            else {
                continue;
            };
            if value.node != self.node || lock(&self.left_alone).contains(id) {
                continue;
            }
            let Some(_coming) = self.comes(id) else { continue };
            if missing.get(id) == Some(&found.mod_revision) {
                self.settle_one(id, &value, found.mod_revision).await;
            } else {
                new.insert(id.to_owned(), found.mod_revision);
            }
        }
        Ok(new)
    }

    /// Repairs the entry of one session. If its journal is here, continues it. Otherwise gives it up to its standby,
    /// or deletes its key if it has none.
    async fn settle_one(self: &Arc<Self>, id: &str, value: &SessionValue, revision: u64) {
        let (fleet, session) = (self.clone(), id.to_owned());
        let is_here = tokio::task::spawn_blocking(move || {
            let can_go_on = |journals: &Arc<_>| crate::server::journals::Journals::can_go_on(journals, &session);
            fleet.stand_by.whole_run(&session).is_some() || fleet.journals.get().is_some_and(can_go_on)
        });
        // If the check failed, the entry stays as it is.
        let Ok(is_here) = is_here.await else { return };
        if is_here {
            let keep = rules::keep(&self.keys, id, revision, &self.node, "");
            return match self.transact(keep, id, |found| self.is_own(found, "")).await {
                Ok(Ok(now)) => self.go_on_with(id.to_owned(), &self.node, now).await,
                Ok(Err(_)) => {}
                Err(refusal) => warn!(session = %id, "{refusal}"),
            };
        }
        warn!(session = %id, "this server does not have this session any more");
        let txn = if value.standby.is_empty() {
            rules::delete(&self.keys, id, revision)
        } else {
            rules::give_up(&self.keys, id, revision, &value.standby)
        };
        if let Err(refusal) = self.transact(txn, id, |_| true).await {
            warn!(session = %id, "{refusal}");
        }
    }
}
