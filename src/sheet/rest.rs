//! How a sheet puts tiles to sleep, and what wakes them: the physics of `tiles`.

use super::choice;
use super::integrate::Oscillator;
use super::real::Real;
use super::survey::{Forces, Survey, Write};
use super::tiles::Region;
use super::{Model, Sheet, central, exponential, rk4};

/// The tolerance of a model's tiles. Motion in the last digits never ends: what rounding is expected to do anyway counts as
/// rest. Without virtual springs nothing bounds how far a force left out would move a sheet: then only what does not move
/// at all may sleep.
pub(super) fn tolerance(model: &Model) -> f64 {
    let given = model.sleep_tolerance;
    if model.scene.virtual_stiffness_n_per_m > 0.0 && given > 0.0 {
        given.max(4.0 * choice::rounding(model.precision, &Oscillator::of(&model.scene), model.plan.substep_s))
    } else {
        given.min(f64::MIN_POSITIVE)
    }
}

impl<T: Real> Sheet<T> {
    /// ε_w, spacings.
    pub(super) fn farthest_unnoticed(&self) -> f64 {
        let epsilon = self.tiles.epsilon();
        let scene = &self.model.scene;
        let ratio = scene.virtual_stiffness_n_per_m / scene.springs.stiffness_n_per_m;
        // Without springs nothing passes from tile to tile.
        if ratio.is_nan() { epsilon } else { epsilon * (20.0 * ratio).clamp(0.1, 1.0) }
    }

    /// Wakes tiles whose force changes in the coming step.
    pub(super) fn wake_what_is_pushed(&mut self) {
        let spacing_m = self.model.scene.sheet.spacing_m;
        for touch in self.applied.changes(&self.model, self.steps) {
            // No force moves its centre less than if all springs held it.
            let stiffness = self.model.omega_bound_per_s.powi(2) * self.model.scene.sheet.point_mass_kg;
            if stiffness > 0.0 {
                self.tiles.largest = self.tiles.largest.max(touch.peak_n() / (stiffness * spacing_m));
            }
            let least_n = self.model.scene.virtual_stiffness_n_per_m * self.farthest_unnoticed() * spacing_m;
            self.tiles.pushed(&touch, spacing_m, least_n);
        }
    }

    /// Puts tiles that are calm to sleep.
    pub(super) fn rest(&mut self) {
        if !self.tiles.may_sleep() || self.tiles.awake.is_empty() {
            return;
        }
        let Sheet { model, plan, bench, state, tiles, prescribed, contacts, applied, .. } = self;
        let spacing_m = model.scene.sheet.spacing_m;
        // What a tool holds or touches goes on being computed.
        let grasped = prescribed.grasped().map(|(index, _)| model.point_of(index));
        let held: Vec<usize> = grasped.chain(contacts.points()).map(|point| tiles.of(point)).collect();
        for (_, motion) in prescribed.grasped() {
            tiles.largest = tiles.largest.max(motion.displacement_m.length() / spacing_m);
        }
        // In the scheme's units: of forces, and of velocities.
        let pull =
            model.scene.virtual_stiffness_n_per_m * plan.substep_s * plan.substep_s / model.scene.sheet.point_mass_kg;
        let slow = |epsilon: f64| epsilon * pull.sqrt();
        let calm = tiles.glance(&state.u, &state.d, slow);
        let epsilon = tiles.epsilon();
        let scale = plan.scheme.spring_scale();
        let forces = Forces {
            terms: &applied.terms,
            field: plan.scheme.last_field(),
            part: scale / plan.scheme.impulse(),
            pull: pull * scale,
        };
        let mut region = Region::default();
        let mut sleepers = Vec::new();
        for tile in calm.into_iter().filter(|tile| !held.contains(tile)) {
            tiles.region_of_one(tile, &mut region);
            let survey = with_scheme!(plan, T, |scheme| Survey::of(bench, scheme, state, forces, &region));
            if tiles.is_calm(tile, survey.speed <= slow(epsilon) && survey.imbalance <= epsilon * pull * scale) {
                sleepers.push((tile, survey));
            }
        }
        if sleepers.is_empty() {
            return;
        }
        let region = tiles.region_of(sleepers.iter().map(|(tile, _)| *tile));
        with_scheme!(plan, T, |scheme| Survey::write(bench, scheme, state, forces, &region, Write::Rest));
        let sleepers: Vec<_> = sleepers.into_iter().map(|(tile, survey)| (tile, self.energy_of(&survey).1)).collect();
        self.tiles.sleep(&sleepers, &self.state.u);
    }
}
