//! A copy of a tissue at one moment. Another thread reads it in slices while the tissue continues.
//!
//! Copying reads and writes each field once, which is the memory traffic of one substep, and only copies what
//! has ever moved. So it happens at once, between two steps. Slow results are computed from the copy: forces
//! take hundreds of nanoseconds per point, and a hash takes tens.

use std::cell::Cell;
use std::ops::Range;

use xxhash_rust::xxh3::Xxh3;

use crate::guard::checkpoint::Work;
use crate::interface::ReadCopy;
use crate::kernel::field::State;
use crate::kernel::real::Real;
use crate::select::audit_window::AuditWindow;
use crate::state::tissue_state::TissueState;
use crate::tools::applied_force::Applied;
use crate::tools::contact::Contacts;

impl<T: Real> TissueState<T> {
    /// Returns a copy whose points and hash are those of this tissue. It can't be stepped or surveyed: it has
    /// no tables of fixed points and forces.
    pub(crate) fn copy(&self) -> ReadCopy {
        let TissueState { model, plan, tables, state, tiles, .. } = self;
        let mut state_copy = State::zero(&tables.layout, state.kept.len());
        state_copy.fields_mut().zip(state.fields()).for_each(|(to, from)| tiles.copy_moved(to, from));
        ReadCopy::of(Box::new(TissueState {
            model: model.clone(),
            plan: plan.clone(),
            halvings: self.halvings,
            tables: tables.for_copy(),
            state: state_copy,
            applied: Applied::<T>::like(&self.applied),
            prescribed: self.prescribed.clone(),
            contacts: Contacts::default(),
            steps: self.steps,
            work: Work::default(),
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
        }))
    }

    /// Adds blocks of the state to a hash ([`State::hash_blocks`]).
    pub(crate) fn hash_blocks(&self, blocks: Range<usize>, hasher: &mut Xxh3) {
        self.state.hash_blocks(&self.tables.layout, |point| self.tiles.has_moved(point), blocks, hasher);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use crate::shape;
    use glam::DVec3;

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
}
