//! The two hands of one program, whose devices touch the same tissue.

use palpate_client::bridge::{HandSlot, two_hand_slots};

use crate::error::{CodedError, at_mut, guard, palpate_result};
use crate::server::free;

/// One of the two hands of a program, from `palpate_two_hands` to `palpate_hand_free`. Any thread.
pub struct palpate_hand {
    pub(crate) slot: HandSlot,
}

/// Creates the two hands of a program, for `hand` of `palpate_touch_options`. Begin two loops in one session, each with one
/// of the hands and with tools of its own: each hand's copy of the tissue then has the tools of the other hand at once,
/// without the delay of the network (of an instrument with more than 32 tips, the first 32). So it has an effect only if
/// the tissue is copied: with `prediction`, or for an instrument. Each hand serves one loop, also if that can't begin.
/// Writes two handles for `palpate_hand_free`. Any thread.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_two_hands(
    left: *mut *mut palpate_hand,
    right: *mut *mut palpate_hand,
) -> palpate_result {
    guard(|| {
        if left == right {
            return Err(CodedError::argument("left and right must be two places"));
        }
        // SAFETY: the caller's promises; they are two places.
        let places = unsafe { [at_mut(left, "left is null")?, at_mut(right, "right is null")?] };
        for (place, slot) in places.into_iter().zip(two_hand_slots()) {
            *place = Box::into_raw(Box::new(palpate_hand { slot }));
        }
        Ok(())
    })
}

/// Frees the handle of a hand; a loop that has begun with it continues. Null is allowed. Any thread, once.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn palpate_hand_free(hand: *mut palpate_hand) {
    // SAFETY: the caller's promise.
    guard(|| unsafe { free(hand) });
}
