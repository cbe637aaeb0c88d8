//! The anchor springs of a sheet or surface that blades sever, so that the tissue comes free of its bed.
//!
//! With `[cutting] anchor_depth_m` an anchor spring is a line: from its point, wherever that is now, to the place at which it is
//! attached, so far beneath the point's rest position. That place belongs to the bed and never moves. A blade severs the anchors whose
//! lines its edge crosses, by the same test as for other springs. So an edge that passes between the tissue and its bed frees the
//! tissue, and lifted tissue offers longer lines. An edge that passes beneath the bed's surface, or stands upright along the lines, severs none.
//!
//! The stiffness K″ of an anchor is the same as without a length: it pulls its point to where that rests.

use glam::DVec3;

use super::{Crossing, EdgeSweep};
use crate::body::severed::{ANCHOR, SeveredSpring};
use crate::body::spring_ends::SpringEnd;
use crate::body::spring_search::NearTile;
use crate::kernel::real::Real;
use crate::kernel::region::sides_of;
use crate::state::tissue_state::TissueState;

impl<T: Real> TissueState<T> {
    /// Returns the whole anchor springs that a blade crosses, in no order.
    pub(super) fn crossed_anchors(&self, sweep: &EdgeSweep) -> Vec<Crossing> {
        let TissueState { model, tables, state, tiles, spring_search, .. } = self;
        let (Some(search), Some(depth_m)) = (spring_search, model.scene.cutting.anchor_depth_m) else {
            return Vec::new();
        };
        let (layout, across) = (&tables.layout, model.points[1]);
        let [least_m, most_m] = sweep.bounds_m();
        let reach_m = DVec3::splat(depth_m);
        let around_m = [least_m - reach_m, most_m + reach_m];
        let mut found = Vec::new();
        let near = search.near(model, tables, state, &tiles.moved, around_m);
        let places = near.into_iter().flat_map(|NearTile { tile, .. }| {
            let [rows, columns] = sides_of(layout, tile);
            rows.flat_map(move |i| columns.clone().map(move |j| i * across + j))
        });
        for place in places {
            let [u_m, way_m] = self.end_motion_m(place);
            let rest_m = model.end_at_rest_m(place);
            let place_m = rest_m + u_m;
            let slack_m = reach_m + way_m.abs();
            let is_below = (place_m.max(rest_m) + slack_m).cmplt(least_m).any();
            if is_below || (place_m.min(rest_m) - slack_m).cmpgt(most_m).any() {
                continue;
            }
            let Some(spring) = self.whole_anchor(place) else { continue };
            // The end at the bed stays.
            let crossed = sweep.crosses(place_m, model.unit_m * spring.rest - u_m, 0.5 * way_m);
            found.extend(crossed.map(|part| Crossing { place, spring, part }));
        }
        found
    }

    /// Returns the anchor spring of the point at a place, severed in its middle, if it is whole and can be severed.
    pub(super) fn anchor_in_middle(&self, place: usize) -> Option<Crossing> {
        self.whole_anchor(place).map(|spring| Crossing { place, spring, part: 0.5 })
    }

    /// Returns the anchor spring of the point at a place if it is whole and can be severed.
    fn whole_anchor(&self, place: usize) -> Option<SpringEnd> {
        let TissueState { model, tables, .. } = self;
        if !model.has_severable_anchor(place) || tables.severed.has_anchor(place) {
            return None;
        }
        let stiffness_n_per_m = tables.anchor_stiffness_at_n_per_m(model, place);
        let anchor_m = model.scene.cutting.anchor_m(model.shape().normal(model.point_at(place)))?;
        let rest = anchor_m / model.unit_m;
        let anchor = SpringEnd { number: ANCHOR as usize, other: place, rest, stiffness_n_per_m, tension_n_per_m: 0.0 };
        (stiffness_n_per_m > 0.0).then_some(anchor)
    }

    /// Severs an anchor spring. Returns whether it was whole.
    pub(super) fn sever_anchor(&mut self, severed: SeveredSpring) -> bool {
        let (model, place) = (self.model.clone(), severed.ends[0] as usize);
        let stiffness_n_per_m = self.tables.anchor_stiffness_at_n_per_m(&model, place);
        if self.tables.sever(&model, severed).is_none() {
            return false;
        }
        // What bounds the error of sleeping tiles is gone.
        self.tiles.wake_all();
        let [u_m, _] = self.end_motion_m(place);
        let released_j = 0.5 * stiffness_n_per_m * u_m.length_squared();
        self.work.add(-released_j);
        self.tables.severed.add_fracture(released_j);
        self.take_from_history(place, -stiffness_n_per_m * u_m);
        true
    }
}

#[cfg(test)]
mod tests;
