//! The intake of a session: commands and changes of the tissue wait here for their step. Time is an argument.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use super::Session;
use super::command::{Command, Due};
use super::lease::{LeaseId, Leases, QueueKey, not_held};
use super::queue::{Discarded, Queue};
use super::rules::{Commands, LeasedTip, Rules, leased_tip};
use super::schedule::Schedule;
use crate::budget::{Account, Purpose, Resource, Taken};
use palpate_refusal::{Reason, Refusal, Result};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Scene;
use palpate_tissue::scene::script::Action;

/// Counts of the accepted commands by outcome: `accepted` is the sum of the others. Ends of leases are not counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// Number of commands accepted so far.
    pub accepted: u64,
    /// Number that took effect at their step.
    pub applied: u64,
    /// Number that a later grasp or pose of the same tool for the same step replaced. Poses that are played by client
    /// time are never replaced.
    pub superseded: u64,
    /// Number whose lease or intake ended before their step.
    pub dropped: u64,
    /// Number that wait for their step now.
    pub waiting: u64,
}

/// Queue of a session's commands and changes of the tissue, with the leases of its tools.
///
/// The holder of a tool commands it. A command waits for its step; one from another client is refused, and changes
/// nothing:
///
/// ```
/// use palpate_refusal::Reason;
/// use palpate_session::command::Command;
/// use palpate_session::intake::Intake;
/// use palpate_tissue::limits::Limits;
/// use palpate_tissue::scene::script::Action;
/// use palpate_tissue::scene::{PAPER, Scene};
///
/// let limits = Limits::default();
/// let mut intake = Intake::new(&Scene::parse("paper", PAPER, &[], &limits)?, &limits);
/// // For 2 s from now on, or until the next command.
/// let (lease, other) = (1, 2);
/// intake.acquire(&[0], "a surgeon", 2.0, lease, 0)?;
/// let release = Command { at_step: Some(10), ..Command::new(0, Some(1), Action::Release) };
/// intake.submit(lease, vec![release.clone()], 0)?;
/// let refusal = intake.submit(other, vec![release], 0).expect_err("another holds the tool");
/// assert_eq!(refusal.reason, Reason::NotHolder);
/// let mut due = Vec::new();
/// intake.take_due(9, 0, &mut due);
/// assert!(due.is_empty());
/// intake.take_due(10, 0, &mut due);
/// assert!(due.len() == 1 && !due[0].late);
/// # Ok::<(), palpate_refusal::Refusal>(())
/// ```
#[derive(Debug)]
pub struct Intake {
    pub(super) rules: Arc<Rules>,
    pub(super) leases: Leases,
    pub(super) queue: Queue,
    /// Number of commands of accepted batches that are not in the queue yet.
    pub(super) coming: usize,
    /// Changes of the tissue that wait for their step, by ascending step, with the memory of each.
    pub(super) changes: VecDeque<(u64, Arc<Model>, Option<Taken>)>,
    /// Account that is charged for what waits, and the memory that was taken for commands.
    pub(super) account: Option<Account>,
    taken: Option<Taken>,
    /// The memory that severed springs may take, bytes (`Model::cut_bytes`), and once it was taken.
    cut_bytes: u64,
    cut_memory: Option<Taken>,
    /// The tissue after the last accepted change, if there was one.
    pub(super) changed_to: Option<Arc<Model>>,
    pub(super) arrivals: u64,
    pub(super) next_step: u64,
    /// The tips of tools that a continued session has in its tissue and that no client holds yet.
    leased_tips: BTreeMap<u32, LeasedTip>,
    /// The schedule of a resting session, and the step up to which steps are skipped and not computed.
    resting: Option<(Schedule, u64)>,
    /// Substeps per step of the first tissue; 0 if the session shares its thread with no other, so that the cost of
    /// tips is not limited.
    substeps: u32,
    /// Whether a command or change has arrived that may take effect earlier, and whether the session's thread was
    /// woken for it.
    pub(super) changed: bool,
    woken: bool,
    /// Counts without the waiting commands.
    pub(super) counts: Counts,
    pub(super) closed: Option<Refusal>,
}

impl Intake {
    /// Creates an intake for a session of `scene` that has not begun: without leases, and with step 0 as the next.
    /// Commands must keep to `limits`; their memory is not charged, and the work of tips is not limited.
    pub fn new(scene: &Scene, limits: &Limits) -> Self {
        Intake {
            rules: Arc::new(Rules::new(scene, limits)),
            leases: Leases::default(),
            queue: Queue::default(),
            coming: 0,
            changes: VecDeque::new(),
            account: None,
            taken: None,
            cut_bytes: 0,
            cut_memory: None,
            changed_to: None,
            arrivals: 0,
            next_step: 0,
            leased_tips: BTreeMap::new(),
            resting: None,
            substeps: 0,
            changed: false,
            woken: false,
            counts: Counts::default(),
            closed: None,
        }
    }

    /// Returns this intake for a tissue with `substeps` substeps per step, on a thread of several sessions. From now on
    /// it limits the work of the session's tips together: a pose whose tip would bring it above `limits.contact_work`
    /// is refused ([`Reason::TooLarge`], field `pose.tip.radius_m`). The work is the number of triangles looked up per
    /// step: it grows with the tips' radii and the substeps, and is 0 on a sheet. 0 substeps remove the limit.
    #[must_use]
    pub fn of_substeps(self, substeps: u32) -> Self {
        Intake { substeps, ..self }
    }

    /// Returns the substeps per step of the newest tissue; 0 if the cost of tips is not limited.
    pub(super) fn substeps(&self) -> u32 {
        let changed = self.changed_to.as_ref().filter(|_| self.substeps > 0);
        changed.map_or(self.substeps, |model| model.plan.substeps)
    }

    /// Returns this intake with an account: the memory of waiting commands and changes is charged to `account` from
    /// now on, whichever client sends them.
    #[must_use]
    pub fn charged_to(self, account: &Account) -> Self {
        Intake { account: Some(account.clone()), ..self }
    }

    /// Returns this intake for a tissue whose severed springs may take `cut_bytes` bytes
    /// ([`Model::cut_bytes`]). The account is charged for them with the first command by which a tool may sever
    /// springs, not before: most sessions are never cut.
    #[must_use]
    pub fn of_cut_bytes(self, cut_bytes: u64) -> Self {
        Intake { cut_bytes, ..self }
    }

    /// Charges the account for the memory of severed springs, if that was not done yet.
    ///
    /// # Errors
    /// [`Reason::Overloaded`] or [`Reason::TooLarge`]: the account has no memory for them.
    pub fn charge_cuts(&mut self, field: &str) -> Result<()> {
        let Some(account) = self.account.as_ref().filter(|_| self.cut_memory.is_none()) else { return Ok(()) };
        self.cut_memory = Some(account.take(Resource::Memory(Purpose::Session), self.cut_bytes, field)?);
        Ok(())
    }

    /// Returns this intake for a continued session, at that session's step. Its tissue is `changed_to`; `None` if it
    /// is still the first. A client that acquires a tool which is in the tissue already must lead it with the tip
    /// that it has.
    #[must_use]
    pub fn continued(self, session: &Session, changed_to: Option<Arc<Model>>) -> Self {
        let leased_tips = session.tips().map(|(tool, tip)| (tool, tip.into())).collect();
        Intake { next_step: session.step_count(), changed_to, leased_tips, ..self }
    }

    /// Takes the memory of `more` commands beside those that wait, or refuses.
    pub(super) fn make_room(&mut self, more: usize) -> Result<()> {
        let bytes = bytes_of(self.queue.len() + self.coming + more);
        let Some(account) = self.account.as_ref().filter(|_| bytes > 0) else { return Ok(()) };
        match &mut self.taken {
            Some(taken) => taken.grow_to(bytes, ""),
            None => account.take(Resource::Memory(Purpose::Commands), bytes, "").map(|taken| self.taken = Some(taken)),
        }
    }

    /// Frees some of the discarded commands, and gives their memory back.
    fn give_back(&mut self) {
        self.queue.free_some();
        let bytes = bytes_of(self.queue.len() + self.coming);
        if let Some(taken) = self.taken.as_mut().filter(|taken| taken.amount() > bytes) {
            taken.shrink_to(bytes);
        }
    }

    /// Gives all of `tools` to the lease `id`, or none. The lease expires after `lease_s` seconds without a command
    /// or renewal, counted from `now_ns`, ns; then its tools let go. `holder` is a name for people. A lease that
    /// holds tools already keeps them.
    ///
    /// # Errors
    /// - The refusal with which the intake was closed.
    /// - [`Reason::OutOfRange`]: `lease_s` is not from 0.01 to `limits.lease_s`; `holder` has more than 128 bytes or
    ///   a control character; a tool is not below `limits.tools` or is named twice.
    /// - [`Reason::ToolHeld`]: a lease, also this one, holds one of the tools.
    pub fn acquire(&mut self, tools: &[u32], holder: &str, lease_s: f64, id: LeaseId, now_ns: u64) -> Result<()> {
        self.check_open()?;
        self.release_expired(now_ns);
        self.leases.acquire(tools, holder, lease_s, id, now_ns, &self.rules.limits)?;
        tools.iter().for_each(|tool| self.take_tip(*tool));
        self.changed = true;
        Ok(())
    }

    /// Sets the tip of a tool that is acquired: the one that the tool has in the tissue of a continued session.
    pub(super) fn take_tip(&mut self, tool: u32) {
        let leased_tip = self.leased_tips.remove(&tool);
        if let Some(lease) = self.leases.get_mut(tool) {
            lease.leased_tip = leased_tip;
        }
    }

    /// Extends a lease by its full duration from `now_ns`, ns. Ends expired leases first.
    ///
    /// # Errors
    /// Refuses a lease that holds no tool: unknown, expired or released ([`Reason::NotHolder`]).
    pub fn renew(&mut self, id: LeaseId, now_ns: u64) -> Result<()> {
        self.release_expired(now_ns);
        self.leases.renew(id, now_ns)
    }

    /// Releases every tool of a lease. Their actions end at the next step, and their waiting commands are dropped. It
    /// also works on a closed intake.
    ///
    /// # Errors
    /// Refuses a lease that holds no tool: unknown, expired or released ([`Reason::NotHolder`]).
    pub fn release(&mut self, id: LeaseId) -> Result<()> {
        let tools: Vec<u32> = self.tools_of(id).collect();
        if tools.is_empty() {
            return Err(not_held());
        }
        for tool in tools {
            self.end(tool);
        }
        Ok(())
    }

    fn end(&mut self, tool: u32) {
        self.leases.remove(tool);
        self.counts.dropped += self.queue.discard(tool) as u64;
        self.enqueue(Command::new(tool, None, Action::Release), true);
    }

    /// Ends the leases that have expired at `now_ns`, ns, as [`Intake::release`] does, and frees some discarded
    /// commands. In a resting session it also advances the next step to that time, but never past a step for which
    /// something waits; a lease ends there at the step of its own time, however late this is called. Most functions
    /// with a `now_ns` call it.
    pub fn release_expired(&mut self, now_ns: u64) {
        while let Some((tool, expires_ns)) = self.leases.take_expired(now_ns) {
            self.advance_rest(expires_ns);
            self.end(tool);
        }
        self.advance_rest(now_ns);
        if self.queue.has_left_over() {
            self.give_back();
        }
    }

    /// Advances the next step of a resting session to the one after `now_ns`, ns, or to the first for which something
    /// waits.
    fn advance_rest(&mut self, now_ns: u64) {
        if let Some((schedule, until)) = &self.resting {
            let until = self.first_waiting().map_or(*until, |step| step.min(*until));
            self.next_step = self.next_step.max(schedule.next_step(now_ns).min(until));
        }
    }

    /// Returns the rules that commands must keep to, for checks without locking the intake.
    pub fn rules(&self) -> Arc<Rules> {
        self.rules.clone()
    }

    /// Accepts all of `commands`, from the holder of the lease `id`, or none, and renews the lease from `now_ns`, ns.
    /// They are in the queue when it returns.
    ///
    /// # Errors
    /// Returns the refusals of [`Rules::check`] (too many commands, an action that breaks a rule) and of
    /// [`Intake::accept`] (closed intake, tools that this lease does not hold, an unfinished batch, sequence numbers
    /// that do not rise, another tip, tips with too much work, a full queue, missing memory).
    pub fn submit(&mut self, id: LeaseId, commands: impl Into<Commands>, now_ns: u64) -> Result<()> {
        self.check_open()?;
        let checked = self.rules.check(commands)?;
        let mut batch = self.accept(id, checked, now_ns)?;
        while self.go_on(&mut batch) {}
        Ok(())
    }

    pub(super) fn enqueue(&mut self, command: Command, ends_lease: bool) {
        let step = command.at_step.map_or(self.next_step, |at| at.max(self.next_step));
        let late = command.at_step.is_some_and(|at| at < self.next_step);
        let mut late_commands = u64::from(late);
        let key = (step, self.arrivals);
        self.arrivals += 1;
        if let Some(lease) = self.leases.get_mut(command.tool) {
            lease.last_sequence = lease.last_sequence.max(command.sequence);
            lease.leased_tip = leased_tip(lease.leased_tip, &command);
            let last = lease.last_key.replace(key);
            // The latest position wins: it supersedes an earlier one that has not taken effect. This does not apply
            // to poses that are played by client time (`palpate_haptics::pose_playback`), where each one counts.
            let is_position = |command: &Command| match command.action {
                Action::Grasp { .. } => true,
                Action::Pose { .. } => command.at_step.is_some() || command.client_time_ns == 0,
                Action::Push(_) | Action::Tie { .. } | Action::Mark(_) | Action::Release => false,
            };
            if let Some(last) = last.filter(|last| last.0 == step && is_position(&command))
                && let Some(superseded) = self.queue.remove_if(command.tool, last, |due| is_position(&due.command))
            {
                late_commands += superseded.late_commands;
                self.counts.superseded += 1;
            }
        }
        self.queue.insert(key, Due { command, late, late_commands, ends_lease });
        self.changed = true;
    }

    /// Returns the first step for which something waits.
    fn first_waiting(&self) -> Option<u64> {
        let commands = self.queue.first_step();
        let changes = self.changes.front().map(|change| change.0);
        commands.into_iter().chain(changes).min()
    }

    /// Returns the tissue after all accepted changes, waiting or not; `None` if there was none, so that the tissue is
    /// the first.
    pub fn changed_to(&self) -> Option<Arc<Model>> {
        self.changed_to.clone()
    }

    /// Accepts another tissue, which was made from `base`, for the beginning of step `at_step`, or of the next step
    /// if that is later or `at_step` is `None`. Returns the step. Returns `None`, and accepts nothing, if
    /// [`Intake::changed_to`] is no longer `base` (the same pointer): then make the tissue again. Changes take effect
    /// in their order of arrival; one for the step of the last waiting change replaces that one, because it includes
    /// it.
    ///
    /// # Errors
    /// - The refusal with which the intake was closed.
    /// - [`Reason::OutOfTurn`]: a waiting change has a later step.
    /// - [`Reason::QueueFull`]: `limits.queued_changes` changes wait.
    /// - [`Reason::Overloaded`] or [`Reason::TooLarge`]: the account has no memory for the tissue.
    pub fn change(
        &mut self,
        base: Option<&Arc<Model>>,
        model: &Arc<Model>,
        at_step: Option<u64>,
        now_ns: u64,
    ) -> Result<Option<u64>> {
        self.check_open()?;
        self.release_expired(now_ns);
        if self.changed_to.as_ref().map(Arc::as_ptr) != base.map(Arc::as_ptr) {
            return Ok(None);
        }
        let step = at_step.unwrap_or(0).max(self.next_step);
        let last = self.changes.back().map(|change| change.0);
        if let Some(last) = last.filter(|last| *last > step) {
            let message = format!("is {step}, but a change of the tissue waits for step {last}: they act in order");
            return Err(Refusal::new(Reason::OutOfTurn, "at_step", message));
        }
        let replaces = last == Some(step);
        if !replaces && self.changes.len() >= self.rules.limits.queued_changes {
            let message = format!("{} changes of the tissue wait for their step already", self.changes.len());
            return Err(Refusal::new(Reason::QueueFull, "", message));
        }
        let account = self.account.as_ref();
        let taken =
            account.map(|account| account.take(Resource::Memory(Purpose::Change), model.bytes(), "")).transpose()?;
        if replaces {
            self.changes.pop_back();
        }
        self.changes.push_back((step, model.clone(), taken));
        self.changed_to = Some(model.clone());
        self.changed = true;
        Ok(Some(step))
    }

    /// Returns copies of the changes of the tissue that wait, each with its step, by ascending step; each step occurs
    /// once.
    pub fn waiting_changes(&self) -> Vec<(u64, Arc<Model>)> {
        self.changes.iter().map(|(step, model, _)| (*step, model.clone())).collect()
    }

    /// Removes the changes that are due at the beginning of step `step` or earlier, and returns the last of them,
    /// which includes the others; `None` if none is due.
    pub fn take_change(&mut self, step: u64) -> Option<Arc<Model>> {
        let due = self.changes.partition_point(|change| change.0 <= step);
        self.changes.drain(..due).next_back().map(|change| change.1)
    }

    /// Begins a rest: the session has done `step` steps and could rest until step `until`; `schedule` has the times
    /// of its steps. Returns the next step that must be computed, which is earlier than `until` if a command, a
    /// change or the end of a lease comes before. The session then rests until [`Intake::take_due`] takes that step,
    /// unless it is the very next one, `step`.
    pub fn rest(&mut self, step: u64, until: u64, schedule: &Schedule) -> u64 {
        let waiting = self.first_waiting();
        let expiry = self.leases.first_expiry_ns().map(|ns| schedule.next_step(ns));
        let next = [waiting, expiry].into_iter().flatten().fold(until, u64::min).max(step);
        self.resting = (next > step).then_some((*schedule, next));
        self.next_step = self.next_step.max(step);
        (self.changed, self.woken) = (false, false);
        next
    }

    /// Returns whether the session rests: from [`Intake::rest`] with a later step until [`Intake::take_due`].
    pub fn is_resting(&self) -> bool {
        self.resting.is_some()
    }

    /// Returns whether the thread of a resting session must be woken to call [`Intake::rest`] again, because a
    /// command, a change or a lease has come since. It returns true at most once for each rest.
    pub fn take_wake(&mut self) -> bool {
        let wake = self.changed && !self.woken && self.is_resting();
        self.woken |= wake;
        wake
    }

    /// Appends the commands and ends of leases that are due at the beginning of step `step` or earlier to `due`, by
    /// step and then by arrival. Ends the leases that have expired at `now_ns`, ns, first, and a rest. Commands of a
    /// batch that is not wholly in the queue stay. Step `step` + 1 is the next one afterwards.
    pub fn take_due(&mut self, step: u64, now_ns: u64, due: &mut Vec<Due>) {
        self.release_expired(now_ns);
        self.resting = None;
        let leases = &self.leases;
        let is_held_back = |key: &QueueKey, due: &Due| {
            let lease = leases.get(due.command.tool).filter(|_| !due.ends_lease);
            lease.and_then(|lease| lease.batch_since).is_some_and(|since| key.1 >= since)
        };
        self.counts.applied += self.queue.take_due(step, is_held_back, due) as u64;
        self.give_back();
        self.next_step = step + 1;
    }

    /// Returns the number of the next step: commands for earlier steps act at this one, and count as late.
    pub fn next_step(&self) -> u64 {
        self.next_step
    }

    /// Returns the tools of a lease, by ascending number; empty for an unknown or expired one. It does not end leases
    /// that have expired since the last call with a time.
    pub fn tools_of(&self, id: LeaseId) -> impl Iterator<Item = u32> {
        self.leases.tools_of(id)
    }

    /// Returns each held tool with the name of its holder, by ascending number of the tool. A name may be empty.
    pub fn holders(&self) -> impl Iterator<Item = (u32, &str)> {
        self.leases.holders()
    }

    /// Returns the number of tools so far whose lease expired; released ones do not count.
    pub fn expired(&self) -> u64 {
        self.leases.expired()
    }

    /// Returns the counts of the commands so far, by outcome. Commands of a batch that are not in the queue yet count
    /// as waiting.
    pub fn counts(&self) -> Counts {
        Counts { waiting: (self.queue.waiting() + self.coming) as u64, ..self.counts }
    }

    /// Refuses commands, new leases and changes with `refusal` from now on, until [`Intake::reopen`]. Discards
    /// everything that waits; leases stay. Returns the discarded commands: drop them without the lock, because
    /// freeing them takes time.
    pub fn close(&mut self, refusal: Refusal) -> Discarded {
        self.closed = Some(refusal);
        self.counts.dropped += self.queue.discard_all() as u64;
        self.changes.clear();
        self.taken = None;
        self.queue.take_left_over()
    }

    /// Opens a closed intake again, with its tissue. Removes all leases without releasing the tools in the session.
    /// On an open intake it also removes them.
    pub fn reopen(&mut self) {
        self.closed = None;
        self.leases.clear();
    }

    /// Ends the leases of the tools for which `chosen` holds, as [`Intake::release`] does. `chosen` gets the tool's
    /// number and the account that is charged for it, if any. Returns the number of tools.
    pub fn free(&mut self, chosen: impl Fn(u32, Option<&Account>) -> bool) -> usize {
        let tools = self.leases.chosen(chosen);
        tools.iter().for_each(|tool| self.end(*tool));
        tools.len()
    }

    /// Charges the tools of a lease to the account that took them: the first of `charges` for the tool with the
    /// lowest number, and so on. Each is given back when its tool is released; surplus ones are given back at once.
    pub fn charge(&mut self, id: LeaseId, charges: Vec<Taken>) {
        self.leases.charge(id, charges);
    }

    pub(super) fn check_open(&self) -> Result<()> {
        self.closed.clone().map_or(Ok(()), Err)
    }
}

/// Memory for commands is charged in pieces of this size, bytes; the first piece of a session is free, so a client
/// with few waiting commands pays nothing.
const PIECE_BYTES: u64 = 64 << 10;

/// Returns the bytes that are charged for this number of commands: they are in a tree, whose nodes are two thirds
/// full.
fn bytes_of(commands: usize) -> u64 {
    let bytes = commands * size_of::<(QueueKey, Due)>() * 3 / 2;
    (bytes as u64 / PIECE_BYTES) * PIECE_BYTES
}

#[cfg(test)]
mod tests;
