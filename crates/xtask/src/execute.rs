//! Runs the stages of a plan, one after the other, and prints each command before it runs.

use std::path::PathBuf;
use std::process::Command;

use crate::plan::{Stage, Step};
use crate::serving;

/// Reason why a task ends early.
#[derive(Debug)]
pub(crate) enum Failure {
    /// A command failed.
    Failed(String),
    /// A program is missing.
    Missing(String),
}

impl Failure {
    /// Returns the failure of a task that needs `what`, and the remedy.
    pub(crate) fn missing(what: &str, remedy: &str) -> Self {
        Failure::Missing(format!("{what} is missing: {remedy}"))
    }

    /// Returns the exit status.
    pub(crate) fn status(&self) -> u8 {
        match self {
            Failure::Failed(_) => 1,
            Failure::Missing(_) => 3,
        }
    }
}

impl std::fmt::Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (Failure::Failed(message) | Failure::Missing(message)) = self;
        f.write_str(message)
    }
}

/// Runs the stages.
///
/// # Errors
/// Returns the first failure; the stages after it do not run.
pub(crate) fn execute(stages: &[Stage]) -> Result<(), Failure> {
    for stage in stages {
        match stage {
            Stage::Step(step) => run(step)?,
            Stage::Beside { step, others, without } => {
                let others = others.clone();
                let beside = std::thread::spawn(move || others.iter().try_for_each(run));
                let ended = run(step);
                if let Err(failure) =
                    beside.join().map_err(|_| Failure::Failed("a thread has failed".to_owned())).flatten()
                {
                    eprintln!("{failure}");
                    eprintln!("{without}");
                }
                ended?;
            }
            Stage::Mark(file) => {
                std::fs::write(file, "").map_err(|error| Failure::Failed(format!("can't write {file}: {error}")))?;
            }
            Stage::Note(text) => eprintln!("{text}"),
            Stage::Serve { server, poke } => serving::serve(server, poke)?,
        }
    }
    Ok(())
}

/// Returns a step as a command of the system.
///
/// # Errors
/// Returns an error if PATH can't be changed as the step asks.
pub(crate) fn command(step: &Step) -> Result<Command, Failure> {
    let here = std::env::current_dir().map_err(|error| Failure::Failed(format!("the current folder: {error}")))?;
    let mut command = Command::new(&step.program);
    command.args(&step.arguments).current_dir(here.join(step.folder));
    if let Some((name, value)) = step.variable {
        command.env(name, value);
    }
    if let Some(folder) = &step.path {
        let before: Vec<PathBuf> = vec![here.join(folder)];
        let others = std::env::var_os("PATH").unwrap_or_default();
        let path = std::env::join_paths(before.into_iter().chain(std::env::split_paths(&others)));
        command.env("PATH", path.map_err(|error| Failure::Failed(format!("PATH: {error}")))?);
    }
    Ok(command)
}

/// Runs a step to its end.
///
/// # Errors
/// Returns an error if it can't be started, or fails.
pub(crate) fn run(step: &Step) -> Result<(), Failure> {
    eprintln!("{step}");
    match command(step)?.status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(Failure::Failed(format!("`{step}` failed ({status})"))),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            Err(Failure::Missing(format!("`{}` is missing, for `{step}`", step.program)))
        }
        Err(error) => Err(Failure::Failed(format!("`{step}` did not start: {error}"))),
    }
}
