//! Hands for programs that have them by handle, as in C and Python: a loop takes each of them once.

use std::sync::{Arc, Mutex, PoisonError};

use super::hands::{BridgeHand, two_hands};
use crate::Error;

/// One of two hands until a loop takes it. Clones are the same hand.
#[derive(Debug, Clone)]
pub struct HandSlot {
    pair: Arc<Mutex<HandPair>>,
    /// Index in [`HandPair::hands`].
    number: usize,
}

/// What both hands share.
#[derive(Debug)]
struct HandPair {
    /// The hands that no loop has taken yet.
    hands: [Option<BridgeHand>; 2],
    /// The session that the first of them touches.
    session_id: Option<String>,
}

/// Creates the two hands of one client ([`two_hands`]), to be taken later.
pub fn two_hand_slots() -> [HandSlot; 2] {
    let pair = Arc::new(Mutex::new(HandPair { hands: two_hands().map(Some), session_id: None }));
    [0, 1].map(|number| HandSlot { pair: pair.clone(), number })
}

impl HandSlot {
    /// Takes the hand for a loop that touches a session.
    ///
    /// # Errors
    /// Returns [`Error::Argument`] if a loop has taken it before, or if the other hand touches another session. Then nothing is
    /// taken.
    pub fn take(&self, session_id: &str) -> Result<BridgeHand, Error> {
        let refuse = |why: &str| Error::Argument(format!("hand: {why}"));
        let mut pair = self.pair.lock().unwrap_or_else(PoisonError::into_inner);
        if pair.session_id.as_deref().is_some_and(|other| other != session_id) {
            return Err(refuse("the other hand touches another session"));
        }
        let hand = pair.hands[self.number].take();
        let hand = hand.ok_or_else(|| refuse("a loop has used this hand before: make two new ones"))?;
        pair.session_id.get_or_insert_with(|| session_id.to_owned());
        Ok(hand)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_hand_is_taken_once_and_both_touch_one_session() {
        let [left, right] = two_hand_slots();
        let taken = left.clone().take("one").unwrap();
        for (slot, session_id, words) in [(&left, "one", "used this hand"), (&right, "two", "another session")] {
            let error = slot.take(session_id).unwrap_err();
            assert!(matches!(&error, Error::Argument(text) if text.contains(words)), "{error}");
        }
        drop(taken);
        right.take("one").unwrap();
    }
}
