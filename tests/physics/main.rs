//! Physics of the sheet: its laws of nature, changes of tissue in use, and sleep.
#![allow(
    clippy::cast_precision_loss,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::disallowed_methods
)]

#[path = "../common/cases.rs"]
mod cases;
#[path = "../common/mod.rs"]
mod common;
#[path = "../common/server.rs"]
mod server;

mod change;
mod laws;
mod sleep;
