//! The server: gRPC services over `pace`, for browsers too (gRPC-web), their page, health, reflection, and a shutdown
//! with a deadline.

mod admin;
pub mod catalog;
pub mod config;
mod connections;
mod cut;
mod descriptors;
mod force_law;
mod guard;
mod haptics;
pub mod identity;
mod leases;
mod metrics;
mod page;
mod price;
mod protection;
mod rate;
mod reload;
mod request;
mod revocation;
mod sessions;
pub mod signals;
mod textures;
mod tls;
mod transport;
mod validity;
mod views;
mod visitor;
mod workshop;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio_util::sync::CancellationToken;
use tonic::server::NamedService;
use tonic::service::Routes;
use tonic::transport::Server;
use tonic_health::ServingStatus;
use tonic_health::server::HealthReporter;
use tonic_web::GrpcWebLayer;
use tower_http::cors::CorsLayer;
use tracing::{info, warn};

use crate::budget::{Budget, give_back_to_the_system};
use crate::pace::Pacer;
use crate::refusal::{Reason, Refusal};
use crate::wire::pb;
use catalog::Catalog;
use config::Config;
use connections::Seats;
use guard::GuardLayer;
use http::{HeaderName, HeaderValue, Method, header};
use metrics::Traffic;
use pb::admin_service_server::AdminServiceServer;
use pb::haptic_service_server::HapticServiceServer;
use pb::session_service_server::SessionServiceServer;
use pb::view_service_server::ViewServiceServer;
use protection::Protection;
use revocation::Calls;
use textures::Textures;
use workshop::Workshop;

/// What every service needs.
#[derive(Clone)]
pub(crate) struct House {
    pub(crate) config: Arc<Config>,
    pub(crate) catalog: Catalog,
    pub(crate) pacer: Arc<Pacer>,
    pub(crate) textures: Textures,
    /// Where sessions are laid out and changed, scripts read, and force laws computed.
    pub(crate) workshop: Workshop,
    pub(crate) traffic: Arc<Traffic>,
}

/// Where a server is reached, and what stands there.
pub struct Doors {
    listener: TcpListener,
    metrics: Option<TcpListener>,
    protection: Protection,
}

impl Doors {
    /// Listens where the configuration says, if that is safe.
    pub async fn open(config: &Config) -> Result<Self, ServeError> {
        let listener = listen("listen", &config.listen).await?;
        let protection = Protection::load(config, local_address("listen", &listener, &config.listen)?)?;
        let metrics = match &config.metrics {
            Some(text) => {
                let listener = listen("metrics", text).await?;
                let address = local_address("metrics", &listener, text)?;
                if !address.ip().is_loopback() && !config.insecure {
                    let why = "can be reached from other machines, and nobody is asked who they are there";
                    let message = format!("{address} {why}: listen on 127.0.0.1, or say --insecure");
                    return Err(Refusal::new(Reason::OutOfRange, "metrics", message).into());
                }
                Some(listener)
            }
            None => None,
        };
        Ok(Doors { listener, metrics, protection })
    }

    /// Where clients find the server.
    pub fn url(&self) -> String {
        url(self.protection.scheme(), &self.listener)
    }

    /// Where Prometheus does, if anywhere.
    pub fn metrics_url(&self) -> Option<String> {
        self.metrics.as_ref().map(|listener| url("http", listener) + "/metrics")
    }
}

fn local_address(field: &'static str, listener: &TcpListener, text: &str) -> Result<SocketAddr, ServeError> {
    listener.local_addr().map_err(|error| ServeError::Listen { field, address: text.to_owned(), error })
}

fn url(scheme: &str, listener: &TcpListener) -> String {
    listener.local_addr().map_or_else(|e| e.to_string(), |address| format!("{scheme}://{address}"))
}

async fn listen(field: &'static str, text: &str) -> Result<TcpListener, ServeError> {
    TcpListener::bind(text).await.map_err(|error| {
        if error.kind() == std::io::ErrorKind::InvalidInput {
            let message = format!("{text}: must be address:port, as in 127.0.0.1:7117");
            return Refusal::new(Reason::WrongKind, field, message).into();
        }
        ServeError::Listen { field, address: text.to_owned(), error }
    })
}

/// What a page of another site may send, and read of the answer, of a call over gRPC-web.
fn cors(origins: &[HeaderValue]) -> CorsLayer {
    let own = |name| HeaderName::from_static(name);
    let sent =
        [header::CONTENT_TYPE, header::AUTHORIZATION, own("x-grpc-web"), own("x-user-agent"), own("grpc-timeout")];
    let read = [own("grpc-status"), own("grpc-message"), own("grpc-status-details-bin")];
    CorsLayer::new()
        .allow_origin(origins.to_vec())
        .allow_methods([Method::GET, Method::POST])
        .allow_headers(sent)
        .expose_headers(read)
        .max_age(Duration::from_secs(3600))
}

/// Bytes that were taken and are free again: then the allocator is asked to give what it keeps back to the system.
const WORTH_GIVING_BACK: u64 = 16 << 20;

/// Why a server could not run.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The configuration makes no sense, or is not safe.
    #[error("{0}")]
    Refused(#[from] Refusal),
    /// The address is taken, or none of this machine.
    #[error("can't listen on {address}: {error}; another --{field}, or port 0 for a free one, may do")]
    Listen {
        /// Which of the addresses of the configuration.
        field: &'static str,
        /// As it was given.
        address: String,
        /// Of the system.
        error: std::io::Error,
    },
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

/// What the health service tells of. The server itself, "", serves also where a part of it does not.
const SERVICES: [&str; 6] = [
    "",
    <SessionServiceServer<sessions::Sessions> as NamedService>::NAME,
    <HapticServiceServer<haptics::Haptics> as NamedService>::NAME,
    <ViewServiceServer<views::Views> as NamedService>::NAME,
    TOKENS,
    WORKSHOP,
];

/// Serves while the tokens in force are those of the file.
const TOKENS: &str = "palpate.tokens";

/// Tells of files whose contents are not in force, for ever.
fn tell_troubles(
    protection: &Protection,
    health: HealthReporter,
    traffic: Arc<Traffic>,
) -> impl Future<Output = ()> + use<> {
    let mut tokens = protection.credentials.troubles();
    let tls = protection.tls.as_ref().map(|tls| tls.troubles());
    let told = traffic.clone();
    let of_tokens = async move {
        loop {
            let useless = tokens.borrow_and_update().is_some();
            told.files("tokens", useless);
            let status = if useless { ServingStatus::NotServing } else { ServingStatus::Serving };
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

/// Says that the server does not serve any more. Then those who watch that are done with: they would be waited for.
async fn leave(mut health: HealthReporter) {
    for service in SERVICES {
        health.set_service_status(service, ServingStatus::NotServing).await;
    }
    for service in SERVICES {
        health.clear_service_status(service).await;
    }
}

/// The health service that tells whether heavy work is done in time.
const WORKSHOP: &str = "palpate.workshop";

/// Tells by [`WORKSHOP`] whether the workshop's oldest piece is within its deadline.
async fn report_workshop(workshop: Workshop, health: HealthReporter) {
    let mut look = tokio::time::interval(Duration::from_millis(250));
    let mut was_late = None;
    loop {
        look.tick().await;
        let load = workshop.load();
        if was_late.replace(load.is_late) == Some(load.is_late) {
            continue;
        }
        if load.is_late {
            warn!(oldest_s = load.oldest_s, waiting = load.waiting, "heavy work is past its deadline");
        }
        let status = if load.is_late { ServingStatus::NotServing } else { ServingStatus::Serving };
        health.set_service_status(WORKSHOP, status).await;
    }
}

/// Serves at `doors` until `shutdown` is cancelled; then ends all streams, and is over at the latest when the
/// deadline of the configuration has passed. The caller ends its runtime without waiting (`shutdown_background`).
pub async fn serve(doors: Doors, config: Config, shutdown: CancellationToken) -> Result<(), ServeError> {
    let Doors { listener, metrics, protection } = doors;
    let budget = Budget::new(&config.limits, config.stepping_threads(), config.serving_threads());
    info!(bytes = budget.bytes(), "memory to share");
    let pacer = Pacer::start(config.stepping_threads(), config.audit_share, &config.limits, budget.clone())?;
    let deadline = Duration::from_secs_f64(config.shutdown_deadline_s);
    let catalog = Catalog::new(&config.scenes, &config.scripts);
    for name in catalog.names() {
        if let Err(refusal) = catalog.load(&name, &[], &config.limits) {
            warn!(%refusal, "a scene that no session can be made from");
        }
    }
    let mut limits = config.limits.clone();
    let traffic = Arc::new(Traffic::default());
    descriptors::raise();
    limits.connections =
        descriptors::connections(limits.connections, metrics.as_ref().map_or(0, |_| metrics::SCRAPERS));
    let workshop = Workshop::open("workshop", &limits)?;
    if let Some(listener) = metrics {
        let registry = metrics::registry(&pacer, &traffic, &workshop);
        let (limits, shutdown) = (limits.clone(), shutdown.clone());
        tokio::spawn(async move { metrics::serve(listener, &limits, registry, shutdown).await });
    }
    let open = protection.credentials.get().is_open();
    if config.insecure && open {
        warn!("--insecure: whoever can reach this server may do everything");
    }
    let origins: Arc<[HeaderValue]> = config.origins.iter().filter_map(|origin| origin.parse().ok()).collect();
    let calls = Calls::new(protection.credentials.clone());
    let guard = GuardLayer {
        credentials: protection.credentials.clone(),
        calls: calls.clone(),
        patience: Duration::from_secs_f64(limits.open_s),
        traffic: traffic.clone(),
        budget: budget.clone(),
        local_only: open && !config.insecure,
        origins: origins.clone(),
    };
    let house = House {
        catalog,
        pacer: pacer.clone(),
        config: Arc::new(config),
        textures: Textures::new(&limits)?,
        workshop: workshop.clone(),
        traffic: traffic.clone(),
    };

    let (health, health_service) = tonic_health::server::health_reporter();
    for service in SERVICES {
        health.set_service_status(service, ServingStatus::Serving).await;
    }
    let telling = tell_troubles(&protection, health.clone(), traffic.clone());
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(pb::DESCRIPTORS)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };

    let reporting = report_workshop(workshop, health.clone());
    let (unused, memory) = (pacer.clone(), budget.clone());
    let mut most_bytes = 0;
    let sweeping = async move {
        let mut sweep = tokio::time::interval(Duration::from_secs(1));
        loop {
            sweep.tick().await;
            for session in unused.delete_idle() {
                info!(session, "session deleted: nobody used it");
            }
            let bytes = memory.bytes_taken();
            most_bytes = most_bytes.max(bytes);
            if most_bytes - bytes >= WORTH_GIVING_BACK {
                most_bytes = bytes;
                let _ = tokio::task::spawn_blocking(give_back_to_the_system).await;
            }
        }
    };

    // Who has not shown who they are leaves half of the room to others.
    let strangers = (!open).then_some(limits.connections.div_ceil(2));
    let seats = Arc::new(Seats::new(&limits, strangers));
    let register = Arc::new(connections::Register::default());
    let tls = protection.tls.clone();
    let incoming = connections::incoming(listener, tls, seats, &limits, budget.clone(), traffic, register.clone());
    let silence = Some(Duration::from_secs_f64(limits.keepalive_s));
    let bytes = limits.message_bytes;
    let (folder, painter) = (Arc::new(house.config.viewer.clone()), house.clone());
    let sessions = SessionServiceServer::new(sessions::Sessions(house.clone())).max_decoding_message_size(bytes);
    let haptics = HapticServiceServer::new(haptics::Haptics(house.clone())).max_decoding_message_size(bytes);
    let admin =
        AdminServiceServer::new(admin::Admin { house: house.clone(), register }).max_decoding_message_size(bytes);
    let views = ViewServiceServer::new(views::Views(house)).max_decoding_message_size(bytes);
    let routes = Routes::new(health_service)
        .add_service(reflection().build_v1()?)
        .add_service(reflection().build_v1alpha()?)
        .add_service(sessions)
        .add_service(haptics)
        .add_service(views)
        .add_service(admin)
        .into_axum_router()
        // Of the services alone: it refuses what is no gRPC.
        .route_layer(GrpcWebLayer::new())
        .route("/textures/{file}", axum::routing::get(move |file, headers| textures::file(painter, file, headers)))
        .fallback(move |request| page::page(folder.clone(), request));
    let drain = CancellationToken::new();
    let serving = Server::builder()
        // Finds out about clients whose host has vanished.
        .http2_keepalive_interval(silence)
        .http2_keepalive_timeout(silence)
        .max_concurrent_streams(limits.streams_per_connection)
        .initial_connection_window_size(limits.connection_window_bytes)
        // Browsers speak HTTP/2 only over TLS.
        .accept_http1(true)
        .layer(cors(&origins))
        .layer(guard)
        .add_routes(routes.into())
        .serve_with_incoming_shutdown(incoming, drain.clone().cancelled_owned());

    // One deadline for all that is left to do. A step that outlasts it goes down with the process.
    let (stopping, begun) = (pacer.clone(), shutdown.clone());
    let stop = async move {
        begun.cancelled().await;
        info!("shutting down");
        leave(health).await;
        drain.cancel();
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
        () = reporting => {}
        () = protection.watch() => {}
        () = calls.watch() => {}
        () = telling => {}
        () = over => warn!("steps or streams outlasted the deadline, and are cut"),
    }
    info!("stopped");
    Ok(())
}
