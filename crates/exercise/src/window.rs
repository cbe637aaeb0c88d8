//! Windows of 10 ms of a tool's motion and force, from its rows.

use glam::DVec3;

use crate::input::{PressedDisc, ToolRow};

/// Windows per second, Hz: that of the studies that defined the measures of smoothness.
const WINDOWS_HZ: f64 = 100.0;

/// Returns the steps of a window at `rate_hz` steps per second: 10 ms, or a step if that is longer.
pub(crate) fn window_steps(rate_hz: f64) -> u64 {
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let steps = (rate_hz / WINDOWS_HZ).round() as u64;
    steps.max(1)
}

/// A window of a tool that is in use: some successive steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct MotionWindow {
    /// Its duration, s.
    pub(crate) time_s: f64,
    /// Whether it is a whole window, and not the rest of one in which the tool came or went.
    pub(crate) is_whole: bool,
    /// Movement of the tool in it, m.
    pub(crate) way_m: DVec3,
    /// Mean force on the tool, N.
    pub(crate) force_n: DVec3,
    /// Whether the tool was in contact at the end of any of its steps.
    pub(crate) touches: bool,
    /// The disc with the largest pressure.
    pub(crate) disc: Option<PressedDisc>,
}

impl MotionWindow {
    /// Returns the mean velocity, m/s.
    pub(crate) fn velocity_m_per_s(&self) -> DVec3 {
        self.way_m / self.time_s
    }
}

/// Makes windows of the rows of one tool. All tools' windows end at the same steps.
#[derive(Debug, Clone, Default)]
pub(crate) struct WindowSampler {
    /// Steps in the present window.
    steps: u32,
    is_cut: bool,
    begin_m: DVec3,
    newest_m: DVec3,
    force_n: DVec3,
    touches: bool,
    disc: Option<PressedDisc>,
}

impl WindowSampler {
    /// Begins at a place. `is_cut` is whether the first step's movement is unknown, so that the window is not whole.
    pub(crate) fn begin(&mut self, place_m: DVec3, is_cut: bool) {
        *self = WindowSampler { begin_m: place_m, newest_m: place_m, is_cut, ..Self::default() };
    }

    /// Adds the row of a step.
    pub(crate) fn add(&mut self, row: &ToolRow) {
        self.steps += 1;
        self.newest_m = row.place_m;
        self.force_n += row.force_n;
        self.touches |= row.is_in_contact;
        let pressure_pa = |disc: Option<PressedDisc>| disc.map_or(0.0, |disc| disc.pressure_pa);
        if pressure_pa(row.disc) > pressure_pa(self.disc) {
            self.disc = row.disc;
        }
    }

    /// Returns how far the tool has moved since the last window, m.
    pub(crate) fn way_m(&self) -> DVec3 {
        self.newest_m - self.begin_m
    }

    /// Ends the present window and begins the next; `None` if it has no step. `whole` is the steps of a whole one.
    pub(crate) fn end(&mut self, whole: u64, step_s: f64) -> Option<MotionWindow> {
        if self.steps == 0 {
            return None;
        }
        let steps = f64::from(self.steps);
        let window = MotionWindow {
            time_s: steps * step_s,
            is_whole: !self.is_cut && u64::from(self.steps) == whole,
            way_m: self.way_m(),
            force_n: self.force_n / steps,
            touches: self.touches,
            disc: self.disc,
        };
        self.begin(self.newest_m, false);
        Some(window)
    }
}
