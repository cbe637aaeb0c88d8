//! The health service: states of the services, of the token files and of the job pool.

use std::sync::Arc;
use std::time::Duration;

use tonic::server::NamedService;
use tonic_health::ServingStatus;
use tonic_health::server::HealthReporter;
use tracing::warn;

use super::exercises::Exercises;
use super::haptics::Haptics;
use super::job_pool::JobPool;
use super::protection::Protection;
use super::sessions::Sessions;
use super::traffic::Traffic;
use super::views::Views;
use palpate_proto::pb::exercise_service_server::ExerciseServiceServer;
use palpate_proto::pb::haptic_service_server::HapticServiceServer;
use palpate_proto::pb::session_service_server::SessionServiceServer;
use palpate_proto::pb::view_service_server::ViewServiceServer;

/// The services that the health service reports. The server itself, "", is serving even if one of the others is not.
pub(super) const SERVICES: [&str; 7] = [
    "",
    <SessionServiceServer<Sessions> as NamedService>::NAME,
    <HapticServiceServer<Haptics> as NamedService>::NAME,
    <ViewServiceServer<Views> as NamedService>::NAME,
    <ExerciseServiceServer<Exercises> as NamedService>::NAME,
    TOKENS,
    JOB_POOL,
];

/// Name of the health service that is serving while the tokens in use are those of the file.
const TOKENS: &str = "palpate.tokens";

/// Reports files whose contents are not in use to the health service and the metrics. Never completes.
pub(super) fn report_files(
    protection: &Protection,
    health: HealthReporter,
    traffic: Arc<Traffic>,
) -> impl Future<Output = ()> + use<> {
    let mut tokens = protection.credentials.problems();
    let tls = protection.tls.as_ref().map(|tls| tls.problems());
    let token_traffic = traffic.clone();
    let of_tokens = async move {
        loop {
            let are_unused = tokens.borrow_and_update().is_some();
            token_traffic.files("tokens", are_unused);
            let status = if are_unused { ServingStatus::NotServing } else { ServingStatus::Serving };
            health.set_service_status(TOKENS, status).await;
            if tokens.changed().await.is_err() {
                return;
            }
        }
    };
    let of_tls = async move {
        let Some(mut tls) = tls else { return };
        loop {
            traffic.files("TLS", tls.borrow_and_update().is_some());
            if tls.changed().await.is_err() {
                return;
            }
        }
    };
    async {
        tokio::join!(of_tokens, of_tls);
    }
}

/// Reports all services as not serving. Then ends the streams that watch their health: shutdown would wait for them.
pub(super) async fn end_health(mut health: HealthReporter) {
    for service in SERVICES {
        health.set_service_status(service, ServingStatus::NotServing).await;
    }
    for service in SERVICES {
        health.clear_service_status(service).await;
    }
}

/// Name of the health service that is serving while heavy work completes in time.
const JOB_POOL: &str = "palpate.job_pool";

/// Reports whether the oldest job of the job pool is within its deadline, as [`JOB_POOL`]. Never completes.
pub(super) async fn report_job_pool(job_pool: JobPool, health: HealthReporter) {
    let mut checks = tokio::time::interval(Duration::from_millis(250));
    let mut was_late = None;
    loop {
        checks.tick().await;
        let load = job_pool.load();
        if was_late.replace(load.is_late) == Some(load.is_late) {
            continue;
        }
        if load.is_late {
            warn!(oldest_s = load.oldest_s, waiting = load.waiting, "heavy work is past its deadline");
        }
        let status = if load.is_late { ServingStatus::NotServing } else { ServingStatus::Serving };
        health.set_service_status(JOB_POOL, status).await;
    }
}
