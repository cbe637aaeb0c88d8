//! The loop of a device: a thousand times a second it reads the device, renders, and writes the force.

use std::time::{Duration, Instant};

use glam::DVec3;
use palpate_touch::deadband::HEARTBEAT_S;
use palpate_touch::news::News;
use palpate_touch::{Envelope, Renderer, RenderingState};
use tokio::sync::mpsc;

use super::line::{Command, Inbound, Shared};
use crate::device::HapticDevice;

/// Period of the device's loop, s.
pub const TICK_S: f64 = 1e-3;

/// After a longer delay the loop skips the missed ticks: catching up would cause a burst.
const MOST_LATE: Duration = Duration::from_millis(5);

/// Largest number of ticks that are remembered.
const MOST_REMEMBERED: usize = 3_600_000;

/// One tick of a device's loop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tick {
    /// Time since the loop began, s.
    pub time_s: f64,
    /// Position in the sheet's frame, m; before the first connection in the device's.
    pub place_m: DVec3,
    /// The rendered force, N.
    pub force_n: DVec3,
    /// `None` before the first connection.
    pub state: Option<RenderingState>,
}

/// The results of a device's loop.
pub(super) struct Served {
    /// The remembered ticks; empty unless the loop was to remember them.
    pub(super) course: Vec<Tick>,
    /// The renderer's envelope; `None` without a connection.
    pub(super) envelope: Option<Envelope>,
    /// Number of ticks that began more than a tick late.
    pub(super) late_ticks: u64,
    /// Number of ticks that were skipped.
    pub(super) missed_ticks: u64,
    /// Age of the local model at each tick, s; empty unless the loop was to remember.
    pub(super) ages_s: Vec<f64>,
}

/// Runs the loop of a device for a time, or until `commands` is closed, and then sets its force to zero, also after an error.
/// `remember`: keeps the course and the models' ages.
///
/// # Errors
/// Returns the device's error if it can't be read or written.
pub(super) fn serve(
    device: &mut dyn HapticDevice,
    shared: &Shared,
    commands: &mpsc::Sender<Command>,
    up_deadband: f64,
    lasts: Option<Duration>,
    remember: bool,
) -> std::io::Result<Served> {
    let ended = tick(device, shared, commands, up_deadband, lasts, remember);
    // A device holds its last force until it is told another.
    let _ = device.write(DVec3::ZERO);
    ended
}

fn tick(
    device: &mut dyn HapticDevice,
    shared: &Shared,
    commands: &mpsc::Sender<Command>,
    up_deadband: f64,
    lasts: Option<Duration>,
    remember: bool,
) -> std::io::Result<Served> {
    let descriptor = device.descriptor();
    let mut renderer: Option<Renderer> = None;
    let mut served = Served { course: Vec::new(), envelope: None, late_ticks: 0, missed_ticks: 0, ages_s: Vec::new() };
    let (start, mut was_asked) = (Instant::now(), false);
    let mut news = News::default();
    // The clock begins at 1 s, because 0 means "no time" in the protocol.
    let clock_s = |at: Instant| 1.0 + at.duration_since(start).as_secs_f64();
    let mut due = start;
    while lasts.is_none_or(|lasts| due.duration_since(start) < lasts) && !commands.is_closed() {
        wait_until(due);
        let now = Instant::now();
        let late = now.duration_since(due);
        served.late_ticks += u64::from(late.as_secs_f64() > TICK_S);
        if late > MOST_LATE {
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
            let missed = (late.as_secs_f64() / TICK_S) as u64;
            served.missed_ticks += missed;
            due = now;
        }
        due += Duration::from_secs_f64(TICK_S);
        let reading = device.read()?;
        let now_s = clock_s(now);
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
        let now_ns = (now_s * 1e9) as u64;
        let mut force_n = DVec3::ZERO;
        let (law, further, model, middle_m, wanted_s) = {
            let mut inbound = shared.inbound();
            let Inbound { middle_m, wanted_s, .. } = *inbound;
            (inbound.law.take(), std::mem::take(&mut inbound.further), inbound.newest.take(), middle_m, wanted_s)
        };
        // The middle of the device's workspace is on the middle of the sheet.
        let place_m = reading.place_m + middle_m;
        if let Some(law) = law {
            match &mut renderer {
                // The envelope stays: what was paused stays paused, and a rendered force falls at the slew limit.
                Some(renderer) => renderer.begin(law),
                None => renderer = Some(Renderer::new(law, Envelope::new(descriptor, middle_m))),
            }
        }
        if let Some(renderer) = &mut renderer {
            if reading.enable && !was_asked {
                renderer.envelope.reset();
                renderer.envelope.enable();
            }
            // Before the models that name them.
            for (number, law) in further {
                renderer.learn(number, law);
            }
            if let Some(model) = model {
                renderer.receive(model, now_s);
            }
            force_n = renderer.tick(now_s, place_m);
            if remember && let Some(time_s) = renderer.model_time_s() {
                served.ages_s.push(now_s - time_s);
            }
        }
        was_asked = reading.enable;
        device.write(force_n)?;
        if remember && served.course.len() < MOST_REMEMBERED {
            let state = renderer.as_ref().map(Renderer::state);
            served.course.push(Tick { time_s: now_s - 1.0, place_m, force_n, state });
        }
        // Before the first connection it is not known where the sheet is. If the network does not keep up, this position is
        // dropped; the next one replaces it.
        if let Some(renderer) = &renderer {
            let command = if up_deadband > 0.0 {
                let heartbeat_s = if wanted_s > 0.0 { wanted_s } else { HEARTBEAT_S };
                let told = news.tell(now_s, place_m, renderer.way_m(up_deadband), heartbeat_s);
                told.map(|told| Command {
                    client_time_ns: now_ns,
                    place_m,
                    velocity_m_per_s: Some(told.velocity_m_per_s),
                })
            } else {
                Some(Command { client_time_ns: now_ns, place_m, velocity_m_per_s: None })
            };
            command.map(|command| commands.try_send(command));
        }
    }
    served.envelope = renderer.map(|renderer| renderer.envelope);
    Ok(served)
}

/// Sleeps until shortly before `due`, then polls the clock.
fn wait_until(due: Instant) {
    const SPIN: Duration = Duration::from_micros(80);
    if let Some(rest) = due.checked_duration_since(Instant::now() + SPIN) {
        std::thread::sleep(rest);
    }
    while Instant::now() < due {
        std::hint::spin_loop();
    }
}

#[cfg(test)]
mod tests {
    use palpate_touch::Law;
    use palpate_touch::device::{Device, UNDECLARED};

    use super::*;
    use crate::device::Reading;

    /// Fails to be read at its 20th tick; remembers what it was last told.
    struct Failing {
        ticks: u32,
        force_n: DVec3,
    }

    impl HapticDevice for Failing {
        fn descriptor(&self) -> Device {
            UNDECLARED
        }

        fn read(&mut self) -> std::io::Result<Reading> {
            self.ticks += 1;
            if self.ticks == 20 {
                // As if a force were held.
                self.force_n = DVec3::Z;
                return Err(std::io::ErrorKind::BrokenPipe.into());
            }
            Ok(Reading { place_m: DVec3::ZERO, enable: true })
        }

        fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
            self.force_n = force_n;
            Ok(())
        }
    }

    #[test]
    fn a_device_that_fails_is_left_without_a_force() {
        let (commands, _received) = mpsc::channel(64);
        let shared = Shared::default();
        shared.inbound().law = Some(Law::linear(400.0, 0.5));
        let mut device = Failing { ticks: 0, force_n: DVec3::X };
        let ended = serve(&mut device, &shared, &commands, 0.0, None, false);
        assert!(ended.is_err());
        assert_eq!((device.ticks, device.force_n), (20, DVec3::ZERO));
    }
}
