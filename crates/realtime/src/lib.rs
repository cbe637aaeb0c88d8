//! Sessions in real time, and the clock of stepping. Stepping threads own the sessions; what servers call here
//! posts a request to one, or goes through the session's intake, and never waits for a step.
//!
//! **Stepping threads wait for nobody.** Commands wait in the intake, whose lock is held for a queue operation and never for a
//! step. Samples and records wait in queues with bounds in items and bytes that drop the oldest and count it, snapshots for
//! frames in a slot that keeps the newest, the log in a buffer that drops. Requests to a session are messages to its thread,
//! which serves one of them before each step that is due.
//!
//! **Overruns.** `policy` decides what a session that is behind catches up, and what is dropped and counted.

mod admission;
pub mod audited;
mod auditor;
pub mod clock;
mod cost;
pub mod event_log;
pub mod fence;
pub mod frames;
pub mod ids;
mod inbox;
pub mod law_cache;
mod pacer;
pub mod playback;
mod policy;
pub mod priority;
mod publishing;
pub mod queue;
mod reading;
mod recorder;
mod recording;
mod run_queue;
mod session_handle;
mod session_task;
mod slots;
mod status;
pub mod streams;
mod subscribers;
mod thread;
pub mod thread_counters;

pub use admission::{Begin, SessionReservation};
pub use frames::FrameReader;
pub use inbox::{Leaving, Present};
pub use pacer::{Pacer, fenced};
pub use reading::{Recorded, SharedRecord};
pub use session_handle::{Accepted, SessionHandle};
pub use slots::StreamKind;
pub use status::{RunState, Status};
pub use streams::StreamGuard;

#[cfg(test)]
mod tests;
