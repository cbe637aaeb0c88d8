//! Devices of Force Dimension, and the Falcon, through `libdhd` of the SDK (version 3).
//!
//! The base's frame has x towards the operator, y to the right and z up, in metres and newtons; its origin is the
//! middle of the workspace. A call returns a negative number when it failed. 1 (the time guard: the value is the
//! previous one) and 2 (a motor is at its limit) are not failures. Every call names the device: without it the SDK
//! uses the one used last.

// Functions of a C library.
#![allow(unsafe_code)]

use std::ffi::{c_char, c_int, c_uchar};
use std::io;
use std::path::Path;

use glam::{DMat3, DQuat, DVec3};
use palpate_haptics::device::UNDECLARED;
use palpate_haptics::instrument_pose::MAX_JAW_RAD;
use palpate_haptics::{Device, Wrench};

use super::loaded::{Loaded, text_of};
use crate::device::{HapticDevice, Reading};

#[cfg(windows)]
const NAMES: [&str; 1] = ["dhd64.dll"];
#[cfg(target_os = "macos")]
const NAMES: [&str; 2] = ["libdhd.3.dylib", "libdhd.dylib"];
#[cfg(not(any(windows, target_os = "macos")))]
const NAMES: [&str; 2] = ["libdhd.so.3", "libdhd.so"];

/// The supported version of the SDK.
const MAJOR: c_int = 3;

/// `DHD_ON`, `DHD_OFF`.
const ON: c_uchar = 1;
const OFF: c_uchar = 0;

/// Numbers of systems in `dhdc.h`, and the device in our table that each is.
const SYSTEMS: [(c_int, &str); 14] = [
    (33, "omega3"),
    (34, "omega3"),
    (35, "omega3"),
    (36, "omega3"),
    (37, "omega3"),
    (60, "falcon"),
    (63, "delta3"),
    (64, "delta3"),
    (104, "sigma7"),
    (105, "sigma7"),
    (106, "sigma7"),
    (107, "sigma7"),
    (108, "lambda7"),
    (109, "lambda7"),
];

/// Number of buttons read at each tick.
const BUTTONS: c_int = 2;

type ByDevice = unsafe extern "system" fn(c_char) -> c_int;
type Text = unsafe extern "system" fn(c_char) -> *const c_char;
type Get3 = unsafe extern "system" fn(*mut f64, *mut f64, *mut f64, c_char) -> c_int;
type Set3 = unsafe extern "system" fn(f64, f64, f64, c_char) -> c_int;
type Set6 = unsafe extern "system" fn(f64, f64, f64, f64, f64, f64, c_char) -> c_int;

/// The handle's axes as those of an instrument: that points away from the operator, which is the handle's −x, with z up.
const HANDLE: DMat3 = DMat3::from_cols(DVec3::NEG_X, DVec3::NEG_Y, DVec3::Z);

/// The functions of the SDK that are used.
#[derive(Debug, Clone, Copy)]
struct LibraryCalls {
    count: unsafe extern "system" fn() -> c_int,
    open: unsafe extern "system" fn() -> c_int,
    open_id: ByDevice,
    close: ByDevice,
    enable_force: unsafe extern "system" fn(c_uchar, c_char) -> c_int,
    system_type: ByDevice,
    system_name: Text,
    position: Get3,
    button: unsafe extern "system" fn(c_int, c_char) -> c_int,
    set_force: Set3,
    /// By rows: the handle's axes in the base's frame are its columns.
    orientation: Option<unsafe extern "system" fn(*mut [[f64; 3]; 3], c_char) -> c_int>,
    gripper: Option<unsafe extern "system" fn(*mut f64, c_char) -> c_int>,
    set_wrench: Option<Set6>,
    last_error: unsafe extern "system" fn() -> *const c_char,
    /// Since SDK 3.9.
    get_most: Option<unsafe extern "system" fn(c_char) -> f64>,
    set_most: Option<unsafe extern "system" fn(f64, c_char) -> c_int>,
    version: Option<unsafe extern "system" fn(*mut c_int, *mut c_int, *mut c_int, *mut c_int)>,
}

impl LibraryCalls {
    fn load(library: Option<&Path>) -> io::Result<(Self, Loaded)> {
        let loaded = Loaded::find(library, &NAMES, "libdhd", "Install the Force Dimension SDK")?;
        // SAFETY: the types are those of dhdc.h.
        let calls = unsafe {
            LibraryCalls {
                count: loaded.function("dhdGetDeviceCount")?,
                open: loaded.function("dhdOpen")?,
                open_id: loaded.function("dhdOpenID")?,
                close: loaded.function("dhdClose")?,
                enable_force: loaded.function("dhdEnableForce")?,
                system_type: loaded.function("dhdGetSystemType")?,
                system_name: loaded.function("dhdGetSystemName")?,
                position: loaded.function("dhdGetPosition")?,
                button: loaded.function("dhdGetButton")?,
                set_force: loaded.function("dhdSetForce")?,
                orientation: loaded.optional("dhdGetOrientationFrame"),
                gripper: loaded.optional("dhdGetGripperAngleRad"),
                set_wrench: loaded.optional("dhdSetForceAndTorque"),
                last_error: loaded.function("dhdErrorGetLastStr")?,
                get_most: loaded.optional("dhdGetMaxForce"),
                set_most: loaded.optional("dhdSetMaxForce"),
                version: loaded.optional("dhdGetSDKVersion"),
            }
        };
        Ok((calls, loaded))
    }

    /// Returns the SDK's version, if it reports one. Refuses versions other than [`MAJOR`].
    fn version(&self, loaded: &Loaded) -> io::Result<String> {
        let Some(version) = self.version else { return Ok("of an unknown version".to_owned()) };
        let (mut major, mut minor, mut release, mut revision) = (0, 0, 0, 0);
        // SAFETY: four numbers that live during the call.
        unsafe { version(&raw mut major, &raw mut minor, &raw mut release, &raw mut revision) };
        let text = format!("{major}.{minor}.{release}");
        if major != MAJOR {
            let message = format!("{} is of SDK {text}: Palpate knows SDK {MAJOR}", loaded.name());
            return Err(io::Error::new(io::ErrorKind::Unsupported, message));
        }
        Ok(text)
    }

    /// Returns the SDK's description of its last error.
    fn last(&self) -> String {
        // SAFETY: the SDK's texts are constants.
        unsafe { text_of((self.last_error)()) }.unwrap_or_else(|| "no reason given".to_owned())
    }
}

/// An open device.
#[derive(Debug)]
pub(super) struct ForceDimension {
    calls: LibraryCalls,
    id: c_char,
    model: String,
    descriptor: Device,
    buttons: u32,
    orientation: DQuat,
    jaw_rad: f64,
}

/// Converts a vector of the base's frame to the device's, and back.
fn of_device(base: DVec3) -> DVec3 {
    DVec3::new(base.y, -base.x, base.z)
}

fn of_base(device: DVec3) -> DVec3 {
    DVec3::new(-device.y, device.x, device.z)
}

impl ForceDimension {
    /// Opens the device with that number, or the first one.
    ///
    /// # Errors
    /// Returns an error if the library or the device is missing, or the library has another version.
    pub(super) fn open(which: Option<&str>, library: Option<&Path>) -> io::Result<Self> {
        let number = which.map(|text| {
            text.parse::<c_char>().ok().filter(|number| *number >= 0).ok_or_else(|| {
                io::Error::new(
                    io::ErrorKind::InvalidInput,
                    format!("force-dimension:{text}: which one is a number, 0 to 127"),
                )
            })
        });
        let number = number.transpose()?;
        let (calls, loaded) = LibraryCalls::load(library)?;
        calls.version(&loaded)?;
        // SAFETY: these functions take a number, or nothing.
        let opened = unsafe { number.map_or_else(|| (calls.open)(), |number| (calls.open_id)(number)) };
        let id = c_char::try_from(opened).ok().filter(|id| *id >= 0).ok_or_else(|| {
            let message = format!(
                "no Force Dimension device: {}. Is it on, is it plugged in, may you open it, and does no other program have it?",
                calls.last()
            );
            io::Error::new(io::ErrorKind::NotFound, message)
        })?;
        // SAFETY: the device is open.
        let (system, model) = unsafe { ((calls.system_type)(id), text_of((calls.system_name)(id))) };
        let known = SYSTEMS.iter().find(|entry| entry.0 == system).and_then(|entry| Device::named(entry.1));
        let mut descriptor = known.unwrap_or(UNDECLARED);
        // SAFETY: as above. A negative number means that there is no limit.
        let told_n =
            calls.get_most.map(|most| unsafe { most(id) }).filter(|most_n| most_n.is_finite() && *most_n > 0.0);
        if let Some(most_n) = told_n {
            descriptor.force_n = descriptor.force_n.min(most_n);
            descriptor.continuous_n = descriptor.continuous_n.min(most_n);
        }
        if calls.set_wrench.is_none() || calls.orientation.is_none() {
            descriptor.torque_n_m = 0.0;
        }
        let model = model.unwrap_or_else(|| format!("system {system}"));
        let (orientation, jaw_rad) = (DQuat::IDENTITY, 0.0);
        let mut device = ForceDimension { calls, id, model, descriptor, buttons: 0, orientation, jaw_rad };
        // A second limit, in the SDK, in addition to our envelope.
        // SAFETY: as above.
        calls.set_most.map(|set| unsafe { set(descriptor.most_n(), id) });
        // From here on, dropping the device sets its force to zero and closes it.
        // SAFETY: as above.
        device.hold(unsafe { (calls.enable_force)(ON, id) }, "its forces can't be enabled")?;
        device.write(DVec3::ZERO)?;
        Ok(device)
    }

    /// Reads orientation and gripper. A device without them keeps the neutral ones.
    ///
    /// # Errors
    /// Returns an error if a device that renders torque does not tell its orientation.
    fn read_handle(&mut self) -> io::Result<()> {
        let mut rows = [[0.0; 3]; 3];
        // SAFETY: room for nine numbers that live during the call, and the device is open.
        let told = self.calls.orientation.map(|get| unsafe { get(&raw mut rows, self.id) });
        let handle = DMat3::from_cols_array_2d(&rows).transpose() * HANDLE;
        let axes = [handle.x_axis, handle.y_axis, handle.z_axis].map(of_device);
        let is_rotation = (handle.determinant() - 1.0).abs() < 1e-3;
        if self.descriptor.torque_n_m > 0.0 {
            self.hold(told.filter(|_| is_rotation).unwrap_or(-1), "its orientation can't be read")?;
        }
        if told.is_some_and(|told| told >= 0) && is_rotation {
            self.orientation = DQuat::from_mat3(&DMat3::from_cols(axes[0], axes[1], axes[2])).normalize();
        }
        let mut angle_rad = 0.0;
        // SAFETY: a number that lives during the call, and the device is open.
        let told = self.calls.gripper.map(|get| unsafe { get(&raw mut angle_rad, self.id) });
        if told.is_some_and(|told| told >= 0) && angle_rad.is_finite() {
            // Grippers for the left hand tell negative angles.
            self.jaw_rad = angle_rad.abs().min(MAX_JAW_RAD);
        }
        Ok(())
    }

    /// Returns an error if a call failed.
    fn hold(&self, returned: c_int, what: &str) -> io::Result<()> {
        if returned >= 0 {
            return Ok(());
        }
        let message = format!("{} (device {} of the SDK): {what}: {}", self.model, self.id, self.calls.last());
        Err(io::Error::new(io::ErrorKind::NotConnected, message))
    }
}

impl HapticDevice for ForceDimension {
    fn descriptor(&self) -> Device {
        self.descriptor
    }

    fn read(&mut self) -> io::Result<Reading> {
        let (mut x, mut y, mut z) = (0.0, 0.0, 0.0);
        // SAFETY: three numbers that live during the call, and the device is open.
        let returned = unsafe { (self.calls.position)(&raw mut x, &raw mut y, &raw mut z, self.id) };
        self.hold(returned, "its position can't be read")?;
        // A device without that button returns an error, which counts as not pressed.
        // SAFETY: as above.
        let pressed = |index| unsafe { (self.calls.button)(index, self.id) } == 1;
        self.buttons = (0..BUTTONS).filter(|index| pressed(*index)).map(|index| 1 << index).sum();
        self.read_handle()?;
        Ok(Reading { place_m: of_device(DVec3::new(x, y, z)), enable: self.buttons & 1 != 0 })
    }

    fn write(&mut self, force_n: DVec3) -> io::Result<()> {
        let DVec3 { x, y, z } = of_base(force_n);
        // SAFETY: the device is open.
        let returned = unsafe { (self.calls.set_force)(x, y, z, self.id) };
        self.hold(returned, "its force can't be set")
    }

    fn orientation(&self) -> DQuat {
        self.orientation
    }

    fn jaw_rad(&self) -> f64 {
        self.jaw_rad
    }

    fn write_wrench(&mut self, wrench: Wrench) -> io::Result<()> {
        let Some(set) = self.calls.set_wrench.filter(|_| self.descriptor.torque_n_m > 0.0) else {
            return self.write(wrench.force_n);
        };
        let (force_n, torque_n_m) = (of_base(wrench.force_n), of_base(wrench.torque_n_m));
        // SAFETY: the device is open.
        let returned =
            unsafe { set(force_n.x, force_n.y, force_n.z, torque_n_m.x, torque_n_m.y, torque_n_m.z, self.id) };
        self.hold(returned, "its force and torque can't be set")
    }

    fn buttons(&self) -> u32 {
        self.buttons
    }

    fn button_count(&self) -> u32 {
        BUTTONS.unsigned_abs()
    }
}

impl Drop for ForceDimension {
    fn drop(&mut self) {
        let LibraryCalls { set_force, set_wrench, enable_force, close, .. } = self.calls;
        // SAFETY: the device is open, and nothing uses it after this.
        unsafe {
            match set_wrench.filter(|_| self.descriptor.torque_n_m > 0.0) {
                Some(set) => set(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, self.id),
                None => set_force(0.0, 0.0, 0.0, self.id),
            };
            enable_force(OFF, self.id);
            close(self.id);
        }
    }
}

/// Returns whether there are devices, and a description.
///
/// # Errors
/// Returns an error if the library is missing or has another version.
pub(super) fn tell(library: Option<&Path>) -> io::Result<(bool, String)> {
    let (calls, loaded) = LibraryCalls::load(library)?;
    let version = calls.version(&loaded)?;
    // SAFETY: a function without arguments.
    let count = unsafe { (calls.count)() };
    Ok((count > 0, format!("{} {version}: {} devices", loaded.name(), count.max(0))))
}
