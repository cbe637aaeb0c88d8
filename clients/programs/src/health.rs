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
    let asked = async {
        let mut health =
            HealthClient::new(server.connect().await.map_err(|error| format!("{error}; --server names another"))?);
        health.check(HealthCheckRequest::default()).await.map_err(|status| describe(&status))
    };
    let answer =
        tokio::time::timeout(ANSWER_TIMEOUT, asked).await.map_err(|_| ClientFailure::Failed("no answer".into()))?;
    let status = answer.map_err(ClientFailure::Failed)?.into_inner().status;
    if status != ServingStatus::Serving as i32 {
        return Err(ClientFailure::Failed("the server is not serving".into()));
    }
    crate::tell!("serving");
    Ok(())
}
