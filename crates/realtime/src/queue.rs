//! A bounded queue from a stepping thread to one reader. A full queue drops its oldest item: the writer never
//! waits, and the reader gets the newest items.

use std::collections::VecDeque;
use std::future::poll_fn;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker};

use palpate_refusal::{Reason, Refusal};
use palpate_tissue::lock::lock;

#[derive(Debug)]
struct QueueState<T> {
    items: VecDeque<T>,
    capacity: usize,
    dropped: u64,
    end: Option<Refusal>,
    abandoned: bool,
    /// Waker of the reader, if it waits.
    waiting: Option<Waker>,
}

/// Writing end of a queue, used by a stepping thread; no function of it waits. Dropping it closes the queue with
/// [`Reason::SessionDeleted`].
#[derive(Debug)]
pub struct Writer<T>(Arc<Mutex<QueueState<T>>>);

/// Reading end of a queue, used by one stream. Dropping it discards the items: the writer finds the queue abandoned.
#[derive(Debug)]
pub struct Reader<T>(Arc<Mutex<QueueState<T>>>);

/// Readers to be woken together: waking one may cost more than the step whose sample it gets. Dropping it wakes none.
#[derive(Debug, Default)]
pub struct Wakes(Vec<Waker>);

impl Wakes {
    /// Returns the number of readers to be woken.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Returns whether there are no readers to be woken.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Wakes the readers, in the order in which they were added, and clears the list.
    pub fn wake(&mut self) {
        self.0.drain(..).for_each(Waker::wake);
    }
}

/// Creates a queue of at most `capacity` items; 0 counts as 1. Returns its two ends.
pub fn queue<T>(capacity: usize) -> (Writer<T>, Reader<T>) {
    let inner = QueueState {
        // It grows when needed: a reader that keeps up needs room for one item.
        items: VecDeque::new(),
        capacity: capacity.max(1),
        dropped: 0,
        end: None,
        abandoned: false,
        waiting: None,
    };
    let shared = Arc::new(Mutex::new(inner));
    (Writer(shared.clone()), Reader(shared))
}

impl<T> Writer<T> {
    /// Adds an item and wakes the reader. A full queue drops its oldest item and counts it; a closed or abandoned
    /// queue ignores the new one.
    pub fn push(&self, item: T) {
        if let Some(waker) = self.place(item) {
            waker.wake();
        }
    }

    /// Adds an item, and appends the reader, if it waits, to `wakes` for the caller to wake. A full queue drops its
    /// oldest item and counts it; a closed or abandoned queue ignores the new one.
    pub fn push_quietly(&self, item: T, wakes: &mut Wakes) {
        wakes.0.extend(self.place(item));
    }

    fn place(&self, item: T) -> Option<Waker> {
        let mut inner = lock(&self.0);
        if inner.end.is_some() || inner.abandoned {
            return None;
        }
        if inner.items.len() == inner.capacity {
            inner.items.pop_front();
            inner.dropped += 1;
        }
        inner.items.push_back(item);
        inner.waiting.take()
    }

    /// Counts one item as dropped that could not be produced. The reader learns of it with the next item.
    pub fn skip(&self) {
        lock(&self.0).dropped += 1;
    }

    /// Removes and returns the newest unread item, without counting it as dropped; `None` if all have been read.
    pub fn withdraw(&self) -> Option<T> {
        lock(&self.0).items.pop_back()
    }

    /// Returns whether a further item would displace the oldest.
    pub fn is_full(&self) -> bool {
        let inner = lock(&self.0);
        inner.items.len() == inner.capacity
    }

    /// Closes the queue and wakes the reader, which gets the remaining items and then `why`. A closed queue keeps its
    /// first reason.
    pub fn close(&self, why: Refusal) {
        let mut inner = lock(&self.0);
        inner.end.get_or_insert(why);
        let waiting = inner.waiting.take();
        drop(inner);
        if let Some(waker) = waiting {
            waker.wake();
        }
    }

    /// Returns whether the reader has been dropped.
    pub fn is_abandoned(&self) -> bool {
        lock(&self.0).abandoned
    }
}

impl<T> Drop for Writer<T> {
    fn drop(&mut self) {
        self.close(Refusal::new(Reason::SessionDeleted, "session_id", "the session has ended"));
    }
}

impl<T> Reader<T> {
    /// Waits for an item. Returns the oldest one, and the number of items that were dropped so far. The call may be
    /// cancelled at any time without losing an item.
    ///
    /// # Errors
    /// Returns the reason for which the queue was closed, after the last item; further calls return it again.
    pub async fn pop(&mut self) -> Result<(T, u64), Refusal> {
        poll_fn(|context| self.poll_pop(context)).await
    }

    /// Polls for an item. Returns the oldest one with the number of items dropped so far, or the reason if the queue
    /// is closed and empty. Otherwise it is pending, and the task of `context` is woken when one of these is there;
    /// it replaces a task that waited before.
    pub fn poll_pop(&mut self, context: &mut Context<'_>) -> Poll<Result<(T, u64), Refusal>> {
        let mut inner = lock(&self.0);
        if let Some(item) = inner.items.pop_front() {
            return Poll::Ready(Ok((item, inner.dropped)));
        }
        if let Some(why) = &inner.end {
            return Poll::Ready(Err(why.clone()));
        }
        if !inner.waiting.as_ref().is_some_and(|waker| waker.will_wake(context.waker())) {
            inner.waiting = Some(context.waker().clone());
        }
        Poll::Pending
    }
}

impl<T> Drop for Reader<T> {
    fn drop(&mut self) {
        let mut inner = lock(&self.0);
        inner.abandoned = true;
        inner.items.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_full_queue_keeps_the_newest_and_counts_the_rest() {
        let (writer, mut reader) = queue(3);
        for item in 0..10 {
            writer.push(item);
        }
        writer.close(Refusal::new(Reason::SessionDeleted, "", "over"));
        writer.push(10);
        for item in 7..10 {
            assert_eq!(reader.pop().await, Ok((item, 7)));
        }
        assert_eq!(reader.pop().await.unwrap_err().reason, Reason::SessionDeleted);
    }

    #[tokio::test]
    async fn what_is_not_read_can_be_taken_back() {
        let (writer, mut reader) = queue(1);
        assert_eq!(writer.withdraw(), None);
        writer.push(1);
        assert!(writer.is_full());
        assert_eq!(writer.withdraw(), Some(1));
        assert!(!writer.is_full());
        writer.push(2);
        assert_eq!(reader.pop().await, Ok((2, 0)));
    }

    #[tokio::test]
    async fn a_reader_that_waits_is_woken_and_one_that_left_is_noticed() {
        let (writer, mut reader) = queue(1);
        let thread = std::thread::spawn(move || {
            writer.push(5);
            writer
        });
        assert_eq!(reader.pop().await, Ok((5, 0)));
        let writer = thread.join().unwrap();
        drop(reader);
        assert!(writer.is_abandoned());
    }
}
