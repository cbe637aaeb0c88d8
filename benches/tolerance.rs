//! Check whether the chosen scheme keeps a scene's tolerance, and by how much. Random scenes with random scripts
//! against f64 at 1e-10. Writes docs/benchmarks/tolerance.{md,svg}.
//! `-- --scenes 1000 --seed 1 --tolerances 1e-3,1e-5`; exit status 1 if a tolerance was broken. `--audit` also
//! compares an audit's result with the true error, which takes ten times as long.

#![allow(clippy::unwrap_used, clippy::disallowed_methods, clippy::cast_precision_loss, missing_docs)]
#![allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]

#[path = "../tests/common/closed_mesh.rs"]
mod closed_mesh;
#[path = "../tests/common/random_scenes.rs"]
mod random_scenes;
mod report;

use std::collections::BTreeMap;
use std::process::ExitCode;
use std::time::Instant;

use palpate_tissue::scene::{Named, Precision};
use random_scenes::{audited_errors, case, errors, play, truth};
use report::chart::{Look, Panel, Series};
use report::{BenchReport, quick, rough};
use serde_json::json;

/// One scene at one tolerance.
struct ToleranceRow {
    /// The larger error of displacement and force, over the tolerance.
    part: f64,
    /// The expected error over the true one.
    expected: f64,
    /// More than one substep, or f64: something cheaper might have been enough.
    dear: bool,
    chosen: String,
    step_s: f64,
    /// Whether an audit's errors of displacement and force are both within a factor of [`FACTOR`] of the true ones.
    audited: Option<bool>,
    about: String,
}

/// Largest ratio between an audited error and the true one.
const FACTOR: f64 = 5.0;

fn argument(name: &str) -> Option<String> {
    let mut arguments = std::env::args().skip_while(|argument| argument != name);
    arguments.next();
    arguments.next()
}

fn quantile(values: &mut [f64], part: f64) -> String {
    values.sort_by(f64::total_cmp);
    let place = ((values.len() as f64 * part) as usize).min(values.len().saturating_sub(1));
    values.get(place).map_or("–".to_owned(), |value| rough(*value))
}

fn main() -> ExitCode {
    let number = |name: &str, standard: u64| argument(name).map_or(standard, |text| text.parse().unwrap());
    let scenes = number("--scenes", if quick() { 50 } else { 1000 });
    let seed = number("--seed", 1);
    let tolerances = argument("--tolerances").unwrap_or_else(|| "1e-2,1e-3,1e-4,1e-5,1e-6,1e-7".to_owned());
    let tolerances: Vec<&str> = tolerances.split(',').collect();
    let audit = std::env::args().any(|argument| argument == "--audit");
    let begun = Instant::now();
    let clock_s = || begun.elapsed().as_secs_f64();
    let mut rows: BTreeMap<&str, Vec<ToleranceRow>> = BTreeMap::new();
    let mut refused = Vec::new();
    for n in 0..scenes {
        let case = case(seed * 1_000_000 + n);
        let truth = match truth(&case) {
            Ok(played) => played.course,
            Err(reason) => {
                refused.push(format!("{}: {reason}", case.about));
                continue;
            }
        };
        for tolerance in &tolerances {
            let asked: f64 = tolerance.parse().unwrap();
            let settings = [format!("stepping.tolerance={tolerance}")];
            match play(&case, &settings, &clock_s) {
                Ok(played) => {
                    let [displacement, force] = errors(&truth, &played.course);
                    let close =
                        |told: f64, true_error: f64| (true_error / FACTOR..=true_error * FACTOR).contains(&told);
                    let audited = audit.then(|| {
                        let told = audited_errors(&case, &settings).unwrap_or([f64::NAN; 2]);
                        close(told[0], displacement) && close(told[1], force)
                    });
                    let (model, error) = (&played.model, displacement.max(force));
                    let (integrator, substeps) = (model.plan.integrator.name(), model.plan.substeps);
                    rows.entry(tolerance).or_default().push(ToleranceRow {
                        part: error / asked,
                        expected: model.expected_error / error,
                        dear: substeps > 1 || model.precision == Precision::F64,
                        chosen: format!("{integrator} × {substeps} {}", model.precision.name()),
                        step_s: played.step_s,
                        audited,
                        about: format!("{}: displacement {displacement:.1e}, force {force:.1e}", case.about),
                    });
                }
                Err(reason) => refused.push(format!("{} at {tolerance}: {reason}", case.about)),
            }
        }
        if n % 50 == 49 {
            let beyond: usize = rows.values().flatten().filter(|row| row.part > 1.0).count();
            eprintln!("{} of {scenes} scenes after {:.0} s: {beyond} beyond their tolerance", n + 1, clock_s());
        }
    }

    let mut report = BenchReport::new("tolerance", "Is the tolerance kept?", "make bench-tolerance");
    report.say(&format!(
        "{scenes} random scenes with random scripts (seed {seed}; tests/common/random_scenes.rs generates them), each \
         compared with itself in f64 at 1e-10. The error is the largest difference of any component of displacement or force \
         at any watched point and sample time, relative to the largest. *Expensive* are the scenes for which Palpate chose \
         more than one substep, or f64: a cheaper scheme might have been enough."
    ));
    let header = [
        "tolerance",
        "kept",
        "beyond",
        "error/tolerance: median, 90 %, largest",
        "dear",
        "of those: median",
        "expected/true error: 1 %, median",
        "µs a step, mean",
        "audited within 5 ×",
    ];
    let mut table = Vec::new();
    let mut series = Vec::new();
    for (tolerance, rows) in &rows {
        let mut parts: Vec<f64> = rows.iter().map(|row| row.part).collect();
        let mut dear: Vec<f64> = rows.iter().filter(|row| row.dear).map(|row| row.part).collect();
        let mut expected: Vec<f64> = rows.iter().map(|row| row.expected).collect();
        let beyond = rows.iter().filter(|row| row.part > 1.0).count();
        let close = rows.iter().filter(|row| row.audited == Some(true)).count();
        let mean_s = rows.iter().map(|row| row.step_s).sum::<f64>() / rows.len() as f64;
        table.push(vec![
            (*tolerance).to_owned(),
            (rows.len() - beyond).to_string(),
            beyond.to_string(),
            [0.5, 0.9, 1.0].map(|part| quantile(&mut parts, part)).join(", "),
            dear.len().to_string(),
            quantile(&mut dear, 0.5),
            [0.01, 0.5].map(|part| quantile(&mut expected, part)).join(", "),
            format!("{:.2}", mean_s * 1e6),
            if audit { format!("{:.1} %", 100.0 * close as f64 / rows.len() as f64) } else { "–".to_owned() },
        ]);
        let share = |n: usize| 100.0 * (n + 1) as f64 / parts.len() as f64;
        let points = parts.iter().enumerate().map(|(n, part)| (part.max(1e-9), share(n))).collect();
        series.push(Series { name: (*tolerance).to_owned(), hue: series.len(), look: Look::Full, points });
        report
            .figure(tolerance, json!({ "kept": rows.len() - beyond, "beyond": beyond, "error_over_tolerance": parts }));
    }
    report.table(&header.map(str::to_owned), &table);
    for (tolerance, rows) in &rows {
        let mut beyond: Vec<&ToleranceRow> = rows.iter().filter(|row| row.part > 1.0).collect();
        beyond.sort_by(|a, b| b.part.total_cmp(&a.part));
        for row in beyond.iter().take(10) {
            report.say(&format!("Beyond {tolerance} by {:.2} times: {} ({})", row.part, row.about, row.chosen));
        }
    }
    for reason in &refused {
        report.say(&format!("Not played: {reason}"));
    }
    let title = "Scenes whose error is at most so many times the tolerance".to_owned();
    report.write(1, &[Panel::Lines { title, x: "error over tolerance", y: "% of scenes", series }]);
    let broken = rows.values().flatten().any(|row| row.part > 1.0);
    if broken || !refused.is_empty() { ExitCode::FAILURE } else { ExitCode::SUCCESS }
}
