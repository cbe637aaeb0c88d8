//! A fit: the parameters of a tissue with which runs of it give the forces that were measured.
//!
//! **What is searched.** Each parameter on its [`Scale`], together, for the least squares of the forces of all curves. The search begins
//! where a linear problem ends: the force of a slow press grows in proportion to all stiffnesses, and what viscosity, damping and
//! branches add in proportion to them; one run for each tells all of these at once.
//!
//! **What is refused.** A parameter that the data can't tell, by its 95 % interval ([`Scale::is_too_wide`]): refused if it was asked for;
//! otherwise it keeps the value of the scene, and the others are fitted again.

use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use nalgebra::{DMatrix, DVector};
use palpate_refusal::{Reason, Refusal};
use palpate_session::simulation::SimulationFailure;
use palpate_tissue::Model;
use palpate_tissue::limits::Limits;
use palpate_tissue::scene::tissue_parameter::TissueParameter;
use palpate_tissue::scene::{Named, Scene};

use super::curve_file::MeasuredCurve;
use super::parallel::in_parallel;
use super::scale::Scale;
use super::search::{Minimum, minimize};
use super::uncertainty::Uncertainty;

/// The part of the largest force by which runs err at least: the noise of a measurement counts as no smaller.
const RUNS_ERR: f64 = 1e-3;

/// How many times a parameter is multiplied to see what it adds to the force, until that is this part of the force: what is smaller
/// drowns in the errors of runs.
const MULTIPLES: [f64; 3] = [4.0, 40.0, 400.0];
const SEEN: f64 = 0.02;

/// How many times the substeps of the given scene a run may have: a stiffer or more viscous tissue is not looked at.
const MAX_SLOWER: u32 = 32;

/// A correlation from which two parameters are named as told only together.
const TOGETHER: f64 = 0.95;

/// What to fit, and how.
pub struct FitOptions<'o> {
    /// The parameters; empty for those that the scene has, above 0, and the data can tell.
    pub parameters: &'o [TissueParameter],
    /// Threads of runs, at least 1. Without effect on the result.
    pub threads: usize,
    /// Limits of the runs.
    pub limits: &'o Limits,
    /// Ends the fit soon after another thread sets it.
    pub stop: &'o AtomicBool,
}

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
    /// The root of the mean square of fitted − measured, N: of all samples, and of each curve.
    pub rms_n: f64,
    /// The same of each curve, N.
    pub rms_of_curves_n: Vec<f64>,
    /// `rms_n` divided by the largest measured force.
    pub relative_rms: f64,
    /// 1 − Σ(fitted − measured)²/Σ(measured − mean)²; 0 if all measured forces are equal.
    pub r_squared: f64,
    /// Standard deviation of the noise of a sample, N, from the residuals.
    pub noise_n: f64,
    /// Correlation between a residual and the next one; 0 if it is within what chance makes of independent ones.
    pub autocorrelation: f64,
    /// Curves that were run: each counts as often as it was.
    pub runs: u64,
    /// Warnings, as sentences.
    pub warnings: Vec<String>,
}

/// How far a fit is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitProgress {
    /// Curves that were run so far.
    pub runs: u64,
    /// The smallest residual so far, N (root of the mean square); `None` before the first.
    pub rms_n: Option<f64>,
}

/// What is fitted now: a parameter, where it began, and its scale.
#[derive(Debug, Clone, Copy)]
struct Active {
    parameter: TissueParameter,
    start: f64,
    scale: Scale,
}

struct Fitter<'f> {
    model: &'f Arc<Model>,
    curves: &'f [MeasuredCurve],
    options: &'f FitOptions<'f>,
    measured: Vec<f64>,
    /// The scene with the values of what is not fitted.
    scene: Scene,
    progress: &'f mut dyn FnMut(FitProgress),
    runs: u64,
    rms_n: Option<f64>,
}

/// Fits parameters of the scene of `model` to curves. The sums of squares and the intervals are those of equal, independent errors of
/// all forces; if neighbouring residuals are correlated, the intervals are wider for it. Blocks for many runs.
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
    Fitter { model, curves, options, measured, scene, progress, runs: 0, rms_n: None }.fit(active)
}

impl Fitter<'_> {
    fn fit(mut self, mut names: Vec<TissueParameter>) -> Result<Fit, SimulationFailure> {
        let original = self.scene.clone();
        let mut untold = Vec::new();
        loop {
            let active = self.begin(&names)?;
            let (minimum, uncertainty) = self.minimum(&active)?;
            let is_untold =
                |index: &usize| active[*index].scale.is_too_wide(minimum.x[*index], uncertainty.half_widths[*index]);
            let Some(last) = (0..active.len()).rev().find(is_untold) else {
                return Ok(self.finish(&original, &active, &minimum, uncertainty, untold));
            };
            let parameter = active[last].parameter;
            let reason = reason(&active, last, &minimum, &uncertainty);
            if !self.options.parameters.is_empty() {
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

    /// Runs all curves with other values of the parameters. `None` where the tissue can't be stepped, or does not bear the presses.
    fn predict(&mut self, active: &[Active], places: &[Vec<f64>]) -> Result<Vec<Option<Vec<f64>>>, SimulationFailure> {
        let FitOptions { threads, limits, stop, .. } = *self.options;
        // A value that no tissue has, such as the time of a branch below a millisecond, has no forces.
        let scenes: Vec<Option<Scene>> = places.iter().map(|x| self.scene_at(active, x).ok()).collect();
        let most = self.model.plan.substeps.saturating_mul(MAX_SLOWER).min(limits.substeps);
        let narrower = Limits { substeps: most, ..limits.clone() };
        let compile = |number: usize| scenes[number].as_ref().map(|scene| self.model.compile_alike(scene, &narrower));
        let models = in_parallel(threads, scenes.len(), compile, || {});
        let models = models.into_iter().map(|model| match model {
            Some(None) => Ok(None),
            Some(Some(Err(refusal))) if [Reason::TooLarge, Reason::OutOfRange].contains(&refusal.reason) => Ok(None),
            Some(Some(model)) => model.map(Some),
            None => Err(no_threads()),
        });
        let models = models.collect::<Result<Vec<Option<Arc<Model>>>, Refusal>>()?;
        let curves = self.curves;
        let run = |job: usize| {
            let model = models[job / curves.len()].as_ref();
            model.map(|model| curves[job % curves.len()].press.forces_n(model, limits, stop))
        };
        let (runs, rms_n, progress) = (&mut self.runs, self.rms_n, &mut self.progress);
        let forces = in_parallel(threads, models.len() * curves.len(), run, || {
            *runs += 1;
            progress(FitProgress { runs: *runs, rms_n });
        });
        let mut predicted = Vec::with_capacity(places.len());
        for of_curves in forces.chunks(curves.len()) {
            let mut joined = Some(Vec::with_capacity(self.measured.len()));
            for forces_n in of_curves {
                match forces_n {
                    None => return Err(no_threads().into()),
                    Some(Some(Ok(forces_n))) => {
                        if let Some(joined) = &mut joined {
                            joined.extend_from_slice(forces_n);
                        }
                    }
                    Some(None | Some(Err(SimulationFailure::Held(_)))) => joined = None,
                    Some(Some(Err(SimulationFailure::Refused(refusal)))) => return Err(refusal.clone().into()),
                    Some(Some(Err(SimulationFailure::Output(_)))) => joined = None,
                }
            }
            if let Some(joined) = &joined {
                let rms_n = rms(&residuals(joined, &self.measured));
                self.rms_n = Some(self.rms_n.map_or(rms_n, |before| before.min(rms_n)));
            }
            predicted.push(joined);
        }
        Ok(predicted)
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
        let Some(here) = self.predict(&active, &[vec![0.0; active.len()]])?.pop().flatten() else {
            let message = "the tissue of the scene does not bear these presses: begin with a softer or less viscous one, or press less deep";
            return Err(SimulationFailure::Held(message.to_owned()));
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
                let mut x = vec![0.0; active.len()];
                x[moving[*unseen]] = multiple.ln();
                x
            };
            let predicted = self.predict(&active, &unseen.iter().map(place).collect::<Vec<_>>())?;
            let tried = std::mem::take(&mut unseen);
            for (number, more) in tried.into_iter().zip(predicted) {
                let Some(more) = more else { continue };
                let added = residuals(&more, &here);
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
        let Some(factors) = least_squares(&columns, &self.measured, is_stiffness_open) else { return Ok(active) };
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

    fn minimum(&mut self, active: &[Active]) -> Result<(Minimum, Uncertainty), SimulationFailure> {
        let steps: Vec<[f64; 2]> = active.iter().map(|active| active.scale.step(active.parameter)).collect();
        let measured = self.measured.clone();
        let lengths: Vec<usize> = self.curves.iter().map(|curve| curve.force_n.len()).collect();
        let found = minimize(&measured, &steps, &mut |places: &[Vec<f64>]| self.predict(active, places))?;
        let Some(minimum) = found else {
            let message = "the tissue does not bear these presses where the search begins: a part of its stiffness may follow from something else";
            return Err(SimulationFailure::Held(message.to_owned()));
        };
        let largest_n = measured.iter().fold(0.0_f64, |largest, force_n| largest.max(force_n.abs()));
        let residuals = residuals(&minimum.predicted, &measured);
        let uncertainty = Uncertainty::of(&minimum.jacobian, &residuals, &lengths, RUNS_ERR * largest_n);
        Ok((minimum, uncertainty))
    }

    #[allow(clippy::cast_precision_loss)]
    fn finish(
        self,
        original: &Scene,
        active: &[Active],
        minimum: &Minimum,
        uncertainty: Uncertainty,
        untold: Vec<UntoldParameter>,
    ) -> Fit {
        let Fitter { curves, measured, runs, .. } = &self;
        let all = residuals(&minimum.predicted, measured);
        let (mut fitted_n, mut rms_of_curves_n, mut begin) = (Vec::new(), Vec::new(), 0);
        for curve in *curves {
            let range = begin..begin + curve.force_n.len();
            fitted_n.push(minimum.predicted[range.clone()].to_vec());
            rms_of_curves_n.push(rms(&all[range.clone()]));
            begin = range.end;
        }
        let mean_n = measured.iter().sum::<f64>() / measured.len() as f64;
        let spread: f64 = measured.iter().map(|force_n| (force_n - mean_n).powi(2)).sum();
        let squares: f64 = all.iter().map(|residual| residual * residual).sum();
        let largest_n = measured.iter().fold(0.0_f64, |largest, force_n| largest.max(force_n.abs()));
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
        Fit {
            scene: self.scene_at(active, &minimum.x).unwrap_or_else(|_| original.clone()),
            parameters: active.iter().enumerate().map(parameter).collect(),
            untold,
            correlations: uncertainty.correlations,
            fitted_n,
            rms_n: rms(&all),
            rms_of_curves_n,
            relative_rms: rms(&all) / largest_n,
            r_squared: if spread > 0.0 { 1.0 - squares / spread } else { 0.0 },
            noise_n: uncertainty.noise,
            autocorrelation: uncertainty.autocorrelation,
            runs: *runs,
            warnings,
        }
    }
}

fn no_threads() -> Refusal {
    Refusal::new(Reason::NotAvailable, "", "no thread could be started")
}

fn residuals(predicted: &[f64], measured: &[f64]) -> Vec<f64> {
    predicted.iter().zip(measured).map(|(predicted, measured)| predicted - measured).collect()
}

#[allow(clippy::cast_precision_loss)]
fn rms(values: &[f64]) -> f64 {
    (values.iter().map(|value| value * value).sum::<f64>() / values.len().max(1) as f64).sqrt()
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
    let interval = if half_width.is_finite() {
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
