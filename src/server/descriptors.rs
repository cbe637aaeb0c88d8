//! File descriptors: raises the process's limit, and bounds the number of connections by it.

use tracing::warn;

/// Descriptors reserved for files: scenes, scripts, textures, certificates and tokens, several at once.
#[cfg(unix)]
const RESERVE: usize = 64;

/// Raises the soft limit of open files to the hard limit.
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

/// The number of connections that the limit of open files allows, at most `wanted`. `others` is the number of
/// connections with descriptors of their own, such as those to the metrics.
pub(super) fn connections(wanted: usize, others: usize) -> usize {
    #[cfg(unix)]
    {
        let limit = rustix::process::getrlimit(rustix::process::Resource::Nofile).current;
        let Some(limit) = limit.and_then(|limit| usize::try_from(limit).ok()) else { return wanted };
        // Without a /proc, assume as many open files as are reserved.
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

/// The number of connections that fit, at least 1. Of a small limit, a quarter is reserved.
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
