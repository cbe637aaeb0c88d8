//! The planes along which blades have gone through a solid, by the places where they crossed the lines between the middles of cubes.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DMat3, DVec3};

use crate::body::solid::places::SolidPlaces;

/// The crossings of some severed faces.
#[derive(Debug, Clone, Copy)]
pub(super) struct Crossings {
    /// Number of faces across each axis.
    axes: [f64; 3],
    /// The sum of the crossings, and that of their products, from the least corner of the lattice, in edges.
    sum: DVec3,
    products: DMat3,
    /// The versions of the first and the last of these faces.
    pub(super) versions: [u32; 2],
}

/// How much a plane through crossings resists a slope, by the mean square of their distances, in edges: crossings in a row say nothing
/// about the slope across it.
const PLANE_REGULARISATION: f64 = 1e-4;

/// Crossings whose spreads along two axes have a smaller product, in edges⁴, are about in a row: faces of two rows have 1/16 or more.
const MIN_SPREAD: f64 = 0.03;

/// How often a vertex outside the tissue is moved to the nearest place of its surface and back to the plane.
const MAX_TURNS: usize = 4;

impl Crossings {
    pub(super) fn none(version: u32) -> Self {
        Crossings { axes: [0.0; 3], sum: DVec3::ZERO, products: DMat3::ZERO, versions: [version; 2] }
    }

    /// Adds the crossing of a face across an axis.
    pub(super) fn add_face(&mut self, axis: usize, at: DVec3, version: u32) {
        self.axes[axis] += 1.0;
        self.sum += at;
        self.products += DMat3::from_cols(at.x * at, at.y * at, at.z * at);
        self.versions[1] = self.versions[1].max(version);
    }

    fn add(&mut self, other: &Self) {
        (0..3).for_each(|axis| self.axes[axis] += other.axes[axis]);
        self.sum += other.sum;
        self.products += other.products;
        self.versions[1] = self.versions[1].max(other.versions[1]);
    }

    /// Returns the axis that most of the faces are across, and the mean of the crossings.
    fn middle(&self) -> (usize, DVec3) {
        let axis = (0..3).fold(0, |most, axis| if self.axes[axis] > self.axes[most] { axis } else { most });
        (axis, self.sum / self.axes.iter().sum::<f64>())
    }

    /// Returns the mean product of the distances of the crossings from their mean along two axes.
    fn spread(&self, p: usize, q: usize) -> f64 {
        let (_, mean) = self.middle();
        self.products.col(p)[q] / self.axes.iter().sum::<f64>() - mean[p] * mean[q]
    }

    /// Returns whether the crossings are far enough from being in a row to tell a plane.
    fn tells_plane(&self) -> bool {
        let (axis, _) = self.middle();
        let [b, c] = [(axis + 1) % 3, (axis + 2) % 3];
        self.spread(b, b) * self.spread(c, c) - self.spread(b, c).powi(2) > MIN_SPREAD
    }

    /// Returns the place of the vertex of a corner, m. Outside the tissue it is moved to the surface, within the plane as nearly as a few
    /// turns allow.
    pub(super) fn vertex_m(&self, places: &SolidPlaces, corner: usize) -> DVec3 {
        let coordinates = places.coordinates(corner);
        let mut at_m = places.at_m(self.moved(coordinates, coordinates));
        // It is no farther from the corner than the cubes around it reach.
        if is_within_cubes(places, corner) {
            return at_m;
        }
        for _ in 0..MAX_TURNS {
            let Some(surface_m) = surface_below_m(places, at_m) else { break };
            at_m = places.at_m(self.moved(places.coordinates_at(surface_m), coordinates));
        }
        at_m
    }

    /// Returns where a place near a corner is moved to along one axis: onto the plane that fits the crossings best, at most an edge from the corner.
    fn moved(&self, place: DVec3, corner: DVec3) -> DVec3 {
        let (axis, mean) = self.middle();
        let [b, c] = [(axis + 1) % 3, (axis + 2) % 3];
        let spread = |p: usize, q: usize| self.spread(p, q);
        let [own_b, own_c, mixed] =
            [spread(b, b) + PLANE_REGULARISATION, spread(c, c) + PLANE_REGULARISATION, spread(b, c)];
        let area = own_b * own_c - mixed * mixed;
        let slope_b = (own_c * spread(axis, b) - mixed * spread(axis, c)) / area;
        let slope_c = (own_b * spread(axis, c) - mixed * spread(axis, b)) / area;
        let at = mean[axis] + slope_b * (place[b] - mean[b]) + slope_c * (place[c] - mean[c]);
        let mut moved = place;
        moved[axis] = at.clamp(corner[axis] - 1.0, corner[axis] + 1.0);
        moved
    }
}

/// Returns for each corner the crossings around it that tell the plane there: its own and those of the corners beside it, of the same
/// `faces`; one round more if these are about in a row.
pub(super) fn around(
    own: &BTreeMap<u32, Crossings>,
    faces: impl Iterator<Item = [u32; 4]>,
) -> BTreeMap<u32, Crossings> {
    let mut beside: BTreeSet<[u32; 2]> = BTreeSet::new();
    for corners in faces {
        beside.extend(corners.iter().flat_map(|one| corners.map(|other| [*one, other])));
    }
    let gathered = |of: &BTreeMap<u32, Crossings>| {
        let mut around: BTreeMap<u32, Crossings> = BTreeMap::new();
        for [corner, other] in &beside {
            let none = || Crossings::none(of[corner].versions[0]);
            around.entry(*corner).or_insert_with(none).add(&of[other]);
        }
        around
    };
    let near = gathered(own);
    let mut around = gathered(&near);
    around.extend(near.into_iter().filter(|(_, crossings)| crossings.tells_plane()));
    around
}

/// Returns whether all cubes around a corner are there, and wholly inside the tissue.
fn is_within_cubes(places: &SolidPlaces, corner: usize) -> bool {
    let around = [0, 1].into_iter().flat_map(|beside| places.cubes_around(corner, beside));
    around.flatten().filter(|cube| places.cube_mass(*cube) >= 1.0).count() == 8
}

/// Returns the nearest place of the surface, m, for a place outside the tissue.
fn surface_below_m(places: &SolidPlaces, at_m: DVec3) -> Option<DVec3> {
    let surface = places.shown_surface();
    let place = surface.nearest(at_m)?;
    let nearest_m = surface.at_m(&place);
    let [along, across] = place.frame;
    (along.cross(across).dot(at_m - nearest_m) > 0.0).then_some(nearest_m)
}

/// Returns whether a corner of the lattice is outside the tissue.
pub(super) fn is_outside(places: &SolidPlaces, corner: usize) -> bool {
    !is_within_cubes(places, corner) && surface_below_m(places, places.rest_m(corner)).is_some()
}
