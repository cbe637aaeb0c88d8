//! Takes over sessions whose owner is gone: this server claims those for which it is the standby, and continues them
//! from their journals.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use futures_util::stream::{self, StreamExt};
use tokio::time::{Instant, sleep, timeout};
use tracing::{error, info, warn};

use super::{Fleet, Owned};
use palpate_cluster::rules;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::journal::file::JournalFile;
use palpate_tissue::lock::lock;

/// Interval between searches for orphaned sessions. A search also runs when a server joins or leaves.
const LOOK: Duration = Duration::from_millis(500);

/// Longest time a starting server tries to reclaim a session of its own, and the pause between tries.
const CLAIM_TIMEOUT: Duration = Duration::from_secs(10);
const PAUSE: Duration = Duration::from_millis(100);

/// Sessions that are claimed concurrently.
const AT_ONCE: usize = 8;

impl Fleet {
    /// Runs until the server ends: claims sessions whose owner is gone.
    pub(super) async fn take_over(self: Arc<Self>) {
        let mut nodes = self.nodes.subscribe();
        loop {
            if self.pacer.fence.may_act() {
                let unsent = self.stand_by.unsent(|node| self.is_there(node));
                stream::iter(unsent).for_each_concurrent(AT_ONCE, |id| self.claim(id)).await;
            }
            let _ = timeout(LOOK, nodes.changed()).await;
        }
    }

    /// Claims a session if its owner is gone, and continues it here.
    async fn claim(self: &Arc<Self>, id: String) {
        if lock(&self.coming).contains(&id) {
            return;
        }
        if self.revision(&id).is_some() && self.pacer.has(&id) {
            // It already runs here, from a state at least as new.
            return self.stand_by.forget(&id);
        }
        let seen = match self.session_value(&id).await {
            Ok(seen) => seen,
            Err(refusal) => return warn!(session = %id, "{refusal}"),
        };
        let Some((value, revision)) = seen else {
            // The session is deleted.
            return self.stand_by.forget(&id);
        };
        let is_own = value.node == self.node;
        if !is_own && value.standby != self.node {
            // Another server is its standby, or the owner has started a new journal.
            if self.is_there(&value.node) && self.stand_by.is_long_unsent(&id) {
                self.stand_by.forget(&id);
            }
            return;
        }
        if !is_own && !rules::may_claim(&value, &self.node, |node| self.is_there(node)) {
            return;
        }
        let (Some(_coming), Some(run), Some(journals)) =
            (self.comes(&id), self.stand_by.whole_run(&id), self.journals.get())
        else {
            return;
        };
        if lock(&self.left_alone).contains(&id) {
            return;
        }
        let claim = if is_own {
            // An earlier claim of ours succeeded. The value read may be outdated, so confirm it with another write.
            rules::keep(&self.keys, &id, revision, &self.node, "")
        } else {
            // Delete local journal data of a branch that no server continued.
            journals.remove_from(&id, run.into());
            rules::claim(&self.keys, &id, (&value, revision), &self.node)
        };
        match self.transact(claim, &id, |found| self.is_own(found, "")).await {
            Ok(Ok(revision)) => self.go_on_with(id, &value.node, revision).await,
            Ok(Err(_)) => {}
            // The next search finds out what became of the claim.
            Err(refusal) => warn!(session = %id, "{refusal}"),
        }
    }

    /// Continues a session of which this server has become the owner. If that fails, logs the error and leaves its
    /// journal and key as they are.
    pub(super) async fn go_on_with(self: &Arc<Self>, id: String, from: &str, revision: u64) {
        lock(&self.owned).insert(id.clone(), Owned::since(revision));
        let (fleet, session) = (self.clone(), id.clone());
        let continued = tokio::task::spawn_blocking(move || fleet.go_on(&session, revision)).await;
        match continued.unwrap_or_else(|error| Err(super::migrate::broken(&error.to_string()))) {
            Ok(()) => info!(session = %id, from, revision, "session taken over"),
            Err(refusal) => {
                // Its journal stays, and so does its key.
                lock(&self.left_alone).insert(id.clone());
                lock(&self.owned).remove(&id);
                error!(session = %id, "session taken over, but it can't go on: {refusal}");
            }
        }
    }

    /// Continues a session from the journal on this server.
    fn go_on(&self, id: &str, revision: u64) -> Result<()> {
        let Some(journals) = self.journals.get() else { return Ok(()) };
        let run = self.take_newer(id, journals.folder())?;
        journals.resume((id, run), revision, &self.pacer, &self.config.limits)?;
        self.stand_by.forget(id);
        self.tally.taken_over.one_more();
        Ok(())
    }

    /// Moves a journal that this server kept as a standby to its own journals, if it is newer than these. Returns its
    /// run, the number of the recording; `None` if it is not newer.
    ///
    /// # Errors
    /// Refuses if it can't be moved.
    fn take_newer(&self, id: &str, folder: &Path) -> Result<Option<u64>> {
        let own = list(folder)?.into_iter().filter(|file| file.session_id == id).map(|file| file.run).max();
        match self.stand_by.whole_run(id) {
            Some(run) if u64::from(run) > own.unwrap_or_default() => {
                Ok(Some(self.stand_by.hand_out(id, folder)?.into()))
            }
            _ => Ok(None),
        }
    }

    /// Returns the sessions that this server still owns, with their revisions: those in its folder, and those for
    /// which it was the standby. They continue here. It may have claimed one, or been handed it, just before it
    /// ended.
    ///
    /// # Errors
    /// Refuses if etcd can't be reached or a folder can't be read.
    pub(in crate::server) async fn own_sessions(&self) -> Result<BTreeMap<String, u64>> {
        let folder = self.config.journal.clone().unwrap_or_default();
        let files = list(&folder)?;
        let stood_by = self.stand_by.list();
        let ids: BTreeSet<&str> =
            files.iter().map(|file| &*file.session_id).chain(stood_by.iter().map(|at| &*at.session_id)).collect();
        let mut own = BTreeMap::new();
        for id in ids {
            let Some((value, revision)) = self.session_value(id).await? else {
                let newest = files.iter().rfind(|file| file.session_id == id);
                // A journal from before the server belonged to a fleet. One written in the fleet that is not in etcd
                // is deleted.
                let is_new = newest.is_some_and(|file| {
                    palpate_session::journal::JournalReader::open(&file.path)
                        .is_ok_and(|r| r.header().ownership_revision == 0)
                });
                if is_new {
                    let made =
                        self.transact(rules::create(&self.keys, id, &self.node), id, |found| found.is_some()).await?;
                    own.extend(made.ok().map(|revision| (id.to_owned(), revision)));
                }
                continue;
            };
            if value.node == self.node
                && let Some(revision) = self.keep_own(id, revision).await?
            {
                self.take_newer(id, &folder)?;
                own.insert(id.to_owned(), revision);
            }
        }
        lock(&self.owned).extend(own.iter().map(|(id, revision)| (id.clone(), Owned::since(*revision))));
        Ok(own)
    }

    /// Confirms ownership again, since a request of the previous process may still be in flight. Returns the new
    /// revision; `None`: another server owns it.
    async fn keep_own(&self, id: &str, mut revision: u64) -> Result<Option<u64>> {
        let until = Instant::now() + CLAIM_TIMEOUT;
        loop {
            let keep = |revision| rules::keep(&self.keys, id, revision, &self.node, "");
            match self.change(id, revision, keep, |found| self.is_own(found, "")).await {
                Ok(Ok(now)) => return Ok(Some(now)),
                // The lease has ended, and this server gets another.
                Ok(Err(Some((value, now)))) if value.node == self.node && Instant::now() < until => revision = now,
                Ok(Err(Some((value, _)))) if value.node == self.node => {
                    return Err(Refusal::new(Reason::Fenced, "cluster", "this server can't keep its lease"));
                }
                Ok(Err(_)) => return Ok(None),
                Err(refusal) if Instant::now() >= until => return Err(refusal),
                Err(refusal) => warn!(session = %id, "{refusal}"),
            }
            sleep(PAUSE).await;
        }
    }
}

/// Lists the journals in a folder.
fn list(folder: &Path) -> Result<Vec<JournalFile>> {
    palpate_session::journal::file::list(folder).map_err(|error| {
        let message = format!("{}: can't be read: {error}", folder.display());
        Refusal::new(Reason::Unreadable, "journal", message)
    })
}
