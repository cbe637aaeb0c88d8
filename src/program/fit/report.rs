//! The result of `palpate fit`, as a table and as JSON.

use std::fmt::{self, Display};

use palpate_fitting::curve_file::MeasuredCurve;
use palpate_fitting::fit::Fit;
use palpate_fitting::scene_text::rounded;
use palpate_refusal::printable::{printable, printable_json};
use palpate_tissue::scene::Named;
use serde::Serialize;

use crate::program::Failure;

/// The result of a fit.
#[derive(Serialize)]
pub(super) struct FitReport {
    scene: String,
    parameters: Vec<ReportedParameter>,
    /// What the curves can't tell.
    untold: Vec<ReportedUntold>,
    /// Between the parameters, in their order.
    correlations: Vec<Vec<f64>>,
    /// Root of the mean square of fitted − measured.
    residual_n: f64,
    /// The same divided by the largest force.
    relative_residual: f64,
    r_squared: f64,
    /// Between a residual and the next; 0 if it is within what chance makes.
    autocorrelation: f64,
    curves: Vec<ReportedCurve>,
    runs: u64,
    wall_s: f64,
    warnings: Vec<String>,
}

#[derive(Serialize)]
struct ReportedParameter {
    name: &'static str,
    unit: &'static str,
    value: f64,
    /// The ends of the 95 % interval.
    low: f64,
    high: f64,
    /// The value of the given scene.
    start: f64,
}

#[derive(Serialize)]
struct ReportedUntold {
    name: &'static str,
    unit: &'static str,
    /// The value of the scene, which stays.
    value: f64,
    reason: String,
}

#[derive(Serialize)]
struct ReportedCurve {
    name: String,
    residual_n: f64,
    /// Standard deviation, from the residuals.
    noise_n: f64,
    /// At the times of the curve.
    fitted_n: Vec<f64>,
}

impl FitReport {
    pub(super) fn new(scene: &str, curves: &[MeasuredCurve], fit: &Fit, wall_s: f64) -> Self {
        let curve = |(index, curve): (usize, &MeasuredCurve)| ReportedCurve {
            name: curve.name.clone(),
            residual_n: fit.residual.rms_of_curves_n[index],
            noise_n: fit.noise_of_curves_n[index],
            fitted_n: fit.fitted_n[index].clone(),
        };
        FitReport {
            scene: scene.to_owned(),
            parameters: fit
                .parameters
                .iter()
                .map(|found| ReportedParameter {
                    name: found.parameter.name(),
                    unit: found.parameter.unit(),
                    value: found.value,
                    low: found.interval[0],
                    high: found.interval[1],
                    start: found.start,
                })
                .collect(),
            untold: fit
                .untold
                .iter()
                .map(|untold| ReportedUntold {
                    name: untold.parameter.name(),
                    unit: untold.parameter.unit(),
                    value: untold.value,
                    reason: untold.reason.clone(),
                })
                .collect(),
            correlations: fit.correlations.clone(),
            residual_n: fit.residual.rms_n,
            relative_residual: fit.residual.relative_rms,
            r_squared: fit.residual.r_squared,
            autocorrelation: fit.autocorrelation,
            curves: curves.iter().enumerate().map(curve).collect(),
            runs: fit.runs,
            wall_s,
            warnings: fit.warnings.clone(),
        }
    }

    pub(super) fn json(&self) -> Result<String, Failure> {
        let text = serde_json::to_string_pretty(self).map_err(|e| Failure::Failed(e.to_string()))?;
        Ok(printable_json(text) + "\n")
    }
}

impl Display for FitReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const NAME: usize = 34;
        writeln!(f, "{}\n", printable(&self.scene))?;
        writeln!(f, "{:NAME$}{:>12}  {:>26}  {:8}{:>12}", "parameter", "value", "95 % interval", "unit", "before")?;
        for ReportedParameter { name, unit, value, low, high, start } in &self.parameters {
            let [value, low, high, start] = [value, low, high, start].map(|number| rounded(*number));
            writeln!(f, "{name:NAME$}{value:>12}  {:>26}  {unit:8}{start:>12}", format!("{low} to {high}"))?;
        }
        for ReportedUntold { name, unit, value, reason } in &self.untold {
            writeln!(f, "{name:NAME$}{:>12}  {:>26}  {unit:8}", rounded(*value), "not fitted")?;
            writeln!(f, "    {}", printable(reason))?;
        }
        if self.parameters.len() > 1 {
            writeln!(f, "\ncorrelation")?;
            for (index, (row, ReportedParameter { name, .. })) in
                self.correlations.iter().zip(&self.parameters).enumerate()
            {
                let row: String = row[..=index].iter().map(|value| format!("{value:>8.3}")).collect();
                writeln!(f, "{name:NAME$}{row}")?;
            }
        }
        let (residual_n, percent) = (self.residual_n, 100.0 * self.relative_residual);
        writeln!(f, "\nresidual  {residual_n:.3e} N, {percent:.2} % of the largest force; R² {:.5}", self.r_squared)?;
        for ReportedCurve { name, residual_n, .. } in self.curves.iter().filter(|_| self.curves.len() > 1) {
            writeln!(f, "  {residual_n:.3e} N  {}", printable(name))?;
        }
        writeln!(f, "runs      {} in {:.1} s", self.runs, self.wall_s)
    }
}
