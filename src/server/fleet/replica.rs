//! The journals of sessions for which this server is the standby: received, written, and synced.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};

use super::positional_io::write_all_at;
use palpate_proto::pb;

use palpate_realtime::clock::now_ns;
use palpate_realtime::ids::random_id;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::journal;
use palpate_tissue::files;
use palpate_tissue::lock::lock;

/// Subfolder for these journals, in the folder of journals.
const FOLDER: &str = "standby";

/// File with the server's own random number, in the folder of journals.
const INSTANCE: &str = "node";

fn unusable(path: &Path, error: &std::io::Error) -> Refusal {
    Refusal::new(Reason::Unreadable, "journal", format!("{}: can't be used: {error}", path.display()))
}

/// Returns the random number of the server whose journals are in `folder`; creates it if there is none.
///
/// # Errors
/// Refuses a folder that can't be used, and a number that can't be read.
pub(super) fn instance(folder: &Path) -> Result<String> {
    let path = folder.join(INSTANCE);
    if path.symlink_metadata().is_ok() {
        return Ok(files::read_regular_text(&path, files::MAX_SECRET_BYTES)?.trim().to_owned());
    }
    let id = random_id()?;
    std::fs::write(&path, &id).map_err(|error| unusable(&path, &error))?;
    Ok(id)
}

/// A journal for which this server is the standby.
#[derive(Debug, Clone, PartialEq, Eq)]
struct ReplicaFile {
    run: u32,
    bytes: u64,
    /// The server that sends it or sent it last; empty if that was before this process.
    from: String,
    /// Number of the stream that sends it; 0 if none does now.
    stream: u64,
    /// Since when no stream sends it, ns.
    since_ns: u64,
}

/// Time for which an unneeded journal is kept after its stream has ended, ns: a transaction that names this server
/// may still be in flight.
const KEEPS_NS: u64 = 30_000_000_000;

/// The journals for which this server is the standby, by session.
pub(super) struct StandBy {
    folder: PathBuf,
    kept: Mutex<BTreeMap<String, ReplicaFile>>,
    /// Number of streams so far.
    streams: AtomicU64,
}

impl StandBy {
    /// Opens the journals that are on the disk. Creates the folder if it is missing.
    ///
    /// # Errors
    /// Refuses a folder that can't be used.
    pub(super) fn open(journals: &Path) -> Result<Self> {
        let folder = journals.join(FOLDER);
        files::create_private_folder(&folder).map_err(|error| unusable(&folder, &error))?;
        let mut kept = BTreeMap::new();
        for file in journal::file::list(&folder).map_err(|error| unusable(&folder, &error))? {
            let bytes = std::fs::metadata(&file.path).map_or(0, |metadata| metadata.len());
            // Sorted by run, so the newest remains.
            let run = u32::try_from(file.run).unwrap_or(u32::MAX);
            kept.insert(
                file.session_id,
                ReplicaFile { run, bytes, from: String::new(), stream: 0, since_ns: now_ns() },
            );
        }
        Ok(StandBy { folder, kept: Mutex::new(kept), streams: 0.into() })
    }

    fn path(&self, id: &str, run: u32) -> PathBuf {
        self.folder.join(journal::file::name(id, u64::from(run)))
    }

    /// Returns all journals, with their runs and lengths.
    pub(super) fn list(&self) -> Vec<pb::Mirrored> {
        let kept = lock(&self.kept);
        let of = |(id, kept): (&String, &ReplicaFile)| pb::Mirrored {
            session_id: id.clone(),
            run: kept.run,
            durable_bytes: kept.bytes,
        };
        kept.iter().map(of).collect()
    }

    /// Returns the number of a new stream, from 1.
    pub(super) fn new_stream(&self) -> u64 {
        self.streams.fetch_add(1, Ordering::Relaxed) + 1
    }

    /// Records that a server sends over `stream` from now on. Returns all journals that are here.
    pub(super) fn stream_begins(&self, node: &str, stream: u64) -> Vec<pb::Mirrored> {
        lock(&self.kept).values_mut().filter(|kept| kept.from == node).for_each(|kept| kept.stream = stream);
        self.list()
    }

    /// Records that a stream has ended.
    pub(super) fn stream_ended(&self, stream: u64) {
        let by_it = |kept: &&mut ReplicaFile| kept.stream == stream;
        for kept in lock(&self.kept).values_mut().filter(by_it) {
            (kept.stream, kept.since_ns) = (0, now_ns());
        }
    }

    /// Returns the sessions whose journals no running server sends: no stream does, or that of a server that is gone.
    /// A frozen server keeps its stream.
    pub(super) fn unsent(&self, is_there: impl Fn(&str) -> bool) -> Vec<String> {
        let kept = lock(&self.kept);
        let unsent = kept.iter().filter(|(_, kept)| kept.stream == 0 || !is_there(&kept.from));
        unsent.map(|(id, _)| id.clone()).collect()
    }

    /// Returns whether a journal has not been sent for so long ([`KEEPS_NS`]) that it is no longer needed.
    pub(super) fn is_long_unsent(&self, id: &str) -> bool {
        let is_long = |kept: &ReplicaFile| kept.stream == 0 && now_ns().saturating_sub(kept.since_ns) > KEEPS_NS;
        lock(&self.kept).get(id).is_some_and(is_long)
    }

    /// Returns the run of a session's journal that is here, if the session can be continued from it.
    pub(super) fn whole_run(&self, id: &str) -> Option<u32> {
        let run = lock(&self.kept).get(id)?.run;
        journal::JournalReader::open(&self.path(id, run)).is_ok().then_some(run)
    }

    /// Writes the parts that a server has sent over a stream, and syncs them. Returns how far the journals are on the
    /// disk. Skips runs older than those here: they come from a server that has lost the session and does not know it
    /// yet.
    ///
    /// # Errors
    /// Refuses parts that do not continue what is here, and those that can't be written.
    pub(super) fn take(&self, (node, stream): (&str, u64), parts: &[pb::MirrorPart]) -> Result<Vec<pb::Mirrored>> {
        let mut files: BTreeMap<(&str, u32), File> = BTreeMap::new();
        let mut taken: BTreeMap<&str, pb::Mirrored> = BTreeMap::new();
        for pb::MirrorPart { session_id, run, offset, bytes } in parts {
            let name = journal::file::name(session_id, u64::from(*run));
            if journal::file::parse(&name).is_none() {
                return Err(Refusal::new(Reason::OutOfRange, "session_id", "is not the ID of a session"));
            }
            let path = self.path(session_id, *run);
            let known = lock(&self.kept).get(session_id).map(|kept| (kept.run, kept.bytes));
            if known.is_some_and(|(newest, _)| *run < newest) {
                continue;
            }
            let known = known.filter(|(of, _)| of == run).map_or(0, |(_, bytes)| bytes);
            let there = if *offset == 0 { 0 } else { known };
            if *offset != there {
                let message = format!("is {offset}, but {there} bytes are there");
                return Err(Refusal::new(Reason::OutOfTurn, "offset", message));
            }
            let failed = |error: std::io::Error| unusable(&path, &error);
            let key = (session_id.as_str(), *run);
            if *offset == 0 || !files.contains_key(&key) {
                let mut options = files::private_options();
                let file = options.create(true).truncate(*offset == 0).open(&path).map_err(failed)?;
                files.insert(key, file);
            }
            write_all_at(&files[&key], bytes, *offset).map_err(failed)?;
            let bytes = offset + bytes.len() as u64;
            let kept = ReplicaFile { run: *run, bytes, from: node.to_owned(), stream, since_ns: 0 };
            let before = lock(&self.kept).insert(session_id.clone(), kept);
            if let Some(before) = before.filter(|before| before.run < *run) {
                let _ = std::fs::remove_file(self.path(session_id, before.run));
            }
            let at = pb::Mirrored { session_id: session_id.clone(), run: *run, durable_bytes: bytes };
            taken.insert(session_id, at);
        }
        for ((id, run), file) in &files {
            file.sync_data().map_err(|error| unusable(&self.path(id, *run), &error))?;
        }
        Ok(taken.into_values().collect())
    }

    /// Removes the journal of a session that this server is no longer the standby of.
    pub(super) fn forget(&self, id: &str) {
        if let Some(kept) = lock(&self.kept).remove(id) {
            let _ = std::fs::remove_file(self.path(id, kept.run));
        }
    }

    /// Removes the journal of a session if it came from that server.
    pub(super) fn forget_from(&self, node: &str, id: &str) {
        let is_its = lock(&self.kept).get(id).is_some_and(|kept| kept.from == node);
        if is_its {
            self.forget(id);
        }
    }

    /// Moves a journal into `folder`, to continue the session from it. Returns its run.
    ///
    /// # Errors
    /// Refuses if there is none, or it can't be moved.
    pub(super) fn hand_out(&self, id: &str, folder: &Path) -> Result<u32> {
        let missing = || Refusal::new(Reason::UnknownSession, "session_id", "no journal of this session is here");
        let kept = lock(&self.kept).remove(id).ok_or_else(missing)?;
        let from = self.path(id, kept.run);
        let to = folder.join(journal::file::name(id, u64::from(kept.run)));
        std::fs::rename(&from, &to).map_err(|error| unusable(&from, &error))?;
        Ok(kept.run)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(id: &str, run: u32, offset: u64, bytes: &[u8]) -> pb::MirrorPart {
        pb::MirrorPart { session_id: id.to_owned(), run, offset, bytes: bytes.to_vec() }
    }

    #[test]
    fn parts_of_a_journal_come_in_order_and_stay_over_a_restart() {
        let folder = tempfile::tempdir().unwrap();
        let stand_by = StandBy::open(folder.path()).unwrap();
        let from_a = ("a", stand_by.new_stream());
        let at =
            stand_by.take(from_a, &[part("s1", 1, 0, b"ab"), part("s1", 1, 2, b"cd"), part("s2", 7, 0, b"x")]).unwrap();
        assert_eq!(at.iter().map(|at| at.durable_bytes).collect::<Vec<_>>(), [4, 1]);
        // A gap, a path, and an offset of another run.
        for bad in [part("s1", 1, 9, b"z"), part("../s1", 1, 0, b"z"), part("s1", 2, 4, b"z")] {
            assert!(stand_by.take(from_a, &[bad]).is_err());
        }
        // A newer stream of the same server keeps its journals when the older one ends. If the server is gone, they
        // count as unsent.
        let newer = stand_by.new_stream();
        assert_eq!(stand_by.stream_begins("a", newer).len(), 2);
        stand_by.stream_ended(from_a.1);
        assert!(stand_by.unsent(|node| node == "a").is_empty());
        assert_eq!(stand_by.unsent(|_| false), ["s1", "s2"]);
        stand_by.stream_ended(newer);
        assert_eq!(stand_by.unsent(|node| node == "a"), ["s1", "s2"]);
        // Not immediately: etcd may still name this server.
        assert!(!stand_by.is_long_unsent("s1"));
        let again = StandBy::open(folder.path()).unwrap();
        assert_eq!(again.list().iter().map(|at| at.durable_bytes).collect::<Vec<_>>(), [4, 1]);
        // The next run replaces the one before, of which no further parts are accepted.
        let from_b = ("b", again.new_stream());
        again.take(from_b, &[part("s1", 2, 0, b"n")]).unwrap();
        assert!(!folder.path().join("standby/s1.1.mcap").exists());
        assert_eq!(again.take(("a", again.new_stream()), &[part("s1", 1, 0, b"old")]).unwrap(), []);
        assert_eq!(again.whole_run("s1"), None);
        // Only the server that has sent it can have it removed.
        again.forget_from("a", "s1");
        assert_eq!(again.hand_out("s1", folder.path()).unwrap(), 2);
        assert_eq!(std::fs::read(folder.path().join("s1.2.mcap")).unwrap(), b"n");
        again.forget("s2");
        assert!(again.list().is_empty() && again.hand_out("s2", folder.path()).is_err());
    }

    #[test]
    fn a_server_keeps_its_number() {
        let folder = tempfile::tempdir().unwrap();
        let first = instance(folder.path()).unwrap();
        assert_eq!(instance(folder.path()).unwrap(), first);
    }
}
