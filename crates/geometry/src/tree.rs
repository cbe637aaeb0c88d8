//! A bounding volume hierarchy of triangles: finds the triangles that overlap a box, and the nearest point to a given
//! point.

use std::ops::Range;

use glam::DVec3;

use crate::work::spend;

/// Maximum number of triangles in a leaf.
const LEAF: usize = 4;

#[derive(Debug, Clone, Copy, PartialEq)]
struct TreeNode {
    least: DVec3,
    most: DVec3,
    /// The triangles of the subtree, as a range of `order`.
    start: usize,
    end: usize,
    /// Index of the second child; the first child comes directly after its parent. `None` in a leaf.
    second: Option<usize>,
}

/// The tree. Its methods expect the vertices and triangles from which it was created, so that the owner of these can
/// store it too.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Tree {
    nodes: Vec<TreeNode>,
    order: Vec<u32>,
}

/// A point on a triangle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Nearest {
    pub(crate) triangle: u32,
    pub(crate) barycentric: [f64; 3],
    pub(crate) squared: f64,
}

/// Returns the positions of a triangle's vertices.
pub(crate) fn corners(vertices: &[DVec3], triangle: [u32; 3]) -> [DVec3; 3] {
    triangle.map(|vertex| vertices[vertex as usize])
}

impl Tree {
    /// Creates a tree of some triangles. All coordinates must be finite, and all indices in range.
    pub(crate) fn new(vertices: &[DVec3], triangles: &[[u32; 3]], of: impl Iterator<Item = u32>) -> Self {
        let mut tree = Self { nodes: Vec::new(), order: of.collect() };
        if tree.order.is_empty() {
            return tree;
        }
        // Ranges that have no node yet, with the parent if the node will be its second child.
        let mut waiting = vec![(0, tree.order.len(), None)];
        while let Some((start, end, parent)) = waiting.pop() {
            let number = tree.nodes.len();
            if let Some(parent) = parent {
                let parent: &mut TreeNode = &mut tree.nodes[parent];
                parent.second = Some(number);
            }
            let range = &mut tree.order[start..end];
            spend(range.len());
            let all = range.iter().flat_map(|triangle| corners(vertices, triangles[*triangle as usize]));
            let (least, most) = all.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(l, m), at| (l.min(at), m.max(at)));
            tree.nodes.push(TreeNode { least, most, start, end, second: None });
            if end - start > LEAF {
                let size = most - least;
                let axis = if size.x >= size.y && size.x >= size.z {
                    0
                } else if size.y >= size.z {
                    1
                } else {
                    2
                };
                let middle = |triangle: &u32| -> f64 {
                    corners(vertices, triangles[*triangle as usize]).iter().map(|at| at[axis]).sum()
                };
                let half = (end - start) / 2;
                range.select_nth_unstable_by(half, |a, b| middle(a).total_cmp(&middle(b)).then(a.cmp(b)));
                waiting.push((start + half, end, Some(number)));
                waiting.push((start, start + half, None));
            }
        }
        tree
    }

    /// Returns the number of nodes. Node 0 is the root, if there is any.
    pub(crate) fn len(&self) -> usize {
        self.nodes.len()
    }

    /// Returns the triangles in the order in which each node has a range of them.
    pub(crate) fn order(&self) -> &[u32] {
        &self.order
    }

    /// Returns the range of a node in the order of triangles.
    pub(crate) fn range(&self, node: usize) -> Range<usize> {
        self.nodes[node].start..self.nodes[node].end
    }

    /// Returns both halves of a node; `None` for a leaf.
    pub(crate) fn halves(&self, node: usize) -> Option<[usize; 2]> {
        self.nodes[node].second.map(|second| [node + 1, second])
    }

    /// Calls `found` for the triangles whose boxes overlap a box, until it returns false. Returns the number of
    /// visited boxes.
    pub(crate) fn overlapping(
        &self,
        (vertices, triangles): (&[DVec3], &[[u32; 3]]),
        [least, most]: [DVec3; 2],
        mut found: impl FnMut(u32) -> bool,
    ) -> u64 {
        let mut looked = 0;
        let mut waiting = if self.nodes.is_empty() { Vec::new() } else { vec![0] };
        while let Some(number) = waiting.pop() {
            let node: &TreeNode = &self.nodes[number];
            looked += 1;
            spend(1);
            if node.least.cmpgt(most).any() || node.most.cmplt(least).any() {
                continue;
            }
            if let Some(second) = node.second {
                waiting.push(second);
                waiting.push(number + 1);
                continue;
            }
            spend(node.end - node.start);
            for triangle in &self.order[node.start..node.end] {
                looked += 1;
                let at = corners(vertices, triangles[*triangle as usize]);
                let is_apart =
                    at[0].min(at[1]).min(at[2]).cmpgt(most).any() || at[0].max(at[1]).max(at[2]).cmplt(least).any();
                if !is_apart && !found(*triangle) {
                    return looked;
                }
            }
        }
        looked
    }

    /// Returns the nearest point. If several are equally near, returns the one on the triangle with the smallest
    /// index.
    pub(crate) fn nearest(&self, of: (&[DVec3], &[[u32; 3]]), point: DVec3) -> Option<Nearest> {
        let mut looks = u64::MAX;
        self.nearest_within(of, point, &mut looks)
    }

    /// Works as [`Self::nearest`], and finds the same, with fewer visits the nearer a triangle is that is known to be near.
    pub(crate) fn nearest_from(&self, of: (&[DVec3], &[[u32; 3]]), point: DVec3, near: u32) -> Option<Nearest> {
        self.improved(of, point, &mut { u64::MAX }, Some(nearest_on(of, point, near)))
    }

    /// Works as [`Self::nearest`], but once `looks` visits of boxes and triangles are used up, returns a point that
    /// is merely near. Finding the nearest of very many points at almost equal distance, as in the middle of a
    /// sphere, can require visiting each of them.
    pub(crate) fn nearest_within(&self, of: (&[DVec3], &[[u32; 3]]), point: DVec3, looks: &mut u64) -> Option<Nearest> {
        self.improved(of, point, looks, None)
    }

    /// Works as [`Self::nearest_within`], with the best point that is known before.
    fn improved(
        &self,
        of: (&[DVec3], &[[u32; 3]]),
        point: DVec3,
        looks: &mut u64,
        mut best: Option<Nearest>,
    ) -> Option<Nearest> {
        let distance = |node: &TreeNode| (point - point.clamp(node.least, node.most)).length_squared();
        let mut waiting = if self.nodes.is_empty() { Vec::new() } else { vec![0] };
        while let Some(number) = waiting.pop() {
            let node = &self.nodes[number];
            spend(1 + node.second.map_or(node.end - node.start, |_| 0));
            *looks = looks.saturating_sub(1);
            if best.is_some_and(|best| distance(node) > best.squared || *looks == 0) {
                continue;
            }
            if let Some(second) = node.second {
                let (near, far) = (number + 1, second);
                let is_swapped = distance(&self.nodes[far]) < distance(&self.nodes[near]);
                waiting.extend(if is_swapped { [near, far] } else { [far, near] });
                continue;
            }
            for triangle in &self.order[node.start..node.end] {
                let found = nearest_on(of, point, *triangle);
                let is_better = |best: Nearest| (found.squared, found.triangle) < (best.squared, best.triangle);
                if best.is_none_or(is_better) {
                    best = Some(found);
                }
            }
        }
        best
    }
}

/// Returns the nearest point of a triangle.
fn nearest_on((vertices, triangles): (&[DVec3], &[[u32; 3]]), point: DVec3, triangle: u32) -> Nearest {
    let at = corners(vertices, triangles[triangle as usize]);
    let barycentric = nearest_place(point, at);
    let place = at[0] * barycentric[0] + at[1] * barycentric[1] + at[2] * barycentric[2];
    Nearest { triangle, barycentric, squared: (point - place).length_squared() }
}

/// Returns the barycentric coordinates, for the corners a, b and c in this order, of the point of the triangle (a, b,
/// c) that is nearest to `point`, all in one unit. Each is from 0 to 1 and their sum is 1 (Ericson, Real-Time
/// Collision Detection, 5.1.5).
pub fn nearest_place(point: DVec3, [a, b, c]: [DVec3; 3]) -> [f64; 3] {
    let (ab, ac, ap) = (b - a, c - a, point - a);
    let (d1, d2) = (ab.dot(ap), ac.dot(ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return [1.0, 0.0, 0.0];
    }
    let bp = point - b;
    let (d3, d4) = (ab.dot(bp), ac.dot(bp));
    if d3 >= 0.0 && d4 <= d3 {
        return [0.0, 1.0, 0.0];
    }
    let vc = d1 * d4 - d3 * d2;
    if vc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 && d1 > d3 {
        let v = d1 / (d1 - d3);
        return [1.0 - v, v, 0.0];
    }
    let cp = point - c;
    let (d5, d6) = (ab.dot(cp), ac.dot(cp));
    if d6 >= 0.0 && d5 <= d6 {
        return [0.0, 0.0, 1.0];
    }
    let vb = d5 * d2 - d1 * d6;
    if vb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 && d2 > d6 {
        let w = d2 / (d2 - d6);
        return [1.0 - w, 0.0, w];
    }
    let va = d3 * d6 - d5 * d4;
    let (e1, e2) = (d4 - d3, d5 - d6);
    if va <= 0.0 && e1 >= 0.0 && e2 >= 0.0 && e1 + e2 > 0.0 {
        let w = e1 / (e1 + e2);
        return [0.0, 1.0 - w, w];
    }
    let sum = va + vb + vc;
    if sum > 0.0 { [va / sum, vb / sum, vc / sum] } else { [1.0, 0.0, 0.0] }
}

/// Returns whether two triangles without a common vertex intersect. Coplanar triangles don't count as intersecting.
pub(crate) fn cut(a: [DVec3; 3], b: [DVec3; 3]) -> bool {
    let edges = |t: [DVec3; 3]| [[t[0], t[1]], [t[1], t[2]], [t[2], t[0]]];
    edges(a).into_iter().any(|edge| pierces(edge, b)) || edges(b).into_iter().any(|edge| pierces(edge, a))
}

/// Whether a segment goes through a triangle (Möller and Trumbore, Fast, minimum storage ray/triangle intersection,
/// Journal of Graphics Tools 2(1), 1997, doi:10.1080/10867651.1997.10487468).
fn pierces([from, to]: [DVec3; 2], [a, b, c]: [DVec3; 3]) -> bool {
    let (way, ab, ac, at) = (to - from, b - a, c - a, from - a);
    let across = way.cross(ac);
    let determinant = ab.dot(across);
    let scale = ab.length() * ac.length() * way.length();
    // Nearly parallel, or the triangle has no area.
    if determinant.abs() <= 1e-12 * scale {
        return false;
    }
    let u = at.dot(across) / determinant;
    let turned = at.cross(ab);
    let v = way.dot(turned) / determinant;
    let t = ac.dot(turned) / determinant;
    u >= 0.0 && v >= 0.0 && u + v <= 1.0 && (0.0..=1.0).contains(&t)
}
