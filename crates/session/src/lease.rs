//! Leases: which client holds which tool, and until when. Time is an argument.

use std::collections::BTreeMap;

use super::rules::LeasedTip;
use crate::budget::{Account, Taken};
use palpate_refusal::{Reason, Refusal, Result, label, number};
use palpate_tissue::limits::Limits;

/// ID of a lease, which gives the right to command its tools. A server chooses it at random, so that it can't be
/// guessed.
pub type LeaseId = u128;

/// One tool of a lease.
#[derive(Debug)]
pub(super) struct LeasedTool {
    pub(super) id: LeaseId,
    holder: String,
    duration_ns: u64,
    expires_ns: u64,
    pub(super) last_sequence: Option<u64>,
    /// The tip that the newest command gives the tool.
    pub(super) leased_tip: Option<LeasedTip>,
    /// Key of the tool's newest command in the queue.
    pub(super) last_key: Option<QueueKey>,
    /// Set while a batch of commands is put in the queue: the tool's commands from this arrival on wait for the
    /// rest of it.
    pub(super) batch_since: Option<u64>,
    /// What the holder's account is charged for this tool.
    charge: Option<Taken>,
}

/// A held tool with its lease, as a server hands it over with its session. Sequence numbers and the time until it
/// expires are left out: they begin again.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct HandedLease {
    /// The tool's number.
    pub tool: u32,
    /// ID of the lease that holds the tool.
    pub id: LeaseId,
    /// Name of the holder, for people.
    pub holder: String,
    /// Time without a command or renewal after which the lease expires, ns.
    pub duration_ns: u64,
    /// Name of the account that is charged for the tool; empty if none is.
    pub owner: String,
}

/// Key of a command in the queue: step, then order of arrival.
pub(super) type QueueKey = (u64, u64);

/// The leases of a session, by tool.
#[derive(Debug, Default)]
pub(super) struct Leases {
    held: BTreeMap<u32, LeasedTool>,
    expired: u64,
}

impl Leases {
    /// Gives all of `tools` to the lease `id`, or none. The lease expires after `lease_s` seconds without a command
    /// or renewal.
    ///
    /// # Errors
    /// Refuses tools that are unknown, named twice or held, and a holder name or a lease time out of range.
    pub(super) fn acquire(
        &mut self,
        tools: &[u32],
        holder: &str,
        lease_s: f64,
        id: LeaseId,
        now_ns: u64,
        limits: &Limits,
    ) -> Result<()> {
        let longest_s = limits.lease_s;
        number("lease_s", lease_s, &format!("from 0.01 to {longest_s}"), |v| v >= 0.01 && v <= longest_s)?;
        label("holder", holder)?;
        for (index, tool) in tools.iter().enumerate() {
            if *tool >= limits.tools {
                let message = format!("must be below {}, but is {tool}", limits.tools);
                return Err(Refusal::new(Reason::OutOfRange, "tools", message));
            }
            if tools[..index].contains(tool) {
                return Err(Refusal::new(Reason::OutOfRange, "tools", format!("names tool {tool} twice")));
            }
            if let Some(lease) = self.held.get(tool) {
                let holder = if lease.holder.is_empty() { "another client" } else { &lease.holder };
                let message = format!("tool {tool} is held by `{holder}`");
                return Err(Refusal::new(Reason::ToolHeld, "tools", message));
            }
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let duration_ns = (lease_s * 1e9) as u64;
        for tool in tools {
            let lease = LeasedTool {
                id,
                holder: holder.to_owned(),
                duration_ns,
                expires_ns: now_ns.saturating_add(duration_ns),
                last_sequence: None,
                leased_tip: None,
                last_key: None,
                batch_since: None,
                charge: None,
            };
            self.held.insert(*tool, lease);
        }
        Ok(())
    }

    /// Returns the tools with the tips that their newest commands give them.
    pub(super) fn leased_tips(&self) -> impl Iterator<Item = (u32, Option<LeasedTip>)> + '_ {
        self.held.iter().map(|(tool, lease)| (*tool, lease.leased_tip))
    }

    /// Extends a lease by its duration from `now_ns`.
    ///
    /// # Errors
    /// Refuses an unknown or expired lease.
    pub(super) fn renew(&mut self, id: LeaseId, now_ns: u64) -> Result<()> {
        let mut is_held = false;
        for lease in self.of_mut(id) {
            lease.expires_ns = now_ns.saturating_add(lease.duration_ns);
            is_held = true;
        }
        if is_held { Ok(()) } else { Err(not_held()) }
    }

    /// Returns the tools of a lease.
    pub(super) fn tools_of(&self, id: LeaseId) -> impl Iterator<Item = u32> {
        self.held.iter().filter(move |lease| lease.1.id == id).map(|lease| *lease.0)
    }

    /// Returns the entries of a lease's tools.
    pub(super) fn of(&self, id: LeaseId) -> impl Iterator<Item = &LeasedTool> {
        self.held.values().filter(move |lease| lease.id == id)
    }

    /// Returns the entries of a lease's tools, to change them.
    pub(super) fn of_mut(&mut self, id: LeaseId) -> impl Iterator<Item = &mut LeasedTool> {
        self.held.values_mut().filter(move |lease| lease.id == id)
    }

    /// Returns the entry of a tool, if it is held.
    pub(super) fn get(&self, tool: u32) -> Option<&LeasedTool> {
        self.held.get(&tool)
    }

    /// Returns the entry of a tool, if it is held, to change it.
    pub(super) fn get_mut(&mut self, tool: u32) -> Option<&mut LeasedTool> {
        self.held.get_mut(&tool)
    }

    /// Removes a tool from its lease.
    pub(super) fn remove(&mut self, tool: u32) {
        self.held.remove(&tool);
    }

    /// Removes all leases.
    pub(super) fn clear(&mut self) {
        self.held.clear();
    }

    /// Removes and returns the tool whose lease expired first, with the time of that, ns, if it is at most `now_ns`,
    /// and counts it. Of several, the one with the lowest number is first.
    pub(super) fn take_expired(&mut self, now_ns: u64) -> Option<(u32, u64)> {
        let expired = self.held.iter().map(|(tool, lease)| (*tool, lease.expires_ns));
        let (tool, expires_ns) = expired.min_by_key(|lease| lease.1).filter(|lease| lease.1 <= now_ns)?;
        self.held.remove(&tool);
        self.expired += 1;
        Some((tool, expires_ns))
    }

    /// Returns the time at which the first lease expires, ns.
    pub(super) fn first_expiry_ns(&self) -> Option<u64> {
        self.held.values().map(|lease| lease.expires_ns).min()
    }

    /// Returns each held tool with the name of its holder.
    pub(super) fn holders(&self) -> impl Iterator<Item = (u32, &str)> {
        self.held.iter().map(|(tool, lease)| (*tool, lease.holder.as_str()))
    }

    /// Returns the number of tools so far whose lease expired.
    pub(super) fn expired(&self) -> u64 {
        self.expired
    }

    /// Returns the tools for which `chosen` holds, by number and by the account that is charged.
    pub(super) fn chosen(&self, chosen: impl Fn(u32, Option<&Account>) -> bool) -> Vec<u32> {
        let payer = |lease: &LeasedTool| lease.charge.as_ref().map(Taken::account).cloned();
        let is_chosen = |(tool, lease): &(&u32, &LeasedTool)| chosen(**tool, payer(lease).as_ref());
        self.held.iter().filter(is_chosen).map(|lease| *lease.0).collect()
    }

    /// Returns each held tool with its lease, for a server that continues the session.
    pub(super) fn handed(&self) -> Vec<HandedLease> {
        let of = |(tool, lease): (&u32, &LeasedTool)| HandedLease {
            tool: *tool,
            id: lease.id,
            holder: lease.holder.clone(),
            duration_ns: lease.duration_ns,
            owner: lease.charge.as_ref().map(|charge| charge.account().name().to_owned()).unwrap_or_default(),
        };
        self.held.iter().map(of).collect()
    }

    /// Adds a tool with the lease that another server gave it. Sequence numbers of its commands start again.
    pub(super) fn adopt(&mut self, lease: HandedLease, now_ns: u64) {
        let HandedLease { tool, id, holder, duration_ns, .. } = lease;
        let leased = LeasedTool {
            id,
            holder,
            duration_ns,
            expires_ns: now_ns.saturating_add(duration_ns),
            last_sequence: None,
            leased_tip: None,
            last_key: None,
            batch_since: None,
            charge: None,
        };
        self.held.insert(tool, leased);
    }

    /// Charges the tools of a lease to the account that took them: one of `charges` for each tool.
    pub(super) fn charge(&mut self, id: LeaseId, charges: Vec<Taken>) {
        self.of_mut(id).zip(charges).for_each(|(lease, charge)| lease.charge = Some(charge));
    }
}

/// Returns the refusal of a lease that holds nothing.
pub(super) fn not_held() -> Refusal {
    let message = "this lease holds no tool: it has expired or was released";
    Refusal::new(Reason::NotHolder, "lease_id", message)
}
