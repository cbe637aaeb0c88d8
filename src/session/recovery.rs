//! Recovery: a session goes on after a blow-up that the guard could not repair.
//!
//! The tissue goes back to the last state that the guard believed, and all tools are released. Time does not go back.
//! The commands that took effect since that state are lost; they are counted, and whoever holds a tool is told. A
//! recovery depends on steps and commands alone, so the same commands give the same bits.
//!
//! A recovery is expensive: the guard has repeated up to [`INTERVAL_SUBSTEPS`] substeps with shorter and shorter ones.
//! So there are at most [`MOST`] within [`WINDOW_STEPS`] steps. After the next blow-up the session is held.
//!
//! [`INTERVAL_SUBSTEPS`]: crate::sheet::guard::INTERVAL_SUBSTEPS

use std::collections::VecDeque;
use std::sync::Arc;

use crate::scene::record::Recovery;

/// Most recoveries within [`WINDOW_STEPS`].
pub const MOST: usize = 4;

/// Length of the window, steps.
pub const WINDOW_STEPS: u64 = 10_000;

/// What a recovery did to a tool.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ended {
    /// The tool's number.
    pub tool: u32,
    /// Sequence of the newest command of the tool that had taken effect; 0 if there was none.
    pub sequence: u64,
    /// Commands of the tool whose effect was lost.
    pub undone_commands: u64,
}

/// A recovery, and the tools that it released.
#[derive(Debug, Clone, PartialEq)]
pub struct Recovered {
    /// The recovery.
    pub recovery: Recovery,
    /// The tools, ascending.
    pub tools: Vec<Ended>,
}

/// Commands of one tool that took effect at one step.
#[derive(Debug, Clone, Copy)]
struct Acts {
    step: u64,
    tool: u32,
    count: u64,
}

/// The recoveries of a session, and the commands that the next one would undo.
#[derive(Debug, Default)]
pub struct Recoveries {
    count: u64,
    /// The newest, at most [`MOST`], by ascending step.
    newest: VecDeque<Arc<Recovered>>,
    /// The commands since the guard's checkpoint, by step. The guard brings the checkpoint forward when there are many.
    acts: VecDeque<Acts>,
}

impl Recoveries {
    /// How many there were.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// The newest.
    pub fn newest(&self) -> Option<Arc<Recovered>> {
        self.newest.back().cloned()
    }

    /// The newest, at most [`MOST`], by ascending step.
    pub fn list(&self) -> Vec<Recovery> {
        self.newest.iter().map(|recovered| recovered.recovery.clone()).collect()
    }

    /// Notes that a command takes effect at `step`.
    pub(super) fn note(&mut self, step: u64, tool: u32) {
        match self.acts.back_mut().filter(|acts| (acts.step, acts.tool) == (step, tool)) {
            Some(acts) => acts.count += 1,
            None => self.acts.push_back(Acts { step, tool, count: 1 }),
        }
    }

    /// Forgets the commands before `step`, whose effect the guard has believed.
    pub(super) fn believe(&mut self, step: u64) {
        while self.acts.front().is_some_and(|acts| acts.step < step) {
            self.acts.pop_front();
        }
    }

    /// Commands of a tool since the guard's checkpoint.
    pub(super) fn acts_of(&self, tool: usize) -> u64 {
        self.acts.iter().filter(|acts| acts.tool as usize == tool).map(|acts| acts.count).sum()
    }

    /// Whether a blow-up at `step` may be recovered from.
    pub(super) fn may_recover(&self, step: u64) -> bool {
        let oldest = self.newest.front().filter(|_| self.newest.len() == MOST);
        oldest.is_none_or(|oldest| step - oldest.recovery.step >= WINDOW_STEPS)
    }

    /// Counts a recovery, and forgets the commands that it has undone.
    pub(super) fn add(&mut self, recovered: Recovered) {
        self.count += 1;
        if self.newest.len() == MOST {
            self.newest.pop_front();
        }
        self.newest.push_back(Arc::new(recovered));
        self.acts.clear();
    }
}

/// A description for people.
pub fn describe(recovery: &Recovery) -> String {
    let Recovery { step, state_of_step, at_rest, undone_commands, reason } = recovery;
    let rest = if *at_rest { ", brought to rest" } else { "" };
    format!(
        "after step {step} {reason}; shorter substeps did not help; the tissue went back to the state of step \
         {state_of_step}{rest}, {undone_commands} commands were undone, and all tools were released"
    )
}
