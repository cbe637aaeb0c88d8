//! The corners of a solid that cuts have doubled: a copy for each part into which the cubes around a corner fall.
//!
//! A cut severs faces between cubes; cubes stay whole (linked cells: Dick, Georgii, Westermann, A hexahedral multigrid approach for
//! simulating cuts in deformable objects, IEEE TVCG 17(11), 2011). The four cubes beside a face share its corners. Once no way
//! from cube to cube through whole faces leads around a corner, the cubes on one side get a copy of it, with the displacement
//! and velocity that the corner has, and the mass of their eighths. So nothing jumps, and no vibration becomes faster than that of one
//! cube alone, by which the substep is bounded.
//!
//! A copy is at a spare place, in the order in which faces were severed. The result depends on this order alone.

#![allow(clippy::cast_possible_truncation)]

use glam::DVec3;

use crate::body::solid::place_numbers::PlaceNumbers;
use crate::body::solid::places::SolidPlaces;

/// The part of the cubes around a corner that share a copy of it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct CornerPart {
    corner: u32,
    /// A bit for each cube: bit n if the corner is its corner n, x before y before z.
    cubes: u8,
    place: u32,
}

/// A copy of a corner.
#[derive(Debug, Clone, Copy, PartialEq)]
struct CornerCopy {
    corner: u32,
    /// The place of the corner or copy from which it came.
    from: u32,
    /// The version of the topology since which there is this copy.
    version: u32,
}

/// A cube that has a copy among its corners.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct CutCube {
    /// Its least corner.
    pub(crate) cube: u32,
    /// Its middle at rest, m.
    pub(crate) middle_m: DVec3,
    /// The places of its corners.
    pub(crate) corners: [u32; 8],
}

/// A copy that a severed face has made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct DoubledCorner {
    /// The place of the corner or copy whose cubes fell apart.
    pub(crate) from: usize,
    /// The place of the new copy.
    pub(crate) to: usize,
    /// Its cubes, by bits as in [`CornerPart`].
    cubes: u8,
    corner: u32,
}

/// A corner, or a copy of it, whose cubes fall into two parts.
#[derive(Debug)]
struct CornerSplit {
    /// Its part; `None` if the corner was whole.
    part: Option<usize>,
    /// The part that a whole corner is.
    whole: CornerPart,
    /// The cubes that get a copy, by bits as in [`CornerPart`].
    moved: u8,
    /// The cubes around the corner.
    around: [Option<usize>; 8],
}

/// The copies of the corners of a solid. Empty if nothing is cut.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct CornerCopies {
    /// The parts of doubled corners; after each, the next one of its corner.
    parts: Vec<CornerPart>,
    next: Vec<u32>,
    /// For each corner that is not whole, its first part.
    first_of: PlaceNumbers,
    /// The cubes that have copies, in the order in which they got them; and for each least corner, its place in this list.
    cubes: Vec<CutCube>,
    cube_at: PlaceNumbers,
    /// The copies, by their places.
    copies: Vec<CornerCopy>,
    /// The first spare place, and how many there are.
    first_spare: u32,
    spare: usize,
}

/// The number of no part.
const NONE: u32 = u32::MAX;

/// The most corners that one face can double.
const CORNERS_OF_FACE: usize = 4;

impl CornerCopies {
    /// Creates it for a solid without cuts.
    pub(crate) fn none(places: &SolidPlaces) -> Self {
        let spare = places.spare();
        CornerCopies {
            parts: Vec::new(),
            next: Vec::new(),
            first_of: PlaceNumbers::default(),
            cubes: Vec::new(),
            cube_at: PlaceNumbers::default(),
            copies: Vec::new(),
            first_spare: spare.start as u32,
            spare: spare.len(),
        }
    }

    /// Returns whether a solid without cuts has spare places for what one face doubles.
    pub(crate) fn fits_in(places: &SolidPlaces) -> bool {
        places.spare().len() >= CORNERS_OF_FACE
    }

    /// Returns whether there are spare places for whatever one more face doubles.
    pub(crate) fn has_room(&self) -> bool {
        self.copies.len() + CORNERS_OF_FACE <= self.spare
    }

    /// Returns the end of the places of all copies.
    pub(crate) fn end(&self) -> usize {
        self.first_spare as usize + self.copies.len()
    }

    /// Returns the places of all copies.
    pub(crate) fn places(&self) -> impl Iterator<Item = usize> + use<> {
        let first = self.first_spare as usize;
        first..first + self.copies.len()
    }

    /// Returns the corner of a place: of a copy, the one that it is a copy of.
    #[inline]
    pub(crate) fn corner_of(&self, place: usize) -> usize {
        let copy = place.checked_sub(self.first_spare as usize);
        copy.and_then(|copy| self.copies.get(copy)).map_or(place, |copy| copy.corner as usize)
    }

    /// Returns the version of the topology since which a place is a copy of a corner; `None` if it is none.
    pub(crate) fn since(&self, place: usize) -> Option<u32> {
        let copy = place.checked_sub(self.first_spare as usize)?;
        self.copies.get(copy).map(|copy| copy.version)
    }

    /// Returns the place of the corner or copy from which a copy came; `None` for a corner.
    pub(crate) fn origin_of(&self, place: usize) -> Option<u32> {
        let copy = place.checked_sub(self.first_spare as usize)?;
        self.copies.get(copy).map(|copy| copy.from)
    }

    /// Returns the version of the topology since which two cubes, given by their least corners, no longer share a corner that they have in
    /// common; `None` if they share all.
    pub(crate) fn apart_since(&self, places: &SolidPlaces, cubes: [usize; 2]) -> Option<u32> {
        let [corners, others] = cubes.map(|cube| places.corners_of(cube));
        let [own, other] = cubes.map(|cube| corners_of(places, Some(self), cube));
        let mut since = None;
        for (number, corner) in corners.iter().enumerate() {
            let Some(same) = others.iter().position(|other| other == corner) else { continue };
            let found = self.parted_since([own[number], other[same]]);
            since = since.into_iter().chain(found).min();
        }
        since
    }

    /// Returns since when two places are copies of one corner apart from each other; `None` if they are one place.
    fn parted_since(&self, [mut one, mut other]: [usize; 2]) -> Option<u32> {
        let mut since = None;
        // The one that is newer came from the other, or both from a third.
        while one != other {
            let newer = one.max(other);
            let copy = self.copies.get(newer.checked_sub(self.first_spare as usize)?)?;
            (one, other, since) = (one.min(other), copy.from as usize, Some(copy.version));
        }
        since
    }

    /// Returns the cubes that have copies among their corners, in the order in which they got them.
    pub(crate) fn cubes(&self) -> &[CutCube] {
        &self.cubes
    }

    /// Returns the place of a cube in the list of those that have copies.
    #[inline]
    pub(crate) fn number_of(&self, cube: usize) -> Option<usize> {
        self.cube_at.get(cube)
    }

    /// Returns the places of the corners of a cube, x before y before z, if it has copies among them.
    #[inline]
    pub(crate) fn cut_corners(&self, cube: usize) -> Option<[u32; 8]> {
        self.number_of(cube).map(|number| self.cubes[number].corners)
    }

    /// Returns the cubes around a place that have copies among their corners, by their places in the list, ascending.
    pub(crate) fn cut_cubes_around(&self, places: &SolidPlaces, place: usize) -> Vec<usize> {
        let around = cubes_around(places, self.corner_of(place));
        let numbers = around.into_iter().flatten().filter_map(|cube| self.number_of(cube));
        let mut found: Vec<usize> = numbers
            .filter(|number| self.cubes[*number].corners.iter().any(|corner| *corner as usize == place))
            .collect();
        found.sort_unstable();
        found
    }

    /// Returns the relative mass at a place: the eighths of its cubes.
    pub(crate) fn mass(&self, places: &SolidPlaces, place: usize) -> f64 {
        let corner = self.corner_of(place);
        match self.parts_of(corner).find(|part| self.parts[*part].place as usize == place) {
            Some(part) => mass_of(places, corner, self.parts[part].cubes),
            None => places.mass(place),
        }
    }

    /// Returns the numbers of the parts of a corner; none if it is whole.
    fn parts_of(&self, corner: usize) -> impl Iterator<Item = usize> {
        let next = |at: &usize| Some(self.next[*at]).filter(|at| *at != NONE).map(|at| at as usize);
        std::iter::successors(self.first_of.get(corner), next)
    }

    /// Returns the places of a corner: its own, and those of its copies.
    pub(crate) fn places_of(&self, corner: usize) -> impl Iterator<Item = usize> {
        let of_parts = self.parts_of(corner).map(|part| self.parts[part].place as usize);
        of_parts.chain([corner].into_iter().filter(move |_| self.first_of.get(corner).is_none()))
    }

    /// Severs the face of a cube with the higher coordinate along an axis, in a version of the topology. `is_severed` tells of each such face whether it is
    /// severed: this one and those before it. Returns the copies that it makes; the caller has made sure that there is room.
    pub(crate) fn sever(
        &mut self,
        places: &SolidPlaces,
        (cube, axis): (usize, usize),
        version: u32,
        is_severed: impl Fn(usize, usize) -> bool,
    ) -> Vec<DoubledCorner> {
        let splits = self.splits(places, (cube, axis), is_severed);
        splits
            .into_iter()
            .map(|split| {
                let part = split.part.unwrap_or_else(|| self.add_part(split.whole));
                self.double(places, part, (split.moved, version), &split.around)
            })
            .collect()
    }

    /// Returns the places that [`CornerCopies::sever`] would double.
    pub(crate) fn doubled_by(
        &self,
        places: &SolidPlaces,
        face: (usize, usize),
        is_severed: impl Fn(usize, usize) -> bool,
    ) -> Vec<usize> {
        let splits = self.splits(places, face, is_severed);
        let of = |split: &CornerSplit| split.part.map_or(split.whole.corner, |part| self.parts[part].place);
        splits.iter().map(|split| of(split) as usize).collect()
    }

    /// Returns the corners of a face whose cubes fall apart if it is severed. Of one corner that does not depend on the others.
    fn splits(
        &self,
        places: &SolidPlaces,
        (cube, axis): (usize, usize),
        is_severed: impl Fn(usize, usize) -> bool,
    ) -> Vec<CornerSplit> {
        let bit = 1 << axis;
        let Some(beyond) = places.cube_across(cube, axis, true) else { return Vec::new() };
        let mut found = Vec::new();
        // The corners of the face are those of the cube beyond it that are lower along the axis.
        for (number, corner) in
            places.corners_of(beyond).into_iter().enumerate().filter(|(number, _)| number & bit == 0)
        {
            let around = cubes_around(places, corner);
            let part = self.parts_of(corner).find(|part| self.parts[*part].cubes >> number & 1 == 1);
            let whole = CornerPart { corner: corner as u32, cubes: mask_of(&around), place: corner as u32 };
            let cubes = part.map_or(whole.cubes, |part| self.parts[part].cubes);
            // The corner is a higher one of the cube before the face.
            if cubes >> (number | bit) & 1 == 0 {
                continue;
            }
            let joined = |from: usize| joined_to(from, cubes, &around, &is_severed);
            let [beyond_face, before_face] = [joined(number), joined(number | bit)];
            if beyond_face == before_face {
                continue;
            }
            let moved = if beyond_face.count_ones() <= before_face.count_ones() { beyond_face } else { before_face };
            found.push(CornerSplit { part, whole, moved, around });
        }
        found
    }

    /// Gives some cubes of a part a copy of its corner.
    fn double(
        &mut self,
        places: &SolidPlaces,
        part: usize,
        (moved, version): (u8, u32),
        around: &[Option<usize>; 8],
    ) -> DoubledCorner {
        let CornerPart { corner, place: from, .. } = self.parts[part];
        let to = self.first_spare + self.copies.len() as u32;
        self.copies.push(CornerCopy { corner, from, version });
        self.parts[part].cubes &= !moved;
        self.add_part(CornerPart { corner, cubes: moved, place: to });
        for (number, cube) in around.iter().enumerate() {
            let Some(cube) = cube.filter(|_| moved >> number & 1 == 1) else { continue };
            let at = self.number_of(cube).unwrap_or_else(|| {
                let corners = places.corners_of(cube).map(|place| place as u32);
                self.cube_at.set(cube, self.cubes.len() as u32);
                self.cubes.push(CutCube { cube: cube as u32, middle_m: places.middle_m(cube), corners });
                self.cubes.len() - 1
            });
            self.cubes[at].corners[number] = to;
        }
        DoubledCorner { from: from as usize, to: to as usize, cubes: moved, corner }
    }

    /// Adds a part. Returns its number.
    fn add_part(&mut self, part: CornerPart) -> usize {
        let corner = part.corner as usize;
        self.next.push(self.first_of.get(corner).map_or(NONE, |at| at as u32));
        self.first_of.set(corner, self.parts.len() as u32);
        self.parts.push(part);
        self.parts.len() - 1
    }
}

/// Returns the places of the corners of a cube, x before y before z, in a solid with these copies.
#[inline]
pub(crate) fn corners_of(places: &SolidPlaces, copies: Option<&CornerCopies>, cube: usize) -> [usize; 8] {
    match copies.and_then(|copies| copies.cut_corners(cube)) {
        Some(corners) => corners.map(|place| place as usize),
        None => places.corners_of(cube),
    }
}

impl DoubledCorner {
    /// Returns the cubes of the copy.
    pub(crate) fn cubes(&self, places: &SolidPlaces) -> impl Iterator<Item = usize> + use<> {
        let (around, cubes) = (cubes_around(places, self.corner as usize), self.cubes);
        let of_copy = move |(number, cube): (usize, Option<usize>)| cube.filter(|_| cubes >> number & 1 == 1);
        around.into_iter().enumerate().filter_map(of_copy)
    }
}

/// Returns the cubes around a corner: at n the one of which it is corner n.
fn cubes_around(places: &SolidPlaces, corner: usize) -> [Option<usize>; 8] {
    let mut around = [None; 8];
    for beside in 0..2 {
        for (row, cube) in places.cubes_around(corner, beside).into_iter().enumerate() {
            // Rows: none before, one before along y, one along z, both.
            around[beside | row << 1] = cube;
        }
    }
    around
}

fn mask_of(around: &[Option<usize>; 8]) -> u8 {
    around.iter().enumerate().filter(|(_, cube)| cube.is_some()).fold(0, |mask, (number, _)| mask | 1 << number)
}

fn mass_of(places: &SolidPlaces, corner: usize, cubes: u8) -> f64 {
    let around = cubes_around(places, corner);
    let of = |(number, cube): (usize, &Option<usize>)| {
        cube.filter(|_| cubes >> number & 1 == 1).map(|cube| places.cube_mass(cube))
    };
    // In the order in which the whole corner adds them up: by ascending cube.
    around.iter().enumerate().rev().filter_map(of).map(|mass| 0.125 * mass).sum()
}

/// Returns the cubes of a part that whole faces join to one of them.
fn joined_to(from: usize, part: u8, around: &[Option<usize>; 8], is_severed: &impl Fn(usize, usize) -> bool) -> u8 {
    let mut found = 1_u8 << from;
    let mut waiting = vec![from];
    while let Some(number) = waiting.pop() {
        for axis in 0..3 {
            let other = number ^ 1 << axis;
            // Of two cubes the one of which the corner is the higher is the lower one.
            let Some(lower) = around[number | 1 << axis] else { continue };
            let is_whole = part >> other & 1 == 1 && !is_severed(lower, axis);
            if is_whole && found >> other & 1 == 0 {
                found |= 1 << other;
                waiting.push(other);
            }
        }
    }
    found
}
