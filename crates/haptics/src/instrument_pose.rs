//! Where an instrument is, how it moves, and what acts on it.

use std::ops::{Add, Mul, Sub};

use glam::{DQuat, DVec3};

/// Largest angle between jaws, rad.
pub const MAX_JAW_RAD: f64 = std::f64::consts::PI;

/// Where an instrument is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InstrumentPose {
    /// Place of the instrument's origin in the frame of the tissue at rest, m.
    pub place_m: DVec3,
    /// Turns vectors of the instrument's frame into the tissue's; of length 1.
    pub orientation: DQuat,
    /// The angle between the jaws, rad, 0 while they are closed.
    pub jaw_rad: f64,
}

impl InstrumentPose {
    /// Returns the pose at a place, not turned, with closed jaws.
    pub const fn at(place_m: DVec3) -> Self {
        InstrumentPose { place_m, orientation: DQuat::IDENTITY, jaw_rad: 0.0 }
    }

    /// Returns whether all its numbers are finite.
    pub fn is_finite(&self) -> bool {
        self.place_m.is_finite() && self.orientation.is_finite() && self.jaw_rad.is_finite()
    }

    /// Returns the shortest turn from this orientation to that of another pose: along its axis, by its angle, rad.
    pub fn turn_to(&self, other: &Self) -> DVec3 {
        let turn = other.orientation * self.orientation.conjugate();
        let half = turn.xyz() * if turn.w < 0.0 { -1.0 } else { 1.0 };
        let sine = half.length();
        // For a small angle, twice its sine.
        if sine < 1e-9 { 2.0 * half } else { half * (2.0 * libm::atan2(sine, turn.w.abs()) / sine) }
    }

    /// Returns the pose at a `part`, 0 to 1, of the way to another: the place on a straight line, the orientation by the shorter turn
    /// at constant angular velocity.
    #[must_use]
    pub fn towards(&self, other: &Self, part: f64) -> Self {
        InstrumentPose {
            place_m: self.place_m.lerp(other.place_m, part),
            orientation: turned_towards(self.orientation, other.orientation, part),
            jaw_rad: self.jaw_rad + (other.jaw_rad - self.jaw_rad) * part,
        }
    }
}

/// How fast an instrument moves.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct InstrumentVelocity {
    /// Velocity of the instrument's origin, m/s.
    pub velocity_m_per_s: DVec3,
    /// Angular velocity, rad/s, in the tissue's frame.
    pub angular_rad_per_s: DVec3,
    /// Velocity of the angle between the jaws, rad/s.
    pub jaw_rad_per_s: f64,
}

impl InstrumentVelocity {
    /// Returns the pose after a time, s, at this velocity.
    #[must_use]
    pub fn after(&self, pose: &InstrumentPose, time_s: f64) -> InstrumentPose {
        InstrumentPose {
            place_m: pose.place_m + self.velocity_m_per_s * time_s,
            orientation: turned(self.angular_rad_per_s * time_s, pose.orientation),
            jaw_rad: (pose.jaw_rad + self.jaw_rad_per_s * time_s).clamp(0.0, MAX_JAW_RAD),
        }
    }
}

/// A force and a torque on an instrument.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Wrench {
    /// The force, N.
    pub force_n: DVec3,
    /// The torque about a stated point, N·m.
    pub torque_n_m: DVec3,
}

impl Wrench {
    /// Returns the wrench of a force that acts at the stated point, N.
    pub fn of_force(force_n: DVec3) -> Self {
        Wrench { force_n, torque_n_m: DVec3::ZERO }
    }

    /// Returns the same wrench with its torque about another point, which lies `by_m` (m) from the former one.
    #[must_use]
    pub fn about(&self, by_m: DVec3) -> Self {
        Wrench { torque_n_m: self.torque_n_m - by_m.cross(self.force_n), ..*self }
    }

    /// Returns the wrench at a `part`, 0 to 1, of the way to another one about the same point.
    #[must_use]
    pub fn lerp(&self, other: Self, part: f64) -> Self {
        Wrench {
            force_n: self.force_n.lerp(other.force_n, part),
            torque_n_m: self.torque_n_m.lerp(other.torque_n_m, part),
        }
    }

    /// Returns whether force and torque are finite.
    pub fn is_finite(&self) -> bool {
        self.force_n.is_finite() && self.torque_n_m.is_finite()
    }
}

impl Add for Wrench {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Wrench { force_n: self.force_n + other.force_n, torque_n_m: self.torque_n_m + other.torque_n_m }
    }
}

impl Sub for Wrench {
    type Output = Self;

    fn sub(self, other: Self) -> Self {
        Wrench { force_n: self.force_n - other.force_n, torque_n_m: self.torque_n_m - other.torque_n_m }
    }
}

impl Mul<f64> for Wrench {
    type Output = Self;

    fn mul(self, factor: f64) -> Self {
        Wrench { force_n: self.force_n * factor, torque_n_m: self.torque_n_m * factor }
    }
}

/// Cosine of half an angle from which on two orientations are so near that a straight line between them is exact to rounding.
const NEARLY_EQUAL: f64 = 1.0 - 1e-12;

/// Returns an orientation after a turn by a vector of angles, rad, with the same bits on every system.
fn turned(by_rad: DVec3, orientation: DQuat) -> DQuat {
    let angle_rad = by_rad.length();
    let Some(axis) = by_rad.try_normalize() else { return orientation };
    let DVec3 { x, y, z } = axis * libm::sin(0.5 * angle_rad);
    (DQuat::from_xyzw(x, y, z, libm::cos(0.5 * angle_rad)) * orientation).normalize()
}

/// Returns the orientation at a part of the shorter turn from one to another, with the same bits on every system.
fn turned_towards(from: DQuat, to: DQuat, part: f64) -> DQuat {
    let cosine = from.dot(to);
    let (to, cosine) = if cosine < 0.0 { (-to, -cosine) } else { (to, cosine) };
    if cosine > NEARLY_EQUAL {
        return (from * (1.0 - part) + to * part).normalize();
    }
    let angle_rad = libm::acos(cosine);
    let weight = |part: f64| libm::sin(part * angle_rad);
    (from * weight(1.0 - part) + to * weight(part)).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_turn_between_two_poses_is_the_angular_velocity_times_the_time() {
        let pose = InstrumentPose { orientation: DQuat::from_rotation_y(0.7), ..InstrumentPose::at(DVec3::ZERO) };
        for turn_rad in [DVec3::ZERO, 1e-12 * DVec3::X, DVec3::new(0.3, -0.5, 0.1), 3.1 * DVec3::Y] {
            let velocity = InstrumentVelocity { angular_rad_per_s: turn_rad, ..InstrumentVelocity::default() };
            let after = velocity.after(&pose, 1.0);
            assert!(pose.turn_to(&after).distance(turn_rad) < 1e-12, "{turn_rad}");
            let opposite = InstrumentPose { orientation: -after.orientation, ..after };
            assert!(pose.turn_to(&opposite).distance(turn_rad) < 1e-12, "{turn_rad}");
        }
    }

    #[test]
    fn half_of_the_way_turns_by_half_of_the_angle() {
        let from = InstrumentPose { place_m: DVec3::ZERO, orientation: DQuat::IDENTITY, jaw_rad: 0.0 };
        let to = InstrumentPose { place_m: DVec3::X, orientation: -DQuat::from_rotation_z(1.0), jaw_rad: 0.5 };
        let half = from.towards(&to, 0.5);
        assert!(half.orientation.angle_between(DQuat::from_rotation_z(0.5)) < 1e-7);
        assert_eq!((half.place_m, half.jaw_rad), (0.5 * DVec3::X, 0.25));
    }
}
