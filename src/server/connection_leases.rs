//! Leases that outlast the call that acquired them (`AcquireTool`). They end with the connection over which they were
//! acquired, or when their holder may not hold a tool any more.

use std::sync::{Arc, Mutex, Weak};

use super::identity::PresentedCredentials;
use palpate_realtime::SessionHandle;
use palpate_session::lease::LeaseId;
use palpate_tissue::lock::lock;

struct LastingLease {
    handle: Weak<SessionHandle>,
    id: LeaseId,
    /// The credentials of its holder, if they decide when it ends.
    presented: Option<PresentedCredentials>,
}

impl LastingLease {
    fn is_held(&self) -> bool {
        self.handle
            .upgrade()
            .is_some_and(|handle| handle.at_intake(|intake, _| intake.tools_of(self.id).next().is_some()))
    }

    /// False if it had ended already.
    fn end(&self) -> bool {
        self.handle.upgrade().is_some_and(|handle| handle.at_intake(|intake, _| intake.release(self.id)).is_ok())
    }
}

/// Those of one connection, or of all authenticated callers.
#[derive(Default)]
pub(super) struct LastingLeases(Mutex<Vec<LastingLease>>);

impl std::fmt::Debug for LastingLeases {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("LastingLeases")
    }
}

impl LastingLeases {
    /// One more. Those that have ended otherwise are forgotten, now and then.
    pub(super) fn add(&self, handle: &Arc<SessionHandle>, id: LeaseId, presented: Option<PresentedCredentials>) {
        let mut leases = lock(&self.0);
        if leases.len().is_power_of_two() && leases.len() >= 64 {
            leases.retain(LastingLease::is_held);
        }
        leases.push(LastingLease { handle: Arc::downgrade(handle), id, presented });
    }

    /// Ends those for which `chosen` holds, by their holder's credentials; tells how many were still held.
    pub(super) fn end(&self, chosen: impl Fn(Option<&PresentedCredentials>) -> bool) -> usize {
        let ended: Vec<LastingLease> = lock(&self.0).extract_if(.., |lease| chosen(lease.presented.as_ref())).collect();
        ended.iter().filter(|lease| lease.end()).count()
    }
}
