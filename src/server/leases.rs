//! Leases that outlast the call that acquired them (`AcquireTool`). They end with the connection over which they were
//! acquired, or when their holder may not hold a tool any more.

use std::sync::{Arc, Mutex, Weak};

use super::identity::Shown;
use crate::lock::lock;
use crate::pace::Live;
use crate::session::lease::LeaseId;

struct Lease {
    live: Weak<Live>,
    id: LeaseId,
    /// What its holder showed, if that decides when it ends.
    shown: Option<Shown>,
}

impl Lease {
    fn is_held(&self) -> bool {
        self.live.upgrade().is_some_and(|live| live.at_intake(|intake, _| intake.tools_of(self.id).next().is_some()))
    }

    /// False if it had ended already.
    fn end(&self) -> bool {
        self.live.upgrade().is_some_and(|live| live.at_intake(|intake, _| intake.release(self.id)).is_ok())
    }
}

/// Those of one connection, or of all authenticated callers.
#[derive(Default)]
pub(super) struct Leases(Mutex<Vec<Lease>>);

impl std::fmt::Debug for Leases {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("Leases")
    }
}

impl Leases {
    /// One more. Those that have ended otherwise are forgotten, now and then.
    pub(super) fn add(&self, live: &Arc<Live>, id: LeaseId, shown: Option<Shown>) {
        let mut leases = lock(&self.0);
        if leases.len().is_power_of_two() && leases.len() >= 64 {
            leases.retain(Lease::is_held);
        }
        leases.push(Lease { live: Arc::downgrade(live), id, shown });
    }

    /// Ends those for which `chosen` holds, by what their holder showed; tells how many were still held.
    pub(super) fn end(&self, chosen: impl Fn(Option<&Shown>) -> bool) -> usize {
        let ended: Vec<Lease> = lock(&self.0).extract_if(.., |lease| chosen(lease.shown.as_ref())).collect();
        ended.iter().filter(|lease| lease.end()).count()
    }
}
