//! A fleet: several servers that share their sessions through etcd. It defines which servers are present (leases),
//! which server owns a session (keys at a revision, changed by transactions), where a new session goes, and which
//! server takes over.
//!
//! **One owner.** A node owns a session while the session's key names it. A node may step its sessions and answer
//! for them only while its lease can't have run out ([`rules::fence_ns`]); another node may claim them only when
//! the lease has run out ([`rules::claim`]). `tests/fleet_model.rs` checks histories of both.

#[cfg(feature = "agones")]
pub mod agones;
pub mod etcd;
pub mod key;
pub mod placement;
pub mod rules;
