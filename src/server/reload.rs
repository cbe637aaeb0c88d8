//! Something that is made from files, and made anew when they change: certificates, keys, tokens.

use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::sync::watch;
use tracing::{info, warn};
use xxhash_rust::xxh3::xxh3_128;

use crate::pace::queue::lock;
use crate::refusal::{Refusal, Result};
use crate::scene::document::read_text;

/// How often the files are looked at: contents, not times, so that a link that is turned counts as well.
const EVERY: Duration = Duration::from_secs(1);

/// Bytes of one file.
const MOST_BYTES: u64 = 1 << 20;

/// Makes the value of the files' texts, in the order of their paths.
type Make<T> = Box<dyn Fn(&[String]) -> Result<T> + Send + Sync>;

/// A value made of files.
pub(super) struct Reloaded<T> {
    what: &'static str,
    paths: Vec<PathBuf>,
    make: Make<T>,
    current: Mutex<Arc<T>>,
    /// How often it has changed.
    version: watch::Sender<u64>,
    /// Of the texts that were looked at last, or why they could not be read.
    seen: Mutex<Result<u128>>,
}

impl<T> Reloaded<T> {
    /// Reads the files for the first time.
    pub(super) fn load(
        what: &'static str,
        paths: Vec<PathBuf>,
        make: impl Fn(&[String]) -> Result<T> + Send + Sync + 'static,
    ) -> Result<Self> {
        let texts = read(&paths)?;
        let current = Mutex::new(Arc::new(make(&texts)?));
        let seen = Mutex::new(Ok(digest(&texts)));
        Ok(Reloaded { what, paths, make: Box::new(make), current, version: watch::Sender::new(0), seen })
    }

    /// What holds now.
    pub(super) fn get(&self) -> Arc<T> {
        lock(&self.current).clone()
    }

    /// How often it has changed.
    pub(super) fn version(&self) -> u64 {
        *self.version.borrow()
    }

    /// Tells of each change.
    pub(super) fn changes(&self) -> watch::Receiver<u64> {
        self.version.subscribe()
    }

    /// Looks at the files. If they have changed, what they say holds from now on; if that makes no sense, what held before.
    fn refresh(&self) {
        let texts = read(&self.paths);
        let digest = texts.as_deref().map(digest).map_err(Clone::clone);
        if *lock(&self.seen) == digest {
            return;
        }
        match texts.and_then(|texts| (self.make)(&texts)) {
            Ok(value) => {
                *lock(&self.current) = Arc::new(value);
                self.version.send_modify(|version| *version += 1);
                info!("{}: new files are in use", self.what);
            }
            Err(refusal) => warn!(%refusal, "{}: the new files are of no use, the old ones hold", self.what),
        }
        *lock(&self.seen) = digest;
    }

    /// Looks at the files for ever.
    pub(super) async fn watch(&self) {
        let mut ticks = tokio::time::interval(EVERY);
        loop {
            ticks.tick().await;
            self.refresh();
        }
    }
}

fn read(paths: &[PathBuf]) -> Result<Vec<String>> {
    paths.iter().map(|path| read_text(path, MOST_BYTES)).collect()
}

fn digest(texts: &[String]) -> u128 {
    let mut bytes = Vec::new();
    for text in texts {
        bytes.extend((text.len() as u64).to_le_bytes());
        bytes.extend(text.as_bytes());
    }
    xxh3_128(&bytes)
}

/// Others on this machine can read a file that holds a secret.
pub(super) fn warn_if_readable(path: &std::path::Path, what: &str) {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        if std::fs::metadata(path).is_ok_and(|meta| meta.permissions().mode() & 0o007 != 0) {
            warn!("{}: every user of this machine can get at {what}; `chmod o= {0}` ends that", path.display());
        }
    }
    #[cfg(not(unix))]
    let _ = (path, what);
}

/// `refusal`, of the file it is about.
pub(super) fn of_file(path: &std::path::Path) -> impl Fn(Refusal) -> Refusal + '_ {
    |refusal| Refusal { place: Some(path.display().to_string()), ..refusal }
}
