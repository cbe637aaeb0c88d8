//! The physics of sleep: when tiles may sleep, and when changes of the tools' forces wake them. `tiles` keeps
//! the sets.

use crate::guard::survey::{Forces, Survey, Write};
use crate::interface::Energy;
use crate::kernel::real::Real;
use crate::scene::Precision;
use crate::scene::profile::Moment;
use crate::scheme::Oscillator;
use crate::scheme::stability;
use crate::state::tissue_state::TissueState;

impl<T: Real> TissueState<T> {
    /// Wakes tiles on which the tools' force changes in the next step.
    pub(crate) fn wake_what_is_pushed(&mut self) {
        let TissueState { model, applied, tiles, steps, .. } = self;
        let spacing_m = model.unit_m;
        for change in applied.changes(model, *steps) {
            // A force moves its centre at least as far as if all springs held the centre.
            let heaviest = model.places.largest_mass();
            let stiffness = model.omega_bound_per_s.powi(2) * model.scene.point_mass_kg() * heaviest;
            if stiffness > 0.0 {
                tiles.largest = tiles.largest.max(change.peak_n() / (stiffness * spacing_m));
            }
            let least_n = model.scene.anchor_stiffness_n_per_m * tiles.wake_threshold(&model.scene) * spacing_m;
            tiles.pushed(&change, spacing_m, least_n);
        }
    }

    /// Wakes tiles around grasped points that tools move by more than `far` spacings in the substep from
    /// `moment` to the fraction `end` of the step. The points beside a sleeping tile are compared only between
    /// substeps (`tiles`): a scheme of several sweeps would pull at it where the tool was before.
    pub(crate) fn wake_what_is_moved(&mut self, moment: Moment, end: f64, far: f64) {
        let TissueState { model, plan, tables, state, prescribed, tiles, .. } = self;
        for (index, displacement_m, _) in prescribed.at(model, moment.step, end) {
            let at = tables.layout.offset(index);
            let moves = |c: usize| displacement_m[c] / model.unit_m - state.u[c * tables.layout.plane + at].wide();
            if (0..3).any(|c| moves(c).abs() > far) {
                tiles.wake_around(model.point_of(index), plan.scheme.sweeps());
            }
        }
    }

    /// Returns the energies of the whole tissue: the awake part, and the springs and anchor springs of sleeping
    /// tiles. The latter follow from the positions of their points alone, so it does not matter when they were
    /// computed.
    pub(crate) fn energies(&self) -> Energy {
        let TissueState { plan, tables, state, tiles, .. } = self;
        let (_, mut energy, _) = self.survey(&tiles.region);
        let forces = Forces { terms: &[], field: 0, part: 1.0, pull: 0.0 };
        let mut region = tiles.no_region();
        for (tile, known) in tiles.sleeping() {
            let [spring_j, anchor_j] = known.unwrap_or_else(|| {
                // With the pressure under which the tile rests, which does not change while it sleeps.
                tables.apply_volume_pressure(tiles.volume_change_then(tile));
                tiles.cover(&mut region, std::iter::once(tile));
                let survey = Survey::of(tables, &plan.scheme, state, forces, &region);
                let (Energy { spring_j, anchor_j, .. }, _) = self.energy_of(&survey);
                tiles.keep_energies(tile, [spring_j, anchor_j]);
                [spring_j, anchor_j]
            });
            energy.spring_j += spring_j;
            energy.anchor_j += anchor_j;
        }
        energy
    }

    /// Puts calm tiles to sleep.
    pub(crate) fn put_to_sleep(&mut self) {
        if !self.tiles.may_sleep() || self.tiles.region.tiles().is_empty() {
            return;
        }
        let volume_change = self.apply_volume_pressure();
        let TissueState { model, plan, tables, state, tiles, prescribed, contacts, applied, .. } = self;
        let spacing_m = model.unit_m;
        // Tiles under a tool that holds or touches stay awake.
        let grasped = prescribed.grasped().map(|(index, _)| model.point_of(index));
        let held: Vec<usize> = grasped.chain(contacts.points()).map(|point| tiles.of(point)).collect();
        for (_, motion) in prescribed.grasped() {
            tiles.largest = tiles.largest.max(motion.displacement_m.length() / spacing_m);
        }
        // In the scheme's units of force and velocity.
        let sheet = Oscillator::of(&model.scene);
        let (anchor_stiffness, drag) = sheet.scaled(plan.substep_s);
        // A displacement is known to half its last digit. The spring force that this rounding causes moves
        // nothing: it differs from point to point, and a point between its neighbours yields by as little. Nor
        // does a substep move anything by less than that digit, unless the scheme keeps the rounding error.
        // (Without anchor springs all of it may matter.)
        let half_digit = if anchor_stiffness > 0.0 { 0.5 * T::EPSILON } else { 0.0 };
        let creep = if model.precision == Precision::Compensated { 0.0 } else { half_digit };
        let rough =
            Oscillator { spring_stiffness_n_per_m: stability::approximate_stiffness_n_per_m(&model.scene), ..sheet };
        let unknown = half_digit * rough.scaled_spring_stiffness(plan.substep_s) + creep * drag;
        let creep = creep * tiles.largest;
        let slow = |epsilon: f64| (epsilon * anchor_stiffness.sqrt()).max(creep);
        let settled = tiles.quiescent_tiles(&state.u, &state.d, slow);
        let epsilon = tiles.epsilon();
        let scale = plan.scheme.spring_scale();
        let forces = Forces {
            terms: &applied.terms,
            field: plan.scheme.last_field(),
            part: scale / plan.scheme.impulse(),
            pull: anchor_stiffness * scale,
        };
        // Where K″ is smaller, the same imbalance moves a point farther.
        let least = anchor_stiffness * (1.0 + model.places.least_extra_anchor());
        let balanced = |survey: &Survey| survey.imbalance <= scale * (epsilon * least + unknown * survey.largest);
        let mut region = tiles.no_region();
        let mut sleepers = Vec::new();
        for tile in settled.into_iter().filter(|tile| !held.contains(tile)) {
            tiles.cover(&mut region, std::iter::once(tile));
            let survey = Survey::of(tables, &plan.scheme, state, forces, &region);
            if tiles.is_settled(tile, survey.speed <= slow(epsilon) && balanced(&survey)) {
                sleepers.push((tile, survey));
            }
        }
        if sleepers.is_empty() {
            return;
        }
        tiles.cover(&mut region, sleepers.iter().map(|(tile, _)| *tile));
        Survey::write(tables, &plan.scheme, state, forces, &region, Write::Rest);
        let sleepers: Vec<_> = sleepers.into_iter().map(|(tile, survey)| (tile, self.energy_of(&survey).1)).collect();
        // Their contribution to the volume is summed up for the last time.
        self.tables.volume_change(&self.state.u, self.tiles.region.tiles());
        self.tiles.sleep(&sleepers, &self.state.u, volume_change);
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use crate::shape::PointId;
    use glam::DVec3;

    use super::*;
    use crate::scene::profile::Poke;
    use crate::sleep::tiles::CHECK_STEPS;
    use crate::{Grasp, Model, Push, Tissue};

    fn pushed<T: Real>(sets: &[&str], falloff_per_m: f64) -> TissueState<T> {
        let always = ["stepping.integrator=central", "stepping.substeps=1"];
        let model = Model::paper(&[&always[..], sets].concat());
        let mut sheet = TissueState::new(&model);
        let centre_m = model.scene.sheet().unwrap().spacing_m * DVec3::new(1.0, 1.0, 0.0);
        let force_n = DVec3::new(0.0, 0.0, -1.0);
        sheet
            .push(0, Some(Push::Constant(Poke { point: None, centre_m, force_n, falloff_per_m, falloff_offset: 0.0 })));
        sheet
    }

    #[test]
    fn a_force_moves_its_centre_no_less_than_if_all_springs_held_it() {
        let mut sheet = pushed::<f64>(&["sheet.points=[20, 20]", "stepping.precision=f64"], 1000.0);
        sheet.step().unwrap();
        // The fastest vibration of a sheet without bending springs is as stiff as 12 k + K″ (`stability`).
        let expected_m = 1.0 / (12.0 * 10.0 + 5.0);
        let found_m = sheet.tiles.largest * sheet.model.scene.sheet().unwrap().spacing_m;
        assert!((found_m - expected_m).abs() < 1e-9, "{found_m} {expected_m}");
    }

    #[test]
    fn a_sheet_falls_asleep_under_a_force_as_soon_as_its_format_can_tell_no_difference() {
        // Overdamped: it creeps until the increment is less than half the last digit.
        let overdamped = ["damping.coefficient_n_s_per_m=50.0", "anchor_springs.stiffness_n_per_m=500.0"];
        let small = ["springs.stiffness_n_per_m=0.0", "sheet.points=[3, 3]", "stepping.precision=f32"];
        let mut sheet = pushed::<f32>(&[&overdamped[..], &small, &["sleep.tolerance=1e-9"]].concat(), 0.0);
        for _ in 0..1000 {
            sheet.step().unwrap();
        }
        assert!(!sheet.is_still());
        for _ in 0..2000 {
            sheet.step().unwrap();
        }
        assert!(sheet.is_still());
        let z_m = sheet.point(PointId::new(4)).displacement_m.z;
        assert!((z_m + 1.0 / 500.0).abs() < 1e-5 / 500.0, "{z_m}");
    }

    #[test]
    fn a_grasped_point_counts_among_the_displacements_that_a_sleeping_tile_is_measured_by() {
        // Nothing else moves: the tools' points are seen wherever they are.
        let sets = ["sheet.points=[20, 20]", "stepping.precision=f64", "springs.stiffness_n_per_m=0.0"];
        let sets = [&sets[..], &["stepping.integrator=central", "stepping.substeps=1"]].concat();
        let model = Model::paper(&sets);
        for [i, j] in [[3, 5], [7, 11], [12, 14], [18, 9]] {
            let mut sheet = TissueState::<f64>::new(&model);
            let point = model.scene.sheet().unwrap().point([i, j]);
            sheet.grasp(0, point, Grasp::Target(DVec3::new(0.0, 0.03, -0.04)));
            while sheet.steps == 0 || !sheet.steps.is_multiple_of(CHECK_STEPS) {
                sheet.step().unwrap();
            }
            let found_m = sheet.tiles.largest * model.unit_m;
            assert!((0.045..0.055).contains(&found_m), "{i} {j}: {found_m} m");
        }
    }
}
