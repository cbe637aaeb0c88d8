//! Commands to tools, before and after their step is due.

use palpate_tissue::scene::script::Action;

/// A command to one tool: an action, with its order, its step and its lifetime. A client sends it; an intake queues
/// it.
#[derive(Debug, Clone, PartialEq)]
pub struct Command {
    /// The tool's number, below `limits.tools`.
    pub tool: u32,
    /// Sequence number, which must rise with each command to the tool under one lease. `None`: the previous number
    /// plus 1, or 0 for the first; the intake fills it in.
    pub sequence: Option<u64>,
    /// Client time, ns, returned with the sample that acknowledges the command; 0 for none. A pose with it and
    /// without `at_step` is played by this time.
    pub client_time_ns: u64,
    /// Whether it came by datagram, so that later poses may have overtaken it: its sequence number need not rise.
    /// Only for poses that are played by client time, and for releases in their place.
    pub by_datagram: bool,
    /// The step at whose beginning the command takes effect; `None` for the next step. If that step has passed, it
    /// acts at the next one and counts as late.
    pub at_step: Option<u64>,
    /// Simulated time after which the command's action ends, s, rounded up to whole steps; `None` for no limit. Any
    /// later command to the tool replaces it.
    pub time_to_live_s: Option<f64>,
    /// The action: push, grasp, pose or release.
    pub action: Action,
    /// Arrival time, ns of the server's clock; 0 if it did not arrive over a network.
    pub arrival_ns: u64,
}

impl Command {
    /// Creates a command that takes effect at the next step and lasts until the tool's next command. It has no client
    /// time and no arrival time.
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

/// A command whose step has come, or the end of a lease: an input of [`Session::advance`](super::Session::advance).
#[derive(Debug, Clone, PartialEq)]
pub struct Due {
    /// The command, with its sequence number.
    pub command: Command,
    /// Whether the command was meant for a step that had passed when it came.
    pub late: bool,
    /// Number of late commands that it represents: itself if it is late, and late ones that it has superseded.
    pub late_commands: u64,
    /// Whether it is not a client's command but the end of a lease, which ends all actions of the tool. Of `command`,
    /// only `tool` counts then.
    pub ends_lease: bool,
}

impl Due {
    /// Creates a client's command that came in time: not late, and not the end of a lease.
    pub fn in_time(command: Command) -> Self {
        Due { command, late: false, late_commands: 0, ends_lease: false }
    }
}
