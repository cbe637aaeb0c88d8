//! Execution of a plan: users arrive, stay and leave, and each second is counted separately.

use std::net::{SocketAddr, ToSocketAddrs};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use palpate_client::bridge::Warn;
use palpate_client::{Error, Server};
use palpate_proto::pb::create_session_request::Source;
use palpate_refusal::Refusal;
use tokio::sync::{OnceCell, mpsc, watch};
use tokio::task::JoinSet;

use super::client::{LoadStage, lock};
use super::connections::Connections;
use super::plan::{LoadPlan, User};
use super::report::{LoadReport, Second};
use super::tally::Tally;
use super::user::{UserContext, UserSession, run_user};
use super::{TURNS, tick};
use crate::relay::RelayNetwork;
use crate::scene_file::SceneFile;

/// Largest number of concurrent flows of one network.
const MAX_FLOWS: u64 = 20_000;

/// Time between the start of the last user and the start of the clock, if the clock waits for the users.
const SETTLE: Duration = Duration::from_millis(500);

/// A plan of a load test with its scene files read, ready to run once, for [`PreparedPlan::run`].
pub struct PreparedPlan {
    plan: LoadPlan,
    scenes: Vec<SceneFile>,
}

impl PreparedPlan {
    /// Creates a plan that is ready to run: reads the scene files and meshes that it names. Sends nothing.
    ///
    /// # Errors
    /// Returns the refusals of [`SceneFile::read`].
    pub fn new(plan: LoadPlan) -> Result<Self, Refusal> {
        let scenes = plan.scenes.iter().map(|scene| SceneFile::read(&scene.what)).collect::<Result<_, _>>()?;
        Ok(PreparedPlan { plan, scenes })
    }

    /// Runs the plan against a server until its end or until `stop` completes; then all users leave, and the report
    /// is one of an interrupted plan. Users have threads of their own. Calls `told` after each second of the plan
    /// with its counts, and `warn` with problems of a simulated network. Returns the report, also if objectives were
    /// missed ([`LoadReport::verdict`]).
    ///
    /// # Errors
    /// Returns an error if the server can't be reached, or can't use a mesh; if a simulated network can't be put
    /// before it, such as one with https://; if a session of a trial is refused; or if a thread can't be started or
    /// fails.
    pub async fn run(
        self,
        server: &Server,
        told: impl FnMut(&Second),
        warn: impl Fn(&str) + Send + Sync + 'static,
        stop: impl Future<Output = ()>,
    ) -> Result<LoadReport, Error> {
        let PreparedPlan { plan, scenes } = self;
        let channel = server.connect().await?;
        let mut sources = Vec::new();
        for scene in scenes {
            sources.push(scene.source(channel.clone()).await?);
        }
        drop(channel);
        let warn: Arc<Warn> = Arc::new(Box::new(warn));
        let mut servers = Vec::new();
        for (index, wire) in plan.wires.iter().enumerate() {
            servers.push(match wire.what.conditions {
                None => server.clone(),
                Some(conditions) => {
                    let to = address(server.url())?;
                    let network = RelayNetwork::new(conditions, 100 + index as u64, MAX_FLOWS, warn.clone());
                    let near = network.relay_tcp(SocketAddr::from(([127, 0, 0, 1], 0)), to);
                    let near = near.map_err(|error| Error::Internal(error.to_string()))?;
                    server.at(&format!("http://{near}"))?
                }
            });
        }
        run(plan, servers, sources, told, stop).await
    }
}

/// Returns the address of a server, for a simulated network before it.
fn address(url: &str) -> Result<SocketAddr, Error> {
    let refuse = |why: String| Error::Argument(format!("{url}: {why}"));
    let host = url.strip_prefix("http://").ok_or_else(|| {
        let why = "must begin with http:// for a plan with networks: a certificate is not valid for a relay";
        refuse(why.to_owned())
    })?;
    let host = host.split('/').next().unwrap_or(host);
    let host = if host.contains(':') { host.to_owned() } else { format!("{host}:80") };
    let mut found = host.to_socket_addrs().map_err(|error| refuse(error.to_string()))?;
    found.next().ok_or_else(|| refuse("has no address".to_owned()))
}

async fn run(
    plan: LoadPlan,
    servers: Vec<Server>,
    sources: Vec<Source>,
    told: impl FnMut(&Second),
    stop: impl Future<Output = ()>,
) -> Result<LoadReport, Error> {
    let users = plan.users();
    let mut plan_run = PlanRun { report: LoadReport::new(&plan, &users), tallies: Vec::new(), at_s: 0.0, users: 0 };
    let (senders, turns): (Vec<_>, Vec<_>) = (0..TURNS).map(|_| watch::channel(0)).unzip();
    let (beating, beats) = watch::channel(());
    let rate_hz = plan.rate_hz;
    let ticker = std::thread::spawn(move || tick(&senders, rate_hz, &beats));
    let (telling, stages) = watch::channel(LoadStage::RAMP);
    let (counting, counted_s) = watch::channel(0.0);
    let (arrived, mut arrivals) = mpsc::unbounded_channel();
    let (servers, sources): (Arc<[_]>, Arc<[_]>) = (servers.into(), sources.into());
    let cells = |_| plan.scripts.iter().map(|_| OnceCell::new()).collect::<Vec<_>>();
    let scripts: Arc<[_]> = (0..plan.scenes.len()).map(cells).collect();
    let (plan, clock) = (Arc::new(plan), Instant::now());
    let threads = (plan.threads as usize).min(users.len()).max(1);
    let mut workers = Vec::new();
    for index in 0..threads {
        let tally = Arc::new(Mutex::new(Tally::new()));
        plan_run.tallies.push(tally.clone());
        let context = UserContext {
            plan: plan.clone(),
            servers: servers.clone(),
            sources: sources.clone(),
            scripts: scripts.clone(),
            clock,
            tally,
            turns: turns.clone(),
            stages: stages.clone(),
            counted_s: counted_s.clone(),
            asking: tokio::sync::Mutex::new(()),
        };
        let (own, arrived) = (users.iter().skip(index).step_by(threads).copied().collect(), arrived.clone());
        // The users get threads of their own, so that no other work delays their measurements.
        workers.push(std::thread::spawn(move || work(context, own, &arrived)));
    }
    drop(arrived);
    let ended = tokio::select! {
        ended = plan_run.take(&plan, &mut arrivals, (&telling, &counting), told) => ended,
        () = stop => {
            plan_run.report.is_interrupted = true;
            Ok(())
        }
    };
    telling.send_replace(LoadStage::DRAIN);
    let joined = tokio::task::spawn_blocking(move || {
        let joined = workers.into_iter().try_for_each(std::thread::JoinHandle::join);
        // Users wait for outstanding answers.
        drop(beating);
        joined.and(ticker.join())
    });
    let joined = joined.await.map_err(|_| ()).and_then(|joined| joined.map_err(|_| ()));
    joined.map_err(|()| Error::Internal("a thread of the generator failed".to_owned()))?;
    ended?;
    while let Some(arrived) = arrivals.recv().await {
        arrived?;
    }
    // Counts after the last second belong to the last phase.
    let rest = plan_run.count(plan_run.at_s + 1.0);
    plan_run.report.add(rest);
    Ok(plan_run.report)
}

/// Progress of a load test.
struct PlanRun {
    report: LoadReport,
    /// Counts by thread.
    tallies: Vec<Arc<Mutex<Tally>>>,
    /// Time since the start of the plan's clock, s.
    at_s: f64,
    users: u64,
}

impl PlanRun {
    /// Runs the clock of the plan. It starts when all users that gather are connected.
    async fn take(
        &mut self,
        plan: &LoadPlan,
        arrivals: &mut mpsc::UnboundedReceiver<Result<(), Error>>,
        (telling, counting): (&watch::Sender<u8>, &watch::Sender<f64>),
        mut told: impl FnMut(&Second),
    ) -> Result<(), Error> {
        let gathers = plan.gathers_over_s().is_some();
        if gathers {
            for _ in &self.tallies {
                arrivals.recv().await.unwrap_or(Ok(()))?;
            }
            tokio::time::sleep(SETTLE).await;
        }
        telling.send_replace(LoadStage::MEASURE);
        let (begun, begun_cpu_s) = (tokio::time::Instant::now(), cpu_s());
        let lasts_s = plan.lasts_s();
        // Fractions of a second do not add up exactly.
        while self.at_s < lasts_s - 1e-9 {
            let at_s = (self.at_s + 1.0).min(lasts_s);
            tokio::time::sleep_until(begun + Duration::from_secs_f64(at_s)).await;
            let second = self.count(at_s);
            counting.send_replace(at_s);
            told(&second);
            self.report.add(second);
            // Nothing is left to measure.
            if gathers && self.users == 0 {
                break;
            }
        }
        if let (Some(from_s), Some(to_s)) = (begun_cpu_s, cpu_s()) {
            self.report.generator_cores = (to_s - from_s) / begun.elapsed().as_secs_f64();
        }
        Ok(())
    }

    /// Takes the counts since the last call, up to `at_s`.
    fn count(&mut self, at_s: f64) -> Second {
        let mut all = Tally::new();
        for tally in &self.tallies {
            let anew = Tally::new();
            let counted = std::mem::replace(&mut *lock(tally), anew);
            all.add(&counted);
        }
        self.users = self.users + all.start_ns.len() - all.left;
        let lasts_s = at_s - std::mem::replace(&mut self.at_s, at_s);
        Second { at_s, lasts_s, users: self.users, tally: all }
    }
}

/// Runs the users of one thread. Sends to `arrived` when all of them have arrived, or why they could not.
fn work(context: UserContext, users: Vec<User>, arrived: &mpsc::UnboundedSender<Result<(), Error>>) {
    let all = match tokio::runtime::Builder::new_current_thread().enable_all().build() {
        Ok(runtime) => return runtime.block_on(play(Arc::new(context), users, arrived)),
        Err(error) => Err(Error::Internal(format!("can't start a thread: {error}"))),
    };
    let _ = arrived.send(all);
}

async fn play(context: Arc<UserContext>, users: Vec<User>, arrived: &mpsc::UnboundedSender<Result<(), Error>>) {
    let (mut stages, mut staying) = (context.stages.clone(), JoinSet::new());
    let all = tokio::select! {
        all = arrive(&context, users, &mut staying) => all,
        _ = stages.wait_for(|stage| *stage == LoadStage::DRAIN) => Ok(()),
    };
    let _ = arrived.send(all);
    while staying.join_next().await.is_some() {}
}

/// Starts the users, each at its time. Users that gather start one after the other.
async fn arrive(context: &Arc<UserContext>, users: Vec<User>, staying: &mut JoinSet<()>) -> Result<(), Error> {
    let gathers = context.plan.gathers_over_s().is_some();
    let mut connections = Connections::new(&context.plan);
    let begun = tokio::time::Instant::from_std(context.clock);
    let mut counted_s = context.counted_s.clone();
    for user in users {
        tokio::time::sleep_until(begun + Duration::from_secs_f64(user.at_s)).await;
        // A user that arrives when a second ends belongs to the next one.
        if !gathers && counted_s.wait_for(|counted_s| counted_s + 1.0 > user.at_s).await.is_err() {
            return Ok(());
        }
        lock(&context.tally).arrived += 1;
        let context = context.clone();
        if gathers {
            let session = UserSession::arrive(&context, &user, &mut connections).await?;
            staying.spawn(async move { session.stay(&context, user.stays_s).await });
        } else {
            staying.spawn(run_user(context, user));
        }
        // Removes the tasks of users that have left.
        while staying.try_join_next().is_some() {}
    }
    Ok(())
}

/// Returns the processor time of this process, s; `None` without /proc.
fn cpu_s() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    let ticks = stat[stat.rfind(')')? + 2..].split_whitespace().skip(11).take(2);
    // Linux counts ticks of 10 ms here.
    ticks.map(|field| field.parse::<f64>().ok()).sum::<Option<f64>>().map(|ticks| ticks / 100.0)
}
