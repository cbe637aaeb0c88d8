//! What streams are given: samples and records, with how the session keeps time.

use std::sync::Arc;

use crate::budget::Taken;
use crate::scene::record::Record;
use crate::session::Sample;
use crate::session::saved::Saved;
use crate::tissue::ReadCopy;

/// A sample, and how the session keeps time.
#[derive(Debug, Clone, PartialEq)]
pub struct PacedSample {
    /// What the tools felt.
    pub sample: Sample,
    /// When its step was due, by the server's clock.
    pub due_ns: u64,
    /// Steps dropped so far.
    pub overrun_count: u64,
    /// Of the last second or so.
    pub time_dilation: f64,
    /// What happened before this step is on disk; `None` if no journal is kept.
    pub durable_step: Option<u64>,
    /// The revision at which this server became the session's owner; 0 without a fleet.
    pub ownership_revision: u64,
    /// Steps were dropped since the stream's last sample.
    pub overrun: bool,
}

/// A record, and its step. All who asked for the same share one.
pub type SharedRecord = Arc<Recorded>;

/// What was measured once, for whoever asked for it.
#[derive(Debug)]
pub struct Recorded {
    /// Steps done.
    pub step: u64,
    /// What was measured.
    pub record: Record,
    /// Its memory.
    pub(super) _taken: Taken,
}

/// A session as it is, to continue from.
pub struct Present {
    /// Everything that the next step depends on.
    pub saved: Box<Saved>,
    /// The state, to be hashed.
    pub copy: ReadCopy,
    /// Whether time goes on.
    pub running: bool,
    /// The step at which it pauses.
    pub until_step: Option<u64>,
}
