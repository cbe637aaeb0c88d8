//! `palpate-client top`: shows the sessions of a server once a second.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::{ErrorKind, IsTerminal, Write};
use std::time::{Duration, Instant};

use palpate_client::{Channel, describe};
use palpate_proto::pb::session_service_client::SessionServiceClient;
use palpate_proto::pb::{Audit, AuditedError, ListSessionsRequest, Session, SessionState, StageTime};
use palpate_refusal::printable::{printable, printable_json};
use serde_json::{Value, json};

use crate::ClientFailure;
use crate::credentials::{CredentialOptions, ServerOption};
use crate::unanswered::Unanswered;

/// Arguments of `top`.
#[derive(clap::Args)]
pub(crate) struct TopArguments {
    #[command(flatten)]
    server: ServerOption,
    /// Print one table, after a second, and exit
    #[arg(long)]
    once: bool,
    /// Print one JSON object per line instead of a table
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    credentials: CredentialOptions,
}

/// Time between two queries.
const EVERY: Duration = Duration::from_secs(1);

/// A session with its steps and overruns per second since the last query.
struct SessionRow {
    session: Session,
    steps_per_s: f64,
    overruns_per_s: f64,
    /// The time of each stage per step since the last query, µs; empty unless the server measures it.
    stages_us: Vec<(String, f64)>,
}

/// Steps and overruns of each session at a moment.
struct StepCounts {
    at: Instant,
    counts: BTreeMap<String, SessionCounts>,
}

/// The counts of a session from which rates follow.
struct SessionCounts {
    steps: u64,
    overruns: u64,
    stages: Vec<StageTime>,
}

/// Shows a server's sessions until it is interrupted or its output is closed.
pub(crate) async fn top(arguments: &TopArguments) -> Result<(), ClientFailure> {
    let server = arguments.credentials.server(arguments.server.url())?;
    let unreached =
        |why| ClientFailure::Failed(format!("{why}; `palpate serve` starts a server, --server names another"));
    let mut sessions = SessionServiceClient::new(server.connect().await.map_err(unreached)?);
    let terminal = std::io::stdout().is_terminal() && !arguments.json && !arguments.once;
    let (mut seen, mut unanswered) = (None, Unanswered::default());
    let mut ticks = tokio::time::interval(EVERY);
    loop {
        tokio::select! {
            _ = ticks.tick() => {}
            _ = tokio::signal::ctrl_c() => return Ok(()),
        }
        let looked = tokio::time::timeout(ANSWER_TIMEOUT, look(&mut sessions, seen.as_ref())).await;
        let silent = |_| Err(tonic::Status::unavailable(format!("no answer within {} s", ANSWER_TIMEOUT.as_secs())));
        let (rows, now) = match looked.unwrap_or_else(silent) {
            Ok(looked) => looked,
            // The channel reconnects by itself.
            Err(status) if unanswered.may_ask_again(&status) && !arguments.once => continue,
            Err(status) => return Err(ClientFailure::Failed(describe(&status))),
        };
        unanswered = Unanswered::default();
        // A rate needs two queries.
        if seen.replace(now).is_none() {
            continue;
        }
        let text = match (arguments.json, terminal) {
            (true, _) => format!("{}\n", printable_json(as_json(&rows))),
            (false, false) => table(arguments.server.url(), &rows, usize::MAX) + if arguments.once { "" } else { "\n" },
            // Overwrites the last table in place, which does not flicker.
            (false, true) => {
                let height = usize::from(console::Term::stdout().size().0);
                let table = table(arguments.server.url(), &rows, height.saturating_sub(4));
                format!("\x1b[H{}\x1b[J", table.replace('\n', "\x1b[K\n"))
            }
        };
        match std::io::stdout().write_all(text.as_bytes()).and_then(|()| std::io::stdout().flush()) {
            Err(e) if e.kind() == ErrorKind::BrokenPipe => return Err(ClientFailure::Unread),
            Err(e) => return Err(ClientFailure::Failed(e.to_string())),
            Ok(()) if arguments.once => return Ok(()),
            Ok(()) => {}
        }
    }
}

/// Time limit for an answer.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);

#[allow(clippy::cast_precision_loss)]
async fn look(
    sessions: &mut SessionServiceClient<Channel>,
    seen: Option<&StepCounts>,
) -> Result<(Vec<SessionRow>, StepCounts), tonic::Status> {
    let listed = sessions.list_sessions(ListSessionsRequest {}).await?.into_inner().sessions;
    let at = Instant::now();
    let counts = |session: &Session| SessionCounts {
        steps: session.step,
        overruns: session.overrun_count,
        stages: session.stages.clone(),
    };
    let counts = listed.iter().map(|session| (session.session_id.clone(), counts(session))).collect();
    let row = |session: Session| {
        // A new session has no rate yet.
        let Some((before, counts)) = seen.and_then(|seen| Some((seen.at, seen.counts.get(&session.session_id)?)))
        else {
            return SessionRow { session, steps_per_s: 0.0, overruns_per_s: 0.0, stages_us: Vec::new() };
        };
        let per_s = |count: u64| count as f64 / (at - before).as_secs_f64().max(1e-3);
        let steps = session.step.saturating_sub(counts.steps);
        let overruns_per_s = per_s(session.overrun_count.saturating_sub(counts.overruns));
        let stages = session.stages.iter().zip(&counts.stages);
        let us = |now: &StageTime, then: &StageTime| 1e6 * (now.time_s - then.time_s) / steps.max(1) as f64;
        let stages_us = stages.map(|(now, then)| (now.stage.clone(), us(now, then))).collect();
        SessionRow { steps_per_s: per_s(steps), overruns_per_s, stages_us, session }
    };
    Ok((listed.into_iter().map(row).collect(), StepCounts { at, counts }))
}

fn state(session: &Session) -> &'static str {
    match session.state() {
        SessionState::Running if session.resting => "resting",
        SessionState::Running => "running",
        SessionState::Paused => "paused",
        SessionState::Held => "held",
        SessionState::Unspecified => "?",
    }
}

fn as_json(rows: &[SessionRow]) -> Value {
    let one = |SessionRow { session, steps_per_s, overruns_per_s, stages_us }: &SessionRow| {
        let stages: serde_json::Map<_, _> = stages_us.iter().map(|(stage, us)| (stage.clone(), json!(us))).collect();
        let holders = session.held_tools.iter().map(|held| json!({ "tool": held.tool, "holder": held.holder }));
        json!({
            "session_id": session.session_id, "scene": session.scene_name, "state": state(session),
            "step": session.step, "steps_per_s": steps_per_s, "time_dilation": session.time_dilation,
            "points": session.points, "awake_points": session.awake_points,
            "overrun_count": session.overrun_count, "overruns_per_s": overruns_per_s,
            "late_commands": session.late_commands, "guard_events": session.guard_events,
            "recoveries": session.recovery_count,
            "durable_step": session.journal.as_ref().and_then(|journal| journal.durable_step),
            "journal_lag_s": session.journal.as_ref().map(|journal| journal.lag_s),
            "journal_fault": session.journal.as_ref().map(|journal| &journal.fault),
            "stages_us_per_step": stages,
            "audit": session.audit.as_ref().map(audit), "streams": session.streams, "held_tools": holders.collect::<Vec<_>>(), "hold_reason": session.hold_reason,
        })
    };
    json!({ "sessions": rows.iter().map(one).collect::<Vec<_>>() })
}

fn audit(audit: &Audit) -> Value {
    let error = |error: &AuditedError| json!({ "displacement": error.displacement, "force": error.force });
    json!({
        "windows": audit.windows, "step": audit.step, "newest_error": audit.newest_error.as_ref().map(error),
        "largest_error": audit.largest_error.as_ref().map(error),
        "windows_above_tolerance": audit.windows_above_tolerance, "reason": audit.reason,
        "corrections": audit.corrections,
    })
}

/// Returns a line of totals, a header, and a line for each session; if there are more than `most`, for the busiest.
fn table(server: &str, rows: &[SessionRow], most: usize) -> String {
    let count = |wanted: &str| rows.iter().filter(|row| state(&row.session) == wanted).count();
    // Not `sum()`: the sum of nothing is −0 and would be printed with its sign.
    let sum = |of: &dyn Fn(&SessionRow) -> f64| rows.iter().map(of).fold(0.0, |sum, value| sum + value);
    let mut text = format!(
        "{server}: {} sessions ({} running, {} resting, {} paused, {} held), {:.0} awake points, {:.0} steps/s, \
         {:.0} overruns/s\n\n",
        rows.len(),
        count("running"),
        count("resting"),
        count("paused"),
        count("held"),
        sum(&|row| f64::from(row.session.awake_points)),
        sum(&|row| row.steps_per_s),
        sum(&|row| row.overruns_per_s),
    );
    let _ = writeln!(
        text,
        "{:<32}  {:<12} {:<7} {:>10} {:>7} {:>8} {:>15} {:>8} {:>6} {:>8} {:>7}  held by",
        "session",
        "scene",
        "state",
        "step",
        "steps/s",
        "dilation",
        "awake/points",
        "overruns",
        "late",
        "error",
        "streams"
    );
    let mut rows: Vec<&SessionRow> = rows.iter().collect();
    if rows.len() > most {
        rows.sort_by_key(|row| std::cmp::Reverse((row.session.awake_points, row.session.streams)));
    }
    for SessionRow { session, steps_per_s, stages_us, .. } in rows.iter().take(most) {
        let holders: Vec<_> = session.held_tools.iter().map(|held| format!("{}: {}", held.tool, held.holder)).collect();
        let newest = session.audit.as_ref().and_then(|audit| audit.newest_error.as_ref());
        let error = newest.map_or("-".to_owned(), |error| format!("{:.1e}", error.displacement.max(error.force)));
        let awake = format!("{}/{}", session.awake_points, session.points);
        let _ = writeln!(
            text,
            "{:<32}  {:<12.12} {:<7} {:>10} {:>7.0} {:>8.4} {:>15} {:>8} {:>6} {:>8} {:>7}  {}",
            printable(&session.session_id),
            // Clients choose names freely.
            printable(&session.scene_name),
            state(session),
            session.step,
            steps_per_s,
            session.time_dilation,
            awake,
            session.overrun_count,
            session.late_commands,
            error,
            session.streams,
            printable(holders.join(", ")),
        );
        text += &stages(stages_us);
    }
    if rows.len() > most {
        let _ = writeln!(text, "and {} more", rows.len() - most);
    }
    text
}

/// Returns a line with the time of each stage of a step, largest first; empty without any.
fn stages(stages_us: &[(String, f64)]) -> String {
    let all_us = stages_us.iter().fold(0.0, |sum, (_, us)| sum + us);
    if all_us <= 0.0 {
        return String::new();
    }
    let mut stages: Vec<_> = stages_us.iter().filter(|(_, us)| *us > 0.0).collect();
    stages.sort_by(|a, b| b.1.total_cmp(&a.1));
    let share = |(stage, us): &&(String, f64)| format!("{} {:.0} %", printable(stage), 100.0 * us / all_us);
    format!("    {all_us:.1} µs a step: {}\n", stages.iter().map(share).collect::<Vec<_>>().join(", "))
}

#[cfg(test)]
mod tests {
    use palpate_proto::pb::HeldTool;

    use super::*;

    #[test]
    fn names_that_clients_choose_act_on_no_terminal() {
        let name = || "a\x1b[2J\r\n\u{9b}\u{202e}z".to_owned();
        let held_tools = vec![HeldTool { holder: name(), ..Default::default() }];
        let session = Session { session_id: name(), scene_name: name(), held_tools, ..Default::default() };
        let rows = [SessionRow {
            session,
            steps_per_s: 0.0,
            overruns_per_s: 0.0,
            stages_us: vec![("sweep".to_owned(), 3.0), ("contact".to_owned(), 1.0)],
        }];
        let table = table("here", &rows, 10);
        // A line for the stages, the longest first.
        assert!(table.lines().count() == 5 && table.matches("a?[2J????z").count() == 3, "{table:?}");
        assert!(table.ends_with("    4.0 µs a step: sweep 75 %, contact 25 %\n"), "{table:?}");
        let json = printable_json(as_json(&rows));
        assert!(json.lines().count() == 1 && !json.contains(['\x1b', '\u{9b}', '\u{202e}']), "{json:?}");
    }
}
