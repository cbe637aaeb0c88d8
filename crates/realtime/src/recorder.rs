//! The part of a session's task that writes to the event log, and its schedule of snapshots, hashes and felt
//! forces.

use std::sync::Arc;

use super::event_log::{Cadence, Event, EventLog};
use palpate_session::Session;

/// Writer of a session's event log, on the stepping thread.
pub(super) struct Recorder {
    pub(super) event_log: Arc<EventLog>,
    pub(super) cadence: Cadence,
    pub(super) was_at_rest: bool,
}

impl Recorder {
    /// Writes the state of `session` to the event log: the journal continues from there.
    pub(super) fn new(event_log: &Arc<EventLog>, session: &Session) -> Self {
        let step = session.step_count();
        let mut recorder = Recorder {
            event_log: event_log.clone(),
            cadence: Cadence::new(session.model(), step),
            was_at_rest: session.rests_until().is_some(),
        };
        recorder.cadence.wants_snapshot(step, false);
        recorder.snapshot(session);
        event_log.set_until(step, true);
        recorder
    }

    pub(super) fn snapshot(&self, session: &Session) {
        self.event_log.note(session.step_count(), Event::Snapshot(Box::new(session.save()), session.copy()));
    }
}
