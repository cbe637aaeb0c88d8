//! Detection: how well somebody tells places with a lump from places without, from answers and truth.

use crate::definition::{MeasureDefinition, Scope};

pub(crate) const D_PRIME: MeasureDefinition = MeasureDefinition {
    name: "d_prime",
    unit: "1",
    scope: Scope::Total,
    range: [f64::NEG_INFINITY, f64::INFINITY],
    formula: "z((hits + ½)/(hits + misses + 1)) − z((false alarms + ½)/(false alarms + correct rejections + 1)), z the \
              inverse of the normal distribution",
    source: "Hautus 1995, doi:10.3758/BF03203619",
    meaning: "How well places with a lump were told from places without: 0 is chance, 3 is excellent.",
};

/// Returns d′ with the log-linear correction (Hautus 1995), which is finite also without a miss or a false alarm: z(h) − z(f)
/// with the corrected rates h = (hits + ½)/(hits + misses + 1) and f = (false alarms + ½)/(false alarms + correct
/// rejections + 1). 0 without any answer.
pub fn d_prime(hits: u32, misses: u32, false_alarms: u32, correct_rejections: u32) -> f64 {
    let rate = |yes: u32, no: u32| (f64::from(yes) + 0.5) / (f64::from(yes) + f64::from(no) + 1.0);
    normal_quantile(rate(hits, misses)) - normal_quantile(rate(false_alarms, correct_rejections))
}

/// Returns the z with Φ(z) = `part`, which must be above 0 and below 1: Newton's method on Φ(z) = ½·erfc(−z/√2).
fn normal_quantile(part: f64) -> f64 {
    // The tails are the same, and the lower one has more digits.
    if part > 0.5 {
        return -normal_quantile(1.0 - part);
    }
    let mut z = 0.0;
    // ln Φ is concave: the first step passes the root, and all others approach it from below.
    for _ in 0..50 {
        let below = 0.5 * libm::erfc(-z / std::f64::consts::SQRT_2);
        let density = libm::exp(-0.5 * z * z) / libm::sqrt(std::f64::consts::TAU);
        let step = (libm::log(below) - libm::log(part)) * below / density;
        z -= step;
        if step.abs() <= 1e-15 * (1.0 + z.abs()) {
            break;
        }
    }
    z
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_tables_and_d_prime_follows_from_the_corrected_rates() {
        for (part, z) in [
            (0.5, 0.0),
            (0.975, 1.959_963_984_540_054),
            (0.001, -3.090_232_306_167_813),
            (1e-9, -5.997_807_015_007_686),
        ] {
            assert!((normal_quantile(part) - z).abs() < 1e-12, "{part}: {}", normal_quantile(part));
        }
        // 20 of 25 found, 5 of 25 false: z(20.5/26) − z(5.5/26).
        assert!((d_prime(20, 5, 5, 20) - 2.0 * 0.801_094_529_281_95).abs() < 1e-9, "{}", d_prime(20, 5, 5, 20));
        assert_eq!(d_prime(0, 0, 0, 0), 0.0);
        assert!(d_prime(10, 0, 0, 10).is_finite() && d_prime(10, 0, 0, 10) > d_prime(9, 1, 0, 10));
    }
}
