//! Devices of several makers, found and loaded at run time: building this library needs no maker's SDK.
//!
//! [`open`] opens a device by its name, for [`crate::bridge::run`]. [`list`] returns the devices that are there, and
//! [`check()`] measures the timing of one. [`Placed`] places the workspace of any device over the tissue.
//!
//! | name | what it is | how it is reached |
//! |---|---|---|
//! | `force-dimension` | omega, delta, sigma, lambda, Falcon | `libdhd` of the Force Dimension SDK |
//! | `openhaptics` | 3D Systems Touch, Omni, Desktop | `libHD` of OpenHaptics |
//! | `haply` | Inverse3 | Haply's Inverse Service, by WebSocket |
//! | `spacemouse`, `gamepad` | position by rate, force by rumble | events of Linux; elsewhere HID, and the system's gamepads |
//!
//! A name may be followed by `:` and which one: the number of a Force Dimension device, the name of an OpenHaptics
//! configuration, the address of Haply's service, the path of events or of a HID, the number of a gamepad.

mod check;
mod force_dimension;
#[cfg(not(target_os = "linux"))]
mod gamepad;
mod haply;
#[cfg(not(target_os = "linux"))]
mod hid_space_mouse;
#[cfg(target_os = "linux")]
mod input;
mod loaded;
mod open_haptics;
mod placement;
#[cfg(any(test, not(target_os = "linux")))]
mod space_mouse_report;
mod velocity_control;

use std::path::Path;

use crate::Error;
use crate::device::HapticDevice;

pub use check::{DeviceReport, check};
pub use placement::{ENGAGED_N, Enables, Placed, Placement};

/// A kind of device, by the library or service that connects it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeviceKind {
    /// Devices of Force Dimension, by `libdhd`.
    ForceDimension,
    /// Devices of 3D Systems, by `libHD` of OpenHaptics.
    OpenHaptics,
    /// Haply's Inverse3, by Haply's service.
    Haply,
    /// A 3D mouse, by input events of Linux, elsewhere as a HID.
    SpaceMouse,
    /// A gamepad, by input events of Linux, elsewhere by the system's gamepads.
    Gamepad,
}

impl DeviceKind {
    /// All kinds, with their names for [`open`].
    pub const ALL: [(DeviceKind, &'static str); 5] = [
        (DeviceKind::ForceDimension, "force-dimension"),
        (DeviceKind::OpenHaptics, "openhaptics"),
        (DeviceKind::Haply, "haply"),
        (DeviceKind::SpaceMouse, "spacemouse"),
        (DeviceKind::Gamepad, "gamepad"),
    ];

    /// Returns the kind that is named before the first `:` of `name`, and the text after it, which may be empty
    /// (`None` without a `:`). Returns `None` if there is no such kind.
    pub fn of(name: &str) -> Option<(DeviceKind, Option<&str>)> {
        let (kind, which) = name.split_once(':').map_or((name, None), |(kind, which)| (kind, Some(which)));
        DeviceKind::ALL.iter().find(|entry| entry.1 == kind).map(|entry| (entry.0, which))
    }
}

/// Opens a device by its name: a kind, or `KIND:WHICH`; without `:WHICH`, the first device of that kind. `library` is
/// the path of the maker's library, if the system does not find it; only `force-dimension` and `openhaptics` use it.
/// May wait some seconds for Haply's service. The device's force is zero until the first [`HapticDevice::write`].
///
/// # Errors
/// Returns [`Error::Argument`] if there is no such kind of device, and [`Error::Device`] with advice if `WHICH` is not
/// valid for the kind, if the library, the service or the device is missing, can't be opened or has an unsupported
/// version, or if the system does not support the kind.
pub fn open(name: &str, library: Option<&Path>) -> Result<Box<dyn HapticDevice>, Error> {
    let Some((kind, which)) = DeviceKind::of(name) else {
        let names: Vec<&str> = DeviceKind::ALL.iter().map(|entry| entry.1).collect();
        return Err(Error::Argument(format!("no device `{name}`: known are {}", names.join(", "))));
    };
    Ok(match kind {
        DeviceKind::ForceDimension => Box::new(force_dimension::ForceDimension::open(which, library)?),
        DeviceKind::OpenHaptics => Box::new(open_haptics::OpenHaptics::open(which, library)?),
        DeviceKind::Haply => Box::new(haply::Inverse3::open(which)?),
        #[cfg(target_os = "linux")]
        DeviceKind::SpaceMouse => Box::new(input::InputDevice::open(input::Map::SpaceMouse, which)?),
        #[cfg(target_os = "linux")]
        DeviceKind::Gamepad => Box::new(input::InputDevice::open(input::Map::Gamepad, which)?),
        #[cfg(not(target_os = "linux"))]
        DeviceKind::SpaceMouse => Box::new(hid_space_mouse::SpaceMouse::open(which)?),
        #[cfg(not(target_os = "linux"))]
        DeviceKind::Gamepad => Box::new(gamepad::Gamepad::open(which)?),
    })
}

/// A device, or a kind of device, that [`list`] looked for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    /// The name to pass to [`open`]: for a SpaceMouse or a gamepad with the path of its events, otherwise only the
    /// kind.
    pub name: String,
    /// Whether it can be tried: the library or service answers, and does not report that there is no device.
    pub is_there: bool,
    /// A description for people: version and model, or what is missing and what to do.
    pub about: String,
}

/// Looks for devices of all kinds, in the order of [`DeviceKind::ALL`], and returns at least one entry for each kind
/// that the system supports; [`Found::is_there`] is false if there is none. Opens no device. `library` is tried as the
/// library of each kind that needs one. May wait some seconds for Haply's service.
pub fn list(library: Option<&Path>) -> Vec<Found> {
    let told = |name: &str, told: std::io::Result<(bool, String)>| {
        let (is_there, about) = told.unwrap_or_else(|error| (false, error.to_string()));
        Found { name: name.to_owned(), is_there, about }
    };
    let found = [
        told("force-dimension", force_dimension::tell(library)),
        told("openhaptics", open_haptics::tell(library)),
        told("haply", haply::tell()),
    ];
    #[cfg(target_os = "linux")]
    let inputs = input::list();
    #[cfg(not(target_os = "linux"))]
    let inputs = hid_space_mouse::list().into_iter().chain(gamepad::list());
    let inputs = inputs.into_iter().map(|(name, is_there, about)| Found { name, is_there, about });
    found.into_iter().chain(inputs).collect()
}
