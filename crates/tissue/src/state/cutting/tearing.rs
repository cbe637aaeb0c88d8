//! Tears: the springs that a step has stretched too far, and how far springs are stretched.
//!
//! A spring tears beyond the strain that the scene gives (`[cutting] tear_strain`), counted from the length at which the scene has it at
//! rest. Only springs between neighbours tear, and in a step only the most strained one of each point, relative to its limit: what is
//! severed relieves the others, so a tear runs on by one spring of a point in a step. A spring that resists bending stands for
//! no material of its own: it goes once no two whole springs in a row join its ends.
//!
//! Only tiles that are awake are looked at: in the others nothing has moved. The comparisons are in f64, from a state that has the same
//! bits on every machine.

use std::collections::BTreeSet;

use glam::DVec3;

use super::Crossing;
use crate::body::spring_ends::SpringEnd;
use crate::kernel::real::Real;
use crate::kernel::region::sides_of;
use crate::shape::PointId;
use crate::state::tissue_state::TissueState;

impl<T: Real> TissueState<T> {
    /// Returns the springs that tear at the end of a step, and those that resist bending and go with them.
    pub(super) fn torn(&self) -> Vec<Crossing> {
        let mut over = self.strained();
        // The most strained first; of equal ones the first in memory.
        over.sort_unstable_by(|(a, one), (b, other)| {
            b.total_cmp(a).then((one.place, one.spring.number).cmp(&(other.place, other.spring.number)))
        });
        let mut ends = BTreeSet::new();
        let mut torn: Vec<Crossing> = Vec::new();
        for (_, spring) in over {
            // All of them count as seen: a spring tears only if it is the most strained at both of its ends.
            let is_first = [ends.insert(spring.place), ends.insert(spring.spring.other)];
            if is_first == [true, true] {
                torn.push(spring);
            }
        }
        let bending = self.unspanned(&torn);
        torn.extend(bending);
        torn
    }

    /// Returns the whole springs that are strained beyond their limit, each from its first end, with its strain divided by the limit.
    fn strained(&self) -> Vec<(f64, Crossing)> {
        let TissueState { model, tables, tiles, .. } = self;
        let (cutting, layout, across) = (&model.scene.cutting, &tables.layout, model.points[1]);
        let mut found = Vec::new();
        if cutting.tear_strain.is_none() {
            return found;
        }
        let u_m = |place: usize| self.end_motion_m(place)[0];
        for tile in tiles.region.tiles() {
            let [rows, columns] = sides_of(layout, *tile);
            for i in rows {
                for j in columns.clone() {
                    let place = i * across + j;
                    if !model.is_spring_end(place) {
                        continue;
                    }
                    let (own_m, first_end) = (u_m(place), model.first_end(place));
                    model.each_spring(place, |spring| {
                        let is_first = spring.other > place;
                        // The other end finds it too, if it is awake.
                        if !is_first && tiles.region.awake.has[tiles.of(model.point_of(spring.other))] {
                            return;
                        }
                        let rest_m = model.unit_m * spring.rest;
                        let delta_m = u_m(spring.other) - own_m;
                        let Some(excess) = excess(rest_m, delta_m, |length_m| cutting.tear_limit(length_m)) else {
                            return;
                        };
                        let is_severed = tables.severed.has(first_end + spring.number);
                        if is_severed || !model.joins_neighbours(place, &spring) {
                            return;
                        }
                        found.push((excess, Crossing::in_middle(model, place, spring)));
                    });
                }
            }
        }
        found
    }

    /// Returns the largest strain of the whole springs between neighbours that end at one of some points; 0 if none is stretched.
    pub(in crate::state) fn largest_strain(&self, points: Vec<PointId>) -> f64 {
        let TissueState { model, tables, .. } = self;
        let u_m = |place: usize| self.end_motion_m(place)[0];
        let mut largest = 0.0;
        for place in points.into_iter().map(|point| model.place_of(point)).filter(|place| model.is_spring_end(*place)) {
            let (own_m, first_end) = (u_m(place), model.first_end(place));
            model.each_spring(place, |spring| {
                let stretch = stretch(model.unit_m * spring.rest, u_m(spring.other) - own_m);
                let is_whole =
                    || !tables.severed.has(first_end + spring.number) && model.joins_neighbours(place, &spring);
                if stretch > largest && is_whole() {
                    largest = stretch;
                }
            });
        }
        strain_of(largest)
    }

    /// Returns the whole springs that resist bending and whose ends no two whole springs in a row join, once `torn` are severed.
    pub(super) fn unspanned(&self, torn: &[Crossing]) -> Vec<Crossing> {
        let TissueState { model, tables, .. } = self;
        let is_torn = |place: usize, spring: &SpringEnd| {
            let ends = [place.min(spring.other), place.max(spring.other)];
            torn.iter().any(|torn| [torn.place, torn.spring.other] == ends)
        };
        let whole = |place: usize| {
            let first_end = model.first_end(place);
            model.springs_at(place).into_iter().filter(move |spring| !tables.severed.has(first_end + spring.number))
        };
        let joined = |place: usize| -> Vec<usize> {
            let joins = |spring: &SpringEnd| model.joins_neighbours(place, spring) && !is_torn(place, spring);
            whole(place).filter(joins).map(|spring| spring.other).collect()
        };
        let mut found = Vec::new();
        // A way of two springs by a torn one begins or ends at an end of that.
        for place in torn.iter().flat_map(|torn| [torn.place, torn.spring.other]) {
            let own = joined(place);
            for spring in whole(place).filter(|spring| !model.joins_neighbours(place, spring)) {
                if joined(spring.other).iter().any(|between| own.contains(between)) {
                    continue;
                }
                found.push(Crossing::in_middle(model, place, spring));
            }
        }
        found
    }
}

/// Returns the strain of a spring divided by its limit, if it is beyond that; `limit` gives it for a length at rest, m.
#[inline]
fn excess(rest_m: DVec3, delta_m: DVec3, limit: impl Fn(f64) -> Option<f64>) -> Option<f64> {
    let limit = limit(rest_m.length())?;
    let stretch = stretch(rest_m, delta_m);
    // Its root is taken of springs beyond the limit alone.
    (stretch > limit * (2.0 + limit)).then(|| strain_of(stretch) / limit)
}

/// Returns (L² − L₀²)/L₀² of a spring, without cancellation (`kernel::springs`): it grows with the strain.
#[inline]
fn stretch(rest_m: DVec3, delta_m: DVec3) -> f64 {
    let length_m = rest_m.length();
    (2.0 * rest_m + delta_m).dot(delta_m) / (length_m * length_m)
}

/// Returns the strain (L − L₀)/L₀ of a [`stretch`].
#[inline]
fn strain_of(stretch: f64) -> f64 {
    stretch / (1.0 + (1.0 + stretch).sqrt())
}

#[cfg(test)]
mod tests;
