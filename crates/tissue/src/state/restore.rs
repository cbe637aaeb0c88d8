//! Saves the whole state of a tissue for a snapshot, and restores a tissue that continues bit for bit.
//!
//! Saving only copies memory, as a copy for readers does (`copy`). Restoring trusts nothing: it checks lengths,
//! indices, numbers and their consistency, and rebuilds all tables.

use std::sync::Arc;

use xxhash_rust::xxh3::Xxh3;

use crate::body::model::{Model, Plan};
use crate::body::severed::Cuts;
use crate::body::tables::springs_of;
use crate::interface::Tissue;
use crate::kernel::field::{Layout, State};
use crate::kernel::real::Real;
use crate::kernel::region::sides_of;
use crate::limits::Limits;
use crate::memory;
use crate::saved::{
    Checks, PlainTissue, SNAPSHOT, SavedBurnTimes, SavedBurns, SavedCheckpoint, SavedContact, SavedForces,
    SavedFracture, SavedInput, SavedPrescribed, SavedState, SavedTie, SavedTies, TissueParts, ensure, unsound,
};
use crate::scene::{Named, Precision};
use crate::state::guard::checkpoint::Checkpoint;
use crate::state::guard::work_account::WorkAccount;
use crate::state::guard::{INTERVAL_SUBSTEPS, MAX_HALVINGS};
use crate::state::sleep::tiles::TakenTiles;
use crate::state::tissue_state::TissueState;
use crate::tools::applied_force::Applied;
use crate::tools::burns::Burns;
use crate::tools::contact::Contacts;
use crate::tools::input::ToolInput;
use crate::tools::prescribed::Prescribed;
use palpate_refusal::{Reason, Refusal, Result};

/// Restores a tissue under its model, from its parts and the bytes of the values at its points
/// ([`PlainTissue`]). The next steps give the same bits as those of the tissue that was saved. `model` must be the one
/// of the parts, as rebuilt by [`Model::resumed`]; `limits` are those of forces and tools.
///
/// # Errors
/// Refuses a tissue of another model (other points, number format, scheme, substeps, coefficients or fingerprint:
/// [`Reason::WrongKind`]), values or parts that no session produces ([`Reason::OutOfRange`]), tools and forces above
/// the limits, and a tissue for which there is no memory. The field is [`SNAPSHOT`], or begins with it.
pub fn restored(model: &Arc<Model>, parts: &TissueParts, values: &[u8], limits: &Limits) -> Result<Box<dyn Tissue>> {
    fits(model, parts)?;
    memory::attempt(SNAPSHOT, || {
        Ok(match model.precision {
            Precision::F64 => Box::new(restored_as::<f64>(model, parts, values, limits)?) as Box<dyn Tissue>,
            Precision::Auto | Precision::F32 | Precision::Compensated => {
                Box::new(restored_as::<f32>(model, parts, values, limits)?)
            }
        })
    })
}

/// Refuses a tissue that was saved under another model.
fn fits(model: &Model, saved: &TissueParts) -> Result<()> {
    let refuse = |what: String| Err(Refusal::new(Reason::WrongKind, SNAPSHOT, what));
    if saved.points != model.len() as u64 {
        return refuse(format!("is of a tissue of {} points, but this one has {}", saved.points, model.len()));
    }
    let (own, other) = (model.saved_plan(), saved.tissue);
    if own.precision != other.precision {
        let (own, other) = (own.precision.name(), other.precision.name());
        return refuse(format!("is of a tissue in {other}, but this one is in {own}"));
    }
    if (own.integrator, own.substeps) != (other.integrator, other.substeps) {
        return refuse(format!(
            "is of a tissue stepped by {}, {} substeps a step, but this one is stepped by {}, {}",
            other.integrator.name(),
            other.substeps,
            own.integrator.name(),
            own.substeps
        ));
    }
    if own != other {
        return refuse(format!("is of a tissue with other coefficients: {other:?}, but this one has {own:?}"));
    }
    if saved.fingerprint != model.fingerprint() {
        return refuse("is of another scene: its points, masses, springs or step rate differ".to_owned());
    }
    Ok(())
}

impl Model {
    /// Returns the XXH3-128 hash of everything in the model that a step depends on: the points and their order in
    /// memory, masses, springs, coefficients, scheme, substeps, sleep tolerance and number format. Vector width and
    /// appearance do not count. Equal on every machine; it reads the whole mesh, so it takes time in proportion.
    pub fn fingerprint(&self) -> u128 {
        let mut hasher = Xxh3::new();
        let mut add = |bytes: &[u8]| hasher.update(bytes);
        add(b"palpate tissue 1");
        let scene = &self.scene;
        for number in [self.rows_of_points(), self.points[1], self.len(), self.fixed.len()] {
            add(&(number as u64).to_le_bytes());
        }
        self.fixed.iter().for_each(|index| add(&(*index as u64).to_le_bytes()));
        for value in [
            self.unit_m,
            scene.point_mass_kg(),
            scene.springs.stiffness_n_per_m,
            scene.springs.shear_stiffness_n_per_m,
            scene.anchor_stiffness_n_per_m,
            scene.damping_n_s_per_m,
            scene.stepping.rate_hz,
            self.plan.substep_s,
            self.prestrain,
            scene.cutting.toughness_j_per_m2,
            scene.cutting.thickness_m.unwrap_or(-1.0),
            self.sleep_tolerance,
        ] {
            add(&value.to_bits().to_le_bytes());
        }
        // A tissue that does not tear keeps the hash that it had before any could.
        for value in [scene.cutting.tear_strain, scene.cutting.tear_reference_m].into_iter().flatten() {
            add(&value.to_bits().to_le_bytes());
        }
        // So does one whose anchors can't be severed.
        if let Some(depth_m) = scene.cutting.anchor_depth_m {
            let direction = scene.cutting.anchor_direction.unwrap_or_default().to_array();
            [depth_m].into_iter().chain(direction).for_each(|value| add(&value.to_bits().to_le_bytes()));
        }
        // And one that burns do not make stiffer.
        let burnt_stiffness_factor = scene.cutting.burnt_stiffness();
        if burnt_stiffness_factor != 1.0 {
            add(b"burnt stiffness");
            add(&burnt_stiffness_factor.to_bits().to_le_bytes());
        }
        add(&[u8::from(scene.springs.bending)]);
        add(self.plan.integrator.name().as_bytes());
        add(&self.plan.substeps.to_le_bytes());
        add(self.precision.name().as_bytes());
        self.places.identify(scene, &mut add);
        hasher.digest128()
    }
}

/// A copy of a tissue, with values in one number format.
#[derive(Debug)]
pub(super) struct TypedState<T: Real> {
    pub(super) model: Arc<Model>,
    pub(super) layout: Layout,
    pub(super) steps: u64,
    pub(super) halvings: u32,
    pub(super) state: State<T>,
    pub(super) forces: SavedForces,
    pub(super) prescribed: SavedPrescribed,
    pub(super) contacts: Vec<SavedContact>,
    pub(super) ties: Vec<SavedTie>,
    pub(super) burns: Burns,
    pub(super) work: WorkAccount,
    pub(super) checkpoint: Option<Arc<Checkpoint<T>>>,
    pub(super) inputs: Vec<(u64, usize, ToolInput)>,
    pub(super) tiles: TakenTiles<T>,
    pub(super) cuts: Cuts,
    pub(super) guard_events: u64,
    pub(super) substeps_done: u64,
    pub(super) points_done: u64,
}

impl<T: Real> SavedState for TypedState<T> {
    fn plain(&self) -> PlainTissue {
        let checkpoint = self.checkpoint.as_ref().map(|checkpoint| SavedCheckpoint {
            steps: checkpoint.steps,
            halvings: checkpoint.halvings,
            forces: checkpoint.applied.saved(),
            prescribed: checkpoint.prescribed.saved(),
            contacts: checkpoint.contacts.saved(),
            work: checkpoint.work.saved(),
            largest: checkpoint.largest,
            passed_checks: checkpoint.passed_checks,
            severed: checkpoint.cuts.len() as u64,
        });
        let mut values = Vec::new();
        let mut put = |field: &[T]| {
            let from = values.len();
            values.resize(from + size_of_val(field), 0);
            values[from..].chunks_exact_mut(size_of::<T>()).zip(field).for_each(|(bytes, value)| value.write(bytes));
        };
        let states = [Some(&self.state), self.checkpoint.as_ref().map(|checkpoint| &checkpoint.state)];
        for state in states.into_iter().flatten() {
            for tile in &self.tiles.moved {
                state.fields().for_each(|field| rows_of(&self.layout, *tile).for_each(|row| put(&field[row])));
            }
        }
        put(&self.tiles.remembered);
        let inputs = self.inputs.iter().map(|(step, tool, input)| (*step, *tool as u64, input.saved()));
        let parts = TissueParts {
            points: self.model.len() as u64,
            tissue: self.model.saved_plan(),
            fingerprint: self.model.fingerprint(),
            steps: self.steps,
            halvings: self.halvings,
            forces: self.forces.clone(),
            prescribed: self.prescribed.clone(),
            contacts: self.contacts.clone(),
            work: self.work.saved(),
            checkpoint,
            inputs: inputs.collect(),
            tiles: self.tiles.plain(),
            severed: self.cuts.saved(),
            topology_version: self.cuts.version(),
            guard_events: self.guard_events,
            substeps_done: self.substeps_done,
            points_done: self.points_done,
            ties: SavedTies {
                now: self.ties.clone(),
                at_checkpoint: self.checkpoint.as_ref().map_or_else(Vec::new, |from| from.contacts.ties.saved()),
            },
            burns: SavedBurns {
                now: self.burns.saved(),
                at_checkpoint: self.checkpoint.as_ref().map_or_else(Vec::new, |from| from.contacts.burns.saved()),
            },
            burn_times: SavedBurnTimes {
                version: self.burns.version(),
                now_s: self.burns.saved_times(),
                at_checkpoint_s: self
                    .checkpoint
                    .as_ref()
                    .map_or_else(Vec::new, |from| from.contacts.burns.saved_times()),
            },
            fracture: SavedFracture {
                now_j: self.cuts.fracture_j(),
                at_checkpoint_j: self.checkpoint.as_ref().map_or(0.0, |from| from.cuts.fracture_j()),
            },
        };
        PlainTissue { parts, values }
    }
}

/// Returns where the values of a tile are in a field, row by row: those of x, then of y and z.
fn rows_of(layout: &Layout, tile: usize) -> impl Iterator<Item = std::ops::Range<usize>> + use<> {
    let Layout { stride, plane, .. } = *layout;
    let [rows, columns] = sides_of(layout, tile);
    (0..3).flat_map(move |c| {
        let columns = columns.clone();
        rows.clone().map(move |i| {
            let row = c * plane + i * stride;
            row + columns.start..row + columns.end
        })
    })
}

/// Returns the model's plan after `halvings` halvings of the substep.
fn halved(model: &Model, halvings: u32) -> Plan {
    if halvings == 0 { model.plan.clone() } else { model.plan.divided(&model.scene, 1 << halvings) }
}

fn restored_as<T: Real>(
    model: &Arc<Model>,
    parts: &TissueParts,
    values: &[u8],
    limits: &Limits,
) -> Result<TissueState<T>> {
    let checks = Checks { shape: model.shape(), limits };
    let mut sheet = TissueState::new(model);
    sheet.steps = checks.count(parts.steps)?;
    ensure(parts.halvings <= MAX_HALVINGS, "a substep shorter than the guard makes")?;
    sheet.halvings = parts.halvings;
    sheet.plan = halved(model, parts.halvings);
    sheet.tables.springs = springs_of(model, &sheet.plan);
    sheet.guard_events = checks.count(parts.guard_events)?;
    // Points times substeps may exceed the limit of steps.
    ensure(parts.substeps_done.max(parts.points_done) < u64::MAX / 4, "a count beyond what any session has")?;
    (sheet.substeps_done, sheet.points_done) = (parts.substeps_done, parts.points_done);

    let layout = sheet.tables.layout;
    let scale = sheet.plan.force_scale(&model.scene);
    sheet.applied = Applied::restored(&parts.forces, model, &layout, scale, &checks)?;
    sheet.prescribed = Prescribed::restored(&parts.prescribed, model, T::LARGEST * model.unit_m, &checks)?;
    sheet.contacts = Contacts::restored((&parts.contacts, &parts.ties.now), model, &checks)?;
    let SavedBurnTimes { version, now_s, .. } = &parts.burn_times;
    sheet.contacts.burns = Burns::restored(&parts.burns.now, now_s, *version, model)?;
    sheet.work = WorkAccount::restored(&parts.work)?;
    sheet.tiles.restore(&parts.tiles)?;
    let fracture_j = checks.number(parts.fracture.now_j)?;
    let cuts = Cuts::restored(&parts.severed, parts.topology_version, fracture_j, model)?;
    let cuts = cuts.burnt_by(sheet.contacts.burns.stiffness(model));
    sheet.tables.set_severed(model, &cuts);
    sheet.follow_cuts();

    let size = size_of::<T>();
    ensure(values.len().is_multiple_of(size), "part of a value")?;
    let mut values = values.chunks_exact(size).map(T::read);
    let moved: Vec<usize> = parts.tiles.moved.iter().map(|tile| *tile as usize).collect();
    // This bound is far beyond what the guard allows a point in an interval. The guard finds an impossible state at the
    // next step.
    let most = T::of(T::LARGEST);
    let mut fill = |state: &mut State<T>| -> Result<bool> {
        let mut any = false;
        for tile in &moved {
            for field in state.fields_mut() {
                for row in rows_of(&layout, *tile) {
                    for value in &mut field[row] {
                        *value = values.next().ok_or_else(|| unsound("too few values"))?;
                        ensure(value.magnitude() < most, "a value that is not finite or out of range")?;
                        any |= *value != T::default();
                    }
                }
            }
        }
        Ok(any)
    };
    let mut state = State::zero(&layout, sheet.state.kept.len());
    let is_moved = fill(&mut state)?;
    sheet.state = state;
    // Computes what each tile adds to the volume; sleeping tiles are not added up again later.
    let tiles: Vec<usize> = (0..sheet.tiles.tile_count()).collect();
    sheet.tables.volume_change(&sheet.state.u, &tiles);
    let has_place = parts.checkpoint.is_some() || parts.ties.at_checkpoint.is_empty();
    ensure(has_place, "threads or clips of a state to go back to that is none")?;
    let checkpoint = parts.checkpoint.as_ref().map(|saved| {
        let mut state = State::zero(&layout, sheet.state.kept.len());
        fill(&mut state)?;
        checkpoint_of(&sheet, parts, saved, state, &checks)
    });
    sheet.checkpoint = checkpoint.transpose()?.map(Arc::new);
    sheet.tiles.remember_again(&mut values)?;
    ensure(values.next().is_none(), "too many values")?;

    let from = sheet.checkpoint.as_ref().map_or(sheet.steps, |checkpoint| checkpoint.steps);
    for (step, tool, input) in &parts.inputs {
        ensure((from..=sheet.steps).contains(step), "an input at a step before its checkpoint or after its end")?;
        let number = if matches!(input, SavedInput::Tie(_)) { checks.tie(*tool)? } else { checks.tool(*tool)? };
        sheet.inputs.push((*step, number, ToolInput::restored(input, model, &checks)?));
    }
    ensure(sheet.inputs.is_sorted_by_key(|input| input.0), "inputs out of order")?;
    if sheet.checkpoint.is_none() {
        // A moving tissue has a state to go back to, from its first input on.
        let is_idle = sheet.is_at_rest() || !is_moved && sheet.applied.is_settled() && sheet.contacts.is_empty();
        ensure(is_idle && sheet.prescribed.is_empty() && sheet.inputs.is_empty(), "no state to go back to")?;
        sheet.state.share_equal_history(sheet.plan.scheme.history());
    }
    Ok(sheet)
}

fn checkpoint_of<T: Real>(
    tissue: &TissueState<T>,
    parts: &TissueParts,
    saved: &SavedCheckpoint,
    state: State<T>,
    checks: &Checks<'_>,
) -> Result<Checkpoint<T>> {
    let (model, layout) = (&tissue.model, &tissue.tables.layout);
    let is_recent = saved.steps <= tissue.steps && tissue.steps - saved.steps <= INTERVAL_SUBSTEPS;
    ensure(is_recent, "a state to go back to that is too old")?;
    ensure(saved.halvings <= MAX_HALVINGS, "a substep shorter than the guard makes")?;
    ensure((0.0..f64::INFINITY).contains(&saved.largest), "a displacement that is not finite")?;
    let severed = usize::try_from(saved.severed).unwrap_or(usize::MAX);
    ensure(severed <= tissue.tables.severed.len(), "more severed springs in its checkpoint than now")?;
    let scale = halved(model, saved.halvings).force_scale(&model.scene);
    let fracture_j = checks.number(parts.fracture.at_checkpoint_j)?;
    let cuts = tissue.tables.severed.first(severed, fracture_j, model);
    let mut contacts = Contacts::restored((&saved.contacts, &parts.ties.at_checkpoint), model, checks)?;
    let SavedBurnTimes { version, at_checkpoint_s, .. } = &parts.burn_times;
    contacts.burns = Burns::restored(&parts.burns.at_checkpoint, at_checkpoint_s, *version, model)?;
    let cuts = cuts.burnt_by(contacts.burns.stiffness(model));
    let mut applied = Applied::restored(&saved.forces, model, layout, scale, checks)?;
    contacts.follow_cuts(model, cuts.copies());
    if let Some(copies) = cuts.copies() {
        applied.follow_cuts(model, layout, copies);
    }
    Ok(Checkpoint {
        steps: saved.steps,
        halvings: saved.halvings,
        state,
        applied,
        prescribed: Prescribed::restored(&saved.prescribed, model, T::LARGEST * model.unit_m, checks)?,
        contacts,
        work: WorkAccount::restored(&saved.work)?,
        largest: saved.largest,
        passed_checks: saved.passed_checks,
        cuts,
    })
}
