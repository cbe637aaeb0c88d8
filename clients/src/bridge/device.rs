//! What a bridge needs of a haptic device, and devices that are simulated.
//!
//! # An adapter for a real one
//!
//! Implement [`HapticDevice`] over the maker's library, and hand it to [`super::serve`]: the bridge does the rest, at
//! 1 kHz, on a thread of its own. Places are in metres in the device's frame, forces in newtons on the hand; whatever
//! else the library speaks (OpenHaptics mm, joints in degrees) is turned into that here and nowhere else.
//!
//! - OpenHaptics: `read` is `hdBeginFrame`, `hdGetDoublev(HD_CURRENT_POSITION)`·1e-3, `HD_CURRENT_BUTTONS`; `write` is
//!   `hdSetDoublev(HD_CURRENT_FORCE)`, `hdEndFrame`; `descriptor` is `HD_NOMINAL_MAX_FORCE`, `HD_NOMINAL_MAX_STIFFNESS`.
//! - Force Dimension: `dhdGetPosition`, `dhdGetButton`; `dhdSetForce`. Leave `dhdEnableExpertMode` alone.
//! - Haply Inverse3: the newest `cursor_position` of its stream; `set_cursor_force`. Its z is up, as ours is.
//!
//! `read` and `write` are called once a tick and must not wait for longer than a part of one. An error of either ends the
//! loop after the force has been set to zero.

use glam::DVec3;
use palpate::haptics::Device;
use palpate::haptics::hand::{Hand, Held};

use crate::link::Task;

/// What a device says at a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Reading {
    /// In the device's frame, m.
    pub(crate) place_m: DVec3,
    /// Its owner asks for forces: a button, a pedal. Only a change from false to true enables.
    pub(crate) enable: bool,
}

/// A haptic device.
pub(crate) trait HapticDevice: Send {
    /// What it can bear.
    fn descriptor(&self) -> Device;
    /// Where it is.
    fn read(&mut self) -> std::io::Result<Reading>;
    /// What it renders until the next tick, N, in its own frame.
    fn write(&mut self, force_n: DVec3) -> std::io::Result<()>;
}

/// A device in a simulated hand, which goes on by a tick with each force that is written.
pub(crate) struct Simulated {
    device: Device,
    hand: Hand,
    held: Held,
    task: Task,
    tick: u32,
    tick_s: f64,
}

impl Simulated {
    pub(crate) fn new(device: Device, hand: Hand, task: Task, tick_s: f64) -> Self {
        let held = Held { place_m: task.start_m(), velocity_m_per_s: DVec3::ZERO };
        Simulated { device, hand, held, task, tick: 0, tick_s }
    }
}

/// The owner of a simulated hand asks for forces so often, ticks: it may be refused, or taken from it.
const ASKS_EVERY: u32 = 300;

impl HapticDevice for Simulated {
    fn descriptor(&self) -> Device {
        self.device
    }

    fn read(&mut self) -> std::io::Result<Reading> {
        Ok(Reading { place_m: self.held.place_m, enable: self.tick % ASKS_EVERY < ASKS_EVERY / 2 })
    }

    fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
        let at = |tick: u32| self.task.at(f64::from(tick) * self.tick_s);
        let string_n = self.hand.string_n(at(self.tick), self.held.place_m);
        self.held = self.hand.advance(self.held, at(self.tick), at(self.tick + 1), force_n + string_n, self.tick_s);
        self.tick += 1;
        Ok(())
    }
}
