//! What audits have found: of one session, and counts of all.

use super::thread_counters::Count;
use palpate_refusal::Refusal;
use palpate_tissue::scene::record::{AuditedError, Correction};
use palpate_tissue::select::audit::{ErrorExtent, Origin};

/// What audits have found of a session.
#[derive(Debug, Clone, Default)]
pub struct Audited {
    /// Windows that were audited.
    pub windows: u64,
    /// The steps done at the end of the newest window, and the error that it added.
    pub newest: Option<(u64, AuditedError)>,
    /// The largest of each part in any window.
    pub largest: AuditedError,
    /// Windows whose error was above the tolerance.
    pub above: u64,
    /// Where most of the newest of those errors came from.
    pub origin: Option<Origin>,
    /// How often the tissue was corrected.
    pub corrections: u64,
    /// The newest of these.
    pub correction: Option<Correction>,
    /// Why the newest correction that was needed could not be made.
    pub refused_correction: Option<Refusal>,
    pub(super) extent: ErrorExtent,
    pub(super) warned_ns: Option<u64>,
}

/// What the auditor counts, of all sessions, since it began.
#[derive(Debug, Default)]
pub struct AuditTally {
    /// Windows that were audited.
    pub windows: Count,
    /// Windows whose error was above the tolerance.
    pub above: Count,
    /// Corrections.
    pub corrections: Count,
    /// Processor time, ns.
    pub busy_ns: Count,
}
