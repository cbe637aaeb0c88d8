//! Two hands: how evenly they move, and how long both stand still.

use crate::definition::{MeasureDefinition, Scope};

pub(crate) const HAND_BALANCE: MeasureDefinition = MeasureDefinition {
    name: "hand_balance",
    unit: "1",
    scope: Scope::Total,
    range: [0.0, 1.0],
    formula: "shorter over longer path of the two hands; the path of a hand is the longest of its tools",
    source: "Palpate, after the bimanual dexterity of laparoscopic trainers",
    meaning: "How evenly the two hands worked: 1 is equally far, 0 is one hand alone.",
};

pub(crate) const BIMANUAL_IDLE: MeasureDefinition = MeasureDefinition {
    name: "bimanual_idle_s",
    unit: "s",
    scope: Scope::Total,
    range: [0.0, f64::INFINITY],
    formula: "time of the windows in which no tool of either hand is faster than 5 mm/s",
    source: "after D'Angelo et al. 2015, doi:10.1016/j.amjsurg.2014.12.013; the speed is ours",
    meaning: "How long both hands stood still, in the air or on the tissue.",
};

/// Returns the shorter over the longer of two paths, m; `None` if neither hand has moved.
pub(crate) fn balance([a_m, b_m]: [f64; 2]) -> Option<f64> {
    let longer_m = a_m.max(b_m);
    (longer_m > 0.0).then(|| a_m.min(b_m) / longer_m)
}
