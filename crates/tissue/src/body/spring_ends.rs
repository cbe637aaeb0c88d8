//! The springs of a tissue, seen from their ends: how severed springs are named, and what blades look through.

use glam::DVec3;

use crate::body::Places;
use crate::body::model::Model;
use crate::kernel::springs::ENDS;

/// The most springs that a point of a sheet has.
pub(crate) const SHEET_ENDS: usize = 12;

/// The faces of a cube: along each axis that with the higher coordinate, then the other.
const SOLID_ENDS: usize = 6;

/// A spring, seen from one of its ends.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SpringEnd {
    /// Its number among the springs of this end.
    pub(crate) number: usize,
    /// The place of the other end.
    pub(crate) other: usize,
    /// The vector to the other end at rest, units of length.
    pub(crate) rest: DVec3,
    pub(crate) stiffness_n_per_m: f64,
    /// The part of it that a pretension has.
    pub(crate) tension_n_per_m: f64,
}

impl Model {
    /// Calls `each` with the springs of the point at a place in memory, by ascending number. In a solid these are the faces of the cube
    /// of which the place is the least corner, towards other cubes.
    #[inline]
    pub(crate) fn each_spring(&self, place: usize, mut each: impl FnMut(SpringEnd)) {
        let springs = &self.scene.springs;
        match &self.places {
            Places::Sheet(_) => {
                let (along, shear) = (springs.stiffness_n_per_m, springs.shear_stiffness_n_per_m);
                let [i, j] = self.point_of(place);
                // A spring of no stiffness counts too: a tissue may get another one.
                for (kind, ends) in ENDS.iter().enumerate().take(if springs.bending { 3 } else { 2 }) {
                    let stiffness_n_per_m = [along, shear, along][kind];
                    let tension_n_per_m = if kind < 2 { self.prestrain * stiffness_n_per_m } else { 0.0 };
                    for (end, [di, dj]) in ends.iter().enumerate() {
                        // Below 0 it wraps, to beyond the last.
                        let [i1, j1] = [i.wrapping_add_signed(*di), j.wrapping_add_signed(*dj)];
                        if i1 >= self.points[0] || j1 >= self.points[1] {
                            continue;
                        }
                        #[allow(clippy::cast_precision_loss)]
                        let rest = DVec3::new(*di as f64, *dj as f64, 0.0);
                        let (number, other) = (4 * kind + end, self.index_of([i1, j1]));
                        each(SpringEnd { number, other, rest, stiffness_n_per_m, tension_n_per_m });
                    }
                }
            }
            Places::Surface(places) => {
                for (number, (other, rest, stiffness)) in places.joined(place).enumerate() {
                    let stiffness_n_per_m = springs.stiffness_n_per_m * stiffness;
                    let tension_n_per_m = self.prestrain * stiffness_n_per_m;
                    each(SpringEnd { number, other, rest, stiffness_n_per_m, tension_n_per_m });
                }
            }
            Places::Solid(places) => {
                for number in 0..SOLID_ENDS {
                    let (axis, is_higher) = (number / 2, number % 2 == 0);
                    let Some(other) = places.cube_across(place, axis, is_higher) else { continue };
                    let rest = if is_higher { DVec3::AXES[axis] } else { -DVec3::AXES[axis] };
                    each(SpringEnd { number, other, rest, stiffness_n_per_m: 0.0, tension_n_per_m: 0.0 });
                }
            }
        }
    }

    /// Returns whether springs may end at a place in memory: in a solid, whether it is the least corner of a cube.
    pub(crate) fn is_spring_end(&self, place: usize) -> bool {
        self.places.solid().is_none_or(|places| places.weight(place) > 0.0)
    }

    /// Returns where the end of a spring at a place in memory is at rest, m: in a solid the middle of a cube.
    pub(crate) fn end_at_rest_m(&self, place: usize) -> DVec3 {
        match &self.places {
            Places::Solid(places) => places.middle_m(place),
            Places::Surface(places) => places.rest_m(place),
            Places::Sheet(_) => self.shape().rest_m(self.point_at(place)),
        }
    }

    /// Returns whether a spring of a place joins neighbours, so that it stands for the material between them. The others resist bending.
    pub(crate) fn joins_neighbours(&self, place: usize, spring: &SpringEnd) -> bool {
        match &self.places {
            Places::Sheet(_) => spring.number < SHEET_ENDS - 4,
            Places::Surface(_) => self.shape().neighbours(self.point_at(place)).contains(&self.point_at(spring.other)),
            Places::Solid(_) => true,
        }
    }

    /// Returns the springs of the point at a place in memory, by ascending number.
    pub(crate) fn springs_at(&self, place: usize) -> Vec<SpringEnd> {
        let mut springs = Vec::new();
        self.each_spring(place, |spring| springs.push(spring));
        springs
    }

    /// Returns the number of the first of a place's springs, seen from there, among those of all places.
    pub(crate) fn first_end(&self, place: usize) -> usize {
        match &self.places {
            Places::Sheet(_) => SHEET_ENDS * place,
            Places::Surface(places) => places.slots.first_half(place),
            Places::Solid(_) => SOLID_ENDS * place,
        }
    }

    /// Returns the number of all springs, each counted from both ends; with those that points at the edge of a sheet lack.
    pub(crate) fn end_count(&self) -> usize {
        match &self.places {
            Places::Sheet(_) => SHEET_ENDS * self.place_count(),
            Places::Surface(places) => places.slots.count(),
            Places::Solid(places) => SOLID_ENDS * places.count(),
        }
    }

    /// Returns the number of a spring of a place among those of its other end. Panics if there is no such spring.
    pub(crate) fn number_at_other_end(&self, place: usize, number: usize) -> usize {
        let places = match &self.places {
            Places::Sheet(_) => return number / 4 * 4 + 3 - number % 4,
            Places::Solid(_) => return number ^ 1,
            Places::Surface(places) => places,
        };
        let others = || places.joined(place).map(|(other, ..)| other);
        let other = others().nth(number).unwrap_or_default();
        // Several springs may join the same points.
        let before = others().take(number).filter(|to| *to == other).count();
        let mut back = places.joined(other).enumerate().filter(|(_, (to, ..))| *to == place);
        back.nth(before).map_or(0, |(number, _)| number)
    }
}
