//! The folder of journals: its lock, its files, and getting them to the disk.

use std::fs::{DirBuilder, File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::journal;

/// Who serves from the folder holds a lock on this file.
const LOCK: &str = "lock";

/// A successor waits so often, and so long each time, for the lock of a server that is ending: 3 s in all.
const LOCK_TRIES: u32 = 150;
const LOCK_PAUSE: Duration = Duration::from_millis(20);

/// Less than this is no room, bytes.
const ROOM: u64 = 16 << 20;

/// So many files are synced one by one; of more, the whole file system at once.
const MAX_SINGLE: usize = 4;

/// A folder that no other server uses while this lives.
pub(super) struct Folder {
    path: PathBuf,
    directory: File,
    _lock: File,
}

impl Folder {
    /// Opens the folder, and makes it if it is not there.
    ///
    /// # Errors
    /// Refuses a path that is no folder or can't be written, and a folder that another server uses.
    pub(super) fn open(path: &Path) -> Result<Self> {
        let refused =
            |reason, message: String| Refusal::new(reason, "journal", format!("{}: {message}", path.display()));
        let unusable = |error: std::io::Error| refused(Reason::Unreadable, format!("can't be used: {error}"));
        DirBuilder::new().recursive(true).mode(0o700).create(path).map_err(unusable)?;
        let directory = File::open(path).map_err(unusable)?;
        let lock = private().truncate(false).open(path.join(LOCK)).map_err(unusable)?;
        let mut tries = 0;
        loop {
            match lock.try_lock() {
                Ok(()) => break,
                // The server before this one may still be ending.
                Err(std::fs::TryLockError::WouldBlock) if tries < LOCK_TRIES => {
                    tries += 1;
                    std::thread::sleep(LOCK_PAUSE);
                }
                Err(std::fs::TryLockError::WouldBlock) => {
                    let message = "another server keeps its journals here; each server needs a folder of its own";
                    return Err(refused(Reason::OutOfTurn, message.to_owned()));
                }
                Err(std::fs::TryLockError::Error(error)) => return Err(unusable(error)),
            }
        }
        Ok(Folder { path: path.to_owned(), directory, _lock: lock })
    }

    /// Its path.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Whether some journals can grow for a while.
    pub(super) fn has_room(&self) -> bool {
        rustix::fs::fstatvfs(&self.directory).is_ok_and(|found| found.f_bavail.saturating_mul(found.f_frsize) >= ROOM)
    }

    /// Makes all that was written to `files` survive a power cut. `is_new`: some of them have just been made.
    ///
    /// # Errors
    /// Returns the system's error.
    pub(super) fn sync<'f>(&self, files: impl ExactSizeIterator<Item = &'f File>, is_new: bool) -> std::io::Result<()> {
        if files.len() > MAX_SINGLE {
            #[cfg(target_os = "linux")]
            return rustix::fs::syncfs(&self.directory).map_err(Into::into);
        }
        for file in files {
            file.sync_data()?;
        }
        if is_new { self.directory.sync_all() } else { Ok(()) }
    }
}

/// A file for its owner alone.
fn private() -> OpenOptions {
    let mut options = File::options();
    options.write(true).create(true).mode(0o600);
    options
}

/// A file that grows at its end, and is opened when there is something to write.
pub(super) struct Grown {
    path: PathBuf,
    bytes: u64,
    file: Option<File>,
}

impl Grown {
    /// A file that is not there yet.
    pub(super) fn new(path: PathBuf) -> Self {
        Grown { path, bytes: 0, file: None }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// How many bytes it has.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Adds to its end. What can't be written whole is taken back.
    ///
    /// # Errors
    /// Returns the system's error.
    pub(super) fn append(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        if self.file.is_none() {
            let file = if self.bytes == 0 {
                private().create_new(true).open(&self.path)?
            } else {
                File::options().append(true).open(&self.path)?
            };
            self.file = Some(file);
        }
        let Some(file) = &mut self.file else { return Err(ErrorKind::NotFound.into()) };
        if let Err(error) = file.write_all(bytes) {
            let _ = file.set_len(self.bytes);
            return Err(error);
        }
        self.bytes += bytes.len() as u64;
        Ok(())
    }

    /// The file, while it is open.
    pub(super) fn file(&self) -> Option<&File> {
        self.file.as_ref()
    }

    /// It is complete: gives it the index by which all tools open it.
    ///
    /// # Errors
    /// Returns the system's error.
    pub(super) fn seal(&mut self) -> std::io::Result<()> {
        self.close();
        journal::seal::seal(&mut File::options().read(true).write(true).open(&self.path)?)
    }

    /// Closes it. The next addition opens it again.
    pub(super) fn close(&mut self) {
        self.file = None;
    }
}
