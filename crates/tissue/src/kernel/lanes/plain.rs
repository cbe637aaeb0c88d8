//! Vectors without instructions of their own: one lane for single points, two for processors without a wider
//! set.
//!
//! Each lane is a field, and each operation is written out by lanes: closures over arrays gave the same machine
//! code, and were more than half of what the compiler had to read for all sweeps.

use super::Vector;
use crate::kernel::real::Real;

macro_rules! plain {
    ($(#[$doc:meta])* $name:ident, $lanes:literal, $real:ident: $($lane:tt $t:ident),*) => {
        $(#[$doc])*
        #[derive(Clone, Copy)]
        pub(crate) struct $name<$real>($(pub(crate) $t),*);

        impl<$real: Real> $name<$real> {
            #[inline(always)]
            fn negative(self) -> Self {
                $name($(-self.$lane),*)
            }
        }

        impl<$real: Real> Vector for $name<$real> {
            type Real = $real;
            type Mask = [bool; $lanes];
            const LANES: usize = $lanes;
            const IS_REGISTER: bool = false;

            #[inline(always)]
            unsafe fn load(from: *const $real) -> Self {
                // SAFETY: the caller's promise.
                unsafe { $name($(*from.add($lane)),*) }
            }
            #[inline(always)]
            unsafe fn store(self, to: *mut $real) {
                // SAFETY: the caller's promise.
                unsafe { $(*to.add($lane) = self.$lane;)* }
            }
            #[inline(always)]
            unsafe fn of(value: $real) -> Self {
                $name($({ let _ = $lane; value }),*)
            }
            #[inline(always)]
            fn add(self, other: Self) -> Self {
                $name($(self.$lane + other.$lane),*)
            }
            #[inline(always)]
            fn sub(self, other: Self) -> Self {
                $name($(self.$lane - other.$lane),*)
            }
            #[inline(always)]
            fn mul(self, other: Self) -> Self {
                $name($(self.$lane * other.$lane),*)
            }
            #[inline(always)]
            fn div(self, other: Self) -> Self {
                $name($(self.$lane / other.$lane),*)
            }
            #[inline(always)]
            fn root(self) -> Self {
                $name($(self.$lane.root()),*)
            }
            #[inline(always)]
            fn mul_add(self, b: Self, c: Self) -> Self {
                $name($(self.$lane.fused(b.$lane, c.$lane)),*)
            }
            #[inline(always)]
            fn mul_sub(self, b: Self, c: Self) -> Self {
                self.mul_add(b, c.negative())
            }
            #[inline(always)]
            fn minus(self, a: Self, b: Self) -> Self {
                a.negative().mul_add(b, self)
            }
            #[inline(always)]
            fn approximate_inverse_root(self) -> Self {
                $name($(self.$lane.approximate_inverse_root()),*)
            }
            #[inline(always)]
            fn power_of_two(self) -> Self {
                $name($(self.$lane.power_of_two()),*)
            }
            #[inline(always)]
            #[allow(clippy::cast_precision_loss)]
            fn count(self, first: usize) -> Self {
                $name($($real::of((first + $lane) as f64)),*)
            }
            #[inline(always)]
            fn larger(self, other: Self) -> Self {
                $name($(if self.$lane > other.$lane { self.$lane } else { other.$lane }),*)
            }
            #[inline(always)]
            fn smaller(self, other: Self) -> Self {
                $name($(if self.$lane < other.$lane { self.$lane } else { other.$lane }),*)
            }
            #[inline(always)]
            fn farther(self, other: Self) -> Self {
                let (a, b) = ($name($(self.$lane.magnitude()),*), $name($(other.$lane.magnitude()),*));
                a.larger(b)
            }
            #[inline(always)]
            fn beyond(self, bound: Self) -> Self::Mask {
                [$(self.$lane.magnitude() > bound.$lane),*]
            }
            #[inline(always)]
            fn above(self, bound: Self) -> Self::Mask {
                [$(self.$lane > bound.$lane),*]
            }
            #[inline(always)]
            #[allow(clippy::neg_cmp_op_on_partial_ord)]
            fn counts(self) -> Self::Mask {
                // NaN counts, so that a check can find it.
                [$(!(self.$lane.magnitude() < $real::of($real::MIN_MAGNITUDE))),*]
            }
            #[inline(always)]
            fn any(mask: Self::Mask) -> bool {
                false $(|| mask[$lane])*
            }
            #[inline(always)]
            fn either(a: Self::Mask, b: Self::Mask) -> Self::Mask {
                [$(a[$lane] | b[$lane]),*]
            }
            #[inline(always)]
            fn both(a: Self::Mask, b: Self::Mask) -> Self::Mask {
                [$(a[$lane] & b[$lane]),*]
            }
            #[inline(always)]
            fn select(mask: Self::Mask, a: Self, b: Self) -> Self {
                $name($(if mask[$lane] { a.$lane } else { b.$lane }),*)
            }
            #[inline(always)]
            fn first(self, count: usize) -> Self::Mask {
                [$($lane < count),*]
            }
            #[inline(always)]
            fn keep(self, mask: Self::Mask) -> Self {
                let zero = $real::default();
                $name($(if mask[$lane] { self.$lane } else { zero }),*)
            }
            #[inline(always)]
            fn shift(self, before: Self) -> Self {
                Self::shifted(self, before, 1)
            }
            #[inline(always)]
            fn shift_two(self, before: Self) -> Self {
                Self::shifted(self, before, 2)
            }
        }
    };
}

plain! {
    /// A vector of one lane.
    Scalar, 1, T: 0 T
}

plain! {
    /// A vector of two lanes.
    Pair, 2, T: 0 T, 1 T
}

impl<T: Real> Scalar<T> {
    /// Returns `before`. Nothing calls it for its result: a single point has no neighbour in its vector.
    #[inline(always)]
    fn shifted(self, before: Self, _: usize) -> Self {
        before
    }
}

impl<T: Real> Pair<T> {
    #[inline(always)]
    fn shifted(self, before: Self, by: usize) -> Self {
        if by == 1 { Pair(before.1, self.0) } else { before }
    }
}
