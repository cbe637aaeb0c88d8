//! Sessions whose owner is gone: this server claims those for which it stands by, and goes on with them from their journals.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use futures_util::stream::{self, StreamExt};
use tokio::time::{sleep, timeout};
use tracing::{error, info, warn};

use super::{Fleet, Owned};
use crate::cluster::key::{SessionValue, decode};
use crate::cluster::rules;
use crate::journal::file::JournalFile;
use crate::lock::lock;
use crate::refusal::{Reason, Refusal, Result};

/// It is looked for such sessions so often, and whenever a server comes or goes.
const LOOK: Duration = Duration::from_millis(500);

/// Sessions at once.
const AT_ONCE: usize = 8;

impl Fleet {
    /// Takes over for ever.
    pub(super) async fn take_over(self: Arc<Self>) {
        let mut nodes = self.nodes.subscribe();
        self.settle_own().await;
        loop {
            if self.pacer.fence.may_act() {
                let unsent = self.stand_by.unsent(|node| self.is_there(node));
                stream::iter(unsent).for_each_concurrent(AT_ONCE, |id| self.claim(id)).await;
            }
            let _ = timeout(LOOK, nodes.changed()).await;
        }
    }

    /// Claims a session, if its owner is gone.
    async fn claim(self: &Arc<Self>, id: String) {
        let seen = match self.session_value(&id).await {
            Ok(seen) => seen,
            Err(refusal) => return warn!(session = %id, "{refusal}"),
        };
        let Some((value, revision)) = seen else {
            // It is deleted.
            return self.stand_by.forget(&id);
        };
        // A claim of this server was done after all.
        if value.node == self.node && self.revision(&id).is_none() && !self.pacer.has(&id) {
            return self.go_on_with(id, &value.node, revision).await;
        }
        if value.standby != self.node {
            // Another stands by, or the owner has begun anew.
            if self.is_there(&value.node) {
                self.stand_by.forget(&id);
            }
            return;
        }
        if !rules::may_claim(&value, &self.node, |node| self.is_there(node)) {
            return;
        }
        let claim = rules::claim(&self.keys, &id, (&value, revision), &self.node);
        let is_own = |found: Option<&SessionValue>| found.is_some_and(|value| value.node == self.node);
        match self.transact(claim, &id, is_own).await {
            Ok(Ok(revision)) => {
                self.go_on_with(id, &value.node, revision).await;
            }
            Ok(Err(_)) => {}
            Err(refusal) => warn!(session = %id, "{refusal}"),
        }
    }

    /// Goes on with a session of which this server has become the owner.
    async fn go_on_with(self: &Arc<Self>, id: String, from: &str, revision: u64) {
        lock(&self.owned).insert(id.clone(), Owned::since(revision));
        let (fleet, session) = (self.clone(), id.clone());
        let continued = tokio::task::spawn_blocking(move || fleet.go_on(&session, revision)).await;
        match continued.unwrap_or_else(|error| Err(super::hand_over::broken(&error.to_string()))) {
            Ok(()) => info!(session = %id, from, revision, "session taken over"),
            Err(refusal) => {
                // Its journal stays, and so does its key.
                lock(&self.owned).remove(&id);
                error!(session = %id, "session taken over, but it can't go on: {refusal}");
            }
        }
    }

    /// Goes on with a session from the journal that is here.
    fn go_on(&self, id: &str, revision: u64) -> Result<()> {
        let Some(journals) = self.journals.get() else { return Ok(()) };
        self.stand_by.hand_out(id, journals.folder())?;
        journals.resume(id, revision, &self.pacer, &self.config.limits).inspect(|()| self.tally.taken_over.one_more())
    }

    /// The sessions in this server's folder that are still its own, and the revision of each: they go on here.
    ///
    /// # Errors
    /// Refuses while etcd can't be reached, and a folder that can't be read.
    pub(in crate::server) async fn own_sessions(&self) -> Result<BTreeMap<String, u64>> {
        let folder = self.config.journal.clone().unwrap_or_default();
        let listed = crate::journal::file::list(&folder);
        let files: Vec<JournalFile> = listed.map_err(|error| {
            let message = format!("{}: can't be read: {error}", folder.display());
            Refusal::new(Reason::Unreadable, "journal", message)
        })?;
        let ids: BTreeSet<&str> = files.iter().map(|file| file.session_id.as_str()).collect();
        let mut own = BTreeMap::new();
        for id in ids {
            let Some((value, revision)) = self.session_value(id).await? else {
                let newest = files.iter().rfind(|file| file.session_id == id);
                // One from before the server was of a fleet. One that was of it, and is not in etcd, is deleted.
                let is_new = newest.is_some_and(|file| {
                    crate::journal::Reader::open(&file.path).is_ok_and(|r| r.header().ownership_revision == 0)
                });
                if is_new {
                    let made =
                        self.transact(rules::create(&self.keys, id, &self.node), id, |found| found.is_some()).await?;
                    own.extend(made.ok().map(|revision| (id.to_owned(), revision)));
                }
                continue;
            };
            if value.node == self.node {
                let keep = rules::keep(&self.keys, id, revision, &self.node, "");
                let kept = self.transact(keep, id, |found| found.is_some_and(|value| value.node == self.node)).await?;
                own.extend(kept.ok().map(|revision| (id.to_owned(), revision)));
            }
        }
        lock(&self.owned).extend(own.iter().map(|(id, revision)| (id.clone(), Owned::since(*revision))));
        Ok(own)
    }

    /// Sessions that etcd says are this server's, and that it has not got: who stands by may claim them, and those that nobody can
    /// go on with are forgotten.
    async fn settle_own(&self) {
        let prefix = self.keys.sessions();
        let found = loop {
            match self.etcd.list(&prefix).await {
                Ok((found, _)) => break found,
                Err(error) => {
                    warn!("{error}");
                    sleep(LOOK).await;
                }
            }
        };
        for found in found {
            let (Some(id), Some(value)) = (found.key.strip_prefix(&prefix), decode::<SessionValue>(&found.value))
            else {
                continue;
            };
            if value.node != self.node || lock(&self.owned).contains_key(id) {
                continue;
            }
            warn!(session = %id, "this server has not got this session any more");
            let txn = if value.standby.is_empty() {
                rules::delete(&self.keys, id, found.mod_revision)
            } else {
                rules::give_up(&self.keys, id, found.mod_revision, &value.standby)
            };
            if let Err(refusal) = self.transact(txn, id, |_| true).await {
                warn!(session = %id, "{refusal}");
            }
        }
    }
}
