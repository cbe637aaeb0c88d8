//! Surgical forces: how those of all tools add up to a field over the points.
//!
//! A two-step scheme sees the force at a substep's beginning only. Where it jumps there, it must see the mean of
//! the values just before and just after (as if the substep before had ended, and this one begun, with a half kick
//! each): with the new value alone the error is first order, with the mean second.

use glam::DVec3;

use super::model::Model;
use super::real::Real;
use crate::scene::law::{ForceLaw, Moment, Poke};

/// Where −c·r is below this, the force is left out: e^−34.5 = 1e-15 of the force at the centre, which is below
/// what the worst sum of f64 loses. Nearer to 0 saves time and costs accuracy.
const NEGLIGIBLE_EXPONENT: f64 = -34.5;

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
#[derive(Debug)]
pub(super) struct Applied<T> {
    slots: Vec<Slot>,
    /// The sum over all tools, for the substep under way.
    pub(super) field: [Vec<T>; 3],
    /// What `field` was summed from: weights and pokes.
    terms: Vec<(f64, Poke)>,
    tables: Vec<Table>,
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

impl Table {
    fn fits(&self, poke: &Poke) -> bool {
        Poke { force_n: self.poke.force_n, ..*poke } == self.poke
    }

    fn new(poke: &Poke, model: &Model) -> Self {
        let spacing_m = model.scene.sheet.spacing_m;
        let reach_m = -NEGLIGIBLE_EXPONENT / poke.falloff_per_m;
        let span = |centre_m: f64, points: usize| {
            // Saturating casts: a reach without end covers the whole sheet.
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
            let [from, to] =
                [((centre_m - reach_m) / spacing_m).ceil(), ((centre_m + reach_m) / spacing_m).floor() + 1.0]
                    .map(|edge| (edge.max(0.0) as usize).min(points));
            [from, to.max(from)]
        };
        let [rows, columns] = [span(poke.centre_m.x, model.points[0]), span(poke.centre_m.y, model.points[1])];
        let factors =
            (rows[0]..rows[1]).flat_map(|i| (columns[0]..columns[1]).map(move |j| factor(poke, [i, j], spacing_m)));
        Table { poke: *poke, rows, columns, factors: factors.collect() }
    }
}

/// e^{−c·r + c′} at a point, 0 where it is negligible.
#[allow(clippy::cast_precision_loss)]
fn factor(poke: &Poke, [i, j]: [usize; 2], spacing_m: f64) -> f64 {
    let (x, y) = (i as f64 * spacing_m - poke.centre_m.x, j as f64 * spacing_m - poke.centre_m.y);
    let exponent = -poke.falloff_per_m * (x * x + y * y).sqrt();
    // The same bits on every machine: not the platform's exponential.
    if exponent < NEGLIGIBLE_EXPONENT { 0.0 } else { libm::exp(exponent + poke.falloff_offset) }
}

impl<T: Real> Applied<T> {
    pub(super) fn new(model: &Model) -> Self {
        Applied {
            slots: Vec::new(),
            field: std::array::from_fn(|_| vec![T::default(); model.len()]),
            terms: Vec::new(),
            tables: Vec::new(),
        }
    }

    /// From the coming step on `tool` exerts `push`.
    pub(super) fn set(&mut self, tool: usize, push: Option<Push>) {
        if self.slots.len() <= tool {
            self.slots.resize(tool + 1, Slot::default());
        }
        self.slots[tool].push = push;
    }

    /// Brings `field` to the beginning of a substep.
    pub(super) fn prepare(&mut self, model: &Model, moment: Moment) {
        let rate_hz = model.scene.stepping.rate_hz;
        let mut terms = std::mem::take(&mut self.terms);
        let mut count = 0;
        let mut changed = false;
        // In place of the last list of terms, so that a step allocates nothing.
        let mut term = |weight: f64, poke: Option<Poke>| {
            let Some(poke) = poke.filter(|poke| poke.force_n != DVec3::ZERO) else { return };
            match terms.get_mut(count) {
                Some(old) if *old == (weight, poke) => {}
                Some(old) => {
                    *old = (weight, poke);
                    changed = true;
                }
                None => {
                    terms.push((weight, poke));
                    changed = true;
                }
            }
            count += 1;
        };
        for slot in &self.slots {
            let now = slot.push.as_ref().map(|push| push.at(moment, rate_hz));
            if moment.fraction > 0.0 || slot.before == now {
                term(1.0, now);
            } else {
                term(0.5, slot.before);
                term(0.5, now);
            }
        }
        changed |= count != terms.len();
        terms.truncate(count);
        self.terms = terms;
        if changed {
            self.sum(model);
        }
    }

    fn sum(&mut self, model: &Model) {
        for table in &self.tables {
            for i in table.rows[0]..table.rows[1] {
                let row = i * model.points[1];
                for component in &mut self.field {
                    component[row + table.columns[0]..row + table.columns[1]].fill(T::default());
                }
            }
        }
        self.tables.retain(|table| self.terms.iter().any(|(_, poke)| table.fits(poke)));
        for (weight, poke) in &self.terms {
            let known = self.tables.iter().position(|table| table.fits(poke));
            let known = known.unwrap_or_else(|| {
                self.tables.push(Table::new(poke, model));
                self.tables.len() - 1
            });
            let table = &self.tables[known];
            let width = table.columns[1] - table.columns[0];
            for (c, force_n) in poke.force_n.to_array().into_iter().enumerate() {
                let force_n = weight * force_n;
                for i in table.rows[0]..table.rows[1] {
                    let row = i * model.points[1];
                    let factors = &table.factors[(i - table.rows[0]) * width..][..width];
                    let field = &mut self.field[c][row + table.columns[0]..row + table.columns[1]];
                    field.iter_mut().zip(factors).for_each(|(f, factor)| *f += T::of(force_n * factor));
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
        )
    }

    /// The force on a point at the end of the last step.
    pub(super) fn until(&self, model: &Model, index: usize) -> DVec3 {
        sum_at(model, index, self.slots.iter().filter_map(|slot| slot.before))
    }
}

fn sum_at(model: &Model, index: usize, pokes: impl Iterator<Item = Poke>) -> DVec3 {
    let (point, spacing_m) = (model.point_of(index), model.scene.sheet.spacing_m);
    pokes.map(|poke| poke.force_n * factor(&poke, point, spacing_m)).sum()
}
