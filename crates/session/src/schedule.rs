//! The times at which steps are due. Time is an argument.

/// Schedule of a session: the time at which each step is due, at a constant rate. A pause or a delay needs a new or
/// shifted one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Schedule {
    step: u64,
    at_ns: f64,
    period_ns: f64,
}

#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
impl Schedule {
    /// Creates a schedule: step `step` is due at `at_ns`, ns of any clock, and each further step 1/`rate_hz` s later.
    /// `rate_hz` must be above 0.
    pub fn new(step: u64, at_ns: u64, rate_hz: f64) -> Self {
        Schedule { step, at_ns: at_ns as f64, period_ns: 1e9 / rate_hz }
    }

    /// Returns the time between two steps, ns: 10⁹ over the rate.
    pub fn period_ns(&self) -> f64 {
        self.period_ns
    }

    /// Returns the time at which a step is due, ns, rounded down. An earlier step than the schedule's first counts as
    /// the first.
    pub fn due_ns(&self, step: u64) -> u64 {
        (self.at_ns + step.saturating_sub(self.step) as f64 * self.period_ns) as u64
    }

    /// Returns the first step that is due after `now_ns`, ns, at least the schedule's first; that is the number of
    /// steps that a session on time has done.
    pub fn next_step(&self, now_ns: u64) -> u64 {
        let periods = (now_ns as f64 - self.at_ns) / self.period_ns;
        let mut step = self.step.saturating_add(periods.max(0.0) as u64);
        // Rounding may be off by a step; `due_ns` decides.
        while step > self.step && self.due_ns(step - 1) > now_ns {
            step -= 1;
        }
        while self.due_ns(step) <= now_ns {
            step += 1;
        }
        step
    }

    /// Makes all steps due later by `periods` periods; a fraction is allowed.
    pub fn delay(&mut self, periods: f64) {
        self.at_ns += periods * self.period_ns;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_next_step_is_the_first_that_is_due_after_now() {
        for rate_hz in [1000.0, 60.0, 20_000.0, 0.3, 7777.7] {
            let schedule = Schedule::new(17, 1_000_003, rate_hz);
            assert_eq!((schedule.next_step(0), schedule.next_step(1_000_002)), (17, 17));
            for step in (17..2000).chain(3_000_000..3_000_500) {
                let due = schedule.due_ns(step);
                assert_eq!(schedule.next_step(due - 1), step, "{rate_hz} Hz");
                assert_eq!(schedule.next_step(due), step + 1, "{rate_hz} Hz");
            }
        }
    }
}
