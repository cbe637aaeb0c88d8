//! What joins the points of a part of a tissue, linearised at given displacements.

use glam::{DMat3, DVec3};

use crate::body::solid::linear_cells::LinearCells;

/// A spring of the part, linearised at the present displacements.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Spring {
    pub(crate) ends: [usize; 2],
    pub(crate) rest_m: DVec3,
    pub(crate) stiffness_n_per_m: f64,
    /// The part of it that a pretension has.
    pub(crate) tension_n_per_m: f64,
    pub(crate) tangent: DMat3,
    /// Force on the first end, N.
    pub(crate) force_n: DVec3,
}

impl Spring {
    pub(super) fn new(ends: [usize; 2], rest_m: DVec3, stiffness_n_per_m: f64, tension_n_per_m: f64) -> Self {
        Spring { ends, rest_m, stiffness_n_per_m, tension_n_per_m, tangent: DMat3::ZERO, force_n: DVec3::ZERO }
    }
}

/// What joins the points of a part of a tissue.
#[derive(Debug)]
pub(crate) enum Elements {
    /// Springs.
    Springs(Vec<Spring>),
    /// Cubes.
    Cells(LinearCells),
}

impl Elements {
    /// Returns the work of one multiplication, in springs. (A cube takes as long as ten.)
    pub(crate) fn work(&self) -> usize {
        match self {
            Elements::Springs(springs) => springs.len(),
            Elements::Cells(cells) => 10 * cells.len(),
        }
    }

    /// Returns the springs; none in a solid.
    pub(crate) fn springs(&self) -> &[Spring] {
        if let Elements::Springs(springs) = self { springs } else { &[] }
    }

    /// Removes springs, given by their ends and rest vectors, m, ascending by their ends.
    pub(crate) fn remove(&mut self, found: &[([usize; 2], DVec3)]) {
        let Elements::Springs(springs) = self else { return };
        springs.retain(|spring| {
            let from = found.partition_point(|(ends, _)| *ends < spring.ends);
            let same = found[from..].iter().take_while(|(ends, _)| *ends == spring.ends);
            !same.into_iter().any(|(_, rest_m)| *rest_m == spring.rest_m)
        });
    }

    /// Multiplies the stiffness of each spring by a factor, which is given its ends.
    pub(crate) fn stiffen(&mut self, factor: impl Fn([usize; 2]) -> f64) {
        let Elements::Springs(springs) = self else { return };
        springs.iter_mut().for_each(|spring| spring.stiffness_n_per_m *= factor(spring.ends));
    }

    /// Computes forces and their derivatives at the present displacements of the points, m. Adds to `blocks` the
    /// stiffness that holds each point if the others are held.
    pub(crate) fn linearise(&mut self, displacement_m: &[DVec3], blocks: &mut [DMat3]) {
        let springs = match self {
            Elements::Springs(springs) => springs,
            Elements::Cells(cells) => return cells.linearise(displacement_m, blocks),
        };
        for spring in springs {
            let [a, b] = spring.ends;
            let delta = displacement_m[b] - displacement_m[a];
            let apart_m = spring.rest_m + delta;
            let rest_squared = spring.rest_m.length_squared();
            // 1 − L0/L without cancellation (`springs`).
            let q = ((2.0 * spring.rest_m + delta).dot(delta) / rest_squared).max(1e-12 - 1.0);
            let s = (1.0 + q).sqrt();
            let stretch = q / (s * (1.0 + s));
            let along = apart_m / (s * rest_squared.sqrt());
            let outer = DMat3::from_cols(along * along.x, along * along.y, along * along.z);
            let across = stretch.max(0.0);
            let slack_n_per_m = spring.stiffness_n_per_m - spring.tension_n_per_m;
            let tension = DMat3::IDENTITY * spring.tension_n_per_m;
            spring.force_n = slack_n_per_m * stretch * apart_m + spring.tension_n_per_m * delta;
            spring.tangent = slack_n_per_m * (outer * (1.0 - across) + DMat3::IDENTITY * across) + tension;
            blocks[a] += spring.tangent;
            blocks[b] += spring.tangent;
        }
    }

    /// Calls `add` with points and forces on them, N: all together are those at the displacements of
    /// [`Elements::linearise`].
    pub(crate) fn forces(&self, mut add: impl FnMut(usize, DVec3)) {
        match self {
            Elements::Springs(springs) => {
                for spring in springs {
                    add(spring.ends[0], spring.force_n);
                    add(spring.ends[1], -spring.force_n);
                }
            }
            Elements::Cells(cells) => cells.forces(add),
        }
    }

    /// Adds K·x for `N` vectors at once to `product`.
    pub(crate) fn times<const N: usize>(&self, x: &[[DVec3; N]], product: &mut [[DVec3; N]]) {
        let springs = match self {
            Elements::Springs(springs) => springs,
            Elements::Cells(cells) => return cells.times(x, product),
        };
        for Spring { ends: [a, b], tangent, .. } in springs {
            for system in 0..N {
                let pull = *tangent * (x[*b][system] - x[*a][system]);
                product[*a][system] -= pull;
                product[*b][system] += pull;
            }
        }
    }
}
