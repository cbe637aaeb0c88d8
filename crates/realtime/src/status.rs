//! How a session stands, for whoever asks: written by its stepping thread.

use std::sync::Arc;

use super::clock::Dilation;
use palpate_session::schedule::Schedule;
use palpate_tissue::Model;
use palpate_tissue::scene::record::Recovery;

/// Whether a session's time goes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunState {
    /// In real time.
    Running,
    /// Waits to be started.
    Paused,
    /// Stopped by a blow-up, a fault of the program or missing memory, until it is revived.
    Held,
}

/// How a session stands.
#[derive(Debug, Clone)]
pub struct Status {
    /// Whether time goes on.
    pub state: RunState,
    /// Steps done.
    pub step: u64,
    /// Nothing moves and no command waits: the session is not stepped.
    pub resting: bool,
    /// Steps skipped at rest.
    pub rested_steps: u64,
    /// Steps dropped.
    pub overrun_count: u64,
    /// Simulated over real time.
    pub dilation: Dilation,
    /// When steps are due while time goes on.
    pub schedule: Schedule,
    /// Commands that came too late for their step.
    pub late_commands: u64,
    /// Commands that had no effect because their tool was paused ([`palpate_session::recovery`]).
    pub paused_commands: u64,
    /// Why it is held.
    pub hold_reason: Option<String>,
    /// How often the guard went back to a checkpoint.
    pub guard_events: u64,
    /// How often the tissue was taken back to an earlier state.
    pub recovery_count: u64,
    /// The newest of these, by ascending step.
    pub recoveries: Vec<Recovery>,
    /// Points that the last step computed.
    pub awake_points: usize,
    /// As [`palpate_session::Session::path_counts`].
    pub path_counts: [u64; 3],
    /// Tools whose lease lapsed.
    pub lapsed_leases: u64,
    /// The tissue as it is: [`SessionHandle::change`](super::SessionHandle::change) may have made another of it.
    pub model: Arc<Model>,
}

impl Status {
    /// The session goes on, and what it counts of itself begins anew.
    pub(super) fn forget_hold(&mut self) {
        (self.hold_reason, self.state) = (None, RunState::Paused);
        (self.late_commands, self.guard_events, self.path_counts) = (0, 0, [0; 3]);
        self.paused_commands = 0;
        (self.recovery_count, self.recoveries) = (0, Vec::new());
    }
}
