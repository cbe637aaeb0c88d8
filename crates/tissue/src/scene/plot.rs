//! Draws displacement and force of a run over time, as text for a terminal.

use std::fmt;

use glam::DVec3;
use textplots::{Chart, LabelBuilder, LabelFormat, Plot, Shape};

use crate::shape::RestShape;

/// Number of values from which every second one is left out. A terminal shows 140 dots side by side.
const MAX_KEPT: usize = 4096;

/// Displacement and force of one tool or point over time, for a chart (`Display`, 140 dots wide, on several
/// lines): on a sheet components along z, as in the paper's figures; on a mesh, which is pressed from any side,
/// lengths. At most 4096 values are kept, evenly spaced, so the memory does not grow with
/// the length of a run.
#[derive(Debug, Clone, Default)]
pub struct Curves {
    of_lengths: bool,
    /// Time, s, and displacement, m.
    displacement: Vec<(f32, f32)>,
    /// Time, s, and force of the tissue, N.
    force: Vec<(f32, f32)>,
    /// Values added so far.
    added: u64,
    /// One of every 2^`halvings` values is kept.
    halvings: u32,
}

impl Curves {
    /// Creates empty curves for a tissue of this shape, of lengths, unless the shape faces up
    /// ([`RestShape::faces_up`]).
    pub fn of(shape: &dyn RestShape) -> Self {
        Curves { of_lengths: !shape.faces_up(), ..Curves::default() }
    }

    /// Adds the displacement, m, and the force of the tissue on the tool, N, at a time, s. Times must ascend,
    /// evenly if the chart is to show all parts alike; this isn't checked. From 4096 kept values on, every
    /// second one is dropped.
    #[allow(clippy::cast_possible_truncation)]
    pub fn add(&mut self, time_s: f64, displacement_m: DVec3, force_n: DVec3) {
        if self.displacement.len() == MAX_KEPT {
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
            let value = |v: DVec3| (time_s as f32, if self.of_lengths { v.length() } else { v.z } as f32);
            self.displacement.push(value(displacement_m));
            self.force.push(value(force_n));
        }
        self.added += 1;
    }
}

impl fmt::Display for Curves {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let titles = if self.of_lengths {
            [
                "Magnitude of the displacement of the control point, m",
                "Magnitude of the force of the tissue on the tool, N",
            ]
        } else {
            ["Displacement of the control point along z, m", "Force of the tissue on the tool along z, N"]
        };
        writeln!(f, "{}", draw(titles[0], &self.displacement))?;
        write!(f, "{}", draw(titles[1], &self.force))
    }
}

/// Returns the chart of `points` (time in s, value) under a title.
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
            curves.add(f64::from(index), DVec3::X, f64::from(index) * DVec3::Z);
            assert!(curves.force.len() <= MAX_KEPT);
        }
        // 100,000 values fit in after five halvings.
        let times: Vec<f32> = curves.force.iter().map(|value| value.0).collect();
        assert_eq!(times, (0..3125_u16).map(|k| 32.0 * f32::from(k)).collect::<Vec<_>>());
        assert!(curves.to_string().contains("Force of the tissue on the tool along z, N\n"), "{curves}");
        assert!(curves.to_string().contains("along z, m: 0 throughout\n"), "{curves}");
    }

    #[test]
    fn curves_of_a_mesh_are_of_lengths() {
        // Pressed from the side.
        let mut curves = Curves { of_lengths: true, ..Curves::default() };
        curves.add(0.0, DVec3::ZERO, DVec3::ZERO);
        curves.add(1.0, DVec3::new(0.003, 0.004, 0.0), DVec3::new(-2.0, 0.0, 0.0));
        assert_eq!([curves.displacement[1].1, curves.force[1].1], [0.005, 2.0]);
        for title in [
            "Magnitude of the displacement of the control point, m\n",
            "Magnitude of the force of the tissue on the tool, N\n",
        ] {
            assert!(curves.to_string().contains(title), "{curves}");
        }
    }
}
