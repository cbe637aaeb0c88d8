//! Leases that outlast the call that acquired them (`AcquireTool`). They end with the connection over which they were
//! acquired, or when their holder loses the right to hold a tool.

use std::sync::{Arc, Mutex, Weak};

use super::identity::PresentedCredentials;
use palpate_realtime::SessionHandle;
use palpate_session::lease::LeaseId;
use palpate_tissue::lock::lock;

struct LastingLease {
    handle: Weak<SessionHandle>,
    id: LeaseId,
    /// The credentials of its holder, if the lease ends when they are revoked.
    presented: Option<PresentedCredentials>,
}

impl LastingLease {
    fn is_held(&self) -> bool {
        self.handle
            .upgrade()
            .is_some_and(|handle| handle.at_intake(|intake, _| intake.tools_of(self.id).next().is_some()))
    }

    /// Ends the lease. Returns false if it had ended already.
    fn end(&self) -> bool {
        self.handle.upgrade().is_some_and(|handle| handle.at_intake(|intake, _| intake.release(self.id)).is_ok())
    }
}

/// The lasting leases of one connection, or of all authenticated callers.
#[derive(Default)]
pub(super) struct LastingLeases(Mutex<Vec<LastingLease>>);

impl std::fmt::Debug for LastingLeases {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("LastingLeases")
    }
}

impl LastingLeases {
    /// Adds a lease. From time to time, also removes those that have ended otherwise.
    pub(super) fn add(&self, handle: &Arc<SessionHandle>, id: LeaseId, presented: Option<PresentedCredentials>) {
        let mut leases = lock(&self.0);
        if leases.len().is_power_of_two() && leases.len() >= 64 {
            leases.retain(LastingLease::is_held);
        }
        leases.push(LastingLease { handle: Arc::downgrade(handle), id, presented });
    }

    /// Ends and removes the leases whose holder's credentials `chosen` accepts. Returns how many were still held.
    pub(super) fn end(&self, chosen: impl Fn(Option<&PresentedCredentials>) -> bool) -> usize {
        let ended: Vec<LastingLease> = lock(&self.0).extract_if(.., |lease| chosen(lease.presented.as_ref())).collect();
        ended.iter().filter(|lease| lease.end()).count()
    }
}
