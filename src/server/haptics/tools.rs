//! What calls that hold tools share.

use palpate_refusal::{Reason, Refusal};
use palpate_session::budget::{Account, Resource, Taken};
use palpate_session::lease::LeaseId;

/// Charges `account` for so many tools.
pub(super) fn charges(account: &Account, tools: usize) -> Result<Vec<Taken>, Refusal> {
    (0..tools).map(|_| account.take(Resource::Leases, 1, "tools")).collect()
}

/// The lease that a text names.
pub(super) fn lease_id(text: &str) -> Result<LeaseId, Refusal> {
    let wrong = |_| Refusal::new(Reason::NotHolder, "lease_id", "is not a lease of this server");
    LeaseId::from_str_radix(text, 16).map_err(wrong)
}
