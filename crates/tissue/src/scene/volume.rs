//! The section `[volume]` of a scene on a mesh: the volume that a closed mesh encloses, and how it grows as
//! vertices move.
//!
//! With V0 the volume at rest and a_i = ∂V/∂x_i there (a third of the area vectors of the triangles around
//! vertex i), the volume grows by ΔV = Σ a_i·u_i to first order, and the pressure p = −κ·ΔV/V0 pushes vertex i
//! by p·a_i. So the pressure is one spring that all vertices share: its energy is ½κ·ΔV²/V0, its stiffness
//! κ·a·aᵀ/V0, and its forces sum up to zero.

use glam::DVec3;

use palpate_refusal::{Reason, Refusal, Result};

/// The volume that a closed mesh encloses, at rest. [`Mesh::enclosing`](super::Mesh::enclosing) computes it.
#[derive(Debug, Clone, PartialEq)]
pub struct Volume {
    /// V0 = |Σ x_a·(x_b × x_c)/6| over the triangles, m³; above 0.
    pub volume_m3: f64,
    /// a = ∂V/∂x of each vertex at rest, m², by vertex number: a third of the area vectors of its triangles,
    /// outward; 0 for a vertex without triangles.
    pub areas_m2: Vec<DVec3>,
    /// The vibration in which the volume swells, which bounds the volume's part of the stiffness.
    pub swelling: Swelling,
}

/// The vibration in which the volume swells and shrinks: all vertices move along a/√m. Contains its stiffness
/// by pressure and by springs. The reference k and mass are those of the mesh.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Swelling {
    /// σ = Σ a²/m over V0, in reference masses, m. Times κ, Pa, it is the vibration's stiffness by the pressure
    /// alone, N/m.
    pub by_pressure_m: f64,
    /// s: the vibration's stiffness by the springs, divided by the reference k; without unit.
    pub by_springs: f64,
    /// j: how strongly the springs couple this vibration to others, divided by the reference k; without unit,
    /// at least 0.
    pub passed_on: f64,
}

impl Swelling {
    /// Returns an upper bound of the largest eigenvalue of pressure and springs together, with the reference
    /// masses, N/m. `pressure_pa` is κ, Pa; `stiffness_n_per_m` is the reference k, N/m; `springs` bounds the
    /// eigenvalue of the springs alone, divided by the reference k.
    ///
    /// The bound is ½(p + q) + √(¼(p − q)² + r²), the larger eigenvalue of [[p, r], [r, q]], with p = κ·σ + k·s
    /// the stiffness of the vibration itself ([`Swelling::by_pressure_m`], [`Swelling::by_springs`]), q the
    /// bound of the springs, and r = k·j ([`Swelling::passed_on`]).
    ///
    /// Proof: let v be the unit vector of the vibration. Any other unit vector is c·v + s·w with w
    /// perpendicular to v, and the springs' quadratic form is at most that of their Laplacian L. So the
    /// eigenvalue is at most that of the matrix with κ·σ + vᵀLv and the bound of L on the diagonal, coupled by
    /// the length of the part of L·v perpendicular to v.
    pub fn bound_n_per_m(&self, pressure_pa: f64, springs: f64, stiffness_n_per_m: f64) -> f64 {
        let own = pressure_pa * self.by_pressure_m + stiffness_n_per_m * self.by_springs;
        let (other, joined) = (stiffness_n_per_m * springs, stiffness_n_per_m * self.passed_on);
        let half = 0.5 * (own - other);
        0.5 * (own + other) + (half * half + joined * joined).sqrt()
    }
}

/// A mesh counts as flat if its volume is less than this part of the volume of a ball with the same area.
const FLAT: f64 = 1e-4;

impl Volume {
    /// Message of the refusal of a volume on a sheet ([`Reason::WrongKind`]).
    pub const OF_A_MESH: &str = "is for a closed mesh: a sheet encloses nothing";

    /// Message of the refusal of a volume stiffness above 0 for a tissue without `[volume]`
    /// ([`Reason::WrongKind`]).
    pub const FROM_THE_BEGINNING: &str = "is for scenes that have [volume] from the beginning";

    /// Returns the volume that the triangles of a mesh enclose.
    ///
    /// # Errors
    /// Refuses a mesh with a hole, with triangles of inconsistent orientation, of several parts, and a flat
    /// mesh.
    pub(super) fn of(vertices_m: &[DVec3], triangles: &[[u32; 3]]) -> Result<Self> {
        let refuse = |what: &str| {
            let message = format!(
                "needs a closed mesh, of one part: {what} (`palpate mesh FILE` shows more, --repair may mend it)"
            );
            Err(Refusal::new(Reason::WrongKind, "volume", message))
        };
        let at =
            |[a, b]: [u32; 2]| format!("at the edge between vertices {a} and {b}, {:.4} m", vertices_m[a as usize]);
        let sides = || triangles.iter().flat_map(|[a, b, c]| [[*a, *b], [*b, *c], [*c, *a]]);
        // Each edge, and whether a triangle follows it from its lower vertex: of its two triangles, one should
        // and one should not.
        let mut ways: Vec<([u32; 2], bool)> = sides().map(|[a, b]| ([a.min(b), a.max(b)], a < b)).collect();
        ways.sort_unstable();
        for of_edge in ways.chunk_by(|a, b| a.0 == b.0) {
            match of_edge {
                [(_, false), (_, true)] => {}
                [(edge, _)] => return refuse(&format!("it has a hole {}", at(*edge))),
                more => return refuse(&format!("triangles do not agree on what is outside {}", at(more[0].0))),
            }
        }
        // The vertices that triangles join, as trees of a union-find.
        #[allow(clippy::cast_possible_truncation)]
        let mut above: Vec<u32> = (0..vertices_m.len() as u32).collect();
        let root = |above: &mut Vec<u32>, mut vertex: u32| {
            while above[vertex as usize] != vertex {
                above[vertex as usize] = above[above[vertex as usize] as usize];
                vertex = above[vertex as usize];
            }
            vertex
        };
        for [a, b] in sides() {
            let [a, b] = [root(&mut above, a), root(&mut above, b)];
            above[a.max(b) as usize] = a.min(b);
        }
        let first = triangles.first().map(|triangle| root(&mut above, triangle[0]));
        if let Some(triangle) = triangles.iter().find(|triangle| Some(root(&mut above, triangle[0])) != first) {
            let place_m = vertices_m[triangle[0] as usize];
            return refuse(&format!("it has several parts, another one at {place_m:.4} m"));
        }
        let (mut volume_m3, mut whole_m2) = (0.0, 0.0);
        let mut areas_m2 = vec![DVec3::ZERO; vertices_m.len()];
        // Relative to an origin nearby, small numbers keep their digits.
        let origin_m = vertices_m.first().copied().unwrap_or_default();
        for triangle in triangles {
            let [a, b, c] = triangle.map(|vertex| vertices_m[vertex as usize] - origin_m);
            let area = 0.5 * (b - a).cross(c - a);
            volume_m3 += a.dot(b.cross(c)) / 6.0;
            whole_m2 += area.length();
            triangle.iter().for_each(|vertex| areas_m2[*vertex as usize] += area / 3.0);
        }
        let ball_m3 = whole_m2 * (whole_m2 / (36.0 * std::f64::consts::PI)).sqrt();
        // Or if the volume is not finite.
        let is_flat = volume_m3.abs() <= FLAT * ball_m3 || !(volume_m3 * ball_m3).is_finite();
        if is_flat {
            return refuse("it encloses nothing");
        }
        if volume_m3 < 0.0 {
            areas_m2.iter_mut().for_each(|area| *area = -*area);
        }
        Ok(Volume { volume_m3: volume_m3.abs(), areas_m2, swelling: Swelling::default() })
    }

    /// Fills in what bounds the volume's stiffness. `springs` has each spring's ends and its k divided by the
    /// reference k; `mass` gives a vertex's mass divided by the reference mass.
    pub(super) fn among(mut self, springs: impl Iterator<Item = ([u32; 2], f64)>, mass: impl Fn(usize) -> f64) -> Self {
        let along = |vertex: usize| self.areas_m2[vertex] / mass(vertex);
        let square: f64 = self.areas_m2.iter().enumerate().map(|(vertex, area)| area.dot(along(vertex))).sum();
        // L·v times √m, and v·L·v.
        let mut pulled = vec![DVec3::ZERO; self.areas_m2.len()];
        for (ends, k) in springs {
            let [a, b] = ends.map(|end| end as usize);
            let pull = k * (along(a) - along(b));
            pulled[a] += pull;
            pulled[b] -= pull;
        }
        let by_springs = pulled.iter().enumerate().map(|(vertex, pull)| pull.dot(along(vertex))).sum::<f64>() / square;
        let whole =
            pulled.iter().enumerate().map(|(vertex, pull)| pull.length_squared() / mass(vertex)).sum::<f64>() / square;
        self.swelling = Swelling {
            by_pressure_m: square / self.volume_m3,
            by_springs,
            passed_on: (whole - by_springs * by_springs).max(0.0).sqrt(),
        };
        self
    }

    /// Returns a volume for some of the vertices, turned, that swells as fast as the whole. `mass` gives a
    /// vertex's mass divided by the reference mass. `None` if they have no area.
    pub(super) fn part(&self, areas_m2: Vec<DVec3>, mass: impl Fn(usize) -> f64) -> Option<Self> {
        let square: f64 = areas_m2.iter().enumerate().map(|(vertex, area)| area.length_squared() / mass(vertex)).sum();
        let volume_m3 = square / self.swelling.by_pressure_m;
        (volume_m3 > 0.0).then_some(Volume { volume_m3, areas_m2, swelling: self.swelling })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// A box with two triangles a side.
    fn cuboid(sides_m: DVec3) -> (Vec<DVec3>, Vec<[u32; 3]>) {
        let corner = |n: u32| DVec3::new(f64::from(n & 1), f64::from(n >> 1 & 1), f64::from(n >> 2)) * sides_m;
        let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles = faces.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
        ((0..8).map(corner).collect(), triangles)
    }

    #[test]
    fn a_box_encloses_its_sides_and_its_areas_are_the_slope_of_that() {
        let (mut vertices_m, mut triangles) = cuboid(DVec3::new(0.2, 0.3, 0.5));
        vertices_m.iter_mut().for_each(|place_m| *place_m += DVec3::new(3.0, -2.0, 5.0));
        let found = Volume::of(&vertices_m, &triangles).unwrap();
        assert!((found.volume_m3 - 0.03).abs() < 1e-15, "{found:?}");
        assert!(found.areas_m2.iter().sum::<DVec3>().length() < 1e-15);
        for vertex in 0..8 {
            for axis in [DVec3::X, DVec3::Y, DVec3::Z] {
                let grown = |by_m: f64| {
                    let mut moved_m = vertices_m.clone();
                    moved_m[vertex] += by_m * axis;
                    Volume::of(&moved_m, &triangles).unwrap().volume_m3
                };
                let slope = (grown(1e-4) - grown(-1e-4)) / 2e-4;
                assert!((found.areas_m2[vertex].dot(axis) - slope).abs() < 1e-10, "{vertex}: {slope}");
            }
        }
        // Inside out it is the same.
        triangles.iter_mut().for_each(|triangle| triangle.swap(0, 1));
        let turned = Volume::of(&vertices_m, &triangles).unwrap();
        assert!((turned.volume_m3 - 0.03).abs() < 1e-15);
        assert!(turned.areas_m2.iter().zip(&found.areas_m2).all(|(a, b)| a.distance(*b) < 1e-15));
    }

    #[test]
    fn what_is_open_flat_in_parts_or_not_agreed_is_refused() {
        let (vertices_m, triangles) = cuboid(DVec3::ONE);
        let refused = |vertices_m: &[DVec3], triangles: &[[u32; 3]], words: &str| {
            let refusal = Volume::of(vertices_m, triangles).unwrap_err();
            assert!(refusal.message.contains(words) && refusal.message.contains("palpate mesh"), "{refusal}");
            assert_eq!((refusal.reason, refusal.field.as_str()), (Reason::WrongKind, "volume"));
        };
        refused(&vertices_m, &triangles[1..], "it has a hole at the edge between vertices");
        let mut turned = triangles.clone();
        turned[5].swap(0, 1);
        refused(&vertices_m, &turned, "do not agree on what is outside at the edge");
        let both: Vec<DVec3> =
            vertices_m.iter().copied().chain(vertices_m.iter().map(|m| *m + 2.0 * DVec3::X)).collect();
        let shifted: Vec<[u32; 3]> = triangles.iter().map(|triangle| triangle.map(|vertex| vertex + 8)).collect();
        refused(&both, &[triangles.clone(), shifted].concat(), "several parts, another one at");
        let (flat_m, _) = cuboid(DVec3::new(1.0, 1.0, 1e-6));
        refused(&flat_m, &triangles, "encloses nothing");
    }

    #[test]
    fn no_vibration_of_springs_and_pressure_is_faster_than_the_bound() {
        let (vertices_m, triangles) = cuboid(DVec3::new(1.0, 2.0, 1.5));
        let mut ends: Vec<[u32; 2]> =
            triangles.iter().flat_map(|[a, b, c]| [[*a, *b], [*b, *c], [*c, *a]]).filter(|[a, b]| a < b).collect();
        ends.sort_unstable();
        let masses = [1.0, 0.5, 2.0, 1.5, 0.7, 1.0, 1.2, 3.0];
        let springs = || ends.iter().enumerate().map(|(at, ends)| (*ends, 1.0 + 0.2 * at as f64));
        let found = Volume::of(&vertices_m, &triangles).unwrap().among(springs(), |vertex| masses[vertex]);
        // The springs' Laplacian and the pressure, each over √m of both ends: the largest eigenvalue by powers.
        let largest = |k: f64, pressure_pa: f64| {
            let mut x: Vec<DVec3> = (0..8).map(|n| DVec3::new(1.0, 0.3 * f64::from(n), 0.7)).collect();
            let mut value = 0.0;
            for _ in 0..3000 {
                let scaled: Vec<DVec3> = x.iter().zip(masses).map(|(x, m)| *x / m.sqrt()).collect();
                let grown: f64 = scaled.iter().zip(&found.areas_m2).map(|(x, a)| x.dot(*a)).sum();
                let mut y: Vec<DVec3> =
                    found.areas_m2.iter().map(|a| *a * (pressure_pa * grown / found.volume_m3)).collect();
                for ([a, b], part) in springs() {
                    let pull = k * part * (scaled[a as usize] - scaled[b as usize]);
                    y[a as usize] += pull;
                    y[b as usize] -= pull;
                }
                y.iter_mut().zip(masses).for_each(|(y, m)| *y /= m.sqrt());
                value = y.iter().map(|y| y.length_squared()).sum::<f64>().sqrt();
                x = y.into_iter().map(|y| y / value).collect();
            }
            value
        };
        let springs_alone = largest(1.0, 0.0);
        for pressure_pa in [0.0, 0.1, 1.0, 3.0, 30.0, 1000.0] {
            let (truth, bound) =
                (largest(1.0, pressure_pa), found.swelling.bound_n_per_m(pressure_pa, springs_alone, 1.0));
            assert!(truth <= bound * (1.0 + 1e-9) && bound < 1.6 * truth, "{pressure_pa}: {truth} {bound}");
        }
        let (truth, bound) = (largest(0.0, 2.0), found.swelling.bound_n_per_m(2.0, springs_alone, 0.0));
        assert!((truth / bound - 1.0).abs() < 1e-9, "{truth} {bound}");
    }
}
