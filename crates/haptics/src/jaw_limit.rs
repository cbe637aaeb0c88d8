//! The limit of the torque between the jaws of an instrument: jaws that close with more crush what they hold.

use crate::instrument::Instrument;

/// Largest limit that can be set, N·m.
pub const MAX_JAW_TORQUE_LIMIT_N_M: f64 = 100.0;

/// Part of the limit below which the torque must fall before it can exceed the limit once more. In between the torque may tremble.
const RELEASED_PART: f64 = 0.8;

/// Watches the torque with which the tissue opens the jaws of an instrument ([`Instrument::opening_n_m`]). Tissue that pulls the jaws
/// together is not crushed, so a negative torque exceeds no limit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JawTorqueMonitor {
    limit_n_m: f64,
    is_above: bool,
}

impl JawTorqueMonitor {
    /// Returns the monitor of an instrument, whose jaws exert no torque yet; `None` without a limit.
    pub fn of(instrument: &Instrument) -> Option<Self> {
        instrument.jaw_torque_limit_n_m.map(|limit_n_m| JawTorqueMonitor { limit_n_m, is_above: false })
    }

    /// Returns the limit, N·m.
    pub fn limit_n_m(&self) -> f64 {
        self.limit_n_m
    }

    /// Takes the torque at the end of a step, N·m. Returns whether it exceeds the limit now and has not before: since the monitor was
    /// made, or since the torque was below 0.8 of the limit. A torque that is not a number changes nothing.
    pub fn exceeds(&mut self, opening_n_m: f64) -> bool {
        if opening_n_m < RELEASED_PART * self.limit_n_m {
            self.is_above = false;
        }
        opening_n_m > self.limit_n_m && !std::mem::replace(&mut self.is_above, true)
    }

    /// Forgets that the torque was above the limit: the instrument was released.
    pub fn reset(&mut self) {
        self.is_above = false;
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    #[test]
    fn jaws_exceed_their_limit_once_until_they_are_well_below_it() {
        let limited = Instrument { jaw_torque_limit_n_m: Some(0.01), ..Instrument::default() };
        let mut monitor = JawTorqueMonitor::of(&limited).unwrap();
        let torques_n_m = [0.0, 0.01, 0.011, 0.5, 0.0081, 0.02, f64::NAN, 0.02, 0.0079, 0.009, 0.0101, -0.02, 0.02];
        let told = torques_n_m.map(|torque_n_m| monitor.exceeds(torque_n_m));
        let expected = [2, 10, 12];
        assert_eq!(told, std::array::from_fn(|at| expected.contains(&at)));
        monitor.reset();
        assert!(monitor.exceeds(0.02) && monitor.limit_n_m() == 0.01);
        assert_eq!(JawTorqueMonitor::of(&Instrument::default()), None);
    }
}
