//! Surgical forces: how the forces of all tools act on the points.
//!
//! A scheme determines at which moments of a substep it evaluates a force, and with which weights the values
//! add to its fields. A two-step scheme evaluates only the substep's beginning. If the force jumps there, it
//! must use the mean of the values just before and just after (as if the substep before had ended, and this one
//! begun, with half an impulse each): with the new value alone the error is first order, with the mean second.
//! The other schemes use the new value.
//!
//! A force is a vector times a falloff over the points. The falloff is a table, computed when a force is
//! placed, and only where it counts; the sweep multiplies. So a changing force costs as little as a constant
//! one, and only a moving force needs new tables.
#![allow(unsafe_code)]
// The compiler does not always inline iterators over vectors. They then run without the caller's instructions, ten
// times slower.
#![allow(clippy::needless_range_loop)]

use std::ops::Range;

use glam::DVec3;

use crate::kernel::field::{Field, Layout};
use crate::kernel::lanes::{Vector, Width};
use crate::kernel::real::Real;
use crate::model::{Model, Plan};
use crate::scene::profile::{LoadProfile, Moment, Poke};
use crate::state::saved::{
    Checks, SavedForces, SavedLoad, SavedPoke, SavedPush, SavedSlot, SavedTerm, Vector as SavedVector, ensure,
};
use palpate_refusal::Result;

/// The force that a tool exerts on the points around a centre ([`Tissue::push`](crate::Tissue::push)). It lasts until
/// the next input of the same tool.
#[derive(Debug, Clone, PartialEq)]
pub enum Push {
    /// A constant force.
    Constant(Poke),
    /// A function of time, evaluated exactly at each moment within a step.
    Profile(LoadProfile),
}

impl Push {
    pub(crate) fn saved(&self) -> SavedPush {
        match self {
            Push::Constant(poke) => SavedPush::Constant(SavedPoke::of(poke)),
            Push::Profile(profile) => SavedPush::Profile(SavedLoad::of(profile)),
        }
    }

    pub(crate) fn restored(saved: &SavedPush, checks: &Checks<'_>) -> Result<Self> {
        Ok(match saved {
            SavedPush::Constant(poke) => Push::Constant(poke.restored(checks)?),
            SavedPush::Profile(profile) => Push::Profile(profile.restored(checks)?),
        })
    }

    fn at(&self, moment: Moment, rate_hz: f64) -> Poke {
        match self {
            Push::Constant(poke) => *poke,
            Push::Profile(profile) => profile.at(moment, rate_hz),
        }
    }
}

/// One tool's force: the present one, and that at the end of the last step.
#[derive(Debug, Clone, Default)]
pub(crate) struct Slot {
    pub(crate) push: Option<Push>,
    before: Option<Poke>,
    /// The force with which the sleeping tiles were last compared.
    compared: Option<Poke>,
}

/// Largest number of terms of one tool's force: two at each moment at which a scheme evaluates it.
const MAX_TERMS: usize = 8;

/// A change of a tool's force.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ForceChange {
    old: Option<Poke>,
    new: Option<Poke>,
    reached: [[[usize; 2]; 2]; 2],
}

impl ForceChange {
    /// Returns an upper bound of the change of force on any point of a rectangle or box, N. `sides` has its
    /// ends along each axis, m.
    pub(crate) fn most_n(&self, sides: &[[f64; 2]]) -> f64 {
        let nearest = |poke: &Poke| {
            let away = sides.iter().enumerate().map(|(axis, [from, to])| {
                let centre = poke.centre_m[axis];
                (from - centre).max(centre - to).max(0.0)
            });
            let away_m = away.map(|away| away * away).sum::<f64>().sqrt();
            factor_of(poke.falloff_offset - poke.falloff_per_m * away_m)
        };
        let [p, q] = [&self.old, &self.new].map(|poke| poke.as_ref().map_or(0.0, nearest));
        let each = |poke: &Option<Poke>, factor: f64| poke.map_or(0.0, |poke| poke.force_n.length() * factor);
        let both = each(&self.old, p) + each(&self.new, q);
        let Some((old, new)) = self.old.as_ref().zip(self.new.as_ref()) else { return both };
        if !same_falloff(&Poke { centre_m: new.centre_m, ..*old }, new) {
            return both;
        }
        // A moving centre changes the exponent by at most the falloff times the distance.
        let moved = new.falloff_per_m * old.centre_m.distance(new.centre_m);
        both.min((new.force_n - old.force_n).length() * q + old.force_n.length() * moved * p.max(q))
    }

    /// Returns the points that the old force reaches, and those that the new one reaches, along x and along y.
    pub(crate) fn reached(&self) -> [[Range<usize>; 2]; 2] {
        self.reached.map(|sides| sides.map(|[from, to]| from..to))
    }

    /// Returns the new force at its centre, N.
    pub(crate) fn peak_n(&self) -> f64 {
        self.new.map_or(0.0, |poke| poke.force_n.length() * factor_of(poke.falloff_offset))
    }
}

/// The forces of all tools.
#[derive(Debug, Clone)]
pub(crate) struct Applied<T: Real> {
    pub(crate) slots: Vec<Slot>,
    /// The terms that act in the present substep.
    pub(crate) terms: Vec<Term<T>>,
    /// The terms before they have tables. Kept, so that a step allocates nothing.
    wanted: Vec<Wanted>,
    /// Whether the terms stay valid for the next steps.
    settled: bool,
}

/// Forces with the same falloff: a weighted sum for each of the scheme's fields, N.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Wanted {
    /// Defines the falloff; its force vector is not used.
    poke: Poke,
    forces_n: [DVec3; 3],
}

/// A force over the points: a vector times e^{−c·r}.
#[derive(Debug, Clone)]
pub(crate) struct Term<T: Real> {
    wanted: Wanted,
    /// e^{c′}.
    gain: f64,
    /// The force in each of the scheme's fields, in the scheme's units.
    forces: [[T; 3]; 3],
    /// The rows where the force counts.
    rows: Range<usize>,
    columns: Range<usize>,
    /// The columns in each of those rows, in whole blocks.
    spans: Vec<Range<usize>>,
    /// e^{−c·r} divided by the relative mass for those rows, each as long as a row of the layout; 0 elsewhere.
    factors: Field<T>,
}

/// Returns e^x, at most the largest number: a force of 0 may have any factor, and 0 times infinity is NaN.
fn factor_of(exponent: f64) -> f64 {
    libm::exp(exponent).min(f64::MAX)
}

/// Returns whether two forces differ only in the vector.
fn same_falloff(a: &Poke, b: &Poke) -> bool {
    Poke { force_n: b.force_n, point: b.point, ..*a } == *b
}

impl<T: Real> Term<T> {
    fn new() -> Self {
        let poke =
            Poke { point: None, centre_m: DVec3::ZERO, force_n: DVec3::ZERO, falloff_per_m: 0.0, falloff_offset: 0.0 };
        Term {
            wanted: Wanted { poke, forces_n: [DVec3::ZERO; 3] },
            gain: 1.0,
            forces: [[T::default(); 3]; 3],
            rows: 0..0,
            columns: 0..0,
            spans: Vec::new(),
            factors: Field::of_length(0),
        }
    }

    /// Writes the falloff of `poke` to the table. Costs as much as the points that the old and the new falloff
    /// reach.
    fn place(&mut self, poke: &Poke, model: &Model, layout: &Layout) {
        // Beyond its spans the table is 0, also where it was longer before.
        for (row, span) in self.factors.chunks_exact_mut(layout.stride).zip(&self.spans) {
            row[span.clone()].fill(T::default());
        }
        [self.rows, self.columns] = model.places.reached::<T>(poke).map(|[from, to]| from..to);
        // `libm` gives the same bits on every machine; the platform's exponential does not.
        self.gain = libm::exp(poke.falloff_offset);
        self.factors.resize(self.rows.len() * layout.stride);
        let points = [self.rows.clone(), self.columns.clone()];
        model.places.fall_off(Width::of(model.lanes), poke, layout, points, &mut self.factors, &mut self.spans);
    }

    fn set(&mut self, wanted: Wanted, scale: f64) {
        self.forces = wanted.forces_n.map(|force_n| (self.gain * scale * force_n).to_array().map(T::of));
        self.wanted = wanted;
    }

    /// Returns e^{−c·r} divided by the relative mass at a point.
    fn factor(&self, layout: &Layout, [i, j]: [usize; 2]) -> T {
        if self.rows.contains(&i) { self.factors[(i - self.rows.start) * layout.stride + j] } else { T::default() }
    }
}

/// A term in the form that a sweep uses: pointers and numbers that need no checks.
#[derive(Clone, Copy)]
pub(crate) struct Pull<'a, T> {
    /// Where the factors of row 0 would be.
    factors: *const T,
    from: usize,
    to: usize,
    /// First and last place of the table, for debug checks.
    places: [usize; 2],
    spans: &'a [Range<usize>],
    /// Forces of one field and, if there is another, the next.
    forces: [[T; 3]; 2],
}

impl<T: Real> Pull<'_, T> {
    pub(crate) fn none() -> Self {
        Pull { factors: std::ptr::null(), from: 0, to: 0, places: [0; 2], spans: &[], forces: [[T::default(); 3]; 2] }
    }

    /// Returns the factors of a block of one of its rows.
    ///
    /// # Safety
    /// The table belongs to the same tissue as the block and is still alive.
    #[inline(always)]
    unsafe fn factor<V: Vector<Real = T>>(&self, at: usize) -> V {
        debug_assert!(self.places[0] <= at && at + V::LANES <= self.places[1]);
        // SAFETY: the caller's promise.
        unsafe { V::load(self.factors.wrapping_add(at)) }
    }
}

impl<T: Real> Term<T> {
    /// Returns the term for the fields from `field` on.
    pub(crate) fn pull(&self, field: usize, stride: usize) -> Pull<'_, T> {
        let factors = self.factors.as_ptr().wrapping_sub(self.rows.start * stride);
        let forces = [self.forces[field], self.forces[(field + 1).min(2)]];
        Pull {
            factors,
            from: self.rows.start,
            to: self.rows.end,
            places: [self.rows.start, self.rows.end].map(|row| row * stride),
            spans: &self.spans,
            forces,
        }
    }
}

/// Returns whether any force acts on a block of a row that has a force.
#[inline(always)]
pub(crate) fn reaches<T>(pulls: &[Pull<'_, T>], row: usize, column: usize) -> bool {
    match pulls {
        [pull] => pull.spans.get(row.wrapping_sub(pull.from)).is_some_and(|span| span.contains(&column)),
        _ => true,
    }
}

/// Returns the force of one term on a block that it reaches, by component, for `FIELDS` fields; a single field
/// is given twice.
///
/// # Safety
/// The table belongs to the same tissue as the block and is still alive.
#[inline(always)]
pub(crate) unsafe fn force_of<V: Vector, const FIELDS: usize>(pull: &Pull<'_, V::Real>, at: usize) -> [[V; 2]; 3] {
    // SAFETY: the caller's promise.
    let factor = unsafe { pull.factor::<V>(at) };
    let mut forces = [[factor; 2]; 3];
    for c in 0..3 {
        for f in 0..FIELDS {
            forces[c][f] = factor.splat(pull.forces[f][c]).mul(factor);
        }
        if FIELDS == 1 {
            forces[c][1] = forces[c][0];
        }
    }
    forces
}

/// Returns the forces of all terms on a block, by component, for `FIELDS` fields; a single field is given
/// twice.
///
/// # Safety
/// The tables belong to the same tissue as the block and are still alive.
#[inline(always)]
pub(crate) unsafe fn force_on<V: Vector, const FIELDS: usize>(
    pulls: &[Pull<'_, V::Real>],
    row: usize,
    at: usize,
) -> [[V; 2]; 3] {
    // SAFETY: the caller's promise.
    let mut sum = [[unsafe { V::of(V::Real::default()) }; 2]; 3];
    if let [pull] = pulls
        && row >= pull.from
        && row < pull.to
    {
        // SAFETY: the caller's promise.
        return unsafe { force_of::<V, FIELDS>(pull, at) };
    }
    for pull in pulls {
        if row >= pull.from && row < pull.to {
            // SAFETY: the caller's promise.
            let factor = unsafe { pull.factor::<V>(at) };
            for c in 0..3 {
                for f in 0..FIELDS {
                    sum[c][f] = factor.splat(pull.forces[f][c]).mul_add(factor, sum[c][f]);
                }
            }
        }
    }
    if FIELDS == 1 {
        for c in 0..3 {
            sum[c][1] = sum[c][0];
        }
    }
    sum
}

/// Returns the rows on which any force acts.
pub(crate) fn rows<T: Real>(terms: &[Term<T>]) -> Range<usize> {
    let rows = terms.iter().map(|term| term.rows.clone());
    rows.reduce(|a, b| a.start.min(b.start)..a.end.max(b.end)).unwrap_or(0..0)
}

/// Returns e^{−c·r + c′} at a distance, m; 0 where it is negligible.
fn factor(poke: &Poke, away_m: f64, negligible: f64) -> f64 {
    let exponent = -poke.falloff_per_m * away_m;
    if exponent < negligible { 0.0 } else { libm::exp(exponent + poke.falloff_offset) }
}

impl<T: Real> Applied<T> {
    pub(crate) fn new() -> Self {
        Applied { slots: Vec::new(), terms: Vec::new(), wanted: Vec::new(), settled: true }
    }

    /// Returns the same forces for a tissue in this number format, without tables.
    pub(crate) fn like<S: Real>(other: &Applied<S>) -> Self {
        Applied { slots: other.slots.clone(), settled: false, ..Applied::new() }
    }

    /// Converts the forces to plain data, without tables.
    pub(crate) fn saved(&self) -> SavedForces {
        let slot = |Slot { push, before, compared }: &Slot| SavedSlot {
            push: push.as_ref().map(Push::saved).map(Box::new),
            before: before.as_ref().map(SavedPoke::of).map(Box::new),
            compared: compared.as_ref().map(SavedPoke::of).map(Box::new),
        };
        let term = |term: &Term<T>| SavedTerm {
            poke: SavedPoke::of(&term.wanted.poke),
            forces_n: term.wanted.forces_n.map(SavedVector::from),
        };
        SavedForces {
            slots: self.slots.iter().map(slot).collect(),
            terms: self.terms.iter().map(term).collect(),
            settled: self.settled,
        }
    }

    /// Restores the forces of a tissue whose plan has the scale of forces `scale`, and their tables.
    pub(crate) fn restored(
        saved: &SavedForces,
        model: &Model,
        layout: &Layout,
        scale: f64,
        checks: &Checks<'_>,
    ) -> Result<Self> {
        if let Some(last) = saved.slots.len().checked_sub(1) {
            checks.tool(last as u64)?;
        }
        ensure(saved.terms.len() <= MAX_TERMS * saved.slots.len(), "more forces than its tools exert")?;
        // In the scheme's units it must be a finite number of this format, unless it is 0.
        let is_sound = |poke: &Poke, forces_n: &[DVec3]| {
            let gain = libm::exp(poke.falloff_offset) * scale;
            let in_terms = |force_n: &DVec3| T::of(gain * force_n.length()).is_finite();
            let acts = |force_n: &&DVec3| **force_n != DVec3::ZERO;
            ensure(forces_n.iter().filter(acts).all(in_terms), "a force that is not finite")
        };
        let poke = |poke: &Option<Box<SavedPoke>>| poke.as_ref().map(|poke| poke.restored(checks)).transpose();
        let slot = |slot: &SavedSlot| {
            let push = slot.push.as_ref().map(|push| Push::restored(push, checks)).transpose()?;
            let (before, compared) = (poke(&slot.before)?, poke(&slot.compared)?);
            if let Some(before) = &before {
                is_sound(before, &[before.force_n])?;
            }
            Ok(Slot { push, before, compared })
        };
        let slots = saved.slots.iter().map(slot).collect::<Result<_>>()?;
        let mut terms = Vec::new();
        for saved in &saved.terms {
            let wanted = Wanted { poke: saved.poke.restored(checks)?, forces_n: saved.forces_n.map(DVec3::from) };
            // A force of 0 needs a finite factor too: the sweep multiplies.
            ensure(libm::exp(wanted.poke.falloff_offset).is_finite(), "a force that is not finite")?;
            is_sound(&wanted.poke, &wanted.forces_n)?;
            let mut term = Term::new();
            term.place(&wanted.poke, model, layout);
            term.set(wanted, scale);
            terms.push(term);
        }
        Ok(Applied { slots, terms, wanted: Vec::new(), settled: saved.settled })
    }

    /// Sets the force of `tool` from the next step on.
    pub(crate) fn set(&mut self, tool: usize, push: Option<Push>) {
        if self.slots.len() <= tool {
            self.slots.resize(tool + 1, Slot::default());
        }
        self.slots[tool].push = push;
        self.settled = false;
    }

    /// Returns whether the forces stay constant until a tool gets another command.
    pub(crate) fn is_settled(&self) -> bool {
        self.settled
    }

    /// Returns the changes of force since the last call, up to the end of step `step`.
    pub(crate) fn changes(&mut self, model: &Model, step: u64) -> impl Iterator<Item = ForceChange> {
        let end = Moment { step, fraction: 1.0 };
        let change = move |slot: &mut Slot| {
            let new = slot.push.as_ref().map(|push| push.at(end, model.scene.stepping.rate_hz));
            let old = std::mem::replace(&mut slot.compared, new);
            let reached =
                |poke: Option<Poke>| poke.map_or_else(Default::default, |poke| model.places.reached::<T>(&poke));
            (old != new).then(|| ForceChange { old, new, reached: [old, new].map(reached) })
        };
        let slots = if self.settled { 0 } else { self.slots.len() };
        self.slots[..slots].iter_mut().filter_map(change)
    }

    /// Updates the forces for the substep that begins at `moment` and takes `share` of the step.
    pub(crate) fn prepare(&mut self, model: &Model, plan: &Plan, layout: &Layout, moment: Moment, share: f64) {
        if self.settled {
            return;
        }
        let rate_hz = model.scene.stepping.rate_hz;
        self.wanted.clear();
        self.settled = true;
        for slot in &self.slots {
            self.settled &= match (&slot.before, &slot.push) {
                (None, None) => true,
                (Some(before), Some(Push::Constant(poke))) => before == poke,
                _ => false,
            };
            // Forces of one tool that differ only in the vector are merged.
            let own = self.wanted.len();
            let mut add = |weights: [f64; 3], poke: Option<Poke>| {
                let Some(poke) = poke.filter(|poke| poke.force_n != DVec3::ZERO) else { return };
                let forces_n = weights.map(|weight| weight * poke.force_n);
                match self.wanted[own..].last_mut() {
                    Some(wanted) if same_falloff(&wanted.poke, &poke) => {
                        wanted.forces_n.iter_mut().zip(forces_n).for_each(|(sum, force)| *sum += force);
                    }
                    _ => self.wanted.push(Wanted { poke: Poke { force_n: DVec3::ZERO, ..poke }, forces_n }),
                }
            };
            for node in &plan.nodes {
                let at = Moment { fraction: moment.fraction + node.fraction * share, ..moment };
                let now = slot.push.as_ref().map(|push| push.at(at, rate_hz));
                if plan.scheme.takes_means() && moment.fraction == 0.0 && slot.before != now {
                    add(node.weights.map(|weight| 0.5 * weight), slot.before);
                    add(node.weights.map(|weight| 0.5 * weight), now);
                } else {
                    add(node.weights, now);
                }
            }
        }
        if !self.wanted.iter().eq(self.terms.iter().map(|term| &term.wanted)) {
            self.put(model, layout, plan.force_scale(&model.scene));
        }
    }

    /// Makes `terms` equal `wanted`. Keeps each table whose falloff is wanted again and reuses the memory of
    /// the others.
    fn put(&mut self, model: &Model, layout: &Layout, scale: f64) {
        for place in 0..self.wanted.len() {
            let wanted = self.wanted[place];
            let known = self.terms[place..].iter().position(|term| same_falloff(&term.wanted.poke, &wanted.poke));
            let needless = |term: &Term<T>| {
                !self.wanted[place..].iter().any(|wanted| same_falloff(&wanted.poke, &term.wanted.poke))
            };
            let found = known.or_else(|| self.terms[place..].iter().position(needless)).unwrap_or_else(|| {
                self.terms.push(Term::new());
                self.terms.len() - 1 - place
            });
            self.terms.swap(place, place + found);
            if known.is_none() {
                self.terms[place].place(&wanted.poke, model, layout);
            }
            self.terms[place].set(wanted, scale);
        }
        self.terms.truncate(self.wanted.len());
    }

    /// Returns the forces at the end of the last step, in the scale of a scheme, as a field of their own.
    pub(crate) fn until_now(&self, model: &Model, layout: &Layout, scale: f64) -> Vec<Term<T>> {
        let pokes = self.slots.iter().filter_map(|slot| slot.before).filter(|poke| poke.force_n != DVec3::ZERO);
        let term = |poke: Poke| {
            let mut term = Term::new();
            term.place(&poke, model, layout);
            term.set(Wanted { poke, forces_n: [poke.force_n; 3] }, scale);
            term
        };
        pokes.map(term).collect()
    }

    /// Returns the force that the present substep adds to a point in one field, divided by its relative mass.
    pub(crate) fn force_at(&self, layout: &Layout, field: usize, point: [usize; 2]) -> [f64; 3] {
        let mut sum = [0.0; 3];
        for term in &self.terms {
            let factor = term.factor(layout, point).wide();
            sum.iter_mut().zip(term.forces[field]).for_each(|(sum, force)| *sum += force.wide() * factor);
        }
        sum
    }

    /// Returns the work of the forces when something other than a sweep moves a point, in units of
    /// `TissueState::unit_of_work_j`. A sweep counts only the movement that it would have made.
    pub(crate) fn work_along(
        &self,
        model: &Model,
        plan: &Plan,
        layout: &Layout,
        point: [usize; 2],
        movement: [f64; 3],
    ) -> f64 {
        if self.terms.is_empty() {
            return 0.0;
        }
        let force = self.force_at(layout, plan.scheme.last_field(), point);
        let product: f64 = force.iter().zip(movement).map(|(force, moved)| force * moved).sum();
        product * model.relative_mass_at(model.index_of(point))
    }

    /// Discards the terms and their scale.
    pub(crate) fn forget(&mut self) {
        self.terms.clear();
        self.settled = false;
    }

    /// Ends a step: the present force becomes the force before the next step.
    pub(crate) fn finish(&mut self, model: &Model, step: u64) {
        let end = Moment { step, fraction: 1.0 };
        for slot in &mut self.slots {
            slot.before = slot.push.as_ref().map(|push| push.at(end, model.scene.stepping.rate_hz));
        }
    }

    /// Returns the force on a point just after a moment, N.
    pub(crate) fn from(&self, model: &Model, index: usize, moment: Moment) -> DVec3 {
        let rate_hz = model.scene.stepping.rate_hz;
        let pokes = self.slots.iter().filter_map(|slot| slot.push.as_ref().map(|push| push.at(moment, rate_hz)));
        sum_at(model, index, pokes, T::NEGLIGIBLE_EXPONENT)
    }

    /// Returns the force on a point at the end of the last step, N.
    pub(crate) fn until(&self, model: &Model, index: usize) -> DVec3 {
        sum_at(model, index, self.slots.iter().filter_map(|slot| slot.before), T::NEGLIGIBLE_EXPONENT)
    }
}

fn sum_at(model: &Model, index: usize, pokes: impl Iterator<Item = Poke>, negligible: f64) -> DVec3 {
    pokes.map(|poke| poke.force_n * factor(&poke, model.places.away_m(index, poke.centre_m), negligible)).sum()
}

#[cfg(test)]
mod tests;
