//! Ports: a point through which an instrument's shaft slides and about which it turns, as through a trocar in the wall of a body.
//!
//! **Pose.** The shaft lies along x of the instrument's frame ([`crate::instrument`]). With a port it runs from the port to the
//! instrument's place, so a pose has four degrees of freedom that count: the place, and the turn about the shaft. An orientation
//! is turned to that by the smallest angle.
//!
//! **Balance.** The tissue exerts F at the place and the torque τ about it. The port exerts R across the shaft, without friction.
//! The hand holds the handle, h behind the port, by a force H and a torque along the shaft. Let a be the direction of the shaft, d
//! the distance from the port to the place, and M = τ + d·a×F the tissue's torque about the port. Then, with v⊥ the part of v across
//! a:
//!
//! - along the shaft: H∥ = −F∥, and the hand's torque is −(M·a)·a;
//! - torques about the port: −h·a×H⊥ + M⊥ = 0, so H⊥ = M⊥×a/h;
//! - forces across: R = −F⊥ − H⊥.
//!
//! The hand feels −H and (M·a)·a. It is the lever of laparoscopy: a force across the shaft is felt d/h times as large, the other way.

use std::ops::RangeInclusive;

use glam::{DQuat, DVec3};

use crate::instrument_pose::{InstrumentPose, InstrumentVelocity, Wrench};

/// Least distance between the port and the instrument's place, and between the port and the handle, m. At the port, the place has
/// no direction and the handle no lever.
pub const MIN_FROM_PORT_M: f64 = 1e-3;

/// Distances from an instrument's place to its handle that are possible, m.
pub const HANDLE_M: RangeInclusive<f64> = 0.01..=2.0;
/// Distance from the place to the handle of usual instruments for laparoscopy, m.
pub const DEFAULT_HANDLE_M: f64 = 0.33;

/// A port, and the handle of the instrument in it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Port {
    /// Where the shaft passes, m, in the frame of the tissue at rest.
    pub place_m: DVec3,
    /// Distance along the shaft from the instrument's place to the handle, m.
    pub handle_m: f64,
}

/// What a port and a hand exert on an instrument, so that it is in balance.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PortLoad {
    /// Force of the port on the instrument, N; across the shaft.
    pub force_of_port_n: DVec3,
    /// Force and torque of the instrument on the hand; the torque is about the handle, along the shaft.
    pub on_hand: Wrench,
}

impl Port {
    /// Returns the distances from the port at which the instrument's place can be, m.
    pub fn depths_m(&self) -> RangeInclusive<f64> {
        MIN_FROM_PORT_M..=self.handle_m - MIN_FROM_PORT_M
    }

    /// Returns the least distance of the straight way between two places from the port, m.
    pub fn way_depth_m(&self, from_m: DVec3, to_m: DVec3) -> f64 {
        let way_m = to_m - from_m;
        let part = (self.place_m - from_m).dot(way_m) / way_m.length_squared().max(f64::MIN_POSITIVE);
        from_m.lerp(to_m, part.clamp(0.0, 1.0)).distance(self.place_m)
    }

    /// Returns a pose whose shaft passes through the port: same place, orientation turned by the smallest angle. One at the port
    /// keeps its orientation.
    #[must_use]
    pub fn lead(&self, pose: &InstrumentPose) -> InstrumentPose {
        let Some(axis) = (pose.place_m - self.place_m).try_normalize() else { return *pose };
        let x = pose.orientation * DVec3::X;
        let cosine = x.dot(axis);
        // To the opposite direction any axis across will do.
        let turn = if cosine > OPPOSITE {
            let DVec3 { x, y, z } = x.cross(axis);
            DQuat::from_xyzw(x, y, z, 1.0 + cosine)
        } else {
            let DVec3 { x, y, z } = pose.orientation * DVec3::Z;
            DQuat::from_xyzw(x, y, z, 0.0)
        };
        InstrumentPose { orientation: (turn.normalize() * pose.orientation).normalize(), ..*pose }
    }

    /// Returns the velocity with which a `pose` of [`Port::lead`] goes on if its place moves as `velocity` says: the shaft turns about
    /// the port, and about itself as before.
    #[must_use]
    pub fn lead_velocity(&self, pose: &InstrumentPose, velocity: &InstrumentVelocity) -> InstrumentVelocity {
        let (axis, depth_m) = self.shaft(pose);
        let about_port = axis.cross(velocity.velocity_m_per_s) / depth_m;
        InstrumentVelocity { angular_rad_per_s: about_port + velocity.angular_rad_per_s.dot(axis) * axis, ..*velocity }
    }

    /// Returns what port and hand exert on an instrument at a `pose` of [`Port::lead`]. `wrench` is that of the tissue, about the
    /// instrument's place.
    pub fn load(&self, pose: &InstrumentPose, wrench: &Wrench) -> PortLoad {
        let (axis, depth_m) = self.shaft(pose);
        let Wrench { force_n, torque_n_m } = *wrench;
        let about_port_n_m = torque_n_m + depth_m * axis.cross(force_n);
        let lever_m = (self.handle_m - depth_m).max(MIN_FROM_PORT_M);
        let hand_across_n = about_port_n_m.cross(axis) / lever_m;
        let along_n = force_n.dot(axis) * axis;
        PortLoad {
            force_of_port_n: along_n - force_n - hand_across_n,
            on_hand: Wrench { force_n: along_n - hand_across_n, torque_n_m: about_port_n_m.dot(axis) * axis },
        }
    }

    /// Returns the wrench on a device at a pose, whose instrument [`Port::lead`] leads, about its place. `wrench` is that of the tissue on
    /// the instrument, about the same place.
    ///
    /// The device moves at v and turns at ω; x is its own x axis and a the shaft's direction. The instrument then turns at
    /// a×v/d + s·a, with s = (x + a)·ω/(1 + x·a) − x·(a×v)/(d·(1 + x·a)): it turns about itself as the device does, less what the
    /// smallest turn from x to a does. So the power F·v + τ·(a×v)/d + s·τ·a is that of the force F + τ×a/d − (τ·a)·(x×a)/(d·(1 + x·a))
    /// and the torque (τ·a)·(x + a)/(1 + x·a).
    pub fn on_device(&self, device: &InstrumentPose, wrench: &Wrench) -> Wrench {
        let (axis, depth_m) = self.shaft(&self.lead(device));
        let own = device.orientation * DVec3::X;
        // Where the device points away from the shaft, its turn does not tell that of the instrument: no torque then.
        let sum = 1.0 + own.dot(axis);
        let rolls = if sum > AWAY { wrench.torque_n_m.dot(axis) / sum } else { 0.0 };
        Wrench {
            force_n: wrench.force_n + (wrench.torque_n_m.cross(axis) - rolls * own.cross(axis)) / depth_m,
            torque_n_m: rolls * (own + axis),
        }
    }

    /// Returns the direction of the shaft and the distance from the port to the instrument's place, m.
    fn shaft(&self, pose: &InstrumentPose) -> (DVec3, f64) {
        (pose.orientation * DVec3::X, self.place_m.distance(pose.place_m).max(MIN_FROM_PORT_M))
    }
}

/// Cosine of an angle down to which the axis of the turn by it is known to rounding.
const OPPOSITE: f64 = -1.0 + 1e-12;

/// 1 + cosine of the angle between a device and the shaft down to which the device gets torque about the shaft: 120°.
const AWAY: f64 = 0.5;

#[cfg(test)]
mod tests {
    use super::*;

    const PORT: Port = Port { place_m: DVec3::new(0.02, -0.01, 0.12), handle_m: 0.3 };

    fn poses() -> impl Iterator<Item = InstrumentPose> {
        (0..20).map(|at| {
            let at = f64::from(at);
            InstrumentPose {
                place_m: DVec3::new(0.05 * at.sin(), 0.04 * at.cos(), 0.01 * (0.3 * at).sin()),
                orientation: DQuat::from_rotation_y(0.5 * at) * DQuat::from_rotation_x(at),
                jaw_rad: 0.3,
            }
        })
    }

    /// Distance of the shaft's line from the port, m.
    fn apart_m(pose: &InstrumentPose) -> f64 {
        (PORT.place_m - pose.place_m).cross(pose.orientation * DVec3::X).length()
    }

    #[test]
    fn the_shaft_passes_through_the_port_and_turns_about_itself_as_asked() {
        for pose in poses() {
            let led = PORT.lead(&pose);
            assert!(apart_m(&led) < 1e-15 && led.place_m == pose.place_m && led.jaw_rad == pose.jaw_rad, "{led:?}");
            // It points away from the port.
            assert!((led.orientation * DVec3::X).dot(pose.place_m - PORT.place_m) > 0.0);
            assert!(PORT.lead(&led).orientation.angle_between(led.orientation) < 1e-7);
            let rolled = InstrumentPose { orientation: led.orientation * DQuat::from_rotation_x(0.4), ..led };
            assert!(PORT.lead(&rolled).orientation.angle_between(rolled.orientation) < 1e-7);
        }
        // Also if the orientation is opposite, and at the port itself.
        let turned = PORT.lead(&poses().next().unwrap_or_else(|| unreachable!()));
        let opposite =
            InstrumentPose { orientation: turned.orientation * DQuat::from_rotation_z(std::f64::consts::PI), ..turned };
        assert!(apart_m(&PORT.lead(&opposite)) < 1e-15);
        let there = InstrumentPose { place_m: PORT.place_m, ..turned };
        assert_eq!(PORT.lead(&there), there);
    }

    #[test]
    fn a_way_past_the_port_comes_as_near_to_it_as_its_nearest_place() {
        let [from_m, to_m] = [DVec3::new(-0.1, 0.002, 0.0), DVec3::new(0.1, 0.002, 0.0)].map(|m| m + PORT.place_m);
        assert!((PORT.way_depth_m(from_m, to_m) - 0.002).abs() < 1e-15);
        assert!((PORT.way_depth_m(from_m, from_m) - from_m.distance(PORT.place_m)).abs() < 1e-15);
    }

    #[test]
    fn a_velocity_keeps_the_shaft_in_the_port() {
        let velocity = InstrumentVelocity {
            velocity_m_per_s: DVec3::new(0.1, -0.05, 0.07),
            angular_rad_per_s: DVec3::new(2.0, -1.0, 3.0),
            jaw_rad_per_s: 0.5,
        };
        for pose in poses() {
            let led = PORT.lead(&pose);
            let moving = PORT.lead_velocity(&led, &velocity);
            // What is left grows with the square of the time.
            let apart_m = |time_s: f64| apart_m(&moving.after(&led, time_s));
            assert!(apart_m(0.01) < 2e-4 && apart_m(0.001) < 2e-6, "{} {}", apart_m(0.01), apart_m(0.001));
            let axis = led.orientation * DVec3::X;
            assert!((moving.angular_rad_per_s - velocity.angular_rad_per_s).dot(axis).abs() < 1e-12);
        }
    }

    /// The power is that of the instrument, whose next pose follows from that of the device.
    #[test]
    fn a_device_gets_the_power_of_the_instrument_for_each_of_its_movements() {
        let wrench = Wrench { force_n: DVec3::new(0.3, -0.7, 1.1), torque_n_m: DVec3::new(0.01, 0.02, -0.005) };
        let mut compared = 0;
        for device in poses() {
            let led = PORT.lead(&device);
            let cosine = (device.orientation * DVec3::X).dot(led.orientation * DVec3::X);
            let on_device = PORT.on_device(&device, &wrench);
            for number in 0..6 {
                let unit = |first: usize| {
                    DVec3::from_array(std::array::from_fn(|axis| f64::from(u8::from(number == first + axis))))
                };
                let velocity = InstrumentVelocity {
                    velocity_m_per_s: 0.05 * unit(0),
                    angular_rad_per_s: unit(3),
                    jaw_rad_per_s: 0.0,
                };
                let time_s = 1e-6;
                let next = PORT.lead(&velocity.after(&device, time_s));
                let tissue_w = (wrench.force_n.dot(next.place_m - led.place_m)
                    + wrench.torque_n_m.dot(led.turn_to(&next)))
                    / time_s;
                let device_w = on_device.force_n.dot(velocity.velocity_m_per_s)
                    + on_device.torque_n_m.dot(velocity.angular_rad_per_s);
                if 1.0 + cosine > AWAY {
                    assert!((tissue_w - device_w).abs() < 1e-4, "{cosine} {number}: {tissue_w} {device_w}");
                    compared += 1;
                }
            }
        }
        assert!(compared > 50, "{compared}");
    }

    #[test]
    fn the_reaction_of_the_port_balances_the_wrench_and_no_power_is_lost() {
        let wrench = Wrench { force_n: DVec3::new(0.3, -0.7, 1.1), torque_n_m: DVec3::new(0.01, 0.02, -0.005) };
        let velocity = InstrumentVelocity {
            velocity_m_per_s: DVec3::new(0.1, -0.05, 0.07),
            angular_rad_per_s: DVec3::new(2.0, -1.0, 3.0),
            jaw_rad_per_s: 0.0,
        };
        for pose in poses() {
            let led = PORT.lead(&pose);
            let PortLoad { force_of_port_n, on_hand } = PORT.load(&led, &wrench);
            let axis = led.orientation * DVec3::X;
            assert!(force_of_port_n.dot(axis).abs() < 1e-14);
            assert!((wrench.force_n + force_of_port_n - on_hand.force_n).length() < 1e-14);
            // Torques about the instrument's place.
            let port_m = PORT.place_m - led.place_m;
            let handle_m = -PORT.handle_m * axis;
            let torque_n_m = wrench.torque_n_m + port_m.cross(force_of_port_n)
                - handle_m.cross(on_hand.force_n)
                - on_hand.torque_n_m;
            assert!(torque_n_m.length() < 1e-14, "{torque_n_m}");
            // The port does no work: the hand gets the power that the tissue gives.
            let moving = PORT.lead_velocity(&led, &velocity);
            let handle_m_per_s = moving.velocity_m_per_s + moving.angular_rad_per_s.cross(handle_m);
            let [tissue_w, hand_w] = [(&wrench, moving.velocity_m_per_s), (&on_hand, handle_m_per_s)]
                .map(|(wrench, speed)| wrench.force_n.dot(speed) + wrench.torque_n_m.dot(moving.angular_rad_per_s));
            assert!((tissue_w - hand_w).abs() < 1e-12, "{tissue_w} {hand_w}");
        }
    }
}
