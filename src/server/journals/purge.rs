//! Removes old journals.

use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use super::retention::Keep;
use palpate_realtime::fence::boot_ns;
use palpate_session::journal;

/// Removes a journal. Logs a failure; the next sweep tries again.
pub(super) fn remove(path: &Path) {
    match std::fs::remove_file(path) {
        Ok(()) => tracing::info!(path = %path.display(), "journal removed"),
        Err(error) => tracing::warn!(path = %path.display(), %error, "a journal can't be removed"),
    }
}

/// Lead, in ns, above which the machine's clock counts as set forward.
const JUMP_NS: i128 = 3_600_000_000_000;

/// Decides whether the ages of files can be trusted. They can't after the machine's clock was set forward: older
/// files then seem older than they are. Compares that clock with one that nobody sets (the time since boot).
#[derive(Debug, Default)]
pub(super) struct Ages {
    /// The lead of the machine's clock on the time since boot, ns.
    lead_ns: Option<i128>,
    /// Time since boot from which ages can be trusted again, ns: everything written before is then old enough.
    blind_until_ns: u64,
}

impl Ages {
    /// Returns whether ages can be trusted now. Journals are kept for `age`.
    fn tell(&mut self, (wall_ns, boot_ns): (u64, u64), age: Duration) -> bool {
        let lead_ns = i128::from(wall_ns) - i128::from(boot_ns);
        let jump_ns = lead_ns - self.lead_ns.unwrap_or(lead_ns);
        if jump_ns > JUMP_NS {
            self.blind_until_ns = boot_ns.saturating_add(u64::try_from(age.as_nanos()).unwrap_or(u64::MAX));
            let hours = jump_ns / JUMP_NS;
            tracing::warn!(
                "the machine's clock was set forward by {hours} h: what was written before is not removed for its age until {} h from \
                 now, since its age is not known any more",
                age.as_secs() / 3600
            );
        }
        // Small steps forward add up; a step back counts at once.
        if !(0..=JUMP_NS).contains(&jump_ns) || self.lead_ns.is_none() {
            self.lead_ns = Some(lead_ns);
        }
        boot_ns >= self.blind_until_ns
    }
}

/// Removes the journals of `folder` that are too old, if their ages can be trusted; then the oldest, while all
/// together are too large. Keeps those that `is_needed` accepts.
#[allow(clippy::disallowed_methods)]
pub(super) fn sweep(folder: &Path, keep: Keep, ages: &mut Ages, is_needed: impl Fn(&Path) -> bool) {
    let now = SystemTime::now();
    let wall = now.duration_since(UNIX_EPOCH).unwrap_or_default();
    let are_known = ages.tell((u64::try_from(wall.as_nanos()).unwrap_or(u64::MAX), boot_ns()), keep.age);
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
            removable.push((metadata.modified().unwrap_or(now), file.path, metadata.len()));
        }
    }
    removable.sort();
    for (written, path, of_it) in removable {
        let age = now.duration_since(written).unwrap_or(Duration::ZERO);
        if are_known && age >= keep.age || bytes > keep.bytes {
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
        sweep(folder.path(), Keep { age: Duration::from_secs(3600), bytes: u64::MAX }, &mut Ages::default(), needed);
        assert_eq!(left(), ["s0", "s2", "s3", "s4"]);
        sweep(folder.path(), Keep { age: Duration::MAX, bytes: 2500 }, &mut Ages::default(), needed);
        assert_eq!(left(), ["s0", "s3"]);
        sweep(folder.path(), Keep { age: Duration::MAX, bytes: 0 }, &mut Ages::default(), needed);
        assert_eq!(left(), ["s3"]);
    }

    #[test]
    fn a_clock_that_is_set_forward_makes_no_journal_old() {
        const HOUR_NS: u64 = 3_600_000_000_000;
        let age = Duration::from_secs(30 * 24 * 3600);
        let mut ages = Ages::default();
        let mut tell = |wall_h: u64, boot_h: u64| ages.tell((wall_h * HOUR_NS, boot_h * HOUR_NS), age);
        assert!(tell(1000, 5));
        // The machine slept: that time counts.
        assert!(tell(1500, 505));
        // Set forward by forty days, corrected, and set forward again.
        assert!(!tell(2461, 506));
        assert!(!tell(1502, 507));
        assert!(!tell(1503, 508));
        assert!(!tell(1602, 597));
        assert!(!tell(1602 + 719, 597 + 719));
        assert!(tell(1602 + 720, 597 + 720));
        // Steps back make nothing old.
        assert!(tell(100, 2000));
        assert!(tell(101, 2001));
    }

    #[test]
    fn after_a_jump_of_the_clock_only_what_is_too_much_goes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(journal::file::name("s", 1));
        std::fs::write(&path, [0; 1000]).unwrap();
        let keep = Keep { age: Duration::from_secs(3600), bytes: u64::MAX };
        let file = std::fs::File::options().append(true).open(&path).unwrap();
        file.set_modified(std::time::UNIX_EPOCH + Duration::from_secs(1)).unwrap();
        // As if the clock had been at 1970 a moment before.
        let mut ages = Ages { lead_ns: Some(-i128::from(boot_ns())), blind_until_ns: 0 };
        sweep(folder.path(), keep, &mut ages, |_| false);
        assert!(path.exists());
        sweep(folder.path(), Keep { bytes: 999, ..keep }, &mut ages, |_| false);
        assert!(!path.exists());
    }
}
