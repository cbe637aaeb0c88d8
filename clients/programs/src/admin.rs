//! `palpate-client admin`: shows the resources that callers use of a server, and frees them.

use palpate_client::{Channel, fleet};
use palpate_proto::pb;
use palpate_refusal::printable::printable;
use pb::admin_service_client::AdminServiceClient;
use pb::session_service_client::SessionServiceClient;

use crate::ClientFailure;
use crate::credentials::CredentialOptions;

/// Arguments of `admin`.
#[derive(clap::Args)]
pub(crate) struct AdminArguments {
    #[command(subcommand)]
    act: AdminAction,
    /// The server
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:7117", global = true)]
    server: String,
    #[command(flatten)]
    credentials: CredentialOptions,
}

#[derive(clap::Subcommand)]
enum AdminAction {
    /// Show the resources that each caller uses: memory, sessions, streams, tools, recent processor time
    Callers,
    /// Show the streams of a session: number, caller, age
    Streams {
        /// The session's ID, from `palpate-client top`
        session: String,
    },
    /// Release a tool, no matter which caller holds it; its effect ends at the next step
    FreeTool {
        /// The session's ID, from `palpate-client top`
        session: String,
        /// The tool's number
        tool: u32,
    },
    /// End a stream and release the tools that it holds
    CutStream {
        /// The session's ID, from `palpate-client top`
        session: String,
        /// The stream's number, from `streams`
        number: u64,
    },
    /// End all streams of a caller, release its tools and close its connections; it can come back while its token is
    /// valid
    CutCaller {
        /// The caller's name, from `callers`: token:NAME or address:IP
        caller: String,
        /// Also delete the sessions that it created
        #[arg(long)]
        delete_sessions: bool,
    },
    /// Recover a session in state HELD: paused at its step, the tissue at rest, all tools released
    Revive {
        /// The session's ID, from `palpate-client top`
        session: String,
    },
    /// Remove the journals of a session that has ended, with its mesh and all its inputs
    DeleteJournal {
        /// The session's ID, from `palpate journal list`
        session: String,
    },
    /// Delete a session and end all its streams
    Delete {
        /// The session's ID, from `palpate-client top`
        session: String,
    },
}

/// Performs the action and prints the result.
pub(crate) async fn admin(arguments: &AdminArguments) -> Result<(), ClientFailure> {
    let server = arguments.credentials.server(&arguments.server)?;
    let channel = server.connect().await?;
    // Another server of the fleet may have the session.
    let done = fleet::follow_from(&server, channel, |channel| act(&arguments.act, channel)).await;
    let done = done.map_err(|error| ClientFailure::Failed(error.to_string()))?;
    crate::tell!("{}", done.answer);
    Ok(())
}

async fn act(act: &AdminAction, channel: Channel) -> Result<String, tonic::Status> {
    let mut admin = AdminServiceClient::new(channel.clone());
    Ok(match act {
        AdminAction::Callers => callers(&admin.list_callers(pb::ListCallersRequest {}).await?.into_inner().callers),
        AdminAction::Streams { session } => {
            let request = pb::ListStreamsRequest { session_id: session.clone() };
            streams(&admin.list_streams(request).await?.into_inner().streams)
        }
        AdminAction::FreeTool { session, tool } => {
            admin.free_tool(pb::FreeToolRequest { session_id: session.clone(), tool: *tool }).await?;
            format!("tool {tool} is free")
        }
        AdminAction::CutStream { session, number } => {
            admin.cut_stream(pb::CutStreamRequest { session_id: session.clone(), number: *number }).await?;
            format!("stream {number} is cut")
        }
        AdminAction::CutCaller { caller, delete_sessions } => {
            let request = pb::CutCallerRequest { caller: caller.clone(), delete_sessions: *delete_sessions };
            let pb::CutCallerResponse { streams, tools, connections, sessions } =
                admin.cut_caller(request).await?.into_inner();
            format!("{streams} streams, {tools} tools, {connections} connections, {sessions} sessions ended")
        }
        AdminAction::Revive { session } => {
            let request = pb::ReviveSessionRequest { session_id: session.clone() };
            let step = admin.revive_session(request).await?.into_inner().step;
            format!("paused at step {step}")
        }
        AdminAction::DeleteJournal { session } => {
            let mut sessions = SessionServiceClient::new(channel);
            let request = pb::DeleteJournalRequest { session_id: session.clone() };
            let files = sessions.delete_journal(request).await?.into_inner().files;
            format!("{files} {} removed", if files == 1 { "file" } else { "files" })
        }
        AdminAction::Delete { session } => {
            let mut sessions = SessionServiceClient::new(channel);
            sessions.delete_session(pb::DeleteSessionRequest { session_id: session.clone() }).await?;
            "deleted".to_owned()
        }
    })
}

/// Returns a header and a line for each caller.
fn callers(callers: &[pb::CallerUse]) -> String {
    let head = format!("{:40} {:>8} {:>8} {:>8} {:>6} {:>6}", "caller", "MiB", "sessions", "streams", "tools", "cores");
    let line = |caller: &pb::CallerUse| {
        let pb::CallerUse { caller, memory_bytes, sessions, streams, tools, processor_share } = caller;
        let mib = memory_bytes >> 20;
        format!("{:40} {mib:>8} {sessions:>8} {streams:>8} {tools:>6} {processor_share:>6.3}", printable(caller))
    };
    std::iter::once(head).chain(callers.iter().map(line)).collect::<Vec<_>>().join("\n")
}

/// Returns a header and a line for each stream.
fn streams(streams: &[pb::StreamUse]) -> String {
    let head = format!("{:>6} {:14} {:40} {:>5} {:>9}", "number", "call", "caller", "tools", "open s");
    let line = |stream: &pb::StreamUse| {
        let pb::StreamUse { number, call, caller, holds_tools, age_s } = stream;
        let tools = if *holds_tools { "holds" } else { "-" };
        format!("{number:>6} {:14} {:40} {tools:>5} {age_s:>9.1}", printable(call), printable(caller))
    };
    std::iter::once(head).chain(streams.iter().map(line)).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_callers_act_on_no_terminal() {
        let name = || "a\x1b[2J\r\n\u{9b}\u{202e}z".to_owned();
        let caller = pb::CallerUse { caller: name(), ..Default::default() };
        let stream = pb::StreamUse { call: name(), caller: name(), ..Default::default() };
        for table in [callers(&[caller]), streams(&[stream])] {
            assert!(table.lines().count() == 2 && table.contains("a?[2J????z"), "{table:?}");
        }
    }
}
