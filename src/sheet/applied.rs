//! Surgical forces: how those of all tools add up to fields over the points.
//!
//! A scheme says at which moments of a substep it asks for a law, and with which weights that adds to its fields. A
//! two-step scheme sees the substep's beginning only. Where the force jumps there, it must see the mean of the values
//! just before and just after (as if the substep before had ended, and this one begun, with a half kick each): with
//! the new value alone the error is first order, with the mean second. The others take the new value.

use std::ops::Range;

use glam::DVec3;

use super::field::{Field, Layout};
use super::model::{Model, Plan};
use super::real::Real;
use crate::scene::law::{ForceLaw, Moment, Poke};

/// What a tool exerts.
#[derive(Debug, Clone, PartialEq)]
pub enum Push {
    /// The same until another command.
    Held(Poke),
    /// A law of time, exact within the step.
    Law(ForceLaw),
}

impl Push {
    fn at(&self, moment: Moment, rate_hz: f64) -> Poke {
        match self {
            Push::Held(poke) => *poke,
            Push::Law(law) => law.at(moment, rate_hz),
        }
    }
}

/// One tool's force: what it is now, and what it was at the end of the last step.
#[derive(Debug, Clone, Default)]
struct Slot {
    push: Option<Push>,
    before: Option<Poke>,
}

/// The forces of all tools.
#[derive(Debug, Clone)]
pub(super) struct Applied<T: Real> {
    slots: Vec<Slot>,
    /// What acts in the substep under way, in the terms of the scheme: as many fields as it wants.
    pub(super) fields: Vec<Field<T>>,
    /// Rows that have a force.
    pub(super) rows: Range<usize>,
    /// What `fields` were summed from.
    terms: Vec<Term>,
    tables: Vec<Table>,
}

/// Forces of the same falloff: of each field a weighted sum, N. The force of `poke` does not matter.
#[derive(Debug, Clone, PartialEq)]
struct Term {
    poke: Poke,
    forces_n: [DVec3; 3],
}

/// e^{−c·r + c′} over the points where it counts, for one centre. Made when the poke is placed.
#[derive(Debug, Clone)]
struct Table {
    /// The poke it is made for; its force does not matter.
    poke: Poke,
    rows: [usize; 2],
    columns: [usize; 2],
    factors: Vec<f64>,
}

/// Whether two pokes differ in the force alone.
fn same_falloff(a: &Poke, b: &Poke) -> bool {
    Poke { force_n: b.force_n, ..*a } == *b
}

impl Table {
    fn new<T: Real>(poke: &Poke, model: &Model) -> Self {
        let spacing_m = model.scene.sheet.spacing_m;
        let reach_m = -T::NEGLIGIBLE_EXPONENT / poke.falloff_per_m;
        let span = |centre_m: f64, points: usize| {
            // Saturating casts: a reach without end covers the whole sheet.
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
            let [from, to] =
                [((centre_m - reach_m) / spacing_m).ceil(), ((centre_m + reach_m) / spacing_m).floor() + 1.0]
                    .map(|edge| (edge.max(0.0) as usize).min(points));
            [from, to.max(from)]
        };
        let [rows, columns] = [span(poke.centre_m.x, model.points[0]), span(poke.centre_m.y, model.points[1])];
        let factors = (rows[0]..rows[1]).flat_map(|i| {
            (columns[0]..columns[1]).map(move |j| factor(poke, [i, j], spacing_m, T::NEGLIGIBLE_EXPONENT))
        });
        Table { poke: *poke, rows, columns, factors: factors.collect() }
    }
}

/// e^{−c·r + c′} at a point, 0 where it is negligible.
#[allow(clippy::cast_precision_loss)]
fn factor(poke: &Poke, [i, j]: [usize; 2], spacing_m: f64, negligible: f64) -> f64 {
    let (x, y) = (i as f64 * spacing_m - poke.centre_m.x, j as f64 * spacing_m - poke.centre_m.y);
    let exponent = -poke.falloff_per_m * (x * x + y * y).sqrt();
    // The same bits on every machine: not the platform's exponential.
    if exponent < negligible { 0.0 } else { libm::exp(exponent + poke.falloff_offset) }
}

impl<T: Real> Applied<T> {
    pub(super) fn new(layout: &Layout, plan: &Plan) -> Self {
        let used = |field: usize| plan.nodes.iter().any(|node| node.weights[field] != 0.0);
        let fields = (0..3).filter(|field| used(*field)).map(|_| Field::zero(layout)).collect();
        Applied { slots: Vec::new(), fields, rows: 0..0, terms: Vec::new(), tables: Vec::new() }
    }

    /// From the coming step on `tool` exerts `push`.
    pub(super) fn set(&mut self, tool: usize, push: Option<Push>) {
        if self.slots.len() <= tool {
            self.slots.resize(tool + 1, Slot::default());
        }
        self.slots[tool].push = push;
    }

    /// Brings the fields to the substep that begins at `moment` and takes `share` of the step. `changing` is told before
    /// the fields change, and after.
    pub(super) fn prepare(
        &mut self,
        model: &Model,
        plan: &Plan,
        layout: &Layout,
        moment: Moment,
        share: f64,
        mut changing: impl FnMut(&Self, bool),
    ) {
        let rate_hz = model.scene.stepping.rate_hz;
        let mut terms = std::mem::take(&mut self.terms);
        let mut count = 0;
        let mut changed = false;
        // In place of the last list of terms, so that a step allocates nothing.
        let mut put = |term: Term| {
            if terms.get(count) != Some(&term) {
                changed = true;
                terms.truncate(count);
                terms.push(term);
            }
            count += 1;
        };
        for slot in &self.slots {
            let mut pending: Option<Term> = None;
            let mut add = |weights: [f64; 3], poke: Option<Poke>| {
                let Some(poke) = poke.filter(|poke| poke.force_n != DVec3::ZERO) else { return };
                let forces_n = weights.map(|weight| weight * poke.force_n);
                let poke = Poke { force_n: DVec3::ZERO, ..poke };
                match &mut pending {
                    Some(term) if same_falloff(&term.poke, &poke) => {
                        term.forces_n.iter_mut().zip(forces_n).for_each(|(sum, force)| *sum += force);
                    }
                    _ => {
                        if let Some(term) = pending.replace(Term { poke, forces_n }) {
                            put(term);
                        }
                    }
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
            if let Some(term) = pending {
                put(term);
            }
        }
        changed |= count != terms.len();
        terms.truncate(count);
        if changed {
            changing(self, true);
        }
        self.terms = terms;
        if changed {
            self.sum(model, plan, layout);
            changing(self, false);
        }
    }

    fn sum(&mut self, model: &Model, plan: &Plan, layout: &Layout) {
        let place = |c: usize, i: usize| c * layout.plane + i * layout.stride;
        for table in &self.tables {
            for field in &mut self.fields {
                for i in table.rows[0]..table.rows[1] {
                    for c in 0..3 {
                        field[place(c, i) + table.columns[0]..place(c, i) + table.columns[1]].fill(T::default());
                    }
                }
            }
        }
        let scale = plan.force_scale(&model.scene);
        self.tables.retain(|table| self.terms.iter().any(|term| same_falloff(&table.poke, &term.poke)));
        for term in &self.terms {
            let known = self.tables.iter().position(|table| same_falloff(&table.poke, &term.poke));
            let known = known.unwrap_or_else(|| {
                self.tables.push(Table::new::<T>(&term.poke, model));
                self.tables.len() - 1
            });
            let table = &self.tables[known];
            let width = table.columns[1] - table.columns[0];
            for (field, force_n) in self.fields.iter_mut().zip(term.forces_n) {
                for (c, force_n) in force_n.to_array().into_iter().enumerate() {
                    for i in table.rows[0]..table.rows[1] {
                        let factors = &table.factors[(i - table.rows[0]) * width..][..width];
                        let row = &mut field[place(c, i) + table.columns[0]..place(c, i) + table.columns[1]];
                        row.iter_mut().zip(factors).for_each(|(f, factor)| *f += T::of(scale * force_n * factor));
                    }
                }
            }
        }
        let rows = self.tables.iter().map(|table| table.rows);
        self.rows = rows.reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])]).map_or(0..0, |[from, to]| from..to);
    }

    /// Forgets what the fields were summed from, and in which scale.
    pub(super) fn forget(&mut self) {
        self.fields.iter_mut().for_each(|field| field.fill(T::default()));
        (self.rows, self.terms, self.tables) = (0..0, Vec::new(), Vec::new());
    }

    /// Adds what acts at the end of the last step, in the scale of a scheme, to `field`.
    pub(super) fn add_until(&self, model: &Model, layout: &Layout, scale: f64, field: &mut Field<T>) {
        for poke in self.slots.iter().filter_map(|slot| slot.before) {
            let table = Table::new::<T>(&poke, model);
            let width = table.columns[1] - table.columns[0];
            for (c, force_n) in poke.force_n.to_array().into_iter().enumerate() {
                for i in table.rows[0]..table.rows[1] {
                    let factors = &table.factors[(i - table.rows[0]) * width..][..width];
                    let from = c * layout.plane + i * layout.stride + table.columns[0];
                    let row = &mut field[from..from + width];
                    row.iter_mut().zip(factors).for_each(|(f, factor)| *f += T::of(scale * force_n * factor));
                }
            }
        }
    }

    /// Ends a step: what acts now is what will have acted before the next.
    pub(super) fn finish(&mut self, model: &Model, step: u64) {
        let end = Moment { step, fraction: 1.0 };
        for slot in &mut self.slots {
            slot.before = slot.push.as_ref().map(|push| push.at(end, model.scene.stepping.rate_hz));
        }
    }

    /// The force on a point from a moment on.
    pub(super) fn from(&self, model: &Model, index: usize, moment: Moment) -> DVec3 {
        let rate_hz = model.scene.stepping.rate_hz;
        sum_at(
            model,
            index,
            self.slots.iter().filter_map(|slot| slot.push.as_ref().map(|push| push.at(moment, rate_hz))),
            T::NEGLIGIBLE_EXPONENT,
        )
    }

    /// The force on a point at the end of the last step.
    pub(super) fn until(&self, model: &Model, index: usize) -> DVec3 {
        sum_at(model, index, self.slots.iter().filter_map(|slot| slot.before), T::NEGLIGIBLE_EXPONENT)
    }
}

fn sum_at(model: &Model, index: usize, pokes: impl Iterator<Item = Poke>, negligible: f64) -> DVec3 {
    let (point, spacing_m) = (model.point_of(index), model.scene.sheet.spacing_m);
    pokes.map(|poke| poke.force_n * factor(&poke, point, spacing_m, negligible)).sum()
}
