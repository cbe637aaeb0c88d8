//! Tracks how far the journals of this server have grown and were replicated, for the fleet.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use tokio::sync::Notify;

use super::folder::Grown as Growing;
use palpate_realtime::event_log::EventLog;
use palpate_tissue::lock::lock;

/// Maximum number of positions per journal whose steps are remembered. A replica that is further behind is counted
/// when it has caught up.
const MAX_POSITIONS: usize = 256;

/// The journal of a session, with its progress.
struct TrackedJournal {
    run: u32,
    path: PathBuf,
    bytes: u64,
    /// Pairs of a length in bytes and the step up to which the journal is then complete.
    steps: VecDeque<(u64, u64)>,
    event_log: Arc<EventLog>,
    /// The most bytes of it that any other server has had.
    mirrored_bytes: u64,
}

/// A growing journal: its place and length.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::server) struct Grown {
    pub(in crate::server) session_id: String,
    pub(in crate::server) run: u32,
    pub(in crate::server) path: PathBuf,
    pub(in crate::server) bytes: u64,
}

/// The growing journals of this server.
#[derive(Default)]
pub(in crate::server) struct Growth {
    files: Mutex<BTreeMap<String, TrackedJournal>>,
    news: Notify,
    /// Replicated bytes of all journals so far.
    mirrored_bytes: AtomicU64,
}

impl Growth {
    /// Records that a journal has grown, and is complete up to `step`. Notifies those that wait for news.
    pub(super) fn grew(&self, event_log: &Arc<EventLog>, run: u64, file: &Growing, step: u64) {
        let (path, bytes) = (file.path(), file.bytes());
        let run = u32::try_from(run).unwrap_or(u32::MAX);
        let mut files = lock(&self.files);
        let new = || TrackedJournal {
            run,
            path: path.to_owned(),
            bytes,
            steps: VecDeque::new(),
            event_log: event_log.clone(),
            mirrored_bytes: 0,
        };
        let file = files.entry(event_log.about.id.clone()).or_insert_with(new);
        if file.run != run {
            *file = new();
        }
        file.bytes = bytes;
        if file.steps.len() >= MAX_POSITIONS {
            file.steps.pop_front();
        }
        file.steps.push_back((bytes, step));
        drop(files);
        self.news.notify_waiters();
    }

    /// Stops tracking a session's journal.
    pub(in crate::server) fn ended(&self, session_id: &str) {
        lock(&self.files).remove(session_id);
        self.news.notify_waiters();
    }

    /// Stops tracking a session's journal if that run is the current one.
    pub(super) fn complete(&self, session_id: &str, run: u32) {
        let mut files = lock(&self.files);
        if files.get(session_id).is_some_and(|file| file.run == run) {
            files.remove(session_id);
        }
    }

    /// Returns a future that completes when a journal grows after this call.
    pub(in crate::server) fn news(&self) -> tokio::sync::futures::Notified<'_> {
        self.news.notified()
    }

    /// Returns the journals of the sessions that `chosen` accepts.
    pub(in crate::server) fn chosen(&self, chosen: impl Fn(&str) -> bool) -> Vec<Grown> {
        let files = lock(&self.files);
        let theirs = files.iter().filter(|(id, _)| chosen(id));
        theirs
            .map(|(id, file)| Grown {
                session_id: id.clone(),
                run: file.run,
                path: file.path.clone(),
                bytes: file.bytes,
            })
            .collect()
    }

    /// Records that `bytes` of a run are replicated. Returns the event log and the step up to which they are
    /// complete.
    pub(in crate::server) fn mirrored(&self, session_id: &str, run: u32, bytes: u64) -> Option<(Arc<EventLog>, u64)> {
        let mut files = lock(&self.files);
        let file = files.get_mut(session_id).filter(|file| file.run == run)?;
        // A new standby starts from the beginning: what another one had before is counted once.
        let more = bytes.min(file.bytes).saturating_sub(file.mirrored_bytes);
        file.mirrored_bytes += more;
        self.mirrored_bytes.fetch_add(more, Ordering::Relaxed);
        let covered = file.steps.partition_point(|(at, _)| *at <= bytes);
        let (_, step) = file.steps.get(covered.checked_sub(1)?)?;
        Some((file.event_log.clone(), *step))
    }

    /// Returns the bytes that other servers have had on their disks so far, and those of growing journals that none
    /// has had.
    pub(in crate::server) fn mirrored_bytes(&self) -> (u64, u64) {
        let unmirrored = lock(&self.files).values().map(|file| file.bytes.saturating_sub(file.mirrored_bytes)).sum();
        (self.mirrored_bytes.load(Ordering::Relaxed), unmirrored)
    }

    /// Returns whether all journals are replicated in full.
    pub(in crate::server) fn is_mirrored(&self) -> bool {
        lock(&self.files).values().all(|file| file.mirrored_bytes >= file.bytes)
    }
}
