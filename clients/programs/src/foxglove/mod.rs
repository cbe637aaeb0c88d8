//! `palpate-client foxglove`: shows a session live in Foxglove, with the topics of exported journals.

#[cfg(feature = "foxglove")]
mod bridge;
#[cfg(feature = "foxglove")]
mod topics;

use std::net::SocketAddr;

use crate::ClientFailure;
use crate::credentials::CredentialOptions;

/// Arguments of `foxglove`.
#[derive(clap::Args)]
// Without the feature, the arguments are parsed and the command is refused.
#[cfg_attr(not(feature = "foxglove"), allow(dead_code))]
pub(crate) struct FoxgloveArguments {
    /// ID of the session to watch
    #[arg(value_name = "SESSION")]
    session: String,
    /// The server
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7117")]
    server: String,
    /// Address for Foxglove to connect to; port 0 takes a free one. Whoever can reach it can watch the session
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:8765")]
    listen: SocketAddr,
    /// Number of point clouds of the surface per second of simulated time
    #[arg(long, value_name = "RATE", default_value_t = 30.0, value_parser = |text: &str| crate::within(text, 0.1..=1000.0))]
    frames_hz: f64,
    /// Number of values of tools and energies per second of simulated time
    #[arg(long, value_name = "RATE", default_value_t = 100.0, value_parser = |text: &str| crate::within(text, 0.1..=1000.0))]
    curves_hz: f64,
    #[command(flatten)]
    credentials: CredentialOptions,
}

/// Shows a session until it is interrupted or the session ends.
#[cfg(feature = "foxglove")]
pub(crate) async fn foxglove(arguments: &FoxgloveArguments) -> Result<(), ClientFailure> {
    bridge::bridge(arguments).await
}

/// Refuses, because this program can't do it.
#[cfg(not(feature = "foxglove"))]
pub(crate) async fn foxglove(_: &FoxgloveArguments) -> Result<(), ClientFailure> {
    let message = "this program was built without the feature `foxglove`; cargo build --package palpate-programs --features foxglove";
    Err(ClientFailure::Refused(message.to_owned()))
}
