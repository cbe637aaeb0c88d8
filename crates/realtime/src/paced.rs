//! What streams and snapshots are given: records, and a session as it is.

use std::sync::Arc;

use palpate_session::budget::Taken;
use palpate_session::saved::Saved;
use palpate_tissue::ReadCopy;
use palpate_tissue::scene::record::Record;

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
