//! The force of a cube on its corners.
//!
//! **Material.** With H = ∂u/∂X, F = I + H, J = det F and Lamé's λ and μ, the energy of a volume is
//!
//! W = μ(½|H|² − tr cof H − det H) + ½(λ + μ)(J − 1)²:
//!
//! stable neo-Hookean without its logarithm (Smith, de Goes and Kim, ACM Transactions on Graphics 37(2), 2018,
//! doi:10.1145/3180491), less its value at rest. With q = (λ + μ)(J − 1) − μ its derivative is
//!
//! P = μ·H + q·(cof H − Hᵀ) + (q + μ + q·tr H)·I,  J − 1 = tr H + tr cof H + det H,
//!
//! without a difference of large numbers at small H, and without a root, a division or a decomposition.
//!
//! **A cube.** A pattern is a sum of the corners' displacements with signs, σ_x σ_y σ_z = ±1. Three of the eight patterns
//! give h = 4a·H; four are hourglasses, g₁ = Σ σ_y σ_z u, g₂ = Σ σ_x σ_z u, g₃ = Σ σ_x σ_y u, g₄ = Σ σ_x σ_y σ_z u: they
//! move the corners without F at the middle. ∫ ½μ|F|² over the cube of edge a adds μa·(⅔(g₁² + g₂² + g₃²) + ⅓g₄²)/32 for
//! them. With u in units of a, E·a = k and P in units of E, the force on a corner is
//!
//! −k/64·w·[(16 P)·σ + μ/E·(8/3·(g₁σ_yσ_z + g₂σ_xσ_z + g₃σ_xσ_y) + 4/3·g₄σ_xσ_yσ_z)],
//!
//! w the part of the cube that is there times its factor of E. A node's force is a sum over its eight cubes, here in
//! fours: rows along x, with A (the part without σ_x) and B (the part with it); the near corner gets A − B, the far one
//! A + B.
//!
//! **Limits.** The law stiffens as λ|cof F|², and as μ|F|. So that a substep that is stable at rest stays stable however far
//! the tissue is pressed or pulled, W = μ(½|H|² + tr H) + ψ has in place of ψ = ½(λ + μ)(J − 1)² − μ(J − 1)
//!
//! g·ψ, g = min(1, S/s), s = |cof F|², with S = [`SOFTENS`],
//!
//! and |(λ + μ)(J − 1)| grows no further than to [`LARGEST`]·μ. Its derivative is g·ψ′·cof F − 2gψ/s·(|F|²F − F·Fᵀ·F) where
//! g < 1. (A force that is only reduced there is the gradient of no energy, and kept cubes moving that were turned inside
//! out.) Pressed by half of its height, a block gives way as without limits.
#![allow(clippy::needless_range_loop)]

use crate::kernel::lanes::Vector;
use crate::kernel::real::Real;

/// |cof F|² from which on ψ is reduced; 3 at rest.
const SOFTENS: f64 = 3.5;

/// The largest pressure, in μ.
const LARGEST: f64 = 5.0;

/// Coefficients of a material's cubes, in units of a scheme.
#[derive(Debug, Clone, Copy)]
pub(crate) struct NeoHookean<T> {
    /// c·μ/E, where c is k/64 times the factor to the scheme's units of force.
    shear: T,
    /// c·(λ + μ)/E/4, the factor of 64(J − 1) in 16 times the pressure.
    bulk: T,
    /// 64|J − 1| beyond which the pressure stays the same.
    largest_growth: T,
}

/// One component of the force of a cube on the rows of its corners along x: near in y and z, far in y, far in z, far in
/// both.
pub(crate) struct RowForces<V> {
    /// The mean force of both corners of a row.
    pub(crate) even: [V; 4],
    /// Half the difference: the corner farther along x gets even + odd, the other one even − odd.
    pub(crate) odd: [V; 4],
}

/// The patterns of a cube: h and the hourglasses g₁ to g₄, by component.
pub(crate) struct Patterns<V> {
    pub(super) h: [[V; 3]; 3],
    pub(super) g: [[V; 4]; 3],
}

/// What a cube's patterns pull with: 16 P and the factors of the first three hourglasses and of the fourth, all times the
/// weight.
pub(crate) struct Stress<V> {
    p: [[V; 3]; 3],
    hours: [V; 2],
}

/// Returns the patterns of one component, from the sums and differences along x of the four rows.
#[inline(always)]
fn patterns<V: Vector>([s00, s10, s01, s11]: [V; 4], [d00, d10, d01, d11]: [V; 4]) -> ([V; 3], [V; 4]) {
    // Along y, near and far in z.
    let (ss0, sd0, ds0, dd0) = (s10.add(s00), s10.sub(s00), d10.add(d00), d10.sub(d00));
    let (ss1, sd1, ds1, dd1) = (s11.add(s01), s11.sub(s01), d11.add(d01), d11.sub(d01));
    ([ds1.add(ds0), sd1.add(sd0), ss1.sub(ss0)], [sd1.sub(sd0), ds1.sub(ds0), dd1.add(dd0), dd1.sub(dd0)])
}

impl<V: Vector> Patterns<V> {
    /// Returns the patterns of cubes at rest.
    #[inline(always)]
    pub(crate) fn at_rest(zero: V) -> Self {
        Patterns { h: [[zero; 3]; 3], g: [[zero; 4]; 3] }
    }

    /// Sets a component, from the displacements of the corners nearer along x by row, and of those farther.
    #[inline(always)]
    pub(crate) fn set(&mut self, c: usize, near: [V; 4], far: [V; 4]) {
        let (mut sums, mut differences) = (near, near);
        for row in 0..4 {
            sums[row] = far[row].add(near[row]);
            differences[row] = far[row].sub(near[row]);
        }
        (self.h[c], self.g[c]) = patterns(sums, differences);
    }
}

impl<V: Vector> Stress<V> {
    /// Creates it from 16 P and the factor μ/E, both times the weight.
    #[inline(always)]
    pub(super) fn of(p: [[V; 3]; 3], shear: V) -> Self {
        let hour = |factor: f64| shear.mul(shear.splat(V::Real::of(factor)));
        Stress { p, hours: [hour(8.0 / 3.0), hour(4.0 / 3.0)] }
    }

    /// Returns a component of the forces on the corners.
    #[inline(always)]
    pub(crate) fn on_rows(&self, patterns: &Patterns<V>, c: usize) -> RowForces<V> {
        let ([px, py, pz], [g1, g2, g3, g4], [three, one]) = (self.p[c], patterns.g[c], self.hours);
        let zero = px.splat(V::Real::default());
        let (py_less, py_more) = (py.minus(three, g1), three.mul_add(g1, py));
        let (px_less, px_more) = (px.minus(three, g2), three.mul_add(g2, px));
        let third = three.mul(g3);
        let (third_less, third_more) = (third.minus(one, g4), one.mul_add(g4, third));
        RowForces {
            even: [zero.sub(py_less).sub(pz), py_less.sub(pz), pz.sub(py_more), pz.add(py_more)],
            odd: [px_less.sub(third_less), px_less.add(third_less), px_more.sub(third_more), px_more.add(third_more)],
        }
    }
}

impl<T: Real> NeoHookean<T> {
    /// Creates the law of a material with μ/E = `shear` and λ/E = `lame`. `stiffness` is k = E·a times the factor to the
    /// scheme's units of force.
    pub(crate) fn new(stiffness: f64, shear: f64, lame: f64) -> Self {
        let unit = stiffness / 64.0;
        NeoHookean {
            shear: T::of(unit * shear),
            bulk: T::of(unit * (lame + shear) / 4.0),
            largest_growth: T::of(64.0 * LARGEST * shear / (lame + shear)),
        }
    }

    /// Returns 64(J − 1) as far as the pressure grows with it.
    #[inline(always)]
    fn growing<V: Vector<Real = T>>(&self, growth: V) -> V {
        let (largest, zero) = (growth.splat(self.largest_growth), growth.splat(T::default()));
        let least = zero.sub(largest);
        // The smaller of two is minus the larger of both turned round.
        zero.sub(zero.sub(growth).larger(least)).larger(least)
    }

    /// Returns 64 ψ without g, with c in it; `pressure` is 16 times the pressure for `growing`.
    #[inline(always)]
    fn psi<V: Vector<Real = T>>(growth: V, growing: V, pressure: V, shear: V) -> V {
        let of = |value: f64| growth.splat(T::of(value));
        let stored = pressure.mul(of(0.0625)).mul(growth.minus(of(0.5), growing));
        stored.minus(shear, growth)
    }

    /// Returns what cubes of weight `w` pull with.
    #[inline(always)]
    pub(crate) fn stress<V: Vector<Real = T>>(&self, w: V, Patterns { h, .. }: &Patterns<V>) -> Stress<V> {
        let shear = w.mul(w.splat(self.shear));
        let bulk = w.mul(w.splat(self.bulk));
        let (cofactor, trace, growth) = invariants(h);
        let growing = self.growing(growth);
        let (mut pressure, sixteenth, four) = (bulk.mul(growing), w.splat(T::of(0.0625)), w.splat(T::of(4.0)));
        let mut q = pressure.mul(sixteenth).sub(shear);
        let (squares, most) = (squares(&cofactor, trace), w.splat(T::of(256.0 * SOFTENS)));
        let is_far = squares.above(most);
        let mut far = None;
        if V::any(is_far) {
            let psi = Self::psi(growth, growing, pressure, shear);
            let part = most.div(squares.larger(most));
            let sixteen = w.splat(T::of(16.0));
            q = V::select(is_far, q.mul(part), q);
            pressure = V::select(is_far, sixteen.mul(q.add(shear)), pressure);
            far = Some(part.mul(psi).mul(w.splat(T::of(-2.0))).div(squares));
        }
        // 16 P, all times the weight: 4μ·h + q·(cof h − 4hᵀ) + (16 (q + μ) + 4 q·tr h)·I, where q is g·ψ′ and `pressure`
        // 16 (q + μ).
        let (shear_four, q_four) = (shear.mul(four), q.mul(four));
        let spherical = q_four.mul_add(trace, pressure);
        let mut p = [[w; 3]; 3];
        for c in 0..3 {
            for along in 0..3 {
                let own =
                    if c == along { shear_four.mul_add(h[c][along], spherical) } else { shear_four.mul(h[c][along]) };
                p[c][along] = q.mul_add(cofactor[c][along], own);
            }
        }
        if let Some(factor) = far {
            let slope = half_slope_of_squares(h);
            for c in 0..3 {
                for along in 0..3 {
                    let more = factor.mul_add(slope[c][along], p[c][along]);
                    p[c][along] = V::select(is_far, more, p[c][along]);
                }
            }
        }
        Stress::of(p, shear)
    }

    /// Returns the energy of cubes, in the scheme's units of force times edges.
    #[inline(always)]
    pub(crate) fn energy<V: Vector<Real = T>>(&self, w: V, Patterns { h, g }: &Patterns<V>) -> V {
        let shear = w.mul(w.splat(self.shear));
        let bulk = w.mul(w.splat(self.bulk));
        let (cofactor, trace, growth) = invariants(h);
        let zero = w.splat(T::default());
        let (mut of_squares, mut hours, mut last) = (zero, zero, zero);
        for c in 0..3 {
            for along in 0..3 {
                of_squares = h[c][along].mul_add(h[c][along], of_squares);
                hours = g[c][along].mul_add(g[c][along], hours);
            }
            last = g[c][3].mul_add(g[c][3], last);
        }
        // 64(J − 1) = 16 tr h + 4 tr cof h + det h: so what is subtracted, 4 tr cof h + det h, is this less 16 tr h.
        let less = growth.sub(w.splat(T::of(16.0)).mul(trace));
        let of_h = w.splat(T::of(2.0)).mul_add(of_squares, zero.sub(less));
        let of_g = w.splat(T::of(4.0 / 3.0)).mul_add(hours, w.splat(T::of(2.0 / 3.0)).mul(last));
        let growing = self.growing(growth);
        let pressure = bulk.mul(growing);
        // ψ + μ(J − 1), without the difference of large numbers at small h; then (g − 1)·ψ.
        let swelling = pressure.mul(w.splat(T::of(0.0625))).mul(growth.minus(w.splat(T::of(0.5)), growing));
        let most = w.splat(T::of(256.0 * SOFTENS));
        let less = most.div(squares(&cofactor, trace).larger(most)).sub(w.splat(T::of(1.0)));
        let reduced = less.mul(Self::psi(growth, growing, pressure, shear));
        shear.mul_add(of_h.add(of_g), swelling.add(reduced))
    }
}

/// Returns cof h − 4hᵀ (16 times cof F less its diagonal part), tr h, and 64(J − 1).
#[inline(always)]
pub(super) fn invariants<V: Vector>(h: &[[V; 3]; 3]) -> ([[V; 3]; 3], V, V) {
    let zero = h[0][0].splat(V::Real::default());
    let (four, sixteen) = (zero.splat(V::Real::of(4.0)), zero.splat(V::Real::of(16.0)));
    let mut cofactor = [[zero; 3]; 3];
    for i in 0..3 {
        let (i1, i2) = ((i + 1) % 3, (i + 2) % 3);
        for j in 0..3 {
            let (j1, j2) = ((j + 1) % 3, (j + 2) % 3);
            cofactor[i][j] = h[i1][j1].mul(h[i2][j2]).minus(h[i1][j2], h[i2][j1]);
        }
    }
    let trace = h[0][0].add(h[1][1]).add(h[2][2]);
    let of_cofactor = cofactor[0][0].add(cofactor[1][1]).add(cofactor[2][2]);
    let determinant = h[0][2].mul_add(cofactor[0][2], h[0][1].mul_add(cofactor[0][1], h[0][0].mul(cofactor[0][0])));
    let growth = sixteen.mul_add(trace, four.mul_add(of_cofactor, determinant));
    for i in 0..3 {
        for j in 0..3 {
            cofactor[i][j] = cofactor[i][j].minus(four, h[j][i]);
        }
    }
    (cofactor, trace, growth)
}

/// Returns 256|cof F|². `cofactor` and `trace` are those of [`invariants`].
#[inline(always)]
fn squares<V: Vector>(cofactor: &[[V; 3]; 3], trace: V) -> V {
    let of = |value: f64| trace.splat(V::Real::of(value));
    // 16 cof F = 16 + 4 tr h on the diagonal, and the rest.
    let diagonal = of(4.0).mul_add(trace, of(16.0));
    let mut squares = of(0.0);
    for i in 0..3 {
        for j in 0..3 {
            let value = if i == j { cofactor[i][j].add(diagonal) } else { cofactor[i][j] };
            squares = value.mul_add(value, squares);
        }
    }
    squares
}

/// Returns |A|²A − A·Aᵀ·A of A = 4F = 4 + h: half the derivative of |cof A|².
#[inline(always)]
fn half_slope_of_squares<V: Vector>(h: &[[V; 3]; 3]) -> [[V; 3]; 3] {
    let (zero, four) = (h[0][0].splat(V::Real::default()), h[0][0].splat(V::Real::of(4.0)));
    let mut a = *h;
    for c in 0..3 {
        a[c][c] = h[c][c].add(four);
    }
    let mut products = [[zero; 3]; 3];
    for i in 0..3 {
        for j in 0..3 {
            for c in 0..3 {
                products[i][j] = a[c][i].mul_add(a[c][j], products[i][j]);
            }
        }
    }
    let whole = products[0][0].add(products[1][1]).add(products[2][2]);
    let mut slope = [[zero; 3]; 3];
    for c in 0..3 {
        for along in 0..3 {
            let mut value = whole.mul(a[c][along]);
            for k in 0..3 {
                value = value.minus(a[c][k], products[k][along]);
            }
            slope[c][along] = value;
        }
    }
    slope
}
