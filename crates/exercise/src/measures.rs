//! All measures of a session, step by step: of each tool, of all together, of the surface, and the force over time.

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::DVec3;

use crate::coverage::PressedSurface;
use crate::definition::{Figure, Figures};
use crate::force::ForceMeasures;
use crate::hands::{BIMANUAL_IDLE, HAND_BALANCE, balance};
use crate::input::{MeasureOptions, ToolRow};
use crate::path::PATH_LENGTH;
use crate::press::PRESS_COUNT;
use crate::time::{CONTACT_TIME, TIME};
use crate::timeline::Timeline;
use crate::tool::{ToolMeasures, WindowResult};
use crate::window::window_steps;

/// The measures of a session so far.
///
/// A tool that presses with 1 N for a second:
///
/// ```
/// use glam::DVec3;
/// use palpate_exercise::{MeasureOptions, Measures, ToolRow};
///
/// let mut measures = Measures::new(1000.0, 0, MeasureOptions::default(), std::iter::empty());
/// let row = ToolRow {
///     tool: 0,
///     place_m: DVec3::ZERO,
///     force_n: DVec3::Z,
///     is_in_contact: true,
///     indentation_m: 0.002,
///     disc: None,
///     strain: None,
/// };
/// measures.begin(&[row]);
/// (0..1000).for_each(|_| measures.step(&[row]));
/// let integral = |figure: &&_| matches!(figure, palpate_exercise::Figure { definition, tool: None, .. }
///     if definition.name == "force_integral_n_s");
/// let figures = measures.figures();
/// let figure = figures.iter().find(integral).expect("the tool touched the tissue");
/// assert!((figure.value - 1.0).abs() < 1e-12);
/// ```
#[derive(Debug, Clone)]
pub struct Measures {
    rate_hz: f64,
    options: MeasureOptions,
    /// Steps done at the beginning, and since.
    begin_step: u64,
    steps: u64,
    /// Steps in which any tool was in contact.
    contact_steps: u64,
    /// Windows in which no tool moved.
    idle_windows: u64,
    /// Whether a tool that left in the present window had moved in it.
    has_moved: bool,
    tools: BTreeMap<u32, ToolMeasures>,
    /// Shared with a copy of the measures until it changes.
    surface: Arc<PressedSurface>,
    timeline: Timeline,
}

impl Measures {
    /// Begins at step `begin_step`. `rate_hz` is the number of steps per second, above 0; `options` must have passed
    /// [`MeasureOptions::check`]. `triangles_m` is the surface at rest, m, counter-clockwise from outside; without it
    /// there is no coverage.
    pub fn new(
        rate_hz: f64,
        begin_step: u64,
        options: MeasureOptions,
        triangles_m: impl Iterator<Item = [DVec3; 3]>,
    ) -> Self {
        Measures {
            rate_hz,
            options,
            begin_step,
            steps: 0,
            contact_steps: 0,
            idle_windows: 0,
            has_moved: false,
            tools: BTreeMap::new(),
            surface: Arc::new(PressedSurface::new(triangles_m)),
            timeline: Timeline::new(rate_hz, begin_step),
        }
    }

    /// Returns measures with the same thresholds and surface that begin at step `begin_step`. These must have taken no row.
    #[must_use]
    pub fn beginning_at(&self, begin_step: u64) -> Self {
        Measures { begin_step, timeline: Timeline::new(self.rate_hz, begin_step), ..self.clone() }
    }

    /// Takes the rows of the tools at the beginning, before the first step.
    pub fn begin(&mut self, rows: &[ToolRow]) {
        for row in rows {
            self.tools.entry(row.tool).or_insert_with(|| ToolMeasures::new(self.rate_hz)).place(row);
        }
    }

    /// Takes the rows of the tools at the end of the next step, one for each tool in use, by ascending number. A tool
    /// without a row is not in use.
    pub fn step(&mut self, rows: &[ToolRow]) {
        self.steps += 1;
        self.contact_steps += u64::from(rows.iter().any(|row| row.is_in_contact));
        let mut ended: Vec<WindowResult> = Vec::new();
        for (number, tool) in &mut self.tools {
            if rows.binary_search_by_key(number, |row| row.tool).is_err() {
                let result = tool.leave();
                let hands = &self.options.hands;
                let is_of_hand = hands.is_empty() || hands.iter().any(|hand| hand.contains(number));
                self.has_moved |= result.moves && is_of_hand;
                ended.push(result);
            }
        }
        for row in rows {
            let tool = self.tools.entry(row.tool).or_insert_with(|| ToolMeasures::new(self.rate_hz));
            tool.step(row, &self.options);
        }
        self.timeline.step(rows, self.options.limits);
        if self.steps.is_multiple_of(window_steps(self.rate_hz)) {
            let hands = &self.options.hands;
            let is_of_hand = |number: &u32| hands.is_empty() || hands.iter().any(|hand| hand.contains(number));
            let (mut results, mut moves) = (Vec::new(), self.has_moved);
            for (number, tool) in &mut self.tools {
                let result = tool.end_window();
                moves |= result.moves && is_of_hand(number);
                results.push(result);
            }
            self.idle_windows += u64::from(!moves);
            self.has_moved = false;
            ended.extend(results);
        }
        for disc in ended.iter().filter_map(|result| result.disc) {
            Arc::make_mut(&mut self.surface).press(&disc);
        }
    }

    /// Returns the number of steps since the beginning.
    pub fn steps(&self) -> u64 {
        self.steps
    }

    /// Returns the number of steps that were done at the beginning.
    pub fn begin_step(&self) -> u64 {
        self.begin_step
    }

    /// Returns the thresholds.
    pub fn options(&self) -> &MeasureOptions {
        &self.options
    }

    /// Returns the surface with the largest pressure so far.
    pub fn surface(&self) -> &PressedSurface {
        &self.surface
    }

    /// Returns the force over time, and when a limit was exceeded.
    pub fn timeline(&self) -> &Timeline {
        &self.timeline
    }

    /// Returns the figures so far: those of all tools together, then those of each tool, by ascending number.
    pub fn figures(&self) -> Vec<Figure> {
        let mut all = self.total();
        for (number, tool) in &self.tools {
            let mut figures = Figures::of(Some(*number));
            tool.figures(&self.options, &mut figures);
            all.extend(figures.list);
        }
        all
    }

    #[allow(clippy::cast_precision_loss)]
    fn total(&self) -> Vec<Figure> {
        let mut figures = Figures::of(None);
        figures.add(&TIME, self.steps as f64 / self.rate_hz);
        figures.add(&CONTACT_TIME, self.contact_steps as f64 / self.rate_hz);
        figures.add(&PATH_LENGTH, self.tools.values().map(ToolMeasures::path_length_m).sum::<f64>());
        let mut forces = ForceMeasures::default();
        self.tools.values().for_each(|tool| forces.join(&tool.forces));
        let contact_steps = self.tools.values().map(|tool| tool.times.contact_steps).sum();
        forces.figures(contact_steps, self.rate_hz, self.options.limits, &mut figures);
        figures.add(&PRESS_COUNT, self.tools.values().map(|tool| tool.presses.count).sum::<u64>() as f64);
        if let Some(paths_m) = self.paths_of_hands_m() {
            figures.add(&HAND_BALANCE, balance(paths_m));
            let window_s = window_steps(self.rate_hz) as f64 / self.rate_hz;
            figures.add(&BIMANUAL_IDLE, self.idle_windows as f64 * window_s);
        }
        self.surface.figures(self.options.coverage_pa, &mut figures);
        figures.list
    }

    /// Returns the paths of the two hands, m; `None` if there are not two.
    fn paths_of_hands_m(&self) -> Option<[f64; 2]> {
        let path_m = |tool: &u32| self.tools.get(tool).map_or(0.0, ToolMeasures::path_length_m);
        match self.options.hands.as_slice() {
            [one, other] => Some([one, other].map(|hand| hand.iter().map(path_m).fold(0.0, f64::max))),
            _ => {
                let numbers: Vec<u32> = self.tools.keys().copied().collect();
                <[u32; 2]>::try_from(numbers).ok().map(|pair| pair.map(|tool| path_m(&tool)))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::tool::tests::row;

    fn total(measures: &Measures, name: &str) -> Option<f64> {
        let of = |figure: &&Figure| figure.tool.is_none() && figure.definition.name == name;
        measures.figures().iter().find(of).map(|figure| figure.value)
    }

    #[test]
    fn two_hands_have_their_balance_and_the_time_in_which_both_rest() {
        let mut measures = Measures::new(1000.0, 0, MeasureOptions::default(), std::iter::empty());
        let at = |tool: u32, x_m: f64| ToolRow { tool, ..row(DVec3::new(x_m, 0.0, 0.0)) };
        measures.begin(&[at(0, 0.0), at(1, 0.0)]);
        // One second of one hand at 0.1 m/s, a second of rest, two seconds of the other hand at 0.1 m/s.
        for step in 1..=4000 {
            let time_s = f64::from(step) / 1000.0;
            measures.step(&[at(0, 0.1 * time_s.min(1.0)), at(1, 0.1 * (time_s - 2.0).max(0.0))]);
        }
        let near = |name: &str, expected: f64| (total(&measures, name).unwrap() - expected).abs() < 1e-9;
        assert!(near("hand_balance", 0.5) && near("bimanual_idle_s", 1.0) && near("path_length_m", 0.3));
    }

    #[test]
    fn a_tool_that_goes_and_comes_again_has_no_path_and_no_work_in_between() {
        let mut measures = Measures::new(1000.0, 0, MeasureOptions::default(), std::iter::empty());
        let at = |x_m: f64| ToolRow { force_n: -DVec3::X, is_in_contact: true, ..row(DVec3::new(x_m, 0.0, 0.0)) };
        for step in 1..=300 {
            match step {
                1..=105 => measures.step(&[at(1e-3 * f64::from(step))]),
                106..=200 => measures.step(&[]),
                _ => measures.step(&[at(5.0)]),
            }
        }
        let value = |name: &str| crate::tool::tests::figure(&measures, name).unwrap();
        assert!((value("path_length_m") - 0.104).abs() < 1e-12, "{}", value("path_length_m"));
        assert!((value("work_j") - 0.104).abs() < 1e-12, "{}", value("work_j"));
        assert!((value("time_s") - 0.205).abs() < 1e-12 && (total(&measures, "time_s").unwrap() - 0.3).abs() < 1e-12);
        assert!((value("economy") - 1.0).abs() < 1e-12, "{}", value("economy"));
    }
}
