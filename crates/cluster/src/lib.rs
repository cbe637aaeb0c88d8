//! A fleet: several servers that share their sessions, by what etcd promises. Who is there (leases), who owns which session (keys
//! at a revision, changed by transactions), where a new session goes, and who takes over.
//!
//! **One owner.** A node owns a session while the session's key names it. It may step and speak for its sessions only while its
//! lease can't have run out ([`rules::fence_ns`]); another may claim them only when the lease has ([`rules::claim`]).
//! `tests/fleet_model.rs` checks histories of both.

#[cfg(feature = "agones")]
pub mod agones;
pub mod etcd;
pub mod key;
pub mod placement;
pub mod rules;
