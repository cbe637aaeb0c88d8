//! `palpate-client`: programs that talk to a Palpate server.

// Clients live in real time; the rule is for what a server computes.
#![allow(clippy::disallowed_methods)]

/// Tells whoever looks at the standard error; a program goes on though nobody does, and no control character of a server
/// gets into a terminal.
macro_rules! say {
    ($($text:tt)*) => {{
        let text = format!($($text)*).replace(|c: char| c.is_control() && c != '\n', "?");
        let _ = std::io::Write::write_all(&mut std::io::stderr(), (text + "\n").as_bytes());
    }};
}

/// The same of the standard output.
macro_rules! tell {
    ($($text:tt)*) => {{
        let _ = std::io::Write::write_all(&mut std::io::stdout(), (format!($($text)*) + "\n").as_bytes());
    }};
}
pub(crate) use {say, tell};

mod admin;
mod bridge;
mod connect;
mod health;
mod link;
mod load;
mod plot;
mod replay;
mod top;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Programs that talk to a Palpate server.
#[derive(Parser)]
#[command(version, about, max_term_width = 100)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Play a script through a server, in real time; write the records it streams as JSON Lines
    #[command(after_help = "Examples:\n  \
        palpate-client replay vertical-60 --server http://127.0.0.1:7117\n  \
        palpate-client replay my-script.toml --scene my-scene.toml --output poke.jsonl --plot\n\n\
        The session is made paused; each command is stamped with the step at which it acts and sent ahead. So the\n\
        final hash is that of `palpate run --held`, whatever the network did, unless late commands are reported.\n\n\
        Exit status: 0; 1 when the replay failed; 2 when an input was refused.")]
    Replay(replay::Arguments),
    /// Run hand, device, network and tissue in one loop in virtual time; tell how true and safe the touch is
    #[command(after_help = "Examples:\n  \
        palpate-client link --scene fibrotic --hand medium --device omega3 --rtt-ms 50\n  \
        palpate-client link --scene liver --profile wan --scheme hold --seed 7 --json\n  \
        palpate-client link --rtt-ms 2 --deadband 0.1\n  \
        palpate-client link --boundary\n  \
        palpate-client link --random 1000\n\n\
        A simulated hand presses and strokes the tissue (minimum jerk, 5 to 15 mm, drawn by the seed, less deep where the\n\
        true force would be above 0.8 of what the device is asked for). `true` is the same tissue without a delay at the\n\
        tool's own place; errors are over the ticks in which either is in contact. Energies are at the device's port:\n\
        below 0 it has given energy. Unstable: it gave 0.1 J, or the tool left three times the task's amplitude; then the\n\
        run ends. The loop runs the code of the server and of `bridge`, not a likeness of it.")]
    Link(Box<link::Arguments>),
    /// Run a haptic device at a server, at 1 kHz; so far a simulated one in a simulated hand
    #[command(after_help = "Examples:\n  \
        palpate-client bridge --server http://127.0.0.1:7117 --scene liver --seconds 10\n  \
        palpate-client bridge --scene fibrotic --device touch --deadband 0.1\n\n\
        Connects again by itself when the connection breaks; forces come back when the owner asks for them. A real device is\n\
        an implementation of `HapticDevice` (clients/src/bridge/device.rs says how).")]
    Bridge(bridge::Arguments),
    /// Put many sessions, haptic clients and viewers on a server at once; tell how it bears them
    #[command(after_help = "Examples:\n  \
        palpate-client load --sessions 50 --seconds 10\n  \
        palpate-client load --sessions 20 --clients-per-session 2 --viewers 3 --scene liver --json\n  \
        palpate-client load --find-limit 'p99<2ms,dilation>0.999'\n\n\
        Each client strokes the tissue by a command every tick of its own clock, whatever comes back: nothing rests, and a\n\
        late answer delays no later command. The round trip is from a command to the first sample that acknowledges it,\n\
        the wait for the step included. Lost: commands of which nothing was heard within 2 s of the end, and samples that\n\
        the server dropped. The age of a frame is against the sample of the same step. The generator shares the machine's\n\
        cores with a server on the same machine: it tells what it took.\n\n\
        Exit status: 0; 1 when streams broke or the server could not be reached; 2 when an input was refused.")]
    Load(load::Arguments),
    /// Ask a server whether it serves; for scripts and containers
    #[command(after_help = "Examples:\n  \
        palpate-client health\n  \
        palpate-client health https://localhost:7117 --ca /etc/palpate/ca.pem\n\n\
        Needs no token. Exit status: 0 if it serves; 1 if not; 2 when an input was refused.")]
    Health(health::Arguments),
    /// Show the sessions of a server, once a second: state, step rate, dilation, awake points, who holds what
    #[command(after_help = "Examples:\n  \
        palpate top\n  \
        palpate top https://server:7117 --token-file admin.token\n  \
        palpate top --once --json | jq '.sessions[] | select(.time_dilation < 0.999)'\n\n\
        Of a server that knows its clients the token needs the role `administer`.\n\n\
        Exit status: 0; 1 when the server can't be reached or does not tell; 2 when an input was refused.")]
    Top(top::Arguments),
    /// Show who has what of a server, and take it from them: free a tool, cut a stream or a caller, revive or delete a session
    #[command(after_help = "Examples:\n  \
        palpate admin callers\n  \
        palpate admin streams 0123456789abcdef0123456789abcdef\n  \
        palpate admin cut-caller token:ann --delete-sessions --server https://server:7117 --token-file admin.token\n\n\
        Of a server that knows its clients the token needs the role `administer`. A caller is known by the name of its token\n\
        or certificate, and where nobody is asked by its address. Who is cut may come back: take its entry from the file\n\
        of tokens first.\n\n\
        Exit status: 0; 1 when the server can't be reached or refuses; 2 when an input was refused.")]
    Admin(admin::Arguments),
}

/// How a program ends that does not end well.
pub(crate) enum Failure {
    /// Exit status 1.
    Failed(String),
    /// Exit status 2.
    Refused(String),
    /// Who reads our output has seen enough: exit status 0.
    Unread,
}

// A device has a thread of its own, beside those of the network.
#[tokio::main(worker_threads = 2)]
async fn main() -> ExitCode {
    let ended = match Arguments::parse().command {
        Command::Replay(arguments) => replay::replay(&arguments).await,
        Command::Link(arguments) => link::link(&arguments).await,
        Command::Bridge(arguments) => bridge::bridge(&arguments).await,
        Command::Load(arguments) => load::load(&arguments).await,
        Command::Health(arguments) => health::health(&arguments).await,
        Command::Top(arguments) => top::top(&arguments).await,
        Command::Admin(arguments) => admin::admin(&arguments).await,
    };
    let (status, message) = match ended {
        Ok(()) | Err(Failure::Unread) => return ExitCode::SUCCESS,
        Err(Failure::Failed(message)) => (1, message),
        Err(Failure::Refused(message)) => (2, message),
    };
    crate::say!("palpate-client: {message}");
    ExitCode::from(status)
}
