//! Touch: contact, force laws, and the streams of devices.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

#[path = "../common/mod.rs"]
mod common;
#[path = "../common/metrics.rs"]
mod metrics;
#[path = "../common/server.rs"]
mod server;

mod commands;
mod contact;
mod laws;
mod poses;
