//! The corners of a lattice in memory: which are points, what they weigh, and the cubes around them.

use std::ops::Range;
use std::sync::Arc;

use glam::DVec3;
use palpate_geometry::surface::Surface;

use crate::body::tile_links::TileLinks;
use crate::kernel::field::{BLOCK, Field, Layout};
use crate::kernel::real::Real;
use crate::kernel::region::TILE;
use crate::memory;
use crate::scene::profile::Poke;
use crate::scene::{BodyKind, Solid, SolidShape};
use crate::shape::{PointId, RestShape};

/// Name of the tables in messages.
const TABLES: &str = "the cubes of a solid";

/// By how much more tissue around it a cube counts as deeper than its neighbour, in cubes: more than the rounding of their parts, by which
/// those of a flat plate differ. Beneath a flat surface it is 9.
const DEEPER_BY: f64 = 1e-3;

/// One spare place for each of so many corners: a cut through the middle of a block of 27³ cubes doubles a twenty-eighth of them.
const CORNERS_PER_SPARE: usize = 8;

/// The places of a solid. A place is a corner of the lattice: x runs fastest, then y. Beyond them are spare places, which cuts
/// use (`corner_copies`).
#[derive(Debug)]
pub(crate) struct SolidPlaces {
    shape: Arc<SolidShape>,
    /// Corners along each axis.
    corners: [usize; 3],
    /// Rows of spare places.
    spare_rows: usize,
    /// The weight of the cube of which each place is the least corner: its part times its factor of E.
    weights: Vec<f64>,
    /// The relative mass of each place; 0 where there is no point.
    masses: Vec<f64>,
    pub(crate) largest_mass: f64,
    /// The stiffness of the foundation at each place divided by its relative mass and by that of `foundation_n_per_m`; empty without a
    /// foundation.
    beds: Vec<f64>,
    /// The stiffness of the foundation of a face of a cube, N/m.
    pub(crate) foundation_n_per_m: f64,
    /// The acceleration that stress must balance, m/s².
    pub(crate) pull_m_per_s2: DVec3,
    pub(crate) links: TileLinks,
    /// μ/E and λ/E.
    lame_over_youngs: [f64; 2],
}

impl SolidPlaces {
    /// Lays out a solid.
    pub(crate) fn of(solid: &Solid) -> Self {
        let shape = solid.shape.clone();
        let corners = shape.lattice().cells.map(|cells| cells + 1);
        let count = shape.place_count();
        let mut weights = memory::zeroed(count, TABLES);
        for (cell, weight) in shape.cells().zip(solid.weights()) {
            weights[shape.corner(cell)] = *weight;
        }
        let mut masses = memory::zeroed(count, TABLES);
        for point in crate::shape::points(&*shape) {
            masses[shape.corner_of(point)] = solid.relative_mass(point);
        }
        let largest_mass = masses.iter().copied().fold(0.0, f64::max);
        let foundation_n_per_m = solid.foundation_n_per_m3() * shape.lattice().edge_m.powi(2);
        let mut beds = Vec::new();
        if foundation_n_per_m > 0.0 {
            beds = memory::zeroed(count, TABLES);
            for point in crate::shape::points(&*shape) {
                let place = shape.corner_of(point);
                beds[place] = solid.foundation_n_per_m(point) / foundation_n_per_m / masses[place];
            }
        }
        let mut places = SolidPlaces {
            shape,
            corners,
            spare_rows: count.div_ceil(CORNERS_PER_SPARE).div_ceil(corners[0]),
            weights,
            masses,
            largest_mass,
            beds,
            foundation_n_per_m,
            pull_m_per_s2: solid.gravity().pull_m_per_s2(),
            links: TileLinks::default(),
            lame_over_youngs: [solid.material.shear_over_youngs(), solid.material.lame_over_youngs()],
        };
        places.links = TileLinks::of(places.size(), |place| places.beside(place));
        places
    }

    /// Returns the number of rows and of columns in memory, with spare places.
    pub(crate) fn size(&self) -> [usize; 2] {
        [self.first_spare_row() + self.spare_rows, self.corners[0]]
    }

    /// Returns the first row of spare places: that of the next tile, so that no tile has both corners and copies.
    fn first_spare_row(&self) -> usize {
        self.corner_rows().next_multiple_of(TILE)
    }

    /// Returns the number of rows of corners; those of spare places follow.
    pub(crate) fn corner_rows(&self) -> usize {
        self.corners[1] * self.corners[2]
    }

    /// Returns the spare places.
    pub(crate) fn spare(&self) -> Range<usize> {
        let first = self.first_spare_row() * self.corners[0];
        first..first + self.spare_rows * self.corners[0]
    }

    /// Returns Lamé's μ and λ divided by E.
    pub(crate) fn lame_over_youngs(&self) -> [f64; 2] {
        self.lame_over_youngs
    }

    /// Returns the number of corners.
    pub(crate) fn count(&self) -> usize {
        self.masses.len()
    }

    /// Returns the part of a cube that counts for mass; 0 where there is none.
    pub(crate) fn cube_mass(&self, cube: usize) -> f64 {
        if self.weights[cube] > 0.0 { self.shape.mass_part_at(cube) } else { 0.0 }
    }

    /// Returns the number of rows of a plane across z.
    pub(crate) fn rows_per_plane(&self) -> usize {
        self.corners[1]
    }

    /// Returns the places that never move, ascending: those of fixed points, and those without a point.
    pub(crate) fn fixed(&self) -> Vec<usize> {
        let is_fixed = |place: &usize| self.masses[*place] == 0.0 || self.shape.is_fixed(self.point_at(*place));
        (0..self.count()).filter(is_fixed).collect()
    }

    /// Returns the relative mass of a corner before any cut; 0 at a spare place.
    pub(crate) fn mass(&self, place: usize) -> f64 {
        self.masses.get(place).copied().unwrap_or(0.0)
    }

    /// Returns the stiffness of the foundation at a place divided by its relative mass, in that of a face of a cube.
    pub(crate) fn bed(&self, place: usize) -> f64 {
        self.beds.get(place).copied().unwrap_or(0.0)
    }

    /// Returns the weight of the cube of which a place is the least corner; 0 where there is none.
    pub(crate) fn weight(&self, place: usize) -> f64 {
        self.weights.get(place).copied().unwrap_or(0.0)
    }

    pub(crate) fn place_of(&self, point: PointId) -> usize {
        self.shape.corner_of(point)
    }

    /// Returns the point at a place; the first point where there is none.
    pub(crate) fn point_at(&self, place: usize) -> PointId {
        if place < self.count() {
            self.shape.point_at_corner(place).unwrap_or(PointId::new(0))
        } else {
            PointId::new(0)
        }
    }

    /// Returns the point at each place (the number of none where there is none), and the place of each point.
    pub(crate) fn order(&self) -> [&[u32]; 2] {
        self.shape.order()
    }

    /// Returns the coordinates of a corner in the lattice.
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn coordinates(&self, place: usize) -> DVec3 {
        DVec3::from_array(self.shape.corner_at(place).map(|at| at as f64))
    }

    /// Returns the coordinates in the lattice of a place at rest, m.
    pub(crate) fn coordinates_at(&self, place_m: DVec3) -> DVec3 {
        self.shape.lattice().from_m(place_m)
    }

    /// Returns where coordinates in the lattice are at rest, m.
    pub(crate) fn at_m(&self, coordinates: DVec3) -> DVec3 {
        self.shape.lattice().origin_m + self.edge_m() * coordinates
    }

    /// Returns the surface that frames show, at rest.
    pub(crate) fn shown_surface(&self) -> &Surface {
        self.shape.surface().surface()
    }

    /// Returns the edge of a cube, m.
    pub(crate) fn edge_m(&self) -> f64 {
        self.shape.lattice().edge_m
    }

    /// Returns the rest position of a corner, m.
    pub(crate) fn rest_m(&self, place: usize) -> DVec3 {
        self.shape.corner_m(place)
    }

    /// Returns the middle at rest of the cube of which a place is the least corner, m.
    pub(crate) fn middle_m(&self, cube: usize) -> DVec3 {
        self.rest_m(cube) + 0.5 * self.edge_m()
    }

    /// Returns where the corners of a cube without copies are in a plane of a field, in the order of [`SolidPlaces::corners_of`].
    #[inline(always)]
    pub(crate) fn offsets_of(&self, layout: &Layout, cube: usize) -> [usize; 8] {
        let at = layout.offset(cube);
        let (across, up) = (at + layout.stride, at + layout.stride * self.corners[1]);
        [at, at + 1, across, across + 1, up, up + 1, up + layout.stride, up + layout.stride + 1]
    }

    /// Returns the places of the corners of the cube of which `cube` is the least corner: those farther along x after the
    /// nearer ones, then along y, then along z.
    #[inline(always)]
    pub(crate) fn corners_of(&self, cube: usize) -> [usize; 8] {
        let [x, y, _] = self.corners;
        let (across, up) = (cube + x, cube + x * y);
        [cube, cube + 1, across, across + 1, up, up + 1, up + x, up + x + 1]
    }

    /// Returns the cubes of which a place is a corner, `beside` (0 or 1) before it along x: in its own row, one row before
    /// along y, one before along z, and both. `None` where there is no cube.
    #[inline(always)]
    pub(crate) fn cubes_around(&self, place: usize, beside: usize) -> [Option<usize>; 4] {
        let [i, j, k] = self.shape.corner_at(place);
        let [x, y, _] = self.corners;
        let mut cubes = [None; 4];
        if place >= self.count() {
            return cubes;
        }
        for (row, cube) in cubes.iter_mut().enumerate() {
            let (by_y, by_z) = (row & 1, row >> 1);
            if i >= beside && j >= by_y && k >= by_z {
                let least = place - beside - by_y * x - by_z * x * y;
                *cube = (self.weights[least] > 0.0).then_some(least);
            }
        }
        cubes
    }

    /// Returns the cube on the other side of a face of a cube: across the face with the higher coordinate along an axis, or the lower.
    pub(crate) fn cube_across(&self, cube: usize, axis: usize, is_higher: bool) -> Option<usize> {
        let [x, y, _] = self.corners;
        let by = [1, x, x * y][axis];
        let is_first = || self.shape.corner_at(cube)[axis] == 0;
        let other = if is_higher { cube + by } else { (!is_first()).then(|| cube - by)? };
        // Beyond the last cube of a row there is a corner without one.
        (self.weight(cube) > 0.0 && self.weight(other) > 0.0).then_some(other)
    }

    /// Returns the cube with which a place at rest moves, m, by its least corner: the one in which it lies, or the nearest one.
    pub(crate) fn cube_at(&self, place_m: DVec3) -> usize {
        self.shape.corner_of(PointId::new(self.shape.bind(place_m).points[0] as usize))
    }

    /// Returns the deepest one of the cubes that share a face with a cube: around it is the most tissue, by more than [`DEEPER_BY`] than
    /// around the cube itself. `None` where no neighbour lies deeper, as in a plate that is as thin as a cube. From cube to cube this leads
    /// inward, and never in a circle.
    pub(crate) fn deeper_beside(&self, cube: usize) -> Option<usize> {
        let mut deepest = None;
        let mut most = self.tissue_around(cube) + DEEPER_BY;
        for (axis, is_higher) in (0..3).flat_map(|axis| [(axis, true), (axis, false)]) {
            let Some(other) = self.cube_across(cube, axis, is_higher) else { continue };
            let around = self.tissue_around(other);
            // Of equal ones the first.
            if around > most {
                (deepest, most) = (Some(other), around);
            }
        }
        deepest
    }

    /// Returns how much of a cube and of the 26 around it is inside, in cubes.
    fn tissue_around(&self, cube: usize) -> f64 {
        let (lattice, parts, at) = (self.shape.lattice(), self.shape.parts(), self.shape.corner_at(cube));
        let [x, y, z] = [0, 1, 2].map(|axis| at[axis].saturating_sub(1)..(at[axis] + 2).min(lattice.cells[axis]));
        let mut sum = 0.0;
        for k in z {
            for j in y.clone() {
                for i in x.clone() {
                    sum += f64::from(parts[lattice.index([i, j, k])]);
                }
            }
        }
        sum
    }

    /// Returns the places that share a cube with a place, with itself; some twice.
    fn beside(&self, place: usize) -> Vec<usize> {
        let cubes = [0, 1].into_iter().flat_map(|beside| self.cubes_around(place, beside)).flatten();
        cubes.flat_map(|cube| self.corners_of(cube)).collect()
    }

    /// Returns the first and the end of the rows and columns within a distance of a place.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(crate) fn reached(&self, centre_m: DVec3, reach_m: f64) -> [[usize; 2]; 2] {
        let lattice = self.shape.lattice();
        let [least, most] = [-reach_m, reach_m].map(|by_m| lattice.from_m(centre_m + by_m));
        // Saturating casts: a reach may be infinite.
        let range = |axis: usize| {
            let end = ((most[axis].floor() + 1.0).max(0.0) as usize).min(self.corners[axis]);
            [(least[axis].ceil().max(0.0) as usize).min(end), end]
        };
        let [x, y, z] = [range(0), range(1), range(2)];
        if [x, y, z].iter().any(|[from, to]| from == to) {
            return [[0, 0], [0, 0]];
        }
        let rows = self.rows_per_plane();
        [[z[0] * rows + y[0], (z[1] - 1) * rows + y[1]], [x[0] / BLOCK * BLOCK, x[1].next_multiple_of(BLOCK)]]
    }

    /// Returns the ends of the box around some rows and columns along each axis, m.
    pub(crate) fn box_of(&self, [rows, columns]: &[Range<usize>; 2]) -> [[f64; 2]; 3] {
        let lattice = self.shape.lattice();
        let y = self.corners[1];
        // Spare places are nowhere: the last row stands for them.
        let rows = rows.start.min(self.corner_rows() - 1)..rows.end.min(self.corner_rows());
        let [first, last] = [rows.start / y, (rows.end - 1) / y];
        // Rows of several planes may be anywhere along y.
        let along_y = if first == last { [rows.start % y, (rows.end - 1) % y] } else { [0, y - 1] };
        let ends = [[columns.start, columns.end - 1], along_y, [first, last]];
        #[allow(clippy::cast_precision_loss)]
        let at_m = |axis: usize, corner: usize| lattice.origin_m[axis] + lattice.edge_m * corner as f64;
        std::array::from_fn(|axis| ends[axis].map(|corner| at_m(axis, corner)))
    }

    /// Writes the falloff of `poke`, e^(−c·r) divided by the relative mass, over some rows and columns, and which part of
    /// each row is not 0. `corner_of` gives the corner of a place: a copy has the factor of its
    /// corner, so the force divides among them as the mass does.
    pub(crate) fn fall_off<T: Real>(
        &self,
        poke: &Poke,
        corner_of: impl Fn(usize) -> usize,
        layout: &Layout,
        [rows, columns]: [Range<usize>; 2],
        factors: &mut Field<T>,
        spans: &mut Vec<Range<usize>>,
    ) {
        spans.clear();
        let columns = columns.start..columns.end.min(layout.columns);
        for (factors, row) in factors.chunks_exact_mut(layout.stride).zip(rows) {
            let (mut first, mut end) = (usize::MAX, 0);
            for column in columns.clone() {
                let place = corner_of(row * layout.columns + column);
                let mass = self.mass(place);
                if mass == 0.0 {
                    factors[column] = T::default();
                    continue;
                }
                let exponent = -poke.falloff_per_m * self.rest_m(place).distance(poke.centre_m);
                let reaches = exponent >= T::NEGLIGIBLE_EXPONENT;
                factors[column] = if reaches { T::of(libm::exp(exponent) / mass) } else { T::default() };
                if factors[column] != T::default() {
                    (first, end) = (first.min(column), column + 1);
                }
            }
            spans.push(if first < end { first / BLOCK * BLOCK..end.next_multiple_of(BLOCK) } else { 0..0 });
        }
    }
}
