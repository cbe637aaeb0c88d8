//! Grasped points in a step: the stage that holds them, and how a point goes on that is let go.

use glam::DVec3;

use crate::kernel::real::Real;
use crate::scene::profile::Moment;
use crate::scheme::family::Release;
use crate::state::step_context::StepContext;
use crate::tools::prescribed::Prescribed;

/// A point that was let go, and the change of its u and d along each axis with which it goes on.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Freed {
    index: usize,
    changes: [[f64; 2]; 3],
}

impl Freed {
    /// Adds the change to u and d of the point.
    pub(crate) fn let_go<T: Real>(&self, context: &mut StepContext<'_, T>) {
        let StepContext { tables, state, .. } = context;
        for (c, change) in self.changes.iter().enumerate() {
            let at = c * tables.layout.plane + tables.layout.offset(self.index);
            state.u[at] += T::of(change[0]);
            state.d[at] += T::of(change[1]);
        }
    }
}

impl<T: Real> StepContext<'_, T> {
    /// Returns the change of u and d of a point that is released with `velocity_m_per_s`; `None` if nothing must
    /// change.
    fn change_at_release(&self, index: usize, velocity_m_per_s: DVec3, moment: Moment) -> Option<[[f64; 2]; 3]> {
        let StepContext { model, plan, tables, state, applied, tiles, .. } = self;
        let (point, scene) = (model.point_of(index), &model.scene);
        let volume_change = tables.volume_change(&state.u, tiles.region.tiles());
        let springs =
            tables.springs.gather(&tables.severed, &tables.layout, &state.u, volume_change, point).map(Real::wide);
        let scale = plan.force_scale(scene);
        let applied_n = applied.from(model, index, moment);
        let (used, mass) = (applied.force_at(&tables.layout, 0, point), tables.relative_mass_at(model, index));
        let mut changes = [[0.0; 2]; 3];
        for (c, change) in changes.iter_mut().enumerate() {
            let at = c * tables.layout.plane + tables.layout.offset(index);
            *change = plan.scheme.release(Release {
                u: state.u[at].wide(),
                springs: &state.history(springs[c], plan.scheme.kept_of_springs(), at),
                used: used[c],
                scale,
                lost_n: scene.damping_n_s_per_m * velocity_m_per_s[c] + applied_n[c] / mass,
            })?;
        }
        Some(changes)
    }
}

impl Prescribed {
    /// Returns the points released since the last call, each with the change that lets it go on with its velocity at
    /// `moment`. Empties the list.
    pub(crate) fn take_freed<T: Real>(&mut self, context: &StepContext<'_, T>, moment: Moment) -> Vec<Freed> {
        let released = self.take_released().into_iter();
        let freed = |(index, velocity_m_per_s)| {
            let changes = context.change_at_release(index, velocity_m_per_s, moment)?;
            Some(Freed { index, changes })
        };
        released.filter_map(freed).collect()
    }

    /// Moves the grasped points to their places at `fraction` of step `step`, and counts the work if `counted`.
    pub(crate) fn hold<T: Real>(&self, context: &mut StepContext<'_, T>, step: u64, fraction: f64, counted: bool) {
        let StepContext { model, plan, tables, state, applied, work, .. } = context;
        let (spacing_m, unit_j) = (model.unit_m, plan.unit_of_work_j(model));
        for (index, displacement_m, velocity_m_per_s) in self.at(model, step, fraction) {
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
                work.add(product * tables.relative_mass_at(model, index) * unit_j);
                work.add(applied.work_along(model, plan, &tables.layout, model.point_of(index), moved) * unit_j);
            }
        }
    }
}
