//! Removes old journals.

use std::path::Path;
use std::time::{Duration, SystemTime};

use super::keep::Keep;
use crate::journal;

/// Removes a journal. What can't be removed is told, and tried again.
pub(super) fn remove(path: &Path) {
    match std::fs::remove_file(path) {
        Ok(()) => tracing::info!(path = %path.display(), "journal removed"),
        Err(error) => tracing::warn!(path = %path.display(), %error, "a journal can't be removed"),
    }
}

/// Removes the journals of `folder` that are too old; then, while all together are too much, the oldest. What `is_needed` stays.
#[allow(clippy::disallowed_methods)]
pub(super) fn sweep(folder: &Path, keep: Keep, is_needed: impl Fn(&Path) -> bool) {
    let now = SystemTime::now();
    let listed = match journal::file::list(folder) {
        Ok(listed) => listed,
        Err(error) => return tracing::warn!(path = %folder.display(), %error, "the journals can't be listed"),
    };
    let mut bytes = 0;
    let mut removable = Vec::new();
    for file in listed {
        let Ok(metadata) = std::fs::metadata(&file.path) else { continue };
        bytes += metadata.len();
        if !is_needed(&file.path) {
            let age = metadata.modified().ok().and_then(|at| now.duration_since(at).ok()).unwrap_or(Duration::ZERO);
            removable.push((age, file.path, metadata.len()));
        }
    }
    removable.sort_by(|a, b| b.0.cmp(&a.0).then_with(|| a.1.cmp(&b.1)));
    for (age, path, of_it) in removable {
        if age >= keep.age || bytes > keep.bytes {
            remove(&path);
            bytes -= of_it;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[allow(clippy::disallowed_methods)]
    fn the_oldest_go_first_and_what_is_needed_stays() {
        let folder = tempfile::tempdir().unwrap();
        let now = SystemTime::now();
        let ages_s = [10, 5000, 100, 7000, 20];
        for (index, age_s) in ages_s.into_iter().enumerate() {
            let path = folder.path().join(journal::file::name(&format!("s{index}"), 1));
            std::fs::write(&path, [0; 1000]).unwrap();
            let file = std::fs::File::options().append(true).open(&path).unwrap();
            file.set_modified(now - Duration::from_secs(age_s)).unwrap();
        }
        std::fs::write(folder.path().join("lock"), [0; 5000]).unwrap();
        let left = || {
            let listed = journal::file::list(folder.path()).unwrap();
            listed.into_iter().map(|file| file.session_id).collect::<Vec<_>>()
        };
        let needed = |path: &Path| path.ends_with(journal::file::name("s3", 1));
        sweep(folder.path(), Keep { age: Duration::from_secs(3600), bytes: u64::MAX }, needed);
        assert_eq!(left(), ["s0", "s2", "s3", "s4"]);
        sweep(folder.path(), Keep { age: Duration::MAX, bytes: 2500 }, needed);
        assert_eq!(left(), ["s0", "s3"]);
        sweep(folder.path(), Keep { age: Duration::MAX, bytes: 0 }, needed);
        assert_eq!(left(), ["s3"]);
    }
}
