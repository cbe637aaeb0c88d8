//! Triangles that are present more than once at the same positions: duplicate surfaces, and internal walls of a solid
//! that both adjacent cells contain.
//!
//! Of duplicates, one stays. Of two triangles with opposite orientations, one stays as well where the surface needs
//! it: on a two-sided surface, or where a triangle was also written in reverse order. Where the surrounding surface
//! is complete without both, they are a wall inside a solid, and both are dropped: as boundaries of two cells they
//! cancel.
//!
//! If cells were split into tetrahedra separately, their common walls may be split along different diagonals. The
//! four triangles of such a wall are the faces of a flat tetrahedron; one diagonal is flipped first, so that the
//! triangles match.

use std::collections::BTreeMap;

use crate::TriangleMesh;
use crate::ray::Enclosures;
use crate::topology::{Sets, Topology, is_proper};
use crate::work::spend;

/// A tetrahedron is flat if six times its volume is at most this fraction of the cube of its longest edge.
const FLAT: f64 = 1e-4;

/// Maximum number of triangles at an edge that are compared in pairs.
const COMPARED: usize = 16;

/// Result of [`doubled`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Doubled {
    /// Whether each triangle stays.
    pub(crate) keep: Vec<bool>,
    /// Number of dropped duplicate triangles.
    pub(crate) copies: usize,
    /// Number of dropped triangles of internal walls.
    pub(crate) walls: usize,
}

/// Triangles between the same three positions.
struct Class {
    /// First the triangles whose positions are a rotation of the ascending order, then the others.
    facing: [Vec<u32>; 2],
    /// Whether all of them use the same vertices.
    is_shared: bool,
}

/// Finds triangles that are present more than once. `places` gives the position of each vertex, as the first vertex
/// there. Indices must be in range.
pub(crate) fn doubled(mesh: &TriangleMesh, places: &[u32]) -> Doubled {
    let triangles = &mesh.triangles;
    let at = |triangle: [u32; 3]| triangle.map(|vertex| places[vertex as usize]);
    let sorted = |mut three: [u32; 3]| {
        three.sort_unstable();
        three
    };
    let mut order: Vec<([u32; 3], u32)> =
        (0..).zip(triangles).filter(|(_, of)| is_proper(&at(**of))).map(|(n, of)| (sorted(at(*of)), n)).collect();
    order.sort_unstable();
    let mut found = Doubled { keep: vec![true; triangles.len()], copies: 0, walls: 0 };
    let mut classes: Vec<Class> = Vec::new();
    let mut class_of: Vec<Option<u32>> = vec![None; triangles.len()];
    for same in order.chunk_by(|a, b| a.0 == b.0).filter(|same| same.len() > 1) {
        let mut class = Class { facing: [Vec::new(), Vec::new()], is_shared: true };
        for (places, number) in same {
            let of = at(triangles[*number as usize]);
            let first = of.iter().position(|place| *place == places[0]).unwrap_or(0);
            class.facing[usize::from(of[(first + 1) % 3] != places[1])].push(*number);
            class.is_shared &= sorted(triangles[*number as usize]) == sorted(triangles[same[0].1 as usize]);
        }
        if class.facing.iter().any(Vec::is_empty) {
            found.drop_copies(&class);
        } else {
            let number = u32::try_from(classes.len()).ok();
            same.iter().for_each(|(_, triangle)| class_of[*triangle as usize] = number);
            classes.push(class);
        }
    }
    if !classes.is_empty() {
        found.judge(mesh, &at, &classes, &class_of);
    }
    found
}

impl Doubled {
    /// Drops all triangles of a class except the first.
    fn drop_copies(&mut self, class: &Class) {
        let first = class.facing.iter().flatten().min();
        for triangle in class.facing.iter().flatten().filter(|triangle| Some(*triangle) != first) {
            self.keep[*triangle as usize] = false;
            self.copies += 1;
        }
    }

    /// Drops equal numbers of both sides of a wall, as many as there are of the rarer side.
    fn drop_wall(&mut self, class: &Class) {
        let both = class.facing[0].len().min(class.facing[1].len());
        for triangle in class.facing.iter().flat_map(|one| &one[..both]) {
            self.keep[*triangle as usize] = false;
            self.walls += 1;
        }
        let rest = class.facing.each_ref().map(|one| one[both..].to_vec());
        self.drop_copies(&Class { facing: rest, is_shared: class.is_shared });
    }

    /// Decides about triangles that are present from both sides, based on the other triangles at the edges of each
    /// connected patch.
    fn judge(
        &mut self,
        mesh: &TriangleMesh,
        at: &impl Fn([u32; 3]) -> [u32; 3],
        classes: &[Class],
        class_of: &[Option<u32>],
    ) {
        let mut halves: Vec<([u32; 2], Option<u32>)> = Vec::new();
        for (number, triangle) in mesh.triangles.iter().enumerate().filter(|(number, _)| self.keep[*number]) {
            let [a, b, c] = at(*triangle);
            if is_proper(&[a, b, c]) {
                let edges = [[a, b], [b, c], [c, a]].map(|[a, b]| [a.min(b), a.max(b)]);
                halves.extend(edges.map(|edge| (edge, class_of[number])));
            }
        }
        halves.sort_unstable();
        let at_edge = || halves.chunk_by(|a, b| a.0 == b.0).map(|edge| edge.iter().map(|half| half.1));
        let mut patches = Sets::new(classes.len());
        for edge in at_edge() {
            let mut doubled = edge.flatten();
            if let Some(first) = doubled.next() {
                doubled.for_each(|other| patches.join(first, other));
            }
        }
        // For each patch: its classes, whether an edge has an odd number of other triangles, and whether an edge has
        // other triangles at all.
        let mut of_patch: BTreeMap<u32, (Vec<u32>, bool, bool)> = BTreeMap::new();
        for class in (0..).take(classes.len()) {
            of_patch.entry(patches.find(class)).or_default().0.push(class);
        }
        for edge in at_edge() {
            let others = edge.clone().filter(Option::is_none).count();
            if let Some(patch) = edge.flatten().next().and_then(|class| of_patch.get_mut(&patches.find(class))) {
                patch.1 |= others % 2 == 1;
                patch.2 |= others > 0;
            }
        }
        drop(halves);
        let part_of: Vec<u32> = class_of.iter().map(|class| u32::from(class.is_some())).collect();
        let mut others: Option<Enclosures<'_>> = None;
        for (of, is_odd, has_others) in of_patch.into_values() {
            let of: Vec<&Class> = of.iter().map(|class| &classes[*class as usize]).collect();
            let is_shared = of.iter().all(|class| class.is_shared);
            // A patch that touches nothing is a two-sided surface, unless it is inside a solid.
            let is_wall = if is_odd {
                false
            } else if has_others {
                if !is_shared {
                    continue;
                }
                true
            } else {
                let others = others.get_or_insert_with(|| {
                    let encloses = |triangle: u32| part_of[triangle as usize] == 0;
                    Enclosures::new(&mesh.vertices_m, &mesh.triangles, &part_of, encloses)
                });
                let triangles: Vec<u32> = of.iter().filter_map(|class| class.facing[0].first().copied()).collect();
                is_shared && others.around(1, &triangles).is_some_and(|around| !around.is_empty())
            };
            of.into_iter().for_each(|class| if is_wall { self.drop_wall(class) } else { self.drop_copies(class) });
        }
    }
}

/// Flips one diagonal of each two pairs of triangles that form a flat tetrahedron, so that they match. Returns the
/// number of flips.
pub(crate) fn match_diagonals(mesh: &mut TriangleMesh) -> usize {
    let topology = Topology::new(mesh.vertices_m.len(), &mesh.triangles);
    let sorted = |mut three: [u32; 3]| {
        three.sort_unstable();
        three
    };
    let mut known: Vec<([u32; 3], u32)> = mesh.triangles.iter().map(|of| sorted(*of)).zip(0..).collect();
    known.sort_unstable();
    let find =
        |three: [u32; 3]| known.binary_search_by(|(other, _)| other.cmp(&sorted(three))).ok().map(|at| known[at].1);
    let (mut is_done, mut flipped) = (vec![false; mesh.triangles.len()], 0);
    for edge in &topology.edges {
        let [a, c] = edge.vertices;
        let sides = topology.sides(edge);
        spend(1 + sides.len() * sides.len().min(COMPARED));
        let opposite = |triangle: u32| mesh.triangles[triangle as usize].into_iter().find(|v| *v != a && *v != c);
        let mut flips = None;
        for (first, second) in sides.iter().take(COMPARED).flat_map(|one| sides.iter().map(move |other| (one, other))) {
            let (first, second) = match (first.is_forward, second.is_forward) {
                (true, false) => (first.triangle, second.triangle),
                _ => continue,
            };
            let (Some(b), Some(d)) = (opposite(first), opposite(second)) else { continue };
            if b == d || is_done[first as usize] || is_done[second as usize] || !is_flat(mesh, [a, c, b, d]) {
                continue;
            }
            let others = [find([a, d, b]), find([c, d, b])];
            if let [Some(third), Some(fourth)] = others.map(|found| found.filter(|other| !is_done[*other as usize])) {
                flips = Some(([first, second, third, fourth], [b, d]));
                break;
            }
        }
        let Some((four, [b, d])) = flips else { continue };
        four.iter().for_each(|triangle| is_done[*triangle as usize] = true);
        let [first, second] = [four[0] as usize, four[1] as usize];
        if let Some(uv) = &mut mesh.uv {
            let corner = |triangle: usize, vertex: u32| {
                uv[triangle][mesh.triangles[triangle].iter().position(|other| *other == vertex).unwrap_or(0)]
            };
            let [ua, ub, uc, ud] = [corner(first, a), corner(first, b), corner(first, c), corner(second, d)];
            (uv[first], uv[second]) = ([ua, ud, ub], [ud, uc, ub]);
        }
        // Before, they were (a, c, b) and (c, a, d).
        (mesh.triangles[first], mesh.triangles[second]) = ([a, d, b], [d, c, b]);
        flipped += 1;
    }
    flipped
}

/// Returns whether the triangles (a, c, b) and (c, a, d) are coplanar and form a quadrilateral with the diagonals a–c
/// and b–d.
fn is_flat(mesh: &TriangleMesh, [a, c, b, d]: [u32; 4]) -> bool {
    let [a, b, c, d] = [a, b, c, d].map(|vertex| mesh.vertices_m[vertex as usize]);
    let edges = [c - a, b - a, d - a, b - c, d - c, d - b];
    let longest = edges.iter().map(|edge| edge.length_squared()).fold(0.0, f64::max).sqrt();
    let normal = (c - a).cross(b - a);
    let others = [(a - c).cross(d - c), (d - a).cross(b - a), (c - d).cross(b - d)];
    normal.dot(d - a).abs() <= FLAT * longest * longest * longest && others.iter().all(|other| normal.dot(*other) > 0.0)
}
