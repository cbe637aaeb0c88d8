//! Times of a tool: in use, in contact, and idle.

use crate::definition::{Figures, MeasureDefinition, Scope};
use crate::input::ToolRow;
use crate::window::MotionWindow;

/// The speed, m/s, below which a tool stands still: faster than drift, slower than any purposeful movement.
pub(crate) const STANDSTILL_M_PER_S: f64 = 0.005;

pub(crate) const TIME: MeasureDefinition = MeasureDefinition {
    name: "time_s",
    unit: "s",
    scope: Scope::Both,
    range: [0.0, f64::INFINITY],
    formula: "number of steps over their rate; of a tool, those in which it is in use",
    source: "Palpate",
    meaning: "How long it took.",
};

pub(crate) const CONTACT_TIME: MeasureDefinition = MeasureDefinition {
    name: "contact_time_s",
    unit: "s",
    scope: Scope::Both,
    range: [0.0, f64::INFINITY],
    formula: "time of the steps at whose end the tool is in contact; of all tools, any of them",
    source: "Palpate",
    meaning: "How long the tissue was touched.",
};

pub(crate) const IDLE_TIME: MeasureDefinition = MeasureDefinition {
    name: "idle_time_s",
    unit: "s",
    scope: Scope::Tool,
    range: [0.0, f64::INFINITY],
    formula: "time of the windows without contact in which the tool is slower than 5 mm/s",
    source: "after D'Angelo et al. 2015, doi:10.1016/j.amjsurg.2014.12.013; the speed is ours",
    meaning: "How long the tool stood still in the air: time to plan, or to hesitate.",
};

/// The times of one tool, by numbers of steps, so that no rounding adds up.
#[derive(Debug, Clone, Default)]
pub(crate) struct Times {
    pub(crate) steps: u64,
    pub(crate) contact_steps: u64,
    idle_s: f64,
}

impl Times {
    pub(crate) fn step(&mut self, row: &ToolRow) {
        self.steps += 1;
        self.contact_steps += u64::from(row.is_in_contact);
    }

    pub(crate) fn window(&mut self, window: &MotionWindow) {
        if !window.touches && window.velocity_m_per_s().length() < STANDSTILL_M_PER_S {
            self.idle_s += window.time_s;
        }
    }

    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn figures(&self, rate_hz: f64, figures: &mut Figures) {
        figures.add(&TIME, self.steps as f64 / rate_hz);
        figures.add(&CONTACT_TIME, self.contact_steps as f64 / rate_hz);
        figures.add(&IDLE_TIME, self.idle_s);
    }
}
