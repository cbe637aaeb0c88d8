//! The events that a session writes to its event log, from its stepping thread.

use std::sync::Arc;

use super::event_log::{Beginning, Event};
use super::recorder::Recorder;
use super::session_task::SessionTask;
use palpate_session::input::Input;
use palpate_tissue::Model;
use palpate_tissue::lock::lock;

impl SessionTask {
    /// Writes an event of the present step.
    pub(super) fn note(&self, event: Event) {
        if let Some(recorder) = &self.recorder {
            recorder.event_log.note(self.session.step_count(), event);
        }
    }

    /// Writes an input that acts on the session at the present step.
    pub(super) fn note_input(&self, input: Input) {
        self.note(Event::Input(input));
    }

    /// Writes the inputs that act in the coming step.
    pub(super) fn note_inputs(&self, change: Option<&Arc<Model>>) {
        let Some(recorder) = &self.recorder else { return };
        let step = self.session.step_count();
        if let Some(model) = change {
            recorder.event_log.note(step, Event::Input(Input::Tissue(model.clone())));
        }
        for due in &self.due {
            recorder.event_log.note(step, Event::Input(Input::Command(due.clone())));
        }
    }

    /// Restarts the event log, if it is broken and there is room again.
    fn begin_anew(&mut self) {
        let Some(recorder) = &mut self.recorder else { return };
        let (session, running, until_step) = (&self.session, self.running, self.until);
        let step = session.step_count();
        if recorder.event_log.begins_anew(|| Beginning { step, running, until_step }) {
            *recorder = Recorder::new(&recorder.event_log, session);
            self.handle.note_waiting(&lock(&self.handle.intake));
            // What has ended is that of the session, not of a log.
            let Some(news) = self.handle.exercise.as_ref().map(|exercise| exercise.news().borrow().clone()) else {
                return;
            };
            (1..news.phase).for_each(|ended| self.note_input(Input::PhaseEnded(ended)));
            news.ended.into_iter().for_each(|ended| self.note_input(Input::ExerciseEnded(ended)));
        }
    }

    /// Writes the state of the tissue after a step, as far as it is due.
    pub(super) fn note_state(&mut self) {
        self.begin_anew();
        let Some(recorder) = &mut self.recorder else { return };
        let (session, event_log) = (&self.session, &recorder.event_log);
        let step = session.step_count();
        if session.hold_reason().is_some() {
            // The guard has held it; a replay of the same inputs is held at the same step.
            return event_log.set_until(step, true);
        }
        let is_at_rest = session.rests_until().is_some();
        let comes_to_rest = is_at_rest && !std::mem::replace(&mut recorder.was_at_rest, is_at_rest);
        if recorder.cadence.wants_felt(step) {
            let felt = session.felt();
            if !felt.is_empty() {
                event_log.note(step, Event::Felt(felt));
            }
        }
        if recorder.cadence.wants_hash(step) {
            event_log.note(step, Event::Hash(session.copy()));
        }
        if recorder.cadence.wants_snapshot(step, comes_to_rest) {
            recorder.snapshot(session);
        }
        recorder.event_log.set_until(step, is_at_rest);
    }

    /// Writes that steps were skipped at rest.
    pub(super) fn note_rest(&mut self) {
        self.begin_anew();
        if let Some(recorder) = &self.recorder {
            recorder.event_log.set_until(self.session.step_count(), true);
        }
    }

    /// Hands what is written so far to the journal's thread, because time is paused.
    pub(super) fn note_standstill(&self) {
        if let Some(recorder) = &self.recorder {
            recorder.event_log.hurry();
        }
    }

    /// Writes a snapshot for the server's successor, because the server ends.
    pub(super) fn note_the_end(&mut self) {
        let Some(recorder) = &self.recorder else { return };
        recorder.snapshot(&self.session);
        recorder.event_log.set_until(self.session.step_count(), true);
    }
}
