//! The buffers and tables of a tissue's sweeps, and the calls that run a sweep at the machine's vector width.
#![allow(unsafe_code)]

use std::cell::RefCell;
use std::sync::Arc;

use crate::body::Places;
use crate::body::advance::AdvanceStage;
use crate::body::burnt_stiffness::BurntStiffness;
use crate::body::footprint::mass_at;
use crate::body::force_field::{self, Pull, Term};
use crate::body::model::{Model, Plan};
use crate::body::severed::{Cuts, Severed, SeveredSpring};
use crate::body::sheet::cuts::SheetCuts;
use crate::body::sheet::grid::Grid;
use crate::body::sheet::sweep::Sweep;
use crate::body::solid::corner_copies::DoubledCorner;
use crate::body::solid::{self, NeoHookean, PointLoad, SolidGrid, SolidPlaces, SolidSweep, SolidTables};
use crate::body::spring_ends::{SHEET_ENDS, SpringEnd};
use crate::body::surface::pressure::{Pressure, push_of};
use crate::body::surface::{self, MeshGrid, MeshPlaces, MeshSprings, MeshSweep, Snapshot};
use crate::kernel::field::{BLOCK, Field, Layout, State};
use crate::kernel::lanes::{self, Scalar, SingleWork, Vector, Width};
use crate::kernel::real::Real;
use crate::kernel::region::Region;
use crate::kernel::springs::{ENDS, SpringCoefficients, Springs};
use crate::kernel::stage::Stage;
use crate::scheme::arithmetic::{Arithmetic, MAX_KEPT};

/// Number of tool forces that need no heap memory.
const FEW: usize = 4;

/// The springs of a tissue, with forces in a scheme's units.
#[derive(Debug, Clone)]
pub(crate) enum Elastic<T> {
    /// A sheet: its springs, and the factor of the extra anchor stiffness.
    Sheet(Springs<T>, T),
    /// A mesh: its places; a spring of length 1 with the reference k, of which those of the mesh are multiples;
    /// the factor of the extra anchor stiffness; and the factor of the growth of a volume.
    Mesh(Arc<MeshPlaces>, SpringCoefficients<T>, T, f64),
    /// A solid: its places, the law of its cubes, and what else acts on its points.
    Solid(Arc<SolidPlaces>, NeoHookean<T>, PointLoad<T>),
}

impl<T: Real> Elastic<T> {
    /// Returns the force of all whole springs, of the extra anchor stiffness and of the pressure on a point, divided
    /// by its relative mass. For a few single points. `volume_change` is the growth of the volume.
    pub(crate) fn gather(
        &self,
        severed: &Severed,
        layout: &Layout,
        u: &[T],
        volume_change: f64,
        point: [usize; 2],
    ) -> [T; 3] {
        lanes::single(&Gathering { springs: self, severed, layout, u, volume_change, point })
    }

    /// Returns what [`Elastic::gather`] does, within [`lanes::single`].
    #[inline(always)]
    pub(crate) fn gather_inline(
        &self,
        severed: &Severed,
        layout: &Layout,
        u: &[T],
        volume_change: f64,
        point: [usize; 2],
    ) -> [T; 3] {
        match self {
            Elastic::Sheet(springs, pull) => {
                let place = point[0] * layout.columns + point[1];
                let first = SHEET_ENDS * place;
                let mut force = springs.gather(layout, u, point, |number, [i, j]| {
                    severed.factor(first + number, [place, i * layout.columns + j])
                });
                if severed.anchor_count() > 0 {
                    let pull = Scalar(*pull * T::of(severed.extra_anchor(0.0, place)));
                    for c in 0..3 {
                        force[c] = Scalar(force[c]).minus(pull, Scalar(u[c * layout.plane + layout.offset(place)])).0;
                    }
                }
                force
            }
            Elastic::Solid(places, law, load) => {
                let copies = severed.copies().map(|copies| &**copies);
                solid::gather(places, copies, law, load, layout, u, point[0] * layout.columns + point[1])
            }
            Elastic::Mesh(places, unit, pull, factor) => {
                let slot = point[0] * BLOCK + point[1];
                let pressed = places.volume.as_ref().map(|volume| {
                    (push_of(*factor, volume_change), volume.over_mass(&places.slots, slot).to_array().map(T::of))
                });
                let first = places.slots.first_half(slot);
                let of_model = places.slots.extra_of(slot).or((severed.anchor_count() > 0).then_some(0.0));
                let pull = (*pull, of_model.map(|of_model| severed.extra_anchor(of_model, slot)));
                let factor = |number: usize, other: usize| severed.factor(first + number, [slot, other]);
                surface::gather(&places.slots, unit, pull, pressed, u, slot, factor)
            }
        }
    }
}

/// The gathering of the force on one point.
struct Gathering<'a, T> {
    springs: &'a Elastic<T>,
    severed: &'a Severed,
    layout: &'a Layout,
    u: &'a [T],
    volume_change: f64,
    point: [usize; 2],
}

impl<T: Real> SingleWork for Gathering<'_, T> {
    type Output = [T; 3];

    #[inline(always)]
    fn compute(&self) -> [T; 3] {
        self.springs.gather_inline(self.severed, self.layout, self.u, self.volume_change, self.point)
    }
}

/// Returns the springs of a model in the units of a plan.
pub(crate) fn springs_of<T: Real>(model: &Model, plan: &Plan) -> Elastic<T> {
    let unit = plan.substep_s * plan.substep_s / model.scene.point_mass_kg() * plan.scheme.spring_scale();
    match &model.places {
        Places::Sheet(_) => Elastic::Sheet(
            Springs::new(&model.scene.springs, model.prestrain, unit),
            T::of(unit * model.scene.anchor_stiffness_n_per_m),
        ),
        Places::Solid(places) => {
            let (stiffness, [shear, lame]) = (unit * model.scene.springs.stiffness_n_per_m, places.lame_over_youngs());
            let load = PointLoad::new(places, unit, unit * model.scene.point_mass_kg() / model.unit_m);
            Elastic::Solid(places.clone(), NeoHookean::new(stiffness, shear, lame), load)
        }
        Places::Surface(places) => Elastic::Mesh(
            places.clone(),
            SpringCoefficients::tense(unit * model.scene.springs.stiffness_n_per_m, 1.0, model.prestrain),
            T::of(unit * model.scene.anchor_stiffness_n_per_m),
            places.volume.as_ref().map_or(0.0, |volume| unit * model.scene.volume_stiffness_pa * volume.stretch_m),
        ),
    }
}

/// A spring whose stiffness a burn has changed, seen from one of its ends.
#[derive(Debug, Clone, Copy)]
pub(crate) struct StiffenedSpring {
    /// The place of this end.
    pub(crate) place: usize,
    pub(crate) spring: SpringEnd,
    /// The factor of its stiffness before, and now.
    pub(crate) factors: [f64; 2],
}

/// The springs of a mesh as its sweeps read them, and memory for a snapshot of the displacements.
#[derive(Debug)]
struct MeshTables<T> {
    springs: MeshSprings<T>,
    snapshot: RefCell<Snapshot<T>>,
}

/// The buffers and tables that a sweep needs besides the state. Each tissue has one.
#[derive(Debug)]
pub(crate) struct SweepTables<T> {
    pub(crate) width: Width,
    pub(crate) layout: Layout,
    pub(crate) springs: Elastic<T>,
    /// `None` but for a mesh.
    mesh: Option<MeshTables<T>>,
    /// `None` but for a solid.
    solid: Option<SolidTables<T>>,
    /// The severed springs. They are part of the state; the tables follow them.
    pub(crate) severed: Severed,
    cuts: SheetCuts<T>,
    /// `None` without a volume.
    pub(crate) pressure: Option<Pressure<T>>,
    /// 1 where a point moves, 0 where it is fixed: one plane. `None` if every point moves.
    pub(crate) free: Option<Field<T>>,
    /// Only the first rows of each plane are used. Planes of the layout's length need no extra address registers.
    carry: RefCell<Field<T>>,
    probe: [T; BLOCK],
    work: [T; BLOCK],
}

impl<T: Real> SweepTables<T> {
    pub(crate) fn new(model: &Model, layout: Layout, springs: Elastic<T>) -> Self {
        let free = (!model.fixed.is_empty()).then(|| {
            let mut free = Field::of_length(layout.plane);
            free.fill(T::of(1.0));
            model.fixed.iter().for_each(|index| free[layout.offset(*index)] = T::default());
            free
        });
        let zero = [T::default(); BLOCK];
        let is_sheet = matches!(model.places, Places::Sheet(_));
        let carry = if is_sheet { Field::zero(&layout) } else { Field::of_length(0) };
        SweepTables {
            width: Width::of(model.lanes),
            layout,
            springs,
            mesh: model.places.surface().map(|graph| MeshTables {
                springs: MeshSprings::new(&graph.slots, lanes::shape::<T>(Width::of(model.lanes))),
                snapshot: RefCell::new(Snapshot::of(&graph.slots)),
            }),
            solid: model.places.solid().map(|places| SolidTables::new(places, &layout)),
            severed: Severed::default(),
            cuts: SheetCuts::none(&layout),
            pressure: model.places.surface().and_then(|graph| Pressure::new(graph, &layout)),
            free,
            carry: RefCell::new(carry),
            probe: zero,
            work: zero,
        }
    }

    /// Follows a model in which other springs are stiff; the points, their masses and what is severed stay.
    pub(crate) fn follow_lumps(&mut self, model: &Model) {
        let cuts = self.severed.cuts().clone();
        *self = SweepTables::new(model, self.layout, self.springs.clone());
        self.set_severed(model, &cuts);
    }

    /// Returns the tables of a copy for reading, without those for sweeps.
    pub(crate) fn for_copy(&self) -> Self {
        SweepTables {
            width: self.width,
            layout: self.layout,
            springs: self.springs.clone(),
            mesh: None,
            solid: None,
            severed: self.severed.clone(),
            cuts: SheetCuts::none(&self.layout),
            pressure: None,
            free: None,
            carry: RefCell::new(Field::of_length(0)),
            probe: self.probe,
            work: self.work,
        }
    }

    /// Returns the relative mass of each place, and its extra K″/m; null if all masses are 1, or all extra
    /// values 0.
    pub(crate) fn masses_and_extra(&self) -> [*const T; 2] {
        if let Some(solid) = &self.solid {
            return [solid.masses.as_ptr(), std::ptr::null()];
        }
        let of_sheet = [std::ptr::null(), self.cuts.anchors()];
        self.mesh.as_ref().map_or(of_sheet, |mesh| mesh.springs.masses_and_extra())
    }

    /// Severs a spring. Returns the corners that this doubles, if the spring was whole.
    pub(crate) fn sever(&mut self, model: &Model, spring: SeveredSpring) -> Option<Vec<DoubledCorner>> {
        let doubled = self.severed.add(model, spring)?;
        let was = self.severed.burnt().of_spring(spring.ends.map(|place| place as usize));
        self.set_spring(model, &spring, [was, 0.0]);
        if let (Some(solid), Some(places), Some(copies)) =
            (&mut self.solid, model.places.solid(), self.severed.copies())
        {
            for copy in &doubled {
                solid.double(places, &self.layout, copies, copy);
            }
        }
        doubled.iter().for_each(|copy| self.hold_copy(copy.to));
        Some(doubled)
    }

    /// Makes room for the cubes of a solid beside cuts, which the first cut then need not do.
    pub(crate) fn prepare_to_cut(&mut self) {
        if let Some(solid) = &mut self.solid {
            solid.prepare_to_cut(&self.layout);
        }
    }

    /// Returns where the corners of a solid's cube beside cuts are in a plane of a field, by its number among these
    /// ([`CornerCopies::cubes`]).
    #[inline]
    pub(crate) fn cut_offsets(&self, number: usize) -> Option<[usize; 8]> {
        self.solid.as_ref()?.cut_offsets(number)
    }

    /// Makes a copy of a corner fixed if the corner is.
    fn hold_copy(&mut self, place: usize) {
        let Some(copies) = self.severed.copies() else { return };
        if let Some(free) = &mut self.free {
            free[self.layout.offset(place)] = free[self.layout.offset(copies.corner_of(place))];
        }
    }

    /// Makes the severed and the burnt springs those of `cuts` ([`Severed::replace`]).
    pub(crate) fn set_severed(&mut self, model: &Model, cuts: &Cuts) {
        let was = self.severed.burnt().clone();
        let [whole, severed] = self.severed.replace(model, cuts);
        let burnt = |spring: &SeveredSpring| was.of_spring(spring.ends.map(|place| place as usize));
        whole.iter().for_each(|spring| self.set_spring(model, spring, [0.0, burnt(spring)]));
        severed.iter().for_each(|spring| self.set_spring(model, spring, [burnt(spring), 0.0]));
        self.severed.set_burnt(was);
        self.set_burnt(model, cuts.burnt().clone());
        if cuts.anchor_count() == 0 {
            self.cuts.forget_anchors();
            if let (Places::Surface(places), Some(mesh)) = (&model.places, &mut self.mesh) {
                mesh.springs.forget_anchors(&places.slots);
            }
        }
        let copies = self.severed.copies().cloned();
        if let (Some(solid), Some(places)) = (&mut self.solid, model.places.solid()) {
            solid.follow(places, &self.layout, copies.as_deref());
        }
        copies.iter().flat_map(|copies| copies.places()).for_each(|place| self.hold_copy(place));
    }

    /// Makes the whole springs as stiff as burns have made them. Returns those that this changes.
    pub(crate) fn set_burnt(&mut self, model: &Model, burnt: BurntStiffness) -> Vec<StiffenedSpring> {
        let was = self.severed.burnt().clone();
        let mut places: Vec<usize> = was.differences(&burnt).collect();
        places.sort_unstable();
        places.dedup();
        let mut changed = Vec::new();
        for place in places.iter().copied() {
            let first_end = model.first_end(place);
            model.each_spring(place, |spring| {
                let ends = [place, spring.other];
                let is_known = spring.other < place && places.binary_search(&spring.other).is_ok();
                let factors = [&was, &burnt].map(|burnt| burnt.of_spring(ends));
                if !is_known && factors[0] != factors[1] && !self.severed.has(first_end + spring.number) {
                    changed.push(StiffenedSpring { place, spring, factors });
                }
            });
        }
        for StiffenedSpring { place, spring, factors } in &changed {
            self.set_factor(model, [*place, spring.other], spring.number, *factors);
        }
        self.severed.set_burnt(burnt);
        changed
    }

    /// Returns the relative mass at a place in memory, after cuts.
    pub(crate) fn relative_mass_at(&self, model: &Model, place: usize) -> f64 {
        mass_at(model, self.severed.copies().map(|copies| &**copies), place)
    }

    /// Returns K″/m at a place in memory divided by the reference value, minus 1, after cuts.
    pub(crate) fn extra_anchor_at(&self, model: &Model, place: usize) -> f64 {
        self.severed.extra_anchor(model.extra_anchor_at(place), place)
    }

    /// Returns K″ at a place in memory, after cuts, N/m.
    pub(crate) fn anchor_stiffness_at_n_per_m(&self, model: &Model, place: usize) -> f64 {
        let relative = model.relative_mass_at(place) * (1.0 + self.extra_anchor_at(model, place));
        model.scene.anchor_stiffness_n_per_m * relative
    }

    /// Returns the force of the springs on a point of a relative mass along an axis, N, from the gathered value of the tables in their
    /// unit ([`Plan::spring_unit`]) and the displacement in spacings.
    pub(crate) fn spring_force_n(
        &self,
        model: &Model,
        [spring_unit, mass]: [f64; 2],
        place: usize,
        [gathered, u]: [f64; 2],
    ) -> f64 {
        let force_n = gathered / spring_unit;
        if !model.places.differ() && self.severed.anchor_count() == 0 {
            return force_n;
        }
        // Anchor stiffness beyond the reference K″ is not part of the springs.
        let pulled_n = model.scene.anchor_stiffness_n_per_m * self.extra_anchor_at(model, place) * u * model.unit_m;
        mass * (force_n + pulled_n)
    }

    /// Writes to the tables that a spring has been severed or is whole again: the factor of its stiffness before and now.
    fn set_spring(&mut self, model: &Model, spring: &SeveredSpring, factors: [f64; 2]) {
        let [first, second] = spring.ends.map(|place| place as usize);
        if !spring.is_anchor() {
            self.set_factor(model, [first, second], spring.number as usize, factors);
        }
        match (&model.places, &mut self.mesh) {
            (Places::Sheet(_), _) if spring.is_anchor() => {
                self.cuts.set_anchor(&self.layout, model.point_of(first), factors[1] == 0.0);
            }
            (Places::Surface(places), Some(mesh)) if spring.is_anchor() => {
                mesh.springs.set_anchor(&places.slots, first, factors[1] == 0.0);
            }
            (Places::Surface(places), Some(mesh)) if model.prestrain > 0.0 => {
                for slot in [first, second] {
                    let end = model.first_end(slot);
                    mesh.springs.set_load(&places.slots, slot, |number| self.severed.has(end + number));
                }
            }
            _ => {}
        }
    }

    /// Writes the factor of the stiffness of a spring to the tables; it is given by its ends and its number at the first one.
    fn set_factor(&mut self, model: &Model, [first, second]: [usize; 2], number: usize, factors: [f64; 2]) {
        match (&model.places, &mut self.mesh) {
            (Places::Sheet(_), _) => {
                let by = ENDS[number / 4][number % 4];
                self.cuts.set(&self.layout, model.point_of(first), by, factors[1]);
            }
            (Places::Surface(places), Some(mesh)) => {
                mesh.springs.set(&places.slots, first, number, factors);
                let back = model.number_at_other_end(first, number);
                mesh.springs.set(&places.slots, second, back, factors);
            }
            _ => {}
        }
    }

    /// Returns the growth of the volume, in cubes of the unit of length, after the points of `tiles` have moved
    /// to `u`; 0 without a volume.
    pub(crate) fn volume_change(&self, u: &Field<T>, tiles: &[usize]) -> f64 {
        self.pressure.as_ref().map_or(0.0, |pressure| pressure.volume_change(self.width, &self.layout, u, tiles))
    }

    /// Computes the growth of a volume from the awake tiles, and applies its pressure. Returns the growth.
    pub(crate) fn press(&self, u: &Field<T>, tiles: &[usize]) -> f64 {
        let volume_change = self.volume_change(u, tiles);
        self.apply_volume_pressure(volume_change);
        volume_change
    }

    /// Sets the pressure of the next sweeps for a growth of the volume.
    pub(crate) fn apply_volume_pressure(&self, volume_change: f64) {
        if let (Some(pressure), Elastic::Mesh(.., factor)) = (&self.pressure, &self.springs) {
            pressure.set(push_of(*factor, volume_change));
        }
    }

    /// Advances every point with `scheme`. The tools' force is read from field `field` on.
    pub(crate) fn advance<C: Arithmetic<T>>(
        &mut self,
        scheme: &C,
        state: &mut State<T>,
        terms: &[Term<T>],
        field: usize,
        over: &Region,
    ) {
        let mut kept = [std::ptr::null_mut(); MAX_KEPT];
        for (pointer, field) in kept.iter_mut().zip(&mut state.kept) {
            *pointer = Arc::make_mut(field).as_mut_ptr();
        }
        assert_eq!(state.kept.len(), C::KEPT);
        // A few forces need no heap memory.
        let (mut few, mut many) = ([Pull::none(); FEW], Vec::new());
        let pulls = terms.iter().map(|term| term.pull(field, self.layout.stride));
        let pulls: &[Pull<'_, T>] = if terms.len() <= FEW {
            few.iter_mut().zip(pulls).for_each(|(to, pull)| *to = pull);
            &few[..terms.len()]
        } else {
            many.extend(pulls);
            &many
        };
        let u = state.u.as_mut_ptr();
        let stage = AdvanceStage {
            layout: self.layout,
            scheme,
            u,
            d: state.d.as_mut_ptr(),
            kept,
            pulls,
            forced: force_field::rows(terms),
            free: self.free.as_ref().map_or(std::ptr::null(), |free| free.as_ptr()),
            masses: self.masses_and_extra()[0],
            probe: self.probe.as_mut_ptr(),
            work: self.work.as_mut_ptr(),
        };
        let of_points = |field: &Field<T>| field.len() == 3 * self.layout.plane;
        debug_assert!(state.fields().all(of_points));
        debug_assert!(self.free.as_ref().is_none_or(|free| free.len() == self.layout.plane));
        debug_assert!(over.is_within(&self.layout));
        // SAFETY: all fields have the layout's three planes, padded by a row and a block, and the tables have this
        // layout; u is written behind what the sweep still reads, through the same pointer.
        unsafe { self.run(u.cast_const(), over, stage) };
    }

    /// Sweeps over the displacements `u`.
    ///
    /// # Safety
    /// `u` and the pointers of the stage belong to fields of this layout.
    pub(crate) unsafe fn survey<S: Stage<T>>(&self, u: *const T, over: &Region, stage: S) {
        debug_assert!(over.is_within(&self.layout));
        // SAFETY: as above.
        unsafe { self.run(u, over, stage) };
    }

    /// Runs a sweep over the springs.
    ///
    /// # Safety
    /// As for [`SweepTables::survey`].
    unsafe fn run<S: Stage<T>>(&self, x: *const T, over: &Region, stage: S) {
        let layout = self.layout;
        match (&self.springs, &self.mesh) {
            (Elastic::Mesh(places, unit, pull, _), Some(MeshTables { springs, snapshot })) => {
                let push = self.pressure.as_ref().map_or((T::default(), std::ptr::null()), Pressure::at_hand);
                let grid = MeshGrid { layout, slots: &places.slots, springs, unit, pull: *pull, push, x, snapshot };
                // SAFETY: the caller's promise; the springs and the snapshot were made for these slots and this width.
                unsafe { lanes::run(self.width, &MeshSweep { grid, over, stage }) };
            }
            (Elastic::Sheet(springs, pull), _) => {
                let mut carry = self.carry.borrow_mut();
                debug_assert!(carry.len() == 3 * layout.plane);
                let grid = Grid { layout, springs, cuts: &self.cuts, pull: *pull, x, carry: carry.as_mut_ptr() };
                // SAFETY: the caller's promise.
                unsafe { lanes::run(self.width, &Sweep { grid, over, stage }) };
            }
            (Elastic::Solid(places, law, load), _) => {
                let Some(tables) = &self.solid else { return };
                let grid = SolidGrid { layout, places, tables, law, load, x };
                // SAFETY: the caller's promise; the tables were made for these places.
                unsafe { lanes::run(self.width, &SolidSweep { grid, over, stage }) };
            }
            // A copy for reading has no tables, and is not swept.
            (Elastic::Mesh(..), None) => {}
        }
    }

    /// Returns whether all increments since the last call were finite and below `farthest`, and resets the sum.
    /// It may be false because the sum of many increments is large.
    pub(crate) fn is_settled(&mut self, farthest: f64) -> bool {
        std::mem::take(&mut self.probe).iter().all(|sum| sum.wide() < farthest * farthest)
    }

    /// Returns Σ force · travel of the tools since the last call, in the scheme's units, and resets the sum.
    pub(crate) fn take_work(&mut self) -> f64 {
        let work = std::mem::take(&mut self.work);
        // Four chains of additions at once, in a fixed order.
        let chains: [f64; 4] = std::array::from_fn(|chain| (0..BLOCK / 4).map(|n| work[4 * n + chain].wide()).sum());
        (chains[0] + chains[1]) + (chains[2] + chains[3])
    }
}
