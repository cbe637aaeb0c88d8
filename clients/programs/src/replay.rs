//! `palpate-client replay`: plays a script through a server, each command at its exact step.

mod measured;

use std::collections::VecDeque;
use std::io::Write;
use std::path::PathBuf;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use palpate_client::{Channel, Error, Touch, describe, fleet};
use palpate_proto::pb;
use palpate_refusal::Reason;
use palpate_refusal::printable::printable;
use palpate_session::wire;
use palpate_simulated::scene_file::SceneFile;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::collection::{find_script, scenes_of};
use palpate_tissue::scene::record::{
    Line, Network, Percentiles, Record, Run, Summary, far_warning, output, write_line,
};
use palpate_tissue::scene::script::Script;
use palpate_tissue::shape;
use pb::haptic_service_client::HapticServiceClient;
use pb::session_service_client::SessionServiceClient;
use pb::touch_request::Message as Say;
use pb::touch_response::Message as Heard;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;

use crate::ClientFailure;
use crate::credentials::CredentialOptions;
use crate::table::progress_bar;
use measured::{Measured, percentiles_us};

/// Time by which commands are sent ahead of the server's step, s: a network may stall for about this time before the
/// session has to wait.
const AHEAD_S: f64 = 2.0;

/// Largest number of commands of a tool that are sent ahead: fewer than a session queues.
const COMMANDS_AHEAD: u64 = 4000;

/// Time between two heartbeats.
const HEARTBEAT: Duration = Duration::from_millis(5);

/// Silence after which a server has failed: a running session answers heartbeats at once.
const SILENCE: Duration = Duration::from_secs(10);

/// Time limit for creating the session.
const CREATE_TIMEOUT: Duration = Duration::from_secs(120);

#[derive(clap::Args)]
pub(crate) struct ReplayArguments {
    /// A script file, or the name of one that is in ./scripts or built in: `press`, `stroke`, …
    script: PathBuf,
    /// The server
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7117")]
    server: String,
    /// Name of a scene of the server, or a scene file of your own (ends in .toml) [default: the script's first scene,
    /// or paper]
    #[arg(long, value_name = "NAME")]
    scene: Option<String>,
    /// Write the records here instead of to the standard output
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Plot displacement and force of the first tool with a tip, or of the first tool, in the terminal; without
    /// --output the records are then not written to a terminal
    #[arg(long)]
    plot: bool,
    /// Show no progress bar
    #[arg(short, long)]
    quiet: bool,
    #[command(flatten)]
    sampling: Sampling,
    #[command(flatten)]
    credentials: CredentialOptions,
}

/// Options of the samples that the server sends. The records do not depend on them.
#[derive(clap::Args)]
#[command(next_help_heading = "Samples, for --plot and the table")]
struct Sampling {
    /// Sample the forces on the tools every Nth step
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,
    /// Skip samples whose force on the tool differs from the last sample's by at most this, N
    #[arg(long, value_name = "N")]
    deadband_force_n: Option<f64>,
    /// Skip samples whose force differs by at most this fraction, 0 to 1; the larger of both bounds applies. People
    /// notice about 0.1
    #[arg(long, value_name = "FRACTION")]
    deadband_force_fraction: Option<f64>,
    /// Skip samples whose control point has moved by at most this, m. With a force deadband too, a sample is sent when
    /// either is exceeded
    #[arg(long, value_name = "M")]
    deadband_displacement_m: Option<f64>,
    /// Longest time between two samples when nothing changes, s: above 0 and at most 10 [default: 0.05]
    #[arg(long, value_name = "SECONDS")]
    heartbeat_s: Option<f64>,
}

impl Sampling {
    fn deadband(&self) -> Option<pb::Deadband> {
        let deadband = pb::Deadband {
            force_n: self.deadband_force_n,
            force_fraction: self.deadband_force_fraction,
            displacement_m: self.deadband_displacement_m,
            ..Default::default()
        };
        (deadband != pb::Deadband::default()).then_some(deadband)
    }

    /// Checks that samples arrive at least twice while the commands sent ahead last: samples pace the commands.
    #[allow(clippy::cast_precision_loss)]
    fn check(&self, rate_hz: f64, ahead: u64) -> Result<(), ClientFailure> {
        let most_s = 0.5 * ahead as f64 / rate_hz;
        let apart_s = f64::from(self.every) / rate_hz;
        for (option, seconds) in [("--every", apart_s), ("--heartbeat-s", self.heartbeat_s.unwrap_or(0.0) + apart_s)] {
            if seconds > most_s {
                let why = "samples pace the commands, so they must be at most";
                return Err(ClientFailure::Refused(format!(
                    "{option}: {why} {most_s} s apart, but would be {seconds} s"
                )));
            }
        }
        Ok(())
    }
}

/// Time when the last message of the server arrived.
type LastHeard = Mutex<Instant>;

/// The replay's session. It is deleted even when the replay fails.
struct ReplaySession {
    client: SessionServiceClient<Channel>,
    id: String,
}

/// Plays the script; writes the records and a summary.
///
/// # Errors
/// Returns an error if an input is refused, the server fails or is silent, or the output can't be written.
pub(crate) async fn replay(arguments: &ReplayArguments) -> Result<(), ClientFailure> {
    let server = arguments.credentials.server(&arguments.server)?;
    let scene = match &arguments.scene {
        Some(scene) => scene.clone(),
        None => {
            scenes_of(&arguments.script, &Limits::default())?.into_iter().next().unwrap_or_else(|| "paper".to_owned())
        }
    };
    let file = SceneFile::read(&scene)?;
    let unreached =
        |why| ClientFailure::Failed(format!("{why}; `palpate serve` starts a server, --server names another"));
    let channel = server.connect().await.map_err(unreached)?;
    let mut client = SessionServiceClient::new(channel.clone());
    let source = file.source(channel.clone()).await?;
    let request =
        pb::CreateSessionRequest { source: Some(source), paused: true, idle_timeout_s: Some(SILENCE.as_secs_f64()) };
    let silent =
        |_| ClientFailure::Failed(format!("the server created no session within {} s", CREATE_TIMEOUT.as_secs()));
    let created = tokio::time::timeout(CREATE_TIMEOUT, client.create_session(request)).await.map_err(silent)?;
    let created = created.map_err(|status| with_hint(&scene, refused_or_failed(status)))?.into_inner().session;
    let created = created.ok_or_else(|| ClientFailure::Failed("the server's answer has no session".into()))?;
    let home = fleet::home(&server, &created)?;
    let channel = if home.url() == server.url() { channel } else { home.connect().await? };
    let client = SessionServiceClient::new(channel.clone());
    let mut session = ReplaySession { client, id: created.session_id.clone() };
    let sessions = session.client.clone();
    let heard = LastHeard::new(Instant::now());
    let ended = tokio::select! {
        ended = play(arguments, &file, &created, sessions, channel, &heard) => ended,
        failure = silence(&heard) => Err(failure),
        _ = tokio::signal::ctrl_c() => Err(ClientFailure::Failed("interrupted".into())),
    };
    // The result does not matter: a server that has ended has no sessions any more.
    let deleted = session.client.delete_session(pb::DeleteSessionRequest { session_id: session.id });
    let _ = tokio::time::timeout(Duration::from_secs(2), deleted).await;
    ended
}

/// Returns the failure to create a session of this scene. If the server does not know the name, the message also
/// explains how to name a file.
fn with_hint(scene: &str, failure: ClientFailure) -> ClientFailure {
    let file = format!("{scene}.toml");
    match failure {
        ClientFailure::Refused(why) if why.contains(Reason::UnknownScene.as_str()) => {
            let hint = if std::path::Path::new(&file).is_file() {
                format!("did you mean the file `{file}`?")
            } else {
                "give your own scene by its path, --scene FILE.toml".to_owned()
            };
            ClientFailure::Refused(format!("{why}; {hint}"))
        }
        failure => failure,
    }
}

fn failed(status: Status) -> ClientFailure {
    ClientFailure::Failed(format!("the server ended the replay: {}", describe(&status)))
}

fn refused_or_failed(status: Status) -> ClientFailure {
    Error::Call(status).into()
}

/// Sends a script's commands over the haptic stream.
struct Streamer<'s> {
    script: &'s Script,
    outbound: mpsc::Sender<Say>,
    clock: Instant,
    next_step: u64,
    /// For each unanswered heartbeat: all commands before this step were sent ahead of it.
    sent_before: VecDeque<u64>,
}

impl Streamer<'_> {
    async fn say(&self, message: Say) -> Result<(), ClientFailure> {
        let sent = self.outbound.send(message).await;
        sent.map_err(|_| ClientFailure::Failed("the server closed the haptic stream".into()))
    }

    #[allow(clippy::cast_possible_truncation)]
    fn now_ns(&self) -> u64 {
        self.clock.elapsed().as_nanos() as u64
    }

    /// Sends the commands of all steps before `step`.
    async fn send_before(&mut self, step: u64) -> Result<(), ClientFailure> {
        while self.next_step < step.min(self.script.steps) {
            for (tool, action) in self.script.actions_at(self.next_step) {
                let command =
                    wire::command::scripted(&*self.script.shape, tool, self.next_step, &action, self.now_ns());
                self.say(Say::Command(command)).await?;
            }
            self.next_step += 1;
        }
        Ok(())
    }

    async fn heartbeat(&mut self) -> Result<(), ClientFailure> {
        self.sent_before.push_back(self.next_step);
        self.say(Say::Renew(pb::Renew { client_time_ns: self.now_ns(), datagrams: false })).await
    }

    /// Called for each answered heartbeat; they are answered in order. Returns the step before which the server has
    /// all commands.
    fn heartbeat_answered(&mut self) -> u64 {
        self.sent_before.pop_front().unwrap_or(0)
    }
}

/// Runs the session until `step`. That is only as far as the server has all commands, so that none is ever late.
fn run_until(sessions: &SessionServiceClient<Channel>, session_id: &str, step: u64) -> JoinHandle<Result<(), Status>> {
    let mut sessions = sessions.clone();
    let request = pb::StartSessionRequest { session_id: session_id.to_owned(), until_step: Some(step) };
    tokio::spawn(async move { sessions.start_session(request).await.map(|_| ()) })
}

/// Waits for `message` and returns it.
async fn next<T>(
    message: impl Future<Output = Result<Option<T>, Status>>,
    heard: &LastHeard,
) -> Result<T, ClientFailure> {
    let message = message.await;
    *heard.lock().unwrap_or_else(PoisonError::into_inner) = Instant::now();
    match message {
        Ok(Some(message)) => Ok(message),
        Ok(None) => Err(ClientFailure::Failed("the server ended the stream".into())),
        Err(status) => Err(failed(status)),
    }
}

/// Completes when the server has been silent for too long.
async fn silence(heard: &LastHeard) -> ClientFailure {
    loop {
        let last = *heard.lock().unwrap_or_else(PoisonError::into_inner);
        if last.elapsed() >= SILENCE {
            return ClientFailure::Failed(format!("the server was silent for {} s", SILENCE.as_secs()));
        }
        tokio::time::sleep_until((last + SILENCE).into()).await;
    }
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
async fn play(
    arguments: &ReplayArguments,
    file: &SceneFile,
    created: &pb::Session,
    mut sessions: SessionServiceClient<Channel>,
    channel: Channel,
    heard: &LastHeard,
) -> Result<(), ClientFailure> {
    let session_id = &created.session_id;
    let scene = file.scene(created, channel.clone()).await?;
    let limits = Limits::default();
    let script = find_script(&arguments.script, &scene, &limits)?;
    for warning in created.warnings.iter().chain(&script.warnings) {
        crate::say!("palpate-client: warning: {warning}");
    }
    let mut output = output(arguments.output.as_deref(), arguments.plot)?;
    let written = |e: std::io::Error| match e.kind() {
        std::io::ErrorKind::BrokenPipe => ClientFailure::Unread,
        _ => ClientFailure::Failed(format!("can't write the output: {e}")),
    };
    let run = Run {
        scene: scene.name.clone(),
        script: script.name.clone(),
        integrator: created.integrator.clone(),
        substeps: created.substeps,
        precision: created.precision.clone(),
        rate_hz: scene.stepping.rate_hz,
        version: env!("CARGO_PKG_VERSION").to_owned(),
    };
    write_line(&mut output, &Line::Run(&run)).map_err(written)?;

    // A change of the tissue may change the number of substeps.
    let (mut substeps, mut since, mut a_step) = (0, 0, u64::from(created.substeps));
    for (step, change) in &script.changes {
        let update = wire::scene::update_tissue(session_id, change, *step);
        let changed = sessions.update_tissue(update).await.map_err(refused_or_failed)?.into_inner();
        substeps += (step - since) * a_step;
        (since, a_step) = (*step, changed.session.map_or(a_step, |session| u64::from(session.substeps)));
    }
    substeps += (script.steps - since) * a_step;
    let mut haptics = HapticServiceClient::new(channel.clone());
    let probe = pb::ProbeRequest {
        session_id: session_id.clone(),
        r#where: Some(wire::probed(script.sample_points.iter().map(|point| script.shape.name(*point)))),
        every_steps: Some(script.sample_every.try_into().unwrap_or(u32::MAX)),
        energy: true,
        tools: !script.poses.is_empty(),
    };
    let probe = if script.sample_points.iter().copied().eq(shape::points(scene.shape())) {
        pb::ProbeRequest { r#where: Some(pb::probe_request::Where::AllPoints(true)), ..probe }
    } else {
        probe
    };
    let mut records = haptics.probe(probe).await.map_err(refused_or_failed)?.into_inner();

    let (outbound, messages) = mpsc::channel(1024);
    let mut streamer =
        Streamer { script: &script, outbound, clock: Instant::now(), next_step: 0, sent_before: VecDeque::new() };
    let open = pb::TouchOpen {
        session_id: session_id.clone(),
        tools: (0..script.tools() as u32).collect(),
        sample_every_steps: Some(arguments.sampling.every),
        lease_s: Some(SILENCE.as_secs_f64()),
        holder: "palpate-client replay".to_owned(),
        deadband: arguments.sampling.deadband(),
        heartbeat_s: arguments.sampling.heartbeat_s,
        ..Default::default()
    };
    let mut touch = Touch::open(channel, open, ReceiverStream::new(messages)).await.map_err(refused_or_failed)?;
    let ahead = ((AHEAD_S * scene.stepping.rate_hz) as u64).clamp(1, COMMANDS_AHEAD);
    arguments.sampling.check(scene.stepping.rate_hz, ahead)?;
    let mut measured = Measured::new(&script)?;
    streamer.send_before(ahead).await?;
    streamer.heartbeat().await?;
    let mut commands_until = loop {
        match next(touch.next(), heard).await? {
            Heard::Renewed(_) => break streamer.heartbeat_answered(),
            Heard::Rejection(rejection) => return Err(rejected(&rejection)),
            _ => {}
        }
    };
    let mut hasher = sessions.clone();
    let asked = pb::GetStateHashRequest { session_id: session_id.clone(), at_step: Some(script.steps) };
    let mut hash = tokio::spawn(async move { hasher.get_state_hash(asked).await });
    let started = Instant::now();
    let mut until = commands_until;
    let (mut running, mut is_answered) = (run_until(&sessions, session_id, until), false);

    let progress = progress_bar("{elapsed_precise} [{wide_bar}] step {pos} of {len}", script.steps, arguments.quiet);
    let mut heartbeat = tokio::time::interval(HEARTBEAT);
    heartbeat.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Skip);
    let mut record = Record::default();
    let mut records_left = script.steps / script.sample_every + 1;
    let mut final_hash = None;
    let mut wall_s = 0.0;
    while records_left > 0 || final_hash.is_none() || measured.last.0 < script.steps {
        // Not at each heartbeat, but well before the session would have to wait.
        let is_due = commands_until >= until + ahead / 4 || commands_until == script.steps;
        if is_answered && commands_until > until && is_due {
            until = commands_until;
            (running, is_answered) = (run_until(&sessions, session_id, until), false);
        }
        tokio::select! {
            message = next(touch.next(), heard), if measured.last.0 < script.steps => match message? {
                Heard::Sample(sample) => {
                    if sample.held {
                        let asked = pb::GetSessionRequest { session_id: session_id.clone() };
                        let session = sessions.get_session(asked).await.map_err(failed)?.into_inner().session;
                        let reason = session.map(|session| session.hold_reason).unwrap_or_default();
                        return Err(ClientFailure::Failed(format!("the run was stopped: {reason}")));
                    }
                    measured.sample(&sample, arguments.sampling.every);
                    wall_s = started.elapsed().as_secs_f64();
                    progress.set_position(sample.step);
                    streamer.send_before(sample.step + ahead).await?;
                }
                Heard::Renewed(renewed) => {
                    let round_trip_ns = streamer.now_ns().saturating_sub(renewed.client_time_ns);
                    let _ = measured.round_trip_ns.record(round_trip_ns);
                    let _ = measured.hold_ns.record(renewed.server_hold_ns);
                    commands_until = streamer.heartbeat_answered();
                }
                Heard::Rejection(rejection) => {
                    // The samples report recoveries.
                    measured.rejected += u64::from(rejection.reason != Reason::Recovered.as_str());
                    progress.suspend(|| crate::say!("palpate-client: warning: {}", rejection_text(&rejection)));
                }
                Heard::Opened(_) | Heard::ForceLaw(_) | Heard::JawOverload(_) => {}
            },
            message = next(records.message(), heard), if records_left > 0 => {
                let message = message?;
                if message.dropped_records > 0 {
                    let why = "records were lost: this client can't keep up with so many points at this rate";
                    return Err(ClientFailure::Failed(why.into()));
                }
                if wire::sample::add_to_record(&mut record, &message) {
                    let mut record = std::mem::take(&mut record);
                    record.instruments = script.instrument_records(record.time_s, &record.tools);
                    measured.record(&record);
                    write_line(&mut output, &record).map_err(written)?;
                    records_left -= 1;
                }
            },
            answer = &mut running, if !is_answered => {
                answer.map_err(|e| ClientFailure::Failed(e.to_string()))?.map_err(refused_or_failed)?;
                is_answered = true;
            }
            answer = &mut hash, if final_hash.is_none() => {
                let answer = answer.map_err(|e| ClientFailure::Failed(e.to_string()))?.map_err(failed)?;
                final_hash = Some(answer.into_inner().state_hash);
            }
            _ = heartbeat.tick(), if measured.last.0 < script.steps => streamer.heartbeat().await?,
        }
    }
    progress.finish_and_clear();
    let mut recoveries = Vec::new();
    if measured.recovery_count > 0 {
        let asked = pb::GetSessionRequest { session_id: session_id.clone() };
        let session = sessions.get_session(asked).await.map_err(failed)?.into_inner().session.unwrap_or_default();
        recoveries = session.recoveries.into_iter().map(wire::sample::from_recovery).collect();
    }

    let points = scene.shape().point_count();
    let network = Network {
        late_commands: measured.late,
        rejected_commands: measured.rejected,
        overruns: measured.overruns,
        time_dilation: measured.dilation(scene.stepping.rate_hz),
        round_trip_us: percentiles_us(&measured.round_trip_ns),
        server_hold_us: percentiles_us(&measured.hold_ns),
    };
    let summary = Summary {
        audited_error: None,
        corrections: Vec::new(),
        recoveries,
        jaw_overloads: Vec::new(),
        ties: Vec::new(),
        warnings: far_warning(measured.largest_displacement_m, scene.shape()).into_iter().collect(),
        largest_displacement_m: measured.largest_displacement_m,
        peak_reaction_n: measured.peak_reaction_n,
        curves: std::mem::take(&mut measured.curves),
        steps: script.steps,
        substeps,
        points,
        wall_s,
        ns_per_point_substep: wall_s * 1e9 / (substeps as f64 * points as f64),
        computed_fraction: measured.computed as f64 / (script.steps * points as u64) as f64,
        guard_events: 0,
        topology: None,
        mesh_error_estimate: None,
        final_hash: final_hash.unwrap_or_default(),
        stages: Vec::new(),
        network: Some(network.clone()),
    };
    write_line(&mut output, &Line::Summary(&summary)).map_err(written)?;
    output.flush().map_err(written)?;
    if arguments.plot {
        // The plot must not go where the records go.
        if arguments.output.is_some() {
            crate::tell!("{}", summary.curves);
        } else {
            let _ = writeln!(std::io::stderr(), "{}", summary.curves);
        }
    }
    table(arguments, &summary, &network, &measured);
    summary.warnings.iter().for_each(|warning| crate::warn(warning));
    if measured.rejected > 0 {
        let why = "commands were rejected, so the run differs from the script";
        return Err(ClientFailure::Failed(format!("{} {why}", measured.rejected)));
    }
    if let Some(fault) = summary.fault() {
        return Err(ClientFailure::Failed(fault));
    }
    Ok(())
}

fn rejection_text(rejection: &pb::Rejection) -> String {
    format!("tool {}, command {}: {} ({})", rejection.tool, rejection.sequence, rejection.message, rejection.reason)
}

fn rejected(rejection: &pb::Rejection) -> ClientFailure {
    ClientFailure::Refused(rejection_text(rejection))
}

/// Prints the summary as a table, on the output that the records do not go to.
fn table(arguments: &ReplayArguments, summary: &Summary, network: &Network, measured: &Measured<'_>) {
    let percentiles = |p: &Percentiles| format!("{:.0} / {:.0} / {:.0} µs", p.p50, p.p99, p.max);
    let rows = [
        ("steps", format!("{} in {:.2} s", summary.steps, summary.wall_s)),
        ("overruns", format!("{} (time dilation {:.5})", network.overruns, network.time_dilation)),
        ("samples", format!("{} for {} steps", measured.samples, summary.steps)),
        ("late commands", network.late_commands.to_string()),
        ("largest displacement seen", format!("{:.6} m", summary.largest_displacement_m)),
        ("peak reaction", format!("{:.6} N", summary.peak_reaction_n)),
        ("round trip p50 / p99 / max", percentiles(&network.round_trip_us)),
        ("final hash", summary.final_hash.clone()),
    ];
    for (name, value) in rows {
        if arguments.output.is_some() {
            crate::tell!("{name:<28}{}", printable(value));
        } else {
            crate::say!("{name:<28}{value}");
        }
    }
}
