//! Small square matrices: their exponential and spectral radius.

/// Rows of the largest matrix: u, d and the kept values; or u, d and the powers that give a scheme's weights.
const LONGEST: usize = 7;

/// A square matrix of at most 7 rows, stored by rows without heap memory: choosing a scheme creates many
/// thousands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Matrix {
    n: usize,
    values: [f64; LONGEST * LONGEST],
}

impl Matrix {
    /// Creates the n × n matrix with `value(row, column)` at each row and column, from 0. n is 1 to 7; others
    /// panic.
    pub fn of(n: usize, value: impl Fn(usize, usize) -> f64) -> Self {
        let mut values = [0.0; LONGEST * LONGEST];
        for (i, row) in values[..n * n].chunks_exact_mut(n).enumerate() {
            row.iter_mut().enumerate().for_each(|(j, entry)| *entry = value(i, j));
        }
        Matrix { n, values }
    }

    /// Returns the value at a row and column, from 0 to n − 1. Others are not checked: they panic or return
    /// another entry.
    pub fn at(&self, row: usize, column: usize) -> f64 {
        self.values[row * self.n + column]
    }

    fn times(&self, other: &Matrix) -> Matrix {
        Matrix::of(self.n, |i, j| (0..self.n).map(|k| self.at(i, k) * other.at(k, j)).sum())
    }

    fn scaled(&self, factor: f64) -> Matrix {
        Matrix { n: self.n, values: self.values.map(|value| value * factor) }
    }

    fn largest(&self) -> f64 {
        self.values.iter().fold(0.0, |largest, value| value.abs().max(largest))
    }

    /// Returns the exponential of the matrix, by scaling and squaring: a Taylor series of the matrix, halved
    /// until it is small, then squared as many times, e^A = (e^{A/2ᵏ})^{2ᵏ} (Moler and Van Loan, Nineteen
    /// dubious ways to compute the exponential of a matrix, twenty-five years later, SIAM Review 45(1), 2003,
    /// doi:10.1137/S00361445024180). For a matrix that is not finite, the result is NaN.
    pub fn exponential(&self) -> Matrix {
        if !self.values.iter().all(|value| value.is_finite()) {
            return Matrix::of(self.n, |_, _| f64::NAN);
        }
        let mut halvings = 0;
        let mut small = *self;
        while small.largest() > 0.125 {
            small = small.scaled(0.5);
            halvings += 1;
        }
        let mut sum = Matrix::of(self.n, |i, j| f64::from(u8::from(i == j)));
        let mut term = sum;
        for k in 1..20 {
            term = term.times(&small).scaled(1.0 / f64::from(k));
            sum.values.iter_mut().zip(&term.values).for_each(|(sum, term)| *sum += term);
        }
        for _ in 0..halvings {
            sum = sum.times(&sum);
        }
        sum
    }

    /// Returns the largest magnitude among the eigenvalues: the 2ᵏ-th root of the size of the 2ᵏ-th power
    /// (Gelfand's formula, ρ(A) = lim ‖Aⁿ‖^{1/n}), with k = 35. Meaningless for a matrix with NaN.
    pub fn spectral_radius(&self) -> f64 {
        let (mut power, mut logarithm, mut exponent) = (*self, 0.0, 1.0);
        for _ in 0..36 {
            let size = power.largest();
            if size == 0.0 || !size.is_finite() {
                return size;
            }
            // The power so far is e^logarithm times a matrix of size 1.
            logarithm += libm::log(size) / exponent;
            power = power.scaled(1.0 / size);
            power = power.times(&power);
            exponent *= 2.0;
        }
        libm::exp(logarithm)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_of_a_rotation_is_a_rotation() {
        let e = Matrix::of(2, |i, j| [[0.0, 7.0], [-7.0, 0.0]][i][j]).exponential();
        assert!((e.at(0, 0) - 7.0_f64.cos()).abs() < 1e-14 && (e.at(0, 1) - 7.0_f64.sin()).abs() < 1e-14);
    }

    #[test]
    fn the_exponential_of_what_is_not_finite_comes_to_an_end() {
        for value in [f64::INFINITY, f64::NEG_INFINITY, f64::NAN] {
            let e = Matrix::of(2, |i, j| if i == j { value } else { 0.0 }).exponential();
            assert!(e.at(0, 0).is_nan());
        }
    }

    #[test]
    fn the_spectral_radius_is_that_of_the_largest_eigenvalue() {
        let rotation = Matrix::of(2, |i, j| [[0.3, 0.9], [-0.9, 0.3]][i][j]);
        assert!((rotation.spectral_radius() - 0.9_f64.sqrt()).abs() < 1e-9);
        let jordan = Matrix::of(2, |i, j| [[0.5, 1.0], [0.0, 0.5]][i][j]);
        assert!((jordan.spectral_radius() - 0.5).abs() < 1e-8);
    }
}
