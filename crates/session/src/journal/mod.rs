//! Journals: files from which sessions are recovered, replayed and proved. No clock, no socket, no thread: time is an
//! argument, and who writes gives the bytes to a file.
//!
//! **What a journal is.** A session is its inputs: the same scene, commands and steps give the same bits. So the file of a
//! run of a session (`SESSION.RUN.mcap`) has the scene, a snapshot, every input with the step at which it acted, hashes to
//! compare with, more snapshots to begin from, and what the tools felt. `proto/palpate/journal/v1` describes the messages.
//!
//! **Batches.** The file is MCAP (<https://mcap.dev>), with the schemas in it. Each flush appends one chunk, with a checksum
//! of its own and one message `/inputs` that numbers it and says up to which step the file is complete. Nothing that was
//! written is ever changed, so a file may be closed between flushes.
//!
//! **Damage.** A file that ends within a chunk, or with chunks that were not on the disk yet, is torn: it is read up to the last
//! whole batch. Each batch says how many before it were on the disk for certain: damage among those is an error that names
//! the place ([`reader`]).
//!
//! **Proof.** Hashes show that the same inputs still give the same bits, not who wrote them: who can change an input can change the
//! hashes too. A server with a key signs its journals ([`signature`]).
//!
//! **Use.** Who records makes a [`JournalWriter`] with an [`Opening`], tells it what happens ([`crate::input::Input`]), and
//! appends what each [`JournalWriter::flush`] gives; after each sync it tells [`JournalWriter::durable`]. Who goes on after a restart calls
//! [`resume`].
//!
//! The crate `mcap` reads records here. Its writer keeps an index of every chunk in memory, and its output open; so journals are
//! written record by record ([`records`]), and indexed when they are complete ([`seal`]).

pub mod file;
pub mod format;
pub mod foxglove;
pub mod inputs;
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
