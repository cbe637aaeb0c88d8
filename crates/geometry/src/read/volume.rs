//! Volume elements, and the surface around them: the faces that belong to only one element.
//!
//! Files number elements in both orientations, and the faces of skewed elements are not flat. So an element is
//! reversed as a whole, according to the sign of its volume: neighbours with the same orientation then agree at the
//! edges of the surface.

use glam::DVec3;

use super::allowance::MemoryAllowance;
use crate::Problem;

/// Stands for corners that a face or element does not have.
const NONE: u32 = u32::MAX;

/// Volumes below this fraction of the cube of an element's size are treated as zero, because of rounding.
const ROUNDING: f64 = 1e-9;

/// A quadrilateral whose corners enclose less than this fraction of the cube of its diagonal is treated as flat.
const FLAT: f64 = 1e-6;

/// Type of a volume element, which determines its faces. Corners are numbered as in Gmsh and VTK, which agree for
/// these types except in the orientation of prisms.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Cell {
    Tetrahedron,
    Hexahedron,
    Prism,
    Pyramid,
}

impl Cell {
    /// Returns the number of corners.
    pub(super) fn corners(self) -> usize {
        match self {
            Cell::Tetrahedron => 4,
            Cell::Hexahedron => 8,
            Cell::Prism => 6,
            Cell::Pyramid => 5,
        }
    }

    /// Returns its faces, counterclockwise seen from outside.
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

/// A face of an element: its sorted corners, the element, and the index of the face in the element.
type Side = ([u32; 4], u32, u8);

/// Memory for finding repeated elements, bytes for each element.
const SORTED: usize = 48;

/// Memory for a face that belongs to only one element, bytes.
const OUTER: usize = 80;

/// A volume element.
#[derive(Clone, Copy)]
struct VolumeElement {
    kind: Cell,
    corners: [u32; 8],
}

/// The volume elements of a file.
#[derive(Default)]
pub(super) struct Volume {
    elements: Vec<VolumeElement>,
    /// The edges of tetrahedra with ten nodes, lower end first, and the node at the middle of each.
    middles: Vec<([u32; 2], u32)>,
}

/// The surface around volume elements.
pub(super) struct OuterSurface {
    /// Three or four vertices for each face, counterclockwise seen from outside.
    pub(super) faces: Vec<Vec<u32>>,
    /// Number of elements that were ignored because they have the corners of an earlier element.
    pub(super) repeated: usize,
    /// Number of other elements whose corners are in the order of a mirror image.
    pub(super) turned: usize,
}

impl Volume {
    /// Returns the number of elements.
    pub(super) fn len(&self) -> usize {
        self.elements.len()
    }

    /// Adds an element. `corners` has as many entries as its type has corners.
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

    /// Adds the nodes at the middles of the edges of the last element, a tetrahedron. Formats number them differently, so each is
    /// that of the edge whose middle is nearest; if two are nearest to the same, the edges stay straight.
    pub(super) fn add_middles(
        &mut self,
        middles: [u32; 6],
        vertices: &[DVec3],
        allowance: &mut MemoryAllowance<'_>,
    ) -> Result<(), Problem> {
        const EDGES: [[usize; 2]; 6] = [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]];
        let Some(element) = self.elements.last() else { return Ok(()) };
        let at = |vertex: u32| vertices[vertex as usize];
        let edges = EDGES.map(|ends| ends.map(|end| element.corners[end]));
        let far = |middle: u32, [a, b]: [u32; 2]| (2.0 * at(middle) - at(a) - at(b)).length_squared();
        let nearest = |middle: u32| (0..6).min_by(|a, b| far(middle, edges[*a]).total_cmp(&far(middle, edges[*b])));
        let of_edge = middles.map(|middle| nearest(middle).unwrap_or(0));
        if (0..6).all(|edge| of_edge.contains(&edge)) {
            for (middle, edge) in middles.into_iter().zip(of_edge) {
                let [a, b] = edges[edge];
                allowance.push(&mut self.middles, ([a.min(b), a.max(b)], middle))?;
            }
        }
        Ok(())
    }

    /// Returns the nodes at the middles of edges, sorted by edge; none if not all elements have them, because the faces of
    /// others would not fit.
    fn sorted_middles(&self, allowance: &mut MemoryAllowance<'_>) -> Result<Vec<([u32; 2], u32)>, Problem> {
        if self.middles.len() != 6 * self.elements.len() {
            return Ok(Vec::new());
        }
        allowance.take(size_of_val(&*self.middles))?;
        let mut sorted = self.middles.clone();
        sorted.sort_unstable();
        sorted.dedup_by_key(|(edge, _)| *edge);
        Ok(sorted)
    }

    /// Returns a part of the volume: elements by their numbers, with straight edges.
    pub(super) fn part(
        &self,
        numbers: impl Iterator<Item = u32>,
        allowance: &mut MemoryAllowance<'_>,
    ) -> Result<Volume, Problem> {
        let mut part = Volume::default();
        for number in numbers {
            allowance.push(&mut part.elements, self.elements[number as usize])?;
        }
        Ok(part)
    }

    /// Returns for each element whether it has the corners of an earlier element.
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

    /// Returns the faces that belong to only one element, in the order of the elements.
    pub(super) fn outer_surface(
        &self,
        vertices: &[DVec3],
        allowance: &mut MemoryAllowance<'_>,
    ) -> Result<OuterSurface, Problem> {
        let most_sides: usize = self.elements.iter().map(|element| element.kind.faces().len()).sum();
        allowance.take(SORTED * self.elements.len() + most_sides * size_of::<Side>())?;
        let is_repeated = self.repeated();
        let kept = || (0_u32..).zip(&self.elements).filter(|(number, _)| !is_repeated[*number as usize]);
        // An element without volume is assumed to have the orientation of most others of its type.
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
        let middles = self.sorted_middles(allowance)?;
        let pieces = if middles.is_empty() { 1 } else { 4 };
        allowance.take(pieces * OUTER * alone().count())?;
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
        let faces = outer.into_iter().map(face).flat_map(|face| split(face, &middles)).collect();
        let repeated = is_repeated.iter().filter(|is| **is).count();
        // Elements of some types are all numbered the other way round in some files.
        let is_odd = |(turned, element): (&Option<bool>, &VolumeElement)| {
            turned.is_some_and(|turned| turned != (senses[element.kind as usize] < 0))
        };
        let turned = is_turned.iter().zip(&self.elements).filter(|pair| is_odd(*pair)).count();
        Ok(OuterSurface { faces, repeated, turned })
    }
}

/// Splits a triangle at the nodes in the middles of its edges into four, if it has them.
fn split(face: Vec<u32>, middles: &[([u32; 2], u32)]) -> Vec<Vec<u32>> {
    let middle = |a: u32, b: u32| {
        let found = middles.binary_search_by_key(&[a.min(b), a.max(b)], |(edge, _)| *edge);
        found.ok().map(|at| middles[at].1)
    };
    if let [a, b, c] = face[..]
        && let (Some(ab), Some(bc), Some(ca)) = (middle(a, b), middle(b, c), middle(c, a))
    {
        return vec![vec![a, ab, ca], vec![ab, b, bc], vec![ca, bc, c], vec![ab, bc, ca]];
    }
    vec![face]
}

/// Returns whether a quadrilateral is to be split along its second diagonal: if it is not flat, so that the choice
/// makes a difference, and this diagonal is the shorter one.
fn is_better_from_second(vertices: &[DVec3], face: &[u32]) -> bool {
    let [a, b, c, d] = *face else { return false };
    let [a, b, c, d] = [a, b, c, d].map(|vertex| vertices[vertex as usize]);
    let (first, second) = (a.distance(c), b.distance(d));
    // Six times the volume of the tetrahedron of the four corners.
    let between = (b - a).cross(c - a).dot(d - a).abs();
    between > FLAT * first.max(second).powi(3) && second < first
}

impl VolumeElement {
    /// Returns the vertices of a face without repetitions: hexahedra are collapsed to wedges by naming a vertex
    /// twice. `None` if fewer than three vertices remain.
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

    /// Returns whether its faces point inwards. `None` if it has no volume.
    ///
    /// The volume is a third of the sum of c·A over its faces. c is the middle of the face relative to the middle of
    /// the element; A is its area vector: half of the cross product of two sides for a triangle, and of the diagonals
    /// for a quadrilateral, flat or not.
    fn is_turned(&self, vertices: &[DVec3]) -> Option<bool> {
        let count = self.kind.corners();
        let at = |place: usize| vertices[self.corners[place] as usize];
        let middle = (0..count).map(at).sum::<DVec3>() / count as f64;
        let size = (0..count).map(|place| (at(place) - middle).abs().max_element()).fold(0.0, f64::max);
        let mut sixfold = 0.0;
        for face in self.kind.faces() {
            let at = |place: usize| (at(face[place]) - middle) / size;
            let double = (at(2) - at(0)).cross(at(face.len() - 1) - at(1));
            // For a triangle, the second factor is another side.
            let mean = (0..face.len()).map(at).sum::<DVec3>() / face.len() as f64;
            sixfold += mean.dot(double);
        }
        (sixfold.abs() > ROUNDING).then_some(sixfold < 0.0)
    }
}
