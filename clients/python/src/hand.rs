//! The two hands of one program, for Python.

use palpate_client::bridge::{HandSlot, two_hand_slots};
use pyo3::prelude::*;

/// One of the two hands of a program, from `two_hands`.
#[pyclass(frozen, module = "palpate", from_py_object)]
#[derive(Debug, Clone)]
pub(crate) struct Hand(pub(crate) HandSlot);

/// Returns the two hands of a program, for `hand` of two calls of `RemoteSession.touch` in one session, at the same time: on two
/// threads, or with asyncio. Each copy of the tissue then has the tools of the other hand at once, without the delay of the
/// network. Each hand serves one call.
#[pyfunction]
pub(crate) fn two_hands() -> (Hand, Hand) {
    let [left, right] = two_hand_slots();
    (Hand(left), Hand(right))
}
