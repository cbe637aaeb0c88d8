//! A queue with turns: each account has a queue of its own, and the next item comes from the next account's.

use std::collections::VecDeque;

/// Items that wait, in a queue for each account; accounts take turns. It has no bound: the caller limits it.
#[derive(Debug)]
pub struct Turns<T> {
    /// By number of account, in the order of their turns; no queue is empty.
    queues: VecDeque<(u64, VecDeque<T>)>,
}

impl<T> Default for Turns<T> {
    fn default() -> Self {
        Turns { queues: VecDeque::new() }
    }
}

impl<T> Turns<T> {
    fn queue(&mut self, account: u64) -> Option<&mut VecDeque<T>> {
        self.queues.iter_mut().find(|queue| queue.0 == account).map(|queue| &mut queue.1)
    }

    /// Returns the numbers of the accounts with waiting items, each once, in the order of their turns.
    pub fn accounts(&self) -> impl Iterator<Item = u64> {
        self.queues.iter().map(|queue| queue.0)
    }

    /// Returns the number of waiting items of `account`; 0 for an unknown one.
    pub fn count(&self, account: u64) -> usize {
        self.queues.iter().find(|queue| queue.0 == account).map_or(0, |queue| queue.1.len())
    }

    /// Adds an item behind all others of `account`. An account without items gets the last turn.
    pub fn push_back(&mut self, account: u64, item: T) {
        self.push_before(account, item, |_| false);
    }

    /// Adds an item before the first item of `account` for which `may_wait` holds, or behind all. An account without
    /// items gets the last turn.
    pub fn push_before(&mut self, account: u64, item: T, may_wait: impl Fn(&T) -> bool) {
        match self.queue(account) {
            Some(queue) => {
                let at = queue.iter().position(may_wait).unwrap_or(queue.len());
                queue.insert(at, item);
            }
            None => self.queues.push_back((account, VecDeque::from([item]))),
        }
    }

    /// Puts an item before all others of `account`, such as the rest of one that was taken. The turn of the account
    /// stays; one without items gets the last turn.
    pub fn push_front(&mut self, account: u64, item: T) {
        match self.queue(account) {
            Some(queue) => queue.push_front(item),
            None => self.queues.push_back((account, VecDeque::from([item]))),
        }
    }

    /// Removes and returns the first item of the first account for whose number `may` holds, with that number. Its
    /// next turn comes after all others'. `None` if no such account has items.
    pub fn next(&mut self, may: impl Fn(u64) -> bool) -> Option<(u64, T)> {
        let turn = self.queues.iter().position(|queue| may(queue.0))?;
        let (account, mut queue) = self.queues.remove(turn)?;
        let item = queue.pop_front()?;
        if !queue.is_empty() {
            self.queues.push_back((account, queue));
        }
        Some((account, item))
    }

    /// Removes the items of `account` for which `keep` is false. Its turn stays if items remain.
    pub fn retain(&mut self, account: u64, keep: impl FnMut(&T) -> bool) {
        if let Some(queue) = self.queue(account) {
            queue.retain(keep);
        }
        self.queues.retain(|queue| !queue.1.is_empty());
    }

    /// Returns all items: by account in the order of turns, and each account's in their order.
    pub fn iter(&self) -> impl Iterator<Item = &T> {
        self.queues.iter().flat_map(|queue| &queue.1)
    }

    /// Returns whether no items wait.
    pub fn is_empty(&self) -> bool {
        self.queues.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn accounts_take_turns_and_each_has_its_items_in_order() {
        let mut turns = Turns::default();
        for item in 0..3 {
            turns.push_back(1, item);
        }
        turns.push_back(2, 10);
        assert_eq!((turns.count(1), turns.count(2), turns.count(3)), (3, 1, 0));
        assert_eq!(turns.iter().copied().collect::<Vec<_>>(), [0, 1, 2, 10]);
        assert_eq!(turns.next(|_| true), Some((1, 0)));
        // The rest of account 1's item comes first at its next turn, which is after that of account 2.
        turns.push_front(1, 0);
        let order: Vec<_> = std::iter::from_fn(|| turns.next(|_| true)).collect();
        assert_eq!(order, [(2, 10), (1, 0), (1, 1), (1, 2)]);
        assert!(turns.is_empty());
    }

    #[test]
    fn an_account_may_be_passed_over_and_lose_items() {
        let mut turns = Turns::default();
        for (account, item) in [(1, 0), (1, 1), (2, 2)] {
            turns.push_back(account, item);
        }
        assert_eq!(turns.next(|account| account != 1), Some((2, 2)));
        assert_eq!(turns.next(|account| account != 1), None);
        turns.retain(1, |item| *item != 0);
        turns.retain(3, |_| false);
        assert_eq!(turns.iter().count(), 1);
        turns.retain(1, |_| false);
        assert!(turns.is_empty());
    }
}
