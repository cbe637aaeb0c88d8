//! `palpate-client play`: sends a journal to a server, and begins a session at one of its steps, played or live.
//! Compares a played session with the hashes of the journal, and records it if requested.

mod recorded;

use std::io::Write;
use std::path::PathBuf;
use std::time::Duration;

use indicatif::ProgressBar;
use palpate_client::fleet::At;
use palpate_client::upload::upload_journal;
use palpate_client::{Channel, Error, fleet};
use palpate_proto::pb;
use palpate_refusal::printable::printable_json;
use palpate_session::wire;
use palpate_tissue::files;
use palpate_tissue::scene::record::{Line, Record, Run, output, write_line};
use palpate_tissue::shape::PointName;
use pb::create_session_request::Source;
use pb::haptic_service_client::HapticServiceClient;
use pb::session_service_client::SessionServiceClient;
use tonic::{Status, Streaming};

use crate::credentials::CredentialOptions;
use crate::table::progress_bar;
use crate::{ClientFailure, interrupted, table};
use recorded::Compared;

/// Largest size of a journal, bytes: no server accepts more.
const MAX_BYTES: u64 = 1 << 32;

/// Arguments of `play`.
#[derive(clap::Args)]
pub(crate) struct PlayArguments {
    /// The journal, or a snapshot (MCAP)
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// The server
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7117")]
    server: String,
    /// The first step [default: the first of the journal; its last with --live]
    #[arg(long, value_name = "STEP")]
    from: Option<u64>,
    /// The last step [default: the last of the journal]
    #[arg(long, value_name = "STEP", conflicts_with = "live")]
    to: Option<u64>,
    /// Multiple of the recorded speed, from 0.1 to 8
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, conflicts_with = "live")]
    speed: f64,
    /// Begin a live session at that step, which anybody may touch, and keep it at the end
    #[arg(long)]
    live: bool,
    /// Write the records of the steps after the first to this file, as JSON Lines like `palpate run`
    #[arg(short, long, value_name = "FILE", conflicts_with = "live")]
    output: Option<PathBuf>,
    /// Number of steps between records
    #[arg(long, value_name = "STEPS", default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..), requires = "output")]
    every: u32,
    /// A point in the records: X,Y of a sheet, or the number of a vertex; may be repeated. Tools are always in them
    #[arg(long, value_name = "POINT", requires = "output")]
    point: Vec<PointName>,
    /// Keep the session at the end: the server deletes it when nobody has used it for a quarter of an hour
    /// (idle_session_s)
    #[arg(long)]
    keep_session: bool,
    /// Print one JSON object instead of a table
    #[arg(long)]
    json: bool,
    /// Show no progress
    #[arg(short, long)]
    quiet: bool,
    #[command(flatten)]
    credentials: CredentialOptions,
}

/// Interval between two queries of the session.
const LOOK: Duration = Duration::from_millis(100);

fn refused(status: Status) -> ClientFailure {
    Error::Call(status).into()
}

/// Writer of a session's records to a file.
struct Records {
    stream: Streaming<pb::ProbeResponse>,
    output: Box<dyn Write>,
    left: u64,
}

impl Records {
    /// Starts to record the steps from `begin` to `end` of a paused session.
    async fn open(
        arguments: &PlayArguments,
        channel: Channel,
        session: &pb::Session,
        [begin, end]: [u64; 2],
    ) -> Result<Option<Self>, ClientFailure> {
        let Some(path) = &arguments.output else { return Ok(None) };
        let every = u64::from(arguments.every);
        let mut output = output(Some(path), false)?;
        let stepping = session.scene.as_ref().and_then(|scene| scene.stepping.as_ref());
        let run = Run {
            scene: session.scene_name.clone(),
            script: arguments.file.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default(),
            integrator: session.integrator.clone(),
            substeps: session.substeps,
            precision: session.precision.clone(),
            rate_hz: stepping.and_then(|stepping| stepping.rate_hz).unwrap_or_default(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        };
        write_line(&mut *output, &Line::Run(&run)).map_err(unwritten)?;
        let probe = pb::ProbeRequest {
            session_id: session.session_id.clone(),
            r#where: Some(wire::probed(arguments.point.iter().copied())),
            every_steps: Some(arguments.every),
            energy: true,
            tools: true,
        };
        let stream = HapticServiceClient::new(channel).probe(probe).await.map_err(refused)?.into_inner();
        let left = end / every - begin / every;
        Ok(Some(Records { stream, output, left }))
    }

    /// Writes the records, up to the last.
    async fn write(mut self) -> Result<(), ClientFailure> {
        let mut record = Record::default();
        while self.left > 0 {
            let message = self.stream.message().await.map_err(refused)?;
            let message =
                message.ok_or_else(|| ClientFailure::Failed("the server has ended the records".to_owned()))?;
            if message.dropped_records > 0 {
                let why = "records were lost: this client can't keep up with so many points at this rate";
                return Err(ClientFailure::Failed(why.to_owned()));
            }
            // Only step 0 has a record of the beginning.
            if wire::sample::add_to_record(&mut record, &message) && message.step == 0 {
                record = Record::default();
            } else if message.last {
                write_line(&mut *self.output, &std::mem::take(&mut record)).map_err(unwritten)?;
                self.left -= 1;
            }
        }
        self.output.flush().map_err(unwritten)
    }
}

fn unwritten(error: std::io::Error) -> ClientFailure {
    ClientFailure::Failed(format!("the records can't be written: {error}"))
}

/// Sends the journal, and plays it to the end.
///
/// # Errors
/// Returns an error if the file can't be read, the server refuses it, the connection breaks, or a hash differs from
/// the journal's.
pub(crate) async fn play(arguments: &PlayArguments) -> Result<(), ClientFailure> {
    let PlayArguments { file, from, to, speed, live, quiet, .. } = arguments;
    let bytes = files::read_regular(file, MAX_BYTES)?;
    let mut recorded = recorded::hashes(&file.display().to_string(), &bytes)?;
    let server = arguments.credentials.server(&arguments.server)?;
    let channel = server.connect().await?;
    let sending =
        progress_bar("{elapsed_precise} [{wide_bar}] sent {bytes} of {total_bytes}", bytes.len() as u64, *quiet);
    let answer = upload_journal(channel.clone(), &bytes, |sent| sending.set_position(sent)).await.map_err(refused)?;
    sending.finish_and_clear();
    drop(bytes);
    let journal = answer.journal.unwrap_or_default();
    let (first, last) = (journal.begin_step, journal.end_step);
    let end = to.unwrap_or(last);
    let begin = from.unwrap_or(if *live { last } else { first });
    for (option, step, least) in [("--from", begin, first), ("--to", end, begin)] {
        if !(least..=last).contains(&step) {
            return Err(ClientFailure::Refused(format!("{option}: must be from {least} to {last}, but is {step}")));
        }
    }
    let moment = pb::JournalMoment {
        upload_id: answer.upload_id,
        step: Some(begin),
        plays: !live,
        speed: (!live).then_some(*speed),
        ..Default::default()
    };
    let mut sessions = SessionServiceClient::new(channel.clone());
    // The session is paused until its name is known.
    let request =
        pb::CreateSessionRequest { source: Some(Source::Journal(moment)), paused: true, ..Default::default() };
    let session = sessions.create_session(request).await.map_err(refused)?.into_inner().session.unwrap_or_default();
    let id = session.session_id.clone();
    if !arguments.json {
        crate::say!("palpate-client: session {id}, {}, from step {begin}", session.scene_name);
    }
    // Only the server that creates the session can report the hash of its first step.
    recorded.retain(|step, _| (begin + 1..=end).contains(step) || (begin == end && *step == begin));
    let started = pb::StartSessionRequest { session_id: id.clone(), until_step: (!live).then_some(end) };
    // From here on, another server of the fleet may have taken over a live session.
    let mut at = At { server, channel: channel.clone(), answer: () };
    let bar = progress_bar("{elapsed_precise} [{wide_bar}] step {pos} of {len}", end, *quiet);
    let run = async {
        let records = Records::open(arguments, channel.clone(), &session, [begin, end]).await?;
        if *live || begin < end {
            let started = call(&mut at, |channel| {
                let request = started.clone();
                async move { SessionServiceClient::new(channel).start_session(request).await }
            });
            started.await?;
        }
        if *live {
            return Ok((begin, Compared::default()));
        }
        let written = async {
            match records {
                Some(records) => records.write().await,
                None => Ok(()),
            }
        };
        let compared = recorded::compare(&channel, &id, recorded);
        let (step, compared, ()) = tokio::try_join!(follow(&mut at, &id, end, &bar), compared, written)?;
        Ok((step, compared))
    };
    let played = tokio::select! {
        played = run => played,
        () = interrupted() => Err(ClientFailure::Failed("interrupted".to_owned())),
    };
    bar.finish_and_clear();
    let hash = match (&played, live) {
        (Ok(_), false) => {
            let asked = pb::GetStateHashRequest { session_id: id.clone(), at_step: None };
            let answer = call(&mut at, |channel| {
                let request = asked.clone();
                async move { SessionServiceClient::new(channel).get_state_hash(request).await }
            });
            answer.await.map(|answer| answer.state_hash)
        }
        _ => Ok(String::new()),
    };
    if !(arguments.keep_session || *live && played.is_ok()) {
        let request = pb::DeleteSessionRequest { session_id: id.clone() };
        let deleted = call(&mut at, |channel| {
            let request = request.clone();
            async move { SessionServiceClient::new(channel).delete_session(request).await }
        });
        if let Err(ClientFailure::Failed(why) | ClientFailure::Refused(why)) = deleted.await {
            crate::warn(&format!("session {id} was not deleted: {why}"));
        }
    }
    let ((step, compared), hash) = (played?, hash?);
    if arguments.json {
        let hash = (!hash.is_empty()).then_some(hash);
        let told = serde_json::json!({ "session_id": id, "begin_step": begin, "end_step": step, "state_hash": hash,
            "equal_hashes": compared.equal, "difference": compared.difference });
        crate::tell!("{}", printable_json(told));
    } else if *live {
        table::print(&[("session", id), ("live from step", step.to_string())]);
    } else {
        let steps = format!("{begin} to {step}");
        let rows = [("session", id), ("steps", steps), ("state hash", hash), ("recorded hashes", compared.told())];
        table::print(&rows);
    }
    match compared.difference {
        Some(difference) => Err(ClientFailure::Failed(format!("{}: differs: {difference}", file.display()))),
        None => Ok(()),
    }
}

/// Calls the server of a fleet that has the session.
async fn call<T, F>(at: &mut At<()>, call: impl Fn(Channel) -> F) -> Result<T, ClientFailure>
where
    F: Future<Output = Result<tonic::Response<T>, Status>>,
{
    let At { server, channel, answer } = fleet::follow_from(&at.server, at.channel.clone(), call).await?;
    *at = At { server, channel, answer: () };
    Ok(answer.into_inner())
}

/// Waits until a session has done `end` steps. Returns how many it has done.
async fn follow(at: &mut At<()>, id: &str, end: u64, bar: &ProgressBar) -> Result<u64, ClientFailure> {
    loop {
        let asked = pb::GetSessionRequest { session_id: id.to_owned() };
        let answer = call(at, |channel| {
            let request = asked.clone();
            async move { SessionServiceClient::new(channel).get_session(request).await }
        });
        let session = answer.await?.session.unwrap_or_default();
        bar.set_position(session.step);
        if !session.hold_reason.is_empty() {
            return Err(ClientFailure::Failed(format!(
                "the session is held at step {}: {}",
                session.step, session.hold_reason
            )));
        }
        if session.step >= end {
            return Ok(session.step);
        }
        tokio::time::sleep(LOOK).await;
    }
}
