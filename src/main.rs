//! The program `palpate`: parses arguments and calls one function.

use std::io::{BufWriter, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

use clap::{Parser, Subcommand};
use palpate::limits::Limits;
use palpate::refusal::Refusal;
use palpate::scene::{self, Scene, script::Script};
use palpate::session::run;
use palpate::sheet::Model;

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
        palpate run scenes/paper.toml scripts/vertical-60.toml\n  \
        palpate run paper scripts/oblique-100.toml --output poke.jsonl --set stepping.integrator=lagged\n\n\
        Exit status: 0; 1 when the run failed; 2 when an input was refused.")]
    Run(RunArguments),
}

#[derive(clap::Args)]
struct RunArguments {
    /// The scene file, or the name of a built-in scene (`paper`)
    scene: PathBuf,
    /// The script file
    script: PathBuf,
    /// Write the records here instead of to the standard output
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Set a key of the scene: a TOML value, or a bare string; may be repeated
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
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
    };
    let (status, message) = match ended {
        Ok(()) => return ExitCode::SUCCESS,
        Err(Failure::Failed(message)) => (1, message),
        Err(Failure::Refused(message)) => (2, message),
    };
    eprintln!("palpate: {message}");
    ExitCode::from(status)
}

fn run_script(arguments: &RunArguments) -> Result<(), Failure> {
    let limits = Limits::default();
    let scene = if arguments.scene.as_os_str() == "paper" && !arguments.scene.exists() {
        Scene::parse("paper (built in)", scene::PAPER, &arguments.set, &limits)?
    } else {
        Scene::load(&arguments.scene, &arguments.set, &limits)?
    };
    let model = Model::compile(&scene, &limits)?;
    let script = Script::load(&arguments.script, &scene, &limits)?;
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
    let start = Instant::now();
    let clock_s = || start.elapsed().as_secs_f64();
    let ended = run::run(&model, &script, arguments.held, &limits, &mut output, &clock_s, &mut |_| {});
    output.flush().map_err(|e| Failure::Failed(format!("can't write the output: {e}")))?;
    ended.map(|_| ()).map_err(|failure| Failure::Failed(failure.to_string()))
}
