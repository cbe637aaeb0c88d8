//! A tissue in motion: its state, the step that advances it, and what can be read from it.

use std::cell::Cell;
use std::ops::Range;
use std::sync::Arc;

use glam::DVec3;
use xxhash_rust::xxh3::Xxh3;

use crate::body::tables::{SweepTables, springs_of};
use crate::guard::checkpoint::{Checkpoint, Input, Repetition, Work};
use crate::interface::{BlowUp, Energy, PointState, ReadCopy, Released, Tissue};
use crate::kernel::field::{BLOCK, Layout, State};
use crate::kernel::lanes::Scalar;
use crate::kernel::real::Real;
use crate::model::{Model, Plan};
use crate::scene::Precision;
use crate::scene::profile::{Moment, Motion, Poke};
use crate::scheme::arithmetic::MAX_KEPT;
use crate::scheme::each;
use crate::scheme::family::{Family, Release};
use crate::scheme::observer::Observer;
use crate::select::audit_window::{AuditWindow, Mark, WindowInputs};
use crate::shape::PointId;
use crate::sleep::tiles::{CHECK_STEPS, SleepTiles};
use crate::state::saved::SavedTissue;
use crate::tools::applied_force::{Applied, Push};
use crate::tools::contact::{Contacts, TangentInput, ToolContact};
use crate::tools::prescribed::{Grasp, Prescribed};
use palpate_haptics::Tip;

/// Creates a tissue at rest, at step 0 and without tools, in the number format of the model: f64 for
/// [`Precision::F64`], otherwise f32. Unwinds with a refusal if there is no memory for its state
/// ([`attempt`](crate::memory::attempt)).
pub fn at_rest(model: &Arc<Model>) -> Box<dyn Tissue> {
    match model.precision {
        Precision::F64 => Box::new(TissueState::<f64>::new(model)),
        Precision::Auto | Precision::F32 | Precision::Compensated => Box::new(TissueState::<f32>::new(model)),
    }
}

#[derive(Debug)]
pub(crate) struct TissueState<T: Real> {
    pub(crate) model: Arc<Model>,
    /// The model's plan, or one with a shorter substep.
    pub(crate) plan: Plan,
    pub(crate) halvings: u32,
    pub(crate) tables: SweepTables<T>,
    pub(crate) state: State<T>,
    pub(crate) applied: Applied<T>,
    pub(crate) prescribed: Prescribed,
    pub(crate) contacts: Contacts,
    pub(crate) steps: u64,
    pub(crate) work: Work,
    /// `None` means the present state. A tissue at rest needs no copy.
    pub(crate) checkpoint: Option<Arc<Checkpoint<T>>>,
    /// The inputs of the tools since the checkpoint: step they precede, tool, input.
    pub(crate) inputs: Vec<(u64, usize, Input)>,
    /// A repetition by the guard; until it ends, the present step is unfinished.
    pub(crate) repetition: Option<Repetition>,
    pub(crate) audit_window: AuditWindow,
    /// Whether the beginning of the window is still to be reported.
    pub(crate) is_marked: bool,
    pub(crate) tiles: SleepTiles<T>,
    pub(crate) guard_events: u64,
    pub(crate) substeps_done: u64,
    /// Points computed, summed over all substeps.
    pub(crate) points_done: u64,
    /// By how much a volume has grown, if it was computed since the last change of the state.
    pub(crate) known_volume_change: Cell<Option<f64>>,
}

impl<T: Real> TissueState<T> {
    pub(crate) fn new(model: &Arc<Model>) -> Self {
        let layout = Layout::new::<T>(model.points);
        let plan = model.plan.clone();
        TissueState {
            model: model.clone(),
            halvings: 0,
            tables: SweepTables::new(model, layout, springs_of(model, &plan)),
            state: State::at_rest(&layout, plan.scheme.kept(model.precision == Precision::Compensated)),
            steps: 0,
            work: Work::default(),
            checkpoint: None,
            applied: Applied::new(),
            prescribed: Prescribed::new(),
            contacts: Contacts::default(),
            inputs: Vec::new(),
            repetition: None,
            audit_window: AuditWindow::Off,
            is_marked: false,
            tiles: SleepTiles::new(layout, model),
            guard_events: 0,
            substeps_done: 0,
            points_done: 0,
            known_volume_change: Cell::new(None),
            plan,
        }
    }

    pub(crate) fn do_step(&mut self) {
        if self.is_still() {
            return self.skip_steps(1);
        }
        self.known_volume_change.set(None);
        let substeps = self.plan.substeps;
        self.substeps_done += u64::from(substeps);
        self.wake_what_is_pushed();
        let fraction = |substep: u32| f64::from(substep) / f64::from(substeps);
        for substep in 0..substeps {
            self.substep(Moment { step: self.steps, fraction: fraction(substep) }, fraction(substep + 1));
        }
        self.applied.finish(&self.model, self.steps);
        self.prescribed.finish(&self.model, self.steps);
        self.contacts.finish(self.model.scene.stepping.rate_hz);
        self.steps += 1;
        if self.steps.is_multiple_of(CHECK_STEPS) {
            self.put_to_sleep();
        }
    }

    /// Advances from `moment` to the fraction `end` of the same step.
    fn substep(&mut self, moment: Moment, end: f64) {
        let far = self.tiles.wake_threshold(&self.model.scene);
        self.tiles.wake_beside_moved([&self.state.u, &self.state.d], self.plan.scheme.sweeps(), far);
        self.wake_what_is_moved(moment, end, far);
        if self.tables.pressure.is_some() {
            let volume_change = self.apply_volume_pressure();
            self.wake_what_is_pressed(volume_change, far);
        }
        self.points_done += self.tiles.awake_points as u64;
        let TissueState { model, plan, tables, applied, .. } = self;
        applied.prepare(model, plan, &tables.layout, moment, end - moment.fraction);
        let released = self.prescribed.take_released();
        let released: Vec<_> = released
            .into_iter()
            .filter_map(|(index, v)| Some((index, self.change_at_release(index, v, moment)?)))
            .collect();
        // A scheme that takes means adds the change to the substep's increment; other schemes add it to the
        // initial state.
        let takes_means = self.plan.scheme.takes_means();
        if !takes_means {
            released.iter().for_each(|(index, change)| self.shift(*index, change));
        }
        for sweep in 0..self.plan.scheme.sweeps() {
            if self.tables.pressure.is_some() && (sweep > 0 || !released.is_empty()) {
                self.apply_volume_pressure();
            }
            self.sweep(sweep);
            if let Some(far) = self.plan.scheme.fraction_after(sweep) {
                self.apply_prescribed(moment.step, moment.fraction + far * (end - moment.fraction), false);
            }
        }
        let history = self.plan.scheme.history();
        if history > 0 {
            // The newest force takes the place of the oldest.
            self.state.kept[..history].rotate_right(1);
        }
        if takes_means {
            released.iter().for_each(|(index, change)| self.shift(*index, change));
        }
        let unit_j = self.unit_of_work_j();
        self.work.add(self.tables.take_work() * unit_j);
        self.apply_prescribed(moment.step, end, true);
        self.solve_contact(end, far);
    }

    /// Runs sweep number `sweep` of a substep.
    fn sweep(&mut self, sweep: usize) {
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

    /// Moves the grasped points to their places at `fraction` of the step, and counts the work if `counted`.
    fn apply_prescribed(&mut self, step: u64, fraction: f64, counted: bool) {
        let unit_j = self.unit_of_work_j();
        let TissueState { model, plan, tables, state, applied, prescribed, work, .. } = self;
        let spacing_m = model.unit_m;
        for (index, displacement_m, velocity_m_per_s) in prescribed.at(model, step, fraction) {
            let (mut product, mut moved) = (0.0, [0.0; 3]);
            for c in 0..3 {
                let at = c * tables.layout.plane + tables.layout.offset(index);
                let (free_u, free_d) = (state.u[at], state.d[at]);
                state.u[at] = T::of(displacement_m[c] / spacing_m);
                state.d[at] = if plan.scheme.takes_means() {
                    // Undo the scheme's own movement: the increment starts from where the point was before.
                    state.u[at] - (free_u - free_d)
                } else {
                    T::of(velocity_m_per_s[c] * plan.substep_s / spacing_m)
                };
                product += (state.d[at].wide() - free_d.wide()) * state.d[at].wide();
                moved[c] = state.u[at].wide() - free_u.wide();
            }
            if counted {
                work.add(product * model.relative_mass_at(index) * unit_j);
                work.add(applied.work_along(model, plan, &tables.layout, model.point_of(index), moved) * unit_j);
            }
        }
    }

    /// Returns the change of u and d of a point that is released with `velocity_m_per_s`; `None` if nothing
    /// must change.
    fn change_at_release(&self, index: usize, velocity_m_per_s: DVec3, moment: Moment) -> Option<[[f64; 2]; 3]> {
        let TissueState { model, plan, tables, state, applied, .. } = self;
        let (point, scene) = (model.point_of(index), &model.scene);
        let springs = tables.springs.gather(&tables.layout, &state.u, self.volume_change(), point).map(Real::wide);
        let scale = plan.force_scale(scene);
        let applied_n = applied.from(model, index, moment);
        let (used, mass) = (applied.force_at(&tables.layout, 0, point), model.relative_mass_at(index));
        let mut changes = [[0.0; 2]; 3];
        for (c, change) in changes.iter_mut().enumerate() {
            let at = c * tables.layout.plane + tables.layout.offset(index);
            *change = plan.scheme.release(Release {
                u: state.u[at].wide(),
                springs: &state.history(springs[c], plan.scheme.history(), at),
                used: used[c],
                scale,
                lost_n: scene.damping_n_s_per_m * velocity_m_per_s[c] + applied_n[c] / mass,
            })?;
        }
        Some(changes)
    }

    /// Adds `change` to u and d of a point.
    fn shift(&mut self, index: usize, change: &[[f64; 2]; 3]) {
        let TissueState { tables, state, .. } = self;
        for (c, change) in change.iter().enumerate() {
            let at = c * tables.layout.plane + tables.layout.offset(index);
            state.u[at] += T::of(change[0]);
            state.d[at] += T::of(change[1]);
        }
    }

    /// Returns the work of a force of 1 in the fields of the tools along a displacement of 1, J.
    pub(crate) fn unit_of_work_j(&self) -> f64 {
        let TissueState { model, plan, .. } = self;
        model.unit_m / (plan.scheme.impulse() * plan.force_scale(&model.scene))
    }

    /// Returns displacement, velocity and springs' force of a free point, under the applied force `applied_n`
    /// and that of tips.
    pub(crate) fn free_point(&self, index: usize, applied_n: DVec3) -> [DVec3; 3] {
        let TissueState { model, plan, tables, state, .. } = self;
        let (spacing_m, scale) = (model.unit_m, plan.force_scale(&model.scene));
        let unit = plan.scheme.spring_scale() * scale;
        let springs = tables.springs.gather(&tables.layout, &state.u, self.volume_change(), model.point_of(index));
        let [i, j] = model.point_of(index);
        let mass = model.relative_mass_at(index);
        let still = self.steps == 0 || !self.tiles.region.is_awake(i, j);
        // Without all present forces, a two-step scheme would report a velocity for a point that rests under a
        // tip.
        let tips_n = if plan.scheme.takes_means() { self.contacts.steady_on(model, index) } else { DVec3::ZERO };
        let pushed_n = applied_n + tips_n;
        let observer = Observer::<f64>::of(&plan.scheme);
        let mut found = [DVec3::ZERO; 3];
        for (c, n) in springs.into_iter().enumerate() {
            let at = c * tables.layout.plane + tables.layout.offset(index);
            let one = Scalar::<f64>;
            let mut kept = [one(0.0); MAX_KEPT];
            kept.iter_mut().zip(&state.kept).for_each(|(value, field)| *value = one(field[at].wide()));
            let (u, d, n) = (one(state.u[at].wide()), one(state.d[at].wide()), one(n.wide()));
            let force = one(unit * pushed_n[c] / mass);
            let [u, w, _] = observer.observe(u, d, n, &kept, Some(force));
            found[0][c] = u.0 * spacing_m;
            found[1][c] = if still { 0.0 } else { w.0 * spacing_m / plan.substep_s };
            found[2][c] = spring_force_n(model, plan, index, n.0, state.u[at].wide());
        }
        found
    }

    pub(crate) fn tell(&mut self, tool: usize, input: Input) {
        match input {
            Input::Push(push) => {
                self.prescribed.release(tool);
                self.contacts.release(tool);
                self.applied.set(tool, push);
            }
            Input::Pose(place_m, tip) => {
                self.prescribed.release(tool);
                self.applied.set(tool, None);
                self.contacts.pose(&self.model, tool, place_m, tip);
            }
            Input::Grasp(index, grasp) => {
                self.applied.set(tool, None);
                self.contacts.release(tool);
                self.tiles.wake_under([self.model.point_of(index)]);
                let PointState { displacement_m, velocity_m_per_s, .. } = self.point(self.model.point_at(index));
                let now = Motion { displacement_m, velocity_m_per_s, ..Motion::default() };
                self.prescribed.grasp(tool, index, grasp, now);
            }
        }
    }
}

/// Returns the force of the springs on a point along an axis, N, from the gathered value of the tables and the
/// displacement in spacings.
pub(crate) fn spring_force_n(model: &Model, plan: &Plan, index: usize, gathered: f64, u: f64) -> f64 {
    let force_n = gathered / (plan.scheme.spring_scale() * plan.force_scale(&model.scene));
    if !model.places.differ() {
        return force_n;
    }
    // Anchor stiffness beyond the reference K″ is not part of the springs.
    let pulled_n = model.scene.anchor_stiffness_n_per_m * model.extra_anchor_at(index) * u * model.unit_m;
    model.relative_mass_at(index) * (force_n + pulled_n)
}

impl<T: Real> Tissue for TissueState<T> {
    fn model(&self) -> &Arc<Model> {
        &self.model
    }

    fn plan(&self) -> &Plan {
        &self.plan
    }

    fn step_count(&self) -> u64 {
        self.steps
    }

    fn guard_events(&self) -> u64 {
        self.guard_events
    }

    fn checkpoint_step(&self) -> u64 {
        self.checkpoint.as_ref().map_or(self.steps, |checkpoint| checkpoint.steps)
    }

    fn substeps_done(&self) -> u64 {
        self.substeps_done
    }

    fn push(&mut self, tool: usize, push: Option<Push>) {
        self.input(tool, Input::Push(push));
    }

    fn grasp(&mut self, tool: usize, point: PointId, grasp: Grasp) {
        self.input(tool, Input::Grasp(self.model.place_of(point), grasp));
    }

    fn pose(&mut self, tool: usize, place_m: DVec3, tip: Tip) {
        self.input(tool, Input::Pose(place_m, tip));
    }

    fn tool_contact(&self, tool: usize) -> Option<ToolContact> {
        self.keep_growth();
        TissueState::tool_contact(self, tool)
    }

    fn tangent_input(&self, tool: usize) -> Option<TangentInput> {
        TissueState::tangent_input(self, tool)
    }

    fn release(&mut self, tool: usize) {
        self.push(tool, None);
    }

    fn change(&mut self, model: &Arc<Model>) {
        self.known_volume_change.set(None);
        TissueState::change(self, model);
        self.known_volume_change.set(None);
    }

    fn request_audit(&mut self, inputs: WindowInputs) {
        TissueState::request_audit(self, inputs);
    }

    fn take_mark(&mut self) -> Option<Mark> {
        TissueState::take_mark(self)
    }

    fn changed(&self, model: &Arc<Model>) -> Option<Box<dyn Tissue>> {
        TissueState::changed(self, model).map(|sheet| sheet as Box<dyn Tissue>)
    }

    fn is_still(&self) -> bool {
        self.tiles.region.tiles().is_empty()
            && self.applied.is_settled()
            && self.prescribed.is_empty()
            && self.contacts.is_empty()
    }

    fn skip_steps(&mut self, steps: u64) {
        self.steps += steps;
        self.substeps_done += steps * u64::from(self.plan.substeps);
    }

    fn step_while(&mut self, may_go_on: &mut dyn FnMut() -> bool) -> Result<bool, BlowUp> {
        if self.repetition.is_none() {
            self.do_step();
            if (self.checkpoint.is_some() || !self.is_still())
                && let Err(cause) = self.check()
            {
                self.begin_repetition(cause)?;
            }
        }
        if !self.go_on_repeating(may_go_on)? {
            return Ok(false);
        }
        if self.checkpoint.is_some() && self.is_still() {
            self.forget_checkpoint();
        }
        self.known_volume_change.set(None);
        Ok(true)
    }

    fn is_within_step(&self) -> bool {
        self.repetition.is_some()
    }

    fn recover(&mut self, step: u64, to_rest: bool) -> Released {
        self.known_volume_change.set(None);
        let released = TissueState::recover(self, step, to_rest);
        self.known_volume_change.set(None);
        released
    }

    fn surface_displacement_m(&self, place_m: DVec3) -> DVec3 {
        self.surface_displacement(place_m)
    }

    fn reaction_around_n(&self, poke: &Poke) -> DVec3 {
        self.keep_growth();
        self.reaction_around(poke)
    }

    fn point(&self, point: PointId) -> PointState {
        self.keep_growth();
        let index = self.model.place_of(point);
        let scene = &self.model.scene;
        let applied_n = match self.steps {
            0 => self.applied.from(&self.model, index, Moment::start_of(0)),
            _ => self.applied.until(&self.model, index),
        };
        let [mut displacement_m, mut velocity_m_per_s, spring_n] = self.free_point(index, applied_n);
        let motion = self.prescribed.motion(&self.model, index);
        if let Some(motion) = motion {
            (displacement_m, velocity_m_per_s) = (motion.displacement_m, motion.velocity_m_per_s);
        }
        let mass = self.model.relative_mass_at(index);
        let anchor_n =
            -scene.anchor_stiffness_n_per_m * self.model.relative_anchor_stiffness_at(index) * displacement_m;
        let damping_n = -scene.damping_n_s_per_m * mass * velocity_m_per_s;
        let constraint_n = motion.map(|motion| {
            let inertia_n = scene.point_mass_kg() * mass * motion.acceleration_m_per_s2;
            inertia_n - spring_n - anchor_n - damping_n - applied_n
        });
        PointState { displacement_m, velocity_m_per_s, spring_n, anchor_n, damping_n, applied_n, constraint_n }
    }

    fn awake_points(&self) -> usize {
        self.tiles.awake_points
    }

    #[allow(clippy::cast_precision_loss)]
    fn computed_fraction(&self) -> f64 {
        match self.substeps_done {
            0 => 1.0,
            substeps => self.points_done as f64 / (substeps as f64 * self.model.len() as f64),
        }
    }

    fn energy(&self) -> Energy {
        self.energies()
    }

    fn largest_displacement_m(&self) -> f64 {
        let squared = (0..self.model.place_count()).map(|index| {
            let at = self.tables.layout.offset(index);
            (0..3).map(|c| self.state.u[c * self.tables.layout.plane + at].wide().powi(2)).sum()
        });
        squared.fold(0.0, f64::max).sqrt() * self.model.unit_m
    }

    fn displacements_m(&self, into: &mut [Vec<f32>; 3]) {
        if self.model.shown_order().is_none() {
            return self.shown_displacements_m(into);
        }
        let spacing = T::of(self.model.unit_m);
        #[allow(clippy::cast_possible_truncation)]
        let metres = |u: &T| (*u * spacing).wide() as f32;
        for (c, into) in into.iter_mut().enumerate() {
            into.clear();
            let layout = self.tables.layout;
            let place = |point| c * layout.plane + layout.offset(self.model.place_of(point));
            into.extend(self.model.points().map(|point| metres(&self.state.u[place(point)])));
        }
    }

    fn whole_displacements_m(&self, into: &mut Vec<f64>) {
        let layout = self.tables.layout;
        let of = |point| {
            let at = layout.offset(self.model.place_of(point));
            std::array::from_fn::<_, 3, _>(|c| self.state.u[c * layout.plane + at].wide() * self.model.unit_m)
        };
        into.clear();
        into.extend(self.model.points().flat_map(of));
    }

    fn shown_displacements_m(&self, into: &mut [Vec<f32>; 3]) {
        let Layout { rows, columns, stride, plane } = self.tables.layout;
        let spacing = T::of(self.model.unit_m);
        #[allow(clippy::cast_possible_truncation)]
        let metres = |u: &T| (*u * spacing).wide() as f32;
        for (c, into) in into.iter_mut().enumerate() {
            into.clear();
            for i in 0..rows {
                let from = c * plane + i * stride;
                into.extend(self.state.u[from..from + columns].iter().map(metres));
            }
        }
    }

    /// Counts the blocks of all rows.
    fn hash_block_count(&self) -> usize {
        let Layout { rows, columns, .. } = self.tables.layout;
        rows * columns.div_ceil(BLOCK)
    }

    fn hash_blocks(&self, blocks: Range<usize>, hasher: &mut Xxh3) {
        TissueState::hash_blocks(self, blocks, hasher);
    }

    fn save(&self) -> SavedTissue {
        TissueState::save(self)
    }

    fn copy(&self) -> ReadCopy {
        TissueState::copy(self)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::needless_range_loop)]
    use super::*;

    #[test]
    fn what_is_shown_of_a_mesh_is_where_its_points_are() {
        let model = Model::gallbladder(&["stepping.precision=f64"]);
        let mut sheet = TissueState::<f64>::new(&model);
        let point = model.shape().nearest(DVec3::new(0.02, 0.0, -0.05));
        sheet.grasp(0, point, Grasp::Target(DVec3::new(0.001, -0.002, 0.003)));
        for _ in 0..10 {
            sheet.step().unwrap();
        }
        // What a buffer held before is replaced.
        let mut shown = [vec![7.0], Vec::new(), vec![1.0; 5000]];
        sheet.displacements_m(&mut shown);
        let mut moved = 0;
        for (place, point) in model.points().enumerate() {
            let displacement_m = sheet.point(point).displacement_m;
            for c in 0..3 {
                assert!((f64::from(shown[c][place]) - displacement_m[c]).abs() < 1e-9, "{place}: {displacement_m}");
            }
            moved += usize::from(displacement_m.length() > 1e-6);
        }
        assert!(moved > 20 && shown.iter().all(|axis| axis.len() == model.len()), "{moved}");
    }

    #[test]
    fn a_grasped_point_pulls_its_neighbours_alike_however_a_step_is_divided() {
        let moved_m = |substeps: u32| {
            let model = Model::paper(&[
                "sheet.points=[7, 7]",
                "stepping.precision=f64",
                "stepping.integrator=rk4",
                &format!("stepping.substeps={substeps}"),
            ]);
            let mut sheet = TissueState::<f64>::new(&model);
            let [held, beside] = [[3, 3], [3, 4]].map(|place| model.scene.sheet().unwrap().point(place));
            sheet.grasp(0, held, Grasp::Target(0.005 * DVec3::Z));
            for _ in 0..3 {
                sheet.step().unwrap();
            }
            sheet.point(beside).displacement_m.z
        };
        let (once, often) = (moved_m(1), moved_m(8));
        assert!(often > 1e-8 && (once / often - 1.0).abs() < 0.01, "{once} {often} m");
    }
}
