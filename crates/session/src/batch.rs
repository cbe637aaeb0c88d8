//! Batches of commands. A batch is accepted whole or not at all, and put in the queue in slices, so that no caller
//! waits long for the intake.

use smallvec::SmallVec;

use super::command::Command;
use super::intake::Intake;
use super::lease::LeaseId;
use super::rules::{CheckedCommands, LeasedTip, check_contact_work, check_tip, leased_tip, may_sever};
use palpate_refusal::{Reason, Refusal, Result};

/// Largest number of commands that one call of [`Intake::go_on`] puts in the queue.
pub const SLICE: usize = 256;

/// The commands of an accepted batch that are not in the queue yet. [`Intake::go_on`] puts them there; call it until
/// it returns false, because the lease accepts no other batch before that.
#[derive(Debug)]
#[must_use]
pub struct AcceptedBatch {
    id: LeaseId,
    commands: smallvec::IntoIter<[Command; 1]>,
}

/// What a batch brings to a tool, so far.
#[derive(Clone, Copy)]
struct ToolCommands {
    tool: u32,
    /// The last sequence number.
    sequence: u64,
    /// Number of commands.
    count: usize,
    /// The tip after them.
    leased_tip: Option<LeasedTip>,
}

/// What a batch brings to each of its tools, by ascending tool. A batch for one tool takes no memory of its own.
#[derive(Default)]
struct BatchTools(SmallVec<[ToolCommands; 1]>);

impl BatchTools {
    fn of(&self, tool: u32) -> Option<ToolCommands> {
        self.0.binary_search_by_key(&tool, |coming| coming.tool).ok().map(|at| self.0[at])
    }

    fn set(&mut self, coming: ToolCommands) {
        match self.0.binary_search_by_key(&coming.tool, |coming| coming.tool) {
            Ok(at) => self.0[at] = coming,
            Err(at) => self.0.insert(at, coming),
        }
    }
}

impl Intake {
    /// Accepts all of the commands, which [`Rules::check`](super::rules::Rules::check) has checked, or none, and
    /// renews the lease `id` from `now_ns`, ns. [`Intake::go_on`] puts them in the queue in slices, between which
    /// other callers may use the intake. No command of the batch takes effect before the last is in the queue. A
    /// command without a sequence number gets the previous one plus 1, or 0. An empty batch only renews.
    ///
    /// # Errors
    /// - The refusal with which the intake was closed.
    /// - [`Reason::OutOfTurn`]: an earlier batch of the lease is unfinished, or a pose has another tip than the tool
    ///   has in the tissue.
    /// - [`Reason::NotHolder`]: a tool is not held by this lease, for example because it has expired.
    /// - [`Reason::StaleSequence`]: a sequence number does not rise, and the command did not come by datagram.
    /// - [`Reason::TooLarge`]: the session's tips together exceed `limits.contact_work`.
    /// - [`Reason::QueueFull`]: more commands of a tool would wait than `limits.queued_commands_per_tool`.
    /// - [`Reason::Overloaded`] or [`Reason::TooLarge`]: the account has no memory for the commands, or for what a tip
    ///   severs (field `pose.tip`).
    pub fn accept(
        &mut self,
        id: LeaseId,
        CheckedCommands(mut commands): CheckedCommands,
        now_ns: u64,
    ) -> Result<AcceptedBatch> {
        self.check_open()?;
        self.release_expired(now_ns);
        if commands.is_empty() {
            self.renew(id, now_ns)?;
            return Ok(AcceptedBatch { id, commands: commands.into_iter() });
        }
        if self.leases.of(id).any(|lease| lease.batch_since.is_some()) {
            let message = "commands of this lease are being taken in: send them one call after another";
            return Err(Refusal::new(Reason::OutOfTurn, "", message));
        }
        let mut last = BatchTools::default();
        for command in &mut commands {
            let lease = self.leases.get(command.tool).filter(|lease| lease.id == id);
            let lease = lease.ok_or_else(|| {
                Refusal::new(Reason::NotHolder, "tool", format!("{} is not held by this client", command.tool))
            })?;
            let coming = last.of(command.tool);
            let before = coming.map(|coming| coming.sequence).or(lease.last_sequence);
            let sequence = command.sequence.unwrap_or_else(|| before.map_or(0, |before| before.saturating_add(1)));
            if let Some(before) = before.filter(|before| sequence <= *before && !command.by_datagram) {
                let message = format!("must be above {before}, the last one, but is {sequence}");
                return Err(Refusal::new(Reason::StaleSequence, "sequence", message));
            }
            command.sequence = Some(sequence);
            let before_tip = coming.map_or(lease.leased_tip, |coming| coming.leased_tip);
            let leased_tip = leased_tip(before_tip, command);
            check_tip(before_tip, leased_tip)?;
            if let (None, Some(now)) = (before_tip, leased_tip) {
                let of = |(tool, waiting)| last.of(tool).map_or(waiting, |coming| coming.leased_tip);
                let others = self.leases.leased_tips().filter(|(tool, _)| *tool != command.tool).filter_map(of);
                check_contact_work(&self.rules, self.substeps(), now, others)?;
            }
            let newest = before.map_or(sequence, |before| before.max(sequence));
            let count = coming.map_or(0, |coming| coming.count) + 1;
            last.set(ToolCommands { tool: command.tool, sequence: newest, count, leased_tip });
        }
        // A limit per tool, so that no holder fills the queue for the others.
        for ToolCommands { tool, count, .. } in &last.0 {
            let waiting = self.queue.waiting_of(*tool);
            if waiting + count > self.rules.limits.queued_commands_per_tool {
                let message = format!("{waiting} commands of tool {tool} wait for their step already");
                return Err(Refusal::new(Reason::QueueFull, "", message));
            }
        }
        if commands.iter().any(|command| may_sever(&command.action)) {
            self.charge_cuts("pose.tip")?;
        }
        self.make_room(commands.len())?;
        self.counts.accepted += commands.len() as u64;
        self.coming += commands.len();
        let arrivals = self.arrivals;
        for lease in self.leases.of_mut(id) {
            lease.batch_since = Some(arrivals);
        }
        self.renew(id, now_ns)?;
        Ok(AcceptedBatch { id, commands: commands.into_iter() })
    }

    /// Puts at most [`SLICE`] commands of a batch in the queue. Returns whether there are more. If the intake has
    /// been closed or a tool has been released since the batch was accepted, the commands concerned are dropped and
    /// counted.
    pub fn go_on(&mut self, batch: &mut AcceptedBatch) -> bool {
        let slice = batch.commands.len().min(SLICE);
        self.coming -= slice;
        for command in batch.commands.by_ref().take(slice) {
            let is_held = self.leases.get(command.tool).is_some_and(|lease| lease.id == batch.id);
            if is_held && self.closed.is_none() {
                self.enqueue(command, false);
            } else {
                self.counts.dropped += 1;
            }
        }
        if batch.commands.len() > 0 {
            return true;
        }
        for lease in self.leases.of_mut(batch.id) {
            lease.batch_since = None;
        }
        self.changed |= slice > 0;
        false
    }
}
