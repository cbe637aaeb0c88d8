//! The NEON width, which every AArch64 processor has: 4 of f32, 2 of f64.
// If the compile target includes the instructions, calling them is safe; otherwise it is unsafe.
#![allow(unsafe_code, unused_unsafe)]

use super::{Real, Vector};

/// The operations that have the same name in both formats.
macro_rules! vector {
    ($name:ident, $real:ty, $lanes:literal, $mantissa:literal, $i:ident, |$self:ident, $before:ident| $shift_two:expr) => {
        /// A register.
        #[derive(Clone, Copy)]
        pub(crate) struct $name($i::Register);

        // SAFETY (of every block below): the processor has the instructions; memory is the caller's promise.
        impl Vector for $name {
            type Real = $real;
            type Mask = $i::Mask;
            const LANES: usize = $lanes;
            ordinary!($name, $real, $mantissa, $i);
            #[inline(always)]
            fn mul_add(self, b: Self, c: Self) -> Self {
                unsafe { $name($i::plus_product(c.0, self.0, b.0)) }
            }
            #[inline(always)]
            fn mul_sub(self, b: Self, c: Self) -> Self {
                unsafe { $name($i::plus_product($i::negative(c.0), self.0, b.0)) }
            }
            #[inline(always)]
            fn minus(self, a: Self, b: Self) -> Self {
                unsafe { $name($i::minus_product(self.0, a.0, b.0)) }
            }
            #[inline(always)]
            fn approximate_inverse_root(self) -> Self {
                unsafe {
                    let magic = $i::splat_bits(<$real as Real>::INVERSE_ROOT);
                    $name($i::real($i::sub_bits(magic, $i::half_bits::<1>($i::bits(self.0)))))
                }
            }
            #[inline(always)]
            fn larger(self, other: Self) -> Self {
                // Not the NEON maximum, which returns NaN for NaN and a number.
                unsafe { Self::select($i::greater(self.0, other.0), self, other) }
            }
            #[inline(always)]
            fn smaller(self, other: Self) -> Self {
                unsafe { Self::select($i::greater(other.0, self.0), self, other) }
            }
            #[inline(always)]
            fn farther(self, other: Self) -> Self {
                unsafe { $name($i::magnitude(self.0)).larger($name($i::magnitude(other.0))) }
            }
            #[inline(always)]
            fn beyond(self, bound: Self) -> $i::Mask {
                unsafe { $i::greater($i::magnitude(self.0), bound.0) }
            }
            #[inline(always)]
            fn above(self, bound: Self) -> $i::Mask {
                unsafe { $i::greater(self.0, bound.0) }
            }
            #[inline(always)]
            fn counts(self) -> $i::Mask {
                unsafe { $i::test_bits($i::bits(self.0), $i::splat_bits(<$real as Real>::MIN_BITS)) }
            }
            #[inline(always)]
            fn any(mask: $i::Mask) -> bool {
                unsafe { $i::largest($i::words(mask)) != 0 }
            }
            #[inline(always)]
            fn either(a: $i::Mask, b: $i::Mask) -> $i::Mask {
                unsafe { $i::or(a, b) }
            }
            #[inline(always)]
            fn both(a: $i::Mask, b: $i::Mask) -> $i::Mask {
                unsafe { $i::and(a, b) }
            }
            #[inline(always)]
            fn select(mask: $i::Mask, a: Self, b: Self) -> Self {
                unsafe { $name($i::select(mask, a.0, b.0)) }
            }
            #[inline(always)]
            #[allow(clippy::cast_precision_loss)]
            fn first(self, count: usize) -> $i::Mask {
                unsafe { $i::greater(self.splat(count.min($lanes) as $real).0, self.count(0).0) }
            }
            #[inline(always)]
            fn keep(self, mask: $i::Mask) -> Self {
                unsafe { $name($i::real($i::and(mask, $i::bits(self.0)))) }
            }
            #[inline(always)]
            fn shift(self, before: Self) -> Self {
                unsafe { $name($i::extract::<{ $lanes - 1 }>(before.0, self.0)) }
            }
            #[inline(always)]
            fn shift_two($self, $before: Self) -> Self {
                unsafe { $name($shift_two) }
            }
        }
    };
}

mod f32s {
    pub(super) use std::arch::aarch64::{
        float32x4_t as Register, uint32x4_t as Mask, uint32x4_t as Words, vabsq_f32 as magnitude, vaddq_f32 as add,
        vandq_u32 as and, vbslq_f32 as select, vcgtq_f32 as greater, vdivq_f32 as div, vdupq_n_f32 as splat,
        vdupq_n_u32 as splat_bits, vextq_f32 as extract, vfmaq_f32 as plus_product, vfmsq_f32 as minus_product,
        vld1q_f32 as load, vmaxvq_u32 as largest, vmulq_f32 as mul, vnegq_f32 as negative, vorrq_u32 as or,
        vreinterpretq_f32_u32 as real, vreinterpretq_u32_f32 as bits, vshlq_n_u32 as left, vshrq_n_u32 as half_bits,
        vsqrtq_f32 as root, vst1q_f32 as store, vsubq_f32 as sub, vsubq_u32 as sub_bits, vtstq_u32 as test_bits,
    };
    #[inline(always)]
    pub(super) fn words(mask: Mask) -> Words {
        mask
    }
}
mod f64s {
    pub(super) use std::arch::aarch64::{
        float64x2_t as Register, uint64x2_t as Mask, vabsq_f64 as magnitude, vaddq_f64 as add, vandq_u64 as and,
        vbslq_f64 as select, vcgtq_f64 as greater, vdivq_f64 as div, vdupq_n_f64 as splat, vdupq_n_u64 as splat_bits,
        vextq_f64 as extract, vfmaq_f64 as plus_product, vfmsq_f64 as minus_product, vld1q_f64 as load,
        vmaxvq_u32 as largest, vmulq_f64 as mul, vnegq_f64 as negative, vorrq_u64 as or, vreinterpretq_f64_u64 as real,
        vreinterpretq_u32_u64 as words, vreinterpretq_u64_f64 as bits, vshlq_n_u64 as left, vshrq_n_u64 as half_bits,
        vsqrtq_f64 as root, vst1q_f64 as store, vsubq_f64 as sub, vsubq_u64 as sub_bits, vtstq_u64 as test_bits,
    };
}

vector!(NeonF32, f32, 4, 23, f32s, |self, before| f32s::extract::<2>(before.0, self.0));
vector!(NeonF64, f64, 2, 52, f64s, |self, before| before.0);
