//! What streams are given: samples and records, with how the session keeps time.

use std::sync::Arc;

use crate::budget::Taken;
use crate::scene::record::Record;
use crate::session::Sample;

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
