//! The run queue of a stepping thread: its sessions, when each is due, and each one's part of the thread.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};

use super::policy;
use super::session_task::SessionTask;
use palpate_refusal::Refusal;

/// Sessions of a thread, by number, with the time at which each is due. A session at rest may never be due.
#[derive(Default)]
pub(super) struct RunQueue {
    sessions: BTreeMap<u64, Box<SessionTask>>,
    due: BTreeSet<(u64, u64)>,
    /// Number of sessions that have a due time, by the account of their owner.
    awake: BTreeMap<u64, usize>,
}

impl RunQueue {
    /// Adds a new session.
    pub(super) fn adopt(&mut self, number: u64, running: Box<SessionTask>) {
        self.sessions.insert(number, running);
        self.with(number, SessionTask::plan);
    }

    /// Runs `act` on session `number`, if it is still there, and then updates its due time. If the session leaves the
    /// thread, this removes and returns it.
    pub(super) fn with(&mut self, number: u64, act: impl FnOnce(&mut SessionTask)) -> Option<Box<SessionTask>> {
        let Entry::Occupied(mut session) = self.sessions.entry(number) else { return None };
        let running = session.get_mut();
        let owner = running.owner();
        if let Some(due_ns) = running.due_ns()
            && self.due.remove(&(due_ns, number))
            && let Entry::Occupied(mut awake) = self.awake.entry(owner)
        {
            *awake.get_mut() -= 1;
            if *awake.get() == 0 {
                awake.remove();
            }
        }
        act(running);
        if let Some(due_ns) = running.due_ns() {
            self.due.insert((due_ns, number));
            *self.awake.entry(owner).or_default() += 1;
        }
        running.has_left().then(|| session.remove())
    }

    /// Returns the number of equal parts of the thread of which one belongs to session `number`
    /// ([`policy::parts`]).
    pub(super) fn parts(&self, number: u64) -> usize {
        let owner = self.owner(number);
        policy::parts(self.awake.len(), owner.and_then(|owner| self.awake.get(&owner)).copied().unwrap_or(1))
    }

    /// Returns the session to step now: the one that is due first. Sessions of callers other than `weary` come
    /// first.
    pub(super) fn next(&self, now_ns: u64, weary: Option<u64>) -> Option<u64> {
        let due = || self.due.iter().take_while(|(due_ns, _)| *due_ns <= now_ns).map(|(_, number)| *number);
        let is_others = |number: &u64| self.owner(*number) != weary;
        weary.and_then(|_| due().find(is_others)).or_else(|| due().next())
    }

    /// Returns the account number of the caller that created a session.
    pub(super) fn owner(&self, number: u64) -> Option<u64> {
        self.sessions.get(&number).map(|running| running.owner())
    }

    /// Returns whether exactly one session has a due time.
    pub(super) fn is_alone(&self) -> bool {
        self.due.len() == 1
    }

    /// Ends all sessions, for the reason `why`.
    pub(super) fn end(&mut self, why: &Refusal) {
        for running in self.sessions.values_mut() {
            running.guarded(SessionTask::finish_step);
            running.note_the_end();
            running.end(why);
        }
    }

    /// Returns the time at which a session is due first, ns, and its number.
    pub(super) fn first(&self) -> Option<(u64, u64)> {
        self.due.first().copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Pacer;
    use palpate_session::Session;
    use palpate_session::budget::{Account, Budget};
    use palpate_session::schedule::Schedule;
    use palpate_tissue::limits::Limits;
    use palpate_tissue::scene::{PAPER, Scene};
    use palpate_tissue::select::scheme_selection::NEVER;

    /// In virtual time: 40 sessions of one caller take 2 ms of each millisecond together; one of another caller stays
    /// on time.
    #[test]
    fn a_thread_is_divided_among_callers_first() {
        let limits = Limits::default();
        let scene = Scene::parse("paper", PAPER, &[], &limits).unwrap();
        let budget = Budget::new(&limits, 1, 1);
        let pacer = Pacer::start(1, 0.0, &limits, budget.clone()).unwrap();
        let (many, one) = (budget.account("many"), budget.account("one"));
        let mut run_queue = RunQueue::default();
        for index in 0..41 {
            let owner = if index == 40 { &one } else { &many };
            let handle = pacer.create(&scene, true, 60.0, owner, &NEVER).unwrap();
            (0..1000).for_each(|_| handle.cost.observe(50_000));
            let mut running = SessionTask::new(handle.clone(), Session::new(&handle.model), true);
            running.schedule = Schedule::new(0, 1_000_000, 1000.0);
            (running.running, running.next_step) = (false, 1);
            run_queue.sessions.insert(index, Box::new(running));
            run_queue.with(index, |running| running.running = true);
        }
        assert_eq!((run_queue.parts(0), run_queue.parts(40), run_queue.awake.len()), (80, 2, 2));
        // All are due at once: first those of the caller with many, and that of the other after their turn.
        let next = |weary: Option<&Account>| run_queue.next(10_000_000, weary.map(Account::number));
        assert_eq!((next(None), next(Some(&many)), next(Some(&one))), (Some(0), Some(40), Some(0)));
        assert_eq!((run_queue.next(1_000_000, None), run_queue.next(1_000_000, Some(many.number()))), (None, None));
        // All are late; those of the caller with more than its half go behind, the other does not.
        let (now_ns, due) = (10_000_000, 2_000_000);
        for (number, expected) in [(0, now_ns), (40, due)] {
            let parts = run_queue.parts(number);
            run_queue.with(number, |running| running.queue_again(now_ns, now_ns, parts, false));
            assert_eq!(run_queue.sessions[&number].due_ns(), Some(expected), "{number}");
        }
        // A session at rest is not counted.
        (0..40).for_each(|number| drop(run_queue.with(number, |running| running.running = false)));
        assert_eq!((run_queue.parts(40), run_queue.awake.len()), (1, 1));
        pacer.stop();
    }
}
