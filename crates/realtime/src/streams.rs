//! The streams of a session: opening, listing and cutting them.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use tokio_util::sync::CancellationToken;

use super::clock::now_ns;
use super::session_handle::SessionHandle;
use super::slots::{OpenSlot, StreamKind, StreamSlots};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_session::budget::{Account, Purpose, Resource};
use palpate_tissue::lock::lock;
use palpate_tissue::shape::RestShape;

/// Bytes of a stream that the client has not read: the transport (hyper) takes no more above 400 KiB, and then
/// holds at most one more message of 64 KiB or a little more.
const UNSENT_BYTES: u64 = (400 + 80) << 10;

/// Description of an open stream, for administrators ([`SessionHandle::list_streams`]).
#[derive(Debug, Clone)]
pub struct StreamInfo {
    /// Number of the stream within its session, from 1; never reused.
    pub number: u64,
    /// Name of the call that opened the stream.
    pub what: &'static str,
    /// Purpose of the stream.
    pub kind: StreamKind,
    /// Name of the account of the caller that opened the stream.
    pub caller: String,
    /// Time since the stream was opened, ns.
    pub age_ns: u64,
}

/// Slot of an open stream in its session. Dropping it frees the slot, and counts as a use of the session.
pub struct StreamGuard {
    handle: Arc<SessionHandle>,
    number: u64,
    cut: CancellationToken,
}

impl StreamGuard {
    /// Returns the token that is cancelled when an administrator cuts the stream; the stream should then end with
    /// [`cut`].
    pub fn cut(&self) -> &CancellationToken {
        &self.cut
    }

    /// Returns the rest shape of the session's tissue, by which messages number its points.
    pub fn shape(&self) -> &dyn RestShape {
        self.handle.model.shape()
    }
}

impl Drop for StreamGuard {
    fn drop(&mut self) {
        lock(&self.handle.streams).close(self.number);
        self.handle.asked_ns.store(now_ns(), Ordering::Relaxed);
    }
}

/// Returns the refusal that a stream ends with after an administrator has cut it ([`Reason::Cut`]).
pub fn cut() -> Refusal {
    Refusal::new(Reason::Cut, "", "an administrator of the server has ended this stream")
}

impl SessionHandle {
    /// Takes a slot for a further stream of `account`, opened by the call `what`. The stream is charged to `account`,
    /// with 480 KiB of memory for unread bytes, until the guard is dropped or the stream is cut.
    ///
    /// # Errors
    /// - [`Reason::TooMany`]: all slots of the session are taken (`limits.streams_per_session`); `kind` is
    ///   [`StreamKind::ReadsOnly`] and the caller has its part of the slots for such streams; or the account has its
    ///   part of the server's streams.
    /// - [`Reason::Overloaded`]: the memory exceeds the part of the account.
    pub fn open_stream(
        self: &Arc<Self>,
        what: &'static str,
        kind: StreamKind,
        account: &Account,
    ) -> Result<StreamGuard> {
        let stream = account.take(Resource::Streams, 1, "")?;
        let _taken = [stream, account.take(Resource::Memory(Purpose::Connections), UNSENT_BYTES, "")?];
        let mut streams = lock(&self.streams);
        let all = streams.open.len();
        if all >= streams.most || kind == StreamKind::ReadsOnly && !streams.readers.take(account.number(), 1) {
            let StreamSlots { most, readers, .. } = &*streams;
            let message = format!(
                "the session has {all} streams of {most} already, {} of those that only read are this caller's; the others \
                 are kept for other callers and for streams that hold tools",
                readers.of(account.number())
            );
            return Err(Refusal::new(Reason::TooMany, "", message));
        }
        streams.numbers += 1;
        let (number, cut) = (streams.numbers, CancellationToken::new());
        let open = OpenSlot { what, kind, account: account.clone(), since_ns: now_ns(), cut: cut.clone(), _taken };
        streams.open.insert(number, open);
        drop(streams);
        Ok(StreamGuard { handle: self.clone(), number, cut })
    }

    /// Returns the number of open streams of the session, of both kinds.
    pub fn streams(&self) -> usize {
        lock(&self.streams).open.len()
    }

    /// Describes the open streams, by ascending number, so oldest first.
    pub fn list_streams(&self) -> Vec<StreamInfo> {
        let now = now_ns();
        let show = |(number, open): (&u64, &OpenSlot)| StreamInfo {
            number: *number,
            what: open.what,
            kind: open.kind,
            caller: open.account.name().to_owned(),
            age_ns: now.saturating_sub(open.since_ns),
        };
        lock(&self.streams).open.iter().map(show).collect()
    }

    /// Cuts the streams for which `chosen` holds, by number and account, and returns how many. `chosen` runs under a
    /// lock. Their slots are free at once; their [`StreamGuard::cut`] tokens are cancelled.
    pub fn cut_streams(&self, chosen: impl Fn(u64, &Account) -> bool) -> usize {
        let mut streams = lock(&self.streams);
        let numbers: Vec<u64> =
            streams.open.iter().filter(|(number, open)| chosen(**number, &open.account)).map(|open| *open.0).collect();
        let cut: Vec<OpenSlot> = numbers.iter().filter_map(|number| streams.close(*number)).collect();
        drop(streams);
        cut.iter().for_each(|open| open.cut.cancel());
        cut.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Pacer;
    use palpate_session::budget::Budget;
    use palpate_tissue::limits::Limits;
    use palpate_tissue::scene::{PAPER, Scene};
    use palpate_tissue::select::scheme_selection::NEVER;

    #[test]
    fn who_reads_leaves_slots_to_others_and_to_who_holds_tools() {
        let limits = Limits { streams_per_session: 64, streams_for_holders: 4, ..Limits::default() };
        let scene = Scene::parse("paper", PAPER, &[], &limits).unwrap();
        let budget = Budget::new(&limits, 1, 1);
        let pacer = Pacer::start(1, 0.0, &limits, budget.clone()).unwrap();
        let handle = pacer.create(&scene, true, 60.0, &budget.account("owner"), &NEVER).unwrap();
        let [greedy, other] = ["greedy", "other"].map(|name| budget.account(name));
        let open = |kind, account: &Account| handle.open_stream("Test", kind, account);
        let mut all: Vec<_> = std::iter::from_fn(|| open(StreamKind::ReadsOnly, &greedy).ok()).collect();
        assert_eq!(all.len(), 57);
        all.push(open(StreamKind::ReadsOnly, &other).unwrap());
        all.extend(std::iter::from_fn(|| open(StreamKind::ReadsOnly, &other).ok()));
        // A stream that holds tools always finds the reserved slots.
        let holders: Vec<_> = (0..4).map(|_| open(StreamKind::HoldsTools, &other).unwrap()).collect();
        assert_eq!(handle.streams(), all.len() + 4);
        assert!(budget.taken(Resource::Streams) == handle.streams() as u64);
        // A cut stream frees its slot, even before its client notices.
        assert_eq!(handle.cut_streams(|_, account| account.number() == greedy.number()), 57);
        assert!(all[0].cut().is_cancelled() && !holders[0].cut().is_cancelled());
        assert!(open(StreamKind::ReadsOnly, &other).is_ok());
        drop((all, holders));
        assert_eq!((handle.streams(), budget.taken(Resource::Streams)), (0, 0));
        pacer.stop();
    }
}
