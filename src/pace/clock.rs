//! The only clock of the server: monotonic, from an origin of its own.

use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// Nanoseconds since the first call in this process; never 0.
#[allow(clippy::disallowed_methods, clippy::cast_possible_truncation)]
pub fn now_ns() -> u64 {
    static ORIGIN: OnceLock<Instant> = OnceLock::new();
    let now = Instant::now();
    let origin = *ORIGIN.get_or_init(|| now.checked_sub(Duration::from_nanos(1)).unwrap_or(now));
    now.duration_since(origin).as_nanos() as u64
}
