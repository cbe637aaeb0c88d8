//! Reading of large sheets: hashes, and records of many points. A stepping thread copies the sheet ([`ReadCopy`]).
//! A thread with a lower priority, named `records`, reads the copies in slices, with turns among the callers; what
//! one caller requests is read in order. The same thread frees the memory of deleted sessions.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError, Weak};

use tokio::sync::oneshot;

use super::queue::Writer;
use palpate_refusal::{Refusal, Result};
use palpate_session::budget::{Account, Purpose, Resource, Taken, Turns};
use palpate_session::{Session, record_of};
use palpate_tissue::lock::lock;
use palpate_tissue::memory;
use palpate_tissue::scene::record::Record;
use palpate_tissue::shape::PointId;
use palpate_tissue::{Hashing, ReadCopy};

/// A record and its step. All streams that asked for equal records at a step share one.
pub type SharedRecord = Arc<Recorded>;

/// A record that was measured at one step. Its memory stays charged until the last stream drops it.
#[derive(Debug)]
pub struct Recorded {
    /// Number of steps done before the measurement.
    pub step: u64,
    /// The measured points, in the order of the request, with the energies and tools that were requested.
    pub record: Record,
    /// Memory of the record.
    pub(super) _taken: Taken,
}

/// Number of points that the stepping thread always reads itself: it takes some tenths of a millisecond.
const AT_ONCE_POINTS: usize = 1024;

/// Number of points that can be copied in the time of reading one.
const COPIED_PER_READ: usize = 64;

/// Number of points in a slice, which takes less than a millisecond.
const SLICE_POINTS: usize = 1024;

/// Returns whether the stepping thread copies a sheet of `all` points rather than read `points` of them itself.
pub(super) fn is_much(points: usize, all: usize) -> bool {
    points > AT_ONCE_POINTS.max(all / COPIED_PER_READ)
}

/// A copy of a sheet, with its memory.
pub(super) struct Copied {
    copy: Mutex<ReadCopy>,
    _taken: Taken,
}

/// The newest copy of a session's sheet, while it is still being read.
#[derive(Default)]
pub(super) struct Copies {
    newest: Weak<Copied>,
    step: u64,
}

impl Copies {
    /// Returns a copy of the present state, which all readers of this moment share. The first reader's account is
    /// charged for its memory.
    pub(super) fn of(&mut self, session: &Session, account: &Account) -> Result<Arc<Copied>> {
        let step = session.step_count();
        if let Some(copied) = self.newest.upgrade().filter(|_| self.step == step) {
            return Ok(copied);
        }
        let _taken = account.take(Resource::Memory(Purpose::Records), session.model().state_bytes(), "")?;
        let copy = memory::attempt("", || Ok(session.copy()))?;
        let copied = Arc::new(Copied { copy: Mutex::new(copy), _taken });
        (self.newest, self.step) = (Arc::downgrade(&copied), step);
        Ok(copied)
    }

    /// Forgets the copy, because the session continues: commands and changes may act before a step has been
    /// counted.
    pub(super) fn forget(&mut self) {
        self.newest = Weak::new();
    }
}

/// The newest hash, with its step.
pub(super) type Hashed = Arc<Mutex<Option<(u64, u128)>>>;

/// Receiver of a state's step and hash.
pub(super) type HashReply = oneshot::Sender<Result<(u64, u128)>>;

/// A stream of records, with the number of records on their way to it.
#[derive(Debug)]
pub(super) struct Recipient {
    writer: Writer<SharedRecord>,
    most: usize,
    pending: AtomicUsize,
}

impl Recipient {
    /// Creates a recipient of at most `most` unfinished records.
    pub(super) fn new(writer: Writer<SharedRecord>, most: usize) -> Arc<Self> {
        Arc::new(Recipient { writer, most, pending: AtomicUsize::new(0) })
    }

    /// Returns the writing end of its queue.
    pub(super) fn writer(&self) -> &Writer<SharedRecord> {
        &self.writer
    }

    /// Returns whether the limit of unfinished records is reached.
    pub(super) fn is_behind(&self) -> bool {
        self.pending.load(Ordering::Acquire) >= self.most
    }
}

/// Work for the reading thread.
pub(super) enum Piece {
    Hash {
        copied: Arc<Copied>,
        hashing: Hashing,
        step: u64,
        hashed: Hashed,
        reply: HashReply,
    },
    Record {
        copied: Arc<Copied>,
        /// All points, if `None`.
        points: Option<Arc<[PointId]>>,
        step: u64,
        /// The record, with the points that were read so far.
        record: Record,
        taken: Taken,
        to: Vec<Arc<Recipient>>,
    },
    /// A computation of some milliseconds.
    Work(Box<dyn FnOnce() + Send>),
    /// Memory of a deleted session, to be freed.
    Remains(Box<dyn Send>),
    /// Closes a stream after its last record.
    Close {
        to: Arc<Recipient>,
        why: Refusal,
    },
}

impl Piece {
    /// Reads a slice. Returns the rest, if there is one and someone waits for it.
    fn read(self) -> Option<Self> {
        match self {
            Piece::Hash { copied, mut hashing, step, hashed, reply } => {
                if reply.is_closed() {
                    return None;
                }
                let hash = lock(&copied.copy).hash(&mut hashing, SLICE_POINTS);
                let Some(hash) = hash else { return Some(Piece::Hash { copied, hashing, step, hashed, reply }) };
                *lock(&hashed) = Some((step, hash));
                let _ = reply.send(Ok((step, hash)));
                None
            }
            Piece::Record { copied, points, step, mut record, taken, to } => {
                if to.iter().all(|recipient| recipient.writer.is_abandoned()) {
                    return None;
                }
                let copy = lock(&copied.copy);
                let all = points.as_ref().map_or(copy.model().len(), |points| points.len());
                let from = record.points.len();
                if from == 0 {
                    record.points = memory::with_room(all, "a record");
                }
                let point = |index| points.as_ref().map_or_else(|| PointId::new(index), |named| named[index]);
                let slice = from..all.min(from + SLICE_POINTS);
                record.points.extend(slice.map(|index| record_of(&copy, point(index))));
                drop(copy);
                if record.points.len() < all {
                    return Some(Piece::Record { copied, points, step, record, taken, to });
                }
                let record = Arc::new(Recorded { step, record, _taken: taken });
                for recipient in to {
                    recipient.writer.push(record.clone());
                    recipient.pending.fetch_sub(1, Ordering::AcqRel);
                }
                None
            }
            Piece::Work(work) => {
                work();
                None
            }
            Piece::Remains(remains) => {
                drop(remains);
                None
            }
            Piece::Close { to, why } => {
                to.writer.close(why);
                None
            }
        }
    }
}

#[derive(Default)]
struct PieceQueue {
    waiting: Turns<Piece>,
    stop: bool,
}

/// The thread that reads, and its queue.
#[derive(Default)]
pub(super) struct Reading {
    board: Mutex<PieceQueue>,
    posted: Condvar,
}

impl Reading {
    /// Queues a piece to be read for `account`. The queue is bounded by the memory of the copies, which is charged,
    /// and for each stream by [`Recipient::is_behind`].
    pub(super) fn post(&self, account: &Account, piece: Piece) {
        if let Piece::Record { to, .. } = &piece {
            to.iter().for_each(|recipient| _ = recipient.pending.fetch_add(1, Ordering::AcqRel));
        }
        lock(&self.board).waiting.push_back(account.number(), piece);
        self.posted.notify_one();
    }

    /// Closes a stream of records of `account`, after the records that are on their way.
    pub(super) fn close(&self, account: &Account, to: &Arc<Recipient>, why: Refusal) {
        if to.pending.load(Ordering::Acquire) == 0 {
            to.writer.close(why);
        } else {
            self.post(account, Piece::Close { to: to.clone(), why });
        }
    }

    /// Makes the thread end.
    pub(super) fn stop(&self) {
        lock(&self.board).stop = true;
        self.posted.notify_one();
    }

    /// Runs the thread until [`Reading::stop`].
    pub(super) fn work(&self) {
        loop {
            let idle = |board: &mut PieceQueue| board.waiting.is_empty() && !board.stop;
            let waited = self.posted.wait_while(lock(&self.board), idle).unwrap_or_else(PoisonError::into_inner);
            if waited.stop {
                return;
            }
            drop(waited);
            self.read();
        }
    }

    /// Reads one slice.
    fn read(&self) {
        let Some((account, piece)) = lock(&self.board).waiting.next(|_| true) else { return };
        let recipients = match &piece {
            Piece::Record { to, .. } => to.clone(),
            Piece::Hash { .. } | Piece::Work(_) | Piece::Remains(_) | Piece::Close { .. } => Vec::new(),
        };
        match catch_unwind(AssertUnwindSafe(|| piece.read())) {
            Ok(None) => {}
            // It goes before the caller's next piece, which may have come meanwhile.
            Ok(Some(rest)) => lock(&self.board).waiting.push_front(account, rest),
            Err(panic) => {
                if memory::refusal_of(&*panic).is_none() {
                    tracing::error!("a fault of the program ended the reading of a sheet");
                }
                for recipient in recipients {
                    recipient.writer.skip();
                    recipient.pending.fetch_sub(1, Ordering::AcqRel);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use tokio::sync::oneshot;

    use super::*;
    use crate::queue::{Reader, queue};
    use palpate_session::budget::Budget;
    use palpate_tissue::Model;
    use palpate_tissue::limits::Limits;

    /// Four slices of points.
    fn session() -> Session {
        Session::new(&Model::parse("paper", palpate_tissue::scene::PAPER, &["sheet.points=[64, 64]"]).unwrap())
    }

    const SLICES: usize = 4;

    fn record(copied: &Arc<Copied>, step: u64, to: &Arc<Recipient>, account: &Account) -> Piece {
        let taken = account.take(Resource::Memory(Purpose::Records), 1, "").unwrap();
        let (copied, record) = (copied.clone(), Record::default());
        Piece::Record { copied, points: None, step, record, taken, to: vec![to.clone()] }
    }

    fn recipient(most: usize) -> (Arc<Recipient>, Reader<SharedRecord>) {
        let (writer, reader) = queue(most);
        (Recipient::new(writer, most), reader)
    }

    #[tokio::test]
    async fn callers_have_their_turns_slice_by_slice_and_each_is_told_in_order() {
        let budget = Budget::new(&Limits::default(), 1, 1);
        let [greedy, other] = ["greedy", "other"].map(|name| budget.account(name));
        let (session, mut copies, reading) = (session(), Copies::default(), Reading::default());
        let copied = copies.of(&session, &greedy).unwrap();
        let (to, mut records) = recipient(8);
        for step in 0..5 {
            reading.post(&greedy, record(&copied, step, &to, &greedy));
        }
        let (reply, mut answer) = oneshot::channel();
        let (hashing, hashed) = (Hashing::default(), Hashed::default());
        let hash = Piece::Hash { copied: copied.clone(), hashing, step: 7, hashed: hashed.clone(), reply };
        reading.post(&other, hash);
        let mut slices = 0;
        let answered = loop {
            reading.read();
            slices += 1;
            if let Ok(answered) = answer.try_recv() {
                break answered.unwrap();
            }
        };
        // A caller with five records under way delays another by one slice in each turn.
        assert_eq!(slices, 2 * SLICES);
        assert_eq!(answered, (7, session.tissue().state_hash()));
        assert_eq!(*lock(&hashed), Some(answered));
        while !lock(&reading.board).waiting.is_empty() {
            reading.read();
            slices += 1;
        }
        assert_eq!(slices, 6 * SLICES);
        let whole = format!("{:?}", session.record(None).points);
        for step in 0..5 {
            let recorded = records.pop().await.unwrap().0;
            assert_eq!(recorded.step, step);
            assert!(format!("{:?}", recorded.record.points) == whole);
        }
    }

    #[tokio::test]
    async fn what_is_under_way_to_one_stream_is_bounded_and_comes_before_its_end() {
        let account = Account::alone();
        let (session, mut copies, reading) = (session(), Copies::default(), Reading::default());
        let copied = copies.of(&session, &account).unwrap();
        let (to, mut records) = recipient(2);
        assert!(!to.is_behind());
        reading.post(&account, record(&copied, 0, &to, &account));
        reading.post(&account, record(&copied, 1, &to, &account));
        assert!(to.is_behind());
        let over = Refusal::new(palpate_refusal::Reason::SessionHeld, "", "over");
        reading.close(&account, &to, over.clone());
        while !lock(&reading.board).waiting.is_empty() {
            reading.read();
        }
        assert!(!to.is_behind());
        let steps = [records.pop().await.unwrap().0.step, records.pop().await.unwrap().0.step];
        assert_eq!(steps, [0, 1]);
        assert_eq!(records.pop().await.unwrap_err(), over);
    }

    #[test]
    fn readers_of_one_moment_share_a_copy_and_its_memory_is_given_back() {
        let account = Budget::new(&Limits::default(), 1, 1).account("a");
        let has = || account.has(Resource::Memory(Purpose::Records));
        let (session, mut copies) = (session(), Copies::default());
        let copied = copies.of(&session, &account).unwrap();
        let bytes = session.model().state_bytes();
        assert!(Arc::ptr_eq(&copied, &copies.of(&session, &account).unwrap()) && has() == bytes);
        // Something may have acted since, though no step was counted.
        copies.forget();
        let later = copies.of(&session, &account).unwrap();
        assert!(!Arc::ptr_eq(&copied, &later) && has() == 2 * bytes);
        drop((copied, later));
        assert_eq!(has(), 0);
    }

    #[test]
    fn few_points_are_read_at_once_and_many_from_a_copy() {
        assert!(!is_much(961, 961) && is_much(1025, 1025));
        // Of a large sheet a copy costs more than to read some thousand points.
        assert!(!is_much(10_000, 1 << 20) && is_much(20_000, 1 << 20));
    }
}
