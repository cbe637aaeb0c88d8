//! `palpate-client load`: loads a server with sessions, clients and viewers, and measures how it copes.

use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use palpate_client::{Error, Server};
use palpate_refusal::printable::{printable_json, printable_lines};
use palpate_simulated::load::{Deadbands, LoadOutcome, LoadPlan, LoadTrial, Objective, PreparedPlan, Second};

use crate::credentials::CredentialOptions;
use crate::{ClientFailure, interrupted, within};

#[derive(clap::Args)]
pub(crate) struct LoadArguments {
    /// The server
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7117")]
    server: String,
    /// Number of sessions; with --find-limit, the first number of the search
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    sessions: u32,
    /// Haptic clients of each session, with one tool each. With 0, commands sent in advance keep each session awake
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(0..=64))]
    clients_per_session: u32,
    /// Viewers of each session
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=64))]
    viewers: u32,
    /// Name of a scene of the server, or a scene file of your own (ends in .toml)
    #[arg(long, value_name = "NAME", default_value = "paper")]
    scene: String,
    /// Duration of the measurement, once all clients are connected
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0, value_parser = seconds)]
    seconds: f64,
    /// Time over which sessions and clients start [default: as fast as the server creates them]
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0, value_parser = seconds)]
    ramp_s: f64,
    /// Commands per second of each client
    #[arg(long, value_name = "HZ", default_value_t = 1000.0, value_parser = rate)]
    rate_hz: f64,
    /// Frames per second of each viewer
    #[arg(long, value_name = "HZ", default_value_t = 60.0, value_parser = rate)]
    frame_rate_hz: f64,
    /// Clients move tools with a tip and render forces, like devices, instead of pushing. The round trip then
    /// excludes the wait for the step of the sample, because a deadband delays samples. Sheets only, such as --scene
    /// liver
    #[arg(long)]
    touch: bool,
    /// With --touch: clients get a sample only if the error of the rendered force would exceed this fraction
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0, requires = "touch", value_parser = fraction)]
    deadband: f64,
    /// With --touch: clients send a pose only if the server's prediction would be wrong by more than this fraction of
    /// the force
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0, requires = "touch", value_parser = fraction)]
    up_deadband: f64,
    /// Number of clients per connection. With 1 each client has its own, like clients on separate machines
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    clients_per_connection: u32,
    /// Threads of this generator
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64))]
    threads: u32,
    /// Find the largest number of sessions that meets this objective in two of three trials: bounds on p50, p99,
    /// p999, max (round trip), gap_p99, gap_max, frame_age_p99, dilation, lost and rejected, such as
    /// 'p99<2ms,dilation>0.999'
    #[arg(long, value_name = "OBJECTIVE")]
    find_limit: Option<Objective>,
    /// Load the server by this plan (TOML): phases, arrivals, mixes and objectives, in place of the numbers above
    #[arg(long, value_name = "FILE", conflicts_with_all = ["sessions", "clients_per_session", "viewers", "scene", "seconds",
        "ramp_s", "rate_hz", "frame_rate_hz", "touch", "find_limit", "clients_per_connection", "threads"])]
    plan: Option<PathBuf>,
    /// With --plan: write a page with plots to this file (HTML)
    #[arg(long, value_name = "FILE", requires = "plan")]
    report: Option<PathBuf>,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
    /// No progress
    #[arg(short, long)]
    quiet: bool,
    #[command(flatten)]
    credentials: CredentialOptions,
}

fn seconds(text: &str) -> Result<f64, String> {
    within(text, 0.0..=36_000.0)
}

fn fraction(text: &str) -> Result<f64, String> {
    within(text, 0.0..=1.0)
}

fn rate(text: &str) -> Result<f64, String> {
    within(text, 0.1..=20_000.0)
}

/// The search ends when the bracket is narrower than this fraction of the limit (1/40).
const RESOLUTION: u32 = 40;

/// Number of trials that must agree: two of three, because one stall of the machine can spoil a trial, and one lucky
/// trial proves nothing.
const AGREE: usize = 2;

/// Largest number of sessions that is tried.
const MAX_SESSIONS: u32 = 1 << 16;

pub(crate) async fn load(arguments: &LoadArguments) -> Result<(), ClientFailure> {
    if let Some(path) = &arguments.plan {
        return by_plan(path, arguments).await;
    }
    let server = arguments.credentials.server(&arguments.server)?;
    let (outcome, limit) = match &arguments.find_limit {
        None => (measured(arguments, &server, arguments.sessions).await?, None),
        Some(objective) => {
            let (outcome, limit) = find_limit(arguments, &server, objective).await?;
            (outcome, Some(limit))
        }
    };
    if arguments.json {
        crate::tell!("{}", printable_json(outcome.json(limit)));
    } else {
        print!("{}", printable_lines(outcome.table(limit)));
    }
    if limit.is_none() && outcome.samples == 0 && arguments.clients_per_session > 0 && arguments.seconds > 0.0 {
        return Err(ClientFailure::Failed("no sample arrived".to_owned()));
    }
    if limit.is_none() && outcome.broken > 0 {
        return Err(ClientFailure::Failed(format!("{} streams broke", outcome.broken)));
    }
    Ok(())
}

/// Repeats a trial until `AGREE` of them agree on whether the objective is met. Returns that, and the outcome of the
/// last of them, if it had one.
async fn agreed<T, E>(mut trial: impl AsyncFnMut() -> Result<(T, bool), E>) -> Result<(T, bool), E> {
    let mut counts = [0; 2];
    loop {
        let (outcome, keeps) = trial().await?;
        counts[usize::from(keeps)] += 1;
        if counts[usize::from(keeps)] == AGREE {
            return Ok((outcome, keeps));
        }
    }
}

/// Finds the largest number of sessions that meets the objective, by doubling until it fails and then bisecting.
/// Returns it with its outcome.
async fn find_limit(
    arguments: &LoadArguments,
    server: &Server,
    objective: &Objective,
) -> Result<(LoadOutcome, u32), Error> {
    // A server that can't be reached has no limit.
    server.connect().await?;
    // 0 sessions meet every objective.
    let (mut best, mut low, mut high) = (None, 0, None);
    let mut next = arguments.sessions;
    loop {
        let found = agreed(async || {
            let (outcome, why) = match measured(arguments, server, next).await {
                Ok(outcome) => {
                    let mut missed = objective.missed(&outcome).join(", ");
                    if outcome.broken > 0 {
                        missed = format!("{} streams broke", outcome.broken);
                    }
                    (Some(outcome), missed)
                }
                Err(error) if error.is_refusal() || low == 0 && next == 1 => return Err(error),
                Err(error) => (None, error.to_string()),
            };
            if !arguments.quiet {
                let verdict = if why.is_empty() { "within the objective".to_owned() } else { format!("misses {why}") };
                crate::say!("{next} sessions: {verdict}");
            }
            Ok((outcome, why.is_empty()))
        });
        match found.await? {
            (outcome, true) => (best, low) = (outcome, next),
            (outcome, false) => {
                high = Some(next);
                if best.is_none() && next == 1 {
                    best = outcome;
                }
            }
        }
        next = match high {
            None if low >= MAX_SESSIONS => break,
            None => 2 * low,
            Some(high) if high - low <= (low / RESOLUTION).max(1) => break,
            Some(high) => u32::midpoint(low, high),
        };
    }
    best.map(|outcome| (outcome, low)).ok_or_else(|| Error::Connection("the server gave not one session".to_owned()))
}

/// Completes at Ctrl-C, and prints a message.
async fn called_off() {
    interrupted().await;
    crate::say!("palpate-client: interrupted: deleting the sessions");
}

/// Performs a trial, and prints its progress and warnings.
async fn measured(arguments: &LoadArguments, server: &Server, sessions: u32) -> Result<LoadOutcome, Error> {
    let trial = LoadTrial {
        scene: arguments.scene.clone(),
        clients_per_session: arguments.clients_per_session,
        viewers: arguments.viewers,
        seconds: arguments.seconds,
        ramp_s: arguments.ramp_s,
        rate_hz: arguments.rate_hz,
        frame_rate_hz: arguments.frame_rate_hz,
        touch: arguments.touch.then_some(Deadbands { down: arguments.deadband, up: arguments.up_deadband }),
        clients_per_connection: arguments.clients_per_connection,
        threads: arguments.threads,
    };
    let course = PreparedPlan::new(trial.plan(sessions)).map_err(|refusal| Error::Argument(refusal.to_string()))?;
    // On a terminal, each line takes the place of the one before.
    let (is_shown, is_terminal) = (!arguments.quiet, std::io::stderr().is_terminal());
    let told = |second: &Second| match (is_shown, is_terminal) {
        (false, _) => {}
        (true, true) => eprint!("\r\x1b[K{}", second.trial_line()),
        (true, false) => crate::say!("{}", second.trial_line()),
    };
    let outcome = course.run(server, told, crate::warn, called_off()).await?.outcome();
    if is_shown && is_terminal {
        eprint!("\r\x1b[K");
    }
    if let Some(why) = &outcome.first_break {
        crate::warn(&format!("{} streams broke, the first because {why}", outcome.broken));
    }
    if outcome.unsent > outcome.commands / 100 {
        let share = 100.0 * outcome.unsent as f64 / (outcome.unsent + outcome.commands) as f64;
        crate::warn(&format!("this generator was too slow for {share:.0} % of its commands"));
    }
    Ok(outcome)
}

/// Runs a load test by a plan, and prints and writes the report.
async fn by_plan(path: &Path, arguments: &LoadArguments) -> Result<(), ClientFailure> {
    let course = PreparedPlan::new(LoadPlan::read(path)?)?;
    let server = arguments.credentials.server(&arguments.server)?;
    let told = |second: &Second| {
        if !arguments.quiet {
            crate::say!("{}", second.line());
        }
    };
    let report = course.run(&server, told, crate::warn, called_off()).await?;
    if let Some(file) = &arguments.report {
        let written = std::fs::write(file, report.page());
        written.map_err(|error| ClientFailure::Failed(format!("{}: {error}", file.display())))?;
    }
    if arguments.json {
        crate::tell!("{}", printable_json(report.json()));
    } else {
        print!("{}", printable_lines(report.table()));
    }
    report.verdict().map_or(Ok(()), |why| Err(ClientFailure::Failed(why)))
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_number_keeps_to_the_objective_in_two_of_three_trials() {
        for (trials, keeps, needed) in [
            (&[true, true][..], true, 2),
            (&[false, false], false, 2),
            // One stall of the machine, and one lucky trial.
            (&[false, true, true], true, 3),
            (&[false, true, false], false, 3),
            (&[true, false, false], false, 3),
        ] {
            let mut done = 0;
            let found = agreed(async || {
                done += 1;
                Ok::<_, ()>((done, trials[done - 1]))
            });
            assert_eq!(found.await, Ok((needed, keeps)), "{trials:?}");
        }
    }
}
