//! A gamepad on Windows and macOS, through gilrs: velocity control of the position, and forces as rumble.

use std::io;
use std::time::{Duration, Instant};

use gilrs::ff::{BaseEffect, BaseEffectType, Effect, EffectBuilder};
use gilrs::{Axis, Button, GamepadId, Gilrs};
use glam::DVec3;
use palpate_haptics::Device;
use palpate_haptics::device::UNDECLARED;

use super::velocity_control::{VelocityControl, dead};
use crate::device::{HapticDevice, Reading};

/// Minimum interval between changes of the rumble.
const RUMBLE_EVERY: Duration = Duration::from_millis(20);

/// An open gamepad.
pub(super) struct Gamepad {
    pads: Gilrs,
    id: GamepadId,
    control: VelocityControl,
    buttons: u32,
    /// `None` for a gamepad without rumble.
    rumble: Option<Effect>,
    rumbled: Option<Instant>,
}

fn failed(error: impl std::fmt::Display) -> io::Error {
    io::Error::other(error.to_string())
}

fn rumble(pads: &mut Gilrs, id: GamepadId) -> Option<Effect> {
    if !pads.connected_gamepad(id)?.is_ff_supported() {
        return None;
    }
    let strong = BaseEffect { kind: BaseEffectType::Strong { magnitude: u16::MAX }, ..Default::default() };
    let effect = EffectBuilder::new().add_effect(strong).gamepads(&[id]).gain(0.0).finish(pads).ok()?;
    effect.play().ok()?;
    Some(effect)
}

impl Gamepad {
    /// Opens the gamepad with a number, which [`list`] shows after `gamepad:`, or the first one.
    ///
    /// # Errors
    /// Returns an error if there is no such gamepad, or if the system's gamepads can't be used.
    pub(super) fn open(which: Option<&str>) -> io::Result<Self> {
        let mut pads = Gilrs::new().map_err(failed)?;
        let found = pads.gamepads().map(|(id, _)| id).find(|id| which.is_none_or(|which| id.to_string() == which));
        let id = found.ok_or_else(|| io::Error::new(io::ErrorKind::NotFound, "no such gamepad is connected"))?;
        let rumble = rumble(&mut pads, id);
        Ok(Gamepad { pads, id, control: VelocityControl::default(), buttons: 0, rumble, rumbled: None })
    }
}

impl HapticDevice for Gamepad {
    fn descriptor(&self) -> Device {
        UNDECLARED
    }

    fn read(&mut self) -> io::Result<Reading> {
        // Events update the states of axes and buttons.
        while self.pads.next_event().is_some() {}
        let Some(pad) = self.pads.connected_gamepad(self.id) else {
            return Err(io::Error::new(io::ErrorKind::NotConnected, "the gamepad was unplugged"));
        };
        let axis = |axis: Axis| dead(f64::from(pad.value(axis)));
        let pressed = |button: Button| dead(pad.button_data(button).map_or(0.0, |data| f64::from(data.value())));
        // The left stick moves along the tissue, the right one and the triggers up and down.
        let up = axis(Axis::RightStickY) + pressed(Button::LeftTrigger2) - pressed(Button::RightTrigger2);
        let velocity = DVec3::new(axis(Axis::LeftStickX), axis(Axis::LeftStickY), up).clamp_length_max(1.0);
        self.buttons = u32::from(pad.is_pressed(Button::South)) | u32::from(pad.is_pressed(Button::East)) << 1;
        let place_m = self.control.advance(Instant::now(), velocity);
        Ok(Reading { place_m, enable: self.buttons & 1 != 0 })
    }

    #[allow(clippy::cast_possible_truncation)]
    fn write(&mut self, force_n: DVec3) -> io::Result<()> {
        self.control.set_force(force_n);
        if let Some(rumble) = &self.rumble
            && self.rumbled.is_none_or(|before| before.elapsed() >= RUMBLE_EVERY)
        {
            // Errors are ignored here: `read` reports a gamepad that was unplugged.
            let _ = rumble.set_gain((force_n.length() / UNDECLARED.most_n()).clamp(0.0, 1.0) as f32);
            self.rumbled = Some(Instant::now());
        }
        Ok(())
    }

    fn buttons(&self) -> u32 {
        self.buttons
    }

    fn button_count(&self) -> u32 {
        2
    }
}

/// Returns the gamepads: their names for [`super::open`], whether they are there, and a description.
pub(super) fn list() -> Vec<(String, bool, String)> {
    let none = |about: String| vec![("gamepad".to_owned(), false, about)];
    match Gilrs::new() {
        Err(error) => none(error.to_string()),
        Ok(pads) => {
            let found: Vec<_> =
                pads.gamepads().map(|(id, pad)| (format!("gamepad:{id}"), true, pad.name().to_owned())).collect();
            if found.is_empty() { none("no gamepad is connected".to_owned()) } else { found }
        }
    }
}
