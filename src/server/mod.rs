//! The server: gRPC and gRPC-web services over `pace`, the page, health, reflection, metrics, and a shutdown with a
//! deadline.

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
mod recovered;
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

use palpate_proto::pb;
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
    /// Creates and changes sessions, reads scripts and computes force laws.
    pub(crate) workshop: Workshop,
    pub(crate) traffic: Arc<Traffic>,
}

/// A server's listeners and its protection.
pub struct Doors {
    listener: TcpListener,
    metrics: Option<TcpListener>,
    protection: Protection,
}

impl Doors {
    /// Listens on the configured addresses, if that is safe.
    ///
    /// # Errors
    /// Returns an error if the configuration is invalid or unsafe, a file can't be read, or an address is not available.
    pub async fn open(config: &Config) -> Result<Self, ServeError> {
        let listener = listen("listen", &config.listen).await?;
        let protection = Protection::load(config, local_address("listen", &listener, &config.listen)?)?;
        let metrics = match &config.metrics {
            Some(text) => {
                let listener = listen("metrics", text).await?;
                let address = local_address("metrics", &listener, text)?;
                if !address.ip().is_loopback() && !config.insecure {
                    let why = "and the metrics need no authentication: listen on 127.0.0.1, or pass --insecure";
                    let message = format!("other machines can reach {address}, {why}");
                    return Err(Refusal::new(Reason::OutOfRange, "metrics", message).into());
                }
                Some(listener)
            }
            None => None,
        };
        Ok(Doors { listener, metrics, protection })
    }

    /// The server's URL.
    pub fn url(&self) -> String {
        url(self.protection.scheme(), &self.listener)
    }

    /// The URL of the metrics, if they are served.
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
            let message = format!("must be address:port, such as 127.0.0.1:7117, but is `{text}`");
            return Refusal::new(Reason::WrongKind, field, message).into();
        }
        ServeError::Listen { field, address: text.to_owned(), error }
    })
}

/// The headers that pages of these origins may send and read in gRPC-web calls.
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

/// When this many bytes have become free, the allocator is asked to return its free memory to the system.
const WORTH_GIVING_BACK: u64 = 16 << 20;

/// Why a server can't run.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// The configuration is invalid or not safe.
    #[error("{0}")]
    Refused(#[from] Refusal),
    /// The address is in use, or not one of this machine.
    #[error("can't listen on {address}: {error}; try another --{field}, or port 0 for any free port")]
    Listen {
        /// The configuration's key of the address.
        field: &'static str,
        /// The address as it was given.
        address: String,
        /// The system's error.
        error: std::io::Error,
    },
    /// A thread can't be started.
    #[error("can't start a stepping thread: {0}")]
    Threads(#[from] std::io::Error),
    /// The transport failed.
    #[error("the transport failed: {0}")]
    Transport(#[from] tonic::transport::Error),
    /// The reflection service can't read its own descriptors.
    #[error("can't read the descriptors of the protocol: {0}")]
    Reflection(#[from] tonic_reflection::server::Error),
}

/// The services that the health service reports. The server itself, "", is serving even while one of the others is not.
const SERVICES: [&str; 6] = [
    "",
    <SessionServiceServer<sessions::Sessions> as NamedService>::NAME,
    <HapticServiceServer<haptics::Haptics> as NamedService>::NAME,
    <ViewServiceServer<views::Views> as NamedService>::NAME,
    TOKENS,
    WORKSHOP,
];

/// The health service that is serving while the tokens in use are those of the file.
const TOKENS: &str = "palpate.tokens";

/// Reports, to health and metrics, files whose contents are not in use. Never completes.
fn report_files(
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

/// Reports that the server is not serving any more. Then ends the streams that watch its health: shutdown would wait for
/// them.
async fn end_health(mut health: HealthReporter) {
    for service in SERVICES {
        health.set_service_status(service, ServingStatus::NotServing).await;
    }
    for service in SERVICES {
        health.clear_service_status(service).await;
    }
}

/// The health service that is serving while heavy work is done in time.
const WORKSHOP: &str = "palpate.workshop";

/// Reports by [`WORKSHOP`] whether the workshop's oldest job is within its deadline. Never completes.
async fn report_workshop(workshop: Workshop, health: HealthReporter) {
    let mut checks = tokio::time::interval(Duration::from_millis(250));
    let mut was_late = None;
    loop {
        checks.tick().await;
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

/// Serves at `doors` until `shutdown` is cancelled. Then ends all streams, and returns at the latest after the configured
/// deadline. The caller must end its runtime without waiting (`shutdown_background`).
///
/// # Errors
/// Returns an error if a thread can't be started, or if the transport fails.
pub async fn serve(doors: Doors, config: Config, shutdown: CancellationToken) -> Result<(), ServeError> {
    let Doors { listener, metrics, protection } = doors;
    let budget = Budget::new(&config.limits, config.stepping_threads(), config.serving_threads());
    info!(bytes = budget.bytes(), "memory that callers share");
    let pacer = Pacer::start(config.stepping_threads(), config.audit_share, &config.limits, budget.clone())?;
    let deadline = Duration::from_secs_f64(config.shutdown_deadline_s);
    let catalog = Catalog::new(&config.scenes, &config.scripts);
    for name in catalog.names() {
        if let Err(refusal) = catalog.load(&name, &[], &config.limits) {
            warn!(%refusal, "this scene is invalid: no session can be created from it");
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
        warn!("--insecure: everyone who can reach this server may do everything");
    }
    let origins: Arc<[HeaderValue]> = config.origins.iter().filter_map(|origin| origin.parse().ok()).collect();
    let calls = Calls::new(protection.credentials.clone());
    let guard = GuardLayer {
        credentials: protection.credentials.clone(),
        calls: calls.clone(),
        message_timeout: Duration::from_secs_f64(limits.open_s),
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
    let reporting_files = report_files(&protection, health.clone(), traffic.clone());
    let reflection = || {
        tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(pb::DESCRIPTORS)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
    };

    let reporting_work = report_workshop(workshop, health.clone());
    let (unused, memory) = (pacer.clone(), budget.clone());
    let mut most_bytes = 0;
    let sweeping = async move {
        let mut sweep = tokio::time::interval(Duration::from_secs(1));
        loop {
            sweep.tick().await;
            for session in unused.delete_idle() {
                info!(session, "session deleted: it was idle");
            }
            let bytes = memory.bytes_taken();
            most_bytes = most_bytes.max(bytes);
            if most_bytes - bytes >= WORTH_GIVING_BACK {
                most_bytes = bytes;
                let _ = tokio::task::spawn_blocking(give_back_to_the_system).await;
            }
        }
    };

    // Unauthenticated connections leave half of the limit to the others.
    let most_unauthenticated = (!open).then_some(limits.connections.div_ceil(2));
    let seats = Arc::new(Seats::new(&limits, most_unauthenticated));
    let register = Arc::new(connections::Register::default());
    let tls = protection.tls.clone();
    let incoming = connections::incoming(listener, tls, seats, &limits, budget.clone(), traffic, register.clone());
    let silence = Some(Duration::from_secs_f64(limits.keepalive_s));
    let bytes = limits.message_bytes;
    let (pages, shared) = (page::Page::of(house.config.viewer.clone()), house.clone());
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
        // Not for the routes below: the layer refuses what is not gRPC.
        .route_layer(GrpcWebLayer::new())
        .route("/textures/{file}", axum::routing::get(move |file, headers| textures::file(shared, file, headers)))
        .fallback(move |request| page::page(pages.clone(), request));
    let drain = CancellationToken::new();
    let serving = Server::builder()
        // Detects clients whose host has disappeared.
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

    // One deadline for everything that is left to do. A step that takes longer ends with the process.
    let (stopping, begun) = (pacer.clone(), shutdown.clone());
    let stop = async move {
        begun.cancelled().await;
        info!("shutting down");
        end_health(health).await;
        drain.cancel();
        // Waits for the running steps. Every stream then reads its end from its queue.
        let _ = tokio::task::spawn_blocking(move || stopping.stop()).await;
    };
    let deadline_passed = async {
        shutdown.cancelled().await;
        tokio::time::sleep(deadline).await;
    };
    tokio::select! {
        (served, ()) = async { tokio::join!(serving, stop) } => served?,
        () = sweeping => {}
        () = reporting_work => {}
        () = protection.watch() => {}
        () = calls.watch() => {}
        () = reporting_files => {}
        () = deadline_passed => warn!("the shutdown deadline has passed: cutting the remaining steps and streams"),
    }
    info!("stopped");
    Ok(())
}
