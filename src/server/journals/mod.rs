//! Journals of a server's sessions: written while they go on, and continued from when the server is started again.

mod folder;
pub(super) mod keep;
mod keeper;
mod old;
mod player;
pub(in crate::server) mod recorded;
mod resume;

use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

pub use keep::Keep;

use super::config::Config;
use crate::lock::lock;
use crate::pace::tape::{Progress, TapeQueue};
use crate::pace::{Live, Pacer};
use crate::priority::{give_way_a_little, thread};
use crate::refusal::{Reason, Refusal, Result};
use folder::Folder;
use keeper::Keeper;
pub(crate) use keeper::KeeperTally;
use player::Player;

/// So long a call waits until a session is on the disk, or all of it.
const PATIENCE: Duration = Duration::from_secs(5);

/// The journals of a server, and the thread that writes them.
pub(super) struct Journals {
    folder: Arc<Folder>,
    queue: Arc<TapeQueue>,
    player: Arc<Player>,
    threads: std::sync::Mutex<Vec<JoinHandle<()>>>,
    pub(super) tally: Arc<KeeperTally>,
}

impl Journals {
    /// Continues the sessions whose journals are in the configured folder, and keeps journals from then on. `None` if no folder is
    /// configured.
    ///
    /// # Errors
    /// Refuses a folder that can't be used, or that another server uses. A journal that can't be continued is no error: that is
    /// logged, and the file stays as it is.
    pub(super) fn open(config: &Config, pacer: &Arc<Pacer>) -> Result<Option<Arc<Self>>> {
        let Some(path) = &config.journal else { return Ok(None) };
        let folder = Arc::new(Folder::open(path)?);
        let (queue, tally) = (pacer.keep_tapes(), Arc::new(KeeperTally::default()));
        let found = resume::all(folder.path(), pacer, &config.limits)?;
        let keeper = Keeper::new(folder.clone(), config.journal_keep, queue.clone(), tally.clone(), found);
        let work = move || {
            give_way_a_little();
            keeper.work();
        };
        let refused = |error| {
            Refusal::new(Reason::Overloaded, "journal", format!("no thread can be started for the journals: {error}"))
        };
        let keeping = thread("journal").spawn(work).map_err(refused)?;
        let player = Arc::new(Player::default());
        let reader = player.clone();
        let playing = thread("player").spawn(move || reader.work()).map_err(refused)?;
        Ok(Some(Arc::new(Journals { folder, queue, player, threads: vec![keeping, playing].into(), tally })))
    }

    /// Writes what there still is, and ends. The stepping threads have ended before.
    pub(super) fn finish(&self) {
        self.queue.stop();
        self.player.stop();
        for thread in lock(&self.threads).drain(..) {
            let _ = thread.join();
        }
    }
}

/// Waits until a session is on the disk; if that takes too long, tells why.
pub(super) async fn until_durable(live: &Live) -> Option<String> {
    until(live, |progress| progress.durable_step.is_some(), "the session is").await
}

/// Waits until all of a session that is deleted is on the disk; if that takes too long, tells why.
pub(super) async fn until_complete(live: &Live) -> Option<String> {
    until(live, |progress| progress.is_complete, "the end of the session is").await
}

async fn until(live: &Live, is_there: impl Fn(&Progress) -> bool, what: &str) -> Option<String> {
    let mut progress = live.tape.as_ref()?.progress();
    let waited = tokio::time::timeout(PATIENCE, progress.wait_for(|now| is_there(now) || now.broken.is_some())).await;
    match waited {
        Ok(Ok(now)) => now.broken.as_ref().map(ToString::to_string),
        // The tape is gone: nothing was to be written.
        Ok(Err(_)) => None,
        Err(_) => {
            let seconds = PATIENCE.as_secs();
            Some(format!(
                "{what} not on the disk after {seconds} s: the disk is slow; what happens is written as soon as it can be"
            ))
        }
    }
}
