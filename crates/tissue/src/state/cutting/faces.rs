//! Blades in solids: which faces between cubes they cross, and what becomes of the corners of these cubes.
//!
//! A face is severed if the edge crosses the line between the middles of its cubes. A cube's middle is the mean of its
//! corners. A doubled corner's copies begin where it is, with its velocity, so severing neither takes nor gives energy: what opens the
//! cut afterwards was stored in the cubes.

use std::sync::Arc;

use glam::DVec3;

use super::{Crossing, EdgeSweep};
use crate::body::severed::SeveredSpring;
use crate::body::solid::SolidPlaces;
use crate::body::solid::corner_copies::{CornerCopies, CutCube};
use crate::body::spring_ends::SpringEnd;
use crate::body::spring_search::NearTile;
use crate::body::tables::SweepTables;
use crate::kernel::real::Real;
use crate::kernel::region::sides_of;
use crate::state::tissue_state::TissueState;

/// How far beyond a sweep's box the middles of cubes are looked for, in edges: faces are found from the lower one of their cubes.
const REACH: f64 = 2.0;

/// How much farther a cube's middle may be than its least corner shows, in edges.
const SLACK: f64 = 0.75;

/// How much farther the rows and columns are looked for in which cubes may be near, in edges.
const ROUNDING: f64 = 1e-6;

/// The axes.
const AXES: usize = 3;

/// A cube near a blade.
#[derive(Debug, Clone, Copy)]
struct NearCube {
    cube: usize,
    /// Its middle at the end of the step, and the displacement and the way in the step of its middle, m.
    middle_m: DVec3,
    u_m: DVec3,
    way_m: DVec3,
}

impl<T: Real> TissueState<T> {
    /// Returns the faces that a blade crosses, from the lower one of their cubes.
    pub(super) fn crossed_faces(&self, sweep: &EdgeSweep) -> Vec<Crossing> {
        let TissueState { model, tables, .. } = self;
        let (Some(places), mut found) = (model.places.solid(), Vec::new()) else { return Vec::new() };
        let [least_m, most_m] = sweep.bounds_m();
        let near = self.cubes_near(places, [least_m, most_m]);
        let reach_m = REACH * model.unit_m;
        for (index, own) in near.iter().enumerate() {
            let NearCube { cube, middle_m, u_m, way_m } = *own;
            if !is_within([least_m, most_m], reach_m, middle_m) {
                continue;
            }
            for axis in 0..AXES {
                let number = 2 * axis;
                let Some(other) = places.cube_across(cube, axis, true) else { continue };
                if tables.severed.has(model.first_end(cube) + number) {
                    continue;
                }
                // The next one along x follows; most others are in the list as well.
                let after = &near[index + 1..];
                let beyond = match after.binary_search_by_key(&other, |near| near.cube) {
                    Ok(at) => after[at],
                    Err(_) => self.near_cube(places, other),
                };
                let span_m = model.unit_m * DVec3::AXES[axis] + (beyond.u_m - u_m);
                let moved_m = 0.5 * (way_m + beyond.way_m);
                let (low_m, high_m) = (span_m.min(DVec3::ZERO), span_m.max(DVec3::ZERO));
                let slack_m = moved_m.abs();
                if (middle_m + high_m + slack_m).cmplt(least_m).any()
                    || (middle_m + low_m - slack_m).cmpgt(most_m).any()
                {
                    continue;
                }
                if let Some(part) = sweep.crosses(middle_m, span_m, moved_m) {
                    let rest = DVec3::AXES[axis];
                    let spring = SpringEnd { number, other, rest, stiffness_n_per_m: 0.0, tension_n_per_m: 0.0 };
                    found.push(Crossing { place: cube, spring, part });
                }
            }
        }
        found
    }

    /// Returns the cubes whose least corners are near a box, ascending.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn cubes_near(&self, places: &SolidPlaces, within_m: [DVec3; 2]) -> Vec<NearCube> {
        let TissueState { model, tables, state, tiles, spring_search, .. } = self;
        let (Some(search), mut near) = (spring_search, Vec::new()) else { return Vec::new() };
        let layout = &tables.layout;
        // By the displacement of the least corner alone: a cube's middle follows.
        let reach_m = (REACH + SLACK) * model.unit_m;
        let [least_m, most_m] = within_m;
        let near_tiles = search.near(model, tables, state, &tiles.moved, [least_m - reach_m, most_m + reach_m]);
        for NearTile { tile, displaced } in near_tiles {
            let [rows, columns] = sides_of(layout, tile);
            // Where a cube's least corner is at rest if it is near, with room for rounding.
            let slack_m = reach_m + ROUNDING * model.unit_m;
            let from_m = least_m - slack_m - model.unit_m * displaced[1];
            let to_m = most_m + slack_m - model.unit_m * displaced[0];
            for row in rows {
                // Without the divisions that find one cube's place.
                let (first_m, from) = (model.end_at_rest_m(row * layout.columns), row * layout.stride);
                if (first_m.cmplt(from_m) | first_m.cmpgt(to_m)).bitmask() & 0b110 != 0 {
                    continue;
                }
                // Saturating casts: the ends may be anywhere.
                let [begin, end] = [from_m.x, to_m.x].map(|x_m| (x_m - first_m.x) / model.unit_m);
                let begin = columns.start.max(begin.ceil().max(0.0) as usize);
                let end = columns.end.min((end.floor() + 1.0).max(0.0) as usize);
                for column in begin..end {
                    let cube = row * layout.columns + column;
                    #[allow(clippy::cast_precision_loss)]
                    let at_m =
                        first_m + model.unit_m * (column as f64 * DVec3::X + self.vector_at(&state.u, from + column));
                    if is_within(within_m, reach_m, at_m) && places.weight(cube) > 0.0 {
                        near.push(self.near_cube(places, cube));
                    }
                }
            }
        }
        // Beside a cut, a cube may be where its least corner is not, but a copy of it.
        let cut = tables.severed.copies().map_or(&[][..], |copies| copies.cubes());
        for (number, CutCube { cube, middle_m, corners }) in cut.iter().enumerate() {
            if corners[0] == *cube {
                continue;
            }
            let Some([at, ..]) = tables.cut_offsets(number) else { continue };
            if is_within(within_m, reach_m, *middle_m + model.unit_m * self.vector_at(&state.u, at)) {
                near.push(self.near_cube(places, *cube as usize));
            }
        }
        near.sort_unstable_by_key(|near| near.cube);
        near.dedup_by_key(|near| near.cube);
        near
    }

    /// Returns where a cube is.
    fn near_cube(&self, places: &SolidPlaces, cube: usize) -> NearCube {
        let [u_m, way_m] = self.middle_motion_m(places, cube);
        NearCube { cube, middle_m: self.model.end_at_rest_m(cube) + u_m, u_m, way_m }
    }

    /// Returns the displacement of the end of a spring and its way in this step, m: in a solid of the middle of a cube.
    pub(super) fn end_motion_m(&self, place: usize) -> [DVec3; 2] {
        let TissueState { model, plan, state, .. } = self;
        if let Some(places) = model.places.solid() {
            return self.middle_motion_m(places, place);
        }
        let substeps = f64::from(plan.substeps);
        [model.unit_m * self.vector(&state.u, place), model.unit_m * substeps * self.vector(&state.d, place)]
    }

    /// Returns the displacement of the middle of a cube and its way in this step, m.
    fn middle_motion_m(&self, places: &SolidPlaces, cube: usize) -> [DVec3; 2] {
        let TissueState { model, plan, tables, state, .. } = self;
        let number = tables.severed.copies().and_then(|copies| copies.number_of(cube));
        let of_cut = number.and_then(|number| tables.cut_offsets(number));
        let corners = of_cut.unwrap_or_else(|| places.offsets_of(&tables.layout, cube));
        let (mut u, mut d) = (DVec3::ZERO, DVec3::ZERO);
        for at in corners {
            u += self.vector_at(&state.u, at);
            d += self.vector_at(&state.d, at);
        }
        let eighth_m = 0.125 * model.unit_m;
        [eighth_m * u, eighth_m * f64::from(plan.substeps) * d]
    }

    /// Returns the value of a field at a place.
    #[inline]
    fn vector(&self, field: &[T], place: usize) -> DVec3 {
        self.vector_at(field, self.tables.layout.offset(place))
    }

    /// Returns the value of a field at an offset within a plane.
    #[inline]
    fn vector_at(&self, field: &[T], at: usize) -> DVec3 {
        let component = |c: usize| field[c * self.tables.layout.plane + at].wide();
        DVec3::new(component(0), component(1), component(2))
    }

    /// Severs a face. Returns whether it was whole, and there was room for the corners that this doubles.
    pub(super) fn sever_face(&mut self, face: SeveredSpring) -> bool {
        let model = self.model.clone();
        if !self.tables.severed.has_room(&model) {
            return false;
        }
        let before = self.forces_before(&face);
        let Some(doubled) = self.tables.sever(&model, face) else { return false };
        // A solid with cuts is awake as a whole, or asleep.
        self.tiles.wake_all();
        let layout = self.tables.layout;
        for copy in &doubled {
            let [from, to] = [copy.from, copy.to].map(|place| layout.offset(place));
            for field in self.state.fields_mut() {
                for c in 0..3 {
                    field[c * layout.plane + to] = field[c * layout.plane + from];
                }
            }
        }
        // Of a multistep scheme's past forces, as if the face had always been severed.
        let history = self.plan.scheme.history();
        for copy in &doubled {
            let known = before.iter().find(|(place, _)| *place == copy.from);
            let Some((_, then)) = known else { continue };
            for place in [copy.from, copy.to] {
                let now = self.force_at(place);
                for kept in &mut self.state.kept[..history] {
                    let kept = Arc::make_mut(kept);
                    for c in 0..3 {
                        kept[c * layout.plane + layout.offset(place)] += T::of(now[c] - then[c]);
                    }
                }
            }
        }
        true
    }

    /// Returns the places that severing a face doubles, with the force on each divided by its mass, in the scheme's units; none if the
    /// scheme keeps no past forces.
    fn forces_before(&self, face: &SeveredSpring) -> Vec<(usize, [f64; 3])> {
        let TissueState { model, plan, tables: SweepTables { severed, .. }, .. } = self;
        let Some(places) = model.places.solid().filter(|_| plan.scheme.history() > 0) else { return Vec::new() };
        let face = (face.ends[0] as usize, face.number as usize / 2);
        let is_severed = |cube, axis| (cube, axis) == face || severed.has(model.first_end(cube) + 2 * axis);
        let doubled = match severed.copies() {
            Some(copies) => copies.doubled_by(places, face, is_severed),
            None => CornerCopies::none(places).doubled_by(places, face, is_severed),
        };
        doubled.into_iter().map(|place| (place, self.force_at(place))).collect()
    }

    fn force_at(&self, place: usize) -> [f64; 3] {
        let TissueState { model, tables, state, .. } = self;
        let point = model.point_of(place);
        tables.springs.gather(&tables.severed, &tables.layout, &state.u, 0.0, point).map(Real::wide)
    }
}

/// Returns whether a place is within a distance of a box along each axis, m.
#[inline]
fn is_within([least_m, most_m]: [DVec3; 2], reach_m: f64, place_m: DVec3) -> bool {
    place_m.cmpge(least_m - reach_m).all() && place_m.cmple(most_m + reach_m).all()
}

#[cfg(test)]
pub(super) mod tests;
