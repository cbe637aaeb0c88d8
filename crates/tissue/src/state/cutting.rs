//! What is severed in a step: by the edges of blades (anchor springs in `anchors`), by heat (`burning`, which stiffens it first), and by strain (`tearing`). And
//! between two steps: what a server reports (`reported`).
//!
//! In a step the edge of a blade sweeps a surface, from the line between its tip and its heel at the step's beginning to that at
//! the step's end: two triangles. A spring that crosses one of them is severed. The tissue moves as well, so the edge
//! is taken as it moves against the spring: its line at the beginning is shifted by the way of the spring's middle in this step.
//!
//! That way is the velocity at the end of the step times the step, which differs from the true one in second order. So the edge
//! begins [`BACK`] of its way farther back: two successive sweeps overlap and leave no gap.
//!
//! **The same everywhere.** The tests are exact comparisons of signed volumes in f64, from a state that has the same bits on every
//! machine. A volume of exactly 0 counts as positive. Springs are severed in ascending order.
//!
//! **Solids.** A face between two cubes is severed like a spring between their middles (`faces`).
//!
//! **What follows.** With a pretension, a severed spring leaves the load that held the rest shape against it
//! (`kernel::springs`): the wound gapes. A multistep scheme keeps the past forces of the springs at each point: the present force of a severed
//! spring is taken out of all of them, as if it had always been severed. Its energy leaves the tissue: it opens the cut. Severing only
//! lowers the fastest vibration, so the substep stays stable.

use glam::DVec3;

use crate::body::model::{Model, displacement_m};
use crate::body::severed::{ANCHOR, SeveredSpring};
use crate::body::spring_ends::SpringEnd;
use crate::body::spring_search::SpringSearch;
use crate::kernel::real::Real;
use crate::stage_times::StepStage;
use crate::state::tissue_state::TissueState;
use crate::tools::contact::Tool;
use palpate_haptics::TipShape;

/// By what part of its way the edge begins farther back.
const BACK: f64 = 0.05;

/// A spring is found if it is, with its way in a step, at most this many times as long as the longest one at rest.
const MAX_STRETCH: f64 = 4.0;

/// The way of a blade's edge in a step: tip and heel at its beginning and its end, m.
#[derive(Debug, Clone, Copy)]
struct EdgeSweep {
    from_m: [DVec3; 2],
    to_m: [DVec3; 2],
}

impl EdgeSweep {
    fn of(tool: &Tool) -> Self {
        let to_m = [tool.to_m, tool.to_m + tool.tip.edge_m];
        let from_m = [tool.from_m, tool.from_m + tool.from_edge_m];
        let from_m = [0, 1].map(|end| from_m[end] - BACK * (to_m[end] - from_m[end]));
        EdgeSweep { from_m, to_m }
    }

    /// Returns the corners of the box around it.
    fn bounds_m(&self) -> [DVec3; 2] {
        let [a, b] = self.from_m;
        let [c, d] = self.to_m;
        [a.min(b).min(c).min(d), a.max(b).max(c).max(d)]
    }

    /// Returns where it crosses the line between two points, the second of which is reached by `span_m` from the first, as the part of
    /// the way there; `None` if it does not. `moved_m` is the way of the line in the step.
    fn crosses(&self, from_m: DVec3, span_m: DVec3, moved_m: DVec3) -> Option<f64> {
        // All places from the first end on: differences are then small.
        let [tip, heel] = self.from_m.map(|place_m| place_m + moved_m - from_m);
        let [tip_after, heel_after] = self.to_m.map(|place_m| place_m - from_m);
        // On which side of the line each directed side of the triangles lies. The diagonal is shared, and the edge's lines are those of
        // the sweeps before and after: each has one direction, so that a line through it crosses exactly one of both.
        let is_left = |a: DVec3, b: DVec3| span_m.dot(a.cross(b)) >= 0.0;
        let diagonal = is_left(tip, heel_after);
        let (first, last) = (is_left(tip, heel), is_left(tip_after, tip));
        let (beyond, before) = (is_left(heel, heel_after), !is_left(tip_after, heel_after));
        let [b, c] = if first == beyond && beyond != diagonal {
            [heel, heel_after]
        } else if diagonal == before && before == last {
            [heel_after, tip_after]
        } else {
            return None;
        };
        let normal = (b - tip).cross(c - tip);
        let [begin, end] = [-tip.dot(normal), (span_m - tip).dot(normal)];
        ((begin >= 0.0) != (end >= 0.0)).then(|| (begin / (begin - end)).clamp(0.0, 1.0))
    }
}

/// A spring that is severed, by its first end, and at which part of the way to the other.
#[derive(Debug, Clone, Copy)]
struct Crossing {
    place: usize,
    spring: SpringEnd,
    part: f64,
}

/// How far a spring is stretched, seen from one of its ends.
#[derive(Debug, Clone, Copy)]
struct SpringStretch {
    /// The vector to the other end at rest, m.
    rest_m: DVec3,
    /// The displacement of the other end from that, m.
    delta_m: DVec3,
    /// L/L0 − 1.
    extension: f64,
    /// 1 − L0/L; 0 for a spring of no length, which has no direction.
    along: f64,
}

impl Crossing {
    /// Returns a spring that is severed in its middle, from its first end; `place` is one of both.
    fn in_middle(model: &Model, place: usize, spring: SpringEnd) -> Self {
        let part = 0.5;
        if spring.other > place {
            return Crossing { place, spring, part };
        }
        let number = model.number_at_other_end(place, spring.number);
        let other = SpringEnd { number, other: place, rest: -spring.rest, ..spring };
        Crossing { place: spring.other, spring: other, part }
    }
}

impl<T: Real> TissueState<T> {
    /// Prepares the search for springs that blades cross, and room for what they sever, once.
    pub(super) fn prepare_to_cut(&mut self) {
        self.tables.prepare_to_cut();
        if self.spring_search.is_none() {
            let tiles = self.tiles.tile_count();
            self.spring_search = Some(SpringSearch::of(&self.model, &self.tables.layout, tiles));
        }
    }

    /// Severs the springs that blades cross in this step, those that burn through, and those that tear.
    pub(super) fn cut(&mut self) {
        for tool in &mut self.contacts.tools {
            let separated_j = std::mem::take(&mut tool.separated_j);
            self.tables.severed.add_fracture(separated_j);
            if separated_j > 0.0 {
                // When tough tissue gives way, a twin that steps otherwise does so at another moment.
                self.audit_window.give_up();
            }
        }
        let burnt = self.burnt();
        let blades = self.contacts.tools.iter().filter(|tool| tool.tip.shape == TipShape::Blade);
        let sweeps: Vec<EdgeSweep> = blades.map(EdgeSweep::of).collect();
        if sweeps.is_empty() && burnt.is_empty() && self.model.scene.cutting.tear_strain.is_none() {
            return;
        }
        if !sweeps.is_empty() {
            self.prepare_to_cut();
        }
        let crossed =
            |sweep| if self.model.places.solid().is_some() { self.crossed_faces(sweep) } else { self.crossed(sweep) };
        let mut crossings: Vec<Crossing> = sweeps.iter().flat_map(crossed).collect();
        crossings.extend(sweeps.iter().flat_map(|sweep| self.crossed_anchors(sweep)));
        crossings.extend(burnt);
        crossings.extend(self.torn());
        crossings.sort_unstable_by_key(|crossing| (crossing.place, crossing.spring.number));
        crossings.dedup_by_key(|crossing| (crossing.place, crossing.spring.number));
        self.sever_all(&crossings);
        self.ended(StepStage::Contact);
    }

    /// Severs the whole ones of some springs, in a new version of the topology. Returns whether there was any.
    fn sever_all(&mut self, crossings: &[Crossing]) -> bool {
        if crossings.is_empty() || !self.tables.severed.has_room(&self.model) {
            return false;
        }
        let version = self.tables.severed.version() + 1;
        let mut any = false;
        // Discs share the copies of corners, which change.
        self.contacts.follow_cuts(&self.model, None);
        self.applied.give_up_copies();
        for crossing in crossings {
            any |= self.sever(crossing, version);
        }
        self.follow_cuts();
        if any {
            self.tables.severed.begin_version(version);
            // A twin that steps otherwise severs other springs: that is no error of the stepping.
            self.audit_window.give_up();
        }
        any
    }

    /// Lets tools act on the copies of corners that there are now, and tiles sleep as far as the anchors that are left allow.
    pub(super) fn follow_cuts(&mut self) {
        self.tiles.has_severed_anchors = self.tables.severed.anchor_count() > 0;
        let copies = self.tables.severed.copies().cloned();
        self.contacts.follow_cuts(&self.model, copies.as_ref());
        if let Some(copies) = &copies {
            self.applied.follow_cuts(&self.model, &self.tables.layout, copies);
        }
    }

    /// Returns the springs that a blade crosses, from their first ends; some perhaps twice.
    fn crossed(&self, sweep: &EdgeSweep) -> Vec<Crossing> {
        let TissueState { model, plan, tables, state, tiles, spring_search, .. } = self;
        let (Some(search), mut found) = (spring_search, Vec::new()) else { return Vec::new() };
        let (layout, across) = (&tables.layout, model.points[1]);
        let [least_m, most_m] = sweep.bounds_m();
        let reach_m = DVec3::splat(0.5 * MAX_STRETCH * search.longest_m());
        let is_near = |place_m: DVec3| place_m.cmpge(least_m - reach_m).all() && place_m.cmple(most_m + reach_m).all();
        let ways = f64::from(plan.substeps) * model.unit_m;
        // Displacement, and way in this step.
        let motion = |place: usize| {
            let at = place / across * layout.stride + place % across;
            let vector = |field: &[T]| {
                let component = |c: usize| field[c * layout.plane + at].wide();
                DVec3::new(component(0), component(1), component(2))
            };
            (model.unit_m * vector(&state.u), ways * vector(&state.d))
        };
        let around_m = [least_m - reach_m, most_m + reach_m];
        for tile in search.near(model, tables, state, &tiles.moved, around_m) {
            for (row, columns) in search.rows_near(model, layout, tile, around_m) {
                for column in columns {
                    self.crossed_at(row * across + column, sweep, &is_near, &motion, &mut found);
                }
            }
        }
        found
    }

    /// Adds the springs of a place that a blade crosses, if the place is near it.
    #[inline]
    fn crossed_at(
        &self,
        place: usize,
        sweep: &EdgeSweep,
        is_near: &impl Fn(DVec3) -> bool,
        motion: &impl Fn(usize) -> (DVec3, DVec3),
        found: &mut Vec<Crossing>,
    ) {
        let TissueState { model, tables, .. } = self;
        let (u_m, way_m) = motion(place);
        let place_m = model.end_at_rest_m(place) + u_m;
        if !is_near(place_m) {
            return;
        }
        let [least_m, most_m] = sweep.bounds_m();
        let first_end = model.first_end(place);
        model.each_spring(place, |spring| {
            let (other_u_m, other_way_m) = motion(spring.other);
            let span_m = model.unit_m * spring.rest + (other_u_m - u_m);
            // The other end finds it too.
            if spring.other < place && is_near(place_m + span_m) {
                return;
            }
            let moved_m = 0.5 * (way_m + other_way_m);
            let (low_m, high_m) = (span_m.min(DVec3::ZERO), span_m.max(DVec3::ZERO));
            let slack_m = moved_m.abs();
            if (place_m + high_m + slack_m).cmplt(least_m).any() || (place_m + low_m - slack_m).cmpgt(most_m).any() {
                return;
            }
            if tables.severed.has(first_end + spring.number) {
                return;
            }
            // Named by its first end.
            let (first, first_m, spring, span_m) = if spring.other > place {
                (place, place_m, spring, span_m)
            } else {
                let number = model.number_at_other_end(place, spring.number);
                let from_other = SpringEnd { number, other: place, rest: -spring.rest, ..spring };
                (spring.other, place_m + span_m, from_other, -span_m)
            };
            if let Some(part) = sweep.crosses(first_m, span_m, moved_m) {
                found.push(Crossing { place: first, spring, part });
            }
        });
    }

    /// Severs a spring. Returns whether it was whole.
    #[allow(clippy::cast_possible_truncation)]
    fn sever(&mut self, crossing: &Crossing, version: u32) -> bool {
        let Crossing { place, spring, part } = *crossing;
        if spring.number == ANCHOR as usize {
            return self.sever_anchor(SeveredSpring::anchor(place, part, version));
        }
        let ends = [place, spring.other];
        let severed =
            SeveredSpring { ends: ends.map(|place| place as u32), number: spring.number as u32, part, version };
        let model = self.model.clone();
        if model.places.solid().is_some() {
            return self.sever_face(severed);
        }
        if self.tables.sever(&model, severed).is_none() {
            return false;
        }
        for place in ends {
            self.tiles.wake_around(model.point_of(place), self.plan.scheme.sweeps());
        }
        let SpringStretch { rest_m, delta_m, extension, along } = self.stretch(place, &spring);
        // The force of the spring, less what a pretension leaves of it.
        let stiffness_n_per_m = self.tables.severed.burnt().of_spring(ends) * spring.stiffness_n_per_m;
        let (tension_n_per_m, slack_n_per_m) = (spring.tension_n_per_m, stiffness_n_per_m - spring.tension_n_per_m);
        let force_n = (slack_n_per_m * along + tension_n_per_m) * (rest_m + delta_m);
        let stored_j = 0.5 * slack_n_per_m * rest_m.length_squared() * extension * extension
            + 0.5 * tension_n_per_m * delta_m.length_squared();
        let released_j = tension_n_per_m * rest_m.dot(delta_m) + stored_j;
        self.work.add(-released_j);
        self.tables.severed.add_fracture(released_j);
        self.take_from_history(place, force_n);
        self.take_from_history(spring.other, -force_n);
        true
    }

    /// Returns how far a spring of a place is stretched.
    fn stretch(&self, place: usize, spring: &SpringEnd) -> SpringStretch {
        let (model, layout) = (&self.model, &self.tables.layout);
        let u_m = |place: usize| displacement_m(model, layout, &self.state, model.point_of(place));
        let (rest_m, delta_m) = (model.unit_m * spring.rest, u_m(spring.other) - u_m(place));
        // 1 − L0/L without cancellation (`kernel::springs`).
        let q = ((2.0 * rest_m + delta_m).dot(delta_m) / rest_m.length_squared()).max(-1.0);
        let s = (1.0 + q).sqrt();
        let extension = q / (1.0 + s);
        SpringStretch { rest_m, delta_m, extension, along: if s > 0.0 { extension / s } else { 0.0 } }
    }

    /// Takes a force of a spring on the point at a place, N, out of the past forces that a multistep scheme keeps: that of a severed spring.
    fn take_from_history(&mut self, place: usize, force_n: DVec3) {
        let (model, layout) = (&self.model, self.tables.layout);
        let change = self.plan.spring_unit(&model.scene) / model.relative_mass_at(place) * force_n;
        let history = self.plan.scheme.history();
        for kept in &mut self.state.kept[..history] {
            let kept = std::sync::Arc::make_mut(kept);
            for c in 0..3 {
                kept[c * layout.plane + layout.offset(place)] -= T::of(change[c]);
            }
        }
    }
}

mod anchors;
mod burning;
mod faces;
mod reported;
mod tearing;
#[cfg(test)]
mod tests;
