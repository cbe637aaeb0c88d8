//! The noise of each curve, from its residuals, and the weights of samples that follow from it.

/// Residuals of a curve of fewer samples do not tell its noise: it counts as that of the others.
const OWN_SAMPLES: usize = 20;

/// Curves have different noise if twice the logarithm of the likelihood ratio is so many of its own standard deviations above its mean.
const NOTICED: f64 = 3.0;

/// Returns the standard deviation of the noise of each curve, at least `least`; `None` if they differ by no more than chance makes. The
/// residuals are those of all curves, one after the other, in those units; `lengths` are the numbers of samples.
///
/// The ratio compares a variance for each curve with one for all: N·ln s² − Σ n·ln s_c² is distributed as χ² with as many degrees of
/// freedom as there are further variances (Wilks, 1938), whose mean that is, and whose variance is twice that.
#[allow(clippy::cast_precision_loss)]
pub(crate) fn noise_of_curves(residuals: &[f64], lengths: &[usize], least: f64) -> Option<Vec<f64>> {
    let mut rest = residuals;
    let mut squares = Vec::with_capacity(lengths.len());
    for length in lengths {
        let (curve, others) = rest.split_at(*length);
        squares.push(curve.iter().map(|residual| residual * residual).sum::<f64>());
        rest = others;
    }
    let variance = |squares: f64, samples: usize| (squares / samples.max(1) as f64).max(least * least);
    let own: Vec<(f64, usize)> =
        squares.iter().copied().zip(lengths.iter().copied()).filter(|(_, length)| *length >= OWN_SAMPLES).collect();
    let common = variance(own.iter().map(|own| own.0).sum(), own.iter().map(|own| own.1).sum());
    let further = own.len().saturating_sub(1) as f64;
    if further == 0.0 || common == 0.0 {
        return None;
    }
    let ratio: f64 =
        own.iter().map(|(squares, length)| *length as f64 * (common / variance(*squares, *length)).ln()).sum();
    let of_curve = |(squares, length): (&f64, &usize)| {
        if *length >= OWN_SAMPLES { variance(*squares, *length).sqrt() } else { common.sqrt() }
    };
    let is_noticed = ratio > further + NOTICED * (2.0 * further).sqrt();
    is_noticed.then(|| squares.iter().zip(lengths).map(of_curve).collect())
}

/// Returns the weight of each sample of curves with that noise: 1/noise, so that the mean square of the weights is 1.
#[allow(clippy::cast_precision_loss)]
pub(crate) fn weights(noise: &[f64], lengths: &[usize]) -> Vec<f64> {
    let each = noise.iter().zip(lengths).flat_map(|(noise, length)| std::iter::repeat_n(noise.recip(), *length));
    let weights: Vec<f64> = each.collect();
    let mean = (weights.iter().map(|weight| weight * weight).sum::<f64>() / weights.len().max(1) as f64).sqrt();
    weights.iter().map(|weight| weight / mean).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use fastrand::Rng;

    fn normal(random: &mut Rng) -> f64 {
        (-2.0 * (1.0 - random.f64()).ln()).sqrt() * (std::f64::consts::TAU * random.f64()).cos()
    }

    #[test]
    fn curves_of_equal_noise_have_one_in_most_cases_and_those_of_different_noise_their_own() {
        let lengths = [100, 60, 10];
        let mut random = Rng::with_seed(7);
        let mut of = |noise: [f64; 3]| {
            let curves = lengths.iter().zip(noise);
            let residuals: Vec<f64> = curves
                .flat_map(|(length, noise)| (0..*length).map(|_| noise * normal(&mut random)).collect::<Vec<_>>())
                .collect();
            noise_of_curves(&residuals, &lengths, 1e-3)
        };
        let noticed = (0..1000).filter(|_| of([1.0; 3]).is_some()).count();
        // That of one degree of freedom exceeds 1 + 3·√2 in 2.2 % of all cases.
        assert!((5..60).contains(&noticed), "{noticed}");
        for _ in 0..100 {
            let found = of([1.0, 0.2, 1.0]).unwrap();
            assert!((found[0] - 1.0).abs() < 0.3 && (found[1] - 0.2).abs() < 0.08 && found[2] > 0.5, "{found:?}");
        }
        // Noise below that of the runs counts as that.
        assert_eq!(of([1.0, 1e-9, 1.0]).unwrap()[1], 1e-3);
    }

    #[test]
    fn one_curve_and_curves_without_residuals_have_one_noise() {
        assert_eq!(noise_of_curves(&[0.1; 50], &[50], 0.0), None);
        assert_eq!(noise_of_curves(&[0.0; 60], &[30, 30], 0.0), None);
        let weights = weights(&[2.0, 1.0], &[1, 3]);
        assert!((weights[3] / weights[0] - 2.0).abs() < 1e-12);
        assert!((weights.iter().map(|weight| weight * weight).sum::<f64>() - 4.0).abs() < 1e-12);
    }
}
