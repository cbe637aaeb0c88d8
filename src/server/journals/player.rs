//! The thread that reads ahead for sessions that play what was recorded (`player`).

use std::io::{Read, Seek};
use std::sync::{Arc, Condvar, Mutex, PoisonError, Weak};
use std::time::Duration;

use crate::journal::inputs::Inputs;
use crate::lock::lock;
use crate::pace::Live;
use crate::pace::feed::Feed;
use crate::refusal::Result;

/// It looks so often whether a session has played much of what was read.
const LOOK: Duration = Duration::from_millis(100);

/// What a journal is read from.
pub(super) trait Source: Read + Seek + Send {}

impl<T: Read + Seek + Send> Source for T {}

struct Played {
    live: Weak<Live>,
    feed: Arc<Feed>,
    inputs: Inputs<Box<dyn Source>>,
}

/// What it reads for.
#[derive(Default)]
pub(super) struct Player {
    state: Mutex<State>,
    wake: Condvar,
}

#[derive(Default)]
struct State {
    new: Vec<Played>,
    stop: bool,
}

impl Player {
    /// Reads on for `live` until it is deleted.
    pub(super) fn play(&self, live: &Arc<Live>, feed: &Arc<Feed>, inputs: Inputs<Box<dyn Source>>) {
        lock(&self.state).new.push(Played { live: Arc::downgrade(live), feed: feed.clone(), inputs });
        self.wake.notify_one();
    }

    pub(super) fn stop(&self) {
        lock(&self.state).stop = true;
        self.wake.notify_one();
    }

    /// The thread's work.
    pub(super) fn work(&self) {
        let mut played: Vec<Played> = Vec::new();
        loop {
            let mut state = lock(&self.state);
            if state.new.is_empty() && !state.stop {
                state = if played.is_empty() {
                    self.wake.wait(state).unwrap_or_else(PoisonError::into_inner)
                } else {
                    self.wake.wait_timeout(state, LOOK).unwrap_or_else(PoisonError::into_inner).0
                };
            }
            if state.stop {
                return;
            }
            played.append(&mut state.new);
            drop(state);
            played.retain_mut(|Played { live, feed, inputs }| {
                let Some(live) = live.upgrade() else { return false };
                if let Err(refusal) = read_ahead(feed, inputs, live.status().step) {
                    tracing::error!(session = %live.id, %refusal, "the recording can't be played any further");
                    feed.complete();
                }
                feed.wants_more(0).is_some()
            });
        }
    }
}

/// Reads ahead of a session that has done `step` steps.
pub(super) fn read_ahead(feed: &Feed, inputs: &mut Inputs<Box<dyn Source>>, step: u64) -> Result<()> {
    while feed.wants_more(step) == Some(true) {
        match inputs.next_batch()? {
            Some(piece) => feed.add(piece.inputs, piece.until_step),
            None => feed.complete(),
        }
    }
    Ok(())
}
