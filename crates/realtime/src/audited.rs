//! Results of audits: those of one session, and counts over all sessions. An audit repeats a window of steps more
//! accurately to measure its error.

use super::thread_counters::Count;
use palpate_refusal::Refusal;
use palpate_tissue::response::mesh_error::MeshErrorEstimate;
use palpate_tissue::scene::record::{AuditedError, Correction};
use palpate_tissue::select::audit::{ErrorExtent, Origin};

/// Results of the audits of one session since it came to this server. All counts are 0 and all options `None` before
/// the first audit.
#[derive(Debug, Clone, Default)]
pub struct Audited {
    /// Number of windows of steps that were audited.
    pub windows: u64,
    /// The step count at the end of the newest audited window, and the error that the window added, relative to the
    /// largest values.
    pub newest: Option<(u64, AuditedError)>,
    /// The largest value of each part of the error in any window.
    pub largest: AuditedError,
    /// Number of windows whose error was above the tolerance.
    pub above: u64,
    /// Main source of the newest error above the tolerance; `None` if none was above.
    pub origin: Option<Origin>,
    /// Number of corrections of the tissue that were made.
    pub corrections: u64,
    /// The newest correction; its step is the one from which it acts.
    pub correction: Option<Correction>,
    /// Why the newest correction that was needed could not be made; `None` after one that was made.
    pub refused_correction: Option<Refusal>,
    /// The error that the size of a solid's cells makes; `None` before it is estimated, and of other tissues.
    pub mesh_error: Option<MeshErrorEstimate>,
    /// Whether the error of the cells was estimated, with or without a result.
    pub(super) knows_mesh: bool,
    pub(super) extent: ErrorExtent,
    pub(super) warned_ns: Option<u64>,
}

/// Counts of the auditor over all sessions, since it began.
#[derive(Debug, Default)]
pub struct AuditTally {
    /// Number of windows of steps that were audited.
    pub windows: Count,
    /// Number of windows whose error was above the tolerance.
    pub above: Count,
    /// Number of corrections.
    pub corrections: Count,
    /// Processor time of the auditor, ns.
    pub busy_ns: Count,
}
