//! The journals of a server's sessions: written while these run, and read to continue them when the server restarts.

mod folder;
mod keeper;
mod player;
pub(super) mod progress;
mod purge;
pub(super) mod recorded;
mod resume;
pub(super) mod retention;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

pub use retention::Keep;

use super::config::Config;
use super::{journal_key, reload};
use folder::Folder;
use keeper::Keeper;
pub(crate) use keeper::KeeperTally;
use palpate_realtime::event_log::{EventLogQueue, JournalProgress};
use palpate_realtime::priority::{give_way_a_little, thread};
use palpate_realtime::{Pacer, SessionHandle};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::journal::signature::Key;
use palpate_tissue::files;
use palpate_tissue::limits::Limits;
use palpate_tissue::lock::lock;
use progress::Growth;

/// Longest time for which a call waits until a session, or all of it, is on the disk.
const WRITE_TIMEOUT: Duration = Duration::from_secs(5);

/// The journals of a server, and the thread that writes them.
pub(super) struct Journals {
    folder: Arc<Folder>,
    queue: Arc<EventLogQueue>,
    thread: std::sync::Mutex<Option<JoinHandle<()>>>,
    pub(super) tally: Arc<KeeperTally>,
    /// Sessions that could not be continued when the server started.
    left_alone: BTreeSet<String>,
}

impl Journals {
    /// Continues the sessions whose journals are in the configured folder, and records journals from then on. `None`
    /// if no folder is configured. In a fleet, only the sessions in `own` are continued, each with its revision, and
    /// `growth` is notified of what is written.
    ///
    /// # Errors
    /// Refuses a folder that can't be used, or that another server uses. A journal that can't be continued is not an
    /// error: it is logged, and the file stays as it is.
    pub(super) fn open(
        config: &Config,
        pacer: &Arc<Pacer>,
        fleet: Option<(BTreeMap<String, u64>, Arc<Growth>)>,
    ) -> Result<Option<Arc<Self>>> {
        let Some(path) = &config.journal else { return Ok(None) };
        let (own, growth) = fleet.unzip();
        let key = config.journal_key.as_deref().map(signing_key).transpose()?;
        let folder = Arc::new(Folder::open(path)?);
        let (queue, tally) = (pacer.record_events(), Arc::new(KeeperTally::default()));
        let found = resume::all(folder.path(), own.as_ref(), pacer, &config.limits)?;
        let name = |path: &PathBuf| palpate_session::journal::file::parse(path.file_name()?.to_str()?);
        let left_alone = found.left_alone.iter().filter_map(|path| Some(name(path)?.0)).collect();
        let keeper =
            Keeper::new(folder.clone(), (config.journal_keep, key), queue.clone(), tally.clone(), found, growth);
        let work = move || {
            give_way_a_little();
            keeper.work();
        };
        let refused = |error| {
            Refusal::new(Reason::Overloaded, "journal", format!("no thread can be started for the journals: {error}"))
        };
        let keeping = thread("journal").spawn(work).map_err(refused)?;
        Ok(Some(Arc::new(Journals { folder, queue, thread: Some(keeping).into(), tally, left_alone })))
    }

    /// Returns whether a session could not be continued when the server started.
    pub(super) fn has_left_alone(&self, id: &str) -> bool {
        self.left_alone.contains(id)
    }

    /// Returns the path of their folder.
    pub(super) fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// Continues a session whose journal was moved into the folder: from that run, or from the newest. This server
    /// owns it since `revision`.
    ///
    /// # Errors
    /// Refuses a session that can't be continued.
    pub(super) fn resume(
        &self,
        (id, run): (&str, Option<u64>),
        revision: u64,
        pacer: &Pacer,
        limits: &Limits,
    ) -> Result<()> {
        resume::session(self.folder.path(), (id, run), revision, pacer, limits)
    }

    /// Returns whether there is a journal from which a session that is not here can continue.
    pub(super) fn can_go_on(&self, id: &str) -> bool {
        resume::can_go_on(self.folder.path(), id)
    }

    /// Removes the journals of a session that is not here, from `run` on.
    pub(super) fn remove_from(&self, id: &str, run: u64) {
        for file in palpate_session::journal::file::list(self.folder.path()).unwrap_or_default() {
            if file.session_id == id && file.run >= run {
                purge::remove(&file.path);
            }
        }
    }

    /// Writes the remaining events and stops. The stepping threads must have ended.
    pub(super) fn finish(&self) {
        self.queue.stop();
        if let Some(thread) = lock(&self.thread).take() {
            let _ = thread.join();
        }
    }
}

/// Reads the private key that signs the journals from a file.
fn signing_key(path: &Path) -> Result<Key> {
    let refuse = |why: String| {
        let refusal = Refusal::new(Reason::Unreadable, "", why);
        Refusal { place: Some(path.display().to_string()), ..refusal }
    };
    let text = files::read_text(path, files::MAX_SECRET_BYTES)?;
    reload::warn_if_readable(path, "the key of the journals");
    let key = journal_key::private(&text).map_err(|refusal| refuse(refusal.message))?;
    tracing::info!(public_key = %key.public(), "journals are signed");
    Ok(key)
}

/// Waits until the session is durable as configured. Returns the reason if that takes too long or its journal broke.
pub(super) async fn until_durable(handle: &SessionHandle) -> Option<String> {
    until(handle, |progress| progress.durable_step.is_some(), "the session is").await
}

/// Waits until the session is on the disk of this server. Returns the reason if that takes too long or its journal
/// broke.
pub(super) async fn until_on_disk(handle: &SessionHandle) -> Option<String> {
    until(handle, |progress| progress.local_step.is_some(), "the session is").await
}

/// Waits until all of a deleted session is on the disk. Returns the reason if that takes too long or its journal
/// broke.
pub(super) async fn until_complete(handle: &SessionHandle) -> Option<String> {
    until(handle, |progress| progress.is_complete, "the end of the session is").await
}

async fn until(handle: &SessionHandle, is_there: impl Fn(&JournalProgress) -> bool, what: &str) -> Option<String> {
    let mut progress = handle.event_log.as_ref()?.progress();
    let waited =
        tokio::time::timeout(WRITE_TIMEOUT, progress.wait_for(|now| is_there(now) || now.broken.is_some())).await;
    match waited {
        Ok(Ok(now)) => now.broken.as_ref().map(ToString::to_string),
        // The event log is gone: nothing was to be written.
        Ok(Err(_)) => None,
        Err(_) => {
            let seconds = WRITE_TIMEOUT.as_secs();
            Some(format!(
                "{what} not on the disk after {seconds} s: the disk is slow; what happens is written as soon as it can be"
            ))
        }
    }
}
