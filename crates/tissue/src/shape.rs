//! The rest shape of a tissue: its mass points, where they rest, and how they lie together. Everything above `sheet` sees a
//! tissue this way and no other, so that it does not matter whether its points form a grid.

use std::fmt;
use std::str::FromStr;

use glam::DVec3;
use serde::Serialize;

use palpate_refusal::{Reason, Refusal, Result, finite, legible};

/// A mass point of a tissue. Which one it is, its shape tells.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PointId(usize);

impl PointId {
    /// Returns the point at place `index` in arrays over all points of the tissue.
    pub fn new(index: usize) -> Self {
        PointId(index)
    }

    /// Returns its place in such arrays.
    pub fn index(self) -> usize {
        self.0
    }
}

/// What people call a point, in scripts, records and messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PointName {
    /// Point [i, j] of a sheet: column i along x, row j along y.
    Point([usize; 2]),
    /// A vertex of a mesh, numbered from 0 as in its file.
    Vertex(u32),
}

impl fmt::Display for PointName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            PointName::Point([i, j]) => write!(f, "[{i}, {j}]"),
            PointName::Vertex(vertex) => write!(f, "vertex {vertex}"),
        }
    }
}

impl FromStr for PointName {
    type Err = &'static str;

    fn from_str(text: &str) -> std::result::Result<Self, Self::Err> {
        let name = match text.split_once(',') {
            Some((i, j)) => i.trim().parse().ok().zip(j.trim().parse().ok()).map(|(i, j)| PointName::Point([i, j])),
            None => text.trim().parse().ok().map(PointName::Vertex),
        };
        name.ok_or("must be X,Y or the number of a vertex")
    }
}

/// The box around a shape at rest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extent {
    /// The least of each coordinate, m.
    pub least_m: DVec3,
    /// The largest of each coordinate, m.
    pub most_m: DVec3,
}

impl Extent {
    /// Returns the box around places; of none, its ends are infinite.
    pub fn around(places_m: impl Iterator<Item = DVec3> + Clone) -> Self {
        let least_m = places_m.clone().fold(DVec3::INFINITY, DVec3::min);
        Extent { least_m, most_m: places_m.fold(DVec3::NEG_INFINITY, DVec3::max) }
    }

    /// Returns its middle, m.
    pub fn middle_m(&self) -> DVec3 {
        (self.least_m + self.most_m) / 2.0
    }

    /// Returns its length along each axis, m.
    pub fn size_m(&self) -> DVec3 {
        self.most_m - self.least_m
    }
}

impl fmt::Display for Extent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [x, y, z] = self.size_m().to_array().map(legible);
        if z > 0.0 { write!(f, "{x} m × {y} m × {z} m") } else { write!(f, "{x} m × {y} m") }
    }
}

/// The rest shape of a tissue. Its points are numbered from 0 without a gap.
pub trait RestShape: fmt::Debug + Send + Sync {
    /// Its size in points, for people.
    fn describe(&self) -> String;
    /// The number of points, at least 1.
    fn point_count(&self) -> usize;
    /// What people call a point.
    fn name(&self, point: PointId) -> PointName;
    /// The point that is called so.
    ///
    /// # Errors
    /// Refuses a name that no point has; `field` is the name that the refusal gives.
    fn find(&self, field: &str, name: PointName) -> Result<PointId>;
    /// Where a point rests, m.
    fn rest_m(&self, point: PointId) -> DVec3;
    /// The unit normal of the surface at a point at rest, out of the tissue.
    fn normal(&self, point: PointId) -> DVec3;
    /// Whether a point never moves.
    fn is_fixed(&self, point: PointId) -> bool;
    /// The points to which springs lead that keep lengths and angles in the surface, ascending.
    fn neighbours(&self, point: PointId) -> Vec<PointId>;
    /// The point that rests nearest to a place.
    fn nearest(&self, place_m: DVec3) -> PointId;
    /// The points that rest within a distance of a place, ascending; a sheet also gives some beyond it.
    fn around(&self, place_m: DVec3, radius_m: f64) -> Vec<PointId>;
    /// The box around all points.
    fn extent(&self) -> Extent;
    /// The usual distance between neighbours, m.
    fn edge_m(&self) -> f64;

    /// The highest place of the surface in line with the middle of the box, m: devices have their origin there, so that a tip
    /// that comes down meets the tissue.
    fn top_m(&self) -> DVec3 {
        self.extent().middle_m()
    }

    /// Where a tool with a tip of `radius_m` begins that comes new and is to be at a place, if not above that: outside the
    /// tissue or within it, but not in the surface, which it meets as a hand does.
    fn approach_m(&self, _place_m: DVec3, _radius_m: f64) -> Option<DVec3> {
        None
    }

    /// How many numbers give a place on it: 3, or 2 if all of it rests in the plane z = 0.
    fn dimensions(&self) -> usize {
        3
    }

    /// Its longest side, or the distance between neighbours if it has a single point, m.
    fn longest_side_m(&self) -> f64 {
        self.extent().size_m().max_element().max(self.edge_m())
    }

    /// Whether a place is within the box around the shape, or off it by at most a tenth of its longest side: a tool that
    /// strokes over the edge is still felt.
    fn is_near(&self, place_m: DVec3) -> bool {
        let Extent { least_m, most_m } = self.extent();
        let margin_m = DVec3::splat(0.1 * self.longest_side_m());
        place_m.cmpge(least_m - margin_m).all() && place_m.cmple(most_m + margin_m).all()
    }

    /// Checks the place of a force.
    ///
    /// # Errors
    /// Refuses a place that is not finite or not near ([`RestShape::is_near`]); `field` is the name that the refusal gives.
    fn check_place(&self, field: &str, place_m: DVec3) -> Result<()> {
        for component in place_m.to_array() {
            finite(field, component)?;
        }
        if self.is_near(place_m) {
            return Ok(());
        }
        let ([x, y, z], extent) = (place_m.to_array().map(legible), self.extent());
        let message =
            format!("({x}, {y}, {z}) m is off the tissue, which is {extent}, by more than a tenth of its longest side");
        Err(Refusal::new(Reason::OffTissue, field, message))
    }
}

/// Returns all points of a shape, ascending.
pub fn points(shape: &dyn RestShape) -> impl ExactSizeIterator<Item = PointId> + Clone + use<> {
    (0..shape.point_count()).map(PointId)
}
