//! Number of cases that a test tries: few in `make test`, many in `make test-long`. docs/tests.md lists both.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used)]

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Calls `of` with each item, on as many threads as there are cores, and returns the results in the order of the items.
pub fn on_every_core<I: Sync, R: Send>(items: &[I], of: impl Fn(&I) -> R + Sync) -> Vec<R> {
    let next = AtomicUsize::new(0);
    let results: Vec<Mutex<Option<R>>> = items.iter().map(|_| Mutex::new(None)).collect();
    let work = || {
        loop {
            let at = next.fetch_add(1, Ordering::Relaxed);
            let Some(item) = items.get(at) else { return };
            *results[at].lock().unwrap() = Some(of(item));
        }
    };
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    std::thread::scope(|scope| (0..cores).for_each(|_| _ = scope.spawn(work)));
    results.into_iter().map(|result| result.into_inner().unwrap().unwrap()).collect()
}

/// Returns `short`, or with `PALPATE_LONG=1` `long`.
pub fn short_or_long<T>(short: T, long: T) -> T {
    if std::env::var_os("PALPATE_LONG").is_some() { long } else { short }
}

/// Returns the number that `variable` of the environment gives, or else [`short_or_long`].
pub fn count<T: std::str::FromStr<Err: std::fmt::Debug>>(variable: &str, short: T, long: T) -> T {
    std::env::var(variable).map_or_else(|_| short_or_long(short, long), |text| text.parse().unwrap())
}
