//! The clock of stepping, which is monotonic with its own origin; and the time dilation of sessions.

use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// Returns the nanoseconds since the first call in this process, plus 1; it never decreases and is never 0. It stands
/// still while the machine is suspended.
#[allow(clippy::disallowed_methods, clippy::cast_possible_truncation)]
pub fn now_ns() -> u64 {
    static ORIGIN: OnceLock<Instant> = OnceLock::new();
    let now = Instant::now();
    let origin = *ORIGIN.get_or_init(|| now.checked_sub(Duration::from_nanos(1)).unwrap_or(now));
    now.duration_since(origin).as_nanos() as u64
}

/// Returns the processor time of the calling thread, ns.
#[allow(clippy::cast_sign_loss, clippy::cast_possible_truncation)]
pub fn thread_time_ns() -> u64 {
    #[cfg(target_os = "linux")]
    {
        let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
        time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
    }
    #[cfg(not(target_os = "linux"))]
    {
        cpu_time::ThreadTime::try_now().map_or_else(|_| now_ns(), |time| time.as_duration().as_nanos() as u64)
    }
}

/// Length of the window over which time dilation is measured, ns.
const DILATION_WINDOW_NS: u64 = 1_000_000_000;

/// Time dilation of a session: simulated over real time, measured over windows of about a second. Steps that a
/// session at rest skips count as simulated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Dilation {
    /// The newest measurement: 1 when the session is on time and before the first, less when it is late.
    pub value: f64,
    /// Time at which the window of the next measurement began, ns, and the step count then.
    since: (u64, u64),
}

impl Dilation {
    pub(super) fn new(now_ns: u64, step: u64) -> Self {
        Dilation { value: 1.0, since: (now_ns, step) }
    }

    #[allow(clippy::cast_precision_loss)]
    pub(super) fn observe(&mut self, now_ns: u64, step: u64, period_ns: f64) {
        let elapsed_ns = now_ns.saturating_sub(self.since.0);
        if elapsed_ns >= DILATION_WINDOW_NS {
            self.value = step.saturating_sub(self.since.1) as f64 * period_ns / elapsed_ns as f64;
            self.since = (now_ns, step);
        }
    }
}
