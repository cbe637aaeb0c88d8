//! `palpate check`: what a scene requires, and how the program will run it.

use std::f64::consts::TAU;
use std::fmt;
use std::sync::Arc;

use glam::DVec3;

use super::Session;
use super::scene_report::Prospect;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::profile::Poke;
use palpate_tissue::scene::script::Script;
use palpate_tissue::scene::{MaxwellBranch, Named};
use palpate_tissue::scheme::{Oscillator, Relaxation};
use palpate_tissue::select::scheme_selection::{self, Choice};
use palpate_tissue::shape::PointId;
use palpate_tissue::{Model, Plan, Push};

/// Report on a scene: its properties, the chosen scheme and its alternatives, the time of a step, and warnings. Its
/// `Display` is the output of `palpate check`, several lines of text.
#[derive(Debug)]
pub struct CheckReport {
    model: Arc<Model>,
    /// The chosen scheme, and the best one with each other integrator.
    candidates: Vec<Choice>,
    /// The scheme that would have been chosen if the scene prescribed none; `None` if it prescribes none.
    by_auto: Option<Choice>,
    prospect: Prospect,
    /// Least and median time of a step, s; `None` if the step failed or would take too long.
    step_s: Option<[f64; 2]>,
}

/// Predicted time of a step above which it is not timed, s.
const LONGEST_STEP_S: f64 = 0.2;

/// The part of a core that a solid may take.
const LOAD: f64 = 0.7;

/// With n times as many cells, a step has n times as many points, and n^⅓ times as many substeps.
const CELLS_OVER_COST: f64 = 0.75;

/// Number of windows in which the step is timed, and the length of each, s.
const WINDOWS: usize = 50;
const WINDOW_S: f64 = 0.004;

/// Reports on a scene, and on a script for it if one is given, and times a step under a poke. `limits` bound the
/// schemes that it tries. `clock_s` returns a monotonic time, s.
///
/// The timing takes about 0.2 s, or longer for steps above 4 ms; it is left out, and the report says so, if a step is
/// predicted to take more than 0.2 s or the guard stops it.
pub fn check(model: &Arc<Model>, script: Option<&Script>, limits: &Limits, clock_s: &dyn Fn() -> f64) -> CheckReport {
    let mut candidates = scheme_selection::candidates(&model.scene, limits);
    // The choice did not try dearer schemes, and another number format alone is no candidate.
    let Plan { integrator, substeps, .. } = model.plan;
    let chosen = Choice { integrator, substeps, precision: model.precision, expected_error: model.expected_error };
    match candidates.iter_mut().find(|candidate| candidate.integrator == integrator) {
        Some(same) => *same = chosen,
        None => candidates.push(chosen),
    }
    CheckReport {
        model: model.clone(),
        candidates,
        by_auto: scheme_selection::by_auto(&model.scene, limits),
        prospect: Prospect::new(model, script),
        step_s: (model.predicted_step_s() <= LONGEST_STEP_S).then(|| time(model, clock_s)).flatten(),
    }
}

/// Times the step under a poke that moves the middle by about a tenth of a spacing, so that values have usual
/// sizes. Returns the least and the median time, s; `None` if the session fails.
fn time(model: &Arc<Model>, clock_s: &dyn Fn() -> f64) -> Option<[f64; 2]> {
    // All tiles are kept awake, to measure the cost of a step while the whole sheet moves.
    let mut awake = Model::clone(model);
    awake.sleep_tolerance = 0.0;
    let mut session = Session::new(&Arc::new(awake));
    let scene = &model.scene;
    let stiffness = scene.anchor_stiffness_n_per_m + 0.1 * scene.springs.stiffness_n_per_m;
    session.tissue.push(
        0,
        Some(Push::Constant(Poke {
            point: None,
            // The middle of a mesh may be far from its surface.
            centre_m: model.shape().rest_m(model.shape().nearest(model.shape().extent().middle_m())),
            force_n: DVec3::new(0.03, 0.0, -0.1) * stiffness * model.shape().edge_m(),
            falloff_per_m: 4.0 / model.shape().edge_m(),
            falloff_offset: 0.0,
        })),
    );
    let mut window = |steps: u64| {
        let begun_s = clock_s();
        for _ in 0..steps {
            session.advance(&mut Vec::new(), |_| {});
        }
        let each_s = (clock_s() - begun_s) / steps as f64;
        session.fault().is_none().then_some(each_s)
    };
    let first_s = window(1)?.max(window(2)?);
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    let steps = (WINDOW_S / first_s).clamp(1.0, 1e6) as u64;
    let mut times = (0..WINDOWS).map(|_| window(steps)).collect::<Option<Vec<f64>>>()?;
    times.sort_by(f64::total_cmp);
    Some([times[0], times[WINDOWS / 2]])
}

/// Returns an expected error in words.
fn error(expected: f64) -> String {
    if expected.is_finite() { format!("{expected:.1e}") } else { "unknown".to_owned() }
}

/// Writes a choice as a row of the table.
fn row(f: &mut fmt::Formatter<'_>, choice: &Choice) -> fmt::Result {
    let Choice { integrator, substeps, precision, expected_error } = choice;
    let (integrator, precision) = (integrator.name(), precision.name());
    writeln!(f, "  {integrator:<15} {substeps:>8}  {precision:<11}  {}", error(*expected_error))
}

impl fmt::Display for CheckReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let model = &self.model;
        let (scene, plan) = (&model.scene, &model.plan);
        let sheet = Oscillator::of(scene);
        writeln!(
            f,
            "scene         {}: {}, {} steps a second",
            scene.name,
            model.shape().describe(),
            scene.stepping.rate_hz
        )?;
        write!(f, "{}", self.prospect)?;
        let slowest = Relaxation::of(scene).slowest_per_s();
        writeln!(
            f,
            "frequencies   {:.3} Hz ({}) to at most {:.3} Hz (ω_b = {:.4} rad/s, under any \
             deformation)",
            slowest / TAU,
            scene.body.kind().slowest_vibration(),
            model.omega_bound_per_s / TAU,
            model.omega_bound_per_s
        )?;
        if let Some(fastest) = scene.body.kind().fastest() {
            let point = PointId::new(fastest.vertex as usize);
            let is_volume = scene.volume_is_fastest();
            writeln!(
                f,
                "fastest       {} at {:.4} m: {:.2} times as fast as at half of the springs; it decides {}the substeps",
                model.shape().name(point),
                model.shape().rest_m(point),
                fastest.fastest_ratio(),
                if is_volume { "less than the volume " } else { "" }
            )?;
            if let Some(volume) = scene.volume() {
                let swelling = volume.swelling;
                let stiffness_n_per_m = scene.volume_stiffness_pa * swelling.by_pressure_m
                    + scene.springs.stiffness_n_per_m * swelling.by_springs;
                writeln!(
                    f,
                    "volume        {:.3} ml, which swells and shrinks with at most {:.3} Hz{}; the pressure rises by {:.4} Pa a ml",
                    volume.volume_m3 * 1e6,
                    ((stiffness_n_per_m + sheet.anchor_stiffness_n_per_m) / sheet.mass_kg).sqrt() / TAU,
                    if is_volume { " and decides the substeps" } else { "" },
                    scene.volume_stiffness_pa / volume.volume_m3 * 1e-6
                )?;
            }
        }
        let decay_s = 2.0 * sheet.mass_kg / sheet.damping_n_s_per_m;
        if decay_s.is_finite() {
            writeln!(f, "damping       vibrations decay by e in {decay_s:.4} s")?;
        } else {
            writeln!(
                f,
                "damping       none: vibrations last, and errors of {} s are expected",
                scheme_selection::LASTING_S
            )?;
        }
        if sheet.relaxes() {
            let branches = sheet.branches.iter().filter(|branch| branch.stiffness > 0.0);
            let at_once = MaxwellBranch::whole(&sheet.branches);
            let times: Vec<String> = branches.map(|branch| format!("{} s", branch.time_s)).collect();
            writeln!(
                f,
                "branches      {at_once:.3} times as stiff at once; what they hold falls by e in {}",
                times.join(", ")
            )?;
        }
        let times = if plan.substeps == 1 { "once" } else { "times" };
        let count = if plan.substeps == 1 { String::new() } else { format!("{} ", plan.substeps) };
        writeln!(
            f,
            "chosen        {}, {count}{times} a step (dt·ω_b = {:.3}), {}, {} lanes",
            plan.integrator.name(),
            plan.substep_s * model.omega_bound_per_s,
            model.precision.name(),
            model.lanes.name()
        )?;
        writeln!(f, "stability     {}", if plan.stable { "within the bound" } else { "BEYOND the bound" })?;
        writeln!(
            f,
            "error         {} expected, {:.1e} asked for, of displacement and force relative to their largest",
            error(model.expected_error),
            scene.stepping.tolerance
        )?;
        writeln!(f, "sleep         tiles at rest are left out, for an error of at most {:.1e}", model.sleep_tolerance)?;
        if let Some([least_s, median_s]) = self.step_s {
            let points = (model.len() * plan.substeps as usize) as f64;
            writeln!(
                f,
                "time          {:.2} µs a step at best, {:.2} µs in the median ({:.2} ns a point and substep)",
                least_s * 1e6,
                median_s * 1e6,
                least_s * 1e9 / points
            )?;
            let sessions = 1.0 / (median_s * scene.stepping.rate_hz);
            writeln!(f, "sessions      {sessions:.1} on a core, without clients and frames")?;
            if let Some(cells) = scene.body.kind().cells() {
                let most = cells as f64 * (LOAD * sessions).powf(CELLS_OVER_COST);
                let percent = 100.0 * LOAD;
                writeln!(
                    f,
                    "capacity      about {most:.0} cells on this core, at {percent:.0} % of real time: solid.cells = {most:.0}"
                )?;
            }
        } else if model.predicted_step_s() > LONGEST_STEP_S {
            writeln!(f, "time          not measured: a step would take about {:.1} s", model.predicted_step_s())?;
        } else {
            writeln!(f, "time          not measured: the guard stopped the sheet")?;
        }
        writeln!(f, "\nWhat could have been chosen:\n  integrator      substeps  precision    expected error")?;
        for candidate in &self.candidates {
            row(f, candidate)?;
        }
        if let Some(by_auto) = &self.by_auto {
            writeln!(f, "With `auto` for integrator, substeps and precision:")?;
            row(f, by_auto)?;
        }
        for warning in model.warnings.iter().chain(&self.prospect.warnings) {
            writeln!(f, "\nwarning: {warning}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::cell::Cell;

    use super::*;

    #[test]
    fn a_report_tells_the_time_of_a_step_and_the_decay_of_vibrations() {
        // 2m/C with m = 0.01 kg.
        let model = Model::parse(
            "paper",
            palpate_tissue::scene::PAPER,
            &["sheet.points=[3, 3]", "damping.coefficient_n_s_per_m=0.4"],
        )
        .unwrap();
        // Between two looks at this clock a whole window passes, whatever is done.
        let now_s = Cell::new(100.0);
        let clock_s = || now_s.replace(now_s.get() + WINDOW_S);
        let report = check(&model, None, &Limits::default(), &clock_s);
        assert!(report.step_s.unwrap().iter().all(|step_s| (step_s - WINDOW_S).abs() < 1e-9), "{:?}", report.step_s);
        let text = report.to_string();
        assert!(text.contains("vibrations decay by e in 0.0500 s"), "{text}");
        assert!(text.contains("4000.00 µs a step at best"), "{text}");
    }

    #[test]
    fn a_report_tells_how_often_a_step_is_divided_and_what_a_point_takes_of_it() {
        let now_s = Cell::new(0.0);
        let clock_s = || now_s.replace(now_s.get() + WINDOW_S);
        let text = |substeps: u32| {
            let set = format!("stepping.substeps={substeps}");
            let model = Model::parse(
                "paper",
                palpate_tissue::scene::PAPER,
                &["sheet.points=[3, 3]", "stepping.integrator=central", &set],
            )
            .unwrap();
            check(&model, None, &Limits::default(), &clock_s).to_string()
        };
        let (once, four) = (text(1), text(4));
        assert!(once.contains("central, once a step (dt·ω_b = "), "{once}");
        assert!(four.contains("central, 4 times a step (dt·ω_b = "), "{four}");
        // A window of 4 ms among nine points, and among as many four times.
        assert!(once.contains("(444444.44 ns a point and substep)"), "{once}");
        assert!(four.contains("(111111.11 ns a point and substep)"), "{four}");
    }

    #[test]
    fn the_table_has_what_was_chosen_and_what_auto_would_take_where_the_scene_gives_something() {
        let limits = Limits::default();
        let now_s = Cell::new(0.0);
        let clock_s = || now_s.replace(now_s.get() + WINDOW_S);
        let of = |sets: &[&str]| {
            Model::parse("paper", palpate_tissue::scene::PAPER, &[&["sheet.points=[3, 3]"], sets].concat()).unwrap()
        };
        let report = |sets: &[&str]| check(&of(sets), None, &limits, &clock_s);
        for (sets, given) in [
            (&[][..], false),
            (&["stepping.tolerance=1e-14"][..], false),
            (&["stepping.integrator=lagged", "stepping.substeps=1"][..], true),
            (&["stepping.precision=f32", "stepping.tolerance=1e-9"][..], true),
        ] {
            let report = report(sets);
            let model = &report.model;
            let chosen = (model.plan.integrator, model.plan.substeps, model.precision, model.expected_error);
            let is_chosen = |row: &Choice| (row.integrator, row.substeps, row.precision, row.expected_error) == chosen;
            assert_eq!(report.candidates.iter().filter(|row| is_chosen(row)).count(), 1, "{sets:?}: {report:?}");
            assert_eq!((report.by_auto.is_some(), report.to_string().contains("`auto`")), (given, given), "{sets:?}");
        }
        assert_eq!([error(f64::INFINITY), error(0.00123)], ["unknown", "1.2e-3"]);
    }
}
