//! The interface of a disc on a kind of tissue: the area over which a tool's tip touches it.

use std::fmt;

use glam::{DMat3, DVec2, DVec3};

use crate::body::solid::corner_copies::CornerCopies;
use crate::saved::SavedPlace;
use crate::shape::{CellPlace, PointId};
use palpate_refusal::Result;

/// A small part of the surface of a tissue, which moves with the cube around it.
#[derive(Debug, Clone)]
pub(crate) struct SurfaceSample {
    /// Its middle at rest, m.
    pub(crate) rest_m: DVec3,
    /// Unit normal out of the tissue at rest.
    pub(crate) outward: DVec3,
    pub(crate) area_m2: f64,
    pub(crate) cell: CellPlace,
    /// The copies of the cell's corners with which it moves, by their places; `None` without cuts beside it.
    pub(crate) copies: Option<[u32; 8]>,
}

/// A point that a disc covers.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DiscPoint {
    pub(crate) point: PointId,
    /// The place of the copy of the point that it covers, if a cut has doubled the point.
    pub(crate) copy: Option<usize>,
}

impl From<PointId> for DiscPoint {
    fn from(point: PointId) -> Self {
        DiscPoint { point, copy: None }
    }
}

/// The disc of a tool on a kind of tissue, at a place of the rest surface. `body::footprint` asks it which points it
/// covers, and computes everything else. All directions along the surface are those of the gradients of
/// [`TissueDisc::cover`].
pub(crate) trait TissueDisc: fmt::Debug + Send + Sync {
    /// Returns a copy.
    fn boxed(&self) -> Box<dyn TissueDisc>;

    /// Returns the place as plain data.
    fn saved(&self) -> SavedPlace;

    /// Checks a saved place and moves there.
    ///
    /// # Errors
    /// Refuses a place that is not on this tissue.
    fn restore(&mut self, saved: &SavedPlace) -> Result<()>;

    /// Moves back to an earlier place ([`TissueDisc::saved`]). Returns whether the covered points may be others.
    fn return_to(&mut self, saved: &SavedPlace) -> bool;

    /// Returns the rest position of the place, m.
    fn anchor_m(&self) -> DVec3;

    /// Moves to the place of the rest surface nearest to `at_m`, m. Returns whether the covered points may be others.
    fn put(&mut self, at_m: DVec3) -> bool;

    /// Moves along the rest surface by `by_m`, m, in the directions of the place. Returns whether the covered points may
    /// be others: a movement may be too small to matter.
    fn walk(&mut self, by_m: DVec2) -> bool;

    /// Moves to the place of the rest surface nearest to `place_m`, if the displaced surface is nearer there than at the
    /// disc. `displacement_m` gives the displacement of a point, m. Returns whether it moved; never where walking leads
    /// everywhere.
    fn leap(&mut self, _place_m: DVec3, _displacement_m: &dyn Fn(PointId) -> DVec3) -> bool {
        false
    }

    /// Returns how far a touching disc may move at once, m; infinite where the surface is a plane.
    fn stride_m(&self) -> f64 {
        f64::INFINITY
    }

    /// Returns whether the whole tissue rests in the plane z = 0, so that x and y are its directions.
    fn is_flat(&self) -> bool {
        false
    }

    /// Returns the unit normal out of the tissue at rest.
    fn outward(&self) -> DVec3 {
        DVec3::Z
    }

    /// Returns the change of the outward normal along the surface at rest, 1/m, as a mean over the disc.
    fn curvature_per_m(&self) -> DMat3 {
        DMat3::ZERO
    }

    /// Returns the side of a newly placed tool that is `height_m` above the surface: 1 outside, −1 inside. A tool below a
    /// flat tissue presses on it from above.
    fn side(&self, _height_m: f64) -> f64 {
        1.0
    }

    /// Returns samples of the surface around the place, at most `spacing_m` apart, as far as `reach_m` away, in a fixed
    /// order, m. Empty where rigid tips can't touch ([`RestShape::takes_rigid_tips`](crate::shape::RestShape)).
    fn samples(&self, _reach_m: f64, _spacing_m: f64, _copies: Option<&CornerCopies>) -> Vec<SurfaceSample> {
        Vec::new()
    }

    /// Returns the weight of a movable point, which need not be covered; `None` if the points of [`TissueDisc::cover`]
    /// are in the order of memory, so that a search among them finds it.
    fn weight_of(&self, _point: PointId) -> Option<f64> {
        None
    }

    /// Calls `add` with each covered point, its weight w and ∂w/∂c, the derivative by the place, 1/m; each point, or copy of it, once. The
    /// weights add up to 1. `copies` are those of a solid with cuts.
    fn cover(&mut self, copies: Option<&CornerCopies>, add: &mut dyn FnMut(DiscPoint, f64, DVec2));
}
