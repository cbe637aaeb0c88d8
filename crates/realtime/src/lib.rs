//! Sessions in real time, and the clock of stepping. Stepping threads own the sessions. A server's call posts a
//! request to a session's thread, or goes through the session's intake, the queue of its commands; no call blocks
//! until a step is done.
//!
//! **Stepping threads do not wait.** Commands wait in the intake, whose lock is held for a queue operation and
//! never for a step. Samples and records wait in queues that are bounded in items and bytes; when a queue is full,
//! the oldest item is dropped and counted. Snapshots for frames wait in a slot that keeps the newest, and log
//! messages in a buffer that drops. A request to a session is a message to its thread, which serves one before each
//! step that is due.
//!
//! **Overruns.** `policy.rs` decides what a session that is late catches up, and what is dropped and counted.

mod admission;
pub mod audited;
mod auditor;
pub mod clock;
mod cost;
pub mod event_log;
mod exercise_task;
pub mod fence;
pub mod frames;
pub mod ids;
mod inbox;
pub mod law_cache;
pub mod live_exercise;
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
pub use live_exercise::{ExerciseNews, LiveExercise, SessionExercise, TrainerAdvice};
pub use pacer::{Pacer, fenced};
pub use reading::{Recorded, SharedRecord};
pub use session_handle::{Accepted, SessionHandle};
pub use slots::StreamKind;
pub use status::{RunState, Status};
pub use streams::StreamGuard;

#[cfg(test)]
mod tests;
