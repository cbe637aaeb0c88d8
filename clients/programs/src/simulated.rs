//! Simulated devices in simulated hands, in real time.

use std::time::Instant;

use glam::DVec3;
use palpate_client::{HapticDevice, Reading};
use palpate_haptics::Device;
use palpate_haptics::device::{DEVICES, UNDECLARED};
use palpate_haptics::hand::{HANDS, Hand, HandState};
use palpate_refusal::{Reason, Refusal, did_you_mean};
use palpate_simulated::task::Task;

/// The value found for a name, or an error that lists the names.
fn named<T>(field: &str, name: &str, found: Option<T>, names: &[&str]) -> Result<T, Refusal> {
    found.ok_or_else(|| {
        let meant = did_you_mean(name, names.iter().copied());
        Refusal::new(Reason::WrongKind, field, format!("must be one of {}, but is `{name}`{meant}", names.join(", ")))
    })
}

/// The device of that name.
///
/// # Errors
/// Returns an error that lists the names if there is no such device.
pub(crate) fn device_named(name: &str) -> Result<Device, Refusal> {
    let mut names: Vec<&str> = DEVICES.iter().map(|device| device.name).collect();
    names.push(UNDECLARED.name);
    let found = if name == UNDECLARED.name { Some(UNDECLARED) } else { Device::named(name) };
    named("--device", name, found, &names)
}

/// The hand of that name.
///
/// # Errors
/// Returns an error that lists the names if there is no such hand.
pub(crate) fn hand_named(name: &str) -> Result<Hand, Refusal> {
    let names: Vec<&str> = HANDS.iter().map(|hand| hand.name).collect();
    named("--hand", name, Hand::named(name), &names)
}

/// One part of a simulated hand's course.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CoursePart {
    /// The end of the part, since the beginning of the course, s.
    pub(crate) time_s: f64,
    /// Position of the hand at the end, m.
    pub(crate) place_m: DVec3,
    /// Force that the device held during the part, N.
    pub(crate) force_n: DVec3,
}

/// A simulated device in a simulated hand. The hand moves with real time, even if the loop is late: like a real device, it
/// holds the last force until the next is written.
pub(crate) struct Simulated {
    device: Device,
    hand: Hand,
    held: HandState,
    task: Task,
    force_n: DVec3,
    begun: Option<Instant>,
    time_s: f64,
    energy_j: f64,
    energy_min_j: f64,
    /// The parts of the course, if they are remembered.
    course: Option<Vec<CoursePart>>,
}

/// Longest part of a simulated hand's course, s.
const PART_S: f64 = 1e-3;

impl Simulated {
    pub(crate) fn new(device: Device, hand: Hand, task: Task, remember: bool) -> Self {
        let held = HandState { place_m: task.start_m(), velocity_m_per_s: DVec3::ZERO };
        let (force_n, course) = (DVec3::ZERO, remember.then(Vec::new));
        let (begun, time_s, energy_j, energy_min_j) = (None, 0.0, 0.0, 0.0);
        Simulated { device, hand, held, task, force_n, begun, time_s, energy_j, energy_min_j, course }
    }

    /// The course so far; empty if it is not remembered.
    pub(crate) fn course(&self) -> &[CoursePart] {
        self.course.as_deref().unwrap_or_default()
    }

    /// The minimum of the energy that the port has received, J. Each force counts for as long as the device held it.
    pub(crate) fn energy_min_j(&self) -> f64 {
        self.energy_min_j
    }

    /// Advances the hand to `time_s` under the held force.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn advance_to(&mut self, time_s: f64) {
        let passed_s = time_s - self.time_s;
        let parts = (passed_s / PART_S).ceil().max(0.0) as u32;
        for _ in 0..parts {
            let part_s = passed_s / f64::from(parts);
            let (from_m, to_m) = (self.task.at(self.time_s), self.task.at(self.time_s + part_s));
            let string_n = self.hand.string_n(from_m, self.held.place_m);
            let before_m = self.held.place_m;
            self.held = self.hand.advance(self.held, from_m, to_m, self.force_n + string_n, part_s);
            self.time_s += part_s;
            self.energy_j -= self.force_n.dot(self.held.place_m - before_m);
            self.energy_min_j = self.energy_min_j.min(self.energy_j);
            if let Some(course) = &mut self.course {
                course.push(CoursePart { time_s: self.time_s, place_m: self.held.place_m, force_n: self.force_n });
            }
        }
    }

    fn now_s(&mut self) -> f64 {
        self.begun.get_or_insert_with(Instant::now).elapsed().as_secs_f64()
    }
}

/// The simulated operator asks for forces with this period, s: the envelope may refuse or stop them.
const ASKS_EVERY_S: f64 = 0.3;

impl HapticDevice for Simulated {
    fn descriptor(&self) -> Device {
        self.device
    }

    fn read(&mut self) -> std::io::Result<Reading> {
        let now_s = self.now_s();
        self.advance_to(now_s);
        Ok(Reading { place_m: self.held.place_m, enable: now_s % ASKS_EVERY_S < ASKS_EVERY_S / 2.0 })
    }

    fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
        let now_s = self.now_s();
        self.advance_to(now_s);
        self.force_n = force_n;
        Ok(())
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use super::*;
    use palpate_simulated::random::Random;

    fn simulated(remember: bool) -> Simulated {
        let task = Task::new(DVec3::ZERO, 0.0, 2.0, 1.0, &mut Random::new(1, 0));
        Simulated::new(Device::named("omega3").unwrap(), Hand::named("medium").unwrap(), task, remember)
    }

    #[test]
    fn a_hand_advances_by_time_and_not_by_ticks() {
        // Under the same held force, the number of calls does not matter.
        let force_n = DVec3::new(0.0, 0.0, 0.5);
        let after = |looks: u32| {
            let mut simulated = simulated(false);
            simulated.force_n = force_n;
            (1..=looks).for_each(|look| simulated.advance_to(0.25 * f64::from(look) / f64::from(looks)));
            (simulated.held.place_m, simulated.energy_j)
        };
        let (often, once) = (after(250), after(1));
        // The parts differ in length, and each takes the target at its middle: hence the tolerance.
        assert!((often.0 - once.0).length() < 1e-7, "{often:?} {once:?}");
        assert!((often.1 - once.1).abs() < 1e-7, "{often:?} {once:?}");
        assert!(often.0.z < simulated(false).held.place_m.z - 1e-3, "{often:?}: the hand did not move");
    }

    #[test]
    fn the_energy_is_that_of_the_force_that_was_held() {
        let mut simulated = simulated(true);
        simulated.force_n = DVec3::new(0.0, 0.0, 1.0);
        simulated.advance_to(0.05);
        simulated.force_n = DVec3::new(0.3, 0.0, -0.5);
        // A stall of a tenth of a second.
        simulated.advance_to(0.15);
        let mut before_m = simulated.task.start_m();
        let (mut energy_j, mut least_j) = (0.0, 0.0_f64);
        for part in simulated.course() {
            energy_j -= part.force_n.dot(part.place_m - before_m);
            before_m = part.place_m;
            least_j = least_j.min(energy_j);
        }
        assert!(simulated.course().len() >= 150 && energy_j != 0.0);
        assert!((simulated.energy_j - energy_j).abs() < 1e-15 && (simulated.energy_min_j() - least_j).abs() < 1e-15);
        assert!(simulated.course().iter().all(|part| part.force_n.x == if part.time_s < 0.0501 { 0.0 } else { 0.3 }));
    }
}
