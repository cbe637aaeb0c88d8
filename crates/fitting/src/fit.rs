//! A fit: the parameters of a tissue with which runs of it give the forces that were measured.
//!
//! **What is searched.** Each parameter on its [`Scale`], together, for the least squares of the forces of all curves. The search begins
//! where a linear problem ends: the force of a slow press grows in proportion to all stiffnesses, and what viscosity, damping and
//! branches add in proportion to them; one run for each tells all of these at once.
//!
//! **Noise.** First that of all samples counts as the same. If the residuals of curves differ by more than chance makes, each curve has its
//! own, and the search goes on with samples weighted by it, until the noise stays.
//!
//! **What is refused.** A parameter that the data can't tell, by its 95 % interval ([`Scale::is_too_wide`]): refused if it was asked for;
//! otherwise it keeps the value of the scene, and the others are fitted again.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use palpate_refusal::{Reason, Refusal};
use palpate_session::simulation::SimulationFailure;
use palpate_tissue::Model;
use palpate_tissue::scene::tissue_parameter::TissueParameter;
use palpate_tissue::scene::{Named, Scene};

use super::curve_file::MeasuredCurve;
use super::noise::{noise_of_curves, weights};
use super::options::{FitOptions, FitProgress};
use super::residual::{Residual, differences, rms};
use super::runs::Runs;
use super::scale::Scale;
use super::search::{Minimum, WeightedSamples, minimize};
use super::uncertainty::{MeasuredSamples, Uncertainty};

/// The part of the largest force by which runs err at least: the noise of a measurement counts as no smaller.
const RUNS_ERR: f64 = 1e-3;

/// How many times a parameter is multiplied to see what it adds to the force, until that is this part of the force: what is smaller
/// drowns in the errors of runs.
const MULTIPLES: [f64; 3] = [4.0, 40.0, 400.0];
const SEEN: f64 = 0.02;

/// What runs err by is this many times what changes with half the substeps: it falls in proportion to their length at least.
const FINER: f64 = 2.0;

/// The part of an interval from which on a warning names the error of runs in it.
const NAMED: f64 = 0.5;

/// Rounds in which the noise of the curves is estimated again, at most; and the factor within which it stays.
const ROUNDS: usize = 4;
const STAYS: f64 = 1.2;

/// A correlation from which two parameters are named as told only together.
const TOGETHER: f64 = 0.95;

/// A fitted parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FittedParameter {
    /// The parameter.
    pub parameter: TissueParameter,
    /// Its value before, in the unit of [`TissueParameter::unit`].
    pub start: f64,
    /// The value with the least squares.
    pub value: f64,
    /// The 95 % interval, from its lower to its upper end.
    pub interval: [f64; 2],
}

/// A parameter that the data can't tell.
#[derive(Debug, Clone, PartialEq)]
pub struct UntoldParameter {
    /// The parameter, which keeps its value.
    pub parameter: TissueParameter,
    /// Its value.
    pub value: f64,
    /// Why, and what measurement would tell it, as a sentence.
    pub reason: String,
}

/// The result of a fit.
#[derive(Debug, Clone)]
pub struct Fit {
    /// The scene with the fitted values.
    pub scene: Scene,
    /// The fitted parameters, in the order of [`Named::NAMES`].
    pub parameters: Vec<FittedParameter>,
    /// The parameters that the data can't tell, of those that the scene has.
    pub untold: Vec<UntoldParameter>,
    /// Correlation between the errors of each two fitted parameters, by rows.
    pub correlations: Vec<Vec<f64>>,
    /// The forces of the fitted tissue at the samples of each curve, N.
    pub fitted_n: Vec<Vec<f64>>,
    /// What is between these and the measured ones.
    pub residual: Residual,
    /// Standard deviation of the noise of a sample of each curve, N, from the residuals: equal unless these differ by more than chance
    /// makes.
    pub noise_of_curves_n: Vec<f64>,
    /// Correlation between a residual and the next one; 0 if it is within what chance makes of independent ones.
    pub autocorrelation: f64,
    /// Curves that were run: each counts as often as it was.
    pub runs: u64,
    /// Warnings, as sentences.
    pub warnings: Vec<String>,
}

/// What is fitted now: a parameter, where it began, and its scale.
#[derive(Debug, Clone, Copy)]
struct Active {
    parameter: TissueParameter,
    start: f64,
    scale: Scale,
}

/// The least squares of what is fitted now.
struct LeastSquares {
    minimum: Minimum,
    uncertainty: Uncertainty,
    /// Standard deviation of the noise of each curve, N.
    noise_of_curves_n: Vec<f64>,
}

struct Fitter<'f> {
    runs: Runs<'f>,
    /// The scene with the values of what is not fitted.
    scene: Scene,
}

/// Fits parameters of the scene of `model` to curves. The sums of squares and the intervals are those of independent errors, equal in
/// each curve; if neighbouring residuals are correlated, the intervals are wider for it. Blocks for many runs.
///
/// # Errors
/// Refuses no curve, curves with fewer samples than parameters, a parameter that the scene does not have or that is 0 in it, a parameter
/// that was asked for and that the data can't tell ([`Reason::Missing`]), forces that are 0 or do not grow with the depth, a press that
/// [`ImposedPress::forces_n`](palpate_session::press::ImposedPress::forces_n) refuses, and ends with [`Reason::TimedOut`] when `stop` is set.
/// [`SimulationFailure::Held`]: the given tissue does not bear the presses.
pub fn fit(
    model: &Arc<Model>,
    curves: &[MeasuredCurve],
    options: &FitOptions<'_>,
    progress: &mut dyn FnMut(FitProgress),
) -> Result<Fit, SimulationFailure> {
    let scene = model.scene.clone();
    let all = TissueParameter::of(&scene);
    if let Some(other) = options.parameters.iter().find(|parameter| !all.contains(parameter)) {
        let names: Vec<&str> = all.iter().map(|parameter| parameter.name()).collect();
        let message = format!("is none of this tissue's parameters: {}", names.join(", "));
        return Err(Refusal::new(Reason::WrongKind, other.name(), message).into());
    }
    for curve in curves {
        curve.press.check()?;
    }
    let measured: Vec<f64> = curves.iter().flat_map(|curve| curve.force_n.iter().copied()).collect();
    let wanted = |parameter: &&TissueParameter| {
        options.parameters.is_empty() && parameter.value(&scene) > Some(0.0) || options.parameters.contains(parameter)
    };
    let active: Vec<TissueParameter> = all.iter().filter(wanted).copied().collect();
    if let Some(zero) = active.iter().find(|parameter| parameter.value(&scene) <= Some(0.0)) {
        let message = "is 0 in the scene: give a value above 0, from which the search begins";
        return Err(Refusal::new(Reason::OutOfRange, zero.name(), message).into());
    }
    if measured.len() < active.len() + 3 {
        let message = format!("{} samples can't tell {} parameters", measured.len(), active.len());
        return Err(Refusal::new(Reason::Missing, "curves", message).into());
    }
    if measured.iter().all(|force_n| *force_n == 0.0) {
        return Err(Refusal::new(Reason::OutOfRange, "force_n", "is 0 in all samples").into());
    }
    let runs = Runs { model, curves, options, measured, progress, count: 0, rms_n: None, no_forces: None };
    Fitter { runs, scene }.fit(active)
}

impl Fitter<'_> {
    fn fit(mut self, mut names: Vec<TissueParameter>) -> Result<Fit, SimulationFailure> {
        let original = self.scene.clone();
        let mut untold = Vec::new();
        loop {
            let active = self.begin(&names)?;
            let found = self.minimum(&active)?;
            let LeastSquares { minimum, uncertainty, .. } = &found;
            let is_untold =
                |index: &usize| active[*index].scale.is_too_wide(minimum.x[*index], uncertainty.half_widths[*index]);
            let Some(last) = (0..active.len()).rev().find(is_untold) else {
                return self.finish(&original, &active, found, untold);
            };
            let parameter = active[last].parameter;
            let reason = reason(&active, last, minimum, uncertainty);
            if !self.runs.options.parameters.is_empty() {
                return Err(Refusal::new(Reason::Missing, parameter.name(), reason).into());
            }
            untold.push(UntoldParameter { parameter, value: parameter.value(&original).unwrap_or(0.0), reason });
            names.remove(last);
            // The others begin where they are.
            self.scene = self.scene_at(&active, &minimum.x)?;
            self.scene = parameter.set(&self.scene, parameter.value(&original).unwrap_or(0.0))?;
            if names.is_empty() {
                let reasons: Vec<String> =
                    untold.iter().map(|untold| format!("{}: {}", untold.parameter.name(), untold.reason)).collect();
                let message = format!("tell no parameter of the tissue: {}", reasons.join("; "));
                return Err(Refusal::new(Reason::Missing, "curves", message).into());
            }
        }
    }

    /// Runs all curves with other values of the parameters, stepped as at `at` ([`Runs::forces`]).
    fn predict(
        &mut self,
        active: &[Active],
        at: &[f64],
        places: &[Vec<f64>],
    ) -> Result<Vec<Option<Vec<f64>>>, SimulationFailure> {
        let scenes = places.iter().map(|x| self.scene_at(active, x)).collect();
        self.runs.forces(&self.scene_at(active, at), scenes)
    }

    fn scene_at(&self, active: &[Active], x: &[f64]) -> Result<Scene, Refusal> {
        let set = |scene: Scene, (active, x): (&Active, &f64)| active.parameter.set(&scene, active.scale.value(*x));
        active.iter().zip(x).try_fold(self.scene.clone(), set)
    }

    /// Returns where each parameter begins: at the solution of the linear problem of stiffness and of what adds by motion, if that has
    /// one.
    fn begin(&mut self, names: &[TissueParameter]) -> Result<Vec<Active>, SimulationFailure> {
        let of = |scene: &Scene, parameter: TissueParameter| {
            let start = parameter.value(scene).unwrap_or(0.0);
            Active { parameter, start, scale: Scale::of(parameter, start) }
        };
        let active: Vec<Active> = names.iter().map(|parameter| of(&self.scene, *parameter)).collect();
        let moving: Vec<usize> = (0..active.len()).filter(|index| active[*index].parameter.adds_by_motion()).collect();
        let is_stiffness_open = names.iter().any(|parameter| parameter.is_stiffness());
        if moving.is_empty() && !is_stiffness_open {
            return Ok(active);
        }
        let begun = vec![0.0; active.len()];
        let Some(here) = self.predict(&active, &begun, std::slice::from_ref(&begun))?.pop().flatten() else {
            return Err(self.runs.held(
                "the tissue of the scene does not bear these presses: begin with a softer or less viscous one, or press less deep",
            ));
        };
        if here.iter().all(|force_n| *force_n == 0.0) {
            let message =
                "are above the tissue in all samples: 0 is where the tip touches, and depth grows into the tissue";
            return Err(Refusal::new(Reason::OutOfRange, "depth_m", message).into());
        }
        // What each adds to the force where it has its value; 0 where nothing is seen.
        let mut adds = vec![vec![0.0; here.len()]; moving.len()];
        let mut unseen: Vec<usize> = (0..moving.len()).collect();
        for multiple in MULTIPLES {
            let place = |unseen: &usize| {
                let mut x = begun.clone();
                x[moving[*unseen]] = multiple.ln();
                x
            };
            let predicted = self.predict(&active, &begun, &unseen.iter().map(place).collect::<Vec<_>>())?;
            let tried = std::mem::take(&mut unseen);
            for (number, more) in tried.into_iter().zip(predicted) {
                let Some(more) = more else { continue };
                let added = differences(&more, &here);
                if rms(&added) > SEEN * rms(&here) {
                    adds[number] = added.iter().map(|added| added / (multiple - 1.0)).collect();
                } else {
                    unseen.push(number);
                }
            }
        }
        let elastic = |row: usize| here[row] - adds.iter().map(|adds| adds[row]).sum::<f64>();
        let columns = DMatrix::from_fn(here.len(), 1 + moving.len(), |row, column| {
            if column == 0 { elastic(row) } else { adds[column - 1][row] }
        });
        let Some(factors) = least_squares(&columns, &self.runs.measured, is_stiffness_open) else { return Ok(active) };
        if factors[0] <= 0.0 {
            let message = "does not grow with the depth: the force of the tissue on the tip must be above 0, outward";
            return Err(Refusal::new(Reason::OutOfRange, "force_n", message).into());
        }
        let mut scene = self.scene.clone();
        for parameter in names.iter().filter(|parameter| parameter.is_stiffness()) {
            scene = parameter.set(&scene, factors[0] * parameter.value(&scene).unwrap_or(0.0))?;
        }
        for (index, factor) in moving.iter().zip(&factors[1..]).filter(|(_, factor)| **factor > 0.1) {
            let Active { parameter, start, .. } = active[*index];
            scene = parameter.set(&scene, start * factor.min(1e3))?;
        }
        Ok(names.iter().map(|parameter| of(&scene, *parameter)).collect())
    }

    fn minimum(&mut self, active: &[Active]) -> Result<LeastSquares, SimulationFailure> {
        let steps: Vec<_> = active.iter().map(|active| active.scale.steps(active.parameter)).collect();
        let measured = self.runs.measured.clone();
        let lengths: Vec<usize> = self.runs.curves.iter().map(|curve| curve.force_n.len()).collect();
        let largest_n = measured.iter().fold(0.0_f64, |largest, force_n| largest.max(force_n.abs()));
        let least_noise = RUNS_ERR * largest_n;
        let mut noise_n = vec![1.0; lengths.len()];
        let (mut weights_of_samples, mut round, mut from) = (vec![1.0; measured.len()], 0, None);
        let minimum = loop {
            let samples = WeightedSamples { measured: &measured, weights: &weights_of_samples };
            let mut predict = |at: &[f64], places: &[Vec<f64>]| self.predict(active, at, places);
            let Some(minimum) = minimize(samples, &steps, from.take(), &mut predict)? else {
                return Err(self.runs.held(
                    "the tissue does not bear these presses where the search begins: a part of its stiffness may follow from something else",
                ));
            };
            let own_n = noise_of_curves(&differences(&minimum.predicted, &measured), &lengths, least_noise);
            let Some(own_n) = own_n.filter(|_| round < ROUNDS) else { break minimum };
            let stays = |(before, now): (&f64, &f64)| (1.0 / STAYS..STAYS).contains(&(now / before));
            if round > 0 && noise_n.iter().zip(&own_n).all(stays) {
                break minimum;
            }
            weights_of_samples = weights(&own_n, &lengths);
            (noise_n, from, round) = (own_n, Some(minimum), round + 1);
        };
        let finer = self.runs.finer(&self.scene_at(active, &minimum.x)?)?;
        let weighted = |values: &[f64]| -> Vec<f64> {
            values.iter().zip(&weights_of_samples).map(|(value, weight)| value * weight).collect()
        };
        let runs_err = finer.map(|finer| weighted(&differences(&finer, &minimum.predicted)));
        let runs_err: Option<Vec<f64>> = runs_err.map(|err| err.iter().map(|err| FINER * err).collect());
        let residuals = weighted(&differences(&minimum.predicted, &measured));
        let data = MeasuredSamples { residuals: &residuals, lengths: &lengths, least_noise };
        let mut jacobian = minimum.jacobian.clone();
        for (mut row, weight) in jacobian.row_iter_mut().zip(&weights_of_samples) {
            row *= *weight;
        }
        let uncertainty = Uncertainty::of(&jacobian, &data, runs_err.as_deref());
        let ends = lengths.iter().scan(0, |end, length| {
            *end += length;
            Some(*end)
        });
        let noise_of_curves_n = ends.map(|end| uncertainty.noise / weights_of_samples[end - 1]).collect();
        Ok(LeastSquares { minimum, uncertainty, noise_of_curves_n })
    }

    fn finish(
        self,
        original: &Scene,
        active: &[Active],
        LeastSquares { minimum, uncertainty, noise_of_curves_n }: LeastSquares,
        untold: Vec<UntoldParameter>,
    ) -> Result<Fit, SimulationFailure> {
        let Runs { curves, count, .. } = &self.runs;
        let (mut fitted_n, mut rest) = (Vec::new(), minimum.predicted.as_slice());
        for curve in *curves {
            let (of_curve, others) = rest.split_at(curve.force_n.len());
            fitted_n.push(of_curve.to_vec());
            rest = others;
        }
        let parameter = |(index, active): (usize, &Active)| {
            let (x, half_width) = (minimum.x[index], uncertainty.half_widths[index]);
            FittedParameter {
                parameter: active.parameter,
                start: active.parameter.value(original).unwrap_or(active.start),
                value: active.scale.value(x),
                interval: [x - half_width, x + half_width].map(|x| active.scale.value(x)),
            }
        };
        let mut warnings = Vec::new();
        if !minimum.converged {
            warnings.push(
                "the search was given up before it came to rest: begin nearer, or fit fewer parameters".to_owned(),
            );
        }
        if uncertainty.autocorrelation > 0.0 {
            let r = uncertainty.autocorrelation;
            warnings.push(format!(
                "neighbouring residuals are correlated (r = {r:.2}): the scene does not describe the curves to within their noise; \
                 the intervals are {:.1} times as wide for it",
                ((1.0 + r) / (1.0 - r)).sqrt()
            ));
        }
        warnings.extend(errors_of_runs(active, &uncertainty));
        Ok(Fit {
            scene: self.scene_at(active, &minimum.x)?,
            parameters: active.iter().enumerate().map(parameter).collect(),
            untold,
            correlations: uncertainty.correlations,
            residual: Residual::of(curves, &fitted_n),
            fitted_n,
            noise_of_curves_n,
            autocorrelation: uncertainty.autocorrelation,
            runs: *count,
            warnings,
        })
    }
}

/// Returns a warning if runs err by much beside the noise, or nobody knows by how much.
fn errors_of_runs(active: &[Active], uncertainty: &Uncertainty) -> Option<String> {
    let Some(shifts) = &uncertainty.shifts else {
        return Some(
            "no run with shorter substeps was possible: the intervals are without what the runs err by".to_owned(),
        );
    };
    let parts = shifts.iter().zip(&uncertainty.half_widths).map(|(shift, half_width)| shift / half_width);
    let (index, part) = parts.enumerate().max_by(|a, b| a.1.total_cmp(&b.1))?;
    (part > NAMED).then(|| {
        format!(
            "{:.0} % of the interval of {} is what runs err by, and not noise: set a smaller stepping.tolerance",
            100.0 * part,
            active[index].parameter.name()
        )
    })
}

/// Returns the factors of the columns whose sum is nearest to `measured`; that of the first is 1 unless it is open. `None` if there is
/// no solution.
fn least_squares(columns: &DMatrix<f64>, measured: &[f64], is_first_open: bool) -> Option<Vec<f64>> {
    let measured = DVector::from_column_slice(measured);
    let solve = |columns: DMatrix<f64>, measured: &DVector<f64>| {
        let norms: Vec<f64> = columns.column_iter().map(|column| column.norm().max(f64::MIN_POSITIVE)).collect();
        let scaled =
            DMatrix::from_fn(columns.nrows(), columns.ncols(), |row, column| columns[(row, column)] / norms[column]);
        let found = scaled.svd(true, true).solve(measured, 1e-6).ok()?;
        Some(found.iter().zip(&norms).map(|(factor, norm)| factor / norm).collect::<Vec<f64>>())
    };
    if is_first_open {
        return solve(columns.clone(), &measured);
    }
    let rest = columns.columns(1, columns.ncols() - 1).into_owned();
    let found = solve(rest, &(measured - columns.column(0)))?;
    Some(std::iter::once(1.0).chain(found).collect())
}

/// Returns why data can't tell a parameter, and what measurement would.
fn reason(active: &[Active], index: usize, minimum: &Minimum, uncertainty: &Uncertainty) -> String {
    let Active { parameter, scale, .. } = active[index];
    let (x, half_width) = (minimum.x[index], uncertainty.half_widths[index]);
    let others = (0..active.len()).filter(|other| *other != index);
    let together = others
        .max_by(|a, b| {
            let correlation = |other: usize| uncertainty.correlations[index][other].abs();
            correlation(*a).total_cmp(&correlation(*b))
        })
        .filter(|other| uncertainty.correlations[index][*other].abs() > TOGETHER);
    let interval = if half_width.is_nan() {
        "the tissues beside the fitted one have no forces".to_owned()
    } else if half_width.is_finite() {
        let [low, high] = [x - half_width, x + half_width].map(|x| scale.value(x));
        format!("its 95 % interval is {low:.3e} to {high:.3e} {}", parameter.unit())
    } else {
        "the forces do not depend on it".to_owned()
    };
    let along = together.map_or_else(String::new, |other| {
        format!(
            ", and the curves tell it only together with {} (correlation {:.3})",
            active[other].parameter.name(),
            uncertainty.correlations[index][other]
        )
    });
    format!("the curves can't tell it: {interval}{along}. What tells it: {}", parameter.told_by())
}
