//! Bounds the largest eigenvalue of the Laplacian of a weighted graph with masses from above, by the method of
//! Lanczos.

use palpate_geometry::work::spend;

/// Steps of the method of Lanczos.
const STEPS: usize = 100;

/// The relative amount by which the largest eigenvalue found may be too small. From a random start, the
/// shortfall is larger with a probability of at most 1.648·√n·e^(−√SHORT·(2·STEPS − 1)) for n points (Kuczyński
/// and Woźniakowski, Estimating the largest eigenvalue by the power and Lanczos algorithms with a random start,
/// SIAM Journal on Matrix Analysis and Applications 13(4), 1992, doi:10.1137/0613066): 10⁻⁹ for a million.
const SHORT: f64 = 0.02;

/// Returns an upper bound of the largest λ with Σ k_ij/m_i·(x_i − x_j) = λ·x_i. `around` has, for each point i,
/// its neighbours j with k_ij/m_i; `mass` returns m_i.
pub(super) fn largest_of_laplacian(around: &[Vec<(u32, f64)>], mass: impl Fn(u32) -> f64) -> f64 {
    #[allow(clippy::cast_possible_truncation)]
    let roots: Vec<f64> = (0..around.len() as u32).map(|point| mass(point).sqrt()).collect();
    let degrees: Vec<f64> = around.iter().map(|others| others.iter().map(|(_, k)| k).sum()).collect();
    // With √m·x in place of x, the operator is symmetric.
    let applied = |x: &[f64], into: &mut [f64]| {
        for (point, others) in around.iter().enumerate() {
            spend(1 + others.len());
            let pulls = others.iter().map(|(other, k)| k * x[*other as usize] / roots[*other as usize]);
            into[point] = degrees[point] * x[point] - roots[point] * pulls.sum::<f64>();
        }
    };
    let mut x = start(around.len());
    let (mut before, mut next) = (vec![0.0; x.len()], vec![0.0; x.len()]);
    let mut matrix = Tridiagonal::default();
    for _ in 0..STEPS.min(x.len()) {
        applied(&x, &mut next);
        let along = dot(&x, &next);
        let last = matrix.beside.last().copied().unwrap_or(0.0);
        for ((next, x), before) in next.iter_mut().zip(&x).zip(&before) {
            *next -= along * x + last * before;
        }
        matrix.diagonal.push(along);
        let length = dot(&next, &next).sqrt();
        matrix.beside.push(length);
        // The Krylov space of the start is exhausted.
        if length <= 1e-12 * along.abs() {
            break;
        }
        next.iter_mut().for_each(|next| *next /= length);
        std::mem::swap(&mut before, &mut x);
        std::mem::swap(&mut x, &mut next);
    }
    matrix.largest_eigenvalue() / (1.0 - SHORT)
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Returns a unit vector that is independent of any graph and the same on every call.
#[allow(clippy::cast_possible_truncation)]
fn start(count: usize) -> Vec<f64> {
    // SplitMix64 (Steele, Lea and Flood 2014). A sum of four uniform numbers is nearly normal, so that no
    // direction is more likely.
    let even = |n: u64| {
        let mut bits = n.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        f64::from((bits ^ (bits >> 31)) as u32) / f64::from(u32::MAX) - 0.5
    };
    let mut x: Vec<f64> = (0..count as u64).map(|point| (1..=4).map(|k| even(4 * point + k)).sum()).collect();
    let length = dot(&x, &x).sqrt();
    x.iter_mut().for_each(|x| *x /= length);
    x
}

/// A symmetric tridiagonal matrix: its diagonal and the entries beside it.
#[derive(Default)]
struct Tridiagonal {
    diagonal: Vec<f64>,
    /// The last entry is not part of the matrix.
    beside: Vec<f64>,
}

impl Tridiagonal {
    /// Returns the largest eigenvalue, by bisection, rounded up.
    fn largest_eigenvalue(&self) -> f64 {
        let reach = |at: usize| {
            let before = if at > 0 { self.beside[at - 1] } else { 0.0 };
            let after = if at + 1 < self.diagonal.len() { self.beside[at] } else { 0.0 };
            self.diagonal[at] + before + after
        };
        let (mut low, mut high) = (0.0, (0..self.diagonal.len()).map(reach).fold(0.0, f64::max));
        while high - low > 1e-13 * high {
            let middle = 0.5 * (low + high);
            if self.has_above(middle) { low = middle } else { high = middle }
        }
        high
    }

    /// Returns whether an eigenvalue is above a value: whether a pivot of the matrix minus that value is
    /// positive.
    fn has_above(&self, value: f64) -> bool {
        let mut pivot = f64::INFINITY;
        let mut before = 0.0;
        self.diagonal.iter().zip(&self.beside).any(|(along, beside)| {
            pivot = along - value - before * before / pivot;
            before = *beside;
            // A pivot of 0 may be replaced by one just below 0.
            if pivot == 0.0 {
                pivot = -f64::MIN_POSITIVE;
            }
            pivot > 0.0
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A ring of points, each joined to the next, where every second one has another mass.
    fn ring(count: u32, masses: [f64; 2]) -> f64 {
        let mass = |point: u32| masses[point as usize % 2];
        let others = |point: u32| [(point + 1) % count, (point + count - 1) % count];
        let around: Vec<Vec<(u32, f64)>> =
            (0..count).map(|point| others(point).map(|other| (other, 1.0 / mass(point))).to_vec()).collect();
        largest_of_laplacian(&around, mass)
    }

    #[test]
    fn the_bound_of_a_ring_is_hardly_above_its_fastest_wave() {
        // Neighbours against each other: λ = 2/m₁ + 2/m₂.
        for (count, masses) in [(4, [1.0, 1.0]), (6, [0.5, 3.0]), (400, [1.0, 1.0]), (100_000, [0.2, 0.7])] {
            let (bound, truth) = (ring(count, masses), 2.0 / masses[0] + 2.0 / masses[1]);
            assert!(bound >= truth && bound <= truth * 1.021, "{count} {masses:?}: {bound} {truth}");
        }
    }

    #[test]
    fn what_nothing_joins_does_not_vibrate() {
        assert_eq!(largest_of_laplacian(&[vec![], vec![]], |_| 1.0), 0.0);
        assert_eq!(largest_of_laplacian(&[], |_| 1.0), 0.0);
    }
}
