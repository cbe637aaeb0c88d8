//! Recovery: a session continues after a blow-up that the guard could not repair.
//!
//! The tissue goes back to the last state that passed the guard's checks, and all tools are released. Time does not
//! go back. The commands that took effect since that state are lost; they are counted, and reported to the holders
//! of tools. A recovery depends on steps and commands alone, so equal commands give equal bits.
//!
//! A recovery is expensive: the guard has repeated up to [`INTERVAL_SUBSTEPS`] substeps with shorter and shorter
//! ones. So at the [`MAX_RECOVERIES`]th recovery within [`WINDOW_STEPS`] steps the tissue is brought to rest, and
//! the tools that acted are paused: until the window is over their commands have no effect, except releases. Other
//! tools can still cause a recovery, which pauses them as well.
//!
//! After a blow-up, the session is held only if nothing has acted on the tissue since it was at rest. Then no
//! command has caused the fault, and another recovery would not help. (A fault of the program, or memory that the
//! system refuses, also holds a session: `palpate_realtime`, `session_task.rs`.)
//!
//! [`INTERVAL_SUBSTEPS`]: palpate_tissue::guard::INTERVAL_SUBSTEPS

use std::collections::VecDeque;
use std::sync::Arc;

use palpate_tissue::scene::record::Recovery;

/// Number of recoveries within [`WINDOW_STEPS`] at which the tissue is brought to rest and the tools that acted are
/// paused; also the number of recoveries that are remembered.
pub const MAX_RECOVERIES: usize = 4;

/// Length of the window in which recoveries are counted, steps: 10 s at 1 kHz.
pub const WINDOW_STEPS: u64 = 10_000;

/// Effect of a recovery on one tool that had acted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ended {
    /// The tool's number.
    pub tool: u32,
    /// Sequence number of the newest command of the tool that had taken effect; 0 if there was none.
    pub sequence: u64,
    /// Number of commands of the tool since the restored state, whose effect was lost.
    pub undone_commands: u64,
}

/// A recovery, with the tools that had acted. All tools of the session are released, also those that are not listed.
#[derive(Debug, Clone, PartialEq)]
pub struct Recovered {
    /// The recovery.
    pub recovery: Recovery,
    /// The tools that acted on the tissue when it blew up, were led by poses, or lost a command; by ascending number.
    pub tools: Vec<Ended>,
}

/// Number of commands of one tool that took effect at one step.
#[derive(Debug, Clone, Copy)]
pub(super) struct Acts {
    pub(super) step: u64,
    pub(super) tool: u32,
    pub(super) count: u64,
}

/// The recoveries of a session, and the commands that the next one would undo. [`Session`](super::Session) keeps it.
#[derive(Debug, Default)]
pub struct Recoveries {
    pub(super) count: u64,
    /// The newest, at most [`MAX_RECOVERIES`], by ascending step.
    pub(super) newest: VecDeque<Arc<Recovered>>,
    /// The commands since the guard's checkpoint, by step. If there are many, the guard makes a new checkpoint.
    pub(super) acts: VecDeque<Acts>,
    /// Whether anything has acted on the tissue since it was at rest. A session begins at rest.
    pub(super) disturbed: bool,
}

impl Recoveries {
    /// Returns the number of recoveries since the session began.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Returns the newest recovery; `None` before the first.
    pub fn newest(&self) -> Option<Arc<Recovered>> {
        self.newest.back().cloned()
    }

    /// Returns the newest recoveries, at most [`MAX_RECOVERIES`], by ascending step; older ones are forgotten.
    pub fn list(&self) -> Vec<Recovery> {
        self.newest.iter().map(|recovered| recovered.recovery.clone()).collect()
    }

    /// Counts a command that takes effect at `step`.
    pub(super) fn note(&mut self, step: u64, tool: u32) {
        match self.acts.back_mut().filter(|acts| (acts.step, acts.tool) == (step, tool)) {
            Some(acts) => acts.count += 1,
            None => self.acts.push_back(Acts { step, tool, count: 1 }),
        }
    }

    /// Notes that a force, a grasp or a tip acts from now on.
    pub(super) fn disturb(&mut self) {
        self.disturbed = true;
    }

    /// Returns whether anything has acted on the tissue since it was at rest.
    pub(super) fn is_disturbed(&self) -> bool {
        self.disturbed
    }

    /// Removes the commands before `step`, because the state after them has passed the guard's checks.
    pub(super) fn accept_until(&mut self, step: u64) {
        while self.acts.front().is_some_and(|acts| acts.step < step) {
            self.acts.pop_front();
        }
    }

    /// Returns the number of commands of a tool since the guard's checkpoint.
    pub(super) fn acts_of(&self, tool: usize) -> u64 {
        self.acts.iter().filter(|acts| acts.tool as usize == tool).map(|acts| acts.count).sum()
    }

    /// Returns the step until which a recovery at `step` pauses the tools that acted: the end of the window, if
    /// there are too many recoveries in it.
    pub(super) fn pause_end(&self, step: u64) -> Option<u64> {
        // The first of the newest [`MAX_RECOVERIES`], of which the one at `step` is the last.
        let first = self.newest.iter().rev().nth(MAX_RECOVERIES - 2)?;
        let end = first.recovery.step + WINDOW_STEPS;
        (end > step).then_some(end)
    }

    /// Adds a recovery, and removes the commands that it has undone.
    pub(super) fn add(&mut self, recovered: Recovered) {
        self.count += 1;
        self.disturbed = !recovered.recovery.at_rest;
        if self.newest.len() == MAX_RECOVERIES {
            self.newest.pop_front();
        }
        self.newest.push_back(Arc::new(recovered));
        self.acts.clear();
    }
}

/// Returns a description of a recovery for people: step, cause, restored state, undone commands, and the end of a
/// pause.
pub fn describe(recovery: &Recovery) -> String {
    let Recovery { step, state_of_step, at_rest, undone_commands, paused_until_step, reason } = recovery;
    let rest = if *at_rest { ", brought to rest" } else { "" };
    let pause = paused_until_step.map_or(String::new(), |end| {
        format!(
            "; there were {MAX_RECOVERIES} recoveries within {WINDOW_STEPS} steps, so commands to the tools that acted have no effect \
             before step {end}"
        )
    });
    format!(
        "after step {step} {reason}; shorter substeps did not help; the tissue went back to the state of step \
         {state_of_step}{rest}, {undone_commands} commands were undone, and all tools were released{pause}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Session;
    use crate::command::{Command, Due};
    use palpate_tissue::CheckFailure;
    use palpate_tissue::scene::script::Action;
    use palpate_tissue::shape::{PointId, PointName};
    use palpate_tissue::{BlowUp, Model};

    fn blow_up(step: u64) -> BlowUp {
        BlowUp { step, cause: CheckFailure::NotFinite { point: PointName::Point([0, 0]) } }
    }

    fn grasp(tool: u32, sequence: u64) -> Due {
        let action = Action::Grasp { point: PointId::new(12), displacement_m: glam::DVec3::Z * 1e-3 };
        Due::in_time(Command::new(tool, Some(sequence), action))
    }

    #[test]
    fn a_session_is_held_only_if_nothing_has_acted_since_it_was_at_rest() {
        let mut session =
            Session::new(&Model::parse("paper", palpate_tissue::scene::PAPER, &["sheet.points=[5, 5]"]).unwrap());
        session.advance(&mut vec![grasp(0, 1)], |_| {});
        // The first one goes back to a state that is not at rest. Nothing acts after it.
        for at_rest in [false, true] {
            assert!(session.recover(blow_up(session.step_count())));
            assert_eq!(session.recoveries().newest().unwrap().recovery.at_rest, at_rest);
        }
        assert!(!session.recover(blow_up(session.step_count())));
        let reason = session.hold_reason().unwrap();
        assert!(reason.contains("nothing has acted on the tissue since it was at rest"), "{reason}");
        let mut untouched = Session::new(session.model());
        assert!(!untouched.recover(blow_up(0)) && untouched.recoveries().count() == 0);
    }

    #[test]
    fn a_tool_that_causes_too_many_recoveries_is_paused_and_no_other() {
        let mut session =
            Session::new(&Model::parse("paper", palpate_tissue::scene::PAPER, &["sheet.points=[5, 5]"]).unwrap());
        let mut sequence = 0;
        for _ in 0..MAX_RECOVERIES {
            sequence += 1;
            session.advance(&mut vec![grasp(0, sequence)], |_| {});
            assert!(session.tools[0].paused_until.is_none());
            assert!(session.recover(blow_up(session.step_count())));
        }
        let list = session.recoveries().list();
        let end = list[0].step + WINDOW_STEPS;
        assert_eq!(
            list.iter().map(|recovery| recovery.paused_until_step).collect::<Vec<_>>()[MAX_RECOVERIES - 1],
            Some(end)
        );
        assert!(describe(&list[MAX_RECOVERIES - 1]).contains(&format!("before step {end}")));
        let sample = |session: &Session, tool: usize| session.sample(Some(&[0, 1])).tools[tool].clone();
        // The command is acknowledged and has no effect; nor has a new holder's.
        session.advance(&mut vec![grasp(0, 5)], |_| {});
        let paused = sample(&session, 0);
        assert_eq!((paused.acknowledged_sequence, paused.expired, paused.paused_until), (5, true, Some(end)));
        let released = Due { ends_lease: true, ..grasp(0, 0) };
        session.advance(&mut vec![released], |_| {});
        session.advance(&mut vec![grasp(0, 1)], |_| {});
        assert_eq!((session.paused_commands(), session.tissue().largest_displacement_m()), (2, 0.0));
        assert!(!session.recoveries.disturbed);
        // Another tool acts, and so does this one after the pause.
        session.advance(&mut vec![grasp(1, 1)], |_| {});
        assert!(!sample(&session, 1).expired && session.tissue().largest_displacement_m() > 0.0);
        while session.step_count() < end - 1 {
            session.advance(&mut Vec::new(), |_| {});
        }
        session.advance(&mut vec![grasp(0, 6)], |_| {});
        assert!(sample(&session, 0).expired);
        session.advance(&mut vec![grasp(0, 7)], |_| {});
        assert!(!sample(&session, 0).expired);
        assert_eq!(session.paused_commands(), 3);
    }

    #[test]
    fn a_tool_that_has_not_acted_is_not_ended_by_a_recovery() {
        let mut session =
            Session::new(&Model::parse("paper", palpate_tissue::scene::PAPER, &["sheet.points=[5, 5]"]).unwrap());
        session.advance(&mut vec![grasp(2, 7)], |_| {});
        assert!(session.recover(blow_up(session.step_count())));
        let ended = session.recoveries().newest().unwrap().tools.clone();
        assert_eq!(ended.iter().map(|ended| (ended.tool, ended.sequence)).collect::<Vec<_>>(), [(2, 7)]);
        let expired: Vec<_> = session.sample(Some(&[0, 1, 2])).tools.iter().map(|tool| tool.expired).collect();
        assert_eq!(expired, [false, false, true]);
    }

    #[test]
    fn a_pause_ends_with_the_window_of_the_first_of_the_recoveries_that_cause_it() {
        let mut recoveries = Recoveries::default();
        let recovered = |step: u64| Recovered {
            recovery: Recovery {
                step,
                state_of_step: step,
                at_rest: false,
                undone_commands: 0,
                paused_until_step: None,
                reason: String::new(),
            },
            tools: Vec::new(),
        };
        for step in [100, 200, 300] {
            assert_eq!(recoveries.pause_end(step), None);
            recoveries.add(recovered(step));
        }
        let end = 100 + WINDOW_STEPS;
        assert_eq!([301, end - 1].map(|step| recoveries.pause_end(step)), [Some(end); 2]);
        // Then the first is no longer within the window.
        assert_eq!([end, end + 1].map(|step| recoveries.pause_end(step)), [None; 2]);
    }
}
