//! `palpate-client`: programs that talk to a Palpate server.

// Clients live in real time; the rule is for what a server computes.
#![allow(clippy::disallowed_methods)]

mod plot;
mod replay;

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

#[tokio::main(flavor = "current_thread")]
async fn main() -> ExitCode {
    let ended = match Arguments::parse().command {
        Command::Replay(arguments) => replay::replay(&arguments).await,
    };
    let (status, message) = match ended {
        Ok(()) | Err(Failure::Unread) => return ExitCode::SUCCESS,
        Err(Failure::Failed(message)) => (1, message),
        Err(Failure::Refused(message)) => (2, message),
    };
    eprintln!("palpate-client: {message}");
    ExitCode::from(status)
}
