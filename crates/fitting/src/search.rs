//! The search for the least squares (Levenberg–Marquardt), over any function from a few numbers to many.

use std::cell::{Cell, RefCell};

use levenberg_marquardt::{LeastSquaresProblem, LevenbergMarquardt};
use nalgebra::{DMatrix, DVector, Dyn, Owned};

/// The residual, in norms of the measured forces, of each sample at a place where the runs have no value.
const NO_VALUE: f64 = 1e6;

/// The part of a standard error below which a step no longer matters: of N samples, it changes the sum of squares by its square
/// divided by N.
const NEAR: f64 = 0.1;

/// The relative change of the numbers below which the search ends.
const XTOL: f64 = 1e-4;

/// Evaluations for each number, at most.
const MAX_EVALUATIONS: usize = 15;

/// How far the first step may go. Each number is on a scale on which 1 is much, whatever depends on it.
const STEP_BOUND: f64 = 1.5;

/// The last Jacobian stands for that of another place if the numbers differ by no more.
const SAME: f64 = 0.1;

/// Evaluates the function at several places at once, in the way in which it is evaluated at the first argument; `None` where it has no
/// value.
pub(crate) type Predict<'p, E> = dyn FnMut(&[f64], &[Vec<f64>]) -> Result<Vec<Option<Vec<f64>>>, E> + 'p;

/// The result of a search.
pub(crate) struct Minimum {
    /// The numbers.
    pub(crate) x: Vec<f64>,
    /// The function there.
    pub(crate) predicted: Vec<f64>,
    /// Its derivatives there, a column for each number; NaN where it has no value on either side.
    pub(crate) jacobian: DMatrix<f64>,
    /// Whether the search ended because nothing becomes better.
    pub(crate) converged: bool,
}

/// What a function is fitted to: the value of each sample, and its weight.
#[derive(Clone, Copy)]
pub(crate) struct WeightedSamples<'m> {
    pub(crate) measured: &'m [f64],
    pub(crate) weights: &'m [f64],
}

/// A place, with the values and the derivatives there.
type Differentiated = (DVector<f64>, Vec<f64>, DMatrix<f64>);

struct Problem<'p, 'm, E> {
    samples: WeightedSamples<'m>,
    /// The square root of the sum of the squares of weighted values: residuals are relative to it.
    norm: f64,
    steps: &'m [[[f64; 2]; 2]],
    x: DVector<f64>,
    predicted: Option<Vec<f64>>,
    /// The function beside `x`, for the derivative by the first number: it is evaluated together with that at `x`, which would leave other
    /// threads idle.
    beside_first: Option<Vec<f64>>,
    predict: RefCell<&'m mut Predict<'p, E>>,
    /// Where it was differentiated last.
    newest: RefCell<Option<Differentiated>>,
    /// Whether no step from there matters ([`NEAR`]).
    is_near: Cell<bool>,
    failure: RefCell<Option<E>>,
}

impl<E> Problem<'_, '_, E> {
    fn call(&self, places: &[Vec<f64>]) -> Vec<Option<Vec<f64>>> {
        if self.failure.borrow().is_none() {
            match (self.predict.borrow_mut())(self.x.as_slice(), places) {
                Ok(values) => return values,
                Err(failure) => *self.failure.borrow_mut() = Some(failure),
            }
        }
        vec![None; places.len()]
    }

    /// Returns the place at which a number is differentiated on one side.
    fn beside(&self, number: usize, side: usize) -> Vec<f64> {
        let mut place = self.x.as_slice().to_vec();
        place[number] += self.steps[number][side][0];
        place
    }

    /// Returns what is known of a place at which the last Jacobian stands for the present one.
    fn known(&self) -> Option<DMatrix<f64>> {
        let newest = self.newest.borrow();
        newest.as_ref().filter(|(x, ..)| (x - &self.x).amax() < SAME).map(|(.., jacobian)| jacobian.clone())
    }

    /// Returns the derivatives at the present place by differences, to the other side where there is no value on the first one; NaN where
    /// there is none on either.
    fn derivatives(&self) -> Option<DMatrix<f64>> {
        let here = self.predicted.as_ref()?;
        let mut jacobian = DMatrix::from_element(here.len(), self.steps.len(), f64::NAN);
        let mut missing: Vec<usize> = (0..self.steps.len()).collect();
        for side in 0..2 {
            let first = self.beside_first.clone().filter(|_| side == 0);
            let called = &missing[usize::from(first.is_some())..];
            let values = if called.is_empty() {
                Vec::new()
            } else {
                self.call(&called.iter().map(|number| self.beside(*number, side)).collect::<Vec<_>>())
            };
            let values = first.map(Some).into_iter().chain(values);
            for (number, value) in std::mem::take(&mut missing).into_iter().zip(values) {
                let Some(value) = value else {
                    missing.push(number);
                    continue;
                };
                for (row, (beside, here)) in value.iter().zip(here).enumerate() {
                    jacobian[(row, number)] = (beside - here) / self.steps[number][side][1];
                }
            }
        }
        *self.newest.borrow_mut() = Some((self.x.clone(), here.clone(), jacobian.clone()));
        Some(jacobian)
    }
}

impl<E> LeastSquaresProblem<f64, Dyn, Dyn> for Problem<'_, '_, E> {
    type ResidualStorage = Owned<f64, Dyn>;
    type JacobianStorage = Owned<f64, Dyn, Dyn>;
    type ParameterStorage = Owned<f64, Dyn>;

    fn set_params(&mut self, x: &DVector<f64>) {
        if self.predicted.is_some() && self.x == *x {
            return;
        }
        self.x.copy_from(x);
        // A step that was in vain leads back to where it began.
        let known = self.newest.borrow().as_ref().filter(|(at, ..)| at == x).map(|(_, predicted, _)| predicted.clone());
        if known.is_some() {
            (self.predicted, self.beside_first) = (known, None);
            return;
        }
        let beside = (!self.steps.is_empty()).then(|| self.beside(0, 0));
        let places: Vec<_> = [x.as_slice().to_vec()].into_iter().chain(beside).collect();
        let mut values = self.call(&places).into_iter();
        self.predicted = values.next().flatten();
        self.beside_first = values.next().flatten();
    }

    fn params(&self) -> DVector<f64> {
        self.x.clone()
    }

    fn residuals(&self) -> Option<DVector<f64>> {
        if self.failure.borrow().is_some() {
            return None;
        }
        // A place without a value is worse than any that has one: there forces are at most some thousand times the measured ones.
        let WeightedSamples { measured, weights } = self.samples;
        let residual = |index: usize| match &self.predicted {
            Some(predicted) => weights[index] * (predicted[index] - measured[index]) / self.norm,
            None => NO_VALUE,
        };
        Some(DVector::from_iterator(measured.len(), (0..measured.len()).map(residual)))
    }

    fn jacobian(&self) -> Option<DMatrix<f64>> {
        let mut jacobian = self.known().or_else(|| self.derivatives())?;
        // A number without a derivative stays where it is.
        jacobian.apply(|value| *value = if value.is_nan() { 0.0 } else { *value / self.norm });
        for (mut row, weight) in jacobian.row_iter_mut().zip(self.samples.weights) {
            row *= *weight;
        }
        // Runs err by more than what a smaller step would gain: it would be taken again and again.
        self.is_near.set(promised(&jacobian, &self.residuals()?) <= tolerance(self.samples.measured.len()));
        if self.is_near.get() { None } else { Some(jacobian) }
    }
}

/// Returns the relative change of the sum of squares, of so many samples, below which a step does not matter.
#[allow(clippy::cast_precision_loss)]
fn tolerance(samples: usize) -> f64 {
    NEAR * NEAR / samples.max(1) as f64
}

/// Returns the part of the sum of squares that the linear problem at a place promises to take away: what the residuals have in common
/// with the columns of the Jacobian.
fn promised(jacobian: &DMatrix<f64>, residuals: &DVector<f64>) -> f64 {
    /// Columns with a smaller part of their own, relative to the largest, are those of others.
    const OWN: f64 = 1e-9;
    let decomposed = jacobian.clone().svd(true, false);
    let largest = decomposed.singular_values.amax();
    let directions = decomposed.u.iter().flat_map(|u| u.column_iter().zip(&decomposed.singular_values));
    let along = directions.filter(|(_, value)| **value > OWN * largest).map(|(u, _)| u.dot(residuals).powi(2));
    along.sum::<f64>() / residuals.norm_squared().max(f64::MIN_POSITIVE)
}

/// Searches for the numbers with the least sum of squares of weighted differences of `predict` from the measured values, which are not 0
/// throughout: from 0 on, or from the minimum with other weights. `steps` are the two differences, one to each side, by which it
/// differentiates each number, each with what it divides the difference of the function by. Without numbers it evaluates once. `None` if
/// the function has no value at 0.
///
/// # Errors
/// Returns the error of `predict`.
pub(crate) fn minimize<E>(
    samples: WeightedSamples<'_>,
    steps: &[[[f64; 2]; 2]],
    from: Option<Minimum>,
    predict: &mut Predict<'_, E>,
) -> Result<Option<Minimum>, E> {
    let WeightedSamples { measured, weights } = samples;
    let norm = measured.iter().zip(weights).map(|(value, weight)| (value * weight).powi(2)).sum::<f64>().sqrt();
    let mut problem = Problem {
        samples,
        norm,
        steps,
        x: DVector::zeros(steps.len()),
        predicted: None,
        beside_first: None,
        predict: RefCell::new(predict),
        newest: RefCell::default(),
        is_near: Cell::new(false),
        failure: RefCell::default(),
    };
    match from {
        Some(Minimum { x, predicted, jacobian, .. }) => {
            problem.x.copy_from_slice(&x);
            problem.predicted = Some(predicted.clone());
            problem.newest = RefCell::new(Some((problem.x.clone(), predicted, jacobian)));
        }
        None => problem.set_params(&DVector::zeros(steps.len())),
    }
    let mut converged = true;
    if !steps.is_empty() && problem.predicted.is_some() {
        let ftol = tolerance(measured.len());
        let search = LevenbergMarquardt::new().with_ftol(ftol).with_xtol(XTOL).with_scale_diag(false);
        let (found, report) = search.with_stepbound(STEP_BOUND).with_patience(MAX_EVALUATIONS).minimize(problem);
        converged = report.termination.was_successful() || found.is_near.get();
        problem = found;
    }
    if let Some(failure) = problem.failure.take() {
        return Err(failure);
    }
    let jacobian = problem.known().or_else(|| problem.derivatives());
    if let Some(failure) = problem.failure.take() {
        return Err(failure);
    }
    let (Some(predicted), Some(jacobian)) = (problem.predicted, jacobian) else { return Ok(None) };
    Ok(Some(Minimum { x: problem.x.as_slice().to_vec(), predicted, jacobian, converged }))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    const STEPS: [[f64; 2]; 2] = [[-0.01; 2], [0.01; 2]];

    fn samples(measured: &[f64]) -> WeightedSamples<'_> {
        WeightedSamples { measured, weights: &[1.0; 40] }
    }

    /// Two curves of one number that contradict each other: the weights decide, and what is known of the first minimum needs no
    /// further derivatives.
    #[test]
    fn other_weights_move_the_minimum_with_few_evaluations() {
        let measured: Vec<f64> = (0..40).map(|k| if k < 20 { 1.0 } else { 2.0 }).collect();
        let mut evaluations = 0;
        let mut predict = |_: &[f64], places: &[Vec<f64>]| {
            evaluations += places.len();
            Ok::<_, ()>(places.iter().map(|x| Some(vec![x[0]; 40])).collect())
        };
        let equal = minimize(samples(&measured), &[STEPS], None, &mut predict).unwrap().unwrap();
        assert!((equal.x[0] - 1.5).abs() < 1e-9, "{:?}", equal.x);
        let weights: Vec<f64> = (0..40).map(|k| if k < 20 { 3.0 } else { 1.0 }).collect();
        let first = std::mem::take(&mut evaluations);
        let mut predict = |_: &[f64], places: &[Vec<f64>]| {
            evaluations += places.len();
            Ok::<_, ()>(places.iter().map(|x| Some(vec![x[0]; 40])).collect())
        };
        let weighted = WeightedSamples { measured: &measured, weights: &weights };
        let moved = minimize(weighted, &[STEPS], Some(equal), &mut predict).unwrap().unwrap();
        // (9·1 + 1·2)/10.
        assert!((moved.x[0] - 1.1).abs() < 1e-6, "{:?}", moved.x);
        assert!(evaluations <= first, "{evaluations}");
    }

    #[test]
    fn an_exponential_is_found_from_far_away_and_places_without_a_value_are_left() {
        let times: Vec<f64> = (0..40).map(|k| 0.1 * f64::from(k)).collect();
        let curve = |x: &[f64]| times.iter().map(|t| x[0].exp() * (-t * x[1].exp()).exp()).collect::<Vec<f64>>();
        let mut evaluations = 0;
        let mut predict = |_: &[f64], places: &[Vec<f64>]| {
            evaluations += places.len();
            Ok::<_, ()>(places.iter().map(|x| (x[0] < 3.0).then(|| curve(x))).collect())
        };
        let found = minimize(samples(&curve(&[2.5, -0.7])), &[STEPS; 2], None, &mut predict).unwrap().unwrap();
        assert!(found.converged);
        assert!((found.x[0] - 2.5).abs() < 1e-3 && (found.x[1] + 0.7).abs() < 1e-3, "{:?}", found.x);
        assert!(evaluations < 60, "{evaluations}");
    }

    /// A derivative of 0 would say that the function does not depend on the number.
    #[test]
    fn a_number_with_a_value_on_one_side_has_a_derivative_and_one_without_neighbours_has_none() {
        let begun = [0.0, 0.0];
        let mut predict = |at: &[f64], places: &[Vec<f64>]| {
            let value = |x: &Vec<f64>| {
                let is_alone = x[1] != at[1];
                (x[0] >= begun[0] && !is_alone).then(|| (0..5).map(|k| 2.0 + x[0] + x[1] + f64::from(k)).collect())
            };
            Ok::<_, ()>(places.iter().map(value).collect())
        };
        let measured: Vec<f64> = (0..5).map(|k| 2.5 + f64::from(k)).collect();
        let found = minimize(samples(&measured), &[STEPS; 2], None, &mut predict).unwrap().unwrap();
        assert!((found.x[0] - 0.5).abs() < 1e-6 && found.x[1] == 0.0, "{:?}", found.x);
        assert!((found.jacobian[(0, 0)] - 1.0).abs() < 1e-9 && found.jacobian[(0, 1)].is_nan(), "{}", found.jacobian);
    }
}
