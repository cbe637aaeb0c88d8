//! Opening of a session whose journal a test writes.
#![allow(unreachable_pub)]

use std::sync::Arc;

use palpate_session::journal::Opening;
use palpate_tissue::Model;

/// A running session of ann's that begins with the tissue of `first`.
pub fn opening(first: &Arc<Model>) -> Opening<'_> {
    Opening {
        session_id: "0123456789abcdef",
        run: 1,
        owner: "ann",
        idle_timeout_s: 60.0,
        first,
        begin_step: 0,
        running: true,
        until_step: None,
        ownership_revision: 0,
        exercise: None,
    }
}
