//! `palpate run`: plays a script offline, in process, as fast as possible.

use std::collections::VecDeque;
use std::io::Write;
use std::sync::Arc;

use super::Session;
use super::audit::{Twin, Windows};
use super::command::{Command, Due};
use super::intake::Intake;
use palpate_refusal::{Refusal, Result};
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Named;
use palpate_tissue::scene::plot::Curves;
use palpate_tissue::scene::record::{Correction, Line, Record, Run, Summary, far_warning, write_line};
use palpate_tissue::scene::script::{Action, Script};
use palpate_tissue::select::audit::AuditFinding;
use palpate_tissue::{Model, Tissue};

/// Why a run ends early.
#[derive(Debug, thiserror::Error)]
pub enum RunFailure {
    /// The session is held, or the audit's twin has failed.
    #[error("the run was stopped: {0}")]
    Held(String),
    /// An input is refused, for the reasons for which a server would refuse it.
    #[error("{0}")]
    Refused(#[from] Refusal),
    /// The output can't be written.
    #[error("can't write the output: {0}")]
    Output(#[from] std::io::Error),
}

/// Returns the first line of a run: the scene, the script and how the scene is stepped.
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

/// Returns the command for a script's action at `step`, as a client streams it. Its sequence number is `step` + 1.
pub fn command(tool: usize, step: u64, action: Action) -> Command {
    #[allow(clippy::cast_possible_truncation)]
    let tool = tool as u32;
    // A tool has at most one command per step, so steps serve as sequence numbers.
    Command { at_step: Some(step), ..Command::new(tool, Some(step + 1), action) }
}

/// Sets the forces and moves of a script, as continuous profiles, in a session that has not begun.
pub fn play(session: &mut Session, script: &Script) {
    for (tool, profile) in script.forces.iter().enumerate() {
        session.play_force(tool, profile.clone());
    }
    for (index, profile) in script.moves.iter().enumerate() {
        session.play_move(script.forces.len() + index, profile.clone());
    }
}

/// Player of a script into sessions. Forces and moves are continuous profiles that are set once or, if `held`,
/// commands as a client streams them. Poses are commands in both cases.
pub struct Player<'s> {
    script: &'s Script,
    /// The intake for commands, as a server has one.
    intake: Option<Intake>,
    held: bool,
}

impl<'s> Player<'s> {
    /// Creates a player that begins `script`.
    ///
    /// # Errors
    /// Refuses a script with more tools than `limits` allow.
    pub fn new(model: &Model, script: &'s Script, held: bool, limits: &Limits) -> Result<Self> {
        let commands = held || !script.poses.is_empty();
        let intake = commands.then(|| intake(model, script, limits)).transpose()?;
        Ok(Player { script, intake, held })
    }

    /// Sets the profiles in a session that has not begun; does nothing if `held`.
    pub fn begin(&self, session: &mut Session) {
        if !self.held {
            play(session, self.script);
        }
    }

    /// Appends the commands that act at `step` to `due`.
    ///
    /// # Errors
    /// Refuses commands that a server would refuse.
    pub fn commands(&mut self, step: u64, due: &mut Vec<Due>) -> Result<()> {
        let Some(intake) = &mut self.intake else { return Ok(()) };
        let actions: Vec<_> =
            if self.held { self.script.actions_at(step).collect() } else { self.script.poses_at(step).collect() };
        for (tool, action) in actions {
            intake.submit(LEASE, vec![command(tool, step, action)], 0)?;
        }
        intake.take_due(step, 0, due);
        Ok(())
    }
}

/// Changes the tissue of `session` to the newest one that is due at the coming step, and removes the due changes
/// from `changes`.
pub fn change(session: &mut Session, changes: &mut VecDeque<(u64, Arc<Model>)>) {
    while changes.front().is_some_and(|change| change.0 <= session.step_count()) {
        if let Some((_, model)) = changes.pop_front() {
            session.change(&model);
        }
    }
}

/// An event of a run, in the order of the output.
pub enum RunEvent<'t> {
    /// The run begins.
    Run(&'t Run),
    /// A record is due.
    Record(Record),
    /// The number of steps done, after each step.
    Steps(u64),
    /// The run is over.
    Summary(&'t Summary),
}

/// Plays `script` and writes its records, as JSON Lines, to `output`. `held` plays forces and moves as commands
/// that keep them constant over each step. `clock_s` returns the time, s, for the summary; `progress` gets the
/// number of steps done every 1024 steps. Returns the summary, which is also the last line.
///
/// # Errors
/// Returns an error if the session is held, a command or change is refused, or the output can't be written.
pub fn run(
    model: &Arc<Model>,
    script: &Script,
    held: bool,
    limits: &Limits,
    output: &mut dyn Write,
    clock_s: &dyn Fn() -> f64,
    progress: &mut dyn FnMut(u64),
) -> std::result::Result<Summary, RunFailure> {
    self::told(model, script, [held, false], limits, clock_s, &mut |told| write(output, progress, told))
}

/// Plays `script` as [`run`] does, beside a twin in f64 with a quarter of the substep: the summary has the
/// differences between the two. With `[stepping] correct`, the run corrects errors above the tolerance on its way.
///
/// # Errors
/// Returns an error for the reasons of [`run`], and if a recovery makes the comparison with the twin impossible.
pub fn audited(
    model: &Arc<Model>,
    script: &Script,
    held: bool,
    limits: &Limits,
    output: &mut dyn Write,
    clock_s: &dyn Fn() -> f64,
    progress: &mut dyn FnMut(u64),
) -> std::result::Result<Summary, RunFailure> {
    self::told(model, script, [held, true], limits, clock_s, &mut |told| write(output, progress, told))
}

/// Plays `script` for a program that takes the records as values: `tell` gets each event and may end the run with
/// an error. The pair is whether forces and moves are commands ([`run`]), and whether a twin audits the run
/// ([`audited`]).
///
/// # Errors
/// Returns an error for the reasons of [`run`] and [`audited`]; an error of `tell` is [`RunFailure::Output`].
pub fn told(
    model: &Arc<Model>,
    script: &Script,
    [held, audit]: [bool; 2],
    limits: &Limits,
    clock_s: &dyn Fn() -> f64,
    tell: &mut dyn FnMut(RunEvent<'_>) -> std::io::Result<()>,
) -> std::result::Result<Summary, RunFailure> {
    let twin = audit.then(|| Twin::new(model));
    Playing { model, script, held, limits, twin, corrections: Vec::new() }.play(clock_s, tell)
}

/// Writes an event of a run as a JSON line, or reports progress.
fn write(output: &mut dyn Write, progress: &mut dyn FnMut(u64), told: RunEvent<'_>) -> std::io::Result<()> {
    match told {
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

/// A script that is being played.
struct Playing<'p> {
    model: &'p Arc<Model>,
    script: &'p Script,
    held: bool,
    limits: &'p Limits,
    twin: Option<Twin>,
    corrections: Vec<Correction>,
}

impl Playing<'_> {
    fn play(
        mut self,
        clock_s: &dyn Fn() -> f64,
        tell: &mut dyn FnMut(RunEvent<'_>) -> std::io::Result<()>,
    ) -> std::result::Result<Summary, RunFailure> {
        let Playing { model, script, held, limits, .. } = self;
        let mut session = Session::new(model);
        let mut changes = model.apply_changes(&script.changes, limits)?;
        let mut player = Player::new(model, script, held, limits)?;
        player.begin(&mut session);
        self.twin.iter_mut().for_each(|twin| player.begin(twin.session()));
        tell(RunEvent::Run(&header(model, &script.name)))?;
        let mut due = Vec::new();
        let mut written: std::io::Result<()> = Ok(());
        let mut windows = (self.twin.is_some() && model.scene.stepping.correct).then(Windows::default);
        let (mut stepping_s, mut resumed_s) = (0.0, clock_s());
        let (mut largest_displacement_m, mut peak_reaction_n, mut curves) =
            (0.0_f64, 0.0_f64, Curves::of(model.shape()));
        let (tip, mut on_fixed) = (script.first_tip(), None);
        for step in 0..script.steps {
            player.commands(step, &mut due)?;
            // The summary's clock stops during everything other than the session's own stepping.
            stepping_s += clock_s() - resumed_s;
            if let Some(windows) = &mut windows
                && let Some(finding) = windows.look(&mut session)
            {
                self.correct(&mut session, &finding, &mut changes)?;
            }
            if changes.front().is_some_and(|change| change.0 <= step) {
                change(&mut session, &mut changes);
                let model = session.model().clone();
                self.twin.iter_mut().for_each(|twin| twin.change(&model));
            }
            if let Some(twin) = &mut self.twin {
                twin.advance(&due, script);
                if let Some(reason) = twin.fault() {
                    return Err(RunFailure::Held(reason));
                }
            }
            resumed_s = clock_s();
            session.advance(&mut due, |session| {
                if session.step_count().is_multiple_of(script.sample_every) {
                    stepping_s += clock_s() - resumed_s;
                    if written.is_ok() {
                        if on_fixed.is_none() {
                            on_fixed = session.tool_on_fixed().map(|tool| (tool, session.time_s()));
                        }
                        let (energy_j, tools) = (Some(session.energy()), session.tool_records());
                        let record = Record { energy_j, tools, ..session.record(Some(&script.sample_points)) };
                        largest_displacement_m = largest_displacement_m.max(session.tissue().largest_displacement_m());
                        peak_reaction_n = peak_reaction_n.max(record.peak_n(tip.is_some()));
                        if let Some((displacement_m, force_n)) = record.first(tip) {
                            curves.add(record.time_s, displacement_m.into(), force_n.into());
                        }
                        self.twin.iter_mut().for_each(|twin| twin.compare(&record));
                        written = tell(RunEvent::Record(record));
                    }
                    resumed_s = clock_s();
                }
            });
            std::mem::replace(&mut written, Ok(()))?;
            // A tissue that has recovered can't be compared with a twin that has not.
            let ended = if self.twin.is_some() { session.fault() } else { session.hold_reason().map(str::to_owned) };
            if let Some(reason) = ended {
                return Err(RunFailure::Held(reason));
            }
            tell(RunEvent::Steps(step + 1))?;
        }
        stepping_s += clock_s() - resumed_s;
        let audited_error = self.twin.as_ref().map(Twin::error);
        let (corrections, recoveries) = (self.corrections, session.recoveries().list());
        let on_fixed = on_fixed.map(|(tool, time_s)| {
            format!(
                "tool {tool} pressed on fixed points, at {time_s:.3} s first: less than a quarter of its tip could move there, and its \
                 force is not that of free tissue"
            )
        });
        let warnings = far_warning(largest_displacement_m, model.shape()).into_iter().chain(on_fixed).collect();
        let summary = Summary {
            audited_error,
            corrections,
            recoveries,
            warnings,
            largest_displacement_m,
            peak_reaction_n,
            curves,
            ..summary(session.tissue(), stepping_s)
        };
        tell(RunEvent::Summary(&summary))?;
        Ok(summary)
    }

    /// Applies the finding's correction from now on, if it needs one, and also to the script's later changes.
    fn correct(
        &mut self,
        session: &mut Session,
        finding: &AuditFinding,
        changes: &mut VecDeque<(u64, Arc<Model>)>,
    ) -> Result<()> {
        let step = session.step_count();
        let Some(correction) = session.model().correction(finding, step, self.limits) else { return Ok(()) };
        let corrected = session.model().corrected(&correction, self.limits)?;
        session.change(&corrected);
        self.twin.iter_mut().for_each(|twin| twin.change(&corrected));
        self.corrections.push(correction);
        let later = self.script.changes.len() - changes.len();
        *changes = corrected.course_of(&self.model.scene, &self.script.changes[later..], self.limits)?;
        Ok(())
    }
}

/// Any number serves: no other client uses this intake.
const LEASE: u128 = 1;

fn intake(model: &Model, script: &Script, limits: &Limits) -> Result<Intake> {
    let mut intake = Intake::new(&model.scene, limits);
    #[allow(clippy::cast_possible_truncation)]
    let tools: Vec<u32> = (0..script.tools() as u32).collect();
    if !tools.is_empty() {
        intake.acquire(&tools, "run", limits.lease_s, LEASE, 0)?;
    }
    Ok(intake)
}

/// Returns the last line of a run with this tissue at its end, without what only the run itself knows. `wall_s` is
/// the time of stepping, s.
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
        final_hash: format!("{:032x}", tissue.state_hash()),
        audited_error: None,
        corrections: Vec::new(),
        recoveries: Vec::new(),
        warnings: Vec::new(),
        largest_displacement_m: 0.0,
        peak_reaction_n: 0.0,
        curves: Curves::default(),
        network: None,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::cell::Cell;
    use std::path::Path;

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
        let mut session = Session::new(&model);
        play(&mut session, &script(&model, ""));
        (0..10).for_each(|_| session.advance(&mut Vec::new(), |_| {}));
        for (point, is_grasped) in [([2, 2], false), ([2, 12], false), ([12, 2], true), ([12, 12], true)] {
            let state = session.tissue().point(model.scene.sheet().unwrap().point(point));
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
            let summary = run(&model, &script, false, &Limits::default(), &mut output, &clock_s, &mut |_| {}).unwrap();
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
        let summary = run(&model, &script, false, &Limits::default(), &mut Vec::new(), &|| 1e6, &mut |_| {}).unwrap();
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
        let summary = run(&model, &script, false, &Limits::default(), &mut output, &|| 0.0, &mut |_| {}).unwrap();
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
}
