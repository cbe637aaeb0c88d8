//! Runs the stages of a plan, one after the other, and prints each command before it runs.

use std::path::PathBuf;
use std::process::Command;

use crate::plan::{PlanStage, Step};
use crate::serving;

/// Reason why a task ends early.
#[derive(Debug)]
pub(crate) enum TaskFailure {
    /// A command failed.
    Failed(String),
    /// A program is missing.
    Missing(String),
}

impl TaskFailure {
    /// Returns the failure of a task that needs `what`, and the remedy.
    pub(crate) fn missing(what: &str, remedy: &str) -> Self {
        TaskFailure::Missing(format!("{what} is missing: {remedy}"))
    }

    /// Returns the exit status.
    pub(crate) fn status(&self) -> u8 {
        match self {
            TaskFailure::Failed(_) => 1,
            TaskFailure::Missing(_) => 3,
        }
    }
}

impl std::fmt::Display for TaskFailure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let (TaskFailure::Failed(message) | TaskFailure::Missing(message)) = self;
        f.write_str(message)
    }
}

/// Runs the stages.
///
/// # Errors
/// Returns the first failure; the stages after it do not run.
pub(crate) fn execute(stages: &[PlanStage]) -> Result<(), TaskFailure> {
    for stage in stages {
        match stage {
            PlanStage::Step(step) => run(step)?,
            PlanStage::Beside { step, others, without } => {
                let (ended, beside) = run_with(step, others);
                match (beside, without) {
                    (Err(failure), Some(without)) => {
                        eprintln!("{failure}\n{without}");
                        ended?;
                    }
                    (beside, _) => ended.and(beside)?,
                }
            }
            PlanStage::Mark(file) => {
                std::fs::write(file, "")
                    .map_err(|error| TaskFailure::Failed(format!("can't write {file}: {error}")))?;
            }
            PlanStage::Note(text) => eprintln!("{text}"),
            PlanStage::Serve { server, poke } => serving::serve(server, poke)?,
        }
    }
    Ok(())
}

/// Runs a step, and others one after another at the same time. Returns the result of the step, and that of the others, of
/// which none runs after one that fails.
fn run_with(step: &Step, others: &[Step]) -> (Result<(), TaskFailure>, Result<(), TaskFailure>) {
    let others = others.to_vec();
    let beside = std::thread::spawn(move || others.iter().try_for_each(run));
    let ended = run(step);
    (ended, beside.join().map_err(|_| TaskFailure::Failed("a thread has failed".to_owned())).flatten())
}

/// Returns a step as a command of the system.
///
/// # Errors
/// Returns an error if PATH can't be changed as the step asks.
pub(crate) fn command(step: &Step) -> Result<Command, TaskFailure> {
    let here = std::env::current_dir().map_err(|error| TaskFailure::Failed(format!("the current folder: {error}")))?;
    let mut command = Command::new(&step.program);
    command.args(&step.arguments).current_dir(here.join(step.folder));
    // `cargo xtask` runs this with Cargo's variables of its own package. They are inputs of build scripts (ring's), so that
    // libraries would be compiled again for every caller that does not have them, such as a test that builds the programs.
    for (key, _) in std::env::vars_os() {
        if is_of_package(&key.to_string_lossy()) {
            command.env_remove(key);
        }
    }
    for (name, value) in &step.variables {
        command.env(name, value);
    }
    if let Some(folder) = &step.path {
        let before: Vec<PathBuf> = vec![here.join(folder)];
        let others = std::env::var_os("PATH").unwrap_or_default();
        let path = std::env::join_paths(before.into_iter().chain(std::env::split_paths(&others)));
        command.env("PATH", path.map_err(|error| TaskFailure::Failed(format!("PATH: {error}")))?);
    }
    Ok(command)
}

/// Returns whether Cargo sets a variable for the program of one package.
fn is_of_package(key: &str) -> bool {
    let starts = ["CARGO_MANIFEST_", "CARGO_PKG_", "CARGO_BIN_"].iter().any(|start| key.starts_with(start));
    starts || key == "CARGO_CRATE_NAME" || key == "CARGO_PRIMARY_PACKAGE"
}

/// Runs a step to its end.
///
/// # Errors
/// Returns an error if it can't be started, or fails.
pub(crate) fn run(step: &Step) -> Result<(), TaskFailure> {
    eprintln!("{step}");
    match command(step)?.status() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(TaskFailure::Failed(format!("`{step}` failed ({status})"))),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            Err(TaskFailure::Missing(format!("`{}` is missing, for `{step}`", step.program)))
        }
        Err(error) => Err(TaskFailure::Failed(format!("`{step}` did not start: {error}"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_has_no_variables_of_the_package_that_runs_it() {
        assert!(std::env::var_os("CARGO_MANIFEST_DIR").is_some(), "cargo sets it for a test");
        let step = Step { program: "cargo".to_owned(), ..Step::default() };
        let command = command(&step).unwrap();
        let removed: Vec<_> = command.get_envs().filter(|(_, value)| value.is_none()).map(|(key, _)| key).collect();
        assert!(
            removed.iter().any(|key| *key == "CARGO_MANIFEST_DIR")
                && removed.iter().any(|key| *key == "CARGO_PKG_NAME")
        );
        assert!(removed.iter().all(|key| *key != "PATH"), "{removed:?}");
    }
}
