//! Displacement and force of a run over time, drawn as text for a terminal.

use std::fmt;

use textplots::{Chart, LabelBuilder, LabelFormat, Plot, Shape};

/// The number of values from which on every second one is left out. A terminal shows 140 dots side by side.
const MOST_KEPT: usize = 4096;

/// Displacement and force along z of one tool or point over time. The memory does not grow with the length of a run.
#[derive(Debug, Clone, Default)]
pub struct Curves {
    /// Time, s, and displacement, m.
    displacement: Vec<(f32, f32)>,
    /// Time, s, and force of the tissue, N.
    force: Vec<(f32, f32)>,
    /// Values added so far.
    added: u64,
    /// Of 2 to this power values one is kept.
    halvings: u32,
}

impl Curves {
    /// Adds the displacement, m, and the force of the tissue, N, along z at a time, s. Times ascend.
    #[allow(clippy::cast_possible_truncation)]
    pub fn add(&mut self, time_s: f64, displacement_m: f64, force_n: f64) {
        if self.displacement.len() == MOST_KEPT {
            for curve in [&mut self.displacement, &mut self.force] {
                let mut is_kept = false;
                curve.retain(|_| {
                    is_kept = !is_kept;
                    is_kept
                });
            }
            self.halvings += 1;
        }
        if self.added.trailing_zeros() >= self.halvings {
            self.displacement.push((time_s as f32, displacement_m as f32));
            self.force.push((time_s as f32, force_n as f32));
        }
        self.added += 1;
    }
}

impl fmt::Display for Curves {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}", draw("Displacement of the control point along z, m", &self.displacement))?;
        write!(f, "{}", draw("Force of the tissue on the tool along z, N", &self.force))
    }
}

/// Draws `points` (time in s, value) under a title.
fn draw(title: &str, points: &[(f32, f32)]) -> String {
    let (Some(first), Some(last)) = (points.first(), points.last()) else { return format!("{title}: nothing") };
    let values = points.iter().map(|point| point.1);
    let (low, high) = values.fold((0.0_f32, 0.0_f32), |(low, high), value| (low.min(value), high.max(value)));
    if low == high || first.0 == last.0 {
        return format!("{title}: {high} throughout");
    }
    let curve = Shape::Lines(points);
    let mut chart = Chart::new_with_y_range(140, 50, first.0, last.0, low, high);
    let format = |value: f32| format!("{value:.3}");
    let chart = chart.lineplot(&curve);
    let chart = chart
        .x_label_format(LabelFormat::Custom(Box::new(move |value| format!("{value:.2} s"))))
        .y_label_format(LabelFormat::Custom(Box::new(format)));
    chart.axis();
    chart.figures();
    format!("{title}\n{chart}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_runs_keep_evenly_spaced_values_and_little_memory() {
        let mut curves = Curves::default();
        for index in 0..100_000_u32 {
            curves.add(f64::from(index), 0.0, f64::from(index));
            assert!(curves.force.len() <= MOST_KEPT);
        }
        // 100,000 values fit in after five halvings.
        let times: Vec<f32> = curves.force.iter().map(|value| value.0).collect();
        assert_eq!(times, (0..3125_u16).map(|k| 32.0 * f32::from(k)).collect::<Vec<_>>());
        assert!(curves.to_string().contains("Force of the tissue on the tool along z, N\n"), "{curves}");
        assert!(curves.to_string().contains("along z, m: 0 throughout\n"), "{curves}");
    }
}
