//! Tasks of an exercise that are judged step by step: regions that no tool may touch, and a place that must be lifted and held.

use glam::DVec3;

use crate::definition::{Figures, MeasureDefinition};
use crate::input::ToolRow;

pub(crate) const AVOIDED_CONTACT: MeasureDefinition = MeasureDefinition::of_truth(
    "avoided_contact_s",
    "s",
    f64::INFINITY,
    "time of all steps in which a tool in contact reached a region to avoid, seen along the exercise's direction: a disc with its radius",
    "How long something was touched that must not be.",
);

pub(crate) const AVOIDED_FORCE: MeasureDefinition = MeasureDefinition::of_truth(
    "avoided_peak_force_n",
    "N",
    f64::INFINITY,
    "largest |F| of a tool that reached a region to avoid",
    "How hard something was touched that must not be.",
);

pub(crate) const LIFT_HEIGHT: MeasureDefinition = MeasureDefinition::of_truth(
    "lift_height_m",
    "m",
    f64::INFINITY,
    "largest displacement of the place that must be lifted, against the exercise's direction",
    "How far the tissue was lifted.",
);

pub(crate) const HELD_SHARE: MeasureDefinition = MeasureDefinition::of_truth(
    "held_share",
    "1",
    1.0,
    "longest time in one piece at or above the height of the exercise, over the time asked, at most 1",
    "For which share of the time asked the tissue was held up.",
);

/// A ball that no tool may touch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AvoidedBall {
    /// Its centre, m.
    pub centre_m: DVec3,
    /// Its radius, m.
    pub radius_m: f64,
}

/// A place that must be lifted, and for how long it must be held.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LiftTarget {
    /// The displacement against the exercise's direction from which on it is lifted, m.
    pub height_m: f64,
    /// For how long, s.
    pub hold_s: f64,
}

/// The tasks so far.
#[derive(Debug, Clone, Default)]
pub struct TaskMeasures {
    seen_along: DVec3,
    avoided: Vec<AvoidedBall>,
    avoided_steps: u64,
    avoided_peak_n: f64,
    lift: Option<LiftTarget>,
    lifted_m: f64,
    held_steps: u64,
    longest_steps: u64,
}

impl TaskMeasures {
    /// Begins with the tasks of an exercise. Distances along `seen_along`, a direction of length 1, do not count.
    pub fn new(seen_along: DVec3, avoided: Vec<AvoidedBall>, lift: Option<LiftTarget>) -> Self {
        TaskMeasures { seen_along, avoided, lift, ..TaskMeasures::default() }
    }

    /// Returns the same tasks, of which nothing is done yet.
    #[must_use]
    pub fn again(&self) -> Self {
        TaskMeasures::new(self.seen_along, self.avoided.clone(), self.lift)
    }

    /// Takes `steps` steps at whose ends the tools did what is in `rows`, and the place to lift was displaced by `lifted_m`, m.
    pub fn step(&mut self, rows: &[ToolRow], lifted_m: f64, steps: u64) {
        let is_inside = |row: &&ToolRow| {
            // The surface at rest below a disc; a tool without an area is where it is.
            let (place_m, reach_m) = row.disc.map_or((row.place_m, 0.0), |disc| (disc.rest_m, disc.radius_m));
            let is_near = |ball: &AvoidedBall| {
                let across_m = (place_m - ball.centre_m).reject_from_normalized(self.seen_along);
                across_m.length() <= ball.radius_m + reach_m
            };
            row.is_in_contact && self.avoided.iter().any(is_near)
        };
        let hardest_n = rows.iter().filter(is_inside).map(|row| row.force_n.length()).reduce(f64::max);
        self.avoided_steps += if hardest_n.is_some() { steps } else { 0 };
        self.avoided_peak_n = self.avoided_peak_n.max(hardest_n.unwrap_or(0.0));
        self.lifted_m = self.lifted_m.max(lifted_m);
        let is_held = self.lift.is_some_and(|lift| lifted_m >= lift.height_m);
        self.held_steps = if is_held { self.held_steps + steps } else { 0 };
        self.longest_steps = self.longest_steps.max(self.held_steps);
    }

    /// Adds the figures.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn figures(&self, rate_hz: f64, figures: &mut Figures) {
        if !self.avoided.is_empty() {
            figures.add(&AVOIDED_CONTACT, self.avoided_steps as f64 / rate_hz);
            figures.add(&AVOIDED_FORCE, self.avoided_peak_n);
        }
        if let Some(lift) = self.lift {
            figures.add(&LIFT_HEIGHT, self.lifted_m);
            figures.add(&HELD_SHARE, (self.longest_steps as f64 / rate_hz / lift.hold_s).min(1.0));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(tasks: &TaskMeasures, name: &str) -> Option<f64> {
        let mut figures = Figures::of(None);
        tasks.figures(1000.0, &mut figures);
        figures.list.iter().find(|figure| figure.definition.name == name).map(|figure| figure.value)
    }

    #[test]
    fn a_touch_of_an_avoided_region_counts_with_its_time_and_its_force() {
        let ball = AvoidedBall { centre_m: DVec3::new(0.05, 0.0, 0.0), radius_m: 0.01 };
        let mut tasks = TaskMeasures::new(DVec3::NEG_Z, vec![ball], None);
        let at = |x_m: f64, is_in_contact: bool| ToolRow {
            tool: 0,
            // However deep it is.
            place_m: DVec3::new(x_m, 0.0, -0.2),
            force_n: 2.0 * x_m / 0.05 * DVec3::Z,
            is_in_contact,
            indentation_m: 0.0,
            disc: None,
            strain: None,
        };
        for (x_m, is_in_contact, steps) in [(0.03, true, 7), (0.045, true, 20), (0.05, true, 30), (0.05, false, 100)] {
            tasks.step(&[at(0.0, true), at(x_m, is_in_contact)], 0.0, steps);
        }
        assert_eq!(
            [value(&tasks, "avoided_contact_s"), value(&tasks, "avoided_peak_force_n")],
            [Some(0.05), Some(2.0)]
        );
        assert_eq!([value(&tasks, "held_share"), value(&tasks, "lift_height_m")], [None, None]);
    }

    #[test]
    fn only_the_longest_time_in_one_piece_is_held() {
        let mut tasks = TaskMeasures::new(DVec3::NEG_Z, Vec::new(), Some(LiftTarget { height_m: 0.01, hold_s: 0.5 }));
        for (lifted_m, steps) in [(0.005, 100), (0.012, 150), (0.009, 1), (0.01, 200), (0.0, 10)] {
            tasks.step(&[], lifted_m, steps);
        }
        assert_eq!([value(&tasks, "held_share"), value(&tasks, "lift_height_m")], [Some(0.4), Some(0.012)]);
        assert_eq!(value(&tasks, "avoided_contact_s"), None);
        tasks.step(&[], 0.02, 900);
        assert_eq!(value(&tasks, "held_share"), Some(1.0));
    }
}
