//! Whether tests run in their long form (`make test-long`) or the short one (`make test`): docs/tests.md lists both.
#![allow(dead_code, unreachable_pub)]

/// Returns `short`, or with `PALPATE_LONG=1` `long`.
pub fn form<T>(short: T, long: T) -> T {
    if std::env::var_os("PALPATE_LONG").is_some() { long } else { short }
}
