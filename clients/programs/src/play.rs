//! `palpate-client play`: sends a journal to a server, and begins a session at a moment of it, played or live.

use std::path::PathBuf;
use std::time::Duration;

use indicatif::ProgressBar;
use palpate_client::fleet::At;
use palpate_client::upload::upload_journal;
use palpate_client::{Channel, Error, fleet};
use palpate_proto::pb;
use pb::create_session_request::Source;
use pb::session_service_client::SessionServiceClient;
use tonic::Status;

use crate::credentials::CredentialOptions;
use crate::table::progress_bar;
use crate::{Failure, interrupted, table};

/// Arguments of `play`.
#[derive(clap::Args)]
pub(crate) struct Arguments {
    /// The journal, or a snapshot (MCAP)
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// The server
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7117")]
    server: String,
    /// The step to begin at [default: the first of the journal; its last with --live]
    #[arg(long, value_name = "STEP")]
    from: Option<u64>,
    /// The step to end at [default: the last of the journal]
    #[arg(long, value_name = "STEP", conflicts_with = "live")]
    to: Option<u64>,
    /// Play so many times as fast as it was recorded, from 0.1 to 8
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, conflicts_with = "live")]
    speed: f64,
    /// Begin a live session there, for anybody to touch, and leave it to the server
    #[arg(long)]
    live: bool,
    /// Keep the session at the end, for others: the server deletes it when nobody has used it for long
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

/// The session is looked at so often.
const LOOK: Duration = Duration::from_millis(100);

fn refused(status: Status) -> Failure {
    Error::Call(status).into()
}

/// Sends the journal, and plays it to its end.
///
/// # Errors
/// Returns an error if the file can't be read, the server refuses it, or the connection breaks.
pub(crate) async fn play(arguments: &Arguments) -> Result<(), Failure> {
    let Arguments { file, from, to, speed, live, quiet, .. } = arguments;
    let bytes = std::fs::read(file).map_err(|e| Failure::Refused(format!("{}: {e}", file.display())))?;
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
            return Err(Failure::Refused(format!("{option}: must be from {least} to {last}, but is {step}")));
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
    // Nothing of it happens before somebody can be told its name.
    let request =
        pb::CreateSessionRequest { source: Some(Source::Journal(moment)), paused: true, ..Default::default() };
    let session = sessions.create_session(request).await.map_err(refused)?.into_inner().session.unwrap_or_default();
    let id = session.session_id;
    if !arguments.json {
        crate::say!("palpate-client: session {id}, {}, from step {begin}", session.scene_name);
    }
    let started = pb::StartSessionRequest { session_id: id.clone(), until_step: (!live).then_some(end) };
    // Another server of the fleet may have the session by now, here and below.
    let mut at = At { server, channel, answer: () };
    let started = call(&mut at, |channel| {
        let request = started.clone();
        async move { SessionServiceClient::new(channel).start_session(request).await }
    });
    let played = match started.await {
        Err(failure) => Err(failure),
        Ok(_) if *live => Ok(begin),
        Ok(_) => {
            let bar = progress_bar("{elapsed_precise} [{wide_bar}] step {pos} of {len}", end, *quiet);
            let followed = tokio::select! {
                followed = follow(&mut at, &id, end, &bar) => followed,
                () = interrupted() => Err(Failure::Failed("interrupted".to_owned())),
            };
            bar.finish_and_clear();
            followed
        }
    };
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
        if let Err(Failure::Failed(why) | Failure::Refused(why)) = deleted.await {
            crate::warn(&format!("session {id} was not deleted: {why}"));
        }
    }
    let (step, hash) = (played?, hash?);
    if arguments.json {
        let hash = (!hash.is_empty()).then_some(hash);
        crate::tell!(
            "{}",
            serde_json::json!({ "session_id": id, "begin_step": begin, "end_step": step, "state_hash": hash })
        );
    } else if *live {
        table::print(&[("session", id), ("live from step", step.to_string())]);
    } else {
        table::print(&[("session", id), ("steps", format!("{begin} to {step}")), ("state hash", hash)]);
    }
    Ok(())
}

/// A call to whichever server of a fleet has the session.
async fn call<T, F>(at: &mut At<()>, call: impl Fn(Channel) -> F) -> Result<T, Failure>
where
    F: Future<Output = Result<tonic::Response<T>, Status>>,
{
    let At { server, channel, answer } = fleet::follow_from(&at.server, at.channel.clone(), call).await?;
    *at = At { server, channel, answer: () };
    Ok(answer.into_inner())
}

/// Waits until a session has done `end` steps. Returns how many it has done.
async fn follow(at: &mut At<()>, id: &str, end: u64, bar: &ProgressBar) -> Result<u64, Failure> {
    loop {
        let asked = pb::GetSessionRequest { session_id: id.to_owned() };
        let answer = call(at, |channel| {
            let request = asked.clone();
            async move { SessionServiceClient::new(channel).get_session(request).await }
        });
        let session = answer.await?.session.unwrap_or_default();
        bar.set_position(session.step);
        if !session.hold_reason.is_empty() {
            return Err(Failure::Failed(format!(
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
