//! All measures of one tool, from its rows.

use crate::definition::Figures;
use crate::force::ForceMeasures;
use crate::input::{MeasureOptions, PressedDisc, ToolRow};
use crate::jerk::Jerk;
use crate::path::ToolPath;
use crate::press::Presses;
use crate::sparc::SpeedProfile;
use crate::time::{STANDSTILL_M_PER_S, Times};
use crate::window::{WindowSampler, window_steps};

/// The measures of one tool.
#[derive(Debug, Clone)]
pub(crate) struct ToolMeasures {
    rate_hz: f64,
    is_in_use: bool,
    sampler: WindowSampler,
    pub(crate) times: Times,
    path: ToolPath,
    jerk: Jerk,
    speeds: SpeedProfile,
    pub(crate) forces: ForceMeasures,
    pub(crate) presses: Presses,
}

/// What a tool did in a window.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct WindowResult {
    /// Whether it moved faster than a tool that stands still.
    pub(crate) moves: bool,
    /// The disc that it pressed hardest.
    pub(crate) disc: Option<PressedDisc>,
}

impl ToolMeasures {
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn new(rate_hz: f64) -> Self {
        ToolMeasures {
            rate_hz,
            is_in_use: false,
            sampler: WindowSampler::default(),
            times: Times::default(),
            path: ToolPath::default(),
            jerk: Jerk::default(),
            speeds: SpeedProfile::new(rate_hz / window_steps(rate_hz) as f64),
            forces: ForceMeasures::default(),
            presses: Presses::default(),
        }
    }

    /// Takes the row at the beginning, which ends no step.
    pub(crate) fn place(&mut self, row: &ToolRow) {
        self.begin(row, false);
        self.forces.place(row);
    }

    fn begin(&mut self, row: &ToolRow, is_cut: bool) {
        self.is_in_use = true;
        self.sampler.begin(row.place_m, is_cut);
        self.path.begin(row.place_m);
        self.forces.begin();
    }

    /// Takes the row at the end of a step. A tool that was away begins there.
    pub(crate) fn step(&mut self, row: &ToolRow, options: &MeasureOptions) {
        if !self.is_in_use {
            self.begin(row, true);
        }
        self.sampler.add(row);
        self.times.step(row);
        self.forces.step(row, options.limits);
        self.presses.step(row, options.press_n);
    }

    /// Notes that the tool is away in this step. What it had begun in this window is returned.
    pub(crate) fn leave(&mut self) -> WindowResult {
        if !self.is_in_use {
            return WindowResult::default();
        }
        let result = self.end_window();
        self.is_in_use = false;
        self.jerk.end();
        self.presses.end();
        result
    }

    /// Ends a window of all tools.
    pub(crate) fn end_window(&mut self) -> WindowResult {
        let ended = self.sampler.end(window_steps(self.rate_hz), self.rate_hz.recip());
        let Some(window) = ended.filter(|_| self.is_in_use) else { return WindowResult::default() };
        self.times.window(&window);
        self.path.window(&window);
        self.jerk.window(&window);
        self.speeds.window(&window);
        self.forces.window(&window);
        WindowResult { moves: window.velocity_m_per_s().length() >= STANDSTILL_M_PER_S, disc: window.disc }
    }

    /// Returns the length of the path so far, m.
    pub(crate) fn path_length_m(&self) -> f64 {
        self.path.length_m(&self.sampler)
    }

    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn figures(&self, options: &MeasureOptions, figures: &mut Figures) {
        self.times.figures(self.rate_hz, figures);
        self.path.figures(&self.sampler, self.times.steps as f64 / self.rate_hz, figures);
        self.jerk.figures(figures);
        self.speeds.figures(figures);
        self.forces.figures(self.times.contact_steps, self.rate_hz, options.limits, figures);
        self.presses.figures(self.times.contact_steps, self.rate_hz, figures);
    }
}

/// Rows with known results, for the tests of the measures.
#[cfg(test)]
pub(crate) mod tests {
    use glam::DVec3;

    use super::*;
    use crate::measures::Measures;

    /// Steps per second of the tests.
    const RATE_HZ: f64 = 1000.0;

    pub(crate) fn row(place_m: DVec3) -> ToolRow {
        let (force_n, is_in_contact, indentation_m) = (DVec3::ZERO, false, 0.0);
        ToolRow { tool: 0, place_m, force_n, is_in_contact, indentation_m, disc: None, strain: None }
    }

    /// Measures a tool without contact over some steps, by its place over time, s.
    pub(crate) fn moved(steps: u32, place_m: impl Fn(f64) -> DVec3) -> Measures {
        pressed(&MeasureOptions::default(), steps, |step| row(place_m(f64::from(step) / RATE_HZ)))
    }

    /// Measures a tool over some steps, by its row at the end of each; that of step 0 is its beginning.
    pub(crate) fn pressed(options: &MeasureOptions, steps: u32, mut row: impl FnMut(u32) -> ToolRow) -> Measures {
        let mut measures = Measures::new(RATE_HZ, 0, options.clone(), std::iter::empty());
        measures.begin(&[row(0)]);
        (1..=steps).for_each(|step| measures.step(&[row(step)]));
        measures
    }

    /// Returns the figure of tool 0.
    pub(crate) fn figure(measures: &Measures, name: &str) -> Option<f64> {
        let of = |figure: &&crate::Figure| figure.tool == Some(0) && figure.definition.name == name;
        measures.figures().iter().find(of).map(|figure| figure.value)
    }

    /// The way from 0 to 1 with the least jerk, for a part of its time from 0 to 1 (Flash and Hogan 1985).
    pub(crate) fn least_jerk(part: f64) -> f64 {
        let s = part.clamp(0.0, 1.0);
        s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
    }
}
