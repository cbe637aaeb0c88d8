//! What two threads share so that neither waits for the other: a queue, and the newest of something.
//!
//! Each has one end that writes and one that reads. Every operation is a fixed number of steps, without a lock, a call of the
//! system or a request for memory. `tests/exchange.rs` checks all interleavings with loom.
#![allow(unsafe_code)]

use super::sync::{Arc, AtomicBool, AtomicUsize, Ordering, UnsafeCell};

/// A queue of a fixed length.
struct Queue<T> {
    /// As many as a power of two.
    places: Box<[UnsafeCell<Option<T>>]>,
    /// Values that were read, and written, in all.
    read: AtomicUsize,
    written: AtomicUsize,
    /// One of the ends was dropped.
    is_over: AtomicBool,
}

// SAFETY: a place is reached by one end at a time: from `read` to `written` by the reader, the others by the writer.
unsafe impl<T: Send> Sync for Queue<T> {}
// SAFETY: it owns its values.
unsafe impl<T: Send> Send for Queue<T> {}

/// The end of a queue that writes.
pub(crate) struct Writer<T>(Arc<Queue<T>>);

/// The end of a queue that reads.
pub(crate) struct Reader<T>(Arc<Queue<T>>);

/// A view of a queue.
pub(crate) struct Peek<T>(Arc<Queue<T>>);

/// A queue of at least `length` values.
pub(crate) fn queue<T>(length: usize) -> (Writer<T>, Reader<T>) {
    let places = (0..length.next_power_of_two()).map(|_| UnsafeCell::new(None)).collect();
    let queue =
        Queue { places, read: AtomicUsize::new(0), written: AtomicUsize::new(0), is_over: AtomicBool::new(false) };
    let queue = Arc::new(queue);
    (Writer(queue.clone()), Reader(queue))
}

impl<T> Queue<T> {
    fn place(&self, number: usize) -> &UnsafeCell<Option<T>> {
        &self.places[number & (self.places.len() - 1)]
    }
}

impl<T> Writer<T> {
    /// How many values fit now; more later, as they are read.
    pub(crate) fn room(&self) -> usize {
        let waiting = self.0.written.load(Ordering::Relaxed).wrapping_sub(self.0.read.load(Ordering::Acquire));
        self.0.places.len() - waiting
    }

    /// Adds a value; gives it back if the queue is full.
    pub(crate) fn push(&mut self, value: T) -> Result<(), T> {
        if self.room() == 0 {
            return Err(value);
        }
        let written = self.0.written.load(Ordering::Relaxed);
        // SAFETY: the reader leaves this place alone until `written` says that it is full, and has left it since it last was.
        self.0.place(written).with_mut(|place| unsafe { *place = Some(value) });
        self.0.written.store(written.wrapping_add(1), Ordering::Release);
        Ok(())
    }

    /// Whether the reader is gone.
    pub(crate) fn is_over(&self) -> bool {
        self.0.is_over.load(Ordering::Acquire)
    }

    /// A view of how full it is, for another thread.
    pub(crate) fn peek(&self) -> Peek<T> {
        Peek(self.0.clone())
    }
}

impl<T> Peek<T> {
    /// Whether values wait.
    pub(crate) fn is_waiting(&self) -> bool {
        self.0.read.load(Ordering::Relaxed) != self.0.written.load(Ordering::Relaxed)
    }

    /// Whether one of the ends is gone.
    pub(crate) fn is_over(&self) -> bool {
        self.0.is_over.load(Ordering::Acquire)
    }
}

impl<T> Reader<T> {
    /// Takes the oldest value.
    pub(crate) fn pop(&mut self) -> Option<T> {
        let read = self.0.read.load(Ordering::Relaxed);
        if read == self.0.written.load(Ordering::Acquire) {
            return None;
        }
        // SAFETY: the writer has filled this place, and leaves it alone until `read` says that it is empty.
        let value = self.0.place(read).with_mut(|place| unsafe { (*place).take() });
        self.0.read.store(read.wrapping_add(1), Ordering::Release);
        value
    }

    /// Whether the writer is gone. What it wrote before can still be read.
    pub(crate) fn is_over(&self) -> bool {
        self.0.is_over.load(Ordering::Acquire)
    }
}

impl<T> Drop for Writer<T> {
    fn drop(&mut self) {
        self.0.is_over.store(true, Ordering::Release);
    }
}

impl<T> Drop for Reader<T> {
    fn drop(&mut self) {
        self.0.is_over.store(true, Ordering::Release);
    }
}

/// Three values: one that is written, one that is read, and the newest between them.
struct Three<T> {
    places: [UnsafeCell<T>; 3],
    /// The number of the place between the two ends, and [`FRESH`] if it was not read yet.
    between: AtomicUsize,
}

/// Set by the writer, removed by the reader.
const FRESH: usize = 4;

// SAFETY: each of the three numbers is with the writer, with the reader, or in `between`: only who has it reaches its place.
unsafe impl<T: Send> Sync for Three<T> {}
// SAFETY: it owns its values.
unsafe impl<T: Send> Send for Three<T> {}

/// The end that writes the newest value.
pub(crate) struct Teller<T> {
    three: Arc<Three<T>>,
    own: usize,
}

/// The end that reads the newest value.
pub(crate) struct Listener<T> {
    three: Arc<Three<T>>,
    own: usize,
}

/// A value of which only the newest counts, and what it is at first.
pub(crate) fn newest<T: Clone>(first: T) -> (Teller<T>, Listener<T>) {
    let places = [first.clone(), first.clone(), first].map(UnsafeCell::new);
    let three = Arc::new(Three { places, between: AtomicUsize::new(1) });
    (Teller { three: three.clone(), own: 0 }, Listener { three, own: 2 })
}

impl<T> Teller<T> {
    /// Changes the value. `write` gets an older one to write over.
    pub(crate) fn tell(&mut self, write: impl FnOnce(&mut T)) {
        // SAFETY: `own` is with this end.
        self.three.places[self.own].with_mut(|place| write(unsafe { &mut *place }));
        self.own = self.three.between.swap(self.own | FRESH, Ordering::AcqRel) & !FRESH;
    }
}

impl<T> Listener<T> {
    /// Whether there is a newer value than before; it is then what [`Listener::read`] shows.
    pub(crate) fn refresh(&mut self) -> bool {
        let is_fresh = self.three.between.load(Ordering::Relaxed) & FRESH != 0;
        if is_fresh {
            self.own = self.three.between.swap(self.own, Ordering::AcqRel) & !FRESH;
        }
        is_fresh
    }

    /// Shows the newest value of the last [`Listener::refresh`].
    pub(crate) fn read<R>(&self, read: impl FnOnce(&T) -> R) -> R {
        // SAFETY: `own` is with this end.
        self.three.places[self.own].with(|place| read(unsafe { &*place }))
    }
}
