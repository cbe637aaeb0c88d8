//! Exponential multistep schemes: exact for anchor springs, damping and tools; they extrapolate the springs'
//! force. It follows the polynomial through its last p values, with one evaluation per substep. Order p + 1 for
//! p = 2, 3, 4.
//!
//! With y = (u, w), w = u̇·dt, A = [[0, 1], [−a, −g]] and b = (0, 1) (times in substeps, see `super`):
//!
//! y(1) = E·y(0) + ∫₀¹ e^{A(1−s)}·b·(N(s) + F(s)) ds,  E = e^A.
//!
//! Predict y* with N(s) through the last p values N₀, N₋₁, …; evaluate N* = N(u*), once; correct with the polynomial
//! through N* as well. It differs from the first polynomial by δ·π(s), where δ = N* − (first polynomial at s = 1) and
//! π(s) = ∏(s + i)/(1 + i), so y = y* + γ·δ, γ = ∫ e^{A(1−s)}·b·π(s) ds. Keep N* as the next N₀.
//!
//! **In the sweep.** The state between substeps is the *predicted* y* of the present, with N of the p times before. A
//! substep evaluates N₀ = N(u*), which completes y₀ = y* + γ(N₀ − Σ e_i·N₋₁₋ᵢ), with eᵢ the weights of the
//! extrapolation, and predicts y*₊ = E·y₀ + Σ aᵢ·N₋ᵢ + forced, i = 0 … p − 1. Together:
//!
//! y*₊ = E·y* + (E·γ + a₀)·N₀ + Σ (aᵢ − e_{i−1}·E·γ)·N₋ᵢ + forced,  i = 1 … p,  a_p = 0:
//!
//! A viscous tissue's springs pull with N + β·Ṅ: the polynomials through N are those of N + β·Ṅ in both integrals.
//!
//! This takes one pass, in place, without a buffer for predictions. u and w advance by increments, with E − 1 formed in
//! f64, so f32 keeps its digits.
//!
//! **Tools.** A force that is a polynomial of degree 2k − 1 within the substep acts exactly, through its values at the
//! k Gauss points (the weights are those of the integral with e^{A(1−s)}·b, exact to degree k − 1). A jump at a step's
//! beginning costs no accuracy: N does not jump with it.
//!
//! Literature: exponential Adams methods (Hochbruck and Ostermann, Acta Numerica 19, 2010, section 2.5); predicting and
//! correcting with one evaluation is PEC mode (Hairer, Nørsett, Wanner I, III.1).

use super::arithmetic::{Arithmetic, MAX_KEPT};
use super::family::{Family, QuadratureNode, Release};
use super::matrix::Matrix;
use super::oscillator::Coefficients;
use crate::kernel::lanes::Vector;
use crate::kernel::real::Real;

/// The largest p.
const ORDER_MAX: usize = 4;

/// The weights of the exponential multistep scheme that keeps p = `ORDER` earlier values of the springs' force
/// N, for one tissue and substep; `ORDER` is 2, 3 or 4, and the scheme's order is p + 1. A weight pair has a
/// part for u, then one for w. [`Scheme::fit`](super::Scheme::fit) computes them. N₋ᵢ is N at the time i
/// substeps ago.
#[derive(Debug, Clone, PartialEq)]
pub struct Multistep<const ORDER: usize> {
    /// E − 1, by rows.
    linear: [[f64; 2]; 2],
    /// Weights of N₀, N₋₁, … N₋p.
    springs: Vec<[f64; 2]>,
    /// γ: the weights with which the error of the predicted force ([`Multistep::prediction_error`]) corrects u
    /// and w.
    pub correction: [f64; 2],
    /// e: the p weights of N₋₁, … N₋p, in this order, in the prediction of N₀.
    pub extrapolation: Vec<f64>,
    /// ∫ e^{A(1−s)}·b·sʲ ds for j = 0, 1, …
    moments: Vec<[f64; 2]>,
}

/// Returns the coefficients, in rising powers, of the polynomial that is 1 at `one` and 0 at the `roots`.
fn basis(one: f64, roots: impl Iterator<Item = f64>) -> Vec<f64> {
    roots.fold(vec![1.0], |polynomial, root| {
        let mut product = vec![0.0; polynomial.len() + 1];
        for (power, coefficient) in polynomial.iter().enumerate() {
            product[power + 1] += coefficient / (one - root);
            product[power] -= root * coefficient / (one - root);
        }
        product
    })
}

/// Returns N + β·Ṅ for N a polynomial in s, in rising powers.
#[allow(clippy::cast_precision_loss)]
fn viscous(polynomial: &[f64], viscosity: f64) -> Vec<f64> {
    let rate = polynomial.iter().enumerate().skip(1).map(|(power, coefficient)| power as f64 * coefficient);
    polynomial.iter().zip(rate.chain([0.0])).map(|(coefficient, rate)| coefficient + viscosity * rate).collect()
}

/// Returns ∫ e^{A(1−s)}·b·polynomial(s) ds.
fn integral(moments: &[[f64; 2]], polynomial: &[f64]) -> [f64; 2] {
    std::array::from_fn(|row| polynomial.iter().zip(moments).map(|(c, moment)| c * moment[row]).sum())
}

/// Fits the scheme to a tissue and a substep.
#[allow(clippy::cast_precision_loss)]
pub(super) fn fit<const ORDER: usize>(of: Coefficients) -> Multistep<ORDER> {
    let Coefficients { anchor: a, damping: g, viscosity, .. } = of;
    // y′ = A·y + b·c₀, cⱼ′ = cⱼ₊₁: starting from c = the j-th unit vector, c₀ is sʲ/j!, and y(1) is its integral.
    let powers = ORDER + 1;
    let system = Matrix::of(2 + powers, |i, j| match (i, j) {
        (0, 1) | (1, 2) => 1.0,
        (1, 0) => -a,
        (1, 1) => -g,
        _ => f64::from(u8::from(i >= 2 && j == i + 1)),
    });
    let solution = system.exponential();
    let mut factorial = 1.0;
    let moments: Vec<[f64; 2]> = (0..powers)
        .map(|j| {
            factorial *= (j as f64).max(1.0);
            std::array::from_fn(|row| factorial * solution.at(row, 2 + j))
        })
        .collect();
    let linear = std::array::from_fn(|i| std::array::from_fn(|j| solution.at(i, j) - f64::from(u8::from(i == j))));

    // Values are at s = 0, −1, …, 1 − p.
    let through = through_values(ORDER);
    let pulls = |polynomial: &[f64]| integral(&moments, &viscous(polynomial, viscosity));
    let predictor: Vec<[f64; 2]> = through.iter().map(|polynomial| pulls(polynomial)).collect();
    // A polynomial's value at s = 1 is the sum of its coefficients.
    let extrapolation: Vec<f64> = through.iter().map(|polynomial| polynomial.iter().sum()).collect();
    let correction = pulls(&basis(1.0, (0..ORDER).map(|i| -(i as f64))));
    let carried: [f64; 2] = std::array::from_fn(|row| {
        correction[row]
            + (0..2)
                .map(|k| -> f64 {
                    let l: &[[f64; 2]; 2] = &linear;
                    l[row][k] * correction[k]
                })
                .sum::<f64>()
    });
    let springs = (0..=ORDER)
        .map(|i| {
            std::array::from_fn(|row| {
                let ahead = predictor.get(i).map_or(0.0, |weights| weights[row]);
                ahead + if i == 0 { carried[row] } else { -extrapolation[i - 1] * carried[row] }
            })
        })
        .collect();
    Multistep { linear, springs, correction, extrapolation, moments }
}

impl<const ORDER: usize> Multistep<ORDER> {
    /// Returns the difference N₀ − Σ eᵢ·N₋ᵢ between the springs' force and its prediction, in the unit of
    /// `history`, which has the p + 1 values N₀, N₋₁, …, N₋p, newest first. Panics if `history` is empty;
    /// missing later values count as 0.
    pub fn prediction_error(&self, history: &[f64]) -> f64 {
        history[0] - self.extrapolation.iter().zip(&history[1..]).map(|(weight, past)| weight * past).sum::<f64>()
    }

    fn arithmetic<T: Real, const COMPENSATED: bool>(&self) -> ExponentialAdvance<T, ORDER, COMPENSATED> {
        let mut springs = [[T::default(); 2]; 1 + ORDER_MAX];
        for (to, from) in springs.iter_mut().zip(&self.springs) {
            *to = from.map(T::of);
        }
        ExponentialAdvance {
            linear: self.linear.map(|row| row.map(T::of)),
            springs,
            correction: self.correction.map(T::of),
            extrapolation: std::array::from_fn(|i| T::of(self.extrapolation[i])),
        }
    }
}

impl<const ORDER: usize> Family for Multistep<ORDER> {
    type Plain<T: Real> = ExponentialAdvance<T, ORDER, false>;
    type Compensated<T: Real> = ExponentialAdvance<T, ORDER, true>;

    fn plain<T: Real>(&self, _: usize) -> Self::Plain<T> {
        self.arithmetic()
    }

    fn compensated<T: Real>(&self, _: usize) -> Self::Compensated<T> {
        self.arithmetic()
    }

    fn history(&self) -> usize {
        ORDER
    }

    fn last_field(&self) -> usize {
        1
    }

    /// Three Gauss points. (Two keep the order, but a force oscillating at 20 Hz then has an error of 1e-7 in steps of
    /// 1 ms.)
    fn nodes(&self) -> Vec<QuadratureNode> {
        let places = [0.112_701_665_379_258_3, 0.5, 0.887_298_334_620_741_7];
        let node = |&fraction: &f64| {
            let polynomial = basis(fraction, places.iter().copied().filter(|place| *place != fraction));
            let [u, w] = integral(&self.moments, &polynomial);
            QuadratureNode { fraction, weights: [u, w, 0.0] }
        };
        places.iter().map(node).collect()
    }

    fn constant(&self) -> [f64; 2] {
        self.moments[0]
    }

    /// E·b: the u and w that an impulse adds.
    fn kick(&self) -> [f64; 2] {
        [self.linear[0][1], 1.0 + self.linear[1][1]]
    }

    fn propagator(&self, z: f64) -> Matrix {
        Matrix::of(2 + ORDER, |i, j| match (i, j) {
            (0 | 1, 0 | 1) => {
                let own = if j == 0 { -z * self.springs[0][i] } else { 0.0 };
                f64::from(u8::from(i == j)) + self.linear[i][j] + own
            }
            (0 | 1, _) => self.springs[j - 1][i],
            (2, _) => {
                if j == 0 {
                    -z
                } else {
                    0.0
                }
            }
            _ => f64::from(u8::from(j + 1 == i)),
        })
    }

    /// u and d are predictions that the next substep corrects. The tool's values are already right, so the
    /// correction is subtracted in advance.
    fn release(&self, at: Release<'_>) -> Option<[f64; 2]> {
        let prediction_error = self.prediction_error(at.springs);
        Some(self.correction.map(|weight| -weight * prediction_error))
    }

    fn resample(&self, to: &Self, ratio: f64, [u, d]: [f64; 2], _: f64, springs: &mut [f64]) -> [f64; 2] {
        let [du, dw] = self.correction.map(|weight| weight * self.prediction_error(springs));
        resample_history(springs, ratio);
        let foretold = to.correction.map(|weight| weight * to.prediction_error(springs));
        [u + du - foretold[0], (d + dw) * ratio - foretold[1]]
    }
}

/// Returns the weights of `count` values now, a substep ago, …, in the rate at which the polynomial through them changes now.
pub(super) fn rate_weights(count: usize) -> Vec<f64> {
    through_values(count).into_iter().map(|polynomial| polynomial[1]).collect()
}

/// Returns the polynomials, in rising powers, that values at 0, −1, … multiply in the one through `count` of them.
#[allow(clippy::cast_precision_loss)]
fn through_values(count: usize) -> Vec<Vec<f64>> {
    let nodes = || (0..count).map(|i| -(i as f64));
    nodes().map(|node| basis(node, nodes().filter(move |other| *other != node))).collect()
}

/// Converts forces now and in substeps before to those of a substep that is `ratio` times as long, in its unit.
#[allow(clippy::cast_precision_loss)]
pub(super) fn resample_history(springs: &mut [f64], ratio: f64) {
    let shorter: Vec<f64> = (0..springs.len()).map(|i| ratio * ratio * through(springs, -(i as f64) * ratio)).collect();
    springs.copy_from_slice(&shorter);
}

/// Returns the value at `s` of the polynomial that is `values[i]` at −i.
#[allow(clippy::cast_precision_loss)]
fn through(values: &[f64], s: f64) -> f64 {
    let weight = |i: usize| -> f64 {
        let others = (0..values.len()).filter(|j| *j != i);
        others.map(|j| (s + j as f64) / (j as f64 - i as f64)).product()
    };
    values.iter().enumerate().map(|(i, value)| value * weight(i)).sum()
}

/// The scheme in the number format of the state.
///
/// With `COMPENSATED`, the rounding error of each sum u + increment is kept and added to the next increment
/// (Kahan 1965). Without it, a displacement that creeps by less than half its last digit per substep stands
/// still.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ExponentialAdvance<T, const ORDER: usize, const COMPENSATED: bool> {
    linear: [[T; 2]; 2],
    springs: [[T; 2]; 1 + ORDER_MAX],
    correction: [T; 2],
    extrapolation: [T; ORDER],
}

impl<T: Real, const ORDER: usize, const COMPENSATED: bool> ExponentialAdvance<T, ORDER, COMPENSATED> {
    /// Returns the change of u (`row` 0) or w (`row` 1) without the tools.
    #[inline(always)]
    fn increment<V: Vector<Real = T>>(&self, row: usize, x: V, d: V, n: V, kept: &[V; MAX_KEPT]) -> V {
        // Two independent sums shorten the dependency chain.
        let mut even = d.splat(self.springs[0][row]).mul(n);
        let mut odd = d.splat(self.springs[1][row]).mul_add(kept[0], d.splat(self.linear[row][0]).mul(x));
        odd = d.splat(self.linear[row][1]).mul_add(d, odd);
        for i in 2..=ORDER {
            let weight = d.splat(self.springs[i][row]);
            if i % 2 == 0 {
                even = weight.mul_add(kept[i - 1], even);
            } else {
                odd = weight.mul_add(kept[i - 1], odd);
            }
        }
        even.add(odd)
    }
}

impl<T: Real, const ORDER: usize, const COMPENSATED: bool> Arithmetic<T> for ExponentialAdvance<T, ORDER, COMPENSATED> {
    const KEPT: usize = ORDER + COMPENSATED as usize;
    /// The newest value replaces the oldest, and the others move by renumbering. The rounding error is written
    /// as well.
    const WRITTEN: usize = 1 + COMPENSATED as usize;
    const FORCES: usize = 2;

    #[inline(always)]
    fn advance<V: Vector<Real = T>>(
        &self,
        x: V,
        d: V,
        n: V,
        kept: &mut [V; MAX_KEPT],
        force: Option<[V; 2]>,
    ) -> (V, V) {
        let (u, w) = if let Some([of_u, of_w]) = force {
            (self.increment(0, x, d, n, kept).add(of_u), self.increment(1, x, d, n, kept).add(of_w))
        } else {
            (self.increment(0, x, d, n, kept), self.increment(1, x, d, n, kept))
        };
        kept[ORDER - 1] = n;
        let u = if COMPENSATED { u.add(kept[ORDER]) } else { u };
        let moved = x.add(u);
        if COMPENSATED {
            kept[ORDER] = u.sub(moved.sub(x));
        }
        (moved, d.add(w))
    }

    #[inline(always)]
    fn travel<V: Vector<Real = T>>(&self, [x, _]: [V; 2], [moved, _]: [V; 2]) -> V {
        moved.sub(x)
    }

    #[inline(always)]
    fn observe<V: Vector<Real = T>>(&self, x: V, d: V, n: V, kept: &[V; MAX_KEPT], _: Option<V>) -> (V, V) {
        let mut prediction_error = n;
        for (weight, past) in self.extrapolation.iter().zip(kept) {
            prediction_error = prediction_error.sub(d.splat(*weight).mul(*past));
        }
        let [of_u, of_w] = self.correction;
        (d.splat(of_u).mul_add(prediction_error, x), d.splat(of_w).mul_add(prediction_error, d))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_polynomial_goes_through_its_values_and_between() {
        let cube = |s: f64| 2.0 - s + 0.5 * s * s - 0.25 * s * s * s;
        let values = [0.0, -1.0, -2.0, -3.0].map(cube);
        for s in [0.0, -1.0, -3.0, -0.5, -2.25, 0.7] {
            assert!((through(&values, s) - cube(s)).abs() < 1e-12, "{s}");
        }
    }

    /// The displacement and the velocity that a state stands for: it is a prediction, which the springs' force of the
    /// present completes.
    fn present<const ORDER: usize>(scheme: &Multistep<ORDER>, state: [f64; 2], springs: &[f64]) -> [f64; 2] {
        let error = scheme.prediction_error(springs);
        [0, 1].map(|row| state[row] + scheme.correction[row] * error)
    }

    /// Values of no polynomial of a low degree: the prediction of the first misses it.
    const SPRINGS: [f64; 5] = [0.3, -0.8, 0.5, 0.1, -0.4];

    #[test]
    fn a_point_that_is_released_goes_on_from_where_the_tool_held_it() {
        let scheme = fit::<3>(Coefficients { anchor: 0.02, damping: 0.1, viscosity: 0.3, ..Coefficients::default() });
        let (held, springs) = ([0.7, -0.2], &SPRINGS[..4]);
        let at = Release { u: held[0], springs, used: 0.0, scale: 1.0, lost_n: 0.0 };
        let [du, dd] = scheme.release(at).unwrap();
        let found = present(&scheme, [held[0] + du, held[1] + dd], springs);
        assert!((0..2).all(|row| (found[row] - held[row]).abs() < 1e-15), "{found:?}");
        assert!(du.abs() > 1e-3 && dd.abs() > 1e-3, "{du} {dd}");
    }

    #[test]
    fn a_state_stands_for_the_same_place_and_velocity_with_another_substep() {
        for ratio in [0.5, 0.25, 1.0] {
            let of = |ratio: f64| Coefficients {
                anchor: 0.02 * ratio * ratio,
                damping: 0.1 * ratio,
                viscosity: 0.3 / ratio,
                ..Coefficients::default()
            };
            let (from, to) = (fit::<4>(of(1.0)), fit::<4>(of(ratio)));
            let (state, mut springs) = ([0.7, -0.2], SPRINGS);
            let before = present(&from, state, &springs);
            let resampled = from.resample(&to, ratio, state, 0.0, &mut springs);
            // Velocities are in spacings a substep, forces in spacings a substep squared.
            let after = present(&to, resampled, &springs);
            assert!((after[0] - before[0]).abs() < 1e-14, "{ratio}: {before:?} {after:?}");
            assert!((after[1] - ratio * before[1]).abs() < 1e-14, "{ratio}: {before:?} {after:?}");
            assert!((springs[0] - ratio * ratio * SPRINGS[0]).abs() < 1e-14, "{ratio}: {springs:?}");
        }
    }
}
