//! What a session plays that was recorded: somebody reads ahead, and its stepping thread takes what is due, without waiting.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use palpate_session::command::Due;
use palpate_session::input::Input;
use palpate_tissue::Model;
use palpate_tissue::lock::lock;

/// Inputs that are read ahead.
const AHEAD: usize = 4096;

/// What is to be played.
#[derive(Default)]
pub struct PlaybackSource(Mutex<Fed>);

#[derive(Default)]
struct Fed {
    /// With the steps done before each acts.
    inputs: VecDeque<(u64, Input)>,
    /// All that act before this step are in, or were taken.
    until_step: u64,
    is_complete: bool,
}

/// What acts at a step.
#[derive(Default)]
pub(super) struct Fetched {
    pub(super) change: Option<Arc<Model>>,
    pub(super) is_revived: bool,
    pub(super) hold: Option<String>,
}

/// Whether a step can be played.
pub(super) enum Next {
    /// With this.
    Step(Fetched),
    /// Not yet: what acts at it has not been read.
    Late,
    /// It was not recorded.
    Over,
}

impl PlaybackSource {
    /// Adds what was read: inputs in order, all that act before `until_step`.
    pub fn add(&self, inputs: VecDeque<(u64, Input)>, until_step: u64) {
        let mut fed = lock(&self.0);
        fed.inputs.extend(inputs);
        fed.until_step = fed.until_step.max(until_step);
    }

    /// Notes that nothing more was recorded.
    pub fn complete(&self) {
        lock(&self.0).is_complete = true;
    }

    /// Returns whether more is to be read; `None` if there is no more.
    pub fn wants_more(&self, step: u64) -> Option<bool> {
        let fed = lock(&self.0);
        (!fed.is_complete).then(|| fed.inputs.len() < AHEAD && fed.until_step < step + AHEAD as u64)
    }

    /// The step that a session at rest must not skip.
    pub(super) fn next_step(&self) -> u64 {
        let fed = lock(&self.0);
        fed.inputs.front().map_or(fed.until_step, |input| input.0)
    }

    /// Takes what acts when `step` steps are done; commands go to `due`.
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
                Some((_, Input::Start { .. } | Input::Pause | Input::DroppedSteps(_))) | None => {}
            }
        }
        Next::Step(fetched)
    }
}

/// A session that plays what another has recorded.
#[derive(Clone)]
pub struct Playback {
    /// The session that was recorded.
    pub session_id: String,
    /// The run of the server that recorded it.
    pub run: u64,
    /// Steps done at the beginning and at the end of what was recorded.
    pub steps: [u64; 2],
    /// How fast it is played.
    pub speed: f64,
    /// What acts.
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
