//! The thread that writes journals (`journal`): it takes the events that the event logs of all sessions hold, appends
//! them to their files, and syncs these together. No session waits for it.

use std::collections::{BTreeMap, BTreeSet};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Weak};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use super::folder::{Folder, Grown};
use super::progress::Growth;
use super::purge;
use super::retention::Keep;
use palpate_realtime::Leaving;
use palpate_realtime::clock::now_ns;
use palpate_realtime::event_log::{About, Beginning, Event, EventLog, EventLogQueue, Noted};
use palpate_session::journal::signature::Key;
use palpate_session::journal::{self, JournalWriter, Opening, pb};

/// Minimum interval between two rounds of syncs: what happens in between is written together.
const ROUND: Duration = Duration::from_millis(20);

/// Interval between searches for old journals.
const SWEEP: Duration = Duration::from_secs(60);

/// Interval at which a disk that was full is checked again.
const RETRY: Duration = Duration::from_secs(2);

/// The thread's counters of its own work, for the metrics.
#[derive(Debug, Default)]
pub(crate) struct KeeperTally {
    /// Bytes that were written.
    pub(crate) bytes: AtomicU64,
    /// Rounds of syncs.
    pub(crate) rounds: AtomicU64,
    /// Journals that broke, because they could not be written.
    pub(crate) broken: AtomicU64,
    /// Time from the newest event until it was on the disk, in the last round, ns.
    pub(crate) lag_ns: AtomicU64,
}

/// A session's journal while it is written.
struct OpenJournal {
    event_log: Arc<EventLog>,
    /// `None` once it is complete.
    writer: Option<JournalWriter>,
    file: Grown,
    /// Whether nothing of it is on the disk yet.
    is_new: bool,
}

pub(super) struct Keeper {
    folder: Arc<Folder>,
    keep: Keep,
    /// The key that signs what is written, if any.
    key: Option<Key>,
    queue: Arc<EventLogQueue>,
    tally: Arc<KeeperTally>,
    /// The newest run of each session that was found in the folder or has started. A session's runs are its
    /// successive journals.
    runs: BTreeMap<String, u64>,
    /// Journals that could not be continued: they stay as they are.
    left_alone: BTreeSet<PathBuf>,
    entries: BTreeMap<String, OpenJournal>,
    /// Event logs of sessions that returned before their previous journal was complete.
    waiting: Vec<Arc<EventLog>>,
    /// Event logs that broke because there was no space or because the disk was too slow.
    without_room: Vec<Weak<EventLog>>,
    /// Receives what was written, for the replication of journals.
    growth: Option<Arc<Growth>>,
    /// Whether the ages of files can be trusted.
    ages: purge::Ages,
}

/// What a folder contained at the start.
#[derive(Debug, Default)]
pub(super) struct FolderContent {
    /// The newest run of each session.
    pub(super) runs: BTreeMap<String, u64>,
    /// Journals of sessions that were not continued, although they have not ended.
    pub(super) left_alone: BTreeSet<PathBuf>,
}

/// What was written for one session in a round.
struct Written {
    id: String,
    until_step: u64,
    batches: u64,
    noted_ns: u64,
    is_still: bool,
}

impl Keeper {
    pub(super) fn new(
        folder: Arc<Folder>,
        (keep, key): (Keep, Option<Key>),
        queue: Arc<EventLogQueue>,
        tally: Arc<KeeperTally>,
        found: FolderContent,
        growth: Option<Arc<Growth>>,
    ) -> Self {
        let FolderContent { runs, left_alone } = found;
        let (entries, waiting, without_room) = (BTreeMap::new(), Vec::new(), Vec::new());
        let ages = purge::Ages::default();
        Keeper { folder, keep, key, queue, tally, runs, left_alone, entries, waiting, without_room, growth, ages }
    }

    /// Writes journals until the queue is stopped and everything in it is written.
    pub(super) fn work(mut self) {
        let (mut swept_ns, mut begun_ns, mut tried_ns) = (0, 0, 0);
        while let Some(mut event_logs) = self.queue.wait(Some(if self.without_room.is_empty() { SWEEP } else { RETRY }))
        {
            let now = now_ns();
            if let Some(rest) = ROUND.checked_sub(Duration::from_nanos(now.saturating_sub(begun_ns)))
                && !self.queue.is_stopped()
            {
                std::thread::sleep(rest);
                event_logs.extend(self.queue.take());
            }
            begun_ns = now_ns();
            self.round(&event_logs);
            if begun_ns > tried_ns + RETRY.as_nanos() as u64 {
                tried_ns = begun_ns;
                self.try_again();
            }
            if swept_ns == 0 || begun_ns > swept_ns + SWEEP.as_nanos() as u64 {
                swept_ns = begun_ns;
                self.sweep();
            }
        }
        self.finish();
    }

    /// Writes the events of these logs and syncs them; several logs of one session one after another.
    fn round(&mut self, event_logs: &[Arc<EventLog>]) {
        let mut left = std::mem::take(&mut self.waiting);
        left.extend_from_slice(event_logs);
        loop {
            let mut now: BTreeMap<String, Arc<EventLog>> = BTreeMap::new();
            for event_log in std::mem::take(&mut left) {
                let id = &event_log.about.id;
                let is_another = |of: &Arc<EventLog>| !Arc::ptr_eq(of, &event_log);
                let others = [now.get(id), self.entries.get(id).map(|entry| &entry.event_log)];
                if others.into_iter().flatten().any(is_another) {
                    left.push(event_log);
                } else {
                    now.insert(id.clone(), event_log);
                }
            }
            if now.is_empty() {
                self.waiting = left;
                return;
            }
            self.write_all(now.values());
        }
    }

    fn write_all<'t>(&mut self, event_logs: impl Iterator<Item = &'t Arc<EventLog>>) {
        let written: Vec<Written> = event_logs.filter_map(|event_log| self.write(event_log)).collect();
        if written.is_empty() {
            return;
        }
        let is_new = written.iter().any(|written| self.entries.get(&written.id).is_some_and(|entry| entry.is_new));
        let files: Vec<_> = written.iter().filter_map(|written| self.entries.get(&written.id)?.file.file()).collect();
        let synced = self.folder.sync(files.into_iter(), is_new);
        self.tally.rounds.fetch_add(1, Ordering::Relaxed);
        let now = now_ns();
        for Written { id, until_step, batches, noted_ns, is_still } in written {
            if let Err(error) = &synced {
                self.break_off(&id, "written data can't be flushed to the disk", error);
                continue;
            }
            let Some(entry) = self.entries.get_mut(&id) else { continue };
            entry.is_new = false;
            if let Some(writer) = &mut entry.writer {
                writer.durable(batches);
            }
            let lag_ns = now.saturating_sub(noted_ns);
            self.tally.lag_ns.store(lag_ns, Ordering::Relaxed);
            #[allow(clippy::cast_precision_loss)]
            entry.event_log.set_durable(until_step, lag_ns as f64 * 1e-9);
            if is_still {
                entry.file.close();
            }
            if entry.writer.is_none() {
                self.complete(&id);
            }
        }
    }

    /// Writes the events of one log. `None` if there are none, or they can't be written.
    fn write(&mut self, event_log: &Arc<EventLog>) -> Option<Written> {
        let taken = event_log.take();
        let id = event_log.about.id.clone();
        if taken.has_overflowed {
            self.forget(&id);
            self.without_room.push(Arc::downgrade(event_log));
        }
        if taken.is_broken {
            return None;
        }
        if !self.entries.contains_key(&id) {
            self.begin(event_log, taken.anew);
        }
        let entry = self.entries.get_mut(&id)?;
        let mut writer = entry.writer.take()?;
        let noted_ns = taken.events.last().map_or_else(now_ns, |noted| noted.at_ns);
        let mut left = None;
        for Noted { step, event, .. } in taken.events {
            match event {
                Event::Input(input) => writer.input(step, &input),
                Event::Hash(copy) => writer.hash(step, copy.state_hash()),
                Event::Snapshot(saved, copy) => {
                    writer.snapshot(step, copy.state_hash(), copy.model(), saved.to_bytes());
                }
                Event::Felt(felt) => writer.felt(step, &felt),
                Event::Waiting(changes) => writer.waiting(&changes),
                Event::Left(leaving) => left = Some(leaving),
            }
        }
        if left == Some(Leaving::Withdrawn) {
            self.withdraw(&id);
            return None;
        }
        let bytes = if let Some(leaving) = left {
            let (why, message) = match leaving {
                Leaving::Deleted => (pb::Why::Deleted, "the session was deleted"),
                Leaving::Moved | Leaving::Withdrawn => (pb::Why::Moved, "another server of the fleet has the session"),
            };
            writer.finish(why, message, taken.until_step, unix_ns())
        } else {
            let bytes = writer.flush(taken.until_step, unix_ns());
            entry.writer = Some(writer);
            bytes
        };
        let (until_step, batches) =
            entry.writer.as_ref().map_or((taken.until_step, 0), |w| (w.until_step(), w.batches()));
        if bytes.is_empty() {
            return None;
        }
        self.append(&id, &bytes)?;
        if let (Some(growth), Some(entry)) = (&self.growth, self.entries.get(&id)) {
            growth.grew(&entry.event_log, self.runs.get(&id).copied().unwrap_or_default(), &entry.file, until_step);
        }
        Some(Written { id, until_step, batches, noted_ns, is_still: taken.is_still })
    }

    fn append(&mut self, id: &str, bytes: &[u8]) -> Option<()> {
        self.tally.bytes.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        let entry = self.entries.get_mut(id)?;
        if let Err(error) = entry.file.append(bytes) {
            self.break_off(id, "the journal can't be written", &error);
            return None;
        }
        Some(())
    }

    /// Starts the journal of a session, at the beginning of its event log or where that started again.
    fn begin(&mut self, event_log: &Arc<EventLog>, anew: Option<Beginning>) {
        let About { id, owner, idle_timeout_s, first, begin_step, running, until_step, after_run, revision, exercise } =
            &event_log.about;
        let first_of = Beginning { step: *begin_step, running: *running, until_step: *until_step };
        let Beginning { step: begin_step, running, until_step } = anew.unwrap_or(first_of);
        let run = self.runs.entry(id.clone()).or_default();
        *run = (*run).max(*after_run) + 1;
        let opening = Opening {
            session_id: id,
            run: *run,
            owner,
            idle_timeout_s: *idle_timeout_s,
            first,
            begin_step,
            running,
            until_step,
            ownership_revision: *revision,
            exercise: exercise.as_ref().map(|(chosen, trainee_id)| journal::exercise::recorded(chosen, trainee_id)),
        };
        let file = Grown::new(self.folder.path().join(journal::file::name(id, *run)));
        let writer = JournalWriter::new(&opening, unix_ns()).signed(self.key.as_ref());
        let entry = OpenJournal { event_log: event_log.clone(), writer: Some(writer), file, is_new: true };
        self.entries.insert(id.clone(), entry);
        event_log.begins(u32::try_from(*run).unwrap_or(u32::MAX));
        if anew.is_some() {
            tracing::info!(session = %id, run = *run, step = begin_step, "the journal of a session starts again");
        }
    }

    /// Completes the journal of a deleted session: removes it, or seals it with an index.
    fn complete(&mut self, id: &str) {
        let Some(mut entry) = self.entries.remove(id) else { return };
        self.runs.remove(id);
        if let Some(growth) = &self.growth {
            growth.complete(id, entry.event_log.progress().borrow().run);
        }
        if self.keep.age.is_zero() {
            purge::remove(entry.file.path());
        } else {
            seal(&mut entry.file);
        }
        entry.event_log.set_complete();
    }

    /// Removes the journal of a session that was expected and did not arrive. Its run is not used again.
    fn withdraw(&mut self, id: &str) {
        let Some(mut entry) = self.entries.remove(id) else { return };
        entry.file.close();
        purge::remove(entry.file.path());
        entry.event_log.set_complete();
    }

    /// Removes journals that are too old or exceed the size limit, and forgets broken ones.
    fn sweep(&mut self) {
        self.entries.retain(|_, entry| entry.event_log.progress().borrow().broken.is_none());
        let current = |path: &Path| self.entries.values().any(|entry| entry.file.path() == path);
        purge::sweep(self.folder.path(), self.keep, &mut self.ages, |path| {
            current(path) || self.left_alone.contains(path)
        });
    }

    /// Ends every journal with the entry that the server ended, and syncs and seals them.
    fn finish(&mut self) {
        let mut ended = Vec::new();
        for (id, entry) in &mut self.entries {
            let Some(writer) = entry.writer.take() else { continue };
            let until_step = writer.until_step();
            ended.push((
                id.clone(),
                until_step,
                writer.finish(pb::Why::Drained, "the server ended", until_step, unix_ns()),
            ));
        }
        ended.retain(|(id, _, bytes)| self.append(id, bytes).is_some());
        let files: Vec<_> = ended.iter().filter_map(|(id, ..)| self.entries.get(id)?.file.file()).collect();
        if let Err(error) = self.folder.sync(files.into_iter(), false) {
            tracing::error!(%error, "the ends of the journals can't be synced to the disk");
        }
        for (id, until_step, _) in ended {
            if let Some(entry) = self.entries.get_mut(&id) {
                entry.event_log.set_durable(until_step, 0.0);
                seal(&mut entry.file);
            }
        }
    }

    /// Breaks the journal of a session, whose file can't be written. It restarts if only space was missing.
    fn break_off(&mut self, id: &str, what: &str, error: &std::io::Error) {
        let Some(event_log) = self.forget(id) else { return };
        event_log.break_off(&format!("{what}: {error}"));
        if matches!(error.kind(), ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge) {
            self.without_room.push(Arc::downgrade(&event_log));
        }
    }

    /// Counts a broken journal, and closes its file as it is. Returns its event log, if the journal had begun.
    fn forget(&mut self, id: &str) -> Option<Arc<EventLog>> {
        self.tally.broken.fetch_add(1, Ordering::Relaxed);
        let mut entry = self.entries.remove(id)?;
        entry.file.close();
        // A run without any data does not count.
        if entry.file.bytes() == 0 {
            purge::remove(entry.file.path());
            self.runs.get_mut(id).into_iter().for_each(|run| *run = run.saturating_sub(1));
        }
        Some(entry.event_log)
    }

    /// Restarts the journals that broke for lack of space or of time, if there is space now.
    fn try_again(&mut self) {
        if !self.without_room.is_empty() && self.folder.has_room() {
            self.without_room
                .drain(..)
                .filter_map(|event_log| event_log.upgrade())
                .for_each(|event_log| event_log.may_begin_anew());
        }
    }
}

/// Adds an index to a complete journal. Without one, it is read from its beginning.
fn seal(file: &mut Grown) {
    if let Err(error) = file.seal() {
        tracing::warn!(path = %file.path().display(), %error, "a journal is complete, but can't be indexed");
    }
}

/// Returns the wall-clock time, ns since 1970.
#[allow(clippy::disallowed_methods)]
pub(super) fn unix_ns() -> u64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)
}
