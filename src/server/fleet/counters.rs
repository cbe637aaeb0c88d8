//! What Prometheus is told of this server in its fleet.

use std::sync::atomic::{AtomicU64, Ordering};

/// How often something happened.
#[derive(Debug, Default)]
pub(super) struct FleetCount(AtomicU64);

impl FleetCount {
    pub(super) fn one_more(&self) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    pub(super) fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// What has happened so far.
#[derive(Debug, Default)]
pub(super) struct FleetTally {
    /// Sessions whose owner was gone, and that go on here.
    pub(super) taken_over: FleetCount,
    /// Sessions of this server that were moved to another.
    pub(super) moved: FleetCount,
    /// Sessions of this server that another had taken over when it came back.
    pub(super) lost: FleetCount,
}

/// How it stands now.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::server) struct Standing {
    /// Whether it may step and speak for its sessions.
    pub(in crate::server) acts: bool,
    /// For how long it may, if etcd confirms nothing more, s.
    pub(in crate::server) to_fence_s: f64,
    /// Servers of the fleet that it sees.
    pub(in crate::server) nodes: usize,
    /// The part of its stepping threads that its sessions take, 0 to 1.
    pub(in crate::server) load: f64,
    /// Sessions that it owns.
    pub(in crate::server) sessions: usize,
    /// Of those, the ones for which no server stands by.
    pub(in crate::server) without_standby: usize,
    /// Bytes of its journals that are on the disk of a second server.
    pub(in crate::server) mirrored_bytes: u64,
    /// Bytes of its journals that are on no second disk.
    pub(in crate::server) unmirrored_bytes: u64,
    pub(in crate::server) taken_over: u64,
    pub(in crate::server) moved: u64,
    pub(in crate::server) lost: u64,
}
