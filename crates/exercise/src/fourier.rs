//! The fast Fourier transform of a power of two of numbers.

use std::f64::consts::TAU;

/// Returns |Σ x(k)·e^{−2πi·jk/n}| for j from 0 to `count` − 1, with `samples` padded by zeros to n = `length`, a power of
/// two that is at least their number.
pub(crate) fn magnitudes(samples: &[f64], length: usize, count: usize) -> Vec<f64> {
    let bits = length.trailing_zeros();
    let reversed = |k: usize| if bits == 0 { 0 } else { k.reverse_bits() >> (usize::BITS - bits) };
    let mut values: Vec<[f64; 2]> =
        (0..length).map(|k| [samples.get(reversed(k)).copied().unwrap_or_default(), 0.0]).collect();
    // The sines come from `libm`, which gives the same bits on every machine.
    #[allow(clippy::cast_precision_loss)]
    let turns: Vec<[f64; 2]> = (0..length / 2)
        .map(|k| -TAU * k as f64 / length as f64)
        .map(|angle| [libm::cos(angle), libm::sin(angle)])
        .collect();
    let mut half = 1;
    while half < length {
        let stride = length / (2 * half);
        for block in values.chunks_exact_mut(2 * half) {
            let (first, second) = block.split_at_mut(half);
            for (k, (a, b)) in first.iter_mut().zip(second).enumerate() {
                let [c, s] = turns[k * stride];
                let turned = [b[0] * c - b[1] * s, b[0] * s + b[1] * c];
                *b = [a[0] - turned[0], a[1] - turned[1]];
                *a = [a[0] + turned[0], a[1] + turned[1]];
            }
        }
        half *= 2;
    }
    values.iter().take(count).map(|[re, im]| (re * re + im * im).sqrt()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sine_has_its_frequency_alone() {
        let sine: Vec<f64> = (0..64).map(|k| libm::sin(TAU * 5.0 * f64::from(k) / 64.0)).collect();
        for (frequency, magnitude) in magnitudes(&sine, 64, 33).into_iter().enumerate() {
            let expected = if frequency == 5 { 32.0 } else { 0.0 };
            assert!((magnitude - expected).abs() < 1e-12, "{frequency}: {magnitude}");
        }
    }
}
