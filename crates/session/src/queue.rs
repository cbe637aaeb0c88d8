//! The commands that wait for their step, by tool, so that all commands of a tool can be discarded at once.

use std::collections::BTreeMap;

use super::command::Due;
use super::lease::QueueKey;

/// Commands that wait, by their key: step, then order of arrival. A single one takes no memory of its own: at 1 kHz a
/// command waits alone for the next step.
#[derive(Debug, Default)]
struct WaitingCommands {
    /// The only command; `None` if there are none or several.
    single: Option<(QueueKey, Due)>,
    /// Several commands; empty if there is one.
    several: BTreeMap<QueueKey, Due>,
}

impl WaitingCommands {
    fn len(&self) -> usize {
        self.several.len() + usize::from(self.single.is_some())
    }

    fn iter(&self) -> impl Iterator<Item = (&QueueKey, &Due)> {
        self.single.iter().map(|(key, due)| (key, due)).chain(&self.several)
    }

    fn insert(&mut self, key: QueueKey, due: Due) {
        if self.single.is_none() && self.several.is_empty() {
            self.single = Some((key, due));
        } else {
            self.several.extend(self.single.take());
            self.several.insert(key, due);
        }
    }

    /// Removes the command with a key, if `is_chosen` holds for it.
    fn remove_if(&mut self, key: QueueKey, is_chosen: impl Fn(&Due) -> bool) -> Option<Due> {
        if let Some((_, due)) = self.single.take_if(|(own, due)| *own == key && is_chosen(due)) {
            return Some(due);
        }
        self.several.get(&key).is_some_and(is_chosen).then(|| self.several.remove(&key))?
    }

    /// Moves the commands that are due at step `step` or earlier to `due`, except those for which `is_held_back` holds.
    fn take_due(&mut self, step: u64, is_held_back: &impl Fn(&QueueKey, &Due) -> bool, due: &mut Vec<(QueueKey, Due)>) {
        due.extend(self.single.take_if(|(key, due)| key.0 <= step && !is_held_back(key, due)));
        let mut from = (0, 0);
        while let Some((key, entry)) = self.several.range(from..=(step, u64::MAX)).next() {
            let key = *key;
            if is_held_back(&key, entry) {
                from = (key.0, key.1 + 1);
            } else if let Some(entry) = self.several.remove(&key) {
                due.push((key, entry));
            }
        }
    }
}

/// Commands that no longer take effect, as [`Intake::close`](super::intake::Intake::close) returns them. Dropping this
/// frees them, which takes time: do so without a lock.
#[derive(Debug, Default)]
pub struct Discarded(Vec<WaitingCommands>);

impl Discarded {
    /// Returns whether there is nothing to free.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}

/// The queue of waiting commands and ends of leases.
#[derive(Debug, Default)]
pub(super) struct Queue {
    /// Commands to the tools that are held.
    by_tool: BTreeMap<u32, WaitingCommands>,
    /// Ends of leases.
    endings: WaitingCommands,
    /// Commands of leases that have ended, by tool. [`Queue::free_some`] frees them piece by piece.
    discarded: Vec<WaitingCommands>,
    /// Number of commands in `by_tool`, and of those in `discarded`.
    waiting: usize,
    left_over: usize,
    /// Commands of all tools that are due, before they are sorted; kept for its buffer.
    due: Vec<(QueueKey, Due)>,
}

impl Queue {
    /// Returns the number of entries that take memory.
    pub(super) fn len(&self) -> usize {
        self.waiting + self.left_over + self.endings.len()
    }

    /// Returns the number of commands that wait.
    pub(super) fn waiting(&self) -> usize {
        self.waiting
    }

    /// Returns the number of commands of a tool that wait.
    pub(super) fn waiting_of(&self, tool: u32) -> usize {
        self.by_tool.get(&tool).map_or(0, WaitingCommands::len)
    }

    /// Adds an entry.
    pub(super) fn insert(&mut self, key: QueueKey, due: Due) {
        if due.ends_lease {
            self.endings.insert(key, due);
        } else {
            self.by_tool.entry(due.command.tool).or_default().insert(key, due);
            self.waiting += 1;
        }
    }

    /// Removes the command of a tool with a key, if `is_chosen` holds for it. Returns it.
    pub(super) fn remove_if(&mut self, tool: u32, key: QueueKey, is_chosen: impl Fn(&Due) -> bool) -> Option<Due> {
        let commands = self.by_tool.get_mut(&tool)?;
        let removed = commands.remove_if(key, is_chosen)?;
        self.waiting -= 1;
        Some(removed)
    }

    /// Discards the commands of a tool, to be freed later. Returns how many.
    pub(super) fn discard(&mut self, tool: u32) -> usize {
        let Some(commands) = self.by_tool.remove(&tool) else { return 0 };
        let count = commands.len();
        self.waiting -= count;
        self.left_over += count;
        self.discarded.push(commands);
        count
    }

    /// Discards everything, to be freed later. Returns the number of commands.
    pub(super) fn discard_all(&mut self) -> usize {
        let tools: Vec<u32> = self.by_tool.keys().copied().collect();
        self.endings = WaitingCommands::default();
        tools.into_iter().map(|tool| self.discard(tool)).sum()
    }

    /// Frees the memory of one tool's discarded commands, of which there are at most
    /// `limits.queued_commands_per_tool`.
    pub(super) fn free_some(&mut self) {
        if let Some(commands) = self.discarded.pop() {
            self.left_over -= commands.len();
        }
    }

    /// Returns all discarded commands, to be freed elsewhere.
    pub(super) fn take_left_over(&mut self) -> Discarded {
        self.left_over = 0;
        Discarded(std::mem::take(&mut self.discarded))
    }

    /// Returns whether there are discarded commands.
    pub(super) fn has_left_over(&self) -> bool {
        !self.discarded.is_empty()
    }

    /// Returns the first step for which something waits.
    pub(super) fn first_step(&self) -> Option<u64> {
        let all = self.by_tool.values().chain([&self.endings]);
        all.filter_map(|commands| commands.iter().next()).map(|(key, _)| key.0).min()
    }

    /// Appends everything that is due at the beginning of step `step` to `due`, in order of effect, except entries
    /// for which `is_held_back` holds. Returns the number of commands.
    pub(super) fn take_due(
        &mut self,
        step: u64,
        is_held_back: impl Fn(&QueueKey, &Due) -> bool,
        due: &mut Vec<Due>,
    ) -> usize {
        for commands in self.by_tool.values_mut().chain([&mut self.endings]) {
            commands.take_due(step, &is_held_back, &mut self.due);
        }
        let count = self.due.iter().filter(|(_, entry)| !entry.ends_lease).count();
        self.waiting -= count;
        self.due.sort_unstable_by_key(|(key, _)| *key);
        due.extend(self.due.drain(..).map(|(_, entry)| entry));
        count
    }

    /// Returns everything that waits, in order of effect.
    pub(super) fn in_order(&self) -> Vec<(QueueKey, &Due)> {
        let all = self.by_tool.values().chain([&self.endings]);
        let mut all: Vec<_> = all.flat_map(WaitingCommands::iter).map(|(key, due)| (*key, due)).collect();
        all.sort_unstable_by_key(|(key, _)| *key);
        all
    }
}
