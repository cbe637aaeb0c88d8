//! The guard's account of work and energy.

use crate::interface::CheckFailure;
use crate::saved::{SavedWork, ensure};
use palpate_refusal::Result;

/// Tolerance of the energy balance, as a fraction of the energy at the last survey plus the size of the tools' work:
/// errors of the schemes at the stability bound.
pub const MARGIN: f64 = 0.05;

/// By how much an energy may rise without a cause.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Noise {
    /// Part of the largest energy so far that counts as noise.
    pub(crate) part: f64,
    pub(crate) energy_j: f64,
}

/// The account of the tools' work, J, and of energies at the last survey.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct WorkAccount {
    /// Work since the last survey, plus what its `present_j` subtracted.
    pub(crate) done_j: f64,
    /// Energy at the last survey.
    energy_j: f64,
    /// The largest energy at any survey.
    largest_j: f64,
    /// How much the energy has risen beyond the work while tools touch or hold, minus its losses since.
    excess_j: f64,
}

impl WorkAccount {
    /// Adds work.
    pub(crate) fn add(&mut self, work_j: f64) {
        self.done_j += work_j;
    }

    pub(crate) fn saved(&self) -> SavedWork {
        let WorkAccount { done_j, energy_j, largest_j, excess_j } = *self;
        SavedWork { done_j, energy_j, largest_j, excess_j }
    }

    pub(crate) fn restored(saved: &SavedWork) -> Result<Self> {
        let SavedWork { done_j, energy_j, largest_j, excess_j } = *saved;
        let is_finite = [done_j, energy_j, largest_j, excess_j].iter().all(|energy_j| energy_j.is_finite());
        ensure(is_finite, "an energy that is not finite")?;
        Ok(WorkAccount { done_j, energy_j, largest_j, excess_j })
    }

    /// Creates an account that begins with the given energy.
    pub(crate) fn begun(energy_j: f64, present_j: f64) -> Self {
        WorkAccount { done_j: present_j, energy_j, largest_j: energy_j, excess_j: 0.0 }
    }

    /// Checks an energy; a rise by `noise` does not count. `present_j` is subtracted from the work so far and
    /// belongs to the next interval. The account then begins anew. Only the excess while tools touch or hold
    /// (`is_touched`) is kept, so that a small gain in every interval can't continue forever. At most [`MARGIN`] of the
    /// present energy is kept: when tools release what they had pressed, the excess goes with the energy, and an energy
    /// that only falls passes.
    pub(crate) fn survey(
        &mut self,
        energy_j: f64,
        present_j: f64,
        noise: Noise,
        is_touched: bool,
    ) -> std::result::Result<(), CheckFailure> {
        let (work_j, before_j) = (self.done_j - present_j, self.energy_j);
        let excess_j = if is_touched { self.excess_j } else { 0.0 } + energy_j - before_j - work_j;
        // NaN is not within it.
        let is_within =
            excess_j <= MARGIN * (before_j.abs() + work_j.abs()) + noise.part * self.largest_j + noise.energy_j;
        if !is_within {
            return Err(CheckFailure::Energy { energy_j, before_j, work_j });
        }
        // Below rest that of a weight is negative.
        let largest_j = self.largest_j.max(energy_j.abs());
        let excess_j = excess_j.clamp(0.0, MARGIN * energy_j.abs());
        *self = WorkAccount { done_j: present_j, energy_j, largest_j, excess_j };
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn energy_comes_from_work_alone() {
        const EXACT: Noise = Noise { part: 0.0, energy_j: 0.0 };
        let begun = WorkAccount::begun(1.0, 0.0);
        // Up to the margin.
        assert_eq!({ begun }.survey(1.04, 0.0, EXACT, false), Ok(()));
        let found = CheckFailure::Energy { energy_j: 1.2, before_j: 1.0, work_j: 0.0 };
        assert_eq!({ begun }.survey(1.2, 0.0, EXACT, false), Err(found));
        let mut worked = begun;
        worked.add(0.25);
        // Work that belongs to the next interval does not count in this one.
        assert!({ worked }.survey(1.25, 0.2, EXACT, false).is_err());
        assert_eq!(worked.survey(1.2, 0.05, EXACT, false), Ok(()));
        assert_eq!(worked, WorkAccount { done_j: 0.05, energy_j: 1.2, largest_j: 1.2, excess_j: 0.0 });
        // A gain within the margin counts against the next while a tool touches, until it is lost again.
        let mut touched = begun;
        assert_eq!(touched.survey(1.04, 0.0, EXACT, true), Ok(()));
        assert!({ touched }.survey(1.06, 0.0, EXACT, true).is_err());
        assert_eq!({ touched }.survey(1.06, 0.0, EXACT, false), Ok(()));
        assert_eq!(touched.survey(1.0, 0.0, EXACT, true), Ok(()));
        assert_eq!(touched.survey(1.04, 0.0, EXACT, true), Ok(()));
        // What is left of a press that is released can't fail for the excess of the press.
        let mut released = begun;
        released.add(1.0);
        assert_eq!(released.survey(2.09, 0.0, EXACT, true), Ok(()));
        released.add(-2.08);
        assert_eq!(released.survey(0.01, 0.0, EXACT, true), Ok(()));
        assert_eq!(released.survey(0.009, 0.0, EXACT, true), Ok(()));
        assert!(released.survey(0.01, 0.0, EXACT, true).is_err());
        // Rounding noise does not count as energy.
        let rounding = Noise { energy_j: 1e-27, ..EXACT };
        assert_eq!(WorkAccount::default().survey(1e-30, 0.0, rounding, true), Ok(()));
        assert!(WorkAccount::default().survey(1e-24, 0.0, rounding, true).is_err());
        // Losing energy is always allowed.
        assert_eq!(worked.survey(0.01, 0.0, EXACT, false), Ok(()));
    }
}
