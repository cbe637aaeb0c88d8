//! The rota of a stepping thread: its sessions, when each is due, and each one's part of the thread.

use std::collections::btree_map::Entry;
use std::collections::{BTreeMap, BTreeSet};

use super::policy;
use super::running::Running;
use crate::refusal::Refusal;

/// The sessions of a thread, by number, and when each needs it next. One at rest may need it never.
#[derive(Default)]
pub(super) struct Rota {
    sessions: BTreeMap<u64, Box<Running>>,
    due: BTreeSet<(u64, u64)>,
    /// Sessions that are due some time, by the account of who made them.
    awake: BTreeMap<u64, usize>,
}

impl Rota {
    /// Adds a new session.
    pub(super) fn adopt(&mut self, number: u64, running: Box<Running>) {
        self.sessions.insert(number, running);
        self.with(number, Running::plan);
    }

    /// Does something with session `number`, if it is there still, which may change when it is due. Returns the session if
    /// it has left the server.
    pub(super) fn with(&mut self, number: u64, act: impl FnOnce(&mut Running)) -> Option<Box<Running>> {
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

    /// The number of equal parts of the thread of which one belongs to session `number` ([`policy::parts`]).
    pub(super) fn parts(&self, number: u64) -> usize {
        let owner = self.owner(number);
        policy::parts(self.awake.len(), owner.and_then(|owner| self.awake.get(&owner)).copied().unwrap_or(1))
    }

    /// The session to be stepped now: that which is due first, of other callers than `weary` if one of theirs is due.
    pub(super) fn next(&self, now_ns: u64, weary: Option<u64>) -> Option<u64> {
        let due = || self.due.iter().take_while(|(due_ns, _)| *due_ns <= now_ns).map(|(_, number)| *number);
        let is_others = |number: &u64| self.owner(*number) != weary;
        weary.and_then(|_| due().find(is_others)).or_else(|| due().next())
    }

    /// Who has made a session.
    pub(super) fn owner(&self, number: u64) -> Option<u64> {
        self.sessions.get(&number).map(|running| running.owner())
    }

    /// Whether only one session is due some time.
    pub(super) fn is_alone(&self) -> bool {
        self.due.len() == 1
    }

    /// Ends all sessions.
    pub(super) fn end(&mut self, why: &Refusal) {
        for running in self.sessions.values_mut() {
            running.guarded(Running::finish_step);
            running.note_the_end();
            running.end(why);
        }
    }

    /// The session that is due first, and when.
    pub(super) fn first(&self) -> Option<(u64, u64)> {
        self.due.first().copied()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::budget::{Account, Budget};
    use crate::limits::Limits;
    use crate::pace::Pacer;
    use crate::scene::{PAPER, Scene};
    use crate::session::Session;
    use crate::session::schedule::Schedule;
    use crate::sheet::choice::NEVER;

    /// In virtual time: 40 sessions of one caller take 2 ms of each millisecond together; one of another keeps its time.
    #[test]
    fn a_thread_is_divided_among_callers_first() {
        let limits = Limits::default();
        let scene = Scene::parse("paper", PAPER, &[], &limits).unwrap();
        let budget = Budget::new(&limits, 1, 1);
        let pacer = Pacer::start(1, 0.0, &limits, budget.clone()).unwrap();
        let (many, one) = (budget.account("many"), budget.account("one"));
        let mut rota = Rota::default();
        for index in 0..41 {
            let owner = if index == 40 { &one } else { &many };
            let live = pacer.create(&scene, true, 60.0, owner, &NEVER).unwrap();
            (0..1000).for_each(|_| live.cost.observe(50_000));
            let mut running = Running::new(live.clone(), Session::new(&live.model), true);
            running.schedule = Schedule::new(0, 1_000_000, 1000.0);
            (running.running, running.next_step) = (false, 1);
            rota.sessions.insert(index, Box::new(running));
            rota.with(index, |running| running.running = true);
        }
        assert_eq!((rota.parts(0), rota.parts(40), rota.awake.len()), (80, 2, 2));
        // All are due at once: first those of the caller with many, and that of the other after their turn.
        let next = |weary: Option<&Account>| rota.next(10_000_000, weary.map(Account::number));
        assert_eq!((next(None), next(Some(&many)), next(Some(&one))), (Some(0), Some(40), Some(0)));
        assert_eq!((rota.next(1_000_000, None), rota.next(1_000_000, Some(many.number()))), (None, None));
        // All are late; those of the caller with more than its half go behind, the other does not.
        let (now_ns, due) = (10_000_000, 2_000_000);
        for (number, expected) in [(0, now_ns), (40, due)] {
            let parts = rota.parts(number);
            rota.with(number, |running| running.queue_again(now_ns, now_ns, parts, false));
            assert_eq!(rota.sessions[&number].due_ns(), Some(expected), "{number}");
        }
        // Who rests is not counted.
        (0..40).for_each(|number| drop(rota.with(number, |running| running.running = false)));
        assert_eq!((rota.parts(40), rota.awake.len()), (1, 1));
        pacer.stop();
    }
}
