//! What a stepping thread counts of itself. Only that thread writes, anybody may read: a count is a load, an addition and
//! a store, without a lock and without a locked bus.

use std::sync::atomic::{AtomicU64, Ordering};

/// A number that only one thread adds to.
#[derive(Debug, Default)]
pub struct Count(AtomicU64);

impl Count {
    pub(super) fn add(&self, more: u64) {
        if more > 0 {
            self.0.store(self.0.load(Ordering::Relaxed).wrapping_add(more), Ordering::Relaxed);
        }
    }

    /// Returns so far.
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// Bounds of a histogram: 1 µs, 2 µs, … , and beyond the last.
const BOUNDS: usize = 18;

/// How often a time was within each power of two of microseconds.
#[derive(Debug, Default)]
pub struct Times {
    buckets: [Count; BOUNDS + 1],
    sum_ns: Count,
}

impl Times {
    pub(super) fn add(&self, ns: u64) {
        // A bound belongs to the bucket below it.
        let whole_us = ns.saturating_sub(1) / 1000;
        let bucket = (u64::BITS - whole_us.leading_zeros()) as usize;
        self.buckets[bucket.min(BOUNDS)].add(1);
        self.sum_ns.add(ns);
    }

    /// Returns upper bound, s, and times up to it, of each bucket; the last has no bound.
    #[allow(clippy::cast_precision_loss)]
    pub fn buckets(&self) -> Vec<(f64, u64)> {
        let bound_s = |bucket: usize| if bucket < BOUNDS { (1_u64 << bucket) as f64 * 1e-6 } else { f64::INFINITY };
        self.buckets.iter().enumerate().map(|(bucket, count)| (bound_s(bucket), count.get())).collect()
    }

    /// Returns the sum over all threads, s.
    #[allow(clippy::cast_precision_loss)]
    pub fn sum_s(&self) -> f64 {
        self.sum_ns.get() as f64 * 1e-9
    }
}

/// Of one stepping thread, since it began. Sessions that are gone count as well.
#[derive(Debug, Default)]
pub struct ThreadCounters {
    /// What a step took, with all that it told.
    pub step_time: Times,
    /// How long after it was due a step began.
    pub lateness: Times,
    /// Steps that were passed over at rest.
    pub rested_steps: Count,
    /// Steps that were due and dropped.
    pub overruns: Count,
    /// Commands that came too late for their step.
    pub late_commands: Count,
    /// Commands that had no effect because their tool was paused.
    pub paused_commands: Count,
    /// Tools whose lease lapsed.
    pub lapsed_leases: Count,
    /// How often the guard went back to a checkpoint.
    pub guard_events: Count,
    /// How often a tissue was taken back to an earlier state.
    pub recoveries: Count,
    /// Sessions that the guard has ended.
    pub held_sessions: Count,
    /// Steps in which a tool was held to the speed limit.
    pub limited_steps: Count,
    /// Poses that were refused or passed over.
    pub dropped_poses: Count,
    /// Tools that were let go because nothing came any more.
    pub stale_releases: Count,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_is_in_the_bucket_whose_bound_it_does_not_pass() {
        for (ns, bucket) in [(0, 0), (1000, 0), (1001, 1), (2000, 1), (2001, 2), (131_072_000, 17), (u64::MAX, 18)] {
            let times = Times::default();
            times.add(ns);
            let counts: Vec<u64> = times.buckets().iter().map(|bucket| bucket.1).collect();
            assert_eq!(counts.iter().position(|count| *count == 1), Some(bucket), "{ns} ns");
        }
    }
}
