//! Something that is made from files, and made anew when they change: certificates, keys, tokens.

use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::sync::watch;
use tokio::time::MissedTickBehavior;
use tracing::{info, warn};
use xxhash_rust::xxh3::xxh3_128;

use crate::lock::lock;
use crate::pace::clock::now_ns;
use crate::refusal::{Reason, Refusal, Result};

/// How often the files are looked at: contents, not times, so that a link that is turned counts as well.
const EVERY: Duration = Duration::from_millis(500);

/// A look that takes longer is trouble: the files are on a disk that does not answer.
const PATIENCE: Duration = Duration::from_secs(5);

/// Bytes of one file.
const MOST_BYTES: u64 = 1 << 20;

/// A file without a byte is one that somebody is writing, for so long. Then it says what it says: nothing.
const EMPTY_NS: u64 = 60_000_000_000;

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
    /// Why what the files hold is not in force, if it is not.
    trouble: watch::Sender<Option<Refusal>>,
    seen: Mutex<Seen>,
}

/// What was looked at last.
struct Seen {
    /// Of the texts that are in force, or are of no use.
    digest: u128,
    /// What is wrong with those.
    useless: Option<Refusal>,
    /// Since when a file is empty.
    empty_since_ns: Option<u64>,
}

impl<T: Send + Sync + 'static> Reloaded<T> {
    /// Reads the files for the first time.
    pub(super) fn load(
        what: &'static str,
        paths: Vec<PathBuf>,
        make: impl Fn(&[String]) -> Result<T> + Send + Sync + 'static,
    ) -> Result<Self> {
        let texts = read(&paths)?;
        let current = Mutex::new(Arc::new(make(&texts)?));
        let seen = Mutex::new(Seen { digest: digest(&texts), useless: None, empty_since_ns: None });
        let (version, trouble) = (watch::Sender::new(0), watch::Sender::new(None));
        Ok(Reloaded { what, paths, make: Box::new(make), current, version, trouble, seen })
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

    /// Tells whether what the files hold is in force, or why not.
    pub(super) fn troubles(&self) -> watch::Receiver<Option<Refusal>> {
        self.trouble.subscribe()
    }

    /// Looks at the files. If they have changed, what they say holds from now on; if that makes no sense, what held before,
    /// and that is told.
    fn refresh(&self, now_ns: u64) {
        let trouble = read(&self.paths).and_then(|texts| self.take(&texts, now_ns));
        self.tell(trouble.err());
    }

    /// Puts what the files say in force, or tells why not.
    fn take(&self, texts: &[String], now_ns: u64) -> Result<()> {
        let mut seen = lock(&self.seen);
        let empty = texts.iter().position(String::is_empty);
        let Some(index) = empty else {
            seen.empty_since_ns = None;
            return self.replace(&mut seen, texts);
        };
        let since_ns = *seen.empty_since_ns.get_or_insert(now_ns);
        if now_ns.saturating_sub(since_ns) >= EMPTY_NS {
            return self.replace(&mut seen, texts);
        }
        let message = format!("is empty; if it stays so, that is what holds in {} s", EMPTY_NS / 1_000_000_000);
        Err(of_file(&self.paths[index])(Refusal::new(Reason::Unreadable, "", message)))
    }

    fn replace(&self, seen: &mut Seen, texts: &[String]) -> Result<()> {
        let digest = digest(texts);
        if seen.digest != digest {
            seen.digest = digest;
            seen.useless = match (self.make)(texts) {
                Ok(value) => {
                    *lock(&self.current) = Arc::new(value);
                    self.version.send_modify(|version| *version += 1);
                    info!("{}: new files are in use", self.what);
                    None
                }
                Err(refusal) => Some(refusal),
            };
        }
        seen.useless.clone().map_or(Ok(()), Err)
    }

    /// Says once what is wrong, and that it is in order again.
    fn tell(&self, trouble: Option<Refusal>) {
        self.trouble.send_if_modified(|told| {
            if *told == trouble {
                return false;
            }
            match &trouble {
                Some(refusal) => warn!(%refusal, "{}: the new files are of no use, the old ones hold", self.what),
                None => info!("{}: the files are in order", self.what),
            }
            *told = trouble;
            true
        });
    }

    /// Looks at the files for ever: steadily, and at once when the process is told so (SIGHUP). On a thread of its own, for a
    /// file may be on a disk that does not answer.
    pub(super) async fn watch(self: Arc<Self>) {
        let mut ticks = tokio::time::interval(EVERY);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        #[cfg(unix)]
        let mut hangups = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::hangup()).ok();
        loop {
            #[cfg(unix)]
            let told = async {
                match &mut hangups {
                    Some(hangups) => hangups.recv().await,
                    None => std::future::pending().await,
                }
            };
            #[cfg(not(unix))]
            let told = std::future::pending::<()>();
            tokio::select! {
                _ = ticks.tick() => {}
                _ = told => info!("{}: told to look at the files", self.what),
            }
            let this = self.clone();
            let mut looking = tokio::task::spawn_blocking(move || this.refresh(now_ns()));
            if tokio::time::timeout(PATIENCE, &mut looking).await.is_err() {
                let message = format!("did not answer for {} s", PATIENCE.as_secs());
                self.tell(Some(Refusal::new(Reason::TimedOut, self.what, message)));
                let _ = looking.await;
            }
        }
    }
}

fn read(paths: &[PathBuf]) -> Result<Vec<String>> {
    paths.iter().map(|path| read_file(path).map_err(|message| of_file(path)(unreadable(message)))).collect()
}

fn unreadable(message: impl Into<String>) -> Refusal {
    Refusal::new(Reason::Unreadable, "", message)
}

/// The text of a file, without waiting for anybody: a pipe that nobody writes to would be waited for.
fn read_file(path: &Path) -> std::result::Result<String, String> {
    let mut options = std::fs::OpenOptions::new();
    options.read(true);
    #[cfg(unix)]
    {
        let flags = rustix::fs::OFlags::NONBLOCK.bits().cast_signed();
        std::os::unix::fs::OpenOptionsExt::custom_flags(&mut options, flags);
    }
    let file = options.open(path).map_err(|e| format!("can't be opened: {e}"))?;
    let meta = file.metadata().map_err(|e| format!("can't be read: {e}"))?;
    if !meta.is_file() {
        return Err("is no file".to_owned());
    }
    let mut bytes = Vec::new();
    file.take(MOST_BYTES + 1).read_to_end(&mut bytes).map_err(|e| format!("can't be read: {e}"))?;
    if bytes.len() as u64 > MOST_BYTES {
        return Err(format!("is larger than the limit of {MOST_BYTES} bytes"));
    }
    String::from_utf8(bytes).map_err(|e| format!("is not UTF-8 text: {e}"))
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
pub(super) fn warn_if_readable(path: &Path, what: &str) {
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
pub(super) fn of_file(path: &Path) -> impl Fn(Refusal) -> Refusal + '_ {
    |refusal| Refusal { place: Some(path.display().to_string()), ..refusal }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_file_is_waited_for_and_then_says_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("words");
        std::fs::write(&path, "old").unwrap();
        let words = Reloaded::load("words", vec![path.clone()], |texts| Ok(texts[0].clone())).unwrap();
        let says = |now_ns: u64| {
            words.refresh(now_ns);
            (words.get().to_string(), words.troubles().borrow().is_some())
        };
        assert_eq!(says(1), ("old".into(), false));
        std::fs::write(&path, "").unwrap();
        assert_eq!(says(2), ("old".into(), true));
        assert_eq!(says(1 + EMPTY_NS), ("old".into(), true));
        assert_eq!(says(2 + EMPTY_NS), (String::new(), false));
        // One that is written in between begins anew.
        std::fs::write(&path, "new").unwrap();
        assert_eq!(says(3 + EMPTY_NS), ("new".into(), false));
        std::fs::write(&path, "").unwrap();
        assert_eq!(says(4 + EMPTY_NS), ("new".into(), true));
        assert_eq!(words.version(), 2);
    }

    #[cfg(unix)]
    #[test]
    fn what_is_no_file_is_told_and_not_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("words");
        std::fs::write(&path, "old").unwrap();
        let words = Reloaded::load("words", vec![path.clone()], |texts| Ok(texts[0].clone())).unwrap();
        std::fs::remove_file(&path).unwrap();
        words.refresh(1);
        assert!(words.troubles().borrow().as_ref().is_some_and(|why| why.message.contains("opened")));
        assert!(std::process::Command::new("mkfifo").arg(&path).status().unwrap().success());
        words.refresh(2);
        assert!(words.troubles().borrow().as_ref().is_some_and(|why| why.message == "is no file"));
        assert_eq!(*words.get(), "old");
        std::fs::remove_file(&path).unwrap();
        std::fs::write(&path, "old").unwrap();
        words.refresh(3);
        assert_eq!((words.version(), words.troubles().borrow().clone()), (0, None));
    }
}
