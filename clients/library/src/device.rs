//! The interface of haptic devices.
//!
//! Implement [`HapticDevice`] with your manufacturer's library and pass it to [`crate::bridge::run`], which calls it
//! at 1 kHz on a thread of its own. Positions are in metres and forces in newtons, in the device's frame: its origin
//! is the middle of the device's workspace, x points right, y away from the operator, and z up. The bridge places the
//! origin on the top of the tissue, which is the middle of a sheet; z points out of the tissue. Forces act on the
//! hand. Convert the library's units and axes in your adapter. [`crate::devices`] has adapters for the devices of
//! some makers, and can place a workspace elsewhere.

use glam::{DQuat, DVec3};
use palpate_haptics::{Device, Wrench};

use crate::bridge::Tick;

/// The position of a device at a tick, and whether its operator requests forces.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    /// Position in the device's frame, m. With a value that is not finite, no force is rendered.
    pub place_m: DVec3,
    /// Whether the operator requests forces, by a button or pedal. Only a change from false to true enables them.
    pub enable: bool,
}

/// A haptic device, as [`crate::bridge::run`] uses it.
///
/// Each tick of 1 ms calls `read` and then `write` once, on the thread of the loop; both must return within a fraction
/// of a tick. An error of either ends the loop. The loop then writes a force of zero once, as at every other end; but
/// after a panic in one of these methods, the device is only dropped.
///
/// # Example
///
/// An adapter for a library that measures in millimetres, with y up and z towards the operator:
///
/// ```
/// use glam::DVec3;
/// use palpate_client::{HapticDevice, Reading};
/// use palpate_haptics::Device;
/// # mod maker {
/// #     pub struct Handle;
/// #     impl Handle {
/// #         pub fn position_mm(&self) -> Option<[f64; 3]> { Some([1.0, 2.0, 3.0]) }
/// #         pub fn is_pressed(&self) -> bool { true }
/// #         pub fn set_force_n(&mut self, _: [f64; 3]) -> bool { true }
/// #     }
/// # }
///
/// struct Adapter(maker::Handle);
///
/// impl HapticDevice for Adapter {
///     fn descriptor(&self) -> Device {
///         Device {
///             name: "mine",
///             force_n: 3.3,
///             continuous_n: 0.9,
///             stiffness_n_per_m: 700.0,
///             damping_n_s_per_m: 5.0,
///             workspace_m: 0.1,
///             torque_n_m: 0.0,
///         }
///     }
///
///     fn read(&mut self) -> std::io::Result<Reading> {
///         let [x, y, z] = self.0.position_mm().ok_or(std::io::ErrorKind::NotConnected)?;
///         Ok(Reading { place_m: 1e-3 * DVec3::new(x, -z, y), enable: self.0.is_pressed() })
///     }
///
///     fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
///         let is_set = self.0.set_force_n([force_n.x, force_n.z, -force_n.y]);
///         is_set.then_some(()).ok_or(std::io::ErrorKind::NotConnected.into())
///     }
/// }
/// # let mut adapter = Adapter(maker::Handle);
/// # assert_eq!(adapter.read().unwrap().place_m, DVec3::new(0.001, -0.003, 0.002));
/// # adapter.write(DVec3::Z).unwrap();
/// ```
pub trait HapticDevice: Send {
    /// Returns the device's limits. They are sent to the server, and no force exceeds them. Called once, before the
    /// loop starts; later changes have no effect.
    fn descriptor(&self) -> Device;
    /// Reads the current position, and whether the operator requests forces.
    ///
    /// # Errors
    /// Returns an error if the device can't be read; it ends the loop.
    fn read(&mut self) -> std::io::Result<Reading>;
    /// Sets the force to render until the next call, N, in the device's frame, acting on the hand.
    ///
    /// # Errors
    /// Returns an error if the force can't be set; it ends the loop.
    fn write(&mut self, force_n: DVec3) -> std::io::Result<()>;
    /// Returns the orientation of the device's handle at the newest reading, of length 1: it turns vectors of an instrument's frame
    /// ([`palpate_haptics::instrument`]) into the device's frame. By default not turned.
    fn orientation(&self) -> DQuat {
        DQuat::IDENTITY
    }
    /// Returns the angle of the device's gripper at the newest reading, rad, 0 while it is closed. By default 0.
    fn jaw_rad(&self) -> f64 {
        0.0
    }
    /// Sets force and torque to render until the next call, in the device's frame, acting on the hand; the torque is about the
    /// device's position. Called in place of `write` while the device leads an instrument. By default writes the force alone.
    ///
    /// # Errors
    /// Returns an error if they can't be set; it ends the loop.
    fn write_wrench(&mut self, wrench: Wrench) -> std::io::Result<()> {
        self.write(wrench.force_n)
    }
    /// Returns the buttons that were pressed at the newest reading: bit n for button n. By default none is reported.
    fn buttons(&self) -> u32 {
        0
    }
    /// Returns how many buttons [`HapticDevice::buttons`] can report, 0 to 32. By default 0.
    fn button_count(&self) -> u32 {
        0
    }
    /// Receives what a tick did, after its `write`, for displays. It must not wait. By default does nothing.
    fn ticked(&mut self, _tick: &Tick) {}
}

impl HapticDevice for Box<dyn HapticDevice> {
    fn descriptor(&self) -> Device {
        (**self).descriptor()
    }

    fn read(&mut self) -> std::io::Result<Reading> {
        (**self).read()
    }

    fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
        (**self).write(force_n)
    }

    fn orientation(&self) -> DQuat {
        (**self).orientation()
    }

    fn jaw_rad(&self) -> f64 {
        (**self).jaw_rad()
    }

    fn write_wrench(&mut self, wrench: Wrench) -> std::io::Result<()> {
        (**self).write_wrench(wrench)
    }

    fn buttons(&self) -> u32 {
        (**self).buttons()
    }

    fn button_count(&self) -> u32 {
        (**self).button_count()
    }

    fn ticked(&mut self, tick: &Tick) {
        (**self).ticked(tick);
    }
}
