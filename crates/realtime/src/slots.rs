//! The slots for streams in a session: how many there are, and which stream has each.

use std::collections::BTreeMap;

use tokio_util::sync::CancellationToken;

use palpate_session::budget::{Account, Pool, Taken};
use palpate_tissue::limits::Limits;

/// Purpose of a stream, which decides which slots of its session it may take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StreamKind {
    /// The stream holds tools. Some slots of a session are reserved for such streams (`limits.streams_for_holders`,
    /// at most an eighth of all).
    HoldsTools,
    /// The stream only reads.
    ReadsOnly,
}

/// Slots for the streams of one session.
#[derive(Debug)]
pub(super) struct StreamSlots {
    pub(super) most: usize,
    pub(super) numbers: u64,
    pub(super) open: BTreeMap<u64, OpenSlot>,
    /// Slots of streams that only read, by account.
    pub(super) readers: Pool,
}

/// An open stream.
#[derive(Debug)]
pub(super) struct OpenSlot {
    pub(super) what: &'static str,
    pub(super) kind: StreamKind,
    pub(super) account: Account,
    pub(super) since_ns: u64,
    pub(super) cut: CancellationToken,
    pub(super) _taken: [Taken; 2],
}

impl StreamSlots {
    pub(super) fn new(limits: &Limits) -> Self {
        let most = limits.streams_per_session;
        let readers = most - limits.streams_for_holders.min(most / 8);
        StreamSlots { most, numbers: 0, open: BTreeMap::new(), readers: Pool::new(readers as u64, 16) }
    }

    /// Frees the slot of a stream. Returns what it held; `None` if the stream has no slot.
    pub(super) fn close(&mut self, number: u64) -> Option<OpenSlot> {
        let open = self.open.remove(&number)?;
        if open.kind == StreamKind::ReadsOnly {
            self.readers.give_back(open.account.number(), 1);
        }
        Some(open)
    }
}
