//! Values built from files, and built again when the files change: certificates, keys, tokens.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::sync::watch;
use tokio::time::MissedTickBehavior;
use tracing::{info, warn};
use xxhash_rust::xxh3::xxh3_128;

use palpate_realtime::clock::now_ns;
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::files;
use palpate_tissue::lock::lock;

/// Interval between two checks. They compare contents, not times, so a changed symbolic link counts too.
const INTERVAL: Duration = Duration::from_millis(500);

/// Time after which a check is reported as too slow: the files may be on a disk that does not answer.
const CHECK_TIMEOUT: Duration = Duration::from_secs(5);

/// Time during which an empty file counts as being written, ns; after that it takes effect as an empty file.
const EMPTY_NS: u64 = 60_000_000_000;

/// Builds the value from the files' texts, in the order of their paths.
type Make<T> = Box<dyn Fn(&[String]) -> Result<T> + Send + Sync>;

/// A value built from files that follows their changes.
pub(super) struct Reloaded<T> {
    what: &'static str,
    paths: Vec<PathBuf>,
    make: Make<T>,
    current: Mutex<Arc<T>>,
    /// The number of changes so far.
    version: watch::Sender<u64>,
    /// Why the files' contents are not in use; `None` if they are.
    problem: watch::Sender<Option<Refusal>>,
    last_read: Mutex<LastRead>,
}

/// The result of the last check.
struct LastRead {
    /// Hash of the texts that were used last, valid or not.
    digest: u128,
    /// The error in those texts, if they are invalid.
    error: Option<Refusal>,
    /// Since when one of the files is empty, ns.
    empty_since_ns: Option<u64>,
}

impl<T: Send + Sync + 'static> Reloaded<T> {
    /// Reads the files and builds the first value.
    ///
    /// # Errors
    /// Returns an error if a file can't be read or its contents are invalid.
    pub(super) fn load(
        what: &'static str,
        paths: Vec<PathBuf>,
        make: impl Fn(&[String]) -> Result<T> + Send + Sync + 'static,
    ) -> Result<Self> {
        let texts = read(&paths)?;
        let current = Mutex::new(Arc::new(make(&texts)?));
        let last_read = Mutex::new(LastRead { digest: digest(&texts), error: None, empty_since_ns: None });
        let (version, problem) = (watch::Sender::new(0), watch::Sender::new(None));
        Ok(Reloaded { what, paths, make: Box::new(make), current, version, problem, last_read })
    }

    /// Returns the current value.
    pub(super) fn get(&self) -> Arc<T> {
        lock(&self.current).clone()
    }

    /// Returns the number of changes so far.
    pub(super) fn version(&self) -> u64 {
        *self.version.borrow()
    }

    /// Returns a receiver that is notified of each change.
    pub(super) fn changes(&self) -> watch::Receiver<u64> {
        self.version.subscribe()
    }

    /// Returns a receiver of the reason why the files' contents are not in use; `None` while they are.
    pub(super) fn problems(&self) -> watch::Receiver<Option<Refusal>> {
        self.problem.subscribe()
    }

    /// Checks the files. If they have changed, builds the value again; if they are invalid, keeps the old value and
    /// reports the reason.
    fn refresh(&self, now_ns: u64) {
        let checked = read(&self.paths).and_then(|texts| self.take(&texts, now_ns));
        self.report(checked.err());
    }

    /// Uses the files' texts, unless one of them is still being written.
    fn take(&self, texts: &[String], now_ns: u64) -> Result<()> {
        let mut last = lock(&self.last_read);
        let empty = texts.iter().position(String::is_empty);
        let Some(index) = empty else {
            last.empty_since_ns = None;
            return self.replace(&mut last, texts);
        };
        let since_ns = *last.empty_since_ns.get_or_insert(now_ns);
        if now_ns.saturating_sub(since_ns) >= EMPTY_NS {
            return self.replace(&mut last, texts);
        }
        let message = format!("is empty; if it stays empty for {} s, it takes effect", EMPTY_NS / 1_000_000_000);
        Err(of_file(&self.paths[index])(Refusal::new(Reason::Unreadable, "", message)))
    }

    fn replace(&self, last: &mut LastRead, texts: &[String]) -> Result<()> {
        let digest = digest(texts);
        if last.digest != digest {
            last.digest = digest;
            last.error = match (self.make)(texts) {
                Ok(value) => {
                    *lock(&self.current) = Arc::new(value);
                    self.version.send_modify(|version| *version += 1);
                    info!("{}: new files are in use", self.what);
                    None
                }
                Err(refusal) => Some(refusal),
            };
        }
        last.error.clone().map_or(Ok(()), Err)
    }

    /// Logs and publishes a problem, or that there is none any longer, once per change.
    fn report(&self, problem: Option<Refusal>) {
        self.problem.send_if_modified(|reported| {
            if *reported == problem {
                return false;
            }
            match &problem {
                Some(refusal) => warn!(%refusal, "{}: the new files are invalid; the old ones stay in use", self.what),
                None => info!("{}: the files are valid again", self.what),
            }
            *reported = problem;
            true
        });
    }

    /// Checks the files at a fixed interval, and at once on SIGHUP; never completes. The checks run on a blocking
    /// thread, because a file may be on a disk that does not answer.
    pub(super) async fn watch(self: Arc<Self>) {
        let mut ticks = tokio::time::interval(INTERVAL);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        #[cfg(unix)]
        let mut hangups = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::hangup()).ok();
        loop {
            #[cfg(unix)]
            let hangup = async {
                match &mut hangups {
                    Some(hangups) => hangups.recv().await,
                    None => std::future::pending().await,
                }
            };
            #[cfg(not(unix))]
            let hangup = std::future::pending::<()>();
            tokio::select! {
                _ = ticks.tick() => {}
                _ = hangup => info!("{}: SIGHUP: checking the files", self.what),
            }
            let this = self.clone();
            let mut checking = tokio::task::spawn_blocking(move || this.refresh(now_ns()));
            if tokio::time::timeout(CHECK_TIMEOUT, &mut checking).await.is_err() {
                let message = format!("the files could not be read within {} s", CHECK_TIMEOUT.as_secs());
                self.report(Some(Refusal::new(Reason::TimedOut, self.what, message)));
                let _ = checking.await;
            }
        }
    }
}

fn read(paths: &[PathBuf]) -> Result<Vec<String>> {
    paths.iter().map(|path| files::read_regular_text(path, files::MAX_SECRET_BYTES)).collect()
}

fn digest(texts: &[String]) -> u128 {
    let mut bytes = Vec::new();
    for text in texts {
        bytes.extend((text.len() as u64).to_le_bytes());
        bytes.extend(text.as_bytes());
    }
    xxh3_128(&bytes)
}

/// Warns if every user of this machine has access to a file that holds a secret.
pub(super) fn warn_if_readable(path: &Path, what: &str) {
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        if std::fs::metadata(path).is_ok_and(|meta| meta.permissions().mode() & 0o007 != 0) {
            warn!("{}: every user of this machine has access to {what}; run `chmod o= {0}`", path.display());
        }
    }
    #[cfg(not(unix))]
    let _ = (path, what);
}

/// Adds the file's path to a refusal.
pub(super) fn of_file(path: &Path) -> impl Fn(Refusal) -> Refusal + '_ {
    |refusal| Refusal { place: Some(path.display().to_string()), ..refusal }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_file_takes_effect_after_a_while() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("words");
        std::fs::write(&path, "old").unwrap();
        let words = Reloaded::load("words", vec![path.clone()], |texts| Ok(texts[0].clone())).unwrap();
        let says = |now_ns: u64| {
            words.refresh(now_ns);
            (words.get().to_string(), words.problems().borrow().is_some())
        };
        assert_eq!(says(1), ("old".into(), false));
        std::fs::write(&path, "").unwrap();
        assert_eq!(says(2), ("old".into(), true));
        assert_eq!(says(1 + EMPTY_NS), ("old".into(), true));
        assert_eq!(says(2 + EMPTY_NS), (String::new(), false));
        // A write in between restarts the time.
        std::fs::write(&path, "new").unwrap();
        assert_eq!(says(3 + EMPTY_NS), ("new".into(), false));
        std::fs::write(&path, "").unwrap();
        assert_eq!(says(4 + EMPTY_NS), ("new".into(), true));
        assert_eq!(words.version(), 2);
    }

    #[cfg(unix)]
    #[test]
    fn a_pipe_is_reported_and_does_not_block() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("words");
        std::fs::write(&path, "old").unwrap();
        let words = Reloaded::load("words", vec![path.clone()], |texts| Ok(texts[0].clone())).unwrap();
        std::fs::remove_file(&path).unwrap();
        words.refresh(1);
        assert!(words.problems().borrow().as_ref().is_some_and(|why| why.message.contains("opened")));
        assert!(std::process::Command::new("mkfifo").arg(&path).status().unwrap().success());
        words.refresh(2);
        assert!(words.problems().borrow().as_ref().is_some_and(|why| why.message == "is not a regular file"));
        assert_eq!(*words.get(), "old");
        std::fs::remove_file(&path).unwrap();
        std::fs::write(&path, "old").unwrap();
        words.refresh(3);
        assert_eq!((words.version(), words.problems().borrow().clone()), (0, None));
    }
}
