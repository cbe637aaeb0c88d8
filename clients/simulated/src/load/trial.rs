//! A trial: so many sessions with clients and viewers for a time, as several threads make them.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use palpate_client::{Error, Server};
use palpate_haptics::Device;
use palpate_proto::pb::create_session_request::Source;
use tokio::sync::watch;

use super::client::{Common, Stage, lock};
use super::swarm::{Orders, Swarm};
use super::tally::{LoadOutcome, Tally};
use super::tip::{DEVICE, Deadbands, Lead};
use super::{PHASES, tick};

/// Between the last client's start and the beginning of the measurement.
const SETTLE: Duration = Duration::from_millis(500);

/// What all sessions of a trial have.
#[derive(Debug, Clone)]
pub struct LoadTrial {
    /// Clients of each session, with one tool each. With 0, commands sent beforehand keep each session awake.
    pub clients_per_session: u32,
    /// Viewers of each session.
    pub viewers: u32,
    /// Duration of the measurement, once all clients are connected, s.
    pub seconds: f64,
    /// Time over which sessions and clients start, s.
    pub ramp_s: f64,
    /// Commands per second of each client.
    pub rate_hz: f64,
    /// Frames per second of each viewer.
    pub frame_rate_hz: f64,
    /// Clients lead tools with a tip and render forces, in place of pushing.
    pub touch: Option<Deadbands>,
    /// Clients that share a connection.
    pub clients_per_connection: u32,
    /// Threads of this generator.
    pub threads: u32,
}

/// How a trial stands.
#[derive(Debug, Clone, Copy)]
pub struct TrialProgress {
    /// Since it began, s.
    pub at_s: f64,
    /// Samples so far.
    pub samples: u64,
    /// Commands that were rejected so far.
    pub rejected: u64,
    /// Round trip, 99 of 100 are shorter, s.
    pub round_trip_p99_s: f64,
}

impl TrialProgress {
    #[allow(clippy::cast_precision_loss)]
    fn of(tallies: &[Arc<Mutex<Tally>>], clock: Instant) -> Self {
        let (mut samples, mut rejected, mut p99_ns) = (0, 0, 0);
        for tally in tallies {
            let tally = lock(tally);
            samples += tally.samples;
            rejected += tally.rejected.values().sum::<u64>();
            p99_ns = p99_ns.max(tally.round_trip_ns.value_at_quantile(0.99));
        }
        TrialProgress { at_s: clock.elapsed().as_secs_f64(), samples, rejected, round_trip_p99_s: p99_ns as f64 * 1e-9 }
    }
}

/// Creates `sessions` on the server, measures, and deletes them again; also when `stop` completes, which ends the trial. `told` is
/// called once a second of the measurement.
///
/// # Errors
/// Returns why the server refused a session, or could not be reached.
pub async fn trial(
    trial: &LoadTrial,
    server: &Server,
    source: &Source,
    sessions: usize,
    mut told: impl FnMut(&TrialProgress),
    stop: impl Future<Output = ()>,
) -> Result<LoadOutcome, Error> {
    let stage = Arc::new(Stage::new());
    let clock = Instant::now();
    let threads = (trial.threads as usize).min(sessions);
    let (senders, phases): (Vec<_>, Vec<_>) = (0..PHASES).map(|_| watch::channel(0)).unzip();
    let (over, is_over) = watch::channel(());
    let ticker = std::thread::spawn({
        let rate_hz = trial.rate_hz;
        move || tick(&senders, rate_hz, &is_over)
    });
    // Each thread reports once when its clients are connected; we tell them when the measurement begins and ends.
    let (ready, mut gathered) = tokio::sync::mpsc::channel::<()>(threads);
    let (telling, stages) = watch::channel(Stage::RAMP);
    let mut tallies = Vec::new();
    let mut workers = Vec::new();
    for index in 0..threads {
        let tally = Arc::new(Mutex::new(Tally::new()));
        tallies.push(tally.clone());
        let numbers: Vec<usize> = (index..sessions).step_by(threads).collect();
        let orders = Orders {
            server: server.clone(),
            source: source.clone(),
            pause: Duration::from_secs_f64(trial.ramp_s / numbers.len() as f64),
            sessions: numbers,
            clients_per_session: trial.clients_per_session,
            viewers_per_session: trial.viewers,
            clients_per_connection: trial.clients_per_connection as usize,
            frame_rate_hz: trial.frame_rate_hz,
            lasts_s: (trial.ramp_s + trial.seconds + 30.0).min(600.0),
        };
        let touches = trial.touch.zip(Device::named(DEVICE));
        let touches = touches.map(|(deadbands, device)| Lead { deadbands, device, hand: None });
        let common = Common { clock, stage: stage.clone(), tally, rate_hz: trial.rate_hz, touches };
        let (phases, ready, stages) = (phases.clone(), ready.clone(), stages.clone());
        workers.push(std::thread::spawn(move || work(&orders, &common, &phases, &ready, stages)));
    }
    drop((ready, phases));

    let streams = sessions as u64 * u64::from(trial.clients_per_session + trial.viewers);
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
        let length = Duration::from_secs_f64(trial.seconds);
        while begun.elapsed() < length {
            tokio::time::sleep((length - begun.elapsed()).min(Duration::from_secs(1))).await;
            told(&TrialProgress::of(&tallies, clock));
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
        () = stop => None,
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
        ended.map_err(|_| Error::Internal("a thread of the generator failed".to_owned()))??;
    }
    let mut all = Tally::new();
    for tally in &tallies {
        all.add(&lock(tally));
    }
    Ok(LoadOutcome { generator_cores: cores.unwrap_or(f64::NAN), ..all.outcome(sessions) })
}

/// The work of one thread.
fn work(
    orders: &Orders,
    common: &Common,
    phases: &[watch::Receiver<u64>],
    ready: &tokio::sync::mpsc::Sender<()>,
    mut stages: watch::Receiver<u8>,
) -> Result<(), Error> {
    let failed = |e: std::io::Error| Error::Internal(format!("can't start a thread: {e}"));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().map_err(failed)?;
    runtime.block_on(async {
        let mut swarm = Swarm::new(&orders.server, common).await?;
        let mut over = stages.clone();
        let gathered = tokio::select! {
            gathered = swarm.gather(orders, phases) => gathered,
            // Called off.
            _ = over.wait_for(|stage| *stage == Stage::DRAIN) => Ok(()),
        };
        if gathered.is_ok() {
            let _ = ready.send(()).await;
            let _ = stages.wait_for(|stage| *stage != Stage::RAMP).await;
            swarm.look(orders).await;
            let _ = stages.wait_for(|stage| *stage == Stage::DRAIN).await;
            swarm.look(orders).await;
            swarm.drain().await;
        }
        swarm.disperse().await;
        gathered
    })
}

/// Processor time of this process, s; `None` without a /proc.
fn cpu_s() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    let ticks = stat[stat.rfind(')')? + 2..].split_whitespace().skip(11).take(2);
    // Linux counts ticks of 10 ms here.
    ticks.map(|field| field.parse::<f64>().ok()).sum::<Option<f64>>().map(|ticks| ticks / 100.0)
}
