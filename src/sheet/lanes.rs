//! Vectors of several widths, so that one algorithm is written once: AVX-512, AVX2 with FMA, and plain arrays.
//!
//! Every operation is one that IEEE 754 rounds exactly, or moves bits. An algorithm in which a lane's result depends on
//! that lane's inputs alone therefore has the same bits at every width. This file and `sweep` are the only ones with
//! unsafe code: an instruction must exist on the processor, which [`Run::run`] makes sure of, once.
#![allow(unsafe_code)]

use super::real::Real;
use crate::scene::Lanes;

/// A fixed number of numbers that are worked on together.
pub(super) trait Vector: Copy {
    type Real: Real;
    /// Which lanes.
    type Mask: Copy;
    const LANES: usize;

    /// # Safety
    /// `LANES` values can be read at `from`.
    unsafe fn load(from: *const Self::Real) -> Self;
    /// # Safety
    /// `LANES` values can be written at `to`.
    unsafe fn store(self, to: *mut Self::Real);
    fn splat(value: Self::Real) -> Self;
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
    /// The larger; `other` if one is NaN.
    fn larger(self, other: Self) -> Self;
    /// The larger magnitude; whichever if one is NaN.
    fn farther(self, other: Self) -> Self;
    /// Where |self| > `bound`.
    fn beyond(self, bound: Self) -> Self::Mask;
    fn any(mask: Self::Mask) -> bool;
    fn either(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// `a` where the mask is set, else `b`.
    fn select(mask: Self::Mask, a: Self, b: Self) -> Self;
    /// The first `count` lanes.
    fn first(count: usize) -> Self::Mask;
    /// 0 where the mask is not set.
    fn keep(self, mask: Self::Mask) -> Self;
    /// Each lane one place up; the last of `before` comes in.
    fn shift(self, before: Self) -> Self;
    /// Each lane two places up; the last two of `before` come in.
    fn shift_two(self, before: Self) -> Self;
}

/// What can be run at any width.
pub(super) trait Run<T> {
    /// # Safety
    /// The processor has the instructions of `V`, and what `self` points to is as it promised.
    unsafe fn run<V: Vector<Real = T>>(&self);
}

/// Lanes one by one, for processors that have neither of the others, and for single points.
#[derive(Clone, Copy)]
pub(super) struct Plain<T, const N: usize>([T; N]);

impl<T: Real, const N: usize> Plain<T, N> {
    fn each(self, other: Self, f: impl Fn(T, T) -> T) -> Self {
        Plain(std::array::from_fn(|lane| f(self.0[lane], other.0[lane])))
    }
}

impl<T: Real> Plain<T, 1> {
    /// A single lane.
    pub(super) fn one(value: T) -> Self {
        Plain([value])
    }

    /// The one value.
    pub(super) fn value(self) -> T {
        self.0[0]
    }
}

impl<T: Real, const N: usize> Vector for Plain<T, N> {
    type Real = T;
    type Mask = [bool; N];
    const LANES: usize = N;

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
    fn splat(value: T) -> Self {
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
        Plain(std::array::from_fn(|lane| self.0[lane].fused(b.0[lane], c.0[lane])))
    }
    #[inline(always)]
    fn mul_sub(self, b: Self, c: Self) -> Self {
        Plain(std::array::from_fn(|lane| self.0[lane].fused(b.0[lane], -c.0[lane])))
    }
    #[inline(always)]
    fn minus(self, a: Self, b: Self) -> Self {
        Plain(std::array::from_fn(|lane| (-a.0[lane]).fused(b.0[lane], self.0[lane])))
    }
    #[inline(always)]
    fn rough_inverse_root(self) -> Self {
        Plain(self.0.map(Real::rough_inverse_root))
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
    fn any(mask: [bool; N]) -> bool {
        mask.contains(&true)
    }
    #[inline(always)]
    fn either(a: [bool; N], b: [bool; N]) -> [bool; N] {
        std::array::from_fn(|lane| a[lane] || b[lane])
    }
    #[inline(always)]
    fn select(mask: [bool; N], a: Self, b: Self) -> Self {
        Plain(std::array::from_fn(|lane| if mask[lane] { a.0[lane] } else { b.0[lane] }))
    }
    #[inline(always)]
    fn first(count: usize) -> [bool; N] {
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

/// Which lanes `auto` becomes on this machine, or whether those asked for are there.
pub(super) fn available(lanes: Lanes) -> Option<Lanes> {
    #[cfg(target_arch = "x86_64")]
    let (wide, narrow) = {
        // `range` is of DQ.
        let wide = is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("avx512dq");
        (wide, is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"))
    };
    #[cfg(not(target_arch = "x86_64"))]
    let (wide, narrow) = (false, false);
    match lanes {
        Lanes::Auto if wide => Some(Lanes::Avx512),
        Lanes::Auto if narrow => Some(Lanes::Avx2),
        Lanes::Auto | Lanes::Plain => Some(Lanes::Plain),
        Lanes::Avx512 => wide.then_some(Lanes::Avx512),
        Lanes::Avx2 => narrow.then_some(Lanes::Avx2),
    }
}

/// Runs `program` with the lanes that [`available`] said are there.
///
/// # Safety
/// What `program` points to is as it promised.
pub(super) unsafe fn run<T: Real>(lanes: Lanes, program: &impl Run<T>) {
    #[cfg(target_arch = "x86_64")]
    let _flushing = x86::Flushing::begin();
    // SAFETY: the instructions are there, by `available`; the rest is the caller's promise.
    unsafe {
        match available(lanes) {
            #[cfg(target_arch = "x86_64")]
            Some(Lanes::Avx512) => x86::with_avx512(program),
            #[cfg(target_arch = "x86_64")]
            Some(Lanes::Avx2) => x86::with_avx2(program),
            _ => program.run::<Plain<T, 16>>(),
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::arch::x86_64::_CMP_GT_OQ;

    use super::{Real, Run, Vector};

    /// While one is alive, results and operands below the normal range count as 0 on this thread. Fields decay in time
    /// and towards the rim of a sheet without end, and each operation on the subnormal numbers at which they arrive
    /// costs as much as a hundred others.
    pub(super) struct Flushing {
        before: u32,
    }

    /// Flush to zero, and denormals are zero: bits of the control register.
    const FLUSH: u32 = 0x8040;

    impl Flushing {
        pub(super) fn begin() -> Self {
            let mut before = 0_u32;
            // SAFETY: stores the control register to a place of its size.
            unsafe { std::arch::asm!("stmxcsr [{}]", in(reg) &raw mut before, options(nostack)) };
            Flushing::set(before | FLUSH);
            Flushing { before }
        }

        fn set(control: u32) {
            // SAFETY: only the two bits change, which alter nothing but numbers below the normal range; they are put
            // back before anything other than a sweep runs.
            unsafe { std::arch::asm!("ldmxcsr [{}]", in(reg) &raw const control, options(nostack, readonly)) };
        }
    }

    impl Drop for Flushing {
        fn drop(&mut self) {
            Flushing::set(self.before);
        }
    }

    /// # Safety
    /// As [`super::run`], and the processor has these instructions.
    #[target_feature(enable = "avx512f,avx512dq,fma")]
    pub(super) unsafe fn with_avx512<T: Real>(program: &impl Run<T>) {
        // SAFETY: the caller's promise.
        unsafe { program.run::<T::Avx512>() }
    }

    /// # Safety
    /// As [`super::run`], and the processor has these instructions.
    #[target_feature(enable = "avx2,fma")]
    pub(super) unsafe fn with_avx2<T: Real>(program: &impl Run<T>) {
        // SAFETY: the caller's promise.
        unsafe { program.run::<T::Avx2>() }
    }

    /// The operations that both widths and both formats have under one name; the others follow in braces.
    macro_rules! vector {
        ($name:ident, $real:ty, $lanes:literal, $mask:ty, $i:ident, { $($own:tt)* }) => {
            /// A register.
            #[derive(Clone, Copy)]
            pub(in super::super) struct $name($i::Register);

            // SAFETY (of every block below): a value of this type is only made by `Run::run`, for which the processor
            // has the instructions; memory is the caller's promise.
            impl Vector for $name {
                type Real = $real;
                type Mask = $mask;
                const LANES: usize = $lanes;
                #[inline(always)]
                unsafe fn load(from: *const $real) -> Self {
                    unsafe { $name($i::load(from)) }
                }
                #[inline(always)]
                unsafe fn store(self, to: *mut $real) {
                    unsafe { $i::store(to, self.0) }
                }
                #[inline(always)]
                fn splat(value: $real) -> Self {
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
                fn mul_add(self, b: Self, c: Self) -> Self {
                    unsafe { $name($i::mul_add(self.0, b.0, c.0)) }
                }
                #[inline(always)]
                fn mul_sub(self, b: Self, c: Self) -> Self {
                    unsafe { $name($i::mul_sub(self.0, b.0, c.0)) }
                }
                #[inline(always)]
                fn minus(self, a: Self, b: Self) -> Self {
                    unsafe { $name($i::minus(a.0, b.0, self.0)) }
                }
                #[inline(always)]
                fn rough_inverse_root(self) -> Self {
                    unsafe {
                        let magic = $i::splat_bits(<$real as Real>::INVERSE_ROOT.cast_signed());
                        $name($i::real($i::sub_bits(magic, $i::half_bits::<1>($i::bits(self.0)))))
                    }
                }
                #[inline(always)]
                fn larger(self, other: Self) -> Self {
                    unsafe { $name($i::larger(self.0, other.0)) }
                }
                $($own)*
            }
        };
    }

    /// What AVX-512 has, for a format: masks of its own kind, and shifts across the register.
    macro_rules! avx512 {
        ($name:ident, $real:ty, $lanes:literal, $mask:ty, $i:ident) => {
            vector!($name, $real, $lanes, $mask, $i, {
                #[inline(always)]
                fn farther(self, other: Self) -> Self {
                    // The larger magnitude, with its sign cleared.
                    unsafe { $name($i::range::<0b1011>(self.0, other.0)) }
                }
                #[inline(always)]
                fn beyond(self, bound: Self) -> $mask {
                    unsafe { $i::compare::<_CMP_GT_OQ>($i::magnitude(self.0), bound.0) }
                }
                #[inline(always)]
                fn any(mask: $mask) -> bool {
                    mask != 0
                }
                #[inline(always)]
                fn either(a: $mask, b: $mask) -> $mask {
                    a | b
                }
                #[inline(always)]
                fn select(mask: $mask, a: Self, b: Self) -> Self {
                    unsafe { $name($i::select(b.0, mask, a.0)) }
                }
                #[inline(always)]
                fn first(count: usize) -> $mask {
                    if count >= $lanes { <$mask>::MAX } else { (1 << count) - 1 }
                }
                #[inline(always)]
                fn keep(self, mask: $mask) -> Self {
                    unsafe { $name($i::keep(mask, self.0)) }
                }
                #[inline(always)]
                fn shift(self, before: Self) -> Self {
                    unsafe { $name($i::real($i::align::<{ $lanes - 1 }>($i::bits(self.0), $i::bits(before.0)))) }
                }
                #[inline(always)]
                fn shift_two(self, before: Self) -> Self {
                    unsafe { $name($i::real($i::align::<{ $lanes - 2 }>($i::bits(self.0), $i::bits(before.0)))) }
                }
            });
        };
    }

    /// What AVX2 has, for a format: masks are registers, and a shift first brings both halves together.
    macro_rules! avx2 {
        ($name:ident, $real:ty, $lanes:literal, $i:ident, $indices:expr, |$high:ident, $mid:ident| $shift:expr,
         |$high2:ident, $mid2:ident| $shift_two:expr) => {
            vector!($name, $real, $lanes, $i::Register, $i, {
                #[inline(always)]
                fn farther(self, other: Self) -> Self {
                    unsafe {
                        let sign = $i::splat(-0.0);
                        $name($i::larger($i::and_not(sign, self.0), $i::and_not(sign, other.0)))
                    }
                }
                #[inline(always)]
                fn beyond(self, bound: Self) -> $i::Register {
                    unsafe { $i::compare::<_CMP_GT_OQ>($i::and_not($i::splat(-0.0), self.0), bound.0) }
                }
                #[inline(always)]
                fn any(mask: $i::Register) -> bool {
                    unsafe { $i::signs(mask) != 0 }
                }
                #[inline(always)]
                fn either(a: $i::Register, b: $i::Register) -> $i::Register {
                    unsafe { $i::or(a, b) }
                }
                #[inline(always)]
                fn select(mask: $i::Register, a: Self, b: Self) -> Self {
                    unsafe { $name($i::select(b.0, a.0, mask)) }
                }
                #[inline(always)]
                #[allow(clippy::cast_precision_loss)]
                fn first(count: usize) -> $i::Register {
                    const INDICES: [$real; $lanes] = $indices;
                    unsafe {
                        $i::compare::<_CMP_GT_OQ>($i::splat(count.min($lanes) as $real), $i::load(INDICES.as_ptr()))
                    }
                }
                #[inline(always)]
                fn keep(self, mask: $i::Register) -> Self {
                    unsafe { $name($i::and(mask, self.0)) }
                }
                #[inline(always)]
                fn shift(self, before: Self) -> Self {
                    unsafe {
                        let ($high, $mid) = (self.0, $i::halves::<0x21>(before.0, self.0));
                        $name($shift)
                    }
                }
                #[inline(always)]
                fn shift_two(self, before: Self) -> Self {
                    unsafe {
                        let ($high2, $mid2) = (self.0, $i::halves::<0x21>(before.0, self.0));
                        $name($shift_two)
                    }
                }
            });
        };
    }

    mod wide_f32 {
        pub(super) use std::arch::x86_64::{
            __m512 as Register, _mm512_abs_ps as magnitude, _mm512_add_ps as add, _mm512_alignr_epi32 as align,
            _mm512_castps_si512 as bits, _mm512_castsi512_ps as real, _mm512_cmp_ps_mask as compare,
            _mm512_div_ps as div, _mm512_fmadd_ps as mul_add, _mm512_fmsub_ps as mul_sub, _mm512_fnmadd_ps as minus,
            _mm512_loadu_ps as load, _mm512_mask_mov_ps as select, _mm512_maskz_mov_ps as keep,
            _mm512_max_ps as larger, _mm512_mul_ps as mul, _mm512_range_ps as range, _mm512_set1_epi32 as splat_bits,
            _mm512_set1_ps as splat, _mm512_sqrt_ps as root, _mm512_srli_epi32 as half_bits, _mm512_storeu_ps as store,
            _mm512_sub_epi32 as sub_bits, _mm512_sub_ps as sub,
        };
    }
    mod wide_f64 {
        pub(super) use std::arch::x86_64::{
            __m512d as Register, _mm512_abs_pd as magnitude, _mm512_add_pd as add, _mm512_alignr_epi64 as align,
            _mm512_castpd_si512 as bits, _mm512_castsi512_pd as real, _mm512_cmp_pd_mask as compare,
            _mm512_div_pd as div, _mm512_fmadd_pd as mul_add, _mm512_fmsub_pd as mul_sub, _mm512_fnmadd_pd as minus,
            _mm512_loadu_pd as load, _mm512_mask_mov_pd as select, _mm512_maskz_mov_pd as keep,
            _mm512_max_pd as larger, _mm512_mul_pd as mul, _mm512_range_pd as range, _mm512_set1_epi64 as splat_bits,
            _mm512_set1_pd as splat, _mm512_sqrt_pd as root, _mm512_srli_epi64 as half_bits, _mm512_storeu_pd as store,
            _mm512_sub_epi64 as sub_bits, _mm512_sub_pd as sub,
        };
    }
    mod narrow_f32 {
        pub(super) use std::arch::x86_64::{
            __m256 as Register, _mm256_add_ps as add, _mm256_alignr_epi8 as align, _mm256_and_ps as and,
            _mm256_andnot_ps as and_not, _mm256_blendv_ps as select, _mm256_castps_si256 as bits,
            _mm256_castsi256_ps as real, _mm256_cmp_ps as compare, _mm256_div_ps as div, _mm256_fmadd_ps as mul_add,
            _mm256_fmsub_ps as mul_sub, _mm256_fnmadd_ps as minus, _mm256_loadu_ps as load, _mm256_max_ps as larger,
            _mm256_movemask_ps as signs, _mm256_mul_ps as mul, _mm256_or_ps as or, _mm256_permute2f128_ps as halves,
            _mm256_set1_epi32 as splat_bits, _mm256_set1_ps as splat, _mm256_sqrt_ps as root,
            _mm256_srli_epi32 as half_bits, _mm256_storeu_ps as store, _mm256_sub_epi32 as sub_bits,
            _mm256_sub_ps as sub,
        };
    }
    mod narrow_f64 {
        pub(super) use std::arch::x86_64::{
            __m256d as Register, _mm256_add_pd as add, _mm256_and_pd as and, _mm256_andnot_pd as and_not,
            _mm256_blendv_pd as select, _mm256_castpd_si256 as bits, _mm256_castsi256_pd as real,
            _mm256_cmp_pd as compare, _mm256_div_pd as div, _mm256_fmadd_pd as mul_add, _mm256_fmsub_pd as mul_sub,
            _mm256_fnmadd_pd as minus, _mm256_loadu_pd as load, _mm256_max_pd as larger, _mm256_movemask_pd as signs,
            _mm256_mul_pd as mul, _mm256_or_pd as or, _mm256_permute2f128_pd as halves,
            _mm256_set1_epi64x as splat_bits, _mm256_set1_pd as splat, _mm256_shuffle_pd as shuffle,
            _mm256_sqrt_pd as root, _mm256_srli_epi64 as half_bits, _mm256_storeu_pd as store,
            _mm256_sub_epi64 as sub_bits, _mm256_sub_pd as sub,
        };
    }

    avx512!(WideF32, f32, 16, u16, wide_f32);
    avx512!(WideF64, f64, 8, u8, wide_f64);
    avx2!(
        NarrowF32,
        f32,
        8,
        narrow_f32,
        [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0],
        |high, mid| narrow_f32::real(narrow_f32::align::<12>(narrow_f32::bits(high), narrow_f32::bits(mid))),
        |high, mid| narrow_f32::real(narrow_f32::align::<8>(narrow_f32::bits(high), narrow_f32::bits(mid)))
    );
    avx2!(
        NarrowF64,
        f64,
        4,
        narrow_f64,
        [0.0, 1.0, 2.0, 3.0],
        |high, mid| narrow_f64::shuffle::<0b0101>(mid, high),
        |_high, mid| mid
    );
}
#[cfg(target_arch = "x86_64")]
pub(super) use x86::{NarrowF32, NarrowF64, WideF32, WideF64};

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
                let mut before = V::splat(T::of(7.0));
                for at in (0..16).step_by(V::LANES) {
                    let (a, b) = (V::load(self.a.as_ptr().add(at)), V::load(self.b.as_ptr().add(at)));
                    let mask = V::first(11_usize.saturating_sub(at));
                    let far = V::either(a.beyond(V::splat(T::of(2.5))), b.beyond(V::splat(T::of(100.0))));
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
                        if V::any(mask) { a } else { b },
                    ];
                    before = a;
                    for (n, result) in results.into_iter().enumerate() {
                        // Whether any lane is set depends on the width by nature.
                        if n < 15 {
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
            let mut out = vec![T::default(); 16 * 15];
            unsafe { run(lanes, &Everything { a: &a, b: &b, out: out.as_mut_ptr() }) };
            out.into_iter().map(Real::wide).collect::<Vec<_>>()
        };
        let plain = result(Lanes::Plain);
        assert!(plain.iter().any(|v| *v != 0.0));
        for lanes in [Lanes::Avx2, Lanes::Avx512] {
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
