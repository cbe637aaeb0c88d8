//! The program `palpate`: parses arguments and calls one function.

use std::io::{BufWriter, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use clap::{Parser, Subcommand};
use palpate::limits::Limits;
use palpate::pace::clock::now_ns;
use palpate::refusal::Refusal;
use palpate::scene::{Scene, script::Script};
use palpate::server::{self, catalog::Catalog, config::Config};
use palpate::session::{check, run};
use palpate::sheet::Model;
use tokio_util::sync::CancellationToken;

/// A server for touching soft tissue over a network.
#[derive(Parser)]
#[command(version, about, max_term_width = 100)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Play a script on a scene, offline, as fast as it goes; write its records as JSON Lines
    #[command(after_help = "Examples:\n  \
        palpate run paper vertical-60\n  \
        palpate run my-scene.toml my-script.toml --output poke.jsonl --set stepping.integrator=lagged\n\n\
        Exit status: 0; 1 when the run failed; 2 when an input was refused.")]
    Run(RunArguments),
    /// Tell what a scene asks for: frequencies, integrator, substeps, expected error, time of a step, sessions on a core
    #[command(after_help = "Examples:\n  \
        palpate check paper\n  \
        palpate check my-scene.toml --set stepping.tolerance=1e-8\n\n\
        Exit status: 0; 2 when the scene was refused.")]
    Check(SceneArguments),
    /// Serve tissue over gRPC: sessions stepped in real time, commands in, forces and frames out
    #[command(after_help = "Examples:\n  \
        palpate serve\n  \
        palpate serve --listen 127.0.0.1:0 --scenes my-scenes --threads 1\n\n\
        The address is printed to the standard output when the server is ready. Ctrl-C or SIGTERM ends it: streams\n\
        are told, and cut when the deadline has passed.")]
    Serve(ServeArguments),
}

#[derive(clap::Args)]
struct ServeArguments {
    /// Where to listen; port 0 takes a free one [default: 127.0.0.1:7117]
    #[arg(long, value_name = "ADDRESS:PORT")]
    listen: Option<String>,
    /// Folder of the scenes that sessions can be made from by name [default: scenes]
    #[arg(long, value_name = "DIR")]
    scenes: Option<PathBuf>,
    /// Configuration file (TOML); its keys are in the README. These options go before it
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Stepping threads [default: one less than the machine has cores]
    #[arg(long, value_name = "N")]
    threads: Option<usize>,
    /// How long streams may take to end at shutdown before they are cut, s [default: 5]
    #[arg(long, value_name = "SECONDS")]
    shutdown_deadline_s: Option<f64>,
    /// What is logged to standard error: error, warn, info, debug, or palpate=debug,tonic=warn, … [default: info]
    #[arg(long, value_name = "FILTER")]
    log: Option<String>,
    /// Log as JSON, a line an event
    #[arg(long)]
    log_json: bool,
}

#[derive(clap::Args)]
struct SceneArguments {
    /// A scene file, or the name of one in --scenes; `paper` is built in
    scene: PathBuf,
    /// Folder of the scenes that have a name
    #[arg(long, value_name = "DIR", default_value = "scenes")]
    scenes: PathBuf,
    /// Set a key of the scene: a TOML value, or a bare string; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Configuration file (TOML) with other limits, in a section [limits]
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

#[derive(clap::Args)]
struct RunArguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// A script file, or the name of one in ./scripts
    script: PathBuf,
    /// Write the records here instead of to the standard output
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Hold forces and paths for each step, as a client does that streams a command a step
    #[arg(long)]
    held: bool,
}

/// How a program ends that does not end well.
enum Failure {
    /// Exit status 1.
    Failed(String),
    /// Exit status 2.
    Refused(String),
}

impl From<Refusal> for Failure {
    fn from(refusal: Refusal) -> Self {
        Failure::Refused(refusal.to_string())
    }
}

fn main() -> ExitCode {
    let ended = match Arguments::parse().command {
        Command::Run(arguments) => run_script(&arguments),
        Command::Check(arguments) => check(&arguments),
        Command::Serve(arguments) => serve(&arguments),
    };
    let (status, message) = match ended {
        Ok(()) => return ExitCode::SUCCESS,
        Err(Failure::Failed(message)) => (1, message),
        Err(Failure::Refused(message)) => (2, message),
    };
    eprintln!("palpate: {message}");
    ExitCode::from(status)
}

fn load_config(path: Option<&Path>) -> Result<Config, Refusal> {
    path.map_or_else(|| Ok(Config::default()), Config::load)
}

fn serve(arguments: &ServeArguments) -> Result<(), Failure> {
    let mut config = load_config(arguments.config.as_deref())?;
    if let Some(listen) = &arguments.listen {
        config.listen.clone_from(listen);
    }
    if let Some(scenes) = &arguments.scenes {
        if !scenes.is_dir() {
            return Err(Failure::Refused(format!("--scenes {}: is not a folder", scenes.display())));
        }
        config.scenes.clone_from(scenes);
    }
    if let Some(threads) = arguments.threads {
        config.threads = threads;
    }
    if let Some(deadline_s) = arguments.shutdown_deadline_s {
        config.shutdown_deadline_s = deadline_s;
    }
    if let Some(log) = &arguments.log {
        config.log.clone_from(log);
    }
    config.check()?;
    let filter = tracing_subscriber::EnvFilter::try_new(&config.log)
        .map_err(|e| Failure::Refused(format!("--log {}: {e}", config.log)))?;
    // Nobody waits for a log that is not read: what does not fit is dropped.
    let (writer, _flush) = tracing_appender::non_blocking(std::io::stderr());
    let subscriber = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(writer)
        .with_ansi(std::io::stderr().is_terminal());
    if arguments.log_json {
        subscriber.json().init();
    } else {
        subscriber.init();
    }
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(config.serving_threads())
        .thread_name("network")
        .enable_all()
        .build()
        .map_err(|e| Failure::Failed(format!("can't start the network threads: {e}")))?;
    let ended = runtime.block_on(async {
        let listen = &config.listen;
        let listener = tokio::net::TcpListener::bind(listen).await.map_err(|e| {
            if e.kind() == std::io::ErrorKind::InvalidInput {
                return Failure::Refused(format!("--listen {listen}: must be address:port, as in 127.0.0.1:7117"));
            }
            Failure::Failed(format!(
                "can't listen on {listen}: {e}; another --listen, or port 0 for a free one, may do"
            ))
        })?;
        let address = listener.local_addr().map_err(|e| Failure::Failed(e.to_string()))?;
        let shutdown = CancellationToken::new();
        tokio::spawn(cancel_on_signal(shutdown.clone()));
        // Who started us may have stopped listening; we serve all the same.
        let _ = writeln!(std::io::stdout(), "palpate listens on http://{address}");
        server::serve(listener, config, shutdown).await.map_err(|e| Failure::Failed(e.to_string()))
    });
    runtime.shutdown_background();
    ended
}

/// Ctrl-C and SIGTERM end the server; a second one ends it at once.
async fn cancel_on_signal(shutdown: CancellationToken) {
    for signals in 0.. {
        #[cfg(unix)]
        {
            use tokio::signal::unix::{SignalKind, signal};
            let Ok(mut terminate) = signal(SignalKind::terminate()) else { return };
            tokio::select! {
                _ = tokio::signal::ctrl_c() => {}
                _ = terminate.recv() => {}
            }
        }
        #[cfg(not(unix))]
        let _ = tokio::signal::ctrl_c().await;
        if signals > 0 {
            std::process::exit(130);
        }
        shutdown.cancel();
    }
}

/// The compiled scene that the arguments name, and the limits that hold.
fn compile(arguments: &SceneArguments) -> Result<(Arc<Model>, Limits), Failure> {
    let limits: Limits = load_config(arguments.config.as_deref())?.limits;
    let path = &arguments.scene;
    let scene = match path.to_str() {
        // A bare word that is no file is a name.
        Some(name) if !path.is_file() && path.components().count() == 1 && path.extension().is_none() => {
            Catalog::new(&arguments.scenes).load(name, &arguments.set, &limits)?
        }
        _ => Scene::load(path, &arguments.set, &limits)?,
    };
    // What only the compiled scene shows is of no one line.
    let in_scene = |refusal: Refusal| Refusal { place: Some(path.display().to_string()), ..refusal };
    Ok((Model::compile(&scene, &limits).map_err(in_scene)?, limits))
}

#[allow(clippy::cast_precision_loss)]
fn clock_s() -> f64 {
    now_ns() as f64 * 1e-9
}

fn check(arguments: &SceneArguments) -> Result<(), Failure> {
    let (model, limits) = compile(arguments)?;
    let report = check::check(&model, limits.substeps, &clock_s);
    match write!(std::io::stdout(), "{report}") {
        // Who reads has seen enough.
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(Failure::Failed(e.to_string())),
        _ => Ok(()),
    }
}

fn run_script(arguments: &RunArguments) -> Result<(), Failure> {
    let (model, limits) = compile(&arguments.scene)?;
    let script = Script::load(&arguments.script, &model.scene, &limits)?;
    for warning in model.warnings.iter().chain(&script.warnings) {
        eprintln!("palpate: warning: {warning}");
    }
    let output: Box<dyn Write> = match &arguments.output {
        Some(path) => Box::new(
            std::fs::File::create(path)
                .map_err(|e| Failure::Refused(format!("{}: can't be written: {e}", path.display())))?,
        ),
        None => Box::new(std::io::stdout().lock()),
    };
    let mut output = BufWriter::new(output);
    let (begun_s, watched) = (clock_s(), std::io::stderr().is_terminal());
    let mut progress = |step: u64| {
        // Only where somebody looks, and has waited.
        if watched && clock_s() - begun_s > 1.0 {
            eprint!("\rstep {step} of {} ", script.steps);
        }
    };
    let ended = run::run(&model, &script, arguments.held, &limits, &mut output, &clock_s, &mut progress);
    if watched && clock_s() - begun_s > 1.0 {
        eprintln!();
    }
    let ended = ended.and_then(|_| output.flush().map_err(run::Failure::Output));
    match ended {
        // Who reads has seen enough.
        Err(run::Failure::Output(e)) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        ended => ended.map_err(|failure| Failure::Failed(failure.to_string())),
    }
}
