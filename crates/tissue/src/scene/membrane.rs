//! Computes the energy that a membrane of springs stores under strain, once its points have settled. It
//! determines the stiffness of a material's springs.
//!
//! The springs along the edges of an uneven mesh give way: points move a little within the surface, and the
//! membrane is softer than the sum of its springs. (Measured: 10 % on jittered points.) So the springs are
//! strained by a given amount, the points move within their tangent planes until the energy is least, and that
//! energy is compared with the material's. A surface without a border can't shrink as a whole by such
//! movements, so the computation covers all of it, whatever its shape; points on a border are held.

use glam::{DMat3, DVec3};
use palpate_geometry::work::spend;

/// Largest number of conjugate-gradient steps, and the fraction of the first residual at which they end. (The
/// remaining error is then some ten thousandths of the energy.)
const MAX_STEPS: usize = 120;
const RESIDUAL: f64 = 1e-5;

/// A spring, with what it gains in length by the strain and by movements of its ends along two tangents each.
struct Strained {
    ends: [usize; 2],
    stiffness: f64,
    gain_m: f64,
    along: [[f64; 2]; 2],
}

impl Strained {
    /// Returns what movements of the ends add to its length.
    fn gained(&self, moved: &[[f64; 2]]) -> f64 {
        let of = |end: usize| {
            let ([a, b], [c, d]) = (self.along[end], moved[self.ends[end]]);
            a * c + b * d
        };
        of(0) + of(1)
    }

    /// Adds a force along the spring to both ends.
    fn add(&self, force: f64, to: &mut [[f64; 2]]) {
        for (end, along) in self.ends.iter().zip(self.along) {
            to[*end][0] += force * along[0];
            to[*end][1] += force * along[1];
        }
    }
}

/// Returns the least energy of strained springs, J. Springs are given by their ends and k; points that are not
/// held move within their tangent planes.
pub(super) fn settled_energy_j(
    [vertices_m, normals]: [&[DVec3]; 2],
    springs: impl Iterator<Item = ([u32; 2], f64)>,
    is_held: impl Fn(usize) -> bool,
    strain: DMat3,
) -> f64 {
    let tangents: Vec<[DVec3; 2]> = (normals.iter().enumerate())
        .map(|(vertex, normal)| match normal.any_orthonormal_pair() {
            _ if is_held(vertex) => [DVec3::ZERO; 2],
            (a, b) => [a, b],
        })
        .collect();
    let springs: Vec<Strained> = springs
        .map(|(ends, stiffness)| {
            let ends = ends.map(|end| end as usize);
            let span_m = vertices_m[ends[1]] - vertices_m[ends[0]];
            let direction = span_m.normalize_or_zero();
            let along = [-1.0, 1.0].map(|sign| sign * direction);
            let along = [0, 1].map(|end| tangents[ends[end]].map(|tangent| tangent.dot(along[end])));
            Strained { ends, stiffness, gain_m: direction.dot(strain * span_m), along }
        })
        .collect();
    let zero = || vec![[0.0; 2]; vertices_m.len()];
    let (mut residual, mut diagonal) = (zero(), zero());
    let mut energy_j = 0.0;
    for spring in &springs {
        energy_j += 0.5 * spring.stiffness * spring.gain_m * spring.gain_m;
        spring.add(-spring.stiffness * spring.gain_m, &mut residual);
        for (end, along) in spring.ends.iter().zip(spring.along) {
            (0..2).for_each(|c| diagonal[*end][c] += spring.stiffness * along[c] * along[c]);
        }
    }
    let scaled = |residual: &[[f64; 2]]| -> Vec<[f64; 2]> {
        let each = |(r, d): (&[f64; 2], &[f64; 2])| [0, 1].map(|c| if d[c] > 0.0 { r[c] / d[c] } else { 0.0 });
        residual.iter().zip(&diagonal).map(each).collect()
    };
    let dot = |a: &[[f64; 2]], b: &[[f64; 2]]| a.iter().zip(b).map(|(a, b)| a[0] * b[0] + a[1] * b[1]).sum::<f64>();
    let mut direction = scaled(&residual);
    let mut left = dot(&residual, &direction);
    let enough = RESIDUAL * left;
    for _ in 0..MAX_STEPS {
        if left <= enough {
            break;
        }
        spend(2 * springs.len());
        let mut product = zero();
        springs.iter().for_each(|spring| spring.add(spring.stiffness * spring.gained(&direction), &mut product));
        let curvature = dot(&direction, &product);
        if curvature <= 0.0 {
            break;
        }
        let far = left / curvature;
        energy_j -= 0.5 * far * left;
        for (residual, product) in residual.iter_mut().zip(&product) {
            (0..2).for_each(|c| residual[c] -= far * product[c]);
        }
        let next = scaled(&residual);
        let before = std::mem::replace(&mut left, dot(&residual, &next));
        for (direction, next) in direction.iter_mut().zip(next) {
            (0..2).for_each(|c| direction[c] = next[c] + left / before * direction[c]);
        }
    }
    energy_j
}
