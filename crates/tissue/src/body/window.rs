//! The part of a tissue around a disc that notices the disc: its points and the springs between them.

use glam::{DMat3, DVec2, DVec3};

use crate::body::Places;
use crate::body::elements::{Elements, Spring};
use crate::body::footprint::Footprint;
use crate::body::model::Model;
use crate::body::severed::Cuts;
use crate::body::solid::corner_copies::CornerCopies;
use crate::body::solid::linear_cells::LinearCells;
use crate::scheme::Relaxation;

/// Size of the window around a disc, in lengths of decay: e⁻⁶ is left at its edge.
pub(crate) const REACHES: f64 = 6.0;

/// Memory of a point of a patch with six springs, and of the vectors of a solution. The work of a force law is
/// bounded, and so is its memory: 20 MB for the 116² points that 2^27 springs times iterations allow.
const BYTES_PER_POINT: usize =
    6 * size_of::<Spring>() + size_of::<DMat3>() + size_of::<DVec3>() + 8 * size_of::<[DVec3; 3]>() + 16;

/// The points around a disc that notice it: those that a patch computes. Those beyond are held at rest.
#[derive(Debug, Clone, PartialEq)]
pub enum Window {
    /// A rectangle of a sheet; its points are numbered row by row, i·columns + j.
    Grid {
        /// First row and first column, from 0.
        origin: [usize; 2],
        /// Number of rows and of columns.
        size: [usize; 2],
    },
    /// A ball of a mesh, as places in memory, ascending; those of copies of a solid's corners are the last.
    Ball(Vec<usize>),
}

impl Window {
    /// Returns this window with the copies of its corners that cuts have made in a solid.
    pub(crate) fn with_copies(mut self, cuts: &Cuts) -> Self {
        if let (Window::Ball(places), Some(copies)) = (&mut self, cuts.copies()) {
            let of_window = copies.places().filter(|copy| places.binary_search(&copies.corner_of(*copy)).is_ok());
            let of_window: Vec<usize> = of_window.collect();
            places.extend(of_window);
        }
        self
    }

    /// Returns the window around a footprint on `model`: all points within [`half_window_m`] of the disc's middle, on
    /// a sheet in both directions, on a mesh in space. Without anchor springs these are all points.
    pub fn around(model: &Model, footprint: &Footprint) -> Self {
        Self::at(model, footprint.radius_m(), footprint.anchor_m(), usize::MAX, f64::INFINITY)
    }

    /// Returns the window around a place of the rest surface; on a mesh, the points at most `reach_m` (m) away, and the radius
    /// shrinks until there are at most `most` points.
    pub(crate) fn at(model: &Model, radius_m: f64, centre_m: DVec3, most: usize, reach_m: f64) -> Self {
        match &model.places {
            Places::Sheet(_) => Self::of_sheet(model, radius_m, centre_m.truncate()),
            Places::Surface(_) | Places::Solid(_) => {
                let shape = model.shape();
                let mut within_m = half_window_m(model, radius_m).min(2.0 * shape.longest_side_m()).min(reach_m);
                let mut points = shape.around(centre_m, within_m);
                while points.len() > most && within_m > radius_m {
                    within_m *= 0.9;
                    points = shape.around(centre_m, within_m);
                }
                let mut slots: Vec<usize> = points.into_iter().map(|point| model.place_of(point)).collect();
                slots.sort_unstable();
                Window::Ball(slots)
            }
        }
    }

    fn of_sheet(model: &Model, radius_m: f64, centre_m: DVec2) -> Self {
        let centre = centre_m / model.unit_m;
        let half = half_window(model, radius_m);
        let (mut origin, mut size) = ([0; 2], [0; 2]);
        for axis in 0..2 {
            // Saturating casts: without anchor springs, the window has no bound.
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
            let [low, high] = [centre[axis] - half, centre[axis] + half].map(|edge| edge.round().max(0.0) as usize);
            origin[axis] = low.min(model.points[axis] - 1);
            size[axis] = high.min(model.points[axis] - 1) + 1 - origin[axis];
        }
        Window::Grid { origin, size }
    }

    /// Returns the window of all points, in the order of memory.
    pub(crate) fn all(model: &Model) -> Self {
        match &model.places {
            Places::Sheet(_) => Window::Grid { origin: [0; 2], size: model.points },
            Places::Surface(_) | Places::Solid(_) => Window::Ball((0..model.len()).collect()),
        }
    }

    /// Returns the number of points of the window.
    pub fn len(&self) -> usize {
        match self {
            Window::Grid { size, .. } => size[0] * size[1],
            Window::Ball(slots) => slots.len(),
        }
    }

    /// Returns whether the window has no point, as far from every point of a mesh.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the approximate number of points from the middle to where nothing is noticed.
    pub(crate) fn across(&self) -> usize {
        match self {
            Window::Grid { size, .. } => size[0].max(size[1]),
            Window::Ball(slots) => slots.len().isqrt(),
        }
    }

    /// Returns the memory of a patch of this window and of a solution, bytes.
    pub(crate) fn bytes(&self) -> u64 {
        (self.len() * BYTES_PER_POINT) as u64
    }

    /// Returns the places of the points in the memory of `model`, ascending: on a sheet, the index i·columns + j of
    /// the whole sheet; on a mesh, the slot.
    pub fn points(&self, model: &Model) -> impl Iterator<Item = usize> {
        let columns = model.points[1];
        (0..self.len()).map(move |at| match self {
            Window::Grid { origin, size } => (origin[0] + at / size[1]) * columns + origin[1] + at % size[1],
            Window::Ball(slots) => slots[at],
        })
    }

    /// Returns the index in the window of the point at a row and column of memory, if it is in the window.
    pub(crate) fn find(&self, model: &Model, point @ [i, j]: [usize; 2]) -> Option<usize> {
        match self {
            Window::Grid { origin, size } => {
                let place = (i.wrapping_sub(origin[0]), j.wrapping_sub(origin[1]));
                (place.0 < size[0] && place.1 < size[1]).then_some(place.0 * size[1] + place.1)
            }
            Window::Ball(slots) => slots.binary_search(&model.index_of(point)).ok(),
        }
    }

    /// Returns which of the points can move. Points at the border, whose springs lead out of the window, are
    /// held.
    pub(crate) fn free(&self, model: &Model, copies: Option<&CornerCopies>) -> Vec<bool> {
        let corner_of = |index: usize| copies.map_or(index, |copies| copies.corner_of(index));
        let is_fixed = |index: usize| model.fixed.binary_search(&corner_of(index)).is_ok();
        match self {
            Window::Ball(slots) => {
                let is_within = |slot: usize| slots.binary_search(&slot).is_ok();
                let is_free =
                    |slot: &usize| !is_fixed(*slot) && model.places.joined(*slot).all(|(other, ..)| is_within(other));
                slots.iter().map(is_free).collect()
            }
            Window::Grid { origin, size } => {
                let layers = model.spring_rows();
                let inside = |axis: usize, place: usize| {
                    (origin[axis] == 0 || place >= layers)
                        && (origin[axis] + size[axis] == model.points[axis] || place + layers < size[axis])
                };
                let is_free = |(at, index)| inside(0, at / size[1]) && inside(1, at % size[1]) && !is_fixed(index);
                self.points(model).enumerate().map(is_free).collect()
            }
        }
    }

    /// Returns what joins points of the window, at least one of which is `free`. Rest vectors are turned by `turn`.
    pub(crate) fn elements(
        &self,
        model: &Model,
        free: &[bool],
        turn: &DMat3,
        copies: Option<&CornerCopies>,
    ) -> Elements {
        if let (Places::Solid(places), Window::Ball(part)) = (&model.places, self) {
            let stiffness_n_per_m = model.scene.springs.stiffness_n_per_m;
            return Elements::Cells(LinearCells::of(places, copies, part, stiffness_n_per_m, model.unit_m, turn));
        }
        let mut springs = match self {
            Window::Ball(slots) => of_mesh(model, slots, free),
            Window::Grid { size, .. } => of_grid(model, *size, free),
        };
        springs.iter_mut().for_each(|spring| spring.rest_m = *turn * spring.rest_m);
        Elements::Springs(springs)
    }

    /// Returns Σ m·|∂u/∂x|² over the points, the mean of both directions of the surface, with the relative `masses` of
    /// the points (on a sheet, all 1).
    pub(crate) fn slopes(&self, model: &Model, springs: &[Spring], masses: &[f64], displacement_m: &[DVec3]) -> f64 {
        match self {
            Window::Grid { size, .. } => slopes_of_grid(model.unit_m, *size, displacement_m),
            Window::Ball(_) => slopes_along_springs(springs, masses, displacement_m),
        }
    }
}

/// Returns the sum of squared slopes at the inner points of a grid, from the differences of their neighbours.
fn slopes_of_grid(spacing_m: f64, size: [usize; 2], displacement_m: &[DVec3]) -> f64 {
    let mut sum = 0.0;
    for i in 1..size[0].saturating_sub(1) {
        for j in 1..size[1].saturating_sub(1) {
            let at = i * size[1] + j;
            let slope = |step: usize| displacement_m[at + step] - displacement_m[at - step];
            sum += slope(1).length_squared() + slope(size[1]).length_squared();
        }
    }
    sum / (8.0 * spacing_m * spacing_m)
}

/// Returns the sum of squared slopes; at each point the mean over its springs.
fn slopes_along_springs(springs: &[Spring], masses: &[f64], displacement_m: &[DVec3]) -> f64 {
    let mut of_points = vec![(0.0, 0.0); masses.len()];
    for Spring { ends: [a, b], rest_m, .. } in springs {
        let slope = (displacement_m[*b] - displacement_m[*a]).length_squared() / rest_m.length_squared();
        for end in [*a, *b] {
            of_points[end].0 += slope;
            of_points[end].1 += 1.0;
        }
    }
    let with_mass = of_points.iter().zip(masses).filter(|((_, count), _)| *count > 0.0);
    with_mass.map(|((slopes, count), mass)| mass * slopes / count).sum()
}

fn of_grid(model: &Model, size: [usize; 2], free: &[bool]) -> Vec<Spring> {
    let springs = &model.scene.springs;
    let (structural, shear) = (springs.stiffness_n_per_m, springs.shear_stiffness_n_per_m);
    let bending = if springs.bending { structural } else { 0.0 };
    let kinds = [(structural, [[1, 0], [0, 1]]), (shear, [[1, 1], [1, -1]]), (bending, [[2, 0], [0, 2]])];
    let mut found = Vec::new();
    for (stiffness_n_per_m, reach) in kinds.into_iter().filter(|kind| kind.0 > 0.0) {
        for [di, dj] in reach {
            for i in 0..size[0] {
                for j in 0..size[1] {
                    let (Some(i1), Some(j1)) = (i.checked_add_signed(di), j.checked_add_signed(dj)) else {
                        continue;
                    };
                    if i1 >= size[0] || j1 >= size[1] {
                        continue;
                    }
                    let ends = [i * size[1] + j, i1 * size[1] + j1];
                    if !(free[ends[0]] || free[ends[1]]) {
                        continue;
                    }
                    #[allow(clippy::cast_precision_loss)]
                    let rest_m = model.unit_m * DVec3::new(di as f64, dj as f64, 0.0);
                    let is_tense = di.abs().max(dj.abs()) < 2;
                    let tension_n_per_m = if is_tense { model.prestrain * stiffness_n_per_m } else { 0.0 };
                    found.push(Spring::new(ends, rest_m, stiffness_n_per_m, tension_n_per_m));
                }
            }
        }
    }
    found
}

fn of_mesh(model: &Model, slots: &[usize], free: &[bool]) -> Vec<Spring> {
    let mut found = Vec::new();
    for (one, slot) in slots.iter().enumerate() {
        for (other, rest, stiffness) in model.places.joined(*slot).filter(|(other, ..)| other > slot) {
            let Ok(other) = slots.binary_search(&other) else { continue };
            if free[one] || free[other] {
                let stiffness_n_per_m = model.scene.springs.stiffness_n_per_m * stiffness;
                let tension_n_per_m = model.prestrain * stiffness_n_per_m;
                found.push(Spring::new([one, other], model.unit_m * rest, stiffness_n_per_m, tension_n_per_m));
            }
        }
    }
    found
}

/// Returns the distance from the middle of a disc of `radius_m` at which points still notice it, in spacings h:
/// a/h + `REACHES`·l/h + 2, with l = h·√(k/K″) the length over which displacements fall by e ([`Relaxation::reach`]);
/// infinite without anchor springs, and in a solid, where displacements fall as 1/r.
fn half_window(model: &Model, radius_m: f64) -> f64 {
    let scene = &model.scene;
    if model.places.solid().is_some() {
        return f64::INFINITY;
    }
    let springs = &scene.springs;
    let stiffest = springs.stiffness_n_per_m.max(springs.shear_stiffness_n_per_m);
    radius_m / model.unit_m + REACHES * Relaxation::of(scene).reach(stiffest) + 2.0
}

/// Returns the distance from the middle of a disc at which points still notice it, m: a + 6·h·√(k/K″) + 2h, with a =
/// `radius_m` (m), h the distance between points, m (on a mesh, the mean edge), k the larger stiffness of structural
/// and shear springs and K″ that of an anchor spring, N/m. The root counts as at least 1. Infinite without anchor
/// springs (K″ = 0), and in a solid.
pub fn half_window_m(model: &Model, radius_m: f64) -> f64 {
    half_window(model, radius_m) * model.unit_m
}
