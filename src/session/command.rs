//! Commands to tools and their intake: leases, sequence numbers, and the queue of commands that wait for their step.
//! Time is an argument.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use super::schedule::Schedule;
use crate::budget::{Account, Purpose, Resource, Taken};
use crate::limits::Limits;
use crate::refusal::{Reason, Refusal, Result};
use crate::scene::Scene;
use crate::scene::script::Action;
use crate::sheet::Model;
pub use batch::{Batch, SLICE};
use rules::tip_radius_m;
pub use rules::{Checked, Rules};

/// One command to one tool.
#[derive(Debug, Clone, PartialEq)]
pub struct Command {
    /// The tool's number.
    pub tool: u32,
    /// Must rise with each command to the tool.
    pub sequence: u64,
    /// Time by the client's clock, returned with the sample that acknowledges the command.
    pub client_time_ns: u64,
    /// The step at whose beginning it takes effect; the next one if `None`.
    pub at_step: Option<u64>,
    /// Simulated time after which its action ends.
    pub time_to_live_s: Option<f64>,
    /// The action.
    pub action: Action,
    /// Arrival time by the server's clock.
    pub arrival_ns: u64,
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

/// Identifies a lease. Random, so that it can't be guessed.
pub type LeaseId = u128;

#[derive(Debug)]
struct Lease {
    id: LeaseId,
    holder: String,
    duration_ns: u64,
    expires_ns: u64,
    last_sequence: Option<u64>,
    /// Radius of the tip by which the newest command leads the tool, m.
    tip_radius_m: Option<f64>,
    /// Number of commands of the tool in the queue.
    waiting: usize,
    /// Place of the tool's newest command in the queue.
    last_place: Option<Place>,
    /// A batch of commands is being taken in: those of the tool that came since this arrival wait for the rest of it.
    batch_since: Option<u64>,
    /// Counts it among those of who holds it.
    seat: Option<Taken>,
}

/// Place in the queue: step, then order of arrival.
type Place = (u64, u64);

/// Counts of the accepted commands by outcome: `accepted` is the sum of the others.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// Commands accepted.
    pub accepted: u64,
    /// Commands that took effect at their step.
    pub applied: u64,
    /// Commands replaced by a later place of the same tool before their step.
    pub superseded: u64,
    /// Commands whose lease or session ended before their step.
    pub dropped: u64,
    /// Commands that wait for their step.
    pub waiting: u64,
}

/// Takes in commands and holds them until their step.
#[derive(Debug)]
pub struct Intake {
    rules: Arc<Rules>,
    leases: BTreeMap<u32, Lease>,
    queue: BTreeMap<Place, Due>,
    /// Of those, commands of clients: counted as they come and go, for whoever asks.
    waiting: u64,
    /// Commands of batches that are not in the queue yet.
    coming: usize,
    /// Changes of tissue that wait for their step, by ascending step, and the memory of each.
    changes: VecDeque<(u64, Arc<Model>, Option<Taken>)>,
    /// Who pays for what waits here, and what was taken for commands.
    account: Option<Account>,
    taken: Option<Taken>,
    /// The last change accepted, if there was one.
    changed_to: Option<Arc<Model>>,
    arrivals: u64,
    next_step: u64,
    /// The session rests: its steps up to this one are skipped, not computed.
    resting: Option<(Schedule, u64)>,
    /// A command or change has arrived that may take effect earlier, and the session's thread was woken for it.
    changed: bool,
    woken: bool,
    lapsed: u64,
    /// Counts without the waiting commands.
    counts: Counts,
    closed: Option<Refusal>,
}

impl Intake {
    /// An intake for a session of `scene` that has not begun.
    pub fn new(scene: &Scene, limits: &Limits) -> Self {
        Intake {
            rules: Arc::new(Rules { scene: scene.clone(), limits: limits.clone() }),
            leases: BTreeMap::new(),
            queue: BTreeMap::new(),
            waiting: 0,
            coming: 0,
            changes: VecDeque::new(),
            account: None,
            taken: None,
            changed_to: None,
            arrivals: 0,
            next_step: 0,
            resting: None,
            changed: false,
            woken: false,
            lapsed: 0,
            counts: Counts::default(),
            closed: None,
        }
    }

    /// The memory of what waits is charged to `account`.
    #[must_use]
    pub fn charged_to(self, account: &Account) -> Self {
        Intake { account: Some(account.clone()), ..self }
    }

    /// Has the memory of `more` commands beside those that wait, or refuses.
    fn make_room(&mut self, more: usize) -> Result<()> {
        let bytes = bytes_of(self.queue.len() + self.coming + more);
        let Some(account) = self.account.as_ref().filter(|_| bytes > 0) else { return Ok(()) };
        match &mut self.taken {
            Some(taken) => taken.grow_to(bytes, ""),
            None => account.take(Resource::Memory(Purpose::Commands), bytes, "").map(|taken| self.taken = Some(taken)),
        }
    }

    /// Gives back what no longer waits.
    fn give_back(&mut self) {
        let bytes = bytes_of(self.queue.len() + self.coming);
        if let Some(taken) = self.taken.as_mut().filter(|taken| taken.amount() > bytes) {
            taken.shrink_to(bytes);
        }
    }

    /// Takes all of `tools` or none. The leases lapse after `lease_s` without a command or renewal.
    ///
    /// # Errors
    /// Refuses if the intake is closed, for tools that are unknown, named twice or held, and for a holder name or a lease
    /// time out of range.
    pub fn acquire(&mut self, tools: &[u32], holder: &str, lease_s: f64, id: LeaseId, now_ns: u64) -> Result<()> {
        self.check_open()?;
        self.lapse(now_ns);
        let longest_s = self.rules.limits.lease_s;
        crate::refusal::number("lease_s", lease_s, &format!("from 0.01 to {longest_s}"), |v| {
            v >= 0.01 && v <= longest_s
        })?;
        crate::refusal::label("holder", holder)?;
        for (index, tool) in tools.iter().enumerate() {
            if *tool >= self.rules.limits.tools {
                let message = format!("must be below {}, but is {tool}", self.rules.limits.tools);
                return Err(Refusal::new(Reason::OutOfRange, "tool", message));
            }
            if tools[..index].contains(tool) {
                return Err(Refusal::new(Reason::OutOfRange, "tools", format!("names tool {tool} twice")));
            }
            if let Some(lease) = self.leases.get(tool) {
                let holder = if lease.holder.is_empty() { "somebody" } else { &lease.holder };
                let message = format!("tool {tool} is held by `{holder}`");
                return Err(Refusal::new(Reason::ToolHeld, "tool", message));
            }
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let duration_ns = (lease_s * 1e9) as u64;
        for tool in tools {
            let lease = Lease {
                id,
                holder: holder.to_owned(),
                duration_ns,
                expires_ns: now_ns.saturating_add(duration_ns),
                last_sequence: None,
                tip_radius_m: None,
                waiting: 0,
                last_place: None,
                batch_since: None,
                seat: None,
            };
            self.leases.insert(*tool, lease);
        }
        self.changed = true;
        Ok(())
    }

    /// Extends a lease: its holder is alive.
    ///
    /// # Errors
    /// Refuses an unknown or lapsed lease.
    pub fn renew(&mut self, id: LeaseId, now_ns: u64) -> Result<()> {
        self.lapse(now_ns);
        let mut held = false;
        for lease in self.leases.values_mut().filter(|lease| lease.id == id) {
            lease.expires_ns = now_ns.saturating_add(lease.duration_ns);
            held = true;
        }
        if held { Ok(()) } else { Err(not_holder("no tool is held by this lease: it lapsed or was given back".into())) }
    }

    /// Releases every tool of a lease. Their actions end at the next step; waiting commands are dropped.
    ///
    /// # Errors
    /// Refuses an unknown or lapsed lease.
    pub fn release(&mut self, id: LeaseId) -> Result<()> {
        let tools: Vec<u32> = self.tools_of(id).collect();
        if tools.is_empty() {
            return Err(not_holder("no tool is held by this lease: it lapsed or was given back".into()));
        }
        for tool in tools {
            self.end(tool);
        }
        Ok(())
    }

    fn end(&mut self, tool: u32) {
        self.leases.remove(&tool);
        let waiting = self.waiting;
        self.queue.retain(|_, due| due.command.tool != tool);
        self.waiting = self.queue.values().filter(|due| !due.ends_lease).count() as u64;
        self.counts.dropped += waiting - self.waiting;
        self.give_back();
        let command = Command {
            tool,
            sequence: 0,
            client_time_ns: 0,
            at_step: None,
            time_to_live_s: None,
            action: Action::Release,
            arrival_ns: 0,
        };
        self.enqueue(command, true);
    }

    /// Ends the leases that have expired at `now_ns`. In a resting session, time passes without computed steps, but
    /// never past a step that has something waiting.
    pub fn lapse(&mut self, now_ns: u64) {
        if let Some((schedule, until)) = &self.resting {
            let until = self.first_waiting().map_or(*until, |step| step.min(*until));
            self.next_step = self.next_step.max(schedule.next_step(now_ns).min(until));
        }
        while let Some(tool) = self.leases.iter().find(|lease| lease.1.expires_ns <= now_ns).map(|lease| *lease.0) {
            self.lapsed += 1;
            self.end(tool);
        }
    }

    /// What commands have to keep to.
    pub fn rules(&self) -> Arc<Rules> {
        self.rules.clone()
    }

    /// Accepts all of `commands`, from the holder of `id`, or none.
    ///
    /// # Errors
    /// Refuses if the intake is closed, too many commands for the queue, tools that this lease does not hold, sequence
    /// numbers that do not rise, and what the checks of an action refuse.
    pub fn submit(&mut self, id: LeaseId, commands: Vec<Command>, now_ns: u64) -> Result<()> {
        self.check_open()?;
        let checked = self.rules.check(commands)?;
        let mut batch = self.accept(id, checked, now_ns)?;
        while self.go_on(&mut batch) {}
        Ok(())
    }

    fn enqueue(&mut self, command: Command, ends_lease: bool) {
        let step = command.at_step.map_or(self.next_step, |at| at.max(self.next_step));
        let late = command.at_step.is_some_and(|at| at < self.next_step);
        let mut late_commands = u64::from(late);
        let place = (step, self.arrivals);
        self.arrivals += 1;
        if let Some(lease) = self.leases.get_mut(&command.tool) {
            lease.last_sequence = Some(command.sequence);
            lease.tip_radius_m = tip_radius_m(&command);
            lease.waiting += 1;
            let last = lease.last_place.replace(place);
            // The latest position wins: it supersedes an earlier one that has not taken effect. This does not apply to
            // poses played by client time (`palpate_touch::path`), where each one counts.
            let is_place = |command: &Command| match command.action {
                Action::Grasp { .. } => true,
                Action::Lead { .. } => command.at_step.is_some() || command.client_time_ns == 0,
                Action::Push(_) | Action::Release => false,
            };
            if let Some(last) = last.filter(|last| last.0 == step && is_place(&command))
                && self.queue.get(&last).is_some_and(|due| is_place(&due.command))
                && let Some(superseded) = self.queue.remove(&last)
            {
                late_commands += superseded.late_commands;
                lease.waiting -= 1;
                self.waiting -= u64::from(!superseded.ends_lease);
                self.counts.superseded += 1;
            }
        }
        self.waiting += u64::from(!ends_lease);
        self.queue.insert(place, Due { command, late, late_commands, ends_lease });
        self.changed = true;
    }

    /// The first step for which something waits.
    fn first_waiting(&self) -> Option<u64> {
        let commands = self.queue.keys().next().map(|place| place.0);
        let changes = self.changes.front().map(|change| change.0);
        commands.into_iter().chain(changes).min()
    }

    /// The tissue after all accepted changes; `None` if there was none.
    pub fn changed_to(&self) -> Option<Arc<Model>> {
        self.changed_to.clone()
    }

    /// Accepts another tissue, made from `base`, for the beginning of step `at_step`, or of the next step. Returns the
    /// step, or `None` if [`Intake::changed_to`] is no longer `base`. Changes take effect in their order of arrival,
    /// and each is made from the one before it. Of several for one step the last one applies; it includes the others.
    ///
    /// # Errors
    /// Refuses if the intake is closed, for a step before that of a waiting change, and for too many waiting changes.
    pub fn change(
        &mut self,
        base: Option<&Arc<Model>>,
        model: &Arc<Model>,
        at_step: Option<u64>,
        now_ns: u64,
    ) -> Result<Option<u64>> {
        self.check_open()?;
        self.lapse(now_ns);
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

    /// The last tissue that is due at the beginning of step `step`, if there is one.
    pub fn take_change(&mut self, step: u64) -> Option<Arc<Model>> {
        let due = self.changes.partition_point(|change| change.0 <= step);
        self.changes.drain(..due).next_back().map(|change| change.1)
    }

    /// Begins a rest: the session has done `step` steps and could rest until step `until`. Returns the next step that
    /// must be computed, which is earlier than `until` if something waits here. The session then rests until
    /// [`Intake::take_due`] takes that step, unless it is the very next one.
    pub fn rest(&mut self, step: u64, until: u64, schedule: &Schedule) -> u64 {
        let waiting = self.first_waiting();
        let lapse = self.leases.values().map(|lease| lease.expires_ns).min().map(|ns| schedule.next_step(ns));
        let next = [waiting, lapse].into_iter().flatten().fold(until, u64::min).max(step);
        self.resting = (next > step).then_some((*schedule, next));
        self.next_step = self.next_step.max(step);
        (self.changed, self.woken) = (false, false);
        next
    }

    /// Whether the session rests.
    pub fn is_resting(&self) -> bool {
        self.resting.is_some()
    }

    /// Whether the thread of a resting session must be woken to call [`Intake::rest`] again. True once per wake.
    pub fn take_wake(&mut self) -> bool {
        let wake = self.changed && !self.woken && self.is_resting();
        self.woken |= wake;
        wake
    }

    /// Moves what is due at the beginning of step `step` into `due`, in order of effect.
    pub fn take_due(&mut self, step: u64, now_ns: u64, due: &mut Vec<Due>) {
        self.lapse(now_ns);
        self.resting = None;
        let mut from = (0, 0);
        while let Some((place, entry)) = self.queue.range(from..=(step, u64::MAX)).next() {
            let place = *place;
            if self.is_held_back(&place, entry) {
                from = (place.0, place.1 + 1);
                continue;
            }
            let Some(entry) = self.queue.remove(&place) else { break };
            if let Some(lease) = self.leases.get_mut(&entry.command.tool).filter(|_| !entry.ends_lease) {
                lease.waiting = lease.waiting.saturating_sub(1);
            }
            self.counts.applied += u64::from(!entry.ends_lease);
            self.waiting -= u64::from(!entry.ends_lease);
            due.push(entry);
        }
        self.give_back();
        self.next_step = step + 1;
    }

    /// The next step.
    pub fn next_step(&self) -> u64 {
        self.next_step
    }

    /// The tools of a lease.
    pub fn tools_of(&self, id: LeaseId) -> impl Iterator<Item = u32> {
        self.leases.iter().filter(move |lease| lease.1.id == id).map(|lease| *lease.0)
    }

    /// Each held tool and its holder.
    pub fn holders(&self) -> impl Iterator<Item = (u32, &str)> {
        self.leases.iter().map(|(tool, lease)| (*tool, lease.holder.as_str()))
    }

    /// Total number of tools whose lease lapsed.
    pub fn lapsed(&self) -> u64 {
        self.lapsed
    }

    /// Counts of the commands so far, by outcome.
    pub fn counts(&self) -> Counts {
        Counts { waiting: self.waiting + self.coming as u64, ..self.counts }
    }

    /// From now on refuses everything with `refusal`.
    pub fn close(&mut self, refusal: Refusal) {
        self.closed = Some(refusal);
        self.counts.dropped += self.waiting;
        self.queue.clear();
        self.waiting = 0;
        self.changes.clear();
        self.taken = None;
    }

    /// After that: as it was in the beginning, with the same tissue, and no tool held.
    pub fn reopen(&mut self) {
        self.closed = None;
        self.leases.clear();
    }

    /// Ends the leases of the tools for which `chosen` holds, by number and by who pays for them; tells how many.
    pub fn free(&mut self, chosen: impl Fn(u32, Option<&Account>) -> bool) -> usize {
        let payer = |lease: &Lease| lease.seat.as_ref().map(Taken::account).cloned();
        let tools: Vec<u32> = self
            .leases
            .iter()
            .filter(|(tool, lease)| chosen(**tool, payer(lease).as_ref()))
            .map(|lease| *lease.0)
            .collect();
        tools.iter().for_each(|tool| self.end(*tool));
        tools.len()
    }

    /// The tools of a lease are charged to who took them, one of `seats` each.
    pub fn seat(&mut self, id: LeaseId, seats: Vec<Taken>) {
        let leases = self.leases.values_mut().filter(|lease| lease.id == id);
        leases.zip(seats).for_each(|(lease, seat)| lease.seat = Some(seat));
    }

    fn check_open(&self) -> Result<()> {
        self.closed.clone().map_or(Ok(()), Err)
    }
}

/// Commands are charged in pieces of so many bytes, and the first of a session is its own: who has a few waiting at a
/// time, as most do, pays nothing.
const PIECE_BYTES: u64 = 64 << 10;

/// What so many commands are charged: they are in a tree, whose nodes are two thirds full.
fn bytes_of(commands: usize) -> u64 {
    let bytes = commands * size_of::<(Place, Due)>() * 3 / 2;
    (bytes as u64 / PIECE_BYTES) * PIECE_BYTES
}

fn not_holder(message: String) -> Refusal {
    Refusal::new(Reason::NotHolder, "lease_id", message)
}

mod batch;
mod rules;
#[cfg(test)]
mod tests;
