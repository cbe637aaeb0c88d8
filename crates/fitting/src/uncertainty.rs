//! How well data tell numbers: intervals and correlations from the residuals and the Jacobian at a minimum.

use nalgebra::{DMatrix, DVector, SymmetricEigen};

/// Columns of the Jacobian that are parallel to within this have no common solution; it is the least eigenvalue of their
/// correlations that counts.
const MIN_EIGENVALUE: f64 = 1e-9;

/// A correlation of neighbouring residuals is noticed from so many of its own standard errors on.
const NOTICED: f64 = 3.0;

/// How well data tell numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct Uncertainty {
    /// Half the width of the 95 % interval of each number, with its shift; infinite if nothing depends on it, NaN if its column has NaN.
    pub half_widths: Vec<f64>,
    /// How far each number is off because the function is not computed exactly, up or down; `None` if nobody knows.
    pub shifts: Option<Vec<f64>>,
    /// Correlation between the errors of each two numbers, by rows.
    pub correlations: Vec<Vec<f64>>,
    /// Standard deviation of the noise, from the residuals.
    pub noise: f64,
    /// Correlation between a residual and the next one in a curve, 0 if it is within what chance makes of independent ones. The
    /// intervals are wider by √((1 + r)/(1 − r)) for it.
    pub autocorrelation: f64,
}

/// Returns the value that Student's t exceeds, up or down, with a probability of 5 %, for so many degrees of freedom, at least 1: the
/// expansion in 1/ν of Abramowitz and Stegun (Handbook of Mathematical Functions, 26.7.5). It errs by 11 % at 1 and by 0.1 % at 3.
pub fn student_t_95(degrees: f64) -> f64 {
    let z = 1.959_963_984_540_054_f64;
    let power = |n: i32| z.powi(n);
    let terms = [
        (power(3) + z) / 4.0,
        (5.0 * power(5) + 16.0 * power(3) + 3.0 * z) / 96.0,
        (3.0 * power(7) + 19.0 * power(5) + 17.0 * power(3) - 15.0 * z) / 384.0,
        (79.0 * power(9) + 776.0 * power(7) + 1482.0 * power(5) - 1920.0 * power(3) - 945.0 * z) / 92160.0,
    ];
    terms.iter().rev().fold(0.0, |sum, term| (sum + term) / degrees) + z
}

/// Returns the correlation between a residual and the next one; `lengths` are those of the curves, one after the other.
fn autocorrelation(residuals: &[f64], lengths: &[usize]) -> f64 {
    let (mut products, mut squares, mut pairs, mut begin) = (0.0, 0.0, 0.0_f64, 0);
    for length in lengths {
        let curve = &residuals[begin..begin + length];
        for pair in curve.windows(2) {
            products += pair[0] * pair[1];
            squares += 0.5 * (pair[0] * pair[0] + pair[1] * pair[1]);
            pairs += 1.0;
        }
        begin += length;
    }
    let found = if squares > 0.0 { products / squares } else { 0.0 };
    if found * pairs.sqrt() > NOTICED { found.min(0.99) } else { 0.0 }
}

/// What is known of the data beside a Jacobian.
#[derive(Debug, Clone, Copy)]
pub struct MeasuredSamples<'d> {
    /// Function − measured of each sample.
    pub residuals: &'d [f64],
    /// The number of samples of each curve, one after the other.
    pub lengths: &'d [usize],
    /// The noise is at least this: what the function errs by from place to place.
    pub least_noise: f64,
}

impl Uncertainty {
    /// Returns the uncertainty of the numbers of a minimum. `jacobian` has a row for each sample and a column for each number;
    /// `errors` are the true function − the function there, if somebody knows it.
    #[allow(clippy::cast_precision_loss)]
    pub fn of(jacobian: &DMatrix<f64>, data: &MeasuredSamples<'_>, errors: Option<&[f64]>) -> Self {
        let count = jacobian.ncols();
        let residuals = data.residuals;
        let is_known: Vec<bool> =
            jacobian.column_iter().map(|column| !column.iter().any(|value| value.is_nan())).collect();
        let jacobian =
            DMatrix::from_fn(jacobian.nrows(), count, |i, j| if is_known[j] { jacobian[(i, j)] } else { 0.0 });
        let degrees = residuals.len().saturating_sub(count).max(1) as f64;
        let squares: f64 = residuals.iter().map(|residual| residual * residual).sum();
        let noise = (squares / degrees).sqrt();
        let autocorrelation = autocorrelation(residuals, data.lengths);
        let dependence = ((1.0 + autocorrelation) / (1.0 - autocorrelation)).sqrt();
        let norms: Vec<f64> = jacobian.column_iter().map(|column| column.norm()).collect();
        let scaled = |column: usize, norm: f64| jacobian.column(column) / norm.max(f64::MIN_POSITIVE);
        let columns: Vec<_> = norms.iter().enumerate().map(|(column, norm)| scaled(column, *norm)).collect();
        let products = DMatrix::from_fn(count, count, |i, j| if i == j { 1.0 } else { columns[i].dot(&columns[j]) });
        let eigen = SymmetricEigen::new(products);
        let covariance = DMatrix::from_fn(count, count, |i, j| {
            let of = |k: usize| eigen.eigenvectors[(i, k)] * eigen.eigenvectors[(j, k)];
            (0..count).map(|k| of(k) / eigen.eigenvalues[k].max(MIN_EIGENVALUE)).sum::<f64>()
        });
        let shifts = errors.map(|errors| {
            let errors = DVector::from_column_slice(errors);
            let along: Vec<f64> = columns.iter().map(|column| column.dot(&errors)).collect();
            let shift = |i: usize| (0..count).map(|j| covariance[(i, j)] * along[j]).sum::<f64>().abs();
            (0..count).map(|i| if norms[i] > 0.0 { shift(i) / norms[i] } else { 0.0 }).collect::<Vec<f64>>()
        });
        let factor = student_t_95(degrees) * (noise * dependence).max(data.least_noise);
        let half_width = |i: usize| match (is_known[i], norms[i] > 0.0) {
            (false, _) => f64::NAN,
            (true, false) => f64::INFINITY,
            (true, true) => {
                factor * covariance[(i, i)].sqrt() / norms[i] + shifts.as_ref().map_or(0.0, |shifts| shifts[i])
            }
        };
        let correlation = |i: usize, j: usize| {
            if i == j { 1.0 } else { covariance[(i, j)] / (covariance[(i, i)] * covariance[(j, j)]).sqrt() }
        };
        Uncertainty {
            half_widths: (0..count).map(half_width).collect(),
            correlations: (0..count).map(|i| (0..count).map(|j| correlation(i, j)).collect()).collect(),
            shifts,
            noise,
            autocorrelation,
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn t_is_that_of_the_tables() {
        for (degrees, t) in [(5.0, 2.5706), (10.0, 2.2281), (30.0, 2.0423), (1e6, 1.95996)] {
            assert!((student_t_95(degrees) / t - 1.0).abs() < 1e-3, "{degrees}: {}", student_t_95(degrees));
        }
    }

    /// Of a straight line through evenly spaced values the textbook knows the standard error of the slope.
    #[test]
    fn the_interval_of_a_line_is_the_textbooks_and_grows_with_the_correlation_of_its_noise() {
        let x: Vec<f64> = (0..50).map(|k| 0.1 * f64::from(k)).collect();
        let jacobian = DMatrix::from_fn(50, 2, |i, j| if j == 0 { 1.0 } else { x[i] });
        let alternating: Vec<f64> = (0..50).map(|k| if k % 2 == 0 { 0.1 } else { -0.1 }).collect();
        let of = |residuals: &[f64], errors: Option<&[f64]>| {
            Uncertainty::of(&jacobian, &MeasuredSamples { residuals, lengths: &[50], least_noise: 0.0 }, errors)
        };
        let found = of(&alternating, None);
        let noise = (50.0 * 0.01_f64 / 48.0).sqrt();
        let mean = x.iter().sum::<f64>() / 50.0;
        let spread: f64 = x.iter().map(|x| (x - mean).powi(2)).sum();
        assert!((found.half_widths[1] / (student_t_95(48.0) * noise / spread.sqrt()) - 1.0).abs() < 1e-9);
        assert!(found.autocorrelation == 0.0 && found.correlations[0][1] < -0.8, "{found:?}");
        let drifting: Vec<f64> = x.iter().map(|x| 0.1 * (x - mean).signum()).collect();
        let drifted = of(&drifting, None);
        assert!(drifted.half_widths[1] > 3.0 * found.half_widths[1], "{drifted:?}");
        // A function that is lower than the true one by a line of a known slope is fitted with that slope too much.
        let errors: Vec<f64> = x.iter().map(|x| 0.3 + 0.02 * x).collect();
        let shifted = of(&alternating, Some(&errors));
        let shifts = shifted.shifts.clone().unwrap();
        assert!((shifts[0] - 0.3).abs() < 1e-9 && (shifts[1] - 0.02).abs() < 1e-9, "{shifts:?}");
        assert!((shifted.half_widths[1] - found.half_widths[1] - 0.02).abs() < 1e-9, "{shifted:?}");
    }

    #[test]
    fn parallel_columns_and_columns_of_zeros_have_no_bounded_interval_and_those_of_nan_none() {
        let jacobian = DMatrix::from_fn(20, 4, |i, j| match j {
            2 => 0.0,
            3 => f64::NAN,
            _ => (j + 1) as f64 * (i + 1) as f64,
        });
        let found = Uncertainty::of(
            &jacobian,
            &MeasuredSamples { residuals: &[0.0; 20], lengths: &[20], least_noise: 0.01 },
            None,
        );
        assert!(found.half_widths[0] > 1.0 && found.half_widths[2].is_infinite(), "{found:?}");
        assert!(found.half_widths[3].is_nan() && found.half_widths[0].is_finite(), "{found:?}");
    }
}
