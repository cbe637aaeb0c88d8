//! The step of a tissue: a list of stages. What a stage computes is in the module that it calls.

use crate::kernel::real::Real;
use crate::scene::Precision;
use crate::scene::profile::Moment;
use crate::scheme::each;
use crate::scheme::family::Family;
use crate::stage_times::StepStage;
use crate::state::sleep::criterion::{put_to_sleep, wake_moved, wake_pressed, wake_pushed};
use crate::state::sleep::tiles::CHECK_STEPS;
use crate::state::step_context::StepContext;
use crate::state::tissue_state::TissueState;
use crate::tools::contact::Contacts;
use crate::tools::prescribed::Prescribed;

/// A substep: from a moment of a step to the fraction `end` of the same step.
#[derive(Debug, Clone, Copy)]
struct Substep {
    from: Moment,
    end: f64,
    /// The movement that wakes a tile, spacings.
    far: f64,
}

impl<T: Real> TissueState<T> {
    /// Advances by one step, which the guard has not checked yet.
    pub(super) fn do_step(&mut self) {
        if self.is_at_rest() {
            return self.pass_steps(1);
        }
        self.begin_step();
        for number in 0..self.plan.substeps {
            let substep = self.begin_substep(number);
            self.wake(substep);
            self.apply_pressure(substep);
            self.apply_forces(substep);
            self.sweep(substep);
            self.hold(substep);
            self.touch(substep);
            self.tie(substep, self.plan.substeps - 1 - number);
        }
        self.cut();
        self.end_step();
        self.sleep();
    }

    fn begin_step(&mut self) {
        self.known_volume_change.set(None);
        self.substeps_done += u64::from(self.plan.substeps);
        wake_pushed(&mut self.tiles, &self.model, &mut self.applied, self.steps);
    }

    fn begin_substep(&self, number: u32) -> Substep {
        let fraction = |number: u32| f64::from(number) / f64::from(self.plan.substeps);
        let from = Moment { step: self.steps, fraction: fraction(number) };
        Substep { from, end: fraction(number + 1), far: self.tiles.wake_threshold(&self.model.scene) }
    }

    /// Wakes tiles beside moving points, and around grasped points that will move.
    fn wake(&mut self, Substep { from, end, far }: Substep) {
        // Copies of corners are far in memory from the cubes that they join: a solid with cuts is awake as a whole.
        if self.tables.severed.copies().is_some() && !self.tiles.region.tiles().is_empty() {
            self.tiles.wake_all();
        }
        self.tiles.wake_beside_moved([&self.state.u, &self.state.d], self.plan.scheme.sweeps(), far);
        if !self.prescribed.is_empty() {
            // A grasp may move its point by less than that in a sleeping tile.
            self.tiles.compare_all();
        }
        let (mut context, prescribed, _) = self.parts();
        wake_moved(&mut context, prescribed, from.step, end, far);
        self.ended(StepStage::Sleep);
    }

    /// Computes the pressure of an enclosed volume, and wakes the tiles that it moves.
    fn apply_pressure(&mut self, Substep { far, .. }: Substep) {
        if self.tables.pressure.is_some() {
            let volume_change = self.tables.press(&self.state.u, self.tiles.region.tiles());
            wake_pressed(&mut self.tiles, &self.model, volume_change, far);
            self.ended(StepStage::Pressure);
        }
        self.points_done += self.tiles.awake_points as u64;
    }

    /// Evaluates the forces of force-controlled tools.
    fn apply_forces(&mut self, Substep { from, end, .. }: Substep) {
        let TissueState { model, plan, tables, applied, .. } = self;
        applied.prepare(model, plan, &tables.layout, from, end - from.fraction);
        self.ended(StepStage::Force);
    }

    /// Lets released points go, sums the springs, and advances the points.
    fn sweep(&mut self, Substep { from, end, .. }: Substep) {
        let (context, prescribed, _) = self.parts();
        let freed = prescribed.take_freed(&context, from);
        // A scheme that takes means adds the change to the substep's increment; other schemes add it to the
        // initial state.
        let takes_means = self.plan.scheme.takes_means();
        if !takes_means {
            freed.iter().for_each(|freed| freed.let_go(&mut self.parts().0));
        }
        for sweep in 0..self.plan.scheme.sweeps() {
            if self.tables.pressure.is_some() && (sweep > 0 || !freed.is_empty()) {
                self.tables.press(&self.state.u, self.tiles.region.tiles());
            }
            self.sweep_once(sweep);
            if let Some(far) = self.plan.scheme.fraction_after(sweep) {
                let fraction = from.fraction + far * (end - from.fraction);
                let (mut context, prescribed, _) = self.parts();
                prescribed.hold(&mut context, from.step, fraction, false);
            }
        }
        let history = self.plan.scheme.history();
        if history > 0 {
            // The newest force takes the place of the oldest.
            self.state.kept[..history].rotate_right(1);
        }
        if takes_means {
            freed.iter().for_each(|freed| freed.let_go(&mut self.parts().0));
        }
        self.work.add(self.tables.take_work() * self.plan.unit_of_work_j(&self.model));
        self.ended(StepStage::Sweep);
    }

    /// Runs sweep number `sweep` of a substep.
    fn sweep_once(&mut self, sweep: usize) {
        let TissueState { model, plan, tables, state, applied, tiles, .. } = self;
        let (field, terms, region) = (plan.scheme.field(sweep), &applied.terms, &tiles.region);
        // Separate calls, so that the compiler leaves out what a format does not need.
        #[allow(clippy::collapsible_if)]
        if const { T::COMPENSATES } {
            if model.precision == Precision::Compensated {
                return each!(&plan.scheme, |family| {
                    tables.advance(&family.compensated::<T>(sweep), state, terms, field, region);
                });
            }
        }
        each!(&plan.scheme, |family| tables.advance(&family.plain::<T>(sweep), state, terms, field, region));
    }

    /// Moves grasped points to where their tools are.
    fn hold(&mut self, Substep { from, end, .. }: Substep) {
        let (mut context, prescribed, _) = self.parts();
        prescribed.hold(&mut context, from.step, end, true);
        self.ended(StepStage::Grasp);
    }

    /// Lets position-controlled tools act (`tools::position_control`), each by the contact that `tools::contact` solves.
    fn touch(&mut self, substep: Substep) {
        let (mut context, _, contacts) = self.parts();
        contacts.act(&mut context, substep.end, substep.far);
        self.ended(StepStage::Contact);
    }

    /// Lets threads and clips pull at the end of a substep that is followed by `more` in this step (`tools::tie`).
    fn tie(&mut self, substep: Substep, more: u32) {
        if !self.contacts.ties.is_empty() {
            let (mut context, _, contacts) = self.parts();
            contacts.ties.act(&mut context, more, substep.far);
            self.ended(StepStage::Contact);
        }
    }

    fn end_step(&mut self) {
        self.applied.finish(&self.model, self.steps);
        self.prescribed.finish(&self.model, self.steps);
        self.contacts.finish(self.model.scene.stepping.rate_hz);
        self.contacts.ties.finish(self.plan.substeps);
        self.steps += 1;
    }

    /// Puts calm tiles to sleep, at some steps.
    fn sleep(&mut self) {
        let is_due = self.steps.is_multiple_of(CHECK_STEPS) && self.tiles.may_sleep();
        if is_due && !self.tiles.region.tiles().is_empty() {
            let volume_change = self.tables.press(&self.state.u, self.tiles.region.tiles());
            let (mut context, prescribed, contacts) = self.parts();
            put_to_sleep(&mut context, prescribed, contacts, volume_change);
            if self.rests_inverted() {
                self.return_to_rest_shape();
            }
        }
        self.ended(StepStage::Sleep);
    }

    /// Returns the parts with which a stage works, and the grasped points and tips beside them.
    fn parts(&mut self) -> (StepContext<'_, T>, &mut Prescribed, &mut Contacts) {
        let TissueState { model, plan, tables, state, applied, tiles, work, prescribed, contacts, .. } = self;
        (StepContext { model, plan, tables, state, applied, tiles, work }, prescribed, contacts)
    }

    /// Ends a stage, if stages are timed.
    pub(super) fn ended(&mut self, stage: StepStage) {
        if let Some(times) = &mut self.stage_times {
            times.end(stage);
        }
    }
}

#[cfg(test)]
mod sleep_tests;
#[cfg(test)]
mod tip_tests;
