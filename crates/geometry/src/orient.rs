//! Orients triangles: neighbours consistently, and closed parts outward from the tissue.
//!
//! A part is a set of triangles that are joined at edges. The triangles that face another side than the majority of
//! their part are turned. A closed part encloses a volume whose sign says whether it faces outward. One that lies
//! within an odd number of other closed parts is the wall of a cavity: the tissue is around it, so outward from the
//! tissue is into the cavity. An open part has no inside and stays as in the file, unless its holes are so small that
//! its inner side can't be meant.

use std::f64::consts::PI;

use glam::DVec3;

use crate::join::Joined;
use crate::ray::Enclosures;
use crate::tree::corners;

/// Ratio of the largest area of its holes to its own area up to which a part is nearly closed and has an inside.
const NEARLY_CLOSED: f64 = 0.02;

/// Fraction of its area, weighted by distance from the middle, above which an open part faces outward or inward.
const FACES: f64 = 0.2;

/// Ratio of its volume to what its area could enclose below which a closed part is flat, and has no inside.
const FLAT: f64 = 1e-9;

/// A part of a mesh: triangles that are joined at edges.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Part {
    /// Its triangles, ascending.
    pub(crate) triangles: Vec<u32>,
    /// Whether it has no border.
    pub(crate) is_closed: bool,
    /// Whether its triangles can all face the same side.
    pub(crate) is_orientable: bool,
    /// Number of its triangles that face another side than the majority.
    pub(crate) turned: usize,
    /// Whether the whole part is turned, since it is closed, or nearly so, and faces inward.
    pub(crate) is_turned: bool,
    /// Whether it is the wall of a cavity of another part.
    pub(crate) is_cavity: bool,
    /// Whether it is open and faces inward; it is not turned.
    pub(crate) faces_inward: bool,
    /// The closed parts around it.
    pub(crate) around: Vec<u32>,
}

/// The parts of a mesh, and the triangles to turn.
pub(crate) struct Oriented {
    pub(crate) parts: Vec<Part>,
    /// The part of each triangle; beyond the last for ignored triangles.
    pub(crate) part_of: Vec<u32>,
    pub(crate) is_turned: Vec<bool>,
    /// Number of parts for which finding the surrounding parts took too much work; they count as within none.
    pub(crate) unknown: usize,
}

/// Finds the parts and their orientation.
pub(crate) fn orient(vertices: &[DVec3], triangles: &[[u32; 3]], joined: &Joined) -> Oriented {
    let mut found = connect(triangles.len(), joined);
    for triangle in joined.borders.iter().map(|border| border.0).chain(joined.crowded.iter().copied()) {
        found.parts[found.part_of[triangle as usize] as usize].is_closed = false;
    }
    let mut border_m = vec![0.0; found.parts.len()];
    for (triangle, edge) in &joined.borders {
        let [from, to] = edge.map(|at| vertices[at as usize]);
        border_m[found.part_of[*triangle as usize] as usize] += from.distance(to);
    }
    let encloses =
        |triangle: u32| found.parts.get(found.part_of[triangle as usize] as usize).is_some_and(|part| part.is_closed);
    let has_several = found.parts.len() > 1;
    let mut enclosures = has_several.then(|| Enclosures::new(vertices, triangles, &found.part_of, encloses));
    let (mut faced, mut unknown) = (Vec::with_capacity(found.parts.len()), 0);
    for (number, part) in (0..).zip(&found.parts) {
        let around = enclosures.as_mut().and_then(|closed| closed.around(number, &part.triangles));
        let facing = Facing::of(vertices, triangles, &found.is_turned, &part.triangles);
        unknown += usize::from(enclosures.is_some() && around.is_none());
        faced.push((facing, around.unwrap_or_default()));
    }
    found.unknown = unknown;
    for ((part, (facing, around)), border_m) in found.parts.iter_mut().zip(faced).zip(border_m) {
        part.around = around;
        part.is_cavity = part.around.len() % 2 == 1 && part.is_orientable;
        // The largest hole with a border of this length is a disc.
        let is_nearly_closed =
            border_m * border_m / (4.0 * PI) <= NEARLY_CLOSED * facing.area && facing.outward.abs() > FACES;
        let (has_inside, is_flat) = (part.is_closed || is_nearly_closed, facing.outward.abs() <= FLAT);
        part.is_turned = part.is_orientable && has_inside && !is_flat && (facing.outward > 0.0) == part.is_cavity;
        part.faces_inward = part.is_orientable && !has_inside && facing.outward < -FACES;
        if part.is_turned {
            part.triangles.iter().for_each(|triangle| found.is_turned[*triangle as usize] ^= true);
        }
    }
    found
}

/// The orientation of a part, with its triangles turned.
struct Facing {
    /// Its area, m².
    area: f64,
    /// 1 if all of it faces away from its middle, −1 if all of it faces towards it.
    outward: f64,
}

impl Facing {
    fn of(vertices: &[DVec3], triangles: &[[u32; 3]], is_turned: &[bool], of: &[u32]) -> Self {
        let normal = |[a, b, c]: [DVec3; 3]| 0.5 * (b - a).cross(c - a);
        let at = |triangle: &u32| corners(vertices, triangles[*triangle as usize]);
        let middle = |at: [DVec3; 3]| (at[0] + at[1] + at[2]) / 3.0;
        let (mut area, mut sum) = (0.0, DVec3::ZERO);
        for triangle in of.iter().map(at) {
            let own = normal(triangle).length();
            area += own;
            sum += own * middle(triangle);
        }
        let middle_of_all = if area > 0.0 { sum / area } else { of.first().map_or(DVec3::ZERO, |first| at(first)[0]) };
        // Three times the volume of the cones from the middle to the triangles, with its sign, and its largest
        // possible value.
        let (mut signed, mut most) = (0.0, 0.0);
        for triangle in of {
            let (normal, off) = (normal(at(triangle)), middle(at(triangle)) - middle_of_all);
            let own = normal.dot(off);
            signed += if is_turned[*triangle as usize] { -own } else { own };
            most += normal.length() * off.length();
        }
        Self { area, outward: if most > 0.0 { signed / most } else { 0.0 } }
    }
}

/// Finds the triangles that are joined, and turns those that face another side than the majority of their part.
fn connect(count: usize, joined: &Joined) -> Oriented {
    const NONE: u32 = u32::MAX;
    // Each side of a triangle has at most one partner: which one, and whether that faces the other side.
    let mut neighbours = vec![[(NONE, false); 3]; count];
    let mut add = |own: u32, other: u32, is_other: bool| {
        let free = neighbours[own as usize].iter_mut().find(|place| place.0 == NONE);
        free.into_iter().for_each(|place| *place = (other, is_other));
    };
    for [a, b] in &joined.pairs {
        add(a.triangle, b.triangle, a.is_forward == b.is_forward);
        add(b.triangle, a.triangle, a.is_forward == b.is_forward);
    }
    let mut takes_part = vec![false; count];
    let alone = joined.borders.iter().map(|border| border.0).chain(joined.crowded.iter().copied());
    let paired = joined.pairs.iter().flatten().map(|side| side.triangle);
    paired.chain(alone).for_each(|triangle| takes_part[triangle as usize] = true);
    let mut found =
        Oriented { parts: Vec::new(), part_of: vec![NONE; count], is_turned: vec![false; count], unknown: 0 };
    for start in (0..).take(count).filter(|triangle| takes_part[*triangle as usize]) {
        if found.part_of[start as usize] != NONE {
            continue;
        }
        let number = u32::try_from(found.parts.len()).unwrap_or(NONE);
        found.part_of[start as usize] = number;
        let (mut triangles, mut next, mut is_orientable) = (vec![start], 0, true);
        while let Some(triangle) = triangles.get(next).map(|triangle| *triangle as usize) {
            next += 1;
            for (neighbour, is_other) in neighbours[triangle].iter().filter(|neighbour| neighbour.0 != NONE) {
                let (neighbour, wanted) = (*neighbour as usize, found.is_turned[triangle] != *is_other);
                if found.part_of[neighbour] == NONE {
                    found.part_of[neighbour] = number;
                    found.is_turned[neighbour] = wanted;
                    triangles.push(neighbour as u32);
                } else {
                    is_orientable &= found.is_turned[neighbour] == wanted;
                }
            }
        }
        triangles.sort_unstable();
        let mut turned = triangles.iter().filter(|triangle| found.is_turned[**triangle as usize]).count();
        // Chooses the side of the majority; turns none if the part has only one side.
        if !is_orientable {
            triangles.iter().for_each(|triangle| found.is_turned[*triangle as usize] = false);
            turned = 0;
        } else if 2 * turned > triangles.len() {
            triangles.iter().for_each(|triangle| found.is_turned[*triangle as usize] ^= true);
            turned = triangles.len() - turned;
        }
        found.parts.push(Part {
            triangles,
            is_closed: true,
            is_orientable,
            turned,
            is_turned: false,
            is_cavity: false,
            faces_inward: false,
            around: Vec::new(),
        });
    }
    found
}

impl Oriented {
    /// Returns sentences that describe what is turned.
    pub(crate) fn notes(&self) -> Vec<String> {
        let mut notes = Vec::new();
        let turned: usize = self.parts.iter().map(|part| part.turned).sum();
        if turned > 0 {
            notes.push(format!("Triangles turned to the side that the others face: {turned}."));
        }
        for (is_cavity, what) in
            [(false, "Closed surfaces turned outward"), (true, "Walls of cavities turned into them")]
        {
            let of = || self.parts.iter().filter(|part| part.is_turned && part.is_cavity == is_cavity);
            let triangles: usize = of().map(|part| part.triangles.len()).sum();
            if triangles > 0 {
                notes.push(format!("{what}: {}, with their triangles: {triangles}.", of().count()));
            }
        }
        if self.unknown > 0 {
            let count = self.unknown;
            notes.push(format!(
                "Surfaces of which it would take too long to find whether others are around them: {count}."
            ));
        }
        if self.parts.iter().any(|part| !part.is_orientable) {
            notes
                .push("A surface has one side only, like a Möbius strip: no way of turning triangles fits.".to_owned());
        }
        notes
    }
}
