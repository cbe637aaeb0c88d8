//! `palpate-client health`: checks that a server is serving.

use std::time::Duration;

use palpate_client::describe;
use tonic_health::ServingStatus;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

use crate::Failure;
use crate::credentials::{CredentialOptions, ServerOption};

/// Arguments of `health`.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    server: ServerOption,
    #[command(flatten)]
    credentials: CredentialOptions,
}

/// A healthy server answers sooner.
const PATIENCE: Duration = Duration::from_secs(2);

/// Fails unless the server reports that it is serving.
pub(crate) async fn health(arguments: &Arguments) -> Result<(), Failure> {
    let server = arguments.credentials.server(arguments.server.url())?.within(PATIENCE);
    let asked = async {
        let mut health =
            HealthClient::new(server.connect().await.map_err(|error| format!("{error}; --server names another"))?);
        health.check(HealthCheckRequest::default()).await.map_err(|status| describe(&status))
    };
    let answer = tokio::time::timeout(PATIENCE, asked).await.map_err(|_| Failure::Failed("no answer".into()))?;
    let status = answer.map_err(Failure::Failed)?.into_inner().status;
    if status != ServingStatus::Serving as i32 {
        return Err(Failure::Failed("the server is not serving".into()));
    }
    crate::tell!("serving");
    Ok(())
}
