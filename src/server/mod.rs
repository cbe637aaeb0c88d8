//! The server: gRPC services over `pace`, for browsers too (gRPC-web), their page, health, reflection, and a shutdown
//! with a deadline.

pub mod catalog;
pub mod config;
mod connections;
mod haptics;
mod page;
mod rate;
mod sessions;
mod textures;
mod views;

use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;
use tonic::service::Routes;
use tonic::transport::Server;
use tonic_web::GrpcWebLayer;
use tracing::{info, warn};

use crate::pace::Pacer;
use crate::wire::pb;
use catalog::Catalog;
use config::Config;
use pb::haptic_service_server::HapticServiceServer;
use pb::session_service_server::SessionServiceServer;
use pb::view_service_server::ViewServiceServer;
use textures::Textures;

/// What every service needs.
#[derive(Clone)]
pub(crate) struct House {
    pub(crate) config: Arc<Config>,
    pub(crate) catalog: Catalog,
    pub(crate) pacer: Arc<Pacer>,
    pub(crate) textures: Textures,
    /// Sessions are laid out, and force laws computed, one at a time: to ask for many takes no more than a core.
    pub(crate) heavy_work: Arc<tokio::sync::Semaphore>,
}

/// Why a server could not run.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// A thread can't be started.
    #[error("can't start a stepping thread: {0}")]
    Threads(#[from] std::io::Error),
    /// The transport failed.
    #[error("the transport failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    /// The reflection service can't read its own descriptors.
    #[error("the descriptors of the protocol can't be read: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
}

/// Serves on `listener` until `shutdown` is cancelled; then ends all streams, and is over at the latest when the
/// deadline of the configuration has passed. The caller ends its runtime without waiting (`shutdown_background`).
pub async fn serve(listener: TcpListener, config: Config, shutdown: CancellationToken) -> Result<(), ServeError> {
    let pacer = Pacer::start(config.stepping_threads(), &config.limits)?;
    let deadline = Duration::from_secs_f64(config.shutdown_deadline_s);
    let catalog = Catalog::new(&config.scenes, &config.scripts);
    for name in catalog.names() {
        if let Err(refusal) = catalog.load(&name, &[], &config.limits) {
            warn!(%refusal, "a scene that no session can be made from");
        }
    }
    let limits = config.limits.clone();
    let heavy_work = Arc::new(tokio::sync::Semaphore::new(1));
    let house =
        House { catalog, pacer: pacer.clone(), config: Arc::new(config), textures: Textures::default(), heavy_work };

    let (health, health_service) = tonic_health::server::health_reporter();
    health.set_serving::<SessionServiceServer<sessions::Sessions>>().await;
    health.set_serving::<HapticServiceServer<haptics::Haptics>>().await;
    health.set_serving::<ViewServiceServer<views::Views>>().await;
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(pb::DESCRIPTORS)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };

    let unused = pacer.clone();
    let sweeping = async move {
        let mut sweep = tokio::time::interval(Duration::from_secs(1));
        loop {
            sweep.tick().await;
            for session in unused.delete_idle() {
                info!(session, "session deleted: nobody used it");
            }
        }
    };

    let incoming = connections::incoming(listener, &limits);
    let silence = Some(Duration::from_secs_f64(limits.keepalive_s));
    let bytes = limits.message_bytes;
    let (folder, painter) = (Arc::new(house.config.viewer.clone()), house.clone());
    let sessions = SessionServiceServer::new(sessions::Sessions(house.clone())).max_decoding_message_size(bytes);
    let haptics = HapticServiceServer::new(haptics::Haptics(house.clone())).max_decoding_message_size(bytes);
    let views = ViewServiceServer::new(views::Views(house)).max_decoding_message_size(bytes);
    let routes = Routes::new(health_service)
        .add_service(reflection().build_v1()?)
        .add_service(reflection().build_v1alpha()?)
        .add_service(sessions)
        .add_service(haptics)
        .add_service(views)
        .into_axum_router()
        // Of the services alone: it refuses what is no gRPC.
        .route_layer(GrpcWebLayer::new())
        .route("/textures/{file}", axum::routing::get(move |file, headers| textures::file(painter, file, headers)))
        .fallback(move |request| page::page(folder.clone(), request));
    let serving = Server::builder()
        // Finds out about clients whose host has vanished.
        .http2_keepalive_interval(silence)
        .http2_keepalive_timeout(silence)
        .max_concurrent_streams(limits.streams_per_connection)
        .initial_connection_window_size(limits.connection_window_bytes)
        // Browsers speak HTTP/2 only over TLS.
        .accept_http1(true)
        .add_routes(routes.into())
        .serve_with_incoming_shutdown(incoming, shutdown.clone().cancelled_owned());

    // One deadline for all that is left to do. A step that outlasts it goes down with the process.
    let (stopping, begun) = (pacer.clone(), shutdown.clone());
    let stop = async move {
        begun.cancelled().await;
        info!("shutting down");
        // Waits for the steps under way. Every stream then reads its end from its queue.
        let _ = tokio::task::spawn_blocking(move || stopping.stop()).await;
    };
    let over = async {
        shutdown.cancelled().await;
        tokio::time::sleep(deadline).await;
    };
    tokio::select! {
        (served, ()) = async { tokio::join!(serving, stop) } => served?,
        () = sweeping => {}
        () = over => warn!("steps or streams outlasted the deadline, and are cut"),
    }
    info!("stopped");
    Ok(())
}
