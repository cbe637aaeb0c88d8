//! Number of cases that a test tries: few in `make test`, many in `make test-long`. docs/tests.md lists both.
#![allow(dead_code, unreachable_pub, clippy::unwrap_used)]

/// Returns `short`, or with `PALPATE_LONG=1` `long`.
pub fn short_or_long<T>(short: T, long: T) -> T {
    if std::env::var_os("PALPATE_LONG").is_some() { long } else { short }
}

/// Returns the number that `variable` of the environment gives, or else [`short_or_long`].
pub fn count<T: std::str::FromStr<Err: std::fmt::Debug>>(variable: &str, short: T, long: T) -> T {
    std::env::var(variable).map_or_else(|_| short_or_long(short, long), |text| text.parse().unwrap())
}
