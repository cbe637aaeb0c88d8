//! Commands to tools, before and after their step has come.

use palpate_tissue::scene::script::Action;

/// One command to one tool.
#[derive(Debug, Clone, PartialEq)]
pub struct Command {
    /// The tool's number.
    pub tool: u32,
    /// Must rise with each command to the tool. `None`: one more than that of the command before; the intake fills it in.
    pub sequence: Option<u64>,
    /// Time by the client's clock, returned with the sample that acknowledges the command.
    pub client_time_ns: u64,
    /// It came by datagram, so that later poses may have overtaken it: its sequence number need not rise. Of poses by client
    /// time only.
    pub by_datagram: bool,
    /// The step at whose beginning it takes effect; the next one if `None`.
    pub at_step: Option<u64>,
    /// Simulated time after which its action ends.
    pub time_to_live_s: Option<f64>,
    /// The action.
    pub action: Action,
    /// Arrival time by the server's clock.
    pub arrival_ns: u64,
}

impl Command {
    /// Creates a command that takes effect at once, and until the next one.
    pub fn new(tool: u32, sequence: Option<u64>, action: Action) -> Self {
        Command {
            tool,
            sequence,
            client_time_ns: 0,
            by_datagram: false,
            at_step: None,
            time_to_live_s: None,
            action,
            arrival_ns: 0,
        }
    }
}

/// A command whose step has come.
#[derive(Debug, Clone, PartialEq)]
pub struct Due {
    /// The command.
    pub command: Command,
    /// Whether it was meant for an earlier step.
    pub late: bool,
    /// Number of late commands that it represents: itself, and those that it has superseded.
    pub late_commands: u64,
    /// Not a client's command: it ends a lease and all actions of its holder with the tool.
    pub ends_lease: bool,
}

impl Due {
    /// Creates a client's command that came in time.
    pub fn in_time(command: Command) -> Self {
        Due { command, late: false, late_commands: 0, ends_lease: false }
    }
}
