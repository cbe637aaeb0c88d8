//! Counters and gauges of this server as a member of its fleet, for Prometheus.

use std::sync::atomic::{AtomicU64, Ordering};

/// A counter of events.
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

/// Counters of this server in its fleet since its start.
#[derive(Debug, Default)]
pub(super) struct FleetTally {
    /// Sessions whose owner was gone and that continue here.
    pub(super) taken_over: FleetCount,
    /// Sessions of this server that were moved to another.
    pub(super) moved: FleetCount,
    /// Sessions of this server that another had taken over when it returned.
    pub(super) lost: FleetCount,
}

/// The current state of this server in its fleet.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::server) struct Standing {
    /// Whether it may step and answer for its sessions.
    pub(in crate::server) acts: bool,
    /// Time that is left for this if etcd confirms nothing more, s.
    pub(in crate::server) to_fence_s: f64,
    /// Servers of the fleet that it sees.
    pub(in crate::server) nodes: usize,
    /// Fraction of its stepping threads that its sessions use, 0 to 1.
    pub(in crate::server) load: f64,
    /// Sessions that it owns.
    pub(in crate::server) sessions: usize,
    /// Sessions that it owns and that have no standby server.
    pub(in crate::server) without_standby: usize,
    /// Bytes of its journals that are on the disk of a second server.
    pub(in crate::server) mirrored_bytes: u64,
    /// Bytes of its journals that are not on a second disk yet.
    pub(in crate::server) unmirrored_bytes: u64,
    pub(in crate::server) taken_over: u64,
    pub(in crate::server) moved: u64,
    pub(in crate::server) lost: u64,
}
