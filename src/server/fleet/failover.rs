//! Sessions whose owner is gone: this server claims those for which it stands by, and goes on with them from their journals.

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

/// It is looked for such sessions so often, and whenever a server comes or goes.
const LOOK: Duration = Duration::from_millis(500);

/// A server that starts waits so long till it can keep a session of its own, and tries so often.
const CLAIM_TIMEOUT: Duration = Duration::from_secs(10);
const PAUSE: Duration = Duration::from_millis(100);

/// Sessions at once.
const AT_ONCE: usize = 8;

impl Fleet {
    /// Takes over for ever.
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

    /// Claims a session, if its owner is gone.
    async fn claim(self: &Arc<Self>, id: String) {
        if lock(&self.coming).contains(&id) {
            return;
        }
        if self.revision(&id).is_some() && self.pacer.has(&id) {
            // It goes on here from what is as new.
            return self.stand_by.forget(&id);
        }
        let seen = match self.session_value(&id).await {
            Ok(seen) => seen,
            Err(refusal) => return warn!(session = %id, "{refusal}"),
        };
        let Some((value, revision)) = seen else {
            // It is deleted.
            return self.stand_by.forget(&id);
        };
        let is_own = value.node == self.node;
        if !is_own && value.standby != self.node {
            // Another stands by, or the owner has begun anew.
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
            // A claim of this server was done after all. What was read may be old by now: it counts when it is written again.
            rules::keep(&self.keys, &id, revision, &self.node, "")
        } else {
            // What is here of a course that nobody took must not be gone on with.
            journals.remove_from(&id, run.into());
            rules::claim(&self.keys, &id, (&value, revision), &self.node)
        };
        match self.transact(claim, &id, |found| self.is_own(found, "")).await {
            Ok(Ok(revision)) => self.go_on_with(id, &value.node, revision).await,
            Ok(Err(_)) => {}
            // What became of it shows when it is looked for the next time.
            Err(refusal) => warn!(session = %id, "{refusal}"),
        }
    }

    /// Goes on with a session of which this server has become the owner.
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

    /// Goes on with a session from the journal that is here.
    fn go_on(&self, id: &str, revision: u64) -> Result<()> {
        let Some(journals) = self.journals.get() else { return Ok(()) };
        let run = self.take_newer(id, journals.folder())?;
        journals.resume((id, run), revision, &self.pacer, &self.config.limits)?;
        self.stand_by.forget(id);
        self.tally.taken_over.one_more();
        Ok(())
    }

    /// Takes a journal for which this server stood by into its own, if it is newer than these. Tells its run.
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

    /// The sessions in this server's folder, and those for which it stood by, that are still its own, and the revision of each: they
    /// go on here. It may have claimed one, or been handed it, just before it ended.
    ///
    /// # Errors
    /// Refuses while etcd can't be reached, and a folder that can't be read.
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
                // One from before the server was of a fleet. One that was of it, and is not in etcd, is deleted.
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

    /// Says once more that a session is this server's. What the process before it has asked for may be under way. `None`: another has
    /// it by now.
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

/// The journals of a folder.
fn list(folder: &Path) -> Result<Vec<JournalFile>> {
    palpate_session::journal::file::list(folder).map_err(|error| {
        let message = format!("{}: can't be read: {error}", folder.display());
        Refusal::new(Reason::Unreadable, "journal", message)
    })
}
