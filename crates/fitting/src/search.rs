//! The search for the least squares (Levenberg–Marquardt), over any function from a few numbers to many.

use std::cell::RefCell;

use levenberg_marquardt::{LeastSquaresProblem, LevenbergMarquardt};
use nalgebra::{DMatrix, DVector, Dyn, Owned};

/// The residual, in norms of the measured forces, of each sample at a place where the runs have no value.
const NO_VALUE: f64 = 1e6;

/// The part of a standard error below which a step no longer matters: of N samples, it changes the sum of squares by its square
/// divided by N.
const NEAR: f64 = 0.03;

/// The relative change of the numbers below which the search ends.
const XTOL: f64 = 1e-4;

/// Evaluations for each number, at most.
const MAX_EVALUATIONS: usize = 15;

/// How far the first step may go. Each number is on a scale on which 1 is much, whatever depends on it.
const STEP_BOUND: f64 = 1.5;

/// The Jacobian of the last step stands for that of the minimum if the numbers differ by no more.
const SAME: f64 = 0.02;

/// Evaluates the function at several places at once; `None` where it has no value.
pub(crate) type Predict<'p, E> = dyn FnMut(&[Vec<f64>]) -> Result<Vec<Option<Vec<f64>>>, E> + 'p;

/// The result of a search.
pub(crate) struct Minimum {
    /// The numbers.
    pub(crate) x: Vec<f64>,
    /// The function there.
    pub(crate) predicted: Vec<f64>,
    /// Its derivatives there, a column for each number.
    pub(crate) jacobian: DMatrix<f64>,
    /// Whether the search ended because nothing becomes better.
    pub(crate) converged: bool,
}

struct Problem<'p, 'm, E> {
    measured: &'m [f64],
    /// The square root of the sum of its squares: residuals are relative to it.
    norm: f64,
    steps: &'m [[f64; 2]],
    x: DVector<f64>,
    predicted: Option<Vec<f64>>,
    predict: RefCell<&'m mut Predict<'p, E>>,
    /// The last derivatives, and where.
    newest: RefCell<Option<(DVector<f64>, DMatrix<f64>)>>,
    failure: RefCell<Option<E>>,
}

impl<E> Problem<'_, '_, E> {
    fn call(&self, places: &[Vec<f64>]) -> Vec<Option<Vec<f64>>> {
        if self.failure.borrow().is_none() {
            match (self.predict.borrow_mut())(places) {
                Ok(values) => return values,
                Err(failure) => *self.failure.borrow_mut() = Some(failure),
            }
        }
        vec![None; places.len()]
    }

    /// Returns the derivatives at the present place by differences; 0 where there is no value beside it.
    fn derivatives(&self) -> Option<DMatrix<f64>> {
        let here = self.predicted.as_ref()?;
        let beside = |(number, [step, _]): (usize, &[f64; 2])| {
            let mut place = self.x.as_slice().to_vec();
            place[number] += step;
            place
        };
        let values = self.call(&self.steps.iter().enumerate().map(beside).collect::<Vec<_>>());
        let mut jacobian = DMatrix::zeros(here.len(), self.steps.len());
        for (number, (value, [_, divisor])) in values.iter().zip(self.steps).enumerate() {
            let Some(value) = value else { continue };
            for (row, (beside, here)) in value.iter().zip(here).enumerate() {
                jacobian[(row, number)] = (beside - here) / divisor;
            }
        }
        *self.newest.borrow_mut() = Some((self.x.clone(), jacobian.clone()));
        Some(jacobian)
    }
}

impl<E> LeastSquaresProblem<f64, Dyn, Dyn> for Problem<'_, '_, E> {
    type ResidualStorage = Owned<f64, Dyn>;
    type JacobianStorage = Owned<f64, Dyn, Dyn>;
    type ParameterStorage = Owned<f64, Dyn>;

    fn set_params(&mut self, x: &DVector<f64>) {
        // The search looks again where it came from.
        if self.predicted.is_some() && self.x == *x {
            return;
        }
        self.x.copy_from(x);
        self.predicted = self.call(&[x.as_slice().to_vec()]).pop().flatten();
    }

    fn params(&self) -> DVector<f64> {
        self.x.clone()
    }

    fn residuals(&self) -> Option<DVector<f64>> {
        if self.failure.borrow().is_some() {
            return None;
        }
        // A place without a value is worse than any that has one: there forces are at most some thousand times the measured ones.
        let residual = |index: usize, measured: f64| match &self.predicted {
            Some(predicted) => (predicted[index] - measured) / self.norm,
            None => NO_VALUE,
        };
        let residuals = self.measured.iter().enumerate().map(|(index, measured)| residual(index, *measured));
        Some(DVector::from_iterator(self.measured.len(), residuals))
    }

    fn jacobian(&self) -> Option<DMatrix<f64>> {
        self.derivatives().map(|jacobian| jacobian / self.norm)
    }
}

/// Searches from 0 on for the numbers with the least sum of squares of `predict` − `measured`, which is not 0 throughout. `steps` are
/// the difference by which it differentiates each number, and what it divides the difference of the function by. Without numbers it evaluates once. `None` if the function has no
/// value at 0.
///
/// # Errors
/// Returns the error of `predict`.
pub(crate) fn minimize<E>(
    measured: &[f64],
    steps: &[[f64; 2]],
    predict: &mut Predict<'_, E>,
) -> Result<Option<Minimum>, E> {
    let norm = measured.iter().map(|value| value * value).sum::<f64>().sqrt();
    let mut problem = Problem {
        measured,
        norm,
        steps,
        x: DVector::zeros(steps.len()),
        predicted: None,
        predict: RefCell::new(predict),
        newest: RefCell::default(),
        failure: RefCell::default(),
    };
    problem.set_params(&DVector::zeros(steps.len()));
    let mut converged = true;
    if !steps.is_empty() && problem.predicted.is_some() {
        #[allow(clippy::cast_precision_loss)]
        let ftol = NEAR * NEAR / measured.len() as f64;
        let search = LevenbergMarquardt::new().with_ftol(ftol).with_xtol(XTOL).with_scale_diag(false);
        let (found, report) = search.with_stepbound(STEP_BOUND).with_patience(MAX_EVALUATIONS).minimize(problem);
        (problem, converged) = (found, report.termination.was_successful());
    }
    if let Some(failure) = problem.failure.take() {
        return Err(failure);
    }
    let newest = problem.newest.take().filter(|(x, _)| (x - &problem.x).amax() < SAME);
    let jacobian = newest.map(|(_, jacobian)| jacobian).or_else(|| problem.derivatives());
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

    #[test]
    fn an_exponential_is_found_from_far_away_and_places_without_a_value_are_left() {
        let times: Vec<f64> = (0..40).map(|k| 0.1 * f64::from(k)).collect();
        let curve = |x: &[f64]| times.iter().map(|t| x[0].exp() * (-t * x[1].exp()).exp()).collect::<Vec<f64>>();
        let mut evaluations = 0;
        let mut predict = |places: &[Vec<f64>]| {
            evaluations += places.len();
            Ok::<_, ()>(places.iter().map(|x| (x[0] < 3.0).then(|| curve(x))).collect())
        };
        let found = minimize(&curve(&[2.5, -0.7]), &[[-0.01; 2]; 2], &mut predict).unwrap().unwrap();
        assert!(found.converged);
        assert!((found.x[0] - 2.5).abs() < 1e-3 && (found.x[1] + 0.7).abs() < 1e-3, "{:?}", found.x);
        assert!(evaluations < 60, "{evaluations}");
    }
}
