//! Computations that can be cancelled, by a flag that the waiting thread sets or by a limit on the number of
//! operations.
//!
//! How long a mesh takes depends on how its triangles lie, which an untrusted user decides. So every loop whose work
//! is not bounded by a few passes over the mesh reports its operations here, with [`spend`]. It does not need to know
//! who is waiting: the limits belong to the thread while it is inside [`within`]. Outside, nothing is cancelled, as
//! in a program with a single user.
//!
//! A cancelled computation unwinds to `within`, as after a failed allocation. It leaves nothing in an inconsistent
//! state, because it changes only its own data.

use std::cell::{Cell, RefCell};
use std::panic::{AssertUnwindSafe, catch_unwind, resume_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// An operation takes a few nanoseconds, at most a tenth of a microsecond. The flag is checked after this many
/// operations: every few milliseconds.
const BETWEEN_LOOKS: u64 = 1 << 16;

/// Reason why a computation inside [`within`] was cancelled; [`spend`] unwinds with it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GivenUp {
    /// The flag was set.
    Stopped,
    /// It would have exceeded the limit, which is given here, in operations.
    TooMuch(u64),
}

/// Limits for the computation of a thread.
struct Bounds {
    stop: Arc<AtomicBool>,
    most: u64,
    /// Operations that are left after the next check.
    left: u64,
}

thread_local! {
    static BOUNDS: RefCell<Option<Bounds>> = const { RefCell::new(None) };
    /// Operations until the next check.
    static UP_TO_LOOK: Cell<u64> = const { Cell::new(u64::MAX) };
}

/// Restores the previous limits when dropped.
struct Before(Option<Bounds>, u64);

impl Drop for Before {
    fn drop(&mut self) {
        BOUNDS.set(self.0.take());
        UP_TO_LOOK.set(self.1);
    }
}

/// Runs `act` on this thread and returns its result. It is cancelled at a [`spend`] once `stop` is set or more than
/// `most` operations are reported; the flag is looked at every 65 536 operations, some milliseconds. Inside another
/// `within`, only these limits apply until it returns. What a cancelled `act` changed outside of itself stays as it
/// is. Other panics of `act` continue.
///
/// # Errors
/// Returns why `act` was cancelled: [`GivenUp::Stopped`] or [`GivenUp::TooMuch`].
pub fn within<T>(stop: &Arc<AtomicBool>, most: u64, act: impl FnOnce() -> T) -> Result<T, GivenUp> {
    let bounds = Bounds { stop: stop.clone(), most, left: most };
    let before = Before(BOUNDS.replace(Some(bounds)), UP_TO_LOOK.replace(0));
    let done = catch_unwind(AssertUnwindSafe(act));
    drop(before);
    done.map_err(|panic| match panic.downcast::<GivenUp>() {
        Ok(given_up) => *given_up,
        Err(panic) => resume_unwind(panic),
    })
}

/// Reports that `operations`, of some nanoseconds each, follow on this thread. Inside [`within`], unwinds to it with a
/// [`GivenUp`] if the computation is cancelled; outside, does nothing.
#[inline]
pub fn spend(operations: usize) {
    let (operations, up_to_look) = (operations as u64, UP_TO_LOOK.get());
    if operations < up_to_look {
        UP_TO_LOOK.set(up_to_look - operations);
    } else {
        look(operations);
    }
}

/// Checks the limits before `operations` more.
#[cold]
fn look(operations: u64) {
    let given_up = BOUNDS.with_borrow_mut(|bounds| {
        let Some(bounds) = bounds else {
            UP_TO_LOOK.set(u64::MAX);
            return None;
        };
        if bounds.stop.load(Ordering::Relaxed) {
            return Some(GivenUp::Stopped);
        }
        let had = bounds.left.saturating_add(UP_TO_LOOK.get());
        let Some(left) = had.checked_sub(operations) else { return Some(GivenUp::TooMuch(bounds.most)) };
        let up_to_look = left.min(BETWEEN_LOOKS);
        bounds.left = left - up_to_look;
        UP_TO_LOOK.set(up_to_look);
        None
    });
    if let Some(given_up) = given_up {
        resume_unwind(Box::new(given_up));
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::panic)]
    use super::*;

    fn flag() -> Arc<AtomicBool> {
        Arc::default()
    }

    #[test]
    fn work_ends_soon_after_its_flag_is_set_and_after_as_many_operations_as_it_may_take() {
        let (stop, mut done) = (flag(), 0_u64);
        let ended = within(&stop, u64::MAX, || {
            loop {
                spend(10);
                done += 10;
                stop.store(done > 1_000_000, Ordering::Relaxed);
            }
        });
        let ended: Result<(), GivenUp> = ended;
        assert_eq!(ended, Err(GivenUp::Stopped));
        assert!(done < 1_000_000 + 2 * BETWEEN_LOOKS, "{done}");
        for most in [0, 1, 7, 1000, 3 * BETWEEN_LOOKS + 5] {
            let done = Cell::new(0);
            let ended: Result<(), GivenUp> = within(&flag(), most, || {
                loop {
                    spend(1);
                    done.set(done.get() + 1);
                }
            });
            assert_eq!((ended, done.get()), (Err(GivenUp::TooMuch(most)), most));
        }
    }

    #[test]
    fn what_keeps_within_its_bounds_is_done_and_what_comes_after_has_none() {
        let spend_all = |count: usize| {
            (0..count).for_each(|_| spend(1000));
            count
        };
        assert_eq!(within(&flag(), 1_000_000, || spend_all(1000)), Ok(1000));
        let inner = within(&flag(), 10_000, || within(&flag(), 100, || spend_all(1)));
        assert_eq!(inner, Ok(Err(GivenUp::TooMuch(100))));
        assert_eq!(
            within(&flag(), 10_000, || (within(&flag(), 5000, || spend_all(2)), spend_all(10))),
            Ok((Ok(2), 10))
        );
        assert_eq!(spend_all(100_000), 100_000);
        let fault = catch_unwind(|| within(&flag(), 5, || panic!("a test"))).map(|_: Result<(), GivenUp>| ());
        assert_eq!(fault.unwrap_err().downcast_ref(), Some(&"a test"));
        assert_eq!(spend_all(100), 100);
    }
}
