//! Finds which closed parts of a surface enclose a part.

use std::collections::BTreeMap;

use glam::DVec3;

use crate::tree::{Tree, corners};

/// Number of test points of a part.
const PLACES: usize = 16;

/// Barycentric position of the test point on a triangle: not where meshes of boxes have edges.
const AT: [f64; 3] = [0.437, 0.342, 0.221];

/// Limit on the boxes and triangles searched in total: a constant, plus a number per triangle.
const LOOKS: [u64; 2] = [1_000_000, 60];

/// Distance from an edge or to the first triangle, as a fraction of the triangle's size, below which a ray is
/// unreliable.
const UNSURE: f64 = 1e-9;

/// The closed parts of a surface, for queries of what encloses a part.
pub(crate) struct Enclosures<'m> {
    vertices: &'m [DVec3],
    triangles: &'m [[u32; 3]],
    part_of: &'m [u32],
    tree: Tree,
    /// The largest x, at which rays end.
    end: f64,
    looks_left: u64,
}

impl<'m> Enclosures<'m> {
    /// Creates the search over the triangles that `encloses` accepts; a part is a number of `part_of`. Coordinates
    /// must be finite, indices in range.
    pub(crate) fn new(
        vertices: &'m [DVec3],
        triangles: &'m [[u32; 3]],
        part_of: &'m [u32],
        encloses: impl Fn(u32) -> bool,
    ) -> Self {
        let of: Vec<u32> = (0..).take(triangles.len()).filter(|triangle| encloses(*triangle)).collect();
        let looks_left = LOOKS[0] + LOOKS[1] * of.len() as u64;
        let tree = Tree::new(vertices, triangles, of.into_iter());
        let end = vertices.iter().map(|at| at.x).fold(f64::NEG_INFINITY, f64::max);
        Self { vertices, triangles, part_of, tree, end, looks_left }
    }

    /// Returns the parts that enclose a part, ascending: those around all of its test points. Empty if no test is
    /// reliable, as for two parts at one place. `None` after too much work.
    pub(crate) fn around(&mut self, own: u32, triangles_of_part: &[u32]) -> Option<Vec<u32>> {
        let mut found: Option<Vec<u32>> = None;
        let step = triangles_of_part.len().div_ceil(PLACES).max(1);
        for triangle in triangles_of_part.iter().step_by(step) {
            if self.looks_left == 0 {
                return None;
            }
            let at = corners(self.vertices, self.triangles[*triangle as usize]);
            let place = AT[0] * at[0] + AT[1] * at[1] + AT[2] * at[2];
            let Some(around) = self.around_place(place, own) else { continue };
            let both = found.map_or_else(
                || around.clone(),
                |found| found.into_iter().filter(|part| around.binary_search(part).is_ok()).collect(),
            );
            if both.is_empty() {
                return Some(both);
            }
            found = Some(both);
        }
        Some(found.unwrap_or_default())
    }

    /// Returns the parts around a place, except `own`: those that a ray from there crosses an odd number of times.
    /// `None` if it passes an edge or starts on a triangle.
    fn around_place(&mut self, from: DVec3, own: u32) -> Option<Vec<u32>> {
        let (mut crossed, mut is_sure, mut looked) = (BTreeMap::new(), true, 0);
        let (vertices, triangles, part_of) = (self.vertices, self.triangles, self.part_of);
        let to = DVec3::new(self.end.max(from.x), from.y, from.z);
        let boxes = self.tree.overlapping((vertices, triangles), [from, to], |triangle| {
            looked += 1;
            let part = part_of[triangle as usize];
            if part != own {
                match is_crossed(from, corners(vertices, triangles[triangle as usize])) {
                    Some(true) => *crossed.entry(part).or_insert(false) ^= true,
                    Some(false) => {}
                    None => is_sure = false,
                }
            }
            is_sure
        });
        self.looks_left = self.looks_left.saturating_sub(boxes + looked);
        is_sure.then(|| crossed.into_iter().filter(|(_, is_odd)| *is_odd).map(|(part, _)| part).collect())
    }
}

/// Returns whether a ray along x crosses a triangle; `None` if it is near its edge or starts on it.
fn is_crossed(from: DVec3, triangle: [DVec3; 3]) -> Option<bool> {
    let [a, b, c] = triangle.map(|at| at - from);
    let double = |u: DVec3, v: DVec3| u.y * v.z - u.z * v.y;
    let weights = [double(b, c), double(c, a), double(a, b)];
    let whole: f64 = weights.iter().sum();
    let longest = (b - a).length_squared().max((c - b).length_squared()).max((a - c).length_squared());
    // The triangle lies along the ray: its neighbours decide.
    if whole.abs() <= 1e-12 * longest {
        return Some(false);
    }
    let weights = weights.map(|weight| weight / whole);
    let least = weights.iter().copied().fold(f64::INFINITY, f64::min);
    if least < -UNSURE {
        return Some(false);
    }
    let x = weights[0] * a.x + weights[1] * b.x + weights[2] * c.x;
    let is_unsure = least <= UNSURE || x.abs() <= UNSURE * longest.sqrt();
    if is_unsure { None } else { Some(x > 0.0) }
}
