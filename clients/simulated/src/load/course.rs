//! A plan as it runs: users arrive, stay and leave, and every second is counted by itself.

use std::net::{SocketAddr, ToSocketAddrs};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use palpate_client::bridge::Warn;
use palpate_client::{Channel, Error, Server, describe, fleet};
use palpate_proto::pb;
use palpate_refusal::Refusal;
use pb::create_session_request::Source;
use pb::session_service_client::SessionServiceClient;
use tokio::sync::watch;
use tokio::task::JoinSet;

use super::client::{Arrivals, Client, Common, Stage, lock};
use super::plan::{LoadPlan, Mover, User, Viewers};
use super::report::{LoadReport, Second};
use super::stroke::Stroke;
use super::swarm::{middle_m, rate_hz, view};
use super::tally::Tally;
use super::tip::Lead;
use super::{PHASES, tick};
use crate::relay::RelayNetwork;
use crate::scene_file::SceneFile;

/// Flows of one network at a time.
const MAX_FLOWS: u64 = 20_000;

/// How long a user waits for the server before going away again.
const SERVER_TIMEOUT: Duration = Duration::from_secs(20);

/// The server deletes a session that nobody uses for so long, if this program dies, s.
const IDLE_S: f64 = 10.0;

/// Counts of users.
#[derive(Default)]
struct UserCounts {
    here: AtomicU64,
    arrived: AtomicU64,
    left: AtomicU64,
}

/// What all users share.
struct World {
    plan: LoadPlan,
    /// By the plan's networks.
    servers: Vec<Server>,
    /// By the plan's scenes.
    sources: Vec<Source>,
    clock: Instant,
    tally: Arc<Mutex<Tally>>,
    counts: UserCounts,
    phases: Vec<watch::Receiver<u64>>,
    /// Whether all are to leave.
    over: watch::Receiver<bool>,
}

/// A plan with its scenes, ready to be run.
pub struct PreparedPlan {
    plan: LoadPlan,
    scenes: Vec<SceneFile>,
}

impl PreparedPlan {
    /// Reads the scene files that a plan names.
    ///
    /// # Errors
    /// Refuses a scene that can't be read.
    pub fn new(plan: LoadPlan) -> Result<Self, Refusal> {
        let scenes = plan.scenes.iter().map(|scene| SceneFile::read(&scene.what)).collect::<Result<_, _>>()?;
        Ok(PreparedPlan { plan, scenes })
    }

    /// Loads a server by the plan, until its end or until `stop` completes; then all users leave. `told` is told of each second,
    /// and `warn` what goes wrong with a network.
    ///
    /// # Errors
    /// Returns an error if the server can't be reached or refuses a scene, or if a network can't stand before it.
    pub async fn run(
        self,
        server: &Server,
        told: impl FnMut(&Second) + Send + 'static,
        warn: impl Fn(&str) + Send + Sync + 'static,
        stop: impl Future<Output = ()> + Send + 'static,
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
        // A thread of its own, so that what the users do is measured by who does nothing else.
        let ran = tokio::task::spawn_blocking(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
            let runtime = runtime.map_err(|error| Error::Internal(format!("can't start a thread: {error}")))?;
            Ok::<_, Error>(runtime.block_on(run(plan, servers, sources, told, stop)))
        });
        ran.await.map_err(|error| Error::Internal(error.to_string()))?
    }
}

/// The address of a server, for a network before it.
fn address(url: &str) -> Result<SocketAddr, Error> {
    let refuse = |why: String| Error::Argument(format!("{url}: {why}"));
    let host = url.strip_prefix("http://").ok_or_else(|| {
        let why = "must begin with http:// for a plan with networks: a certificate is not for what stands before it";
        refuse(why.to_owned())
    })?;
    let host = host.split('/').next().unwrap_or(host);
    let host = if host.contains(':') { host.to_owned() } else { format!("{host}:80") };
    let mut found = host.to_socket_addrs().map_err(|error| refuse(error.to_string()))?;
    found.next().ok_or_else(|| refuse("has no address".to_owned()))
}

/// What a loop waits for next.
enum NextEvent {
    User(User),
    Second,
    Stop,
}

async fn run(
    plan: LoadPlan,
    servers: Vec<Server>,
    sources: Vec<Source>,
    mut told: impl FnMut(&Second),
    stop: impl Future<Output = ()>,
) -> LoadReport {
    let (senders, phases): (Vec<_>, Vec<_>) = (0..PHASES).map(|_| watch::channel(0)).unzip();
    let (beating, beats) = watch::channel(());
    let (leave, over) = watch::channel(false);
    let rate_hz = plan.rate_hz;
    let ticker = std::thread::spawn(move || tick(&senders, rate_hz, &beats));
    let tally = Arc::new(Mutex::new(Tally::new()));
    let (users, lasts_s) = (plan.users(), plan.lasts_s());
    let mut report = LoadReport::new(&plan, &users);
    let clock = Instant::now();
    let counts = UserCounts::default();
    let world = Arc::new(World { plan, servers, sources, clock, tally, counts, phases, over });
    let mut tasks = JoinSet::new();
    let mut coming = users.into_iter().peekable();
    let mut stop = std::pin::pin!(stop);
    let begun = tokio::time::Instant::now();
    let mut second = 1.0_f64;
    while second <= lasts_s.ceil() {
        let user_s = coming.peek().map_or(f64::INFINITY, |user| user.at_s);
        let due_s = user_s.min(second);
        let next = tokio::select! {
            biased;
            () = &mut stop => NextEvent::Stop,
            () = tokio::time::sleep_until(begun + Duration::from_secs_f64(due_s)) => {
                coming.next_if(|user| user.at_s < second).map_or(NextEvent::Second, NextEvent::User)
            }
        };
        match next {
            NextEvent::User(user) => {
                world.counts.arrived.fetch_add(1, Ordering::Relaxed);
                tasks.spawn(visit(world.clone(), user));
            }
            NextEvent::Second => {
                let counted = count(&world, second);
                told(&counted);
                report.add(counted);
                second += 1.0;
            }
            NextEvent::Stop => {
                report.is_interrupted = true;
                break;
            }
        }
        // Those who have gone.
        while tasks.try_join_next().is_some() {}
    }
    leave.send_replace(true);
    while tasks.join_next().await.is_some() {}
    // What came after the last second counts in the last phase.
    report.add(count(&world, second));
    drop(beating);
    let _ = ticker.join();
    report
}

/// What was counted since the last time.
fn count(world: &World, at_s: f64) -> Second {
    let tally = std::mem::replace(&mut *lock(&world.tally), Tally::new());
    let UserCounts { here, arrived, left } = &world.counts;
    Second {
        at_s,
        users: here.load(Ordering::Relaxed),
        arrived: arrived.swap(0, Ordering::Relaxed),
        left: left.swap(0, Ordering::Relaxed),
        tally,
    }
}

/// Why a user could not start: the server's reason, or the code of a call, or what else it was.
fn reason(error: &Error) -> String {
    match error {
        Error::Call(status) => {
            let said = describe(status);
            let last = said.rsplit_once('(').and_then(|parts| parts.1.strip_suffix(')'));
            last.map_or_else(|| format!("{:?}", status.code()), str::to_owned)
        }
        _ => "UNREACHABLE".to_owned(),
    }
}

/// The streams of a user.
struct Streams {
    sessions: SessionServiceClient<Channel>,
    session_id: String,
    stage: Arc<Stage>,
    tasks: JoinSet<()>,
}

/// The life of a user.
async fn visit(world: Arc<World>, user: User) {
    let begun = Instant::now();
    let starting = tokio::time::timeout(SERVER_TIMEOUT, start(&world, &user)).await;
    let silent = || Error::Connection("the server is silent".to_owned());
    let mut streams = match starting.map_err(|_| silent()).and_then(|started| started) {
        Ok(streams) => streams,
        Err(error) => {
            let mut tally = lock(&world.tally);
            *tally.turned_away.entry(reason(&error)).or_default() += 1;
            tally.first_break.get_or_insert(error.to_string());
            return;
        }
    };
    #[allow(clippy::cast_possible_truncation)]
    lock(&world.tally).start_ns.saturating_record(begun.elapsed().as_nanos() as u64);
    world.counts.here.fetch_add(1, Ordering::Relaxed);
    streams.stage.measure();
    let mut over = world.over.clone();
    tokio::select! {
        () = tokio::time::sleep(Duration::from_secs_f64(user.stays_s)) => {}
        _ = over.wait_for(|over| *over) => {}
    }
    #[allow(clippy::cast_possible_truncation)]
    streams.stage.drain(world.clock.elapsed().as_nanos() as u64);
    while streams.tasks.join_next().await.is_some() {}
    world.counts.here.fetch_sub(1, Ordering::Relaxed);
    world.counts.left.fetch_add(1, Ordering::Relaxed);
    let request = pb::DeleteSessionRequest { session_id: streams.session_id };
    let _ = tokio::time::timeout(SERVER_TIMEOUT, streams.sessions.delete_session(request)).await;
}

/// Makes a session, and opens the streams of its hand and viewers.
async fn start(world: &World, user: &User) -> Result<Streams, Error> {
    let server = &world.servers[user.wire];
    let channel = server.connect().await?;
    let mut sessions = SessionServiceClient::new(channel.clone());
    let source = Some(world.sources[user.scene].clone());
    let request = pb::CreateSessionRequest { source, paused: false, idle_timeout_s: Some(IDLE_S) };
    let created = sessions.create_session(request).await?.into_inner().session.unwrap_or_default();
    let session_id = created.session_id.clone();
    // What stands for a network leads to one server only.
    let home = match world.plan.wires[user.wire].what.conditions {
        None => fleet::home(server, &created)?,
        Some(_) => server.clone(),
    };
    let channel = if home.url() == server.url() { channel } else { home.connect().await? };
    let mut sessions = SessionServiceClient::new(channel.clone());
    let opened = open(world, user, &home, &created, channel).await;
    match opened {
        Ok((stage, tasks)) => Ok(Streams { sessions, session_id, stage, tasks }),
        Err(error) => {
            let _ = sessions.delete_session(pb::DeleteSessionRequest { session_id }).await;
            Err(error)
        }
    }
}

async fn open(
    world: &World,
    user: &User,
    server: &Server,
    created: &pb::Session,
    channel: Channel,
) -> Result<(Arc<Stage>, JoinSet<()>), Error> {
    let World { plan, clock, tally, phases, .. } = world;
    let touches = match &plan.movers[user.mover].what {
        Mover::Push => None,
        Mover::Hand { hand, device, deadbands } => {
            Some(Lead { deadbands: *deadbands, device: *device, hand: Some((*hand, user.seed)) })
        }
    };
    let stage = Arc::new(Stage::new());
    let common = Common { clock: *clock, stage: stage.clone(), tally: tally.clone(), rate_hz: plan.rate_hz, touches };
    let rate_hz = rate_hz(created);
    let Viewers { number, rate_hz: frames_hz } = plan.viewers[user.viewers].what;
    let arrivals = (number > 0).then(|| Arc::new(Mutex::new(Arrivals::new())));
    #[allow(clippy::cast_precision_loss)]
    let turn = 0.618 * user.seed as f64;
    let client = Client {
        common: common.clone(),
        session_id: created.session_id.clone(),
        tool: 0,
        rate_hz,
        stroke: Stroke::new(created, turn.fract()),
        middle_m: middle_m(created),
        arrivals: arrivals.clone(),
    };
    #[allow(clippy::cast_possible_truncation)]
    let ticks = phases[user.seed as usize % phases.len()].clone();
    let mut tasks = JoinSet::new();
    tasks.spawn(client.open(channel, ticks).await?);
    for _ in 0..number {
        // A connection of its own: on a shared one, frames would delay samples.
        let (channel, id) = (server.connect().await?, created.session_id.clone());
        tasks.spawn(view(common.clone(), channel, id, frames_hz.min(rate_hz), arrivals.clone()).await?);
    }
    Ok((stage, tasks))
}
