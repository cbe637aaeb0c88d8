//! The thread that reads ahead for sessions that play back recordings (`player`).

use std::sync::{Arc, Condvar, Mutex, PoisonError, Weak};
use std::time::Duration;

use palpate_realtime::SessionHandle;
use palpate_realtime::playback::PlaybackSource;
use palpate_refusal::Result;
use palpate_session::journal::inputs::Inputs;
use palpate_tissue::lock::lock;

/// Interval between checks whether a session has played much of what was read.
const LOOK: Duration = Duration::from_millis(100);

struct Played {
    handle: Weak<SessionHandle>,
    feed: Arc<PlaybackSource>,
    inputs: Inputs<'static>,
}

/// The sessions that play recordings, and the thread's wake-up.
#[derive(Default)]
pub(super) struct Player {
    state: Mutex<PlayerState>,
    wake: Condvar,
}

#[derive(Default)]
struct PlayerState {
    new: Vec<Played>,
    stop: bool,
}

impl Player {
    /// Reads ahead for `handle` until it is deleted.
    pub(super) fn play(&self, handle: &Arc<SessionHandle>, feed: &Arc<PlaybackSource>, inputs: Inputs<'static>) {
        lock(&self.state).new.push(Played { handle: Arc::downgrade(handle), feed: feed.clone(), inputs });
        self.wake.notify_one();
    }

    pub(super) fn stop(&self) {
        lock(&self.state).stop = true;
        self.wake.notify_one();
    }

    /// Runs the thread's loop, until it is stopped.
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
            played.retain_mut(|Played { handle, feed, inputs }| {
                let Some(handle) = handle.upgrade() else { return false };
                if let Err(refusal) = read_ahead(feed, inputs, handle.status().step) {
                    tracing::error!(session = %handle.id, %refusal, "the recording can't be played any further");
                    feed.complete();
                }
                feed.wants_more(0).is_some()
            });
        }
    }
}

/// Reads ahead for a session that has done `step` steps.
pub(super) fn read_ahead(feed: &PlaybackSource, inputs: &mut Inputs<'_>, step: u64) -> Result<()> {
    while feed.wants_more(step) == Some(true) {
        match inputs.next_batch()? {
            Some(piece) => feed.add(piece.inputs, piece.until_step),
            None => feed.complete(),
        }
    }
    Ok(())
}
