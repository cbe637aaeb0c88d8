//! Volume elements, and the surface around them: the faces that one element alone has.
//!
//! Files number elements in both senses, and faces of skewed ones are not flat. So an element is turned as a whole, by the sign
//! of its volume: neighbours that are turned the same way then agree at the edges of the surface.

use glam::DVec3;

use super::allowance::MemoryAllowance;
use crate::Problem;

/// In the place of corners that a face or element does not have.
const NONE: u32 = u32::MAX;

/// Volumes below this part of the cube of an element's size are rounding.
const ROUNDING: f64 = 1e-9;

/// A quadrangle whose corners enclose less than this part of the cube of its diagonal is flat.
const FLAT: f64 = 1e-6;

/// The kind of a volume element, by which its corners make faces. Corners are numbered as in Gmsh and VTK, which agree here but
/// for the sense of prisms.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Cell {
    Tetrahedron,
    Hexahedron,
    Prism,
    Pyramid,
}

impl Cell {
    /// How many corners it has.
    pub(super) fn corners(self) -> usize {
        match self {
            Cell::Tetrahedron => 4,
            Cell::Hexahedron => 8,
            Cell::Prism => 6,
            Cell::Pyramid => 5,
        }
    }

    /// Its faces, counterclockwise seen from outside.
    fn faces(self) -> &'static [&'static [usize]] {
        match self {
            Cell::Tetrahedron => &[&[0, 2, 1], &[0, 1, 3], &[1, 2, 3], &[0, 3, 2]],
            Cell::Hexahedron => {
                &[&[0, 3, 2, 1], &[4, 5, 6, 7], &[0, 1, 5, 4], &[1, 2, 6, 5], &[2, 3, 7, 6], &[3, 0, 4, 7]]
            }
            Cell::Prism => &[&[0, 2, 1], &[3, 4, 5], &[0, 1, 4, 3], &[1, 2, 5, 4], &[2, 0, 3, 5]],
            Cell::Pyramid => &[&[0, 3, 2, 1], &[0, 1, 4], &[1, 2, 4], &[2, 3, 4], &[3, 0, 4]],
        }
    }
}

/// A face of an element: its corners, sorted, the element, and which face of it.
type Side = ([u32; 4], u32, u8);

/// Memory of finding elements that are there twice, for each of them, bytes.
const SORTED: usize = 48;

/// Memory of a face that one element alone has, bytes.
const OUTER: usize = 80;

/// A volume element.
struct VolumeElement {
    kind: Cell,
    corners: [u32; 8],
}

/// The volume elements of a file.
#[derive(Default)]
pub(super) struct Volume {
    elements: Vec<VolumeElement>,
}

/// The surface around volume elements.
pub(super) struct OuterSurface {
    /// Three or four vertices each, counterclockwise seen from outside.
    pub(super) faces: Vec<Vec<u32>>,
    /// How many elements were left out because they have the corners of an earlier one.
    pub(super) repeated: usize,
}

impl Volume {
    /// How many elements there are.
    pub(super) fn len(&self) -> usize {
        self.elements.len()
    }

    /// Adds an element; `corners` are as many as its kind has.
    pub(super) fn add(
        &mut self,
        kind: Cell,
        corners: &[u32],
        allowance: &mut MemoryAllowance<'_>,
    ) -> Result<(), Problem> {
        let mut own = [NONE; 8];
        own.iter_mut().zip(corners).for_each(|(own, corner)| *own = *corner);
        allowance.push(&mut self.elements, VolumeElement { kind, corners: own })
    }

    /// Whether each element has the corners of an earlier one.
    fn repeated(&self) -> Vec<bool> {
        let sorted = |(number, element): (u32, &VolumeElement)| {
            let mut corners = element.corners;
            corners.sort_unstable();
            (corners, number)
        };
        let mut order: Vec<([u32; 8], u32)> = (0..).zip(&self.elements).map(sorted).collect();
        order.sort_unstable();
        let mut is_repeated = vec![false; order.len()];
        for pair in order.windows(2).filter(|pair| pair[0].0 == pair[1].0) {
            is_repeated[pair[1].1 as usize] = true;
        }
        is_repeated
    }

    /// The faces that one element alone has, in the order of the elements.
    pub(super) fn outer_surface(
        &self,
        vertices: &[DVec3],
        allowance: &mut MemoryAllowance<'_>,
    ) -> Result<OuterSurface, Problem> {
        let most_sides: usize = self.elements.iter().map(|element| element.kind.faces().len()).sum();
        allowance.take(SORTED * self.elements.len() + most_sides * size_of::<Side>())?;
        let is_repeated = self.repeated();
        let kept = || (0_u32..).zip(&self.elements).filter(|(number, _)| !is_repeated[*number as usize]);
        // An element without volume is numbered as most others of its kind, one hopes.
        let mut senses = [0_i64; 4];
        let mut is_turned: Vec<Option<bool>> = vec![None; self.elements.len()];
        for (number, element) in kept() {
            let turned = element.is_turned(vertices);
            is_turned[number as usize] = turned;
            senses[element.kind as usize] += turned.map_or(0, |turned| if turned { -1 } else { 1 });
        }
        let mut sides: Vec<Side> = Vec::with_capacity(most_sides);
        for (number, element) in kept() {
            for (place, face) in (0..).zip(element.kind.faces()) {
                if let Some(corners) = element.face(face) {
                    let mut sorted = [NONE; 4];
                    sorted.iter_mut().zip(&corners).for_each(|(own, corner)| *own = *corner);
                    sorted.sort_unstable();
                    sides.push((sorted, number, place));
                }
            }
        }
        sides.sort_unstable();
        let alone = || sides.chunk_by(|a, b| a.0 == b.0).filter(|same| same.len() == 1);
        allowance.take(OUTER * alone().count())?;
        let mut outer: Vec<(u32, u8)> = alone().map(|same| (same[0].1, same[0].2)).collect();
        drop(sides);
        outer.sort_unstable();
        let face = |(number, place): (u32, u8)| {
            let element = &self.elements[number as usize];
            let mut face = element.face(element.kind.faces()[usize::from(place)]).unwrap_or_default();
            if is_turned[number as usize].unwrap_or(senses[element.kind as usize] < 0) {
                face.reverse();
            }
            if is_better_from_second(vertices, &face) {
                face.rotate_left(1);
            }
            face
        };
        let faces = outer.into_iter().map(face).collect();
        Ok(OuterSurface { faces, repeated: is_repeated.iter().filter(|is| **is).count() })
    }
}

/// Whether a quadrangle is folded along its second diagonal. It is if it is not flat, so that the diagonal makes a difference, and
/// that one is the shorter.
fn is_better_from_second(vertices: &[DVec3], face: &[u32]) -> bool {
    let [a, b, c, d] = *face else { return false };
    let [a, b, c, d] = [a, b, c, d].map(|vertex| vertices[vertex as usize]);
    let (first, second) = (a.distance(c), b.distance(d));
    // Six times the volume between the four corners.
    let between = (b - a).cross(c - a).dot(d - a).abs();
    between > FLAT * first.max(second).powi(3) && second < first
}

impl VolumeElement {
    /// The vertices of a face, each once: bricks are collapsed to wedges by naming a vertex twice. `None` if nothing is left.
    fn face(&self, places: &[usize]) -> Option<Vec<u32>> {
        let mut face = Vec::with_capacity(4);
        for place in places {
            let vertex = self.corners[*place];
            if !face.contains(&vertex) {
                face.push(vertex);
            }
        }
        (face.len() > 2).then_some(face)
    }

    /// Whether its faces look inwards; `None` if it has no volume.
    ///
    /// The volume is a third of the sum of c·A over its faces, with c the middle of a face, from the middle of the element, and A
    /// its area vector: of a triangle half of the cross product of two sides, of a quadrangle, flat or not, that of its
    /// diagonals.
    fn is_turned(&self, vertices: &[DVec3]) -> Option<bool> {
        let count = self.kind.corners();
        let at = |place: usize| vertices[self.corners[place] as usize];
        let middle = (0..count).map(at).sum::<DVec3>() / count as f64;
        let size = (0..count).map(|place| (at(place) - middle).abs().max_element()).fold(0.0, f64::max);
        let mut sixfold = 0.0;
        for face in self.kind.faces() {
            let at = |place: usize| (at(face[place]) - middle) / size;
            let double = (at(2) - at(0)).cross(at(face.len() - 1) - at(1));
            // Of a triangle, the second factor is another side.
            let mean = (0..face.len()).map(at).sum::<DVec3>() / face.len() as f64;
            sixfold += mean.dot(double);
        }
        (sixfold.abs() > ROUNDING).then_some(sixfold < 0.0)
    }
}
