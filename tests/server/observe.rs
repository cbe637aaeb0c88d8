//! What optional features show of a running server: traces and the bridge to Foxglove. One program with both features:
//! `make test-observe`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::disallowed_methods)]

#[path = "../common"]
mod common {
    pub mod server;
}

mod foxglove;
mod traces;
