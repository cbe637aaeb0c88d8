//! File descriptors: raises the process's limit, and limits the number of connections accordingly.

#[cfg(unix)]
use tracing::warn;

/// Descriptors reserved for files: scenes, scripts, textures, certificates and tokens, several at once.
#[cfg(unix)]
const RESERVE: usize = 64;

/// Raises the soft limit of open files to the hard limit. Logs a warning if that fails.
pub(super) fn raise() {
    #[cfg(unix)]
    {
        use rustix::process::{Resource, getrlimit, setrlimit};
        let mut limit = getrlimit(Resource::Nofile);
        limit.current = limit.maximum;
        if let Err(error) = setrlimit(Resource::Nofile, limit) {
            warn!(%error, "can't raise the limit of open files");
        }
    }
}

/// Returns the number of connections that the limit of open files allows, at most `wanted`, and logs a warning if it
/// is lower. `others` is the number of other connections with descriptors, such as those to the metrics.
pub(super) fn connections(wanted: usize, others: usize) -> usize {
    #[cfg(unix)]
    {
        let limit = rustix::process::getrlimit(rustix::process::Resource::Nofile).current;
        let Some(limit) = limit.and_then(|limit| usize::try_from(limit).ok()) else { return wanted };
        // Without /proc, assume that as many files are open as are reserved.
        let open = std::fs::read_dir("/proc/self/fd").map_or(RESERVE, Iterator::count);
        let most = room(limit, open + others);
        if most < wanted {
            warn!(
                "the process may open {limit} files (`ulimit -Hn`); that allows {most} connections, fewer than \
                 limits.connections = {wanted}"
            );
        }
        most.min(wanted)
    }
    #[cfg(not(unix))]
    {
        let _ = others;
        wanted
    }
}

/// Returns the number of connections that fit, at least 1. A quarter of a small limit is reserved.
#[cfg(unix)]
fn room(limit: usize, taken: usize) -> usize {
    limit.saturating_sub(taken + RESERVE.min(limit / 4)).max(1)
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn descriptors_are_reserved_for_files() {
        assert_eq!(room(65_536, 30), 65_536 - 30 - RESERVE);
        assert_eq!(room(64, 20), 28);
        assert_eq!(room(16, 20), 1);
    }
}
