//! The physics of sleep: when tiles may sleep, when forces, grasped points and pressure wake them, and the energies of
//! sleeping tiles. `tiles` keeps the sets.

use crate::body::model::{Model, Plan};
use crate::body::tables::SweepTables;
use crate::interface::Energy;
use crate::kernel::field::State;
use crate::kernel::real::Real;
use crate::scene::Precision;
use crate::scheme::stability;
use crate::scheme::{Coefficients, Oscillator, Relaxation};
use crate::state::guard::survey::{Forces, Survey, Write, energy_of};
use crate::state::sleep::tiles::{CHECK_STEPS, SleepTiles};
use crate::state::step_context::StepContext;
use crate::tools::applied_force::Applied;
use crate::tools::contact::Contacts;
use crate::tools::prescribed::Prescribed;

/// Returns the factor by which the recent largest displacement decays from one check of the tiles to the next: by a hundredth, or
/// slower than a tissue with branches creeps back, which would otherwise stay as large as its memory.
fn forget(relaxation: &Relaxation, rate_hz: f64) -> f64 {
    const USUAL: f64 = 0.99;
    const TIMES_CREEP: f64 = 8.0;
    let creep_s = TIMES_CREEP * relaxation.creep_s();
    let check_s = CHECK_STEPS as f64 / rate_hz;
    if creep_s > 0.0 { USUAL.max(libm::exp(-check_s / creep_s)) } else { USUAL }
}

/// Wakes tiles on which the tools' force changes in step `step`.
pub(crate) fn wake_pushed<T: Real>(tiles: &mut SleepTiles<T>, model: &Model, applied: &mut Applied<T>, step: u64) {
    let spacing_m = model.unit_m;
    for change in applied.changes(model, step) {
        // A force moves its centre at least as far as if all springs held the centre.
        let heaviest = model.places.largest_mass();
        let stiffness = model.omega_bound_per_s.powi(2) * model.scene.point_mass_kg() * heaviest;
        if stiffness > 0.0 {
            tiles.largest = tiles.largest.max(change.peak_n() / (stiffness * spacing_m));
        }
        let least_n =
            tiles.relaxation(&model.scene).restoring_n_per_m() * tiles.wake_threshold(&model.scene) * spacing_m;
        tiles.pushed(&change, spacing_m, least_n);
    }
}

/// Wakes tiles around grasped points that tools move by more than `far` spacings until the fraction `end` of step
/// `step`. Sleeping tiles compare their neighbours only between substeps (`tiles`). Without this, later sweeps of the
/// substep would use the tool's old position.
pub(crate) fn wake_moved<T: Real>(
    context: &mut StepContext<'_, T>,
    prescribed: &Prescribed,
    step: u64,
    end: f64,
    far: f64,
) {
    let StepContext { model, plan, tables, state, tiles, .. } = context;
    for (index, displacement_m, _) in prescribed.at(model, step, end) {
        let at = tables.layout.offset(index);
        let moves = |c: usize| displacement_m[c] / model.unit_m - state.u[c * tables.layout.plane + at].wide();
        if (0..3).any(|c| moves(c).abs() > far) {
            tiles.wake_around(model.point_of(index), plan.scheme.sweeps());
        }
    }
}

/// Adds the energies of springs and anchor springs in the sleeping tiles, J. They follow from the positions of their
/// points alone, so it does not matter when they were computed.
pub(crate) fn add_sleeping<T: Real>(
    energy: &mut Energy,
    model: &Model,
    plan: &Plan,
    tables: &SweepTables<T>,
    state: &State<T>,
    tiles: &SleepTiles<T>,
) {
    let forces = Forces { terms: &[], field: 0, part: 1.0, pull: 0.0 };
    let mut region = tiles.no_region();
    for (tile, known) in tiles.sleeping() {
        let [spring_j, anchor_j] = known.unwrap_or_else(|| {
            // With the pressure at which the tile fell asleep, which it rests under.
            tables.apply_volume_pressure(tiles.volume_change_then(tile));
            tiles.cover(&mut region, std::iter::once(tile));
            let survey = Survey::of(tables, &plan.scheme, state, forces, &region);
            let (Energy { spring_j, anchor_j, .. }, _) = energy_of(model, plan, &survey);
            tiles.keep_energies(tile, [spring_j, anchor_j]);
            [spring_j, anchor_j]
        });
        energy.spring_j += spring_j;
        energy.anchor_j += anchor_j;
    }
}

/// Wakes tiles that the pressure of an enclosed volume has moved by more than `far` spacings since they fell asleep.
///
/// There is one pressure for the whole mesh. A tile falls asleep in balance with the pressure of that moment. It wakes
/// when the pressure has changed so much since then that one of its points would move by more than it may (`tiles`), as
/// for a change of the tools' force. Until it wakes, its contribution to the volume stays the same. Its own
/// omitted movement would change the pressure back a little; that error is within the same bound.
pub(crate) fn wake_pressed<T: Real>(tiles: &mut SleepTiles<T>, model: &Model, volume_change: f64, far: f64) {
    let Some(volume) = model.places.volume() else { return };
    let stiffness = model.scene.volume_stiffness_pa * volume.stretch_m;
    let least = far * tiles.relaxation(&model.scene).restoring_n_per_m();
    tiles.wake_pressed(volume_change, &volume.reaches, stiffness, least);
}

/// Puts calm tiles to sleep, under the pressure that belongs to `volume_change`.
pub(crate) fn put_to_sleep<T: Real>(
    context: &mut StepContext<'_, T>,
    prescribed: &Prescribed,
    contacts: &Contacts,
    volume_change: f64,
) {
    let StepContext { model, plan, tables, state, tiles, applied, .. } = context;
    let spacing_m = model.unit_m;
    // Tiles under a tool that holds or touches stay awake.
    let grasped = prescribed.grasped().map(|(index, _)| model.point_of(index));
    let held: Vec<usize> = grasped.chain(contacts.points()).map(|point| tiles.of(point)).collect();
    for (_, motion) in prescribed.grasped() {
        tiles.largest = tiles.largest.max(motion.displacement_m.length() / spacing_m);
    }
    // In the scheme's units of force and velocity: the anchor springs, drag, and the stiffness that pulls a point back.
    let sheet = Oscillator::of(&model.scene);
    let Coefficients { anchor: anchor_stiffness, damping: drag, .. } = sheet.scaled(plan.substep_s);
    let relaxation = tiles.relaxation(&model.scene);
    let restoring = relaxation.scaled(plan.substep_s);
    // A displacement is known to half its last digit. The spring force that this rounding causes moves
    // nothing: it differs from point to point, and a point between its neighbours yields by as little. Nor
    // does a substep move anything by less than that digit, unless the scheme keeps the rounding error.
    // (Where nothing pulls a point back, all of it may matter.)
    let half_digit = if restoring > 0.0 { 0.5 * T::EPSILON } else { 0.0 };
    let creep = if model.precision == Precision::Compensated { 0.0 } else { half_digit };
    let rough =
        Oscillator { spring_stiffness_n_per_m: stability::approximate_stiffness_n_per_m(&model.scene), ..sheet };
    let unknown = half_digit * rough.scaled_spring_stiffness(plan.substep_s) + creep * drag;
    let creep = creep * tiles.largest;
    let slow = |epsilon: f64| (epsilon * restoring.sqrt()).max(creep);
    let settled = tiles.quiescent_tiles(&state.u, &state.d, forget(&relaxation, model.scene.stepping.rate_hz), slow);
    // A solid with cuts sleeps as a whole (`state::step`).
    let is_cut = tables.severed.copies().is_some();
    if is_cut && (settled.len() < tiles.region.tiles().len() || !held.is_empty()) {
        return;
    }
    let epsilon = tiles.epsilon();
    let scale = plan.scheme.spring_scale();
    let forces = Forces {
        terms: &applied.terms,
        field: plan.scheme.last_field(),
        part: scale / plan.scheme.impulse(),
        pull: anchor_stiffness * scale,
    };
    // Where K″ is smaller, the same imbalance moves a point farther.
    let least = restoring * (1.0 + model.places.least_extra_anchor());
    let balanced = |survey: &Survey| survey.imbalance <= scale * (epsilon * least + unknown * survey.largest);
    let mut region = tiles.no_region();
    if is_cut {
        // One survey tells of all, and of the energy, which the first tile stands for.
        tiles.cover(&mut region, settled.iter().copied());
        let survey = Survey::of(tables, &plan.scheme, state, forces, &region);
        let is_calm = survey.speed <= slow(epsilon) && balanced(&survey);
        let may_sleep = settled.iter().map(|tile| tiles.is_settled(*tile, is_calm)).filter(|settled| *settled).count();
        if may_sleep == settled.len() {
            Survey::write(tables, &plan.scheme, state, forces, &region, Write::Rest);
            let energy_j = energy_of(model, plan, &survey).1;
            let sleepers: Vec<_> =
                settled.iter().enumerate().map(|(at, tile)| (*tile, if at == 0 { energy_j } else { 0.0 })).collect();
            tiles.sleep(&sleepers, &state.u, volume_change);
        }
        return;
    }
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
    let sleepers: Vec<_> =
        sleepers.into_iter().map(|(tile, survey)| (tile, energy_of(model, plan, &survey).1)).collect();
    // Their contribution to the volume is summed up for the last time.
    tables.volume_change(&state.u, tiles.region.tiles());
    tiles.sleep(&sleepers, &state.u, volume_change);
}
