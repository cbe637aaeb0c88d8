//! The guard: periodic checks of a tissue's motion, and the checkpoint to go back to.
//!
//! Numbers must be finite; energy must not appear from nowhere; the springs' force must be near its prediction
//! from its history. Every [`INTERVAL_SUBSTEPS`] substeps a survey of the tissue (a sweep, about twice the cost
//! of a substep) checks them: E − E₀ ≤ W + [`MARGIN`]·(E₀ + |W|), with E₀ the energy at the last survey and W
//! the work of all tools since. Damping only removes energy, so the check stays valid. Increments are summed in
//! every substep, so a value that is not finite shows at once.
//!
//! If a check fails, the tissue goes back to the last checkpoint and repeats the tools' inputs since then with
//! half the substep; observers never see time go back. It keeps the shorter substep. After [`MAX_HALVINGS`]
//! halvings the guard gives up, at the checkpoint.

pub(crate) mod checkpoint;
pub(crate) mod recovery;
pub(crate) mod survey;
pub(crate) mod tool_bounds;

use std::sync::Arc;

use super::interface::BlowUp;
use super::model::{Model, Plan};
use crate::body::tables::Elastic;
use crate::body::tables::springs_of;
pub use crate::guard::checkpoint::{CheckFailure, MARGIN};
use crate::guard::checkpoint::{Checkpoint, Input, Noise, Repetition, Work};
use crate::guard::survey::Survey;
use crate::kernel::field::{Field, Layout, State};
use crate::kernel::real::Real;
use crate::memory;
use crate::state::tissue_state::TissueState;
use crate::tools::applied_force::Applied;

/// Number of substeps between two surveys, in which the guard checks the whole tissue and takes a checkpoint. A
/// snapshot's checkpoint is at most as many steps old.
pub const INTERVAL_SUBSTEPS: u64 = 256;

/// Largest error of a predicted displacement, as a fraction of the largest displacement; beyond it the check fails
/// with [`CheckFailure::Prediction`].
pub const MAX_PREDICTION_ERROR: f64 = 0.5;

/// Largest number of times that a substep is halved (to a sixteenth) before the guard gives up and stops the tissue.
pub const MAX_HALVINGS: u32 = 4;

/// Largest number of inputs kept since the last checkpoint. With more, the next checkpoint is taken earlier.
pub(super) const MAX_INPUTS: usize = 1024;

/// A rise of energy below this fraction of the largest so far is rounding noise in a tissue that has come to
/// rest. So is a rise below the square of ten times the error that sleeping tiles may have.
const NOISE: f64 = 1e-10;

/// Largest movement, in spacings, of points under tools that hold fixed points or rest on points at rest. Their
/// distances are differences of numbers of the size of the tissue.
const ROUNDING: f64 = 1e-12;

impl<T: Real> TissueState<T> {
    /// Checks the motion after a step. Every step, all numbers must be finite; the full check is periodic, and
    /// takes a checkpoint. Returns the cause if a check fails.
    pub(super) fn check(&mut self) -> Result<(), CheckFailure> {
        let interval = (INTERVAL_SUBSTEPS / u64::from(self.plan.substeps)).max(1);
        let due = self.steps.is_multiple_of(interval) || self.inputs.len() >= MAX_INPUTS;
        let farthest = farthest_in_spacings(&self.model);
        let settled = self.tables.is_settled(farthest);
        let scan = || match broken_point(&self.model, &self.tables.layout, &self.state) {
            Some(index) => Err(CheckFailure::NotFinite { point: self.model.shape().name(self.model.point_at(index)) }),
            None => Ok(()),
        };
        if !settled {
            scan()?;
        }
        if let Some(index) = self.broken_by_tools(farthest) {
            return Err(CheckFailure::NotFinite { point: self.model.shape().name(self.model.point_at(index)) });
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
            energy_j: ROUNDING * ROUNDING * self.unit_of_work_j(),
        };
        self.work.survey(energy_j + self.coupling_j(), present_j, noise, !self.contacts.is_empty())?;
        self.take_checkpoint();
        Ok(())
    }

    /// Returns the part of the work done that belongs to the next interval: half of the last increment's
    /// (`central`), J.
    pub(super) fn present_work_j(&self, survey: &Survey) -> f64 {
        if self.plan.scheme.takes_means() { 0.5 * survey.power * self.unit_of_work_j() } else { 0.0 }
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
            let (work, largest) = (Work::default(), 0.0);
            let (steps, halvings, passed_checks) = (0, 0, true);
            Arc::new(Checkpoint { steps, halvings, state, applied, prescribed, contacts, work, largest, passed_checks })
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
    fn go_back(&mut self, halvings: u32) {
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
        self.contacts.clone_from(&checkpoint.contacts);
        self.work = checkpoint.work;
        let was = checkpoint.halvings;
        self.halve(was, halvings);
        self.tables.is_settled(0.0);
        self.tables.take_work();
    }

    /// Converts the state from the substep of `was` halvings to that of `halvings`.
    pub(super) fn halve(&mut self, was: u32, halvings: u32) {
        let [was, plan] = [was, halvings].map(|halvings| self.model.plan.divided(&self.model.scene, 1 << halvings));
        let springs = springs_of(&self.model, &was);
        let volume_change = self.volume_change();
        convert(&self.tables.layout, &springs, [&was, &plan], &self.applied, volume_change, &mut self.state);
        self.known_volume_change.set(None);
        self.applied.forget();
        self.tables.springs = springs_of(&self.model, &plan);
        (self.halvings, self.plan) = (halvings, plan);
    }

    pub(super) fn input(&mut self, tool: usize, input: Input) {
        if self.checkpoint.is_none() {
            self.take_checkpoint();
        }
        self.inputs.push((self.steps, tool, input.clone()));
        self.audit_window.input(self.steps, tool, &input);
        self.tell(tool, input);
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
    /// ends when the checks pass up to where it began, or fail with the shortest substep. Returns whether it
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
}

/// Returns the displacement, in spacings, beyond which a motion is a blow-up: far beyond any tissue, and far
/// below the root of the largest f32.
pub(super) fn farthest_in_spacings(model: &Model) -> f64 {
    1e9 * model.shape().longest_side_m() / model.unit_m
}

/// Returns the place of a point whose values are not finite or beyond the bound, if there is one.
pub(super) fn broken_point<T: Real>(model: &Model, layout: &Layout, state: &State<T>) -> Option<usize> {
    let farthest = T::of(farthest_in_spacings(model));
    let is_good = |field: &Field<T>, at: usize| field[at].is_finite() && field[at].magnitude() < farthest;
    (0..model.place_count()).find(|index| {
        let offsets = (0..3).map(|c| c * layout.plane + layout.offset(*index));
        !offsets.into_iter().all(|at| state.fields().all(|field| is_good(field, at)))
    })
}

/// Converts a state from one substep to another. `from` and `to` are plans of the same scheme; `springs` are
/// those of `from`; `volume_change` is the growth of the volume.
pub(super) fn convert<T: Real>(
    layout: &Layout,
    springs: &Elastic<T>,
    [from, to]: [&Plan; 2],
    applied: &Applied<T>,
    volume_change: f64,
    state: &mut State<T>,
) {
    let ratio = to.substep_s / from.substep_s;
    let points = layout.rows * layout.columns;
    // Compute all forces first: points are converted one by one, in place.
    let force =
        |index| springs.gather(layout, &state.u, volume_change, [index / layout.columns, index % layout.columns]);
    let forces: Vec<[T; 3]> = memory::collected((0..points).map(force), "the forces of a tissue");
    for (index, force) in forces.iter().enumerate() {
        let pushed = applied.force_at(layout, 0, [index / layout.columns, index % layout.columns]);
        for (c, n) in force.iter().enumerate() {
            let at = c * layout.plane + layout.offset(index);
            let mut history = state.history(n.wide(), from.scheme.history(), at);
            let now = [state.u[at].wide(), state.d[at].wide()];
            let [u, d] = from.scheme.resample(&to.scheme, ratio, now, pushed[c], &mut history);
            (state.u[at], state.d[at]) = (T::of(u), T::of(d));
            for (field, value) in state.kept.iter_mut().zip(&history[1..]) {
                Arc::make_mut(field)[at] = T::of(*value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use crate::shape::PointName;
    use glam::DVec3;

    use super::*;
    use crate::scene::profile::Poke;
    use crate::scene::{Integrator, Named};
    use crate::scheme::Scheme;
    use crate::shape::PointId;
    use crate::{Push, Tissue};
    use palpate_haptics::{Coupling, Tip};

    /// The names of all schemes.
    fn schemes() -> impl Iterator<Item = &'static str> {
        Integrator::NAMES.iter().map(|entry| entry.0).filter(|name| *name != "auto")
    }

    fn sheet(integrator: &str) -> TissueState<f64> {
        sheet_with(integrator, &[])
    }

    fn sheet_with(integrator: &str, more: &[&str]) -> TissueState<f64> {
        let integrator = format!("stepping.integrator={integrator}");
        let format = ["stepping.substeps=4", "stepping.precision=f64", "sheet.points=[7, 9]", "sleep.tolerance=0.0"];
        let model = Model::paper(&[&[integrator.as_str()], &format[..], more].concat());
        let (scene, mut sheet) = (&model.scene, TissueState::new(&model));
        sheet.push(
            0,
            Some(Push::Constant(Poke {
                point: None,
                centre_m: scene.sheet().unwrap().spacing_m * DVec3::new(3.0, 4.0, 0.0),
                force_n: DVec3::new(0.1, -0.2, -1.0),
                falloff_per_m: 0.7 / scene.sheet().unwrap().spacing_m,
                falloff_offset: 0.0,
            })),
        );
        (0..40).for_each(|_| sheet.step().unwrap());
        sheet
    }

    /// Largest difference of displacements and of velocities, each as a fraction of the largest.
    fn apart(a: &TissueState<f64>, b: &TissueState<f64>) -> [f64; 2] {
        let (mut most, mut largest) = ([0.0_f64; 2], [0.0_f64; 2]);
        for index in 0..a.model.len() {
            let [p, q] = [a, b].map(|sheet| sheet.point(PointId::new(index)));
            let pairs = [(p.displacement_m, q.displacement_m), (p.velocity_m_per_s, q.velocity_m_per_s)];
            for (which, (p, q)) in pairs.into_iter().enumerate() {
                most[which] = most[which].max(p.distance(q));
                largest[which] = largest[which].max(p.length());
            }
        }
        [most[0] / largest[0], most[1] / largest[1]]
    }

    #[test]
    fn half_the_substep_shows_the_same_state_and_goes_on_the_same_way() {
        for integrator in schemes() {
            // A history is interpolated; what has none continues as it is, but for the scheme's own error.
            let within = match integrator {
                "rk4" => 1e-7,
                "exponential3" => 1e-4,
                "exponential4" => 1e-5,
                _ => 1e-3,
            };
            let (mut as_it_was, mut halved) = (sheet(integrator), sheet(integrator));
            halved.halve(0, 1);
            let now = apart(&as_it_was, &halved);
            assert!(now[0] < 1e-9 && now[1] < within, "{integrator}: {now:?}");
            (0..40).for_each(|_| [&mut as_it_was, &mut halved].into_iter().for_each(|sheet| sheet.step().unwrap()));
            let later = apart(&as_it_was, &halved);
            assert!(later.iter().all(|part| *part < within), "{integrator}, later: {later:?}");
            assert!(halved.guard_events() == 0 && as_it_was.guard_events() == 0);
        }
    }

    #[test]
    fn central_differences_show_the_same_velocity_with_half_the_substep_to_the_last_digits() {
        let (as_it_was, mut halved) = (sheet("central"), sheet("central"));
        halved.halve(0, 1);
        let now = apart(&as_it_was, &halved);
        assert!(now.iter().all(|part| *part < 1e-9), "{now:?}");
    }

    #[test]
    fn grasps_that_hold_still_beside_each_other_do_nothing() {
        for integrator in schemes() {
            let model = Model::paper(&[&format!("stepping.integrator={integrator}"), "stepping.substeps=7"]);
            let mut sheet = crate::at_rest(&model);
            let tip = Tip { radius_m: 0.005, friction: 0.2, grasps: true, coupling: Coupling::Constraint };
            for tool in 0..16 {
                let (y_m, x_m) = (0.1 * f64::from(tool)).sin_cos();
                sheet.pose(tool as usize, DVec3::new(0.07 + 0.01 * x_m, 0.07 + 0.01 * y_m, -0.004), tip);
            }
            (0..400).for_each(|step| assert!(sheet.step().is_ok(), "{integrator}, {step}"));
            assert_eq!(sheet.guard_events(), 0, "{integrator}");
            let energy = sheet.energy();
            let energy_j = energy.kinetic_j + energy.spring_j + energy.anchor_j;
            assert!(energy_j < 1e-27, "{integrator}: {energy_j} J");
        }
    }

    #[test]
    fn what_the_tools_do_is_what_the_sheet_has() {
        // Without damping `lagged` is `central`.
        for integrator in schemes() {
            let undamped = ["damping.coefficient_n_s_per_m=0.0"];
            let mut sheet = sheet_with(integrator, &undamped);
            let (survey, energy, energy_j) = sheet.survey(&sheet.tiles.region);
            let work_j = sheet.work.done_j - sheet.present_work_j(&survey);
            assert!((work_j - energy_j).abs() < 0.02 * energy_j, "{integrator}: {work_j} J, {energy_j} J");
            let mass_kg = sheet.model.scene.sheet().unwrap().point_mass_kg;
            let points = (0..sheet.model.len()).map(|index| sheet.point(PointId::new(index)));
            let kinetic_j: f64 = points.map(|point| 0.5 * mass_kg * point.velocity_m_per_s.length_squared()).sum();
            assert!((energy.kinetic_j - kinetic_j).abs() < 1e-9 * kinetic_j, "{integrator}: {energy:?} {kinetic_j}");
            // And continues like this.
            (0..20).for_each(|_| sheet.step().unwrap());
            assert_eq!(sheet.guard_events(), 0);
        }
    }

    #[test]
    fn a_repetition_that_stops_at_each_step_fails_and_mends_as_one_that_does_not() {
        let sets = ["stepping.substeps=1", "springs.stiffness_n_per_m=100000"];
        let model = Model::paper(&[&["sheet.points=[9, 9]", "stepping.integrator=central"][..], &sets].concat());
        let (mut whole, mut parts) = (TissueState::<f32>::new(&model), TissueState::<f32>::new(&model));
        let mut stops = 0;
        for step in 0..300 {
            let place_m = DVec3::new(0.13, 0.13, 0.01 - 1e-3 * f64::from(step));
            for sheet in [&mut whole, &mut parts] {
                sheet.pose(0, place_m, Tip { radius_m: 0.03, ..Default::default() });
            }
            let done = whole.step();
            let done_in_parts = loop {
                match parts.step_while(&mut || false) {
                    Ok(false) => stops += 1,
                    done => break done.map(drop),
                }
            };
            assert_eq!(done, done_in_parts, "{step}");
            assert_eq!((whole.steps, whole.guard_events), (parts.steps, parts.guard_events), "{step}");
            assert_eq!(whole.state_hash(), parts.state_hash(), "{step}");
            if let Err(blow_up) = done {
                [&mut whole, &mut parts].into_iter().for_each(|sheet| drop(sheet.recover(blow_up.step, false)));
            }
        }
        assert!(stops > 20 && whole.guard_events > 0, "{stops} stops, {} events", whole.guard_events);
    }

    #[test]
    fn a_repetition_that_fails_leaves_no_inputs_behind() {
        // Three halvings are needed: the first repetitions fail as well.
        let sets = ["stepping.substeps=1", "springs.stiffness_n_per_m=100000"];
        let model = Model::paper(&[&["sheet.points=[9, 9]", "stepping.integrator=central"][..], &sets].concat());
        let mut sheet = TissueState::<f32>::new(&model);
        let place_m = |step: u32| DVec3::new(0.13, 0.13, 0.01 - 1e-3 * f64::from(step));
        let mut mended = 0;
        for step in 0..120 {
            sheet.pose(0, place_m(step), palpate_haptics::Tip { radius_m: 0.03, ..Default::default() });
            sheet.step().unwrap();
            let from = sheet.checkpoint.as_ref().unwrap().steps;
            let inputs: Vec<u64> = sheet.inputs.iter().map(|input| input.0).collect();
            assert_eq!(inputs, (from..sheet.steps).collect::<Vec<_>>(), "step {step}");
            mended = mended.max(sheet.halvings);
        }
        assert!(mended >= 3, "{mended} halvings");
    }

    #[test]
    fn a_checkpoint_is_taken_every_256_substeps() {
        let mut sheet = sheet("exponential2");
        (40..130).for_each(|_| sheet.step().unwrap());
        assert_eq!(sheet.checkpoint.as_ref().unwrap().steps, 128);
    }

    #[test]
    fn a_point_that_is_not_finite_or_beyond_the_bound_is_named() {
        for broken in [f64::NAN, f64::INFINITY, 2.0 * farthest_in_spacings(&sheet("central").model)] {
            let mut sheet = sheet("central");
            let layout = sheet.tables.layout;
            assert_eq!(broken_point(&sheet.model, &layout, &sheet.state), None);
            let index = sheet.model.index_of([2, 5]);
            sheet.state.u[layout.plane + layout.offset(index)] = broken;
            assert_eq!(broken_point(&sheet.model, &layout, &sheet.state), Some(index));
            // A survey is due at step 64.
            sheet.steps = 64;
            assert_eq!(sheet.check(), Err(CheckFailure::NotFinite { point: PointName::Point([2, 5]) }), "{broken}");
        }
    }

    #[test]
    fn increments_that_are_finite_and_below_the_bound_are_calm() {
        let farthest = farthest_in_spacings(&sheet("central").model);
        for (increment, settled) in [(1e-3, true), (0.1 * farthest, true), (10.0 * farthest, false), (f64::NAN, false)]
        {
            let mut sheet = sheet_with("central", &["springs.stiffness_n_per_m=0.0"]);
            let offset = sheet.tables.layout.offset(11);
            sheet.tables.is_settled(0.0);
            sheet.state.d[offset] = increment;
            sheet.do_step();
            assert_eq!(sheet.tables.is_settled(farthest), settled, "{increment}");
        }
    }

    #[test]
    fn a_force_far_from_what_its_history_foretold_is_found() {
        for integrator in schemes().filter(|name| name.starts_with("exponential")) {
            let mut sheet = sheet(integrator);
            sheet.steps = 64;
            let weight = match &sheet.plan.scheme {
                Scheme::Exponential2(multistep) => multistep.correction[0] * multistep.extrapolation[0],
                Scheme::Exponential3(multistep) => multistep.correction[0] * multistep.extrapolation[0],
                Scheme::Exponential4(multistep) => multistep.correction[0] * multistep.extrapolation[0],
                _ => panic!("{integrator} is a multistep scheme"),
            };
            // A force of the past that moves the point by 5 spacings.
            let past = 5.0 / weight;
            let offset = sheet.tables.layout.offset(31);
            Arc::make_mut(&mut sheet.state.kept[0])[offset] += past;
            assert!(matches!(sheet.check(), Err(CheckFailure::Prediction { .. })), "{integrator}");
        }
    }
}
