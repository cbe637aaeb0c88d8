//! Another tissue under way: between two steps springs, virtual springs and damping become those of another model.
//!
//! Displacements and velocities stay. What a scheme keeps beside belongs to the old springs, and is made anew as if the
//! new ones had always pulled as they do now: constant forces for a past, so that nothing jumps. Energy does: that of the
//! springs is another. So the guard's account begins anew, and what it goes back to is the state just after the change.

use std::sync::Arc;

use super::field::{Field, State};
use super::model::Model;
use super::real::Real;
use super::survey::{Forces, Survey, Write};
use super::{Sheet, Work, central, exponential, rest, rk4, springs_of};
use crate::scene::Precision;

impl<T: Real> Sheet<T> {
    /// From the coming step on: `model` has the same points and number format.
    pub(super) fn change(&mut self, model: &Arc<Model>) {
        self.tiles.begin_anew(rest::tolerance(model));
        self.watch.give_up();
        if self.is_same_tissue(model) {
            self.resample(model);
            // Nothing was lost before there was room for it.
            let layout = self.bench.layout;
            let kept = self.plan.scheme.kept(model.precision == Precision::Compensated);
            self.state.kept.resize_with(kept, || Arc::new(Field::zero(&layout)));
        } else {
            self.exchange(model);
        }
        self.halvings = 0;

        self.bench.is_calm(0.0);
        self.bench.take_work();
        let (survey, _, energy_j) = self.survey(&self.tiles.region);
        self.work = Work::begun(energy_j, self.present_work_j(&survey));
        self.checkpoint = None;
        self.take_checkpoint();
    }

    /// Whether `model` has the same springs, damping and scheme: then what the scheme keeps of the past is as good as before.
    fn is_same_tissue(&self, model: &Model) -> bool {
        let tissue = |model: &Model| {
            let scene = &model.scene;
            let springs = scene.springs.clone();
            (springs, scene.virtual_stiffness_n_per_m, scene.damping_n_s_per_m, model.plan.integrator)
        };
        tissue(&self.model) == tissue(model)
    }

    /// Other springs, or another scheme.
    fn exchange(&mut self, model: &Arc<Model>) {
        self.write(Write::Seen);
        let ratio = T::of(model.plan.substep_s / self.plan.substep_s);
        self.state.d.iter_mut().for_each(|d| *d = *d * ratio);

        let layout = self.bench.layout;
        self.model = model.clone();
        self.plan = model.plan.clone();
        self.bench.springs = springs_of(model, &self.plan);
        let kept = self.plan.scheme.kept(model.precision == Precision::Compensated);
        self.state.kept = State::at_rest(&layout, kept).kept;
        self.applied.forget();
        let spacing_m = model.scene.sheet.spacing_m;
        // What a scheme would make of a grasped point is not what is seen of it.
        for (index, motion) in self.prescribed.grasped() {
            for c in 0..3 {
                let at = c * layout.plane + layout.place(index);
                self.state.u[at] = T::of(motion.displacement_m[c] / spacing_m);
                self.state.d[at] = T::of(motion.velocity_m_per_s[c] * self.plan.substep_s / spacing_m);
            }
        }
        self.write(Write::Begin);
    }

    /// Writes all of the state anew.
    fn write(&mut self, write: Write) {
        let terms = self.present_terms();
        let Sheet { plan, bench, state, tiles, .. } = self;
        let forces = Forces { terms: &terms, field: 0, part: 1.0, pull: 0.0 };
        with_scheme!(plan, T, |scheme| Survey::write(bench, scheme, state, forces, &tiles.region, write));
    }
}
