//! A SpaceMouse or a gamepad, through the input events of Linux: velocity control of the position, and forces as
//! rumble, so that anybody can try touch.
//!
//! Forces are felt as rumble, if the device has that. Events are read from a path, so a pipe with recorded events works as
//! well.

use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read};
use std::os::unix::fs::{FileTypeExt, OpenOptionsExt};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use evdev::{AbsoluteAxisCode, FFEffect, FFEffectCode, FFEffectData, FFEffectKind, FFReplay, FFTrigger, KeyCode};
use glam::DVec3;
use palpate_haptics::Device;
use palpate_haptics::device::UNDECLARED;

use super::velocity_control::{VelocityControl, dead};
use crate::device::{HapticDevice, Reading};

/// Size of `struct input_event` in bytes: two words of time, then type, code and value.
const TIME_BYTES: usize = 2 * size_of::<usize>();
const EVENT_BYTES: usize = TIME_BYTES + 8;

// Of input-event-codes.h.
const EV_SYN: u16 = 0;
const EV_KEY: u16 = 1;
const EV_REL: u16 = 2;
const EV_ABS: u16 = 3;
const EV_MAX: u16 = 0x1f;
const SYN_DROPPED: u16 = 3;

/// Axes that are used: X, Y, Z, RX, RY, RZ, with equal numbers in EV_REL and EV_ABS.
const AXES: usize = 6;

/// Time without an event after which a relative axis counts as at rest: such devices do not report 0.
const RESTS: Duration = Duration::from_millis(100);

/// Minimum interval between changes of the rumble, and its duration if it is not renewed.
const RUMBLE_EVERY: Duration = Duration::from_millis(20);
const RUMBLE_MS: u16 = 100;

/// The meaning of a device's axes and buttons.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Map {
    /// A knob that is pushed and pulled; its axes point to the right, towards the operator, and down.
    SpaceMouse,
    /// The left stick moves along the tissue, the right one and the triggers up and down.
    Gamepad,
}

impl Map {
    fn name(self) -> &'static str {
        match self {
            Map::SpaceMouse => "spacemouse",
            Map::Gamepad => "gamepad",
        }
    }

    /// Returns the codes of the button that requests forces, and of the clutch.
    fn keys(self) -> [u16; 2] {
        match self {
            Map::SpaceMouse => [KeyCode::BTN_0.0, KeyCode::BTN_1.0],
            Map::Gamepad => [KeyCode::BTN_SOUTH.0, KeyCode::BTN_EAST.0],
        }
    }

    /// Returns the axes' ranges for devices that do not report them.
    fn ranges(self) -> [[f64; 2]; AXES] {
        match self {
            Map::SpaceMouse => [[-350.0, 350.0]; AXES],
            Map::Gamepad => {
                let (stick, trigger) = ([-32768.0, 32767.0], [0.0, 255.0]);
                [stick, stick, trigger, stick, stick, trigger]
            }
        }
    }

    /// Returns the velocity of the position, as a fraction of the largest, from the axes' values.
    fn velocity(self, values: &[f64; AXES], ranges: &[[f64; 2]; AXES]) -> DVec3 {
        let centred = |axis: usize| {
            let [least, most] = ranges[axis];
            dead((2.0 * values[axis] - least - most) / (most - least))
        };
        // Triggers rest at their smallest value.
        let pressed = |axis: usize| {
            let [least, most] = ranges[axis];
            dead((values[axis] - least) / (most - least))
        };
        let velocity = match self {
            Map::SpaceMouse => DVec3::new(centred(0), -centred(1), -centred(2)),
            Map::Gamepad => DVec3::new(centred(0), -centred(1), -centred(4) + pressed(2) - pressed(5)),
        };
        velocity.clamp_length_max(1.0)
    }

    fn is(self, device: &evdev::Device) -> bool {
        match self {
            Map::SpaceMouse => {
                let name = device.name().unwrap_or_default();
                let vendor = device.input_id().vendor();
                vendor == 0x256f
                    || ["3Dconnexion", "SpaceMouse", "SpaceNavigator", "SpacePilot"]
                        .iter()
                        .any(|part| name.contains(part))
            }
            Map::Gamepad => {
                let has_south = device.supported_keys().is_some_and(|keys| keys.contains(KeyCode::BTN_SOUTH));
                has_south && device.supported_absolute_axes().is_some_and(|axes| axes.contains(AbsoluteAxisCode::ABS_X))
            }
        }
    }
}

/// The state of a device's axes and buttons after the events so far.
#[derive(Debug)]
struct InputState {
    map: Map,
    ranges: [[f64; 2]; AXES],
    values: [f64; AXES],
    /// When a relative axis was last reported; `None` for an axis with absolute values.
    relative: [Option<Instant>; AXES],
    buttons: u32,
}

impl InputState {
    fn new(map: Map, ranges: [[f64; 2]; AXES]) -> Self {
        let mut told = InputState { map, ranges, values: [0.0; AXES], relative: [None; AXES], buttons: 0 };
        told.rest();
        told
    }

    /// Resets all axes to rest and releases all buttons.
    fn rest(&mut self) {
        let is_trigger = |axis: usize| self.map == Map::Gamepad && (axis == 2 || axis == 5);
        self.values = std::array::from_fn(|axis| {
            let [least, most] = self.ranges[axis];
            if is_trigger(axis) { least } else { 0.5 * (least + most) }
        });
        (self.relative, self.buttons) = ([None; AXES], 0);
    }

    /// Applies one event.
    ///
    /// # Errors
    /// Returns an error if it is not an input event.
    fn take(&mut self, event: &[u8; EVENT_BYTES], now: Instant) -> io::Result<()> {
        let [a, b, c, d, rest @ ..] = std::array::from_fn::<u8, 8, _>(|index| event[TIME_BYTES + index]);
        let (kind, code, value) = (u16::from_ne_bytes([a, b]), u16::from_ne_bytes([c, d]), i32::from_ne_bytes(rest));
        let axis = usize::from(code);
        match kind {
            // The kernel has dropped events: which buttons are held is not known any more.
            EV_SYN if code == SYN_DROPPED => self.rest(),
            EV_REL if axis < AXES => {
                (self.values[axis], self.relative[axis]) = (f64::from(value), Some(now));
                // The three axes of a report arrive together: one that is missing is at rest.
                let others = if axis < 3 { 0..3 } else { 3..AXES };
                for other in others.filter(|other| *other != axis) {
                    if self.relative[other].is_some_and(|told| now.duration_since(told) > RESTS / 4) {
                        self.values[other] = 0.0;
                    }
                }
            }
            EV_ABS if axis < AXES => self.values[axis] = f64::from(value),
            EV_KEY => {
                if let Some(bit) = self.map.keys().iter().position(|key| *key == code) {
                    self.buttons = self.buttons & !(1 << bit) | u32::from(value != 0) << bit;
                }
            }
            0..=EV_MAX => {}
            _ => {
                let message = format!("the data is not an event of an input device (type {kind})");
                return Err(io::Error::new(ErrorKind::InvalidData, message));
            }
        }
        Ok(())
    }

    fn velocity(&mut self, now: Instant) -> DVec3 {
        for (value, told) in self.values.iter_mut().zip(&self.relative) {
            if told.is_some_and(|told| now.duration_since(told) > RESTS) {
                *value = 0.0;
            }
        }
        self.map.velocity(&self.values, &self.ranges)
    }
}

/// The rumble of a gamepad.
struct Rumble {
    effect: FFEffect,
    /// The current magnitude, and since when it plays.
    played: u16,
    since: Option<Instant>,
}

fn effect(magnitude: u16) -> FFEffectData {
    FFEffectData {
        direction: 0,
        trigger: FFTrigger { button: 0, interval: 0 },
        replay: FFReplay { length: RUMBLE_MS, delay: 0 },
        kind: FFEffectKind::Rumble { strong_magnitude: magnitude, weak_magnitude: magnitude / 2 },
    }
}

impl Rumble {
    fn of(device: &mut evdev::Device) -> Option<Self> {
        let rumbles = device.supported_ff().is_some_and(|effects| effects.contains(FFEffectCode::FF_RUMBLE));
        let effect = rumbles.then(|| device.upload_ff_effect(effect(0)).ok()).flatten()?;
        Some(Rumble { effect, played: 0, since: None })
    }

    /// Plays a fraction of the largest rumble.
    fn play(&mut self, part: f64) {
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let magnitude = (part.clamp(0.0, 1.0) * f64::from(u16::MAX)) as u16;
        let is_due = self.since.is_none_or(|since| since.elapsed() >= RUMBLE_EVERY);
        if magnitude == 0 && self.played == 0 || !is_due && magnitude != 0 {
            return;
        }
        // A device that fails to rumble is noticed by its events.
        let _ = self.effect.update(effect(magnitude));
        let _ = if magnitude == 0 { self.effect.stop() } else { self.effect.play(1) };
        (self.played, self.since) = (magnitude, Some(Instant::now()));
    }
}

/// An open device.
pub(super) struct InputDevice {
    path: PathBuf,
    events: File,
    /// Bytes of an event that was read partly.
    part: Vec<u8>,
    has_told: bool,
    told: InputState,
    rumble: Option<Rumble>,
    control: VelocityControl,
}

impl InputDevice {
    /// Opens the events at a path, or those of the first device of that kind.
    ///
    /// # Errors
    /// Returns an error if there is no such device, or if it can't be opened.
    pub(super) fn open(map: Map, which: Option<&str>) -> io::Result<Self> {
        let path = match which {
            Some(path) => PathBuf::from(path),
            None => found(map).into_iter().next().map(|found| found.0).ok_or_else(|| none(map))?,
        };
        let refused = |error: io::Error| {
            let advice = match error.kind() {
                ErrorKind::PermissionDenied => ". Be in the group `input`, or let a rule of udev give you the device",
                _ => "",
            };
            io::Error::new(error.kind(), format!("{}: {error}{advice}", path.display()))
        };
        // Opening must not wait for a program that writes to a pipe; reading never waits.
        const NONBLOCK: i32 = 0o4000;
        let events = OpenOptions::new().read(true).custom_flags(NONBLOCK).open(&path).map_err(refused)?;
        let kind = events.metadata().map_err(refused)?.file_type();
        let mut ranges = map.ranges();
        let mut rumble = None;
        if kind.is_char_device() {
            let mut device = evdev::Device::open(&path).map_err(refused)?;
            for (code, info) in device.get_absinfo().map_err(refused)? {
                if let Some(range) = ranges.get_mut(usize::from(code.0)).filter(|_| info.maximum() > info.minimum()) {
                    *range = [f64::from(info.minimum()), f64::from(info.maximum())];
                }
            }
            rumble = Rumble::of(&mut device);
        } else if !kind.is_fifo() {
            let message = format!("{}: is neither an input device nor a pipe", path.display());
            return Err(io::Error::new(ErrorKind::InvalidInput, message));
        }
        let told = InputState::new(map, ranges);
        let control = VelocityControl::default();
        Ok(InputDevice { path, events, part: Vec::new(), has_told: false, told, rumble, control })
    }

    /// Reads the events that have arrived, without waiting.
    fn take(&mut self, now: Instant) -> io::Result<()> {
        let named =
            |path: &PathBuf, error: io::Error| io::Error::new(error.kind(), format!("{}: {error}", path.display()));
        let mut bytes = [0; 64 * EVENT_BYTES];
        loop {
            match self.events.read(&mut bytes) {
                // No program has opened the pipe yet.
                Ok(0) if !self.has_told => return Ok(()),
                Ok(0) => {
                    let ended = io::Error::new(ErrorKind::NotConnected, "no more events: it was unplugged");
                    return Err(named(&self.path, ended));
                }
                Ok(count) => {
                    self.has_told = true;
                    self.part.extend_from_slice(&bytes[..count]);
                    let whole = self.part.len() / EVENT_BYTES * EVENT_BYTES;
                    for event in self.part[..whole].as_chunks::<EVENT_BYTES>().0 {
                        self.told.take(event, now).map_err(|error| named(&self.path, error))?;
                    }
                    self.part.drain(..whole);
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => return Ok(()),
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(named(&self.path, error)),
            }
        }
    }
}

impl HapticDevice for InputDevice {
    fn descriptor(&self) -> Device {
        UNDECLARED
    }

    fn read(&mut self) -> io::Result<Reading> {
        let now = Instant::now();
        self.take(now)?;
        let place_m = self.control.advance(now, self.told.velocity(now));
        Ok(Reading { place_m, enable: self.told.buttons & 1 != 0 })
    }

    fn write(&mut self, force_n: DVec3) -> io::Result<()> {
        self.control.set_force(force_n);
        if let Some(rumble) = &mut self.rumble {
            rumble.play(force_n.length() / UNDECLARED.most_n());
        }
        Ok(())
    }

    fn buttons(&self) -> u32 {
        self.told.buttons
    }

    fn button_count(&self) -> u32 {
        2
    }
}

/// Returns the error that explains why there is no device of that kind.
fn none(map: Map) -> io::Error {
    let all = std::fs::read_dir("/dev/input").map_or(0, |entries| {
        entries.flatten().filter(|entry| entry.file_name().to_string_lossy().starts_with("event")).count()
    });
    let open = evdev::enumerate().count();
    let mut message = format!("no {} among {open} input devices", map.name());
    if all > open {
        message += &format!(
            "; {} more can't be opened: be in the group `input`, or let a rule of udev give them to you",
            all - open
        );
    }
    io::Error::new(ErrorKind::NotFound, message)
}

/// Returns path and name of the devices of that kind.
fn found(map: Map) -> Vec<(PathBuf, String)> {
    let devices = evdev::enumerate().filter(|(_, device)| map.is(device));
    let mut found: Vec<_> =
        devices.map(|(path, device)| (path, device.name().unwrap_or("without a name").to_owned())).collect();
    found.sort();
    found
}

/// Returns the devices of both kinds: their names for `open`, whether they are there, and a description.
pub(super) fn list() -> Vec<(String, bool, String)> {
    let of = |map: Map| {
        let found = found(map);
        if found.is_empty() {
            return vec![(map.name().to_owned(), false, none(map).to_string())];
        }
        found.into_iter().map(|(path, about)| (format!("{}:{}", map.name(), path.display()), true, about)).collect()
    };
    [Map::SpaceMouse, Map::Gamepad].into_iter().flat_map(of).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;

    fn event(kind: u16, code: u16, value: i32) -> [u8; EVENT_BYTES] {
        let mut event = [0; EVENT_BYTES];
        event[TIME_BYTES..TIME_BYTES + 2].copy_from_slice(&kind.to_ne_bytes());
        event[TIME_BYTES + 2..TIME_BYTES + 4].copy_from_slice(&code.to_ne_bytes());
        event[TIME_BYTES + 4..].copy_from_slice(&value.to_ne_bytes());
        event
    }

    #[test]
    fn axes_point_the_same_way_for_both_and_rest_without_a_word() {
        let now = Instant::now();
        let later = now + RESTS + Duration::from_millis(1);
        // Pushed to the right, away and down.
        let mut mouse = InputState::new(Map::SpaceMouse, Map::SpaceMouse.ranges());
        for (code, value) in [(0, 200), (1, -200), (2, 200)] {
            mouse.take(&event(EV_REL, code, value), now).unwrap();
        }
        let mut pad = InputState::new(Map::Gamepad, Map::Gamepad.ranges());
        assert_eq!(pad.velocity(now), DVec3::ZERO);
        for (code, value) in [(0, 20000), (1, -20000), (4, 20000)] {
            pad.take(&event(EV_ABS, code, value), now).unwrap();
        }
        for told in [&mut mouse, &mut pad] {
            let velocity = told.velocity(now);
            assert!(velocity.x > 0.3 && velocity.y > 0.3 && velocity.z < -0.3, "{velocity}");
        }
        assert_eq!(mouse.velocity(later), DVec3::ZERO);
        // A stick stays where it was last reported.
        assert!(pad.velocity(later).x > 0.3);
        // The right trigger goes down.
        let mut pad = InputState::new(Map::Gamepad, Map::Gamepad.ranges());
        pad.take(&event(EV_ABS, 5, 255), now).unwrap();
        assert_eq!(pad.velocity(now), -DVec3::Z);
    }

    #[test]
    fn buttons_go_to_their_bits_and_dropped_events_let_all_go() {
        let now = Instant::now();
        let mut told = InputState::new(Map::Gamepad, Map::Gamepad.ranges());
        told.take(&event(EV_KEY, KeyCode::BTN_EAST.0, 1), now).unwrap();
        told.take(&event(EV_KEY, KeyCode::BTN_NORTH.0, 1), now).unwrap();
        assert_eq!(told.buttons, 2);
        told.take(&event(EV_KEY, KeyCode::BTN_SOUTH.0, 1), now).unwrap();
        told.take(&event(EV_KEY, KeyCode::BTN_EAST.0, 0), now).unwrap();
        assert_eq!(told.buttons, 1);
        told.take(&event(EV_SYN, SYN_DROPPED, 0), now).unwrap();
        assert_eq!(told.buttons, 0);
        assert!(told.take(&[0xa5; EVENT_BYTES], now).is_err());
    }
}
