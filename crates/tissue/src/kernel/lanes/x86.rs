//! The widths of x86-64: AVX-512, and AVX2 with FMA.
#![allow(unsafe_code)]

use std::arch::x86_64::{_CMP_GT_OQ, _CMP_NLT_UQ, _MM_HINT_T0, _mm_prefetch};

use super::{Names, Real, Run, Vector};

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

/// # Safety
/// As [`super::run`], and the processor has this instruction.
#[target_feature(enable = "fma")]
pub(super) unsafe fn with_fma<T: Real>(program: &impl Run<T>) {
    // SAFETY: the caller's promise.
    unsafe { program.run::<super::Pair<T>>() }
}

/// The operations that have the same name in both widths and both formats; the others follow in braces.
macro_rules! vector {
    ($name:ident, $real:ty, $lanes:literal, $mantissa:literal, $mask:ty, $i:ident, { $($own:tt)* }) => {
        /// A register.
        #[derive(Clone, Copy)]
        pub(crate) struct $name($i::Register);

        // SAFETY (of every block below): the processor has the instructions. The functions that create the first value
        // require it, and every other function takes a value. Memory is the caller's promise.
        impl Vector for $name {
            type Real = $real;
            type Mask = $mask;
            const LANES: usize = $lanes;
            ordinary!($name, $real, $mantissa, $i);
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
            fn approximate_inverse_root(self) -> Self {
                unsafe {
                    let magic = $i::splat_bits(<$real as Real>::INVERSE_ROOT.cast_signed());
                    $name($i::real($i::sub_bits(magic, $i::half_bits::<1>($i::bits(self.0)))))
                }
            }
            #[inline(always)]
            fn larger(self, other: Self) -> Self {
                unsafe { $name($i::larger(self.0, other.0)) }
            }
            #[inline(always)]
            fn smaller(self, other: Self) -> Self {
                unsafe { $name($i::smaller(self.0, other.0)) }
            }
            #[inline(always)]
            fn prefetch(at: *const $real) {
                unsafe { _mm_prefetch::<_MM_HINT_T0>(at.cast()) }
            }
            $($own)*
        }
    };
}

/// AVX-512 operations for a format: masks of their own type, and shifts across the register. Those of only one
/// format follow in braces.
macro_rules! avx512 {
    ($name:ident, $real:ty, $lanes:literal, $mantissa:literal, $mask:ty, $i:ident, { $($own:tt)* }) => {
        vector!($name, $real, $lanes, $mantissa, $mask, $i, {
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
            fn above(self, bound: Self) -> $mask {
                unsafe { $i::compare::<_CMP_GT_OQ>(self.0, bound.0) }
            }
            #[inline(always)]
            fn counts(self) -> $mask {
                unsafe { $i::test_bits($i::bits(self.0), $i::splat_bits(<$real as Real>::MIN_BITS.cast_signed())) }
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
            fn both(a: $mask, b: $mask) -> $mask {
                a & b
            }
            #[inline(always)]
            fn select(mask: $mask, a: Self, b: Self) -> Self {
                unsafe { $name($i::select(b.0, mask, a.0)) }
            }
            #[inline(always)]
            fn first(self, count: usize) -> $mask {
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
            $($own)*
        });
    };
}

/// AVX2 operations for a format: masks are registers, and a shift first joins both halves. Those of only one
/// format follow in braces.
macro_rules! avx2 {
    ($name:ident, $real:ty, $lanes:literal, $mantissa:literal, $i:ident, |$high:ident, $mid:ident| $shift:expr,
     |$high2:ident, $mid2:ident| $shift_two:expr, { $($own:tt)* }) => {
        vector!($name, $real, $lanes, $mantissa, $name, $i, {
            #[inline(always)]
            fn farther(self, other: Self) -> Self {
                unsafe {
                    let sign = $i::splat(-0.0);
                    $name($i::larger($i::and_not(sign, self.0), $i::and_not(sign, other.0)))
                }
            }
            #[inline(always)]
            fn beyond(self, bound: Self) -> Self {
                unsafe { $name($i::compare::<_CMP_GT_OQ>($i::and_not($i::splat(-0.0), self.0), bound.0)) }
            }
            #[inline(always)]
            fn above(self, bound: Self) -> Self {
                unsafe { $name($i::compare::<_CMP_GT_OQ>(self.0, bound.0)) }
            }
            #[inline(always)]
            fn counts(self) -> Self {
                let least = self.splat(<$real>::of(<$real as Real>::MIN_MAGNITUDE));
                unsafe { $name($i::compare::<_CMP_NLT_UQ>($i::and_not($i::splat(-0.0), self.0), least.0)) }
            }
            #[inline(always)]
            fn any(mask: Self) -> bool {
                unsafe { $i::signs(mask.0) != 0 }
            }
            #[inline(always)]
            fn either(a: Self, b: Self) -> Self {
                unsafe { $name($i::or(a.0, b.0)) }
            }
            #[inline(always)]
            fn both(a: Self, b: Self) -> Self {
                unsafe { $name($i::and(a.0, b.0)) }
            }
            #[inline(always)]
            fn select(mask: Self, a: Self, b: Self) -> Self {
                unsafe { $name($i::select(b.0, a.0, mask.0)) }
            }
            #[inline(always)]
            #[allow(clippy::cast_precision_loss)]
            fn first(self, count: usize) -> Self {
                unsafe { $name($i::compare::<_CMP_GT_OQ>($i::splat(count.min($lanes) as $real), self.count(0).0)) }
            }
            #[inline(always)]
            fn keep(self, mask: Self) -> Self {
                unsafe { $name($i::and(mask.0, self.0)) }
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
            $($own)*
        });
    };
}

/// Select, from each 128 bits of two registers, the first pair of values, or the last.
const FIRST_PAIRS: i32 = 0b01_00_01_00;
const LAST_PAIRS: i32 = 0b11_10_11_10;

mod wide_f32 {
    pub(super) use std::arch::x86_64::{
        __m512 as Register, _mm512_abs_ps as magnitude, _mm512_add_ps as add, _mm512_alignr_epi32 as align,
        _mm512_castps_si512 as bits, _mm512_castsi512_ps as real, _mm512_cmp_ps_mask as compare, _mm512_div_ps as div,
        _mm512_fmadd_ps as mul_add, _mm512_fmsub_ps as mul_sub, _mm512_fnmadd_ps as minus, _mm512_loadu_ps as load,
        _mm512_mask_mov_ps as select, _mm512_mask_permutexvar_ps as pick_some, _mm512_maskz_mov_ps as keep,
        _mm512_max_ps as larger, _mm512_min_ps as smaller, _mm512_mul_ps as mul, _mm512_permutex2var_ps as pick_of_two,
        _mm512_permutexvar_ps as pick, _mm512_range_ps as range, _mm512_set1_epi32 as splat_bits,
        _mm512_set1_ps as splat, _mm512_shuffle_ps as shuffle, _mm512_slli_epi32 as left, _mm512_sqrt_ps as root,
        _mm512_srli_epi32 as half_bits, _mm512_storeu_ps as store, _mm512_sub_epi32 as sub_bits, _mm512_sub_ps as sub,
        _mm512_test_epi32_mask as test_bits, _mm512_unpackhi_ps as high, _mm512_unpacklo_ps as low,
    };
    use std::arch::x86_64::{
        __m512i, _mm_loadu_ps as load_record, _mm_loadu_si128, _mm512_castps128_ps512 as begin, _mm512_cvtepu8_epi32,
        _mm512_insertf32x4 as insert,
    };
    /// Returns the records at every fourth of the places.
    ///
    /// # Safety
    /// The processor has AVX-512; the places and their records can be read.
    #[inline(always)]
    pub(super) unsafe fn records(from: *const f32, places: *const u32) -> Register {
        unsafe {
            let two = insert::<1>(
                begin(load_record(from.add(*places as usize))),
                load_record(from.add(*places.add(4) as usize)),
            );
            let three = insert::<2>(two, load_record(from.add(*places.add(8) as usize)));
            insert::<3>(three, load_record(from.add(*places.add(12) as usize)))
        }
    }
    /// Returns the bytes as integers.
    ///
    /// # Safety
    /// The processor has AVX-512; 16 bytes can be read.
    #[inline(always)]
    pub(super) unsafe fn lanes(from: *const u8) -> __m512i {
        unsafe { _mm512_cvtepu8_epi32(_mm_loadu_si128(from.cast())) }
    }
}
mod wide_f64 {
    pub(super) use std::arch::x86_64::{
        __m512d as Register, _mm512_abs_pd as magnitude, _mm512_add_pd as add, _mm512_alignr_epi64 as align,
        _mm512_castpd_si512 as bits, _mm512_castsi512_pd as real, _mm512_cmp_pd_mask as compare, _mm512_div_pd as div,
        _mm512_fmadd_pd as mul_add, _mm512_fmsub_pd as mul_sub, _mm512_fnmadd_pd as minus, _mm512_loadu_pd as load,
        _mm512_mask_mov_pd as select, _mm512_maskz_mov_pd as keep, _mm512_max_pd as larger, _mm512_min_pd as smaller,
        _mm512_mul_pd as mul, _mm512_range_pd as range, _mm512_set1_epi64 as splat_bits, _mm512_set1_pd as splat,
        _mm512_slli_epi64 as left, _mm512_sqrt_pd as root, _mm512_srli_epi64 as half_bits, _mm512_storeu_pd as store,
        _mm512_sub_epi64 as sub_bits, _mm512_sub_pd as sub, _mm512_test_epi64_mask as test_bits,
    };
}
mod narrow_f32 {
    pub(super) use std::arch::x86_64::{
        __m256 as Register, _mm256_add_ps as add, _mm256_alignr_epi8 as align, _mm256_and_ps as and,
        _mm256_andnot_ps as and_not, _mm256_blendv_ps as select, _mm256_castps_si256 as bits,
        _mm256_castsi256_ps as real, _mm256_cmp_ps as compare, _mm256_div_ps as div, _mm256_fmadd_ps as mul_add,
        _mm256_fmsub_ps as mul_sub, _mm256_fnmadd_ps as minus, _mm256_loadu_ps as load, _mm256_max_ps as larger,
        _mm256_min_ps as smaller, _mm256_movemask_ps as signs, _mm256_mul_ps as mul, _mm256_or_ps as or,
        _mm256_permute2f128_ps as halves, _mm256_set1_epi32 as splat_bits, _mm256_set1_ps as splat,
        _mm256_shuffle_ps as shuffle, _mm256_slli_epi32 as left, _mm256_sqrt_ps as root,
        _mm256_srli_epi32 as half_bits, _mm256_storeu_ps as store, _mm256_sub_epi32 as sub_bits, _mm256_sub_ps as sub,
        _mm256_unpackhi_ps as high, _mm256_unpacklo_ps as low,
    };
    use std::arch::x86_64::{
        _mm_loadu_ps as load_record, _mm256_castps128_ps256 as begin, _mm256_insertf128_ps as insert,
    };
    /// Returns the records at every fourth of the places.
    ///
    /// # Safety
    /// The processor has AVX2; the places and their records can be read.
    #[inline(always)]
    pub(super) unsafe fn records(from: *const f32, places: *const u32) -> Register {
        unsafe {
            let first = begin(load_record(from.add(*places as usize)));
            insert::<1>(first, load_record(from.add(*places.add(4) as usize)))
        }
    }
}
mod narrow_f64 {
    pub(super) use std::arch::x86_64::{
        __m256d as Register, _mm256_add_pd as add, _mm256_and_pd as and, _mm256_andnot_pd as and_not,
        _mm256_blendv_pd as select, _mm256_castpd_si256 as bits, _mm256_castsi256_pd as real, _mm256_cmp_pd as compare,
        _mm256_div_pd as div, _mm256_fmadd_pd as mul_add, _mm256_fmsub_pd as mul_sub, _mm256_fnmadd_pd as minus,
        _mm256_loadu_pd as load, _mm256_max_pd as larger, _mm256_min_pd as smaller, _mm256_movemask_pd as signs,
        _mm256_mul_pd as mul, _mm256_or_pd as or, _mm256_permute2f128_pd as halves, _mm256_set1_epi64x as splat_bits,
        _mm256_set1_pd as splat, _mm256_shuffle_pd as shuffle, _mm256_slli_epi64 as left, _mm256_sqrt_pd as root,
        _mm256_srli_epi64 as half_bits, _mm256_storeu_pd as store, _mm256_sub_epi64 as sub_bits, _mm256_sub_pd as sub,
    };
}

avx512!(WideF32, f32, 16, 23, u16, wide_f32, {
    const PICKS: bool = true;

    #[inline(always)]
    unsafe fn records(from: *const f32, places: *const u32) -> [Self; 3] {
        unsafe {
            let rows = [
                wide_f32::records(from, places),
                wide_f32::records(from, places.add(1)),
                wide_f32::records(from, places.add(2)),
                wide_f32::records(from, places.add(3)),
            ];
            let (low, high) = (wide_f32::low(rows[0], rows[1]), wide_f32::high(rows[0], rows[1]));
            let (low2, high2) = (wide_f32::low(rows[2], rows[3]), wide_f32::high(rows[2], rows[3]));
            [
                WideF32(wide_f32::shuffle::<FIRST_PAIRS>(low, low2)),
                WideF32(wide_f32::shuffle::<LAST_PAIRS>(low, low2)),
                WideF32(wide_f32::shuffle::<FIRST_PAIRS>(high, high2)),
            ]
        }
    }
    #[inline(always)]
    unsafe fn store_records(xyz: [Self; 3], to: *mut f32, slot: usize) {
        unsafe {
            let [x, y, z] = [xyz[0].0, xyz[1].0, xyz[2].0];
            let (low, high, to) = (wide_f32::low(x, y), wide_f32::high(x, y), to.add(4 * slot));
            wide_f32::store(to, wide_f32::shuffle::<0b00_00_01_00>(low, z));
            wide_f32::store(to.add(16), wide_f32::shuffle::<0b01_01_11_10>(low, z));
            wide_f32::store(to.add(32), wide_f32::shuffle::<0b10_10_01_00>(high, z));
            wide_f32::store(to.add(48), wide_f32::shuffle::<0b11_11_11_10>(high, z));
        }
    }
    #[inline(always)]
    unsafe fn half_of_records(from: *const f32, places: *const u32) -> [Self; 3] {
        unsafe {
            let rows = [wide_f32::records(from, places), wide_f32::records(from, places.add(1))];
            // x of two records and their y; z of both.
            let (low, high) = (wide_f32::low(rows[0], rows[1]), wide_f32::high(rows[0], rows[1]));
            [WideF32(low), WideF32(wide_f32::shuffle::<LAST_PAIRS>(low, low)), WideF32(high)]
        }
    }
    #[inline(always)]
    unsafe fn pick<const N: usize, const G: usize>(
        names: *const Names,
        own: &[Self; N],
        others: &[[Self; N]; G],
    ) -> [Self; N] {
        unsafe {
            // A mask from memory: from a test of the lanes the compiler would make three more instructions for each
            // vector.
            let (lanes, later) = (wide_f32::lanes((&raw const (*names).lanes).cast()), (*names).mask);
            let mut picked = *own;
            for n in 0..N {
                picked[n] = WideF32(match G {
                    0 => wide_f32::pick(lanes, own[n].0),
                    1 => wide_f32::pick_of_two(own[n].0, lanes, others[0][n].0),
                    2 => {
                        let first = wide_f32::pick_of_two(own[n].0, lanes, others[0][n].0);
                        wide_f32::pick_some(first, later, lanes, others[1][n].0)
                    }
                    _ => {
                        let first = wide_f32::pick_of_two(own[n].0, lanes, others[0][n].0);
                        let last = wide_f32::pick_of_two(others[1][n].0, lanes, others[2][n].0);
                        wide_f32::select(first, later, last)
                    }
                });
            }
            picked
        }
    }
    #[inline(always)]
    unsafe fn named(names: *const Names) -> u16 {
        unsafe { (*names).mask }
    }
});
avx512!(WideF64, f64, 8, 52, u8, wide_f64, {});
avx2!(
    NarrowF32,
    f32,
    8,
    23,
    narrow_f32,
    |high, mid| narrow_f32::real(narrow_f32::align::<12>(narrow_f32::bits(high), narrow_f32::bits(mid))),
    |high, mid| narrow_f32::real(narrow_f32::align::<8>(narrow_f32::bits(high), narrow_f32::bits(mid))),
    {
        #[inline(always)]
        unsafe fn records(from: *const f32, places: *const u32) -> [Self; 3] {
            unsafe {
                let rows = [
                    narrow_f32::records(from, places),
                    narrow_f32::records(from, places.add(1)),
                    narrow_f32::records(from, places.add(2)),
                    narrow_f32::records(from, places.add(3)),
                ];
                let (low, high) = (narrow_f32::low(rows[0], rows[1]), narrow_f32::high(rows[0], rows[1]));
                let (low2, high2) = (narrow_f32::low(rows[2], rows[3]), narrow_f32::high(rows[2], rows[3]));
                [
                    NarrowF32(narrow_f32::shuffle::<FIRST_PAIRS>(low, low2)),
                    NarrowF32(narrow_f32::shuffle::<LAST_PAIRS>(low, low2)),
                    NarrowF32(narrow_f32::shuffle::<FIRST_PAIRS>(high, high2)),
                ]
            }
        }
        #[inline(always)]
        unsafe fn store_records(xyz: [Self; 3], to: *mut f32, slot: usize) {
            unsafe {
                let [x, y, z] = [xyz[0].0, xyz[1].0, xyz[2].0];
                let (low, high, to) =
                    (narrow_f32::low(x, y), narrow_f32::high(x, y), to.add(super::record_place(slot)));
                narrow_f32::store(to, narrow_f32::shuffle::<0b00_00_01_00>(low, z));
                narrow_f32::store(to.add(16), narrow_f32::shuffle::<0b01_01_11_10>(low, z));
                narrow_f32::store(to.add(32), narrow_f32::shuffle::<0b10_10_01_00>(high, z));
                narrow_f32::store(to.add(48), narrow_f32::shuffle::<0b11_11_11_10>(high, z));
            }
        }
    }
);
avx2!(NarrowF64, f64, 4, 52, narrow_f64, |high, mid| narrow_f64::shuffle::<0b0101>(mid, high), |_high, mid| mid, {});
