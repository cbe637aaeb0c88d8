//! Surgical forces: how the forces of all tools act on the points.
//!
//! A scheme determines at which moments of a substep it evaluates a force, and with which weights the values
//! add to its fields. A two-step scheme evaluates only the substep's beginning. If the force jumps there, it
//! must use the mean of the values just before and just after (as if the substep before had ended, and this one
//! begun, with half an impulse each): with the new value alone the error is first order, with the mean second.
//! The other schemes use the new value.
//!
//! `body::force_field` has the force of one tool over the points.

use std::sync::Arc;

use glam::DVec3;

use crate::body::footprint::mass_at;
use crate::body::force_field::{FalloffForces, ForceChange, Term, factor, same_falloff};
use crate::body::model::{Model, Plan};
use crate::body::solid::corner_copies::CornerCopies;
use crate::kernel::field::Layout;
use crate::kernel::real::Real;
use crate::saved::{
    Checks, SavedForces, SavedLoad, SavedPoke, SavedPush, SavedSlot, SavedTerm, Vector as SavedVector, ensure,
};
use crate::scene::profile::{LoadProfile, Moment, Poke};
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

/// The forces of all tools.
#[derive(Debug, Clone)]
pub(crate) struct Applied<T: Real> {
    pub(crate) slots: Vec<Slot>,
    /// The terms that act in the present substep.
    pub(crate) terms: Vec<Term<T>>,
    /// The terms before they have tables. Kept, so that a step allocates nothing.
    wanted: Vec<FalloffForces>,
    /// Whether the terms stay valid for the next steps.
    settled: bool,
    /// The corners of a solid that cuts have doubled.
    copies: Option<Arc<CornerCopies>>,
}

impl<T: Real> Applied<T> {
    pub(crate) fn new() -> Self {
        Applied { slots: Vec::new(), terms: Vec::new(), wanted: Vec::new(), settled: true, copies: None }
    }

    /// Returns the same forces for a tissue in this number format, without tables.
    pub(crate) fn like<S: Real>(other: &Applied<S>) -> Self {
        Applied { slots: other.slots.clone(), settled: false, copies: other.copies.clone(), ..Applied::new() }
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
            let wanted =
                FalloffForces { poke: saved.poke.restored(checks)?, forces_n: saved.forces_n.map(DVec3::from) };
            // A force of 0 needs a finite factor too: the sweep multiplies.
            ensure(libm::exp(wanted.poke.falloff_offset).is_finite(), "a force that is not finite")?;
            is_sound(&wanted.poke, &wanted.forces_n)?;
            let mut term = Term::new();
            term.place(&wanted.poke, model, layout, None);
            term.set(wanted, scale);
            terms.push(term);
        }
        Ok(Applied { slots, terms, wanted: Vec::new(), settled: saved.settled, copies: None })
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

    /// Returns whether a tool pushes.
    pub(crate) fn pushes(&self) -> bool {
        self.slots.iter().any(|slot| slot.push.is_some())
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
                    _ => self.wanted.push(FalloffForces { poke: Poke { force_n: DVec3::ZERO, ..poke }, forces_n }),
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
                self.terms[place].place(&wanted.poke, model, layout, self.copies.as_deref());
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
            term.place(&poke, model, layout, self.copies.as_deref());
            term.set(FalloffForces { poke, forces_n: [poke.force_n; 3] }, scale);
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
        product * mass_at(model, self.copies.as_deref(), model.index_of(point))
    }

    /// Discards the terms and their scale.
    pub(crate) fn forget(&mut self) {
        self.terms.clear();
        self.settled = false;
    }

    /// Lets the forces act on these copies of a solid's corners too: each gets the part of the force on its corner that its mass is of the
    /// corner's.
    pub(crate) fn follow_cuts(&mut self, model: &Model, layout: &Layout, copies: &Arc<CornerCopies>) {
        self.copies = Some(copies.clone());
        for term in &mut self.terms {
            let poke = term.wanted.poke;
            term.place(&poke, model, layout, Some(copies));
        }
    }

    /// Gives up the copies that it knows; its forces stay as they are until it follows others.
    pub(crate) fn give_up_copies(&mut self) {
        self.copies = None;
    }

    /// Returns the corner at a place in memory, and the part of the force on the corner that acts there.
    fn share(&self, model: &Model, index: usize) -> (usize, f64) {
        let Some(copies) = &self.copies else { return (index, 1.0) };
        let corner = copies.corner_of(index);
        (corner, mass_at(model, Some(copies), index) / model.relative_mass_at(corner))
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
        let (corner, part) = self.share(model, index);
        part * sum_at(model, corner, pokes, T::NEGLIGIBLE_EXPONENT)
    }

    /// Returns the force on a point at the end of the last step, N.
    pub(crate) fn until(&self, model: &Model, index: usize) -> DVec3 {
        let (corner, part) = self.share(model, index);
        part * sum_at(model, corner, self.slots.iter().filter_map(|slot| slot.before), T::NEGLIGIBLE_EXPONENT)
    }
}

fn sum_at(model: &Model, index: usize, pokes: impl Iterator<Item = Poke>, negligible: f64) -> DVec3 {
    pokes.map(|poke| poke.force_n * factor(&poke, model.places.away_m(index, poke.centre_m), negligible)).sum()
}

#[cfg(test)]
mod tests;
