//! Run of a script: plays it offline, in this process, as fast as possible, for `palpate run` and for programs.

use std::io::Write;
use std::sync::Arc;

use super::Session;
use super::audit::{Twin, Windows};
use super::simulation::{Simulation, SimulationFailure};
use palpate_haptics::{JawTorqueMonitor, Tip, TipShape};
use palpate_refusal::legible;
use palpate_tissue::limits::Limits;
use palpate_tissue::response::force_law::Disc;
use palpate_tissue::response::mesh_error::MeshErrorEstimate;
use palpate_tissue::scene::Named;
use palpate_tissue::scene::plot::Curves;
use palpate_tissue::scene::profile::{PoseProfile, TieProfile};
use palpate_tissue::scene::record::{
    JawOverload, Line, MAX_JAW_OVERLOADS, Record, Run, Summary, TieRecord, TopologyRecord, far_warning, write_line,
};
use palpate_tissue::scene::script::{Script, forces_n};
use palpate_tissue::{Model, StageTimes, TieState, Tissue};

/// Returns the first line of a run: the names of scene and script, the stepping of the model (integrator, substeps
/// per step, precision, steps per second), and the version of this program.
pub fn header(model: &Model, script: &str) -> Run {
    Run {
        scene: model.scene.name.clone(),
        script: script.to_owned(),
        integrator: model.plan.integrator.name().to_owned(),
        substeps: model.plan.substeps,
        precision: model.precision.name().to_owned(),
        rate_hz: model.scene.stepping.rate_hz,
        version: env!("CARGO_PKG_VERSION").to_owned(),
    }
}

/// An event of a run. A run gives `Run` first; for each step the records that are due and then `Steps`; and `Summary`
/// at the end, unless an error ends it.
pub enum RunEvent<'t> {
    /// The run begins.
    Run(&'t Run),
    /// A record is due: at t = 0 (just after the forces begin) and at the end of each `sample_every`-th step, of the
    /// script's sample points. It has energies and tools.
    Record(Record),
    /// A step was done. Contains the number of steps done, from 1.
    Steps(u64),
    /// The run has ended at the script's last step.
    Summary(&'t Summary),
}

/// How a script is played.
#[derive(Debug, Clone, Copy, Default)]
pub struct RunOptions {
    /// Whether forces and moves are played as commands that keep them constant over each step, like those of a client;
    /// otherwise as continuous functions.
    pub held: bool,
    /// Whether a second simulation in f64 with a quarter of the substep (a twin) runs beside, to measure errors.
    pub audit: bool,
    /// A clock that never goes back, ns: the summary then has the time of each stage of a step.
    pub profile: Option<fn() -> u64>,
}

/// Plays `script` on `model` from rest and writes its records, as JSON Lines, to `output`. Returns the summary, which
/// is also the last line. Blocks until the script ends.
///
/// With `audit`, the summary contains the differences between the run and its twin, and with `[stepping] correct` the run
/// corrects errors above the tolerance. `clock_s` returns a monotonic time, s; the summary has the time of the run's own steps
/// by it. `progress` is called with the number of steps done: 0, 1024, 2048 and so on.
///
/// # Errors
/// - [`SimulationFailure::Held`]: the session stops for good ([`Session::hold_reason`](super::Session::hold_reason)),
///   or with `audit` there was a recovery or the twin can't be compared.
/// - [`SimulationFailure::Refused`]: a command, a change of the tissue or a correction is refused under `limits`.
/// - [`SimulationFailure::Output`]: `output` fails. What was written before stays.
pub fn run(
    model: &Arc<Model>,
    script: &Script,
    options: RunOptions,
    limits: &Limits,
    output: &mut dyn Write,
    clock_s: &dyn Fn() -> f64,
    progress: &mut dyn FnMut(u64),
) -> Result<Summary, SimulationFailure> {
    run_with(model, script, options, limits, clock_s, &mut |told| write_event(output, progress, told))
}

/// Plays `script` on `model` from rest for a program that uses the records as values, in the calling thread. Calls
/// `tell` with each event, in the order of [`RunEvent`]. Returns the summary, which is also the last event.
///
/// `clock_s` returns a monotonic time, s; the summary's time excludes `tell` and the twin.
///
/// # Errors
/// - [`SimulationFailure::Held`]: the session stops for good ([`Session::hold_reason`](super::Session::hold_reason));
///   with `audit` also a recovery, because a tissue that was put back can't be compared, and a stop or recovery of
///   the twin. A recovery without `audit` is no error; the summary lists it.
/// - [`SimulationFailure::Refused`]: a command, a change of the tissue or a correction is refused under `limits`.
/// - [`SimulationFailure::Output`]: `tell` returned an error, which ends the run at the end of its step.
pub fn run_with(
    model: &Arc<Model>,
    script: &Script,
    options: RunOptions,
    limits: &Limits,
    clock_s: &dyn Fn() -> f64,
    tell: &mut dyn FnMut(RunEvent<'_>) -> std::io::Result<()>,
) -> Result<Summary, SimulationFailure> {
    run_observed(model, script, options, limits, clock_s, tell, &mut |_| {})
}

/// Plays `script` as [`run_with`] does, and calls `observe` with the session at t = 0⁺ and at the end of each step, before
/// the step's events. The summary's time excludes `observe`.
///
/// # Errors
/// Returns the errors of [`run_with`].
pub fn run_observed(
    model: &Arc<Model>,
    script: &Script,
    options: RunOptions,
    limits: &Limits,
    clock_s: &dyn Fn() -> f64,
    tell: &mut dyn FnMut(RunEvent<'_>) -> std::io::Result<()>,
    observe: &mut dyn FnMut(&Session),
) -> Result<Summary, SimulationFailure> {
    let RunOptions { held, audit, profile } = options;
    let (mut twin, mut corrections) = (audit.then(|| Twin::new(model, (!held).then_some(script))), Vec::new());
    let mut simulation = Simulation::playing(model, script, held, limits)?;
    simulation.session.time_stages(profile);
    tell(RunEvent::Run(&header(model, &script.name)))?;
    let mut written: std::io::Result<()> = Ok(());
    let mut windows = (twin.is_some() && model.scene.stepping.correct).then(Windows::default);
    let (mut stepping_s, mut resumed_s) = (0.0, clock_s());
    let (mut largest_displacement_m, mut peak_reaction_n, mut curves) = (0.0_f64, 0.0_f64, Curves::of(model.shape()));
    let (tip, mut on_fixed, mut jaws) = (script.first_tip(), None, WatchedJaws::of(script));
    let mut ties = WatchedTies::of(script);
    for step in 0..script.steps {
        // The summary's clock stops during everything other than the session's own stepping.
        stepping_s += clock_s() - resumed_s;
        if let Some(finding) = windows.as_mut().and_then(|windows| windows.look(&mut simulation.session))
            && let Some(correction) = simulation.correct(&finding)?
        {
            twin.iter_mut().for_each(|twin| twin.follow(simulation.session.model()));
            corrections.push(correction);
        }
        simulation.take_inputs(0)?;
        let Simulation { session, due, .. } = &mut simulation;
        if let Some(twin) = &mut twin {
            twin.follow(session.model());
            twin.advance(due, script);
            if let Some(reason) = twin.fault() {
                return Err(SimulationFailure::Held(reason));
            }
        }
        resumed_s = clock_s();
        session.advance(due, |session| {
            ties.look(session);
            stepping_s += clock_s() - resumed_s;
            observe(session);
            if jaws.has_any() {
                jaws.look(script, session);
            }
            resumed_s = clock_s();
            if session.step_count().is_multiple_of(script.sample_every) {
                stepping_s += clock_s() - resumed_s;
                if written.is_ok() {
                    if on_fixed.is_none() {
                        on_fixed = session.tool_on_fixed().map(|tool| (tool, session.time_s()));
                    }
                    let (energy_j, tools) = (Some(session.energy()), session.tool_records());
                    let instruments = script.instrument_records(session.time_s(), &tools);
                    let record = Record { energy_j, tools, instruments, ..session.record(Some(&script.sample_points)) };
                    largest_displacement_m = largest_displacement_m.max(session.tissue().largest_displacement_m());
                    peak_reaction_n = peak_reaction_n.max(record.peak_n(tip.is_some()));
                    if let Some((displacement_m, force_n)) = record.first(tip) {
                        curves.add(record.time_s, displacement_m.into(), force_n.into());
                    }
                    twin.iter_mut().for_each(|twin| twin.compare(&record));
                    written = tell(RunEvent::Record(record));
                }
                resumed_s = clock_s();
            }
        });
        std::mem::replace(&mut written, Ok(()))?;
        // A tissue that was put back to an earlier state can't be compared with a twin that was not.
        let ended = if twin.is_some() { session.fault() } else { session.hold_reason().map(str::to_owned) };
        if let Some(reason) = ended {
            return Err(SimulationFailure::Held(reason));
        }
        tell(RunEvent::Steps(step + 1))?;
    }
    stepping_s += clock_s() - resumed_s;
    let audited_error = twin.as_ref().map(Twin::error);
    let session = &simulation.session;
    let on_fixed = on_fixed.map(|(tool, time_s)| {
        format!(
            "tool {tool} pressed on fixed points, at {time_s:.3} s first: less than a quarter of its tip could move there, and its \
             force is not that of free tissue"
        )
    });
    let crushed = jaws.warning(model.scene.stepping.rate_hz);
    let exhausted = (session.cuts_exhausted() && severs(script)).then(|| {
        "blades only push in the end, and burns sever nothing: the solid has no spare places left for the corners that another cut \
         would double"
            .to_owned()
    });
    let warnings = far_warning(largest_displacement_m, model.shape())
        .into_iter()
        .chain(on_fixed)
        .chain(crushed)
        .chain(exhausted)
        .collect();
    let summary = Summary {
        audited_error,
        mesh_error_estimate: MeshErrorEstimate::of(model, disc(model, script)).map(|error| error.relative),
        corrections,
        recoveries: session.recoveries().list(),
        jaw_overloads: jaws.overloads,
        ties: ties.records(script),
        warnings,
        largest_displacement_m,
        peak_reaction_n,
        curves,
        ..summary(session.tissue(), stepping_s)
    };
    tell(RunEvent::Summary(&summary))?;
    Ok(summary)
}

/// What the threads and clips of a script have borne.
struct WatchedTies {
    /// By number: the sum of the distances between its bites just after it was laid, m, and its newest state.
    newest: Vec<Option<(f64, TieState)>>,
}

impl WatchedTies {
    fn of(script: &Script) -> Self {
        WatchedTies { newest: vec![None; script.ties.len()] }
    }

    fn look(&mut self, session: &Session) {
        if self.newest.is_empty() {
            return;
        }
        for state in session.tissue().ties() {
            let Some(newest) = self.newest.get_mut(state.number) else { continue };
            let laid_m = newest.as_ref().map_or(state.path_m, |newest| newest.0);
            *newest = Some((laid_m, state));
        }
    }

    fn records(&self, script: &Script) -> Vec<TieRecord> {
        let laid = script.ties.iter().zip(&self.newest).filter_map(|(tie, newest)| Some((tie, newest.as_ref()?)));
        let of = |(tie, (laid_m, state)): (&TieProfile, &(f64, TieState))| TieRecord {
            name: tie.name.clone(),
            peak_tension_n: state.peak_n,
            length_m: state.length_m,
            path_when_laid_m: *laid_m,
            path_m: state.path_m,
            is_broken: state.is_broken,
        };
        laid.map(of).collect()
    }
}

/// The instruments of a script whose jaws have a limit, and when they exceeded it.
struct WatchedJaws {
    /// By the number of the instrument.
    monitors: Vec<(usize, JawTorqueMonitor)>,
    overloads: Vec<JawOverload>,
    /// How often they did; `overloads` has the first of these.
    count: u64,
}

impl WatchedJaws {
    fn of(script: &Script) -> Self {
        let numbered = script.instruments.iter().enumerate();
        let monitors = numbered
            .filter_map(|(number, profile)| Some((number, JawTorqueMonitor::of(&profile.instrument)?)))
            .collect();
        WatchedJaws { monitors, overloads: Vec::new(), count: 0 }
    }

    fn has_any(&self) -> bool {
        !self.monitors.is_empty()
    }

    /// Takes the torques at the end of a step. An instrument that is not there exerts none.
    #[allow(clippy::cast_possible_truncation)]
    fn look(&mut self, script: &Script, session: &Session) {
        let (tools, time_s) = (session.tool_records(), session.time_s());
        for (number, monitor) in &mut self.monitors {
            let profile = &script.instruments[*number];
            let opening_n_m =
                profile.at(time_s).map_or(0.0, |pose| profile.instrument.opening_n_m(&pose, forces_n(profile, &tools)));
            if monitor.exceeds(opening_n_m) {
                self.count += 1;
                if self.overloads.len() < MAX_JAW_OVERLOADS {
                    self.overloads.push(JawOverload {
                        step: session.step_count(),
                        instrument: *number as u32,
                        first_tool: profile.first_tool as u32,
                        torque_n_m: opening_n_m,
                        limit_n_m: monitor.limit_n_m(),
                    });
                }
            }
        }
    }

    /// Returns a warning about the first time; `None` if there is none.
    #[allow(clippy::cast_precision_loss)]
    fn warning(&self, rate_hz: f64) -> Option<String> {
        let JawOverload { step, instrument, first_tool, torque_n_m, limit_n_m } = self.overloads.first()?;
        let times = if self.count == 1 { "once".to_owned() } else { format!("{} times", self.count) };
        Some(format!(
            "the jaws of instrument {instrument} (tool {first_tool}) crush what they hold: at {:.3} s the torque between them was {} \
             N·m, above its limit of {} N·m; all jaws exceeded their limits {times}",
            *step as f64 / rate_hz,
            legible(*torque_n_m),
            legible(*limit_n_m)
        ))
    }
}

/// Returns whether a script has a tip that severs: a blade, or one that burns.
fn severs(script: &Script) -> bool {
    let of_instruments = script.instruments.iter().flat_map(|profile| &profile.instrument.tips).map(|tip| &tip.tip);
    let mut tips = script.poses.iter().map(|profile| &profile.tip).chain(of_instruments);
    tips.any(|tip| tip.shape == TipShape::Blade || tip.burn_s > 0.0)
}

/// Returns the disc of the first tip of a script, where it is first; without a tip that of a fingertip in the middle.
fn disc(model: &Model, script: &Script) -> Disc {
    match script.poses.first() {
        Some(PoseProfile { tip, poses, .. }) if !poses.is_empty() => Disc { radius_m: tip.radius_m, at_m: poses[0].1 },
        _ => Disc::in_middle(model, Tip::default().radius_m),
    }
}

/// Writes an event of a run to `output`, as a JSON line, or calls `progress` with the number of steps done: 0, 1024, 2048
/// and so on.
///
/// # Errors
/// Returns the error of writing.
pub fn write_event(output: &mut dyn Write, progress: &mut dyn FnMut(u64), event: RunEvent<'_>) -> std::io::Result<()> {
    match event {
        RunEvent::Run(run) => write_line(output, &Line::Run(run)),
        RunEvent::Record(record) => write_line(output, &record),
        RunEvent::Summary(summary) => write_line(output, &Line::Summary(summary)),
        RunEvent::Steps(steps) => {
            // Every 1024 steps, beginning with the first.
            if steps % 1024 == 1 {
                progress(steps - 1);
            }
            Ok(())
        }
    }
}

/// Returns how blades have changed what joins the points of a tissue.
pub fn topology(tissue: &dyn Tissue) -> TopologyRecord {
    let cuts = tissue.cuts();
    TopologyRecord {
        topology_version: cuts.version(),
        severed: cuts.len(),
        severed_anchors: cuts.anchor_count(),
        pieces: cuts.pieces(tissue.model()),
        fracture_j: cuts.fracture_j(),
    }
}

/// Returns the summary of a run that ended with this tissue and whose steps took `wall_s`, s: counts, time per point
/// and substep (ns; not a number before the first substep), and the final hash. Fields that only the run itself can
/// fill (audit, corrections, recoveries, warnings, peaks, curves and network) are empty or 0.
#[allow(clippy::cast_precision_loss)]
pub fn summary(tissue: &dyn Tissue, wall_s: f64) -> Summary {
    let (model, steps) = (tissue.model(), tissue.step_count());
    let substeps = tissue.substeps_done();
    Summary {
        steps,
        substeps,
        points: model.len(),
        wall_s,
        ns_per_point_substep: wall_s * 1e9 / (substeps as f64 * model.len() as f64),
        computed_fraction: tissue.computed_fraction(),
        guard_events: tissue.guard_events(),
        topology: Some(topology(tissue)),
        final_hash: format!("{:032x}", tissue.state_hash()),
        audited_error: None,
        mesh_error_estimate: None,
        corrections: Vec::new(),
        recoveries: Vec::new(),
        jaw_overloads: Vec::new(),
        ties: Vec::new(),
        warnings: Vec::new(),
        largest_displacement_m: 0.0,
        peak_reaction_n: 0.0,
        curves: Curves::default(),
        stages: tissue.stage_times().map(StageTimes::list).unwrap_or_default(),
        network: None,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::cell::Cell;
    use std::path::Path;
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;

    /// Two forces and two grasped points, each far from the others.
    const FOUR_TOOLS: &str = "duration_s = 0.02\nsample_every_s = 0.01\n\
        [[force]]\npoint = [2, 2]\nforce_n = [0.0, 0.0, -0.1]\nfalloff_per_m = 500.0\nfalloff_offset = 0.0\n\
        profile = { type = \"constant\" }\n\
        [[force]]\npoint = [2, 12]\nforce_n = [0.0, 0.0, -0.1]\nfalloff_per_m = 500.0\nfalloff_offset = 0.0\n\
        profile = { type = \"constant\" }\n\
        [[tool]]\npoint = [12, 2]\nmoves = [{ from_s = 0.0, to_s = 0.02, by_m = [0.0, 0.0, -0.01] }]\n\
        [[tool]]\npoint = [12, 12]\nmoves = [{ from_s = 0.0, to_s = 0.02, by_m = [0.0, 0.0, -0.01] }]\n";

    fn model() -> Arc<Model> {
        Model::parse(
            "paper",
            palpate_tissue::scene::PAPER,
            &["sheet.points=[15, 15]", "stepping.integrator=central", "stepping.substeps=1"],
        )
        .unwrap()
    }

    fn script(model: &Model, more: &str) -> Script {
        let text = format!("{FOUR_TOOLS}{more}");
        Script::parse("test", &text, Path::new(""), &model.scene, &Limits::default()).unwrap()
    }

    #[test]
    fn every_force_and_every_grasp_of_a_script_acts() {
        let model = model();
        let mut simulation = Simulation::playing(&model, &script(&model, ""), false, &Limits::default()).unwrap();
        simulation.run_to(10).unwrap();
        for (point, is_grasped) in [([2, 2], false), ([2, 12], false), ([12, 2], true), ([12, 12], true)] {
            let state = simulation.session.tissue().point(model.scene.sheet().unwrap().point(point));
            assert!(state.displacement_m.z < -1e-4, "{point:?}: {state:?}");
            assert_eq!(state.constraint_n.is_some(), is_grasped, "{point:?}");
            assert_eq!(state.applied_n.z < -0.09, !is_grasped, "{point:?}: {state:?}");
        }
    }

    #[test]
    fn a_run_takes_its_changes_of_tissue_and_no_more_time_than_passed() {
        let model = model();
        let run_with = |more: &str| {
            let (begun_s, mut output) = (1e6, Vec::new());
            let now_s = Cell::new(begun_s);
            let clock_s = || now_s.replace(now_s.get() + 0.5);
            let script = script(&model, more);
            let summary =
                run(&model, &script, RunOptions::default(), &Limits::default(), &mut output, &clock_s, &mut |_| {})
                    .unwrap();
            let passed_s = now_s.get() - begun_s;
            assert!(summary.wall_s > 0.0 && summary.wall_s <= passed_s, "{} of {passed_s} s", summary.wall_s);
            let point_substeps = summary.points as f64 * summary.substeps as f64;
            assert!((summary.ns_per_point_substep * point_substeps / (1e9 * summary.wall_s) - 1.0).abs() < 1e-12);
            summary
        };
        let plain = run_with("");
        let changed = run_with("[[tissue]]\nat_s = 0.01\nanchor_stiffness_n_per_m = 50.0\n");
        assert_eq!((plain.steps, changed.steps), (20, 20));
        assert_ne!(plain.final_hash, changed.final_hash);
        // While a clock stands still, no time is counted.
        let script = script(&model, "");
        let summary =
            run(&model, &script, RunOptions::default(), &Limits::default(), &mut Vec::new(), &|| 1e6, &mut |_| {})
                .unwrap();
        assert_eq!(summary.wall_s, 0.0);
        // At the very end it changes nothing.
        let late = run_with("[[tissue]]\nat_s = 0.02\nanchor_stiffness_n_per_m = 50.0\n");
        assert_eq!(plain.final_hash, late.final_hash);
    }

    #[test]
    fn a_summary_has_the_largest_reaction_of_all_its_records() {
        let model = model();
        let back = "[[tool]]\npoint = [7, 7]\nmoves = [{ from_s = 0.0, to_s = 0.01, by_m = [0.0, 0.0, -0.02] }, \
                    { from_s = 0.01, to_s = 0.02, by_m = [0.0, 0.0, 0.02] }]\n";
        let text = format!("duration_s = 0.02\nsample_every_s = 0.001\n{back}");
        let script = Script::parse("test", &text, Path::new(""), &model.scene, &Limits::default()).unwrap();
        let mut output = Vec::new();
        let summary =
            run(&model, &script, RunOptions::default(), &Limits::default(), &mut output, &|| 0.0, &mut |_| {}).unwrap();
        let mut largest_n = 0.0_f64;
        for line in String::from_utf8(output).unwrap().lines() {
            let record: serde_json::Value = serde_json::from_str(line).unwrap();
            for point in record["points"].as_array().into_iter().flatten() {
                let force_n = point["reaction_n"].as_array().unwrap().iter().map(|part| part.as_f64().unwrap());
                largest_n = largest_n.max(force_n.map(|part| part * part).sum::<f64>().sqrt());
            }
        }
        assert!(largest_n > 0.1, "{largest_n} N");
        assert!(
            (summary.peak_reaction_n - largest_n).abs() < 1e-9 * largest_n,
            "{} {largest_n}",
            summary.peak_reaction_n
        );
    }

    #[test]
    fn a_profile_has_the_time_of_each_stage_and_changes_nothing() {
        static NOW_NS: AtomicU64 = AtomicU64::new(0);
        // Each look at the clock takes a millisecond.
        let clock: fn() -> u64 = || NOW_NS.fetch_add(1_000_000, Ordering::Relaxed);
        let model =
            Model::parse("paper", palpate_tissue::scene::PAPER, &["sheet.points=[9, 9]", "stepping.substeps=2"])
                .unwrap();
        let script = "duration_s = 0.05\nsample_every_s = 0.05\n[[force]]\nat_m = [0.1, 0.1]\nforce_n = [0.0, 0.0, -0.5]\n\
                      falloff_per_m = 20.0\nfalloff_offset = 0.0\nprofile = { type = \"constant\" }\n";
        let script = Script::parse("test", script, Path::new(""), &model.scene, &Limits::default()).unwrap();
        let run = |profile| {
            let options = RunOptions { profile, ..Default::default() };
            run(&model, &script, options, &Limits::default(), &mut Vec::new(), &|| 0.0, &mut |_| {}).unwrap()
        };
        let (plain, measured) = (run(None), run(Some(clock)));
        assert!(plain.stages.is_empty());
        assert_eq!(plain.final_hash, measured.final_hash);
        let time_s = |name: &str| measured.stages.iter().find(|stage| stage.stage == name).unwrap().time_s;
        // Two substeps in each of 50 steps; a sheet has no pressure.
        assert_eq!((time_s("sweep"), time_s("contact"), time_s("pressure")), (0.1, 0.1, 0.0));
        assert_eq!(time_s("guard"), 0.05);
    }
}
