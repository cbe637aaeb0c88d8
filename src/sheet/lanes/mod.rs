//! Vectors of several widths, so that an algorithm is written once: AVX-512, AVX2 with FMA, NEON, and plain arrays.
//!
//! Every operation is one that IEEE 754 rounds exactly, or moves bits. So an algorithm in which a lane's result depends
//! only on that lane's inputs has the same bits at every width.
//!
//! The processor must have the instructions. [`Width::of`] checks that, and a vector is the proof: `unsafe` functions
//! that require the instructions create the first vectors, and all others come from vectors.
#![allow(unsafe_code)]

use super::real::Real;
use crate::scene::Lanes;

/// A fixed number of values that are processed together.
pub(super) trait Vector: Copy {
    type Real: Real;
    /// A set of lanes.
    type Mask: Copy;
    const LANES: usize;
    /// Whether the lanes form one register. If so, separate loops for the usual rows are worth their code size.
    const IS_REGISTER: bool = true;

    /// # Safety
    /// The processor has the instructions, and `LANES` values can be read at `from`.
    unsafe fn load(from: *const Self::Real) -> Self;
    /// # Safety
    /// `LANES` values can be written at `to`.
    unsafe fn store(self, to: *mut Self::Real);
    /// `value` in every lane.
    ///
    /// # Safety
    /// The processor has the instructions.
    unsafe fn of(value: Self::Real) -> Self;
    /// `value` in every lane; `self` only proves that the processor has such vectors.
    #[inline(always)]
    fn splat(self, value: Self::Real) -> Self {
        // SAFETY: `self` is such a vector.
        unsafe { Self::of(value) }
    }
    fn add(self, other: Self) -> Self;
    fn sub(self, other: Self) -> Self;
    fn mul(self, other: Self) -> Self;
    fn div(self, other: Self) -> Self;
    fn root(self) -> Self;
    /// self·b + c, rounded once.
    fn mul_add(self, b: Self, c: Self) -> Self;
    /// self·b − c, rounded once.
    fn mul_sub(self, b: Self, c: Self) -> Self;
    /// self − a·b, rounded once.
    fn minus(self, a: Self, b: Self) -> Self;
    /// 1/√self within 4 %, from half the exponent: the bits of a positive number are nearly its logarithm.
    fn rough_inverse_root(self) -> Self;
    /// 2^self, for integers from -100 to 100.
    fn power_of_two(self) -> Self;
    /// `first`, `first` + 1, …; `self` is the proof.
    fn count(self, first: usize) -> Self;
    /// The larger; `other` if one is NaN.
    fn larger(self, other: Self) -> Self;
    /// The value of larger magnitude; either if one is NaN.
    fn farther(self, other: Self) -> Self;
    /// Lanes where |self| > `bound`.
    fn beyond(self, bound: Self) -> Self::Mask;
    /// Lanes where self > `bound`.
    fn above(self, bound: Self) -> Self::Mask;
    /// Lanes where |self| is not below [`Real::LEAST`].
    fn counts(self) -> Self::Mask;
    fn any(mask: Self::Mask) -> bool;
    fn either(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// `a` where the mask is set, else `b`.
    fn select(mask: Self::Mask, a: Self, b: Self) -> Self;
    /// The first `count` lanes; `self` is the proof.
    fn first(self, count: usize) -> Self::Mask;
    /// 0 where the mask is not set.
    fn keep(self, mask: Self::Mask) -> Self;
    /// Shifts each lane up by one; the last lane of `before` comes in.
    fn shift(self, before: Self) -> Self;
    /// Shifts each lane up by two; the last two lanes of `before` come in.
    fn shift_two(self, before: Self) -> Self;
}

/// A program that can run at any width.
pub(super) trait Run<T> {
    /// # Safety
    /// The processor has the instructions of `V`, and the pointers of `self` are valid as documented.
    unsafe fn run<V: Vector<Real = T>>(&self);
}

/// Lanes processed one by one, for processors without any of the instruction sets, and for single points.
#[derive(Clone, Copy)]
pub(super) struct Plain<T, const N: usize>([T; N]);

impl<T: Real, const N: usize> Plain<T, N> {
    /// a·b + c. Not inlined: without the instruction each lane is a function call, and a row of points has hundreds.
    #[inline(never)]
    fn fused(a: Self, b: Self, c: Self) -> Self {
        Plain(std::array::from_fn(|lane| a.0[lane].fused(b.0[lane], c.0[lane])))
    }

    #[inline(always)]
    fn negative(self) -> Self {
        Plain(self.0.map(|value| -value))
    }

    #[inline(always)]
    fn each(self, other: Self, f: impl Fn(T, T) -> T) -> Self {
        Plain(std::array::from_fn(|lane| f(self.0[lane], other.0[lane])))
    }
}

impl<T: Real> Plain<T, 1> {
    /// A vector of one lane.
    pub(super) fn one(value: T) -> Self {
        Plain([value])
    }

    /// The value of the one lane.
    pub(super) fn value(self) -> T {
        self.0[0]
    }
}

impl<T: Real, const N: usize> Vector for Plain<T, N> {
    type Real = T;
    type Mask = [bool; N];
    const LANES: usize = N;
    const IS_REGISTER: bool = false;

    #[inline(always)]
    unsafe fn load(from: *const T) -> Self {
        // SAFETY: the caller's promise.
        Plain(unsafe { from.cast::<[T; N]>().read() })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut T) {
        // SAFETY: the caller's promise.
        unsafe { to.cast::<[T; N]>().write(self.0) }
    }
    #[inline(always)]
    unsafe fn of(value: T) -> Self {
        Plain([value; N])
    }
    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.each(other, |a, b| a + b)
    }
    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.each(other, |a, b| a - b)
    }
    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.each(other, |a, b| a * b)
    }
    #[inline(always)]
    fn div(self, other: Self) -> Self {
        self.each(other, |a, b| a / b)
    }
    #[inline(always)]
    fn root(self) -> Self {
        Plain(self.0.map(Real::root))
    }
    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        Self::fused(self, b, c)
    }
    #[inline(always)]
    fn mul_sub(self, b: Self, c: Self) -> Self {
        Self::fused(self, b, c.negative())
    }
    #[inline(always)]
    fn minus(self, a: Self, b: Self) -> Self {
        Self::fused(a.negative(), b, self)
    }
    #[inline(always)]
    fn rough_inverse_root(self) -> Self {
        Plain(self.0.map(Real::rough_inverse_root))
    }
    #[inline(always)]
    fn power_of_two(self) -> Self {
        Plain(self.0.map(Real::power_of_two))
    }
    #[inline(always)]
    #[allow(clippy::cast_precision_loss)]
    fn count(self, first: usize) -> Self {
        Plain(std::array::from_fn(|lane| T::of((first + lane) as f64)))
    }
    #[inline(always)]
    fn larger(self, other: Self) -> Self {
        self.each(other, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn farther(self, other: Self) -> Self {
        self.each(other, |a, b| if a.magnitude() > b.magnitude() { a.magnitude() } else { b.magnitude() })
    }
    #[inline(always)]
    fn beyond(self, bound: Self) -> [bool; N] {
        std::array::from_fn(|lane| self.0[lane].magnitude() > bound.0[lane])
    }
    #[inline(always)]
    fn above(self, bound: Self) -> [bool; N] {
        std::array::from_fn(|lane| self.0[lane] > bound.0[lane])
    }
    #[inline(always)]
    #[allow(clippy::neg_cmp_op_on_partial_ord)]
    fn counts(self) -> [bool; N] {
        // NaN counts, so that a check can find it.
        std::array::from_fn(|lane| !(self.0[lane].magnitude() < T::of(T::LEAST)))
    }
    #[inline(always)]
    fn any(mask: [bool; N]) -> bool {
        mask.contains(&true)
    }
    #[inline(always)]
    fn either(a: [bool; N], b: [bool; N]) -> [bool; N] {
        std::array::from_fn(|lane| a[lane] || b[lane])
    }
    #[inline(always)]
    fn both(a: [bool; N], b: [bool; N]) -> [bool; N] {
        std::array::from_fn(|lane| a[lane] && b[lane])
    }
    #[inline(always)]
    fn select(mask: [bool; N], a: Self, b: Self) -> Self {
        Plain(std::array::from_fn(|lane| if mask[lane] { a.0[lane] } else { b.0[lane] }))
    }
    #[inline(always)]
    fn first(self, count: usize) -> [bool; N] {
        std::array::from_fn(|lane| lane < count)
    }
    #[inline(always)]
    fn keep(self, mask: [bool; N]) -> Self {
        Self::select(mask, self, Plain([T::default(); N]))
    }
    #[inline(always)]
    fn shift(self, before: Self) -> Self {
        Plain(std::array::from_fn(|lane| if lane == 0 { before.0[N - 1] } else { self.0[lane - 1] }))
    }
    #[inline(always)]
    fn shift_two(self, before: Self) -> Self {
        Plain(std::array::from_fn(|lane| if lane < 2 { before.0[N - 2 + lane] } else { self.0[lane - 2] }))
    }
}

/// The lanes that `auto` selects on this machine, or the requested ones if it has them.
pub(super) fn available(lanes: Lanes) -> Option<Lanes> {
    #[cfg(target_arch = "x86_64")]
    let (wide, narrow) = {
        // `range` needs AVX-512DQ.
        let wide = is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq");
        (wide, is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"))
    };
    #[cfg(not(target_arch = "x86_64"))]
    let (wide, narrow) = (false, false);
    // A compile-time fact: every AArch64 processor has it.
    let neon = cfg!(target_arch = "aarch64");
    match lanes {
        Lanes::Auto if wide => Some(Lanes::Avx512),
        Lanes::Auto if narrow => Some(Lanes::Avx2),
        Lanes::Auto if neon => Some(Lanes::Neon),
        Lanes::Auto | Lanes::Plain => Some(Lanes::Plain),
        Lanes::Avx512 => wide.then_some(Lanes::Avx512),
        Lanes::Avx2 => narrow.then_some(Lanes::Avx2),
        Lanes::Neon => neon.then_some(Lanes::Neon),
    }
}

/// Lanes that this machine supports.
#[derive(Debug, Clone, Copy)]
pub(super) struct Width(Lanes);

impl Width {
    /// The requested lanes if this machine has them, else those of `auto`.
    pub(super) fn of(lanes: Lanes) -> Self {
        Width(available(lanes).or_else(|| available(Lanes::Auto)).unwrap_or(Lanes::Plain))
    }
}

/// Runs `program` at a width.
///
/// # Safety
/// The pointers of `program` are valid as documented.
pub(super) unsafe fn run<T: Real>(width: Width, program: &impl Run<T>) {
    // SAFETY: `Width::of` has checked the instructions; the rest is the caller's promise.
    unsafe {
        match width.0 {
            #[cfg(target_arch = "x86_64")]
            Lanes::Avx512 => x86::with_avx512(program),
            #[cfg(target_arch = "x86_64")]
            Lanes::Avx2 => x86::with_avx2(program),
            #[cfg(target_arch = "aarch64")]
            Lanes::Neon => program.run::<T::Neon>(),
            _ => program.run::<Plain<T, 2>>(),
        }
    }
}

/// The operations that registers of every kind have under the same name.
// SAFETY (of every block): the processor has the instructions. The functions that create the first value require it,
// and every other function takes a value. Memory is the caller's promise.
#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
macro_rules! ordinary {
    ($name:ident, $real:ty, $mantissa:literal, $i:ident) => {
        #[inline(always)]
        unsafe fn load(from: *const $real) -> Self {
            unsafe { $name($i::load(from)) }
        }
        #[inline(always)]
        unsafe fn store(self, to: *mut $real) {
            unsafe { $i::store(to, self.0) }
        }
        #[inline(always)]
        unsafe fn of(value: $real) -> Self {
            unsafe { $name($i::splat(value)) }
        }
        #[inline(always)]
        fn add(self, other: Self) -> Self {
            unsafe { $name($i::add(self.0, other.0)) }
        }
        #[inline(always)]
        fn sub(self, other: Self) -> Self {
            unsafe { $name($i::sub(self.0, other.0)) }
        }
        #[inline(always)]
        fn mul(self, other: Self) -> Self {
            unsafe { $name($i::mul(self.0, other.0)) }
        }
        #[inline(always)]
        fn div(self, other: Self) -> Self {
            unsafe { $name($i::div(self.0, other.0)) }
        }
        #[inline(always)]
        fn root(self) -> Self {
            unsafe { $name($i::root(self.0)) }
        }
        #[inline(always)]
        fn power_of_two(self) -> Self {
            // The last bits of the sum are the exponent.
            let sum = self.add(self.splat(<$real>::of(<$real as Real>::POWER)));
            unsafe { $name($i::real($i::left::<$mantissa>($i::bits(sum.0)))) }
        }
        #[inline(always)]
        #[allow(clippy::cast_precision_loss)]
        fn count(self, first: usize) -> Self {
            const COUNT: [$real; 16] =
                [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0];
            unsafe { $name($i::load(COUNT.as_ptr())).add(self.splat(first as $real)) }
        }
    };
}

#[cfg(target_arch = "x86_64")]
mod x86;
#[cfg(target_arch = "x86_64")]
pub(super) use x86::{NarrowF32, NarrowF64, WideF32, WideF64};

#[cfg(target_arch = "aarch64")]
mod neon;
#[cfg(target_arch = "aarch64")]
pub(super) use neon::{NeonF32, NeonF64};

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    /// Every operation on every lane, in one array.
    struct Everything<'a, T> {
        a: &'a [T; 16],
        b: &'a [T; 16],
        out: *mut T,
    }

    impl<T: Real> Run<T> for Everything<'_, T> {
        #[inline(always)]
        unsafe fn run<V: Vector<Real = T>>(&self) {
            unsafe {
                let mut before = V::of(T::of(7.0));
                for at in (0..16).step_by(V::LANES) {
                    let (a, b) = (V::load(self.a.as_ptr().add(at)), V::load(self.b.as_ptr().add(at)));
                    let mask = a.first(11_usize.saturating_sub(at));
                    let far = V::either(a.beyond(a.splat(T::of(2.5))), b.beyond(a.splat(T::of(100.0))));
                    let results = [
                        a.add(b),
                        a.sub(b),
                        a.mul(b),
                        a.div(b),
                        a.mul(a).root(),
                        a.mul_add(b, a),
                        a.mul_sub(b, b),
                        a.larger(b),
                        a.farther(b),
                        V::select(far, a, b),
                        a.keep(mask),
                        a.shift(before),
                        a.shift_two(before),
                        a.minus(a, b),
                        b.mul(b).rough_inverse_root(),
                        a.count(at).sub(a.splat(T::of(9.0))).power_of_two(),
                        a.keep(a.mul(a.splat(T::of(T::LEAST))).counts()),
                        a.keep(V::both(a.above(b), mask)),
                        if V::any(mask) { a } else { b },
                    ];
                    before = a;
                    for (n, result) in results.into_iter().enumerate() {
                        // Whether any lane is set depends on the width by definition.
                        if n < 18 {
                            result.store(self.out.add(16 * n + at));
                        }
                    }
                }
            }
        }
    }

    fn same_at_every_width<T: Real>() {
        let a: [T; 16] = std::array::from_fn(|i| T::of(0.37 * i as f64 * if i % 3 == 0 { -1.0 } else { 1.1 }));
        let b: [T; 16] = std::array::from_fn(|i| T::of(13.0 / (1.0 + i as f64) - 2.0));
        let result = |lanes| {
            let mut out = vec![T::default(); 18 * 16];
            unsafe { run(Width::of(lanes), &Everything { a: &a, b: &b, out: out.as_mut_ptr() }) };
            out.into_iter().map(Real::wide).collect::<Vec<_>>()
        };
        let plain = result(Lanes::Plain);
        assert!(plain.iter().any(|v| *v != 0.0));
        for lanes in [Lanes::Avx2, Lanes::Avx512, Lanes::Neon] {
            if available(lanes).is_some() {
                assert_eq!(result(lanes), plain, "{lanes:?}");
            }
        }
    }

    #[test]
    fn every_operation_has_the_same_bits_at_every_width() {
        same_at_every_width::<f32>();
        same_at_every_width::<f64>();
    }
}
