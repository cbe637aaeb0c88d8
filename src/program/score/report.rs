//! The report of a score: one HTML page to print, without anything from elsewhere.

use std::fmt::Write as _;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use palpate::render::{MAP_COLOURS, STRONG, pressed_map};
use palpate_exercise::timeline::Timeline;
use palpate_exercise::{MeasureDefinition, Measures, register};

use super::super::Failure;
use super::super::markup::{escaped, mark_distance};
use super::{Score, ScoredCrossing, ScoredMeasure, shown};

/// Size of the curves, pixels, with the room for the labels of the axes.
const SIZE: [f64; 2] = [920.0, 260.0];
const LEFT: f64 = 56.0;
const BOTTOM: f64 = 34.0;
const TOP: f64 = 10.0;

/// The largest number of points of a curve.
const MAX_POINTS: usize = 900;

/// Width of a map, pixels.
const MAP_WIDTH: usize = 440;

/// The largest number of times above the limit in the table.
const MAX_ROWS: usize = 40;

/// The colours of the tools, told apart also without colour vision (Okabe and Ito).
const TOOL_COLOURS: [&str; 6] = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"];

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;color:#1c1c1c;background:#fff;max-width:960px;margin:2em auto;padding:0 1em}\
    h1{font-size:1.5em;margin-bottom:.1em}h2{font-size:1.1em;margin:1.6em 0 .4em}.of{color:#555;margin-top:0}\
    table{border-collapse:collapse;width:100%}th,td{padding:.25em .6em;text-align:right;border-bottom:1px solid #ddd;vertical-align:top}\
    th:first-child,td:first-child,td:last-child,th:last-child{text-align:left}td:last-child{color:#444;font-size:.87em}\
    code{font-size:.93em}figure{margin:0;display:inline-block;margin-right:1.5em}figcaption{color:#555;font-size:.87em}\
    .key{display:inline-block;width:1em;height:1em;vertical-align:-.15em;margin:0 .3em 0 1em;border:1px solid #999}\
    svg{width:100%;height:auto}svg text{font:12px system-ui,sans-serif;fill:#444}\
    @media print{body{margin:0;max-width:none;font-size:11px}h2,figure,svg{break-after:avoid;break-inside:avoid}tr{break-inside:avoid}}";

/// Returns the score of the exercise, and the truth beside the answers; nothing without an exercise.
fn exercise(score: &Score) -> String {
    let Some(exercise) = &score.exercise else { return String::new() };
    let percent = exercise.score_percent.map_or_else(String::new, |percent| format!(": {percent:.0} %"));
    let mut html = format!("<h2>Exercise {}, seed {}{percent}</h2>\n", escaped(&exercise.name), exercise.seed);
    if !exercise.changed_thresholds.is_empty() {
        let names = escaped(&exercise.changed_thresholds.join(", "));
        let _ = writeln!(html, "<p>Not comparable with other scores of the exercise: {names} changed by options.</p>");
    }
    html +=
        "<table><tr><th>criterion</th><th>value</th><th>poor</th><th>good</th><th>weight</th><th>earned</th></tr>\n";
    for criterion in &exercise.criteria {
        let [value, poor, good] = [criterion.value, Some(criterion.poor), Some(criterion.good)].map(shown);
        let _ = writeln!(
            html,
            "<tr><td><code>{}</code></td><td>{value}</td><td>{poor}</td><td>{good}</td><td>{}</td><td>{:.0} %</td></tr>",
            escaped(&criterion.title()),
            criterion.weight,
            100.0 * criterion.earned
        );
    }
    html += "</table>\n";
    for (index, phase) in exercise.phases.iter().enumerate() {
        let (title, time_s) = (escaped(&phase.title), shown(Some(phase.time_s(score.rate_hz))));
        let _ = writeln!(html, "<h2>Phase {}, {title}: {time_s} s</h2>\n<table>", index + 1);
        for ScoredMeasure { name, value, unit, .. } in phase.of_all_tools() {
            let (value, unit) = (shown(Some(*value)), if unit == "1" { "" } else { unit });
            let _ = writeln!(html, "<tr><td><code>{name}</code></td><td>{value}</td><td>{unit}</td></tr>");
        }
        html += "</table>\n";
    }
    let place = |[x, y, z]: [f64; 3]| format!("{:.1}, {:.1}, {:.1}", 1e3 * x, 1e3 * y, 1e3 * z);
    if !exercise.lumps.is_empty() || !exercise.answers.is_empty() {
        html += "<table><tr><th>hidden or marked</th><th>place, mm</th><th>diameter, mm</th><th></th></tr>\n";
        for lump in &exercise.lumps {
            let (at, diameter) = (place(lump.centre_m), 2e3 * lump.radius_m);
            let times = shown(Some(lump.stiffness_factor));
            let _ = writeln!(
                html,
                "<tr><td>lump</td><td>{at}</td><td>{diameter:.1}</td><td>{times} times as stiff</td></tr>"
            );
        }
        for answer in &exercise.answers {
            let diameter = shown(answer.diameter_m.map(|diameter_m| 1e3 * diameter_m));
            #[allow(clippy::cast_precision_loss)]
            let at_s = answer.step as f64 / score.rate_hz;
            let at = place(answer.place_m);
            let _ = writeln!(html, "<tr><td>mark</td><td>{at}</td><td>{diameter}</td><td>at {at_s:.3} s</td></tr>");
        }
        html += "</table>\n";
    }
    html
}

fn colour_of(tool: u32) -> &'static str {
    TOOL_COLOURS[tool as usize % TOOL_COLOURS.len()]
}

/// Returns the page of a score.
///
/// # Errors
/// Fails if a picture can't be encoded.
pub(crate) fn page(score: &Score, measures: &Measures) -> Result<String, Failure> {
    let title = escaped(&score.title());
    let mut html = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
         <title>{title}</title><style>{STYLE}</style></head><body>\n<h1>{title}</h1>\n<p class=\"of\">{}</p>\n",
        escaped(&about(score))
    );
    html += &exercise(score);
    html += &figures(score);
    html += &curves(score, measures.timeline());
    html += &crossings(score);
    html += &maps(score, measures)?;
    let _ = writeln!(
        html,
        "<p class=\"of\">Computed by Palpate {}. The guide's page on exercises has the formula and the source of each \
         figure. Compare figures of the same exercise with each other: none of them is a grade.</p></body></html>",
        escaped(&score.version)
    );
    Ok(html)
}

#[allow(clippy::cast_precision_loss)]
fn about(score: &Score) -> String {
    let mut parts = vec![format!("{} s", shown(Some(score.steps as f64 / score.rate_hz)))];
    parts.extend(score.source.session_id.as_ref().map(|session| format!("session {session}")));
    parts.extend(score.source.recorded.as_ref().map(|recorded| format!("recorded {recorded} UTC")));
    let thresholds = &score.thresholds;
    parts.extend(thresholds.force_limit_n.map(|limit_n| format!("limit of force {limit_n} N")));
    parts.extend(thresholds.pressure_limit_pa.map(|limit_pa| format!("limit of pressure {limit_pa} Pa")));
    parts.extend(thresholds.strain_limit.map(|limit| format!("limit of strain {limit}")));
    parts.push(format!("a press begins at {} N", thresholds.press_n));
    parts.push(format!("a place is covered from {} Pa on", thresholds.coverage_pa));
    parts.join(" · ")
}

fn figures(score: &Score) -> String {
    let tools = score.tools();
    let mut html = "<h2>Figures</h2>\n<table><tr><th>measure</th><th>all tools</th>".to_owned();
    tools.iter().for_each(|tool| html += &format!("<th>tool {tool}</th>"));
    html += "<th>unit</th><th>what it tells</th></tr>\n";
    for (name, unit) in score.names() {
        let meaning = register::find(name).map_or("", |MeasureDefinition { meaning, .. }| *meaning);
        let _ = write!(html, "<tr><td><code>{name}</code></td><td>{}</td>", shown(score.value(name, None)));
        tools.iter().for_each(|tool| html += &format!("<td>{}</td>", shown(score.value(name, Some(*tool)))));
        let unit = if unit == "1" { "" } else { unit };
        let _ = writeln!(html, "<td>{unit}</td><td>{}</td></tr>", escaped(meaning));
    }
    html + "</table>\n"
}

#[allow(clippy::cast_precision_loss)]
fn curves(score: &Score, timeline: &Timeline) -> String {
    let mut html = "<h2>Force over time</h2>\n".to_owned();
    let limit_n = score.thresholds.force_limit_n;
    let peak_n = timeline.curves().flat_map(|(_, curve)| curve).copied().fold(0.0, f64::max);
    let (duration_s, begin_s) = (score.steps as f64 / score.rate_hz, score.begin_step as f64 / score.rate_hz);
    if peak_n <= 0.0 || duration_s <= 0.0 {
        return html + "<p>No tool touched the tissue.</p>\n";
    }
    let most_n = 1.05 * peak_n.max(limit_n.unwrap_or_default());
    let x = |time_s: f64| LEFT + (SIZE[0] - LEFT - 10.0) * time_s / duration_s;
    let y = |force_n: f64| TOP + (SIZE[1] - TOP - BOTTOM) * (1.0 - force_n / most_n);
    let _ = write!(html, "<svg viewBox=\"0 0 {} {}\" role=\"img\" aria-label=\"Force over time\">", SIZE[0], SIZE[1]);
    let marks = |most: f64, count: f64| {
        let distance = mark_distance(most, count);
        (0..).map(move |k: u32| f64::from(k) * distance).take_while(move |mark| *mark <= most)
    };
    for mark in marks(most_n, 5.0) {
        let at = y(mark);
        let _ = write!(
            html,
            "<line x1=\"{LEFT}\" x2=\"{:.1}\" y1=\"{at:.1}\" y2=\"{at:.1}\" stroke=\"#e4e4e4\"/>\
             <text x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            x(duration_s),
            LEFT - 6.0,
            at + 4.0,
            shown(Some(mark))
        );
    }
    for mark in marks(duration_s, 10.0) {
        let _ = write!(
            html,
            "<text x=\"{:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>",
            x(mark),
            SIZE[1] - BOTTOM + 17.0,
            shown(Some(begin_s + mark))
        );
    }
    let _ = write!(
        html,
        "<text x=\"{:.1}\" y=\"{}\" text-anchor=\"end\">time, s</text><text x=\"4\" y=\"{}\">N</text>",
        x(duration_s),
        SIZE[1] - 4.0,
        TOP + 4.0
    );
    if let Some(limit_n) = limit_n {
        let at = y(limit_n);
        let _ = write!(
            html,
            "<line x1=\"{LEFT}\" x2=\"{:.1}\" y1=\"{at:.1}\" y2=\"{at:.1}\" stroke=\"#b00020\" stroke-dasharray=\"6 4\"/>",
            x(duration_s)
        );
    }
    for (tool, curve) in timeline.curves() {
        let each = curve.len().div_ceil(MAX_POINTS).max(1);
        let _ = write!(html, "<polyline fill=\"none\" stroke=\"{}\" stroke-width=\"1.6\" points=\"", colour_of(tool));
        for (k, values) in curve.chunks(each).enumerate() {
            let time_s = (k as f64 + 0.5) * each as f64 * timeline.interval_s();
            let force_n = values.iter().copied().fold(0.0, f64::max);
            let _ = write!(html, "{:.1},{:.1} ", x(time_s.min(duration_s)), y(force_n));
        }
        html += "\"/>";
    }
    html += "</svg>\n<p class=\"of\">The largest force in each moment, of";
    for (tool, _) in timeline.curves() {
        let _ = write!(html, "<span class=\"key\" style=\"background:{}\"></span>tool {tool}", colour_of(tool));
    }
    html + if limit_n.is_some() { "; dashed: the limit</p>\n" } else { "</p>\n" }
}

fn crossings(score: &Score) -> String {
    let Some(count) = score.limit_crossing_count else { return String::new() };
    let mut html = "<h2>Above the limits</h2>\n".to_owned();
    if count == 0 {
        return html + "<p>Never.</p>\n";
    }
    html += "<table><tr><th>limit of</th><th>tool</th><th>from, s</th><th>to, s</th><th>most</th><th>look at it</th></tr>\n";
    for crossing in score.limit_crossings.iter().take(MAX_ROWS) {
        let ScoredCrossing { tool, from_s, to_s, from_step, peak, .. } = crossing;
        let (name, unit) = crossing.name_and_unit();
        let look = score.source.journal.as_ref().map_or_else(
            || format!("step {from_step}"),
            |journal| {
                format!("<code>palpate journal render {} --at {from_step} --output moment.png</code>", escaped(journal))
            },
        );
        let _ = writeln!(
            html,
            "<tr><td>{}</td><td>{tool}</td><td>{from_s:.3}</td><td>{to_s:.3}</td><td>{}{unit}</td><td>{look}</td></tr>",
            escaped(name),
            shown(Some(*peak))
        );
    }
    html += "</table>\n";
    if count > MAX_ROWS as u64 {
        let _ = writeln!(html, "<p>{count} times in all; these are the first {MAX_ROWS}.</p>");
    }
    html
}

fn maps(score: &Score, measures: &Measures) -> Result<String, Failure> {
    let parts = measures.surface().parts();
    if parts.is_empty() {
        return Ok(String::new());
    }
    let mut html = "<h2>What was pressed, and how hard</h2>\n".to_owned();
    let enough_pa = score.thresholds.coverage_pa;
    let faces_down = parts.iter().any(|part| {
        let [a, b, c] = part.corners_m;
        (b - a).cross(c - a).z < 0.0
    });
    let views: &[(bool, &str)] = if faces_down {
        &[(false, "from above"), (true, "from below, x to the left")]
    } else {
        &[(false, "from above")]
    };
    for (from_below, name) in views {
        let png = pressed_map(parts, enough_pa, MAP_WIDTH, *from_below).png()?;
        let _ = write!(
            html,
            "<figure><img width=\"{MAP_WIDTH}\" alt=\"The surface {name}\" src=\"data:image/png;base64,{}\"><figcaption>The \
             surface at rest, {name}</figcaption></figure>",
            STANDARD.encode(png)
        );
    }
    let labels = [
        "not pressed by a tip".to_owned(),
        "hardly".to_owned(),
        "almost enough".to_owned(),
        format!("{enough_pa} Pa, enough"),
        format!("{} Pa and more", STRONG * enough_pa),
    ];
    html += "\n<p class=\"of\">";
    for ([r, g, b], label) in MAP_COLOURS.into_iter().zip(labels) {
        let _ = write!(html, "<span class=\"key\" style=\"background:rgb({r},{g},{b})\"></span>{label}");
    }
    Ok(html + "</p>\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn marks_of_an_axis_are_round_and_a_foreign_name_stays_a_text() {
        for (most, expected) in [(1.0, 0.2), (0.37, 0.1), (4.2, 1.0), (96.0, 20.0)] {
            assert!((mark_distance(most, 5.0) / expected - 1.0).abs() < 1e-12, "{most}: {}", mark_distance(most, 5.0));
        }
        assert_eq!(escaped("<a href=\"x\">&\u{1b}"), "&lt;a href=&quot;x&quot;&gt;&amp;?");
    }
}
