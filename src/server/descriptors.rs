//! File descriptors: as many as the system grants, and fewer connections than that.

use tracing::warn;

/// Kept for files: scenes, scripts, textures, certificates and tokens, several at once.
#[cfg(unix)]
const RESERVE: usize = 64;

/// Raises what the process may open to what it may raise it to.
pub(super) fn raise() {
    #[cfg(unix)]
    {
        use rustix::process::{Resource, getrlimit, setrlimit};
        let mut limit = getrlimit(Resource::Nofile);
        limit.current = limit.maximum;
        if let Err(error) = setrlimit(Resource::Nofile, limit) {
            warn!(%error, "the limit of file descriptors can't be raised");
        }
    }
}

/// How many of so many connections there can be beside `others`, which have descriptors of their own.
pub(super) fn connections(wanted: usize, others: usize) -> usize {
    #[cfg(unix)]
    {
        let limit = rustix::process::getrlimit(rustix::process::Resource::Nofile).current;
        let Some(limit) = limit.and_then(|limit| usize::try_from(limit).ok()) else { return wanted };
        // A system that does not tell has a few more than it needs.
        let open = std::fs::read_dir("/proc/self/fd").map_or(RESERVE, Iterator::count);
        let most = room(limit, open + others);
        if most < wanted {
            warn!(
                "the process may open {limit} files (`ulimit -Hn`), which is enough for {most} connections, not for \
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

/// Connections for which there is room, one at least: of a small limit a quarter is kept.
#[cfg(unix)]
fn room(limit: usize, taken: usize) -> usize {
    limit.saturating_sub(taken + RESERVE.min(limit / 4)).max(1)
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    #[test]
    fn files_keep_their_part() {
        assert_eq!(room(65_536, 30), 65_536 - 30 - RESERVE);
        assert_eq!(room(64, 20), 28);
        assert_eq!(room(16, 20), 1);
    }
}
