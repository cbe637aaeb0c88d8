//! Counters of a stepping thread. Only that thread writes them, and any thread may read them: an increment is a
//! load, an addition and a store, without a lock and without an atomic read-modify-write.

use std::sync::atomic::{AtomicU64, Ordering};

/// A counter that only one thread increments and that any thread may read. It begins at 0.
#[derive(Debug, Default)]
pub struct Count(AtomicU64);

impl Count {
    pub(super) fn add(&self, more: u64) {
        if more > 0 {
            self.0.store(self.0.load(Ordering::Relaxed).wrapping_add(more), Ordering::Relaxed);
        }
    }

    /// Returns the present count.
    pub fn get(&self) -> u64 {
        self.0.load(Ordering::Relaxed)
    }
}

/// Number of bounds of a histogram: 1 µs, 1.5 µs, 2 µs, 3 µs, 4 µs, 6 µs, … One more bucket has no bound.
const BOUNDS: usize = 35;

/// Histogram of times, with 36 buckets: up to 1 µs, 1.5 µs, 2 µs, 3 µs, 4 µs and so on to 131 ms, and longer ones. So
/// its quantiles are known to within a half.
#[derive(Debug)]
pub struct Times {
    buckets: [Count; BOUNDS + 1],
    sum_ns: Count,
}

impl Default for Times {
    fn default() -> Self {
        Times { buckets: std::array::from_fn(|_| Count::default()), sum_ns: Count::default() }
    }
}

impl Times {
    pub(super) fn add(&self, ns: u64) {
        // A bound belongs to the bucket below it.
        let halves_us = ns.saturating_sub(1) / 500;
        let bucket = match halves_us.checked_ilog2() {
            None | Some(0) => 0,
            // The two buckets of an octave differ in the second bit.
            Some(octave) => 2 * octave as usize - 1 + usize::from(halves_us >> (octave - 1) & 1 == 1),
        };
        self.buckets[bucket.min(BOUNDS)].add(1);
        self.sum_ns.add(ns);
    }

    /// Returns the upper bound, s, and the count of each bucket alone, by ascending bound; a time that equals a bound
    /// counts below it. The bound of the last is infinite.
    #[allow(clippy::cast_precision_loss)]
    pub fn buckets(&self) -> Vec<(f64, u64)> {
        let bound_s = |bucket: usize| match bucket {
            BOUNDS.. => f64::INFINITY,
            _ if bucket.is_multiple_of(2) => (1_u64 << (bucket / 2)) as f64 * 1e-6,
            _ => (3_u64 << (bucket / 2)) as f64 * 0.5e-6,
        };
        self.buckets.iter().enumerate().map(|(bucket, count)| (bound_s(bucket), count.get())).collect()
    }

    /// Returns the sum of all times, s.
    #[allow(clippy::cast_precision_loss)]
    pub fn sum_s(&self) -> f64 {
        self.sum_ns.get() as f64 * 1e-9
    }
}

/// Counters of one stepping thread since it began. They include sessions that have ended or moved to another thread;
/// a session that came with counts from elsewhere adds them.
#[derive(Debug, Default)]
pub struct ThreadCounters {
    /// Times of steps, including the publication of samples. A step that was done in parts counts once for each part.
    pub step_time: Times,
    /// Times by which steps, or parts of one, began after they were due.
    pub lateness: Times,
    /// Steps that were skipped at rest and not computed.
    pub rested_steps: Count,
    /// Steps that were due and were dropped from the schedule.
    pub overruns: Count,
    /// Commands that came too late for their step.
    pub late_commands: Count,
    /// Commands without effect because their tool was paused.
    pub paused_commands: Count,
    /// Tools whose lease expired.
    pub lapsed_leases: Count,
    /// Returns of the guard to a checkpoint, from which it repeated steps with a shorter substep, or of a solid to its shape.
    pub guard_events: Count,
    /// Recoveries: returns of a tissue to an earlier state.
    pub recoveries: Count,
    /// Sessions that were stopped: by the guard, a fault of the program, or missing memory.
    pub held_sessions: Count,
    /// Steps in which the speed limit of 0.5 m/s acted on a tool.
    pub limited_steps: Count,
    /// Poses that were refused or passed over.
    pub dropped_poses: Count,
    /// Tools that were released because no pose had arrived for 250 ms.
    pub stale_releases: Count,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_is_in_the_bucket_whose_bound_it_does_not_pass() {
        for (ns, bound_us) in [
            (0, 1.0),
            (1000, 1.0),
            (1001, 1.5),
            (1500, 1.5),
            (1501, 2.0),
            (2000, 2.0),
            (2001, 3.0),
            (3001, 4.0),
            (4001, 6.0),
            (6001, 8.0),
            (100_000, 128.0),
            (98_304_000, 98_304.0),
            (131_072_000, 131_072.0),
            (131_072_001, f64::INFINITY),
            (u64::MAX, f64::INFINITY),
        ] {
            let times = Times::default();
            times.add(ns);
            let counted: Vec<f64> =
                times.buckets().iter().filter(|bucket| bucket.1 == 1).map(|bucket| bucket.0).collect();
            assert_eq!(counted, [bound_us * 1e-6], "{ns} ns");
        }
        let bounds: Vec<f64> = Times::default().buckets().iter().map(|bucket| bucket.0).collect();
        assert!(bounds.is_sorted_by(|one, next| one < next), "{bounds:?}");
    }
}
