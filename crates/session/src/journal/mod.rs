//! Journals: files from which sessions are recovered, replayed and verified. This module has no clock, socket or
//! thread: time is an argument, and the caller writes the bytes to a file.
//!
//! **Content.** A session is determined by its inputs: equal scenes, commands and steps give equal bits. So the
//! file of a run of a session (`SESSION.RUN.mcap`) has the scene, a snapshot, every input with the step at which it
//! acted, hashes to compare with, more snapshots to begin from, and the poses and forces of the tools.
//! `proto/palpate/journal/v1` describes the messages.
//!
//! **Batches.** The file is MCAP (<https://mcap.dev>), with the schemas in it. Each flush appends one chunk, with a
//! checksum of its own and one message `/inputs` that numbers it and says up to which step the file is complete.
//! Written bytes are never changed, so a file may be closed between flushes.
//!
//! **Damage.** A file that ends within a chunk, or with chunks that had not reached the disk, is torn: it is read
//! up to the last whole batch. Each batch says how many earlier batches were certainly on the disk: damage among
//! those is an error that names the place ([`reader`]).
//!
//! **Proof.** Hashes show that the inputs still give the recorded bits, not who wrote them: an attacker who can
//! change an input can also change the hashes. A server with a key signs its journals ([`signature`]).
//!
//! **Use.** To record, create a [`JournalWriter`] with an [`Opening`], pass it each event
//! ([`crate::input::Input`]), append the bytes of each [`JournalWriter::flush`] to the file, and call
//! [`JournalWriter::durable`] after each sync. To continue after a restart, call [`resume`].
//!
//! Records are parsed by the crate `mcap`. Its writer keeps an index of every chunk in memory, and its output open;
//! so journals are written record by record ([`records`]), and indexed when they are complete ([`seal`]).

pub mod exercise;
pub mod file;
pub mod format;
pub mod foxglove;
pub mod inputs;
#[cfg(test)]
mod lump_tests;
mod lumps;
pub mod message;
pub mod reader;
pub mod records;
pub mod recover;
pub mod replay;
pub mod seal;
pub mod signature;
pub mod writer;

pub use format::{REPLAYS, Topic};
pub use reader::{JournalBatch, JournalReader, SnapshotAt, Survey};
pub use replay::{Difference, Replay, ReplayEvent, Resumed, Verdict, prediction, resume, session_at, verify};
pub use writer::{JournalWriter, Opening};

pub use palpate_proto::journal as pb;
pub use palpate_proto::pb::Vector3;
