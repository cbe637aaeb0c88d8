//! Data that two threads share so that neither waits for the other: a queue, and the newest value of something.
//!
//! Each has one end that writes and one that reads. No operation takes a lock, calls the system or allocates memory;
//! `tests/tick.rs` counts the allocations of a device's loop.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use rtrb::{Consumer, Producer, PushError, RingBuffer};
use triple_buffer::{Input, Output, TripleBuffer};

/// The state of a queue that a third thread can see.
#[derive(Default)]
struct QueueStatus {
    /// Number of waiting values. The ends count separately, so it may be off by one for a moment.
    waiting: AtomicUsize,
    /// Whether one of the ends was dropped.
    is_over: AtomicBool,
}

/// The writing end of a queue.
pub(crate) struct QueueWriter<T> {
    values: Producer<T>,
    status: Arc<QueueStatus>,
}

/// The reading end of a queue.
pub(crate) struct QueueReader<T> {
    values: Consumer<T>,
    status: Arc<QueueStatus>,
}

/// A view of a queue, for a third thread.
pub(crate) struct QueueView(Arc<QueueStatus>);

/// Creates a queue of at most `length` values.
pub(crate) fn queue<T>(length: usize) -> (QueueWriter<T>, QueueReader<T>) {
    let (writer, reader) = RingBuffer::new(length);
    let status = Arc::<QueueStatus>::default();
    (QueueWriter { values: writer, status: status.clone() }, QueueReader { values: reader, status })
}

impl<T> QueueWriter<T> {
    /// Returns how many values fit now.
    pub(crate) fn room(&self) -> usize {
        self.values.slots()
    }

    /// Appends a value.
    ///
    /// # Errors
    /// Returns the value if the queue is full.
    pub(crate) fn push(&mut self, value: T) -> Result<(), T> {
        self.values.push(value).map_err(|PushError::Full(value)| value)?;
        self.status.waiting.fetch_add(1, Ordering::Release);
        Ok(())
    }

    /// Returns whether the reader is gone.
    pub(crate) fn is_over(&self) -> bool {
        self.values.is_abandoned()
    }

    /// Returns a view of the queue, for another thread.
    pub(crate) fn view(&self) -> QueueView {
        QueueView(self.status.clone())
    }
}

impl QueueView {
    /// Returns whether values wait.
    pub(crate) fn is_waiting(&self) -> bool {
        self.0.waiting.load(Ordering::Acquire) != 0
    }

    /// Returns whether one of the ends is gone.
    pub(crate) fn is_over(&self) -> bool {
        self.0.is_over.load(Ordering::Acquire)
    }
}

impl<T> QueueReader<T> {
    /// Takes the oldest value; `None` if the queue is empty.
    pub(crate) fn pop(&mut self) -> Option<T> {
        let value = self.values.pop().ok()?;
        self.status.waiting.fetch_sub(1, Ordering::Release);
        Some(value)
    }

    /// Returns whether the writer is gone. What it wrote can still be read.
    pub(crate) fn is_over(&self) -> bool {
        self.values.is_abandoned()
    }
}

impl<T> Drop for QueueWriter<T> {
    fn drop(&mut self) {
        self.status.is_over.store(true, Ordering::Release);
    }
}

impl<T> Drop for QueueReader<T> {
    fn drop(&mut self) {
        self.status.is_over.store(true, Ordering::Release);
    }
}

/// The end that writes the newest value.
pub(crate) struct NewestWriter<T: Send>(Input<T>);

/// The end that reads the newest value.
pub(crate) struct NewestReader<T: Send>(Output<T>);

/// Creates a shared value of which only the newest version counts, with its first version.
pub(crate) fn newest<T: Clone + Send>(first: &T) -> (NewestWriter<T>, NewestReader<T>) {
    let (writer, reader) = TripleBuffer::new(first).split();
    (NewestWriter(writer), NewestReader(reader))
}

impl<T: Send> NewestWriter<T> {
    /// Publishes a new value. `write` overwrites an older one.
    pub(crate) fn write(&mut self, write: impl FnOnce(&mut T)) {
        write(self.0.input_buffer_mut());
        self.0.publish();
    }
}

impl<T: Send> NewestReader<T> {
    /// Takes a newer value, if there is one, for [`NewestReader::read`]. Returns whether there was one.
    pub(crate) fn refresh(&mut self) -> bool {
        self.0.update()
    }

    /// Returns the value that the last [`NewestReader::refresh`] took.
    pub(crate) fn read(&self) -> &T {
        self.0.peek_output_buffer()
    }
}
