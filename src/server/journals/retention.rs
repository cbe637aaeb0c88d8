//! How long journals are kept, as configured.

use std::str::FromStr;
use std::time::Duration;

use serde::Deserialize;

use palpate_session::budget::parse_bytes;

/// The age above which journals of ended sessions are removed, and the size of all journals above which the oldest of
/// those are. The newest journal of a running session, and those that could not be continued, are never removed.
/// Parsed from `30d,10GiB` (the default), one of both (the other is then unlimited), or `0`, which keeps none; an age
/// is in `d`, `h`, `m` or `s`.
#[derive(Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(try_from = "String")]
pub struct Keep {
    /// Age, since the end of its session, at which a journal is removed; [`Duration::MAX`]: never.
    pub age: Duration,
    /// Limit on the bytes of all journals together; [`u64::MAX`]: none.
    pub bytes: u64,
}

impl std::fmt::Debug for Keep {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} s, {} bytes", self.age.as_secs(), self.bytes)
    }
}

impl Default for Keep {
    fn default() -> Self {
        Keep { age: Duration::from_secs(30 * DAY_S), bytes: 10 << 30 }
    }
}

const DAY_S: u64 = 24 * 3600;

impl FromStr for Keep {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text.trim() == "0" {
            return Ok(Keep { age: Duration::ZERO, bytes: 0 });
        }
        let (mut age, mut bytes) = (None, None);
        for part in text.split(',').map(str::trim) {
            let is_told_twice = match age_of(part) {
                Some(found) => age.replace(found).is_some(),
                None => bytes
                    .replace(parse_bytes(part).map_err(|_| {
                        format!("`{part}` is neither an age (30d, 12h, 90m) nor a size (10GiB, 500MiB)")
                    })?)
                    .is_some(),
            };
            if is_told_twice {
                return Err(format!("`{text}` has two ages or two sizes"));
            }
        }
        // A missing value means no limit.
        Ok(Keep { age: age.unwrap_or(Duration::MAX), bytes: bytes.unwrap_or(u64::MAX) })
    }
}

impl TryFrom<String> for Keep {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl Keep {
    /// Describes in words how long the journals of an ended session are kept.
    pub(super) fn in_words(self) -> String {
        let age = match self.age.as_secs() {
            _ if self.age == Duration::MAX => None,
            s if s % DAY_S == 0 => Some(format!("{} days", s / DAY_S)),
            s => Some(format!("{:.1} hours", Duration::from_secs(s).as_secs_f64() / 3600.0)),
        };
        let size = (self.bytes != u64::MAX).then(|| format!("all journals take more than {} MiB", self.bytes >> 20));
        match (age, size) {
            (None, None) => "until somebody removes them".to_owned(),
            (None, Some(size)) => format!("after the session's end until {size}"),
            (Some(age), None) => format!("{age} after the session's end"),
            (Some(age), Some(size)) => format!("{age} after the session's end, or until {size}"),
        }
    }
}

fn age_of(text: &str) -> Option<Duration> {
    let unit_s = match text.chars().last()? {
        'd' => DAY_S,
        'h' => 3600,
        'm' => 60,
        's' => 1,
        _ => return None,
    };
    let count: u64 = text[..text.len() - 1].trim().parse().ok()?;
    Some(Duration::from_secs(count.checked_mul(unit_s)?))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn in_words_it_is_what_people_say() {
        let words = |text: &str| text.parse::<Keep>().unwrap().in_words();
        assert_eq!(
            Keep::default().in_words(),
            "30 days after the session's end, or until all journals take more than 10240 MiB"
        );
        assert_eq!(words("12h"), "12.0 hours after the session's end");
        assert_eq!(words("500MiB"), "after the session's end until all journals take more than 500 MiB");
    }

    #[test]
    fn an_age_a_size_or_both() {
        let hour = Duration::from_secs(3600);
        assert_eq!("12h".parse(), Ok(Keep { age: 12 * hour, bytes: u64::MAX }));
        assert_eq!("2d, 1GiB".parse(), Ok(Keep { age: 48 * hour, bytes: 1 << 30 }));
        assert_eq!("500MiB".parse(), Ok(Keep { age: Duration::MAX, bytes: 500 << 20 }));
        assert_eq!("0".parse(), Ok(Keep { age: Duration::ZERO, bytes: 0 }));
        for wrong in ["", "12x", "1d,2d", "1GiB,2GiB", "d", "-1d", "99999999999999999999d"] {
            assert!(wrong.parse::<Keep>().is_err(), "{wrong}");
        }
    }
}
