//! The fence of a server in a fleet: it steps and speaks for its sessions only until a moment, which is moved on while it may.
//!
//! The moment is of a clock that also goes on while the machine is suspended. So a server that was frozen finds, before its next
//! step and its next message, that its time is over.

use std::sync::atomic::{AtomicU64, Ordering};

/// Until when a server may act. Without a fleet: for ever.
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
    /// Returns whether the server may step and speak for its sessions now.
    pub fn may_act(&self) -> bool {
        let until_ns = self.until_ns.load(Ordering::Acquire);
        until_ns == u64::MAX || boot_ns() < until_ns
    }

    /// Returns for how long it may, s; 0 if its time is over.
    #[allow(clippy::cast_precision_loss)]
    pub fn left_s(&self) -> f64 {
        match self.until_ns.load(Ordering::Acquire) {
            u64::MAX => f64::INFINITY,
            until_ns => until_ns.saturating_sub(boot_ns()) as f64 * 1e-9,
        }
    }

    /// Lets it until that moment of [`boot_ns`].
    pub fn set(&self, until_ns: u64) {
        self.until_ns.store(until_ns.min(u64::MAX - 1), Ordering::Release);
    }
}

/// Returns the time since the machine was started, ns; also that in which it was suspended.
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
        // No moment means "for ever" by chance.
        fence.set(u64::MAX);
        assert_ne!(fence.until_ns.load(Ordering::Relaxed), u64::MAX);
    }
}
