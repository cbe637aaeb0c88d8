//! Exponential multistep: the virtual springs, damping and tools exactly, the springs by the polynomial through their
//! last p values; one evaluation of the springs a substep. Order p + 1 for p = 2, 3, 4.
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
//! This takes one pass, in place, without a buffer for predictions. u and w advance by increments, with E − 1 formed in
//! f64, so f32 keeps its digits.
//!
//! **Tools.** A force that is a polynomial of degree 2k − 1 within the substep acts exactly, through its values at the
//! k Gauss points (the weights are those of the integral with e^{A(1−s)}·b, exact to degree k − 1). A jump at a step's
//! beginning costs no accuracy: N does not jump with it.
//!
//! Literature: exponential Adams methods (Hochbruck and Ostermann, Acta Numerica 19, 2010, section 2.5); predicting and
//! correcting with one evaluation is PEC mode (Hairer, Nørsett, Wanner I, III.1).

use super::super::lanes::Vector;
use super::super::real::Real;
use super::super::sweep::{self, MAX_KEPT};
use super::Node;
use super::matrix::Matrix;

/// The largest p.
const ORDER_MAX: usize = 4;

/// The weights of a scheme, each for u and for w.
#[derive(Debug, Clone, PartialEq)]
pub struct Multistep {
    /// p: the number of kept values of the springs' force.
    pub order: usize,
    /// E − 1, by rows.
    linear: [[f64; 2]; 2],
    /// Weights of N₀, N₋₁, … N₋p.
    springs: Vec<[f64; 2]>,
    /// γ.
    pub correction: [f64; 2],
    /// e: weights of N₋₁, … N₋p in the prediction of N₀.
    pub extrapolation: Vec<f64>,
    /// ∫ e^{A(1−s)}·b·sʲ ds for j = 0, 1, …
    moments: Vec<[f64; 2]>,
}

/// Coefficients, in rising powers, of the polynomial that is 1 at `one` and 0 at the `roots`.
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

/// ∫ e^{A(1−s)}·b·polynomial(s) ds.
fn integral(moments: &[[f64; 2]], polynomial: &[f64]) -> [f64; 2] {
    std::array::from_fn(|row| polynomial.iter().zip(moments).map(|(c, moment)| c * moment[row]).sum())
}

/// The scheme that keeps `order` values.
#[allow(clippy::cast_precision_loss)]
pub(super) fn fit(order: usize, a: f64, g: f64) -> Multistep {
    // y′ = A·y + b·c₀, cⱼ′ = cⱼ₊₁: starting from c = the j-th unit vector, c₀ is sʲ/j!, and y(1) is its integral.
    let powers = order + 1;
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
    let nodes = || (0..order).map(|i| -(i as f64));
    let through: Vec<Vec<f64>> = nodes().map(|node| basis(node, nodes().filter(move |other| *other != node))).collect();
    let predictor: Vec<[f64; 2]> = through.iter().map(|polynomial| integral(&moments, polynomial)).collect();
    // A polynomial's value at s = 1 is the sum of its coefficients.
    let extrapolation: Vec<f64> = through.iter().map(|polynomial| polynomial.iter().sum()).collect();
    let correction = integral(&moments, &basis(1.0, nodes()));
    let carried: [f64; 2] = std::array::from_fn(|row| {
        correction[row]
            + (0..2)
                .map(|k| -> f64 {
                    let l: &[[f64; 2]; 2] = &linear;
                    l[row][k] * correction[k]
                })
                .sum::<f64>()
    });
    let springs = (0..=order)
        .map(|i| {
            std::array::from_fn(|row| {
                let ahead = predictor.get(i).map_or(0.0, |weights| weights[row]);
                ahead + if i == 0 { carried[row] } else { -extrapolation[i - 1] * carried[row] }
            })
        })
        .collect();
    Multistep { order, linear, springs, correction, extrapolation, moments }
}

impl Multistep {
    /// Three Gauss points. (Two keep the order, but a force oscillating at 20 Hz then has an error of 1e-7 in steps of
    /// 1 ms.)
    pub(super) fn nodes(&self) -> Vec<Node> {
        let places = [0.112_701_665_379_258_3, 0.5, 0.887_298_334_620_741_7];
        let node = |&fraction: &f64| {
            let polynomial = basis(fraction, places.iter().copied().filter(|place| *place != fraction));
            let [u, w] = integral(&self.moments, &polynomial);
            Node { fraction, weights: [u, w, 0.0] }
        };
        places.iter().map(node).collect()
    }

    /// The difference between the springs' force and its prediction: `history` has p + 1 values, at 0, −1, …, −p.
    pub fn surprise(&self, history: &[f64]) -> f64 {
        history[0] - self.extrapolation.iter().zip(&history[1..]).map(|(weight, past)| weight * past).sum::<f64>()
    }

    /// The u and w that a constant force of 1 adds in a substep.
    pub(super) fn constant(&self) -> [f64; 2] {
        self.moments[0]
    }

    /// E·b: the u and w that an impulse adds.
    pub(super) fn kick(&self) -> [f64; 2] {
        [self.linear[0][1], 1.0 + self.linear[1][1]]
    }

    pub(super) fn propagator(&self, z: f64) -> Matrix {
        let n = 2 + self.order;
        Matrix::of(n, |i, j| match (i, j) {
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
}

/// The same in the format of the state.
///
/// With `COMPENSATED`, the rounding loss of each sum u + increment is kept and added to the next increment (Kahan
/// 1965). Without it, a displacement that creeps by less than half its last digit per substep stands still.
#[derive(Debug, Clone, Copy)]
pub(in super::super) struct Advance<T, const ORDER: usize, const COMPENSATED: bool> {
    linear: [[T; 2]; 2],
    springs: [[T; 2]; 1 + ORDER_MAX],
    correction: [T; 2],
    extrapolation: [T; ORDER],
}

impl<T: Real, const ORDER: usize, const COMPENSATED: bool> Advance<T, ORDER, COMPENSATED> {
    pub(in super::super) fn new(multistep: &Multistep) -> Self {
        let mut springs = [[T::default(); 2]; 1 + ORDER_MAX];
        for (to, from) in springs.iter_mut().zip(&multistep.springs) {
            *to = from.map(T::of);
        }
        Advance {
            linear: multistep.linear.map(|row| row.map(T::of)),
            springs,
            correction: multistep.correction.map(T::of),
            extrapolation: std::array::from_fn(|i| T::of(multistep.extrapolation[i])),
        }
    }
}

impl<T: Real, const ORDER: usize, const COMPENSATED: bool> Advance<T, ORDER, COMPENSATED> {
    /// The change of u (`row` 0) or w without the tools.
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

impl<T: Real, const ORDER: usize, const COMPENSATED: bool> sweep::Scheme<T> for Advance<T, ORDER, COMPENSATED> {
    const KEPT: usize = ORDER + COMPENSATED as usize;
    /// The newest value replaces the oldest, and the others move by renumbering. Beside it, the rounding loss is
    /// written.
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
        let mut surprise = n;
        for (weight, past) in self.extrapolation.iter().zip(kept) {
            surprise = surprise.sub(d.splat(*weight).mul(*past));
        }
        let [of_u, of_w] = self.correction;
        (d.splat(of_u).mul_add(surprise, x), d.splat(of_w).mul_add(surprise, d))
    }
}
