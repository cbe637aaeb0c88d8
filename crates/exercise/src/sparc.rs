//! Smoothness by spectrum: the spectral arc length (SPARC) of a tool's speed.
//!
//! The length of the normalized magnitude spectrum of the speed up to the last frequency that is at most 10 Hz and has at
//! least 0.05 of the largest magnitude, negative (Balasubramanian et al. 2015). The spectrum has 16 to 32 times as many
//! frequencies as there are speeds (padding by zeros), as in the published program.
//!
//! The speeds are kept: 100 in a second for up to 327 s. A longer time of use is coarsened, to 50 Hz and then to 25 Hz, by
//! means of two; beyond 21 minutes there is no figure. 10 Hz need at least 20.

use crate::definition::{Figures, MeasureDefinition, Scope};
use crate::fourier::magnitudes;
use crate::window::MotionWindow;

/// The largest number of speeds that are kept.
const MAX_SPEEDS: usize = 1 << 15;

/// The lowest rate of the speeds, Hz.
const MIN_RATE_HZ: f64 = 20.0;

/// The highest frequency that counts, Hz.
const CUTOFF_HZ: f64 = 10.0;

/// The smallest magnitude that counts, relative to the largest.
const MIN_MAGNITUDE: f64 = 0.05;

/// The binary logarithm of the least padding.
const PADDING: u32 = 4;

pub(crate) const SPARC: MeasureDefinition = MeasureDefinition {
    name: "sparc",
    unit: "1",
    scope: Scope::Tool,
    range: [f64::NEG_INFINITY, 0.0],
    formula: "−∫ √((1/ω_c)² + (dV̂/dω)²) dω from 0 to ω_c: the last frequency up to 10 Hz with V̂ ≥ 0.05; V̂ the \
              spectrum of the speed in windows of 10 ms over its largest value",
    source: "Balasubramanian et al. 2015, doi:10.1186/s12984-015-0090-9",
    meaning: "How smooth the movement was: nearer to 0 is smoother; one least-jerk movement has −1.41, and each pause \
              or correction makes it less.",
};

/// The speeds of one tool over its time of use.
#[derive(Debug, Clone)]
pub(crate) struct SpeedProfile {
    speeds_m_per_s: Vec<f64>,
    /// Windows for each of these speeds.
    windows_each: u32,
    /// The sum of the speeds of the windows that are not yet enough for one, and their number.
    pending: (f64, u32),
    rate_hz: f64,
    is_too_long: bool,
}

impl SpeedProfile {
    /// `rate_hz` is the number of whole windows per second.
    pub(crate) fn new(rate_hz: f64) -> Self {
        let is_too_long = rate_hz < MIN_RATE_HZ;
        SpeedProfile { speeds_m_per_s: Vec::new(), windows_each: 1, pending: (0.0, 0), rate_hz, is_too_long }
    }

    pub(crate) fn window(&mut self, window: &MotionWindow) {
        if !window.is_whole || self.is_too_long {
            return;
        }
        self.pending.0 += window.velocity_m_per_s().length();
        self.pending.1 += 1;
        if self.pending.1 < self.windows_each {
            return;
        }
        let (sum, count) = std::mem::take(&mut self.pending);
        self.speeds_m_per_s.push(sum / f64::from(count));
        if self.speeds_m_per_s.len() > MAX_SPEEDS {
            self.coarsen();
        }
    }

    fn coarsen(&mut self) {
        if self.rate_hz / 2.0 < MIN_RATE_HZ {
            (self.speeds_m_per_s, self.is_too_long) = (Vec::new(), true);
            return;
        }
        // One is left over: MAX_SPEEDS is even.
        let (pairs, last) = self.speeds_m_per_s.as_chunks::<2>();
        self.pending =
            (last.iter().sum::<f64>() * f64::from(self.windows_each), u32::from(!last.is_empty()) * self.windows_each);
        self.speeds_m_per_s = pairs.iter().map(|[a, b]| (a + b) / 2.0).collect();
        (self.windows_each, self.rate_hz) = (2 * self.windows_each, self.rate_hz / 2.0);
    }

    pub(crate) fn figures(&self, figures: &mut Figures) {
        figures.add(&SPARC, arc_length(&self.speeds_m_per_s, self.rate_hz));
    }
}

/// Returns the spectral arc length of speeds, `rate_hz` in a second; `None` without a movement.
#[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
fn arc_length(speeds: &[f64], rate_hz: f64) -> Option<f64> {
    let length = speeds.len().checked_next_power_of_two().filter(|_| speeds.len() > 1)? << PADDING;
    let step_hz = rate_hz / length as f64;
    let count = (CUTOFF_HZ / step_hz) as usize + 1;
    // No speed is negative, so that frequency 0 has the largest magnitude.
    let spectrum = magnitudes(speeds, length, count.min(length / 2 + 1));
    let largest = spectrum.iter().copied().fold(0.0, f64::max);
    let last = spectrum.iter().rposition(|magnitude| *magnitude >= MIN_MAGNITUDE * largest)?;
    if largest == 0.0 || last == 0 {
        return None;
    }
    let along = 1.0 / last as f64;
    let length_of = |pair: &[f64]| {
        let rise = (pair[1] - pair[0]) / largest;
        (along * along + rise * rise).sqrt()
    };
    Some(-spectrum[..=last].windows(2).map(length_of).sum::<f64>())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use glam::DVec3;

    use super::*;
    use crate::tool::tests::{figure, least_jerk, moved};

    #[test]
    fn a_bell_and_a_least_jerk_movement_have_the_arc_lengths_of_the_published_program() {
        let bell = |k: i32| {
            let time_s = -1.0 + f64::from(k) * 0.01;
            libm::exp(-5.0 * time_s * time_s)
        };
        let value = arc_length(&(0..200).map(bell).collect::<Vec<_>>(), 100.0).unwrap();
        // The example in its documentation.
        assert!((value + 1.414_03).abs() < 1e-5, "{value}");
        let value = figure(&moved(1000, |time_s| 0.1 * DVec3::X * least_jerk(time_s)), "sparc").unwrap();
        // That of the program for these 100 speeds.
        assert!((value + 1.405_845_85).abs() < 1e-6, "{value}");
    }

    #[test]
    fn a_long_use_is_coarsened_without_a_step_and_a_longer_one_has_no_figure() {
        let speed = |k: usize| 0.1 + 0.05 * libm::sin(k as f64 * 0.01);
        let mut profile = SpeedProfile::new(100.0);
        let window = |k: usize| MotionWindow {
            time_s: 0.01,
            is_whole: true,
            way_m: DVec3::X * (0.01 * speed(k)),
            force_n: DVec3::ZERO,
            touches: false,
            disc: None,
        };
        (0..=2 * MAX_SPEEDS + 3).for_each(|k| profile.window(&window(k)));
        assert_eq!((profile.windows_each, profile.rate_hz), (4, 25.0));
        assert_eq!(profile.speeds_m_per_s.len(), MAX_SPEEDS / 2 + 1);
        for (k, value) in profile.speeds_m_per_s.iter().enumerate() {
            let mean = (4 * k..4 * k + 4).map(speed).sum::<f64>() / 4.0;
            assert!((value - mean).abs() < 1e-12, "{k}: {value} {mean}");
        }
        (0..2 * MAX_SPEEDS).for_each(|k| profile.window(&window(k)));
        let mut figures = Figures::of(None);
        profile.figures(&mut figures);
        assert!(figures.list.is_empty());
    }
}
