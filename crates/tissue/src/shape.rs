//! The rest shape of a tissue: its mass points, where they rest, and how they are joined. Code outside
//! `scene::sheet` and `scene::mesh` uses a tissue only through this interface, so that it works for grids and
//! meshes.

use std::fmt;
use std::str::FromStr;

use glam::DVec3;
use serde::Serialize;

use palpate_refusal::{Reason, Refusal, Result, finite, legible};

/// A mass point of a tissue, as an index into arrays over all points. The rest shape gives its name and place.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct PointId(usize);

impl PointId {
    /// Returns the point with this index in arrays over all points of the tissue.
    pub fn new(index: usize) -> Self {
        PointId(index)
    }

    /// Returns the point's index in arrays over all points of the tissue.
    pub fn index(self) -> usize {
        self.0
    }
}

/// The name of a point in scripts, records and messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum PointName {
    /// Point [i, j] of a sheet: index i along x, index j along y.
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

/// The box around a shape at rest, parallel to the axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extent {
    /// The least of each coordinate, m.
    pub least_m: DVec3,
    /// The largest of each coordinate, m.
    pub most_m: DVec3,
}

impl Extent {
    /// Returns the box around places, m. Without places, its ends are infinite.
    pub fn around(places_m: impl Iterator<Item = DVec3> + Clone) -> Self {
        let least_m = places_m.clone().fold(DVec3::INFINITY, DVec3::min);
        Extent { least_m, most_m: places_m.fold(DVec3::NEG_INFINITY, DVec3::max) }
    }

    /// Returns the middle of the box, m.
    pub fn middle_m(&self) -> DVec3 {
        (self.least_m + self.most_m) / 2.0
    }

    /// Returns the length of the box along each axis, m.
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
    /// Returns the size in points as text, for people.
    fn describe(&self) -> String;
    /// Returns the number of points, at least 1.
    fn point_count(&self) -> usize;
    /// Returns the name of a point.
    fn name(&self, point: PointId) -> PointName;
    /// Returns the point of a name.
    ///
    /// # Errors
    /// Refuses a name that no point has; `field` is the key that the refusal gives.
    fn find(&self, field: &str, name: PointName) -> Result<PointId>;
    /// Returns the rest position of a point, m.
    fn rest_m(&self, point: PointId) -> DVec3;
    /// Returns the unit normal of the surface at a point at rest, out of the tissue.
    fn normal(&self, point: PointId) -> DVec3;
    /// Returns whether a point never moves.
    fn is_fixed(&self, point: PointId) -> bool;
    /// Returns the points that are joined to a point by springs within the surface (structural and shear
    /// springs, or edges), ascending.
    fn neighbours(&self, point: PointId) -> Vec<PointId>;
    /// Returns the point that rests nearest to a place, m.
    fn nearest(&self, place_m: DVec3) -> PointId;
    /// Returns the points that rest within a distance of a place, ascending. A sheet also returns some beyond
    /// it.
    fn around(&self, place_m: DVec3, radius_m: f64) -> Vec<PointId>;
    /// Returns the box around all points.
    fn extent(&self) -> Extent;
    /// Returns the usual distance between neighbours, m.
    fn edge_m(&self) -> f64;

    /// Returns the highest place of the surface in line with the middle of the box, m. Haptic devices have
    /// their origin there, so that a tip that comes down meets the tissue.
    fn top_m(&self) -> DVec3 {
        self.extent().middle_m()
    }

    /// Returns the place, m, where a newly placed tool with a tip of `radius_m` begins on its way to a place:
    /// outside the tissue or within it, but not in the surface, so that it meets the surface as a hand does.
    /// `None` means above that place (on a sheet).
    fn approach_m(&self, _place_m: DVec3, _radius_m: f64) -> Option<DVec3> {
        None
    }

    /// Returns how many numbers give a place: 3, or 2 if the whole shape rests in the plane z = 0.
    fn dimensions(&self) -> usize {
        3
    }

    /// Returns the longest side of the box, or the distance between neighbours if that is longer, m.
    fn longest_side_m(&self) -> f64 {
        self.extent().size_m().max_element().max(self.edge_m())
    }

    /// Returns whether a place is within the box around the shape, or beside it by at most a tenth of its
    /// longest side: a tool that strokes over the edge is still felt.
    fn is_near(&self, place_m: DVec3) -> bool {
        let Extent { least_m, most_m } = self.extent();
        let margin_m = DVec3::splat(0.1 * self.longest_side_m());
        place_m.cmpge(least_m - margin_m).all() && place_m.cmple(most_m + margin_m).all()
    }

    /// Checks the place of a force.
    ///
    /// # Errors
    /// Refuses a place that is not finite or not near ([`RestShape::is_near`]); `field` is the key that the
    /// refusal gives.
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
