//! The loop of a device: a thousand times per second it reads the device, renders, and writes the force.

use std::time::{Duration, Instant};

use glam::DVec3;
use palpate_haptics::{Envelope, RenderingState, Wrench};
use tokio::sync::Notify;

use super::Disable;
use super::lateness::TickLateness;
use super::ticker::Ticker;
use crate::device::HapticDevice;

/// Period of the device's loop, s.
pub const TICK_S: f64 = 1e-3;

/// Delay above which the loop skips the missed ticks: catching up would cause a burst.
const MAX_LATE: Duration = Duration::from_millis(5);

/// Maximum number of ticks that are recorded.
const MAX_REMEMBERED: usize = 3_600_000;

/// One tick of a device's loop: what [`crate::HapticDevice::ticked`] and [`super::BridgeReport::course`] get.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Tick {
    /// Time from the start of the loop until the device was read, s.
    pub time_s: f64,
    /// Position of the tool in the tissue's frame, m; before the first connection, in the device's frame.
    pub place_m: DVec3,
    /// The force written to the device, N, in its frame.
    pub force_n: DVec3,
    /// Whether forces are rendered; `None` before the first connection.
    pub state: Option<RenderingState>,
}

/// The results of a device's loop, until it ended or the device failed.
#[derive(Default)]
pub(super) struct Served {
    /// The recorded ticks; empty unless the loop was to record them.
    pub(super) course: Vec<Tick>,
    /// The renderer's envelope; `None` without a connection.
    pub(super) envelope: Option<Envelope>,
    /// Number of ticks that started more than a tick late.
    pub(super) late_ticks: u64,
    /// Number of ticks that were skipped.
    pub(super) missed_ticks: u64,
    /// How late the ticks began that were not skipped.
    pub(super) lateness: TickLateness,
    /// Number of ticks that were rendered from a copy of the tissue.
    pub(super) predicted_ticks: u64,
    /// The largest rendered force, N, and torque, N·m.
    pub(super) most_force_n: f64,
    pub(super) most_torque_n_m: f64,
    /// Age of the local model at each tick, s; empty unless the loop was to record it.
    pub(super) ages_s: Vec<f64>,
    /// The error of the device, if it failed.
    pub(super) failure: Option<std::io::Error>,
}

/// Runs the loop of a device for a time, or until the network side has ended. Then sets its force to zero, also after
/// an error. `remember`: records the course and the models' ages. `news` is notified when there is something to send.
pub(super) fn serve(
    device: &mut dyn HapticDevice,
    mut ticker: Ticker,
    news: &Notify,
    disable: &Disable,
    lasts: Option<Duration>,
    remember: bool,
) -> Served {
    let mut served = Served::default();
    served.failure = tick(device, &mut ticker, news, disable, lasts, remember, &mut served).err();
    // A device holds its last force until it gets another.
    let _ = if ticker.has_instrument() { device.write_wrench(Wrench::default()) } else { device.write(DVec3::ZERO) };
    served.envelope = ticker.envelope().cloned();
    served.predicted_ticks = ticker.predicted();
    drop(ticker);
    // The network side waits for the next place, or for the end.
    news.notify_one();
    served
}

/// # Errors
/// Returns the device's error if it can't be read or written.
fn tick(
    device: &mut dyn HapticDevice,
    ticker: &mut Ticker,
    news: &Notify,
    disable: &Disable,
    lasts: Option<Duration>,
    remember: bool,
    served: &mut Served,
) -> std::io::Result<()> {
    let Served { course, late_ticks, missed_ticks, lateness, ages_s, most_force_n, most_torque_n_m, .. } = served;
    let start = Instant::now();
    let mut due = start;
    // If a tick is much too late, later ones are timed from it.
    let mut catch_up = |due: &mut Instant| {
        let now = Instant::now();
        let late = now.saturating_duration_since(*due);
        if late > MAX_LATE {
            #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
            let missed = (late.as_secs_f64() / TICK_S) as u64;
            *missed_ticks += missed;
            *due = now;
        }
        (now, late)
    };
    while lasts.is_none_or(|lasts| due.duration_since(start) < lasts) && !ticker.is_over() {
        wait_until(due);
        let late = catch_up(&mut due).1;
        *late_ticks += u64::from(late.as_secs_f64() > TICK_S);
        lateness.add(late);
        let reading = device.read()?;
        // The device may have waited for its next position. The time of the force is what counts: a late tick must
        // not be made up for by a step at the next one.
        let (now, _) = catch_up(&mut due);
        due += Duration::from_secs_f64(TICK_S);
        let time_s = now.duration_since(start).as_secs_f64();
        if disable.take() {
            ticker.disable();
        }
        ticker.press(device.buttons());
        let wrench = ticker.tick_turned(reading, device.orientation(), device.jaw_rad(), time_s);
        let force_n = wrench.force_n;
        if ticker.has_instrument() {
            device.write_wrench(wrench)?;
        } else {
            device.write(force_n)?;
        }
        *most_force_n = most_force_n.max(force_n.length());
        *most_torque_n_m = most_torque_n_m.max(wrench.torque_n_m.length());
        if ticker.has_spoken() {
            news.notify_one();
        }
        let tick = Tick { time_s, place_m: ticker.place_m(), force_n, state: ticker.state() };
        device.ticked(&tick);
        if remember && course.len() < MAX_REMEMBERED {
            ages_s.extend(ticker.model_age_s());
            course.push(tick);
        }
    }
    Ok(())
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
    use palpate_haptics::Law;
    use palpate_haptics::device::{Device, UNDECLARED};

    use super::*;
    use crate::bridge::ticker::{PositionOrigin, ticker};
    use crate::device::Reading;

    /// A device that fails at its 20th reading; records the last force.
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

    /// A device pressed 2 mm deep whose 40th reading takes a fifth of a second; ends soon after.
    struct Slow {
        ticks: u32,
        forces: Vec<(Instant, f64)>,
    }

    impl HapticDevice for Slow {
        fn descriptor(&self) -> Device {
            Device { workspace_m: 0.1, ..UNDECLARED }
        }

        fn read(&mut self) -> std::io::Result<Reading> {
            self.ticks += 1;
            if self.ticks == 40 {
                std::thread::sleep(Duration::from_millis(200));
            }
            Ok(Reading { place_m: DVec3::new(0.0, 0.0, -0.002 - 1e-5 * f64::from(self.ticks)), enable: true })
        }

        fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
            self.forces.push((Instant::now(), force_n.length()));
            Ok(())
        }
    }

    #[test]
    fn a_slow_reading_is_no_reason_for_a_step_at_the_next_tick() {
        let mut device = Slow { ticks: 0, forces: Vec::new() };
        let (ticker, mut feed, _commands) = ticker(device.descriptor(), PositionOrigin::Workspace, 0.0);
        feed.begin(Some(&palpate_proto::touch::law(&Law::linear(400.0, 0.5), 0)), DVec3::ZERO).unwrap();
        let lasts = Some(Duration::from_millis(300));
        let served = serve(&mut device, ticker, &Notify::new(), &Disable::default(), lasts, true);
        assert!(served.missed_ticks >= 199, "{}", served.missed_ticks);
        // Between two times of the loop no more time has passed than between the writes of their forces.
        for (ticks, writes) in served.course.windows(2).zip(device.forces.windows(2)) {
            let told_s = ticks[1].time_s - ticks[0].time_s;
            let took_s = writes[1].0.duration_since(writes[0].0).as_secs_f64();
            assert!(told_s < took_s + 0.15, "{told_s} {took_s}");
        }
    }

    #[test]
    fn a_device_that_fails_is_left_without_a_force() {
        let mut device = Failing { ticks: 0, force_n: DVec3::X };
        let (ticker, mut feed, _commands) = ticker(device.descriptor(), PositionOrigin::Workspace, 0.0);
        feed.begin(Some(&palpate_proto::touch::law(&Law::linear(400.0, 0.5), 0)), DVec3::ZERO).unwrap();
        let served = serve(&mut device, ticker, &Notify::new(), &Disable::default(), None, true);
        assert_eq!(served.failure.map(|error| error.kind()), Some(std::io::ErrorKind::BrokenPipe));
        // The results until then are returned.
        assert_eq!((served.course.len(), served.envelope.is_some()), (19, true));
        assert_eq!((device.ticks, device.force_n), (20, DVec3::ZERO));
    }
}
