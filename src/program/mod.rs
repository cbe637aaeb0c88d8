//! The program `palpate`: one file for each subcommand, and shared functions.

pub(crate) mod certificate;
pub(crate) mod check;
pub(crate) mod client;
pub(crate) mod fit;
pub(crate) mod indent;
pub(crate) mod journal;
mod log;
mod markup;
pub(crate) mod mesh;
pub(crate) mod organ;
pub(crate) mod render;
pub(crate) mod run;
mod scene;
mod score;
pub(crate) mod serve;
#[cfg(windows)]
pub(crate) mod service;
pub(crate) mod texture;
pub(crate) mod token;

use std::io::IsTerminal;
use std::path::Path;

use palpate::server::ServeError;
use palpate::server::config::Config;
use palpate_realtime::clock::now_ns;
use palpate_refusal::Refusal;
use palpate_session::simulation::SimulationFailure;

/// Writes a line to the standard error, with names and messages of others made printable. A closed standard error
/// does not end the program.
macro_rules! say {
    ($($text:tt)*) => {{
        let text = palpate_refusal::printable::printable(format_args!($($text)*));
        let _ = std::io::Write::write_all(&mut std::io::stderr(), (text + "\n").as_bytes());
    }};
}
pub(crate) use say;

/// Reason why the program ends early.
pub(crate) enum Failure {
    /// Exit status 1.
    Failed(String),
    /// Exit status 2.
    Refused(String),
    /// A program that was run in its place ended with this exit status, and has reported the reason.
    Told(u8),
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

impl From<SimulationFailure> for Failure {
    fn from(failure: SimulationFailure) -> Self {
        match failure {
            SimulationFailure::Refused(refusal) => refusal.into(),
            failure => Failure::Failed(failure.to_string()),
        }
    }
}

/// Runs work that may need more memory than is available.
pub(crate) fn within_memory(work: impl FnOnce() -> Result<(), Failure>) -> Result<(), Failure> {
    palpate_tissue::memory::attempt("", || Ok(work()))?
}

/// Returns the configuration in a file, or the default.
fn load_config(path: Option<&Path>) -> Result<Config, Refusal> {
    path.map_or_else(|| Ok(Config::default()), Config::load)
}

/// Returns the time by the server's clock, s.
#[allow(clippy::cast_precision_loss)]
fn clock_s() -> f64 {
    now_ns() as f64 * 1e-9
}

/// Runs `work` and, unless `quiet`, shows its progress; `work` reports the number of steps done, or of what `unit`
/// names.
fn with_progress<T>(unit: &str, steps: u64, quiet: bool, work: impl FnOnce(&mut dyn FnMut(u64)) -> T) -> T {
    let (begun_s, watched) = (clock_s(), !quiet && std::io::stderr().is_terminal());
    let done = work(&mut |step| {
        // Only on a terminal, and after a second.
        if watched && clock_s() - begun_s > 1.0 {
            eprint!("\r{unit} {step} of {steps} ");
        }
    });
    if watched && clock_s() - begun_s > 1.0 {
        say!("");
    }
    done
}

/// Writes a whole file.
fn write_file(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    std::fs::write(path, bytes).map_err(|e| Failure::Failed(format!("{}: can't be written: {e}", path.display())))
}
