//! Draws measured and fitted curves, and what is between them, as SVG.

use std::fmt::Write as _;

use palpate_fitting::curve_file::MeasuredCurve;

use super::super::markup::{escaped, mark_distance};

/// Curves that are drawn, at most: each is a row.
const MAX_CURVES: usize = 24;

/// Size of a panel, pixels, and its margins: left, right, above, below.
const PANEL: [f64; 2] = [400.0, 260.0];
const MARGINS: [f64; 4] = [62.0, 14.0, 30.0, 40.0];

/// Samples of a curve that are drawn, at most.
const MAX_DRAWN: usize = 1000;

const MEASURED: &str = "#0072b2";
const FITTED: &str = "#d55e00";

/// A diagram of points and a line over the same values along x.
struct Panel<'p> {
    title: &'p str,
    axes: [&'p str; 2],
    x: Vec<f64>,
    points: Vec<f64>,
    line: Vec<f64>,
}

/// Returns a picture: for each curve, at most 24, force over time, force over depth, and fitted − measured over time.
pub(super) fn svg(curves: &[MeasuredCurve], fitted_n: &[Vec<f64>]) -> String {
    let rows = curves.len().min(MAX_CURVES);
    let [width, height] = [3.0 * PANEL[0], PANEL[1] * rows as f64 + 24.0];
    let mut text = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} {height}\" \
         font-family=\"sans-serif\" font-size=\"12\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n\
         <circle cx=\"70\" cy=\"12\" r=\"2.5\" fill=\"{MEASURED}\"/><text x=\"80\" y=\"16\">measured</text>\n\
         <path d=\"M150 12h20\" stroke=\"{FITTED}\" stroke-width=\"2\"/><text x=\"176\" y=\"16\">fitted</text>\n"
    );
    for (row, (curve, fitted_n)) in curves.iter().zip(fitted_n).take(rows).enumerate() {
        let every = curve.force_n.len().div_ceil(MAX_DRAWN).max(1);
        let thin = |values: &mut dyn Iterator<Item = f64>| values.step_by(every).collect::<Vec<f64>>();
        let time_s = thin(&mut curve.press.time_s.iter().copied());
        let depth_mm = thin(&mut curve.press.depth_m.iter().map(|depth_m| 1e3 * depth_m));
        let measured_n = thin(&mut curve.force_n.iter().copied());
        let fitted_n = thin(&mut fitted_n.iter().copied());
        let residual_n: Vec<f64> =
            fitted_n.iter().zip(&measured_n).map(|(fitted, measured)| fitted - measured).collect();
        let panels = [
            Panel {
                title: &curve.name,
                axes: ["time, s", "force, N"],
                x: time_s.clone(),
                points: measured_n.clone(),
                line: fitted_n.clone(),
            },
            Panel { title: "", axes: ["depth, mm", "force, N"], x: depth_mm, points: measured_n, line: fitted_n },
            Panel {
                title: "",
                axes: ["time, s", "fitted − measured, N"],
                x: time_s,
                points: residual_n,
                line: Vec::new(),
            },
        ];
        for (column, panel) in panels.iter().enumerate() {
            panel.draw(&mut text, [PANEL[0] * column as f64, 24.0 + PANEL[1] * row as f64]);
        }
    }
    text + "</svg>\n"
}

/// Returns the range of values, with 0, and round steps in it.
fn range(values: impl Iterator<Item = f64>) -> ([f64; 2], f64) {
    let [low, high] = values.fold([0.0_f64, 0.0_f64], |[low, high], value| [low.min(value), high.max(value)]);
    let span = if high > low { high - low } else { 1.0 };
    ([low - 0.03 * span, low + 1.03 * span], mark_distance(span, 5.0))
}

impl Panel<'_> {
    fn draw(&self, text: &mut String, [x0, y0]: [f64; 2]) {
        let [left, right, above, below] = MARGINS;
        let [width, height] = [PANEL[0] - left - right, PANEL[1] - above - below];
        let ([x_low, x_high], x_step) = range(self.x.iter().copied());
        let ([y_low, y_high], y_step) = range(self.points.iter().chain(&self.line).copied());
        let at_x = |x: f64| x0 + left + width * (x - x_low) / (x_high - x_low);
        let at_y = |y: f64| y0 + above + height * (y_high - y) / (y_high - y_low);
        let ticks = |low: f64, high: f64, step: f64| {
            let first = (low / step).ceil();
            (0..20).map(move |k| (first + f64::from(k)) * step).take_while(move |at| *at <= high)
        };
        let digits = |step: f64| (-step.log10().floor()).clamp(0.0, 9.0) as usize;
        let [bottom, end] = [y0 + above + height, x0 + left + width];
        for x in ticks(x_low, x_high, x_step) {
            let (at, shown) = (at_x(x), digits(x_step));
            let _ = writeln!(
                text,
                "<path d=\"M{at:.1} {:.1}V{bottom:.1}\" stroke=\"#ddd\"/><text x=\"{at:.1}\" y=\"{:.1}\" \
                 text-anchor=\"middle\">{:.shown$}</text>",
                y0 + above,
                bottom + 15.0,
                x + 0.0
            );
        }
        for y in ticks(y_low, y_high, y_step) {
            let (at, shown) = (at_y(y), digits(y_step));
            let _ = writeln!(
                text,
                "<path d=\"M{:.1} {at:.1}H{end:.1}\" stroke=\"#ddd\"/><text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{:.shown$}</text>",
                x0 + left,
                x0 + left - 5.0,
                at + 4.0,
                y + 0.0
            );
        }
        for (x, y) in self.x.iter().zip(&self.points) {
            let _ =
                writeln!(text, "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"2\" fill=\"{MEASURED}\"/>", at_x(*x), at_y(*y));
        }
        if !self.line.is_empty() {
            let points: Vec<String> =
                self.x.iter().zip(&self.line).map(|(x, y)| format!("{:.1},{:.1}", at_x(*x), at_y(*y))).collect();
            let points = points.join(" ");
            let _ = writeln!(
                text,
                "<polyline points=\"{points}\" fill=\"none\" stroke=\"{FITTED}\" stroke-width=\"1.6\"/>"
            );
        }
        let middle = x0 + left + width / 2.0;
        let _ = writeln!(
            text,
            "<text x=\"{middle:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\n\
             <text x=\"{:.1}\" y=\"{:.1}\">{}</text>\n\
             <text x=\"{:.1}\" y=\"{:.1}\" font-weight=\"bold\">{}</text>",
            bottom + 32.0,
            escaped(self.axes[0]),
            x0 + left,
            y0 + above - 8.0,
            escaped(self.axes[1]),
            x0 + left + width / 2.0,
            y0 + above - 8.0,
            escaped(self.title)
        );
    }
}

#[cfg(test)]
mod tests {
    use palpate_haptics::TipShape;
    use palpate_session::press::ImposedPress;

    use super::*;

    #[test]
    fn a_picture_has_a_mark_for_each_sample_and_a_curve_of_any_name() {
        let time_s: Vec<f64> = (0..50).map(|k| 0.1 * f64::from(k)).collect();
        let press = ImposedPress {
            place_m: None,
            shape: TipShape::Disc,
            radius_m: 0.005,
            depth_m: time_s.iter().map(|time_s| 1e-3 * time_s).collect(),
            time_s,
        };
        let curve = MeasuredCurve { name: "<a>&\u{7}".to_owned(), press, force_n: vec![0.1; 50] };
        let text = svg(&[curve], &[vec![0.0; 50]]);
        assert_eq!(text.matches("<circle").count(), 1 + 3 * 50);
        assert!(text.contains("&lt;a&gt;&amp;") && !text.contains('\u{7}') && !text.contains("NaN"), "{text}");
    }
}
