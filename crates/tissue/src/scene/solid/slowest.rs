//! The slowest vibration of a solid: how stiffly the whole of it comes back to rest.
//!
//! It is found by Rayleigh's quotient on a lattice of at most [`MIXED_CELLS`] cubes, in each of which several cubes of the
//! solid are mixed. The shapes looked at are how the solid gives way to its own weight along each axis, and what inverse
//! iteration makes of the slowest of them. Cubes are as in the kernel (`body::solid`), linearised at rest.

use std::sync::{Arc, OnceLock};

use glam::DVec3;

use super::shape::{CORNERS, SolidShape};
use crate::shape::{PointId, RestShape};

/// Cubes of the lattice on which the vibration is looked for.
const MIXED_CELLS: usize = 2000;

/// Inverse iterations after the first shapes.
const ITERATIONS: usize = 2;

/// Iterations of a solution by conjugate gradients, and the part of the force that may be left.
const MAX_ITERATIONS: usize = 300;
const LEFT: f64 = 1e-3;

/// A value below which nothing holds the solid.
const NONE: f64 = 1e-12;

/// The slowest vibration of a solid, computed when it is first asked for. Two are equal whether it is known or not: it
/// follows from the rest of the solid.
#[derive(Debug, Clone, Default)]
pub(super) struct SlowestVibration(Arc<OnceLock<f64>>);

impl PartialEq for SlowestVibration {
    fn eq(&self, _other: &Self) -> bool {
        true
    }
}

impl SlowestVibration {
    /// Returns ρ·a²·ω²/E of the slowest vibration ω of a solid, the same solid each time, whose cubes have the edge a; 0 if
    /// nothing holds the solid. `weights` is the stiffness of each cube relative to that of a full one; `lame` is μ/E and
    /// λ/E; `beds` the stiffness of the foundation of a point divided by E·a.
    pub(super) fn of(&self, shape: &SolidShape, weights: &[f64], lame: [f64; 2], beds: impl Fn(PointId) -> f64) -> f64 {
        *self.0.get_or_init(|| MixedCells::of(shape, weights, lame, beds).slowest())
    }
}

/// A lattice of larger cubes. Lengths are in its edges, stiffnesses in E times an edge, masses in those of a full cube.
struct MixedCells {
    /// Edges of a cube, in those of the solid.
    by: usize,
    cells: Vec<MixedCell>,
    /// The mass of each corner; 0 where there is none.
    masses: Vec<f64>,
    /// The stiffness of each corner if the others are held; infinite where it is fixed or there is none.
    alone: Vec<f64>,
    /// The stiffness of the foundation of each corner.
    beds: Vec<f64>,
    shear: f64,
    lame: f64,
}

struct MixedCell {
    corners: [usize; 8],
    weight: f64,
}

/// The signs of a corner along each axis.
fn signs(corner: usize) -> [f64; 3] {
    CORNERS[corner].map(|at| if at == 1 { 1.0 } else { -1.0 })
}

impl MixedCells {
    #[allow(clippy::cast_precision_loss)]
    fn of(shape: &SolidShape, weights: &[f64], [shear, lame]: [f64; 2], beds: impl Fn(PointId) -> f64) -> Self {
        let parts = shape.mass_parts();
        let inside = weights.iter().filter(|weight| **weight > 0.0).count();
        let mut by = 1;
        while inside > MIXED_CELLS * by * by * by {
            by += 1;
        }
        let cells = shape.lattice().cells.map(|cells| cells.div_ceil(by));
        let index = |[i, j, k]: [usize; 3]| (k * cells[1] + j) * cells[0] + i;
        let mut mixed = vec![[0.0; 2]; cells.iter().product()];
        let full = 1.0 / (by * by * by) as f64;
        for (at, cell) in shape.cells().enumerate() {
            let [weight, part] = &mut mixed[index(cell.map(|at| at / by))];
            *weight += full * weights[at];
            *part += full * parts[at];
        }
        let corners = cells.map(|cells| cells + 1);
        let corner = |[i, j, k]: [usize; 3]| (k * corners[1] + j) * corners[0] + i;
        let count = corners.iter().product();
        let none = || vec![0.0; count];
        let mut found = MixedCells { by, cells: Vec::new(), masses: none(), alone: none(), beds: none(), shear, lame };
        for (at, [weight, part]) in mixed.into_iter().enumerate().filter(|(_, [weight, _])| *weight > 0.0) {
            let [i, j, k] = [at % cells[0], at / cells[0] % cells[1], at / cells[0] / cells[1]];
            let corners = CORNERS.map(|[x, y, z]| corner([i + x, j + y, k + z]));
            for corner in corners {
                found.masses[corner] += 0.125 * part;
                found.alone[corner] += weight * (lame + 19.0 / 3.0 * shear) / 16.0;
            }
            found.cells.push(MixedCell { corners, weight });
        }
        for point in crate::shape::points(shape) {
            let at = shape.corner_at(shape.corner_of(point));
            let nearest = corner(at.map(|at| (at + (by - 1) / 2) / by));
            let bed = beds(point) / by as f64;
            found.beds[nearest] += bed;
            found.alone[nearest] += if shape.is_fixed(point) { f64::INFINITY } else { bed };
        }
        for (alone, mass) in found.alone.iter_mut().zip(&found.masses) {
            if *mass == 0.0 {
                *alone = f64::INFINITY;
            }
        }
        found
    }

    /// Returns ρ·a²·ω²/E, with the edge a of the solid's cubes.
    #[allow(clippy::cast_precision_loss)]
    fn slowest(&self) -> f64 {
        let moves = |axis: DVec3| vec![axis; self.masses.len()];
        let shapes = DVec3::AXES.map(|axis| self.solved(&self.weighed(&moves(axis))));
        let slowest = shapes.into_iter().min_by(|a, b| self.quotient(a).total_cmp(&self.quotient(b)));
        let mut shape = slowest.unwrap_or_default();
        for _ in 0..ITERATIONS {
            shape = self.solved(&self.weighed(&shape));
        }
        let quotient = self.quotient(&shape) / (self.by * self.by) as f64;
        if quotient > NONE { quotient } else { 0.0 }
    }

    /// Returns M·x.
    fn weighed(&self, x: &[DVec3]) -> Vec<DVec3> {
        x.iter().zip(&self.masses).map(|(x, mass)| *mass * *x).collect()
    }

    /// Returns x·K·x / x·M·x; infinite for a shape without movement.
    fn quotient(&self, x: &[DVec3]) -> f64 {
        let (mut stiffness, mut mass) = (0.0, 0.0);
        for ((x, k), m) in x.iter().zip(self.times(x)).zip(&self.masses) {
            stiffness += x.dot(k);
            mass += m * x.length_squared();
        }
        if mass > 0.0 { stiffness / mass } else { f64::INFINITY }
    }

    /// Returns K·x, 0 at corners that do not move.
    fn times(&self, x: &[DVec3]) -> Vec<DVec3> {
        let mut product = vec![DVec3::ZERO; x.len()];
        let (shear, lame) = (self.shear, self.lame);
        for MixedCell { corners, weight } in &self.cells {
            // The derivative along each axis, and the four other ways in which eight corners move.
            let (mut along, mut others) = ([DVec3::ZERO; 3], [DVec3::ZERO; 4]);
            for (corner, point) in corners.iter().enumerate() {
                let ([x_sign, y_sign, z_sign], u) = (signs(corner), 0.25 * x[*point]);
                along[0] += x_sign * u;
                along[1] += y_sign * u;
                along[2] += z_sign * u;
                others[0] += y_sign * z_sign * u;
                others[1] += x_sign * z_sign * u;
                others[2] += x_sign * y_sign * u;
                others[3] += x_sign * y_sign * z_sign * u;
            }
            let growth = along[0].x + along[1].y + along[2].z;
            let stress: [DVec3; 3] = std::array::from_fn(|axis| {
                let turned = DVec3::new(along[0][axis], along[1][axis], along[2][axis]);
                lame * growth * DVec3::AXES[axis] + shear * (along[axis] + turned)
            });
            let parts: [f64; 4] = [2.0, 2.0, 2.0, 1.0];
            let others: [DVec3; 4] = std::array::from_fn(|way| parts[way] / 3.0 * shear * others[way]);
            for (corner, point) in corners.iter().enumerate() {
                let [x, y, z] = signs(corner);
                let of_stress = x * stress[0] + y * stress[1] + z * stress[2];
                let of_others = y * z * others[0] + x * z * others[1] + x * y * others[2] + x * y * z * others[3];
                product[*point] += 0.25 * weight * (of_stress + of_others);
            }
        }
        for ((product, x), bed) in product.iter_mut().zip(x).zip(&self.beds) {
            *product += *bed * *x;
        }
        self.held(&mut product);
        product
    }

    fn held(&self, x: &mut [DVec3]) {
        x.iter_mut().zip(&self.alone).filter(|(_, alone)| alone.is_infinite()).for_each(|(x, _)| *x = DVec3::ZERO);
    }

    /// Returns x with K·x = `force`, by conjugate gradients.
    fn solved(&self, force: &[DVec3]) -> Vec<DVec3> {
        let dot = |a: &[DVec3], b: &[DVec3]| a.iter().zip(b).map(|(a, b)| a.dot(*b)).sum::<f64>();
        let mut left = force.to_vec();
        self.held(&mut left);
        let eased = |left: &[DVec3]| left.iter().zip(&self.alone).map(|(left, alone)| *left / *alone).collect();
        let mut x = vec![DVec3::ZERO; force.len()];
        let mut step: Vec<DVec3> = eased(&left);
        let mut size = dot(&left, &step);
        let enough = LEFT * LEFT * size;
        for _ in 0..MAX_ITERATIONS {
            if size <= enough {
                break;
            }
            let product = self.times(&step);
            let far = size / dot(&step, &product);
            for (at, product) in product.iter().enumerate() {
                x[at] += far * step[at];
                left[at] -= far * *product;
            }
            let eased: Vec<DVec3> = eased(&left);
            let before = std::mem::replace(&mut size, dot(&left, &eased));
            for (step, eased) in step.iter_mut().zip(eased) {
                *step = eased + size / before * *step;
            }
        }
        x
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::{CellSize, FixedPart, Solid, SolidMaterial};
    use super::*;
    use crate::scene::body::BodyKind;
    use crate::scene::springs::Springs;

    /// A box on a fixed lower face.
    fn standing(size_m: DVec3, edge_m: f64, poissons_ratio: f64) -> Solid {
        let corners = CORNERS.map(|at| DVec3::from_array(at.map(|at| at as f64)) * size_m);
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles = quads.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
        let mesh = palpate_geometry::TriangleMesh { vertices_m: corners.to_vec(), triangles, ..Default::default() };
        let fixed = [FixedPart::plane(DVec3::ZERO, DVec3::Z, 0.0).unwrap()];
        let material = SolidMaterial { poissons_ratio, ..SolidMaterial::usual() };
        Solid::of(mesh, CellSize::Edge(edge_m), &fixed, material).unwrap()
    }

    fn slowest_per_s(solid: &Solid) -> f64 {
        let springs = Springs::alike(solid.stiffness_n_per_m());
        (solid.restoring_n_per_m(&springs, 0.0) / solid.point_mass_kg()).sqrt()
    }

    #[test]
    fn a_wide_block_shears_and_a_slender_one_bends_as_slowly_as_theory_says() {
        let SolidMaterial { youngs_modulus_pa: e, density_kg_per_m3: rho, .. } = SolidMaterial::usual();
        // Shear of a layer, ω = (π/2H)·√(μ/ρ); a block four times as wide as high is slower by a little.
        let wide = slowest_per_s(&standing(DVec3::new(0.12, 0.12, 0.03), 0.003, 0.45));
        let layer = std::f64::consts::FRAC_PI_2 / 0.03 * (e / 2.9 / rho).sqrt();
        assert!((0.88..1.0).contains(&(wide / layer)), "{wide} {layer}");
        // Bending of a beam that is clamped at one end, ω = 3.516·√(E·I/(ρ·A))/L²; shear makes it slower by 2 %.
        let slender = slowest_per_s(&standing(DVec3::new(0.01, 0.012, 0.12), 0.0025, 0.3));
        let beam = 3.516 * (e * 0.01 * 0.01 / 12.0 / rho).sqrt() / (0.12 * 0.12);
        assert!((0.93..1.02).contains(&(slender / beam)), "{slender} {beam}");
    }

    #[test]
    fn larger_cubes_find_nearly_the_same() {
        let [fine, coarse] = [0.002, 0.004].map(|edge_m| standing(DVec3::new(0.06, 0.05, 0.04), edge_m, 0.49));
        let [fine, coarse] = [fine, coarse].map(|solid| slowest_per_s(&solid));
        assert!((0.95..1.05).contains(&(fine / coarse)), "{fine} {coarse}");
    }
}
