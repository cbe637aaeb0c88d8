//! The status of a session for other threads, written by its stepping thread.

use std::sync::Arc;

use super::clock::Dilation;
use palpate_session::schedule::Schedule;
use palpate_tissue::scene::record::{Recovery, StageTime};
use palpate_tissue::{Burns, Cuts, Model, TieState};

/// Whether a session's simulated time advances. A running session at rest or frozen is [`RunState::Running`] too.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RunState {
    /// The session's time advances in real time.
    Running,
    /// The session waits to be started: it has not been, or it was paused or reached the step at which it pauses.
    Paused,
    /// The session has been stopped by a blow-up, a fault of the program or missing memory, until it is revived.
    Held,
}

/// Status of a session at one moment: its state, its time, and its counts. Counts of late and paused commands, guard
/// events, paths and recoveries begin again when a session is revived.
#[derive(Debug, Clone)]
pub struct Status {
    /// Whether time advances.
    pub state: RunState,
    /// Number of steps done.
    pub step: u64,
    /// Whether nothing moves and no command waits, so that steps are skipped and not computed.
    pub resting: bool,
    /// Number of steps skipped at rest, since the session came to this server.
    pub rested_steps: u64,
    /// Number of steps dropped from the schedule because the session was late, since it came to this server.
    pub overrun_count: u64,
    /// Simulated over real time, as last measured.
    pub dilation: Dilation,
    /// Times at which steps are due while time advances.
    pub schedule: Schedule,
    /// Number of commands that came too late for their step.
    pub late_commands: u64,
    /// Number of commands without effect because their tool was paused ([`palpate_session::recovery`]).
    pub paused_commands: u64,
    /// Why the session is held, for people; `None` if it is not.
    pub hold_reason: Option<String>,
    /// Number of times that the guard, which checks stability after steps, went back to a checkpoint.
    pub guard_events: u64,
    /// Number of recoveries: the tissue was taken back to an earlier state.
    pub recovery_count: u64,
    /// The newest recoveries, at most [`MAX_RECOVERIES`](palpate_session::recovery::MAX_RECOVERIES), by ascending
    /// step.
    pub recoveries: Vec<Recovery>,
    /// What blades have severed.
    pub cuts: Cuts,
    /// What tips have burnt.
    pub burns: Burns,
    /// The threads and clips, by ascending number, at most 32 steps old.
    pub ties: Vec<TieState>,
    /// Number of points that a step computes now; 0 at rest.
    pub awake_points: usize,
    /// Counts of limited steps, dropped poses and releases: see [`palpate_session::Session::path_counts`].
    pub path_counts: [u64; 3],
    /// The time of each stage of a step since the session came to this server; empty unless it is measured
    /// ([`Pacer::measure_stages`](super::Pacer::measure_stages)).
    pub stages: Vec<StageTime>,
    /// Number of tools whose lease expired, since the session came to this server.
    pub lapsed_leases: u64,
    /// The present tissue. It differs from the first one after a
    /// [`SessionHandle::change`](super::SessionHandle::change).
    pub model: Arc<Model>,
}

impl Status {
    /// Sets the state to paused after a hold, and resets the counts of the session.
    pub(super) fn forget_hold(&mut self) {
        (self.hold_reason, self.state) = (None, RunState::Paused);
        (self.late_commands, self.guard_events, self.path_counts) = (0, 0, [0; 3]);
        self.paused_commands = 0;
        (self.recovery_count, self.recoveries) = (0, Vec::new());
    }
}
