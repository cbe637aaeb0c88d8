//! The fence of a server in a fleet: the server may step its sessions and answer for them only until a moment,
//! which each renewal of its lease in etcd extends.
//!
//! The clock of that moment also runs while the machine is suspended. So a server that was frozen finds, before its
//! next step and its next message, that the moment has passed.

use std::sync::atomic::{AtomicU64, Ordering};

/// The moment until which a server may act. It begins without such a moment, as for a server without a fleet;
/// [`Fence::set`] gives it one.
#[derive(Debug)]
pub struct Fence {
    until_ns: AtomicU64,
}

impl Default for Fence {
    fn default() -> Self {
        Fence { until_ns: AtomicU64::new(u64::MAX) }
    }
}

impl Fence {
    /// Returns whether the server may step its sessions and answer for them now: the moment has not come, or there is
    /// none.
    pub fn may_act(&self) -> bool {
        let until_ns = self.until_ns.load(Ordering::Acquire);
        until_ns == u64::MAX || boot_ns() < until_ns
    }

    /// Returns the time for which the server may still act, s: 0 if the moment has passed, infinity without a
    /// fleet.
    #[allow(clippy::cast_precision_loss)]
    pub fn left_s(&self) -> f64 {
        match self.until_ns.load(Ordering::Acquire) {
            u64::MAX => f64::INFINITY,
            until_ns => until_ns.saturating_sub(boot_ns()) as f64 * 1e-9,
        }
    }

    /// Sets the moment until which the server may act, ns of [`boot_ns`]; an earlier one than before counts too.
    pub fn set(&self, until_ns: u64) {
        self.until_ns.store(until_ns.min(u64::MAX - 1), Ordering::Release);
    }
}

/// Returns the time since the machine was started, ns, including the time in which it was suspended. Outside Linux
/// it returns [`now_ns`](super::clock::now_ns).
#[allow(clippy::cast_sign_loss)]
pub fn boot_ns() -> u64 {
    #[cfg(target_os = "linux")]
    {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::Boottime);
        time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
    }
    #[cfg(not(target_os = "linux"))]
    super::clock::now_ns()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_acts_until_its_moment_and_without_a_fleet_for_ever() {
        let fence = Fence::default();
        assert!(fence.may_act() && fence.left_s() == f64::INFINITY);
        fence.set(boot_ns() + 60_000_000_000);
        assert!(fence.may_act() && (0.0..=60.0).contains(&fence.left_s()));
        fence.set(boot_ns() - 1);
        assert!(!fence.may_act() && fence.left_s() == 0.0);
        // No settable moment is the value without a limit.
        fence.set(u64::MAX);
        assert_ne!(fence.until_ns.load(Ordering::Relaxed), u64::MAX);
    }
}
