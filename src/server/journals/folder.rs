//! The folder of journals: its lock, its files, and syncing them to the disk.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::journal;
use palpate_tissue::files;

/// Name of the file that the server using the folder locks.
const LOCK: &str = "lock";

/// Number of tries for the lock of a server that is ending, and the pause between them: 3 s in total.
const LOCK_TRIES: u32 = 150;
const LOCK_PAUSE: Duration = Duration::from_millis(20);

/// Free space below which the disk counts as full, bytes.
const ROOM: u64 = 16 << 20;

/// Number of files up to which they are synced one by one; beyond it, the whole file system at once.
const MAX_SINGLE: usize = 4;

/// An open folder of journals, locked against other servers.
pub(super) struct Folder {
    path: PathBuf,
    /// The folder itself. On Windows a folder is no file, and needs no syncing.
    #[cfg(unix)]
    directory: File,
    _lock: File,
}

impl Folder {
    /// Opens and locks the folder, and creates it if it is missing.
    ///
    /// # Errors
    /// Refuses a path that is not a folder or can't be written, and a folder that another server uses.
    pub(super) fn open(path: &Path) -> Result<Self> {
        let refused =
            |reason, message: String| Refusal::new(reason, "journal", format!("{}: {message}", path.display()));
        let unusable = |error: std::io::Error| refused(Reason::Unreadable, format!("can't be used: {error}"));
        files::create_private_folder(path).map_err(unusable)?;
        #[cfg(unix)]
        let directory = File::open(path).map_err(unusable)?;
        let lock = private().truncate(false).open(path.join(LOCK)).map_err(unusable)?;
        let mut tries = 0;
        loop {
            match lock.try_lock() {
                Ok(()) => break,
                // The previous server may still be ending.
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
        Ok(Folder {
            path: path.to_owned(),
            #[cfg(unix)]
            directory,
            _lock: lock,
        })
    }

    /// Returns the folder's path.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns whether the disk has room for journals to grow for a while.
    pub(super) fn has_room(&self) -> bool {
        #[cfg(unix)]
        let free = rustix::fs::fstatvfs(&self.directory).map(|found| found.f_bavail.saturating_mul(found.f_frsize));
        #[cfg(windows)]
        let free = fs4::available_space(&self.path);
        free.is_ok_and(|bytes| bytes >= ROOM)
    }

    /// Makes all that was written to `files` survive a power failure. `is_new`: some of them were just created.
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
        #[cfg(unix)]
        if is_new {
            self.directory.sync_all()?;
        }
        #[cfg(not(unix))]
        let _ = is_new;
        Ok(())
    }
}

/// Returns options that create a file which only its owner can access.
fn private() -> OpenOptions {
    let mut options = files::private_options();
    options.create(true);
    options
}

/// A file that grows at its end, and is opened when there is something to write.
pub(super) struct Grown {
    path: PathBuf,
    bytes: u64,
    file: Option<File>,
}

impl Grown {
    /// Creates the description of a file that does not exist yet.
    pub(super) fn new(path: PathBuf) -> Self {
        Grown { path, bytes: 0, file: None }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns its length in bytes.
    pub(super) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Appends to its end. On an error, removes what was written partly.
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

    /// Returns the file while it is open.
    pub(super) fn file(&self) -> Option<&File> {
        self.file.as_ref()
    }

    /// Closes a complete file and adds the index by which all tools open it.
    ///
    /// # Errors
    /// Returns the system's error.
    pub(super) fn seal(&mut self) -> std::io::Result<()> {
        self.close();
        journal::seal::seal(&mut File::options().read(true).write(true).open(&self.path)?)
    }

    /// Closes the file. The next append opens it again.
    pub(super) fn close(&mut self) {
        self.file = None;
    }
}
