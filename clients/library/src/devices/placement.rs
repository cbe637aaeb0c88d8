//! Places a device's workspace over the tissue, and implements the clutch.
//!
//! A position p of the device, from the middle of its workspace, becomes `offset + scale·R·p` from the top of the
//! tissue. A force f of the tissue becomes `force_scale·R⁻¹·f` at the device. So the work at the device is
//! `force_scale/scale` times the work at the tissue: if the envelope keeps the tissue side passive, the device side
//! is passive too, for any scale. A spring of the tissue is felt `scale·force_scale` times as stiff, so the device's
//! limits are declared to the server divided by that. As `force_scale` is at most 1, the envelope's largest force is
//! never exceeded.

use std::time::Instant;

use glam::{DQuat, DVec3, EulerRot};
use palpate_haptics::{Device, Wrench};
use palpate_refusal::{Reason, Refusal, Result, finite_vector, legible, number};

use crate::bridge::Tick;
use crate::device::{HapticDevice, Reading};

/// Limit on the shift by the clutch, m.
const SHIFT_M: f64 = 1.0;

/// Limit on the offset, m.
const OFFSET_M: f64 = 10.0;

/// Magnitude of the rendered force, N, before `force_scale`, below which the device gets forces again after a clutch.
pub const ENGAGED_N: f64 = 0.01;

/// Interval at which [`Enables::Always`] requests forces, s.
const ASKS_EVERY_S: f64 = 0.3;

/// What requests the forces of a [`Placed`] device ([`Reading::enable`]).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Enables {
    /// The operator, by the device's button with this number, 0 to 31.
    Button(u32),
    /// Forces return by themselves, requested anew every 0.3 s: for devices without a button.
    Always,
    /// The operator, as the device's own readings report it.
    #[default]
    Device,
}

/// Where a device's workspace is placed over the tissue, with its scales and buttons. The default leaves it on the top
/// of the tissue, neither rotated nor scaled, with the clutch on button 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placement {
    /// The middle of the workspace, from the top of the tissue, along the axes of the tissue, m; at most 10 m long.
    pub offset_m: DVec3,
    /// Rotation of the device about the tissue's x, then y, then z axis, degrees, -360 to 360 each.
    pub rotation_deg: DVec3,
    /// Metres of the tissue per metre of the device, 0.01 to 100.
    pub scale: f64,
    /// Newtons at the device per newton of the tissue, 0.01 to 1.
    pub force_scale: f64,
    /// What requests forces.
    pub enable: Enables,
    /// Number of the clutch button, 0 to 31, other than that of [`Enables::Button`]: while it is held, the device
    /// moves without the tool. `None`: no clutch.
    pub clutch_button: Option<u32>,
}

impl Default for Placement {
    fn default() -> Self {
        Placement {
            offset_m: DVec3::ZERO,
            rotation_deg: DVec3::ZERO,
            scale: 1.0,
            force_scale: 1.0,
            enable: Enables::Device,
            clutch_button: Some(1),
        }
    }
}

impl Placement {
    /// Checks that all values are within their ranges.
    ///
    /// # Errors
    /// Refuses the first field, by its name, that is not finite or out of its range, and a `clutch_button` that is
    /// also the button of [`Enables::Button`] (named `enable_button`).
    pub fn check(&self) -> Result<()> {
        let Placement { offset_m, rotation_deg, scale, force_scale, enable, clutch_button } = *self;
        finite_vector("offset_m", offset_m)?;
        if offset_m.length() > OFFSET_M {
            let off_m = legible(offset_m.length());
            let message = format!("must be within {OFFSET_M} m of the top of the tissue, but is {off_m} m off");
            return Err(Refusal::new(Reason::OutOfRange, "offset_m", message));
        }
        finite_vector("rotation_deg", rotation_deg)?;
        if rotation_deg.abs().max_element() > 360.0 {
            return Err(Refusal::new(Reason::OutOfRange, "rotation_deg", "must be from -360 to 360 about each axis"));
        }
        number("scale", scale, "from 0.01 to 100", |scale| (0.01..=100.0).contains(&scale))?;
        number("force_scale", force_scale, "from 0.01 to 1", |scale| (0.01..=1.0).contains(&scale))?;
        let enables = if let Enables::Button(button) = enable { Some(button) } else { None };
        for (field, button) in [("enable_button", enables), ("clutch_button", clutch_button)] {
            if let Some(button) = button.filter(|button| *button > 31) {
                return Err(Refusal::new(Reason::OutOfRange, field, format!("must be from 0 to 31, but is {button}")));
            }
        }
        if enables.is_some() && enables == clutch_button {
            let message = "must be another button than the one that asks for forces";
            return Err(Refusal::new(Reason::OutOfRange, "clutch_button", message));
        }
        Ok(())
    }

    fn rotation(&self) -> DQuat {
        let [x, y, z] = (self.rotation_deg * (std::f64::consts::PI / 180.0)).to_array();
        // The axes are the tissue's, which do not turn: x, applied first, is the rightmost factor.
        DQuat::from_euler(EulerRot::ZYX, z, y, x)
    }
}

/// A device whose workspace is placed over the tissue, rotated and scaled, with a clutch.
///
/// While the clutch is held, the tool stays where it is, as it is turned, and the device gets no force. When it is released, the tool
/// continues from there, unless it would be shifted by more than 1 m in all; forces return once the rendered force is
/// below [`ENGAGED_N`], as outside the tissue: none starts within it.
#[derive(Debug)]
pub struct Placed<D> {
    device: D,
    placement: Placement,
    rotation: DQuat,
    /// Shift by the clutch, in the tissue's frame, m.
    shift_m: DVec3,
    /// The tool's place while the clutch is held, m, and its orientation.
    held_m: Option<DVec3>,
    held_turn: Option<DQuat>,
    /// Turn by the clutch, in the tissue's frame.
    shift: DQuat,
    /// The lever at which the device's torque counts as a force, m.
    lever_m: f64,
    /// Whether the clutch is held, or was released and the envelope's force has not been small since.
    is_shut: bool,
    begun: Option<Instant>,
}

impl<D: HapticDevice> Placed<D> {
    /// Places `device` over the tissue. Neither reads nor moves it.
    ///
    /// # Errors
    /// Returns the refusals of [`Placement::check`]; the device is then dropped.
    pub fn new(device: D, placement: Placement) -> Result<Self> {
        placement.check()?;
        let rotation = placement.rotation();
        let lever_m = device.descriptor().lever_m();
        Ok(Placed {
            device,
            placement,
            rotation,
            shift_m: DVec3::ZERO,
            held_m: None,
            held_turn: None,
            shift: DQuat::IDENTITY,
            lever_m,
            is_shut: false,
            begun: None,
        })
    }

    /// Returns the device that was placed, with its own frame and limits.
    pub fn device(&self) -> &D {
        &self.device
    }

    /// Returns the wrench of the tool as that of the device. The powers of force and torque have the same ratio on both sides, so that
    /// what is passive stays so: ways are scaled, turns are not.
    fn pass(&mut self, wrench: Wrench) -> Wrench {
        let turns_n = if self.lever_m > 0.0 { wrench.torque_n_m.length() / self.lever_m } else { 0.0 };
        if self.held_m.is_none() && wrench.force_n.length().max(turns_n) < ENGAGED_N {
            self.is_shut = false;
        }
        if self.is_shut {
            return Wrench::default();
        }
        let (Placement { scale, force_scale, .. }, back) = (self.placement, self.rotation.inverse());
        Wrench {
            force_n: force_scale * (back * wrench.force_n),
            torque_n_m: force_scale / scale * (back * wrench.torque_n_m),
        }
    }

    fn asks(&mut self, reading: Reading, buttons: u32) -> bool {
        match self.placement.enable {
            Enables::Device => reading.enable,
            Enables::Button(button) => buttons >> button & 1 != 0,
            Enables::Always => {
                let passed_s = self.begun.get_or_insert_with(Instant::now).elapsed().as_secs_f64();
                passed_s % ASKS_EVERY_S < ASKS_EVERY_S / 2.0
            }
        }
    }
}

impl<D: HapticDevice> HapticDevice for Placed<D> {
    fn descriptor(&self) -> Device {
        let (device, Placement { scale, force_scale, offset_m, clutch_button, .. }) =
            (self.device.descriptor(), self.placement);
        let shift_m =
            if clutch_button.is_some_and(|button| button < self.device.button_count()) { SHIFT_M } else { 0.0 };
        Device {
            stiffness_n_per_m: device.stiffness_n_per_m / (scale * force_scale),
            damping_n_s_per_m: device.damping_n_s_per_m / (scale * force_scale),
            workspace_m: scale * device.workspace_m + offset_m.length() + shift_m,
            torque_n_m: device.torque_n_m * scale / force_scale,
            ..device
        }
    }

    fn read(&mut self) -> std::io::Result<Reading> {
        let reading = self.device.read()?;
        let buttons = self.device.buttons();
        let enable = self.asks(reading, buttons);
        let laid_m = self.placement.offset_m + self.placement.scale * (self.rotation * reading.place_m);
        let laid = self.rotation * self.device.orientation();
        let is_held = self.placement.clutch_button.is_some_and(|button| buttons >> button & 1 != 0);
        let place_m = match (is_held, self.held_m) {
            (true, held_m) => {
                self.is_shut = true;
                self.held_turn.get_or_insert(self.shift * laid);
                *self.held_m.insert(held_m.unwrap_or(laid_m + self.shift_m))
            }
            (false, Some(held_m)) => {
                // It continues from where it stood.
                self.shift_m = (held_m - laid_m).clamp_length_max(SHIFT_M);
                self.held_m = None;
                if let Some(held) = self.held_turn.take() {
                    self.shift = (held * laid.inverse()).normalize();
                }
                laid_m + self.shift_m
            }
            (false, None) => laid_m + self.shift_m,
        };
        Ok(Reading { place_m, enable })
    }

    fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
        let passed = self.pass(Wrench::of_force(force_n));
        self.device.write(passed.force_n)
    }

    fn orientation(&self) -> DQuat {
        self.held_turn.unwrap_or(self.shift * self.rotation * self.device.orientation())
    }

    fn jaw_rad(&self) -> f64 {
        self.device.jaw_rad()
    }

    fn write_wrench(&mut self, wrench: Wrench) -> std::io::Result<()> {
        let passed = self.pass(wrench);
        self.device.write_wrench(passed)
    }

    fn buttons(&self) -> u32 {
        self.device.buttons()
    }

    fn button_count(&self) -> u32 {
        self.device.button_count()
    }

    fn ticked(&mut self, tick: &Tick) {
        self.device.ticked(tick);
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use palpate_haptics::device::UNDECLARED;

    use super::*;

    #[derive(Default)]
    struct Fake {
        place_m: DVec3,
        buttons: u32,
        force_n: DVec3,
    }

    impl HapticDevice for Fake {
        fn descriptor(&self) -> Device {
            UNDECLARED
        }

        fn read(&mut self) -> std::io::Result<Reading> {
            Ok(Reading { place_m: self.place_m, enable: self.buttons & 1 != 0 })
        }

        fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
            self.force_n = force_n;
            Ok(())
        }

        fn buttons(&self) -> u32 {
            self.buttons
        }
    }

    fn near(a: DVec3, b: DVec3) -> bool {
        (a - b).length() < 1e-12
    }

    #[test]
    fn a_place_is_turned_scaled_and_shifted_and_a_force_goes_back() {
        let placement = Placement {
            offset_m: DVec3::new(0.01, 0.0, 0.0),
            rotation_deg: DVec3::new(0.0, 0.0, 90.0),
            scale: 0.5,
            force_scale: 0.8,
            ..Placement::default()
        };
        let mut placed = Placed::new(Fake::default(), placement).unwrap();
        placed.device.place_m = 0.02 * DVec3::X;
        // The device's x is the tissue's y.
        assert!(near(placed.read().unwrap().place_m, DVec3::new(0.01, 0.01, 0.0)));
        placed.write(DVec3::new(0.0, 2.0, 1.0)).unwrap();
        assert!(near(placed.device.force_n, DVec3::new(1.6, 0.0, 0.8)), "{}", placed.device.force_n);
        let descriptor = placed.descriptor();
        assert!((descriptor.stiffness_n_per_m - UNDECLARED.stiffness_n_per_m / 0.4).abs() < 1e-9);
        assert_eq!(descriptor.force_n, UNDECLARED.force_n);
        // About x, then y, then z, of axes that do not turn: z goes to -y by the first, and on to x by the last.
        let turned = Placement { rotation_deg: DVec3::new(90.0, 0.0, 90.0), ..Placement::default() };
        assert!(near(turned.rotation() * DVec3::Z, DVec3::X), "{}", turned.rotation() * DVec3::Z);
    }

    #[test]
    fn the_work_at_the_device_is_that_at_the_tissue_by_one_factor() {
        let placement = Placement {
            rotation_deg: DVec3::new(20.0, -50.0, 130.0),
            scale: 3.0,
            force_scale: 0.25,
            ..Placement::default()
        };
        let mut placed = Placed::new(Fake::default(), placement).unwrap();
        let (mut at_device, mut at_tissue) = (0.0, 0.0);
        let mut before = (DVec3::ZERO, DVec3::ZERO);
        for tick in 0..200 {
            let t = 0.05 * f64::from(tick);
            placed.device.place_m = 0.01 * DVec3::new(t.sin(), (1.3 * t).cos() - 1.0, (0.7 * t).sin());
            let place_m = placed.read().unwrap().place_m;
            let force_n = DVec3::new((2.0 * t).cos(), 0.5, -(t.sin()));
            at_device += placed.device.force_n.dot(placed.device.place_m - before.0);
            if tick > 0 {
                let last_n = placement.rotation() * placed.device.force_n / placement.force_scale;
                at_tissue += last_n.dot(place_m - before.1);
            }
            placed.write(force_n).unwrap();
            before = (placed.device.place_m, place_m);
        }
        assert!(
            at_tissue.abs() > 1e-3 && (at_device - at_tissue * 0.25 / 3.0).abs() < 1e-12,
            "{at_device} {at_tissue}"
        );
    }

    #[test]
    fn the_clutch_holds_the_tool_and_takes_the_force_until_the_tool_is_out_of_the_tissue() {
        let mut placed = Placed::new(Fake::default(), Placement::default()).unwrap();
        let mut tick = |place_m: DVec3, buttons: u32, force_n: DVec3| {
            (placed.device.place_m, placed.device.buttons) = (place_m, buttons);
            let reading = placed.read().unwrap();
            placed.write(force_n).unwrap();
            (reading, placed.device.force_n)
        };
        assert!(tick(DVec3::ZERO, 1, DVec3::Z).0.enable);
        assert_eq!(tick(-0.001 * DVec3::Z, 0, DVec3::Z).1, DVec3::Z);
        // Held: the device moves, the tool stays where it was when the button was pressed.
        let held_m = DVec3::new(0.002, 0.0, -0.001);
        for moved in 1..10 {
            let place_m = DVec3::new(0.002 * f64::from(moved), 0.0, -0.001);
            let (reading, force_n) = tick(place_m, 2, DVec3::Z);
            assert!(near(reading.place_m, held_m) && force_n == DVec3::ZERO);
        }
        // Released: it continues from where it stood, without a force as long as it is in the tissue.
        for _ in 0..4 {
            let (reading, force_n) = tick(DVec3::new(0.018, 0.0, -0.001), 0, DVec3::Z);
            assert!(near(reading.place_m, held_m) && force_n == DVec3::ZERO, "{reading:?}");
        }
        let (reading, force_n) = tick(DVec3::new(0.018, 0.0, 0.001), 0, DVec3::ZERO);
        assert!(near(reading.place_m, held_m + 0.002 * DVec3::Z) && force_n == DVec3::ZERO);
        // From then on the device gets the envelope's force.
        assert_eq!(tick(DVec3::new(0.018, 0.0, -0.001), 0, 0.3 * DVec3::Z).1, 0.3 * DVec3::Z);
    }

    #[test]
    fn what_is_out_of_range_is_refused_by_the_name_of_its_field() {
        let good = Placement::default();
        let cases = [
            ("offset_m", Placement { offset_m: DVec3::splat(8.0), ..good }),
            ("offset_m", Placement { offset_m: DVec3::NAN, ..good }),
            ("rotation_deg", Placement { rotation_deg: 400.0 * DVec3::X, ..good }),
            ("scale", Placement { scale: 0.0, ..good }),
            ("scale", Placement { scale: f64::NAN, ..good }),
            ("force_scale", Placement { force_scale: 1.5, ..good }),
            ("clutch_button", Placement { clutch_button: Some(32), ..good }),
            ("clutch_button", Placement { enable: Enables::Button(1), ..good }),
            ("enable_button", Placement { enable: Enables::Button(40), ..good }),
        ];
        for (field, placement) in cases {
            assert_eq!(Placed::new(Fake::default(), placement).err().unwrap().field, field, "{placement:?}");
        }
    }
}
