//! `palpate-client load`: loads a server with sessions, clients and viewers, and measures how it copes.

mod client;
mod course;
mod objective;
mod plan;
mod report;
mod stroke;
mod swarm;
mod tally;
mod tip;

use std::io::IsTerminal;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use palpate_client::Server;
use palpate_proto::pb::create_session_request::Source;
use palpate_touch::Device;
use tokio::sync::watch;

use crate::Failure;
use crate::credentials::CredentialOptions;
use crate::scene_file::SceneFile;
use crate::within;
use client::{Common, Stage, lock};
use objective::Objective;
use swarm::{Orders, Stopped, Swarm};
use tally::{Outcome, Tally};
use tip::{DEVICE, Deadbands, Lead};

#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The server
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7117")]
    server: String,
    /// Number of sessions; with --find-limit, where the search begins
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..))]
    sessions: u32,
    /// Haptic clients of each session, with one tool each. With 0, commands sent beforehand keep each session awake
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
    /// Clients lead tools with a tip and render forces, as devices do, in place of pushing. Of a round trip, the wait for the step
    /// of the sample does not count: that is what a deadband is for. Sheets only, such as --scene liver
    #[arg(long)]
    touch: bool,
    /// With --touch: clients get a sample only when the rendered force would be off by more than this fraction
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0, requires = "touch", value_parser = fraction)]
    deadband: f64,
    /// With --touch: clients send a pose only when the server would be wrong about the tool by more than this fraction of the force
    #[arg(long, value_name = "FRACTION", default_value_t = 0.0, requires = "touch", value_parser = fraction)]
    up_deadband: f64,
    /// Clients that share a connection. With 1 each client has its own, like clients on separate machines
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    clients_per_connection: u32,
    /// Threads of this generator
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=64))]
    threads: u32,
    /// Find the largest number of sessions that meets this objective in two of three trials: bounds on p50, p99, p999,
    /// max (round trip), gap_p99, gap_max, frame_age_p99, dilation, lost and rejected, such as 'p99<2ms,dilation>0.999'
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

/// Clients send at this many moments of a period: not all at once, and without a wake-up for each.
const PHASES: usize = 4;

/// Between the last client's start and the beginning of the measurement.
const SETTLE: Duration = Duration::from_millis(500);

/// The search ends when the bracket is narrower than this fraction of the limit (1/40).
const RESOLUTION: usize = 40;

/// Number of trials that must agree: two of three, because one stall of the machine can spoil a trial, and one lucky trial
/// proves nothing.
const AGREE: usize = 2;

/// The largest number that is tried.
const MOST_SESSIONS: usize = 1 << 16;

pub(crate) async fn load(arguments: &Arguments) -> Result<(), Failure> {
    if let Some(path) = &arguments.plan {
        return course::load(path, arguments).await;
    }
    let server = arguments.credentials.server(&arguments.server)?;
    let file = SceneFile::read(&arguments.scene)?;
    let source = file.source(server.connect().await.map_err(Failure::from)?).await?;
    let sessions = arguments.sessions as usize;
    let ended = async {
        match &arguments.find_limit {
            None => trial(arguments, &server, &source, sessions).await.map(|outcome| (outcome, None)),
            Some(objective) => find_limit(arguments, &server, &source, sessions, objective)
                .await
                .map(|(outcome, limit)| (outcome, Some(limit))),
        }
    };
    let (outcome, limit) = ended.await.map_err(|stopped| match stopped.is_refusal {
        true => Failure::Refused(stopped.message),
        false => Failure::Failed(stopped.message),
    })?;
    if arguments.json {
        crate::tell!("{}", outcome.json(limit));
    } else {
        print!("{}", outcome.table(limit));
    }
    if limit.is_none() && outcome.samples == 0 && arguments.clients_per_session > 0 && arguments.seconds > 0.0 {
        return Err(Failure::Failed("no sample arrived".to_owned()));
    }
    if limit.is_none() && outcome.broken > 0 {
        return Err(Failure::Failed(format!("{} streams broke", outcome.broken)));
    }
    Ok(())
}

/// Repeats a trial until `AGREE` of them agree on whether the objective is met. Returns that, and the outcome of the last of
/// them, if it had one.
async fn agreed<E>(
    mut trial: impl AsyncFnMut() -> Result<(Option<Outcome>, bool), E>,
) -> Result<(Option<Outcome>, bool), E> {
    let mut counts = [0; 2];
    loop {
        let (outcome, keeps) = trial().await?;
        counts[usize::from(keeps)] += 1;
        if counts[usize::from(keeps)] == AGREE {
            return Ok((outcome, keeps));
        }
    }
}

/// The largest number of sessions that meets the objective, and its outcome: doubled until it fails, then bisected.
async fn find_limit(
    arguments: &Arguments,
    server: &Server,
    source: &Source,
    first: usize,
    objective: &Objective,
) -> Result<(Outcome, usize), Stopped> {
    // 0 sessions meet every objective.
    let (mut best, mut low, mut high) = (None, 0, None);
    let mut next = first;
    loop {
        let found = agreed(async || {
            let (outcome, why) = match trial(arguments, server, source, next).await {
                Ok(outcome) => {
                    let mut missed = objective.missed(&outcome).join(", ");
                    if outcome.broken > 0 {
                        missed = format!("{} streams broke", outcome.broken);
                    }
                    (Some(outcome), missed)
                }
                Err(stopped) if stopped.is_refusal || low == 0 && next == 1 => return Err(stopped),
                Err(stopped) => (None, stopped.message),
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
            None if low >= MOST_SESSIONS => break,
            None => 2 * low,
            Some(high) if high - low <= (low / RESOLUTION).max(1) => break,
            Some(high) => usize::midpoint(low, high),
        };
    }
    let none = || Stopped { message: "the server gave not one session".to_owned(), is_refusal: false };
    best.map(|outcome| (outcome, low)).ok_or_else(none)
}

/// Creates `sessions` on the server, measures, and deletes them again.
async fn trial(arguments: &Arguments, server: &Server, source: &Source, sessions: usize) -> Result<Outcome, Stopped> {
    let stage = Arc::new(Stage::new());
    let clock = Instant::now();
    let threads = (arguments.threads as usize).min(sessions);
    let (senders, phases): (Vec<_>, Vec<_>) = (0..PHASES).map(|_| watch::channel(0)).unzip();
    let (over, is_over) = watch::channel(());
    let ticker = std::thread::spawn({
        let rate_hz = arguments.rate_hz;
        move || tick(&senders, rate_hz, &is_over)
    });
    // Each thread reports once when its clients are connected; we tell them when the measurement begins and ends.
    let (ready, mut gathered) = tokio::sync::mpsc::channel::<()>(threads);
    let (telling, told) = watch::channel(Stage::RAMP);
    let mut tallies = Vec::new();
    let mut workers = Vec::new();
    for index in 0..threads {
        let tally = Arc::new(Mutex::new(Tally::new()));
        tallies.push(tally.clone());
        let numbers: Vec<usize> = (index..sessions).step_by(threads).collect();
        let orders = Orders {
            server: server.clone(),
            source: source.clone(),
            pause: Duration::from_secs_f64(arguments.ramp_s / numbers.len() as f64),
            sessions: numbers,
            clients_per_session: arguments.clients_per_session,
            viewers_per_session: arguments.viewers,
            clients_per_connection: arguments.clients_per_connection as usize,
            frame_rate_hz: arguments.frame_rate_hz,
            lasts_s: (arguments.ramp_s + arguments.seconds + 30.0).min(600.0),
        };
        let deadbands = Deadbands { down: arguments.deadband, up: arguments.up_deadband };
        let device = Device::named(DEVICE).filter(|_| arguments.touch);
        let touches = device.map(|device| Lead { deadbands, device, hand: None });
        let common = Common { clock, stage: stage.clone(), tally, rate_hz: arguments.rate_hz, touches };
        let (phases, ready, told) = (phases.clone(), ready.clone(), told.clone());
        workers.push(std::thread::spawn(move || work(&orders, &common, &phases, &ready, told)));
    }
    drop((ready, phases));

    let streams = sessions as u64 * u64::from(arguments.clients_per_session + arguments.viewers);
    let mut progress = Progress::new(arguments, sessions, clock);
    let cpu_s = async {
        for _ in 0..threads {
            // A thread that failed closes its end of the channel; the trial is then called off.
            gathered.recv().await?;
        }
        tokio::time::sleep(SETTLE).await;
        let begun_s = cpu_s();
        stage.measure();
        telling.send_replace(Stage::MEASURE);
        let begun = Instant::now();
        let length = Duration::from_secs_f64(arguments.seconds);
        while begun.elapsed() < length {
            tokio::time::sleep((length - begun.elapsed()).min(Duration::from_secs(1))).await;
            progress.tell(&tallies);
            // No stream is left to measure.
            let broken: u64 = tallies.iter().map(|tally| lock(tally).broken).sum();
            if broken > 0 && broken >= streams {
                break;
            }
        }
        let cores = (cpu_s()? - begun_s?) / begun.elapsed().as_secs_f64();
        Some(cores)
    };
    let cores = tokio::select! {
        cores = cpu_s => cores,
        _ = tokio::signal::ctrl_c() => {
            crate::say!("palpate-client: interrupted: deleting the sessions");
            None
        }
    };
    #[allow(clippy::cast_possible_truncation)]
    stage.drain(clock.elapsed().as_nanos() as u64);
    telling.send_replace(Stage::DRAIN);
    let ended = tokio::task::spawn_blocking(move || {
        let ended: Vec<_> = workers.into_iter().map(std::thread::JoinHandle::join).collect();
        drop(over);
        let _ = ticker.join();
        ended
    });
    for ended in ended.await.unwrap_or_default() {
        let failed = |_| Stopped { message: "a thread of the generator failed".to_owned(), is_refusal: false };
        ended.map_err(failed)??;
    }
    progress.end();
    let mut all = Tally::new();
    for tally in &tallies {
        all.add(&lock(tally));
    }
    if let Some(why) = &all.first_break {
        crate::say!("palpate-client: warning: {} streams broke, the first because {why}", all.broken);
    }
    if all.unsent > all.commands / 100 {
        let share = 100.0 * all.unsent as f64 / (all.unsent + all.commands) as f64;
        crate::say!("palpate-client: warning: this generator was too slow for {share:.0} % of its commands");
    }
    Ok(Outcome { generator_cores: cores.unwrap_or(f64::NAN), ..all.outcome(sessions) })
}

/// The work of one thread.
fn work(
    orders: &Orders,
    common: &Common,
    phases: &[watch::Receiver<u64>],
    ready: &tokio::sync::mpsc::Sender<()>,
    mut told: watch::Receiver<u8>,
) -> Result<(), Stopped> {
    let failed = |e: std::io::Error| Stopped { message: format!("can't start a thread: {e}"), is_refusal: false };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(failed)?;
    runtime.block_on(async {
        let mut swarm = Swarm::new(&orders.server, common).await?;
        let mut over = told.clone();
        let gathered = tokio::select! {
            gathered = swarm.gather(orders, phases) => gathered,
            // Called off.
            _ = over.wait_for(|stage| *stage == Stage::DRAIN) => Ok(()),
        };
        if gathered.is_ok() {
            let _ = ready.send(()).await;
            let _ = told.wait_for(|stage| *stage != Stage::RAMP).await;
            swarm.look(orders).await;
            let _ = told.wait_for(|stage| *stage == Stage::DRAIN).await;
            swarm.look(orders).await;
            swarm.drain().await;
        }
        swarm.disperse().await;
        gathered
    })
}

/// Tells each phase in turn that its clients are to send: by the clock, independent of the answers.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn tick(phases: &[watch::Sender<u64>], rate_hz: f64, over: &watch::Receiver<()>) {
    let (begun, apart_s) = (Instant::now(), 1.0 / (rate_hz * phases.len() as f64));
    let mut tick: u64 = 0;
    while over.has_changed().is_ok() {
        let due = Duration::from_secs_f64(tick as f64 * apart_s);
        if let Some(rest) = due.checked_sub(begun.elapsed()) {
            std::thread::sleep(rest.min(Duration::from_secs(1)));
            if begun.elapsed() < due {
                continue;
            }
        }
        // Ticks that are overdue by more than a turn are skipped, not caught up; clients count them.
        let count = phases.len() as u64;
        let behind = ((begun.elapsed().as_secs_f64() / apart_s) as u64).saturating_sub(tick) / count * count;
        tick += behind;
        phases[(tick % count) as usize].send_replace(tick / count + 1);
        tick += 1;
    }
}

/// Processor time of this process, s; `None` without a /proc.
fn cpu_s() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    let ticks = stat[stat.rfind(')')? + 2..].split_whitespace().skip(11).take(2);
    // Linux counts ticks of 10 ms here.
    ticks.map(|field| field.parse::<f64>().ok()).sum::<Option<f64>>().map(|ticks| ticks / 100.0)
}

/// Prints the progress of a trial.
struct Progress {
    quiet: bool,
    sessions: usize,
    clock: Instant,
    /// Number of samples at the last report, and its time.
    last: (u64, Instant),
}

impl Progress {
    fn new(arguments: &Arguments, sessions: usize, clock: Instant) -> Self {
        Progress { quiet: arguments.quiet, sessions, clock, last: (0, clock) }
    }

    fn tell(&mut self, tallies: &[Arc<Mutex<Tally>>]) {
        if self.quiet {
            return;
        }
        let (mut samples, mut rejected, mut p99_ns) = (0, 0, 0);
        for tally in tallies {
            let tally = lock(tally);
            samples += tally.samples;
            rejected += tally.rejected.values().sum::<u64>();
            p99_ns = p99_ns.max(tally.round_trip_ns.value_at_quantile(0.99));
        }
        let elapsed_s = self.last.1.elapsed().as_secs_f64();
        let text = format!(
            "{:.0} s  {} sessions  {:.0} samples/s  round trip p99 {:.2} ms  rejected {rejected}",
            self.clock.elapsed().as_secs_f64(),
            self.sessions,
            (samples - self.last.0) as f64 / elapsed_s,
            p99_ns as f64 / 1e6,
        );
        self.last = (samples, Instant::now());
        if std::io::stderr().is_terminal() {
            eprint!("\r\x1b[K{text}");
        } else {
            crate::say!("{text}");
        }
    }

    fn end(&self) {
        if !self.quiet && std::io::stderr().is_terminal() {
            eprint!("\r\x1b[K");
        }
    }
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
                Ok::<_, Stopped>((Some(Tally::new().outcome(done)), trials[done - 1]))
            });
            let Ok((outcome, found)) = found.await else { unreachable!() };
            assert_eq!((found, outcome.unwrap().sessions), (keeps, needed), "{trials:?}");
        }
    }
}
