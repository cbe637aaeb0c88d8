//! How far the forces of a tissue are from measured ones.

use super::curve_file::MeasuredCurve;

/// What is between the forces of a tissue and those of measured curves.
#[derive(Debug, Clone, PartialEq)]
pub struct Residual {
    /// The root of the mean square of computed − measured, N, of all samples.
    pub rms_n: f64,
    /// The same of each curve, N.
    pub rms_of_curves_n: Vec<f64>,
    /// `rms_n` divided by the largest measured force; 0 if all measured forces are 0.
    pub relative_rms: f64,
    /// 1 − Σ(computed − measured)²/Σ(measured − mean)²; 0 if all measured forces are equal.
    pub r_squared: f64,
}

impl Residual {
    /// Returns the residual of forces, N, one for each sample of each curve, in their order.
    pub fn of(curves: &[MeasuredCurve], computed_n: &[Vec<f64>]) -> Self {
        let of_curves: Vec<Vec<f64>> =
            curves.iter().zip(computed_n).map(|(curve, computed_n)| differences(computed_n, &curve.force_n)).collect();
        let all: Vec<f64> = of_curves.iter().flatten().copied().collect();
        let measured = || curves.iter().flat_map(|curve| &curve.force_n);
        #[allow(clippy::cast_precision_loss)]
        let mean_n = measured().sum::<f64>() / measured().count().max(1) as f64;
        let spread: f64 = measured().map(|force_n| (force_n - mean_n).powi(2)).sum();
        let squares: f64 = all.iter().map(|difference| difference * difference).sum();
        let largest_n = measured().fold(0.0_f64, |largest, force_n| largest.max(force_n.abs()));
        let rms_n = rms(&all);
        Residual {
            rms_n,
            rms_of_curves_n: of_curves.iter().map(|of_curve| rms(of_curve)).collect(),
            relative_rms: if largest_n > 0.0 { rms_n / largest_n } else { 0.0 },
            r_squared: if spread > 0.0 { 1.0 - squares / spread } else { 0.0 },
        }
    }
}

/// Returns computed − measured of each sample.
pub(crate) fn differences(computed: &[f64], measured: &[f64]) -> Vec<f64> {
    computed.iter().zip(measured).map(|(computed, measured)| computed - measured).collect()
}

/// Returns the root of the mean square.
#[allow(clippy::cast_precision_loss)]
pub(crate) fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|value| value * value).sum::<f64>() / values.len().max(1) as f64).sqrt()
}
