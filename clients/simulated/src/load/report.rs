//! Report of a load test by second, by phase and as a whole; as JSON, as a table, and as a page with plots.

use std::collections::BTreeMap;
use std::fmt::Write;

use serde_json::{Value, json};

use super::led_instrument::InstrumentKind;
use super::objective::Objective;
use super::plan::{LoadPlan, NO_SCRIPT, User};
use super::tally::{LoadOutcome, Tally, listed};

/// Counts of a load test within one second of its plan, for [`super::PreparedPlan::run`] to report as they come. The
/// last one of a plan may be shorter.
pub struct Second {
    /// Its end, since the plan began, s.
    pub(crate) at_s: f64,
    /// Its length, s: the last of a plan may be shorter.
    pub(crate) lasts_s: f64,
    /// Users at its end.
    pub(crate) users: u64,
    pub(crate) tally: Tally,
}

impl Second {
    /// Returns a line for a terminal, without a line break: time since the start, s, users at the end of the second,
    /// samples per second, 99th percentile of the round trips, and users that were turned away, by reason.
    pub fn line(&self) -> String {
        format!("{}  turned away {}", self.figures("users"), away(&self.tally.turned_away))
    }

    /// Returns a line for a terminal during a trial, like [`Second::line`] but with sessions for users, and with the
    /// number of rejected commands at its end. (A user that is turned away ends a trial.)
    pub fn trial_line(&self) -> String {
        format!("{}  rejected {}", self.figures("sessions"), self.tally.rejected.values().sum::<u64>())
    }

    #[allow(clippy::cast_precision_loss)]
    fn figures(&self, users: &str) -> String {
        let round_trip_us = self.tally.outcome(self.users).round_trip_us;
        format!(
            "{:.0} s  {} {users}  {:.0} samples/s  round trip p99 {}",
            self.at_s,
            self.users,
            self.tally.samples as f64 / self.lasts_s,
            milliseconds(round_trip_us.p99),
        )
    }
}

/// One point of the plots.
struct Point {
    at_s: f64,
    users: u64,
    outcome: LoadOutcome,
}

/// A phase, or the whole plan, with its counts.
struct Stretch {
    name: String,
    from_s: f64,
    to_s: f64,
    objective: Option<Objective>,
    most_users: u64,
    tally: Tally,
}

/// Report of a load test: counts and quantiles of each second, each phase and the whole, and whether the objectives
/// were met.
pub struct LoadReport {
    name: String,
    points: Vec<Point>,
    phases: Vec<Stretch>,
    whole: Stretch,
    /// Numbers of users by scene, hand, network, script and viewers.
    mix: Value,
    pub(crate) is_interrupted: bool,
    /// Processor time of this generator per second, cores.
    pub(crate) generator_cores: f64,
}

/// Returns the numbers of users that were turned away, by reason, as a text.
fn away(reasons: &BTreeMap<String, u64>) -> String {
    if reasons.is_empty() { "none".to_owned() } else { listed(reasons) }
}

/// Returns the numbers of users of a plan by scene, hand, network, script and number of viewers.
fn mix(plan: &LoadPlan, users: &[User]) -> Value {
    let mut counts: [BTreeMap<String, u64>; 5] = Default::default();
    for user in users {
        let hand = plan.leads[user.lead].what.map_or("push".to_owned(), |lead| {
            let with = lead.instrument.map_or(lead.device.name, InstrumentKind::name);
            format!("{} {with}", lead.hand.map_or("stroke", |hand| hand.name))
        });
        let names = [
            plan.scenes[user.scene].what.clone(),
            hand,
            plan.wires[user.wire].what.name.clone(),
            plan.scripts[user.script].what.clone().unwrap_or_else(|| NO_SCRIPT.to_owned()),
            plan.viewers[user.viewers].what.number.to_string(),
        ];
        for (counts, name) in counts.iter_mut().zip(names) {
            *counts.entry(name).or_default() += 1;
        }
    }
    let [scenes, hands, networks, scripts, viewers] = counts;
    json!({ "scenes": scenes, "hands": hands, "networks": networks, "scripts": scripts, "viewers": viewers })
}

/// Returns an outcome whose dilation is that of the worst second.
fn outcome(tally: &Tally, users: u64) -> LoadOutcome {
    let dilation = tally.dilation_s_min;
    let dilation_min = if dilation.is_finite() { dilation } else { f64::NAN };
    LoadOutcome { dilation_min, ..tally.outcome(users) }
}

fn milliseconds(us: f64) -> String {
    if us.is_nan() { "–".to_owned() } else { format!("{:.2} ms", us / 1e3) }
}

impl Stretch {
    fn new(name: &str, from_s: f64, to_s: f64, objective: Option<Objective>) -> Self {
        let name = name.to_owned();
        Stretch { name, from_s, to_s, objective, most_users: 0, tally: Tally::new() }
    }

    fn outcome(&self) -> LoadOutcome {
        outcome(&self.tally, self.most_users)
    }

    /// Returns the bounds that were not met.
    fn missed(&self) -> Vec<String> {
        let outcome = self.outcome();
        let missed = self.objective.iter().flat_map(|objective| objective.missed(&outcome));
        missed.map(str::to_owned).collect()
    }

    fn json(&self) -> Value {
        let outcome = self.outcome();
        let mut told = outcome.json(None);
        if let Some(told) = told.as_object_mut() {
            // Only trials have these.
            told.remove("sessions");
            told.remove("generator_cores");
            for (key, value) in [
                ("name", json!(self.name)),
                ("from_s", json!(self.from_s)),
                ("to_s", json!(self.to_s)),
                ("users_arrived", json!(self.tally.arrived)),
                ("users_left", json!(self.tally.left)),
                ("users_most", json!(self.most_users)),
                ("turned_away", json!(self.tally.turned_away)),
                ("start_us", outcome.start_us.json()),
                ("has_objective", json!(self.objective.is_some())),
                ("missed", json!(self.missed())),
            ] {
                told.insert(key.to_owned(), value);
            }
        }
        told
    }
}

impl LoadReport {
    /// Creates an empty report of a plan and its users.
    pub(crate) fn new(plan: &LoadPlan, users: &[User]) -> Self {
        let mut from_s = 0.0;
        let phases = plan.phases.iter().map(|phase| {
            let begin_s = from_s;
            from_s += phase.seconds;
            Stretch::new(&phase.name, begin_s, from_s, phase.objective.clone())
        });
        let phases: Vec<Stretch> = phases.collect();
        let whole = Stretch::new("all", 0.0, from_s, plan.objective.clone());
        LoadReport {
            name: plan.name.clone(),
            points: Vec::new(),
            phases,
            whole,
            mix: mix(plan, users),
            is_interrupted: false,
            generator_cores: f64::NAN,
        }
    }

    /// Adds a second to the phase in which it ended.
    pub(crate) fn add(&mut self, second: Second) {
        let Second { at_s, users, tally, .. } = second;
        self.points.push(Point { at_s, users, outcome: outcome(&tally, users) });
        let phase = self.phases.iter().position(|phase| at_s <= phase.to_s + 1e-9);
        let last = self.phases.len().saturating_sub(1);
        let mut stretches = vec![&mut self.whole];
        stretches.extend(self.phases.get_mut(phase.unwrap_or(last)));
        for stretch in stretches {
            stretch.most_users = stretch.most_users.max(users);
            stretch.tally.add(&tally);
        }
    }

    fn stretches(&self) -> impl Iterator<Item = &Stretch> {
        self.phases.iter().chain([&self.whole])
    }

    /// Returns the summary of the whole plan, for trials: its number of sessions is that of the users that arrived.
    /// Its dilation is the smallest of whole stays, whereas that of a phase is of the worst second.
    pub fn outcome(&self) -> LoadOutcome {
        let tally = &self.whole.tally;
        LoadOutcome { generator_cores: self.generator_cores, ..tally.outcome(tally.arrived) }
    }

    /// Returns why the load test failed; `None` if it succeeded. It fails if it was interrupted, if users arrived but
    /// no sample did, if a phase or the plan missed bounds of its objective, or if a stream broke. Several reasons
    /// are joined by `; `.
    pub fn verdict(&self) -> Option<String> {
        let whole = self.whole.outcome();
        if self.is_interrupted {
            return Some("the plan was interrupted".to_owned());
        }
        let first = |instead: &str| self.whole.tally.first_break.clone().unwrap_or_else(|| instead.to_owned());
        let mut whys = Vec::new();
        if self.whole.tally.arrived > 0 && whole.samples == 0 {
            whys.push(format!("no user could touch: {}", first("no sample arrived")));
        }
        for stretch in self.stretches() {
            let missed = stretch.missed();
            if !missed.is_empty() {
                whys.push(format!("`{}` misses {}", stretch.name, missed.join(", ")));
            }
        }
        if whole.broken > 0 {
            whys.push(format!("{} streams broke, the first because {}", whole.broken, first("of an unknown cause")));
        }
        (!whys.is_empty()).then(|| whys.join("; "))
    }

    /// Returns the report as JSON: `plan`, `mix`, `kept` (whether it succeeded) and `why` not, `phases`, `all` (the
    /// whole plan) and `seconds`. Names end with the unit of their values. Values that were not measured are `null`.
    pub fn json(&self) -> Value {
        let finite = |value: f64| if value.is_finite() { json!(value) } else { Value::Null };
        let points = self.points.iter().map(|Point { at_s, users, outcome }| {
            json!({
                "at_s": at_s, "users": users, "samples": outcome.samples, "commands": outcome.commands,
                "frames": outcome.frames, "round_trip_us": outcome.round_trip_us.json(),
                "dilation_min": finite(outcome.dilation_min), "turned_away": outcome.turned_away,
                "lost": outcome.lost, "rejected": outcome.rejected,
            })
        });
        json!({
            "plan": self.name, "mix": self.mix, "kept": self.verdict().is_none(), "why": self.verdict(),
            "phases": self.phases.iter().map(Stretch::json).collect::<Vec<_>>(),
            "all": self.whole.json(), "seconds": points.collect::<Vec<_>>(),
        })
    }

    /// Returns the report as one self-contained HTML page, with plots over the seconds of the plan.
    pub fn page(&self) -> String {
        page(self)
    }

    /// Returns the report as a table for a terminal: a row for each phase and one for the whole plan, then totals.
    pub fn table(&self) -> String {
        let head = "phase               users  arrived  turned away  round trip p50 / p99      start p99    dilation   objective\n";
        let rows = self.stretches().map(|stretch| {
            let outcome = stretch.outcome();
            let name: String = stretch.name.chars().take(18).collect();
            format!(
                "{name:<18}  {:>5}  {:>7}  {:>11}  {:>24}  {:>11}  {:>9.5}   {}\n",
                stretch.most_users,
                stretch.tally.arrived,
                outcome.turned_away,
                format!("{} / {}", milliseconds(outcome.round_trip_us.p50), milliseconds(outcome.round_trip_us.p99)),
                milliseconds(outcome.start_us.p99),
                outcome.dilation_min,
                kept(stretch),
            )
        });
        let whole = self.whole.outcome();
        head.to_owned()
            + &rows.collect::<String>()
            + &format!(
                "\n{} commands, {} samples, {} frames; lost {}, rejected {}, turned away: {}\n",
                whole.commands,
                whole.samples,
                whole.frames,
                whole.lost,
                whole.rejected,
                away(&self.whole.tally.turned_away),
            )
    }
}

/// Returns whether an objective was kept, as a text.
fn kept(stretch: &Stretch) -> String {
    let missed = stretch.missed();
    match (&stretch.objective, missed.is_empty()) {
        (None, _) => "–".to_owned(),
        (Some(_), true) => "kept".to_owned(),
        (Some(_), false) => format!("misses {}", missed.join(", ")),
    }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Size of a plot, and of its margins: left, top, right, bottom.
const SIZE: [f64; 2] = [860.0, 220.0];
const MARGINS: [f64; 4] = [64.0, 12.0, 12.0, 28.0];

/// A curve over time: its name, its colour, and its values; values that are not finite are left out.
type Curve<'c> = (&'c str, &'c str, Vec<f64>);

/// Returns the smallest round number (1, 2 or 5 times a power of 10) that is at least this.
fn round_up(value: f64) -> f64 {
    if value <= 0.0 || !value.is_finite() {
        return 1.0;
    }
    let power = 10.0_f64.powf(value.log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|step| step * power).find(|step| *step >= value * 0.999_999).unwrap_or(value)
}

/// Returns a plot of curves over the seconds, with the phases behind them.
fn plot(report: &LoadReport, title: &str, courses: &[Curve<'_>]) -> String {
    let [width, height] = SIZE;
    let [left, top, right, bottom] = MARGINS;
    let last_s = report.points.last().map_or(1.0, |point| point.at_s).max(report.whole.to_s);
    let most =
        round_up(courses.iter().flat_map(|course| &course.2).copied().filter(|y| y.is_finite()).fold(0.0, f64::max));
    let x = |at_s: f64| left + (width - left - right) * at_s / last_s;
    let y = |value: f64| height - bottom - (height - top - bottom) * (value / most).clamp(0.0, 1.0);
    let mut svg = format!("<h2>{}</h2>\n<svg viewBox=\"0 0 {width} {height}\" role=\"img\">\n", escaped(title));
    for (index, phase) in report.phases.iter().enumerate() {
        let (from, to) = (x(phase.from_s), x(phase.to_s.min(last_s)));
        let class = if index % 2 == 0 { "even" } else { "odd" };
        let _ = writeln!(
            svg,
            "<rect class=\"{class}\" x=\"{from:.1}\" y=\"{top}\" width=\"{:.1}\" height=\"{:.1}\"/><text x=\"{:.1}\" y=\"{:.1}\">{}</text>",
            to - from,
            height - top - bottom,
            from + 4.0,
            top + 13.0,
            escaped(&phase.name),
        );
    }
    #[allow(clippy::cast_possible_truncation)]
    for part in 0..=4 {
        // In f32, so that the sum of roundings is not shown.
        let value = most * f64::from(part) / 4.0;
        let at = y(value);
        let _ = writeln!(
            svg,
            "<line class=\"grid\" x1=\"{left}\" x2=\"{:.1}\" y1=\"{at:.1}\" y2=\"{at:.1}\"/><text class=\"y\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
            width - right,
            left - 6.0,
            at + 4.0,
            value as f32,
        );
    }
    for part in 0..=6 {
        let at_s = last_s * f64::from(part) / 6.0;
        let _ = writeln!(svg, "<text class=\"x\" x=\"{:.1}\" y=\"{:.1}\">{at_s:.0} s</text>", x(at_s), height - 8.0);
    }
    for (index, (name, colour, values)) in courses.iter().enumerate() {
        let mut path = String::new();
        let mut is_down = false;
        for (point, value) in report.points.iter().zip(values) {
            if value.is_finite() {
                let _ = write!(path, "{}{:.1} {:.1}", if is_down { "L" } else { "M" }, x(point.at_s), y(*value));
            }
            is_down = value.is_finite();
        }
        let at = left + 10.0 + 130.0 * f64::from(u32::try_from(index).unwrap_or(0));
        let _ = writeln!(
            svg,
            "<path d=\"{path}\" stroke=\"{colour}\"/><text x=\"{at:.1}\" y=\"{:.1}\" style=\"fill:{colour}\">{}</text>",
            top + 30.0,
            escaped(name),
        );
    }
    svg + "</svg>\n"
}

/// Returns the report as one self-contained page.
fn page(report: &LoadReport) -> String {
    let of =
        |value: fn(&LoadOutcome) -> f64| report.points.iter().map(|point| value(&point.outcome)).collect::<Vec<f64>>();
    #[allow(clippy::cast_precision_loss)]
    let users = report.points.iter().map(|point| point.users as f64).collect();
    #[allow(clippy::cast_precision_loss)]
    let plots = [
        plot(report, "Users", &[("users", "#1f6f8b", users), ("turned away", "#b3261e", of(|o| o.turned_away as f64))]),
        plot(
            report,
            "Round trip, ms",
            &[
                ("p50", "#1f6f8b", of(|o| o.round_trip_us.p50 / 1e3)),
                ("p99", "#c77700", of(|o| o.round_trip_us.p99 / 1e3)),
                ("max", "#b3261e", of(|o| o.round_trip_us.max / 1e3)),
            ],
        ),
        plot(
            report,
            "Simulated time over real time, the slowest session",
            &[("dilation", "#1f6f8b", of(|o| o.dilation_min))],
        ),
        plot(
            report,
            "Each second",
            &[
                ("commands", "#c77700", of(|o| o.commands as f64)),
                ("samples", "#1f6f8b", of(|o| o.samples as f64)),
                ("frames", "#5b7f2b", of(|o| o.frames as f64)),
            ],
        ),
    ];
    let rows: String = report
        .stretches()
        .map(|stretch| {
            let outcome = stretch.outcome();
            let class = if stretch.missed().is_empty() { "" } else { " class=\"missed\"" };
            format!(
                "<tr{class}><td>{}</td><td>{:.0}–{:.0} s</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td>{:.4}</td>\
                 <td>{}</td></tr>\n",
                escaped(&stretch.name),
                stretch.from_s,
                stretch.to_s,
                stretch.most_users,
                stretch.tally.arrived,
                outcome.turned_away,
                escaped(&outcome.round_trip_us.text()),
                milliseconds(outcome.start_us.p99),
                outcome.dilation_min,
                escaped(&kept(stretch)),
            )
        })
        .collect();
    let verdict = report.verdict().map_or("All objectives were kept.".to_owned(), |why| format!("Failed: {why}."));
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<title>{name}: load of Palpate</title>\n\
         <style>{STYLE}</style>\n</head>\n<body>\n<h1>{name}</h1>\n<p>{verdict}</p>\n{plots}\n<h2>Phases</h2>\n\
         <table>\n<tr><th>phase</th><th>time</th><th>users at most</th><th>arrived</th><th>turned away</th>\
         <th>round trip p50 / p99 / p99.9 / max</th><th>start p99</th><th>dilation</th><th>objective</th></tr>\n{rows}</table>\n\
         <p>Turned away: {away}.</p>\n</body>\n</html>\n",
        name = escaped(&report.name),
        verdict = escaped(&verdict),
        plots = plots.concat(),
        away = escaped(&away(&report.whole.tally.turned_away)),
    )
}

const STYLE: &str = "body{font:15px/1.45 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#1c1c1c}\
h1{font-size:1.5rem}h2{font-size:1.05rem;margin:1.4rem 0 .3rem}svg{width:100%;height:auto}svg text{font-size:11px;fill:#555}\
svg path{fill:none;stroke-width:1.6}.even{fill:#f4f6f7}.odd{fill:#e9edef}.grid{stroke:#cfd6d9;stroke-width:.6}\
svg text.y{text-anchor:end}svg text.x{text-anchor:middle}table{border-collapse:collapse;font-size:13px;width:100%}\
th,td{text-align:left;padding:.3rem .5rem;border-bottom:1px solid #d5dbde}.missed td{color:#b3261e}";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_end_at_round_numbers() {
        for (value, expected) in
            [(0.0, 1.0), (0.9, 1.0), (1.0, 1.0), (1.1, 2.0), (37.0, 50.0), (0.021, 0.05), (f64::NAN, 1.0)]
        {
            assert!((round_up(value) - expected).abs() < 1e-12 * expected, "{value}");
        }
    }
}
