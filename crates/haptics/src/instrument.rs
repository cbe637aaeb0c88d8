//! Instruments: rigid sets of tips that one pose moves, some of them on two jaws.
//!
//! **Frame.** An instrument has a frame of its own, whose origin is the place of its pose. It points along x: the shaft runs from
//! the origin along −x, and jaws run from their hinge along x. They turn about the axis along z through the hinge, each by half of
//! the angle between them: the upper jaw towards y, the lower one towards −y.
//!
//! **Forces.** The force of a tip acts at the tip's place. An instrument's wrench is the sum of its tips' forces and of their torques
//! about the instrument's place.

use glam::{DQuat, DVec3};

use crate::tip::Tip;

/// Largest number of tips of an instrument.
pub const MAX_TIPS: usize = 64;

/// Largest angle between jaws, rad.
pub const MAX_JAW_RAD: f64 = std::f64::consts::PI;

/// What of an instrument a tip belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum InstrumentPart {
    /// The body, which moves as the instrument does.
    #[default]
    Body,
    /// The jaw that opens towards y.
    UpperJaw,
    /// The jaw that opens towards −y.
    LowerJaw,
}

impl InstrumentPart {
    /// Returns how far the part turns about the hinge for each radian between the jaws.
    fn turn(self) -> f64 {
        match self {
            InstrumentPart::Body => 0.0,
            InstrumentPart::UpperJaw => 0.5,
            InstrumentPart::LowerJaw => -0.5,
        }
    }
}

/// A tip of an instrument.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct InstrumentTip {
    /// Its place in the instrument's frame, m; on a jaw, that while the jaws are closed.
    pub offset_m: DVec3,
    /// Its shape, radius and friction.
    pub tip: Tip,
    /// What it belongs to.
    pub part: InstrumentPart,
}

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
    /// Returns the pose at a `part`, 0 to 1, of the way to another: the place on a straight line, the orientation by the shorter turn
    /// at constant angular velocity.
    #[must_use]
    pub fn towards(&self, other: &Self, part: f64) -> Self {
        InstrumentPose {
            place_m: self.place_m + (other.place_m - self.place_m) * part,
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

/// A force and a torque on an instrument, both of the tissue.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Wrench {
    /// The force, N.
    pub force_n: DVec3,
    /// The torque about a stated point, N·m.
    pub torque_n_m: DVec3,
}

impl Wrench {
    /// Returns the same wrench with its torque about another point, which lies `by_m` (m) from the former one.
    #[must_use]
    pub fn about(&self, by_m: DVec3) -> Self {
        Wrench { torque_n_m: self.torque_n_m - by_m.cross(self.force_n), ..*self }
    }
}

/// A rigid set of tips, with or without jaws.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Instrument {
    /// The tips, at most [`MAX_TIPS`].
    pub tips: Vec<InstrumentTip>,
    /// The hinge of the jaws in the instrument's frame, m.
    pub hinge_m: DVec3,
}

impl Instrument {
    /// Adds a row of equal tips, from `from_m` to `to_m` (m, in the instrument's frame), at most a radius apart: a capsule.
    pub fn add_row(&mut self, from_m: DVec3, to_m: DVec3, tip: Tip, part: InstrumentPart) {
        // Saturating cast: a length without end gives more tips than an instrument may have.
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let gaps = ((from_m.distance(to_m) / tip.radius_m).ceil() as usize).clamp(1, MAX_TIPS);
        let offsets_m = (0..=gaps).map(|at| from_m.lerp(to_m, at as f64 / gaps as f64));
        self.tips.extend(offsets_m.map(|offset_m| InstrumentTip { offset_m, tip, part }));
    }

    /// Returns whether it has jaws.
    pub fn has_jaws(&self) -> bool {
        self.tips.iter().any(|tip| tip.part != InstrumentPart::Body)
    }

    /// Returns the place of a tip by its number, m, in the tissue's frame. Panics if there is no such tip.
    pub fn tip_m(&self, number: usize, pose: &InstrumentPose) -> DVec3 {
        let InstrumentTip { offset_m, part, .. } = self.tips[number];
        let turn = about_z(part.turn() * pose.jaw_rad);
        let in_frame_m = match part {
            InstrumentPart::Body => offset_m,
            _ => self.hinge_m + turn * (offset_m - self.hinge_m),
        };
        pose.place_m + pose.orientation * in_frame_m
    }

    /// Returns the velocity of a tip by its number, m/s, in the tissue's frame. Panics if there is no such tip.
    pub fn tip_velocity_m_per_s(&self, number: usize, pose: &InstrumentPose, velocity: &InstrumentVelocity) -> DVec3 {
        let (axis, hinge_m) = self.hinge(pose);
        let (tip_m, turn) = (self.tip_m(number, pose), self.tips[number].part.turn());
        velocity.velocity_m_per_s
            + velocity.angular_rad_per_s.cross(tip_m - pose.place_m)
            + turn * velocity.jaw_rad_per_s * axis.cross(tip_m - hinge_m)
    }

    /// Returns the axis of the jaws and their hinge, m, in the tissue's frame.
    fn hinge(&self, pose: &InstrumentPose) -> (DVec3, DVec3) {
        (pose.orientation * DVec3::Z, pose.place_m + pose.orientation * self.hinge_m)
    }

    /// Returns the wrench of forces on the tips (number and N, in the tissue's frame) about the instrument's place.
    pub fn wrench(&self, pose: &InstrumentPose, forces_n: impl IntoIterator<Item = (usize, DVec3)>) -> Wrench {
        forces_n.into_iter().fold(Wrench::default(), |sum, (number, force_n)| Wrench {
            force_n: sum.force_n + force_n,
            torque_n_m: sum.torque_n_m + (self.tip_m(number, pose) - pose.place_m).cross(force_n),
        })
    }

    /// Returns the torque with which forces on the tips (number and N, in the tissue's frame) open the jaws, N·m: half the difference
    /// of the torques on both jaws about their hinge, so that its product with the angle's velocity is their power.
    pub fn opening_n_m(&self, pose: &InstrumentPose, forces_n: impl IntoIterator<Item = (usize, DVec3)>) -> f64 {
        let (axis, hinge_m) = self.hinge(pose);
        let of = |(number, force_n): (usize, DVec3)| {
            self.tips[number].part.turn() * (self.tip_m(number, pose) - hinge_m).cross(force_n).dot(axis)
        };
        forces_n.into_iter().map(of).sum()
    }
}

/// Cosine of half an angle from which on two orientations are so near that a straight line between them is exact to rounding.
const NEARLY_EQUAL: f64 = 1.0 - 1e-12;

/// Returns the rotation by an angle about z. (glam's own takes sine and cosine from the system, whose last digits differ.)
fn about_z(angle_rad: f64) -> DQuat {
    DQuat::from_xyzw(0.0, 0.0, libm::sin(0.5 * angle_rad), libm::cos(0.5 * angle_rad))
}

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
    use std::f64::consts::FRAC_PI_2;

    use super::*;

    /// A grasper: a shaft of 40 mm, and jaws of 10 mm.
    fn grasper() -> Instrument {
        let tip = Tip { radius_m: 0.002, ..Tip::default() };
        let mut instrument = Instrument { hinge_m: -0.01 * DVec3::X, ..Instrument::default() };
        instrument.add_row(-0.01 * DVec3::X, -0.05 * DVec3::X, tip, InstrumentPart::Body);
        instrument.add_row(-0.008 * DVec3::X, DVec3::ZERO, tip, InstrumentPart::UpperJaw);
        instrument.add_row(-0.008 * DVec3::X, DVec3::ZERO, tip, InstrumentPart::LowerJaw);
        instrument
    }

    fn pose() -> InstrumentPose {
        InstrumentPose {
            place_m: DVec3::new(0.1, 0.2, 0.3),
            orientation: DQuat::from_rotation_y(FRAC_PI_2) * DQuat::from_rotation_x(0.4),
            jaw_rad: 0.6,
        }
    }

    #[test]
    fn the_tips_of_a_row_are_at_most_a_radius_apart_and_jaws_open_to_both_sides() {
        let (instrument, pose) = (grasper(), InstrumentPose { orientation: DQuat::IDENTITY, ..pose() });
        assert_eq!(instrument.tips.len(), 21 + 5 + 5);
        let [upper_m, lower_m] = [25, 30].map(|tip| instrument.tip_m(tip, &pose) - pose.place_m);
        let expected_m = DVec3::new(-0.01 + 0.01 * 0.3_f64.cos(), 0.01 * 0.3_f64.sin(), 0.0);
        assert!(
            upper_m.distance(expected_m) < 1e-15 && lower_m.distance(expected_m * DVec3::new(1.0, -1.0, 1.0)) < 1e-15
        );
        let apart_m = instrument.tip_m(0, &pose).distance(instrument.tip_m(1, &pose));
        assert!(apart_m <= 0.002 + 1e-15, "{apart_m} m");
    }

    #[test]
    fn the_power_of_a_wrench_and_of_the_jaws_is_that_of_the_forces_on_the_tips() {
        let (instrument, before) = (grasper(), pose());
        let rotation = DVec3::new(0.3, -0.7, 0.5);
        let (velocity, opening) = (DVec3::new(0.2, 0.1, -0.4), 0.9);
        let dt = 1e-6;
        let moving =
            InstrumentVelocity { velocity_m_per_s: velocity, angular_rad_per_s: rotation, jaw_rad_per_s: opening };
        let after = moving.after(&before, dt);
        let forces_n: Vec<_> = (0..instrument.tips.len())
            .map(|tip| (tip, DVec3::new((tip as f64).sin(), 0.3, (tip as f64).cos())))
            .collect();
        let moved = |(tip, force_n): &(usize, DVec3)| {
            force_n.dot(instrument.tip_m(*tip, &after) - instrument.tip_m(*tip, &before)) / dt
        };
        let power_w: f64 = forces_n.iter().map(moved).sum();
        let Wrench { force_n, torque_n_m } = instrument.wrench(&before, forces_n.iter().copied());
        let opening_n_m = instrument.opening_n_m(&before, forces_n.iter().copied());
        for tip in 0..instrument.tips.len() {
            let moved_m_per_s = (instrument.tip_m(tip, &after) - instrument.tip_m(tip, &before)) / dt;
            assert!(moved_m_per_s.distance(instrument.tip_velocity_m_per_s(tip, &before, &moving)) < 1e-5, "{tip}");
        }
        let expected_w = force_n.dot(velocity) + torque_n_m.dot(rotation) + opening_n_m * opening;
        assert!((power_w / expected_w - 1.0).abs() < 1e-5, "{power_w} {expected_w}");
        // About any point the power is the same.
        let by_m = DVec3::new(0.03, -0.02, 0.05);
        let there = Wrench { force_n, torque_n_m }.about(by_m);
        let power_w = there.force_n.dot(velocity + rotation.cross(by_m)) + there.torque_n_m.dot(rotation);
        assert!((power_w - (expected_w - opening_n_m * opening)).abs() < 1e-12, "{power_w}");
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
