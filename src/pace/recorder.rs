//! Who tells the tape of a session, and when.

use std::sync::Arc;

use super::tape::{Cadence, Event, Tape};
use crate::session::Session;

/// Tells the tape of a session.
pub(super) struct Recorder {
    pub(super) tape: Arc<Tape>,
    pub(super) cadence: Cadence,
    pub(super) was_at_rest: bool,
}

impl Recorder {
    /// Begins with the state of `session`: a journal continues from there.
    pub(super) fn new(tape: &Arc<Tape>, session: &Session) -> Self {
        let step = session.step_count();
        let mut recorder = Recorder {
            tape: tape.clone(),
            cadence: Cadence::new(session.model(), step),
            was_at_rest: session.rests_until().is_some(),
        };
        recorder.cadence.wants_snapshot(step, false);
        recorder.snapshot(session);
        tape.is_told_until(step, true);
        recorder
    }

    pub(super) fn snapshot(&self, session: &Session) {
        self.tape.note(session.step_count(), Event::Snapshot(Box::new(session.save()), session.copy()));
    }
}
