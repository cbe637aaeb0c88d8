//! `palpate run`: plays a script offline, in process, as fast as possible.

use std::collections::VecDeque;
use std::io::Write;
use std::sync::Arc;

use super::Session;
use super::audit::{Twin, Windows};
use super::command::{Command, Intake};
use crate::limits::Limits;
use crate::refusal::{Refusal, Result};
use crate::scene::Named;
use crate::scene::record::{Correction, Line, Record, Run, Summary, write_line};
use crate::scene::script::{Action, Script};
use crate::sheet::audit::Finding;
use crate::sheet::{Model, Tissue};

/// The reason why a run ends early.
#[derive(Debug, thiserror::Error)]
pub enum Failure {
    /// The guard has ended the session.
    #[error("the run was stopped: {0}")]
    Held(String),
    /// The input is refused, for the same reasons as a command.
    #[error("{0}")]
    Refused(#[from] Refusal),
    /// The output can't be written.
    #[error("can't write the output: {0}")]
    Output(#[from] std::io::Error),
}

/// The first line of a run.
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

/// The command of a script's action, as a client streams it.
pub fn command(tool: usize, step: u64, action: Action) -> Command {
    Command {
        #[allow(clippy::cast_possible_truncation)]
        tool: tool as u32,
        // At most one command per step, so steps serve as sequence numbers.
        sequence: step + 1,
        client_time_ns: 0,
        at_step: Some(step),
        time_to_live_s: None,
        action,
        arrival_ns: 0,
    }
}

/// Applies the laws of a script to a session that has not begun.
pub fn play(session: &mut Session, script: &Script) {
    for (tool, law) in script.forces.iter().enumerate() {
        session.play_force(tool, law.clone());
    }
    for (index, law) in script.moves.iter().enumerate() {
        session.play_move(script.forces.len() + index, law.clone());
    }
}

/// Changes the tissue to the one due at the coming step.
pub fn change(session: &mut Session, changes: &mut VecDeque<(u64, Arc<Model>)>) {
    while changes.front().is_some_and(|change| change.0 <= session.step_count()) {
        if let Some((_, model)) = changes.pop_front() {
            session.change(&model);
        }
    }
}

/// Plays `script` and writes its records, as JSON Lines, to `output`. `clock_s` returns the time, for the summary;
/// `progress` gets the number of steps done from time to time.
///
/// # Errors
/// Returns an error if the guard stops the run, a command or change is refused, or the output can't be written.
pub fn run(
    model: &Arc<Model>,
    script: &Script,
    held: bool,
    limits: &Limits,
    output: &mut dyn Write,
    clock_s: &dyn Fn() -> f64,
    progress: &mut dyn FnMut(u64),
) -> std::result::Result<Summary, Failure> {
    Playing { model, script, held, limits, twin: None, corrections: Vec::new() }.play(output, clock_s, progress)
}

/// The same, with a twin in f64 with a quarter of the substep beside it: the summary has the differences. With
/// `[stepping] correct`, the run corrects errors above the tolerance as it goes.
///
/// # Errors
/// As for [`run`].
pub fn audited(
    model: &Arc<Model>,
    script: &Script,
    held: bool,
    limits: &Limits,
    output: &mut dyn Write,
    clock_s: &dyn Fn() -> f64,
    progress: &mut dyn FnMut(u64),
) -> std::result::Result<Summary, Failure> {
    let twin = Some(Twin::new(model));
    Playing { model, script, held, limits, twin, corrections: Vec::new() }.play(output, clock_s, progress)
}

/// A script being played.
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
        output: &mut dyn Write,
        clock_s: &dyn Fn() -> f64,
        progress: &mut dyn FnMut(u64),
    ) -> std::result::Result<Summary, Failure> {
        let Playing { model, script, held, limits, .. } = self;
        let mut session = Session::new(model);
        let mut changes = model.course(&script.changes, limits)?;
        // Held forces are commands, through the same intake as in a server; laws are set once.
        let mut intake = held.then(|| intake(model, script, limits)).transpose()?;
        if !held {
            play(&mut session, script);
            self.twin.iter_mut().for_each(|twin| play(twin.session(), script));
        }
        write_line(output, &Line::Run(&header(model, &script.name)))?;
        let mut due = Vec::new();
        let mut written: std::io::Result<()> = Ok(());
        let mut windows = (self.twin.is_some() && model.scene.stepping.correct).then(Windows::default);
        let (mut stepping_s, mut resumed_s) = (0.0, clock_s());
        for step in 0..script.steps {
            if let Some(intake) = &mut intake {
                for (tool, action) in script.actions_at(step) {
                    intake.submit(LEASE, vec![command(tool, step, action)], 0)?;
                }
                intake.take_due(step, 0, &mut due);
            }
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
                    return Err(Failure::Held(reason));
                }
            }
            resumed_s = clock_s();
            session.advance(&mut due, |session| {
                if session.step_count().is_multiple_of(script.sample_every) {
                    stepping_s += clock_s() - resumed_s;
                    if written.is_ok() {
                        let record = session.record(Some(&script.sample_points));
                        self.twin.iter_mut().for_each(|twin| twin.compare(&record));
                        written = write_line(output, &Record { energy_j: Some(session.energy()), ..record });
                    }
                    resumed_s = clock_s();
                }
            });
            std::mem::replace(&mut written, Ok(()))?;
            // A tissue that went back can't be compared with a twin that did not.
            let ended = if self.twin.is_some() { session.fault() } else { session.hold_reason().map(str::to_owned) };
            if let Some(reason) = ended {
                return Err(Failure::Held(reason));
            }
            if step.is_multiple_of(1024) {
                progress(step);
            }
        }
        stepping_s += clock_s() - resumed_s;
        let audited_error = self.twin.as_ref().map(Twin::error);
        let (corrections, recoveries) = (self.corrections, session.recoveries().list());
        let summary = Summary { audited_error, corrections, recoveries, ..summary(session.tissue(), stepping_s) };
        write_line(output, &Line::Summary(&summary))?;
        Ok(summary)
    }

    /// Applies the finding's correction, if it needs one, from now on, and to the script's later changes.
    fn correct(
        &mut self,
        session: &mut Session,
        finding: &Finding,
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

/// Any number will do: there is no other client in the process.
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

/// The last line of a run that ends here.
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
        network: None,
    }
}
