//! `palpate-client health`: checks that a server is serving.

use std::time::Duration;

use palpate_client::describe;
use tonic_health::ServingStatus;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

use crate::ClientFailure;
use crate::credentials::{CredentialOptions, ServerOption};

/// Arguments of `health`.
#[derive(clap::Args)]
pub(crate) struct HealthArguments {
    #[command(flatten)]
    server: ServerOption,
    #[command(flatten)]
    credentials: CredentialOptions,
}

/// Timeout of an answer: a healthy server answers sooner.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(2);

/// Fails unless the server reports that it is serving.
pub(crate) async fn health(arguments: &HealthArguments) -> Result<(), ClientFailure> {
    let server = arguments.credentials.server(arguments.server.url())?.within(ANSWER_TIMEOUT);
    // Connecting has the same time limit. A second limit around both would race with it, and hide its message.
    let connected = server.connect().await;
    let channel = connected.map_err(|error| ClientFailure::Failed(format!("{error}; --server names another")))?;
    let mut health = HealthClient::new(channel);
    let asked = tokio::time::timeout(ANSWER_TIMEOUT, health.check(HealthCheckRequest::default())).await;
    let silent = |_| format!("the server has not answered within {} s", ANSWER_TIMEOUT.as_secs());
    let answer = asked.map_err(silent).and_then(|answer| answer.map_err(|status| describe(&status)));
    let status = answer.map_err(ClientFailure::Failed)?.into_inner().status;
    if status != ServingStatus::Serving as i32 {
        return Err(ClientFailure::Failed("the server is not serving".into()));
    }
    crate::tell!("serving");
    Ok(())
}
