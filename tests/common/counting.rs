//! The system's allocator, which counts what a thread has of it: a test binary that has this is its own.
#![allow(unsafe_code, dead_code, unreachable_pub, clippy::cast_possible_wrap, clippy::cast_sign_loss)]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

thread_local! {
    /// Bytes that this thread has, and the most that it has had; what other threads free for it is not known.
    static NOW: Cell<isize> = const { Cell::new(0) };
    static PEAK: Cell<isize> = const { Cell::new(0) };
    /// A large piece that was asked for last. If it goes back at once, it was a question (`palpate_tissue::memory`)
    /// and never had a page.
    static ASKED: Cell<isize> = const { Cell::new(0) };
}

/// From this size on a piece may be a question.
const LARGE: isize = 64 << 20;

struct Counting;

fn add(bytes: isize) {
    let asked = ASKED.take();
    if asked > 0 && bytes != -asked {
        PEAK.set(PEAK.get().max(NOW.get()));
    }
    NOW.set(NOW.get() + bytes);
    if bytes >= LARGE {
        ASKED.set(bytes);
    } else {
        PEAK.set(PEAK.get().max(NOW.get()));
    }
}

// SAFETY: it only counts.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        add(layout.size() as isize);
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        add(layout.size() as isize);
        // SAFETY: the caller's promise.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, place: *mut u8, layout: Layout) {
        add(-(layout.size() as isize));
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(place, layout) }
    }

    // Large memory is moved by its pages, so that old and new are not there at once.
    unsafe fn realloc(&self, place: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        add(size as isize - layout.size() as isize);
        // SAFETY: the caller's promise.
        unsafe { System.realloc(place, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Returns the result of `work`, and the largest number of bytes that it had at once, including the result.
pub fn counted<T>(work: impl FnOnce() -> T) -> (T, usize) {
    let before = NOW.get();
    PEAK.set(before);
    let result = work();
    add(0);
    (result, (PEAK.get() - before).max(0) as usize)
}
