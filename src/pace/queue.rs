//! A bounded queue from a stepping thread to one reader. When it is full the oldest makes room: the writer never
//! waits, and the reader gets what is new.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;

use crate::refusal::{Reason, Refusal};

/// Locks a mutex whose holders leave no half-done work behind.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[derive(Debug)]
struct Inner<T> {
    items: VecDeque<T>,
    capacity: usize,
    dropped: u64,
    end: Option<Refusal>,
    abandoned: bool,
}

#[derive(Debug)]
struct Shared<T> {
    inner: Mutex<Inner<T>>,
    arrived: Notify,
}

/// The end that a stepping thread writes to.
#[derive(Debug)]
pub struct Writer<T>(Arc<Shared<T>>);

/// The end that a stream reads from. Dropping it tells the writer to stop.
#[derive(Debug)]
pub struct Reader<T>(Arc<Shared<T>>);

/// A queue of `capacity` items.
pub fn queue<T>(capacity: usize) -> (Writer<T>, Reader<T>) {
    let inner = Inner {
        // Grows if it must: a reader that keeps up needs room for one.
        items: VecDeque::new(),
        capacity: capacity.max(1),
        dropped: 0,
        end: None,
        abandoned: false,
    };
    let shared = Arc::new(Shared { inner: Mutex::new(inner), arrived: Notify::new() });
    (Writer(shared.clone()), Reader(shared))
}

impl<T> Writer<T> {
    /// Adds an item; drops the oldest if there is no room.
    pub fn push(&self, item: T) {
        let mut inner = lock(&self.0.inner);
        if inner.end.is_some() || inner.abandoned {
            return;
        }
        if inner.items.len() == inner.capacity {
            inner.items.pop_front();
            inner.dropped += 1;
        }
        inner.items.push_back(item);
        drop(inner);
        self.0.arrived.notify_one();
    }

    /// Takes back the newest item, if it has not been read.
    pub fn withdraw(&self) -> Option<T> {
        lock(&self.0.inner).items.pop_back()
    }

    /// Whether one more item would cost the oldest.
    pub fn is_full(&self) -> bool {
        let inner = lock(&self.0.inner);
        inner.items.len() == inner.capacity
    }

    /// No more items; the reader is told why when it has read the rest.
    pub fn close(&self, why: Refusal) {
        lock(&self.0.inner).end.get_or_insert(why);
        self.0.arrived.notify_one();
    }

    /// The reader has gone.
    pub fn is_abandoned(&self) -> bool {
        lock(&self.0.inner).abandoned
    }
}

impl<T> Drop for Writer<T> {
    fn drop(&mut self) {
        self.close(Refusal::new(Reason::SessionDeleted, "session_id", "the session has ended"));
    }
}

impl<T> Reader<T> {
    /// The oldest item, and how many were dropped so far; the reason when there are no more.
    pub async fn pop(&mut self) -> Result<(T, u64), Refusal> {
        loop {
            {
                let mut inner = lock(&self.0.inner);
                if let Some(item) = inner.items.pop_front() {
                    return Ok((item, inner.dropped));
                }
                if let Some(why) = &inner.end {
                    return Err(why.clone());
                }
            }
            self.0.arrived.notified().await;
        }
    }
}

impl<T> Drop for Reader<T> {
    fn drop(&mut self) {
        let mut inner = lock(&self.0.inner);
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
