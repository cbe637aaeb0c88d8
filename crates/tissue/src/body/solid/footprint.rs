//! The disc of a tool on a solid: a disc on its surface, whose vertices move with the cubes around them.
//!
//! The disc averages the surface over its whole area, not over a smaller disc as on a foundation
//! (`body::footprint`): a solid carries a load sideways, and a smaller disc would be too soft. (Disc of 5 mm on cubes of
//! 2.5 to 5 mm: 13 to 32 % too soft with the smaller one.)

use std::sync::Arc;

use glam::{DMat3, DVec2, DVec3};

use crate::body::disc::{DiscPoint, SurfaceSample, TissueDisc};
use crate::body::solid::corner_copies::CornerCopies;
use crate::body::surface::footprint::MeshDisc;
use crate::saved::SavedPlace;
use crate::scene::SolidShape;
use crate::shape::{CellPlace, PointId};
use palpate_refusal::Result;

/// A side of a triangle is divided into at most so many parts.
const MAX_SIDE_PARTS: f64 = 16.0;

/// Returns the places of the corners of a cell, if a cut has doubled any of them.
fn copies_in(shape: &SolidShape, copies: Option<&CornerCopies>, cell: &CellPlace) -> Option<[u32; 8]> {
    copies?.cut_corners(shape.corner_of(PointId::new(cell.points[0] as usize)))
}

/// The part of a vertex's weight and derivative that a point gets.
#[derive(Debug, Clone, Copy)]
struct CoveredPart {
    point: u32,
    /// The place of the point, or of the copy of it, in memory.
    place: u32,
    /// In which order the parts were found, and are added.
    order: u32,
    weight: f64,
    gradient: DVec2,
}

/// The disc of a tool on a solid, at a place of its surface.
#[derive(Debug, Clone)]
pub(crate) struct SolidDisc {
    shape: Arc<SolidShape>,
    disc: MeshDisc,
    /// What each vertex gives to its points; kept, so that a step allocates nothing.
    covered: Vec<CoveredPart>,
}

impl SolidDisc {
    /// Creates a disc at an arbitrary place.
    pub(crate) fn new(shape: &Arc<SolidShape>, radius_m: f64) -> Self {
        let disc = MeshDisc::whole(shape.surface(), radius_m);
        SolidDisc { shape: shape.clone(), disc, covered: Vec::new() }
    }
}

impl TissueDisc for SolidDisc {
    fn boxed(&self) -> Box<dyn TissueDisc> {
        Box::new(self.clone())
    }

    fn saved(&self) -> SavedPlace {
        self.disc.saved()
    }

    fn restore(&mut self, saved: &SavedPlace) -> Result<()> {
        self.disc.restore(saved)
    }

    fn return_to(&mut self, saved: &SavedPlace) -> bool {
        self.disc.return_to(saved)
    }

    fn anchor_m(&self) -> DVec3 {
        self.disc.anchor_m()
    }

    fn outward(&self) -> DVec3 {
        self.disc.outward()
    }

    fn curvature_per_m(&self) -> DMat3 {
        self.disc.curvature_per_m()
    }

    fn side(&self, height_m: f64) -> f64 {
        self.disc.side(height_m)
    }

    fn put(&mut self, at_m: DVec3) -> bool {
        self.disc.put(at_m)
    }

    fn stride_m(&self) -> f64 {
        self.disc.stride_m()
    }

    fn walk(&mut self, by_m: DVec2) -> bool {
        self.disc.walk(by_m)
    }

    fn leap(&mut self, place_m: DVec3, displacement_m: &dyn Fn(PointId) -> DVec3) -> bool {
        let of_vertex = |vertex: PointId| {
            let CellPlace { points, weights } = self.shape.cell_of(vertex.index());
            points
                .iter()
                .zip(weights)
                .map(|(point, weight)| *weight * displacement_m(PointId::new(*point as usize)))
                .sum()
        };
        self.disc.leap(place_m, &of_vertex)
    }

    /// Divides each triangle into equal ones of the same shape, and takes their middles.
    fn samples(&self, reach_m: f64, spacing_m: f64, copies: Option<&CornerCopies>) -> Vec<SurfaceSample> {
        let mut samples = Vec::new();
        for [a, b, c] in self.disc.triangles_around(reach_m) {
            let longest_m = (b - a).length().max((c - b).length()).max((a - c).length());
            let parts = (longest_m / spacing_m).ceil().clamp(1.0, MAX_SIDE_PARTS);
            let cross = (b - a).cross(c - a);
            let area_m2 = 0.5 * cross.length() / (parts * parts);
            let (along, across) = ((b - a) / parts, (c - a) / parts);
            let mut add = |by_along: f64, by_across: f64| {
                let rest_m = a + by_along * along + by_across * across;
                let outward = cross.normalize_or_zero();
                let cell = self.shape.bind(rest_m);
                samples.push(SurfaceSample {
                    rest_m,
                    outward,
                    area_m2,
                    copies: copies_in(&self.shape, copies, &cell),
                    cell,
                });
            };
            let parts = parts as u32;
            for i in 0..parts {
                for j in 0..parts - i {
                    let (i, j) = (f64::from(i), f64::from(j));
                    add(i + 1.0 / 3.0, j + 1.0 / 3.0);
                    if i + j < f64::from(parts) - 1.5 {
                        add(i + 2.0 / 3.0, j + 2.0 / 3.0);
                    }
                }
            }
        }
        samples
    }

    fn cover(&mut self, copies: Option<&CornerCopies>, add: &mut dyn FnMut(DiscPoint, f64, DVec2)) {
        let SolidDisc { shape, disc, covered } = self;
        covered.clear();
        disc.cover(None, &mut |vertex, weight, gradient| {
            let cell = shape.cell_of(vertex.point.index());
            let of_cell = copies_in(shape, copies, cell);
            for (corner, (point, part)) in cell.points.iter().zip(&cell.weights).enumerate() {
                if *part > 0.0 {
                    let order = u32::try_from(covered.len()).unwrap_or(u32::MAX);
                    let place = of_cell.map_or_else(|| corner_of(shape, *point), |places| places[corner]);
                    let (weight, gradient) = (part * weight, *part * gradient);
                    covered.push(CoveredPart { point: *point, place, order, weight, gradient });
                }
            }
        });
        // In the order of memory.
        covered.sort_unstable_by_key(|part| (part.place, part.order));
        for of_place in covered.chunk_by(|a, b| a.place == b.place) {
            let (mut weight, mut gradient) = (0.0, DVec2::ZERO);
            for part in of_place {
                weight += part.weight;
                gradient += part.gradient;
            }
            let CoveredPart { point, place, .. } = of_place[0];
            let copy = (place != corner_of(shape, point)).then_some(place as usize);
            add(DiscPoint { point: PointId::new(point as usize), copy }, weight, gradient);
        }
    }
}

/// Returns the corner of a point.
fn corner_of(shape: &SolidShape, point: u32) -> u32 {
    u32::try_from(shape.corner_of(PointId::new(point as usize))).unwrap_or(u32::MAX)
}
