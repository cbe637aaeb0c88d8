//! The force of a tool: peak, mean, integral, derivative, pressure, indentation, strain, work, and the shares above limits.
//!
//! A row holds for the step that it ends, so that a force that is constant over each step has an exact integral. Work
//! uses the mean of the forces at both ends of a step.

use glam::DVec3;

use crate::definition::{Figures, MeasureDefinition, Scope};
use crate::input::ToolRow;
use crate::limit::{LimitKind, ToolLimits};
use crate::window::MotionWindow;

const TREJOS: &str = "Trejos et al. 2014, doi:10.1007/s00464-014-3442-9";

const fn of_force(
    name: &'static str,
    unit: &'static str,
    formula: &'static str,
    source: &'static str,
    meaning: &'static str,
) -> MeasureDefinition {
    MeasureDefinition { name, unit, scope: Scope::Both, range: [0.0, f64::INFINITY], formula, source, meaning }
}

pub(crate) const PEAK_FORCE: MeasureDefinition =
    of_force("peak_force_n", "N", "max |F| over the steps in contact", TREJOS, "How strong the tool was at most.");

pub(crate) const MEAN_FORCE: MeasureDefinition = of_force(
    "mean_force_n",
    "N",
    "∫|F|dt divided by the contact time",
    TREJOS,
    "How strong the tool was on average while it touched the tissue.",
);

pub(crate) const FORCE_INTEGRAL: MeasureDefinition = of_force(
    "force_integral_n_s",
    "N·s",
    "∫|F|dt over the steps in contact; of all tools, the sum",
    TREJOS,
    "How strong and how long: of all measures, this and the derivative follow experience best.",
);

pub(crate) const FORCE_DERIVATIVE: MeasureDefinition = MeasureDefinition {
    scope: Scope::Tool,
    ..of_force(
        "force_derivative_rms_n_per_s",
        "N/s",
        "√(mean of |ΔF/Δt|²) over successive windows of 10 ms with contact in either, F the mean force of a window",
        TREJOS,
        "How abruptly the force changed: experts are steadier.",
    )
};

pub(crate) const PEAK_PRESSURE: MeasureDefinition = of_force(
    "peak_pressure_pa",
    "Pa",
    "max of F·n/(πr²) in contact, n the normal of the surface and r the radius of the tip",
    "Palpate",
    "How hard a place was pressed at most.",
);

pub(crate) const PEAK_INDENTATION: MeasureDefinition = of_force(
    "peak_indentation_m",
    "m",
    "max over the steps in contact of how far the tissue under the tool is in from rest",
    "Palpate",
    "How deep the tissue was pressed at most.",
);

pub(crate) const PEAK_STRAIN: MeasureDefinition = of_force(
    "peak_strain",
    "1",
    "max of (L − L₀)/L₀ over the steps in contact, of what joins neighbours of the tissue within two radii of the tip",
    "Palpate",
    "How far the tissue near a tool was stretched at most.",
);

pub(crate) const WORK: MeasureDefinition = MeasureDefinition {
    range: [f64::NEG_INFINITY, f64::INFINITY],
    ..of_force(
        "work_j",
        "J",
        "−Σ ½(F₀ + F₁)·Δx over the steps, F the force of the tissue on the tool; of all tools, the sum",
        "Palpate",
        "What the tissue got: what it has not given back was lost in it.",
    )
};

/// The force of one tool.
#[derive(Debug, Clone, Default)]
pub(crate) struct ForceMeasures {
    peak_n: f64,
    /// Σ |F| over the steps in contact, N.
    sum_n: f64,
    /// Number of steps above each limit, in the order of [`LimitKind::ALL`].
    steps_above: [u64; 3],
    peak_strain: Option<f64>,
    peak_pa: Option<f64>,
    peak_indentation_m: Option<f64>,
    work_j: f64,
    /// Place, m, and force, N, at the end of the step before.
    before: Option<(DVec3, DVec3)>,
    /// Σ |ΔF|², N², and the number of differences; the last mean force, N, and whether there was contact.
    derivative: (f64, u64),
    last: Option<(DVec3, bool)>,
    window_s: f64,
}

impl ForceMeasures {
    /// Begins a use of the tool.
    pub(crate) fn begin(&mut self) {
        (self.before, self.last) = (None, None);
    }

    /// Takes the row at the beginning, which ends no step.
    pub(crate) fn place(&mut self, row: &ToolRow) {
        self.before = Some((row.place_m, row.force_n));
    }

    pub(crate) fn step(&mut self, row: &ToolRow, limits: ToolLimits) {
        if let Some((place_m, force_n)) = self.before {
            self.work_j -= (0.5 * (force_n + row.force_n)).dot(row.place_m - place_m);
        }
        self.before = Some((row.place_m, row.force_n));
        if !row.is_in_contact {
            return;
        }
        let force_n = row.force_n.length();
        self.peak_n = self.peak_n.max(force_n);
        self.sum_n += force_n;
        for (kind, limit) in limits.given() {
            self.steps_above[kind as usize] += u64::from(row.limited(kind) > limit);
        }
        self.peak_strain = larger(self.peak_strain, row.strain);
        self.peak_indentation_m = larger(self.peak_indentation_m, Some(row.indentation_m.max(0.0)));
        self.peak_pa = larger(self.peak_pa, row.disc.map(|disc| disc.pressure_pa));
    }

    pub(crate) fn window(&mut self, window: &MotionWindow) {
        if !window.is_whole {
            self.last = None;
            return;
        }
        self.window_s = window.time_s;
        if let Some((before_n, touched)) = self.last
            && (touched || window.touches)
        {
            self.derivative.0 += (window.force_n - before_n).length_squared();
            self.derivative.1 += 1;
        }
        self.last = Some((window.force_n, window.touches));
    }

    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn figures(&self, contact_steps: u64, rate_hz: f64, limits: ToolLimits, figures: &mut Figures) {
        let of_contact = |sum: f64| (contact_steps > 0).then(|| sum / contact_steps as f64);
        figures.add(&PEAK_FORCE, self.peak_n);
        figures.add(&MEAN_FORCE, of_contact(self.sum_n));
        figures.add(&FORCE_INTEGRAL, self.sum_n / rate_hz);
        let (squared, count) = self.derivative;
        figures.add(&FORCE_DERIVATIVE, (count > 0).then(|| (squared / count as f64).sqrt() / self.window_s));
        for (kind, _) in limits.given() {
            figures.add(kind.share(), of_contact(self.steps_above[kind as usize] as f64));
        }
        figures.add(&PEAK_PRESSURE, self.peak_pa);
        figures.add(&PEAK_INDENTATION, self.peak_indentation_m);
        figures.add(&PEAK_STRAIN, self.peak_strain);
        figures.add(&WORK, self.work_j);
    }

    /// Adds another tool's: its sums, and its peaks if they are larger.
    pub(crate) fn join(&mut self, other: &ForceMeasures) {
        self.peak_n = self.peak_n.max(other.peak_n);
        self.sum_n += other.sum_n;
        self.steps_above =
            LimitKind::ALL.map(|kind| self.steps_above[kind as usize] + other.steps_above[kind as usize]);
        self.peak_strain = larger(self.peak_strain, other.peak_strain);
        self.peak_pa = larger(self.peak_pa, other.peak_pa);
        self.peak_indentation_m = larger(self.peak_indentation_m, other.peak_indentation_m);
        self.work_j += other.work_j;
    }
}

/// Returns the larger value of the two; the other one if one is `None`.
fn larger(a: Option<f64>, b: Option<f64>) -> Option<f64> {
    a.zip(b).map(|(a, b)| a.max(b)).or(a).or(b)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::input::{MeasureOptions, PressedDisc};
    use crate::tool::tests::{figure, pressed, row};

    #[test]
    fn a_step_of_force_has_its_integral_mean_and_share_above_the_limit() {
        let limits = ToolLimits { force_n: Some(1.5), ..ToolLimits::default() };
        let options = MeasureOptions { limits, ..MeasureOptions::default() };
        // 0.5 s of nothing, 1 s of 1 N, 0.5 s of 2 N.
        let tool = pressed(&options, 2000, |step| {
            let force_n = if step <= 500 {
                0.0
            } else if step <= 1500 {
                1.0
            } else {
                2.0
            };
            ToolRow { force_n: force_n * DVec3::Z, is_in_contact: step > 500, ..row(DVec3::ZERO) }
        });
        for (name, expected) in [
            ("contact_time_s", 1.5),
            ("peak_force_n", 2.0),
            ("force_integral_n_s", 2.0),
            ("mean_force_n", 2.0 / 1.5),
            ("force_above_limit_share", 1.0 / 3.0),
            ("work_j", 0.0),
        ] {
            let value = figure(&tool, name).unwrap();
            assert!((value - expected).abs() < 1e-9, "{name}: {value} instead of {expected}");
        }
        // One step of a window of 10 ms from 0 to 1 N, and one from 1 to 2 N, of 150 differences.
        let expected = libm::sqrt(2.0 / 150.0) / 0.01;
        let value = figure(&tool, "force_derivative_rms_n_per_s").unwrap();
        assert!((value / expected - 1.0).abs() < 1e-3, "{value} instead of {expected}");
    }

    #[test]
    fn the_work_on_a_spring_is_its_energy_and_the_pressure_that_of_its_area() {
        let (stiffness_n_per_m, radius_m) = (200.0, 0.005);
        let tool = pressed(&MeasureOptions::default(), 300, |step| {
            let depth_m = 0.004 * f64::from(step) / 300.0;
            let force_n = stiffness_n_per_m * depth_m;
            let pressure_pa = force_n / (std::f64::consts::PI * radius_m * radius_m);
            let disc = Some(PressedDisc { rest_m: DVec3::ZERO, normal: DVec3::Z, radius_m, pressure_pa });
            let place_m = -depth_m * DVec3::Z;
            ToolRow { force_n: force_n * DVec3::Z, is_in_contact: true, indentation_m: depth_m, disc, ..row(place_m) }
        });
        let near = |name: &str, expected: f64| {
            let value = figure(&tool, name).unwrap();
            assert!((value / expected - 1.0).abs() < 1e-9, "{name}: {value} instead of {expected}");
        };
        near("work_j", 0.5 * stiffness_n_per_m * 0.004 * 0.004);
        near("peak_pressure_pa", 0.8 / (std::f64::consts::PI * 2.5e-5));
        near("peak_indentation_m", 0.004);
    }

    #[test]
    fn pressure_and_strain_have_their_peaks_and_their_shares_above_the_limits() {
        let limits = ToolLimits { force_n: None, pressure_pa: Some(3000.0), strain: Some(0.2) };
        let options = MeasureOptions { limits, ..MeasureOptions::default() };
        // Half a wave of 4 s, the same in pressure and strain, with contact in its second half.
        let part = |step: u32| libm::sin(std::f64::consts::PI * f64::from(step) / 4000.0);
        let tool = pressed(&options, 4000, |step| {
            let pressure_pa = 6000.0 * part(step);
            let disc = Some(PressedDisc { rest_m: DVec3::ZERO, normal: DVec3::Z, radius_m: 0.005, pressure_pa });
            ToolRow { is_in_contact: step > 2000, disc, strain: Some(0.22 * part(step)), ..row(DVec3::ZERO) }
        });
        // The wave falls below 3000/6000 at 5/6 of its time, and below 0.2/0.22 at 1 − asin(0.2/0.22)/π of it.
        let strained = 0.5 - libm::asin(0.2 / 0.22) / std::f64::consts::PI;
        for (name, expected) in [
            ("peak_pressure_pa", 6000.0),
            ("peak_strain", 0.22),
            ("pressure_above_limit_share", (5.0 / 6.0 - 0.5) / 0.5),
            ("strain_above_limit_share", strained / 0.5),
        ] {
            let value = figure(&tool, name).unwrap();
            assert!((value - expected).abs() < 1e-3 * expected.max(1.0), "{name}: {value} instead of {expected}");
        }
        assert_eq!(figure(&tool, "force_above_limit_share"), None);
        let told: Vec<_> =
            tool.timeline().crossings().iter().map(|crossing| (crossing.limit, crossing.steps)).collect();
        // The contact begins above both limits.
        assert!(
            matches!(told[..], [(LimitKind::Pressure, [2001, 3333]), (LimitKind::Strain, [2001, 2547])]),
            "{told:?}"
        );
    }

    #[test]
    fn white_noise_has_the_derivative_of_its_variance() {
        // A maximum-length sequence has the autocorrelation of white noise: 1, and −1/32767 for any other lag. Ten of
        // its periods meet the windows in each phase.
        let (level_n, period) = (0.6, 32_767);
        let mut register = 1_u32;
        let tool = pressed(&MeasureOptions::default(), 10 * period, |_| {
            register = (register >> 1) | ((register ^ (register >> 1)) & 1) << 14;
            let noise_n = if register & 1 == 1 { level_n } else { -level_n };
            ToolRow { force_n: DVec3::new(0.0, noise_n, 5.0), is_in_contact: true, ..row(DVec3::ZERO) }
        });
        // Means of 10 steps have a tenth of the variance, differences of two of these twice that.
        let expected = libm::sqrt(2.0 * level_n * level_n / 10.0) / 0.01;
        let value = figure(&tool, "force_derivative_rms_n_per_s").unwrap();
        assert!((value / expected - 1.0).abs() < 1e-3, "{value} instead of {expected}");
    }
}
