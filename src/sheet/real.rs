//! The number format of the state: the same arithmetic in 4 and in 8 bytes.

use std::ops::{Add, AddAssign, Mul, Neg, Sub, SubAssign};

/// f32 or f64. Only operations that IEEE 754 rounds exactly, so that the bits do not depend on the machine.
pub(super) trait Real:
    Copy
    + Default
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
    /// 1.
    const ONE: Self;
    /// A displacement of less than this part of the spacing is 0. Its square is still a normal number; it is 1e-9 of
    /// a displacement that is itself 1e-8 of the spacing.
    const LEAST: Self;
    /// An increment of less than this part of the least displacement is 0.
    const LEAST_INCREMENT: Self;
    /// Nearest value of a f64.
    fn of(value: f64) -> Self;
    /// The same value as a f64.
    fn wide(self) -> f64;
    /// Square root, correctly rounded.
    fn root(self) -> Self;
    /// |x|.
    fn magnitude(self) -> Self;
    /// Neither infinite nor NaN.
    fn is_finite(self) -> bool;
    /// Appends the bytes of the value, little-endian.
    fn hash_into(self, hasher: &mut xxhash_rust::xxh3::Xxh3);
}

macro_rules! real {
    ($t:ty, $least:expr, $least_increment:expr) => {
        impl Real for $t {
            const ONE: Self = 1.0;
            const LEAST: Self = $least;
            const LEAST_INCREMENT: Self = $least_increment;
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
            fn magnitude(self) -> Self {
                self.abs()
            }
            fn is_finite(self) -> bool {
                <$t>::is_finite(self)
            }
            fn hash_into(self, hasher: &mut xxhash_rust::xxh3::Xxh3) {
                hasher.update(&self.to_le_bytes());
            }
        }
    };
}

real!(f32, 1e-17, 1e-9);
real!(f64, 1e-140, 1e-100);
