//! Copies of a tissue: for reading in another thread while the tissue continues, for a snapshot, and twins that repeat steps
//! for an audit.
//!
//! Copying reads and writes each field once, which is the memory traffic of one substep, and only copies what
//! has ever moved. So it happens at once, between two steps. Slow results are computed from the copy: forces
//! take hundreds of nanoseconds per point, and a hash takes tens.

use std::cell::Cell;
use std::sync::Arc;

use glam::DVec3;

use crate::audit_window::{AuditWindow, Replay, Resume, WindowInputs};
use crate::body::model::Model;
use crate::interface::{ReadCopy, Tissue};
use crate::kernel::field::State;
use crate::kernel::real::Real;
use crate::memory;
use crate::saved::SavedTissue;
use crate::scene::Precision;
use crate::state::guard::checkpoint::Checkpoint;
use crate::state::guard::work_account::WorkAccount;
use crate::state::restore::TypedState;
use crate::state::tissue_state::TissueState;
use crate::tools::applied_force::Applied;

/// Size of a slice of an audit, in points times substeps; a slice takes a few milliseconds.
const SLICE: u64 = 1 << 20;

impl<T: Real> TissueState<T> {
    /// Returns a copy of the values at all points. Only what has ever moved is copied.
    fn copied_state(&self) -> State<T> {
        let mut copy = State::zero(&self.tables.layout, self.state.kept.len());
        copy.fields_mut().zip(self.state.fields()).for_each(|(to, from)| self.tiles.copy_moved(to, from));
        copy
    }

    /// Returns a copy whose points and hash are those of this tissue. It can't be stepped or surveyed: it has
    /// no tables of fixed points and forces.
    pub(super) fn read_copy(&self) -> ReadCopy {
        let TissueState { model, plan, tables, tiles, .. } = self;
        ReadCopy::of(Box::new(TissueState {
            model: model.clone(),
            plan: plan.clone(),
            halvings: self.halvings,
            tables: tables.for_copy(),
            state: self.copied_state(),
            applied: Applied::<T>::like(&self.applied),
            prescribed: self.prescribed.clone(),
            contacts: self.contacts.without_tools(),
            steps: self.steps,
            work: WorkAccount::default(),
            checkpoint: None,
            inputs: Vec::new(),
            repetition: None,
            audit_window: AuditWindow::Off,
            is_marked: false,
            tiles: tiles.for_copy(),
            guard_events: self.guard_events,
            substeps_done: self.substeps_done,
            points_done: self.points_done,
            known_volume_change: Cell::new(Some(self.volume_change())),
            stage_times: None,
            spring_search: None,
        }))
    }

    /// Returns a copy of everything that the next steps depend on. It shares the checkpoint, so that the next
    /// checkpoint takes new memory.
    pub(super) fn saved(&self) -> SavedTissue {
        let TissueState { model, tables, tiles, .. } = self;
        SavedTissue(Arc::new(TypedState {
            model: model.clone(),
            layout: tables.layout,
            steps: self.steps,
            halvings: self.halvings,
            state: self.copied_state(),
            forces: self.applied.saved(),
            prescribed: self.prescribed.saved(),
            contacts: self.contacts.saved(),
            ties: self.contacts.ties.saved(),
            burns: self.contacts.burns.clone(),
            work: self.work,
            checkpoint: self.checkpoint.clone(),
            inputs: self.inputs.clone(),
            tiles: tiles.taken(),
            cuts: tables.severed.cuts().clone(),
            guard_events: self.guard_events,
            substeps_done: self.substeps_done,
            points_done: self.points_done,
        }))
    }

    /// Returns a tissue in the state of a checkpoint of a tissue with `model`.
    pub(super) fn resumed(model: &Model, checkpoint: &Checkpoint<T>) -> Box<Self> {
        let mut sheet = Box::new(TissueState::new(&model.twin(1 << checkpoint.halvings, model.precision)));
        sheet.steps = checkpoint.steps;
        sheet.state.copy_from(&checkpoint.state);
        sheet.applied.clone_from(&checkpoint.applied);
        sheet.prescribed.clone_from(&checkpoint.prescribed);
        sheet.contacts.clone_from(&checkpoint.contacts);
        sheet.tiles.largest = checkpoint.largest;
        sheet.tables.set_severed(model, &checkpoint.cuts);
        sheet.follow_cuts();
        sheet
    }

    /// Returns the same state in f64. `model` may differ from this tissue's only in the format and in what may
    /// sleep.
    pub(super) fn widened(&self, model: &Arc<Model>) -> TissueState<f64> {
        let mut sheet = TissueState::<f64>::new(model);
        sheet.steps = self.steps;
        let lost = (self.model.precision == Precision::Compensated).then(|| self.state.kept.last()).flatten();
        let State { u, d, kept } = &mut sheet.state;
        let pairs = [(u, &self.state.u), (d, &self.state.d)].into_iter();
        let kept = kept.iter_mut().zip(&self.state.kept).map(|(to, from)| (Arc::make_mut(to), &**from));
        let (from, to) = (self.tables.layout, sheet.tables.layout);
        for (number, (wide, narrow)) in pairs.chain(kept).enumerate() {
            for index in 0..self.model.place_count() {
                for c in 0..3 {
                    let at = c * from.plane + from.offset(index);
                    // The rounding error of a compensated displacement belongs to it.
                    let lost = lost.filter(|_| number == 0).map_or(0.0, |lost| lost[at].wide());
                    wide[c * to.plane + to.offset(index)] = narrow[at].wide() + lost;
                }
            }
        }
        sheet.applied = Applied::like(&self.applied);
        sheet.prescribed.clone_from(&self.prescribed);
        sheet.contacts.clone_from(&self.contacts);
        sheet.tables.set_severed(model, self.tables.severed.cuts());
        sheet.follow_cuts();
        sheet
    }

    /// Returns the tissue converted to f64 and to `model`; `None` unless `model` is in f64 and this tissue is not.
    pub(super) fn in_f64(&self, model: &Arc<Model>) -> Option<Box<TissueState<f64>>> {
        if self.model.precision == Precision::F64 || model.precision != Precision::F64 {
            return None;
        }
        let mut same = Model::clone(&self.model);
        (same.plan, same.precision) = (self.plan.clone(), Precision::F64);
        let mut sheet = Box::new(self.widened(&Arc::new(same)));
        sheet.tiles.largest = self.tiles.largest;
        sheet.guard_events = self.guard_events;
        (sheet.substeps_done, sheet.points_done) = (self.substeps_done, self.points_done);
        if !matches!(self.audit_window, AuditWindow::Off) {
            sheet.audit_window = AuditWindow::Dropped;
        }
        sheet.stage_times.clone_from(&self.stage_times);
        sheet.exchange_model(model);
        Some(sheet)
    }
}

impl<T: Real> Resume for Checkpoint<T> {
    fn resume(&self, model: &Model) -> Box<dyn Replay> {
        TissueState::resumed(model, self)
    }
}

impl<T: Real> Replay for TissueState<T> {
    fn model(&self) -> &Arc<Model> {
        &self.model
    }

    fn steps(&self) -> u64 {
        self.steps
    }

    fn largest(&self) -> f64 {
        self.tiles.largest
    }

    fn observed(&self) -> Vec<[DVec3; 2]> {
        let points = self.model.points().map(|point| {
            let point = self.point(point);
            [point.displacement_m, point.reaction_n()]
        });
        memory::collected(points, "an audit")
    }

    fn twin(&self, by: u32) -> Box<dyn Replay> {
        let mut wide = self.widened(&self.model.twin(1, Precision::F64));
        if by > 1 {
            let model = wide.model.twin(by, Precision::F64);
            wide.resample(&model);
        }
        Box::new(wide)
    }

    fn repeat(&mut self, inputs: &WindowInputs, until: u64, go_on: &mut dyn FnMut() -> bool) -> bool {
        let work = self.model.len() as u64 * u64::from(self.plan.substeps);
        let slice = (SLICE / work).max(1);
        let mut waiting = inputs.0.iter().peekable();
        while self.steps < until {
            while let Some((_, tool, input)) = waiting.next_if(|(step, ..)| *step <= self.steps) {
                self.tell(*tool, input.clone());
            }
            self.do_step();
            if self.steps.is_multiple_of(slice) && !go_on() {
                return false;
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use crate::shape;
    use glam::DVec3;

    use super::*;
    use crate::kernel::field::BLOCK;
    use crate::scene::profile::Poke;
    use crate::{Grasp, Hashing, Model, Push, at_rest};

    #[test]
    fn a_copy_has_the_points_and_the_hash_of_its_moment_in_slices_of_any_size() {
        for sets in [
            ["sheet.points=[37, 51]", "stepping.precision=f32", "stepping.integrator=central"],
            ["sheet.points=[3, 83]", "stepping.precision=f64", "stepping.integrator=exponential3"],
            ["sheet.points=[90, 40]", "stepping.precision=compensated", "stepping.integrator=exponential4"],
        ] {
            let model = Model::paper(&sets);
            let mut tissue = at_rest(&model);
            let spacing_m = model.scene.sheet().unwrap().spacing_m;
            let centre_m = spacing_m * DVec3::new(1.0, 20.0, 0.0);
            let force_n = DVec3::new(0.2, 0.1, -0.8);
            let falloff_per_m = 1.0 / spacing_m;
            tissue.push(
                0,
                Some(Push::Constant(Poke { point: None, centre_m, force_n, falloff_per_m, falloff_offset: 0.0 })),
            );
            tissue.grasp(
                1,
                model.scene.sheet().unwrap().point([1, 30]),
                Grasp::Target(DVec3::new(0.0, 0.0, 0.3 * spacing_m)),
            );
            (0..25).for_each(|_| tissue.step().unwrap());
            let copy = tissue.copy();
            let (hash, points) = (tissue.state_hash(), shape::points(model.shape()).map(|point| tissue.point(point)));
            let points: Vec<_> = points.collect();
            (0..5).for_each(|_| tissue.step().unwrap());
            assert_ne!(tissue.state_hash(), hash);
            assert!(shape::points(model.shape()).zip(&points).all(|(id, point)| copy.point(id) == *point), "{sets:?}");
            for slice in [1, 16, 700, usize::MAX] {
                let (mut hashing, mut slices) = (Hashing::default(), 1);
                let found = loop {
                    if let Some(found) = copy.hash(&mut hashing, slice) {
                        break found;
                    }
                    slices += 1;
                };
                assert_eq!(found, hash, "{sets:?} by {slice}");
                let [rows, columns] = model.points;
                assert_eq!(slices, (rows * columns.div_ceil(BLOCK)).div_ceil(slice.div_ceil(BLOCK)));
            }
        }
    }

    #[test]
    fn a_sheet_resumed_from_a_checkpoint_goes_on_as_the_first_does_also_with_a_halved_substep() {
        for halvings in [0, 1, 2] {
            let model = Model::paper(&[
                "stepping.integrator=exponential3",
                "stepping.precision=f64",
                "sleep.tolerance=0.0",
                "sheet.points=[5, 5]",
                "stepping.substeps=2",
            ]);
            let mut sheet = TissueState::<f64>::new(&model);
            let (centre_m, force_n) = (0.07 * DVec3::new(2.0, 3.0, 0.0), DVec3::new(0.1, -0.2, -1.0));
            let poke = Poke { point: None, centre_m, force_n, falloff_per_m: 10.0, falloff_offset: 0.0 };
            sheet.push(0, Some(Push::Constant(poke)));
            (0..30).for_each(|_| sheet.step().unwrap());
            sheet.halve(0, halvings);
            sheet.take_checkpoint();
            let mut resumed = TissueState::resumed(&sheet.model, sheet.checkpoint.as_ref().unwrap());
            assert_eq!(resumed.plan, sheet.plan);
            for _ in 0..20 {
                sheet.step().unwrap();
                resumed.do_step();
            }
            assert_eq!(resumed.state_hash(), sheet.state_hash(), "{halvings} halvings");
        }
    }
}
