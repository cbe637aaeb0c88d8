//! Curves in the terminal.

use textplots::{Chart, LabelBuilder, LabelFormat, Plot, Shape};

/// Draws `points` (time in s, value) under a title.
pub(crate) fn draw(title: &str, points: &[(f32, f32)]) -> String {
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
