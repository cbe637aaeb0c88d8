//! Runs the server: combines the services, the page and the metrics, and shuts down with a deadline.

use std::sync::Arc;
use std::time::Duration;

use futures_util::future::LocalBoxFuture;
use http::{HeaderName, HeaderValue, Method, header};
use tokio_util::sync::CancellationToken;
use tonic::service::Routes;
use tonic::transport::Server;
use tonic_health::ServingStatus;
use tonic_web::GrpcWebLayer;
use tower_http::cors::CorsLayer;
use tracing::{info, warn};

use super::authorize::AuthorizeLayer;
use super::catalog::Catalog;
use super::config::Config;
use super::connections::ConnectionSlots;
use super::datagrams;
use super::fleet::{self, Fleet};
use super::health::{SERVICES, end_health, report_files, report_job_pool};
use super::job_pool::JobPool;
use super::journals::Journals;
use super::journals::recorded::Recorded;
use super::listeners::{Listeners, ServeError};
use super::meshes::Meshes;
use super::revocation::Calls;
use super::services::Services;
use super::session_instruments::SessionInstruments;
use super::textures::Textures;
use super::traffic::Traffic;
use super::{admin, connections, descriptors, exercises, haptics, metrics, nodes, page, sessions, textures, views};
use palpate_proto::pb;
use palpate_proto::pb::admin_service_server::AdminServiceServer;
use palpate_proto::pb::exercise_service_server::ExerciseServiceServer;
use palpate_proto::pb::haptic_service_server::HapticServiceServer;
use palpate_proto::pb::node_service_server::NodeServiceServer;
use palpate_proto::pb::session_service_server::SessionServiceServer;
use palpate_proto::pb::view_service_server::ViewServiceServer;
use palpate_realtime::Pacer;
use palpate_realtime::clock::now_ns;
use palpate_session::budget::{Budget, give_back_to_the_system};

/// Returns the layer that lets pages of these origins send and read the headers of gRPC-web calls.
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

/// Time that connections which use none of the services have to end at shutdown.
const STRANGERS: Duration = Duration::from_secs(1);

/// Bytes that must become free before the allocator is asked to return free memory to the system.
const WORTH_GIVING_BACK: u64 = 16 << 20;

/// Serves at `listeners` until `shutdown` is cancelled. Then ends all streams, and returns within the configured
/// deadline. `config` must be the one that the listeners were opened with. Calls `ready` when everything that can
/// fail at the start is done: opening the journals, continuing the sessions of the previous process, joining the
/// fleet. The caller must end its runtime without waiting (`shutdown_background`).
///
/// A server on any free port, and a client that asks what it serves. Both end within the example:
///
/// ```
/// use palpate::server::config::Config;
/// use palpate::server::{Listeners, serve};
/// use palpate_client::{Credentials, Server};
/// use palpate_proto::pb;
/// use pb::session_service_client::SessionServiceClient;
/// use tokio_util::sync::CancellationToken;
///
/// let config = Config { listen: "127.0.0.1:0".to_owned(), threads: 1, datagrams: false, ..Config::default() };
/// let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build()?;
/// let created = runtime.block_on(async {
///     let listeners = Listeners::open(&config).await?;
///     let (url, shutdown) = (listeners.url(), CancellationToken::new());
///     let client = async {
///         let channel = Server::new(&url, &Credentials::default())?.connect().await?;
///         let source = pb::create_session_request::Source::SceneName("paper".to_owned());
///         let request = pb::CreateSessionRequest { source: Some(source), ..Default::default() };
///         let answer = SessionServiceClient::new(channel).create_session(request).await;
///         shutdown.cancel();
///         Ok::<_, Box<dyn std::error::Error>>(answer?.into_inner().session)
///     };
///     let (served, created) = tokio::join!(serve(listeners, config, shutdown.clone(), Box::new(|| {})), client);
///     served?;
///     created
/// })?;
/// runtime.shutdown_background();
/// let session = created.expect("a session of the built-in scene");
/// assert_eq!((session.scene_name.as_str(), session.idle_timeout_s), ("paper", 900.0));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
/// Returns an error if a thread can't be started, if the journals or the fleet can't be used, or if the transport fails.
pub fn serve(
    listeners: Listeners,
    config: Config,
    shutdown: CancellationToken,
    ready: Box<dyn FnOnce()>,
) -> LocalBoxFuture<'static, Result<(), ServeError>> {
    // Boxed, so that all services are compiled in this crate: a program that polled the unboxed future would compile
    // them again.
    Box::pin(run(listeners, config, shutdown, ready))
}

async fn run(
    listeners: Listeners,
    config: Config,
    shutdown: CancellationToken,
    ready: Box<dyn FnOnce()>,
) -> Result<(), ServeError> {
    let Listeners { listener, metrics, datagrams: socket, protection } = listeners;
    let budget = Budget::new(&config.limits, config.stepping_threads(), config.serving_threads());
    info!(bytes = budget.bytes(), "memory that callers share");
    let pacer = Pacer::start(config.stepping_threads(), config.audit_share, &config.limits, budget.clone())?;
    if config.profile {
        pacer.measure_stages();
    }
    let deadline = Duration::from_secs_f64(config.shutdown_deadline_s);
    let catalog = Catalog::new(&config.scenes, &config.scripts, &config.exercises);
    for name in catalog.foreign_names(&config.limits) {
        if let Err(refusal) = catalog.load(&name, &[], &config.limits) {
            warn!(%refusal, "this scene is invalid: no session can be created from it");
        }
    }
    for refusal in catalog.invalid_exercises(&config.limits) {
        warn!(%refusal, "this exercise is invalid: it is left out of the list");
    }
    for refusal in catalog.misplaced(&config.limits) {
        warn!(%refusal, "this file is left out of the list");
    }
    let mut limits = config.limits.clone();
    let traffic = Arc::new(Traffic::default());
    descriptors::raise();
    limits.connections =
        descriptors::connections(limits.connections, metrics.as_ref().map_or(0, |_| metrics::SCRAPERS));
    let job_pool = JobPool::open("job", &limits)?;
    let config = Arc::new(config);
    let fleet = match config.cluster.is_on() {
        true => Some(Fleet::join(&config, &pacer).await?),
        false => None,
    };
    let own = match &fleet {
        Some(fleet) => Some((fleet.own_sessions().await?, fleet.growth())),
        None => None,
    };
    // Continues the sessions of the previous process before any client is admitted.
    let (continued, kept) = (pacer.clone(), config.clone());
    let opened = tokio::task::spawn_blocking(move || Journals::open(&kept, &continued, own)).await;
    let journals = opened.map_err(std::io::Error::other)??;
    if let (Some(fleet), Some(journals)) = (&fleet, &journals) {
        fleet.begin(journals);
    }
    if let Some(listener) = metrics {
        let registry = metrics::registry(&pacer, &traffic, &job_pool, journals.as_deref(), fleet.clone());
        let (limits, shutdown) = (limits.clone(), shutdown.clone());
        tokio::spawn(async move { metrics::serve(listener, &limits, registry, shutdown).await });
    }
    let open = protection.credentials.get().is_open();
    if config.insecure && open {
        warn!("--insecure: everyone who can reach this server may do everything");
    }
    let origins: Arc<[HeaderValue]> = config.origins.iter().filter_map(|origin| origin.parse().ok()).collect();
    let calls = Calls::new(protection.credentials.clone());
    let authorize = AuthorizeLayer {
        credentials: protection.credentials.clone(),
        calls: calls.clone(),
        message_timeout: Duration::from_secs_f64(limits.open_s),
        traffic: traffic.clone(),
        budget: budget.clone(),
        local_only: open && !config.insecure,
        origins: origins.clone(),
        fence: fleet.is_some().then(|| pacer.fence.clone()),
    };
    let meshes = Meshes::new(&limits);
    let recorded = Recorded::new(journals.as_deref(), &config)?;
    let textures = Textures::open(&config, &catalog, &pacer, &limits)?;
    let (pages, counted) = (origins.clone(), traffic.clone());
    let datagrams = datagrams::receive(socket, pages, counted, shutdown.child_token()).await;
    let services = Services {
        datagrams,
        catalog,
        pacer: pacer.clone(),
        config,
        textures: textures.clone(),
        meshes: meshes.clone(),
        job_pool: job_pool.clone(),
        traffic: traffic.clone(),
        recorded: recorded.clone(),
        instruments: SessionInstruments::default(),
        fleet: fleet.clone(),
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

    let reporting_work = report_job_pool(job_pool, health.clone());
    let (unused, memory, sent) = (pacer.clone(), budget.clone(), recorded.clone());
    let mut most_bytes = 0;
    let sweeping = async move {
        let mut sweep = tokio::time::interval(Duration::from_secs(1));
        loop {
            sweep.tick().await;
            for session in unused.delete_idle() {
                info!(session, "session deleted: it was idle");
            }
            meshes.forget_expired(now_ns());
            sent.forget_expired(now_ns());
            let bytes = memory.bytes_taken();
            most_bytes = most_bytes.max(bytes);
            if most_bytes - bytes >= WORTH_GIVING_BACK {
                most_bytes = bytes;
                let _ = tokio::task::spawn_blocking(give_back_to_the_system).await;
            }
        }
    };

    // Unauthenticated connections can use at most half of the limit.
    let most_unauthenticated = (!open).then_some(limits.connections.div_ceil(2));
    let slots = Arc::new(ConnectionSlots::new(&limits, most_unauthenticated));
    let register = Arc::new(connections::Register::default());
    let tls = protection.tls.clone();
    let incoming = connections::incoming(listener, tls, slots, &limits, budget.clone(), traffic, register.clone());
    let silence = Some(Duration::from_secs_f64(limits.keepalive_s));
    let bytes = limits.message_bytes;
    let pages = page::Page::of(services.config.viewer.clone(), services.config.datagrams_advertise.as_deref());
    // A part of a mesh may be as long as the limit; its other fields add some bytes.
    let with_part = bytes.saturating_add(4096);
    let sessions = SessionServiceServer::new(sessions::Sessions(services.clone())).max_decoding_message_size(with_part);
    let haptics = HapticServiceServer::new(haptics::Haptics(services.clone())).max_decoding_message_size(bytes);
    let admin = AdminServiceServer::new(admin::Admin { services: services.clone(), register: register.clone() })
        .max_decoding_message_size(bytes);
    let node_calls = fleet.clone().map(|fleet| {
        let sessions = sessions::Sessions(services.clone());
        NodeServiceServer::new(nodes::Nodes { sessions, fleet }).max_decoding_message_size(fleet::MAX_MESSAGE_BYTES)
    });
    let exercises = ExerciseServiceServer::new(exercises::Exercises(services.clone())).max_decoding_message_size(bytes);
    let views = ViewServiceServer::new(views::Views(services)).max_decoding_message_size(bytes);
    let routes = Routes::new(health_service)
        .add_service(reflection().build_v1()?)
        .add_service(reflection().build_v1alpha()?)
        .add_service(sessions)
        .add_service(haptics)
        .add_service(views)
        .add_service(exercises)
        .add_service(admin);
    let routes = match node_calls {
        Some(calls) => routes.add_service(calls),
        None => routes,
    };
    let routes = routes
        .into_axum_router()
        // Not for the routes below: the layer refuses requests that are not gRPC.
        .route_layer(GrpcWebLayer::new())
        .route("/textures/{file}", axum::routing::get(move |file, headers| textures::file(textures, file, headers)))
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
        .layer(cors(&origins));
    // Outside of authorization, so that refused calls have spans too.
    #[cfg(feature = "otlp")]
    let serving = serving.layer(super::traces::TraceLayer);
    let serving = serving
        .layer(authorize)
        .add_routes(routes.into())
        .serve_with_incoming_shutdown(incoming, drain.clone().cancelled_owned());

    // One deadline for all remaining work. A step that takes longer ends with the process.
    let (stopping, begun) = (pacer.clone(), shutdown.clone());
    let stop = async move {
        begun.cancelled().await;
        info!("shutting down");
        end_health(health).await;
        drain.cancel();
        // Clients that only request health have no work to lose, and may not read the end of their stream.
        tokio::spawn(async move {
            tokio::time::sleep(STRANGERS).await;
            register.close_strangers();
        });
        // Waits for the running steps. Every stream then reads its end from its queue.
        let last = move || {
            stopping.stop();
            recorded.finish();
            journals.iter().for_each(|journals| journals.finish());
        };
        let _ = tokio::task::spawn_blocking(last).await;
        if let Some(fleet) = fleet {
            fleet.leave().await;
        }
    };
    let deadline_passed = async {
        shutdown.cancelled().await;
        tokio::time::sleep(deadline).await;
    };
    ready();
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
