//! Forces that a bridge rendered, tick by tick (`palpate-client bridge --course FILE`), and the checks that hold in
//! every failure.
#![allow(unreachable_pub, clippy::unwrap_used, clippy::panic)]

use std::path::Path;

/// A tick of a bridge's course.
struct TraceTick {
    time_s: f64,
    force_n: [f64; 3],
    state: String,
}

fn length(v: [f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}

/// The course of a device, without the file it was in.
pub struct DeviceTrace(Vec<TraceTick>);

impl DeviceTrace {
    /// Reads the file, and removes it.
    pub fn take(path: &Path) -> Self {
        let text = std::fs::read_to_string(path).unwrap();
        std::fs::remove_file(path).unwrap();
        let tick = |line: &str| {
            let fields: Vec<&str> = line.split(',').collect();
            let number = |at: usize| fields[at].parse::<f64>().unwrap();
            TraceTick { time_s: number(0), force_n: [number(4), number(5), number(6)], state: fields[7].to_owned() }
        };
        DeviceTrace(text.lines().skip(1).map(tick).collect())
    }

    /// Every force is within the envelope: its size, its slew, what is left of it 0.3 s after a pause, and that it
    /// never rises while paused. Tells when the device was paused.
    pub fn keeps_to_the_envelope(&self) -> Vec<f64> {
        let mut pauses = Vec::new();
        for pair in self.0.windows(2) {
            let (before, now) = (&pair[0], &pair[1]);
            assert!(now.force_n.iter().all(|c| c.is_finite()) && length(now.force_n) <= 3.3, "at {} s", now.time_s);
            let change_n = length(std::array::from_fn(|c| now.force_n[c] - before.force_n[c]));
            let most_n = 100.0 * (now.time_s - before.time_s).min(0.01) + 1e-5;
            assert!(change_n <= most_n, "{change_n} N at {} s, at most {most_n}", now.time_s);
            match (before.state.as_str(), now.state.as_str()) {
                ("enabled", "paused") => pauses.push(now.time_s),
                ("paused", "paused") => {
                    assert!(length(now.force_n) <= length(before.force_n) + 1e-6, "at {} s", now.time_s);
                }
                _ => {}
            }
        }
        for paused_s in &pauses {
            // Until it is enabled again.
            let paused = self.0.iter().skip_while(|tick| tick.time_s < *paused_s);
            let later = paused.take_while(|tick| tick.state == "paused").filter(|tick| tick.time_s > paused_s + 0.3);
            for tick in later {
                assert!(length(tick.force_n) < 0.05, "{} N at {} s", length(tick.force_n), tick.time_s);
            }
        }
        pauses
    }

    /// Returns whether the device is enabled at some time after `time_s`.
    pub fn comes_back_after(&self, time_s: f64) -> bool {
        self.0.iter().any(|tick| tick.time_s > time_s && tick.state == "enabled")
    }
}
