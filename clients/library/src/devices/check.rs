//! Checks a device: runs it for some seconds without a force, and measures its timing.

use std::time::{Duration, Instant};

use glam::DVec3;

use crate::bridge::TICK_S;
use crate::device::HapticDevice;

/// The results of [`check`], until the time had passed or the device failed.
#[derive(Debug, Clone, Default)]
pub struct DeviceReport {
    /// Number of ticks, including one at which the device failed.
    pub ticks: u64,
    /// Mean number of ticks per second.
    pub rate_hz: f64,
    /// Positions per second that differ from the one before: about the device's own rate, if it is moved all the time.
    pub changes_hz: f64,
    /// Time from one tick to the next, s: median, 99th percentile and longest; zeros with fewer than two ticks.
    pub period_s: [f64; 3],
    /// Duration of reading the device and setting its force, s: median, 99th percentile and longest; zeros without a
    /// tick.
    pub call_s: [f64; 3],
    /// Smallest and largest x, y and z of the positions, m, in the device's frame; `None` without a finite position.
    pub place_m: Option<[DVec3; 2]>,
    /// Buttons that were pressed at any time: bit n for button n. Bit 0 is also set if forces were requested
    /// ([`crate::Reading::enable`]).
    pub buttons: u32,
    /// Number of readings whose position was not finite. They count in none of the other values but the times.
    pub not_finite: u64,
    /// The error of the device that ended the check early; `None` if the time has passed.
    pub failure: Option<String>,
}

/// Reads a device a thousand times per second for the time `lasts`, and sets a force of zero each time and at the end.
/// Blocks the thread that long; ends earlier if the device fails. Missed ticks are not made up for.
pub fn check(device: &mut dyn HapticDevice, lasts: Duration) -> DeviceReport {
    let begun = Instant::now();
    let (mut checked, mut changes) = (DeviceReport::default(), 0_u32);
    let (mut periods, mut calls) = (Vec::new(), Vec::new());
    let (mut before, mut last_m) = (None, None);
    let mut due = begun;
    while due.duration_since(begun) < lasts {
        if let Some(rest) = due.checked_duration_since(Instant::now()) {
            std::thread::sleep(rest);
        }
        let now = Instant::now();
        if let Some(before) = before.replace(now) {
            periods.push(now.duration_since(before).as_secs_f64());
        }
        let done = device.read().and_then(|reading| device.write(DVec3::ZERO).map(|()| reading));
        calls.push(now.elapsed().as_secs_f64());
        // Missed ticks are not made up for.
        due = due.max(now) + Duration::from_secs_f64(TICK_S);
        checked.ticks += 1;
        match done {
            Ok(reading) if reading.place_m.is_finite() => {
                let place_m = reading.place_m;
                let [least, most] = checked.place_m.unwrap_or([place_m; 2]);
                checked.place_m = Some([least.min(place_m), most.max(place_m)]);
                changes += u32::from(last_m.replace(place_m).is_some_and(|last| last != place_m));
                checked.buttons |= device.buttons() | u32::from(reading.enable);
            }
            Ok(_) => checked.not_finite += 1,
            Err(error) => {
                checked.failure = Some(error.to_string());
                break;
            }
        }
    }
    let passed_s = begun.elapsed().as_secs_f64().max(TICK_S);
    #[allow(clippy::cast_precision_loss)]
    let ticks = checked.ticks as f64;
    (checked.rate_hz, checked.changes_hz) = (ticks / passed_s, f64::from(changes) / passed_s);
    (checked.period_s, checked.call_s) = (quantiles(&mut periods), quantiles(&mut calls));
    let _ = device.write(DVec3::ZERO);
    checked
}

/// Returns median, 99th percentile and maximum; 0 if there are no values. Sorts the values.
fn quantiles(values: &mut [f64]) -> [f64; 3] {
    values.sort_by(f64::total_cmp);
    let at = |hundredths: usize| values.get((values.len() * hundredths / 100).min(values.len().saturating_sub(1)));
    [at(50), at(99), at(100)].map(|value| value.copied().unwrap_or(0.0))
}

#[cfg(test)]
mod tests {
    use palpate_haptics::Device;
    use palpate_haptics::device::UNDECLARED;

    use super::*;
    use crate::device::Reading;

    /// A device that moves by a millimetre at each reading, and is unplugged at the 40th.
    struct CountingDevice(u32, Vec<DVec3>);

    impl HapticDevice for CountingDevice {
        fn descriptor(&self) -> Device {
            UNDECLARED
        }

        fn read(&mut self) -> std::io::Result<Reading> {
            self.0 += 1;
            if self.0 == 40 {
                return Err(std::io::ErrorKind::BrokenPipe.into());
            }
            Ok(Reading { place_m: 1e-3 * f64::from(self.0) * DVec3::X, enable: self.0 == 7 })
        }

        fn write(&mut self, force_n: DVec3) -> std::io::Result<()> {
            self.1.push(force_n);
            Ok(())
        }
    }

    #[test]
    fn a_check_sets_no_force_and_tells_why_it_ended() {
        let mut device = CountingDevice(0, Vec::new());
        let checked = check(&mut device, Duration::from_secs(5));
        assert!(device.1.len() == 40 && device.1.iter().all(|force_n| *force_n == DVec3::ZERO));
        assert_eq!((checked.ticks, checked.buttons, checked.not_finite), (40, 1, 0));
        assert_eq!(checked.place_m, Some([1e-3 * DVec3::X, 39e-3 * DVec3::X]));
        assert!(checked.failure.is_some() && checked.changes_hz > 0.0 && checked.period_s.is_sorted());
    }
}
