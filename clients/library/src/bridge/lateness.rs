//! How late the ticks of a loop begin: counts in a fixed amount of memory, for loops that run for hours.

use std::time::Duration;

/// Width of a class of latenesses, ns.
const CLASS_NS: u128 = 1000;

/// Number of classes. The last one also has the ticks that began more than 5 ms late.
const CLASSES: usize = 5000;

/// Number of ticks by the time by which they began after they were due.
pub(super) struct TickLateness {
    /// Counts of the ticks up to 1 µs late, up to 2 µs, …
    classes: Box<[u64]>,
    longest: Duration,
}

impl Default for TickLateness {
    fn default() -> Self {
        TickLateness { classes: vec![0; CLASSES].into_boxed_slice(), longest: Duration::ZERO }
    }
}

impl TickLateness {
    pub(super) fn add(&mut self, late: Duration) {
        // A bound belongs to the class below it.
        let class = late.as_nanos().saturating_sub(1) / CLASS_NS;
        let class = usize::try_from(class).unwrap_or(CLASSES).min(CLASSES - 1);
        if let Some(count) = self.classes.get_mut(class) {
            *count += 1;
        }
        self.longest = self.longest.max(late);
    }

    /// Returns median, 99th percentile and longest, s; zeros without a tick. The first two are the upper bounds of
    /// their classes, at most the longest.
    pub(super) fn quantiles_s(&self) -> [f64; 3] {
        let longest_s = self.longest.as_secs_f64();
        [self.quantile_s(50, longest_s), self.quantile_s(99, longest_s), longest_s]
    }

    fn quantile_s(&self, hundredths: u64, longest_s: f64) -> f64 {
        let rank = (self.classes.iter().sum::<u64>() * hundredths).div_ceil(100);
        let mut counted = 0;
        let class = self.classes.iter().position(|count| {
            counted += count;
            counted >= rank
        });
        #[allow(clippy::cast_precision_loss)]
        match class {
            Some(class) if class + 1 < CLASSES => longest_s.min((class + 1) as f64 * CLASS_NS as f64 * 1e-9),
            // The last class has no bound.
            _ => longest_s,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_quantiles_are_those_of_the_ticks_to_a_microsecond() {
        let mut lateness = TickLateness::default();
        assert_eq!(lateness.quantiles_s(), [0.0; 3]);
        lateness.add(Duration::from_nanos(300));
        assert_eq!(lateness.quantiles_s(), [3e-7; 3]);
        for us in 1..=100 {
            lateness.add(Duration::from_micros(us));
        }
        // The median of 101 ticks is the 51st of them, and 99 % are the first 100.
        let [median_s, p99_s, longest_s] = lateness.quantiles_s();
        for (found_s, wanted_s) in [(median_s, 50e-6), (p99_s, 99e-6), (longest_s, 100e-6)] {
            assert!((found_s - wanted_s).abs() < 1e-9, "{found_s} {wanted_s}");
        }
    }

    #[test]
    fn a_lateness_beyond_the_classes_counts_as_the_longest() {
        let mut lateness = TickLateness::default();
        for ms in [6, 200, 9] {
            lateness.add(Duration::from_millis(ms));
        }
        assert_eq!(lateness.quantiles_s(), [0.2; 3]);
    }
}
