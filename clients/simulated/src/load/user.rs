//! One user of a load test: a session with its clients and viewers, from arrival to end.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use palpate_client::{Channel, Error, Followed, Server, describe, fleet};
use palpate_proto::geometry::from_vector;
use palpate_proto::pb;
use pb::create_session_request::Source;
use pb::haptic_service_client::HapticServiceClient;
use pb::session_service_client::SessionServiceClient;
use tokio::sync::{OnceCell, watch};
use tokio::task::JoinSet;
use tonic::{Response, Status};

use super::client::{Client, Common, LoadStage, SampleTimes, lock};
use super::connections::{ConnectionPurpose, Connections};
use super::led_instrument::InstrumentKind;
use super::plan::{LoadPlan, User, Viewers};
use super::script_player::{ScriptCommands, ScriptPlayer};
use super::stroke::Stroke;
use super::tally::Tally;
use super::viewer::view;

/// Longest time for which a user waits for the server before it leaves.
const SERVER_TIMEOUT: Duration = Duration::from_secs(20);

/// Idle time after which the server deletes a session, if this program dies, s.
const IDLE_S: f64 = 10.0;

/// Number of different places where strokes begin.
const MAX_PLACES: u64 = 1 << 16;

/// State that all users of a thread share.
pub(crate) struct UserContext {
    pub(crate) plan: Arc<LoadPlan>,
    /// The server through each of the plan's networks.
    pub(crate) servers: Arc<[Server]>,
    /// The sources of the plan's scenes.
    pub(crate) sources: Arc<[Source]>,
    /// The scripts of the plan for each of its scenes, once a user has got them.
    pub(crate) scripts: Arc<[Vec<OnceCell<Arc<ScriptCommands>>>]>,
    pub(crate) clock: Instant,
    pub(crate) tally: Arc<Mutex<Tally>>,
    /// The ticks of each turn, at which clients send.
    pub(crate) turns: Vec<watch::Receiver<u64>>,
    /// The stage of the whole load.
    pub(crate) stages: watch::Receiver<u8>,
    /// Time up to which events are counted, s since the start of the plan's clock.
    pub(crate) counted_s: watch::Receiver<f64>,
    /// Held during a request for a step: an answer that waits behind others would have a wrong time.
    pub(crate) asking: tokio::sync::Mutex<()>,
}

/// A user with an open session.
pub(crate) struct UserSession {
    /// The server of the session. In a fleet, another server may own it later.
    server: Server,
    channel: Channel,
    session_id: String,
    rate_hz: f64,
    stage: Arc<LoadStage>,
    /// Its clients and viewers.
    streams: JoinSet<()>,
}

/// Returns why a user could not start: the server's reason, the code of a call, or `UNREACHABLE`.
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

fn silent() -> Error {
    Error::Connection("the server is silent".to_owned())
}

/// Runs a user from arrival to end. If the server refuses it, counts it as turned away.
pub(crate) async fn run_user(context: Arc<UserContext>, user: User) {
    let mut connections = Connections::new(&context.plan);
    let arriving = tokio::time::timeout(SERVER_TIMEOUT, UserSession::arrive(&context, &user, &mut connections)).await;
    match arriving.map_err(|_| silent()).and_then(|arrived| arrived) {
        Ok(session) => session.stay(&context, user.stays_s).await,
        Err(error) => {
            let mut tally = lock(&context.tally);
            *tally.turned_away.entry(reason(&error)).or_default() += 1;
            tally.first_break.get_or_insert(error.to_string());
        }
    }
}

impl UserSession {
    /// Creates a session, and opens the streams of its clients and viewers.
    pub(crate) async fn arrive(
        context: &UserContext,
        user: &User,
        connections: &mut Connections,
    ) -> Result<Self, Error> {
        let begun = Instant::now();
        let server = &context.servers[user.wire];
        let source = Some(context.sources[user.scene].clone());
        let request = pb::CreateSessionRequest { source, paused: false, idle_timeout_s: Some(IDLE_S) };
        let mut sessions = SessionServiceClient::new(connections.to(server, ConnectionPurpose::Call).await?);
        let created = sessions.create_session(request).await?.into_inner().session.unwrap_or_default();
        // A simulated network leads to one server only.
        let server = match context.plan.wires[user.wire].what.conditions {
            None => fleet::home(server, &created)?,
            Some(_) => server.clone(),
        };
        let stepping = created.scene.as_ref().and_then(|scene| scene.stepping.as_ref());
        let mut session = UserSession {
            channel: connections.to(&server, ConnectionPurpose::Call).await?,
            server,
            session_id: created.session_id.clone(),
            rate_hz: stepping.and_then(|stepping| stepping.rate_hz).unwrap_or(1000.0),
            stage: Arc::new(LoadStage::new()),
            streams: JoinSet::new(),
        };
        if let Err(error) = session.open(context, user, &created, connections).await {
            session.leave().await;
            return Err(error);
        }
        #[allow(clippy::cast_possible_truncation)]
        lock(&context.tally).start_ns.saturating_record(begun.elapsed().as_nanos() as u64);
        Ok(session)
    }

    async fn open(
        &mut self,
        context: &UserContext,
        user: &User,
        created: &pb::Session,
        connections: &mut Connections,
    ) -> Result<(), Error> {
        let UserContext { plan, clock, tally, turns, .. } = context;
        let common = Common {
            clock: *clock,
            stage: self.stage.clone(),
            tally: tally.clone(),
            rate_hz: plan.rate_hz,
            touches: plan.leads[user.lead].what,
        };
        let Viewers { number, rate_hz: frames_hz } = plan.viewers[user.viewers].what;
        let sample_times = (number > 0).then(|| Arc::new(Mutex::new(SampleTimes::new())));
        let whole = Stroke::new(created);
        for tool in 0..plan.clients_per_user {
            let place = user.seed.wrapping_add(u64::from(tool)) % MAX_PLACES;
            #[allow(clippy::cast_precision_loss)]
            let client = Client {
                common: common.clone(),
                session_id: self.session_id.clone(),
                tool,
                rate_hz: self.rate_hz,
                stroke: whole.beginning(0.618 * place as f64),
                seed: user.seed,
                middle_m: from_vector(created.extent.as_ref().and_then(|extent| extent.middle_m.as_ref())),
                sample_times: sample_times.clone(),
            };
            #[allow(clippy::cast_possible_truncation)]
            let ticks = turns[place as usize % turns.len()].clone();
            self.streams
                .spawn(client.open(connections.to(&self.server, ConnectionPurpose::Touch).await?, ticks).await?);
        }
        if let Some(name) = &plan.scripts[user.script].what {
            self.play(context, user, name, common.clone()).await?;
        }
        if plan.clients_per_user == 0 {
            self.keep_awake(plan, whole, created.step).await?;
        }
        for _ in 0..number {
            let channel = connections.to(&self.server, ConnectionPurpose::View).await?;
            let (id, frames_hz) = (self.session_id.clone(), frames_hz.min(self.rate_hz));
            self.streams.spawn(view(common.clone(), channel, id, frames_hz, sample_times.clone()).await?);
        }
        Ok(())
    }

    /// Begins to play a script, by tools behind those of the clients.
    async fn play(&mut self, context: &UserContext, user: &User, name: &str, common: Common) -> Result<(), Error> {
        let session = Followed::new(self.server.clone(), self.channel.clone(), self.session_id.clone());
        let known = &context.scripts[user.scene][user.script];
        let get = async || ScriptCommands::get(&session, name).await.map(Arc::new);
        let script = known.get_or_try_init(get).await?.clone();
        let instrument = common.touches.and_then(|lead| lead.instrument);
        let first_tool = context.plan.clients_per_user * instrument.map_or(1, InstrumentKind::tips);
        let player = ScriptPlayer::new(common, session, self.rate_hz, script, first_tool).await?;
        self.streams.spawn(player.play());
        Ok(())
    }

    /// Sends a session without clients all its commands in advance, in one call: a new force every [`APART_S`], so
    /// that the tissue never comes to rest.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    async fn keep_awake(&self, plan: &LoadPlan, stroke: Stroke, step: u64) -> Result<(), Error> {
        /// Fewer than the limit of a session's queue.
        const MAX_COMMANDS: u64 = 4000;
        const APART_S: f64 = 0.05;
        let rate_hz = self.rate_hz;
        let lasts_s = (plan.gathers_over_s().unwrap_or(0.0) + plan.lasts_s() + 30.0).min(600.0);
        let steps = (lasts_s * rate_hz) as u64;
        let apart = ((APART_S * rate_hz) as u64).max(steps / MAX_COMMANDS).max(1);
        let mut haptics = HapticServiceClient::new(self.channel.clone());
        let acquire = pb::AcquireToolRequest {
            session_id: self.session_id.clone(),
            tool: 0,
            lease_s: Some(lasts_s),
            holder: "palpate-client load".to_owned(),
            // The connection is silent until the commands have acted, and silent connections are closed.
            outlives_connection: true,
            more_tools: Vec::new(),
        };
        let lease_id = haptics.acquire_tool(acquire).await?.into_inner().lease_id;
        let command = |index: u64| {
            let at_step = step + index * apart;
            let action = Some(stroke.at(at_step as f64 / rate_hz));
            pb::Command { at_step: Some(at_step), sequence: Some(index + 1), action, ..Default::default() }
        };
        let commands = (0..steps.div_ceil(apart)).map(command).collect();
        let session_id = self.session_id.clone();
        haptics.send_commands(pb::SendCommandsRequest { session_id, lease_id, commands }).await?;
        Ok(())
    }

    /// Stays for `stays_s`, s, or until the load test drains or all streams have ended; then leaves.
    pub(crate) async fn stay(mut self, context: &UserContext, stays_s: f64) {
        let mut stages = context.stages.clone();
        let _ = stages.wait_for(|stage| *stage != LoadStage::RAMP).await;
        self.stage.measure();
        let has_clients = context.plan.clients_per_user > 0;
        let begin = if has_clients { None } else { self.ask(context).await };
        let has_streams = !self.streams.is_empty();
        tokio::select! {
            () = tokio::time::sleep(Duration::from_secs_f64(stays_s)) => {}
            _ = stages.wait_for(|stage| *stage == LoadStage::DRAIN) => {}
            () = async { while self.streams.join_next().await.is_some() {} }, if has_streams => {}
        }
        #[allow(clippy::cast_possible_truncation)]
        self.stage.drain(context.clock.elapsed().as_nanos() as u64);
        if let Some((from_ns, from)) = begin
            && let Some((to_ns, to)) = self.ask(context).await
        {
            #[allow(clippy::cast_precision_loss)]
            let (simulated_s, real_s) =
                (to.step.saturating_sub(from.step) as f64 / self.rate_hz, (to_ns - from_ns) as f64 * 1e-9);
            let mut tally = lock(&context.tally);
            tally.dilation_min = tally.dilation_min.min(simulated_s / real_s);
            if to.resting {
                tally.broke("a session came to rest although commands should keep it awake".to_owned());
            }
        }
        while self.streams.join_next().await.is_some() {}
        lock(&context.tally).left += 1;
        self.leave().await;
    }

    /// Returns the time, ns, and the session as the server describes it: the only way to find the step of one without
    /// clients.
    async fn ask(&self, context: &UserContext) -> Option<(u64, pb::Session)> {
        let _turn = context.asking.lock().await;
        let request = pb::GetSessionRequest { session_id: self.session_id.clone() };
        let answer = self.call(|mut sessions| {
            let request = request.clone();
            async move { sessions.get_session(request).await }
        });
        match answer.await {
            #[allow(clippy::cast_possible_truncation)]
            Ok(answer) => Some((context.clock.elapsed().as_nanos() as u64, answer.session.unwrap_or_default())),
            Err(error) => {
                lock(&context.tally).broke(error.to_string());
                None
            }
        }
    }

    /// Deletes the session. An error is ignored: if the server is gone, so is the session.
    async fn leave(&mut self) {
        self.streams.abort_all();
        let request = pb::DeleteSessionRequest { session_id: self.session_id.clone() };
        let deleted = self.call(|mut sessions| {
            let request = request.clone();
            async move { sessions.delete_session(request).await }
        });
        let _ = deleted.await;
    }

    /// Calls the server that has the session at present.
    async fn call<T, F>(&self, call: impl Fn(SessionServiceClient<Channel>) -> F) -> Result<T, Error>
    where
        F: Future<Output = Result<Response<T>, Status>>,
    {
        let called =
            fleet::follow_from(&self.server, self.channel.clone(), |channel| call(SessionServiceClient::new(channel)));
        let called = tokio::time::timeout(SERVER_TIMEOUT, called).await;
        called.map_err(|_| silent())?.map(|at| at.answer.into_inner())
    }
}
