//! A script of the server that is played in the session of a user of a load test, again and again: what it does, threads and clips too, is
//! done by tools behind those of the clients.

use std::sync::Arc;
use std::time::Duration;

use palpate_client::held_tools::{acquire, send};
use palpate_client::{Error, Followed};
use palpate_proto::pb;
use pb::session_service_client::SessionServiceClient;

use super::client::{Common, LoadStage, lock};

/// Largest number of commands of a script; one with more is refused.
const MAX_COMMANDS: usize = 200_000;

/// Time from a script's beginning to its first step, and how far ahead its commands are sent, s of simulated time.
const LEAD_S: f64 = 0.3;
const AHEAD_S: f64 = 1.0;

/// Largest number of commands that are sent at once, and time between two turns.
const BATCH: usize = 500;
const TURN: Duration = Duration::from_millis(200);

/// Time limit of a turn.
const TURN_TIMEOUT: Duration = Duration::from_secs(20);

/// A script as the commands that play it.
#[derive(Debug, Default)]
pub(crate) struct ScriptCommands {
    /// Number of its steps.
    steps: u64,
    /// It uses the tools 0 to this − 1.
    tools: u32,
    /// In the order of their steps, which count from its beginning.
    commands: Vec<pb::Command>,
}

impl ScriptCommands {
    /// Gets a script of the server, for the tissue of a session.
    ///
    /// # Errors
    /// Returns the server's refusal, how the connection broke, and [`Error::Argument`] for a script of more than [`MAX_COMMANDS`] commands.
    pub(crate) async fn get(session: &Followed, script_name: &str) -> Result<Self, Error> {
        let request =
            pb::GetScriptRequest { session_id: session.session_id().to_owned(), script_name: script_name.to_owned() };
        let parts = session.call(|channel| {
            let request = request.clone();
            async move { SessionServiceClient::new(channel).get_script(request).await }
        });
        let (mut parts, mut script) = (parts.await?.into_inner(), ScriptCommands::default());
        while let Some(part) = parts.message().await? {
            (script.steps, script.tools) = (part.steps, part.tools);
            script.commands.extend(part.commands);
            if script.commands.len() > MAX_COMMANDS {
                return Err(Error::Argument(format!("{script_name} has more than {MAX_COMMANDS} commands")));
            }
            if part.last {
                break;
            }
        }
        Ok(script)
    }

    /// Returns the commands from number `next` on, at most [`BATCH`], that are due before step `until` of the session if the script begins at
    /// step `begin`, for tools from `first_tool` on.
    fn due(&self, next: usize, begin: u64, until: u64, first_tool: u32) -> Vec<pb::Command> {
        let ours = self.commands.get(next..).unwrap_or_default().iter().take(BATCH);
        let at = |command: &pb::Command| begin.saturating_add(command.at_step.unwrap_or(0));
        let moved = |command: &pb::Command| pb::Command {
            tool: first_tool.saturating_add(command.tool),
            at_step: Some(at(command)),
            sequence: command.sequence.map(|sequence| begin.saturating_add(sequence)),
            ..command.clone()
        };
        ours.take_while(|command| at(command) < until).map(moved).collect()
    }
}

/// A script that is being played.
pub(crate) struct ScriptPlayer {
    common: Common,
    session: Followed,
    rate_hz: f64,
    script: Arc<ScriptCommands>,
    first_tool: u32,
    /// The lease of each tool, from the first on.
    leases: Vec<String>,
}

impl ScriptPlayer {
    /// Acquires the tools of a script, from `first_tool` on. `rate_hz` is that of the session's steps.
    ///
    /// # Errors
    /// Returns the server's refusal, or how the connection broke.
    pub(crate) async fn new(
        common: Common,
        session: Followed,
        rate_hz: f64,
        script: Arc<ScriptCommands>,
        first_tool: u32,
    ) -> Result<Self, Error> {
        let mut leases = Vec::new();
        for tool in 0..script.tools {
            leases.push(acquire(&session, first_tool.saturating_add(tool), "palpate-client load, script").await?);
        }
        Ok(ScriptPlayer { common, session, rate_hz, script, first_tool, leases })
    }

    /// Plays the script, from its beginning whenever it is over, until the measurement ends.
    pub(crate) async fn play(self) {
        // The number of the next command, and the step at which the script began.
        let (mut next, mut begin) = (0, None);
        while !self.common.stage.is(LoadStage::DRAIN) {
            let turn = tokio::time::timeout(TURN_TIMEOUT, self.turn(&mut next, &mut begin)).await;
            match turn.unwrap_or_else(|_| Err(Error::Connection("the server is silent".to_owned()))) {
                Ok(true) => tokio::time::sleep(TURN).await,
                Ok(false) => {}
                Err(error) => return lock(&self.common.tally).broke(format!("a script: {error}")),
            }
        }
    }

    /// Sends what is due, and renews the leases. Returns whether nothing more is due now.
    async fn turn(&self, next: &mut usize, begin: &mut Option<u64>) -> Result<bool, Error> {
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let steps = |time_s: f64| (time_s * self.rate_hz) as u64;
        let step = self.step().await?;
        if begin.is_some_and(|begin| *next >= self.script.commands.len() && step >= begin + self.script.steps) {
            (*next, *begin) = (0, None);
        }
        let from = *begin.get_or_insert(step + steps(LEAD_S));
        let due = self.script.due(*next, from, step + steps(AHEAD_S), self.first_tool);
        for (lease, tool) in self.leases.iter().zip(self.first_tool..) {
            let own: Vec<pb::Command> = due.iter().filter(|command| command.tool == tool).cloned().collect();
            send(&self.session, lease, own).await?;
        }
        *next += due.len();
        if self.common.stage.is(LoadStage::MEASURE) {
            lock(&self.common.tally).commands += due.len() as u64;
        }
        Ok(due.len() < BATCH)
    }

    /// Returns the number of steps that the session has done.
    async fn step(&self) -> Result<u64, Error> {
        let request = pb::GetSessionRequest { session_id: self.session.session_id().to_owned() };
        let asked = self.session.call(|channel| {
            let request = request.clone();
            async move { SessionServiceClient::new(channel).get_session(request).await }
        });
        Ok(asked.await?.into_inner().session.unwrap_or_default().step)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use pb::command::Action;

    fn command(tool: u32, at_step: u64, sequence: Option<u64>) -> pb::Command {
        let action = Some(Action::Release(pb::Release {}));
        pb::Command { tool, at_step: Some(at_step), sequence, action, ..Default::default() }
    }

    #[test]
    fn commands_are_due_at_the_steps_of_the_session_by_tools_behind_those_of_clients() {
        let commands = vec![command(0, 0, Some(1)), command(1, 5, None), command(0, 9, Some(10))];
        let script = ScriptCommands { steps: 12, tools: 2, commands };
        assert_eq!(script.due(0, 100, 105, 3), [command(3, 100, Some(101))]);
        assert_eq!(script.due(1, 100, 200, 3), [command(4, 105, None), command(3, 109, Some(110))]);
        assert_eq!(script.due(3, 100, 200, 3), []);
        let many = ScriptCommands { commands: vec![command(0, 0, None); BATCH + 1], ..script };
        assert_eq!((many.due(0, 0, 1, 0).len(), many.due(BATCH, 0, 1, 0).len()), (BATCH, 1));
    }
}
