//! The force over time, for a curve, and the times at which a tool was above a limit: in bounded memory.

use std::collections::BTreeMap;

use crate::input::ToolRow;
use crate::limit::{LimitKind, ToolLimits};

/// The largest number of values of a curve. One that is longer is coarsened by pairs.
pub const MAX_CURVE_VALUES: usize = 4096;

/// The largest number of crossings that are kept.
pub const MAX_CROSSINGS: usize = 1000;

/// A time in which a tool was above a limit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LimitCrossing {
    /// The tool.
    pub tool: u32,
    /// The limit.
    pub limit: LimitKind,
    /// The first and the last step at whose end it was.
    pub steps: [u64; 2],
    /// The largest value in it: N, Pa, or a strain.
    pub peak: f64,
}

/// The force of each tool over time, and when it was above a limit.
#[derive(Debug, Clone)]
pub struct Timeline {
    rate_hz: f64,
    begin_step: u64,
    steps: u64,
    steps_each: u64,
    /// By tool: the largest force in each interval, N.
    curves: BTreeMap<u32, Vec<f64>>,
    crossings: Vec<LimitCrossing>,
    count: u64,
    /// By tool and limit: its crossing that goes on, as an index if it is kept.
    open: BTreeMap<(u32, usize), Option<usize>>,
}

impl Timeline {
    pub(crate) fn new(rate_hz: f64, begin_step: u64) -> Self {
        Timeline {
            rate_hz,
            begin_step,
            steps: 0,
            steps_each: 1,
            curves: BTreeMap::new(),
            crossings: Vec::new(),
            count: 0,
            open: BTreeMap::new(),
        }
    }

    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn step(&mut self, rows: &[ToolRow], limits: ToolLimits) {
        if (self.steps / self.steps_each) as usize == MAX_CURVE_VALUES {
            for curve in self.curves.values_mut() {
                *curve = curve.chunks(2).map(|pair| pair.iter().copied().fold(0.0, f64::max)).collect();
            }
            self.steps_each *= 2;
        }
        let index = (self.steps / self.steps_each) as usize;
        self.steps += 1;
        for row in rows {
            let force_n = row.limited(LimitKind::Force);
            let curve = self.curves.entry(row.tool).or_default();
            curve.resize(index + 1, 0.0);
            curve[index] = curve[index].max(force_n);
            for (kind, limit) in limits.given() {
                let value = row.limited(kind);
                if value > limit {
                    self.cross(row.tool, kind, value);
                } else {
                    self.open.remove(&(row.tool, kind as usize));
                }
            }
        }
        self.open.retain(|(tool, _), _| rows.iter().any(|row| row.tool == *tool));
    }

    fn cross(&mut self, tool: u32, limit: LimitKind, value: f64) {
        let step = self.begin_step + self.steps;
        let index = *self.open.entry((tool, limit as usize)).or_insert_with(|| {
            self.count += 1;
            (self.crossings.len() < MAX_CROSSINGS).then(|| {
                self.crossings.push(LimitCrossing { tool, limit, steps: [step, step], peak: 0.0 });
                self.crossings.len() - 1
            })
        });
        if let Some(crossing) = index.map(|index| &mut self.crossings[index]) {
            (crossing.steps[1], crossing.peak) = (step, crossing.peak.max(value));
        }
    }

    /// Returns the time from one value of a curve to the next, s.
    #[allow(clippy::cast_precision_loss)]
    pub fn interval_s(&self) -> f64 {
        self.steps_each as f64 / self.rate_hz
    }

    /// Returns the curves, by ascending tool: the largest force in contact in each interval from the beginning on, N; 0
    /// without contact. A curve ends with the last use of its tool.
    pub fn curves(&self) -> impl Iterator<Item = (u32, &[f64])> {
        self.curves.iter().map(|(tool, curve)| (*tool, curve.as_slice()))
    }

    /// Returns the times above a limit, by ascending first step: the first [`MAX_CROSSINGS`] of them.
    pub fn crossings(&self) -> &[LimitCrossing] {
        &self.crossings
    }

    /// Returns how often a limit was crossed.
    pub fn crossing_count(&self) -> u64 {
        self.count
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;
    use crate::input::MeasureOptions;
    use crate::tool::tests::{pressed, row};

    #[test]
    fn a_curve_keeps_each_peak_and_a_limit_each_crossing() {
        let limits = ToolLimits { force_n: Some(1.0), ..ToolLimits::default() };
        let options = MeasureOptions { limits, ..MeasureOptions::default() };
        let strong = [100, 9000, 9001, 19_990];
        let measures = pressed(&options, 20_000, |step| {
            let force_n = if strong.contains(&step) { 2.0 } else { 0.5 };
            ToolRow { force_n: force_n * DVec3::Z, is_in_contact: true, ..row(DVec3::ZERO) }
        });
        let timeline = measures.timeline();
        let steps: Vec<[u64; 2]> = timeline.crossings().iter().map(|crossing| crossing.steps).collect();
        assert_eq!((steps, timeline.crossing_count()), (vec![[100, 100], [9000, 9001], [19_990, 19_990]], 3));
        let (_, curve) = timeline.curves().next().unwrap();
        assert_eq!((timeline.interval_s(), curve.len()), (0.008, 2500));
        let peaks: Vec<usize> = (0..curve.len()).filter(|k| curve[*k] == 2.0).collect();
        assert_eq!(peaks, [12, 1124, 1125, 2498]);
    }
}
