//! A change of tissue: between two steps, springs, anchor springs and damping become those of another model.
//!
//! Displacements and velocities stay. The scheme's kept values belong to the old springs and are rebuilt as if
//! the new springs had always pulled as they do now: a constant force history, so nothing jumps. The energy
//! does jump, because the new springs store another energy. So the guard's account of energy begins anew, and
//! its checkpoint becomes the state just after the change.

use std::sync::Arc;

use crate::body::tables::springs_of;
use crate::guard::checkpoint::Work;
use crate::guard::survey::{Forces, Survey, Write};
use crate::kernel::field::{Field, State};
use crate::kernel::real::Real;
use crate::model::Model;
use crate::scene::Precision;
use crate::state::tissue_state::TissueState;

impl<T: Real> TissueState<T> {
    /// Uses `model`, which has the same points and number format, from the next step on.
    pub(crate) fn change(&mut self, model: &Arc<Model>) {
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
    }

    /// Begins the guard's account and checkpoint anew, after the state or the springs were exchanged.
    pub(crate) fn begin_account(&mut self) {
        self.halvings = 0;
        self.tables.is_settled(0.0);
        self.tables.take_work();
        let (survey, _, energy_j) = self.survey(&self.tiles.region);
        self.work = Work::begun(energy_j + self.coupling_j(), self.present_work_j(&survey));
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
            (springs, coefficients, model.plan.integrator)
        };
        tissue(&self.model) == tissue(model)
    }

    /// Exchanges the springs or the scheme. Displacements and velocities stay.
    pub(crate) fn exchange(&mut self, model: &Arc<Model>) {
        self.write(Write::Seen);
        let ratio = T::of(model.plan.substep_s / self.plan.substep_s);
        self.state.d.iter_mut().for_each(|d| *d = *d * ratio);

        let layout = self.tables.layout;
        self.model = model.clone();
        self.plan = model.plan.clone();
        self.tables.springs = springs_of(model, &self.plan);
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
    fn write(&mut self, write: Write) {
        let terms = self.present_terms();
        self.apply_volume_pressure();
        let TissueState { plan, tables, state, tiles, .. } = self;
        let forces = Forces { terms: &terms, field: 0, part: 1.0, pull: 0.0 };
        Survey::write(tables, &plan.scheme, state, forces, &tiles.region, write);
    }
}
