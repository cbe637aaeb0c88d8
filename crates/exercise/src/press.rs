//! Presses of a tool, and the search between them.
//!
//! A press begins when the force in contact reaches a threshold, and ends when it falls below half of it, so that a force
//! near the threshold is one press and not many. The rest of the contact is search (Laufer, Klatzky and Pugh 2024).

use crate::definition::{Figures, MeasureDefinition, Scope};
use crate::input::ToolRow;

const LAUFER: &str = "after Laufer et al. 2024, doi:10.1097/ACM.0000000000005614; the threshold is ours";

const fn of_presses(
    name: &'static str,
    scope: Scope,
    unit: &'static str,
    formula: &'static str,
    meaning: &'static str,
) -> MeasureDefinition {
    MeasureDefinition { name, unit, scope, range: [0.0, f64::INFINITY], formula, source: LAUFER, meaning }
}

pub(crate) const PRESS_COUNT: MeasureDefinition = of_presses(
    "press_count",
    Scope::Both,
    "1",
    "how often |F| in contact reached the threshold of a press, after it was below half of it",
    "How often the tissue was pressed.",
);

pub(crate) const MEAN_PRESS_TIME: MeasureDefinition = of_presses(
    "mean_press_time_s",
    Scope::Tool,
    "s",
    "time of all presses over their number",
    "How long a press took on average.",
);

pub(crate) const SEARCH_TIME: MeasureDefinition = of_presses(
    "search_time_s",
    Scope::Tool,
    "s",
    "contact time without the presses",
    "How long the tool touched the tissue lightly, as in a search.",
);

/// The presses of one tool.
#[derive(Debug, Clone, Default)]
pub(crate) struct Presses {
    pub(crate) count: u64,
    steps: u64,
    is_pressing: bool,
}

impl Presses {
    /// Ends a use of the tool.
    pub(crate) fn end(&mut self) {
        self.is_pressing = false;
    }

    pub(crate) fn step(&mut self, row: &ToolRow, press_n: f64) {
        let threshold_n = if self.is_pressing { 0.5 * press_n } else { press_n };
        let presses = row.is_in_contact && row.force_n.length() >= threshold_n;
        self.count += u64::from(presses && !self.is_pressing);
        self.steps += u64::from(presses);
        self.is_pressing = presses;
    }

    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn figures(&self, contact_steps: u64, rate_hz: f64, figures: &mut Figures) {
        figures.add(&PRESS_COUNT, self.count as f64);
        let time_s = self.steps as f64 / rate_hz;
        figures.add(&MEAN_PRESS_TIME, (self.count > 0).then(|| time_s / self.count as f64));
        figures.add(&SEARCH_TIME, contact_steps.saturating_sub(self.steps) as f64 / rate_hz);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use glam::DVec3;

    use super::*;
    use crate::input::MeasureOptions;
    use crate::tool::tests::{figure, pressed, row};

    #[test]
    fn a_force_that_trembles_around_the_threshold_is_one_press() {
        let options = MeasureOptions { press_n: 0.2, ..MeasureOptions::default() };
        // A light touch, then 0.4 s around the threshold, twice.
        let tool = pressed(&options, 2000, |step| {
            let force_n = match step % 1000 {
                1..=600 => 0.05,
                step => {
                    if step % 2 == 0 {
                        0.15
                    } else {
                        0.25
                    }
                }
            };
            ToolRow { force_n: force_n * DVec3::Z, is_in_contact: true, ..row(DVec3::ZERO) }
        });
        assert_eq!(figure(&tool, "press_count"), Some(2.0));
        let near = |name: &str, expected: f64| (figure(&tool, name).unwrap() - expected).abs() < 2e-3;
        assert!(near("mean_press_time_s", 0.4) && near("search_time_s", 1.2));
    }
}
