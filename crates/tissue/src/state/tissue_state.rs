//! A tissue in motion: its state, and what can be read from it. `step` advances it, `guarded` changes it otherwise.

use std::cell::{Cell, LazyCell};
use std::ops::Range;
use std::sync::Arc;

use glam::DVec3;
use xxhash_rust::xxh3::Xxh3;

use crate::audit_window::{AuditWindow, Mark, WindowInputs};
use crate::body::force_field::Term;
use crate::body::model::{Model, Plan, displacement_m};
use crate::body::severed::Cuts;
use crate::body::spring_search::SpringSearch;
use crate::body::tables::{SweepTables, springs_of};
use crate::body::window::Window;
use crate::interface::{BlowUp, Energy, PointState, ReadCopy, Released, Tissue};
use crate::kernel::field::{BLOCK, Layout, State};
use crate::kernel::real::Real;
use crate::kernel::region::Region;
use crate::memory;
use crate::response::around_place::reaction_around;
use crate::saved::SavedTissue;
use crate::scene::Precision;
use crate::scene::profile::Poke;
use crate::scene::tie::Tie;
use crate::scheme::observer::Observer;
use crate::shape::PointId;
use crate::stage_times::{StageTimes, StepStage};
use crate::state::guard::checkpoint::{Checkpoint, Repetition};
use crate::state::guard::survey::{Forces, Survey, Write, energy_of, pressure_j};
use crate::state::guard::work_account::WorkAccount;
use crate::state::point_reader::PointReader;
use crate::state::sleep::criterion::add_sleeping;
use crate::state::sleep::tiles::SleepTiles;
use crate::tools::applied_force::{Applied, Push};
use crate::tools::burns::Burns;
use crate::tools::contact::{Contacts, TangentInput, ToolContact};
use crate::tools::input::ToolInput;
use crate::tools::prescribed::{Grasp, Prescribed};
use crate::tools::tie::TieState;
use palpate_haptics::{ContactState, ReportedSpring, Tip};

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
    pub(super) model: Arc<Model>,
    /// The model's plan, or one with a shorter substep.
    pub(super) plan: Plan,
    pub(super) halvings: u32,
    pub(super) tables: SweepTables<T>,
    pub(super) state: State<T>,
    pub(super) applied: Applied<T>,
    pub(super) prescribed: Prescribed,
    pub(super) contacts: Contacts,
    pub(super) steps: u64,
    pub(super) work: WorkAccount,
    /// `None`: the present state itself is the checkpoint, as in a tissue at rest.
    pub(super) checkpoint: Option<Arc<Checkpoint<T>>>,
    /// The inputs of the tools since the checkpoint: step they precede, tool, input.
    pub(super) inputs: Vec<(u64, usize, ToolInput)>,
    /// A repetition by the guard; until it ends, the present step is unfinished.
    pub(super) repetition: Option<Repetition>,
    pub(super) audit_window: AuditWindow,
    /// Whether the beginning of the window is still to be reported.
    pub(super) is_marked: bool,
    pub(super) tiles: SleepTiles<T>,
    pub(super) guard_events: u64,
    pub(super) substeps_done: u64,
    /// Points computed, summed over all substeps.
    pub(super) points_done: u64,
    /// By how much a volume has grown, if it was computed since the last change of the state.
    pub(super) known_volume_change: Cell<Option<f64>>,
    /// How long the stages of a step take, if that is asked for.
    pub(super) stage_times: Option<StageTimes>,
    /// What a search for springs begins with, once there was a blade.
    pub(super) spring_search: Option<SpringSearch>,
}

impl<T: Real> TissueState<T> {
    pub(crate) fn new(model: &Arc<Model>) -> Self {
        let layout = Layout::new::<T>(model.points);
        let plan = model.plan.clone();
        let mut tissue = TissueState {
            model: model.clone(),
            halvings: 0,
            tables: SweepTables::new(model, layout, springs_of(model, &plan)),
            state: State::at_rest(&layout, plan.scheme.kept(model.precision == Precision::Compensated)),
            steps: 0,
            work: WorkAccount::default(),
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
            stage_times: None,
            spring_search: None,
            plan,
        };
        if model.places.is_pulled() {
            tissue.tiles.wake_all();
            tissue.write(Write::Begin);
            tissue.begin_account();
        }
        tissue
    }

    /// Returns by how much the volume of a mesh has grown, in cubes of the unit of length.
    pub(super) fn volume_change(&self) -> f64 {
        let fresh = || self.tables.volume_change(&self.state.u, self.tiles.region.tiles());
        self.known_volume_change.get().unwrap_or_else(fresh)
    }

    /// Keeps the growth of a volume until the state changes: reading many points computes it once.
    fn keep_growth(&self) {
        if self.tables.pressure.is_some() && self.known_volume_change.get().is_none() {
            self.known_volume_change.set(Some(self.volume_change()));
        }
    }

    /// Returns whether no point moves and no tool can change that.
    pub(super) fn is_at_rest(&self) -> bool {
        self.tiles.region.tiles().is_empty()
            && self.applied.is_settled()
            && self.prescribed.is_empty()
            && self.contacts.are_settled()
    }

    /// Passes steps in which nothing moves.
    pub(super) fn pass_steps(&mut self, steps: u64) {
        self.steps += steps;
        self.substeps_done += steps * u64::from(self.plan.substeps);
    }

    /// Returns the displacement of the point at a row and column of memory, m; of a multistep scheme the predicted one.
    fn displacement_m(&self, point: [usize; 2]) -> DVec3 {
        displacement_m(&self.model, &self.tables.layout, &self.state, point)
    }

    /// Returns a reader of points.
    pub(super) fn reader(&self) -> PointReader<'_, T> {
        let TissueState { model, plan, tables, state, applied, prescribed, contacts, tiles, .. } = self;
        PointReader {
            model,
            plan,
            tables,
            state,
            applied,
            prescribed,
            contacts,
            tiles,
            steps: self.steps,
            volume_change: self.volume_change(),
            observer: Observer::of(&plan.scheme),
            spring_unit: plan.spring_unit(&model.scene),
        }
    }

    /// Returns the tools' force at the end of the last step, in the springs' units, if the scheme needs it to
    /// observe a velocity; otherwise nothing.
    pub(super) fn present_terms(&self) -> Vec<Term<T>> {
        let TissueState { model, plan, tables, .. } = self;
        if !plan.scheme.takes_means() || self.steps == 0 {
            return Vec::new();
        }
        self.applied.until_now(model, &tables.layout, plan.spring_unit(&model.scene))
    }

    /// Surveys part of the tissue. Returns the survey, the energies, and the energy that the scheme conserves;
    /// both energies include that of the pressure, which belongs to the whole tissue.
    pub(super) fn survey(&self, over: &Region) -> (Survey, Energy, f64) {
        let TissueState { model, plan, tables, state, .. } = self;
        let terms = self.present_terms();
        let forces = Forces { terms: &terms, field: 0, part: 1.0, pull: 0.0 };
        let pressure_j = pressure_j(model, tables.press(&state.u, self.tiles.region.tiles()));
        let survey = Survey::of(tables, &plan.scheme, state, forces, over);
        let (mut energy, kept_j) = energy_of(model, plan, &survey);
        energy.spring_j += pressure_j;
        // A grasped point moves with its tool, not as the scheme would move it.
        let reader = LazyCell::new(|| self.reader());
        let own = self.prescribed.grasped().map(|(index, motion)| {
            let free = reader.free_velocity_m_per_s(index);
            tables.relative_mass_at(model, index) * (motion.velocity_m_per_s.length_squared() - free.length_squared())
        });
        let grasped_j = 0.5 * model.scene.point_mass_kg() * own.sum::<f64>();
        energy.kinetic_j += grasped_j;
        (survey, energy, kept_j + grasped_j + pressure_j)
    }
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
        self.input(tool, ToolInput::Push(push));
    }

    fn grasp(&mut self, tool: usize, point: PointId, grasp: Grasp) {
        self.input(tool, ToolInput::Grasp(self.model.place_of(point), grasp));
    }

    fn pose(&mut self, tool: usize, place_m: DVec3, tip: Tip) {
        self.input(tool, ToolInput::Pose(place_m, tip));
    }

    fn tie(&mut self, number: usize, tie: Option<Tie>) {
        self.input(number, ToolInput::Tie(tie.map(Box::new)));
    }

    fn ties(&self) -> Vec<TieState> {
        self.contacts.ties.states(|point| self.displacement_m(point))
    }

    fn tool_contact(&self, tool: usize) -> Option<ToolContact> {
        self.keep_growth();
        let tool = self.contacts.tool(tool)?;
        let without_inertia = || {
            let reader = self.reader();
            tool.without_inertia(&self.model, |index, mass| reader.force_on_free_n(index, mass))
        };
        let (surface_m, _) = tool.footprint.surface(|point| self.displacement_m(point));
        Some(tool.contact(surface_m, without_inertia))
    }

    fn tangent_input(&self, tool: usize) -> Option<TangentInput> {
        let tool = self.contacts.tool(tool).filter(|tool| tool.contact_state != ContactState::Free)?;
        let cuts = self.tables.severed.cuts();
        let window = Window::around(&self.model, &tool.footprint).with_copies(cuts);
        // Without memory for it, the stiffness from the force law must suffice.
        memory::check(window.bytes(), "the stiffness under a tool").ok()?;
        let displacement_m = |place: usize| self.displacement_m(self.model.point_of(place));
        let displacement_m = window.points(&self.model).map(displacement_m).collect();
        Some(TangentInput {
            model: self.model.clone(),
            footprint: tool.footprint.clone(),
            window,
            displacement_m,
            cuts: cuts.clone(),
        })
    }

    fn release(&mut self, tool: usize) {
        self.push(tool, None);
    }

    fn change(&mut self, model: &Arc<Model>) {
        self.exchange_model(model);
    }

    fn request_audit(&mut self, inputs: WindowInputs) {
        self.begin_window(inputs);
    }

    fn take_mark(&mut self) -> Option<Mark> {
        self.report_window()
    }

    fn changed(&self, model: &Arc<Model>) -> Option<Box<dyn Tissue>> {
        self.in_f64(model).map(|sheet| sheet as Box<dyn Tissue>)
    }

    fn is_still(&self) -> bool {
        self.is_at_rest()
    }

    fn skip_steps(&mut self, steps: u64) {
        self.pass_steps(steps);
    }

    fn step_while(&mut self, may_go_on: &mut dyn FnMut() -> bool) -> Result<bool, BlowUp> {
        let is_done = self.guarded_step(may_go_on);
        self.ended(StepStage::Guard);
        is_done
    }

    fn is_within_step(&self) -> bool {
        self.repetition.is_some()
    }

    fn recover(&mut self, step: u64, to_rest: bool) -> Released {
        self.go_on_after_blow_up(step, to_rest)
    }

    fn surface_displacement_m(&self, place_m: DVec3) -> DVec3 {
        let shape = self.model.shape();
        let Some(cell) = shape.cell_around(place_m) else { return self.point(shape.nearest(place_m)).displacement_m };
        cell.interpolate(|point| self.displacement_m(self.model.point_of(self.model.place_of(point))))
    }

    fn reaction_around_n(&self, poke: &Poke) -> DVec3 {
        self.keep_growth();
        let reader = self.reader();
        let reaction_n = |point| {
            let place = self.model.place_of(point);
            match self.tables.severed.copies() {
                Some(copies) => copies.places_of(place).map(|place| reader.point(place).reaction_n()).sum(),
                None => reader.point(place).reaction_n(),
            }
        };
        reaction_around(self.model.shape(), poke, reaction_n)
    }

    fn point(&self, point: PointId) -> PointState {
        self.keep_growth();
        self.reader().point(self.model.place_of(point))
    }

    fn cuts(&self) -> Cuts {
        self.tables.severed.cuts().clone()
    }

    fn sever(&mut self, springs: &[ReportedSpring]) -> palpate_refusal::Result<()> {
        self.sever_reported(springs)
    }

    fn burns(&self) -> Burns {
        self.contacts.burns.clone()
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

    fn strain_around(&self, place_m: DVec3, radius_m: f64) -> f64 {
        self.largest_strain(self.model.shape().around(place_m, radius_m))
    }

    fn energy(&self) -> Energy {
        let TissueState { model, plan, tables, state, tiles, .. } = self;
        let (_, mut energy, _) = self.survey(&tiles.region);
        add_sleeping(&mut energy, model, plan, tables, state, tiles);
        energy
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

    /// Counts the blocks of all rows in use.
    fn hash_block_count(&self) -> usize {
        let Layout { columns, .. } = self.tables.layout;
        let rows = self.tables.severed.copies().map_or(0, |copies| copies.end().div_ceil(columns));
        rows.max(self.model.rows_of_points()) * columns.div_ceil(BLOCK)
    }

    fn hash_blocks(&self, blocks: Range<usize>, hasher: &mut Xxh3) {
        if blocks.start == 0 {
            self.tables.severed.hash(hasher);
            self.contacts.ties.hash(&mut |bytes| hasher.update(bytes));
            self.contacts.burns.hash(&mut |bytes| hasher.update(bytes));
        }
        self.state.hash_blocks(&self.tables.layout, |point| self.tiles.has_moved(point), blocks, hasher);
    }

    fn time_stages(&mut self, now_ns: Option<fn() -> u64>) {
        self.stage_times = now_ns.map(StageTimes::new);
    }

    fn stage_times(&self) -> Option<&StageTimes> {
        self.stage_times.as_ref()
    }

    fn save(&self) -> SavedTissue {
        self.saved()
    }

    fn copy(&self) -> ReadCopy {
        self.read_copy()
    }
}

#[cfg(test)]
mod around_tests;

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
    fn at_a_place_of_a_mesh_the_surface_moves_as_its_nearest_point_is_observed() {
        let model = Model::gallbladder(&["stepping.precision=f64", "stepping.integrator=exponential3"]);
        let mut tissue = TissueState::<f64>::new(&model);
        let point = model.shape().nearest(DVec3::new(0.02, 0.0, -0.05));
        let centre_m = model.shape().rest_m(point);
        let force_n = DVec3::new(0.0, 0.01, 0.02);
        let poke = Poke { point: None, centre_m, force_n, falloff_per_m: 200.0, falloff_offset: 0.0 };
        tissue.push(0, Some(Push::Constant(poke)));
        for _ in 0..5 {
            tissue.step().unwrap();
        }
        let observed_m = tissue.point(point).displacement_m;
        assert_eq!(tissue.surface_displacement_m(centre_m), observed_m);
        // While it moves, a multistep scheme has predicted another place.
        let predicted_m = tissue.displacement_m(model.point_of(model.place_of(point)));
        assert!(observed_m != predicted_m && observed_m.length() > 1e-6, "{observed_m} {predicted_m}");
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
