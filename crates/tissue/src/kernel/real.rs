//! The number format of the state: the same arithmetic in 4 and in 8 bytes.

use std::ops::{Add, AddAssign, Mul, Neg, Sub, SubAssign};

use crate::kernel::lanes::Vector;

/// The number format f32 or f64. It has only operations that IEEE 754 rounds exactly, so the bits do not depend
/// on the machine.
pub(crate) trait Real:
    Copy
    + bytemuck::Zeroable
    + Default
    + std::fmt::Debug
    + PartialEq
    + PartialOrd
    + Send
    + Sync
    + 'static
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + std::ops::Div<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
{
    /// The widest vector of this format, and the next narrower one.
    #[cfg(target_arch = "x86_64")]
    type Avx512: Vector<Real = Self>;
    #[cfg(target_arch = "x86_64")]
    type Avx2: Vector<Real = Self>;
    /// The vector of NEON.
    #[cfg(target_arch = "aarch64")]
    type Neon: Vector<Real = Self>;
    /// An integer with the same number of bits.
    type Bits;
    /// Whether sums can be compensated. The widest format does not need it, and no code is generated for it.
    const COMPENSATES: bool;
    /// Number of terms of [`Real::SERIES`], even.
    const TERMS: usize;
    /// The polynomial in q nearest to (1 − 1/√(1 + q))/q on |q| ≤ 1/8 in relative error: within 5.2e-8 (degree 5) for
    /// f32, 9e-18 (degree 13) for f64. From the Remez exchange algorithm.
    const SERIES: [f64; 14];
    /// The exponent −c·r below which a tool's force is omitted. The omitted part is (1 + |c·r|)·e^−|c·r| of the whole:
    /// e^−34.5 = 1e-15 of the force at the centre for f64, less than the worst sum loses; e^−22 for f32.
    const NEGLIGIBLE_EXPONENT: f64;
    /// The smallest number whose square is a normal number. Smaller values count as 0 in the state of a tissue.
    const MIN_MAGNITUDE: f64;
    /// Sums of squares of several numbers below this, and of their differences, are finite.
    const LARGEST: f64;
    /// Numbers from [`Real::MIN_MAGNITUDE`] on have at least one of these bits: the two highest of the exponent.
    const MIN_BITS: Self::Bits;
    /// The smallest |Q| of a spring that pulls; half of it is a strain. The force across the spring's direction is a
    /// product of Q and a difference of displacements, and with this bound it is seldom subnormal.
    const MIN_EXCESS: f64;
    /// A number far below any Q that counts and its square, and far above the subnormal range.
    const FAINT: f64;
    /// Returns the nearest value to an f64.
    fn of(value: f64) -> Self;
    /// Returns the same value as an f64.
    fn wide(self) -> f64;
    /// 1.5 times the bits of 1, minus the constant that minimises the error of the rough inverse root.
    const INVERSE_ROOT: Self::Bits;
    /// Number of Newton steps from there to a few parts in 10⁶ (f32) or 10¹¹ (f64).
    const NEWTON: usize;
    /// Returns 1/√self within 4 %.
    fn approximate_inverse_root(self) -> Self;
    /// The last digit of 1.
    const EPSILON: f64;
    /// 1.5 times the number whose last digit is 1.
    const UNIT: f64;
    /// The number whose last digit is 1, and the exponent's bias.
    const POWER: f64;
    /// Returns 2^self, for integers.
    fn power_of_two(self) -> Self;
    /// ln 2 in two parts: the first ends in enough zeros that its product with an integer is exact.
    const LN_2: [f64; 2];
    /// Degree of the polynomial of e^r, |r| ≤ ½ln 2.
    const EXPONENTIAL_DEGREE: usize;
    /// Returns the square root, correctly rounded.
    fn root(self) -> Self;
    /// Returns self·b + c, rounded once.
    fn fused(self, b: Self, c: Self) -> Self;
    /// Returns |self|.
    fn magnitude(self) -> Self;
    /// Returns whether the number is neither infinite nor NaN.
    fn is_finite(self) -> bool;
    /// Writes the value's bytes, little-endian, to `bytes`, which has the value's size.
    fn write(self, bytes: &mut [u8]);
    /// Returns the value of bytes that [`Real::write`] wrote; 0 for any other number of bytes.
    fn read(bytes: &[u8]) -> Self;
}

macro_rules! real {
    ($t:ty, $bits:ty, $magic:literal, $newton:literal, $wide:ident, $narrow:ident, $neon:ident, $small:expr, $terms:literal, $series:expr,
     $negligible:literal, $ln_2:expr,
     $degree:literal) => {
        impl Real for $t {
            #[cfg(target_arch = "x86_64")]
            type Avx512 = crate::kernel::lanes::$wide;
            #[cfg(target_arch = "x86_64")]
            type Avx2 = crate::kernel::lanes::$narrow;
            #[cfg(target_arch = "aarch64")]
            type Neon = crate::kernel::lanes::$neon;
            type Bits = $bits;
            const COMPENSATES: bool = size_of::<$t>() < 8;
            const MIN_MAGNITUDE: f64 = f64::from_bits(((1023 + (<$t>::MIN_EXP - 1) / 2) as u64) << 52);
            const LARGEST: f64 = f64::from_bits(((1023 + (<$t>::MAX_EXP - 1) / 2 - 3) as u64) << 52);
            const MIN_BITS: $bits = 3 << (<$bits>::BITS - 3);
            const MIN_EXCESS: f64 = f64::from_bits(((1023 - $small[0]) as u64) << 52);
            const FAINT: f64 = f64::from_bits(((1023 - $small[1]) as u64) << 52);
            const INVERSE_ROOT: $bits = $magic;
            const NEWTON: usize = $newton;
            fn approximate_inverse_root(self) -> Self {
                Self::from_bits(Self::INVERSE_ROOT.wrapping_sub(self.to_bits() >> 1))
            }
            const EPSILON: f64 = <$t>::EPSILON as f64;
            const UNIT: f64 = 1.5 / <$t as Real>::EPSILON;
            const POWER: f64 = 1.0 / <$t as Real>::EPSILON + (<$t>::MAX_EXP - 1) as f64;
            fn power_of_two(self) -> Self {
                Self::from_bits((self + Self::of(Self::POWER)).to_bits() << (<$t>::MANTISSA_DIGITS - 1))
            }
            const LN_2: [f64; 2] = $ln_2;
            const EXPONENTIAL_DEGREE: usize = $degree;
            const TERMS: usize = $terms;
            const SERIES: [f64; 14] = $series;
            const NEGLIGIBLE_EXPONENT: f64 = $negligible;
            // The kernel reads its constants here; a call within a loop costs 6 %.
            #[inline(always)]
            #[allow(clippy::cast_possible_truncation)]
            fn of(value: f64) -> Self {
                value as $t
            }
            fn wide(self) -> f64 {
                f64::from(self)
            }
            fn root(self) -> Self {
                self.sqrt()
            }
            #[inline(always)]
            fn fused(self, b: Self, c: Self) -> Self {
                self.mul_add(b, c)
            }
            fn magnitude(self) -> Self {
                self.abs()
            }
            fn is_finite(self) -> bool {
                <$t>::is_finite(self)
            }
            fn write(self, bytes: &mut [u8]) {
                bytes.copy_from_slice(&self.to_le_bytes());
            }
            fn read(bytes: &[u8]) -> Self {
                bytes.try_into().map_or(0.0, Self::from_le_bytes)
            }
        }
    };
}

const SERIES_F32: [f64; 14] = [
    0.500_000_025_546_736_8,
    -0.375_000_048_020_088,
    0.312_470_624_092_452_5,
    -0.273_403_790_311_480_14,
    0.251_082_408_606_127_6,
    -0.230_579_348_633_321_45,
    0.0,
    0.0,
    0.0,
    0.0,
    0.0,
    0.0,
    0.0,
    0.0,
];

const SERIES_F64: [f64; 14] = [
    0.5,
    -0.375,
    0.312_499_999_999_973_5,
    -0.273_437_499_999_952_63,
    0.246_093_750_027_127_84,
    -0.225_585_937_537_379_9,
    0.209_472_645_852_532_4,
    -0.196_380_602_725_415_93,
    0.185_472_476_651_728,
    -0.176_199_148_370_421_15,
    0.168_011_068_201_414_93,
    -0.160_995_440_206_322_48,
    0.163_135_689_960_630_06,
    -0.157_608_573_440_095_58,
];

real!(
    f32,
    u32,
    0x5f37_5a86,
    2,
    WideF32,
    NarrowF32,
    NeonF32,
    [54, 100],
    6,
    SERIES_F32,
    -22.0,
    [0.693_359_375, -2.121_944_4e-4],
    7
);
real!(
    f64,
    u64,
    0x5fe6_eb50_c7b5_37a9,
    3,
    WideF64,
    NarrowF64,
    NeonF64,
    [450, 900],
    14,
    SERIES_F64,
    -34.5,
    [0.693_147_180_369_123_8, 1.908_214_929_270_587_7e-10],
    13
);
