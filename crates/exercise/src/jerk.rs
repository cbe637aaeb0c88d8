//! Smoothness by jerk: the log dimensionless jerk of a tool's movement.
//!
//! −ln(T³/v²·∫|jerk|²dt), with the time T of the movement, its peak speed v, and the jerk as the second derivative of the
//! velocity (Hogan and Sternad 2009; its logarithm in Balasubramanian et al. 2012 and 2015). The jerk is a vector, so that
//! turns count: a circle at constant speed has a jerk. Along a straight line it is the formula for the speed.
//!
//! The second differences of N velocities leave out a window at each end of the movement, where the jerk of a movement
//! from rest to rest is largest: there the nearest one is taken.

use glam::DVec3;

use crate::definition::{Figures, MeasureDefinition, Scope};
use crate::window::MotionWindow;

pub(crate) const LOG_DIMENSIONLESS_JERK: MeasureDefinition = MeasureDefinition {
    name: "log_dimensionless_jerk",
    unit: "1",
    scope: Scope::Tool,
    range: [f64::NEG_INFINITY, f64::INFINITY],
    formula: "−ln(T³/v_peak² · ∫|d²v/dt²|² dt), v the velocity in windows of 10 ms, T the time in use",
    source: "Hogan and Sternad 2009, doi:10.3200/35-09-004-RC; Balasubramanian et al. 2015, doi:10.1186/s12984-015-0090-9",
    meaning: "How smooth the movement was: larger is smoother; one least-jerk movement has −5.32, and longer ones with \
              pauses have less.",
};

/// The jerk of one tool.
#[derive(Debug, Clone, Default)]
pub(crate) struct Jerk {
    /// ∫|jerk|²dt up to the last window, m²/s⁵, without the end of the present use.
    squared: f64,
    time_s: f64,
    peak_m_per_s: f64,
    /// The last two velocities, m/s.
    before: [Option<DVec3>; 2],
    /// |jerk|²·dt of the last window of the present use.
    last: Option<f64>,
}

impl Jerk {
    /// Ends a use of the tool.
    pub(crate) fn end(&mut self) {
        self.squared += self.last.unwrap_or_default();
        (self.before, self.last) = ([None; 2], None);
    }

    pub(crate) fn window(&mut self, window: &MotionWindow) {
        if !window.is_whole {
            return;
        }
        let velocity = window.velocity_m_per_s();
        self.time_s += window.time_s;
        self.peak_m_per_s = self.peak_m_per_s.max(velocity.length());
        if let [Some(first), Some(second)] = self.before {
            let jerk = (first - 2.0 * second + velocity) / (window.time_s * window.time_s);
            let squared = jerk.length_squared() * window.time_s;
            self.squared += if self.last.is_none() { 2.0 * squared } else { squared };
            self.last = Some(squared);
        }
        self.before = [self.before[1], Some(velocity)];
    }

    pub(crate) fn figures(&self, figures: &mut Figures) {
        let scale = self.time_s * self.time_s * self.time_s / (self.peak_m_per_s * self.peak_m_per_s);
        let dimensionless = scale * (self.squared + self.last.unwrap_or_default());
        figures.add(&LOG_DIMENSIONLESS_JERK, (dimensionless > 0.0).then(|| -libm::log(dimensionless)));
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::tool::tests::{figure, least_jerk, moved};

    #[test]
    fn a_least_jerk_movement_has_the_log_dimensionless_jerk_of_its_formula() {
        // T³/v² · ∫jerk² = 720/1.875².
        let expected = -libm::log(204.8);
        let direction = DVec3::new(0.06, 0.0, 0.08);
        let value =
            figure(&moved(2000, |time_s| direction * least_jerk(time_s / 2.0)), "log_dimensionless_jerk").unwrap();
        assert!((value / expected - 1.0).abs() < 1e-3, "{value} instead of {expected}");
    }

    #[test]
    fn a_bell_of_speed_has_the_log_dimensionless_jerk_of_the_published_program() {
        let mut jerk = Jerk::default();
        for k in 0..200 {
            let time_s = -1.0 + f64::from(k) * 0.01;
            let speed = libm::exp(-5.0 * time_s * time_s);
            let way_m = 0.01 * speed * DVec3::Y;
            let (force_n, disc) = (DVec3::ZERO, None);
            jerk.window(&MotionWindow { time_s: 0.01, is_whole: true, way_m, force_n, touches: false, disc });
        }
        let mut figures = Figures::of(None);
        jerk.figures(&mut figures);
        // The example in its documentation.
        assert!((figures.list[0].value + 5.816_36).abs() < 1e-3, "{}", figures.list[0].value);
    }
}
