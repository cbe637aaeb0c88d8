//! The cost of accuracy: every scheme, number format and step on seven sheets and two organs, run time against error.
//! Writes docs/benchmarks/error.{md,svg}; `-- --quick` tries fewer steps and measures each once.

#![allow(
    clippy::unwrap_used,
    clippy::disallowed_methods,
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    missing_docs
)]

mod frontier;
mod report;
mod scenes;
mod subject;

use std::path::Path;
use std::sync::Arc;

use frontier::{Curve, SchemeTrial, cheapest, is_best, on_any_frontier};
use glam::DVec3;
use palpate_session::Session;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::script::Script;
use report::chart::{Look, Panel, Series};
use report::{BenchReport, cells, digits, least, quick, rough, seconds};
use scenes::{CASES, Case};
use serde_json::json;
use subject::{INTEGRATOR, PRECISION, PRECISIONS, integrators, known, set};

/// Number of refinements of the step, and of timings of each run.
struct Effort {
    rounds: usize,
    /// Longest time of a run, s.
    longest_run_s: f64,
    least_error: f64,
}

/// Displacements and reactions of all sample points at all sample times.
#[derive(Clone)]
struct Trace {
    displacements_m: Vec<DVec3>,
    forces_n: Vec<DVec3>,
}

/// A scene with its settings, ready to run.
struct SceneRun {
    model: Arc<Model>,
    script: Script,
}

impl SceneRun {
    /// `None` where the settings are refused, or are known to be unstable.
    fn new(case: &Case, assignments: &[String]) -> Option<Self> {
        let model = subject::model_of(case.scene, &case.with(assignments)).ok()?;
        let script =
            Script::parse(case.name, &case.script(), Path::new("."), &model.scene, &Limits::default()).unwrap();
        assert!(script.warnings.is_empty(), "{}: {:?}", case.name, script.warnings);
        model.plan.stable.then_some(SceneRun { model, script })
    }

    fn session(&self) -> Session {
        let mut session = Session::new(&self.model);
        session.play_script(&self.script);
        session
    }

    /// Runs it and records; `None` if the guard ended it.
    fn trace(&self) -> Option<Trace> {
        let mut trace = Trace { displacements_m: Vec::new(), forces_n: Vec::new() };
        let mut session = self.session();
        let mut due = Vec::new();
        for _ in 0..self.script.steps {
            session.advance(&mut due, |session| {
                if session.step_count().is_multiple_of(self.script.sample_every) {
                    for point in &self.script.sample_points {
                        let point = session.tissue().point(*point);
                        trace.displacements_m.push(point.displacement_m);
                        trace.forces_n.push(point.reaction_n());
                    }
                }
            });
        }
        session.fault().is_none().then_some(trace)
    }

    /// Runs it without recording. Run time per simulated second, s.
    fn cost(&self) -> f64 {
        let mut session = self.session();
        let mut due = Vec::new();
        let (run_s, ()) = seconds(|| (0..self.script.steps).for_each(|_| session.advance(&mut due, |_| {})));
        run_s / session.time_s()
    }
}

/// Largest error of displacements and of forces, each relative to the largest value.
fn errors(trace: &Trace, truth: &Trace) -> [f64; 2] {
    let relative = |values: &[DVec3], truth: &[DVec3]| {
        let largest = truth.iter().map(|v| v.length()).fold(0.0, f64::max);
        values.iter().zip(truth).map(|(a, b)| (*a - *b).length()).fold(0.0, f64::max) / largest
    };
    [relative(&trace.displacements_m, &truth.displacements_m), relative(&trace.forces_n, &truth.forces_n)]
}

/// The settings for a step of 8 ms / 2ⁿ: the rate sets steps of up to 1 kHz, and substeps set shorter ones.
fn step_of(halvings: u32) -> (f64, Vec<String>) {
    let (rate_hz, substeps) = (125.0 * f64::from(1_u32 << halvings.min(3)), 1_u32 << halvings.saturating_sub(3));
    let settings = vec![set("stepping.rate_hz", rate_hz), set("stepping.substeps", substeps)];
    (1.0 / (rate_hz * f64::from(substeps)), settings)
}

/// The true motion of a scene, and how well two ways of finding it agree. One is central differences at two small
/// steps, extrapolated to step zero: unlike any of the schemes measured. The other is Runge–Kutta at a small step or,
/// in a build without it, the extrapolation from twice the steps.
fn truth(case: &Case, knows_rk4: bool) -> (Trace, [f64; 2], &'static str) {
    let one_step = subject::model_of(case.scene, &case.with(&[])).unwrap();
    let scene = &one_step.scene;
    let fastest_per_s = one_step.omega_bound_per_s.max(scene.damping_n_s_per_m / scene.point_mass_kg());
    // Even, for the coarser extrapolation.
    let substeps = 2 * (64.0 * fastest_per_s / 1000.0).ceil().max(32.0) as u32;
    let trace = |integrator: &str, substeps: u32| {
        let settings = [set(INTEGRATOR, integrator), set(PRECISION, "f64"), set("stepping.substeps", substeps)];
        SceneRun::new(case, &settings).unwrap().trace().unwrap()
    };
    let extrapolated = |coarse: &Trace, fine: &Trace| {
        let values = |coarse: &[DVec3], fine: &[DVec3]| {
            coarse.iter().zip(fine).map(|(coarse, fine)| *fine + (*fine - *coarse) / 3.0).collect()
        };
        Trace {
            displacements_m: values(&coarse.displacements_m, &fine.displacements_m),
            forces_n: values(&coarse.forces_n, &fine.forces_n),
        }
    };
    let middle = trace("central", substeps);
    let truth = extrapolated(&middle, &trace("central", 2 * substeps));
    let (second, kind) = if knows_rk4 {
        (trace("rk4", substeps), "rk4")
    } else {
        (extrapolated(&trace("central", substeps / 2), &middle), "the extrapolation from twice the steps")
    };
    let agreement = errors(&second, &truth);
    (truth, agreement, kind)
}

/// Every trial of one scheme and format from the coarsest stable step on, not yet timed.
fn curve(
    case: &Case,
    integrator: &'static str,
    precision: &'static str,
    truth: &Trace,
    effort: &Effort,
) -> Vec<(SceneRun, SchemeTrial)> {
    let mut trials: Vec<(SceneRun, SchemeTrial)> = Vec::new();
    let mut best = f64::INFINITY;
    let mut in_vain = 0;
    for halvings in 0..16 {
        let (step_s, mut settings) = step_of(halvings);
        settings.extend([set(INTEGRATOR, integrator), set(PRECISION, precision)]);
        let Some(run) = SceneRun::new(case, &settings) else { continue };
        let (run_s, trace) = seconds(|| run.trace());
        let Some(trace) = trace else { continue };
        let [displacement, force] = errors(&trace, truth);
        let trial = SchemeTrial { integrator, precision, step_s, displacement, force, cost: f64::NAN };
        // At some step, rounding stops the gain.
        in_vain = if trial.error() < 0.8 * best { 0 } else { in_vain + 1 };
        best = best.min(trial.error());
        trials.push((run, trial));
        if in_vain == 2 || best < effort.least_error || 2.0 * run_s > effort.longest_run_s {
            break;
        }
    }
    trials
}

/// All trials of a scene, timed.
fn measure(case: &Case, truth: &Trace, schemes: &[&'static str], effort: &Effort) -> Vec<Curve> {
    let mut curves = Vec::new();
    for &integrator in schemes {
        for precision in PRECISIONS {
            eprintln!("  {integrator} {precision}");
            curves.push(curve(case, integrator, precision, truth, effort));
        }
    }
    eprintln!("  timing");
    let runs: Vec<&SceneRun> = curves.iter().flatten().map(|(run, _)| run).collect();
    let mut costs = least(effort.rounds, &runs, |run| run.cost()).into_iter();
    let timed = |trials: &Vec<(SceneRun, SchemeTrial)>| {
        let timed = trials.iter().map(|(_, trial)| SchemeTrial { cost: costs.next().unwrap(), ..trial.clone() });
        timed.collect::<Curve>()
    };
    curves.iter().map(timed).filter(|curve| !curve.is_empty()).collect()
}

fn panel(case: &Case, curves: &[Curve]) -> Panel {
    let mut best: Vec<_> = curves.iter().flatten().filter(|trial| is_best(trial, curves)).collect();
    best.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    let line = |trials: &[&SchemeTrial]| trials.iter().map(|trial| (trial.error(), trial.cost)).collect();
    let mut series =
        vec![Series { name: "cheapest".into(), hue: integrators().len(), look: Look::Broad, points: line(&best) }];
    series.extend(curves.iter().map(|curve| Series {
        name: format!("{} {}", curve[0].integrator, curve[0].precision),
        hue: integrators().iter().position(|name| *name == curve[0].integrator).unwrap(),
        look: if curve[0].precision == "f32" { Look::Full } else { Look::Hollow },
        points: line(&curve.iter().collect::<Vec<_>>()),
    }));
    Panel::Lines {
        title: case.name.to_owned(),
        x: "largest relative error",
        y: "run time a simulated second, s",
        series,
    }
}

fn tell_case(report: &mut BenchReport, case: &Case, curves: &[Curve], truth: &str) {
    report.heading(case.name);
    report.say(&format!("{}. {truth}", case.about));
    let header = ["scheme", "format", "step, µs", "error of displacement", "of force", "s a simulated second", "best"];
    let row = |trial: &SchemeTrial| {
        cells([
            trial.integrator,
            trial.precision,
            &digits(1e6 * trial.step_s),
            &rough(trial.displacement),
            &rough(trial.force),
            &digits(trial.cost),
            if is_best(trial, curves) { "●" } else { "" },
        ])
    };
    report.table(&cells(header), &curves.iter().flatten().map(row).collect::<Vec<_>>());
}

/// Ratios at equal error: the cost of the reference scheme over that of the best.
fn tell_ratios(report: &mut BenchReport, reference: &str, at: &[f64], results: &[(&Case, Vec<Curve>)]) {
    let mut header = vec!["scene".to_owned()];
    header.extend(at.iter().map(|error| format!("at {error:.0e}")));
    let mut rows = Vec::new();
    let mut figures = Vec::new();
    for (case, curves) in results {
        let mut row = vec![case.name.to_owned()];
        for &error in at {
            let of = |trial: &SchemeTrial| trial.integrator == reference;
            // Extrapolation is possible only for a scheme of first order.
            let reference = cheapest(curves, error, of, reference == "lagged");
            let best = cheapest(curves, error, |_| true, false);
            row.push(match (reference, best) {
                (Some(reference), Some(best)) => {
                    let ratio = reference.cost / best.cost;
                    figures.push(json!({
                        "scene": case.name, "error": error, "ratio": ratio, "best": best.by,
                        "extrapolated": reference.extrapolated,
                    }));
                    let mark = if reference.extrapolated { " (extrapolated)" } else { "" };
                    format!("{}{mark}, {}", digits(ratio), best.by)
                }
                _ => "–".to_owned(),
            });
        }
        rows.push(row);
    }
    report.table(&header, &rows);
    report.figure(&format!("times_cheaper_than_{reference}"), json!(figures));
}

fn main() {
    let effort = if quick() {
        Effort { rounds: 1, longest_run_s: 0.1, least_error: 1e-6 }
    } else {
        Effort { rounds: 3, longest_run_s: 0.6, least_error: 1e-9 }
    };
    let schemes = known(INTEGRATOR, &integrators());
    let knows_rk4 = schemes.contains(&"rk4");
    let mut results = Vec::new();
    let mut truths = Vec::new();
    for case in &CASES {
        eprintln!("{}", case.name);
        let (truth, [displacement, force], kind) = truth(case, knows_rk4);
        let kind = format!(
            "The truth, and {kind}, agree within {} (displacement) and {} (force).",
            rough(displacement),
            rough(force)
        );
        eprintln!("  {kind}");
        truths.push((kind, displacement.max(force)));
        results.push((case, measure(case, &truth, &schemes, &effort)));
    }

    let mut report = BenchReport::new("error", "Run time against error", "make bench-error");
    report.say(
        "Errors are the largest over all sample times and points, relative to the largest value: of the displacement, and of \
         the force on a tool there (springs, anchor spring and damping). `error` is the larger of the two. The reference is \
         central differences in f64 at two small steps, extrapolated to a step of zero. Time is that of the stepping alone on \
         one thread, the shortest of some runs in turn. ● marks the best runs: no other run takes less time for an error as \
         small, or within 2 % of it.",
    );
    report.heading("How many times cheaper than the paper's scheme, at equal error");
    report.say(
        "The run time of `lagged` divided by that of the cheapest scheme, interpolated logarithmically between measured \
         steps. If `lagged` does not reach an error within the steps tried, its last run is extrapolated by its first order \
         (halving the error doubles the time): *extrapolated*. A dash means that the best scheme does not reach the error \
         either.",
    );
    tell_ratios(&mut report, "lagged", &[1e-3, 1e-6], &results);
    if knows_rk4 {
        report.heading("How many times cheaper than Runge–Kutta, at equal error");
        report.say(
            "1 means that Runge–Kutta itself is the cheapest; a dash means that it, or the best scheme, does not reach \
                 the error.",
        );
        tell_ratios(&mut report, "rk4", &[1e-3, 1e-4, 1e-5, 1e-6, 1e-7], &results);
    }
    let absent: Vec<String> = schemes
        .iter()
        .flat_map(|integrator| PRECISIONS.map(|precision| (*integrator, precision)))
        .filter(|(integrator, precision)| !on_any_frontier(integrator, precision, &results))
        .map(|(integrator, precision)| format!("`{integrator}` in {precision}"))
        .collect();
    report.say(&match absent.as_slice() {
        [] => "Every scheme is the cheapest at some error.".to_owned(),
        absent => format!("Never the cheapest, at any error: {}.", absent.join(", ")),
    });
    report.figure("nowhere_cheapest", json!(absent));
    let figures = |((case, curves), (_, agreement)): (&(&Case, Vec<Curve>), &(String, f64))| {
        let trials: Vec<_> = curves.iter().flatten().map(|trial| trial.figures(is_best(trial, curves))).collect();
        json!({"scene": case.name, "about": case.about, "truth_agrees_within": agreement, "trials": trials})
    };
    report.figure("scenes", results.iter().zip(&truths).map(figures).collect());
    for ((case, curves), (truth, _)) in results.iter().zip(&truths) {
        tell_case(&mut report, case, curves, truth);
    }
    let panels: Vec<_> = results.iter().map(|(case, curves)| panel(case, curves)).collect();
    report.write(2, &panels);
}
