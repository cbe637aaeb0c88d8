//! The disc of a tool on a mesh. It moves by walking over the surface; a search finds another part that the
//! tool may have reached.

use std::sync::Arc;

use glam::{DMat3, DVec2, DVec3};
use palpate_geometry::surface::{Covered, Place, SurfaceDisc};

use crate::body::model::Model;
use crate::saved::{SavedGeometry, ensure};
use crate::scene::MeshShape;
use crate::shape::PointId;
use palpate_refusal::Result;

/// A tool that touches nothing moves to another place of the surface if that is nearer by this part of the
/// radius, so that it does not jump back and forth between two places.
const NEARER: f64 = 0.1;

/// Returns the place on a mesh that a snapshot has; `None` for one on a sheet.
fn place_of(saved: &SavedGeometry) -> Option<Place> {
    let SavedGeometry::Mesh { triangle, barycentric, frame } = saved else { return None };
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
        let surface = shape.surface();
        let nowhere = Place { triangle: 0, barycentric: [1.0 / 3.0; 3], frame: [DVec3::X, DVec3::Y] };
        let place = surface.nearest(DVec3::ZERO).unwrap_or(nowhere);
        MeshDisc { shape: shape.clone(), disc: SurfaceDisc::new(radius_m, surface.edge_m()), place }
    }

    /// Returns the place as plain data.
    pub(crate) fn saved(&self) -> SavedGeometry {
        let Place { triangle, barycentric, frame } = self.place;
        SavedGeometry::Mesh { triangle, barycentric, frame: frame.map(Into::into) }
    }

    /// Checks a saved place and moves the disc there.
    pub(crate) fn restore(&mut self, saved: &SavedGeometry) -> Result<()> {
        let Some(place) = place_of(saved) else { return Ok(()) };
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

    /// Moves the disc back to an earlier place.
    pub(crate) fn go_to(&mut self, saved: &SavedGeometry) {
        self.place = place_of(saved).unwrap_or(self.place);
    }

    /// Returns the rest position of the place, m.
    pub(crate) fn anchor_m(&self) -> DVec3 {
        self.shape.surface().at_m(&self.place)
    }

    /// Returns the outward normal of its triangle at rest.
    pub(crate) fn outward(&self) -> DVec3 {
        let [along, across] = self.place.frame;
        along.cross(across)
    }

    /// Returns the change of the outward normal along the surface at rest, 1/m: the mean over the disc.
    pub(crate) fn curvature_per_m(&self) -> DMat3 {
        let surface = self.shape.surface();
        let of = |covered: &Covered| covered.weight * surface.curvature_per_m(covered.vertex as usize);
        self.disc.covered().iter().map(of).fold(DMat3::ZERO, |sum, part| sum + part)
    }

    /// Returns the side on which a tool is ([`palpate_geometry::surface::Surface::side`]).
    pub(crate) fn side(&self, height_m: f64) -> f64 {
        self.shape.surface().side(height_m, self.disc.radius_m())
    }

    /// Moves the disc to the place of the rest surface nearest to `at_m`.
    pub(crate) fn put(&mut self, at_m: DVec3) {
        self.place = self.shape.surface().nearest(at_m).unwrap_or(self.place);
    }

    /// Returns how far the disc may move at once, m.
    pub(crate) fn stride_m(&self) -> f64 {
        self.disc.stride_m()
    }

    /// Walks over the surface by `by_m` in the directions of the place.
    pub(crate) fn walk(&mut self, by_m: DVec2) {
        self.place = self.shape.surface().walk(&self.place, by_m);
    }

    /// Moves the disc to the place of the rest surface nearest to `place_m`, if the displaced surface is nearer
    /// there than at the disc. Returns whether it moved.
    pub(crate) fn leap(&mut self, model: &Model, place_m: DVec3, displacement_m: impl Fn([usize; 2]) -> DVec3) -> bool {
        let (surface, Some(graph)) = (self.shape.surface(), model.places.surface()) else { return false };
        let Some(other) = surface.nearest(place_m) else { return false };
        let away_m = |place: &Place| {
            let vertices = surface.triangle(place).map(|vertex| PointId::new(vertex as usize));
            let moved_m: DVec3 = (0..3)
                .map(|corner| {
                    let point = model.point_of(graph.slot_of(vertices[corner]));
                    place.barycentric[corner] * displacement_m(point)
                })
                .sum();
            place_m.distance(surface.at_m(place) + moved_m)
        };
        let is_nearer = away_m(&other) < away_m(&self.place) - NEARER * self.disc.radius_m();
        if is_nearer {
            self.place = other;
        }
        is_nearer
    }

    /// Returns the weight of a vertex.
    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn weight_of(&self, vertex: PointId) -> f64 {
        self.disc.weight_of(vertex.index() as u32)
    }

    /// Returns the vertices that the disc covers, with their weights, the derivatives of these by the place,
    /// and their rest positions.
    pub(crate) fn cover(&mut self) -> impl Iterator<Item = (PointId, f64, DVec2, DVec3)> + '_ {
        let surface = self.shape.surface();
        self.disc.lay(surface, &self.place);
        self.disc.covered().iter().map(|covered| {
            let vertex = covered.vertex as usize;
            (PointId::new(vertex), covered.weight, covered.gradient, surface.vertices_m()[vertex])
        })
    }
}
