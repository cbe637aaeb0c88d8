//! The journals of sessions for which this server stands by: received, written, and synced.

use std::collections::BTreeMap;
use std::fs::{DirBuilder, File};
use std::os::unix::fs::{DirBuilderExt, FileExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use palpate_proto::pb;

use crate::ids::random_id;
use crate::journal;
use crate::lock::lock;
use crate::refusal::{Reason, Refusal, Result};

/// Where they are, in the folder of journals.
const FOLDER: &str = "standby";

/// Where the server's own random number is, in the folder of journals.
const INSTANCE: &str = "node";

fn unusable(path: &Path, error: &std::io::Error) -> Refusal {
    Refusal::new(Reason::Unreadable, "journal", format!("{}: can't be used: {error}", path.display()))
}

/// The number of the server whose journals are in `folder`; a new one if there is none.
///
/// # Errors
/// Refuses a folder that can't be used.
pub(super) fn instance(folder: &Path) -> Result<String> {
    let path = folder.join(INSTANCE);
    match std::fs::read_to_string(&path) {
        Ok(text) => Ok(text.trim().to_owned()),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            let id = random_id()?;
            std::fs::write(&path, &id).map_err(|error| unusable(&path, &error))?;
            Ok(id)
        }
        Err(error) => Err(unusable(&path, &error)),
    }
}

/// A journal for which this server stands by.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Kept {
    run: u32,
    bytes: u64,
    /// The server that sends it; empty if none does now.
    from: String,
}

/// The journals for which this server stands by.
pub(super) struct StandBy {
    folder: PathBuf,
    kept: Mutex<BTreeMap<String, Kept>>,
}

impl StandBy {
    /// Those that are on the disk.
    ///
    /// # Errors
    /// Refuses a folder that can't be used.
    pub(super) fn open(journals: &Path) -> Result<Self> {
        let folder = journals.join(FOLDER);
        DirBuilder::new().recursive(true).mode(0o700).create(&folder).map_err(|error| unusable(&folder, &error))?;
        let mut kept = BTreeMap::new();
        for file in journal::file::list(&folder).map_err(|error| unusable(&folder, &error))? {
            let bytes = std::fs::metadata(&file.path).map_or(0, |metadata| metadata.len());
            // By ascending run: the newest stays.
            let run = u32::try_from(file.run).unwrap_or(u32::MAX);
            kept.insert(file.session_id, Kept { run, bytes, from: String::new() });
        }
        Ok(StandBy { folder, kept: Mutex::new(kept) })
    }

    fn path(&self, id: &str, run: u32) -> PathBuf {
        self.folder.join(journal::file::name(id, u64::from(run)))
    }

    /// All that is there, for a server that begins to send.
    pub(super) fn list(&self) -> Vec<pb::Mirrored> {
        let kept = lock(&self.kept);
        let of = |(id, kept): (&String, &Kept)| pb::Mirrored {
            session_id: id.clone(),
            run: kept.run,
            durable_bytes: kept.bytes,
        };
        kept.iter().map(of).collect()
    }

    /// Sessions whose journals no server sends now: none of those that `is_there`. A server that is frozen keeps its stream.
    pub(super) fn unsent(&self, is_there: impl Fn(&str) -> bool) -> Vec<String> {
        lock(&self.kept).iter().filter(|(_, kept)| !is_there(&kept.from)).map(|(id, _)| id.clone()).collect()
    }

    /// A server sends no more.
    pub(super) fn ended_from(&self, node: &str) {
        lock(&self.kept).values_mut().filter(|kept| kept.from == node).for_each(|kept| kept.from.clear());
    }

    /// Writes what a server has sent, and gets it to the disk. Tells how far the journals are there.
    ///
    /// # Errors
    /// Refuses parts that do not fit what is there, and what can't be written.
    pub(super) fn take(&self, node: &str, parts: &[pb::MirrorPart]) -> Result<Vec<pb::Mirrored>> {
        let mut files: BTreeMap<(&str, u32), File> = BTreeMap::new();
        let mut taken: BTreeMap<&str, pb::Mirrored> = BTreeMap::new();
        for pb::MirrorPart { session_id, run, offset, bytes } in parts {
            let name = journal::file::name(session_id, u64::from(*run));
            if journal::file::parse(&name).is_none() {
                return Err(Refusal::new(Reason::OutOfRange, "session_id", "is no ID of a session"));
            }
            let path = self.path(session_id, *run);
            let known = lock(&self.kept).get(session_id).filter(|kept| kept.run == *run).map(|kept| kept.bytes);
            let there = if *offset == 0 { 0 } else { known.unwrap_or(0) };
            if *offset != there {
                let message = format!("is {offset}, but {there} bytes are there");
                return Err(Refusal::new(Reason::OutOfTurn, "offset", message));
            }
            let failed = |error: std::io::Error| unusable(&path, &error);
            let key = (session_id.as_str(), *run);
            if *offset == 0 || !files.contains_key(&key) {
                let mut options = File::options();
                let file =
                    options.write(true).create(true).truncate(*offset == 0).mode(0o600).open(&path).map_err(failed)?;
                files.insert(key, file);
            }
            files[&key].write_all_at(bytes, *offset).map_err(failed)?;
            let bytes = offset + bytes.len() as u64;
            let before = lock(&self.kept).insert(session_id.clone(), Kept { run: *run, bytes, from: node.to_owned() });
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

    /// This server stands by for a session no longer.
    pub(super) fn forget(&self, id: &str) {
        if let Some(kept) = lock(&self.kept).remove(id) {
            let _ = std::fs::remove_file(self.path(id, kept.run));
        }
    }

    /// Takes a journal out, to go on with it from `folder`. Tells its run.
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
        let at =
            stand_by.take("a", &[part("s1", 1, 0, b"ab"), part("s1", 1, 2, b"cd"), part("s2", 7, 0, b"x")]).unwrap();
        assert_eq!(at.iter().map(|at| at.durable_bytes).collect::<Vec<_>>(), [4, 1]);
        // A gap, a path, and an offset of another run.
        for bad in [part("s1", 1, 9, b"z"), part("../s1", 1, 0, b"z"), part("s1", 2, 4, b"z")] {
            assert!(stand_by.take("a", &[bad]).is_err());
        }
        assert!(stand_by.unsent(|node| node == "a").is_empty());
        stand_by.ended_from("a");
        assert_eq!(stand_by.unsent(|node| node == "a"), ["s1", "s2"]);
        let again = StandBy::open(folder.path()).unwrap();
        assert_eq!(again.list().iter().map(|at| at.durable_bytes).collect::<Vec<_>>(), [4, 1]);
        // The next run takes the place of the one before.
        again.take("b", &[part("s1", 2, 0, b"n")]).unwrap();
        assert!(!folder.path().join("standby/s1.1.mcap").exists());
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
