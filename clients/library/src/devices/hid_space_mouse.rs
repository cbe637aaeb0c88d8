//! A SpaceMouse on Windows and macOS, as a human interface device (HID): velocity control of the position.

use std::io;
use std::time::Instant;

use glam::DVec3;
use hidapi::{DeviceInfo, HidApi, HidDevice, HidError};
use palpate_haptics::Device;
use palpate_haptics::device::UNDECLARED;

use super::space_mouse_report::{Reported, is_space_mouse};
use super::velocity_control::VelocityControl;
use crate::device::{HapticDevice, Reading};

/// An open SpaceMouse.
pub(super) struct SpaceMouse {
    device: HidDevice,
    reported: Reported,
    control: VelocityControl,
}

fn failed(error: HidError) -> io::Error {
    io::Error::other(error.to_string())
}

/// Returns the devices that are connected.
fn connected(api: &HidApi) -> impl Iterator<Item = &DeviceInfo> {
    api.device_list().filter(|found| is_space_mouse(found.vendor_id(), found.product_string().unwrap_or("")))
}

impl SpaceMouse {
    /// Opens the device at a path of the system, or the first one.
    ///
    /// # Errors
    /// Returns an error if there is no such device, or if it can't be opened.
    pub(super) fn open(which: Option<&str>) -> io::Result<Self> {
        let api = HidApi::new().map_err(failed)?;
        let found = connected(&api).find(|found| which.is_none_or(|which| found.path().to_string_lossy() == which));
        let none = || io::Error::new(io::ErrorKind::NotFound, "no such spacemouse is connected");
        let device = found.ok_or_else(none)?.open_device(&api).map_err(failed)?;
        device.set_blocking_mode(false).map_err(failed)?;
        Ok(SpaceMouse { device, reported: Reported::default(), control: VelocityControl::default() })
    }
}

impl HapticDevice for SpaceMouse {
    fn descriptor(&self) -> Device {
        UNDECLARED
    }

    fn read(&mut self) -> io::Result<Reading> {
        let mut report = [0; 64];
        loop {
            match self.device.read(&mut report).map_err(failed)? {
                0 => break,
                length => self.reported.take(&report[..length]),
            }
        }
        let place_m = self.control.advance(Instant::now(), self.reported.velocity());
        Ok(Reading { place_m, enable: self.reported.buttons & 1 != 0 })
    }

    fn write(&mut self, force_n: DVec3) -> io::Result<()> {
        self.control.set_force(force_n);
        Ok(())
    }

    fn buttons(&self) -> u32 {
        self.reported.buttons
    }

    fn button_count(&self) -> u32 {
        2
    }
}

/// Returns the devices: their names for [`super::open`], whether they are there, and a description.
pub(super) fn list() -> Vec<(String, bool, String)> {
    let none = |about: String| vec![("spacemouse".to_owned(), false, about)];
    let api = match HidApi::new() {
        Ok(api) => api,
        Err(error) => return none(error.to_string()),
    };
    let found: Vec<_> = connected(&api)
        .map(|found| {
            let name = format!("spacemouse:{}", found.path().to_string_lossy());
            (name, true, found.product_string().unwrap_or("without a name").to_owned())
        })
        .collect();
    if found.is_empty() { none("no spacemouse is connected".to_owned()) } else { found }
}
