//! Threads and clips in a substep: the stage in which they pull. `tools::tie` solves for their forces.

use glam::DVec3;

use crate::body::footprint::{Footprint, WeightedNode};
use crate::body::model::displacement_m;
use crate::kernel::real::Real;
use crate::state::step_context::StepContext;
use crate::tools::contact::push;
use crate::tools::tie::{LaidTie, Ties, disc_forces_n};

impl Ties {
    /// Makes all ties pull at the end of a substep that is followed by `more` in this step. One that moves points by more than `far` spacings
    /// wakes the tiles that these pull at in the next substep.
    pub(crate) fn act<T: Real>(&mut self, context: &mut StepContext<'_, T>, more: u32, far: f64) {
        for laid in self.laid.iter_mut().filter(|laid| !laid.is_broken) {
            laid.act(context, more, far);
        }
    }
}

impl LaidTie {
    fn act<T: Real>(&mut self, context: &mut StepContext<'_, T>, more: u32, far: f64) {
        let StepContext { model, plan, tables, state, applied, tiles, work } = context;
        let layout = &tables.layout;
        let discs = self.discs.clone();
        let before_n = disc_forces_n(&self.forces_n);
        if self.pulls() {
            tiles.wake_under(self.points());
            let movable = discs.footprints.iter().zip(&before_n);
            for (footprint, force_n) in movable.filter(|(footprint, _)| footprint.relative_inverse_mass() > 0.0) {
                push(model, plan, layout, state, footprint, *force_n, plan.scheme.constant());
            }
        }
        let way_m = self.draw(plan.substep_s, more);
        let scale = plan.force_scale(&model.scene);
        let moves_m_per_n = plan.scheme.kick()[0] * scale * model.unit_m;
        let places_m = self.places_m(&|point| displacement_m(model, layout, state, point));
        let directions: Vec<DVec3> = places_m.windows(2).map(|pair| (pair[1] - pair[0]).normalize_or_zero()).collect();
        // As if the force of the last substep had ended as an impulse at this one's beginning.
        let without = |(disc, place_m): (usize, &DVec3)| {
            let moved = |(other, force_n): (usize, &DVec3)| discs.inverse_mass(disc, other) * *force_n;
            *place_m - moves_m_per_n * before_n.iter().enumerate().map(moved).sum::<DVec3>()
        };
        let without_m: Vec<DVec3> = places_m.iter().enumerate().map(without).collect();
        let forces_n = self.solve(moves_m_per_n, &without_m, &directions);
        for (sum_n, force_n) in self.tensions_n.iter_mut().zip(&forces_n) {
            // The sum of this step's substeps begins with the first.
            let earlier_n = if more + 1 == plan.substeps { 0.0 } else { *sum_n };
            *sum_n = earlier_n + force_n.length();
        }
        let pulled = self.pulls();
        self.forces_n = forces_n;
        work.add(self.work_j(way_m));
        if !pulled && !self.pulls() {
            return;
        }
        // Sleeping tiles were at rest in this substep, as if they had been computed.
        tiles.wake_under(self.points());
        let after_n = disc_forces_n(&self.forces_n);
        let [kick, constant] = [plan.scheme.kick(), plan.scheme.constant()];
        for ((footprint, before_n), after_n) in discs.footprints.iter().zip(before_n).zip(after_n) {
            // A disc on fixed points does not move.
            if footprint.relative_inverse_mass() == 0.0 {
                continue;
            }
            let kick_n = after_n - before_n;
            let most = scale * kick[0].max(kick[1]) * kick_n.abs().max_element();
            for WeightedNode { point, .. } in free(footprint).filter(|of| of.weight / of.mass * most > far) {
                tiles.wake_around(*point, plan.scheme.sweeps());
            }
            push(model, plan, layout, state, footprint, kick_n, kick);
            // Forces of other tools on these points also do work along this movement.
            if !applied.terms.is_empty() {
                let moved = scale * (kick[0] * kick_n + constant[0] * before_n);
                for WeightedNode { point, mass, weight, .. } in free(footprint) {
                    let movement = weight / mass * moved;
                    let done = applied.work_along(model, plan, layout, *point, movement.to_array());
                    work.add(done * plan.unit_of_work_j(model));
                }
            }
        }
    }
}

/// Returns the movable points of a disc.
fn free(footprint: &Footprint) -> impl Iterator<Item = &WeightedNode> {
    footprint.reached().iter().filter(|node| node.free)
}

#[cfg(test)]
mod tests;
