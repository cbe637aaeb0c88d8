//! Leases of tools that end with the connection over which they were taken.

use std::sync::{Arc, Mutex, Weak};

use crate::lock::lock;
use crate::pace::Live;
use crate::session::command::LeaseId;

/// Those of one connection.
#[derive(Default)]
pub(super) struct Leases(Mutex<Vec<(Weak<Live>, LeaseId)>>);

impl std::fmt::Debug for Leases {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Leases")
    }
}

impl Leases {
    /// One more. Those that have ended otherwise are forgotten, now and then.
    pub(super) fn add(&self, live: &Arc<Live>, lease: LeaseId) {
        let mut leases = lock(&self.0);
        if leases.len().is_power_of_two() && leases.len() >= 64 {
            leases.retain(|(live, lease)| {
                live.upgrade().is_some_and(|live| live.at_intake(|intake, _| intake.tools_of(*lease).next().is_some()))
            });
        }
        leases.push((Arc::downgrade(live), lease));
    }

    /// The connection is no more.
    pub(super) fn end(&self) {
        for (live, lease) in lock(&self.0).drain(..) {
            if let Some(live) = live.upgrade() {
                // One that has lapsed already has nothing to give back.
                let _ = live.at_intake(|intake, _| intake.release(lease));
            }
        }
    }
}
