//! Instruments: rigid sets of tips that one pose moves, some of them on two jaws.
//!
//! **Frame.** An instrument has a frame of its own, whose origin is the place of its pose. It points along x: the shaft runs from
//! the origin along −x, and jaws run from their hinge along x. They turn about the axis along z through the hinge, each by half of
//! the angle between them: the upper jaw towards y, the lower one towards −y.
//!
//! **Forces.** The force of a tip acts at the tip's place; that on a blade where its edge pierces the surface ([`TipForce`]). An instrument's wrench is the sum of its tips' forces and of their torques
//! about the instrument's place.

use glam::{DQuat, DVec3};

use crate::capsule::Capsule;
use crate::instrument_pose::{InstrumentPose, InstrumentVelocity, Wrench};
use crate::port::{Port, PortLoad};
use crate::tip::{Tip, TipShape};

/// Largest number of tips of an instrument.
pub const MAX_TIPS: usize = 64;

/// By how much of its radius r a sphere of a row is larger than the row's capsule, if the tips are r apart; it grows with the square of
/// their distance. Between two spheres a row is thinner than a capsule. A shaft of 24 mm and r = 4 mm on a block of 60 × 60 × 30 mm,
/// beside one with 25 tips, where the pressed depth is 3, 2 and 1.5 mm in cells of 5 mm, and 2 mm in cells of 4 mm:
///
/// | larger by | error of force and torque |
/// |---|---|
/// | 0 | −8, −9, −9, −10 % |
/// | 2 % | −4, −3, −3, −6 % |
/// | 4.2 %, with which it is as thick in the mean | 0, 3, 5, −1 % |
pub const BETWEEN_SPHERES: f64 = 0.035;

/// By which part of their length the edges of closed scissors have passed each other: what lies between them is cut.
pub const PASSED: f64 = 0.02;

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

/// The force of the tissue on a tip of an instrument.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TipForce {
    /// The tip's number.
    pub tip: usize,
    /// The force on it, N, in the tissue's frame.
    pub force_n: DVec3,
    /// From the tip's place to where the force acts, m: 0, except for a blade, on which it acts where the edge pierces the surface.
    pub lever_m: DVec3,
}

impl From<(usize, DVec3)> for TipForce {
    /// Returns a force that acts at the place of a tip, from its number and the force, N.
    fn from((tip, force_n): (usize, DVec3)) -> Self {
        TipForce { tip, force_n, lever_m: DVec3::ZERO }
    }
}

/// A rigid set of tips, with or without jaws.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Instrument {
    /// The tips, at most [`MAX_TIPS`].
    pub tips: Vec<InstrumentTip>,
    /// The hinge of the jaws in the instrument's frame, m.
    pub hinge_m: DVec3,
    /// The port through which its shaft slides; `None`: it moves freely.
    pub port: Option<Port>,
    /// The torque between its jaws above which they crush what they hold, N·m ([`crate::JawTorqueMonitor`]); `None`: they have no limit.
    /// It changes no force.
    pub jaw_torque_limit_n_m: Option<f64>,
}

impl Instrument {
    /// Returns the instrument that is a single tip, at the place of its pose.
    pub fn of_tip(tip: Tip) -> Self {
        let tip = InstrumentTip { offset_m: DVec3::ZERO, tip, part: InstrumentPart::Body };
        Instrument { tips: vec![tip], ..Instrument::default() }
    }

    /// Adds jaws that end at the origin, and a shaft behind them or behind scissors, each with its length, m, and its tip. Closed jaws of spheres touch
    /// each other; discs lie on the tissue, so that those of both jaws lie on the instrument's axis.
    pub fn add_parts(&mut self, jaws: Option<(f64, Tip)>, shaft: Option<(f64, Tip)>) {
        let mut from_m = self.hinge_m;
        if let Some((length_m, tip)) = jaws {
            self.hinge_m = -length_m * DVec3::X;
            from_m = self.hinge_m;
            // At the hinge the tips of both jaws would lie within each other.
            let begin_m = from_m + (2.0 * tip.radius_m).min(length_m) * DVec3::X;
            for (part, side) in [(InstrumentPart::UpperJaw, 1.0), (InstrumentPart::LowerJaw, -1.0)] {
                let beside_m = if tip.shape == TipShape::Sphere { side * tip.radius_m * DVec3::Y } else { DVec3::ZERO };
                self.add_row(begin_m + beside_m, beside_m, tip, part);
            }
        }
        if let Some((length_m, tip)) = shaft {
            self.add_row(from_m, from_m - length_m * DVec3::X, tip, InstrumentPart::Body);
        }
    }

    /// Adds the jaws of scissors, which end at the origin: a blade on each, `length_m` (m) long, from the hinge on. The tip `blade` gives radius
    /// and friction. When the jaws are closed, the edges have passed each other by [`PASSED`] of their length.
    pub fn add_scissors(&mut self, length_m: f64, blade: Tip) {
        self.hinge_m = -length_m * DVec3::X;
        let tip = Tip { shape: TipShape::Blade, edge_m: -length_m * DVec3::X, ..blade };
        for (part, side) in [(InstrumentPart::UpperJaw, 1.0), (InstrumentPart::LowerJaw, -1.0)] {
            self.tips.push(InstrumentTip { offset_m: -side * PASSED * length_m * DVec3::Y, tip, part });
        }
    }

    /// Adds a row of equal tips, from `from_m` to `to_m` (m, in the instrument's frame), at most a radius apart: a capsule of the radius of
    /// `tip`. One tip if both are the same place. Spheres are larger than that by [`BETWEEN_SPHERES`].
    pub fn add_row(&mut self, from_m: DVec3, to_m: DVec3, tip: Tip, part: InstrumentPart) {
        // Saturating cast: a length without end gives more tips than an instrument may have.
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let gaps = ((from_m.distance(to_m) / tip.radius_m).ceil() as usize).min(MAX_TIPS);
        let offsets_m = (0..=gaps).map(|at| from_m.lerp(to_m, at as f64 / gaps.max(1) as f64));
        let apart = from_m.distance(to_m) / gaps.max(1) as f64 / tip.radius_m;
        let wider = if tip.shape == TipShape::Sphere { 1.0 + BETWEEN_SPHERES * apart * apart } else { 1.0 };
        let tip = Tip { radius_m: wider * tip.radius_m, ..tip };
        self.tips.extend(offsets_m.map(|offset_m| InstrumentTip { offset_m, tip, part }));
    }

    /// Returns the first and the last tip of each row of tips: tips of one part and radius that follow each other on a straight line,
    /// at most a radius apart. Each row is a capsule; a tip beside which there is no other is a row of its own.
    pub fn rows(&self) -> Vec<[usize; 2]> {
        let mut rows: Vec<[usize; 2]> = Vec::new();
        for (number, tip) in self.tips.iter().enumerate() {
            let goes_on = |row: &[usize; 2]| {
                let [first, last] = row.map(|tip| &self.tips[tip]);
                let way_m = tip.offset_m - last.offset_m;
                let before = (last.offset_m - first.offset_m).try_normalize();
                let is_straight = before.is_none_or(|before| before.dot(way_m) >= (1.0 - 1e-9) * way_m.length());
                let radius_m = tip.tip.radius_m;
                (tip.part, radius_m) == (last.part, last.tip.radius_m)
                    && way_m.length() <= (1.0 + 1e-9) * radius_m
                    && is_straight
            };
            match rows.last_mut().filter(|row| goes_on(row)) {
                Some(row) => row[1] = number,
                None => rows.push([number; 2]),
            }
        }
        rows
    }

    /// Returns the capsule of a row ([`Instrument::rows`]) at a pose. Panics if there is no such tip.
    pub fn capsule(&self, row: [usize; 2], pose: &InstrumentPose) -> Capsule {
        Capsule { ends_m: row.map(|tip| self.tip_m(tip, pose)), radius_m: self.capsule_radius_m(row) }
    }

    /// Returns the radius of the capsule of a row, m: that of which [`Instrument::add_row`] makes its tips.
    pub(crate) fn capsule_radius_m(&self, [first, last]: [usize; 2]) -> f64 {
        let Tip { radius_m, shape, .. } = self.tips[first].tip;
        if shape != TipShape::Sphere {
            return radius_m;
        }
        let apart_m = self.tips[first].offset_m.distance(self.tips[last].offset_m) / (last - first).max(1) as f64;
        0.5 * (radius_m + (radius_m * radius_m - 4.0 * BETWEEN_SPHERES * apart_m * apart_m).max(0.0).sqrt())
    }

    /// Returns where the instrument is if a hand leads it to a pose: with a port, its shaft passes through that ([`Port::lead`]).
    #[must_use]
    pub fn lead(&self, pose: &InstrumentPose) -> InstrumentPose {
        self.port.map_or(*pose, |port| port.lead(pose))
    }

    /// Returns the velocity at a pose of [`Instrument::lead`] if a hand leads it with a velocity.
    #[must_use]
    pub fn lead_velocity(&self, pose: &InstrumentPose, velocity: &InstrumentVelocity) -> InstrumentVelocity {
        self.port.map_or(*velocity, |port| port.lead_velocity(pose, velocity))
    }

    /// Returns what port and hand exert at a pose of [`Instrument::lead`] and a wrench of the tissue; `None` without a port.
    pub fn port_load(&self, pose: &InstrumentPose, wrench: &Wrench) -> Option<PortLoad> {
        self.port.map(|port| port.load(pose, wrench))
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

    /// Returns a tip by its number, with the edge of a blade in the tissue's frame. Panics if there is no such tip.
    pub fn tip(&self, number: usize, pose: &InstrumentPose) -> Tip {
        let InstrumentTip { tip, part, .. } = self.tips[number];
        if tip.edge_m == DVec3::ZERO {
            return tip;
        }
        Tip { edge_m: pose.orientation * (about_z(part.turn() * pose.jaw_rad) * tip.edge_m), ..tip }
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

    /// Returns the wrench of forces on the tips about the instrument's place.
    pub fn wrench(&self, pose: &InstrumentPose, forces: impl IntoIterator<Item = impl Into<TipForce>>) -> Wrench {
        forces.into_iter().map(Into::into).fold(Wrench::default(), |sum, TipForce { tip, force_n, lever_m }| Wrench {
            force_n: sum.force_n + force_n,
            torque_n_m: sum.torque_n_m + (self.tip_m(tip, pose) + lever_m - pose.place_m).cross(force_n),
        })
    }

    /// Returns the torque with which forces on the tips open the jaws, N·m: half the difference
    /// of the torques on both jaws about their hinge, so that its product with the angle's velocity is their power.
    pub fn opening_n_m(&self, pose: &InstrumentPose, forces: impl IntoIterator<Item = impl Into<TipForce>>) -> f64 {
        let (axis, hinge_m) = self.hinge(pose);
        let of = |TipForce { tip, force_n, lever_m }: TipForce| {
            self.tips[tip].part.turn() * (self.tip_m(tip, pose) + lever_m - hinge_m).cross(force_n).dot(axis)
        };
        forces.into_iter().map(Into::into).map(of).sum()
    }
}

/// Returns the rotation by an angle about z. (glam's own takes sine and cosine from the system, whose last digits differ.)
fn about_z(angle_rad: f64) -> DQuat {
    DQuat::from_xyzw(0.0, 0.0, libm::sin(0.5 * angle_rad), libm::cos(0.5 * angle_rad))
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
        // Jaws as short as a tip is wide have one tip each.
        let mut short = Instrument::default();
        short.add_parts(Some((0.004, Tip { radius_m: 0.002, ..Tip::default() })), None);
        assert_eq!(short.tips.len(), 2);
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
}
