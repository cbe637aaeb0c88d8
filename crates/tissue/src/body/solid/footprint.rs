//! The disc of a tool on a solid: a disc on its surface, whose vertices move with the cubes around them.
//!
//! The disc averages the surface over its whole area, not over a smaller disc as on a foundation
//! (`body::footprint`): a solid carries a load sideways, and a smaller disc would be too soft. (Disc of 5 mm on cubes of
//! 2.5 to 5 mm: 13 to 32 % too soft with the smaller one.)

use std::cmp::Ordering;
use std::collections::BTreeMap;
use std::sync::Arc;

use glam::{DMat3, DVec2, DVec3};

use crate::body::disc::{DiscPoint, SurfaceSample, TissueDisc};
use crate::body::solid::corner_copies::CornerCopies;
use crate::body::surface::footprint::MeshDisc;
use crate::saved::SavedPlace;
use crate::scene::SolidShape;
use crate::shape::{CellPlace, PointId};
use palpate_geometry::fill::Lattice;
use palpate_refusal::Result;

/// A side of a triangle is divided into at most so many parts.
const MAX_SIDE_PARTS: f64 = 16.0;

/// Returns the places of the corners of a cell, if a cut has doubled any of them.
fn copies_in(shape: &SolidShape, copies: Option<&CornerCopies>, cell: &CellPlace) -> Option<[u32; 8]> {
    copies?.cut_corners(shape.corner_of(PointId::new(cell.points[0] as usize)))
}

/// A part of the surface at rest.
#[derive(Debug, Clone, Copy, PartialEq)]
struct RestPart {
    /// Its middle, m.
    rest_m: DVec3,
    /// Its outward normal times its area, m².
    outward_m2: DVec3,
    area_m2: f64,
}

/// Divides each triangle (its corners, m) into equal ones of the same shape, whose sides are at most `spacing_m` (m).
fn divided(triangles: &[[DVec3; 3]], spacing_m: f64) -> Vec<RestPart> {
    let mut divided = Vec::with_capacity(triangles.len());
    for [a, b, c] in triangles.iter().copied() {
        let longest_m = (b - a).length().max((c - b).length()).max((a - c).length());
        let parts = (longest_m / spacing_m).ceil().clamp(1.0, MAX_SIDE_PARTS);
        let outward_m2 = 0.5 * (b - a).cross(c - a) / (parts * parts);
        let area_m2 = outward_m2.length();
        // A triangle without an area has no direction either.
        if area_m2 == 0.0 {
            continue;
        }
        let (along, across) = ((b - a) / parts, (c - a) / parts);
        let mut add = |by_along: f64, by_across: f64| {
            let rest_m = a + by_along * along + by_across * across;
            divided.push(RestPart { rest_m, outward_m2, area_m2 });
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
    divided
}

/// Joins parts in the same box of the lattice that face the same way: the triangles of a surface may be much finer than the cells, and a
/// contact with each of them would take many times as long and tell no more. Each cell is divided into equal boxes with sides of at most
/// half of `spacing_m` (m). The joined parts come in the order of their first ones, and each is the same, to the bit, in whatever order
/// its parts come.
fn joined(parts: Vec<RestPart>, lattice: &Lattice, spacing_m: f64) -> Vec<RestPart> {
    let boxes = (2.0 * lattice.edge_m / spacing_m).ceil();
    let mut numbers: BTreeMap<_, usize> = BTreeMap::new();
    let mut groups: Vec<Vec<RestPart>> = Vec::new();
    for part in parts {
        let in_box = (boxes * lattice.from_m(part.rest_m)).to_array().map(|along| along.floor() as i64);
        // The axis that the part faces most, and to which side.
        let axis = part.outward_m2.abs().max_position();
        let number = *numbers.entry((in_box, axis, part.outward_m2[axis] > 0.0)).or_insert(groups.len());
        if number == groups.len() {
            groups.push(Vec::new());
        }
        groups[number].push(part);
    }
    let join = |mut group: Vec<RestPart>| {
        group.sort_by(|a, b| {
            let of = |part: &RestPart| part.rest_m.to_array();
            of(a).iter().zip(of(b)).map(|(a, b)| a.total_cmp(&b)).find(|order| order.is_ne()).unwrap_or(Ordering::Equal)
        });
        // A part of its own keeps its bits.
        if let [only] = group[..] {
            return only;
        }
        let area_m2: f64 = group.iter().map(|part| part.area_m2).sum();
        let outward_m2 = group.iter().map(|part| part.outward_m2).sum();
        let rest_m = group.iter().map(|part| part.area_m2 * part.rest_m).sum::<DVec3>() / area_m2;
        RestPart { rest_m, outward_m2, area_m2 }
    };
    groups.into_iter().map(join).collect()
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

    fn samples(&self, reach_m: f64, spacing_m: f64, copies: Option<&CornerCopies>) -> Vec<SurfaceSample> {
        let parts = divided(&self.disc.triangles_around(reach_m), spacing_m);
        let sample = |RestPart { rest_m, outward_m2, area_m2 }: RestPart| {
            let cell = self.shape.bind(rest_m);
            let copies = copies_in(&self.shape, copies, &cell);
            SurfaceSample { rest_m, outward: outward_m2.normalize_or_zero(), area_m2, copies, cell }
        };
        joined(parts, self.shape.lattice(), spacing_m).into_iter().map(sample).collect()
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

#[cfg(test)]
mod tests {
    use super::*;

    const CELLS: Lattice = Lattice { origin_m: DVec3::ZERO, edge_m: 0.005, cells: [4, 4, 2] };

    /// The triangles of a square of 20 mm at a height, of so many squares along a side.
    fn square(height_m: f64, squares: u32) -> Vec<[DVec3; 3]> {
        let side_m = 0.02 / f64::from(squares);
        let at = |i: u32, j: u32| DVec3::new(side_m * f64::from(i), side_m * f64::from(j), height_m);
        (0..squares * squares)
            .map(|square| (square / squares, square % squares))
            .flat_map(|(i, j)| [[at(i, j), at(i + 1, j), at(i + 1, j + 1)], [at(i, j), at(i + 1, j + 1), at(i, j + 1)]])
            .collect()
    }

    fn area_m2(parts: &[RestPart]) -> f64 {
        parts.iter().map(|part| part.area_m2).sum()
    }

    #[test]
    fn triangles_much_finer_than_cells_are_four_parts_on_each_cell_with_the_same_area_and_coarse_ones_are_divided() {
        let joined_of = |squares, spacing_m| joined(divided(&square(0.0099, squares), spacing_m), &CELLS, spacing_m);
        let fine = joined_of(64, 0.005);
        assert_eq!(fine.len(), 4 * 16);
        assert!((area_m2(&fine) - 4e-4).abs() < 1e-15, "{}", area_m2(&fine));
        for part in &fine {
            assert!((part.outward_m2 - DVec3::new(0.0, 0.0, 6.25e-6)).length() < 1e-12, "{part:?}");
            let in_box = (part.rest_m / 0.0025).fract();
            assert!((in_box.truncate() - 0.5).abs().max_element() < 1e-9, "{part:?}");
        }
        // Two triangles, whose longest side has six parts.
        let coarse = joined_of(1, 0.005);
        assert_eq!(divided(&square(0.0099, 1), 0.005).len(), 2 * 36);
        assert!((36..=72).contains(&coarse.len()), "{}", coarse.len());
        assert!((area_m2(&coarse) - 4e-4).abs() < 1e-15, "{}", area_m2(&coarse));
    }

    /// Forces stay with parts when a tip takes samples anew, from another place outward.
    #[test]
    fn joined_parts_have_the_same_bits_in_any_order_and_sides_that_face_apart_stay_apart() {
        let mut triangles = square(0.0099, 32);
        triangles.extend(square(0.0098, 32).into_iter().map(|[a, b, c]| [a, c, b]));
        let parts = divided(&triangles, 0.005);
        let sorted = |mut parts: Vec<RestPart>| {
            parts.sort_by(|a, b| {
                let of = |part: &RestPart| [part.rest_m.x, part.rest_m.y, part.outward_m2.z].map(f64::to_bits);
                of(a).cmp(&of(b))
            });
            parts
        };
        let forward = sorted(joined(parts.clone(), &CELLS, 0.005));
        let backward = sorted(joined(parts.into_iter().rev().collect(), &CELLS, 0.005));
        assert_eq!(forward, backward);
        assert_eq!(forward.len(), 2 * 4 * 16);
        assert!((forward.iter().map(|part| part.outward_m2).sum::<DVec3>()).length() < 1e-15);
    }
}
