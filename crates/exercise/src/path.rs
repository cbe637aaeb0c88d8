//! The path of a tool: its length, its economy, and the speed.

use glam::DVec3;

use crate::definition::{Figures, MeasureDefinition, Scope};
use crate::window::{MotionWindow, WindowSampler};

pub(crate) const PATH_LENGTH: MeasureDefinition = MeasureDefinition {
    name: "path_length_m",
    unit: "m",
    scope: Scope::Both,
    range: [0.0, f64::INFINITY],
    formula: "Σ |Δx| over the windows; of all tools, the sum",
    source: "Datta et al. 2001, doi:10.1016/S1072-7515(01)01041-9",
    meaning: "How far the tool moved: experts need shorter ways.",
};

pub(crate) const ECONOMY: MeasureDefinition = MeasureDefinition {
    name: "economy",
    unit: "1",
    scope: Scope::Tool,
    range: [0.0, 1.0],
    formula: "Σ |x(end) − x(begin)| of each use of the tool, over the path length",
    source: "Palpate, after the economy of movement of laparoscopic trainers",
    meaning: "How straight the way was: 1 is a straight line, and a way back to its begin has 0.",
};

pub(crate) const MEAN_SPEED: MeasureDefinition = MeasureDefinition {
    name: "mean_speed_m_per_s",
    unit: "m/s",
    scope: Scope::Tool,
    range: [0.0, f64::INFINITY],
    formula: "path length over the time in use",
    source: "Palpate",
    meaning: "How fast the tool moved on average.",
};

pub(crate) const PEAK_SPEED: MeasureDefinition = MeasureDefinition {
    name: "peak_speed_m_per_s",
    unit: "m/s",
    scope: Scope::Tool,
    range: [0.0, f64::INFINITY],
    formula: "max |Δx|/Δt over the whole windows",
    source: "Palpate",
    meaning: "How fast the tool moved at most.",
};

/// The path of one tool.
#[derive(Debug, Clone, Default)]
pub(crate) struct ToolPath {
    length_m: f64,
    straight_m: f64,
    peak_m_per_s: f64,
    begin_m: DVec3,
    newest_m: DVec3,
}

impl ToolPath {
    /// Begins a use of the tool.
    pub(crate) fn begin(&mut self, place_m: DVec3) {
        self.straight_m += self.newest_m.distance(self.begin_m);
        (self.begin_m, self.newest_m) = (place_m, place_m);
    }

    pub(crate) fn window(&mut self, window: &MotionWindow) {
        self.length_m += window.way_m.length();
        self.newest_m += window.way_m;
        if window.is_whole {
            self.peak_m_per_s = self.peak_m_per_s.max(window.velocity_m_per_s().length());
        }
    }

    /// Returns the length of the path, m, with what has moved since the last window.
    pub(crate) fn length_m(&self, sampler: &WindowSampler) -> f64 {
        self.length_m + sampler.way_m().length()
    }

    pub(crate) fn figures(&self, sampler: &WindowSampler, time_s: f64, figures: &mut Figures) {
        let length_m = self.length_m(sampler);
        let straight_m = self.straight_m + (self.newest_m + sampler.way_m()).distance(self.begin_m);
        figures.add(&PATH_LENGTH, length_m);
        // Rounding may make the straight line longer than the path along it.
        figures.add(&ECONOMY, (length_m > 0.0).then(|| (straight_m / length_m).min(1.0)));
        figures.add(&MEAN_SPEED, (time_s > 0.0).then(|| length_m / time_s));
        figures.add(&PEAK_SPEED, self.peak_m_per_s);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::tool::tests::{figure, moved};

    #[test]
    fn the_path_along_a_circle_is_its_circumference_and_leads_nowhere() {
        let radius_m = 0.03;
        let tool = moved(2000, |time_s| {
            let angle = std::f64::consts::PI * time_s;
            DVec3::new(radius_m * libm::cos(angle), radius_m * libm::sin(angle), 0.01)
        });
        let round_m = std::f64::consts::TAU * radius_m;
        let near = |name: &str, expected: f64| {
            let value = figure(&tool, name).unwrap();
            assert!((value - expected).abs() < 1e-3 * round_m, "{name}: {value} instead of {expected}");
        };
        near("path_length_m", round_m);
        near("economy", 0.0);
        near("mean_speed_m_per_s", round_m / 2.0);
        near("peak_speed_m_per_s", round_m / 2.0);
    }

    #[test]
    fn a_straight_way_has_an_economy_of_one_also_between_two_windows() {
        let tool = moved(1234, |time_s| DVec3::new(0.1 * time_s, 0.2 * time_s, 0.0));
        assert!((figure(&tool, "economy").unwrap() - 1.0).abs() < 1e-9);
        let length_m = libm::sqrt(0.05) * 1.234;
        assert!((figure(&tool, "path_length_m").unwrap() - length_m).abs() < 1e-9);
    }
}
