//! Takes in a tool holder's commands, from the stream or by datagram.

use std::collections::BTreeMap;
use std::sync::Arc;

use palpate_haptics::datagram_health::ReceiveWindow;
use palpate_haptics::device::Device;
use palpate_proto::{datagram, instrument, pb};
use tracing::{debug, info};

use super::event::StreamEvent;
use crate::server::rate::Bucket;
use crate::server::session_instruments::Instruments;
use crate::server::traffic::Traffic;
use palpate_realtime::SessionHandle;
use palpate_realtime::clock::now_ns;
use palpate_realtime::queue::Writer;
use palpate_refusal::{Reason, Refusal, Result, number};
use palpate_session::command::Command;
use palpate_session::lease::LeaseId;
use palpate_session::led_instrument::LedInstrument;
use palpate_session::rules::Commands;
use palpate_session::wire;
use palpate_tissue::limits::Limits;
use palpate_tissue::lock::lock;
use palpate_tissue::scene::script::Action;

/// What the rate of a stream limits, for messages.
const COMMANDS: &str = "commands of this stream";

/// The holder of the tools of one lease: checks, limits and submits its commands.
pub(super) struct LeaseController {
    pub(super) handle: Arc<SessionHandle>,
    pub(super) lease: LeaseId,
    device: Option<Device>,
    traffic: Arc<Traffic>,
    commands: Bucket,
    instruments: Instruments,
    /// For each tool whose poses may arrive twice (by stream and by datagram): the sequence numbers that have
    /// arrived.
    seen: BTreeMap<u32, ReceiveWindow>,
}

/// Returns the command, or a refusal if its pose is outside the declared workspace.
fn within_reach(command: Command, handle: &SessionHandle, device: Option<&Device>) -> Result<Command> {
    if let (Action::Pose { place_m, .. }, Some(device)) = (&command.action, device) {
        // A device's origin is on the top of the tissue; other clients may have theirs in the middle.
        let shape = handle.model.shape();
        let away_m = place_m.distance(shape.top_m()).min(place_m.distance(shape.extent().middle_m()));
        let range =
            format!("within {} m of the top or the middle of the tissue, the device's workspace", device.workspace_m);
        number("pose.position_m", away_m, &range, |away_m| away_m <= device.workspace_m)?;
    }
    Ok(command)
}

/// Returns whether a command may also arrive by datagram: a pose that is played back by the client's time.
fn may_overtake(command: &pb::Command) -> bool {
    use pb::command::Action as Message;
    let is_pose = matches!(command.action, Some(Message::Pose(_) | Message::Instrument(_)));
    is_pose && command.client_time_ns != 0 && command.at_step.is_none() && command.sequence.is_some()
}

impl LeaseController {
    /// Creates the controller of the tools of a lease. `by_datagram`: their poses may arrive by datagram as well.
    #[allow(clippy::cast_precision_loss, clippy::too_many_arguments)] // Its callers have them all.
    pub(super) fn new(
        handle: Arc<SessionHandle>,
        lease: LeaseId,
        tools: &[u32],
        device: Option<Device>,
        by_datagram: bool,
        limits: &Limits,
        traffic: Arc<Traffic>,
        instruments: Instruments,
    ) -> Self {
        // A rate per step and tool, and a burst of twice the number of commands that may wait.
        let seen = tools.iter().filter(|_| by_datagram).map(|tool| (*tool, ReceiveWindow::default())).collect();
        let tools = tools.len().max(1) as f64;
        let per_s = limits.commands_per_step * handle.model.scene.stepping.rate_hz * tools;
        let commands = Bucket::new(per_s, per_s.max(2.0 * limits.queued_commands_per_tool as f64 * tools));
        LeaseController { handle, lease, device, traffic, commands, instruments, seen }
    }

    /// Accepts a command of the stream. Sends a rejection to `events` if it is refused.
    ///
    /// # Errors
    /// Returns a refusal that ends the stream if commands arrive far too fast.
    pub(super) fn command(&mut self, command: &pb::Command, events: &Writer<StreamEvent>) -> Result<()> {
        let by_datagram = self.seen.contains_key(&command.tool) && may_overtake(command);
        // It may have arrived by datagram before.
        if by_datagram && !self.is_new(command) {
            return Ok(());
        }
        self.take(command, by_datagram, events)
    }

    /// Returns the rate limit of commands.
    pub(super) fn pace(&self) -> Bucket {
        self.commands.clone()
    }

    /// Accepts the poses of a datagram. Ignores one that can't be read.
    ///
    /// # Errors
    /// Returns a refusal that ends the stream if commands arrive far too fast.
    pub(super) fn datagram(&mut self, datagram: Result<pb::PosesDatagram>, events: &Writer<StreamEvent>) -> Result<()> {
        let Ok(message) = datagram else { return Ok(()) };
        let of_tools = message.tools.iter().flat_map(datagram::commands);
        for command in of_tools.chain(datagram::instrument_commands(&message)) {
            if may_overtake(&command) && self.is_new(&command) {
                self.take(&command, true, events)?;
            }
        }
        Ok(())
    }

    /// Counts another message of the client against the rate of commands.
    ///
    /// # Errors
    /// Refuses it if there are too many; the flag says whether that ends the stream.
    pub(super) fn message(&mut self, now_ns: u64) -> std::result::Result<(), (Refusal, bool)> {
        self.commands.take(now_ns, "messages of this stream").map_err(|refusal| (refusal, self.commands.is_abused()))
    }

    /// Accepts a command to a single tool.
    fn command_tool(&mut self, message: &pb::Command, by_datagram: bool, now: u64) -> Result<()> {
        self.commands.take(now, COMMANDS)?;
        let command = wire::command::from_command(message, self.handle.model.shape(), now)?;
        let command = within_reach(command, &self.handle, self.device.as_ref())?;
        self.handle.submit(self.lease, [Command { by_datagram, ..command }]).map(drop)
    }

    /// Accepts a command to an instrument: one to each of its tools, or none.
    fn lead(
        &mut self,
        instrument: &mut LedInstrument,
        message: &pb::Command,
        by_datagram: bool,
        now: u64,
    ) -> Result<()> {
        use pb::command::Action as Message;
        let first = instrument.first_tool();
        let refuse = |reason, field: &str, text: String| Err(Refusal::new(reason, field, text));
        if message.tool != first {
            let text = format!("is a tip of the instrument whose first tool is {first}: command that");
            return refuse(Reason::WrongKind, "tool", text);
        }
        let Some(sequence) = message.sequence else {
            return refuse(Reason::Missing, "sequence", "is missing: an instrument needs it".to_owned());
        };
        (0..instrument.instrument().tips.len()).try_for_each(|_| self.commands.take(now, COMMANDS))?;
        let command = wire::command::with_action(message, Action::Release, now);
        let command = Command { sequence: Some(sequence), by_datagram, ..command };
        match &message.action {
            Some(Message::Instrument(pose)) => {
                let (pose, velocity) = instrument::from_pose(pose, instrument.instrument())?;
                let commands = instrument.lead(&command, &pose, velocity.as_ref(), self.handle.model.shape());
                let reached = |command| within_reach(command, &self.handle, self.device.as_ref());
                let commands = commands.into_iter().map(reached).collect::<Result<Vec<Command>>>()?;
                let is_far = commands.iter().all(|command| command.action == Action::Release);
                self.handle.submit(self.lease, commands)?;
                instrument.accepted(&command, pose, velocity, is_far);
                Ok(())
            }
            Some(Message::Release(_)) => {
                let commands: Commands = instrument.release(&command).into_iter().collect();
                self.handle.submit(self.lease, commands)?;
                instrument.released();
                Ok(())
            }
            _ => refuse(Reason::WrongKind, "action", "must be `instrument` or `release` for an instrument".to_owned()),
        }
    }

    fn is_new(&mut self, command: &pb::Command) -> bool {
        // Commands to tools of other holders are refused in `take`.
        let seen = self.seen.get_mut(&command.tool).zip(command.sequence);
        seen.is_none_or(|(seen, sequence)| seen.take(sequence))
    }

    fn take(&mut self, message: &pb::Command, by_datagram: bool, events: &Writer<StreamEvent>) -> Result<()> {
        let now = now_ns();
        let instruments = self.instruments.clone();
        let taken = match lock(&instruments).iter_mut().find(|instrument| instrument.has(message.tool)) {
            Some(instrument) => self.lead(instrument, message, by_datagram, now),
            None => self.command_tool(message, by_datagram, now),
        };
        let handle = &self.handle;
        self.traffic.commanded(usize::from(taken.is_ok()));
        let Err(refusal) = taken else { return Ok(()) };
        handle.count_refused(1);
        self.traffic.refused(refusal.reason);
        debug!(session = %handle.id, reason = refusal.reason.as_str(), %refusal, "command refused");
        events.push(StreamEvent::Rejected(wire::sample::rejection(
            message.tool,
            message.sequence.unwrap_or_default(),
            &refusal,
        )));
        if self.commands.is_abused() {
            info!(session = %handle.id, "haptic stream ended: its commands come far too fast");
            return Err(refusal);
        }
        Ok(())
    }
}
