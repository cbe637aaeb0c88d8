//! The disc of a tool on a mesh. It moves by walking over the surface; a search finds another part that the
//! tool may have reached.

use std::sync::Arc;

use glam::{DMat3, DVec2, DVec3};
use palpate_geometry::surface::{Covered, Place, SurfaceDisc};

use crate::body::disc::{DiscPoint, TissueDisc};
use crate::body::solid::corner_copies::CornerCopies;
use crate::saved::{SavedPlace, ensure, unsound};
use crate::scene::MeshShape;
use crate::shape::PointId;
use palpate_refusal::Result;

/// A tool that touches nothing moves to another place of the surface if that is nearer by this part of the
/// radius, so that it does not jump back and forth between two places.
const NEARER: f64 = 0.1;

/// Smallest movement of a disc, as a part of its radius. Computing its weights costs as much as stepping some thousand
/// points, and the disc is at most this far from the tool's place.
const MIN_PART: f64 = 1e-6;

/// Returns the place on a triangle that a snapshot has.
fn place_of(saved: &SavedPlace) -> Option<Place> {
    let SavedPlace::OfTriangle { triangle, barycentric, frame } = saved else { return None };
    Some(Place { triangle: *triangle, barycentric: *barycentric, frame: frame.map(DVec3::from) })
}

/// The disc of a tool on a mesh, at a place.
#[derive(Debug, Clone)]
pub(crate) struct MeshDisc {
    shape: Arc<MeshShape>,
    disc: SurfaceDisc,
    place: Place,
}

impl MeshDisc {
    /// Creates a disc at an arbitrary place.
    pub(crate) fn new(shape: &Arc<MeshShape>, radius_m: f64) -> Self {
        Self::with(shape, |edge_m| SurfaceDisc::new(radius_m, edge_m))
    }

    /// Creates a disc at an arbitrary place that averages over its whole area ([`SurfaceDisc::whole`]).
    pub(crate) fn whole(shape: &Arc<MeshShape>, radius_m: f64) -> Self {
        Self::with(shape, |edge_m| SurfaceDisc::whole(radius_m, edge_m))
    }

    fn with(shape: &Arc<MeshShape>, disc: impl FnOnce(f64) -> SurfaceDisc) -> Self {
        let surface = shape.surface();
        let nowhere = Place { triangle: 0, barycentric: [1.0 / 3.0; 3], frame: [DVec3::X, DVec3::Y] };
        let place = surface.nearest(DVec3::ZERO).unwrap_or(nowhere);
        MeshDisc { shape: shape.clone(), disc: disc(surface.edge_m()), place }
    }
}

impl MeshDisc {
    /// Returns the corners of the triangles around the place ([`Surface::triangles_around`](palpate_geometry::surface::Surface)).
    pub(crate) fn triangles_around(&self, reach_m: f64) -> Vec<[DVec3; 3]> {
        self.shape.surface().triangles_around(&self.place, reach_m)
    }
}

impl TissueDisc for MeshDisc {
    fn boxed(&self) -> Box<dyn TissueDisc> {
        Box::new(self.clone())
    }

    fn saved(&self) -> SavedPlace {
        let Place { triangle, barycentric, frame } = self.place;
        SavedPlace::OfTriangle { triangle, barycentric, frame: frame.map(Into::into) }
    }

    fn restore(&mut self, saved: &SavedPlace) -> Result<()> {
        let place = place_of(saved).ok_or_else(|| unsound("a tool on a tissue of another kind"))?;
        let triangles = self.shape.triangles().len();
        ensure((place.triangle as usize) < triangles, "a tool on a triangle that the tissue lacks")?;
        let hats = place.barycentric;
        let is_inside =
            hats.iter().all(|hat| (0.0..=1.0).contains(hat)) && (hats.iter().sum::<f64>() - 1.0).abs() < 1e-6;
        ensure(is_inside, "a tool beside its triangle")?;
        let corners_m = self.shape.surface().triangle(&place).map(|vertex| self.shape.vertices_m()[vertex as usize]);
        let normal = (corners_m[1] - corners_m[0]).cross(corners_m[2] - corners_m[0]).normalize_or_zero();
        let [along, across] = place.frame;
        // The normal of a needle-like triangle is accurate to the ratio of its sides times a rounding error.
        let is_square = |a: DVec3, b: DVec3| a.dot(b).abs() < 1e-3;
        let is_one = |v: DVec3| (v.length() - 1.0).abs() < 1e-3;
        let is_frame = is_one(along)
            && is_one(across)
            && is_square(along, across)
            && is_square(along, normal)
            && is_square(across, normal);
        ensure(is_frame, "a tool whose directions are not those of its triangle")?;
        self.place = place;
        Ok(())
    }

    fn return_to(&mut self, saved: &SavedPlace) -> bool {
        let place = place_of(saved);
        self.place = place.unwrap_or(self.place);
        place.is_some()
    }

    fn anchor_m(&self) -> DVec3 {
        self.shape.surface().at_m(&self.place)
    }

    /// Returns the outward normal of its triangle at rest.
    fn outward(&self) -> DVec3 {
        let [along, across] = self.place.frame;
        along.cross(across)
    }

    fn curvature_per_m(&self) -> DMat3 {
        let surface = self.shape.surface();
        let of = |covered: &Covered| covered.weight * surface.curvature_per_m(covered.vertex as usize);
        self.disc.covered().iter().map(of).fold(DMat3::ZERO, |sum, part| sum + part)
    }

    fn side(&self, height_m: f64) -> f64 {
        self.shape.surface().side(height_m, self.disc.radius_m())
    }

    fn put(&mut self, at_m: DVec3) -> bool {
        self.place = self.shape.surface().nearest(at_m).unwrap_or(self.place);
        true
    }

    fn stride_m(&self) -> f64 {
        self.disc.stride_m()
    }

    fn walk(&mut self, by_m: DVec2) -> bool {
        let moves = by_m.length() > MIN_PART * self.disc.radius_m();
        if moves {
            self.place = self.shape.surface().walk(&self.place, by_m);
        }
        moves
    }

    fn leap(&mut self, place_m: DVec3, displacement_m: &dyn Fn(PointId) -> DVec3) -> bool {
        let surface = self.shape.surface();
        let Some(other) = surface.nearest_from(place_m, &self.place) else { return false };
        let away_m = |place: &Place| {
            let vertices = surface.triangle(place).map(|vertex| PointId::new(vertex as usize));
            let moved_m: DVec3 =
                (0..3).map(|corner| place.barycentric[corner] * displacement_m(vertices[corner])).sum();
            place_m.distance(surface.at_m(place) + moved_m)
        };
        let is_nearer = away_m(&other) < away_m(&self.place) - NEARER * self.disc.radius_m();
        if is_nearer {
            self.place = other;
        }
        is_nearer
    }

    #[allow(clippy::cast_possible_truncation)]
    fn weight_of(&self, vertex: PointId) -> Option<f64> {
        Some(self.disc.weight_of(vertex.index() as u32))
    }

    fn cover(&mut self, _copies: Option<&CornerCopies>, add: &mut dyn FnMut(DiscPoint, f64, DVec2)) {
        self.disc.lay(self.shape.surface(), &self.place);
        let covered = self.disc.covered().iter();
        let point = |vertex: u32| PointId::new(vertex as usize).into();
        covered.for_each(|covered| add(point(covered.vertex), covered.weight, covered.gradient));
    }
}
