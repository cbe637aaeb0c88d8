//! A session without a server. Its inputs come from a script, from the caller or from a journal, and the caller
//! decides how far it advances.

use std::collections::VecDeque;
use std::sync::Arc;

use super::Session;
use super::command::{Command, Due};
use super::input::Input;
use super::intake::Intake;
use super::lease::LeaseId;
use palpate_refusal::{Refusal, Result};
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::Scene;
use palpate_tissue::scene::record::Correction;
use palpate_tissue::scene::script::{Action, Script};
use palpate_tissue::select::audit::AuditFinding;

/// Reason why a simulation or a run ends early. Its `Display` is a message for people.
#[derive(Debug, thiserror::Error)]
pub enum SimulationFailure {
    /// The session has stopped for good, its tissue went back to an earlier state, or an audit's twin did one of
    /// these. Contains the reason, for people.
    #[error("the run was stopped: {0}")]
    Held(String),
    /// A command, a change of the tissue or a correction was refused. Contains the refusal.
    #[error("{0}")]
    Refused(#[from] Refusal),
    /// The output could not be written, or the caller's function that receives events failed.
    #[error("can't write the output: {0}")]
    Output(#[from] std::io::Error),
}

/// A session with its queue of inputs, which the caller steps without a server. Its tools are held by one lease of
/// its own, which never expires while times are 0.
pub struct Simulation {
    /// The tissue and its tools. If you advance it directly, inputs that wait for that step act later.
    pub session: Session,
    /// Queue of the commands, with the leases of tools.
    pub intake: Intake,
    /// The commands that act at the coming step.
    pub(crate) due: Vec<Due>,
    /// Other tissues, each with the step from which it is simulated, by ascending step.
    pub(crate) changes: VecDeque<(u64, Arc<Model>)>,
    /// The script, and whether its forces and moves are played as commands that a client streams.
    script: Option<(Script, bool)>,
}

/// The lease of all tools of [`Simulation::command`].
const LEASE: LeaseId = 1;

impl Simulation {
    /// Creates a simulation of a tissue at rest, at step 0, without a script. Commands must keep to `limits`.
    pub fn new(model: &Arc<Model>, limits: &Limits) -> Self {
        Simulation::of(Session::new(model), &model.scene, limits)
    }

    /// Creates a simulation that continues `session` at its present step. `first` is the scene with which the session
    /// began; commands must keep to `limits`. Tools that are led by poses stay in the tissue with their tips.
    pub fn of(session: Session, first: &Scene, limits: &Limits) -> Self {
        let intake = Intake::new(first, limits).continued(&session, None);
        Simulation { session, intake, due: Vec::new(), changes: VecDeque::new(), script: None }
    }

    /// Creates a simulation at step 0 that plays `script`. Without `held`, its forces and moves are continuous
    /// profiles that are set once; with `held`, they are commands at each step, as a client streams them. Poses are
    /// commands in both cases. [`Simulation::take_inputs`] issues the commands.
    ///
    /// # Errors
    /// Refuses a change of the tissue in the script that the scene or `limits` do not allow
    /// ([`Model::apply_changes`]).
    pub fn playing(model: &Arc<Model>, script: &Script, held: bool, limits: &Limits) -> Result<Self> {
        let changes = model.apply_changes(&model.scene, &script.changes, limits)?;
        let mut simulation = Simulation { changes, ..Simulation::new(model, limits) };
        if !held {
            simulation.session.play_script(script);
        }
        simulation.script = Some((script.clone(), held));
        Ok(simulation)
    }

    /// Queues an action of a tool for the coming step. Acquires the tool first if it is free, under the simulation's
    /// own lease, for `limits.lease_s`.
    ///
    /// # Errors
    /// Refuses a tool number that is not below `limits.tools`, a tool that another lease holds, an action that breaks
    /// a rule ([`Rules::check_one`](super::rules::Rules::check_one)), another tip than that of the tool in the
    /// tissue, tips with too much work, and more commands of one tool than may wait.
    pub fn command(&mut self, tool: u32, action: Action) -> Result<()> {
        if self.intake.leases.get(tool).is_none() {
            let lease_s = self.intake.rules().limits.lease_s;
            self.intake.acquire(&[tool], "simulation", lease_s, LEASE, 0)?;
        }
        let command = Command { at_step: Some(self.session.step_count()), ..Command::new(tool, None, action) };
        self.intake.submit(LEASE, [command], 0)
    }

    /// Applies an input from a journal. Commands act at the coming step without being checked, and another tissue
    /// acts there too. [`Input::Hold`] and [`Input::Revive`] act at once: the latter replaces the session by one at
    /// rest at the same step, and drops what was due. Inputs that only start, pause or skip time do nothing.
    pub fn apply(&mut self, input: Input) {
        let step = self.session.step_count();
        match input {
            Input::Command(due) => self.due.push(due),
            Input::Tissue(model) => {
                self.take_change();
                self.changes.push_front((step, model));
            }
            Input::Hold(reason) => self.session.hold(reason),
            Input::Revive => {
                self.session = Session::new(self.session.model());
                self.session.skip_to(step);
                self.due.clear();
            }
            Input::Start { .. }
            | Input::Pause
            | Input::DroppedSteps(_)
            | Input::ExerciseEnded(_)
            | Input::PhaseEnded(_) => {}
        }
    }

    /// Corrects the tissue as a finding of an audit needs it, from the coming step on, and also in the script's later
    /// changes. It may run rehearsals, which take time. Returns the correction; `None`, without a change, if the
    /// error is within the tolerance or nothing more accurate exists.
    ///
    /// # Errors
    /// Returns the refusals of [`Model::corrected`] and [`Model::apply_changes`]. If the latter refuses, the session
    /// already has its new tissue.
    pub fn correct(&mut self, finding: &AuditFinding) -> Result<Option<Correction>> {
        let (rules, step) = (self.intake.rules(), self.session.step_count());
        let Some(correction) = self.session.model().correction(finding, step, &rules.limits) else { return Ok(None) };
        let corrected = self.session.model().corrected(&correction, &rules.limits)?;
        self.session.change(&corrected);
        if let Some((script, _)) = &self.script {
            let later = &script.changes[script.changes.partition_point(|change| change.0 < step)..];
            self.changes = corrected.apply_changes(&rules.scene, later, &rules.limits)?;
        }
        Ok(Some(correction))
    }

    /// Begins a step: queues the script's commands for it, changes the tissue to the last one that is due, if any,
    /// and moves the commands that act at the coming step out of the queue. Ends the leases that have expired at
    /// `now_ns`, ns of the caller's clock; with 0 no lease expires. [`Simulation::step`] calls it.
    ///
    /// # Errors
    /// Refuses a command of the script, for the reasons of [`Simulation::command`].
    pub fn take_inputs(&mut self, now_ns: u64) -> Result<()> {
        let step = self.session.step_count();
        if let Some((script, held)) = &self.script {
            let actions: Vec<_> =
                if *held { script.actions_at(step).collect() } else { script.poses_at(step).collect() };
            for (tool, action) in actions {
                #[allow(clippy::cast_possible_truncation)]
                self.command(tool as u32, action)?;
            }
        }
        if let Some(model) = self.take_change() {
            self.session.change(&model);
        }
        self.intake.take_due(step, now_ns, &mut self.due);
        Ok(())
    }

    /// Removes all tissues that are due, and returns the last of them.
    fn take_change(&mut self) -> Option<Arc<Model>> {
        let due = self.changes.partition_point(|change| change.0 <= self.session.step_count());
        self.changes.drain(..due).next_back().map(|change| change.1)
    }

    /// Advances one step, with the inputs that act at its beginning. Leases that have expired at `now_ns`, ns, end;
    /// with 0 none expires. A session that has stopped does not advance, and this is no error
    /// ([`Session::hold_reason`]).
    ///
    /// # Errors
    /// Returns the refusals of [`Simulation::take_inputs`].
    pub fn step(&mut self, now_ns: u64) -> Result<()> {
        self.take_inputs(now_ns)?;
        self.session.advance(&mut self.due, |_| {});
        Ok(())
    }

    /// Advances until `step` steps are done. Does nothing if they are done already.
    ///
    /// # Errors
    /// - [`SimulationFailure::Held`]: the session has stopped for good or there was a recovery, at any time so far,
    ///   so that the tissue is not the result of its inputs ([`Session::fault`]). It ends at the first step after
    ///   which this is so.
    /// - [`SimulationFailure::Refused`]: a command of the script is refused ([`Simulation::take_inputs`]).
    pub fn run_to(&mut self, step: u64) -> std::result::Result<(), SimulationFailure> {
        while self.session.step_count() < step {
            self.step(0)?;
            if let Some(reason) = self.session.fault() {
                return Err(SimulationFailure::Held(reason));
            }
        }
        Ok(())
    }
}

impl Session {
    /// Sets the forces and moves of a script in a session that has not begun, as continuous profiles: the forces are
    /// tools 0, 1, …, and the moves follow them. Poses are not set; they are commands.
    pub fn play_script(&mut self, script: &Script) {
        for (tool, profile) in script.forces.iter().enumerate() {
            self.play_force(tool, profile.clone());
        }
        for (index, profile) in script.moves.iter().enumerate() {
            self.play_move(script.forces.len() + index, profile.clone());
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use glam::DVec3;
    use palpate_tissue::scene::Change;

    use super::*;

    #[test]
    fn of_several_tissues_for_a_step_the_last_is_simulated_from_it_on_and_a_revived_one_is_at_rest() {
        let limits = Limits::default();
        let model = Model::parse("paper", palpate_tissue::scene::PAPER, &["sheet.points=[7, 7]"]).unwrap();
        let mut simulation = Simulation::new(&model, &limits);
        let point = model.scene.sheet().unwrap().point([3, 3]);
        simulation.command(0, Action::Grasp { point, displacement_m: DVec3::new(0.0, 0.0, -0.001) }).unwrap();
        simulation.run_to(5).unwrap();
        for stiffness in [40.0, 50.0] {
            let change = Change { stiffness_n_per_m: Some(stiffness), ..Change::default() };
            let changed = model.changed(&change, &model.scene, &limits).unwrap();
            simulation.apply(Input::Tissue(changed));
        }
        assert!(Arc::ptr_eq(simulation.session.model(), &model));
        simulation.run_to(6).unwrap();
        assert_eq!(simulation.session.model().scene.springs.stiffness_n_per_m, 50.0);
        assert!((simulation.session.tissue().point(point).displacement_m.z + 0.001).abs() < 1e-9);
        simulation.apply(Input::Hold("the disk is full".to_owned()));
        assert!(matches!(simulation.run_to(7), Err(SimulationFailure::Held(_))));
        simulation.apply(Input::Revive);
        assert_eq!((simulation.session.step_count(), simulation.session.fault()), (6, None));
        assert_eq!(simulation.session.tissue().largest_displacement_m(), 0.0);
    }
}
