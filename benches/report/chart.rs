//! Charts as SVG: lines over two logarithmic or two plain axes, and maps of coloured cells.

use plotters::coord::Shift;
use plotters::prelude::*;

/// One chart of a picture.
pub enum Panel {
    /// Lines with a marker at each point, over logarithmic axes.
    Lines {
        /// Above the chart.
        title: String,
        /// Below the chart.
        x: &'static str,
        /// Left of the chart.
        y: &'static str,
        /// The lines.
        series: Vec<Series>,
    },
    /// Lines over plain axes.
    Curves {
        /// Above the chart.
        title: String,
        /// Below the chart.
        x: &'static str,
        /// Left of the chart.
        y: &'static str,
        /// The range of y.
        up: std::ops::Range<f64>,
        /// The lines, which may leave the chart.
        series: Vec<Series>,
    },
    /// Cells, the first row at the bottom.
    Cells {
        /// Above the chart.
        title: String,
        /// Below the chart, with the name of each column.
        x: (&'static str, Vec<String>),
        /// Left of the chart, with the name of each row.
        y: (&'static str, Vec<String>),
        /// Text, and its colour from 0 (green) to 1 (red).
        rows: Vec<Vec<(String, f64)>>,
    },
    /// Places of a surface with a value each, as colours, seen from above: both axes have the same scale.
    Places {
        /// Above the chart.
        title: String,
        /// Of the axes.
        unit: &'static str,
        /// Of the values.
        value: &'static str,
        /// Edge of the square that stands for a place.
        size: f64,
        /// Along x and y, and the value.
        places: Vec<[f64; 3]>,
    },
}

/// A line.
#[derive(Clone)]
pub struct Series {
    /// Name in the legend. Panels share one legend, so the same name should have the same look.
    pub name: String,
    /// Index of the colour.
    pub hue: usize,
    /// Style of the line.
    pub look: Look,
    /// Points along x and y.
    pub points: Vec<(f64, f64)>,
}

/// Style of a line.
#[derive(Clone, Copy, PartialEq)]
pub enum Look {
    /// A line with filled markers.
    Full,
    /// A thin line with hollow markers.
    Hollow,
    /// A line without markers.
    Plain,
    /// A broad pale line without markers, drawn below others.
    Broad,
}

const PANEL: (u32, u32) = (480, 360);
const LEGEND_ENTRY: (u32, u32) = (170, 20);

/// Colours that colour-blind readers can distinguish.
const HUES: [RGBColor; 10] = [
    RGBColor(213, 94, 0),
    RGBColor(0, 114, 178),
    RGBColor(90, 90, 90),
    RGBColor(86, 180, 233),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(170, 140, 0),
    RGBColor(60, 30, 110),
    RGBColor(0, 0, 0),
    RGBColor(150, 75, 0),
];

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

impl Series {
    fn style(&self) -> ShapeStyle {
        let colour = HUES[self.hue % HUES.len()];
        match self.look {
            Look::Full | Look::Plain => ShapeStyle::from(&colour).stroke_width(2),
            Look::Hollow => ShapeStyle::from(&colour).stroke_width(1),
            Look::Broad => ShapeStyle::from(&colour.mix(0.25)).stroke_width(9),
        }
    }
}

/// A picture of panels side by side, `columns` to a row, under one legend.
pub fn svg(columns: usize, panels: &[Panel]) -> String {
    let columns = columns.min(panels.len()).max(1);
    let width = PANEL.0 * columns as u32;
    let mut legend: Vec<&Series> = Vec::new();
    for panel in panels {
        let (Panel::Lines { series, .. } | Panel::Curves { series, .. }) = panel else { continue };
        for line in series {
            if !legend.iter().any(|other| other.name == line.name) {
                legend.push(line);
            }
        }
    }
    let in_a_row = (width / LEGEND_ENTRY.0) as usize;
    let legend_height = legend.len().div_ceil(in_a_row) as u32 * LEGEND_ENTRY.1;
    let rows = panels.len().div_ceil(columns);
    let mut text = String::new();
    {
        let root = SVGBackend::with_string(&mut text, (width, legend_height + PANEL.1 * rows as u32));
        let root = root.into_drawing_area();
        root.fill(&WHITE).unwrap();
        let (top, rest) = root.split_vertically(legend_height);
        for (index, series) in legend.into_iter().enumerate() {
            let (x, y) = ((index % in_a_row) as u32 * LEGEND_ENTRY.0, (index / in_a_row) as u32 * LEGEND_ENTRY.1);
            draw_entry(&top, series, (x as i32 + 12, y as i32 + 11));
        }
        for (area, panel) in rest.split_evenly((rows, columns)).iter().zip(panels) {
            match panel {
                Panel::Lines { title, x, y, series } => draw_lines(area, title, x, y, series),
                Panel::Curves { title, x, y, up, series } => draw_curves(area, title, x, y, up, series),
                Panel::Cells { title, x, y, rows } => draw_cells(area, title, x, y, rows),
                Panel::Places { title, unit, value, size, places } => {
                    draw_places(area, title, (unit, value), *size, places);
                }
            }
        }
        root.present().unwrap();
    }
    text
}

fn draw_entry(area: &Area<'_>, series: &Series, (x, y): (i32, i32)) {
    area.draw(&PathElement::new(vec![(x, y), (x + 26, y)], series.style())).unwrap();
    draw_marker(series, (x + 13, y), |marker| area.draw(&marker).unwrap());
    area.draw(&Text::new(series.name.clone(), (x + 32, y - 6), ("sans-serif", 12))).unwrap();
}

fn draw_marker<C>(series: &Series, at: C, draw: impl FnOnce(Circle<C, i32>)) {
    match series.look {
        Look::Full => draw(Circle::new(at, 3, series.style().filled())),
        Look::Hollow => draw(Circle::new(at, 3, series.style())),
        Look::Plain | Look::Broad => {}
    }
}

/// The powers of ten around all values, for any number of values.
fn span(values: impl Iterator<Item = f64>) -> std::ops::Range<f64> {
    let (low, high) = values.fold((f64::INFINITY, 0.0_f64), |(low, high), v| (low.min(v), high.max(v)));
    if low <= high && low > 0.0 {
        10.0_f64.powf(low.log10().floor())..10.0_f64.powf((1.02 * high).log10().ceil())
    } else {
        0.1..10.0
    }
}

fn draw_lines(area: &Area<'_>, title: &str, x: &str, y: &str, series: &[Series]) {
    let points = || series.iter().flat_map(|line| &line.points);
    let (across, up) = (span(points().map(|point| point.0)), span(points().map(|point| point.1)));
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 15))
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(56)
        .build_cartesian_2d(across.log_scale(), up.log_scale())
        .unwrap();
    let power = |value: &f64| {
        if (0.01..1e4).contains(value) { value.to_string() } else { format!("{value:.0e}") }
    };
    chart
        .configure_mesh()
        .x_desc(x)
        .y_desc(y)
        .x_label_formatter(&power)
        .y_label_formatter(&power)
        .x_labels(8)
        .bold_line_style(BLACK.mix(0.12))
        .light_line_style(BLACK.mix(0.04))
        .draw()
        .unwrap();
    for line in series {
        chart.draw_series(LineSeries::new(line.points.iter().copied(), line.style())).unwrap();
        for point in &line.points {
            draw_marker(line, *point, |marker| {
                chart.draw_series(std::iter::once(marker)).unwrap();
            });
        }
    }
}

fn draw_curves(area: &Area<'_>, title: &str, x: &str, y: &str, up: &std::ops::Range<f64>, series: &[Series]) {
    let along = || series.iter().flat_map(|line| &line.points).map(|point| point.0);
    let across = along().fold(0.0, f64::min)..along().fold(0.0, f64::max);
    let mut chart = ChartBuilder::on(area)
        .caption(title, ("sans-serif", 15))
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(56)
        .build_cartesian_2d(across, up.clone())
        .unwrap();
    chart
        .configure_mesh()
        .x_desc(x)
        .y_desc(y)
        .x_label_formatter(&|value| format!("{value:.1}"))
        .y_label_formatter(&|value| format!("{value:.0}"))
        .bold_line_style(BLACK.mix(0.12))
        .light_line_style(BLACK.mix(0.04))
        .draw()
        .unwrap();
    for line in series {
        let shown = line.points.iter().map(|(x, y)| (*x, y.clamp(up.start, up.end)));
        chart.draw_series(LineSeries::new(shown, line.style())).unwrap();
    }
}

/// A colour from green over yellow to red.
fn colour(shade: f64) -> RGBColor {
    let stops = [(152.0, 205.0, 160.0), (250.0, 225.0, 140.0), (226.0, 120.0, 105.0)];
    let place = 2.0 * shade.clamp(0.0, 1.0);
    let (from, to) = if place < 1.0 { (stops[0], stops[1]) } else { (stops[1], stops[2]) };
    let between = |a: f64, b: f64| (a + (b - a) * place.fract()).round() as u8;
    if place >= 2.0 {
        return RGBColor(stops[2].0 as u8, stops[2].1 as u8, stops[2].2 as u8);
    }
    RGBColor(between(from.0, to.0), between(from.1, to.1), between(from.2, to.2))
}

fn draw_cells(
    area: &Area<'_>,
    title: &str,
    (x, columns): &(&str, Vec<String>),
    (y, names): &(&str, Vec<String>),
    rows: &[Vec<(String, f64)>],
) {
    let (width, height) = area.dim_in_pixel();
    let (left, right, top, bottom) = (62, width as i32 - 12, 44, height as i32 - 40);
    let across = |column: usize| left + (right - left) * column as i32 / columns.len() as i32;
    let up = |row: usize| bottom - (bottom - top) * row as i32 / names.len() as i32;
    let write = |text: &str, at: (i32, i32), size: i32| {
        area.draw(&Text::new(text.to_owned(), at, ("sans-serif", size))).unwrap();
    };
    write(title, (left, 6), 15);
    write(y, (6, top - 18), 11);
    write(x, (left, bottom + 22), 11);
    for (column, name) in columns.iter().enumerate() {
        write(name, (across(column) + 2, bottom + 6), 9);
    }
    for (row, (name, cells)) in names.iter().zip(rows).enumerate() {
        let middle = i32::midpoint(up(row), up(row + 1)) - 5;
        write(name, (6, middle), 9);
        for (column, (text, shade)) in cells.iter().enumerate() {
            let corners = [(across(column), up(row + 1)), (across(column + 1) - 1, up(row) - 1)];
            area.draw(&Rectangle::new(corners, colour(*shade).filled())).unwrap();
            write(text, (across(column) + 3, middle), 9);
        }
    }
}

/// Colours of a scale beside the chart.
const SHADES: i32 = 50;

fn draw_places(area: &Area<'_>, title: &str, (unit, value): (&str, &str), size: f64, places: &[[f64; 3]]) {
    let (width, height) = area.dim_in_pixel();
    let (chart_area, scale) = area.split_horizontally(width - 70);
    let range = |axis: usize| {
        let (from, to) = places
            .iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(from, to), place| (from.min(place[axis]), to.max(place[axis])));
        (from, to)
    };
    let (low, high) = range(2);
    let shade = |value: f64| if high > low { (value - low) / (high - low) } else { 0.0 };
    // Of the panel, less labels and margins.
    let (across_px, up_px) = (f64::from(width - 70 - 76), f64::from(height - 82));
    let [x, y] = [0, 1].map(range);
    let per_px = ((x.1 - x.0 + size) / across_px).max((y.1 - y.0 + size) / up_px);
    let around = |(from, to): (f64, f64), px: f64| {
        let (middle, half) = (0.5 * (from + to), 0.5 * px * per_px);
        middle - half..middle + half
    };
    let mut chart = ChartBuilder::on(&chart_area)
        .caption(title, ("sans-serif", 15))
        .margin(10)
        .x_label_area_size(36)
        .y_label_area_size(56)
        .build_cartesian_2d(around(x, across_px), around(y, up_px))
        .unwrap();
    chart.configure_mesh().x_desc(unit).y_desc(unit).disable_mesh().draw().unwrap();
    let half = 0.5 * size;
    let square = |[x, y, value]: &[f64; 3]| {
        Rectangle::new([(x - half, y - half), (x + half, y + half)], colour(shade(*value)).filled())
    };
    chart.draw_series(places.iter().map(square)).unwrap();
    let write = |text: String, at: (i32, i32)| scale.draw(&Text::new(text, at, ("sans-serif", 11))).unwrap();
    let (top, step) = (50, 4);
    for index in 0..SHADES {
        let y = top + step * index;
        let shade = 1.0 - f64::from(index) / f64::from(SHADES - 1);
        scale.draw(&Rectangle::new([(0, y), (16, y + step)], colour(shade).filled())).unwrap();
    }
    write(value.to_owned(), (0, top - 18));
    for (value, y) in [(high, top), (0.5 * (low + high), top + step * SHADES / 2), (low, top + step * SHADES)] {
        write(format!("{value:.0}"), (20, y - 5));
    }
}
