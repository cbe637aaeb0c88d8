//! Processor time of callers' requests: the recent time of each, divided by the rule of every shared resource.

use std::collections::BTreeMap;

/// Kind of work that threads do for a caller's requests, beside stepping. Each kind has its own time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Work {
    /// Calls, and the messages of streams, on the network threads.
    Network,
    /// Records, hashes and frames, on the stepping threads.
    Reading,
}

impl Work {
    /// Both kinds.
    pub const ALL: [Work; 2] = [Work::Network, Work::Reading];
}

/// Time constant of fading, s: time spent this long ago counts for 1/e. It is also how long a burst may keep others
/// waiting.
const MEMORY_S: f64 = 0.005;

/// Part of all available time that a single caller must leave.
const RESERVE: f64 = 0.5;

/// Time below which an account is forgotten, s.
const NOTHING_S: f64 = 1e-9;

/// Recently spent time by number of account, s, which fades exponentially.
#[derive(Debug)]
pub(super) struct RecentTime {
    /// Time that the threads could have spent, s.
    most_s: f64,
    at_ns: u64,
    all_s: f64,
    by: BTreeMap<u64, f64>,
}

#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
impl RecentTime {
    /// Creates the record of threads that have `cores` cores together.
    pub(super) fn new(cores: f64) -> Self {
        RecentTime { most_s: cores * MEMORY_S, at_ns: 0, all_s: 0.0, by: BTreeMap::new() }
    }

    fn fade(&mut self, now_ns: u64) {
        let elapsed_s = now_ns.saturating_sub(self.at_ns) as f64 * 1e-9;
        // 1/250 of the time constant: the difference is negligible.
        if elapsed_s < 2e-5 {
            return;
        }
        let left = (-elapsed_s / MEMORY_S).exp();
        self.by.retain(|_, spent_s| {
            *spent_s *= left;
            *spent_s > NOTHING_S
        });
        self.all_s = self.by.values().sum();
        self.at_ns = now_ns;
    }

    pub(super) fn add(&mut self, account: u64, now_ns: u64, took_ns: u64) {
        self.fade(now_ns);
        let took_s = took_ns as f64 * 1e-9;
        *self.by.entry(account).or_default() += took_s;
        self.all_s += took_s;
    }

    /// Returns how long the account must wait, ns: until own·r ≤ (1 − r)·(most − all), as both fade.
    pub(super) fn wait_ns(&mut self, account: u64, now_ns: u64) -> u64 {
        self.fade(now_ns);
        let own_s = self.by.get(&account).copied().unwrap_or(0.0);
        let excess = (own_s * RESERVE + (1.0 - RESERVE) * self.all_s) / ((1.0 - RESERVE) * self.most_s);
        if own_s == 0.0 || excess <= 1.0 { 0 } else { (excess.ln() * MEMORY_S * 1e9).ceil() as u64 }
    }

    /// Returns the account's recent time as a fraction of a core.
    pub(super) fn share(&mut self, account: u64, now_ns: u64) -> f64 {
        self.fade(now_ns);
        self.by.get(&account).copied().unwrap_or(0.0) / MEMORY_S
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// In virtual time: each of `callers` works in slices of 0.1 ms whenever it need not wait. Returns the part of
    /// a thread that each got.
    fn parts(callers: u64) -> Vec<f64> {
        let (mut spent, mut got) = (RecentTime::new(1.0), vec![0.0; callers as usize]);
        let mut now_ns = 0;
        while now_ns < 20_000_000_000 {
            for caller in 0..callers {
                if spent.wait_ns(caller, now_ns) == 0 {
                    spent.add(caller, now_ns, 100_000);
                    got[caller as usize] += 1e-4 / 20.0;
                    now_ns += 100_000;
                }
            }
            now_ns += 25_000;
        }
        got
    }

    #[test]
    fn one_alone_has_half_and_several_share_alike() {
        for (callers, part) in [(1, 0.5), (2, 1.0 / 3.0), (4, 0.2)] {
            let got = parts(callers);
            assert!(got.iter().all(|got| (got - part).abs() < 0.1 * part + 0.01), "{callers}: {got:?}");
        }
    }

    #[test]
    fn who_has_taken_nothing_never_waits_and_who_took_much_does() {
        let mut spent = RecentTime::new(1.0);
        spent.add(1, 1, 10_000_000_000);
        assert_eq!(spent.wait_ns(2, 1), 0);
        let wait_ns = spent.wait_ns(1, 1);
        assert!(wait_ns > 10_000_000, "{wait_ns}");
        assert_eq!(spent.wait_ns(1, 1 + wait_ns), 0);
        assert_eq!(spent.wait_ns(1, u64::MAX), 0);
        assert!(spent.by.is_empty());
    }
}
