//! `palpate-client`: programs that talk to a Palpate server.

// Clients live in real time; the rule is for what a server computes.
#![allow(clippy::disallowed_methods)]

/// Writes a line to the standard error, with names and messages of others made printable. A closed standard error
/// does not end the program.
macro_rules! say {
    ($($text:tt)*) => {{
        let text = palpate_refusal::printable::printable(format_args!($($text)*));
        let _ = std::io::Write::write_all(&mut std::io::stderr(), (text + "\n").as_bytes());
    }};
}

/// Writes lines to the standard output. The caller makes texts of others printable first, as a part of a line or as
/// JSON. A closed standard output does not end the program.
macro_rules! tell {
    ($($text:tt)*) => {{
        let text = palpate_refusal::printable::printable_lines(format_args!($($text)*));
        let _ = std::io::Write::write_all(&mut std::io::stdout(), (text + "\n").as_bytes());
    }};
}
pub(crate) use {say, tell};

mod admin;
mod bridge;
mod cluster;
mod credentials;
mod devices;
mod foxglove;
mod health;
mod link;
mod load;
mod placement;
mod play;
mod prediction;
mod proxy;
mod replay;
mod simulated;
mod table;
mod top;
mod unanswered;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use palpate_client::Error;
use palpate_refusal::{Reason, Refusal};

/// Programs that talk to a Palpate server.
#[derive(Parser)]
#[command(version, about, max_term_width = 100)]
struct ClientArguments {
    #[command(subcommand)]
    command: ClientCommand,
}

#[derive(Subcommand)]
enum ClientCommand {
    /// Play a script through a server in real time; write the records that it streams as JSON Lines
    #[command(after_help = "Examples:\n  \
        palpate-client replay vertical-60 --server http://127.0.0.1:7117\n  \
        palpate-client replay my-script.toml --scene my-scene.toml --output poke.jsonl --plot\n\n\
        The session is created paused. Each command contains the step at which it takes effect, and is sent ahead of \
        time. So the final hash equals that of `palpate run --held` over any network, unless late commands are \
        reported.\n\n\
        Exit status: 0; 1 when the replay failed; 2 when an input was refused.")]
    Replay(replay::ReplayArguments),
    /// Send a journal or a snapshot to a server, and play it there for viewers, or continue live from one of its
    /// moments
    #[command(after_help = "Examples:\n  \
        palpate-client play 3f0c….1.mcap --speed 2\n  \
        palpate-client play training.mcap --live --from 12000\n\n\
        Viewers see the session like any other; its ID is printed at the beginning. Nobody can hold a tool of a \
        session that plays. Anybody may touch a live session, and it stays after the end. The program compares each \
        hash of the journal with the session's. `palpate journal replay` without a server writes records as fast as \
        possible.\n\n\
        Exit status: 0; 1 when a hash differs, the connection broke or the session was held; 2 when an input was \
        refused.")]
    Play(play::PlayArguments),
    /// Simulate hand, device, network and tissue in one loop in virtual time; report how accurate and safe the touch
    /// is
    #[command(after_help = "Examples:\n  \
        palpate-client link --scene fibrotic --hand medium --device omega3 --rtt-ms 50\n  \
        palpate-client link --scene liver --profile wan --scheme hold --seed 7 --json\n  \
        palpate-client link --rtt-ms 2 --deadband 0.1\n  \
        palpate-client link --boundary\n  \
        palpate-client link --random 1000\n\n\
        A simulated hand presses and strokes the tissue (minimum jerk, 5 to 15 mm, drawn by the seed; less deep if \
        the true force would exceed 0.8 of the device's). `true` is the same tissue without a delay at the tool's \
        own place. Errors are computed over the ticks in which either is in contact. Energies are measured at the \
        device's port: below 0 the port has given off energy. A run is unstable, and ends, when the port has given \
        off 0.1 J or the tool is farther away than three times the task's amplitude. The loop runs the same code as \
        the server and `bridge`.\n\n\
        With `prediction` the client's copy is that same tissue, so its error is small if nothing else acts and \
        nothing is lost. Use loss, jitter, a second tool, a change of the tissue or --server to measure a realistic \
        error.\n\n\
        Exit status: 0; 1 when a run failed; 2 when an input was refused, or the system has no memory for the sheet.")]
    Link(Box<link::LinkArguments>),
    /// Connect a haptic device to a server at 1 kHz: one of your own, or a simulated one in a simulated hand
    #[command(after_help = "Examples:\n  \
        palpate-client bridge --server http://127.0.0.1:7117 --scene liver --seconds 10\n  \
        palpate-client bridge --scene fibrotic --device touch --deadband 0.1\n  \
        palpate-client bridge --device force-dimension --scale 0.5 --rotation-deg 0,0,90\n  \
        palpate-client bridge --device gamepad --placement my-desk.toml\n\n\
        A name may select one of several: force-dimension:1, openhaptics:'Left Device', haply:ws://localhost:10001, \
        gamepad:/dev/input/event5. It reconnects by itself when the connection breaks; forces return when the \
        operator presses the device's first button. It deletes the session that it made when it ends. For another \
        device, implement `HapticDevice` of the crate palpate-client (clients/library).\n\n\
        Exit status: 0; 1 when the device is missing or fails, or when there was no connection at all or at the end; \
        2 when an input was refused.")]
    Bridge(Box<bridge::BridgeArguments>),
    /// List haptic devices; read one for some seconds, and report how well it keeps time
    #[command(after_help = "Examples:\n  \
        palpate-client devices\n  \
        palpate-client devices --test force-dimension\n  \
        palpate-client devices --test haply --seconds 20 --json\n\n\
        The test sets no force. Move the device while it runs: the number of changed positions shows how often the \
        device itself measures.\n\n\
        Exit status: 0; 1 when the device to test is missing or fails; 2 when an input was refused.")]
    Devices(devices::DevicesArguments),
    /// Show a session live in Foxglove: its moving surface, its tools and the forces on them, energies
    #[command(after_help = "Examples:\n  \
        palpate-client foxglove 0123456789abcdef0123456789abcdef\n  \
        palpate-client foxglove SESSION --server https://server:7117 --token-file watch.token --listen 127.0.0.1:0\n\n\
        Watches the session like any viewer, with your credentials, and serves the topics of an exported journal by \
        WebSocket: /surface (foxglove.PointCloud, frame `tissue`), /tool/N and /tissue. In Foxglove, choose `Open \
        connection`, `Foxglove WebSocket`. Foxglove can't change the session. The WebSocket has no authentication of \
        its own. Needs a program built with the feature `foxglove`.\n\n\
        Exit status: 0; 1 when it can't listen, or when the session has ended or can't be reached; 2 when an input \
        was refused.")]
    Foxglove(foxglove::FoxgloveArguments),
    /// Simulate a bad network on this machine: relay TCP and UDP to a server with delay, jitter, loss and outages
    #[command(after_help = "Examples:\n  \
        palpate-client proxy 127.0.0.1:7200 127.0.0.1:7117 --delay-ms 25 --loss 0.01\n  \
        palpate-client proxy 127.0.0.1:7200 127.0.0.1:7117 --udp --jitter-ms 10 --seed 7\n\n\
        Start the server with --datagrams-advertise 127.0.0.1:7200, so that clients send their datagrams through the \
        proxy as well. Lost TCP packets are sent again by the rule of RFC 6298, which delays everything after them. \
        Ctrl-C ends the proxy, which then prints the amounts of data.\n\n\
        Exit status: 0; 1 when it can't listen; 2 when an input was refused.")]
    Proxy(proxy::ProxyArguments),
    /// Load a server with many sessions, haptic clients and viewers; report delays, losses and dilation
    #[command(after_help = "Examples:\n  \
        palpate-client load --sessions 50 --seconds 10\n  \
        palpate-client load --sessions 20 --clients-per-session 2 --viewers 3 --scene liver --json\n  \
        palpate-client load --find-limit 'p99<2ms,dilation>0.999'\n\n\
        Each client strokes the tissue with a command at every tick of its own clock, without waiting for answers: \
        no tissue rests, and a late answer delays no later command. The round trip lasts from a command to the first \
        sample that acknowledges it, and includes the wait for the step. A command without an acknowledgement until \
        2 s after the end counts as lost, and so does a sample that the server dropped. The age of a frame is \
        measured against the sample of the same step. On the server's machine the generator takes processor time \
        from the server; the report states how much.\n\n\
        Exit status: 0; 1 when streams broke or the server could not be reached; 2 when an input was refused.")]
    Load(load::LoadArguments),
    /// Check that a server is serving; for scripts and containers
    #[command(after_help = "Examples:\n  \
        palpate-client health\n  \
        palpate-client health --server https://localhost:7117 --ca /etc/palpate/ca.pem\n\n\
        Needs no token. Exit status: 0 if the server is serving; 1 if not; 2 when an input was refused.")]
    Health(health::HealthArguments),
    /// Show the sessions of a server once a second: state, step rate, dilation, awake points, holders of tools
    #[command(after_help = "Examples:\n  \
        palpate-client top\n  \
        palpate-client top --server https://server:7117 --token-file admin.token\n  \
        palpate-client top --once --json | jq '.sessions[] | select(.time_dilation < 0.999)'\n\n\
        If the server authenticates clients, your token needs the role `administer`.\n\n\
        Exit status: 0; 1 when the server can't be reached or refuses; 2 when an input was refused.")]
    Top(top::TopArguments),
    /// Show the resources that each caller uses; release a tool, cut a stream or a caller, revive or delete a session
    #[command(after_help = "Examples:\n  \
        palpate-client admin callers\n  \
        palpate-client admin streams 0123456789abcdef0123456789abcdef\n  \
        palpate-client admin cut-caller token:ann --delete-sessions --server https://server:7117 --token-file \
        admin.token\n\n\
        If the server authenticates clients, your token needs the role `administer`. The name of a caller is that of \
        its token or certificate; without authentication it is its address. A caller that you cut can come back: \
        remove its entry from the token file first.\n\n\
        Exit status: 0; 1 when the server can't be reached or refuses; 2 when an input was refused.")]
    Admin(admin::AdminArguments),
    /// Show the servers and sessions of a fleet; move sessions between servers, and drain a server for an upgrade
    #[command(after_help = "Examples:\n  \
        palpate-client cluster nodes\n  \
        palpate-client cluster sessions --json | jq '.[] | select(.standby == \"\")'\n  \
        palpate-client cluster move 0123456789abcdef0123456789abcdef node-b\n  \
        palpate-client cluster drain node-a --server https://node-b:7117 --token-file admin.token\n  \
        palpate-client cluster drain node-a --stop\n\n\
        Ask any server of the fleet; a call for another server goes there with the same credentials. If the servers \
        authenticate clients, your token needs the role `administer`. A moved session continues at once, and its \
        clients follow by themselves. A drained server accepts no new sessions until you use --stop, or start it \
        again.\n\n\
        Exit status: 0; 1 when a server can't be reached or refuses, or when sessions could not be moved; 2 when an \
        input was refused.")]
    Cluster(cluster::ClusterArguments),
}

/// Reason why a program ends early.
pub(crate) enum ClientFailure {
    /// Exit status 1.
    Failed(String),
    /// Exit status 2.
    Refused(String),
    /// The reader of our output closed the pipe: exit status 0.
    Unread,
}

impl From<Error> for ClientFailure {
    fn from(error: Error) -> Self {
        if error.is_refusal() {
            ClientFailure::Refused(error.to_string())
        } else {
            ClientFailure::Failed(error.to_string())
        }
    }
}

impl From<Refusal> for ClientFailure {
    fn from(refusal: Refusal) -> Self {
        ClientFailure::Refused(refusal.to_string())
    }
}

/// Prints a warning.
pub(crate) fn warn(message: &str) {
    say!("palpate-client: warning: {message}");
}

/// Parses an option's number within a range.
pub(crate) fn within(text: &str, range: std::ops::RangeInclusive<f64>) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| "is not a number".to_owned())?;
    let wrong = || format!("must be from {} to {}", range.start(), range.end());
    if range.contains(&value) { Ok(value) } else { Err(wrong()) }
}

/// Completes at Ctrl-C.
pub(crate) async fn interrupted() {
    let _ = tokio::signal::ctrl_c().await;
}

// Two threads for the network; a device runs on its own thread.
#[tokio::main(worker_threads = 2)]
async fn main() -> ExitCode {
    let ended = match palpate_arguments::parse::<ClientArguments>().command {
        ClientCommand::Replay(arguments) => replay::replay(&arguments).await,
        ClientCommand::Play(arguments) => play::play(&arguments).await,
        ClientCommand::Link(arguments) => link::link(&arguments).await,
        ClientCommand::Bridge(arguments) => bridge::bridge(&arguments).await,
        ClientCommand::Devices(arguments) => devices::devices(&arguments).await,
        ClientCommand::Foxglove(arguments) => foxglove::foxglove(&arguments).await,
        ClientCommand::Proxy(arguments) => proxy::proxy(&arguments).await,
        ClientCommand::Load(arguments) => load::load(&arguments).await,
        ClientCommand::Health(arguments) => health::health(&arguments).await,
        ClientCommand::Top(arguments) => top::top(&arguments).await,
        ClientCommand::Admin(arguments) => admin::admin(&arguments).await,
        ClientCommand::Cluster(arguments) => cluster::cluster(&arguments).await,
    };
    let (status, message) = match ended {
        Ok(()) | Err(ClientFailure::Unread) => return ExitCode::SUCCESS,
        Err(ClientFailure::Failed(message)) => (1, message),
        Err(ClientFailure::Refused(message)) => (2, message),
    };
    crate::say!("palpate-client: {message}");
    if message.contains(Reason::Unauthenticated.as_str()) {
        crate::say!(
            "palpate-client: give your token by --token-file FILE, or set the environment variable PALPATE_TOKEN to it"
        );
    }
    ExitCode::from(status)
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    #[test]
    fn the_arguments_of_all_subcommands_are_sound() {
        super::ClientArguments::command().debug_assert();
    }

    #[test]
    fn help_fits_into_a_terminal_of_any_width() {
        for width in [40, 80, 100, 160] {
            for subcommand in super::ClientArguments::command().get_subcommands() {
                let help = subcommand.clone().term_width(width).render_long_help().to_string();
                for line in help.lines() {
                    // Single words and the names of options can't be broken.
                    let is_one = !line.trim().contains(' ') || line.trim().starts_with('-');
                    let fits = line.chars().count() <= width || is_one;
                    assert!(fits, "{} at {width} columns: {line}", subcommand.get_name());
                }
            }
        }
    }

    #[test]
    fn paragraphs_of_help_are_wrapped_by_the_terminal_alone() {
        for subcommand in super::ClientArguments::command().get_subcommands() {
            let text = subcommand.get_after_help().map(ToString::to_string).unwrap_or_default();
            let lines: Vec<&str> = text.lines().collect();
            for pair in lines.windows(2) {
                let is_text = |line: &str| !line.is_empty() && !line.starts_with(' ');
                assert!(!(is_text(pair[0]) && is_text(pair[1])), "{}: {pair:?}", subcommand.get_name());
            }
        }
    }
}
