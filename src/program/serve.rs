//! `palpate serve`: serves tissue over gRPC and to browsers.

use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

#[cfg(feature = "otlp")]
use palpate::server::traces::{self, Traces};
use palpate::server::{self, Listeners, signals};
use palpate_realtime::priority::{NETWORK_TURN, take_short_turns};
use palpate_session::budget;
use palpate_tissue::check_processor;
use tokio_util::sync::CancellationToken;
#[cfg(feature = "otlp")]
use tracing_subscriber::filter::LevelFilter;
use tracing_subscriber::fmt::format::FmtSpan;
use tracing_subscriber::layer::{Filter, SubscriberExt};
use tracing_subscriber::util::SubscriberInitExt;
use tracing_subscriber::{Layer, Registry};

use super::{Failure, load_config, log};

#[derive(clap::Args)]
pub(crate) struct ServeArguments {
    /// Address to listen on; port 0 takes a free one [default: 127.0.0.1:7117]
    #[arg(long, value_name = "ADDRESS:PORT")]
    listen: Option<String>,
    /// The server's certificate chain (PEM); enables TLS
    #[arg(long, value_name = "FILE")]
    tls_cert: Option<PathBuf>,
    /// The server's private key (PEM)
    #[arg(long, value_name = "FILE")]
    tls_key: Option<PathBuf>,
    /// Certificate authorities (PEM): clients must present a certificate that one of them has signed
    #[arg(long, value_name = "FILE")]
    tls_client_ca: Option<PathBuf>,
    /// Roles of tokens and client certificates (TOML); `palpate token` writes entries
    #[arg(long, value_name = "FILE")]
    tokens: Option<PathBuf>,
    /// Allow an address that other machines can reach, without TLS or authentication
    #[arg(long)]
    insecure: bool,
    /// Origin of another site whose pages may call, such as https://example.org; may be repeated
    #[arg(long, value_name = "ORIGIN")]
    origin: Vec<String>,
    /// Disable touch by datagram (WebTransport over UDP), which otherwise uses the UDP port of the same number
    #[arg(long)]
    no_datagrams: bool,
    /// Address for datagrams to give to clients, if it differs from the server's own: behind a proxy or in a container
    #[arg(long, value_name = "HOST:PORT", conflicts_with = "no_datagrams")]
    datagrams_advertise: Option<String>,
    /// Serve Prometheus metrics at http://ADDRESS:PORT/metrics [default: off]
    #[arg(long, value_name = "ADDRESS:PORT")]
    metrics: Option<String>,
    /// Send a trace of each call to a collector of OpenTelemetry, by OTLP over gRPC: http://HOST:4317. Needs a program
    /// built with the feature `otlp` [default: off]
    #[arg(long, value_name = "URL")]
    otlp: Option<String>,
    /// Folder of the scenes that clients can create sessions from by name [default: scenes]
    #[arg(long, value_name = "DIR")]
    scenes: Option<PathBuf>,
    /// Folder of the scripts that clients can read by name [default: scripts]
    #[arg(long, value_name = "DIR")]
    scripts: Option<PathBuf>,
    /// Folder of the exercises that clients can create sessions for by name [default: exercises]
    #[arg(long, value_name = "DIR")]
    exercises: Option<PathBuf>,
    /// Folder of the page that `/` serves, built by `npm run build` in clients/viewer [default: clients/viewer/dist]
    #[arg(long, value_name = "DIR")]
    viewer: Option<PathBuf>,
    /// Configuration file (TOML); docs/palpate.toml lists every key. Options on the command line override it
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Stepping threads [default: one less than the machine has cores]
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// Fraction of a core for measuring the errors of live sessions; 0 disables that [default: 0.02]
    #[arg(long, value_name = "FRACTION")]
    audit_share: Option<f64>,
    /// Measure how long each stage of a step takes, which `palpate-client top` shows
    #[arg(long)]
    profile: bool,
    /// Keep a journal of each session in this folder: after a crash or an upgrade the server continues the sessions
    /// [default: off]
    #[arg(long, value_name = "DIR")]
    journal: Option<PathBuf>,
    /// Time to keep the journals of ended sessions, and the size of all journals beyond which the server removes the
    /// oldest of these: 30d, 12h, 10GiB, both, or 0 to keep none [default: 30d,10GiB]
    #[arg(long, value_name = "AGE,BYTES", requires = "journal")]
    journal_keep: Option<palpate::server::Keep>,
    /// Whether sessions on a mesh from a client have journals, which contain the mesh; without a journal such a
    /// session ends with the server [default: true]
    #[arg(long, value_name = "true|false", requires = "journal", action = clap::ArgAction::Set)]
    journal_meshes: Option<bool>,
    /// Sign the journals with this key (PEM) from `palpate journal key`: `verify --signed-by` then detects changes
    #[arg(long, value_name = "FILE")]
    journal_key: Option<PathBuf>,
    /// Join a fleet: URLs of the members of etcd, such as http://etcd:2379. Needs --journal and --advertise
    #[arg(long, value_name = "URL", value_delimiter = ',', requires = "advertise")]
    cluster: Vec<String>,
    /// URL under which clients and the other servers of the fleet reach this one
    #[arg(long, value_name = "URL")]
    advertise: Option<String>,
    /// Name of this server in its fleet [default: host and port of --advertise]
    #[arg(long, value_name = "NAME")]
    node: Option<String>,
    /// Name of the fleet [default: default]
    #[arg(long, value_name = "NAME")]
    cluster_name: Option<String>,
    /// Certificate authorities (PEM) of the servers of the fleet, which present --tls-cert to each other; other
    /// clients need no certificate
    #[arg(long, value_name = "FILE")]
    cluster_ca: Option<PathBuf>,
    /// Meaning of `durable_step` in a fleet: on the disk of the server (one), or also on that of its stand-by server
    /// (two) [default: one]
    #[arg(long, value_name = "SERVERS")]
    durable: Option<palpate::server::Durable>,
    /// Report the server's state to Agones: ready, its sessions, drained. For a server of a fleet in a pod of Agones
    #[arg(long)]
    agones: bool,
    /// Time for streams to end at shutdown before the server cuts them, s [default: 5]
    #[arg(long, value_name = "SECONDS")]
    shutdown_deadline_s: Option<f64>,
    /// Memory that the server may use for all callers together, such as 512MiB or 2GiB [default: half of the
    /// machine's, or of its control group's]
    #[arg(long, value_name = "BYTES", value_parser = budget::parse_bytes)]
    memory: Option<u64>,
    /// Level of the log on the standard error: error, warn, info, debug, or palpate=debug,tonic=warn, … [default:
    /// info]
    #[arg(long, value_name = "FILTER")]
    log: Option<String>,
    /// Log as JSON Lines
    #[arg(long)]
    log_json: bool,
}

/// Returns whether a folder contains a page. The client library's examples have no index.html.
fn has_page(folder: &Path) -> bool {
    let mut files = folder.read_dir().into_iter().flatten().flatten();
    files.any(|file| file.path().extension().is_some_and(|extension| extension == "html"))
}

/// What a server runs in: a terminal, or the service control manager of Windows.
pub(crate) struct ServerHost {
    /// Ends the server when it is cancelled, as a signal does.
    pub(crate) shutdown: CancellationToken,
    /// Where the log goes, and whether it has colours.
    pub(crate) log: Box<dyn Write + Send>,
    pub(crate) has_colours: bool,
    /// Called when the server serves.
    pub(crate) ready: Box<dyn FnOnce()>,
}

/// Serves until a signal stops it.
pub(crate) fn serve(arguments: &ServeArguments) -> Result<(), Failure> {
    let host = ServerHost {
        shutdown: CancellationToken::new(),
        log: Box::new(std::io::stderr()),
        has_colours: std::io::stderr().is_terminal(),
        ready: Box::new(|| {}),
    };
    serve_in(arguments, host)
}

/// Serves until a signal or the host stops it.
pub(crate) fn serve_in(arguments: &ServeArguments, host: ServerHost) -> Result<(), Failure> {
    let mut config = load_config(arguments.config.as_deref())?;
    if let Some(listen) = &arguments.listen {
        config.listen.clone_from(listen);
    }
    let files = [
        (&arguments.tls_cert, &mut config.tls_cert),
        (&arguments.tls_key, &mut config.tls_key),
        (&arguments.tls_client_ca, &mut config.tls_client_ca),
        (&arguments.tokens, &mut config.tokens),
    ];
    for (given, configured) in files {
        if given.is_some() {
            configured.clone_from(given);
        }
    }
    config.insecure |= arguments.insecure;
    config.origins.extend(arguments.origin.iter().cloned());
    config.datagrams &= !arguments.no_datagrams;
    if arguments.datagrams_advertise.is_some() {
        config.datagrams_advertise.clone_from(&arguments.datagrams_advertise);
    }
    if arguments.metrics.is_some() {
        config.metrics.clone_from(&arguments.metrics);
    }
    if arguments.otlp.is_some() {
        config.otlp.clone_from(&arguments.otlp);
    }
    for (option, folder, key) in [
        ("--scenes", &arguments.scenes, &mut config.scenes),
        ("--scripts", &arguments.scripts, &mut config.scripts),
        ("--exercises", &arguments.exercises, &mut config.exercises),
        ("--viewer", &arguments.viewer, &mut config.viewer),
    ] {
        let Some(folder) = folder else { continue };
        if !folder.is_dir() {
            return Err(Failure::Refused(format!("{option} {}: is not a folder", folder.display())));
        }
        if option == "--viewer" && !has_page(folder) {
            let message = "has no .html file; `npm run build` in clients/viewer makes the page in clients/viewer/dist";
            return Err(Failure::Refused(format!("{option} {}: {message}", folder.display())));
        }
        key.clone_from(folder);
    }
    if let Some(threads) = arguments.threads {
        config.threads = threads;
    }
    if let Some(share) = arguments.audit_share {
        config.audit_share = share;
    }
    config.profile |= arguments.profile;
    if let Some(deadline_s) = arguments.shutdown_deadline_s {
        config.shutdown_deadline_s = deadline_s;
    }
    if arguments.journal.is_some() {
        config.journal.clone_from(&arguments.journal);
    }
    if let Some(meshes) = arguments.journal_meshes {
        config.journal_meshes = meshes;
    }
    if arguments.journal_key.is_some() {
        config.journal_key.clone_from(&arguments.journal_key);
    }
    if let Some(keep) = arguments.journal_keep {
        config.journal_keep = keep;
    }
    let cluster = &mut config.cluster;
    if !arguments.cluster.is_empty() {
        cluster.etcd.clone_from(&arguments.cluster);
    }
    if arguments.advertise.is_some() {
        cluster.advertise.clone_from(&arguments.advertise);
    }
    if arguments.cluster_ca.is_some() {
        cluster.ca.clone_from(&arguments.cluster_ca);
    }
    for (given, configured) in [(&arguments.node, &mut cluster.node), (&arguments.cluster_name, &mut cluster.name)] {
        if let Some(given) = given {
            configured.clone_from(given);
        }
    }
    cluster.agones |= arguments.agones;
    if let Some(durable) = arguments.durable {
        cluster.durable = durable;
    }
    if let Some(bytes) = arguments.memory {
        config.limits.memory_bytes = bytes;
    }
    if let Some(log) = &arguments.log {
        config.log.clone_from(log);
    }
    config.check()?;
    // Clients don't choose lanes.
    check_processor()?;
    let filter = log::filter(&config.log).map_err(|wrong| Failure::Refused(format!("log: {wrong}")))?;
    let detailed = Filter::<Registry>::max_level_hint(&filter).is_none_or(|level| level >= tracing::Level::DEBUG);
    budget::set_up_allocator();
    // Logging never blocks: lines that do not fit into the queue are dropped.
    let (writer, _flush) = tracing_appender::non_blocking(host.log);
    let log = tracing_subscriber::fmt::layer()
        // At level debug, the duration of each call and sampled step is logged when it ends.
        .with_span_events(if detailed { FmtSpan::CLOSE } else { FmtSpan::NONE })
        .with_ansi(host.has_colours);
    let log = if arguments.log_json {
        log.json().with_writer(move || log::JsonRecords(writer.clone())).boxed()
    } else {
        log.fmt_fields(log::fields()).with_writer(writer).boxed()
    };
    #[cfg(feature = "otlp")]
    let (filter, traces) = (filter.with_target(traces::TARGET, LevelFilter::OFF), Traces::start(&config)?);
    let layers = vec![log.with_filter(filter).boxed()];
    #[cfg(feature = "otlp")]
    let layers: Vec<_> = layers.into_iter().chain(traces.as_ref().map(|traces| traces.layer().boxed())).collect();
    Registry::default().with(layers).init();
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(config.serving_threads())
        .thread_name("network")
        // Blocking threads read files, twice a second. With the default keep-alive of 10 s these checks would wake
        // every idle thread in turn before it ends, so that none ever would.
        .max_blocking_threads(16)
        .thread_keep_alive(Duration::from_secs(1))
        .on_thread_start(|| take_short_turns(NETWORK_TURN))
        .enable_all()
        .build()
        .map_err(|e| Failure::Failed(format!("can't start the network threads: {e}")))?;
    let ended = runtime.block_on(async {
        let listeners = Listeners::open(&config).await?;
        let shutdown = host.shutdown;
        signals::outlive();
        signals::cancel_on(shutdown.clone());
        let (url, metrics) = (listeners.url(), listeners.metrics_url());
        let ready = Box::new(move || {
            // The standard output may be closed; that does not stop the server.
            let _ = writeln!(std::io::stdout(), "palpate listens on {url}");
            if let Some(url) = metrics {
                let _ = writeln!(std::io::stdout(), "metrics are at {url}");
            }
            (host.ready)();
        });
        Ok(server::serve(listeners, config, shutdown, ready).await?)
    });
    runtime.shutdown_background();
    #[cfg(feature = "otlp")]
    if let Some(traces) = traces {
        traces.finish();
    }
    ended
}
