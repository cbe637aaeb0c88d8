//! Everything that tests a running server but the siege, which times it: one program, as each would link the whole server
//! and its clients again. `cargo test --release --workspace --test server sessions::` runs one file of it.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

#[path = "../common"]
mod common {
    #[path = "mod.rs"]
    mod shared;

    pub(crate) use shared::*;

    pub mod authority;
    pub mod cases;
    pub mod cores;
    pub mod course;
    pub mod etcd;
    pub mod fleet;
    pub mod inverse_service;
    pub mod journal_opening;
    pub mod metrics;
    pub mod proxy;
    pub mod random;
    pub mod raw_codec;
    pub mod server;
}

#[cfg(feature = "agones")]
mod agones;
mod audit;
mod budget;
mod curves;
mod datagrams;
mod devices;
mod etcd;
mod exercise_bytes;
mod exercises;
mod fleet;
mod fleet_chaos;
mod follow;
mod haptics;
mod identity;
mod isolation;
mod journal_kill;
mod journal_server;
mod kill;
mod library;
mod link;
mod load;
#[cfg(target_os = "linux")]
mod memory;
mod mesh_server;
mod page;
mod replay;
mod sessions;
mod soak;
mod stall;
mod trainees;
mod views;
mod watching;
mod zero_server;
