//! `palpate journal list`: the journals of a folder.

use std::fmt::Write as _;
use std::path::PathBuf;

use palpate_refusal::printable::{printable, printable_json};
use palpate_session::journal::file::{self, JournalFile};
use palpate_session::journal::{JournalReader, Survey, pb};
use serde::Serialize;

use super::super::Failure;
use super::output::{output, utc, written};

#[derive(clap::Args)]
pub(super) struct ListArguments {
    /// The folder: that of `palpate serve --journal`
    dir: PathBuf,
    /// Write JSON
    #[arg(long)]
    json: bool,
}

/// Kind of end of a journal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum JournalEnd {
    /// The session was deleted.
    Deleted,
    /// The server ended, and the session continues in the next run.
    Drained,
    /// It is a part of another journal.
    Cut,
    /// It was recovered.
    Recovered,
    /// Another server of the fleet has the session.
    Moved,
    /// A server is writing it, or was killed.
    Unfinished,
    /// A server is writing it or was killed, and its last batch is incomplete.
    Torn,
    /// It can't be read, or is damaged in the middle.
    Damaged,
}

#[derive(Serialize)]
struct ListRow {
    session_id: String,
    run: u64,
    file: PathBuf,
    bytes: u64,
    state: JournalEnd,
    #[serde(skip_serializing_if = "Option::is_none")]
    problem: Option<String>,
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    more: Option<More>,
}

#[derive(Serialize)]
struct More {
    scene: String,
    owner: String,
    version: String,
    begun: String,
    ended: String,
    begin_step: u64,
    /// The last step up to which it is complete.
    durable_step: u64,
    rate_hz: f64,
    inputs: u64,
    hashes: u64,
    snapshots: usize,
    torn_bytes: u64,
    sealed: bool,
}

fn state(survey: &Survey) -> JournalEnd {
    match survey.end.as_ref().map(pb::End::why) {
        Some(pb::Why::Deleted) => JournalEnd::Deleted,
        Some(pb::Why::Drained | pb::Why::Unspecified) => JournalEnd::Drained,
        Some(pb::Why::Cut) => JournalEnd::Cut,
        Some(pb::Why::Recovered) => JournalEnd::Recovered,
        Some(pb::Why::Moved) => JournalEnd::Moved,
        None if survey.torn_bytes > 0 => JournalEnd::Torn,
        None => JournalEnd::Unfinished,
    }
}

fn row(JournalFile { session_id, run, path }: JournalFile) -> ListRow {
    let bytes = std::fs::metadata(&path).map_or(0, |metadata| metadata.len());
    let read = JournalReader::open(&path).and_then(|reader| {
        let mut reader = reader.up_to_damage();
        let survey = reader.survey(&mut |_| {})?;
        let header = reader.header();
        let more = More {
            scene: header.scene.as_ref().map(|scene| scene.name.clone()).unwrap_or_default(),
            owner: header.owner.clone(),
            version: header.version.clone(),
            begun: utc(survey.unix_ns[0]),
            ended: utc(survey.unix_ns[1]),
            begin_step: header.begin_step,
            durable_step: survey.until_step,
            rate_hz: header.rate_hz,
            inputs: survey.inputs,
            hashes: survey.hashes,
            snapshots: survey.snapshots.len(),
            torn_bytes: survey.torn_bytes,
            sealed: survey.sealed,
        };
        Ok((state(&survey), survey.damage, more))
    });
    let (state, problem, more) = match read {
        Ok((_, Some(damage), more)) => (JournalEnd::Damaged, Some(damage), Some(more)),
        Ok((state, None, more)) => (state, None, Some(more)),
        Err(refusal) => (JournalEnd::Damaged, Some(refusal.message), None),
    };
    ListRow { session_id, run, file: path, bytes, state, problem, more }
}

/// Lists the journals of a folder.
pub(super) fn list(arguments: &ListArguments) -> Result<(), Failure> {
    let ListArguments { dir, json } = arguments;
    let files = file::list(dir).map_err(|e| {
        Failure::Refused(format!("{}: can't be read: {e}; give the folder of `palpate serve --journal`", dir.display()))
    })?;
    let rows = files.into_iter().map(row);
    let mut text = String::new();
    if *json {
        let rows: Vec<ListRow> = rows.collect();
        text = printable_json(serde_json::to_string_pretty(&rows).map_err(|e| Failure::Failed(e.to_string()))?) + "\n";
    } else {
        let head = ["session", "run", "state", "begun (UTC)", "from step", "durable step", "kB", "scene"];
        let [session, run, state, begun, from, durable, size, scene] = head;
        let _ =
            writeln!(text, "{session:<32} {run:>4} {state:<10} {begun:<19} {from:>10} {durable:>12} {size:>9} {scene}");
        for row in rows {
            let state = serde_json::to_value(row.state).ok().and_then(|name| name.as_str().map(str::to_owned));
            let _ =
                write!(text, "{:<32} {:>4} {:<10} ", printable(&row.session_id), row.run, state.unwrap_or_default());
            let _ = match (&row.more, &row.problem) {
                (Some(more), _) => writeln!(
                    text,
                    "{:<19} {:>10} {:>12} {:>9} {}",
                    &more.begun[..19.min(more.begun.len())],
                    more.begin_step,
                    more.durable_step,
                    row.bytes.div_ceil(1000),
                    printable(&more.scene)
                ),
                (None, problem) => writeln!(text, "{}", printable(problem.as_deref().unwrap_or_default())),
            };
        }
    }
    let mut out = output(None)?;
    written(out.write_all(text.as_bytes()).and_then(|()| out.flush()))
}
