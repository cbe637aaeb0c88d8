//! `palpate-client cluster`: shows the servers and sessions of a fleet, and moves sessions between servers.

use std::io::{ErrorKind, IsTerminal, Write};
use std::time::Duration;

use palpate_client::{Channel, Error, Server, fleet};
use palpate_proto::pb;
use palpate_refusal::printable::{printable, printable_json};
use pb::admin_service_client::AdminServiceClient;
use serde_json::{Value, json};
use tonic::Status;

use crate::credentials::CredentialOptions;
use crate::unanswered::Unanswered;
use crate::{ClientFailure, interrupted};

/// Arguments of `cluster`.
#[derive(clap::Args)]
pub(crate) struct ClusterArguments {
    #[command(subcommand)]
    act: ClusterAction,
    /// Any server of the fleet
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7117", global = true)]
    server: String,
    /// Print JSON instead of a table: an array of nodes or sessions; an object for `move`; an object on each line for
    /// `drain` and `top`
    #[arg(long, global = true)]
    json: bool,
    #[command(flatten)]
    credentials: CredentialOptions,
}

#[derive(clap::Subcommand)]
enum ClusterAction {
    /// Show the servers: name, URL, release, threads, load, sessions, whether they take new sessions
    Nodes,
    /// Show the sessions: for each its server, the revision of that ownership, and its stand-by server
    Sessions,
    /// Move a running session to another server; print the new server, and the time without steps
    Move {
        /// The session's ID, from `sessions`
        session: String,
        /// Name of the new server, from `nodes` [default: the one with the most room]
        node: Option<String>,
    },
    /// Move all sessions of a server to others; it then accepts no new sessions
    Drain {
        /// The server's name, from `nodes`
        node: String,
        /// Accept new sessions again; no session is moved
        #[arg(long)]
        stop: bool,
    },
    /// Show the servers once a second
    Top {
        /// Print one table and exit
        #[arg(long)]
        once: bool,
    },
}

/// Interval between two queries of the servers.
const EVERY: Duration = Duration::from_secs(1);

/// Time limit for an answer; a move has another.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(10);

/// Performs the action and prints the result.
///
/// # Errors
/// Returns an error if an argument is refused, if the server can't be reached or refuses, or if sessions could not be
/// moved.
pub(crate) async fn cluster(arguments: &ClusterArguments) -> Result<(), ClientFailure> {
    let ClusterArguments { act, json: is_json, .. } = arguments;
    let server = arguments.credentials.server(&arguments.server)?;
    let unreached = |why| ClientFailure::Failed(format!("{why}; --server names any server of the fleet"));
    let channel = server.connect().await.map_err(unreached)?;
    match act {
        ClusterAction::Nodes => {
            let nodes = nodes(&channel).await?;
            print(&if *is_json {
                format!("{}\n", printable_json(json_of(&nodes, node_json)))
            } else {
                nodes_table(&nodes)
            })
        }
        ClusterAction::Sessions => {
            let sessions = sessions(channel).await?;
            print(&if *is_json {
                format!("{}\n", printable_json(json_of(&sessions, session_json)))
            } else {
                sessions_table(&sessions)
            })
        }
        ClusterAction::Move { session, node } => {
            let request =
                pb::MoveSessionRequest { session_id: session.clone(), node: node.clone().unwrap_or_default() };
            let moved = fleet::follow_from(&server, channel, |channel| {
                let request = request.clone();
                async move { AdminServiceClient::new(channel).move_session(request).await }
            });
            let pb::MoveSessionResponse { ownership, gap_s } = moved.await?.answer.into_inner();
            let pb::Ownership { node, endpoint, revision, .. } = ownership.unwrap_or_default();
            print(&if *is_json {
                let moved = json!({
                    "session_id": session, "node": node, "endpoint": endpoint, "revision": revision, "gap_s": gap_s,
                });
                format!("{}\n", printable_json(moved))
            } else {
                let (node, gap_ms) = (printable(&node), 1e3 * gap_s);
                format!("session {session} is at {node} ({}) now; no step for {gap_ms:.0} ms\n", printable(&endpoint))
            })
        }
        ClusterAction::Drain { node, stop } => drain(&server, &channel, node, *stop, *is_json).await,
        ClusterAction::Top { once } => top(&channel, *once, *is_json).await,
    }
}

fn failed(status: Status) -> ClientFailure {
    Error::Call(status).into()
}

async fn within<T>(answer: impl Future<Output = Result<T, Status>>) -> Result<T, Status> {
    let silent = |_| Err(Status::unavailable(format!("no answer within {} s", ANSWER_TIMEOUT.as_secs())));
    tokio::time::timeout(ANSWER_TIMEOUT, answer).await.unwrap_or_else(silent)
}

/// Returns the servers, by name.
async fn nodes(channel: &Channel) -> Result<Vec<pb::Node>, ClientFailure> {
    look(channel).await.map_err(failed)
}

async fn look(channel: &Channel) -> Result<Vec<pb::Node>, Status> {
    let mut admin = AdminServiceClient::new(channel.clone());
    within(async { Ok(admin.list_nodes(pb::ListNodesRequest {}).await?.into_inner().nodes) }).await
}

/// Returns the sessions, by ID.
async fn sessions(channel: Channel) -> Result<Vec<pb::FleetSession>, ClientFailure> {
    let mut admin = AdminServiceClient::new(channel);
    let listed = async {
        let mut parts = admin.list_fleet_sessions(pb::ListFleetSessionsRequest {}).await?.into_inner();
        let mut sessions = Vec::new();
        while let Some(part) = within(parts.message()).await? {
            sessions.extend(part.sessions);
        }
        Ok(sessions)
    };
    listed.await.map_err(failed)
}

/// Moves all sessions of a server to others, or lets it accept new ones again.
async fn drain(server: &Server, channel: &Channel, node: &str, stop: bool, is_json: bool) -> Result<(), ClientFailure> {
    let nodes = nodes(channel).await?;
    let Some(found) = nodes.iter().find(|other| other.node == node) else {
        let names: Vec<String> = nodes.iter().map(|other| printable(&other.node)).collect();
        return Err(ClientFailure::Refused(format!("there is no server `{node}`; there are {}", names.join(", "))));
    };
    let mut admin = AdminServiceClient::new(server.at(&found.endpoint)?.connect().await?);
    let mut moves = admin.drain_node(pb::DrainNodeRequest { stop }).await.map_err(failed)?.into_inner();
    let (mut moved, mut stayed) = (0, 0);
    while let Some(told) = moves.message().await.map_err(failed)? {
        let pb::DrainNodeResponse { session_id, node, fault, left } = &told;
        let line = match (is_json, fault.is_empty()) {
            (true, _) => {
                printable_json(json!({ "session_id": session_id, "node": node, "fault": fault, "left": left }))
            }
            (false, true) => format!("{}  moved to {}; {left} left", printable(session_id), printable(node)),
            (false, false) => format!("{}  not moved: {}; {left} left", printable(session_id), printable(fault)),
        };
        *(if fault.is_empty() { &mut moved } else { &mut stayed }) += 1;
        // If the reader of the output is gone, the drain still continues.
        crate::tell!("{line}");
    }
    if stayed > 0 {
        return Err(ClientFailure::Failed(format!("{stayed} sessions of {node} could not be moved ({moved} moved)")));
    }
    if !is_json {
        let done =
            if stop { "takes new sessions again".to_owned() } else { format!("is drained: {moved} sessions moved") };
        crate::tell!("{node} {done}");
    }
    Ok(())
}

/// Shows the servers until it is interrupted or its output is closed.
async fn top(channel: &Channel, once: bool, is_json: bool) -> Result<(), ClientFailure> {
    let terminal = std::io::stdout().is_terminal() && !is_json && !once;
    let mut ticks = tokio::time::interval(EVERY);
    let mut unanswered = Unanswered::default();
    loop {
        tokio::select! {
            _ = ticks.tick() => {}
            () = interrupted() => return Ok(()),
        }
        let nodes = match look(channel).await {
            Ok(nodes) => nodes,
            // The channel reconnects by itself.
            Err(status) if unanswered.may_ask_again(&status) && !once => continue,
            Err(status) => return Err(failed(status)),
        };
        unanswered = Unanswered::default();
        let table = nodes_table(&nodes);
        print(&match (is_json, terminal) {
            (true, _) => format!("{}\n", printable_json(json!({ "nodes": json_of(&nodes, node_json) }))),
            (false, false) => table + if once { "" } else { "\n" },
            // Overwrites the last table in place, which does not flicker.
            (false, true) => format!("\x1b[H{}\x1b[J", table.replace('\n', "\x1b[K\n")),
        })?;
        if once {
            return Ok(());
        }
    }
}

fn print(text: &str) -> Result<(), ClientFailure> {
    let mut output = std::io::stdout();
    match output.write_all(text.as_bytes()).and_then(|()| output.flush()) {
        Ok(()) => Ok(()),
        Err(e) if e.kind() == ErrorKind::BrokenPipe => Err(ClientFailure::Unread),
        Err(e) => Err(ClientFailure::Failed(e.to_string())),
    }
}

fn json_of<T>(all: &[T], one: fn(&T) -> Value) -> Value {
    Value::Array(all.iter().map(one).collect())
}

fn node_json(node: &pb::Node) -> Value {
    let pb::Node { node, endpoint, version, replays, threads, load, sessions, draining } = node;
    json!({
        "node": node, "endpoint": endpoint, "version": version, "replays": replays, "threads": threads, "load": load,
        "sessions": sessions, "draining": draining,
    })
}

fn session_json(session: &pb::FleetSession) -> Value {
    let pb::FleetSession { session_id, ownership, served } = session;
    let pb::Ownership { endpoint, node, revision, standby, .. } = ownership.clone().unwrap_or_default();
    json!({
        "session_id": session_id, "node": node, "revision": revision, "standby": standby, "endpoint": endpoint,
        "served": served,
    })
}

fn nodes_table(nodes: &[pb::Node]) -> String {
    let head = ["node", "endpoint", "version", "threads", "load", "sessions", "state"].map(str::to_owned);
    let row = |node: &pb::Node| {
        let state = if node.draining { "draining" } else { "open" };
        let load = format!("{:.0} %", 100.0 * node.load);
        let (threads, sessions) = (node.threads.to_string(), node.sessions.to_string());
        [
            printable(&node.node),
            printable(&node.endpoint),
            printable(&node.version),
            threads,
            load,
            sessions,
            state.to_owned(),
        ]
    };
    aligned(std::iter::once(head).chain(nodes.iter().map(row)))
}

fn sessions_table(sessions: &[pb::FleetSession]) -> String {
    let head = ["session", "node", "revision", "standby", "endpoint"].map(str::to_owned);
    let row = |session: &pb::FleetSession| {
        let own = session.ownership.clone().unwrap_or_default();
        let or = |text: &str, none: &str| if text.is_empty() { none.to_owned() } else { printable(text) };
        let endpoint = if session.served { or(&own.endpoint, "-") } else { "(its server is gone)".to_owned() };
        [
            printable(&session.session_id),
            printable(&own.node),
            own.revision.to_string(),
            or(&own.standby, "-"),
            endpoint,
        ]
    };
    aligned(std::iter::once(head).chain(sessions.iter().map(row)))
}

/// Formats lines of cells in columns. Long cells are cut at the end, so that each column has a limited width.
fn aligned<const N: usize>(rows: impl Iterator<Item = [String; N]>) -> String {
    const MAX_LETTERS: usize = 128;
    let short = |cell: String| match cell.char_indices().nth(MAX_LETTERS) {
        Some((end, _)) => format!("{}…", &cell[..end]),
        None => cell,
    };
    let rows: Vec<[String; N]> = rows.map(|row| row.map(short)).collect();
    let width = |column: usize| rows.iter().map(|row| row[column].chars().count()).max().unwrap_or(0);
    let widths: [usize; N] = std::array::from_fn(width);
    let mut text = String::new();
    for row in &rows {
        let cells: Vec<String> = row.iter().zip(widths).map(|(cell, width)| format!("{cell:<width$}")).collect();
        text += cells.join("  ").trim_end();
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_session_is_an_object_and_a_line() {
        let own = pb::Ownership {
            endpoint: "http://127.0.0.1:7001".to_owned(),
            node: "a\u{1b}[2J".to_owned(),
            revision: 7,
            ..Default::default()
        };
        let served = pb::FleetSession { session_id: "5e".to_owned(), ownership: Some(own), served: true };
        let gone = pb::FleetSession { served: false, ..served.clone() };
        let expected = json!([{
            "session_id": "5e", "node": "a\u{1b}[2J", "revision": 7, "standby": "", "endpoint": "http://127.0.0.1:7001",
            "served": true,
        }]);
        assert_eq!(json_of(std::slice::from_ref(&served), session_json), expected);
        let table = sessions_table(&[served, gone]);
        let lines: Vec<Vec<&str>> = table.lines().map(|line| line.split_whitespace().collect()).collect();
        assert_eq!(lines[1], ["5e", "a?[2J", "7", "-", "http://127.0.0.1:7001"]);
        assert_eq!(lines[2][4..], ["(its", "server", "is", "gone)"]);
    }

    #[test]
    fn cells_are_one_below_the_other() {
        let rows = [["a", "long", ""], ["long", "b", "c"]].map(|row| row.map(str::to_owned));
        assert_eq!(aligned(rows.into_iter()), "a     long\nlong  b     c\n");
        let long = ["x".repeat(1 << 20), "b".to_owned()];
        assert_eq!(aligned([long].into_iter()).chars().count(), 128 + "…  b\n".chars().count());
    }
}
