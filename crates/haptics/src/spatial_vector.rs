//! Vectors of six components: a force with a torque, or a velocity with an angular velocity.
//!
//! A torque counts by the force that exerts it at a lever ℓ: a wrench is (F, τ/ℓ) in N, a velocity (v, ω·ℓ) in m/s. Their product is
//! the power F·v + τ·ω for any ℓ. With angular parts of 0 each operation gives the bits of that of the linear part alone.

use std::ops::{Add, AddAssign, Div, Mul, Sub, SubAssign};

use glam::DVec3;

/// A vector of six components, all in one unit.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct SpatialVector {
    pub(crate) linear: DVec3,
    pub(crate) angular: DVec3,
}

impl SpatialVector {
    pub(crate) const ZERO: SpatialVector = SpatialVector { linear: DVec3::ZERO, angular: DVec3::ZERO };

    pub(crate) fn dot(self, other: Self) -> f64 {
        self.linear.dot(other.linear) + self.angular.dot(other.angular)
    }

    pub(crate) fn length(self) -> f64 {
        self.dot(self).sqrt()
    }

    pub(crate) fn is_finite(self) -> bool {
        self.linear.is_finite() && self.angular.is_finite()
    }

    /// Returns the vector of length 1 in the same direction; 0 if there is none.
    pub(crate) fn normalize_or_zero(self) -> Self {
        let inverse = self.length().recip();
        if inverse.is_finite() && inverse > 0.0 { self * inverse } else { Self::ZERO }
    }

    /// Returns the vector, shortened to a length of at most `most`.
    pub(crate) fn clamp_length_max(self, most: f64) -> Self {
        let length_squared = self.dot(self);
        if length_squared > most * most {
            let length = length_squared.sqrt();
            let shorten = |part: DVec3| most * (part / length);
            return SpatialVector { linear: shorten(self.linear), angular: shorten(self.angular) };
        }
        self
    }
}

impl Add for SpatialVector {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        SpatialVector { linear: self.linear + other.linear, angular: self.angular + other.angular }
    }
}

impl Sub for SpatialVector {
    type Output = Self;

    fn sub(self, other: Self) -> Self {
        SpatialVector { linear: self.linear - other.linear, angular: self.angular - other.angular }
    }
}

impl AddAssign for SpatialVector {
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

impl SubAssign for SpatialVector {
    fn sub_assign(&mut self, other: Self) {
        *self = *self - other;
    }
}

impl Mul<f64> for SpatialVector {
    type Output = Self;

    fn mul(self, factor: f64) -> Self {
        SpatialVector { linear: self.linear * factor, angular: self.angular * factor }
    }
}

impl Div<f64> for SpatialVector {
    type Output = Self;

    fn div(self, divisor: f64) -> Self {
        SpatialVector { linear: self.linear / divisor, angular: self.angular / divisor }
    }
}
