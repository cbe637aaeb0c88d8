//! Allocates memory that the system may refuse.
//!
//! A failed allocation ends the process. Memory that grows with a request or a session is therefore allocated
//! here, where a failure is a [`Refusal`]. Code that returns a `Result` calls `check`. Code deep in a
//! computation calls `zeroed`, `filled`, `with_room`, `collected` or `require`: these unwind with the refusal,
//! like a panic, and [`attempt`] returns it where the call or session is known.
//!
//! Allocations below [`LARGE_BYTES`] and those inside libraries can't be refused. So each large one must leave
//! [`HEADROOM_BYTES`] for them.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};

use bytemuck::Zeroable;
use bytemuck::allocation::try_zeroed_vec;

use palpate_refusal::{Reason, Refusal, Result};

/// Smallest allocation that is checked: 64 KiB, in bytes. The functions of this module don't check the headroom
/// for smaller ones.
pub const LARGE_BYTES: usize = 64 << 10;

/// Bytes that must remain available after a large allocation, for small ones: 64 MiB. More than 32 MiB, because
/// the GNU allocator returns such memory to the system at once and changes none of its thresholds.
pub const HEADROOM_BYTES: usize = 64 << 20;

fn refused(bytes: usize, what: &str) -> Refusal {
    let message = format!("the system has no memory for {what}: {bytes} bytes, and {HEADROOM_BYTES} for all else");
    Refusal::new(Reason::Overloaded, "", message)
}

/// Returns whether the system would give `bytes` now.
fn is_available(bytes: usize) -> bool {
    let mut memory = Vec::<u8>::new();
    let reserved = memory.try_reserve_exact(bytes).is_ok();
    // The compiler may remove an allocation that nothing uses, and assumes that it succeeds.
    std::hint::black_box(&mut memory);
    reserved
}

/// Checks that the system would give `bytes` now, and [`HEADROOM_BYTES`] besides. Nothing is reserved: another
/// thread may take them first. Below [`LARGE_BYTES`] it checks nothing. `what` names the purpose in the refusal
/// ("a texture").
///
/// # Errors
/// Refuses if the memory is not there ([`Reason::Overloaded`], with an empty field).
pub fn check(bytes: u64, what: &str) -> Result<()> {
    let bytes = usize::try_from(bytes).unwrap_or(usize::MAX);
    if bytes < LARGE_BYTES || is_available(bytes.saturating_add(HEADROOM_BYTES)) {
        Ok(())
    } else {
        Err(refused(bytes, what))
    }
}

/// Checks, as [`check`] does, that the system would give `bytes` now, and the headroom: before many small
/// allocations. `what` names their purpose in the refusal. If the memory is not there, it unwinds with the
/// refusal, which [`attempt`] returns.
pub fn require(bytes: u64, what: &str) {
    if let Err(refusal) = check(bytes, what) {
        resume_unwind(Box::new(refusal));
    }
}

/// Returns `values` if their allocation succeeded and leaves the headroom; otherwise unwinds with a refusal.
fn kept<T, E>(values: std::result::Result<Vec<T>, E>, length: usize, what: &str) -> Vec<T> {
    let bytes = length.saturating_mul(size_of::<T>());
    match values {
        Ok(values) if bytes < LARGE_BYTES || is_available(HEADROOM_BYTES) => values,
        _ => resume_unwind(Box::new(refused(bytes, what))),
    }
}

/// Returns `length` zeros. The system supplies their pages at the first write. `what` names their purpose in
/// the refusal.
///
/// If there is no memory for them, or (from [`LARGE_BYTES`] on) for [`HEADROOM_BYTES`] besides, it unwinds with
/// a refusal, which [`attempt`] returns.
pub fn zeroed<T: Zeroable>(length: usize, what: &str) -> Vec<T> {
    kept(try_zeroed_vec(length), length, what)
}

/// Returns `length` copies of `value`. Unwinds with a refusal that names `what` if there is no memory, as
/// [`zeroed`] does.
pub fn filled<T: Clone>(length: usize, value: T, what: &str) -> Vec<T> {
    let mut values = with_room(length, what);
    values.resize(length, value);
    values
}

/// Returns an empty vector with room for at least `capacity` values. Unwinds with a refusal that names `what`
/// if there is no memory, as [`zeroed`] does.
pub fn with_room<T>(capacity: usize, what: &str) -> Vec<T> {
    let mut values = Vec::new();
    let reserved = values.try_reserve_exact(capacity).map(|()| values);
    kept(reserved, capacity, what)
}

/// Collects `values` into a vector, in their order. Unwinds with a refusal that names `what` if there is no
/// memory for as many values as the iterator announces, as [`zeroed`] does.
pub fn collected<T>(values: impl ExactSizeIterator<Item = T>, what: &str) -> Vec<T> {
    let mut vector = with_room(values.len(), what);
    vector.extend(values);
    vector
}

/// Returns the refusal with which a thread unwound, from the payload of `catch_unwind` or `join`; `None` if the
/// panic had another cause.
pub fn refusal_of(panic: &(dyn Any + Send)) -> Option<&Refusal> {
    panic.downcast_ref()
}

/// Runs `work` and catches a refusal with which it unwinds ([`require`], [`zeroed`]), so that this is an error
/// as well. It puts `field` before the field of such a refusal, and leaves a refusal that `work` returns as it
/// is. Other panics continue. What `work` was changing may be half done.
///
/// # Errors
/// Returns the refusal that `work` returns or unwinds with.
pub fn attempt<T>(field: &str, work: impl FnOnce() -> Result<T>) -> Result<T> {
    catch_unwind(AssertUnwindSafe(work)).unwrap_or_else(|panic| match panic.downcast::<Refusal>() {
        Ok(refusal) => Err(refusal.within(field)),
        Err(panic) => resume_unwind(panic),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// No machine has so much.
    const TOO_MUCH: usize = 1 << 60;

    #[test]
    fn what_can_not_be_had_is_refused_in_words() {
        let refused = [
            attempt("sheet", || Ok(zeroed::<u8>(TOO_MUCH, "a sheet").len())),
            attempt("sheet", || Ok(filled(TOO_MUCH, 1.0, "a sheet").len())),
            attempt("sheet", || Ok(with_room::<[f32; 3]>(TOO_MUCH, "a sheet").len())),
            attempt("sheet", || {
                require(TOO_MUCH as u64, "a sheet");
                Ok(0)
            }),
        ];
        for refused in refused {
            let refusal = refused.unwrap_err();
            assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::Overloaded, "sheet"));
            assert!(refusal.message.contains("no memory for a sheet"), "{refusal}");
        }
        assert_eq!(check(u64::MAX, "a sheet").unwrap_err().reason, Reason::Overloaded);
    }

    #[test]
    fn what_can_be_had_is_as_asked_for() {
        assert_eq!(zeroed::<f64>(LARGE_BYTES, "zeros"), vec![0.0; LARGE_BYTES]);
        assert_eq!(filled(3, 7, "sevens"), [7; 3]);
        assert_eq!(collected((1..4).map(|n| n * n), "squares"), [1, 4, 9]);
        let room = with_room::<u32>(1000, "numbers");
        assert!(room.is_empty() && room.capacity() >= 1000);
        check(1 << 20, "a megabyte").unwrap();
        assert_eq!(attempt("", || Ok(5)), Ok(5));
    }

    #[test]
    fn a_fault_is_no_refusal() {
        let fault = catch_unwind(|| attempt("", || -> Result<()> { panic!("a test") })).unwrap_err();
        assert_eq!(fault.downcast_ref(), Some(&"a test"));
        assert!(refusal_of(&*fault).is_none());
    }
}
