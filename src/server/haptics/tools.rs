//! Helpers shared by the calls that hold tools.

use palpate_refusal::{Reason, Refusal};
use palpate_session::budget::{Account, Resource, Taken};
use palpate_session::lease::LeaseId;

/// Charges `account` for that many tools. Returns one charge per tool.
pub(super) fn charges(account: &Account, tools: usize) -> Result<Vec<Taken>, Refusal> {
    (0..tools).map(|_| account.take(Resource::Leases, 1, "tools")).collect()
}

/// Parses a lease ID. Refuses a text that is not one.
pub(super) fn lease_id(text: &str) -> Result<LeaseId, Refusal> {
    let wrong = |_| Refusal::new(Reason::NotHolder, "lease_id", "is not a lease of this server");
    LeaseId::from_str_radix(text, 16).map_err(wrong)
}
