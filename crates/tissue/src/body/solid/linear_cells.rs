//! The cubes of a part of a solid, linearised at given displacements: what a slow press needs (`response::tangent`).
//!
//! With C = 16 cof F, 16 P = 4μ·h + q·C + 16μ·I, and so d(16 P) = 4μ·dh + dq·C + q·dC with dq = (λ + μ)·(C : dh)/64. The
//! reduction of the pressure ([`neo_hookean`](super::neo_hookean)) is left out of the derivative, not of the force: Newton's method finds
//! the same place, in a step more.
#![allow(clippy::needless_range_loop)]

use std::cell::RefCell;

use glam::{DMat3, DVec3};

use super::corner_copies::{CornerCopies, corners_of};
use super::neo_hookean::{Invariants, NeoHookean, Patterns, Stress};
use super::places::SolidPlaces;
use crate::kernel::lanes::{self, Scalar, SingleWork};

type One = Scalar<f64>;

/// A corner that is not in the part: it is held at rest.
const BEYOND: u32 = u32::MAX;

/// A cube of the part.
#[derive(Debug, Clone)]
struct LinearCell {
    /// The index of each corner among the points of the part.
    points: [u32; 8],
    weight: f64,
    /// C and h at the present displacements, and q in E.
    cofactor: [[f64; 3]; 3],
    h: [[f64; 3]; 3],
    q: f64,
    /// The force on each corner, N.
    forces_n: [DVec3; 8],
}

/// The cubes of a part of a solid. Vectors are in directions turned by a rotation.
#[derive(Debug)]
pub(crate) struct LinearCells {
    cells: Vec<LinearCell>,
    turn: DMat3,
    edge_m: f64,
    /// E·a, N/m; and μ/E and λ/E.
    stiffness_n_per_m: f64,
    shear: f64,
    lame: f64,
}

/// Returns the patterns of a cube. (A loop: the compiler does not inline `map` of an array into code for other processors.)
#[inline(always)]
fn patterns_of(corners: &[DVec3; 8]) -> Patterns<One> {
    let mut values = [[Scalar(0.0); 3]; 8];
    for corner in 0..8 {
        for c in 0..3 {
            values[corner][c] = Scalar(corners[corner][c]);
        }
    }
    Patterns::of_corners(&values)
}

/// Returns the force on each corner, outward: what resists the displacement that causes it.
#[inline(always)]
pub(super) fn resisting(stress: &Stress<One>) -> [DVec3; 8] {
    let inward = stress.on_corners();
    let mut forces = [DVec3::ZERO; 8];
    for corner in 0..8 {
        for c in 0..3 {
            forces[corner][c] = -inward[corner][c].0;
        }
    }
    forces
}

impl LinearCells {
    /// Finds the cubes with a corner among the places `part`, ascending, some of which may be copies of corners. Directions are turned by
    /// `turn`.
    #[allow(clippy::cast_possible_truncation)]
    pub(crate) fn of(
        places: &SolidPlaces,
        copies: Option<&CornerCopies>,
        part: &[usize],
        stiffness_n_per_m: f64,
        edge_m: f64,
        turn: &DMat3,
    ) -> Self {
        let corner_of = |place: usize| copies.map_or(place, |copies| copies.corner_of(place));
        let around = |place: &usize| [0, 1].map(|beside| places.cubes_around(corner_of(*place), beside));
        let mut cubes: Vec<usize> = part.iter().flat_map(around).flatten().flatten().collect();
        cubes.sort_unstable();
        cubes.dedup();
        let index = |place: usize| part.binary_search(&place).map_or(BEYOND, |at| at as u32);
        let cell = |cube: usize| LinearCell {
            points: corners_of(places, copies, cube).map(index),
            weight: places.weight(cube),
            cofactor: [[0.0; 3]; 3],
            h: [[0.0; 3]; 3],
            q: 0.0,
            forces_n: [DVec3::ZERO; 8],
        };
        let [shear, lame] = places.lame_over_youngs();
        let cells = cubes.into_iter().map(cell).collect();
        LinearCells { cells, turn: *turn, edge_m, stiffness_n_per_m, shear, lame }
    }

    /// Returns the number of cubes.
    pub(crate) fn len(&self) -> usize {
        self.cells.len()
    }

    /// Computes the forces and their derivative at the present displacements of the part's points, m. Adds to `blocks`
    /// what holds each point at rest if the others are held: it is nearly the same in all directions.
    pub(crate) fn linearise(&mut self, displacement_m: &[DVec3], blocks: &mut [DMat3]) {
        struct Linearising<'a>(RefCell<&'a mut LinearCells>, &'a [DVec3]);
        impl SingleWork for Linearising<'_> {
            type Output = ();
            #[inline(always)]
            fn compute(&self) {
                self.0.borrow_mut().evaluate(self.1);
            }
        }
        lanes::single(&Linearising(RefCell::new(self), displacement_m));
        // (25⅓ μ + 4 λ)·k/64, from d(16 P)·σ and the hourglasses of a corner that moves alone.
        let alone = self.stiffness_n_per_m / 64.0 * (76.0 / 3.0 * self.shear + 4.0 * self.lame);
        for cell in &self.cells {
            for point in cell.points.into_iter().filter(|point| *point != BEYOND) {
                blocks[point as usize] += DMat3::from_diagonal(DVec3::splat(alone * cell.weight));
            }
        }
    }

    #[inline(always)]
    fn evaluate(&mut self, displacement_m: &[DVec3]) {
        let LinearCells { cells, turn, edge_m, stiffness_n_per_m, shear, lame } = self;
        let back = turn.transpose();
        let law = NeoHookean::<f64>::new(*stiffness_n_per_m * *edge_m, *shear, *lame);
        for cell in cells {
            let mut corners = [DVec3::ZERO; 8];
            for corner in 0..8 {
                let point = cell.points[corner];
                let moved_m = if point == BEYOND { DVec3::ZERO } else { displacement_m[point as usize] };
                corners[corner] = back * moved_m / *edge_m;
            }
            let patterns = patterns_of(&corners);
            let stress = law.stress(Scalar(cell.weight), &patterns);
            let forces = resisting(&stress);
            for corner in 0..8 {
                cell.forces_n[corner] = *turn * -forces[corner];
            }
            let h = &patterns.h;
            let Invariants { cofactor, growth, .. } = Invariants::of(h);
            for i in 0..3 {
                for j in 0..3 {
                    cell.h[i][j] = h[i][j].0;
                    cell.cofactor[i][j] = cofactor[i][j].0 + if i == j { 16.0 } else { 0.0 };
                }
            }
            cell.q = (*lame + *shear) * growth.0 / 64.0 - *shear;
        }
    }

    /// Calls `add` with each point and the force of a cube on it, N.
    pub(crate) fn forces(&self, mut add: impl FnMut(usize, DVec3)) {
        for cell in &self.cells {
            for (point, force_n) in cell.points.iter().zip(&cell.forces_n).filter(|(point, _)| **point != BEYOND) {
                add(*point as usize, *force_n);
            }
        }
    }

    /// Adds K·x for `N` vectors at once to `product`.
    pub(crate) fn times<const N: usize>(&self, x: &[[DVec3; N]], product: &mut [[DVec3; N]]) {
        struct Multiplying<'a, const N: usize>(&'a LinearCells, &'a [[DVec3; N]], RefCell<&'a mut [[DVec3; N]]>);
        impl<const N: usize> SingleWork for Multiplying<'_, N> {
            type Output = ();
            #[inline(always)]
            fn compute(&self) {
                self.0.multiply(self.1, &mut self.2.borrow_mut());
            }
        }
        lanes::single(&Multiplying(self, x, RefCell::new(product)));
    }

    #[inline(always)]
    fn multiply<const N: usize>(&self, x: &[[DVec3; N]], product: &mut [[DVec3; N]]) {
        let back = self.turn.transpose();
        let unit = self.stiffness_n_per_m / 64.0;
        for cell in &self.cells {
            let c = unit * cell.weight;
            for system in 0..N {
                let mut corners = [DVec3::ZERO; 8];
                for corner in 0..8 {
                    let point = cell.points[corner];
                    if point != BEYOND {
                        corners[corner] = back * x[point as usize][system];
                    }
                }
                let patterns = patterns_of(&corners);
                let stress = Stress::of(self.stress(cell, &patterns.h, c), Scalar(c * self.shear), patterns.g);
                let forces = resisting(&stress);
                for corner in 0..8 {
                    let point = cell.points[corner];
                    if point != BEYOND {
                        product[point as usize][system] += self.turn * forces[corner];
                    }
                }
            }
        }
    }

    /// Returns d(16 P) in E for a change of h, times `c`.
    #[inline(always)]
    fn stress(&self, cell: &LinearCell, change: &[[One; 3]; 3], c: f64) -> [[One; 3]; 3] {
        let LinearCell { cofactor, h, q, .. } = cell;
        let mut growth = 0.0;
        for i in 0..3 {
            for j in 0..3 {
                growth += cofactor[i][j] * change[i][j].0;
            }
        }
        let dq = (self.lame + self.shear) * growth / 64.0;
        let trace = change[0][0].0 + change[1][1].0 + change[2][2].0;
        let mut p = [[Scalar(0.0); 3]; 3];
        for i in 0..3 {
            let (i1, i2) = ((i + 1) % 3, (i + 2) % 3);
            for j in 0..3 {
                let (j1, j2) = ((j + 1) % 3, (j + 2) % 3);
                let turned = change[i1][j1].0 * h[i2][j2] + h[i1][j1] * change[i2][j2].0
                    - change[i1][j2].0 * h[i2][j1]
                    - h[i1][j2] * change[i2][j1].0;
                let of_cofactor = turned - 4.0 * change[j][i].0 + if i == j { 4.0 * trace } else { 0.0 };
                p[i][j] = Scalar(c * (4.0 * self.shear * change[i][j].0 + dq * cofactor[i][j] + q * of_cofactor));
            }
        }
        p
    }
}
