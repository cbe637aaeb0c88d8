//! Locks that survive a panic.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Locks a mutex; blocks until it is free. If an earlier holder panicked (a poisoned mutex), it still returns
/// the guard and does not panic: use it only where no holder can leave half-done work behind. A thread that
/// already holds the mutex deadlocks or panics, as with [`Mutex::lock`].
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
