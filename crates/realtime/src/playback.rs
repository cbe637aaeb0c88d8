//! Playback of a recorded session. Another thread reads the recording ahead, and the stepping thread takes what is
//! due without waiting.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use palpate_session::command::Due;
use palpate_session::input::Input;
use palpate_tissue::Model;
use palpate_tissue::lock::lock;

/// Limit of inputs, and of steps, that are read ahead.
const AHEAD: usize = 4096;

/// Recorded inputs that have been read and not yet played: a thread that reads the recording adds them, and the
/// stepping thread takes them. It is empty at first.
#[derive(Default)]
pub struct PlaybackSource(Mutex<Fed>);

#[derive(Default)]
struct Fed {
    /// Each input with the number of steps done before it acts.
    inputs: VecDeque<(u64, Input)>,
    /// All inputs that act before this step are in `inputs`, or have been taken.
    until_step: u64,
    is_complete: bool,
}

/// Inputs of one step, without its commands.
#[derive(Default)]
pub(super) struct Fetched {
    pub(super) change: Option<Arc<Model>>,
    pub(super) is_revived: bool,
    pub(super) hold: Option<String>,
}

/// Whether a step can be played.
pub(super) enum Next {
    /// Yes, with these inputs.
    Step(Fetched),
    /// Not yet: the inputs of the step have not been read.
    Late,
    /// No: the recording ends before the step.
    Over,
}

impl PlaybackSource {
    /// Adds inputs that were read, each with the number of steps done before it acts, in order, after those of
    /// earlier calls. With them, all inputs that act before `until_step` are there.
    pub fn add(&self, inputs: VecDeque<(u64, Input)>, until_step: u64) {
        let mut fed = lock(&self.0);
        fed.inputs.extend(inputs);
        fed.until_step = fed.until_step.max(until_step);
    }

    /// Marks the recording as read to its end: the playback pauses at the last step of which all inputs were added.
    pub fn complete(&self) {
        lock(&self.0).is_complete = true;
    }

    /// Returns whether more inputs should be read for a session that has done `step` steps: fewer than 4096 inputs
    /// wait, and they reach fewer than 4096 steps ahead. `None` once [`PlaybackSource::complete`] was called.
    pub fn wants_more(&self, step: u64) -> Option<bool> {
        let fed = lock(&self.0);
        (!fed.is_complete).then(|| fed.inputs.len() < AHEAD && fed.until_step < step + AHEAD as u64)
    }

    /// Returns the first step that a session at rest must not skip.
    pub(super) fn next_step(&self) -> u64 {
        let fed = lock(&self.0);
        fed.inputs.front().map_or(fed.until_step, |input| input.0)
    }

    /// Takes the inputs that act when `step` steps are done. Commands are appended to `due`.
    pub(super) fn take(&self, step: u64, due: &mut Vec<Due>) -> Next {
        let mut fed = lock(&self.0);
        if step >= fed.until_step {
            return if fed.is_complete { Next::Over } else { Next::Late };
        }
        let mut fetched = Fetched::default();
        while fed.inputs.front().is_some_and(|input| input.0 <= step) {
            match fed.inputs.pop_front() {
                Some((_, Input::Command(command))) => due.push(command),
                Some((_, Input::Tissue(model))) => fetched.change = Some(model),
                Some((_, Input::Revive)) => fetched.is_revived = true,
                Some((_, Input::Hold(reason))) => fetched.hold = Some(reason),
                Some((
                    _,
                    Input::Start { .. }
                    | Input::Pause
                    | Input::DroppedSteps(_)
                    | Input::ExerciseEnded(_)
                    | Input::PhaseEnded(_),
                ))
                | None => {}
            }
        }
        Next::Step(fetched)
    }
}

/// A recording of a session that another session plays. Clones share the source of inputs.
#[derive(Clone)]
pub struct Playback {
    /// ID of the recorded session.
    pub session_id: String,
    /// Number of the recorded run of that session.
    pub run: u64,
    /// Step counts at the beginning and at the end of the recording, in this order.
    pub steps: [u64; 2],
    /// Speed of the playback, above 0: simulated over real time; 1 is real time.
    pub speed: f64,
    /// The recorded inputs, as far as they have been read.
    pub feed: Arc<PlaybackSource>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_acts_at_a_step_is_taken_there_and_nothing_is_played_that_was_not_read() {
        let feed = PlaybackSource::default();
        let mut due = Vec::new();
        assert!(matches!(feed.take(0, &mut due), Next::Late));
        let hold = |reason: &str| Input::Hold(reason.to_owned());
        feed.add(VecDeque::from([(2, hold("a")), (5, Input::Revive)]), 7);
        assert_eq!(feed.next_step(), 2);
        assert!(matches!(feed.take(1, &mut due), Next::Step(Fetched { hold: None, is_revived: false, .. })));
        assert!(matches!(feed.take(2, &mut due), Next::Step(Fetched { hold: Some(_), is_revived: false, .. })));
        assert_eq!((feed.next_step(), feed.wants_more(2)), (5, Some(true)));
        assert!(matches!(feed.take(6, &mut due), Next::Step(Fetched { is_revived: true, .. })));
        assert!(matches!(feed.take(7, &mut due), Next::Late));
        feed.complete();
        assert!(matches!(feed.take(7, &mut due), Next::Over));
        assert_eq!((feed.wants_more(7), feed.next_step()), (None, 7));
    }
}
