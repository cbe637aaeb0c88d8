//! The program `palpate`: one function for each subcommand.

use std::io::{BufWriter, IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use clap::{Parser, Subcommand};
use palpate::budget;
use palpate::limits::Limits;
use palpate::pace::clock::now_ns;
use palpate::refusal::Refusal;
use palpate::render::{self, Film, View};
use palpate::scene::{Scene, script::Script};
use palpate::server::identity::{self, Role};
use palpate::server::{self, Doors, ServeError, catalog::Catalog, config::Config, signals};
use palpate::session::{check, run};
use palpate::sheet::Model;
use palpate::surface::Refinement;
use palpate::texture;
use tokio_util::sync::CancellationToken;
use tracing_subscriber::fmt::format::FmtSpan;

/// Writes a line to the standard error. A closed standard error does not end the program.
macro_rules! say {
    ($($text:tt)*) => {{
        let _ = std::io::stderr().write_all((format!($($text)*) + "\n").as_bytes());
    }};
}

/// A server for touching soft tissue over a network.
#[derive(Parser)]
#[command(version, about, max_term_width = 100)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Play a script on a scene, offline and as fast as possible; write the records as JSON Lines
    #[command(after_help = "Examples:\n  \
        palpate run paper vertical-60\n  \
        palpate run my-scene.toml my-script.toml --output poke.jsonl --set stepping.integrator=lagged\n\n\
        Exit status: 0; 1 when the run failed; 2 when an input was refused.")]
    Run(RunArguments),
    /// Report what a scene needs: frequencies, integrator, substeps, expected error, time per step, sessions per core
    #[command(after_help = "Examples:\n  \
        palpate check paper\n  \
        palpate check my-scene.toml --set stepping.tolerance=1e-8\n\n\
        Exit status: 0; 2 when the scene was refused.")]
    Check(SceneArguments),
    /// Draw a tissue while a script acts on it, without a screen: a PNG image of one moment, or a GIF of the whole script
    #[command(after_help = "Examples:\n  \
        palpate render paper oblique-100 --output poke.png\n  \
        palpate render paper vertical-60 --output mesh.png --wireframe --refine 1 --at-s 0.3 --camera 0,25\n  \
        palpate render liver my-script.toml --output poke.gif --size 480x360 --frames-hz 20\n\n\
        The scene's section [appearance] defines the texture. An arrow at its control point shows each force.\n\
        Exit status: 0; 1 when the run failed or the file can't be written; 2 when an input was refused.")]
    Render(RenderArguments),
    /// Paint an image for a tissue's surface: the lining of a stomach as an endoscope shows it
    #[command(after_help = "Examples:\n  \
        palpate texture --output mucosa.png\n  \
        palpate texture --seed 7 --size 4096 --output mucosa.png\n\n\
        The same seed and size give the same bytes; another size gives the same tissue at another resolution. To use a\n\
        texture in a scene, set texture_seed and texture_size in its section [appearance], or texture = \"FILE.png\".\n\
        Exit status: 0; 1 when the file can't be written; 2 when an input was refused.")]
    Texture(TextureArguments),
    /// Serve tissue over gRPC and to browsers: sessions in real time, commands in, forces and frames out
    #[command(after_help = "Examples:\n  \
        palpate serve\n  \
        palpate serve --listen 127.0.0.1:0 --scenes my-scenes --threads 1\n  \
        palpate token --name ann --role create,touch --tokens tokens.toml > ann.token\n  \
        palpate serve --listen 0.0.0.0:7117 --tls-cert server.pem --tls-key server.key --tokens tokens.toml\n  \
        palpate-client replay vertical-60 --server https://server:7117 --token-file ann.token\n\n\
        The server prints its address to the standard output when it is ready. Ctrl-C or SIGTERM ends it: all streams end\n\
        with the reason, and what remains after the deadline is cut.\n\n\
        On a loopback address every caller may do everything. At any other address the server starts only with TLS and\n\
        with tokens or client certificates, or with --insecure. A client sends its token with every call, as\n\
        `authorization: Bearer TOKEN`. Roles are watch, touch (hold a tool, change the tissue), create (create,\n\
        start, pause and delete sessions) and administer (everything, including the list of sessions). Health, reflection\n\
        and the page's files need no token; give the page one as in https://server:7117/#token=TOKEN.\n\
        The server checks certificates, keys and tokens twice a second, and at once on SIGHUP. Valid changes apply at once\n\
        to new connections and calls. Invalid files are logged and the old ones stay in use; for tokens, the health\n\
        service `palpate.tokens` reports it.")]
    Serve(Box<ServeArguments>),
    /// Create a token for clients of a server; prints the token once and stores only its hash
    #[command(after_help = "Examples:\n  \
        palpate token --name ann --role create,touch --tokens tokens.toml > ann.token\n  \
        palpate token --name screen --role watch\n\n\
        Roles: watch (every role includes it), touch (hold a tool, change the tissue), create (create, start, pause and\n\
        delete sessions), administer (everything). To revoke a token, delete its entry; the server notices within 1 s.")]
    Token(TokenArguments),
    /// Show the sessions of a server once a second (`palpate-client top`)
    #[command(disable_help_flag = true)]
    Top {
        /// See `palpate-client top --help`
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<std::ffi::OsString>,
    },
    /// Show what each caller uses of a server, and take it back (`palpate-client admin`)
    #[command(disable_help_flag = true, disable_help_subcommand = true)]
    Admin {
        /// See `palpate-client admin --help`
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<std::ffi::OsString>,
    },
}

#[derive(clap::Args)]
struct TokenArguments {
    /// Name of the token's owner, for the log
    #[arg(long)]
    name: String,
    /// Roles of the token: watch, touch, create, administer; separated by commas
    #[arg(long, value_name = "ROLE", required = true, value_delimiter = ',')]
    role: Vec<String>,
    /// Append the entry to this file instead of printing it
    #[arg(long, value_name = "FILE")]
    tokens: Option<PathBuf>,
}

#[derive(clap::Args)]
struct ServeArguments {
    /// Where to listen; port 0 takes a free one [default: 127.0.0.1:7117]
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
    /// Serve Prometheus metrics at http://ADDRESS:PORT/metrics [default: off]
    #[arg(long, value_name = "ADDRESS:PORT")]
    metrics: Option<String>,
    /// Folder of the scenes that clients can create sessions from by name [default: scenes]
    #[arg(long, value_name = "DIR")]
    scenes: Option<PathBuf>,
    /// Folder of the scripts that clients can ask for by name [default: scripts]
    #[arg(long, value_name = "DIR")]
    scripts: Option<PathBuf>,
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
    #[arg(long, value_name = "SHARE")]
    audit_share: Option<f64>,
    /// Time that streams get to end at shutdown before they are cut, s [default: 5]
    #[arg(long, value_name = "SECONDS")]
    shutdown_deadline_s: Option<f64>,
    /// Memory that the server may use for all callers together, such as 512MiB or 2GiB [default: half of the machine's, or
    /// of its control group's]
    #[arg(long, value_name = "BYTES", value_parser = budget::parse_bytes)]
    memory: Option<u64>,
    /// What to log to the standard error: error, warn, info, debug, or palpate=debug,tonic=warn, … [default: info]
    #[arg(long, value_name = "FILTER")]
    log: Option<String>,
    /// Log as JSON Lines
    #[arg(long)]
    log_json: bool,
}

#[derive(clap::Args)]
struct SceneArguments {
    /// A scene file, or the name of a scene in --scenes; `paper` is built in
    scene: PathBuf,
    /// Folder of the scenes that you can give by name
    #[arg(long, value_name = "DIR", default_value = "scenes")]
    scenes: PathBuf,
    /// Override a key of the scene: a TOML value, or a bare string; may be repeated
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
    /// A script file, or the name of a script in ./scripts
    script: PathBuf,
    /// Write the records here instead of to the standard output
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Hold forces and paths constant within each step, like a client that sends one command per step
    #[arg(long)]
    held: bool,
    /// Play the script a second time in parallel, in f64 with a quarter of the substep and all points awake. The summary
    /// then has audited_error: the largest difference of displacement and of force at the sample points and times, each
    /// relative to its largest. With [stepping] correct = true, the run is corrected where an error exceeds the tolerance
    #[arg(long)]
    audit: bool,
}

#[derive(clap::Args)]
struct RenderArguments {
    #[command(flatten)]
    scene: SceneArguments,
    /// A script file, or the name of a script in ./scripts
    script: PathBuf,
    /// The file to write: a .png of one moment, or a .gif of the whole script
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// The moment to draw, s, rounded to a step [default: the sample time with the largest displacement]
    #[arg(long, value_name = "SECONDS")]
    at_s: Option<f64>,
    /// Show the mesh instead of the texture
    #[arg(long)]
    wireframe: bool,
    /// Vertices between neighbouring points, 0 to 10 [default: enough for 300 along a side; 0 with --wireframe]
    #[arg(long, value_name = "N")]
    refine: Option<u32>,
    /// The camera: azimuth about the tissue's normal and elevation, degrees; distance, in sides of the sheet
    #[arg(long, value_name = "AZIMUTH,ELEVATION[,DISTANCE]", default_value = "25,32,2", allow_hyphen_values = true)]
    camera: String,
    /// Size of the image, pixels
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value = "800x600")]
    size: String,
    /// Images per second of a GIF
    #[arg(long, value_name = "HZ", default_value_t = 20.0)]
    frames_hz: f64,
}

#[derive(clap::Args)]
struct TextureArguments {
    /// Seed of the texture, an integer
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Pixels along each side
    #[arg(long, value_name = "PIXELS", default_value_t = 1024)]
    size: u32,
    /// The PNG file to write
    #[arg(short, long, value_name = "FILE.png")]
    output: PathBuf,
}

/// Why the program ends early.
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

impl From<ServeError> for Failure {
    fn from(error: ServeError) -> Self {
        match error {
            ServeError::Refused(refusal) => refusal.into(),
            error => Failure::Failed(error.to_string()),
        }
    }
}

fn main() -> ExitCode {
    let ended = match Arguments::parse().command {
        Command::Run(arguments) => within_memory(|| run_script(&arguments)),
        Command::Check(arguments) => within_memory(|| check(&arguments)),
        Command::Render(arguments) => within_memory(|| render(&arguments)),
        Command::Texture(arguments) => within_memory(|| make_texture(&arguments)),
        Command::Serve(arguments) => serve(&arguments),
        Command::Token(arguments) => token(&arguments),
        Command::Top { arguments } => return client("top", &arguments),
        Command::Admin { arguments } => return client("admin", &arguments),
    };
    let (status, message) = match ended {
        Ok(()) => return ExitCode::SUCCESS,
        Err(Failure::Failed(message)) => (1, message),
        Err(Failure::Refused(message)) => (2, message),
    };
    say!("palpate: {message}");
    ExitCode::from(status)
}

/// Does something that may need more memory than there is.
fn within_memory(work: impl FnOnce() -> Result<(), Failure>) -> Result<(), Failure> {
    palpate::memory::attempt("", || Ok(work()))?
}

fn load_config(path: Option<&Path>) -> Result<Config, Refusal> {
    path.map_or_else(|| Ok(Config::default()), Config::load)
}

fn serve(arguments: &ServeArguments) -> Result<(), Failure> {
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
    if arguments.metrics.is_some() {
        config.metrics.clone_from(&arguments.metrics);
    }
    for (option, folder, key) in [
        ("--scenes", &arguments.scenes, &mut config.scenes),
        ("--scripts", &arguments.scripts, &mut config.scripts),
        ("--viewer", &arguments.viewer, &mut config.viewer),
    ] {
        let Some(folder) = folder else { continue };
        if !folder.is_dir() {
            return Err(Failure::Refused(format!("{option} {}: is not a folder", folder.display())));
        }
        key.clone_from(folder);
    }
    if let Some(threads) = arguments.threads {
        config.threads = threads;
    }
    if let Some(share) = arguments.audit_share {
        config.audit_share = share;
    }
    if let Some(deadline_s) = arguments.shutdown_deadline_s {
        config.shutdown_deadline_s = deadline_s;
    }
    if let Some(bytes) = arguments.memory {
        config.limits.memory_bytes = bytes;
    }
    if let Some(log) = &arguments.log {
        config.log.clone_from(log);
    }
    config.check()?;
    let filter = tracing_subscriber::EnvFilter::try_new(&config.log)
        .map_err(|e| Failure::Refused(format!("--log {}: {e}", config.log)))?;
    let detailed = filter.max_level_hint().is_none_or(|level| level >= tracing::Level::DEBUG);
    // Logging never blocks: lines that do not fit into the queue are dropped.
    let (writer, _flush) = tracing_appender::non_blocking(std::io::stderr());
    let subscriber = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(writer)
        // At level debug, the duration of each call and sampled step is logged when it ends.
        .with_span_events(if detailed { FmtSpan::CLOSE } else { FmtSpan::NONE })
        .with_ansi(std::io::stderr().is_terminal());
    if arguments.log_json {
        subscriber.json().init();
    } else {
        subscriber.init();
    }
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(config.serving_threads())
        .thread_name("network")
        // Blocking threads read files, twice a second. With the default keep-alive of 10 s these checks would wake every
        // idle thread in turn before it ends, so that none ever would.
        .max_blocking_threads(16)
        .thread_keep_alive(Duration::from_secs(1))
        .enable_all()
        .build()
        .map_err(|e| Failure::Failed(format!("can't start the network threads: {e}")))?;
    let ended = runtime.block_on(async {
        let doors = Doors::open(&config).await?;
        let shutdown = CancellationToken::new();
        signals::outlive();
        tokio::spawn(signals::cancel_on(shutdown.clone()));
        // The standard output may be closed; that does not stop the server.
        let _ = writeln!(std::io::stdout(), "palpate listens on {}", doors.url());
        if let Some(url) = doors.metrics_url() {
            let _ = writeln!(std::io::stdout(), "metrics are at {url}");
        }
        Ok(server::serve(doors, config, shutdown).await?)
    });
    runtime.shutdown_background();
    ended
}

/// Runs a command of `palpate-client`, which must be in the folder of this program.
fn client(command: &str, arguments: &[std::ffi::OsString]) -> ExitCode {
    let program = std::env::current_exe().unwrap_or_default().with_file_name("palpate-client");
    match std::process::Command::new(&program).arg(command).args(arguments).status() {
        Ok(status) => status.code().and_then(|code| u8::try_from(code).ok()).map_or(ExitCode::FAILURE, ExitCode::from),
        Err(e) => {
            say!("palpate: {}: {e}", program.display());
            ExitCode::FAILURE
        }
    }
}

fn token(arguments: &TokenArguments) -> Result<(), Failure> {
    let roles: Vec<Role> = arguments.role.iter().map(|role| Role::named(role)).collect::<Result<_, _>>()?;
    let token = identity::new_token()?;
    let entry = identity::entry(&arguments.name, &roles, &token)?;
    let Some(path) = &arguments.tokens else {
        let printed = writeln!(
            std::io::stdout(),
            "# For the client (--token-file or PALPATE_TOKEN); it is not stored anywhere:\n{token}\n\n\
             # For the server's file (--tokens):\n{entry}"
        );
        return printed.map_err(|e| Failure::Failed(e.to_string()));
    };
    let refuse = |e: std::io::Error| Failure::Refused(format!("{}: can't be written: {e}", path.display()));
    let mut options = std::fs::OpenOptions::new();
    options.append(true).create(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    let mut file = options.open(path).map_err(refuse)?;
    // In one write: a server may read the file at any moment.
    file.write_all(format!("\n{entry}").as_bytes()).map_err(refuse)?;
    writeln!(std::io::stdout(), "{token}").map_err(|e| Failure::Failed(e.to_string()))
}

/// Factor by which compiling a scene may take more work here than on a server: reference solutions need a tolerance of
/// 1e-10.
const OFFLINE_WORK: u64 = 32;

/// Compiles the scene that the arguments name; returns it with the limits in force.
fn compile(arguments: &SceneArguments) -> Result<(Arc<Model>, Limits), Failure> {
    let mut limits: Limits = load_config(arguments.config.as_deref())?.limits;
    // No other caller waits here.
    limits.rehearsal_work = limits.rehearsal_work.saturating_mul(OFFLINE_WORK);
    let path = &arguments.scene;
    let scene = match path.to_str() {
        // A plain word that is not a file is a scene's name.
        Some(name) if !path.is_file() && path.components().count() == 1 && path.extension().is_none() => {
            Catalog::new(&arguments.scenes, Path::new("scripts")).load(name, &arguments.set, &limits)?
        }
        _ => Scene::load(path, &arguments.set, &limits)?,
    };
    // An error of compilation belongs to no single line.
    let in_scene = |refusal: Refusal| Refusal { place: Some(path.display().to_string()), ..refusal };
    Ok((Model::compile(&scene, &limits).map_err(in_scene)?, limits))
}

#[allow(clippy::cast_precision_loss)]
fn clock_s() -> f64 {
    now_ns() as f64 * 1e-9
}

fn check(arguments: &SceneArguments) -> Result<(), Failure> {
    let (model, limits) = compile(arguments)?;
    let report = check::check(&model, &limits, &clock_s);
    match write!(std::io::stdout(), "{report}") {
        // A reader that closed the pipe is not an error.
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(Failure::Failed(e.to_string())),
        _ => Ok(()),
    }
}

/// Runs `work` and shows its progress; `work` reports the steps that it has done.
fn with_progress<T>(steps: u64, work: impl FnOnce(&mut dyn FnMut(u64)) -> T) -> T {
    let (begun_s, watched) = (clock_s(), std::io::stderr().is_terminal());
    let done = work(&mut |step| {
        // Only on a terminal, and after a second.
        if watched && clock_s() - begun_s > 1.0 {
            eprint!("\rstep {step} of {steps} ");
        }
    });
    if watched && clock_s() - begun_s > 1.0 {
        say!("");
    }
    done
}

fn write_file(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    std::fs::write(path, bytes).map_err(|e| Failure::Failed(format!("{}: can't be written: {e}", path.display())))
}

fn make_texture(arguments: &TextureArguments) -> Result<(), Failure> {
    let image = texture::mucosa(arguments.seed, arguments.size, &Limits::default())?;
    write_file(&arguments.output, &image.png()?)
}

fn render(arguments: &RenderArguments) -> Result<(), Failure> {
    let refused = |option: &str, message: String| Failure::Refused(format!("--{option}: {message}"));
    let extension = arguments.output.extension().and_then(|extension| extension.to_str()).map(str::to_lowercase);
    let moves = match extension.as_deref() {
        Some("png") => false,
        Some("gif") => true,
        _ => return Err(refused("output", format!("{}: must end in .png or .gif", arguments.output.display()))),
    };
    let most = render::LARGEST_SIDE;
    let size = arguments.size.split_once('x').and_then(|(x, y)| Some([x.parse().ok()?, y.parse().ok()?]));
    let size = size.filter(|size| size.iter().all(|side| (16..=most).contains(side))).ok_or_else(|| {
        refused("size", format!("must be WIDTHxHEIGHT, each from 16 to {most} pixels, but is `{}`", arguments.size))
    })?;
    if !(1.0..=50.0).contains(&arguments.frames_hz) {
        return Err(refused("frames-hz", format!("must be from 1 to 50, but is {}", arguments.frames_hz)));
    }
    let (model, limits) = compile(&arguments.scene)?;
    let script = Script::load(&arguments.script, &model.scene, &limits)?;
    for warning in model.warnings.iter().chain(&script.warnings) {
        say!("palpate: warning: {warning}");
    }
    let rate_hz = model.scene.stepping.rate_hz;
    let at_step = arguments.at_s.map(|at_s| {
        let step = (at_s * rate_hz).round();
        let holds = step >= 0.0 && step <= script.steps as f64;
        let lasts_s = script.steps as f64 / rate_hz;
        let message = format!("must be from 0 to {lasts_s}, the script's duration, but is {at_s}");
        if holds { Ok(step as u64) } else { Err(refused("at-s", message)) }
    });
    let at_step = at_step.transpose()?;
    if moves && at_step.is_some() {
        return Err(refused("at-s", "applies to a .png only: a .gif shows the whole script".to_owned()));
    }
    let camera = arguments.camera.parse()?;
    let cells = (model.points[0].max(model.points[1]) - 1).max(1) as u32;
    let fine = if arguments.wireframe { 0 } else { 300_u32.div_ceil(cells).clamp(1, 11) - 1 };
    let refinement = Refinement::new(model.points, arguments.refine.unwrap_or(fine), &limits)?;
    let skin = if arguments.wireframe { None } else { Some(texture::image(&model.scene.appearance, &limits)?) };
    let view = View { camera, size, refinement, texture: skin };
    let failed = |failure: render::Failure| match failure {
        render::Failure::Refused(refusal) => Failure::from(refusal),
        failure => Failure::Failed(failure.to_string()),
    };
    if moves {
        let mut file = Vec::new();
        with_progress(script.steps, |progress| {
            render::gif(&model, &script, &view, &limits, arguments.frames_hz, &mut file, progress).map_err(failed)
        })?;
        return write_file(&arguments.output, &file);
    }
    let mut film = Film::new(&model, &script, &limits).map_err(failed)?;
    let still = match at_step {
        Some(step) => film.at(step),
        None => film.deepest(),
    };
    write_file(&arguments.output, &still.map_err(failed)?.picture(&model, &view).png()?)
}

fn run_script(arguments: &RunArguments) -> Result<(), Failure> {
    let (model, limits) = compile(&arguments.scene)?;
    let script = Script::load(&arguments.script, &model.scene, &limits)?;
    for warning in model.warnings.iter().chain(&script.warnings) {
        say!("palpate: warning: {warning}");
    }
    let output: Box<dyn Write> = match &arguments.output {
        Some(path) => Box::new(
            std::fs::File::create(path)
                .map_err(|e| Failure::Refused(format!("{}: can't be written: {e}", path.display())))?,
        ),
        None => Box::new(std::io::stdout().lock()),
    };
    let mut output = BufWriter::new(output);
    let run = if arguments.audit { run::audited } else { run::run };
    let ended = with_progress(script.steps, |progress| {
        run(&model, &script, arguments.held, &limits, &mut output, &clock_s, progress)
    });
    let ended = ended.and_then(|summary| output.flush().map(|()| summary).map_err(run::Failure::Output));
    match ended {
        // A reader that closed the pipe is not an error.
        Err(run::Failure::Output(e)) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        Err(run::Failure::Refused(refusal)) => Err(refusal.into()),
        Err(failure) => Err(Failure::Failed(failure.to_string())),
        Ok(summary) => summary.fault().map_or(Ok(()), |fault| Err(Failure::Failed(fault))),
    }
}
