//! Transfer of an intake to another server that continues its session: the leases, and what waits for its step.

use super::command::Due;
use super::input::Input;
use super::intake::Intake;
use super::lease::HandedLease;
use super::queue::Discarded;
use super::rules::{leased_tip, may_sever};
use crate::budget::{Purpose, Resource};
use palpate_refusal::Refusal;

/// Content of an intake when it was closed by [`Intake::hand_over`], for another server's [`Intake::adopt`].
#[derive(Debug, Default)]
pub struct Handed {
    /// Each held tool with its lease, by ascending number of the tool.
    pub leases: Vec<HandedLease>,
    /// Changes of the tissue, then commands and ends of leases; each kind in order of effect, and each entry with its
    /// step.
    pub waiting: Vec<(u64, Input)>,
}

impl Intake {
    /// Closes the intake, which refuses everything with `refusal` from now on, and returns its content and the
    /// discarded commands to be freed without the lock ([`Intake::close`]). What waited no longer counts as accepted
    /// here: it counts where the session continues. The rest of an unfinished batch is dropped.
    pub fn hand_over(&mut self, refusal: Refusal) -> (Handed, Discarded) {
        let leases = self.leases.handed();
        let changes = self.waiting_changes().into_iter().map(|(step, model)| (step, Input::Tissue(model)));
        let commands = self.queue.in_order().into_iter().map(|(key, due)| (key.0, Input::Command(due.clone())));
        let waiting: Vec<(u64, Input)> = changes.chain(commands).collect();
        let moved = self.queue.waiting() as u64;
        let discarded = self.close(refusal);
        self.counts.dropped -= moved;
        self.counts.accepted -= moved;
        (Handed { leases, waiting }, discarded)
    }

    /// Adds the content of another server's intake. The leases last their full duration from `now_ns`, ns, and
    /// sequence numbers of their commands start again; a tool that is held here gets the other lease. No account is
    /// charged for the tools ([`Intake::charge`]). Steps that have passed become the next one. Nothing is checked
    /// against limits, and a closed intake takes it too.
    ///
    /// Inputs for which the account has no memory are dropped, but never ends of leases; so are inputs that are
    /// neither commands nor changes. Returns the number of dropped inputs.
    pub fn adopt(&mut self, handed: Handed, now_ns: u64) -> usize {
        for lease in handed.leases {
            let tool = lease.tool;
            self.leases.adopt(lease, now_ns);
            self.take_tip(tool);
        }
        let commands = handed.waiting.iter().filter(|(_, input)| matches!(input, Input::Command(_))).count();
        let severs = |due: &Due| may_sever(&due.command.action);
        let is_severing = |(_, input): &(u64, Input)| matches!(input, Input::Command(due) if severs(due));
        let has_room = self.make_room(commands).is_ok();
        let may_cut = !handed.waiting.iter().any(is_severing) || self.charge_cuts("").is_ok();
        let mut dropped = 0;
        for (step, input) in handed.waiting {
            let step = step.max(self.next_step);
            match input {
                Input::Command(due) if due.ends_lease || has_room && (may_cut || !severs(&due)) => {
                    self.await_again(step, due, now_ns);
                }
                Input::Tissue(model) => {
                    let memory = Resource::Memory(Purpose::Change);
                    let taken =
                        self.account.as_ref().map(|account| account.take(memory, model.bytes(), "")).transpose();
                    match taken {
                        Ok(taken) => {
                            self.changes.push_back((step, model.clone(), taken));
                            self.changed_to = Some(model);
                        }
                        Err(_) => dropped += 1,
                    }
                }
                _ => dropped += 1,
            }
        }
        self.changed = true;
        dropped
    }

    /// Queues a command that has waited on another server.
    fn await_again(&mut self, step: u64, mut due: Due, now_ns: u64) {
        due.command.arrival_ns = now_ns;
        let key = (step, self.arrivals);
        self.arrivals += 1;
        if !due.ends_lease {
            self.counts.accepted += 1;
            if let Some(lease) = self.leases.get_mut(due.command.tool) {
                lease.leased_tip = leased_tip(lease.leased_tip, &due.command);
                lease.last_key = Some(key);
            }
        }
        self.queue.insert(key, due);
    }
}
