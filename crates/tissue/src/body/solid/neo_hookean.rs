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
//! w the part of the cube that is there times its factor of E. Patterns and forces are computed by sides ([`CubeSide`]): the four
//! corners with one y have sums and differences along x and z of their own, which the next cube along y shares.
//!
//! With h, 16(cof F − I) = e and 64(J − 1) = h₀₀·16 + (4 + h₀₀)·e₀₀ + h₀₁·e₀₁ + h₀₂·e₀₂, and so
//!
//! 16 P = 4μ·h + q·e + 16(q + μ)·I.
//!
//! **Limits.** The law stiffens as λ|cof F|², and as μ|F|. So that a substep that is stable at rest stays stable however far
//! the tissue is pressed or pulled, W = μ(½|H|² + tr H) + ψ has in place of ψ = ½(λ + μ)(J − 1)² − μ(J − 1)
//!
//! g·ψ, g = s̄/s, s̄ = S + D·y/√(1 + y²), y = max(0, s − S)/D, s = |cof F|², with S = [`SOFTENS`] and D = [`SOFTENS_OVER`]: so s̄
//! is s up to S, and never more than S + D;
//!
//! and |(λ + μ)(J − 1)| grows no further than to [`LARGEST`]·μ. Its derivative is g·ψ′·cof F + 2g′ψ·(|F|²F − F·Fᵀ·F) with
//! g′ = ((1 + y²)^(−3/2) − g)/s. (A force that is only reduced there is the gradient of no energy, and kept cubes moving that were
//! turned inside out. With s̄ = min(s, 3.5) the stress jumps, and a cube that stays there has no force that substeps of any length
//! find. Here s̄ has no jump up to its second derivative, and schemes of high order keep their order.) Pressed by half of its
//! height, a block gives way as without limits.
#![allow(unsafe_code, clippy::needless_range_loop)]

use crate::kernel::lanes::Vector;
use crate::kernel::real::Real;

/// |cof F|² from which on ψ is reduced; 3 at rest.
const SOFTENS: f64 = 3.15;

/// How much more |cof F|² counts at most.
const SOFTENS_OVER: f64 = 0.4;

/// |4F|² up to which |cof F|² is below [`SOFTENS`]: 16·√(3·3.15), less a thousandth for rounding.
const MAY_SOFTEN: f64 = 49.13;

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

/// Sums and differences over the four corners of a cube with one y, by component: of all, with σ_z, with σ_x, and with σ_xσ_z. Of
/// forces, a corner gets the sum of the four with its own signs.
pub(crate) type CubeSide<V> = [[V; 4]; 3];

/// Returns one component of a side, from the corners nearer and farther along x at the lower z, and at the higher.
#[inline(always)]
pub(crate) fn side<V: Vector>([near, far]: [V; 2], [near_above, far_above]: [V; 2]) -> [V; 4] {
    let (sum, difference) = (far.add(near), far.sub(near));
    let (sum_above, difference_above) = (far_above.add(near_above), far_above.sub(near_above));
    [sum_above.add(sum), sum_above.sub(sum), difference_above.add(difference), difference_above.sub(difference)]
}

/// The patterns of a cube: h and the hourglasses g₁ to g₄, by component.
pub(crate) struct Patterns<V> {
    pub(super) h: [[V; 3]; 3],
    pub(super) g: [[V; 4]; 3],
}

/// What a cube pulls its corners with: 16 P and the factors of the first three hourglasses and of the fourth, all times the
/// weight; and the hourglasses.
pub(crate) struct Stress<V> {
    p: [[V; 3]; 3],
    g: [[V; 4]; 3],
    hours: [V; 2],
}

impl<V: Vector> Patterns<V> {
    /// Returns the patterns of cubes between two sides, the second farther along y.
    #[inline(always)]
    pub(crate) fn between(near: &CubeSide<V>, far: &CubeSide<V>) -> Self {
        let zero = near[0][0].splat(V::Real::default());
        let mut patterns = Patterns { h: [[zero; 3]; 3], g: [[zero; 4]; 3] };
        for c in 0..3 {
            let ([all, z, x, xz], [far_all, far_z, far_x, far_xz]) = (near[c], far[c]);
            patterns.h[c] = [far_x.add(x), far_all.sub(all), far_z.add(z)];
            patterns.g[c] = [far_z.sub(z), far_xz.add(xz), far_x.sub(x), far_xz.sub(xz)];
        }
        patterns
    }

    /// Writes the hourglasses where [`Stress::load`] reads them: as soon as they are known, because there are not registers enough to
    /// keep them for the stress.
    ///
    /// # Safety
    /// As [`Stress::store`].
    #[inline(always)]
    pub(super) unsafe fn store_hourglasses(&self, to: *mut V::Real) {
        // SAFETY: the caller's promise.
        unsafe {
            for c in 0..3 {
                for hour in 0..4 {
                    self.g[c][hour].store(to.add((9 + 4 * c + hour) * V::LANES));
                }
            }
        }
    }

    /// Returns the patterns of cubes by corner, x before y before z, and component.
    #[inline(always)]
    pub(crate) fn of_corners(corners: &[[V; 3]; 8]) -> Self {
        let zero = corners[0][0].splat(V::Real::default());
        let mut sides = [[[zero; 4]; 3]; 2];
        for y in 0..2 {
            for c in 0..3 {
                let of_row = |row: usize| [corners[2 * row][c], corners[2 * row + 1][c]];
                sides[y][c] = side(of_row(y), of_row(y + 2));
            }
        }
        Self::between(&sides[0], &sides[1])
    }
}

impl<V: Vector> Stress<V> {
    /// Number of vectors that [`Stress::store`] writes.
    pub(crate) const VECTORS: usize = 23;

    /// Creates it from 16 P and the factor μ/E, both times the weight, and the hourglasses.
    #[inline(always)]
    pub(super) fn of(p: [[V; 3]; 3], shear: V, g: [[V; 4]; 3]) -> Self {
        let hour = |factor: f64| shear.mul(shear.splat(V::Real::of(factor)));
        Stress { p, g, hours: [hour(8.0 / 3.0), hour(4.0 / 3.0)] }
    }

    /// Writes it, but for the hourglasses, which [`Patterns::store_hourglasses`] wrote.
    ///
    /// # Safety
    /// [`Stress::VECTORS`] vectors can be written at `to`.
    #[inline(always)]
    pub(super) unsafe fn store(&self, to: *mut V::Real) {
        // SAFETY: the caller's promise.
        unsafe {
            for c in 0..3 {
                for along in 0..3 {
                    self.p[c][along].store(to.add((3 * c + along) * V::LANES));
                }
            }
            self.hours[0].store(to.add(21 * V::LANES));
            self.hours[1].store(to.add(22 * V::LANES));
        }
    }

    /// Reads what [`Stress::store`] and [`Patterns::store_hourglasses`] wrote.
    ///
    /// # Safety
    /// The processor has the instructions, and the vectors can be read at `from`.
    #[inline(always)]
    pub(super) unsafe fn load(from: *const V::Real) -> Self {
        // SAFETY: the caller's promise.
        unsafe {
            let zero = V::of(V::Real::default());
            let (mut p, mut g) = ([[zero; 3]; 3], [[zero; 4]; 3]);
            for c in 0..3 {
                for along in 0..3 {
                    p[c][along] = V::load(from.add((3 * c + along) * V::LANES));
                }
                for hour in 0..4 {
                    g[c][hour] = V::load(from.add((9 + 4 * c + hour) * V::LANES));
                }
            }
            Stress { p, g, hours: [V::load(from.add(21 * V::LANES)), V::load(from.add(22 * V::LANES))] }
        }
    }

    /// Adds a component of the force on the side nearer along y to `sum`.
    #[inline(always)]
    pub(crate) fn on_near_side(&self, c: usize, sum: [V; 4]) -> [V; 4] {
        let ([px, py, pz], [g1, g2, g3, g4], [three, one]) = (self.p[c], self.g[c], self.hours);
        [
            sum[0].sub(py),
            sum[1].add(pz.minus(three, g1)),
            sum[2].add(px.minus(three, g3)),
            sum[3].add(three.mul(g2).minus(one, g4)),
        ]
    }

    /// Returns a component of the force on the side farther along y.
    #[inline(always)]
    pub(crate) fn on_far_side(&self, c: usize) -> [V; 4] {
        let ([px, py, pz], [g1, g2, g3, g4], [three, one]) = (self.p[c], self.g[c], self.hours);
        [py, three.mul_add(g1, pz), three.mul_add(g3, px), one.mul_add(g4, three.mul(g2))]
    }

    /// Returns the force on each corner, x before y before z, by component.
    #[inline(always)]
    pub(super) fn on_corners(&self) -> [[V; 3]; 8] {
        let zero = self.hours[0].splat(V::Real::default());
        let mut forces = [[zero; 3]; 8];
        for c in 0..3 {
            let sides = [self.on_near_side(c, [zero; 4]), self.on_far_side(c)];
            for corner in 0..8 {
                let [all, z, x, xz] = sides[corner >> 1 & 1];
                let (both, along) = if corner >> 2 == 1 { (all.add(z), x.add(xz)) } else { (all.sub(z), x.sub(xz)) };
                forces[corner][c] = if corner & 1 == 1 { zero.sub(both.add(along)) } else { along.sub(both) };
            }
        }
        forces
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
        let largest = growth.splat(self.largest_growth);
        growth.smaller(largest).larger(growth.splat(T::default()).sub(largest))
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
    pub(crate) fn stress<V: Vector<Real = T>>(&self, w: V, Patterns { h, g }: &Patterns<V>) -> Stress<V> {
        let shear = w.mul(w.splat(self.shear));
        let bulk = w.mul(w.splat(self.bulk));
        let Invariants { diagonal, cofactor, growth } = Invariants::of(h);
        let growing = self.growing(growth);
        let mut pressure = bulk.mul(growing);
        let mut q = bulk.mul(w.splat(T::of(0.0625))).mul(growing).sub(shear);
        let mut far = None;
        if V::any(may_soften(h, diagonal)) {
            let squares = squares(&cofactor);
            let is_far = squares.above(w.splat(T::of(256.0 * SOFTENS)));
            if V::any(is_far) {
                let psi = Self::psi(growth, growing, pressure, shear);
                let Softening { part, slope } = Softening::of(squares);
                let sixteen = w.splat(T::of(16.0));
                q = V::select(is_far, q.mul(part), q);
                pressure = V::select(is_far, sixteen.mul(q.add(shear)), pressure);
                far = Some((is_far, slope.mul(psi).mul(w.splat(T::of(2.0)))));
            }
        }
        // 16 P, all times the weight: 4μ·h + q·e + 16(q + μ)·I, where q is g·ψ′ and `pressure` 16(q + μ).
        let shear_four = shear.mul(w.splat(T::of(4.0)));
        let mut p = [[w; 3]; 3];
        for c in 0..3 {
            for along in 0..3 {
                let h = h[c][along];
                let own = if c == along { shear_four.mul_add(h, pressure) } else { shear_four.mul(h) };
                p[c][along] = q.mul_add(cofactor[c][along], own);
            }
        }
        if let Some((is_far, factor)) = far {
            let slope = half_slope_of_squares(h, diagonal);
            for c in 0..3 {
                for along in 0..3 {
                    let more = factor.mul_add(slope[c][along], p[c][along]);
                    p[c][along] = V::select(is_far, more, p[c][along]);
                }
            }
        }
        Stress::of(p, shear, *g)
    }

    /// Returns the energy of cubes, in the scheme's units of force times edges.
    #[inline(always)]
    pub(crate) fn energy<V: Vector<Real = T>>(&self, w: V, Patterns { h, g }: &Patterns<V>) -> V {
        let shear = w.mul(w.splat(self.shear));
        let bulk = w.mul(w.splat(self.bulk));
        let Invariants { cofactor, growth, .. } = Invariants::of(h);
        let trace = h[0][0].add(h[1][1]).add(h[2][2]);
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
        let less = Softening::of(squares(&cofactor)).part.sub(w.splat(T::of(1.0)));
        let reduced = less.mul(Self::psi(growth, growing, pressure, shear));
        shear.mul_add(of_h.add(of_g), swelling.add(reduced))
    }
}

/// What the law needs of h.
pub(super) struct Invariants<V> {
    /// The diagonal of 4F.
    diagonal: [V; 3],
    /// e = 16(cof F − I).
    pub(super) cofactor: [[V; 3]; 3],
    /// 64(J − 1).
    pub(super) growth: V,
}

impl<V: Vector> Invariants<V> {
    /// Computes them without a difference of large numbers at small h.
    #[inline(always)]
    pub(super) fn of(h: &[[V; 3]; 3]) -> Self {
        let zero = h[0][0].splat(V::Real::default());
        let four = zero.splat(V::Real::of(4.0));
        let diagonal = [h[0][0].add(four), h[1][1].add(four), h[2][2].add(four)];
        // An entry of 4F.
        let a = |i: usize, j: usize| if i == j { diagonal[i] } else { h[i][j] };
        let mut cofactor = [[zero; 3]; 3];
        for i in 0..3 {
            let (i1, i2) = ((i + 1) % 3, (i + 2) % 3);
            for j in 0..3 {
                let (j1, j2) = ((j + 1) % 3, (j + 2) % 3);
                cofactor[i][j] = if i == j {
                    let own = h[i1][i1].mul(h[i2][i2]).minus(h[i1][i2], h[i2][i1]);
                    four.mul_add(h[i1][i1].add(h[i2][i2]), own)
                } else {
                    a(i1, j1).mul(a(i2, j2)).minus(a(i1, j2), a(i2, j1))
                };
            }
        }
        let sixteen = zero.splat(V::Real::of(16.0));
        let apart = h[0][2].mul_add(cofactor[0][2], h[0][1].mul_add(cofactor[0][1], sixteen.mul(h[0][0])));
        Invariants { diagonal, cofactor, growth: diagonal[0].mul_add(cofactor[0][0], apart) }
    }
}

/// Returns the lanes where |cof F|² may be beyond [`SOFTENS`]: it is at most |F|⁴/3. Tissue that is only touched has none, and this
/// takes no cofactor; so its sums may have any order.
#[inline(always)]
fn may_soften<V: Vector>(h: &[[V; 3]; 3], diagonal: [V; 3]) -> V::Mask {
    let of_row = |a: V, b: V, c: V| c.mul_add(c, b.mul_add(b, a.mul(a)));
    let [first, second, third] = [
        of_row(diagonal[0], h[0][1], h[0][2]),
        of_row(h[1][0], diagonal[1], h[1][2]),
        of_row(h[2][0], h[2][1], diagonal[2]),
    ];
    first.add(second).add(third).above(first.splat(V::Real::of(MAY_SOFTEN)))
}

/// Returns 256|cof F|², from e.
#[inline(always)]
fn squares<V: Vector>(cofactor: &[[V; 3]; 3]) -> V {
    let sixteen = cofactor[0][0].splat(V::Real::of(16.0));
    let mut squares = cofactor[0][0].splat(V::Real::default());
    for i in 0..3 {
        for j in 0..3 {
            let value = if i == j { cofactor[i][j].add(sixteen) } else { cofactor[i][j] };
            squares = value.mul_add(value, squares);
        }
    }
    squares
}

/// How much ψ is reduced. A cube that is crushed beyond all measure has finite values too.
struct Softening<V> {
    /// g.
    part: V,
    /// Its derivative by 256|cof F|².
    slope: V,
}

impl<V: Vector> Softening<V> {
    /// Computes it from 256|cof F|².
    #[inline(always)]
    fn of(squares: V) -> Self {
        let of = |value: f64| squares.splat(V::Real::of(value));
        let squares = squares.larger(of(256.0 * SOFTENS));
        let y = squares.sub(of(256.0 * SOFTENS)).mul(of(1.0 / (256.0 * SOFTENS_OVER))).smaller(of(1e9));
        let inverse_root = of(1.0).div(y.mul_add(y, of(1.0)).root());
        let counted = y.mul(inverse_root).mul_add(of(256.0 * SOFTENS_OVER), of(256.0 * SOFTENS));
        let part = counted.div(squares);
        let slope_of_counted = inverse_root.mul(inverse_root).mul(inverse_root);
        Softening { part, slope: slope_of_counted.sub(part).div(squares) }
    }
}

/// Returns |A|²A − A·Aᵀ·A of A = 4F = 4 + h: half the derivative of |cof A|².
#[inline(always)]
fn half_slope_of_squares<V: Vector>(h: &[[V; 3]; 3], diagonal: [V; 3]) -> [[V; 3]; 3] {
    let zero = h[0][0].splat(V::Real::default());
    let mut a = *h;
    for c in 0..3 {
        a[c][c] = diagonal[c];
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
