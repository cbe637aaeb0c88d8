//! Changes to the state of a tissue other than a step: inputs of tools, checks of the guard and what follows from them,
//! other models, and recovery.
//!
//! A change of model happens between two steps: springs, anchor springs and damping become those of another model.
//! Displacements and velocities stay. The scheme's kept values belong to the old springs and are rebuilt as if
//! the new springs had always pulled as they do now: a constant force history, so nothing jumps. The energy
//! does jump, because the new springs store another energy. So the guard's account of energy begins anew, and
//! its checkpoint becomes the state just after the change.
//!
//! A recovery follows a blow-up that the guard could not repair.
//! The guard leaves the tissue in the state of its last checkpoint, with the last substep that it tried. A
//! recovery keeps that state, restores the model's own substep and releases all tools. Time does not go back:
//! the tissue continues at the step at which the blow-up was found. Only displacements and velocities are kept;
//! the scheme's history begins anew, as after a change of model. So the result depends on the
//! checkpoint alone.
//!
//! A solid that nothing holds, and that falls asleep inside out, gets its shape at rest: no motion would bring it there.
//!
//! A checkpoint just after a change of tissue or a recovery has passed no check: the fault may be in that very
//! state. Then the tissue continues at rest, which is safe for any tissue.

use std::sync::Arc;

use crate::audit_window::{AuditWindow, Mark, SharedCheckpoint, WindowInputs};
use crate::body::Places;
use crate::body::model::{Model, Plan, displacement_m};
use crate::body::severed::SeveredSpring;
use crate::body::solid::is_inverted;
use crate::body::tables::springs_of;
use crate::interface::{BlowUp, CheckFailure, PointState, Released, Tissue};
use crate::kernel::field::{Field, State};
use crate::kernel::real::Real;
use crate::scene::Precision;
use crate::scene::profile::Motion;
use crate::stage_times::StepStage;
use crate::state::guard::checkpoint::{Checkpoint, Repetition};
use crate::state::guard::survey::{Forces, Survey, Write};
use crate::state::guard::tool_bounds::broken_by_tools;
use crate::state::guard::work_account::{Noise, WorkAccount};
use crate::state::guard::{
    INTERVAL_SUBSTEPS, MAX_HALVINGS, MAX_INPUTS, MAX_PREDICTION_ERROR, NOISE, ROUNDING, broken_point, convert,
    farthest_in_spacings,
};
use crate::state::tissue_state::TissueState;
use crate::tools::applied_force::Applied;
use crate::tools::input::ToolInput;
use crate::tools::prescribed::Prescribed;
use crate::tools::tie::Ties;
use palpate_haptics::TipShape;

/// By which part of what the loads of severed springs have done an energy may rise: just after a cut a scheme's error is a part of little.
const GAPING: f64 = 0.25;

/// The most severed springs whose loads a check of the energy looks at.
const MAX_GAPING: usize = 1024;

impl<T: Real> TissueState<T> {
    /// Does a step and checks it; if a check fails, repeats from the checkpoint with a shorter substep. Returns whether
    /// the step has ended; `may_go_on` is asked during a repetition.
    pub(super) fn guarded_step(&mut self, may_go_on: &mut dyn FnMut() -> bool) -> Result<bool, BlowUp> {
        if let Some(times) = &mut self.stage_times {
            times.begin();
        }
        if self.repetition.is_none() {
            self.do_step();
            if (self.checkpoint.is_some() || !self.is_at_rest())
                && let Err(cause) = self.check()
            {
                self.begin_repetition(cause)?;
            }
        }
        if !self.go_on_repeating(may_go_on)? {
            return Ok(false);
        }
        if self.checkpoint.is_some() && self.is_at_rest() {
            self.forget_checkpoint();
        }
        self.known_volume_change.set(None);
        Ok(true)
    }

    /// Checks the motion after a step. Every step, all numbers must be finite; the full check is periodic, and
    /// takes a checkpoint. Returns the cause if a check fails.
    pub(super) fn check(&mut self) -> Result<(), CheckFailure> {
        let interval = (INTERVAL_SUBSTEPS / u64::from(self.plan.substeps)).max(1);
        let due = self.steps.is_multiple_of(interval) || self.inputs.len() >= MAX_INPUTS;
        let farthest = farthest_in_spacings(&self.model);
        let settled = self.tables.is_settled(farthest);
        let broken = |index: usize| {
            let index = self.tables.severed.copies().map_or(index, |copies| copies.corner_of(index));
            Err(CheckFailure::NotFinite { point: self.model.shape().name(self.model.point_at(index)) })
        };
        let scan = || broken_point(&self.model, &self.tables.layout, &self.state).map_or(Ok(()), broken);
        if !settled {
            scan()?;
        }
        let TissueState { model, tables, state, prescribed, contacts, .. } = &*self;
        if let Some(index) = broken_by_tools(model, &tables.layout, state, prescribed, contacts, farthest) {
            return broken(index);
        }
        if !due {
            return Ok(());
        }
        let (survey, _, energy_j) = self.survey(&self.tiles.region);
        let energy_j = energy_j + self.tiles.asleep_j;
        if !(survey.largest < farthest && energy_j.is_finite()) {
            scan()?;
        }
        if survey.prediction_error > MAX_PREDICTION_ERROR * survey.largest {
            return Err(CheckFailure::Prediction { part: survey.prediction_error / survey.largest });
        }
        let present_j = self.present_work_j(&survey);
        let noise = Noise {
            part: NOISE.max((10.0 * self.model.sleep_tolerance).powi(2)),
            energy_j: ROUNDING * ROUNDING * self.plan.unit_of_work_j(&self.model) + self.gaping_j(),
        };
        self.work.survey(
            energy_j + self.contacts.coupling_j(&self.model, &self.tables.layout, &self.state),
            present_j,
            noise,
            !self.contacts.is_empty(),
        )?;
        self.take_checkpoint();
        Ok(())
    }

    /// Returns by how much an energy may rise while a wound gapes, J: a part of what the loads of severed springs have done. They have a
    /// negative energy, which becomes elastic and kinetic, and the sum stays near 0; errors of the schemes are a part of each, not of the
    /// sum. Of many springs some stand for all.
    #[allow(clippy::cast_precision_loss)]
    fn gaping_j(&self) -> f64 {
        let TissueState { model, tables, state, .. } = self;
        if model.prestrain == 0.0 || tables.severed.joint_count() == 0 {
            return 0.0;
        }
        // Anchor springs have no pretension.
        let springs: Vec<&SeveredSpring> =
            tables.severed.springs().iter().filter(|spring| !spring.is_anchor()).collect();
        let each = springs.len().div_ceil(MAX_GAPING);
        let of = |spring: &&SeveredSpring| {
            let [a, b] = spring.ends.map(|place| {
                let place = place as usize;
                let rest_m = model.shape().rest_m(model.point_at(place));
                (rest_m, displacement_m(model, &tables.layout, state, model.point_of(place)))
            });
            (b.0 - a.0).dot(b.1 - a.1).abs()
        };
        let done_m2: f64 = springs.iter().step_by(each).map(of).sum();
        GAPING * model.prestrain * model.scene.springs.stiffness_n_per_m * each as f64 * done_m2
    }

    /// Returns the part of the work done that belongs to the next interval: half of the work of the last
    /// increment (`scheme::central`), less that of branches, which the next sweep adds, J.
    pub(super) fn present_work_j(&self, survey: &Survey) -> f64 {
        let present = if self.plan.scheme.takes_means() { 0.5 * survey.power - survey.relaxing } else { 0.0 };
        present * self.plan.unit_of_work_j(&self.model)
    }

    /// Stores the present state as the state to go back to.
    pub(super) fn take_checkpoint(&mut self) {
        let TissueState { tables, state, applied, prescribed, contacts, tiles, .. } = self;
        // A checkpoint that an audit still holds stays as it is.
        if self.checkpoint.as_mut().is_some_and(|checkpoint| Arc::get_mut(checkpoint).is_none()) {
            self.checkpoint = None;
        }
        let checkpoint = self.checkpoint.get_or_insert_with(|| {
            // Most of a large tissue has never moved. That part is neither copied nor given memory.
            tiles.touch_all();
            state.part_history(|to, from| tiles.copy_moved(to, from));
            let state = State::zero(&tables.layout, state.kept.len());
            let (applied, prescribed, contacts) = (applied.clone(), prescribed.clone(), contacts.clone());
            let (work, largest) = (WorkAccount::default(), 0.0);
            let (steps, halvings, passed_checks) = (0, 0, true);
            let cuts = tables.severed.cuts().clone();
            Arc::new(Checkpoint {
                steps,
                halvings,
                state,
                applied,
                prescribed,
                contacts,
                work,
                largest,
                passed_checks,
                cuts,
            })
        });
        let Some(checkpoint) = Arc::get_mut(checkpoint) else { return };
        checkpoint.largest = tiles.largest;
        (checkpoint.steps, checkpoint.passed_checks) = (self.steps, true);
        checkpoint.halvings = self.halvings;
        tiles.copy_touched(checkpoint.state.fields_mut().zip(self.state.fields()));
        checkpoint.applied.clone_from(&self.applied);
        checkpoint.prescribed.clone_from(&self.prescribed);
        checkpoint.contacts.clone_from(&self.contacts);
        checkpoint.work = self.work;
        checkpoint.cuts.clone_from(self.tables.severed.cuts());
        self.inputs.clear();
        self.mark();
    }

    /// Frees the checkpoint of a still tissue: nothing can go wrong until a tool gets a command.
    pub(super) fn forget_checkpoint(&mut self) {
        self.checkpoint = None;
        self.audit_window.give_up();
        self.inputs.clear();
        self.state.share_history(self.plan.scheme.history());
    }

    /// Goes back to the checkpoint, with the substep of `halvings`.
    pub(super) fn go_back(&mut self, halvings: u32) {
        // Without a checkpoint there is nothing to go back to.
        let Some(checkpoint) = &self.checkpoint else { return };
        self.audit_window.give_up();
        self.steps = checkpoint.steps;
        // Inputs of a repetition that failed: the next one repeats them.
        self.inputs.clear();
        self.tiles.wake_all();
        self.state.copy_from(&checkpoint.state);
        self.known_volume_change.set(None);
        self.applied.clone_from(&checkpoint.applied);
        self.prescribed.clone_from(&checkpoint.prescribed);
        let mut burns = std::mem::take(&mut self.contacts.burns);
        burns.go_back_to(&checkpoint.contacts.burns);
        self.contacts.clone_from(&checkpoint.contacts);
        self.contacts.burns = burns;
        self.work = checkpoint.work;
        self.tables.set_severed(&self.model, &checkpoint.cuts);
        self.tiles.has_severed_anchors = self.tables.severed.anchor_count() > 0;
        let was = checkpoint.halvings;
        self.halve(was, halvings);
        self.tables.is_settled(0.0);
        self.tables.take_work();
    }

    /// Converts the state from the substep of `was` halvings to that of `halvings`.
    pub(super) fn halve(&mut self, was: u32, halvings: u32) {
        let [was, plan] = [was, halvings].map(|halvings| self.model.plan.divided(&self.model.scene, 1 << halvings));
        self.convert_state(&was, &plan);
        self.tables.springs = springs_of(&self.model, &plan);
        (self.halvings, self.plan) = (halvings, plan);
    }

    /// Converts the state from one plan to another of the same scheme.
    fn convert_state(&mut self, was: &Plan, plan: &Plan) {
        let springs = (&springs_of(&self.model, was), &self.tables.severed);
        let volume_change = self.volume_change();
        convert(&self.tables.layout, springs, [was, plan], &self.applied, volume_change, &mut self.state);
        self.known_volume_change.set(None);
        self.applied.forget();
    }

    pub(super) fn input(&mut self, tool: usize, input: ToolInput) {
        if self.checkpoint.is_none() {
            self.take_checkpoint();
        }
        self.inputs.push((self.steps, tool, input.clone()));
        self.audit_window.input(self.steps, tool, &input);
        self.tell(tool, input);
    }

    pub(super) fn tell(&mut self, tool: usize, input: ToolInput) {
        match input {
            ToolInput::Push(push) => {
                self.prescribed.release(tool);
                self.contacts.release(tool);
                self.applied.set(tool, push);
            }
            ToolInput::Pose(place_m, tip) => {
                self.prescribed.release(tool);
                self.applied.set(tool, None);
                self.contacts.pose(&self.model, tool, place_m, tip);
                if tip.shape == TipShape::Blade {
                    self.prepare_to_cut();
                }
            }
            ToolInput::Tie(tie) => {
                let TissueState { model, tables, state, contacts, .. } = self;
                contacts
                    .tie(model, tool, tie.map(|tie| *tie), |point| displacement_m(model, &tables.layout, state, point));
            }
            ToolInput::Grasp(index, grasp) => {
                self.applied.set(tool, None);
                self.contacts.release(tool);
                self.tiles.wake_under([self.model.point_of(index)]);
                let PointState { displacement_m, velocity_m_per_s, .. } = self.point(self.model.point_at(index));
                let now = Motion { displacement_m, velocity_m_per_s, ..Motion::default() };
                self.prescribed.grasp(tool, index, grasp, now);
            }
        }
    }

    /// Begins to repeat from the checkpoint to the present step with half the substep, after a check failed.
    pub(super) fn begin_repetition(&mut self, cause: CheckFailure) -> Result<(), BlowUp> {
        let (target, inputs) = (self.steps, std::mem::take(&mut self.inputs));
        let mut repetition = Repetition { target, inputs, next_input: 0, halvings: self.halvings };
        self.repeat_shorter(&mut repetition, cause)?;
        self.repetition = Some(repetition);
        Ok(())
    }

    /// Begins again with half the substep; fails if that is the shortest.
    fn repeat_shorter(&mut self, repetition: &mut Repetition, cause: CheckFailure) -> Result<(), BlowUp> {
        if repetition.halvings >= MAX_HALVINGS {
            self.go_back(self.halvings);
            return Err(BlowUp { step: repetition.target, cause });
        }
        repetition.halvings += 1;
        self.go_back(repetition.halvings);
        // A repetition that succeeded for a while has left a later checkpoint.
        repetition.next_input = repetition.inputs.partition_point(|(step, ..)| *step < self.steps);
        Ok(())
    }

    /// Continues a repetition, if there is one, by at least one step and until `may_go_on` returns false. It
    /// ends when the checks pass up to the step at which the failure was found, or fail with the shortest substep. Returns whether it
    /// has ended.
    pub(super) fn go_on_repeating(&mut self, may_go_on: &mut dyn FnMut() -> bool) -> Result<bool, BlowUp> {
        let Some(mut repetition) = self.repetition.take() else { return Ok(true) };
        loop {
            if self.steps == repetition.target {
                self.guard_events += 1;
                return Ok(true);
            }
            let inputs = &repetition.inputs[repetition.next_input..];
            let now = inputs.partition_point(|(step, ..)| *step == self.steps);
            for (_, tool, input) in &inputs[..now] {
                self.input(*tool, input.clone());
            }
            repetition.next_input += now;
            self.ended(StepStage::Guard);
            self.do_step();
            if let Err(cause) = self.check() {
                self.repeat_shorter(&mut repetition, cause)?;
            }
            if self.steps != repetition.target && !may_go_on() {
                self.repetition = Some(repetition);
                return Ok(false);
            }
        }
    }

    /// Continues at step `step` from the state of the checkpoint, in which a blow-up has left the tissue.
    /// Continues at rest if `to_rest` or if that state has passed no check.
    pub(super) fn go_on_after_blow_up(&mut self, step: u64, to_rest: bool) -> Released {
        self.known_volume_change.set(None);
        let at_rest = to_rest || self.checkpoint.as_ref().is_some_and(|checkpoint| !checkpoint.passed_checks);
        let pushing = self.applied.slots.iter().enumerate().filter(|(_, slot)| slot.push.is_some());
        let mut tools: Vec<usize> =
            pushing.map(|(tool, _)| tool).chain(self.prescribed.tools()).chain(self.contacts.tools()).collect();
        tools.sort_unstable();
        tools.dedup();
        if at_rest {
            // Also discards what the end of a force or a grasp would add to the next substep.
            self.state = State::at_rest(&self.tables.layout, self.state.kept.len());
            (self.applied, self.prescribed) = (Applied::new(), Prescribed::new());
            self.contacts = self.contacts.without_tools();
            self.follow_cuts();
        }
        // They may be what the tissue did not bear.
        self.contacts.ties = Ties::default();
        // The largest displacement of the failed attempts must not decide what may sleep.
        if let Some(checkpoint) = &self.checkpoint {
            self.tiles.largest = checkpoint.largest;
        }
        self.begin_anew();
        self.steps = step;
        self.begin_account();
        for tool in &tools {
            self.input(*tool, ToolInput::Push(None));
        }
        self.known_volume_change.set(None);
        Released { tools, at_rest }
    }

    /// Returns whether no point moves and nothing holds the tissue, and yet a solid is inside out somewhere. (Gravity could do that
    /// to a solid at rest.)
    pub(super) fn rests_inverted(&self) -> bool {
        let TissueState { model, tables, state, applied, prescribed, contacts, tiles, .. } = self;
        let is_free = prescribed.is_empty() && contacts.are_free() && applied.is_settled() && !applied.pushes();
        let Places::Solid(places) = &model.places else { return false };
        is_free
            && tiles.region.tiles().is_empty()
            && !model.places.is_pulled()
            && is_inverted(places, tables.severed.copies().map(|copies| &**copies), &tables.layout, &state.u)
    }

    /// Brings a tissue that nothing holds to its shape at rest.
    pub(super) fn return_to_rest_shape(&mut self) {
        self.guard_events += 1;
        self.known_volume_change.set(None);
        self.state = State::at_rest(&self.tables.layout, self.state.kept.len());
        self.begin_anew();
        self.begin_account();
    }

    /// Continues from the present displacements and velocities with the model's own substep and without a history; all tiles are
    /// awake.
    fn begin_anew(&mut self) {
        let model = self.model.clone();
        self.tiles.begin_anew(model.tile_tolerance());
        self.audit_window.give_up();
        self.exchange(&model);
    }

    /// Uses `model`, which has the same points and number format, from the next step on.
    pub(super) fn exchange_model(&mut self, model: &Arc<Model>) {
        self.known_volume_change.set(None);
        self.tiles.begin_anew(model.tile_tolerance());
        self.audit_window.give_up();
        if self.is_same_tissue(model) {
            self.resample(model);
            // A newly allocated field of rounding errors begins at 0.
            let layout = self.tables.layout;
            let kept = self.plan.scheme.kept(model.precision == Precision::Compensated);
            self.state.kept.resize_with(kept, || Arc::new(Field::zero(&layout)));
        } else {
            self.exchange(model);
        }
        self.begin_account();
        self.known_volume_change.set(None);
    }

    /// Begins the guard's account and checkpoint anew, after the state or the springs were exchanged.
    pub(super) fn begin_account(&mut self) {
        self.halvings = 0;
        self.tables.is_settled(0.0);
        self.tables.take_work();
        let (survey, _, energy_j) = self.survey(&self.tiles.region);
        self.work = WorkAccount::begun(
            energy_j + self.contacts.coupling_j(&self.model, &self.tables.layout, &self.state),
            self.present_work_j(&survey),
        );
        self.checkpoint = None;
        self.take_checkpoint();
        if let Some(checkpoint) = self.checkpoint.as_mut().and_then(Arc::get_mut) {
            checkpoint.passed_checks = false;
        }
    }

    /// Returns whether `model` has the same springs, damping and scheme, so that the kept history stays valid.
    fn is_same_tissue(&self, model: &Model) -> bool {
        let tissue = |model: &Model| {
            let scene = &model.scene;
            let springs = scene.springs.clone();
            let coefficients = [scene.anchor_stiffness_n_per_m, scene.damping_n_s_per_m, scene.volume_stiffness_pa];
            (springs, coefficients, model.plan.integrator, scene.added_lumps.clone())
        };
        tissue(&self.model) == tissue(model)
    }

    /// Exchanges the springs or the scheme. Displacements and velocities stay.
    pub(super) fn exchange(&mut self, model: &Arc<Model>) {
        self.write(Write::Seen);
        let ratio = T::of(model.plan.substep_s / self.plan.substep_s);
        self.state.d.iter_mut().for_each(|d| *d = *d * ratio);

        let layout = self.tables.layout;
        let has_other_lumps = self.model.scene.added_lumps != model.scene.added_lumps;
        self.model = model.clone();
        self.plan = model.plan.clone();
        self.tables.springs = springs_of(model, &self.plan);
        if has_other_lumps {
            self.tables.follow_lumps(model);
        }
        let kept = self.plan.scheme.kept(model.precision == Precision::Compensated);
        self.state.kept = State::at_rest(&layout, kept).kept;
        self.applied.forget();
        let spacing_m = model.unit_m;
        // The scheme does not produce the visible motion of a grasped point, so restore it.
        for (index, motion) in self.prescribed.grasped() {
            for c in 0..3 {
                let at = c * layout.plane + layout.offset(index);
                self.state.u[at] = T::of(motion.displacement_m[c] / spacing_m);
                self.state.d[at] = T::of(motion.velocity_m_per_s[c] * self.plan.substep_s / spacing_m);
            }
        }
        self.write(Write::Begin);
    }

    /// Rewrites the whole state.
    pub(super) fn write(&mut self, write: Write) {
        let terms = self.present_terms();
        self.tables.press(&self.state.u, self.tiles.region.tiles());
        let TissueState { plan, tables, state, tiles, .. } = self;
        let forces = Forces { terms: &terms, field: 0, part: 1.0, pull: 0.0 };
        Survey::write(tables, &plan.scheme, state, forces, &tiles.region, write);
    }

    /// Continues with another substep of the same scheme. The springs and the scheme's history stay.
    pub(super) fn resample(&mut self, model: &Arc<Model>) {
        let (was, plan) = (self.plan.clone(), model.plan.clone());
        // The present force as an acceleration; the scheme's own terms may be the mean of both sides of a jump.
        self.applied.terms = self.present_terms();
        self.convert_state(&was, &plan);
        self.model = model.clone();
        self.tables.springs = springs_of(model, &plan);
        self.plan = plan;
    }

    /// Requests a window, which begins at the next checkpoint.
    pub(super) fn begin_window(&mut self, mut inputs: WindowInputs) {
        inputs.0.clear();
        (self.audit_window, self.is_marked) = (AuditWindow::Wanted(inputs), false);
    }

    /// Handles a new checkpoint, at which a window may begin or end.
    pub(super) fn mark(&mut self) {
        self.audit_window = match std::mem::take(&mut self.audit_window) {
            AuditWindow::Wanted(inputs) => {
                self.is_marked = true;
                AuditWindow::Open(self.steps + self.model.window_steps(), inputs)
            }
            // The beginning has not been reported yet, and its checkpoint is gone.
            AuditWindow::Open(_, mut inputs) if self.is_marked => {
                inputs.0.clear();
                AuditWindow::Open(self.steps + self.model.window_steps(), inputs)
            }
            AuditWindow::Open(until, inputs) if self.steps >= until => AuditWindow::Closed(inputs),
            AuditWindow::Closed(_) => AuditWindow::Dropped,
            other => other,
        };
    }

    /// Takes the report on the window, once.
    pub(super) fn report_window(&mut self) -> Option<Mark> {
        let share = |sheet: &Self| {
            let checkpoint = sheet.checkpoint.clone()?;
            Some(SharedCheckpoint { model: sheet.model.clone(), checkpoint })
        };
        match &self.audit_window {
            AuditWindow::Open(..) if std::mem::take(&mut self.is_marked) => share(self).map(Mark::Begin),
            AuditWindow::Closed(_) => {
                let end = share(self);
                let AuditWindow::Closed(inputs) = std::mem::take(&mut self.audit_window) else { return None };
                Some(end.map_or(Mark::Dropped, |end| Mark::End(end, inputs)))
            }
            AuditWindow::Dropped => {
                self.audit_window = AuditWindow::Off;
                Some(Mark::Dropped)
            }
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests;
